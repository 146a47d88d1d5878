"""Detections in the YAML of the Bosch Small Traffic Lights Dataset: a list of pictures with their boxes."""

from __future__ import annotations

import numpy as np

from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.files import read_yaml
from valuemap.readers.json_values import Json

_EXPECTED = "a YAML file: a list of {path, boxes: [{label, x_min, y_min, x_max, y_max}]}"


def read_bosch(file: DetectionFile) -> NamedBoxes:
    """Read boxes with edges in pixels from the picture's corner; `./` at the start of a path means nothing.

    Raises
    ------
    InputError
        The file is no such list, or has aliases.
    """
    content = Json(read_yaml(file.path, _EXPECTED), str(file.path), f"expected {_EXPECTED}")
    names, images, classes, edges, where = [], [], [], [], []
    for entry in content.entries():
        name = entry["path"].text().removeprefix("./")
        names.append(name)
        for box in entry["boxes"].entries():
            images.append(name)
            classes.append(box["label"].text() if "label" in box else file.class_name)
            edges.append([box[key].number() for key in ("x_min", "y_min", "x_max", "y_max")])
            where.append(box.where)
    found = np.array(edges, dtype=np.float64).reshape(-1, 4)
    return NamedBoxes.of_columns(
        image_names=images,
        class_names=classes,
        center=(found[:, :2] + found[:, 2:]) / 2.0,
        size=found[:, 2:] - found[:, :2],
        score=np.full(len(found), file.full_score),
        where=where.__getitem__,
        other_names=names,
    )
