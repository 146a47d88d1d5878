"""How drives lie to each other: constellations of what each sees alone, matched where residuals cannot lock in.

One drive after the other is laid onto what the drives before it saw. Along a drive the shift on the ground is a chain
of states on a grid: it stays, creeps to a cell beside it, or jumps at a price, and the likeliest chain is found exactly
(Viterbi 1967). Then every drive is laid anew onto all others. Matches are one to one: no drive sees an object twice in
one place.

That a landmark p shows one of the n objects x_j around it is told by the density of its place given the objects,
against that of a place where nobody has seen anything:

    L(g) = 1 - q + q V / n sum_j N(x_j - p - g; covariance of both)

so a landmark of unknown depth, or one among many objects, tells little of the shift g. A jump pays for being rare, and
for the place where it ends: of the many shifts that there are, one always fits two landmarks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from valuemap.arrays import Floats, Ints, runs
from valuemap.assignment import one_to_one
from valuemap.refine.landmarks import Landmarks

_REACH_M, _CELL_M = 6.0, 0.5
"""Shifts are sought on the ground up to this far, on a grid this fine."""
_AROUND_M = _REACH_M * math.sqrt(2.0) + 2.0
"""Objects this near may be what a landmark shows."""
_CELLS_A_SIDE = 2 * round(_REACH_M / _CELL_M) + 1
"""Cells of the grid of shifts, each way."""
_GRID_M = np.stack(
    np.meshgrid(*2 * [(np.arange(_CELLS_A_SIDE) - _CELLS_A_SIDE // 2) * _CELL_M], indexing="ij"), axis=-1
).reshape(-1, 2)
"""Shifts on the ground (G, 2)."""
_HEIGHT_M = 1.0
"""Deviation of what is left between heights, and how far the heights that are tried are apart."""
_MOST_HEIGHTS = 20
"""Heights that are tried, at most: those at which most pairs agree."""
_OTHER_DATUM = math.log(1000.0)
"""A drive's heights are above something else, by as much as may be, once in so many: minus the logarithm of that."""
_FINE_M = np.arange(-1.0, 1.05, 0.1)
"""Once it is known where a drive is on the ground, its height is told as finely as this, about the one it has."""
_JUMP, _NEW_SEGMENT, _CREEP = 5.0, 0.5, 2.0
"""Minus the logarithm of how likely a chain jumps where none is seen, where one is, and creeps to the next cell."""
_SHARED = 0.7
"""How likely a landmark shows what others have seen."""
_HIGH_M = 4.0
"""Objects are spread over so much height."""
_PRIOR_M = 3.0
"""Deviation of shifts, each axis, before landmarks say anything: of a drive where it begins, or where a jump ends."""
_SMOOTH_M = 0.35
"""What drives disagree by within a cell and a stretch, each axis."""
_GATE2 = 12.0
"""Squared distance in sigmas within which a landmark is an object; 0.993 of chi-squared with three degrees."""
_SAME_SIZE = 1.6
"""A landmark that is higher or lower than an object by more than this factor is another thing."""
_AT_ONCE = 2_000_000
"""Pairs and shifts that are looked at together: 48 MB."""
_ROUNDS = 2
"""Times that each drive is laid anew onto what all others see."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The shift (N, 3), m, that takes each landmark to the common frame, and its object (N), -1 for none."""

    shift_m: Floats
    object_of_landmark: Ints


def register(landmarks: Landmarks, covariance: Floats, evidence: Floats | None = None) -> Registration:
    """Lay the landmarks of all drives, with covariances (N, 3, 3) in m², onto each other; up is z.

    `evidence` (N) is how much the trajectory speaks, as in `Hints`, for a jump between the landmark and the one before
    it in its drive.
    """
    point = landmarks.point_in_world_m
    price = np.full(len(point), _JUMP) if evidence is None else np.maximum(_JUMP - 0.5 * evidence, _NEW_SEGMENT)
    along = np.argsort(landmarks.drive, kind="stable")
    by_drive = [
        rows[np.argsort(landmarks.driven_m[rows], kind="stable")]
        for rows in runs(along, landmarks.drive[along])
        if len(rows)
    ]
    shift = np.zeros_like(point)
    thing = np.full(len(point), -1)
    known = _Objects(landmarks, point, covariance, price)
    for drive in order_of_laying(point, by_drive):
        _lay(by_drive[drive], point, covariance, shift, thing, known)
    for _ in range(_ROUNDS):
        for rows in by_drive:
            known.forget(thing[rows], rows, shift)
            thing[rows] = -1
            _lay(rows, point, covariance, shift, thing, known)
    return Registration(shift, thing)


