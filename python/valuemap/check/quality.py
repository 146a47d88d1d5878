"""Faults of the rows themselves: duplicates, strays, coarse values, names, scores, truth."""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from typing import Any, ClassVar

import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers
from valuemap.check.agreement import chance_of_majority
from valuemap.check.boxes import rows_in_images
from valuemap.check.fault import LEAST_CHANCE, WHICH_PASS, Fault, Finding, Stage, View, keep_rows, with_detections
from valuemap.check.offsets import find_shift
from valuemap.check.sample import FASTER, drive_of_camera, order_by_camera, steps_along_drives
from valuemap.dataset import Dataset
from valuemap.tables import Categories, Images, Truth

_SAME_SHARE = 0.05
"""Boxes of one class whose centres and sizes differ by less than this share of their size are one box, twice."""
_SAME_PX = 0.5
_LEAST_DUPLICATES = 0.05
_FAR_TIMES = 10.0
_MOST_FAR = 0.05
_COARSE_PX = 1.5


class RepeatedBoxes(Fault):
    """Every box twice."""

    name: ClassVar[str] = "repeated_boxes"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look for boxes of one image and class that cover each other."""
        repeated = _repeated_boxes(view.dataset)
        count, total = int(repeated.sum()), len(repeated)
        if count < max(3, _LEAST_DUPLICATES * total):
            return None
        return Finding(
            fault=self.name,
            what="Boxes are there twice.",
            why=f"{count} of {total} boxes lie on another of their image and class ({_SAME_SHARE:.0%} of its size).",
            do="Remove the copies: was a file read twice, or non-maximum suppression left out?",
            figures={"repeated": count, "boxes": total},
            fix=lambda dataset: keep_rows(dataset, detections=~_repeated_boxes(dataset)),
        )


class RepeatedImages(Fault):
    """The same image twice."""

    name: ClassVar[str] = "repeated_images"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look for images with the same pose and the same detections."""
        repeated = _repeated_images(view.dataset)
        count = int(repeated.sum())
        if count == 0:
            return None
        return Finding(
            fault=self.name,
            what="Images are there twice.",
            why=f"{count} of {len(repeated)} images have the pose and the boxes of another one.",
            do="Remove the copies: they count as witnesses of their own and make labels look surer than they are.",
            figures={"repeated": count, "images": len(repeated)},
            fix=lambda dataset: keep_rows(dataset, images=~_repeated_images(dataset)),
        )


class FarImages(Fault):
    """Images far from the rest."""

    name: ClassVar[str] = "far_images"
    stage: ClassVar[Stage] = "positions"  # Of poses read wrongly, positions jump.

    def find(self, view: View) -> Finding | None:
        """Look for few images much farther from the middle than all others, or far from the rest of their drive."""
        far = _far_or_stray(view.dataset.images)
        count = int(far.sum())
        if count == 0:
            return None
        center = view.center_in_world_m
        middle = np.median(center, axis=0)
        nearest = float(np.linalg.norm(center[far] - middle, axis=1).min())
        extent = float(np.linalg.norm(center[~far] - middle, axis=1).max())
        apart_m = float(np.asarray(cKDTree(center[~far]).query(center[far])[0]).min())
        names = view.dataset.images.name.take(np.flatnonzero(far)[:3]).to_pylist()
        is_nowhere = bool(nowhere(view.dataset.images).all(where=far))
        where = (
            "at places that their drives jump to and back from again and again"
            if is_nowhere
            else f"{nearest:.4g} m or more from the middle, the others within {extent:.4g} m"
            if nearest > extent
            else f"{apart_m:.4g} m or more from all others, and most of them a jump away from where their drive goes on"
        )
        return Finding(
            fault=self.name,
            what=f"Some images are {'where no car was' if is_nowhere else 'far from all others'}.",
            why=f"{count} of {len(far)} images are {where}: {', '.join(names)}{' and more' if count > 3 else ''}.",
            do="Remove them, or repair their positions (no GPS fix? 0, 0?).",
            figures={
                "far": count,
                "from_m": round(nearest, 1),
                "others_within_m": round(extent, 1),
                "apart_m": round(apart_m, 1),
            },
            fix=lambda dataset: _without_far(dataset),
        )


