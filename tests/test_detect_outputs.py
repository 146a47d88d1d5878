"""What each kind of network says becomes the right boxes, to a hundredth of a pixel."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tiny_models import red_finder, says, scales_to_sizes, tensorflow_red
from valuemap.config import DetectConfig
from valuemap.detect.boxes import Boxes, overlaps, suppress
from valuemap.detect.classes import choose_classes
from valuemap.detect.coco_names import COCO_80, COCO_91
from valuemap.detect.letterbox import Fit, fit_around, fit_into
from valuemap.detect.model import Model, load_model
from valuemap.detect.outputs import find_boxes
from valuemap.errors import InputError, SettingError

Array = NDArray[Any]


def boxes_of(edges: Any, score: Any = 0.9, number: Any = 0) -> Boxes:
    table = np.array(edges, dtype=np.float64).reshape(-1, 4)
    return Boxes.from_edges(table, np.broadcast_to(score, len(table)), np.broadcast_to(number, len(table)))


def yolox_raw(boxes: Boxes, canvas: tuple[int, int], classes: int) -> Array:
    """Return what YOLOX says about boxes: each in the cell of stride 8, 16 or 32 that its centre lies in."""
    width, height = canvas
    grids = [(height // s, width // s) for s in (8, 16, 32)]
    raw = np.zeros((sum(rows * columns for rows, columns in grids), 5 + classes), np.float32)
    for i in range(len(boxes)):
        level = i % 3
        stride = (8, 16, 32)[level]
        rows, columns = grids[level]
        cell = np.minimum(boxes.center_px[i] // stride, [columns - 1, rows - 1])
        anchor = sum(r * c for r, c in grids[:level]) + int(cell[1] * columns + cell[0])
        raw[anchor, :2] = boxes.center_px[i] / stride - cell
        raw[anchor, 2:4] = np.log(boxes.size_px[i] / stride)
        raw[anchor, 4] = 1.0
        raw[anchor, 5 + boxes.class_code[i]] = boxes.score[i]
    return raw


def ultralytics_raw(boxes: Boxes, canvas: tuple[int, int], classes: int) -> Array:
    raw = np.zeros((4 + classes, max(len(boxes), 20)), np.float32)
    raw[:4, : len(boxes)] = np.concatenate([boxes.center_px, boxes.size_px], axis=1).T
    raw[4 + boxes.class_code, np.arange(len(boxes))] = boxes.score
    return raw


def model_of(path: Path, kind: str, count: int = 3) -> Model:
    """Return a model whose kind is said, to decode outputs that the test makes up."""
    outputs = {"output": np.zeros((1, 20, 5 + count), np.float32)}
    if kind == "detr":
        outputs = {"logits": np.zeros((1, 5, count), np.float32), "pred_boxes": np.zeros((1, 5, 4), np.float32)}
    file = says(path / f"{kind}.onnx", outputs, picture=("batch", 3, "height", "width"))
    return load_model(file, DetectConfig(kind=kind))  # type: ignore[arg-type]


def decode(model: Model, outputs: list[Array], fit: Fit, *, classes: str = "", min_score: float = 0.25) -> Boxes:
    wanted = choose_classes(classes, model.class_names)
    return find_boxes(model, outputs, 0, fit, wanted, min_score=min_score, max_iou=0.5)


@pytest.fixture(scope="module")
def decoders(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Model]:
    folder = tmp_path_factory.mktemp("models")
    return {kind: model_of(folder, kind) for kind in ("yolox", "ultralytics", "detr")}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    picture=st.tuples(st.integers(40, 4000), st.integers(40, 3000)),
    canvas=st.sampled_from([None, (416, 416), (1024, 448), (640, 640), (96, 1280)]),
    how=st.sampled_from(["corner", "center", "stretch"]),
    kind=st.sampled_from(["yolox", "ultralytics", "detr"]),
    place=st.tuples(st.floats(0.05, 0.95), st.floats(0.05, 0.95)),
    share=st.tuples(st.floats(0.01, 0.09), st.floats(0.01, 0.09)),
)
def test_centres_survive_the_way_to_the_network_and_back(
    decoders: Mapping[str, Model],
    picture: tuple[int, int],
    canvas: tuple[int, int] | None,
    how: Any,
    kind: str,
    place: tuple[float, float],
    share: tuple[float, float],
) -> None:
    fit = fit_around(picture, 32) if canvas is None else fit_into(picture, canvas, how)
    boxes = Boxes(
        np.array([place]) * picture, np.array([share]) * picture, np.array([0.75]), np.array([1], dtype=np.int64)
    )
    seen = fit.to_canvas(boxes)
    if kind == "detr":
        shares = np.concatenate([seen.center_px, seen.size_px], axis=1) / np.tile(fit.canvas, 2)
        logits = np.array([[-9.0, np.log(0.75 / 0.25), -9.0]])
        outputs = [logits[None].astype(np.float32), shares[None].astype(np.float32)]
    else:
        raw = (yolox_raw if kind == "yolox" else ultralytics_raw)(seen, fit.canvas, 3)
        outputs = [raw[None]]
    found = decode(decoders[kind], outputs, fit)
    assert len(found) == 1
    np.testing.assert_allclose(found.center_px, boxes.center_px, atol=0.01)
    np.testing.assert_allclose(found.size_px, boxes.size_px, atol=0.01)
    assert found.score[0] == pytest.approx(0.75, abs=1e-6)
    assert found.class_code[0] == 1


@pytest.mark.parametrize("canvas", [(320, 320), (480, 256), (700, 640)])
@pytest.mark.parametrize("how", ["corner", "center", "stretch"])
def test_resized_pixels_lie_where_the_boxes_do(canvas: tuple[int, int], how: Any) -> None:
    """A soft spot drawn on the canvas has its centre where the fit says, so there is no half pixel too much."""
    picture, center = (611, 407), np.array([233.37, 171.81])
    x, y = np.meshgrid(np.arange(picture[0]) + 0.5, np.arange(picture[1]) + 0.5)
    spot = 255.0 * np.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / (2 * 12.0**2))
    fit = fit_into(picture, canvas, how)
    drawn = fit.draw(np.repeat(spot[:, :, None], 3, axis=2).round().astype(np.uint8))[:, :, 1].astype(float)
    assert drawn.shape == canvas[::-1]
    left, top = fit.offset
    drawn = drawn[top : top + fit.resized[1], left : left + fit.resized[0]]
    x, y = np.meshgrid(np.arange(drawn.shape[1]) + left + 0.5, np.arange(drawn.shape[0]) + top + 0.5)
    seen = np.array([[(x * drawn).sum(), (y * drawn).sum()]]) / drawn.sum()
    back = fit.to_picture(Boxes(seen, np.ones((1, 2)), np.ones(1), np.zeros(1, np.int64)))
    np.testing.assert_allclose(back.center_px[0], center, atol=0.02)


def test_a_letterbox_is_grey_and_keeps_the_shape() -> None:
    fit = fit_into((1280, 713), (416, 416), "corner")
    assert (fit.resized, fit.offset) == ((416, 231), (0, 0))
    assert (fit.draw(np.zeros((713, 1280, 3), np.uint8))[231:] == 114).all()
    assert fit_into((100, 50), (64, 64), "center").offset == (0, 16)
    assert fit_around((1024, 440), 32).canvas == (1024, 448)


def test_yolox_multiplies_objectness_and_class_and_suppresses(decoders: Mapping[str, Model]) -> None:
    raw = np.zeros((20 * 20 + 10 * 10 + 5 * 5, 8), np.float32)
    raw[0, :] = [0.5, 0.5, np.log(2), np.log(3), 0.8, 0.0, 0.5, 0.9]  # Cell (0, 0) of stride 8.
    raw[21, :] = [-0.5, -0.5, np.log(2), np.log(3), 0.6, 0.0, 0.0, 0.9]  # The same box from cell (1, 1).
    raw[400, :] = [2.0, 2.0, 0.0, 0.0, 0.5, 0.9, 0.0, 0.0]  # Cell (0, 0) of stride 16.
    found = decode(decoders["yolox"], [raw[None]], fit_around((160, 160), 32))
    np.testing.assert_allclose(found.score, [0.72, 0.45], atol=1e-6)
    assert found.class_code.tolist() == [2, 0]
    np.testing.assert_allclose(found.edges_px[0], [0, 0, 12, 16], atol=1e-4)  # Clipped at the left and the top.
    np.testing.assert_allclose(found.edges_px[1], [24, 24, 40, 40], atol=1e-4)
    only = decode(decoders["yolox"], [raw[None]], fit_around((160, 160), 32), classes="1")
    assert only.class_code.tolist() == [1]
    assert only.score[0] == pytest.approx(0.4)


def test_yolox_of_another_grid_is_refused(decoders: Mapping[str, Model]) -> None:
    with pytest.raises(InputError, match="anchor for each cell"):
        decode(decoders["yolox"], [np.zeros((1, 77, 8), np.float32)], fit_around((160, 160), 32))


def test_yolox_is_not_read_as_yolov5(tmp_path: Path) -> None:
    """Its sizes are logarithms: taken for pixels they would be boxes too small to be seen."""
    raw = np.random.default_rng(0).normal(0.5, 1.0, (1, 525, 8)).astype(np.float32)
    raw[:, :, 4:] = 0.0
    with pytest.raises(InputError, match="gives no sizes in pixels, as YOLOv5 does, but from -") as refused:
        decode(model_of(tmp_path, "yolov5"), [raw], fit_around((160, 160), 32))
    assert "--kind yolox" in refused.value.hint


def test_a_detr_with_a_class_for_nothing_is_a_softmax(tmp_path: Path) -> None:
    logits = np.array([[[2.0, 0.0, 1.0], [0.0, 0.0, 5.0]]], np.float32)
    places = np.array([[[0.5, 0.25, 0.5, 0.5], [0.5, 0.5, 1.0, 1.0]]], np.float32)
    file = says(
        tmp_path / "detr.onnx",
        {"logits": logits, "pred_boxes": places},
        picture=(1, 3, 200, 100),
        metadata={"valuemap.classes": ["light", "sign"]},
    )
    model = load_model(file, DetectConfig())
    assert (model.kind, model.is_softmax, model.fixed) == ("detr", True, (100, 200))
    fit = model.fit((50, 100), None)
    found = decode(model, model.run([fit.draw(np.zeros((100, 50, 3), np.uint8))]), fit)
    np.testing.assert_allclose(found.edges_px, [[12.5, 0, 37.5, 50]], atol=1e-4)
    assert found.score[0] == pytest.approx(np.exp(2) / (np.exp(2) + 1 + np.exp(1)))


@pytest.mark.parametrize("batch", [(), (1,)])
def test_boxes_suppressed_in_the_graph(tmp_path: Path, batch: tuple[int, ...]) -> None:
    """Torchvision's three outputs, in any order, with or without a batch."""
    outputs = {
        "scores": np.array([0.9, 0.4, 0.1], np.float32).reshape(*batch, 3),
        "found": np.array([[1, 2, 11, 22], [30, 30, 40, 50], [0, 0, 5, 5]], np.float32).reshape(*batch, 3, 4),
        "labels": np.array([10, 3, 10]).reshape(*batch, 3),
    }
    model = load_model(says(tmp_path / "m.onnx", outputs, picture=(*batch, 3, "height", "width")), DetectConfig())
    assert model.kind == "boxes"
    fit = model.fit((64, 64), None)
    found = decode(model, model.run([np.zeros((64, 64, 3), np.uint8)]), fit)
    np.testing.assert_allclose(found.edges_px, [[1, 2, 11, 22], [30, 30, 40, 50]])
    assert found.class_code.tolist() == [10, 3]
    assert decode(model, model.run([np.zeros((64, 64, 3), np.uint8)]), fit, classes="3").class_code.tolist() == [3]


