"""Evaluation: matching against a search of all matchings, recoverable objects against all pairs, and the figures."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import linear_sum_assignment

from small_dataset import ANCHOR, map_of, small_dataset
from valuemap.arrays import Floats
from valuemap.dataset import Dataset, Frame, write_dataset
from valuemap.errors import InputError, SettingError
from valuemap.evaluate import Evaluation, TrueObjects, evaluate_map, match_labels, recoverable_objects
from valuemap.evaluate.objects_file import read_objects_file
from valuemap.geodesy import accuracy_note, enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.map_folder import Map, write_map
from valuemap.tables import Categories, Truth, TruthDetections
from valuemap.tables.write import write_table
from valuemap.writers import export_map

JSON_NAMES = [
    "true_positives",
    "duplicates",
    "false_positives",
    "false_negatives",
    "recall",
    "precision",
    "position_rmse_m",
    "position_median_m",
    "horizontal_rmse_m",
    "vertical_rmse_m",
    "mean_reprojection_error_px",
]


def truth_of(positions: Any, classes: list[str] | None = None) -> Truth:
    position = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    names = classes if classes is not None else ["light"] * len(position)
    return Truth(np.arange(len(position)), Categories.from_texts(names), position)


def objects_of(positions: Floats, classes: list[str] | None = None) -> TrueObjects:
    return TrueObjects(
        np.arange(len(positions)), positions, None if classes is None else Categories.from_texts(classes)
    )


def counts(evaluation: Evaluation) -> tuple[int, int, int, int]:
    return (
        evaluation.true_positives,
        evaluation.duplicates,
        evaluation.false_positives,
        evaluation.false_negatives,
    )


# Exact cases.


def test_a_map_worked_out_by_hand() -> None:
    """Four labels: 0.3 m east and 0.4 m above its object, a duplicate of it, a false one, 1 m south of its object."""
    truth = truth_of([[0.0, 0.0, 5.0], [20.0, 0.0, 5.0], [40.0, 0.0, 5.0]])
    result = map_of(
        [[0.3, 0.0, 5.4], [0.0, 1.5, 5.0], [60.0, 0.0, 5.0], [20.0, -1.0, 5.0]], residual_px=[1.0, 2.0, 6.0]
    )
    evaluation = evaluate_map(result, truth)
    assert counts(evaluation) == (2, 1, 1, 1)
    assert (evaluation.labels, evaluation.objects, evaluation.recoverable_objects) == (4, 3, 3)
    assert evaluation.precision == 0.5
    assert evaluation.recall == pytest.approx(2 / 3)
    assert evaluation.position_rmse_m == pytest.approx(math.sqrt((0.25 + 1.0) / 2))
    assert evaluation.position_median_m == pytest.approx(0.75)
    assert evaluation.horizontal_rmse_m == pytest.approx(math.sqrt((0.09 + 1.0) / 2))
    assert evaluation.vertical_rmse_m == pytest.approx(math.sqrt(0.16 / 2))
    assert evaluation.mean_reprojection_error_px == pytest.approx(3.0)
    matches = evaluation.matches
    assert matches.label_outcome.texts() == ["true", "duplicate", "false", "true"]
    assert matches.object_outcome.texts() == ["found", "found", "missed"]
    assert_array_equal(matches.object_of_label, [0, -1, -1, 1])
    assert_array_equal(matches.label_of_object, [0, 3, -1])


@pytest.mark.parametrize("name", ["radius_m", "truth_sigma_m", "seen_within_m"])
def test_what_is_no_number_is_refused(name: str) -> None:
    options: dict[str, Any] = {name: "x"}
    with pytest.raises(SettingError, match="found 'x'"):
        evaluate_map(map_of([[0.0, 0.0, 5.0]]), small_dataset(), **options)


def test_labels_that_are_gone_do_not_count() -> None:
    """Of three labels that are there one is false; a gone one on an object neither takes it nor is false."""
    truth = truth_of([[0.0, 0.0, 5.0], [20.0, 0.0, 5.0]])
    places = [[0.0, 0.0, 5.0], [0.3, 0.0, 5.0], [60.0, 0.0, 5.0], [20.0, 0.0, 5.0], [90.0, 0.0, 5.0]]
    result = map_of(places, residual_px=[8.0, 2.0], existence=[0.7] * 5)
    state = Categories.from_texts(["gone", "confirmed", "uncertain", "new", "gone"])
    votes = result.votes.replace(label_id=np.array([0, 1]))
    result = dataclasses.replace(result, labels=result.labels.replace(state=state), votes=votes)
    evaluation = evaluate_map(result, truth)
    assert counts(evaluation) == (2, 0, 1, 0)
    assert (evaluation.labels, evaluation.completeness.excess_items) == (3, 1)
    assert evaluation.mean_reprojection_error_px == 2.0
    assert evaluation.reliability is not None
    assert evaluation.reliability[0].labels == 3
    assert "2 of 5 labels are gone (valuemap update found nothing there) and do not count" in evaluation.notes
    matches = evaluation.matches
    assert matches.label_outcome.texts() == ["gone", "true", "false", "true", "gone"]
    assert_array_equal(matches.object_of_label, [-1, 0, -1, 1, -1])
    assert_array_equal(matches.label_of_object, [1, 3])


def test_objects_that_are_there_twice_are_told() -> None:
    places = [[0.0, 0.0, 5.0], [0.0, 0.0, 5.0], [0.0, 0.0, 5.0], [20.0, 0.0, 5.0]]
    evaluation = evaluate_map(map_of(places[:1]), truth_of(places, ["light", "light", "sign", "light"]))
    assert (
        "1 of 4 objects stand exactly where another of its class stands, and count like any other" in evaluation.notes
    )
    assert evaluation.objects == 4
    alone = evaluate_map(map_of(places[:1]), truth_of(places[2:]))
    assert not any("stand exactly" in note for note in alone.notes)


def test_most_matches_come_before_the_nearest() -> None:
    """The label at 1 is nearest to the object at 1.2, but only that label reaches the object at -0.9."""
    matches = match_labels(
        map_of([[1.0, 0, 0], [3.1, 0, 0]]).labels, objects_of(np.array([[-0.9, 0, 0], [1.2, 0, 0]])), Frame()
    )
    assert_array_equal(matches.object_of_label, [0, 1])


def test_of_equally_many_matches_the_shortest_count() -> None:
    matches = match_labels(
        map_of([[0.0, 0, 0], [1.0, 0, 0]]).labels, objects_of(np.array([[0.9, 0, 0], [0.2, 0, 0]])), Frame()
    )
    assert_array_equal(matches.object_of_label, [1, 0])


def test_the_radius_itself_is_within() -> None:
    for radius_m, expected in ((2.0, (1, 0, 0, 0)), (1.999, (0, 0, 1, 1))):
        assert counts(evaluate_map(map_of([[2.0, 0, 0]]), truth_of([[0, 0, 0]]), radius_m=radius_m)) == expected


def test_a_label_on_the_spot_is_a_match() -> None:
    evaluation = evaluate_map(map_of([[1.0, 2, 3], [1.0, 2, 3]]), truth_of([[1, 2, 3]]))
    assert counts(evaluation) == (1, 1, 0, 0)
    assert evaluation.position_rmse_m == 0.0


def test_classes_do_not_mix() -> None:
    result = map_of([[0.0, 0, 0], [10.0, 0, 0]], ["light", "sign"])
    evaluation = evaluate_map(result, truth_of([[0, 0, 0], [10, 0, 0]], ["sign", "sign"]))
    assert counts(evaluation) == (1, 0, 1, 1)
    assert evaluation.matches.label_outcome.texts() == ["false", "true"]


def test_a_class_that_the_truth_does_not_know_is_false() -> None:
    assert counts(evaluate_map(map_of([[0.0, 0, 0]], ["tree"]), truth_of([[0, 0, 0]]))) == (0, 0, 1, 1)


def test_a_map_without_labels() -> None:
    evaluation = evaluate_map(map_of([]), truth_of([[0, 0, 0]]))
    assert counts(evaluation) == (0, 0, 0, 1)
    assert evaluation.recall == 0.0
    assert evaluation.to_json()["precision"] is None


def test_up_says_what_is_vertical() -> None:
    """With up = -y, an offset of 3 along y and 4 along z is 3 high and 4 far."""
    result = map_of([[0.0, 0.3, 0.4]], frame=Frame(up=(0.0, -1.0, 0.0)))
    evaluation = evaluate_map(result, truth_of([[0, 0, 0]]))
    assert evaluation.vertical_rmse_m == pytest.approx(0.3)
    assert evaluation.horizontal_rmse_m == pytest.approx(0.4)
    assert evaluation.position_rmse_m == pytest.approx(0.5)


# What is printed.


def test_json_has_exactly_the_documented_names() -> None:
    values = evaluate_map(map_of([[0.0, 0, 0]], residual_px=[1.5]), truth_of([[0, 0, 0]])).to_json()
    assert list(values) == [*JSON_NAMES, "accuracy", "completeness", "chance", "reliability"]
    assert values["mean_reprojection_error_px"] == 1.5


def test_json_of_nothing_is_null_and_not_nan() -> None:
    evaluation = evaluate_map(map_of([[9.0, 0, 0]]), truth_of([[0, 0, 0]]))
    parsed = json.loads(json.dumps(evaluation.to_json(), allow_nan=False))
    assert parsed["position_rmse_m"] is None
    assert parsed["mean_reprojection_error_px"] is None
    assert parsed["recall"] == 0.0


def test_the_documentation_names_what_json_prints() -> None:
    text = (Path(__file__).parents[1] / "docs" / "evaluation.md").read_text(encoding="utf-8")
    values = evaluate_map(map_of([[0.0, 0, 0]], existence=[0.9]), truth_of([[0, 0, 0]])).to_json()
    parts = [values[name] for name in ("accuracy", "completeness", "chance")]
    for name in [*values, *(name for part in [*parts, *values["reliability"]] for name in part)]:
        assert f"`{name}`" in text


def test_the_output_says_when_every_object_counts() -> None:
    dataset = small_dataset()
    result = map_of([[4.0, 25.0, 5.0]])
    (few,) = evaluate_map(result, dataset).notes
    assert few.startswith("1 check point: too few")
    note, _ = evaluate_map(result, Dataset(**{**vars(dataset), "truth_detections": None})).notes
    assert note.startswith("every true object counts as recoverable")


# The matching against slower ways.


def best_of_all_matchings(distance: Floats, radius_m: float) -> tuple[int, float]:
    """Try every one-to-one matching (labels x objects): most matches, then smallest sum."""
    labels, objects = distance.shape
    best = (0, 0.0)
    for size in range(1, min(labels, objects) + 1):
        for some_labels in itertools.combinations(range(labels), size):
            for some_objects in itertools.permutations(range(objects), size):
                parts = distance[list(some_labels), list(some_objects)]
                if np.all(parts <= radius_m) and (size > best[0] or parts.sum() < best[1]):
                    best = (size, float(parts.sum()))
    return best


points = st.lists(st.tuples(st.integers(0, 12), st.integers(0, 3)), max_size=4)


@settings(max_examples=150, deadline=None)
@given(points, points, st.sampled_from([0.5, 2.0, 3.0]))
def test_the_matching_is_the_best_of_all(
    labels: list[tuple[int, int]], objects: list[tuple[int, int]], radius_m: float
) -> None:
    label_points = np.array([(x / 2, y / 2, 0.0) for x, y in labels]).reshape(-1, 3)
    object_points = np.array([(x / 2, y / 2, 0.0) for x, y in objects]).reshape(-1, 3)
    matches = match_labels(map_of(label_points).labels, objects_of(object_points), Frame(), radius_m=radius_m)
    distance = np.linalg.norm(label_points[:, None] - object_points[None], axis=2)
    found = np.flatnonzero(matches.object_of_label >= 0)
    chosen = distance[found, matches.object_of_label[found]]
    assert len(set(matches.object_of_label[found])) == len(found)
    assert np.all(chosen <= radius_m)
    count, total = best_of_all_matchings(distance, radius_m)
    assert len(found) == count
    assert chosen.sum() == pytest.approx(total, abs=1e-9)


@pytest.mark.parametrize("radius_m", [1.0, 2.0, 8.0])
def test_a_large_matching_is_that_of_the_dense_algorithm(radius_m: float) -> None:
    """Crowded enough that most labels have several objects to choose from."""
    random = np.random.default_rng(8)
    objects = random.uniform(0.0, 25.0, (300, 3)) * [1.0, 1.0, 0.1]
    labels = np.concatenate([objects[:250], objects[:60]]) + random.normal(0.0, 0.6, (310, 3))
    matches = match_labels(map_of(labels).labels, objects_of(objects), Frame(), radius_m=radius_m)
    distance = np.linalg.norm(labels[:, None] - objects[None], axis=2)
    cost = np.where(distance <= radius_m, distance - 1e4, 0.0)
    rows, columns = linear_sum_assignment(cost)
    is_match = cost[rows, columns] < 0.0
    found = np.flatnonzero(matches.object_of_label >= 0)
    assert len(found) == is_match.sum()
    total = distance[rows, columns][is_match].sum()
    assert distance[found, matches.object_of_label[found]].sum() == pytest.approx(total, abs=1e-6)
    near = (distance <= radius_m).any(axis=1)
    expected = np.where(matches.object_of_label >= 0, "true", np.where(near, "duplicate", "false"))
    assert matches.label_outcome.texts() == expected.tolist()


def test_every_label_and_every_object_has_one_outcome() -> None:
    random = np.random.default_rng(4)
    objects = random.uniform(0.0, 60.0, (200, 3)) * [1, 1, 0.05]
    labels = np.concatenate([objects[:120] + random.normal(0.0, 0.7, (120, 3)), random.uniform(0.0, 60.0, (60, 3))])
    evaluation = evaluate_map(map_of(labels), truth_of(objects))
    assert evaluation.true_positives + evaluation.duplicates + evaluation.false_positives == 180
    assert evaluation.true_positives + evaluation.false_negatives == 200
    matches = evaluation.matches
    found = matches.object_of_label >= 0
    assert_array_equal(matches.label_of_object[matches.object_of_label[found]], np.flatnonzero(found))


# Recoverable objects.


def scene_of_views(centers: list[Floats], positions: Floats, *, same_image_twice: bool = False) -> Dataset:
    """Return a dataset in which object i is detected from centers[i] (n, 3), each view an image of its own."""
    base = small_dataset()
    center = np.concatenate(centers)
    ids = np.arange(len(center))
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (len(center), 1))
    object_id = np.repeat(np.arange(len(positions)), [len(c) for c in centers])
    images = type(base.images)(
        ids,
        pa.array([str(i) for i in ids]),
        np.ones_like(ids),
        identity,
        -center,
        Categories.from_texts(["p"] * len(ids)),
    )
    detections = type(base.detections)(
        ids,
        ids,
        Categories.from_texts(["light"] * len(ids)),
        np.full((len(ids), 2), 100.0),
        np.ones((len(ids), 2)),
        np.ones(len(ids)),
    )
    pairs = TruthDetections(ids, object_id)
    if same_image_twice:
        detections = detections.replace(image_id=np.zeros_like(ids))
    return Dataset("views", Frame(), base.cameras, images, detections, truth_of(positions), pairs)


def widest_angle(centers: Floats, position: Floats) -> float:
    """Try every pair of views."""
    direction = (position - centers) / np.linalg.norm(position - centers, axis=1, keepdims=True)
    apart = np.linalg.norm(np.cross(direction[:, None], direction), axis=2)
    return float(np.arctan2(apart, direction @ direction.T).max())


def test_recoverable_objects_are_those_of_all_pairs() -> None:
    """Objects seen 0 to 40 times from places whose spread straddles the limit in every way."""
    random = np.random.default_rng(11)
    positions = random.uniform(-50.0, 50.0, (200, 3))
    centers = [
        position
        + [0.0, -40.0, 0.0]
        + random.normal(0.0, random.choice([0.02, 0.3, 0.6, 3.0]), (random.integers(0, 40), 3))
        for position in positions
    ]
    min_parallax = math.radians(2.0)
    expected = [
        widest_angle(c, p) >= min_parallax if len(c) > 1 else False for c, p in zip(centers, positions, strict=True)
    ]
    found = recoverable_objects(scene_of_views(centers, positions), min_parallax)
    assert found is not None
    assert 50 < np.sum(expected) < 150
    assert_array_equal(found, expected)


def test_the_widest_pair_need_not_include_the_first_view() -> None:
    """Views at -0.6, 0, and 0.6 degrees, the middle one first: 1.2 degrees between the outer ones."""
    angles = np.radians([0.0, -0.6, 0.6])
    centers = -30.0 * np.stack([np.sin(angles), np.cos(angles), np.zeros(3)], axis=1)
    dataset = scene_of_views([centers], np.zeros((1, 3)))
    for limit, expected in ((1.19, True), (1.21, False)):
        assert_array_equal(recoverable_objects(dataset, math.radians(limit)), [expected])


def test_an_object_with_thousands_of_views_is_measured_exactly() -> None:
    """A ring of 3001 views, 1.5 degrees across: no pair reaches more, opposite ones just do."""
    turn = np.linspace(0.0, 2.0 * np.pi, 3001)
    radius = 40.0 * math.tan(math.radians(0.75))
    centers = np.stack([radius * np.cos(turn), np.full(3001, -40.0), radius * np.sin(turn)], axis=1)
    centers = np.concatenate([[[0.0, -40.0, 0.0]], centers])
    dataset = scene_of_views([centers], np.zeros((1, 3)))
    for limit, expected in ((1.4999, True), (1.5001, False)):
        assert_array_equal(recoverable_objects(dataset, math.radians(limit)), [expected])


def test_two_detections_in_one_image_are_one_view() -> None:
    centers = [np.array([[0.0, -40.0, 0.0], [40.0, 0.0, 0.0]])]
    positions = np.zeros((1, 3))
    assert_array_equal(recoverable_objects(scene_of_views(centers, positions), 0.0), [True])
    assert_array_equal(recoverable_objects(scene_of_views(centers, positions, same_image_twice=True), 0.0), [False])


def test_objects_that_are_not_recoverable_do_not_count_in_the_recall() -> None:
    """Of three objects one is seen once: its label is still true, its absence no miss."""
    wide = np.array([[0.0, -20.0, 0.0], [8.0, -20.0, 0.0]])
    positions = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [60.0, 0.0, 0.0]])
    dataset = scene_of_views([wide, wide + [30.0, 0.0, 0.0], wide[:1]], positions)
    missing = evaluate_map(map_of([[0.0, 0.1, 0.0]]), dataset)
    assert (missing.recoverable_objects, missing.false_negatives, missing.recall) == (2, 1, 0.5)
    assert missing.matches.object_outcome.texts() == ["found", "missed", "not recoverable"]
    lucky = evaluate_map(map_of([[0.0, 0.1, 0.0], [60.0, 0.0, 0.0]]), dataset)
    assert (lucky.true_positives, lucky.precision, lucky.recall) == (2, 1.0, 0.5)
    assert lucky.matches.object_outcome.texts() == ["found", "missed", "found"]


def test_the_parallax_is_that_of_the_map_unless_given() -> None:
    """Two views 5 degrees apart."""
    centers = [np.array([[0.0, -20.0, 0.0], [20.0 * math.tan(math.radians(5.0)), -20.0, 0.0]])]
    dataset = scene_of_views(centers, np.zeros((1, 3)))
    strict = map_of([], run={"settings": {"min_parallax_deg": 6.0}})
    assert evaluate_map(strict, dataset).recoverable_objects == 0
    assert evaluate_map(strict, dataset, min_parallax_rad=math.radians(4.0)).recoverable_objects == 1
    assert evaluate_map(map_of([], run={}), dataset).recoverable_objects == 1  # The default is 2 degrees.
    assert math.isnan(evaluate_map(strict, dataset).recall)


def test_objects_far_from_all_images_do_not_count(tmp_path: Path) -> None:
    """The images of the small dataset are at x = 0 to 12 m and y = 0: objects are 24.9 and 25.1 m beside one."""
    dataset = small_dataset()
    truth = truth_of([[4.0, 24.9, 90.0], [12.0, -25.1, 0.0], [0.0, 24.9, 0.0]])
    result = map_of([[4.0, 24.9, 90.0]])
    evaluation = evaluate_map(result, truth, images=dataset, seen_within_m=25.0)
    assert (evaluation.objects, evaluation.recoverable_objects, evaluation.recall) == (3, 2, 0.5)
    assert evaluation.completeness.missing_not_recoverable == 1
    (note,) = [note for note in evaluation.notes if "farther" in note]
    assert note == "1 of 3 objects lie farther than 25 m from every image and do not count"
    write_dataset(dataset, tmp_path / "city")
    assert evaluate_map(result, truth, images=tmp_path / "city", seen_within_m=25.0) == evaluation
    assert evaluate_map(result, truth).recoverable_objects == 3


def test_far_objects_do_not_count_although_they_were_detected() -> None:
    """The truth of a dataset says where its images are; what was not detected twice stays out as well."""
    dataset = scene_of_views(
        [np.array([[0.0, -20.0, 0.0], [8.0, -20.0, 0.0]]), np.array([[30.0, -20.0, 0.0]])],
        np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0]]),
    )
    for within_m, expected in ((30.0, 1), (20.1, 1), (19.9, 0)):
        assert evaluate_map(map_of([]), dataset, seen_within_m=within_m).recoverable_objects == expected


def test_images_in_another_georeferenced_frame_are_converted() -> None:
    """The anchor of the map is 111 m north of that of the images."""
    other = (ANCHOR[0] + 0.001, ANCHOR[1], ANCHOR[2])
    truth = truth_of([[4.0, 20.0 - 111.3, 0.0], [4.0, 20.0, 0.0]])
    images = small_dataset(Frame(anchor=ANCHOR))
    evaluation = evaluate_map(map_of([], frame=Frame(anchor=other)), truth, images=images, seen_within_m=25.0)
    assert evaluation.recoverable_objects == 1
    there = f"{ANCHOR[0]:g}, longitude {ANCHOR[1]:g}"
    with pytest.raises(
        InputError, match=f"the images are in a frame at latitude {there}, .*, the map in one of its own"
    ):
        evaluate_map(map_of([]), truth, images=images, seen_within_m=25.0)


@pytest.mark.parametrize("distance_m", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_distance_is_refused(distance_m: float) -> None:
    with pytest.raises(SettingError, match="seen-within: expected above 0 m, found "):
        evaluate_map(map_of([]), small_dataset(), seen_within_m=distance_m)


def test_a_distance_needs_images_and_images_a_distance(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="does not say where the images are") as refusal:
        evaluate_map(map_of([]), truth_of([[0, 0, 0]]), seen_within_m=25.0)
    assert "--images" in refusal.value.hint
    with pytest.raises(InputError, match=r"absent: is not a dataset"):
        evaluate_map(map_of([]), truth_of([[0, 0, 0]]), images=tmp_path / "absent", seen_within_m=25.0)
    with pytest.raises(SettingError, match="images: mean nothing without seen-within"):
        evaluate_map(map_of([]), small_dataset(), images=small_dataset())


# Truth from files.


def geographic_map() -> Map:
    """Return a geo-referenced map with labels 0.3 m east of truth_positions()."""
    position = truth_positions() + [0.3, 0.0, 0.0]
    return map_of(position, frame=Frame(anchor=ANCHOR), lon_lat_height=lon_lat_height_from_enu(position, ANCHOR))


def truth_positions() -> Floats:
    return np.array([[100.0, 2000.0, 8.0], [-3000.0, 50.0, -4.0], [500.0, 600.0, 5.0]])


def truth_places() -> Floats:
    return lon_lat_height_from_enu(truth_positions(), ANCHOR)


def write_csv(path: Path, columns: dict[str, Any]) -> Path:
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join("" if v is None else str(v) for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def xyz(positions: Floats) -> dict[str, Any]:
    return dict(zip("xyz", positions.T.tolist(), strict=True))


def lon_lat(places: Floats, *names: str) -> dict[str, Any]:
    return dict(zip(names or ("lon", "lat", "height"), places.T.tolist(), strict=False))


def assert_found_at(evaluation: Evaluation, distance_m: float) -> None:
    assert counts(evaluation) == (3, 0, 0, 0)
    assert evaluation.horizontal_rmse_m == pytest.approx(distance_m, abs=2e-3)


def test_truth_from_csv_and_parquet(tmp_path: Path) -> None:
    result = map_of(truth_positions() + [0.3, 0.0, 0.0])
    columns = {**xyz(truth_positions()), "class": ["light"] * 3, "object_id": [5, 6, 7], "note": ["a"] * 3}
    pq.write_table(pa.table(columns), tmp_path / "truth.parquet")
    for path in (write_csv(tmp_path / "truth.csv", columns), tmp_path / "truth.parquet"):
        evaluation = evaluate_map(result, path)
        assert_found_at(evaluation, 0.3)
        assert sorted(evaluation.matches.objects.object_id) == [5, 6, 7]
        assert sum("recoverable" in note for note in evaluation.notes) == 1


def test_truth_without_classes_matches_any(tmp_path: Path) -> None:
    result = map_of(truth_positions(), ["light", "sign", "tree"])
    evaluation = evaluate_map(result, write_csv(tmp_path / "truth.csv", xyz(truth_positions())))
    assert_found_at(evaluation, 0.0)
    assert any("any class" in note for note in evaluation.notes)


def test_classes_that_look_like_numbers_are_texts(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "truth.csv", {**xyz(truth_positions()), "class": [1, 2, 2]})
    assert_found_at(evaluate_map(map_of(truth_positions(), ["1", "2", "2"]), path), 0.0)


def test_truth_in_longitude_and_latitude(tmp_path: Path) -> None:
    columns = lon_lat(truth_places())
    pq.write_table(pa.table(columns), tmp_path / "truth.parquet")
    for path in (write_csv(tmp_path / "truth.csv", columns), tmp_path / "truth.parquet"):
        evaluation = evaluate_map(geographic_map(), path)
        assert_found_at(evaluation, 0.3)
        assert evaluation.vertical_rmse_m == pytest.approx(0.0, abs=1e-6)


def test_truth_without_heights_is_matched_horizontally(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "truth.csv", lon_lat(truth_places(), "lon", "lat"))
    evaluation = evaluate_map(geographic_map(), path)
    assert_found_at(evaluation, 0.3)
    values = evaluation.to_json()
    assert values["vertical_rmse_m"] is values["position_rmse_m"] is values["position_median_m"] is None
    assert any("no heights" in note for note in evaluation.notes)


def test_truth_of_which_some_have_heights_is_matched_horizontally(tmp_path: Path) -> None:
    table = lon_lat(truth_places(), "lon", "lat") | {"elevation": [truth_places()[0, 2], None, None]}
    evaluation = evaluate_map(geographic_map(), write_csv(tmp_path / "truth.csv", table))
    assert_found_at(evaluation, 0.3)
    assert math.isnan(evaluation.vertical_rmse_m)
    assert {
        "2 of 3 objects have no height",
        "labels are matched horizontally, without vertical and 3D errors: not all of the truth has heights",
    } <= {*evaluation.notes}


def test_heights_far_from_the_anchor_do_not_shift_truth_without_heights(tmp_path: Path) -> None:
    """In a city 1600 m above its anchor, the height of the labels is taken: else it would be 0.5 m off."""
    high = truth_positions() + [0.0, 0.0, 1600.0]
    places = lon_lat_height_from_enu(high, ANCHOR)
    result = map_of(high, frame=Frame(anchor=ANCHOR), lon_lat_height=places)
    path = write_csv(tmp_path / "truth.csv", lon_lat(places, "lon", "lat"))
    assert evaluate_map(result, path).horizontal_rmse_m < 0.02


@pytest.mark.parametrize("suffix", [".geojson", ".gpkg", ".fgb"])
@pytest.mark.parametrize("has_height", [True, False])
def test_truth_from_files_of_points(suffix: str, has_height: bool, tmp_path: Path) -> None:
    import geopandas

    lon, lat, height = truth_places().T
    points = geopandas.points_from_xy(lon, lat, height if has_height else None)
    frame = geopandas.GeoDataFrame({"class": ["light"] * 3}, geometry=points, crs="EPSG:4326")
    frame.to_file(tmp_path / f"truth{suffix}")
    evaluation = evaluate_map(geographic_map(), tmp_path / f"truth{suffix}")
    assert_found_at(evaluation, 0.3)
    assert math.isnan(evaluation.vertical_rmse_m) != has_height


@pytest.mark.parametrize("suffix", ["gpkg", "parquet"])
def test_truth_in_a_national_datum_tells_how_exactly_it_is_reached(suffix: str, tmp_path: Path) -> None:
    """The same of control points, which are read alike."""
    import geopandas

    frame = geopandas.GeoDataFrame(geometry=geopandas.points_from_xy([530000.0], [180000.0]), crs="EPSG:27700")
    path = tmp_path / f"t.{suffix}"
    frame.to_parquet(path) if suffix == "parquet" else frame.to_file(path)
    found = read_objects_file(path, Frame(anchor=(51.5, -0.13, 40.0)))
    note = accuracy_note("EPSG:27700")
    assert [line for line in found.notes if "PROJ lacks a grid" in line] == ([] if note is None else [note])


def features(places: Floats, **more: Any) -> str:
    """Return GeoJSON of points, as portals give it, with the ends of the collection in `more`."""
    rows = [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": place}}
        for place in places[:, :2].tolist()
    ]
    return json.dumps({"type": "FeatureCollection", "features": [*rows, *more.pop("others", [])], **more})


@pytest.mark.parametrize("suffix", [".shp", ".zip", ".kml", ".gml", ".parquet", ".json"])
def test_truth_from_files_of_points_of_other_programs(suffix: str, tmp_path: Path) -> None:
    """A shapefile, packed and not, with capitals and codes; KML, GML, GeoParquet, and Esri's JSON in a projection."""
    import geopandas

    lon, lat, _ = truth_places().T
    points = geopandas.points_from_xy(lon, lat)
    frame = geopandas.GeoDataFrame({"CLASS": ["light"] * 3, "OBJECTID": [1, 2, 3]}, geometry=points, crs="EPSG:4326")
    path = tmp_path / f"truth{suffix}"
    if suffix == ".json":
        projected = frame.to_crs("EPSG:25830").geometry
        rows = [{"attributes": {"CLASS": "light"}, "geometry": {"x": p.x, "y": p.y}} for p in projected]
        text = {"geometryType": "esriGeometryPoint", "spatialReference": {"wkid": 25830}, "features": rows}
        path.write_text(json.dumps(text))
    elif suffix == ".zip":
        frame.to_file(tmp_path / "signals.shp")
        with zipfile.ZipFile(path, "w") as archive:
            for part in tmp_path.glob("signals.*"):
                archive.write(part, part.name)
    elif suffix == ".parquet":
        frame.to_parquet(path)
    else:
        frame.to_file(path, driver="KML" if suffix == ".kml" else None)
    evaluation = evaluate_map(geographic_map(), path)
    assert_found_at(evaluation, 0.3)
    assert math.isnan(evaluation.vertical_rmse_m)
    assert evaluation.matches.objects.class_name is not None


