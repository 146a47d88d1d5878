"""How large the detected objects are in the world, and how large such things are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints
from valuemap.check.agreement import Agreement
from valuemap.check.fault import GATE_RAD, LEAST_CHANCE, View, once_a_view
from valuemap.check.groups import Group, groups_of
from valuemap.check.sample import Sample

_LEAST_VOTES = 5
_LEAST_GATES = 6.0
"""Rays of so many gates between them tell how far a thing is to a sixth, were they off by a whole gate."""
_ANYTHING = (0.05, 10.0)
_HEIGHTS_M = (
    # Housings of two or three lenses of 0.2 or 0.3 m (EN 12368, MUTCD), with or without a back plate.
    (("traffic_light", "traffic light", "trafficlight", "traffic signal", "traffic_signal"), (0.45, 2.0)),
    # Discs and triangles of 0.4 to 1.2 m (Vienna, MUTCD), a plate of a street's name up to a board at a junction.
    (("sign",), (0.2, 2.5)),
)


def plausible_heights(class_name: str) -> tuple[float, float]:
    """Return between which heights in metres the median of a class must be."""
    name = class_name.lower()
    for words, heights in _HEIGHTS_M:
        if any(word in name for word in words):
            return heights
    return _ANYTHING


def are_outside(height_m: Floats, low_m: float, high_m: float) -> bool:
    """Return whether heights (N) of objects are, in the middle, beyond limits by more than they scatter, in logarithms.

    A few objects that are taken for too far or too near, as loose poses have it, say nothing of the rest. But where all
    are beyond by a factor of two, however they scatter, it is not that.
    """
    if len(height_m) < _LEAST_OBJECTS:
        return False
    if height_m.max() < low_m / 2.0 or height_m.min() > 2.0 * high_m:
        return True
    median_m = float(np.median(height_m))
    beyond = abs(math.log(median_m / min(max(median_m, low_m), high_m)))
    if beyond == 0.0:
        return False
    error = float(np.log(height_m).std(ddof=1)) / math.sqrt(len(height_m))
    return error == 0.0 or float(stats.t.sf(beyond / error, len(height_m) - 1)) < _OUTSIDE_SHARE


_LEAST_OBJECTS = 3
_OUTSIDE_SHARE = 0.01
"""The limits have room of their own: the usual height is a factor of two from either."""


_HALF_OR_A_QUARTER = -1.5 * math.log(2.0)
"""The logarithm of a ratio that is as near to a half as to a quarter."""


def object_heights(view: View, group: Group | None = None, *, is_without: bool = False) -> dict[str, Floats]:
    """Return, for each class, the heights in metres of the points where rays meet, by the boxes of a group or without.

    Classes whose detections are points without a size are left out, and points whose rays are too near each other to
    tell how far they are.
    """
    heights = _heights(view, at_places=False)
    if heights is None:
        return {}
    height_m = heights.of_points(heights.is_of(group, is_without=is_without))
    is_seen = np.isfinite(height_m)
    found: dict[str, Floats] = {}
    for name, of_class in heights.classes(is_usual=True).items():
        if np.any(of_class & is_seen):
            found[name] = height_m[of_class & is_seen]
    return found


@once_a_view
def heights_of_groups(view: View) -> dict[Group, dict[str, Floats]]:
    """Return the heights of objects by camera and by pass, where there are several."""
    return {group: object_heights(view, group) for group in groups_of(view.dataset)}


def do_groups_agree(view: View, name: str, low_m: float, high_m: float) -> bool:
    """Return whether no camera and no pass sees the objects of a class within limits, by more than they scatter.

    All share one world: what some of them see in its right size is no other unit, but a mistake of the others.
    """
    of_groups = [heights[name] for heights in heights_of_groups(view).values() if name in heights]
    return not any(_are_within(height_m, low_m, high_m) for height_m in of_groups)


def _are_within(height_m: Floats, low_m: float, high_m: float) -> bool:
    """Return whether heights (N) are, in the middle, within limits by more than they scatter, in logarithms."""
    if len(height_m) < _LEAST_OBJECTS:
        return False
    logarithm = np.log(height_m)
    inside = min(float(logarithm.mean()) - math.log(low_m), math.log(high_m) - float(logarithm.mean()))
    error = float(logarithm.std(ddof=1)) / math.sqrt(len(height_m))
    return inside > error * float(stats.t.isf(_OUTSIDE_SHARE, len(height_m) - 1))


def half_sized_group(view: View) -> tuple[Group, str, float, float, float] | None:
    """Return the camera or pass by whose boxes things are half as high as by all others', if one is.

    With it the class, both heights in metres, and the chance: that in logarithms they are nearer to equal than to a
    half. Objects that both see are compared each with itself (Student's t), else all those of one with all those of the
    others (Welch's t). None where no group is.
    """
    of_groups, at_places = heights_of_groups(view), _heights(view, at_places=True)
    found: list[tuple[Group, str, float, float, float]] = []
    for group, heights in of_groups.items():
        others = object_heights(view, group, is_without=True)
        pairs = {} if at_places is None else at_places.pairs(group)
        for name in heights.keys() | pairs.keys():
            told = [_half(*np.log(pairs[name]), is_paired=True)] if name in pairs else []
            own_m, others_m = heights.get(name, _NONE), others.get(name, _NONE)
            if min(len(own_m), len(others_m)) >= _LEAST_OBJECTS:
                told.append(_half(np.log(own_m), np.log(others_m), is_paired=False))
            if not told:
                continue
            best = min(told, key=lambda each: each.chance)
            chance = best.chance * len(told) * len(of_groups) * len(heights.keys() | pairs.keys())
            if chance < LEAST_CHANCE and best.ratio > _HALF_OR_A_QUARTER:
                found.append((group, name, best.own_m, best.others_m, chance))
    return min(found, key=lambda each: each[4], default=None)


_NONE = np.empty(0)


@dataclass(frozen=True)
class _Half:
    """The chance that heights are nearer to equal than to a half, their mean ratio in logarithms, and their medians."""

    chance: float
    ratio: float
    own_m: float
    others_m: float


def _half(own: Floats, others: Floats, *, is_paired: bool) -> _Half:
    """Compare logarithms of heights (N and M, or pairs) by a group with those by others."""
    ratio, own_m, others_m = float(own.mean() - others.mean()), math.exp(np.median(own)), math.exp(np.median(others))
    nearer = own + math.log(2.0) / 2.0
    if is_paired:
        test = stats.ttest_rel(nearer, others, alternative="less")
    else:
        test = stats.ttest_ind(nearer, others, equal_var=False, alternative="less")
    return _Half(float(test.pvalue), ratio, own_m, others_m)


@dataclass(frozen=True, eq=False)
class _Heights:
    """How high points (P) where rays meet are by their votes (V), in metres, at the distance of the point.

    `is_told` (P) are those whose rays say how far they are and whose detections have a size; `is_usual` (P) those that
    have as many votes as most of their class: chance makes points of few votes, and what most votes are for is there.
    """

    sample: Sample
    height_m: Floats
    image_row: Ints
    offsets: Ints
    class_code: Ints
    is_told: Bools
    is_usual: Bools

    def is_of(self, group: Group | None, *, is_without: bool = False) -> Bools:
        """Return which votes (V) are of images of a group (None: all), or of all others."""
        if group is None:
            return np.ones(len(self.image_row), np.bool_)
        return np.asarray(group.images_of(self.sample.dataset)[self.image_row] != is_without)

    def of_points(self, which: Bools) -> Floats:
        """Return the median height (P) of each point by some votes (V, by mask), NaN where it has none of them."""
        votes = np.add.reduceat(which.astype(np.int64), self.offsets[:-1])
        seen = votes > 0
        result = np.full(len(votes), np.nan)
        if seen.any():
            offsets = np.append(0, np.cumsum(votes[seen])).astype(self.offsets.dtype)
            result[seen] = _core.medians(self.height_m[which].copy(), offsets)
        return result

    def classes(self, *, is_usual: bool) -> dict[str, Bools]:
        """Return which points (P) are of each class and told."""
        told = self.is_told & self.is_usual if is_usual else self.is_told
        names = self.sample.dataset.detections.class_name.names
        return {name: told & (self.class_code == code) for code, name in enumerate(names)}

    def pairs(self, group: Group) -> dict[str, Floats]:
        """Return for each class the heights (2, N) of points by votes of a group, and by those of others."""
        mine = self.is_of(group)
        both = np.stack([self.of_points(mine), self.of_points(~mine)])
        is_both = np.all(both > 0.0, axis=0)
        of_classes = {name: both[:, of_class & is_both] for name, of_class in self.classes(is_usual=False).items()}
        return {name: values for name, values in of_classes.items() if values.shape[1] >= _LEAST_OBJECTS}


@once_a_view
def _heights(view: View, *, at_places: bool) -> _Heights | None:
    """Return the heights of what the stretches show, or the places; None where nothing does."""
    agreement, sample = (view.agreement_at_places, view.places) if at_places else (view.agreement, view.stretches)
    return _heights_of(view, agreement, sample)


def _heights_of(view: View, agreement: Agreement, sample: Sample) -> _Heights | None:
    found, detections = agreement.found, sample.dataset.detections
    if not len(found) or not view.meets:
        return None
    voters, votes = found.voters.astype(np.int64), np.diff(found.voter_offsets)
    _, metres_per_px, parallax_rad = _core.see(
        agreement.rays.core, found.position_in_world_m, found.voter_offsets, found.voters
    )
    height_m = detections.size_px[voters, 1] * metres_per_px[:, 1]
    class_code = detections.class_name.codes[voters[found.voter_offsets[:-1]]]
    enough = votes >= _LEAST_VOTES
    is_usual = enough.copy()
    for code in np.unique(class_code[enough]):
        is_usual &= (class_code != code) | (votes >= np.median(votes[enough & (class_code == code)]))
    is_told = enough & (_core.medians(height_m.copy(), found.voter_offsets) > 0.0)  # Key points have no size.
    is_told &= parallax_rad > _LEAST_GATES * GATE_RAD * view.gate_share
    image_row = agreement.rays.image_row[voters]
    return _Heights(sample, height_m, image_row, found.voter_offsets, class_code.astype(np.int64), is_told, is_usual)
