"""Segments that were laid onto the wrong things: a row of like things fits onto itself, one thing further on.

What a segment then votes for agrees with where it was laid, whatever that is, on held-out objects too. What tells is
all that it sees, and all that the other segments see: where it was laid it must meet more of that than where most
segments are, or it stays there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.refine.adjust import triangulate
from valuemap.refine.estimate import LEAST_VOTES, Estimate, apparent_shift, associated, seen_by, segments_of
from valuemap.refine.footage import Footage
from valuemap.refine.residuals import OFFSET, Observations, State
from valuemap.refine.tracks import GATE_SIGMAS, associate

BEYOND_DRIFT = 2.0
"""What is no more than so many deviations of drift is drift."""
_ROUNDS = 2
"""Times that a segment is moved by what its residuals say of it, within drift."""


def without_aliases(footage: Footage, found: Estimate, range_m: float) -> Estimate:
    """Return an estimate whose segments are far from where most are only if they meet more of the objects there.

    A segment that does not is put back, and sees what it sees from there.
    """
    seen, offset = seen_by(footage, found), found.state.constants[OFFSET]
    weight = np.bincount(seen.segment, minlength=len(offset))
    agreed = agreed_shift(offset, np.ones_like(offset, np.bool_), weight)
    if np.count_nonzero(weight) < 3:  # Of two, one is where it is: put back both, and nothing says where.
        agreed = offset[int(np.argmax(weight))]
    far = np.linalg.norm((offset - agreed)[:, :2], axis=1) > BEYOND_DRIFT * found.scales.drift_m
    tried = np.flatnonzero(far & (weight > 0))
    # Two coordinates by Bayes' information criterion, and so many segments were looked at.
    price = 2.0 * math.log(max(len(seen), 2)) + 2.0 * math.log(max(len(tried), 1))
    of_image = segments_of(footage, found.segments)
    back: dict[int, Floats] = {}
    for segment in tried.tolist():
        witnesses = _Witnesses.of(footage, found, seen, of_image, segment, range_m)
        there, here = witnesses.met(offset[segment]), witnesses.met(agreed)
        if there[0] - here[0] <= price:
            back[segment] = here[1]
    if not back:
        return found
    offset = offset.copy()
    for segment, value in back.items():
        offset[segment] = value
    moved = np.isin(of_image, list(back))
    stays = ~moved[footage.rays.image_row[found.detection]]
    state = _at_rest(found.state.with_offset(offset), footage, moved)
    kept = replace(found, detection=found.detection[stays], thing=found.thing[stays], state=state)
    return associated(footage, kept, range_m)


def agreed_shift(offset: Floats, active: Bools, weight: Ints) -> Floats:
    """Return the place (3) on which most segments agree: those that are off do not move it.

    It is the median of the offsets (L, 3) that are `active`, weighted by their observations (L).
    """
    shift = np.zeros(3)
    for axis in range(3):
        rows = np.flatnonzero(active[:, axis])
        if len(rows) < 3:
            continue
        value, of = offset[rows, axis], weight[rows]
        order = np.argsort(value, kind="stable")
        share = np.cumsum(of[order])
        shift[axis] = value[order[np.searchsorted(share, 0.5 * share[-1])]]
    return shift


@dataclass(frozen=True, eq=False)
class _Witnesses:
    """The objects `seen` by other segments, where these have them, for one `segment`.

    `of_image` (I) is the segment of each image.
    """

    footage: Footage
    seen: Estimate
    of_image: Ints
    segment: int
    range_m: float

    @staticmethod
    def of(
        footage: Footage, found: Estimate, seen: Observations, of_image: Ints, segment: int, range_m: float
    ) -> _Witnesses:
        """Return those of a segment: what it sees itself is placed anew without it."""
        count, own = len(found.class_code), seen.segment == segment
        others = np.bincount(seen.thing[~own], minlength=count) >= LEAST_VOTES
        shared = np.zeros(count, np.bool_)
        shared[seen.thing[own]] = True
        state = triangulate(seen.take(~own & (shared & others)[seen.thing]), found.state)
        state = replace(state, point_in_world_m=state.point_in_world_m[others])
        state = _at_rest(state, footage, of_image == segment)
        by_others = replace(found, state=state, class_code=found.class_code[others], size_m=found.size_m[others])
        return _Witnesses(footage, by_others, of_image, segment, range_m)

    def met(self, offset: Floats) -> tuple[float, Floats]:
        """Return how much of what the segment sees meets objects, and where, when it is laid about there.

        Each detection that meets one is worth what it is nearer than the gate, in squares of sigmas.
        """
        best, at, seen = -1.0, offset, self.seen
        images = np.flatnonzero(self.of_image == self.segment)
        for _ in range(_ROUNDS + 1):
            offsets = seen.state.constants[OFFSET].copy()
            offsets[self.segment] = at
            state = seen.state.with_offset(offsets)
            detection, thing, square = associate(
                self.footage, state, seen.class_code, seen.size_m, self.of_image, seen.sigma_px, self.range_m, images
            )
            worth = float(np.sum(GATE_SIGMAS**2 - square))
            if worth <= best:
                break
            best, offset = worth, at
            if not len(detection):
                break
            shown = self.footage.observe(detection, thing, self.of_image, seen.sigma_px)
            shift, information, _ = apparent_shift(self.footage, shown, state)
            total = information.sum(axis=0) + np.eye(3) / seen.scales.drift_m**2
            pull = np.einsum("nij,nj->i", information, shift - offset)
            at = offset + np.linalg.solve(total, pull)
        return best, offset


def _at_rest(state: State, footage: Footage, images: Bools) -> State:
    """Return a state in which some images (flags) have no error but that of their segment."""
    drift, own = state.drift.copy(), state.own.copy()
    drift[np.unique(footage.node[images])] = 0.0
    own[images] = 0.0
    return replace(state, drift=drift, own=own)
