"""The final adjustment: features, GPS positions and the vertical together, and how sure the poses are.

Gauss-Newton with Levenberg's damping over all poses, cameras and points, the points eliminated (Schur's complement).
Outliers of features and of the GPS lose weight (Cauchy).

By Cauchy's loss what is far off pulls for ever, if less and less. Many features are where two edges cross that are not
of one thing, and slide as the camera moves. So once poses have settled features lose their weight faster (Geman and
McClure, 1987).

Errors of features last: one is off in a picture as it was in the one before, while features of one picture know nothing
of each other. So the covariance of the poses is that of the scatter between points (the sandwich of Huber, 1967, and of
Liang and Zeger, 1986): what all sights of a point pull together counts, not how many they are.

What bends a street a little bends it for all its points: windows alike, a lens that is not quite its model. No scatter
between points shows it, but the GPS does. By how much features weigh too much is estimated with what the GPS says of
the shape, by the likelihood of its positions with all poses and points integrated out (Patterson and Thompson, 1971).

Errors of a GPS follow each other: what looks like a hundred positions may be worth ten. How much its residuals along a
drive are alike says by how much their sigma must grow. The vertical is known from cameras that are held level: their
axis x is horizontal on average, which counts once a drive, not once a picture, as all lean in the same way. They may
look up or down much more, so that how a street climbs is left to the GPS.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import bsr_matrix, coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from valuemap.arrays import Bools, Floats, Ints
from valuemap.colmap import pycolmap

_MOST_STEPS, _ENOUGH = 20, 1e-4
_WHOLE_STEPS = 5
_DAMPING = (1e-6, 1e-12, 1e3)
"""At first, at least and at most."""
_LEAST_SIGMA_PX = 0.2
_NEAREST_M = 0.3
_CAUCHY, _GEMAN = 1, 2
"""Losses by their power: weights 1 / (1 + x^2) and 1 / (1 + x^2)^2, with errors x in units of `_HALF` sigmas."""
_HALF, _BEHIND = 2.5, 30.0
_GROWTHS = 2.0 ** np.arange(0.0, 6.5, 0.5)
"""Of variances: no growth, up to eight times the standard deviation."""
_SURE = 2.71
"""What the logarithm of a likelihood ratio, doubled, exceeds by chance once in twenty, where nothing grows."""
_LEAST_SHARE = 1e-6
"""Of the priors, that holds what features alone leave open."""
_HEIGHT_SHARE = 2.0
_FOCAL_SHARE, _GUESSED_FOCAL_SHARE, _DISTORTION_SIGMA = 0.05, 0.5, 0.2
_LONGEST_RUN = 50
_LEAST_RUN = 20
_BATCH = 300
_ROLL_SIGMA_RAD, _PITCH_SIGMA_RAD = 0.02, 0.2
_RANGE_M = 20.0
"""What is mapped stands about so far away: a turn moves it as much as a shift of this times the turn."""


@dataclass(frozen=True, eq=False)
class Sights:
    """What pictures (N) see: features (M) of points (P), their positions by GPS, and first guesses of everything.

    `row` (N) are theirs in the job, in driving order within each `drive` (N, numbers); `cam_from_world` (N, 3, 3),
    `center_in_world_m` (N, 3), `gps_in_world_m` (N, 3, NaN where there is none), `sigma_m` (N); `image` and `point` (M)
    are numbers of rows here, `pixel` (M, 2).
    """

    row: Ints
    cam_from_world: Floats
    center_in_world_m: Floats
    camera_id: Ints
    cameras: dict[int, Any]
    has_focal: dict[int, bool]
    gps_in_world_m: Floats
    sigma_m: Floats
    drive: Ints
    image: Ints
    point: Ints
    pixel: Floats
    point_in_world_m: Floats


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses (N), cameras by id, and standard deviations (N, 2) of each axis: of a position, m, and of a rotation, rad.

    `sigma` is that of a pose in the world. `sigma_in_part` is what is left of it where its part is moved, turned and
    scaled as a whole to where it should be: the share that pictures of one part do not have in common.
    """

    cam_from_world: Floats
    center_in_world_m: Floats
    cameras: dict[int, Any]
    sigma: Floats
    sigma_in_part: Floats


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations: of poses and cameras, of points (P, 3, 3), and between them."""

    rest: Any
    points: Floats
    between: Any
    rest_right: Floats
    points_right: Floats

    def without_points(self, damping: float) -> tuple[Any, Floats, Any]:
        """Return matrix and right side without the points (Schur's complement), and the inverse of the points' part."""
        axes = np.arange(3)
        points = self.points.copy()
        # A point that is seen along one line alone has no depth: so little moves it nowhere.
        points[:, axes, axes] += damping * points[:, axes, axes] + 1e-9 * (1.0 + points[:, axes, axes])
        count = len(points)
        inverse = bsr_matrix((np.linalg.inv(points), np.arange(count), np.arange(count + 1))).tocsr()
        matrix = self.rest + damping * diags(self.rest.diagonal()) - self.between @ inverse @ self.between.T
        return matrix, self.rest_right - self.between @ (inverse @ self.points_right), inverse

    def step(self, damping: float) -> tuple[Floats, Floats]:
        """Return the step of poses and cameras, and that of the points (P, 3)."""
        matrix, right, inverse = self.without_points(damping)
        step: Floats = splu(matrix.tocsc()).solve(right)
        return step, (inverse @ (self.points_right - self.between.T @ step)).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Linear:
    """Errors of features (2 M), their derivatives by poses and cameras, and by points (M, 2, 3)."""

    residual: Floats
    of_rest: csr_matrix
    by_place: Floats

    def rows(self, width: int) -> Ints:
        """Return the rows (M, 2, width) of blocks."""
        return np.repeat(np.arange(len(self.residual)).reshape(-1, 2)[:, :, None], width, 2)


@dataclass(frozen=True, eq=False)
class _Weights:
    """Square roots of the weights of features (M), of GPS positions (N, 3) and of roll and pitch (N, 2).

    `sigma_px` is the standard deviation of features that are no outliers, `power` the loss of those that are. `growth`
    is that of the variance of what they say together of the shape of streets.
    """

    sigma_px: float
    feature: Floats
    gps: Floats
    level: Floats
    growth: float
    power: int


def adjust(sights: Sights, part: Ints, *, is_last: bool = True) -> Adjusted:
    """Return the poses and cameras that agree best, with their standard deviations.

    `part` (N) says which pictures hang together by what they see. Points are made anew from these poses unless this
    `is_last`: by then poses have settled.
    """
    power = _GEMAN if is_last else _CAUCHY
    # First the GPS is taken at its word: what is wrong yet would look like errors of it that follow each other.
    worse = np.ones(len(sights.row))
    here = _settled(_converged(sights, sights, worse), part, sights, worse)
    worse = gps_inflation(_gps_off(here), here.drive)
    here = _settled(_converged(here, sights, worse, power=power), part, sights, worse)
    growth = _growth_of_features(here, sights, worse, part, power)
    here = _settled(_converged(here, sights, worse, growth, power), part, sights, worse, growth)
    weights = _weigh(here, worse, growth, power)
    # Weights are less by the growth, and what features pull is more than these say.
    scatter = growth * _scatter(_linearised(here, weights), here)
    meat = scatter + _priors(here, weights, sights, scatter.shape[0])[0]
    # What weights lose where errors grow is information that their sum counts and that there is not (Huber, 1981).
    equations = _equations(
        here, replace(weights, feature=weights.feature * np.sqrt(_slope_share(here, weights))), sights
    )
    variance, in_part = _variances(equations.without_points(0.0)[0], meat, here, part)
    return Adjusted(here.cam_from_world, here.center_in_world_m, here.cameras, np.sqrt(variance), np.sqrt(in_part))


def _growth_of_features(here: Sights, first: Sights, worse: Floats, part: Ints, power: int) -> float:
    """Return by how much the variance of what features say of the shape of parts must grow, at least 1.

    With what features say, F, and priors, P, about where both agree best, positions by GPS have a variance of
    g F^-1 + P^-1 about the shape by features. Of all g tried that is taken under which they are likeliest, if it is
    more than chance. Moves of a part as a whole (7) are none of its shape.
    """
    weights = _weigh(here, worse, power=power)
    matrix, right, _ = _equations(here, weights, first).without_points(0.0)
    priors, right_of_priors = _priors(here, weights, first, matrix.shape[0])
    features, right_of_features = matrix - priors, right - right_of_priors
    alone = splu((features + _LEAST_SHARE * priors).tocsc()).solve(right_of_features)
    shape = matrix.shape[0] - 7 * len(np.unique(part))
    cost = []
    for growth in _GROWTHS:
        factors = splu((features / growth + priors).tocsc())
        both = right_of_features / growth + right_of_priors
        quadratic = right_of_features @ alone / growth - both @ factors.solve(both)
        cost.append(quadratic + np.log(np.abs(factors.U.diagonal())).sum() + shape * np.log(growth))
    best = int(np.argmin(cost))
    return float(_GROWTHS[best]) if cost[0] - cost[best] > _SURE else 1.0


def _converged(here: Sights, first: Sights, worse: Floats, growth: float = 1.0, power: int = _CAUCHY) -> Sights:
    """Return the sights with all moved to where they agree best, the GPS with sigmas `worse` (N) times as large."""
    damping, least, most = _DAMPING
    for _ in range(_MOST_STEPS):
        weights = _weigh(here, worse, growth, power)
        equations = _equations(here, weights, first)
        cost = _cost(here, weights, first)
        while damping < most:
            there = _moved(here, *equations.step(damping))
            if (after := _cost(there, weights, first)) < cost:
                break
            damping *= 10.0
        else:
            break
        here = there
        # What the GPS alone says is little beside features: much damping holds it up.
        if cost - after < _ENOUGH * cost and damping <= least:
            break
        damping = max(damping / 100.0, least)
    return here


def _in_camera(sights: Sights) -> Floats:
    """Return the points of the features (M, 3) in camera axes."""
    away = sights.point_in_world_m[sights.point] - sights.center_in_world_m[sights.image]
    in_cam: Floats = np.einsum("mij,mj->mi", sights.cam_from_world[sights.image], away)
    return in_cam


def _project(sights: Sights, in_cam: Floats) -> Floats:
    """Return pixels (M, 2); NaN behind the camera, or so near before it that no street has anything there."""
    pixel = np.full((len(in_cam), 2), np.nan)
    of = sights.camera_id[sights.image]
    for camera_id, camera in sights.cameras.items():
        rows = np.flatnonzero((of == camera_id) & (in_cam[:, 2] > _NEAREST_M))
        if len(rows):
            pixel[rows] = camera.img_from_cam(in_cam[rows])
    return pixel


def _residuals(sights: Sights) -> Floats:
    return np.asarray(_project(sights, _in_camera(sights)) - sights.pixel)


def _weigh(sights: Sights, worse: Floats, growth: float = 1.0, power: int = _CAUCHY) -> _Weights:
    residual = np.linalg.norm(_residuals(sights), axis=1)
    fine = np.isfinite(residual)
    # The length of two normal errors has a median of 1.18 sigmas.
    sigma_px = max(float(np.median(residual[fine])) / 1.18, _LEAST_SIGMA_PX)
    feature = np.zeros(len(residual))
    size = residual[fine] / (_HALF * sigma_px)
    feature[fine] = 1.0 / sigma_px / np.sqrt(growth * (1.0 + size**2) ** power)
    off = _gps_off(sights)
    known = np.isfinite(off).all(axis=1)
    gps = np.zeros_like(off)
    if known.any():
        length = np.linalg.norm(off[known], axis=1) / worse[known]
        sigma = worse[known] * sights.sigma_m[known] * np.sqrt(1.0 + (length / (1.7 * _HALF)) ** 2)
        gps[known] = 1.0 / sigma[:, None] / [1.0, 1.0, _HEIGHT_SHARE]
    count = np.bincount(sights.drive)[sights.drive]
    level = 1.0 / (np.array([_ROLL_SIGMA_RAD, _PITCH_SIGMA_RAD]) * np.sqrt(count)[:, None])
    return _Weights(sigma_px, feature, gps, level, growth, power)


def _slope_share(sights: Sights, weights: _Weights) -> float:
    """Return how much what features pull changes with their errors, as a share of their weights.

    Along an error x with the weight w = (1 + x^2)^-p that is w (1 + x^2 - 2 p x^2) / (1 + x^2), across it w: the mean.
    """
    residual = np.linalg.norm(_residuals(sights), axis=1)
    fine = np.isfinite(residual)
    weight, square = weights.feature[fine] ** 2, (residual[fine] / (_HALF * weights.sigma_px)) ** 2
    return float((weight * (1.0 - (weights.power - 1) * square) / (1.0 + square)).sum() / weight.sum())


def _gps_off(sights: Sights) -> Floats:
    """Return how far positions (N, 3) are from those of the GPS, in sigmas, NaN where there is none."""
    off = (sights.center_in_world_m - sights.gps_in_world_m) / [1.0, 1.0, _HEIGHT_SHARE] / sights.sigma_m[:, None]
    return np.asarray(off)


def gps_inflation(off: Floats, drive: Ints) -> Floats:
    """Return by how much (N) the sigmas of GPS positions must grow for what residuals (N, 3), in sigmas, tell of them.

    Two things: residuals that are larger than their sigmas say, and such that follow each other. The mean of n alike
    ones is worth n / (1 + 2 (rho_1 + rho_2 + ...)) with their autocorrelations rho.
    """
    worse = np.ones(len(off))
    for each in np.unique(drive):
        rows = np.flatnonzero((drive == each) & np.isfinite(off).all(axis=1))
        if len(rows) < _LEAST_RUN:
            continue
        along = np.clip(off[rows], -10.0, 10.0)
        size = 1.48 * float(np.median(np.abs(along)))
        along = along - along.mean(axis=0)
        power = float((along**2).mean())
        alike = 1.0
        for lag in range(1, min(_LONGEST_RUN, len(rows) // 3)):
            rho = float((along[lag:] * along[:-lag]).mean()) / max(power, 1e-12)
            if rho < 2.0 / np.sqrt(3.0 * len(rows)):
                break
            alike += 2.0 * rho
        worse[rows] = max(1.0, size) * np.sqrt(alike)
    return worse


def _free(camera: Any) -> Ints:
    """Return which parameters of a camera are adjusted: all but the principal point."""
    return np.array([*camera.focal_length_idxs(), *camera.extra_params_idxs()], dtype=np.int64)


def _intrinsic_columns(sights: Sights) -> dict[int, Ints]:
    """Return the columns of the adjusted parameters of each camera, after those of the poses."""
    columns, start = {}, 6 * len(sights.row)
    for camera_id, camera in sights.cameras.items():
        free = _free(camera) if camera.model.name != "EQUIRECTANGULAR" else np.empty(0, dtype=np.int64)
        columns[camera_id] = start + np.arange(len(free))
        start += len(free)
    return columns


def _intrinsic_weights(sights: Sights, first: Sights) -> list[tuple[int, float, float]]:
    """Return column, square root of weight, and residual of each adjusted parameter."""
    found = []
    for camera_id, columns in _intrinsic_columns(sights).items():
        camera, before = sights.cameras[camera_id], first.cameras[camera_id]
        focal = len(camera.focal_length_idxs())
        share = _FOCAL_SHARE if first.has_focal[camera_id] else _GUESSED_FOCAL_SHARE
        for place, (column, which) in enumerate(zip(columns.tolist(), _free(camera).tolist(), strict=False)):
            sigma = share * before.params[which] if place < focal else _DISTORTION_SIGMA
            target = before.params[which] if place < focal else 0.0
            found.append((column, 1.0 / sigma, camera.params[which] - target))
    return found


def _cost(sights: Sights, weights: _Weights, first: Sights) -> float:
    """Return the sum of squares in sigmas: of features with their loss, of the rest with the weights as they are."""
    size = np.linalg.norm(_residuals(sights), axis=1) / (_HALF * weights.sigma_px)
    # What comes to lie behind its camera is an outlier like others.
    square = np.where(np.isfinite(size), size, _BEHIND) ** 2
    loss = np.log1p(square) if weights.power == _CAUCHY else square / (1.0 + square)
    total = _HALF**2 / weights.growth * float(loss.sum())
    total += float(np.nansum(((sights.center_in_world_m - sights.gps_in_world_m) * weights.gps) ** 2))
    total += float(((_slopes(sights) * weights.level) ** 2).sum())
    total += sum((root * off) ** 2 for _, root, off in _intrinsic_weights(sights, first))
    return total


def _equations(sights: Sights, weights: _Weights, first: Sights) -> _Equations:
    """Return the normal equations.

    The unknowns are for each picture a small rotation w of the camera, R' = exp(w) R, and the shift of its centre; then
    the cameras' parameters.
    """
    linear = _linearised(sights, weights)
    of_rest, shape = linear.of_rest, (len(linear.residual), 3 * len(sights.point_in_world_m))
    of_points = _sparse([(linear.rows(3), _blocks(sights.point, 3, 2), linear.by_place)], shape)
    more, more_right = _priors(sights, weights, first, of_rest.shape[1])
    each = np.zeros((len(sights.point_in_world_m), 3, 3))
    np.add.at(each, sights.point, np.einsum("mki,mkj->mij", linear.by_place, linear.by_place))
    return _Equations(
        rest=(of_rest.T @ of_rest).tocsr() + more,
        points=each,
        between=(of_rest.T @ of_points).tocsr(),
        rest_right=more_right - of_rest.T @ linear.residual,
        points_right=-(of_points.T @ linear.residual),
    )


def _linearised(sights: Sights, weights: _Weights) -> _Linear:
    """Return what features say, in sigmas."""
    in_cam = _in_camera(sights)
    residual = _project(sights, in_cam) - sights.pixel
    by_point, by_param = _derivatives(sights, in_cam)
    fine: Bools = np.asarray(np.isfinite(residual).all(axis=1) & np.isfinite(by_point).all(axis=(1, 2)))
    weight = np.where(fine, weights.feature, 0.0)
    residual = np.where(fine[:, None], residual, 0.0) * weight[:, None]
    by_point = np.where(fine[:, None, None], by_point, 0.0) * weight[:, None, None]
    count, images = len(sights.image), len(sights.row)
    turned = sights.cam_from_world[sights.image]
    cross = np.zeros((count, 3, 3))  # d(exp(w) x)/dw = -[x]
    x, y, z = in_cam.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 0] = z, -y, -z
    cross[:, 1, 2], cross[:, 2, 0], cross[:, 2, 1] = x, y, -x
    by_place = by_point @ turned
    of_pose = np.concatenate([by_point @ cross, -by_place], axis=2)
    columns = _intrinsic_columns(sights)
    size = 6 * images + sum(map(len, columns.values()))
    rows = np.arange(2 * count).reshape(count, 2)
    where = [(np.repeat(rows[:, :, None], 6, 2), _blocks(sights.image, 6, 2), of_pose)]
    of_camera = sights.camera_id[sights.image]
    for camera_id, own in columns.items():
        mine = np.flatnonzero((of_camera == camera_id) & fine)
        if len(own) and len(mine):
            values = by_param[camera_id][mine] * weight[mine, None, None]
            place = np.broadcast_to(own, values.shape)
            where.append((np.repeat(rows[mine][:, :, None], len(own), 2), place, values))
    return _Linear(residual.reshape(-1), _sparse(where, (2 * count, size)), by_place)


def _scatter(linear: _Linear, sights: Sights) -> csr_matrix:
    """Return the sum of squares of what points pull poses and cameras, each with all its sights.

    What a point can follow by moving itself pulls nothing else.
    """
    count, points, residual = len(linear.residual), len(sights.point_in_world_m), linear.residual.reshape(-1, 2)
    moves, pull_of_point = np.zeros((points, 3, 3)), np.zeros((points, 3))
    np.add.at(moves, sights.point, np.einsum("mki,mkj->mij", linear.by_place, linear.by_place))
    np.add.at(pull_of_point, sights.point, np.einsum("mki,mk->mi", linear.by_place, residual))
    step = np.einsum("pij,pj->pi", np.linalg.pinv(moves, hermitian=True), pull_of_point)
    left = residual - np.einsum("mki,mi->mk", linear.by_place, step[sights.point])
    of_point = csr_matrix((left.reshape(-1), (np.repeat(sights.point, 2), np.arange(count))), shape=(points, count))
    pull = of_point @ linear.of_rest
    return csr_matrix(pull.T @ pull)


def _slopes(sights: Sights) -> Floats:
    """Return the sines (N, 2) of the angles by which the axes x and z of the cameras are off the horizontal."""
    return np.asarray(sights.cam_from_world[:, [0, 2], 2])


def _blocks(number: Ints, width: int, height: int) -> Ints:
    """Return the columns (M, height, width) of blocks."""
    return np.repeat((width * number[:, None] + np.arange(width))[:, None], height, axis=1)


def _sparse(parts: list[tuple[Ints, Ints, Floats]], shape: tuple[int, int]) -> Any:
    rows, columns, values = (np.concatenate([part[i].reshape(-1) for part in parts]) for i in range(3))
    return coo_matrix((values, (rows, columns)), shape=shape).tocsr()


def _derivatives(sights: Sights, in_cam: Floats) -> tuple[Floats, dict[int, Floats]]:
    """Return derivatives of pixels by the point in camera axes (M, 2, 3), and by each camera's parameters (M, 2, K)."""
    by_point = np.empty((len(in_cam), 2, 3))
    step = 1e-5 * np.maximum(np.abs(in_cam[:, 2]), 1e-3)
    for axis in range(3):
        ahead, behind = in_cam.copy(), in_cam.copy()
        ahead[:, axis] += step
        behind[:, axis] -= step
        by_point[:, :, axis] = (_project(sights, ahead) - _project(sights, behind)) / (2.0 * step[:, None])
    by_param = {}
    for camera_id, columns in _intrinsic_columns(sights).items():
        free, values = _free(sights.cameras[camera_id]), []
        for which in free[: len(columns)].tolist():
            size = 1e-4 * max(1.0, abs(sights.cameras[camera_id].params[which]))
            both = [
                _project(replace(sights, cameras={camera_id: _changed(sights.cameras[camera_id], which, sign)}), in_cam)
                for sign in (size, -size)
            ]
            values.append((both[0] - both[1]) / (2.0 * size))
        if values:
            by_param[camera_id] = np.stack(values, axis=2)
    return by_point, by_param


def _changed(camera: Any, which: int, by: float) -> Any:
    params = np.array(camera.params, dtype=np.float64)
    params[which] += by
    return pycolmap.Camera(model=camera.model.name, width=camera.width, height=camera.height, params=params)


def _priors(sights: Sights, weights: _Weights, first: Sights, size: int) -> tuple[csr_matrix, Floats]:
    """Return what GPS, the vertical and the first guesses of cameras add to normal matrix and right side."""
    images = len(sights.row)
    diagonal, right = np.zeros(size), np.zeros(size)
    place = 6 * np.arange(images)[:, None] + [3, 4, 5]
    diagonal[place] = weights.gps**2
    right[place] = -(weights.gps**2) * np.nan_to_num(sights.center_in_world_m - sights.gps_in_world_m)
    for column, root, off in _intrinsic_weights(sights, first):
        diagonal[column], right[column] = root**2, -(root**2) * off
    # Of a level camera the axes x and z are horizontal. (exp(w) R)[k] = R[k] + (w x R)[k].
    third = np.zeros((images, 2, 3))
    up_in_cam = sights.cam_from_world[:, :, 2]
    third[:, 0, 1], third[:, 0, 2] = up_in_cam[:, 2], -up_in_cam[:, 1]
    third[:, 1, 0], third[:, 1, 1] = up_in_cam[:, 1], -up_in_cam[:, 0]
    third *= weights.level[:, :, None]
    off_up = _slopes(sights) * weights.level
    blocks = np.zeros((images, 6, 6))
    blocks[:, :3, :3] = np.einsum("nki,nkj->nij", third, third)
    right[(6 * np.arange(images)[:, None] + [0, 1, 2])] -= np.einsum("nki,nk->ni", third, off_up)
    up = bsr_matrix((blocks, np.arange(images), np.arange(images + 1)), shape=(6 * images, 6 * images)).tocoo()
    return csr_matrix((up.data, (up.row, up.col)), shape=(size, size)) + diags(diagonal), right


def _variances(matrix: Any, meat: Any, sights: Sights, part: Ints) -> tuple[Floats, Floats]:
    """Return variances (N, 2) of positions and rotations in the world, and in their parts.

    The covariance S is M^-1 B M^-1, with the matrix M of the equations and the scatter B of what they rest on. With G
    (D, 7) the ways in which a part moves as a whole and W weights, P = I - G (G'WG)^-1 G'W takes a fitted move of the
    whole out of an error. The diagonal of P S P' needs of S its own diagonal and S W G.
    """
    factors, images = splu(matrix.tocsc()), len(sights.row)
    count = 6 * images
    own = np.empty(count)
    for start in range(0, count, _BATCH):
        stop = min(start + _BATCH, count)
        unit = np.zeros((matrix.shape[0], stop - start))
        unit[np.arange(start, stop), np.arange(stop - start)] = 1.0
        column = factors.solve(unit)
        own[start:stop] = (column * (meat @ column)).sum(axis=0)
    rest = own.copy()
    weight = np.tile([_RANGE_M**2] * 3 + [1.0] * 3, images)
    for each in np.unique(part):
        rows = np.flatnonzero(part == each)
        place = (6 * rows[:, None] + np.arange(6)).reshape(-1)
        ways = _moves_of_whole(sights, rows)
        weighted = np.zeros((matrix.shape[0], 7))
        weighted[place] = weight[place, None] * ways
        spread = factors.solve(meat @ factors.solve(weighted))[place]
        fitted = ways @ np.linalg.pinv(ways.T @ weighted[place])
        rest[place] += -2.0 * (fitted * spread).sum(axis=1)
        rest[place] += ((fitted @ (weighted[place].T @ spread)) * fitted).sum(axis=1)
    both = np.stack([np.maximum(each, 0.0).reshape(-1, 2, 3).mean(axis=2)[:, ::-1] for each in (own, rest)])
    return both[0], both[1]


def _settled(sights: Sights, part: Ints, first: Sights, worse: Floats, growth: float = 1.0) -> Sights:
    """Move, turn and scale each part as a whole to where GPS and level cameras want it.

    Features say nothing of that, and what the others say of it is so little beside them that steps of everything at
    once come to it slowly.
    """
    of_point = np.zeros(len(sights.point_in_world_m), dtype=np.int64)
    of_point[sights.point] = part[sights.image]
    for _ in range(_WHOLE_STEPS):
        size = 6 * len(sights.row)
        matrix, right = _priors(
            sights, _weigh(sights, worse, growth), first, size + sum(map(len, _intrinsic_columns(sights).values()))
        )
        turn, center = sights.cam_from_world.copy(), sights.center_in_world_m.copy()
        points = sights.point_in_world_m.copy()
        for each in np.unique(part):
            rows = np.flatnonzero(part == each)
            place = (6 * rows[:, None] + np.arange(6)).reshape(-1)
            ways = _moves_of_whole(sights, rows)
            normal = ways.T @ (matrix[place][:, place] @ ways)
            step = np.linalg.lstsq(normal, ways.T @ right[place], rcond=1e-12)[0]
            moved, grown = Rotation.from_rotvec(step[3:6]).as_matrix(), 1.0 + max(step[6], -0.5)
            middle = sights.center_in_world_m[rows].mean(axis=0)
            center[rows] = grown * (center[rows] - middle) @ moved.T + middle + step[:3]
            turn[rows] = turn[rows] @ moved.T
            mine = of_point == each
            points[mine] = grown * (points[mine] - middle) @ moved.T + middle + step[:3]
        sights = replace(sights, cam_from_world=turn, center_in_world_m=center, point_in_world_m=points)
    return sights


def _moves_of_whole(sights: Sights, rows: Ints) -> Floats:
    """Return how poses (6 N) change when all are shifted, turned and scaled about their middle (7 columns)."""
    away = sights.center_in_world_m[rows]
    away = away - away.mean(axis=0)
    ways = np.zeros((len(rows), 6, 7))
    ways[:, 3:, :3] = np.eye(3)
    x, y, z = away.T
    ways[:, 3, 4], ways[:, 3, 5], ways[:, 4, 3] = z, -y, -z
    ways[:, 4, 5], ways[:, 5, 3], ways[:, 5, 4] = x, y, -x
    ways[:, :3, 3:6] = -sights.cam_from_world[rows]  # The world turns, the camera with it: R' = R exp(-t).
    ways[:, 3:, 6] = away
    return ways.reshape(-1, 7)


def _moved(sights: Sights, step: Floats, points_step: Floats) -> Sights:
    images = len(sights.row)
    poses = step[: 6 * images].reshape(-1, 6)
    cameras = {}
    for camera_id, columns in _intrinsic_columns(sights).items():
        camera = sights.cameras[camera_id]
        params = np.array(camera.params, dtype=np.float64)
        params[_free(camera)[: len(columns)]] += step[columns]
        cameras[camera_id] = pycolmap.Camera(
            model=camera.model.name, width=camera.width, height=camera.height, params=params
        )
    return replace(
        sights,
        cam_from_world=Rotation.from_rotvec(poses[:, :3]).as_matrix() @ sights.cam_from_world,
        center_in_world_m=sights.center_in_world_m + poses[:, 3:],
        point_in_world_m=sights.point_in_world_m + points_step,
        cameras=cameras,
    )
