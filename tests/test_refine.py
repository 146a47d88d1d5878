"""Faults of whole drives: each mechanism alone, and cities with one fault of their poses each."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import valuemap
from valuemap.cameras import camera_poses
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset
from valuemap.drives import find_drives
from valuemap.refine import Refined, refine_poses
from valuemap.refine.estimate import segment
from valuemap.refine.footage import find_motion
from valuemap.refine.jumps import Legs, find_jumps
from valuemap.refine.landmarks import Landmarks, keyframes
from valuemap.refine.register import register
from valuemap.simulate import simulate
from valuemap.tables import Floats, Ints

CITY = SimulationConfig(
    streets_north_south=2,
    streets_east_west=2,
    signalised_share=1.0,
    passes_per_street=3,
    lookalikes_per_light=0.0,
)


def city(**faults: float) -> Dataset:
    """Return a city of four crossings, three tours in each direction, with the same errors but for the faults."""
    return simulate(dataclasses.replace(CITY, **faults), seed=3)  # type: ignore[arg-type]


@functools.cache
def shifted_city() -> tuple[Dataset, Refined]:
    """Return a city with every pass shifted by 3 m, and what is made of it."""
    faulty = city(pass_shift_m=3.0)
    return faulty, refine_poses(faulty, valuemap.MapConfig())


def errors(dataset: Dataset, clean: Dataset) -> tuple[float, float]:
    """Return how far images are off on the ground, against their mean, m, and turned about up, deg (RMS)."""
    rotation, center = camera_poses(dataset.images)
    clean_rotation, clean_center = camera_poses(clean.images)
    apart = (center - clean_center)[:, :2]
    turn = Rotation.from_matrix(np.einsum("nij,nkj->nik", rotation, clean_rotation)).as_rotvec(degrees=True)
    off_m = np.linalg.norm(apart - apart.mean(axis=0), axis=1)
    return float(np.sqrt(np.mean(off_m**2))), float(np.sqrt(np.mean(turn[:, 1] ** 2)))


def test_a_city_without_faults_stays_bit_for_bit() -> None:
    dataset = city()
    refined = refine_poses(dataset, valuemap.MapConfig())
    assert refined.dataset is dataset
    assert refined.record["found"] == "nothing"
    assert refined.record["shared_objects"] > 10


def test_shifts_of_passes_of_three_metres_are_found_to_three_decimetres() -> None:
    clean, (faulty, refined) = city(), shifted_city()
    assert errors(faulty, clean)[0] > 2.0
    assert errors(refined.dataset, clean)[0] < 0.3
    assert len(refined.record["drives"]) >= 5
    # The place of all stays: as many images are moved as far to one side as to the other, drive by drive.
    drive = find_drives(faulty.images).pass_code
    moved = camera_poses(refined.dataset.images)[1] - camera_poses(faulty.images)[1]
    mean = np.stack([np.bincount(drive, weights=axis) / np.bincount(drive) for axis in moved.T], axis=1)
    assert np.abs(mean.mean(axis=0)).max() < 0.3


def test_cameras_mounted_askew_are_turned_back() -> None:
    clean, faulty = city(), city(pass_yaw_deg=1.5)
    refined = refine_poses(faulty, valuemap.MapConfig())
    assert errors(faulty, clean)[1] == pytest.approx(1.5, abs=0.01)
    assert errors(refined.dataset, clean)[1] < 0.4


def test_a_delay_of_all_poses_is_one_number_of_the_camera() -> None:
    refined = refine_poses(city(pose_delay_s=0.15), valuemap.MapConfig())
    assert refined.record["cameras"][0]["delay_s"] == pytest.approx(0.15, abs=0.03)


def test_rows_names_and_ids_change_nothing_of_what_is_found() -> None:
    faulty, refined = shifted_city()
    order = np.random.default_rng(5).permutation(len(faulty.images))
    images = faulty.images.take(order)
    new_id = np.argsort(order)
    detections = faulty.detections.replace(image_id=new_id[faulty.detections.image_id])
    shuffled = dataclasses.replace(
        faulty, images=images.replace(image_id=np.arange(len(order))), detections=detections, truth_detections=None
    )
    other = refine_poses(shuffled, valuemap.MapConfig()).dataset.images
    assert np.array_equal(refined.dataset.images.cam_from_world_m[order], other.cam_from_world_m)


def test_constellations_tell_how_drives_lie_to_each_other() -> None:
    random = np.random.default_rng(1)
    objects = np.column_stack([random.uniform(0.0, 300.0, (20, 2)), random.uniform(3.0, 6.0, 20)])
    angle = random.uniform(0.0, 2.0 * np.pi, 6)
    shift = 3.0 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6)])
    points = (objects[None] + shift[:, None]).reshape(-1, 3) + random.normal(0.0, 0.1, (120, 3))
    marks = landmarks(points, drive=np.repeat(np.arange(6), 20), driven_m=np.tile(objects[:, 0], 6))
    found = register(marks, np.tile(0.1**2 * np.eye(3), (120, 1, 1)))
    total = found.shift_m.reshape(6, 20, 3) + shift[:, None]
    assert np.abs(total - total.mean(axis=(0, 1))).max() < 1.0
    assert len(np.unique(found.object_of_landmark)) == 20


def test_constellations_that_agree_are_not_moved_and_classes_are_kept_apart() -> None:
    random = np.random.default_rng(2)
    objects = random.uniform(0.0, 200.0, (10, 3)) * [1.0, 1.0, 0.02]
    marks = landmarks(np.tile(objects, (2, 1)), drive=np.repeat([0, 1], 10), driven_m=np.tile(objects[:, 0], 2))
    covariance = np.tile(0.1**2 * np.eye(3), (20, 1, 1))
    assert np.all(register(marks, covariance).shift_m == 0.0)
    other = dataclasses.replace(marks, class_code=np.repeat([0, 1], 10))
    assert len(np.unique(register(other, covariance).object_of_landmark)) == 20


def landmarks(points: Floats, *, drive: Ints, driven_m: Floats) -> Landmarks:
    count = len(points)
    return Landmarks(
        point_in_world_m=points,
        class_code=np.zeros(count, np.int64),
        size_m=np.ones(count),
        drive=drive,
        leg=drive,
        driven_m=driven_m,
        offsets=np.arange(count + 1),
        voters=np.arange(count),
    )


def test_a_signal_is_cut_where_any_cuts_are_cheapest() -> None:
    random = np.random.default_rng(3)
    for _ in range(5):
        value = np.repeat([[0.0, 0.0], [1.5, -1.0], [0.0, 0.0]], [3, 4, 3], axis=0) + random.normal(0.0, 0.4, (10, 2))
        precision = np.tile(np.diag([4.0, 9.0]), (10, 1, 1))
        price = 8.0

        def cost(starts: tuple[int, ...], value: Floats = value, price: float = price) -> float:
            parts = np.split(value, starts)
            return sum(float(np.sum((p - p.mean(axis=0)) ** 2 * [4.0, 9.0])) for p in parts) + price * len(starts)

        every = [c for k in range(4) for c in itertools.combinations(range(1, 10), k)]
        best = min(every, key=cost)
        assert segment(value, precision, np.full(10, price)) == [0, *best]


def test_legs_are_found_by_drive_and_order() -> None:
    legs = Legs(np.array([0, 0, 1]), np.array([0, 5, 0]))
    assert legs.of(np.array([0, 0, 0, 1, 1]), np.array([0, 4, 5, 0, 9])).tolist() == [0, 0, 1, 2, 2]


def test_a_waiting_car_gives_the_middle_one_of_its_images() -> None:
    dataset = city()
    drives = find_drives(dataset.images)
    chosen = keyframes(drives, dataset.images.camera_id)
    assert np.array_equal(np.unique(drives.viewpoint[chosen]), np.unique(drives.viewpoint))
    assert chosen.sum() == len(np.unique(drives.viewpoint))
    longest = np.argmax(np.bincount(drives.viewpoint))
    members = np.sort(drives.order[drives.viewpoint == longest])
    assert drives.order[chosen & (drives.viewpoint == longest)][0] == members[len(members) // 2]


def test_velocities_are_those_of_the_trajectory() -> None:
    dataset = city(position_white_m=0.0, position_drift_m=0.0)
    drives = find_drives(dataset.images)
    motion = find_motion(dataset, drives)
    speed = np.linalg.norm(motion.forward_mps, axis=1)
    assert motion.is_timed.all()
    assert np.median(speed[speed > 1.0]) == pytest.approx(CITY.speed_mps, rel=0.02)
    assert speed.max() < 1.3 * CITY.speed_mps


def test_jumps_of_poses_are_seen_in_the_trajectory_and_stops_and_turns_are_none() -> None:
    settings = {"jump_m": 3.0, "jumps_per_km": 10.0}
    plain, jumping = city(), city(**settings)
    drives = find_drives(plain.images)
    assert len(find_jumps(plain, drives)) == drives.count
    center, other = (camera_poses(d.images)[1] for d in (plain, jumping))
    found = find_jumps(jumping, find_drives(jumping.images))
    leg = found.of(drives.pass_code, drives.order)
    off = other - center
    true = right = 0
    for drive in range(drives.count):
        rows = np.flatnonzero(drives.pass_code == drive)
        rows = rows[np.argsort(drives.order[rows])]
        jumps = np.linalg.norm(np.diff(off[rows], axis=0), axis=1) > 1.0
        true += int(jumps.sum())
        right += int((jumps & (np.diff(leg[rows]) != 0)).sum())
    assert true >= 8
    assert right >= 0.5 * true
