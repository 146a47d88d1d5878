"""Exports for maps of roads, editors and viewers, read back by the software of their field."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sqlite3
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import geopandas
import numpy as np
import pyarrow as pa
import pycolmap
import pyogrio
import pytest
from numpy.testing import assert_allclose

from small_dataset import ANCHOR, map_of, small_dataset
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers
from valuemap.dataset import Frame
from valuemap.errors import InputError, OutputError
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.map_folder import Map
from valuemap.readers.colmap import read_colmap
from valuemap.tables import Categories, Votes
from valuemap.writers import export_map
from valuemap.writers.attributes import Export
from valuemap.writers.lanelet2 import lower_edges
from valuemap.writers.poses import write_poses

GEOREFERENCED = Frame(anchor=ANCHOR)
POSITIONS = np.array([[4.0, 25.0, 5.0], [12.0, 20.0, 2.0], [-30.0, 50.0, 3.0]])
CLASSES = ["traffic light", "regulatory--stop--g1", 'a <strange> & "new"\x01 class']


def a_map(frame: Frame = GEOREFERENCED, *, facing_deg: tuple[float, ...] = (180.0, 90.0, 0.0)) -> Map:
    """Return three labels; the first two are voted for by the detections of the small dataset."""
    places = lon_lat_height_from_enu(POSITIONS, ANCHOR) if frame.anchor is not None else None
    result = map_of(POSITIONS, CLASSES, frame=frame, lon_lat_height=places, run={"dataset": "small & co"})
    labels = result.labels.replace(
        facing_azimuth_rad=np.radians(facing_deg),
        existence=np.array([0.999, 0.8, 0.55]),
        last_seen_s=np.full(3, 1.7e9),
        first_seen_s=np.full(3, 1.6e9),
        facing_concentration=np.array([0.9, 0.9, 0.1]),
    )
    votes = Votes(
        label_id=np.array([0, 0, 0, 1, 1]),
        detection_id=np.array([100, 101, 102, 103, 104]),
        image_id=np.array([10, 20, 30, 30, 40]),
        residual_px=np.array([1.0, 2.0, 0.5, 1.5, 0.25]),
        residual_sigmas=np.array([0.5, 1.0, 0.25, 0.75, 0.125]),
    )
    dataset = small_dataset(frame)
    image_of = dict(zip(dataset.detections.detection_id.tolist(), dataset.detections.image_id.tolist(), strict=True))
    votes = votes.replace(image_id=np.array([image_of[i] for i in votes.detection_id.tolist()]))
    return dataclasses.replace(result, labels=labels, votes=votes)


def tags_of(element: ElementTree.Element) -> dict[str, str]:
    return {tag.attrib["k"]: tag.attrib["v"] for tag in element.iter("tag")}


OGRINFO = shutil.which("ogrinfo")


@pytest.mark.skipif(OGRINFO is None, reason="GDAL's ogrinfo is not installed")
@pytest.mark.parametrize(
    ("name", "driver", "counts"),
    [
        ("map.geojson", "GeoJSON", {"labels": 3}),
        ("map.gpkg", "GPKG", {"labels": 3, "ellipses": 3, "votes": 5, "cameras": 4}),
        ("map.fgb", "FlatGeobuf", {"labels": 3}),
        ("map.kml", "KML", {"traffic light": 1, "regulatory--stop--g1": 1}),
        ("map.osm", "OSM", {"points": 3}),
        ("map.csv", "CSV", {"map": 3}),
        ("map.parquet", "Parquet", {"map": 3}),
        ("map.xodr", "XODR", {}),
    ],
)
def test_ogrinfo_reads_what_is_written(tmp_path: Path, name: str, driver: str, counts: dict[str, int]) -> None:
    drivers = subprocess.run(["ogrinfo", "--formats"], capture_output=True, text=True, check=True).stdout
    if f" {driver} -" not in drivers:
        pytest.skip(f"this GDAL has no driver for {driver}")
    path = tmp_path / name
    export_map(a_map(), path, dataset=small_dataset(GEOREFERENCED))
    # Nodes of no map yet have negative ids.
    command = ["ogrinfo", "--config", "OSM_USE_CUSTOM_INDEXING", "NO", "-ro", "-al", str(path)]
    read = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "ERROR" not in read.stderr
    parts = {part.partition("\n")[0]: part for part in read.stdout.split("\nLayer name: ")[1:]}
    layers = {layer: part.count("\nOGRFeature(") for layer, part in parts.items()}
    assert counts.items() <= layers.items(), read.stdout
    assert name != "map.xodr" or layers
    if name in {"map.geojson", "map.gpkg", "map.fgb"}:
        lines = parts["labels"].splitlines()
        points = [line.split("(")[1].rstrip(")").split() for line in lines if "POINT Z (" in line]
        places = np.array(points, dtype=np.float64)
        assert_allclose(
            places[np.argsort(places[:, 2])],
            lon_lat_height_from_enu(POSITIONS, ANCHOR)[np.argsort(POSITIONS[:, 2])],
            rtol=0.0,
            atol=1e-3,
        )


def test_geopackage_has_labels_ellipses_votes_and_cameras(tmp_path: Path) -> None:
    dataset = small_dataset(GEOREFERENCED)
    path = tmp_path / "map.gpkg"
    export_map(a_map(), path, dataset=dataset)
    assert {name for name, _ in pyogrio.list_layers(path)} == {"labels", "ellipses", "votes", "cameras", "layer_styles"}
    labels, ellipses, votes, cameras = (
        geopandas.read_file(path, layer=name) for name in ("labels", "ellipses", "votes", "cameras")
    )
    assert labels.crs == ellipses.crs == votes.crs == cameras.crs == "EPSG:4979"
    assert len(cameras) == 4
    assert ellipses.geometry.contains(labels.geometry).all()
    width_m = (ellipses.total_bounds[2:] - ellipses.total_bounds[:2]) * [69_000.0, 111_000.0]
    assert np.all(width_m < [60.0, 60.0])
    centers = enu_from_lon_lat_height(
        np.column_stack([cameras.geometry.x, cameras.geometry.y, cameras.geometry.z]), ANCHOR
    )
    assert_allclose(centers, camera_centers(dataset.images), atol=1e-4)
    assert_allclose(cameras["heading_deg"], 0.0, atol=1e-6)  # They look along y, which is north.
    first, last = votes.geometry[0].coords[0], votes.geometry[0].coords[-1]
    assert first[:2] == (cameras.geometry.x[0], cameras.geometry.y[0])
    assert last[:2] == (labels.geometry.x[0], labels.geometry.y[0])
    assert votes["picture"].tolist()[0] == "a/1.jpg"


def test_a_map_with_y_down_is_seen_from_above(tmp_path: Path) -> None:
    """As KITTI has it: x right is east, z ahead is north."""
    frame = Frame(up=(0.0, -1.0, 0.0))
    dataset, result = small_dataset(frame), a_map(frame)
    for name in ("map.gpkg", "map.fgb"):
        export_map(result, tmp_path / name, dataset=dataset)
        labels = geopandas.read_file(tmp_path / name, layer="labels").sort_values("label_id")
        assert_allclose(labels[["x", "y", "z"]], POSITIONS)
        points = labels.geometry
        assert_allclose(np.stack([points.x, points.y, points.z], axis=1), POSITIONS[:, [0, 2, 1]] * [1.0, 1.0, -1.0])
    ellipses, votes, cameras = (
        geopandas.read_file(tmp_path / "map.gpkg", layer=name) for name in ("ellipses", "votes", "cameras")
    )
    points = geopandas.read_file(tmp_path / "map.gpkg", layer="labels").geometry
    assert ellipses.geometry.contains(points).all()
    centers = camera_centers(dataset.images)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    assert_allclose(np.stack([cameras.geometry.x, cameras.geometry.y, cameras.geometry.z], axis=1), centers, atol=1e-9)
    assert_allclose(votes.geometry[0].coords[0], centers[0], atol=1e-9)
    assert votes.geometry[0].coords[-1] == points[0].coords[0]


@pytest.mark.parametrize(
    ("crs", "largest"), [(None, 0.01), ("EPSG:3857", 200.0), ("ESRI:54009", 200.0), ("EPSG:32660", 200.0)]
)
def test_lines_and_areas_of_a_geopackage_do_not_go_around_the_earth(
    tmp_path: Path, crs: str | None, largest: float
) -> None:
    """Cameras are on the one side of longitude 180 and labels on the other, and one label is on it."""
    frame = Frame(anchor=(-17.0, 179.9999, 5.0))
    assert frame.anchor is not None
    positions = POSITIONS + [[7.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    positions[1, 0] = enu_from_lon_lat_height(np.array([[180.0, -17.0, 5.0]]), frame.anchor)[0, 0]
    result = a_map(frame)
    places = lon_lat_height_from_enu(positions, frame.anchor)
    labels = result.labels.replace(position_in_world_m=positions, lon_lat_height=places)
    export_map(dataclasses.replace(result, labels=labels), tmp_path / "map.gpkg", dataset=small_dataset(frame), crs=crs)
    assert places[0, 0] < -179.0
    for layer in ("ellipses", "votes"):
        bounds = geopandas.read_file(tmp_path / "map.gpkg", layer=layer).geometry.bounds
        assert ((bounds.maxx - bounds.minx) < largest).all(), layer
    if crs != "EPSG:3857":
        return
    elsewhere = Frame(anchor=(-17.0, 100.0, 5.0))
    assert elsewhere.anchor is not None
    labels = labels.replace(lon_lat_height=lon_lat_height_from_enu(positions, elsewhere.anchor))
    there = dataclasses.replace(result, labels=labels, frame=elsewhere)
    export_map(there, tmp_path / "there.gpkg", dataset=small_dataset(elsewhere), crs=crs)
    lines, others = (
        geopandas.read_file(tmp_path / name, layer="votes").geometry.bounds for name in ("map.gpkg", "there.gpkg")
    )
    assert_allclose(lines.maxx - lines.minx, others.maxx - others.minx, atol=1e-6)


@pytest.mark.parametrize("kind", [pyogrio.errors.DataSourceError, pyogrio.errors.FeatureError])
def test_a_geopackage_that_gdal_cannot_write_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type[Exception]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise kind("no such table: gpkg_contents")

    monkeypatch.setattr(pyogrio, "write_dataframe", fail)
    with pytest.raises(OutputError, match="no GeoPackage can be written there: no such table") as error:
        export_map(a_map(), tmp_path / "map.gpkg")
    assert error.value.hint == "is the disk full?"
    assert not list(tmp_path.iterdir())


def test_a_geopackage_in_a_folder_that_sqlite_cannot_open_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no GeoPackage can be written there: ") as error:
        export_map(a_map(), tmp_path / "line\nbreak" / "map.gpkg")
    assert error.value.hint == "choose a folder without line breaks in its name"


def test_geopackage_brings_its_styles(tmp_path: Path) -> None:
    export_map(a_map(), tmp_path / "map.gpkg", dataset=small_dataset(GEOREFERENCED))
    with sqlite3.connect(tmp_path / "map.gpkg") as database:
        styles = dict(database.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault = 1"))
        columns = dict(database.execute("SELECT table_name, column_name FROM gpkg_geometry_columns"))
        used = dict(database.execute("SELECT f_table_name, f_geometry_column FROM layer_styles"))
        problems = database.execute("PRAGMA integrity_check").fetchall()
    assert set(styles) == {"labels", "ellipses", "votes", "cameras"}
    assert used == columns
    assert problems == [("ok",)]
    for name, text in styles.items():
        renderer = ElementTree.fromstring(text.partition("\n")[2]).find("renderer-v2")
        assert renderer is not None, name
        assert renderer.find("symbols/symbol/layer") is not None, name
    labels = ElementTree.fromstring(styles["labels"].partition("\n")[2])
    assert {entry.attrib["value"] for entry in labels.iter("category")} == {c.replace("\x01", "") for c in CLASSES}


def test_geopackage_of_a_map_in_a_frame_of_its_own(tmp_path: Path) -> None:
    export_map(a_map(Frame()), tmp_path / "map.gpkg")
    labels = pyogrio.read_dataframe(tmp_path / "map.gpkg", layer="labels")
    assert_allclose(np.column_stack([labels.geometry.x, labels.geometry.y, labels.geometry.z]), POSITIONS)
    votes = pyogrio.read_dataframe(tmp_path / "map.gpkg", layer="votes", read_geometry=False)
    assert votes["detection_id"].tolist() == [100, 101, 102, 103, 104]


def test_flatgeobuf_holds_the_labels(tmp_path: Path) -> None:
    export_map(a_map(), tmp_path / "map.fgb")
    frame = geopandas.read_file(tmp_path / "map.fgb").sort_values("label_id")
    places = np.column_stack([frame.geometry.x, frame.geometry.y, frame.geometry.z])
    assert_allclose(places, lon_lat_height_from_enu(POSITIONS, ANCHOR), atol=1e-12)
    assert len(geopandas.read_file(tmp_path / "map.fgb", bbox=tuple(np.tile(places[0, :2], 2)))) == 1


def test_kml_opens_with_gdal(tmp_path: Path) -> None:
    export_map(a_map(), tmp_path / "map.kml")
    layers = [name for name, _ in pyogrio.list_layers(tmp_path / "map.kml")]
    assert sorted(layers) == sorted(c.replace("\x01", "") for c in CLASSES)
    light = pyogrio.read_dataframe(tmp_path / "map.kml", layer="traffic light")
    lon, lat, _ = lon_lat_height_from_enu(POSITIONS, ANCHOR)[0]
    assert (light.geometry.x[0], light.geometry.y[0]) == pytest.approx((lon, lat), abs=1e-9)
    text = (tmp_path / "map.kml").read_text(encoding="utf-8")
    assert "<begin>2020-09-13T12:26:40.000Z</begin>" in text


def test_osm_suggests_tags_and_forbids_uploading(tmp_path: Path) -> None:
    export_map(a_map(), tmp_path / "map.osm")
    root = ElementTree.parse(tmp_path / "map.osm").getroot()
    assert root.attrib["upload"] == "never"
    light, stop, strange = root.findall("node")
    assert [int(node.attrib["id"]) for node in (light, stop, strange)] == [-1, -2, -3]
    assert tags_of(light)["highway"] == "traffic_signals"
    assert tags_of(light)["direction"] == "180"
    assert (tags_of(stop)["traffic_sign"], tags_of(stop)["direction"]) == ("stop", "90")
    assert tags_of(strange)["valuemap:class"] == CLASSES[2].replace("\x01", "")
    assert "direction" not in tags_of(strange)  # It is seen from all sides.
    assert tags_of(light)["survey:date"] == "2023-11-14"
    points = pyogrio.read_dataframe(tmp_path / "map.osm", layer="points")
    assert len(points) == 3


def test_maproulette_has_a_task_a_line(tmp_path: Path) -> None:
    export_map(a_map(), tmp_path / "tasks.geojsonl")
    lines = (tmp_path / "tasks.geojsonl").read_bytes().decode().split("\n")[:-1]
    assert all(line.startswith("\x1e{") for line in lines)
    tasks = [json.loads(line[1:]) for line in lines]
    assert [task["type"] for task in tasks] == ["FeatureCollection"] * 3
    assert [len(task["features"]) for task in tasks] == [1, 1, 1]
    properties = tasks[0]["features"][0]["properties"]
    assert properties["id"] == "valuemap-0"
    assert "highway=traffic_signals" in properties["suggested_tags"].split("\n")


@pytest.mark.parametrize(
    ("facing_deg", "right"),
    # Who sees a light that faces south looks north: right is east.
    [(180.0, [1.0, 0.0]), (90.0, [0.0, 1.0]), (0.0, [-1.0, 0.0]), (270.0, [0.0, -1.0])],
)
def test_lower_edges_go_from_left_to_right_as_drivers_see_them(facing_deg: float, right: list[float]) -> None:
    left_end, right_end = lower_edges(Export(a_map(facing_deg=(facing_deg,) * 3)))[0]
    assert_allclose((right_end - left_end)[:2], 0.3 * np.array(right), atol=1e-12)
    assert_allclose((left_end + right_end) / 2.0, POSITIONS[0] - [0.0, 0.0, 0.45], atol=1e-12)


def test_lanelet2_reads_what_is_written(tmp_path: Path) -> None:
    lanelet2 = pytest.importorskip("lanelet2", reason="there is no lanelet2 for this system")
    export_map(a_map(), tmp_path / "map.lanelet2.osm")
    lat, lon, height = ANCHOR
    origin = lanelet2.io.Origin(lat, lon, height)
    read, errors = lanelet2.io.loadRobust(
        str(tmp_path / "map.lanelet2.osm"), lanelet2.projection.LocalCartesianProjector(origin)
    )
    assert list(errors) == []
    lines = {line.attributes["valuemap:label"]: line for line in read.lineStringLayer}
    assert sorted(lines) == ["0", "1", "2"]
    light = lines["0"]
    assert light.attributes["type"] == "traffic_light"
    assert light.attributes["subtype"] == "red_yellow_green"
    assert float(light.attributes["height"]) == pytest.approx(0.9)
    assert float(light.attributes["existence"]) == pytest.approx(0.999)
    assert float(light.attributes["sigma_m"]) == pytest.approx(np.hypot(0.2, 0.1), abs=1e-3)
    assert lines["1"].attributes["type"] == "traffic_sign"
    ends = np.array([[point.x, point.y, point.z] for point in light])
    assert_allclose(ends, lower_edges(Export(a_map()))[0], atol=2e-4)
    nodes = ElementTree.parse(tmp_path / "map.lanelet2.osm").getroot().findall("node")
    assert [float(tags_of(node)["ele"]) for node in nodes[:2]] == pytest.approx([39.55, 39.55], abs=1e-3)
    # Autoware would take `local_x` for x, whatever the projection of the map of lanes is.
    assert all(tags_of(node).keys() == {"ele"} for node in nodes)


def test_lanelet2_of_a_map_in_a_frame_of_its_own_has_local_coordinates(tmp_path: Path) -> None:
    """As Autoware has it where a map is not geo-referenced; cameras that look down a little tilt no map."""
    tilt = np.radians(3.0)
    result = a_map(Frame(up=(np.sin(tilt), 0.0, np.cos(tilt))))
    export_map(result, tmp_path / "map.lanelet2.osm")
    nodes = ElementTree.parse(tmp_path / "map.lanelet2.osm").getroot().findall("node")
    assert all((node.attrib["lat"], node.attrib["lon"]) == ("0.0", "0.0") for node in nodes)
    found = [[float(tags_of(node)[key]) for key in ("local_x", "local_y", "ele")] for node in nodes]
    assert_allclose(found, lower_edges(Export(result)).reshape(-1, 3), atol=1e-4)
    with pytest.raises(InputError, match="the map is not geo-referenced"):
        export_map(result, tmp_path / "other.lanelet2.osm", crs="EPSG:32630")


def test_lanelet2_has_lights_for_pedestrians_without_yellow(tmp_path: Path) -> None:
    names = ["object--traffic-light--pedestrians", "object--traffic-light--general-upright"]
    places = lon_lat_height_from_enu(POSITIONS[:2], ANCHOR)
    result = map_of(POSITIONS[:2], names, frame=GEOREFERENCED, lon_lat_height=places)
    export_map(result, tmp_path / "map.lanelet2.osm")
    ways = ElementTree.parse(tmp_path / "map.lanelet2.osm").getroot().findall("way")
    assert [tags_of(way)["type"] for way in ways] == ["traffic_light"] * 2
    assert [tags_of(way)["subtype"] for way in ways] == ["red_green", "red_yellow_green"]


def test_lanelet2_does_not_share_ids_with_a_map_of_lanes(tmp_path: Path) -> None:
    """Editors of such maps count from 1; where ids are the same, merging loses a line or moves another's nodes."""
    export_map(a_map(), tmp_path / "map.lanelet2.osm")
    root = ElementTree.parse(tmp_path / "map.lanelet2.osm").getroot()
    ids = {
        tags_of(way)["valuemap:label"]: [int(nd.attrib["ref"]) for nd in way.findall("nd")] + [int(way.attrib["id"])]
        for way in root.findall("way")
    }
    assert ids == {str(label): [10**9 + 3 * label + each for each in range(3)] for label in range(3)}
    assert {int(node.attrib["id"]) for node in root.findall("node")} == {
        10**9 + 3 * label + each for label in range(3) for each in range(2)
    }


