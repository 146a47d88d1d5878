"""Real data as tables in memory, and the command line that the benchmarks on real data share."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv
from scipy.spatial.transform import Rotation

from machine import describe_machine, keep_record
from valuemap.arrays import Floats, Ints
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, Frame, check_dataset
from valuemap.errors import InputError, ValuemapError
from valuemap.geodesy import enu_from_lon_lat_height
from valuemap.map_folder import Map
from valuemap.pipeline import build_map
from valuemap.readers.assemble import number_detections
from valuemap.tables import Cameras, Categories, Images

PANORAMA_SIZE_PX = (4096, 2048)
"""Width and height that a panorama is taken to have where the data does not say it."""

Figures = dict[str, Any]
"""What a benchmark measured, by name, in the order in which it is shown."""


def read_columns(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns of a CSV file with a header line by name; a missing file is an `InputError`."""
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder described at the top of this script")
    table = csv.read_csv(path)
    return {name: table[name].to_numpy() for name in table.column_names}


def positions(columns: dict[str, NDArray[Any]], *names: str) -> Floats:
    """Return columns side by side (N, len(names))."""
    return np.stack([columns[name].astype(np.float64) for name in names], axis=1)


def enu(lat: Floats, lon: Floats, anchor: tuple[float, float, float]) -> Floats:
    """Return ENU positions (N, 3) in metres of places at the height of the anchor."""
    place = enu_from_lon_lat_height(np.column_stack([lon, lat, np.full(len(lat), anchor[2])]), anchor)
    place[:, 2] = 0.0  # Flat ground: not the curve of the ellipsoid, 8 cm in a kilometre.
    return place


def level_rotations(azimuth_rad: Floats) -> Rotation:
    """Return world-from-camera rotations of level cameras that look along azimuths (N), clockwise from north."""
    sine, cosine, zero = np.sin(azimuth_rad), np.cos(azimuth_rad), np.zeros(len(azimuth_rad))
    right, forward = np.stack([cosine, -sine, zero], axis=1), np.stack([sine, cosine, zero], axis=1)
    down = np.stack([zero, zero, zero - 1.0], axis=1)
    return Rotation.from_matrix(np.stack([right, down, forward], axis=2))


def panorama_camera(size_px: tuple[int, int] = PANORAMA_SIZE_PX) -> Cameras:
    """Return one equirectangular camera with id 1."""
    return cameras_of(["EQUIRECTANGULAR"], [size_px], [np.array(size_px, np.float64)])


def cameras_of(models: Sequence[str], sizes_px: Sequence[tuple[int, int]], params: list[Floats]) -> Cameras:
    """Return cameras with ids from 1 on."""
    sizes = np.array(sizes_px, np.int64)
    return Cameras(
        camera_id=np.arange(1, len(models) + 1),
        model=Categories.from_texts(models),
        width_px=sizes[:, 0],
        height_px=sizes[:, 1],
        params=params,
    )


def images_of(
    names: Sequence[str],
    world_from_cam: Rotation,
    center_in_world_m: Floats,
    pass_names: Sequence[str],
    *,
    camera_id: Ints | None = None,
    timestamp_s: Floats | None = None,
) -> Images:
    """Return images with ids from 0 on, in the order given."""
    cam_from_world = world_from_cam.inv()
    return Images(
        image_id=np.arange(len(names)),
        name=pa.array(list(names), pa.string()),
        camera_id=np.ones(len(names), np.int64) if camera_id is None else camera_id,
        cam_from_world_quat=cam_from_world.as_quat(canonical=True, scalar_first=True),
        cam_from_world_m=-cam_from_world.apply(center_in_world_m),
        pass_id=Categories.from_texts(list(pass_names)),
        timestamp_s=timestamp_s,
    )


def dataset_of(
    name: str,
    cameras: Cameras,
    images: Images,
    *,
    image_id: Ints,
    class_names: Sequence[str],
    center_px: Floats,
    size_px: Floats,
    score: Floats | None = None,
    anchor: tuple[float, float, float] | None = None,
) -> Dataset:
    """Return the checked dataset; without `anchor` its frame is local with z up."""
    score = np.ones(len(image_id)) if score is None else score
    return check_dataset(
        Dataset(
            name=name,
            frame=Frame(anchor=anchor),
            cameras=cameras,
            images=images,
            detections=number_detections(image_id, class_names, center_px, size_px, score),
        ),
        source=name,
    )


Change = Callable[[Dataset], Dataset]


def as_it_is(dataset: Dataset) -> Dataset:
    """Return the dataset."""
    return dataset


def timed_map(dataset: Dataset, config: MapConfig) -> tuple[Map, float]:
    """Return the map of a dataset and the seconds that it took."""
    start = time.perf_counter()
    result = build_map(dataset, config)
    return result, time.perf_counter() - start


def ratio(part: float, whole: float) -> float | None:
    """Return a share with four digits; None of nothing."""
    return round(part / whole, 4) if whole else None


def command_line(
    script: str,
    description: str,
    run: Callable[[argparse.Namespace, MapConfig], dict[str, Figures]],
    add_options: Callable[[argparse.ArgumentParser], None] | None = None,
) -> int:
    """Run one benchmark on real data: parse DATA_DIR, --method, --set and --json, print, keep; return the exit code."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_dir", type=Path, metavar="DATA_DIR")
    parser.add_argument("--json", type=Path, help="write the figures, settings and machine there")
    parser.add_argument("--method", default=MapConfig().method)
    parser.add_argument("--set", action="append", default=[], metavar="name=value", dest="settings")
    if add_options:
        add_options(parser)
    options = parser.parse_args()
    try:
        config = MapConfig(method=options.method).with_settings(options.settings)
        results = run(options, config)
        print(table(results))
        settings = "".join(f" --set {assignment}" for assignment in options.settings)
        details = " --details" if getattr(options, "details", False) else ""
        command = f"python benchmarks/{script}.py DATA_DIR --method {options.method}{details}{settings}"
        record = {"benchmark": script, "command": command, **describe_machine(), "settings": config.as_dict()}
        keep_record(options.json, {**record, "results": results})
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    return 0


def table(results: dict[str, Figures]) -> str:
    """Return one column a part of the data and one line a figure."""
    width = max(9, *(len(part) + 2 for part in results))
    lines = [f"{'':26}" + "".join(f"{part:>{width}}" for part in results)]
    for name in next(iter(results.values())):
        values = (results[part].get(name) for part in results)
        lines.append(f"{name:26}" + "".join(f"{'-' if value is None else value:>{width}}" for value in values))
    return "\n".join(lines)
