"""Pictures whose width and height are exchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from check_faults import good_city, sides_exchanged
from valuemap.check.fault import View, with_detections
from valuemap.check.lenses import SidesExchanged, with_params
from valuemap.dataset import Dataset


@pytest.fixture(scope="module")
def city() -> Dataset:
    """Every second pass has a camera of its own."""
    return good_city(1, passes_per_street=2)


def test_the_sides_of_one_camera_are_put_back_and_the_other_stays(city: Dataset) -> None:
    cameras, wrong = city.cameras, sides_exchanged(city).cameras
    is_second = cameras.camera_id == 1
    spoiled = replace(
        city,
        cameras=cameras.replace(
            width_px=np.where(is_second, wrong.width_px, cameras.width_px),
            height_px=np.where(is_second, wrong.height_px, cameras.height_px),
        ),
    )
    found = SidesExchanged().find(View(spoiled))
    assert found is not None
    assert found.figures["cameras"] == 1
    assert found.fix is not None
    fixed = found.fix(spoiled).cameras
    assert (fixed.width_px == cameras.width_px).all()
    assert (fixed.height_px == cameras.height_px).all()


def test_boxes_and_principal_points_both_tell(city: Dataset) -> None:
    exchanged = sides_exchanged(city)
    assert SidesExchanged().find(View(exchanged)) is not None
    inside = with_detections(exchanged, center_px=0.5 * exchanged.detections.center_px)
    assert SidesExchanged().find(View(inside)) is None  # As of smaller pictures.
    params = [each.copy() for each in city.cameras.params]
    for each in params:
        each[2:4] = each[3:1:-1]
    assert SidesExchanged().find(View(with_params(city, params))) is None
    assert SidesExchanged().find(View(with_params(exchanged, params))) is None
    assert SidesExchanged().find(View(city)) is None
