"""What each part of the robust method is worth: the whole method, and without each of its parts.

On the city of `robust.py`, driven six times through every street in each direction, five seeds; and with `--kitti` on
the real traffic signs of `kitti_signs.py` as well.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import kitti_signs
import valuemap
from cities import add_up, city, line, measure, prepare
from machine import write_record
from valuemap import robust
from valuemap.robust import Noise

_GUESS = Noise()
WITHOUT: dict[str, list[str]] = {
    "nothing": [],
    "pose-aware gate": ["position_sigma_m=0", "rotation_sigma_deg=0"],
    # The estimation's own start.
    "self-calibration": [
        f"detection_sigma_px={_GUESS.detection_px}",
        f"position_sigma_m={math.hypot(_GUESS.position_m, _GUESS.position_drift_m)}",
        f"rotation_sigma_deg={math.degrees(math.hypot(_GUESS.rotation_rad, _GUESS.rotation_drift_rad))}",
    ],
    "existence": ["min_existence=0"],
    **{part: [] for part in robust.PARTS},
}
"""What is left out, and the settings that leave it out; parts that none does by their names in `valuemap.robust`."""
KITTI_FIGURES = ("signs_found_2m", "signs_found_1m", "precision", "track_recall")


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--without", nargs="+", choices=list(WITHOUT), default=list(WITHOUT), metavar="PART")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--passes", type=int, default=6)
    parser.add_argument("--kitti", type=Path, metavar="DATA_DIR", help="the folder that kitti_signs.py takes")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    configs = {part: valuemap.MapConfig().with_settings(WITHOUT[part]) for part in options.without}
    cases = [prepare(city(options.passes), seed) for seed in options.seeds]
    results: list[dict[str, Any]] = []
    for part, config in configs.items():
        robust.LEFT_OUT = {part} & set(robust.PARTS)
        figures = add_up([measure(case, config) for case in cases])
        results.append({"without": part, "settings": WITHOUT[part], **figures})
        print(line(f"without {part}", figures), flush=True)
        if options.kitti:
            sequences = kitti_signs.SEQUENCES
            scores = {name: kitti_signs.run_sequence(options.kitti, name, config, None) for name in sequences}
            kitti = kitti_signs.add_up(scores).to_json()
            results[-1]["kitti_signs"] = kitti
            print(" " * 30, "  ".join(f"{name} {kitti[name]}" for name in KITTI_FIGURES), flush=True)
    write_record(options.json, results)


if __name__ == "__main__":
    main()
