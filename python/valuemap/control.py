"""Control points: surveyed objects tell by how much the whole map is shifted and turned, and how sure that is.

A point's label is not known. The shift on which most points and labels agree, small ones first, matches them one to
one; then shift, and rotation about the vertical where the points tell it, are weighted least squares with Huber's
weights. What labels and points disagree by beyond their own errors - what a survey calls the middle of an object, and
errors that neighbours do not share - is estimated along with them and is part of the uncertainty. Points that are left
out at random, with the rest of the estimation done anew, prove it.

Some shift is always the one on which most points agree. So it counts only if they agree far better than the same search
makes them agree from where they cannot be: moved on the ground, farther than shifts are looked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.assignment import one_to_one
from valuemap.cameras import camera_poses
from valuemap.dataset import Dataset
from valuemap.errors import InputError
from valuemap.evaluate.truth import TrueObjects
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import Map
from valuemap.tables import Labels
from valuemap.tables.covariance import covariance_columns, covariance_matrices

REACH_M = 10.0
"""Shifts up to this are looked for."""
_USUAL_M = 3.0
"""Deviation of the shift that is expected: of several that explain the points, a small one is likelier."""
_FIRST_SPREAD_M = 0.5
"""What labels and points disagree by, each axis, before anything is known."""
_CLUTTER = 0.02
"""What a point with no label in its place counts, where one with a label exactly there counts one more."""
_GATE = 3.5
"""A label farther from a point than so many sigmas is not that of the point."""
_HUBER = 2.0
"""What points and labels disagree by beyond so many sigmas weighs less, in inverse proportion."""
_LEAST_POINTS = 3
_LEAST_FOR_ROTATION = 6
_TURN_PRICE = 10.0
"""What a rotation must explain, in squared sigmas."""
_SPLITS, _LEFT_OUT = 50, 0.3
_LEAST_CHANCE = 1e-3
"""Points that agree by chance do so as well with a probability below this."""
_ELSEWHERE_M = REACH_M * math.sqrt(2.0)
"""The side of a square whose corners all are within reach of its middle: searches from the middles of such squares
together see every shift."""
_RINGS = 3
"""So many squares away to each side: 48 searches, in streets that are as dense as those of the points."""
_ENOUGH_POINTS = 200
"""So many points, evenly spread, tell chance; the search grows with their square."""
_MINORITY = 0.5
"""Where a smaller share of the points on the map has a label, a note says so. By chance a larger one hardly ever has,
and points in rows agree with labels from many places."""


@dataclass(frozen=True, eq=False)
class Georeference:
    """What takes a map to its control points: `turn_rad` about up at `pivot_m`, then `shift_m`; east, north, up.

    `covariance` (4, 4) is of shift and turn, NaN where points do not tell one at all. `label_of_point` (points) is the
    row of the label, -1 for none; `spread_m` is what labels and points disagree by beyond their own errors, each axis
    on the ground.
    """

    shift_m: Floats
    turn_rad: float
    pivot_m: Floats
    covariance: Floats
    label_of_point: Ints
    spread_m: float


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Points that had no part in the estimation: horizontal and vertical RMSE as mapped and as corrected, m."""

    points: int
    splits: int
    before_m: tuple[float, float]
    after_m: tuple[float, float]
    shift_deviation_m: float
    """Root mean square distance on the ground between the shift of the rest and that of all."""


