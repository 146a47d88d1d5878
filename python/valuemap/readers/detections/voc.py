"""Detections in the XML of Pascal VOC: a file a picture."""

from __future__ import annotations

import math
from pathlib import Path

from valuemap.errors import InputError
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.detections.shapes import Drawn, picture_beside
from valuemap.readers.files import files_below, read_xml

_EXPECTED = "XML files of Pascal VOC, one a picture: <annotation><filename>, <object><name>, <bndbox><xmin>..."
_CORNERS = ("xmin", "ymin", "xmax", "ymax")
_OBJECT = ("annotation", "object")
_BOX = (*_OBJECT, "bndbox")


def read_voc(file: DetectionFile) -> NamedBoxes:
    """Read a file, or a folder of files `NAME.xml`, with the edges of boxes in pixels from the picture's corner.

    The picture is `filename`, in the folder of the file unless it names one itself; without it, it has the name of the
    file. Boxes of parts of objects, and what else is told of these, are not read.

    Raises
    ------
    InputError
        There are no such files, or one is no such XML or has a document type.
    """
    found = Drawn()
    for name, path in files_below(file.path, ".xml", _EXPECTED):
        _add_picture(name, path, found)
    return found.named_boxes(file, _EXPECTED)


def _add_picture(name: str, path: Path, found: Drawn) -> None:
    stated, sizes = "", dict.fromkeys(("width", "height"), 0)
    objects: list[dict[str, str]] = []  # What each says: its line, name and corners.
    open_tags: list[str] = []

    def on_element(tag: str, _: dict[str, str], line: int) -> None:
        if not open_tags and tag != "annotation":
            raise InputError(f"{path} line {line}: expected <annotation>, found <{tag}>", hint=f"expected {_EXPECTED}")
        if tag.startswith("/"):
            open_tags.pop()
            return
        open_tags.append(tag)
        if tuple(open_tags) == _OBJECT:
            objects.append({"line": str(line)})
        elif tuple(open_tags) == _BOX:
            objects[-1] |= dict.fromkeys(_CORNERS, "")

    def on_text(tag: str, text: str, _: int) -> None:
        nonlocal stated
        inside = tuple(open_tags[:-1])
        if inside == _BOX or (inside == _OBJECT and tag == "name"):
            objects[-1][tag] = text
        elif inside == ("annotation",) and tag == "filename":
            stated = text
        elif inside == ("annotation", "size") and tag in sizes:
            sizes[tag] = int(size) if math.isfinite(size := _number(text)) else 0

    read_xml(path, _EXPECTED, on_element, on_text)
    picture = picture_beside(name, stated)
    found.names.append(picture)
    found.pictures[picture] = (sizes["width"], sizes["height"])
    for each in objects:
        box = None
        if "xmin" in each:
            left, top, right, bottom = (_number(each[corner]) for corner in _CORNERS)
            box = (left + right) / 2, (top + bottom) / 2, right - left, bottom - top
        found.add(f"{path} line {each['line']}", picture, each.get("name", ""), box)


def _number(text: str) -> float:
    """Return a number, NaN where it is none: the box is left out, and listed with its place."""
    try:
        return float(text)
    except ValueError:
        return math.nan
