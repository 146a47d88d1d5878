"""One pass that is so far off that its rays meet nothing that others see."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from check_faults import good_city
from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers
from valuemap.check import meeting
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import View, keep_rows, with_centers, with_images
from valuemap.check.pass_shifts import far_shift, near_shift
from valuemap.check.quality import FarImages
from valuemap.check.sample import order_by_pass
from valuemap.check.time_stamps import RollingTimes
from valuemap.dataset import Dataset
from valuemap.progress import silent
from valuemap.tables import Categories, Images


@pytest.fixture(scope="module")
def city() -> Dataset:
    return good_city(1, passes_per_street=3)


def second(dataset: Dataset) -> Bools:
    return np.asarray(dataset.images.pass_id.codes == 1)


def with_second_pass(dataset: Dataset, center_in_world_m: Floats) -> View:
    center = np.where(second(dataset)[:, None], center_in_world_m, camera_centers(dataset.images))
    return View(with_centers(dataset, center))


@pytest.mark.parametrize("offset_m", [[50.0, -35.0, 0.0], [-417e3, 2.1e3, 0.0]])  # Another datum, another zone.
def test_a_pass_far_from_all_others_is_named_and_put_back(offset_m: list[float], city: Dataset) -> None:
    center = camera_centers(city.images)
    spoiled = with_second_pass(city, center + offset_m)
    assert near_shift(spoiled) is None
    (finding,) = find_in_stage(spoiled, "fine", silent)
    assert finding.fault == "pass_offset"
    assert finding.figures["pass"] == city.images.pass_id.names[1]
    assert "where others see such" in finding.why
    assert finding.fix is not None
    fixed = camera_centers(finding.fix(spoiled.dataset).images)
    assert np.linalg.norm((fixed - center)[second(city)], axis=1).max() < 0.5
    np.testing.assert_allclose(fixed[~second(city)], center[~second(city)], atol=1e-9)


def test_a_pass_whose_best_shift_is_one_of_many_is_not_moved(city: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """In feet it fits nowhere: some shift is the best of all, and the next one nearly as good."""
    assert far_shift(View(city)) is None
    assert far_shift(with_second_pass(city, camera_centers(city.images) / 0.3048)) is None
    far = with_second_pass(city, camera_centers(city.images) + [50.0, -35.0, 0.0])
    assert far_shift(far) is not None
    monkeypatch.setattr(meeting, "_NEXT_TIMES", 0.0)  # The next best is the best once more.
    assert far_shift(far) is None


def two_folders(dataset: Dataset, later_s: float) -> Dataset:
    """Return a drive that two cameras of one row recorded, in a folder each, of which the first has another clock."""
    images = dataset.images
    count = len(images)
    names = [f"{folder}/{row:05d}.jpg" for folder in ("front", "rear") for row in range(count)]
    time_s = np.asarray(images.timestamp_s)
    twice = images.take(np.tile(order_by_pass(images), 2))
    time_s = np.tile(time_s[order_by_pass(images)], 2) + np.repeat([later_s, 0.0], count)
    twice = twice.replace(image_id=np.arange(1, 2 * count + 1), name=pa.array(names), timestamp_s=time_s)
    pass_id, camera_id = Categories.from_texts(["drive"] * len(twice)), np.full(len(twice), images.camera_id[0])
    return with_detections_of_first(dataset, twice.replace(pass_id=pass_id, camera_id=camera_id))


def with_detections_of_first(dataset: Dataset, images: Images) -> Dataset:
    detections = dataset.detections.take(np.arange(10)).replace(image_id=np.full(10, images.image_id[0]))
    return Dataset(**{**vars(dataset), "images": images, "detections": detections, "truth_detections": None})


@pytest.mark.parametrize("left_s", [None, 10.0])
def test_another_clock_in_another_folder_is_no_counter_and_leaves_no_image_far(left_s: float | None) -> None:
    """Where the end of one camera's drive meets the start of the other's in time, images jump between two places."""
    one = good_city(1, passes_per_street=1)
    mine = one.images.pass_id.codes == 0
    part = keep_rows(one, images=mine & (one.images.camera_id == one.images.camera_id[0]))
    length_s = float(np.ptp(np.asarray(part.images.timestamp_s)))
    given = two_folders(part, 3600.0 if left_s is None else length_s - left_s)
    assert RollingTimes().find(View(given)) is None
    assert FarImages().find(View(given)) is None


def straight_drive(count: int) -> Dataset:
    """Return images of one camera, 2 m and half a second from each other."""
    one = good_city(1, passes_per_street=1)
    images = one.images.take(np.zeros(count, dtype=np.int64)).replace(
        image_id=np.arange(1, count + 1),
        name=pa.array([f"{row // 50:03d}/{row:05d}.jpg" for row in range(count)]),
        timestamp_s=0.5 * np.arange(count),
    )
    along_m = np.column_stack([2.0 * np.arange(count), np.zeros(count), np.full(count, 2.0)])
    return with_centers(with_detections_of_first(one, images), along_m)


def test_a_counter_goes_on_over_the_folders_of_a_drive() -> None:
    given = straight_drive(200)
    time_s = np.asarray(given.images.timestamp_s)
    finding = RollingTimes().find(View(with_images(given, timestamp_s=time_s % 10.0)))
    assert finding is not None
    assert finding.figures["period_s"] == 10.0
    assert finding.fix is not None
    unrolled = finding.fix(with_images(given, timestamp_s=time_s % 10.0)).images.timestamp_s
    np.testing.assert_allclose(np.asarray(unrolled), time_s)


def test_of_images_away_from_their_drive_it_is_said_how_far_they_are_from_others() -> None:
    given = straight_drive(200)
    center = camera_centers(given.images)
    center[100] += [0.0, 120.0, 0.0]
    finding = FarImages().find(View(with_centers(given, center)))
    assert finding is not None
    assert finding.why.startswith("1 of 200 images are 120 m or more from all others")
