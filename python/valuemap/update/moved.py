"""Maps that control points moved together with their dataset: passes that are added are moved likewise."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import camera_poses, cast_rays
from valuemap.control import labels_before_control
from valuemap.dataset import Dataset, evenly, read_images, rows_of
from valuemap.map_folder import Map
from valuemap.portions import ROWS, read_portions
from valuemap.tables import Detections
from valuemap.update.changes import first_rows

_LOOKED_AT = 10_000
"""Votes that tell where a dataset is."""


def is_moved_with_map(before: Map, folder: Path) -> bool:
    """Return whether a dataset is where control points moved its map: its rays then meet the labels where they are."""
    if "control" not in before.run:
        return False
    cameras, images = read_images(folder)
    detections = next(read_portions(Detections, folder / "detections.parquet", ROWS))
    at = first_rows(before.votes.detection_id, detections.detection_id)
    votes = evenly(np.flatnonzero(at >= 0), _LOOKED_AT)
    if not len(votes):
        return False
    rays = cast_rays(Dataset("", before.frame, cameras, images, detections.take(np.unique(at[votes]))))
    ray = np.searchsorted(np.unique(at[votes]), at[votes])
    center_m, direction = rays.center_in_world_m[ray], rays.direction_in_world[ray]

    def off_rad(place_in_world_m: Floats) -> float:
        away_m = place_in_world_m[rows_of(before.votes.label_id[votes], before.labels.label_id)] - center_m
        away_m /= np.linalg.norm(away_m, axis=1, keepdims=True)
        return float(np.nanmedian(np.linalg.norm(np.cross(direction, away_m), axis=1)))

    return off_rad(before.labels.position_in_world_m) < off_rad(labels_before_control(before).position_in_world_m)


def moved_with_map(before: Map, added: Dataset) -> Dataset:
    """Return a dataset with its images shifted and turned as control points moved a map."""
    from scipy.spatial.transform import Rotation  # Slow to import, and only maps with control points need it.

    told, axes = before.run["control"], before.frame.east_north_up()
    turn = axes.T @ Rotation.from_rotvec([0.0, 0.0, math.radians(told["turn_deg"])]).as_matrix() @ axes
    pivot, shift = np.array(told["pivot_m"]), np.array(told["shift_east_north_up_m"]) @ axes
    rotation, center_m = camera_poses(added.images)
    turned = Rotation.from_matrix(rotation @ turn.T)
    moved_m = (center_m - pivot) @ turn.T + pivot + shift
    images = added.images.replace(
        cam_from_world_quat=turned.as_quat(canonical=True, scalar_first=True), cam_from_world_m=-turned.apply(moved_m)
    )
    return replace(added, images=images)
