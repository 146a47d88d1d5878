"""How good a map is when the poses of a fleet are far worse than those of a survey.

The city of `robust.py`, driven twenty times through every street in both directions, without faults and with one fault
of the poses or of the camera each. All settings of the method are its defaults. For each fault, over all seeds:

    recall         of the recoverable objects with three detections, and precision; a label is right within 4 m
    rmse           of the right labels, wherever the whole map may have been shifted to
    between        root mean square error of the vector from one object to another within 50 m, over the pairs that are
                   found with the fault and without
    ratio          of that to the same without the fault: what the fault costs where neighbours count
    bound          the Cramer-Rao bound of `between` (`bound.py`) with the noise of the poses that is simulated, if it
                   were known which detection shows which object, and what whole drives and cameras are wrong by
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import valuemap
from bound import joint_cramer_rao_covariance, true_views
from cities import city, ratio, seeds_from
from machine import write_record
from valuemap.arrays import Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.dataset import rows_of
from valuemap.simulate import record_city

PASSES = 20
SMALL: dict[str, Any] = {"streets_north_south": 2, "streets_east_west": 2, "passes_per_street": 5}
RIGHT_M = 4.0
NEIGHBOR_M = 50.0
MIN_DETECTIONS = 3
CLEAN = "clean"
FAULTS: dict[str, dict[str, float]] = {
    CLEAN: {},
    "shift-1.5": {"pass_shift_m": 1.5},
    "shift-3": {"pass_shift_m": 3.0},
    "height-3": {"pass_shift_m": 1.5, "pass_height_m": 3.0},
    "yaw-1": {"pass_yaw_deg": 1.0},
    "late-100": {"pose_delay_s": 0.1},
    "jumps-1": {"jump_m": 1.0},
    "jumps-3": {"jump_m": 3.0},
    "focal-2": {"focal_error_share": 0.02},
    "dashcam": {
        "position_white_m": 0.48,
        "position_drift_m": 0.64,
        "rotation_white_deg": 0.3,
        "rotation_drift_deg": 0.4,
    },
}
"""Settings of the simulator by the name of the fault; a dash camera is 0.8 m and 0.5 degrees off on each axis, and
receivers are twice as far off in height as on the ground."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one city: `error_m` (objects, 3) is that of the label of each, NaN without a right one.

    `bound_m2` (objects, 3, objects, 3) is the least covariance of these errors.
    """

    objects: int
    found: int
    labels: int
    position_in_world_m: Floats
    error_m: Floats
    bound_m2: Floats
    detections: int
    seconds: float


def main() -> None:
    """Run the benchmark and print a line for each fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=FAULTS, default=list(FAULTS), metavar="FAULT")
    parser.add_argument("--seeds", nargs="+", default=["0..4"], metavar="N|FIRST..LAST")
    parser.add_argument("--small", action="store_true", help="a city of four blocks, driven five times")
    parser.add_argument(
        "--passes", type=int, metavar="N", help=f"passes in each direction [default: {PASSES}, small 5]"
    )
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE", help="of the map")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    config = valuemap.MapConfig().with_settings(options.settings)
    plain = dataclasses.replace(city(PASSES), **(SMALL if options.small else {}))
    if options.passes is not None:
        plain = dataclasses.replace(plain, passes_per_street=options.passes)
    seeds = seeds_from(options.seeds)
    clean = [map_city(plain, seed, config) for seed in seeds]
    results: list[dict[str, Any]] = []
    for name in options.only:
        faulty = dataclasses.replace(plain, **FAULTS[name])  # type: ignore[arg-type]
        outcomes = clean if name == CLEAN else [map_city(faulty, seed, config) for seed in seeds]
        results.append({"name": name, **add_up(outcomes, clean)})
        print(_line(results[-1]), flush=True)
        write_record(options.json, results)


