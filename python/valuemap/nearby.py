"""Which points are near each other, where SciPy's trees would take longer to import than to ask."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from valuemap.arrays import Bools, Floats, Ints

ONE_PLACE_CHI2 = 16.27
"""Squared distance, in sigmas, that two measures of one place exceed in one case of a thousand (chi-square, 3 axes)."""
_AT_ONCE = 2**20
"""So many pairs are looked at in one go: 0.1 GB."""
_ROUNDING = 1.0 + 1e-9


class Nearby:
    """Points (M, D), sorted along the axis on which they lie farthest apart: only those in a strip are looked at."""

    def __init__(self, points_m: Floats) -> None:
        self._axis = int(np.argmax(np.ptp(points_m, axis=0))) if len(points_m) else 0
        self._order = np.argsort(points_m[:, self._axis], kind="stable")
        self._points_m = points_m[self._order]
        self._along_m = np.ascontiguousarray(self._points_m[:, self._axis])

    def pairs(self, places_m: Floats, reach_m: float) -> tuple[Ints, Ints]:
        """Return the places (rows of N, D; ascending) and points (rows) that are no farther apart than `reach_m`."""
        found = list(self._found(places_m, reach_m))
        none = np.empty(0, np.int64)
        place, point = (np.concatenate([none, *(part[side] for part in found)]) for side in (0, 1))
        return place, self._order[point]

    def have_any(self, places_m: Floats, reach_m: float) -> Bools:
        """Return which places (N, D) have a point no farther away than `reach_m`."""
        has = np.zeros(len(places_m), np.bool_)
        for place, _ in self._found(places_m, reach_m):
            has[place] = True
        return has

    def _found(self, places_m: Floats, reach_m: float) -> Iterator[tuple[Ints, Ints]]:
        """Yield pairs of places (rows) and points (in their order along the axis), some places at a time."""
        at_m, wide_m = places_m[:, self._axis], reach_m * _ROUNDING
        first = np.searchsorted(self._along_m, at_m - wide_m, side="left")
        count = np.searchsorted(self._along_m, at_m + wide_m, side="right") - first
        before = np.cumsum(count) - count
        begin = 0
        while begin < len(places_m):
            end = max(begin + 1, int(np.searchsorted(before, before[begin] + _AT_ONCE, side="right")) - 1)
            end = len(places_m) if before[-1] + count[-1] <= before[begin] + _AT_ONCE else end
            place = np.repeat(np.arange(begin, end), count[begin:end])
            point = np.arange(len(place)) - np.repeat(
                before[begin:end] - before[begin] - first[begin:end], count[begin:end]
            )
            away_m = self._points_m[point] - places_m[place]
            near = np.einsum("ni,ni->n", away_m, away_m) <= reach_m**2
            yield place[near], point[near]
            begin = end
