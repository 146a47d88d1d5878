"""What a column is: which names it has on disk, and how values of any kind are taken, cut and joined.

Whole numbers and numbers are arrays of NumPy, texts one array of Arrow, few distinct texts `Categories`, and lists of
numbers a list of arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from valuemap.arrow import numbers_to_arrow, take_texts
from valuemap.tables.categories import Categories, join_categories

EXPECTED = {
    "int": "whole numbers",
    "float": "numbers",
    "text": "texts",
    "category": "texts",
    "floats": "a list of numbers a row",
}
"""The kinds of columns, in words."""


def column(kind: str, names: tuple[str, ...], *, optional: bool = False, nullable: bool = False) -> Any:
    """Declare which columns on disk a field stands for.

    kind: "int", "float", "text", "category" or "floats" (a list of numbers a row).
    optional: the whole column may be missing; the field is then None.
    nullable: single values may be missing; they are NaN in memory.
    """
    metadata = {"kind": kind, "names": names, "optional": optional, "nullable": nullable}
    return field(default=None, metadata=metadata) if optional else field(metadata=metadata)


def is_of_kind(kind_found: pa.DataType, kind: str) -> bool:
    """Return whether a column of Arrow can be read as one of a kind."""
    types = pa.types
    if types.is_dictionary(kind_found):
        return kind in ("text", "category") and is_of_kind(kind_found.value_type, kind)
    if kind == "int":
        return bool(types.is_integer(kind_found))
    if kind == "float":
        return bool(types.is_integer(kind_found) or types.is_floating(kind_found) or types.is_null(kind_found))
    if kind == "floats":
        is_list = types.is_list(kind_found) or types.is_large_list(kind_found) or types.is_fixed_size_list(kind_found)
        return bool(is_list and is_of_kind(kind_found.value_type, "float"))
    return bool(types.is_string(kind_found) or types.is_large_string(kind_found))


def cut(value: Any, rows: slice) -> Any:
    """Return the rows (N) of a slice, without a copy; None of a column that is not there."""
    if value is None:
        return None
    return Categories(value.codes[rows], value.names) if isinstance(value, Categories) else value[rows]


def taken(value: Any, rows: NDArray[Any]) -> Any:
    """Return the rows given by indices or by a mask; None of a column that is not there."""
    if value is None:
        return None
    if isinstance(value, Categories):
        return value.take(rows)
    if isinstance(value, pa.Array):
        indices = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        return take_texts(value, indices)
    if isinstance(value, list):
        return [value[i] for i in (np.flatnonzero(rows) if rows.dtype == np.bool_ else rows)]
    # A fraction of the time of value[rows] where a row has several numbers.
    return value.take(np.flatnonzero(rows) if rows.dtype == np.bool_ else rows, axis=0)


def joined(values: Sequence[Any]) -> Any:
    """Return columns of one kind, at least one, as one, in their order; None if one of them is None."""
    if any(value is None for value in values):
        return None
    if isinstance(values[0], Categories):
        return join_categories(values)
    if isinstance(values[0], pa.Array):
        return pa.concat_arrays(values)
    if isinstance(values[0], list):
        return [item for value in values for item in value]
    return np.concatenate(values)


def column_to_arrow(value: Any, kind: str) -> pa.Array:
    """Return a column of any kind but "float", of which a field may have several, as an Arrow array."""
    if kind == "category":
        return value.to_arrow()
    if kind == "floats":
        offsets = np.cumsum([0, *map(len, value)], dtype=np.int32)
        items = numbers_to_arrow(np.concatenate([*value, np.empty(0)]))
        return pa.ListArray.from_arrays(numbers_to_arrow(offsets), items)
    return value if isinstance(value, pa.Array) else numbers_to_arrow(np.asarray(value, np.int64))
