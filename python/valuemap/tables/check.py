"""The check of tables that were made by hand."""

from __future__ import annotations

import dataclasses
from dataclasses import fields
from typing import Any

import numpy as np
import pyarrow as pa

from valuemap.arrays import Ints
from valuemap.errors import InputError
from valuemap.tables.categories import Categories
from valuemap.tables.column import EXPECTED, is_of_kind
from valuemap.tables.table import Table


def check_table(table: Table, *, source: str) -> None:
    """Check a table that was made by hand as `read_table` checks a file; what is read needs it no more.

    Raises
    ------
    InputError
        A column has another length, shape or type than the table needs, or a value is not finite, or the keys are not
        ascending and unique.
    """
    for f in fields(table):
        value = getattr(table, f.name)
        if value is not None:
            _check_column(value, f, len(table), source)
        elif not f.metadata["optional"]:
            raise InputError(
                f"{source}: {f.name}: expected values, found None", hint="only optional columns may be None"
            )
    if table.KEY is not None:
        key: Ints = getattr(table, table.KEY)
        wrong = np.flatnonzero(np.diff(key) <= 0)
        if len(wrong):
            raise InputError(
                f"{source} row {wrong[0] + 1}: {table.KEY}: expected ascending unique ids, found {key[wrong[0] + 1]} "
                f"after {key[wrong[0]]} ({len(wrong)} rows)",
                hint=f"sort the rows by {table.KEY}",
            )


def _check_column(value: Any, column: dataclasses.Field[Any], rows: int, source: str) -> None:
    names, kind = column.metadata["names"], column.metadata["kind"]
    expected = {"category": Categories, "text": pa.Array, "floats": list}.get(kind, np.ndarray)
    if not isinstance(value, expected):
        raise InputError(
            f"{source}: {column.name}: expected {expected.__name__}, found {type(value).__name__}",
            hint="Categories.from_texts makes a column of texts" if kind == "category" else "see the table's docstring",
        )
    if len(value) != rows:
        raise InputError(
            f"{source}: {column.name}: expected {rows} rows, found {len(value)}",
            hint="all columns need the same length",
        )
    if isinstance(value, Categories):
        _check_codes(value, column.name, source)
    if isinstance(value, list) and not all(_is_row_of_numbers(row) for row in value):
        raise InputError(
            f"{source}: {column.name}: expected an array of numbers in each row",
            hint="np.array([fx, fy, cx, cy], dtype=np.float64), for example",
        )
    if isinstance(value, pa.Array) and (value.null_count or not is_of_kind(value.type, "text")):
        raise InputError(
            f"{source}: {column.name}: expected texts, found {value.type} with {value.null_count} missing",
            hint="pyarrow.array(texts) makes such a column",
        )
    if not isinstance(value, np.ndarray):
        return
    shape = (rows,) if len(names) == 1 else (rows, len(names))
    if value.shape != shape or value.dtype.kind not in ("f" if kind == "float" else "iu"):
        raise InputError(
            f"{source}: {column.name}: expected {EXPECTED[kind]} of shape {shape}, "
            f"found {value.dtype} of {value.shape}",
            hint=f"its columns are {', '.join(names)}",
        )
    if kind == "float":
        bad = np.isinf(value) if column.metadata["nullable"] else ~np.isfinite(value)
        if bad.any():
            row = int(np.flatnonzero(bad.reshape(rows, -1).any(axis=1))[0])
            raise InputError(
                f"{source} row {row}: {column.name}: expected finite numbers, found {value[row]}",
                hint="repair or remove it",
            )


def _check_codes(column: Categories, name: str, source: str) -> None:
    codes = column.codes
    is_code = isinstance(codes, np.ndarray) and codes.ndim == 1 and codes.dtype.kind in "iu"
    if not is_code or np.any((codes < 0) | (codes >= len(column.names))):
        raise InputError(
            f"{source}: {name}: expected codes from 0 to {len(column.names) - 1}, one a row",
            hint="Categories.from_texts makes a column of texts",
        )


def _is_row_of_numbers(row: Any) -> bool:
    return isinstance(row, np.ndarray) and row.ndim == 1 and row.dtype.kind == "f"