def order_of_laying(point: Floats, by_drive: list[Ints]) -> list[int]:
    """Return the drives, the one with most landmarks first, then always one that meets most of what is known."""
    if not by_drive:
        return []
    drive = np.empty(len(point), np.int64)
    for number, rows in enumerate(by_drive):
        drive[rows] = number
    near = drive[scipy.spatial.cKDTree(point).query_pairs(_REACH_M, output_type="ndarray")]
    met = np.zeros((len(by_drive), len(by_drive)), np.bool_)
    met[near[:, 0], near[:, 1]] = met[near[:, 1], near[:, 0]] = True
    np.fill_diagonal(met, val=False)
    seen = met * np.array([len(rows) for rows in by_drive])[:, None]
    left = set(range(len(by_drive)))
    first = max(left, key=lambda i: (len(by_drive[i]), -i))
    chosen = [first]
    left.discard(first)
    score = seen[:, first]
    while left:
        best = max(left, key=lambda i: (score[i], len(by_drive[i]), -i))
        chosen.append(best)
        left.discard(best)
        score = score + seen[:, best]
    return chosen


class _Objects:
    """Objects as sums of information of the landmarks that show them."""

    def __init__(self, landmarks: Landmarks, point: Floats, covariance: Floats, price: Floats) -> None:
        self.landmarks, self.point, self.price = landmarks, point, price
        self.weight = np.linalg.inv(covariance)
        self.information = np.zeros((0, 3, 3))
        self.vector = np.zeros((0, 3))
        self.class_code = np.zeros(0, np.int64)
        self.log_size = np.zeros(0)
        self.count = np.zeros(0, np.int64)

    def add(self, row: int, shift: Floats) -> int:
        """Make a new object of a landmark."""
        self.information = np.concatenate([self.information, np.zeros((1, 3, 3))])
        self.vector = np.concatenate([self.vector, np.zeros((1, 3))])
        self.class_code = np.append(self.class_code, self.landmarks.class_code[row])
        size = self.landmarks.size_m[row]
        self.log_size = np.append(self.log_size, math.log(size) if size > 0.0 else np.nan)
        self.count = np.append(self.count, 0)
        self.join(len(self.count) - 1, row, shift)
        return len(self.count) - 1

    def join(self, thing: int, row: int, shift: Floats) -> None:
        """Let a landmark support an object."""
        self.information[thing] += self.weight[row]
        self.vector[thing] += self.weight[row] @ (self.point[row] + shift)
        self.count[thing] += 1

    def forget(self, things: Ints, rows: Ints, shift: Floats) -> None:
        """Take the support of landmarks away again."""
        for thing, row in zip(things.tolist(), rows.tolist(), strict=True):
            self.information[thing] -= self.weight[row]
            self.vector[thing] -= self.weight[row] @ (self.point[row] + shift[row])
            self.count[thing] -= 1

    def alive(self) -> tuple[Ints, Floats, Floats]:
        """Return the objects that anything supports, their positions and covariances."""
        rows = np.flatnonzero(self.count > 0)
        covariance = np.linalg.inv(self.information[rows])
        return rows, np.asarray(np.einsum("nij,nj->ni", covariance, self.vector[rows])), np.asarray(covariance)


