"""Tables of the user's own in CSV files, with columns that are found by their names."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from valuemap.arrays import Bools, Floats
from valuemap.arrow import numbers_from_arrow
from valuemap.csv_table import has_decimal_commas, lines_before_header, odd_fields, read_csv_arrow, read_csv_portions
from valuemap.errors import InputError, SettingError
from valuemap.readers.files import check_file
from valuemap.readers.texts import Texts

_NAMES_OF_OTHERS = {
    "class": ("label", "category", "class_name", "category_name", "class_id", "category_id"),
    "score": ("conf", "confidence", "probability"),
}
"""What detectors and their tools call these columns."""


class CsvFile:
    """The columns of a CSV file, some of which may be missing or have other names.

    Parameters
    ----------
    path
        The file.
    expected
        What it should be, in words, for errors.
    texts, numbers
        Names of columns, lower case, that are texts and numbers; others are not looked at.
    columns
        Under which name a column stands in the file, where it is another one.
    table, first_row
        A portion of the file, as it was read, and which row it begins with; without, the whole file.

    Raises
    ------
    InputError
        The file is missing, empty or no CSV, or has a column twice.
    SettingError
        `columns` names a column that the file does not have, or one that nobody asks for.
    """

    def __init__(
        self,
        path: Path,
        expected: str,
        *,
        texts: Sequence[str],
        numbers: Sequence[str],
        columns: Mapping[str, str] | None = None,
        table: pa.Table | None = None,
        first_row: int = 0,
    ) -> None:
        self.path, self._first_row = path, first_row
        self._hint = _hint(expected)
        columns = columns or {}
        unknown = [name for name in columns if name not in (*texts, *numbers)]
        if unknown:
            raise SettingError(
                f"column {unknown[0]}={columns[unknown[0]]}: there is no column {unknown[0]!r}",
                hint=f"the names before = are among {', '.join((*texts, *numbers))}",
            )
        names = (*texts, *numbers)
        if table is None:
            check_file(path, expected)
            types = _types(texts, numbers, columns)
            table = read_csv_arrow(path, types, has_missing=False, hint=self._hint, bad_numbers_are_nan=True)
        self._table = table
        if self._table.num_rows == 0:
            raise InputError(f"{path}: no rows after the first line", hint="check what wrote the file")
        self._name = {
            name: columns.get(name, name) for name in names if name in columns or name not in columns.values()
        }
        for ours, theirs in columns.items():
            if theirs not in self._table.column_names:
                found = ", ".join(self._table.column_names)[:300]
                raise SettingError(f"column {ours}={theirs}: {path} has no column {theirs!r}", hint=f"it has {found}")
        for theirs in self._name.values():
            if self._table.column_names.count(theirs) > 1:
                raise InputError(f"{path}: column {theirs!r} is there twice", hint="keep one of them")

    def __len__(self) -> int:
        return int(self._table.num_rows)

    def has(self, *names: str) -> bool:
        """Say whether all of these columns are there."""
        return all(self._name.get(name) in self._table.column_names for name in names)

    def has_optional(self, name: str) -> bool:
        """Say whether a class or a score is there; refuse a table that has it under a name of others."""
        if self.has(name):
            return True
        read = set(self._name.values())
        others = (theirs for theirs in self._table.column_names if theirs.lower() in _NAMES_OF_OTHERS[name])
        theirs = next((theirs for theirs in others if theirs not in read), None)
        if theirs is not None:
            raise InputError(
                f"{self.path}: has no column {name!r}, and its column {theirs!r} is none of {', '.join(self._name)}",
                hint=f"an option says what a column is called in the file, {name}={theirs}; or remove the column",
            )
        return False

    def texts(self, name: str) -> Texts:
        """Return a column as texts (N) without spaces around them; an empty field is an empty text."""
        chunks = self._column(name).chunks
        number: dict[str, int] = {}
        codes = [np.empty(0, np.int32)]
        for chunk in chunks:
            of = [number.setdefault(text.strip(), len(number)) for text in chunk.dictionary.to_pylist()]
            codes.append(np.array(of, np.int32)[numbers_from_arrow(chunk.indices)])
        return Texts(np.concatenate(codes), list(number))

    def filled_texts(self, name: str, *, may_be_left_away: bool = False) -> list[str]:
        """Return a column, which maybe need not be there, as texts (N) none of which is empty."""
        texts = self.texts(name)
        if "" in texts.distinct:
            row = texts.index("")
            count = int(np.sum(texts.codes == texts.codes[row]))
            other_way = ", or remove the column" if may_be_left_away else ""
            raise InputError(
                f"{self.line(row)}: {name}: expected a text, found none ({count} rows)",
                hint=f"fill in {self._name[name]!r} in all rows{other_way}",
            )
        return list(texts)

    def numbers(self, name: str) -> Floats:
        """Return a column as numbers (N), NaN where there is none or another text."""
        values: Floats = numbers_from_arrow(self._column(name)).astype(np.float64)
        return values

    def with_points(self, text: str) -> str:
        """Return a text of numbers with decimal points, where the file may have commas."""
        return text.replace(",", ".") if has_decimal_commas(self._table) else text

    def some_numbers(self, name: str, hint: str) -> Floats:
        """Return a column as numbers (N), not all of which are NaN; `hint` says what to do where they are."""
        values = self.numbers(name)
        if np.isnan(values).all():
            rows, text = odd_fields(self._table, self._name[name])
            found = f"{text!r}" if len(rows) else "none"
            raise InputError(
                f"{self.line(int(rows[0]) if len(rows) else 0)}: {name}: expected a number, found {found}, and none in "
                f"any of {len(values)} rows",
                hint=hint,
            )
        return values

    def numbers_or_none(self, name: str) -> Floats:
        """Return a column as numbers (N), NaN where nothing is known and infinite where there is another text."""
        values = self.numbers(name)
        values[odd_fields(self._table, self._name[name])[0]] = np.inf
        return values

    def finite_numbers(self, name: str) -> Floats:
        """Return a column as numbers (N) all of which are finite."""
        values = self.numbers(name)
        self.refuse(~np.isfinite(values), name, "a finite number")
        return values

    def whole_numbers(self, name: str) -> list[int]:
        """Return a column as whole numbers (N)."""
        values = self.numbers(name)
        self.refuse(~(np.abs(values) < 2**53) | (values % 1.0 != 0.0), name, "a whole number")
        return [int(value) for value in values.tolist()]

    def refuse(self, wrong: Bools, name: str, expected: str) -> None:
        """Raise one error for all wrong rows (N), showing the first."""
        rows = np.flatnonzero(wrong)
        if len(rows):
            odd, text = odd_fields(self._table, self._name[name])
            found = reprlib.repr(text if len(odd) and odd[0] == rows[0] else self._column(name)[int(rows[0])].as_py())
            raise InputError(
                f"{self.line(int(rows[0]))}: {name}: expected {expected}, found {found} ({len(rows)} rows)",
                hint=self._hint,
            )

    def line(self, row: int) -> str:
        """Return where a row stands, for errors."""
        return line_of(self.path, lines_before_header(self._table) + self._first_row + row)

    def missing(self, expected: str) -> InputError:
        """Return the error that says which columns are expected."""
        return InputError(
            f"{self.path}: expected {expected} in the first line, found {', '.join(self._table.column_names)[:300]}",
            hint=f"{self._hint}; an option says what a column is called in the file, NAME=THEIRS",
        )

    def _column(self, name: str) -> pa.ChunkedArray:
        if not self.has(name):
            raise self.missing(f"a column {name!r}")
        return self._table.column(self._name[name])


def csv_portions(
    path: Path, expected: str, *, texts: Sequence[str], numbers: Sequence[str], columns: Mapping[str, str]
) -> Iterator[CsvFile]:
    """Yield a CSV file in portions, each as a `CsvFile`, whose parameters these are."""
    check_file(path, expected)
    types, first_row = _types(texts, numbers, columns), 0
    for table in read_csv_portions(path, types, has_missing=False, hint=_hint(expected), bad_numbers_are_nan=True):
        yield CsvFile(path, expected, texts=texts, numbers=numbers, columns=columns, table=table, first_row=first_row)
        first_row += len(table)


def _types(texts: Sequence[str], numbers: Sequence[str], columns: Mapping[str, str]) -> dict[str, pa.DataType]:
    """Return the types of columns by their names in a file."""
    # Texts that repeat, as the names of images do of boxes, are held once.
    kinds = dict.fromkeys(texts, pa.dictionary(pa.int32(), pa.string())) | dict.fromkeys(numbers, pa.float64())
    # A column that has another's name does not count as that.
    return {columns.get(name, name): kind for name, kind in kinds.items()}


def _hint(expected: str) -> str:
    return f"expected {expected}"


def line_of(path: Path, row: int) -> str:
    """Return where a row of a CSV file stands, for errors."""
    return f"{path} line {row + 2}"


def parse_columns(assignments: Sequence[str]) -> dict[str, str]:
    """Return which column stands under which name, of texts such as `heading_deg=yaw`."""
    found = {}
    for assignment in assignments:
        ours, is_pair, theirs = (part.strip() for part in assignment.partition("="))
        if not (is_pair and ours and theirs):
            raise SettingError(f"column {assignment!r}: expected NAME=THEIRS", hint="for example lat=latitude")
        found[ours] = theirs
    return found
