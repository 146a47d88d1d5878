"""What the rows of one camera or one pass show alone."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import FAULTS as INJECTED
from check_faults import good_city, good_rig, of_camera
from valuemap.check import boxes, groups
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import Fault, View
from valuemap.dataset import Dataset
from valuemap.progress import silent


@pytest.fixture(scope="module")
def rig() -> Dataset:
    return good_rig(14, passes_per_street=1)


@pytest.mark.parametrize(
    ("name", "camera_id"),
    [("boxes_as_corners", 0), ("boxes_as_corners", 1), ("boxes_normalised", 2)],
)
def test_boxes_of_one_camera_that_mean_something_else_are_named_and_put_right(
    name: str, camera_id: int, rig: Dataset
) -> None:
    spoiled = INJECTED[name].spoil(rig)
    assert spoiled is not None
    found = find_in_stage(View(of_camera(rig, spoiled, camera_id)), "tables", silent)
    assert [(each.fault, each.of) for each in found] == [(name, f"camera {camera_id}")]
    assert found[0].fix is not None
    fixed = found[0].fix(of_camera(rig, spoiled, camera_id)).detections
    np.testing.assert_allclose(fixed.center_px, rig.detections.center_px, atol=1e-9)
    np.testing.assert_allclose(fixed.size_px, rig.detections.size_px, atol=1e-9)


def test_boxes_of_two_cameras_are_put_right_one_after_the_other(rig: Dataset) -> None:
    corners = INJECTED["boxes_as_corners"].spoil(rig)
    assert corners is not None
    spoiled, told = of_camera(of_camera(rig, corners, 0), corners, 2), []
    for known in (frozenset[str](), frozenset({"boxes_as_corners"})):
        (finding,) = find_in_stage(View(spoiled, known=known), "tables", silent)
        assert finding.fix is not None
        told.append(finding.of)
        spoiled = finding.fix(spoiled)
    assert sorted(told, key=str) == ["camera 0", "camera 2"]
    np.testing.assert_allclose(spoiled.detections.center_px, rig.detections.center_px, atol=1e-9)


def test_the_chance_of_one_group_counts_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    given = good_rig(12)
    corners = INJECTED["boxes_top_left"].spoil(given)
    assert corners is not None
    spoiled, fault = View(of_camera(given, corners, 1)), boxes.TopLeftAsCenter()
    found = groups.find_in_groups(spoiled, fault)
    assert found is not None
    assert (found.fault, found.of) == ("boxes_top_left", "camera 1")
    assert found.chance is not None
    own = found.chance / len(groups.groups_of(spoiled.dataset))
    monkeypatch.setattr(groups, "LEAST_CHANCE", 1.5 * own)
    assert groups.find_in_groups(spoiled, fault) is None


@pytest.mark.parametrize("fault", [boxes.CornersAsCenter(), boxes.NormalisedBoxes(), boxes.TopLeftAsCenter()])
def test_good_cameras_and_passes_have_nothing_of_the_kind(fault: Fault) -> None:
    assert fault.is_of_rows
    for given in (good_rig(11, passes_per_street=2), good_city(1)):
        assert groups.find_in_groups(View(given), fault) is None
