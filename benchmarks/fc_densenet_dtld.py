"""A fully convolutional DenseNet trained on real pictures of ten German cities, beside YOLOX-Nano as trained on COCO.

    python benchmarks/fc_densenet_dtld.py DATA_DIR --work DIR [--resume] [--json FILE] [--set name=value ...]

DATA_DIR holds `dtld/` (DTLD pictures of 1024x440 with YOLO labels of traffic lights, in `train` and `val`) and
`yolox_nano.onnx`. The network is trained on `train` only; a part of that also chooses epoch and threshold. Both
are then measured on `val`: YOLOX-Nano at 1024x448, at the score that suits it best there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.progress import Progress as ProgressBar

from bundled_model import show_progress
from machine import describe_machine, keep_record
from valuemap.config import DetectConfig, TrainConfig
from valuemap.detect.accuracy import evaluate_boxes
from valuemap.detect.labels import LabelledPictures, read_labels
from valuemap.detect.run import detect_pictures
from valuemap.detect.train import train
from valuemap.errors import ValuemapError
from yolox_dtld import as_found

SETTINGS = TrainConfig(epochs=6, cutouts=2, validation_share=0.1, dropout=0.0)
HEIGHTS_PX = (0.0, 12.0, 24.0)
MIN_IOU = 0.3


def main() -> None:
    """Train, measure, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_dir", type=Path, metavar="DATA_DIR")
    parser.add_argument("--work", type=Path, required=True, help="folder for the training run")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--json", type=Path, help="write the figures and the machine there")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="name=value")
    options = parser.parse_args()
    config = SETTINGS.with_settings(options.settings)
    labels = read_labels(f"yolo:{options.data_dir / 'dtld'}")
    # Without a split, `train` takes a part of them for validation and never sees `val`.
    to_train = tuple(replace(picture, split="") for picture in labels.pictures if picture.split == "train")
    to_measure = LabelledPictures(labels.source, tuple(p for p in labels.pictures if p.split == "val"), labels.skipped)
    with ProgressBar(disable=not sys.stderr.isatty()) as bar:
        result = train(
            [LabelledPictures(labels.source, to_train, ())],
            options.work,
            config,
            resume=options.resume,
            one_class="traffic_light",
            progress=show_progress(bar),
        )
    run = json.loads((options.work / "train.json").read_text(encoding="utf-8"))
    yolox = DetectConfig(classes="traffic light", size="1024x448", min_score=0.01)
    results = {
        "fc_densenet": {
            "training_seconds": run["seconds"],
            "size_bytes": result.model.stat().st_size,
            "threshold": result.threshold,
            **measure(result.model, DetectConfig(), to_measure),
        },
        "yolox_nano": measure(options.data_dir / "yolox_nano.onnx", yolox, to_measure),
    }
    print(json.dumps(results, indent=2))
    if options.json is not None:
        record = {
            "benchmark": "fc_densenet_dtld",
            "data": "DTLD, 1024x440, labels of traffic lights: trained on split train, measured on split val",
            "command": "python benchmarks/fc_densenet_dtld.py DATA_DIR --work DIR",
            **describe_machine(),
            "settings": dataclasses.asdict(config),
            "results": results,
        }
        keep_record(options.json, record)


def measure(model: Path, config: DetectConfig, labels: LabelledPictures) -> dict[str, Any]:
    """Return recall and precision at IoU 0.3 by least height; a detector's are those of its best score."""
    found = {entry.path: as_found(entry) for entry in detect_pictures([p.path for p in labels.pictures], model, config)}
    figures = {}
    for low_px in HEIGHTS_PX:
        score = 0.0
        if config.min_score is not None:
            score = evaluate_boxes(found, labels, min_height_px=low_px).overall[MIN_IOU].best_score
        best = evaluate_boxes(found, labels, min_score=score, min_height_px=low_px).overall[MIN_IOU]
        figures[f"from_{low_px:g}_px"] = {
            "labels": best.labels,
            "recall": round(best.recall, 3),
            "precision": round(best.precision, 3),
            "f1": round(2.0 * best.recall * best.precision / max(best.recall + best.precision, 1e-12), 3),
            "mean_iou": round(best.mean_iou, 3),
        }
    return figures


if __name__ == "__main__":
    try:
        main()
    except ValuemapError as error:
        sys.exit(f"error: {error}\nhint: {error.hint}")
