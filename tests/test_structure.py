"""In black, white and noise the bundled model finds nothing, and nobody asks it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tiny_models import red_finder
from valuemap.config import DetectConfig
from valuemap.detect import BUNDLED_MODEL
from valuemap.detect.infer import Detector, Task
from valuemap.detect.run import RECORD, detect_folder
from valuemap.detect.structure import MIN_COARSE_SHARE, coarse_share
from valuemap.simulate import PRESETS, record_city
from valuemap.simulate.render import render_pictures

Pixels = NDArray[np.uint8]
SIZE = (480, 640, 3)


def noise(grain_px: int, *, is_grey: bool = False, seed: int = 0) -> Pixels:
    """Return noise whose grain is so many pixels wide."""
    shape = (SIZE[0] // grain_px + 1, SIZE[1] // grain_px + 1, 1 if is_grey else 3)
    fine = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    fine = np.broadcast_to(fine, (*shape[:2], 3))
    return np.asarray(cv2.resize(fine, (SIZE[1], SIZE[0]), interpolation=cv2.INTER_CUBIC), np.uint8)


def nothing_to_see() -> dict[str, Pixels]:
    rng = np.random.default_rng(3)
    pictures = {f"one_color_{value}": np.full(SIZE, value, np.uint8) for value in (0, 1, 77, 254, 255)}
    pictures |= {f"grain_{grain}": noise(grain) for grain in (1, 2, 4, 8, 16)}
    pictures |= {f"grey_grain_{grain}": noise(grain, is_grey=True) for grain in (1, 4, 16)}
    pictures["salt"] = np.repeat(np.where(rng.random((*SIZE[:2], 1)) < 0.01, 255, 0).astype(np.uint8), 3, axis=2)
    for level, spread in ((2, 4), (110, 10), (110, 60)):
        pictures[f"sensor_{level}_{spread}"] = np.clip(rng.normal(level, spread, SIZE), 0, 255).astype(np.uint8)
    return pictures


def test_the_bundled_model_finds_nothing_where_nothing_can_be(tmp_path: Path) -> None:
    pictures = nothing_to_see()
    for name, pixels in pictures.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), pixels)
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), pixels)
    detect_folder(tmp_path, BUNDLED_MODEL, DetectConfig(min_score=0.0), out=tmp_path / "out")
    counts = json.loads((tmp_path / "out" / RECORD).read_text())["counts"]
    assert counts["detections"] == 0
    assert counts["pictures_of_noise_or_one_color"] == counts["pictures"] == 2 * len(pictures)


def test_it_would_find_lights_in_noise_if_it_were_asked(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "noise.png"), noise(4))
    detector = Detector(BUNDLED_MODEL, DetectConfig(min_score=0.0))
    (seen,) = next(iter(detector.run([Task(tmp_path / "noise.png")])))
    detector.model = replace(detector.model, min_coarse_share=0.0)
    (asked,) = next(iter(detector.run([Task(tmp_path / "noise.png")])))
    assert (len(seen.boxes), seen.has_structure) == (0, False)
    assert len(asked.boxes) > 100
    assert asked.has_structure


def test_pictures_of_streets_have_far_more_structure_than_is_asked_for() -> None:
    recording = record_city(PRESETS["small"], seed=5)
    for picture in render_pictures(recording, rows=[0, len(recording.dataset.images) // 2]):
        assert coarse_share(picture.image) > 2.0 * MIN_COARSE_SHARE
        assert coarse_share(picture.image // 16) > 2.0 * MIN_COARSE_SHARE  # At night.


def test_by_default_only_boxes_count_that_are_mostly_right_in_real_pictures() -> None:
    assert Detector(BUNDLED_MODEL, DetectConfig()).min_score == 0.8
    assert Detector(BUNDLED_MODEL, DetectConfig(min_score=0.3)).min_score == 0.3


def test_models_that_do_not_ask_for_structure_look_at_everything(tmp_path: Path) -> None:
    red = np.zeros(SIZE, np.uint8)
    red[:, :, 2] = 255
    cv2.imwrite(str(tmp_path / "red.png"), red)
    finder = red_finder(tmp_path / "finder.onnx")
    (outcome,) = next(iter(Detector(finder, DetectConfig()).run([Task(tmp_path / "red.png")])))
    assert len(outcome.boxes) == 1


@pytest.mark.parametrize(
    ("pixels", "share"),
    [
        (np.full(SIZE, 9, np.uint8), 0.0),
        (np.repeat(np.repeat(np.array([[[0]], [[250]]], np.uint8), 240, axis=0), 640, axis=1).repeat(3, axis=2), 1.0),
        ((np.indices((480, 640)).sum(axis=0) % 2 * 255).astype(np.uint8)[:, :, None].repeat(3, axis=2), 0.0),
    ],
    ids=["one color", "sky and ground", "chequered"],
)
def test_the_coarse_share_of_known_pictures(pixels: Pixels, share: float) -> None:
    assert coarse_share(pixels) == pytest.approx(share, abs=1e-3)


def test_the_share_of_noise_falls_with_the_square_of_its_grain() -> None:
    fine, coarse = (np.mean([coarse_share(noise(grain, seed=seed)) for seed in range(4)]) for grain in (2, 16))
    assert 20.0 < coarse / fine < 200.0  # 64, were 16 blocks not few.
