"""The floor of chance: how many labels match a truth that has been moved away, and so can mean nothing."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from valuemap.dataset import Frame
from valuemap.evaluate.figures import share, to_json
from valuemap.evaluate.matching import match_labels
from valuemap.evaluate.truth import TrueObjects
from valuemap.tables import Labels

SHIFT_M = 20.0
"""Farther than any error, near enough that streets and junctions stay as dense."""
RADII_AWAY = 4.0
"""With a large radius the shift is so many of them, that no label reaches its own object."""


@dataclass(frozen=True)
class ChanceFloor:
    """Matches after a shift of the truth by `shift_m`, the mean over shifts to the east, north, west and south.

    A precision or recall means as much as it stands above these.
    """

    shift_m: float
    matches: float
    precision: float
    recall: float

    def to_json(self) -> dict[str, float | None]:
        """Return the figures by name, None where there is nothing to count."""
        return to_json(dataclasses.asdict(self))


def measure_chance(labels: Labels, objects: TrueObjects, frame: Frame, *, radius_m: float) -> ChanceFloor:
    """Match labels with the truth moved away in four directions, in the same way as with the truth where it is."""
    shift_m = max(SHIFT_M, RADII_AWAY * radius_m)
    east, north = shift_m * frame.east_north()
    counts, recalls = [], []
    for shift in (east, north, -east, -north):
        moved = dataclasses.replace(objects, position_in_world_m=objects.position_in_world_m + shift)
        matches = match_labels(labels, moved, frame, radius_m=radius_m)
        counts.append(int(np.sum(matches.object_of_label >= 0)))
        recalls.append(int(np.sum((matches.label_of_object >= 0) & objects.counts_in_recall)))
    matched, recoverable = sum(counts) / len(counts), int(objects.counts_in_recall.sum())
    return ChanceFloor(
        shift_m=shift_m,
        matches=matched,
        precision=share(matched, len(labels)),
        recall=share(sum(recalls) / len(recalls), recoverable),
    )
