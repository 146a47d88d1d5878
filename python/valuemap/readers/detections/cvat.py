"""Detections in the XML of CVAT, version 1.1 for images."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from valuemap.errors import InputError
from valuemap.readers.boxes import NO_BOX, SINGLE
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.files import read_xml

_EXPECTED = "an XML file that CVAT exported for images 1.1"


_WITHOUT_BOX = ("points", "polyline", "cuboid", "skeleton")
_LEAST_CORNERS = 3


@dataclass
class _Found:
    """What has been read so far, and which image and skeleton are open."""

    where: list[str] = field(default_factory=list)
    images: list[str] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    boxes_px: list[tuple[float, float, float, float]] = field(default_factory=list)
    entries: list[int] = field(default_factory=list)
    pictures: dict[str, tuple[int, int]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    open_image: str | None = None
    in_skeleton: bool = False


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
    found = _Found()

    def on_element(name: str, attributes: dict[str, str], line: int) -> None:
        where = f"{file.path} line {line}"
        if name == "image":
            found.open_image = _text(attributes, "name", where)
            found.names.append(found.open_image)
            if "width" in attributes and "height" in attributes:
                size = [_number(attributes, key, where) for key in ("width", "height")]
                found.pictures[found.open_image] = (int(size[0]), int(size[1]))
        elif name == "/image":
            found.open_image = None
        elif name == "track":
            raise InputError(
                f"{where}: tracks name frames, not files", hint='export the task again as "CVAT for images 1.1"'
            )
        elif name == "/skeleton":
            found.in_skeleton = False
        elif found.open_image is not None and not found.in_skeleton and (name in _BOX_OF or name in _WITHOUT_BOX):
            found.where.append(where)
            found.images.append(found.open_image)
            found.classes.append(_text(attributes, "label", where))
            found.boxes_px.append(_BOX_OF[name](attributes, where) if name in _BOX_OF else (math.nan,) * 4)
            found.entries.append(SINGLE if name in _BOX_OF else NO_BOX)
            found.in_skeleton = name == "skeleton"

    read_xml(file.path, _EXPECTED, on_element)
    if not found.names:
        raise InputError(f"{file.path}: there are no images in it", hint=f"expected {_EXPECTED}")
    boxes_px = np.array(found.boxes_px, dtype=np.float64).reshape(-1, 4)
    return NamedBoxes.of_columns(
        image_names=found.images,
        class_names=found.classes,
        center=boxes_px[:, :2],
        size=boxes_px[:, 2:],
        score=np.full(len(boxes_px), file.full_score),
        entry=np.array(found.entries, np.int64),
        where=found.where.__getitem__,
        pictures=found.pictures,
        other_names=found.names,
    )


def _of_box(attributes: dict[str, str], where: str) -> tuple[float, float, float, float]:
    """Return centre x and y, width and height in pixels; so do the other shapes."""
    left, top, right, bottom = (_number(attributes, key, where) for key in ("xtl", "ytl", "xbr", "ybr"))
    cosine, sine = _turn(attributes, where)
    width, height = right - left, bottom - top
    return (left + right) / 2, (top + bottom) / 2, cosine * width + sine * height, cosine * height + sine * width


def _of_polygon(attributes: dict[str, str], where: str) -> tuple[float, float, float, float]:
    text = _text(attributes, "points", where)
    try:
        corners = [(float(x), float(y)) for x, y in (corner.split(",") for corner in text.split(";"))]
    except ValueError:
        corners = []
    if len(corners) < _LEAST_CORNERS:
        raise InputError(f"{where}: points: expected x,y;x,y;x,y, found {text[:40]!r}", hint="repair the file")
    (left, top), (right, bottom) = np.min(corners, axis=0).tolist(), np.max(corners, axis=0).tolist()
    return (left + right) / 2, (top + bottom) / 2, right - left, bottom - top


def _of_mask(attributes: dict[str, str], where: str) -> tuple[float, float, float, float]:
    left, top, width, height = (_number(attributes, key, where) for key in ("left", "top", "width", "height"))
    return left + width / 2, top + height / 2, width, height


def _of_ellipse(attributes: dict[str, str], where: str) -> tuple[float, float, float, float]:
    x, y, across, along = (_number(attributes, key, where) for key in ("cx", "cy", "rx", "ry"))
    cosine, sine = _turn(attributes, where)
    return x, y, 2 * math.hypot(cosine * across, sine * along), 2 * math.hypot(cosine * along, sine * across)


def _turn(attributes: dict[str, str], where: str) -> tuple[float, float]:
    """Return cosine and sine of how far a shape is turned about its middle, without their signs."""
    turn = math.radians(_number(attributes, "rotation", where)) if "rotation" in attributes else 0.0
    return abs(math.cos(turn)), abs(math.sin(turn))


_BOX_OF = {"box": _of_box, "polygon": _of_polygon, "mask": _of_mask, "ellipse": _of_ellipse}


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
