"""How good the robust method is on simulated cities: seeds and densities, beside the paper's method at its best alpha.

A city of four by four signalised streets is driven 2, 6 and 20 times through every street in both directions, without
lookalikes. Everything is simulated. Counted over all seeds of a density: recall of the recoverable objects with at
least three detections, false positives and duplicates over labels, position rmse over the Cramer-Rao bound for the
same views and noise (from the true associations, with the true noise and the drift that the images of a pass share),
and the mean squared normalised error of the labels' own covariances (3 if they are honest).
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import valuemap
from bound import cramer_rao_covariances
from machine import describe_machine
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset
from valuemap.simulate import simulate

ALPHAS = (1.0, 1.1, 1.25, 1.5)
RELIABILITY_BINS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.99, 1.0)
MIN_DETECTIONS = 3


def city(passes: int, **changes: float) -> SimulationConfig:
    """Return the city of the benchmark with a number of passes through every street."""
    settings: dict[str, float] = {
        "streets_north_south": 4,
        "streets_east_west": 4,
        "signalised_share": 1.0,
        "passes_per_street": passes,
        "lookalikes_per_light": 0.0,
    }
    return dataclasses.replace(SimulationConfig(), **{**settings, **changes})  # type: ignore[arg-type]


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--passes", type=int, nargs="+", default=[2, 6, 20])
    parser.add_argument("--no-paper", action="store_true", help="leave the paper's method out")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    results: list[dict[str, Any]] = []
    for passes in options.passes:
        datasets = [simulate(city(passes), seed=seed, name=f"city-{seed}") for seed in options.seeds]
        results.append(_over_seeds(datasets, valuemap.MapConfig(), f"{passes} passes"))
        if not options.no_paper:
            best = [_over_seeds(datasets, _paper(alpha), f"{passes} passes, paper, alpha {alpha}") for alpha in ALPHAS]
            results.append(
                max(best, key=lambda r: 2.0 / (1.0 / max(r["recall"], 1e-9) + 1.0 / max(r["precision"], 1e-9)))
            )
        for result in results[-2 if not options.no_paper else -1 :]:
            print(_line(result), flush=True)
    if options.json:
        command = ("python benchmarks/robust.py " + " ".join(sys.argv[1:])).strip()
        record = {"command": command, "data": "simulated", **describe_machine(), "results": results}
        options.json.write_text(json.dumps(record, indent=2) + "\n")


def _paper(alpha: float) -> valuemap.MapConfig:
    return valuemap.MapConfig(method="paper").with_settings([f"min_vote_ratio={alpha}"])


def _over_seeds(datasets: list[Dataset], config: valuemap.MapConfig, name: str) -> dict[str, Any]:
    each = [_measure(dataset, config) for dataset in datasets]

    def total(key: str) -> float:
        return float(sum(one[key] for one in each))

    labels, squares, bounds = total("labels"), total("square_error_m2"), total("square_bound_m2")
    outcomes = np.concatenate([one["outcomes"] for one in each])
    return {
        "name": name,
        "seeds": len(each),
        "objects": int(total("objects")),
        "labels": int(labels),
        "recall": round(total("found") / total("objects"), 4),
        "precision": round(total("true_positives") / labels, 4) if labels else 0.0,
        "false_positives_per_label": round(total("false_positives") / labels, 4) if labels else 0.0,
        "duplicates_per_label": round(total("duplicates") / labels, 4) if labels else 0.0,
        "position_rmse_m": round((squares / total("true_positives")) ** 0.5, 4),
        "rmse_over_bound": round((squares / bounds) ** 0.5, 3),
        "mean_normalised_error": round(total("normalised_error") / total("true_positives"), 2),
        "median_normalised_error": round(float(np.median(np.concatenate([one["normalised"] for one in each]))), 2),
        "reliability": _reliability(outcomes),
        "seconds": round(total("seconds"), 2),
    }


def _measure(dataset: Dataset, config: valuemap.MapConfig) -> dict[str, Any]:
    start = time.perf_counter()
    result = valuemap.build_map(dataset, config)
    seconds = time.perf_counter() - start
    evaluation = valuemap.evaluate_map(result, dataset)
    matches, labels = evaluation.matches, result.labels
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    views = np.bincount(
        np.searchsorted(dataset.truth.object_id, dataset.truth_detections.object_id), minlength=len(dataset.truth)
    )
    counted = matches.objects.counts_in_recall & (views >= MIN_DETECTIONS)
    found = matches.object_of_label >= 0
    objects = matches.object_of_label[found]
    error = labels.position_in_world_m[found] - dataset.truth.position_in_world_m[objects]
    xx, xy, xz, yy, yz, zz = labels.covariance_m2[found].T
    covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    # Every city here has the simulator's default noise.
    bound = cramer_rao_covariances(dataset, SimulationConfig())[objects]
    existence = np.ones(len(labels)) if labels.existence is None else labels.existence
    return {
        "objects": int(counted.sum()),
        "found": int((counted & (matches.label_of_object >= 0)).sum()),
        "labels": len(labels),
        "true_positives": evaluation.true_positives,
        "false_positives": evaluation.false_positives,
        "duplicates": evaluation.duplicates,
        "square_error_m2": float(np.sum(error**2)),
        "square_bound_m2": float(np.trace(bound, axis1=1, axis2=2).sum()),
        "normalised_error": float(normalised.sum()),
        "normalised": normalised,
        "outcomes": np.stack([existence, found], axis=1),
        "seconds": seconds,
    }


def _reliability(outcomes: np.ndarray[Any, np.dtype[np.float64]]) -> list[dict[str, float]]:
    """Return, for ranges of the probability of existence, how many labels there are and which share is real."""
    rows = []
    for low, high in itertools.pairwise(RELIABILITY_BINS):
        inside = (outcomes[:, 0] >= low) & ((outcomes[:, 0] < high) | (high == 1.0))
        if inside.any():
            share = float(outcomes[inside, 1].mean())
            rows.append({"from": low, "to": high, "labels": int(inside.sum()), "real": round(share, 3)})
    return rows


def _line(result: dict[str, Any]) -> str:
    return (
        f"{result['name']:30} recall {result['recall']:.3f}  false {result['false_positives_per_label']:.3f}  "
        f"duplicates {result['duplicates_per_label']:.4f}  rmse {result['position_rmse_m']:.3f} m = "
        f"{result['rmse_over_bound']:.2f} bounds  normalised error {result['mean_normalised_error']:.2f}  "
        f"{result['seconds']:.1f} s"
    )


if __name__ == "__main__":
    main()
