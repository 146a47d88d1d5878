"""Where one pass goes on where another ends: at a seam of one drive the poses must not jump."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.check.sample import order_by_pass
from valuemap.dataset import Dataset

_GAP_STEPS = 3.5
"""A pass goes on with another where the other begins within so many steps of time after its last image."""
_MOST_STEPS = 8.0
"""Jumps of more steps are between drives that have nothing to do with each other."""
_LEAST_TIMES = 6.0
"""A jump is so many times as large as what nearly all successive images of single passes jump by."""
_NEARLY_ALL = 99.5
_SAME_WAY_COSINE = 0.9


@dataclass(frozen=True, eq=False)
class Seam:
    """Two passes that are one drive by their times, and the jump (3) in the world from where one ends to the other.

    `usual_m` is what nearly all successive images within passes jump by, `chance` that good data jump so.
    """

    before: str
    after: str
    jump_m: Floats
    forward: Floats
    speed_mps: float
    usual_m: float
    chance: float


def worst_seam(dataset: Dataset, center_in_world_m: Floats) -> Seam | None:
    """Return the seam at which poses jump most, None where they jump nowhere.

    The jump at an image is how far it is from where the two images before it lead, or how far the two after it lead
    from the image before, whichever is less: a turn at the seam is no jump.
    """
    images = dataset.images
    if images.timestamp_s is None or not np.all(np.isfinite(images.timestamp_s)):
        return None
    order = order_by_pass(images)
    starts = np.flatnonzero(np.diff(images.pass_id.codes[order], prepend=-1) != 0)
    passes = [rows for rows in np.split(order, starts[1:]) if len(rows) >= 2 * _EACH_SIDE]
    if len(passes) < 2:
        return None
    time, center = images.timestamp_s, center_in_world_m
    within = np.concatenate([_jumps(rows, time, center) for rows in passes])
    within = within[np.all(np.isfinite(within), axis=1)]
    if not len(within):
        return None
    usual_m = float(np.percentile(np.linalg.norm(within, axis=1), _NEARLY_ALL))
    step_s = float(np.median(np.concatenate([np.diff(time[rows]) for rows in passes])))
    steps_m = [np.linalg.norm(np.diff(center[rows], axis=0), axis=1) for rows in passes]
    step_m = float(np.median(np.concatenate(steps_m)))
    found: list[tuple[float, Seam]] = []
    for before, after in _successors(passes, time, images.camera_id, _GAP_STEPS * step_s):
        seam = np.concatenate([before[-_EACH_SIDE:], after[:_EACH_SIDE]])
        jump = _jumps(seam, time, center)[_EACH_SIDE - 2]
        size_m = float(np.linalg.norm(jump))
        forward, speed_mps = _motion(before[-_EACH_SIDE:], time, center)
        onwards, _ = _motion(after[:_EACH_SIDE], time, center)
        if not _LEAST_TIMES * usual_m < size_m <= _MOST_STEPS * step_m or float(forward @ onwards) < _SAME_WAY_COSINE:
            continue
        first, second = (images.pass_id.names[images.pass_id.codes[rows[0]]] for rows in (before, after))
        chance = len(passes) / (len(within) + 1.0)
        found.append((size_m, Seam(first, second, jump, forward, speed_mps, usual_m, chance)))
    return max(found, key=lambda each: each[0])[1] if found else None


_EACH_SIDE = 4
"""Images on each side of a seam that say how fast and which way the car drives."""


def _successors(passes: list[Ints], time: Floats, camera: Ints, gap_s: float) -> list[tuple[Ints, Ints]]:
    """Return pairs of passes of which the second begins just after the first ends, and after no other of its camera."""
    pairs = []
    for after in passes:
        begin = time[after[0]]
        before = [
            rows
            for rows in passes
            if 0.0 < begin - time[rows[-1]] <= gap_s and camera[rows[-1]] == camera[after[0]] and rows is not after
        ]
        if len(before) == 1:
            pairs.append((before[0], after))
    return pairs


def _jumps(rows: Ints, time: Floats, center: Floats) -> Floats:
    """Return the jump (N - 3, 3) between the second and third of each four successive images."""
    when, where = time[rows], center[rows]
    with np.errstate(divide="ignore", invalid="ignore"):  # Of images of one time no speed is known.
        before = (where[1:-2] - where[:-3]) / (when[1:-2] - when[:-3])[:, None]
        after = (where[3:] - where[2:-1]) / (when[3:] - when[2:-1])[:, None]
        gap = where[2:-1] - where[1:-2]
        seconds = (when[2:-1] - when[1:-2])[:, None]
        first, second = gap - before * seconds, gap - after * seconds
    is_first = np.linalg.norm(first, axis=1) <= np.linalg.norm(second, axis=1)
    return np.where(is_first[:, None], first, second)


def _motion(rows: Ints, time: Floats, center: Floats) -> tuple[Floats, float]:
    """Return the direction (3) in which some images move, and how fast."""
    way = center[rows[-1]] - center[rows[0]]
    length_m, seconds = float(np.linalg.norm(way)), float(time[rows[-1]] - time[rows[0]])
    if length_m <= 0.0 or seconds <= 0.0:
        return np.zeros(3), 0.0
    return np.asarray(way / length_m), length_m / seconds
