"""Faults of time stamps: their unit, and counters that start over."""

from __future__ import annotations

import itertools
from functools import partial
from typing import ClassVar

import numpy as np

from valuemap.arrays import Bools, Ints
from valuemap.cameras import camera_centers
from valuemap.check.fault import (
    Fault,
    Finding,
    Stage,
    View,
    with_images,
)
from valuemap.check.sample import (
    FASTER,
    drive_of_camera,
    order_by_camera,
    order_by_pass,
    steps_along_drives,
)
from valuemap.dataset import Dataset
from valuemap.tables import Images

_TIME_UNITS = (("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))

SPEEDS_MPS = (0.2, 70.0)


class TimeUnit(Fault):
    """Time stamps that are not seconds."""

    name: ClassVar[str] = "time_unit"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """See whether another unit of time gives a speed that a car has."""
        speed = median_speed_mps(view)
        if speed is None or SPEEDS_MPS[0] <= speed <= SPEEDS_MPS[1]:
            return None
        for unit, seconds in _TIME_UNITS:
            if SPEEDS_MPS[0] <= speed / seconds <= SPEEDS_MPS[1]:
                return Finding(
                    fault=self.name,
                    what=f"The time stamps are {unit}, not seconds.",
                    why=f"Images would move at {speed:.2g} m/s (median); in {unit} it is {speed / seconds:.3g} m/s.",
                    do="Write seconds.",
                    figures={"speed_mps": speed, "unit": unit},
                    fix=partial(_with_times_scaled, factor=seconds),
                )
        return None


def _with_times_scaled(dataset: Dataset, *, factor: float) -> Dataset:
    return with_images(dataset, timestamp_s=np.asarray(dataset.images.timestamp_s) * factor)


def median_speed_mps(view: View) -> float | None:
    """Return the median speed of images that move, None without time stamps."""
    images = view.dataset.images
    if images.timestamp_s is None or not np.all(np.isfinite(images.timestamp_s)):
        return None
    order = order_by_pass(images)
    step = np.linalg.norm(np.diff(view.center_in_world_m[order], axis=0), axis=1)
    seconds = np.diff(images.timestamp_s[order])
    moves = (np.diff(images.pass_id.codes[order]) == 0) & (seconds > 0.0) & (step > 0.3 * view.step_m)
    return float(np.median(step[moves] / seconds[moves])) if np.any(moves) else None


class RollingTimes(Fault):
    """Time stamps that start over within a drive."""

    name: ClassVar[str] = "rolling_times"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Follow each pass by the names of its images and look for time that falls back by one and the same amount."""
        period = rolling_period(view.dataset)
        if period is None:
            return None
        length, falls = period
        return Finding(
            fault=self.name,
            what="The time stamps start over within drives.",
            why=f"Along the images of single passes, in the order of their names, time falls back {falls} times, "
            f"and all time stamps are within {length:.4g} s.",
            do=f"Add {length:.4g} s at every fall (a counter of seconds within the minute, hour or week?).",
            figures={"period_s": round(length, 4), "falls": falls},
            fix=unroll,
        )


def rolling_period(dataset: Dataset) -> tuple[float, int] | None:
    """Return after how many seconds time starts over and how often it does, None where it does not.

    Counters that start over stay within their period, and go forward but for few falls.
    """
    images = dataset.images
    if images.timestamp_s is None or not np.all(np.isfinite(images.timestamp_s)):
        return None
    order, starts = _by_name(images)
    time = images.timestamp_s[order]
    step = np.diff(time)[~starts[1:]]
    falls, forward = -step[step < 0.0], step[step > 0.0]
    if len(falls) < 1 or len(forward) < 10 or len(falls) > 0.1 * len(step):
        return None
    usual = float(np.median(forward))
    period = _rounded(float(falls.max()) + usual)
    within = np.ptp(time) <= 1.02 * period and time.min() >= -0.02 * period
    return (period, len(falls)) if within and falls.max() > 10.0 * usual else None


def _by_name(images: Images) -> tuple[Ints, Bools]:
    """Return the rows of images in the order of their names, and where (N) the next pass or camera of one begins.

    Names of a car with several cameras often are those of one camera after the other, and cameras of one kind may share
    a row of the table. So where the folder changes and the car is elsewhere at once, the next one begins, too.
    """
    order = order_by_camera(images, by_time=False)
    step_m, ends, usual_m = steps_along_drives(camera_centers(images)[order], drive_of_camera(images)[order])
    folders = [name.rpartition("/")[0] for name in images.name.take(order).to_pylist()]
    changes = np.array([first != second for first, second in itertools.pairwise(folders)], dtype=np.bool_)
    return order, np.append(True, ends | (changes & (step_m > FASTER * usual_m)))


def unroll(dataset: Dataset) -> Dataset:
    """Return a dataset whose time goes on where it started over."""
    found = rolling_period(dataset)
    assert found is not None
    images = dataset.images
    order, start = _by_name(images)
    time = np.asarray(images.timestamp_s)[order]
    falls = np.diff(time, prepend=time[0]) < 0.0
    falls[start] = False
    laps = np.cumsum(falls)
    laps = laps - np.repeat(laps[start], np.diff(np.append(np.flatnonzero(start), len(order))))
    unrolled = np.empty(len(order))
    unrolled[order] = time + laps * found[0]
    return with_images(dataset, timestamp_s=unrolled)


def _rounded(period: float) -> float:
    """Return the period of a counter: a round number far more often than what a fall and a step add up to."""
    for unit in (604_800.0, 86_400.0, 3_600.0, 60.0, 10.0, 1.0):
        whole = round(period / unit) * unit
        if whole > 0.0 and abs(whole - period) < 0.06 * period:
            return whole
    return period
