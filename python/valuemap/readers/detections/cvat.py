"""Detections in the XML of CVAT, version 1.1 for images."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from valuemap.errors import InputError
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.detections.shapes import (
    LEAST_CORNERS,
    Box,
    Drawn,
    around_ellipse,
    around_points,
    around_turned_box,
)
from valuemap.readers.files import read_xml

_EXPECTED = "an XML file that CVAT exported for images 1.1"


_WITHOUT_BOX = ("points", "polyline", "cuboid", "skeleton")


def read_cvat(file: DetectionFile) -> NamedBoxes:
    """Read the shapes of `<image name width height>` elements, in pixels from the corner.

    `<box label xtl ytl xbr ybr>` is a box. Of one that is turned about its middle (`rotation`, degrees), of a polygon
    and of an ellipse the upright box around it counts, and of a mask the rectangle that it fills. Other shapes have no
    box and are left out.

    Tracks of videos have frame numbers instead of file names and are refused.

    Raises
    ------
    InputError
        The file is no such XML, has a document type, or a value is missing.
    """
    found = Drawn()
    open_image: str | None = None
    in_skeleton = False

    def on_element(name: str, attributes: dict[str, str], line: int) -> None:
        nonlocal open_image, in_skeleton
        where = f"{file.path} line {line}"
        if name == "image":
            open_image = _text(attributes, "name", where)
            found.names.append(open_image)
            if "width" in attributes and "height" in attributes:
                size = [_number(attributes, key, where) for key in ("width", "height")]
                found.pictures[open_image] = (int(size[0]), int(size[1]))
        elif name == "/image":
            open_image = None
        elif name == "track":
            raise InputError(
                f"{where}: tracks name frames, not files", hint='export the task again as "CVAT for images 1.1"'
            )
        elif name == "/skeleton":
            in_skeleton = False
        elif open_image is not None and not in_skeleton and (name in _BOX_OF or name in _WITHOUT_BOX):
            box = _BOX_OF[name](attributes, where) if name in _BOX_OF else None
            found.add(where, open_image, _text(attributes, "label", where), box)
            in_skeleton = name == "skeleton"

    read_xml(file.path, _EXPECTED, on_element)
    return found.named_boxes(file, _EXPECTED)


def _of_box(attributes: dict[str, str], where: str) -> Box:
    left, top, right, bottom = (_number(attributes, key, where) for key in ("xtl", "ytl", "xbr", "ybr"))
    turn_rad = _turn_rad(attributes, where)
    return around_turned_box((left + right) / 2, (top + bottom) / 2, right - left, bottom - top, turn_rad)


def _of_polygon(attributes: dict[str, str], where: str) -> Box:
    text = _text(attributes, "points", where)
    try:
        corners = [(float(x), float(y)) for x, y in (corner.split(",") for corner in text.split(";"))]
    except ValueError:
        corners = []
    if len(corners) < LEAST_CORNERS:
        raise InputError(f"{where}: points: expected x,y;x,y;x,y, found {text[:40]!r}", hint="repair the file")
    return around_points(corners)


def _of_mask(attributes: dict[str, str], where: str) -> Box:
    left, top, width, height = (_number(attributes, key, where) for key in ("left", "top", "width", "height"))
    return left + width / 2, top + height / 2, width, height


def _of_ellipse(attributes: dict[str, str], where: str) -> Box:
    x, y, across, along = (_number(attributes, key, where) for key in ("cx", "cy", "rx", "ry"))
    return around_ellipse(x, y, across, along, _turn_rad(attributes, where))


def _turn_rad(attributes: dict[str, str], where: str) -> float:
    """Return how far a shape is turned about its middle."""
    return math.radians(_number(attributes, "rotation", where)) if "rotation" in attributes else 0.0


_BOX_OF: Mapping[str, Callable[[dict[str, str], str], Box]] = {
    "box": _of_box,
    "polygon": _of_polygon,
    "mask": _of_mask,
    "ellipse": _of_ellipse,
}


def _text(attributes: dict[str, str], key: str, where: str) -> str:
    if not attributes.get(key):
        raise InputError(
            f"{where}: expected {key}=..., found {', '.join(attributes) or 'nothing'}", hint=f"expected {_EXPECTED}"
        )
    return attributes[key]


def _number(attributes: dict[str, str], key: str, where: str) -> float:
    text = _text(attributes, key, where)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{where}: {key}: expected a number, found {text[:40]!r}", hint="repair the file")
    return number
