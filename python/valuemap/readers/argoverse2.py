"""Argoverse 2, the sensor dataset: a folder a log, with feather tables of poses and calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather

from valuemap.arrays import Floats, Ints
from valuemap.arrow import numbers_from_arrow
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import check_folder, file_in
from valuemap.readers.names import match_images
from valuemap.readers.poses import (
    images_without_poses,
    interpolate_poses,
    make_images,
    place_in_crs,
    rigs_by_time,
    rotations_of_quaternions,
)
from valuemap.readers.reader import Reader

_EXPECTED = "a folder of an Argoverse 2 log, or of several, with city_SE3_egovehicle.feather and calibration"
_POSES = "city_SE3_egovehicle.feather"
_NANO = 1e-9
_LONGEST_GAP_NS = 200_000_000

_CITIES = {
    "ATX": (14, 30.27464237939507, -97.7404457407424),
    "DTW": (17, 42.29993066912924, -83.17555750783717),
    "MIA": (17, 25.77452579915163, -80.19656914449405),
    "PAO": (10, 37.416065, -122.13571963362166),
    "PIT": (17, 40.44177902989321, -80.01294377242584),
    "WDC": (18, 38.889377, -77.0355047439081),
}
"""Zone of UTM, latitude and longitude of the origin of each city's frame, which is UTM less that of the origin."""


@dataclass(frozen=True)
class _Log:
    """Images of one log, in the frame of its city."""

    names: list[str]
    cameras: list[Camera]
    sensors: list[str]
    time_ns: Ints
    world_from_cam: Floats
    center_m: Floats
    city: str | None


