"""Scale: tiles of any size, runs that are killed, and changes between years; see docs/scale.md.

    python benchmarks/scale.py PART [--preset nyc] [--dataset FOLDER] [--json FILE]

Times are those of the processor (user and system, all threads): they do not depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import valuemap
from machine import describe_machine
from valuemap.arrays import Ints
from valuemap.cameras import rotation_matrices
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, rows_of, write_dataset_in_pieces
from valuemap.engine.threads import ThreadEngine
from valuemap.pipeline import Run, build_map_of_folder
from valuemap.portions import rows_on_disk
from valuemap.simulate import PRESETS, simulate, simulate_districts
from valuemap.tables.table import table_to_arrow
from valuemap.tiles.grid import Grid
from valuemap.tiles.partition import partition_dataset
from valuemap.tiles.work import open_work
from valuemap.update import compare
from valuemap.update.changes import MOVED_WITHIN_M
from valuemap.update.join import join_datasets

CELL_SIZES = (200.0, 500.0, 2000.0, 1e6)
CHANGED = 20
MOVED = 10
MOVED_BY_M = 3.0
SEEDS_CHOSEN_ON = 5
"""What tells changes was chosen on the seeds below this one: those from it on are measured."""
KILLS = 10
UPDATED_SHARE = 0.05
RUNS, RUNS_OF_TILES = 5, 2
"""So often updates and maps of all data, and maps in one piece and in tiles, are timed."""
POSES_AS_THEY_ARE = "correct_poses=0"
"""Poses of whole drives are looked at in all data, whatever is added: tiles and changes have no part in that."""
SET = (f"--set={POSES_AS_THEY_ARE}",)


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=sorted(PARTS))
    parser.add_argument("--preset", default="small", help="a preset of valuemap simulate, or block for a part of nyc")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--dataset", type=Path, help="a dataset of the preset that is there already")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = {
        "command": " ".join(["python", *sys.argv]),
        **describe_machine(),
        "load_average": os.getloadavg(),
        "valuemap": valuemap.__version__,
        **PARTS[arguments.what](arguments),
    }
    print(json.dumps(result, indent=2))
    if arguments.json:
        known = json.loads(arguments.json.read_text()) if arguments.json.is_file() else {}
        known[f"{arguments.what} {arguments.preset}"] = result
        arguments.json.write_text(json.dumps(known, indent=2) + "\n")


def city(preset: str, seed: int = 0) -> Dataset:
    """Return a simulated city."""
    if preset == "block":
        nyc = PRESETS["nyc"]
        small = {"streets_north_south": 8, "streets_east_west": 7, "lights": 40, "images": 4_000, "detections": 0}
        return simulate(dataclasses.replace(nyc, **small), seed=seed, name="block")
    return simulate(PRESETS[preset], seed=seed, name=preset)


def measured(folder: Path, out: Path, *options: str) -> dict[str, Any]:
    """Map a dataset in a process of its own, and return what it took."""
    took, run = timed("map", str(folder), "--out", str(out), *options)
    return {
        "options": options,
        **took,
        "stages": run["stages"],
        "counts": {name: value for name, value in run["counts"].items() if name != "noise"},
        "map": digest(out),
    }


def timed(*command: str, program_of: tuple[str, ...] | None = None) -> tuple[dict[str, float], dict[str, Any]]:
    """Run a command of valuemap, or of another program, and return what it took, and what it says."""
    took, told = taken(*(program_of or COMMAND), *command, "--json")
    return took, json.loads(told)


def taken(*command: str) -> tuple[dict[str, float], str]:
    """Run Python with some arguments, and return what it took, and what it says."""
    start = time.perf_counter()
    with tempfile.TemporaryFile() as told, tempfile.TemporaryFile() as used:
        done = subprocess.run(
            [sys.executable, "-S", "-c", _MEASURE, sys.executable, *command],
            stdout=told,
            stderr=used,
            env=as_installed(),
            check=False,
        )
        seconds = time.perf_counter() - start
        told.seek(0)
        used.seek(0)
        if done.returncode not in (0, FOUND_WRONG):
            raise SystemExit(f"{' '.join(command)}: ended with {done.returncode}")
        return {"seconds": round(seconds, 2), **json.load(used)}, told.read().decode()


COMMAND = ("-m", "valuemap.cli")
FOUND_WRONG = 3
"""How `check` ends where something is wrong with a dataset."""
_ONE_CELL = (
    "-c",
    "from dataclasses import replace; from valuemap.tiles.grid import Grid; of = Grid.of; "
    "Grid.of = lambda *data: replace(of(*data), side_m=1e7, most_detections=10**9); "
    "from valuemap.cli import main; main()",
)
"""The command, where all data is one cell, however wide it is: as there was before there were cells."""
_MEASURE = """
import json, resource, subprocess, sys
status = subprocess.run(sys.argv[1:], stderr=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
took = {"cpu_seconds": round(used.ru_utime + used.ru_stime, 2), "peak_memory_mb": used.ru_maxrss >> 10}
print(json.dumps(took), file=sys.stderr)
sys.exit(status)
"""
"""Runs a command, and prints what it took. A process that is started counts the peak memory of who started it as its
own, so one that has little starts it."""


def as_installed() -> dict[str, str]:
    """Return the environment of a command: what Python compiles is kept, as a package that is installed has it."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def least(runs: list[dict[str, float]]) -> dict[str, Any]:
    """Return the least that runs of one command took: what else the machine does makes each take longer."""
    return {name: min(run[name] for run in runs) for name in runs[0]} | {
        "all_cpu_seconds": [run["cpu_seconds"] for run in runs]
    }


def program(*command: str) -> list[str]:
    """Return a command of valuemap."""
    return [sys.executable, *COMMAND, *command]


def digest(folder: Path) -> str:
    """Return a hash of what a map says."""
    names = ("labels.parquet", "votes.parquet", "calibration.json")
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).hexdigest()[:16]


