"""How well what each pass sees alone meets what the others see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints
from valuemap.cameras import Rays
from valuemap.check.agreement import chance_of_majority, measure_agreement
from valuemap.check.fault import (
    AGAINST,
    View,
    once_a_view,
)
from valuemap.check.headings import driving_azimuths
from valuemap.check.offsets import densest, pairs_within

SEARCH_STEPS = 8.0
"""How far a pass may be off, in median steps between images."""

LEAST_PAIRS = 4

_MOST_PASSES = 60

_NEXT_TIMES = 4.0
"""So many tolerances away from the best shift, no pair of points agrees with it and with another."""


@dataclass(frozen=True, eq=False)
class Match:
    """The shift (3) by which so many points of a pass are `met` by those of others, and how many by the next."""

    offset_m: Floats
    met: int
    met_by_next: int

    def chance_against(self, others: int) -> float:
        """Return how likely so many are met, and so many others otherwise, by two ways that are alike."""
        return chance_of_majority(self.met, self.met + others)


@dataclass(frozen=True, eq=False)
class Meeting:
    """Rays of a sample, and the points (P, 3) that each pass finds alone, relative to `middle_in_world_m` (3)."""

    rays: Rays
    place_of_image: NDArray[np.uint32]
    pass_of_image: Ints
    point: Floats
    middle_in_world_m: Floats
    pass_of_point: Ints
    class_of_point: NDArray[np.int32]
    place_of_point: Ints
    gate_px: float

    def passes_of_most_points(self) -> list[int]:
        """Return the codes of the passes that find most points, as many as are looked at."""
        codes, number = np.unique(self.pass_of_point, return_counts=True)
        return [int(code) for code in codes[np.argsort(-number, kind="stable")][:_MOST_PASSES]]

    def differences(self, code: int, *, within_m: float | None) -> tuple[Ints, Floats]:
        """Return from which points of a pass (M) how far it is (M, 3) to points of their class that others find."""
        i, j = self.near(code, self.point, within_m=within_m)
        return i, self.point[j] - self.point[i]

    def near(self, code: int, point: Floats, *, within_m: float | None) -> tuple[Ints, Ints]:
        """Return the rows of points of a pass, and of points of their class that others find near them, of all pairs.

        The points (P, 3) are these, or some of them elsewhere.
        """
        own, others = np.flatnonzero(self.pass_of_point == code), np.flatnonzero(self.pass_of_point != code)
        i, j = pairs_within(point[own], point[others], within_m=within_m)
        same = self.class_of_point[own[i]] == self.class_of_point[others[j]]
        return own[i[same]], others[j[same]]

    def met(self, code: int, point: Floats, within_m: float) -> int:
        """Return how many points of a pass, where all points (P, 3) are elsewhere, are near one of others."""
        return len(np.unique(self.elsewhere(point).near(code, point, within_m=within_m)[0]))

    def met_by(self, code: int, point: Floats, within_m: float) -> list[int]:
        """Return the codes of the passes that points of a pass are near those of, where all points are elsewhere."""
        _, others = self.elsewhere(point).near(code, point, within_m=within_m)
        return [int(each) for each in np.unique(self.pass_of_point[others])]

    def elsewhere(self, point: Floats) -> Meeting:
        """Return the same with other points (P, 3)."""
        return replace(self, point=point)

    def best_match(self, code: int, tolerance_m: float) -> Match | None:
        """Return the shift, however far, by which most points of a pass fall on those of others; None where none do."""
        own, difference = self.differences(code, within_m=None)
        shift = densest(difference, tolerance_m)
        if shift is None:
            return None
        away_m = np.linalg.norm(difference - shift.offset_m, axis=1)
        next_best = densest(difference[away_m > _NEXT_TIMES * tolerance_m], tolerance_m)
        met_by_next = 0
        if next_best is not None:
            is_next = np.linalg.norm(difference - next_best.offset_m, axis=1) <= tolerance_m
            met_by_next = len(np.unique(own[is_next]))
        return Match(shift.offset_m, len(np.unique(own[away_m <= tolerance_m])), met_by_next)

    def gain(self, code: int, offset_m: Floats) -> Floats:
        """Return how well the rays of a pass, whose images (N, 3) are moved, meet the points of the others (places)."""
        image = self.rays.image_row
        own = np.flatnonzero((self.pass_of_image[image] == code) & np.isfinite(self.rays.direction_in_world[:, 0]))
        others = np.flatnonzero(self.pass_of_point != code)
        place_of_ray = self.place_of_image[image[own]].astype(np.int64)
        gain = np.zeros(int(self.place_of_image.max()) + 1)
        for place in np.unique(place_of_ray).tolist():
            ray, target = own[place_of_ray == place], others[self.place_of_point[others] == place]
            if not len(target):
                continue
            center = self.rays.center_in_world_m[ray] + offset_m[image[ray]]
            towards = self.point[target][None] - center[:, None]
            local = np.einsum("nij,nmj->nmi", self.rays.residual_from_world[ray], towards)
            with np.errstate(divide="ignore", invalid="ignore"):
                error2 = (local[..., 0] ** 2 + local[..., 1] ** 2) / local[..., 2] ** 2
            meets = (local[..., 2] > 0.0) & (self.rays.class_code[ray][:, None] == self.class_of_point[target])
            worth = np.where(meets, 1.0 - error2 / self.gate_px**2, 0.0).max(axis=1)
            gain[place] = np.maximum(worth, 0.0).sum()
        return gain


@dataclass(frozen=True, eq=False)
class PassPoints:
    """What each pass of a sample finds alone: rays to meet them with, and the drive's mean azimuth at each point."""

    meeting: Meeting
    heading: Floats


