"""How many pictures per second a detector gets through, from the files on disk to boxes, and whether memory stays flat.

    python benchmarks/detector_speed.py MODEL.onnx PICTURES [--size SIZE] [--count N] [--batch N] [--json FILE]
                                        [--provider cuda] [--against cpu]

PICTURES is a folder, for example `images` of a dataset that `valuemap simulate --images` made; its pictures are taken
again and again until there are N. Memory is that of the process after each tenth. The load says how many other
processes wanted the processor in the minute before: above 0.5 or so the speed is that of a shared machine.

With --against the other provider is measured too, and the boxes of both are compared, each picture once. Boxes of one
class are the same thing if they overlap by half.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any, get_args

import numpy as np

from machine import describe_machine, keep_record
from valuemap.config import DetectConfig, Provider
from valuemap.detect.boxes import Boxes, overlaps
from valuemap.detect.infer import Detector, Task
from valuemap.detect.pictures import list_pictures, read_picture
from valuemap.errors import ValuemapError


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, metavar="MODEL.onnx")
    parser.add_argument("pictures", type=Path, metavar="PICTURES")
    parser.add_argument("--size", default="model")
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--provider", default="cpu", choices=get_args(Provider))
    parser.add_argument("--against", choices=get_args(Provider), help="measure this provider too, and compare boxes")
    parser.add_argument("--json", type=Path, help="write the figures and the machine there")
    options = parser.parse_args()
    config = DetectConfig(size=options.size, batch=options.batch, provider=options.provider)
    try:
        results = measure(options.model, options.pictures, options.count, config)
        if options.against is not None:
            other = replace(config, provider=options.against)
            figures = measure(options.model, options.pictures, options.count, other)
            # Memory is that of both by then.
            results[f"with_{other.provider}"] = {
                key: figures[key] for key in ("boxes", "pictures_a_second", "cores_busy")
            }
            results[f"boxes_against_{other.provider}"] = compare(options.model, options.pictures, config, other)
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    print(json.dumps(results, indent=2))
    if options.json is not None:
        record = {
            "benchmark": "detector_speed",
            "data": f"{results['width']}x{results['height']} pictures from disk, {options.model.name}",
            "command": f"python benchmarks/detector_speed.py {options.model.name} PICTURES --size {options.size} "
            f"--count {options.count} --batch {options.batch}"
            + (f" --provider {options.provider}" if options.provider != "cpu" else "")
            + (f" --against {options.against}" if options.against is not None else ""),
            **describe_machine(),
            "results": results,
        }
        if options.provider == "cuda":
            record["machine"]["gpu"] = _gpu()
        keep_record(options.json, record)
    return 0


def measure(model: Path, pictures: Path, count: int, config: DetectConfig) -> dict[str, Any]:
    """Run `count` pictures; return speed and memory."""
    paths = list_pictures(pictures)
    detector = Detector(model, config)
    width, height = read_picture(paths[0]).stored
    list(detector.run([Task(path) for path in paths[:5]]))  # The first pictures wait for memory and caches.
    done = boxes = 0
    memory_mb: list[int] = []
    load = os.getloadavg()[0]
    start, cpu = time.perf_counter(), time.process_time()
    for group in detector.run([Task(path) for path in islice(cycle(paths), count)]):
        done += len(group)
        boxes += sum(len(outcome.boxes) for outcome in group)
        if done >= (len(memory_mb) + 1) * count / 10:
            memory_mb.append(_memory_mb())
    seconds = time.perf_counter() - start
    return {
        "width": width,
        "height": height,
        "network": list(detector.model.fit((width, height), config.size_px).canvas),
        "pictures": done,
        "boxes": boxes,
        "pictures_a_second": round(done / seconds, 1),
        "load_of_the_machine_before": round(load, 2),
        "cores_busy": round((time.process_time() - cpu) / seconds, 2),
        "memory_mb_after_each_tenth": memory_mb,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def compare(model: Path, pictures: Path, config: DetectConfig, other: DetectConfig) -> dict[str, Any]:
    """Look at every picture with both settings, and return how far the boxes are apart."""
    tasks = [Task(path) for path in list_pictures(pictures)]
    found, expected = (_boxes_of(Detector(model, each), tasks) for each in (config, other))
    same, moved_px, rescored = 0, [0.0], [0.0]
    for ours, theirs in zip(found, expected, strict=True):
        union, _ = overlaps(ours, theirs)
        union[ours.class_code[:, None] != theirs.class_code] = 0.0
        for row, column in zip(*np.nonzero(union > 0.5), strict=True):
            if union[row, column] == max(union[row].max(), union[:, column].max()):
                same += 1
                moved_px.append(np.abs(ours.edges_px[row] - theirs.edges_px[column]).max())
                rescored.append(abs(ours.score[row] - theirs.score[column]))
    return {
        "pictures": len(tasks),
        "in_both": same,
        f"{config.provider}_only": sum(map(len, found)) - same,
        f"{other.provider}_only": sum(map(len, expected)) - same,
        "largest_distance_of_edges_px": float(f"{max(moved_px):.2g}"),
        "largest_difference_of_scores": float(f"{max(rescored):.2g}"),
    }


def _boxes_of(detector: Detector, tasks: list[Task]) -> list[Boxes]:
    return [outcome.boxes for group in detector.run(tasks) for outcome in group]


def _gpu() -> str | None:
    """Return the name and driver of the GPU (NVIDIA)."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return None
    command = [program, "--query-gpu=name,driver_version", "--format=csv,noheader"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _memory_mb() -> int:
    """Return the memory that the process has now (Linux)."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() // 2**20


if __name__ == "__main__":
    sys.exit(main())