class QuantisedBoxes(Fault):
    """Centres on a coarse grid."""

    name: ClassVar[str] = "quantised_boxes"
    stage: ClassVar[Stage] = "results"  # Boxes of pictures of another size are on another grid.

    def find(self, view: View) -> Finding | None:
        """Look for a step of more than a pixel that all centres keep to."""
        steps = [_grid_step(view.dataset.detections.center_px[:, axis]) for axis in (0, 1)]
        coarse = max(step or 0.0 for step in steps)
        if coarse <= _COARSE_PX:
            return None
        shown = " and ".join(f"{step:.3g} px in {axis}" for step, axis in zip(steps, "xy", strict=True) if step)
        return Finding(
            fault=self.name,
            what="The centres of the boxes are on a coarse grid.",
            why=f"All of them are multiples of {shown} (from one another).",
            do="Write the detector's full numbers. If there are none, map with --set "
            f"detection_sigma_px={max(1.0, coarse / 3.46):.2g} or more.",
            figures={"step_px": [None if step is None else round(step, 4) for step in steps]},
        )


class ClassSpelling(Fault):
    """Classes that differ only in case, spaces, underscores or a plural s."""

    name: ClassVar[str] = "class_spelling"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Compare the names of the classes of detections and truth."""
        groups = _spellings(view.dataset)
        if not groups:
            return None
        shown = "; ".join(" and ".join(repr(name) for name in sorted(names)) for names in groups)
        return Finding(
            fault=self.name,
            what="Classes differ only in capitals, spaces, hyphens, underscores or a plural s.",
            why=f"There are {shown}: detections of them never support each other, and labels match no truth.",
            do="Spell each class one way.",
            figures={"classes": [sorted(names) for names in groups]},
            fix=_with_one_spelling,
        )


class EqualScores(Fault):
    """All scores equal."""

    name: ClassVar[str] = "equal_scores"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """See whether scores say anything; 1 is what a reader writes where there are none."""
        score = view.dataset.detections.score
        if len(score) < 10 or np.ptp(score) > 0.0 or score[0] == 1.0:
            return None
        return Finding(
            fault=self.name,
            what="All detections have the same score.",
            why=f"All {len(score)} scores are {score[0]:.4g}.",
            do="Write the detector's own scores: they say which detections to believe. Without any, write 1.",
            figures={"score": float(score[0]), "detections": len(score)},
        )


class TruthElsewhere(Fault):
    """Truth that is far off, or in another frame."""

    name: ClassVar[str] = "truth_elsewhere"
    stage: ClassVar[Stage] = "results"
    # Truth in metres is not where such a world's is. Of two passes that are apart it may be with either.
    explained_by: ClassVar[frozenset[str]] = frozenset({"scale", WHICH_PASS})

    def find(self, view: View) -> Finding | None:
        """Look for the shift, after other orders of axes, by which most points where rays meet get an object."""
        truth, points = view.dataset.truth, certain_points(view)
        if truth is None or len(truth) < _LEAST_TRUTH or len(points) < _LEAST_TRUTH or not view.meets:
            return None
        tolerance_m = max(view.step_m / 2.0, 1e-9)
        objects = flattened(truth.position_in_world_m, truth, view)
        points = flattened(points, truth, view)
        here = matches(points, objects, tolerance_m)
        if here >= ENOUGH_TRUTH * min(len(points), len(objects)):
            return None
        there, how, fix = here, "", None
        for name, axes in _TRUTH_AXES.items():
            turned = objects @ np.array(axes, dtype=np.float64).T
            shift = find_shift(turned, points, tolerance_m, within_m=None)
            if shift is None:
                continue
            matched = matches(points, turned + shift.offset_m, tolerance_m)
            if matched > there:
                moved_m = float(np.linalg.norm(shift.offset_m))
                there, how = matched, f" With {name} and a shift of {moved_m:.4g} m, {matched} have one."
                fix = _MovedTruth(np.array(axes, dtype=np.float64), shift.offset_m)
        # By a shift to any pair, in any axes, chance matches some: those that are then matched are counted anew.
        tests = len(points) * len(objects) * len(_TRUTH_AXES)
        chance = chance_of_majority(there, there + here) * tests if there > here else 1.0
        fits = fix is not None and chance < LEAST_CHANCE
        if not fits and (here > 0 or _is_nearest_where_it_is(points, objects, view)):
            return None  # It may well know other objects than are seen here, or poses are metres off.
        distance = _median_distance(points, objects)
        return Finding(
            fault=self.name,
            what="The truth is not where the rays meet: another frame, or far off.",
            why=f"Of {len(points)} points where many rays meet {here} have a true object within {tolerance_m:.2g} m; "
            f"the median distance is {distance:.4g} m.{how if fits else ' No shift or order of axes makes it fit.'}",
            do="Give the truth in the dataset's frame.",
            chance=min(chance, 1.0) if fits else None,
            figures={
                "points": len(points),
                "matched": here,
                "matched_if_moved": there if fits else here,
                "median_distance_m": round(distance, 2),
            },
            fix=fix if fits else None,
        )


_LEAST_TRUTH = 3
ENOUGH_TRUTH = 0.25
"""Truth that knows this share of the places where rays meet is in their frame."""
_TRUTH_AXES: dict[str, list[list[float]]] = {
    "its axes as they are": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "x and y exchanged": [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
    "x, y, z as east, south, down": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "x, y, z as north, east, down": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    "y up": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "y down": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}


def flattened(points: Floats, truth: Truth, view: View) -> Floats:
    """Return points (N, 3) as they are, or where the truth knows no heights (all are equal) on the ground."""
    up = np.array(view.dataset.frame.up)
    if float(np.ptp(truth.position_in_world_m @ up)) > 0.0:
        return points
    return np.asarray(points - (points @ up)[:, None] * up)


class _MovedTruth:
    """Truth in other axes, then moved."""

    def __init__(self, axes: Floats, offset_m: Floats) -> None:
        self._axes, self._offset_m = axes, offset_m

    def __call__(self, dataset: Dataset) -> Dataset:
        assert dataset.truth is not None
        position = dataset.truth.position_in_world_m @ self._axes.T + self._offset_m
        return Dataset(**{**vars(dataset), "truth": dataset.truth.replace(position_in_world_m=position)})


def certain_points(view: View) -> Floats:
    """Return the points (N, 3) where rays of many images meet: the half with most votes."""
    found, point = view.agreement.found, view.agreement.points_in_world_m
    votes = np.diff(found.voter_offsets)
    if not len(votes):
        return np.empty((0, 3))
    certain = votes >= max(5.0, float(np.median(votes)))
    return np.asarray(point[certain])


def _is_nearest_where_it_is(points: Floats, objects: Floats, view: View) -> bool:
    """Return whether objects are nearer to points than if all were moved on the ground by twice as far, any way."""
    here = _median_distance(points, objects)
    east, north = view.dataset.frame.east_north()
    ways = [np.cos(angle) * east + np.sin(angle) * north for angle in np.linspace(0.0, 2.0 * np.pi, _WAYS, False)]
    return all(here < _median_distance(points, objects + 2.0 * here * way) for way in ways)


_WAYS = 16
"""Ways round, 22.5 degrees apart: a shift between two of them is 2 % shorter along the nearest."""


def _median_distance(points: Floats, objects: Floats) -> float:
    return float(np.median(cKDTree(objects).query(points)[0]))


def matches(points: Floats, objects: Floats, within_m: float) -> int:
    """Return how many points (N, D) have an object (M, D) within a distance."""
    return int((np.asarray(cKDTree(objects).query(points)[0]) <= within_m).sum())


def _repeated_boxes(dataset: Dataset) -> Bools:
    """Return which boxes (N) have a better one, or one as good before them, in the same place."""
    detections = dataset.detections
    image, code = rows_in_images(dataset), detections.class_name.codes
    order = np.lexsort((detections.center_px[:, 1], detections.center_px[:, 0], code, image))
    repeated = np.zeros(len(order), dtype=np.bool_)
    size = np.maximum(detections.size_px, 1.0)
    # Copies lie side by side in this order, but for rare boxes in between: three neighbours are looked at.
    for lag in (1, 2, 3):
        first, second = order[:-lag], order[lag:]
        same = (image[first] == image[second]) & (code[first] == code[second])
        smaller = np.minimum(size[first], size[second])
        apart = np.abs(detections.center_px[first] - detections.center_px[second])
        same &= (apart <= np.maximum(_SAME_SHARE * smaller, _SAME_PX)).all(axis=1)
        same &= (np.abs(size[first] - size[second]) <= np.maximum(2.0 * _SAME_SHARE * smaller, _SAME_PX)).all(axis=1)
        first, second = first[same], second[same]
        worse_is_second = (detections.score[second] < detections.score[first]) | (
            (detections.score[second] == detections.score[first]) & (second > first)
        )
        repeated[np.where(worse_is_second, second, first)] = True
    return repeated


def _repeated_images(dataset: Dataset) -> Bools:
    """Return which images (N) have the camera, pose and boxes of an earlier one; those without boxes do not count."""
    images, detections = dataset.images, dataset.detections
    row = rows_in_images(dataset)
    order = np.lexsort((detections.center_px[:, 1], detections.center_px[:, 0], row))
    count = np.bincount(row, minlength=len(images))
    first = np.cumsum(count) - count
    pose = np.concatenate(
        [images.cam_from_world_quat, images.cam_from_world_m, images.camera_id[:, None].astype(np.float64)], axis=1
    )
    by_pose: dict[Any, list[int]] = defaultdict(list)
    for row_with_boxes in np.flatnonzero(count).tolist():
        by_pose[pose[row_with_boxes].tobytes()].append(row_with_boxes)
    repeated = np.zeros(len(images), dtype=np.bool_)
    for alike in by_pose.values():
        seen: set[bytes] = set()
        if len(alike) < 2:
            continue
        for image in alike:
            rows = order[first[image] : first[image] + count[image]]
            boxes = detections.center_px[rows].tobytes() + detections.size_px[rows].tobytes()
            repeated[image] = boxes in seen
            seen.add(boxes)
    return repeated


def far_images(center: Floats) -> Bools:
    """Return which of some places (N, D) are ten times farther from the middle than 95 % of all, and none between."""
    distance = np.linalg.norm(center - np.median(center, axis=0), axis=1)
    usual = float(np.quantile(distance, 1.0 - _MOST_FAR))
    far: Bools = distance > _FAR_TIMES * usual
    if usual == 0.0 or not np.any(far) or len(center) < 10:
        return np.zeros(len(center), dtype=np.bool_)
    return far


def strays(images: Images) -> Bools:
    """Return which images (N) are a jump away from their drive, which goes on behind them where it was before them.

    Where others are as near as on a drive, a car was, and it is the order of the images that is wrong.
    """
    order = order_by_camera(images)
    center = camera_centers(images)[order]
    step_m, starts, usual_m = steps_along_drives(center, drive_of_camera(images)[order])
    found = np.zeros(len(order), dtype=np.bool_)
    jumps = ~starts & (step_m > _STRAY_STEPS * usual_m)
    if jumps.sum() > _MOST_FAR * len(order):
        return found  # Of images in no order all steps are jumps.
    cuts = np.flatnonzero(jumps | starts) + 1
    for first, last in itertools.pairwise(cuts.tolist()):
        returns = jumps[first - 1] and jumps[last - 1]
        way_on_m = float(np.linalg.norm(center[last] - center[first - 1]))
        if returns and last - first <= _MOST_STRAYS and way_on_m <= FASTER * usual_m * (last - first + 1):
            found[order[first:last]] = True
    if found.any():
        rows, center = np.flatnonzero(found), camera_centers(images)
        apart_m = np.asarray(cKDTree(center[~found]).query(center[rows])[0])
        found[rows[apart_m <= FASTER * usual_m]] = False
    return found


_STRAY_STEPS, _MOST_STRAYS = 50.0, 10
"""No car is fifty steps away for some images, without having been seen on the way, and back at once."""


def nowhere(images: Images) -> Bools:
    """Return which images (N) are at a place that drives jump to and back from again and again, to the millimetre.

    It is what a receiver without a fix writes: 0, 0 as a rule. No car comes back so exactly.
    """
    order = order_by_camera(images)
    center = np.round(camera_centers(images)[order], _MILLIMETRES)
    step_m, ends, usual_m = steps_along_drives(center, drive_of_camera(images)[order])
    found = np.zeros(len(order), dtype=np.bool_)
    if not np.isfinite(usual_m):
        return found
    jumps = ~ends & (step_m > _NOWHERE_STEPS * usual_m)
    visit = np.append(0, np.cumsum(ends | (step_m > 0.0)))
    first = np.flatnonzero(np.diff(visit, prepend=-1))
    last = np.append(first[1:], len(order)) - 1
    (comes, is_first), (goes, is_last) = (
        (np.append(False, jumps)[first], np.append(True, ends)[first]),
        (np.append(jumps, False)[last], np.append(ends, True)[last]),
    )
    is_reached = (comes & (goes | is_last)) | (goes & is_first)
    _, place, visits = np.unique(center[first[is_reached]], axis=0, return_inverse=True, return_counts=True)
    at_none = np.zeros(len(first), dtype=np.bool_)
    at_none[is_reached] = visits[place.ravel()] >= _LEAST_VISITS
    found[order] = at_none[visit]
    return found


_MILLIMETRES = 3
"""Decimals of a metre: positions are made of rotations and translations, and exact to less."""
_NOWHERE_STEPS, _LEAST_VISITS = 8.0, 3
"""Positions that are rounded come back, too, but from the next ones on their grid."""


def _far_or_stray(images: Images) -> Bools:
    return far_images(camera_centers(images)) | strays(images) | nowhere(images)


def _without_far(dataset: Dataset) -> Dataset:
    return keep_rows(dataset, images=~_far_or_stray(dataset.images))


def _grid_step(values: Floats) -> float | None:
    """Return the step of the grid that values (N) are on, None where there is none of more than a thousandth."""
    distinct = np.unique(np.round(values, 6))
    # On a grid there are few values for many rows, or all gaps are multiples of the smallest.
    gaps = np.diff(distinct)
    if len(distinct) < 5 or len(values) < 20:
        return None
    step = float(gaps.min())
    multiple = gaps / step
    if step < 1e-3 or np.abs(multiple - np.round(multiple)).max() > 0.01:
        return None
    # A handful of values may have a common divisor by accident; hundreds of gaps do not.
    return step if len(values) > 2 * len(distinct) or len(distinct) > 30 else None


def _key(name: str) -> str:
    """Return a name without capitals, what separates its words, and a plural's s; codes as W1-11, 3.5 and C3s stay."""
    parts = [part for part in _NO_LETTERS.split(name.casefold()) if part]
    key = parts[0] if parts else ""
    for part in parts[1:]:
        key += f"-{part}" if key[-1].isdigit() and part[0].isdigit() else part
    return _PLURAL.sub("", key)


