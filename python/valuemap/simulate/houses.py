"""The houses that the pictures show: closed fronts around every block, the ones that hide lights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.simulate.pavement import BEYOND_M
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import Streets
from valuemap.tables import Table

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
_GABLE_M = 11.0


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


def build_fronts(streets: Streets, seed: int) -> Fronts:
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
    low = np.concatenate([[axes_m[0] - BEYOND_M], axes_m + half_m])
    high = np.concatenate([axes_m - half_m, [axes_m[-1] + BEYOND_M]])
    return low, high


def _cut(start: float, stop: float, random: np.random.Generator) -> Floats:
    """Cut a front into houses of 9 to 20 m."""
    count = max(1, round((stop - start) / 14.0))
    inner = np.linspace(start, stop, count + 1)
    inner[1:-1] += random.uniform(-2.5, 2.5, max(0, count - 1))
    return inner
