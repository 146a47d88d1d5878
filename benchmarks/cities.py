"""Simulated cities and how good their maps are: what the benchmarks of the robust method share."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import valuemap
from bound import cramer_rao_covariances, true_views
from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.dataset import rows_of
from valuemap.simulate import Recording, record_city
from valuemap.simulate.detector import KINDS
from valuemap.tables.covariance import covariance_matrices

RELIABILITY_RANGES = ((0.5, 0.6), (0.6, 0.7), (0.7, 0.8), (0.8, 0.9), (0.9, 0.99), (0.99, 1.0), (0.9, 1.0))
PASSING_KINDS = ("temporary", "reflections")
"""False things that only one pass meets."""
LEAST_DETECTIONS_OF_PASSING = 3


def city(passes: int, **changes: float) -> SimulationConfig:
    """Return a city of four by four signalised streets, without lookalikes, driven so often in each direction."""
    settings: dict[str, float] = {
        "streets_north_south": 4,
        "streets_east_west": 4,
        "signalised_share": 1.0,
        "passes_per_street": passes,
        "lookalikes_per_light": 0.0,
    }
    return dataclasses.replace(SimulationConfig(), **{**settings, **changes})  # type: ignore[arg-type]


def seeds_from(texts: Sequence[str]) -> list[int]:
    """Return the seeds that a command line asks for: numbers, and ranges such as 100..109 with both ends."""
    seeds: list[int] = []
    for text in texts:
        first, dots, last = text.partition("..")
        if not (first.isdecimal() and (last.isdecimal() or not dots)):
            raise SystemExit(f"--seeds {text}: expected a whole number or a range such as 100..109")
        seeds += range(int(first), int(last or first) + 1)
    return seeds


@dataclass(frozen=True, eq=False)
class Case:
    """A recorded city; for each of its objects the Cramer-Rao bound (N, 3, 3) in m² and how many images detected it."""

    recording: Recording
    bound_m2: Floats
    detections: Ints


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of the objects that count, of all labels, and of the false things that passed by.

    The squared errors and their bounds (N), in m², are of the objects that count and are found; `normalised_error`
    (N) is of all true labels: squared Mahalanobis distances by the labels' own covariances. `is_real` (labels) says
    which are matched with an object, `existence` (labels) what the map thinks of it, if anything.
    """

    objects: int
    found: int
    false_positives: int
    duplicates: int
    squared_error_m2: Floats
    squared_bound_m2: Floats
    normalised_error: Floats
    is_real: Bools
    existence: Floats | None
    passing: dict[str, tuple[int, int]]
    seconds: float


def prepare(config: SimulationConfig, seed: int) -> Case:
    """Record a city and compute its bounds."""
    recording = record_city(config, seed=seed, name=f"city-{seed}")
    truth, shown = recording.dataset.truth, recording.dataset.truth_detections
    assert truth is not None
    assert shown is not None
    detections = np.bincount(rows_of(shown.object_id, truth.object_id), minlength=len(truth))
    return Case(recording, cramer_rao_covariances(true_views(recording), config, len(truth)), detections)


def measure(case: Case, config: valuemap.MapConfig, *, min_detections: int = 3) -> Outcome:
    """Map a city and compare with the truth: objects count that are recoverable and have so many detections."""
    start = time.perf_counter()
    result = valuemap.build_map(case.recording.dataset, config)
    return compare(case, result, time.perf_counter() - start, min_detections=min_detections)


def compare(
    case: Case, result: valuemap.Map, seconds: float, *, min_detections: int = 3, max_bound_m: float = np.inf
) -> Outcome:
    """Compare a map that took so long with the truth: as `measure`, and objects count whose bound is no larger."""
    dataset = case.recording.dataset
    assert dataset.truth is not None
    evaluation = valuemap.evaluate_map(result, dataset)
    matches, labels = evaluation.matches, result.labels
    counts = matches.objects.counts_in_recall & (case.detections >= min_detections)
    counts &= np.trace(case.bound_m2, axis1=1, axis2=2) <= max_bound_m**2

    is_real = matches.object_of_label >= 0
    objects = matches.object_of_label[is_real]
    error = labels.position_in_world_m[is_real] - dataset.truth.position_in_world_m[objects]
    covariance = covariance_matrices(labels.stated_covariance_m2[is_real])
    return Outcome(
        objects=int(counts.sum()),
        found=int((counts & (matches.label_of_object >= 0)).sum()),
        false_positives=evaluation.false_positives,
        duplicates=evaluation.duplicates,
        squared_error_m2=np.sum(error**2, axis=1)[counts[objects]],
        squared_bound_m2=np.trace(case.bound_m2[objects[counts[objects]]], axis1=1, axis2=2),
        normalised_error=np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]),
        is_real=is_real,
        existence=labels.existence,
        passing=passing_things(case.recording, result),
        seconds=seconds,
    )


