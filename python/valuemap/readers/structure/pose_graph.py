"""All pictures at once from their pairs: rotations, then the lengths of ways, then positions.

Nothing grows from a first pair, so nothing bends: every pair has its say, and those that contradict the others lose it
(L1 norm, then Cauchy's loss; each step is one sparse linear system). Pictures that follow each other show one place;
others that are near may show two houses alike, and count only where the way around does not contradict. How long the
way of one pair is beside that of another, what both see says: a feature of a picture has one depth, by whichever pair
it is measured. The GPS gives the scale of what hangs together so, its place, and where north is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from valuemap.arrays import Bools, Floats, Ints
from valuemap.readers.structure.onto_earth import similarity_onto
from valuemap.readers.structure.two_views import Pair, Way, find_way

LEAST_IMAGES = 3
"""Pictures with a GPS position, which a turn, a scale and a place need."""
_L1_ROUNDS, _CAUCHY_ROUNDS = 10, 10
"""Of reweighting: of both losses the last ones change nothing that shows."""
_CAUCHY = 2.5
"""Sigmas at which Cauchy's loss halves a weight: of normal errors 2.385 loses 5 % of what they say."""
_ROTATION_SIGMA_RAD, _ENOUGH = 0.005, 100
"""Rotations of pairs with so many matches are right to 0.3 degrees; of more they are not better, as what bends them
(the focal length, the lens) is in all matches."""
_LARGEST_TURN_RAD = 0.05
"""Pairs that are so far off the rotations of all others are not of one place."""
_FOLLOWING = 12
"""Pictures of a drive that follow each other by so many at most are of one place."""
_OTHER_PLACE_RAD = 0.35
"""A round of four corners turns so much too far, 20 degrees, where a focal length is five per cent wrong: EXIF knows it
to a millimetre. Houses alike in another street turn a picture by 90 or 180 degrees."""
_LEAST_PARALLAX_RAD = 0.01
"""Below it, 5 px at a focal length of 500 px, matches that are right to a pixel say nothing about a depth."""
_LEAST_SHARED = 8
"""Features whose depths two pairs share, for these to say how long the ways of both are: a median of fewer is one
wrong match away from being wrong."""
_LENGTH_SHARE, _STILL_M = 0.1, 0.02
"""Standard deviations of a way: a share of its length, and metres of a car that stands."""
_ONE_TURN_RAD = 0.035
"""What two pairs allow is the same rotation up to here: 2 degrees. Right ones differ by 0.2 to 0.7 degrees, wrong ones
of a plane by 8 and more (docs/notes/structure_from_motion.md)."""
_MOST_RIVALS, _MOST_DEPTHS, _MOST_STATES = 4, 8, 8
"""Rotations of a picture, looks at its depths, and ways to go on that are kept: time grows with each."""
_RIVAL = 0.3
"""A rotation that fewer than this share of the best one's matches allow is no rival: the true one of a plane has
nine tenths of the matches of the wrong one, and those of single wrong pairs a tenth."""
_SAME_DEPTH = 0.02
"""Standard deviation of the logarithm of a depth that is one: two per cent, beside what a pixel makes of it."""
_CLEAR = 300.0
"""So many matches must agree more with one way to go on than with another, which then is given up: what three full
pairs (`_ENOUGH`) say, so that no one pair decides."""
_SAME_NORTH_RAD = 0.35
"""Parts whose GPS turns them by more than this, 20 degrees, against the largest are of a piece of their own, or too
short for their GPS to tell."""
_HEIGHT_SHARE = 2.0
"""Heights by GPS are so much worse than positions: satellites are above only."""
_RIDGE = 1e-9
"""Share of the usual weight that holds what nothing else holds, so that systems can be solved."""


@dataclass(frozen=True, eq=False)
class _Edges:
    """Differences (M, K) that are wanted of values at `two` from those at `one` (M), with their sigmas (M)."""

    one: Ints
    two: Ints
    wanted: Floats
    sigma: Floats

    def take(self, rows: Ints) -> _Edges:
        return _Edges(self.one[rows], self.two[rows], self.wanted[rows], self.sigma[rows])


