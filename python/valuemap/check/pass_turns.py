"""One pass whose world is turned a little against that of the others, about the sky's direction.

Grid north of a map projection is up to three degrees from true north, and poses that were aligned by few points are
turned as much. Its own rays meet. What it sees is where others see it in one part of the map, and metres off in others:
no shift puts it right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats, Ints
from valuemap.check.agreement import Comparison, chance_of_majority, compare
from valuemap.check.fault import (
    AGAINST,
    FAR_WORSE,
    LEAST_CHANCE,
    LEAST_RISE,
    Fault,
    Finding,
    Stage,
    View,
    with_pass_moved,
)
from valuemap.check.meeting import SEARCH_STEPS, Meeting, meeting_of_passes
from valuemap.check.offsets import densest
from valuemap.check.pass_offsets import OF_ITS_CAMERA
from valuemap.check.which_pass import which_is_off, which_of_two
from valuemap.dataset import Dataset

ANGLES_DEG = np.concatenate([[0.0], *[[angle, -angle] for angle in np.arange(0.25, 10.25, 0.25)]])
_ROUNDS = 8
_LEAST_MET = 6
"""Points of a pass that are met: a turn and a shift take two."""


class PassTurned(Fault):
    """A pass whose positions and rotations are turned against those of the others."""

    name: ClassVar[str] = "pass_turned"
    stage: ClassVar[Stage] = "fine"
    rivals: ClassVar[frozenset[str]] = OF_ITS_CAMERA | {"pass_offset", "pass_time_shift"}
    may_be_reading: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """Turn each pass so that its points fall on those of others; its rays must meet them better than by a shift."""
        meeting = meeting_of_passes(view)
        if meeting is None:
            return None
        tried = meeting.passes_of_most_points()
        found: list[tuple[float, int, _Turned, Comparison, float]] = []
        for code in tried:
            turn, shift = (best_turn_of_pass(view, meeting, code, angles) for angles in (ANGLES_DEG, ANGLES_DEG[:1]))
            if turn is None or (shift is not None and chance_of_majority(turn.met, turn.met + shift.met) > AGAINST):
                continue
            turn = _refined(view, meeting, code, turn)
            if turn.reach_m < view.seen_m:
                continue
            # A shift is the simpler explanation.
            others = [_gain(meeting, code, each) for each in (None, shift)]
            without = max(others, key=lambda gain: float(gain.sum()))
            rise = compare(_gain(meeting, code, turn), without)
            chance = rise.chance * len(tried)
            if chance < LEAST_CHANCE and rise.difference > LEAST_RISE * float(without.sum()):
                found.append((rise.difference, code, turn, rise, chance))
        if not found:
            return None
        _, code, turn, rise, chance = max(found, key=lambda each: each[0])
        return _settled(view, meeting, code, turn, _finding(turn, rise, chance))


def _settled(view: View, meeting: Meeting, code: int, turn: _Turned, finding: Finding) -> Finding:
    """Return the finding, or that of the other pass of two if it is that one which is off; no fix if none tells.

    Of two passes, rays say no more than how far they are turned against each other.
    """
    point = _elsewhere(meeting, code, turn)
    mine = _share(meeting, code, turn)
    back = turn_about(turn.up, -turn.angle_deg)
    names = view.dataset.images.pass_id.names
    rivals = [
        (share, other, opposite)
        for other in meeting.met_by(code, point, view.step_m / 2.0)
        for opposite in [replace(turn, name=names[other], angle_deg=-turn.angle_deg, move_m=-turn.move_m @ back.T)]
        for share in [_share(meeting, other, opposite)]
        if share >= FAR_WORSE * mine
    ]
    if not rivals:
        return finding
    _, other, opposite = max(rivals, key=lambda each: each[0])
    theirs = _elsewhere(meeting, other, opposite)
    is_mine = which_is_off(view, meeting, (code, point), (other, theirs))
    if is_mine is not None:
        if is_mine:
            return finding
        assert finding.chance is not None
        what = f"Pass {opposite.name} is turned by {abs(turn.angle_deg):.2f} degrees as a whole against the others."
        figures = {**finding.figures, "pass": opposite.name, "turn_deg": round(opposite.angle_deg, 3)}
        why = finding.why.replace("Turned", f"Were {turn.name} turned", 1)
        return replace(finding, what=what, why=why, figures=figures, fix=opposite, of=f"pass {opposite.name}")
    return replace(
        finding,
        what=which_of_two(turn.name, opposite.name, f"turned by {abs(turn.angle_deg):.2f} degrees against each other"),
        do="Find out which is right (by a third pass, by known points as truth), then turn the other. " + finding.do,
        figures={**finding.figures, "or_pass": opposite.name},
        fix=None,
        trial=turn,
    )


def _elsewhere(meeting: Meeting, code: int, turn: _Turned) -> Floats:
    """Return all points (P, 3) with those of a pass turned."""
    about = turn.about_in_world_m - meeting.middle_in_world_m
    there = _turn(meeting.point, turn.up, turn.angle_deg, about) + turn.move_m
    return np.where((meeting.pass_of_point == code)[:, None], there, meeting.point)


def _share(meeting: Meeting, code: int, turn: _Turned) -> float:
    """Return what share of how well the rays of a pass, turned so, meet the points of the others is due to the turn."""
    gain, without = (float(_gain(meeting, code, each).sum()) for each in (turn, None))
    return (gain - without) / max(gain, 1e-9)


def _gain(meeting: Meeting, code: int, turn: _Turned | None) -> Floats:
    """Return how well the rays of a pass, turned so, meet the points of the others (places)."""
    still = np.zeros((len(meeting.pass_of_image), 3))
    if turn is None:
        return meeting.gain(code, still)
    back = turn_about(turn.up, -turn.angle_deg)
    about = turn.about_in_world_m - meeting.middle_in_world_m
    return replace(meeting, point=(meeting.point - about - turn.move_m) @ back.T + about).gain(code, still)


def _finding(turn: _Turned, rise: Comparison, chance: float) -> Finding:
    way = "counter-clockwise" if turn.angle_deg > 0.0 else "clockwise"
    return Finding(
        fault=PassTurned.name,
        what=f"Pass {turn.name} is turned by {abs(turn.angle_deg):.2f} degrees as a whole against the others.",
        why=f"Turned {way} by as much, what it sees is where others see it: the agreement of its rays with the others' "
        f"points is {rise.difference:.0f} more than as given, or by any shift ({rise.places} places).",
        do="Align it with the others: grid north of a map projection is not true north, and an alignment by few points "
        "leaves a turn.",
        chance=chance,
        figures={"pass": turn.name, "turn_deg": round(turn.angle_deg, 3), "points": turn.met, **rise.to_json()},
        fix=turn,
        of=f"pass {turn.name}",
    )


@dataclass(frozen=True, eq=False)
class _Turned:
    """The images of a pass turned about the sky's direction through a place (3) in the world, and moved (3)."""

    name: str
    angle_deg: float
    up: tuple[float, float, float]
    about_in_world_m: Floats
    move_m: Floats
    met: int
    reach_m: float
    """What points of the pass are moved by through the turn, the middle one of them."""

    def __call__(self, dataset: Dataset) -> Dataset:
        """Return the dataset with the pass so."""
        turn = turn_about(self.up, self.angle_deg)
        return with_pass_moved(
            dataset, self.name, turn, self.about_in_world_m - turn @ self.about_in_world_m + self.move_m
        )


