"""Training a segmentation network on labelled pictures: what goes in, and the folder that comes out.

The folder of a run holds `checkpoint.pt` (the last epoch, to resume from), `metrics.csv` (a row an epoch),
`curve.png`, `train.json` (settings, counts, what was left out) and, at the end, `model.onnx`. PyTorch is imported
only when training begins.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valuemap.config import TrainConfig, bounded_threads
from valuemap.detect.labels import LabelledPictures
from valuemap.detect.samples import TrainingData, prepare_data
from valuemap.errors import InputError, OutputError, ValuemapError
from valuemap.folders import new_file
from valuemap.progress import Progress, silent

if TYPE_CHECKING:
    from valuemap.detect.training import Epoch

CHECKPOINT = "checkpoint.pt"
MODEL = "model.onnx"
RECORD = "train.json"
"""The record of a run. It is not called run.json, as that file makes a folder a map."""
_CURVES = (("loss", ("training_loss", "validation_loss")), ("share at IoU 0.3", ("recall", "precision")))


@dataclass(frozen=True)
class TrainResult:
    """What a training run gave: the model, the validation figures of its epoch, and counts of the pictures.

    `skipped` has a line for each picture or label that was left out.
    """

    model: Path
    epoch: int
    epochs: int
    threshold: float
    recall: float
    precision: float
    counts: dict[str, int]
    skipped: tuple[str, ...]


def train(
    labels: Sequence[LabelledPictures],
    run: Path,
    config: TrainConfig | None = None,
    *,
    resume: bool = False,
    one_class: str | None = None,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = silent,
) -> TrainResult:
    """Train a fully convolutional DenseNet and write it as ONNX, with the threshold that validates best.

    Parameters
    ----------
    labels
        Pictures of one or more sources; those of the split `test` are left alone.
    run
        Folder for checkpoints, metrics and the model.
    config
        Settings; the defaults where not given.
    resume
        Go on after the last finished epoch of `run`, from the start if it has none. The losses are those of a run
        without interruption.
    one_class
        Take every label as this class; otherwise every class of the labels has an output of its own.
    seed
        Of the network's first weights, the split and all variation. On one kind of machine and GPU the same seed
        gives the same network.
    threads
        Threads of the network, 0 as PyTorch chooses.
    progress
        Called as progress(what, done, total).

    Raises
    ------
    ValuemapError
        PyTorch is not installed.
    InputError
        There are too few usable pictures, or no run to resume, or its checkpoint is damaged.
    SettingError
        The run to resume had other settings, pictures or another seed.
    OutputError
        `run` holds a run or a model already and `resume` is not said, or cannot be written.
    """
    if importlib.util.find_spec("torch") is None or importlib.util.find_spec("onnxscript") is None:
        raise ValuemapError(
            "training needs PyTorch and onnxscript, which are not installed",
            hint="install the extra: pip install 'valuemap[train]', or make setup EXTRAS=train in a clone",
        )
    from valuemap.detect.training import Training  # PyTorch is large, slow to import and an extra.

    config, threads = config or TrainConfig(), bounded_threads(threads)
    checkpoint = run / CHECKPOINT
    if not resume and any((run / name).exists() for name in (CHECKPOINT, MODEL)):
        raise OutputError(
            f"{run}: holds a training run or a model already", hint="go on with --resume, or choose another --out"
        )
    if resume and not checkpoint.exists() and not (run / RECORD).exists():
        raise InputError(f"{run}: there is no training run to go on with", hint="check --out, or leave --resume away")
    data = prepare_data(labels, config, one_class=one_class, seed=seed, progress=progress)
    training = Training(data, config, seed=seed, threads=threads)
    if resume and checkpoint.exists():
        training.load(checkpoint)
    _write_record(run, data, config, seed, training.history)
    while len(training.history) < config.epochs:
        training.run_epoch(progress)
        training.save(checkpoint)
        _write_metrics(run / "metrics.csv", training.history)
    _draw_curves(run / "curve.png", training.history)
    training.export(run / MODEL)
    _write_record(run, data, config, seed, training.history)
    best = training.best
    return TrainResult(
        run / MODEL,
        best.epoch,
        len(training.history),
        best.threshold,
        best.recall,
        best.precision,
        _counts(data),
        data.skipped,
    )


def _counts(data: TrainingData) -> dict[str, int]:
    return {
        "training_pictures": len(data.training),
        "training_boxes": sum(len(picture.classes) for picture in data.training),
        "validation_pictures": len(data.validation),
        "validation_boxes": sum(len(picture.classes) for picture in data.validation),
        "test_pictures_left_alone": data.test_pictures,
        "skipped": len(data.skipped),
    }


def _write_record(run: Path, data: TrainingData, config: TrainConfig, seed: int, history: Sequence[Epoch]) -> None:
    record: dict[str, Any] = {
        "valuemap": version("valuemap"),
        "settings": dataclasses.asdict(config),
        "seed": seed,
        "classes": data.classes,
        "counts": _counts(data),
        "skipped": data.skipped,
        "epochs": len(history),
        "seconds": round(sum(epoch.seconds for epoch in history), 1),
    }
    with new_file(run / RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def _write_metrics(path: Path, history: Sequence[Epoch]) -> None:
    rows = [dataclasses.asdict(epoch) for epoch in history]
    with new_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _draw_curves(path: Path, history: Sequence[Epoch]) -> None:
    from matplotlib.figure import Figure  # Slow to import.

    figure = Figure(figsize=(10.0, 4.0), dpi=120, layout="constrained")
    for axes, (title, names) in zip(figure.subplots(1, 2), _CURVES, strict=True):
        for name in names:
            axes.plot([e.epoch for e in history], [getattr(e, name) for e in history], label=name.replace("_", " "))
        axes.set_xlabel("epoch")
        axes.set_title(title)
        axes.grid(alpha=0.3)
        axes.legend()
    with new_file(path) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None})
