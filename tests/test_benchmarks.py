"""What the benchmarks compute besides the method: bounds and counts, on small cases of known answers."""

from __future__ import annotations

import dataclasses
import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import any_city
import dense
import fleets
import pictures
from block import block
from bound import (
    Views,
    cramer_rao_covariances,
    joint_cramer_rao_covariance,
    residual_covariance,
    true_views,
)
from cities import PASSING_KINDS, passing_things, reliability, seeds_from
from literal import Pinhole, Sighting
from more_data import part_of, reprojection_errors_px, tour_of_images
from scenes import Scene, as_dataset
from small_dataset import map_of
from still_poses import nothing_found
from valuemap import correction
from valuemap.arrays import Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.simulate import PRESETS, Recording, record_city
from valuemap.simulate.detector import KINDS
from valuemap.simulate.pose_errors import pose_errors
from valuemap.tables import Categories, Truth, TruthDetections, Votes


@pytest.fixture(scope="module")
def small_city() -> Recording:
    return record_city(dataclasses.replace(PRESETS["small"], passes_per_street=2), seed=0)


# The Cramer-Rao bound.


def information(views: Views, config: SimulationConfig, *, is_shared: bool) -> Floats:
    """What views of one object tell of it, with drift as six unknowns of each pass, or as more noise of each image."""
    white = config.position_white_m, np.radians(config.rotation_white_deg)
    drift = config.position_drift_m, np.radians(config.rotation_drift_deg)
    passes, number = np.unique(views.pass_row, return_inverse=True)
    normal = np.diag([0.0] * 3 + [1.0] * (6 * len(passes)))
    for i in range(len(views)):
        derivatives = views.of_point[i], views.of_turn[i]
        covariance = views.pixel_sigma[i] ** 2 * np.eye(2)
        for derivative, own, along in zip(derivatives, white, drift, strict=True):
            covariance += (own**2 + (0.0 if is_shared else along**2)) * derivative @ derivative.T
        row = np.zeros((2, len(normal)))
        row[:, :3] = views.of_point[i]
        if is_shared:
            row[:, 3 + 6 * number[i] :][:, :6] = np.hstack([derivatives[0] * drift[0], derivatives[1] * drift[1]])
        normal += row.T @ np.linalg.inv(covariance) @ row
    return np.asarray(np.linalg.inv(np.linalg.inv(normal)[:3, :3]))


@pytest.mark.parametrize(("length_m", "is_shared"), [(1e12, True), (1e-12, False)])
def test_the_bound_has_the_right_limits(small_city: Recording, length_m: float, is_shared: bool) -> None:
    """Drift that never changes in a pass is six more unknowns of it; drift that is forgotten at once is white."""
    config = dataclasses.replace(small_city.config, drift_length_m=length_m)
    views = true_views(small_city)
    views = views.take(np.diff(views.distance_m, append=np.inf) != 0.0)  # Where the car stands, drift stands as well.
    bound = cramer_rao_covariances(views, config, len(small_city.city.lights))
    for light in np.unique(views.object_row)[:5]:
        of_light = views.take(views.object_row == light)
        assert len(np.unique(of_light.pass_row)) > 1
        expected = information(of_light, config, is_shared=is_shared)
        np.testing.assert_allclose(bound[light], np.linalg.inv(expected), rtol=1e-6)


def test_objects_that_images_show_together_are_better_known_against_each_other(small_city: Recording) -> None:
    lights = len(small_city.city.lights)
    views = true_views(small_city)
    light = int(views.object_row[0])
    of_light = views.take(views.object_row == light)
    single = joint_cramer_rao_covariance(of_light, small_city.config, lights)
    alone = cramer_rao_covariances(of_light, small_city.config, lights)
    np.testing.assert_allclose(single[light, :, light], alone[light], rtol=1e-6)
    assert np.isinf(np.trace(single[(light + 1) % lights, :, (light + 1) % lights]))
    # Poses that are off by the same 10 m in a whole pass move all objects alike.
    config = dataclasses.replace(
        small_city.config,
        position_drift_m=10.0,
        drift_length_m=1e12,
        position_white_m=0.0,
        rotation_white_deg=0.0,
        rotation_drift_deg=0.0,
    )
    bound = joint_cramer_rao_covariance(views, config, lights)
    of_pass = views.object_row[views.pass_row == views.pass_row[0]]
    a, b = np.unique(of_pass)[:2]
    apart = bound[a, :, a] + bound[b, :, b] - bound[a, :, b] - bound[b, :, a]
    assert np.trace(bound[a, :, a]) > 1.0
    assert np.trace(apart) < 0.01 * np.trace(bound[a, :, a])


