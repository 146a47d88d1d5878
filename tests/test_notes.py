"""Notes on maps: each is told where it applies, and a good map has none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenes import as_dataset, random_scene
from small_dataset import map_of, small_dataset
from valuemap.anchor import heights_not_given
from valuemap.config import MapConfig
from valuemap.evaluate import evaluate_map
from valuemap.map_folder import Map
from valuemap.notes import (
    Findings,
    cameras_not_upright,
    classes_spelled_alike,
    close_twins,
    confused_classes,
    find_notes,
    implausible_size,
    no_labels,
    no_overlap,
    noise_at_bound,
    untested_covariances,
    unused_detections,
)
from valuemap.pipeline import build_map
from valuemap.readers.bearings import read_bearings
from valuemap.tables import Labels, Votes


def findings(result: Map, *, config: MapConfig | None = None, counts: dict[str, Any] | None = None) -> Findings:
    total = len(small_dataset().detections)
    counts = {"detections": total, "detections_without_label": total - len(result.votes), **(counts or {})}
    return Findings(2, config or MapConfig(), result.labels, result.votes, counts)


def with_votes(image_id: list[int], label_id: list[int]) -> Map:
    """Return a map of two labels with such votes."""
    plain = map_of([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], residual_px=[0.0] * len(image_id))
    votes: Votes = plain.votes.replace(image_id=np.array(image_id), label_id=np.array(label_id))
    images = small_dataset().images
    passes = [
        len(np.unique(images.pass_id.codes[np.isin(images.image_id, votes.image_id[votes.label_id == label])]))
        for label in (0, 1)
    ]
    return replace(plain, votes=votes, labels=plain.labels.replace(passes=np.array(passes)))


def sized(size_m: float) -> Map:
    plain = map_of([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [20.0, 0.0, 0.0]])
    labels: Labels = plain.labels.replace(object_width_m=np.full(3, size_m), object_height_m=np.array([size_m] * 3))
    return replace(plain, labels=labels)


def test_a_good_map_has_no_notes() -> None:
    scene = random_scene(3, images=40, objects=6, clutter=10)
    dataset = as_dataset(scene, passes=["one", "two"] * 20)
    assert build_map(dataset).run["notes"] == []


def test_an_empty_map_is_told_and_nothing_else_of_it() -> None:
    told = find_notes(findings(map_of([])))
    assert len(told) == 1
    assert told[0].startswith("no object was found")
    assert no_labels(findings(sized(1.0))) is None


def test_a_detector_that_confuses_classes_is_told() -> None:
    result = with_votes([10, 20, 30, 10], [0, 0, 0, 1])
    assert confused_classes(findings(result)) is None
    assert confused_classes(findings(result, counts={"votes_of_another_class": 0})) is None
    note = confused_classes(findings(result, counts={"votes_of_another_class": 1}))
    assert note is not None
    assert note.startswith("25.0 % of the votes are detections of another class")


@pytest.mark.parametrize(("votes", "told"), [(2, "60 % of the detections belong to no label"), (3, None)])
def test_most_detections_unused(votes: int, told: str | None) -> None:
    note = unused_detections(findings(with_votes([10, 20, 30][:votes], [0] * votes)))
    assert note is None if told is None else told in str(note)


@pytest.mark.parametrize(
    ("noise", "told"),
    [
        ({"position_m": 4.0, "position_drift_m": 3.0}, "position_m 5"),
        ({"position_m": 3.0, "position_drift_m": 3.0}, None),
        ({"detection_px": 30.0}, "detection_px 30"),
        ({"box_share": 0.15}, "box_share 0.15"),
        ({}, None),
    ],
)
def test_noise_at_its_bound(noise: dict[str, float], told: str | None) -> None:
    note = noise_at_bound(findings(sized(1.0), counts={"noise": noise}))
    assert note is None if told is None else told in str(note)


def test_the_bound_of_positions_grows_with_the_range() -> None:
    counts = {"noise": {"position_m": 0.4, "position_drift_m": 0.3}}
    of_a_room = findings(sized(1.0), config=MapConfig(max_range_m=6.0), counts=counts)
    assert "position_m 0.5)" in str(noise_at_bound(of_a_room))
    assert noise_at_bound(findings(sized(1.0), counts=counts)) is None


def test_noise_that_was_given_is_at_no_bound() -> None:
    config = MapConfig().with_settings(["position_sigma_m=5"])
    counts = {"noise": {"position_m": 4.0, "position_drift_m": 3.0}}
    assert noise_at_bound(findings(sized(1.0), config=config, counts=counts)) is None
    assert noise_at_bound(findings(sized(1.0))) is None  # The paper's method estimates none.


@pytest.mark.parametrize(
    ("size_m", "told"), [(0.04, "0.04 m large"), (0.06, None), (9.0, None), (11.0, "11 m large"), (0.0, None)]
)
def test_implausible_sizes(size_m: float, told: str | None) -> None:
    note = implausible_size(findings(sized(size_m)))
    assert note is None if told is None else told in str(note)


@pytest.mark.parametrize(
    ("away_m", "classes", "told"),
    [
        ([0.27, 0.0, 0.0], None, True),  # Together sqrt(0.08) = 0.283 m in x,
        ([0.29, 0.0, 0.0], None, False),
        ([0.0, 0.13, 0.0], None, True),  # sqrt(0.02) = 0.141 m in y,
        ([0.0, 0.15, 0.0], None, False),
        ([0.0, 0.0, 0.42], None, True),  # and sqrt(0.18) = 0.424 m in z.
        ([0.0, 0.0, 0.43], None, False),
        ([0.0, 0.0, 0.0], ["light", "sign", "light"], False),
    ],
)
def test_twins_are_closer_than_their_sigmas(away_m: list[float], classes: list[str] | None, told: bool) -> None:
    note = close_twins(findings(map_of([[5.0, 5.0, 5.0], [5.0 + step for step in away_m], [50.0, 0.0, 0.0]], classes)))
    assert (note is not None) == told
    if told:
        assert str(note).startswith("labels 0 and 1 are closer")


def test_all_pairs_of_twins_are_counted() -> None:
    assert "labels 0 and 1 and 2 more pairs" in str(close_twins(findings(map_of([[0.0, 0.0, 0.0]] * 3))))


@pytest.mark.parametrize(
    ("image_id", "label_id", "told"),
    [([10, 20, 30, 40], [0, 0, 1, 1], True), ([10, 20, 30, 40], [0, 0, 0, 1], False)],
)
def test_passes_without_overlap(image_id: list[int], label_id: list[int], told: bool) -> None:
    note = no_overlap(findings(with_votes(image_id, label_id)))
    assert (note is not None) == told


def test_a_single_pass_overlaps_with_nothing() -> None:
    result = with_votes([10, 20], [0, 1])
    assert no_overlap(replace(findings(result), passes=1)) is None


def test_covariances_that_no_second_pass_tests_are_told() -> None:
    result = with_votes([10, 20], [0, 1])
    assert untested_covariances(findings(result)) is None
    one_pass = replace(findings(result), passes=1)
    assert str(untested_covariances(one_pass)).startswith("all images are of one pass: standard deviations of labels")
    assert untested_covariances(one_pass) in find_notes(one_pass)
    none_stated = result.labels.replace(covariance_m2=np.zeros_like(result.labels.covariance_m2))
    assert untested_covariances(replace(one_pass, labels=none_stated)) is None
    assert untested_covariances(replace(findings(map_of([])), passes=1)) is None


@pytest.mark.parametrize(
    ("in_map", "in_truth", "told"),
    [
        ("traffic_light", "traffic light", "the truth has the class 'traffic light' and the map 'traffic_light'"),
        ("Light", "lights", "the truth has the class 'lights' and the map 'Light'"),
        ("light", "sign", "no class of the truth ('sign') is in the map ('light'): nothing can be matched"),
        ("light", "light", None),
    ],
)
def test_classes_of_truth_and_map_that_differ(in_map: str, in_truth: str, told: str | None, tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text(f"x,y,z,class\n0,0,0,{in_truth}\n")
    evaluation = evaluate_map(map_of([[0.0, 0.0, 0.0]], [in_map]), tmp_path / "truth.csv")
    notes = [note for note in evaluation.notes if "class" in note and "any class" not in note]
    assert [told in note for note in notes] == [True] if told else notes == []
    assert evaluation.true_positives == int(told is None)


def test_classes_that_are_spelled_alike_are_told() -> None:
    plain = map_of([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], ["traffic_light", "Traffic Light"])
    said = classes_spelled_alike(findings(plain))
    assert said is not None
    assert "'Traffic Light' and 'traffic_light'" in said
    assert classes_spelled_alike(findings(map_of([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], ["light", "sign"]))) is None
    assert classes_spelled_alike(findings(map_of([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]], ["-", "+"]))) is None


@pytest.mark.parametrize(
    ("height_m", "said"), [(-0.0004, "height 0.00 m"), (-0.0, "height 0.00 m"), (-1.5, "height -1.50 m")]
)
def test_no_height_is_minus_nothing(height_m: float, said: str) -> None:
    assert said in str(heights_not_given(np.full(100, height_m)))


@pytest.mark.parametrize(("height_m", "is_told"), [(9.9, True), (-9.9, True), (10.1, False), (115.0, False)])
def test_only_one_height_near_zero_is_taken_for_none(height_m: float, is_told: bool) -> None:
    assert (heights_not_given(np.full(100, height_m)) is not None) == is_told


def test_heights_that_were_not_measured_are_told() -> None:
    scene = random_scene(3, images=40, objects=6, clutter=10)
    dataset = as_dataset(scene, passes=["one", "two"] * 20)
    sigma_px = np.full(len(dataset.detections), np.nan)
    plain = replace(dataset, detections=dataset.detections.replace(vertical_sigma_px=sigma_px))
    assert build_map(plain).run["notes"] == []
    stated = np.where(np.arange(len(sigma_px)) < 9, 800.0, np.nan)
    bearings = replace(dataset, detections=dataset.detections.replace(vertical_sigma_px=stated))
    (note,) = build_map(bearings).run["notes"]
    assert note.startswith(f"9 of {len(sigma_px)} detections have a vertical_sigma_px")


@pytest.mark.parametrize(("step_m", "times"), [(0.0, 1), (0.01, 0)])
def test_heights_that_no_data_states_are_told(step_m: float, times: int, tmp_path: Path) -> None:
    """At the import and of the map, for what is exported names the ellipsoid."""
    rows = [f"51.{row:05d},0.1,{90 - row},{2.5 + step_m * row}" for row in range(12)]
    (tmp_path / "b.csv").write_text("\n".join(["lat,lon,bearing,height", *rows]) + "\n")
    told: list[str] = []
    notes = build_map(read_bearings(tmp_path / "b.csv", tell=told.append)).run["notes"]
    for said in (told, notes):
        assert sum("all cameras are at height 2.50 m, as where data states none" in note for note in said) == times


def test_quaternions_in_another_order_are_told() -> None:
    assert cameras_not_upright(np.array([1.0, 0.9, -0.2])) is None
    scene = random_scene(3, images=40, objects=6, clutter=10)
    dataset = as_dataset(scene, passes=["one", "two"] * 20)
    assert not any("on their side" in note for note in build_map(dataset).run["notes"])
    quaternion = np.ascontiguousarray(dataset.images.cam_from_world_quat[:, [1, 2, 3, 0]])
    spoiled = replace(dataset, images=dataset.images.replace(cam_from_world_quat=quaternion))
    assert any("cameras lie on their side" in note for note in build_map(spoiled).run["notes"])
