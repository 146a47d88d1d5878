"""All benchmarks on real data with one command: what the default method does outside our own cities.

    python benchmarks/field.py DATA_ROOT [--only NAME ...] [--laws] [--thinned TIMES] [--json FILE] [--method NAME]
                               [--set name=value ...]

DATA_ROOT has a folder a data set, named as here; what each holds and what is counted stands at the top of the script of
that name. A data set whose folder is not there is said and left out. With --thinned each is mapped TIMES times more,
each time without another tenth of its detections: how much the figures are chance. With --laws the laws of `laws.py`
follow: shuffled ids, renamed passes, a world of another size.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import av2_static
import bend_ramps
import kitti_signs
import kitti_ts
import laws
import london_tl
import peers
from field_data import Change, Figures, as_it_is
from machine import describe_machine, keep_record
from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.errors import InputError, ValuemapError
from valuemap.system import peak_memory_mb

RUNS: dict[str, Callable[[Path, MapConfig, Change], dict[str, Figures]]] = {
    "kitti_signs": kitti_signs.run,
    "av2_static": av2_static.run,
    "london_tl": london_tl.run,
    "kitti_ts": kitti_ts.run,
    "bend_ramps": bend_ramps.run,
}

LEFT_OUT = 0.1
"""The share of the detections that is left out of what is thinned."""

SHOWN: dict[str, tuple[tuple[str, str, str], ...]] = {
    "kitti_signs": (
        ("signs_found_2m", "signs found of 27, 2 m", ">= 26"),
        ("signs_found_1m", "signs found of 27, 1 m", ">= 25"),
        ("tracks_one_to_one", "tracks one to one of 80", ">= 77"),
        ("precision", "precision", ">= 0.94"),
        ("duplicate_labels", "duplicates", ""),
        ("median_distance_survey_m", "median to survey, m", "<= paper's"),
        ("median_distance_survey_paper_m", "the same of paper, m", ""),
    ),
    "av2_static": (
        ("recall", "recall of 18", ">= 0.95"),
        ("precision_one_to_one", "precision", ">= 0.95"),
        ("duplicate_labels", "duplicates", ""),
        ("median_distance_m", "median, m", ""),
    ),
    "london_tl": (
        ("f1_6m", "F1 at 6 m", ">= 0.70"),
        ("true_6m", "true", ""),
        ("false_6m", "false", ""),
        ("missed_6m", "missed", ""),
        ("f1_3m", "F1 at 3 m", ""),
    ),
    "kitti_ts": (
        ("recall_1m", "R@1 m of 216", ">= 0.45"),
        ("recall_2m", "R@2 m", ""),
        ("labels", "labels", ""),
        ("precision_2m", "precision at 2 m", ""),
        ("duplicate_labels_2m", "duplicates", ""),
        ("facing_right", "face as said, 45 deg", ">= 0.86"),
    ),
    "bend_ramps": (
        ("covered", "covered of 5771", ">= 0.709"),
        ("unmatched", "unmatched", "<= 0.093"),
        ("median_distance_m", "median, m", "<= 0.461"),
        ("sigma_per_axis_m", "sigma per axis, m", "<= 0.334"),
        ("in_95_ellipse_less_bias", "in 95 % ellipse, less bias", ">= 0.67"),
        ("in_95_ellipse", "in 95 % ellipse", ""),
        ("labels", "labels", ""),
    ),
}
"""The figures of the compact table: name, words, and what is to be reached."""


def run(data_root: Path, config: MapConfig, only: list[str] | None = None) -> dict[str, dict[str, Figures]]:
    """Run the benchmarks named, or all whose data is there; return figures by data set and part."""
    names = _names(data_root, only)
    for name in RUNS:
        if name not in names:
            print(f"left out: {name}", file=sys.stderr)
    results = {}
    for name in names:
        start = time.perf_counter()
        results[name] = RUNS[name](data_root / name, config, as_it_is)
        total = list(results[name].values())[-1]
        print(_lines(name, total, time.perf_counter() - start), flush=True)
        if name == "av2_static":
            print(_by_class(results[name]), flush=True)
    return results


def _names(data_root: Path, only: list[str] | None) -> list[str]:
    names = only or [name for name in RUNS if (data_root / name).is_dir()]
    if not names:
        raise InputError(f"{data_root}: none of {', '.join(RUNS)} in it", hint="give the folder that holds the data")
    return names


def run_thinned(
    data_root: Path, config: MapConfig, only: list[str] | None, times: int
) -> dict[str, dict[str, list[float | None]]]:
    """Run the same as often, each time without another tenth of the detections; return what each figure was."""
    names = _names(data_root, only)
    jobs = [(data_root / name, config, seed) for name in names for seed in range(times)]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        totals = list(pool.map(_run_thin, jobs))
    results = {}
    for row, name in enumerate(names):
        of_name = totals[row * times : (row + 1) * times]
        results[name] = {figure: [total[figure] for total in of_name] for figure, *_ in SHOWN[name]}
        print(f"{name}, thinned {times} times: least, middle and most")
        for figure, words, goal in SHOWN[name]:
            found = np.array([np.nan if value is None else value for value in results[name][figure]])
            print(f"    {words:28}{found.min():>9.4g}{np.median(found):>9.4g}{found.max():>9.4g}  {goal}")
    return results


def _run_thin(job: tuple[Path, MapConfig, int]) -> Figures:
    data_dir, config, seed = job

    def thin(dataset: Dataset) -> Dataset:
        is_kept = np.random.default_rng(seed).random(len(dataset.detections)) >= LEFT_OUT
        return dataclasses.replace(dataset, detections=dataset.detections.take(is_kept))

    return list(RUNS[data_dir.name](data_dir, config, thin).values())[-1]


def _lines(name: str, total: dict[str, Any], seconds: float) -> str:
    lines = [f"{name} (map {total['map_seconds']:.2f} s, whole {seconds:.1f} s)"]
    for figure, words, goal in SHOWN[name]:
        value = total[figure]
        lines.append(f"    {words:28}{'-' if value is None else value:>9}  {goal}")
    return "\n".join(lines)


def _by_class(results: dict[str, Figures]) -> str:
    """Return one line a class: the parts that are no logs and not the total."""
    classes = {part: figures for part, figures in results.items() if part != "total" and "map_seconds" not in figures}
    return "\n".join(
        f"    {part.lower():28}{figures['found']} of {figures['objects']}, {figures['labels']} labels"
        for part, figures in classes.items()
    )


PEERS_HEAD = """
# valuemap and its peers on the same real detections

