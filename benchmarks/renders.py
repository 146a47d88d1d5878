"""How many pictures of 640x480 a simulated city gives a second, from nothing to JPEG files on disk.

    python benchmarks/renders.py [--preset small] [--seed 0] [--threads 0] [--json FILE]

The figures depend on the machine, so it is written beside them. Set-up and the writing of the true boxes count.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import describe_machine, keep_record
from valuemap.dataset import write_dataset
from valuemap.simulate import PRESETS, record_city
from valuemap.simulate.render import render_images


def main() -> None:
    """Run the benchmark and print a line."""
    parser = argparse.ArgumentParser(description="how many pictures a simulated city gives a second")
    parser.add_argument("--preset", default="small")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="0: one a core")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    recording = record_city(PRESETS[options.preset], seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        dataset = Path(folder) / "dataset"
        write_dataset(recording.dataset, dataset)
        start = time.perf_counter()
        count = render_images(recording, dataset, threads=options.threads)
        seconds = time.perf_counter() - start
        size = sum(path.stat().st_size for path in dataset.rglob("*.jpg"))
        boxes = json.loads((dataset / "boxes.json").read_text(encoding="utf-8"))["annotations"]
    result: dict[str, Any] = {
        "preset": options.preset,
        "seed": options.seed,
        "threads": options.threads,
        "pictures": count,
        "size_px": [recording.config.image_width_px, recording.config.image_height_px],
        "true_boxes": sum(1 for box in boxes if not box["iscrowd"]),
        "kilobytes_a_picture": round(size / count / 1000.0, 1),
        "seconds": round(seconds, 2),
        "pictures_a_second": round(count / seconds, 1),
    }
    print(f"{count} pictures in {seconds:.1f} s: {count / seconds:.1f} a second, {len(boxes)} boxes")
    command = " ".join(["python", "benchmarks/renders.py", *sys.argv[1:]])
    keep_record(options.json, {"command": command, **describe_machine(), **result})


if __name__ == "__main__":
    main()
