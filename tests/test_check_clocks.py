"""Poses that were looked up at times of another clock, seconds off."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from check_faults import FAULTS as INJECTED
from check_faults import posed
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers
from valuemap.check import examine
from valuemap.check.cameras import TimeShift
from valuemap.check.clocks import better_by_clock, find_clock
from valuemap.check.fault import View, keep_rows
from valuemap.check.headings import level_rotations
from valuemap.dataset import Dataset, Frame
from valuemap.tables import Cameras, Categories, Detections, Images

FOCAL_PX, SIDES_PX, STEP_S = 500.0, (640, 480), 0.25


def way(time_s: Floats) -> tuple[Floats, Floats]:
    """Return where (N, 3) a car is that winds along at 7 to 10 m/s, and its azimuth (N)."""
    x, y = 7.0 * time_s, 40.0 * np.sin(time_s / 6.0)
    azimuth = np.arctan2(np.full_like(time_s, 7.0), 40.0 / 6.0 * np.cos(time_s / 6.0))
    return np.stack([x, y, np.full_like(x, 1.5)], axis=1), azimuth


def winding(late_s: tuple[float, ...]) -> Dataset:
    """Return a drive of each pass with the poses of so many seconds before; lamps along the road are seen exactly."""
    random = np.random.default_rng(4)
    lamps = way(np.arange(-20.0, 140.0, 1.3))[0]
    lamps += np.stack(
        [random.uniform(-9.0, 9.0, len(lamps)) for _ in range(2)] + [random.uniform(1.0, 5.0, len(lamps))], 1
    )
    frame, each_s = Frame(up=(0.0, 0.0, 1.0)), np.arange(0.0, 100.0, STEP_S)
    time_s = np.concatenate([each_s + 1000.0 * number for number in range(len(late_s))])
    late, seen_s = np.repeat(late_s, len(each_s)), np.tile(each_s, len(late_s))
    (seen_from, azimuth), (center, looks) = way(seen_s), way(seen_s - late)
    in_cam = np.einsum("nij,npj->npi", level_rotations(azimuth, frame), lamps - seen_from[:, None])
    px = FOCAL_PX * in_cam[..., :2] / in_cam[..., 2:] + np.array(SIDES_PX) / 2.0
    is_seen = (in_cam[..., 2] > 5.0) & (in_cam[..., 2] < 45.0) & np.all((px > 0.0) & (px < SIDES_PX), axis=2)
    row, lamp = np.nonzero(is_seen)
    count = len(row)
    images = Images(
        image_id=np.arange(len(time_s)),
        name=pa.array([f"{number:05d}.jpg" for number in range(len(time_s))]),
        camera_id=np.zeros(len(time_s), np.int64),
        cam_from_world_quat=np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1)),
        cam_from_world_m=np.zeros((len(time_s), 3)),
        pass_id=Categories.from_texts([f"pass-{number}" for number in np.repeat(np.arange(len(late_s)), len(each_s))]),
        timestamp_s=time_s,
    )
    detections = Detections(
        detection_id=np.arange(count),
        image_id=row,
        class_name=Categories.from_texts(["lamp"] * count),
        center_px=px[row, lamp] + random.normal(0.0, 0.5, (count, 2)),
        size_px=FOCAL_PX * 0.5 / in_cam[row, lamp, 2:] * np.ones((1, 2)),
        score=np.ones(count),
    )
    cameras = Cameras(
        camera_id=np.array([0]),
        model=Categories.from_texts(["PINHOLE"]),
        width_px=np.array([SIDES_PX[0]]),
        height_px=np.array([SIDES_PX[1]]),
        params=[np.array([FOCAL_PX, FOCAL_PX, SIDES_PX[0] / 2.0, SIDES_PX[1] / 2.0])],
    )
    empty = Dataset("winding", frame, cameras, images, detections)
    return posed(empty, level_rotations(looks, frame), center)


@pytest.fixture(scope="module")
def good() -> Dataset:
    return winding((0.0, 0.0, 0.0))


@pytest.mark.parametrize("late_s", [18.0, -6.0])
def test_a_clock_that_is_seconds_off_is_named_and_undone(late_s: float, good: Dataset) -> None:
    found = better_by_clock(View(winding((late_s,) * 3)), None)
    assert found is not None
    assert (found.fault, found.of) == ("time_shift", None)
    assert found.figures["shift_s"] == pytest.approx(late_s, abs=0.1)
    assert ("behind" in found.what) == (late_s > 0.0)
    assert found.fix is not None
    fixed = found.fix(winding((late_s,) * 3))
    # No pose is known at one end of each pass.
    assert len(fixed.images) == pytest.approx(3 * (100.0 - abs(late_s)) / STEP_S, abs=5)
    there = camera_centers(good.images)[np.isin(good.images.image_id, fixed.images.image_id)]
    assert np.abs(camera_centers(fixed.images) - there).max() < 1.0
    assert set(fixed.detections.image_id) <= set(fixed.images.image_id)


def test_a_clock_of_one_pass_is_named_and_the_others_stay(good: Dataset) -> None:
    given = winding((0.0, 18.0, 0.0))
    found = better_by_clock(View(given), None)
    assert found is not None
    assert (found.fault, found.of) == ("pass_time_shift", "pass pass-1")
    assert found.figures["shift_s"] == pytest.approx(18.0, abs=0.1)
    assert found.fix is not None
    fixed = found.fix(given)
    kept, same = (keep_rows(each, images=each.images.pass_id.codes != 1).images for each in (fixed, good))
    np.testing.assert_allclose(camera_centers(kept), camera_centers(same), atol=1e-9)


def test_good_poses_are_of_no_other_time(good: Dataset) -> None:
    assert find_clock(View(good)) is None


def test_without_times_there_is_no_clock() -> None:
    given = winding((18.0, 18.0, 18.0))
    given = replace(given, images=given.images.replace(timestamp_s=None))
    assert find_clock(View(given)) is None


def test_a_clock_is_told_by_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    given, module = winding((18.0, 18.0, 18.0)), sys.modules["valuemap.check.examine"]
    monkeypatch.setattr(module, "FAULTS", ())
    outcome = examine(given)
    assert [each.fault for each in outcome.findings] == ["time_shift"]
    assert outcome.notes == ()
    monkeypatch.setattr(module, "better_by_clock", lambda _, finding: finding)
    assert [each.fault for each in examine(given).findings] != ["time_shift"]


def test_leap_seconds_of_the_benchmark_leave_the_images_that_have_a_pose_then() -> None:
    good = winding((0.0,))
    spoiled, kept = INJECTED["leap_seconds"].spoil(good), INJECTED["leap_seconds"].compared(good)
    assert spoiled is not None
    assert np.array_equal(spoiled.images.image_id, np.arange(round(18.0 / STEP_S), 400))
    assert np.array_equal(kept.images.image_id, np.arange(round(18.0 / STEP_S), 400 - round(18.0 / STEP_S)))
    late = camera_centers(winding((18.0,)).images)
    np.testing.assert_allclose(camera_centers(spoiled.images), late[spoiled.images.image_id], atol=1e-6)


def test_a_second_is_named_where_nothing_smaller_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays of a drive that is a second off agree half as well and more, as they do by many a small error."""
    module = sys.modules["valuemap.check.cameras"]
    monkeypatch.setattr(module, "best_correction", lambda _: None)
    view = View(winding((1.0, 1.0, 1.0)))
    found = TimeShift().find(view)
    assert found is not None
    assert found.figures["shift_s"] == pytest.approx(1.0, abs=0.1)