@contextmanager
def dataset_of(arguments: argparse.Namespace) -> Iterator[Path]:
    """Yield the folder of the preset's dataset, simulated if it is not there."""
    if arguments.dataset is not None:
        yield arguments.dataset
        return
    with tempfile.TemporaryDirectory() as name:
        if arguments.preset == "block":
            valuemap.write_dataset(city("block"), Path(name) / "city")
        else:
            write_dataset_in_pieces(simulate_districts(PRESETS[arguments.preset], seed=0), Path(name) / "city")
        yield Path(name) / "city"


def peak_mb() -> int:
    """Return the peak memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def cpu_s() -> float:
    """Return the processor seconds of this process so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def simulate_only(arguments: argparse.Namespace) -> dict[str, Any]:
    """Simulate a city district by district; it stays where --dataset says."""
    if arguments.dataset is not None:
        write_dataset_in_pieces(simulate_districts(PRESETS[arguments.preset], seed=0), arguments.dataset)
    with dataset_of(arguments) as folder:
        size = rows_on_disk(folder)
    return {"images_and_detections": size, "cpu_seconds": round(cpu_s(), 1), "peak_memory_mb": peak_mb()}


def partition(arguments: argparse.Namespace) -> dict[str, Any]:
    """Cut a dataset into tiles on disk; give the dataset, or simulating it counts as well."""
    with dataset_of(arguments) as folder, tempfile.TemporaryDirectory() as name:
        before, start = cpu_s(), time.perf_counter()
        with open_work(Path(name) / "work", resume=False) as work:
            found = partition_dataset(folder, work, MapConfig())
            seconds = time.perf_counter() - start
            files = [path for path in work.glob("partition-*/**/*") if path.is_file()]
            disk = sum(path.stat().st_size for path in files)
        return {
            "counts": found.counts,
            "cells": len(found.cells),
            "files": len(files),
            "disk_mb": disk >> 20,
            "seconds": round(seconds, 1),
            "cpu_seconds": round(cpu_s() - before, 1),
            "peak_memory_mb": peak_mb(),
        }


