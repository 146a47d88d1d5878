"""Hypotheses that became no labels: what the detections that no label has would make, and the test that each fails.

Nothing is decided here: the map stands. The detections that are left over propose points and vote for them as in the
paper's Algorithm 1; each point that two images or more vote for is put to the plain tests of the method, in order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import Rays, cast_rays
from valuemap.config import PartitionConfig, VoteConfig
from valuemap.dataset import Dataset, evenly, rows_of
from valuemap.drives import in_driving_order
from valuemap.evidence import Evidence
from valuemap.map_folder import Map
from valuemap.nearby import ONE_PLACE_CHI2
from valuemap.paper.partition import partition_images
from valuemap.paper.vote import vote_in_clusters
from valuemap.tables import Categories, Rejected
from valuemap.tables.candidates import Candidates
from valuemap.tables.covariance import covariance_matrices

MOST_KEPT = 10_000
"""So many rejected hypotheses a map keeps, those with most votes."""
LARGEST = 200_000
"""Maps of more images and detections keep none: what is asked about is found when it is asked."""

_VOTES_SHARE = 0.99
_GATE_PX = (2.0, 30.0)
"""A detection votes for a point as near as that share of the map's votes are to their labels, within these limits."""
_MOST_AROUND = 300
"""Detections of one place and class that are looked at, evenly spread where there are more: work is cubic in them."""
_SAME_PLACE_RANGES = 0.05
"""Labels so many ranges away are asked whether they are what a point is: 3 m in streets."""
_WIDER = 1.5
"""Points so many times farther away than the map looks are proposed, to be refused for it."""
_NO_LABEL = -1


@dataclass(frozen=True, eq=False)
class _LeftOver:
    """The detections that no label has, with their images, as a dataset; `image_row` (N) are rows of the whole one.

    `cluster` (N) are the images that are looked at together.
    """

    dataset: Dataset
    image_row: Ints
    cluster: NDArray[np.uint32]
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
    verdicts = _judged(evidence, left, found)
    voter_images = left.image_row[left.rays.image_row[found.voters.astype(np.int64)]]
    by_point = np.split(voter_images, found.voter_offsets[1:-1]) if len(found) else []
    expected = [
        len(images) + len(evidence.should_have_seen(point, images)) if why in ("existence", "ratio") else 0
        for point, images, why in zip(found.position_in_world_m, by_point, verdicts.reason, strict=True)
    ]
    votes, usual = np.diff(found.voter_offsets), _usual_share(evidence)
    is_unlikely = np.array([why == "existence" for why in verdicts.reason], dtype=np.bool_)
    detections = left.dataset.detections
    return Rejected(
        hypothesis_id=np.arange(1, len(found) + 1),
        class_name=detections.class_name.take(found.voters[found.voter_offsets[:-1]].astype(np.int64)),
        position_in_world_m=found.position_in_world_m,
        votes=votes,
        passes=np.array([len(np.unique(evidence.pass_number[images])) for images in by_point], dtype=np.int64),
        expected=np.array(expected, dtype=np.int64),
        existence=np.full(len(found), np.nan),
        reason=Categories.from_texts(verdicts.reason),
        rival=verdicts.rival,
        value=np.where(is_unlikely, votes / np.maximum(expected, 1), verdicts.value),
        threshold=np.where(is_unlikely, usual, verdicts.threshold),
    )


def figures_in_words(rejected: Rejected, row: int) -> str:
    """Return what the test that a hypothesis failed saw and what it asks for; empty where that is no number."""
    if rejected.value is None or rejected.threshold is None:
        return ""
    value, threshold = float(rejected.value[row]), float(rejected.threshold[row])
    if not (math.isfinite(value) and math.isfinite(threshold)):
        return ""
    reason = rejected.reason.names[rejected.reason.codes[row]]
    if reason == "range":
        return f"its votes count from {value:.1f} m, {'at least' if value < threshold else 'at most'} {threshold:g} m"
    return _FIGURES[reason].format(value=value, threshold=threshold) if reason in _FIGURES else ""


