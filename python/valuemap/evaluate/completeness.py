"""Completeness as ISO 19157 has it: what is there and should not be, and what should be there and is not.

Its measures are the numbers and rates of excess items (2, 3), duplicate feature instances (4), and missing items
(6, 7), with rates over the number of items that should be present. Here an item is a label, and every true object
should be present, recoverable or not.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from valuemap.evaluate.figures import share, to_json
from valuemap.evaluate.matching import LABEL_OUTCOMES, Matches


@dataclass(frozen=True)
class Completeness:
    """Counts, and rates; NaN of nothing.

    A split object is found and has a second label within the radius that no other object took; a merged label is true
    and has a second object within the radius that no other label took. Their rates are over the true labels.
    """

    items: int
    excess_items: int
    excess_rate: float
    duplicate_items: int
    missing_items: int
    missing_rate: float
    missing_not_recoverable: int
    split_objects: int
    split_rate: float
    merged_labels: int
    merge_rate: float

    def to_json(self) -> dict[str, int | float | None]:
        """Return the figures by name, None where there is nothing to count."""
        return to_json(dataclasses.asdict(self))


def measure_completeness(matches: Matches) -> Completeness:
    """Count what is in excess and what is missing."""
    items, matched = len(matches.label_of_object), int(np.sum(matches.object_of_label >= 0))
    is_missing = matches.label_of_object < 0
    excess, missing = len(matches.object_of_label) - matched, int(is_missing.sum())
    split, merged = int(matches.is_split_object.sum()), int(matches.is_merged_label.sum())
    duplicate = LABEL_OUTCOMES.index("duplicate")
    return Completeness(
        items=items,
        excess_items=excess,
        excess_rate=share(excess, items),
        duplicate_items=int(np.sum(matches.label_outcome.codes == duplicate)),
        missing_items=missing,
        missing_rate=share(missing, items),
        missing_not_recoverable=int(np.sum(is_missing & ~matches.objects.counts_in_recall)),
        split_objects=split,
        split_rate=share(split, matched),
        merged_labels=merged,
        merge_rate=share(merged, matched),
    )