def turn_about(up: tuple[float, float, float], angle_deg: float) -> Floats:
    """Return the rotation (3, 3) about up."""
    return np.asarray(Rotation.from_rotvec(np.radians(angle_deg) * np.array(up)).as_matrix())


def best_turn_of_pass(view: View, meeting: Meeting, code: int, angles_deg: Floats) -> _Turned | None:
    """Return the turn by one of the angles, and as near it as fits best, after which most points of a pass are met."""
    up, own = view.dataset.frame.up, np.flatnonzero(meeting.pass_of_point == code)
    point, tolerance_m, within_m = meeting.point[own], view.step_m / 2.0, SEARCH_STEPS * view.step_m
    about = np.median(point, axis=0) if len(own) else np.zeros(3)
    best_met, best = 0, (0.0, np.zeros(3))
    for angle in angles_deg.tolist():
        first, _, difference = _pairs(meeting, code, _turn(point, up, angle, about), within_m)
        shift = densest(difference, tolerance_m)
        if shift is None:
            continue
        met = len(np.unique(first[np.linalg.norm(difference - shift.offset_m, axis=1) <= tolerance_m]))
        if met > best_met:
            best_met, best = met, (angle, shift.offset_m)
    if best_met < _LEAST_MET:
        return None
    angle, move = best
    met_now = np.empty(0, np.int64)
    for _ in range(_ROUNDS):
        there = _turn(point, up, angle, about) + move
        first, second, difference = _pairs(meeting, code, there, tolerance_m)
        nearest = _nearest(first, np.linalg.norm(difference, axis=1))
        first, second, met_now = first[nearest], second[nearest], first[nearest]
        if len(first) < _LEAST_MET:
            return None
        ours, theirs = point[first] - about, meeting.point[second] - about
        if len(angles_deg) > 1:
            angle = _angle_deg(ours - ours.mean(axis=0), theirs - theirs.mean(axis=0), up)
        move = theirs.mean(axis=0) - ours.mean(axis=0) @ turn_about(up, angle).T
    reach_m = float(np.median(np.linalg.norm(_turn(point, up, angle, about) - point, axis=1)))
    name = view.dataset.images.pass_id.names[code]
    return _Turned(name, angle, up, about + meeting.middle_in_world_m, move, len(met_now), reach_m)


