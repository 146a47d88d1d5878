"""Positions of a map projection that were imported as a frame of their own."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from check_faults import ANCHOR, good_city
from valuemap.cameras import camera_centers
from valuemap.check import examine as examine_dataset
from valuemap.check.fault import with_centers
from valuemap.check.projection import note_projection
from valuemap.dataset import Dataset, Frame

_LONDON_IN_EPSG_3857_M = [-15_584.73, 6_710_219.08, 35.0]
"""Longitude -0.14, latitude 51.5, by the formula: 6,378,137 times ln(tan(45 + 25.75 degrees)); cos(51.5) is 0.6225."""


@pytest.fixture(scope="module")
def city() -> Dataset:
    """A city about the origin of a frame of its own."""
    return replace(good_city(1, passes_per_street=1), frame=Frame(up=(0.0, 0.0, 1.0)))


def test_positions_far_from_the_origin_of_their_own_frame_are_told_of(
    city: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    stretched = camera_centers(city.images) * [1.6064, 1.6064, 1.0]
    projected = with_centers(city, stretched + _LONDON_IN_EPSG_3857_M)
    monkeypatch.setattr(sys.modules["valuemap.check.examine"], "STAGES", ())
    (note,) = examine_dataset(projected).notes
    assert "6710 km from the origin" in note
    assert "at latitude 51.5 " in note
    assert "1.61 times as large" in note
    assert examine_dataset(city).notes == ()


def test_nothing_is_said_of_what_has_a_place_on_the_earth_or_is_a_long_drive(city: Dataset) -> None:
    center = camera_centers(city.images)
    on_earth = replace(with_centers(city, center + [-15_584.73, 6_710_219.08, 0.0]), frame=Frame(anchor=ANCHOR))
    assert note_projection(on_earth) is None
    assert note_projection(with_centers(city, np.asarray(center + [60e3, 50e3, 0.0]))) is None
    assert note_projection(with_centers(city, np.asarray(center + [480e3, 5.7e6, 0.0]))) is not None