@once_a_view
def pass_points(view: View) -> PassPoints | None:
    """Return what each pass finds alone at each place; None where there is nothing to compare."""
    sample = view.places_of_passes
    dataset, pass_code = sample.dataset, sample.dataset.images.pass_id.codes.astype(np.int64)
    if len(np.unique(pass_code)) < 2:
        return None
    group = sample.place_of_image.astype(np.int64) * (int(pass_code.max()) + 1) + pass_code
    _, group_of_image = np.unique(group, return_inverse=True)
    agreement = measure_agreement(dataset, group_of_image.astype(np.uint32), view.gate_px)
    found = agreement.found
    if len(found) < LEAST_PAIRS:
        return None
    voters = found.voters.astype(np.int64)
    first = voters[found.voter_offsets[:-1]]
    first_image = agreement.rays.image_row[first]
    azimuth, _ = driving_azimuths(view.dataset)
    heading = _mean_heading(azimuth[sample.image_row][agreement.rays.image_row[voters]], found.voter_offsets)
    meeting = Meeting(
        rays=agreement.rays,
        place_of_image=sample.place_of_image,
        pass_of_image=pass_code,
        point=found.position_in_world_m,
        middle_in_world_m=agreement.middle_in_world_m,
        pass_of_point=pass_code[first_image],
        class_of_point=agreement.rays.class_code[first],
        place_of_point=sample.place_of_image[first_image].astype(np.int64),
        gate_px=view.gate_px,
    )
    return PassPoints(meeting, heading)


def _mean_heading(azimuth: Floats, offsets: Ints) -> Floats:
    starts = offsets[:-1]
    return np.arctan2(np.add.reduceat(np.sin(azimuth), starts), np.add.reduceat(np.cos(azimuth), starts))


def meeting_of_passes(view: View) -> Meeting | None:
    """Return the points that each pass finds alone and the rays to meet them with; None where there are none."""
    points = pass_points(view)
    return None if points is None else points.meeting


def unexplained_passes(view: View, near_m: float) -> tuple[str, ...]:
    """Return the passes whose points are near those of others no more often than if they were elsewhere.

    Each has a dozen points or more that others have some of the kind around. Elsewhere is four times as far as near is,
    in each of sixteen directions on the ground, the middle one of which counts.
    """
    points = pass_points(view)
    if points is None:
        return ()
    meeting = points.meeting
    east, north = view.dataset.frame.east_north()
    ways = [np.cos(angle) * east + np.sin(angle) * north for angle in np.linspace(0.0, 2.0 * np.pi, _WAYS, False)]
    found = []
    for code in meeting.passes_of_most_points():
        if meeting.met(code, meeting.point, SEARCH_STEPS * view.step_m) < _A_DOZEN:
            continue
        own = (meeting.pass_of_point == code)[:, None]
        away = [
            meeting.met(code, np.where(own, meeting.point + _NEXT_TIMES * near_m * way, meeting.point), near_m)
            for way in ways
        ]
        met, by_chance = meeting.met(code, meeting.point, near_m), int(np.median(away))
        if chance_of_majority(met, met + by_chance) > AGAINST:
            found.append(view.dataset.images.pass_id.names[code])
    return tuple(found)


_A_DOZEN, _WAYS = 12, 16
