"""Faults of poses: which way they go, the order of a quaternion, the camera's axes, pitch and roll."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.fault import Convention, Fix, InTurn, with_centers, with_images, with_poses
from valuemap.check.headings import headings, rotations_of
from valuemap.dataset import Dataset

_ROS_BODY = "x forward, y left, z up, as in ROS bodies"
_CAMERA_AXES: dict[str, list[list[float]]] = {
    "y up and z back, as in OpenGL": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    _ROS_BODY: [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
    "x forward, y right, z down, as in aircraft": [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
    "x right, y forward, z up": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x left, y up, z forward": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "x left, y down, z back": [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
    "x down, y left, z forward": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "x up, y right, z forward": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
"""Takes a point in the axes named to x right, y down, z forward."""


_STEADY_RAD = 1e-3
"""Angles that vary by less than this over all images are given, not measured."""


class InvertedPoses(Convention):
    """world_from_cam where cam_from_world is expected."""

    name: ClassVar[str] = "inverted_poses"
    what: ClassVar[str] = "The poses go the wrong way: they take the camera into the world (world_from_cam)."
    do: ClassVar[str] = "Invert them: cam_from_world has R^T and -R^T t."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield both inverted, as they are and of cameras with the axes of other fields, and the rotation alone."""
        yield "world_from_cam", _invert
        yield "world_from_cam in the rotation, the camera centre as it is", _invert_rotation
        for name, axes in _CAMERA_AXES.items():
            yield f"world_from_cam of cameras with {name}", InTurn(_invert, _OtherAxes(axes))


class CenterAsTranslation(Convention):
    """The camera centre where the translation -R c is expected."""

    name: ClassVar[str] = "center_as_translation"
    what: ClassVar[str] = "tx ty tz hold the camera centre, not the translation of cam_from_world."
    do: ClassVar[str] = "Set t = -R c."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield the translation taken for the centre."""
        yield "t is the camera centre", _center_from_translation


class QuaternionOrder(Convention):
    """x y z w where w x y z is expected."""

    name: ClassVar[str] = "quaternion_order"
    what: ClassVar[str] = "The quaternions are in another order than w, x, y, z."
    do: ClassVar[str] = "Write qw qx qy qz; SciPy, ROS and Eigen's memory have x y z w."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield both orders, with the translation or the camera centre as it is, both ways; of ROS bodies too."""
        for order, columns in (("x y z w", [3, 0, 1, 2]), ("y z w x", [1, 2, 3, 0])):
            yield f"{order}, the translation as it is", _Reordered(columns, keeps_center=False)
            yield f"{order}, the camera centre as it is", _Reordered(columns, keeps_center=True)
            yield f"{order}, world_from_cam", InTurn(_Reordered(columns, keeps_center=False), _invert)
        reordered = _Reordered([3, 0, 1, 2], keeps_center=False)
        of_ros = InTurn(reordered, _invert, _OtherAxes(_CAMERA_AXES[_ROS_BODY]))
        yield f"x y z w, world_from_cam of cameras with {_ROS_BODY}", of_ros


class CameraAxes(Convention):
    """Axes of the camera other than x right, y down, z forward."""

    name: ClassVar[str] = "camera_axes"
    what: ClassVar[str] = "The cameras' axes are not x right, y down, z forward."
    do: ClassVar[str] = "Turn the cameras' axes into x right, y down, z forward before writing the poses."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield the axes of other fields."""
        for name, axes in _CAMERA_AXES.items():
            yield name, _OtherAxes(axes)


class PitchAndRoll(Convention):
    """Pitch and roll that are worse than none."""

    name: ClassVar[str] = "pitch_and_roll"
    what: ClassVar[str] = (
        "The pitch and roll of the poses are worse than none: one for all images of a camera agrees better."
    )
    do: ClassVar[str] = "Take one pitch and roll of each camera (and the heading of each image), or find better poses."
    is_guess: ClassVar[bool] = True
    least_times: ClassVar[float | None] = 1.5
    """Errors of a degree, as of a phone, are noise: without them rays agree up to a quarter better; hills are lost."""

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield cameras of one pitch and roll; one that all images share wrongly is a tilt, and looked for as such."""
        _, pitch, roll = headings(dataset)
        if max(float(np.std(pitch)), float(np.std(roll))) < _STEADY_RAD:
            return
        yield "one pitch and roll of each camera", steadied


def _invert(dataset: Dataset) -> Dataset:
    rotation = rotation_matrices(dataset.images).transpose(0, 2, 1)
    return with_poses(dataset, rotation, np.asarray(dataset.images.cam_from_world_m))


def _invert_rotation(dataset: Dataset) -> Dataset:
    rotation = rotation_matrices(dataset.images).transpose(0, 2, 1)
    return with_poses(dataset, rotation, camera_centers(dataset.images))


def _center_from_translation(dataset: Dataset) -> Dataset:
    return with_centers(dataset, np.asarray(dataset.images.cam_from_world_m))


def steadied(dataset: Dataset) -> Dataset:
    """Return the dataset with the pitch and roll of all images of a camera at their medians."""
    azimuth_rad, pitch_rad, roll_rad = headings(dataset)
    for camera in np.unique(dataset.images.camera_id):
        rows = dataset.images.camera_id == camera
        pitch_rad[rows], roll_rad[rows] = np.median(pitch_rad[rows]), np.median(roll_rad[rows])
    rotation = rotations_of(azimuth_rad, pitch_rad, roll_rad, dataset.frame)
    return with_poses(dataset, rotation, camera_centers(dataset.images))


class _Reordered:
    """Takes the parts of the quaternions from other columns."""

    def __init__(self, columns: list[int], *, keeps_center: bool) -> None:
        self._columns, self._keeps_center = columns, keeps_center

    def __call__(self, dataset: Dataset) -> Dataset:
        quaternion = np.ascontiguousarray(dataset.images.cam_from_world_quat[:, self._columns])
        other = with_images(dataset, cam_from_world_quat=quaternion)
        if not self._keeps_center:
            return other
        return with_poses(dataset, rotation_matrices(other.images), camera_centers(dataset.images))


class _OtherAxes:
    """Turns the cameras in their places."""

    def __init__(self, axes: list[list[float]]) -> None:
        self._axes = np.array(axes, dtype=np.float64)

    def __call__(self, dataset: Dataset) -> Dataset:
        rotation = self._axes @ rotation_matrices(dataset.images)
        return with_poses(dataset, rotation, camera_centers(dataset.images))
