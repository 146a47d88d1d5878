"""Poses moved along their own drives, as a shift in time moves them."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats, runs
from valuemap.cameras import camera_centers
from valuemap.check.sample import (
    drive_of_camera,
    order_by_camera,
)
from valuemap.dataset import Dataset


def moved_along(dataset: Dataset, forward_m: float) -> Floats:
    """Return camera centres (N, 3) moved forward along their passes, each camera's own, as a shift in time does.

    The shift is that of an image that moves by the median step; slower ones move less, standing ones not at all.
    """
    order = order_by_camera(dataset.images)
    center = camera_centers(dataset.images)[order]
    codes = drive_of_camera(dataset.images)[order]
    time = dataset.images.timestamp_s
    seconds = np.arange(len(order), dtype=np.float64) if time is None or not np.all(np.isfinite(time)) else time[order]
    step = np.linalg.norm(np.diff(center, axis=0), axis=1)
    duration = np.diff(seconds)
    usable = (np.diff(codes) == 0) & (duration > 0.0) & (step > 0.0)
    usable &= step > 0.3 * np.median(step[usable]) if np.any(usable) else usable
    if not np.any(usable):
        return camera_centers(dataset.images)
    shift_s = forward_m / float(np.median(step[usable] / duration[usable]))
    moved = np.empty_like(center)
    for rows in runs(np.arange(len(order)), codes):
        when = seconds[rows]
        _, keep = np.unique(when, return_index=True)
        if len(keep) < 2:
            moved[rows] = center[rows]
            continue
        for axis in range(3):
            moved[rows, axis] = _interpolate(when + shift_s, when[keep], center[rows[keep], axis])
    result = np.empty_like(moved)
    result[order] = moved
    return result


def _interpolate(at: Floats, when: Floats, value: Floats) -> Floats:
    """Interpolate linearly, and beyond the ends go on as at the ends."""
    inside = np.interp(at, when, value)
    first = value[0] + (at - when[0]) * (value[1] - value[0]) / (when[1] - when[0])
    last = value[-1] + (at - when[-1]) * (value[-1] - value[-2]) / (when[-1] - when[-2])
    return np.asarray(np.where(at < when[0], first, np.where(at > when[-1], last, inside)))