def test_nodes_of_openstreetmap_are_truth(tmp_path: Path) -> None:
    lon, lat, _ = truth_places().T
    nodes = [
        f'<node id="{10**10 + i}" lat="{lat[i]:.9f}" lon="{lon[i]:.9f}"><tag k="highway" v="traffic_signals"/></node>'
        for i in range(3)
    ]
    (tmp_path / "t.osm").write_text(f'<osm version="0.6">{"".join(nodes)}</osm>')
    assert_found_at(evaluate_map(geographic_map(), tmp_path / "t.osm"), 0.3)
    (tmp_path / "t.json").write_text('{"version": 0.6, "elements": [{"type": "node", "lat": 1, "lon": 2}]}')
    with pytest.raises(InputError, match=r"t\.json: cannot be read") as refusal:
        evaluate_map(geographic_map(), tmp_path / "t.json")
    assert "Overpass" in refusal.value.hint


@pytest.mark.parametrize("suffix", ["gpkg", "fgb"])
def test_the_export_of_a_map_without_a_place_on_the_earth_is_truth(suffix: str, tmp_path: Path) -> None:
    result = map_of(truth_positions())
    export_map(result, tmp_path / f"own.{suffix}")
    evaluation = evaluate_map(result, tmp_path / f"own.{suffix}")
    assert (evaluation.true_positives, evaluation.position_rmse_m) == (3, 0.0)
    assert not any("any class" in note for note in evaluation.notes)


