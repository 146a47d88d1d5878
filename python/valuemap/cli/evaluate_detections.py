"""`valuemap evaluate-detections`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from valuemap.cli.app import app
from valuemap.cli.options import AsJson
from valuemap.cli.show import out, show_notes

if TYPE_CHECKING:
    from valuemap.detect.accuracy import DetectionEvaluation


@app.command("evaluate-detections")
def evaluate_detections_command(
    place: Annotated[
        Path, typer.Argument(metavar="DATASET|FOLDER", help="A dataset, or a folder that valuemap detect looked at.")
    ],
    labels: Annotated[str, typer.Option(help="Labelled pictures: bosch:FILE, yolo:DIR or coco:FILE.")],
    min_score: Annotated[float, typer.Option(help="For recall and precision, count boxes of at least this.")] = 0.0,
    min_height: Annotated[float, typer.Option(min=0.0, help="Count only objects of at least this height, px.")] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Compare detections with labelled pictures: recall, precision and average precision, by box height."""
    from valuemap.detect.accuracy import evaluate_boxes
    from valuemap.detect.found import match_pictures, read_found
    from valuemap.detect.labels import read_labels

    found, known = read_found(place), read_labels(labels)
    evaluation = evaluate_boxes(match_pictures(found, known), known, min_score=min_score, min_height_px=min_height)
    if as_json:
        print(json.dumps(evaluation.to_json(), indent=2))
    else:
        _show_accuracies(evaluation)
    show_notes(evaluation.notes)


def _show_accuracies(evaluation: DetectionEvaluation) -> None:
    """Print one line for each range of heights and each IoU."""
    table = Table(box=None)
    for name in ("height px", "IoU", "labels", "recall", "precision", "AP", "mean IoU", "best F1", "at score"):
        table.add_column(name, justify="right", no_wrap=True)
    everything = f"{evaluation.min_height_px:g} up" if evaluation.min_height_px else "all"
    ranges = {everything: evaluation.overall}
    for (low, high), each in evaluation.by_height.items():
        ranges[f"{low:g} up" if math.isinf(high) else f"{low:g} to {high:g}"] = each
    for heights, each in ranges.items():
        for iou, accuracy in each.items():
            figures = (
                accuracy.recall,
                accuracy.precision,
                accuracy.average_precision,
                accuracy.mean_iou,
                accuracy.best_f1,
                accuracy.best_score,
            )
            shown = ("-" if math.isnan(figure) else f"{figure:.3f}" for figure in figures)
            table.add_row(heights, f"{iou:g}", str(accuracy.labels), *shown)
    out.print(table)
