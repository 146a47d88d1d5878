"""NumPy arrays to Arrow and back, without a copy of numbers and without pandas.

`pyarrow.array` and `Array.to_numpy` import pandas before they do anything, which takes longer than mapping a small
city.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from valuemap.errors import InputError

_TYPES = {"f8": pa.float64(), "i8": pa.int64(), "i4": pa.int32()}


def numbers_from_arrow(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """Return numbers (N) as an array that must not be written to; missing ones are NaN."""
    column = in_one(column)
    if column.null_count:
        column = pc.fill_null(column, _MISSING if column.type == _MISSING.type else float("nan"))
    return np.from_dlpack(column)


def in_one(column: pa.Array | pa.ChunkedArray) -> pa.Array:
    """Return a column (N) as one array, without a copy where it is in one piece: `combine_chunks` always copies."""
    if isinstance(column, pa.Array):
        return column
    return column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()


def numbers_to_arrow(values: NDArray[Any], *, nullable: bool = False) -> pa.Array:
    """Return float64, int64 or int32 numbers (N) as an Arrow array; with `nullable`, NaN means missing."""
    values = np.ascontiguousarray(values)
    validity = pa.py_buffer(np.packbits(~np.isnan(values), bitorder="little")) if nullable else None
    kind = _TYPES[values.dtype.str[1:]]
    return pa.Array.from_buffers(kind, len(values), [validity, pa.py_buffer(values)])


_MISSING = numbers_to_arrow(np.array([np.nan]))[0]


def texts_to_arrow(texts: Sequence[str]) -> pa.Array:
    """Return texts (N) as an Arrow array.

    Raises
    ------
    InputError
        A text cannot be written as UTF-8, as the name of a file in another encoding cannot.
    """
    try:
        encoded = [text.encode() for text in texts]
    except UnicodeEncodeError as error:
        raise InputError(
            f"{error.object!r}: cannot be written as UTF-8", hint="give files and classes names of Unicode characters"
        ) from error
    offsets = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    return pa.StringArray.from_buffers(len(encoded), pa.py_buffer(offsets), pa.py_buffer(b"".join(encoded)))


def no_texts(count: int) -> pa.Array:
    """Return so many empty texts (`pyarrow.repeat` imports pandas, too)."""
    offsets = np.zeros(count + 1, np.int32)
    return pa.StringArray.from_buffers(count, pa.py_buffer(offsets), pa.py_buffer(b""))
