"""Columns of few distinct texts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from valuemap.arrow import in_one, numbers_from_arrow, numbers_to_arrow, texts_to_arrow

_SHOWN_NAMES = 5


@dataclass(frozen=True, eq=False, repr=False)
class Categories:
    """A column of few distinct texts: `names[codes[i]]` is the text of row i; names are sorted."""

    codes: NDArray[np.int32]
    names: tuple[str, ...]

    @classmethod
    def from_texts(cls, texts: Sequence[str] | pa.Array | pa.ChunkedArray) -> Self:
        """Encode texts (N) so that equal columns get equal codes whatever the order of rows."""
        if isinstance(texts, pa.ChunkedArray | pa.Array):
            column = in_one(texts)
            column = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
            found, codes = column.dictionary.to_pylist(), numbers_from_arrow(column.indices)
        else:
            number: dict[str, int] = {}
            codes = np.array([number.setdefault(text, len(number)) for text in texts], np.int32)
            found = texts_to_arrow(list(number)).to_pylist()  # All can be written.
        is_used = np.bincount(codes.astype(np.int64), minlength=len(found)) > 0
        names = tuple(sorted({name for name, used in zip(found, is_used.tolist(), strict=True) if used}))
        rank = {name: i for i, name in enumerate(names)}
        recode = np.array([rank.get(name, -1) for name in found], dtype=np.int32)
        return cls(recode[codes] if len(codes) else np.empty(0, np.int32), names)

    def __len__(self) -> int:
        return len(self.codes)

    def __repr__(self) -> str:
        shown = ", ".join(map(repr, self.names[:_SHOWN_NAMES]))
        return f"Categories({len(self):,} rows of {shown}{', ...' if len(self.names) > _SHOWN_NAMES else ''})"

    def take(self, rows: NDArray[Any]) -> Categories:
        """Return the rows given by indices or by a mask."""
        return Categories(self.codes[rows], self.names)

    def texts(self) -> list[str]:
        """Return the text of every row."""
        return [self.names[code] for code in self.codes]

    def code_of(self, name: str) -> int:
        """Return the code of a text, or -1 where no row can have it."""
        return self.names.index(name) if name in self.names else -1

    def to_arrow(self) -> pa.Array:
        """Return a dictionary array."""
        return pa.DictionaryArray.from_arrays(numbers_to_arrow(self.codes), texts_to_arrow(self.names))


def join_categories(columns: Sequence[Categories]) -> Categories:
    """Return columns of texts as one, in their order."""
    names_of = {id(column.names): column.names for column in columns}  # Parts of one column share theirs.
    names = tuple(sorted({name for each in names_of.values() for name in each}))
    rank = {name: code for code, name in enumerate(names)}
    recode = {key: np.array([rank[name] for name in each], np.int32) for key, each in names_of.items()}
    codes = [recode[id(column.names)][column.codes] if len(column) else column.codes for column in columns]
    return Categories(np.concatenate(codes), names)