def _lay(rows: Ints, point: Floats, covariance: Floats, shift: Floats, thing: Ints, known: _Objects) -> None:
    """Find the shifts of one drive's landmarks, by the way driven, and what they show; both are written in place."""
    objects, place, spread = known.alive()
    near: list[list[int]]
    if len(objects):
        tree = scipy.spatial.cKDTree(place[:, :2])
        near = list(tree.query_ball_point(point[rows, :2], _AROUND_M, return_sorted=True))  # type: ignore[arg-type]
    else:
        near = [[] for _ in rows]
    pairs = _compatible(rows, near, objects, known)
    if pairs[0].size:
        mark, target = pairs
        seen = _Pairs(len(rows), mark, place[target] - point[rows[mark]], covariance[rows[mark]] + spread[target])
        height_m = _height(seen)
        price = np.where(np.diff(known.landmarks.segment[rows]) != 0, _NEW_SEGMENT, known.price[rows[1:]])
        shift[rows, :2] = _chain(seen.raised(height_m), price)
        shift[rows, 2] = height_m
        if height_m:
            shift[rows, 2] += _fine_height(seen.raised(height_m), shift[rows, :2])
    _match(rows, pairs, objects, point, covariance, place, spread, shift, thing, known)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs (K) of one of so many landmarks, `mark`, and an object that it may show.

    They are so far apart (K, 3), with covariances (K, 3, 3) of both, m².
    """

    landmarks: int
    mark: Ints
    apart_m: Floats
    total_m2: Floats

    def raised(self, height_m: float) -> _Pairs:
        """Return them with the landmarks moved up."""
        return replace(self, apart_m=self.apart_m - [0.0, 0.0, height_m])


def _height(seen: _Pairs) -> float:
    """Return by how much a drive is to be moved up, 0 unless another height explains more, wherever on the ground.

    Passes are off in height by more than on the ground where a receiver tells their place, and by tens of metres where
    their heights are above something else. Heights at which fewer pairs agree than at none are not tried.
    """
    apart_m = np.sort(seen.apart_m[:, 2])
    height_m = _HEIGHT_M * np.unique(np.append(np.round(apart_m / _HEIGHT_M), 0.0))
    below, above = (np.searchsorted(apart_m, height_m + side * _HEIGHT_M) for side in (-1.0, 1.0))
    agree = above - below
    order = np.argsort(-agree, kind="stable")[:_MOST_HEIGHTS]
    tried = height_m[order[agree[order] > agree[height_m == 0.0]]]
    if not len(tried):
        return 0.0

    def explained(height_m: float) -> float:
        return float(np.max(_prior() + _gain(seen.raised(height_m)).sum(axis=0)))

    price = math.log(len(height_m)) + np.minimum(tried**2 / (2.0 * _PRIOR_M**2), _OTHER_DATUM)
    value = np.array([explained(one) for one in tried]) - price
    best = int(np.argmax(value))
    return float(tried[best]) if value[best] > explained(0.0) else 0.0


def _fine_height(seen: _Pairs, shift_m: Floats) -> float:
    """Return by how much a drive is to be moved up further, with its landmarks moved on the ground (N, 2)."""
    total = seen.total_m2 + _SMOOTH_M**2 * np.eye(3)
    weight, height = np.linalg.inv(total), _density(seen, total)
    apart = seen.apart_m.copy()
    apart[:, :2] -= shift_m[seen.mark]

    def explained(height_m: float) -> float:
        left = apart - [0.0, 0.0, height_m]
        evidence = height * np.exp(-0.5 * np.einsum("ki,kij,kj->k", left, weight, left))
        return float(np.sum(np.log(1.0 - _SHARED + np.bincount(seen.mark, evidence, seen.landmarks))))

    return float(max(_FINE_M, key=explained))


def _compatible(rows: Ints, near: list[list[int]], objects: Ints, known: _Objects) -> tuple[Ints, Ints]:
    """Return pairs of landmark (place in `rows`) and object (place in `objects`) of one class and about one size."""
    first = np.repeat(np.arange(len(rows)), [len(found) for found in near])
    second = np.array([i for found in near for i in found], dtype=np.int64)
    if not len(second):
        return first, second
    marks = known.landmarks
    size = np.where(marks.size_m > 0.0, marks.size_m, np.nan)
    ratio = np.abs(np.log(size[rows[first]]) - known.log_size[objects[second]])
    fits = (marks.class_code[rows[first]] == known.class_code[objects[second]]) & ~(ratio > math.log(_SAME_SIZE))
    return first[fits], second[fits]


def _prior() -> Floats:
    """Return the logarithm of how likely each shift (G) is before landmarks say anything."""
    prior = -np.sum(_GRID_M**2, axis=1) / (2.0 * _PRIOR_M**2)
    return np.asarray(prior - math.log(float(np.exp(prior).sum())))


def _chain(seen: _Pairs, price: Floats) -> Floats:
    """Return the likeliest shifts (N, 2) of landmarks on the ground by the way driven: Viterbi over a grid."""
    gain, prior = _gain(seen), _prior()
    value = prior + gain[0]
    came_from = np.empty(gain.shape, np.int64)
    for i in range(1, len(gain)):
        best, source = _stayed_or_crept(value)
        top = int(np.argmax(value))
        jumped = value[top] - price[i - 1] + prior
        better = jumped > best
        best, came_from[i] = np.where(better, jumped, best), np.where(better, top, source)
        value = best + gain[i]
    state = np.empty(len(gain), np.int64)
    state[-1] = int(np.argmax(value))
    for i in range(len(gain) - 1, 0, -1):
        state[i - 1] = came_from[i, state[i]]
    return _GRID_M[state]


def _gain(seen: _Pairs) -> Floats:
    """Return the logarithm of L(g) of each landmark at each shift of the grid (landmarks, G)."""
    # What the grid does not move is the height: it is left free up to what passes for it.
    total = seen.total_m2 + np.diag([_SMOOTH_M**2, _SMOOTH_M**2, _HEIGHT_M**2])
    evidence = np.zeros((seen.landmarks, len(_GRID_M)))
    weight, height = np.linalg.inv(total), _density(seen, total)
    block = max(1, _AT_ONCE // len(_GRID_M))
    for start in range(0, len(seen.mark), block):
        part = slice(start, start + block)
        left = np.empty((len(weight[part]), len(_GRID_M), 3))
        left[:, :, :2] = seen.apart_m[part, None, :2] - _GRID_M
        left[:, :, 2] = seen.apart_m[part, None, 2]
        square = np.einsum("kgi,kij,kgj->kg", left, weight[part], left, optimize=True)
        np.add.at(evidence, seen.mark[part], height[part, None] * np.exp(-0.5 * square))
    return np.asarray(np.log(1.0 - _SHARED + evidence))


def _density(seen: _Pairs, total_m2: Floats) -> Floats:
    """Return q V / n over the norm of the densities of pairs (K), whose covariances are `total_m2`."""
    around = np.bincount(seen.mark, minlength=seen.landmarks)
    volume_m3 = math.pi * _AROUND_M**2 * _HIGH_M
    return np.asarray(_SHARED * volume_m3 / around[seen.mark] / np.sqrt(np.linalg.det(2.0 * np.pi * total_m2)))


_ALL, _NEXT, _LAST = slice(None), slice(1, None), slice(None, -1)
_BESIDE = (
    ((_NEXT, _ALL), (_LAST, _ALL)),
    ((_LAST, _ALL), (_NEXT, _ALL)),
    ((_ALL, _NEXT), (_ALL, _LAST)),
    ((_ALL, _LAST), (_ALL, _NEXT)),
)
"""Cells that have one beside them on each of four sides, and those beside them."""


def _stayed_or_crept(value: Floats) -> tuple[Floats, Ints]:
    """Return the best value of each cell if the chain stayed in it or crept to it, and the cell that it came from."""
    here = np.arange(len(value))
    best, source = value, here
    cells, index = value.reshape(_CELLS_A_SIDE, _CELLS_A_SIDE), here.reshape(_CELLS_A_SIDE, _CELLS_A_SIDE)
    for to, beside in _BESIDE:
        crept, of = np.full_like(cells, -np.inf), np.zeros_like(index)
        crept[to], of[to] = cells[beside] - _CREEP, index[beside]
        better = crept.ravel() > best
        best, source = np.where(better, crept.ravel(), best), np.where(better, of.ravel(), source)
    return best, source


def _match(
    rows: Ints,
    pairs: tuple[Ints, Ints],
    objects: Ints,
    point: Floats,
    covariance: Floats,
    place: Floats,
    spread: Floats,
    shift: Floats,
    thing: Ints,
    known: _Objects,
) -> None:
    """Give each landmark of a drive its object, one to one, or make it one of its own."""
    mark, target = pairs
    apart = place[target] - point[rows[mark]] - shift[rows[mark]]
    total = covariance[rows[mark]] + spread[target] + np.diag([_SMOOTH_M**2, _SMOOTH_M**2, _SMOOTH_M**2])
    square = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(total), apart)
    fits = square < _GATE2
    mark, target, square = mark[fits], target[fits], square[fits]
    for ours, theirs in zip(*one_to_one(mark, target, square, _GATE2), strict=True):
        row = int(rows[ours])
        thing[row] = objects[theirs]
        known.join(int(thing[row]), row, shift[row])
    for row in rows[thing[rows] < 0].tolist():
        thing[row] = known.add(row, shift[row])
