"""What each kind of network says, as boxes of the picture: one function a kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints
from valuemap.detect.boxes import Boxes, suppress
from valuemap.detect.classes import WantedClasses
from valuemap.detect.components import boxes_of_components
from valuemap.detect.letterbox import Fit
from valuemap.detect.model import Model
from valuemap.detect.signature import ANCHOR_STRIDES, TENSORFLOW, anchor_counts, is_logits, is_places, plain_name
from valuemap.errors import InputError

Array = NDArray[Any]

_LARGEST_LOG = 16.0
"""Of the size of a box in strides: it would be millions of pixels wide."""
_ROUNDING = 0.01
"""Of scores from 0 to 1, and of classes that are floats."""
_LARGEST_SHARE = 1.5
"""Edges of boxes that all are smaller than this many pixels are shares of the picture."""
_MAX_CANDIDATES = 3000
"""Boxes of one canvas that go into the suppression, best first: bounds the cost where every score is accepted."""


def find_boxes(
    model: Model, outputs: list[Array], row: int, fit: Fit, wanted: WantedClasses, *, min_score: float, max_iou: float
) -> Boxes:
    """Return the boxes of one row of a batch, in pixels of the picture that was on the canvas.

    Raises
    ------
    InputError
        The outputs are not what the kind of model has.
    """
    boxes = _DECODERS[model.kind](model, outputs, row, fit, wanted)
    boxes = boxes.take(boxes.score >= min_score)
    boxes = boxes.take(np.argsort(-boxes.score, kind="stable")[:_MAX_CANDIDATES])
    boxes = Boxes(boxes.center_px, boxes.size_px, boxes.score, wanted.one_a_name(boxes.class_code))
    if model.kind in ("yolox", "yolov5", "ultralytics"):
        boxes = boxes.take(suppress(boxes, max_iou))
    return fit.to_picture(boxes).clipped(*fit.picture)


def _from_segmentation(model: Model, outputs: list[Array], row: int, fit: Fit, wanted: WantedClasses) -> Boxes:
    """Make connected pixels (8 neighbours) of at least the threshold one object; its score is their mean."""
    if outputs[0].ndim != 4:
        raise _unexpected(model, outputs, "[batch, classes, height, width]")
    maps = np.asarray(outputs[0][row], np.float32)
    _check_shares(model, maps)
    # A map may be coarser than the canvas; and of the padding nothing is wanted.
    cell_px = np.array(fit.canvas, np.float64) / maps.shape[:0:-1]
    low = np.floor(np.array(fit.offset) / cell_px).astype(int)
    high = np.ceil((np.array(fit.offset) + fit.resized) / cell_px).astype(int)
    parts = []
    for number in wanted.columns(len(maps)):
        probability = maps[number, low[1] : high[1], low[0] : high[0]]
        found = boxes_of_components(probability, model.threshold, model.minimum_component_px)
        center_px = (found.center_px + low) * cell_px
        parts.append(Boxes(center_px, found.size_px * cell_px, found.score, np.full(len(found), number)))
    return Boxes.together(parts)


def _from_yolox(model: Model, outputs: list[Array], row: int, fit: Fit, wanted: WantedClasses) -> Boxes:
    """Ge et al., "YOLOX", 2021: xy = (o + grid) stride, wh = exp(o) stride, score = objectness times class."""
    if outputs[0].ndim != 3 or outputs[0].shape[2] <= 5:
        raise _unexpected(model, outputs, "[batch, anchors, 5 + classes]")
    raw = np.asarray(outputs[0][row], np.float64)
    cell, stride_px = _yolox_grid(model, outputs, fit)
    if raw[:, 2:4].max(initial=0.0) > _LARGEST_LOG:
        raise InputError(
            f"{model.path}: gives boxes in pixels, not what YOLOX gives, sizes up to {raw[:, 2:4].max():.0f}",
            hint="--kind yolov5 reads such boxes of YOLOv5, YOLOv6 and YOLOv7; "
            "export YOLOX without --decode_in_inference",
        )
    score, number = _best_class(model, raw[:, 5:], wanted)
    with np.errstate(over="ignore"):  # Boxes of infinite size are dropped.
        size_px = np.exp(raw[:, 2:4]) * stride_px
    return _from_centers((raw[:, :2] + cell) * stride_px, size_px, raw[:, 4] * score, number)


def _yolox_grid(model: Model, outputs: list[Array], fit: Fit) -> tuple[Floats, Floats]:
    """Return column and row (N, 2) of the cell of each anchor, and its stride (N, 1)."""
    width, height = fit.canvas
    for strides in ANCHOR_STRIDES:
        shapes = [(height // stride, width // stride) for stride in strides]
        counts = [rows * columns for rows, columns in shapes]
        if sum(counts) == outputs[0].shape[1]:
            cells = [np.moveaxis(np.indices(shape)[::-1], 0, -1).reshape(-1, 2) for shape in shapes]
            return np.concatenate(cells).astype(np.float64), np.repeat(strides, counts)[:, None].astype(np.float64)
    raise _unexpected(model, outputs, f"an anchor for each cell of strides 8, 16, 32 of {width} x {height} px")


def _from_yolov5(model: Model, outputs: list[Array], row: int, _: Fit, wanted: WantedClasses) -> Boxes:
    """Centre x, y, width, height in pixels of the canvas, objectness, then a probability a class; a row an anchor."""
    if outputs[0].ndim != 3 or outputs[0].shape[2] <= 5:
        raise _unexpected(model, outputs, "[batch, anchors, 5 + classes]")
    raw = np.asarray(outputs[0][row], np.float64)
    low, high = raw[:, 2:4].min(initial=0.0), raw[:, 2:4].max(initial=0.0)
    if low < 0.0 and high <= _LARGEST_LOG:
        raise InputError(
            f"{model.path}: gives no sizes in pixels, as YOLOv5 does, but from {low:.3g} to {high:.3g}",
            hint="--kind yolox reads the logarithms of sizes that YOLOX gives",
        )
    score, number = _best_class(model, raw[:, 5:][:, : model.class_count], wanted)
    return _from_centers(raw[:, :2], raw[:, 2:4], raw[:, 4] * score, number)


def _from_ultralytics(model: Model, outputs: list[Array], row: int, _: Fit, wanted: WantedClasses) -> Boxes:
    """Centre x, y, width, height in pixels of the canvas, then a score a class; one column an anchor."""
    if outputs[0].ndim != 3 or outputs[0].shape[1] <= 4:
        raise _unexpected(model, outputs, "[batch, 4 + classes, anchors]")
    raw = np.asarray(outputs[0][row], np.float64).T
    score, number = _best_class(model, raw[:, 4:][:, : model.class_count], wanted)
    return _from_centers(raw[:, :2], raw[:, 2:4], score, number)


def _from_rtdetr(model: Model, outputs: list[Array], row: int, fit: Fit, wanted: WantedClasses) -> Boxes:
    """Ultralytics' RT-DETR: centre and size as shares of the whole, then a probability a class; a row a query."""
    if outputs[0].ndim != 3 or outputs[0].shape[2] <= 4:
        raise _unexpected(model, outputs, "[batch, queries, 4 + classes]")
    raw = np.asarray(outputs[0][row], np.float64)
    score, number = _best_class(model, raw[:, 4:][:, : model.class_count], wanted)
    place_px = raw[:, :4] * np.tile(fit.canvas, 2)
    return _from_centers(place_px[:, :2], place_px[:, 2:], score, number)


