"""Headings that were written with too few digits."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city, good_rig
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers
from valuemap.check.fault import View, with_poses
from valuemap.check.headings import headings, level_rotations
from valuemap.check.rounding import RoundedHeadings
from valuemap.dataset import Dataset


@pytest.fixture(scope="module")
def rig() -> Dataset:
    """Each street is driven once by three cameras."""
    return good_rig(14, passes_per_street=1)


def looking(dataset: Dataset, azimuth_deg: Floats) -> View:
    rotation = level_rotations(np.radians(azimuth_deg), dataset.frame)
    return View(with_poses(dataset, rotation, camera_centers(dataset.images)))


@pytest.mark.parametrize("step_deg", [1.0, 5.0])
def test_headings_on_a_grid_are_named_whatever_the_mount(step_deg: float, rig: Dataset) -> None:
    azimuth_deg = np.degrees(headings(rig)[0])
    mount_deg = 17.3 * rig.images.camera_id
    found = RoundedHeadings().find(looking(rig, step_deg * np.round(azimuth_deg / step_deg) + mount_deg))
    assert found is not None
    assert found.figures == {"step_deg": step_deg}


def test_good_headings_and_those_of_a_straight_grid_of_streets_are_on_no_grid(rig: Dataset) -> None:
    for given in (rig, good_city(1, passes_per_street=1)):
        azimuth_deg = np.degrees(headings(given)[0])
        assert RoundedHeadings().find(View(given)) is None
        assert RoundedHeadings().find(looking(given, np.asarray(np.round(10.0 * azimuth_deg) / 10.0))) is None
        assert RoundedHeadings().find(looking(given, 90.0 * np.round(azimuth_deg / 90.0))) is None
