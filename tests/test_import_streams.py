"""Large tables of boxes, and COCO's: read in blocks and judged in portions, to the same bytes as at once."""

from __future__ import annotations

import errno
import gc
import io
import json
import os
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import valuemap
from valuemap import csv_table, json_lists, portions
from valuemap.errors import InputError, OutputError
from valuemap.json_lists import read_json_lists
from valuemap.readers import READERS, boxes, row_file, vet
from valuemap.readers.detections import DetectionFile
from valuemap.readers.detections.coco import read_coco
from valuemap.readers.texts import Texts
from valuemap.tables import Categories, Detections
from valuemap.tables import write as write_tables
from valuemap.text_files import read_json

HEADER = "image,class,left,top,width,height,score,range_m"


def write(folder: Path, *, separator: str = ",", bad: bool = True, count: int = 2000) -> Path:
    """Write poses of 40 images and so many boxes in them, some of which cannot be used."""
    random = np.random.default_rng(5)
    folder.mkdir()
    poses = ["image,x,y,z,heading_deg,pass,width_px,height_px,fx,cx,cy"]
    poses += [f"{i // 20}/{i}.jpg,{2.0 * i},0,1.5,90,{i // 20},640,480,500,320,240" for i in range(40)]
    (folder / "poses.csv").write_text("\n".join(poses) + "\n")
    rows = []
    for i in range(count):
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


def in_small_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let what is in memory together be a few rows, so that there are many portions, parts and blocks."""
    monkeypatch.setattr(row_file, "PORTION", 77)
    monkeypatch.setattr(row_file.KeyBounds, "_STEP", 3)
    monkeypatch.setattr(json_lists, "PORTION", 31)
    monkeypatch.setattr(csv_table, "_BLOCK", 999)
    monkeypatch.setattr(csv_table, "_START", 1000)


def test_an_import_in_blocks_and_portions_is_that_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write(tmp_path / "data")
    at_once = imported(folder, tmp_path / "whole")
    assert "rejected.parquet" in at_once
    in_small_portions(monkeypatch)
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
    why.mark(np.arange(300) >= 298, vet._Reason("late", "hint"))
    assert why.reasons[why.code[299]].text == "reason 299"


def test_texts_that_repeat_are_held_once() -> None:
    texts = Texts.of(["b", "a", "b", "", "a"])
    assert list(texts) == ["b", "a", "b", "", "a"]
    assert texts.distinct == ["b", "a", ""]
    assert (texts[2], list(texts[1:3]), texts.index("a"), len(texts)) == ("b", ["a", "b"], 1, 5)
    assert Texts.of(texts) is texts
    assert list(Texts.repeated("x", 2)) == ["x", "x"]


# COCO's files.


def coco(folder: Path, *, results: bool = False, corners: int = 5) -> Path:
    """Write the boxes of `write` as COCO's, with what is not needed in them, and some that cannot be used."""
    lines = (folder / "boxes.csv").read_text().splitlines()[1:]
    rows = [line.split(",") for line in lines]
    images = [{"id": 100 - i, "file_name": f"{i // 20}/{i}.jpg", "width": 640, "height": 480} for i in range(40)]
    number = {image["file_name"]: image["id"] for image in images}
    entries: list[Any] = [
        {
            "image_id": name if results else number.get(name, 7),
            "category_id": {"light": 1, " sign ": 2}.get(kind, 9),
            "bbox": [float(left), float(top), float(width), float(height)],
            "score": float(score),
            "segmentation": [[0.25] * corners, '\\"ü]}\u00fc' * 9],
        }
        for name, kind, left, top, width, height, score, _ in rows
    ]
    entries[11]["bbox"], entries[12]["score"] = [1, 2, None, float("nan")], "high"
    content: Any = entries
    if not results:
        entries = [{**box, "id": 5 * i} for i, box in enumerate(entries)]
        categories = [{"id": 1, "name": "light"}, {"id": 2, "name": "sign"}]
        content = {"info": {"a": [1, {}]}, "annotations": entries, "licenses": [[], {}], "images": images, "x": []}
        content |= {"categories": categories, "y": 1e5}
    path = folder / "boxes.json"
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False))
    return path