def _from_detr(model: Model, outputs: list[Array], row: int, fit: Fit, wanted: WantedClasses) -> Boxes:
    """Carion et al., "DETR", 2020: a softmax with a last class for nothing; its successors: a sigmoid a class."""
    named = _by_name(model, outputs)
    logits = next((output for name, output in named.items() if is_logits(name)), None)
    places = next((output for name, output in named.items() if is_places(name)), None)
    if logits is None or places is None or logits.ndim != 3 or places.shape != (*logits.shape[:2], 4):
        raise _unexpected(model, outputs, "logits [batch, queries, classes] and boxes [batch, queries, 4]")
    value = np.asarray(logits[row], np.float64)
    if model.is_softmax:
        odds = np.exp(value - value.max(axis=1, keepdims=True))
        probability = (odds / odds.sum(axis=1, keepdims=True))[:, :-1]
    else:
        probability = 1.0 / (1.0 + np.exp(np.clip(-value, -60.0, 60.0)))
        is_last = (np.argmax(value, axis=1) == value.shape[1] - 1) & (probability[:, -1] > 0.5)
        if not model.class_names and is_last.sum() > len(value) / 2:
            raise InputError(
                f"{model.path}: the last of its {value.shape[1]} classes is nearly everywhere, as one for nothing is",
                hint="write the names of the others into the metadata as valuemap.classes, as docs/detect.md shows",
            )
    score, number = _best_class(model, probability, wanted)
    place_px = np.asarray(places[row], np.float64) * np.tile(fit.canvas, 2)  # Centre and size, as shares of the whole.
    return _from_centers(place_px[:, :2], place_px[:, 2:], score, number)


