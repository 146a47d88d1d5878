"""The part of a dataset that is calibrated on: whole places, chosen by a hash of where they are.

The choice does not depend on order, ids or tiles, and hardly on what is elsewhere, so that what is learned is not
either.
"""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.tiles.grid import Census, Grid, smallest_squares

SAMPLE_DETECTIONS = 60_000
"""So many detections are calibrated on, and at most those of one place more; all of a dataset that has no more, or that
is one cell."""
_NEAR = 2
"""Places are this many of the smallest squares of the grid wide: objects in most of one are seen from it alone."""


def is_sampled(grid: Grid, census: Census, place_m: Floats, detections: int = SAMPLE_DETECTIONS) -> Bools:
    """Return which of some places (N, 2) are in a sample of about so many detections."""
    square, chosen = smallest_squares(grid, place_m), sampled_squares(census, detections)
    low = np.minimum(square.min(axis=0, initial=2**62), chosen.min(axis=0, initial=2**62))
    across = int(max(square[:, 1].max(initial=0), chosen[:, 1].max(initial=0)) - low[1]) + 1
    key, of_chosen = ((each[:, 0] - low[0]) * across + each[:, 1] - low[1] for each in (square, chosen))
    return np.isin(key, of_chosen)


def sampled_squares(census: Census, detections: int = SAMPLE_DETECTIONS) -> Ints:
    """Return the smallest squares (N, 2) of a grid that are calibrated on, ascending."""
    place, inverse = np.unique(census.square // _NEAR, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    count = np.bincount(inverse, census.detections, len(place))
    order = np.argsort(_scrambled(place), kind="stable")
    before = np.cumsum(count[order]) - count[order]
    taken = np.zeros(len(place), np.bool_)
    taken[order[before < detections]] = True
    return np.asarray(census.square[taken[inverse]])


def _scrambled(place: Ints) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    """Return numbers (N) spread over 64 bits for places (N, 2), as the core's `scramble`."""
    z = (place[:, 0].astype(np.uint64) << np.uint64(32)) ^ (place[:, 1].astype(np.uint64) & np.uint64(0xFFFFFFFF))
    z = z + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))
