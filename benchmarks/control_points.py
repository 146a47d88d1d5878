"""How well a few surveyed points tell the shift of a georeference: many random draws from the ramps of Bend.

    python benchmarks/control_points.py DATA_DIR [--map FOLDER] [--draws N] [--json FILE]

DATA_DIR is that of `bend_ramps.py`. The map is made with default settings, or read from FOLDER. The shift that counts
as true is that of all matched ramps, some thousand of them: label and ramp one to one within 1.5 m, the median of their
differences on each axis, three times over.

For each number of control points, so many surveyed ramps within 25 m of a panorama are drawn at random, and the map is
moved to them as `valuemap map --control` does. What is counted, over all draws:

    refused           draws in which fewer than three points agree about one shift, or no more than would by chance
    rms, median, q90  distance on the ground between the shift that is found and the true one, m
    attainable        what the mean of so many matched points is off by at best: sigma of a ramp less its label, each
                      axis, times sqrt(2 / points)
    in_2_sigmas       share of draws whose shift is within two of its own standard deviations, each axis
    held out          rmse on the ground, m, of thirty other matched ramps, as mapped and as moved (rms over the draws)
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from bend_ramps import COVERAGE_M, load, match_nearest_first, truth
from machine import describe_machine, keep_record
from valuemap import build_map
from valuemap.arrays import Floats
from valuemap.config import MapConfig
from valuemap.control import find_georeference
from valuemap.errors import InputError
from valuemap.evaluate.truth import TrueObjects
from valuemap.map_folder import Map, read_map

POINTS = (5, 10, 20, 40)
HELD_OUT = 30
SURE_M = 1.5


def main() -> None:
    """Run the benchmark and print a line for each number of points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_dir", type=Path, metavar="DATA_DIR")
    parser.add_argument("--map", type=Path, metavar="FOLDER", help="a map of the data, made with other settings, say")
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    result = read_map(options.map) if options.map else build_map(load(options.data_dir), MapConfig())
    ramps, panoramas = truth(options.data_dir)
    near = ramps[np.atleast_1d(KDTree(panoramas).query(ramps)[0] <= COVERAGE_M)]
    figures = measure(result, near, options.draws)
    for line in figures["points"]:
        print("  ".join(f"{name} {value}" for name, value in line.items()))
    record = {
        "command": f"python benchmarks/control_points.py DATA_DIR --draws {options.draws}",
        "data": "bend_ramps",
        **describe_machine(),
        "results": figures,
    }
    keep_record(options.json, record)


def measure(result: Map, ramps: Floats, draws: int) -> dict[str, Any]:
    """Return what is found with draws of ramps (N, 2) against the shift of all of them."""
    labels = result.labels.position_in_world_m[:, :2]
    shift = np.zeros(2)
    for _ in range(3):
        label, ramp, _ = match_nearest_first(labels + shift, ramps, SURE_M)
        shift = np.median(ramps[ramp] - labels[label], axis=0)
    apart = ramps[ramp] - labels[label] - shift
    sigma_m = float(np.sqrt(np.mean(apart.var(axis=0))))
    lines = [_draw(result, ramps, (label, ramp), shift, sigma_m, points, draws) for points in POINTS]
    return {
        "true_shift_east_north_m": [round(float(v), 3) for v in shift],
        "matched": len(label),
        "sigma_per_axis_m": round(sigma_m, 3),
        "points": lines,
    }


def _draw(
    result: Map, ramps: Floats, matched: tuple[Any, Any], shift: Floats, sigma_m: float, points: int, draws: int
) -> dict[str, Any]:
    random = np.random.default_rng(0)
    labels = result.labels.position_in_world_m[:, :2]
    off, inside, before, after = [], [], [], []
    for _ in range(draws):
        rows = random.choice(len(ramps), points, replace=False)
        place = np.column_stack([ramps[rows], np.zeros(points)])
        control = TrueObjects(np.arange(points), place, None, has_height=False)
        rest = random.permutation(np.flatnonzero(~np.isin(matched[1], rows)))[:HELD_OUT]
        try:
            found = find_georeference(result, control)
        except InputError:
            continue
        cos, sin = np.cos(found.turn_rad), np.sin(found.turn_rad)
        turn, pivot = np.array([[cos, -sin], [sin, cos]]), found.pivot_m[:2]
        error = found.shift_m[:2] - shift
        off.append(float(np.linalg.norm(error)))
        inside.append(np.mean(np.abs(error) < 2.0 * np.sqrt(np.diag(found.covariance)[:2])))
        of, to = labels[matched[0][rest]], ramps[matched[1][rest]]
        before.append(np.mean(np.sum((to - of) ** 2, axis=1)))
        after.append(np.mean(np.sum((to - ((of - pivot) @ turn.T + pivot + found.shift_m[:2])) ** 2, axis=1)))
    return {
        "points": points,
        "draws": draws,
        "refused": draws - len(off),
        "rms_m": round(float(np.sqrt(np.mean(np.square(off)))), 3),
        "median_m": round(float(np.median(off)), 3),
        "q90_m": round(float(np.quantile(off, 0.9)), 3),
        "attainable_rms_m": round(sigma_m * float(np.sqrt(2.0 / points)), 3),
        "in_2_sigmas": round(float(np.mean(inside)), 3),
        "held_out_rmse_as_mapped_m": round(float(np.sqrt(np.mean(before))), 3),
        "held_out_rmse_m": round(float(np.sqrt(np.mean(after))), 3),
    }


if __name__ == "__main__":
    main()
