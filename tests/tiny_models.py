"""Tiny ONNX models, built on the spot, whose answers are known."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

Dims = Sequence[int | str | None]


def red_finder(path: Path, metadata: Mapping[str, Any] | None = None, *, size: Dims = ("height", "width")) -> Path:
    """Write a segmentation model whose probability is the red of the picture, 0 to 1, where green is not."""
    nodes = [
        helper.make_node("Split", ["image"], ["red", "green", "blue"], axis=1, num_outputs=3),
        helper.make_node("Sub", ["red", "green"], ["difference"]),
        helper.make_node("Relu", ["difference"], ["probability"]),
    ]
    return _write(
        path,
        nodes,
        {"image": ["batch", 3, *size]},
        {"probability": (TensorProto.FLOAT, ["batch", 1, *size])},
        metadata={"valuemap.kind": "segmentation", "valuemap.classes": '["traffic_light"]', **(metadata or {})},
    )


def halves(path: Path, *, size: Dims) -> Path:
    """Write a segmentation model that joins a picture with its own half made twice as large, and finds nothing."""
    nodes = [
        helper.make_node("AveragePool", ["image"], ["half"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Resize", ["half", "", "scales"], ["whole"], mode="nearest"),
        helper.make_node("Sub", ["image", "image"], ["none"]),
        helper.make_node("Concat", ["none", "whole"], ["joined"], axis=1),
        helper.make_node("Split", ["joined"], ["probability", "rest"], axis=1, num_outputs=2),
    ]
    return _write(
        path,
        nodes,
        {"image": ["batch", 3, *size]},
        {"probability": (TensorProto.FLOAT, ["batch", 3, *size])},
        constants=[numpy_helper.from_array(np.array([1.0, 1.0, 2.0, 2.0], np.float32), "scales")],
        metadata={"valuemap.kind": "segmentation"},
    )


def says(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    *,
    picture: Dims = (1, 3, 64, 64),
    dims: Mapping[str, Dims] | None = None,
    metadata: Mapping[str, Any] | None = None,
    takes: int = TensorProto.FLOAT,
) -> Path:
    """Write a model that gives the same outputs whatever it sees, which are numbers of the type that it `takes`.

    Nothing but `dims` says what shapes the outputs will have: with others, names in it would count for nothing.
    """
    nodes = []
    constants = []
    declared = {}
    for name, value in outputs.items():
        kind = helper.np_dtype_to_tensor_dtype(value.dtype)
        constants.append(numpy_helper.from_array(value, f"{name}_value"))
        constants.append(numpy_helper.from_array(np.array(value.shape, np.int64), f"{name}_shape"))
        nodes += [
            helper.make_node("ReduceMax", ["image"], [f"{name}_seen"], keepdims=0),
            helper.make_node("Cast", [f"{name}_seen"], [f"{name}_cast"], to=kind),
            helper.make_node("Sub", [f"{name}_cast", f"{name}_cast"], [f"{name}_nothing"]),
            helper.make_node("Add", [f"{name}_value", f"{name}_nothing"], [f"{name}_whole"]),
            helper.make_node("Cast", [f"{name}_nothing"], [f"{name}_zero"], to=TensorProto.INT64),
            helper.make_node("Add", [f"{name}_shape", f"{name}_zero"], [f"{name}_dims"]),
            helper.make_node("Reshape", [f"{name}_whole", f"{name}_dims"], [name]),
        ]
        declared[name] = (kind, list((dims or {}).get(name, value.shape)))
    return _write(
        path,
        nodes,
        {"image": list(picture)},
        declared,
        constants=constants,
        metadata=metadata or {},
        types={"image": takes},
    )


def scales_to_sizes(path: Path, shares: NDArray[Any]) -> Path:
    """Write a model as of RT-DETR: boxes (N, 4) in shares, times the width and height that its second input says."""
    nodes = [
        helper.make_node("Cast", ["orig_target_sizes"], ["size"], to=TensorProto.FLOAT),
        helper.make_node("Concat", ["size", "size"], ["sizes"], axis=1),
        helper.make_node("Mul", ["sizes", "shares"], ["scaled"]),
        helper.make_node("Unsqueeze", ["scaled", "first"], ["boxes"]),
        helper.make_node("ReduceMax", ["images"], ["seen"], keepdims=0),
        helper.make_node("Mul", ["seen", "none"], ["nothing"]),
        helper.make_node("Add", ["ones", "nothing"], ["scores"]),
        helper.make_node("Cast", ["nothing"], ["zero"], to=TensorProto.INT64),
        helper.make_node("Add", ["zero", "numbers"], ["labels"]),
    ]
    count = len(shares)
    constants = {
        "shares": shares,
        "first": np.array([0]),
        "none": np.zeros((), np.float32),
        "ones": np.ones((1, count), np.float32),
        "numbers": np.zeros((1, count), np.int64),
    }
    return _write(
        path,
        nodes,
        {"images": ["N", 3, 64, 64], "orig_target_sizes": ["N", 2]},
        {
            "labels": (TensorProto.INT64, ["N", count]),
            "boxes": (TensorProto.FLOAT, ["N", count, 4]),
            "scores": (TensorProto.FLOAT, ["N", count]),
        },
        constants=[numpy_helper.from_array(value, name) for name, value in constants.items()],
        metadata={},
        types={"orig_target_sizes": TensorProto.INT64},
    )


def tensorflow_red(path: Path, places: NDArray[Any]) -> Path:
    """Write a model as of TensorFlow: boxes (1, 1, 4), y first in shares, whose score is the largest red over 255."""
    nodes = [
        helper.make_node("Gather", ["image_tensor:0", "first"], ["red"], axis=3),
        helper.make_node("ReduceMax", ["red"], ["largest"], keepdims=0),
        helper.make_node("Cast", ["largest"], ["number"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["number", "part"], ["detection_scores:0"]),
        helper.make_node("Identity", ["places"], ["detection_boxes:0"]),
        helper.make_node("Identity", ["ten"], ["detection_classes:0"]),
        helper.make_node("Identity", ["one"], ["num_detections:0"]),
    ]
    constants = {
        "first": np.array([0]),
        "part": np.full((1, 1), 1 / 255, np.float32),
        "places": places,
        "ten": np.full((1, 1), 10, np.float32),
        "one": np.ones(1, np.float32),
    }
    floats = {
        "num_detections:0": [1],
        "detection_boxes:0": [1, 1, 4],
        "detection_scores:0": [1, 1],
        "detection_classes:0": [1, 1],
    }
    return _write(
        path,
        nodes,
        {"image_tensor:0": [1, None, None, 3]},
        {name: (TensorProto.FLOAT, dims) for name, dims in floats.items()},
        constants=[numpy_helper.from_array(value, name) for name, value in constants.items()],
        metadata={},
        types={"image_tensor:0": TensorProto.UINT8},
    )


def _write(
    path: Path,
    nodes: list[Any],
    inputs: Mapping[str, list[Any]],
    outputs: Mapping[str, tuple[int, list[Any]]],
    *,
    metadata: Mapping[str, Any],
    constants: Sequence[Any] = (),
    types: Mapping[str, int] | None = None,
) -> Path:
    type_of = types or {}
    graph = helper.make_graph(
        nodes,
        "tiny",
        [
            helper.make_tensor_value_info(name, type_of.get(name, TensorProto.FLOAT), dims)
            for name, dims in inputs.items()
        ],
        [helper.make_tensor_value_info(name, kind, dims) for name, (kind, dims) in outputs.items()],
        initializer=list(constants),
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(
        model, {name: value if isinstance(value, str) else json.dumps(value) for name, value in metadata.items()}
    )
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path