def test_points_without_a_coordinate_system_are_refused(tmp_path: Path) -> None:
    import geopandas

    with pytest.warns(UserWarning, match="'crs' was not provided"):
        geopandas.GeoDataFrame(geometry=geopandas.points_from_xy([1.0], [2.0])).to_file(tmp_path / "t.fgb")
    with pytest.raises(InputError, match="no geometries in a coordinate system") as refusal:
        evaluate_map(map_of([]), tmp_path / "t.fgb")
    assert "as a .csv with columns x, y, z" in str(refusal.value.hint)


def test_an_osm_file_without_tagged_nodes_says_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "t.osm").write_text('<osm version="0.6"><node id="1" version="1" lat="0" lon="0" /></osm>')
    with pytest.raises(InputError, match=r"t\.osm: has no nodes with tags") as refusal:
        evaluate_map(geographic_map(), tmp_path / "t.osm")
    assert "export a map as .csv" in str(refusal.value.hint)


def test_a_map_as_truth_says_how_two_maps_are_compared(tmp_path: Path) -> None:
    write_map(map_of(truth_positions()), tmp_path / "other")
    with pytest.raises(InputError, match="other: is a map") as refusal:
        evaluate_map(map_of([]), tmp_path / "other")
    assert f"valuemap export {tmp_path / 'other'} labels.csv" in str(refusal.value.hint)


