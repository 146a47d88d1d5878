"""The typed tables: what passes the door, in which order, and what every refusal says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from small_dataset import small_dataset, with_column, with_value
from valuemap.arrays import rows_in_runs
from valuemap.arrow import in_one, numbers_from_arrow, take_texts, texts_to_arrow
from valuemap.errors import InputError
from valuemap.tables import (
    Cameras,
    Categories,
    Detections,
    GeographicTruth,
    Images,
    Labels,
    Truth,
    TruthDetections,
    TruthPoints,
    Votes,
)
from valuemap.tables.covariance import covariance_columns, covariance_matrices
from valuemap.tables.read import read_table, table_from_arrow
from valuemap.tables.table import table_to_arrow
from valuemap.tables.write import write_table


def images() -> pa.Table:
    return table_to_arrow(small_dataset().images)


def test_covariances_are_columns_of_a_table_and_matrices() -> None:
    columns = np.array([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [7.0, 0.0, 0.0, 8.0, 0.0, 9.0]])
    matrices = covariance_matrices(columns)
    assert_array_equal(matrices[0], [[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])
    assert_array_equal(matrices[1], np.diag([7.0, 8.0, 9.0]))
    assert_array_equal(covariance_matrices((1.0, 2.0, 3.0, 4.0, 5.0, 6.0)), matrices[0])
    assert_array_equal(covariance_columns(matrices), columns)
    assert covariance_matrices(np.empty((0, 6))).shape == (0, 3, 3)


def test_rows_come_in_the_order_of_their_keys() -> None:
    images = small_dataset().images
    assert images.by_key() is images
    assert_same_table(images.take(np.arange(len(images))[::-1]).by_key(), images)


def assert_same_table(first: Any, second: Any) -> None:
    assert table_to_arrow(first).equals(table_to_arrow(second))


# Categories.


@given(st.lists(st.sampled_from(["b", "a", "ä", "", "traffic light"])), st.randoms(use_true_random=False))
def test_equal_texts_get_equal_codes_whatever_their_order(texts: list[str], random: Any) -> None:
    shuffled = list(texts)
    random.shuffle(shuffled)
    categories, other = Categories.from_texts(texts), Categories.from_texts(shuffled)
    assert categories.texts() == texts
    assert categories.names == other.names == tuple(sorted(set(texts)))


def test_categories_from_every_kind_of_arrow_column() -> None:
    plain = ["b", "a", "b"]
    expected = Categories.from_texts(plain)
    chunks = pa.chunked_array([["b"], ["a", "b"]])
    for column in (pa.array(plain), chunks, chunks.dictionary_encode(), pa.array(plain).dictionary_encode()):
        found = Categories.from_texts(column)
        assert found.names == expected.names
        assert_array_equal(found.codes, expected.codes)


def test_texts_of_a_dictionary_that_no_row_has_do_not_count() -> None:
    column = pa.DictionaryArray.from_arrays(pa.array([1, 2]), pa.array(["unused", "b", "a"]))
    table = table_from_arrow(Images, with_column("pass_id", pa.array(["p"] * 4))(images()), source="s")
    assert table.pass_id.names == ("p",)
    truth = pa.table({"object_id": [1, 2], "class": column, "x": [0.0, 1], "y": [0.0, 1], "z": [0.0, 1]})
    assert table_from_arrow(Truth, truth, source="s").class_name.names == ("a", "b")


def test_a_column_in_one_piece_is_not_copied() -> None:
    column = pa.chunked_array([pa.array([1.0, 2.0])])
    assert in_one(column).buffers()[1].address == column.chunk(0).buffers()[1].address
    assert in_one(pa.chunked_array([["a"], ["b"]])).to_pylist() == ["a", "b"]
    assert in_one(pa.chunked_array([], pa.string())).to_pylist() == []


def test_code_of_a_name() -> None:
    categories = Categories.from_texts(["b", "a"])
    assert [categories.code_of(name) for name in ("a", "b", "c")] == [0, 1, -1]


# Reading.


def test_every_table_survives_writing_and_reading(tmp_path: Path) -> None:
    dataset = small_dataset()
    tables = [dataset.cameras, dataset.images, dataset.detections, dataset.truth, dataset.truth_detections]
    for table in tables:
        assert table is not None
        write_table(table, tmp_path / "t.parquet")
        assert_same_table(read_table(type(table), tmp_path / "t.parquet"), table)


def test_the_same_table_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.parquet", "b.parquet"):
        write_table(small_dataset().detections, tmp_path / name)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


@given(st.permutations(range(4)))
def test_the_order_of_rows_does_not_matter(order: list[int]) -> None:
    shuffled = table_from_arrow(Images, images().take(pa.array(order)), source="s")
    assert_same_table(shuffled, small_dataset().images)


def test_lists_and_texts_are_sorted_along() -> None:
    cameras = table_to_arrow(small_dataset().cameras).take(pa.array([1, 0]))
    assert_same_table(table_from_arrow(Cameras, cameras, source="s"), small_dataset().cameras)


def test_a_slice_copies_no_numbers() -> None:
    for table in (small_dataset().images, small_dataset().detections, small_dataset().cameras):
        for rows in (slice(1, None), slice(0, 1), slice(2, 2), slice(None, None, 2)):
            assert_same_table(table[rows], table.take(np.arange(len(table))[rows]))
    detections = small_dataset().detections
    assert np.shares_memory(detections[1:].center_px, detections.center_px)


def test_rows_can_be_taken_by_index_and_by_mask() -> None:
    for table in (small_dataset().images, small_dataset().cameras):
        by_index = table.take(np.array([1]))
        assert len(by_index) == 1
        assert_same_table(by_index, table.take(np.arange(len(table)) == 1))


def test_runs_of_rows_follow_each_other() -> None:
    assert rows_in_runs(np.array([5, 0, 9]), np.array([2, 0, 3])).tolist() == [5, 6, 9, 10, 11]
    assert rows_in_runs(0, np.array([3, 0, 1, 2])).tolist() == [0, 1, 2, 0, 0, 1]
    assert not len(rows_in_runs(np.empty(0, np.int64), np.empty(0, np.int64)))


def test_optional_columns_are_none_where_they_are_not() -> None:
    table = table_from_arrow(Images, images().drop_columns(["timestamp"]), source="s")
    assert table.timestamp_s is None
    assert "timestamp" not in table_to_arrow(table).column_names


def test_a_missing_value_of_a_nullable_column_is_nan_and_null_again() -> None:
    table = table_from_arrow(Images, images(), source="s")
    assert table.timestamp_s is not None
    assert_array_equal(np.isnan(table.timestamp_s), [False, False, False, True])
    assert table_to_arrow(table).column("timestamp").null_count == 1


def test_columns_that_nobody_asked_for_are_ignored() -> None:
    extended = images().append_column("weather", pa.array(["sun"] * 4))
    assert_same_table(table_from_arrow(Images, extended, source="s"), small_dataset().images)


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("image_id", pa.array([10, 20, 30, 40], pa.uint8())),
        ("tx", pa.array([0, 1, 2, 3], pa.int32())),
        ("tx", pa.array([0, 1, 2, 3], pa.float32())),
        ("name", pa.array(["a", "b", "c", "d"], pa.large_string())),
        ("name", pa.array(["a", "b", "c", "d"]).dictionary_encode()),
        ("timestamp", pa.nulls(4)),
    ],
)
def test_types_that_mean_the_same_are_read(column: str, values: pa.Array) -> None:
    found = table_to_arrow(table_from_arrow(Images, with_column(column, values)(images()), source="s"))
    assert found.column(column).to_pylist() == values.to_pylist()


@pytest.mark.parametrize("kind", [TruthDetections, Labels, Votes])
def test_some_tables_may_be_empty(kind: Any, tmp_path: Path) -> None:
    schema = {
        TruthDetections: {"detection_id": pa.int64(), "object_id": pa.int64()},
        Labels: {
            **dict.fromkeys(("label_id", "votes", "passes"), pa.int64()),
            "class": pa.string(),
            **dict.fromkeys(("x", "y", "z", "object_width_m", "object_height_m"), pa.float64()),
            **{f"covariance_{axes}": pa.float64() for axes in ("xx", "xy", "xz", "yy", "yz", "zz")},
            **dict.fromkeys(("reprojection_rms_px", "max_parallax_rad", "first_seen", "last_seen"), pa.float64()),
            **dict.fromkeys(("facing_azimuth_rad", "facing_concentration"), pa.float64()),
        },
        Votes: {
            **dict.fromkeys(("label_id", "detection_id", "image_id"), pa.int64()),
            **dict.fromkeys(("residual_px", "residual_sigmas"), pa.float64()),
        },
    }[kind]
    pq.write_table(pa.schema(schema).empty_table(), tmp_path / "t.parquet")
    table = read_table(kind, tmp_path / "t.parquet")
    assert len(table) == 0
    write_table(table, tmp_path / "t.parquet")
    assert_same_table(read_table(kind, tmp_path / "t.parquet"), table)


def test_truth_of_the_user_needs_positions_only() -> None:
    points = table_from_arrow(TruthPoints, pa.table({"x": [1.0], "y": [2.0], "z": [3.0]}), source="s")
    assert points.class_name is None
    assert points.object_id is None
    places = table_from_arrow(GeographicTruth, pa.table({"lon": [1.0], "lat": [2.0]}), source="s")
    assert places.height_m is None


# Refusals: file, row or column, what was expected, what was found, and what to do.


@pytest.mark.parametrize(
    ("change", "message", "hint"),
    [
        (
            lambda t: t.drop_columns(["qw"]),
            r"^s: column 'qw' is missing; found image_id, name",
            "add the column 'qw'",
        ),
        (lambda t: t.drop_columns(["camera_id"]), r"^s: column 'camera_id' is missing", "whole numbers"),
        (lambda t: t.slice(0, 0), r"^s: the table is empty$", "at least one row"),
        (
            with_column("tx", ["a", "b", "c", "d"]),
            r"^s: column 'tx': expected numbers, found string$",
            "another type",
        ),
        (
            with_column("image_id", [1.0, 2.0, 3.0, 4.0]),
            r"^s: column 'image_id': expected whole numbers, found double$",
            "another type",
        ),
        (
            with_column("name", [1, 2, 3, 4]),
            r"^s: column 'name': expected texts, found int64$",
            "another type",
        ),
        (
            with_column("timestamp", pa.array([0, 1, 2, 3], pa.timestamp("us"))),
            r"^s: column 'timestamp': expected numbers, found timestamp",
            "another type",
        ),
        (
            with_value("qx", 2, None),
            r"^s row 2: qx: expected a value, found none \(1 rows\)$",
            "fill the value in",
        ),
        (with_value("name", 1, None), r"^s row 1: name: expected a value, found none", "fill the value in"),
        (
            with_value("image_id", 3, None),
            r"^s row 3: image_id: expected a value, found none",
            "fill the value in",
        ),
        (
            with_column("pass_id", pa.DictionaryArray.from_arrays(pa.array([0, 1, 0, 0]), pa.array(["a", None]))),
            r"^s row 1: pass_id: expected a value, found none \(1 rows\)$",
            "fill the value in",
        ),
        (
            with_value("ty", 1, np.nan),
            r"^s row 1: ty: expected a finite number, found nan \(1 rows\)$",
            "repair",
        ),
        (with_value("tz", 0, np.inf), r"^s row 0: tz: expected a finite number, found inf", "repair"),
        (
            with_value("timestamp", 0, -np.inf),
            r"^s row 0: timestamp: expected a finite number, found -inf",
            "repair",
        ),
        (
            with_column("image_id", [5, 6, 7, 5]),
            r"^s row 3: image_id: expected unique ids, found 5 again \(1 repeated\)$",
            "an id of its own",
        ),
        (
            with_column("image_id", pa.array([1, 2, 3, 2**64 - 1], pa.uint64())),
            r"^s: column 'image_id': expected numbers that int64 can hold",
            "2^63",
        ),
        (
            with_column("timestamp", [1, 2, 3, 2**60 + 1]),
            r"^s: column 'timestamp': expected numbers that double can hold",
            "timestamps in seconds",
        ),
        (
            lambda t: t.append_column("tx", pa.array([0.0] * 4)),
            r"^s: column 'tx' is there twice$",
            "keep one",
        ),
    ],
)
def test_a_wrong_table_is_refused(change: Any, message: str, hint: str) -> None:
    with pytest.raises(InputError, match=message) as refusal:
        table_from_arrow(Images, change(images()), source="s")
    assert hint in refusal.value.hint


def test_params_must_be_lists_of_numbers() -> None:
    cameras = table_to_arrow(small_dataset().cameras)
    for wrong in (pa.array([500.0, 500.0]), pa.array([["a"], ["b"]])):
        with pytest.raises(InputError, match="column 'params': expected a list of numbers a row"):
            table_from_arrow(Cameras, with_column("params", wrong)(cameras), source="s")


def test_ids_and_numbers_are_encoded_by_what_they_have_in_common(tmp_path: Path) -> None:
    write_table(small_dataset().detections, tmp_path / "detections.parquet")
    group = pq.ParquetFile(tmp_path / "detections.parquet").metadata.row_group(0)
    columns = [group.column(number) for number in range(group.num_columns)]
    encodings = {column.path_in_schema: column.encodings for column in columns}
    assert "DELTA_BINARY_PACKED" in encodings["detection_id"]
    assert "BYTE_STREAM_SPLIT" in encodings["x"]
    assert any("DICTIONARY" in each for each in encodings["class"])
    assert {column.compression for column in columns} == {"SNAPPY"}


@pytest.mark.parametrize("kept", [0, 3, 200, -1])
def test_a_truncated_file_is_refused(kept: int, tmp_path: Path) -> None:
    path = tmp_path / "detections.parquet"
    write_table(small_dataset().detections, path)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"detections\.parquet: cannot be read as Parquet: [^\n]+$") as refusal:
        read_table(Detections, path)
    assert "damaged or cut short" in refusal.value.hint


def test_text_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "images.parquet"
    table = with_column("name", ["ZZZZ", "b", "c", "d"])(images())
    pq.write_table(table, path, compression="none", use_dictionary=False)
    path.write_bytes(path.read_bytes().replace(b"ZZZZ", b"\xff\xfe\xff\xfe"))
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        read_table(Images, path)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"images\.parquet: no such file$"):
        read_table(Images, tmp_path / "images.parquet")


@pytest.mark.parametrize("kind", [pa.string(), pa.large_string()])
def test_texts_are_taken_as_by_arrow(kind: pa.DataType) -> None:
    texts = pa.array(["cut off", "a", "", "häuser/1.jpg", "b" * 300, "", "z"], kind)[1:]
    for rows in ([], [0], [5, 1, 1, 3, 0, 2], list(range(6)), [4, 1]):
        taken = take_texts(texts, np.array(rows, np.int64))
        taken.validate(full=True)
        assert taken.to_pylist() == texts.take(pa.array(rows, pa.int64())).to_pylist()
    assert take_texts(texts_to_arrow(["", ""]), np.array([1, 0])).to_pylist() == ["", ""]


@pytest.mark.parametrize("kind", [pa.float64(), pa.float32(), pa.int64()])
def test_numbers_that_are_missing_are_nan(kind: pa.DataType) -> None:
    column = pa.array([9, None, *range(20), None, 5], kind)[1:]
    expected = [np.nan, *range(20), np.nan, 5]
    np.testing.assert_array_equal(numbers_from_arrow(column), expected)
    np.testing.assert_array_equal(numbers_from_arrow(pa.chunked_array([column[:3], column[3:]])), expected)
