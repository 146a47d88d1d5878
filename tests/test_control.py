"""Control points: shifts and turns found, proven by points left out, and said in the covariance."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from small_dataset import ANCHOR, map_of
from valuemap.arrays import Floats
from valuemap.cli.commands import app
from valuemap.cli.show import worded
from valuemap.config import SimulationConfig
from valuemap.control import apply_control, find_georeference
from valuemap.dataset import Frame, read_dataset, write_dataset
from valuemap.errors import InputError
from valuemap.evaluate.truth import TrueObjects, read_truth
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import read_map
from valuemap.simulate import simulate
from valuemap.summary import summarize_map
from valuemap.tables import Categories, Rejected
from valuemap.tables.covariance import covariance_matrices

SHIFT = np.array([-0.4, 0.25, 0.1])


@pytest.fixture(autouse=True)
def few_splits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave points out ten times instead of fifty."""
    monkeypatch.setattr("valuemap.control._SPLITS", 10)


def surveyed(places: Floats, classes: list[str] | None = None, **changes: object) -> TrueObjects:
    names = None if classes is None else Categories.from_texts(classes)
    return TrueObjects(np.arange(len(places)), places, names, **changes)  # type: ignore[arg-type]


def rejected_at(*places: Floats) -> Rejected:
    count = len(places)
    ones = np.ones(count, np.int64)
    texts = Categories.from_texts(["votes"] * count)
    return Rejected(np.arange(1, count + 1), texts, np.array(places), ones, ones, ones, np.full(count, np.nan), texts)


def labels_around(seed: int, count: int = 60) -> Floats:
    random = np.random.default_rng(seed)
    return random.uniform(0.0, 300.0, (count, 3)) * [1.0, 1.0, 0.02]


def map_in(folder: Path, *options: str | Path) -> Any:
    """Map the dataset of a folder, quickly."""
    command = ["map", folder / "data", "--out", folder / "map", "--method", "paper", *options]
    return CliRunner().invoke(app, [*map(str, command)])


def test_a_shift_is_found_with_its_deviation() -> None:
    for seed in range(5):
        random = np.random.default_rng(seed)
        truth = labels_around(seed)
        result = map_of(truth - SHIFT + random.normal(0.0, 1.0, (60, 3)) * [0.2, 0.1, 0.3])
        found = find_georeference(result, surveyed(truth[:30]))
        sigma = np.sqrt(np.diag(found.covariance)[:3])
        assert np.all(np.abs(found.shift_m - SHIFT) < 4.0 * sigma)
        assert np.all(sigma < 0.1)
        assert found.turn_rad == 0.0
        assert np.array_equal(found.label_of_point, np.arange(30))


