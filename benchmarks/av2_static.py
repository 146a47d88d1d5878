"""Real cars with seven cameras: static objects of two Argoverse 2 logs, seen as boxes, against surveyed places.

    python benchmarks/av2_static.py DATA_DIR [--json FILE] [--method NAME] [--set name=value ...]

DATA_DIR holds `intrinsics.csv` and a folder a log with `camera_poses.csv` (camera to city, a row a sweep and camera),
`projected_boxes.csv` (human cuboids of bollards, signs and cones projected into the cameras without distortion; which
object a box shows, track_uuid, is read for scoring only) and `gt_city.csv` (where each object is).

How a user would hold it: each log is a dataset and one pass, its frames have timestamps, and the cameras are pinholes.
Boxes and intrinsics share one pixel convention, so nothing is shifted.

What is counted

    evaluable objects  those with at least 3 boxes, two of them from directions 2 degrees apart, the nearest from
                       less than 60 m
    found              evaluable objects with a label of their class within 1 m, one to one
    right labels       within 1 m of any object of their class; over all labels: precision
    duplicate labels   right ones that are left over when labels and objects are matched one to one
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from field_data import (
    Change,
    Figures,
    as_it_is,
    cameras_of,
    command_line,
    dataset_of,
    images_of,
    positions,
    ratio,
    read_columns,
    timed_map,
)
from kitti_signs import match_one_to_one, median
from valuemap.arrays import Bools, Floats
from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.errors import InputError

RADIUS_M = 1.0
MIN_BOXES = 3
MIN_PARALLAX_DEG = 2.0
MAX_NEAREST_M = 60.0

Columns = dict[str, NDArray[Any]]


def logs(data_dir: Path) -> list[str]:
    """Return the names of the folders of logs, sorted."""
    names = sorted(path.parent.name for path in data_dir.glob("*/projected_boxes.csv"))
    if not names:
        raise InputError(f"{data_dir}: no log with projected_boxes.csv in it", hint="see the top of this script")
    return names


def load(data_dir: Path, log: str) -> Dataset:
    """Return one log as a dataset in the frame of the city."""
    cameras, poses = read_columns(data_dir / "intrinsics.csv"), read_columns(data_dir / log / "camera_poses.csv")
    boxes = read_columns(data_dir / log / "projected_boxes.csv")
    row_of_camera = {name: row for row, name in enumerate(cameras["sensor_name"].tolist())}
    row_of_image = {key: row for row, key in enumerate(zip(poses["k"].tolist(), poses["camera"].tolist(), strict=True))}
    world_from_cam = positions(poses, *(f"r{i}{j}" for i in "123" for j in "123")).reshape(-1, 3, 3)
    sizes = positions(cameras, "width_px", "height_px").astype(int)
    corners = positions(boxes, "x1", "y1", "x2", "y2")
    return dataset_of(
        f"av2-{log}",
        cameras_of(
            ["PINHOLE"] * len(sizes),
            [(int(width), int(height)) for width, height in sizes],
            list(positions(cameras, "fx_px", "fy_px", "cx_px", "cy_px")),
        ),
        images_of(
            [f"{name}/{time}.jpg" for name, time in zip(poses["camera"], poses["timestamp_ns"], strict=True)],
            Rotation.from_matrix(world_from_cam),
            positions(poses, "tx", "ty", "tz"),
            [log] * len(poses["k"]),
            camera_id=np.array([row_of_camera[name] + 1 for name in poses["camera"].tolist()]),
            timestamp_s=poses["timestamp_ns"] / 1e9,
        ),
        image_id=np.array(
            [row_of_image[key] for key in zip(boxes["k"].tolist(), boxes["camera"].tolist(), strict=True)]
        ),
        class_names=boxes["category"].tolist(),
        center_px=(corners[:, :2] + corners[:, 2:]) / 2.0,
        size_px=corners[:, 2:] - corners[:, :2],
    )


def evaluable(data_dir: Path, log: str) -> Bools:
    """Return which objects of `gt_city.csv` (N) a map should hold."""
    truth, boxes = read_columns(data_dir / log / "gt_city.csv"), read_columns(data_dir / log / "projected_boxes.csv")
    poses = read_columns(data_dir / log / "camera_poses.csv")
    center = dict(
        zip(
            zip(poses["k"].tolist(), poses["camera"].tolist(), strict=True),
            positions(poses, "tx", "ty", "tz"),
            strict=True,
        )
    )
    place = positions(truth, "city_x", "city_y", "city_z")
    counts = np.zeros(len(place), np.bool_)
    for row, uuid in enumerate(truth["track_uuid"]):
        shows = boxes["track_uuid"] == uuid
        keys = zip(boxes["k"][shows].tolist(), boxes["camera"][shows].tolist(), strict=True)
        views = np.array([center[key] for key in keys]).reshape(-1, 3)
        counts[row] = is_evaluable(views, place[row])
    return counts


def is_evaluable(center_in_world_m: Floats, place_in_world_m: Floats) -> bool:
    """Say whether cameras (N, 3) that show an object (3) in a box each see enough of it."""
    if len(center_in_world_m) < MIN_BOXES:
        return False
    to_object = place_in_world_m - center_in_world_m
    distance_m = np.linalg.norm(to_object, axis=1)
    direction = to_object / distance_m[:, None]
    parallax_deg = np.degrees(np.arccos(np.clip(direction @ direction.T, -1.0, 1.0))).max()
    return bool(parallax_deg >= MIN_PARALLAX_DEG and distance_m.min() < MAX_NEAREST_M)


def score_labels(
    labels: Floats, label_class: NDArray[Any], objects: Floats, object_class: NDArray[Any], counts: Bools
) -> Figures:
    """Count what became of labels (N, 3) and objects (M, 3), in metres in one frame, of classes (N) and (M)."""
    distance_m = cdist(labels, objects)
    near = (distance_m <= RADIUS_M) & (label_class[:, None] == object_class[None, :])
    matched_label, matched_object = match_one_to_one(distance_m, near)
    right, found = int(near.any(axis=1).sum()), int(counts[matched_object].sum())
    return {
        "objects": int(counts.sum()),
        "found": found,
        "recall": ratio(found, int(counts.sum())),
        "labels": len(labels),
        "right_labels": right,
        "false_labels": len(labels) - right,
        "duplicate_labels": right - len(matched_label),
        "precision": ratio(right, len(labels)),
        "precision_one_to_one": ratio(len(matched_label), len(labels)),
        "median_distance_m": median(distance_m[matched_label, matched_object]),
    }


def run(data_dir: Path, config: MapConfig, change: Change = as_it_is) -> dict[str, Figures]:
    """Map and score each log, all of them together, and each class of them together."""
    parts: list[tuple[str, Floats, NDArray[Any], Floats, NDArray[Any], Bools]] = []
    results: dict[str, Figures] = {}
    seconds = 0.0
    for number, log in enumerate(logs(data_dir)):
        result, took = timed_map(change(load(data_dir, log)), config)
        truth = read_columns(data_dir / log / "gt_city.csv")
        apart = np.array([1e6 * number, 0.0, 0.0])  # So that no object of one log is near a label of another.
        part = (
            result.labels.position_in_world_m + apart,
            np.array(result.labels.class_name.names, object)[result.labels.class_name.codes],
            positions(truth, "city_x", "city_y", "city_z") + apart,
            truth["category"].astype(object),
            evaluable(data_dir, log),
        )
        parts.append((log, *part))
        results[log[:8]] = {**score_labels(*part), "map_seconds": round(took, 2)}
        seconds += took
    place, name, truth_place, truth_name, counts = (np.concatenate([part[i] for part in parts]) for i in range(1, 6))
    for kind in sorted(set(truth_name)):
        is_label, is_object = name == kind, truth_name == kind
        results[kind] = score_labels(
            place[is_label], name[is_label], truth_place[is_object], truth_name[is_object], counts[is_object]
        )
    total = score_labels(place, name, truth_place, truth_name, counts)
    return {**results, "total": {**total, "map_seconds": round(seconds, 2)}}


def main() -> int:
    """Run the benchmark; return the exit code."""

    def measure(options: argparse.Namespace, config: MapConfig) -> dict[str, Figures]:
        return run(options.data_dir, config)

    return command_line("av2_static", __doc__ or "", measure)


if __name__ == "__main__":
    sys.exit(main())
