"""Faults of positions: held until the next fix, heights above two zeros."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Ints, runs
from valuemap.cameras import camera_centers
from valuemap.check.agreement import Comparison, compare
from valuemap.check.fault import LEAST_CHANCE, Convention, Fault, Finding, Fix, Stage, View, with_centers
from valuemap.check.meeting import meeting_of_passes
from valuemap.check.sample import order_by_pass
from valuemap.dataset import Dataset
from valuemap.tables import Images

_HELD_MORE_OFTEN = 0.5
_LEAST_FIXES = 10
_OTHER_LEVEL_STEPS = 4.0
_ALIKE = 0.25
_MOSTLY = 0.8
_LEAST_MEETINGS = 10
_NO_ROAD_M = 20.0
"""No road lies so far above another and goes along with it; geoids differ from ellipsoids by up to 100 m."""


class HeldPositions(Convention):
    """Positions that stay until the next fix of a slower receiver."""

    name: ClassVar[str] = "held_positions"
    what: ClassVar[str] = "Several images in a row have one position: positions come more seldom than pictures."
    do: ClassVar[str] = "Interpolate the positions at the times of the pictures; do not take the last one known."
    is_guess: ClassVar[bool] = True

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield positions between the fixes, where most images that follow a move do not move."""
        if np.sum(_is_new(dataset.images)) >= _LEAST_FIXES and _held_share(dataset.images) > _HELD_MORE_OFTEN:
            yield "positions between those that are held", _interpolated


class HeightZero(Fault):
    """Passes whose heights count from another zero: ellipsoid and sea level."""

    name: ClassVar[str] = "height_zero"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """See whether passes that meet on the map are at other levels, and rays agree if they are put on one."""
        levels = _levels(view)
        if not levels:
            return None
        fix = _Lifted(levels)
        comparison = _compare_levels(View(fix(view.dataset), gate_share=view.gate_share), levels)
        chance = comparison.chance
        if chance > LEAST_CHANCE:
            # Few objects are seen from both: then only what no road does above another for long is believed.
            if comparison.difference < 0.0 or min(abs(level) for level in levels.values()) < _NO_ROAD_M:
                return None
            chance = LEAST_CHANCE / 10.0
        name, level_m = max(levels.items(), key=lambda item: abs(item[1]))
        return Finding(
            fault=self.name,
            what=f"The heights of {len(levels)} passes count from another zero than the others'."
            if len(levels) > 1
            else f"The heights of pass {name} count from another zero than the others'.",
            why=f"Wherever pass {name} crosses others on the map it is {abs(level_m):.1f} m "
            f"{'above' if level_m > 0.0 else 'below'} them; on one level the agreement of its rays with "
            f"the others' points rises by {comparison.difference:.0f} ({comparison.places} places).",
            do="Use one zero of heights: the ellipsoid or the sea level (--vertical), not both.",
            chance=chance,
            figures={"passes": {name: round(level, 2) for name, level in levels.items()}, **comparison.to_json()},
            fix=fix,
        )


def _is_new(images: Images) -> Bools:
    """Return which images in driving order (N) are elsewhere than the one before, or begin a pass."""
    order = order_by_pass(images)
    center = camera_centers(images)[order]
    moved = np.linalg.norm(np.diff(center, axis=0), axis=1) > 1e-6
    return np.append(True, moved | (np.diff(images.pass_id.codes[order]) != 0))


def _held_share(images: Images) -> float:
    """Return how many of the images after a move do not move: few of a car that stands, most of a slow receiver."""
    is_new = _is_new(images)
    after = is_new[:-1]
    return float(np.mean(~is_new[1:][after])) if np.any(after) else 0.0


def _interpolated(dataset: Dataset) -> Dataset:
    images = dataset.images
    order, is_new = order_by_pass(images), _is_new(images)
    center = camera_centers(images)
    time = images.timestamp_s
    has_times = time is not None and bool(np.all(np.isfinite(time)))
    codes = images.pass_id.codes[order]
    moved = center.copy()
    for rows in runs(np.arange(len(order)), codes):
        when = np.asarray(time)[order[rows]] if has_times else rows.astype(np.float64)
        fix = np.flatnonzero(is_new[rows])
        if len(fix) < 2 or np.any(np.diff(when[fix]) <= 0.0):
            continue
        for axis in range(3):
            value = center[order[rows], axis]
            between = np.interp(when, when[fix], value[fix])
            speed = (value[fix[-1]] - value[fix[-2]]) / (when[fix[-1]] - when[fix[-2]])
            late = when > when[fix[-1]]
            between[late] = value[fix[-1]] + speed * (when[late] - when[fix[-1]])
            moved[order[rows], axis] = between
    return with_centers(dataset, moved)