def find_georeference(result: Map, points: TrueObjects) -> Georeference:
    """Return what takes the labels of a map to its control points.

    Raises
    ------
    InputError
        There are fewer than three points, fewer than three agree with labels, or no more than chance would make agree.
    """
    labels, here = _Labels.of(result), _Points.of(result, points)
    rows = np.arange(len(here.place_m))
    if len(rows) < _LEAST_POINTS:
        raise InputError(
            f"control: {len(rows)} point{'s' if len(rows) != 1 else ''}, expected at least {_LEAST_POINTS}",
            hint=f"measure more: any label near a point gives a shift, and {_LEAST_POINTS} that agree tell which it is",
        )
    trust = _Trust.of(labels, here)
    try:
        found = _find(labels, here, rows)
    except InputError as error:
        raise InputError(str(error), hint=trust.told_of_elsewhere(labels, here) or error.hint) from error
    matched = int((found.label_of_point >= 0).sum())
    is_majority = matched > _MINORITY * _on_map(result, points) and trust.is_best
    if trust.chance_of(0) > _LEAST_CHANCE and not is_majority:
        raise InputError(
            f"control: {matched} of {len(rows)} points agree with labels about one shift of up to {REACH_M:g} m, and "
            "about as many would by chance",
            hint=trust.told_of_elsewhere(labels, here)
            or "are these the objects that were mapped, in the frame of the map, and are there enough of them?",
        )
    return found


def leave_out(result: Map, points: TrueObjects, found: Georeference) -> LeftOut | None:
    """Estimate without some of the points, chosen at random again and again, and see how far those are then off.

    None where there are too few to leave any out.
    """
    labels, here = _Labels.of(result), _Points.of(result, points)
    matched = np.flatnonzero(found.label_of_point >= 0)
    count = max(1, round(_LEFT_OUT * len(matched)))
    if len(matched) - count < _LEAST_POINTS:
        return None
    random = np.random.default_rng(0)
    before: list[Floats] = []
    after: list[Floats] = []
    shifts = []
    for _ in range(_SPLITS):
        out = random.permutation(matched)[:count]
        rest = np.setdiff1d(matched, out)
        try:
            without = _find(labels, here, rest)
        except InputError:
            continue
        place_m = labels.place_m[found.label_of_point[out]]
        for errors, mapped_m in ((before, place_m), (after, _moved(place_m, without))):
            error = here.place_m[out] - mapped_m
            error[~here.has_height[out], 2] = np.nan
            errors.append(error)
        middle = found.pivot_m[None]
        shifts.append(_moved(middle, without)[0, :2] - _moved(middle, found)[0, :2])
    if not before:
        return None
    return LeftOut(
        points=count,
        splits=len(before),
        before_m=_rmse(np.concatenate(before)),
        after_m=_rmse(np.concatenate(after)),
        shift_deviation_m=float(np.sqrt(np.mean(np.sum(np.square(shifts), axis=1)))),
    )


def apply_control(result: Map, points: TrueObjects, dataset: Dataset | None = None) -> tuple[Map, Dataset | None]:
    """Return a map that is moved to its control points, and its dataset likewise.

    Labels get a covariance in two parts: that against the labels around stays, and `absolute_covariance_m2` adds
    what is not known of the shift and the turn. Where points tell no heights, it adds to the height what it added
    before. `run["control"]` says what was found.

    Raises
    ------
    InputError
        As `find_georeference`.
    """
    found = find_georeference(result, points)
    proof = leave_out(result, points, found)
    axes = result.frame.east_north_up()
    place = result.labels.position_in_world_m @ axes.T
    common_m2 = _common_m2(place, found)
    if np.isnan(found.covariance[2, 2]):
        common_m2[:, 2, 2] = (axes @ _added_before_m2(result.labels) @ axes.T)[:, 2, 2]
    absolute_m2 = result.labels.covariance_m2 + covariance_columns(axes.T @ common_m2 @ axes)
    labels = _moved_labels(result, found).replace(absolute_covariance_m2=absolute_m2)
    rejected = result.rejected
    if rejected is not None:
        rejected = rejected.replace(position_in_world_m=_moved(rejected.position_in_world_m @ axes.T, found) @ axes)
    record = _describe(found, proof, points, result)
    run = {**result.run, "control": record}
    matched, on_map = record["matched"], record["points_on_map"]
    if matched < _MINORITY * on_map:
        told = f"control: only {matched} of {on_map} points on the map have a label that agrees about the shift"
        run["notes"] = [*run.get("notes", []), told]
    if dataset is not None:
        dataset = _moved_dataset(dataset, found, axes)
    return replace(result, labels=labels, run=run, rejected=rejected), dataset