def whole(arguments: argparse.Namespace) -> dict[str, Any]:
    """Map a dataset as `valuemap map` does by itself, in memory or in tiles on disk; check it and report on the map."""
    with dataset_of(arguments) as folder, tempfile.TemporaryDirectory() as name:
        out = Path(name) / "map"
        result = measured(folder, out)
        checked, told = timed("check", str(folder))
        reported, _ = taken(*COMMAND, "report", str(out), "--out", str(Path(name) / "report.html"))
        looked_at = {"looked_at": told["looked_at"]} if "looked_at" in told else {}
        found = [finding["fault"] for finding in told["findings"]]
        return {**result, "check": {**checked, **looked_at, "found": found}, "report": reported}


def tiles(arguments: argparse.Namespace) -> dict[str, Any]:
    """Map a dataset in one piece, in cells in memory, and in tiles on disk, in turn: what cells and tiles cost.

    Noise is that of one map, as one piece would estimate it from all the data.
    """
    ways = {
        "one cell": (_ONE_CELL, ()),
        "cells in memory": (COMMAND, ()),
        "tiles on disk": (COMMAND, ("--tile-size", "1000")),
    }
    took: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    found: dict[str, Any] = {}
    with dataset_of(arguments) as folder, tempfile.TemporaryDirectory() as name:
        known = Path(name) / "known"
        of_known, _ = timed("map", str(folder), "--out", str(known), *SET)
        given = ("--calibration", str(known), *SET)
        for _ in range(RUNS_OF_TILES):
            for way, (program_of_way, options) in ways.items():
                out = Path(name) / way
                shutil.rmtree(out, ignore_errors=True)
                command = ("map", str(folder), "--out", str(out), *options, *given)
                seconds, run = timed(*command, program_of=program_of_way)
                took[way].append(seconds)
                found[way] = {"map": digest(out), "labels": run["counts"]["labels"]}
    runs = {way: {**least(took[way]), **found[way]} for way in ways}
    cpu = {way: run["cpu_seconds"] for way, run in runs.items()}
    return {
        "estimating_noise_too": of_known,
        "runs": runs,
        "cells_in_memory_to_one_cell": round(cpu["cells in memory"] / cpu["one cell"], 3),
        "tiles_on_disk_to_one_cell": round(cpu["tiles on disk"] / cpu["one cell"], 3),
        "tiles_on_disk_to_cells_in_memory": round(cpu["tiles on disk"] / cpu["cells in memory"], 3),
        "identical": runs["tiles on disk"]["map"] == runs["cells in memory"]["map"],
    }


