"""`valuemap demo`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from valuemap import dataset as dataset_folder
from valuemap import map_folder
from valuemap.cli import show as shown
from valuemap.cli.app import app
from valuemap.cli.options import AsJson
from valuemap.cli.show import evaluation_rows, progress_bars, show
from valuemap.folders import check_place
from valuemap.summary import summarize_dataset, summarize_map

if TYPE_CHECKING:
    from valuemap.demo import Demo
    from valuemap.detect.accuracy import DetectionEvaluation


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option("--out", help="Folder for dataset, map and picture.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Another seed, another city.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Simulate a city, draw its pictures, detect lights in them, map these, evaluate and draw the map."""
    from valuemap.demo import run_demo

    check_place(out / "dataset", parts=dataset_folder.PARTS)
    check_place(out / "map", parts=map_folder.PARTS)
    with progress_bars() as progress:
        outcome = run_demo(out, seed=seed, progress=progress)
    if as_json:
        print(json.dumps(_record(outcome), indent=2))
        return
    show(summarize_dataset(outcome.dataset), title="A simulated city and what was detected in its pictures")
    show(_detection_rows(outcome.detection), title="The detections")
    show(summarize_map(outcome.result), title="The map of them")
    show(evaluation_rows(outcome.evaluation), title="The map against the simulated truth")
    for what, path in outcome.files.items():
        shown.out.print(f"{what:8} {path}", highlight=False, soft_wrap=True)


def _record(outcome: Demo) -> dict[str, Any]:
    return {
        "dataset": summarize_dataset(outcome.dataset),
        "detections": outcome.detection.to_json(),
        "map": summarize_map(outcome.result),
        "evaluation": outcome.evaluation.to_json(),
        "files": {what: str(path) for what, path in outcome.files.items()},
    }


def _detection_rows(evaluation: DetectionEvaluation) -> dict[str, Any]:
    """Return how good detections are in pictures, at the lowest IoU."""
    iou, accuracy = next(iter(evaluation.overall.items()))
    return {
        "pictures": evaluation.pictures,
        "true boxes": accuracy.labels,
        f"detection rate at IoU {iou:g}": accuracy.recall,
        f"precision at IoU {iou:g}": accuracy.precision,
        "mean IoU": accuracy.mean_iou,
    }