def test_a_turn_is_found_only_where_the_points_tell_it() -> None:
    truth = labels_around(3)
    turn, middle = math.radians(0.5), truth[:40].mean(axis=0)
    rotation = np.array([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    noise = np.random.default_rng(3).normal(0.0, 0.1, (60, 3))
    result = map_of((truth - middle) @ rotation.T + middle + noise)
    found = find_georeference(result, surveyed(truth[:40]))
    assert found.turn_rad == pytest.approx(turn, abs=math.radians(0.05))
    places = result.labels.position_in_world_m
    result = replace(result, rejected=rejected_at(*places))
    moved, _ = apply_control(result, surveyed(truth[:40]))
    assert np.abs(moved.labels.position_in_world_m[40:] - truth[40:]).max() < 0.5
    assert moved.rejected is not None
    assert moved.rejected.position_in_world_m == pytest.approx(moved.labels.position_in_world_m)


def test_wrong_points_and_other_classes_do_not_move_a_map() -> None:
    truth = labels_around(4)
    classes = ["light", "sign"] * 30
    places = truth[:20].copy()
    places[:4] += [3.0, -2.0, 0.0]
    result = map_of(truth - SHIFT, classes)
    found = find_georeference(result, surveyed(places, classes[:20]))
    assert np.abs(found.shift_m - SHIFT).max() < 0.15
    with pytest.raises(InputError, match="label of their class"):
        find_georeference(result, surveyed(places, ["post"] * 20))


def test_points_that_agree_by_chance_do_not_move_a_map() -> None:
    truth = labels_around(8)
    result = map_of(truth + np.random.default_rng(8).normal(0.0, 0.1, (60, 3)))
    for angle in np.radians(np.arange(0.0, 360.0, 45.0)):
        for away_m in (14.0, 30.0, 500.0):  # All are farther than is looked for.
            offset = away_m * np.array([math.cos(angle), math.sin(angle), 0.0])
            with pytest.raises(InputError, match=r"control: \d+ of 30 points"):
                find_georeference(result, surveyed(truth[:30] + offset))
    with pytest.raises(InputError, match=r"control: \d+ of 30 points") as refused:
        find_georeference(result, surveyed(truth[:30] + [3.0, -14.0, 0.0]))
    assert "30 of 30 would if the points were moved by 3.0 m to the west and 14.0 m to the north" in refused.value.hint


def test_many_points_in_a_dense_map_agree_by_chance() -> None:
    random = np.random.default_rng(0)
    result = map_of(random.uniform(0.0, 300.0, (800, 3)) * [1.0, 1.0, 0.02])
    for seed in range(5):
        elsewhere = np.random.default_rng(seed + 1).uniform(0.0, 300.0, (30, 3)) * [1.0, 1.0, 0.0]
        with pytest.raises(InputError, match=r"\d+ of 30 points agree .* and about as many would by chance"):
            find_georeference(result, surveyed(elsewhere, has_height=False))


def test_points_in_rows_of_equal_distances_move_a_map() -> None:
    """They agree as well from the next place of the row, but for its end; the shift is taken for a small one."""
    random = np.random.default_rng(2)
    east, north = np.meshgrid(np.arange(0.0, 300.0, 15.0), [0.0, 12.0])
    truth = np.stack([east.ravel(), north.ravel(), np.zeros(40)], axis=1)
    result = map_of(truth - SHIFT + random.normal(0.0, 0.1, (40, 3)))
    found = find_georeference(result, surveyed(truth))
    assert np.abs(found.shift_m - SHIFT).max() < 0.15


def test_few_points_that_all_agree_are_enough_and_two_are_not() -> None:
    truth = labels_around(9)
    result = map_of(truth - SHIFT)
    for count in (3, 5):
        assert np.abs(find_georeference(result, surveyed(truth[:count])).shift_m - SHIFT).max() < 0.1
    with pytest.raises(InputError, match="control: 2 points, expected at least 3"):
        find_georeference(result, surveyed(truth[:2]))


def test_a_minority_of_points_with_a_label_is_a_note() -> None:
    truth = labels_around(10)
    inventory = np.concatenate([truth[:8], np.random.default_rng(1).uniform(0.0, 300.0, (20, 3)) * [1, 1, 0.02]])
    far = inventory[:5] + [5000.0, 0.0, 0.0]  # What another part of a city has is none of this map's.
    moved, _ = apply_control(map_of(truth - SHIFT), surveyed(np.concatenate([inventory, far])))
    assert moved.run["control"]["matched"] == 8
    assert moved.run["control"]["points_on_map"] == 28
    assert "control: only 8 of 28 points on the map have a label that agrees about the shift" in moved.run["notes"]
    moved, _ = apply_control(map_of(truth - SHIFT), surveyed(np.concatenate([truth[:8], far])))
    assert "notes" not in moved.run


def test_points_left_out_prove_it_and_covariances_have_two_parts() -> None:
    random = np.random.default_rng(5)
    truth = labels_around(5)
    result = map_of(truth - SHIFT + random.normal(0.0, 0.1, (60, 3)))
    moved, _ = apply_control(result, surveyed(truth[:25], sigma_m=np.full(25, 0.02)))
    proof = moved.run["control"]["left_out"]
    assert proof["rmse_horizontal_as_mapped_m"] > 0.4
    assert proof["rmse_horizontal_m"] < 0.25
    assert 0.0 < proof["shift_deviation_m"] < 0.05  # Without any left out it is none.
    labels = moved.labels
    assert labels.absolute_covariance_m2 is not None
    assert np.array_equal(labels.covariance_m2, result.labels.covariance_m2)
    added = labels.absolute_covariance_m2 - labels.covariance_m2
    assert np.all(added[:, [0, 3, 5]] > 1e-5)
    control = moved.run["control"]
    # In the middle of the points what is not known of a turn moves nothing.
    middle = int(np.argmin(np.linalg.norm(labels.position_in_world_m[:, :2] - control["pivot_m"][:2], axis=1)))
    assert added[middle, [0, 3, 5]] == pytest.approx(np.square(control["shift_sigma_m"]), rel=0.3)


def test_a_turn_that_is_not_told_may_be_there_all_the_same() -> None:
    """Points in one corner hardly tell the turn: labels far from them know it. Fewer than six say nothing of one."""
    points, turn_deg = 7, 0.06
    random = np.random.default_rng(8)
    truth = labels_around(8)
    turn = math.radians(turn_deg)
    mapped = truth + random.normal(0.0, 0.03, (60, 3))
    mapped[:, :2] = mapped[:, :2] @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    near = np.argsort(np.linalg.norm(truth[:, :2], axis=1))[:points]
    moved, _ = apply_control(map_of(mapped), surveyed(truth[near], sigma_m=np.full(points, 0.03)))
    control = moved.run["control"]
    assert control["turn_deg"] == 0.0
    assert control["turn_sigma_deg"] > turn_deg / 4.0
    off = (moved.labels.position_in_world_m - truth)[:, :2]
    assert moved.labels.absolute_covariance_m2 is not None
    full = covariance_matrices(moved.labels.absolute_covariance_m2)[:, :2, :2]
    square = np.einsum("ni,ni->n", off, np.linalg.solve(full, off[:, :, None])[:, :, 0])
    assert np.mean(square < -2.0 * math.log(0.01)) > 0.9
    few, _ = apply_control(map_of(mapped), surveyed(truth[near[:5]], sigma_m=np.full(5, 0.03)))
    assert few.run["control"]["turn_sigma_deg"] is None


def test_a_height_that_is_not_told_is_as_well_known_as_before() -> None:
    truth = labels_around(6)
    result = map_of(truth - SHIFT)
    absolute_m2 = result.labels.covariance_m2 + np.array([0.5, 0.0, 0.0, 0.5, 0.0, 0.25])
    result = replace(result, labels=result.labels.replace(absolute_covariance_m2=absolute_m2))
    for has_height in (False, True):
        moved, _ = apply_control(result, surveyed(truth[:20], has_height=has_height))
        assert moved.labels.absolute_covariance_m2 is not None
        added = moved.labels.absolute_covariance_m2 - moved.labels.covariance_m2
        assert (added[:, [0, 3]] < 0.05).all()
        assert (added[:, 5] == pytest.approx(0.25)) if not has_height else (added[:, 5] < 0.05).all()
        assert (moved.run["control"]["shift_sigma_m"][2] is None) == (not has_height)


def test_what_points_do_not_tell_is_said_to_be_unknown() -> None:
    truth = labels_around(6)
    moved, _ = apply_control(map_of(truth - SHIFT), surveyed(truth[:20], has_height=False))
    said = worded("control", summarize_map(moved)["control"])
    assert re.search(r"shift_sigma_m [0-9.]+ [0-9.]+ unknown,", said)
    assert re.search(r"shift_east_north_up_m -?[0-9.]+ -?[0-9.]+ 0,", said)


def test_points_without_heights_leave_the_heights() -> None:
    truth = labels_around(6)
    result = map_of(truth - SHIFT)
    moved, _ = apply_control(result, surveyed(truth[:20], has_height=False))
    assert moved.labels.position_in_world_m[:, 2] == pytest.approx(result.labels.position_in_world_m[:, 2], abs=1e-9)
    assert moved.labels.position_in_world_m[:, :2] == pytest.approx(truth[:, :2], abs=0.05)


def test_points_of_which_some_have_heights_move_the_heights_by_these() -> None:
    truth = labels_around(6)
    result = map_of(truth - SHIFT + np.random.default_rng(6).normal(0.0, 0.05, (60, 3)))
    places, known = truth[:20].copy(), np.arange(20) < 12
    places[~known, 2] = 1000.0  # Means nothing.
    points = surveyed(places, has_height=False, is_height_known=known)
    moved, _ = apply_control(result, points)
    assert np.abs(np.array(moved.run["control"]["shift_east_north_up_m"]) - SHIFT).max() < 0.1
    assert moved.run["control"]["matched"] == 20
    assert moved.run["control"]["left_out"]["rmse_vertical_m"] < 0.2
    known = np.arange(20) < 2
    moved, _ = apply_control(result, replace(points, is_height_known=known))
    assert moved.run["control"]["matched"] == 20
    assert moved.run["control"]["shift_east_north_up_m"][2] == 0.0


@pytest.mark.parametrize("name", ["height", "z", "Elevation", "altitude"])
def test_heights_of_a_file_have_several_names_and_may_be_missing(name: str, tmp_path: Path) -> None:
    truth = labels_around(7, 8)
    places = lon_lat_height_from_enu(truth, ANCHOR)
    lines = [f"{lat:.9f},{lon:.9f},{height if i else ''}" for i, (lon, lat, height) in enumerate(places)]
    file = tmp_path / "points.csv"
    file.write_text("\n".join([f"lat,lon,{name}", *lines]) + "\n")
    result = map_of(truth - SHIFT, frame=Frame(anchor=ANCHOR), lon_lat_height=places)
    points = read_truth(file, result)
    assert isinstance(points, TrueObjects)
    assert not points.has_height
    assert points.knows_height.sum() == 7
    assert points.notes == ("1 of 8 objects have no height",)
    moved, _ = apply_control(result, points)
    assert np.array(moved.run["control"]["shift_east_north_up_m"]) == pytest.approx(SHIFT, abs=1e-3)


def test_a_file_of_points_has_geographic_places_and_deviations(tmp_path: Path) -> None:
    places = lon_lat_height_from_enu(labels_around(7, 5), ANCHOR)
    lines = [f"{lat:.9f},{lon:.9f},{height:.3f},{0.02 if i else ''}" for i, (lon, lat, height) in enumerate(places)]
    file = tmp_path / "points.csv"
    file.write_text("\n".join(["lat,lon,height,sigma", *lines]) + "\n")
    result = map_of(labels_around(7, 5) - SHIFT, frame=Frame(anchor=ANCHOR), lon_lat_height=places)
    points = read_truth(file, result)
    assert isinstance(points, TrueObjects)
    assert points.sigma_m is not None
    assert np.isnan(points.sigma_m).sum() == 1
    moved, _ = apply_control(result, points)
    assert moved.labels.lon_lat_height is not None
    assert moved.labels.lon_lat_height[:, :2] == pytest.approx(places[:, :2], abs=1e-6)


def test_a_layer_of_points_has_deviations_too(tmp_path: Path) -> None:
    import geopandas

    places = lon_lat_height_from_enu(labels_around(7, 5), ANCHOR)
    sigma = [0.02] * (len(places) - 1) + [None]
    points = geopandas.points_from_xy(*places.T)
    geopandas.GeoDataFrame({"SIGMA": sigma}, geometry=points, crs="EPSG:4326").to_file(tmp_path / "points.gpkg")
    found = read_truth(tmp_path / "points.gpkg", map_of(labels_around(7, 5), frame=Frame(anchor=ANCHOR)))
    assert isinstance(found, TrueObjects)
    assert found.sigma_m is not None
    assert sorted(found.sigma_m[~np.isnan(found.sigma_m)].tolist()) == [0.02] * (len(places) - 1)


@pytest.mark.parametrize("columns", ["x,y,z", "lat,lon,height"])
@pytest.mark.parametrize(("sigma", "shown"), [("-1", "-1"), ("0", "0"), ("1e30", "1e+30"), ("100.5", "100.5")])
def test_a_deviation_that_is_none_is_refused_with_its_row(columns: str, sigma: str, shown: str, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text(f"{columns},sigma\n1,2,3,100\n4,5,6,\n7,8,9,{sigma}\n")
    told = rf"points\.csv row 2: sigma: expected above 0 and at most 100 \(m\), or no value, found {re.escape(shown)} "
    with pytest.raises(InputError, match=told):
        read_truth(file, map_of(labels_around(7, 5), frame=Frame(anchor=ANCHOR)))


def test_the_command_moves_map_and_written_poses_alike(tmp_path: Path) -> None:
    config = SimulationConfig(streets_north_south=2, streets_east_west=2, lookalikes_per_light=0.0)
    dataset = replace(simulate(config, seed=1), frame=Frame(anchor=ANCHOR))
    assert dataset.truth is not None
    write_dataset(dataset, tmp_path / "data")
    places = lon_lat_height_from_enu(dataset.truth.position_in_world_m + SHIFT, ANCHOR)
    rows = [",".join(f"{v:.9f}" for v in place) for place in places]
    (tmp_path / "points.csv").write_text("\n".join(["lon,lat,height", *rows, "0,0,0"]) + "\n")
    done = map_in(tmp_path, "--write-poses", tmp_path / "better", "--control", tmp_path / "points.csv")
    assert done.exit_code == 0, done.stderr
    result, better = read_map(tmp_path / "map"), read_dataset(tmp_path / "better")
    left_out = f"1 of {len(rows) + 1} objects lie at longitude 0, latitude 0 and are left out"
    assert left_out in result.run["notes"]
    assert left_out in " ".join(done.stderr.split())
    shift = np.array(result.run["control"]["shift_east_north_up_m"])
    assert np.abs(shift - SHIFT)[:2].max() < 0.25
    assert result.labels.absolute_covariance_m2 is not None
    assert result.run["dataset_folder"] == "../better"
    assert (tmp_path / "better" / "colmap" / "points3D.txt").is_file()
    moved = better.images.cam_from_world_m - dataset.images.cam_from_world_m
    assert np.linalg.norm(moved, axis=1) == pytest.approx(np.linalg.norm(shift), abs=0.02)


def test_control_points_are_looked_at_before_anything_is_mapped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map may take hours; a file whose columns have other names is known at once."""
    write_dataset(simulate(SimulationConfig(streets_north_south=2, streets_east_west=2), seed=1), tmp_path / "data")
    (tmp_path / "points.csv").write_text("X,Y\n1,2\n")
    monkeypatch.setattr("valuemap.cli.map.build_map_of_folder", lambda *_, **__: pytest.fail("it was mapped"))
    done = map_in(tmp_path, "--control", tmp_path / "points.csv")
    assert "points.csv: expected columns lon, lat or x, y, z, found x, y" in done.stderr
    assert isinstance(done.exception, SystemExit)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("no.csv", "no.csv: no such file"),
        ("data", "data: is a folder, expected a table of objects"),
        ("data/images.txt", "images.txt: control points of an unknown kind: .txt"),
    ],
)
def test_control_that_is_no_table_is_one_line(name: str, told: str, tmp_path: Path) -> None:
    write_dataset(simulate(SimulationConfig(streets_north_south=2, streets_east_west=2), seed=1), tmp_path / "data")
    (tmp_path / "data" / "images.txt").write_text("x,y,z\n")
    done = map_in(tmp_path, "--control", tmp_path / name)
    assert done.exit_code != 0
    assert told in done.stderr
    assert "hint: give a table of objects as one of .csv, .tsv, .parquet, .geojson, .json, .gpkg, .fgb," in done.stderr
    assert isinstance(done.exception, SystemExit)  # Nothing else gets out: no traceback.
    assert not (tmp_path / "map").exists()