@Reader
def read_argoverse2(
    logs: Path,
    *,
    detections: DetectionFile | Path | None = None,
    city: str | None = None,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read the cameras of one log, or of all logs of one city in a folder; every image has the pose of its own instant.

    The images are the files of `sensors/cameras`, named `LOG/sensors/cameras/CAMERA/NANOSECONDS.jpg`; for a single log
    without `LOG/`. A pass is a log, images of the ring within 60 ms are a rig. Pictures are undistorted, so the `k1` to
    `k3` of the tables are not used. The frame of a city is UTM with another origin: poses come into east, north, up.

    Parameters
    ----------
    logs
        Folder of a log, or of logs.
    detections
        As in `read_detections`.
    city
        ATX, DTW, MIA, PAO, PIT or WDC; by default the name of the log's map says it. Where there are several, only the
        logs of this one are read, and those that do not say theirs.
    up
        As in `assemble`: the poses then stay in the frame of the city, and are not placed on the Earth.
    anchor
        Latitude, longitude and height of the origin; by default the place of the first image by name that is
        about where most are.

    Raises
    ------
    InputError
        A table is missing or damaged, or there are no images.
    SettingError
        There is no such city, or none is chosen where there are several, or where one of several logs does not say its.
    """
    check_folder(logs, _EXPECTED)
    if city is not None and city not in _CITIES:
        raise SettingError(f"city {city}: there is no such city", hint=f"one of {', '.join(_CITIES)}")
    single = (logs / _POSES).exists()
    folders = [logs] if single else sorted(path.parent for path in logs.glob(f"*/{_POSES}"))
    if not folders:
        raise InputError(f"{logs}: there is no {_POSES} in it", hint=f"expected {_EXPECTED}")
    read = []
    for number, folder in enumerate(folders):
        progress("reading the logs", number, len(folders))
        read.append(_read_log(folder, "" if single else f"{folder.name}/"))
    unknown = [folder.name for folder, log in zip(folders, read, strict=True) if log.city is None]
    if unknown and len(read) > 1 and city is None:
        raise SettingError(
            f"{logs}: {len(unknown)} of {len(read)} logs do not say which city they are of, the first is {unknown[0]}, "
            "and each city has a frame of its own",
            hint="say it with --city, or put the folder map of each log back",
        )
    found = sorted({log.city or city or "" for log in read})
    if len(found) > 1 and city is None:
        raise SettingError(
            f"{logs}: has logs of {', '.join(found)}, whose frames are not one", hint="choose with --city"
        )
    city = city or found[0] or None
    elsewhere = [name for log in read if log.city not in (None, city) for name in log.names]
    kept = [(folder, log) for folder, log in zip(folders, read, strict=True) if log.city in (None, city)]
    images = [log for _, log in kept]
    names = [name for log in images for name in log.names]
    passes = [folder.name for folder, log in kept for _ in log.names]
    time_ns = np.concatenate([log.time_ns for log in images])
    rotation = np.concatenate([log.world_from_cam for log in images])
    center = np.concatenate([log.center_m for log in images])
    if not np.isfinite(center).any():
        raise InputError(
            f"{logs}: {len(names)} images in sensors/cameras, and none has a pose",
            hint="the names of the pictures are their times, in nanoseconds of the clock of the poses",
        )
    if city is not None and up is None:
        placed = place_in_crs(*_utm(center, city), anchor, names, source=str(logs))
        rotation, center, anchor = placed.world_from_local @ rotation, placed.position_in_world_m, placed.anchor
    cameras, camera_id = make_cameras([camera for log in images for camera in log.cameras], str(logs))
    table = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=rotation,
        center_in_world_m=center,
        passes=passes,
        source=str(logs),
        timestamp_s=time_ns * _NANO,
        rigs=rigs_by_time(
            [sensor for log in images for sensor in log.sensors], (time_ns - time_ns.min()) * _NANO, passes
        ),
    )
    dataset = assemble(
        name=logs.resolve().name,
        cameras=cameras,
        images=table,
        detections=read_detections(detections, table, cameras),
        up=up,
        anchor=anchor,
        source=str(logs),
        max_rejected=max_rejected,
        unposed=images_without_poses(table, _LONGEST_GAP_NS * _NANO),
        not_chosen=lambda missing: match_images(missing, elsewhere),
    )
    progress("reading the logs", len(folders), len(folders))
    return dataset


def _utm(center_m: Floats, city: str) -> tuple[Floats, str]:
    """Return positions (N, 3) in UTM and its code, of positions in the frame of a city."""
    from pyproj import Transformer

    zone, lat, lon = _CITIES[city]
    crs = f"EPSG:{32600 + zone}"
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    return center_m + np.array([east, north, 0.0]), crs


def _read_log(folder: Path, prefix: str) -> _Log:
    poses = _feather(folder, _POSES)
    world_from_ego, ego_m = _poses(poses, folder / _POSES)
    sensor_poses = _feather(folder, "calibration/egovehicle_SE3_sensor.feather")
    ego_from_sensor, sensor_m = _poses(sensor_poses, folder / "calibration/egovehicle_SE3_sensor.feather")
    row_of = {name: row for row, name in enumerate(_column(sensor_poses, "sensor_name", folder).to_pylist())}
    intrinsics = _cameras(_feather(folder, "calibration/intrinsics.feather"), folder)
    names, sensors, times = _pictures(folder, set(intrinsics) & set(row_of))
    time = np.array(times, dtype=np.int64)
    known = np.array(_numbers(poses, "timestamp_ns", folder), dtype=np.int64)
    rotation, center, _ = interpolate_poses(time, known, world_from_ego, ego_m, _LONGEST_GAP_NS)
    sensor = np.array([row_of[name] for name in sensors], dtype=np.int64)
    maps = sorted((folder / "map").glob("*____*_city_*.json")) if (folder / "map").is_dir() else []
    cities = {path.name.split("____")[-1].split("_city_")[0] for path in maps} & set(_CITIES)
    return _Log(
        names=[prefix + name for name in names],
        cameras=[intrinsics[name] for name in sensors],
        sensors=sensors,
        time_ns=time,
        world_from_cam=rotation @ ego_from_sensor[sensor],
        center_m=np.einsum("nij,nj->ni", rotation, sensor_m[sensor]) + center,
        city=cities.pop() if len(cities) == 1 else None,
    )


def _pictures(folder: Path, sensors: set[str]) -> tuple[list[str], list[str], list[int]]:
    """Return names, cameras and times in nanoseconds of the pictures of a log."""
    found = []
    for path in sorted((folder / "sensors" / "cameras").glob("*/*")):
        if path.suffix.lower() in (".jpg", ".png") and path.stem.isdecimal() and len(path.stem) < 19 + 1:
            if path.parent.name not in sensors:
                raise InputError(
                    f"{path.parent}: the calibration has no camera {path.parent.name!r}", hint=f"expected {_EXPECTED}"
                )
            found.append((path.relative_to(folder).as_posix(), path.parent.name, int(path.stem)))
    return [name for name, _, _ in found], [sensor for _, sensor, _ in found], [time for _, _, time in found]


def _feather(folder: Path, name: str) -> pa.Table:
    path = file_in(folder, name, _EXPECTED)
    try:
        table = pyarrow.feather.read_table(path)
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read as feather: {' '.join(str(error).split())[:200]}",
            hint="is it whole? Download it again",
        ) from error
    if not table.num_rows:
        raise InputError(f"{path}: the table is empty", hint=f"expected {_EXPECTED}")
    return table


def _column(table: pa.Table, name: str, where: Path) -> pa.ChunkedArray:
    if table.column_names.count(name) != 1:
        raise InputError(
            f"{where}: expected a column {name!r}, found {', '.join(table.column_names)[:200]}",
            hint=f"expected {_EXPECTED}",
        )
    return table.column(name)


def _numbers(table: pa.Table, name: str, where: Path) -> Floats:
    column = _column(table, name, where)
    kind = pa.int64() if name == "timestamp_ns" else pa.float64()
    try:
        values: Floats = numbers_from_arrow(column.cast(kind))
    except pa.ArrowException as error:
        raise InputError(
            f"{where}: {name}: expected numbers, found {column.type}", hint=f"expected {_EXPECTED}"
        ) from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: {name}: expected finite numbers", hint="repair the table")
    return values


def _poses(table: pa.Table, where: Path) -> tuple[Floats, Floats]:
    """Return rotations (N, 3, 3) and translations (N, 3)."""
    quaternion = np.stack([_numbers(table, name, where) for name in ("qw", "qx", "qy", "qz")], axis=1)
    translation = np.stack([_numbers(table, name, where) for name in ("tx_m", "ty_m", "tz_m")], axis=1)
    return rotations_of_quaternions(quaternion), translation


def _cameras(table: pa.Table, folder: Path) -> dict[str, Camera]:
    names = _column(table, "sensor_name", folder).to_pylist()
    fx, fy, cx, cy, width, height = (
        _numbers(table, name, folder) for name in ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    )
    return {
        name: Camera(
            "PINHOLE",
            int(width[row]),
            int(height[row]),
            (float(fx[row]), float(fy[row]), float(cx[row] + 0.5), float(cy[row] + 0.5)),
        )
        for row, name in enumerate(names)
    }
