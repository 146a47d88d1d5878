"""Reading a table of texts and numbers separated by commas, semicolons or tabs, with names in its first line."""

from __future__ import annotations

import csv
import reprlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv

from valuemap.arrow import numbers_from_arrow
from valuemap.errors import InputError, SettingError
from valuemap.readers.files import check_file
from valuemap.tables import Floats, Ints

_NAMES = {pa.int64(): "whole numbers", pa.float64(): "numbers", pa.string(): "texts"}
_SEPARATORS = (",", ";", "\t")
_LARGEST_HEADER = 1_000_000


class CsvFile:
    """The columns of a file by name, as texts until somebody asks for numbers.

    Names are told apart without regard to upper case; `columns` says under which name a column stands in the file,
    where it is another one.

    Raises
    ------
    InputError
        The file is missing, empty, not UTF-8 or not a table.
    SettingError
        `columns` names a column that the file does not have.
    """

    def __init__(self, path: Path, expected: str, columns: Mapping[str, str] | None = None) -> None:
        self.path = path
        self._hint = f"expected {expected}"
        header, separator = _header(path, expected)
        self._names = [name.strip() for name in header]
        self._index: dict[str, int] = {}
        for index, name in enumerate(self._names):
            if self._index.setdefault(name.lower(), index) != index:
                raise InputError(f"{path}: column {name!r} is there twice", hint="keep one of them")
        for ours, theirs in (columns or {}).items():
            if theirs.lower() not in self._index:
                found = ", ".join(self._names)
                raise SettingError(f"column {ours}={theirs}: {path} has no column {theirs!r}", hint=f"it has {found}")
        # What was renamed is not found under the name that it had.
        renamed = {theirs.lower() for theirs in (columns or {}).values()}
        kept = {name: index for name, index in self._index.items() if name not in renamed}
        self._index = kept | {ours.lower(): self._index[theirs.lower()] for ours, theirs in (columns or {}).items()}
        self._table = _read(path, separator, len(header), self._hint)
        if self._table.num_rows == 0:
            raise InputError(f"{path}: no rows after the first line", hint="check what wrote the file")

    def __len__(self) -> int:
        return int(self._table.num_rows)

    def has(self, *names: str) -> bool:
        """Say whether all of these columns are there."""
        return all(name in self._index for name in names)

    def texts(self, name: str) -> list[str]:
        """Return a column as texts (N); an empty field is an empty text."""
        texts: list[str] = self._column(name).to_pylist()
        return texts

    def filled_texts(self, name: str) -> list[str]:
        """Return a column as texts (N) none of which is empty."""
        texts = [text.strip() for text in self.texts(name)]
        if "" in texts:
            raise self._wrong(texts.index(""), name, "a text", "")
        return texts

    def numbers(self, name: str, *, may_miss: bool = False) -> Floats:
        """Return a column as finite numbers (N); with `may_miss` an empty field is NaN."""
        column = pc.utf8_trim_whitespace(self._column(name))
        if may_miss:
            column = pc.if_else(pc.equal(column, ""), None, column)
        try:
            values = numbers_from_arrow(pc.cast(column, pa.float64())).copy()
        except pa.ArrowInvalid:
            row = next(row for row, text in enumerate(column.to_pylist()) if text is not None and not _is_number(text))
            raise self._wrong(row, name, "a number", column[row].as_py()) from None
        is_bad = ~np.isfinite(values)
        if may_miss:
            is_bad &= np.array([text is not None for text in column.to_pylist()])
        if is_bad.any():
            row = int(np.flatnonzero(is_bad)[0])
            raise self._wrong(row, name, "a finite number", str(values[row]))
        return values

    def whole_numbers(self, name: str) -> Ints:
        """Return a column as whole numbers (N)."""
        column = pc.utf8_trim_whitespace(self._column(name))
        try:
            return np.array(numbers_from_arrow(pc.cast(column, pa.int64())), dtype=np.int64)
        except pa.ArrowInvalid:
            row = next(row for row, text in enumerate(column.to_pylist()) if not _is_whole(text))
            raise self._wrong(row, name, "a whole number", column[row].as_py()) from None

    def line(self, row: int) -> str:
        """Return where a row stands, for errors."""
        return f"{self.path} line {row + 2}"

    def missing(self, expected: str) -> InputError:
        """Return the error that says which columns are expected."""
        return InputError(
            f"{self.path}: expected {expected} in the first line, found {', '.join(self._names)[:300]}",
            hint=self._hint + "; --column NAME=THEIRS says what a column is called in the file",
        )

    def _column(self, name: str) -> pa.ChunkedArray:
        if name not in self._index:
            raise self.missing(f"one column {name!r}")
        return self._table.column(self._index[name])

    def _wrong(self, row: int, name: str, expected: str, found: str) -> InputError:
        return InputError(
            f"{self.line(row)}: {name}: expected {expected}, found {reprlib.repr(found)}", hint=self._hint
        )