def coco_imported(folder: Path, out: Path) -> dict[str, bytes]:
    dataset = READERS["csv"](folder / "poses.csv", detections=folder / "boxes.json", max_rejected=0.05)
    valuemap.write_dataset(dataset, out)
    return {path.name: path.read_bytes() for path in out.glob("*.parquet")}


@pytest.mark.parametrize("results", [False, True])
def test_an_import_of_coco_in_portions_is_that_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, results: bool
) -> None:
    folder = write(tmp_path / "data")
    coco(folder, results=results)
    at_once = coco_imported(folder, tmp_path / "whole")
    assert "rejected.parquet" in at_once
    monkeypatch.setattr(json_lists, "_BLOCK", 300)
    monkeypatch.setattr(json_lists, "PORTION", 7)
    assert coco_imported(folder, tmp_path / "parts") == at_once
    data = valuemap.read_dataset(tmp_path / "parts")
    assert data.rejected is not None
    assert (
        f"{folder / 'boxes.json'}: {'results' if results else 'annotations'}[1999]" in data.rejected.place.to_pylist()
    )
    assert list(data.detections.detection_id[:3]) == ([0, 1, 2] if results else [0, 5, 10])


def many(folder: Path, count: int, kind: str) -> Path:
    """Write so many boxes in 40 images, one in a hundred of which cannot be used, and one of which is there twice."""
    random = np.random.default_rng(6)
    image = random.integers(0, 40, count).tolist()
    box = random.uniform([0, 0, 5, 5, 0], [600, 440, 40, 40, 1], (count, 5)).round(4).tolist()
    box[100:count:100] = [[-50.0, *values[1:]] for values in box[100:count:100]]
    box[50:count:100], image[50:count:100] = box[49:count:100], image[49:count:100]
    if kind == "csv":
        lines = [f"{i // 20}/{i}.jpg,light,{','.join(map(str, b))}" for i, b in zip(image, box, strict=True)]
        path, text = folder / f"{count}.csv", "\n".join(["image,class,left,top,width,height,score", *lines])
    else:
        ids = random.permutation(count).tolist()
        names = [{"id": i, "file_name": f"{i // 20}/{i}.jpg"} for i in range(40)]
        entries = [
            {"id": number, "image_id": i, "category_id": 1, "bbox": b[:4], "score": b[4]}
            for number, i, b in zip(ids, image, box, strict=True)
        ]
        content = {"images": names, "categories": [{"id": 1, "name": "light"}], "annotations": entries}
        path, text = folder / f"{count}.json", json.dumps(content)
    path.write_text(text)
    return path


@pytest.mark.parametrize("kind", ["csv", "coco"])
def test_memory_does_not_grow_with_the_boxes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    poses = write(tmp_path / "data") / "poses.csv"
    in_small_portions(monkeypatch)
    monkeypatch.setattr(row_file, "PORTION", 500)
    monkeypatch.setattr(csv_table, "_BLOCK", 10_000)
    monkeypatch.setattr(json_lists, "_BLOCK", 10_000)
    monkeypatch.setattr(write_tables, "ROWS_OF_GROUP", 500)

    in_arrow: list[int] = []
    append = row_file.RowFile.append

    def looking(self: row_file.RowFile, rows: row_file.Rows) -> None:
        in_arrow.append(pa.total_allocated_bytes())
        append(self, rows)

    monkeypatch.setattr(row_file.RowFile, "append", looking)

    def peak(count: int) -> tuple[int, int]:
        """Return the peaks of what Python held, and of what Arrow held more than before where portions are put away."""
        path = many(tmp_path, count, kind)
        in_arrow.clear()
        gc.collect()  # What other tests left to Arrow is given back now, and not on the way.
        before = pa.total_allocated_bytes()
        tracemalloc.start()
        found = READERS["csv"].in_portions(poses, detections=path, max_rejected=0.05)
        found.write(tmp_path / f"out {count}")
        python = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return python, max(in_arrow) - before

    peak(1000)  # What is imported is no part of it.
    few, more = peak(2_000), peak(10_000)
    # Less than the boxes take: what is listed of a group of those left out is texts, a quarter of a megabyte.
    assert more[0] - few[0] < 20 * 8_000
    assert more[1] < 1.5 * few[1] + 10_000
    # The same with all in one portion, and of a table in one block.
    monkeypatch.setattr(row_file, "PORTION", 10**6)
    monkeypatch.setattr(csv_table, "_BLOCK", 2_000_000)
    whole = peak(10_000)
    assert whole[0] - few[0] > 50 * 8_000
    if kind == "csv":
        assert whole[1] > 3 * more[1]


