"""Where one drive ends and the next begins: at pauses, at jumps, and where a vehicle comes back to where it was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints
from valuemap.drives.order import CHAIN, TIME, Track
from valuemap.drives.runs import begins_of_runs, quantiles
from valuemap.drives.way import lengths, steps_m, way_from_place_to_place

_GAP_STEPS = 10.0
"""A step longer than this many usual ones is a jump, if the time it took does not explain it."""
_JUMP_SPEEDS = 3.0
"""Faster than this many usual speeds nobody drives."""
_PAUSE_STEPS = 100.0
"""Who was away for longer than this many usual steps take, and comes back elsewhere, drives anew."""
_STOP_STEPS = 1000.0
"""Who stood for longer than this many usual steps take drives anew: no light is red for that long."""
_REVISIT_STEPS = 5.0
"""Nearer than this many usual steps is the same place: opposite lanes are, parallel streets are not."""
_AWAY_STEPS = 30.0
"""Who drove this many usual steps between two visits of a place had left it."""


@dataclass(frozen=True, eq=False)
class Usual:
    """What is usual among some vehicles (V): the upper quartiles of their steps, speeds and times, NaN where unknown.

    `low_m` and `high_m` (3) are between which places they drove.
    """

    step_m: Floats
    speed: Floats
    taken: Floats
    low_m: Floats
    high_m: Floats

    def __add__(self, other: Usual) -> Usual:
        return Usual(
            step_m=np.concatenate([self.step_m, other.step_m]),
            speed=np.concatenate([self.speed, other.speed]),
            taken=np.concatenate([self.taken, other.taken]),
            low_m=np.minimum(self.low_m, other.low_m),
            high_m=np.maximum(self.high_m, other.high_m),
        )

    @property
    def ground_axes(self) -> Ints:
        """The two axes along which places differ most."""
        return np.sort(np.argsort(self.low_m - self.high_m, kind="stable")[:2])


@dataclass(frozen=True, eq=False)
class Steps:
    """How far (E) each exposure is from the one before in metres, in time, and both, NaN where a way begins."""

    begins: Bools
    step_m: Floats
    taken: Floats
    speed: Floats

    @classmethod
    def of(cls, place_m: Floats, group: Ints, taken: Floats) -> Steps:
        """Return the steps along places (E, 3), group after group (E); each `taken` (E) so long."""
        begins = begins_of_runs(group)
        step_m = steps_m(place_m)
        step_m[begins] = np.nan
        taken = np.where(begins, np.nan, taken)
        with np.errstate(divide="ignore", invalid="ignore"):
            speed = step_m / np.where(taken > 0.0, taken, np.nan)
        return cls(begins, step_m, taken, speed)


@dataclass(frozen=True, eq=False)
class Cuts:
    """Where (E) a drive begins, and why: counts by reason."""

    any_of: Bools
    counts: dict[str, int]


def usual_steps(steps: Steps, place_m: Floats, track: Track, camera: Ints) -> tuple[Floats, Floats, Floats]:
    """Return the usual steps, speeds and times of vehicles (V), by exposures at places (E, 3) of cameras (E).

    They are those from one image of a camera to its next: where several expose in turn, the next is there at once.
    """
    of_all, group = _upper(steps, track.group), track.group
    vehicles = int(group.max(initial=-1)) + 1
    code = group * (int(camera.max(initial=0)) + 1) + camera
    if len(np.unique(code)) == vehicles:
        return of_all
    by_camera = np.lexsort((code, group))
    clock = np.cumsum(np.nan_to_num(track.taken))[by_camera]
    taken = np.where(np.isnan(track.taken[by_camera]), np.nan, np.diff(clock, prepend=np.nan))
    of_camera = _upper(Steps.of(place_m.take(by_camera, axis=0), code[by_camera], taken), group)
    step_m, speed, taken = (np.where(np.isnan(own), both, own) for own, both in zip(of_camera, of_all, strict=True))
    return step_m, speed, taken


def _upper(steps: Steps, group: Ints) -> tuple[Floats, Floats, Floats]:
    """Return the upper quartiles of steps, speeds and times of groups (E), which neither stops nor gaps move."""
    step_m, speed, taken = (quantiles(values, group, 0.75) for values in (steps.step_m, steps.speed, steps.taken))
    return step_m, speed, taken


def find_cuts(place_m: Floats, track: Track, steps: Steps, own: Usual, usual: Usual) -> Cuts:
    """Return where along the exposures (E) of vehicles drives begin.

    `own` is what is usual for each of these vehicles, `usual` for all.
    """
    begins, step_m, taken = steps.begins, steps.step_m, steps.taken
    if len(begins) < 2:
        return Cuts(begins, {})
    usual_m, usual_speed, usual_taken = (
        _usual(getattr(own, name), getattr(usual, name))[track.group] for name in ("step_m", "speed", "taken")
    )
    timed = track.told_by == TIME
    with np.errstate(divide="ignore", invalid="ignore"):
        far = step_m > _GAP_STEPS * usual_m
        too_fast = ~(step_m <= _JUMP_SPEEDS * usual_speed * taken)  # Also where there is no clock.
        waited = taken - step_m / np.where(usual_speed > 0.0, usual_speed, np.inf)
        pause = timed & (waited > _PAUSE_STEPS * usual_taken) & (far | (waited > _STOP_STEPS * usual_taken))
    jump = far & too_fast & ~pause
    drive = np.cumsum(begins | jump | pause)
    revisit = _revisits(place_m, drive, usual_m, track.told_by != CHAIN, usual.ground_axes)
    reasons = {"pauses": pause, "jumps": jump, "revisits": revisit}
    counts = {name: int(mask.sum()) for name, mask in reasons.items() if mask.any()}
    return Cuts(begins | jump | pause | revisit, counts)


def _usual(own: Floats, of_all: Floats) -> Floats:
    """Return what is usual for each of some vehicles: the upper quartile, which neither stops nor gaps move.

    It is at least half of what is usual among all, so that one that mostly stands has the speed of the others.
    """
    known = of_all[~np.isnan(of_all)]
    floor = 0.5 * np.median(known) if len(known) else np.nan
    return np.asarray(np.maximum(own, floor))


def _revisits(place_m: Floats, drive: Ints, usual_m: Floats, may: Bools, ground: Ints) -> Bools:
    """Return where (E) a drive comes back to where it has been, having left: what follows is a drive of its own.

    A place is as wide as some usual steps, on the ground (the axes `ground`). Way is made from place to place: poses of
    a standing car tremble, by as much as a step where there are many in a second.
    """
    near_m = np.where((usual_m > 0.0) & may, _REVISIT_STEPS * usual_m, np.nan)
    begins = begins_of_runs(drive)
    opens = _core.viewpoint_openings(place_m / near_m[:, None], begins, 1.0)
    opened = np.flatnonzero(opens)[np.cumsum(opens) - 1]
    way_m = way_from_place_to_place(place_m, begins, opens) + lengths(place_m - place_m.take(opened, axis=0))
    return _core.revisits(place_m, drive, way_m, near_m, _AWAY_STEPS * usual_m, ground.tolist())
