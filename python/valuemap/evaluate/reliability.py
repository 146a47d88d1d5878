"""Whether the probability of existence means what it says: of labels that exist with 0.9, nine in ten should."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from valuemap.evaluate.matching import Matches
from valuemap.tables import Labels

LIMITS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)
"""The ranges of existence; each holds its lower limit, the last one both."""


@dataclass(frozen=True)
class ExistenceRange:
    """Labels whose existence lies in a range: how many, how many are true, and what the map says on average."""

    low: float
    high: float
    labels: int
    true_labels: int
    true_share: float
    mean_existence: float

    def to_json(self) -> dict[str, int | float]:
        """Return the figures by name."""
        return dataclasses.asdict(self)


def measure_reliability(labels: Labels, matches: Matches) -> tuple[ExistenceRange, ...] | None:
    """Return one entry a range that has labels, in ascending order; None where the map has no existence.

    A duplicate is not true.
    """
    if labels.existence is None:
        return None
    existence, is_true = labels.existence, matches.object_of_label >= 0
    of_range = np.clip(np.searchsorted(LIMITS, existence, side="right") - 1, 0, len(LIMITS) - 2)
    ranges = []
    for row in np.unique(of_range).tolist():
        inside = of_range == row
        ranges.append(
            ExistenceRange(
                low=LIMITS[row],
                high=LIMITS[row + 1],
                labels=int(inside.sum()),
                true_labels=int(is_true[inside].sum()),
                true_share=float(is_true[inside].mean()),
                mean_existence=float(existence[inside].mean()),
            )
        )
    return tuple(ranges)
