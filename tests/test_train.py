"""Training: it learns, goes on where it stopped, and writes a model that says what the network says."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from PIL import Image

from extras import require_extra
from valuemap.config import TrainConfig
from valuemap.detect.labels import LabelledPicture, LabelledPictures
from valuemap.detect.samples import prepare_data
from valuemap.detect.train import RECORD, TrainResult, train
from valuemap.errors import InputError, OutputError, SettingError
from valuemap.progress import silent

require_extra("train", "torch", "onnxscript")

import torch  # noqa: E402 (only where it is installed)

from valuemap.detect.export_onnx import export_onnx  # noqa: E402
from valuemap.detect.fc_densenet import FCDenseNet  # noqa: E402
from valuemap.detect.training import Training, loss_of, loss_sums  # noqa: E402

torch.set_num_threads(1)  # Tiny networks only get slower with more, above all on a busy machine.

TINY = TrainConfig(
    first_channels=6, growth_channels=4, first_layers=1, layers=1, levels=2, epochs=3, batch=4, crop_px=32, dropout=0.1
)


def squares(folder: Path, count: int) -> LabelledPictures:
    """Pictures of a bright square each on a dark ground; every fourth is for validation."""
    rng = np.random.default_rng(5)
    pictures = []
    for row in range(count):
        x, y = rng.integers(4, 40, 2).tolist()
        pixels = rng.integers(0, 60, (64, 64, 3)).astype(np.uint8)
        pixels[y : y + 14, x : x + 10] = 220
        path = folder / f"{row}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(pixels).save(path)
        box_px = np.array([[x + 5.0, y + 7.0, 10.0, 14.0]])
        pictures.append(LabelledPicture(path, box_px, ("square",), split="val" if row % 4 == 0 else "train"))
    return LabelledPictures("squares", tuple(pictures), ("one line",))


def metrics(run: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv, but for the time they took."""
    with (run / "metrics.csv").open(encoding="utf-8") as file:
        return [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]


class _Stop(Exception):
    pass


@pytest.mark.parametrize(("classes", "stride"), [(1, 2), (3, 1)])
def test_the_network_gives_every_pixel_a_logit_a_class(classes: int, stride: int) -> None:
    config = replace(TINY, levels=4, first_stride=stride)
    network = FCDenseNet(classes, config).eval()
    with torch.no_grad():
        assert network(torch.zeros(2, 3, 64, 96)).shape == (2, classes, 64, 96)


def test_dense_layers_see_all_before_them() -> None:
    network = FCDenseNet(1, replace(TrainConfig(), first_layers=3, growth_channels=5, first_channels=7))
    assert [layer.conv.in_channels for layer in network.down_blocks[0].layers] == [7, 12, 17]
    # Of the way up: as many as the transposed convolution gives, and the skip connection.
    up, block = network.ups[-1], network.up_blocks[-1]
    assert block.layers[0].conv.in_channels == up.out_channels + 7 + 15


def test_the_loss_is_the_formula() -> None:
    logits = torch.tensor([[[[2.0, -1.0], [0.5, -3.0]]]])
    target = torch.tensor([[[[1.0, 0.0], [1.0, 0.0]]]])
    weight = torch.tensor([[[[3.0, 1.0], [1.0, 0.0]]]])
    p = 1.0 / (1.0 + np.exp([-2.0, 1.0, -0.5]))
    right = np.array([p[0], 1.0 - p[1], p[2]])
    focal = (np.array([3.0, 1.0, 1.0]) * (1.0 - right) ** 2 * -np.log(right)).sum() / 4.0
    dice = 1.0 - (2.0 * (3.0 * p[0] + p[2]) + 1.0) / (3.0 * (p[0] + 1.0) + p[1] + p[2] + 1.0 + 1.0)
    assert loss_of(loss_sums(logits, target, weight, 2.0)).item() == pytest.approx(focal + dice, rel=1e-5)


def test_what_is_to_be_ignored_does_not_change_the_loss() -> None:
    target, weight = torch.zeros(1, 1, 4, 4), torch.ones(1, 1, 4, 4)
    weight[..., 0] = 0.0
    first = torch.randn(1, 1, 4, 4, generator=torch.Generator().manual_seed(0))
    second = first.clone()
    second[..., 0] += 5.0
    assert torch.equal(loss_sums(first, target, weight, 2.0), loss_sums(second, target, weight, 2.0))


