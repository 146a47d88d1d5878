"""The kinds of arrays that all files share, and what NumPy lacks for any of them."""

from __future__ import annotations

from dataclasses import dataclass
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


def runs(rows: Ints, code: NDArray[Any]) -> list[Ints]:
    """Return the runs of rows (N) that follow each other with equal codes (N)."""
    return np.split(rows, np.flatnonzero(np.diff(code)) + 1)


@dataclass(frozen=True, eq=False)
class RowsByNumber:
    """Rows (N) by a number that each of them has: those of number k, ascending, are `order[first[k] : first[k + 1]]`.

    `order` (N) has all rows, and `first` (K + 1) is where those of each of K numbers begin.
    """

    order: Ints
    first: Ints

    @classmethod
    def of(cls, number: Ints, count: int) -> RowsByNumber:
        """Sort rows by their numbers (N), of which there are `count`, from 0 on."""
        order = np.argsort(number, kind="stable")
        return cls(order, np.searchsorted(number[order], np.arange(count + 1)))

    @property
    def count(self) -> Ints:
        """How many rows have each number (K)."""
        return np.diff(self.first)

    def __getitem__(self, number: int) -> Ints:
        return self.order[self.first[number] : self.first[number + 1]]

    def each(self) -> list[Ints]:
        """Return the rows of each number (K)."""
        return np.split(self.order, self.first[1:-1])

    def of_several(self, numbers: Ints) -> tuple[Ints, Ints]:
        """Return for all rows of some numbers (M), one number after the other, which of these it is, and the row."""
        count = self.count[numbers]
        return np.repeat(np.arange(len(numbers)), count), self.order[rows_in_runs(self.first[numbers], count)]


def bounds(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the least and largest (K) of each column of values (N, K); of none infinity, and its negative."""
    # Along rows of few numbers NumPy takes seven times as long.
    least = [column.min() if len(column) else np.inf for column in values.T]
    return np.array(least), np.array([column.max() if len(column) else -np.inf for column in values.T])
