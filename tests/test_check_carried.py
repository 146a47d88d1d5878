"""Boxes that stay at one place of the picture wherever the car drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from check_faults import FAULTS as INJECTED
from check_faults import good_city, rows
from valuemap.cameras import camera_centers
from valuemap.check.carried import CarriedBoxes, find_carried
from valuemap.check.fault import View, with_centers
from valuemap.dataset import Dataset


@pytest.fixture(scope="module")
def good() -> Dataset:
    return good_city(1)


@pytest.fixture(scope="module")
def dirty(good: Dataset) -> Dataset:
    spoiled = INJECTED["carried_boxes"].spoil(good)
    assert spoiled is not None
    return spoiled


def test_boxes_of_dirt_are_found_and_no_others_are_left_out(good: Dataset, dirty: Dataset) -> None:
    is_carried, places = find_carried(dirty)
    assert is_carried[len(good.detections) :].all()
    assert is_carried[: len(good.detections)].sum() < 0.01 * len(good.detections)
    (place,) = places
    assert place.share == pytest.approx(2.0 / 3.0, abs=0.1)
    finding = CarriedBoxes().find(View(dirty))
    assert finding is not None
    assert finding.fix is not None
    assert f"({place.x_px:.0f}, {place.y_px:.0f}) px" in finding.why
    assert finding.fix(dirty).detections.detection_id.tolist() == dirty.detections.detection_id[~is_carried].tolist()


def test_what_half_of_the_pictures_do_not_show_is_not_said_to_be_carried(good: Dataset, dirty: Dataset) -> None:
    is_dirt = np.arange(len(dirty.detections)) >= len(good.detections)
    some = dirty.detections.take(~is_dirt | (np.arange(len(is_dirt)) % 3 == 0))
    assert find_carried(replace(dirty, detections=some))[1] == []


def test_a_standing_car_sees_the_same_all_along(good: Dataset, dirty: Dataset) -> None:
    """Its positions tremble; what it sees from one place counts as one picture."""
    is_dirt = np.arange(len(dirty.detections)) >= len(good.detections)
    seen_in = np.unique(rows(dirty)[is_dirt])
    standing = camera_centers(dirty.images)
    tremble = np.random.default_rng(1).normal(0.0, 1e-3, (len(seen_in), 3))
    standing[seen_in] = standing[seen_in[0]] + tremble
    assert find_carried(with_centers(dirty, standing))[1] == []


def test_where_a_street_vanishes_boxes_are_close_together_and_not_at_one_place(good: Dataset, dirty: Dataset) -> None:
    spread = dirty.detections.center_px.copy()
    first = len(good.detections)
    width_px = float(good.cameras.width_px[0])
    spread[first:] += np.random.default_rng(2).normal(0.0, 0.006 * width_px, (len(spread) - first, 2))
    assert find_carried(replace(dirty, detections=dirty.detections.replace(center_px=spread)))[1] == []


def test_few_places_tell_nothing(good: Dataset, dirty: Dataset) -> None:
    is_dirt = np.arange(len(dirty.detections)) >= len(good.detections)
    seen_in = np.unique(rows(dirty)[is_dirt])
    for count, found in ((20, 0), (60, 1)):
        some = dirty.images.take(seen_in[:count])
        boxes = dirty.detections.take(np.isin(dirty.detections.image_id, some.image_id))
        assert len(find_carried(replace(dirty, images=some, detections=boxes))[1]) == found
