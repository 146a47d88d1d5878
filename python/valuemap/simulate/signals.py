"""Which lamp of a light is lit: red while the car waits, and what agrees with that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.simulate.drives import Frames
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import Streets

RED, AMBER, GREEN = 0, 1, 2
_STILL_M = 1e-9
_RED_FROM_FAR = 0.35
_AMBER_LATE = 0.15


@dataclass(frozen=True, eq=False)
class Signals:
    """When cars of a pass waited for green: (pass, i, j, axis) to the time of the last image of the wait."""

    streets: Streets
    seed: int
    waited_until_s: dict[tuple[int, int, int, int], float]

    def lamps(self, frames: Frames, row: int, approach: Ints) -> Ints:
        """Return the lit lamp (N) of lights that serve approaches (N, 3), in one image."""
        pass_row = int(frames.pass_row[row])
        own_axis = int(np.round(frames.heading_rad[row] / (np.pi / 2.0))) % 2
        return np.array(
            [self._lamp(frames, row, pass_row, own_axis, int(i), int(j), int(k) % 2) for i, j, k in approach],
            dtype=np.int64,
        )

    def _lamp(self, frames: Frames, row: int, pass_row: int, own_axis: int, i: int, j: int, axis: int) -> int:
        for waiting_axis in (own_axis, 1 - own_axis):
            until_s = self.waited_until_s.get((pass_row, i, j, waiting_axis))
            if until_s is not None:
                has_red = frames.time_s[row] <= until_s
                return RED if has_red == (axis == waiting_axis) else GREEN
        middle = self.streets.center_m(np.array([[i, j]]))[0]
        distance_m = float(np.hypot(*(frames.center_in_world_m[row, :2] - middle)))
        chance, where = random_stream(self.seed, "signal", pass_row, i, j).random(2)
        is_red = chance < _RED_FROM_FAR and distance_m > 30.0 + 30.0 * where
        if axis != own_axis:
            return GREEN if is_red else RED
        if chance > 1.0 - _AMBER_LATE and distance_m < 12.0 + 15.0 * where:
            return AMBER
        return RED if is_red else GREEN


def time_signals(frames: Frames, streets: Streets, *, seed: int) -> Signals:
    """Find out from the drives which lights are red when."""
    stands = np.zeros(len(frames), dtype=np.bool_)
    still = (np.abs(np.diff(frames.distance_m)) < _STILL_M) & (np.diff(frames.pass_row) == 0)
    stands[1:] |= still
    stands[:-1] |= still
    stands &= np.isfinite(frames.signal_ahead_m)
    rows = np.flatnonzero(stands)
    heading = frames.heading_rad[rows]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    reached: Floats = frames.center_in_world_m[rows, :2] + frames.signal_ahead_m[rows, None] * ahead
    i = np.argmin(np.abs(reached[:, :1] - streets.x_m), axis=1)
    j = np.argmin(np.abs(reached[:, 1:] - streets.y_m), axis=1)
    axis = np.round(heading / (np.pi / 2.0)).astype(np.int64) % 2
    keys = zip(frames.pass_row[rows].tolist(), i.tolist(), j.tolist(), axis.tolist(), strict=True)
    return Signals(streets, seed, dict(zip(keys, frames.time_s[rows].tolist(), strict=True)))
