"""One pass in a world of its own: another unit, or other axes, of both its positions and its rotations.

Its own rays meet, as all that they see is scaled or turned with it. But what it sees is nowhere near what others see,
unless it is read in their world. Where that begins may be elsewhere, too, so any shift is allowed beside it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np

from valuemap.arrays import Floats
from valuemap.check.fault import LEAST_CHANCE, NEAR_STEPS, Fault, Finding, Stage, View, with_pass_moved
from valuemap.check.meeting import Match, Meeting, meeting_of_passes

_NED = "north, east, down"
_WORLDS: dict[str, Floats] = {
    "feet": 0.3048 * np.eye(3),
    _NED: np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "east, up, south (y up)": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Takes a place in it to x east, y north, z up, in metres."""


class PassFrame(Fault):
    """A pass in another unit, or in other axes, than the others."""

    name: ClassVar[str] = "pass_frame"
    stage: ClassVar[Stage] = "fine"

    def find(self, view: View) -> Finding | None:
        """Read each pass in other worlds: most of its points must fall on those of others then, by one shift of all."""
        meeting = meeting_of_passes(view)
        if meeting is None or view.dataset.frame.up != (0.0, 0.0, 1.0):
            return None
        tried = meeting.passes_of_most_points()
        tests, found = len(tried) * len(_WORLDS), []
        for code in tried:
            if _sees_what_others_see(meeting, code, NEAR_STEPS * view.step_m):
                continue
            as_given = meeting.best_match(code, view.step_m / 2.0)
            for world, axes in _WORLDS.items():
                match = _turned(meeting, code, axes).best_match(code, view.step_m / 2.0)
                if match is None:
                    continue
                others = max(match.met_by_next, 0 if as_given is None else as_given.met)
                chance = match.chance_against(others) * tests
                if chance < LEAST_CHANCE:
                    name = view.dataset.images.pass_id.names[code]
                    found.append((match.met - others, _finding(meeting, code, name, world, match, others, chance)))
        return max(found, key=lambda each: each[0])[1] if found else None


def _sees_what_others_see(meeting: Meeting, code: int, within_m: float) -> bool:
    """Return whether most points of a pass have one of others within a distance as they are: it is in their world."""
    own, _ = meeting.differences(code, within_m=within_m)
    return len(np.unique(own)) > 0.5 * float((meeting.pass_of_point == code).sum())


def _turned(meeting: Meeting, code: int, axes: Floats) -> Meeting:
    """Return the points with those of a pass in another world, relative to where its middle is then."""
    mine = (meeting.pass_of_point == code)[:, None]
    return replace(meeting, point=np.where(mine, meeting.point @ axes.T, meeting.point))


def _finding(meeting: Meeting, code: int, name: str, world: str, match: Match, others: int, chance: float) -> Finding:
    axes, middle = _WORLDS[world], meeting.middle_in_world_m
    offset_m, points = match.offset_m + middle - axes @ middle, int((meeting.pass_of_point == code).sum())
    return Finding(
        fault=PassFrame.name,
        what=f"Pass {name} is in another world than the others: {world}.",
        why=f"Read so, and moved by {np.linalg.norm(offset_m):.2f} m, {match.met} of {points} things that it sees are "
        f"where others see such; otherwise at most {others} are.",
        do="Import it in metres, x east, y north, z up, as the others.",
        chance=chance,
        figures={
            "pass": name,
            "world": world,
            "points_if_read_so": match.met,
            "points_otherwise": others,
            "shift_m": [round(float(part), 3) for part in offset_m],
        },
        fix=partial(with_pass_moved, name=name, axes=axes, offset_m=offset_m),
        of=f"pass {name}",
    )
