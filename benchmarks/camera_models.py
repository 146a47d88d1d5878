"""The same simulated cities through pinhole, distorted, fisheye and panoramic cameras, and how exact the map is.

    python benchmarks/camera_models.py [--preset NAME] [--seeds N ...] [--json FILE]

A city is simulated with pinholes. Then every box is put where another camera would see the same rays, so that the noise
in angles is the same in all, whatever it is in pixels. For each camera the table says how many true objects have a
label within 1 m, how many labels have none, and the median and the root mean square distance of those that have one;
the last line is the largest difference of each to the pinholes'.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from machine import write_record
from valuemap.arrays import Floats
from valuemap.cameras import colmap_camera
from valuemap.config import MapConfig, SimulationConfig
from valuemap.dataset import Dataset
from valuemap.pipeline import build_map
from valuemap.simulate import PRESETS, simulate
from valuemap.tables import Categories

MATCH_M = 1.0


def seen_through(dataset: Dataset, model: str, size: tuple[int, int], params: list[float]) -> Dataset:
    """Return a dataset of pinholes with the same viewing rays, and boxes about them, through another camera."""
    pinhole = colmap_camera(dataset.cameras, 0)
    other = pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)

    def moved(pixels: Floats) -> Floats:
        return np.asarray(other.img_from_cam(np.asarray(pinhole.cam_ray_from_img(pixels))))

    detections = dataset.detections
    half = detections.size_px / 2.0
    sides = [moved(detections.center_px + sign * half * axis) for axis in ([1, 0], [0, 1]) for sign in (-1, 1)]
    cameras = dataset.cameras.replace(
        model=Categories.from_texts([model]),
        width_px=np.array([size[0]]),
        height_px=np.array([size[1]]),
        params=[np.array(params, dtype=np.float64)],
    )
    boxes = detections.replace(
        center_px=moved(detections.center_px),
        size_px=np.stack([(sides[1] - sides[0])[:, 0], (sides[3] - sides[2])[:, 1]], axis=1),
    )
    return Dataset(**{**vars(dataset), "cameras": cameras, "detections": boxes})


def cameras_like(dataset: Dataset) -> dict[str, tuple[str, tuple[int, int], list[float]]]:
    """Return cameras with as many pixels a radian in the middle as a dataset's pinholes: model, size, parameters."""
    focal, middle = float(dataset.cameras.params[0][0]), dataset.cameras.params[0][2:].tolist()
    size = (int(dataset.cameras.width_px[0]), int(dataset.cameras.height_px[0]))
    height = round(np.pi * focal)
    return {
        "pinhole": ("PINHOLE", size, [focal, focal, *middle]),
        "opencv": ("OPENCV", size, [focal, focal, *middle, -0.15, 0.03, 0.001, -0.001]),
        "fisheye": ("OPENCV_FISHEYE", size, [focal, focal, *middle, -0.02, 0.004, 0.0, 0.0]),
        "equirectangular": ("EQUIRECTANGULAR", (2 * height, height), [2.0 * height, float(height)]),
    }


def distances_m(dataset: Dataset, config: MapConfig | None = None) -> tuple[Floats, int, int]:
    """Return the distance of each true object that has a label within 1 m to it, all objects, and labels of none."""
    assert dataset.truth is not None
    truth, labels = dataset.truth.position_in_world_m, build_map(dataset, config).labels.position_in_world_m
    away = np.linalg.norm(labels[:, None] - truth[None], axis=2)
    nearest = away.min(axis=0, initial=np.inf)
    return nearest[nearest < MATCH_M], len(truth), int((away.min(axis=1, initial=np.inf) >= MATCH_M).sum())


def measure(config: SimulationConfig, seeds: list[int]) -> dict[str, Any]:
    """Return the figures of each camera over all cities."""
    found: dict[str, list[tuple[Floats, int, int]]] = {}
    for seed in seeds:
        city = simulate(config, seed=seed, name=f"city-{seed}")
        for name, camera in cameras_like(city).items():
            found.setdefault(name, []).append(distances_m(seen_through(city, *camera)))
    result: dict[str, Any] = {}
    for name, cities in found.items():
        distance = np.concatenate([each for each, _, _ in cities])
        result[name] = {
            "objects": sum(objects for _, objects, _ in cities),
            "found": len(distance),
            "false": sum(strangers for _, _, strangers in cities),
            "median_m": round(float(np.median(distance)), 4),
            "rms_m": round(float(np.sqrt(np.mean(distance**2))), 4),
        }
    plain = result["pinhole"]
    result["largest_difference"] = {
        key: round(max(abs(result[name][key] / plain[key] - 1.0) for name in found), 4)
        for key in ("found", "median_m", "rms_m")
    }
    return result


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="small", choices=sorted(PRESETS))
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(5)))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result = measure(PRESETS[options.preset], options.seeds)
    for name, figures in result.items():
        print(f"{name:20} " + "  ".join(f"{key} {value:g}" for key, value in figures.items()))
    write_record(options.json, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
