"""Joint least squares over objects and the errors of drives: a bundle adjustment whose poses have few parameters.

A detection of object X in an image with pose (R, C) and local pinhole M (see `cameras.py`) has the residual

    r = (1 + s) (a/c, b/c) + s (u - u_0),    (a, b, c) = M p,
    p = exp(m + n + tau w) R (X - C - o - d - tau v)

with s the error of the camera's focal length, m how the camera is mounted (in camera axes), n and d the drift of
rotation and position, o the offset of the leg, and tau the time from pose to exposure, in which the image moves by v
and turns by w. Drift is an Ornstein-Uhlenbeck process over nodes along the drive. It couples neighbouring nodes only:
each drive's nodes are eliminated by a banded Cholesky factor; what is left are the objects and the constants. Steps
are those of Gauss-Newton with Cauchy's weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, solveh_banded
from scipy.sparse.linalg import splu

from valuemap.tables import Bools, Floats, Ints

OFFSET, MOUNT, DELAY, FOCAL, CAMERA_MOUNT, CAMERA_DELAY = range(6)
KINDS = ("offset", "mount", "delay", "focal", "camera_mount", "camera_delay")
WIDTH = (3, 3, 1, 1, 3, 1)
_DENSE_LIMIT = 3000
_SMALL = 200_000
"""Normal equations of fewer observations times columns are made of dense matrices: sparse ones take longer to build."""
_DAMPING = 1e-6
"""Added to the information of objects, so that one that nothing tells stays."""
_LONGEST_M = 20.0
"""A step moves an object by at most this."""
_CAUCHY = 2.0
"""Residuals of so many sigmas weigh half."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Detections (N) of objects, sorted by drive and node, with what their residuals are computed from.

    `residual_from_cam` (N, 3, 3), `cam_from_world` (N, 3, 3), `center_in_world_m` (N, 3); `forward_mps`, `backward_mps`
    (N, 3) and `forward_radps`, `backward_radps` (N, 3, camera axes): how the image moves and turns until the next one
    and since the last one; `from_middle_px` (N, 2) from the principal point (0 where the camera has no focal length);
    `cam_from_node` (N, 3, 3) turns drift into camera axes; `sigma_px` (N) is the deviation of all that
    is not in the model, `detection_sigma_px` (N) that of the detection alone. `leg` (N) and `vehicle` (N) are the rows
    of the offset and of the mounting and delay; drives that go on as the one before them share its vehicle.
    """

    residual_from_cam: Floats
    cam_from_world: Floats
    center_in_world_m: Floats
    forward_mps: Floats
    backward_mps: Floats
    forward_radps: Floats
    backward_radps: Floats
    from_middle_px: Floats
    cam_from_node: Floats
    sigma_px: Floats
    detection_sigma_px: Floats
    thing: Ints
    node: Ints
    drive: Ints
    leg: Ints
    vehicle: Ints
    camera: Ints
    image: Ints

    def __len__(self) -> int:
        return len(self.thing)

    def pixels_per_unit(self) -> Floats:
        """Return the local focal length (N), px: that of a pinhole along the detection's own ray."""
        square = np.sum(self.residual_from_cam[:, :2] ** 2, axis=(1, 2)) - np.sum(
            np.einsum("nij,nj->ni", self.residual_from_cam[:, :2], self.residual_from_cam[:, 2]) ** 2, axis=1
        )
        return np.asarray(np.sqrt(0.5 * square))

    def take(self, rows: Any) -> Observations:
        """Return some of them."""
        return Observations(**{name: value[rows] for name, value in vars(self).items()})


@dataclass(frozen=True, eq=False)
class Chain:
    """Nodes (n) of all drives: `drive` (n) ascending, `keep` (n) the correlation with the node before, 0 at a start."""

    drive: Ints
    keep: Floats


@dataclass(frozen=True)
class Scales:
    """Standard deviations a priori: of drift and of an image's own error, each axis; of each kind of constant.

    Those of constants are one number, or one for each (rows, width).
    """

    drift_m: float
    drift_rad: float
    own_m: float
    own_rad: float
    constant: tuple[float | Floats, ...]


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
    """Of the constants that are free (C, C), in the order of `Adjustment.free`, all else marginalised."""

    @staticmethod
    def zero(points: Floats, nodes: int, images: int, counts: tuple[int, ...]) -> State:
        """Return poses as they are."""
        return State(
            points,
            np.zeros((nodes, 6)),
            np.zeros((images, 6)),
            tuple(np.zeros((n, w)) for n, w in zip(counts, WIDTH, strict=True)),
        )


