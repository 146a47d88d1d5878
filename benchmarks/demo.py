"""What `valuemap demo` does, city by city: how good maps from rendered pictures and the bundled model are.

    python benchmarks/demo.py --work DIR [--seeds 0 2 3] [--json FILE]

The training saw no picture of the seeds 2 and 3, and the least score of the boxes was chosen on 0 and 1. The load says
how many other processes wanted the processor in the minute before: above 0.5 or so the seconds are those of a shared
machine.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from machine import describe_machine, keep_record
from valuemap.demo import DETECTION, run_demo
from valuemap.errors import ValuemapError


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for the cities")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 2, 3])
    parser.add_argument("--json", type=Path, help="write the figures and the machine there")
    options = parser.parse_args()
    try:
        results = {str(seed): run_city(options.work / str(seed), seed) for seed in options.seeds}
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    record = {
        "benchmark": "demo",
        "command": f"python benchmarks/demo.py --work DIR --seeds {' '.join(map(str, options.seeds))}",
        **describe_machine(),
        "min_score": DETECTION.min_score,
        "results_of_seed": results,
    }
    print(json.dumps(record, indent=2))
    keep_record(options.json, record)
    return 0


def run_city(folder: Path, seed: int) -> dict[str, Any]:
    """Return the figures of one city."""
    load, start = os.getloadavg()[0], time.perf_counter()
    demo = run_demo(folder, seed=seed)
    seconds = time.perf_counter() - start
    boxes, lights = demo.detection.overall[0.3], demo.evaluation
    return {
        "seconds": round(seconds, 1),
        "load_of_the_machine_before": round(load, 2),
        "pictures": demo.detection.pictures,
        "boxes": {
            "labels": boxes.labels,
            "recall": round(boxes.recall, 3),
            "precision": round(boxes.precision, 3),
            "mean_iou": round(boxes.mean_iou, 3),
        },
        "lights": {
            "recoverable": lights.recoverable_objects,
            "true_positives": lights.true_positives,
            "duplicates": lights.duplicates,
            "false_positives": lights.false_positives,
            "recall": round(lights.recall, 3),
            "precision": round(lights.precision, 3),
            "position_rmse_m": round(lights.position_rmse_m, 3),
        },
    }


if __name__ == "__main__":
    sys.exit(main())