def cells(arguments: argparse.Namespace) -> dict[str, Any]:
    """Map by tiles of all sizes, and in memory."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        valuemap.write_dataset(city(arguments.preset), folder / "city")
        runs = [measured(folder / "city", folder / "memory")]
        runs += [measured(folder / "city", folder / f"{m:.0f}", "--tile-size", str(m)) for m in CELL_SIZES]
    return {"identical": len({run["map"] for run in runs}) == 1, "runs": runs}


def kills(arguments: argparse.Namespace) -> dict[str, Any]:
    """Kill maps and updates with SIGKILL at random moments, and let them go on."""
    with dataset_of(arguments) as dataset, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole, added, _ = split(dataset, folder)
        mapping = ("map", str(whole), "--tile-size", "1000", *SET)
        of_map = killed(mapping, folder / "map")
        update = ("update", str(folder / "map"), "--add", str(added), "--tile-size", "1000")
        return {"map": of_map, "update": killed(update, folder / "updated")}


def killed(command: tuple[str, ...], out: Path) -> dict[str, Any]:
    """Kill a command at random moments, and count how often it comes to the same when it goes on."""
    chosen = random.Random(0)
    took, _ = timed(*command, "--out", str(out))
    expected = contents(out)
    killed_at: list[list[float]] = []
    identical, number = 0, 0
    while len(killed_at) < KILLS:
        again = out.with_name(f"{out.name}-{number}")
        number += 1
        options = (*command, "--out", str(again), "--resume")
        # By what it has used: what else the machine does makes it slower, not what it is at then another.
        share = chosen.uniform(0.05, 0.95)
        process = subprocess.Popen(
            program(*options), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=as_installed()
        )
        while process.poll() is None and processor_s(process.pid) < share * took["cpu_seconds"]:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        if process.wait() == 0:  # It was done before.
            shutil.rmtree(again)
            continue
        work = again.with_name(f"{again.name}.work")
        killed_at.append([round(share, 2), len(list(work.glob("cells/*.arrow")))])
        subprocess.run(program(*options), check=True, capture_output=True)
        identical += contents(again) == expected
        assert not work.exists()
        shutil.rmtree(again)
    return {"kills": KILLS, "identical": identical, "share_and_cells_when_killed": killed_at, **took}


def processor_s(pid: int) -> float:
    """Return the processor seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def contents(folder: Path) -> dict[str, str]:
    """Return the hashes of all files of a map, but for its record, which says how long things took."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in ("run.json", ".valuemap-files"))
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def update(arguments: argparse.Namespace) -> dict[str, Any]:
    """Update a map with new passes through a part of the cells, and compare with a map of all the data."""
    with dataset_of(arguments) as dataset, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        before, added, size = split(dataset, folder)
        of_map, _ = timed("map", str(before), "--out", str(folder / "map"), *SET)
        both = str(folder / "updated" / "dataset")
        calibration = ("--calibration", str(folder / "map"))
        updates, fulls = [], []
        for _ in range(RUNS):  # In turn, so that what else the machine does is the same for both.
            for out in ("updated", "full"):  # Files that are replaced are looked at first.
                shutil.rmtree(folder / out, ignore_errors=True)
            took, run = timed("update", str(folder / "map"), "--add", str(added), "--out", str(folder / "updated"))
            updates.append(took)
            fulls.append(timed("map", both, "--out", str(folder / "full"), *SET)[0])
        of_update, full = least(updates), least(fulls)
        again, _ = timed("map", both, "--out", str(folder / "rebuilt"), *SET, *calibration)
        known, cells = (
            {path.name for path in (folder / each / "cells").glob("*.arrow")} for each in ("map", "updated")
        )
        updated, rebuilt = (labels_of(folder / each) for each in ("updated", "rebuilt"))
    return {
        **size,
        "cells_solved": len(cells - known),
        "cells_of_map": len(cells),
        "map_before": of_map,
        "update": {**of_update, "stages": run["stages"]},
        "map_of_all": full,
        "map_of_all_with_its_calibration": again,
        "share_of_cpu_seconds": round(of_update["cpu_seconds"] / full["cpu_seconds"], 3),
        "share_of_seconds": round(of_update["seconds"] / full["seconds"], 3),
        "labels": len(updated),
        "labels_not_in_the_rebuilt_map": len(updated - rebuilt),
        "labels_only_in_the_rebuilt_map": len(rebuilt - updated),
        "states": run["update"],
    }


def labels_of(folder: Path) -> set[tuple[Any, ...]]:
    """Return all that a map says of its labels, with their votes, but for their ids and states."""
    found = valuemap.read_map(folder)
    first, end = (np.searchsorted(found.votes.label_id, found.labels.label_id, side=side) for side in ("left", "right"))
    rows = table_to_arrow(found.labels).drop_columns(["label_id"]).to_pylist()
    votes = [tuple(found.votes.detection_id[a:b].tolist()) for a, b in zip(first, end, strict=True)]
    told = [tuple(repr(value) for name, value in row.items() if name != "state") for row in rows]
    return set(zip(told, votes, strict=True))


def split(dataset: Path, folder: Path) -> tuple[Path, Path, dict[str, Any]]:
    """Write a dataset as what was there before, and passes through a part of the tiles that are added.

    These passes follow each other: each is that which begins nearest to where the last one ended, of those that go
    through a new tile and not through too many.
    """
    whole = valuemap.read_dataset(dataset)
    images, grid = whole.images, Grid.of(whole.frame, MapConfig().vote.farthest_m)
    place_m = grid.images_on_ground(images)
    tile = np.floor((place_m + 0.5 * grid.side_m) / grid.side_m).astype(np.int64)
    code, time_s = images.pass_id.codes, images.timestamp_s
    assert time_s is not None
    rows = [np.flatnonzero(code == number) for number in range(len(images.pass_id.names))]
    rows = [of[np.argsort(time_s[of], kind="stable")] for of in rows]
    tiles = [{(x, y) for x, y in tile[of].tolist()} for of in rows]
    most = max(1, round(UPDATED_SHARE * len(set().union(*tiles))))
    begins = np.array([place_m[of[0]] for of in rows])
    chosen = [max((number for number in range(len(rows)) if len(tiles[number]) <= most), key=lambda n: len(tiles[n]))]
    taken = set(tiles[chosen[0]])
    while len(taken) < most:
        away_m = np.linalg.norm(begins - place_m[rows[chosen[-1]][-1]], axis=1)
        nearest = (
            n for n in np.argsort(away_m, kind="stable").tolist() if 0 < len(tiles[n] - taken) <= most - len(taken)
        )
        following = next(nearest, None)
        if following is None:
            break
        chosen.append(following)
        taken |= tiles[following]
    is_added = np.isin(code, chosen)
    of_added = is_added[rows_of(whole.detections.image_id, images.image_id)]
    for name, is_part, of_part in (("before", ~is_added, ~of_added), ("added", is_added, of_added)):
        part = dataclasses.replace(
            whole,
            images=images.take(is_part),
            detections=whole.detections.take(of_part),
            truth=None,
            truth_detections=None,
        )
        valuemap.write_dataset(part, folder / name)
    size = {
        "images": len(images),
        "images_added": int(is_added.sum()),
        "passes_added": len(chosen),
        "tiles": len(set().union(*tiles)),
        "tiles_driven": len(taken),
    }
    return folder / "before", folder / "added", size


def change(arguments: argparse.Namespace) -> dict[str, Any]:
    """Two years of one city: lights removed, added and moved between them; on seeds that nothing was chosen on."""
    runs = []
    for seed in range(SEEDS_CHOSEN_ON, SEEDS_CHOSEN_ON + arguments.seeds):
        runs.append(change_of(arguments.preset, seed))
        print(json.dumps(runs[-1]), flush=True)
    return {
        "moved_by_m": MOVED_BY_M,
        **summed(runs),
        "runs": runs,
    }


def summed(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what the runs say together."""
    right, changed, had = (
        sum(sum(run[name].values()) for run in runs) for name in ("right", "changed", "in_map_before")
    )
    added = sum(run["changed"]["added"] for run in runs)
    counts = (
        *("others_in_map_before", "others_that_change", "false_labels_before", "false_labels_that_change"),
        *("standing_objects_new_to_the_map", "false_labels_new_to_the_map"),
    )
    return {
        "right_share": round(right / max(changed, 1), 4),
        "right_share_of_what_the_map_had_and_of_added": round(right / max(had + added, 1), 4),
        **{name: sum(run[name] for run in runs) for name in counts},
    }