def labels_before_control(result: Map) -> Labels:
    """Return the labels of a map that was moved to control points where they were before, as `run["control"]` says."""
    told = _told(result)
    back = replace(told, shift_m=-told.shift_m, turn_rad=-told.turn_rad, pivot_m=told.pivot_m + told.shift_m)
    return _moved_labels(result, back).replace(absolute_covariance_m2=None)


def dataset_after_control(result: Map, dataset: Dataset) -> Dataset:
    """Return a dataset moved as a map was moved to control points, as `run["control"]` of the map says."""
    return _moved_dataset(dataset, _told(result), result.frame.east_north_up())


def updated_after_control(result: Map, record: dict[str, Any]) -> Map:
    """Return a map of data that was moved as `record` says, with what that says is not known of the place of labels.

    What the map itself says of the place of all drives counts beside.
    """
    result = replace(result, run={**result.run, "control": record})
    labels, axes = result.labels, result.frame.east_north_up()
    common_m2 = axes.T @ _common_m2(labels.position_in_world_m @ axes.T, _told(result)) @ axes
    absolute_m2 = labels.covariance_m2 + covariance_columns(common_m2 + _added_before_m2(labels))
    return replace(result, labels=labels.replace(absolute_covariance_m2=absolute_m2))


def _told(result: Map) -> Georeference:
    """Return what a map was moved by; its pivot is where it was before."""
    told = result.run["control"]
    shift, pivot = np.array(told["shift_east_north_up_m"]), result.frame.east_north_up() @ np.array(told["pivot_m"])
    none = np.full(int(told["points"]), -1)
    covariance = np.array(told["covariance_of_shift_and_turn"], np.float64)
    return Georeference(shift, math.radians(told["turn_deg"]), pivot, covariance, none, 0.0)


@dataclass(frozen=True, eq=False)
class _Labels:
    """Places (N, 3) and covariances (N, 3, 3) of labels, east, north, up, and their classes."""

    place_m: Floats
    covariance_m2: Floats
    class_names: list[str]

    @classmethod
    def of(cls, result: Map) -> _Labels:
        axes, labels = result.frame.east_north_up(), result.labels
        full = covariance_matrices(labels.covariance_m2)
        return cls(labels.position_in_world_m @ axes.T, axes @ full @ axes.T, labels.class_name.texts())


@dataclass(frozen=True, eq=False)
class _Points:
    """Places (N, 3) of control points, east, north, up, their deviations (N), and their classes, None for any.

    Of points that do not `has_height` (N) the third coordinate means nothing.
    """

    place_m: Floats
    sigma_m: Floats
    class_names: list[str] | None
    has_height: Bools

    @classmethod
    def of(cls, result: Map, points: TrueObjects) -> _Points:
        sigma = np.zeros(len(points)) if points.sigma_m is None else np.nan_to_num(points.sigma_m)
        names = None if points.class_name is None else points.class_name.texts()
        return cls(points.position_in_world_m @ result.frame.east_north_up().T, sigma, names, points.knows_height)

    def axes(self, rows: Ints) -> int:
        """Return how many axes of a shift some points tell: heights, as places, take a few."""
        return 3 if int(self.has_height[rows].sum()) >= _LEAST_POINTS else 2

    def knows(self, rows: Ints, used: int) -> Floats:
        """Return 1 for each of the axes used (N, used) that points know their place on, else 0."""
        known = np.ones((len(rows), used))
        known[~self.has_height[rows], 2:] = 0.0
        return known

    def covariance_m2(self, rows: Ints, of_labels_m2: Floats, used: int) -> Floats:
        """Return the covariances (N, used, used) of points less labels; an axis not known goes with no other."""
        known = self.knows(rows, used)
        both = known[:, :, None] * known[:, None, :] + (1.0 - known)[:, :, None] * np.eye(used)
        total = of_labels_m2[:, :used, :used] * both
        return np.asarray(total + (self.sigma_m[rows] ** 2)[:, None, None] * np.eye(used))


