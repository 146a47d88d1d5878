"""Cameras and rays: every detection becomes a local pinhole, so that one kernel serves all camera models.

For a detection at pixel z, in a camera with projection pi, take a virtual image plane (the camera's own for
perspective models, else the plane orthogonal to the detection's ray) with coordinates p = (x/z, y/z) and let
J = d pi / d p at the detection. Then with the 3x3 matrix

    M = [ J (V_12 - p_0 V_3) ; V_3 ] R_cam_from_world,        (a, b, c) = M (X - camera centre)

(a/c, b/c) is the reprojection error in pixels, exactly for pinholes without distortion and to first order
around the detection for all others; c is the depth along the virtual axis and c > 0 means in front.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import valuemap._core as _core
from valuemap import camera_models
from valuemap.arrays import Floats, Ints
from valuemap.camera_models import Lens
from valuemap.dataset import Dataset, rows_of
from valuemap.tables import Cameras, Detections, Images

if TYPE_CHECKING:
    from valuemap.colmap import pycolmap

_LEAST_FORWARD = 0.1
"""Corners of a picture less forward than this (cosine to the axis) bound no pyramid."""
_JACOBIAN_STEP = 1e-5
"""Half the step, in units of the virtual image plane, of the central differences."""
_RAY_TOLERANCE_PX = 0.1
"""A ray that projects farther than this from its pixel is not the ray of the pixel."""
_STEEPEST = 1e12
"""A pixel around which a lens spreads a direction over more pixels has no ray."""
_BLOCK = 8192
"""Rows that are worked on at once, so that what is between stays in the cache."""


@dataclass(frozen=True, eq=False)
class Rays:
    """One viewing ray a detection, in the order of the detections.

    `core` are the rays as the numeric core holds them, `image_row` (N) is the row of the detection's image in the
    images table, `camera_row` (N) that of its camera, `class_code` (N) that of its class.
    """

    core: _core.Rays
    image_row: Ints
    camera_row: Ints
    class_code: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.image_row)

    @cached_property
    def residual_from_world(self) -> Floats:
        """M above (N, 3, 3); NaN, like the direction, where the camera model has no ray for the pixel.

        Such a detection neither proposes nor votes.
        """
        return self.core.residual_from_world()

    @cached_property
    def center_in_world_m(self) -> Floats:
        """The camera centres (N, 3)."""
        return self.core.center_in_world_m()

    @cached_property
    def direction_in_world(self) -> Floats:
        """Unit vectors (N, 3)."""
        return self.core.direction_in_world()


def camera_centers(images: Images) -> Floats:
    """Return the camera centres (N, 3) in metres in the world, -R^T t."""
    quat, translation_m = images.cam_from_world_quat, images.cam_from_world_m
    return _core.camera_centers(np.ascontiguousarray(quat), np.ascontiguousarray(translation_m))


def camera_poses(images: Images) -> tuple[Floats, Floats]:
    """Return the rotation matrices (N, 3, 3) and the camera centres (N, 3) of images."""
    cam_from_world = rotation_matrices(images)
    return cam_from_world, -np.einsum("nji,nj->ni", cam_from_world, images.cam_from_world_m)


def directions_down(images: Images) -> Floats:
    """Return the unit vectors (N, 3) in the world that go down in each picture: the second rows of R."""
    w, x, y, z = np.ascontiguousarray(images.cam_from_world_quat.T)
    return np.stack([2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)], axis=1)


def rotation_matrices(images: Images) -> Floats:
    """Return R (N, 3, 3) with point_in_cam = R point_in_world + t."""
    rotation = np.empty((len(images), 3, 3))
    for members in _blocks(np.arange(len(images))):
        rotation[members] = rotation_of(images.cam_from_world_quat[members])
    return rotation


def rotation_of(quat: Floats) -> Floats:
    """Return R (N, 3, 3) of quaternions (N, 4)."""
    # Written out, because importing SciPy's rotations takes longer than mapping a small city.
    w, x, y, z = np.ascontiguousarray(quat.T)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def lens_of(cameras: Cameras, row: int) -> Lens:
    """Return how the camera in one row of the cameras table pictures points."""
    return camera_models.lens_of(*_model_of(cameras, row))


def colmap_camera(cameras: Cameras, row: int) -> pycolmap.Camera:
    """Return one row of the cameras table as pycolmap's camera."""
    return camera_models.colmap_camera(*_model_of(cameras, row))


