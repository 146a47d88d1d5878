"""How far what one pass sees is from what the others see: in the world, or along its own drive."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from valuemap.arrays import Floats
from valuemap.check.agreement import compare
from valuemap.check.along_drives import moved_along
from valuemap.check.fault import (
    FAR_WORSE,
    LEAST_CHANCE,
    LEAST_RISE,
    View,
    once_a_view,
)
from valuemap.check.meeting import LEAST_PAIRS, SEARCH_STEPS, Meeting, PassPoints, pass_points
from valuemap.check.offsets import densest
from valuemap.check.seams import Seam, worst_seam
from valuemap.check.time_stamps import median_speed_mps
from valuemap.check.which_pass import which_is_off

_MOST_CANDIDATES = 6


@dataclass(frozen=True, eq=False)
class PassShift:
    """How far what one pass sees is from what the others see.

    `offset_m` (3) takes the pass's own objects to those of the others, in the world; of a shift along the drive it is
    (forward, left, up). `gain` is how well its rays meet the others' points then; `chance` that good data do so. Where
    it is told from the way the poses jump where the pass goes on from another, that is the `seam`.
    """

    pass_name: str
    offset_m: Floats
    is_along: bool
    gain: float
    gain_without: float
    chance: float
    passes: int
    seam: Seam | None = None
    points: int = 0
    """How many points of the pass are where others have one, where it is told from these."""
    other: PassShift | None = None
    """The shift of another pass that explains as much, where nothing tells which of the two is off."""


@once_a_view
def worst_pass(view: View) -> PassShift | None:
    """Return the shift of the pass that is farthest from good, None where all agree."""
    shift = near_shift(view) or far_shift(view)
    return shift_at_a_seam(view) if shift is None else _settled(view, shift)


def _settled(view: View, shift: PassShift) -> PassShift:
    """Return the shift, or that of the other pass of two if it is that one which is off; with the other if none tells.

    Of three passes that see the same, two agree. Of two, rays say no more than how far they are apart.
    """
    points = pass_points(view)
    assert points is not None
    mine = _Hypothesis.of(view, points, shift)
    rivals = [
        rival
        for code in points.meeting.met_by(mine.code, mine.point, view.step_m / 2.0)
        for rival in [_best_opposite(view, points, mine, code)]
        if rival.share >= FAR_WORSE * mine.share
    ]
    if not rivals:
        return shift
    theirs = max(rivals, key=lambda each: each.share)
    is_mine = which_is_off(view, points.meeting, (mine.code, mine.point), (theirs.code, theirs.point))
    if is_mine is None:
        return replace(shift, other=theirs.shift)
    return shift if is_mine else theirs.shift


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A shift of a pass, all points (P, 3) with those of the pass moved, and what share of what is met is due to it."""

    shift: PassShift
    code: int
    point: Floats
    share: float

    @classmethod
    def of(cls, view: View, points: PassPoints, shift: PassShift) -> _Hypothesis:
        """Work out what a shift comes to."""
        meeting, offset_m = points.meeting, shift.offset_m
        code = view.dataset.images.pass_id.code_of(shift.pass_name)
        if shift.is_along:
            east, north = view.dataset.frame.east_north()
            heading = points.heading[:, None]
            moves = offset_m[0] * (np.sin(heading) * east + np.cos(heading) * north)
        else:
            moves = np.broadcast_to(offset_m, meeting.point.shape)
        point = np.where((meeting.pass_of_point == code)[:, None], meeting.point + moves, meeting.point)
        if shift.points:  # Rays of one place do not reach so far.
            met, met_before = (meeting.met(code, each, view.step_m / 2.0) for each in (point, meeting.point))
            return cls(shift, code, point, (met - met_before) / max(met, 1))
        images = view.places_of_passes.image_row
        still = np.zeros((len(images), 3))
        moved = (moved_along(view.dataset, offset_m[0]) - view.center_in_world_m)[images] if shift.is_along else still
        moved = moved if shift.is_along else still + offset_m
        gain, gain_without = (float(meeting.gain(code, each).sum()) for each in (moved, still))
        told = replace(shift, gain=gain, gain_without=gain_without)
        return cls(told, code, point, (gain - gain_without) / max(gain, 1e-9))