def _find(labels: _Labels, points: _Points, rows: Ints) -> Georeference:
    """Estimate with some of the points."""
    used = points.axes(rows)
    point, label = _candidates(labels, points, rows, used)
    if len(np.unique(point)) < _LEAST_POINTS:
        raise InputError(
            f"control: {len(np.unique(point))} of {len(rows)} points have a label of their class within "
            f"{REACH_M:g} m, expected at least {_LEAST_POINTS}",
            hint="are they in the frame of the map, or geographic, and are their classes those of the labels?",
        )
    shift, _ = _first_shift(labels, points, point, label, used)
    pivot = points.place_m[rows].mean(axis=0)
    found = Georeference(shift, 0.0, pivot, np.zeros((4, 4)), np.full(len(points.place_m), -1), _FIRST_SPREAD_M)
    for _ in range(8):
        match = _match(labels, points, point, label, found, used)
        if int((match >= 0).sum()) < _LEAST_POINTS:
            raise InputError(
                f"control: {int((match >= 0).sum())} of {len(rows)} points agree with labels about one shift, "
                f"expected at least {_LEAST_POINTS}",
                hint="are these the objects that were mapped?",
            )
        used = points.axes(np.flatnonzero(match >= 0))
        found = _adjust(labels, points, match, found, used)
    return found


def _candidates(labels: _Labels, points: _Points, rows: Ints, used: int) -> tuple[Ints, Ints]:
    """Return pairs of point and label of one class within reach."""
    if not len(labels.place_m):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    from scipy.spatial import cKDTree  # Slow to import, and only maps with control points need it.

    tree = cKDTree(labels.place_m[:, :2])
    near: list[list[int]] = list(tree.query_ball_point(points.place_m[rows, :2], REACH_M, return_sorted=True))  # type: ignore[arg-type]
    pairs = [
        (row, other)
        for row, others in zip(rows.tolist(), near, strict=True)
        for other in others
        if points.class_names is None or points.class_names[row] == labels.class_names[other]
    ]
    point, label = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    apart_m = (points.place_m[point] - labels.place_m[label])[:, :used] * points.knows(point, used)
    is_near = np.linalg.norm(apart_m, axis=1) <= REACH_M
    return point[is_near], label[is_near]


def _first_shift(labels: _Labels, points: _Points, point: Ints, label: Ints, used: int) -> tuple[Floats, float]:
    """Return the shift (3) on which most points agree, the best of all differences of pairs, and none, and its support.

    That is the logarithm of how much likelier the points are with labels there than with none, less what a large shift
    is less likely by.
    """
    known = points.knows(point, used)
    difference = (points.place_m[point] - labels.place_m[label])[:, :used] * known
    variance = np.trace(labels.covariance_m2[label][:, :used, :used], axis1=1, axis2=2) / used
    variance = variance + points.sigma_m[point] ** 2 + _FIRST_SPREAD_M**2
    trial = np.unique(np.vstack([np.zeros((1, used)), difference]), axis=0)
    best, least = np.zeros(used), math.inf
    for shift in trial:
        agreement = np.exp(-0.5 * np.sum(known * (difference - shift) ** 2, axis=1) / variance)
        each = np.zeros(len(points.place_m))
        np.maximum.at(each, point, agreement)
        cost = -2.0 * float(np.sum(np.log(_CLUTTER + each))) + float(shift @ shift) / _USUAL_M**2
        if cost < least:
            best, least = shift, cost
    support = -0.5 * least - len(points.place_m) * math.log(_CLUTTER)
    return np.append(best, np.zeros(3 - used)), support


