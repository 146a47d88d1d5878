"""Which true objects a map could hold: detected from sufficiently different directions, or near an image at least."""

from __future__ import annotations

import math

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, rows_of
from valuemap.tables import Truth, TruthDetections

_VIEWS_AT_ONCE = 1000
"""Rows of a block of pairwise distances between the views of one object; bounds memory, changes no result."""


def recoverable_objects(dataset: Dataset, min_parallax_rad: float) -> Bools | None:
    """Return which true objects (N) two images detected from directions at least `min_parallax_rad` apart.

    A direction is that from a camera centre to the true object. None where the dataset does not say which
    detection shows which object.
    """
    if dataset.truth is None or dataset.truth_detections is None:
        return None
    object_row, direction = _views(dataset.truth, dataset.truth_detections, dataset)
    return _are_spread(object_row, direction, len(dataset.truth), 2.0 * math.sin(min_parallax_rad / 2.0))


def near_images(position_in_world_m: Floats, center_in_world_m: Floats, up: Floats, radius_m: float) -> Bools:
    """Return which positions (N, 3) lie within a radius of a camera centre (M, 3), across up."""
    from scipy.spatial import KDTree  # Slow to import, and only evaluation needs it.

    if len(position_in_world_m) == 0:
        return np.empty(0, np.bool_)
    along_ground = np.eye(3) - np.outer(up, up)
    distance_m, _ = KDTree(center_in_world_m @ along_ground).query(position_in_world_m @ along_ground)
    near: Bools = np.asarray(distance_m <= radius_m)
    return near


def _views(truth: Truth, pairs: TruthDetections, dataset: Dataset) -> tuple[Ints, Floats]:
    """Return object row (M), ascending, and unit direction (M, 3) of every image that detected an object."""
    detection_row = rows_of(pairs.detection_id, dataset.detections.detection_id)
    image_row = rows_of(dataset.detections.image_id[detection_row], dataset.images.image_id)
    view = np.unique(np.column_stack([rows_of(pairs.object_id, truth.object_id), image_row]), axis=0)
    object_row, image_row = view.T
    direction = truth.position_in_world_m[object_row] - camera_centers(dataset.images)[image_row]
    return object_row, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def _are_spread(group: Ints, direction: Floats, groups: int, min_chord: float) -> Bools:
    """Return for each group of unit vectors (M, 3) whether two are `min_chord` apart or more; `group` ascends.

    Exact. With c the longest chord from the first vector of a group, some chord has length c and none is
    longer than 2c, which decides almost all groups at once; all pairs are measured in the others only.
    """
    start = np.searchsorted(group, np.arange(groups + 1))
    count = np.diff(start)
    seen = np.flatnonzero(count)
    from_first = np.linalg.norm(direction - direction[start[group]], axis=1)
    longest = np.zeros(groups)
    longest[seen] = np.maximum.reduceat(from_first, start[seen]) if len(seen) else 0.0
    is_spread: Bools = (count >= 2) & (longest >= min_chord)
    for row in np.flatnonzero((count >= 3) & ~is_spread & (2.0 * longest >= min_chord)):
        is_spread[row] = _longest_chord_reaches(direction[start[row] : start[row + 1]], min_chord)
    return is_spread


def _longest_chord_reaches(direction: Floats, min_chord: float) -> bool:
    from scipy.spatial.distance import cdist  # Slow to import, and only evaluation needs it.

    from_mean = np.linalg.norm(direction - direction.mean(axis=0), axis=1)
    # By the triangle inequality the others are too near to all.
    far = direction[from_mean + from_mean.max() >= min_chord]
    blocks = (far[i : i + _VIEWS_AT_ONCE] for i in range(0, len(far), _VIEWS_AT_ONCE))
    return any(bool(np.any(cdist(block, far) >= min_chord)) for block in blocks)
