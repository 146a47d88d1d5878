"""How long the whole `map` command takes, as a process: seconds, peak memory, counts and accuracy.

Each dataset is simulated once, then mapped several times; the median counts. The figures depend on the machine, so it
is written beside them. Run `python benchmarks/speed.py --json FILE` to keep them.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import valuemap
from machine import describe_machine, keep_record


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["sf", "nyc"], help="simulated datasets to map")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=5, help="runs of each; one more before them is not counted")
    parser.add_argument("--method", default="paper")
    parser.add_argument("--threads", type=int, default=0, help="0: one a core")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    command = "python benchmarks/speed.py " + " ".join(sys.argv[1:])
    record: dict[str, Any] = {"command": command.strip(), **describe_machine(), "data": "simulated", "results": []}
    with tempfile.TemporaryDirectory() as folder:
        for preset in options.presets:
            result = _measure(Path(folder), preset, options)
            record["results"].append(result)
            print(
                f"{preset:6} {options.method:7} {result['seconds_median']:7.2f} s "
                f"({min(result['seconds']):.2f} to {max(result['seconds']):.2f}) {result['peak_memory_mb']:6d} MB  "
                f"recall {result['accuracy']['recall']:.3f} precision {result['accuracy']['precision']:.3f}",
                flush=True,
            )
    keep_record(options.json, record)


def _measure(folder: Path, preset: str, options: argparse.Namespace) -> dict[str, Any]:
    dataset, result = folder / preset, folder / f"{preset}-map"
    valuemap_command = [sys.executable, "-c", "from valuemap.cli import main; main()"]
    subprocess.run(
        [*valuemap_command, "simulate", "--preset", preset, "--seed", str(options.seed), "--out", dataset],
        check=True,
        stderr=subprocess.DEVNULL,
    )
    map_command = [*valuemap_command, "map", dataset, "--out", result, "--method", options.method]
    map_command += ["--threads", str(options.threads)]
    runs = [_run(map_command) for _ in range(options.runs + 1)][1:]
    evaluation = valuemap.evaluate_map(result, dataset)
    return {
        "dataset": f"{preset}, seed {options.seed}",
        "method": options.method,
        "seconds": [round(seconds, 3) for seconds, _ in runs],
        "seconds_median": round(statistics.median(seconds for seconds, _ in runs), 3),
        "peak_memory_mb": max(memory for _, memory in runs),
        "stages": valuemap.read_map(result).run["stages"],
        "counts": valuemap.read_map(result).run["counts"],
        "accuracy": evaluation.to_json(),
    }


def _run(command: list[Any]) -> tuple[float, int]:
    """Return wall seconds and peak memory (MB) of one process."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed with status {process.returncode}")
    return seconds, usage.ru_maxrss // 1024


if __name__ == "__main__":
    main()