def start_of(
    pairs: Sequence[Pair], drive: Ints, gps_in_world_m: Floats, sigma_m: Floats
) -> dict[int, tuple[Floats, Floats]]:
    """Return poses (cam_from_world, centre) by row, of pictures that hang together with three that have a GPS position.

    `drive` (count) numbers the drive of each, rows are in driving order; `gps_in_world_m` (count, 3) is NaN where there
    is none, `sigma_m` (count) its standard deviation.
    """
    count = len(drive)
    pairs = _of_one_place(pairs, drive)
    rotation = _rotations(pairs, count)
    off_rad = np.linalg.norm(_turns_off(pairs, rotation), axis=1)
    pairs = [pair for pair, off in zip(pairs, off_rad, strict=True) if off < _LARGEST_TURN_RAD]
    ways = [find_way(pair.ray[0] @ rotation[pair.first], pair.ray[1] @ rotation[pair.second]) for pair in pairs]
    edges, part = _edges(pairs, ways)
    group = _components(edges.one, edges.two, count)
    poses: dict[int, tuple[Floats, Floats]] = {}
    for each in np.unique(group[edges.one[part >= 0]]):
        mine = np.flatnonzero((group[edges.one] == each) & (part >= 0))
        for turn, metric in _onto_earth(edges.take(mine), part[mine], rotation, gps_in_world_m, sigma_m):
            rows = np.unique([metric.one, metric.two])
            place = np.zeros(count, dtype=np.int64)
            place[rows] = np.arange(len(rows))
            local = _Edges(place[metric.one], place[metric.two], metric.wanted, metric.sigma)
            gps_sigma = sigma_m[rows][:, None] * [1.0, 1.0, _HEIGHT_SHARE]
            center = _solve(local, len(rows), gps_in_world_m[rows], gps_sigma)
            # A picture of two pieces is of the larger, which comes first.
            poses = {row: (rotation[row] @ turn.T, center[i]) for i, row in enumerate(rows.tolist())} | poses
    return poses


def _of_one_place(pairs: Sequence[Pair], drive: Ints) -> list[Pair]:
    """Return pairs without those that turn otherwise than pictures on the way from one of the two to the other.

    How sure that way is, the pairs along it say: their variances add up as resistances do.
    """
    count = len(drive)
    place = np.zeros(count, dtype=np.int64)
    for each in np.unique(drive):
        place[drive == each] = np.arange((drive == each).sum())
    one, two, sigma = _between(pairs)
    follows: Bools = np.asarray((drive[one] == drive[two]) & (np.abs(place[two] - place[one]) <= _FOLLOWING))
    along = [pair for pair, is_along in zip(pairs, follows, strict=True) if is_along]
    if len(along) == len(pairs) or not along:
        return list(pairs)
    rotation = _rotations(along, count)
    agrees = follows.copy()
    off_rad = np.linalg.norm(_turns_off(pairs, rotation), axis=1)
    agrees[follows] = off_rad[follows] < _LARGEST_TURN_RAD
    group = _components(one[agrees], two[agrees], count)
    weight = 1.0 / sigma[agrees] ** 2
    between = coo_matrix((-weight, (one[agrees], two[agrees])), shape=(count, count))
    total = np.bincount(one[agrees], weight, count) + np.bincount(two[agrees], weight, count)
    factors = splu(((between + between.T).tocsc() + diags(total + _RIDGE * weight.max())).tocsc())
    kept = []
    for number, pair in enumerate(pairs):
        if not follows[number] and group[pair.first] == group[pair.second]:
            way = np.zeros(count)
            way[pair.first], way[pair.second] = 1.0, -1.0
            sure = 3.0 * math.sqrt(max(float(way @ factors.solve(way)), 0.0))
            if off_rad[number] > _OTHER_PLACE_RAD + sure:
                continue
        kept.append(pair)
    return kept


def _between(pairs: Sequence[Pair]) -> tuple[Ints, Ints, Floats]:
    """Return the rows of both pictures of pairs (M), and the standard deviation of their rotation."""
    one = np.array([pair.first for pair in pairs], dtype=np.int64)
    two = np.array([pair.second for pair in pairs], dtype=np.int64)
    matches = np.array([min(len(pair.feature), _ENOUGH) for pair in pairs], dtype=np.float64)
    return one, two, _ROTATION_SIGMA_RAD * np.sqrt(_ENOUGH / matches)


def _rotations(pairs: Sequence[Pair], count: int) -> Floats:
    """Return rotations (count, 3, 3), cam from a world of each group of pictures that pairs hold together."""
    rotation = _grown(pairs, count)
    one, two, sigma = _between(pairs)
    for loss in _losses():
        # R_two exp(w_two) = turn R_one exp(w_one), in the world's axes.
        edges = _Edges(one, two, _turns_off(pairs, rotation), sigma)
        weight = _weight(np.linalg.norm(edges.wanted, axis=1) / sigma, loss) / sigma**2
        step = _linear(edges, count, weight, np.zeros((count, 3)), np.zeros((count, 3)))
        rotation = rotation @ Rotation.from_rotvec(step).as_matrix()
    return rotation


