"""The opportunities to see an object: all that was taken from one viewpoint of a drive is one look.

How likely an object that is there is seen in the looks of a drive is the share `recall` of them that the map found, but
for drives in which it is hidden all the way, or seen from where it is not detected. How many these are is learned from
how the drives of the first epoch saw what the map has. How likely one that is not there is "seen" is the share of looks
in which something else is taken for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.dataset import rows_of
from valuemap.drives import Drives
from valuemap.evidence import Evidence
from valuemap.map_folder import Map
from valuemap.tables import Votes

HIDDEN_OF = 50
"""Before anything is learned one in so many drives cannot see an object that is there: as much as so many drives say.
While it is that few, one drive alone shows that a thing is gone if it had looks enough: three where seven or eight of
ten looks see what is there, two where nine do, eleven where three do."""
FALSE_LOOKS = 0.02
"""The share of looks in which something else is taken for an object that is not there."""
RECALL_BOUNDS = (0.3, 0.95)
"""Rates beyond these are not believed."""
SURE = math.log(20.0)
"""Log of the odds from which on something is there, or is not: 20 to 1."""


@dataclass(frozen=True)
class Looks:
    """How often some drives looked at an object, in how many of these looks they saw it, and when.

    `log_odds` is by how much they speak for the object: the logarithm of the likelihood ratio. `seen_by` is the number
    of drives that saw it. Times are NaN where images have none.
    """

    looks: int
    hits: int
    log_odds: float
    first_s: float
    last_s: float
    seen_by: int = 0

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


@dataclass(frozen=True, eq=False)
class Sights:
    """In how many viewpoints each of some drives (D) looked at an object, and in how many of these it saw it, and when.

    Times are NaN where images have none.
    """

    looks: Ints
    hits: Ints
    first_s: float
    last_s: float


class Lookout:
    """Counts looks at the labels of a map in one of two epochs; `is_new` (images) tells the images of the second.

    `votes` are those of the labels, in their order; they are of images of the evidence, which needs no detections.
    """

    def __init__(self, evidence: Evidence, drives: Drives, is_new: Bools, votes: Votes) -> None:
        self._evidence, self._drives, self._is_new, self._votes = evidence, drives, is_new, votes
        self._image_row = rows_of(votes.image_id, evidence.dataset.images.image_id)

    def at(self, label_id: int) -> tuple[Sights, Sights]:
        """Return how the drives of the first epoch, and of the second, saw a label."""
        first, end = np.searchsorted(self._votes.label_id, [label_id, label_id + 1])
        hit = self._image_row[first:end]
        place = self._evidence.result.labels.position_in_world_m[self._evidence.label_row(label_id)]
        missed = self._evidence.should_have_seen(place, hit)
        image = np.concatenate([hit, missed])
        is_hit = np.arange(len(image)) < len(hit)
        return self._sights(image, is_hit, new=False), self._sights(image, is_hit, new=True)

    def _sights(self, image: Ints, is_hit: Bools, *, new: bool) -> Sights:
        here = self._is_new[image] == new
        image, is_hit = image[here], is_hit[here]
        views, view = np.unique(self._drives.viewpoint[image], return_inverse=True)
        was_hit = np.bincount(view, is_hit, len(views)) > 0
        drive = np.empty(len(views), np.int64)
        drive[view] = self._drives.pass_code[image]
        _, of = np.unique(drive, return_inverse=True)
        time = self._evidence.dataset.images.timestamp_s
        first, last = (math.nan, math.nan) if time is None else _range(time[image])
        return Sights(np.bincount(of), np.bincount(of, was_hit).astype(np.int64), first, last)


class Chances:
    """What looks say, where an object that is there, and not hidden, is seen in so large a share of them."""

    def __init__(self, recall: float) -> None:
        self._recall = min(max(recall, RECALL_BOUNDS[0]), RECALL_BOUNDS[1])

    @classmethod
    def of(cls, result: Map) -> Chances:
        """Return the chances of what found a map."""
        return cls(result.run["counts"].get("detection_rate", 0.5))

    def hidden_share(self, sights: Sequence[Sights]) -> float:
        """Return the share of drives that cannot see an object, of how drives saw objects that were there."""
        none = np.empty(0, np.int64)
        hits, looks = (np.concatenate([none, *(getattr(each, name) for each in sights)]) for name in ("hits", "looks"))
        blind = int(np.count_nonzero(self._ratio(hits, looks) < -SURE))
        telling = int(np.count_nonzero(self._ratio(np.zeros_like(looks), looks) < -SURE))
        return (blind + 1.0) / (telling + HIDDEN_OF)

    def looks(self, sights: Sights, hidden_share: float) -> Looks:
        """Return what looks say, where so large a share of drives cannot see an object that is there."""
        ratio = self._ratio(sights.hits, sights.looks)
        odds = np.logaddexp(math.log(1.0 - hidden_share) + ratio, math.log(hidden_share))
        return Looks(
            looks=int(sights.looks.sum()),
            hits=int(sights.hits.sum()),
            log_odds=float(odds.sum()),
            first_s=sights.first_s,
            last_s=sights.last_s,
            seen_by=int(np.count_nonzero(sights.hits)),
        )

    def _ratio(self, hits: Ints, looks: Ints) -> Floats:
        """Return the logarithms of how much likelier the looks of drives (N) are if nothing hides the object."""
        r, c = self._recall, FALSE_LOOKS
        return np.asarray(hits * math.log(r / c) + (looks - hits) * math.log((1.0 - r) / (1.0 - c)))


def _range(time_s: Floats) -> tuple[float, float]:
    known = time_s[~np.isnan(time_s)]
    return (float(known.min()), float(known.max())) if len(known) else (math.nan, math.nan)
