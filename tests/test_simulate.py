"""The simulator: sizes, exactness without noise, the noises one by one, and truth that is true."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from block import block
from told import Told
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers, colmap_camera, rotation_matrices
from valuemap.config import SimulationConfig
from valuemap.config.setting import declared
from valuemap.dataset import Dataset, check_dataset, read_dataset, rows_of, write_dataset, write_dataset_in_pieces
from valuemap.errors import SettingError
from valuemap.progress import silent
from valuemap.simulate import PRESETS, build_city, record_city, simulate, simulate_districts
from valuemap.simulate.detector import KINDS
from valuemap.simulate.drives import Frames, drive
from valuemap.simulate.paths import lay_path
from valuemap.simulate.pose_errors import _drift_along_passes
from valuemap.simulate.routes import route_at_random, routes_over_every_street
from valuemap.simulate.streets import DIRECTIONS, Streets
from valuemap.tables.table import table_to_arrow

SMALL = PRESETS["small"]

EXACT_POSES: dict[str, Any] = {
    "position_white_m": 0.0,
    "position_drift_m": 0.0,
    "rotation_white_deg": 0.0,
    "rotation_drift_deg": 0.0,
}
NOTHING_FALSE: dict[str, Any] = {
    "clutter_per_image": 0.0,
    "reflections_per_1000_images": 0.0,
    "temporary_per_1000_images": 0.0,
    "lookalikes_per_light": 0.0,
}
NOTHING_MISSED: dict[str, Any] = {
    "recall_mean": 1.0,
    "recall_sd": 0.0,
    "half_recall_height_px": 0.0,
    "occluded_share": 0.0,
}
EXACT_BOXES: dict[str, Any] = {"pixel_noise_px": 0.0, "pixel_noise_share": 0.0, "size_noise": 0.0}
PERFECT = EXACT_POSES | NOTHING_FALSE | NOTHING_MISSED | EXACT_BOXES


def changed(config: SimulationConfig, **settings: Any) -> SimulationConfig:
    return config.with_settings(f"{name}={value}" for name, value in settings.items())


@cache
def small(seed: int = 0, **settings: Any) -> Dataset:
    return simulate(changed(SMALL, **settings), seed=seed, name="small")


def tables_of(dataset: Dataset) -> list[Any]:
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    parts = (dataset.cameras, dataset.images, dataset.detections, dataset.truth, dataset.truth_detections)
    return [table_to_arrow(part) for part in parts]


def shown(dataset: Dataset) -> tuple[Ints, Ints]:
    """Rows (detection, object) of all detections of lights."""
    assert dataset.truth_detections is not None
    return dataset.truth_detections.detection_id, dataset.truth_detections.object_id


def sightings_of(dataset: Dataset) -> set[tuple[int, int]]:
    """Pairs (image, object) of all detections of lights."""
    detection, thing = shown(dataset)
    return set(zip(dataset.detections.image_id[detection].tolist(), thing.tolist(), strict=True))


def shows_nothing(dataset: Dataset) -> Ints:
    return np.setdiff1d(dataset.detections.detection_id, shown(dataset)[0])


def points_in_cam(dataset: Dataset, image: Ints, point: Floats) -> Floats:
    rotation = rotation_matrices(dataset.images)[image]
    in_cam: Floats = np.einsum("nij,nj->ni", rotation, point) + dataset.images.cam_from_world_m[image]
    return in_cam


def projected(dataset: Dataset, image: Ints, point: Floats) -> Floats:
    return np.asarray(colmap_camera(dataset.cameras, 0).img_from_cam(points_in_cam(dataset, image, point)))


def truth_in_cam(dataset: Dataset) -> tuple[Floats, Floats]:
    """True objects of the detections of lights, in camera axes and in pixels."""
    assert dataset.truth is not None
    detection, thing = shown(dataset)
    image, point = dataset.detections.image_id[detection], dataset.truth.position_in_world_m[thing]
    return points_in_cam(dataset, image, point), projected(dataset, image, point)


# --- sizes and repeatability


def test_the_same_seed_gives_the_same_dataset_and_another_one_does_not() -> None:
    first, again, other = simulate(SMALL, seed=5), simulate(SMALL, seed=5), simulate(SMALL, seed=6)
    assert all(a.equals(b) for a, b in zip(tables_of(first), tables_of(again), strict=True))
    assert not any(a.equals(b) for a, b in zip(tables_of(first)[1:], tables_of(other)[1:], strict=True))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_small_is_a_small_city_driven_several_times(seed: int) -> None:
    dataset = small(seed)
    assert dataset.truth is not None
    assert dataset.name == "small"
    assert 1_500 <= len(dataset.images) <= 3_100
    assert 20 <= len(dataset.truth) <= 40
    passes_of_light = np.unique(
        np.stack([shown(dataset)[1], dataset.images.pass_id.codes[dataset.detections.image_id[shown(dataset)[0]]]]),
        axis=1,
    )[0]
    assert np.all(np.bincount(passes_of_light, minlength=len(dataset.truth)) >= 2)
    check_dataset(dataset, source="small")


def test_sf_has_the_size_and_the_statistics_of_the_paper() -> None:
    dataset = simulate(PRESETS["sf"], seed=0)
    assert dataset.truth is not None
    assert len(dataset.images) == 12_048
    assert len(dataset.truth) == 183
    assert abs(len(dataset.detections) / 17_198 - 1.0) < 0.02
    in_image = np.bincount(dataset.detections.image_id, minlength=12_048)
    share = np.bincount(in_image, minlength=6) / 12_048
    paper = np.array([1587, 6231, 2389, 1346, 369]) / 12_048
    np.testing.assert_allclose(share[:5], paper, atol=0.15)

    cluster, clusters = clusters_of_50_m(camera_centers(dataset.images))
    assert abs(clusters / 172 - 1.0) < 0.15
    of_cluster = np.unique(np.stack([cluster, dataset.images.pass_id.codes]), axis=1)[0]
    assert np.mean(np.bincount(of_cluster) <= 3) > 0.6


def clusters_of_50_m(center: Floats) -> tuple[Ints, int]:
    """Each free image in turn takes all free images closer than 50 m; returns the cluster of each image."""
    tree = cKDTree(center)
    cluster, count = np.full(len(center), -1), 0
    for row in range(len(center)):
        if cluster[row] < 0:
            near = np.array(tree.query_ball_point(center[row], 50.0))
            cluster[near[cluster[near] < 0]] = count
            count += 1
    return cluster, count


def test_nyc_asks_for_the_size_of_the_paper() -> None:
    nyc = PRESETS["nyc"]
    assert (nyc.images, nyc.detections, nyc.lights) == (360_207, 547_689, 1_906)
    assert len(build_city(nyc, seed=0).lights) == 1_906


def test_ids_names_passes_and_times_are_in_order() -> None:
    images = small().images
    assert np.array_equal(images.image_id, np.arange(len(images)))
    assert images.timestamp_s is not None
    assert np.all(np.diff(images.timestamp_s) > 0.0)
    assert images.name[0].as_py() == "pass-0000/000000.jpg"
    names = images.name.to_pylist()
    assert len(set(names)) == len(names)
    assert [name.split("/")[0] for name in names] == images.pass_id.texts()
    days = [images.timestamp_s[images.pass_id.codes == code] // 86_400 for code in range(len(images.pass_id.names))]
    assert len({float(day) for of_pass in days for day in of_pass}) == len(days)
    assert np.all(np.diff(small().detections.image_id) >= 0)


def test_a_simulated_dataset_is_written_and_read_back(tmp_path: Path) -> None:
    write_dataset(small(), tmp_path / "city")
    back = read_dataset(tmp_path / "city")
    assert back.detections.center_px.tolist() == small().detections.center_px.tolist()
    assert back.images.pass_id.texts() == small().images.pass_id.texts()


def test_more_passes_leave_the_first_ones_as_they_were() -> None:
    few, many = small(passes_per_street=2), small(passes_per_street=5)
    assert few.truth is not None
    assert many.truth is not None
    assert table_to_arrow(few.truth).equals(table_to_arrow(many.truth))
    images, detections = len(few.images), len(few.detections)
    assert len(many.images) > 2 * images
    first = np.arange(images)
    assert np.array_equal(many.images.take(first).cam_from_world_quat, few.images.cam_from_world_quat)
    assert np.array_equal(many.images.take(first).cam_from_world_m, few.images.cam_from_world_m)
    assert np.array_equal(many.detections.center_px[:detections], few.detections.center_px)
    assert many.detections.image_id[detections] >= images


@pytest.mark.parametrize(
    ("settings", "same"),
    [
        ({"pixel_noise_px": 3.0, "size_noise": 0.4}, "sightings"),
        ({"clutter_per_image": 0.5, "lookalikes_per_light": 1.0, "temporary_per_1000_images": 20.0}, "sightings"),
        (EXACT_POSES, "detections"),
        ({"recall_mean": 0.6}, "images"),
    ],
)
def test_one_noise_does_not_reshuffle_another(settings: dict[str, Any], same: str) -> None:
    base, other = small(), small(**settings)
    if same == "sightings":
        assert sightings_of(base) == sightings_of(other)
        assert len(base.detections) != len(other.detections) or not np.array_equal(
            base.detections.center_px, other.detections.center_px
        )
    if same == "detections":
        assert table_to_arrow(base.detections).equals(table_to_arrow(other.detections))
    else:
        assert table_to_arrow(base.images).equals(table_to_arrow(other.images))


# --- exactness


def test_without_noise_the_truth_projects_exactly_onto_every_box() -> None:
    dataset = small(**PERFECT)
    detection, _ = shown(dataset)
    assert len(detection) == len(dataset.detections)
    in_cam, pixel = truth_in_cam(dataset)
    assert np.all(in_cam[:, 2] > 0.0)
    np.testing.assert_allclose(pixel, dataset.detections.center_px, atol=1e-7)
    np.testing.assert_allclose(dataset.detections.size_px[:, 1], 500.0 * 1.0 / in_cam[:, 2], rtol=1e-9)
    assert np.all(dataset.detections.size_px[:, 0] <= 0.35 * dataset.detections.size_px[:, 1] * (1.0 + 1e-9))


def test_without_misses_exactly_the_lights_in_view_are_detected() -> None:
    """All pairs, walking each line of sight in small steps."""
    far = {"keep_before_signal_m": 300.0, "max_sight_m": 300.0, "min_box_height_px": 1.0, "max_facing_deg": 88.0}
    settings = PERFECT | far | {"frame_spacing_m": 10.0, "passes_per_street": 1, "red_light_share": 0.0}
    dataset, config = small(**settings), changed(SMALL, **settings)
    city = build_city(config, seed=0)
    lights, center = city.lights.position_in_world_m, camera_centers(dataset.images)
    image = np.repeat(np.arange(len(center)), len(lights))
    light = np.tile(np.arange(len(lights)), len(image) // len(lights))
    in_cam = points_in_cam(dataset, image, lights[light])
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel, height = 500.0 * in_cam[:, :2] / in_cam[:, 2:] + [320.0, 240.0], 500.0 / in_cam[:, 2]
    to_light = lights[light] - center[image]
    distance = np.hypot(to_light[:, 0], to_light[:, 1])
    facing = city.lights.facing_rad[light]
    cosine = -(to_light[:, 0] * np.cos(facing) + to_light[:, 1] * np.sin(facing)) / distance
    half = np.stack([0.35 * height * np.maximum(cosine, 0.3), height], axis=1) / 2.0
    in_view = (
        (in_cam[:, 2] > 1.0)
        & (height >= config.min_box_height_px)
        & (distance <= config.max_sight_m)
        & (cosine >= np.cos(np.radians(config.max_facing_deg)))
        & np.all((pixel - half >= 0.0) & (pixel + half <= [640.0, 480.0]), axis=1)
    )
    image, light = image[in_view], light[in_view]
    hidden = hidden_in_steps(city.streets, center[image, :2], lights[light, :2])
    assert 10 < np.count_nonzero(hidden) < len(hidden) / 2
    expected = set(zip(image[~hidden].tolist(), light[~hidden].tolist(), strict=True))
    assert expected == sightings_of(dataset)


def hidden_in_steps(streets: Streets, start: Floats, end: Floats) -> Bools:
    steps = np.linspace(0.0, 1.0, 1501)[None, :, None]
    points = start[:, None] + steps * (end - start)[:, None]
    off_axis = [np.abs(points[..., i, None] - axes).min(axis=-1) for i, axes in enumerate((streets.x_m, streets.y_m))]
    return np.asarray(np.any(np.minimum(*off_axis) > streets.half_width_m, axis=1))


@pytest.mark.parametrize(
    ("start", "end", "hidden"),
    [
        ((-60.0, 0.0), (180.0, 0.0), False),  # along a street
        ((40.0, -5.0), (160.0, 5.0), False),
        ((100.0, -200.0), (100.0, 400.0), False),
        ((50.0, 0.0), (100.0, 50.0), True),  # round a corner
        ((85.0, 0.0), (100.0, 15.0), False),  # a short cut over an intersection
        ((50.0, 0.0), (50.0, 100.0), True),  # through a block, along its middle
        ((-60.0, 0.0), (0.0, 60.0), True),  # through the houses at the edge of the city
        ((0.0, 0.0), (100.0, 100.0), True),
    ],
)
def test_houses_hide_what_is_behind_them(start: tuple[float, float], end: tuple[float, float], hidden: bool) -> None:
    streets = build_city(changed(SMALL, street_width_m=26.0), seed=0).streets
    square = Streets(
        np.array([0.0, 100.0, 200.0]), np.array([0.0, 100.0]), streets.half_width_m, streets.popularity, streets.hills
    )
    for a, b in ((start, end), (end, start)):
        assert square.is_hidden_by_houses(np.array([a]), np.array([b])).tolist() == [hidden]
        assert hidden_in_steps(square, np.array([a]), np.array([b])).tolist() == [hidden]


# --- the city


def test_lights_hang_where_lights_hang() -> None:
    config = changed(SMALL, streets_north_south=14, streets_east_west=12, lights=0, relief_m=0.0)
    city = build_city(config, seed=2)
    position = city.lights.position_in_world_m
    assert np.all((position[:, 2] > 3.0) & (position[:, 2] < 6.0))
    off_axis = [np.abs(position[:, i, None] - axes) for i, axes in enumerate((city.streets.x_m, city.streets.y_m))]
    at = np.stack([o.argmin(axis=1) for o in off_axis], axis=1)
    assert np.max([o.min(axis=1) for o in off_axis]) < city.streets.half_width_m
    counts = np.unique(at, axis=0, return_counts=True)[1]
    assert counts.min() >= 3
    assert counts.max() <= 8
    assert len(counts) == round(config.signalised_share * 14 * 12)
    nearest = to_nearest(position)
    assert nearest.min() > 0.45
    assert 0.1 < np.mean(nearest < 0.95) < 0.7


def to_nearest(position: Floats) -> Floats:
    """Distance (N) from each to the nearest other."""
    distance = np.linalg.norm(position[:, None] - position, axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest: Floats = distance.min(axis=1)
    return nearest


def test_more_lights_than_mounts_still_hang_apart() -> None:
    city = build_city(
        changed(SMALL, lights=0, min_lights=24, max_lights=24, lights_per_approach=8, signalised_share=0.3), seed=0
    )
    position = city.lights.position_in_world_m
    assert len(position) == 24 * round(0.3 * 12)
    assert to_nearest(position).min() > 0.45


def test_hills_lift_streets_and_lights_alike() -> None:
    flat, hilly = small(relief_m=0.0, **EXACT_POSES), small(relief_m=5.0, **EXACT_POSES)
    heights = [camera_centers(d.images)[:, 2] for d in (flat, hilly)]
    np.testing.assert_allclose(heights[0], 1.6, atol=1e-9)
    assert np.ptp(heights[1]) > 3.0
    hills = build_city(changed(SMALL, relief_m=5.0), seed=0).streets.hills
    place = np.random.default_rng(0).uniform(0.0, 400.0, (50, 2))
    for axis in (0, 1):
        step = 1e-4 * np.eye(2)[axis]
        rise = (hills.height_m(place + step) - hills.height_m(place - step)) / 2e-4
        np.testing.assert_allclose(hills.slope(place)[:, axis], rise, atol=1e-6)


# --- the drives


def test_a_round_drives_every_street_once_in_each_direction() -> None:
    streets = build_city(SMALL, seed=0).streets
    for round_number in range(20):
        routes = routes_over_every_street(streets, SMALL, seed=0, round_number=round_number)
        driven = [
            (*route.intersection[i].tolist(), int(route.direction[i]))
            for route in routes
            for i in range(len(route.direction))
        ]
        assert sorted(driven) == [tuple(row) for row in np.argwhere(streets.can_leave()).tolist()]
        for route in routes:
            assert np.array_equal(np.diff(route.intersection, axis=0), DIRECTIONS[route.direction])
            assert np.all((np.diff(route.direction) % 4) != 2)


def test_rounds_are_few_long_passes() -> None:
    streets = build_city(SMALL, seed=0).streets
    passes = [len(routes_over_every_street(streets, SMALL, seed=0, round_number=i)) for i in range(20)]
    assert np.mean(passes) < 1.6
    short = changed(SMALL, pass_length_m=500.0)
    assert len(routes_over_every_street(streets, short, seed=0, round_number=0)) >= 5


def test_drives_at_random_never_turn_round_and_turn_as_often_as_asked() -> None:
    config = changed(SMALL, streets_north_south=30, streets_east_west=30, pass_length_m=3e5, turn_share=0.2, lights=0)
    streets = build_city(config, seed=0).streets
    route = route_at_random(streets, config, seed=0, pass_row=0)
    assert np.array_equal(np.diff(route.intersection, axis=0), DIRECTIONS[route.direction])
    turn = np.diff(route.direction) % 4
    assert not np.any(turn == 2)
    inner = np.all((route.intersection[1:-1] > 0) & (route.intersection[1:-1] < 29), axis=1)
    assert abs(np.mean(turn[inner] != 0) - 0.2) < 0.03


def test_main_streets_are_driven_more() -> None:
    config = changed(
        SMALL, streets_north_south=12, streets_east_west=12, pass_length_m=3e5, lights=0, main_street_pull=1.5
    )
    streets = build_city(config, seed=0).streets
    route = route_at_random(streets, config, seed=0, pass_row=0)
    east_west = route.intersection[:-1][route.direction % 2 == 0, 1]
    driven = np.bincount(east_west, minlength=12)
    popularity = streets.popularity[0, :, 0]
    assert driven[popularity.argsort()[-4:]].sum() > 3 * driven[popularity.argsort()[:4]].sum()


def test_cars_keep_right_and_turn_smoothly() -> None:
    streets = build_city(SMALL, seed=0).streets
    route = routes_over_every_street(streets, SMALL, seed=0, round_number=0)[0]
    path = lay_path(route, streets, 3.0)
    step = 0.01
    distance = np.arange(0.0, path.from_m[-1], step)
    ground, heading = path.walk(distance)
    forward = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    motion = np.diff(ground, axis=0) / step
    np.testing.assert_allclose(motion, (forward[1:] + forward[:-1]) / 2.0, atol=2e-3)
    turned = np.angle(np.exp(1j * np.diff(heading)))
    assert np.abs(turned).max() <= step / 6.0 + 1e-9

    middle = (path.from_m[:-1] + path.middle_at_m) / 2.0
    ground, heading = path.walk(middle)
    right = np.stack([np.sin(heading), -np.cos(heading)], axis=1)
    axis = streets.center_m(route.intersection[:-1])
    np.testing.assert_allclose(((ground - axis) * right).sum(axis=1), 3.0, atol=1e-9)


def test_cars_stand_at_red_lights_and_images_are_evenly_spaced_else() -> None:
    frames = frames_of(changed(SMALL, keep_before_signal_m=500.0))
    step_m, step_s = np.diff(frames.distance_m), np.diff(frames.time_s)
    same_pass = np.diff(frames.pass_row) == 0
    standing = same_pass & (step_m == 0.0)
    share = np.count_nonzero(standing) / len(frames)
    assert 0.1 < share < 0.5
    np.testing.assert_allclose(step_s[standing], SMALL.standing_interval_s, rtol=1e-6)
    assert np.all(frames.signal_ahead_m[1:][standing] < 100.0)
    np.testing.assert_array_equal(frames.center_in_world_m[1:][standing], frames.center_in_world_m[:-1][standing])
    moving = same_pass & ~standing
    assert np.median(step_m[moving]) == pytest.approx(SMALL.frame_spacing_m)
    no_reds = frames_of(changed(SMALL, red_light_share=0.0))
    assert np.all(np.diff(no_reds.distance_m)[np.diff(no_reds.pass_row) == 0] > 1.0)


def test_images_far_from_lights_are_dropped() -> None:
    near, far = frames_of(changed(SMALL, keep_before_signal_m=40.0)), frames_of(changed(SMALL, keep_before_signal_m=90))
    assert near.signal_ahead_m.max() <= 40.0 < far.signal_ahead_m.max() <= 90.0
    assert len(near) == np.count_nonzero(far.signal_ahead_m <= 40.0)
    assert len(small(keep_before_signal_m=40.0).images) == len(near)


def test_a_number_of_images_is_met_exactly_by_drives_at_random() -> None:
    dataset = small(passes_per_street=0, images=777, pass_length_m=600.0)
    assert len(dataset.images) == 777
    assert len(dataset.images.pass_id.names) > 2
    both = small(passes_per_street=1, images=2_000, pass_length_m=600.0)
    assert len(both.images) == 2_000
    assert len(small(passes_per_street=4, images=100).images) == 100


def test_a_number_of_detections_is_met_by_keeping_more_or_fewer_images() -> None:
    free = len(small().detections)
    for aim in (round(0.9 * free), round(1.04 * free)):
        assert abs(len(small(detections=aim).detections) / aim - 1.0) < 0.02


def frames_of(config: SimulationConfig, seed: int = 0) -> Frames:
    return drive(build_city(config, seed=seed), config, seed=seed, progress=silent)


# --- the errors of poses


def test_position_errors_have_the_size_asked_for() -> None:
    settings = {"streets_north_south": 10, "streets_east_west": 8, "lights": 0}
    noisy = simulate(changed(SMALL, **settings), seed=1)
    error = camera_centers(noisy.images) - camera_centers(
        simulate(changed(SMALL, **settings, **EXACT_POSES), seed=1).images
    )
    assert np.all(np.abs(error.std(axis=0) / 0.12 - 1.0) < 0.1)
    # A standing car's drift stands as well: what is left between two of its images is white.
    frames = frames_of(changed(SMALL, **settings), seed=1)
    standing = (np.diff(frames.distance_m) == 0.0) & (np.diff(frames.pass_row) == 0)
    assert np.all(np.abs(np.diff(error, axis=0)[standing].std(axis=0) / (0.072 * np.sqrt(2.0)) - 1.0) < 0.06)


def test_rotation_errors_have_the_size_asked_for() -> None:
    settings = {"streets_north_south": 10, "streets_east_west": 8, "lights": 0}
    noisy, exact = (
        Rotation.from_matrix(rotation_matrices(simulate(changed(SMALL, **settings, **extra), seed=1).images))
        for extra in ({}, EXACT_POSES)
    )
    error = np.degrees((noisy * exact.inv()).as_rotvec())
    assert np.all(np.abs(error.std(axis=0) / 0.15 - 1.0) < 0.1)


def test_drift_forgets_itself_over_its_length() -> None:
    count, step_m, length_m = 200_000, 2.0, 50.0
    distance: Floats = np.linspace(0.0, step_m * (count - 1), count)
    frames = line_of_frames(distance, np.zeros(count, dtype=np.int64))
    drift = _drift_along_passes(frames, length_m, np.random.default_rng(3).standard_normal((count, 2)))
    assert abs(drift.std() - 1.0) < 0.03
    for lag in (5, 25, 60):
        assert abs(np.mean(drift[lag:] * drift[:-lag]) - np.exp(-lag * step_m / length_m)) < 0.04


def test_drift_is_the_recursion_it_claims_to_be() -> None:
    random = np.random.default_rng(0)
    pass_row = np.sort(random.integers(0, 5, 300))
    distance: Floats = random.uniform(0.0, 400.0, 300)
    distance = distance[np.lexsort((distance, pass_row))]
    distance[20:30] = distance[20]
    normal = random.standard_normal((300, 3))
    expected = np.empty((300, 3))
    for i in range(300):
        if i == 0 or pass_row[i] != pass_row[i - 1]:
            expected[i] = normal[i]
        else:
            keep = np.exp(-(distance[i] - distance[i - 1]) / 40.0)
            expected[i] = keep * expected[i - 1] + np.sqrt(1.0 - keep**2) * normal[i]
    drift = _drift_along_passes(line_of_frames(distance, pass_row), 40.0, normal)
    np.testing.assert_allclose(drift, expected, atol=1e-12)


def line_of_frames(distance_m: Floats, pass_row: Ints) -> Frames:
    zeros, rows = np.zeros(len(distance_m)), np.arange(len(distance_m))
    points = np.zeros((len(zeros), 3))
    moved = (points, zeros, points, zeros)
    return Frames(pass_row, distance_m, zeros, zeros, points, zeros, zeros, 0 * rows, rows, *moved)


def test_sigmas_of_poses_are_written_on_demand() -> None:
    assert small().images.position_sigma_m is None
    assert small().images.rotation_sigma_rad is None
    images = small(write_pose_sigmas=1).images
    assert images.position_sigma_m is not None
    assert images.rotation_sigma_rad is not None
    np.testing.assert_allclose(images.position_sigma_m, 0.12)
    np.testing.assert_allclose(images.rotation_sigma_rad, np.radians(0.15))
    assert small(write_pose_sigmas=1, **EXACT_POSES).images.position_sigma_m is None


# --- the detector


def test_boxes_scatter_more_the_larger_they_are() -> None:
    settings = NOTHING_FALSE | NOTHING_MISSED | EXACT_POSES
    exact, noisy = small(**settings, **EXACT_BOXES), small(**settings, pixel_noise_px=1.0, pixel_noise_share=0.1)
    residual, size = by_sighting(noisy)[:, :2] - by_sighting(exact)[:, :2], by_sighting(exact)[:, 2:]
    sigma = np.hypot(1.0, 0.1 * size[:, 1])
    for group in (size[:, 1] < 8.0, size[:, 1] > 15.0):
        assert np.all(np.abs((residual[group] / sigma[group, None]).std(axis=0) - 1.0) < 0.06)
    stretch = np.log(by_sighting(noisy)[:, 2:] / size)
    assert np.all(np.abs(stretch.std(axis=0) / SMALL.size_noise - 1.0) < 0.06)


def by_sighting(dataset: Dataset) -> Floats:
    """Boxes (x, y, width, height) in the order of images, then objects."""
    detection, thing = shown(dataset)
    order = np.lexsort((thing, dataset.detections.image_id[detection]))
    return np.column_stack([dataset.detections.center_px, dataset.detections.size_px])[detection[order]]


def test_each_pass_has_a_recall_of_its_own() -> None:
    steady = NOTHING_FALSE | {"half_recall_height_px": 0.0, "occluded_share": 0.0, "pass_length_m": 400.0}
    in_view = small(**(steady | NOTHING_MISSED))
    for sd, low, high in ((0.0, 0.0, 0.05), (0.2, 0.14, 0.27)):
        found = small(**steady, recall_mean=0.7, recall_sd=sd)
        counts = [
            np.bincount(d.images.pass_id.codes[d.detections.image_id], minlength=len(d.images.pass_id.names))
            for d in (found, in_view)
        ]
        recall = (counts[0] / counts[1])[counts[1] > 100]
        assert len(recall) > 15
        assert abs(recall.mean() - 0.7) < (0.03 if sd == 0.0 else 0.15)
        assert low <= recall.std() < high


def test_small_boxes_are_found_less_often() -> None:
    settings = NOTHING_FALSE | EXACT_POSES | EXACT_BOXES | {"occluded_share": 0.0, "recall_mean": 1.0, "recall_sd": 0.0}
    in_view, found = small(**settings, half_recall_height_px=0.0), small(**settings, half_recall_height_px=8.0)
    heights = [d.detections.size_px[:, 1] for d in (in_view, found)]
    for low, high in ((7.5, 8.5), (15.0, 17.0)):
        counts = [np.count_nonzero((h > low) & (h < high)) for h in heights]
        expected = 1.0 - 2.0 ** -(((low + high) / 2.0 / 8.0) ** 2)
        assert abs(counts[1] / counts[0] - expected) < 0.06


def test_traffic_hides_lights_in_runs() -> None:
    settings = NOTHING_FALSE | EXACT_POSES | EXACT_BOXES | NOTHING_MISSED
    in_view, found = sightings_of(small(**settings)), sightings_of(small(**(settings | {"occluded_share": 0.3})))
    assert found < in_view
    assert abs(1.0 - len(found) / len(in_view) - 0.3) < 0.08
    hidden = in_view - found
    after_hidden = [(i + 1, j) in hidden for i, j in hidden if (i + 1, j) in in_view]
    assert np.mean(after_hidden) > 0.8


def test_true_detections_show_the_light_they_say() -> None:
    dataset = small()
    in_cam, pixel = truth_in_cam(dataset)
    detection, _ = shown(dataset)
    residual = pixel - dataset.detections.center_px[detection]
    height = 500.0 / in_cam[:, 2]
    pose_px = np.hypot(500.0 * 0.12 / in_cam[:, 2], 500.0 * np.radians(0.15))
    # Near the rim a shift along the ray and a turn move the picture more than in its middle.
    off_middle = 1.0 + (((pixel - [320.0, 240.0]) / 500.0) ** 2).sum(axis=1)
    sigma = np.sqrt(1.2**2 + (0.06 * height) ** 2 + (pose_px * off_middle) ** 2)
    sigmas = residual / sigma[:, None]
    assert np.abs(sigmas).max() < 6.0
    assert np.all(np.abs(sigmas.std(axis=0) - 1.0) < 0.15)


def test_scores_tell_lights_from_clutter_a_little() -> None:
    dataset = small(clutter_per_image=0.5)
    false, score = shows_nothing(dataset), dataset.detections.score
    assert score.min() >= 0.0
    assert score.max() <= 1.0
    assert 0.1 < score[shown(dataset)[0]].mean() - score[false].mean() < 0.3
    assert score[shown(dataset)[0]].min() < score[false].max()


# --- what is not there


def test_with_nothing_false_every_detection_shows_a_light() -> None:
    assert len(shows_nothing(small(**NOTHING_FALSE))) == 0
    assert len(shows_nothing(small())) > 0


def test_without_lookalikes_there_are_none() -> None:
    assert len(build_city(changed(SMALL, lookalikes_per_light=0.0), seed=0).lookalikes) == 0
    assert len(build_city(changed(SMALL, lookalikes_per_light=0.5), seed=0).lookalikes) == 15


def test_lookalikes_stay_for_all_passes_and_are_not_in_the_truth() -> None:
    settings = PERFECT | {"lookalikes_per_light": 0.5, "lookalike_recall": 0.5}
    dataset = small(**settings)
    lookalikes = build_city(changed(SMALL, **settings), seed=0).lookalikes.position_in_world_m
    false = shows_nothing(dataset)
    image = dataset.detections.image_id[false]
    of_all = np.stack([projected(dataset, image, np.broadcast_to(p, (len(image), 3))) for p in lookalikes])
    miss_px = np.linalg.norm(of_all - dataset.detections.center_px[false], axis=2)
    miss_px[np.isnan(miss_px)] = np.inf  # behind the camera
    assert miss_px.min(axis=0).max() < 1e-6
    pass_and_thing = np.unique(np.stack([miss_px.argmin(axis=0), dataset.images.pass_id.codes[image]]), axis=1)
    assert np.median(np.bincount(pass_and_thing[0])) >= 3
    assert dataset.truth is not None
    assert len(dataset.truth) == 30


def test_temporary_objects_are_met_by_one_pass() -> None:
    dataset = small(**(PERFECT | {"temporary_per_1000_images": 2.0, "temporary_recall": 1.0}))
    false = shows_nothing(dataset)
    passes, counts = np.unique(dataset.images.pass_id.codes[dataset.detections.image_id[false]], return_counts=True)
    assert len(false) > 20
    assert len(passes) <= 4
    assert counts.sum() == len(false)
    # They stand in the world: a car that drives up to one sees it grow.
    run = np.split(false, np.flatnonzero(np.diff(dataset.detections.image_id[false]) > 1) + 1)
    longest = max(run, key=len)
    assert np.ptp(dataset.detections.size_px[longest, 1]) > 3.0


def test_reflections_stay_where_they_are_in_the_picture() -> None:
    dataset = small(**(PERFECT | {"reflections_per_1000_images": 1.0, "reflection_images": 30.0}))
    false = shows_nothing(dataset)
    size = np.round(dataset.detections.size_px[false, 1], 9)
    sizes, of_reflection, counts = np.unique(size, return_inverse=True, return_counts=True)
    assert 1 <= len(sizes) <= 12
    assert counts.max() >= 10
    for number in range(len(sizes)):
        rows = false[of_reflection == number]
        assert len(np.unique(dataset.images.pass_id.codes[dataset.detections.image_id[rows]])) == 1
        assert np.all(np.ptp(dataset.detections.center_px[rows], axis=0) < 8.0)
        assert np.ptp(dataset.detections.image_id[rows]) < 60


def test_a_recording_tells_what_every_detection_shows() -> None:
    rates = {"clutter_per_image": 0.2, "temporary_per_1000_images": 5.0, "reflections_per_1000_images": 5.0}
    recording = record_city(changed(SMALL, lookalikes_per_light=1.0, **rates), seed=0)
    dataset, boxes = recording.dataset, recording.boxes
    assert dataset.truth_detections is not None
    assert np.array_equal(boxes.center_px, dataset.detections.center_px)
    assert np.array_equal(boxes.frame_row, dataset.detections.image_id)
    is_of = {kind: boxes.kind == code for code, kind in enumerate(KINDS)}
    assert np.array_equal(np.flatnonzero(is_of["lights"]), dataset.truth_detections.detection_id)
    passes = recording.frames.pass_row[boxes.frame_row]
    most_passes = {}
    for kind, rows in is_of.items():
        met = np.unique(np.stack([boxes.thing_row[rows], passes[rows]], axis=1), axis=0)[:, 0]
        most_passes[kind] = np.bincount(met).max(initial=0)
    assert (most_passes["clutter"], most_passes["reflections"], most_passes["temporary"]) == (1, 1, 1)
    assert min(most_passes["lights"], most_passes["lookalikes"]) > 2
    assert np.bincount(boxes.thing_row[is_of["clutter"]]).max() == 1
    reflection = boxes.take(is_of["reflections"])
    first = np.unique(reflection.thing_row, return_index=True)[1]
    assert np.array_equal(reflection.size_px, reflection.size_px[first][_number(reflection.thing_row)])


def _number(values: Ints) -> Ints:
    return np.unique(values, return_inverse=True)[1]


def test_clutter_comes_as_often_as_asked_and_everywhere() -> None:
    dataset = small(**(PERFECT | {"clutter_per_image": 0.4}))
    false = shows_nothing(dataset)
    assert abs(len(false) / len(dataset.images) - 0.4) < 0.05
    center = dataset.detections.center_px[false] / [640.0, 480.0]
    assert np.all(np.abs(center.mean(axis=0) - 0.5) < 0.05)
    assert np.all(np.abs(center.std(axis=0) - 12.0**-0.5) < 0.02)


# --- settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"passes_per_street": 0}, "nobody drives"),
        ({"min_lights": 9}, "min_lights"),
        ({"recall_sd": 0.4}, "recall_sd"),
        ({"recall_mean": 1.5}, "recall_mean"),
        ({"lights": 1000}, "6 intersections with 3 to 8 lights each have 18 to 48"),
        ({"detections": 100_000}, "the other settings give"),
        ({"recall_mean": 1e-9, "recall_sd": 0.0, **NOTHING_FALSE}, "nothing at all is detected"),
        ({"recal_mean": 0.5}, "no setting named 'recal_mean'"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=re.escape(message)) as error:
        simulate(changed(SMALL, **settings), seed=0)
    assert error.value.hint


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(SettingError, match="seed"):
        simulate(SMALL, seed=-1)


def test_progress_reaches_its_end() -> None:
    simulate(SMALL, seed=0, progress=(told := Told()))
    told.check("driving every street", "seeing lights")


def test_the_docs_list_every_setting_as_it_is() -> None:
    docs = (Path(__file__).parents[1] / "docs" / "simulator.md").read_text(encoding="utf-8")
    rows = [f"| `{s.name}` | {s.default} | {s.unit} | {s.effect} |" for s in declared(SimulationConfig)]
    assert [row for row in rows if row not in docs] == []


def test_districts_are_cities_side_by_side_one_after_the_other(tmp_path: Path) -> None:
    config = replace(block(), districts=3)
    alone = simulate(block(), seed=5)
    write_dataset_in_pieces(simulate_districts(config, seed=5), tmp_path / "city")
    city = read_dataset(tmp_path / "city")  # Ids are unique, and what they refer to is there.
    assert city.truth is not None
    assert city.truth_detections is not None
    assert alone.truth is not None
    for part, whole in ((alone.images, city.images), (alone.detections, city.detections), (alone.truth, city.truth)):
        first = (
            table_to_arrow(whole)
            .slice(0, len(part))
            .drop_columns([n for n in ("name", "pass_id", "class") if n in table_to_arrow(whole).column_names])
        )
        assert first.equals(table_to_arrow(part).select(first.column_names))
    assert len(set(city.images.name.to_pylist())) == len(city.images)
    # Objects are seen where they are, in all districts.
    image = rows_of(city.detections.image_id, city.images.image_id)
    image = image[rows_of(city.truth_detections.detection_id, city.detections.detection_id)]
    place = city.truth.position_in_world_m[city.truth_detections.object_id]
    x, y, z = (
        np.einsum("nij,nj->ni", rotation_matrices(city.images)[image], place) + city.images.cam_from_world_m[image]
    ).T
    f, _, cx, cy = city.cameras.params[0]
    pixel = np.stack([f * x / z + cx, f * y / z + cy], axis=1)
    seen = city.detections.center_px[rows_of(city.truth_detections.detection_id, city.detections.detection_id)]
    assert np.quantile(np.linalg.norm(pixel - seen, axis=1), 0.9) < 10.0
    # Each is a city of its own, a block away from the next.
    east_m, north_m = np.array([2 * config.block_east_m, 2 * config.block_north_m])
    district = np.array([int(name[len("district-")]) for name in city.images.pass_id.names])[city.images.pass_id.codes]
    center = [camera_centers(city.images)[district == number] for number in range(3)]
    assert np.allclose(center[1].mean(axis=0) - center[0].mean(axis=0), [east_m, 0.0, 0.0], atol=20.0)
    assert np.allclose(center[2].mean(axis=0) - center[0].mean(axis=0), [0.0, north_m, 0.0], atol=20.0)
    assert len({len(part) for part in center}) > 1
    with pytest.raises(SettingError, match="only one can be held"):
        simulate(config, seed=5)