def test_it_learns_to_find_squares(tmp_path: Path) -> None:
    config = replace(TINY, epochs=12, cutouts=3, learning_rate=0.01, growth_channels=6, dropout=0.0)
    result = train([squares(tmp_path / "pictures", 24)], tmp_path / "run", config)
    rows = metrics(tmp_path / "run")
    assert len(rows) == 12
    assert float(rows[-1]["training_loss"]) < 0.5 * float(rows[0]["training_loss"])
    assert result.recall >= 0.8
    assert result.precision >= 0.8
    assert (tmp_path / "run" / "curve.png").read_bytes().startswith(b"\x89PNG")
    record = json.loads((tmp_path / "run" / RECORD).read_text())
    assert record["counts"] == result.counts
    assert record["counts"]["training_pictures"] == 18
    assert record["counts"]["skipped"] == 1
    assert record["skipped"] == ["one line"]
    assert record["settings"]["epochs"] == 12
    _check_found(result, tmp_path / "pictures")


def _check_found(result: TrainResult, pictures: Path) -> None:
    """The model file finds the square of a picture, with nothing but what the file says."""
    session = onnxruntime.InferenceSession(result.model, providers=["CPUExecutionProvider"])
    said = session.get_modelmeta().custom_metadata_map
    assert {name: said[name] for name in ("valuemap.kind", "valuemap.classes", "valuemap.color")} == {
        "valuemap.kind": "segmentation",
        "valuemap.classes": '["square"]',
        "valuemap.color": "RGB",
    }
    assert float(said["valuemap.threshold"]) == result.threshold
    pixels = np.asarray(Image.open(pictures / "0.png"), np.float32) / 255.0
    normal = (pixels - json.loads(said["valuemap.mean"])) / json.loads(said["valuemap.std"])
    (probability,) = session.run(None, {"image": normal.transpose(2, 0, 1)[None].astype(np.float32)})
    rows, columns = np.nonzero(probability[0, 0] >= result.threshold)
    bright_rows, bright_columns = np.nonzero(pixels[..., 0] > 0.5)
    assert abs(rows.mean() - bright_rows.mean()) < 2.0
    assert abs(columns.mean() - bright_columns.mean()) < 2.0


def test_a_resumed_run_has_the_losses_of_one_that_was_not_stopped(tmp_path: Path) -> None:
    pictures = squares(tmp_path / "pictures", 12)
    train([pictures], tmp_path / "whole", TINY, seed=3)

    def stop(what: str, done: int, total: int) -> None:
        if what.startswith("epoch 2") and done == total:
            raise _Stop

    with pytest.raises(_Stop):
        train([pictures], tmp_path / "parts", TINY, seed=3, progress=stop)
    assert len(metrics(tmp_path / "parts")) == 1
    train([pictures], tmp_path / "parts", TINY, seed=3, resume=True)
    assert metrics(tmp_path / "parts") == metrics(tmp_path / "whole")
    models = [(tmp_path / run / "model.onnx").read_bytes() for run in ("parts", "whole")]
    assert models[0] == models[1]
    # Nothing is left to do: the same again.
    train([pictures], tmp_path / "whole", TINY, seed=3, resume=True)
    assert metrics(tmp_path / "parts") == metrics(tmp_path / "whole")


def test_a_gpu_too_adds_up_in_a_fixed_order(tmp_path: Path) -> None:
    """There sums have none by themselves: the same seed would give another network each time."""
    is_fixed = set()

    def told(what: str, _: int, __: int) -> None:
        if what.startswith("epoch"):
            is_fixed.add(torch.are_deterministic_algorithms_enabled())

    config = replace(TINY, epochs=1)
    models = [train([squares(tmp_path / "pictures", 8)], tmp_path / run, config, progress=told).model for run in "ab"]
    assert is_fixed == {True}
    assert not torch.are_deterministic_algorithms_enabled()
    assert models[0].read_bytes() == models[1].read_bytes()


def test_another_seed_is_another_run(tmp_path: Path) -> None:
    pictures = squares(tmp_path / "pictures", 8)
    config = replace(TINY, epochs=1)
    for seed in (0, 1):
        train([pictures], tmp_path / str(seed), config, seed=seed)
    assert metrics(tmp_path / "0") != metrics(tmp_path / "1")


def test_a_run_is_only_gone_on_with_if_that_is_said_and_nothing_changed(tmp_path: Path) -> None:
    pictures, run = squares(tmp_path / "pictures", 8), tmp_path / "run"
    config = replace(TINY, epochs=1)
    with pytest.raises(InputError, match="there is no training run to go on with"):
        train([pictures], run, config, resume=True)
    assert not run.exists()
    train([pictures], run, config)
    before = (run / "model.onnx").read_bytes()
    with pytest.raises(OutputError, match="holds a training run or a model already") as refusal:
        train([pictures], run, config)
    assert "--resume" in refusal.value.hint
    with pytest.raises(SettingError, match="is of a run with another epochs: 1, now 2"):
        train([pictures], run, replace(config, epochs=2), resume=True)
    with pytest.raises(SettingError, match="is of a run with another seed: 0, now 1"):
        train([pictures], run, config, seed=1, resume=True)
    fewer = replace(pictures, pictures=pictures.pictures[1:])
    with pytest.raises(SettingError, match="is of a run with another pictures"):
        train([fewer], run, config, resume=True)
    (run / "checkpoint.pt").write_bytes(b"damaged")
    with pytest.raises(InputError, match="cannot be read as a checkpoint"):
        train([pictures], run, config, resume=True)
    assert (run / "model.onnx").read_bytes() == before


