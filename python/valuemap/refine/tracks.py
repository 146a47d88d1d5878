"""Which detection shows which object, once poses are about right; objects that are one become one."""

from __future__ import annotations

from itertools import chain

import numpy as np
import scipy

from valuemap.arrays import Floats, Ints, RowsByNumber
from valuemap.refine.adjust import Groups
from valuemap.refine.footage import Footage, Sigmas
from valuemap.refine.residuals import FOCAL, Observations, State, linearised, poses_of, weights

GATE_SIGMAS = 5.0
"""A detection farther than this from where an object should be seen does not show it."""
_ONE_M = 2.5
"""Objects farther apart than this are two, however badly their places are known."""
_BESIDE_M = 4.0
"""Objects nearer to each other than this may be one that drives do not agree about."""
_TOGETHER = 0.1
"""Two objects are one only if fewer than this share of the images that see the one show both."""
_SAME_SIDE = 0.7
"""Cosine between mean directions of view: within 45 degrees is the same side."""
_CLOSE2 = 16.0
"""Objects are one only if they are apart by less than this in squared sigmas: four sigmas."""


def associate(
    footage: Footage,
    state: State,
    class_code: Ints,
    size_m: Floats,
    segment_of_image: Ints,
    sigma_px: Sigmas,
    range_m: float,
    images: Ints | None = None,
) -> tuple[Ints, Ints, Floats]:
    """Return pairs of detection (row) and object: one to one in each image, the closest first, within the gate.

    Also how far off they are, in squares of sigmas. Detections are those of some of the `images` (rows), None for all.
    """
    if not len(state.point_in_world_m):
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    row, thing = _near(footage, state.point_in_world_m, class_code, range_m, images)
    if not len(row):
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    rows, detection = np.unique(row, return_inverse=True)
    seen = footage.observe_as_given(rows, np.zeros_like(rows), segment_of_image, sigma_px)
    poses, row_of_pose = poses_of(seen, state)
    from_world = seen.residual_from_cam @ poses.cam_from_world[row_of_pose]
    offset = -np.einsum("nij,nj->in", from_world, poses.center_in_world_m[row_of_pose])
    by_row = np.ascontiguousarray(from_world.reshape(-1, 9).T).reshape(3, 3, -1)
    x, y, z = np.ascontiguousarray(state.point_in_world_m.T)

    def project(axis: int) -> Floats:
        """Return a row of the local pinholes of the detections that are left times their objects."""
        a, b, c = by_row[axis]
        return np.asarray(
            a[detection] * x[thing] + b[detection] * y[thing] + c[detection] * z[thing] + offset[axis][detection]
        )

    depth = project(2)
    box = footage.dataset.detections.size_px[rows, 1] / footage.pixels_per_rad[rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        fits = ~(np.abs(np.log(box[detection] * depth / size_m[thing])) > np.log(2.0)) & (depth > 0.5)
    detection, thing, depth = detection[fits], thing[fits], depth[fits]
    stretch = state.constants[FOCAL][seen.camera, 0]
    square = np.zeros(len(detection))
    for axis in range(2):
        residual = (1.0 + stretch[detection]) * project(axis) / depth
        square += (residual + (stretch * seen.from_middle_px[:, axis])[detection]) ** 2
    square /= seen.sigma_px[detection] ** 2
    fits = square < GATE_SIGMAS**2
    detection, thing, square = detection[fits], thing[fits], square[fits]
    kept = _one_to_one(seen.image[detection], detection, thing, square)
    return rows[detection[kept]], thing[kept], square[kept]


def _near(footage: Footage, point: Floats, class_code: Ints, range_m: float, images: Ints | None) -> tuple[Ints, Ints]:
    """Return pairs of detection (row, ascending) and object of its class (ascending) within a range of its image."""
    images = np.arange(len(footage.row)) if images is None else images
    tree = scipy.spatial.cKDTree(footage.center_in_world_m[images])
    near: list[list[int]] = list(tree.query_ball_point(point, range_m))  # type: ignore[arg-type]
    thing = np.repeat(np.arange(len(near)), [len(found) for found in near])
    image = images[np.array(list(chain.from_iterable(near)), dtype=np.int64)]
    by_image = RowsByNumber.of(image, len(footage.row))
    detection, row = by_image.of_several(footage.rays.image_row)
    thing = thing[row]
    fits = class_code[thing] == footage.rays.class_code[detection]
    return detection[fits], thing[fits]


def _one_to_one(image: Ints, detection: Ints, thing: Ints, square: Floats) -> Ints:
    """Return the rows (ascending) of pairs that are taken, the closest first: one of each detection and each object."""
    things = int(thing.max(initial=0)) + 1
    _, of_detection, detections = np.unique(detection, return_inverse=True, return_counts=True)
    _, of_object, objects = np.unique(image * things + thing, return_inverse=True, return_counts=True)
    taken = (detections[of_detection] == 1) & (objects[of_object] == 1)
    # Only pairs that have a rival need an order.
    rivals = np.flatnonzero(~taken)
    has, shown = np.zeros(len(detections), np.bool_), np.zeros(len(objects), np.bool_)
    for k in rivals[np.argsort(square[rivals], kind="stable")].tolist():
        if not has[of_detection[k]] and not shown[of_object[k]]:
            has[of_detection[k]] = shown[of_object[k]] = taken[k] = True
    return np.flatnonzero(taken)


def merge_objects(seen: Observations, state: State, image: Ints, class_code: Ints, drift_m: float) -> Ints:
    """Return the new number (K) of each object: those in one place that no image shows together are one.

    What is one place for drives that drift, each by `drift_m` on each axis, may be two as their rays have it.
    """
    count = len(state.point_in_world_m)
    number = np.arange(count)
    pairs = scipy.spatial.cKDTree(state.point_in_world_m).query_pairs(_ONE_M, output_type="ndarray")
    if not len(pairs):
        return number
    shows = [set(image[rows].tolist()) for rows in RowsByNumber.of(seen.thing, count).each()]
    covariance = _covariances(seen, state, count)
    apart = state.point_in_world_m[pairs[:, 0]] - state.point_in_world_m[pairs[:, 1]]
    total = covariance[pairs[:, 0]] + covariance[pairs[:, 1]] + 2.0 * drift_m**2 * np.eye(3)
    square = np.einsum("ni,ni->n", apart, np.linalg.solve(total, apart[:, :, None])[:, :, 0])
    for k in np.argsort(square, kind="stable").tolist():
        if not square[k] < _CLOSE2:
            break
        a, b = sorted((int(number[pairs[k, 0]]), int(number[pairs[k, 1]])))
        fewer = min(len(shows[a]), len(shows[b]))
        if a == b or class_code[a] != class_code[b] or len(shows[a] & shows[b]) > _TOGETHER * fewer:
            continue
        shows[a] |= shows[b]
        number[number == b] = a
    return number


def unresolved_share(seen: Observations, state: State, class_code: Ints) -> float:
    """Return the share of the observations whose objects stand, as another sees it, beside themselves.

    Two objects of one class nearer to each other than drives can be off, seen from the same side and shown together by
    no image, are one that the drives do not agree about. What is seen from different sides are two faces.
    """
    count = len(state.point_in_world_m)
    pairs = scipy.spatial.cKDTree(state.point_in_world_m).query_pairs(_BESIDE_M, output_type="ndarray")
    pairs = pairs[class_code[pairs[:, 0]] == class_code[pairs[:, 1]]]
    shows = [set(seen.image[rows].tolist()) for rows in RowsByNumber.of(seen.thing, count).each()]
    poses, row_of_pose = poses_of(seen, state)
    toward = state.point_in_world_m[seen.thing] - poses.center_in_world_m[row_of_pose]
    toward = toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    side = np.stack([np.bincount(seen.thing, weights=axis, minlength=count) for axis in toward.T], axis=1)
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    pairs = pairs[np.sum(side[pairs[:, 0]] * side[pairs[:, 1]], axis=1) > _SAME_SIDE]
    doubtful = np.zeros(count, np.bool_)
    for a, b in pairs.tolist():
        if len(shows[a] & shows[b]) <= _TOGETHER * min(len(shows[a]), len(shows[b])):
            doubtful[a if len(shows[a]) < len(shows[b]) else b] = True
    return float(np.mean(doubtful[seen.thing])) if len(seen) else 0.0


def _covariances(seen: Observations, state: State, count: int) -> Floats:
    """Return covariances (K, 3, 3) of objects where poses are right, of independent residuals."""
    at = linearised(seen, state)
    root = np.sqrt(weights(seen, at.residual_px, at.depth_m, 1.0))
    by_point = np.where(root[:, None, None] > 0.0, at.by_point * root[:, None, None], 0.0)
    information = np.zeros((count, 3, 3))
    groups = Groups(seen.thing)
    information[seen.thing[groups.row]] = groups.products(by_point)
    return np.asarray(np.linalg.inv(information + 1e-4 * np.eye(3)))
