"""Clocks of poses and pictures that are seconds apart: leap seconds, or a recorder that started late.

What a car sees so many seconds before or after is nothing that rays meet at, so no small shift makes it better. So all
whole seconds are tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from valuemap.arrays import Bools, Floats, Ints, runs
from valuemap.cameras import camera_centers
from valuemap.check.agreement import Agreement, agreement_on, compare
from valuemap.check.fault import (
    FAR_WORSE,
    LEAST_CHANCE,
    LEAST_RISE,
    TIE,
    Finding,
    View,
    agreement_after,
    gains_of_all,
    gains_without,
    keep_rows,
    once_a_view,
    with_images,
)
from valuemap.check.groups import Group, groups_of
from valuemap.check.sample import FASTER, HEAT, LEAST_IN_HEAT, Sample, drive_of_camera, median_step_m, order_by_camera
from valuemap.dataset import Dataset
from valuemap.tables import Images

_MOST_S = 40
"""GPS time is 18 s ahead of UTC, and TAI 37 s: so much a clock may be off, to either side."""
_LEAST_S = 0.75
"""What is less, least squares find."""
_PARTS_S = np.arange(-5, 6) / 10.0
_MOST_LEADING = 10
"""So many times, the best of these, are tried on all."""


@dataclass(frozen=True, eq=False)
class _Clock:
    """What is read at another time, how well its rays agree then and as given, and how likely that is by chance."""

    group: Group | None
    seconds: float
    agreement: Agreement
    given: Agreement
    chance: float
    is_far: bool
    """Whether rays agree far worse as given."""


def better_by_clock(view: View, finding: Finding | None) -> Finding | None:
    """Return the shift in time with which all rays agree better than with a finding, else the finding.

    Where nothing was found, rays must agree far worse as given: what is less may be a small error of something else.
    """
    clock = _clock(view)
    if clock is None or (finding is None and not clock.is_far):
        return finding
    if finding is not None and finding.fix is not None:
        by_clock = agreement_after(view, _AtOtherTimes(clock.group, clock.seconds))
        if by_clock < (1.0 + TIE) * agreement_after(view, finding.fix):
            return finding
    return _told(clock)


def find_clock(view: View) -> Finding | None:
    """Return the shift in time with which rays agree best, None where they agree with none better than as given."""
    clock = _clock(view)
    return None if clock is None else _told(clock)


@once_a_view
def _clock(view: View) -> _Clock | None:
    """Return the best shift of all images, or of a pass or camera whose own rays agree far worse than the others'."""
    time_s, clocks = view.dataset.images.timestamp_s, []
    if time_s is not None and np.all(np.isfinite(time_s)) and len(view.stretches.dataset.detections):
        groups: list[Group | None] = [None, *_apart(view)]
        clocks = [each for group in groups if (each := _best_clock(view, group, len(groups))) is not None]
    return min(clocks, key=lambda each: each.chance) if clocks else None


def _apart(view: View) -> Iterator[Group]:
    """Yield passes, then cameras, whose own rays agree far worse than those of the others."""
    groups = groups_of(view.dataset)
    worth = {group: _beyond_chance(alone := group.alone(view), alone.agreement) for group in groups}
    seen: list[Bools] = []
    for group in sorted(groups, key=lambda each: each.pass_name is None):
        alike = [each for each in groups if each != group and (each.pass_name is None) == (group.pass_name is None)]
        mine = group.images_of(view.dataset)
        is_known = any(np.array_equal(mine, each) for each in seen)  # A camera of one pass is that pass.
        if alike and worth[group] < FAR_WORSE * float(np.median([worth[each] for each in alike])) and not is_known:
            seen.append(mine)
            yield group


def _beyond_chance(view: View, agreement: Agreement) -> float:
    """Return how much better a detection of the stretches agrees with others than by chance."""
    return float(agreement.gain.sum() - view.chance.gain.sum()) / max(agreement.detections, 1)