def change_of(preset: str, seed: int) -> dict[str, Any]:
    """Change one city, and count which states are right."""
    config = dataclasses.replace(
        PRESETS["small"], streets_north_south=6, streets_east_west=6, lights=110, passes_per_street=6
    )
    config = config if preset == "small" else PRESETS[preset]
    dataset = simulate(config, seed=seed, name="years")
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    seen = np.bincount(dataset.truth_detections.object_id, minlength=len(dataset.truth))
    place = dataset.truth.position_in_world_m
    removed, added, moved = choose_changed(place, np.random.default_rng(seed).permutation(np.flatnonzero(seen >= 40)))
    first, second = years(dataset, removed, added, moved)
    with tempfile.TemporaryDirectory() as name:
        folder, progress = Path(name), lambda *_: None
        valuemap.write_dataset(first, folder / "first")
        settings = MapConfig().with_settings([POSES_AS_THEY_ARE])
        before = valuemap.build_map(first, settings)
        both = join_datasets(first, second)
        valuemap.write_dataset(both, folder / "both")
        with open_work(folder / "work", resume=False) as work:
            from valuemap.robust import calibration_from_json

            known = calibration_from_json(before.run["calibration"], source="before")
            rebuilt, _ = build_map_of_folder(
                folder / "both", settings, Run(work, ThreadEngine(0), calibration=known), progress=progress
            )
            valuemap.write_dataset(second, folder / "second")
            run = Run(work, ThreadEngine(0), calibration=known)
            alone, _ = build_map_of_folder(folder / "second", settings, run, progress=progress)
        result, changes, _ = compare(before, rebuilt, alone, both, first.images.image_id)
    states = result.labels.state.texts() if result.labels.state is not None else []
    labels = result.labels.position_in_world_m
    kinds, where, was = changes.change.texts(), changes.position_in_world_m, changes.from_m

    def near(points: np.ndarray[Any, Any], target: np.ndarray[Any, Any]) -> list[int]:
        return np.flatnonzero(np.linalg.norm(points - target, axis=1) < 1.0).tolist() if len(points) else []

    right = {
        "removed": sum(any(kinds[i] == "removed" for i in near(where, place[o])) for o in removed),
        "added": sum(any(states[i] == "new" for i in near(labels, place[o])) for o in added),
        "moved": sum(any(states[i] == "moved" for i in near(labels, place[o] + [MOVED_BY_M, 0.0, 0.0])) for o in moved),
    }
    others = np.setdiff1d(np.arange(len(place)), [*removed, *added, *moved])
    touched = {i for o in [*removed, *added, *moved] for i in near(where, place[o])}
    touched |= {i for o in moved for i in near(where, place[o] + [MOVED_BY_M, 0.0, 0.0])}
    # What else the maps say: of objects that stand, and of what is none (temporary things and lookalikes are seen too).
    had = before.labels.position_in_world_m
    is_other = np.array([i not in touched for i in range(len(kinds))])
    is_true = np.array([bool(near(place[others], at)) for at in where])
    is_told = np.array([kind in ("removed", "moved") for kind in kinds])
    is_fresh = np.array([kind == "added" and not near(had, at) for kind, at in zip(kinds, where, strict=True)])
    is_known = is_other & (~np.isnan(was[:, 0]))
    told = [changes.state.texts()[i] for o in [*removed, *added, *moved] for i in near(where, place[o])]
    return {
        "seed": seed,
        "changed": {"removed": len(removed), "added": len(added), "moved": len(moved)},
        "right": right,
        "others_in_map_before": int((is_known & is_true).sum()),
        "others_that_change": int((is_known & is_true & is_told).sum()),
        "false_labels_before": int((is_known & ~is_true).sum()),
        "false_labels_that_change": int((is_known & ~is_true & is_told).sum()),
        "standing_objects_new_to_the_map": int((is_other & is_true & is_fresh).sum()),
        "false_labels_new_to_the_map": int((is_other & ~is_true & is_fresh).sum()),
        "hidden_share": result.run["update"]["hidden_share"],
        "labels_before": len(before.labels),
        "in_map_before": {
            "removed": sum(bool(near(before.labels.position_in_world_m, place[o])) for o in removed),
            "moved": sum(bool(near(before.labels.position_in_world_m, place[o])) for o in moved),
        },
        "states_of_changed": {state: told.count(state) for state in sorted(set(told))},
        "moved_from_right": sum(bool(near(was[[k == "moved" for k in kinds]], place[o])) for o in moved),
    }


