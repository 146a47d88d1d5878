"""Real drives with GPS/IMU poses: traffic signs of 42 KITTI raw drives on five days, with classes.

    python benchmarks/kitti_ts.py DATA_DIR [--json FILE] [--method NAME] [--set name=value ...]

DATA_DIR holds `images.csv` (lat, lon, yaw and intrinsics of each image that shows a sign, and its drive),
`detections.csv` (image, class, box in pixels that count from the centre of the top-left one: half a pixel is added) and
`signs.csv` (class, lat and lon of each sign, good to about 1 m).

How a user would hold it: the camera is level, 1.65 m above a flat road; a drive is a pass; frames have numbers in their
names and no timestamps. Images of other drives are driven hours or days apart.

What is counted: R@1m and R@2m, signs with a label of their class within 1 m and 2 m in the plane, one to one, over all
signs; right labels, within 2 m of a sign of their class, over all labels: precision at 2 m (of what somebody
annotated). Facing: of the signs found within 2 m whose `faces_class` is known, how many labels face within 45 degrees
of where it says. What its codes mean stands nowhere; they are read as 1: against the drive of the images that show the
sign, 2: across it, 0: not known.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from field_data import (
    Change,
    Figures,
    as_it_is,
    cameras_of,
    command_line,
    dataset_of,
    enu,
    images_of,
    level_rotations,
    positions,
    ratio,
    read_columns,
    timed_map,
)
from kitti_signs import match_one_to_one, median
from valuemap.arrays import Floats, Ints
from valuemap.cameras import rotation_matrices
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.map_folder import Map

RADII_M = (1.0, 2.0)
CAMERA_HEIGHT_M = 1.65
AGAINST_THE_DRIVE, ACROSS = 1, 2
RIGHT_FACING_DEG = 45.0
PIXEL_CENTER = 0.5


def anchor_of(data_dir: Path) -> tuple[float, float, float]:
    """Return the place of the first image, where the map's frame has its origin, on the road."""
    images = read_columns(data_dir / "images.csv")
    return float(images["lat"][0]), float(images["lon"][0]), 0.0


def load(data_dir: Path) -> Dataset:
    """Return all drives as one dataset, a camera for every distinct set of intrinsics."""
    images, boxes = read_columns(data_dir / "images.csv"), read_columns(data_dir / "detections.csv")
    intrinsics, camera_row = np.unique(
        positions(images, "width", "height", "fx", "cx", "cy"), axis=0, return_inverse=True
    )
    anchor = anchor_of(data_dir)
    center = enu(images["lat"], images["lon"], anchor) + [0.0, 0.0, CAMERA_HEIGHT_M]
    row_of_image = {name: row for row, name in enumerate(images["image"].tolist())}
    corners = positions(boxes, "x1", "y1", "x2", "y2")
    return dataset_of(
        "kitti_ts",
        cameras_of(
            ["PINHOLE"] * len(intrinsics),
            [(int(width), int(height)) for width, height in intrinsics[:, :2]],
            [np.array([fx, fx, cx + PIXEL_CENTER, cy + PIXEL_CENTER]) for fx, cx, cy in intrinsics[:, 2:]],
        ),
        images_of(
            [f"{name}.png" for name in images["image"]],
            level_rotations(np.pi / 2.0 - images["yaw_rad_ccw_from_east"]),
            center,
            images["drive"].tolist(),
            camera_id=camera_row.ravel() + 1,
        ),
        image_id=np.array([row_of_image[name] for name in boxes["image"].tolist()]),
        class_names=[str(code) for code in boxes["class"]],
        center_px=(corners[:, :2] + corners[:, 2:]) / 2.0 + PIXEL_CENTER,
        size_px=corners[:, 2:] - corners[:, :2],
        anchor=anchor,
    )


