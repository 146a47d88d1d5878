"""Rows of numbers in temporary files, of which only a portion is in memory.

Files are in the folder for temporary files (`TMPDIR`), without a name: they go with the process, however it ends.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from valuemap.arrays import Ints
from valuemap.errors import OutputError

PORTION = 2**18
"""Rows that are in memory together: 15 to 22 MB of boxes."""

Rows = NDArray[Any]
"""A structured array."""


class RowFile:
    """Rows (N) of one structure, in the order in which they were added."""

    def __init__(self, dtype: DTypeLike) -> None:
        self.dtype = np.dtype(dtype)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 (open as long as somebody has it)
        weakref.finalize(self, self._file.close)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, rows: Rows) -> None:
        """Add rows at the end.

        Raises
        ------
        OutputError
            There is no room.
        """
        try:
            self._file.seek(self._count * self.dtype.itemsize)
            self._file.write(np.ascontiguousarray(rows, self.dtype).view(np.uint8).data)
            self._file.flush()
        except OSError as error:
            raise OutputError(
                f"{tempfile.gettempdir()}: cannot be written: {error.strerror or error}",
                hint="make room, or name another folder for temporary files in TMPDIR",
            ) from error
        self._count += len(rows)

    def read(self, first: int, count: int) -> Rows:
        """Return some rows."""
        rows = np.empty(count, self.dtype)
        self._file.seek(first * self.dtype.itemsize)
        self._file.readinto(rows.view(np.uint8).data)
        return rows

    def portions(self) -> Iterator[tuple[int, Rows]]:
        """Yield all rows, a portion at a time, at least one, each with the number of its first row."""
        for first in range(0, max(self._count, 1), PORTION):
            yield first, self.read(first, min(PORTION, self._count - first))


class PartFile:
    """Rows in parts by a key: part k has the keys from `bounds[k - 1]` to below `bounds[k]`, in their order."""

    def __init__(self, dtype: DTypeLike, bounds: Ints) -> None:
        self._file, self._bounds = RowFile(dtype), bounds
        self.dtype = self._file.dtype
        self._ends: list[Ints] = []

    def append(self, rows: Rows, key: Ints) -> None:
        """Add rows, which have these keys."""
        part = np.searchsorted(self._bounds, key, side="right")
        order = np.argsort(part, kind="stable")
        self._ends.append(len(self._file) + np.searchsorted(part[order], np.arange(len(self._bounds) + 2)))
        self._file.append(rows[order])

    def parts(self) -> Iterator[Rows]:
        """Yield one part after the other."""
        for k in range(len(self._bounds) + 1):
            found = [self._file.read(ends[k], ends[k + 1] - ends[k]) for ends in self._ends if ends[k + 1] > ends[k]]
            yield np.concatenate([np.empty(0, self._file.dtype), *found])


def bounds_by_count(count: Ints) -> Ints:
    """Return bounds of the keys 0, 1, ... (N) that make parts of about a portion each; `count` says how many have each.

    Rows of one key are one part, however many.
    """
    before = np.cumsum(count) - count
    first_of_part = np.flatnonzero(np.diff(before // PORTION, prepend=0))
    return first_of_part.astype(np.int64)


class KeyBounds:
    """Finds bounds that make parts of about a portion each, of keys that come in portions: by samples of each."""

    _STEP = 2**10

    def __init__(self) -> None:
        self._samples: list[Ints] = []

    def add(self, keys: Ints) -> None:
        """Look at some keys."""
        self._samples.append(np.sort(keys)[:: self._STEP])

    def bounds(self) -> Ints:
        """Return bounds, ascending."""
        samples = np.sort(np.concatenate([np.empty(0, np.int64), *self._samples]))
        return np.unique(samples[:: max(1, PORTION // self._STEP)][1:])