def test_boxes_without_a_batch_go_one_picture_at_a_time(tmp_path: Path) -> None:
    """Four boxes, with masks beside them, so that scores and boxes look alike."""
    outputs = {
        "scores": np.array([0.9, 0.8, 0.7, 0.6], np.float32),
        "places": np.array([[i, i, i + 9, i + 9] for i in range(0, 40, 10)], np.float32),
        "masks": np.zeros((4, 1, 8, 8), np.float32),
        "labels": np.array([1, 1, 2, 2]),
    }
    dims = {"masks": (4, 1, 8, 8)}
    model = load_model(
        says(tmp_path / "m.onnx", outputs, picture=("batch", 3, 64, 64), dims=dims), DetectConfig(kind="boxes")
    )
    found = decode(model, model.run([np.zeros((64, 64, 3), np.uint8)]), model.fit((64, 64), None))
    assert found.score.tolist() == pytest.approx([0.9, 0.8, 0.7, 0.6])
    assert model.fixed_batch == 1


def test_boxes_in_one_output_of_six_columns(tmp_path: Path) -> None:
    rows = np.array([[[1, 2, 11, 22, 0.9, 1], [0, 0, 0, 0, 0, 0]]], np.float32)
    model = load_model(says(tmp_path / "m.onnx", {"output0": rows}), DetectConfig())
    assert model.kind == "boxes"
    found = decode(model, [rows], model.fit((64, 64), None))
    np.testing.assert_allclose(found.edges_px, [[1, 2, 11, 22]])


