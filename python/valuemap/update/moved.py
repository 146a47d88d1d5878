"""Maps that control points moved: whether their dataset was moved, too, so that what is added has to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import cast_rays
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
    rows, ray = np.unique(at[votes], return_inverse=True)
    rays = cast_rays(Dataset("", before.frame, cameras, images, detections.take(rows)))
    center_m, direction = rays.center_in_world_m[ray], rays.direction_in_world[ray]

    def off_rad(place_in_world_m: Floats) -> float:
        away_m = place_in_world_m[rows_of(before.votes.label_id[votes], before.labels.label_id)] - center_m
        away_m /= np.linalg.norm(away_m, axis=1, keepdims=True)
        return float(np.nanmedian(np.linalg.norm(np.cross(direction, away_m), axis=1)))

    return off_rad(before.labels.position_in_world_m) < off_rad(labels_before_control(before).position_in_world_m)
