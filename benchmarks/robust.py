"""How good a method is on simulated cities of several seeds and densities.

A city of four by four signalised streets is driven 2, 6 and 20 times through every street in both directions, without
lookalikes. Everything is simulated. Counted over all seeds of a density: recall of the recoverable objects with at
least three detections; false positives and duplicates over labels; the position rmse of these objects over the
Cramer-Rao bound for the same views and noise (`bound.py`); the mean squared normalised error of the labels' own
covariances (3 if they are honest); of how many labels of an existence are real; and how many things that one pass
met and that are no light (temporary objects, reflections in the own car) got a label.

The paper's method is measured at its best alpha (F1) among those below. Its time is cubic in the passes, so alpha is
chosen on a smaller city of another seed.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import valuemap
from cities import add_up, city, line, measure, prepare
from machine import describe_machine

ALPHAS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
ALPHA_CITY = {"streets_north_south": 3, "streets_east_west": 2}


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", choices=["robust", "paper"], default="robust")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--passes", type=int, nargs="+", default=[2, 6, 20])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    results: list[dict[str, Any]] = []
    for passes in options.passes:
        name, config, told = f"{passes} passes", valuemap.MapConfig(), {}
        if options.method == "paper":
            alpha_seed = max(options.seeds) + 1
            f1_of_alpha = {alpha: _f1(passes, alpha, alpha_seed) for alpha in ALPHAS}
            alpha = max(f1_of_alpha, key=f1_of_alpha.__getitem__)
            name, config = f"{name}, paper, alpha {alpha}", _paper(alpha)
            told = {"alpha": alpha, "f1_of_alpha": f1_of_alpha, "seed_of_alpha": alpha_seed}
        figures = add_up([measure(prepare(city(passes), seed), config) for seed in options.seeds])
        results.append({"name": name, "passes": passes, **told, **figures})
        print(line(name, figures), flush=True)
    if options.json:
        command = ("python benchmarks/robust.py " + " ".join(sys.argv[1:])).strip()
        record = {"command": command, "data": "simulated", **describe_machine(), "results": results}
        options.json.write_text(json.dumps(record, indent=2) + "\n")


def _paper(alpha: float) -> valuemap.MapConfig:
    return valuemap.MapConfig(method="paper").with_settings([f"min_vote_ratio={alpha}"])


def _f1(passes: int, alpha: float, seed: int) -> float:
    """Return the harmonic mean of recall and precision on the city on which alpha is chosen."""
    figures = add_up([measure(prepare(city(passes, **ALPHA_CITY), seed), _paper(alpha))])
    recall, precision = figures["recall"], figures["precision"]
    return round(2.0 * recall * precision / (recall + precision), 4) if recall + precision > 0.0 else 0.0


if __name__ == "__main__":
    main()
