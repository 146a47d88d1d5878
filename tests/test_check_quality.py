"""Images at a place where no car was, and names of classes that are spelled in several ways."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city, good_rig
from valuemap.arrays import Bools
from valuemap.cameras import camera_centers
from valuemap.check import quality
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import View, with_centers, with_detections, with_images
from valuemap.check.quality import ClassSpelling, nowhere
from valuemap.dataset import Dataset
from valuemap.progress import silent
from valuemap.tables import Categories


@pytest.fixture(scope="module")
def city() -> Dataset:
    return good_city(1, passes_per_street=2)


def without_fix(dataset: Dataset, share: float) -> Bools:
    return np.random.default_rng(8).random(len(dataset.images)) < share


@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [1e6, -5e6, 3e6]])
def test_images_without_a_fix_are_left_out_however_many_they_are(place: list[float], city: Dataset) -> None:
    lost = without_fix(city, 0.15)
    spoiled = with_centers(city, np.where(lost[:, None], place, camera_centers(city.images)))
    (finding,) = find_in_stage(View(spoiled), "positions", silent)
    assert finding.fault == "far_images"
    assert "again and again" in finding.why
    assert finding.fix is not None
    left = finding.fix(spoiled).images.image_id
    assert set(left) == set(city.images.image_id[~lost])


def test_places_that_are_come_back_to_from_beside_them_or_twice_are_somewhere(
    city: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    center = camera_centers(city.images)
    assert not nowhere(city.images).any()
    assert not nowhere(good_rig(14, passes_per_street=1).images).any()
    rounded = with_centers(city, np.round(center / 5.0) * 5.0)
    monkeypatch.setattr(quality, "_LEAST_VISITS", 2)
    assert not nowhere(rounded.images).any()
    monkeypatch.setattr(quality, "_NOWHERE_STEPS", 0.5)
    assert nowhere(rounded.images).any()
    monkeypatch.undo()
    twice = center.copy()
    twice[[300, 700]] = [0.0, 0.0, 0.0]
    assert not nowhere(with_centers(city, twice).images).any()
    twice[900] = [0.0, 0.0, 0.0]
    assert nowhere(with_centers(city, twice).images).sum() == 3


def test_passes_of_one_image_jump_nowhere(city: Dataset) -> None:
    """Several panoramas of one tripod are no drive."""
    center = np.where(without_fix(city, 0.15)[:, None], 0.0, camera_centers(city.images))
    names = Categories.from_texts([f"pass-{row}" for row in range(len(city.images))])
    assert not nowhere(with_images(with_centers(city, center), pass_id=names).images).any()


@pytest.mark.parametrize(
    ("one", "other", "is_one"),
    [
        ("W1-11", "W11-1", False),
        ("speed limit 3.5", "speed limit 35", False),
        ("274-1", "2741", False),
        ("C3", "C3s", False),
        ("R1 1", "r1-1", True),
        ("traffic_light", "Traffic Lights", True),
        ("stop-sign-2", "stopsign2", True),
        ("ÉCOLES", "école", True),
        ("--", "-", True),
    ],
)
def test_codes_that_digits_make_are_no_spellings_of_each_other(
    one: str, other: str, is_one: bool, city: Dataset
) -> None:
    names = [other if row % 3 else one for row in range(len(city.detections))]
    spoiled = with_detections(city, class_name=Categories.from_texts(names))
    finding = ClassSpelling().find(View(spoiled))
    assert (finding is not None) == is_one
    if finding is not None:
        assert finding.fix is not None
        assert finding.fix(spoiled).detections.class_name.names == (other,)