def _grown(pairs: Sequence[Pair], count: int) -> Floats:
    """Return first rotations (count, 3, 3): picture by picture, such as pairs with those before agree about.

    Each pair has a vote for every rotation that it allows, and for depths: what three pictures see is as far away by
    one pair as by another. Where that does not say which rotation is right, the next pictures may: several ways to go
    on are kept until one is clearly ahead.
    """
    of: list[list[Pair]] = [[] for _ in range(count)]
    for pair in pairs:
        of[pair.first].append(pair)
        of[pair.second].append(pair)
    states = [_State(0.0, np.tile(np.eye(3), (count, 1, 1)), [()] * count)]
    known = np.zeros(count, dtype=np.bool_)
    matches = np.array([sum(len(pair.feature) for pair in each) for each in of], dtype=np.float64)
    tied = np.zeros(count)
    while not known.all():
        on = (tied[~known] > 0).any()
        row = int(np.where(known, -1.0, tied if on else matches).argmax())
        if not on:  # What hangs on nothing known begins a group of its own.
            states = states[:1]
        before = [pair for pair in of[row] if known[pair.first + pair.second - row]]
        if before:
            states = [after for state in states for after in state.with_row(row, before, alone=len(states) == 1)]
            states.sort(key=lambda state: -state.score)
            states = [state for state in states[:_MOST_STATES] if state.score > states[0].score - _CLEAR]
        known[row] = True
        for pair in of[row]:
            tied[pair.first + pair.second - row] += len(pair.feature)
    return states[0].rotation


@dataclass(frozen=True, eq=False)
class _State:
    """Rotations (count, 3, 3) of the pictures so far, what is known of the depths of each, and how much agrees."""

    score: float
    rotation: Floats
    depths: Sequence[tuple[_Depths, ...]]

    def with_row(self, row: int, pairs: Sequence[Pair], *, alone: bool) -> list[_State]:
        """Return what comes of each rotation that pairs with what is known allow a picture, unless it is clear."""
        looks = [_look(pair, row, self.rotation) for pair in pairs]
        rotation = np.concatenate([look.candidates() for look in looks])
        of = np.repeat(np.arange(len(looks)), [len(look.pair.second_from_first) for look in looks])
        matches = np.array([min(len(look.pair.feature), _ENOUGH) for look in looks], dtype=np.float64)
        angle = np.arccos(np.clip((np.einsum("aij,bij->ab", rotation, rotation) - 1.0) / 2.0, -1.0, 1.0))
        # Rows are candidates, columns pairs.
        allowed = np.stack([(angle[:, of == each] < _ONE_TURN_RAD).any(axis=1) for each in range(len(looks))], axis=1)
        score = allowed @ matches
        rivals: list[int] = []
        left = score > max(_RIVAL * score.max(), score.max() - _CLEAR)
        while left.any() and len(rivals) < _MOST_RIVALS:
            rivals.append(int(np.where(left, score, -1.0).argmax()))
            left &= angle[rivals[-1]] > _ONE_TURN_RAD
        clear = alone and len(rivals) == 1
        agreed = [np.flatnonzero(allowed[each]).tolist() for each in rivals]
        return [
            self._after(looks, rotation[each], numbers, float(score[each]), clear=clear)
            for each, numbers in zip(rivals, agreed, strict=True)
        ]

    def _after(self, looks: Sequence[_Look], turn: Floats, allowed: list[int], score: float, *, clear: bool) -> _State:
        rotation, depths = self.rotation.copy(), list(self.depths)
        rotation[looks[0].row] = turn
        for number in allowed:
            look = looks[number]
            there, here = look.depths(turn)
            if not clear:
                score += max((there.agree(known) for known in depths[look.other][-_MOST_DEPTHS:]), default=0.0)
            depths[look.other] = (*depths[look.other], there)
            depths[look.row] = (*depths[look.row], here)
        return _State(self.score + score, rotation, depths)


