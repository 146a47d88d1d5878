"""Angles in degrees that were read as radians: known but for multiples of 2 pi, which the drive gives back.

Read as radians, 30 degrees are 4.8 turns: of the angle remains what is left of 2 pi, in degrees. Which multiple of 2 pi
was lost is sought for the images of a stretch together, in which a camera turns and tilts little from one to the next.
"""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.check.headings import headings, rotations_of, wrapped
from valuemap.check.sample import order_by_pass, standing_m
from valuemap.dataset import Dataset

_WHOLE_TURN_RAD = 2.0 * np.pi
_GAP_STEPS = 5.0
"""A step so many times the usual one is a gap: nothing is known of how the camera turned in it."""
_MOST_OFF_DEG = 30.0
"""Of a direction of travel that is off by more it does not matter how far: there the car did not go where it looked."""
_ROUNDS = 2
"""The first headings tell how far the camera moves outwards in bends and how far cars look off their way."""


def rotations_from_degrees(dataset: Dataset, *, zero_rad: float, clockwise: bool, tilts: bool = True) -> Floats:
    """Return the rotations (N, 3, 3) that the degrees meant which were read as radians.

    Parameters
    ----------
    dataset
        Poses as they were read.
    zero_rad
        The azimuth, clockwise from north, from which headings count.
    clockwise
        Whether they count clockwise.
    tilts
        Whether pitch and roll were degrees as well; else they are right as they are.
    """
    way = 1.0 if clockwise else -1.0
    azimuth, pitch, roll = headings(dataset)
    order = order_by_pass(dataset.images)
    travel = _Travel(dataset, order)
    usual_pitch = None
    # The longest pass first, with the smallest pitch there can be: the others are mounted as it is.
    for rows in sorted(travel.passes, key=len, reverse=True) if tilts else ():
        images = order[rows]
        over = images[_is_turned_over(pitch[images], roll[images])]
        azimuth[over], pitch[over], roll[over] = azimuth[over] + np.pi, np.pi - pitch[over], roll[over] + np.pi
        pitch[images] = _steady(pitch[images], usual_pitch or 0.0)
        roll[images] = _steady(roll[images], 0.0)
        usual_pitch = float(np.median(pitch[images])) if usual_pitch is None else usual_pitch
    right = np.empty(len(order))
    outwards_m = 0.0
    # Of headings of which nothing is known but a remainder, the nearest is evenly off up to half of 2 pi degrees.
    off_deg = _WHOLE_TURN_RAD / 4.0
    for _ in range(_ROUNDS):
        looks_rad = travel.azimuth - outwards_m * travel.turn_per_m
        wanted_deg = np.degrees(wrapped(way * (looks_rad - zero_rad), np.pi))
        remainder_deg = way * (azimuth[order] - zero_rad)
        weight = _weight_of_changes(off_deg, _change_deg(remainder_deg, wanted_deg, travel))
        heading_deg = _headings_deg(remainder_deg, wanted_deg, travel.is_moving, travel.stretches, weight)
        right[order] = zero_rad + way * np.radians(heading_deg)
        outwards_m = travel.outwards_m(right[order])
        off_deg = travel.off_deg(right[order], outwards_m)
    unit = np.radians(1.0) if tilts else 1.0
    return rotations_of(right, unit * pitch, unit * roll, dataset.frame)


class _Travel:
    """Passes of images in driving order, stretches of them without gaps, and how each image (N) moves in its own."""

    def __init__(self, dataset: Dataset, order: Ints) -> None:
        center = camera_centers(dataset.images)[order]
        flat = center @ np.stack(list(dataset.frame.east_north()), axis=1)
        step = np.diff(flat, axis=0)
        length = np.hypot(*step.T)
        same = np.diff(dataset.images.pass_id.codes[order]) == 0
        moving = length[same & (length > standing_m(length[same]))]
        near = same & (length <= _GAP_STEPS * (np.median(moving) if len(moving) else np.inf))
        self.passes = np.split(np.arange(len(order)), np.flatnonzero(~same) + 1)
        self.stretches = np.split(np.arange(len(order)), np.flatnonzero(~near) + 1)
        sum_of_steps = np.zeros((len(order), 2))
        sum_of_steps[:-1] += np.where(near[:, None], step, 0.0)
        sum_of_steps[1:] += np.where(near[:, None], step, 0.0)
        self.azimuth = np.arctan2(*sum_of_steps.T)
        length_of_both = np.hypot(*sum_of_steps.T)
        self.is_moving: Bools = length_of_both > (standing_m(length[same]) if len(moving) else 0.0)
        turn = np.zeros((2, len(order)))
        for side, (here, there) in enumerate([(slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))]):
            both = near & self.is_moving[1:] & self.is_moving[:-1]
            turn[side, here] = np.where(both, wrapped(self.azimuth[there] - self.azimuth[here], np.pi), 0.0)
        self.turn_per_m = (turn[0] - turn[1]) / np.maximum(length_of_both, 1e-9)

    def outwards_m(self, heading_rad: Floats) -> float:
        """Return how far a camera is in front of the axle that does not steer: so far it moves outwards in bends."""
        off = wrapped(self.azimuth - heading_rad, np.pi)
        known = self.is_moving & (np.abs(off) < np.pi / 6.0)
        turn = self.turn_per_m[known]
        return float(turn @ off[known] / max(float(turn @ turn), 1e-12))

    def off_deg(self, heading_rad: Floats, outwards_m: float) -> float:
        """Return how far cameras look off their way: the median of the images that move."""
        off = np.degrees(np.abs(wrapped(self.azimuth - outwards_m * self.turn_per_m - heading_rad, np.pi)))
        return float(np.median(off[self.is_moving])) if self.is_moving.any() else 0.0