def test_components_of_a_coarser_map_without_the_padding(tmp_path: Path) -> None:
    model = load_model(
        red_finder(tmp_path / "m.onnx", {"valuemap.threshold": "0.6", "valuemap.minimum_component_px": "2"}),
        DetectConfig(),
    )
    probability = np.zeros((1, 1, 16, 32), np.float32)
    probability[0, 0, 2:5, 3:5] = [[0.7, 0.9]] * 3
    probability[0, 0, 5, 5] = 0.8  # Touches by a corner.
    probability[0, 0, 10, 20] = 0.9  # Too small.
    probability[0, 0, 13:16, 2:9] = 0.9  # Padding, from row 13 on.
    found = decode(model, [probability], fit_around((128, 52), 64))
    np.testing.assert_allclose(found.edges_px, [[12, 8, 24, 24]])
    assert found.score[0] == pytest.approx((3 * 0.7 + 3 * 0.9 + 0.8) / 7)


RECOGNISED: list[tuple[str, dict[str, Array], dict[str, Any], dict[str, Any]]] = [
    ("segmentation", {"output": np.zeros((1, 2, 64, 64), np.float32)}, {}, {}),
    ("yolox", {"output": np.zeros((1, 84, 13), np.float32)}, {}, {}),
    ("yolox", {"output": np.zeros((1, 84, 13), np.float32)}, {"output": ("batch", "anchors", 13)}, {}),
    ("ultralytics", {"output": np.zeros((1, 13, 84), np.float32)}, {}, {}),
    ("ultralytics", {"output": np.zeros((1, 13, 84), np.float32)}, {"output": ("batch", 13, "anchors")}, {}),
    ("ultralytics", {"output": np.zeros((1, 6, 5), np.float32)}, {}, {"names": "{0: 'light', 1: 'sign'}"}),
    ("boxes", {"output": np.zeros((1, 300, 6), np.float32)}, {}, {}),
    ("boxes", {"output": np.zeros((1, 300, 6), np.float32)}, {}, {"names": "{0: 'light', 1: 'sign', 2: 'lane'}"}),
    # One class: as many columns as boxes that are suppressed in the graph, but a row for each cell, or three.
    ("yolox", {"output": np.zeros((1, 84, 6), np.float32)}, {}, {}),
    ("yolov5", {"output": np.zeros((1, 252, 6), np.float32)}, {}, {}),
    ("yolov5", {"output": np.zeros((1, 252, 13), np.float32)}, {}, {}),
    ("detr", {"logits": np.zeros((1, 9, 3), np.float32), "pred_boxes": np.zeros((1, 9, 4), np.float32)}, {}, {}),
]


