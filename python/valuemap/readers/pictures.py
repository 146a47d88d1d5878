"""A folder of pictures without poses: EXIF says where and when, structure from motion or the compass the rest."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, get_args

import numpy as np

from valuemap.arrays import Bools, Floats
from valuemap.errors import InputError, SettingError
from valuemap.geodesy import lon_lat_height_from_crs, with_heights
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported, assemble
from valuemap.readers.cameras_of import CUT_PANORAMA, Camera, make_cameras, parse_camera
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.exif import Exif, check_whole, read_exif
from valuemap.readers.files import check_folder, check_names, file_in
from valuemap.readers.poses import Placed, local_from_cam, make_images, place_on_earth
from valuemap.readers.reader import Reader
from valuemap.readers.structure import Picture, Posed, find_poses
from valuemap.readers.vet import refuse_too_many_unreadable

PosesFrom = Literal["auto", "sfm", "exif"]
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
_NOT_READ = (".heic", ".heif")
_HEIC = "is HEIC, which is not read: convert it to JPEG"
_EXPECTED = f"a folder of pictures: {', '.join(_SUFFIXES)}"
_FOCAL_GUESS = 1.2
"""Focal length over the larger side where structure from motion is to find it: about 45 degrees."""
_NO_FOCAL = "it has no focal length, which --camera can give, and which --poses sfm finds"
_NO_PLACE = "it has no GPS position"
_TURNED = (
    "it was taken on its side or upside down (EXIF orientation), and structure from motion takes cameras for level"
)
_MOST_ROLL_DEG = 45.0
"""Half a quarter turn: EXIF knows quarter turns alone."""
_TILTED = "it looks far up or down (GimbalPitchDegree), and structure from motion takes cameras for level"
_MOST_PITCH_DEG = 45.0
_MAY_BE_PANORAMA = "is twice as wide as high, as panoramas are, and no tag says what it is: say it with --camera"
_SAME_HEADING_DEG = 1.0
_NO_HEADING = "it has no heading (GPSImgDirection, or PoseHeadingDegrees of a panorama)"


@dataclass(frozen=True, eq=False)
class _Found:
    """Pictures that can be used, in driving order."""

    names: list[str]
    exif: list[Exif]
    time_s: list[float]
    passes: list[str]
    placed: Placed
    sigma_m: Floats
    unreadable: dict[str, str]


@Reader
def read_pictures(
    folder: Path,
    *,
    workspace: Path | None = None,
    poses: PosesFrom = "auto",
    camera: str | None = None,
    gps_sigma_m: float = 3.0,
    detections: DetectionFile | Path | None = None,
    vertical: str | None = None,
    anchor: tuple[float, float, float] | None = None,
    threads: int = 0,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read pictures of a folder and its folders, find their poses, and put them on the Earth.

    Panoramas (equirectangular by their GPano tags, or by `camera`) stand at their GPS position with their heading (of
    the GPS tags, else of GPano), pitch and roll. Other pictures get their poses by structure from motion
    (`find_poses`), or with `poses` "exif" are taken level with the heading that the GPS tags give, or as the gimbal of
    a drone says, where their focal length is known. A pass is a folder; times are those of the GPS, else of the
    camera, less what both differ by in the folder.

    Parameters
    ----------
    folder
        The pictures; links that lead out of it are refused.
    workspace
        Where structure from motion keeps what it has found, to go on after an interruption.
    poses
        "sfm" and "exif" as above; "auto" is "exif" for panoramas and "sfm" for the others.
    camera
        As in `parse_camera`, for all pictures, where their own tags are wrong or say nothing.
    gps_sigma_m
        Standard deviation of GPS positions that do not say theirs.
    detections
        As in `read_detections`; without, they are still to be found in the pictures.
    vertical
        What altitudes count from, as in `with_heights`; without, the ellipsoid. Those that EXIF 3.0 says to count from
        the ellipsoid do.
    anchor
        Latitude, longitude and height of the origin; by default the place of the first picture by name.
    threads
        Of structure from motion, 0 for one a core.
    tell
        Called with each line that is worth knowing about the poses.

    Raises
    ------
    InputError
        There are no pictures, none has a GPS position, too many cannot be used, or no poses can be found.
    SettingError
        An option is impossible.
    """
    if poses not in get_args(PosesFrom) or not 0.0 < gps_sigma_m < math.inf:
        raise SettingError(
            f"poses {poses}, gps-sigma {gps_sigma_m:g}: expected {', '.join(get_args(PosesFrom))}, and metres above 0",
            hint="leave them away",
        )
    given = None if camera is None else parse_camera(camera)
    found = _read_all(folder, gps_sigma_m, vertical, anchor, max_rejected, progress, tell, is_whole=given is not None)
    cameras = [given or _guess(exif) for exif in found.exif]
    by_heading = np.array([poses == "exif" or (poses == "auto" and c.model == "EQUIRECTANGULAR") for c in cameras])
    is_guessed = np.array([given is None and not exif.is_panorama and exif.focal_px is None for exif in found.exif])
    rotation, center = _level_poses(found)
    sigma_m, sigma_rad = found.sigma_m.copy(), np.full(len(found.names), np.nan)
    part = np.full(len(found.names), -1)
    why_not: dict[int, str] = {}
    is_turned = ~by_heading & (np.abs([exif.roll_deg for exif in found.exif]) > _MOST_ROLL_DEG)
    why_not |= dict.fromkeys(np.flatnonzero(by_heading & is_guessed).tolist(), _NO_FOCAL)
    why_not |= dict.fromkeys(np.flatnonzero(is_turned).tolist(), _TURNED)
    is_tilted = ~by_heading & ~is_turned & (np.abs([exif.pitch_deg for exif in found.exif]) > _MOST_PITCH_DEG)
    why_not |= dict.fromkeys(np.flatnonzero(is_tilted).tolist(), _TILTED)
    without = ~by_heading | is_guessed
    rotation[without], center[without] = np.nan, np.nan
    rows = np.flatnonzero(~by_heading & ~is_turned & ~is_tilted)
    if tell is not None and (others := _told_twice(found, by_heading)):
        tell(
            f"{others} pictures have another heading in PoseHeadingDegrees or GimbalYawDegree than in "
            "GPSImgDirection or MAPCompassHeading, which is used"
        )
    if len(rows):
        if workspace is None:
            raise SettingError("workspace: structure from motion needs a folder to work in", hint="give --workspace")
        distinct = sorted({cameras[row] for row in rows}, key=lambda c: (c.model, c.width, c.height, c.params))
        known_focal = {cameras[row] for row in rows if not is_guessed[row]}
        posed = find_poses(
            [_picture(folder, found, row, distinct.index(cameras[row])) for row in rows.tolist()],
            distinct,
            [each in known_focal for each in distinct],
            workspace,
            threads=threads,
            progress=progress,
        )
        at = rows[posed.row]
        rotation[at], center[at], part[at] = posed.world_from_cam, posed.center_in_world_m, posed.part
        sigma_m[at], sigma_rad[at] = posed.position_sigma_m, posed.rotation_sigma_rad
        if tell is not None:
            for line in _told(posed, len(rows)):
                tell(line)
        why_not |= {int(rows[row]): reason for row, reason in posed.why_not.items()}
        refined = {distinct[number]: value for number, value in posed.cameras.items()}
        cameras = [each if by_heading[row] else refined.get(each, each) for row, each in enumerate(cameras)]
    has_pose = np.isfinite(center).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2))
    if not has_pose.any() and len(why_not):
        reason = why_not[min(why_not)]
        raise InputError(
            f"{folder}: none of {len(found.names)} pictures has a pose; of the first: {reason}",
            hint='give --camera "SIMPLE_PINHOLE W H f cx cy" of your camera, in pixels'
            if reason == _NO_FOCAL
            else "turn the pictures as their EXIF orientation says, save them so (exiftran -a), and detect in these",
        )
    if not has_pose.any():
        raise InputError(
            f"{folder}: no picture has a heading (GPSImgDirection, or PoseHeadingDegrees of a panorama)",
            hint="--poses sfm finds poses where pictures overlap",
        )
    for row in np.flatnonzero(~has_pose & by_heading & ~is_guessed).tolist():
        why_not[row] = _NO_PLACE if found.exif[row].lat_lon is None else _NO_HEADING
    table, camera_id = make_cameras(cameras, str(folder))
    parts = len(set(part[has_pose].tolist()))
    images = make_images(
        names=found.names,
        camera_id=camera_id,
        world_from_cam=rotation,
        center_in_world_m=center,
        passes=[f"{name}/{part[row]}" if parts > 1 else name for row, name in enumerate(found.passes)],
        source=str(folder),
        timestamp_s=np.array(found.time_s),
        position_sigma_m=sigma_m,
        rotation_sigma_rad=sigma_rad,
    )
    row_of = {name: row for row, name in enumerate(images.name.to_pylist())}
    return assemble(
        name=folder.resolve().name,
        cameras=table,
        images=images,
        detections=read_detections(detections, images, table),
        up=None,
        anchor=found.placed.anchor,
        is_on_earth=True,
        source=str(folder),
        max_rejected=max_rejected,
        unposed={row_of[found.names[row]]: reason for row, reason in why_not.items()},
        unreadable=found.unreadable,
    )


