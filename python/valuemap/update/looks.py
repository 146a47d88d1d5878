"""The opportunities to see an object: all that was taken from one viewpoint of a drive is one look.

How likely an object that is there is seen in the looks of a drive is the share `recall` of them that the map found, but
for drives in which it is hidden all the way, or seen from where it is not detected. How likely one that is not there is
"seen" is the share of looks in which something else is taken for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valuemap.drives import Drives
from valuemap.evidence import Evidence
from valuemap.tables import Bools, Floats, Ints

HIDDEN_DRIVES = 0.02
"""The share of drives in which an object that is there cannot be seen. One drive alone shows that a thing is gone if it
had three looks or more."""
FALSE_LOOKS = 0.02
"""The share of looks in which something else is taken for an object that is not there."""
RECALL_BOUNDS = (0.3, 0.95)
"""Rates beyond these are not believed."""
SURE = math.log(20.0)
"""Log of the odds from which on something is there, or is not: 20 to 1."""


@dataclass(frozen=True)
class Looks:
    """How often some drives looked at an object, in how many of these looks they saw it, and when.

    `log_odds` is by how much they speak for the object: the logarithm of the likelihood ratio. Times are NaN where
    images have none.
    """

    looks: int
    hits: int
    log_odds: float
    first_s: float
    last_s: float

    @property
    def misses(self) -> int:
        """Looks that should have seen it and did not."""
        return self.looks - self.hits

    @property
    def say_there(self) -> bool:
        """Whether they show that it is there."""
        return self.log_odds > SURE

    @property
    def say_gone(self) -> bool:
        """Whether they show that it is not."""
        return self.log_odds < -SURE


class Lookout:
    """Counts looks at the labels of a map in one of two epochs; `is_new` (images) tells the images of the second."""

    def __init__(self, evidence: Evidence, drives: Drives, is_new: Bools, recall: float) -> None:
        self._evidence, self._drives, self._is_new = evidence, drives, is_new
        self._recall = min(max(recall, RECALL_BOUNDS[0]), RECALL_BOUNDS[1])

    def at(self, label_id: int) -> tuple[Looks, Looks]:
        """Return the looks of the first epoch, and of the second, at a label."""
        hit = self._evidence.image_row[self._evidence.vote_rows(label_id)]
        place = self._evidence.result.labels.position_in_world_m[self._evidence.label_row(label_id)]
        missed = self._evidence.should_have_seen(place, hit)
        image = np.concatenate([hit, missed])
        is_hit = np.arange(len(image)) < len(hit)
        return self._looks(image, is_hit, new=False), self._looks(image, is_hit, new=True)

    def _looks(self, image: Ints, is_hit: Bools, *, new: bool) -> Looks:
        here = self._is_new[image] == new
        image, is_hit = image[here], is_hit[here]
        if not len(image):
            return Looks(0, 0, 0.0, math.nan, math.nan)
        views, view = np.unique(self._drives.viewpoint[image], return_inverse=True)
        was_hit = np.bincount(view, is_hit, len(views)) > 0
        drive = np.empty(len(views), np.int64)
        drive[view] = self._drives.pass_code[image]
        _, of = np.unique(drive, return_inverse=True)
        hits = np.bincount(of, was_hit).astype(np.int64)
        looks = np.bincount(of)
        odds = sum(self._log_odds(int(h), int(n)) for h, n in zip(hits, looks, strict=True))
        time = self._evidence.dataset.images.timestamp_s
        first, last = (math.nan, math.nan) if time is None else _range(time[image])
        return Looks(len(views), int(was_hit.sum()), odds, first, last)

    def _log_odds(self, hits: int, looks: int) -> float:
        """Return the logarithm of how much likelier the looks of a drive are if the object is there."""
        r, c = self._recall, FALSE_LOOKS
        ratio = hits * math.log(r / c) + (looks - hits) * math.log((1.0 - r) / (1.0 - c))
        return float(np.logaddexp(math.log(1.0 - HIDDEN_DRIVES) + ratio, math.log(HIDDEN_DRIVES)))


def _range(time_s: Floats) -> tuple[float, float]:
    known = time_s[~np.isnan(time_s)]
    return (float(known.min()), float(known.max())) if len(known) else (math.nan, math.nan)
