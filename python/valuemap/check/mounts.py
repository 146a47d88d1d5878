"""How cameras hang on their car: two may be exchanged, and vehicle_from_cam may be taken for cam_from_vehicle."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.fault import SMALL_TURNS_RAD, Convention, Fix, with_images, with_poses
from valuemap.check.headings import driving_azimuths, level_rotations
from valuemap.dataset import Dataset
from valuemap.tables import Floats, Images, Ints


class CamerasExchanged(Convention):
    """Two cameras of a car taken for each other: each has the poses of the other."""

    name: ClassVar[str] = "cameras_exchanged"
    what: ClassVar[str] = "Two cameras of the car are taken for each other: each has the poses of the other."
    do: ClassVar[str] = "Give each camera its own place on the car (left for right, front for rear?)."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield the poses of each two cameras exchanged, where they expose together."""
        for first, second in _pairs_of_a_car(dataset.images):
            yield f"poses of cameras {first} and {second} exchanged", _Exchanged(first, second)


class InvertedMounts(Convention):
    """vehicle_from_cam where cam_from_vehicle was expected, in poses that were made from those of the vehicle."""

    name: ClassVar[str] = "inverted_mounts"
    what: ClassVar[str] = "The mounts of the cameras go the wrong way: vehicle_from_cam was taken for cam_from_vehicle."
    do: ClassVar[str] = (
        "Invert the rotation and the position of each camera on the vehicle, and make the poses of the cameras anew; "
        "the fix turns the cameras in their places."
    )

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield mounts inverted, on vehicles with the axes that are in use: of one camera alone these are its axes."""
        if next(_pairs_of_a_car(dataset.images), None) is None:
            return
        for name, vehicle_from_level in _VEHICLE_AXES.items():
            fix = _InvertedMounts(vehicle_from_level)
            if fix.turns(dataset):
                yield f"mounts inverted on a vehicle with {name}", fix


_VEHICLE_AXES: dict[str, list[list[float]]] = {
    "x forward, y left, z up": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
    "x forward, y right, z down": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "the axes of a camera that looks ahead": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
}
"""Takes a point in the axes of a level camera that looks where the vehicle drives to those of the vehicle."""


class _InvertedMounts:
    """Turns each camera as if its mount, by the way its vehicle drives, had been inverted.

    A camera that hangs by M on a vehicle at V has the pose M V, and with its mount inverted M^T V. That is N V with
    N = M^T, the mean of all its images against the way they are driven, so N^T N^T turns it right.
    """

    def __init__(self, vehicle_from_level: list[list[float]]) -> None:
        self._vehicle_from_level = np.array(vehicle_from_level, dtype=np.float64)

    def turns(self, dataset: Dataset) -> bool:
        """Return whether it turns any camera at all."""
        return any(np.trace(turn) < _NO_TURN for turn in self._turn_of_cameras(dataset).values())

    def __call__(self, dataset: Dataset) -> Dataset:
        rotation = rotation_matrices(dataset.images)
        for camera, turn in self._turn_of_cameras(dataset).items():
            mine = dataset.images.camera_id == camera
            rotation[mine] = turn @ rotation[mine]
        return with_poses(dataset, rotation, camera_centers(dataset.images))

    def _turn_of_cameras(self, dataset: Dataset) -> dict[int, Floats]:
        azimuth_rad, moves = driving_azimuths(dataset)
        vehicle = self._vehicle_from_level @ level_rotations(azimuth_rad, dataset.frame)
        mount = rotation_matrices(dataset.images) @ vehicle.transpose(0, 2, 1)
        turns = {}
        for camera in np.unique(dataset.images.camera_id[moves]).tolist():
            mean = Rotation.from_matrix(mount[moves & (dataset.images.camera_id == camera)]).mean().as_matrix()
            turns[camera] = mean.T @ mean.T
        return turns


_NO_TURN = 1.0 + 2.0 * np.cos(SMALL_TURNS_RAD.max())
"""The trace of a turn by so much: by less, a contest takes it for a turn in the mount."""


class _Exchanged:
    """Gives the images of two cameras that expose together the pose of the other."""

    def __init__(self, first: int, second: int) -> None:
        self._first, self._second = first, second

    def __call__(self, dataset: Dataset) -> Dataset:
        images = dataset.images
        first, second = _together(images, self._first, self._second)
        row = np.arange(len(images))
        row[first], row[second] = second, first
        return with_images(
            dataset,
            cam_from_world_quat=images.cam_from_world_quat[row],
            cam_from_world_m=images.cam_from_world_m[row],
        )


def _pairs_of_a_car(images: Images) -> Iterator[tuple[int, int]]:
    """Yield each two cameras that expose together."""
    for first, second in itertools.combinations(np.unique(images.camera_id).tolist(), 2):
        if len(_together(images, first, second)[0]):
            yield first, second


def _together(images: Images, first: int, second: int) -> tuple[Ints, Ints]:
    """Return the rows (N) of images of one camera, and of another one that exposed with it (in the same pass).

    Two expose together if each is the nearest in time of the other's, and much nearer than the next of its own.
    """
    none = np.empty(0, dtype=np.int64)
    time = images.timestamp_s
    if time is None or not np.all(np.isfinite(time)):
        return none, none
    pairs = [(none, none)]
    for code in np.unique(images.pass_id.codes):
        rows = [np.flatnonzero((images.pass_id.codes == code) & (images.camera_id == each)) for each in (first, second)]
        if min(len(each) for each in rows) < 2:
            continue
        one, other = (each[np.argsort(time[each], kind="stable")] for each in rows)
        to, back = _nearest(time[one], time[other]), _nearest(time[other], time[one])
        mutual = back[to] == np.arange(len(one))
        step_s = min(float(np.median(np.diff(time[each]))) for each in (one, other))
        near = np.abs(time[other[to]] - time[one]) < step_s / 2.0
        pairs.append((one[mutual & near], other[to][mutual & near]))
    one, other = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return one, other


def _nearest(when: np.ndarray, others: np.ndarray) -> Ints:
    """Return the place in sorted times of the one nearest to each time."""
    after = np.clip(np.searchsorted(others, when), 1, len(others) - 1)
    return np.where(when - others[after - 1] <= others[after] - when, after - 1, after)