def map_city(simulation: SimulationConfig, seed: int, config: valuemap.MapConfig) -> Outcome:
    """Simulate a city, map it and compare with the truth."""
    recording = record_city(simulation, seed=seed, name=f"city-{seed}")
    dataset = recording.dataset
    truth, shown = dataset.truth, dataset.truth_detections
    assert truth is not None
    assert shown is not None
    start = time.perf_counter()
    result = valuemap.build_map(dataset, config)
    seconds = time.perf_counter() - start
    matches = valuemap.evaluate_map(result, dataset, radius_m=RIGHT_M).matches
    detections = np.bincount(rows_of(shown.object_id, truth.object_id), minlength=len(truth))
    counts = matches.objects.counts_in_recall & (detections >= MIN_DETECTIONS)
    is_found = matches.label_of_object >= 0
    error_m = np.full((len(truth), 3), np.nan)
    error_m[is_found] = (
        result.labels.position_in_world_m[matches.label_of_object[is_found]] - truth.position_in_world_m[is_found]
    )
    return Outcome(
        objects=int(counts.sum()),
        found=int((counts & is_found).sum()),
        labels=len(result.labels),
        position_in_world_m=truth.position_in_world_m,
        error_m=error_m,
        bound_m2=joint_cramer_rao_covariance(true_views(recording), simulation, len(truth)),
        detections=len(dataset.detections),
        seconds=seconds,
    )


def neighbors(outcome: Outcome, other: Outcome) -> tuple[Ints, Ints]:
    """Return the pairs (P) of near objects that both maps hold."""
    pairs = cKDTree(outcome.position_in_world_m).query_pairs(NEIGHBOR_M, output_type="ndarray")
    is_found = np.isfinite(outcome.error_m[:, 0]) & np.isfinite(other.error_m[:, 0])
    a, b = pairs[is_found[pairs].all(axis=1)].T
    return a, b


def squared_errors_between(outcome: Outcome, other: Outcome) -> Floats:
    """Return squared errors (P), m², of the vectors between near objects that both maps hold, in the first map."""
    a, b = neighbors(outcome, other)
    return np.asarray(np.sum((outcome.error_m[a] - outcome.error_m[b]) ** 2, axis=1))


def squared_bounds_between(outcome: Outcome, other: Outcome) -> Floats:
    """Return the least that squared errors between near objects (P), m², can be in the mean."""
    a, b = neighbors(outcome, other)
    of_both = [outcome.bound_m2[i, :, j, :] for i, j in ((a, a), (b, b), (a, b))]
    first, second, together = (np.einsum("pii->p", part) for part in of_both)
    return np.asarray(first + second - 2.0 * together)


def add_up(outcomes: Sequence[Outcome], clean: Sequence[Outcome]) -> dict[str, Any]:
    """Return the figures of several cities together, beside those of the same cities without the fault."""
    objects, labels = sum(o.objects for o in outcomes), sum(o.labels for o in outcomes)
    errors_m2 = np.concatenate([np.sum(o.error_m**2, axis=1) for o in outcomes])
    between, between_in_clean = (
        np.sqrt(np.mean(np.concatenate([squared_errors_between(*pair) for pair in zip(ours, theirs, strict=True)])))
        for ours, theirs in ((outcomes, clean), (clean, outcomes))
    )
    bound = np.sqrt(
        np.mean(np.concatenate([squared_bounds_between(*pair) for pair in zip(outcomes, clean, strict=True)]))
    )
    figures = {
        "recall": ratio(sum(o.found for o in outcomes), objects),
        "precision": ratio(int(np.isfinite(errors_m2).sum()), labels),
        "position_rmse_m": float(np.sqrt(np.nanmean(errors_m2))),
        "rmse_between_neighbors_m": float(between),
        "ratio_to_clean": float(between / between_in_clean),
        "bound_between_neighbors_m": float(bound),
        "seconds": sum(o.seconds for o in outcomes),
    }
    return {
        "seeds": len(outcomes),
        "objects": objects,
        "labels": labels,
        "detections": sum(o.detections for o in outcomes),
        **{name: round(value, 4) for name, value in figures.items()},
    }


def _line(figures: dict[str, Any]) -> str:
    return (
        f"{figures['name']:10} objects {figures['objects']:4d}  labels {figures['labels']:4d}  "
        f"recall {figures['recall']:.4f}  precision {figures['precision']:.4f}  "
        f"rmse {figures['position_rmse_m']:.3f} m  between neighbours {figures['rmse_between_neighbors_m']:.3f} m = "
        f"{figures['ratio_to_clean']:.2f} of clean  bound {figures['bound_between_neighbors_m']:.3f} m  "
        f"{figures['detections']} detections  {figures['seconds']:.1f} s"
    )


if __name__ == "__main__":
    main()