def test_tabs_separate_the_columns_of_tsv(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "t.csv", xyz(truth_positions()))
    (tmp_path / "t.tsv").write_text(path.read_text().replace(",", "\t"))
    assert evaluate_map(map_of(truth_positions()), tmp_path / "t.tsv").true_positives == 3


def test_rows_without_a_place_are_left_out_and_told(tmp_path: Path) -> None:
    """No geometry, no numbers, and the point 0, 0."""
    others = [
        {"type": "Feature", "properties": {}, "geometry": geometry}
        for geometry in (None, None, {"type": "Point", "coordinates": [0, 0]})
    ]
    (tmp_path / "t.geojson").write_text(features(truth_places(), others=others))
    evaluation = evaluate_map(geographic_map(), tmp_path / "t.geojson")
    assert_found_at(evaluation, 0.3)
    assert "2 of 6 objects have no place and are left out" in evaluation.notes
    assert "1 of 6 objects lie at longitude 0, latitude 0 and are left out" in evaluation.notes
    lon, lat, _ = truth_places().T.tolist()
    table = {"Latitude": [*lat[:1], None, 0, *lat[1:]], "LNG": [*lon[:1], None, 0, *lon[1:]], "note": list("abcde")}
    evaluation = evaluate_map(geographic_map(), write_csv(tmp_path / "t.csv", table))
    assert_found_at(evaluation, 0.3)
    assert evaluation.notes[0] == "1 of 5 objects have no place and are left out"