def test_a_run_stopped_in_its_first_epoch_goes_on_from_the_start(tmp_path: Path) -> None:
    pictures, config = squares(tmp_path / "pictures", 8), replace(TINY, epochs=1)

    def stop(what: str, _: int, __: int) -> None:
        if what.startswith("epoch 1"):
            raise _Stop

    with pytest.raises(_Stop):
        train([pictures], tmp_path / "run", config, progress=stop)
    train([pictures], tmp_path / "run", config, resume=True)
    assert len(metrics(tmp_path / "run")) == 1


def half_precision(pictures: LabelledPictures) -> Training:
    """A training as on a GPU: autocast and a scale of the loss, which PyTorch has for the CPU too."""
    data = prepare_data([pictures], TINY, one_class=None, seed=0, progress=silent)
    training = Training(data, TINY, seed=0, threads=0)
    training.is_mixed, training.scaler = True, torch.amp.GradScaler(training.device.type, growth_interval=2)
    return training


def test_half_precision_keeps_its_scale_of_the_loss(tmp_path: Path) -> None:
    pictures = squares(tmp_path / "pictures", 8)
    first = half_precision(pictures)
    first.run_epoch(silent)
    first.save(tmp_path / "checkpoint.pt")
    scale = first.scaler.get_scale()
    # Two steps without an overflow double it; on a GPU the first steps overflow, and halve it.
    assert scale != torch.amp.GradScaler(first.device.type).get_scale()
    second = half_precision(pictures)
    second.load(tmp_path / "checkpoint.pt")
    assert second.scaler.get_scale() == scale
    for training in (first, second):
        training.run_epoch(silent)
    assert replace(first.history[1], seconds=0.0) == replace(second.history[1], seconds=0.0)
    assert np.isfinite(first.history[1].training_loss)


def test_a_run_begun_without_half_precision_goes_on_with_it(tmp_path: Path) -> None:
    pictures = squares(tmp_path / "pictures", 8)
    train([pictures], tmp_path / "run", replace(TINY, epochs=3))
    training = half_precision(pictures)
    training.load(tmp_path / "run" / "checkpoint.pt")
    training.run_epoch(silent)
    assert len(training.history) == 4


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[FCDenseNet, Path]:
    """A network with weights at random and statistics that are not those of the start, and its file."""
    torch.manual_seed(1)
    network: Any = FCDenseNet(2, replace(TINY, levels=4))
    for name, value in network.named_buffers():
        if name.endswith(("mean", "var")):
            value.copy_(torch.rand_like(value) + 0.5)
    path = tmp_path_factory.mktemp("exported") / "model.onnx"
    export_onnx(network, path, classes=["a", "b"], threshold=0.35, minimum_component_px=7)
    return network, path


@pytest.mark.parametrize("shape", [(1, 3, 32, 32), (2, 3, 96, 64), (3, 3, 32, 160)])
def test_the_file_says_what_the_network_says(exported: tuple[Any, Path], shape: tuple[int, ...]) -> None:
    network, path = exported
    image = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (probability,) = session.run(["probability"], {"image": image})
    with torch.no_grad():
        expected = torch.sigmoid(network.eval()(torch.from_numpy(image))).numpy()
    assert probability.shape == (shape[0], 2, *shape[2:])
    assert np.abs(probability - expected).max() < 1e-5


def test_the_file_names_its_dimensions_and_itself_and_no_place_of_this_machine(exported: tuple[Any, Path]) -> None:
    _, path = exported
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    dims = [
        [d.dim_param or d.dim_value for d in value.type.tensor_type.shape.dim]
        for value in (model.graph.input[0], model.graph.output[0])
    ]
    assert dims == [["batch", 3, "height", "width"], ["batch", 2, "height", "width"]]
    assert {entry.key: entry.value for entry in model.metadata_props} == {
        "valuemap.kind": "segmentation",
        "valuemap.classes": '["a", "b"]',
        "valuemap.threshold": "0.35",
        "valuemap.mean": "[0.485, 0.456, 0.406]",
        "valuemap.std": "[0.229, 0.224, 0.225]",
        "valuemap.color": "RGB",
        "valuemap.minimum_component_px": "7",
        "valuemap.min_coarse_share": "0.04",
    }
    assert b"fc_densenet.py" not in path.read_bytes()
    assert str(Path.home()).encode() not in path.read_bytes()
