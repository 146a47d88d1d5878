"""How wrong the recorded poses are: a part of each image of its own, and a part that drifts along a pass."""

from __future__ import annotations

import numpy as np

from valuemap.config import SimulationConfig
from valuemap.simulate.drives import Frames
from valuemap.simulate.streams import random_stream
from valuemap.tables import Floats


def pose_errors(frames: Frames, config: SimulationConfig, *, seed: int) -> tuple[Floats, Floats]:
    """Return errors of positions (N, 3), m in the world, and of rotations (N, 3), rotation vectors in camera axes."""
    white_rad, drift_rad = np.radians([config.rotation_white_deg, config.rotation_drift_deg])
    length_m = config.drift_length_m
    return (
        _errors(frames, config.position_white_m, config.position_drift_m, length_m, seed, "position"),
        _errors(frames, white_rad, drift_rad, length_m, seed, "rotation"),
    )


def _errors(frames: Frames, white: float, drift: float, length_m: float, seed: int, what: str) -> Floats:
    own = random_stream(seed, what, "white").standard_normal((len(frames), 3))
    steps = random_stream(seed, what, "drift").standard_normal((len(frames), 3))
    return white * own + drift * _drift_along_passes(frames, length_m, steps)


def _drift_along_passes(frames: Frames, length_m: float, normal: Floats) -> Floats:
    """Return unit Ornstein-Uhlenbeck processes (N, M) over the distance driven, from normal numbers (N, M).

    x_i = n_i at the start of each pass, then x_i = a_i x_(i-1) + sqrt(1 - a_i^2) n_i, a_i = exp(-step_i / length).
    """
    keep = np.exp(-np.abs(np.diff(frames.distance_m, prepend=0.0)) / length_m)
    keep[np.diff(frames.pass_row, prepend=-1) != 0] = 0.0
    return _recur(keep, np.sqrt(1.0 - keep**2)[:, None] * normal)


def _recur(factor: Floats, addend: Floats) -> Floats:
    """Return x (N, M) with x_i = factor_i x_(i-1) + addend_i and nothing before the first.

    Each round doubles the reach: x_i = reach_i x_(i-step) + total_i holds with `step` twice as long.
    """
    total, reach = addend.copy(), factor.copy()
    step = 1
    while step < len(factor) and np.any(reach[step:]):
        total[step:] += reach[step:, None] * total[:-step]
        reach[step:] = reach[step:] * reach[:-step]
        step *= 2
    return total
