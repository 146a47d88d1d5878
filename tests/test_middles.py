"""Middles that sides show are told by how all objects' sides disagree, together."""

from __future__ import annotations

import importlib
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import scipy.stats

import valuemap
from block import SHORT_STREETS
from test_refine import CITY
from valuemap import MapConfig, calibration, correction, robust
from valuemap.arrays import Bools, Floats, Ints
from valuemap.dataset import Dataset
from valuemap.engine.threads import ThreadEngine
from valuemap.progress import silent
from valuemap.refine import Mapped, gather_images
from valuemap.refine.images import Bundle
from valuemap.refine.middles import Contrasts, Middles
from valuemap.refine.residuals import cauchy
from valuemap.simulate import simulate
from valuemap.tables.covariance import covariance_matrices
from valuemap.tiles.source import InMemory

refine_middles = importlib.import_module("valuemap.refine.middles")
"""The module, which the package hides behind its function of the same name."""
MOST_M = 1.0
DRIFT_M = 0.5


def sides(middles_m: float, *, objects: int = 40, seed: int = 0) -> tuple[list[Floats], Floats]:
    """Return where two drives put both sides of objects, each along its own line of sight worse, and covariances.

    Each drive is off by half a metre at all objects alike, and by 2 cm at each.
    """
    rng = np.random.default_rng(seed)
    own = np.tile(np.diag([0.3, 0.02, 0.02, 0.02, 0.3, 0.02]) ** 2, (objects, 1, 1))
    by_drive = np.kron(np.ones((objects, 1)), np.eye(6))
    covariance_m2 = DRIFT_M**2 * by_drive @ by_drive.T
    for number, block in enumerate(own):
        covariance_m2[6 * number : 6 * number + 6, 6 * number : 6 * number + 6] += block
    off_m = rng.multivariate_normal(np.zeros(len(covariance_m2)), covariance_m2)
    off_m += middles_m * rng.normal(size=len(off_m))
    return list(1e5 + off_m.reshape(objects, 2, 3)), covariance_m2


@pytest.mark.parametrize("middles_m", [0.05, 0.1, 0.3])
def test_middles_are_told_where_drives_are_off_by_more(middles_m: float) -> None:
    told = Contrasts.of_sides(*sides(middles_m)).middles(MOST_M)
    assert told is not None
    assert told.is_certain
    assert told.off_m == pytest.approx(middles_m, rel=0.25)


@pytest.mark.parametrize("seed", range(5))
def test_what_drives_are_off_by_at_all_objects_alike_is_no_middle(seed: int) -> None:
    assert Contrasts.of_sides(*sides(0.0, seed=seed)).middles(MOST_M) is None


@pytest.mark.parametrize("objects", [5, 8])
def test_a_few_objects_tell_middles_beyond_what_their_sides_are_known_to(objects: int) -> None:
    told = [Contrasts.of_sides(*sides(0.2, objects=objects, seed=seed)).middles(MOST_M) for seed in range(5)]
    assert all(one is not None and one.is_certain for one in told)
    assert np.median([one.off_m for one in told if one is not None]) == pytest.approx(0.2, rel=0.3)


def test_middles_that_are_in_doubt_are_told_as_such() -> None:
    """Where they are as large as what sides are known to, five objects tell them in some cases, and seldom for sure."""
    told = [Contrasts.of_sides(*sides(0.02, objects=5, seed=seed)).middles(MOST_M) for seed in range(40)]
    in_doubt = [one for one in told if one is not None and not one.is_certain]
    assert len(in_doubt) > sum(one is not None and one.is_certain for one in told)
    assert all(0.01 < one.off_m < 0.1 for one in in_doubt)


def test_the_half_that_agrees_best_says_what_all_objects_would() -> None:
    contrasts = Contrasts.of_sides(*sides(0.2, objects=200))
    values_m = MOST_M * np.geomspace(1e-3, 1.0, 60)
    everyone = np.ones(200, np.bool_)
    is_best = refine_middles._best_half(contrasts._chances(everyone, 0.2))
    assert is_best.sum() == 100
    assert contrasts._as_of_all(is_best)._likeliest(is_best, values_m)[0] == pytest.approx(0.2, rel=0.15)
    assert contrasts._likeliest(is_best, values_m)[0] < 0.15


def test_objects_that_are_two_tell_nothing_of_middles() -> None:
    points, covariance_m2 = sides(0.0)
    for two in points[::8]:
        two[1] += [0.0, 0.0, 1.0]
    contrasts = Contrasts.of_sides(points, covariance_m2)
    assert contrasts.middles(MOST_M) is None
    _, gain = contrasts._likeliest(np.ones(len(points), np.bool_), MOST_M * np.geomspace(1e-3, 1.0, 60))
    assert gain > 100.0  # With them, middles are off by far more than chance.


