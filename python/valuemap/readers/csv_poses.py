"""Images and poses in a table of the user's own, with columns that say what they are."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.dataset import LONGEST_READOUT_S
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported, assemble, refuse_plane
from valuemap.readers.cameras_of import Camera, make_cameras, parse_camera
from valuemap.readers.csv_file import CsvFile
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.pixel_center import shift_to_corner_px
from valuemap.readers.poses import (
    AXES,
    Placed,
    height_where_none,
    local_from_cam,
    make_images,
    place_in_crs,
    place_on_earth,
    rotations_of_quaternions,
    seconds_of_unit,
)
from valuemap.readers.radians import as_small_as_radians, tell_radians
from valuemap.readers.reader import Reader

_EXPECTED = (
    "a CSV file with columns image; lat, lon or x, y; and heading_deg, yaw_rad, omega_deg, phi_deg, kappa_deg or "
    "qw, qx, qy, qz"
)
_QUATERNION = ("qw", "qx", "qy", "qz")
_TEXTS = ("image", "pass", "rig", "timestamp", "model", "params")
_NUMBERS = (
    *("lat", "lon", "height", "x", "y", "z", "qw", "qx", "qy", "qz", "pitch_deg", "roll_deg"),
    *("omega_deg", "phi_deg", "kappa_deg"),
    *("heading_deg", "heading_rad", "yaw_deg", "yaw_rad", "width_px", "height_px", "fx", "fy", "cx", "cy"),
    *("position_sigma_m", "rotation_sigma_deg", "readout_s"),
)
_SKY = (0.0, 0.0, 1.0)
"""Up where orientations are angles: these are about the horizon, however cameras are turned."""
_HEADINGS = ("heading_deg", "heading_rad", "yaw_deg", "yaw_rad")
_OMEGA_PHI_KAPPA = ("omega_deg", "phi_deg", "kappa_deg")
_UP_IN_THE_SKY_DEG = 60.0
_MOST_DEG = 36_000.0
"""A hundred turns, as of a heading that nobody wrapped: numbers beyond are no angles."""
_LATEST_S = 1e10
"""In the year 2286: 20231114221320 is a date without marks, not a number of milliseconds."""
_EXIF_DATE = re.compile(r"^(\d{4}):(\d\d):(\d\d)(?=\s)")
"""As ExifTool writes it."""
_NO_DEGREES = "write decimal degrees, as 52.5123 or -0.1276, without letters and signs"
_NO_METRES = "write metres as plain numbers, as 1234.5"
_NO_HEIGHT = "write metres as plain numbers, or remove the column and give --camera-height"
_NO_NUMBER = "write plain numbers, or remove the column if nothing of it is known"


@Reader
def read_csv_poses(
    poses: Path,
    *,
    detections: DetectionFile | Path | None = None,
    camera: str | None = None,
    columns: Mapping[str, str] | None = None,
    rotation: str = "cam_from_world",
    axes: str = "right-down-forward",
    pixel_center: float = 0.5,
    camera_height_m: float = 0.0,
    crs: str | None = None,
    vertical: str | None = None,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read a table with one row an image.

    Columns: `image` (name); a place, `lat, lon` in degrees or `x, y`, with `height` or `z`; an orientation; and as far
    as known a camera, `pass`, `timestamp` (as in `seconds_of_unit`, or a date of ISO 8601 or EXIF, in UTC without a
    zone), `rig` (equal for images taken at one time by one car), `position_sigma_m`, `rotation_sigma_deg` and
    `readout_s` of the camera.

    An orientation is a quaternion `qw, qx, qy, qz`; or `omega_deg, phi_deg, kappa_deg`, the angles of photogrammetry,
    which turn x (right), y (up in the picture), z (back) into the axes of the positions, about x, then the new y, then
    the new z; or one of `heading_deg`, `heading_rad` (clockwise from north) and `yaw_deg`, `yaw_rad` (counter-clockwise
    from east) of the middle of the picture, with `pitch_deg` (up) and `roll_deg` (right side down), which are 0 for
    level cameras. A camera is `width_px, height_px` with `model, params` (numbers with spaces between), or with
    `fx, cx, cy` and maybe `fy`; else it is `camera` for all.

    Parameters
    ----------
    poses
        The table.
    detections
        As in `read_detections`.
    camera
        The camera of all images, as in `parse_camera`, where the table has none.
    columns
        Under which name a column stands in the table, where it is another one.
    rotation
        What a quaternion does, "cam_from_world" or "world_from_cam". The world of a quaternion is the frame of
        `x, y, z`; with `lat, lon` it is east, north, up at the image.
    axes
        The axes of the camera that a quaternion is about, one of `AXES`.
    pixel_center
        Coordinates of the centre of the top-left pixel in `cx, cy`: 0.5 or 0.
    camera_height_m
        Height of all images where the table has none.
    crs
        The reference system of `x, y`, e.g. EPSG:32610: easting, northing. Without, they are metres in their own frame.
    vertical
        What the heights of `lat, lon` or `crs` count from, as in `with_heights`; without, the ellipsoid.
    up, anchor, max_rejected
        As in `assemble`, but that up is z where orientations are angles. With `lat, lon` or `crs` the anchor is the
        origin, by default the place of the first image by name that is about where most are.
    tell
        Called with each line that is worth knowing about the positions and angles.

    Raises
    ------
    InputError
        A file is missing, damaged or inconsistent.
    SettingError
        An option is impossible, or does not go with the columns.
    """
    if rotation not in ("cam_from_world", "world_from_cam") or axes not in AXES:
        raise SettingError(
            f"rotation {rotation}, axes {axes}: expected cam_from_world or world_from_cam, and {' or '.join(AXES)}",
            hint="leave them away for COLMAP's convention",
        )
    progress("reading the poses", 0, 2)
    table = CsvFile(poses, _EXPECTED, texts=_TEXTS, numbers=_NUMBERS, columns=columns)
    names = table.filled_texts("image")
    where = _place(table, names, crs, vertical, anchor, up, camera_height_m, tell)
    cameras, camera_id = make_cameras(_with_readout(table, _cameras(table, camera, pixel_center)), str(poses))
    turned = _turned(table, rotation, axes, tell)
    make = partial(
        make_images,
        names=names,
        camera_id=camera_id,
        center_in_world_m=where.position_in_world_m,
        passes=table.filled_texts("pass", may_be_left_away=True) if table.has("pass") else [ONE_PASS] * len(table),
        source=str(poses),
        timestamp_s=_timestamps(table) if table.has("timestamp") else None,
        rigs=table.filled_texts("rig", may_be_left_away=True) if table.has("rig") else None,
        position_sigma_m=_sigma(table, "position_sigma_m"),
        rotation_sigma_rad=_radians(_sigma(table, "rotation_sigma_deg")),
    )
    images = make(world_from_cam=where.world_from_local @ turned.local_from_cam)
    if tell is not None and turned.angle_deg is not None:
        others = None if turned.if_radians is None else make(world_from_cam=where.world_from_local @ turned.if_radians)
        tell_radians(turned.name, turned.angle_deg, tell, images=None if others is None else (images, others))
    progress("reading the detections", 1, 2)
    has_angles = not table.has(*_QUATERNION)
    dataset = assemble(
        name=poses.stem,
        cameras=cameras,
        images=images,
        detections=read_detections(detections, images, cameras),
        up=_SKY if has_angles and up is None and where.anchor is None else up,
        anchor=where.anchor,
        is_on_earth=has_angles,
        source=str(poses),
        max_rejected=max_rejected,
    )
    progress("reading the detections", 2, 2)
    return dataset