def _best_clock(view: View, group: Group | None, groups: int) -> _Clock | None:
    """Return the shift in time with which rays of a group (None: all) agree best, if that is no chance."""
    alone = view if group is None else group.alone(view)
    heat = alone.stretches.every(HEAT)
    sample = heat if heat.places >= LEAST_IN_HEAT else alone.stretches

    def read(seconds: float, sample: Sample) -> Agreement:
        return agreement_on(sample, sample.of(_AtOtherTimes(None, seconds)(alone.dataset)), alone.gate_px)

    def all_gains(seconds: float) -> Floats:
        return gains_of_all(alone, _AtOtherTimes(None, seconds)(alone.dataset))

    tried = [float(way * size) for size in range(1, _MOST_S + 1) for way in (1, -1)]
    leading = sorted(tried, key=lambda seconds: -read(seconds, sample).gain.sum())[:_MOST_LEADING]
    first = max(leading, key=lambda seconds: read(seconds, alone.stretches).gain.sum())
    if read(first, alone.stretches).gain.sum() <= alone.agreement.gain.sum():
        return None
    near = {round(first + part, 1): all_gains(first + part) for part in _PARTS_S.tolist()}
    best = max(near, key=lambda seconds: float(near[seconds].sum()))
    moved, agreement, given = near[best], read(best, alone.stretches), alone.agreement
    if abs(best) < _LEAST_S:
        return None
    unmoved = gains_without(alone, _AtOtherTimes(None, -best)(alone.dataset))
    rise, tests = compare(moved, unmoved), (len(tried) + len(near)) * groups
    chance = max(rise.chance, compare(agreement.gain, alone.chance.gain).chance) * tests
    if chance > LEAST_CHANCE or rise.difference < LEAST_RISE * float(moved.sum()):
        return None
    is_far = _beyond_chance(alone, given) < FAR_WORSE * _beyond_chance(alone, agreement)
    return _Clock(group, best, agreement, given, chance, is_far)


def _told(clock: _Clock) -> Finding:
    group, seconds = clock.group, clock.seconds
    whose = "poses" if group is None else f"poses of {group.text}"
    return Finding(
        fault="pass_time_shift" if group is not None and group.pass_name is not None else "time_shift",
        what=f"The {whose} are {abs(seconds):g} s {'behind' if seconds > 0 else 'ahead of'} their pictures.",
        why=f"With the poses of {abs(seconds):g} s {'later' if seconds > 0 else 'before'}, "
        f"{clock.agreement.share:.0%} of {clock.agreement.detections} detections meet others, with an agreement of "
        f"{clock.agreement.gain.sum():.0f}; as given {clock.given.share:.0%} and {clock.given.gain.sum():.0f}.",
        do="Correct the clock of the poses: GPS time is 18 s ahead of UTC (leap seconds). If it is a whole number of "
        "images: are detections listed with other images than theirs? The fix leaves out the images that have no pose "
        "then, at the ends of passes.",
        chance=clock.chance,
        figures={
            **({} if group is None else {"of": group.text}),
            "shift_s": seconds,
            "agreement_as_given": round(float(clock.given.gain.sum()), 1),
            "agreement_if_moved": round(float(clock.agreement.gain.sum()), 1),
        },
        fix=_AtOtherTimes(group, seconds, leaves_out=True),
        of=None if group is None else group.text,
    )


@dataclass(frozen=True, eq=False)
class _AtOtherTimes:
    """Images of a group (None: all) with the poses of seconds later; those that have none stay, or are left out."""

    group: Group | None
    seconds: float
    leaves_out: bool = False

    def __call__(self, dataset: Dataset) -> Dataset:
        images = dataset.images
        mine = np.ones(len(images), np.bool_) if self.group is None else self.group.images_of(dataset)
        quaternion, center, is_known = _poses_later(images, self.seconds)
        moved = mine & is_known
        rotation = np.where(moved[:, None], quaternion, images.cam_from_world_quat)
        position = np.where(moved[:, None], center, camera_centers(images))
        translation = -Rotation.from_quat(rotation, scalar_first=True).apply(position)
        result = with_images(dataset, cam_from_world_quat=rotation, cam_from_world_m=translation)
        return keep_rows(result, images=moved | ~mine) if self.leaves_out else result


def _poses_later(images: Images, seconds: float) -> tuple[Floats, Floats, Bools]:
    """Return quaternions (N, 4) and centres (N, 3) so much later along each drive of a camera, and which are known.

    Known is what is between two images that are no farther apart than those of a drive are.
    """
    time_s, most_m = np.asarray(images.timestamp_s), FASTER * median_step_m(images)
    quaternion, center = images.cam_from_world_quat.copy(), camera_centers(images)
    later, is_known = center.copy(), np.zeros(len(images), dtype=np.bool_)
    order = order_by_camera(images)
    for rows in runs(order, drive_of_camera(images)[order]):
        when, first = np.unique(time_s[rows], return_index=True)
        if len(when) < 2:
            continue
        own, at = rows[first], time_s[rows] + seconds
        after: Ints = np.clip(np.searchsorted(when, at), 1, len(when) - 1)
        step_m = np.linalg.norm(np.diff(center[own], axis=0), axis=1)
        inside = (at >= when[0]) & (at <= when[-1]) & (step_m[after - 1] <= most_m)
        is_known[rows] = inside
        turn = Slerp(when, Rotation.from_quat(images.cam_from_world_quat[own], scalar_first=True))
        quaternion[rows[inside]] = turn(at[inside]).as_quat(scalar_first=True)
        for axis in range(3):
            later[rows, axis] = np.interp(at, when, center[own, axis])
    return quaternion, later, is_known
