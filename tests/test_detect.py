"""From pictures on disk to detections: tiles, panoramas, orientations, damaged pictures, interrupted runs."""

from __future__ import annotations

import importlib
import importlib.util
import io
import itertools
import json
import os
import shutil
import threading
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pyarrow as pa
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from small_dataset import rewrite, small_dataset, with_value
from test_cli import colmap_model
from tiny_models import halves, red_finder, says
from told import Told
from valuemap import build_map, read_dataset, remote, write_dataset
from valuemap.cli.commands import app
from valuemap.config import DetectConfig
from valuemap.dataset import Dataset
from valuemap.detect import BUNDLED_MODEL, infer, shards
from valuemap.detect.boxes import Boxes
from valuemap.detect.found import match_pictures, read_found
from valuemap.detect.infer import Detector, Task
from valuemap.detect.journal import Journal, Outcome
from valuemap.detect.labels import read_labels
from valuemap.detect.model import load_model
from valuemap.detect.pictures import read_picture
from valuemap.detect.run import RECORD, RESULTS, detect_dataset, detect_folder, detect_pictures
from valuemap.detect.tiles import are_cut, merge_views, plan_tiles
from valuemap.detect.truth import find_truth_detections
from valuemap.errors import InputError, OutputError, SettingError
from valuemap.folders import LEDGER
from valuemap.progress import silent
from valuemap.readers.colmap import read_colmap
from valuemap.remote import UrlPath
from valuemap.simulate import PRESETS, simulate
from valuemap.summary import summarize_dataset
from valuemap.tables import Cameras, Categories

DATA = Path(__file__).parents[2] / "shared" / "data" / "detector"

Pixels = NDArray[np.uint8]
Rectangle = tuple[int, int, int, int]


def painted(size: tuple[int, int], rectangles: list[Rectangle]) -> Pixels:
    """Return a grey picture (height, width, 3) with red rectangles of left, top, right, bottom."""
    pixels = np.full((size[1], size[0], 3), 90, np.uint8)
    for left, top, right, bottom in rectangles:
        pixels[top:bottom, left:right] = [255, 0, 0]
    return pixels


