"""The ground that the pictures show: pavements, kerbs, roads, repairs and markings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import Streets
from valuemap.tables import Table

BEYOND_M = 180.0
"""Streets lead out of the grid this far."""

_STRIP_M = 12.0
_ROAD_M = 7.0
_KERB_M = 7.3
_CROSSING_M = 12.6

_Lay = Callable[[int, bool, Floats, Floats], None]


@dataclass(frozen=True, eq=False)
class GroundQuads(Table):
    """Quadrangles (N, 4, 3) on the ground, in the order in which they lie on each other; colours (N, 3)."""

    corner_in_world_m: Floats
    color: Floats


def pave(streets: Streets, seed: int) -> GroundQuads:
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
            edges = np.arange(crossings[0] - BEYOND_M, crossings[-1] + BEYOND_M, _STRIP_M)
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
    ends = np.concatenate([[crossings[0] - BEYOND_M], crossings, [crossings[-1] + BEYOND_M]])
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
