"""Boxes of one image that show the same thing twice: a detector's doubles are one sighting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import Rays, cast_rays
from valuemap.dataset import Dataset

DOUBLE_OVERLAP = 0.5
"""Boxes whose intersection is at least this share of their union are of one thing: what the non-maximum suppression of
detectors and the PASCAL VOC challenge (Everingham et al., IJCV 2010, section 4.2) take for the same object."""
DOUBLE_APART_PX = 2.0
"""So are boxes whose centres are no farther apart: edges are known to about a pixel, and small boxes overlap less."""


def cast_sightings(dataset: Dataset) -> tuple[Rays, Bools]:
    """Return the viewing rays of a dataset, none where a detection (N) is a double; and which those are."""
    is_double = find_doubles(dataset)
    return cast_rays(dataset, is_left_out=is_double), is_double


def find_doubles(dataset: Dataset) -> Bools:
    """Return which detections (N) are another sight of what a better one of the same image and class shows.

    The better one has the higher score, then the larger box, then stands farther left and up; what overlaps with a
    double alone is none (greedy non-maximum suppression).
    """
    detections = dataset.detections
    first, second = _overlapping(
        detections.image_id, detections.class_name.codes, detections.center_px, detections.size_px
    )
    score = np.zeros(len(detections)) if detections.score is None else np.nan_to_num(detections.score)
    area_px2 = detections.size_px.prod(axis=1)
    order = np.lexsort((*detections.center_px.T, -area_px2, -score))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    swap = rank[first] > rank[second]
    better, worse = np.where(swap, second, first), np.where(swap, first, second)
    is_double = np.zeros(len(detections), dtype=np.bool_)
    while len(better):
        # Those that no undecided better one overlaps stand; what they overlap are doubles.
        waits = np.zeros(len(detections), dtype=np.bool_)
        waits[worse] = True
        stands = ~waits[better]
        is_double[worse[stands]] = True
        is_open = ~(is_double[better] | is_double[worse])
        better, worse = better[is_open], worse[is_open]
    return is_double


def _overlapping(
    image_id: Ints, class_code: NDArray[np.int32], center_px: Floats, size_px: Floats
) -> tuple[Ints, Ints]:
    """Return the rows of all pairs of boxes of one image and class that show one thing."""
    order = np.lexsort((center_px[:, 0], class_code, image_id))
    image, code = np.asarray(image_id)[order], np.asarray(class_code)[order]
    center, size = center_px[order], size_px[order]
    reach_px = np.maximum(size[:, 0].max(initial=0.0), DOUBLE_APART_PX)
    pairs: list[tuple[Ints, Ints]] = []
    rows = np.arange(len(order))
    step = 0
    while len(rows):
        step += 1
        rows = rows[rows + step < len(order)]
        other = rows + step
        is_near = (image[rows] == image[other]) & (code[rows] == code[other])
        is_near &= center[other, 0] - center[rows, 0] <= reach_px
        rows, other = rows[is_near], other[is_near]
        is_one = _are_one(center[rows], size[rows], center[other], size[other])
        pairs.append((order[rows[is_one]], order[other[is_one]]))
    none = [np.empty(0, np.int64)]
    return np.concatenate(none + [row for row, _ in pairs]), np.concatenate(none + [other for _, other in pairs])


def _are_one(center_px: Floats, size_px: Floats, other_center_px: Floats, other_size_px: Floats) -> Bools:
    """Return which boxes (K) show the same as others (K)."""
    apart_px = np.abs(center_px - other_center_px)
    common_px = np.clip(
        np.minimum(0.5 * (size_px + other_size_px) - apart_px, np.minimum(size_px, other_size_px)), 0.0, None
    )
    common_px2 = common_px.prod(axis=1)
    union_px2 = size_px.prod(axis=1) + other_size_px.prod(axis=1) - common_px2
    is_one: Bools = (common_px2 >= DOUBLE_OVERLAP * union_px2) | (np.linalg.norm(apart_px, axis=1) <= DOUBLE_APART_PX)
    return is_one
