"""Recall, precision and average precision of boxes, by hand and against a literal search."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from small_dataset import small_dataset
from test_cli import COMMAND, complains, heard_by_default, works
from test_detect import painted, save
from tiny_models import red_finder
from valuemap import config, read_dataset, write_dataset
from valuemap.detect.accuracy import FoundBoxes, evaluate_boxes
from valuemap.detect.found import match_pictures
from valuemap.detect.labels import LabelledPicture, LabelledPictures
from valuemap.errors import InputError, SettingError

HERE = Path("a.png")


def labelled(boxes: list[list[float]], *, path: Path = HERE, name: str = "light", ignored: Any = ()) -> LabelledPicture:
    table = np.array(boxes, dtype=np.float64).reshape(-1, 4)
    return LabelledPicture(path, table, (name,) * len(table), np.array(ignored, np.float64).reshape(-1, 4))


def labels_of(*pictures: LabelledPicture) -> LabelledPictures:
    return LabelledPictures("labels", pictures, ())


def found(boxes: list[list[float]], score: list[float], name: str = "light") -> FoundBoxes:
    return FoundBoxes(np.array(boxes, dtype=np.float64).reshape(-1, 4), np.array(score), [name] * len(boxes))


def test_figures_worked_out_by_hand() -> None:
    labels = labels_of(labelled([[50, 50, 20, 40], [150, 50, 20, 40], [250, 50, 20, 40]]))
    boxes = found(
        [[50, 50, 20, 40], [50, 50, 20, 38], [400, 50, 20, 40], [155, 50, 20, 40]],
        [0.9, 0.8, 0.7, 0.6],  # Right, a second one, of nothing, right with an IoU of 15 / 25.
    )
    evaluation = evaluate_boxes({HERE: boxes}, labels)
    loose = evaluation.overall[0.3]
    assert (loose.labels, loose.right, loose.false) == (3, 2, 2)
    assert (loose.recall, loose.precision) == (2 / 3, 2 / 4)
    assert loose.average_precision == pytest.approx(1 / 3 * 1.0 + 1 / 3 * 0.5)
    assert loose.mean_iou == pytest.approx((1.0 + 0.6) / 2)
    assert loose.best_f1 == pytest.approx(2 * 2 / (4 + 3))
    assert loose.best_score == 0.6
    strict = evaluate_boxes({HERE: boxes}, labels, min_score=0.85).overall[0.5]
    assert (strict.right, strict.false, strict.precision) == (1, 0, 1.0)
    assert strict.average_precision == pytest.approx(0.5)


def test_boxes_take_the_label_they_overlap_most_and_only_one() -> None:
    labels = labels_of(labelled([[50, 50, 20, 40], [56, 50, 20, 40]]))
    boxes = found([[55, 50, 20, 40], [54, 50, 20, 40]], [0.9, 0.8])
    accuracy = evaluate_boxes({HERE: boxes}, labels).overall[0.5]
    assert (accuracy.right, accuracy.false) == (2, 0)
    assert accuracy.mean_iou == pytest.approx((19 / 21 + 16 / 24) / 2)


def test_by_height_others_are_neither_found_nor_missed() -> None:
    labels = labels_of(labelled([[50, 50, 10, 30], [150, 50, 10, 10]]))
    boxes = found([[50, 50, 10, 30], [150, 50, 10, 10], [250, 50, 10, 10], [350, 50, 10, 30]], [0.9, 0.8, 0.7, 0.6])
    evaluation = evaluate_boxes({HERE: boxes}, labels)
    large, small = evaluation.by_height[(24.0, 48.0)][0.3], evaluation.by_height[(0.0, 12.0)][0.3]
    assert (large.labels, large.right, large.false) == (1, 1, 1)
    assert (small.labels, small.right, small.false) == (1, 1, 1)
    only = evaluate_boxes({HERE: boxes}, labels, min_height_px=24.0)
    assert only.overall[0.3] == large
    assert list(only.by_height) == [(24.0, 48.0), (48.0, math.inf)]
    empty = evaluation.by_height[(48.0, math.inf)][0.3].to_json()
    assert (empty["labels"], empty["recall"], empty["average_precision"]) == (0, None, None)


def test_ignored_places_count_for_nothing() -> None:
    labels = labels_of(labelled([[50, 50, 10, 30]], ignored=[[150, 50, 40, 40]]))
    boxes = found([[50, 50, 10, 30], [145, 50, 30, 40], [155, 50, 30, 40]], [0.9, 0.8, 0.7])
    accuracy = evaluate_boxes({HERE: boxes}, labels).overall[0.5]
    assert (accuracy.labels, accuracy.right, accuracy.false) == (1, 1, 0)


def test_impossible_limits_are_refused() -> None:
    for limits, message in (({"min_score": math.nan}, "--min-score"), ({"min_height_px": -3.0}, "--min-height")):
        with pytest.raises(SettingError, match=message):
            evaluate_boxes({}, LabelledPictures("test", (), ()), **limits)


def test_classes_are_compared_where_they_are_the_same_on_both_sides() -> None:
    two = labels_of(
        labelled([[50, 50, 20, 40]], name="light"), labelled([[50, 50, 20, 40]], path=Path("b.png"), name="sign")
    )
    boxes = found([[50, 50, 20, 40]], [0.9])
    evaluation = evaluate_boxes({HERE: boxes, Path("b.png"): boxes}, two)
    assert (evaluation.overall[0.5].right, evaluation.overall[0.5].false, evaluation.notes) == (1, 1, ())
    other = found([[50, 50, 20, 40]], [0.9], "traffic light")
    evaluation = evaluate_boxes({HERE: other, Path("b.png"): other}, two)
    assert evaluation.overall[0.5].right == 2
    assert "classes are not compared" in evaluation.notes[0]


def test_pictures_without_boxes_count_and_others_do_not() -> None:
    labels = labels_of(labelled([[50, 50, 20, 40]]), labelled([[9, 9, 8, 8]], path=Path("b.png")))
    evaluation = evaluate_boxes({HERE: found([], []), Path("c.png"): found([[5, 5, 4, 4]], [0.9])}, labels)
    assert (evaluation.pictures, evaluation.unlabelled_pictures) == (1, 1)
    assert (evaluation.overall[0.3].recall, evaluation.overall[0.3].false) == (0.0, 0)
    assert "1 labelled pictures were not looked at" in evaluation.notes[0]


def literal_average_precision(pictures: list[tuple[FoundBoxes, LabelledPicture]], min_iou: float) -> float:
    """Return the area below the precision for every threshold of the score, matched anew for each picture."""

    def iou(a: Any, b: Any) -> float:
        sides = [
            min(a[i] + a[i + 2] / 2, b[i] + b[i + 2] / 2) - max(a[i] - a[i + 2] / 2, b[i] - b[i + 2] / 2)
            for i in (0, 1)
        ]
        common = max(sides[0], 0.0) * max(sides[1], 0.0)
        return float(common / (a[2] * a[3] + b[2] * b[3] - common))

    total = sum(len(picture.boxes_px) for _, picture in pictures)
    points = []
    for threshold in sorted({score for boxes, _ in pictures for score in boxes.score.tolist()}, reverse=True):
        right = taken_in_all = 0
        for boxes, picture in pictures:
            free = list(range(len(picture.boxes_px)))
            for row in sorted(range(len(boxes.score)), key=lambda i: (-boxes.score[i], boxes.boxes_px[i, 0])):
                if boxes.score[row] < threshold:
                    continue
                taken_in_all += 1
                best = max(free, key=lambda j: iou(boxes.boxes_px[row], picture.boxes_px[j]), default=None)
                if best is not None and iou(boxes.boxes_px[row], picture.boxes_px[best]) >= min_iou:
                    free.remove(best)
                    right += 1
        points.append((right / total, right / taken_in_all))
    area, before = 0.0, 0.0
    for i, (recall, _) in enumerate(points):
        area += (recall - before) * max(precision for _, precision in points[i:])
        before = recall
    return area


def test_average_precision_agrees_with_a_literal_search() -> None:
    random = np.random.default_rng(7)
    for _ in range(10):
        pictures = []
        for i in range(4):
            known = np.column_stack([random.uniform(0, 100, (6, 2)), random.uniform(15, 30, (6, 2))])
            near = known[random.integers(0, 6, 9)] + random.normal(0, 4, (9, 4))
            picture = LabelledPicture(Path(f"{i}.png"), known, ("light",) * 6)
            pictures.append((FoundBoxes(near, random.integers(1, 30, 9) / 30.0, ["light"] * 9), picture))
        evaluation = evaluate_boxes({p.path: boxes for boxes, p in pictures}, labels_of(*(p for _, p in pictures)))
        for min_iou, accuracy in evaluation.overall.items():
            assert accuracy.average_precision == pytest.approx(literal_average_precision(pictures, min_iou))


def test_pictures_are_matched_by_the_end_of_their_path() -> None:
    nothing = found([], [])
    labels = labels_of(*(labelled([], path=Path("/data") / name) for name in ("a/1.png", "b/1.png", "b/2.png")))
    matched = match_pictures({"b/1.png": nothing, "x/2.png": nothing, "1.png": nothing}, labels)
    assert set(matched) == {Path("/data/b/1.png"), Path("/data/b/2.png"), Path("1.png")}
    with pytest.raises(InputError, match="none of the 1 pictures"):
        match_pictures({"z.png": nothing}, labels)


# The commands.


def test_detect_and_compare_from_the_command_line(tmp_path: Path) -> None:
    finder = red_finder(tmp_path / "finder.onnx")
    data = tmp_path / "data"
    write_dataset(small_dataset(), data)
    for name, size in (("a/1", (640, 480)), ("a/2", (640, 480)), ("b/1", (800, 600))):
        save(data / "images" / f"{name}.jpg", painted(size, [(100, 50, 120, 80)]), format="PNG")
    (data / "images/b/2.jpg").write_text("damaged")
    labels = {
        "images": [{"id": 1, "file_name": "images/a/1.jpg"}, {"id": 2, "file_name": "images/a/2.jpg"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 1, "bbox": [100, 50, 20, 30]},
            {"id": 2, "image_id": 2, "category_id": 1, "bbox": [300, 50, 20, 30]},
        ],
        "categories": [{"id": 1, "name": "light"}],
    }
    (data / "labels.json").write_text(json.dumps(labels))
    told = works("detect", data, "--model", finder, "--classes", "traffic_light=light")
    assert "light 3" in told
    assert read_dataset(data).detections.class_name.names == ("light",)
    assert json.loads((data / "detect.json").read_text())["counts"]["unusable_pictures"] == 1
    record = json.loads(
        works("detect", data / "images", "--model", finder, "--out", tmp_path / "o", "--json", "--set", "decoders=1")
    )
    assert record["counts"]["detections"] == 3
    figures = json.loads(works("evaluate-detections", data, "--labels", f"coco:{data / 'labels.json'}", "--json"))
    assert (figures["pictures"], figures["iou_0.5"]["recall"], figures["iou_0.5"]["precision"]) == (2, 0.5, 0.5)
    assert set(figures["iou_0.3"]) >= {"recall", "precision", "average_precision", "mean_iou"}
    assert [entry["min_px"] for entry in figures["by_height"]] == [0, 12, 24, 48]
    shown = works(
        "evaluate-detections", tmp_path / "o", "--labels", f"coco:{data / 'labels.json'}", "--min-height", "20"
    )
    assert "20 up" in shown


def test_mistakes_are_one_line_and_a_hint(tmp_path: Path) -> None:
    finder = red_finder(tmp_path / "finder.onnx")
    save(tmp_path / "pictures" / "1.png", painted((64, 64), []))
    pictures = tmp_path / "pictures"
    assert "no such folder" in complains("detect", tmp_path / "none", "--model", finder)
    assert "no class 'sign'" in complains("detect", pictures, "--model", finder, "--classes", "sign")
    assert "--out is for" in complains("detect", pictures, "--model", finder, "--images", pictures)
    assert "dataset.json" in complains("evaluate-detections", pictures, "--labels", "coco:x.json")
    (pictures / "1.png").write_bytes(b"")
    assert "none of 1 pictures" in complains("detect", pictures, "--model", finder)


def test_ctrl_c_keeps_what_is_done(tmp_path: Path) -> None:
    count = 20000
    data, base = tmp_path / "data", small_dataset()
    images = base.images.take(np.zeros(count, np.int64)).replace(
        image_id=np.arange(count), name=pa.array([f"{i % 7}.png" for i in range(count)])
    )
    first = base.detections.take(np.array([0])).replace(image_id=np.array([0]))
    write_dataset(replace(base, images=images, detections=first, truth=None, truth_detections=None), data)
    for i in range(7):
        save(data / "images" / f"{i}.png", painted((640, 480), [(9 * i, 9, 9 * i + 5, 30)]))
    before = (data / "detections.parquet").read_bytes()
    command = [*COMMAND, "detect", str(data), "--model", str(red_finder(tmp_path / "finder.onnx"))]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heard_by_default
    ) as process:
        journal = data / ".detect.journal"
        while process.poll() is None and not (journal.is_file() and journal.stat().st_size > 5000):
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 130, told
    assert told.splitlines() == [
        "interrupted: the detections are as before",
        "hint: run the same command again to go on from here",
    ]
    assert (data / "detections.parquet").read_bytes() == before
    assert journal.stat().st_size > 5000


def test_simulated_pictures_are_drawn_on_request(tmp_path: Path) -> None:
    small = ("--set", "streets_north_south=2", "--set", "streets_east_west=2", "--set", "frame_spacing_m=18")
    few = ("--set", "passes_per_street=1", "--set", "image_width_px=160", "--set", "image_height_px=120")
    works(
        "simulate", "--out", tmp_path / "city", "--images", *small, *few, "--set", "focal_px=125", "--set", "lights=8"
    )
    names = read_dataset(tmp_path / "city").images.name.to_pylist()
    for name in names:
        with Image.open(tmp_path / "city" / "images" / name) as picture:
            assert picture.size == (160, 120)
    assert (tmp_path / "city" / "boxes.json").is_file()


def test_maps_are_made_without_the_settings_of_other_commands() -> None:
    names = tuple(f"valuemap.config.{name}" for name in ("detection", "simulation", "training"))
    code = f"import sys, valuemap.cli.update\nprint([name for name in {names!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert all(hasattr(config, name) for name in config.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        config.Nothing  # noqa: B018


def test_the_command_line_starts_without_slow_libraries() -> None:
    slow = ("onnxruntime", "cv2", "onnx", "torch", "PIL", "scipy.stats")
    code = f"import sys, valuemap.cli, valuemap.pipeline\nprint([name for name in {slow!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
