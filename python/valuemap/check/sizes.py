"""How large the detected objects are in the world, and how large such things are."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

import valuemap._core as _core
from valuemap.check.fault import GATE_RAD, LEAST_CHANCE, View
from valuemap.check.groups import Group, groups_of
from valuemap.tables import Floats

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
    return error == 0.0 or float(stats.t.sf(beyond / error, len(height_m) - 1)) < _OUTSIDE


_LEAST_OBJECTS = 3
_OUTSIDE = 0.01
"""The limits have room of their own: the usual height is a factor of two from either."""


_HALF_OR_A_QUARTER = -1.5 * math.log(2.0)
"""The logarithm of a ratio that is as near to a half as to a quarter."""


def object_heights(view: View, group: Group | None = None, *, is_without: bool = False) -> dict[str, Floats]:
    """Return, for each class, the heights in metres of the points where rays meet, by the boxes of a group or without.

    Classes whose detections are points without a size are left out, and points whose rays are too near each other to
    tell how far they are.
    """
    heights = {name: _medians(of_votes) for name, of_votes in _heights_of_votes(view, group, is_without).items()}
    return {name: values for name, values in heights.items() if len(values)}


def heights_of_groups(view: View) -> dict[Group, dict[str, Floats]]:
    """Return the heights of objects by camera and by pass, where there are several, worked out once a view."""
    if "heights_of_groups" not in view.memory:
        heights = {group: object_heights(view, group) for group in groups_of(view.dataset)}
        view.memory["heights_of_groups"] = heights
    found: dict[Group, dict[str, Floats]] = view.memory["heights_of_groups"]
    return found


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
    return inside > error * float(stats.t.isf(_OUTSIDE, len(height_m) - 1))


def half_sized_group(view: View) -> tuple[Group, str, float, float, float] | None:
    """Return the camera or pass by whose boxes things are half as high as by all others', if one is.

    With it the class, both heights in metres, and the chance: that in logarithms they are nearer to equal than to a
    half (Welch's t). None where no group is.
    """
    of_groups = heights_of_groups(view)
    found: list[tuple[Group, str, float, float, float]] = []
    for group, heights in of_groups.items():
        others = object_heights(view, group, is_without=True)
        for name in heights.keys() & others.keys():
            own, rest = np.log(heights[name]), np.log(others[name])
            if min(len(own), len(rest)) < _LEAST_OBJECTS:
                continue
            test = stats.ttest_ind(own + math.log(2.0) / 2.0, rest, equal_var=False, alternative="less")
            chance, ratio = float(test.pvalue) * len(of_groups) * len(heights), float(own.mean() - rest.mean())
            if chance < LEAST_CHANCE and ratio > _HALF_OR_A_QUARTER:
                found.append((group, name, math.exp(np.median(own)), math.exp(np.median(rest)), chance))
    return min(found, key=lambda each: each[4], default=None)


def _heights_of_votes(view: View, group: Group | None, is_without: bool) -> dict[str, list[Floats]]:
    """Return, for each class and point, the heights in metres by the votes of a group (None: all), or by all others."""
    agreement = view.agreement
    found = agreement.found
    votes = np.diff(found.voter_offsets)
    if not len(found) or not view.meets:
        return {}
    detections = view.stretches.dataset.detections
    _, metres_per_px, parallax_rad = _core.see(
        agreement.rays.core, found.position_in_world_m, found.voter_offsets, found.voters
    )
    height_m = detections.size_px[found.voters.astype(np.int64), 1] * metres_per_px[:, 1]
    median = _core.medians(height_m.copy(), found.voter_offsets)
    class_code = detections.class_name.codes[found.voters[found.voter_offsets[:-1]].astype(np.int64)]
    row = agreement.rays.image_row[found.voters.astype(np.int64)]
    is_told = np.ones(len(row), np.bool_)
    if group is not None:
        is_told = group.images_of(view.stretches.dataset)[row] != is_without
    result: dict[str, list[Floats]] = {}
    for code, name in enumerate(detections.class_name.names):
        of_class = (class_code == code) & (votes >= _LEAST_VOTES)
        # Chance makes points of few votes; what most votes are for is what is there.
        of_class &= votes >= np.median(votes[of_class]) if np.any(of_class) else of_class
        of_class &= median > 0.0  # Key points have no size.
        of_class &= parallax_rad > _LEAST_GATES * GATE_RAD * view.gate_share
        if np.any(of_class):
            spans = zip(found.voter_offsets[:-1][of_class], found.voter_offsets[1:][of_class], strict=True)
            result[name] = [height_m[first:last][is_told[first:last]] for first, last in spans]
    return result


def _medians(of_votes: list[Floats]) -> Floats:
    return np.array([np.median(values) for values in of_votes if len(values)])
