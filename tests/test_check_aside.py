"""Cameras that are farther to a side of their car than the poses say: a lever arm that was taken the other way."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import camera_aside, good_city, good_rig
from valuemap.cameras import camera_centers
from valuemap.check import corrections
from valuemap.check.cameras import CameraAside
from valuemap.check.fault import View
from valuemap.dataset import Dataset


@pytest.fixture(scope="module")
def rig() -> Dataset:
    """Each street is driven by three cameras, in both directions."""
    return good_rig(0)


@pytest.fixture(scope="module")
def aside(rig: Dataset) -> View:
    """All cameras are 2 m farther to the right than their poses say."""
    return View(camera_aside(rig))


def test_cameras_on_the_other_side_of_the_car_are_named_and_put_back(rig: Dataset, aside: View) -> None:
    off_m = np.linalg.norm(camera_centers(aside.dataset.images) - camera_centers(rig.images), axis=1)
    assert np.median(off_m) == pytest.approx(2.0)
    finding = CameraAside().find(aside)
    assert finding is not None
    assert "farther to the right of their way" in finding.what
    assert finding.fix is not None
    left_m = np.linalg.norm(camera_centers(finding.fix(aside.dataset).images) - camera_centers(rig.images), axis=1)
    assert np.median(left_m) < 0.3


def test_it_is_told_from_the_noise_of_poses_and_borne_out_by_rays(aside: View, monkeypatch: pytest.MonkeyPatch) -> None:
    assert corrections.find_correction(aside) is None  # Nothing else explains it.
    assert corrections.find_aside(aside) is not None
    for name, value in (("LEAST_TIMES", 20.0), ("AGAINST", 0.0)):
        monkeypatch.setattr(corrections, name, value)
        assert corrections.find_aside(aside) is None
        monkeypatch.undo()


def test_cameras_where_their_poses_say_are_not_aside(rig: Dataset) -> None:
    assert corrections.find_aside(View(rig)) is None
    loose = {"position_white_m": 0.8, "position_drift_m": 2.0, "rotation_white_deg": 0.6, "rotation_drift_deg": 1.0}
    assert corrections.find_aside(View(good_city(4, **loose))) is None
