"""Pitch and roll that count the other way, or are taken for each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from check_faults import good_city
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.contest import hold_contest
from valuemap.check.fault import View, with_detections, with_poses
from valuemap.check.frames import TiltConvention
from valuemap.check.headings import headings, rotations_of
from valuemap.check.lenses import camera_rows
from valuemap.dataset import Dataset, rows_of


@pytest.fixture(scope="module")
def rolled() -> Dataset:
    """A city whose cameras are turned about their axes, by 4 degrees to the right and 5 to and fro, and its boxes."""
    city = good_city(1, passes_per_street=1)
    roll_rad = np.radians(np.random.default_rng(4).normal(4.0, 5.0, len(city.images)))
    turn = Rotation.from_rotvec(np.stack([0.0 * roll_rad, 0.0 * roll_rad, -roll_rad], axis=1)).as_matrix()
    posed = with_poses(city, turn @ rotation_matrices(city.images), camera_centers(city.images))
    detections = city.detections
    middle_px = np.array([city.cameras.params[row][2:4] for row in camera_rows(city)])
    of_image = rows_of(detections.image_id, city.images.image_id)
    turned_px = np.einsum("nij,nj->ni", turn[of_image, :2, :2], detections.center_px - middle_px)
    return with_detections(posed, center_px=middle_px + turned_px)


@pytest.mark.parametrize(
    ("of_pitch_and_roll", "how"),
    [
        ([[1, 0], [0, -1]], "roll the other way"),
        ([[-1, 0], [0, 1]], "pitch the other way"),
        ([[0, -1], [-1, 0]], "pitch and roll exchanged, both the other way"),
        ([[1, 0], [0, 1]], None),
    ],
)
def test_signs_of_tilts_are_told(rolled: Dataset, of_pitch_and_roll: list[list[int]], how: str | None) -> None:
    azimuth, pitch, roll = headings(rolled)
    pitch, roll = np.array(of_pitch_and_roll) @ [pitch, roll]
    rotation = rotations_of(azimuth, pitch, roll, rolled.frame)
    given = View(with_poses(rolled, rotation, camera_centers(rolled.images)))
    finding = hold_contest(given, [TiltConvention()]).finding
    if how is None:
        assert finding is None
        return
    assert finding is not None
    assert f"Read as {how}," in finding.why
    assert finding.fix is not None
    fixed = rotation_matrices(finding.fix(given.dataset).images)
    np.testing.assert_allclose(fixed, rotation_matrices(rolled.images), atol=1e-9)