@dataclass(frozen=True, eq=False)
class _Depths:
    """Logarithms of the depths (M) of features (M, rising numbers) of a picture in units of some way, and sigmas."""

    feature: Ints
    log_depth: Floats
    sigma: Floats

    def agree(self, other: _Depths) -> float:
        """Return how many features of both have one ratio of depths, each by how near it is to that."""
        _, mine, its = np.intersect1d(self.feature, other.feature, assume_unique=True, return_indices=True)
        if len(mine) < _LEAST_SHARED:
            return 0.0
        ratio = self.log_depth[mine] - other.log_depth[its]
        sigma = np.hypot(np.hypot(self.sigma[mine], other.sigma[its]), _SAME_DEPTH)
        return float(_weight((ratio - np.median(ratio)) / sigma, "cauchy").sum())


@dataclass(frozen=True, eq=False)
class _Look:
    """A pair of a picture whose rotation is known (`other`) and one (`row`) whose rotation is sought."""

    pair: Pair
    other: int
    row: int
    known: Floats

    def candidates(self) -> Floats:
        """Return the rotations (H, 3, 3) that the pair allows."""
        turn = self.pair.second_from_first
        return np.asarray((turn if self.pair.second == self.row else np.swapaxes(turn, 1, 2)) @ self.known)

    def depths(self, rotation: Floats) -> tuple[_Depths, _Depths]:
        """Return what the known picture and the other say of depths, if the rotation is this."""
        place = 0 if self.pair.first == self.other else 1
        way = find_way(self.pair.ray[place] @ self.known, self.pair.ray[1 - place] @ rotation)
        fine = way.fine & (way.parallax_rad > _LEAST_PARALLAX_RAD)
        found = []
        for which, depth in zip((place, 1 - place), way.depth, strict=True):
            feature, first = np.unique(self.pair.feature[fine, which], return_index=True)
            found.append(_Depths(feature, np.log(depth[fine][first]), way.sigma[fine][first]))
        return found[0], found[1]


def _look(pair: Pair, row: int, rotation: Floats) -> _Look:
    other = pair.first + pair.second - row
    return _Look(pair, other, row, rotation[other])


def _turns_off(pairs: Sequence[Pair], rotation: Floats) -> Floats:
    """Return by what turns (M, 3), rad, pairs are off the rotations of all: the least of those that each allows."""
    if not pairs:
        return np.empty((0, 3))
    allowed = np.array([len(pair.second_from_first) for pair in pairs])
    one, two = (np.repeat([getattr(pair, name) for pair in pairs], allowed) for name in ("first", "second"))
    turn = np.concatenate([pair.second_from_first for pair in pairs])
    turn = Rotation.from_matrix(np.swapaxes(rotation[two], 1, 2) @ turn @ rotation[one]).as_rotvec()
    # Those of a pair stay together, the least of them first.
    ordered = np.lexsort((np.linalg.norm(turn, axis=1), np.repeat(np.arange(len(pairs)), allowed)))
    return np.asarray(turn[ordered[np.cumsum(allowed) - allowed]])


def _edges(pairs: Sequence[Pair], ways: Sequence[Way]) -> tuple[_Edges, Ints]:
    """Return the ways of all pairs (M), and of which part each is: those of a part are in one unit, -1 is of none."""
    of = np.concatenate([np.full(2 * len(pair.feature), i) for i, pair in enumerate(pairs)])
    row = np.concatenate([np.repeat([pair.first, pair.second], len(pair.feature)) for pair in pairs])
    feature = np.concatenate([pair.feature.T.reshape(-1) for pair in pairs])
    log_depth = np.concatenate([np.log(np.maximum(way.depth, 1e-9)).reshape(-1) for way in ways])
    sigma = np.concatenate([np.tile(way.sigma, 2) for way in ways])
    parallax = np.concatenate([np.tile(way.parallax_rad, 2) for way in ways])
    fine = np.concatenate([np.tile(way.fine, 2) for way in ways])
    node = np.unique(np.stack([row, feature]), axis=1, return_inverse=True)[1].reshape(-1)
    far = np.flatnonzero(fine & (parallax > _LEAST_PARALLAX_RAD))
    part = _parts(of[far], node[far], len(pairs))
    # Each part has its own depths.
    far = far[part[of[far]] >= 0]
    own, place = np.unique(np.stack([part[of[far]], node[far]]), axis=1, return_inverse=True)
    log_length, log_depths = _lengths(of[far], place.reshape(-1), log_depth[far], sigma[far], len(pairs), own.shape[1])
    length, way_sigma = np.exp(log_length), _LENGTH_SHARE * np.exp(log_length)
    # How far a pair without parallax can be apart, by what others say of the depths of what it sees.
    depth_of, part_of = np.full(node.max(initial=-1) + 1, np.nan), np.full(node.max(initial=-1) + 1, -1)
    depth_of[own[1]], part_of[own[1]] = np.exp(log_depths), own[0]
    begin = np.searchsorted(of, np.arange(len(pairs) + 1))
    for i in np.flatnonzero(part < 0).tolist():
        mine = begin[i] + np.flatnonzero(part_of[node[begin[i] : begin[i + 1]]] >= 0)
        if len(mine) >= _LEAST_SHARED:
            part[i] = np.bincount(part_of[node[mine]]).argmax()
            mine = mine[part_of[node[mine]] == part[i]]
            length[i], way_sigma[i] = 0.0, np.median(parallax[mine] * depth_of[node[mine]])
    wanted = length[:, None] * np.array([way.direction for way in ways]).reshape(-1, 3)
    one, two = (np.array([getattr(pair, end) for pair in pairs], dtype=np.int64) for end in ("first", "second"))
    return _Edges(one, two, wanted, way_sigma), part


