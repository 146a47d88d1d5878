"""The accuracy statement, completeness, the floor of chance and reliability, against numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from typing import Any

import numpy as np
import pytest

from small_dataset import map_of
from valuemap.arrays import Floats
from valuemap.dataset import Frame
from valuemap.errors import SettingError
from valuemap.evaluate import (
    Evaluation,
    TrueObjects,
    evaluate_map,
    match_labels,
    measure_accuracy,
    measure_chance,
    measure_completeness,
)
from valuemap.map_folder import Map
from valuemap.tables import Categories, Truth


def truth_of(positions: Any) -> Truth:
    position = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    return Truth(np.arange(len(position)), Categories.from_texts(["light"] * len(position)), position)


def rows_of_objects(count: int) -> Floats:
    """Objects 10 m apart along x."""
    return np.column_stack([10.0 * np.arange(count), np.zeros(count), np.zeros(count)])


def evaluate_errors(errors: Any, *, frame: Frame | None = None, **options: Any) -> Evaluation:
    """Evaluate labels with these errors (N, 3) and covariances of diag(0.04, 0.01, 0.09) m²."""
    error = np.asarray(errors, dtype=np.float64).reshape(-1, 3)
    places = rows_of_objects(len(error))
    return evaluate_map(map_of(places + error, frame=frame), truth_of(places), **options)


# Accuracy at check points.


def test_errors_worked_out_by_hand() -> None:
    """East 0.3 and -0.1, north 0.4 and 0.2, up 0 and 0.6: squares add up to 0.10, 0.20 and 0.36."""
    accuracy = evaluate_errors([[0.3, 0.4, 0.0], [-0.1, 0.2, 0.6]]).accuracy
    assert accuracy.check_points == 2
    assert accuracy.rmse_east_m == pytest.approx(math.sqrt(0.05))
    assert accuracy.rmse_north_m == pytest.approx(math.sqrt(0.10))
    assert accuracy.rmse_up_m == pytest.approx(math.sqrt(0.18))
    assert accuracy.rmse_h_m == pytest.approx(math.sqrt(0.15))
    assert accuracy.rmse_v_m == pytest.approx(math.sqrt(0.18))
    assert accuracy.rmse_3d_m == pytest.approx(math.sqrt(0.33))
    assert accuracy.nssda_horizontal_95_m == pytest.approx(1.7308 * math.sqrt(0.15))
    assert accuracy.nssda_vertical_95_m == pytest.approx(1.96 * math.sqrt(0.18))
    assert (accuracy.bias_east_m, accuracy.bias_north_m, accuracy.bias_up_m) == pytest.approx((0.1, 0.3, 0.3))
    # Two values 0.4, 0.2 and 0.6 apart: the deviation is the difference over the root of two.
    spread = (accuracy.sigma_east_m, accuracy.sigma_north_m, accuracy.sigma_up_m)
    assert spread == pytest.approx(np.array([0.4, 0.2, 0.6]) / math.sqrt(2.0))
    assert accuracy.truth_sigma_m is None


def test_the_check_points_own_error_is_added() -> None:
    """With 0.2 m on each axis: RMSE_H² = 0.15 + 0.08, RMSE_V² = 0.18 + 0.04; NSSDA's figures stay."""
    errors = [[0.3, 0.4, 0.0], [-0.1, 0.2, 0.6]]
    accuracy, without = evaluate_errors(errors, truth_sigma_m=0.2).accuracy, evaluate_errors(errors).accuracy
    assert accuracy.rmse_h_m == pytest.approx(math.sqrt(0.23))
    assert accuracy.rmse_v_m == pytest.approx(math.sqrt(0.22))
    assert accuracy.rmse_3d_m == pytest.approx(math.sqrt(0.45))
    assert accuracy.nssda_horizontal_95_m == without.nssda_horizontal_95_m
    assert accuracy.rmse_east_m == without.rmse_east_m
    assert "own sigma 0.2 m an axis" in accuracy.statement
    assert "RMSE_H = 0.480 m, RMSE_V = 0.469 m, RMSE_3D = 0.671 m" in accuracy.statement
    assert "own error not stated" in without.statement


