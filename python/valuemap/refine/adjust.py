"""Joint least squares over objects and the errors of drives: a bundle adjustment whose poses have few parameters.

The residuals are those of `residuals.py`. Drift is an Ornstein-Uhlenbeck process over nodes along the drive. It couples
neighbouring nodes only: each drive's nodes are eliminated by a banded Cholesky factor L; what is left are the objects
and the constants, whose normal equations lose Y^T Y with L Y = C, where C are the products with the nodes. Steps are
those of Gauss-Newton with Cauchy's weights, until the next one would hardly lower the cost.

What an image is off by itself moves all that it shows, so that its detections are not independent of each other. It is
eliminated before the nodes, image by image, in the same way.

Where things stand in the equations depends on who sees what alone: it is found once for all steps. In each step the
products of the derivatives of an observation are added up over those of one node and object before anything else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy

from valuemap.arrays import Bools, Floats, Ints
from valuemap.refine.jumps import Links
from valuemap.refine.residuals import (
    OFFSET,
    Observations,
    State,
    cauchy,
    linearised,
    poses_of,
    weights,
)

_DENSE_LIMIT = 3000
_AT_ONCE = 32
"""Objects, of all groups together, of which covariances are solved for at once: 96 columns take 46 MB where 20,000
objects are adjusted, and what they are solved to as much."""
_DAMPING = 1e-6
"""Added to the information of objects, so that one that nothing tells stays."""
_LONGEST_STEP_M = 20.0
"""A step moves an object by at most this."""
_SETTLED = 0.1
"""Steps end where one lowers the cost, in units of chi-squared, by less than this."""
_POINT, _TURN, _DELAY_AT, _FOCAL_AT, _NODE_TURN, _RESIDUAL, _BASIS = 0, 3, 6, 7, 8, 11, 12
"""Columns of what residuals are differentiated by, and of the residual."""


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
class SameObjects:
    """What of the objects are the same (N): object `first` is where `second` is, but for `sigma`, each axis.

    `total` is what they may be apart by with poses as they are a priori.
    """

    first: Ints
    second: Ints
    sigma: float
    total: float

    @classmethod
    def none(cls) -> SameObjects:
        """Return that none are the same."""
        return cls(np.empty(0, np.int64), np.empty(0, np.int64), 1.0, 1.0)


class Groups:
    """Rows that share a code, to add up over each: `row` are those of the codes (M) in ascending order of the codes."""

    def __init__(self, *codes: Ints) -> None:
        order = np.lexsort(codes[::-1])
        in_order = [code[order] for code in codes]
        starts = np.ones(len(order), np.bool_)
        starts[1:] = np.any([np.diff(code) != 0 for code in in_order], axis=0)
        begins = np.flatnonzero(starts)
        self.row = order[begins]
        pointers = np.append(begins, len(order))
        self.members = scipy.sparse.csr_array((np.ones(len(order)), order, pointers), shape=(len(begins), len(order)))

    def sum(self, values: Floats) -> Floats:
        """Return the sums (M, ...) of values (N, ...)."""
        flat = values.reshape(len(values), -1)
        return np.asarray(self.members @ flat).reshape(-1, *values.shape[1:])

    @cached_property
    def _by_size(self) -> list[tuple[Ints, Ints]]:
        """The groups of each size, and their members (groups, size)."""
        starts, sizes = self.members.indptr[:-1].astype(np.int64), np.diff(self.members.indptr)
        groups = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
        order = self.members.indices.astype(np.int64)
        return [(of, order[starts[of][:, None] + np.arange(sizes[of[0]])]) for of in groups]

    def products(self, rows: Floats) -> Floats:
        """Return the sums (M, width, width) of A^T A of matrices A (N, height, width), without making those of each."""
        _, height, width = rows.shape
        sums = np.empty((len(self.row), width, width))
        for groups, members in self._by_size:
            stacked = rows[members].reshape(len(groups), members.shape[1] * height, width)
            sums[groups] = stacked.transpose(0, 2, 1) @ stacked
        return sums


def _selection() -> tuple[Floats, Floats]:
    """Return what takes the derivatives (12) to those by drift (6), and to those by constants (12)."""
    drift, constant = np.zeros((_BASIS, 6)), np.zeros((_BASIS, 12))
    for axis in range(3):
        drift[_POINT + axis, axis] = constant[_POINT + axis, axis] = -1.0
        drift[_NODE_TURN + axis, 3 + axis] = 1.0
        constant[_TURN + axis, 3 + axis] = constant[_TURN + axis, 8 + axis] = 1.0
    constant[_DELAY_AT, 6] = constant[_DELAY_AT, 11] = constant[_FOCAL_AT, 7] = 1.0
    return drift, constant


_TO_DRIFT, _TO_CONSTANTS = _selection()


@dataclass(frozen=True, eq=False)
class _DrivesAlike:
    """Drives that see about as many objects, whose nodes are eliminated together.

    `nodes` (n) are theirs, one drive after the other. Entry `at` of the products with the nodes, stored column after
    column, is the sum of those products of observations and constants that are `of_things` or `of_constants` (rows of
    the sums, which of the 18 and 72 products). `parts` are the places of each drive's nodes and its columns in the
    normal equations.
    """

    nodes: Ints
    width: int
    at_things: Ints
    rows_of_things: Ints
    at_constants: Ints
    rows_of_constants: Ints
    parts: list[tuple[slice, Ints]]


class Adjustment:
    """The normal equations of observations; `active` (by kind: count, width) says which constants are free."""

    def __init__(
        self,
        seen: Observations,
        chain: Chain,
        scales: Scales,
        active: tuple[Bools, ...],
        things: int,
        links: Links,
        ties: SameObjects | None = None,
    ) -> None:
        self.links, self.ties = links, ties or SameObjects.none()
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
        views = seen.views
        of = (views.segment, views.vehicle, views.vehicle, views.camera, views.camera, views.camera)
        of_view = np.concatenate([c[rows] for c, rows in zip(self.column_of, of, strict=True)], axis=1)
        unknowns, part_of_view = np.unique(
            np.stack([views.segment, views.vehicle, views.camera]), axis=1, return_inverse=True
        )
        part = part_of_view.ravel()[seen.image]
        self.constants_of_part = np.zeros((unknowns.shape[1], 12), np.int64)
        self.constants_of_part[part_of_view.ravel()] = of_view
        # The finest sums, and those that are made of them.
        node = seen.node
        self.finest = Groups(node, seen.thing, part)
        self.node, self.thing, self.part = (code[self.finest.row] for code in (node, seen.thing, part))
        self.by_node_and_part = Groups(self.node, self.part)
        both = self.by_node_and_part.row
        self.by_node, self.by_part = Groups(self.node[both]), Groups(self.part[both])
        self.by_thing = Groups(self.thing)
        self.by_thing_and_part = Groups(self.thing, self.part)
        self.by_image = Groups(seen.image)
        self.image = seen.image[self.by_image.row]
        self.image_row = np.searchsorted(self.image, seen.image)
        # An image is of one node and one part: as sorted, these are the groups of `by_node_and_part`.
        self.images_by_node_and_part = Groups(seen.node[self.by_image.row], part[self.by_image.row])
        self.drives = list(self._together())

    def _together(self) -> Iterator[_DrivesAlike]:
        """Yield the drives by how many columns they have: powers of two, so that few of them are empty."""
        drive = self.chain.drive[self.node]
        both, of_part = self.by_node_and_part.row, self.constants_of_part[self.part[self.by_node_and_part.row]]
        # Columns of each drive, in order: those of objects first.
        keys = [drive[:, None] * self.columns + 3 * self.thing[:, None] + np.arange(3)]
        keys.append(np.where(of_part >= 0, drive[both][:, None] * self.columns + of_part, -1))
        kinds, place = np.unique(np.concatenate([key.ravel() for key in keys]), return_inverse=True)
        column_of_kind, drive_of_kind = kinds % self.columns, kinds // self.columns
        starts = np.searchsorted(kinds, np.arange(int(self.chain.drive[-1]) + 2) * self.columns)
        local = place.ravel() - starts[np.maximum(drive_of_kind, 0)][place.ravel()]
        of_things, of_constants = np.split(local, [keys[0].size])
        of_things, of_constants = of_things.reshape(-1, 3), of_constants.reshape(-1, 12)
        is_fixed = of_part < 0
        widths = np.diff(starts)
        size = np.ceil(np.log2(np.maximum(widths, 1))).astype(np.int64)
        for power in np.unique(size[widths > 0]).tolist():
            members = np.flatnonzero((size == power) & (widths > 0))
            width = int(widths[members].max())
            nodes = np.flatnonzero(np.isin(self.chain.drive, members))
            row_of_node = np.full(len(self.chain.drive), -1)
            row_of_node[nodes] = np.arange(len(nodes))
            height = 6 * len(nodes)
            rows = np.flatnonzero(np.isin(drive, members))
            six = np.arange(6)[None, :, None]
            at_things = of_things[rows][:, None, :] * height + 6 * row_of_node[self.node[rows]][:, None, None] + six
            pairs = np.flatnonzero(np.isin(drive[both], members))
            column = np.where(is_fixed[pairs], width, of_constants[pairs])
            at_constants = column[:, None, :] * height + 6 * row_of_node[self.node[both[pairs]]][:, None, None] + six
            bounds = np.searchsorted(self.chain.drive[nodes], [members, members + 1])
            yield _DrivesAlike(
                nodes=nodes,
                width=width,
                at_things=at_things.ravel(),
                rows_of_things=rows,
                at_constants=at_constants.ravel(),
                rows_of_constants=pairs,
                parts=[
                    (slice(6 * int(first), 6 * int(last)), column_of_kind[starts[member] : starts[member + 1]])
                    for member, first, last in zip(members.tolist(), *bounds, strict=True)
                ],
            )

    def step(
        self, state: State, tolerance: float, *, with_variance: bool = False, of_groups: Ints | None = None
    ) -> tuple[State, float]:
        """Return the state after one step of Gauss-Newton with weights of this tolerance, and what it gains.

        The gain is that of chi-squared if the residuals were linear and the weights stayed. The covariance is that of
        the constants, or those (G, 3 M, 3 M) of groups (G, M) of objects.
        """
        rows, own = self._weighted(state, tolerance)
        products, of_image = self.finest.products(rows), self._shared_by_image(rows, own)
        # What all detections of an image have in common is taken from what they say of the image's node and part, ...
        both = self.by_node_and_part.sum(products)
        both -= self.images_by_node_and_part.sum(of_image.whole.transpose(0, 2, 1) @ of_image.whole)
        parts, node_products = self.by_part.sum(both), self.by_node.sum(both)
        # ... of each object together with these, ...
        beside_thing = products[:, :, :3] - self.finest.sum(
            of_image.whole[self.image_row].transpose(0, 2, 1) @ of_image.of_thing
        )
        things = self.by_thing.sum(beside_thing)
        system = _System(self.columns, self.things)
        thing = self.thing[self.by_thing.row]
        of_thing = 3 * thing[:, None] + np.arange(3)
        of_part = self.constants_of_part[self.part[self.by_node_and_part.row[self.by_part.row]]]
        system.add(of_thing, of_thing, self.by_thing.sum(products[:, :3, :3]), -things[:, _RESIDUAL])
        # ... and of objects that it shows together.
        system.take_sparse(self._between_things(of_image.of_thing))
        of_constants = _TO_CONSTANTS.T @ parts
        system.add(of_part, of_part, of_constants @ _TO_CONSTANTS, -of_constants[:, :, _RESIDUAL])
        pairs = self.by_thing_and_part
        beside = _TO_CONSTANTS.T @ pairs.sum(beside_thing)
        system.add_beside(self.constants_of_part[self.part[pairs.row]], 3 * self.thing[pairs.row], beside)
        system.add_diagonal(np.arange(3 * self.things), np.full(3 * self.things, _DAMPING))
        for kind, index in enumerate(self.column_of):
            free = self.active[kind]
            sigma = np.broadcast_to(np.asarray(self.scales.constant[kind], np.float64), free.shape)[free]
            system.add_diagonal(index[free], sigma**-2, -(sigma**-2) * state.constants[kind][free])
        self._link(system, state.constants[OFFSET])
        self._tie(system, state.point_in_world_m, tolerance)
        nodes = np.zeros((len(self.chain.drive), _BASIS, _BASIS))
        nodes[self.node[self.by_node_and_part.row[self.by_node.row]]] = node_products
        sums = (_TO_DRIFT.T @ beside_thing, _TO_DRIFT.T @ both @ _TO_CONSTANTS, _TO_DRIFT.T @ nodes)
        eliminated = [self._eliminate(drives, sums, state.drift, system) for drives in self.drives]
        step, covariance = system.solve(3 * self.things if with_variance else None, of_groups)
        gain = float(system.right @ step)
        drift = state.drift.copy()
        for drives, (factor, solved) in zip(self.drives, eliminated, strict=True):
            moved, more = _drift_by(step, drives, factor, solved)
            drift[drives.nodes] += moved
            gain += more
        points = state.point_in_world_m + np.clip(
            step[: 3 * self.things].reshape(-1, 3), -_LONGEST_STEP_M, _LONGEST_STEP_M
        )
        after = State(points, drift, state.own, self._constants_by(step, state), covariance)
        return replace(after, own=self._own_errors(after, tolerance)), gain

    def _constants_by(self, step: Floats, state: State) -> tuple[Floats, ...]:
        """Return the constants, kind by kind, after a step of all that was not eliminated."""
        constants = []
        for kind, index in enumerate(self.column_of):
            free = self.active[kind]
            values = np.where(free, state.constants[kind], 0.0)
            values[free] += step[index[free]]
            constants.append(values)
        return tuple(constants)

    def _link(self, system: _System, offset: Floats) -> None:
        """Add what trajectories say of the offsets (L, 3) of segments."""
        columns = self.links.columns(self.column_of[OFFSET])
        left = offset[self.links.second, :2] - offset[self.links.first, :2] - self.links.apart_m
        pull = np.einsum("nij,nj->ni", self.links.information, left)
        system.add(columns, columns, self.links.blocks(), np.concatenate([pull, -pull], axis=1))

    def _tie(self, system: _System, point: Floats, tolerance: float) -> None:
        """Add what is known of objects that are the same, with weights as those of observations."""
        apart = point[self.ties.first] - point[self.ties.second]
        square = np.sum(apart**2, axis=1) / self.ties.total**2
        information = cauchy(square, tolerance)[:, None] / self.ties.sigma**2
        columns = 3 * np.stack([self.ties.first, self.ties.second], axis=1)[:, :, None] + np.arange(3)
        columns = columns.reshape(-1, 6)
        block = np.kron([[1.0, -1.0], [-1.0, 1.0]], np.eye(3))
        pull = information * apart
        system.add(columns, columns, information[:, :, None] * block, np.concatenate([-pull, pull], axis=1))

    def _weighted(self, state: State, tolerance: float) -> tuple[Floats, Floats]:
        """Return derivatives with residuals (N, 2, 12), and those by the image's own error (N, 2, 6), both weighted."""
        at = linearised(self.seen, state)
        weight = weights(self.seen, at.residual_px, at.depth_m, tolerance)
        weight = weight * self.seen.sigma_px**2 / self.seen.detection_sigma_px**2
        basis = np.empty((len(self.seen), 2, _BASIS))
        basis[:, :, _POINT:_TURN], basis[:, :, _TURN:_DELAY_AT] = at.by_point, at.by_turn
        basis[:, :, _DELAY_AT], basis[:, :, _FOCAL_AT] = at.by_delay, at.by_focal
        basis[:, :, _NODE_TURN:_RESIDUAL] = at.by_turn @ self.seen.views.cam_from_node[self.seen.image]
        basis[:, :, _RESIDUAL] = at.residual_px
        basis[weight == 0.0] = 0.0  # What is behind its camera may be infinite.
        basis *= np.sqrt(weight)[:, None, None]
        return basis, np.concatenate([-basis[:, :, _POINT:_TURN], basis[:, :, _TURN:_DELAY_AT]], axis=2)

    def _shared_by_image(self, rows: Floats, own: Floats) -> _OfImages:
        """Return what takes images' own errors out of the products of weighted derivatives (N, 2, 12)."""
        information = self.by_image.products(own) + self._own_precision()
        to_own = np.linalg.inv(np.linalg.cholesky(information))[self.image_row] @ own.transpose(0, 2, 1)
        of_rows = to_own @ rows
        return _OfImages(self.by_image.sum(of_rows), of_rows[:, :, :3])

    def _between_things(self, of_thing: Floats) -> scipy.sparse.coo_array:
        """Return what products of pairs of objects (3 K, 3 K) lose, by what they share (N, 6, 3) with images."""
        row = 6 * self.image_row[:, None, None] + np.arange(6)[:, None]
        column = 3 * self.seen.thing[:, None, None] + np.arange(3)
        at = [np.broadcast_to(index, of_thing.shape).ravel() for index in (row, column)]
        shared = scipy.sparse.csr_array(
            (of_thing.ravel(), (at[0], at[1])), shape=(6 * len(self.image), 3 * self.things)
        )
        return scipy.sparse.coo_array(shared.T @ shared)

    def _own_precision(self) -> Floats:
        """Return the information (6, 6) that is thought to be had of an image's own error."""
        return np.diag(np.repeat([self.scales.own_m**-2, self.scales.own_rad**-2], 3))

    def _eliminate(
        self, drives: _DrivesAlike, sums: tuple[Floats, Floats, Floats], drift: Floats, system: _System
    ) -> tuple[Floats, Floats]:
        """Take the nodes of drives out of the system; return their factor L (12, 6n) and Y (6n, width + 1).

        `sums` are the products of the derivatives by drift with those by objects (P, 6, 3), by constants (Q, 6, 12),
        and with all of each node (n, 6, 12). The last column of Y is that of the right side.
        """
        of_things, of_constants, of_nodes = sums
        count = len(drives.nodes)
        blocks, gradient, beside = self._chain_of(drives, drift)
        blocks += of_nodes[drives.nodes] @ _TO_DRIFT
        gradient -= of_nodes[drives.nodes, :, _RESIDUAL]
        cross = np.zeros((drives.width + 1) * 6 * count)
        np.add.at(cross, drives.at_things, of_things[drives.rows_of_things].ravel())
        np.add.at(cross, drives.at_constants, of_constants[drives.rows_of_constants].ravel())
        right = cross.reshape(drives.width + 1, 6 * count).T
        right[:, -1] = gradient.ravel()
        factor, failed = scipy.linalg.lapack.dpbtrf(banded(blocks, beside), lower=1, overwrite_ab=1)
        if failed:
            raise np.linalg.LinAlgError("the information of drift is not positive definite")
        solved, _ = scipy.linalg.lapack.dtbtrs(factor, right, uplo=b"L", overwrite_b=1)
        for rows, columns in drives.parts:
            own = solved[rows, : len(columns)]
            system.take_block(columns, own.T @ own, own.T @ solved[rows, -1])
        return factor, solved

    def _chain_of(self, drives: _DrivesAlike, drift: Floats) -> tuple[Floats, Floats, Floats]:
        """Return what the process says of nodes: blocks (n, 6, 6), right side (n, 6), and of neighbours (n - 1, 6)."""
        diagonal, beside = process(self.chain.keep[drives.nodes], self.scales)
        of_nodes = drift[drives.nodes]
        pull = diagonal * of_nodes
        pull[1:] += beside * of_nodes[:-1]
        pull[:-1] += beside * of_nodes[1:]
        return diagonal[:, :, None] * np.eye(6), -pull, beside

    def _own_errors(self, state: State, tolerance: float) -> Floats:
        """Return what each image (I, 6) is probably off by itself, given all else."""
        rows, by_own = self._weighted(state, tolerance)
        products = self.by_image.products(np.concatenate([by_own, rows[:, :, _RESIDUAL:]], axis=2))
        own = np.zeros_like(state.own)
        information = products[:, :6, :6] + self._own_precision()
        own[self.image] = -np.linalg.solve(information, products[:, :6, 6:])[:, :, 0]
        return own


