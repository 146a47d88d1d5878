"""What a Ray cluster costs beside threads, for a map and for detections; and whether both come to the same bytes.

    python benchmarks/on_ray.py [--preset nyc] [--dataset FOLDER] [--pictures N] [--json FILE]

The cluster is two nodes of one core each on this machine, on its loopback, with token authentication. The map is that
of a simulated city, in tiles; the pictures are those of the preset `small`, N of them, looked at by the bundled model.
Processor seconds are those of the command, and of all processes of the cluster while it runs; seconds depend on what
else the machine does.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any

from machine import describe_machine, keep_record
from scale import SET, dataset_of, digest, timed
from valuemap.engine.ray import import_ray

TILE_M = "1000"
CORES = 2


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="nyc", help="a preset of valuemap simulate, or block for a part of nyc")
    parser.add_argument("--dataset", type=Path, help="a dataset of the preset that is there already")
    parser.add_argument("--pictures", type=int, default=500)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    # Nodes of a busy machine take longer to begin than Ray waits.
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "b" * 64, "RAY_raylet_start_wait_time_s": "300"}
    import_ray()
    from ray.cluster_utils import Cluster

    load = os.getloadavg()
    with tempfile.TemporaryDirectory() as name, dataset_of(options) as city:
        folder = Path(name)
        head = {"num_cpus": 1, "node_ip_address": "127.0.0.2", "include_dashboard": False}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        cluster.add_node(num_cpus=1, node_ip_address="127.0.0.3")
        try:
            on_ray = ("--engine", "ray", "--ray-address", cluster.address)
            results = {"map": compare_maps(city, folder, on_ray)}
            results["detect"] = compare_detections(folder, options.pictures, on_ray)
        finally:
            cluster.shutdown()
    print(json.dumps(results, indent=2))
    keep_record(
        options.json,
        {
            "benchmark": "on_ray",
            "command": f"python benchmarks/on_ray.py --preset {options.preset} --pictures {options.pictures}",
            "data": "simulated",
            **describe_machine(),
            "load_average_before": load,
            "results": results,
        },
    )
    return int(not all(result["identical"] for result in results.values()))


def compare_maps(city: Path, folder: Path, on_ray: tuple[str, ...]) -> dict[str, Any]:
    """Map a city with threads and on the cluster."""
    outs = [folder / name for name in ("threads", "ray")]
    took = [
        measured("map", str(city), "--out", str(out), "--tile-size", TILE_M, *SET, *options)
        for out, options in zip(outs, ((f"--threads={CORES}",), on_ray), strict=True)
    ]
    counts = json.loads((outs[1] / "run.json").read_text(encoding="utf-8"))["counts"]
    size = {name: counts[name] for name in ("images", "detections", "labels")}
    cells = len(list((outs[1] / "cells").glob("*.arrow")))
    return {**size, "cells": cells, "identical": digest(outs[0]) == digest(outs[1]), **beside(took)}


def compare_detections(folder: Path, count: int, on_ray: tuple[str, ...]) -> dict[str, Any]:
    """Look at simulated pictures with threads and on the cluster."""
    place = folder / "pictures"
    timed("simulate", "--out", str(place), "--images", f"--set=images={count}")
    took, contents = [], []
    for options in ((), on_ray):
        took.append(measured("detect", str(place), "--model=bundled", *options))
        contents.append((place / "detections.parquet").read_bytes())
    record = json.loads((place / "detect.json").read_text(encoding="utf-8"))
    return {**record["counts"], "identical": contents[0] == contents[1], **beside(took)}


def beside(took: list[dict[str, float]]) -> dict[str, Any]:
    """Return what threads and the cluster took, and how much more processor time the cluster."""
    threads, ray = (each["cpu_seconds"] + each["cluster_cpu_seconds"] for each in took)
    return {"threads": took[0], "ray": took[1], "cpu_of_ray_to_threads": round(ray / threads, 2)}


def measured(*command: str) -> dict[str, float]:
    """Run a command of valuemap; return seconds, and processor seconds of it and of the cluster."""
    nodes = _children(_processes(), {os.getpid()})
    used: dict[int, float] = {}
    is_over = Event()

    def watch() -> None:
        """Look again and again: workers end with the command, and nobody is told what they used."""
        while True:
            used.update(_used_below(nodes))
            if is_over.wait(_WATCHED_S):
                return

    before = _used_below(nodes)
    with ThreadPoolExecutor(1) as pool:
        watching = pool.submit(watch)
        took, _ = timed(*command)
        is_over.set()
        watching.result()
    of_cluster = sum(seconds - before.get(pid, 0.0) for pid, seconds in used.items())
    return {**took, "cluster_cpu_seconds": round(of_cluster, 2)}


_WATCHED_S = 0.2


def _processes() -> dict[int, tuple[int, float]]:
    """Return the parent of each process, and its processor seconds."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
            found[int(path.parent.name)] = int(fields[1]), sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")
    return found


def _children(processes: dict[int, tuple[int, float]], of: set[int]) -> set[int]:
    return {pid for pid, (parent, _) in processes.items() if parent in of}


def _used_below(nodes: set[int]) -> dict[int, float]:
    """Return the processor seconds of processes and of all below them."""
    processes = _processes()
    found: dict[int, float] = {}
    below = nodes & processes.keys()
    while below:
        found |= {pid: processes[pid][1] for pid in below}
        below = _children(processes, below)
    return found


if __name__ == "__main__":
    sys.exit(main())