@pytest.mark.parametrize(("kind", "outputs", "dims", "metadata"), RECOGNISED)
def test_kinds_are_recognised(
    tmp_path: Path, kind: str, outputs: dict[str, Array], dims: dict[str, Any], metadata: dict[str, Any]
) -> None:
    file = says(tmp_path / "m.onnx", outputs, dims=dims, metadata=metadata)
    assert load_model(file, DetectConfig()).kind == kind
    assert load_model(file, DetectConfig(kind="boxes")).kind == "boxes"


ULTRALYTICS = {"task": "detect", "names": "{0: 'light', 1: 'sign'}", "stride": "32"}
BOX = [20, 30, 10, 8]
EDGES = [15, 26, 25, 34]
EXPORTED: list[tuple[str, int, list[float], tuple[int, int], dict[str, str]]] = [
    ("yolov5", 0, [*BOX, 0.9, 0.1, 0.8], (1200, 7), {"names": "{0: 'light', 1: 'sign'}", "stride": "32"}),
    ("yolov5", 0, [*BOX, 0.9, 0.1, 0.8], (1200, 7), {"names": "['light', 'sign']", "stride": "32"}),
    ("yolov5", 0, [*BOX, 0.9, 0.1, 0.8, *[5.0] * 32], (1200, 39), {**ULTRALYTICS, "task": "segment"}),
    ("yolov5", 0, [*BOX, 0.9, 0.1, 0.8, *[5.0] * 32], (1200, 39), {"names": "['light', 'sign']", "stride": "32"}),
    ("ultralytics", 1, [*BOX, 0.1, 0.72], (6, 84), ULTRALYTICS),
    ("ultralytics", 1, [*BOX, 0.1, 0.72, *[5.0] * 32], (38, 84), {**ULTRALYTICS, "task": "segment"}),
    ("ultralytics", 1, [*BOX, 0.1, 0.72, *[5.0] * 51], (57, 84), {**ULTRALYTICS, "task": "pose"}),
    ("boxes", 0, [*EDGES, 0.72, 1], (300, 6), ULTRALYTICS),
    ("boxes", 0, [*EDGES, 0.72, 1, *[5.0] * 32], (300, 38), {**ULTRALYTICS, "task": "segment"}),
    ("boxes", 0, [*EDGES, 0.72, 1, *[5.0] * 51], (300, 57), {**ULTRALYTICS, "task": "pose"}),
    (
        "rtdetr",
        0,
        [20 / 64, 30 / 64, 10 / 64, 8 / 64, 0.1, 0.72, 0.2],
        (300, 7),
        {**ULTRALYTICS, "names": "{0: 'light', 1: 'sign', 2: 'sign'}"},
    ),
    (
        "rtdetr",
        0,
        [20 / 64, 30 / 64, 10 / 64, 8 / 64, 0.1, 0.72],
        (300, 6),
        {**ULTRALYTICS, "description": "Ultralytics rtdetr-l model"},
    ),
]


@pytest.mark.parametrize(("kind", "axis", "values", "shape", "metadata"), EXPORTED)
def test_exports_of_yolo_and_rtdetr_say_the_same_box(
    tmp_path: Path, kind: str, axis: int, values: list[float], shape: tuple[int, int], metadata: dict[str, str]
) -> None:
    """With masks and key points behind the scores, suppressed or not: a score is 0.72, its class sign."""
    table = np.zeros((1, *shape), np.float32)
    np.moveaxis(table, 1 + axis, 1)[0, 5] = values
    outputs = {"output0": table}
    if len(values) > 32 and metadata.get("task") != "pose":
        outputs["output1"] = np.zeros((1, 32, 16, 16), np.float32)
    model = load_model(says(tmp_path / "m.onnx", outputs, metadata=metadata), DetectConfig())
    assert (model.kind, model.preparation.color, model.preparation.std) == (kind, "RGB", (1.0, 1.0, 1.0))
    found = decode(model, model.run([np.zeros((64, 64, 3), np.uint8)]), model.fit((64, 64), None))
    np.testing.assert_allclose(found.edges_px, [EDGES], atol=1e-4)
    assert found.score[0] == pytest.approx(0.72)
    assert model.class_names[found.class_code[0]] == "sign"


def test_anchors_of_yolov5_that_say_the_same_box_are_one(tmp_path: Path) -> None:
    table = np.zeros((1, 252, 7), np.float32)
    table[0, [3, 4]] = [*BOX, 0.9, 0.1, 0.8]
    model = load_model(says(tmp_path / "m.onnx", {"output": table}), DetectConfig())
    np.testing.assert_allclose(decode(model, [table], model.fit((64, 64), None)).edges_px, [EDGES])


def test_rows_that_fill_up_boxes_are_none(tmp_path: Path) -> None:
    """Of such rows neither the score nor the class nor the edges are anything."""
    table = np.full((1, 300, 6), -1.0, np.float32)
    table[0, 1] = [*EDGES, 0.72, 1]
    model = load_model(says(tmp_path / "m.onnx", {"output": table}), DetectConfig())
    np.testing.assert_allclose(decode(model, [table], model.fit((64, 64), None)).edges_px, [EDGES])


