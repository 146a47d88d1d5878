"""What other methods make of the same real data: rewritten by us from their papers, or as their authors publish it.

    krylov            the Markov random field of Krylov, Kenny and Dahyot 2018: crossings of rays in the plane are on or
                      off, most rays want one crossing that is on, crossings agree with estimated depths where there are
                      any; solved by iterated conditional modes, crossings that are on are clustered. Our own writing
                      from the paper; its constants are the best of 24 on London itself, in the peer's favour.
                      Its authors report 36.6 right, 17.6 false and 13.4 missed there: F1 0.70.
    published sites   what the live open peer on Bend publishes for the same detections
    bearings, given   one point a true object by least squares of angles, its detections given
    colmap, given     the same by pycolmap's robust triangulation
    paper             the voting of VALUE (Dabisias et al. 2018), valuemap's other method

Association is given by truth where it says so: the track of each box (Argoverse 2), or for each box the surveyed sign
of its class that is nearest in direction (KITTI-TS). These are bounds, not methods.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import av2_static
import bend_ramps
import kitti_ts
import london_tl
from field_data import Figures, positions, read_columns
from valuemap.arrays import Floats, Ints
from valuemap.cameras import cast_rays, colmap_camera
from valuemap.dataset import Dataset

_REACH_M = 25.0
"""Krylov: rays cross no farther from their cameras than this."""
_TOGETHER_M = 2.0
"""Crossings nearer than this are one object."""
_ROUNDS = 30
_MOST_LINKED = 20_000
_LEAST_ANGLE = math.radians(2.0)
_NEAREST_DEG = 4.0
_FARTHEST_M = 60.0


def krylov(data_dir: Path, name: str) -> Figures:
    """Score the Markov random field on London (with its depths, or without: `london_tl bearings`) or on Bend."""
    if name == "bend_ramps":
        dataset = bend_ramps.load(data_dir)
        places, spread = krylov_field(*_rays_in_plane(dataset), None)
        covariance = np.tile(spread**2 * np.eye(2), (len(places), 1, 1))
        return bend_ramps.score_labels(places, covariance, *bend_ramps.truth(data_dir))
    dataset = london_tl.load(data_dir, with_range=True)
    depth = dataset.detections.range_m if name == "london_tl" else None
    places, _ = krylov_field(*_rays_in_plane(dataset), depth)
    return london_tl.score_labels(places, london_tl.truth(data_dir))


def _rays_in_plane(dataset: Dataset) -> tuple[Floats, Floats, Ints]:
    """Return origins (N, 2) and unit directions (N, 2) on the ground of all detections, and their images (N)."""
    rays = cast_rays(dataset)
    direction = rays.direction_in_world[:, :2]
    return rays.center_in_world_m[:, :2], direction / np.linalg.norm(direction, axis=1)[:, None], rays.image_row


def krylov_field(origin: Floats, direction: Floats, image: Ints, depth_m: Floats | None) -> tuple[Floats, float]:
    """Return the objects (K, 2) that crossings of rays (N) make, and how far the crossings of one are apart.

    Energy of crossings z in {0, 1}: depths that disagree (unary); two crossings on one ray that are not one place
    (pairwise); rays without a crossing (high order). Iterated conditional modes from all off.
    """
    first, second = _pairs(origin, image)
    point, reach_a, reach_b = _crossings(origin, direction, first, second)
    good = (reach_a > 0.0) & (reach_b > 0.0) & (reach_a < _REACH_M) & (reach_b < _REACH_M)
    first, second = first[good], second[good]
    point, reach_a, reach_b = point[good], reach_a[good], reach_b[good]
    if not len(point):
        return np.empty((0, 2)), 0.0
    unary = np.zeros(len(point))
    if depth_m is not None:
        unary = 0.2 * (np.abs(reach_a - depth_m[first]) + np.abs(reach_b - depth_m[second]))
    on_ray: list[list[int]] = [[] for _ in origin]
    for k, (a, b) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        on_ray[a].append(k)
        on_ray[b].append(k)
    is_on = np.zeros(len(point), np.bool_)
    order = np.lexsort((np.arange(len(point)), np.minimum(reach_a, reach_b)))
    for _ in range(_ROUNDS):
        changed = False
        for k in order.tolist():
            value = unary[k]
            for ray in (first[k], second[k]):
                others = [j for j in on_ray[ray] if is_on[j] and j != k]
                if not others:
                    value -= 1.0  # A ray that shows nothing is clutter, and has its price.
                apart = [float(np.linalg.norm(point[j] - point[k])) for j in others]
                value += sum(0.5 * min(distance, 10.0) for distance in apart if distance > _TOGETHER_M)
            changed |= bool(is_on[k] != (value < 0.0))
            is_on[k] = value < 0.0
        if not changed:
            break
    chosen = point[is_on]
    if len(chosen) < 2:
        return chosen, 0.0
    cluster = _clusters(chosen)
    count = np.bincount(cluster)[1:]
    middle = np.stack([np.bincount(cluster, axis)[1:] / count for axis in chosen.T], axis=1)
    apart_m = float(np.sqrt(np.mean(np.sum((chosen - middle[cluster - 1]) ** 2, axis=1) / 2.0)))
    return middle, max(apart_m, 0.1)


def _clusters(point: Floats) -> Ints:
    """Return clusters (N), from 1, of points: by average linkage; of too many, what hangs together."""
    if len(point) < _MOST_LINKED:
        return np.asarray(fcluster(linkage(point, "average"), 2.0 * _TOGETHER_M, "distance"), np.int64)
    pairs = cKDTree(point).query_pairs(_TOGETHER_M, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(point), len(point)))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64) + 1


def _pairs(origin: Floats, image: Ints) -> tuple[Ints, Ints]:
    """Return pairs of rays of different images whose cameras are near enough that they may meet."""
    pairs = cKDTree(origin).query_pairs(2.0 * _REACH_M, output_type="ndarray")
    pairs = pairs[image[pairs[:, 0]] != image[pairs[:, 1]]]
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)


def _crossings(origin: Floats, direction: Floats, first: Ints, second: Ints) -> tuple[Floats, Floats, Floats]:
    """Return where pairs of rays cross (K, 2) and how far from each camera (K); behind where nearly parallel."""
    between = origin[second] - origin[first]
    a, b = direction[first], direction[second]
    sine = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    is_good = np.abs(sine) > math.sin(_LEAST_ANGLE)
    safe = np.where(is_good, sine, 1.0)
    reach_a = np.where(is_good, (between[:, 0] * b[:, 1] - between[:, 1] * b[:, 0]) / safe, -1.0)
    reach_b = np.where(is_good, (between[:, 0] * a[:, 1] - between[:, 1] * a[:, 0]) / safe, -1.0)
    return origin[first] + reach_a[:, None] * a, reach_a, reach_b


def bearings_of_given(data_dir: Path, name: str) -> Figures:
    """Score least squares of angles with the association given."""
    return _given(data_dir, name, lambda dataset, rows: least_squares(*_rays_of(dataset, rows)))


def colmap_of_given(data_dir: Path, name: str) -> Figures:
    """Score pycolmap's triangulation with the association given."""
    return _given(data_dir, name, triangulate)


