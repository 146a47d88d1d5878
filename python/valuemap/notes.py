"""What a user should know about a map before trusting it: each note is one small function of what was found."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from valuemap.arrays import Floats
from valuemap.config import MapConfig
from valuemap.nearby import Nearby
from valuemap.tables import Labels, Votes
from valuemap.tables.covariance import covariance_matrices

_UNUSED_SHARE = 0.5
_PLAUSIBLE_SIZE_M = (0.05, 10.0)
_UPRIGHT = 0.5
_TWIN_SIGMAS = 1.0
_AT_BOUND = 0.99
_LARGEST_NOISE = {"detection_px": 30.0, "box_share": 0.15, "position_m": 5.0}
"""Where the estimation of the noise in the core ends; metres are units of `VoteConfig.unit_m`."""


@dataclass(frozen=True, eq=False)
class Findings:
    """A map with how many `passes` it was made from, and how; `counts` as run.json holds them."""

    passes: int
    config: MapConfig
    labels: Labels
    votes: Votes
    counts: Mapping[str, Any]


def find_notes(findings: Findings) -> list[str]:
    """Return what is odd about a map, one line each; none where nothing is."""
    return [note for find in NOTES if (note := find(findings)) is not None]


def no_labels(findings: Findings) -> str | None:
    """Say that a map is empty."""
    if len(findings.labels):
        return None
    return (
        "no object was found: are poses, cameras and boxes in the conventions that the formats page names? "
        "valuemap check finds out"
    )


def unused_detections(findings: Findings) -> str | None:
    """Say that most detections show nothing that was found."""
    unused, count = findings.counts["detections_without_label"], findings.counts["detections"]
    if unused <= _UNUSED_SHARE * count or not len(findings.labels):
        return None
    return (
        f"{100.0 * unused / count:.0f} % of the detections belong to no label: a noisy detector, things seen "
        "once, or poses or boxes in another convention than they were taken for (valuemap check finds out)"
    )


def confused_classes(findings: Findings) -> str | None:
    """Say that the detector takes objects of one class for others."""
    confused, votes = findings.counts.get("votes_of_another_class", 0), len(findings.votes)
    if not confused or not votes:
        return None
    return (
        f"{100.0 * confused / votes:.1f} % of the votes are detections of another class than their label's: the "
        "detector takes objects of one class for another (calibration.json: confusions)"
    )


def noise_at_bound(findings: Findings) -> str | None:
    """Say that the noise was estimated as large as it can be."""
    noise = findings.counts.get("noise")
    if not isinstance(noise, Mapping):
        return None
    given = findings.config.noise
    found = {
        "detection_px": (noise.get("detection_px", 0.0), given.detection_sigma_px),
        "box_share": (noise.get("box_share", 0.0), given.detection_sigma_px),
        "position_m": (
            math.hypot(noise.get("position_m", 0.0), noise.get("position_drift_m", 0.0)),
            given.position_sigma_m,
        ),
    }
    bounds = {**_LARGEST_NOISE, "position_m": _LARGEST_NOISE["position_m"] * findings.config.vote.unit_m}
    largest = [
        f"{name} {value:.3g}"
        for name, (value, known) in found.items()
        if known is None and value >= _AT_BOUND * bounds[name]
    ]
    if not largest:
        return None
    return f"the noise was estimated as large as it can be ({', '.join(largest)}): detections and poses hardly agree"


def implausible_size(findings: Findings) -> str | None:
    """Say that objects are too small or too large, as they are where poses are not in metres."""
    labels = findings.labels
    size_m = np.sqrt(labels.object_width_m * labels.object_height_m)
    if not np.any(size_m > 0.0):
        return None  # Bearings have no size.
    median_m = float(np.median(size_m[size_m > 0.0]))
    low, high = _PLAUSIBLE_SIZE_M
    if low <= median_m <= high:
        return None
    return (
        f"the median object is {median_m:.2g} m large, expected {low:g} to {high:g} m: the poses may not be in metres, "
        "or the boxes not in pixels"
    )


def close_twins(findings: Findings) -> str | None:
    """Say that labels of one class are closer to each other than they are exact."""
    pairs = _twins(findings.labels)
    if not pairs:
        return None
    (first, second), *others = pairs
    ids = findings.labels.label_id
    more = f" and {len(others)} more pairs" if others else ""
    return f"labels {ids[first]} and {ids[second]}{more} are closer than their sigmas: each may be one object twice"


def no_overlap(findings: Findings) -> str | None:
    """Say that no object was found by two passes, though there are several."""
    labels = findings.labels
    if findings.passes <= 1 or not len(labels) or np.any(labels.passes > 1):
        return None
    return (
        f"no label has votes of two of the {findings.passes} passes: they see different places, or are shifted "
        "against each other"
    )


def untested_covariances(findings: Findings) -> str | None:
    """Say that no second pass tests the covariances, which are known then from the scatter along one drive alone."""
    labels = findings.labels
    if findings.passes != 1 or not np.any(labels.covariance_m2 > 0.0):
        return None
    return (
        "all images are of one pass: standard deviations of labels assume what poses get wrong all along it, and leave "
        "out what boxes do, which a second pass or surveyed objects (valuemap evaluate) would show"
    )


def classes_spelled_alike(findings: Findings) -> str | None:
    """Say that classes differ in capitals, spaces, hyphens or underscores only: their detections never meet."""
    groups: dict[str, list[str]] = {}
    for name in findings.labels.class_name.names:
        groups.setdefault("".join(letter for letter in name.casefold() if letter.isalnum()) or name, []).append(name)
    alike = [names for names in groups.values() if len(names) > 1]
    if not alike:
        return None
    shown = " and ".join(repr(name) for name in alike[0])
    return f"the classes {shown} differ in spelling only: detections of one hardly support labels of the other"


def cameras_not_upright(cosine_to_sky: Floats) -> str | None:
    """Say that most cameras (N cosines between their own up and the frame's) lie on their side or upside down."""
    lying = int(np.sum(cosine_to_sky < _UPRIGHT))
    if 2 * lying <= len(cosine_to_sky):
        return None
    return (
        f"{lying} of {len(cosine_to_sky)} cameras lie on their side or upside down: the order of the quaternions, the "
        "axes or the direction up may be another; valuemap check finds out"
    )


def heights_not_measured(vertical_sigma_px: Floats | None) -> str | None:
    """Say that the map takes heights of detections (N standard deviations, NaN where none is stated) for measured."""
    stated = 0 if vertical_sigma_px is None else int(np.isfinite(vertical_sigma_px).sum())
    if not stated or vertical_sigma_px is None:
        return None
    return (
        f"{stated} of {len(vertical_sigma_px)} detections have a vertical_sigma_px, which the map does not use: where "
        "it is large the heights of labels mean nothing, and their positions are less sure than their covariances say"
    )


NOTES: tuple[Callable[[Findings], str | None], ...] = (
    no_labels,
    unused_detections,
    confused_classes,
    noise_at_bound,
    implausible_size,
    close_twins,
    no_overlap,
    untested_covariances,
    classes_spelled_alike,
)
"""All of them, in the order in which they are told."""


def _twins(labels: Labels) -> list[tuple[int, int]]:
    """Return the rows of labels of one class whose difference is less than its standard deviation in that direction."""
    covariance = covariance_matrices(labels.covariance_m2)
    largest_m = float(np.sqrt(np.max(np.trace(covariance, axis1=1, axis2=2), initial=0.0)))
    if len(labels) < 2 or not largest_m > 0.0:
        return []
    reach_m = _TWIN_SIGMAS * math.sqrt(2.0) * largest_m
    place_m, code = labels.position_in_world_m, labels.class_name.codes
    pairs = np.stack(Nearby(place_m).pairs(place_m, reach_m), axis=1)
    pairs = pairs[(pairs[:, 0] < pairs[:, 1]) & (code[pairs[:, 0]] == code[pairs[:, 1]])]
    away_m = labels.position_in_world_m[pairs[:, 0]] - labels.position_in_world_m[pairs[:, 1]]
    both = covariance[pairs[:, 0]] + covariance[pairs[:, 1]]
    squared_sigmas = np.einsum("ni,nij,nj->n", away_m, np.linalg.pinv(both), away_m)
    rows = np.sort(pairs[squared_sigmas < _TWIN_SIGMAS**2], axis=1)
    return [(int(first), int(second)) for first, second in rows[np.lexsort(rows.T[::-1])]]