def test_sides_that_disagree_by_as_much_as_things_are_large_are_of_several_things() -> None:
    assert Contrasts.of_sides(*sides(3.0)).middles(MOST_M) is None


def test_how_far_an_object_disagrees_is_judged_by_all_others() -> None:
    """Against the others one by one: their distribution given what is known of the rest."""
    contrasts = Contrasts.of_sides(*sides(0.1, objects=8))
    is_one = np.arange(8) % 3 != 0
    whole = contrasts.covariance_m2 + 0.1**2 * np.eye(len(contrasts.of))
    for one, chance in enumerate(contrasts._chances(is_one, 0.1)):
        own, rest = contrasts.of == one, is_one[contrasts.of] & (contrasts.of != one)
        gain = whole[np.ix_(own, rest)] @ np.linalg.inv(whole[np.ix_(rest, rest)])
        off_m = contrasts.apart_m[own] - gain @ contrasts.apart_m[rest]
        known_m2 = whole[np.ix_(own, own)] - gain @ whole[np.ix_(rest, own)]
        square = off_m @ np.linalg.solve(known_m2, off_m)
        assert chance == pytest.approx(scipy.stats.chi2.sf(square, own.sum()), rel=1e-6, abs=1e-12)


def test_objects_of_one_side_tell_nothing() -> None:
    told = SimpleNamespace(label=np.array([7, 3, 7, 3, 5, 9, 9]))
    assert [things.tolist() for things in refine_middles._sides(cast(Bundle, told))] == [[1, 3], [0, 2], [5, 6]]


def with_tie(points: list[Floats], covariance_m2: Floats, tie_m: float, unknown: Bools) -> Contrasts:
    """Return contrasts as they are with middles that are thought to be off by so much; axes `unknown` are not seen."""
    given = Contrasts.of_sides(points, covariance_m2)
    seen = np.diag((~unknown).astype(np.float64))
    information = seen @ np.linalg.inv(given.covariance_m2) @ seen
    covariance = np.asarray(np.linalg.inv(information + np.eye(len(unknown)) / tie_m**2), np.float64)
    return replace(given, apart_m=covariance @ information @ given.apart_m, covariance_m2=covariance)


def test_what_sides_disagree_by_does_not_depend_on_what_they_were_tied_by() -> None:
    points, covariance_m2 = sides(0.2)
    given, all_seen = Contrasts.of_sides(points, covariance_m2), np.zeros(120, np.bool_)
    untied = with_tie(points, covariance_m2, 0.5, all_seen).untied(0.5)
    assert untied.apart_m == pytest.approx(given.apart_m, abs=1e-6)
    assert untied.covariance_m2 == pytest.approx(given.covariance_m2, abs=1e-6)


def test_what_no_vote_tells_of_sides_is_no_agreement() -> None:
    """As far as it is not seen where sides are, ties alone keep them together."""
    unknown = np.arange(120) % 3 != 0
    tied = with_tie(*sides(0.2, seed=1), 0.5, unknown)
    told = tied.untied(0.5).middles(MOST_M)
    assert told is not None
    assert told.off_m == pytest.approx(0.2, rel=0.35)
    as_if_seen = tied.middles(MOST_M)
    assert as_if_seen is None or as_if_seen.off_m < 0.1


@pytest.mark.parametrize(("objects", "asked"), [(0, 0), (3, 3), (100, 100), (101, 51), (1000, 100)])
def test_no_more_objects_are_asked_than_tell_it(objects: int, asked: int) -> None:
    sides = [np.array([number]) for number in range(objects)]
    chosen = np.array([int(things[0]) for things in refine_middles._asked(sides)])
    assert len(chosen) == asked
    assert len(set(np.diff(chosen))) <= 1


def lamps_beside_drives_that_drift(side_offset_m: float, seed: int) -> Dataset:
    """Return lamps whose sides show other middles, seen by drives that drift by 0.4 m."""
    lamps = replace(CITY, has_lights=0, lamp_spacing_m=12.0, side_offset_m=side_offset_m, frame_spacing_m=4.0)
    return simulate(replace(lamps, position_drift_m=0.4, **SHORT_STREETS), seed=seed)


@pytest.fixture(scope="module")
def mapped() -> tuple[Dataset, Mapped]:
    """Return lamps whose middles are off by 0.2 m, and a map of them that knows of no middles."""
    city = lamps_beside_drives_that_drift(0.2, seed=4)
    return city, correction._map_alone(city, MapConfig(side_sigma_m=0.0), ThreadEngine(1), silent)


