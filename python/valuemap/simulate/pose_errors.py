"""How wrong the recorded poses are: parts of each image of its own, parts that drift along a pass, and faults."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats
from valuemap.config import SimulationConfig
from valuemap.simulate.drives import Frames
from valuemap.simulate.streams import random_stream


def pose_errors(frames: Frames, config: SimulationConfig, *, seed: int) -> tuple[Floats, Floats]:
    """Return errors of positions (N, 3), m in the world, and of rotations (N, 3), rotation vectors in camera axes.

    `frames` are of one camera: those of the other cameras of a car share them.
    """
    parts_m = config.position_white_m, config.position_drift_m, config.position_middle_m
    parts_rad = tuple(np.radians([config.rotation_white_deg, config.rotation_drift_deg, config.rotation_middle_deg]))
    position_m = _errors(frames, parts_m, config, seed, "position")
    rotation_rad = _errors(frames, parts_rad, config, seed, "rotation")
    if config.pass_shift_m or config.jump_m:
        position_m[:, :2] += _shifts(frames, config, seed) + _jumps(frames, config, seed)
    if config.pass_height_m:
        is_higher = _of_passes(frames, seed, "height") < 0.5
        position_m[:, 2] += config.pass_height_m * np.where(is_higher, 1.0, -1.0)
    if config.pass_yaw_deg:
        is_left = _of_passes(frames, seed, "yaw") < 0.5
        # Up in camera axes, but for its pitch: y is down.
        rotation_rad[:, 1] += np.radians(config.pass_yaw_deg) * np.where(is_left, 1.0, -1.0)
    return position_m, rotation_rad


def _errors(
    frames: Frames, white_drift_middle: tuple[float, ...], config: SimulationConfig, seed: int, what: str
) -> Floats:
    white, drift, middle = white_drift_middle
    own = random_stream(seed, what, "white").standard_normal((len(frames), 3))
    steps = random_stream(seed, what, "drift").standard_normal((len(frames), 3))
    errors = white * own + drift * _drift_along_passes(frames, config.drift_length_m, steps)
    if middle:
        steps = random_stream(seed, what, "middle").standard_normal((len(frames), 3))
        errors += middle * _drift_along_passes(frames, config.middle_length_m, steps)
    return errors


def _shifts(frames: Frames, config: SimulationConfig, seed: int) -> Floats:
    """Return the shift (N, 2) on the ground of the pass of each image."""
    return config.pass_shift_m * _towards(2.0 * np.pi * _of_passes(frames, seed, "shift"))


def _jumps(frames: Frames, config: SimulationConfig, seed: int) -> Floats:
    """Return by how much (N, 2) on the ground images are off that lie between a jump and the jump back."""
    step_m = np.diff(frames.distance_m, prepend=0.0)
    step_m[np.diff(frames.pass_row, prepend=-1) != 0] = 0.0
    chance = -np.expm1(-config.jumps_per_km * step_m / 1000.0)
    changes = random_stream(seed, "jumps").random(len(frames)) < chance
    starts = np.diff(frames.pass_row, prepend=-1) != 0
    before = np.cumsum(changes)
    in_pass = before - np.repeat(before[starts], np.diff(np.append(np.flatnonzero(starts), len(frames))))
    direction_rad = 2.0 * np.pi * random_stream(seed, "jumps", "direction").random(int(before[-1]) + 1)
    is_off = in_pass % 2 == 1
    jumps: Floats = config.jump_m * is_off[:, None] * _towards(direction_rad[before])
    return jumps


def _of_passes(frames: Frames, seed: int, what: str) -> Floats:
    """Return a uniform random number (N) of the pass of each image."""
    return random_stream(seed, "pass", what).random(int(frames.pass_row.max()) + 1)[frames.pass_row]


def _towards(angle_rad: Floats) -> Floats:
    return np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)


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
