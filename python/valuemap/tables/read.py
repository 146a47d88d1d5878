"""Tables read from Parquet and checked: every column and value that is wrong is named."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints
from valuemap.arrow import as_type, in_one, numbers_from_arrow
from valuemap.errors import InputError
from valuemap.tables.categories import Categories
from valuemap.tables.column import EXPECTED, is_of_kind
from valuemap.tables.table import Table

T = TypeVar("T", bound=Table)


def read_table(kind: type[T], path: Path) -> T:
    """Read and check one Parquet file as a table, rows sorted by its key.

    Raises
    ------
    InputError
        The file is missing, not Parquet or truncated, empty, lacks a column, or holds a wrong type, a
        missing or non-finite value, or a duplicate key; the message names file, row and column.
    """
    return table_from_arrow(kind, read_arrow(path), source=str(path))


def read_arrow(path: Path) -> pa.Table:
    """Read one Parquet file as it is; raises `InputError` where it is missing, damaged or cut short."""
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder that an import or simulate command wrote")
    try:
        # Not pq.read_table, which imports pandas before it reads. One thread: others cost more than they save.
        table = pq.ParquetFile(pa.BufferReader(path.read_bytes())).read(use_threads=False)
        table.validate(full=True)  # Finds texts that are not UTF-8, which nothing else would before they are used.
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise not_parquet(path, error) from error
    return table


def not_parquet(path: Path, error: Exception) -> InputError:
    """Return the error of a file that is no whole Parquet."""
    reason = str(error).splitlines()[0]
    return InputError(
        f"{path}: cannot be read as Parquet: {reason}", hint="the file is damaged or cut short: write it again"
    )


def table_from_arrow(kind: type[T], table: pa.Table, *, source: str) -> T:
    """Check an Arrow table and turn it into a typed one, rows sorted by its key; raises as `read_table`."""
    if table.num_rows == 0 and not kind.MAY_BE_EMPTY:
        raise InputError(f"{source}: the table is empty", hint="at least one row is needed: check what wrote the file")
    values = {f.name: _read_field(f.metadata, table, source) for f in fields(kind)}
    result = kind(**values)
    if kind.KEY is None:
        return result
    key: Ints = getattr(result, kind.KEY)
    if np.all(key[1:] > key[:-1]):
        return result
    order = np.argsort(key, kind="stable")
    repeated = np.flatnonzero(np.diff(key[order]) == 0)
    if len(repeated):
        row = int(order[repeated[0] + 1])
        raise InputError(
            f"{source} row {row}: {kind.KEY}: expected unique ids, found {key[row]} again ({len(repeated)} repeated)",
            hint="give every row an id of its own",
        )
    return result.take(order)


def _read_field(column: Any, table: pa.Table, source: str) -> Any:
    names, kind = column["names"], column["kind"]
    missing = [name for name in names if name not in table.column_names]
    if missing:
        if column["optional"] and len(missing) == len(names):
            return None
        raise InputError(
            f"{source}: column {missing[0]!r} is missing; found {', '.join(table.column_names)}",
            hint=f"add the column {missing[0]!r} ({EXPECTED[kind]})",
        )
    twice = [name for name in names if table.column_names.count(name) > 1]
    if twice:
        raise InputError(f"{source}: column {twice[0]!r} is there twice", hint="keep one of them")
    parts = [_read_column(table.column(name), name, column, source) for name in names]
    return parts[0] if len(parts) == 1 else np.stack(parts, axis=1)


def _read_column(column: pa.ChunkedArray, name: str, spec: Any, source: str) -> Any:
    kind, nullable = spec["kind"], spec["nullable"]
    if not is_of_kind(column.type, kind):
        raise InputError(
            f"{source}: column {name!r}: expected {EXPECTED[kind]}, found {column.type}",
            hint=f"write {name!r} with another type",
        )
    if pa.types.is_dictionary(column.type) and (
        kind != "category" or any(chunk.dictionary.null_count for chunk in column.chunks)
    ):
        column = column.cast(column.type.value_type)  # What is missing in the dictionary is so in the rows.
    if column.null_count and not nullable:
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise InputError(
            f"{source} row {row}: {name}: expected a value, found none ({column.null_count} rows)",
            hint="fill the value in, or remove the row",
        )
    if kind == "category":
        return Categories.from_texts(column)
    if kind == "text":
        return in_one(as_type(column, pa.string()))
    if kind == "floats":
        return [np.asarray(row, dtype=np.float64) for row in column.to_pylist()]
    if kind == "int":
        return _numbers(column, pa.int64(), name, source)
    values: Floats = _numbers(column, pa.float64(), name, source)
    bad = np.flatnonzero(np.isinf(values) if nullable else ~np.isfinite(values))
    if len(bad):
        row = int(bad[0])
        raise InputError(
            f"{source} row {row}: {name}: expected a finite number, found {values[row]} ({len(bad)} rows)",
            hint="repair or remove the row",
        )
    return values


def _numbers(column: pa.ChunkedArray, kind: pa.DataType, name: str, source: str) -> NDArray[Any]:
    try:
        return numbers_from_arrow(as_type(column, kind))
    except pa.ArrowInvalid as error:
        raise InputError(
            f"{source}: column {name!r}: expected numbers that {kind} can hold: {error}",
            hint="are these ids below 2^63, timestamps in seconds?",
        ) from error