def test_a_point_in_a_collection_of_one_is_a_point(tmp_path: Path) -> None:
    def as_collections(count: int) -> str:
        rows = [
            {
                "type": "Feature",
                "properties": {},
                "geometry": {"type": "MultiPoint", "coordinates": [place] * count},
            }
            for place in truth_places()[:, :2].tolist()
        ]
        return json.dumps({"type": "FeatureCollection", "features": rows})

    (tmp_path / "t.geojson").write_text(as_collections(1))
    assert_found_at(evaluate_map(geographic_map(), tmp_path / "t.geojson"), 0.3)
    (tmp_path / "t.geojson").write_text(as_collections(2))
    with pytest.raises(InputError, match=r"row 0: expected a point, found MultiPoint of 2 \(3 rows\)"):
        evaluate_map(geographic_map(), tmp_path / "t.geojson")


def test_rows_behind_one_without_a_place_keep_their_numbers(tmp_path: Path) -> None:
    table = {"lon": [1.0, None, 1.0], "lat": [2.0, None, 2.0], "class": ["light", "light", None]}
    with pytest.raises(InputError, match=r"t\.csv row 2: class: expected a value"):
        evaluate_map(geographic_map(), write_csv(tmp_path / "t.csv", table))


def test_points_of_geoparquet_come_before_coordinates_of_a_projection(tmp_path: Path) -> None:
    """As portals have them: X, Y, Z in a system of their own would be metres in the frame of the map."""
    import geopandas

    lon, lat, _ = truth_places().T
    columns = {"X": lon + 530000.0, "Y": lat + 180000.0, "Z": [1.0, 2.0, 3.0]}
    for count in (2, 3):
        points = geopandas.points_from_xy(lon, lat)
        frame = geopandas.GeoDataFrame(dict(list(columns.items())[:count]), geometry=points, crs="EPSG:4326")
        frame.to_parquet(tmp_path / "t.parquet")
        assert_found_at(evaluate_map(geographic_map(), tmp_path / "t.parquet"), 0.3)