def _lengths(pair: Ints, node: Ints, log_depth: Floats, sigma: Floats, pairs: int, nodes: int) -> tuple[Floats, Floats]:
    """Return logarithms of the lengths of pairs' ways and of the depths of nodes: depth = depth in ways * length."""
    length, depth = np.zeros(pairs), np.zeros(nodes)
    weight = 1.0 / sigma**2
    for loss in ["none", *_losses()]:
        if loss != "none":
            weight = _weight(np.abs(log_depth + length[pair] - depth[node]) / sigma, loss) / sigma**2
        # Without the depths, which are weighted means (Schur's complement).
        seen = csr_matrix((weight, (pair, node)), shape=(pairs, nodes))
        of_node = 1.0 / np.maximum(np.bincount(node, weight, nodes), 1e-300)
        total = np.bincount(pair, weight, pairs)
        matrix = diags(total + _RIDGE * max(float(np.median(total)), 1e-12)) - seen @ diags(of_node) @ seen.T
        mean = of_node * np.bincount(node, weight * log_depth, nodes)
        length = splu(matrix.tocsc()).solve(seen @ mean - np.bincount(pair, weight * log_depth, pairs))
        depth = mean + of_node * (seen.T @ length)
    return length, depth


def _parts(pair: Ints, node: Ints, count: int) -> Ints:
    """Return which of pairs (count) are held together by depths of the same features, -1 where a pair has too few."""
    seen = csr_matrix((np.ones(len(pair)), (pair, node)), shape=(count, node.max(initial=-1) + 1))
    shared = (seen @ seen.T).tocsr()
    enough = shared.diagonal() >= _LEAST_SHARED
    shared.data[shared.data < _LEAST_SHARED] = 0.0
    shared.eliminate_zeros()
    part = connected_components(shared, directed=False)[1].astype(np.int64)
    return np.where(enough, part, -1)


def _components(one: Ints, two: Ints, count: int) -> Ints:
    graph = csr_matrix((np.ones(len(one)), (one, two)), shape=(count, count))
    found: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return found


@dataclass(frozen=True, eq=False)
class _Placed:
    """The ways `which` of `pictures` of one part, and the scale and turn that take them onto the GPS.

    `north_sigma_rad` is how well their GPS says where north is.
    """

    pictures: int
    which: Ints
    scale: float
    turn: Floats
    north_sigma_rad: float


