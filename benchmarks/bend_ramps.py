"""Real detections in real panoramas of half a city: curb ramps of Bend, Oregon, against the city's own survey.

    python benchmarks/bend_ramps.py DATA_DIR [--peer] [--json FILE] [--method NAME] [--set name=value ...]

DATA_DIR holds `panoramas.csv` (lat, lon, heading of the middle column in degrees clockwise from north, month),
`detections.csv` (points, x and y from 0 to 1 of the picture, on a heat map of 512 x 256 cells, and a confidence),
`survey.csv` (installed ramps) and `peer_sites.csv` (what an open peer makes of the same detections, with covariances).

How a user would hold it: one equirectangular camera of 4096 x 2048 pixels, level, 2.5 m above flat ground. A point is a
box without extent. A month of capture is a pass, and there are no times. Names are those of the panoramas, which say
nothing about their order; the images are in the order of the file.

What is counted, as the peer's own evaluation does: labels matched one to one with surveyed ramps, the nearest pair
first, within 2.5 m in the plane.

    covered            ramps matched, over those within 25 m of a panorama
    unmatched          labels without a ramp, over all labels (the survey is not complete)
    sigma per axis     root mean square over both axes of the standard deviation of label minus ramp
    bias               mean of label minus ramp, east and north
    in ellipse         share of the matched within the 95 % ellipse of the label's own horizontal covariance, as it is
                       and after the bias is taken off: a shift of all panoramas is not in any covariance
    chance             share of labels that would be matched if all were moved 20 m to the east

--peer scores the peer's sites in the same way instead of making a map.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import chi2

from field_data import (
    PANORAMA_SIZE_PX,
    Figures,
    command_line,
    dataset_of,
    enu,
    images_of,
    level_rotations,
    panorama_camera,
    positions,
    ratio,
    read_columns,
    timed_map,
)
from kitti_signs import median
from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.tables import Floats, Ints

RADIUS_M = 2.5
COVERAGE_M = 25.0
CAMERA_HEIGHT_M = 2.5
CHANCE_SHIFT_M = 20.0


def anchor_of(data_dir: Path) -> tuple[float, float, float]:
    """Return the middle of all panoramas, where the map's frame has its origin, on the ground."""
    panoramas = read_columns(data_dir / "panoramas.csv")
    return float(np.median(panoramas["lat"])), float(np.median(panoramas["lon"])), 0.0


def load(data_dir: Path) -> Dataset:
    """Return the panoramas and what was detected in them as a dataset."""
    panoramas, seen = read_columns(data_dir / "panoramas.csv"), read_columns(data_dir / "detections.csv")
    anchor = anchor_of(data_dir)
    row_of_image = {name: row for row, name in enumerate(panoramas["panorama_id"].tolist())}
    center = positions(seen, "x_normalized", "y_normalized") * PANORAMA_SIZE_PX
    return dataset_of(
        "bend_ramps",
        panorama_camera(),
        images_of(
            panoramas["panorama_id"].tolist(),
            level_rotations(np.radians(panoramas["heading_deg"])),
            enu(panoramas["lat"], panoramas["lon"], anchor) + [0.0, 0.0, CAMERA_HEIGHT_M],
            panoramas["captured"].astype(str).tolist(),
        ),
        image_id=np.array([row_of_image[name] for name in seen["panorama_id"].tolist()]),
        class_names=["curb_ramp"] * len(center),
        center_px=center,
        size_px=np.zeros_like(center),
        score=seen["confidence"].astype(np.float64),
        anchor=anchor,
    )


def truth(data_dir: Path) -> tuple[Floats, Floats]:
    """Return the places of surveyed ramps (N, 2) and of panoramas (M, 2) in the plane of the map, in metres."""
    survey, panoramas = read_columns(data_dir / "survey.csv"), read_columns(data_dir / "panoramas.csv")
    anchor = anchor_of(data_dir)
    return enu(survey["lat"], survey["lon"], anchor)[:, :2], enu(panoramas["lat"], panoramas["lon"], anchor)[:, :2]