_FIGURES = {
    "votes": "{value:.0f} votes, of at least {threshold:.0f}",
    "parallax": "{value:.1f} degrees, of at least {threshold:g}",
    "merged": "{value:.1f} sigmas apart, up to {threshold:.1f} are one place",
    "class": "{value:.1f} sigmas apart, up to {threshold:.1f} are one place",
    "existence": "{value:.0%} of the images that should have seen it vote for it, for a usual label {threshold:.0%}",
}


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
    images = dataset.images.take(np.unique(image_row))
    left = Dataset(dataset.name, dataset.frame, dataset.cameras, images, dataset.detections.take(rows))
    # In driving order, ids say nothing of what is looked at together and what is not looked at.
    ordered = in_driving_order(left)
    images, detections = ordered.dataset.images, ordered.dataset.detections
    cluster = partition_images(images, PartitionConfig())
    of_detection = cluster[detections.image_id].astype(np.int64)
    chosen = _thinned(of_detection, detections.class_name.codes.astype(np.int64))
    part = replace(ordered.dataset, detections=detections.take(chosen))
    return _LeftOver(part, rows_of(ordered.image_id, dataset.images.image_id), cluster, cast_rays(part))


def _thinned(cluster: Ints, code: Ints) -> Ints:
    """Return at most `_MOST_AROUND` rows of each cluster and class, evenly where there are more; ascending."""
    order = np.lexsort((code, cluster))
    _, first, count = np.unique(np.stack([cluster[order], code[order]]), axis=1, return_index=True, return_counts=True)
    kept = [
        evenly(order[start : start + size], _MOST_AROUND)
        for start, size in zip(first.tolist(), count.tolist(), strict=True)
    ]
    return np.sort(np.concatenate(kept)) if kept else np.empty(0, np.int64)


def _hypotheses(evidence: Evidence, left: _LeftOver) -> Candidates:
    """Return the points that at least two images vote for; each detection votes for one at most."""
    residual_px, usual = evidence.result.votes.residual_px, VoteConfig()
    gate_px = float(np.quantile(residual_px, _VOTES_SHARE)) if len(residual_px) else usual.max_reprojection_error_px
    config = VoteConfig(
        max_reprojection_error_px=float(np.clip(gate_px, *_GATE_PX)),
        min_parallax_deg=evidence.result.setting("min_parallax_deg", usual.min_parallax_deg) / 4.0,
        min_range_m=0.0,
        max_range_m=_WIDER * evidence.max_range_m,
        min_vote_ratio=0.0,
        min_votes=2,
    )
    return vote_in_clusters(left.rays, left.cluster, config, threads=1)[0]


def _usual_share(evidence: Evidence) -> float:
    """Return the share of the images that should have seen it which vote for a label, the median; NaN if unknown."""
    labels = evidence.result.labels
    if labels.expected is None or not len(labels):
        return math.nan
    return float(np.median(labels.votes / np.maximum(labels.expected, labels.votes)))


@dataclass(frozen=True, eq=False)
class _Verdicts:
    """Of each point (N) the first test that it fails, with its value and threshold, and the label that has its place.

    Both are NaN for the last test; `rival` is -1 where there is no such label.
    """

    reason: list[str]
    rival: Ints
    value: Floats
    threshold: Floats


