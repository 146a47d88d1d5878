"""Names of images cut into texts and numbers, which tell an order where no time does."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from valuemap.arrays import Floats, Ints

_DIGITS = re.compile("([0-9]+)")


def cut_name(name: str) -> list[str]:
    """Return the texts and numbers of a name by turns, from a text to a text."""
    return _DIGITS.split(name)


class NameParts:
    """Names (M) cut into texts and numbers: columns of codes that sort as texts and numbers do."""

    def __init__(self, names: Sequence[str]) -> None:
        parts = [cut_name(name) for name in names]
        self._length = np.array([len(part) for part in parts])
        self.codes: list[Ints] = []
        self.numbers: list[Floats] = []
        for column in range(int(self._length.max(initial=0))):
            cells = [part[column] if column < len(part) else "" for part in parts]
            values = {cell: (0, cell) for cell in set(cells)}
            if column % 2:  # Numbers of any length: without leading zeros, the longer one is more.
                values = {cell: (len(cell.lstrip("0")), cell.lstrip("0")) for cell in values}
            rank = {value: i for i, value in enumerate(sorted(set(values.values())))}
            self.codes.append(np.array([rank[values[cell]] for cell in cells], dtype=np.int64))
            numbers = {cell: float(cell) if column % 2 and cell else np.nan for cell in values}
            self.numbers.append(np.array([numbers[cell] for cell in cells]))

    def take(self, rows: Ints) -> NameParts:
        """Return some of them."""
        part = NameParts([])
        part._length = self._length[rows]
        part.codes = [codes[rows] for codes in self.codes]
        part.numbers = [numbers[rows] for numbers in self.numbers]
        return part

    def rank(self, *, without: int | None = None) -> Floats:
        """Return the rank (M) in natural order; names that differ in one column only may have the same."""
        keys = [codes for column, codes in enumerate(self.codes) if column != without]
        keys.insert(0, self._length)
        order = np.lexsort(keys[::-1])
        differs = np.zeros(len(order), np.bool_)
        for key in keys:
            differs[1:] |= key[order][1:] != key[order][:-1]
        rank = np.empty(len(order))
        rank[order] = np.cumsum(differs)
        return rank

    def varying(self) -> list[int]:
        """Return the columns in which not all are the same."""
        return [column for column, codes in enumerate(self.codes) if len(codes) and np.ptp(codes) > 0]

    def numbers_passed(self, order: Ints) -> Floats:
        """Return by how much (M) a number grew since the name before in an order, NaN where more than it changed."""
        varying = self.varying()
        passed = np.full(len(order), np.nan)
        if varying and varying[-1] % 2 == 1:
            passed[1:] = np.diff(self.numbers[varying[-1]][order])
            for column in varying[:-1]:
                passed[1:][np.diff(self.codes[column][order]) != 0] = np.nan
        return passed