def rotations(vector_rad: Floats) -> Floats:
    """Return rotation matrices (N, 3, 3) of rotation vectors (N, 3), Rodrigues' formula."""
    angle = np.linalg.norm(vector_rad, axis=1)
    safe = np.where(angle > 1e-12, angle, 1.0)
    cross = skew(vector_rad / safe[:, None])
    sin, cos = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sin * cross + (1.0 - cos) * (cross @ cross))


def skew(vector: Floats) -> Floats:
    """Return the matrices (N, 3, 3) whose product with a vector is the cross product."""
    x, y, z = vector.T
    o = np.zeros_like(x)
    return np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)


def corrected(seen: Observations, state: State) -> tuple[Floats, Floats, Floats, Floats]:
    """Return rotations (N, 3, 3), centres (N, 3), and the velocity (N, 3) and turn rate (N, 3) that a delay acts by."""
    offset, mount, delay, _, camera_mount, camera_delay = state.constants
    late_s = delay[seen.vehicle, 0] + camera_delay[seen.camera, 0]
    ahead = (late_s >= 0.0)[:, None]
    velocity = np.where(ahead, seen.forward_mps, seen.backward_mps)
    rate = np.where(ahead, seen.forward_radps, seen.backward_radps)
    drift, own = state.drift[seen.node], state.own[seen.image]
    center = seen.center_in_world_m + velocity * late_s[:, None] + offset[seen.leg] + drift[:, :3] + own[:, :3]
    turn = mount[seen.vehicle] + camera_mount[seen.camera] + own[:, 3:]
    turn = turn + np.einsum("nij,nj->ni", seen.cam_from_node, drift[:, 3:])
    rotation = rotations(turn) @ rotations(rate * late_s[:, None]) @ seen.cam_from_world
    return rotation, center, velocity, rate


def residuals(seen: Observations, state: State) -> tuple[Floats, Floats]:
    """Return the residuals (N, 2) in px and the depths (N) in m."""
    rotation, center, _, _ = corrected(seen, state)
    p = np.einsum("nij,nj->ni", rotation, state.point_in_world_m[seen.thing] - center)
    abc = np.einsum("nij,nj->ni", seen.residual_from_cam, p)
    stretch = state.constants[FOCAL][seen.camera]
    with np.errstate(divide="ignore", invalid="ignore"):
        return (1.0 + stretch) * abc[:, :2] / abc[:, 2:] + stretch * seen.from_middle_px, abc[:, 2]


def weights(seen: Observations, residual_px: Floats, depth_m: Floats, tolerance: float) -> Floats:
    """Return Cauchy's weights (N) over variance; what is behind its camera weighs nothing."""
    square = np.sum(residual_px**2, axis=1) / seen.sigma_px**2
    with np.errstate(invalid="ignore"):
        weight = 1.0 / (1.0 + square / (tolerance * _CAUCHY) ** 2) / seen.sigma_px**2
    return np.where((depth_m > 0.1) & np.isfinite(square), weight, 0.0)


def cost(seen: Observations, state: State) -> Floats:
    """Return Cauchy's cost (N) of each observation: minus twice its log likelihood, up to a constant."""
    residual_px, depth_m = marginal_residuals(seen, state)
    square = np.sum(residual_px**2, axis=1) / seen.sigma_px**2
    width = _CAUCHY**2
    with np.errstate(invalid="ignore"):
        value = width * np.log1p(square / width)
    return np.asarray(np.where((depth_m > 0.1) & np.isfinite(square), value, width * np.log1p(100.0)))


def marginal_residuals(seen: Observations, state: State) -> tuple[Floats, Floats]:
    """Return the residuals (N, 2) in px without the images' own errors, to first order, and the depths (N)."""
    return _jacobians(seen, state)[:2]


