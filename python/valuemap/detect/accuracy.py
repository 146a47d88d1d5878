"""How good a detector is: its boxes against labelled ones, as in PASCAL VOC and COCO.

In each picture, boxes in the order of their scores take the free label that they overlap most, if the intersection
over union (IoU) reaches a threshold. Such a box is right, any other is false, and a label that nobody took is missed.
Where only labels of some heights count, others are neither found nor missed: a box that takes one of them does not
count, nor does one of another height that takes none.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.detect.boxes import Boxes, overlaps
from valuemap.detect.labels import LabelledPictures
from valuemap.errors import SettingError

IOU_THRESHOLDS = (0.3, 0.5)
HEIGHT_BOUNDS_PX = (0.0, 12.0, 24.0, 48.0, math.inf)
"""Heights at which the figures are split."""

_NOBODY = -1


@dataclass(frozen=True, eq=False)
class FoundBoxes:
    """The boxes found in one picture: (N, 4) centre x, y, width, height in px, scores and class names."""

    boxes_px: Floats
    score: Floats
    classes: Sequence[str]


@dataclass(frozen=True)
class Accuracy:
    """Figures at one IoU threshold; NaN where there is nothing to measure.

    Recall, precision and mean IoU (of the right boxes) count the boxes of at least `min_score`; the average
    precision (area below the precision, made monotonic, over the recall) counts all boxes. `best_f1` is the
    largest harmonic mean of recall and precision over all thresholds of the score, reached at `best_score`.
    """

    labels: int
    right: int
    false: int
    recall: float
    precision: float
    average_precision: float
    mean_iou: float
    best_f1: float
    best_score: float

    def to_json(self) -> dict[str, Any]:
        """Return the figures by name, None where there is nothing to measure."""
        return {
            name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in vars(self).items()
        }


@dataclass(frozen=True)
class DetectionEvaluation:
    """Accuracies by IoU threshold, over all heights and by height in px; `notes` say what a reader must know."""

    pictures: int
    unlabelled_pictures: int
    min_score: float
    min_height_px: float
    overall: Mapping[float, Accuracy]
    by_height: Mapping[tuple[float, float], Mapping[float, Accuracy]]
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all figures by name."""
        return {
            "pictures": self.pictures,
            "unlabelled_pictures": self.unlabelled_pictures,
            "min_score": self.min_score,
            "min_height_px": self.min_height_px,
            **{f"iou_{iou:g}": accuracy.to_json() for iou, accuracy in self.overall.items()},
            "by_height": [
                {
                    "min_px": low,
                    "max_px": None if math.isinf(high) else high,
                    **{f"iou_{iou:g}": accuracy.to_json() for iou, accuracy in each.items()},
                }
                for (low, high), each in self.by_height.items()
            ],
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class _Pair:
    """One picture: found boxes, best first, and labels, with the classes as numbers; ignored ones are no labels."""

    found: Boxes
    labels: Boxes
    is_ignored: Bools


def evaluate_boxes(
    found: Mapping[Path, FoundBoxes],
    labels: LabelledPictures,
    *,
    min_score: float = 0.0,
    min_height_px: float = 0.0,
) -> DetectionEvaluation:
    """Compare boxes with labels, picture by picture.

    Only pictures on both sides count; a picture in which nothing was found is in `found` without boxes. Classes must
    agree if any name occurs on both sides; else they are not compared.

    Raises
    ------
    SettingError
        `min_score` or `min_height_px` is impossible.
    """
    if not math.isfinite(min_score):
        raise SettingError(f"--min-score: expected a number, found {min_score}", hint="for example 0.3")
    if not 0.0 <= min_height_px < math.inf:
        raise SettingError(f"--min-height: expected 0 px or more, found {min_height_px}", hint="for example 24")
    pictures = [picture for picture in labels.pictures if picture.path in found]
    names = {name for picture in pictures for name in picture.classes}
    found_names = {name for boxes in found.values() for name in boxes.classes}
    compares_classes = bool(names & found_names)
    number = {name: i if compares_classes else 0 for i, name in enumerate(sorted(names | found_names))}
    pairs = [
        _pair(found[picture.path], picture.boxes_px, picture.classes, picture.ignored_px, number)
        for picture in pictures
    ]
    notes = []
    if names and found_names and not compares_classes:
        notes.append(
            f"classes are not compared: the labels have {', '.join(sorted(names))}, "
            f"the detections {', '.join(sorted(found_names))}"
        )
    if len(pictures) < len(labels.pictures):
        notes.append(f"{len(labels.pictures) - len(pictures)} labelled pictures were not looked at and do not count")
    if labels.skipped:
        notes.append(f"{len(labels.skipped)} labels or pictures cannot be used, the first: {labels.skipped[0]}")
    bounds = itertools.pairwise(HEIGHT_BOUNDS_PX)

    def measure(low: float, high: float) -> dict[float, Accuracy]:
        return {iou: _measure(pairs, iou, max(low, min_height_px), high, min_score) for iou in IOU_THRESHOLDS}

    return DetectionEvaluation(
        pictures=len(pictures),
        unlabelled_pictures=len(found.keys() - {picture.path for picture in pictures}),
        min_score=min_score,
        min_height_px=min_height_px,
        overall=measure(0.0, math.inf),
        by_height={(low, high): measure(low, high) for low, high in bounds if high > min_height_px},
        notes=tuple(notes),
    )


def _pair(
    found: FoundBoxes,
    labels_px: Floats,
    classes: Iterable[str],
    ignored_px: Floats,
    number: Mapping[str, int],
) -> _Pair:
    def boxes(place: Floats, score: Floats, names: Iterable[str]) -> Boxes:
        codes = np.array([number[name] for name in names], dtype=np.int64)
        return Boxes(place[:, :2], place[:, 2:], score, codes)

    order = np.lexsort((found.boxes_px[:, 1], found.boxes_px[:, 0], -found.score))
    known = boxes(labels_px, np.ones(len(labels_px)), classes)
    ignored = Boxes(ignored_px[:, :2], ignored_px[:, 2:], np.ones(len(ignored_px)), np.full(len(ignored_px), _NOBODY))
    return _Pair(
        boxes(found.boxes_px, found.score, found.classes).take(order),
        Boxes.together([known, ignored]),
        np.arange(len(known) + len(ignored)) >= len(known),
    )


def _measure(pairs: Sequence[_Pair], min_iou: float, low_px: float, high_px: float, min_score: float) -> Accuracy:
    """Measure over the labels with a height from `low_px` to below `high_px`."""
    scores, rights, ious, count = [np.empty(0)], [np.empty(0, np.bool_)], [np.empty(0)], 0
    for pair in pairs:
        height = pair.labels.size_px[:, 1]
        counts = ~pair.is_ignored & (height >= low_px) & (height < high_px)
        count += int(counts.sum())
        taken, iou = _take_labels(pair, counts, min_iou)
        found_height = pair.found.size_px[:, 1]
        is_right = (taken >= 0) & np.append(counts, False)[taken]
        is_false = (taken < 0) & (found_height >= low_px) & (found_height < high_px)
        matters = is_right | is_false
        scores.append(pair.found.score[matters])
        rights.append(is_right[matters])
        ious.append(iou[matters])
    return _figures(np.concatenate(scores), np.concatenate(rights), np.concatenate(ious), count, min_score)


def _take_labels(pair: _Pair, counts: Bools, min_iou: float) -> tuple[Ints, Floats]:
    """Return for each found box the row of the label that it takes, or -1, and their IoU."""
    overlap, _ = overlaps(pair.found, pair.labels)
    is_allowed = pair.found.class_code[:, None] == pair.labels.class_code[None]
    overlap = np.where(is_allowed | pair.is_ignored[None], overlap, 0.0)
    taken = np.full(len(pair.found), _NOBODY)
    iou = np.zeros(len(pair.found))
    is_free = np.ones(len(pair.labels), np.bool_)
    for row in np.flatnonzero((overlap >= min_iou).any(axis=1)):  # In the order of the scores, as each takes one away.
        reach = np.where(is_free, overlap[row], 0.0)
        for group in (counts, ~counts):  # Labels that count go first.
            candidates = np.where(group & (reach >= min_iou), reach, 0.0)
            if candidates.any():
                best = int(np.argmax(candidates))
                taken[row], iou[row] = best, candidates[best]
                is_free[best] = bool(pair.is_ignored[best])  # Any number of boxes may lie in an ignored place.
                break
    return taken, iou


def _figures(score: Floats, is_right: Bools, iou: Floats, labels: int, min_score: float) -> Accuracy:
    order = np.argsort(-score, kind="stable")
    score, is_right, iou = score[order], is_right[order], iou[order]
    right = np.cumsum(is_right)
    # Boxes of one score come together: no threshold can part them.
    last = np.flatnonzero(np.append(score[1:] < score[:-1], True)) if len(score) else np.empty(0, np.int64)
    recall = right[last] / labels if labels else np.full(len(last), math.nan)
    precision = right[last] / (last + 1)
    counted = score >= min_score
    hits = int(is_right[counted].sum())
    best, best_score = math.nan, math.nan
    if labels and right.any():
        f1 = 2.0 * right[last] / (last + 1 + labels)
        row = int(np.argmax(f1))
        best, best_score = float(f1[row]), float(score[last[row]])
    return Accuracy(
        labels=labels,
        right=hits,
        false=int(counted.sum()) - hits,
        recall=hits / labels if labels else math.nan,
        precision=hits / int(counted.sum()) if counted.any() else math.nan,
        average_precision=_area(recall, precision) if labels else math.nan,
        mean_iou=float(iou[counted & is_right].mean()) if hits else math.nan,
        best_f1=best,
        best_score=best_score,
    )


def _area(recall: Floats, precision: Floats) -> float:
    """Return the area below the precision over the recall, each precision at least that at any larger recall."""
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall, prepend=0.0) * envelope))