def test_middles_are_not_told_without_boxes_or_objects(
    mapped: tuple[Dataset, Mapped], monkeypatch: pytest.MonkeyPatch
) -> None:
    city, (calibration, labels, votes, _) = mapped
    images, noise = gather_images(city, MapConfig()), calibration.noise
    told = refine_middles.middles(images, labels, votes, noise)
    assert told is not None
    assert told.off_m == pytest.approx(0.2, rel=0.3)
    without_boxes = labels.replace(object_width_m=np.zeros(len(labels)), object_height_m=np.zeros(len(labels)))
    assert refine_middles.middles(images, without_boxes, votes, noise) is None
    monkeypatch.setattr(refine_middles, "_LEAST_OBJECTS", len(labels))
    assert refine_middles.middles(images, labels, votes, noise) is None


def test_ties_hold_alike_however_far_sides_are_apart(
    mapped: tuple[Dataset, Mapped], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only then can they be taken out again: one that gives way would be taken out in full."""
    city, (calibration, labels, votes, _) = mapped
    weights: list[Floats] = []

    def spy(told: Bundle, groups: Ints) -> tuple[Floats, Floats]:
        weights.append(cauchy(np.array([0.0, 1e6]) / told.ties.total**2, 3.0))
        return placed(told, groups)

    placed = Bundle.placed
    monkeypatch.setattr(Bundle, "placed", spy)
    assert refine_middles.middles(gather_images(city, MapConfig()), labels, votes, calibration.noise) is not None
    assert np.array_equal(weights, [[1.0, 1.0]])


def test_middles_are_no_farther_off_than_half_of_the_larger_side_of_a_box(mapped: tuple[Dataset, Mapped]) -> None:
    city, (calibration, labels, votes, _) = mapped
    images = gather_images(city, MapConfig())

    def told_of(width_m: float, height_m: float) -> Middles | None:
        of_size = {"object_width_m": np.full(len(labels), width_m), "object_height_m": np.full(len(labels), height_m)}
        told = refine_middles.middles(images, labels.replace(**of_size), votes, calibration.noise)
        return cast("Middles | None", told)

    assert told_of(0.7, 0.1) is not None
    assert told_of(0.1, 0.7) is not None
    assert told_of(0.3, 0.3) is None


def told(city: Dataset, *settings: str) -> float:
    """Return what the calibration of a dataset says that middles are off by."""
    config = MapConfig().with_settings(settings)
    return calibration.calibrate(InMemory(city, config), config, None, None, ThreadEngine(1), silent).noise.side_m


def test_middles_that_are_smaller_than_the_drift_are_in_the_map_and_its_calibration(
    mapped: tuple[Dataset, Mapped],
) -> None:
    run = valuemap.build_map(mapped[0], MapConfig(correct_poses=0)).run
    side_m = run["calibration"]["noise"]["side_m"]
    assert run["counts"]["noise"]["side_m"] == side_m == pytest.approx(0.2, rel=0.3)


@pytest.mark.parametrize("off_m", [0.0, 0.2])
def test_sides_of_one_or_two_votes_tell_middles_together(off_m: float) -> None:
    lamps = replace(CITY, has_lights=0, lamp_spacing_m=12.0, side_offset_m=off_m, frame_spacing_m=8.0)
    city = simulate(replace(lamps, recall_mean=0.4, position_drift_m=0.05, **SHORT_STREETS), seed=1)
    assert told(city) == pytest.approx(off_m, rel=0.4)


def test_drift_is_not_taken_for_middles() -> None:
    assert told(lamps_beside_drives_that_drift(0.0, seed=6)) == 0.0


def test_middles_that_are_set_are_not_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "middles", None)
    city = simulate(replace(CITY, lights=12, passes_per_street=1, frame_spacing_m=4.0), seed=4)
    assert told(city, "side_sigma_m=0.07") == 0.07


def test_without_the_part_there_are_no_middles(mapped: tuple[Dataset, Mapped], monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even those that are told."""
    monkeypatch.setattr(robust, "LEFT_OUT", {"sides"})
    monkeypatch.setattr(calibration, "middles", lambda *_: Middles(0.2, is_certain=True))
    city = simulate(replace(CITY, lights=12, passes_per_street=1, frame_spacing_m=4.0), seed=4)
    assert told(city) == 0.0


def test_middles_that_are_in_doubt_widen_covariances_and_change_no_vote(
    mapped: tuple[Dataset, Mapped], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "middles", lambda *_: Middles(0.2, is_certain=False))
    city, (_, labels, votes, _) = mapped
    _, labels_of_doubt, votes_of_doubt, _ = correction._map_alone(city, MapConfig(), ThreadEngine(1), silent)
    assert np.array_equal(labels.position_in_world_m, labels_of_doubt.position_in_world_m)
    assert np.array_equal(votes.detection_id, votes_of_doubt.detection_id)
    trace_m2 = (covariance_matrices(each.covariance_m2).trace(axis1=1, axis2=2) for each in (labels, labels_of_doubt))
    known_m2, doubted_m2 = trace_m2
    assert np.median(doubted_m2 / known_m2) > 1.2
