"""How well rays agree: the one measure by which a mistake in the conventions of a dataset shows.

Rays of good data meet: many detections of different images vote for one point. Under a wrong convention they meet
no more often than by chance. The measure asks nothing but that: places are voted on by the core, without any metre
(ranges are open, so that a model in arbitrary units is measured alike), and every vote counts

    1 - (residual / gate)^2,        and every point found costs COST_OF_A_POINT,

so that few close votes and many distant ones are told apart. A dataset and what it would be under another convention
are compared place by place on the same detections, so the difference has a scatter of its own and is tested against
that scatter, not against a constant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import Pinholes, Rays, camera_poses, local_pinholes, rays_of_pinholes
from valuemap.check.sample import Sample
from valuemap.config import VoteConfig
from valuemap.dataset import Dataset
from valuemap.errors import SettingError
from valuemap.paper.vote import vote_in_clusters
from valuemap.reach import deal
from valuemap.tables.candidates import Candidates

COST_OF_A_POINT = 1.5
"""A point has three coordinates to please three residuals of its own with: half of them are no evidence."""
_LEAST_RANGE_M, _GREATEST_RANGE_M = 1e-6, 1e5
_LEAST_PARALLAX_DEG = 1.0
_GREATEST_GATE_PX = 1e5
"""What the vote takes at most: a reading under which a radian has millions of pixels is refuted at any gate."""
_LEAST_PLACES = 4
_MOST_EXACT = 50
_ROUNDING = 1e-6
"""Gains that differ by a smaller share of themselves differ in their last digits only."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """What voting on a sample of places came to.

    `gain` (places) is the sum over the votes of a place, `gain_of_point` (P) that of the points, each of which its
    votes have an equal share in the cost of: `gain_of_vote` (V). `voters` counts all votes, `detections` all
    detections; `rays`, of the detections `detection_id` (N), and `found` are what was voted on and the points that were
    found, relative to `middle_in_world_m` (3).
    """

    gain: Floats
    gain_of_point: Floats
    gain_of_vote: Floats
    detection_id: Ints
    voters: int
    detections: int
    rays: Rays
    found: Candidates
    middle_in_world_m: Floats

    @property
    def points_in_world_m(self) -> Floats:
        """The points (N, 3) where rays meet, in the frame of the dataset."""
        return self.found.position_in_world_m + self.middle_in_world_m

    def gain_of_images(self, place_of_image: NDArray[np.uint32], which: Bools) -> Floats:
        """Return the sum over the votes of each place (places) that are of some images (N, by mask)."""
        image = self.rays.image_row[self.found.voters.astype(np.int64)]
        mine = which[image]
        sums = np.bincount(place_of_image[image[mine]], weights=self.gain_of_vote[mine], minlength=len(self.gain))
        return np.asarray(sums, dtype=np.float64)

    @property
    def share(self) -> float:
        """The share of detections whose rays meet others."""
        return self.voters / max(self.detections, 1)


def agreement_on(sample: Sample, version: Dataset, gate_px: float) -> Agreement:
    """Vote on a sample, of whose images another version is given."""
    return measure_agreement(version, sample.place_of_image, gate_px, pinholes=sample.pinholes_of(version))


def measure_agreement(
    dataset: Dataset, place_of_image: NDArray[np.uint32], gate_px: float, *, pinholes: Pinholes | None = None
) -> Agreement:
    """Vote on images: `place_of_image` (images) says which ones are looked at together, from 0 without gaps.

    The `pinholes` of their detections are made where they are not known.
    """
    gate_px = min(gate_px, _GREATEST_GATE_PX)
    pinholes = local_pinholes(dataset) if pinholes is None else pinholes
    cam_from_world, center_in_world_m = camera_poses(dataset.images)
    # The origin is amid the images: far from it the core's single precision is coarse.
    middle_in_world_m = np.median(center_in_world_m, axis=0) if len(center_in_world_m) else np.zeros(3)
    rays = rays_of_pinholes(pinholes, dataset.detections, cam_from_world, center_in_world_m - middle_in_world_m)
    places = int(place_of_image.max(initial=0)) + 1
    config = VoteConfig(
        max_reprojection_error_px=gate_px,
        min_parallax_deg=_LEAST_PARALLAX_DEG,
        min_range_m=_LEAST_RANGE_M,
        max_range_m=_GREATEST_RANGE_M,
    )
    try:
        found, _ = vote_in_clusters(rays, place_of_image, config)
    except SettingError:  # So many rays through one point that their votes fill the memory: no convention of the world.
        found = Candidates(np.empty((0, 3)), np.zeros(1, np.int64), np.empty(0, np.uint32), np.empty(0, np.uint32))
    gain, of_point, of_vote = np.zeros(places), np.zeros(len(found)), np.zeros(len(found.voters))
    if len(found):
        residual_px, _, _ = _core.see(rays.core, found.position_in_world_m, found.voter_offsets, found.voters)
        worth = np.maximum(1.0 - (residual_px / gate_px) ** 2, 0.0)
        of_point = np.add.reduceat(worth, found.voter_offsets[:-1]) - COST_OF_A_POINT
        votes = np.diff(found.voter_offsets)
        of_vote = worth - np.repeat(COST_OF_A_POINT / votes, votes)
        first = found.voters[found.voter_offsets[:-1]].astype(np.int64)
        gain += np.bincount(place_of_image[rays.image_row[first]], weights=of_point, minlength=places)
    detection_id = dataset.detections.detection_id
    return Agreement(
        gain, of_point, of_vote, detection_id, len(found.voters), len(rays), rays, found, middle_in_world_m
    )


def chance_agreement(dataset: Dataset, place_of_image: NDArray[np.uint32], gate_px: float) -> Agreement:
    """Measure the same with the detections of each place dealt to other images of it: what is left is chance."""
    detections = dataset.detections
    place = place_of_image[np.searchsorted(dataset.images.image_id, detections.image_id)]
    dealt = deal(place, np.argsort(place, kind="stable"))
    moved = detections.replace(center_px=detections.center_px[dealt], size_px=detections.size_px[dealt])
    return measure_agreement(Dataset(**{**vars(dataset), "detections": moved}), place_of_image, gate_px)


def gains_of_objects(better: Sequence[Agreement], worse: Sequence[Agreement]) -> tuple[Floats, Floats]:
    """Return the gains (objects) of two readings by the smallest units that do not depend on each other.

    One unit are all detections that points of either reading join, on whatever sample they were found: what one reading
    takes for one object may be two by the other.
    """
    linked: list[tuple[Ints, Ints, Floats, int]] = []
    points = 0
    for which, agreements in enumerate((better, worse)):
        for each in agreements:
            voters = each.detection_id[each.found.voters.astype(np.int64)]
            count = np.diff(each.found.voter_offsets)
            linked.append((voters, points + np.repeat(np.arange(len(count)), count), each.gain_of_point, which))
            points += len(count)
    ids, number = np.unique(np.concatenate([voters for voters, _, _, _ in linked]), return_inverse=True)
    point = np.concatenate([of for _, of, _, _ in linked])
    size = points + len(ids)
    graph = coo_matrix((np.ones(len(point)), (point, points + number)), shape=(size, size))
    units, unit = connected_components(graph, directed=False)
    gain = np.concatenate([gain for _, _, gain, _ in linked])
    of_better = np.concatenate([np.full(len(gain), side == 0) for _, _, gain, side in linked])
    first, second = (
        np.bincount(unit[:points][mine], gain[mine], units).astype(np.float64) for mine in (of_better, ~of_better)
    )
    return first, second


@dataclass(frozen=True)
class Comparison:
    """How much better one convention makes rays agree than another: difference of gains, and how likely by chance.

    `places` counts what was compared: places, or objects where `of` says so.
    """

    difference: float
    chance: float
    places: int
    of: Literal["places", "objects"] = "places"

    def to_json(self) -> dict[str, Any]:
        """Return the figures by name."""
        return {"difference": round(self.difference, 2), "chance": float(f"{self.chance:.2g}"), self.of: self.places}


def chance_of_majority(count: int, of: int) -> float:
    """Return how likely so many and more of some are on one side, where both sides are as likely (a sign test)."""
    return float(stats.binom.sf(count - 1, of, 0.5))


def compare(better: Floats, worse: Floats) -> Comparison:
    """Test the paired differences of gains (places) against their scatter, one-sided.

    Student's t has most power where places are alike, Wilcoxon's signed ranks where few of them are much larger; the
    better of both counts, times two for the choice. Places where both are the same tell nothing and do not count; those
    that a camera does not see say nothing of it.
    """
    difference = better - worse
    difference = difference[np.abs(difference) > _ROUNDING * np.maximum(np.abs(better), np.abs(worse))]
    count = len(difference)
    total = float(difference.sum())
    if count < _LEAST_PLACES or total <= 0.0:
        return Comparison(total, 1.0, count)
    scatter = float(difference.std(ddof=1)) / math.sqrt(count)
    statistic = math.inf if scatter == 0.0 else float(difference.mean()) / scatter
    by_size = float(stats.t.sf(statistic, count - 1))
    if count <= _MOST_EXACT and by_size <= 0.5**count:  # Of so few places ranks are never less likely.
        return Comparison(total, 2.0 * by_size, count)
    method: Literal["exact", "approx"] = "exact" if count <= _MOST_EXACT else "approx"
    by_rank = float(stats.wilcoxon(difference, alternative="greater", method=method).pvalue)
    return Comparison(total, min(1.0, 2.0 * min(by_size, by_rank)), count)


def compare_objects(better: Sequence[Agreement], worse: Sequence[Agreement]) -> Comparison:
    """Compare two readings on the same samples by objects instead of places."""
    return replace(compare(*gains_of_objects(better, worse)), of="objects")