def read_csv(path: Path, required: Mapping[str, pa.DataType], optional: Mapping[str, pa.DataType]) -> pa.Table:
    """Return the named columns of a file, in the types given, which are those of texts, numbers and whole numbers.

    Optional columns that are absent are left out, as are columns that nobody asked for. There are no missing
    values: an empty field is an empty text, and no number.

    Raises
    ------
    InputError
        The file is missing, empty or no CSV, lacks a column, or a value is not of its type.
    """
    expected = ", ".join(f"{name} ({_NAMES[kind]})" for name, kind in required.items())
    file = CsvFile(path, f"a CSV file with columns {expected}")
    found = {}
    for name, kind in {**required, **optional}.items():
        if name in required or file.has(name):
            take = {pa.int64(): file.whole_numbers, pa.float64(): file.numbers, pa.string(): file.texts}[kind]
            found[name] = pa.array(take(name), kind)
    return pa.table(found)


def parse_columns(assignments: list[str]) -> dict[str, str]:
    """Return which column stands under which name, of texts such as `heading_deg=yaw`."""
    found = {}
    for assignment in assignments:
        ours, is_pair, theirs = assignment.partition("=")
        if not (is_pair and ours.strip() and theirs.strip()):
            raise SettingError(f"column {assignment!r}: expected NAME=THEIRS", hint="for example lat=latitude")
        found[ours.strip()] = theirs.strip()
    return found


def _header(path: Path, expected: str) -> tuple[list[str], str]:
    check_file(path, expected)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline(_LARGEST_HEADER)
    except UnicodeDecodeError as error:
        hint = "unpack it first" if path.read_bytes()[:2] == b"\x1f\x8b" else f"expected {expected}, in UTF-8"
        raise InputError(f"{path}: cannot be read as CSV: its first line is not UTF-8", hint=hint) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", hint=f"expected {expected}") from error
    if not first.strip():
        raise InputError(f"{path}: cannot be read as CSV: its first line is empty", hint=f"expected {expected}")
    separator = max(_SEPARATORS, key=first.count)
    try:
        return next(csv.reader([first], delimiter=separator)), separator
    except (csv.Error, StopIteration) as error:
        raise InputError(f"{path}: cannot be read as CSV: {error}", hint=f"expected {expected}") from error


def _read(path: Path, separator: str, columns: int, hint: str) -> pa.Table:
    names = [str(number) for number in range(columns)]
    try:
        return pa_csv.read_csv(
            path,
            # Else errors do not say the row.
            read_options=pa_csv.ReadOptions(use_threads=False, column_names=names, skip_rows=1),
            parse_options=pa_csv.ParseOptions(delimiter=separator),
            convert_options=pa_csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()), null_values=[], strings_can_be_null=False
            ),
        )
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        if "Empty CSV" in reason:
            raise InputError(f"{path}: no rows after the first line", hint="check what wrote the file") from error
        raise InputError(f"{path}: cannot be read as CSV: {reason}", hint=hint) from error


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def _is_whole(text: str) -> bool:
    return text.lstrip("+-").isdecimal() and abs(int(text)) < 2**63 and not text.startswith("+")
