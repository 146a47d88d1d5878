"""More passes never hurt: one district mapped from 1, 2, 4, 8 and 16 tours of all its streets, each with those before.

The city of `robust.py` is recorded once on 17 tours (every street once in each direction). The maps are made from the
first tours, the last is in none of them. For each number of tours, over all seeds:

    recall             of the recoverable objects with three detections in these tours
    recall of first    of those of the first tour
    precision
    rmse               of the true labels, and of the objects that all maps hold
    held out           root mean square distance in px between the detections of the last tour and the labels of the
                       objects that they show, among the objects that all maps hold: the reprojection error of passes
                       that the labels were not made from. It cannot fall below that of the true positions, because
                       the last tour has errors of its own.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import valuemap
from cities import city, seeds_from
from machine import write_record
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import cast_rays
from valuemap.dataset import Dataset, rows_of
from valuemap.simulate import Recording, record_city
from valuemap.simulate.routes import routes_over_every_street

MIN_DETECTIONS = 3


@dataclass(frozen=True, eq=False)
class Mapped:
    """The map of some tours: which objects (N) count in its recall, and where their labels are (NaN for none)."""

    labels: int
    counts: Bools
    label_in_world_m: Floats
    seconds: float

    @property
    def is_found(self) -> Bools:
        """Which objects (N) have a label."""
        return np.isfinite(self.label_in_world_m[:, 0])


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", default=["0..4"], metavar="N|FIRST..LAST")
    parser.add_argument("--tours", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    districts = [_measure_district(seed, options.tours) for seed in seeds_from(options.seeds)]
    results = [{"tours": tours, **_figures(sums)} for tours, *sums in zip(options.tours, *districts, strict=True)]
    for name in results[0]:
        print(f"{name:28}" + "".join(f"{row[name]:>9}" for row in results))
    write_record(options.json, results)


def tour_of_images(recording: Recording) -> Ints:
    """Return for each image (N) which of the tours of all streets took it."""
    streets, config = recording.city.streets, recording.config
    passes = [
        len(routes_over_every_street(streets, config, seed=recording.seed, round_number=number))
        for number in range(config.passes_per_street)
    ]
    return np.searchsorted(np.cumsum(passes), recording.frames.pass_row, side="right")


def part_of(dataset: Dataset, rows: Bools) -> Dataset:
    """Return the dataset with some of its images only, and all of its truth."""
    images = dataset.images.take(rows)
    detections = dataset.detections.take(np.isin(dataset.detections.image_id, images.image_id))
    shown = dataset.truth_detections
    assert shown is not None
    return dataclasses.replace(
        dataset,
        images=images,
        detections=detections,
        truth_detections=shown.take(np.isin(shown.detection_id, detections.detection_id)),
    )


def reprojection_errors_px(dataset: Dataset, position_in_world_m: Floats, is_wanted: Bools) -> Floats:
    """Return how far (M) positions of the true objects (N, 3) project from the detections that show wanted ones (N)."""
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    shown = rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)
    detection = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    shown, detection = shown[is_wanted[shown]], detection[is_wanted[shown]]
    rays = cast_rays(dataset)
    offset = position_in_world_m[shown] - rays.center_in_world_m[detection]
    projected = np.einsum("nij,nj->ni", rays.residual_from_world[detection], offset)
    return np.asarray(np.linalg.norm(projected[:, :2] / projected[:, 2:], axis=1))


def _measure_district(seed: int, tours: list[int]) -> list[dict[str, float]]:
    """Return for each number of tours what `_figures` adds up."""
    recording = record_city(city(max(tours) + 1), seed=seed, name=f"district-{seed}")
    dataset, tour = recording.dataset, tour_of_images(recording)
    assert dataset.truth is not None
    truth_m = dataset.truth.position_in_world_m
    held_out = part_of(dataset, tour == max(tours))
    maps = [_map(part_of(dataset, tour < number)) for number in tours]
    first = maps[0].counts
    in_all = np.logical_and.reduce([one.is_found for one in maps])
    truth_px = reprojection_errors_px(held_out, truth_m, in_all)
    rows = []
    for one in maps:
        squared_m2 = np.sum((one.label_in_world_m - truth_m) ** 2, axis=1)
        held_out_px = reprojection_errors_px(held_out, one.label_in_world_m, in_all)
        sums = {
            "objects": one.counts.sum(),
            "found": (one.counts & one.is_found).sum(),
            "objects_of_first": first.sum(),
            "found_of_first": (first & one.is_found).sum(),
            "labels": one.labels,
            "true_labels": one.is_found.sum(),
            "squared_m2": np.nansum(squared_m2),
            "in_all": in_all.sum(),
            "squared_in_all_m2": squared_m2[in_all].sum(),
            "held_out": len(held_out_px),
            "held_out_px2": np.sum(held_out_px**2),
            "held_out_of_truth_px2": np.sum(truth_px**2),
            "seconds": one.seconds,
        }
        rows.append({name: float(value) for name, value in sums.items()})
    return rows


def _map(dataset: Dataset) -> Mapped:
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    start = time.perf_counter()
    result = valuemap.build_map(dataset)
    seconds = time.perf_counter() - start
    matches = valuemap.evaluate_map(result, dataset).matches
    shown = rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)
    detections = np.bincount(shown, minlength=len(dataset.truth))
    label_in_world_m = np.full((len(dataset.truth), 3), np.nan)
    is_found = matches.label_of_object >= 0
    label_in_world_m[is_found] = result.labels.position_in_world_m[matches.label_of_object[is_found]]
    counts = matches.objects.counts_in_recall & (detections >= MIN_DETECTIONS)
    return Mapped(len(result.labels), counts, label_in_world_m, seconds)


def _figures(districts: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the figures of one number of tours over all districts."""
    total = {name: sum(sums[name] for sums in districts) for name in districts[0]}

    def share(part: str, whole: str) -> float:
        return round(total[part] / total[whole], 4) if total[whole] else float("nan")

    return {
        "objects": int(total["objects"]),
        "labels": int(total["labels"]),
        "recall": share("found", "objects"),
        "recall_of_first": share("found_of_first", "objects_of_first"),
        "precision": share("true_labels", "labels"),
        "position_rmse_m": round(share("squared_m2", "true_labels") ** 0.5, 3),
        "position_rmse_in_all_m": round(share("squared_in_all_m2", "in_all") ** 0.5, 3),
        "held_out_px": round(share("held_out_px2", "held_out") ** 0.5, 3),
        "held_out_of_truth_px": round(share("held_out_of_truth_px2", "held_out") ** 0.5, 3),
        "seconds": round(total["seconds"], 2),
    }


if __name__ == "__main__":
    main()
