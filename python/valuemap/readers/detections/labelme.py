"""Detections in the JSON of LabelMe: a file a picture."""

from __future__ import annotations

import math
from pathlib import Path

from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.detections.shapes import LEAST_CORNERS, Box, Drawn, around_points, picture_beside
from valuemap.readers.files import files_below, read_json
from valuemap.readers.json_values import Json

_EXPECTED = "JSON files of LabelMe, one a picture: imagePath and shapes with label, points and shape_type"
_CORNERS_OF = {"polygon": LEAST_CORNERS, "rectangle": 2, "rotation": LEAST_CORNERS, "circle": 2, "mask": 2}
"""Shapes that have boxes, and how many points they have at least."""


def read_labelme(file: DetectionFile) -> NamedBoxes:
    """Read a file, or a folder of files `NAME.json`, with points in pixels from the picture's corner.

    Of a rectangle, a polygon, a circle (its centre and a point on it) and a mask (its first and last pixel) the box
    around it counts. Other shapes have no box and are left out. A `score`, which X-AnyLabeling writes, is that of the
    box. The picture is `imagePath`, in the folder of the file unless it names one itself.

    Raises
    ------
    InputError
        There are no such files, or one is no such JSON.
    """
    found = Drawn()
    for name, path in files_below(file.path, ".json", _EXPECTED):
        _add_picture(name, path, found)
    return found.named_boxes(file, _EXPECTED)


def _add_picture(name: str, path: Path, found: Drawn) -> None:
    content = Json(read_json(path, _EXPECTED), str(path), f"expected {_EXPECTED}")
    shapes = content["shapes"]
    picture = picture_beside(name, content["imagePath"].text() if "imagePath" in content else "")
    found.names.append(picture)
    if "imageWidth" in content and "imageHeight" in content:
        found.pictures[picture] = (content["imageWidth"].whole(), content["imageHeight"].whole())
    for shape in shapes.entries():
        label = shape["label"].key() if "label" in shape else ""
        score = shape["score"].number() if "score" in shape else None
        found.add(shape.where, picture, label, _box(shape), score)


def _box(shape: Json) -> Box | None:
    kind = shape["shape_type"].text() if "shape_type" in shape else "polygon"  # LabelMe 3 has polygons alone.
    if kind not in _CORNERS_OF:
        return None
    points = [point.numbers(2).tolist() for point in shape["points"].entries()]
    if len(points) < _CORNERS_OF[kind]:
        raise shape["points"].wrong(f"expected at least {_CORNERS_OF[kind]} points of a {kind}")
    if kind == "circle":
        radius = math.dist(points[0], points[1])
        return points[0][0], points[0][1], 2 * radius, 2 * radius
    x, y, width, height = around_points(points)
    return (x + 0.5, y + 0.5, width + 1.0, height + 1.0) if kind == "mask" else (x, y, width, height)
