"""NumPy arrays to Arrow and back, without a copy of numbers, and without pandas and Arrow's functions.

`pyarrow.array` and `Array.to_numpy` import pandas before they do anything, which takes longer than mapping a small
city; methods as `take`, `cast` and `fill_null` import `pyarrow.compute`, an eighth of the start of a command.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from valuemap.errors import InputError

_TYPES = {"f8": pa.float64(), "i8": pa.int64(), "i4": pa.int32()}


def numbers_from_arrow(column: pa.Array | pa.ChunkedArray) -> NDArray[Any]:
    """Return numbers (N) as an array that must not be written to; missing ones are NaN."""
    column = in_one(column)
    if not column.null_count:
        return np.from_dlpack(column)
    column = as_type(column, pa.float64())
    validity, values = column.buffers()
    rows = slice(column.offset, column.offset + len(column))
    is_there = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[rows]
    return np.where(is_there, np.frombuffer(values, np.float64)[rows], np.nan)


def as_type(column: pa.Array | pa.ChunkedArray, kind: pa.DataType) -> Any:
    """Return a column (N) as one of another type; raises `pyarrow.ArrowInvalid` where a value has no place in it."""
    return column if column.type == kind else column.cast(kind)


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


def take_texts(texts: pa.Array, rows: NDArray[np.int64]) -> pa.Array:
    """Return some texts (rows, M), of which none is missing."""
    if not len(rows):
        return no_texts(0)
    texts = as_type(texts, pa.string())
    _, offsets, letters = texts.buffers()
    offset = np.frombuffer(offsets, np.int32)[texts.offset : texts.offset + len(texts) + 1]
    first, end = offset[:-1][rows], offset[1:][rows]
    taken = np.concatenate([[0], np.cumsum(end - first)]).astype(np.int32)
    letter = np.repeat(first - taken[:-1], end - first) + np.arange(taken[-1], dtype=np.int32)
    content = np.frombuffer(letters or b"", np.uint8)[letter]
    return pa.StringArray.from_buffers(len(rows), pa.py_buffer(taken), pa.py_buffer(content))


def no_texts(count: int) -> pa.Array:
    """Return so many empty texts (`pyarrow.repeat` imports pandas, too)."""
    offsets = np.zeros(count + 1, np.int32)
    return pa.StringArray.from_buffers(count, pa.py_buffer(offsets), pa.py_buffer(b""))
