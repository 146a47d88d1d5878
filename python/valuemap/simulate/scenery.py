"""What the pictures show besides lights: streets with markings, house fronts, poles and signs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valuemap.simulate.city import City, Targets
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import DIRECTIONS, Streets
from valuemap.tables import Floats, Ints, Table

_BEYOND_M = 180.0
"""Streets lead out of the grid this far."""
_STRIP_M = 12.0
_ROAD_M = 7.0
_KERB_M = 7.3
_CROSSING_M = 12.6
_WALLS = np.array(
    # Brick, cream, concrete, sand, dark brick, white plaster, grey glass, ochre: red, green, blue.
    [
        [150, 88, 72],
        [205, 190, 160],
        [142, 142, 140],
        [186, 160, 126],
        [108, 74, 66],
        [214, 212, 205],
        [112, 124, 134],
        [190, 146, 92],
    ]
)
_SIGNS = np.array([[190, 30, 35], [30, 80, 165], [235, 200, 40], [235, 235, 235], [25, 115, 70]])
_GABLE_M = 11.0
_TREE_SHARE = 0.5
_Lay = Callable[[int, bool, Floats, Floats], None]
_ARM_BELOW_M = 7.0
"""Lights nearer than this to the axis of their street hang on a mast arm."""


@dataclass(frozen=True, eq=False)
class GroundQuads(Table):
    """Quadrangles (N, 4, 3) on the ground, in the order in which they lie on each other; colours (N, 3)."""

    corner_in_world_m: Floats
    color: Floats


@dataclass(frozen=True, eq=False)
class Fronts(Table):
    """House fronts: from `from_m` to `to_m` (N, 2) on the ground, seen from the side of `normal` (N, 2).

    `base_m` and `top_m` (N) are heights in the world; `windows` (N, 2) numbers of columns and of storeys,
    `number` (N) tells houses apart.
    """

    from_m: Floats
    to_m: Floats
    normal: Floats
    base_m: Floats
    top_m: Floats
    color: Floats
    windows: Ints
    number: Ints


@dataclass(frozen=True, eq=False)
class Bars(Table):
    """Poles and arms: from one end to the other (N, 3), so thick (N), in colours (N, 3); some carry a lamp."""

    from_in_world_m: Floats
    to_in_world_m: Floats
    thickness_m: Floats
    color: Floats
    is_street_lamp: Ints


@dataclass(frozen=True, eq=False)
class Signs(Table):
    """Traffic signs: centres (N, 3), radius (N), where they face (N, 2), colour (N, 3), corners (N)."""

    center_in_world_m: Floats
    radius_m: Floats
    normal: Floats
    color: Floats
    corners: Ints


@dataclass(frozen=True, eq=False)
class Trees(Table):
    """Trees: feet (N, 3), heights of the middle of the crown above the foot and radii (N), numbers (N)."""

    foot_in_world_m: Floats
    crown_m: Floats
    radius_m: Floats
    number: Ints


@dataclass(frozen=True, eq=False)
class Scenery:
    """All that stands still and is no light."""

    ground: GroundQuads
    fronts: Fronts
    bars: Bars
    signs: Signs
    trees: Trees


def build_scenery(city: City, *, seed: int) -> Scenery:
    """Furnish a city."""
    street_bars, signs, trees = _furnish(city.streets, seed)
    return Scenery(
        ground=_pave(city.streets, seed),
        fronts=_build_fronts(city.streets, seed),
        bars=join_rows(
            [
                _carry_lights(city.lights, city.streets, share_poles=True),
                _carry_lights(city.lookalikes, city.streets, share_poles=False),
                street_bars,
            ]
        ),
        signs=signs,
        trees=trees,
    )


def approach_of(targets: Targets, streets: Streets) -> Ints:
    """Return intersections and directions of travel (N, 3) that targets serve: i, j, k."""
    position = targets.position_in_world_m
    i = np.argmin(np.abs(position[:, :1] - streets.x_m), axis=1)
    j = np.argmin(np.abs(position[:, 1:2] - streets.y_m), axis=1)
    quarter = np.round((targets.facing_rad + np.pi) / (np.pi / 2.0)).astype(np.int64) % 4
    return np.stack([i, j, quarter], axis=1)


def _pave(streets: Streets, seed: int) -> GroundQuads:
    """Lay pavement, kerbs, road, repairs and markings, in this order."""
    random = random_stream(seed, "ground")
    layers: list[list[Floats]] = [[] for _ in range(5)]
    colors: list[list[Floats]] = [[] for _ in range(5)]

    def lay(layer: int, along_x: bool, rects: Floats, color: Floats) -> None:
        """Add rectangles (N, 4): along from, along to, across from, across to, of streets along x or y."""
        a0, a1, b0, b1 = rects.T
        corners = np.stack([np.stack([a0, a1, a1, a0], 1), np.stack([b0, b0, b1, b1], 1)], axis=2)
        layers[layer].append(corners if along_x else corners[:, :, ::-1])
        colors[layer].append(np.broadcast_to(color, (len(rects), 3)).astype(np.float64))

    for along_x in (True, False):
        axes, crossings = (streets.y_m, streets.x_m) if along_x else (streets.x_m, streets.y_m)
        for axis in axes:
            edges = np.arange(crossings[0] - _BEYOND_M, crossings[-1] + _BEYOND_M, _STRIP_M)
            strips = np.stack([edges, edges + _STRIP_M], axis=1)
            for layer, half_m, grey in ((0, streets.half_width_m, 132.0), (1, _KERB_M, 168.0), (2, _ROAD_M, 84.0)):
                # No two strips are of quite the same colour.
                tint = grey + random.normal(0.0, 0.018 * grey, (len(strips), 1)) + np.array([[0.0, 0.0, 2.0]])
                lay(layer, along_x, _across(strips, axis - half_m, axis + half_m), tint)
            count = len(strips)
            at = random.uniform(edges[0], edges[-1], count)
            aside = axis + random.uniform(-_ROAD_M, _ROAD_M - 2.0, count)
            size = random.uniform(0.6, 5.0, (count, 2)) * [1.4, 0.45]
            patches = np.stack([at, at + size[:, 0], aside, aside + size[:, 1]], axis=1)
            lay(3, along_x, patches, 84.0 + random.choice([-16.0, -9.0, 8.0], (count, 1)))
            _mark(lay, along_x, axis, crossings, random)
    ground_m = np.concatenate([np.concatenate(layer) for layer in layers])
    height_m = streets.hills.height_m(ground_m.reshape(-1, 2)).reshape(len(ground_m), 4)
    return GroundQuads(
        corner_in_world_m=np.concatenate([ground_m, height_m[:, :, None]], axis=2),
        color=np.concatenate([np.concatenate(layer) for layer in colors]),
    )


def _mark(lay: _Lay, along_x: bool, axis: float, crossings: Floats, random: np.random.Generator) -> None:
    """Paint the lines of one street: centre lines, lane dashes, stop lines, crossings for people."""
    white, yellow = np.array([205.0, 205.0, 198.0]), np.array([205.0, 165.0, 60.0])
    worn = random.uniform(0.8, 1.0)
    ends = np.concatenate([[crossings[0] - _BEYOND_M], crossings, [crossings[-1] + _BEYOND_M]])
    starts, stops = ends[:-1] + _CROSSING_M, ends[1:] - _CROSSING_M
    for start, stop in zip(starts, stops, strict=True):
        pieces = np.linspace(start, stop, max(2, round((stop - start) / _STRIP_M)))
        strips = np.stack([pieces[:-1], pieces[1:]], axis=1)
        for side in (-0.18, 0.18):
            lay(4, along_x, _across(strips, axis + side - 0.06, axis + side + 0.06), worn * yellow)
        dashes = np.arange(start + 2.0, stop - 3.0, 9.0)
        for side in (-3.5, 3.5):
            lay(
                4,
                along_x,
                _across(np.stack([dashes, dashes + 3.0], 1), axis + side - 0.07, axis + side + 0.07),
                worn * white,
            )
    for sign in (-1.0, 1.0):
        # Who drives along +x keeps to -y, who drives along +y keeps to +x.
        low, high = (0.3, 6.8) if (sign > 0) == along_x else (-6.8, -0.3)
        at = np.sort(np.stack([crossings + sign * 12.2, crossings + sign * 12.65], axis=1), axis=1)
        lay(4, along_x, _across(at, axis + low, axis + high), worn * white)
        bars = np.sort(np.stack([crossings + sign * 8.0, crossings + sign * 11.0], axis=1), axis=1)
        for across in np.arange(-6.4, 6.0, 1.15):
            lay(4, along_x, _across(bars, axis + across, axis + across + 0.5), worn * white)


def _across(along: Floats, low: float, high: float) -> Floats:
    sides = np.broadcast_to([low, high], (len(along), 2))
    return np.concatenate([along, sides], axis=1)


def _build_fronts(streets: Streets, seed: int) -> Fronts:
    """Build the four fronts of every block as rows of houses."""
    random = random_stream(seed, "houses")
    half_m = streets.half_width_m
    lows_x, highs_x = _gaps(streets.x_m, half_m)
    lows_y, highs_y = _gaps(streets.y_m, half_m)
    pieces: list[Floats] = []
    for x0, x1 in zip(lows_x, highs_x, strict=True):
        for y0, y1 in zip(lows_y, highs_y, strict=True):
            for start, stop, fixed, is_x, normal in (
                (x0, x1, y0, True, (0.0, -1.0)),
                (x0, x1, y1, True, (0.0, 1.0)),
                (y0, y1, x0, False, (-1.0, 0.0)),
                (y0, y1, x1, False, (1.0, 0.0)),
            ):
                cuts = _cut(start, stop, random)
                along, across = np.stack([cuts[:-1], cuts[1:]], 1), np.full((len(cuts) - 1, 2), fixed)
                points = np.stack([along, across] if is_x else [across, along], axis=2)
                pieces.append(np.concatenate([points.reshape(-1, 4), np.tile(normal, (len(points), 1))], axis=1))
    rows = np.concatenate(pieces)
    from_m, to_m = rows[:, :2], rows[:, 2:4]
    count = len(rows)
    base = np.minimum(streets.hills.height_m(from_m), streets.hills.height_m(to_m)) - 0.3
    top = base + 1.5 + 3.3 * random.integers(2, 8, count) + random.uniform(0.0, 0.8, count)
    top = _even_at_corners(top, from_m, to_m)
    storeys = np.floor((top - base - 1.5) / 3.3).astype(np.int64)
    width_m = np.linalg.norm(to_m - from_m, axis=1)
    color = _WALLS[random.integers(0, len(_WALLS), count)] * random.uniform(0.8, 1.1, (count, 1))
    fronts = Fronts(
        from_m=from_m,
        to_m=to_m,
        normal=rows[:, 4:],
        base_m=base,
        top_m=top,
        color=color,
        windows=np.stack([np.maximum(1, np.round(width_m / random.uniform(2.2, 3.6, count))), storeys], 1).astype(
            np.int64
        ),
        number=np.arange(count),
    )
    return join_rows([fronts, _gables(fronts)])


def _even_at_corners(top_m: Floats, from_m: Floats, to_m: Floats) -> Floats:
    """Return heights (N) of roofs such that the two fronts of a house at a corner have the same."""
    ends = np.round(np.concatenate([from_m, to_m]), 6)
    place = np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1)
    runs_along_x = np.tile(np.equal(from_m[:, 1], to_m[:, 1]), 2)
    met = np.zeros((place.max() + 1, 2), dtype=np.int64)
    np.add.at(met, (place, runs_along_x.astype(np.int64)), 1)
    is_corner = (met.min(axis=1) > 0)[place]
    highest_m = np.full(len(met), -np.inf)
    front = np.tile(np.arange(len(top_m)), 2)[is_corner]
    np.maximum.at(highest_m, place[is_corner], top_m[front])
    even_m = top_m.copy()
    np.maximum.at(even_m, front, highest_m[place[is_corner]])
    return even_m


def _gables(fronts: Fronts) -> Fronts:
    """Return the walls, without windows, by which houses rise above their neighbours."""
    lowest, highest = np.minimum(fronts.from_m, fronts.to_m), np.maximum(fronts.from_m, fronts.to_m)
    inward = -fronts.normal * _GABLE_M
    along = np.abs(fronts.normal[:, ::-1])
    parts = []
    for corner, other, normal in ((lowest, highest, -along), (highest, lowest, along)):
        # The neighbour of a house is the one before or after it, if it ends where this one begins.
        step = -1 if corner is lowest else 1
        neighbour = np.clip(np.arange(len(fronts)) + step, 0, len(fronts) - 1)
        touches = np.all(np.abs(np.roll(other, -step, axis=0) - corner) < 1e-6, axis=1)
        touches &= np.all(fronts.normal[neighbour] == fronts.normal, axis=1)
        rows = np.flatnonzero(touches & (fronts.top_m > fronts.top_m[neighbour] + 0.3))
        parts.append(
            fronts.take(rows).replace(
                from_m=corner[rows],
                to_m=corner[rows] + inward[rows],
                normal=normal[rows],
                base_m=fronts.top_m[neighbour[rows]] - 0.3,
                color=0.92 * fronts.color[rows],
                windows=np.zeros((len(rows), 2), dtype=np.int64),
            )
        )
    return join_rows(parts)


def _gaps(axes_m: Floats, half_m: float) -> tuple[Floats, Floats]:
    """Return where blocks begin and end between streets, with those outside the grid."""
    low = np.concatenate([[axes_m[0] - _BEYOND_M], axes_m + half_m])
    high = np.concatenate([axes_m - half_m, [axes_m[-1] + _BEYOND_M]])
    return low, high


def _cut(start: float, stop: float, random: np.random.Generator) -> Floats:
    """Cut a front into houses of 9 to 20 m."""
    count = max(1, round((stop - start) / 14.0))
    inner = np.linspace(start, stop, count + 1)
    inner[1:-1] += random.uniform(-2.5, 2.5, max(0, count - 1))
    return inner


def _carry_lights(lights: Targets, streets: Streets, *, share_poles: bool) -> Bars:
    """Put up poles, mast arms and brackets, behind the lights."""
    if len(lights) == 0:
        return _no_bars()
    approach = approach_of(lights, streets)
    ahead = DIRECTIONS[approach[:, 2]]
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    from_center = lights.position_in_world_m[:, :2] - streets.center_m(approach[:, :2])
    place_m = np.stack([(from_center * ahead).sum(axis=1), (from_center * left).sum(axis=1)], axis=1)
    height_m = lights.position_in_world_m[:, 2]
    half_m = lights.size_m[:, 1] / 2.0
    on_arm = np.abs(place_m[:, 1]) < _ARM_BELOW_M
    # Everything on one side of an approach shares a pole, which stands behind it.
    side = np.where(on_arm | (place_m[:, 1] < 0.0), -1, 1)
    apart = np.zeros(len(lights)) if share_poles else np.arange(len(lights))
    group = np.column_stack([approach, place_m[:, 0] > 0.0, side, apart])
    _, shared = np.unique(group, axis=0, return_inverse=True)
    shared = shared.reshape(-1)
    behind_m = np.full(shared.max() + 1, -np.inf)
    np.maximum.at(behind_m, shared, place_m[:, 0] + 0.35)
    aside_m = np.where(side < 0, -8.0, 10.0)
    aside_m = aside_m if share_poles else place_m[:, 1]
    foot = streets.center_m(approach[:, :2]) + behind_m[shared, None] * ahead + aside_m[:, None] * left
    foot_m = streets.hills.height_m(foot)
    top_m = np.full(shared.max() + 1, -np.inf)
    np.maximum.at(top_m, shared, height_m + half_m + np.where(on_arm, 0.25, 0.1))
    first = np.unique(shared, return_index=True)[1]
    poles = _bars(_at(foot, foot_m)[first], _at(foot, top_m[shared])[first], 0.19, 72.0)
    # An arm goes above its light, a bracket behind it.
    hold_m = np.where(on_arm, height_m + half_m + 0.12, height_m)
    tip = streets.center_m(approach[:, :2]) + (place_m[:, :1] + np.where(on_arm, 0.1, 0.2)[:, None]) * ahead
    tip = tip + (place_m[:, 1] + np.where(on_arm, 0.3, 0.0))[:, None] * left
    arms = _bars(_at(foot, hold_m), _at(tip, hold_m), 0.12, 72.0)
    return join_rows([poles, arms])


def _furnish(streets: Streets, seed: int) -> tuple[Bars, Signs, Trees]:
    """Put street lamps, signs and trees along the pavements.

    Trees stand so near the houses that they hide no light from those who drive toward it.
    """
    random = random_stream(seed, "furniture")
    lamps: list[Floats] = []
    signs: list[Floats] = []
    trees: list[Floats] = []
    for along_x in (True, False):
        axes, crossings = (streets.y_m, streets.x_m) if along_x else (streets.x_m, streets.y_m)
        for axis in axes:
            for side in (-1.0, 1.0):
                for spacing_m, aside_m, found in ((30.0, 11.2, lamps), (42.0, 8.6, signs), (14.0, 12.2, trees)):
                    start_m = crossings[0] - _BEYOND_M + random.uniform(0.0, spacing_m)
                    at = np.arange(start_m, crossings[-1] + _BEYOND_M, spacing_m)
                    at = at + random.uniform(-4.0, 4.0, len(at))
                    at = at[np.min(np.abs(at[:, None] - crossings), axis=1) > 16.0]
                    across = np.full(len(at), axis + side * aside_m)
                    # Traffic signs face those who drive on their side of the street.
                    toward = np.full(len(at), side if along_x else -side)
                    flat = np.zeros(len(at))
                    found.append(np.column_stack([at, across, toward, flat] if along_x else [across, at, flat, toward]))
    lamp, sign, tree = np.concatenate(lamps), np.concatenate(signs), np.concatenate(trees)
    lamp_m, sign_m = streets.hills.height_m(lamp[:, :2]), streets.hills.height_m(sign[:, :2])
    poles = _bars(_at(lamp[:, :2], lamp_m), _at(lamp[:, :2], lamp_m + 7.5), 0.14, 58.0, is_street_lamp=1)
    posts = _bars(_at(sign[:, :2], sign_m), _at(sign[:, :2], sign_m + 2.7), 0.07, 120.0)
    count = len(sign)
    kind = random.integers(0, len(_SIGNS), count)
    plates = Signs(
        center_in_world_m=_at(sign[:, :2] - 0.06 * sign[:, 2:], sign_m + 2.45),
        radius_m=random.uniform(0.3, 0.42, count),
        normal=-sign[:, 2:],
        color=_SIGNS[kind].astype(np.float64),
        corners=np.array([8, 24, 4, 4, 4])[kind],
    )
    tree = tree[random.random(len(tree)) < _TREE_SHARE]
    foot = _at(tree[:, :2], streets.hills.height_m(tree[:, :2]))
    radius_m = random.uniform(1.3, 1.9, len(tree))
    crown_m = 2.4 + radius_m + random.uniform(0.0, 0.8, len(tree))
    trunks = _bars(foot, foot + crown_m[:, None] * [0.0, 0.0, 1.0], 0.22, 66.0)
    crowns = Trees(foot, crown_m, radius_m, np.arange(len(tree)))
    return join_rows([poles, posts, trunks]), plates, crowns


def _bars(start: Floats, end: Floats, thickness_m: float, grey: float, *, is_street_lamp: int = 0) -> Bars:
    count = len(start)
    return Bars(
        from_in_world_m=start,
        to_in_world_m=end,
        thickness_m=np.full(count, thickness_m),
        color=np.full((count, 3), grey),
        is_street_lamp=np.full(count, is_street_lamp, dtype=np.int64),
    )


def _no_bars() -> Bars:
    return _bars(np.empty((0, 3)), np.empty((0, 3)), 0.0, 0.0)


def _at(ground_m: Floats, height_m: Floats) -> Floats:
    return np.column_stack([ground_m, height_m])