def test_bytes_do_not_change_where_the_picture_goes(tmp_path: Path) -> None:
    file = says(tmp_path / "m.onnx", {"output": np.zeros((1, 6, 84), np.float32)}, takes=onnx.TensorProto.UINT8)
    how = load_model(file, DetectConfig()).preparation
    assert (how.color, how.std[0], how.fitting) == ("RGB", 1 / 255, "center")


def test_free_sizes_of_ultralytics_leave_columns_free(tmp_path: Path) -> None:
    table = np.zeros((1, 300, 6), np.float32)
    table[0, 0] = [*EDGES, 0.72, 1]
    file = says(
        tmp_path / "m.onnx", {"output0": table}, dims={"output0": ("batch", 300, "anchors")}, metadata=ULTRALYTICS
    )
    model = load_model(file, DetectConfig())
    assert model.kind == "boxes"
    np.testing.assert_allclose(decode(model, [table], model.fit((64, 64), None)).edges_px, [EDGES])


def test_rf_detr_is_a_detr_with_names_of_its_own(tmp_path: Path) -> None:
    logits = np.full((1, 9, 91), -9.0, np.float32)
    logits[0, 2, 10] = 2.0
    places = np.full((1, 9, 4), 0.5, np.float32)
    model = load_model(says(tmp_path / "m.onnx", {"dets": places, "labels": logits}), DetectConfig())
    found = decode(model, [places, logits], model.fit((64, 64), None))
    assert (model.kind, [model.class_names[i] for i in found.class_code]) == ("detr", ["traffic light"])
    np.testing.assert_allclose(found.edges_px, [[16, 16, 48, 48]])


@pytest.mark.parametrize(
    ("queries", "classes", "is_plain"),
    [(300, 80, True), ("queries", 80, True), (300, 91, False), ("queries", 91, False), (900, 80, False)],
)
def test_rt_detr_takes_colours_as_they_are_and_other_detrs_do_not(
    tmp_path: Path, *, queries: int | str, classes: int, is_plain: bool
) -> None:
    count = queries if isinstance(queries, int) else 300
    outputs = {"logits": np.zeros((1, count, classes), np.float32), "pred_boxes": np.zeros((1, count, 4), np.float32)}
    dims = {"logits": (1, queries, classes), "pred_boxes": (1, queries, 4)}
    model = load_model(says(tmp_path / "m.onnx", outputs, dims=dims), DetectConfig())
    assert (model.kind, model.preparation.fitting) == ("detr", "stretch")
    assert (model.preparation.mean == (0.0, 0.0, 0.0)) is is_plain


def test_models_that_take_the_size_give_boxes_of_the_canvas(tmp_path: Path) -> None:
    """RT-DETR and D-FINE; the canvas is square and the picture is not: stretched, as these are trained."""
    file = scales_to_sizes(tmp_path / "m.onnx", np.array([[0.25, 0.5, 0.5, 0.75]], np.float32))
    model = load_model(file, DetectConfig())
    assert (model.kind, model.preparation.fitting) == ("boxes", "stretch")
    fit = model.fit((128, 32), None)
    outputs = model.run([fit.draw(np.zeros((32, 128, 3), np.uint8))])
    np.testing.assert_allclose(decode(model, outputs, fit).edges_px, [[32, 16, 64, 24]])


def test_tensorflow_takes_bytes_with_channels_last_and_gives_y_first(tmp_path: Path) -> None:
    file = tensorflow_red(tmp_path / "m.onnx", np.array([[[0.25, 0.5, 0.5, 0.75]]], np.float32))
    model = load_model(file, DetectConfig())
    fit = model.fit((128, 64), None)
    picture = np.zeros((64, 128, 3), np.uint8)
    picture[3, 5] = [200, 90, 250]
    found = decode(model, model.run([fit.draw(picture)]), fit)
    np.testing.assert_allclose(found.edges_px, [[64, 16, 96, 32]])
    assert found.score[0] == pytest.approx(200 / 255)
    assert found.class_code.tolist() == [10]


def test_counts_and_sizes_beside_boxes_are_no_classes(tmp_path: Path) -> None:
    """YOLO-NAS says first how many boxes there are, Detectron2 how large the picture is, and takes BGR to 255."""
    boxes = np.array([EDGES, [0, 0, 9, 9], [0, 0, 9, 9]], np.float32)
    scores, classes = np.array([0.9, 0.1, 0.1], np.float32), np.array([4, 5, 6])
    counted = {
        "num_predictions": np.array([[1]]),
        "boxes": boxes[None],
        "scores": scores[None],
        "classes": classes[None],
    }
    sized = {"boxes": boxes, "image_size": np.array([64, 64]), "classes": classes, "scores": scores}
    colors = []
    for name, outputs, picture in (("counted", counted, (1, 3, 64, 64)), ("sized", sized, (3, 64, 64))):
        model = load_model(says(tmp_path / f"{name}.onnx", outputs, picture=picture), DetectConfig())
        found = decode(model, model.run([np.zeros((64, 64, 3), np.uint8)]), model.fit((64, 64), None))
        assert (found.class_code.tolist(), found.edges_px.tolist()) == ([4], [EDGES])
        colors.append((model.preparation.color, model.preparation.std[0]))
    assert colors == [("RGB", 1.0), ("BGR", 1 / 255)]