def _rays_of(dataset: Dataset, rows: Ints) -> tuple[Floats, Floats]:
    rays = _CAST.setdefault(id(dataset), (dataset, cast_rays(dataset)))[1]
    return rays.center_in_world_m[rows], rays.direction_in_world[rows]


_CAST: dict[int, tuple[Dataset, Any]] = {}


def least_squares(origin: Floats, direction: Floats) -> Floats | None:
    """Return the point (3) with the least squares of angles to rays (N), None where they do not tell one."""
    weight = np.ones(len(origin))
    point = None
    for _ in range(10):
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        normal = np.einsum("n,nij->ij", weight, across)
        if np.linalg.cond(normal) > 1e6:
            return point
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weight, across, origin))
        weight = 1.0 / np.maximum(np.sum((point - origin) ** 2, axis=1), 1.0)
    return point


def triangulate(dataset: Dataset, rows: Ints) -> Floats | None:
    """Return the point (3) that pycolmap triangulates from detections, None where it finds none."""
    images, detections = dataset.images, dataset.detections
    image_row = np.searchsorted(images.image_id, detections.image_id[rows])
    camera_row = np.searchsorted(dataset.cameras.camera_id, images.camera_id[image_row])
    poses = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(np.roll(images.cam_from_world_quat[i], -1)), images.cam_from_world_m[i])
        for i in image_row
    ]
    cameras = [colmap_camera(dataset.cameras, int(i)) for i in camera_row]
    found = pycolmap.estimate_triangulation(detections.center_px[rows], poses, cameras)
    return None if found is None else np.asarray(found["xyz"])


