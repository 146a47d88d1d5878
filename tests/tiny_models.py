"""Tiny ONNX models, built on the spot, whose answers are known."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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


def says(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    *,
    picture: Dims = (1, 3, 64, 64),
    dims: Mapping[str, Dims] | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Write a model that gives the same outputs whatever it sees."""
    nodes = []
    constants = []
    declared = {}
    for name, value in outputs.items():
        kind = helper.np_dtype_to_tensor_dtype(value.dtype)
        constants.append(numpy_helper.from_array(value, f"{name}_value"))
        nodes += [
            helper.make_node("ReduceMax", ["image"], [f"{name}_seen"], keepdims=0),
            helper.make_node("Cast", [f"{name}_seen"], [f"{name}_cast"], to=kind),
            helper.make_node("Sub", [f"{name}_cast", f"{name}_cast"], [f"{name}_nothing"]),
            helper.make_node("Add", [f"{name}_value", f"{name}_nothing"], [name]),
        ]
        declared[name] = (kind, list((dims or {}).get(name, value.shape)))
    return _write(path, nodes, {"image": list(picture)}, declared, constants=constants, metadata=metadata or {})


def _write(
    path: Path,
    nodes: list[Any],
    inputs: Mapping[str, list[Any]],
    outputs: Mapping[str, tuple[int, list[Any]]],
    *,
    metadata: Mapping[str, Any],
    constants: Sequence[Any] = (),
) -> Path:
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, dims) for name, dims in inputs.items()],
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
