"""Boxes of one picture that are listed with the next one, too: a detector that gave its last answer again.

No number of a box stays the same to the last digit while the car drives, but by rounding. How often that makes it so,
boxes tell that are near each other in successive pictures and differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers
from valuemap.check.boxes import rows_in_images
from valuemap.check.fault import LEAST_CHANCE, Fault, Finding, Stage, View, keep_rows
from valuemap.check.sample import drive_of_camera, order_by_camera, standing_m
from valuemap.dataset import Dataset

_MOST_ROUNDED = 0.05
"""Where rounding makes more than one in twenty of the numbers equal that differ otherwise, all four of a box are equal
by rounding far more often than each would be alone: what is far ahead hardly moves."""
_APART = 1e6
"""Pictures, and classes, are farther from each other than boxes in one picture, in px."""


class RepeatedDetections(Fault):
    """Boxes that are there again in the next image."""

    name: ClassVar[str] = "repeated_detections"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look for boxes of successive images of a car that drives that are equal in all numbers."""
        repeats = find_repeats(view.dataset)
        if repeats is None or repeats.chance > LEAST_CHANCE:
            return None
        count, images = int(repeats.is_repeated.sum()), repeats.images
        return Finding(
            fault=self.name,
            what="Boxes are there again in the next image, equal to the last digit.",
            why=f"{count} of {len(repeats.is_repeated)} boxes, in {images} images, are those of the image before, "
            f"though the car drives on; by rounding it would be {repeats.by_rounding:.2g} of them.",
            do="List each box with the image that it was found in: was an answer given again while the next one was "
            "not ready, or a picture written twice?",
            chance=repeats.chance,
            figures={"repeated": count, "boxes": len(repeats.is_repeated), "images": images},
            fix=_without_repeats,
        )


@dataclass(frozen=True, eq=False)
class Repeats:
    """Which boxes (N) are those of the image before, in so many images, and how likely that is by rounding.

    `by_rounding` is how many would be, at most.
    """

    is_repeated: Bools
    images: int
    by_rounding: float
    chance: float


def find_repeats(dataset: Dataset, *, is_driving: bool = True) -> Repeats | None:
    """Look for boxes of successive images that are equal, of a car that drives or of any.

    None where no box is near one of the image before.
    """
    images, detections = dataset.images, dataset.detections
    order, center = order_by_camera(images), camera_centers(images)
    step_m = np.linalg.norm(np.diff(center[order], axis=0), axis=1)
    goes_on = np.diff(drive_of_camera(images)[order]) == 0
    drives_on = np.append(False, goes_on & ((step_m > standing_m(step_m[goes_on])) | (not is_driving)))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    row = rows_in_images(dataset)
    values: Floats = np.concatenate([detections.center_px, detections.size_px], axis=1)
    place = np.column_stack([detections.center_px, _APART * rank[row], _APART * detections.class_name.codes])
    later = np.flatnonzero(drives_on[rank[row]])
    if not len(later):
        return None
    back = np.array([0.0, 0.0, _APART, 0.0])
    away, near = (
        np.asarray(each) for each in cKDTree(place).query(place[later] - back, k=2, distance_upper_bound=_APART / 2.0)
    )
    is_there = np.isfinite(away)
    same: Bools = values[np.where(is_there, near, 0)] == values[later, None]
    is_equal: Bools = is_there & same.all(axis=2)
    others: Bools = is_there & ~is_equal
    has_other = others.any(axis=1)
    of_other = same[has_other, np.argmax(others[has_other], axis=1)]
    if not len(of_other):
        return None
    rounded = (1.0 + float(of_other[:, :2].sum(axis=0).min())) / (2.0 + len(of_other))
    is_repeated = np.zeros(len(row), dtype=np.bool_)
    is_repeated[later[is_equal.any(axis=1)]] = True
    tried = int(is_there[:, 0].sum())
    chance = 1.0 if rounded > _MOST_ROUNDED else float(stats.binom.sf(is_repeated.sum() - 1, tried, rounded))
    return Repeats(is_repeated, len(np.unique(row[is_repeated])), tried * rounded, chance)


def _without_repeats(dataset: Dataset) -> Dataset:
    repeats = find_repeats(dataset, is_driving=False)  # What is given again is so where the car stands, too.
    return dataset if repeats is None else keep_rows(dataset, detections=~repeats.is_repeated)
