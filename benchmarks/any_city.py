"""Cities of random settings: how good a map is where nobody chose the settings.

    python benchmarks/any_city.py [--seeds N|FIRST..LAST [N|FIRST..LAST ...]] [--set name=value ...] [--json FILE]

Each seed draws a city, its objects, a car, a detector and errors of poses, each setting from a range that is written
below (simulated). Each fault is there or not: a draw has about a third of them. Counted is what `dense.py` counts,
for objects whose bound is at most 0.5 m. A line for each seed says what was drawn, so that what is odd can be looked
at; the last line is all seeds together. The seeds 0 to 15, which the results are of, were looked at while the method
was made, as were those that docs/notes/method.md names: a test of it needs others.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

import valuemap
from cities import seeds_from
from dense import Outcome, Scene, add_up, line, measure
from machine import write_record
from valuemap.config import SimulationConfig
from valuemap.simulate import record_city

FAULT_SHARE = 0.3
"""How often a draw has each fault: about four of fourteen, so that faults meet each other."""

MOST_DETECTIONS = 25_000
"""Of a city; one with more is drawn again, driven less often, so that a seed takes no minutes."""


def main() -> None:
    """Run the benchmark, print a line for each city, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", default=["0..19"], metavar="N|FIRST..LAST")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE", help="of the map")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    config = valuemap.MapConfig().with_settings(options.settings)
    outcomes: list[Outcome] = []
    results: list[dict[str, Any]] = []
    for seed in seeds_from(options.seeds):
        drawn, outcome = outcome_of(seed, config)
        outcomes.append(outcome)
        results.append({"name": f"seed {seed}", "drawn": drawn, **add_up([outcome])})
        print(line(results[-1]), " ".join(f"{name}={value}" for name, value in drawn.items()), flush=True)
    results.append({"name": "all", **add_up(outcomes)})
    print(line(results[-1]))
    write_record(options.json, results)


def outcome_of(seed: int, config: valuemap.MapConfig) -> tuple[dict[str, float], Outcome]:
    """Return what is drawn for a seed, and what becomes of it."""
    drawn = draw(np.random.default_rng(seed))
    while True:
        city = dataclasses.replace(SimulationConfig(), **drawn)  # type: ignore[arg-type]
        recording = record_city(city, seed=seed, name="any")
        if len(recording.dataset.detections) <= MOST_DETECTIONS or drawn["passes_per_street"] == 1:
            return drawn, measure(recording, config, Scene(city))
        drawn["passes_per_street"] = int(drawn["passes_per_street"]) // 2


def draw(random: np.random.Generator) -> dict[str, float]:
    """Return settings of the simulator."""

    def between(least: float, most: float) -> float:
        return float(f"{random.uniform(least, most):.3g}")

    def about(least: float, most: float) -> float:
        return float(f"{np.exp(random.uniform(np.log(least), np.log(most))):.3g}")

    def some(share: float = FAULT_SHARE) -> bool:
        return bool(random.random() < share)

    drawn: dict[str, float] = {
        "streets_north_south": int(random.integers(2, 4)),
        "streets_east_west": int(random.integers(2, 4)),
        "street_width_m": between(24.0, 40.0),
        "relief_m": between(0.0, 4.0),
        "passes_per_street": int(random.integers(1, 9)),
        "frame_spacing_m": about(1.0, 8.0),
        "focal_px": about(300.0, 1200.0),
        "camera_height_m": between(1.2, 2.8),
        "max_sight_m": between(50.0, 150.0),
        "recall_mean": between(0.4, 0.95),
        "pixel_noise_px": about(0.4, 3.0),
        "pixel_noise_share": between(0.0, 0.12),
        "size_noise": between(0.03, 0.3),
        "clutter_per_image": about(0.005, 0.5),
        "position_white_m": about(0.01, 0.3),
        "position_drift_m": about(0.01, 0.6),
        "rotation_white_deg": about(0.01, 0.3),
        "rotation_drift_deg": about(0.01, 0.3),
        "drift_length_m": about(30.0, 300.0),
    }
    has_lights = some(0.7)
    drawn |= {"has_lights": 1, "signalised_share": between(0.3, 1.0)} if has_lights else {"has_lights": 0}
    kinds: list[dict[str, float]] = [
        {"sign_row_spacing_m": between(20.0, 60.0), "sign_apart_m": between(0.5, 1.5)},
        {"lamp_spacing_m": between(15.0, 40.0)},
        {"tree_spacing_m": between(6.0, 15.0)},
        {"post_spacing_m": between(3.0, 10.0)},
    ]
    # Without lights there is another kind, with them there may be.
    others = kinds[int(random.integers(len(kinds)))] if some() or not has_lights else {}
    drawn |= others
    faults: list[dict[str, float]] = [
        {"cameras": int(random.integers(2, 4)), "camera_folders": int(random.integers(0, 3))},
        {"shuffle_ids": 1},
        {"write_pose_sigmas": 1},
        {"double_share": between(0.02, 0.2)},
        {"tail_share": between(0.02, 0.1)},
        {"min_visible_share": between(0.2, 0.6), "partly_hidden_share": between(0.0, 0.15)},
        {"size_spread": between(0.05, 0.3)},
        {"side_offset_m": between(0.03, 0.2)},
        {"class_confusion": between(0.02, 0.15) if has_lights and others else 0.0},
        {"position_middle_m": about(0.02, 0.3), "rotation_middle_deg": about(0.02, 0.2)},
        {"lookalikes_per_light": between(0.02, 0.2) if has_lights else 0.02},
        {"temporary_per_1000_images": between(0.1, 2.0)},
        {"occluded_share": between(0.1, 0.4)},
        {"readout_s": between(0.01, 0.04)},
    ]
    for fault in faults:
        drawn |= fault if some() else {}
    return drawn


if __name__ == "__main__":
    main()
