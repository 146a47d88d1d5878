"""How fast the page of `valuemap view` is with large maps, and how fast a report opens.

    valuemap simulate --preset nyc --out nyc && valuemap map nyc --out nyc-map && valuemap report nyc-map --out nyc.html
    npm ci --prefix viewer
    python benchmarks/viewer.py --map nyc-map --report nyc.html --repeats 3 --json benchmarks/results/viewer.json
    python benchmarks/viewer.py --json benchmarks/results/viewer.json

The first measures simulated New York, the second a city with far more labels: 50,000 labels and 400,000 images in 100
passes are made up without mapping (positions along a grid of streets, twelve votes a label), because the page cares
about numbers and places only. The figures are the browser's own (Performance API), in Debian's Chromium without a
graphics card.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.dataset import Dataset, Frame, write_dataset
from valuemap.map_folder import Map, write_map
from valuemap.tables import Cameras, Categories, Detections, Images, Labels, Votes
from valuemap.viewer.scene import Scene
from valuemap.viewer.server import Content, ViewServer

VIEWER = Path(__file__).parent.parent / "viewer"
SPACING_M, BLOCK_M, BLOCKS, VOTES = 4.0, 100.0, 100, 12
WIDTH, HEIGHT, FOCAL = 640, 480, 500.0

Figures = dict[str, Any]


def made_up_city(labels: int, images: int, passes: int, *, seed: int = 0) -> tuple[Dataset, Map]:
    """Return a dataset and a map whose votes belong to it; images drive along a grid, labels stand beside them."""
    random = np.random.default_rng(seed)
    steps = images // passes
    center, heading = np.empty((passes, steps, 3)), np.empty((passes, steps))
    per_block = int(BLOCK_M / SPACING_M)
    for row in range(passes):
        turns = random.integers(-1, 2, size=-(-steps // per_block))
        direction = np.repeat(np.cumsum(turns) % 4, per_block)[:steps] * (np.pi / 2.0)
        step = SPACING_M * np.column_stack([np.cos(direction), np.sin(direction)])
        start = BLOCK_M * random.integers(0, BLOCKS, 2)
        path = start + np.cumsum(step, axis=0)
        center[row, :, :2] = np.abs((path + BLOCK_M * BLOCKS) % (2 * BLOCK_M * BLOCKS) - BLOCK_M * BLOCKS)
        center[row, :, 2], heading[row] = 1.6, direction
    return _city_around(center.reshape(-1, 3), heading.reshape(-1), labels, passes, random)


def _city_around(
    center: Floats, heading: Floats, labels: int, passes: int, random: np.random.Generator
) -> tuple[Dataset, Map]:
    """Return images at these places (N, 3) with these headings (N), pass after pass, and labels beside them."""
    count = len(center)
    steps = count // passes
    right = np.column_stack([np.sin(heading), -np.cos(heading), np.zeros(count)])
    forward = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    rotation = np.stack([right, np.broadcast_to([0.0, 0.0, -1.0], (count, 3)), forward], axis=1)
    dataset_images = Images(
        image_id=np.arange(count),
        name=pa.array([f"{i // steps:03d}/{i % steps:05d}.jpg" for i in range(count)]),
        camera_id=np.ones(count, np.int64),
        cam_from_world_quat=Rotation.from_matrix(rotation).as_quat(scalar_first=True),
        cam_from_world_m=-np.einsum("nij,nj->ni", rotation, center),
        pass_id=Categories.from_texts(np.repeat([f"pass-{i:03d}" for i in range(passes)], steps).tolist()),
        timestamp_s=1.7e9 + 0.4 * np.arange(count, dtype=np.float64),
    )
    last = np.sort(random.choice(np.arange(VOTES, count), labels, replace=False))
    last = np.maximum(last, last // steps * steps + VOTES)
    position = center[last] + 6.0 * forward[last] + random.choice([-5.0, 5.0], labels)[:, None] * right[last]
    position[:, 2] = random.uniform(3.0, 6.0, labels)
    voter = (last[:, None] - np.arange(VOTES)).ravel()
    label = np.repeat(np.arange(labels), VOTES)
    in_cam = np.einsum("nij,nj->ni", rotation[voter], position[label] - center[voter])
    pixel = FOCAL * in_cam[:, :2] / np.maximum(in_cam[:, 2:], 1.0) + [WIDTH / 2, HEIGHT / 2]
    pixel = np.clip(pixel + random.normal(0.0, 1.0, pixel.shape), 0.0, [WIDTH, HEIGHT])
    classes = Categories.from_texts([("traffic_light", "stop", "speed_limit")[i % 3] for i in range(labels)])
    order = np.lexsort((voter, label))
    detections = Detections(
        detection_id=np.arange(len(voter)),
        image_id=voter[order],
        class_name=classes.take(label[order]),
        center_px=pixel[order],
        size_px=np.tile([12.0, 30.0], (len(voter), 1)),
        score=random.uniform(0.4, 1.0, len(voter)),
    )
    residual = np.abs(random.normal(0.0, 1.2, len(voter)))
    existence = 1.0 - random.beta(0.3, 8.0, labels)
    sigma = random.gamma(3.0, 0.03, (labels, 3))
    zeros = np.zeros(labels)
    found = Labels(
        label_id=np.arange(1, labels + 1),
        class_name=classes,
        position_in_world_m=position,
        covariance_m2=np.column_stack(
            [sigma[:, 0] ** 2, 0.4 * sigma[:, 0] * sigma[:, 1], zeros, sigma[:, 1] ** 2, zeros, sigma[:, 2] ** 2]
        ),
        votes=np.full(labels, VOTES),
        passes=np.ones(labels, np.int64),
        object_width_m=np.full(labels, 0.3),
        object_height_m=np.full(labels, 0.9),
        reprojection_rms_px=np.full(labels, 1.2),
        max_parallax_rad=np.full(labels, 0.5),
        first_seen_s=np.full(labels, 1.7e9),
        last_seen_s=np.full(labels, 1.7e9 + 5.0),
        facing_azimuth_rad=np.zeros(labels),
        facing_concentration=np.ones(labels),
        expected=np.full(labels, VOTES),
        existence=existence,
    )
    votes = Votes(
        label_id=label[order] + 1,
        detection_id=detections.detection_id,
        image_id=detections.image_id,
        residual_px=residual,
        residual_sigmas=residual / 1.2,
    )
    cameras = Cameras(
        camera_id=np.array([1]),
        model=Categories.from_texts(["PINHOLE"]),
        width_px=np.array([WIDTH]),
        height_px=np.array([HEIGHT]),
        params=[np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])],
    )
    dataset = Dataset("made-up city", Frame(), cameras, dataset_images, detections)
    return dataset, Map(Frame(), found, votes, {"dataset": "made-up city", "settings": {"max_range_m": 60.0}})


def measure_made_up(folder: Path, labels: int, images: int, passes: int, screenshot: Path, clicks: int) -> Figures:
    """Make the city up, serve it, and let a browser say how fast it is."""
    dataset, result = made_up_city(labels, images, passes)
    write_dataset(dataset, folder / "dataset")
    write_map(result, folder / "map")
    return measure(folder / "map", None, screenshot, clicks)


def measure(map_: Path, dataset: Path | None, screenshot: Path, clicks: int) -> Figures:
    """Serve a map, and let a browser say how fast its page is."""
    begun = time.perf_counter()
    content = Content(lambda: Scene(map_, dataset_folder=dataset), None)
    start_seconds = time.perf_counter() - begun
    scene = content.scene
    ids = scene.result.labels.label_id
    server = ViewServer(content)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    chosen = ids[np.linspace(len(ids) // 20, len(ids) - 1 - len(ids) // 20, clicks).astype(int)]
    load = os.getloadavg()[0]
    seen = _in_browser("measure.mjs", server.address, str(screenshot.absolute()), *map(str, chosen))
    server.shutdown()
    return {
        "labels": len(ids),
        "images": 0 if scene.evidence is None else len(scene.evidence.dataset.images),
        "passes": len(scene.head()["passes"]),
        "votes": len(scene.result.votes),
        "load": round(load, 1),
        "server_start_s": round(start_seconds, 2),
        "interactive_ms": round(seen["interactive_ms"]),
        "interactive_cpu_ms": round(seen["loading_cpu_ms"]),
        "labels_drawn": seen["drawn"],
        "pan": _rounded(seen["pan"]),
        "zoom": _rounded(seen["zoom"]),
        "click_by_hand": _clicks(seen["by_hand"]),
        "click_at_once": _clicks(seen["at_once"]),
        "answer_median_ms": round(statistics.median(seen["answers_ms"])),
        "complaints": seen["complaints"],
    }


def measure_report(page: Path) -> Figures:
    """Open a report from disk, and let the browser say how long that took."""
    load = os.getloadavg()[0]
    seen = _in_browser("report.mjs", str(page.absolute()), "on", "")
    return {
        "labels": seen["labels"],
        "megabytes": round(page.stat().st_size / 1e6, 1),
        "load": round(load, 1),
        "first_paint_ms": round(seen["opened_ms"]["paint"]),
        "ready_ms": round(seen["opened_ms"]["ready"]),
        "loaded_ms": round(seen["opened_ms"]["loaded"]),
        "complaints": seen["complaints"],
    }


def _in_browser(script: str, *arguments: str) -> dict[str, Any]:
    line = ["node", f"e2e/{script}", *arguments]
    done = subprocess.run(line, cwd=VIEWER, capture_output=True, text=True, check=False, env=os.environ.copy())
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    seen: dict[str, Any] = json.loads(done.stdout)
    return seen


def _middle(runs: list[Figures], by: str) -> Figures:
    """Return the middle one of all runs by one figure, with what all of them say of it."""
    middle = sorted(runs, key=lambda run: run[by])[len(runs) // 2]
    return {**middle, f"{by}_of_all_runs": [run[by] for run in runs]}


def _clicks(seen: dict[str, list[float]]) -> dict[str, int]:
    """Return the time to the answer, to the next paint (Event Timing), and of the page's main thread."""
    return {
        "median_ms": round(statistics.median(seen["ms"])),
        "worst_ms": round(max(seen["ms"])),
        "painted_median_ms": round(statistics.median(seen["painted_ms"])),
        "median_cpu_ms": round(statistics.median(seen["cpu_ms"])),
    }


