"""Columns of texts that repeat, as names of images and classes do of many boxes: each text is held once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray


class Texts(Sequence[str]):
    """Texts (N), of which the one in row i is `distinct[codes[i]]`; all that are distinct are there, in any order."""

    def __init__(self, codes: NDArray[np.int32], distinct: list[str]) -> None:
        self.codes, self.distinct = codes, distinct

    @classmethod
    def of(cls, texts: Sequence[str]) -> Texts:
        """Return texts as such a column."""
        if isinstance(texts, Texts):
            return texts
        number: dict[str, int] = {}
        codes = np.fromiter((number.setdefault(text, len(number)) for text in texts), np.int32, len(texts))
        return cls(codes, list(number))

    @classmethod
    def repeated(cls, text: str, count: int) -> Texts:
        """Return one text so many times."""
        return cls(np.zeros(count, np.int32), [text])

    def __len__(self) -> int:
        return len(self.codes)

    def __iter__(self) -> Iterator[str]:
        return map(self.distinct.__getitem__, self.codes.tolist())

    @overload
    def __getitem__(self, row: int) -> str: ...
    @overload
    def __getitem__(self, row: slice) -> Texts: ...
    def __getitem__(self, row: int | slice) -> str | Texts:
        if isinstance(row, slice):
            return Texts(self.codes[row], self.distinct)
        return self.distinct[int(self.codes[row])]