@dataclass(frozen=True, eq=False)
class _Trust:
    """How much points agree about a shift where they are, and moved to where they cannot be.

    `offset_m` (N, 3) are those moves, none first; `shift_m` (N, 3) is what is found then, and `support` (N) how much
    points agree, as in `_first_shift`.
    """

    offset_m: Floats
    shift_m: Floats
    support: Floats

    @classmethod
    def of(cls, labels: _Labels, points: _Points) -> _Trust:
        steps = _ELSEWHERE_M * np.arange(-_RINGS, _RINGS + 1)
        east, north = (each.ravel() for each in np.meshgrid(steps, steps))
        offset_m = np.stack([east, north, np.zeros(len(east))], axis=1)
        offset_m = offset_m[np.argsort(np.linalg.norm(offset_m, axis=1), kind="stable")]
        spread = np.linspace(0, len(points.place_m) - 1, min(_ENOUGH_POINTS, len(points.place_m)))
        rows = spread.round().astype(np.int64)
        used = points.axes(rows)
        shift_m, support = np.zeros_like(offset_m), np.zeros(len(offset_m))
        for i, offset in enumerate(offset_m):
            moved = replace(points, place_m=points.place_m + offset)
            point, label = _candidates(labels, moved, rows, used)
            shift_m[i], support[i] = _first_shift(labels, moved, point, label, used)
        return cls(offset_m, shift_m, support)

    def chance_of(self, which: int) -> float:
        """Return how likely points agree so well by chance, by Gumbel's law of what is the best of many.

        Moves that lead to the same place of the points are no other ones.
        """
        place_m = (self.shift_m - self.offset_m)[:, :2]
        apart_m = np.linalg.norm(place_m - place_m[which], axis=1)
        other = self.support[apart_m > _GATE * _FIRST_SPREAD_M]
        if not len(other):
            return 1.0
        scale = max(float(other.std()) * math.sqrt(6.0) / math.pi, 1e-9)
        at = (self.support[which] - float(other.mean())) / scale + np.euler_gamma
        return -math.expm1(-math.exp(-at))

    @property
    def is_best(self) -> bool:
        """Whether points agree best where they are: in a row of equal distances they agree elsewhere, too."""
        return int(np.argmax(self.support)) == 0

    def told_of_elsewhere(self, labels: _Labels, points: _Points) -> str | None:
        """Return where points agree with labels beyond chance, farther away than a shift may be; None if nowhere."""
        which = int(np.argmax(self.support))
        if which == 0 or self.chance_of(which) > _LEAST_CHANCE:
            return None
        rows = np.arange(len(points.place_m))
        try:
            there = _find(labels, replace(points, place_m=points.place_m + self.offset_m[which]), rows)
        except InputError:
            return None
        east, north = (self.offset_m[which] - there.shift_m)[:2]
        matched = int((there.label_of_point >= 0).sum())
        ways = "east" if east > 0 else "west", "north" if north > 0 else "south"
        return (
            f"{matched} of {len(rows)} would if the points were moved by {abs(east):.1f} m to the {ways[0]} and "
            f"{abs(north):.1f} m to the {ways[1]}: are they, or the poses, of another datum?"
        )


def _on_map(result: Map, points: TrueObjects) -> int:
    """Return how many points could have a label: those in the extent of all labels, or within reach of it."""
    ground = np.stack(list(result.frame.east_north()))
    labels, places = result.labels.position_in_world_m @ ground.T, points.position_in_world_m @ ground.T
    low, high = labels.min(axis=0) - REACH_M, labels.max(axis=0) + REACH_M
    return int(np.all((places >= low) & (places <= high), axis=1).sum())


