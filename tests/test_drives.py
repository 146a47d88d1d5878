"""Driving order: told by times, names or places, never by ids, rows or what passes are called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from scenes import as_dataset, random_scene
from valuemap.arrays import Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.drives import Drives, are_dates, find_drives, in_driving_order
from valuemap.simulate import simulate
from valuemap.tables import Categories, Images

AHEAD, LEFT = 0.0, 90.0


def posed(
    center_m: Floats,
    *,
    heading_deg: Any = 0.0,
    time_s: Any = None,
    names: Sequence[str] | None = None,
    passes: Sequence[str] | None = None,
    camera: Any = 1,
) -> Images:
    """Return level cameras at places (N, 2 or 3) that look along x, turned to the left by some degrees."""
    count = len(center_m)
    center = np.column_stack([center_m, np.full(count, 1.6)]) if center_m.shape[1] == 2 else center_m
    level = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    turn = Rotation.from_euler("z", -np.broadcast_to(heading_deg, count)[:, None], degrees=True)
    rotation = Rotation.from_matrix(level @ turn.as_matrix())
    return Images(
        image_id=np.arange(count),
        name=pa.array(names or [f"{i * 7919 % 1000003:x}.jpg" for i in range(count)], pa.string()),
        camera_id=np.broadcast_to(camera, count).astype(np.int64),
        cam_from_world_quat=rotation.as_quat(canonical=True, scalar_first=True),
        cam_from_world_m=-rotation.apply(center),
        pass_id=Categories.from_texts(passes or ["all"] * count),
        timestamp_s=time_s,
    )


def street(count: int, *, step_m: float = 2.0, seed: int = 0, y_m: float = 0.0) -> Floats:
    random = np.random.default_rng(seed)
    x = np.cumsum(step_m * random.uniform(0.8, 1.2, count))
    return np.column_stack([x, y_m + random.normal(0.0, 0.05, count)])


def stack(*parts: Images) -> Images:
    """Return images under each other, numbered anew."""
    timed = parts[0].timestamp_s is not None
    return Images(
        image_id=np.arange(sum(map(len, parts))),
        name=pa.concat_arrays([p.name for p in parts]),
        camera_id=np.concatenate([p.camera_id for p in parts]),
        cam_from_world_quat=np.concatenate([p.cam_from_world_quat for p in parts]),
        cam_from_world_m=np.concatenate([p.cam_from_world_m for p in parts]),
        pass_id=Categories.from_texts([text for p in parts for text in p.pass_id.texts()]),
        timestamp_s=np.concatenate([p.timestamp_s for p in parts]) if timed else None,
    )


def same(a: Drives, b: Drives) -> bool:
    return (
        np.array_equal(a.pass_code, b.pass_code)
        and np.array_equal(a.order, b.order)
        and np.array_equal(a.driven_m, b.driven_m)
        and np.array_equal(a.viewpoint, b.viewpoint)
    )


def shuffled(images: Images, seed: int) -> tuple[Images, Ints]:
    """Return the same images in another order, with other ids of images and cameras and other names of passes."""
    random = np.random.default_rng(seed)
    rows = random.permutation(len(images))
    mixed = images.take(rows)
    other = [f"{random.integers(10**9)}-{i}" for i in range(len(images.pass_id.names))]
    cameras = np.unique(images.camera_id)
    ids = random.permutation(10 * len(cameras))[: len(cameras)]
    return (
        mixed.replace(
            image_id=np.arange(len(images)),
            pass_id=Categories.from_texts([other[code] for code in mixed.pass_id.codes]),
            camera_id=ids[np.searchsorted(cameras, mixed.camera_id)],
        ),
        rows,
    )


def a_city() -> Images:
    config = SimulationConfig(images=1500)
    return simulate(config, seed=5).images


def test_times_tell_the_order_and_pauses_and_jumps_end_a_drive() -> None:
    place = street(60)
    time = np.arange(60.0)
    time[20:] += 3600.0  # A break.
    place[40:] += [0.0, 500.0]  # A jump.
    found = find_drives(posed(place, time_s=time))
    assert found.pass_code.tolist() == [0] * 20 + [1] * 20 + [2] * 20
    assert found.order.tolist() == [*range(20)] * 3
    assert found.record["cut_at"] == {"pauses": 1, "jumps": 1}
    assert found.record["images_ordered_by"] == {"time": 60}


def test_images_without_a_time_make_no_date_of_the_times_of_others() -> None:
    time = np.arange(60.0)
    time[20:40] = np.nan
    images = posed(street(60), time_s=time)
    assert not are_dates(images).any()
    assert find_drives(images).record["images_ordered_by"] == {"time": 40, "chain": 20}
    assert are_dates(images.replace(timestamp_s=np.where(np.isnan(time), 7e4, time))).all()


def test_of_one_box_the_class_and_then_the_score_come_first_and_ids_say_nothing() -> None:
    dataset = as_dataset(random_scene(3, images=6, objects=4, clutter=12))
    detections, count = dataset.detections, len(dataset.detections)
    names, score = ["sign"] * count + ["light"] * 2 * count, np.repeat([0.5, 0.9, 0.6], count)
    thrice = detections.take(np.tile(np.arange(count), 3)).replace(class_name=Categories.from_texts(names), score=score)
    for seed in range(2):
        rows = np.random.default_rng(seed).permutation(3 * count)
        mixed = replace(dataset, detections=thrice.take(rows).replace(detection_id=np.arange(3 * count)))
        found = in_driving_order(mixed).dataset.detections
        assert found.class_name.texts() == ["light", "light", "sign"] * count
        assert found.score.tolist() == [0.6, 0.9, 0.5] * count


def test_a_red_light_and_a_stretch_without_images_end_no_drive() -> None:
    place = street(80)
    time = np.arange(80.0)
    time[30:] += 60.0  # Waits.
    time[50:] += 100.0  # Drives on, for 200 m.
    place[50:, 0] += 200.0
    assert find_drives(posed(place, time_s=time)).count == 1
    # The same without times is a jump.
    assert find_drives(posed(place, names=[f"{i}.jpg" for i in range(80)])).count == 2
    # But not where numbers were left out.
    numbers = np.arange(80) + 100 * (np.arange(80) >= 50)
    assert find_drives(posed(place, names=[f"{i}.jpg" for i in numbers])).count == 1


def test_numbers_in_names_are_numbers() -> None:
    place = street(120)
    names = [f"drive 7/frame{i}.jpg" for i in range(120)]  # Not padded: as texts they are out of order.
    found = find_drives(posed(place, names=names))
    assert found.order.tolist() == list(range(120))
    assert found.record["images_ordered_by"] == {"name": 120}


def test_times_of_day_in_names_run() -> None:
    place = street(200)
    names = [f"2024-05-01T{9 + i // 120:02d}-{i // 2 % 60:02d}-{30 * (i % 2):02d}.jpg" for i in range(200)]
    assert find_drives(posed(place, names=names)).order.tolist() == list(range(200))


def test_numbers_and_times_that_jump_about_are_not_believed() -> None:
    place = street(100)
    random = np.random.default_rng(1)
    mixed = random.permutation(100)
    for images in (
        posed(place, names=[f"{i:04d}.jpg" for i in mixed]),
        posed(place, time_s=mixed.astype(np.float64)),
    ):
        found = find_drives(images)
        assert found.record["images_ordered_by"] == {"chain": 100}
        assert found.count == 1
        assert found.order.tolist() in (list(range(100)), list(range(99, -1, -1)))
    # Where times lie, names are asked before places are.
    found = find_drives(posed(place, time_s=mixed.astype(np.float64), names=[f"{i}.jpg" for i in range(100)]))
    assert found.record["images_ordered_by"] == {"name": 100}
    assert found.order.tolist() == list(range(100))


def test_a_car_that_waits_is_still_on_its_way() -> None:
    random = np.random.default_rng(3)
    place = np.concatenate([street(30), np.tile(street(30)[-1], (40, 1)), street(30) + street(30)[-1] + [1.0, 0.0]])
    place += random.normal(0.0, 0.02, place.shape)
    found = find_drives(posed(place, time_s=0.5 * np.arange(100)))
    assert found.record["images_ordered_by"] == {"time": 100}
    assert found.count == 1
    assert len(np.unique(found.viewpoint[30:70])) == 1
    assert len(np.unique(found.viewpoint)) == pytest.approx(60, abs=5)


@pytest.mark.parametrize("seed", range(3, 6))
def test_poses_that_tremble_by_a_step_while_a_car_waits_make_no_way(seed: int) -> None:
    along_m = 0.5 * np.concatenate([np.arange(300), np.full(600, 300), np.arange(300, 600)])  # Ten images a second.
    place = np.column_stack([along_m, np.zeros(1200)])
    place += np.random.default_rng(seed).normal(0.0, 0.3, place.shape)
    assert find_drives(posed(place, time_s=0.1 * np.arange(1200))).record["cut_at"] == {}


def test_cameras_that_expose_at_once_pause_no_more_than_each_of_them() -> None:
    # Poses of their own, which tremble by more than half a step, so that they are no rig.
    random = np.random.default_rng(0)
    along_m = np.column_stack([0.5 * np.arange(300), np.zeros(300)])
    cameras = [
        posed(
            along_m + random.normal(0.0, 0.3, (300, 2)),
            time_s=0.1 * np.arange(300),
            names=[f"{camera}/{i}.jpg" for i in range(300)],
            camera=camera,
        )
        for camera in range(1, 8)
    ]
    found = find_drives(stack(*cameras))
    assert (found.record["rigs"], found.record["cut_at"], found.count) == (0, {}, 1)


def test_a_street_driven_again_is_another_drive() -> None:
    angle = np.linspace(0.0, 6.0 * np.pi, 600)  # Three laps of 377 m.
    place = 60.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    found = find_drives(posed(place, time_s=np.arange(600.0)))
    # Each ends a few steps before it is closed, so that a rest is left.
    assert found.count == 4
    assert found.record["cut_at"] == {"revisits": 3}
    assert np.bincount(found.pass_code).tolist() == pytest.approx([190, 190, 190, 30], abs=15)
    # There and back in the other lane.
    there = street(100)
    back = there[::-1] + [0.0, 4.0]
    found = find_drives(posed(np.concatenate([there, back]), time_s=np.arange(200.0)))
    assert found.count == 2
    assert np.bincount(found.pass_code).tolist() == pytest.approx([100, 100], abs=20)


def rig(passes: str, *, times: bool = True, cameras: Sequence[int] = (1, 2), late_s: float = 0.0) -> Images:
    """Return two cameras of one car that turns, the second 1 m behind and to the left of the first."""
    heading = np.concatenate([np.zeros(40), np.linspace(0.0, np.pi / 2, 20), np.full(40, np.pi / 2)])
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    front = np.cumsum(2.0 * ahead, axis=0) + np.random.default_rng(2).normal(0.0, 0.05, (100, 2))
    side = front - ahead + 0.5 * np.column_stack([-ahead[:, 1], ahead[:, 0]])
    parts = [
        posed(
            place,
            heading_deg=np.degrees(heading) + look,
            time_s=0.3 * np.arange(100) + late * late_s if times else None,
            names=[f"{folder}/{i}.jpg" for i in range(100)],
            passes=[folder if passes == "folder" else "all"] * 100,
            camera=number,
        )
        for place, look, folder, number, late in zip(
            (front, side), (AHEAD, LEFT), ("cam0", "cam1"), cameras, (0, 1), strict=True
        )
    ]
    return stack(*parts)


@pytest.mark.parametrize("late_s", [0.0, 0.03])
@pytest.mark.parametrize("times", [True, False])
@pytest.mark.parametrize("cameras", [(1, 2), (1, 1)])
@pytest.mark.parametrize("passes", ["folder", "all"])
def test_cameras_of_one_car_share_its_drive(passes: str, times: bool, cameras: tuple[int, int], late_s: float) -> None:
    found = find_drives(rig(passes, times=times, cameras=cameras, late_s=late_s))
    if passes == "all" and cameras == (1, 1) and late_s and times:
        # One camera, as far as can be seen: its images are in order.
        assert found.count == 1
        return
    assert found.count == 1
    assert found.record["images_on_rigs"] == 200
    assert found.order.tolist() == [*range(100)] * 2
    assert np.array_equal(found.viewpoint[:100], found.viewpoint[100:])
    # The way is that of one camera, not from one to the other and back.
    assert found.driven_m.max() == pytest.approx(198.0, rel=0.03)


def test_two_cars_at_one_time_are_no_rig() -> None:
    one = posed(street(100, seed=1), time_s=np.arange(100.0), passes=["a"] * 100, camera=1)
    two = posed(street(100, step_m=2.3, seed=2, y_m=4.0), time_s=np.arange(100.0), passes=["b"] * 100, camera=2)
    assert find_drives(stack(one, two)).record["images_on_rigs"] == 0
    assert find_drives(stack(one, two)).count == 2


def test_two_drives_with_the_same_numbers_are_no_rig() -> None:
    straight = street(100)
    parts = [
        posed(
            straight + [0.0, 3.0 * i],
            names=[f"{name}/{k}.jpg" for k in range(100)],
            passes=[name] * 100,
        )
        for i, name in enumerate("ab")
    ]
    assert find_drives(stack(*parts)).count == 2


def test_rig_id_joins_whatever_the_rest_says() -> None:
    images = rig("folder", times=False).replace(
        name=pa.array([f"{i:x}" for i in np.random.default_rng(0).permutation(200) + 10**9])
    )
    assert find_drives(images).count == 2
    found = find_drives(images.replace(rig_id=np.tile(np.arange(100), 2)))
    assert found.count == 1
    assert np.array_equal(found.order[:100], found.order[100:])


@pytest.mark.parametrize("per_s", [2, 4])
def test_images_of_one_camera_at_whole_seconds_follow_each_other(per_s: int) -> None:
    """There and back: the places of one second are in the order in which the car comes to them."""
    there = street(80, step_m=5.0)
    way = np.concatenate([there, there[::-1] + [0.0, 4.0]])
    heading_deg = np.repeat([0.0, 180.0], 80)
    names = np.random.default_rng(3).permutation(160)
    images = posed(
        way, heading_deg=heading_deg, time_s=1.7e9 + np.arange(160) // per_s, names=[f"{name:x}.jpg" for name in names]
    )
    found = find_drives(images)
    assert found.record["images_on_rigs"] == 0
    assert np.array_equal(np.argsort(found.pass_code * 1000 + found.order), np.arange(160))


def test_cars_mixed_in_one_pass_are_told_apart_by_their_cameras() -> None:
    one = posed(street(100, seed=1), time_s=np.arange(100.0), camera=1)
    two = posed(street(100, seed=2, y_m=300.0), time_s=np.arange(100.0) + 0.5, camera=2)
    found = find_drives(stack(one, two))
    assert found.pass_code.tolist() == [0] * 100 + [1] * 100
    assert found.record["images_ordered_by"] == {"time": 200}


def test_a_collection_without_order_becomes_short_drives() -> None:
    random = np.random.default_rng(0)
    far = 2500.0 * random.normal(0.0, 3.0, (12, 2))
    found = find_drives(posed(far))
    assert len(np.unique(found.order * 1000 + found.pass_code)) == 12
    # Panoramas every 10 m along two streets, all of one month, in any order.
    streets = np.concatenate([street(60, step_m=10.0), street(60, step_m=10.0, seed=1, y_m=400.0)])
    rows = random.permutation(120)
    found = find_drives(posed(streets[rows], time_s=np.full(120, 1.7e9)))
    assert found.record["images_ordered_by"] == {"chain": 120}
    assert found.count == 2
    along = np.argsort(found.pass_code * 1000 + found.order)
    assert np.max(np.sort(np.linalg.norm(np.diff(streets[rows][along], axis=0), axis=1))[:-1]) < 15.0


def test_one_image_and_images_all_in_one_place() -> None:
    assert find_drives(posed(np.zeros((1, 2)))).count == 1
    found = find_drives(posed(np.zeros((50, 2)), time_s=np.arange(50.0)))
    assert found.count == 1
    assert set(found.viewpoint.tolist()) == {0}
    assert find_drives(posed(np.zeros((50, 2)))).count >= 1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["city", "city without times", "rig", "rig by names", "one pass"])
def test_ids_rows_and_names_of_passes_mean_nothing(kind: str, seed: int) -> None:
    if kind.startswith("rig"):
        images = rig("folder", times=kind == "rig")
    else:
        images = a_city()
        if kind == "city without times":
            images = images.replace(timestamp_s=None)
        if kind == "one pass":
            images = images.replace(pass_id=Categories.from_texts(["all"] * len(images)))
    mixed, rows = shuffled(images, seed)
    assert same(find_drives(mixed), find_drives(images).take(rows))


def test_a_city_has_the_passes_that_were_driven() -> None:
    images = a_city()
    found = find_drives(images)
    # Each drive is of one pass, and in its order of time.
    pairs = np.unique(np.stack([found.pass_code, images.pass_id.codes]), axis=1)
    assert pairs.shape[1] == found.count
    along = np.lexsort((found.order, found.pass_code))
    assert images.timestamp_s is not None
    time = images.timestamp_s[along]
    assert np.all(np.diff(time)[np.diff(found.pass_code[along]) == 0] > 0.0)
    # One pass for all is cut at the same gaps.
    merged = find_drives(images.replace(pass_id=Categories.from_texts(["all"] * len(images))))
    pairs = np.unique(np.stack([merged.pass_code, images.pass_id.codes]), axis=1)
    assert pairs.shape[1] == merged.count


def literal_viewpoints(place_m: Floats, step_m: float) -> list[int]:
    number, start, result = 0, place_m[0], []
    for place in place_m:
        if np.linalg.norm(place - start) > step_m:
            number, start = number + 1, place
        result.append(number)
    return result


@pytest.mark.parametrize("step_m", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("drives", [1, 40])
def test_viewpoints_are_those_of_looking_back_at_each(step_m: float, drives: int) -> None:
    random = np.random.default_rng(7)
    places = np.cumsum(random.normal(0.0, 0.5, (drives, 300, 2)) + [0.4, 0.0], axis=1)
    places[:, :, 1] += 1e4 * np.arange(drives)[:, None]
    time = (1e6 * np.arange(drives)[:, None] + np.arange(300.0)).reshape(-1)
    passes = [str(i) for i in range(drives) for _ in range(300)]
    found = find_drives(posed(places.reshape(-1, 2), time_s=time, passes=passes), viewpoint_step_m=step_m)
    for drive in range(found.count):
        rows = np.flatnonzero(found.pass_code == drive)
        rows = rows[np.argsort(found.order[rows])]
        place = places.reshape(-1, 2)[rows]
        expected = literal_viewpoints(place, step_m)
        assert (found.viewpoint[rows] - found.viewpoint[rows[0]]).tolist() == expected
        begins = [expected.index(number) for number in range(expected[-1] + 1)]
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place[begins], axis=0), axis=1))])
        assert found.driven_m[rows] == pytest.approx(way[expected])
    assert len(np.unique(found.viewpoint)) == found.viewpoint.max() + 1


@pytest.mark.parametrize("times", [True, False])
def test_a_camera_for_each_image_hides_no_rig(times: bool) -> None:
    images = rig("all", times=times)
    found = find_drives(images.replace(camera_id=np.arange(200)))
    assert found.record["images_on_rigs"] == 200
    assert found.order.tolist() == [*range(100)] * 2


def test_a_drive_that_mostly_stands_is_measured_by_the_others() -> None:
    random = np.random.default_rng(4)
    parts = []
    for number in range(5):
        place = street(60, seed=number, y_m=100.0 * number)
        if number == 0:
            place = np.concatenate([place[:30], place[30] + random.normal(0.0, 0.02, (400, 2)), place[30:]])
        time = 10_000.0 * number + np.arange(len(place))
        parts.append(posed(place, time_s=time, passes=[str(number)] * len(place)))
    assert find_drives(stack(*parts)).count == 5


def test_numbers_count_within_what_is_before_them_in_the_name() -> None:
    """Frames of clips, of which some were left out; all in one pass."""
    numbers = np.concatenate([np.arange(0, 30), np.arange(100, 130)])
    place = np.column_stack([2.0 * numbers, np.zeros(60)])
    clips = np.concatenate([place, place[::-1] + [0.0, 5000.0]])
    names = [f"clip{clip}_{number}.jpg" for clip in (1, 2) for number in numbers]
    found = find_drives(posed(clips, names=names))
    assert found.record["images_ordered_by"] == {"name": 120}
    assert found.pass_code.tolist() == [0] * 60 + [1] * 60
    # The next clip goes on with the next number, elsewhere.
    names = [f"clip1_{number}.jpg" for number in numbers] + [f"clip2_{4000 + number}.jpg" for number in numbers]
    assert find_drives(posed(clips, names=names)).count == 2


def test_a_ramp_in_turns_is_a_way_though_it_leads_round_and_round() -> None:
    angle = np.arange(120) * 2.0 * np.pi / 14.0
    ramp = np.column_stack([4.5 * np.cos(angle), 4.5 * np.sin(angle), 4.0 * angle / np.pi])
    assert find_drives(posed(ramp, time_s=np.arange(120.0))).record["images_ordered_by"] == {"time": 120}


def test_where_no_order_is_known_nothing_is_driven_again() -> None:
    angle = np.linspace(0.0, 6.0 * np.pi, 600)
    place = 60.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    found = find_drives(posed(place[np.random.default_rng(0).permutation(600)]))
    assert found.record["images_ordered_by"] == {"chain": 600}
    assert "revisits" not in found.record["cut_at"]


def test_what_the_fullest_camera_missed_the_others_took_together() -> None:
    place = street(100)
    parts = [
        posed(place[:, :2] + [0.0, 0.5 * number], heading_deg=90.0 * number, time_s=np.arange(100.0), camera=number)
        for number in range(3)
    ]
    # The first misses the last twenty, the others ten each before.
    parts = [
        parts[0].take(np.arange(85)),
        parts[1].take(np.r_[0:20, 40:100]),
        parts[2].take(np.r_[0:40, 60:100]),
    ]
    found = find_drives(stack(*parts))
    order = [found.order[start : start + count] for start, count in ((0, 85), (85, 80), (165, 80))]
    assert order[1][-15:].tolist() == order[2][-15:].tolist() == list(range(85, 100))


def three_passes_of_a_rig(
    missing: float, name: str, *, folders: Sequence[str], back: bool, one_camera: bool
) -> tuple[Images, Ints]:
    """Return four cameras of one car without times, of which images are missing, and the exposure (N) of each image.

    `name` is what images are called, of a `drive`, a `folder`, a `number`, and the camera's `own` number.
    """
    random = np.random.default_rng(1)
    parts, exposure = [], []
    mounts = ((0.0, 0.0, 0.0), (-0.3, 0.5, 80.0), (-0.3, -0.5, -80.0), (-1.5, 0.0, 180.0))
    for drive in range(3):
        way = street(80, step_m=5.0, seed=drive, y_m=3.0 * drive)
        way = way[::-1] if back else way
        for camera, (ahead_m, left_m, look_deg) in enumerate(mounts):
            offset = (-1.0 if back else 1.0) * np.array([ahead_m, left_m])
            names = [
                name.format(drive=drive, folder=folders[camera], number=i, own=1000 * camera + i) for i in range(80)
            ]
            taken = np.flatnonzero(random.random(80) >= missing)
            images = posed(
                way + offset + random.normal(0.0, 0.05, (80, 2)),
                heading_deg=look_deg + 180.0 * back,
                names=names,
                passes=[str(drive)] * 80,
                camera=0 if one_camera else camera,
            )
            parts.append(images.take(taken))
            exposure.append(1000 * drive + taken)
    return stack(*parts), np.concatenate(exposure)


@pytest.mark.parametrize("missing", [0.0, 0.15, 0.4])
@pytest.mark.parametrize("back", [False, True])
@pytest.mark.parametrize("one_camera", [False, True])
@pytest.mark.parametrize(
    ("name", "folders", "rig_ids"),
    [
        ("fahrt{drive}/{folder}/bild{number:04d}.jpg", ("front", "left", "rechts", "rear"), True),
        ("fahrt{drive}/{folder}/bild{number:04d}.jpg", ("m", "z", "a", "c"), False),
        ("fahrt{drive}/{number}_{folder}.jpg", ("m", "z", "a", "c"), True),
        ("fahrt{drive}/{number}_{folder}.jpg", ("cam3", "cam0", "cam2", "cam1"), False),
        # Names of one camera have a number more. Each camera counts on its own. Only rig ids tell exposures then.
        ("fahrt{drive}/{folder}/{number}.jpg", ("front", "left", "cam2", "rear"), True),
        ("fahrt{drive}/{folder}/{own}.jpg", ("m", "z", "a", "c"), True),
    ],
)
def test_images_that_a_rig_lacks_leave_the_order_that_names_tell(
    name: str, folders: Sequence[str], rig_ids: bool, one_camera: bool, back: bool, missing: float
) -> None:
    images, exposure = three_passes_of_a_rig(missing, name, folders=folders, back=back, one_camera=one_camera)
    if rig_ids:
        images = images.replace(rig_id=exposure)
    found = find_drives(images)
    assert found.count == 3
    assert found.record["images_ordered_by"] == {"name": len(images)}
    along = np.lexsort((found.order, found.pass_code))
    assert np.all(np.diff(exposure[along])[np.diff(found.pass_code[along]) == 0] >= 0)
    mixed, rows = shuffled(images, 2)
    assert same(find_drives(mixed), found.take(rows))


@pytest.mark.parametrize("turn_deg", [0.0, 130.0, 180.0])
@pytest.mark.parametrize("per_second", [2.0, 2.7, 4.0])
def test_several_images_within_a_second_of_one_camera_are_no_rig(per_second: float, turn_deg: float) -> None:
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()[:2, :2]
    place = street(120, step_m=5.0) @ turn.T
    time = 0.01 + np.arange(120) / per_second
    names = [f"pano{i}.jpg" for i in range(120)]
    exact = find_drives(posed(place, heading_deg=turn_deg, time_s=time, names=names))
    found = find_drives(posed(place, heading_deg=turn_deg, time_s=np.floor(time), names=names))
    assert found.record["rigs"] == 0
    assert found.record["images_ordered_by"] == {"time": 120}
    assert same(found, exact)


@pytest.mark.parametrize("aside_m", [-0.5, 0.5])
@pytest.mark.parametrize("names", ["{camera}/{i}.jpg", "{i}_{camera}.jpg", "{random}.jpg"])
def test_two_lenses_that_look_the_same_way_are_a_rig_though_they_share_a_camera(names: str, aside_m: float) -> None:
    place = street(100, step_m=5.0)
    random = np.random.default_rng(0).permutation(200)
    parts = [
        posed(
            place + [0.0, aside_m * camera],
            time_s=np.arange(100.0),
            names=[names.format(camera=f"cam{camera}", i=i, random=random[i + 100 * camera]) for i in range(100)],
        )
        for camera in range(2)
    ]
    assert find_drives(stack(*parts)).record["images_on_rigs"] == 200


def test_a_camera_behind_another_is_told_by_its_name() -> None:
    place = street(100, step_m=5.0)
    parts = [
        posed(place - [2.5 * c, 0.0], time_s=np.arange(100.0), names=[f"cam{c}/{i}.jpg" for i in range(100)])
        for c in range(2)
    ]
    assert find_drives(stack(*parts)).record["images_on_rigs"] == 200
