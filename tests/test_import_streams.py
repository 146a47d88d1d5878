"""Large tables of boxes: read in blocks and judged in portions, to the same bytes as at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import valuemap
from valuemap import csv_table
from valuemap.errors import InputError
from valuemap.readers import READERS, vet
from valuemap.readers.texts import Texts

HEADER = "image,class,left,top,width,height,score,range_m"


def write(folder: Path, *, separator: str = ",", bad: bool = True) -> Path:
    """Write poses of 40 images and 2000 boxes in them, some of which cannot be used."""
    random = np.random.default_rng(5)
    folder.mkdir()
    poses = ["image,x,y,z,heading_deg,pass,width_px,height_px,fx,cx,cy"]
    poses += [f"{i // 20}/{i}.jpg,{2.0 * i},0,1.5,90,{i // 20},640,480,500,320,240" for i in range(40)]
    (folder / "poses.csv").write_text("\n".join(poses) + "\n")
    rows = []
    for i in range(2000):
        left, top, width, height = random.uniform([0, 0, 5, 5], [600, 440, 40, 40]).round(2)
        image, kind = f"{i % 2}/{random.integers(0, 20) + 20 * (i % 2)}.jpg", ("light", " sign ", "light")[i % 3]
        rows.append([image, kind, left, top, width, height, round(random.uniform(), 3), 30.5])
    if bad:
        rows[7][0], rows[901][1], rows[902][2], rows[1500][4], rows[1999][6] = "none.jpg", "", 5000.0, -3.0, 7.0
        rows[1200], rows[1201] = rows[3], [*rows[3][:6], 0.999, 30.5]
    lines = [HEADER, *(",".join(map(str, row)) for row in rows)]
    text = "\n".join(lines).replace(",", separator) + "\n"
    (folder / "boxes.csv").write_text(text.replace(".5\n", ",5\n") if separator == ";" else text)
    return folder


def imported(folder: Path, out: Path) -> dict[str, bytes]:
    dataset = READERS["csv"](folder / "poses.csv", detections=folder / "boxes.csv", max_rejected=0.05)
    valuemap.write_dataset(dataset, out)
    return {path.name: path.read_bytes() for path in out.glob("*.parquet")}


def test_an_import_in_blocks_and_portions_is_that_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write(tmp_path / "data")
    at_once = imported(folder, tmp_path / "whole")
    assert "rejected.parquet" in at_once
    monkeypatch.setattr(csv_table, "_START", 1000)
    monkeypatch.setattr(vet, "_PORTION", 7)
    assert imported(folder, tmp_path / "parts") == at_once
    rejected = valuemap.read_dataset(tmp_path / "parts").rejected
    assert rejected is not None
    assert rejected.place.to_pylist() == [f"{folder / 'boxes.csv'} line {row + 2}" for row in (3, 7, 901, 902, 1200, 1500, 1999)]  # fmt: skip # noqa: E501


def test_a_large_table_is_never_in_memory_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write(tmp_path / "data")
    expected = imported(folder, tmp_path / "whole")
    monkeypatch.setattr(csv_table, "_START", 1000)
    monkeypatch.setattr(csv_table, "_read_text_bytes", None)  # Reads a file whole.
    assert imported(folder, tmp_path / "parts") == expected


@pytest.mark.parametrize("start", [b"\xef\xbb\xbf", b'"', b"\n"])
def test_what_does_not_begin_plainly_is_read_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: bytes
) -> None:
    folder = write(tmp_path / "data")
    expected = imported(folder, tmp_path / "whole")
    text = (folder / "boxes.csv").read_bytes()
    (folder / "boxes.csv").write_bytes(start + (text.replace(b"image,", b'image",', 1) if start == b'"' else text))
    monkeypatch.setattr(csv_table, "_START", 1000)
    assert imported(folder, tmp_path / "again") == expected


def test_large_tables_with_decimal_commas_and_words_for_numbers_are_read_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write(tmp_path / "data", separator=";")
    expected = imported(folder, tmp_path / "whole")
    monkeypatch.setattr(csv_table, "_START", 1000)
    assert imported(folder, tmp_path / "again") == expected
    with (folder / "boxes.csv").open("a") as file:
        file.write("0/1.jpg;light;unknown;3;4;5;0.5;7\n")
    imported(folder, tmp_path / "words")
    rejected = valuemap.read_dataset(tmp_path / "words").rejected
    assert rejected is not None
    assert rejected.place[len(rejected) - 1].as_py().endswith("line 2002")


def test_damage_far_inside_a_large_table_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write(tmp_path / "data", bad=False)
    with (folder / "boxes.csv").open("a") as file:
        file.write("0/1.jpg,light,1,2\n")
    monkeypatch.setattr(csv_table, "_START", 1000)
    with pytest.raises(InputError, match=r"boxes.csv: cannot be read as CSV: .*2002"):
        imported(folder, tmp_path / "out")


def test_as_many_reasons_as_rows_are_told_apart() -> None:
    why = vet.Verdicts(300)
    for row in range(300):
        why.mark(np.arange(300) == row, vet._Reason(f"reason {row}", "hint"))
    assert [why.reasons[code].text for code in why.code.tolist()] == [f"reason {row}" for row in range(300)]
    why.mark(np.ones(2, np.bool_), vet._Reason("late", "hint"), slice(298, 300))
    assert why.reasons[why.code[299]].text == "reason 299"


def test_texts_that_repeat_are_held_once() -> None:
    texts = Texts.of(["b", "a", "b", "", "a"])
    assert list(texts) == ["b", "a", "b", "", "a"]
    assert texts.distinct == ["b", "a", ""]
    assert (texts[2], list(texts[1:3]), texts.index("a"), len(texts)) == ("b", ["a", "b"], 1, 5)
    assert Texts.of(texts) is texts
    categories = texts.categories(str.upper)
    assert categories.names == ("", "A", "B")
    assert categories.texts() == ["B", "A", "B", "", "A"]
    # What no row has is no category.
    assert texts[1:3].categories(str).names == ("a", "b")
    assert list(Texts.repeated("x", 2)) == ["x", "x"]
    assert Texts.of([]).categories(str).names == ()
