"""What the data can give: rays for each place, the angles between them, the accuracy to expect, where they miss."""

from __future__ import annotations

from typing import Any

import numpy as np

import valuemap._core as _core
from valuemap.cameras import camera_centers
from valuemap.check.fault import View
from valuemap.check.loose import LEAST_TIMES, loose_of
from valuemap.check.sample import order_by_pass

_GAP_TIMES = 10.0
_LEAST_VOTES = 5
"""Fewer rays may meet by chance."""

_LEAST_PLACES = 10
"""Of fewer none need be in the best or the worst tenth, which are told."""


def describe_prospects(view: View) -> dict[str, Any]:
    """Return the figures by name, from the sample of places that several passes meet."""
    dataset = view.dataset
    sample = view.places
    facts: dict[str, Any] = {
        "images": len(dataset.images),
        "detections": len(dataset.detections),
        "detections_looked_at": len(sample.dataset.detections),
        "images_without_detections": _share_without(view),
        "scores": "none" if np.ptp(dataset.detections.score) == 0.0 else "vary",
        **_gaps(view),
    }
    misses = loose_of(view).misses(dataset)
    if misses is not None:
        facts["turn_of_all_cameras_seen_from_deg"] = round(LEAST_TIMES * float(np.degrees(misses.angle_rad)), 2)
        facts["shift_of_all_poses_seen_from_m"] = round(LEAST_TIMES * misses.distance_m, 2)
    agreement = view.agreement_at_places
    facts["detections_that_meet_others"] = round(agreement.share, 3)
    found = agreement.found
    votes = np.diff(found.voter_offsets)
    kept = np.flatnonzero(votes >= _LEAST_VOTES)
    if not len(kept):
        return facts
    residual_px, _, parallax_rad = _core.see(
        agreement.rays.core, found.position_in_world_m, found.voter_offsets, found.voters
    )
    freedom = 2 * len(residual_px) - 3 * len(found)
    sigma_px = float(np.sqrt((residual_px**2).sum() / freedom)) if freedom > 0 else 1.0
    covariance = sigma_px**2 * _core.unit_covariance(
        agreement.rays.core, found.position_in_world_m, found.voter_offsets, found.voters
    ).reshape(-1, 3, 3)
    sigma_m = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)
    image_row = agreement.rays.image_row[found.voters.astype(np.int64)]
    pass_code = sample.dataset.images.pass_id.codes[image_row]
    point = np.repeat(np.arange(len(found)), votes)
    passes = np.bincount(np.unique(np.stack([point, pass_code], axis=1), axis=0)[:, 0], minlength=len(found))
    facts |= {
        "places_where_rays_meet": len(kept),
        "rays_per_place": _spread(votes[kept].astype(np.float64), 0),
        "passes_per_place": _spread(passes[kept].astype(np.float64), 0),
        "parallax_deg": _spread(np.degrees(parallax_rad[kept]), 1),
        "residual_px": round(sigma_px, 2),
    }
    # Rays that are parallel say nothing of how far.
    if np.isfinite(sigma_m[kept]).sum() >= _LEAST_PLACES:
        facts["expected_accuracy_m"] = _spread(sigma_m[kept], 3)
    return facts


def _spread(values: np.ndarray[Any, Any], digits: int) -> dict[str, float]:
    """Return the 10th, 50th and 90th percentile."""
    low, middle, high = np.quantile(values[np.isfinite(values)], [0.1, 0.5, 0.9])
    return {"p10": round(float(low), digits), "median": round(float(middle), digits), "p90": round(float(high), digits)}


def _share_without(view: View) -> float:
    with_some = np.unique(view.dataset.detections.image_id)
    return round(1.0 - len(with_some) / len(view.dataset.images), 3)


def _gaps(view: View) -> dict[str, Any]:
    """Return how often a drive is interrupted, and the longest way without an image."""
    images = view.drives
    if not len(images):
        return {"passes": len(np.unique(view.dataset.images.pass_id.codes)), "step_m": round(view.step_m, 3)}
    order = order_by_pass(images)
    step = np.linalg.norm(np.diff(camera_centers(images)[order], axis=0), axis=1)
    step = step[np.diff(images.pass_id.codes[order]) == 0]
    gaps = step[step > _GAP_TIMES * view.step_m]
    return {
        "passes": len(np.unique(images.pass_id.codes)),
        "step_m": round(view.step_m, 3),
        "gaps": len(gaps),
        "longest_gap_m": round(float(gaps.max()), 1) if len(gaps) else 0.0,
    }
