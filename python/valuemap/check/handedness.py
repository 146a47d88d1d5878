"""A mirrored world, or mirrored pictures, where truth tells: on straight streets every ray agrees with either.

What is to the right of a car is to its left then, and all passes say so. Only bends and crossings disagree, if they are
driven at all.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from valuemap.check.agreement import chance_of_majority, compare
from valuemap.check.boxes import MirroredPictures
from valuemap.check.fault import AGAINST, LEAST_CHANCE, Convention, Fault, Finding, Fix, Stage, View, gains_of_all
from valuemap.check.frames import MirroredWorld
from valuemap.check.quality import ENOUGH_TRUTH, certain_points, flattened, matches


class MirroredByTruth(Fault):
    """A left-handed world, or mirrored pictures, that the truth tells."""

    name: ClassVar[str] = MirroredWorld.name
    stage: ClassVar[Stage] = "results"
    explained_by: ClassVar[frozenset[str]] = frozenset({"scale"})

    def find(self, view: View) -> Finding | None:
        """See whether most points get a true object if world or pictures are mirrored, and rays agree as well."""
        truth, points = view.dataset.truth, certain_points(view)
        if truth is None or not len(truth) or not len(points) or not view.meets:
            return None
        tolerance_m = max(view.step_m / 2.0, 1e-9)
        objects = flattened(truth.position_in_world_m, truth, view)
        enough = ENOUGH_TRUTH * min(len(points), len(objects))
        here = matches(flattened(points, truth, view), objects, tolerance_m)
        if here >= enough:
            return None
        readings = list(_readings(view))
        found: list[tuple[int, Convention, str, Fix, float]] = []
        for convention, how, fix in readings:
            other = View(fix(view.dataset), gate_share=view.gate_share)
            there = matches(flattened(certain_points(other), truth, other), objects, tolerance_m)
            chance = chance_of_majority(there, there + here) * len(readings)
            if there < enough or chance > LEAST_CHANCE:
                continue
            if compare(gains_of_all(view, view.dataset), gains_of_all(view, other.dataset)).chance > AGAINST:
                found.append((there, convention, how, fix, chance))
        if not found:
            return None
        there, convention, how, fix, chance = max(found, key=lambda each: each[0])
        return Finding(
            fault=convention.name,
            what=convention.what,
            why=f"Of {len(points)} points where many rays meet {here} have a true object within {tolerance_m:.2g} m, "
            f"read as {how} {there}; rays agree with both.",
            do=convention.do,
            chance=chance,
            figures={"reading": how, "points": len(points), "matched": here, "matched_if_read_so": there},
            fix=fix,
        )


def told_by_truth(view: View, finding: Finding | None) -> Finding | None:
    """Return a reading of all data that rays prefer, or the one of world and pictures that truth tells in its place."""
    if finding is None or finding.of is not None or finding.fault not in (MirroredWorld.name, MirroredPictures.name):
        return finding
    return MirroredByTruth().find(view) or finding


def _readings(view: View) -> Iterator[tuple[Convention, str, Fix]]:
    mirrored = (MirroredWorld(), MirroredPictures())
    for convention in mirrored:
        for how, fix in convention.readings(view.dataset):
            if convention is mirrored[0] or how == MirroredPictures.left_and_right:
                yield convention, how, fix