def signals_of(path: Path) -> list[ElementTree.Element]:
    return ElementTree.parse(path).getroot().findall("road/signals/signal")


def test_opendrive_signals_say_where_and_how_exactly(tmp_path: Path) -> None:
    export_map(a_map(), tmp_path / "map.xodr")
    light, stop, _ = signals_of(tmp_path / "map.xodr")
    assert (light.attrib["dynamic"], light.attrib["type"]) == ("yes", "1000001")
    assert (stop.attrib["dynamic"], stop.attrib["type"]) == ("no", "B,2a")
    place = light.find("positionInertial")
    assert place is not None
    # Near the anchor the projection is the local frame; z is ellipsoidal, to the lower edge.
    assert [float(place.attrib[axis]) for axis in "xyz"] == pytest.approx([4.0, 25.0, 35.0 + 5.0 - 0.45], abs=1e-3)
    # It faces south, so that those see it who drive north.
    assert float(place.attrib["hdg"]) == pytest.approx(np.pi / 2)
    error = light.find("dataQuality/error")
    assert error is not None
    assert float(error.attrib["xyAbsolute"]) == pytest.approx(np.hypot(0.2, 0.1), abs=1e-4)
    assert float(error.attrib["zAbsolute"]) == pytest.approx(0.3, abs=1e-4)
    placed = a_map()
    absolute_m2 = placed.labels.covariance_m2 + [4.0, 0.0, 0.0, 4.0, 0.0, 1.0]
    placed = dataclasses.replace(placed, labels=placed.labels.replace(absolute_covariance_m2=absolute_m2))
    export_map(placed, tmp_path / "placed.xodr")
    error = signals_of(tmp_path / "placed.xodr")[0].find("dataQuality/error")
    assert error is not None
    # What the whole map is off by is no error against the labels around.
    of_place = {"xyAbsolute": np.sqrt(8.05), "zAbsolute": np.sqrt(1.09), "xyRelative": np.sqrt(0.05), "zRelative": 0.3}
    assert {name: float(value) for name, value in error.attrib.items()} == pytest.approx(of_place, abs=1e-4)