def test_residuals_scatter_as_the_bound_takes_them_to(small_city: Recording) -> None:
    """Over 500 draws of the simulator's own errors the residuals of one light in one pass have that covariance."""
    config, frames, lights = small_city.config, small_city.frames, small_city.city.lights
    views = true_views(small_city)
    views = views.take((views.object_row == views.object_row[0]) & (views.pass_row == views.pass_row[0]))
    views = views.take(np.arange(0, len(views), 3))
    rows = [
        int(np.flatnonzero((frames.pass_row == p) & (frames.distance_m == d))[0])
        for p, d in zip(views.pass_row, views.distance_m, strict=True)
    ]
    to_light = lights.position_in_world_m[views.object_row] - frames.center_in_world_m[rows]
    cam_from_world = frames.cam_from_world()[rows]
    random = np.random.default_rng(0)
    residuals = []
    for seed in range(500):
        shift, turn = pose_errors(frames, config, seed=seed)
        in_cam = np.einsum("nij,nj->ni", cam_from_world, to_light - shift[rows])
        turned = Rotation.from_rotvec(turn[rows]).apply(in_cam)
        exact = np.einsum("nij,nj->ni", cam_from_world, to_light)
        moved = config.focal_px * (turned[:, :2] / turned[:, 2:] - exact[:, :2] / exact[:, 2:])
        residuals.append((moved + random.normal(size=moved.shape) * views.pixel_sigma[:, None]).ravel())
    lower = np.linalg.cholesky(residual_covariance(views, config))
    scatter = np.cov(np.linalg.solve(lower, np.transpose(residuals)))
    assert len(scatter) >= 16
    np.testing.assert_allclose(scatter, np.eye(len(scatter)), atol=0.3)


def test_without_views_nothing_is_known(small_city: Recording) -> None:
    views = true_views(small_city)
    bound = cramer_rao_covariances(views.take(views.object_row != 0), small_city.config, len(small_city.city.lights))
    assert np.all(np.isinf(bound[0]))
    assert np.all(np.isfinite(bound[views.object_row[-1]]))


# What became of labels and objects.


def test_things_that_pass_by_have_a_label_if_most_of_its_voters_show_them() -> None:
    rates = {"temporary_per_1000_images": 5.0, "reflections_per_1000_images": 5.0}
    recording = record_city(dataclasses.replace(PRESETS["small"], **rates), seed=0)  # type: ignore[arg-type]
    kind, thing = recording.boxes.kind, recording.boxes.thing_row

    def rows(name: str, number: int) -> Ints:
        return np.flatnonzero((kind == KINDS.index(name)) & (thing == number))

    often = [int(np.argmax(np.bincount(thing[kind == KINDS.index(name)]))) for name in PASSING_KINDS]
    temporary, reflection = (rows(name, number) for name, number in zip(PASSING_KINDS, often, strict=True))
    light = np.flatnonzero(kind == KINDS.index("lights"))
    assert min(len(temporary), len(reflection)) >= 3

    def passing(*voters: Ints) -> dict[str, tuple[int, int]]:
        result = map_of(np.zeros((len(voters), 3)))
        every = np.concatenate(voters)
        votes = Votes(
            label_id=np.repeat(result.labels.label_id, [len(v) for v in voters]),
            detection_id=recording.dataset.detections.detection_id[every],
            image_id=recording.dataset.detections.image_id[every],
            residual_px=np.zeros(len(every)),
            residual_sigmas=np.zeros(len(every)),
        )
        labels = result.labels.replace(votes=np.array([len(v) for v in voters]))
        return passing_things(recording, dataclasses.replace(result, labels=labels, votes=votes))

    half = len(temporary)
    none = passing(light[:4])
    assert all(things > 1 and labelled == 0 for things, labelled in none.values())
    assert passing(temporary)["temporary"] == (none["temporary"][0], 1)
    assert passing(temporary, temporary)["temporary"] == (none["temporary"][0], 1)
    assert passing(temporary, reflection)["reflections"] == (none["reflections"][0], 1)
    assert passing(np.concatenate([temporary, light[:half]])) == none
    assert passing(np.concatenate([temporary, light[: half - 1]]))["temporary"][1] == 1


def test_reliability_counts_labels_by_their_existence() -> None:
    rows = reliability(np.array([0.5, 0.55, 0.95, 0.99, 1.0, 1.0]), np.array([True, False, False, True, True, True]))
    assert rows == [
        {"from": 0.5, "to": 0.6, "labels": 2, "real": 0.5},
        {"from": 0.9, "to": 0.99, "labels": 1, "real": 0.0},
        {"from": 0.99, "to": 1.0, "labels": 3, "real": 1.0},
        {"from": 0.9, "to": 1.0, "labels": 4, "real": 0.75},
    ]