def test_mmdeploy_must_say_how_it_wants_colours(tmp_path: Path) -> None:
    outputs = {"dets": np.array([[[*EDGES, 0.9]]], np.float32), "labels": np.array([[2]])}
    with pytest.raises(InputError, match="MMDeploy") as error:
        load_model(says(tmp_path / "m.onnx", outputs), DetectConfig())
    assert "valuemap.mean" in error.value.hint
    said = {"valuemap.mean": [0.485, 0.456, 0.406], "valuemap.std": [0.229, 0.224, 0.225]}
    model = load_model(says(tmp_path / "m.onnx", outputs, metadata=said), DetectConfig())
    found = decode(model, list(outputs.values()), model.fit((64, 64), None))
    assert (found.class_code.tolist(), found.edges_px.tolist()) == ([2], [EDGES])


def test_masks_among_outputs_of_their_own_are_left_alone(tmp_path: Path) -> None:
    boxes, masks = np.array([[EDGES]], np.float32), np.zeros((1, 1, 28, 28), np.float32)
    outputs = {"boxes": boxes, "masks": masks, "labels": np.array([[2]]), "scores": np.array([[0.9]], np.float32)}
    model = load_model(says(tmp_path / "m.onnx", outputs), DetectConfig())
    found = decode(model, list(outputs.values()), model.fit((64, 64), None))
    assert (found.class_code.tolist(), found.edges_px.tolist()) == ([2], [EDGES])


def test_bytes_with_channels_first_are_freed_of_their_size(tmp_path: Path) -> None:
    """As YOLO-NAS takes them; which of four axes are height and width, the type does not tell."""
    outputs = {"boxes": np.array([[EDGES]], np.float32), "scores": np.ones((1, 1), np.float32), "n": np.array([[2]])}
    file = says(tmp_path / "m.onnx", outputs, takes=onnx.TensorProto.UINT8)
    model = load_model(file, DetectConfig(size="96x32"))
    found = decode(model, model.run([np.zeros((32, 96, 3), np.uint8)]), model.fit((96, 32), (96, 32)))
    np.testing.assert_allclose(found.edges_px, [[15, 26, 25, 32]])  # Cut at the lower edge of the picture.


ONE = np.ones(1, np.float32)
COLORS = {"valuemap.mean": [0, 0, 0], "valuemap.std": [1, 1, 1]}


@pytest.mark.parametrize(
    "outputs",
    [
        {"detection_boxes": np.ones((1, 4), np.float32), "detection_scores": ONE, "detection_classes": ONE},
        {"detection_boxes": np.ones((1, 1, 4), np.float32), "detection_scores": ONE, "detection_classes": ONE},
        {"detection_boxes": np.ones((1, 1, 4), np.float32), "scores": ONE, "classes": np.array([1])},
        {"dets": np.ones((1, 1, 5), np.float32), "classes": np.array([[1]])},
        {"dets": np.ones((1, 1, 5), np.float32), "labels": np.array([1])},
        {"logits": np.ones((1, 2, 3), np.float32), "pred_boxes": np.ones((2, 4), np.float32)},
        {"output": np.array([[[*EDGES, 0.9, np.nan]]], np.float32)},
    ],
)
def test_outputs_of_known_names_and_other_shapes_are_refused(tmp_path: Path, outputs: dict[str, Array]) -> None:
    """TensorFlow's and MMDeploy's without a batch or with other names beside them, and a class that is no number."""
    kind: Any = None if "logits" in outputs else "boxes"
    model = load_model(says(tmp_path / "m.onnx", outputs, metadata=COLORS), DetectConfig(kind=kind))
    with pytest.raises(InputError, match=rf"a model of kind {model.kind} gives .* found \["):
        decode(model, list(outputs.values()), model.fit((64, 64), None))


