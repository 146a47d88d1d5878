"""How pairs of pictures stand to each other by their matches, and what depths the two give, in units of their way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.colmap import pycolmap
from valuemap.readers.structure.job import DATABASE

LEAST_MATCHES = 30
"""Of a pair. Two pictures of different houses with windows alike may agree in 25 features."""

_ROUNDS = 12
_AHEAD, _LEAST_IN_PLANE, _IN_PLANE, _TRIALS = 0.2, 8, 0.4, 500
_SHARP = 0.002
"""How far features are off, as a share of their depth: one pixel of a focal length of 500."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two pictures, by row, that are of one place as their matches say.

    `second_from_first` (H, 3, 3) are the rotations that may turn directions in the first camera's axes into those of
    the second: where all that both see lies in one plane, two explain it equally well, and other pairs must say which
    is true. `feature` (M, 2) are the numbers of the features in both pictures, `ray` (2, M, 3) their directions of
    length 1 in camera axes.
    """

    first: int
    second: int
    second_from_first: Floats
    feature: Ints
    ray: Floats


def read_pairs(workspace: Path, ids: dict[int, int], cameras: dict[int, pycolmap.Camera]) -> list[Pair]:
    """Return the pairs whose matches agree about one way between the two, in the order of their rows."""
    row_of = {image_id: row for row, image_id in ids.items()}
    found, pixel = [], {}
    with pycolmap.Database.open(workspace / DATABASE) as database:
        camera_of = {each.image_id: cameras[each.camera_id] for each in database.read_all_images()}
        numbers, counts = database.read_two_view_geometry_num_inliers()
        for number, count in zip(numbers, counts, strict=True):
            one, two = sorted(pycolmap.pair_id_to_image_pair(number), key=lambda each: row_of.get(each, -1))
            if count < LEAST_MATCHES or one not in row_of:
                continue
            for each in (one, two):
                if each not in pixel:
                    pixel[each] = np.asarray(database.read_keypoints(each), dtype=np.float64)[:, :2]
            geometry = database.read_two_view_geometry(one, two)
            if not pycolmap.estimate_two_view_geometry_pose(
                camera_of[one], pixel[one], camera_of[two], pixel[two], geometry
            ):
                continue
            feature = np.asarray(geometry.inlier_matches, dtype=np.int64)
            ray = np.stack([_rays(camera_of[each], pixel[each][feature[:, i]]) for i, each in enumerate((one, two))])
            assert geometry.cam2_from_cam1 is not None
            turn = np.asarray(geometry.cam2_from_cam1.rotation.matrix())
            turns = np.concatenate([turn[None], _turns_by_plane(*ray)])
            found.append(Pair(row_of[one], row_of[two], turns, feature, ray))
    return sorted(found, key=lambda pair: (pair.first, pair.second))


def _turns_by_plane(first: Floats, second: Floats) -> Floats:
    """Return the rotations (H, 3, 3) by which directions (M, 3) of points in one plane may come about, none or two.

    Of the four ways in which a homography comes apart (Malis and Vargas, 2007) two have the points behind a camera.
    """
    before = (first[:, 2] > _AHEAD) & (second[:, 2] > _AHEAD)
    if before.sum() < _LEAST_IN_PLANE:
        return np.empty((0, 3, 3))
    one, two = (ray[before, :2] / ray[before, 2:] for ray in (first, second))
    plane, inside = cv2.findHomography(one, two, cv2.RANSAC, 2.0 * _SHARP, maxIters=_TRIALS)
    if plane is None or inside.sum() < _IN_PLANE * len(first):
        return np.empty((0, 3, 3))
    return np.unique(np.round(cv2.decomposeHomographyMat(plane, np.eye(3))[1], 9), axis=0)


def _rays(camera: pycolmap.Camera, pixel: Floats) -> Floats:
    ray = np.column_stack([np.asarray(camera.cam_from_img(pixel)), np.ones(len(pixel))])
    return np.asarray(ray / np.linalg.norm(ray, axis=1)[:, None])


@dataclass(frozen=True, eq=False)
class Way:
    """The way from the first camera of a pair to the second, where rotations are known: its direction (3), length 1.

    `fine` (M) says which matches agree with it, `depth` (2, M) the lengths of their rays to the point that they see, in
    units of the way, and `parallax_rad` (M) the angles between them. `sigma` (M) is that of the logarithm of depths.
    """

    direction: Floats
    fine: Bools
    depth: Floats
    parallax_rad: Floats
    sigma: Floats


def find_way(first: Floats, second: Floats) -> Way:
    """Return the way between two cameras that see something in directions `first` and `second` (M, 3) in one frame.

    The way lies in the plane of both rays of each match: the direction is across all their normals, reweighted so that
    outliers lose their weight. It goes to where more points are before both cameras.
    """
    normal = np.cross(first, second)
    parallax = np.arcsin(np.clip(np.linalg.norm(normal, axis=1), 0.0, 1.0))
    weight = np.ones(len(first))
    for _ in range(_ROUNDS):
        direction = np.linalg.eigh((normal * weight[:, None]).T @ normal)[1][:, 0]
        # The normal is as long as the parallax is large: its share along the way is an angle across it.
        weight = 1.0 / (1.0 + (normal @ direction / _SHARP) ** 2)
    depth = _depths(direction, first, second)
    if np.sum(weight * np.sign(depth).sum(axis=0) * parallax) < 0.0:
        direction, depth = -direction, -depth
    fine: Bools = (np.abs(normal @ direction) < 3.0 * _SHARP) & (depth > 0.0).all(axis=0)
    sigma = _SHARP / np.maximum(parallax, 1e-9)
    return Way(direction, fine, depth, parallax, sigma)


def _depths(direction: Floats, first: Floats, second: Floats) -> Floats:
    """Return how long the rays (M, 3) of cameras a unit apart are (2, M) where they come nearest to each other."""
    along, one, two = (first * second).sum(axis=1), first @ direction, second @ direction
    share = np.maximum(1.0 - along**2, 1e-12)
    return np.stack([(one - along * two) / share, (along * one - two) / share])
