"""How long an import takes, and how much memory: COLMAP's model with COCO boxes, and tables of images and boxes.

    python benchmarks/import_speed.py [--images N] [--detections N ...] [--points N] [--json FILE]

Writes a model (cameras, images with observations of points, rigs and frames, as COLMAP 4 does) and COCO files of
several sizes into a temporary folder, and runs `valuemap import colmap` on them as processes of their own; then
`valuemap import csv` with a table of the images, and tables of boxes in any order. All have the same images, so that
what a box takes is told apart from the rest; the fewest boxes are imported with three times the images, too, which says
what an image takes. It reports seconds, processor seconds and peak memory, and how many processes wanted the processors
meanwhile. The dataset that comes out is read back and counted.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from machine import describe_machine, keep_record
from valuemap.portions import DatasetReader

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


def write_tables(folder: Path, images: int, detections: int) -> None:
    """Write a table of images along straight roads, and one of boxes in any order."""
    folder.mkdir()
    random = np.random.default_rng(2)
    with (folder / "images.csv").open("w", encoding="utf-8") as file:
        file.write("image,x,y,z,heading_deg,pass,timestamp,width_px,height_px,fx,cx,cy\n")
        for i in range(images):
            row, number = divmod(i, _IMAGES_OF_A_PASS)
            place = f"{20.0 * row},{_STEP_M * number},1.5,0,pass{row:04d},{0.2 * i:.1f}"
            file.write(f"pass{row:04d}/{number:06d}.jpg,{place},1920,1080,1000,960,540\n")
    image = random.integers(0, images, detections).tolist()
    box = random.uniform([0.0, 0.0, 8.0, 8.0, 0.1], [1880.0, 1000.0, 40.0, 40.0, 1.0], (detections, 5)).tolist()
    with (folder / "boxes.csv").open("w", encoding="utf-8") as file:
        file.write("image,class,left,top,width,height,score\n")
        for i, (left, top, width, height, score) in zip(image, box, strict=True):
            row, number = divmod(i, _IMAGES_OF_A_PASS)
            kind = "light" if left > top else "sign"
            numbers = f"{left:.3f},{top:.3f},{width:.3f},{height:.3f},{score:.4f}"
            file.write(f"pass{row:04d}/{number:06d}.jpg,{kind},{numbers}\n")


def run_import(folder: Path, *what: str) -> dict[str, Any]:
    """Import in a process of its own; return what it took, and what came out."""
    command = [sys.executable, "-c", _RUN, "import", *what, "--out", str(folder / "dataset")]
    start = time.perf_counter()
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    processor_s, peak_mb = json.loads(done.stderr.splitlines()[-1])
    dataset = DatasetReader(folder / "dataset")
    return {
        "images": sum(map(len, dataset.images())),
        "detections": sum(map(len, dataset.detections())),
        "seconds": round(seconds, 1),
        "processor_seconds": processor_s,
        "peak_memory_mb": peak_mb,
        "load_average": round(os.getloadavg()[0], 1),
    }


_RUN = """
import atexit, json, re, resource, sys
from pathlib import Path
from valuemap.cli import main
def told():
    used = resource.getrusage(resource.RUSAGE_SELF)
    # Not ru_maxrss, which begins with what the process that started this one has.
    peak_kb = re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]
    print(json.dumps([round(used.ru_utime + used.ru_stime, 1), int(peak_kb) >> 10]), file=sys.stderr)
atexit.register(told)
main()
"""


def import_colmap(images: int, detections: int, points: int) -> dict[str, Any]:
    """Import a model and a COCO file that are written for it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_model(folder / "model", images, points)
        write_coco(folder / "boxes.json", images, detections)
        sizes = {path.name: path.stat().st_size for path in (folder / "model" / "images.bin", folder / "boxes.json")}
        took = run_import(folder, "colmap", str(folder / "model"), "--detections", str(folder / "boxes.json"))
    return {"points_per_image": points, "bytes": sizes, **took}


def import_csv(images: int, detections: int, _points: int) -> dict[str, Any]:
    """Import tables that are written for it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_tables(folder / "tables", images, detections)
        tables = [folder / "tables" / f"{which}.csv" for which in ("images", "boxes")]
        sizes = {path.name: path.stat().st_size for path in tables}
        return {"bytes": sizes, **run_import(folder, "csv", str(tables[0]), "--detections", str(tables[1]))}


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=100_000)
    parser.add_argument("--detections", type=int, nargs="+", default=[1_000_000, 3_000_000, 10_000_000])
    parser.add_argument("--points", type=int, default=200, help="observations of points an image, which are not needed")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    counts = sorted(options.detections)
    sizes = [(3 * options.images, counts[0]), *((options.images, count) for count in counts)]
    results: dict[str, Any] = {}
    is_right: bool = True
    for kind, run in (("colmap and coco", import_colmap), ("csv", import_csv)):
        found = []
        for images, detections in sizes:
            took = run(images, detections, options.points)
            is_right = is_right and bool(took["images"] == images and took["detections"] == detections)
            found.append(took)
            print(kind, json.dumps(took), flush=True)
        more_images, few, last = found[0], found[1], found[-2:]
        results[kind] = {
            "runs": found,
            "bytes_per_image": _per(more_images, few, "images"),
            # Of the two largest: a part of a file that is written at once is a million detections.
            "bytes_per_detection": _per(last[1], last[0], "detections") if len(counts) > 1 else None,
        }
    keep_record(
        options.json,
        {
            "benchmark": "import_speed",
            "command": "python benchmarks/import_speed.py",
            "data": "simulated",
            **describe_machine(),
            "results": results,
        },
    )
    return int(not is_right)


def _per(more: dict[str, Any], few: dict[str, Any], what: str) -> int:
    """Return how many bytes the peak grows by for each image or detection more."""
    grown = 2**20 * float(more["peak_memory_mb"] - few["peak_memory_mb"])
    return round(grown / float(more[what] - few[what]))


if __name__ == "__main__":
    sys.exit(main())