def test_outputs_that_mean_something_else_are_refused(tmp_path: Path) -> None:
    """Decoded boxes where YOLOX's are raw, shares where pixels are, a class for nothing that nobody told."""
    yolov6 = np.full((1, 84, 8), 20.0, np.float32)
    shares: dict[str, Array] = {
        "boxes": np.array([[0.2, 0.2, 0.4, 0.5]], np.float32),
        "scores": np.ones(1, np.float32),
        "labels": np.ones(1, np.int64),
    }
    logits = np.full((1, 9, 4), -3.0, np.float32)
    logits[:, :, 3] = 6.0
    cells, anchors = np.zeros((1, 84, 6), np.float32), np.zeros((1, 252, 6), np.float32)
    # Of NanoDet the rest of a row are logits of edges, of a network for masks they are of masks or before the sigmoid.
    nanodet, masks = np.full((1, 84, 20), 0.1, np.float32), np.full((1, 3, 64, 64), -4.0, np.float32)
    nanodet[0, 3, 15] = 7.5
    cases: list[tuple[str, dict[str, Array], str, str]] = [
        ("yolov6", {"outputs": yolov6}, "boxes in pixels", "--kind yolov5"),
        ("nanodet", {"output": nanodet}, "scores from 0 to 1, found 0.1 to 7.5", "--kind"),
        ("pose", {"output0": np.full((1, 20, 84), 30.0, np.float32)}, "scores from 0 to 1, found 1 to 30", "metadata"),
        (
            "order",
            {"output": np.full((1, 3, 6), [[*EDGES, 1.0, 0.6]], np.float32)},
            "whole numbers as classes",
            "--kind",
        ),
        ("masks", {"out": masks}, "scores from 0 to 1, found -4 to 0", "sigmoid"),
        ("shares", shares, "shares of the picture", "in pixels"),
        (
            "nothing",
            {"logits": logits, "pred_boxes": np.full((1, 9, 4), 0.5, np.float32)},
            "nothing",
            "valuemap.classes",
        ),
        ("cells", {"output": cells}, "each cell", "--kind"),
        ("anchors", {"output": anchors}, "each cell", "--kind"),
    ]
    for name, outputs, message, hint in cases:
        kind: Any = "boxes" if name in ("cells", "anchors") else None
        model = load_model(says(tmp_path / f"{name}.onnx", outputs), DetectConfig(kind=kind))
        with pytest.raises(InputError, match=message) as error:
            decode(model, list(outputs.values()), model.fit((64, 64), None))
        assert hint in error.value.hint
    with pytest.raises(InputError, match="task obb"):
        load_model(
            says(
                tmp_path / "o.onnx",
                {"output0": np.zeros((1, 7, 84), np.float32)},
                metadata={**ULTRALYTICS, "task": "obb"},
            ),
            DetectConfig(),
        )
    many = says(tmp_path / "many.onnx", {"output": np.zeros((1, 2000, 6), np.float32)})
    with pytest.raises(InputError, match="cannot tell what the outputs mean"):
        load_model(many, DetectConfig())
    flat = says(tmp_path / "flat.onnx", {"output": np.zeros((4, 7), np.float32)})
    with pytest.raises(InputError, match="cannot tell what the outputs mean") as error:
        load_model(flat, DetectConfig())
    assert "--end2end" in error.value.hint
    node = onnx.helper.make_node("EfficientNMS_TRT", ["image"], ["boxes"], domain="TRT")
    ends = [onnx.helper.make_tensor_value_info(name, 1, [1, 3, 64, 64]) for name in ("image", "boxes")]
    graph = onnx.helper.make_graph([node], "trt", ends[:1], ends[1:])
    opsets = [onnx.helper.make_opsetid("", 18), onnx.helper.make_opsetid("TRT", 1)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opsets, ir_version=10), tmp_path / "trt.onnx")
    with pytest.raises(InputError, match="cannot be read as an ONNX model") as error:
        load_model(tmp_path / "trt.onnx", DetectConfig())
    assert "TensorRT" in error.value.hint
    weights = tmp_path / "best.pt"
    weights.write_bytes(b"PK")
    with pytest.raises(InputError) as error:
        load_model(weights, DetectConfig())
    assert "ONNX" in error.value.hint


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("names", "{1e400: 'light'}", "names of the classes"),
        ("names", "{}", "names of the classes"),
        ("valuemap.classes", "[" * 100_000, "names of the classes"),
        ("stride", "0", "stride: expected a number of at least 1, found '0'"),
        ("stride", "inf", "stride: expected a number"),
        ("valuemap.minimum_component_px", "nan", "minimum_component_px: expected a number of at least 0"),
        ("valuemap.threshold", "half", "threshold: expected a number"),
    ],
)
def test_damaged_metadata_are_refused_in_a_line(tmp_path: Path, name: str, value: str, message: str) -> None:
    file = says(tmp_path / "m.onnx", {"output0": np.zeros((1, 6, 84), np.float32)}, metadata={name: value})
    with pytest.raises(InputError, match=message):
        load_model(file, DetectConfig())


def test_the_file_says_how_it_wants_pictures(tmp_path: Path) -> None:
    file = red_finder(
        tmp_path / "m.onnx",
        {"valuemap.mean": [0.5, 0.25, 0.0], "valuemap.std": [0.5, 0.5, 2.0], "valuemap.color": "RGB"},
    )
    model = load_model(file, DetectConfig())
    canvas = np.tile(np.array([255, 51, 0], np.uint8), (32, 32, 1))
    output = model.run([canvas, canvas])[0]
    assert output.shape == (2, 1, 32, 32)
    np.testing.assert_allclose(output, (1.0 - 0.5) / 0.5 - (0.2 - 0.25) / 0.5, atol=1e-5)
    assert model.class_names == ("traffic_light",)


def test_names_come_from_the_file_else_from_coco(tmp_path: Path) -> None:
    assert COCO_80[9] == "traffic light"
    assert COCO_80[11] == COCO_91[13] == "stop sign"
    assert (len(COCO_80), len(COCO_91), COCO_91[90]) == (80, 91, "toothbrush")
    for columns, names in ((85, COCO_80), (8, ())):
        file = says(tmp_path / f"{columns}.onnx", {"output": np.zeros((1, 84, columns), np.float32)})
        assert load_model(file, DetectConfig(kind="yolox")).class_names == names
    named = {"output": np.zeros((1, 6, 84), np.float32)}
    file = says(tmp_path / "u.onnx", named, metadata={"names": "{0: 'light', 1: 'sign'}"})
    assert load_model(file, DetectConfig()).class_names == ("light", "sign")


