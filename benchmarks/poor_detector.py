"""What a poor detector costs: half of the lights in view are missed, and every other image has a false box.

The city of `robust.py`, driven five times through every street in each direction: ten times over each place. Half of
the lights are in view of eight passes or fewer, since each faces one approach. Recall is of recoverable objects with at
least eight detections; the rest is as in `robust.py`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import valuemap
from cities import add_up, city, line, measure, prepare, seeds_from
from machine import write_record

DETECTOR = {"recall_mean": 0.5, "clutter_per_image": 0.5}
MIN_DETECTIONS = 8


def main() -> None:
    """Run the benchmark and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", default=["0..4"], metavar="N|FIRST..LAST")
    parser.add_argument("--passes", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    config = city(options.passes, **DETECTOR)
    figures = add_up(
        [
            measure(prepare(config, seed), valuemap.MapConfig(), min_detections=MIN_DETECTIONS)
            for seed in seeds_from(options.seeds)
        ]
    )
    print(line(f"poor detector, {options.passes} passes", figures))
    write_record(options.json, figures)


if __name__ == "__main__":
    main()