def _moved(place_m: Floats, found: Georeference) -> Floats:
    """Return places (N, 3), east, north, up, turned about the pivot and shifted."""
    cos, sin = math.cos(found.turn_rad), math.sin(found.turn_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray((place_m - found.pivot_m) @ turn.T + found.pivot_m + found.shift_m)


def _moved_labels(result: Map, found: Georeference) -> Labels:
    """Return the labels of a map turned and shifted."""
    labels, axes, anchor = result.labels, result.frame.east_north_up(), result.frame.anchor
    moved = _moved(labels.position_in_world_m @ axes.T, found) @ axes
    return labels.replace(
        position_in_world_m=moved,
        facing_azimuth_rad=(labels.facing_azimuth_rad - found.turn_rad) % (2.0 * np.pi),
        lon_lat_height=None if anchor is None else lon_lat_height_from_enu(moved, anchor),
    )


def _match(labels: _Labels, points: _Points, point: Ints, label: Ints, found: Georeference, used: int) -> Ints:
    """Return the label (points) of each point, one to one, the closest in sigmas; -1 where none is within the gate."""
    apart = (points.place_m[point] - _moved(labels.place_m[label], found))[:, :used] * points.knows(point, used)
    total = points.covariance_m2(point, labels.covariance_m2[label], used)
    total += max(found.spread_m, 0.05) ** 2 * np.eye(used)
    square = np.einsum("ni,ni->n", apart, np.linalg.solve(total, apart[:, :, None])[:, :, 0])
    match = np.full(len(points.place_m), -1)
    fits = square < _GATE**2
    ours, theirs = one_to_one(point[fits], label[fits], square[fits], _GATE**2)
    match[ours] = theirs
    return match


def _adjust(labels: _Labels, points: _Points, match: Ints, found: Georeference, used: int) -> Georeference:
    """Estimate shift, spread, and a turn where it explains more than its price."""
    rows = np.flatnonzero(match >= 0)
    source, target = labels.place_m[match[rows]], points.place_m[rows]
    known = points.knows(rows, used)
    own = points.covariance_m2(rows, labels.covariance_m2[match[rows]], used)
    pivot = target.mean(axis=0)
    with_turn = len(rows) >= _LEAST_FOR_ROTATION
    design = np.zeros((len(rows), used, used + 1))
    design[:, np.arange(used), np.arange(used)] = 1.0
    arm = source - pivot
    design[:, 0, used], design[:, 1, used] = -arm[:, 1], arm[:, 0]
    difference = (target - source)[:, :used]
    turn_rad2 = math.nan
    for columns in ([*range(used + 1)], [*range(used)]) if with_turn else ([*range(used)],):
        part = design[:, :, columns]
        weight_of, spread2 = np.ones(len(rows)), found.spread_m**2
        for _ in range(20):
            information = np.linalg.inv(own + spread2 * np.eye(used)) * known[:, :, None]
            weight = information * weight_of[:, None, None]
            normal = np.einsum("nki,nkl,nlj->ij", part, weight, part)
            covariance_part = np.linalg.inv(normal)
            values = covariance_part @ np.einsum("nki,nkl,nl->i", part, weight, difference)
            left = difference - part @ values
            square = np.einsum("ni,nij,nj->n", left, information, left)
            weight_of = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(square, 1e-12)))
            # The spread at which what is left is as large as it should be, a step at a time.
            freedom = max(int(known.sum()) - len(columns), 1)
            excess = float(np.sum(weight_of * square)) / freedom
            spread2 = min(max(spread2 * excess, 1e-6), REACH_M**2)
        solution, covariance = np.zeros(used + 1), np.zeros((used + 1, used + 1))
        solution[columns], covariance[np.ix_(columns, columns)] = values, covariance_part
        if len(columns) == used + 1:
            turn_rad2 = covariance_part[used, used]
            if values[used] ** 2 > _TURN_PRICE * turn_rad2:
                break
            turn_rad2 += values[used] ** 2
    # A turn that is too small to be told is off from none by what it seems to be.
    covariance[used, used] = turn_rad2
    full = np.zeros((4, 4))
    full[[2, 3], [2, 3]] = np.nan
    places = [*range(used), 3]
    full[np.ix_(places, places)] = covariance
    shift = np.append(solution[:used], np.zeros(3 - used))
    return Georeference(shift, float(solution[used]), pivot, full, match, math.sqrt(spread2))


