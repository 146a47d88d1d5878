"""Real street plans with simulated detections: signals of San Francisco from cars, poles of Dublin in panoramas.

    python benchmarks/real_layouts.py DATA_ROOT [--seeds N|FIRST..LAST ...] [--only NAME ...] [--json FILE]

DATA_ROOT holds `apollo_san_francisco` (201 signals with faces, 1,524 lanes with successors) and `dublin_tl` (surveyed
poles, places and months of real panoramas). Places are real. Misses, noise, false boxes and errors of poses are those
of the simulator (`layouts.py`, `valuemap.simulate`), by seed.

    sf N tours         drives over lanes that together are N times as long as all lanes, an image every 2 m; signals are
                       5 m high and 0.65 x 1.5 m large and are seen from before them, up to 120 m away
    dublin YEAR, S m   panoramas that show the poles of the survey of that year, one head on each, seen from all sides
                       up to 35 m away; directions are 1.3 degrees off (each axis), positions S m on each axis (as the
                       simulator shares it: 0.6 of it each panorama by itself, 0.8 drifting over 100 m); a month is a
                       pass, without times, and names say nothing of the order
    ... two heads      a third of the poles have a second head a metre lower

Counted as in `robust.py`: recall of the recoverable objects with at least three detections whose Cramer-Rao bound is at
most 1 m, matched one to one within 2 m; their position rmse over the bound; precision and mean squared normalised error
(3 if covariances are honest) of all labels. `of_any_bound` is the recall without a limit to the bound.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import valuemap
from bound import cramer_rao_covariances, true_views
from cities import Case, add_up, compare, line, seeds_from
from field_data import PANORAMA_SIZE_PX, timed_map
from layouts import BAND_HEIGHT_PX, PANORAMA_ABOVE_M, PX_PER_RAD, dublin, san_francisco, views_in_panoramas
from machine import write_record
from valuemap.config import SimulationConfig
from valuemap.dataset import rows_of
from valuemap.errors import ValuemapError
from valuemap.simulate import Recording

DIRECTION_SIGMA_DEG = 1.3
PANORAMA_SIGHT_M = 35.0
OWN_SHARE, DRIFT_SHARE = 0.6, 0.8
"""Of the errors of positions; their squares add up to 1, as in the simulator's defaults."""
SECOND_HEAD_SHARE = 0.35
MAX_BOUND_M = 1.0
"""Half of the radius within which labels are matched: larger bounds would be met by chance."""


@dataclass(frozen=True)
class Layout:
    """How one layout is recorded: from the root of the data and a seed; in panoramas or not."""

    record: Callable[[Path, int], Recording]
    is_panoramic: bool


def drives(tours: float) -> Layout:
    """Return drives through San Francisco."""
    config = dataclasses.replace(SimulationConfig(), relief_m=0.0, lookalikes_per_light=0.0)
    return Layout(lambda root, seed: san_francisco(root / "apollo_san_francisco", config, tours, seed=seed), False)


def panorama_config(position_sigma_m: float) -> SimulationConfig:
    """Return how panoramas with such errors of positions are detected in: the picture is the band round the horizon."""
    return dataclasses.replace(
        SimulationConfig(),
        image_width_px=PANORAMA_SIZE_PX[0],
        image_height_px=BAND_HEIGHT_PX,
        camera_height_m=PANORAMA_ABOVE_M,
        camera_pitch_deg=0.0,
        max_sight_m=PANORAMA_SIGHT_M,
        pixel_noise_px=float(np.radians(DIRECTION_SIGMA_DEG) * PX_PER_RAD),
        pixel_noise_share=0.0,
        position_white_m=OWN_SHARE * position_sigma_m,
        position_drift_m=DRIFT_SHARE * position_sigma_m,
        rotation_white_deg=0.0,
        rotation_drift_deg=0.0,
        relief_m=0.0,
        lookalikes_per_light=0.0,
        write_timestamps=0,
        shuffle_names=1,
    )


def panoramas(year: int, position_sigma_m: float, second_head_share: float = 0.0) -> Layout:
    """Return panoramas of Dublin."""
    config = panorama_config(position_sigma_m)
    return Layout(lambda root, seed: dublin(root / "dublin_tl", config, year, second_head_share, seed=seed), True)


LAYOUTS = {
    "sf 0.5 tours": drives(0.5),
    "sf 2 tours": drives(2.0),
    "dublin 2015, 0.15 m": panoramas(2015, 0.15),
    "dublin 2015, 0.45 m": panoramas(2015, 0.45),
    "dublin 2017, 0.15 m": panoramas(2017, 0.15),
    "dublin 2017, 0.45 m": panoramas(2017, 0.45),
    "dublin 2017, 0.15 m, two heads": panoramas(2017, 0.15, SECOND_HEAD_SHARE),
}


def case_of(layout: Layout, data_root: Path, seed: int) -> Case:
    """Record a layout and compute its bounds."""
    recording = layout.record(data_root, seed)
    truth, shown = recording.dataset.truth, recording.dataset.truth_detections
    assert truth is not None
    assert shown is not None
    views = views_in_panoramas(recording) if layout.is_panoramic else true_views(recording)
    detections = np.bincount(rows_of(shown.object_id, truth.object_id), minlength=len(truth))
    return Case(recording, cramer_rao_covariances(views, recording.config, len(truth)), detections)


def main() -> int:
    """Run the benchmark and print a line for each layout; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_root", type=Path, metavar="DATA_ROOT")
    parser.add_argument("--seeds", nargs="+", default=["0..4"], metavar="N|FIRST..LAST")
    parser.add_argument("--only", nargs="+", choices=LAYOUTS, default=list(LAYOUTS), metavar="NAME")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE", help="of the map")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    results: list[dict[str, Any]] = []
    try:
        config = valuemap.MapConfig().with_settings(options.settings)
        for name in options.only:
            cases = [case_of(LAYOUTS[name], options.data_root, seed) for seed in seeds_from(options.seeds)]
            maps = [timed_map(case.recording.dataset, config) for case in cases]
            told, of_any_bound = (
                add_up([compare(case, *of, max_bound_m=limit_m) for case, of in zip(cases, maps, strict=True)])
                for limit_m in (MAX_BOUND_M, np.inf)
            )
            figures = {**told, "of_any_bound": {key: of_any_bound[key] for key in ("objects", "recall")}}
            images = sum(len(case.recording.dataset.images) for case in cases)
            boxes = sum(len(case.recording.dataset.detections) for case in cases)
            results.append({"name": name, "images": images, "detections": boxes, **figures})
            print(f"{line(name, figures)}  of any bound {of_any_bound['recall']:.4f}", flush=True)
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    write_record(options.json, results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
