"""The door: a dataset survives writing and reading, and every inconsistency is refused in words of its own."""

from __future__ import annotations

import json
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from typer.testing import CliRunner

from small_dataset import ANCHOR, rewrite, small_dataset, with_column, with_value
from valuemap import portions
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, Frame, evenly, read_dataset, rows_of, write_dataset
from valuemap.errors import InputError, OutputError
from valuemap.folders import LEDGER, new_file
from valuemap.summary import summarize_dataset, summarize_portions
from valuemap.tables import Categories, Detections, Images
from valuemap.tables.read import read_table
from valuemap.tables.table import table_to_arrow

TABLES = ("cameras", "images", "detections", "truth", "truth_detections")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_dataset(small_dataset(), tmp_path / "city")
    return tmp_path / "city"


def assert_same_dataset(first: Dataset, second: Dataset) -> None:
    assert (first.name, first.frame) == (second.name, second.frame)
    for name in TABLES:
        assert table_to_arrow(getattr(first, name)).equals(table_to_arrow(getattr(second, name))), name


# Round trips.


@pytest.mark.parametrize("frame", [Frame(), Frame(up=(0.0, -1.0, 0.0)), Frame(anchor=ANCHOR)])
def test_a_dataset_survives_writing_and_reading(frame: Frame, tmp_path: Path) -> None:
    write_dataset(small_dataset(frame), tmp_path / "city")
    assert_same_dataset(read_dataset(tmp_path / "city"), small_dataset(frame))


def test_the_order_of_rows_in_the_files_does_not_matter(folder: Path) -> None:
    for name in TABLES:
        rewrite(folder / f"{name}.parquet", lambda table: table.take(pa.array(range(table.num_rows))[::-1]))
    assert_same_dataset(read_dataset(folder), small_dataset())


def test_the_same_dataset_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    write_dataset(small_dataset(), tmp_path / "again")
    files = sorted(path.name for path in folder.iterdir())
    assert files == sorted([LEDGER, "dataset.json", *(f"{name}.parquet" for name in TABLES)])
    for name in files:
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_truth_is_optional(folder: Path) -> None:
    (folder / "truth_detections.parquet").unlink()
    assert read_dataset(folder).truth_detections is None
    (folder / "truth.parquet").unlink()
    assert read_dataset(folder).truth is None


def test_what_was_written_by_hand_with_other_types_is_read(folder: Path) -> None:
    rewrite(folder / "images.parquet", with_column("pass_id", pa.array(["a", "a", "b", "b"])))
    rewrite(folder / "cameras.parquet", with_column("width", pa.array([640, 800], pa.uint16())))
    assert_same_dataset(read_dataset(folder), small_dataset())


def test_a_quaternion_within_rounding_is_normalised(folder: Path) -> None:
    rewrite(
        folder / "images.parquet",
        with_value("qw", 0, small_dataset().images.cam_from_world_quat[0, 0] * 1.0005),
    )
    quaternion = read_dataset(folder).images.cam_from_world_quat
    assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, rtol=0, atol=1e-15)


def test_a_dataset_without_a_name_has_that_of_its_folder(folder: Path) -> None:
    head = json.loads((folder / "dataset.json").read_text())
    del head["name"]
    (folder / "dataset.json").write_text(json.dumps(head))
    assert read_dataset(folder).name == "city"


def test_a_detection_may_reach_out_of_its_picture_by_a_box(folder: Path) -> None:
    rewrite(folder / "detections.parquet", with_value("x", 0, -10.0))
    rewrite(folder / "detections.parquet", with_value("y", 1, 500.0))
    assert len(read_dataset(folder).detections) == 5


@pytest.mark.parametrize(("width", "is_fine"), [(640, False), (800, True)])  # The other camera has 800 px.
def test_a_picture_ends_where_that_of_its_camera_does(folder: Path, width: int, is_fine: bool) -> None:
    rewrite(folder / "cameras.parquet", with_value("width", 0, width))
    rewrite(folder / "cameras.parquet", with_value("height", 0, 600))
    rewrite(folder / "detections.parquet", with_value("x", 0, 700.0))
    if is_fine:
        assert len(read_dataset(folder).detections) == 5
    rewrite(folder / "detections.parquet", with_value("x", 0, width + 10.1))
    with pytest.raises(InputError, match=rf"detection_id 100: x: expected a centre .* found {width + 10.1}"):
        read_dataset(folder)


