"""Straight drives that all go the same way: what rays leave open there, and what is no fault of theirs."""

from __future__ import annotations

import numpy as np
import pytest

from test_straight_drives import lanes
from valuemap.check import corrections, examine
from valuemap.check.fault import View, with_images
from valuemap.check.frames import DegreesForRadians
from valuemap.dataset import Dataset
from valuemap.drives.way import azimuths_along

EAST, NORTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def one_way(seed: int) -> Dataset:
    """Return two drives in each of two lanes, all to the east, that drift by 0.2 m."""
    return timed(lanes(seed, lane_m=(-2.0, -2.0, 2.0, 2.0), drift_m=0.2, image_m=0.05)[0])


def timed(given: Dataset) -> Dataset:
    """Return the same drives, one after another, with two images a second."""
    time_s = 0.5 * np.arange(len(given.images)) + 100.0 * given.images.pass_id.codes
    return with_images(given, timestamp_s=time_s)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_nothing_but_offsets_of_drives_is_told_where_all_drive_straight_ahead(seed: int) -> None:
    """Headings without their noise, and positions between measured ones, agree better than what is right."""
    assert {each.fault for each in examine(one_way(seed)).findings} <= {"pass_offset"}


def test_no_shift_along_a_straight_street_is_told_from_positions_that_were_smoothed() -> None:
    """Positions between measured ones are smoother whichever way they are moved."""
    given = timed(lanes(1, lane_m=(-2.0, -2.0, 2.0, 2.0), drift_m=0.8, image_m=0.3)[0])
    assert corrections.find_beyond_noise(View(given)) is None


def test_a_unit_in_which_cameras_hardly_turn_is_not_tried() -> None:
    given = one_way(0)
    tried = [how for how, _ in DegreesForRadians().readings(given)]
    assert 0 < len(tried) < 16
    assert "degrees counter-clockwise from east read as radians" not in tried


def test_the_way_of_cars_that_stand_most_of_the_time_is_where_they_drive() -> None:
    """Two images in three are of cars that stand, as they do when they set out, and whose places tremble by 1 cm."""
    x = np.repeat(np.arange(120.0) * 5.0, np.where(np.arange(120) % 4 == 0, 8, 1))
    way_rad = np.arctan2(1.0, 0.75 * np.cos(x / 40.0))
    place = np.column_stack([x, 30.0 * np.sin(x / 40.0), np.full_like(x, 1.6)])
    place += np.random.default_rng(0).normal(0.0, 0.01, place.shape)
    place, way_rad = np.concatenate([place, place[::-1]]), np.concatenate([way_rad, way_rad[::-1] + np.pi])
    azimuth_rad, moves = azimuths_along(place, np.repeat([0, 1], len(x)), EAST, NORTH)
    assert 240 <= moves.sum() <= 300  # From and to where they stand they move.
    off_rad = np.abs(np.angle(np.exp(1j * (azimuth_rad - way_rad))))
    assert np.degrees(off_rad.max()) < 10.0
