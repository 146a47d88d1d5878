"""Where poses jump: steps that no vehicle makes, told from the trajectory alone."""

from __future__ import annotations

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


@dataclass(frozen=True, eq=False)
class Legs:
    """Drives cut where their poses jump: leg `begins` (L) at this place in the order of its `drive` (L)."""

    drive: Ints
    begins: Ints

    def __len__(self) -> int:
        return len(self.drive)

    def of(self, drive: Ints, order: Ints) -> Ints:
        """Return the leg (N) of images, by drive and order."""
        reach = int(max(order.max(initial=0), self.begins.max(initial=0))) + 2
        return np.searchsorted(self.drive * reach + self.begins, drive * reach + order, side="right") - 1


def find_jumps(dataset: Dataset, drives: Drives) -> Legs:
    """Cut drives where the pose jumps: at steps that are outside what the steps before and after them span.

    A vehicle goes on as before, or as after, or stops, or anything between: the step is in the triangle of no step and
    those two. How far usual steps are outside of it is the trembling of the poses.
    """
    center = camera_centers(dataset.images)[:, :2]
    time = dataset.images.timestamp_s
    camera = np.unique(dataset.images.camera_id, return_inverse=True)[1]
    cuts: list[tuple[int, int]] = [(drive, 0) for drive in range(drives.count)]
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
        ahead = _FASTER * seconds[inner, None]
        outside = _from_triangle(step[inner], velocity[inner - 1] * ahead, velocity[inner + 1] * ahead)
        expected = 0.5 * (velocity[inner - 1] + velocity[inner + 1]) * seconds[inner, None]
        usual = float(np.median(np.linalg.norm(step[inner] - expected, axis=1)))
        far = outside > max(_SIGMAS * usual / 1.5, _LEAST_M)
        cuts += [(drive, int(drives.order[rows[i + 1]])) for i in inner[far]]
    both = np.unique(np.array(cuts, dtype=np.int64), axis=0)
    return Legs(both[:, 0], both[:, 1])


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
