"""The robust method on small scenes of known truth."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

import valuemap
import valuemap._core as _core
from block import SHORT_STREETS, block
from literal import Floats, Pinhole, Sighting
from scenes import FOCAL, HEIGHT, WIDTH, Scene, as_dataset
from valuemap.cameras import camera_centers
from valuemap.config import MapConfig, SimulationConfig
from valuemap.dataset import Dataset
from valuemap.errors import InputError
from valuemap.robust import Calibration, Noise, calibration_from_json, calibration_to_json
from valuemap.simulate import simulate
from valuemap.tables import Categories

INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
POSES_AS_THEY_ARE = MapConfig().with_settings(["correct_poses=0"])
"""Of cities where nothing is found that poses are off by: their maps are the same, and made in half the time."""
ALONG_X = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def drive(
    objects: Floats, *, passes: int = 2, seed: int = 0, noise_px: float = 0.5, offset_m: float = 0.0, stop: int = 0
) -> Dataset:
    """Passes along x past objects, each pass shifted by its own error; the first stands still for `stop` frames."""
    random = np.random.default_rng(seed)
    cameras: list[Pinhole] = []
    sightings: list[Sighting] = []
    names: list[str] = []
    for number in range(passes):
        error = random.normal(0.0, offset_m, 3)
        places = [*np.arange(0.0, 36.0, 2.0), *([10.0] * stop if number == 0 else [])]
        for x in sorted(places):
            center = np.array([x, -1.5 + 3.0 * number / passes, 1.6])
            true, recorded = (Pinhole(INTRINSICS, ALONG_X, -ALONG_X @ c) for c in (center, center + error))
            for place in objects:
                pixel, depth = true.project(place)
                if depth > 3.0 and 0 <= pixel[0] < WIDTH and 0 <= pixel[1] < HEIGHT and random.random() < 0.9:
                    sightings.append(Sighting(len(cameras), "light", pixel + random.normal(0.0, noise_px, 2)))
            cameras.append(recorded)
            names.append(f"pass-{number}")
    return as_dataset(Scene(cameras, sightings, objects), passes=names)


def nearest_m(result: valuemap.Map, objects: Floats) -> Floats:
    apart = np.linalg.norm(result.labels.position_in_world_m[:, None] - objects[None], axis=2)
    return np.asarray(apart.min(axis=0))


def test_twin_heads_stay_two() -> None:
    twins = np.array([[45.0, 4.0, 5.0], [45.0, 4.6, 5.0]])
    result = valuemap.build_map(drive(twins))
    assert len(result.labels) == 2
    assert nearest_m(result, twins).max() < 0.1


def test_what_seems_one_light_is_two_where_both_together_are_likelier() -> None:
    # Of two lights 2.5 m apart, each is seen by passes that hardly see the other: gains without drifts prefer one.
    config = SimulationConfig(
        streets_north_south=2,
        streets_east_west=2,
        signalised_share=1.0,
        passes_per_street=2,
        lookalikes_per_light=0.0,
    )
    dataset = simulate(config, seed=5)
    # One of them is seen by hardly more than one pass, as what stands there for a day is.
    config_of_map = POSES_AS_THEY_ARE.with_settings(["min_existence=0.1"])
    result = valuemap.evaluate_map(valuemap.build_map(dataset, config_of_map), dataset)
    assert (result.recall, result.precision) == (1.0, 1.0)


def test_one_light_of_passes_that_disagree_stays_one() -> None:
    """How far passes disagree is learned from five lights or more."""
    beside = [[50.0, -6.0, 4.0], [38.0, 7.0, 4.5], [60.0, 5.0, 4.2], [55.0, -7.0, 5.0], [64.0, -4.0, 4.0]]
    lights = np.array([[45.0, 4.0, 5.0], *beside])
    for seed in range(4):
        result = valuemap.build_map(drive(lights, passes=4, seed=seed, offset_m=0.25), POSES_AS_THEY_ARE)
        assert len(result.labels) == len(lights)
        assert result.labels.passes.min() >= 3


def test_standing_still_does_not_make_sure() -> None:
    """A hundred frames from one place tell hardly more of the position than one does."""
    light = np.array([[45.0, 4.0, 5.0], [50.0, -6.0, 4.0]])
    config = MapConfig().with_settings(["detection_sigma_px=0.5", "position_sigma_m=0.1", "rotation_sigma_deg=0.1"])
    moving = valuemap.build_map(drive(light), config).labels
    standing = valuemap.build_map(drive(light, stop=100), config).labels
    assert standing.votes.sum() > moving.votes.sum() + 100
    ratio = standing.covariance_m2[:, [0, 3, 5]] / moving.covariance_m2[:, [0, 3, 5]]
    assert ratio.min() > 0.5


def test_known_sigmas_of_images_are_used() -> None:
    light = np.array([[45.0, 4.0, 5.0]])
    dataset = drive(light)
    count = len(dataset.images)
    labels = {}
    for sigma in (0.02, 0.5):
        images = dataset.images.replace(position_sigma_m=np.full(count, sigma), rotation_sigma_rad=np.full(count, 1e-4))
        labels[sigma] = valuemap.build_map(dataclasses.replace(dataset, images=images)).labels
    assert labels[0.5].covariance_m2[0, 0] > 10.0 * labels[0.02].covariance_m2[0, 0]


def test_measured_ranges_pull_softly() -> None:
    """Exact ranges tighten the position along the view; wild ones with honest sigmas change little."""
    light = np.array([[45.0, 4.0, 5.0]])
    dataset = drive(light, passes=1, noise_px=1.0)
    plain = valuemap.build_map(dataset).labels
    rows = np.searchsorted(dataset.images.image_id, dataset.detections.image_id)
    true_range = np.linalg.norm(light[0] - camera_centers(dataset.images)[rows], axis=1)
    exact = dataset.detections.replace(range_m=true_range, range_sigma_m=np.full(len(rows), 0.05))
    tightened = valuemap.build_map(dataclasses.replace(dataset, detections=exact)).labels
    assert tightened.covariance_m2[0, 0] < 0.5 * plain.covariance_m2[0, 0]
    wild = dataset.detections.replace(range_m=true_range + 20.0, range_sigma_m=np.full(len(rows), 20.0))
    pulled = valuemap.build_map(dataclasses.replace(dataset, detections=wild)).labels
    moved = np.linalg.norm(pulled.position_in_world_m[0] - plain.position_in_world_m[0])
    assert moved < 3.0 * np.sqrt(plain.covariance_m2[0, [0, 3, 5]].sum())


def test_the_class_with_most_votes_has_the_place_and_others_do_not_vote() -> None:
    light = np.array([[45.0, 4.0, 5.0]])
    dataset = drive(light)
    mixed = ["sign" if i % 3 == 0 else "light" for i in range(len(dataset.detections))]
    detections = dataset.detections.replace(class_name=Categories.from_texts(mixed))
    result = valuemap.build_map(dataclasses.replace(dataset, detections=detections))
    assert result.labels.class_name.texts() == ["light"]
    lights = detections.detection_id[np.array(mixed) == "light"]
    assert np.isin(result.votes.detection_id, lights).all()
    assert result.labels.votes[0] > 0.9 * len(lights)


def test_a_detector_that_confuses_classes_makes_hardly_a_label_more() -> None:
    city = block(lookalikes_per_light=0.0, sign_row_spacing_m=30.0, class_confusion=0.15, **SHORT_STREETS)
    dataset = simulate(city, seed=5, name="block")
    result = valuemap.build_map(dataset, POSES_AS_THEY_ARE)
    score = valuemap.evaluate_map(result, dataset)
    assert score.recall > 0.9
    assert score.precision > 0.9  # 0.7 where each class is for itself.
    confusions = result.run["calibration"]["confusions"]
    assert confusions["traffic_sign"]["traffic_light"] == pytest.approx(0.15, abs=0.05)
    # Twelve lights are too few to tell: they are confused like all objects.
    assert confusions["traffic_light"]["traffic_sign"] == pytest.approx(0.15, abs=0.05)
    assert any("another class than their label's" in note for note in result.run["notes"])
    codes = dataset.detections.class_name.codes[
        np.searchsorted(dataset.detections.detection_id, result.votes.detection_id)
    ]
    of_label = result.labels.class_name.codes[np.searchsorted(result.labels.label_id, result.votes.label_id)]
    assert np.mean(codes != of_label) == pytest.approx(0.15, abs=0.05)
    assert np.sum(codes != of_label) == result.run["counts"]["votes_of_another_class"]


@pytest.fixture(scope="module")
def driven_block() -> tuple[Dataset, valuemap.Map]:
    dataset = simulate(block(passes_per_street=4, lookalikes_per_light=0.0, **SHORT_STREETS), seed=5, name="block")
    return dataset, valuemap.build_map(dataset, POSES_AS_THEY_ARE)


def test_it_beats_the_paper_on_a_city_with_pose_noise(driven_block: tuple[Dataset, valuemap.Map]) -> None:
    dataset, robust = driven_block
    ours = valuemap.evaluate_map(robust, dataset)
    paper = valuemap.evaluate_map(valuemap.build_map(dataset, MapConfig(method="paper")), dataset)
    assert ours.recall >= 0.95
    assert ours.precision >= 0.9 > paper.precision
    assert ours.duplicates <= 1 < paper.duplicates


def test_the_noise_is_estimated() -> None:
    """It is a third of what the estimation begins with."""
    small = {"position_white_m": 0.03, "position_drift_m": 0.03, "rotation_white_deg": 0.03, "rotation_drift_deg": 0.03}
    config = block(pixel_noise_px=0.5, pixel_noise_share=0.02, passes_per_street=3, **small)
    noise = valuemap.build_map(simulate(config, seed=5, name="block"), POSES_AS_THEY_ARE).run["counts"]["noise"]
    true_position = np.hypot(config.position_white_m, config.position_drift_m)
    true_rotation = np.radians(np.hypot(config.rotation_white_deg, config.rotation_drift_deg))
    true_far_px = np.hypot(config.pixel_noise_px, config.focal_px * true_rotation)
    rotation = np.hypot(noise["rotation_rad"], noise["rotation_drift_rad"])
    far_px = np.hypot(noise["detection_px"], config.focal_px * rotation)
    assert 0.5 < np.hypot(noise["position_m"], noise["position_drift_m"]) / true_position < 2.0
    assert 0.5 < far_px / true_far_px < 2.0


def test_a_noisy_detector_is_no_drive_that_turns() -> None:
    """Where images of several objects tell that the detector is off, passes do not turn by half of that."""
    poses = {"position_white_m": 0.03, "position_drift_m": 0.06, "rotation_white_deg": 0.03, "rotation_drift_deg": 0.03}
    detector = {"pixel_noise_px": 2.5, "pixel_noise_share": 0.0, "focal_px": 400.0}
    config = block(passes_per_street=3, **detector, **poses, **SHORT_STREETS)
    noise = valuemap.build_map(simulate(config, seed=5, name="block"), POSES_AS_THEY_ARE).run["counts"]["noise"]
    assert noise["rotation_drift_rad"] < 0.5 * config.pixel_noise_px / config.focal_px * np.sqrt(0.5)
    assert 0.4 < noise["position_drift_m"] / config.position_drift_m < 2.5


def test_existence_and_expected_views_are_told(driven_block: tuple[Dataset, valuemap.Map]) -> None:
    _, result = driven_block
    labels = result.labels
    assert labels.existence is not None
    assert labels.expected is not None
    assert np.all((labels.existence >= MapConfig().existence.min_existence) & (labels.existence <= 1.0))
    assert np.all(labels.expected >= labels.votes)


def test_a_stricter_existence_keeps_fewer() -> None:
    """Things that stood there during one pass only are believed a little."""
    dataset = simulate(block(temporary_per_1000_images=10.0), seed=4, name="block")
    known = ["detection_sigma_px=1.2", "position_sigma_m=0.12", "rotation_sigma_deg=0.15", "correct_poses=0"]
    configs = [MapConfig().with_settings([*known, f"min_existence={least}"]) for least in (0.0, 0.97)]
    kept = [len(valuemap.build_map(dataset, config).labels) for config in configs]
    assert kept[0] > kept[1] > 0


def test_a_calibration_of_another_version_is_refused() -> None:
    row = tuple(0.5 + number for number in range(sum(count for _, count in _core.CLASS_FIELDS)))
    noise = dict.fromkeys((each.name for each in dataclasses.fields(Noise)), 0.1)
    known = Calibration(Noise(**noise), Noise(), False, {"light": row}, row, {})
    value = calibration_to_json(known)
    assert calibration_from_json(value, source="run.json") == known
    fields = value["classes"]["light"]
    assert fields["recall"] == row[1]
    for name, changed in (
        ("recall", {key: number for key, number in fields.items() if key != "recall"}),
        ("score_edges", {**fields, "score_edges": fields["score_edges"][1:]}),
        ("score_edges", {**fields, "score_edges": 0.5}),
    ):
        told = f"run.json: is no calibration: expected [0-9]+ numbers as {name} of each class"
        with pytest.raises(InputError, match=told):
            calibration_from_json({**value, "classes": {"light": changed}}, source="run.json")


def test_what_is_not_known_of_a_class_is_null() -> None:
    row = [math.nan] * sum(count for _, count in _core.CLASS_FIELDS)
    value = calibration_to_json(Calibration(Noise(), Noise(), False, {"light": tuple(row)}, tuple(row), {}))
    assert value["pooled"]["farthest_m"] is None
    assert set(value["classes"]["light"]["score_edges"]) == {None}
    again = calibration_from_json(json.loads(json.dumps(value, allow_nan=False)), source="run.json")
    assert all(math.isnan(number) for number in again.pooled)


def test_cameras_that_stand_see_no_distance_and_tell_the_noise_all_the_same() -> None:
    """Four cameras on masts with 60 images each: what one of them sees from its place is no parallax."""
    random = np.random.default_rng(1)
    objects = np.stack([random.uniform(low, high, 12) for low, high in ((5.0, 60.0), (5.0, 30.0), (0.0, 4.0))], axis=1)
    focal_px, width, height = 1000.0, 1920, 1080
    intrinsics = np.array([[focal_px, 0.0, width / 2], [0.0, focal_px, height / 2], [0.0, 0.0, 1.0]])
    cameras: list[Pinhole] = []
    sightings: list[Sighting] = []
    size_px: list[float] = []
    passes: list[str] = []
    for number, (x, y) in enumerate(((0.0, 0.0), (40.0, 5.0), (20.0, 30.0), (60.0, 30.0))):
        center = np.array([x, y, 6.0])
        forward = np.array([30.0, 15.0, 2.0]) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        for _ in range(60):
            camera = Pinhole(intrinsics, rotation, -rotation @ center)
            for place in objects:
                pixel, depth = camera.project(place)
                if depth > 1.0 and 0 <= pixel[0] < width and 0 <= pixel[1] < height and random.random() < 0.85:
                    sightings.append(Sighting(len(cameras), "light", pixel + random.normal(0.0, 1.5, 2)))
                    size_px.append(0.8 * focal_px / depth * np.exp(random.normal(0.0, 0.1)))
            cameras.append(camera)
            passes.append(f"mast {number}")
    dataset = as_dataset(Scene(cameras, sightings, objects), passes=passes)
    sizes = np.repeat(np.array(size_px)[:, None], 2, axis=1)
    whole = np.array([focal_px, focal_px, width / 2, height / 2])
    one = dataclasses.replace(dataset.cameras, width_px=np.array([width]), height_px=np.array([height]), params=[whole])
    dataset = dataclasses.replace(dataset, cameras=one, detections=dataset.detections.replace(size_px=sizes))
    result = valuemap.build_map(dataset, POSES_AS_THEY_ARE)
    near = np.linalg.norm(result.labels.position_in_world_m[:, None] - objects[None], axis=2).min(axis=1)
    assert len(result.labels) == len(objects)
    assert near.max() < 0.3
    noise = result.run["counts"]["noise"]
    assert 1.0 < noise["detection_px"] < 2.0
    assert noise["position_drift_m"] < 0.05
