"""Real detections in real panoramas of half a city: curb ramps of Bend, Oregon, against the city's own survey.

    python benchmarks/bend_ramps.py DATA_DIR [--peer] [--details] [--json FILE] [--method NAME] [--set name=value ...]

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

--peer scores the peer's sites in the same way instead of making a map. --details adds parts:

    with the peer      sigma per axis over the ramps that both find, ours and the peer's
    votes N            labels by votes: what existence says on average, the share that is matched, and the same over
                       the share of ramps that the survey has; halves: median squared distance, in sigmas, of the labels
                       of this many votes from those of the other half, where every other panorama from west to east
                       makes a map (of two labels, the fewer votes count)
    existence A..B     the same by existence, with min_existence at nearly 0
    unmatched 0.12     how many ramps are covered by the labels of most existence of which so many are unmatched
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import chi2

from field_data import (
    PANORAMA_SIZE_PX,
    Change,
    Figures,
    as_it_is,
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
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.pipeline import build_map
from valuemap.tables.covariance import covariance_matrices

RADIUS_M = 2.5
COVERAGE_M = 25.0
CAMERA_HEIGHT_M = 2.5
CHANCE_SHIFT_M = 20.0
NOT_SURVEYED = 0.05
"""Ramps that are there and not in the survey: what is unmatched of labels of six votes and more."""
NEARLY_0 = 1e-4
VOTES = ((1, 1), (2, 2), (3, 3), (4, 4), (5, 10**6))
EXISTENCE = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.01)
UNMATCHED = (0.10, 0.12, 0.15, 0.19, 0.24)
STEP = 20
"""So many labels more at a time."""


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


def run(data_dir: Path, config: MapConfig, change: Change = as_it_is) -> dict[str, Figures]:
    """Map and score."""
    result, seconds = timed_map(change(load(data_dir)), config)
    covariance = covariance_matrices(result.labels.covariance_m2)[:, :2, :2]
    figures = score_labels(result.labels.position_in_world_m[:, :2], covariance, *truth(data_dir))
    return {"bend": {**figures, "map_seconds": round(seconds, 2)}}


def run_details(data_dir: Path, config: MapConfig) -> dict[str, Figures]:
    """Map and score, and say what existence, votes and covariances are worth."""
    dataset = load(data_dir)
    ramps, panoramas = truth(data_dir)
    results = run(data_dir, config)
    everything = build_map(dataset, config.with_settings([f"min_existence={NEARLY_0}"])).labels
    assert everything.existence is not None
    is_kept = everything.existence >= config.existence.min_existence
    place = everything.position_in_world_m[:, :2]
    is_matched = np.zeros(len(everything), np.bool_)
    is_matched[match_nearest_first(place, ramps, RADIUS_M)[0]] = True
    results["with the peer"] = _with_the_peer(data_dir, place[is_kept], ramps)
    squared, votes = _halves(dataset, config)
    for low, high in VOTES:
        chosen = is_kept & (everything.votes >= low) & (everything.votes <= high)
        of_halves = squared[(votes >= low) & (votes <= high)]
        results[f"votes {low}" if low == high else f"votes {low} or more"] = {
            **_reliability(everything.existence, is_matched, chosen),
            "halves": len(of_halves),
            "halves_median_sigmas2": round(float(np.median(of_halves)), 3) if len(of_halves) else None,
        }
    for low_share, high_share in itertools.pairwise(EXISTENCE):
        chosen = (everything.existence >= low_share) & (everything.existence < high_share)
        results[f"existence {low_share}..{min(high_share, 1.0)}"] = _reliability(
            everything.existence, is_matched, chosen
        )
    order = np.argsort(-everything.existence, kind="stable")
    is_near = np.atleast_1d(KDTree(panoramas).query(ramps)[0] <= COVERAGE_M)
    curve = [_covered(place[order[:count]], ramps, is_near) for count in range(STEP, len(order) + STEP, STEP)]
    for share in UNMATCHED:
        results[f"unmatched {share}"] = {
            "covered": max((covered for covered, unmatched in curve if unmatched <= share), default=None)
        }
    for part, figures in itertools.islice(results.items(), 1, None):
        print(part, *(f"{name} {value}" for name, value in figures.items()), sep="  ")
    return results


def _covered(labels: Floats, ramps: Floats, is_near: Bools) -> tuple[float, float]:
    """Return which share of the near ramps labels cover, and which share of the labels is unmatched."""
    label, ramp, _ = match_nearest_first(labels, ramps, RADIUS_M)
    return round(float(is_near[ramp].sum() / is_near.sum()), 4), 1.0 - len(label) / len(labels)


def _reliability(existence: Floats, is_matched: Bools, chosen: Bools) -> Figures:
    return {
        "labels": int(chosen.sum()),
        "existence": round(float(existence[chosen].mean()), 3) if chosen.any() else None,
        "matched": ratio(int(is_matched[chosen].sum()), int(chosen.sum())),
        "matched_of_surveyed": ratio(int(is_matched[chosen].sum()), (1.0 - NOT_SURVEYED) * int(chosen.sum())),
    }


def _with_the_peer(data_dir: Path, labels: Floats, ramps: Floats) -> Figures:
    sites = read_columns(data_dir / "peer_sites.csv")
    of_peer = enu(sites["lat"], sites["lon"], anchor_of(data_dir))[:, :2]
    found = [match_nearest_first(each, ramps, RADIUS_M)[:2] for each in (labels, of_peer)]
    both = np.intersect1d(found[0][1], found[1][1])
    sigma = []
    for each, (label, ramp) in zip((labels, of_peer), found, strict=True):
        chosen = np.isin(ramp, both)
        sigma.append(round(float(np.sqrt((each[label[chosen]] - ramps[ramp[chosen]]).var(axis=0).mean())), 3))
    return {"labels": len(both), "sigma_per_axis_m": sigma[0], "sigma_per_axis_of_peer_m": sigma[1]}


def _halves(dataset: Dataset, config: MapConfig) -> tuple[Floats, Ints]:
    """Return squared distances (K) in sigmas between labels of every other panorama and of the rest, and votes (K)."""
    images = dataset.images
    east, north, _ = camera_centers(images).T
    rank = np.empty(len(images), np.int64)
    rank[np.lexsort((east, north))] = np.arange(len(images))
    halves = []
    for half in (0, 1):
        rows = np.flatnonzero(rank % 2 == half)
        is_there = np.isin(dataset.detections.image_id, images.image_id[rows])
        part = replace(dataset, images=images.take(rows), detections=dataset.detections.take(is_there))
        halves.append(build_map(part, config).labels)
    one, other = halves
    first, second, _ = match_nearest_first(one.position_in_world_m[:, :2], other.position_in_world_m[:, :2], RADIUS_M)
    covariance = covariance_matrices(one.covariance_m2[first] + other.covariance_m2[second])[:, :2, :2]
    apart = (one.position_in_world_m[first] - other.position_in_world_m[second])[:, :2]
    squared = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(covariance), apart)
    return squared, np.minimum(one.votes[first], other.votes[second])


def main() -> int:
    """Run the benchmark; return the exit code."""

    def add_options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--peer", action="store_true", help="score the sites of the peer")
        parser.add_argument("--details", action="store_true", help="what existence, votes and covariances are worth")

    def measure(options: argparse.Namespace, config: MapConfig) -> dict[str, Figures]:
        if options.peer:
            return {"peer": score_peer(options.data_dir)}
        return (run_details if options.details else run)(options.data_dir, config)

    return command_line("bend_ramps", __doc__ or "", measure, add_options)


if __name__ == "__main__":
    sys.exit(main())