def _best_opposite(view: View, points: PassPoints, mine: _Hypothesis, code: int) -> _Hypothesis:
    """Return the shift of another pass, by as much the other way, by which most of what it sees is met."""
    shift, moved = mine.shift, mine.point - points.meeting.point
    in_world = replace(
        shift,
        pass_name=view.dataset.images.pass_id.names[code],
        is_along=False,
        offset_m=-np.mean(moved[points.meeting.pass_of_point == mine.code], axis=0),
    )
    # One that drives the other way is as far ahead as this one is.
    along = [replace(in_world, is_along=True, offset_m=way * shift.offset_m) for way in (-1.0, 1.0) if shift.is_along]
    tried = [_Hypothesis.of(view, points, each) for each in (*along, in_world)]
    return max(tried, key=lambda each: each.share)


def shift_at_a_seam(view: View) -> PassShift | None:
    """Return the shift that closes the largest jump between passes that are one drive: of the shorter of the two."""
    seam = worst_seam(view.dataset, view.center_in_world_m)
    if seam is None or seam.chance > LEAST_CHANCE or float(np.linalg.norm(seam.jump_m)) < view.seen_m:
        return None
    images = view.dataset.images
    count = {name: int((images.pass_id.codes == images.pass_id.code_of(name)).sum()) for name in images.pass_id.names}
    name = seam.after if count[seam.after] <= count[seam.before] else seam.before
    offset_m = -seam.jump_m if name == seam.after else seam.jump_m
    forward_m = float(offset_m @ seam.forward)
    speed_mps = median_speed_mps(view)
    is_along = speed_mps is not None and abs(forward_m) > _ALONG_COSINE * float(np.linalg.norm(offset_m))
    if is_along and speed_mps is not None:
        # What a shift in time is at the median speed.
        offset_m = np.array([forward_m / seam.speed_mps * speed_mps, 0.0, 0.0])
    return PassShift(name, offset_m, is_along, 0.0, 0.0, seam.chance, len(count), seam)


_ALONG_COSINE = 0.97
"""A jump within 14 degrees of the way the car drives is one in time."""


def near_shift(view: View) -> PassShift | None:
    """See for each pass whether its rays meet the points of the others, moved or not."""
    points = pass_points(view)
    if points is None:
        return None
    meeting, heading = points.meeting, points.heading
    # Offsets as small as rays can see, if that is less than images are apart.
    tolerance_m = min(view.step_m / 2.0, view.seen_m or view.step_m / 2.0)
    tried = meeting.passes_of_most_points()
    candidates: list[tuple[int, int, bool, Floats]] = []
    for code in tried:
        own, difference = meeting.differences(code, within_m=SEARCH_STEPS * view.step_m)
        for is_along, turned in ((False, difference), (True, _along(difference, heading[own], view))):
            shift = densest(turned, tolerance_m)
            if shift is None or shift.pairs < LEAST_PAIRS or np.linalg.norm(shift.offset_m) <= tolerance_m:
                continue
            if is_along and abs(shift.offset_m[0]) < 2.0 * float(np.linalg.norm(shift.offset_m[1:])):
                continue
            candidates.append((shift.pairs - shift.pairs_at_zero, code, is_along, shift.offset_m))
    candidates.sort(key=lambda each: (-each[0], each[1], each[2]))
    return _best_shift(view, meeting, candidates[:_MOST_CANDIDATES], len(tried), tolerance_m)


