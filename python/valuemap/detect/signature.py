"""What an ONNX file is, told from the names and shapes of its inputs and outputs, and from its metadata."""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from valuemap.config import ModelKind
from valuemap.detect.coco_names import COCO_80, COCO_91
from valuemap.detect.letterbox import Fitting, Size
from valuemap.errors import InputError

KIND_HINT = f"say what it is with --kind: one of {', '.join(get_args(ModelKind))}"
ANCHOR_STRIDES = ((8, 16, 32), (8, 16, 32, 64))
"""Of YOLO, in px: a cell a square of each, from the smallest on."""
SIZES_INPUT = "orig_target_sizes"
"""The second input of RT-DETR and its kin: width and height that their boxes are to be in."""
TENSORFLOW = frozenset({"detection_boxes", "detection_scores", "detection_classes"})
"""Outputs of TensorFlow's models."""
_ANCHORS_A_CELL = 3
"""Of YOLOv5 and YOLOv7."""
_MOST_SUPPRESSED = 1000
"""Rows that a graph leaves after its suppression are fewer, cells of a picture are more."""
_FLAT_COLUMNS = 7
"""Of boxes of all pictures of a batch below each other: number of the picture, edges, and score and class."""
_TASKS = ("", "detect", "segment", "pose")
"""Of Ultralytics: those that have upright boxes."""
_RTDETR_QUERIES = 300
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_TO_255 = (1 / 255, 1 / 255, 1 / 255)


@dataclass(frozen=True)
class Preparation:
    """How pixels become numbers: (pixel / 255 - mean) / std in the order of `color`, and where the picture goes."""

    color: str = "RGB"
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    fitting: Fitting = "corner"


_PREPARATIONS: Mapping[str, Preparation] = {
    "segmentation": Preparation(),
    "yolox": Preparation(color="BGR", std=_TO_255),
    "yolov5": Preparation(fitting="center"),
    "ultralytics": Preparation(fitting="center"),
    "rtdetr": Preparation(fitting="stretch"),
    "detr": Preparation(mean=_IMAGENET_MEAN, std=_IMAGENET_STD, fitting="stretch"),
    "boxes": Preparation(),
}
"""What each kind expects where the file does not say it."""


def plain_name(entry: Any) -> str:
    """Return the name of an input or output without what TensorFlow puts behind it."""
    return str(entry.name).partition(":")[0].lower()