def test_images_and_detections_are_read_beside_each_other(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both = Barrier(2)

    def waits(kind: Any, path: Path) -> Any:
        if kind in (Images, Detections):
            both.wait(timeout=30.0)  # Raises where the other one does not come.
        return read_table(kind, path)

    monkeypatch.setattr("valuemap.dataset.read_table", waits)
    assert_same_dataset(read_dataset(folder), small_dataset())


def test_rows_of_ids() -> None:
    assert_array_equal(rows_of(np.array([30, 10, 30]), np.array([10, 20, 30])), [2, 0, 2])
    assert_array_equal(rows_of(np.array([12, 10, 12]), np.array([10, 11, 12])), [2, 0, 2])
    assert_array_equal(rows_of(np.array([13, 10, 13]), np.array([10, 11, 13])), [2, 0, 2])
    assert_array_equal(rows_of(np.empty(0, np.int64), np.empty(0, np.int64)), [])


def test_some_rows_of_many_are_evenly_spread() -> None:
    rows = np.arange(10, 21)
    assert evenly(rows, 11) is rows
    assert_array_equal(evenly(rows, 3), [10, 15, 20])
    assert len(evenly(rows, 0)) == 0


def test_what_a_dataset_holds_is_told_of_portions(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rewrite(folder / "detections.parquet", lambda table: table.take(pa.array([3, 0, 4, 1, 2])))
    whole = summarize_dataset(read_dataset(folder))
    monkeypatch.setattr(portions, "ROWS", 2)
    dataset, of_folder = portions.read_dataset_in_portions(folder)
    parts = list(of_folder)
    assert [len(part) for part in parts] == [2, 2, 1]
    assert summarize_portions(dataset, parts) == whole
    told = CliRunner().invoke(app, ["info", str(folder), "--json"])
    assert json.loads(told.stdout) == whole
    rewrite(folder / "detections.parquet", with_value("image_id", 4, 99))
    for read in (lambda: read_dataset(folder), lambda: list(portions.read_dataset_in_portions(folder)[1])):
        with pytest.raises(InputError, match="detections.parquet, row with detection_id .*: image_id: expected an id"):
            read()


# Refusals.

PINHOLE_PARAMS = [[500.0, 500.0, 320.0, 240.0], [600.0, 600.0, 400.0, 300.0, 0.0, 0.0, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("table", "change", "message", "hint"),
    [
        (
            "cameras",
            with_value("model", 1, "PINHOLLE"),
            r"cameras\.parquet, row with camera_id 2: model: found 'PINHOLLE'$",
            "SIMPLE_PINHOLE, PINHOLE",
        ),
        ("cameras", with_value("model", 0, "INVALID"), r"camera_id 1: model: found 'INVALID'$", "COLMAP"),
        (
            "cameras",
            with_value("height", 1, 0),
            r"row with camera_id 2: width and height: expected pixels above 0, found 800 x 0$",
            "size of the pictures",
        ),
        (
            "cameras",
            with_column("params", [PINHOLE_PARAMS[0][:3], PINHOLE_PARAMS[1]]),
            r"row with camera_id 1: params: PINHOLE expects 4 finite numbers \(fx, fy, cx, cy\), found \[500",
            "COLMAP's order",
        ),
        (
            "cameras",
            with_column("params", [PINHOLE_PARAMS[0], [*PINHOLE_PARAMS[1][:7], None]]),
            r"row with camera_id 2: params: OPENCV expects 8 finite numbers",
            "COLMAP's order",
        ),
        (
            "cameras",
            with_column("params", [[*PINHOLE_PARAMS[0][:1], -500.0, *PINHOLE_PARAMS[0][2:]], PINHOLE_PARAMS[1]]),
            r"row with camera_id 1: params: expected focal lengths above 0, found \[500\.0, -500\.0",
            "COLMAP's order",
        ),
        (
            "cameras",
            with_column("readout_s", [None, 30.0]),
            r"row with camera_id 2: readout_s: expected at most 1 s, or no value, found 30\.0 \(1 rows\)$",
            "30 ms are 0.03",
        ),
        (
            "images",
            with_value("camera_id", 2, 9),
            r"images\.parquet, row with image_id 30: camera_id: expected an id that is in cameras\.parquet, found 9",
            "add it to cameras.parquet",
        ),
        (
            "images",
            with_value("tz", 1, 1e200),
            r"images\.parquet, row with image_id 20: tz: expected at most 1e\+12 m, found 1e\+200",
            "repair",
        ),
        (
            "images",
            with_value("qw", 1, 2.0),
            r"images\.parquet, row with image_id 20: qw qx qy qz: expected a quaternion of length 1, found length 2",
            "w, x, y, z",
        ),
        (
            "images",
            with_value("qw", 1, 1e200),
            r"row with image_id 20: qw qx qy qz: expected a quaternion of length 1, found length inf",
            "w, x, y, z",
        ),
        (
            "images",
            lambda t: with_value("qw", 1, 0.0)(with_value("qx", 1, 0.0)(t)),
            r"row with image_id 20: qw qx qy qz: expected a quaternion of length 1, found length 0 ",
            "w, x, y, z",
        ),
        (
            "images",
            with_column("position_sigma_m", [0.1, 0.1, 0.0, 0.1]),
            r"row with image_id 30: position_sigma_m: expected above 0, or no value, found 0\.0 \(1 rows\)$",
            "repair",
        ),
        (
            "images",
            with_column("rotation_sigma_rad", [None, -0.1, 0.1, 0.1]),
            r"row with image_id 20: rotation_sigma_rad: expected above 0, or no value, found -0\.1",
            "repair",
        ),
        (
            "images",
            with_value("tx", 1, np.nan),
            r"images\.parquet row 1: tx: expected a finite number, found nan",
            "",
        ),
        (
            "detections",
            with_value("image_id", 3, 99),
            r"detections\.parquet, row with detection_id 103: image_id: expected an id that is in images\.parquet, "
            r"found 99 \(1 rows\)$",
            "add it to images.parquet",
        ),
        (
            "detections",
            with_value("width", 1, -1.0),
            r"row with detection_id 101: width: expected at least 0 px, found -1\.0",
            "repair",
        ),
        (
            "detections",
            with_value("x", 0, 650.1),
            r"row with detection_id 100: x: expected a centre inside its picture or within a box of it, found 650\.1",
            "pixels",
        ),
        (
            "detections",
            with_value("y", 4, -20.1),
            r"row with detection_id 104: y: expected a centre inside its picture or within a box of it, found -20\.1",
            "pixels",
        ),
        (
            "detections",
            with_column("range_m", [None, 5.0, 0.0, -1.0, 5.0]),
            r"row with detection_id 102: range_m: expected above 0, or no value, found 0\.0 \(2 rows\)$",
            "repair",
        ),
        (
            "images",
            lambda t: t.slice(0, 0),
            r"images\.parquet: the table is empty$",
            "at least one row",
        ),
        (
            "truth_detections",
            with_value("object_id", 0, 70),
            r"truth_detections\.parquet, row with detection_id 100: object_id: expected an id that is in "
            r"truth\.parquet, found 70",
            "add it to truth.parquet",
        ),
        (
            "truth_detections",
            with_value("detection_id", 4, 999),
            r"truth_detections\.parquet, row with detection_id 999: detection_id: expected an id that is in "
            r"detections\.parquet",
            "add it to detections.parquet",
        ),
    ],
)
def test_an_inconsistent_dataset_is_refused(folder: Path, table: str, change: Any, message: str, hint: str) -> None:
    rewrite(folder / f"{table}.parquet", change)
    with pytest.raises(InputError, match=message) as refusal:
        read_dataset(folder)
    assert str(refusal.value).startswith(f"{folder}/{table}.parquet")
    assert "\n" not in str(refusal.value)
    assert hint in refusal.value.hint


@pytest.mark.parametrize("name", ["cameras", "images", "detections"])
def test_a_missing_or_truncated_table_is_refused(folder: Path, name: str) -> None:
    path = folder / f"{name}.parquet"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=rf"{name}\.parquet: cannot be read as Parquet"):
        read_dataset(folder)
    path.unlink()
    with pytest.raises(InputError, match=rf"{name}\.parquet: no such file"):
        read_dataset(folder)


def test_truth_detections_without_truth_are_refused(folder: Path) -> None:
    (folder / "truth.parquet").unlink()
    with pytest.raises(InputError, match=r"truth_detections\.parquet without truth\.parquet"):
        read_dataset(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"dataset\.json: cannot be read as JSON"),
        ('"\udcff"', r"dataset\.json: cannot be read as JSON"),
        ("[]", r"dataset\.json: format_version: expected 1, found \[\]"),
        ('{"format_version": 99}', r"dataset\.json: format_version: expected 1, found 99"),
        ('{"format_version": 1}', r"dataset\.json: frame: expected .* found null"),
    ],
)
def test_a_wrong_dataset_json_is_refused(folder: Path, text: str, message: str) -> None:
    (folder / "dataset.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=message):
        read_dataset(folder)


@pytest.mark.parametrize(
    "frame",
    [
        None,
        "local",
        [],
        {},
        {"local": True},
        {"local": False, "up": [0, 0, 1]},
        {"local": True, "up": [0, 0]},
        {"local": True, "up": [0, 0, 0]},
        {"local": True, "up": [0, 0, float("nan")]},
        {"local": True, "up": "abc"},
        {"anchor": [51.5, -0.1, 0]},
        {"anchor": {"lat": 51.5, "lon": -0.1}},
        {"anchor": {"lat": 91, "lon": 0, "height": 0}},
        {"anchor": {"lat": 0, "lon": 0, "height": float("inf")}},
    ],
)
def test_a_wrong_frame_is_refused(frame: Any) -> None:
    with pytest.raises(InputError, match=r"^f: frame: expected .* found ") as refusal:
        Frame.from_json(frame, source="f")
    assert "WGS84" in refusal.value.hint


def test_up_is_made_a_unit_vector() -> None:
    assert Frame.from_json({"local": True, "up": [0, -2, 0]}, source="f").up == (0.0, -1.0, 0.0)


def test_a_folder_that_is_no_dataset_is_refused(tmp_path: Path) -> None:
    for path, why in (
        (tmp_path, r"there is no dataset\.json in it"),
        (tmp_path / "absent", "there is no such folder"),
    ):
        with pytest.raises(InputError, match=f"is not a dataset: {why}$"):
            read_dataset(path)


# Writing.


def test_a_wrong_dataset_is_not_written(tmp_path: Path) -> None:
    dataset = small_dataset()
    wrong = Dataset(**{**vars(dataset), "detections": dataset.detections.replace(image_id=np.full(5, 99))})
    with pytest.raises(InputError, match="image_id: expected an id that is in images"):
        write_dataset(wrong, tmp_path / "city")
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_replaces_a_dataset_and_nothing_else(folder: Path, tmp_path: Path) -> None:
    smaller = Dataset(**{**vars(small_dataset()), "truth": None, "truth_detections": None})
    write_dataset(smaller, folder)
    assert read_dataset(folder).truth is None
    (folder / "thesis.txt").write_text("years of work")
    write_dataset(small_dataset(), folder)
    assert (folder / "thesis.txt").read_text() == "years of work"
    rewrite(folder / "truth.parquet", with_value("x", 0, 4.5))
    with pytest.raises(OutputError, match="truth.parquet: is not ours to replace"):
        write_dataset(smaller, folder)
    write_dataset(smaller, folder, force=True)
    assert read_dataset(folder).truth is None


def test_pictures_that_were_drawn_for_a_dataset_go_with_it(folder: Path) -> None:
    for name in ("drawn.jpg", "pass-1/drawn.jpg"):
        with new_file(folder / "images" / name) as path:
            path.write_text("ours")
        (folder / "images" / name).with_name("mine.jpg").write_text("mine")
    write_dataset(small_dataset(), folder)
    assert sorted(p.name for p in (folder / "images").rglob("*.jpg")) == ["mine.jpg", "mine.jpg"]


def test_many_texts_are_written_as_codes(folder: Path) -> None:
    field = pq.read_schema(folder / "detections.parquet").field("class")
    assert pa.types.is_dictionary(field.type)
    assert Categories.from_texts(["light", "sign"]).names == read_dataset(folder).detections.class_name.names