@pytest.mark.parametrize("sigma_m", [-0.1, math.nan, math.inf])
def test_an_impossible_error_of_the_truth_is_refused(sigma_m: float) -> None:
    with pytest.raises(SettingError, match="truth_sigma: expected at least 0 m, found "):
        evaluate_errors([[0.0, 0.0, 0.0]], truth_sigma_m=sigma_m)


@pytest.mark.parametrize(
    ("east_m", "inside"),
    # Sigma 0.2 m: the radius of the 95 % ellipse is 2.4477 sigmas, 0.48955 m.
    [(0.4895, 1.0), (0.4897, 0.0)],
)
def test_the_ellipse_of_a_label_holds_95_percent(east_m: float, inside: float) -> None:
    assert evaluate_errors([[east_m, 0.0, 0.0]]).accuracy.in_95_ellipse == inside


def test_what_all_share_is_taken_out_of_errors_and_covariances_alike() -> None:
    """Labels are off by 2 m together, which the absolute covariance allows, and by 0.2 m each, as the relative says."""
    rng = np.random.default_rng(3)
    places = rows_of_objects(400)
    error = rng.normal(0.0, 0.2, (400, 3)) + [2.0, 0.0, 0.0]
    result = map_of(places + error)
    relative_m2 = np.tile([0.04, 0.0, 0.0, 0.04, 0.0, 0.04], (400, 1))
    absolute_m2 = relative_m2 + np.array([4.0, 0.0, 0.0, 4.0, 0.0, 4.0])
    labels = result.labels.replace(covariance_m2=relative_m2, absolute_covariance_m2=absolute_m2)
    accuracy = evaluate_map(dataclasses.replace(result, labels=labels), truth_of(places), radius_m=4.0).accuracy
    assert accuracy.in_95_ellipse == accuracy.in_95_height == 1.0
    assert accuracy.stated_sigma_factor == pytest.approx(1.0, abs=0.1)
    assert accuracy.in_95_ellipse_less_bias == pytest.approx(0.95, abs=0.03)
    assert accuracy.in_95_height_less_bias == pytest.approx(0.95, abs=0.03)
    told = "shifted against the truth, 2.00 m east on average: "
    assert any(note.endswith(told + "absolute covariances allow for one") for note in accuracy.notes)
    without = evaluate_map(result, truth_of(places), radius_m=4.0).accuracy
    assert any(note.endswith(told + "no covariance tells it") for note in without.notes)


def test_each_check_point_is_as_exact_as_it_says() -> None:
    rng = np.random.default_rng(4)
    own_m = np.tile([0.01, 0.5], 200)
    places = rows_of_objects(400)
    labels = map_of(places + rng.normal(0.0, 1.0, (400, 3)) * np.hypot(0.1, own_m)[:, None]).labels
    labels = labels.replace(covariance_m2=np.tile([0.01, 0.0, 0.0, 0.01, 0.0, 0.01], (400, 1)))
    matches = match_labels(labels, TrueObjects(np.arange(400), places, sigma_m=own_m), Frame(), radius_m=3.0)
    accuracy = measure_accuracy(labels, matches, Frame())
    assert accuracy.stated_sigma_factor == pytest.approx(1.0, abs=0.1)  # 0.4 with one deviation for all.
    assert accuracy.in_95_ellipse == pytest.approx(0.95, abs=0.03)
    assert accuracy.truth_sigma_m == pytest.approx(math.sqrt(np.mean(own_m**2)))


def test_one_error_less_its_mean_tells_nothing() -> None:
    accuracy = evaluate_errors([[0.3, 0.0, 0.0]]).accuracy
    figures = (accuracy.stated_sigma_factor, accuracy.in_95_ellipse_less_bias, accuracy.in_95_height_less_bias)
    assert all(math.isnan(figure) for figure in figures)


