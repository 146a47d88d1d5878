"""Boxes that show the same thing twice are one sighting."""

import dataclasses

import numpy as np
import pytest

import valuemap
from valuemap.arrays import Floats
from valuemap.config import MapConfig, SimulationConfig
from valuemap.dataset import Dataset
from valuemap.sightings import DOUBLE_APART_PX, find_doubles
from valuemap.simulate import simulate


@pytest.fixture(scope="module")
def street() -> Dataset:
    return simulate(
        SimulationConfig(streets_north_south=2, streets_east_west=2, passes_per_street=2), seed=3, name="street"
    )


def with_boxes(dataset: Dataset, center_px: Floats, size_px: Floats, score: Floats) -> Dataset:
    """The dataset with some boxes (N) of the first class in its first image alone."""
    rows = np.zeros(len(center_px), np.int64)
    detections = dataset.detections.take(rows)
    detections = detections.replace(
        detection_id=np.arange(len(rows)), center_px=center_px, size_px=size_px, score=score
    )
    return dataclasses.replace(dataset, detections=detections, truth_detections=None)


def test_the_best_of_overlapping_boxes_stands(street: Dataset) -> None:
    """The second overlaps with the first by more than half; the third with the second alone; the fourth is small."""
    center_px = np.array([[100.0, 100.0], [105.0, 100.0], [110.0, 100.0], [300.0, 50.0], [301.0, 51.0]])
    size_px = np.array([[20.0, 40.0]] * 3 + [[3.0, 3.0]] * 2)
    doubles = find_doubles(with_boxes(street, center_px, size_px, np.array([0.9, 0.8, 0.7, 0.4, 0.5])))
    assert doubles.tolist() == [False, True, False, True, False]
    # Without a score the larger one is the better one, and the order of rows means nothing.
    turned = find_doubles(with_boxes(street, center_px[::-1], size_px[::-1], np.array([0.5, 0.4, 0.7, 0.8, 0.9])))
    assert turned[::-1].tolist() == doubles.tolist()


def test_neighbors_are_two(street: Dataset) -> None:
    center_px = np.array([[100.0, 100.0], [100.0 + 3 * DOUBLE_APART_PX, 100.0]])
    doubles = find_doubles(with_boxes(street, center_px, np.full((2, 2), 6.0), np.array([0.9, 0.9])))
    assert not doubles.any()


@pytest.mark.parametrize("share", [0.08, 1.0])
def test_doubles_make_no_second_label(share: float) -> None:
    """A detector that reports boxes twice gives the map of one that does not, about."""
    changes = SimulationConfig(streets_north_south=2, streets_east_west=2, passes_per_street=3, double_share=share)
    dataset = simulate(changes, seed=5, name="doubles")
    result = valuemap.build_map(dataset, MapConfig())
    evaluation = valuemap.evaluate_map(result, dataset)
    assert evaluation.duplicates == 0
    assert evaluation.precision == 1.0
    assert result.run["counts"]["detections_double"] > 0.9 * share / (1.0 + share) * len(dataset.detections) * 0.9
