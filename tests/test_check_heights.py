"""Heights in feet or smaller units above positions in metres, and heights that one pass was imported without."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import FAULTS as INJECTED
from check_faults import FOOT_M, good_city, posed
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import examine
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import View
from valuemap.check.heights import HeightsLeftOut, HeightUnit, SmallHeightUnit
from valuemap.dataset import Dataset
from valuemap.progress import silent


@pytest.fixture(scope="module")
def hilly() -> Dataset:
    """Return a city whose streets go up and down by seven metres."""
    return good_city(0, passes_per_street=2)


def with_heights(dataset: Dataset, height_m: Floats) -> Dataset:
    center = camera_centers(dataset.images)
    return posed(dataset, rotation_matrices(dataset.images), np.column_stack([center[:, :2], height_m]))


def heights(dataset: Dataset) -> Floats:
    return np.asarray(camera_centers(dataset.images)[:, 2])


def test_heights_of_one_pass_in_feet_are_named_and_undone(hilly: Dataset) -> None:
    mine = hilly.images.pass_id.codes == 1
    spoiled = with_heights(hilly, np.where(mine, heights(hilly) / FOOT_M, heights(hilly)))
    outcome = examine(spoiled)
    assert [(each.fault, each.of) for each in outcome.findings] == [
        ("height_unit", f"pass {hilly.images.pass_id.names[1]}")
    ]
    np.testing.assert_allclose(heights(outcome.fixed), heights(hilly), atol=1e-6)


def test_all_heights_are_in_feet_where_single_passes_prove_it(good: Dataset) -> None:
    """Among low hills rays of all agree as well with no heights."""
    spoiled = INJECTED["height_unit"].spoil(good)
    assert spoiled is not None
    finding = HeightUnit().find(View(spoiled))
    assert finding is not None
    assert finding.of is None


def test_heights_in_feet_are_named_alone_and_undone(hilly: Dataset) -> None:
    spoiled = INJECTED["height_unit"].spoil(hilly)
    assert spoiled is not None
    outcome = examine(spoiled)
    assert [(each.fault, each.of) for each in outcome.findings] == [("height_unit", None)]
    np.testing.assert_allclose(heights(outcome.fixed), heights(hilly), atol=1e-6)


@pytest.mark.parametrize(("unit", "factor"), [("centimetres", 100.0), ("millimetres", 1000.0)])
def test_heights_in_small_units_are_named_before_conventions_and_undone(
    unit: str, factor: float, hilly: Dataset
) -> None:
    for mine in (np.ones(len(hilly.images), np.bool_), hilly.images.pass_id.codes == 1):
        spoiled = with_heights(hilly, np.where(mine, factor * heights(hilly), heights(hilly)))
        (finding,) = find_in_stage(View(spoiled), "tables", silent)
        assert finding.fault == "height_unit"
        assert finding.figures["unit"] == unit
        assert finding.of == (None if mine.all() else f"pass {hilly.images.pass_id.names[1]}")
        assert finding.fix is not None
        np.testing.assert_allclose(heights(finding.fix(spoiled)), heights(hilly), atol=1e-6)


@pytest.mark.parametrize("fault", ["inverted_poses", "center_as_translation", "world_axes"])
def test_ways_that_are_steep_for_another_reason_are_not_in_centimetres(fault: str, hilly: Dataset) -> None:
    spoiled = INJECTED[fault].spoil(hilly)
    assert spoiled is not None
    assert SmallHeightUnit().find(View(spoiled)) is None


@pytest.mark.parametrize("sigma_m", [0.3, 0.5, 2.0])
def test_heights_that_waver_are_not_in_feet(sigma_m: float, hilly: Dataset) -> None:
    """Of these, too, rays agree better with a third."""
    random, window = np.random.default_rng(1), np.hanning(40)
    error = np.convolve(random.normal(0.0, sigma_m, len(hilly.images)), window / np.linalg.norm(window), "same")
    assert HeightUnit().find(View(with_heights(hilly, heights(hilly) + error))) is None
    steep = with_heights(hilly, heights(hilly) + 20.0 * error)
    assert SmallHeightUnit().find(View(steep)) is None


def test_a_pass_that_is_moved_up_is_not_in_feet(hilly: Dataset) -> None:
    mine = hilly.images.pass_id.codes == 1
    assert HeightUnit().find(View(with_heights(hilly, heights(hilly) + 8.0 * mine))) is None


def test_a_pass_without_heights_gets_those_of_the_others(hilly: Dataset) -> None:
    spoiled = INJECTED["heights_left_out"].spoil(hilly)
    assert spoiled is not None
    outcome = examine(spoiled)
    assert [each.fault for each in outcome.findings] == ["heights_left_out"]
    off_m = heights(outcome.fixed) - heights(hilly)
    assert np.quantile(np.abs(off_m), 0.95) < 0.5
    assert np.abs(heights(spoiled) - heights(hilly)).max() > 4.0


def test_level_ground_and_good_heights_are_none(hilly: Dataset) -> None:
    level = with_heights(hilly, np.full(len(hilly.images), 2.0))
    for fault in (HeightUnit(), HeightsLeftOut()):
        assert fault.find(View(level)) is None
        assert fault.find(View(hilly)) is None