def choose_changed(place_m: np.ndarray[Any, Any], objects: Ints) -> tuple[Ints, Ints, Ints]:
    """Return which objects are removed, added and moved, in this order of preference.

    One removed and one added side by side are one moved, for all that anybody can see. So objects that change in
    different ways are farther apart than what is told as moved, and none is moved to where another one is.
    """
    chosen: tuple[list[int], list[int], list[int]] = ([], [], [])
    places = [np.empty((0, 3))] * 3
    for item in objects.tolist():
        now = place_m[item] + [MOVED_BY_M, 0.0, 0.0]
        for kind, most in enumerate((CHANGED, CHANGED, MOVED)):
            own = place_m[item][None] if kind < 2 else np.stack([place_m[item], now])
            others = np.concatenate([places[other] for other in range(3) if other != kind or kind == 2])
            apart = np.linalg.norm(own[:, None] - others, axis=2).min(initial=np.inf)
            in_place = kind == 2 and np.linalg.norm(place_m - now, axis=1).min() < 1.0
            if len(chosen[kind]) < most and apart > MOVED_WITHIN_M and not in_place:
                chosen[kind].append(item)
                places[kind] = np.concatenate([places[kind], own])
                break
    removed, added, moved = (np.array(sorted(items), np.int64) for items in chosen)
    return removed, added, moved