def _read_all(
    folder: Path,
    gps_sigma_m: float,
    vertical: str | None,
    anchor: tuple[float, float, float] | None,
    max_rejected: float,
    progress: Progress,
    tell: Callable[[str], None] | None,
    *,
    is_whole: bool,
) -> _Found:
    """Read all pictures; panoramas that are cut, and what may be one, cannot be used unless somebody says what all are.

    Of pictures that a phone keeps both as HEIC and as JPEG the latter count.
    """
    check_folder(folder, _EXPECTED)
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (*_SUFFIXES, *_NOT_READ))
    paths = [path for path in files if path.suffix.lower() in _SUFFIXES]
    if not files:
        raise InputError(f"{folder}: there are no pictures in it", hint=f"expected {_EXPECTED}")
    names, found = [], []
    twins = {path.with_suffix("") for path in paths}
    unreadable: dict[str, str] = {
        path.relative_to(folder).as_posix(): _HEIC
        for path in files
        if path.suffix.lower() in _NOT_READ and path.with_suffix("") not in twins
    }
    for number, path in enumerate(paths):
        if number % 50 == 0:
            progress("reading the pictures' tags", number, len(paths))
        name = path.relative_to(folder).as_posix()
        try:
            exif = read_exif(file_in(folder, name, _EXPECTED))
            check_whole(path)
        except InputError as error:
            unreadable[name] = str(error).removeprefix(f"{path}: ")
        else:
            if (exif.is_cut or exif.may_be_panorama) and not is_whole:
                unreadable[name] = CUT_PANORAMA if exif.is_cut else _MAY_BE_PANORAMA
                continue
            found.append(exif)
            names.append(name)
    progress("reading the pictures' tags", len(paths), len(paths))
    total = len(names) + len(unreadable)
    refuse_too_many_unreadable(unreadable, total, max_rejected, str(folder), "remove or replace them")
    check_names(names, str(folder))
    passes = [str(parent) if str(parent := PurePosixPath(name).parent) != "." else ONE_PASS for name in names]
    # Driving order: by time where a whole folder has times, else by name.
    times = _times(found, passes)
    timed = set(passes) - {each for each, time_s in zip(passes, times, strict=True) if math.isnan(time_s)}
    order = sorted(
        range(len(names)), key=lambda row: (passes[row], times[row] if passes[row] in timed else 0.0, names[row])
    )
    names, found, times, passes = ([values[row] for row in order] for values in (names, found, times, passes))  # type: ignore[assignment]
    lon_lat = np.array([(math.nan, math.nan) if e.lat_lon is None else (e.lat_lon[1], e.lat_lon[0]) for e in found])
    if not np.isfinite(lon_lat).any():
        raise InputError(
            f"{folder}: none of {len(names)} pictures has a GPS position in its EXIF tags",
            hint="were they exported without tags? For poses of your own see import csv and import colmap",
        )
    place = np.column_stack([lon_lat, _heights(found, lon_lat, vertical)])
    placed = place_on_earth(place, anchor, names, source=str(folder), tell=tell)
    sigma = np.array([exif.sigma_m or gps_sigma_m for exif in found])
    return _Found(list(names), list(found), list(times), list(passes), placed, sigma, unreadable)