def _jacobians(seen: Observations, state: State) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Return residuals (N, 2), depths, and derivatives by object (N, 2, 3), drift (N, 2, 6), constants, own errors.

    The residuals are those without the images' own errors, to first order around them.
    """
    rotation, center, velocity, rate = corrected(seen, state)
    p = np.einsum("nij,nj->ni", rotation, state.point_in_world_m[seen.thing] - center)
    abc = np.einsum("nij,nj->ni", seen.residual_from_cam, p)
    stretch = state.constants[FOCAL][seen.camera]
    depth = np.where(np.abs(abc[:, 2]) > 1e-6, abc[:, 2], 1e-6)
    ratio = abc[:, :2] / depth[:, None]
    at_own = (1.0 + stretch) * ratio + stretch * seen.from_middle_px
    m = seen.residual_from_cam
    by_p = (1.0 + stretch)[:, :, None] * (m[:, :2] - ratio[:, :, None] * m[:, 2:]) / depth[:, None, None]
    by_point = by_p @ rotation
    by_turn = -by_p @ skew(p)
    by_drift = np.concatenate([-by_point, by_turn @ seen.cam_from_node], axis=2)
    by_delay = -np.einsum("nij,nj->ni", by_point, velocity) + np.einsum("nij,nj->ni", by_turn, rate)
    by_focal = ratio + seen.from_middle_px
    by_own = np.concatenate([-by_point, by_turn], axis=2)
    residual = at_own - np.einsum("nki,ni->nk", by_own, state.own[seen.image])
    parts = [-by_point, by_turn, by_delay[:, :, None], by_focal[:, :, None], by_turn, by_delay[:, :, None]]
    return residual, abc[:, 2], by_point, by_drift, np.concatenate(parts, axis=2), by_own


def by_object(seen: Observations, state: State) -> tuple[Floats, Floats, Floats]:
    """Return residuals (N, 2), depths (N) and the derivatives (N, 2, 3) of the residuals by their objects."""
    residual, depth, by_point, _, _, _ = _jacobians(seen, state)
    return residual, depth, by_point


class Adjustment:
    """The normal equations of observations; `active` (by kind: count, width) says which constants are free."""

    def __init__(
        self, seen: Observations, chain: Chain, scales: Scales, active: tuple[Bools, ...], things: int
    ) -> None:
        self.seen, self.chain, self.scales, self.active, self.things = seen, chain, scales, active, things
        # Columns of the constants after those of the objects.
        self.column_of: list[Ints] = []
        column = 3 * things
        for flags in active:
            index = np.full(flags.shape, -1)
            index[flags] = column + np.arange(int(flags.sum()))
            column += int(flags.sum())
            self.column_of.append(index)
        self.columns = column
        of = (seen.leg, seen.vehicle, seen.vehicle, seen.camera, seen.camera, seen.camera)
        self.constant_columns = np.concatenate([c[rows] for c, rows in zip(self.column_of, of, strict=True)], axis=1)
        bounds = np.flatnonzero(np.diff(seen.drive)) + 1
        self.parts = [rows for rows in np.split(np.arange(len(seen)), bounds) if len(rows)]

    def step(self, state: State, tolerance: float, *, with_variance: bool = False) -> State:
        """Return the state after one step of Gauss-Newton with weights of this tolerance."""
        residual, depth, by_point, by_drift, by_constant, _ = _jacobians(self.seen, state)
        weight = weights(self.seen, residual, depth, tolerance)
        system = _System(self.columns, self.things)
        of_things = np.arange(3 * self.things)
        system.add_diagonal(of_things, np.full(len(of_things), _DAMPING), np.zeros(len(of_things)))
        for kind, index in enumerate(self.column_of):
            free = self.active[kind]
            sigma = np.broadcast_to(np.asarray(self.scales.constant[kind], np.float64), free.shape)[free]
            system.add_diagonal(index[free], sigma**-2, -(sigma**-2) * state.constants[kind][free])
        pending = []
        for rows in self.parts:
            columns_of_thing = 3 * self.seen.thing[rows, None] + np.arange(3)
            columns = np.concatenate([columns_of_thing, self.constant_columns[rows]], axis=1)
            used = np.unique(columns[columns >= 0])
            local = np.where(columns >= 0, np.searchsorted(used, columns), len(used))
            jacobian = np.concatenate([by_point[rows], by_constant[rows]], axis=2)
            hessian, gradient = _dense_normals(jacobian, residual[rows], weight[rows], local, len(used))
            nodes, solved, of_gradient, cross = self._eliminate(
                rows, state, jacobian, by_drift[rows], residual[rows], weight[rows], local, len(used)
            )
            hessian = hessian - cross.T @ solved
            gradient = gradient - cross.T @ of_gradient
            pending.append((nodes, used, solved, of_gradient))
            system.add_block(used, hessian, gradient)
        step, covariance = system.solve(3 * self.things if with_variance else self.columns)
        drift = state.drift.copy()
        for nodes, used, solved, of_gradient in pending:
            drift[nodes] += (of_gradient - solved @ step[used]).reshape(-1, 6)
        points = state.point_in_world_m + np.clip(step[: 3 * self.things].reshape(-1, 3), -_LONGEST_M, _LONGEST_M)
        constants = []
        for kind, index in enumerate(self.column_of):
            free = self.active[kind]
            values = np.where(free, state.constants[kind], 0.0)
            values[free] += step[index[free]]
            constants.append(values)
        moved = State(points, drift, state.own, tuple(constants), covariance if with_variance else None)
        return replace(moved, own=self._own_errors(moved, tolerance))

    def _own_errors(self, state: State, tolerance: float) -> Floats:
        """Return what each image (N, 6) is probably off by itself, given all else."""
        residual, depth, _, _, _, by_own = _jacobians(self.seen, state)
        share = weights(self.seen, residual, depth, tolerance) * self.seen.sigma_px**2 / self.seen.detection_sigma_px**2
        weighted = by_own * share[:, None, None]
        count = len(state.own)
        information, right = np.zeros((count, 6, 6)), np.zeros((count, 6))
        np.add.at(information, self.seen.image, np.einsum("nki,nkj->nij", weighted, by_own))
        np.add.at(right, self.seen.image, -np.einsum("nki,nk->ni", weighted, residual))
        information += np.diag(np.repeat([self.scales.own_m**-2, self.scales.own_rad**-2], 3))
        return np.asarray(np.linalg.solve(information, right[:, :, None])[:, :, 0])

    def _eliminate(
        self,
        rows: Ints,
        state: State,
        jacobian: Floats,
        by_drift: Floats,
        residual: Floats,
        weight: Floats,
        local: Ints,
        width: int,
    ) -> tuple[slice, Floats, Floats, Floats]:
        drive = self.seen.drive[rows[0]]
        first, last = np.searchsorted(self.chain.drive, [drive, drive + 1])
        nodes = slice(int(first), int(last))
        count = int(last - first)
        node = self.seen.node[rows] - first
        precision = np.repeat([self.scales.drift_m**-2, self.scales.drift_rad**-2], 3)
        keep = self.chain.keep[nodes]
        fresh = 1.0 / (1.0 - keep**2 + 1e-9)
        # Precision of the process: each node from the one before it.
        diagonal = fresh.copy()
        diagonal[:-1] += (keep**2 * fresh)[1:]
        beside = -(keep * fresh)[1:]
        band = np.zeros((12, 6 * count))
        blocks = np.zeros((count, 6, 6))
        weighted = by_drift * weight[:, None, None]
        np.add.at(blocks, node, np.einsum("nki,nkj->nij", weighted, by_drift))
        for i in range(6):
            blocks[:, i, i] += diagonal * precision[i]
        for i in range(6):
            for j in range(i + 1):
                band[i - j, j::6] = blocks[:, i, j]
        if count > 1:
            band[6, : 6 * (count - 1)] = (beside[:, None] * precision).ravel()
        drift = state.drift[nodes]
        pull = diagonal[:, None] * drift
        pull[1:] += beside[:, None] * drift[:-1]
        pull[:-1] += beside[:, None] * drift[1:]
        gradient = -pull * precision
        np.add.at(gradient, node, -np.einsum("nki,nk->ni", weighted, residual))
        cross = np.zeros((count, 6, width + 1))
        product = np.einsum("nki,nkj->nij", weighted, jacobian)
        np.add.at(cross, (node[:, None, None], np.arange(6)[None, :, None], local[:, None, :]), product)
        cross_flat = cross.reshape(6 * count, width + 1)[:, :width]
        right = np.concatenate([cross_flat, gradient.reshape(-1, 1)], axis=1)
        solved = solveh_banded(band, right, lower=True, overwrite_ab=True, overwrite_b=True, check_finite=False)
        return nodes, solved[:, :width], solved[:, width], cross_flat


def _dense_normals(
    jacobian: Floats, residual: Floats, weight: Floats, local: Ints, width: int
) -> tuple[Floats, Floats]:
    """Return the normal equations (width, width) and right side of observations with local columns."""
    if len(local) * width < _SMALL:
        dense = np.zeros((len(local), 2, width + 1))
        each = np.arange(len(local))[:, None, None], np.arange(2)[None, :, None]
        dense[(*each, local[:, None, :])] = jacobian
        dense *= np.sqrt(weight)[:, None, None]
        flat = dense.reshape(-1, width + 1)[:, :width]
        return flat.T @ flat, -(flat.T @ (residual * np.sqrt(weight)[:, None]).ravel())
    rows = np.repeat(np.arange(2 * len(local)), local.shape[1])
    columns = np.repeat(local, 2, axis=0).ravel()
    root = np.sqrt(weight)[:, None]
    matrix = sparse.csr_matrix(
        ((jacobian * root[:, :, None]).ravel(), (rows, columns)), shape=(2 * len(local), width + 1)
    )[:, :width]
    return (matrix.T @ matrix).toarray(), -np.asarray(matrix.T @ (residual * root).ravel())


class _System:
    """Normal equations of objects and constants, gathered from blocks; dense while small."""

    def __init__(self, columns: int, things: int) -> None:
        self.columns, self.things = columns, things
        self.is_dense = columns <= _DENSE_LIMIT
        self.matrix = np.zeros((columns, columns)) if self.is_dense else None
        self.entries: list[tuple[Floats, Ints, Ints]] = []
        self.right = np.zeros(columns)

    def add_diagonal(self, columns: Ints, values: Floats, right: Floats) -> None:
        if self.matrix is not None:
            self.matrix[columns, columns] += values
        else:
            self.entries.append((values, columns, columns))
        self.right[columns] += right

    def add_block(self, columns: Ints, block: Floats, right: Floats) -> None:
        if self.matrix is not None:
            self.matrix[np.ix_(columns, columns)] += block
        else:
            i, j = np.nonzero(block)
            self.entries.append((block[i, j], columns[i], columns[j]))
        self.right[columns] += right

    def solve(self, first: int) -> tuple[Floats, Floats]:
        """Return the solution and the covariance of the columns from `first` on."""
        if self.matrix is not None:
            factor = cho_factor(self.matrix, lower=True, overwrite_a=True, check_finite=False)
            unit = np.eye(self.columns)[:, first:]
            return cho_solve(factor, self.right), cho_solve(factor, unit)[first:]
        values, rows, columns = (np.concatenate(part) for part in zip(*self.entries, strict=True))
        shape = (self.columns, self.columns)
        sparse_factor = splu(sparse.csc_matrix((values, (rows, columns)), shape=shape))
        covariance = np.empty((self.columns - first, self.columns - first))
        for column in range(first, self.columns):
            unit = np.zeros(self.columns)
            unit[column] = 1.0
            covariance[:, column - first] = sparse_factor.solve(unit)[first:]
        return np.asarray(sparse_factor.solve(self.right)), covariance


def adjust(problem: Adjustment, state: State, *, tolerances: tuple[float, ...], with_variance: bool = False) -> State:
    """Take one step for each of the tolerances, from wide to narrow."""
    for number, tolerance in enumerate(tolerances):
        state = problem.step(state, tolerance, with_variance=with_variance and number == len(tolerances) - 1)
    return state


def triangulate(seen: Observations, state: State, things: int, *, rounds: int = 8, tolerance: float = 1.0) -> State:
    """Return the state with the objects placed anew and all else as it is."""
    for _ in range(rounds):
        residual, depth, by_point, _, _, _ = _jacobians(seen, state)
        weight = weights(seen, residual, depth, tolerance)
        hessian = np.zeros((things, 3, 3))
        right = np.zeros((things, 3))
        weighted = by_point * weight[:, None, None]
        np.add.at(hessian, seen.thing, np.einsum("nki,nkj->nij", weighted, by_point))
        np.add.at(right, seen.thing, -np.einsum("nki,nk->ni", weighted, residual))
        hessian += 1e-6 * np.eye(3)
        step = np.linalg.solve(hessian, right[:, :, None])[:, :, 0]
        state = replace(state, point_in_world_m=state.point_in_world_m + np.clip(step, -5.0, 5.0))
    return state
