"""CSV files of users, as spreadsheets and programs write them: the one way to read them."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from valuemap.arrow import numbers_to_arrow
from valuemap.errors import InputError


def read_csv_arrow(
    path: Path, types: Mapping[str, pa.DataType], *, has_missing: bool, hint: str, bad_numbers_are_nan: bool = False
) -> pa.Table:
    """Read a CSV file with a header line; the columns named in `types` are of these types.

    Fields are separated by commas, semicolons or tabs, whichever the header line has most outside of quotation marks,
    or by what a line `sep=;` before it says, as Excel writes it; without commas, numbers may have decimal ones. Gzip
    and a byte order mark are read through. A column whose name is that of a type but for the case of its letters is
    taken as that. With `has_missing` an empty field is a missing value; else it is an empty text, and no number. With
    `bad_numbers_are_nan`, what should be a float64 and is no number is NaN, not an error; which fields are no numbers
    the metadata of the column say (`odd_fields`). Empty rows at the end, as spreadsheets leave them, are none.

    Raises
    ------
    InputError
        The file is empty or no CSV, or a value is not of its type; `hint` says what is expected.
    """
    found = read_csv_portions(path, types, has_missing=has_missing, hint=hint, bad_numbers_are_nan=bad_numbers_are_nan)
    return _joined(list(found))


def read_csv_portions(
    path: Path, types: Mapping[str, pa.DataType], *, has_missing: bool, hint: str, bad_numbers_are_nan: bool = False
) -> Iterator[pa.Table]:
    """Yield a CSV file as `read_csv_arrow` reads it, a large plain text in portions; there is at least one.

    Columns of a large one that `types` does not name are bytes.
    """
    names: list[str] | None = None
    rows = skipped = 0
    try:
        start = _start_of_large(path)
        content = start or _read_text_bytes(path, hint)
        said, skipped = _said_separator(content)
        content = content[skipped:]
        separator, header = _header(content, said)
        # What others are would be guessed anew from each portion.
        type_of = dict.fromkeys(header if start else (), pa.binary()) | _types_by_header(header, types)
        options: dict[str, Any] = {
            "column_types": type_of,
            "null_values": None if has_missing else [],
            "strings_can_be_null": has_missing,
        }
        for block in _blocks(path, skipped) if start else [content]:
            try:
                table = _parse_csv(block, separator, options, names)
            except pa.ArrowInvalid:
                table = _parse_odd_csv(block, separator, options, names, bad_numbers_are_nan)
            names = names or table.column_names
            exact = {name.strip() for name in names}
            same = {name.lower(): name for name in types if name not in exact}
            table = table.rename_columns([same.get(name.strip().lower(), name.strip()) for name in names])
            # Where a quote in the header line is not closed, its columns are not those that the types were given for.
            if any(field.type != types.get(field.name, field.type) for field in table.schema):
                raise InputError(f"{path}: the first line has a quotation mark that is not closed", hint=hint)
            rows += len(table)
            yield table.replace_schema_metadata({_MARK: _decimal_mark(separator), _BEFORE: str(int(skipped > 0))})
    except (pa.ArrowException, OSError, EOFError, zlib.error, UnicodeDecodeError, csv.Error) as error:
        # A portion begins behind the header line, but for the first.
        before = (rows + 1 if names else 0) + int(skipped > 0)
        reason = _ROW.sub(lambda row: f"Row #{int(row[1]) + before}", str(error).splitlines()[0])
        raise InputError(f"{path}: cannot be read as CSV: {reason}", hint=_better_hint(path, hint)) from error


def _blocks(path: Path, first: int) -> Iterator[bytes]:
    """Yield a text from a byte on in blocks of whole lines; none ends in a field that a quotation mark begins."""
    with path.open("rb") as file:
        file.seek(first)
        while block := file.read(_BLOCK):
            lines = [block, file.readline()]
            marks = sum(each.count(_QUOTE) for each in lines)
            while marks % 2 and lines[-1]:  # Within a field they are there twice.
                lines.append(file.readline())
                marks += lines[-1].count(_QUOTE)
            yield b"".join(lines)


def _joined(tables: list[pa.Table]) -> pa.Table:
    """Return portions as one table that says which fields are no numbers."""
    if len(tables) == 1:
        return tables[0]
    first = np.cumsum([0, *map(len, tables)])
    fields = []
    for column, field in enumerate(tables[0].schema):
        odd = [_odd_fields(table.schema.field(column)) for table in tables]
        rows = np.concatenate([at + found for at, (found, _) in zip(first, odd, strict=False)])
        fields.append(field.with_metadata(_metadata(rows, next((text for found, text in odd if len(found)), ""))))
    schema = pa.schema(fields, metadata=tables[0].schema.metadata)
    return pa.concat_tables([table.cast(schema) for table in tables])


def _start_of_large(path: Path) -> bytes | None:
    """Return how a plain text file begins that is read in blocks; None for a small one, and for what must be unpacked.

    All of it is then never in memory.
    """
    if not path.is_file():
        return None
    with path.open("rb") as file:
        start = file.read(_START)
        file.seek(max(path.stat().st_size - _LOOKED_AT, 0))
        end = file.read()
    after = end[len(end.rstrip(_SEPARATORS)) :].splitlines()
    if any(after[1:]):  # Empty rows at its end are to be left out.
        return None
    is_plain = start[:1].isalpha() and not start.startswith(_NO_TEXT) and b"\0" not in start[:_LOOKED_AT]
    return start if len(start) == _START and is_plain and b"\n" in start else None


def has_decimal_commas(table: pa.Table) -> bool:
    """Say whether numbers of a table may have decimal commas, in its texts, too: no commas separate its fields."""
    return bool(table.schema.metadata[_MARK] == b",")


def lines_before_header(table: pa.Table) -> int:
    """Return how many lines of its file are before that with the names of the columns."""
    return int(table.schema.metadata[_BEFORE])


def _decimal_mark(separator: str) -> str:
    return "." if separator == "," else ","


def odd_fields(table: pa.Table, name: str) -> tuple[NDArray[np.int64], str]:
    """Return the rows of the fields of a column of numbers that are other texts, and the first of these."""
    return _odd_fields(table.schema.field(name))


def _odd_fields(field: pa.Field) -> tuple[NDArray[np.int64], str]:
    found = field.metadata or {}
    return np.frombuffer(found.get(_ODD_ROWS, b""), dtype=np.int64), found.get(_ODD, b"").decode("utf-8", "replace")


def _metadata(odd_rows: NDArray[np.int64], text: str) -> dict[bytes, bytes] | None:
    return {_ODD: text.encode(), _ODD_ROWS: odd_rows.tobytes()} if len(odd_rows) else None


_MARK, _BEFORE = b"valuemap: decimal mark", b"valuemap: lines before the header"
_ODD, _ODD_ROWS = b"valuemap: first field that is no number", b"valuemap: rows of fields that are no numbers"
_NOTHING = frozenset({"", "nan", "na", "n/a", "none", "null", "-"})
"""How tables say that nothing is known."""


def _better_hint(path: Path, hint: str) -> str:
    """Return what helps with a file that is no CSV, by what it begins with."""
    try:
        content = _read_text_bytes(path, hint)
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        return f"byte {error.start} is not UTF-8: save it as CSV in UTF-8; {hint}"
    except (InputError, OSError, EOFError, zlib.error):
        return hint
    if content.lstrip().startswith(b"#"):
        return f"the first line names the columns: remove the lines that begin with #; {hint}"
    return hint


def _read_text_bytes(path: Path, hint: str) -> bytes:
    """Return the bytes of a text file, unpacked if it is gzip; raises `InputError` where it is something else."""
    if not path.is_file():  # A pipe would hang.
        raise InputError(f"{path}: is not a file", hint=hint)
    content = path.read_bytes()
    if content.startswith(b"\x1f\x8b"):
        content = _unpacked(content, path, hint)
    for start, what in zip(_NO_TEXT, ("a zip archive or a spreadsheet", "a Parquet file"), strict=True):
        if content.startswith(start):
            raise InputError(f"{path}: is {what}, not CSV", hint=f"save it as CSV in UTF-8; {hint}")
    start = content[:_LOOKED_AT].removeprefix(codecs.BOM_UTF8).lstrip()
    for mark, what in ((b"<", "a web page or XML"), (b"{", "JSON"), (b"[", "JSON")):
        if start.startswith(mark):
            raise InputError(f"{path}: is {what}, not CSV", hint=hint)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"{path}: is text in UTF-16, not in UTF-8", hint=f"save it as CSV in UTF-8; {hint}")
    if b"\0" in content[:_LOOKED_AT]:
        raise InputError(f"{path}: cannot be read as CSV: it is no text", hint=hint)
    content = content.removeprefix(codecs.BOM_UTF8)
    ends = len(content.rstrip(_SEPARATORS))
    after = content[ends:]
    # A row of separators alone is none; those of the last row that is one stay.
    content = content[: ends + len(after.splitlines(keepends=True)[0])] if after else content
    # A header line without an end is a table without rows, too.
    return content if not content or b"\n" in content or b"\r" in content else content + b"\n"


def _unpacked(content: bytes, path: Path, hint: str) -> bytes:
    """Return what gzip holds; refuse what is a few bytes on disk and fills the memory."""
    most = max(_MOST_UNPACKED_TIMES * len(content), _ALWAYS_UNPACKED)
    with gzip.open(io.BytesIO(content)) as file:
        unpacked = file.read(most + 1)
    if len(unpacked) > most:
        raise InputError(
            f"{path}: unpacks to more than {most / 1e6:.0f} MB, {_MOST_UNPACKED_TIMES} times itself", hint=hint
        )
    return unpacked


_MOST_UNPACKED_TIMES = 100
"""Tables of texts and numbers shrink to a third or a twentieth."""
_ALWAYS_UNPACKED = 64 * 2**20
_START = 2**20
"""Files of no more bytes are read at once."""
_BLOCK = 2**24
"""Bytes of a larger file that are read together."""
_ROW = re.compile(r"Row #(\d+)")
_NO_TEXT = (b"PK\3\4", b"PAR1")
_SEPARATORS = b" \t\r\n,;"
_SAID = re.compile(rb'"?sep=([,;|\t])"?[ ,;]*(?:\r\n|\n|\r)', re.IGNORECASE)
_QUOTED = re.compile(r'"[^"]*"')
_QUOTE = b'"'
_LOOKED_AT = 1000
"""Bytes that say what a file is."""


def _said_separator(content: bytes) -> tuple[str | None, int]:
    """Return what a first line such as `sep=;` says that separates the fields, and the bytes up to the next line."""
    found = _SAID.match(content)
    return (found[1].decode("ascii"), found.end()) if found else (None, 0)


def _header(content: bytes, said: str | None) -> tuple[str, list[str]]:
    """Return what separates the fields of the first line, where it was not said before, and the fields."""
    first = next(iter(content[:100_000].lstrip(b"\r\n").splitlines()), b"").decode("utf-8", "replace")
    separator = said or max((",", ";", "\t"), key=_QUOTED.sub("", first).count)  # The first of several.
    return separator, next(iter(csv.reader([first], delimiter=separator)), [])


def _types_by_header(names: Sequence[str], types: Mapping[str, pa.DataType]) -> dict[str, pa.DataType]:
    """Return the types by the names as the header has them: spaces and the case of letters may be others."""
    exact = {name.strip() for name in names}
    same = {name.lower(): name for name in types if name not in exact}
    found = {name: same.get(name.strip().lower(), name.strip()) for name in names}
    return {name: types[wanted] for name, wanted in found.items() if wanted in types}


def _parse_csv(source: bytes, separator: str, options: Mapping[str, Any], names: list[str] | None) -> pa.Table:
    """Read what begins with a header line, or has columns of these names."""
    return pa_csv.read_csv(
        pa.BufferReader(source),
        read_options=pa_csv.ReadOptions(use_threads=False, column_names=names),  # With threads errors say no row.
        parse_options=pa_csv.ParseOptions(delimiter=separator, newlines_in_values=_QUOTE in source),
        convert_options=pa_csv.ConvertOptions(**options),
    )


def _parse_odd_csv(
    source: bytes, separator: str, options: dict[str, Any], names: list[str] | None, bad_numbers_are_nan: bool
) -> pa.Table:
    """Read what cannot be read at once: decimal commas, or fields that should be numbers and are none."""
    decimal = _decimal_mark(separator)
    try:
        return _parse_csv(source, separator, {**options, "decimal_point": decimal}, names)
    except pa.ArrowInvalid:
        if not bad_numbers_are_nan:
            raise
    type_of: dict[str, pa.DataType] = options["column_types"]
    as_texts = {name: pa.string() if kind == pa.float64() else kind for name, kind in type_of.items()}
    table = _parse_csv(source, separator, {**options, "column_types": as_texts}, names)
    for name, kind in type_of.items():
        if kind == pa.float64() and table.column_names.count(name) == 1:
            texts = table.column(name).to_pylist()
            values = np.array([_number_or_nan(text, decimal) for text in texts])
            odd = [
                row
                for row in np.flatnonzero(np.isnan(values)).tolist()
                if (texts[row] or "").strip().lower() not in _NOTHING
            ]
            metadata = _metadata(np.array(odd, np.int64), texts[odd[0]].strip()[:40] if odd else "")
            field = pa.field(name, pa.float64(), metadata=metadata)
            table = table.set_column(table.column_names.index(name), field, numbers_to_arrow(values))
    return table


def _number_or_nan(text: str | None, decimal: str) -> float:
    try:
        return math.nan if "_" in (text or "") else float((text or "nan").replace(decimal, "."))
    except ValueError:
        return math.nan
