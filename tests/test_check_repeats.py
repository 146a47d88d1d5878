"""Boxes that are there again in the next image."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city
from valuemap.arrays import Bools
from valuemap.cameras import camera_centers
from valuemap.check.boxes import rows_in_images
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import View, with_centers, with_detections
from valuemap.check.repeats import RepeatedDetections
from valuemap.check.sample import drive_of_camera, order_by_camera
from valuemap.dataset import Dataset
from valuemap.progress import silent


@pytest.fixture(scope="module")
def city() -> Dataset:
    return good_city(1)


def listed_again(dataset: Dataset, which: Bools) -> Dataset:
    """Return a dataset in which the boxes of some images (N, in driving order) are listed with the next one, too."""
    images, detections = dataset.images, dataset.detections
    order = order_by_camera(images)
    following = np.full(len(order), -1)
    goes_on = np.diff(drive_of_camera(images)[order]) == 0
    following[order[:-1][goes_on & which[:-1]]] = order[1:][goes_on & which[:-1]]
    to = following[rows_in_images(dataset)]
    rows = np.concatenate([np.arange(len(to)), np.flatnonzero(to >= 0)])
    image_id = np.concatenate([detections.image_id, images.image_id[to[to >= 0]]])
    changed = detections.take(rows).replace(image_id=image_id, detection_id=np.arange(1, len(rows) + 1))
    return Dataset(**{**vars(dataset), "detections": changed, "truth_detections": None})


def rounded_to(dataset: Dataset, step_px: float) -> Dataset:
    center_px, size_px = (
        np.round(each / step_px) * step_px for each in (dataset.detections.center_px, dataset.detections.size_px)
    )
    return with_detections(dataset, center_px=center_px, size_px=size_px)


@pytest.mark.parametrize(("every", "step_px"), [(1, 1e-9), (20, 1e-9), (1, 0.01)])
def test_boxes_that_are_listed_with_the_next_image_too_are_left_out(every: int, step_px: float, city: Dataset) -> None:
    good = rounded_to(city, step_px)
    spoiled = listed_again(good, np.arange(len(city.images)) % every == 0)
    (finding,) = find_in_stage(View(spoiled), "tables", silent)
    assert finding.fault == "repeated_detections"
    assert finding.sure == "almost certain"
    assert finding.fix is not None
    mended = finding.fix(spoiled).detections
    added = len(spoiled.detections) - len(good.detections)
    assert abs(len(spoiled.detections) - len(mended) - added) <= 0.01 * added  # A few are equal by rounding.
    assert RepeatedDetections().find(View(finding.fix(spoiled))) is None


@pytest.mark.parametrize("step_px", [1e-3, 0.1, 1.0, 2.0, 4.0, 8.0, 16.0])
def test_boxes_that_are_equal_by_rounding_are_none(step_px: float, city: Dataset) -> None:
    assert RepeatedDetections().find(View(rounded_to(city, step_px))) is None


def test_what_a_standing_car_sees_may_stay_the_same(city: Dataset) -> None:
    order, center = order_by_camera(city.images), camera_centers(city.images)
    center[order[201:241]] = center[order[200]]
    standing = with_centers(city, center)
    again = listed_again(standing, (np.arange(len(order)) >= 200) & (np.arange(len(order)) < 240))
    assert len(again.detections) > len(city.detections) + 20
    assert RepeatedDetections().find(View(again)) is None