def _along(difference: Floats, heading: Floats, view: View) -> Floats:
    """Return differences (N, 3) as forward, left and up of drives along azimuths (N)."""
    east, north = view.dataset.frame.east_north()
    up = np.array(view.dataset.frame.up)
    forward = np.sin(heading)[:, None] * east + np.cos(heading)[:, None] * north
    left = np.sin(heading - np.pi / 2.0)[:, None] * east + np.cos(heading - np.pi / 2.0)[:, None] * north
    return np.stack(
        [np.einsum("nj,nj->n", difference, forward), np.einsum("nj,nj->n", difference, left), difference @ up], axis=1
    )


def _best_shift(
    view: View,
    meeting: Meeting,
    candidates: Sequence[tuple[int, int, bool, Floats]],
    passes: int,
    tolerance_m: float,
) -> PassShift | None:
    """Move each candidate pass and return the shift that makes its rays meet the points of the others best."""
    images = view.places_of_passes.image_row
    still = np.zeros((len(images), 3))
    best: tuple[float, PassShift] | None = None
    for _, code, is_along, offset_m in candidates:
        name = view.dataset.images.pass_id.names[code]
        given = meeting.gain(code, still)

        def gain_of(offset: Floats, code: int = code, is_along: bool = is_along) -> Floats:
            moved = (
                (moved_along(view.dataset, offset[0]) - view.center_in_world_m)[images] if is_along else still + offset
            )
            return meeting.gain(code, moved)

        start = offset_m * [1.0, 0.0, 0.0] if is_along else offset_m.copy()
        gain_at_start = gain_of(start)
        first = compare(gain_at_start, given)
        offset, gain = _climb(gain_of, start, gain_at_start, (0,) if is_along else (0, 1, 2), tolerance_m)
        # The pairs of points chose where to look; how well rays meet there has not been looked at before.
        chance = min(1.0, first.chance * len(candidates))
        total, without = float(gain.sum()), float(given.sum())
        if total - without < LEAST_RISE * without:
            continue
        # Of two ways to say the same, a shift in the world is the simpler one.
        rise = (total - without) * (1.0 if not is_along else 0.95)
        if chance < LEAST_CHANCE and np.linalg.norm(offset) > tolerance_m and (best is None or rise > best[0]):
            best = rise, PassShift(name, offset, is_along, total, without, chance, passes)
    return None if best is None else best[1]


def _climb(
    gain_of: Callable[[Floats], Floats], offset: Floats, gain: Floats, axes: tuple[int, ...], tolerance_m: float
) -> tuple[Floats, Floats]:
    """Return the offset (3) near one, of given gains, that gains most in all by ever smaller steps along axes."""
    for step, axis in itertools.product((1.0, 0.5, 0.25), axes):
        for way in (-step, step):
            other = offset.copy()
            other[axis] += way * tolerance_m
            gain_there = gain_of(other)
            if gain_there.sum() > gain.sum():
                offset, gain = other, gain_there
    return offset, gain


def far_shift(view: View) -> PassShift | None:
    """Return the shift by which what a pass sees is what the others see, where it is farther off than rays tell.

    Then its points are in other places than theirs. The right shift stands out of all others: by the next best one
    fewer of its points have another, beyond what chance makes of two that are alike.
    """
    points = pass_points(view)
    if points is None:
        return None
    meeting, tolerance_m = points.meeting, view.step_m / 2.0
    tried = meeting.passes_of_most_points()
    found: list[tuple[int, PassShift]] = []
    for code in tried:
        match = meeting.best_match(code, tolerance_m)
        if match is None or np.linalg.norm(match.offset_m) <= SEARCH_STEPS * view.step_m:
            continue
        chance = match.chance_against(match.met_by_next) * len(tried)
        if chance < LEAST_CHANCE:
            name = view.dataset.images.pass_id.names[code]
            told = PassShift(name, match.offset_m, False, 0.0, 0.0, chance, len(tried), points=match.met)
            found.append((match.met - match.met_by_next, told))
    return max(found, key=lambda each: each[0])[1] if found else None
