"""OpenDroneMap: shots.geojson with the poses of a finished project, and the lenses in cameras.json."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.errors import InputError
from valuemap.geodesy import crs_from_lon_lat_height
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import check_file, file_in, read_json
from valuemap.readers.json_values import Json
from valuemap.readers.opensfm_cameras import opensfm_camera
from valuemap.readers.poses import make_images, place_in_crs
from valuemap.readers.reader import Reader

_EXPECTED = "OpenDroneMap's odm_report/shots.geojson: features with filename, translation, rotation and coordinates"
_SHOTS, _REPORT, _CAMERAS = "shots.geojson", "odm_report", "cameras.json"
_SAME_PLACE_M = 1.0
"""Between coordinates and translation, which are one place in two systems."""


@Reader
def read_opendronemap(
    project: Path,
    *,
    detections: DetectionFile | Path | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read the poses of the original pictures of a project.

    `translation` is the place of a camera in UTM, in the zone where that is the place of the `coordinates`, and
    `rotation` axis-angle from the axes of that grid into the camera. The camera is that of `cameras.json` with the name
    (`camera`), else with the focal length and size of the shot; where there is none, it is a pinhole of that focal
    length. A pass is the folder of a name.

    Parameters
    ----------
    project
        The file, its folder, or the folder of the project; `cameras.json` is beside the file or in the folder above.
    detections
        As in `read_detections`.
    anchor
        Latitude, longitude and height of the origin; by default the place of the first image by name that is
        about where most are.
    tell
        Called with each line that is worth knowing about lenses and shots.

    Raises
    ------
    InputError
        A file is missing, damaged or of another format, places are not in UTM, or a camera is of a type that COLMAP's
        models do not have.
    """
    progress("reading the shots", 0, 2)
    path = _file(project)
    content = Json(read_json(path, _EXPECTED), str(path), f"expected {_EXPECTED}")
    shots: dict[str, Json] = {}
    told_twice = 0
    for feature in content["features"].entries():
        name = feature["properties"]["filename"].text()
        told_twice += name in shots
        shots.setdefault(name, feature)
    if not shots:
        raise InputError(f"{path}: there are no shots in it", hint="did the reconstruction succeed?")
    names = list(shots)
    said = [shot["properties"] for shot in shots.values()]
    lenses = _Lenses(path)
    camera_of = [lenses.of(shot) for shot in said]
    lon_lat_height = np.array([shot["geometry"]["coordinates"].numbers(3) for shot in shots.values()])
    center_in_grid_m = np.array([shot["translation"].numbers(3) for shot in said])
    crs = _zone(lon_lat_height, center_in_grid_m, path)
    placed = place_in_crs(center_in_grid_m, crs, anchor, names, source=str(path), tell=tell)
    grid_from_cam = Rotation.from_rotvec(np.array([shot["rotation"].numbers(3) for shot in said])).inv().as_matrix()
    seconds = [shot["capture_time"].number() if "capture_time" in shot else 0.0 for shot in said]
    folders = [str(PurePosixPath(name).parent) for name in names]
    cameras, camera_id = make_cameras(camera_of, str(path))
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=placed.world_from_local @ grid_from_cam,
        center_in_world_m=placed.position_in_world_m,
        passes=[folder if folder != "." else ONE_PASS for folder in folders],
        source=str(path),
        timestamp_s=np.array([time or np.nan for time in seconds]),  # It writes 0 for pictures without a date.
    )
    if tell is not None:
        for line in lenses.told():
            tell(line)
        if told_twice:
            tell(
                f"{told_twice} shots are there again, from parts of a project that overlap: the first of a name counts"
            )
    progress("reading the detections", 1, 2)
    dataset = assemble(
        name=path.resolve().parent.name,
        cameras=cameras,
        images=images,
        detections=read_detections(detections, images, cameras),
        up=None,
        anchor=placed.anchor,
        is_on_earth=True,
        source=str(path),
        max_rejected=max_rejected,
    )
    progress("reading the detections", 2, 2)
    return dataset


