"""What each drive sees alone: points triangulated from the images of one stretch of one drive.

Errors that the images of a stretch share move such a point but do not destroy it, however large they are. Points of
different drives that stand for one object therefore tell how the drives lie to each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import valuemap._core as _core
from valuemap.arrays import Floats, Ints
from valuemap.cameras import Rays
from valuemap.config import MapConfig, VoteConfig
from valuemap.dataset import Dataset
from valuemap.drives import Drives
from valuemap.paper.vote import vote_in_clusters
from valuemap.tables.candidates import Candidates

_STRETCH_RANGES = 1.5
"""A stretch is as long as so many largest ranges: an object is seen from before it on one of two of them."""
GATES = (1.0, 2.0, 4.0)
"""Multiples of `max_reprojection_error_px` that are tried: coarse boxes, and poses that tremble, need a wider one."""
_ENOUGH = 0.7
"""A gate is wide enough if this share of the detections vote."""
_LEAST_VOTES = 4
RANGES = 1.5
"""Points may be so many largest ranges away: poses that are off stretch what they see."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points (N, 3) in the world, m, as single drives see them.

    `class_code`, `size_m` (the median height of the object, 0 where no size was measured), `drive`, `segment` (the
    part of it between two jumps) and `driven_m` (the median way of its voters along the drive) are one number a point;
    the voters of point i are the rows `voters[offsets[i] : offsets[i + 1]]` of the detections.
    """

    point_in_world_m: Floats
    class_code: Ints
    size_m: Floats
    drive: Ints
    segment: Ints
    driven_m: Floats
    offsets: Ints
    voters: Ints

    def __len__(self) -> int:
        return len(self.point_in_world_m)

    def landmark_of_voter(self) -> Ints:
        """Return the row of the landmark of each voter."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))


def keyframes(drives: Drives, camera_id: Ints) -> NDArray[np.bool_]:
    """Return which images (N) are the middle one of their camera at their viewpoint: a waiting car shows nothing new.

    The first and the last one of a wait are when it begins and ends, where velocities change within an image.
    """
    cameras = np.unique(camera_id, return_inverse=True)[1]
    place = drives.viewpoint * (int(cameras.max(initial=0)) + 1) + cameras
    order = np.lexsort((drives.order, place))
    starts = np.flatnonzero(np.diff(place[order], prepend=-1))
    ends = np.append(starts[1:], len(order))
    chosen = np.zeros(len(order), np.bool_)
    chosen[order[(starts + ends) // 2]] = True
    return chosen


def find_landmarks(
    dataset: Dataset, rays: Rays, drives: Drives, segment: Ints, config: MapConfig, *, threads: int = 0
) -> Landmarks:
    """Vote on every stretch of every drive alone, with the narrowest gate through which most detections agree."""
    stretch = stretches(drives, segment, config)
    best: Candidates | None = None
    for gate in GATES:
        gate_px = gate * config.vote.max_reprojection_error_px
        found = vote_on_stretches(rays, stretch, config, gate_px, threads=threads)
        if best is None or len(found.voters) > len(best.voters):
            best = found
        if len(found.voters) >= _ENOUGH * len(rays):
            break
    assert best is not None
    voters, offsets = best.voters.astype(np.int64), best.voter_offsets
    _, metres_per_px, _ = _core.see(rays.core, best.position_in_world_m, offsets, best.voters)
    first = rays.image_row[voters[offsets[:-1]]]
    return Landmarks(
        point_in_world_m=best.position_in_world_m,
        class_code=rays.class_code[voters[offsets[:-1]]].astype(np.int64),
        size_m=_core.medians((dataset.detections.size_px[voters] * metres_per_px)[:, 1].copy(), offsets),
        drive=drives.pass_code[first],
        segment=segment[first],
        driven_m=_core.medians(drives.driven_m[rays.image_row[voters]], offsets),
        offsets=offsets,
        voters=voters,
    )


def vote_on_stretches(
    rays: Rays, stretch: NDArray[np.uint32], config: MapConfig, gate_px: float, *, threads: int = 0
) -> Candidates:
    """Vote on every stretch (N, of each image) alone, through a gate."""
    vote = VoteConfig(
        max_reprojection_error_px=gate_px,
        min_parallax_deg=config.vote.min_parallax_deg,
        min_range_m=config.vote.nearest_m,
        max_range_m=RANGES * config.vote.farthest_m,
        min_votes=_LEAST_VOTES,
    )
    return vote_in_clusters(rays, stretch, vote, threads=threads)[0]


def stretches(drives: Drives, segment: Ints, config: MapConfig) -> NDArray[np.uint32]:
    """Return the stretch (N) of each image: segments cut into pieces of about the same length."""
    piece = np.floor(drives.driven_m / (_STRETCH_RANGES * config.vote.farthest_m)).astype(np.int64)
    code = segment * (int(piece.max(initial=0)) + 1) + piece
    return np.asarray(np.unique(code, return_inverse=True)[1], np.uint32)
