"""The loop of training: steps, validation, checkpoints. Importing this needs PyTorch."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from valuemap.config import TrainConfig
from valuemap.detect.export_onnx import export_onnx
from valuemap.detect.fc_densenet import FCDenseNet
from valuemap.detect.samples import TrainingData, batches, edges_of, whole
from valuemap.detect.threshold import ThresholdSearch
from valuemap.errors import InputError, SettingError
from valuemap.folders import new_file
from valuemap.progress import Progress

_WARM_UP = 0.05
_MAX_GRADIENT = 5.0


@dataclass(frozen=True)
class Epoch:
    """The figures of one epoch: a row of metrics.csv. Recall and precision are at the best threshold, IoU 0.3."""

    epoch: int
    training_loss: float
    validation_loss: float
    threshold: float
    recall: float
    precision: float
    seconds: float

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision."""
        return 2.0 * self.recall * self.precision / max(self.recall + self.precision, 1e-12)


def loss_sums(logits: Tensor, target: Tensor, weight: Tensor, focal_power: float) -> Tensor:
    """Return the sums over pictures and pixels that `loss_of` makes a loss of; those of parts add up.

    Parameters
    ----------
    logits, target, weight
        (batch, classes, height, width); target 0 or 1.

    Returns
    -------
    Tensor
        (4, classes): focal loss, weight of the objects' pixels, sum of p t, sum of p + t.
    """
    logits = logits.float()
    entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    probability = torch.sigmoid(logits)
    right = probability * target + (1.0 - probability) * (1.0 - target)
    focal = (1.0 - right) ** focal_power * entropy
    pixels = (0, 2, 3)
    return torch.stack(
        [
            (weight * focal).sum(pixels),
            (weight * target).sum(pixels),
            (weight * probability * target).sum(pixels),
            (weight * (probability + target)).sum(pixels),
        ]
    )


def loss_of(sums: Tensor) -> Tensor:
    """Return focal loss a pixel of objects, plus Dice loss: both stay in balance however rare objects are.

    Lin et al. 2017, "Focal Loss for Dense Object Detection": sum over all pixels of (1 - p)^power times the
    cross-entropy, p the probability of what is true, over the number of pixels of objects. Milletari et al. 2016,
    "V-Net": 1 - 2 sum(p t) / sum(p + t), a class.
    """
    focal, objects, common, both = sums
    loss: Tensor = focal.sum() / objects.sum().clamp(min=1.0) + (1.0 - (2.0 * common + 1.0) / (both + 1.0)).mean()
    return loss


@contextmanager
def _in_fixed_order() -> Iterator[None]:
    """Let PyTorch add up in a fixed order: on a GPU it does not by itself, and a seed would give many networks."""
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    memory: Any = torch.utils.deterministic
    is_filled = memory.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    memory.fill_uninitialized_memory = False  # It would take a sixth of the time, for memory that nothing reads.
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
        memory.fill_uninitialized_memory = is_filled