def _drift_by(step: Floats, drives: _DrivesAlike, factor: Floats, solved: Floats) -> tuple[Floats, float]:
    """Return how the nodes of eliminated drives (n, 6) move where all else makes a step, and what that gains."""
    left = solved[:, -1].copy()
    gain = float(left @ left)
    for place, columns in drives.parts:
        left[place] -= solved[place, : len(columns)] @ step[columns]
    moved, _ = scipy.linalg.lapack.dtbtrs(factor, left[:, None], uplo=b"L", trans=b"T")
    return np.asarray(moved.reshape(-1, 6)), gain


@dataclass(frozen=True, eq=False)
class _OfImages:
    """With L L^T the information of an image's own error and B the derivatives by it, L^-1 B^T times those by others.

    `whole` (images, 6, 12) are the sums over an image, `of_thing` (N, 6, 3) those by the object of each detection.
    """

    whole: Floats
    of_thing: Floats


class _System:
    """Normal equations of objects and constants, gathered from blocks; dense while small.

    Of the dense matrix only the lower half is right: constants come after objects.
    """

    def __init__(self, columns: int, things: int) -> None:
        self.columns, self.things = columns, things
        # What is not free is added to one more row and column.
        self.matrix = np.zeros((columns + 1, columns + 1)) if columns <= _DENSE_LIMIT else None
        self.entries: list[tuple[Floats, Ints, Ints]] = []
        self._right = np.zeros(columns + 1)

    @property
    def right(self) -> Floats:
        """The right side."""
        return self._right[: self.columns]

    def add(self, rows: Ints, columns: Ints, blocks: Floats, right: Floats) -> None:
        """Add blocks (B, n, m) at rows (B, n) and columns (B, m), and what belongs to their rows on the right."""
        self._add(rows[:, :, None], columns[:, None, :], blocks)
        np.add.at(self._right, rows.ravel(), right.ravel())

    def add_beside(self, rows: Ints, first_column: Ints, blocks: Floats) -> None:
        """Add blocks (B, n, 3) at rows (B, n) of constants and the columns of objects, and their mirror images."""
        columns = first_column[:, None] + np.arange(3)
        self._add(rows[:, :, None], columns[:, None, :], blocks)
        if self.matrix is None:
            self._add(columns[:, :, None], rows[:, None, :], blocks.transpose(0, 2, 1))

    def add_diagonal(self, columns: Ints, values: Floats, right: Floats | None = None) -> None:
        """Add to the diagonal, and on the right."""
        self._add(columns, columns, values)
        if right is not None:
            self._right[columns] += right

    def take_block(self, columns: Ints, block: Floats, right: Floats) -> None:
        """Take a block (n, n) away, and a right side (n)."""
        if self.matrix is not None:
            self.matrix[np.ix_(columns, columns)] -= block
        else:
            self._add(columns[:, None], columns[None, :], -block)
        self._right[columns] -= right

    def take_sparse(self, block: scipy.sparse.coo_array) -> None:
        """Take a block away that begins at the first row and column."""
        self._add(block.row.astype(np.int64), block.col.astype(np.int64), -block.data)

    def _add(self, rows: Ints, columns: Ints, values: Floats) -> None:
        if self.matrix is not None:
            size = self.columns + 1
            at = np.broadcast_to((rows % size) * size + columns % size, values.shape)
            np.add.at(self.matrix.reshape(-1), at.ravel(), np.ascontiguousarray(values).ravel())
            return
        used = np.broadcast_to((rows >= 0) & (columns >= 0), values.shape)
        rows, columns = np.broadcast_to(rows, values.shape)[used], np.broadcast_to(columns, values.shape)[used]
        self.entries.append((values[used], rows, columns))

    def solve(self, first: int | None, of_groups: Ints | None = None) -> tuple[Floats, Floats | None]:
        """Return the solution, and the covariance of the columns from `first` on, or those of groups of objects."""
        if self.matrix is not None:
            factor = scipy.linalg.cho_factor(self.matrix[:-1, :-1], lower=True, overwrite_a=True, check_finite=False)
            solution = scipy.linalg.cho_solve(factor, self.right, check_finite=False)
            if of_groups is not None:
                solved = partial(scipy.linalg.cho_solve, factor, check_finite=False)
                return solution, self._blocks(solved, of_groups)
            if first is None:
                return solution, None
            # The factor of what is left once the objects are eliminated is its lower right corner.
            corner = factor[0][first:, first:]
            return solution, scipy.linalg.cho_solve((corner, True), np.eye(len(corner)), check_finite=False)
        values, rows, columns = (np.concatenate(part) for part in zip(*self.entries, strict=True))
        sparse_factor = scipy.sparse.linalg.splu(
            scipy.sparse.csc_matrix((values, (rows, columns)), shape=(self.columns, self.columns))
        )
        solution = np.asarray(sparse_factor.solve(self.right))
        if of_groups is not None:
            return solution, self._blocks(sparse_factor.solve, of_groups)
        if first is None:
            return solution, None
        covariance = np.empty((self.columns - first, self.columns - first))
        for column in range(first, self.columns):
            unit = np.zeros(self.columns)
            unit[column] = 1.0
            covariance[:, column - first] = sparse_factor.solve(unit)[first:]
        return solution, covariance

    def _blocks(self, solved: Callable[[Floats], Floats], groups: Ints) -> Floats:
        """Return the covariances of groups of objects, few at a time: that of all is as large as they are squared."""
        columns = (3 * groups[:, :, None] + np.arange(3)).reshape(len(groups), -1)
        blocks = np.empty((*columns.shape, columns.shape[1]))
        at_once = max(1, _AT_ONCE // groups.shape[1])
        for first in range(0, len(groups), at_once):
            some = columns[first : first + at_once]
            units = np.zeros((self.columns, some.size))
            units[some.ravel(), np.arange(some.size)] = 1.0
            covariance = solved(units)[some.ravel()].reshape(*some.shape, *some.shape)
            number = np.arange(len(some))
            blocks[first : first + at_once] = covariance[number, :, number, :]
        return blocks


def adjust(problem: Adjustment, state: State, *, tolerances: tuple[float, ...], with_variance: bool = False) -> State:
    """Take a step for each of the tolerances, from wide to narrow, and no more with the last one than it takes."""
    for tolerance in tolerances:
        state, gain = problem.step(state, tolerance, with_variance=with_variance)
        if tolerance == tolerances[-1] and gain < _SETTLED:
            break
    return state


def process(keep: Floats, scales: Scales) -> tuple[Floats, Floats]:
    """Return the information that the process of drift has of nodes (n, 6), and of neighbours (n - 1, 6)."""
    fresh = 1.0 / (1.0 - keep**2 + 1e-9)
    # Each node from the one before it.
    diagonal = fresh.copy()
    diagonal[:-1] += (keep**2 * fresh)[1:]
    precision = np.repeat([scales.drift_m**-2, scales.drift_rad**-2], 3)
    return np.outer(diagonal, precision), -np.outer((keep * fresh)[1:], precision)


def banded(blocks: Floats, beside: Floats) -> Floats:
    """Return nodes' blocks (n, 6, 6) and diagonal ones beside these (n - 1, 6) as LAPACK's lower band (12, 6 n)."""
    band = np.zeros((12, 6 * len(blocks)), order="F")
    band[6, : 6 * len(beside)] = beside.ravel()
    for i in range(6):
        for j in range(i + 1):
            band[i - j, j::6] = blocks[:, i, j]
    return band


def triangulate(seen: Observations, state: State, *, rounds: int = 8, tolerance: float = 1.0) -> State:
    """Return the state with the objects placed anew and all else as it is."""
    groups = Groups(seen.thing)
    thing = seen.thing[groups.row]
    poses = poses_of(seen, state)
    for _ in range(rounds):
        at = linearised(seen, state, poses)
        weight = weights(seen, at.residual_px, at.depth_m, tolerance)
        basis = np.concatenate([at.by_point, at.residual_px[:, :, None]], axis=2)
        basis[weight == 0.0] = 0.0
        basis *= np.sqrt(weight)[:, None, None]
        products = groups.products(basis)
        step = -np.linalg.solve(products[:, :3, :3] + 1e-6 * np.eye(3), products[:, :3, 3:])[:, :, 0]
        points = state.point_in_world_m.copy()
        points[thing] += np.clip(step, -5.0, 5.0)
        state = replace(state, point_in_world_m=points)
    return state