def _levels(view: View) -> dict[str, float]:
    """Return, for each pass on another level than most images, how many metres it is above them."""
    images = view.dataset.images
    codes = images.pass_id.codes.astype(np.int64)
    above = _meetings(view, codes)
    if not above:
        return {}
    level = _spread_from(int(np.argmax(np.bincount(codes))), above)
    weight = np.bincount(codes)
    known = np.array(sorted(level))
    # Most images are right.
    order = known[np.argsort([level[code] for code in known], kind="stable")]
    middle = level[int(order[np.searchsorted(np.cumsum(weight[order]), weight[order].sum() / 2.0)])]
    least_m = _OTHER_LEVEL_STEPS * view.step_m
    return {
        images.pass_id.names[code]: level[code] - middle
        for code in known.tolist()
        if abs(level[code] - middle) > least_m
    }


def _meetings(view: View, codes: Ints) -> dict[tuple[int, int], float]:
    """Return how far pass i is above pass j, where the two meet on the map often and always at that difference."""
    east, north = view.dataset.frame.east_north()
    center = view.center_in_world_m
    ground = np.stack([center @ east, center @ north], axis=1)
    height = center @ np.array(view.dataset.frame.up)
    rows_of_pass: dict[int, Ints] = {int(code): np.flatnonzero(codes == code) for code in np.unique(codes)}
    if not 1 < len(rows_of_pass) <= _MOST_PASSES:
        return {}
    trees = {code: cKDTree(ground[rows]) for code, rows in rows_of_pass.items()}
    above: dict[tuple[int, int], float] = {}
    for i, rows in rows_of_pass.items():
        for j, others in rows_of_pass.items():
            if j <= i:
                continue
            distance, near = map(np.asarray, trees[j].query(ground[rows], distance_upper_bound=2.0 * view.step_m))
            meets = np.isfinite(distance)
            if int(meets.sum()) < _LEAST_MEETINGS:
                continue
            difference = height[rows[meets]] - height[others[near[meets]]]
            middle = float(np.median(difference))
            spread_m = max(_ALIKE * abs(middle), view.step_m)
            if float(np.mean(np.abs(difference - middle) < spread_m)) > _MOSTLY:
                above[i, j], above[j, i] = middle, -middle
    return above


_MOST_PASSES = 100


def _spread_from(first: int, above: dict[tuple[int, int], float]) -> dict[int, float]:
    """Return the level of each pass that hangs together with the first by meetings."""
    level, waiting = {first: 0.0}, [first]
    while waiting:
        here = waiting.pop(0)
        for (i, j), difference in above.items():
            if j == here and i not in level:
                level[i] = level[here] + difference
                waiting.append(i)
    return level


def _compare_levels(together: View, levels: dict[str, float]) -> Comparison:
    """Compare how well the rays of passes meet the points of others on one level, and each on its own."""
    meeting = meeting_of_passes(together)
    if meeting is None:
        return Comparison(0.0, 1.0, 0)
    images = together.places_of_passes.dataset.images
    up = np.array(together.dataset.frame.up)
    on_one, on_own = [np.zeros(0)], [np.zeros(0)]
    for name, level_m in levels.items():
        code = images.pass_id.code_of(name)
        on_one.append(meeting.gain(code, np.zeros((len(images), 3))))
        on_own.append(meeting.gain(code, np.broadcast_to(level_m * up, (len(images), 3))))
    return compare(np.concatenate(on_one), np.concatenate(on_own))


class _Lifted:
    """Passes put on the level of the others."""

    def __init__(self, levels: dict[str, float]) -> None:
        self._levels = levels

    def __call__(self, dataset: Dataset) -> Dataset:
        names: list[Any] = dataset.images.pass_id.texts()
        lift = -np.array([self._levels.get(name, 0.0) for name in names])
        center = camera_centers(dataset.images) + lift[:, None] * np.array(dataset.frame.up)
        return with_centers(dataset, center)
