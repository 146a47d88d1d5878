"""What moves a detection: the model of residuals that all of this package fits.

A detection of object X in an image with pose (R, C) and local pinhole M (see `cameras.py`) has the residual

    r = (1 + s) (a/c, b/c) + s (u - u_0),    (a, b, c) = M p,
    p = exp(m + n + tau w) R (X - C - o - d - tau v)

with s the error of the camera's focal length, m how the camera is mounted (in camera axes), n and d the drift of
rotation and position, o the offset of the segment, and tau the time from pose to exposure, in which the image moves by
v and turns by w.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valuemap.arrays import Floats, Ints

OFFSET, MOUNT, DELAY, FOCAL, CAMERA_MOUNT, CAMERA_DELAY = range(6)
WIDTH = (3, 3, 1, 1, 3, 1)
_CAUCHY = 2.0
"""Residuals of so many sigmas weigh half."""


@dataclass(frozen=True, eq=False)
class Views:
    """Images (I) with their poses as given, and which unknowns they share.

    `cam_from_world` (I, 3, 3), `center_in_world_m` (I, 3); `forward_mps`, `backward_mps` (I, 3) and `forward_radps`,
    `backward_radps` (I, 3, camera axes): how the image moves and turns until the next one and since the last one;
    `cam_from_node` (I, 3, 3) turns drift into camera axes. `segment` (I) and `vehicle` (I) are the rows of the offset
    and of the mounting and delay; drives that go on as the one before them share its vehicle.
    """

    cam_from_world: Floats
    center_in_world_m: Floats
    forward_mps: Floats
    backward_mps: Floats
    forward_radps: Floats
    backward_radps: Floats
    cam_from_node: Floats
    node: Ints
    drive: Ints
    segment: Ints
    vehicle: Ints
    camera: Ints


@dataclass(frozen=True, eq=False)
class Observations:
    """Detections (N) of objects in images, with what their residuals are computed from.

    `residual_from_cam` (N, 3, 3); `from_middle_px` (N, 2) from the principal point (0 where the camera has no focal
    length); `sigma_px` (N) is the deviation of all that is not in the model, `detection_sigma_px` (N) that of the
    detection alone, `box_px` (N) the height of its box; `thing` (N) and `image` (N) are rows of the objects and views.
    """

    views: Views
    residual_from_cam: Floats
    from_middle_px: Floats
    sigma_px: Floats
    detection_sigma_px: Floats
    box_px: Floats
    thing: Ints
    image: Ints

    def __len__(self) -> int:
        return len(self.thing)

    @property
    def node(self) -> Ints:
        """The node (N) of the drift of each."""
        return self.views.node[self.image]

    @property
    def drive(self) -> Ints:
        """The drive (N) of each."""
        return self.views.drive[self.image]

    @property
    def segment(self) -> Ints:
        """The segment (N) of each."""
        return self.views.segment[self.image]

    @property
    def vehicle(self) -> Ints:
        """The vehicle (N) of each."""
        return self.views.vehicle[self.image]

    @property
    def camera(self) -> Ints:
        """The camera (N) of each."""
        return self.views.camera[self.image]

    def take(self, rows: Any) -> Observations:
        """Return some of them."""
        return Observations(self.views, **{name: value[rows] for name, value in vars(self).items() if name != "views"})


@dataclass(frozen=True, eq=False)
class State:
    """All unknowns: objects (K, 3), drift (n, 6: position in the world, rotation in axes of the node), constants.

    `own` (images, 6: position in the world, rotation in camera axes) is what each image is probably off by itself. It
    is no unknown of the normal equations, which have its variance, but where they are linearised: derivatives at poses
    that are wrong in the same way as the residuals would move objects away from the cameras, however many look.
    """

    point_in_world_m: Floats
    drift: Floats
    own: Floats
    constants: tuple[Floats, ...]
    covariance: Floats | None = None
    """Of the constants that are free (C, C), in the order of `Adjustment.column_of`, all else marginalised; or those of
    groups (G, M) of objects (G, 3 M, 3 M), if they were asked for."""

    def with_offset(self, offset_m: Floats) -> State:
        """Return the state with other offsets of segments (L, 3)."""
        return replace(self, constants=(offset_m, *self.constants[OFFSET + 1 :]))

    @staticmethod
    def zero(points: Floats, nodes: int, images: int, counts: tuple[int, ...]) -> State:
        """Return poses as they are."""
        return State(
            points,
            np.zeros((nodes, 6)),
            np.zeros((images, 6)),
            tuple(np.zeros((n, w)) for n, w in zip(counts, WIDTH, strict=True)),
        )


@dataclass(frozen=True, eq=False)
class Poses:
    """Corrected poses of images: `cam_from_world` (I, 3, 3), `center_in_world_m` (I, 3).

    `velocity_mps` (I, 3) and `rate_radps` (I, 3) are those that a delay acts by.
    """

    cam_from_world: Floats
    center_in_world_m: Floats
    velocity_mps: Floats
    rate_radps: Floats

    def vectors(self) -> tuple[Floats, Floats, Floats]:
        """Return centres, velocities and rates."""
        return self.center_in_world_m, self.velocity_mps, self.rate_radps


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals (N, 2), px, without the images' own errors, depths (N), and the derivatives of the residuals.

    Those by the object (N, 2, 3), by a turn in camera axes (N, 2, 3), by the delay (N, 2), and by the error of the
    focal length (N, 2); that by the position of the camera is minus that by the object.
    """

    residual_px: Floats
    depth_m: Floats
    by_point: Floats
    by_turn: Floats
    by_delay: Floats
    by_focal: Floats


