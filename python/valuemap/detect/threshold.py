"""Which threshold finds the validation pictures' objects best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints
from valuemap.detect.boxes import Boxes, intersections, overlaps
from valuemap.detect.components import boxes_of_components

THRESHOLDS = np.round(np.arange(0.1, 0.91, 0.1), 2)
MIN_IOU = 0.3
_MAX_IGNORED = 0.5
"""A box of which more than this lies in a place to ignore counts neither way."""


@dataclass
class ThresholdSearch:
    """Counts of found, missed and false boxes at every threshold, picture by picture."""

    minimum_component_px: int

    def __post_init__(self) -> None:
        self._true = np.zeros(len(THRESHOLDS), np.int64)
        self._false = np.zeros(len(THRESHOLDS), np.int64)
        self._objects = 0

    def add(self, probability: NDArray[Any], edges_px: Floats, class_code: Ints, ignored_edges_px: Floats) -> None:
        """Count one picture: probabilities (classes, H, W), its boxes and its places to ignore."""
        self._objects += len(edges_px)
        ignored = _boxes(ignored_edges_px)
        for code, of_class in enumerate(probability):
            truth = _boxes(edges_px[class_code == code])
            for place, threshold in enumerate(THRESHOLDS):
                found = boxes_of_components(of_class, float(threshold), self.minimum_component_px)
                is_true = match(found, truth)
                self._true[place] += is_true.sum()
                self._false[place] += (~is_true & ~_is_ignored(found, ignored)).sum()

    def best(self) -> tuple[float, float, float]:
        """Return threshold, recall and precision where their harmonic mean is highest."""
        recall = self._true / max(self._objects, 1)
        precision = self._true / np.maximum(self._true + self._false, 1)
        f1 = 2.0 * recall * precision / np.maximum(recall + precision, 1e-12)
        # Where several are as good (none is any good at first), the middle one is safest.
        places = np.flatnonzero(f1 >= f1.max() - 1e-12)
        place = int(places[len(places) // 2])
        return float(THRESHOLDS[place]), float(recall[place]), float(precision[place])


def match(found: Boxes, truth: Boxes) -> Bools:
    """Return which found boxes are true: the better score first takes the free object it overlaps most."""
    is_true = np.zeros(len(found), dtype=np.bool_)
    if len(found) == 0 or len(truth) == 0:
        return is_true
    iou, _ = overlaps(found, truth)
    for row in np.argsort(-found.score, kind="stable"):
        column = int(np.argmax(iou[row]))
        if iou[row, column] >= MIN_IOU:
            is_true[row] = True
            iou[:, column] = -1.0
    return is_true


def _is_ignored(found: Boxes, ignored: Boxes) -> Bools:
    if len(found) == 0 or len(ignored) == 0:
        return np.zeros(len(found), dtype=np.bool_)
    common = intersections(found, ignored).prod(axis=2).max(axis=1)
    is_ignored: Bools = common > _MAX_IGNORED * found.size_px.prod(axis=1)
    return is_ignored


def _boxes(edges_px: Floats) -> Boxes:
    return Boxes.from_edges(edges_px, np.ones(len(edges_px)), np.zeros(len(edges_px)))