def anchor_counts(canvas: Size) -> tuple[int, ...]:
    """Return how many cells of all strides a canvas may have."""
    width, height = canvas
    return tuple(sum((height // s) * (width // s) for s in strides) for strides in ANCHOR_STRIDES)


def recognise(
    path: Path, outputs: Sequence[Any], metadata: Mapping[str, str], names: Sequence[str], canvas: Size | None
) -> str:
    """Tell the kind from the outputs; `names` are those of the classes in the metadata, `canvas` a fixed size.

    Raises
    ------
    InputError
        It cannot be told.
    """
    task = metadata.get("task", "")
    if task not in _TASKS:
        raise InputError(
            f"{path}: is a model for the task {task}, expected one that finds upright boxes",
            hint=f"export a model for one of {', '.join(_TASKS[1:])}",
        )
    ranks = [len(output.shape) for output in outputs]
    named = {plain_name(output): output for output in outputs}
    has_ints = any("int" in output.type for output in outputs)
    if any("logits" in name for name in named) and any("boxes" in name for name in named):
        return "detr"
    if not has_ints and {"dets", "labels"} <= named.keys() and len(named["labels"].shape) == 3:
        return "detr"  # RF-DETR.
    if named.keys() >= TENSORFLOW:
        return "boxes"
    if has_ints and (len(outputs) >= 3 or is_of_mmdeploy(outputs)):
        return "boxes"  # Others, as torchvision's masks, are left alone.
    if ranks == [4]:
        return "segmentation"
    if ranks in ([3], [3, 4]):  # The second one is what masks are made of.
        rows, columns = outputs[0].shape[1:]
        kind = (
            _named_table(rows, columns, metadata, names, has_more=task in ("segment", "pose") or ranks == [3, 4])
            if names
            else _table(rows, columns, canvas, has_masks=ranks == [3, 4])
        )
        if kind is not None:
            return kind
    found = ", ".join(f"{output.name} {output.shape}" for output in outputs)
    hint = KIND_HINT
    if ranks == [2] and outputs[0].shape[1] == _FLAT_COLUMNS:
        hint = (
            "YOLOv7 and YOLO-NAS have their seven columns in other orders: export YOLOv7 without --end2end, YOLO-NAS "
        )
        hint += "with output_predictions_format BATCH_FORMAT"
    raise InputError(f"{path}: cannot tell what the outputs mean: {found}", hint=hint)


def _named_table(
    rows: Any, columns: Any, metadata: Mapping[str, str], names: Sequence[str], *, has_more: bool
) -> str | None:
    """Tell a table by the number of its classes; with `has_more` it has numbers for masks or key points too."""
    count = len(names)
    is_long = not isinstance(columns, int) or (isinstance(rows, int) and columns > rows)
    if isinstance(rows, int) and (rows == 4 + count or (has_more and rows > 4 + count and is_long)):
        return "ultralytics"
    if isinstance(rows, int) and rows <= _MOST_SUPPRESSED:
        is_rtdetr = "rtdetr" in metadata.get("description", "").lower()
        if is_rtdetr or (columns == 4 + count and columns != 6):
            return "rtdetr"
        # With free sizes Ultralytics declares the columns as free too.
        is_wider = not isinstance(columns, int) or (has_more and columns > 6)
        return "boxes" if columns == 6 or (is_wider and "task" in metadata) else None
    if isinstance(columns, int) and (columns == 5 + count or (has_more and columns > 5 + count)):
        return "yolov5"
    return None


def _table(rows: Any, columns: Any, canvas: Size | None, *, has_masks: bool) -> str | None:
    """Tell a table of which nobody says how many classes it has."""
    if has_masks:
        return None
    cells = () if canvas is None else anchor_counts(canvas)
    if isinstance(columns, int) and columns >= 6 and rows in [_ANCHORS_A_CELL * count for count in cells]:
        return "yolov5"
    if columns == 6 and rows not in cells:
        return None if isinstance(rows, int) and rows > _MOST_SUPPRESSED else "boxes"
    if isinstance(rows, int) and (not isinstance(columns, int) or rows < columns):
        return "ultralytics"
    return "yolox" if isinstance(columns, int) else None


def is_of_mmdeploy(outputs: Sequence[Any]) -> bool:
    """Say whether boxes have their scores as a fifth column."""
    found = {plain_name(output): output.shape for output in outputs}
    return "labels" in found and len(found.get("dets", ())) == 3 and found["dets"][-1] == 5


def class_count(kind: str, outputs: Sequence[Any], names: Sequence[str]) -> int | None:
    """Return how many classes the outputs have room for, with DETR's "nothing"; None if they do not say.

    Behind the `names` that the metadata have, there are numbers for masks or key points.
    """
    if kind == "boxes":
        return None
    axis, other = {
        "segmentation": (1, 0),
        "yolox": (2, 5),
        "yolov5": (2, 5),
        "ultralytics": (1, 4),
        "rtdetr": (2, 4),
        "detr": (2, 0),
    }[kind]
    output = next((o for o in outputs if kind == "detr" and is_logits(plain_name(o))), outputs[0])
    entries = output.shape[axis] if len(output.shape) > axis else None
    count = entries - other if isinstance(entries, int) else None
    return len(names) if names and kind in ("yolov5", "ultralytics", "rtdetr") else count


def is_logits(name: str) -> bool:
    """Say whether an output of a DETR has the scores, by its name."""
    return "logits" in name or name == "labels"


def is_places(name: str) -> bool:
    """Say whether an output of a DETR has the boxes, by its name."""
    return "boxes" in name or name == "dets"


def names_in(path: Path, metadata: Mapping[str, str]) -> tuple[str, ...]:
    """Return the names of the classes that the file says, if it does.

    Raises
    ------
    InputError
        They cannot be read.
    """
    try:
        if "valuemap.classes" in metadata:
            return tuple(str(name) for name in json.loads(metadata["valuemap.classes"]))
        if "names" in metadata:  # Ultralytics writes a Python dict, YOLOv5 of 2021 a list.
            entries = ast.literal_eval(metadata["names"])
            pairs = enumerate(entries) if isinstance(entries, list) else dict(entries).items()
            named = {int(i): str(name) for i, name in pairs}
            return tuple(named.get(i, f"class-{i}") for i in range(max(named) + 1))
    except (ValueError, TypeError, SyntaxError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{path}: the names of the classes in its metadata cannot be read: {error}", hint="export it again"
        ) from error
    return ()


def coco_names(count: int | None) -> tuple[str, ...]:
    """Return COCO's names if there are so many, else none."""
    return {80: COCO_80, 91: COCO_91, 92: COCO_91}.get(count or 0, ())


def preparation_of(
    path: Path, kind: str, inputs: Sequence[Any], outputs: Sequence[Any], metadata: Mapping[str, str]
) -> Preparation:
    """Return how the file wants pictures.

    Raises
    ------
    InputError
        What the metadata say is damaged, or they must say it and do not.
    """
    default = _preparation_by_shapes(kind, inputs, outputs)
    if kind == "boxes" and is_of_mmdeploy(outputs) and not {"valuemap.mean", "valuemap.std"} <= metadata.keys():
        raise InputError(
            f"{path}: is of MMDeploy, whose files do not say how the colours of pictures become numbers",
            hint="write mean, std and order of its pipeline into the metadata: valuemap.mean, valuemap.std (of values "
            "from 0 to 1) and valuemap.color, as docs/detect.md shows",
        )
    try:
        mean, std = (
            tuple(float(c) for c in json.loads(metadata[f"valuemap.{name}"])) if f"valuemap.{name}" in metadata else own
            for name, own in (("mean", default.mean), ("std", default.std))
        )
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: metadata valuemap.mean, valuemap.std: {error}", hint="export it again") from error
    color = metadata.get("valuemap.color", default.color)
    if color not in ("RGB", "BGR") or len(mean) != 3 or len(std) != 3 or not all(std):
        raise InputError(
            f"{path}: metadata: expected valuemap.color RGB or BGR, and 3 numbers in valuemap.mean and valuemap.std",
            hint="export it again",
        )
    return Preparation(color, mean, std, default.fitting)


def _preparation_by_shapes(kind: str, inputs: Sequence[Any], outputs: Sequence[Any]) -> Preparation:
    """Return how models of such inputs and outputs are trained."""
    if inputs[0].type == "tensor(uint8)":  # What comes before the network is in the graph.
        return Preparation(std=_TO_255, fitting=_PREPARATIONS[kind].fitting)
    if kind == "boxes" and any(plain_name(entry) == SIZES_INPUT for entry in inputs):
        return Preparation(fitting="stretch")
    if kind == "detr" and _is_rtdetr(outputs):
        return Preparation(fitting="stretch")
    # Detectron2 also gives the size of the picture.
    if kind == "boxes" and any("int" in output.type and output.shape == [2] for output in outputs):
        return Preparation(color="BGR", std=_TO_255)
    return _PREPARATIONS[kind]


def _is_rtdetr(outputs: Sequence[Any]) -> bool:
    """Say whether a DETR is RT-DETR or D-FINE with COCO's classes, of which others have 91, or 900 queries."""
    logits = next((output for output in outputs if is_logits(plain_name(output))), None)
    if logits is None or len(logits.shape) != 3 or logits.shape[2] != len(COCO_80):
        return False
    queries = logits.shape[1]
    return queries == _RTDETR_QUERIES or (not isinstance(queries, int) and plain_name(logits) == "logits")