class Training:
    """The network, its optimiser and the figures so far; everything that a checkpoint holds.

    What an epoch sees depends on seed and epoch only, so that a checkpoint needs no state of random numbers.
    """

    def __init__(self, data: TrainingData, config: TrainConfig, *, seed: int, threads: int) -> None:
        if threads:
            torch.set_num_threads(threads)
        self.data, self.config, self.seed = data, config, seed
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.manual_seed(seed)
        network = FCDenseNet(len(data.classes), config)
        self.network = network.to(self.device, memory_format=torch.channels_last)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        # Half precision is faster on a GPU only; the scaler does nothing elsewhere.
        self.is_mixed = self.device.type == "cuda"
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=self.is_mixed)
        self.history: list[Epoch] = []
        self.best_weights: dict[str, Any] = {}

    @property
    def best(self) -> Epoch:
        """The epoch of the model: the best on the validation pictures, of equals the one with less loss."""
        return max(self.history, key=lambda epoch: (epoch.f1, -epoch.validation_loss))

    def run_epoch(self, progress: Progress) -> None:
        """Train on every picture, validate, and note the figures."""
        start = time.perf_counter()
        epoch = len(self.history) + 1
        with _in_fixed_order():
            training_loss = self._train(epoch, progress)
            validation_loss, search = self._validate(epoch, progress)
        threshold, recall, precision = search.best()
        seconds = round(time.perf_counter() - start, 1)
        self.history.append(Epoch(epoch, training_loss, validation_loss, threshold, recall, precision, seconds))
        if self.best.epoch == epoch:
            self.best_weights = {name: value.cpu().clone() for name, value in self.network.state_dict().items()}

    def save(self, path: Path) -> None:
        """Write the checkpoint, whole or not at all."""
        state = {
            "identity": self._identity(),
            "history": [dataclasses.asdict(epoch) for epoch in self.history],
            "network": self.network.state_dict(),
            "best": self.best_weights,
            "optimiser": self.optimiser.state_dict(),
            "scaler": self.scaler.state_dict(),
        }
        with new_file(path) as temporary:
            torch.save(state, temporary)

    def load(self, path: Path) -> None:
        """Take everything from a checkpoint.

        Raises
        ------
        InputError
            It cannot be read.
        SettingError
            It is of other settings, pictures, or another seed.
        """
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            identity = state["identity"]
        except Exception as error:  # What a damaged file raises depends on where the damage is.
            reason = str(error).splitlines()[0] if str(error) else repr(error)
            raise InputError(
                f"{path}: cannot be read as a checkpoint: {reason}", hint="remove the folder and train again"
            ) from error
        own = self._identity()
        other = sorted(name for name in own if identity.get(name) != own[name])
        if other:
            raise SettingError(
                f"{path}: is of a run with another {other[0]}: {identity.get(other[0])}, now {own[other[0]]}",
                hint="resume with the settings, pictures and seed of that run, or train into another folder",
            )
        self.history = [Epoch(**row) for row in state["history"]]
        self.network.load_state_dict(state["network"])
        self.best_weights = state["best"]
        self.optimiser.load_state_dict(state["optimiser"])
        if state["scaler"]:  # Empty, if the run was begun without half precision.
            self.scaler.load_state_dict(state["scaler"])

    def export(self, path: Path) -> None:
        """Write the network of the best epoch as ONNX."""
        network = FCDenseNet(len(self.data.classes), self.config)
        network.load_state_dict(self.best_weights)
        export_onnx(
            network,
            path,
            classes=self.data.classes,
            threshold=self.best.threshold,
            minimum_component_px=self.config.minimum_component_px,
        )

    def _identity(self) -> dict[str, Any]:
        return {"seed": self.seed, **dataclasses.asdict(self.config), "pictures": self.data.digest()}

    def _train(self, epoch: int, progress: Progress) -> float:
        self.network.train()
        torch.manual_seed(self.seed * 1_000_003 + epoch)  # For the dropout.
        steps = math.ceil(len(self.data.training) * self.config.cutouts / self.config.batch)
        losses = []
        what = f"epoch {epoch} of {self.config.epochs}: train"
        progress(what, 0, steps)
        for step, arrays in enumerate(batches(self.data, self.config, seed=self.seed, epoch=epoch)):
            rate = self._learning_rate((epoch - 1 + step / steps) / self.config.epochs)
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            image, target, weight = (self._to_device(array) for array in arrays)
            with torch.autocast(self.device.type, enabled=self.is_mixed):
                logits = self.network(image)
            loss = loss_of(loss_sums(logits, target, weight, self.config.focal_power))
            self.optimiser.zero_grad()
            self.scaler.scale(loss).backward()
            self.scaler.unscale_(self.optimiser)
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT)
            self.scaler.step(self.optimiser)
            self.scaler.update()
            losses.append(loss.item())
            progress(what, step + 1, steps)
        return float(sum(losses) / len(losses))

    @torch.no_grad()
    def _validate(self, epoch: int, progress: Progress) -> tuple[float, ThresholdSearch]:
        self.network.eval()
        search = ThresholdSearch(self.config.minimum_component_px)
        sums = torch.zeros(4, len(self.data.classes), dtype=torch.float64, device=self.device)
        what = f"epoch {epoch} of {self.config.epochs}: validate"
        progress(what, 0, len(self.data.validation))
        for row, picture in enumerate(self.data.validation):
            sample, fit = whole(self.data, row, self.config)
            image, target, weight = (self._to_device(a[None]) for a in (sample.image, sample.target, sample.weight))
            with torch.autocast(self.device.type, enabled=self.is_mixed):
                logits = self.network(image)
            sums += loss_sums(logits, target, weight, self.config.focal_power)
            width, height = fit.resized
            probability = torch.sigmoid(logits.float())[0, :, :height, :width].cpu().numpy()
            search.add(probability, edges_of(picture.boxes_px), self.data.codes(picture), edges_of(picture.ignored_px))
            progress(what, row + 1, len(self.data.validation))
        return loss_of(sums).item(), search

    def _learning_rate(self, done: float) -> float:
        """Return the rate when this share of all steps is done: a short rise, then half a cosine."""
        rise = min(1.0, (done + 1e-3) / _WARM_UP)
        fall = 0.5 * (1.0 + math.cos(math.pi * max(0.0, done - _WARM_UP) / (1.0 - _WARM_UP)))
        return self.config.learning_rate * rise * fall

    def _to_device(self, array: Any) -> Tensor:
        return torch.from_numpy(array).to(self.device, memory_format=torch.channels_last)
