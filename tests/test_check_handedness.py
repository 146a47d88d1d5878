"""A left-handed world, with headings to match, is mirrored pictures to all rays: truth tells which."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city, mirrored_pictures
from valuemap.cameras import camera_centers
from valuemap.check.examine import examine
from valuemap.check.fault import View, with_poses
from valuemap.check.handedness import MirroredByTruth
from valuemap.check.headings import headings, rotations_of
from valuemap.dataset import Dataset


@pytest.fixture(scope="module")
def two() -> Dataset:
    return good_city(21, passes_per_street=2)


def left_handed(dataset: Dataset) -> Dataset:
    """Return x north, y east, and headings from x towards y."""
    azimuth, pitch, roll = headings(dataset)
    rotation = rotations_of(np.pi / 2.0 - azimuth, pitch, roll, dataset.frame)
    return with_poses(dataset, rotation, camera_centers(dataset.images)[:, [1, 0, 2]])


@pytest.mark.parametrize(("seed", "passes"), [(21, 2), (23, 4)])
def test_a_left_handed_world_is_named_and_the_truth_stays(seed: int, passes: int) -> None:
    good = good_city(seed, passes_per_street=passes)
    outcome = examine(left_handed(good))
    assert [each.fault for each in outcome.findings] == ["mirrored_world"]
    np.testing.assert_allclose(camera_centers(outcome.fixed.images), camera_centers(good.images), atol=1e-6)
    assert outcome.fixed.truth is good.truth


def test_mirrored_pictures_are_told_by_truth_and_what_they_may_be_is_said(two: Dataset) -> None:
    assert MirroredByTruth().find(View(two)) is None
    finding = MirroredByTruth().find(View(mirrored_pictures(two)))
    assert finding is not None
    assert finding.fault == "mirrored_pictures"
    assert "If these are not mirrored, the world is" in finding.do
