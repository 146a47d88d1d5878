"""What stands along the streets in the pictures: poles that carry lights, street lamps, signs and trees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.simulate.pavement import BEYOND_M
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import DIRECTIONS, Streets
from valuemap.simulate.targets import Targets
from valuemap.tables import Table

_SIGNS = np.array([[190, 30, 35], [30, 80, 165], [235, 200, 40], [235, 235, 235], [112, 72, 44]])
_ARM_BELOW_M = 7.0
"""Lights nearer than this to the axis of their street hang on a mast arm."""
_TREE_SHARE = 0.5


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


def approach_of(targets: Targets, streets: Streets) -> Ints:
    """Return intersections and directions of travel (N, 3) that targets serve: i, j, k."""
    position = targets.position_in_world_m
    i = np.argmin(np.abs(position[:, :1] - streets.x_m), axis=1)
    j = np.argmin(np.abs(position[:, 1:2] - streets.y_m), axis=1)
    quarter = np.round((targets.facing_rad + np.pi) / (np.pi / 2.0)).astype(np.int64) % 4
    return np.stack([i, j, quarter], axis=1)


def carry_lights(lights: Targets, streets: Streets, *, share_poles: bool) -> Bars:
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


def furnish(streets: Streets, seed: int) -> tuple[Bars, Signs, Trees]:
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
                    start_m = crossings[0] - BEYOND_M + random.uniform(0.0, spacing_m)
                    at = np.arange(start_m, crossings[-1] + BEYOND_M, spacing_m)
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