def _refined(view: View, meeting: Meeting, code: int, turn: _Turned) -> _Turned:
    """Return a turn beside a given one with which the rays of a pass meet the points of the others best.

    Points of one pass are known less well across the road than rays are.
    """
    point = meeting.point[meeting.pass_of_point == code]
    away_m = float(np.median(np.linalg.norm(point - np.median(point, axis=0), axis=1)))
    best, total = turn, float(_gain(meeting, code, turn).sum())
    for step_m in view.step_m * np.array([0.5, 0.5, 0.25, 0.25, 0.125]):
        for axis, way in ((axis, way) for axis in range(4) for way in (-step_m, step_m)):
            if axis == 3:
                other = replace(best, angle_deg=best.angle_deg + float(np.degrees(way / away_m)))
            else:
                other = replace(best, move_m=best.move_m + way * np.eye(3)[axis])
            there = float(_gain(meeting, code, other).sum())
            if there > total:
                best, total = other, there
    return replace(best, reach_m=away_m * abs(np.radians(best.angle_deg)))


def _turn(point: Floats, up: tuple[float, float, float], angle_deg: float, about: Floats) -> Floats:
    return np.asarray((point - about) @ turn_about(up, angle_deg).T + about)


def _pairs(meeting: Meeting, code: int, point: Floats, within_m: float) -> tuple[Ints, Ints, Floats]:
    """Return which of a pass's points (M), elsewhere now, and of all points are near, and how far it is (M, 3)."""
    own = np.flatnonzero(meeting.pass_of_point == code)
    moved = meeting.point.copy()
    moved[own] = point
    first, second = meeting.near(code, moved, within_m=within_m)
    return np.searchsorted(own, first), second, moved[second] - moved[first]


def _nearest(first: Ints, distance_m: Floats) -> Ints:
    """Return the row of the nearest pair of each point."""
    order = np.lexsort((distance_m, first))
    return order[np.append(True, np.diff(first[order]) != 0)] if len(order) else order


def _angle_deg(ours: Floats, theirs: Floats, up: tuple[float, float, float]) -> float:
    """Return the angle about the sky's direction that takes points (M, 3) to others best, both from their middles."""
    axis = np.array(up)
    sine = float(np.sum(np.cross(ours, theirs) @ axis))
    cosine = float(np.sum(ours * theirs) - np.sum((ours @ axis) * (theirs @ axis)))
    return float(np.degrees(np.arctan2(sine, cosine)))
