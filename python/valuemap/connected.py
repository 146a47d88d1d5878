"""Which things belong together, where some pairs of them do."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Ints


def connected(a: Ints, b: Ints, count: int) -> Ints:
    """Return the lowest member (count) of the connected group of each of `count` things, of which pairs are one."""
    lowest = np.arange(count)
    a, b = np.unique(np.stack([a, b]), axis=1)
    while True:
        least = np.minimum(lowest[a], lowest[b])
        merged = lowest.copy()
        np.minimum.at(merged, lowest[a], least)
        np.minimum.at(merged, lowest[b], least)
        merged = merged[merged]
        if np.array_equal(merged, lowest):
            return lowest
        lowest = merged
