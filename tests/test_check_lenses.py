"""Pictures whose width and height are exchanged, and focal lengths in other units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from check_faults import good_city, sides_exchanged
from valuemap.check.contest import hold_contest
from valuemap.check.fault import View, with_detections
from valuemap.check.lenses import FocalUnit, SidesExchanged, with_params
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


@pytest.mark.parametrize(
    ("width_mm", "how"),
    [
        (5.8, "focal lengths in millimetres of a sensor 5.8 mm wide"),
        (23.5, "focal lengths in millimetres of a sensor 23.5 mm wide"),
        (36.0, "focal lengths in millimetres of film 36 mm wide"),
        (1.0, "focal lengths in shares of the longer side of the picture"),
    ],
)
def test_focal_lengths_are_in_the_unit_that_lenses_have(city: Dataset, width_mm: float, how: str) -> None:
    """What EXIF says of a phone, 4.2 mm, is no share of its picture."""
    params = [each.copy() for each in city.cameras.params]
    longer = np.maximum(city.cameras.width_px, city.cameras.height_px)
    for each, px in zip(params, longer.tolist(), strict=True):
        each[:2] *= width_mm / px
    given = with_params(city, params)
    finding = hold_contest(View(given), [FocalUnit()]).finding
    assert finding is not None
    assert f"Read as {how}," in finding.why
    assert finding.fix is not None
    for fixed, right in zip(finding.fix(given).cameras.params, city.cameras.params, strict=True):
        np.testing.assert_allclose(fixed, right)


def test_units_are_tried_that_a_lens_can_have(city: Dataset) -> None:
    def units(focal: float) -> list[str]:
        params = [np.array([focal, focal, *each[2:]]) for each in city.cameras.params]
        return [how for how, _ in FocalUnit().readings(with_params(city, params))]

    assert not any("share" in how for how in units(2.1))
    assert any("share" in how for how in units(1.9))
    assert sum("sensor" in how for how in units(1.6)) == 8
    assert not any("sensor" in how for how in units(1.4))
