"""The demo: a simulated city through the whole method, with everything left on disk to look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from valuemap.dataset import Dataset, write_dataset
from valuemap.evaluate import Evaluation, evaluate_map
from valuemap.map_folder import Map, write_map
from valuemap.pipeline import build_map
from valuemap.progress import Progress, silent
from valuemap.report import draw_map
from valuemap.simulate import PRESETS, simulate


@dataclass(frozen=True, eq=False)
class Demo:
    """What the demo made, and where it is."""

    dataset: Dataset
    result: Map
    evaluation: Evaluation
    files: dict[str, Path]


def run_demo(out: Path, *, seed: int = 0, progress: Progress = silent) -> Demo:
    """Simulate the preset `small`, map it, evaluate and draw the map, and write all of it below `out`."""
    files = {"dataset": out / "dataset", "map": out / "map", "picture": out / "map.png"}
    dataset = simulate(PRESETS["small"], seed=seed, name="small", progress=progress)
    write_dataset(dataset, files["dataset"])
    result = build_map(dataset, progress=progress)
    write_map(result, files["map"])
    evaluation = evaluate_map(result, dataset)
    draw_map(result, dataset, evaluation.matches, files["picture"])
    return Demo(dataset, result, evaluation, files)