def _from_boxes(model: Model, outputs: list[Array], row: int, fit: Fit, wanted: WantedClasses) -> Boxes:
    """Edges, class and score, suppressed in the graph: outputs of their own, or one [batch, N, 6 or more]."""
    named = _by_name(model, outputs)
    if len(outputs) == 1 or [output.ndim for output in outputs] == [3, 4]:  # With what masks are made of.
        expected = "left, top, right, bottom, score, class [batch, N, 6]"
        if outputs[0].ndim != 3 or outputs[0].shape[2] < 6:
            raise _unexpected(model, outputs, expected)
        if outputs[0].shape[1] in [many * count for many in (1, 3) for count in anchor_counts(fit.canvas)]:
            raise _unexpected(model, outputs, f"{expected}, not a row for each cell of the picture")
        edges_px, score, number = outputs[0][row][:, :4], outputs[0][row][:, 4], outputs[0][row][:, 5]
    elif named.keys() >= TENSORFLOW and named["detection_boxes"].ndim == 3:
        edges_px = named["detection_boxes"][row][:, [1, 0, 3, 2]] * np.tile(fit.canvas, 2)  # y first, in shares.
        score, number = named["detection_scores"][row], named["detection_classes"][row]
    elif named.keys() >= {"dets", "labels"} and named["dets"].ndim == 3 and named["dets"].shape[2] == 5:
        edges_px, score, number = named["dets"][row][:, :4], named["dets"][row][:, 4], named["labels"][row]
    else:
        edges_px, score, number = _edges_score_number(model, outputs, row)
    if edges_px.shape != (*score.shape, 4) or number.shape != score.shape:
        raise _unexpected(model, outputs, "boxes [N, 4], labels [N] and scores [N]")
    is_used = score > 0.0  # What fills up the rest of the rows is no score.
    edges_px, score, exact = edges_px[is_used], score[is_used], number[is_used]
    _check_shares(model, score)
    if not np.all(np.abs(exact - np.round(exact)) <= _ROUNDING):  # None is NaN, either.
        raise _unexpected(model, outputs, "whole numbers as classes, behind the scores,")
    number = np.round(exact).astype(np.int64)
    largest = np.abs(edges_px).max(initial=0.0)
    if 0.0 < largest <= _LARGEST_SHARE:
        raise InputError(
            f"{model.path}: gives boxes as shares of the picture, up to {largest:.3g}, expected pixels",
            hint="export it with boxes in pixels; if a row of its output is centre, size and a score a class, "
            "say --kind rtdetr",
        )
    is_wanted = wanted.are_wanted(number)
    return Boxes.from_edges(edges_px[is_wanted], score[is_wanted], number[is_wanted])


def _by_name(model: Model, outputs: list[Array]) -> dict[str, Array]:
    entries = model.session.get_outputs()
    return {plain_name(entry): output for entry, output in zip(entries, outputs, strict=True)}


def _edges_score_number(model: Model, outputs: list[Array], row: int) -> tuple[Array, Array, Array]:
    """Tell outputs apart by shape and dtype; some exports have a batch, torchvision's have none."""
    places = [output for output in outputs if output.ndim in (2, 3) and output.shape[-1] == 4]
    if places:
        edges_px = max(places, key=lambda output: output.ndim)  # Four scores have less dimensions than boxes.
        # How many boxes there are, and how large the picture is, are outputs of other shapes.
        flat = [output for output in outputs if output.shape == edges_px.shape[:-1]]
        score = next((output for output in flat if output.dtype.kind == "f"), None)
        number = next((output for output in flat if output.dtype.kind in "iu"), None)
        if score is not None and number is not None:
            return (edges_px[row], score[row], number[row]) if edges_px.ndim == 3 else (edges_px, score, number)
    raise _unexpected(model, outputs, "boxes [N, 4], labels [N] and scores [N]")


_DECODERS: Mapping[str, Callable[[Model, list[Array], int, Fit, WantedClasses], Boxes]] = {
    "segmentation": _from_segmentation,
    "yolox": _from_yolox,
    "yolov5": _from_yolov5,
    "ultralytics": _from_ultralytics,
    "rtdetr": _from_rtdetr,
    "detr": _from_detr,
    "boxes": _from_boxes,
}


def _best_class(model: Model, score: Floats, wanted: WantedClasses) -> tuple[Floats, Ints]:
    """Return the best score (N) among the wanted classes, and which class that is (N)."""
    _check_shares(model, score)
    columns = wanted.columns(score.shape[1])
    best = np.argmax(score[:, columns], axis=1)
    return score[np.arange(len(score)), columns[best]], columns[best]


def _check_shares(model: Model, score: Array) -> None:
    """Refuse what can be no probabilities: other numbers, as those for masks, or scores before their sigmoid."""
    low, high = score.min(initial=1.0), score.max(initial=0.0)  # Of nothing, too.
    if low < -_ROUNDING or high > 1.0 + _ROUNDING:
        raise InputError(
            f"{model.path}: a model of kind {model.kind} gives scores from 0 to 1, found {low:.3g} to {high:.3g}",
            hint="say what the model is with --kind, or export it with the sigmoid and its metadata (names, task)",
        )


def _from_centers(center_px: Floats, size_px: Floats, score: Floats, number: Ints) -> Boxes:
    return Boxes.from_edges(np.concatenate([center_px - size_px / 2, center_px + size_px / 2], axis=1), score, number)


def _unexpected(model: Model, outputs: list[Array], expected: str) -> InputError:
    found = ", ".join(str(list(output.shape)) for output in outputs)
    return InputError(
        f"{model.path}: a model of kind {model.kind} gives {expected}, found {found}",
        hint="say what the model is with --kind, or what it takes with --size",
    )