Made by `make bench-field FIELD_DATA=FOLDER`. Krylov's Markov random field is our own writing from the paper; "given"
means that the association was read from the truth, which no method knows: bounds, not methods. What the peers are:
`benchmarks/peers.py`. What the figures are: the scripts named as the data sets.
"""


TABLE: dict[str, tuple[str, ...]] = {
    "london_tl": ("f1_6m", "true_6m", "false_6m", "missed_6m", "f1_3m"),
    "london_tl bearings": ("f1_6m", "true_6m", "false_6m", "missed_6m", "f1_3m"),
    "bend_ramps": ("covered", "unmatched", "median_distance_m", "sigma_per_axis_m", "labels"),
    "kitti_ts": ("recall_1m", "recall_2m", "precision_2m", "median_distance_m", "labels"),
    "av2_static": ("recall", "precision", "duplicate_labels", "median_distance_m", "labels"),
}
"""The figures of the table that compares methods."""


def compare(data_root: Path, only: list[str] | None = None) -> str:
    """Run valuemap, its method `paper` and the peers, each in a process of its own; return a table in Markdown."""
    lines: list[str] = []
    for part, figures in TABLE.items():
        name = part.split()[0]
        if not (data_root / name).is_dir() or (only and name not in only):
            continue
        lines += [f"### {part}", "", f"| method | {' | '.join(figures)} | seconds | peak MB |"]
        lines.append(f"|---|{'---:|' * (len(figures) + 2)}")
        for method in ("valuemap", "paper", *peers.PEERS[part]):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                found, seconds, peak_mb = pool.submit(_measure, data_root / name, part, method).result()
            shown = ["-" if found[figure] is None else str(found[figure]) for figure in figures]
            lines.append(f"| {method} | {' | '.join(shown)} | {seconds:.1f} | {peak_mb} |")
            print(lines[-1], file=sys.stderr, flush=True)
        lines.append("")
    return "\n".join(lines)


def _measure(data_dir: Path, part: str, method: str) -> tuple[Figures, float, int]:
    """Return what one method finds in a data set, its seconds with reading and scoring, and its peak memory."""
    start = time.perf_counter()
    if method in ("valuemap", "paper"):
        config = MapConfig(method="robust" if method == "valuemap" else "paper")
        if part == "london_tl":
            results = london_tl.run(data_dir, config, with_range=True)
        else:
            results = RUNS[part.split()[0]](data_dir, config, as_it_is)
        found = list(results.values())[-1]
    else:
        found = peers.PEERS[part][method](data_dir, part)
    return found, time.perf_counter() - start, peak_memory_mb() or 0


def main() -> int:
    """Run the benchmarks; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_root", type=Path, metavar="DATA_ROOT")
    parser.add_argument("--only", nargs="+", choices=list(RUNS), metavar="NAME", help=f"of {', '.join(RUNS)}")
    parser.add_argument("--laws", action="store_true", help="check laws that no map may break as well; slow")
    parser.add_argument("--thinned", type=int, metavar="TIMES", help="and so often without a tenth of the detections")
    parser.add_argument("--peers", type=Path, metavar="FILE", help="compare with other methods; a table in Markdown")
    parser.add_argument("--json", type=Path, help="write all figures, settings and machine there")
    parser.add_argument("--method", default=MapConfig().method)
    parser.add_argument("--set", action="append", default=[], metavar="name=value", dest="settings")
    options = parser.parse_args()
    try:
        if options.peers is not None:
            table = compare(options.data_root, options.only)
            machine = describe_machine()["machine"]
            where = f"On {machine['cores']} cores of {machine['cpu']}."
            options.peers.write_text(f"{PEERS_HEAD.strip()}\n\n{where}\n\n{table}", encoding="utf-8")
            print(table)
            return 0
        config = MapConfig(method=options.method).with_settings(options.settings)
        results = run(options.data_root, config, options.only)
        kept = laws.run(options.data_root, config, options.only) if options.laws else {}
        thinned = run_thinned(options.data_root, config, options.only, options.thinned) if options.thinned else {}
        settings = "".join(f" --set {assignment}" for assignment in options.settings)
        times = f" --thinned {options.thinned}" if options.thinned else ""
        command = f"python benchmarks/field.py DATA_ROOT --method {options.method}{times}{settings}"
        record = {"benchmark": "field", "command": command, **describe_machine(), "settings": config.as_dict()}
        more = {name: value for name, value in (("laws", kept), ("thinned", thinned)) if value}
        keep_record(options.json, {**record, "results": results, **more})
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