def _rounded(figures: dict[str, Any]) -> dict[str, int | None]:
    return {name: None if value is None else round(value) for name, value in figures.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--map", type=Path, help="measure this map instead of a made-up city")
    parser.add_argument("--dataset", type=Path, help="the dataset of --map, where it is not found by itself")
    parser.add_argument("--report", type=Path, help="measure this report of a map too")
    parser.add_argument("--name", default="nyc", help="what --map is called in the file of results")
    parser.add_argument("--labels", type=int, default=50_000)
    parser.add_argument("--images", type=int, default=400_000)
    parser.add_argument("--passes", type=int, default=100)
    parser.add_argument("--clicks", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=1, help="the middle run counts: others share the machine")
    parser.add_argument("--screenshot", type=Path, default=Path("viewer-large.png"))
    parser.add_argument("--json", type=Path, help="figures of other names in this file are kept")
    given = parser.parse_args()
    kept: dict[str, Any] = {}
    if given.json is not None and given.json.is_file():
        kept = json.loads(given.json.read_text(encoding="utf-8"))
    measured: dict[str, Figures] = {}
    repeats = range(given.repeats)
    if given.map is not None:
        runs = [measure(given.map, given.dataset, given.screenshot, given.clicks) for _ in repeats]
        measured[given.name] = _middle(runs, "interactive_ms")
    if given.report is not None:
        measured[f"report of {given.name}"] = _middle([measure_report(given.report) for _ in repeats], "ready_ms")
    if given.map is None and given.report is None:
        with tempfile.TemporaryDirectory() as folder:
            sizes = given.labels, given.images, given.passes
            measured["made up"] = measure_made_up(Path(folder), *sizes, given.screenshot, given.clicks)
    machine = f"{platform.machine()}, {os.cpu_count()} cores shared with other work (see load), no graphics card"
    for figures in measured.values():
        figures["machine"] = machine
    print(json.dumps(measured, indent=2))
    if given.json is not None:
        given.json.write_text(json.dumps({**kept, **measured}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