def test_the_number_of_a_sign_is_a_text_in_opendrive(tmp_path: Path) -> None:
    """A value needs a unit, which a class does not say; and codes of Vienna are none of OpenDRIVE's own."""
    speed = map_of([[1.0, 2.0, 3.0]], ["regulatory--maximum-speed-limit-50--g1"])
    export_map(speed, tmp_path / "map.xodr")
    (signal,) = signals_of(tmp_path / "map.xodr")
    assert (signal.attrib["type"], signal.attrib["text"]) == ("C,14", "50")
    assert not {"value", "unit", "country"} & set(signal.attrib)
    export_map(a_map(), tmp_path / "lights.xodr")
    assert signals_of(tmp_path / "lights.xodr")[0].attrib["country"] == "OpenDRIVE"


def random_places(seed: int, spread_m: tuple[float, float]) -> Floats:
    """Return positions (12, 3) around a place that is not the origin."""
    random = np.random.default_rng(seed)
    return random.uniform(-1.0, 1.0, (12, 3)) * [*spread_m, 5.0] + random.uniform(-3e3, 3e3, 3)


@pytest.mark.parametrize(
    "places",
    [
        POSITIONS,
        POSITIONS[:1],
        *(random_places(seed, (500.0, 500.0)) for seed in range(5)),
        random_places(5, (1.0, 800.0)),  # The westernmost and the easternmost are not at the ends.
        random_places(6, (0.1, 800.0)),
        random_places(7, (0.0, 800.0)),  # On one meridian.
        random_places(8, (800.0, 0.0)),
    ],
)
def test_opendrive_roads_carry_their_signals(places: Floats, tmp_path: Path) -> None:
    """Whoever only looks at s and t finds them in the same places."""
    export_map(map_of(places), tmp_path / "map.xodr")
    assert len(signals_of(tmp_path / "map.xodr")) == len(places)
    line = ElementTree.parse(tmp_path / "map.xodr").getroot().find("road/planView/geometry")
    assert line is not None
    x, y, heading = (float(line.attrib[name]) for name in ("x", "y", "hdg"))
    for signal in signals_of(tmp_path / "map.xodr"):
        s, t = float(signal.attrib["s"]), float(signal.attrib["t"])
        place = signal.find("positionInertial")
        assert place is not None
        assert 0.0 <= s <= float(line.attrib["length"])
        found = [
            x + s * np.cos(heading) - t * np.sin(heading),
            y + s * np.sin(heading) + t * np.cos(heading),
        ]
        assert found == pytest.approx([float(place.attrib["x"]), float(place.attrib["y"])], abs=1e-3)
        turned = heading + float(signal.attrib["hOffset"]) - float(place.attrib["hdg"])
        assert np.cos(turned) == pytest.approx(1.0)


