"""The line a car follows on its route: in its lane, on the right, and round the corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.simulate.routes import Route
from valuemap.simulate.streets import DIRECTIONS, Streets

_RIGHT_TURN_RADIUS_M = 6.0
_LEFT_TURN_RADIUS_M = 8.0


@dataclass(frozen=True, eq=False)
class Path:
    """N straights, each followed by a quarter of a circle where the car turns.

    Straights start at `start_m` (N, 2) and go `direction` (N) for `straight_m` (N); the curve after one has
    `radius_m` (N, 0 for none) and goes left (`turn` +1) or right (-1). `from_m` (N + 1) is the distance along
    the path at which each straight begins, `middle_at_m` (N) that of the middle of the intersection after it.
    """

    start_m: Floats
    direction: Ints
    straight_m: Floats
    radius_m: Floats
    turn: Ints
    from_m: Floats
    middle_at_m: Floats

    def walk(self, distance_m: Floats) -> tuple[Floats, Floats]:
        """Return the ground points (N, 2) and headings (N), counter-clockwise from east, at distances (N)."""
        last = len(self.direction) - 1
        piece = np.minimum(np.searchsorted(self.from_m, distance_m, side="right") - 1, last)
        along_m = distance_m - self.from_m[piece]
        straight_m, radius_m, turn = self.straight_m[piece], self.radius_m[piece], self.turn[piece]
        ahead = DIRECTIONS[self.direction[piece]]
        inward = turn[:, None] * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        turns = radius_m > 0.0
        angle: Floats = np.where(turns, np.maximum(along_m - straight_m, 0.0) / np.where(turns, radius_m, 1.0), 0.0)
        ahead_m = np.where(turns, np.minimum(along_m, straight_m), along_m) + radius_m * np.sin(angle)
        inward_m = radius_m * (1.0 - np.cos(angle))
        ground = self.start_m[piece] + ahead_m[:, None] * ahead + inward_m[:, None] * inward
        return ground, self.direction[piece] * (np.pi / 2.0) + turn * angle


def lay_path(route: Route, streets: Streets, lane_m: float) -> Path:
    """Return the path of a route in the lane that is `lane_m` to the right of the streets' axes."""
    ahead = DIRECTIONS[route.direction]
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    turn = (np.diff(route.direction, append=route.direction[-1]) + 1) % 4 - 1
    radius_m = np.choose(turn + 1, [_RIGHT_TURN_RADIUS_M, 0.0, _LEFT_TURN_RADIUS_M])
    # A corner is where the lanes before and after an intersection meet; straight on, it is the same lane.
    right_after = np.where((turn == 0)[:, None], 0.0, np.roll(right, -1, axis=0))
    aside = lane_m * np.concatenate([right[:1], right + right_after])
    corner = streets.center_m(route.intersection) + aside
    start = corner[:-1] + np.concatenate([[0.0], radius_m[:-1]])[:, None] * ahead
    straight_m = ((corner[1:] - start) * ahead).sum(axis=1) - radius_m
    curve_m = radius_m * np.pi / 2.0
    from_m = np.concatenate([[0.0], np.cumsum(straight_m + curve_m)])
    return Path(start, route.direction, straight_m, radius_m, turn, from_m, from_m[1:] - curve_m / 2.0)