def match_nearest_first(labels: Floats, objects: Floats, radius_m: float) -> tuple[Ints, Ints, Floats]:
    """Return rows of labels and objects and their distances (K): the nearest pair that is left, again and again."""
    pairs = KDTree(labels).sparse_distance_matrix(KDTree(objects), radius_m, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs["j"], pairs["i"], pairs["v"]))]
    is_taken_label, is_taken_object = np.zeros(len(labels), np.bool_), np.zeros(len(objects), np.bool_)
    kept = []
    for row, (label, true_object) in enumerate(zip(pairs["i"].tolist(), pairs["j"].tolist(), strict=True)):
        if not (is_taken_label[label] or is_taken_object[true_object]):
            is_taken_label[label] = is_taken_object[true_object] = True
            kept.append(row)
    pairs = pairs[kept]
    return pairs["i"].astype(np.int64), pairs["j"].astype(np.int64), pairs["v"]


def score_labels(labels: Floats, covariance_m2: Floats, ramps: Floats, panoramas: Floats) -> Figures:
    """Count and measure labels (N, 2) with covariances (N, 2, 2) against ramps (M, 2), seen from panoramas (K, 2)."""
    is_near = np.atleast_1d(KDTree(panoramas).query(ramps)[0] <= COVERAGE_M)
    label, ramp, distance_m = match_nearest_first(labels, ramps, RADIUS_M)
    by_chance = match_nearest_first(labels + [CHANCE_SHIFT_M, 0.0], ramps, RADIUS_M)[0]
    error = labels[label] - ramps[ramp]
    bias = error.mean(axis=0) if len(error) else np.full(2, np.nan)
    return {
        "ramps": int(is_near.sum()),
        "labels": len(labels),
        "matched": len(label),
        "covered": ratio(int(is_near[ramp].sum()), int(is_near.sum())),
        "unmatched": ratio(len(labels) - len(label), len(labels)),
        "median_distance_m": median(distance_m),
        "sigma_per_axis_m": round(float(np.sqrt(error.var(axis=0).mean())), 3) if len(error) else None,
        "bias_east_m": round(float(bias[0]), 3),
        "bias_north_m": round(float(bias[1]), 3),
        "in_95_ellipse": share_in_ellipse(error, covariance_m2[label]),
        "in_95_ellipse_less_bias": share_in_ellipse(error - bias, covariance_m2[label]),
        "matched_by_chance": ratio(len(by_chance), len(labels)),
    }


def share_in_ellipse(error_m: Floats, covariance_m2: Floats) -> float | None:
    """Return the share of errors (N, 2) within the 95 % ellipses of their covariances (N, 2, 2)."""
    squared = np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(covariance_m2), error_m)
    return ratio(int((squared <= chi2.ppf(0.95, 2)).sum()), len(error_m))


def score_peer(data_dir: Path) -> Figures:
    """Score the sites of the peer."""
    sites = read_columns(data_dir / "peer_sites.csv")
    xx, xy, yy = positions(sites, "cov_ee_m2", "cov_en_m2", "cov_nn_m2").T
    covariance = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    return score_labels(enu(sites["lat"], sites["lon"], anchor_of(data_dir))[:, :2], covariance, *truth(data_dir))


def run(data_dir: Path, config: MapConfig) -> dict[str, Figures]:
    """Map and score."""
    result, seconds = timed_map(load(data_dir), config)
    xx, xy, _, yy, _, _ = result.labels.covariance_m2.T
    covariance = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    figures = score_labels(result.labels.position_in_world_m[:, :2], covariance, *truth(data_dir))
    return {"bend": {**figures, "map_seconds": round(seconds, 2)}}


def main() -> int:
    """Run the benchmark; return the exit code."""

    def add_options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--peer", action="store_true", help="score the sites of the peer")

    def measure(options: argparse.Namespace, config: MapConfig) -> dict[str, Figures]:
        return {"peer": score_peer(options.data_dir)} if options.peer else run(options.data_dir, config)

    return command_line("bend_ramps", __doc__ or "", measure, add_options)


if __name__ == "__main__":
    sys.exit(main())
