"""How coarsely detections are written down, told by the detections alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from block import block
from valuemap.arrays import Floats
from valuemap.dataset import Dataset
from valuemap.rounding import rounding_px
from valuemap.simulate import simulate


@pytest.fixture(scope="module")
def city() -> Dataset:
    return simulate(block(), seed=5, name="block")


def with_centers(dataset: Dataset, center_px: Floats) -> Dataset:
    return replace(dataset, detections=dataset.detections.replace(center_px=np.ascontiguousarray(center_px)))


@pytest.mark.parametrize("step_px", [0.5, 1.0, 8.0, 4096 / 360])
def test_steps_are_found_wherever_they_begin(city: Dataset, step_px: float) -> None:
    center_px = np.round(city.detections.center_px / step_px) * step_px + 0.25
    assert rounding_px(with_centers(city, center_px)) == pytest.approx(step_px / math.sqrt(12.0))


def test_what_is_not_rounded_is_not_taken_for_it(city: Dataset) -> None:
    assert rounding_px(city) == 0.0
    none = replace(city, detections=city.detections.take(np.empty(0, np.int64)))
    assert rounding_px(none) == 0.0


def test_an_axis_of_one_value_was_not_measured(city: Dataset) -> None:
    center_px = np.round(city.detections.center_px)
    center_px[:, 1] = 512.0
    assert rounding_px(with_centers(city, center_px)) == pytest.approx(math.sqrt(1.0 / 24.0))


def test_one_detection_between_the_steps_leaves_nothing_sure(city: Dataset) -> None:
    center_px = np.round(city.detections.center_px)
    center_px[0] += 1e-3
    assert rounding_px(with_centers(city, center_px)) < 1e-3


@settings(max_examples=50)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_few_numbers_that_are_far_apart_by_chance_show_no_steps(city: Dataset, count: int, seed: int) -> None:
    few = city.detections.take(np.arange(count))
    center_px = np.random.default_rng(seed).uniform(0.0, 4000.0, (count, 2))
    assert rounding_px(with_centers(replace(city, detections=few), center_px)) == 0.0