def _times(found: Sequence[Exif], passes: Sequence[str]) -> list[float]:
    """Return seconds (N) of the GPS's clock, else of the camera's, NaN where there are none.

    What the clock of the camera is off by, its zone too, is the median of the pictures of a pass that have both.
    """
    off_s = defaultdict(list)
    for exif, name in zip(found, passes, strict=True):
        if exif.gps_time_s is not None and exif.camera_time_s is not None:
            off_s[name].append(exif.gps_time_s - exif.camera_time_s)
    median_s = {name: float(np.median(each)) for name, each in off_s.items()}
    times = []
    for exif, name in zip(found, passes, strict=True):
        by_camera_s = math.nan if exif.camera_time_s is None else exif.camera_time_s + median_s.get(name, 0.0)
        times.append(by_camera_s if exif.gps_time_s is None else exif.gps_time_s)
    return times


def _heights(found: Sequence[Exif], lon_lat: Floats, vertical: str | None) -> Floats:
    """Return heights (N) at places (N, 2); pictures without one are at the median of the others, or at 0."""
    heights = np.array([math.nan if exif.height_m is None else exif.height_m for exif in found])
    is_above_sea = np.array([not exif.is_ellipsoidal for exif in found])
    if np.isnan(heights).all():
        heights, is_above_sea = np.zeros(len(found)), np.ones(len(found), dtype=np.bool_)
    system, zero_m = with_heights(None, vertical)
    rows = is_above_sea & np.isfinite(heights) & np.isfinite(lon_lat).all(axis=1)
    if system is not None and rows.any():
        place = np.column_stack([lon_lat, heights + zero_m])[rows]
        heights[rows] = lon_lat_height_from_crs(place, system)[:, 2]
    return np.where(np.isnan(heights), np.nanmedian(heights), heights)


