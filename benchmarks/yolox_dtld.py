"""YOLOX-Nano, as trained on COCO, on real pictures of ten German cities: how many lights it finds.

    python benchmarks/yolox_dtld.py DATA_DIR [--size 1024x448] [--split val] [--json FILE]

DATA_DIR holds `yolox_nano.onnx` (static 416x416, its size set free) and `dtld/` (DTLD pictures of 1024x440 with
YOLO labels of traffic lights), and `bosch/dataset_sample.jpg`, whose two boxes are known.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from machine import describe_machine, keep_record
from valuemap.config import DetectConfig
from valuemap.detect.accuracy import FoundBoxes, evaluate_boxes
from valuemap.detect.labels import LabelledPictures, read_labels
from valuemap.detect.run import PictureBoxes, detect_pictures
from valuemap.errors import ValuemapError

MIN_SCORE = 0.01
"""For the average precision the whole curve is needed."""


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_dir", type=Path, metavar="DATA_DIR")
    parser.add_argument("--size", default="1024x448")
    parser.add_argument("--split", default="val")
    parser.add_argument("--json", type=Path, help="write the figures and the machine there")
    options = parser.parse_args()
    try:
        results = {"sample": sample_boxes(options.data_dir), **run_split(options.data_dir, options.split, options.size)}
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    record = {
        "benchmark": "yolox_dtld",
        "data": f"DTLD, split {options.split}, 1024x440, labels of traffic lights; YOLOX-Nano trained on COCO",
        "command": f"python benchmarks/yolox_dtld.py DATA_DIR --size {options.size} --split {options.split}",
        **describe_machine(),
        "results": results,
    }
    print(json.dumps(results, indent=2))
    keep_record(options.json, record)
    return 0


def sample_boxes(data_dir: Path) -> list[dict[str, Any]]:
    """Return the boxes of the picture whose boxes are known, at the model's own size."""
    found = _detect(data_dir, [data_dir / "bosch" / "dataset_sample.jpg"], "model", 0.3)[0]
    return [
        {"edges_px": edges, "score": score}
        for edges, score in zip(
            found.boxes.edges_px.round(1).tolist(), found.boxes.score.round(3).tolist(), strict=True
        )
    ]


def run_split(data_dir: Path, split: str, size: str) -> dict[str, Any]:
    """Return accuracy over lights of all heights and of at least 24 px."""
    labels = read_labels(f"yolo:{data_dir / 'dtld'}")
    pictures = tuple(picture for picture in labels.pictures if picture.split == split)
    found = _detect(data_dir, [picture.path for picture in pictures], size, MIN_SCORE)
    by_path = {entry.path: as_found(entry) for entry in found}
    known = LabelledPictures(labels.source, pictures, labels.skipped)
    return {
        "pictures": len(pictures),
        "unusable_pictures": sum(entry.problem is not None for entry in found),
        "all_heights": _rounded(evaluate_boxes(by_path, known).to_json()),
        "at_least_24_px": _rounded(evaluate_boxes(by_path, known, min_height_px=24.0).to_json()),
    }


def as_found(entry: PictureBoxes) -> FoundBoxes:
    """Return the boxes of a picture as the evaluation takes them."""
    place_px = np.concatenate([entry.boxes.center_px, entry.boxes.size_px], axis=1)
    return FoundBoxes(place_px, entry.boxes.score, entry.class_names)


def _detect(data_dir: Path, paths: list[Path], size: str, min_score: float) -> list[PictureBoxes]:
    config = DetectConfig(classes="traffic light", size=size, min_score=min_score)
    return detect_pictures(paths, data_dir / "yolox_nano.onnx", config)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(entry) for name, entry in value.items() if name != "notes"}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return round(value, 4) if isinstance(value, float) else value


if __name__ == "__main__":
    sys.exit(main())