def _place(
    table: CsvFile,
    names: list[str],
    crs: str | None,
    vertical: str | None,
    anchor: tuple[float, float, float] | None,
    up: tuple[float, float, float] | None,
    camera_height_m: float,
    tell: Callable[[str], None] | None,
) -> Placed:
    level = np.full(len(table), height_where_none(camera_height_m))
    source = str(table.path)
    if table.has("lat", "lon"):
        if crs is not None or up is not None:
            raise SettingError(
                "crs and up: do not go with columns lat, lon", hint="leave them away: lat, lon are WGS84"
            )
        # A z beside x and y is of their frame.
        heights = ("height",) if table.has("x", "y") else ("height", "z")
        height = next((table.some_numbers(name, _NO_HEIGHT) for name in heights if table.has(name)), level)
        place = np.stack([table.some_numbers(name, _NO_DEGREES) for name in ("lon", "lat")] + [height], axis=1)
        if vertical is None:
            return place_on_earth(place, anchor, names, source=source, tell=tell)
        return place_in_crs(place, "EPSG:4326", anchor, names, vertical=vertical, source=source, tell=tell)
    if not table.has("x", "y"):
        raise table.missing("lat, lon or x, y")
    height = next((table.some_numbers(name, _NO_HEIGHT) for name in ("z", "height") if table.has(name)), level)
    position = np.stack([table.some_numbers(name, _NO_METRES) for name in ("x", "y")] + [height], axis=1)
    if crs is not None:
        if up is not None:
            raise SettingError("up: does not go with crs", hint="leave it away: heights are along z")
        return place_in_crs(position, crs, anchor, names, vertical=vertical, source=source, tell=tell)
    if vertical is not None:
        raise SettingError(
            f"vertical {vertical}: does not go with x, y in a frame of their own", hint="give --crs, or leave it away"
        )
    if anchor is not None:
        refuse_plane(position, source)
    return Placed(position, np.broadcast_to(np.eye(3), (len(table), 3, 3)), anchor)