def test_an_opendrive_signal_for_traffic_along_the_road_is_not_turned(tmp_path: Path) -> None:
    """Of two lights on a road to the east, that which faces west is for those who drive along it."""
    facing = np.radians([270.0, 90.0])
    result = map_of([[0.0, 0.0, 5.0], [100.0, 0.0, 5.0]], ["traffic light"] * 2)
    result = dataclasses.replace(result, labels=result.labels.replace(facing_azimuth_rad=facing))
    export_map(result, tmp_path / "map.xodr")
    turned = [float(signal.attrib["hOffset"]) for signal in signals_of(tmp_path / "map.xodr")]
    assert np.abs(turned) == pytest.approx([0.0, np.pi], abs=1e-5)


@pytest.mark.parametrize("frame", [GEOREFERENCED, Frame(up=(0.0, -1.0, 0.0))])
def test_opendrive_passes_the_checker_of_asam(frame: Frame, tmp_path: Path) -> None:
    checker = shutil.which("qc_opendrive")
    if checker is None:
        pytest.skip("qc_opendrive is not on the PATH: pip install asam-qc-opendrive into an environment of its own")
    export_map(a_map(frame), tmp_path / "map.xodr")
    (tmp_path / "config.xml").write_text(
        f'<Config><Param name="InputFile" value="{tmp_path / "map.xodr"}"/>'
        '<CheckerBundle application="xodrBundle"><Param name="resultFile" value="result.xqar"/></CheckerBundle>'
        "</Config>"
    )
    subprocess.run([checker, "-c", "config.xml"], cwd=tmp_path, check=True, capture_output=True)
    result = ElementTree.parse(tmp_path / "result.xqar").getroot()
    checks = list(result.iter("Checker"))
    assert any(check.attrib["status"] == "completed" for check in checks)
    issues = [issue.attrib["description"] for issue in result.iter("Issue")]
    assert issues == []


