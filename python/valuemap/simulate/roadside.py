"""What stands in rows along the streets: signs side by side, street lamps, trees and posts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints, rows_in_runs
from valuemap.config import SimulationConfig
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import DIRECTIONS, Streets
from valuemap.simulate.targets import CLASSES, Targets

_FREE_OF_CROSSING_M = 3.0
"""How far rows end before the houses at an intersection."""
_SIGNS_FROM_AXIS_M = (7.0, 7.6)
_SIGN_SIZE_M = (0.6, 0.6)
_SIGN_ABOVE_M = 2.4
_SIGN_AIM_JITTER_RAD = np.radians(5.0)
_SIGN_JITTER_M = 0.02


@dataclass(frozen=True)
class _Kind:
    """One kind of thing that stands on both sides and is seen from all sides.

    `size_m` is width and height, `above_m` the height of the middle above the street, `jitter_share` how far a place
    is off its even spacing and `jitter_m` off the line and its height, both at most.
    """

    name: str
    size_m: tuple[float, float]
    from_axis_m: float
    above_m: float
    jitter_share: float
    jitter_m: float


_LAMP = _Kind("street_lamp", (0.7, 0.4), 7.2, 7.0, 0.05, 0.3)
_TREE = _Kind("tree", (1.5, 3.0), 8.8, 2.2, 0.1, 0.4)
_POST = _Kind("post", (0.15, 1.0), 7.0, 0.5, 0.02, 0.05)


def place_roadside(config: SimulationConfig, streets: Streets, *, seed: int) -> Targets:
    """Return all that stands along the streets, kind by kind; nothing where all spacings are 0."""
    parts = [_signs(config, streets, random_stream(seed, "signs"))]
    for kind, spacing_m in (
        (_LAMP, config.lamp_spacing_m),
        (_TREE, config.tree_spacing_m),
        (_POST, config.post_spacing_m),
    ):
        parts.append(_along_both_sides(kind, spacing_m, streets, random_stream(seed, kind.name)))
    return join_rows(parts)


def _signs(config: SimulationConfig, streets: Streets, random: np.random.Generator) -> Targets:
    """Return rows of signs on the right of each street, in each direction: side by side, facing the traffic."""
    start, direction = _places(streets, config.sign_row_spacing_m)
    rows = len(start)
    at_m = start + 0.1 * config.sign_row_spacing_m * random.uniform(-1.0, 1.0, rows)[:, None] * DIRECTIONS[direction]
    from_axis_m = random.uniform(*_SIGNS_FROM_AXIS_M, rows)
    facing_rad = direction * (np.pi / 2.0) + np.pi + _SIGN_AIM_JITTER_RAD * random.uniform(-1.0, 1.0, rows)
    count = random.integers(config.min_row_signs, config.max_row_signs + 1, rows)
    row = np.repeat(np.arange(rows), count)
    number = rows_in_runs(0, count)
    ahead = DIRECTIONS[direction[row]]
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    jitter_m = _SIGN_JITTER_M * random.uniform(-1.0, 1.0, (len(row), 3))
    ground = at_m[row] + (from_axis_m[row] + number * config.sign_apart_m)[:, None] * right + jitter_m[:, :2]
    return _targets("traffic_sign", _SIGN_SIZE_M, ground, _SIGN_ABOVE_M + jitter_m[:, 2], streets, facing_rad[row])


def _along_both_sides(kind: _Kind, spacing_m: float, streets: Streets, random: np.random.Generator) -> Targets:
    """Return things on both sides of each street."""
    # The right side of both directions is both sides.
    start, direction = _places(streets, spacing_m)
    jitter = random.uniform(-1.0, 1.0, (len(start), 3))
    ahead = DIRECTIONS[direction]
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    along_m = kind.jitter_share * spacing_m * jitter[:, :1]
    ground = start + along_m * ahead + (kind.from_axis_m + kind.jitter_m * jitter[:, 1:2]) * right
    above_m = kind.above_m + kind.jitter_m * jitter[:, 2]
    return _targets(kind.name, kind.size_m, ground, above_m, streets, None)


def _places(streets: Streets, spacing_m: float) -> tuple[Floats, Ints]:
    """Return points on the axes of the streets (N, 2), evenly apart between intersections, and their directions (N)."""
    points: list[Floats] = [np.empty((0, 2))]
    ways: list[Ints] = [np.empty(0, dtype=np.int64)]
    if spacing_m > 0.0:
        free_m = streets.half_width_m + _FREE_OF_CROSSING_M
        for i, j, k in np.argwhere(streets.can_leave()):
            here = np.array([i, j])
            ends = streets.center_m(np.stack([here, here + DIRECTIONS[k].astype(np.int64)]))
            length_m = float(np.abs(ends[1] - ends[0]).sum()) - 2.0 * free_m
            count = max(1, round(length_m / spacing_m))
            along_m = free_m + length_m / 2.0 + spacing_m * (np.arange(count) - (count - 1) / 2.0)
            points.append(ends[0] + along_m[:, None] * DIRECTIONS[k])
            ways.append(np.full(count, k, dtype=np.int64))
    return np.concatenate(points), np.concatenate(ways)


def _targets(
    class_name: str,
    size_m: tuple[float, float],
    ground_m: Floats,
    above_m: Floats,
    streets: Streets,
    facing_rad: Floats | None,
) -> Targets:
    count = len(ground_m)
    return Targets(
        position_in_world_m=np.column_stack([ground_m, streets.hills.height_m(ground_m) + above_m]),
        facing_rad=np.zeros(count) if facing_rad is None else facing_rad,
        size_m=np.broadcast_to(size_m, (count, 2)),
        recall_share=np.ones(count),
        pass_row=np.full(count, -1, dtype=np.int64),
        class_code=np.full(count, CLASSES.index(class_name)),
        is_round=np.full(count, facing_rad is None),
        uneven_m=np.zeros((count, 4)),
    )
