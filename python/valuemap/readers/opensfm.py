"""OpenSfM: reconstruction.json with cameras, shots and the place of the origin."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.errors import InputError, SettingError
from valuemap.geodesy import crs_from_lon_lat_height, true_axes_of_crs
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import file_in, read_json
from valuemap.readers.json_values import Json
from valuemap.readers.opensfm_cameras import opensfm_camera
from valuemap.readers.poses import make_images
from valuemap.readers.reader import Reader

_EXPECTED = "OpenSfM's reconstruction.json: a list of reconstructions with cameras and shots"
_REFERENCE = "reference_lla.json"
_RECONSTRUCTION, _TOPOCENTRIC = "reconstruction.json", "reconstruction.topocentric.json"
"""OpenDroneMap gives what OpenSfM wrote the second name, and the first to the same in a map projection."""


@Reader
def read_opensfm(
    reconstruction: Path,
    *,
    detections: DetectionFile | Path | None = None,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read all reconstructions of a file, whose origin is `reference_lla` in it or in the file of that name beside it.

    Rotations are axis-angle, world to camera. Lengths are fractions of the larger side of the picture about its middle,
    and become pixels with the centre of the top-left one at 0.5. A pass is the sequence of a shot (`skey`), else the
    folder of its name; separate reconstructions share no pass. Rig instances are rigs. Nothing is asked of cameras
    without shots.

    Parameters
    ----------
    reconstruction
        The file, or the folder with it. In a folder of OpenDroneMap it is `reconstruction.topocentric.json`.
    detections
        As in `read_detections`.
    up, anchor, max_rejected
        As in `assemble`, for models without a reference.
    tell
        Called where the cameras are turned against their GPS as a map projection is.

    Raises
    ------
    InputError
        A file is missing, damaged, of another format or in OpenDroneMap's map projection, or a camera is of a type that
        COLMAP's models do not have.
    SettingError
        `anchor` or `up` contradicts the reference of the file.
    """
    progress("reading the reconstruction", 0, 2)
    path = _file(reconstruction)
    content = Json(read_json(path, _EXPECTED), str(path), f"expected {_EXPECTED}")
    parts = list(content.entries())
    names, passes, rigs, time, rotation, translation, camera_of, gps_m = [], [], [], [], [], [], [], []
    for number, part in enumerate(parts):
        listed = dict(part["cameras"].items())
        cameras_here: dict[str, Camera] = {}  # Of those with shots alone: all of a project are listed.
        rig_of = _rigs(part, number)
        for name, shot in part["shots"].items():
            key = shot["camera"].text()
            if key not in listed:
                raise shot["camera"].wrong("expected one of cameras")
            if key not in cameras_here:
                cameras_here[key] = opensfm_camera(listed[key])
            names.append(name)
            camera_of.append(cameras_here[key])
            rotation.append(shot["rotation"].known_numbers(3))
            translation.append(shot["translation"].known_numbers(3))
            gps_m.append(_gps_m(shot))
            seconds = shot["capture_time"].number() if "capture_time" in shot else 0.0
            time.append(seconds or np.nan)  # It writes 0 for pictures without a date.
            folder = str(PurePosixPath(name).parent)
            sequence = shot["skey"].text() if "skey" in shot else (folder if folder != "." else ONE_PASS)
            passes.append(f"{number}/{sequence}" if len(parts) > 1 else sequence)
            rigs.append(rig_of.get(name, f"{number}/{name}"))
    reference = _reference(parts, path, tell)
    if reference is not None and (anchor is not None or up is not None):
        raise SettingError(
            f"anchor and up: {path} says where it is: {reference[0]:g} {reference[1]:g} {reference[2]:g}",
            hint="leave them away",
        )
    if not names:
        raise InputError(f"{path}: there are no shots in it", hint="did the reconstruction succeed?")
    cameras, camera_id = make_cameras(camera_of, str(path))
    cam_from_world = Rotation.from_rotvec(np.array(rotation))
    center_m: Floats = -cam_from_world.inv().apply(np.array(translation))
    if (
        tell is not None
        and reference is not None
        and (turn_deg := _turn_of_grid_deg(center_m, np.array(gps_m), reference))
    ):
        tell(
            f"{path}: cameras are turned by {turn_deg:.2f} degrees against their GPS, as the grid of UTM is there: it "
            "may be OpenDroneMap's in a map projection, of which positions and directions are wrong; give "
            f"{_TOPOCENTRIC}, or import opendronemap its shots.geojson"
        )
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=cam_from_world.inv().as_matrix(),
        center_in_world_m=center_m,
        passes=passes,
        source=str(path),
        timestamp_s=np.array(time),
        rigs=rigs,
    )
    progress("reading the detections", 1, 2)
    dataset = assemble(
        name=path.resolve().parent.name,
        cameras=cameras,
        images=images,
        detections=read_detections(detections, images, cameras),
        up=up,
        anchor=reference or anchor,
        is_on_earth=reference is not None,
        source=str(path),
        max_rejected=max_rejected,
    )
    progress("reading the detections", 2, 2)
    return dataset


