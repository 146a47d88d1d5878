"""Exports: read back by other software with the same numbers, whole or not at all."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from xml.etree import ElementTree

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pyogrio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from small_dataset import ANCHOR, map_of, small_dataset, votes_of_two_labels
from valuemap.dataset import Frame, write_dataset
from valuemap.errors import InputError, OutputError
from valuemap.folders import new_file
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import Map, write_map
from valuemap.tables import Categories, Labels
from valuemap.tables.read import read_table
from valuemap.tables.table import table_to_arrow
from valuemap.writers import SUFFIXES, export_map

POSITIONS = np.array([[1.0 / 3.0, -2.0, 5.25], [100.123456789012, 0.1, 4.0]])
CLASSES = ["traffic light", 'sign "30", round']
COLUMNS = ["label_id", "class", "x", "y", "z", "votes", "passes"]


def local_map() -> Map:
    return map_of(POSITIONS, CLASSES)


def geographic_map() -> Map:
    places = lon_lat_height_from_enu(POSITIONS, ANCHOR)
    return map_of(POSITIONS, CLASSES, frame=Frame(anchor=ANCHOR), lon_lat_height=places)


def empty_geographic_map() -> Map:
    return map_of([], frame=Frame(anchor=ANCHOR), lon_lat_height=np.empty((0, 3)))


def rows_of_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_csv_holds_every_number_with_all_its_digits(tmp_path: Path) -> None:
    export_map(local_map(), tmp_path / "map.csv")
    rows = rows_of_csv(tmp_path / "map.csv")
    assert {*COLUMNS} <= {*rows[0]}
    assert "lon" not in rows[0]
    assert [row["class"] for row in rows] == CLASSES
    assert_array_equal([[float(row[name]) for name in "xyz"] for row in rows], POSITIONS)
    assert [row["votes"] for row in rows] == ["5", "5"]
    assert float(rows[0]["covariance_xx"]) == 0.04


def test_csv_leaves_unknown_values_empty(tmp_path: Path) -> None:
    export_map(local_map(), tmp_path / "map.csv")
    assert [row["first_seen"] for row in rows_of_csv(tmp_path / "map.csv")] == ["", ""]


def test_csv_has_longitude_latitude_and_height_where_there_are_any(tmp_path: Path) -> None:
    export_map(geographic_map(), tmp_path / "map.csv")
    found = [[float(row[name]) for name in ("lon", "lat", "height")] for row in rows_of_csv(tmp_path / "map.csv")]
    assert_array_equal(found, lon_lat_height_from_enu(POSITIONS, ANCHOR))


def test_geojson_is_longitude_latitude_height_in_that_order(tmp_path: Path) -> None:
    export_map(geographic_map(), tmp_path / "map.geojson")
    collection = json.loads((tmp_path / "map.geojson").read_text(encoding="utf-8"))
    assert collection["type"] == "FeatureCollection"
    assert "crs" not in collection  # RFC 7946, section 4: always WGS84.
    first, second = collection["features"]
    assert first["geometry"]["type"] == "Point"
    lon, lat, height = first["geometry"]["coordinates"]
    assert (round(lon, 2), round(lat, 2), round(height, 2)) == (-0.14, 51.5, 40.25)
    places = [first["geometry"]["coordinates"], second["geometry"]["coordinates"]]
    assert_allclose(places, lon_lat_height_from_enu(POSITIONS, ANCHOR), rtol=0, atol=6e-10)
    assert {*COLUMNS} <= {*first["properties"]}
    assert second["properties"]["class"] == CLASSES[1]
    assert first["properties"]["first_seen"] is None
    assert first["properties"]["x"] == POSITIONS[0, 0]


def test_geojson_opens_with_gdal(tmp_path: Path) -> None:
    export_map(geographic_map(), tmp_path / "map.geojson")
    frame = geopandas.read_file(tmp_path / "map.geojson")
    assert frame.geometry.has_z.all()
    assert frame["label_id"].tolist() == [0, 1]


def test_geojson_needs_a_geo_reference(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the map is not geo-referenced") as refusal:
        export_map(local_map(), tmp_path / "map.geojson")
    assert ".csv, .parquet or .gpkg" in refusal.value.hint
    assert list(tmp_path.iterdir()) == []


def test_parquet_is_the_table_of_labels(tmp_path: Path) -> None:
    export_map(local_map(), tmp_path / "map.parquet")
    again = read_table(Labels, tmp_path / "map.parquet")
    assert table_to_arrow(again).equals(table_to_arrow(local_map().labels))
    assert "geo" not in (pq.read_schema(tmp_path / "map.parquet").metadata or {})


def test_parquet_is_geoparquet_where_geo_referenced(tmp_path: Path) -> None:
    export_map(geographic_map(), tmp_path / "map.parquet")
    frame = geopandas.read_parquet(tmp_path / "map.parquet")
    assert frame.crs == "EPSG:4979"
    places = np.column_stack([frame.geometry.x, frame.geometry.y, frame.geometry.z])
    assert_array_equal(places, lon_lat_height_from_enu(POSITIONS, ANCHOR))
    again = read_table(Labels, tmp_path / "map.parquet")
    assert table_to_arrow(again).equals(table_to_arrow(geographic_map().labels))


EVERY_FILE = [f"map{suffix}" for suffix in SUFFIXES if suffix != ".rrd"]  # Tested by itself: it needs an extra.


def rows_in(path: Path) -> int:
    if path.suffix == ".csv":
        return len(rows_of_csv(path))
    if path.suffix == ".parquet":
        return len(read_table(Labels, path))
    if path.suffix in (".osm", ".xodr", ".kml"):
        tag = {".kml": "{http://www.opengis.net/kml/2.2}Placemark", ".xodr": "signal"}.get(path.suffix, "node")
        return sum(1 for _ in ElementTree.parse(path).iter(tag))
    if path.suffix == ".geojsonl":
        return path.read_text(encoding="utf-8").count("\n")
    return len(pyogrio.read_dataframe(path, layer="labels"))


@pytest.mark.parametrize("name", EVERY_FILE)
def test_a_map_without_labels_is_a_file_without_rows(name: str, tmp_path: Path) -> None:
    export_map(empty_geographic_map(), tmp_path / name)
    assert rows_in(tmp_path / name) == 0


@pytest.mark.parametrize("name", EVERY_FILE)
def test_every_label_is_in_every_format(name: str, tmp_path: Path) -> None:
    export_map(geographic_map(), tmp_path / name)
    assert rows_in(tmp_path / name) == (4 if "lanelet2" in name else 2)


@pytest.mark.parametrize("name", EVERY_FILE)
def test_labels_that_are_gone_are_only_in_formats_that_say_so(name: str, tmp_path: Path) -> None:
    result = geographic_map()
    states = Categories.from_texts(["gone", "confirmed"])
    result = dataclasses.replace(result, labels=result.labels.replace(state=states))
    notes: list[str] = []
    written = export_map(result, tmp_path / name, tell=notes.append)
    has_no_state = name.endswith((".osm", ".xodr", ".geojsonl"))
    assert written == (1 if has_no_state else 2)
    assert rows_in(tmp_path / name) == (2 if "lanelet2" in name else written)
    assert [note.split(" of ")[0] for note in notes] == (
        ["labels that are gone (column state): 1 left out"] if has_no_state else []
    )
    if not has_no_state:
        assert b"gone" in (tmp_path / name).read_bytes()


def test_a_map_takes_labels_with_their_votes() -> None:
    kept = dataclasses.replace(local_map(), votes=votes_of_two_labels()).take(np.array([False, True]))
    assert kept.labels.label_id.tolist() == [1]
    assert kept.votes.detection_id.tolist() == [103]


@pytest.mark.parametrize("name", EVERY_FILE)
def test_the_same_map_gives_the_same_bytes(name: str, tmp_path: Path) -> None:
    dataset = small_dataset(Frame(anchor=ANCHOR))
    for folder in ("a", "b"):
        export_map(geographic_map(), tmp_path / folder / name, dataset=dataset)
    assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_suffix_may_be_in_capitals_and_a_file_is_replaced(tmp_path: Path) -> None:
    export_map(map_of([[0.0, 0.0, 0.0]]), tmp_path / "MAP.CSV")
    export_map(local_map(), tmp_path / "MAP.CSV")
    assert len(rows_of_csv(tmp_path / "MAP.CSV")) == 2


def test_a_format_may_be_named(tmp_path: Path) -> None:
    export_map(geographic_map(), tmp_path / "map.osm", format_name="lanelet2")
    assert rows_in(tmp_path / "map.osm") == 4
    with pytest.raises(OutputError, match="there is no such format"):
        export_map(geographic_map(), tmp_path / "map.osm", format_name="shp")


def test_a_file_of_somebody_else_is_replaced_by_force_only(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("mine")
    with pytest.raises(OutputError, match="is not ours to replace"):
        export_map(local_map(), tmp_path / "map.csv")
    assert (tmp_path / "map.csv").read_text() == "mine"
    export_map(local_map(), tmp_path / "map.csv", force=True)
    assert len(rows_of_csv(tmp_path / "map.csv")) == 2


@pytest.mark.parametrize("force", [False, True])
def test_files_of_datasets_and_maps_are_not_written_over(tmp_path: Path, force: bool) -> None:
    write_dataset(small_dataset(), tmp_path / "data")
    write_map(local_map(), tmp_path / "map")
    with new_file(tmp_path / "map" / "review.json") as fresh:
        fresh.write_text("{}")
    (tmp_path / "map" / "cells").mkdir()
    with new_file(tmp_path / "map" / "cells" / "cell.arrow") as fresh:
        fresh.write_text("solved")
    before = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()}
    for kind, names in (
        ("dataset", ("images.parquet", "truth.parquet", "dataset.json", "rejected.parquet")),
        ("map", ("labels.parquet", "run.json", "review.json", "cells/cell.arrow")),
    ):
        for name in names:
            path = tmp_path / {"dataset": "data", "map": "map"}[kind] / name
            with pytest.raises(OutputError, match=f"{name}: is a file of a {kind}, which would be lost") as refusal:
                export_map(local_map(), path, format_name="parquet", force=force)
            assert refusal.value.hint == "name another file"
    assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()} == before
    for _ in range(2):  # What is not a file of the map may be beside them.
        export_map(local_map(), tmp_path / "map" / "export.parquet")


@pytest.mark.parametrize(
    ("name", "found"), [("map.shp", r"\.shp"), ("map", "without a suffix"), ("map.csv.gz", r"\.gz")]
)
def test_an_unknown_format_is_refused(name: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=found) as refusal:
        export_map(local_map(), tmp_path / name)
    assert refusal.value.hint.startswith("name a file that ends in .csv, .geojson, .parquet, .gpkg,")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("url", ["s3://bucket/map.csv", "http://me:secret@host/map.csv", "file:///map.csv"])
@pytest.mark.parametrize("format_name", [None, "csv", "colmap"])
def test_a_url_that_no_writer_takes_is_refused(
    url: str, format_name: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scheme = url.partition(":")[0]
    told = "expected a file, or the URL of a database, which begins with postgresql:// or postgres://"
    with pytest.raises(OutputError, match=f"^{scheme}://: {told}$"):
        export_map(local_map(), url, format_name=format_name)
    with pytest.raises(OutputError, match="a database takes no --format"):
        export_map(local_map(), "postgresql://host/maps", format_name="csv")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format_name", [None, "csv", "colmap"])
def test_standard_output_is_no_file(format_name: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="does not write to standard output") as refusal:
        export_map(local_map(), "-", format_name=format_name)
    assert refusal.value.hint == "give the name of a file, whose suffix says the format"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", EVERY_FILE)
def test_a_place_that_cannot_be_written_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot be written"):
        export_map(geographic_map(), tmp_path / "file" / name)
    (tmp_path / name).mkdir()
    with pytest.raises(OutputError, match="is a folder, a file is to be written there"):
        export_map(geographic_map(), tmp_path / name)
