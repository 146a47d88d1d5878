"""Where the cameras are on their car: lever arms left out, with exchanged axes, or not turned with the car."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import arms_left_out, arms_not_turned, good_rig
from valuemap.cameras import camera_centers
from valuemap.check import arms
from valuemap.check.arms import LeverArms
from valuemap.check.fault import View, with_images
from valuemap.check.registry import FAULTS
from valuemap.dataset import Dataset

ON_THE_CAR, EAST = "on the car", "forward as east"


@pytest.fixture(scope="module")
def rig() -> Dataset:
    """Each street is driven once by three cameras."""
    return good_rig(1, passes_per_street=1)


@pytest.fixture(scope="module")
def left_out(rig: Dataset) -> View:
    """The front camera is 2.7 m from each of the others, which are 2 m apart; their poses do not say so."""
    return View(arms_left_out(rig))


@pytest.fixture(scope="module")
def found(left_out: View) -> arms.LeverArmMistake:
    """Where the cameras are told to be."""
    result = told(left_out, ON_THE_CAR)
    assert result is not None
    return result


def told(view: View, how: str) -> arms.LeverArmMistake | None:
    return arms.find_mistake(view, arms.cameras_of_cars(view), how)


def apart_m(dataset: Dataset, right: Dataset) -> float:
    """Return the median error of where a camera is against the middle of the three that expose together."""
    error = (camera_centers(dataset.images) - camera_centers(right.images)).reshape(-1, 3, 3)
    return float(np.median(np.linalg.norm(error - error.mean(axis=1, keepdims=True), axis=2)))


def test_lever_arms_that_were_left_out_are_told_and_put_in(
    rig: Dataset, left_out: View, found: arms.LeverArmMistake, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of what has been told, all rays must agree better with it."""
    assert any(isinstance(each, LeverArms) for each in FAULTS)
    assert apart_m(left_out.dataset, rig) > 1.2
    monkeypatch.setattr(arms, "find_mistake", lambda _view, _groups, how: found if how == ON_THE_CAR else None)
    finding = LeverArms().find(left_out)
    assert finding is not None
    assert finding.figures["mistake"] == ON_THE_CAR
    forward_m, right_m = np.array([finding.figures["forward_right_m"][f"camera {each}"] for each in range(3)]).T
    np.testing.assert_allclose(forward_m, [-0.5, 2.0, -0.5], atol=0.4)
    np.testing.assert_allclose(right_m, [-1.0, 0.0, 1.0], atol=0.4)
    assert finding.fix is not None
    assert apart_m(finding.fix(left_out.dataset), rig) < 0.3
    monkeypatch.setattr(arms, "AGAINST", 0.0)
    assert LeverArms().find(left_out) is None


@pytest.mark.parametrize(("name", "value"), [("LEAST_TIMES", 30.0), ("LEAST_CHANCE", 0.0), ("HALF_WAY", 10.0)])
def test_what_noise_of_poses_makes_is_no_lever_arm(
    name: str, value: float, left_out: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arms, name, value)
    assert told(left_out, ON_THE_CAR) is None


def test_lever_arms_in_the_axes_of_the_world_are_told_from_wrong_ones(rig: Dataset) -> None:
    spoiled = View(arms_not_turned(rig))
    finding = LeverArms().find(spoiled)
    assert finding is not None
    assert finding.figures["mistake"] == EAST
    assert "do not turn with it" in finding.what
    assert finding.fix is not None
    assert apart_m(spoiled.dataset, rig) > 1.5
    assert apart_m(finding.fix(spoiled.dataset), rig) < 0.5


def test_of_cameras_metres_off_most_votes_are_seen_at_a_wider_gate_only(
    rig: Dataset, left_out: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arms, "at_wider_gate", lambda view: view)
    near = told(left_out, ON_THE_CAR)
    assert near is None or apart_m(near.fix(left_out.dataset), rig) > 0.5


def test_good_places_raise_nothing(rig: Dataset) -> None:
    assert LeverArms().find(View(rig)) is None


def test_cameras_that_do_not_expose_together_are_no_rig(left_out: View) -> None:
    """Without times nobody knows which do."""
    assert len(arms.cameras_of_cars(left_out)) == 3
    assert not arms.cameras_of_cars(View(with_images(left_out.dataset, timestamp_s=None)))
