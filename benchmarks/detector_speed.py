"""How many pictures per second a detector gets through, from the files on disk to boxes, and whether memory stays flat.

    python benchmarks/detector_speed.py MODEL.onnx PICTURES [--size SIZE] [--count N] [--batch N] [--json FILE]

PICTURES is a folder, for example `images` of a dataset that `valuemap simulate --images` made; its pictures are taken
again and again until there are N. Memory is that of the process after each tenth. The load says how many other
processes wanted the processor in the minute before: above 0.5 or so the speed is that of a shared machine.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from itertools import cycle, islice
from pathlib import Path
from typing import Any

from machine import describe_machine, keep_record
from valuemap.config import DetectConfig
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
    parser.add_argument("--json", type=Path, help="write the figures and the machine there")
    options = parser.parse_args()
    config = DetectConfig(size=options.size, batch=options.batch)
    try:
        results = measure(options.model, options.pictures, options.count, config)
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    print(json.dumps(results, indent=2))
    if options.json is not None:
        record = {
            "benchmark": "detector_speed",
            "data": f"{results['width']}x{results['height']} pictures from disk, {options.model.name}",
            "command": f"python benchmarks/detector_speed.py {options.model.name} PICTURES --size {options.size} "
            f"--count {options.count} --batch {options.batch}",
            **describe_machine(),
            "results": results,
        }
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


def _memory_mb() -> int:
    """Return the memory that the process has now (Linux)."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() // 2**20


if __name__ == "__main__":
    sys.exit(main())