def save(path: Path, pixels: Pixels, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def edges_found(boxes: Boxes) -> list[list[int]]:
    return sorted(np.round(boxes.edges_px).astype(int).tolist())


@pytest.fixture(scope="session")
def finder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return red_finder(tmp_path_factory.mktemp("model") / "finder.onnx", {"valuemap.minimum_component_px": "4"})


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Write a dataset of four images of two sizes with a picture each, lossless."""
    folder = tmp_path / "data"
    write_dataset(small_dataset(), folder)
    for name, size in (("a/1", (640, 480)), ("a/2", (640, 480)), ("b/1", (800, 600)), ("b/2", (800, 600))):
        shift = 10 * int(name[2]) + (100 if name[0] == "b" else 0)
        pixels = painted(size, [(shift, 50, shift + 12, 80), (300, 200 + shift, 320, 240 + shift)])
        save(folder / "images" / f"{name}.jpg", pixels, format="PNG")
    return folder


def test_detections_of_a_dataset_are_replaced(dataset: Path, finder: Path) -> None:
    told: list[tuple[str, int, int]] = []
    detections = detect_dataset(dataset, finder, progress=lambda *state: told.append(state))
    read = read_dataset(dataset).detections
    assert len(read) == len(detections) == 8
    assert read.detection_id.tolist() == list(range(8))
    assert read.image_id.tolist() == [10, 10, 20, 20, 30, 30, 40, 40]
    assert read.class_name.names == ("traffic_light",)
    np.testing.assert_array_equal(read.center_px[read.image_id == 10], [[16, 65], [310, 230]])
    np.testing.assert_array_equal(read.size_px[:2], [[12, 30], [20, 40]])
    assert read.score.min() == 1.0
    record = json.loads((dataset / RECORD).read_text())
    assert record["counts"] == {
        "pictures": 4,
        "unusable_pictures": 0,
        "pictures_of_noise_or_one_color": 0,
        "turned_by_exif": 0,
        "detections": 8,
        "detections_of_class": {"traffic_light": 8},
    }
    assert told[-1] == ("pictures", 4, 4)
    assert [path.name for path in dataset.glob(".*")] == [LEDGER]


def test_images_may_come_without_detections(tmp_path: Path, finder: Path) -> None:
    colmap_model(tmp_path / "model")
    write_dataset(read_colmap(tmp_path / "model"), tmp_path / "data")
    with pytest.raises(InputError, match="there are no detections") as error:
        build_map(read_dataset(tmp_path / "data"))
    assert "valuemap detect" in error.value.hint
    assert summarize_dataset(read_dataset(tmp_path / "data"))["detections"] == 0
    for i in range(3):
        save(tmp_path / "pictures" / "a" / f"{i}.jpg", painted((640, 480), [(300, 200, 310, 230)]), format="PNG")
    detect_dataset(tmp_path / "data", finder, pictures=tmp_path / "pictures")
    assert read_dataset(tmp_path / "data").detections.image_id.tolist() == [1, 2, 3]


def test_unusable_pictures_are_listed_and_counted(dataset: Path, finder: Path) -> None:
    images = dataset / "images"
    save(images / "a/1.jpg", np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8), format="JPEG")
    whole = (images / "a/1.jpg").read_bytes()
    (images / "a/1.jpg").write_bytes(whole[: len(whole) // 2])
    (images / "a/2.jpg").write_text("this is no picture")
    (images / "b/1.jpg").unlink()
    detections = detect_dataset(dataset, finder)
    assert set(detections.image_id.tolist()) == {40}
    record = json.loads((dataset / RECORD).read_text())
    assert record["counts"]["unusable_pictures"] == 3
    problems = {entry["image"]: entry["problem"] for entry in record["unusable"]}
    assert problems["a/1.jpg"].startswith("cannot be decoded: image file is truncated")
    assert problems["a/2.jpg"] == "is no picture"
    assert problems["b/1.jpg"] == "no such file"


def test_pictures_of_another_size_than_the_camera_are_unusable(dataset: Path, finder: Path) -> None:
    save(dataset / "images/a/1.jpg", painted((320, 240), []), format="PNG")
    detect_dataset(dataset, finder)
    record = json.loads((dataset / RECORD).read_text())
    assert record["unusable"] == [{"image": "a/1.jpg", "problem": "is 320 x 240 px, but its camera 640 x 480"}]


def test_no_usable_picture_is_an_error_and_changes_nothing(dataset: Path, finder: Path) -> None:
    before = (dataset / "detections.parquet").read_bytes()
    shutil.rmtree(dataset / "images")
    with pytest.raises(InputError, match="no such folder of pictures"):
        detect_dataset(dataset, finder)
    (dataset / "images").mkdir()
    with pytest.raises(InputError, match=r"none of 4 pictures can be used"):
        detect_dataset(dataset, finder)
    assert (dataset / "detections.parquet").read_bytes() == before
    assert not (dataset / RECORD).exists()
    assert [path.name for path in dataset.glob(".*")] == [LEDGER]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_network_sees_upright_pictures_and_boxes_come_back(tmp_path: Path, finder: Path, orientation: int) -> None:
    """A red rectangle in the stored pixels is found there, whatever the EXIF orientation."""
    stored = painted((120, 80), [(20, 10, 50, 22)])
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = save(tmp_path / "p.png", stored, exif=exif)
    found = detect_pictures([path], finder)[0]
    assert edges_found(found.boxes) == [[20, 10, 50, 22]]
    assert found.stored_px == (120, 80)
    # A camera of the upright size has upright pixels.
    upright = (80, 120) if orientation >= 5 else (120, 80)
    outcome = next(Detector(finder, DetectConfig()).run([Task(path, upright)]))[0]
    if orientation >= 5:
        seen = painted((80, 120), [])
        left, top, right, bottom = edges_found(outcome.boxes)[0]
        seen[top:bottom, left:right] = [255, 0, 0]
        assert np.array_equal(seen, read_picture(path).pixels)
        assert outcome.was_turned
    else:
        assert edges_found(outcome.boxes) == [[20, 10, 50, 22]]


def test_16_bit_and_grey_pictures_are_brought_to_8_bit_colour(tmp_path: Path) -> None:
    Image.fromarray(np.arange(64, dtype=np.uint16).reshape(8, 8) * 1000).save(tmp_path / "deep.png")
    pixels = read_picture(tmp_path / "deep.png").pixels
    np.testing.assert_array_equal(pixels[..., 0].ravel(), np.arange(64) * 1000 // 256)
    Image.fromarray(np.full((4, 6), 77, np.uint8)).save(tmp_path / "grey.png")
    assert (read_picture(tmp_path / "grey.png").pixels == 77).all()


# Tiles.


def test_tiles_cover_the_picture_and_overlap() -> None:
    for size, tile, overlap in (((1000, 700), 256, 64), ((257, 100), 256, 10), ((4000, 3000), 640, 96)):
        seen = np.zeros(size[::-1], np.int64)
        windows = plan_tiles(size, tile, overlap)
        for left, top, right, bottom in windows:
            assert right - left == min(tile, size[0])
            assert bottom - top == min(tile, size[1])
            seen[top:bottom, left:right] += 1
        assert seen.min() == 1
        starts = sorted({window[0] for window in windows})
        assert all(second - first <= tile - overlap for first, second in itertools.pairwise(starts))
    assert plan_tiles((1000, 700), 0, 96) == [(0, 0, 1000, 700)]
    assert plan_tiles((600, 400), 640, 96) == [(0, 0, 600, 400)]


def test_tiles_find_what_the_whole_picture_shows(tmp_path: Path, finder: Path) -> None:
    random = np.random.default_rng(5)
    free = np.ones((900, 1400), np.bool_)
    rectangles: list[Rectangle] = []
    while len(rectangles) < 60:
        left, top, width, height = (int(n) for n in random.integers([0, 0, 4, 4], [1370, 860, 30, 40]))
        area = np.s_[max(top - 2, 0) : top + height + 2, max(left - 2, 0) : left + width + 2]
        if free[area].all():
            free[area] = False
            rectangles.append((left, top, left + width, top + height))
    rectangles.append((200, 890, 900, 900))  # Longer than any tile.
    free[886:, 196:904] = False
    path = save(tmp_path / "p.png", painted((1400, 900), [r for r in rectangles if r[3] < 886 or r[0] == 200]))
    whole = detect_pictures([path], finder)[0]
    tiled = detect_pictures([path], finder, DetectConfig(tile_px=256, tile_overlap_px=64))[0]
    assert edges_found(whole.boxes) == edges_found(tiled.boxes)
    assert len(whole.boxes) > 50


def test_parts_of_a_thing_are_joined_and_neighbours_are_not() -> None:
    def boxes(*edges: list[float]) -> Boxes:
        return Boxes.from_edges(np.array(edges), np.linspace(0.9, 0.5, len(edges)), np.zeros(len(edges)))

    left, right = (0, 0, 100, 100), (60, 0, 160, 100)
    is_inner = {left: (False, False, True, False), right: (True, False, False, False)}
    views = {
        left: boxes([40.0, 10, 100, 30], [70.0, 50, 80, 60], [90.0, 70, 100, 80]),
        right: boxes([60.0, 10, 140, 30], [70.0, 50, 80, 60], [90.0, 70, 106, 80], [120.0, 50, 130, 60]),
    }
    cuts = [are_cut(found, window, is_inner[window]) for window, found in views.items()]
    assert [cut.tolist() for cut in cuts] == [[True, False, True], [True, False, False, False]]
    merged = merge_views(list(views.values()), cuts, 0.5)
    assert edges_found(merged) == [[40, 10, 140, 30], [70, 50, 80, 60], [90, 70, 106, 80], [120, 50, 130, 60]]


# Panoramas.


def panorama_with_spots(width: int, directions: NDArray[np.float64], radius_deg: float) -> tuple[Pixels, Any]:
    """Return a panorama (width / 2, width, 3) with red spots of a radius around directions (N, 3), and its camera."""
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=width, height=width // 2, params=[width, width // 2])
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(width // 2) + 0.5)
    rays = np.asarray(camera.cam_ray_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))
    is_red = (rays @ directions.T > np.cos(np.radians(radius_deg))).any(axis=1).reshape(x.shape)
    return np.where(is_red[:, :, None], [255, 0, 0], [90, 90, 90]).astype(np.uint8), camera


def test_panoramas_are_seen_all_round_and_each_thing_once(tmp_path: Path, finder: Path) -> None:
    azimuth = np.radians([-180.0, -179.0, -120.0, -66.0, -3.0, 0.0, 25.0, 30.0, 61.0, 90.0, 135.0, 149.0])
    height = np.radians([5.0, -12.0, 20.0, 0.0, 30.0, -20.0, 10.0, 25.0, 15.0, 40.0, 3.0, -10.0])
    direction = np.stack([np.sin(azimuth) * np.cos(height), -np.sin(height), np.cos(azimuth) * np.cos(height)], axis=1)
    pixels, camera = panorama_with_spots(1440, direction, 1.6)
    path = save(tmp_path / "pano.png", pixels)
    outcome = next(Detector(finder, DetectConfig()).run([Task(path, (1440, 720), is_panorama=True)]))[0]
    expected = np.asarray(camera.img_from_cam(direction))
    assert len(outcome.boxes) == len(expected)
    apart = outcome.boxes.center_px[:, None] - expected[None]
    apart[..., 0] -= 1440 * np.round(apart[..., 0] / 1440)
    distance = np.linalg.norm(apart, axis=2)
    assert sorted(distance.argmin(axis=1).tolist()) == list(range(len(expected)))
    assert distance.min(axis=1).max() < 0.75
    wide = 2 * 1.6 * 4 / np.cos(height)[distance.argmin(axis=1)]  # A panorama stretches what is high up.
    np.testing.assert_allclose(outcome.boxes.size_px, np.stack([wide, np.full(len(wide), 12.8)], axis=1), atol=2.0)


def test_a_dataset_of_panoramas(tmp_path: Path, finder: Path) -> None:
    pixels, _ = panorama_with_spots(720, np.array([[0.0, -0.1, 1.0]]) / np.hypot(0.1, 1.0), 3.0)
    small = small_dataset()
    cameras = Cameras(
        camera_id=np.array([1]),
        model=Categories.from_texts(["EQUIRECTANGULAR"]),
        width_px=np.array([720]),
        height_px=np.array([360]),
        params=[np.array([720.0, 360.0])],
    )
    images = small.images.take(np.array([0])).replace(name=pa.array(["pano.png"]))
    first = small.detections.take(np.array([0]))
    write_dataset(Dataset("panorama", small.frame, cameras, images, first), tmp_path / "data")
    save(tmp_path / "data" / "images" / "pano.png", pixels)
    detections = detect_dataset(tmp_path / "data", finder)
    np.testing.assert_allclose(detections.center_px, [[360.0, 180 - 2 * np.degrees(np.arctan(0.1))]], atol=0.5)


# Sizes and batches.


def fixed_finder(path: Path) -> Path:
    return red_finder(path, size=(64, 96))


def test_a_model_of_a_fixed_size_is_freed_on_request(tmp_path: Path) -> None:
    file = fixed_finder(tmp_path / "fixed.onnx")
    path = save(tmp_path / "p.png", painted((200, 100), [(150, 60, 156, 66)]))
    sizes = []
    for size in ("model", "picture", "224x128", "96x64"):
        config = DetectConfig(size=size)
        sizes.append(load_model(file, config).fit((200, 100), config.size_px).canvas)
        found = detect_pictures([path], file, config)[0].boxes
        tolerance = 0.0 if size == "picture" else 2.5
        np.testing.assert_allclose(found.edges_px, [[150, 60, 156, 66]], atol=tolerance + 1e-9)
    assert sizes == [(96, 64), (224, 128), (224, 128), (96, 64)]


def test_batches_change_nothing(tmp_path: Path, finder: Path) -> None:
    """Pictures of different sizes and damaged ones in one batch; also with a model that takes one at a time."""
    paths = [save(tmp_path / f"{i}.png", painted((64 + 32 * (i % 3), 64), [(5 + i, 9, 15 + i, 30)])) for i in range(11)]
    paths[4].write_text("damaged")
    one = detect_pictures(paths, finder)
    for batch in (2, 4, 64):
        many = detect_pictures(paths, finder, DetectConfig(batch=batch, decoders=3))
        assert [edges_found(found.boxes) for found in many] == [edges_found(found.boxes) for found in one]
    assert [bool(found.problem) for found in one] == [i == 4 for i in range(11)]
    single = says(tmp_path / "single.onnx", {"output": np.zeros((1, 300, 6), np.float32)})
    assert len(detect_pictures(paths, single, DetectConfig(batch=4))) == 11


def test_a_size_that_the_network_cannot_take_is_one_clear_line(tmp_path: Path) -> None:
    file = says(tmp_path / "m.onnx", {"output": np.zeros((1, 84, 13), np.float32)}, picture=(1, 3, 64, 64))
    path = save(tmp_path / "p.png", painted((64, 64), []))
    with pytest.raises(InputError, match="for each cell of strides"):
        detect_pictures([path], file, DetectConfig(size="128"))
    for text in ("0", "12x", "axb", "1x2x3"):
        with pytest.raises(SettingError, match="--size"):
            DetectConfig(size=text)


def test_a_network_for_one_size_says_which(tmp_path: Path) -> None:
    """As YOLOX joins what it sees at three scales: of 100 px the half of a half is no whole number."""
    file = halves(tmp_path / "m.onnx", size=(64, 96))
    path = save(tmp_path / "p.png", painted((96, 64), []))
    detect_pictures([path], file, DetectConfig(size="192x128"))
    with pytest.raises(
        InputError, match=r"m.onnx: cannot be run on 101 x 101 px: it was made for 96 x 64 px"
    ) as refused:
        detect_pictures([path], file, DetectConfig(size="101"))
    assert refused.value.hint == "leave --size away; some such models also take other multiples of 32 px"


def test_settings_are_checked() -> None:
    assert DetectConfig().with_settings(["max_iou=0.7", "tile_px=640"]).tile_px == 640
    for change, message in (
        ({"min_score": 1.5}, "min-score"),
        ({"kind": "yolo"}, "--kind"),
        ({"provider": "tpu"}, "--provider"),
        ({"tile_px": 100}, "--tile"),
        ({"batch": 0}, "batch"),
    ):
        with pytest.raises(SettingError, match=message):
            DetectConfig(**change)
    with pytest.raises(SettingError, match="no setting named"):
        DetectConfig().with_settings(["kind=yolox"])


def test_only_a_few_pictures_are_decoded_ahead(tmp_path: Path, finder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path / "p.png", painted((64, 64), []))
    read, lock, most = [0], threading.Lock(), 0
    decode = read_picture

    def counting(*arguments: Any, **options: Any) -> Any:
        with lock:
            read[0] += 1
        return decode(*arguments, **options)

    monkeypatch.setattr(infer, "read_picture", counting)
    config = DetectConfig(batch=3, decoders=2)
    done = 0
    for group in Detector(finder, config).run([Task(path)] * 100):
        done += len(group)
        most = max(most, read[0] - done)
    assert done == read[0] == 100
    assert most <= 5


# Interrupted runs.


@cache
def noisy_png(number: int) -> bytes:
    """Return a file of noise with a red rectangle, whose place is that of the number."""
    pixels = painted((640, 120), [(30 * number, 40, 30 * number + 17, 90)])
    noise = np.random.default_rng(number).normal(0, 25, pixels.shape)
    file = io.BytesIO()
    Image.fromarray(np.clip(pixels + noise, 0, 255).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def noisy_pictures(folder: Path) -> Path:
    """Write a dataset of 20 images with a noisy picture each, but for one that is damaged."""
    base = small_dataset()
    cameras = base.cameras.replace(height_px=np.full(len(base.cameras), 120))
    images = base.images.take(np.repeat(0, 20)).replace(
        image_id=np.arange(20), name=pa.array([f"{i}.png" for i in range(20)])
    )
    detections = base.detections.take(np.array([0]))
    detections = detections.replace(image_id=np.array([0]), center_px=np.array([[400.0, 60.0]]))
    write_dataset(Dataset("long", base.frame, cameras, images, detections), folder)
    (folder / "images").mkdir()
    for i in range(20):
        (folder / "images" / f"{i}.png").write_bytes(noisy_png(i))
    (folder / "images" / "3.png").write_text("damaged")
    return folder


def test_an_interrupted_run_goes_on_to_the_same_bytes(tmp_path: Path, finder: Path) -> None:
    folder = noisy_pictures(tmp_path / "data")
    before = (folder / "detections.parquet").read_bytes()
    config = DetectConfig(batch=3)
    whole = shutil.copytree(folder, tmp_path / "whole")
    told = Told()
    detect_dataset(whole, finder, config, progress=told)
    told.check("pictures")

    def stop_after(count: int) -> Callable[[str, int, int], None]:
        def progress(what: str, done: int, total: int) -> None:
            if done >= count:
                raise KeyboardInterrupt

        return progress

    for count in (4, 11):
        with pytest.raises(KeyboardInterrupt):
            detect_dataset(folder, finder, config, progress=stop_after(count))
        assert (folder / "detections.parquet").read_bytes() == before
        with (folder / ".detect.journal").open("ab") as file:
            file.write(b'{"boxes": [[1.0, 2.')  # As if it had been killed while writing.
    detect_dataset(folder, finder, config)
    assert (folder / "detections.parquet").read_bytes() == (whole / "detections.parquet").read_bytes()
    record, expected = (json.loads((place / RECORD).read_text()) for place in (folder, whole))
    assert record["pictures_of_an_interrupted_run"] == 12
    assert record["counts"] == expected["counts"]
    assert record["unusable"] == expected["unusable"]


class Elsewhere:
    """An engine as a cluster is one: paths go to it, and what begins last is done first."""

    needs_paths = True

    def __init__(self, before: Callable[[], object] = lambda: None) -> None:
        self.before, self.ran = before, list[tuple[int, bool]]()

    def threads_of_task(self, *_: object, **__: object) -> int:
        return 1

    def run(self, work: Any, tasks: Any, *, on_gpus: bool = False) -> Any:
        self.ran.append((len(tasks), on_gpus))
        self.before()
        yield from ((number, work(tasks[number], silent)) for number in reversed(range(len(tasks))))


def test_pictures_looked_at_elsewhere_in_any_order_give_the_same_bytes(
    tmp_path: Path, finder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = noisy_pictures(tmp_path / "data")
    whole = shutil.copytree(folder, tmp_path / "whole")
    detect_dataset(whole, finder, DetectConfig(batch=3))
    monkeypatch.setattr(shards, "SHARD_PICTURES", 7)
    engine, told = Elsewhere(), Told()
    monkeypatch.chdir(tmp_path)
    detect_dataset("data", finder, DetectConfig(batch=3), engine=engine, progress=told)
    told.check("pictures")
    assert engine.ran == [(4, False)]  # Six at a time: whole groups.
    assert (folder / "detections.parquet").read_bytes() == (whole / "detections.parquet").read_bytes()
    # Of pictures that go to GPUs only the cluster need have one.
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(SettingError, match="--provider cuda"):
        detect_dataset("data", finder, DetectConfig(provider="cuda"), engine=engine)
    assert engine.ran[1:] == [(3, True)]


def test_machines_that_have_other_files_are_told_of(tmp_path: Path, finder: Path) -> None:
    folder, model = noisy_pictures(tmp_path / "data"), shutil.copy(finder, tmp_path / "finder.onnx")
    picture, hidden = folder / "images" / "5.png", tmp_path / "hidden.png"
    engine = Elsewhere(lambda: picture.rename(hidden))

    def seen_again(what: str, done: int, total: int) -> None:
        if done:
            raise AssertionError("a picture that is there was taken for missing")

    found = engine.run

    def run(*arguments: Any, **options: Any) -> Any:
        for each in found(*arguments, **options):
            hidden.rename(picture)
            yield each

    engine.run = run  # type: ignore[method-assign]
    with pytest.raises(InputError, match=r"5\.png: is not there on all machines"):
        detect_dataset(folder, model, engine=engine, progress=seen_again)
    assert not (folder / RECORD).exists()
    with pytest.raises(InputError, match=r"finder\.onnx: no such file on"):
        detect_dataset(folder, model, DetectConfig(batch=2), engine=Elsewhere(Path(model).unlink))
    shutil.copy(finder, model)
    other = partial(red_finder, Path(model), {"valuemap.minimum_component_px": "9"})
    with pytest.raises(InputError, match=r"finder\.onnx: is another file on"):
        detect_dataset(folder, model, DetectConfig(batch=4), engine=Elsewhere(other))


# Pictures at URLs.


def test_pictures_may_be_in_a_store(tmp_path: Path, finder: Path) -> None:
    folder = noisy_pictures(tmp_path / "data")
    (folder / "images" / "7.png").unlink()
    whole = shutil.copytree(folder, tmp_path / "whole")
    detect_dataset(whole, finder)
    expected = json.loads((whole / RECORD).read_text())
    assert expected["counts"]["unusable_pictures"] == 2
    away = (folder / "images").rename(tmp_path / "away 100%23")
    urls = [away.as_uri()]
    if importlib.util.find_spec("fsspec"):
        fsspec = importlib.import_module("fsspec")
        memory = fsspec.filesystem("memory")
        for path in away.iterdir():
            memory.pipe(f"/valuemap/away/{path.name}", path.read_bytes())
        urls += ["memory://valuemap/away", "fsspec+memory://valuemap/away"]
    for url, engine in itertools.product(urls, (None, Elsewhere())):
        detect_dataset(folder, finder, pictures=url, engine=engine)
        assert (folder / "detections.parquet").read_bytes() == (whole / "detections.parquet").read_bytes()
        record = json.loads((folder / RECORD).read_text())
        assert (record["unusable"], record["counts"]) == (expected["unusable"], expected["counts"])
    result = CliRunner().invoke(app, ["detect", str(folder), f"--model={finder}", f"--images={urls[0]}"])
    assert result.exit_code == 0, result.output
    for wrong, message in (
        (f"{urls[0]}/none", "no such folder"),
        ("nowhere://a:secret@b/c", "nowhere://b/c: no store"),
    ):
        with pytest.raises(InputError, match=message) as refusal:
            detect_dataset(folder, finder, pictures=wrong)
        assert "secret" not in f"{refusal.value} {refusal.value.hint}"


def test_a_store_that_fails_ends_a_run_which_goes_on_later(
    tmp_path: Path, finder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = noisy_pictures(tmp_path / "data")
    whole = shutil.copytree(folder, tmp_path / "whole")
    detect_dataset(whole, finder)
    url = (folder / "images").as_uri()
    read = UrlPath.read_bytes

    class Failing:
        def open_input_file(self, _path: str) -> None:
            raise OSError("AWS Error NETWORK_CONNECTION\nand more")

    def read_some(place: UrlPath) -> bytes:
        if place.name == "11.png":
            monkeypatch.setattr(remote, "_system_of", lambda _root: (Failing(), "/x"))
        return read(place)

    with monkeypatch.context():
        monkeypatch.setattr(UrlPath, "read_bytes", read_some)
        with pytest.raises(
            InputError, match=r"/images/11\.png: cannot be read: AWS Error NETWORK_CONNECTION and more$"
        ):
            detect_dataset(folder, finder, DetectConfig(decoders=1), pictures=url)
    monkeypatch.undo()
    detect_dataset(folder, finder, DetectConfig(decoders=1), pictures=url)
    assert (folder / "detections.parquet").read_bytes() == (whole / "detections.parquet").read_bytes()
    assert json.loads((folder / RECORD).read_text())["pictures_of_an_interrupted_run"] > 5


def test_a_model_that_cannot_be_run_is_one_clear_line_and_leaves_nothing_behind(
    dataset: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    # Half of another colour: the model looks for nothing in plain pictures.
    for path in (dataset / "images").rglob("*.jpg"):
        with Image.open(path) as picture:
            width, height = picture.size
        save(path, painted((width, height), [(0, 0, width, height // 2)]), format="PNG")
    with pytest.raises(InputError, match="cannot be run on a batch of 1, 100 x 50 px") as refusal:
        detect_dataset(dataset, BUNDLED_MODEL, DetectConfig(size="100x50"))
    assert "multiples of 32" in refusal.value.hint
    assert capfd.readouterr().err == ""  # ONNX Runtime would print the same at length.
    assert [path.name for path in dataset.glob(".*")] == [LEDGER]


def test_a_full_disk_is_one_clear_line(dataset: Path, finder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Journal, "write", write)
    with pytest.raises(OutputError, match="cannot be written: No space left on device"):
        detect_dataset(dataset, finder)


def test_a_run_with_other_settings_begins_anew(dataset: Path, finder: Path) -> None:
    def stop(what: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        detect_dataset(dataset, finder, progress=stop)
    detect_dataset(dataset, finder, DetectConfig(min_score=0.5))
    assert json.loads((dataset / RECORD).read_text())["pictures_of_an_interrupted_run"] == 0


def test_the_journal_gives_back_every_bit(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    outcomes = [
        Outcome(Boxes(random.random((i, 2)) / 3, random.random((i, 2)) / 7, random.random(i), np.arange(i)), (64, 48))
        for i in range(5)
    ]
    outcomes.append(Outcome(Boxes.none(), problem="größer"))
    journal = Journal(tmp_path / "j", {"run": 1}, 2)
    journal.write(outcomes)
    journal.close()
    again = Journal(tmp_path / "j", {"run": 1}, 4)
    assert again.done == 4
    again.write(outcomes[4:])
    for read, written in zip(again.read(), outcomes, strict=True):
        for name in ("center_px", "size_px", "score", "class_code"):
            np.testing.assert_array_equal(getattr(read.boxes, name), getattr(written.boxes, name))
        assert (read.stored, read.problem) == (written.stored, written.problem)
    again.remove()
    assert not (tmp_path / "j").exists()


# Truth, folders of pictures, and real data.


def test_which_object_a_detection_shows_is_found_again() -> None:
    dataset = simulate(PRESETS["small"], seed=4)
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    found = find_truth_detections(dataset.cameras, dataset.images, dataset.detections, dataset.truth)
    known = dict(zip(dataset.truth_detections.detection_id, dataset.truth_detections.object_id, strict=True))
    said = dict(zip(found.detection_id, found.object_id, strict=True))
    agreed = sum(known.get(detection) == known_object for detection, known_object in said.items())
    assert agreed > 0.95 * len(known)
    assert agreed > 0.95 * len(said)


def test_truth_detections_are_made_anew(dataset: Path, finder: Path) -> None:
    base = read_dataset(dataset)
    assert base.truth is not None
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=base.cameras.params[0])
    light = base.truth.position_in_world_m[0] - np.array([0.0, 0.0, 1.5])  # From the first camera.
    x, y = np.asarray(camera.img_from_cam(np.array([[light[0], -light[2], light[1]]])))[0]
    place = (int(x) - 5, int(y) - 10, int(x) + 5, int(y) + 10)
    save(dataset / "images/a/1.jpg", painted((640, 480), [place, (500, 400, 510, 420)]), format="PNG")
    detect_dataset(dataset, finder, DetectConfig(classes="traffic_light=light"))
    again = read_dataset(dataset)
    assert again.truth_detections is not None
    shown = dict(zip(again.truth_detections.detection_id, again.truth_detections.object_id, strict=True))
    first = again.detections.detection_id[again.detections.image_id == 10]
    assert [shown.get(detection) for detection in first] == [7, None]


def test_a_folder_of_pictures_gives_annotations_that_can_be_compared(tmp_path: Path, finder: Path) -> None:
    pictures = tmp_path / "pictures"
    for i in range(3):
        save(pictures / "cam" / f"{i}.png", painted((64, 64), [(10, 10 * i, 20, 10 * i + 20)]))
    (pictures / "cam" / "3.png").write_text("damaged")
    file = detect_folder(pictures, finder, out=tmp_path / "out")
    assert file == tmp_path / "out" / RESULTS
    assert sorted(path.name for path in pictures.iterdir()) == ["cam"]
    content = json.loads(file.read_text())
    assert [image["file_name"] for image in content["images"]] == ["cam/0.png", "cam/1.png", "cam/2.png"]
    assert [entry["bbox"] for entry in content["annotations"]] == [[10, 10 * i, 10, 20] for i in range(3)]
    assert content["categories"] == [{"id": 0, "name": "traffic_light"}]
    assert json.loads((tmp_path / "out" / RECORD).read_text())["counts"]["unusable_pictures"] == 1
    labels = read_labels(f"coco:{file}")
    assert set(match_pictures(read_found(tmp_path / "out"), labels)) == {picture.path for picture in labels.pictures}
    with pytest.raises(InputError, match="no pictures in it"):
        detect_folder(tmp_path / "out", finder)


def test_results_go_into_a_folder_not_over_a_file(tmp_path: Path, finder: Path) -> None:
    save(tmp_path / "pictures" / "a.png", painted((64, 64), []))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="notes.txt: is a file, a folder is to be written there") as refused:
        detect_folder(tmp_path / "pictures", finder, out=tmp_path / "notes.txt")
    assert refused.value.hint == "name a folder with --out"
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_where_nothing_is_found_a_note_says_what_was_looked_for(tmp_path: Path, finder: Path) -> None:
    save(tmp_path / "pictures" / "a.png", painted((64, 64), []))
    command = ["detect", str(tmp_path / "pictures"), "--model", str(finder)]
    told = CliRunner().invoke(app, command)
    assert told.exit_code == 0
    assert "note: nothing was found with min_score 0 by a model of kind segmentation: --classes, " in told.stderr
    save(tmp_path / "pictures" / "b.png", painted((64, 64), [(10, 10, 20, 30)]))
    assert "nothing was found" not in CliRunner().invoke(app, command).stderr


def test_detections_of_others_are_replaced_by_force_only(dataset: Path, finder: Path) -> None:
    rewrite(dataset / "detections.parquet", with_value("score", 0, 0.5))
    with pytest.raises(OutputError, match="detections.parquet: is not ours to replace"):
        detect_dataset(dataset, finder)
    assert len(detect_dataset(dataset, finder, force=True)) == len(detect_dataset(dataset, finder))


@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "folder", "notes"])
def test_what_has_the_name_of_a_journal_is_not_followed_or_truncated(
    kind: str, dataset: Path, finder: Path, tmp_path: Path
) -> None:
    target, journal = tmp_path / "precious", dataset / ".detect.journal"
    if kind in ("link", "notes"):
        target.write_text("years of work")
    if "link" in kind:
        journal.symlink_to(target)
    elif kind == "pipe":
        os.mkfifo(journal)
    elif kind == "folder":
        journal.mkdir()
    else:
        target.rename(journal)
    with pytest.raises(OutputError, match="journal: is not ours to replace"):
        detect_dataset(dataset, finder)
    if kind in ("link", "notes"):
        assert (journal if kind == "notes" else target).read_text() == "years of work"
    assert target.exists() == (kind == "link")


def test_annotations_of_others_are_not_replaced(tmp_path: Path, finder: Path) -> None:
    save(tmp_path / "1.png", painted((64, 64), []))
    (tmp_path / RESULTS).write_text("made by hand")
    with pytest.raises(OutputError, match="not ours to replace"):
        detect_folder(tmp_path, finder)
    assert (tmp_path / RESULTS).read_text() == "made by hand"
    for _ in range(2):  # Our own are.
        detect_folder(tmp_path, finder, out=tmp_path / "out")


def test_yolox_nano_finds_the_known_boxes() -> None:
    if not DATA.is_dir():
        pytest.skip(f"there is no {DATA}")
    found = detect_pictures(
        [DATA / "bosch/dataset_sample.jpg"], DATA / "yolox_nano.onnx", DetectConfig(classes="traffic light")
    )[0]
    assert found.class_names == ("traffic light", "traffic light")
    np.testing.assert_allclose(found.boxes.edges_px, [[783, 118, 807, 169], [567, 138, 589, 186]], atol=2.0)
    np.testing.assert_allclose(found.boxes.score, [0.72, 0.68], atol=0.02)
    larger = detect_pictures(
        [DATA / "bosch/dataset_sample.jpg"],
        DATA / "yolox_nano.onnx",
        DetectConfig(classes="traffic light", size="picture"),
    )[0]
    assert len(larger.boxes) > len(found.boxes)
