"""How long the label file of the Bosch Small Traffic Lights Dataset takes to load, every box checked.

    python benchmarks/bosch_labels.py train.yaml [--json FILE]

It is loaded several times; the longest time counts, too.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from machine import describe_machine, keep_record
from valuemap.detect.labels import read_labels
from valuemap.errors import ValuemapError

RUNS = 5


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, metavar="train.yaml")
    parser.add_argument("--json", type=Path, help="write the figures and the machine there")
    options = parser.parse_args()
    seconds = []
    try:
        for _ in range(RUNS):
            start = time.perf_counter()
            labels = read_labels(f"bosch:{options.file}")
            seconds.append(time.perf_counter() - start)
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    record = {
        "benchmark": "bosch_labels",
        "command": f"python benchmarks/bosch_labels.py {options.file.name}",
        **describe_machine(),
        "results": {
            "pictures": len(labels.pictures),
            "boxes": labels.boxes,
            "skipped": len(labels.skipped),
            "runs": RUNS,
            "seconds_median": round(sorted(seconds)[RUNS // 2], 2),
            "seconds_longest": round(max(seconds), 2),
        },
    }
    print(json.dumps(record, indent=2))
    keep_record(options.json, record)
    return 0


if __name__ == "__main__":
    sys.exit(main())
