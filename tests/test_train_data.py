"""What a network trains on: masks of boxes, cut-outs, splits; and how its threshold is chosen. No PyTorch needed."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from valuemap.arrays import Floats
from valuemap.config import TrainConfig
from valuemap.detect.augment import Window, choose_window, vary_colours
from valuemap.detect.boxes import Boxes
from valuemap.detect.labels import LabelledPicture, LabelledPictures
from valuemap.detect.letterbox import PADDING
from valuemap.detect.masks import masks_of_boxes
from valuemap.detect.samples import batches, prepare_data, whole
from valuemap.detect.threshold import THRESHOLDS, ThresholdSearch, match
from valuemap.detect.train import train
from valuemap.errors import InputError, SettingError, ValuemapError
from valuemap.progress import silent

NOTHING = np.empty((0, 4))


def edges(*rows: tuple[float, float, float, float]) -> Floats:
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def write_picture(path: Path, value: int = 90, size_px: tuple[int, int] = (96, 64)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size_px, (value, value, value)).save(path)
    return path


def labelled(
    path: Path, *boxes: tuple[float, float, float, float], split: str = "", name: str = "light"
) -> LabelledPicture:
    return LabelledPicture(path, edges(*boxes), (name,) * len(boxes), NOTHING, split)


def source(*pictures: LabelledPicture) -> LabelledPictures:
    return LabelledPictures("test", pictures, ())


def test_a_pixel_is_of_a_box_if_its_centre_is() -> None:
    target, weight = masks_of_boxes(
        edges((1.5, 0.6, 4.5, 2.4)), np.array([0]), NOTHING, classes=1, size_px=(6, 4), small_object_px=0.0
    )
    assert target[0].tolist() == [[0] * 6, [0, 1, 1, 1, 0, 0], [0] * 6, [0] * 6]
    assert (weight == 1.0).all()


def test_the_smallest_box_has_a_pixel_and_those_outside_have_none() -> None:
    boxes = edges((2.6, 1.6, 2.8, 1.8), (-9.0, 0.0, -2.0, 3.0), (7.0, 0.0, 9.0, 3.0))
    target, _ = masks_of_boxes(boxes, np.zeros(3, int), NOTHING, classes=1, size_px=(6, 4), small_object_px=0.0)
    assert np.argwhere(target[0]).tolist() == [[1, 2]]


def test_small_objects_weigh_as_much_as_a_larger_one_and_ignored_places_nothing() -> None:
    target, weight = masks_of_boxes(
        edges((0.0, 0.0, 2.0, 2.0), (4.0, 0.0, 12.0, 10.0)),
        np.array([0, 1]),
        edges((0.0, 0.0, 3.0, 3.0)),
        classes=2,
        size_px=(16, 16),
        small_object_px=64.0,
    )
    assert weight[0, :2, :2].tolist() == [[16.0, 16.0], [16.0, 16.0]]
    assert weight[0, 2, :4].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert weight[1, :3, :3].max() == 0.0
    assert weight[1, 5, 8] == 1.0
    assert target.sum(axis=(1, 2)).tolist() == [4, 80]


@settings(deadline=None)
@given(
    st.tuples(st.floats(-40.0, 90.0), st.floats(-40.0, 60.0)), st.floats(0.5, 2.0), st.booleans(), st.integers(0, 2**32)
)
def test_boxes_go_where_their_pixels_go(
    corner_px: tuple[float, float], scale: float, is_mirrored: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    left, top = rng.integers(0, 60), rng.integers(0, 30)
    width, height = rng.integers(12, 30, 2)
    pixels = np.zeros((64, 96, 3), np.uint8)
    pixels[top : top + height, left : left + width] = 255
    box_px = np.array([[left + width / 2, top + height / 2, width, height]], float)
    box_px[:, 2:] = np.minimum(box_px[:, :2] + box_px[:, 2:] / 2, [96, 64]) - (box_px[:, :2] - box_px[:, 2:] / 2)
    box_px[:, :2] = [left, top] + box_px[:, 2:] / 2
    window = Window(corner_px, scale, is_mirrored, 128)
    drawn = window.draw(pixels)[..., 0] > 160
    found = np.argwhere(drawn)
    place = window.edges(box_px)[0]
    is_inside = (place[:2] >= 2.0).all() and (place[2:] <= 126.0).all()
    if is_inside:
        low, high = found.min(axis=0)[::-1], found.max(axis=0)[::-1] + 1
        assert np.abs(np.concatenate([low, high]) - place).max() < 1.6


def test_half_pixels_are_right() -> None:
    pixels = np.full((8, 8, 3), PADDING, np.uint8)
    pixels[2:4, 4:6] = 255
    boxes_px = np.array([[5.0, 3.0, 2.0, 2.0]])
    for is_mirrored in (False, True):
        window = Window((0.0, 0.0), 2.0, is_mirrored, 16)
        left, top, right, bottom = window.edges(boxes_px)[0].astype(int)
        drawn = window.draw(pixels)[..., 0].astype(float) - PADDING
        rows, columns = np.indices(drawn.shape) + 0.5
        assert (drawn * columns).sum() / drawn.sum() == pytest.approx((left + right) / 2, abs=0.01)
        assert (drawn * rows).sum() / drawn.sum() == pytest.approx((top + bottom) / 2, abs=0.01)


def test_cut_outs_hold_an_object_as_often_as_said_and_are_never_upside_down() -> None:
    config = replace(TrainConfig(), crop_px=64, object_share=1.0)
    boxes_px = np.array([[500.0, 20.0, 8.0, 20.0]])
    mirrored = []
    for seed in range(200):
        window = choose_window((640, 480), boxes_px, config, np.random.default_rng(seed))
        left, top, right, bottom = window.edges(boxes_px)[0]
        assert left < right
        assert top < bottom
        assert 0.0 <= (left + right) / 2 <= 64.0
        assert 0.0 <= (top + bottom) / 2 <= 64.0
        assert 1.0 / config.max_enlargement <= window.scale <= config.max_enlargement
        above, below = window.edges(np.array([[500.0, 20.0, 8.0, 20.0], [500.0, 40.0, 8.0, 20.0]]))[:, 1]
        assert above < below
        mirrored.append(window.is_mirrored)
    assert 60 < sum(mirrored) < 140


def test_cut_outs_stay_in_the_picture_where_it_is_large_enough() -> None:
    config = replace(TrainConfig(), crop_px=64)
    for seed in range(100):
        window = choose_window((200, 150), NOTHING, config, np.random.default_rng(seed))
        (x, y), seen_px = window.corner_px, 64 / window.scale
        assert min(x, y) >= 0.0
        assert x + seen_px <= 200.0 + 1e-9
        assert y + seen_px <= 150.0 + 1e-9


def test_colours_vary_within_bounds_and_not_at_all_where_nothing_is_to_vary() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    still = replace(TrainConfig(), brightness=0.0, blur_sigma_px=0.0)
    assert np.allclose(vary_colours(pixels, still, np.random.default_rng(1)), pixels / 255.0, atol=1e-6)
    varied = [vary_colours(pixels, TrainConfig(), np.random.default_rng(seed)) for seed in range(20)]
    assert all(picture.min() >= 0.0 and picture.max() <= 1.0 for picture in varied)
    assert np.ptp([picture.mean() for picture in varied]) > 0.05


def test_the_crop_has_to_fit_the_network() -> None:
    with pytest.raises(SettingError, match="crop_px: expected a multiple of 32, found 100"):
        TrainConfig().with_settings(["crop_px=100"])


def test_labels_say_the_split_and_test_pictures_are_left_alone(tmp_path: Path) -> None:
    path = write_picture(tmp_path / "a.png")
    data = prepare_data(
        [source(*(labelled(path, (9, 9, 4, 4), split=split) for split in ("train", "val", "test", "train")))],
        TrainConfig(),
        one_class=None,
        seed=0,
        progress=silent,
    )
    assert (len(data.training), len(data.validation), data.test_pictures) == (2, 1, 1)


@pytest.mark.parametrize("split", ["", "train"])
def test_without_a_split_a_share_validates(tmp_path: Path, split: str) -> None:
    path = write_picture(tmp_path / "a.png")
    pictures = [labelled(path, (9, 9, 4, 4), split=split)] * 10
    config = replace(TrainConfig(), validation_share=0.3)
    data = prepare_data([source(*pictures)], config, one_class=None, seed=0, progress=silent)
    assert (len(data.training), len(data.validation)) == (7, 3)


def test_pictures_of_one_folder_stay_together(tmp_path: Path) -> None:
    paths = [write_picture(tmp_path / str(folder) / f"{i}.png") for folder in range(6) for i in range(4)]
    pictures = [labelled(path, (9, 9, 4, 4)) for path in paths]
    data = prepare_data([source(*pictures)], TrainConfig(), one_class=None, seed=0, progress=silent)
    folders = [{picture.path.parent for picture in use} for use in (data.training, data.validation)]
    assert not folders[0] & folders[1]
    assert [len(use) for use in folders] == [4, 2]


def test_one_class_takes_all_labels(tmp_path: Path) -> None:
    path = write_picture(tmp_path / "a.png")
    pictures = [labelled(path, (9, 9, 4, 4), name=name, split="train") for name in ("red", "green")]
    pictures.append(labelled(path, (9, 9, 4, 4), name="blue", split="val"))
    data = prepare_data([source(*pictures)], TrainConfig(), one_class="light", seed=0, progress=silent)
    assert data.classes == ("light",)
    with pytest.raises(InputError, match="class 'blue' is in the pictures for validation only"):
        prepare_data([source(*pictures)], TrainConfig(), one_class=None, seed=0, progress=silent)


def test_broken_and_missing_pictures_are_named_and_the_others_stay(tmp_path: Path) -> None:
    good = write_picture(tmp_path / "a.png")
    broken = tmp_path / "b.png"
    broken.write_bytes(good.read_bytes()[:60])
    paths = [good, broken, tmp_path / "c.png", good, good]
    data = prepare_data(
        [source(*(labelled(path, (9, 9, 4, 4)) for path in paths))],
        TrainConfig(),
        one_class=None,
        seed=0,
        progress=silent,
    )
    assert len(data.training) + len(data.validation) == 3
    assert [line.partition(":")[0] for line in data.skipped] == [str(broken), str(tmp_path / "c.png")]


def test_too_few_pictures_or_boxes_are_refused(tmp_path: Path) -> None:
    path = write_picture(tmp_path / "a.png")
    with pytest.raises(InputError, match="test: 1 usable pictures for training, 0 for validation"):
        prepare_data([source(labelled(path, (9, 9, 4, 4)))], TrainConfig(), one_class=None, seed=0, progress=silent)
    with pytest.raises(InputError, match=r"no usable pictures \(1 entries skipped, .*none.png: no such file"):
        prepare_data([source(labelled(tmp_path / "none.png"))], TrainConfig(), one_class=None, seed=0, progress=silent)
    with pytest.raises(InputError, match="no picture for training has a box"):
        prepare_data([source(*[labelled(path)] * 9)], TrainConfig(), one_class=None, seed=0, progress=silent)


def test_batches_depend_on_seed_and_epoch_only(tmp_path: Path) -> None:
    paths = [write_picture(tmp_path / f"{i}.png", 20 * i) for i in range(7)]
    config = replace(TrainConfig(), crop_px=32, batch=3, cutouts=2)
    pictures = [labelled(path, (30, 30, 9, 9), split="train" if i else "val") for i, path in enumerate(paths)]
    data = prepare_data([source(*pictures)], config, one_class=None, seed=0, progress=silent)

    def images(seed: int, epoch: int) -> Floats:
        return np.concatenate([image for image, _, _ in batches(data, config, seed=seed, epoch=epoch)])

    assert images(0, 1).shape == (12, 3, 32, 32)
    assert np.array_equal(images(0, 1), images(0, 1))
    assert not np.array_equal(images(0, 1), images(0, 2))
    assert not np.array_equal(images(0, 1), images(1, 1))


def test_the_padding_of_a_whole_picture_has_no_weight(tmp_path: Path) -> None:
    path = write_picture(tmp_path / "a.png", size_px=(70, 40))
    pictures = [labelled(path, (69.0, 39.0, 2.0, 2.0), split=split) for split in ("train", "val")]
    data = prepare_data([source(*pictures)], TrainConfig(), one_class=None, seed=0, progress=silent)
    sample, fit = whole(data, 0, TrainConfig())
    assert sample.image.shape == (3, 64, 96)
    assert fit.resized == (70, 40)
    assert np.argwhere(sample.target[0]).tolist() == [[38, 68], [38, 69], [39, 68], [39, 69]]
    assert (sample.weight[0, :40, :70] > 0).all()
    assert sample.weight.sum() == pytest.approx(sample.weight[0, :40, :70].sum())


def boxes(*rows: tuple[float, float, float, float], score: list[float] | None = None) -> Boxes:
    return Boxes.from_edges(edges(*rows), np.array(score or [1.0] * len(rows)), np.zeros(len(rows)))


def test_the_better_score_takes_the_object_first() -> None:
    truth = boxes((0, 0, 10, 10), (20, 0, 30, 10))
    found = boxes((0, 0, 10, 9), (0, 0, 10, 10), (21, 0, 30, 10), (50, 50, 60, 60), score=[0.6, 0.9, 0.5, 0.8])
    assert match(found, truth).tolist() == [False, True, True, False]
    assert match(boxes(), truth).tolist() == []
    assert match(found, boxes()).tolist() == [False] * 4


def test_the_threshold_is_where_most_objects_and_least_else_is_found() -> None:
    probability = np.zeros((1, 20, 60))
    probability[0, 2:8, 2:8] = 0.55  # An object, found up to 0.5.
    probability[0, 2:8, 20:26] = 0.95  # Another.
    probability[0, 12:18, 2:8] = 0.35  # Nothing, so more than 0.3 is better.
    probability[0, 12:18, 40:46] = 0.95  # To ignore.
    search = ThresholdSearch(minimum_component_px=4)
    truth = edges((2, 2, 8, 8), (20, 2, 26, 8))
    search.add(probability, truth, np.array([0, 0]), edges((38, 10, 50, 20)))
    assert search.best() == (0.5, 1.0, 1.0)
    search.add(np.full((1, 20, 60), 0.99), edges(), np.empty(0, int), edges())
    _, recall, precision = search.best()
    assert recall == 1.0
    assert precision == pytest.approx(2 / 3)


def test_a_network_that_finds_nothing_has_a_threshold_all_the_same() -> None:
    search = ThresholdSearch(minimum_component_px=4)
    search.add(np.zeros((1, 8, 8)), edges((0, 0, 4, 4)), np.array([0]), edges())
    assert search.best() == (float(THRESHOLDS[len(THRESHOLDS) // 2]), 0.0, 0.0)


def test_without_the_extra_there_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def find_nothing(name: str) -> None:
        return None

    monkeypatch.setattr("valuemap.detect.train.importlib.util.find_spec", find_nothing)
    with pytest.raises(ValuemapError, match="training needs PyTorch and onnxscript") as refusal:
        train([source()], tmp_path / "run")
    assert "valuemap[train]" in refusal.value.hint
    assert not (tmp_path / "run").exists()


def test_reading_and_preparing_pictures_imports_no_pytorch() -> None:
    import subprocess

    code = "import sys, valuemap.detect.train, valuemap.detect.samples; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
