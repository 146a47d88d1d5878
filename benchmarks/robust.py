"""How good a method is on simulated cities of several seeds and densities.

A city of four by four signalised streets is driven 2, 6 and 20 times through every street in both directions, without
lookalikes. Everything is simulated. Counted over all seeds of a density: recall of the recoverable objects with at
least three detections; false positives and duplicates over labels; the position rmse of these objects over the
Cramer-Rao bound for the same views and noise (`bound.py`); the mean squared normalised error of the labels' own
covariances (3 if they are honest); of how many labels of an existence are real; and how many things that one pass
met and that are no light (temporary objects, reflections in the own car) got a label.

The paper's method is measured at its best alpha among those below. Its time is cubic in the passes, so the best (F1) is
chosen on the first two seeds, and then measured on all.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import valuemap
from cities import Case, Outcome, add_up, city, line, measure, prepare, seeds_from
from machine import write_record

ALPHAS = (1.0, 1.5, 1.75, 2.0, 2.5)
ALPHA_SEEDS = 2


def main() -> None:
    """Run the benchmark and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", choices=["robust", "paper"], default="robust")
    parser.add_argument("--seeds", nargs="+", default=["0..9"], metavar="N|FIRST..LAST")
    parser.add_argument("--passes", type=int, nargs="+", default=[2, 6, 20])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    results: list[dict[str, Any]] = []
    for passes in options.passes:
        cases = [prepare(city(passes), seed) for seed in seeds_from(options.seeds)]
        name, told = f"{passes} passes", {}
        if options.method == "paper":
            alpha, f1_of_alpha, outcomes = _at_best_alpha(cases)
            name, told = f"{name}, paper, alpha {alpha}", {"f1_of_alpha": f1_of_alpha}
        else:
            outcomes = [measure(case, valuemap.MapConfig()) for case in cases]
        figures = add_up(outcomes)
        results.append({"name": name, "passes": passes, **told, **figures})
        print(line(name, figures), flush=True)
    write_record(options.json, results)


def _at_best_alpha(cases: list[Case]) -> tuple[float, dict[float, float], list[Outcome]]:
    """Return the alpha that is best on the first cities, F1 there at each alpha, and all outcomes at the best."""
    tried = {alpha: [measure(case, _paper(alpha)) for case in cases[:ALPHA_SEEDS]] for alpha in ALPHAS}
    f1_of_alpha = {alpha: _f1(add_up(outcomes)) for alpha, outcomes in tried.items()}
    best = max(ALPHAS, key=f1_of_alpha.__getitem__)
    return best, f1_of_alpha, tried[best] + [measure(case, _paper(best)) for case in cases[ALPHA_SEEDS:]]


def _paper(alpha: float) -> valuemap.MapConfig:
    return valuemap.MapConfig(method="paper").with_settings([f"min_vote_ratio={alpha}"])


def _f1(figures: dict[str, Any]) -> float:
    recall, precision = figures["recall"], figures["precision"]
    return round(2.0 * recall * precision / (recall + precision), 4) if recall * precision else 0.0


if __name__ == "__main__":
    main()
