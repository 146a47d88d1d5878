"""Other vehicles: those that drive and wait along the streets, and those that hide lights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.simulate.canvas import View
from valuemap.simulate.drives import Frames
from valuemap.simulate.sightings import Sightings
from valuemap.simulate.streams import hash01, random_stream
from valuemap.simulate.streets import DIRECTIONS, Streets
from valuemap.tables import Table

CAR, TRUCK, COACH = range(3)
SIZES_M: Floats = np.array([[4.4, 1.8, 1.45], [8.0, 2.5, 3.8], [11.0, 2.5, 3.8]])
"""Length, width and height by kind."""

_COLORS = np.array(
    [[40, 42, 46], [200, 202, 204], [122, 126, 130], [148, 26, 28], [34, 58, 116], [232, 232, 228], [70, 84, 70]]
)
_IN_SIGHT_M = 90.0
_LANES_M = (1.75, 5.25)
_SLOT_M = 26.0
_STOP_M = 15.0
_SPEED_MPS = 8.0


@dataclass(frozen=True, eq=False)
class Vehicles(Table):
    """Vehicles around one camera: kind, middle on the ground (N, 3), direction of travel (N, 2), colour (N, 3)."""

    kind: Ints
    ground_in_world_m: Floats
    ahead: Floats
    color: Floats

    def corners_m(self) -> Floats:
        """Return the corners (N, 8, 3) of their boxes: rear left, rear right, front right, front left, below, above."""
        size = SIZES_M[self.kind]
        left = np.stack([-self.ahead[:, 1], self.ahead[:, 0]], axis=1)
        along = np.array([-0.5, -0.5, 0.5, 0.5]) * size[:, :1]
        across = np.array([0.5, -0.5, -0.5, 0.5]) * size[:, 1:2]
        flat = along[:, :, None] * self.ahead[:, None] + across[:, :, None] * left[:, None]
        flat = np.concatenate([flat, flat], axis=1) + self.ground_in_world_m[:, None, :2]
        above = np.repeat([[0.0, 1.0]], 4, axis=1) * size[:, 2:]
        height = self.ground_in_world_m[:, 2:] + above
        return np.concatenate([flat, height[:, :, None]], axis=2)


def vehicles_around(
    frames: Frames,
    row: int,
    view: View,
    streets: Streets,
    lights: Floats,
    shown: Sightings,
    hidden: Bools,
    *,
    seed: int,
) -> Vehicles:
    """Return the vehicles around one camera.

    `shown` are the sightings of lights (at `lights`, (L, 3)) in this image and `hidden` which of them traffic
    hides: a truck stands before each of these.
    """
    trucks = _before_hidden(frames, row, view, streets, lights, shown, hidden, seed)
    cars = _along_streets(frames, row, streets, seed)
    own = frames.center_in_world_m[row, :2]
    too_near = np.linalg.norm(cars[:, :2] - own, axis=1) < 6.0
    for truck in trucks:
        too_near |= np.linalg.norm(cars[:, :2] - truck[:2], axis=1) < 7.0
    cars = cars[~too_near]
    rows = np.concatenate([trucks, cars])
    own_direction = int(np.round(frames.heading_rad[row] / (np.pi / 2.0))) % 4
    tall = np.where(trucks[:, 3] == own_direction, TRUCK, COACH)
    number = rows[:, 4].astype(np.int64)
    return Vehicles(
        kind=np.concatenate([tall, np.full(len(cars), CAR)]),
        ground_in_world_m=np.column_stack([rows[:, :2], streets.hills.height_m(rows[:, :2])]),
        ahead=DIRECTIONS[rows[:, 3].astype(np.int64)],
        color=_COLORS[number % len(_COLORS)].astype(np.float64),
    )


def _along_streets(frames: Frames, row: int, streets: Streets, seed: int) -> Floats:
    """Return cars (N, 5) along the streets near the camera: x, y, unused, direction, number."""
    own = frames.center_in_world_m[row, :2]
    heading = frames.heading_rad[row]
    own_direction = int(np.round(heading / (np.pi / 2.0))) % 4
    pass_row, driven_m = int(frames.pass_row[row]), float(frames.distance_m[row])
    found: list[Floats] = []
    for along in (0, 1):
        axes, crossings = (streets.y_m, streets.x_m) if along == 0 else (streets.x_m, streets.y_m)
        for number in np.flatnonzero(np.abs(axes - own[1 - along]) < _IN_SIGHT_M):
            is_own = own_direction % 2 == along and abs(axes[number] - own[1 - along]) < 8.0
            for direction in (along, along + 2):
                sign = 1.0 if direction < 2 else -1.0
                # Traffic on the own street goes with us or toward us, that on others waits.
                drift = 0.0
                if is_own:
                    with_us = direction == own_direction
                    drift = sign * (0.85 * driven_m if with_us else _SPEED_MPS * float(frames.time_s[row] % 10_000.0))
                for lane, lane_m in enumerate(_LANES_M):
                    # Right of the axis, seen in the direction of travel.
                    across = axes[number] + lane_m * (-sign if along == 0 else sign)
                    if is_own and direction == own_direction and abs(across - own[1 - along]) < 1.7:
                        continue
                    first = np.floor((own[along] - _IN_SIGHT_M - drift) / _SLOT_M)
                    slots = first + np.arange(int(2.0 * _IN_SIGHT_M / _SLOT_M) + 1)
                    chance = hash01(slots, seed, pass_row, along, int(number), direction, lane)
                    at = slots * _SLOT_M + 16.0 * (chance * 7.0 % 1.0) + drift
                    kept = chance < 0.38
                    if not is_own:
                        # Who waits, waits before the crossing.
                        nearest = crossings[np.argmin(np.abs(at[:, None] - crossings), axis=1)]
                        kept &= np.abs(at - nearest) > _STOP_M
                    cars = np.full((int(kept.sum()), 5), float(direction))
                    cars[:, along], cars[:, 1 - along] = at[kept], across
                    cars[:, 4] = np.floor(chance[kept] * 1e4)
                    found.append(cars)
    lead = _lead(own, heading, pass_row, own_direction, streets, seed)
    return np.concatenate([*found, lead]) if found else lead


def _lead(own: Floats, heading: float, pass_row: int, direction: int, streets: Streets, seed: int) -> Floats:
    """Return the car that drives before ours, if there is one on this street."""
    ahead = DIRECTIONS[direction]
    across = 1 - direction % 2
    street = int(np.argmin(np.abs((streets.x_m, streets.y_m)[across] - own[across])))
    chance, far = random_stream(seed, "lead", pass_row, direction, street).random(2)
    if chance > 0.45 or np.array([np.cos(heading), np.sin(heading)]) @ ahead < 0.98:
        return np.empty((0, 5))
    place = own + (13.0 + 16.0 * far) * ahead
    return np.array([[place[0], place[1], 0.0, float(direction), np.floor(chance * 1e4)]])


def _farthest_that_hides(own: Floats, to_light: Floats, along_m: float, ahead: Floats, streets: Streets) -> float:
    """Return how far ahead a truck may be for its rear to reach above the line of sight to a light."""
    near_m = np.linspace(min(30.0, 0.7 * along_m), 2.5, 24)
    line_m = own[2] + (to_light[2] + 0.75) * near_m / max(along_m, 1.0)
    roof_m = streets.hills.height_m(own[:2] + near_m[:, None] * ahead) + SIZES_M[TRUCK, 2]
    high_enough = np.append(roof_m[:-1] > line_m[:-1] + 0.1, True)  # If none is, the nearest.
    return float(near_m[np.argmax(high_enough)])


def _before_hidden(
    frames: Frames,
    row: int,
    view: View,
    streets: Streets,
    lights: Floats,
    shown: Sightings,
    hidden: Bools,
    seed: int,
) -> Floats:
    """Return a truck or coach (N, 5) on the line of sight to each hidden light, so that it hides few others."""
    direction = int(np.round(frames.heading_rad[row] / (np.pi / 2.0))) % 4
    ahead = DIRECTIONS[direction]
    left = np.array([-ahead[1], ahead[0]])
    own = view.center_in_world_m
    width_m = SIZES_M[TRUCK, 1]
    axis_m = (streets.x_m, streets.y_m)[1 - direction % 2]
    trucks: list[Floats] = []
    to_light = lights[shown.target_row] - own
    along_m, aside_m = to_light[:, :2] @ ahead, to_light[:, :2] @ left
    for one in np.flatnonzero(hidden):
        near_m = _farthest_that_hides(own, to_light[one], float(along_m[one]), ahead, streets)
        at_rear = aside_m * near_m / np.maximum(along_m, 1.0)
        margin_m = 0.45 * near_m / max(along_m[one], 1.0) + 0.1
        choices = at_rear[one] + np.array([0.0, width_m / 2.0 - margin_m, margin_m - width_m / 2.0])
        others = at_rear[~hidden]
        covered = (np.abs(others[None] - choices[:, None]) < width_m / 2.0 + margin_m).sum(axis=1)
        best = choices[int(np.argmin(covered))]
        # On the left of the street it comes toward us.
        across = 1 - direction % 2
        from_axis = (own[:2] + best * left)[across] - axis_m[np.argmin(np.abs(axis_m - own[across]))]
        kind, goes = (COACH, (direction + 2) % 4) if from_axis * left[across] > 0.0 else (TRUCK, direction)
        place = own[:2] + (near_m + SIZES_M[kind, 0] / 2.0) * ahead + best * left
        look = random_stream(seed, "truck", int(frames.pass_row[row]), int(shown.target_row[one])).integers(0, 10_000)
        trucks.append(np.array([place[0], place[1], 0.0, float(goes), float(look)]))
    return np.array(trucks).reshape(-1, 5)
