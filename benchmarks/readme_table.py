"""Write the table of accuracy and speed of README.md and docs/index.md from the figures in results/.

    python benchmarks/readme_table.py [--check]

A row is there when its result is: run the benchmarks with --json benchmarks/results/NAME.json first. What others
reach stands in `OTHERS`, each with where it was published. With --check nothing is written; the exit code says
whether the pages hold what the results say.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/index.md")
RESULTS = ROOT / "benchmarks" / "results"
_BLOCK = re.compile(r"(<!-- figures: [^\n]*-->\n)(.*?)(<!-- end of figures -->)", re.DOTALL)

OTHERS = {
    # Dabisias et al., "VALUE", ICRA 2018, Table III: true positives, false positives, false negatives, duplicates.
    "paper": "recall 0.93 and 0.90, false per label 2.3 and 4.9%, duplicates 8.0 and 3.3% (paper, its own cities)",
    # Ibid., section V: 19 minutes for the clusters of New York City and 3.1 for the triangulation.
    "paper seconds": "22.1 min (paper, its own machines)",
    # Krylov, Kenny, Dahyot, "Automatic Discovery and Geotagging of Objects from Street View Imagery", 2018.
    "london": "F1 0.70 (Krylov et al. 2018)",
    # ProjectSidewalk, sidewalk-auto-labeler: its published sites, scored by `bend_ramps.py --peer`.
    "bend": "0.907 covered, 0.246 unmatched (sidewalk-auto-labeler)",
    # AutoTS, 2025: with the association given, and a network for depth.
    "kitti_ts": "0.31, 0.54 (AutoTS 2025, test part, association given)",
}


def main() -> int:
    """Rewrite or check the block of each page."""
    parser = argparse.ArgumentParser(description="write the table of figures from benchmarks/results")
    parser.add_argument("--check", action="store_true", help="write nothing; fail where a page is not up to date")
    check = parser.parse_args().check
    table = figures_table()
    stale = []
    for name in PAGES:
        page = ROOT / name
        old = page.read_text(encoding="utf-8")
        new = _BLOCK.sub(lambda block: f"{block[1]}{table}{block[3]}", old)
        if new != old:
            stale.append(name)
            if not check:
                page.write_text(new, encoding="utf-8")
    if check and stale:
        print(f"not what the results say: {', '.join(stale)}: python benchmarks/readme_table.py", file=sys.stderr)
        return 1
    return 0


def figures_table() -> str:
    """Return the table as Markdown, a row for each result that there is."""
    head = "| data | what | default method | `--method paper` | others |\n|---|---|---|---|---|\n"
    return head + "".join(f"| {' | '.join(row)} |\n" for row in _rows())


def _rows() -> Iterator[tuple[str, str, str, str, str]]:
    ours, theirs = _results("robust"), _results("robust_paper")
    if ours:
        by_passes = {each["passes"]: each for each in theirs or []}
        for each in ours:
            other = by_passes.get(each["passes"])
            said = OTHERS["paper"] if each is ours[0] else "as above"
            yield (
                f"simulated cities, {each['name']}",
                "recall, false per label, duplicates",
                _city(each),
                _city(other) if other else "-",
                said,
            )
    fast, faster = _results("speed_robust"), _results("speed_paper")
    for row, each in enumerate(fast or []):
        other = faster[row] if faster else None
        name = each["dataset"].partition(",")[0]
        images = each["counts"]["images"]
        yield (
            f"simulated `{name}`, {images:,} images",
            "whole `map` command",
            _speed(each),
            _speed(other) if other else "-",
            OTHERS["paper seconds"] if name == "nyc" else "-",
        )
    yield from _field_rows()


def _field_rows() -> Iterator[tuple[str, str, str, str, str]]:
    """Yield the rows of real data."""
    for name, part, data, what, keys, other in (
        (
            "kitti_signs", "total", "KITTI, 27 surveyed signs", "signs found within 2 m and 1 m; precision",
            ("signs_found_2m", "signs_found_1m", "precision"), "-",
        ),
        (
            "london_tl", "london", "London, lights in panoramas", "F1 within 6 m",
            ("f1_6m",), OTHERS["london"],
        ),
        (
            "bend_ramps", "bend", "Bend, curb ramps in panoramas", "covered, unmatched",
            ("covered", "unmatched"), OTHERS["bend"],
        ),
        (
            "kitti_ts", "kitti_ts", "KITTI raw, 216 signs with classes", "found within 1 m and 2 m",
            ("recall_1m", "recall_2m"), OTHERS["kitti_ts"],
        ),
    ):  # fmt: skip
        ours = _results(f"{name}_robust") or _results(name)
        if ours:
            paper = _results(f"{name}_paper")
            yield data, what, _figures(ours[part], keys), _figures(paper[part], keys) if paper else "-", other


def _results(name: str) -> Any:
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8"))["results"] if path.is_file() else None


def _figures(figures: dict[str, Any], keys: tuple[str, ...]) -> str:
    return ", ".join(f"{figures[key]:.3g}" if isinstance(figures[key], float) else str(figures[key]) for key in keys)


def _city(figures: dict[str, Any]) -> str:
    false, twice = figures["false_positives_per_label"], figures["duplicates_per_label"]
    return f"{figures['recall']:.3f}, {100 * false:.1f}%, {100 * twice:.1f}%"


def _speed(figures: dict[str, Any]) -> str:
    return f"{figures['seconds_median']:.1f}&nbsp;s, {figures['peak_memory_mb'] / 1024:.2f}&nbsp;GB"


if __name__ == "__main__":
    sys.exit(main())
