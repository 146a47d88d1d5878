"""How far away objects are looked for: as far as in streets, unless the data say that they are no street.

Pose errors of cars and what they forget along a drive are some metres, however far away the objects are. So what has
no unit of its own is in metres as long as objects are seen from as far away as in any street. Rooms, models of tables,
and reconstructions whose unit is not the metre are seen from elsewhere: there `max_range_m` is told from the data, and
with it all other lengths (`VoteConfig.unit_m`).

How far away objects are usually seen is asked of stretches of single drives, whose poses agree best: by the paper's
vote, with ranges of any length, on rays that cross at wide angles, which do so at the right distance even if poses are
off by more than a metre. It is believed if twice as many detections vote as where they are dealt to other images.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints, runs
from valuemap.cameras import Rays, cast_rays
from valuemap.config import MapConfig, VoteConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.drives import driving_order, find_drives
from valuemap.errors import SettingError
from valuemap.paper.vote import vote_in_clusters
from valuemap.refine.landmarks import GATES

MOST_LOOKED_AT = 300_000
"""Datasets of more images and detections are streets, whose poses are taken as they are: a minute or two is spared."""
_STREET_M = (5.0, 150.0)
"""In streets objects are usually seen from 13 m (ramps, from panoramas) to 70 m (lights, by a camera that sees far)."""
_RANGE = 2.0
"""The largest range in units of the usual one: 60 m where lights are usually seen from 30."""
_MOST_DETECTIONS = 3_000
_OF_A_STRETCH = (8, 100)
"""Images of a stretch at least, and detections at least: an object is seen by several, and work is cubic in them."""
_PARALLAX_DEG = 10.0
"""Rays that cross at narrower angles do so anywhere, where poses are off."""
_TOLD_BY, _BEYOND_CHANCE = 0.1, 2.0
"""A gate tells if at least this share of the detections vote, and the odds that one does are so many times as high as
by chance: few vote twice as often, and where most do, half as many do not."""
_LEAST_DETECTIONS = 50
_SHORTEST_M, _LONGEST_M = 1e-5, 1e5


def with_range(dataset: Dataset, config: MapConfig) -> tuple[MapConfig, str | None]:
    """Return settings with both ranges, told from the data where they are not given, and a note where these are odd."""
    vote = config.vote
    usual_m = None
    if config.method == "robust" and vote.max_range_m is None:
        usual_m = usual_distance_m(dataset, vote)
    if usual_m is None or _STREET_M[0] <= usual_m <= _STREET_M[1]:
        return with_usual_range(config), None
    farthest_m = float(f"{_RANGE * usual_m:.2g}")
    note = (
        f"objects are usually seen from {usual_m:.2g} m, in streets from tens of metres: max_range_m was taken to be "
        f"{farthest_m:g} m, and all that is in metres in streets in proportion (is the metre the unit of the poses?)"
    )
    return with_usual_range(replace(config, vote=replace(vote, max_range_m=farthest_m))), note


def with_usual_range(config: MapConfig) -> MapConfig:
    """Return settings with both ranges, those of streets where they are not given."""
    vote = config.vote
    return replace(config, vote=replace(vote, max_range_m=vote.farthest_m, min_range_m=vote.nearest_m))


def usual_distance_m(dataset: Dataset, vote: VoteConfig) -> float | None:
    """Return the median distance from which objects are seen, m; None where the data do not tell it."""
    detections = dataset.detections
    if not _LEAST_DETECTIONS <= len(detections) <= MOST_LOOKED_AT - len(dataset.images):
        return None
    stretch = _stretches(dataset)
    image_row = rows_of(detections.image_id, dataset.images.image_id)
    images = dataset.images.take(np.flatnonzero(stretch >= 0))
    looked_at = detections.take(np.flatnonzero(stretch[image_row] >= 0))
    sample = replace(dataset, images=images, detections=looked_at, truth_detections=None)
    of_image = stretch[stretch >= 0].astype(np.uint32)
    rays, dealt = cast_rays(sample), cast_rays(_dealt(sample, of_image))
    for gate in GATES:
        gate_px = gate * vote.max_reprojection_error_px
        try:
            distance_m = _distances_m(rays, of_image, gate_px, vote)
            by_chance = _distances_m(dealt, of_image, gate_px, vote)
        except SettingError:  # So many rays through one point that their votes fill the memory.
            return None
        voted, left = len(distance_m), len(looked_at) - len(distance_m)
        of_chance, left_by_chance = len(by_chance), len(looked_at) - len(by_chance)
        is_beyond_chance = voted * left_by_chance >= _BEYOND_CHANCE * of_chance * left
        if voted >= _TOLD_BY * len(looked_at) and is_beyond_chance:
            return float(np.median(distance_m))
    return None


def _distances_m(rays: Rays, stretch: NDArray[np.uint32], gate_px: float, vote: VoteConfig) -> Floats:
    """Return how far from its camera each vote is, m, for points that are told on each stretch (N) alone."""
    through = VoteConfig(
        max_reprojection_error_px=gate_px,
        min_parallax_deg=_PARALLAX_DEG,
        min_range_m=_SHORTEST_M,
        max_range_m=_LONGEST_M,
        min_votes=vote.min_votes,
    )
    found, _ = vote_in_clusters(rays, stretch, through)
    voters = found.voters.astype(np.int64)
    point = np.repeat(found.position_in_world_m, np.diff(found.voter_offsets), axis=0)
    return np.asarray(np.linalg.norm(rays.center_in_world_m[voters] - point, axis=1))


def _dealt(dataset: Dataset, stretch: NDArray[np.uint32]) -> Dataset:
    """Return a dataset whose detections are dealt to other images of their stretch (N): what is left is chance."""
    detections = dataset.detections
    of_detection = stretch[rows_of(detections.image_id, dataset.images.image_id)]
    dealt = deal(of_detection, np.lexsort((*detections.center_px.T, of_detection)))
    return replace(dataset, detections=detections.replace(center_px=detections.center_px[dealt]))


def deal(place: NDArray[Any], order: Ints) -> Ints:
    """Return which row each row (N) gets if those of each place are dealt, in an `order` that has places together."""
    dealt = np.arange(len(place))
    for rows in runs(order, place[order]):
        dealt[rows] = np.random.default_rng(len(rows)).permutation(rows)
    return dealt


def _stretches(dataset: Dataset) -> Ints:
    """Return the stretch (N) of each image, from 0 without gaps; -1 of those that are not looked at.

    Stretches are evenly spread over all drives.
    """
    drives = find_drives(dataset.images)
    order = driving_order(dataset.images, drives)
    count = np.bincount(rows_of(dataset.detections.image_id, dataset.images.image_id), minlength=len(dataset.images))[
        order
    ]
    images, detections = _OF_A_STRETCH
    size = np.minimum(count, detections / images)
    along = np.floor((np.cumsum(size) - size) / detections).astype(np.int64)
    _, stretch = np.unique(along * (drives.count + 1) + drives.pass_code[order], return_inverse=True)
    every = max(1.0, len(dataset.detections) / _MOST_DETECTIONS)
    chosen = np.unique(np.floor(np.arange(0.0, stretch.max() + 1, every)).astype(np.int64))
    number = np.full(stretch.max() + 1, -1, np.int64)
    number[chosen] = np.arange(len(chosen))
    of_image = np.empty(len(order), np.int64)
    of_image[order] = number[stretch]
    return of_image