def _level_poses(found: _Found) -> tuple[Floats, Floats]:
    """Return rotations (N, 3, 3) by headings and centres (N, 3), NaN where there is no heading."""
    heading, pitch, roll = (
        np.radians([math.nan if (v := getattr(exif, name)) is None else v for exif in found.exif])
        for name in ("heading_deg", "pitch_deg", "roll_deg")
    )
    known = np.isfinite(heading)
    rotation = np.full((len(heading), 3, 3), np.nan)
    if known.any():
        rotation[known] = found.placed.world_from_local[known] @ local_from_cam(
            heading[known], pitch[known], roll[known]
        )
    return rotation, found.placed.position_in_world_m.copy()


def _told_twice(found: _Found, by_heading: Bools) -> int:
    """Return how many of the pictures with a heading, of those chosen (N), have another one elsewhere in their tags."""
    apart_deg = [
        abs((exif.heading_deg - exif.pose_heading_deg + 180.0) % 360.0 - 180.0)
        for exif, chosen in zip(found.exif, by_heading.tolist(), strict=True)
        if chosen and exif.heading_deg is not None and exif.pose_heading_deg is not None
    ]
    return sum(apart > _SAME_HEADING_DEG for apart in apart_deg)


def _guess(exif: Exif) -> Camera:
    width, height = exif.width, exif.height
    if exif.is_panorama:
        return Camera("EQUIRECTANGULAR", width, height, (float(width), float(height)))
    focal = exif.focal_px or _FOCAL_GUESS * max(width, height)
    return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2.0, height / 2.0, 0.0))


def _told(posed: Posed, total: int) -> Iterator[str]:
    """Yield what is worth knowing about poses that were found."""
    yield f"structure from motion found the poses of {len(posed.row)} of {total} pictures"
    parts = len(set(posed.part.tolist()))
    if parts > 1:
        yield (
            f"they are in {parts} parts that only the GPS holds together, each a pass of its own; "
            "their sigmas are those on the Earth"
        )
    else:
        yield (
            f"together they stand on the Earth to {posed.on_earth_m:.2f} m on each axis, "
            "which position_sigma_m leaves out"
        )


def _picture(folder: Path, found: _Found, row: int, camera: int) -> Picture:
    return Picture(
        name=found.names[row],
        path=folder / found.names[row],
        camera=camera,
        gps_in_world_m=found.placed.position_in_world_m[row],
        sigma_m=float(found.sigma_m[row]),
        drive=found.passes[row],
    )
