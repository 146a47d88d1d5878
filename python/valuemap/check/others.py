"""What others see of the places of one camera or pass, and whether its own rays meet that.

A group of few rays, or one whose rays agree among themselves as well if they are read wrongly (a mirrored picture of a
straight road is one, too), still has the points that others see to meet. They are there whatever is wrong with it.
Each point counts once, however often a standing car sees it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints
from valuemap.cameras import Pinholes, Rays, camera_poses, local_pinholes, rays_of_pinholes
from valuemap.check.agreement import compare
from valuemap.check.fault import (
    AGAINST,
    FAR_WORSE,
    LEAST_CHANCE,
    TIE,
    Convention,
    Finding,
    Fix,
    View,
    gains_of_all,
)
from valuemap.check.groups import Group, groups_of, is_of_one_group, only
from valuemap.check.sample import see_the_same
from valuemap.dataset import Dataset

LEAST_OTHERS = 3
"""Votes of others that make a point: two rays of different images nearly always meet somewhere."""


@dataclass(frozen=True, eq=False)
class PointsOfOthers:
    """Points (P, 3) that others than a group see, relative to `middle_in_world_m` (3), with their places and classes.

    `part` has the images of the group that are in any place, `place_of_image` (N) their places.
    """

    position_m: Floats
    middle_in_world_m: Floats
    place: Ints
    class_code: NDArray[np.int32]
    part: Dataset
    place_of_image: Ints

    def rays(self, version: Dataset) -> Rays:
        """Return the rays of a version of the group, from camera centres relative to the middle."""
        pinholes = self._pinholes if see_the_same(version, self.part) else local_pinholes(version)
        cam_from_world, center_in_world_m = camera_poses(version.images)
        return rays_of_pinholes(
            pinholes, version.detections, cam_from_world, center_in_world_m - self.middle_in_world_m
        )

    @cached_property
    def _pinholes(self) -> Pinholes:
        return local_pinholes(self.part)

    @cached_property
    def _pairs_as_given(self) -> tuple[Ints, Ints]:
        return self.pairs(self.rays(self.part))

    def pairs(self, rays: Rays) -> tuple[Ints, Ints]:
        """Return the rows of rays of the group, and of points in the same place and of the same class, of all pairs."""
        place, rows, points = self.place_of_image[rays.image_row], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        has_ray = np.isfinite(rays.direction_in_world[:, 0])
        for each in np.unique(self.place).tolist():
            own, others = np.flatnonzero(has_ray & (place == each)), np.flatnonzero(self.place == each)
            row, point = np.nonzero(rays.class_code[own][:, None] == self.class_code[others])
            rows.append(own[row])
            points.append(others[point])
        return np.concatenate(rows), np.concatenate(points)

    def are_met(self, gate_px: float) -> bool:
        """Return whether rays of the group, as given, are worth more than half of what rays are worth at most."""
        return float(self.worth(self.part, gate_px).sum()) > FAR_WORSE * len(self.part.detections)

    def worth(self, version: Dataset, gate_px: float) -> Floats:
        """Return how well the rays of a version of the group meet each point (P); each ray meets the nearest one.

        A ray is worth 1 at most.
        """
        rays = self.rays(version)
        row, point = self._pairs_as_given if see_the_same(version, self.part) else self.pairs(rays)
        to_point = self.position_m[point] - rays.center_in_world_m[row]
        local = np.einsum("nij,nj->ni", rays.residual_from_world[row], to_point)
        with np.errstate(divide="ignore", invalid="ignore"):
            worth = 1.0 - (local[:, 0] ** 2 + local[:, 1] ** 2) / (gate_px * local[:, 2]) ** 2
        meets = (local[:, 2] > 0.0) & (worth > 0.0)  # Few of all pairs do.
        row, point, worth = row[meets], point[meets], worth[meets]
        order = np.lexsort((worth, row))
        nearest = order[np.append(np.diff(row[order]) != 0, True)] if len(order) else order
        return np.asarray(
            np.bincount(point[nearest], weights=worth[nearest], minlength=len(self.place)), dtype=np.float64
        )


def points_of_others(view: View, group: Group) -> PointsOfOthers | None:
    """Return what others than a group see where it has images, at the places of a view; None where nothing."""
    sample, agreement = view.many_places, view.agreement_at_many_places
    found, rays = agreement.found, agreement.rays
    mine = group.images_of(sample.dataset)
    if not len(found) or not mine.any():
        return None
    starts, voters = found.voter_offsets[:-1], found.voters.astype(np.int64)
    votes_of_others = np.add.reduceat((~mine[rays.image_row[voters]]).astype(np.int64), starts)
    first, kept = voters[starts], votes_of_others >= LEAST_OTHERS
    if not kept.any():
        return None
    return PointsOfOthers(
        found.position_in_world_m[kept],
        agreement.middle_in_world_m,
        sample.place_of_image[rays.image_row[first[kept]]].astype(np.int64),
        rays.class_code[first[kept]],
        group.part(sample.dataset),
        sample.place_of_image[mine].astype(np.int64),
    )


@dataclass(frozen=True, eq=False)
class ReadingOfGroup:
    """A reading of a group, and how well its rays meet each point of others then."""

    convention: Convention
    how: str
    fix: Fix
    worth: Floats


def find_by_others(view: View, conventions: Sequence[Convention]) -> Finding | None:
    """Look for a camera or pass whose rays meet little of what others see, but do if they are read another way.

    Little is less than half: good rays may meet a little more if read otherwise, by errors of poses and of lenses.
    The points are compared one by one, each with itself, and all readings of all groups are counted. That all rays
    agree better is to bear it out.
    """
    groups = groups_of(view.dataset)
    given = gains_of_all(view, view.dataset)
    found: list[tuple[float, Finding]] = []
    for group in groups:
        finding = _of_group(view, conventions, group, len(groups))
        if finding is None or finding.fix is None:
            continue
        gain = compare(gains_of_all(view, finding.fix(view.dataset)), given)
        if gain.chance * len(groups) < AGAINST:
            found.append((gain.difference, finding))
    return max(found, key=lambda each: each[0])[1] if found else None


def _of_group(view: View, conventions: Sequence[Convention], group: Group, groups: int) -> Finding | None:
    points = points_of_others(view, group)
    if points is None or points.are_met(view.gate_px):  # However they are read, no rays are worth twice as much.
        return None
    given = points.worth(points.part, view.gate_px)
    readings = list(readings_of_group(view, conventions, group, points))
    if not readings:
        return None
    most = max(float(each.worth.sum()) for each in readings)
    best = next(each for each in readings if float(each.worth.sum()) >= (1.0 - TIE) * most)
    if float(given.sum()) > FAR_WORSE * most:
        return None
    comparison = compare(best.worth, given)
    chance = comparison.chance * len(readings) * groups
    if chance > LEAST_CHANCE:
        return None
    how, own = best.convention.refined(group.alone(view), best.how, best.fix)
    met, met_as_given = (int(np.sum(each > 0.0)) for each in (best.worth, given))
    finding = Finding(
        fault=best.convention.name,
        what=best.convention.what,
        why=f"Read as {how}, its rays meet {met} of {len(given)} points that others see around it, as given "
        f"{met_as_given}; the agreement with them rises from {given.sum():.0f} to {best.worth.sum():.0f}.",
        do=best.convention.do,
        chance=chance,
        figures={
            "reading": how,
            "points": len(given),
            "met_as_given": met_as_given,
            "met_if_read_so": met,
            "difference": round(comparison.difference, 2),
        },
        fix=own,
    )
    return only(group, finding)


def readings_of_group(
    view: View, conventions: Sequence[Convention], group: Group, points: PointsOfOthers
) -> Iterator[ReadingOfGroup]:
    """Yield all readings that measure and change nothing but the group; the world is that of all cameras of a pass."""
    for convention in conventions:
        if convention.is_guess or (group.pass_name is None and convention.is_of_world):
            continue
        for how, fix in convention.readings(points.part):
            read = fix(points.part)
            if is_of_one_group(read, points.part, group):
                gate_px = view.gate_px * getattr(fix, "gate_factor", 1.0)
                yield ReadingOfGroup(convention, how, fix, points.worth(read, gate_px))
