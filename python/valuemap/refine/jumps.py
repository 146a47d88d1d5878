"""Where poses jump: steps that no vehicle makes, or that one hardly makes, told from the trajectory alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset
from valuemap.drives import Drives
from valuemap.tables import Floats, Ints

_FASTER = 1.2
"""A step that much longer than those around it is none of a vehicle."""
_SIGMAS = 8.0
"""A step farther than so many usual deviations from what a vehicle can make is a jump."""
_LEAST_M = 0.3
_MOST_STEPS = 4.0
_JUMP_M = 2.0
"""Deviation of jumps, each axis."""
_LEAST_SIGMA_M = 0.02


@dataclass(frozen=True, eq=False)
class Hints:
    """How much a trajectory speaks for a jump: minus twice the log of the odds (H) before this place of a drive (H).

    Sorted by drive and order; where nothing is known, nothing is said.
    """

    drive: Ints
    order: Ints
    evidence: Floats

    def between(self, drive: int, order: Ints) -> Floats:
        """Return the most that speaks (N) for a jump after the image before and not after this one, 0 at the first."""
        low, high = np.searchsorted(self.drive, [drive, drive + 1])
        at = low + np.searchsorted(self.order[low:high], order, side="right")
        most = np.zeros(len(order))
        for i in np.flatnonzero(np.diff(at)) + 1:
            most[i] = max(0.0, float(self.evidence[at[i - 1] : at[i]].max()))
        return most


@dataclass(frozen=True, eq=False)
class Segments:
    """Drives cut where their poses jump: segment `begins` (L) at this place in the order of its `drive` (L)."""

    drive: Ints
    begins: Ints

    def __len__(self) -> int:
        return len(self.drive)

    def of(self, drive: Ints, order: Ints) -> Ints:
        """Return the segment (N) of images, by drive and order."""
        reach = int(max(order.max(initial=0), self.begins.max(initial=0))) + 2
        return np.searchsorted(self.drive * reach + self.begins, drive * reach + order, side="right") - 1


def find_jumps(dataset: Dataset, drives: Drives) -> Segments:
    """Cut drives where the pose jumps: at steps that are outside what the steps before and after them span.

    A vehicle goes on as before, or as after, or stops, or anything between: the step is in the triangle of no step and
    those two. How far usual steps are outside of it is the trembling of the poses.
    """
    cuts: list[tuple[int, int]] = [(drive, 0) for drive in range(drives.count)]
    for steps in _steps_of_drives(dataset, drives):
        ahead = _FASTER * steps.seconds[:, None]
        outside = _from_triangle(steps.step_m, steps.before_mps * ahead, steps.after_mps * ahead)
        usual = float(np.median(np.linalg.norm(steps.unexpected_m(), axis=1)))
        far = outside > max(_SIGMAS * usual / 1.5, _LEAST_M)
        cuts += [(steps.drive, int(order)) for order in steps.order[far]]
    both = np.unique(np.array(cuts, dtype=np.int64), axis=0)
    return Segments(both[:, 0], both[:, 1])


def find_hints(dataset: Dataset, drives: Drives) -> Hints:
    """Return how much each step speaks for a jump: by how much it is likelier with one than without.

    What a step differs by from those before and after it is normal, along the way and across it, with the deviation
    that it usually has in its drive; and wider by that of jumps where there is one.
    """
    parts = []
    for steps in _steps_of_drives(dataset, drives):
        unexpected = steps.unexpected_m()
        way = steps.before_mps + steps.after_mps
        length = np.linalg.norm(way, axis=1, keepdims=True)
        way = np.where(length > 0.0, way / np.maximum(length, 1e-9), np.array([1.0, 0.0]))
        along = np.sum(unexpected * way, axis=1)
        across = unexpected[:, 1] * way[:, 0] - unexpected[:, 0] * way[:, 1]
        evidence = np.zeros(len(along))
        for value in (along, across):
            variance = max(1.4826 * float(np.median(np.abs(value))), _LEAST_SIGMA_M) ** 2
            evidence += value**2 / variance - value**2 / (variance + _JUMP_M**2) - np.log1p(_JUMP_M**2 / variance)
        parts.append(np.column_stack([np.full(len(along), steps.drive), steps.order, evidence]))
    table = np.concatenate([np.empty((0, 3)), *parts])
    return Hints(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2])


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps (N) of one drive that have one before and one after them, on the ground, and the order they lead to."""

    drive: int
    order: Ints
    step_m: Floats
    seconds: Floats
    before_mps: Floats
    after_mps: Floats

    def unexpected_m(self) -> Floats:
        """Return what the steps (N, 2) are other than the mean of those before and after."""
        return np.asarray(self.step_m - 0.5 * (self.before_mps + self.after_mps) * self.seconds[:, None])


def _steps_of_drives(dataset: Dataset, drives: Drives) -> Iterator[_Steps]:
    """Yield the steps of the camera with most images in each drive; seconds are images where there are no times."""
    center = camera_centers(dataset.images)[:, :2]
    time = dataset.images.timestamp_s
    camera = np.unique(dataset.images.camera_id, return_inverse=True)[1]
    for drive in range(drives.count):
        rows = np.flatnonzero(drives.pass_code == drive)
        rows = rows[camera[rows] == np.argmax(np.bincount(camera[rows]))]
        rows = rows[np.argsort(drives.order[rows], kind="stable")]
        if len(rows) < 5:
            continue
        when = np.arange(len(rows), dtype=np.float64) if time is None else time[rows]
        if not (np.all(np.isfinite(when)) and np.all(np.diff(when) > 0.0)):
            when = np.arange(len(rows), dtype=np.float64)
        seconds, step = np.diff(when), np.diff(center[rows], axis=0)
        near = seconds <= _MOST_STEPS * np.median(seconds)
        velocity = step / seconds[:, None]
        inner = np.flatnonzero(near[1:-1] & near[:-2] & near[2:]) + 1
        if len(inner) < 3:
            continue
        yield _Steps(
            drive, drives.order[rows[inner + 1]], step[inner], seconds[inner], velocity[inner - 1], velocity[inner + 1]
        )


def _from_triangle(point: Floats, a: Floats, b: Floats) -> Floats:
    """Return the distance (N) of points (N, 2) from the triangles of the origin, a and b (N, 2)."""
    zero = np.zeros_like(a)
    edges = np.stack([_from_edge(point, zero, a), _from_edge(point, a, b), _from_edge(point, b, zero)])
    sides = np.stack([_side(point, zero, a), _side(point, a, b), _side(point, b, zero)])
    inside = np.all(sides >= 0.0, axis=0) | np.all(sides <= 0.0, axis=0)
    return np.where(inside, 0.0, edges.min(axis=0))


def _from_edge(point: Floats, start: Floats, end: Floats) -> Floats:
    along = end - start
    length2 = np.sum(along**2, axis=1)
    share = np.clip(np.sum((point - start) * along, axis=1) / np.where(length2 > 0.0, length2, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(point - start - share[:, None] * along, axis=1))


def _side(point: Floats, start: Floats, end: Floats) -> Floats:
    along, to = end - start, point - start
    return np.asarray(along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0])
