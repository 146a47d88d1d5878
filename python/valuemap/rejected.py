"""Hypotheses that became no labels: what the detections that no label has would make, and the test that each fails.

Nothing is decided here: the map stands. The detections that are left over propose points and vote for them as in the
paper's Algorithm 1; each point that two images or more vote for is put to the plain tests of the method, in order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

import valuemap._core as _core
from valuemap.cameras import Rays, cast_rays
from valuemap.config import PartitionConfig, VoteConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.evidence import Evidence
from valuemap.map_folder import Map
from valuemap.partition import partition_images
from valuemap.tables import Bools, Candidates, Categories, Floats, Ints, Rejected
from valuemap.vote import vote_in_clusters

MOST_KEPT = 10_000
"""So many rejected hypotheses a map keeps, those with most votes."""
LARGEST = 200_000
"""Maps of more images and detections keep none: what is asked about is found when it is asked."""

_VOTES_SHARE = 0.99
_GATE_PX = (2.0, 30.0)
"""A detection votes for a point as near as that share of the map's votes are to their labels, within these limits."""
_MOST_AROUND = 300
"""Detections of one place and class that are looked at, evenly spread where there are more: work is cubic in them."""
_SAME_PLACE = 16.27
"""Squared distance in sigmas up to which a point and a label can be one: chi-square, 3 axes, 99.9 %."""
_SAME_PLACE_M = 3.0
_WIDER = 1.5
"""Points so many times farther away than the map looks are proposed, to be refused for it."""
_NO_LABEL = -1


@dataclass(frozen=True, eq=False)
class _LeftOver:
    """The detections that no label has, with their images, as a dataset; `image_row` (N) are rows of the whole one."""

    dataset: Dataset
    image_row: Ints
    rays: Rays


def find_rejected(evidence: Evidence, around_in_world_m: Floats | None = None) -> Rejected:
    """Return the best hypotheses of the detections that no label has, most votes first, and why they are no labels.

    Parameters
    ----------
    evidence
        A map and its dataset.
    around_in_world_m
        A place (3): only what images within the range of the map see is looked at. Without it, everything.
    """
    left = _left_over(evidence, around_in_world_m)
    found = _hypotheses(evidence, left)
    most = np.lexsort((np.arange(len(found)), -np.diff(found.voter_offsets)))[:MOST_KEPT]
    found = found.take(most)
    reason, rival = _judged(evidence, left, found)
    voter_images = left.image_row[left.rays.image_row[found.voters.astype(np.int64)]]
    by_point = np.split(voter_images, found.voter_offsets[1:-1]) if len(found) else []
    expected = [
        len(images) + len(evidence.should_have_seen(point, images)) if why in ("existence", "ratio") else 0
        for point, images, why in zip(found.position_in_world_m, by_point, reason, strict=True)
    ]
    detections = left.dataset.detections
    return Rejected(
        hypothesis_id=np.arange(1, len(found) + 1),
        class_name=detections.class_name.take(found.voters[found.voter_offsets[:-1]].astype(np.int64)),
        position_in_world_m=found.position_in_world_m,
        votes=np.diff(found.voter_offsets),
        passes=np.array([len(np.unique(evidence.pass_number[images])) for images in by_point], dtype=np.int64),
        expected=np.array(expected, dtype=np.int64),
        existence=np.full(len(found), np.nan),
        reason=Categories.from_texts(reason),
        rival=rival,
    )


def rejected_of_map(result: Map, read: Callable[[], Dataset]) -> Rejected | None:
    """Return what a map keeps beside its labels; `read` gives its dataset. None where that is large."""
    counts = result.run["counts"]
    if counts["images"] + counts["detections"] > LARGEST:
        return None
    return find_rejected(Evidence(result, read()))


def _left_over(evidence: Evidence, around_in_world_m: Floats | None) -> _LeftOver:
    dataset = evidence.dataset
    rows = np.flatnonzero(evidence.label_of_detection < 0)
    image_row = rows_of(dataset.detections.image_id[rows], dataset.images.image_id)
    if around_in_world_m is not None:
        near = evidence.images_around(around_in_world_m, evidence.max_range_m, horizontally=True)
        is_near = np.isin(image_row, near)
        rows, image_row = rows[is_near], image_row[is_near]
    kept, number = np.unique(image_row, return_inverse=True)
    images = dataset.images.take(kept)
    clusters = partition_images(images, PartitionConfig())[number] if len(kept) else number
    code = dataset.detections.class_name.codes[rows]
    rows = rows[_thinned(clusters.astype(np.int64), code.astype(np.int64))]
    part = Dataset(dataset.name, dataset.frame, dataset.cameras, images, dataset.detections.take(rows))
    return _LeftOver(part, kept, cast_rays(part))