@pytest.mark.parametrize("geo", ["{}", "no JSON", None])
def test_damaged_geoparquet_is_refused_in_a_line(geo: str | None, tmp_path: Path) -> None:
    column = {"encoding": "WKB", "geometry_types": []}
    whole = json.dumps({"version": "1.0.0", "primary_column": "geometry", "columns": {"geometry": column}})
    table = pa.table({"geometry": [b"x"]}).replace_schema_metadata({"geo": whole if geo is None else geo})
    pq.write_table(table, tmp_path / "t.parquet")
    with pytest.raises(InputError, match=r"t\.parquet: cannot be read as GeoParquet: .+"):
        evaluate_map(geographic_map(), tmp_path / "t.parquet")


def test_columns_of_rare_types_and_columns_that_are_there_twice(tmp_path: Path) -> None:
    lon, lat, _ = truth_places().T
    texts = pa.array(["light"] * 3).cast(pa.string_view())
    table = {"lon": lon, "lat": lat, "class": texts, "note": texts, "sigma": pa.array([0.5] * 3, pa.float16())}
    pq.write_table(pa.table(table), tmp_path / "t.parquet")
    assert_found_at(evaluate_map(geographic_map(), tmp_path / "t.parquet"), 0.3)
    halves = {"lon": pa.array([1.0], pa.float16()), "lat": pa.array([2.0], pa.float16())}
    pq.write_table(pa.table(halves), tmp_path / "t.parquet")
    assert len(evaluate_map(geographic_map(), tmp_path / "t.parquet").matches.objects) == 1
    (tmp_path / "t.csv").write_text("lat,lat,lon\n51,51,0\n")
    with pytest.raises(InputError, match="column 'lat' is there twice"):
        evaluate_map(geographic_map(), tmp_path / "t.csv")


def test_a_property_of_our_name_comes_before_one_in_capitals(tmp_path: Path) -> None:
    content = json.loads(features(truth_places()))
    for row in content["features"]:
        row["properties"] = {"class": "light", "CLASS": "A road"}
    (tmp_path / "t.geojson").write_text(json.dumps(content))
    assert_found_at(evaluate_map(geographic_map(), tmp_path / "t.geojson"), 0.3)


def test_an_answer_that_a_server_cut_short_is_told(tmp_path: Path) -> None:
    (tmp_path / "t.geojson").write_text(features(truth_places(), properties={"exceededTransferLimit": True}))
    evaluation = evaluate_map(geographic_map(), tmp_path / "t.geojson")
    assert_found_at(evaluation, 0.3)
    assert sum("exceededTransferLimit" in note for note in evaluation.notes) == 1


def test_deviations_of_check_points_count_where_all_are_stated(tmp_path: Path) -> None:
    """Of 0.03, 0.04 and 0.05 m the mean of the squares is 0.0050 / 3; the option comes first; one gap is too many."""
    result = map_of(truth_positions())
    sigmas: list[Any] = [0.03, 0.04, 0.05]
    path = write_csv(tmp_path / "t.csv", {**xyz(truth_positions()), "sigma": sigmas})
    assert evaluate_map(result, path).accuracy.truth_sigma_m == pytest.approx(math.sqrt(0.005 / 3))
    assert evaluate_map(result, path, truth_sigma_m=0.2).accuracy.truth_sigma_m == 0.2
    write_csv(path, {**xyz(truth_positions()), "sigma": [0.03, None, 0.05]})
    assert evaluate_map(result, path).accuracy.truth_sigma_m is None


