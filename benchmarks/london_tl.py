"""Real panoramas with GPS-grade poses: traffic lights of Regent Street, of which only bearings are known.

    python benchmarks/london_tl.py DATA_DIR [--with-range] [--json FILE] [--method NAME] [--set name=value ...]

DATA_DIR holds `detection_input.csv` (lat, lon of a panorama, bearing of a traffic light in it in degrees clockwise from
north, depth in metres) and `ground_truth.csv` (lon, lat of each light); Krylov et al., Remote Sensing 2018.

How a user would hold it: one equirectangular camera of 4096 x 2048 pixels. Each panorama is level, faces north and lies
at height 0. A bearing is a box of 40 x 80 pixels in the column of the bearing with its centre on the horizon, so all
lights are at the height of the cameras, and the benchmark is about the plane. Sizes and scores were not published: the
same for all. There is one pass, without times, and the names number the panoramas as the file has them, along the
street. Depths come from a network and are not used, except with --with-range: then as ranges with a sigma of a quarter.

What is counted: labels matched one to one with lights within 6 m (and 3 m) in the plane; F1 of that.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from field_data import (
    PANORAMA_SIZE_PX,
    Change,
    Figures,
    as_it_is,
    command_line,
    dataset_of,
    enu,
    images_of,
    level_rotations,
    panorama_camera,
    positions,
    ratio,
    read_columns,
    timed_map,
)
from kitti_signs import match_one_to_one, median
from valuemap.arrays import Floats
from valuemap.config import MapConfig
from valuemap.dataset import Dataset

RADII_M = (6.0, 3.0)
BOX_PX = (40.0, 80.0)
RANGE_SIGMA_SHARE = 0.25


def anchor_of(data_dir: Path) -> tuple[float, float, float]:
    """Return the place of the first panorama, where the map's frame has its origin."""
    seen = read_columns(data_dir / "detection_input.csv")
    return float(seen["lat"][0]), float(seen["lon"][0]), 0.0


def load(data_dir: Path, *, with_range: bool = False) -> Dataset:
    """Return the panoramas as a dataset."""
    seen = read_columns(data_dir / "detection_input.csv")
    place, first, image_id = np.unique(positions(seen, "lat", "lon"), axis=0, return_index=True, return_inverse=True)
    number = np.empty(len(first), np.int64)
    number[np.argsort(first)] = np.arange(len(first))
    place, image_id = place[np.argsort(first)], number[image_id.ravel()]
    width, height = PANORAMA_SIZE_PX
    # The middle column faces north.
    column = (seen["bearing"] / 360.0 + 0.5) % 1.0 * width
    anchor = anchor_of(data_dir)
    dataset = dataset_of(
        "london",
        panorama_camera(),
        images_of(
            [f"panorama-{row:03d}.jpg" for row in range(len(place))],
            level_rotations(np.zeros(len(place))),
            enu(place[:, 0], place[:, 1], anchor),
            ["all"] * len(place),
        ),
        image_id=image_id,
        class_names=["traffic_light"] * len(column),
        center_px=np.column_stack([column, np.full(len(column), height / 2.0)]),
        size_px=np.tile(BOX_PX, (len(column), 1)),
        anchor=anchor,
    )
    return _with_range(dataset, image_id, column, seen["depth"].astype(np.float64)) if with_range else dataset


def _with_range(dataset: Dataset, image_id: np.ndarray, column: Floats, depth_m: Floats) -> Dataset:
    order = np.lexsort((column, image_id))  # As the detections are numbered.
    detections = dataset.detections.replace(range_m=depth_m[order], range_sigma_m=RANGE_SIGMA_SHARE * depth_m[order])
    return dataclasses.replace(dataset, detections=detections)


def truth(data_dir: Path) -> Floats:
    """Return the places (N, 2) of the lights in the plane of the map, in metres."""
    lights = read_columns(data_dir / "ground_truth.csv")
    return enu(lights["lat"], lights["lon"], anchor_of(data_dir))[:, :2]


def score_labels(labels: Floats, lights: Floats) -> Figures:
    """Count what became of labels (N, 2) and lights (M, 2), in metres in one plane."""
    distance_m = cdist(labels, lights)
    figures: Figures = {"lights": len(lights), "labels": len(labels)}
    for radius_m in RADII_M:
        label, light = match_one_to_one(distance_m, distance_m <= radius_m)
        right = len(label)
        figures |= {
            f"true_{radius_m:g}m": right,
            f"false_{radius_m:g}m": len(labels) - right,
            f"missed_{radius_m:g}m": len(lights) - right,
            f"f1_{radius_m:g}m": ratio(2 * right, len(labels) + len(lights)),
            f"median_distance_{radius_m:g}m": median(distance_m[label, light]),
        }
    return figures


def run(
    data_dir: Path, config: MapConfig, change: Change = as_it_is, *, with_range: bool = False
) -> dict[str, Figures]:
    """Map and score."""
    result, seconds = timed_map(change(load(data_dir, with_range=with_range)), config)
    figures = score_labels(result.labels.position_in_world_m[:, :2], truth(data_dir))
    return {"london": {**figures, "map_seconds": round(seconds, 2)}}


def main() -> int:
    """Run the benchmark; return the exit code."""

    def add_options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--with-range", action="store_true", help="use the depths as ranges")

    def measure(options: argparse.Namespace, config: MapConfig) -> dict[str, Figures]:
        return run(options.data_dir, config, with_range=options.with_range)

    return command_line("london_tl", __doc__ or "", measure, add_options)


if __name__ == "__main__":
    sys.exit(main())
