"""Which detection shows which object, once poses are about right; objects that are one become one."""

from __future__ import annotations

import numpy as np
import scipy

from valuemap.refine.adjust import Groups
from valuemap.refine.footage import Footage, Sigmas
from valuemap.refine.residuals import Observations, State, corrected, linearised, residuals, weights
from valuemap.tables import Floats, Ints

GATE_SIGMAS = 5.0
_ONE_M = 2.5
_BESIDE_M = 4.0
_TOGETHER = 0.1
"""Two objects are one only if fewer than this share of the images that see the one show both."""
_SAME_SIDE = 0.7
"""Cosine between mean directions of view: within 45 degrees is the same side."""
_CLOSE2 = 16.0
_BLOCK = 2_000_000


def associate(
    footage: Footage,
    state: State,
    class_code: Ints,
    size_m: Floats,
    segment_of_image: Ints,
    sigma_px: Sigmas,
    range_m: float,
) -> tuple[Ints, Ints]:
    """Return pairs of detection (row) and object: one to one in each image, the closest first, within the gate."""
    if not len(state.point_in_world_m):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    images = len(footage.row)
    tree = scipy.spatial.cKDTree(footage.center_in_world_m)
    near: list[list[int]] = list(tree.query_ball_point(state.point_in_world_m, range_m, return_sorted=True))  # type: ignore[arg-type]
    by_image: list[list[int]] = [[] for _ in range(images)]
    for k, found in enumerate(near):
        for place in found:
            by_image[place].append(k)
    image_of = footage.rays.image_row
    count = np.array([len(found) for found in by_image])
    detection = np.repeat(np.arange(len(image_of)), count[image_of])
    if not len(detection):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    thing = np.concatenate([np.array(by_image[i], dtype=np.int64) for i in image_of.tolist()])
    fits = class_code[thing] == footage.rays.class_code[detection]
    detection, thing = detection[fits], thing[fits]
    square = np.empty(len(detection))
    for start in range(0, len(detection), _BLOCK):
        part = slice(start, start + _BLOCK)
        seen = footage.observe_as_given(detection[part], thing[part], segment_of_image, sigma_px)
        residual, depth = residuals(seen, state)
        with np.errstate(invalid="ignore"):
            value = np.sum(residual**2, axis=1) / seen.sigma_px**2
            value = np.where((depth > 0.5) & np.isfinite(value), value, np.inf)
        box = footage.dataset.detections.size_px[detection[part], 1]
        metres_per_px = depth / seen.pixels_per_unit()
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(np.log(box * metres_per_px / size_m[thing[part]]))
        square[part] = np.where(ratio > np.log(2.0), np.inf, value)
    fits = square < GATE_SIGMAS**2
    detection, thing, square = detection[fits], thing[fits], square[fits]
    taken = set()
    kept = []
    image = image_of[detection]
    has = np.full(len(image_of), -1)
    for k in np.argsort(square, kind="stable").tolist():
        key = (int(image[k]), int(thing[k]))
        if has[detection[k]] < 0 and key not in taken:
            has[detection[k]] = thing[k]
            taken.add(key)
            kept.append(k)
    rows = np.sort(np.array(kept, dtype=np.int64))
    return detection[rows], thing[rows]


def merge_objects(seen: Observations, state: State, image: Ints, class_code: Ints, drift_m: float) -> Ints:
    """Return the new number (K) of each object: those in one place that no image shows together are one.

    What is one place for drives that drift, each by `drift_m` on each axis, may be two as their rays have it.
    """
    count = len(state.point_in_world_m)
    number = np.arange(count)
    pairs = scipy.spatial.cKDTree(state.point_in_world_m).query_pairs(_ONE_M, output_type="ndarray")
    if not len(pairs):
        return number
    shows = [set(image[rows].tolist()) for rows in _rows_of(seen.thing, count)]
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
    shows = [set(seen.image[rows].tolist()) for rows in _rows_of(seen.thing, count)]
    toward = state.point_in_world_m[seen.thing] - corrected(seen.views, state).center_in_world_m[seen.image]
    toward = toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    side = np.stack([np.bincount(seen.thing, weights=axis, minlength=count) for axis in toward.T], axis=1)
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    pairs = pairs[np.sum(side[pairs[:, 0]] * side[pairs[:, 1]], axis=1) > _SAME_SIDE]
    doubtful = np.zeros(count, np.bool_)
    for a, b in pairs.tolist():
        if len(shows[a] & shows[b]) <= _TOGETHER * min(len(shows[a]), len(shows[b])):
            doubtful[a if len(shows[a]) < len(shows[b]) else b] = True
    return float(np.mean(doubtful[seen.thing])) if len(seen) else 0.0


def _rows_of(thing: Ints, count: int) -> list[Ints]:
    order = np.argsort(thing, kind="stable")
    return np.split(order, np.searchsorted(thing[order], np.arange(1, count)))


def _covariances(seen: Observations, state: State, count: int) -> Floats:
    """Return covariances (K, 3, 3) of objects where poses are right, of independent residuals."""
    at = linearised(seen, state)
    root = np.sqrt(weights(seen, at.residual_px, at.depth_m, 1.0))
    by_point = np.where(root[:, None, None] > 0.0, at.by_point * root[:, None, None], 0.0)
    information = np.zeros((count, 3, 3))
    groups = Groups(seen.thing)
    information[seen.thing[groups.row]] = groups.sum(by_point.transpose(0, 2, 1) @ by_point)
    return np.asarray(np.linalg.inv(information + 1e-4 * np.eye(3)))
