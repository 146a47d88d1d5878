"""Rejected stays rejected: hundreds of rejected labels, and new maps of the same city from other passes.

A city is recorded on several passes of every street. A first map is made from some of them, and people reject labels
of it at random. Then maps are made from other, random passes each. Whether a rejected object has come back is judged by
the truth, which the review knows nothing of: a label of the new map that is matched with the same true object must be
found by the decision about it. Counted over all new maps:

    again         rejected objects that the new map has a label of
    rejected      of these, labels that the review leaves out
    check again   of these, labels that the review leaves out and asks about: they have twice the votes, or could be
                  what was rejected as well as another label
    reappeared    of these, labels that the review would let through: must be 0
    wrongly out   labels of objects that nobody rejected, left out by a decision about another one
    asked         labels of objects that nobody rejected, left out and asked about
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from machine import write_record
from valuemap import build_map
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset
from valuemap.evaluate import evaluate_map
from valuemap.map_folder import Map
from valuemap.review import Decision, decide, match_decisions, state_of
from valuemap.simulate import simulate

CITY = SimulationConfig(
    streets_north_south=10,
    streets_east_west=9,
    signalised_share=0.9,
    lights=560,
    lights_per_approach=1.7,
    passes_per_street=6,
    frame_spacing_m=4.0,
    standing_interval_s=1.0,
    keep_before_signal_m=60.0,
)


def main() -> None:
    """Run the benchmark and print what came back."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rejected", type=int, default=500)
    parser.add_argument("--maps", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    random = np.random.default_rng(given.seed)
    dataset = simulate(CITY, seed=given.seed)
    first = build_map(_some_passes(dataset, random))
    true_object = _object_of_label(first, dataset)
    rows = np.flatnonzero(true_object >= 0)
    rows = np.sort(random.choice(rows, min(given.rejected, len(rows)), replace=False))
    decisions = [decide(first, int(first.labels.label_id[row]), "rejected", dataset=dataset) for row in rows]
    rejected = set(true_object[rows].tolist())
    maps = [_come_back(_some_passes(dataset, random), dataset, decisions, rejected) for _ in range(given.maps)]
    total = {name: sum(each[name] for each in maps) for name in maps[0]}
    results = {"rejected labels": len(rows), "maps": len(maps), **total, "each": maps}
    print({name: value for name, value in results.items() if name != "each"})
    write_record(given.json, results)


def _some_passes(dataset: Dataset, random: np.random.Generator) -> Dataset:
    """Return the images of half of the passes, and what was detected in them."""
    codes = dataset.images.pass_id.codes
    passes = np.unique(codes)
    images = dataset.images.take(np.isin(codes, random.choice(passes, len(passes) // 2, replace=False)))
    detections = dataset.detections.take(np.isin(dataset.detections.image_id, images.image_id))
    return Dataset(dataset.name, dataset.frame, dataset.cameras, images, detections, truth=dataset.truth)


def _object_of_label(result: Map, dataset: Dataset) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    return evaluate_map(result, dataset).matches.object_of_label


def _come_back(some: Dataset, whole: Dataset, decisions: list[Decision], rejected: set[int]) -> dict[str, int]:
    result = build_map(some)
    object_of_label = _object_of_label(result, whole)
    matches = match_decisions(decisions, result, some)
    state = ["open"] * len(result.labels)
    for row in matches.unsure:
        state[row] = "check again"
    for decision, row in zip(decisions, matches.row_of_decision, strict=True):
        if row >= 0:
            state[row] = state_of(decision, result.labels, int(row))
    again = [state[row] for row, each in enumerate(object_of_label) if int(each) in rejected]
    others = [state[row] for row, each in enumerate(object_of_label) if each >= 0 and int(each) not in rejected]
    return {
        "again": len(again),
        "rejected": again.count("rejected"),
        "check again": again.count("check again"),
        "reappeared": again.count("open"),
        "wrongly out": others.count("rejected"),
        "asked": others.count("check again"),
    }


if __name__ == "__main__":
    main()