def test_wanted_classes_by_name_number_and_new_name() -> None:
    wanted = choose_classes("Stop Sign, traffic light=light, 0=light", COCO_80)
    assert wanted.columns(80).tolist() == [0, 9, 11]
    assert [wanted.name_of(i) for i in (0, 9, 11, 99)] == ["light", "light", "stop sign", "class-99"]
    assert wanted.one_a_name(np.array([9, 11, 0, 12])).tolist() == [0, 11, 0, 12]
    with pytest.raises(SettingError, match="no class 'trafic light'") as error:
        choose_classes("trafic light", COCO_80)
    assert "traffic light" in error.value.hint
    with pytest.raises(SettingError, match="does not say"):
        choose_classes("light", ())
    for twice in ("9=light,9=other", "traffic light=a,9=b", "9,traffic light=b"):
        with pytest.raises(SettingError, match="--classes: class 9 is given two names"):
            choose_classes(twice, COCO_80)
    assert choose_classes("9=light,9=light,traffic light=light", COCO_80).name_of(9) == "light"
    with pytest.raises(SettingError, match="no class 80"):
        choose_classes("80", COCO_80).columns(80)


def test_models_that_cannot_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "text.onnx").write_text("no model")
    odd = says(tmp_path / "odd.onnx", {"a": np.zeros((1, 7), np.float32)})
    grey = says(tmp_path / "grey.onnx", {"a": np.zeros((1, 9, 9), np.float32)}, picture=(1, 1, 8, 8))
    two = says(tmp_path / "two.onnx", {name: np.zeros((1, 9, 9), np.float32) for name in "ab"})
    for file, message in (
        (tmp_path / "none.onnx", "no such file"),
        (tmp_path / "text.onnx", "cannot be read as an ONNX model"),
        (odd, "cannot tell what the outputs mean"),
        (grey, "3 channels"),
        (two, "cannot tell what the outputs mean"),
    ):
        with pytest.raises(InputError, match=message) as error:
            load_model(file, DetectConfig())
        assert "\n" not in str(error.value)
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(SettingError, match="--provider cuda"):
        load_model(two, DetectConfig(provider="cuda"))


@pytest.mark.parametrize(
    ("reason", "is_loaded"),
    [("no CUDA-capable device is detected", True), ("libcublas.so.13: cannot open shared object file", False)],
)
def test_a_gpu_that_cannot_be_used_is_told_of_and_not_replaced_by_the_cpu(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    reason: str,
    is_loaded: bool,
) -> None:
    model = red_finder(tmp_path / "red.onnx")
    create = onnxruntime.InferenceSession._create_inference_session

    def without_device(session: Any, providers: Any, *rest: Any) -> None:
        if is_loaded and any(provider[0] == "CUDAExecutionProvider" for provider in providers):
            raise RuntimeError(f"cuda_call.cc:154 CudaCall(...) CUDA failure 100: {reason} ; GPU=-1 ; \n\n")
        create(session, [], *rest)

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider"])
    monkeypatch.setattr(
        onnxruntime, "preload_dlls", lambda: None if is_loaded else print(f"Failed to load x: {reason}")
    )
    monkeypatch.setattr(onnxruntime, "set_default_logger_severity", lambda _: None)
    monkeypatch.setattr(onnxruntime.InferenceSession, "_create_inference_session", without_device)
    with pytest.raises(SettingError, match=f"--provider cuda: .*: {reason}$"):
        load_model(model, DetectConfig(provider="cuda"))
    assert capsys.readouterr() == ("", "")


def literal_suppression(boxes: Boxes, max_iou: float) -> set[int]:
    left = sorted(range(len(boxes)), key=lambda i: -boxes.score[i])
    kept: list[int] = []
    for i in left:
        for j in kept:
            a, b = boxes.edges_px[i], boxes.edges_px[j]
            width = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
            height = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
            union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
            if boxes.class_code[i] == boxes.class_code[j] and width * height / union > max_iou:
                break
        else:
            kept.append(i)
    return set(kept)


def test_suppression_agrees_with_the_literal_one() -> None:
    random = np.random.default_rng(1)
    for _ in range(50):
        low = random.uniform(0, 60, (40, 2))
        edges = np.concatenate([low, low + random.uniform(3, 30, (40, 2))], axis=1)
        boxes = boxes_of(edges, random.permutation(40) / 40.0, random.integers(0, 2, 40))
        assert set(suppress(boxes, 0.4).tolist()) == literal_suppression(boxes, 0.4)


def test_boxes_meet_across_the_seam_of_a_panorama() -> None:
    left, right = boxes_of([[-5.0, 10, 5, 20]]), boxes_of([[995.0, 10, 1005, 20]])
    assert overlaps(left, right)[0] == 0.0
    assert overlaps(left, right, period_px=1000.0)[0] == pytest.approx(1.0)


def test_boxes_that_are_no_numbers_are_dropped() -> None:
    assert len(boxes_of([[0, 0, np.inf, 5], [0, 0, 5, 5], [np.nan, 0, 1, 1]])) == 1
    assert len(boxes_of([[0, 0, 5, 5], [20, 20, 30, 30]]).clipped(10, 10)) == 1
