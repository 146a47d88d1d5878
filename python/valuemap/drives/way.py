"""The lengths of ways along places, and whether places are in driving order."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Bools, Floats, Ints, rows_in_runs
from valuemap.drives.runs import edges_of_runs

_WINDOW = 16
"""Exposures in a row that are looked at together: in random order their way is 5.7 times as long as they are wide."""
CLEARLY_LONGER = 2.0
"""An order whose way is longer than the chain of nearest poses by this factor is none."""
_PARTS_OF_A_METRE = 2.0**26
"""Ways are summed in such parts: sums of a whole fleet, 130,000 km, are exact."""


def lengths(vectors: Floats) -> Floats:
    """Return the lengths (N) of vectors (N, 3)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))  # Several times as fast as the norm of NumPy.


def steps_m(place_m: Floats) -> Floats:
    """Return how far each of some places (N, 3) in a row is from the one before, the first 0."""
    step_m = np.zeros(len(place_m))
    step_m[1:] = lengths(place_m[1:] - place_m[:-1])
    return step_m


def summed_m(step_m: Floats) -> Floats:
    """Return the way up to each of some steps (N), to 15 nm: then no sum depends on other drives."""
    return np.asarray(np.cumsum(np.rint(step_m * _PARTS_OF_A_METRE).astype(np.int64)) / _PARTS_OF_A_METRE)


def way_from_place_to_place(place_m: Floats, begins: Bools, opens: Bools) -> Floats:
    """Return how far drives had come, m (N), where the place of each exposure opened.

    Exposures (N, 3) are in a row; `begins` says which begin a drive, `opens` which open a new place. What trembles
    within a place makes no way.
    """
    start = np.flatnonzero(opens)
    way_m = steps_m(place_m.take(start, axis=0))
    way_m[begins[start]] = 0.0
    total_m = summed_m(way_m)
    at_begin_m = np.maximum.accumulate(np.where(begins[start], total_m, 0.0))
    return np.asarray((total_m - at_begin_m)[np.cumsum(opens) - 1])


def way_length_m(place_m: Floats) -> float:
    """Return the length of a way along places (N, 3)."""
    return float(steps_m(place_m).sum())


def are_ways(place_m: Floats, group: Ints) -> Bools:
    """Return for each group of places (N, 3) in a row whether they surely are in driving order.

    No order is shorter than its places are wide. So one that, cut into short windows, is little longer than these
    windows are wide, goes ahead nearly everywhere.
    """
    runs = edges_of_runs(group)
    starts = np.flatnonzero(rows_in_runs(0, np.diff(runs)) % _WINDOW == 0)
    if not len(starts):
        return np.empty(0, np.bool_)
    step_m = steps_m(place_m)
    step_m[starts] = 0.0
    way_m = np.add.reduceat(step_m, starts)
    width_m = lengths(np.maximum.reduceat(place_m, starts) - np.minimum.reduceat(place_m, starts))
    of = np.searchsorted(runs, starts, side="right") - 1
    groups = len(runs) - 1
    ways_m, widths_m = np.bincount(of, way_m, groups), np.bincount(of, width_m, groups)
    return np.asarray(ways_m <= CLEARLY_LONGER * widths_m)


def azimuths_along(place_m: Floats, drive: Ints, east: Floats, north: Floats) -> tuple[Floats, Bools]:
    """Return the azimuth (N) in radians in which each of some places (N, 3) is driven through, and which (N) move.

    The places of a drive (a number, N) are in a row and in driving order; `east` and `north` are unit vectors (3).
    Where the vehicle stands it is the azimuth with which it came, or with which it drives off.
    """
    step = np.zeros((len(place_m), 3))
    same = np.diff(drive) == 0
    inside = (same[1:] & same[:-1])[:, None]
    step[1:-1] = np.where(inside, place_m[2:] - place_m[:-2], 0.0) if len(place_m) > 2 else 0.0
    first = np.flatnonzero(np.diff(drive, prepend=-1) != 0)
    last = np.append(first[1:], len(place_m)) - 1
    many = last > first
    step[first[many]] = place_m[first[many] + 1] - place_m[first[many]]
    step[last[many]] = place_m[last[many]] - place_m[last[many] - 1]
    length = np.hypot(step @ east, step @ north)
    # A vehicle may stand for most of its images, whose places tremble: a quarter at least are taken on the way.
    typical = np.quantile(length[length > 0.0], 0.75) if np.any(length > 0.0) else 1.0
    moves = length > 0.2 * typical
    azimuth = np.arctan2(step @ east, step @ north)
    return azimuth[_nearest_known(moves, first, last)], np.asarray(moves)


def _nearest_known(is_known: Bools, first: Ints, last: Ints) -> Ints:
    """Return for each of some rows (N) the known one before it in its drive, else the one after, else itself.

    Drives go from a `first` row to a `last` one.
    """
    row, drive = np.arange(len(is_known)), np.repeat(np.arange(len(first)), last - first + 1)
    before = np.maximum.accumulate(np.where(is_known, row, -1))
    after = np.minimum.accumulate(np.where(is_known, row, len(row))[::-1])[::-1]
    return np.where(before >= first[drive], before, np.where(after <= last[drive], after, row))
