"""What exports say for people: ellipses, facing, times, pictures, other reference systems, harmless texts."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import geopandas
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pyogrio
import pytest
from numpy.testing import assert_allclose
from pyproj import Transformer

from small_dataset import ANCHOR, map_of, small_dataset
from valuemap.dataset import Frame
from valuemap.errors import InputError, OutputError, SettingError
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import Map
from valuemap.tables import Detections, Votes
from valuemap.writers import SUFFIXES, export_map
from valuemap.writers.attributes import Export, azimuth_in_degrees, iso_times
from valuemap.writers.geopackage import ELLIPSE_SIGMAS, ellipse_rings_in_world_m
from valuemap.writers.sign_codes import SIGNS, find_sign, osm_tags


def one_label(covariance: list[float], frame: Frame | None = None) -> Map:
    result = map_of([[1.0, 2.0, 3.0]], frame=frame)
    return dataclasses.replace(result, labels=result.labels.replace(covariance_m2=np.array([covariance])))


def covariance_of(major_m: float, minor_m: float, azimuth_deg: float, height_m: float) -> list[float]:
    azimuth = np.radians(azimuth_deg)
    axes = np.array([[np.sin(azimuth), np.cos(azimuth)], [np.cos(azimuth), -np.sin(azimuth)]])
    ground = axes.T @ np.diag([major_m**2, minor_m**2]) @ axes
    return [ground[0, 0], ground[0, 1], 0.0, ground[1, 1], 0.0, height_m**2]


@pytest.mark.parametrize("azimuth_deg", [0.0, 20.0, 90.0, 135.0, 170.0])
def test_the_ellipse_has_the_axes_and_the_azimuth_of_the_covariance(azimuth_deg: float) -> None:
    row = Export(one_label(covariance_of(0.5, 0.2, azimuth_deg, 0.3))).attributes.iloc[0]
    assert row["ellipse_major_m"] == pytest.approx(0.5)
    assert row["ellipse_minor_m"] == pytest.approx(0.2)
    assert row["sigma_m"] == pytest.approx(np.hypot(0.5, 0.2))
    assert row["sigma_height_m"] == pytest.approx(0.3)
    assert row["ellipse_azimuth_deg"] == pytest.approx(azimuth_deg, abs=1e-6)


def test_in_a_frame_with_y_down_the_ground_is_across_it() -> None:
    """As KITTI has it: x right, z ahead, which is north there."""
    row = Export(one_label([0.04, 0.0, 0.0, 0.09, 0.0, 0.25], Frame(up=(0.0, -1.0, 0.0)))).attributes.iloc[0]
    assert row["sigma_height_m"] == pytest.approx(0.3)
    assert row["ellipse_major_m"] == pytest.approx(0.5)
    assert row["ellipse_minor_m"] == pytest.approx(0.2)
    assert row["ellipse_azimuth_deg"] % 180.0 == pytest.approx(0.0, abs=1e-6)


def test_the_ring_of_an_ellipse_holds_what_it_says() -> None:
    export = Export(one_label(covariance_of(0.5, 0.2, 20.0, 0.3)))
    ring = ellipse_rings_in_world_m(export)[0] - [1.0, 2.0, 3.0]
    from_middle = np.linalg.norm(ring[:, :2], axis=1)
    assert from_middle.max() == pytest.approx(0.5 * ELLIPSE_SIGMAS)
    assert from_middle.min() == pytest.approx(0.2 * ELLIPSE_SIGMAS, rel=1e-3)
    farthest = ring[np.argmax(from_middle)]
    assert np.degrees(np.arctan2(farthest[0], farthest[1])) % 180.0 == pytest.approx(20.0)
    errors = np.random.default_rng(0).normal(0.0, [0.2, 0.5], (20_000, 2))
    assert np.mean((errors / [0.2, 0.5] / ELLIPSE_SIGMAS) ** 2 @ np.ones(2) <= 1.0) == pytest.approx(0.95, abs=0.005)


def test_times_are_iso_where_they_are_dates() -> None:
    times = np.array([np.nan, 12.5, 1_700_000_000.25, 1e18])
    assert iso_times(times) == [None, None, "2023-11-14T22:13:20.250Z", "9999-12-31T23:59:59.999Z"]


def test_facing_is_in_degrees() -> None:
    assert Export(map_of([[0.0, 0.0, 0.0]])).attributes["facing_deg"][0] == pytest.approx(np.degrees(4.7))
    assert_allclose(azimuth_in_degrees(np.array([-1e-17, -np.pi / 2.0, np.nan])), [0.0, 270.0, np.nan], atol=1e-9)


def voted_map(votes: list[tuple[int, int]], labels: int = 2, frame: Frame | None = None) -> Map:
    """Votes are pairs of label and detection of the small dataset."""
    image_of = {100: 10, 101: 10, 102: 30, 103: 30, 104: 40}
    detections = sorted(detection for _, detection in votes)
    assert set(detections) <= set(image_of)
    position = np.arange(3.0 * labels).reshape(-1, 3)
    places = None if frame is None or frame.anchor is None else lon_lat_height_from_enu(position, frame.anchor)
    result = map_of(position, frame=frame, lon_lat_height=places, run={"dataset": "small"})
    return dataclasses.replace(
        result,
        votes=Votes(
            label_id=np.array([label for label, _ in votes]),
            detection_id=np.array([detection for _, detection in votes]),
            image_id=np.array([image_of[detection] for _, detection in votes]),
            residual_px=np.full(len(votes), 1.0),
            residual_sigmas=np.full(len(votes), 0.5),
        ),
    )


def test_the_best_pictures_are_large_and_of_different_passes_first() -> None:
    dataset = small_dataset()
    size = np.array([[30.0, 30.0], [1.0, 1.0], [5.0, 5.0], [1.0, 1.0], [8.0, 8.0]])
    detections: Detections = dataset.detections.replace(size_px=size)
    dataset = dataclasses.replace(dataset, detections=detections)
    # Image 10 is of pass a, 30 and 40 are of pass b.
    result = voted_map([(0, 102), (0, 104), (0, 100), (1, 103)])
    table = Export(result, dataset).attributes
    assert table[["picture_1", "picture_2", "picture_3"]].values.tolist()[0] == ["a/1.jpg", "b/2.jpg", "b/1.jpg"]
    assert table["picture_1"][1] == "b/1.jpg"
    assert table["picture_2"].isna().tolist() == [False, True]
    assert "picture_1" not in Export(result).attributes


def test_a_dataset_of_another_map_is_refused(tmp_path: Path) -> None:
    result = voted_map([(0, 100)])
    strange = dataclasses.replace(result, votes=result.votes.replace(detection_id=np.array([7])))
    with pytest.raises(InputError, match="detection_id 7 is not in the dataset small"):
        export_map(strange, tmp_path / "map.csv", dataset=small_dataset())
    assert list(tmp_path.iterdir()) == []


FORMULAS = ["=cmd|' /C calc'!A0", "+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "speed limit -30"]


def test_a_text_is_no_formula_to_a_spreadsheet(tmp_path: Path) -> None:
    positions = -np.ones((len(FORMULAS), 3))
    export_map(map_of(positions, FORMULAS), tmp_path / "map.csv")
    with (tmp_path / "map.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["class"] for row in rows] == [f"'{text}".replace("\r", " ") for text in FORMULAS[:-1]] + FORMULAS[-1:]
    assert {row["x"] for row in rows} == {"-1.0"}  # Numbers are numbers.


def geographic_map() -> Map:
    return voted_map([(0, 100)], frame=Frame(anchor=ANCHOR))


def test_other_reference_systems(tmp_path: Path) -> None:
    result = geographic_map()
    assert result.labels.lon_lat_height is not None
    to_utm = Transformer.from_crs("EPSG:4979", "EPSG:32630", always_xy=True)
    expected = np.stack(to_utm.transform(*result.labels.lon_lat_height.T), axis=1)
    for name in ("map.gpkg", "map.fgb"):
        export_map(result, tmp_path / name, crs="EPSG:32630")
        frame = geopandas.read_file(tmp_path / name, layer="labels").sort_values("label_id")
        assert frame.crs.to_epsg() == 32630, name
        assert_allclose(np.column_stack([frame.geometry.x, frame.geometry.y, frame.geometry.z]), expected, atol=1e-6)
    export_map(result, tmp_path / "map.parquet", crs="EPSG:32630")
    assert geopandas.read_parquet(tmp_path / "map.parquet").crs.to_epsg() == 32630
    export_map(result, tmp_path / "map.csv", crs="EPSG:32630")
    with (tmp_path / "map.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert_allclose([[float(row[f"crs_{axis}"]) for axis in "xyz"] for row in rows], expected, atol=1e-6)


@pytest.mark.parametrize("name", ["map.geojson", "map.kml", "map.osm", "map.geojsonl", "map.lanelet2.osm"])
def test_formats_that_are_always_wgs84_refuse_others(name: str, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="longitude and latitude only, not EPSG:32630"):
        export_map(geographic_map(), tmp_path / name, crs="EPSG:32630")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("crs", "told"),
    [
        (
            "EPSG:2193",
            ["crs EPSG:2193: 2 of 2 labels lie outside the area that it is made for, by up to 167 degrees: "],
        ),
        ("EPSG:32630", []),
        ("+proj=utm +zone=31", []),  # Nobody says what it is made for.
    ],
)
@pytest.mark.parametrize("name", ["map.csv", "map.gpkg"])
def test_labels_outside_the_area_of_a_system_are_told(name: str, crs: str, told: list[str], tmp_path: Path) -> None:
    notes: list[str] = []
    export_map(geographic_map(), tmp_path / name, crs=crs, tell=notes.append)
    assert [note.partition("is it")[0] for note in notes] == told


def test_heights_above_a_zero_given_in_metres(tmp_path: Path) -> None:
    result = voted_map([(0, 100)], frame=Frame(anchor=ANCHOR))
    export_map(result, tmp_path / "plain.csv", crs="EPSG:32630")
    export_map(result, tmp_path / "sea.csv", crs="EPSG:32630", vertical="46.5")
    export_map(result, tmp_path / "degrees.csv", vertical="46.5")
    plain, sea, degrees = (pd.read_csv(tmp_path / f"{name}.csv") for name in ("plain", "sea", "degrees"))
    assert_allclose(plain["crs_z"] - sea["crs_z"], 46.5, atol=1e-6)
    assert_allclose(sea["crs_z"], degrees["crs_z"], atol=1e-6)
    assert_allclose(degrees["crs_x"], ANCHOR[1], atol=1e-3)
    with pytest.raises(OutputError, match="only, not heights above another zero"):
        export_map(result, tmp_path / "a.kml", vertical="46.5")


@pytest.mark.parametrize("crs", ["EPSG:4326", "epsg:4979", "4326", "OGC:CRS84"])
@pytest.mark.parametrize("name", ["map.geojson", "map.kml"])
def test_wgs84_may_be_asked_of_formats_that_are_always_wgs84(name: str, crs: str, tmp_path: Path) -> None:
    export_map(geographic_map(), tmp_path / name, crs=crs)
    export_map(geographic_map(), tmp_path / "plain" / name)
    places = [pyogrio.read_dataframe(tmp_path / folder / name).geometry[0].wkt for folder in (".", "plain")]
    assert places[0] == places[1]


@pytest.mark.parametrize(("name", "options"), [("map.xodr", {}), ("map.rrd", {}), ("model", {"format_name": "colmap"})])
def test_formats_with_a_frame_of_their_own_refuse_reference_systems(
    name: str, options: dict[str, Any], tmp_path: Path
) -> None:
    both: list[dict[str, Any]] = [{"crs": "EPSG:32630"}, {"crs": "EPSG:32630", "vertical": "46.5"}]
    for asked in both:
        with pytest.raises(OutputError, match=r"only, not (EPSG:32630|heights above another zero)"):
            export_map(geographic_map(), tmp_path / name, dataset=small_dataset(), **options, **asked)
    assert list(tmp_path.iterdir()) == []


def test_columns_have_their_types_without_any_label(tmp_path: Path) -> None:
    """So that tables of several maps go together."""
    types = []
    for folder, positions in (("some", [[1.0, 2.0, 3.0]]), ("none", [])):
        export_map(map_of(positions), tmp_path / f"{folder}.parquet", dataset=small_dataset())
        schema = pq.read_schema(tmp_path / f"{folder}.parquet")
        types.append({field.name: str(field.type).removeprefix("large_") for field in schema})
    assert types[0] == types[1]
    assert types[1]["first_seen_time"] == types[1]["picture_1"] == "string"


def test_a_size_that_was_not_measured_is_missing(tmp_path: Path) -> None:
    """Key points have no size: their labels have one of 0."""
    result = voted_map([(0, 100)], frame=Frame(anchor=ANCHOR))
    nothing = np.zeros(len(result.labels))
    labels = result.labels.replace(object_width_m=nothing, object_height_m=nothing)
    result = dataclasses.replace(result, labels=labels)
    export_map(result, tmp_path / "map.csv")
    assert pd.read_csv(tmp_path / "map.csv")[["object_width_m", "object_height_m"]].isna().all().all()
    export_map(result, tmp_path / "map.xodr")
    signal = ElementTree.parse(tmp_path / "map.xodr").getroot().find("road/signals/signal")
    assert signal is not None
    assert not {"height", "width"} & set(signal.attrib)
    export_map(result, tmp_path / "map.lanelet2.osm")
    keys = {tag.attrib["k"] for tag in ElementTree.parse(tmp_path / "map.lanelet2.osm").getroot().iter("tag")}
    assert "height" not in keys


def test_a_reference_system_must_exist_and_the_map_have_a_place_in_it(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="EPSG:1"):
        export_map(geographic_map(), tmp_path / "map.gpkg", crs="EPSG:1")
    with pytest.raises(InputError, match="not geo-referenced, so that it has no place in EPSG:32630"):
        export_map(voted_map([(0, 100)]), tmp_path / "map.gpkg", crs="EPSG:32630")
    assert list(tmp_path.iterdir()) == []


def test_geoparquet_is_1_1_with_bounds_along_a_curve(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    positions = np.column_stack([random.uniform(-1e3, 1e3, (500, 2)), np.zeros(500)])
    result = map_of(positions, frame=Frame(anchor=ANCHOR), lon_lat_height=lon_lat_height_from_enu(positions, ANCHOR))
    export_map(result, tmp_path / "map.parquet")
    schema = pq.read_schema(tmp_path / "map.parquet")
    geo = schema.metadata[b"geo"].decode()
    assert '"version": "1.1.0"' in geo
    assert '"covering": {"bbox"' in geo
    assert schema.field("bbox").type.num_fields >= 4
    frame = geopandas.read_parquet(tmp_path / "map.parquet")
    along = positions[frame["label_id"]]
    way_m = np.linalg.norm(np.diff(along, axis=0), axis=1).sum()
    assert way_m < 0.15 * np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    west = geopandas.read_parquet(tmp_path / "map.parquet", bbox=(-0.16, 51.4, -0.14, 51.6))
    assert 0 < len(west) < 500


def test_sign_codes_know_classes_by_their_words() -> None:
    for name in ("regulatory--stop--g1", "stop_sign", "Stop", "stop sign"):
        found = find_sign(name)
        assert found is not None
        assert (found[0].vienna, found[0].mutcd) == ("B,2a", "R1-1")
    for name in ("regulatory--maximum-speed-limit-50--g1", "speed_limit_50", "Speed limit 50"):
        assert osm_tags(name) == {"traffic_sign": "maxspeed", "valuemap:number": "50"}
    assert osm_tags("traffic_light") == {"highway": "traffic_signals"}
    assert osm_tags("object--street-light") == {"highway": "street_lamp"}
    assert find_sign("dragon {} 7") is None
    assert find_sign("") is None


def test_sign_codes_are_of_one_meaning_each() -> None:
    names = [sign.mapillary for sign in SIGNS]
    assert len(set(names)) == len(names)
    said = [name for sign in SIGNS for name in sign.names]
    assert len(set(said)) == len(said)
    for sign in SIGNS:
        for name in (sign.mapillary.replace("{}", "30"), *(name.replace("{}", "30") for name in sign.names)):
            found = find_sign(name)
            assert found is not None, name
            assert found[0] is sign, name


FORMATS = Path(__file__).parents[1] / "docs" / "formats"
DOCS = "".join((FORMATS / name).read_text(encoding="utf-8") for name in ("export.md", "signs.md"))


def test_the_docs_say_what_every_column_means() -> None:
    table = Export(geographic_map(), small_dataset(Frame(anchor=ANCHOR)), "EPSG:32630").attributes
    covariance = {name for name in table.columns if name.startswith("covariance_")}
    for name in [*table.columns, "expected", "existence", "state"]:
        if name not in covariance and name != "picture_2":
            assert f"`{name}`" in DOCS, name


def test_the_docs_have_the_table_of_signs_and_all_formats() -> None:
    for sign in SIGNS:
        row = next(line for line in DOCS.splitlines() if line.startswith(f"| `{sign.mapillary}` |"))
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[1] == ", ".join(f"`{key}={value}`" for key, value in sign.osm.items())
        assert cells[2:4] == [sign.vienna or "", sign.mutcd or ""]
    for suffix, name in SUFFIXES.items():
        assert f"| `{suffix}` | `{name}` |" in DOCS