def passing_things(recording: Recording, result: valuemap.Map) -> dict[str, tuple[int, int]]:
    """Return for each of PASSING_KINDS how many there were with three detections, and how many of these have a label.

    A label is of a false thing if more than half of its voters show that one.
    """
    kind, thing = recording.boxes.kind, recording.boxes.thing_row
    voter = rows_of(result.votes.detection_id, recording.dataset.detections.detection_id)
    label = rows_of(result.votes.label_id, result.labels.label_id)
    told = {}
    for name in PASSING_KINDS:
        is_kind = kind == KINDS.index(name)
        detections = np.bincount(thing[is_kind])
        is_voter = is_kind[voter]
        pairs, votes = np.unique(
            np.stack([label[is_voter], thing[voter[is_voter]]], axis=1), axis=0, return_counts=True
        )
        is_of_thing = 2 * votes > result.labels.votes[pairs[:, 0]]
        has_label = np.isin(np.arange(len(detections)), pairs[is_of_thing, 1])
        counts = detections >= LEAST_DETECTIONS_OF_PASSING
        told[name] = int(counts.sum()), int((counts & has_label).sum())
    return told


def add_up(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the figures of several cities together."""
    objects, found = sum(o.objects for o in outcomes), sum(o.found for o in outcomes)
    is_real = np.concatenate([o.is_real for o in outcomes])
    error, bound, normalised = (
        np.concatenate([getattr(o, name) for o in outcomes])
        for name in ("squared_error_m2", "squared_bound_m2", "normalised_error")
    )
    figures: dict[str, Any] = {
        "cities": len(outcomes),
        "objects": objects,
        "labels": len(is_real),
        "recall": ratio(found, objects),
        "precision": ratio(int(is_real.sum()), len(is_real)),
        "false_positives_per_label": ratio(sum(o.false_positives for o in outcomes), len(is_real)),
        "duplicates_per_label": ratio(sum(o.duplicates for o in outcomes), len(is_real)),
        "position_rmse_m": ratio(float(error.sum()), len(error)) ** 0.5,
        "rmse_over_bound": ratio(float(error.sum()), float(bound.sum())) ** 0.5,
        "mean_normalised_error": ratio(float(normalised.sum()), len(normalised)),
        "median_normalised_error": float(np.median(normalised)) if len(normalised) else 0.0,
    }
    for name in PASSING_KINDS:
        things, labelled = np.sum([o.passing[name] for o in outcomes], axis=0).tolist()
        figures[name] = {"with_3_detections": things, "with_label": labelled}
    existence = [o.existence for o in outcomes if o.existence is not None]
    if len(existence) == len(outcomes):
        figures["reliability"] = reliability(np.concatenate(existence), is_real)
    figures["seconds"] = sum(o.seconds for o in outcomes)
    return {name: round(value, 4) if isinstance(value, float) else value for name, value in figures.items()}


def reliability(existence: Floats, is_real: Bools) -> list[dict[str, float]]:
    """Return, for ranges of the probability of existence, how many labels there are and which share is real.

    A duplicate is not real. The last range holds the two before it.
    """
    rows = []
    for low, high in RELIABILITY_RANGES:
        inside = (existence >= low) & ((existence < high) | (high == 1.0))
        if inside.any():
            share = round(float(is_real[inside].mean()), 3)
            rows.append({"from": low, "to": high, "labels": int(inside.sum()), "real": share})
    return rows


def ratio(part: float, whole: float) -> float:
    """Return a share; 0 of nothing."""
    return part / whole if whole else 0.0


def line(name: str, figures: dict[str, Any]) -> str:
    """Return the figures that matter most in one line."""
    return (
        f"{name:30} recall {figures['recall']:.4f}  precision {figures['precision']:.4f}  "
        f"false {figures['false_positives_per_label']:.4f}  duplicates {figures['duplicates_per_label']:.4f}  "
        f"rmse {figures['position_rmse_m']:.3f} m = {figures['rmse_over_bound']:.2f} bounds  "
        f"normalised error {figures['mean_normalised_error']:.2f}  {figures['seconds']:.1f} s"
    )