def years(dataset: Dataset, removed: Ints, added: Ints, moved: Ints) -> tuple[Dataset, Dataset]:
    """Return the first half of all passes as the first year and the others as the second, with what each shows.

    Passes are rounds through every street, one after the other: in each year all streets are driven as often.
    """
    images, detections = dataset.images, dataset.detections
    assert dataset.truth_detections is not None
    assert dataset.truth is not None
    object_of = np.full(len(detections), -1)
    object_of[rows_of(dataset.truth_detections.detection_id, detections.detection_id)] = (
        dataset.truth_detections.object_id
    )
    late = images.pass_id.codes >= len(images.pass_id.names) // 2
    image_row = rows_of(detections.image_id, images.image_id)
    is_late = late[image_row]
    is_seen = np.where(is_late, ~np.isin(object_of, removed), ~np.isin(object_of, added))
    center = detections.center_px.copy()
    shifted = np.flatnonzero(is_late & np.isin(object_of, moved))
    rotation = rotation_matrices(images)[image_row[shifted]]
    place = dataset.truth.position_in_world_m[object_of[shifted]]
    pixel = []
    for target in (place, place + [MOVED_BY_M, 0.0, 0.0]):
        x, y, z = (np.einsum("nij,nj->ni", rotation, target) + images.cam_from_world_m[image_row[shifted]]).T
        focal = dataset.cameras.params[0]
        pixel.append(np.stack([focal[0] * x / z, focal[1] * y / z], axis=1))
        is_seen[shifted[z < 4.0]] = False
    center[shifted] += pixel[1] - pixel[0]
    size = np.array([dataset.cameras.width_px[0], dataset.cameras.height_px[0]])
    is_seen &= np.all((center >= 0.0) & (center <= size), axis=1)
    detections = detections.replace(center_px=center)

    def year(of: bool) -> Dataset:
        return dataclasses.replace(
            dataset,
            images=images.take(np.flatnonzero(late == of)),
            detections=detections.take(np.flatnonzero(is_seen & (is_late == of))),
            truth=None,
            truth_detections=None,
        )

    return year(False), year(True)


PARTS = {
    "simulate": simulate_only,
    "partition": partition,
    "map": whole,
    "tiles": tiles,
    "cells": cells,
    "kills": kills,
    "update": update,
    "change": change,
}

if __name__ == "__main__":
    main()