# Dense scenes.


def test_a_label_is_right_within_3_of_its_sigmas_and_1_to_3_m() -> None:
    distance_m = np.array([0.9, 0.9, 1.1, 1.1, 2.9, 3.1])
    sigmas = np.array([2.0, 9.0, 2.9, 3.1, 2.9, 1.0])
    assert dense.is_right(distance_m, sigmas**2, (1.0, 3.0)).tolist() == [True, True, True, False, True, False]


def test_most_matches_come_first_then_the_least_distance() -> None:
    distance_m = np.array([[0.1, 0.9, 9.0], [0.2, 9.0, 9.0], [9.0, 0.4, 9.0]])
    rows, columns = dense.match_one_to_one(distance_m, distance_m < 1.0)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 0), (2, 1)]
    rows, columns = dense.match_one_to_one(distance_m[:2], distance_m[:2] < 1.0)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 1), (1, 0)]
    assert len(dense.match_one_to_one(np.empty((0, 3)), np.empty((0, 3), np.bool_))[0]) == 0


def test_the_small_part_of_a_scene_is_whole_in_itself() -> None:
    recording = dense.record_scene(dense.SCENES["posts-3"], 0, is_small=True)
    dataset, boxes = recording.dataset, recording.boxes
    assert dataset.truth_detections is not None
    assert 50 < len(dataset.images) == len(recording.frames) < 150
    assert np.array_equal(dataset.images.image_id[boxes.frame_row], dataset.detections.image_id)
    is_object = boxes.kind == KINDS.index("roadside")
    assert np.array_equal(dataset.detections.detection_id[is_object], dataset.truth_detections.detection_id)
    assert np.logical_and(*dense.objects_that_count(recording, dense.SCENES["posts-3"])).sum() > 20


# More data.


def test_the_first_tour_is_the_city_driven_once() -> None:
    twice = record_city(dataclasses.replace(PRESETS["small"], passes_per_street=2), seed=0)
    once = record_city(dataclasses.replace(PRESETS["small"], passes_per_street=1), seed=0).dataset
    first = part_of(twice.dataset, tour_of_images(twice) == 0)
    assert once.truth_detections is not None
    assert first.truth_detections is not None
    assert len(first.images) < len(twice.dataset.images)
    assert first.images.name.to_pylist() == once.images.name.to_pylist()
    assert np.array_equal(first.images.cam_from_world_m, once.images.cam_from_world_m)
    assert np.array_equal(first.detections.center_px, once.detections.center_px)
    assert np.array_equal(first.truth_detections.object_id, once.truth_detections.object_id)


def test_reprojection_errors_are_those_of_the_pinhole() -> None:
    """Labels 0.2 m too far right at 20 m and 0.1 m too low at 10 m, with a focal length of 500 px: both 5 px."""
    intrinsics = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    objects = np.array([[1.0, 2.0, 20.0], [-1.0, 1.0, 10.0], [0.0, 0.0, 15.0]])
    camera = Pinhole(intrinsics, np.eye(3), np.zeros(3))
    sightings = [Sighting(0, "light", camera.project(place)[0]) for place in objects]
    dataset = dataclasses.replace(
        as_dataset(Scene([camera], sightings, objects)),
        truth=Truth(np.arange(3), Categories.from_texts(["light"] * 3), objects),
        truth_detections=TruthDetections(np.array([0, 10, 20]), np.arange(3)),
    )
    labels = objects + [[0.2, 0.0, 0.0], [0.0, 0.1, 0.0], [9.0, 9.0, 9.0]]
    errors_px = reprojection_errors_px(dataset, labels, np.array([True, True, False]))
    np.testing.assert_allclose(errors_px, [5.0, 5.0])


# Fleets.


def test_a_shift_of_the_whole_map_costs_nothing_between_neighbours() -> None:
    place = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 40.0, 0.0], [200.0, 0.0, 0.0]])

    # Each object has a variance of 1 m² on each axis, and all of them 4 m² in common.
    bound_m2 = np.einsum("ab,ij->aibj", np.eye(4) + 4.0, np.eye(3))

    def outcome(error_m: Floats) -> fleets.Outcome:
        found = int(np.isfinite(error_m[:, 0]).sum())
        return fleets.Outcome(4, found, found, place, error_m, bound_m2, 100, 1.0)

    random = np.random.default_rng(0).standard_normal((4, 3))
    shifted = fleets.add_up([outcome(random + [3.0, 0.0, 0.0])], [outcome(random)])
    assert shifted["ratio_to_clean"] == 1.0
    assert shifted["recall"] == shifted["precision"] == 1.0
    assert shifted["position_rmse_m"] > 2.0
    doubled = fleets.add_up([outcome(2.0 * random)], [outcome(random)])
    assert doubled["ratio_to_clean"] == 2.0
    assert doubled["bound_between_neighbors_m"] == pytest.approx(6.0**0.5, abs=1e-4)
    # Pairs of (0, 1), (0, 2) and (1, 2) are near; without object 1 only (0, 2).
    missed = np.array(random)
    missed[1] = np.nan
    assert len(fleets.squared_errors_between(outcome(random), outcome(random))) == 3
    between = fleets.squared_errors_between(outcome(random), outcome(missed))
    np.testing.assert_allclose(between, [np.sum((random[0] - random[2]) ** 2)])


