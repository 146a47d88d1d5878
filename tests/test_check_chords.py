"""Positions on straight lines between fixes that are many images apart."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import FAULTS as INJECTED
from check_faults import posed
from test_check_clocks import winding
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import examine
from valuemap.check.chords import InterpolatedPositions
from valuemap.check.fault import View
from valuemap.check.headings import level_rotations
from valuemap.dataset import Dataset


@pytest.fixture(scope="module")
def winding_drives() -> Dataset:
    return winding((0.0, 0.0, 0.0))


def spoiled(good: Dataset) -> Dataset:
    given = INJECTED["interpolated_positions"].spoil(good)
    assert given is not None
    return given


def off_m(given: Dataset, good: Dataset) -> Floats:
    there = camera_centers(good.images)[np.isin(good.images.image_id, given.images.image_id)]
    return np.asarray(np.linalg.norm(camera_centers(given.images) - there, axis=1))


def test_positions_between_fixes_are_named_and_put_on_curves(winding_drives: Dataset) -> None:
    given = spoiled(winding_drives)
    outcome = examine(given)
    assert [each.fault for each in outcome.findings] == ["interpolated_positions"]
    assert outcome.findings[0].figures["images_between"] == 16.0
    assert outcome.findings[0].figures["left_out"] == 0
    # Of an arc of 34 m with a radius of some 60 m the middle is 2 m beside the chord.
    assert off_m(given, winding_drives).max() > 2.0
    assert off_m(outcome.fixed, winding_drives).max() < 0.5 * off_m(given, winding_drives).max()
    assert InterpolatedPositions().find(View(outcome.fixed)) is None


@pytest.mark.parametrize("decimals", [9, 2])
def test_positions_that_were_rounded_afterwards_are_still_on_lines(decimals: int, winding_drives: Dataset) -> None:
    given = spoiled(winding_drives)
    given = posed(given, rotation_matrices(given.images), np.round(camera_centers(given.images), decimals))
    assert InterpolatedPositions().find(View(given)) is not None


def test_a_car_that_is_driven_along_lines_and_turned_at_their_ends_is_none(winding_drives: Dataset) -> None:
    given = spoiled(winding_drives)
    center = camera_centers(given.images)
    way = np.concatenate([center[1:] - center[:-1], center[-1:] - center[-2:-1]])
    way[399::400] = way[398::400]  # The last image of each pass.
    azimuth = np.arctan2(way[:, 0], way[:, 1])
    assert InterpolatedPositions().find(View(posed(given, level_rotations(azimuth, given.frame), center))) is None


def test_drives_without_bends_at_fixes_are_none(winding_drives: Dataset, good: Dataset) -> None:
    assert InterpolatedPositions().find(View(winding_drives)) is None
    assert InterpolatedPositions().find(View(good)) is None


def test_a_pass_of_fixes_is_left_as_it_is_beside_one_that_has_few(winding_drives: Dataset) -> None:
    mine = winding_drives.images.pass_id.codes == 1
    center = np.where(
        mine[:, None], camera_centers(spoiled(winding_drives).images), camera_centers(winding_drives.images)
    )
    center += np.random.default_rng(1).normal(0.0, 0.02, center.shape) * ~mine[:, None]
    given = posed(winding_drives, rotation_matrices(winding_drives.images), center)
    finding = InterpolatedPositions().find(View(given))
    assert finding is not None
    assert finding.fix is not None
    np.testing.assert_allclose(camera_centers(finding.fix(given).images)[~mine], center[~mine], atol=1e-9)


def test_images_where_no_car_can_have_gone_are_left_out(good: Dataset) -> None:
    """Passes of the city go from street to street without the way between."""
    finding = InterpolatedPositions().find(View(spoiled(good)))
    assert finding is not None
    assert finding.fix is not None
    fixed = finding.fix(spoiled(good))
    assert len(fixed.images) == len(good.images) - finding.figures["left_out"] < len(good.images)
    assert np.quantile(off_m(fixed, good), 0.9) < 0.5 * np.quantile(off_m(spoiled(good), good), 0.9)
    assert set(fixed.detections.image_id) <= set(fixed.images.image_id)