def _judged(evidence: Evidence, left: _LeftOver, found: Candidates) -> _Verdicts:
    rays, position = left.rays, found.position_in_world_m
    if not len(found):
        return _Verdicts([], np.empty(0, np.int64), np.empty(0), np.empty(0))
    _, _, parallax_rad = _core.see(rays.core, position, found.voter_offsets, found.voters)
    voters = found.voters.astype(np.int64)
    point = np.repeat(position, np.diff(found.voter_offsets), axis=0)
    distance_m = np.linalg.norm(rays.center_in_world_m[voters] - point, axis=1)
    rival, is_same_class, sigmas = _labels_there(evidence, left, found)
    result, usual = evidence.result, VoteConfig()
    last = "ratio" if result.method == "paper" else "existence"
    votes, min_votes = np.diff(found.voter_offsets), int(result.setting("min_votes", usual.min_votes))
    parallax_deg, least_deg = np.degrees(parallax_rad), result.setting("min_parallax_deg", usual.min_parallax_deg)
    by_point = np.split(distance_m, found.voter_offsets[1:-1])
    least_m = result.setting("min_range_m", usual.nearest_m)
    decisive = [_decisive(of, least_m, evidence.max_range_m, min_votes) for of in by_point]
    range_m, limit_m = np.array(decisive).T
    largest = np.full(len(found), math.sqrt(ONE_PLACE_CHI2))
    tests = (
        ("merged", (rival >= 0) & is_same_class, sigmas, largest),
        ("class", rival >= 0, sigmas, largest),
        ("votes", votes < min_votes, votes, np.full(len(found), min_votes)),
        ("parallax", parallax_deg < least_deg, parallax_deg, np.full(len(found), least_deg)),
        ("range", np.isfinite(limit_m), range_m, limit_m),
        (last, np.ones(len(found), np.bool_), np.full(len(found), np.nan), np.full(len(found), np.nan)),
    )
    first = np.array([fails for _, fails, _, _ in tests]).argmax(axis=0)
    value, threshold = (np.array([test[column] for test in tests])[first, np.arange(len(found))] for column in (2, 3))
    return _Verdicts([tests[test][0] for test in first], rival, value, threshold)


def _decisive(distance_m: Floats, least_m: float, most_m: float, min_votes: int) -> tuple[float, float]:
    """Return the distance of the vote that makes too few votes of a point lie in the range, and the limit it is beyond.

    The limit is NaN where enough of its votes are in the range.
    """
    beyond_m = np.maximum(least_m - distance_m, distance_m - most_m)
    if len(distance_m) < min_votes:
        return math.nan, math.nan
    vote = np.argsort(beyond_m, kind="stable")[min_votes - 1]
    if beyond_m[vote] <= 0.0:
        return float(distance_m[vote]), math.nan
    return float(distance_m[vote]), least_m if distance_m[vote] < least_m else most_m


def _labels_there(evidence: Evidence, left: _LeftOver, found: Candidates) -> tuple[Ints, Bools, Floats]:
    """Return the id of the label that agrees best with each point, -1 if none does; if it has its class; in sigmas."""
    labels, residual_px = evidence.result.labels, evidence.result.votes.residual_px
    rival, is_same = np.full(len(found), _NO_LABEL), np.zeros(len(found), np.bool_)
    sigmas = np.full(len(found), np.nan)
    if not len(labels):
        return rival, is_same, sigmas
    sigma_px = max(1.0, float(np.sqrt(np.mean(residual_px**2) / 2.0)))
    own = sigma_px**2 * _core.unit_covariance(
        left.rays.core, found.position_in_world_m, found.voter_offsets, found.voters
    )
    spread = covariance_matrices(labels.covariance_m2)
    names = left.dataset.detections.class_name.take(found.voters[found.voter_offsets[:-1]].astype(np.int64))
    around_m = _SAME_PLACE_RANGES * evidence.max_range_m
    near = scipy.spatial.cKDTree(labels.position_in_world_m).query_ball_point(found.position_in_world_m, around_m)
    for row, rows in enumerate(near):
        if not rows:
            continue
        around = np.sort(rows)
        away = labels.position_in_world_m[around] - found.position_in_world_m[row]
        apart = np.einsum(
            "ni,ni->n", away, np.linalg.solve(spread[around] + own.reshape(-1, 3, 3)[row], away[..., None])[..., 0]
        )
        if apart.min() <= ONE_PLACE_CHI2:
            best = around[int(np.argmin(apart))]
            rival[row], sigmas[row] = labels.label_id[best], math.sqrt(max(float(apart.min()), 0.0))
            is_same[row] = labels.class_name.names[labels.class_name.codes[best]] == names.names[names.codes[row]]
    return rival, is_same, sigmas