def test_deviations_say_nothing_where_nothing_is_matched(tmp_path: Path) -> None:
    result = map_of(truth_positions() + [40.0, 0.0, 0.0])
    path = write_csv(tmp_path / "t.csv", {**xyz(truth_positions()), "sigma": [0.03, 0.04, 0.05]})
    assert evaluate_map(result, path).accuracy.truth_sigma_m is None


def test_heights_that_are_all_0_are_none_and_told(tmp_path: Path) -> None:
    """As many programs write them where there are none; one that is not 0 makes them heights."""
    table = {**lon_lat(truth_places(), "lon", "lat"), "height": [0.0, 0.0, 0.0]}
    evaluation = evaluate_map(geographic_map(), write_csv(tmp_path / "t.csv", table))
    assert_found_at(evaluation, 0.3)
    assert math.isnan(evaluation.vertical_rmse_m)
    assert "the heights of the objects are all 0, and taken for none" in evaluation.notes
    table["height"] = [0.0, 0.0, 8.0]
    evaluation = evaluate_map(geographic_map(), write_csv(tmp_path / "t.csv", table))
    assert evaluation.matches.objects.has_height


@pytest.mark.parametrize(
    ("given", "ids"), [(["7", "5", "6"], [7, 5, 6]), (["7", "", "6"], [0, 1, 2]), (["TL-1", "2", "3"], [0, 1, 2])]
)
def test_rows_are_the_ids_where_those_of_a_file_are_no_numbers(
    given: list[str], ids: list[int], tmp_path: Path
) -> None:
    table = {**xyz(truth_positions()), "object_id": given}
    encoded = pa.array([text or None for text in given]).dictionary_encode()  # As of categories of pandas.
    pq.write_table(pa.table({**table, "object_id": encoded}), tmp_path / "t.parquet")
    for path in (write_csv(tmp_path / "t.csv", table), tmp_path / "t.parquet"):
        objects = evaluate_map(map_of(truth_positions()), path).matches.objects
        rows = [truth_positions().tolist().index(place) for place in objects.position_in_world_m.tolist()]
        assert objects.object_id.tolist() == [ids[row] for row in rows]


def test_degrees_in_columns_x_and_y_are_no_metres(tmp_path: Path) -> None:
    """As ArcGIS and QGIS write them; in the frame of the map they would all be objects beside its origin."""
    with pytest.raises(InputError, match="x and y are longitude and latitude of the place") as refusal:
        evaluate_map(geographic_map(), write_csv(tmp_path / "t.csv", lon_lat(truth_places(), "X", "Y", "Z")))
    assert "lon, lat and height" in refusal.value.hint


def test_codes_that_are_numbers_are_classes(tmp_path: Path) -> None:
    """Of a layer and of Parquet as of CSV, with or without a fraction; an empty column of classes is none."""
    import geopandas

    lon, lat, _ = truth_places().T
    result = geographic_map()
    labels = result.labels.replace(class_name=Categories.from_texts(["205", "205", "206"]))
    result = Map(**{**vars(result), "labels": labels})
    for codes in ([205, 205, 206], [205.0, 205.0, 206.0]):
        points = geopandas.points_from_xy(lon, lat)
        frame = geopandas.GeoDataFrame({"class": codes}, geometry=points, crs="EPSG:4326")
        frame.to_file(tmp_path / "t.gpkg")
        pq.write_table(pa.table({"lon": lon, "lat": lat, "class": codes}), tmp_path / "t.parquet")
        for name in ("t.gpkg", "t.parquet"):
            assert_found_at(evaluate_map(result, tmp_path / name), 0.3)
    empty = {"lon": lon.tolist(), "lat": lat.tolist(), "height": [None] * 3, "class": [None] * 3}
    assert_found_at(evaluate_map(result, write_csv(tmp_path / "t.csv", empty)), 0.3)


def test_objects_are_the_layer_of_labels_where_a_file_has_several(tmp_path: Path) -> None:
    """A map that was exported has layers of cameras and votes too."""
    import geopandas

    lon, lat, height = truth_places().T
    frame = geopandas.GeoDataFrame(geometry=geopandas.points_from_xy(lon, lat, height), crs="EPSG:4326")
    for layer in ("cameras", "labels"):
        frame.iloc[: 3 if layer == "labels" else 1].to_file(tmp_path / "a.gpkg", layer=layer)
        frame.to_file(tmp_path / "b.gpkg", layer=f"{layer} of others")
    assert_found_at(evaluate_map(geographic_map(), tmp_path / "a.gpkg"), 0.3)
    with pytest.raises(InputError, match="has the layers cameras of others, labels of others"):
        evaluate_map(geographic_map(), tmp_path / "b.gpkg")


def test_heights_of_a_file_count_from_where_its_system_says(tmp_path: Path) -> None:
    """Heights above the sea are none above the ellipsoid: they need a grid, without which there is no way."""
    import geopandas

    lon, lat, height = truth_places().T
    points = geopandas.points_from_xy(lon, lat, height)
    frame = geopandas.GeoDataFrame(geometry=points, crs="EPSG:4326").to_crs("EPSG:25830")
    frame.set_crs("EPSG:25830+5621", allow_override=True).to_file(tmp_path / "t.gpkg")
    with pytest.raises(SettingError, match="cannot be brought to WGS84"):
        evaluate_map(geographic_map(), tmp_path / "t.gpkg")


def test_truth_that_is_elsewhere_is_told(tmp_path: Path) -> None:
    lon, lat, height = truth_places().T
    there = write_csv(tmp_path / "there.csv", {"lon": lat, "lat": lon, "height": height})
    below = write_csv(tmp_path / "below.csv", {"lon": lon, "lat": lat, "height": height - 47.2})
    assert "are latitude and longitude not exchanged?" in " ".join(evaluate_map(geographic_map(), there).notes)
    told = " ".join(evaluate_map(geographic_map(), below).notes)
    assert "true objects are 47.2 m below the labels beside them: do the heights of both count" in told
    found = evaluate_map(geographic_map(), write_csv(tmp_path / "t.csv", lon_lat(truth_places())))
    assert not any("true object" in note and "labels beside" in note for note in found.notes)


def test_geographic_positions_come_first_where_they_are_complete(tmp_path: Path) -> None:
    """x, y, z may belong to another anchor; an exported map has both."""
    wrong = xyz(truth_positions() + 1000.0)
    both = write_csv(tmp_path / "both.csv", {**wrong, **lon_lat(truth_places())})
    assert_found_at(evaluate_map(geographic_map(), both), 0.3)
    flat = write_csv(tmp_path / "flat.csv", {**xyz(truth_positions()), **lon_lat(truth_places() + 1.0, "lon", "lat")})
    assert_found_at(evaluate_map(geographic_map(), flat), 0.3)


