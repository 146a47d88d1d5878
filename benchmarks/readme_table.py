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
    # What others reach on real data; before a colon the row of field.md that holds their figures.
    "london": "krylov:(Krylov et al. 2018, written anew from the paper; 0.70 as published, with a network for depth)",
    "bend": "published sites:(sidewalk-auto-labeler, its published sites)",
    # AutoTS, 2025: with the association given, and a network for depth.
    "kitti_ts": "0.31, 0.54 (AutoTS 2025, test part, association given)",
    "av2_static": "colmap, given:(COLMAP, association given)",
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
    """Yield the rows of real data: ours from `field.py --json`, all others from the tables of its `--peers`."""
    ours, tables = _results("field"), _peers()
    signs = _results("kitti_signs_paper")
    for name, part, table, data, what, keys, other in (
        (
            "kitti_signs", "total", "", "KITTI, 27 surveyed signs", "signs found within 2 m and 1 m; precision",
            ("signs_found_2m", "signs_found_1m", "precision"), "-",
        ),
        (
            "london_tl", "london", "london_tl bearings", "London, 50 lights in panoramas, by bearings alone",
            "F1 within 6 m", ("f1_6m",), OTHERS["london"],
        ),
        (
            "bend_ramps", "bend", "bend_ramps", "Bend, 5,771 curb ramps in panoramas",
            "covered, unmatched, median distance (m)", ("covered", "unmatched", "median_distance_m"), OTHERS["bend"],
        ),
        (
            "kitti_ts", "kitti_ts", "kitti_ts", "KITTI raw, 216 signs with classes", "found within 1 m and 2 m",
            ("recall_1m", "recall_2m"), OTHERS["kitti_ts"],
        ),
        (
            "av2_static", "total", "av2_static", "Argoverse 2, 18 bollards, cones and a sign", "recall, precision",
            ("recall", "precision"), OTHERS["av2_static"],
        ),
    ):  # fmt: skip
        if not ours:
            return
        paper = tables.get(table, {}).get("paper") or (signs and signs[part] if name == "kitti_signs" else None)
        peer, _, said = other.partition(":")
        measured = tables.get(table, {}).get(peer)
        yield (
            data,
            what,
            _figures(ours[name][part], keys),
            _figures(paper, keys) if paper else "-",
            f"{_figures(measured, keys)} {said}" if measured else other,
        )


def _peers() -> dict[str, dict[str, dict[str, float]]]:
    """Return what all methods reached on the same real data: by table, method and column of field.md."""
    path = RESULTS / "field.md"
    tables: dict[str, dict[str, dict[str, float]]] = {}
    for section in path.read_text(encoding="utf-8").split("\n### ")[1:] if path.is_file() else []:
        title, *lines = section.splitlines()
        head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line]
        tables[title] = {row[0]: dict(zip(head[1:], map(float, row[1:]), strict=True)) for row in rows}
    return tables


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