_NO_LETTERS = re.compile(r"[\W_]+")
_PLURAL = re.compile(r"(?<=[^\W\d_]{3})s$")


def _spellings(dataset: Dataset) -> list[set[str]]:
    groups: dict[str, set[str]] = defaultdict(set)
    columns = [dataset.detections.class_name] + ([dataset.truth.class_name] if dataset.truth is not None else [])
    for column in columns:
        for code in np.unique(column.codes).tolist():
            groups[_key(column.names[code])].add(column.names[code])
    return [names for _, names in sorted(groups.items()) if len(names) > 1]


def _with_one_spelling(dataset: Dataset) -> Dataset:
    """Spell every class as most of its detections do."""
    column = dataset.detections.class_name
    count = dict(zip(column.names, np.bincount(column.codes, minlength=len(column.names)).tolist(), strict=True))
    chosen = {
        name: max(sorted(names), key=lambda name: count.get(name, 0)) for names in _spellings(dataset) for name in names
    }
    result = with_detections(dataset, class_name=_renamed(column, chosen))
    if dataset.truth is None:
        return result
    truth = dataset.truth.replace(class_name=_renamed(dataset.truth.class_name, chosen))
    return Dataset(**{**vars(result), "truth": truth})


def _renamed(column: Categories, chosen: dict[str, str]) -> Categories:
    renamed = [chosen.get(name, name) for name in column.names]
    names = tuple(sorted(set(renamed)))
    recode = np.array([names.index(name) for name in renamed], dtype=np.int32)
    return Categories(recode[column.codes], names)
