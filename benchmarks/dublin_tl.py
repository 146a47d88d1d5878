"""A real layout with simulated detections: traffic lights of central Dublin in street-level panoramas.

    python benchmarks/dublin_tl.py DATA_DIR [--json FILE] [--method NAME] [--set name=value ...]

DATA_DIR holds `gsvs_all.csv` (lat, lon, year and month of real panoramas; no headings) and `DublinTL_2017.csv` (lon
and lat of surveyed poles, separated by blanks). Both are real: crossings of 2 to 16 poles, streets driven often and
once. What a detector shows is simulated, by seed.

Each pole has one head of 0.9 m, 2.7 m above the ground on average. A level panorama, 2.5 m above flat ground, of 2014
or later shows it up to 35 m away with a probability of 0.6. Directions are 1.3 degrees off, as measured in real cities,
sizes of boxes 15 %. One panorama in ten has a false box. Poses are off by 0.15 m (as with a good rig) or by 0.45 m (as
with a poor one) on each axis, each panorama by itself. A month is a pass.

What is counted, within 2 m in the plane, one to one: recall of the poles with two detections and with three; precision
of all labels; F1 of both over all poles with two detections; the mean squared normalised error of right labels, east
and north (2 if covariances are honest).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from field_data import (
    PANORAMA_SIZE_PX,
    Figures,
    command_line,
    dataset_of,
    enu,
    images_of,
    level_rotations,
    panorama_camera,
    ratio,
    read_columns,
    timed_map,
)
from kitti_signs import match_one_to_one
from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.tables import Floats, Ints, covariance_matrices

SEEDS = range(3)
POSITION_SIGMAS_M = (0.15, 0.45)
FIRST_YEAR = 2014
CAMERA_HEIGHT_M = 2.5
HEAD_M = (2.7, 0.3)
"""Height of the middle of heads above the ground, mean and standard deviation."""
HEAD_SIZE_M = 0.9
SIGHT_M = (3.0, 35.0)
RECALL = 0.6
DIRECTION_SIGMA_DEG = 1.3
SIZE_SIGMA = 0.15
CLUTTER_PER_IMAGE = 0.1
SCORES_OF_LIGHTS, SCORES_OF_CLUTTER = (5.0, 2.0), (2.0, 3.0)
"""Parameters of beta distributions."""
RIGHT_M = 2.0


def layout(data_dir: Path) -> tuple[Floats, Floats, list[str], tuple[float, float, float]]:
    """Return panoramas (N, 3) and poles (M, 3) on the ground in metres, the pass of each panorama (N), the anchor."""
    panoramas = read_columns(data_dir / "gsvs_all.csv")
    chosen = panoramas["year"] >= FIRST_YEAR
    lat, lon = panoramas["lat"][chosen], panoramas["lon"][chosen]
    passes = [f"{y}-{m:02d}" for y, m in zip(panoramas["year"][chosen], panoramas["month"][chosen], strict=True)]
    lon_of_pole, lat_of_pole = np.loadtxt(data_dir / "DublinTL_2017.csv", skiprows=1).T
    anchor = (float(np.median(lat)), float(np.median(lon)), 0.0)
    return enu(lat, lon, anchor), enu(lat_of_pole, lon_of_pole, anchor), passes, anchor


def simulate(data_dir: Path, seed: int, position_sigma_m: float) -> tuple[Dataset, Floats, Ints]:
    """Return what is detected, the true heads (M, 3) in metres, and how many detections show each (M)."""
    rng = np.random.default_rng([seed, int(1000 * position_sigma_m)])
    ground, poles, passes, anchor = layout(data_dir)
    centers = ground + [0.0, 0.0, CAMERA_HEIGHT_M]
    heads = poles + np.column_stack([np.zeros((len(poles), 2)), rng.normal(*HEAD_M, len(poles))])
    image, head = np.nonzero(cdist(centers, heads) < SIGHT_M[1])
    ray_m = heads[head] - centers[image]
    is_seen = (np.hypot(ray_m[:, 0], ray_m[:, 1]) > SIGHT_M[0]) & (rng.random(len(ray_m)) < RECALL)
    image, head, ray_m = image[is_seen], head[is_seen], ray_m[is_seen]
    clutter = np.repeat(np.arange(len(centers)), rng.poisson(CLUTTER_PER_IMAGE, len(centers)))
    # False boxes look as if they were heads somewhere.
    like = rng.integers(len(ray_m), size=len(clutter))
    level_m = np.concatenate([np.hypot(ray_m[:, 0], ray_m[:, 1]), np.hypot(*ray_m[like, :2].T)])
    azimuth = np.concatenate([np.arctan2(ray_m[:, 0], ray_m[:, 1]), rng.uniform(-np.pi, np.pi, len(clutter))])
    elevation = np.arctan2(np.concatenate([ray_m[:, 2], ray_m[like, 2]]), level_m)
    sigma = np.radians(DIRECTION_SIGMA_DEG)
    azimuth, elevation = azimuth + rng.normal(0, sigma, len(azimuth)), elevation + rng.normal(0, sigma, len(azimuth))
    width, height = PANORAMA_SIZE_PX
    size_px = HEAD_SIZE_M / level_m * width / (2 * np.pi) * np.exp(rng.normal(0, SIZE_SIGMA, len(level_m)))
    dataset = dataset_of(
        "dublin",
        panorama_camera(),
        images_of(
            [f"panorama-{row:05d}.jpg" for row in range(len(centers))],
            level_rotations(np.zeros(len(centers))),
            centers + rng.normal(0, position_sigma_m, centers.shape),
            passes,
        ),
        image_id=np.concatenate([image, clutter]),
        class_names=["traffic_light"] * len(azimuth),
        center_px=np.column_stack(
            [(azimuth / (2 * np.pi) + 0.5) % 1.0 * width, np.clip(0.5 - elevation / np.pi, 0.01, 0.99) * height]
        ),
        size_px=np.column_stack([size_px / 2.5, size_px]),
        score=np.concatenate([rng.beta(*SCORES_OF_LIGHTS, len(image)), rng.beta(*SCORES_OF_CLUTTER, len(clutter))]),
        anchor=anchor,
    )
    return dataset, heads, np.bincount(head, minlength=len(heads))


def score_map(labels: Floats, covariance_m2: Floats, heads: Floats, shown: Ints) -> Figures:
    """Count labels (N, 3) with covariances (N, 3, 3) against heads (M, 3) that so many detections (M) show."""
    distance_m = cdist(labels[:, :2], heads[:, :2])
    label, head = match_one_to_one(distance_m, distance_m <= RIGHT_M)
    is_found = np.isin(np.arange(len(heads)), head)
    recalls = {f"recall_of_{n}": ratio(int(is_found[shown >= n].sum()), int((shown >= n).sum())) for n in (2, 3)}
    error_m = (labels[label] - heads[head])[:, :2]
    squared = np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(covariance_m2[label][:, :2, :2]), error_m)
    return {
        "heads": int((shown >= 2).sum()),
        "labels": len(labels),
        **recalls,
        "precision": ratio(len(label), len(labels)),
        "f1": ratio(2 * int(is_found[shown >= 2].sum()), len(labels) + int((shown >= 2).sum())),
        "duplicates": int((KDTree(heads[:, :2]).query(labels[:, :2])[0] <= RIGHT_M).sum()) - len(label),
        "rmse_m": round(float(np.sqrt(np.mean(np.sum(error_m**2, axis=1)))), 3),
        "squared_normalised_error": round(float(squared.mean()), 2),
    }


def main() -> int:
    """Run the benchmark; return the exit code."""

    def measure(options: argparse.Namespace, config: MapConfig) -> dict[str, Figures]:
        results: dict[str, Figures] = {}
        for sigma_m in POSITION_SIGMAS_M:
            for seed in SEEDS:
                dataset, heads, shown = simulate(options.data_dir, seed, sigma_m)
                labels = (result := timed_map(dataset, config))[0].labels
                covariance = covariance_matrices(labels.covariance_m2)
                figures = score_map(labels.position_in_world_m, covariance, heads, shown)
                results[f"{sigma_m} m, seed {seed}"] = {**figures, "map_seconds": round(result[1], 2)}
        return results

    return command_line("dublin_tl", __doc__ or "", measure)


if __name__ == "__main__":
    sys.exit(main())
