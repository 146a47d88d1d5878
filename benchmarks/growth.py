"""How the time grows with the passes: the same simulated streets driven 5 and 50 times, in one run.

Time of `build_map` with the default method, by the clock and of the processor: ten times the passes should cost about
ten times as much.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import valuemap
from cities import city
from machine import write_record
from valuemap.simulate import simulate


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--passes", type=int, nargs=2, default=[5, 50])
    parser.add_argument("--streets", type=int, default=3, help="streets in each direction")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for passes in options.passes:
        size = {"streets_north_south": options.streets, "streets_east_west": options.streets}
        dataset = simulate(city(passes, **size), seed=0, name="growth")
        start, cpu_start = time.perf_counter(), time.process_time()
        result = valuemap.build_map(dataset)
        seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
        evaluation = valuemap.evaluate_map(result, dataset)
        rows.append(
            {
                "passes": passes,
                "images": len(dataset.images),
                "detections": len(dataset.detections),
                "seconds": round(seconds, 2),
                "cpu_seconds": round(cpu_seconds, 2),
                "recall": round(evaluation.recall, 4),
                "precision": round(evaluation.precision, 4),
                "position_rmse_m": round(evaluation.position_rmse_m, 4),
            }
        )
        print(rows[-1], flush=True)
    ratio, cpu_ratio = (round(rows[1][name] / rows[0][name], 2) for name in ("seconds", "cpu_seconds"))
    more = rows[1]["detections"] / rows[0]["detections"]
    print(f"{more:.1f} times the detections: {ratio} times the time, {cpu_ratio} times the processor time")
    write_record(options.json, rows, time_ratio=ratio, cpu_ratio=cpu_ratio)


if __name__ == "__main__":
    main()