def _model_of(cameras: Cameras, row: int) -> tuple[str, int, int, Floats]:
    model = cameras.model.names[cameras.model.codes[row]]
    return model, int(cameras.width_px[row]), int(cameras.height_px[row]), cameras.params[row]


@dataclass(frozen=True, eq=False)
class Pinholes:
    """The local pinhole of each detection, wherever its camera is.

    `residual_from_cam` (N, 3, 3) is M above in camera axes and `direction_in_cam` (N, 3) the unit ray, NaN where the
    camera model has no ray for the pixel; `image_row` and `camera_row` (N) are as of `Rays`.
    """

    residual_from_cam: Floats
    direction_in_cam: Floats
    image_row: Ints
    camera_row: Ints


def local_pinholes(dataset: Dataset) -> Pinholes:
    """Return what every detection of a dataset sees by its camera alone."""
    images, cameras, detections = dataset.images, dataset.cameras, dataset.detections
    image_row = rows_of(detections.image_id, images.image_id)
    camera_row = rows_of(images.camera_id, cameras.camera_id)[image_row]
    residual_from_cam = np.empty((len(detections), 3, 3))
    direction_in_cam = np.empty((len(detections), 3))
    for row in range(len(cameras)):
        camera = lens_of(cameras, row)
        for members in _blocks(np.flatnonzero(camera_row == row)):
            residual_from_cam[members], direction_in_cam[members] = _local_pinholes(
                camera, detections.center_px[members]
            )
    has_no_ray = ~(np.abs(residual_from_cam).max(axis=(1, 2)) <= _STEEPEST)
    residual_from_cam[has_no_ray], direction_in_cam[has_no_ray] = np.nan, np.nan
    return Pinholes(residual_from_cam, direction_in_cam, image_row, camera_row)


def cast_rays(dataset: Dataset, *, is_left_out: NDArray[np.bool_] | None = None) -> Rays:
    """Return the viewing ray of every detection of a dataset; those that are left out (N) have none."""
    pinholes = local_pinholes(dataset)
    if is_left_out is not None:
        pinholes.residual_from_cam[is_left_out], pinholes.direction_in_cam[is_left_out] = np.nan, np.nan
    return rays_of_pinholes(pinholes, dataset.detections, *camera_poses(dataset.images))


def rays_of_pinholes(
    pinholes: Pinholes, detections: Detections, cam_from_world: Floats, center_in_world_m: Floats
) -> Rays:
    """Return the viewing rays of detections whose images have these rotations (M, 3, 3) and camera centres (M, 3)."""
    class_code = detections.class_name.codes
    core = _core.Rays(
        pinholes.residual_from_cam,
        pinholes.direction_in_cam,
        pinholes.image_row.astype(np.uint32),
        class_code.astype(np.uint32),
        cam_from_world,
        center_in_world_m,
    )
    return Rays(core, pinholes.image_row, pinholes.camera_row, class_code)


def _blocks(rows: Ints) -> list[Ints]:
    """Cut rows into blocks."""
    return [rows[start : start + _BLOCK] for start in range(0, len(rows), _BLOCK)]


