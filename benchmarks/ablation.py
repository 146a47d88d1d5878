"""What each part of the robust method is worth: the whole method, and without each of its parts.

On the city of `robust.py`, driven twice through every street in each direction, five seeds: with more passes hardly
anything is missed. With `--field` on the real data of `field.py` as well.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import field
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
    **{part: [] for part in robust.PARTS},
}
"""What is left out, and the settings that leave it out; parts that none does by their names in `valuemap.robust`."""


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--without", nargs="+", choices=list(WITHOUT), default=list(WITHOUT), metavar="PART")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--passes", type=int, default=2)
    parser.add_argument("--field", type=Path, metavar="DATA_ROOT", help="the folder that field.py takes")
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
        if options.field:
            results[-1]["field"] = of_field(options.field, config)
    data = "simulated; real under field" if options.field else "simulated"
    write_record(options.json, results, data=data)


def of_field(data_root: Path, config: valuemap.MapConfig) -> dict[str, dict[str, float | None]]:
    """Return the figures that `field.py` shows of the data that is there."""
    totals = {name: list(parts.values())[-1] for name, parts in field.run(data_root, config).items()}
    return {name: {figure: total[figure] for figure, *_ in field.SHOWN[name]} for name, total in totals.items()}


if __name__ == "__main__":
    main()
