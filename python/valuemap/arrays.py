"""The kinds of arrays that all files share, and what NumPy lacks for any of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def rows_in_runs(first: Ints | int, count: Ints) -> Ints:
    """Return the rows of runs (N) one after the other, of which each has so many rows from its `first` (N) on."""
    before = np.cumsum(count) - count
    return np.asarray(np.arange(int(count.sum())) + np.repeat(first - before, count), np.int64)


def bounds(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the least and largest (K) of each column of values (N, K); of none infinity, and its negative."""
    # Along rows of few numbers NumPy takes seven times as long.
    least = [column.min() if len(column) else np.inf for column in values.T]
    return np.array(least), np.array([column.max() if len(column) else -np.inf for column in values.T])