def picture_bounds(cameras: Cameras) -> tuple[Floats, Floats]:
    """Return what each camera pictures: normals (N, 4, 3) of planes through its centre, and solid angles (N) in sr.

    A point in camera axes is in the picture if its product with all four normals is not negative. Cameras that see
    beyond a half space have NaN normals: they are taken to picture everything around them.
    """
    normals, solid_angle = np.full((len(cameras), 4, 3), np.nan), np.full(len(cameras), 4.0 * np.pi)
    for row in range(len(cameras)):
        camera = lens_of(cameras, row)
        width, height = camera.width, camera.height
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        ray = np.asarray(camera.cam_ray_from_img(corners))
        if camera.is_spherical() or not np.all(ray[:, 2] > _LEAST_FORWARD):
            continue
        normals[row] = np.cross(ray, np.roll(ray, -1, axis=0))
        # Two spherical triangles, by the formula of Van Oosterom and Strackee (1983).
        solid_angle[row] = sum(_triangle_sr(ray[0], ray[i], ray[i + 1]) for i in (1, 2))
    return normals, solid_angle


def _triangle_sr(a: Floats, b: Floats, c: Floats) -> float:
    return float(2.0 * np.arctan2(abs(a @ np.cross(b, c)), 1.0 + a @ b + b @ c + c @ a))


def _local_pinholes(camera: Lens, center_px: Floats) -> tuple[Floats, Floats]:
    """Return M in camera axes (N, 3, 3) and the unit ray in camera axes (N, 3) of detections (N, 2)."""
    ray = np.asarray(camera.cam_ray_from_img(center_px))
    # Where a model has no ray, e.g. beyond 90 degrees of a fisheye, COLMAP may answer with another one.
    miss_px = np.linalg.norm(_pixels_between(camera, camera.img_from_cam(ray), center_px), axis=1)
    ray[~(miss_px <= _RAY_TOLERANCE_PX)] = np.nan
    # A perspective camera has a plane of its own.
    virtual_from_cam = None if camera.is_perspective_pinhole() else _rotation_onto(ray)
    in_virtual = ray if virtual_from_cam is None else np.einsum("nij,nj->ni", virtual_from_cam, ray)
    plane = in_virtual[:, :2] / in_virtual[:, 2:]
    residual_from_cam = np.zeros((len(ray), 3, 3))
    for axis in (0, 1):
        residual_from_cam[:, :2, axis] = _pixels_per_step(camera, virtual_from_cam, plane, axis)
    residual_from_cam[:, :2, 2] = -np.einsum("nij,nj->ni", residual_from_cam[:, :2, :2], plane)
    residual_from_cam[:, 2, 2] = 1.0
    if virtual_from_cam is not None:
        residual_from_cam = residual_from_cam @ virtual_from_cam
    has_no_ray = np.isnan(residual_from_cam).any(axis=(1, 2))
    residual_from_cam[has_no_ray], ray[has_no_ray] = np.nan, np.nan
    return residual_from_cam, ray


def _pixels_per_step(camera: Lens, virtual_from_cam: Floats | None, plane: Floats, axis: int) -> Floats:
    """Return the column (N, 2) of d pi / d p for one axis of the virtual plane, by central differences."""
    ends = []
    for step in (_JACOBIAN_STEP, -_JACOBIAN_STEP):
        point = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
        point[:, axis] += step
        in_cam = point if virtual_from_cam is None else np.einsum("nji,nj->ni", virtual_from_cam, point)
        ends.append(camera.img_from_cam(in_cam))
    return _pixels_between(camera, ends[0], ends[1]) / (2.0 * _JACOBIAN_STEP)


def _pixels_between(camera: Lens, first_px: Floats, second_px: Floats) -> Floats:
    """Return first - second (N, 2); the seam of a panorama is no jump of the world."""
    difference: Floats = np.asarray(first_px) - np.asarray(second_px)
    if camera.is_spherical():
        difference[:, 0] -= camera.width * np.round(difference[:, 0] / camera.width)
    return difference


def _rotation_onto(direction: Floats) -> Floats:
    """Return rotations (N, 3, 3) whose third rows are the unit directions (N, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first), direction], axis=1)
