"""A trained network as an ONNX file that says itself what it is. Importing this needs PyTorch."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from valuemap.detect.fc_densenet import FCDenseNet
from valuemap.detect.samples import MEAN, MULTIPLE_PX, STD
from valuemap.detect.structure import MIN_COARSE_SHARE
from valuemap.folders import new_file

_SIDES = ("height", "width")


def export_onnx(
    network: FCDenseNet, path: Path, *, classes: Sequence[str], threshold: float, minimum_component_px: int
) -> None:
    """Write `network` with sigmoid: `image` [batch, 3, height, width] in, `probability` [batch, classes, ...] out.

    Height and width are multiples of 32. The metadata name the kind, the classes, the threshold, the
    normalisation and the least size of a component.
    """
    with_sigmoid = nn.Sequential(network, nn.Sigmoid()).cpu().eval()
    rows, columns = (MULTIPLE_PX * torch.export.Dim(name) for name in ("rows", "columns"))
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    try:
        logger.setLevel(logging.ERROR)  # It says that torchvision, which nothing here needs, is not there.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PyTorch's exporter warns of its own inner workings.
            program = torch.onnx.export(
                with_sigmoid,
                (torch.zeros(2, 3, 2 * MULTIPLE_PX, 3 * MULTIPLE_PX),),
                dynamo=True,
                input_names=["image"],
                output_names=["probability"],
                dynamic_shapes=({0: torch.export.Dim("batch"), 2: rows, 3: columns},),
                verbose=False,
            )
    finally:
        logger.setLevel(level)
    model = program.model_proto
    _forget_the_source(model)
    for value in (model.graph.input[0], model.graph.output[0]):
        for dimension, name in zip(value.type.tensor_type.shape.dim[2:], _SIDES, strict=True):
            dimension.dim_param = name
    metadata = {
        "valuemap.kind": "segmentation",
        "valuemap.classes": json.dumps(list(classes)),
        "valuemap.threshold": repr(threshold),
        "valuemap.mean": json.dumps(MEAN),
        "valuemap.std": json.dumps(STD),
        "valuemap.color": "RGB",
        "valuemap.minimum_component_px": str(minimum_component_px),
        "valuemap.min_coarse_share": repr(MIN_COARSE_SHARE),
    }
    for key, text in metadata.items():
        model.metadata_props.add(key=key, value=text)
    with new_file(path) as temporary:
        temporary.write_bytes(model.SerializeToString(deterministic=True))


def _forget_the_source(model: Any) -> None:
    """Remove what the exporter notes about the lines of source: paths of this machine, and half of the file."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del part.metadata_props[:]
    del graph.value_info[:]