def _given(data_dir: Path, name: str, place: Callable[[Dataset, Ints], Floats | None]) -> Figures:
    """Place each true object from the detections that are its own, and score."""
    if name == "kitti_ts":
        dataset, signs = kitti_ts.load(data_dir), kitti_ts.truth(data_dir)
        groups = _detections_of_signs(dataset, *signs)
        points, names = _placed(dataset, groups, place)
        return kitti_ts.score_labels(points[:, :2], names, *signs)
    parts = []
    for number, log in enumerate(av2_static.logs(data_dir)):
        dataset = av2_static.load(data_dir, log)
        truth, boxes = (
            read_columns(data_dir / log / "gt_city.csv"),
            read_columns(data_dir / log / "projected_boxes.csv"),
        )
        corners = positions(boxes, "x1", "y1", "x2", "y2")
        middle = (corners[:, :2] + corners[:, 2:]) / 2.0
        # Rows were numbered anew: found again by their boxes.
        at = {
            (round(x, 6), round(y, 6)): uuid for (x, y), uuid in zip(middle.tolist(), boxes["track_uuid"], strict=True)
        }
        uuid = np.array([at[x, y] for x, y in np.round(dataset.detections.center_px, 6).tolist()])
        groups = [np.flatnonzero(uuid == u) for u in sorted(set(uuid.tolist()))]
        points, names = _placed(dataset, groups, place)
        apart = np.array([1e6 * number, 0.0, 0.0])
        parts.append(
            (
                points + apart,
                names.astype(object),
                positions(truth, "city_x", "city_y", "city_z") + apart,
                truth["category"].astype(object),
                av2_static.evaluable(data_dir, log),
            )
        )
    return av2_static.score_labels(*(np.concatenate([part[i] for part in parts]) for i in range(5)))


def _placed(
    dataset: Dataset, groups: list[Ints], place: Callable[[Dataset, Ints], Floats | None]
) -> tuple[Floats, NDArray[Any]]:
    """Return points (K, 3) and classes (K) of groups of at least two detections."""
    names = np.array(dataset.detections.class_name.texts())
    points, classes = [], []
    for rows in groups:
        point = place(dataset, rows) if len(rows) > 1 else None
        if point is not None:
            points.append(point)
            classes.append(names[rows[0]])
    return np.array(points).reshape(-1, 3), np.array(classes)


def _detections_of_signs(dataset: Dataset, signs: Floats, sign_class: NDArray[Any]) -> list[Ints]:
    """Return for each sign the detections of its class that it is the nearest to in direction."""
    origin, direction, _ = _rays_in_plane(dataset)
    names = np.array(dataset.detections.class_name.texts())
    best, least = np.full(len(origin), -1), np.full(len(origin), math.radians(_NEAREST_DEG))
    for row, (sign, kind) in enumerate(zip(signs, sign_class, strict=True)):
        to_sign = sign - origin
        distance = np.linalg.norm(to_sign, axis=1)
        cosine = np.sum(to_sign * direction, axis=1) / np.maximum(distance, 1e-9)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        nearer = (angle < least) & (distance < _FARTHEST_M) & (names == kind)
        best[nearer], least[nearer] = row, angle[nearer]
    return [np.flatnonzero(best == row) for row in range(len(signs))]


def published(data_dir: Path, name: str) -> Figures:
    """Score what the peer on Bend publishes."""
    assert name == "bend_ramps"
    return bend_ramps.score_peer(data_dir)


PEERS: dict[str, dict[str, Callable[[Path, str], Figures]]] = {
    "london_tl": {"krylov, with depths": krylov},
    "london_tl bearings": {"krylov": krylov},
    "bend_ramps": {"krylov": krylov, "published sites": published},
    "kitti_ts": {"bearings, given": bearings_of_given, "colmap, given": colmap_of_given},
    "av2_static": {"bearings, given": bearings_of_given, "colmap, given": colmap_of_given},
}
"""The peers of each data set; `london_tl bearings` is London without depths, as valuemap gets it."""
