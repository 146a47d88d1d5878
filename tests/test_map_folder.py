"""A map on disk: geo-referenced or not, empty or not, it is read back as it was written."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas
import numpy as np
import pytest

from small_dataset import ANCHOR, map_of, rewrite, with_value
from valuemap.dataset import Frame
from valuemap.errors import InputError
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import Map, read_map, write_map
from valuemap.tables.table import table_to_arrow

POSITIONS = np.array([[1.0, 2.0, 3.0], [1000.0, -500.0, 6.0]])
ON_EARTH = Frame(anchor=ANCHOR)
RUN = {"dataset": "city", "settings": {"min_parallax_deg": 2.0}, "counts": {"labels": 2}}
MAPS = [
    map_of(POSITIONS, ["light", "sign"], residual_px=[1.0, 0.5], run=RUN),
    map_of(POSITIONS, frame=Frame(up=(0.0, -1.0, 0.0)), run=RUN),
    map_of(POSITIONS, frame=ON_EARTH, lon_lat_height=lon_lat_height_from_enu(POSITIONS, ANCHOR), run=RUN),
    map_of([], run=RUN),
    map_of([], frame=ON_EARTH, lon_lat_height=np.empty((0, 3)), run=RUN),
]


@pytest.mark.parametrize("result", MAPS, ids=["local", "another up", "on Earth", "empty", "empty on Earth"])
def test_a_map_survives_writing_and_reading(result: Map, tmp_path: Path) -> None:
    write_map(result, tmp_path / "map")
    again = read_map(tmp_path / "map")
    assert (again.frame, again.run) == (result.frame, result.run)
    assert table_to_arrow(again.labels).equals(table_to_arrow(result.labels))
    assert table_to_arrow(again.votes).equals(table_to_arrow(result.votes))
    write_map(again, tmp_path / "again")
    for name in ("run.json", "labels.parquet", "votes.parquet"):
        assert (tmp_path / "map" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_a_map_says_how_it_was_made() -> None:
    settings = {"method": "paper", "min_votes": 4, "max_range_m": None}
    result = map_of([], run={"settings": settings})
    assert (result.method, result.setting("min_votes", 3.0)) == ("paper", 4.0)
    assert [result.setting(name, 60.0) for name in ("max_range_m", "min_range_m", "method")] == [60.0] * 3
    assert map_of([], run={"dataset": "city"}).method == "?"


def test_the_labels_of_a_map_on_earth_are_a_layer(tmp_path: Path) -> None:
    write_map(MAPS[2], tmp_path / "map")
    layer = geopandas.read_parquet(tmp_path / "map" / "labels.parquet")
    assert layer.crs == "EPSG:4979"
    assert (layer.geometry.x.round(1) == -0.1).all()


def test_further_files_are_linked_or_copied_where_there_are_no_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "images").write_bytes(b"long")
    files = {"dataset/images.parquet": tmp_path / "images"}
    (tmp_path / "0_0.arrow").write_bytes(b"labels")
    cells = [tmp_path / "0_0.arrow"]
    write_map(MAPS[0], tmp_path / "linked", cells=cells, files=files)
    assert (tmp_path / "linked" / "dataset" / "images.parquet").samefile(tmp_path / "images")
    assert (tmp_path / "linked" / "cells" / "0_0.arrow").samefile(cells[0])

    def no_links(*_: object) -> None:
        raise OSError

    monkeypatch.setattr("os.link", no_links)
    write_map(MAPS[0], tmp_path / "copied", cells=cells, files=files)
    assert (tmp_path / "copied" / "cells" / "0_0.arrow").read_bytes() == b"labels"
    copied = tmp_path / "copied" / "dataset" / "images.parquet"
    assert copied.read_bytes() == b"long"
    assert not copied.samefile(tmp_path / "images")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"is not a map: there is no run\.json in it$"),
        ("{", r"run\.json: cannot be read as JSON"),
        ("[]", r"run\.json: expected a JSON object, found list$"),
        ("{}", r"run\.json: frame: expected .* found null$"),
    ],
)
def test_a_wrong_record_is_refused(text: str | None, message: str, tmp_path: Path) -> None:
    write_map(MAPS[0], tmp_path / "map")
    (tmp_path / "map" / "run.json").unlink()
    if text is not None:
        (tmp_path / "map" / "run.json").write_text(text)
    with pytest.raises(InputError, match=message):
        read_map(tmp_path / "map")


def test_damaged_labels_are_refused(tmp_path: Path) -> None:
    write_map(MAPS[0], tmp_path / "map")
    rewrite(tmp_path / "map" / "labels.parquet", with_value("x", 1, np.nan))
    with pytest.raises(InputError, match=r"labels\.parquet row 1: x: expected a finite number, found nan"):
        read_map(tmp_path / "map")


def test_labels_may_be_removed_from_the_table(tmp_path: Path) -> None:
    write_map(MAPS[0], tmp_path / "map")
    rewrite(tmp_path / "map" / "labels.parquet", lambda table: table.slice(1))
    left = read_map(tmp_path / "map")
    np.testing.assert_array_equal(left.labels.label_id, MAPS[0].labels.label_id[1:])
    kept = MAPS[0].votes.label_id != MAPS[0].labels.label_id[0]
    np.testing.assert_array_equal(left.votes.detection_id, MAPS[0].votes.detection_id[kept])


def test_the_frame_is_part_of_the_record(tmp_path: Path) -> None:
    write_map(MAPS[2], tmp_path / "map")
    lat, lon, height = ANCHOR
    record = json.loads((tmp_path / "map" / "run.json").read_text())
    assert record["frame"] == {"anchor": {"lat": lat, "lon": lon, "height": height}}
    assert {name: record[name] for name in RUN} == RUN