def test_what_the_gps_leaves_of_a_true_shape_is_its_place_turn_and_scale() -> None:
    random = np.random.default_rng(0)
    shape = random.uniform(0.0, 100.0, (40, 3))
    moved = 1.02 * shape @ Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix().T + [5.0, 6.0, 7.0]
    np.testing.assert_allclose(pictures.moved_onto(moved, shape), moved, atol=1e-9)
    # Of 120 numbers with noise of 1 a fit of seven takes seven.
    left = np.mean([
        ((pictures.moved_onto(noisy, shape) - shape) ** 2).sum()
        for noisy in shape + random.normal(0.0, 1.0, (200, *shape.shape))
    ])  # fmt: skip
    assert left == pytest.approx(7.0, abs=0.8)
    # Ways between positions know nothing of a shift of all; those of a longer shape are longer by that.
    street = np.column_stack([np.arange(0.0, 101.0, 10.0), np.zeros(11), np.zeros(11)])
    assert pictures.relative_errors(np.full((11, 3), 3.0), street).max() == 0.0
    np.testing.assert_allclose(pictures.relative_errors(0.01 * street, street), 0.5)


def test_seeds_are_numbers_and_ranges() -> None:
    assert seeds_from(["3", "100..102"]) == [3, 100, 101, 102]
    with pytest.raises(SystemExit, match="expected a whole number"):
        seeds_from(["a..b"])


# The scripts run.


def block_driven(passes: int) -> SimulationConfig:
    """Stands for the city of the benchmarks."""
    return block(passes_per_street=passes, lookalikes_per_light=0.0, frame_spacing_m=4.0, standing_interval_s=2.0)


def block_drawn(_random: np.random.Generator) -> dict[str, float]:
    """Stands for what is drawn."""
    drawn = dataclasses.asdict(block_driven(2))
    return {name: value for name, value in drawn.items() if value != getattr(SimulationConfig(), name)}


def test_a_drawn_city_is_one_that_the_simulator_takes_and_the_same_again() -> None:
    drawn = [any_city.draw(np.random.default_rng(seed)) for seed in range(100)]
    assert [any_city.draw(np.random.default_rng(seed)) for seed in range(100)] == drawn
    assert len({tuple(one.items()) for one in drawn}) == 100
    for one in drawn:
        dataclasses.replace(SimulationConfig(), **one)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("script", "arguments", "rows"),
    [
        ("robust", "--seeds 0 --passes 1", 1),
        ("robust", "--seeds 0 --passes 1 --method paper", 1),
        ("more_data", "--seeds 0 --tours 1 2", 2),
        ("fleets", "--seeds 1 --small --only clean", 1),
        ("dense", "--seeds 0 --small --radius 30 --only lamps-25", 1),
        ("any_city", "--seeds 0", 2),
        ("ablation", "--seeds 0 --passes 1 --without nothing", 1),
    ],
)
def test_a_benchmark_writes_what_it_found(
    script: str,
    arguments: str,
    rows: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """On one block instead of the city, whose poses stay."""
    monkeypatch.setattr(correction, "refine_poses", nothing_found)
    path = tmp_path / "figures.json"
    module = importlib.import_module(script)
    small_ones = {"city": block_driven, "SMALL": {"passes_per_street": 2}, "draw": block_drawn}
    for name, small in small_ones.items():
        if hasattr(module, name):
            monkeypatch.setattr(module, name, small)
    monkeypatch.setattr("sys.argv", [f"benchmarks/{script}.py", *arguments.split(), "--json", str(path)])
    module.main()
    record = json.loads(path.read_text(encoding="utf-8"))
    assert record["command"].startswith(f"python benchmarks/{script}.py {arguments}")
    assert [0.0 < row["recall"] <= 1.0 for row in record["results"]] == [True] * rows
    assert str(record["results"][-1]["recall"]) in capsys.readouterr().out