def test_files_are_the_same_however_detections_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write(tmp_path / "data")
    monkeypatch.setattr(write_tables, "ROWS_OF_GROUP", 300)
    in_small_portions(monkeypatch)
    found = READERS["csv"].in_portions(folder / "poses.csv", detections=folder / "boxes.csv", max_rejected=0.05)
    found.write(tmp_path / "streamed" / "city")
    valuemap.write_dataset(replace(found.whole(), name="city"), tmp_path / "whole" / "city")
    names = sorted(path.name for path in (tmp_path / "whole" / "city").iterdir())
    assert "rejected.parquet" in names
    for name in names:
        assert (tmp_path / "streamed" / "city" / name).read_bytes() == (tmp_path / "whole" / "city" / name).read_bytes()
    assert pq.ParquetFile(tmp_path / "streamed" / "city" / "detections.parquet").num_row_groups == 7


def test_what_was_read_of_a_file_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count, random = 200_000, np.random.default_rng(9)
    monkeypatch.setattr(write_tables, "ROWS_OF_GROUP", 10_000)
    detections = Detections(
        detection_id=np.arange(count),
        image_id=random.integers(0, 2**40, count),
        class_name=Categories(np.zeros(count, np.int32), ("light",)),
        center_px=random.random((count, 2)),
        size_px=random.random((count, 2)),
        score=random.random(count),
    )
    write_tables.write_table(detections, tmp_path / "detections.parquet")
    tracemalloc.start()
    lengths = [len(portion) for portion in portions.read_portions(Detections, tmp_path / "detections.parquet", 10_000)]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert lengths == [10_000] * 20
    assert peak < 4 * 10_000 * 64


def test_no_room_for_temporary_files_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.BytesIO):
        def flush(self) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    folder = write(tmp_path / "data")
    monkeypatch.setattr("tempfile.TemporaryFile", Full)
    with pytest.raises(OutputError, match="cannot be written: No space left on device") as told:
        imported(folder, tmp_path / "out")
    assert "TMPDIR" in told.value.hint


def test_ids_that_do_not_ascend_are_told_apart_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    in_small_portions(monkeypatch)
    random = np.random.default_rng(8)
    for repeat in (False, True):
        ids = random.permutation(2**40 + np.arange(1000) ** 3)
        if repeat:
            ids[977] = ids[13]
        rows = row_file.RowFile(boxes.structure(("detection_id",)))
        for first in range(0, 1000, 90):
            portion = np.zeros(len(ids[first : first + 90]), rows.dtype)
            portion["detection_id"] = ids[first : first + 90]
            rows.append(portion)
        distinct, bounds = boxes.are_distinct(rows)
        assert distinct != repeat
        assert 1 < len(bounds) < 100


def test_a_large_coco_file_is_never_in_memory_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = coco(write(tmp_path / "data"), corners=99)
    monkeypatch.setattr(json_lists, "_BLOCK", 2**14)
    monkeypatch.setattr(json_lists, "PORTION", 20)
    tracemalloc.start()
    found = read_coco(DetectionFile(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found.rows) == 2000
    assert peak < path.stat().st_size / 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["annotations"].__setitem__(50, 3), r"annotations\[50\]: expected an object, found 3"),
        (lambda c: c["images"][39].pop("id"), r"images\[39\]: id: expected a whole number or a text, found None"),
        (lambda c: c["images"][38].update(id=90), r"images\[38\]: id 90 is there twice"),
        (lambda c: c["categories"][1].update(id=1), r"categories\[1\]: id 1 is there twice"),
        (lambda c: c.update(annotations={}), "there is no list named annotations"),
        (lambda c: c.update(annotations=[]), "there are no detections in it"),
        (lambda c: c.pop("images"), "there is no list named images"),
        (lambda c: c.update(categories={"1": "light"}), "there is no list named categories"),
    ],
)
def test_errors_of_coco_in_portions_say_the_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Any, message: str
) -> None:
    path = coco(write(tmp_path / "data", bad=False, count=60))
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    monkeypatch.setattr(json_lists, "PORTION", 7)
    with pytest.raises(InputError, match=message):
        read_coco(DetectionFile(path))