def rotations(vector_rad: Floats) -> Floats:
    """Return rotation matrices (N, 3, 3) of rotation vectors (N, 3), Rodrigues' formula."""
    square = np.einsum("ni,ni->n", vector_rad, vector_rad)
    angle = np.sqrt(square)
    is_none = angle <= 1e-12
    sine = np.where(is_none, 1.0, np.sin(angle) / np.where(is_none, 1.0, angle))
    versine = np.where(is_none, 0.5, 2.0 * (np.sin(0.5 * angle) / np.where(is_none, 1.0, angle)) ** 2)
    matrix = (versine[:, None] * vector_rad)[:, :, None] * vector_rad[:, None, :]
    about = sine[:, None] * vector_rad
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        matrix[:, axis, axis] += np.cos(angle)
        matrix[:, i, j] -= about[:, axis]
        matrix[:, j, i] += about[:, axis]
    return np.asarray(matrix)


def corrected(views: Views, state: State, rows: Ints | slice = slice(None)) -> Poses:
    """Return the poses of the images as the state has them, or of those `rows` of them."""
    offset, mount, delay, _, camera_mount, camera_delay = state.constants
    own, vehicle, camera = state.own[rows], views.vehicle[rows], views.camera[rows]
    late_s = (delay[vehicle, 0] + camera_delay[camera, 0])[:, None]
    velocity = np.where(late_s >= 0.0, views.forward_mps[rows], views.backward_mps[rows])
    rate = np.where(late_s >= 0.0, views.forward_radps[rows], views.backward_radps[rows])
    drift, of_segment = state.drift[views.node[rows]], offset[views.segment[rows]]
    center = views.center_in_world_m[rows] + velocity * late_s + of_segment + drift[:, :3] + own[:, :3]
    turn = mount[vehicle] + camera_mount[camera] + own[:, 3:]
    turn = turn + np.einsum("nij,nj->ni", views.cam_from_node[rows], drift[:, 3:])
    cam_from_world = views.cam_from_world[rows]
    moved = rotations(rate * late_s) @ cam_from_world if late_s.any() else cam_from_world
    return Poses(rotations(turn) @ moved, center, velocity, rate)


def poses_of(seen: Observations, state: State) -> tuple[Poses, Ints]:
    """Return the poses of the images that observations (N) are of, and the row there of each."""
    images, row = np.unique(seen.image, return_inverse=True)
    return corrected(seen.views, state, images), row


