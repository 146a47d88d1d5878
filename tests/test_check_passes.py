"""One pass that is so far off that its rays meet nothing that others see."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city
from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers
from valuemap.check import passes
from valuemap.check.examine import _look
from valuemap.check.fault import View, with_centers
from valuemap.dataset import Dataset
from valuemap.progress import silent


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
    assert passes._apart_from_others(spoiled) is None
    (finding,) = _look(spoiled, "fine", silent)
    assert finding.fault == "pass_offset"
    assert finding.figures["pass"] == city.images.pass_id.names[1]
    assert "where others see such" in finding.why
    assert finding.fix is not None
    fixed = camera_centers(finding.fix(spoiled.dataset).images)
    assert np.linalg.norm((fixed - center)[second(city)], axis=1).max() < 0.5
    np.testing.assert_allclose(fixed[~second(city)], center[~second(city)], atol=1e-9)


def test_a_pass_whose_best_shift_is_one_of_many_is_not_moved(city: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """In feet it fits nowhere: some shift is the best of all, and the next one nearly as good."""
    assert passes._far_from_others(View(city)) is None
    assert passes._far_from_others(with_second_pass(city, camera_centers(city.images) / 0.3048)) is None
    far = with_second_pass(city, camera_centers(city.images) + [50.0, -35.0, 0.0])
    assert passes._far_from_others(far) is not None
    monkeypatch.setattr(passes, "_NEXT_TIMES", 0.0)  # The next best is the best once more.
    assert passes._far_from_others(far) is None
