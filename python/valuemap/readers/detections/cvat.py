"""Detections in the XML of CVAT, version 1.1 for images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from valuemap.errors import InputError
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.files import read_xml

_EXPECTED = "an XML file that CVAT exported for images 1.1"


@dataclass
class _Found:
    """What has been read so far, and which image and box are open."""

    where: list[str] = field(default_factory=list)
    images: list[str] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    edges: list[list[float]] = field(default_factory=list)
    turn_deg: list[float] = field(default_factory=list)
    pictures: dict[str, tuple[int, int]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    open_image: str | None = None


def read_cvat(file: DetectionFile) -> NamedBoxes:
    """Read the boxes of `<image name width height>` elements: `<box label xtl ytl xbr ybr>` in pixels from the corner.

    Of a box that is turned about its middle (`rotation`, degrees), the upright box around it counts.

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
        elif name == "box" and found.open_image is not None:
            found.where.append(where)
            found.images.append(found.open_image)
            found.classes.append(_text(attributes, "label", where))
            found.edges.append([_number(attributes, key, where) for key in ("xtl", "ytl", "xbr", "ybr")])
            found.turn_deg.append(_number(attributes, "rotation", where) if "rotation" in attributes else 0.0)

    read_xml(file.path, _EXPECTED, on_element)
    if not found.names:
        raise InputError(f"{file.path}: there are no images in it", hint=f"expected {_EXPECTED}")
    edges = np.array(found.edges, dtype=np.float64).reshape(-1, 4)
    size = edges[:, 2:] - edges[:, :2]
    turn = np.radians(found.turn_deg)[:, None]
    return NamedBoxes.of_columns(
        image_names=found.images,
        class_names=found.classes,
        center=(edges[:, :2] + edges[:, 2:]) / 2.0,
        size=np.abs(np.cos(turn)) * size + np.abs(np.sin(turn)) * size[:, ::-1],
        score=np.full(len(edges), file.full_score),
        where=found.where.__getitem__,
        pictures=found.pictures,
        other_names=found.names,
    )


def _text(attributes: dict[str, str], key: str, where: str) -> str:
    if not attributes.get(key):
        raise InputError(
            f"{where}: expected {key}=..., found {', '.join(attributes) or 'nothing'}", hint=f"expected {_EXPECTED}"
        )
    return attributes[key]


def _number(attributes: dict[str, str], key: str, where: str) -> float:
    text = _text(attributes, key, where)
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{where}: {key}: expected a number, found {text[:40]!r}", hint="repair the file") from error