def _file(project: Path) -> Path:
    if not project.is_dir():
        return check_file(project, _EXPECTED)
    folder = project / _REPORT if (project / _REPORT).is_dir() else project
    return file_in(folder, _SHOTS, _EXPECTED)


class _Lenses:
    """The cameras of a project, and for how many shots there is none among them."""

    def __init__(self, shots: Path) -> None:
        folder = shots.resolve().parent
        self._path = next((each / _CAMERAS for each in (folder, folder.parent) if (each / _CAMERAS).exists()), None)
        self._shots, self._without = shots, 0
        self._known: dict[str, Json] = {}
        if self._path is not None:
            content = Json(read_json(self._path, "OpenDroneMap's cameras"), str(self._path))
            self._known = {_bare(name): camera for name, camera in content.items()}

    def of(self, shot: Json) -> Camera:
        """Return the camera of a shot."""
        known = self._named(shot) or self._alike(shot)
        if known is not None:
            return opensfm_camera(known)
        self._without += 1
        width, height, focal = shot["width"].whole(), shot["height"].whole(), shot["focal"].number()
        if not (width > 0 and height > 0 and focal > 0.0):
            raise shot.wrong("expected width, height and focal above 0")
        return Camera("SIMPLE_PINHOLE", width, height, (focal * max(width, height), width / 2.0, height / 2.0))

    def told(self) -> Iterator[str]:
        """Yield what is to be told of lenses."""
        if self._without:
            where = f"{self._path} has no such camera" if self._path else f"no {_CAMERAS} is beside {self._shots}"
            yield (
                f"{self._without} shots have a focal length alone, as {where}: their lenses are taken for free of "
                "distortion, which moves objects near the edges of pictures"
            )

    def _named(self, shot: Json) -> Json | None:
        return self._known.get(_bare(shot["camera"].text())) if "camera" in shot else None

    def _alike(self, shot: Json) -> Json | None:
        """Return the one camera of the size and focal length of a shot."""
        alike = [camera for camera in self._known.values() if _looks(camera) == _looks(shot)]
        return alike[0] if len(alike) == 1 else None


def _bare(name: str) -> str:
    """Return the name of a camera without OpenSfM's mark of its version, which cameras.json does not have."""
    return name.removeprefix("v2 ")


def _looks(camera: Json) -> tuple[float, ...]:
    """Return width, height and focal length, of a camera or of a shot; a panorama has none."""
    focal = next((camera[name].number() for name in ("focal", "focal_x") if name in camera), 0.0)
    return camera["width"].number(), camera["height"].number(), focal


def _zone(lon_lat_height: Floats, center_in_grid_m: Floats, path: Path) -> str:
    """Return the system in which places (N, 3) have these coordinates (N, 3): OpenDroneMap takes one zone for all."""
    lon, lat, _ = np.median(lon_lat_height, axis=0).tolist()
    if abs(lon) <= 180.0 and abs(lat) < 90.0 and np.abs(lon_lat_height[:, 1]).max() < 90.0:
        zone = int((lon + 180.0) // 6.0)
        for number in (zone, zone - 1, zone + 1):
            for hemisphere in (326, 327) if lat >= 0.0 else (327, 326):
                crs = f"EPSG:{hemisphere}{number % 60 + 1:02d}"
                try:
                    away_m = crs_from_lon_lat_height(lon_lat_height, crs)[:, :2] - center_in_grid_m[:, :2]
                except InputError:
                    continue  # On the other side of the Earth.
                if np.abs(away_m).max() < _SAME_PLACE_M:
                    return crs
    raise InputError(
        f"{path}: expected translations that are the coordinates in UTM, found "
        f"{center_in_grid_m[0].round(1).tolist()} for {lon_lat_height[0].round(6).tolist()}",
        hint="the project has no GPS, or control points in another system: give import opensfm the folder opensfm with "
        "its reconstruction.topocentric.json",
    )
