"""CSV files as spreadsheets and programs write them."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import pyarrow as pa
import pytest

from valuemap import csv_table
from valuemap.csv_table import odd_fields, read_csv_arrow
from valuemap.errors import InputError

TYPES = {**dict.fromkeys("xyz", pa.float64()), "class": pa.string()}
PLAIN = b"x,y,z,class\n1,2,3.5,light\n"


def read(folder: Path, content: bytes, *, bad_numbers_are_nan: bool = False) -> list[dict[str, object]]:
    (folder / "points.csv").write_bytes(content)
    table = read_csv_arrow(
        folder / "points.csv", TYPES, has_missing=False, hint="a hint", bad_numbers_are_nan=bad_numbers_are_nan
    )
    rows: list[dict[str, object]] = table.to_pylist()
    return rows


@pytest.mark.parametrize(
    "content",
    [
        PLAIN,
        b"\xef\xbb\xbf" + PLAIN,
        gzip.compress(PLAIN, mtime=0),
        PLAIN.replace(b"\n", b"\r\n"),
        b"X,Y,Z,Class\n1,2,3.5,light\n",
        b" x, Y ,z,class\n1,2,3.5,light\n",
        b"x;y;z;class\n1;2;3.5;light\n",
        b"x;y;z;class\n1;2;3,5;light\n",
        b"sep=;\nx;y;z;class\n1;2;3,5;light\n",
        b'\xef\xbb\xbf"SEP=,"\r\nx,y,z,class\r\n1,2,3.5,light\r\n',
        b"sep=|\nx|y|z|class\n1|2|3,5|light\n",
        b"x\ty\tz\tclass\n1\t2\t3.5\tlight\n",
        b'"x","y","z","class"\n1,2,3.5,"light"\n',
        PLAIN + b",,,\n\n , , ,\r\n",
        b"x;y;z;class\n1;2;3,5;light\n;;;\n",
    ],
)
def test_all_these_say_the_same(tmp_path: Path, content: bytes) -> None:
    assert read(tmp_path, content) == [{"x": 1.0, "y": 2.0, "z": 3.5, "class": "light"}]


def test_a_name_in_other_letters_is_taken_only_where_the_exact_one_is_not_there(tmp_path: Path) -> None:
    assert read(tmp_path, b"x,X\n1,one\n") == [{"x": 1.0, "X": "one"}]


def test_what_is_no_number_is_an_error_or_nan(tmp_path: Path) -> None:
    content = b"x,y,z\n1,two,3\n4,,6\n"
    with pytest.raises(InputError, match=r"points\.csv: cannot be read as CSV: .*invalid value 'two'"):
        read(tmp_path, content)
    rows = read(tmp_path, content, bad_numbers_are_nan=True)
    assert str(rows) == "[{'x': 1.0, 'y': nan, 'z': 3.0}, {'x': 4.0, 'y': nan, 'z': 6.0}]"


def test_fields_are_separated_by_what_separates_most_names(tmp_path: Path) -> None:
    row = {"x": 1.5, "note, free": "a"}
    assert read(tmp_path, b"x;y;note, free\n1,5;2,5;a\n") == [{"y": 2.5, **row}]
    assert read(tmp_path, b'x;"note, free"\n1,5;a\n') == [row]
    assert read(tmp_path, b'x,"one; two; three"\n1.5,a\n') == [{"x": 1.5, "one; two; three": "a"}]
    assert read(tmp_path, b"sep=;\nx;a,b,c,d\n1,5;a\n") == [{"x": 1.5, "a,b,c,d": "a"}]


def test_a_large_file_may_say_what_separates_its_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_table, "_START", 20)
    monkeypatch.setattr(csv_table, "_BLOCK", 30)
    content = b"sep=;\nx;class\n" + b"1,5;light\n" * 20
    assert read(tmp_path, content) == [{"x": 1.5, "class": "light"}] * 20


def test_empty_rows_at_the_end_of_a_large_file_are_none(tmp_path: Path) -> None:
    rows = [f"{number},2,3.5,light" for number in range(100_000)]
    content = "x,y,z,class\n" + "\n".join(rows) + "\n"
    assert len(read(tmp_path, content.encode())) == len(rows)
    assert len(read(tmp_path, (content + ",,,\n,,,\n").encode())) == len(rows)


@pytest.mark.parametrize("block", [997, 2**24])
@pytest.mark.parametrize("comment", ['"first line\nsecond, ""line"""', '6" wide'])
def test_line_breaks_in_quotation_marks_are_no_ends_of_rows(
    comment: str, block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a file of 1.7 MB: Arrow looks at one after the other."""
    monkeypatch.setattr(csv_table, "_START", 1000)
    monkeypatch.setattr(csv_table, "_BLOCK", block)
    count = 300 if block < 1000 else 40_000
    rows = [f"{number},2,3.5,light,{comment}" for number in range(count)]
    found = read(tmp_path, ("x,y,z,class,comment\n" + "\n".join(rows) + "\n").encode())
    assert [row["x"] for row in found] == list(range(count))
    assert {row["class"] for row in found} == {"light"}


def test_which_fields_are_no_numbers_is_known(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text('x,y,Z\n1,2,3\n1 m,-,6_0\n"1,500",n/a,9\n,,\n', encoding="utf-8")
    table = read_csv_arrow(path, TYPES, has_missing=False, hint="a hint", bad_numbers_are_nan=True)
    assert table.num_rows == 3
    assert [(odd_fields(table, name)[0].tolist(), odd_fields(table, name)[1]) for name in "xyz"] == [
        ([1, 2], "1 m"), ([], ""), ([1], "6_0")
    ]  # fmt: skip
    assert str(table.column("z").to_pylist()) == "[3.0, nan, 9.0]"


@pytest.mark.parametrize(
    ("content", "hint"),
    [
        (b"# my points\nx,y,z\n1,2,3\n", "remove the lines that begin with #"),
        ("x,y,z,class\n1,2,3,Stra\u00dfe\n".encode("latin-1"), "byte 22 is not UTF-8: save it as CSV in UTF-8"),
    ],
)
def test_the_hint_says_what_helps(tmp_path: Path, content: bytes, hint: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    assert caught.value.hint.startswith((hint, "the first line names the columns: " + hint))
    assert caught.value.hint.endswith("; a hint")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "cannot be read as CSV: Empty CSV file"),
        (b"\0\0\0", "cannot be read as CSV"),
        ("x,y,z\n1,2,3\n".encode("utf-16"), "is text in UTF-16, not in UTF-8"),
        (b"PK\3\4xl/worksheets", "is a zip archive or a spreadsheet, not CSV"),
        (b"PAR1....", "is a Parquet file, not CSV"),
        (b"\xef\xbb\xbf\n<!DOCTYPE html><html>404", "is a web page or XML, not CSV"),
        (b'{"type": "FeatureCollection"}', "is JSON, not CSV"),
        (b"[\n1]", "is JSON, not CSV"),
        (gzip.compress(PLAIN, mtime=0)[:-9], "cannot be read as CSV: Compressed file ended"),
        (b"x,y,z,class\n1,2,3,\xff\n", "invalid UTF8 data"),
        (b"x,y,z\n1,2\n", "Row #2: Expected 3 columns, got 2"),
    ],
)
def test_what_is_no_csv_is_named(tmp_path: Path, content: bytes, said: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "a hint" in caught.value.hint


def test_a_header_without_an_end_is_a_table_without_rows(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_bytes(b"x,y,class")
    table = read_csv_arrow(tmp_path / "points.csv", TYPES, has_missing=False, hint="a hint")
    assert (table.column_names, table.num_rows) == (["x", "y", "class"], 0)


def test_a_pipe_does_not_hang(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match=r"pipe\.csv: is not a file"):
        read_csv_arrow(tmp_path / "pipe.csv", TYPES, has_missing=False, hint="a hint")


def test_a_quotation_mark_that_is_not_closed_in_the_first_line_is_refused(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_bytes(b'x,",y,z,class\rx,",y,z,class\r1,2,3,4,5\r')
    with pytest.raises(InputError, match="first line has a quotation mark that is not closed"):
        read_csv_arrow(tmp_path / "points.csv", TYPES, has_missing=False, hint="a hint", bad_numbers_are_nan=True)