def test_the_order_of_rows_in_a_file_does_not_matter(tmp_path: Path) -> None:
    random = np.random.default_rng(9)
    positions = random.uniform(0.0, 100.0, (50, 3))
    result = map_of(positions + random.normal(0.0, 0.3, (50, 3)))
    shuffled = positions[random.permutation(50)]
    first = evaluate_map(result, write_csv(tmp_path / "a.csv", xyz(positions)))
    second = evaluate_map(result, write_csv(tmp_path / "b.csv", xyz(shuffled)))
    assert first == second


def test_a_dataset_folder_and_a_map_folder(tmp_path: Path) -> None:
    dataset, result = small_dataset(), map_of([[4.0, 25.1, 5.0]], residual_px=[1.0])
    write_dataset(dataset, tmp_path / "city")
    write_map(result, tmp_path / "map")
    evaluation = evaluate_map(tmp_path / "map", str(tmp_path / "city"))
    assert evaluation == evaluate_map(result, dataset)
    assert counts(evaluation) == (1, 0, 0, 1)


def test_a_dataset_with_another_anchor() -> None:
    other = (51.501, -0.139, 30.0)
    position = enu_from_lon_lat_height(
        lon_lat_height_from_enu(np.array([[4.0, 25.0, 5.0], [12.0, 20.0, 2.0]]), ANCHOR), other
    )
    result = map_of(position, ["light", "sign"], frame=Frame(anchor=other))
    evaluation = evaluate_map(result, small_dataset(Frame(anchor=ANCHOR)))
    assert counts(evaluation) == (2, 0, 0, 0)
    assert evaluation.position_rmse_m < 1e-6


# Refusals.


@pytest.mark.parametrize(
    ("name", "text", "message", "hint"),
    [
        ("t.txt", "x,y,z\n1,2,3\n", r"t\.txt: truth of an unknown kind: \.txt$", ".csv, .tsv, .parquet, .geojson"),
        ("t.csv", "", r"t\.csv: cannot be read as CSV: Empty CSV file", "commas"),
        ("t.csv", "x,y,z\n", r"t\.csv: the table is empty$", "at least one row"),
        ("t.csv", "x,y\n1,2\n", r"t\.csv: expected columns lon, lat or x, y, z, found x, y$", "WGS84 degrees"),
        ("t.csv", "x,y,z\n1,2,3\n1,a,3\n", r"t\.csv: cannot be read as CSV: .*[Rr]ow #3.* 'a'", "commas"),
        (
            "t.csv",
            "x,y,z\n1,2,3\n1,,3\n",
            r"t\.csv row 1: y: expected a value, found none",
            "fill the value in",
        ),
        ("t.csv", "x,y,z\n1,2,inf\n", r"t\.csv row 0: z: expected a finite number, found inf", "repair"),
        (
            "t.csv",
            "x,y,z,class\n1,2,3,a\n1,2,3,\n",
            r"t\.csv row 1: class: expected a value, found none",
            "fill",
        ),
        (
            "t.csv",
            "lon,lat,height\n1,2,3\n",
            r"has longitude and latitude, but the map is not geo-referenced",
            "x, y, z",
        ),
        ("t.parquet", "PAR1", r"t\.parquet: cannot be read as Parquet", "damaged"),
        ("t.geojson", "{", r"t\.geojson: cannot be read", "QGIS"),
        (
            "t.geojson",
            '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": '
            '{"type": "LineString", "coordinates": [[0, 0], [1, 1]]}}]}',
            r"t\.geojson row 0: expected a point, found LineString \(1 rows\)$",
            "one point",
        ),
    ],
)
def test_wrong_truth_is_refused(name: str, text: str, message: str, hint: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as refusal:
        evaluate_map(map_of([[0.0, 0, 0]]), tmp_path / name)
    assert hint in refusal.value.hint


def test_a_table_without_geometries_is_refused(tmp_path: Path) -> None:
    import pandas as pd
    import pyogrio

    pyogrio.write_dataframe(pd.DataFrame({"class": ["light"]}), tmp_path / "t.gpkg")
    with pytest.raises(InputError, match=r"t\.gpkg: has no geometries in a coordinate system"):
        evaluate_map(geographic_map(), tmp_path / "t.gpkg")


def test_truth_that_is_nowhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        evaluate_map(map_of([]), tmp_path / "absent.csv")
    with pytest.raises(InputError, match="is not a dataset"):
        evaluate_map(map_of([]), tmp_path)
    for lon, lat in ((0.0, 95.0), (698000.0, 5711000.0)):
        file = write_csv(tmp_path / "t.csv", {"lon": [lon], "lat": [lat], "height": [0.0]})
        with pytest.raises(InputError, match=r"t\.csv row 0: expected degrees, found longitude") as refusal:
            evaluate_map(geographic_map(), file)
        assert "map projection" in refusal.value.hint


def test_a_dataset_without_truth_is_refused() -> None:
    dataset = Dataset(**{**vars(small_dataset()), "truth": None, "truth_detections": None})
    with pytest.raises(InputError, match="small: the dataset has no truth") as refusal:
        evaluate_map(map_of([]), dataset)
    assert "truth.parquet" in refusal.value.hint


@pytest.mark.parametrize(
    "frame", [Frame(anchor=ANCHOR), Frame(up=(0.0, -1.0, 0.0))], ids=["geo-referenced", "another up"]
)
def test_truth_in_another_frame_is_refused(frame: Frame) -> None:
    with pytest.raises(InputError, match="the truth is in a frame .*, the map in one "):
        evaluate_map(map_of([], frame=frame), small_dataset())


@pytest.mark.parametrize("radius_m", [0.0, -1.0, math.nan, math.inf, 1e308])
def test_an_impossible_radius_is_refused(radius_m: float) -> None:
    with pytest.raises(SettingError, match="radius: expected above 0 m and up to 1e.07 m, found "):
        evaluate_map(map_of([]), truth_of([[0, 0, 0]]), radius_m=radius_m)


def test_an_impossible_parallax_is_refused() -> None:
    with pytest.raises(SettingError, match="min_parallax: expected 0 to 180 degrees, found -"):
        evaluate_map(map_of([]), small_dataset(), min_parallax_rad=-0.1)


def test_a_truth_table_of_the_dataset_is_truth_too(tmp_path: Path) -> None:
    truth = truth_of(truth_positions())
    write_table(truth, tmp_path / "truth.parquet")
    result = map_of(truth_positions() + [0.0, 0.0, 0.5])
    from_file, from_table = evaluate_map(result, tmp_path / "truth.parquet"), evaluate_map(result, truth)
    assert from_file == from_table
    assert_allclose(from_file.vertical_rmse_m, 0.5)
