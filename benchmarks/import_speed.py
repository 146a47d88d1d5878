"""How long an import takes, and how much memory: a COLMAP binary model of many images and COCO boxes in them.

    python benchmarks/import_speed.py [--images N] [--detections N] [--points N] [--json FILE]

Writes a model (cameras, images with observations of points, rigs and frames, as COLMAP 4 does) and a COCO file into a
temporary folder, runs `valuemap import colmap` on them as a process of its own, and reports its seconds, processor
seconds and peak memory, and how many processes wanted the processors meanwhile. The dataset that comes out is read back
and counted.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from machine import describe_machine, keep_record
from valuemap.dataset import read_dataset

_STEP_M = 2.0
_IMAGES_OF_A_PASS = 1000


def write_model(folder: Path, images: int, points: int) -> None:
    """Write a model of one camera that drives along straight roads side by side."""
    folder.mkdir()
    random = np.random.default_rng(0)
    (folder / "cameras.bin").write_bytes(
        struct.pack("<QIiQQ4d", 1, 1, 1, 1920, 1080, 1000.0, 1000.0, 960.0, 540.0)  # PINHOLE is model 1.
    )
    (folder / "rigs.bin").write_bytes(struct.pack("<QIIiI", 1, 1, 1, 0, 1))
    observed = np.zeros(points, dtype=[("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
    observed["x"], observed["y"] = random.uniform(0.0, 1080.0, (2, points))
    observed["point"] = np.arange(points)
    tail = struct.pack("<Q", points) + observed.tobytes()
    half = np.sqrt(0.5)
    with (folder / "images.bin").open("wb") as to_images, (folder / "frames.bin").open("wb") as to_frames:
        to_images.write(struct.pack("<Q", images))
        to_frames.write(struct.pack("<Q", images))
        for i in range(images):
            number, row = i % _IMAGES_OF_A_PASS, i // _IMAGES_OF_A_PASS
            # Camera axes from world axes: x stays, y is -z, z is y.
            center = (20.0 * row, _STEP_M * number, 1.5)
            pose = struct.pack("<7d", half, half, 0.0, 0.0, -center[0], center[2], -center[1])
            to_images.write(struct.pack("<I", i + 1) + pose + struct.pack("<I", 1))
            to_images.write(f"pass{row:04d}/{number:06d}.jpg".encode() + b"\0" + tail)
            to_frames.write(struct.pack("<II", i + 1, 1) + pose + struct.pack("<IiIQ", 1, 0, 1, i + 1))


def write_coco(path: Path, images: int, detections: int) -> None:
    """Write boxes with a class, a score and an id, as detectors do."""
    random = np.random.default_rng(1)
    image = np.sort(random.integers(0, images, detections))
    left, top = random.uniform(0.0, 1880.0, detections), random.uniform(0.0, 1000.0, detections)
    size, score = random.uniform(8.0, 40.0, (detections, 2)), random.uniform(0.1, 1.0, detections)
    with path.open("w", encoding="utf-8") as file:
        file.write('{"categories": [{"id": 1, "name": "light"}, {"id": 2, "name": "sign"}],\n"images": [')
        for i in range(images):
            name = f"pass{i // _IMAGES_OF_A_PASS:04d}/{i % _IMAGES_OF_A_PASS:06d}.jpg"
            file.write(f'{"," * (i > 0)}\n{{"id": {i}, "file_name": "{name}", "width": 1920, "height": 1080}}')
        file.write('],\n"annotations": [')
        for i in range(detections):
            box = f"[{left[i]:.3f}, {top[i]:.3f}, {size[i, 0]:.3f}, {size[i, 1]:.3f}]"
            file.write(
                f'{"," * (i > 0)}\n{{"id": {i}, "image_id": {image[i]}, "category_id": {1 + i % 2}, "bbox": {box}, '
                f'"area": {size[i].prod():.2f}, "iscrowd": 0, "score": {score[i]:.4f}}}'
            )
        file.write("]}\n")


def run_import(folder: Path) -> dict[str, Any]:
    """Import in a process of its own; return what it took."""
    command = [sys.executable, "-m", "valuemap.cli", "import", "colmap", str(folder / "model")]
    command += ["--detections", str(folder / "boxes.json"), "--out", str(folder / "dataset")]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    subprocess.run(command, check=True)
    seconds = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "seconds": round(seconds, 1),
        "processor_seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "peak_memory_mb": after.ru_maxrss // 1024,
        "load_average": round(os.getloadavg()[0], 1),
    }


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=100_000)
    parser.add_argument("--detections", type=int, default=1_000_000)
    parser.add_argument("--points", type=int, default=200, help="observations of points an image, which are not needed")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_model(folder / "model", options.images, options.points)
        write_coco(folder / "boxes.json", options.images, options.detections)
        sizes = {path.name: path.stat().st_size for path in (folder / "model" / "images.bin", folder / "boxes.json")}
        took = run_import(folder)
        dataset = read_dataset(folder / "dataset")
    counts = {"images": len(dataset.images), "detections": len(dataset.detections)}
    result = {**counts, "points_per_image": options.points, "bytes": sizes, **took}
    print(json.dumps(result))
    keep_record(
        options.json,
        {
            "benchmark": "import_speed",
            "command": "python benchmarks/import_speed.py",
            "data": "simulated",
            **describe_machine(),
            "results": result,
        },
    )
    return int(counts != {"images": options.images, "detections": options.detections})


if __name__ == "__main__":
    sys.exit(main())