def _common_m2(place_m: Floats, found: Georeference) -> Floats:
    """Return the covariances (N, 3, 3), east, north, up, that shift and turn give places (N, 3)."""
    arm = place_m - found.pivot_m
    design = np.zeros((len(place_m), 3, 4))
    design[:, np.arange(3), np.arange(3)] = 1.0
    design[:, 0, 3], design[:, 1, 3] = -arm[:, 1], arm[:, 0]
    return np.asarray(design @ np.nan_to_num(found.covariance) @ design.transpose(0, 2, 1))


def _added_before_m2(labels: Labels) -> Floats:
    """Return what absolute covariances (N, 3, 3) of labels add to those against the labels around; 0 without."""
    if labels.absolute_covariance_m2 is None:
        return np.zeros((len(labels), 3, 3))
    return covariance_matrices(labels.absolute_covariance_m2 - labels.covariance_m2)


def _moved_dataset(dataset: Dataset, found: Georeference, axes: Floats) -> Dataset:
    """Return the dataset with its images moved as the labels are."""
    from scipy.spatial.transform import Rotation  # As slow.

    rotation, center = camera_poses(dataset.images)
    moved = _moved(center @ axes.T, found) @ axes
    turn = axes.T @ Rotation.from_rotvec([0.0, 0.0, found.turn_rad]).as_matrix() @ axes
    turned = Rotation.from_matrix(rotation @ turn.T)
    images = dataset.images.replace(
        cam_from_world_quat=turned.as_quat(canonical=True, scalar_first=True), cam_from_world_m=-turned.apply(moved)
    )
    return replace(dataset, images=images)


def _rmse(error_m: Floats) -> tuple[float, float]:
    horizontal = float(np.sqrt(np.mean(np.sum(error_m[:, :2] ** 2, axis=1))))
    vertical_m = error_m[np.isfinite(error_m[:, 2]), 2]
    return horizontal, float(np.sqrt(np.mean(vertical_m**2))) if len(vertical_m) else math.nan


def _rounded(value: float, digits: int) -> float | None:
    return None if math.isnan(value) else round(float(value), digits)


def _describe(found: Georeference, proof: LeftOut | None, points: TrueObjects, result: Map) -> dict[str, Any]:
    """Return what run.json says of the control."""
    sigma = np.sqrt(np.diag(found.covariance))
    record: dict[str, Any] = {
        "points": len(points),
        "points_on_map": _on_map(result, points),
        "matched": int((found.label_of_point >= 0).sum()),
        "shift_east_north_up_m": [round(float(v), 4) for v in found.shift_m],
        "shift_sigma_m": [_rounded(v, 4) for v in sigma[:3]],
        "turn_deg": round(math.degrees(found.turn_rad), 6),
        "turn_sigma_deg": _rounded(math.degrees(sigma[3]), 6),
        "covariance_of_shift_and_turn": [[_rounded(v, 12) for v in row] for row in found.covariance],
        "pivot_m": [round(float(v), 4) for v in found.pivot_m @ result.frame.east_north_up()],
        "spread_m": round(found.spread_m, 4),
    }
    if proof is not None:
        names = ("horizontal", "vertical")
        record["left_out"] = {
            "points": proof.points,
            "splits": proof.splits,
            **{f"rmse_{n}_as_mapped_m": round(v, 4) for n, v in zip(names, proof.before_m, strict=True) if v == v},
            **{f"rmse_{n}_m": round(v, 4) for n, v in zip(names, proof.after_m, strict=True) if v == v},
            "shift_deviation_m": round(proof.shift_deviation_m, 4),
        }
    return record