@dataclass(frozen=True, eq=False)
class _Turned:
    """Rotations (N, 3, 3) from camera axes into the frame of the positions, or east, north, up at the image.

    Where angles in degrees say it, `name` and `angle_deg` (N) are those that go all the way round. Where these are as
    small as radians, `if_radians` are the rotations (N, 3, 3) if they are.
    """

    local_from_cam: Floats
    name: str = ""
    angle_deg: Floats | None = None
    if_radians: Floats | None = None


def _turned(table: CsvFile, rotation: str, axes: str, tell: Callable[[str], None] | None) -> _Turned:
    headings = [name for name in _HEADINGS if table.has(name)]
    ways = [
        *(["a quaternion"] if table.has(*_QUATERNION) else []),
        *(["omega, phi, kappa"] if table.has(*_OMEGA_PHI_KAPPA) else []),
        *headings[:1],
    ]
    if len(ways) > 1:
        raise InputError(f"{table.path}: has both {ways[0]} and {ways[1]}", hint="remove the columns that do not count")
    if table.has(*_OMEGA_PHI_KAPPA):
        angles = np.stack([_degrees(table, name) for name in _OMEGA_PHI_KAPPA], axis=1)
        if_radians = _of_photogrammetry(np.degrees(angles)) if as_small_as_radians(angles) else None
        return _Turned(_of_photogrammetry(angles), "kappa_deg", angles[:, 2], if_radians)
    if table.has(*_QUATERNION):
        quaternion = np.stack([table.some_numbers(name, _NO_NUMBER) for name in _QUATERNION], axis=1)
        matrix = rotations_of_quaternions(quaternion)
        local_from_axes = matrix if rotation == "world_from_cam" else matrix.transpose(0, 2, 1)
        return _Turned(local_from_axes @ AXES[axes])
    if len(headings) != 1:
        raise table.missing(
            f"one of {', '.join(_HEADINGS)}, or {', '.join(_OMEGA_PHI_KAPPA)}, or {', '.join(_QUATERNION)}"
        )
    pitch, roll = (
        np.radians(_degrees(table, name)) if table.has(name) else np.zeros(len(table))
        for name in ("pitch_deg", "roll_deg")
    )
    pitch_deg = float(np.degrees(np.nanmedian(pitch)))
    if tell is not None and pitch_deg > _UP_IN_THE_SKY_DEG:
        tell(
            f"pitch_deg: cameras look {pitch_deg:.0f} degrees above the horizon; Metashape and Pix4D count from below, "
            "so that 90 is level: take 90 away, or give their omega, phi, kappa"
        )
    name = headings[0]
    if name.endswith("_rad"):
        angle_rad = table.some_numbers(name, _NO_NUMBER)
        if np.nanmax(np.abs(angle_rad), initial=0.0) > 4.0 * math.pi:
            raise InputError(
                f"{table.path}: {name}: expected radians, found {np.nanmax(np.abs(angle_rad)):g}",
                hint=f"are these degrees? Then --column {name[:-4]}_deg={name}",
            )
        return _Turned(local_from_cam(_heading_rad(name, angle_rad), pitch, roll))
    angle = _degrees(table, name)
    if_radians = local_from_cam(_heading_rad(name, angle), pitch, roll) if as_small_as_radians(angle) else None
    return _Turned(local_from_cam(_heading_rad(name, np.radians(angle)), pitch, roll), name, angle, if_radians)


def _degrees(table: CsvFile, name: str) -> Floats:
    """Return a column of angles (N) in degrees, NaN where there is none."""
    angle = table.some_numbers(name, _NO_NUMBER)
    table.refuse(np.isfinite(angle) & (np.abs(angle) > _MOST_DEG), name, f"degrees, at most {_MOST_DEG:g}")
    return np.where(np.isfinite(angle), angle, np.nan)


def _heading_rad(name: str, angle_rad: Floats) -> Floats:
    """Return angles (N) clockwise from north of those that a column has."""
    return angle_rad if name.startswith("heading") else math.pi / 2.0 - angle_rad


def _of_photogrammetry(angle_deg: Floats) -> Floats:
    """Return the rotations (N, 3, 3) of omega, phi, kappa (N, 3)."""
    local_from_photo: Floats = Rotation.from_euler("XYZ", angle_deg, degrees=True).as_matrix() @ AXES["right-up-back"]
    return local_from_photo