def _weight_of_changes(off_deg: float, change_deg: float) -> float:
    """Return how much more a degree counts by which a camera turns otherwise than its way than one by which it is off.

    How far a camera looks off its way stays from image to image: it is an autoregression of first order, whose
    correlation is 1 - (change / off)^2 / 2. Images that are correlated say the same thing about how far it is off, once
    for 1 / (1 - correlation) of them, while changes are independent.

    Parameters
    ----------
    off_deg, change_deg
        Median sizes of how far it is off, and of how much that changes from image to image.
    """
    ratio = off_deg / max(change_deg, _EXACT_DEG)
    return ratio * max(2.0 * ratio**2, 1.0)


_EXACT_DEG = 0.01
"""Degrees that are written with two decimals change by no less."""


def _change_deg(remainder_deg: Floats, wanted_deg: Floats, travel: _Travel) -> float:
    """Return the median size of how much more than its way a camera turns, as remainders of 2 pi degrees tell it."""
    found = [
        np.abs(
            wrapped(
                np.diff(remainder_deg[rows]) - _changes(wanted_deg[rows], travel.is_moving[rows]), _WHOLE_TURN_RAD / 2.0
            )
        )
        for rows in travel.stretches
    ]
    every = np.concatenate(found)
    return float(np.median(every)) if len(every) else 0.0


def _changes(wanted_deg: Floats, is_moving: Bools) -> Floats:
    """Return by how much the way turns from image to image (K - 1), 0 where it is not known."""
    return np.where(is_moving[1:] & is_moving[:-1], wrapped(np.diff(wanted_deg), 180.0), 0.0)


def _is_turned_over(pitch: Floats, roll: Floats) -> Bools:
    """Return of which images (K) of a pass the other triple of angles is meant that gives the same rotation.

    It is turned around and over. Meant are those in which the tilts change little from image to image; of the two such
    rows of triples the one with small rolls, as a camera may well look up, but not lie on its side.
    """

    def changes(over: bool) -> Floats:
        before = np.stack([pitch[:-1], roll[:-1]])
        after = np.stack([np.pi - pitch[1:], roll[1:] + np.pi] if over else [pitch[1:], roll[1:]])
        return np.asarray((wrapped(after - before, np.pi) ** 2).sum(axis=0))

    is_over = np.cumsum(np.append(False, changes(over=True) < changes(over=False))) % 2 == 1
    rolled = _steady(roll + np.pi * is_over, 0.0)
    return np.asarray(is_over if abs(float(np.median(rolled))) <= np.pi / 2.0 else ~is_over)


def _steady(angle: Floats, usual: float) -> Floats:
    """Return angles (K), known but for multiples of 2 pi, that change little, their middle nearest to a usual one."""
    own = np.unwrap(angle)
    return np.asarray(own - _WHOLE_TURN_RAD * np.round((np.median(own) - usual) / _WHOLE_TURN_RAD))


def _headings_deg(
    heading: Floats, wanted_deg: Floats, is_moving: Bools, stretches: list[Ints], weight_of_changes: float
) -> Floats:
    """Return headings (N) in degrees, -180 to 180, known but for multiples of 2 pi, so that in each stretch of rows
    their changes and themselves are as near as can be to the directions of travel: the cheapest path through all
    multiples. All stretches are gone along at once.
    """
    multiples = np.arange(np.ceil(-180.0 / _WHOLE_TURN_RAD), np.floor(180.0 / _WHOLE_TURN_RAD) + 2.0)
    count = len(multiples)
    choices = np.mod(heading + 180.0, _WHOLE_TURN_RAD)[:, None] - 180.0 + _WHOLE_TURN_RAD * (multiples - multiples[0])
    off = np.minimum(np.abs(wrapped(choices - wanted_deg[:, None], 180.0)), _MOST_OFF_DEG)
    off = np.where(is_moving[:, None], off, 0.0) + np.where(choices > 180.0, np.inf, 0.0)
    step = np.diff(choices[:, 0]) - _changes(wanted_deg, is_moving)
    # A step costs by how many multiples it goes over, whichever they are: from each (last axis) to each is a window.
    over = np.arange(count - 1, -count, -1)
    cost_of_step = weight_of_changes * np.abs(wrapped(step[:, None] + _WHOLE_TURN_RAD * over, 180.0))
    cost_of_pair = np.lib.stride_tricks.sliding_window_view(cost_of_step, count, axis=1)[:, ::-1]
    longest_first = sorted(stretches, key=len, reverse=True)
    start, length = (np.array([each(rows) for rows in longest_first]) for each in (lambda rows: rows[0], len))
    cost, came_from = off.copy(), np.zeros(choices.shape, dtype=np.int64)
    for i in range(1, int(length[0])):
        row = start[: np.searchsorted(-length, -i)] + i
        total = (cost[row - 1][:, None] + cost_of_pair[row - 1]).reshape(-1, count)
        cheapest = total.argmin(axis=1)
        came_from[row] = cheapest.reshape(-1, count)
        cost[row] += total[np.arange(len(total)), cheapest].reshape(-1, count)
    path = np.empty(len(choices), dtype=np.int64)
    last = start + length - 1
    path[last] = cost[last].argmin(axis=1)
    for i in range(int(length[0]) - 1, 0, -1):
        row = start[: np.searchsorted(-length, -i)] + i
        path[row - 1] = came_from[row, path[row]]
    return np.asarray(choices[np.arange(len(choices)), path])