def _thinned(cluster: Ints, code: Ints) -> Ints:
    """Return at most `_MOST_AROUND` rows of each cluster and class, evenly where there are more; ascending."""
    order = np.lexsort((code, cluster))
    _, first, count = np.unique(np.stack([cluster[order], code[order]]), axis=1, return_index=True, return_counts=True)
    kept = [
        order[start : start + size][np.linspace(0, size - 1, min(size, _MOST_AROUND)).round().astype(np.int64)]
        for start, size in zip(first.tolist(), count.tolist(), strict=True)
    ]
    return np.sort(np.concatenate(kept)) if kept else np.empty(0, np.int64)


def _hypotheses(evidence: Evidence, left: _LeftOver) -> Candidates:
    """Return the points that at least two images vote for; each detection votes for one at most."""
    residual_px = evidence.result.votes.residual_px
    gate_px = (
        float(np.quantile(residual_px, _VOTES_SHARE)) if len(residual_px) else VoteConfig().max_reprojection_error_px
    )
    config = VoteConfig(
        max_reprojection_error_px=float(np.clip(gate_px, *_GATE_PX)),
        min_parallax_deg=_setting(evidence, "min_parallax_deg", 2.0) / 4.0,
        min_range_m=0.0,
        max_range_m=_WIDER * evidence.max_range_m,
        min_vote_ratio=0.0,
        min_votes=2,
    )
    clusters = partition_images(left.dataset.images, PartitionConfig())
    return vote_in_clusters(left.rays, clusters, config, threads=1)[0]


def _judged(evidence: Evidence, left: _LeftOver, found: Candidates) -> tuple[list[str], Ints]:
    """Return the first test that each point fails, and the id of the label that has its place, -1 if none."""
    rays, position = left.rays, found.position_in_world_m
    if not len(found):
        return [], np.empty(0, np.int64)
    _, _, parallax_rad = _core.see(rays.core, position, found.voter_offsets, found.voters)
    voters = found.voters.astype(np.int64)
    point = np.repeat(position, np.diff(found.voter_offsets), axis=0)
    distance_m = np.linalg.norm(rays.center_in_world_m[voters] - point, axis=1)
    in_range = (distance_m >= _setting(evidence, "min_range_m", 2.0)) & (distance_m <= evidence.max_range_m)
    votes_in_range = np.add.reduceat(in_range.astype(np.int64), found.voter_offsets[:-1])
    rival, is_same_class = _labels_there(evidence, left, found)
    settings = evidence.result.run.get("settings")
    last = "ratio" if isinstance(settings, dict) and settings.get("method") == "paper" else "existence"
    votes, min_votes = np.diff(found.voter_offsets), _setting(evidence, "min_votes", 3)
    tests = (
        ("merged", (rival >= 0) & is_same_class),
        ("class", rival >= 0),
        ("votes", votes < min_votes),
        ("parallax", parallax_rad < math.radians(_setting(evidence, "min_parallax_deg", 2.0))),
        ("range", votes_in_range < min_votes),
    )
    failed = np.array([fails for _, fails in tests])
    names = np.array([*(name for name, _ in tests), last])
    return names[np.where(failed.any(axis=0), failed.argmax(axis=0), len(tests))].tolist(), rival


def _labels_there(evidence: Evidence, left: _LeftOver, found: Candidates) -> tuple[Ints, Bools]:
    """Return the id of the label that agrees best with each point, -1 if none does; and whether it has its class."""
    labels, residual_px = evidence.result.labels, evidence.result.votes.residual_px
    rival, is_same = np.full(len(found), _NO_LABEL), np.zeros(len(found), np.bool_)
    if not len(labels):
        return rival, is_same
    sigma_px = max(1.0, float(np.sqrt(np.mean(residual_px**2) / 2.0)))
    own = sigma_px**2 * _core.unit_covariance(
        left.rays.core, found.position_in_world_m, found.voter_offsets, found.voters
    )
    spread = labels.covariance_m2[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    names = left.dataset.detections.class_name.take(found.voters[found.voter_offsets[:-1]].astype(np.int64))
    near = cKDTree(labels.position_in_world_m).query_ball_point(found.position_in_world_m, _SAME_PLACE_M)
    for row, rows in enumerate(near):
        if not rows:
            continue
        around = np.sort(rows)
        away = labels.position_in_world_m[around] - found.position_in_world_m[row]
        apart = np.einsum(
            "ni,ni->n", away, np.linalg.solve(spread[around] + own.reshape(-1, 3, 3)[row], away[..., None])[..., 0]
        )
        if apart.min() <= _SAME_PLACE:
            best = around[int(np.argmin(apart))]
            rival[row] = labels.label_id[best]
            is_same[row] = labels.class_name.names[labels.class_name.codes[best]] == names.names[names.codes[row]]
    return rival, is_same


def _setting(evidence: Evidence, name: str, otherwise: float) -> float:
    """Return a number that the run which made the map was set to."""
    settings = evidence.result.run.get("settings")
    value = settings.get(name) if isinstance(settings, dict) else None
    return float(value) if isinstance(value, int | float) else otherwise