@pytest.mark.parametrize(("stated", "is_told"), [(2, False), (3, True)])
def test_no_factor_makes_anything_of_sigmas_of_zero(stated: int, is_told: bool) -> None:
    places = rows_of_objects(4)
    result = map_of(places + [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    covariance_m2 = np.where(np.arange(4)[:, None] < stated, [0.04, 0.0, 0.0, 0.04, 0.0, 0.04], 0.0)
    result = dataclasses.replace(result, labels=result.labels.replace(covariance_m2=covariance_m2))
    accuracy = evaluate_map(result, truth_of(places)).accuracy
    assert (accuracy.to_json()["stated_sigma_factor"] is not None) == is_told
    assert any("stated_sigma_factor is not told" in note for note in accuracy.notes) != is_told


def test_the_ellipse_is_turned_as_the_covariance_is() -> None:
    """A covariance that is long along the diagonal holds an error along it, and not the same across."""
    places = rows_of_objects(3)
    labels = map_of(places + [[0.5, 0.5, 0.0], [-0.5, -0.5, 0.0], [0.5, -0.5, 0.0]]).labels
    labels = labels.replace(covariance_m2=np.tile([0.1, 0.09, 0.0, 0.1, 0.0, 0.1], (3, 1)))
    objects = TrueObjects(np.arange(3), places)
    matches = match_labels(labels, objects, Frame())
    # The squared error along is 2.6, that across 50 squared sigmas.
    assert measure_accuracy(labels, matches, Frame()).in_95_ellipse == pytest.approx(2 / 3)
    # With a truth of 0.3 m it is 5 across.
    assert measure_accuracy(labels, matches, Frame(), truth_sigma_m=0.3).in_95_ellipse == 1.0


def test_a_height_is_within_196_sigmas() -> None:
    """Sigma 0.3 m up: 0.588 m."""
    accuracy = evaluate_errors([[0.0, 0.0, 0.5878], [0.0, 0.0, -0.5882]]).accuracy
    assert accuracy.in_95_height == 0.5
    assert evaluate_errors([[0.0, 0.0, 0.7]] * 4).accuracy.in_95_height == 0.0
    assert evaluate_errors([[0.0, 0.0, 0.7]] * 4).accuracy.in_95_height_less_bias == 1.0


def test_a_shared_shift_is_told_and_taken_off() -> None:
    """All labels 0.6 m west, +- 0.02: outside of all ellipses, inside when the shift is off."""
    errors = np.column_stack([np.full(40, -0.6) + np.tile([0.02, -0.02], 20), np.tile([0.01, -0.01], 20), np.zeros(40)])
    evaluation = evaluate_errors(errors)
    assert evaluation.accuracy.in_95_ellipse == 0.0
    assert evaluation.accuracy.in_95_ellipse_less_bias == 1.0
    (note,) = [note for note in evaluation.notes if "shifted" in note]
    assert "0.60 m west on average" in note
    assert "north" not in note


@pytest.mark.parametrize(
    ("errors_m", "count"),
    [
        ((0.3, -0.1), 4),  # 0.1 m of an RMSE of 0.22 m, but less than one standard error.
        ((0.12, -0.08), 400),  # 0.02 m, four standard errors, but a fifth of the RMSE.
    ],
)
def test_a_mean_error_that_is_unsure_or_small_is_no_shift(errors_m: tuple[float, float], count: int) -> None:
    errors = np.column_stack([np.tile(errors_m, count // 2), np.tile([0.2, -0.2], count // 2), np.zeros(count)])
    assert not any("shifted" in note for note in evaluate_errors(errors).notes)


@pytest.mark.parametrize(("shift_m", "told"), [(0.0049, False), (0.0051, True)])
def test_a_shift_of_less_than_half_a_centimetre_is_none(shift_m: float, told: bool) -> None:
    """It would be told as 0.00 m."""
    errors = np.column_stack([np.full(40, shift_m), np.tile([0.01, -0.01], 20), np.zeros(40)])
    notes = [note for note in evaluate_errors(errors).notes if "shifted" in note]
    assert ["0.01 m east" in note for note in notes] == [True] * told


def test_stated_sigmas_that_are_too_small_are_told() -> None:
    """Errors of twice the stated sigmas in each direction have squared errors of 4 sigmas², 4 / 1.3863 the median."""
    errors = [[0.4, 0.0, 0.0], [-0.4, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, -0.2, 0.0]]
    factor = evaluate_errors(errors).accuracy.stated_sigma_factor
    assert factor == pytest.approx(2.0 / math.sqrt(2.0 * math.log(2.0)))


@pytest.mark.parametrize(
    ("count", "told"),
    [(1, "1 check point: .* at least 30, NSSDA 20"), (19, "NSSDA"), (20, r"^20 check points: .* 30\)$"), (30, None)],
)
def test_too_few_check_points_are_said(count: int, told: str | None) -> None:
    notes = [note for note in evaluate_errors(np.zeros((count, 3))).notes if "check point" in note]
    assert (len(notes) == 1 and re.search(told, notes[0]) is not None) if told else notes == []


def test_unlike_axes_are_said() -> None:
    """NSSDA's factor holds for RMSE that differ by at most 0.6."""
    for north_m, said in ((0.061, False), (0.059, True)):
        errors = np.tile([[0.1, north_m, 0.0], [-0.1, -north_m, 0.0]], (20, 1))
        assert any("NSSDA's horizontal" in note for note in evaluate_errors(errors).notes) == said


@pytest.mark.parametrize(("count", "north_m"), [(2, 0.1), (40, 1e-9)])
def test_unlike_axes_are_not_said_of_few_points_nor_of_rounding(count: int, north_m: float) -> None:
    errors = np.tile([0.0, north_m, 0.0], (count, 1))
    assert not any("NSSDA's horizontal" in note for note in evaluate_errors(errors).notes)


def test_axes_are_those_of_the_frame() -> None:
    """With up = -y, z is north and x is east of it or west: an error of 0.3 down is 0.3 along y."""
    frame = Frame(up=(0.0, -1.0, 0.0))
    east, north = frame.east_north()
    errors = 0.1 * east + 0.2 * north + np.array([0.0, 0.3, 0.0])
    accuracy = evaluate_errors(errors, frame=frame).accuracy
    assert (accuracy.bias_east_m, accuracy.bias_north_m, accuracy.bias_up_m) == pytest.approx((0.1, 0.2, -0.3))
    # Along y the stated sigma is 0.1 m, so 0.3 m is too much; along x it is 0.2 m and along z 0.3 m.
    assert (accuracy.in_95_height, accuracy.in_95_ellipse) == (0.0, 1.0)


def test_without_heights_nothing_is_said_of_them() -> None:
    places = rows_of_objects(2)
    result = map_of(places + [0.3, 0.4, 9.0])
    objects = TrueObjects(np.arange(2), places, has_height=False)
    matches = match_labels(result.labels, objects, result.frame)
    accuracy = measure_accuracy(result.labels, matches, result.frame, truth_sigma_m=0.1)
    values = accuracy.to_json()
    assert values["rmse_h_m"] == pytest.approx(math.sqrt(0.25 + 0.02))
    vertical = ("rmse_v_m", "rmse_3d_m", "bias_up_m", "nssda_vertical_95_m", "in_95_height", "in_95_height_less_bias")
    assert [values[name] for name in vertical] == [None] * 6
    assert "RMSE_V" not in accuracy.statement


def test_of_no_check_point_nothing_is_said() -> None:
    evaluation = evaluate_map(map_of([[50.0, 0.0, 0.0]]), truth_of([[0, 0, 0]]), truth_sigma_m=0.1)
    assert evaluation.accuracy.statement == "no check points"
    values = evaluation.accuracy.to_json()
    assert values.pop("check_points") == 0
    assert values.pop("truth_sigma_m") == 0.1
    assert values.pop("is_shift_stated") is False
    assert set(values.values()) == {None}
    assert not any("check point" in note for note in evaluation.notes)
    json.dumps(evaluation.to_json(), allow_nan=False)


def test_a_covariance_of_zero_holds_no_error() -> None:
    result = map_of([[0.0, 0.0, 0.0]])
    labels = result.labels.replace(covariance_m2=np.zeros((1, 6)))
    evaluation = evaluate_map(dataclasses.replace(result, labels=labels), truth_of([[0, 0.1, 0]]))
    assert evaluation.accuracy.in_95_ellipse == 0.0


# Completeness.


def test_completeness_worked_out_by_hand() -> None:
    """Of five objects three are found, one has two labels, one label stands for two; one label is of nothing."""
    objects = [[0.0, 0, 0], [20, 0, 0], [40, 0, 0], [41, 0, 0], [60, 0, 0]]
    labels = [[0.1, 0.0, 0.0], [0.0, 1.0, 0.0], [20.0, 0.0, 0.0], [40.1, 0.0, 0.0], [90.0, 0.0, 0.0]]
    completeness = evaluate_map(map_of(labels), truth_of(objects)).completeness
    assert completeness.to_json() == {
        "items": 5,
        "excess_items": 2,
        "excess_rate": 0.4,
        "duplicate_items": 1,
        "missing_items": 2,
        "missing_rate": 0.4,
        "missing_not_recoverable": 0,
        "split_objects": 1,
        "split_rate": pytest.approx(1 / 3),
        "merged_labels": 1,
        "merge_rate": pytest.approx(1 / 3),
    }


def test_what_cannot_be_seen_is_missing_all_the_same() -> None:
    places = rows_of_objects(3)
    objects = TrueObjects(np.arange(3), places, is_recoverable=np.array([True, False, False]))
    result = map_of(places[[0, 2]])
    matches = match_labels(result.labels, objects, result.frame)
    completeness = measure_completeness(matches)
    assert (completeness.missing_items, completeness.missing_not_recoverable) == (1, 1)
    assert completeness.missing_rate == pytest.approx(1 / 3)


def test_an_empty_map_is_complete_in_no_way() -> None:
    completeness = evaluate_map(map_of([]), truth_of([[0, 0, 0]])).completeness
    assert (completeness.excess_rate, completeness.missing_rate) == (0.0, 1.0)
    assert completeness.to_json()["split_rate"] is None


# Chance.


def row_of_labels() -> tuple[Map, TrueObjects]:
    """Labels on objects every 10 m along x, of which a shift along x keeps all but two in place."""
    places = rows_of_objects(10)
    return map_of(places), TrueObjects(np.arange(10), places)


def test_chance_is_what_a_moved_truth_matches() -> None:
    """20 m east or west: eight of ten labels lie on another object; north or south: none."""
    result, objects = row_of_labels()
    chance = measure_chance(result.labels, objects, result.frame, radius_m=2.0)
    assert chance.to_json() == {"shift_m": 20.0, "matches": 4.0, "precision": 0.4, "recall": 0.4}


def test_chance_moves_farther_for_a_large_radius() -> None:
    """Labels 30 m apart with a radius of 8 m: a shift of 20 m would leave 10 m, one of 32 m leaves 2 m."""
    places = 3.0 * rows_of_objects(3)
    objects = TrueObjects(np.arange(3), places, is_recoverable=np.array([True, True, False]))
    chance = measure_chance(map_of(places).labels, objects, Frame(), radius_m=8.0)
    assert chance.shift_m == 32.0
    assert chance.matches == 1.0
    # East: objects 0 and 1 are met, both count; west: 1 and 2, of which one counts.
    assert chance.recall == 3 / 4 / 2


def test_chance_of_nothing_is_nothing() -> None:
    chance = measure_chance(map_of([]).labels, row_of_labels()[1], Frame(), radius_m=2.0)
    assert chance.to_json() == {"shift_m": 20.0, "matches": 0.0, "precision": None, "recall": 0.0}


# Reliability.


def test_reliability_counts_by_existence() -> None:
    """A limit belongs to the range above it; one is in the last."""
    places = rows_of_objects(6)
    existence = [0.55, 0.6, 0.65, 0.999, 1.0, 0.3]
    labels = np.concatenate([places[:5], [[100.0, 50.0, 0.0]]])
    labels[1] = [200.0, 0.0, 0.0]
    ranges = evaluate_map(map_of(labels, existence=existence), truth_of(places)).reliability
    assert ranges is not None
    assert [(r.low, r.high, r.labels, r.true_labels, r.true_share) for r in ranges] == [
        (0.0, 0.5, 1, 0, 0.0),
        (0.5, 0.6, 1, 1, 1.0),
        (0.6, 0.7, 2, 1, 0.5),
        (0.99, 1.0, 2, 2, 1.0),
    ]
    assert [r.mean_existence for r in ranges] == pytest.approx([0.3, 0.55, 0.625, 0.9995])


def test_a_map_without_existence_has_no_reliability() -> None:
    evaluation = evaluate_map(map_of([[0.0, 0, 0]]), truth_of([[0, 0, 0]]))
    assert evaluation.reliability is None
    assert evaluation.to_json()["reliability"] is None
