"""What correcting poses costs and gains: every data set mapped with the stage and without.

    python benchmarks/poses_on_off.py [DATA_ROOT] [--only NAME ...] [--cities FIRST..LAST] [--json FILE]

DATA_ROOT holds `kitti_signs`, `kitti_ts`, `bend_ramps` and `london_tl`, as `field.py` and `kitti_signs.py` want them.
The simulated cities are those of `fleets.py --small` without a fault: four blocks, driven five times in both
directions, with poses as good as those of a survey. All settings are the defaults.

Where the stage corrects nothing, poses are those that were given, bit for bit, and so is the map: `off` is then not
made again. With --json, parts that the file has from earlier runs stay; its command and machine are those
of the last run.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import bend_ramps
import kitti_signs
import kitti_ts
import london_tl
import valuemap
from cities import city, seeds_from
from fleets import PASSES, RIGHT_M, SMALL
from machine import write_record
from valuemap.dataset import Dataset
from valuemap.map_folder import Map
from valuemap.simulate import simulate
from valuemap.tables.covariance import covariance_matrices

Part = tuple[str, Dataset, Callable[[Map], dict[str, Any]]]


def main() -> None:
    """Run the benchmark and print two lines for each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_root", type=Path, nargs="?", metavar="DATA_ROOT")
    parser.add_argument("--only", nargs="+", choices=["cities", *DATA], metavar="NAME", help="cities or a data set")
    parser.add_argument("--cities", nargs="+", default=["100..104"], metavar="N|FIRST..LAST", help="seeds")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    results: dict[str, Any] = {}
    if options.json is not None and options.json.is_file():
        results = json.loads(options.json.read_text(encoding="utf-8"))["results"]
    for name, dataset, score in _parts(options):
        results[name] = _on_and_off(dataset, score)
        print(f"{name:18} found {results[name]['found']:8} {results[name]['on']}", flush=True)
        if not results[name]["same"]:
            print(f"{'':18}     without   {results[name]['off']}", flush=True)
        write_record(options.json, dict(sorted(results.items())), data="city-...: simulated; all others: real")


def _on_and_off(dataset: Dataset, score: Callable[[Map], dict[str, Any]]) -> dict[str, Any]:
    on = valuemap.build_map(dataset)
    poses = on.run["poses"]
    figures = {
        "images": len(dataset.images),
        "detections": len(dataset.detections),
        "found": poses["found"],
        **{key: poses[key] for key in ("because", "misfit_before", "misfit_after", "price") if key in poses},
        "seconds_of_stage": next(stage["seconds"] for stage in on.run["stages"] if stage["stage"] == "poses"),
    }
    with_stage = score(on)
    if on.corrected is None:
        return {**figures, "same": True, "on": with_stage, "off": with_stage}
    off = valuemap.build_map(dataset, valuemap.MapConfig(correct_poses=0))
    return {**figures, "same": False, "on": with_stage, "off": score(off)}


def _parts(options: argparse.Namespace) -> Iterator[Part]:
    names = options.only or ["cities", *DATA]
    if "cities" in names:
        for seed in seeds_from(options.cities):
            yield _city(seed)
    for name, parts in DATA.items():
        if name in names and options.data_root is not None:
            yield from parts(options.data_root / name)


def _city(seed: int) -> Part:
    dataset = simulate(dataclasses.replace(city(PASSES), **SMALL), seed=seed)

    def score(result: Map) -> dict[str, Any]:
        figures = valuemap.evaluate_map(result, dataset, radius_m=RIGHT_M)
        names = ("recall", "precision", "position_rmse_m")
        return {"labels": len(result.labels), **{name: round(getattr(figures, name), 4) for name in names}}

    return f"city-{seed}", dataset, score


def _kitti_signs(data_dir: Path) -> Iterator[Part]:
    for sequence in kitti_signs.SEQUENCES:
        signs, is_evaluable = kitti_signs.read_signs(data_dir / sequence / "gt.csv")
        tracks = kitti_signs.read_points(data_dir / sequence / "reference_tracks.csv")

        def score(result: Map, signs: Any = signs, of: Any = is_evaluable, tracks: Any = tracks) -> dict[str, Any]:
            figures = kitti_signs.score_labels(result.labels.position_in_world_m, signs, of, tracks).to_json()
            return {name: value for name, value in figures.items() if "seconds" not in name and "paper" not in name}

        yield f"kitti_signs-{sequence}", kitti_signs.import_sequence(data_dir, sequence), score


def _kitti_ts(data_dir: Path) -> Iterator[Part]:
    def score(result: Map) -> dict[str, Any]:
        names = np.array(result.labels.class_name.names, str)[result.labels.class_name.codes]
        return kitti_ts.score_labels(result.labels.position_in_world_m[:, :2], names, *kitti_ts.truth(data_dir))

    yield "kitti_ts", kitti_ts.load(data_dir), score


def _bend(data_dir: Path) -> Iterator[Part]:
    def score(result: Map) -> dict[str, Any]:
        covariance = covariance_matrices(result.labels.covariance_m2)[:, :2, :2]
        truth = bend_ramps.truth(data_dir)
        return bend_ramps.score_labels(result.labels.position_in_world_m[:, :2], covariance, *truth)

    yield "bend_ramps", bend_ramps.load(data_dir), score


def _london(data_dir: Path) -> Iterator[Part]:
    def score(result: Map) -> dict[str, Any]:
        return london_tl.score_labels(result.labels.position_in_world_m[:, :2], london_tl.truth(data_dir))

    yield "london_tl", london_tl.load(data_dir), score


DATA: dict[str, Callable[[Path], Iterator[Part]]] = {
    "kitti_signs": _kitti_signs,
    "kitti_ts": _kitti_ts,
    "london_tl": _london,
    "bend_ramps": _bend,
}

if __name__ == "__main__":
    main()