def _cameras(table: CsvFile, camera: str | None, pixel_center: float) -> list[Camera]:
    shift_px = shift_to_corner_px(pixel_center, "pixel-center")
    if table.has("model", "width_px", "height_px", "params"):
        sizes = zip(table.whole_numbers("width_px"), table.whole_numbers("height_px"), strict=True)
        parts = zip(table.filled_texts("model"), sizes, table.texts("params"), strict=True)
        joined = [f"{model} {width} {height} {table.with_points(params)}" for model, (width, height), params in parts]
        parsed: dict[str, Camera] = {}
        for row, text in enumerate(joined):
            if text not in parsed:
                try:
                    parsed[text] = parse_camera(text, pixel_center)
                except SettingError as error:
                    raise InputError(f"{table.line(row)}: {error}", hint=error.hint) from error
        return [parsed[text] for text in joined]
    if table.has("width_px", "height_px", "fx", "cx", "cy"):
        fx, cx, cy = (table.finite_numbers(name) for name in ("fx", "cx", "cy"))
        fy = table.finite_numbers("fy") if table.has("fy") else fx
        params = np.stack([fx, fy, cx + shift_px, cy + shift_px], axis=1).tolist()
        sizes = zip(table.whole_numbers("width_px"), table.whole_numbers("height_px"), strict=True)
        return [Camera("PINHOLE", *size, tuple(values)) for size, values in zip(sizes, params, strict=True)]
    if camera is None:
        raise table.missing(
            "width_px, height_px and fx, cx, cy or model, params, where no camera is given for all images"
        )
    return [parse_camera(camera, pixel_center)] * len(table)


def _with_readout(table: CsvFile, cameras: list[Camera]) -> list[Camera]:
    """Return the cameras (N) with the readout times that the table has for them."""
    readout_s = _optional(table, "readout_s")
    if readout_s is None:
        return cameras
    table.refuse(np.abs(readout_s) > LONGEST_READOUT_S, "readout_s", f"at most {LONGEST_READOUT_S:g} s, or no value")
    known = [None if math.isnan(seconds) else seconds for seconds in readout_s.tolist()]
    return [replace(camera, readout_s=seconds) for camera, seconds in zip(cameras, known, strict=True)]


def _timestamps(table: CsvFile) -> Floats:
    """Return seconds (N) since 1970; empty fields are NaN.

    Dates with and without a zone in one column are of two clocks, of which nobody can tell how they differ.
    """
    seconds = np.full(len(table), math.nan)
    has_zone: bool | None = None
    for row, text in enumerate(table.texts("timestamp")):
        if not text:
            continue
        seconds[row], zoned = _seconds(text, table, row)
        if zoned is not None and has_zone not in (None, zoned):
            expected, found = ("a", "none") if has_zone else ("no", "one")
            raise InputError(
                f"{table.line(row)}: timestamp: expected {expected} zone as in the rows before, found {found}: "
                f"{text[:40]!r}",
                hint="give all times with a zone, as 2023-11-14T22:13:20Z or +01:00, or all without, which are UTC",
            )
        has_zone = has_zone if zoned is None else zoned
    return seconds


def _seconds(text: str, table: CsvFile, row: int) -> tuple[float, bool | None]:
    """Return seconds since 1970, and if a date has a zone; None where it is no date."""
    try:
        seconds = float(table.with_points(text))
    except ValueError:
        try:
            time = datetime.fromisoformat(_EXIF_DATE.sub(r"\1-\2-\3", text))
        except ValueError as error:
            raise _no_time(text, table, row) from error
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp(), time.tzinfo is not None
    if not math.isfinite(seconds):
        raise InputError(
            f"{table.line(row)}: timestamp: expected a finite number", hint="leave it empty where not known"
        )
    seconds *= seconds_of_unit(seconds)
    if seconds > _LATEST_S:
        raise _no_time(text, table, row)
    return seconds, None


def _no_time(text: str, table: CsvFile, row: int) -> InputError:
    return InputError(
        f"{table.line(row)}: timestamp: expected seconds or an ISO 8601 time, found {text[:40]!r}",
        hint="for example 1700000000.25 or 2023-11-14T22:13:20.25Z",
    )


def _optional(table: CsvFile, name: str) -> Floats | None:
    return table.numbers_or_none(name) if table.has(name) else None


def _sigma(table: CsvFile, name: str) -> Floats | None:
    values = _optional(table, name)
    if values is not None:
        table.refuse((values <= 0.0) | np.isinf(values), name, "above 0, or no value")
    return values


def _radians(degrees: Floats | None) -> Floats | None:
    return None if degrees is None else np.radians(degrees)
