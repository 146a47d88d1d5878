"""How many things that only one pass met, and that are no light, get a label.

The city of `robust.py` with thirty times its rate of temporary objects (such as a van's lamp, which stand in the world
while a pass goes by) and five times its rate of reflections (which stand still in the picture). Counted are the things
with at least three detections; one has a label if more than half of the label's voters show it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import valuemap
from cities import PASSING_KINDS, add_up, city, line, measure, prepare, seeds_from
from machine import write_record

RATES = {"temporary_per_1000_images": 3.0, "reflections_per_1000_images": 3.0}


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", default=["0..4"], metavar="N|FIRST..LAST")
    parser.add_argument("--passes", type=int, nargs="+", default=[2, 6])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    results: list[dict[str, Any]] = []
    for passes in options.passes:
        cases = [prepare(city(passes, **RATES), seed) for seed in seeds_from(options.seeds)]
        figures = add_up([measure(case, valuemap.MapConfig()) for case in cases])
        results.append({"passes": passes, **figures})
        print(line(f"{passes} passes", figures))
        for kind in PASSING_KINDS:
            print(f"  {kind}: {figures[kind]['with_label']} of {figures[kind]['with_3_detections']} have a label")
    write_record(options.json, results)


if __name__ == "__main__":
    main()