def cauchy(square: Floats, tolerance: float) -> Floats:
    """Return Cauchy's weights (N) of squared residuals (N), in variances."""
    return np.asarray(1.0 / (1.0 + square / (tolerance * _CAUCHY) ** 2))


def weights(seen: Observations, residual_px: Floats, depth_m: Floats, tolerance: float) -> Floats:
    """Return Cauchy's weights (N) over variance; what is behind its camera weighs nothing."""
    square = np.sum(residual_px**2, axis=1) / seen.sigma_px**2
    with np.errstate(invalid="ignore"):
        weight = cauchy(square, tolerance) / seen.sigma_px**2
    return np.where((depth_m > 0.1) & np.isfinite(square), weight, 0.0)


def cost(seen: Observations, state: State) -> Floats:
    """Return Cauchy's cost (N) of each observation: minus twice its log likelihood, up to a constant."""
    at = linearised(seen, state)
    square = np.sum(at.residual_px**2, axis=1) / seen.sigma_px**2
    width = _CAUCHY**2
    with np.errstate(invalid="ignore"):
        value = width * np.log1p(square / width)
    return np.asarray(np.where((at.depth_m > 0.1) & np.isfinite(square), value, width * np.log1p(100.0)))


def linearised(seen: Observations, state: State, poses: tuple[Poses, Ints] | None = None) -> Linearised:
    """Return residuals without the images' own errors, to first order around them, and derivatives.

    `poses` are `poses_of` them, where these are known: they are the same wherever objects are.
    """
    of_images, row = poses or poses_of(seen, state)
    # Number by number: sums over the last, shortest axis take several times as long.
    r = np.take(np.ascontiguousarray(of_images.cam_from_world.reshape(-1, 9).T), row, axis=1).reshape(3, 3, -1)
    m = np.ascontiguousarray(seen.residual_from_cam.reshape(-1, 9).T).reshape(3, 3, -1)
    center, velocity, rate = (_of(values, row) for values in of_images.vectors())
    apart = _of(state.point_in_world_m, seen.thing) - center
    p = [_dot(row, apart) for row in r]
    a, b, c = (_dot(row, p) for row in m)
    stretch = state.constants[FOCAL][seen.camera, 0]
    depth = np.where(np.abs(c) > 1e-6, c, 1e-6)
    own = _of(state.own, seen.image)
    count = len(seen)
    by_point, by_turn = np.empty((2, 3, count)), np.empty((2, 3, count))
    residual, by_delay, by_focal = np.empty((2, count)), np.empty((2, count)), np.empty((2, count))
    scale = (1.0 + stretch) / depth
    for k, numerator in enumerate((a, b)):
        ratio = numerator / depth
        by_p = [(m[k, j] - ratio * m[2, j]) * scale for j in range(3)]
        for axis in range(3):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            by_point[k, axis] = _dot(by_p, r[:, axis])
            by_turn[k, axis] = p[i] * by_p[j] - p[j] * by_p[i]  # p x by_p
        by_delay[k] = _dot(by_turn[k], rate) - _dot(by_point[k], velocity)
        by_focal[k] = ratio + seen.from_middle_px[:, k]
        residual[k] = (1.0 + stretch) * ratio + stretch * seen.from_middle_px[:, k]
        residual[k] += _dot(by_point[k], own[:3]) - _dot(by_turn[k], own[3:])
    of_points, of_turns = (np.moveaxis(values, 2, 0) for values in (by_point, by_turn))
    return Linearised(residual.T, c, of_points, of_turns, by_delay.T, by_focal.T)


def _of(vectors: Floats, rows: Ints) -> Floats:
    """Return the numbers (width, N) of some rows of vectors (M, width)."""
    return np.take(np.ascontiguousarray(vectors.T), rows, axis=1)


def _dot(one: Sequence[Floats] | Floats, other: Sequence[Floats] | Floats) -> Floats:
    """Return the products (N) of vectors, number by number (3, N)."""
    return np.asarray(one[0] * other[0] + one[1] * other[1] + one[2] * other[2])