def test_the_first_result_of_coco_that_names_no_file_is_named_whatever_the_portion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Portions of 7 results: none in the first, two in the second, one more in the last."""
    result = {"category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}
    unnamed = {10: 77, 12: 78, 30: 79}
    results = [{**result, "image_id": unnamed.get(row, "a.jpg")} for row in range(31)]
    path = tmp_path / "results.json"
    path.write_text(json.dumps(results))
    for portion in (7, 100):
        monkeypatch.setattr(json_lists, "PORTION", portion)
        with pytest.raises(InputError, match=r"results\[10\]: image_id 77 does not say which file it is \(3 entries\)"):
            read_coco(DetectionFile(path))


def test_of_lists_of_one_name_the_last_counts(tmp_path: Path) -> None:
    path = coco(write(tmp_path / "data", bad=False, count=60))
    box = '{"image_id": 100, "category_id": 1, "bbox": [1, 2, 3, 4], "id": 1}'
    path.write_text(
        path.read_text().rstrip()[:-1] + f', "annotations": [{box}], "images": 3, "images": [], "images": []}}'
    )
    found = read_coco(DetectionFile(path))
    assert (len(found.rows), found.other_names, list(found.image_names)) == (1, [], ["image_id 100"])


def in_portions(path: Path) -> Any:
    """Return what a JSON file holds, put together from its portions; or what is said against it."""
    found: Any = {}
    try:
        for portion in read_json_lists(path, "JSON"):
            if portion.entries is None and portion.key is None:
                found = portion.value
            elif portion.key is None:
                found = [] if portion.first == 0 else found
                assert len(found) == portion.first
                found += portion.entries or []
            elif portion.entries is None or portion.first == 0:
                found[portion.key] = portion.value if portion.entries is None else list(portion.entries)
            else:
                assert len(found[portion.key]) == portion.first
                found[portion.key] += portion.entries
    except InputError as error:
        return str(error)
    return found


def at_once(path: Path) -> Any:
    """Return the same by the json module, of a text that is whole."""
    try:
        return read_json(path, "JSON")
    except InputError as error:
        return str(error)


WHOLE = [
    '{"a": [1, -2.5e-3, "x\\u00e4\\ud83d\\ude00", null, true, [], {}], "b": {"c": [1]}, "a b": [], "d": 12345678}',
    '[{"k": [1.25, NaN, -Infinity]}, {"k": "line\\n"}, 10000000, "text",\r\n {"k": "ü€😀"}]',
    " \n[\n]\n ",
    "{}",
    "-12.5e+7",
    '"no list"',
]


def test_portions_of_json_are_the_file_and_their_errors_those_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(7)
    monkeypatch.setattr(json_lists, "PORTION", 2)
    path = tmp_path / "file.json"
    told = set()
    for case in range(1200):
        text = WHOLE[case % len(WHOLE)]
        at = int(random.integers(0, len(text) + 1))
        mark = random.choice(list('[]{}",:\\ue1-.+x \n'))
        text = [text, text[:at], text[:at] + mark + text[at:], text[:at] + text[at + 1 :]][case // len(WHOLE) % 4]
        content = text.encode()
        if case % 50 == 49:
            content = content[: at // 2] + b"\xff" + content[at // 2 :]
        if case % 3 == 0:
            content = b"\xef\xbb\xbf" + content
        path.write_bytes(content)
        expected = at_once(path)
        monkeypatch.setattr(json_lists, "_BLOCK", int(random.integers(1, 40)))
        found = in_portions(path)
        assert repr(found) == repr(expected) or (
            # Later versions of Python say in other words that a comma has nothing behind it.
            sys.version_info >= (3, 13) and "Illegal trailing comma" in str(expected) and "JSON" in str(found)
        ), content
        told.add(str(expected).partition(": line")[0].partition("JSON: ")[2])
    assert len(told) > 8, told