def _onto_earth(
    edges: _Edges, part: Ints, rotation: Floats, gps_in_world_m: Floats, sigma_m: Floats
) -> list[tuple[Floats, _Edges]]:
    """Return pieces, the largest first: turns (3, 3) from the world of rotations to that of the GPS, ways in metres.

    Parts are of one piece where their GPS has north in one direction. Where it has not, rotations are wrong between
    them, if it is long enough to tell; else it is the GPS that is, and the smaller part is left out.
    """
    placed = []
    for each in np.unique(part):
        which = np.flatnonzero(part == each)
        rows, place = np.unique([edges.one[which], edges.two[which]], return_inverse=True)
        if len(rows) < LEAST_IMAGES:
            continue
        one, two = place.reshape(2, -1)
        free = np.full((len(rows), 3), np.nan)
        # What hangs on another piece by nothing would stay where it is.
        piece = _components(one, two, len(rows))
        main = piece == np.bincount(piece).argmax()
        center = _solve(_Edges(one, two, edges.wanted[which], edges.sigma[which]), len(rows), free, free)
        gps, sigma = gps_in_world_m[rows[main]], sigma_m[rows[main]]
        moved = similarity_onto(center[main], -rotation[rows[main], 1], gps, sigma)
        if moved is not None:
            placed.append(_Placed(int(main.sum()), which[main[one]], *moved[:2], _north_sigma_rad(gps, sigma)))
    placed.sort(key=lambda each: -each.pictures)
    pieces = []
    while placed:
        turn = placed[0].turn
        off_rad = [float(Rotation.from_matrix(each.turn @ turn.T).magnitude()) for each in placed]
        same = [each for each, off in zip(placed, off_rad, strict=True) if off < _SAME_NORTH_RAD]
        pieces.append((turn, _in_metres(edges, same, turn)))
        placed = [
            each
            for each, off in zip(placed, off_rad, strict=True)
            if off > max(_SAME_NORTH_RAD, 3.0 * each.north_sigma_rad)
        ]
    return pieces


def _in_metres(edges: _Edges, placed: Sequence[_Placed], turn: Floats) -> _Edges:
    """Return the ways of parts, each by its own scale, in the axes of the world."""
    which = np.concatenate([each.which for each in placed])
    scale = np.concatenate([np.full(len(each.which), each.scale) for each in placed])
    sigma = np.maximum(scale * edges.sigma[which], _STILL_M)
    return _Edges(edges.one[which], edges.two[which], scale[:, None] * edges.wanted[which] @ turn.T, sigma)


def _north_sigma_rad(gps_m: Floats, sigma_m: Floats) -> float:
    """Return how well positions (N, 3) say in which direction a drive goes, by how far they are apart.

    What noise alone makes of that, two a position in variances, says nothing.
    """
    known = np.isfinite(gps_m).all(axis=1)
    away = (gps_m[known, :2] - gps_m[known, :2].mean(axis=0)) / sigma_m[known, None]
    return float(1.0 / np.sqrt(max((away**2).sum() - 2.0 * known.sum(), 1e-12)))


def _losses() -> Iterator[str]:
    yield from ["l1"] * _L1_ROUNDS
    yield from ["cauchy"] * _CAUCHY_ROUNDS


def _weight(size: Floats, loss: str) -> Floats:
    """Return weights of residuals in sigmas."""
    found: Floats = 1.0 / np.maximum(size, 1.0) if loss == "l1" else 1.0 / (1.0 + (size / _CAUCHY) ** 2)
    return found


def _solve(edges: _Edges, count: int, target: Floats, target_sigma: Floats) -> Floats:
    """Return values (count, K) whose differences and, where they are known, targets (count, K) are as wanted."""
    known = np.asarray(np.isfinite(target).all(axis=1))
    to, root = np.where(known[:, None], target, 0.0), np.where(known[:, None], 1.0 / target_sigma, 0.0)
    weight, gps = 1.0 / edges.sigma**2, np.ones(count)
    value = to
    for loss in ["none", *_losses()]:
        if loss != "none":
            off = value[edges.two] - value[edges.one] - edges.wanted
            weight = _weight(np.linalg.norm(off, axis=1) / edges.sigma, loss) / edges.sigma**2
            gps = _weight(np.linalg.norm((value - to) * root, axis=1), loss)
        value = _linear(edges, count, weight, gps[:, None] * root**2, to)
    return value


def _linear(edges: _Edges, count: int, weight: Floats, own: Floats, target: Floats) -> Floats:
    """Return the values (count, K) of least squares, with weights of differences (M) and of targets (count, K)."""
    one, two = edges.one, edges.two
    between = coo_matrix((-weight, (one, two)), shape=(count, count))
    total = np.bincount(one, weight, count) + np.bincount(two, weight, count)
    laplacian = (between + between.T).tocsc() + diags(total)
    pull = weight[:, None] * edges.wanted
    found = np.empty((count, edges.wanted.shape[1]))
    ridge = _RIDGE * max(float(np.median(total)), 1e-12)
    for axis in range(found.shape[1]):
        given: Floats = own[:, axis] * target[:, axis]
        right = given + np.bincount(two, pull[:, axis], count) - np.bincount(one, pull[:, axis], count)
        if axis == 0 or not np.array_equal(own[:, axis], own[:, axis - 1]):
            factors = splu((laplacian + diags(own[:, axis] + ridge)).tocsc())
        found[:, axis] = factors.solve(right)
    return found
