"""Stage 4: what the evidence says about each label: covariance, passes, residuals, parallax, size, time."""

from __future__ import annotations

import numpy as np

import valuemap._core as _core
from valuemap.arrays import Floats, Ints
from valuemap.cameras import Rays
from valuemap.config import NoiseConfig
from valuemap.dataset import Dataset, number_passes
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.tables import Categories, Labels, Votes
from valuemap.tables.candidates import Candidates
from valuemap.tables.covariance import covariance_columns


def describe_labels(dataset: Dataset, rays: Rays, candidates: Candidates, config: NoiseConfig) -> tuple[Labels, Votes]:
    """Return the labels (ids from 1, in the order of the candidates) and their votes.

    Where the candidates have no covariance of their own it is the squared standard deviation of the detections times
    the inverse of the normal equations of Eq. (1) of the paper at the label. That deviation is the setting
    `detection_sigma_px`, else that of the residuals. Width and height are the medians over voters of box size times
    depth over focal length. The largest parallax is exact up to 64 voters; beyond, it is that among the 64 directions
    that are farthest from their mean. A label faces the mean horizontal direction to its voters' cameras, in which
    every pass weighs the same, so that a car that waits before it does not decide; the length of that mean of unit
    vectors is the concentration.
    """
    images, detections = dataset.images, dataset.detections
    voters = candidates.voters.astype(np.int64)
    starts = candidates.voter_offsets[:-1]
    label = candidates.row_of_voter()
    count = np.diff(candidates.voter_offsets)
    residual_px, metres_per_px, max_parallax_rad = _core.see(
        rays.core, candidates.position_in_world_m, candidates.voter_offsets, candidates.voters
    )
    size_m = detections.size_px[voters] * metres_per_px
    image_row = rays.image_row[voters]
    time = np.full(len(voters), np.nan) if images.timestamp_s is None else images.timestamp_s[image_row]
    sigma_px = config.detection_sigma_px or residual_sigma_px(residual_px, len(candidates))
    covariance = candidates.covariance_m2
    if covariance is None:
        covariance = sigma_px**2 * _core.unit_covariance(
            rays.core, candidates.position_in_world_m, candidates.voter_offsets, candidates.voters
        )
    position = candidates.position_in_world_m
    anchor = dataset.frame.anchor
    label_of_pass, pass_of_voter = _passes_of_labels(label, number_passes(images)[image_row])
    toward_camera = (rays.center_in_world_m[voters] - position[label]) @ dataset.frame.east_north().T
    facing = _mean_in_groups(_mean_in_groups(_unit_vectors(toward_camera), pass_of_voter), label_of_pass)
    labels = Labels(
        label_id=np.arange(1, len(candidates) + 1),
        class_name=_classes(candidates, detections.class_name),
        position_in_world_m=position,
        covariance_m2=covariance_columns(covariance),
        votes=count,
        passes=np.bincount(label_of_pass, minlength=len(candidates)),
        object_width_m=_core.medians(size_m[:, 0].copy(), candidates.voter_offsets),
        object_height_m=_core.medians(size_m[:, 1].copy(), candidates.voter_offsets),
        reprojection_rms_px=np.sqrt(_reduce(np.add, residual_px**2, starts) / count),
        max_parallax_rad=max_parallax_rad,
        first_seen_s=_reduce(np.fmin, time, starts),
        last_seen_s=_reduce(np.fmax, time, starts),
        facing_azimuth_rad=np.arctan2(facing[:, 0], facing[:, 1]) % (2.0 * np.pi),
        facing_concentration=np.minimum(np.linalg.norm(facing, axis=1), 1.0),
        expected=candidates.expected,
        existence=candidates.existence,
        lon_lat_height=None if anchor is None else lon_lat_height_from_enu(position, anchor),
    )
    votes = Votes(
        label_id=labels.label_id[label],
        detection_id=detections.detection_id[voters],
        image_id=detections.image_id[voters],
        residual_px=residual_px,
        residual_sigmas=residual_px / sigma_px,
    )
    return labels, votes


def _classes(candidates: Candidates, of_detection: Categories) -> Categories:
    if candidates.class_code is None:
        return of_detection.take(candidates.voters[candidates.voter_offsets[:-1]].astype(np.int64))
    return Categories(candidates.class_code.astype(of_detection.codes.dtype), of_detection.names)


def residual_sigma_px(residual_px: Floats, labels: int) -> float:
    """Return the standard deviation of residuals, each axis: two numbers a vote, three spent on each position."""
    freedom = 2 * len(residual_px) - 3 * labels
    return float(np.sqrt(np.sum(residual_px**2) / freedom)) if freedom > 0 else 1.0


def _reduce(operation: np.ufunc, values: Floats, starts: Ints) -> Floats:
    return np.asarray(operation.reduceat(values, starts)) if len(starts) else np.empty(0)


def _passes_of_labels(label: Ints, pass_code: Ints) -> tuple[Ints, Ints]:
    """Return the label of every pass that voted for one (N, by label), and which of these each voter is of."""
    codes = int(pass_code.max(initial=0)) + 1
    pairs, pass_of_voter = np.unique(label * codes + pass_code, return_inverse=True)
    return pairs // codes, pass_of_voter


def _unit_vectors(vectors: Floats) -> Floats:
    """Return vectors (N, K) with length 1; those without a direction stay 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))


def _mean_in_groups(values: Floats, group: Ints) -> Floats:
    """Return the mean (groups, K) of values (N, K); groups are numbered from 0, none is empty."""
    sums = [np.bincount(group, weights=column) for column in values.T]
    return np.asarray(np.stack(sums, axis=1) / np.bincount(group)[:, None])
