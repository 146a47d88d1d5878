"""The shift between two sets of points that show the same objects, without knowing which is which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Floats, Ints
from valuemap.check.sample import number_rows

_MOST_PAIRS = 4_000_000
_ROUNDS = 5


@dataclass(frozen=True, eq=False)
class Shift:
    """`offset_m` (3) takes points to others; so many pairs agree with it, and so many with no shift."""

    offset_m: Floats
    pairs: int
    pairs_at_zero: int


def find_shift(points: Floats, others: Floats, tolerance_m: float, *, within_m: float | None) -> Shift | None:
    """Return the difference other - point that most pairs have, up to the tolerance; None where there is no pair.

    Points (N, 3) and others (M, 3) in one frame; pairs farther apart than `within_m` are not looked at.
    """
    difference = differences(points, others, within_m=within_m)
    return densest(difference, tolerance_m)


def differences(points: Floats, others: Floats, *, within_m: float | None) -> Floats:
    """Return other - point (K, 3) of all pairs within a distance (None: of all pairs)."""
    first, second = pairs_within(points, others, within_m=within_m)
    return np.asarray(others[second] - points[first])


def pairs_within(points: Floats, others: Floats, *, within_m: float | None) -> tuple[Ints, Ints]:
    """Return the rows of points and others of all pairs within a distance (None: of all pairs)."""
    if within_m is None:
        every = max(1, -(-len(points) * len(others) // _MOST_PAIRS))
        first, second = np.meshgrid(np.arange(0, len(points), every), np.arange(len(others)), indexing="ij")
        return first.ravel(), second.ravel()
    if not len(points) or not len(others):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    near: list[list[int]] = list(cKDTree(others).query_ball_point(points, within_m, return_sorted=True))  # type: ignore[arg-type]
    count = np.array([len(found) for found in near])
    second = np.concatenate([np.array(rows, dtype=np.int64) for rows in near]) if count.sum() else np.empty(0, np.int64)
    return np.repeat(np.arange(len(points)), count), second


def densest(difference: Floats, tolerance_m: float) -> Shift | None:
    """Return the place (3) with most of the differences (K, 3) within the tolerance, and how many are around zero."""
    if not len(difference):
        return None
    best_count, best = 0, difference[0]
    for start in (0.0, 0.5):
        cell = np.floor(difference / (2.0 * tolerance_m) + start).astype(np.int64)
        number = number_rows(*cell.T)
        count = np.bincount(number)
        fullest = int(np.argmax(count))
        if count[fullest] > best_count:
            best_count = int(count[fullest])
            best = difference[number == fullest].mean(axis=0)
    for _ in range(_ROUNDS):
        near = np.linalg.norm(difference - best, axis=1) <= tolerance_m
        if not np.any(near):
            break
        best = np.median(difference[near], axis=0)
    near = np.linalg.norm(difference - best, axis=1) <= tolerance_m
    at_zero = np.linalg.norm(difference, axis=1) <= tolerance_m
    return Shift(best, int(near.sum()), int(at_zero.sum()))