def test_opendrive_of_a_map_in_a_frame_of_its_own_has_z_up(tmp_path: Path) -> None:
    export_map(a_map(Frame(up=(0.0, -1.0, 0.0))), tmp_path / "map.xodr")
    place = signals_of(tmp_path / "map.xodr")[0].find("positionInertial")
    assert place is not None
    assert float(place.attrib["z"]) == pytest.approx(-25.0 - 0.45)


def test_colmap_opens_the_map(tmp_path: Path) -> None:
    dataset = small_dataset()
    export_map(a_map(Frame()), tmp_path / "model", format_name="colmap", dataset=dataset)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert model.num_images() == 4
    assert sorted(model.points3D) == [0, 1, 2]
    assert_allclose(model.points3D[0].xyz, POSITIONS[0])
    assert model.points3D[0].error == pytest.approx(1.5)
    tracks = {
        (e.image_id, tuple(model.images[e.image_id].points2D[e.point2D_idx].xy))
        for e in model.points3D[1].track.elements
    }
    expected: set[tuple[int, tuple[float, ...]]] = set()
    for detection in (103, 104):
        row = dataset.detections.detection_id.tolist().index(detection)
        center: Floats = dataset.detections.center_px[row]
        expected.add((int(dataset.detections.image_id[row]), tuple(center.tolist())))
    assert tracks == expected
    image = model.images[10]
    assert_allclose(image.projection_center(), camera_centers(dataset.images)[0], atol=1e-12)
    assert image.name == "a/1.jpg"


