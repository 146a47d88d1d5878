"""Real street plans as cities of the simulator, on made-up plans of known answers."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

import real_layouts
from bound import cramer_rao_covariances, true_views
from layouts import BAND_HEIGHT_PX, DrivenStreets, dublin, routes_over_lanes, san_francisco, views_in_panoramas
from valuemap.arrays import Floats
from valuemap.cameras import cast_rays
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.simulate import Recording
from valuemap.simulate.streets import Hills

EXACT = {
    "pixel_noise_px": 0.0,
    "pixel_noise_share": 0.0,
    "position_white_m": 0.0,
    "position_drift_m": 0.0,
    "rotation_white_deg": 0.0,
    "rotation_drift_deg": 0.0,
}


def city_of_one_road(root: Path) -> Path:
    """Two lanes of 100 m east, one after the other, and back; signals at 90 m and 110 m that face the traffic."""

    def lane(name: str, successor: str, start_m: float, end_m: float, north_m: float) -> dict[str, object]:
        curve = [[start_m, north_m, 0.0], [end_m, north_m, 0.0]]
        return {"id": name, "length": 100.0, "succ": [successor], "curve": curve}

    def signal(east_m: float, north_m: float, ahead: float) -> dict[str, object]:
        # From the left to the right of who drives east (+1) or west (-1), then back below.
        sides = [(0.3, 16.0), (-0.3, 16.0), (-0.3, 15.0), (0.3, 15.0)]
        return {"boundary": [[east_m, north_m + ahead * aside, above] for aside, above in sides]}

    folder = root / "apollo_san_francisco"
    folder.mkdir(parents=True)
    lanes = [lane("a", "b", 0.0, 100.0, 0.0), lane("b", "c", 100.0, 200.0, 0.0)]
    lanes += [lane("c", "d", 200.0, 100.0, 5.0), lane("d", "a", 100.0, 0.0, 5.0)]
    signals = {"signals": [signal(110.0, -3.0, 1.0), signal(90.0, 8.0, -1.0)]}
    for name, content in (("lanes", lanes), ("signals", signals)):
        (folder / f"{name}.json").write_text(json.dumps(content), encoding="utf-8")
    return root


def city_of_panoramas(root: Path) -> Path:
    """A street of 200 m to the north with a panorama every 10 m in two months, and poles on both sides."""
    folder = root / "dublin_tl"
    folder.mkdir(parents=True)
    places = [(53.34 + 9e-5 * i, -6.25, month) for month in (4, 7) for i in range(20)]
    rows = [f"{lat:.7f},{lon},id{i},2017,{month}" for i, (lat, lon, month) in enumerate(places)]
    (folder / "gsvs_all.csv").write_text("\n".join(["lat,lon,panoid,year,month", *rows, ""]), encoding="utf-8")
    sides = ((1.1e-4, "\t"), (-1.1e-4, " "))  # Lines are separated by either.
    poles = [f"{-6.25 + side}{gap}{53.3403 + 3e-4 * i}" for i in range(4) for side, gap in sides]
    (folder / "DublinTL_2017.csv").write_text("\n".join(["lon lat", *poles, ""]), encoding="utf-8")
    return root


def exact(config: SimulationConfig) -> SimulationConfig:
    return dataclasses.replace(config, **EXACT, clutter_per_image=0.0, reflections_per_1000_images=0.0)  # type: ignore[arg-type]


def past_true_objects(dataset: Dataset) -> tuple[Floats, Floats]:
    """How far the ray of each detection of an object passes it, and how far the object is, m (N)."""
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    rays = cast_rays(dataset)
    row = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    place = dataset.truth.position_in_world_m[rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)]
    away = place - rays.core.center_in_world_m()[row]
    along = rays.core.direction_in_world()[row]
    return np.linalg.norm(np.cross(away, along), axis=1), np.linalg.norm(away, axis=1)


@pytest.fixture
def lanes(tmp_path: Path) -> Recording:
    folder = city_of_one_road(tmp_path) / "apollo_san_francisco"
    return san_francisco(folder, exact(SimulationConfig(relief_m=0.0, pass_length_m=400.0)), 1.0, seed=0)


def test_drives_go_over_lanes_and_see_signals_from_before_them(lanes: Recording) -> None:
    frames, seen = lanes.frames, lanes.sightings
    assert len(frames) in (204, 205)  # The way across to the lanes back counts as well.
    assert np.unique(np.abs(np.diff(frames.distance_m)).round(6)).tolist() == [2.0]
    off_m, away_m = past_true_objects(lanes.dataset)
    assert len(off_m) > 20
    assert off_m.max() < 1e-6
    east_m = frames.center_in_world_m[seen.frame_row, 0]
    assert np.all(np.where(seen.target_row == 0, east_m < 110.0, east_m > 90.0))
    assert set(seen.target_row.tolist()) == {0, 1}
    assert lanes.city.lights.size_m.round(6).tolist() == [[0.6, 1.0]] * 2
    assert np.all(lanes.city.lights.position_in_world_m[:, 2] == 5.0)
    assert np.all(away_m < lanes.config.max_sight_m + 5.0)


def test_routes_go_on_in_the_lane_that_was_driven_least() -> None:
    successors = {"a": ["b", "c"], "b": ["a"], "c": ["a"], "d": []}
    lanes = [{"id": name, "length": 100.0, "succ": after} for name, after in successors.items()]
    routes = routes_over_lanes(lanes, 6.0, 1000.0, seed=0)
    assert routes == routes_over_lanes(lanes, 6.0, 1000.0, seed=0)
    for here, there in (pair for route in routes for pair in itertools.pairwise(route)):
        assert lanes[there]["id"] in successors[str(lanes[here]["id"])]
    driven = np.bincount(np.concatenate(routes))
    assert abs(int(driven[1]) - int(driven[2])) <= 1
    assert 2400.0 <= 100.0 * driven.sum() < 3400.0


def test_houses_stand_where_nobody_drives() -> None:
    along = np.arange(0.0, 101.0)
    corner = np.concatenate([np.column_stack([along, 0.0 * along]), np.column_stack([100.0 + 0.0 * along, along])])
    flat = Hills(amplitude_m=0.0, wave_vector=np.zeros((1, 2)), phase_rad=np.zeros(1))
    nothing = np.empty(0)
    streets = DrivenStreets(nothing, nothing, 8.0, np.empty((0, 0, 4)), flat, corner)
    start = np.array([[10.0, 0.0]] * 4)
    end = np.array([[90.0, 5.0], [90.0, 8.2], [100.0, 60.0], [50.0, 40.0]])
    assert streets.is_hidden_by_houses(start, end).tolist() == [False, False, True, True]


@pytest.fixture
def panoramas(tmp_path: Path) -> Recording:
    config = exact(real_layouts.panorama_config(0.15))
    return dublin(city_of_panoramas(tmp_path) / "dublin_tl", config, 2017, 0.5, seed=1)


def test_panoramas_show_poles_in_their_true_directions(panoramas: Recording) -> None:
    dataset, heads = panoramas.dataset, panoramas.city.lights
    assert len(dataset.images) == 40
    assert dataset.images.timestamp_s is None
    assert 8 < len(heads) < 16
    poles, lower = heads.position_in_world_m[:8], heads.position_in_world_m[8:]
    of_pole = np.argmin(np.linalg.norm(lower[:, None, :2] - poles[:, :2], axis=2), axis=1)
    down_m = poles[of_pole] - lower
    assert np.all(down_m[:, :2] == 0.0)
    assert np.all((down_m[:, 2] >= 0.9) & (down_m[:, 2] <= 1.1))
    off_m, away_m = past_true_objects(dataset)
    assert len(off_m) > 100
    assert off_m.max() < 1e-6
    assert away_m.max() < 36.0
    assert np.abs(dataset.detections.center_px[:, 1] - 1024.0).max() < BAND_HEIGHT_PX / 2


def test_derivatives_in_panoramas_are_those_of_directions(panoramas: Recording) -> None:
    """Many panoramas with known poses bound an object as rays across which they tell would."""
    config = dataclasses.replace(panoramas.config, pixel_noise_px=10.0)
    views = views_in_panoramas(dataclasses.replace(panoramas, config=config))
    count = len(panoramas.city.lights)
    bound = cramer_rao_covariances(views, config, count)
    told = np.zeros((count, 3, 3))
    rays = cast_rays(panoramas.dataset)
    dataset = panoramas.dataset
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    row = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    objects = rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)
    away = dataset.truth.position_in_world_m[objects] - rays.core.center_in_world_m()[row]
    for one, way in zip(objects, away, strict=True):
        length_m, level_m = np.linalg.norm(way), np.hypot(way[0], way[1])
        across = np.array([-way[1], way[0], 0.0]) / level_m
        up = np.cross(way / length_m, across)
        for axis, distance_m in ((across, level_m), (up, length_m)):
            told[one] += np.outer(axis, axis) / (10.0 * 2.0 * np.pi / 4096.0 * distance_m) ** 2
    np.testing.assert_allclose(bound, np.linalg.inv(told), rtol=1e-6, atol=1e-12)


def test_pinholes_have_bounds_too(lanes: Recording) -> None:
    assert len(true_views(lanes)) > 20


def test_the_benchmark_writes_what_it_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "figures.json"
    city_of_panoramas(city_of_one_road(tmp_path))
    arguments = [str(tmp_path), "--seeds", "0", "--only", "sf 2 tours", "dublin 2017, 0.15 m", "--json", str(path)]
    monkeypatch.setattr("sys.argv", ["benchmarks/real_layouts.py", *arguments])
    assert real_layouts.main() == 0
    record = json.loads(path.read_text(encoding="utf-8"))
    assert [row["name"] for row in record["results"]] == ["sf 2 tours", "dublin 2017, 0.15 m"]
    assert record["results"][1]["objects"] == 8
    assert str(record["results"][1]["recall"]) in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["benchmarks/real_layouts.py", str(tmp_path / "nowhere")])
    assert real_layouts.main() == 1
    assert "give the folder" in capsys.readouterr().err
