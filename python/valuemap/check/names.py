"""One kind of object that has two names, so that detections of the one never support those of the other."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Floats
from valuemap.check.agreement import Comparison, agreement_on, chance_of_majority, compare
from valuemap.check.fault import (
    AGAINST,
    FAR_WORSE,
    LEAST_CHANCE,
    LEAST_RISE,
    NEAR_STEPS,
    Fault,
    Finding,
    Stage,
    View,
    with_detections,
)
from valuemap.dataset import Dataset
from valuemap.tables import Categories

_LEAST_VOTES = 4
"""Fewer rays may meet by chance."""
_LEAST_OBJECTS = 6
_OFTEN = 1.0 / 3.0
"""Of a detector that takes one kind for another in one of four pictures few objects have both names so often."""


class TwoNames(Fault):
    """Two classes that are one kind of object: its states, its front and back, or the names of two sources."""

    name: ClassVar[str] = "two_names"
    stage: ClassVar[Stage] = "results"  # When rays meet as well as they can.

    def find(self, view: View) -> Finding | None:
        """Look for classes at the same places whose rays agree better under one name, and make points together then.

        Two objects on one pole are seen side by side. Under one name a point of them has no vote more.
        """
        classes, told = points_of_classes(view), []
        pairs = list(itertools.combinations(sorted(classes, key=lambda each: (-len(classes[each]), each)), 2))
        for name, rarer in pairs:
            if not _are_near(classes[name], classes[rarer], NEAR_STEPS * view.step_m):
                continue
            joined = joined_as_one(view, name, rarer)
            if joined.chance * len(pairs) < LEAST_CHANCE and joined.is_borne_out(len(pairs)):
                told.append(joined)
        return _finding(max(told, key=lambda each: each.gain.difference), len(pairs)) if told else None


@dataclass(frozen=True)
class _Joined:
    """Two classes under the name of the commoner one.

    Of the `objects` that the rarer one often votes for, so many are `shared`: the other one often does, too. `gain` is
    how much better all rays agree than as `given`. As a fix it calls both by one name.
    """

    name: str
    rarer: str
    shared: int
    objects: int
    gain: Comparison
    given: float
    kept: str
    """The commoner name; of two that are about as common the plainer one."""

    @property
    def chance(self) -> float:
        """How likely so many are shared, were it as many as not at most."""
        return chance_of_majority(self.shared, self.objects)

    def is_borne_out(self, pairs: int) -> bool:
        """Return whether rays agree better, as they do not if two objects are side by side."""
        return self.gain.chance * pairs < AGAINST and self.gain.difference >= LEAST_RISE * self.given

    def __call__(self, dataset: Dataset) -> Dataset:
        return _with_one_name(dataset, self.kept, self.rarer if self.kept == self.name else self.name)


def _with_one_name(dataset: Dataset, name: str, rarer: str) -> Dataset:
    """Return the dataset with one name for both, in the truth, too."""

    def renamed(column: Categories) -> Categories:
        return Categories.from_texts([name if each == rarer else each for each in column.texts()])

    truth = dataset.truth
    if truth is not None:
        truth = truth.replace(class_name=renamed(truth.class_name))
    return Dataset(
        **{
            **vars(with_detections(dataset, class_name=renamed(dataset.detections.class_name))),
            "truth": truth,
        }
    )


def joined_as_one(view: View, name: str, rarer: str) -> _Joined:
    """Return how rays meet at many places if two names are one."""
    sample, column = view.many_places, view.many_places.dataset.detections.class_name
    as_given = view.agreement_at_many_places.gain
    agreement = agreement_on(sample, _with_one_name(sample.dataset, name, rarer), view.gate_px)
    voters, starts = agreement.found.voters.astype(np.int64), agreement.found.voter_offsets[:-1]
    of_name, of_rarer = (
        np.add.reduceat((column.codes[voters] == column.code_of(each)).astype(np.int64), starts)
        for each in (name, rarer)
    )
    votes = of_name + of_rarer
    is_object = (votes >= _LEAST_VOTES) & (of_rarer >= _OFTEN * votes)
    is_shared = is_object & (of_name >= _OFTEN * votes)
    gain = compare(agreement.gain, as_given)
    kept = name_of_both(view.dataset.detections.class_name, name, rarer)
    return _Joined(name, rarer, int(is_shared.sum()), int(is_object.sum()), gain, float(as_given.sum()), kept)


def name_of_both(column: Categories, name: str, other: str) -> str:
    """Return the commoner of two names; of two that are about as common that with fewer words or letters."""
    first, second = (int((column.codes == column.code_of(each)).sum()) for each in (name, other))
    if min(first, second) < FAR_WORSE * max(first, second):
        return name if first > second else other
    return min((name, other), key=lambda each: (len(re.split(r"[\W_]+", each)), len(each), each))


def _finding(joined: _Joined, pairs: int) -> Finding:
    gain = joined.gain
    return Finding(
        fault=TwoNames.name,
        what=f"One kind of object has two names: {joined.name!r} and {joined.rarer!r}.",
        why=f"Of {joined.objects} objects that are often called {joined.rarer!r}, {joined.shared} are as often called "
        f"{joined.name!r}; under one name the agreement of rays rises by {gain.difference:.0f} ({gain.places} places).",
        do=f"Give each object one class, whatever its state, its side or the source; the fix takes {joined.kept!r}.",
        chance=joined.chance * pairs,
        figures={
            "classes": [joined.name, joined.rarer],
            "kept": joined.kept,
            "shared": joined.shared,
            "objects": joined.objects,
            **gain.to_json(),
        },
        fix=joined,
    )


def points_of_classes(view: View) -> dict[str, Floats]:
    """Return for each class the points (N, 3) that many rays meet at."""
    agreement = view.agreement_at_many_places
    found = agreement.found
    if not len(found) or not view.meets:
        return {}
    is_certain = np.diff(found.voter_offsets) >= _LEAST_VOTES
    code = agreement.rays.class_code[found.voters[found.voter_offsets[:-1]].astype(np.int64)]
    names = view.dataset.detections.class_name.names
    points = {name: found.position_in_world_m[is_certain & (code == number)] for number, name in enumerate(names)}
    return {name: each for name, each in points.items() if len(each) >= _LEAST_OBJECTS}


def _are_near(points: Floats, others: Floats, within_m: float) -> bool:
    """Return whether most of the others (M, 3) have one of the points (N, 3) within a distance."""
    return float(np.mean(np.asarray(cKDTree(points).query(others)[0]) <= within_m)) >= FAR_WORSE