def _file(reconstruction: Path) -> Path:
    """Return the file to read; refuse those of OpenDroneMap that are in a map projection but name OpenSfM's origin."""
    is_folder = reconstruction.is_dir()
    folder = reconstruction if is_folder else reconstruction.parent
    if is_folder and (folder / _TOPOCENTRIC).is_file():
        return folder / _TOPOCENTRIC
    path = folder / _RECONSTRUCTION if is_folder else reconstruction
    for place in (folder, folder.parent):  # Undistorted pictures have a folder of their own in it.
        if path.name == _RECONSTRUCTION and (place / _TOPOCENTRIC).is_file():
            raise InputError(
                f"{path}: is in OpenDroneMap's map projection, as {place / _TOPOCENTRIC} tells",
                hint=f"give {place / _TOPOCENTRIC}, which is the same in metres east, north and up",
            )
    return path


def _rigs(part: Json, number: int) -> dict[str, str]:
    """Return the rig instance of each shot that is in one."""
    found = {}
    if "rig_instances" in part:
        for key, instance in part["rig_instances"].items():
            for name in instance["rig_camera_ids"].object():
                found[name] = f"{number}/instance/{key}"
    return found


def _reference(parts: list[Json], path: Path, tell: Callable[[str], None] | None) -> tuple[float, float, float] | None:
    """Return latitude, longitude and altitude of the origin, which all reconstructions share."""
    places = [_origin(part["reference_lla"]) for part in parts if "reference_lla" in part]
    if (path.parent / _REFERENCE).is_file():
        beside = file_in(path.parent, _REFERENCE, "the place of the origin")
        place = _origin(Json(read_json(beside, "latitude, longitude, altitude"), str(beside)))
        if tell is not None and places and place != places[0]:
            tell(
                f"{path}: its origin (reference_lla) is {_shown(places[0])}, which is used; "
                f"{beside.name} beside it says {_shown(place)}"
            )
        places = places or [place]
    if len(set(places)) > 1:
        raise InputError(
            f"{path}: its {len(parts)} reconstructions have different origins (reference_lla)",
            hint="import them one by one",
        )
    return places[0] if places else None


def _origin(place: Json) -> tuple[float, float, float]:
    return place["latitude"].number(), place["longitude"].number(), place["altitude"].number()


def _shown(place: tuple[float, float, float]) -> str:
    return " ".join(f"{each:.9g}" for each in place)


def _gps_m(shot: Json) -> Floats:
    """Return where the GPS of a picture is, NaN where it says no such thing: no pose needs it."""
    try:
        return shot["gps_position"].numbers(3)
    except InputError:
        return np.full(3, np.nan)


def _turn_of_grid_deg(center_m: Floats, gps_m: Floats, reference: tuple[float, float, float]) -> float | None:
    """Return how far the grid of UTM is turned at the origin, where cameras (N, 3) are turned as far; else None.

    OpenSfM turns a model so that its cameras fit their GPS, both in east, north, up. OpenDroneMap turns the model on
    into the grid, and leaves the GPS as it was.
    """
    lat, lon, _ = reference
    known = np.isfinite(gps_m).all(axis=1) & np.isfinite(center_m).all(axis=1)
    if known.sum() < _FEWEST_CAMERAS or not (abs(lat) <= _POLAR_DEG and abs(lon) <= 180.0):
        return None
    crs = f"EPSG:{326 if lat >= 0.0 else 327}{int((lon + 180.0) // 6.0) % 60 + 1:02d}"
    origin = crs_from_lon_lat_height(np.array([[lon, lat, 0.0]]), crs)
    grid_north = true_axes_of_crs(origin, crs)[0, :, 1]
    grid_rad = float(np.arctan2(grid_north[0], grid_north[1]))
    here, gps = (complex_m - complex_m.mean() for complex_m in (_level(center_m[known]), _level(gps_m[known])))
    turn_rad = float(np.angle(np.vdot(gps, here)))
    spread_m = float(np.linalg.norm(gps))
    if not spread_m > 0.0:
        return None
    left_m = float(np.linalg.norm(here - gps * np.exp(1j * turn_rad)))
    sigma_rad = left_m / spread_m / np.sqrt(2.0 * len(gps) - 3.0)
    is_grid = abs(turn_rad - grid_rad) < abs(grid_rad) / 3.0 and abs(turn_rad) > _SURE_SIGMAS * sigma_rad
    return float(np.degrees(grid_rad)) if is_grid else None


def _level(position_m: Floats) -> NDArray[np.complex128]:
    """Return east and north (N, 3) as complex numbers."""
    level: NDArray[np.complex128] = position_m[:, 0] + 1j * position_m[:, 1]
    return level


_FEWEST_CAMERAS = 5
_POLAR_DEG = 84.0
"""UTM ends there."""
_SURE_SIGMAS = 5.0
