"""Reading a CSV file with known columns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa

from valuemap.csv_table import read_csv_arrow
from valuemap.errors import InputError

_NAMES = {pa.int64(): "whole numbers", pa.float64(): "numbers", pa.string(): "texts"}


def read_csv(path: Path, required: Mapping[str, pa.DataType], optional: Mapping[str, pa.DataType]) -> pa.Table:
    """Return the named columns of a CSV file with a header line, in the types given.

    Optional columns that are absent are left out, as are columns that nobody asked for. What should be a float64 and
    is no number is NaN, to be vetted; an empty field is an empty text.

    Raises
    ------
    InputError
        The file is missing, empty or no CSV, lacks a column, or a value is not of its type.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file", hint="check the path")
    expected = ", ".join(f"{name} ({_NAMES[kind]})" for name, kind in required.items())
    hint = f"expected a CSV file with columns {expected}"
    table = read_csv_arrow(path, {**required, **optional}, has_missing=False, hint=hint, bad_numbers_are_nan=True)
    columns = [name for name in (*required, *optional) if name in required or name in table.column_names]
    for name in columns:
        if table.column_names.count(name) != 1:
            found = ", ".join(table.column_names)
            raise InputError(
                f"{path}: expected one column {name!r} in the first line, found {found}",
                hint=hint,
            )
    if table.num_rows == 0:
        raise InputError(f"{path}: no rows after the first line", hint="check what wrote the file")
    return table.select(columns)
