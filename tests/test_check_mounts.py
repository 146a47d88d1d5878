"""One camera of a car that looks another way than its poses say, or exposes at another time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from check_faults import RIG_FAULTS, camera_late, exchanged, good_rig, mount_in_degrees, of_camera
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import corrections, mounts, parameters
from valuemap.check.contest import hold_contest
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import View, with_poses
from valuemap.check.groups import Group, groups_of
from valuemap.check.mounts import Bearings, CameraMount, best_turn
from valuemap.check.registry import CONVENTIONS
from valuemap.dataset import Dataset, rows_of
from valuemap.progress import silent


@pytest.fixture(scope="module")
def rig() -> Dataset:
    """Each street is driven once by three cameras."""
    return good_rig(14, passes_per_street=1)


@pytest.fixture(scope="module")
def turned(rig: Dataset) -> View:
    """The mount of a side camera that sees little is read in the wrong unit."""
    return View(mount_in_degrees(rig, 2))


def degrees_off(dataset: Dataset, right: Dataset) -> Floats:
    between = rotation_matrices(dataset.images) @ rotation_matrices(right.images).transpose(0, 2, 1)
    return np.degrees(Rotation.from_matrix(between).magnitude())


def test_a_mount_in_degrees_that_was_read_in_radians_is_named_and_the_camera_turned(rig: Dataset, turned: View) -> None:
    assert degrees_off(turned.dataset, rig)[rig.images.camera_id == 2].min() > 40.0
    found = find_in_stage(turned, "fine", silent)
    assert [(each.fault, each.of) for each in found] == [("camera_mount", "camera 2")]
    assert "60 degrees to the right" in found[0].what
    assert found[0].fix is not None
    assert degrees_off(found[0].fix(turned.dataset), rig).max() < 1.0


def test_no_good_camera_and_no_small_turn_is_another_mount(rig: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    assert CameraMount().find(View(rig)) is None
    aside = Rotation.from_rotvec([0.0, np.radians(6.0), 0.0]).as_matrix() @ rotation_matrices(rig.images)
    small = View(of_camera(rig, with_poses(rig, aside, camera_centers(rig.images)), 1))
    assert CameraMount().find(small) is None
    monkeypatch.setattr(mounts, "SMALL_TURNS_RAD", np.array([0.0]))
    assert CameraMount().find(small) is not None
    assert CameraMount().find(View(rig)) is None  # As its rays gain nothing.
    monkeypatch.setattr(mounts, "LEAST_RISE", 100.0)
    assert CameraMount().find(small) is None


def test_what_rays_may_meet_by_accident_is_no_mount(turned: View, monkeypatch: pytest.MonkeyPatch) -> None:
    found = mounts.turned_by_others(turned, Group(camera_id=2))
    assert found is not None
    groups = len(groups_of(turned.dataset))
    for likely in (
        replace(found, turn=replace(found.turn, chance=2e-3 / groups)),
        replace(found, comparison=replace(found.comparison, chance=0.1 / groups)),
    ):
        monkeypatch.setattr(mounts, "turned_by_others", lambda *_, told=likely: told)
        assert CameraMount().find(turned) is None


def pairs(yaw_deg: float, pitch_deg: float, points: int, times: int, first: int) -> Bearings:
    """Return pairs of a camera that looks so: each of some points is seen so often, from all sides of the picture."""
    cam_from_level = Rotation.from_euler("YX", [yaw_deg, pitch_deg], degrees=True).inv()
    azimuth = np.radians(np.linspace(-25.0, 25.0, points * times))
    ray = np.stack([np.sin(azimuth), np.full(len(azimuth), -0.1), np.cos(azimuth)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    given = Rotation.from_rotvec([0.3, -2.0, 0.5])
    level = cam_from_level.inv().apply(ray)
    return Bearings(level, given.apply(level), ray, first + np.repeat(np.arange(points), times))


def together(*parts: Bearings) -> Bearings:
    return Bearings(
        *(np.concatenate([getattr(each, name) for each in parts]) for name in Bearings.__dataclass_fields__)
    )


def looks(bearings: Bearings) -> tuple[float, float]:
    turn = best_turn(bearings, 0.012)
    assert turn is not None
    forward = (turn.rotation * Rotation.from_rotvec([0.3, -2.0, 0.5])).inv().apply([0.0, 0.0, 1.0])
    return round(float(np.degrees(np.arctan2(forward[0], forward[2]))), 1), round(
        float(np.degrees(np.arcsin(-forward[1]))), 1
    )


def test_a_camera_looks_where_most_points_are_met_and_not_where_a_standing_car_sees_one() -> None:
    right, standing = pairs(60.0, 4.0, 12, 3, 0), pairs(-100.0, 0.0, 4, 200, 50)
    assert looks(right) == (60.0, 4.0)
    assert looks(together(right, standing)) == (60.0, 4.0)
    assert looks(standing) == (-100.0, 0.0)


def test_no_camera_looks_into_the_sky() -> None:
    assert looks(together(pairs(60.0, 4.0, 6, 3, 0), pairs(20.0, 50.0, 12, 3, 50))) == (60.0, 4.0)


def test_two_points_make_no_mount_and_few_among_many_pairs_are_chance() -> None:
    assert best_turn(pairs(60.0, 4.0, 2, 30, 0), 0.012) is None
    few = pairs(60.0, 4.0, 8, 1, 0)
    any_way = np.random.default_rng(5).uniform([-180.0, -20.0], [180.0, 20.0], (500, 2))
    others = [pairs(yaw, pitch, 1, 8, number) for number, (yaw, pitch) in enumerate(any_way)]
    alone, among = best_turn(few, 0.012), best_turn(together(few, *others), 0.012)
    assert alone is not None
    assert among is not None
    assert alone.chance < 1e-6
    assert among.chance > 1e-3


def test_a_camera_that_exposes_late_is_told_by_what_the_others_see(monkeypatch: pytest.MonkeyPatch) -> None:
    """How its rays meet theirs tells how late; how all rays agree is to bear it out."""
    late = View(camera_late(good_rig(42, passes_per_street=1), 2))
    found = corrections.find_of_one_group(late)
    assert found is not None
    assert (found.group, found.parameter.name) == (Group(camera_id=2), "along")
    assert found.value == pytest.approx(-2.4, abs=0.4)  # 0.3 s at 8 m/s.
    monkeypatch.setattr(corrections, "AGAINST", 0.0)
    assert corrections.find_of_one_group(late) is None
    monkeypatch.undo()
    monkeypatch.setattr(corrections, "OF_ONE_CAMERA", parameters.OF_ONE_CAMERA[:-1])
    other = corrections.find_of_one_group(late)
    assert other is None or other.parameter.name != "along"


def test_what_others_tell_of_a_camera_is_followed_as_far_as_rays_agree_the_better(
    rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = View(camera_late(rig, 2))
    found = corrections.find_of_one_group(late)
    assert found is not None
    assert found.value == pytest.approx(-2.4, abs=0.4)
    monkeypatch.setattr(corrections, "follow", lambda _view, best: best)
    assert corrections.find_of_one_group(late) is None


def test_the_main_camera_that_exposes_late_is_named(rig: Dataset) -> None:
    late = RIG_FAULTS["time_shift"].spoil(rig)
    assert late is not None
    assert [(each.fault, each.of) for each in find_in_stage(View(late), "fine", silent)] == [("time_shift", "camera 1")]


@pytest.mark.parametrize("has_poses_of_other", [False, True])
def test_two_cameras_with_the_parameters_of_each_other_are_named_and_put_back(
    has_poses_of_other: bool, rig: Dataset
) -> None:
    """Two files of a calibration are exchanged: that of a side camera with a longer lens and that of the other one."""
    of_first = rig.images.camera_id[rows_of(rig.detections.image_id, rig.images.image_id)] == 0
    middle = rig.cameras.params[0][2:4]
    params = [rig.cameras.params[0] * [1.3, 1.3, 1.0, 1.0], *rig.cameras.params[1:]]
    longer = replace(
        rig,
        cameras=rig.cameras.replace(params=params),
        detections=rig.detections.replace(
            center_px=np.where(
                of_first[:, None], middle + 1.3 * (rig.detections.center_px - middle), rig.detections.center_px
            ),
            size_px=np.where(of_first[:, None], 1.3, 1.0) * rig.detections.size_px,
        ),
    )
    spoiled = replace(longer, cameras=longer.cameras.replace(params=[params[2], params[1], params[0]]))
    spoiled = exchanged(spoiled, 0, 2) if has_poses_of_other else spoiled
    finding = hold_contest(View(spoiled), CONVENTIONS).finding
    assert finding is not None
    what = "poses and parameters" if has_poses_of_other else "parameters"
    assert (finding.fault, finding.figures["reading"]) == (
        "cameras_exchanged",
        f"{what} of cameras 0 and 2 exchanged",
    )
    assert finding.fix is not None
    fixed = finding.fix(spoiled)
    np.testing.assert_array_equal(np.stack(fixed.cameras.params), np.stack(params))
    np.testing.assert_array_equal(fixed.cameras.camera_id, rig.cameras.camera_id)
    np.testing.assert_allclose(camera_centers(fixed.images), camera_centers(rig.images), atol=1e-9)


def test_parameters_that_are_alike_are_not_exchanged(rig: Dataset) -> None:
    assert all(how.startswith("poses of cameras") for how, _ in mounts.CamerasExchanged().readings(rig))