def test_labels_that_are_gone_are_no_points_of_colmap(tmp_path: Path) -> None:
    result = a_map()
    states = Categories.from_texts(["gone", "moved", "new"])
    result = dataclasses.replace(result, labels=result.labels.replace(state=states))
    export_map(result, tmp_path / "model", format_name="colmap", dataset=small_dataset(GEOREFERENCED))
    points = pycolmap.Reconstruction(str(tmp_path / "model")).points3D
    assert {number: len(point.track.elements) for number, point in points.items()} == {1: 2, 2: 0}


@pytest.mark.parametrize("space", [" ", "\t", "\u3000"])
def test_names_with_white_space_make_a_binary_model_that_is_read_back(space: str, tmp_path: Path) -> None:
    plain = small_dataset()
    names = [f"a{space}drive/{number}.jpg" for number in range(len(plain.images))]
    dataset = dataclasses.replace(plain, images=plain.images.replace(name=pa.array(names)))
    export_map(a_map(Frame()), tmp_path / "model", format_name="colmap", dataset=plain)
    assert (tmp_path / "model" / "images.txt").exists()
    export_map(a_map(Frame()), tmp_path / "model", format_name="colmap", dataset=dataset)
    files = sorted(path.name for path in (tmp_path / "model").glob("[!.]*"))
    assert files == ["cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"]
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert sorted(image.name for image in model.images.values()) == names
    assert len(model.points3D[0].track.elements) == 3
    write_poses(a_map(Frame()), dataset, tmp_path / "poses")
    for folder in (tmp_path / "model", tmp_path / "poses" / "colmap"):
        read = read_colmap(folder, up=(0.0, 0.0, 1.0))
        assert read.images.name.to_pylist() == names
        assert_allclose(camera_centers(read.images), camera_centers(dataset.images), atol=1e-12)


def test_colmap_needs_the_dataset(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the dataset of the map is not known"):
        export_map(a_map(), tmp_path / "model", format_name="colmap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["map.kml", "map.osm", "map.geojsonl"])
def test_formats_of_the_earth_need_a_geo_reference(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the map is not geo-referenced"):
        export_map(a_map(Frame()), tmp_path / name)
    assert list(tmp_path.iterdir()) == []