def truth(data_dir: Path) -> tuple[Floats, NDArray[Any]]:
    """Return places (N, 2) in the plane of the map, in metres, and classes (N) of the signs."""
    signs = read_columns(data_dir / "signs.csv")
    return enu(signs["lat"], signs["lon"], anchor_of(data_dir))[:, :2], signs["class"].astype(str)


def score_labels(labels: Floats, label_class: NDArray[Any], signs: Floats, sign_class: NDArray[Any]) -> Figures:
    """Count what became of labels (N, 2) and signs (M, 2), in metres in one plane, of classes (N) and (M)."""
    distance_m = cdist(labels, signs)
    is_same = label_class[:, None] == sign_class[None, :]
    near = is_same & (distance_m <= max(RADII_M))
    matched = match_one_to_one(distance_m, near)
    figures: Figures = {"signs": len(signs), "labels": len(labels)}
    for radius_m in RADII_M:
        found = len(match_one_to_one(distance_m, is_same & (distance_m <= radius_m))[0])
        figures[f"recall_{radius_m:g}m"] = ratio(found, len(signs))
    return {
        **figures,
        "right_labels_2m": int(near.any(axis=1).sum()),
        "duplicate_labels_2m": int(near.any(axis=1).sum()) - len(matched[0]),
        "precision_2m": ratio(int(near.any(axis=1).sum()), len(labels)),
        "median_distance_m": median(distance_m[matched]),
    }


def drive_azimuths_rad(result: Map, dataset: Dataset) -> Floats:
    """Return where the images that show each label look on average (N), clockwise from north."""
    image = rows_of(dataset.detections.image_id, dataset.images.image_id)
    voter = image[rows_of(result.votes.detection_id, dataset.detections.detection_id)]
    forward = np.zeros((len(result.labels), 3))
    label = rows_of(result.votes.label_id, result.labels.label_id)
    np.add.at(forward, label, rotation_matrices(dataset.images)[voter, 2])
    return np.asarray(np.arctan2(forward[:, 0], forward[:, 1]))


def score_facing(facing_rad: Floats, drive_rad: Floats, faces_class: Ints) -> Figures:
    """Count which of some labels face where their signs are said to; all (N), azimuths clockwise from north."""
    is_known = np.isin(faces_class, (AGAINST_THE_DRIVE, ACROSS))
    against = -np.cos(facing_rad - drive_rad)
    across = np.abs(np.sin(facing_rad - drive_rad))
    least = np.cos(np.radians(RIGHT_FACING_DEG))
    is_right = np.where(faces_class == ACROSS, across, against) >= least
    known = int(is_known.sum())
    return {"facing_known": known, "facing_right": ratio(int(is_right[is_known].sum()), known)}


def run(data_dir: Path, config: MapConfig, change: Change = as_it_is) -> dict[str, Figures]:
    """Map and score."""
    dataset = change(load(data_dir))
    result, seconds = timed_map(dataset, config)
    place, (signs, sign_class) = result.labels.position_in_world_m[:, :2], truth(data_dir)
    names = np.array(result.labels.class_name.names, str)[result.labels.class_name.codes]
    figures = score_labels(place, names, signs, sign_class)
    distance_m = cdist(place, signs)
    label, sign = match_one_to_one(distance_m, (names[:, None] == sign_class) & (distance_m <= max(RADII_M)))
    faces_class = read_columns(data_dir / "signs.csv")["faces_class"][sign]
    drive_rad = drive_azimuths_rad(result, dataset)
    facing = score_facing(result.labels.facing_azimuth_rad[label], drive_rad[label], faces_class)
    return {"kitti_ts": {**figures, **facing, "map_seconds": round(seconds, 2)}}


def main() -> int:
    """Run the benchmark; return the exit code."""

    def measure(options: argparse.Namespace, config: MapConfig) -> dict[str, Figures]:
        return run(options.data_dir, config)

    return command_line("kitti_ts", __doc__ or "", measure)


if __name__ == "__main__":
    sys.exit(main())
