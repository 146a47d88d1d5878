"""Detections of the VGG Image Annotator (VIA), versions 1 and 2: its project, or its export as JSON or CSV."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from valuemap.errors import InputError, SettingError
from valuemap.readers.csv_file import CsvFile
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.detections.shapes import LEAST_CORNERS, Box, Drawn, around_ellipse, around_points
from valuemap.readers.files import read_json
from valuemap.readers.json_values import Json
from valuemap.text_files import first_line

_EXPECTED = "JSON or CSV of the VGG Image Annotator 2: pictures with filename and regions with shape_attributes"
_PROJECT = "_via_img_metadata"
_NAMES = ("filename", "#filename")
"""The column of pictures, in version 2 and 1."""
REGIONS = "region_shape_attributes"
"""The column that only its tables have."""
_FIELDS = (REGIONS, "region_attributes")
_WITHOUT_BOX = ("point", "polyline")


@dataclass(frozen=True)
class _Region:
    """A region of a picture: its shape, and what people said of it."""

    where: str
    picture: str
    shape: Json
    said: Mapping[str, Any]


def is_via(key: str | None, value: Any) -> bool:
    """Return whether a member of an object is one of a project or an export of VIA, versions 1 to 3."""
    is_picture = isinstance(value, dict) and "filename" in value and "regions" in value
    return is_picture or key == "project" or (key or "").startswith("_via_")


def read_via(file: DetectionFile) -> NamedBoxes:
    """Read regions, in pixels from the picture's corner.

    Of a rectangle, polygon, circle or ellipse the box around it counts; points and lines have no box and are left out.
    The class is the value of the attribute `file.columns["class"]`, else of `class`, else of the only attribute that
    regions have; regions without attributes have `file.class_name`.

    Raises
    ------
    InputError
        The file is of another format or version, a region is no such shape, or nothing says which attribute is the
        class.
    """
    others = sorted(file.columns.keys() - {"class"})
    if others:
        raise SettingError(
            f"detection-column {others[0]}: of regions only the attribute that is the class can be named",
            hint="leave it away, or say class=NAME",
        )
    found = Drawn()
    is_table = file.path.suffix.lower() == ".csv"
    regions = list(_of_table(file, found) if is_table else _of_json(file, found))
    attribute = _class_attribute(regions, file)
    for region in regions:
        name = file.class_name if attribute is None else _value(region.said.get(attribute))
        found.add(region.where, region.picture, name, _box(region.shape))
    return found.named_boxes(file, _EXPECTED)


def _of_json(file: DetectionFile, found: Drawn) -> Iterator[_Region]:
    content = Json(read_json(file.path, _EXPECTED), str(file.path), f"expected {_EXPECTED}")
    if "file" in content and "metadata" in content and "view" in content:
        raise InputError(f"{file.path}: is a project of VIA 3", hint="export its regions of images as COCO")
    listing = content[_PROJECT] if _PROJECT in content else content  # noqa: SIM401 (no dict)
    pictures = [picture for _, picture in listing.items()]
    for picture in pictures:
        name = picture["filename"].text()
        found.names.append(name)
        regions = picture["regions"]  # An object of them in version 1.
        listed = [region for _, region in regions.items()] if isinstance(regions.value, dict) else regions.entries()
        for region in listed:
            said = region["region_attributes"].object() if "region_attributes" in region else {}
            yield _Region(region.where, name, region["shape_attributes"], said)


def _of_table(file: DetectionFile, found: Drawn) -> Iterator[_Region]:
    """Yield the regions of a table, which has JSON in its fields, and a row for a picture without any."""
    table = CsvFile(file.path, _EXPECTED, texts=(*_NAMES, *_FIELDS), numbers=())
    name_of_names = next((name for name in _NAMES if table.has(name)), None)
    if name_of_names is None or not table.has(*_FIELDS):
        raise table.missing(f"filename, {' and '.join(_FIELDS)}")
    columns = [table.texts(name) for name in (name_of_names, *_FIELDS)]
    for row, (name, shape, said) in enumerate(zip(*columns, strict=True)):
        found.names.append(name)
        where = table.line(row)
        fields = [Json(_fields(text, where), where, f"expected {_EXPECTED}") for text in (shape, said)]
        if fields[0].object():
            yield _Region(where, name, fields[0], fields[1].object())


def _fields(text: str, where: str) -> Any:
    try:
        return json.loads(text or "{}")
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{where}: cannot be read as JSON: {first_line(error)}", hint="export it again, or as JSON"
        ) from error


def _class_attribute(regions: list[_Region], file: DetectionFile) -> str | None:
    """Return the attribute of regions that is their class; None where they have no attributes."""
    names = sorted({name for region in regions for name in region.said})
    asked = file.columns.get("class", "class")
    if asked in names or not names:
        return asked if asked in names else None
    if len(names) == 1 and "class" not in file.columns:
        return names[0]
    raise InputError(
        f"{file.path}: regions have no attribute {asked!r}, but {', '.join(names)[:200]}",
        hint="say which is the class with --detection-column class=NAME",
    )


def _value(value: Any) -> str:
    """Return a text, or the one that is ticked of many; an empty text, which is no class, where that is not one."""
    if isinstance(value, dict):
        ticked = [name for name, is_ticked in value.items() if is_ticked is True]
        return ticked[0] if len(ticked) == 1 else ""
    return str(value) if isinstance(value, str | int | float) else ""


def _box(shape: Json) -> Box | None:
    kind = shape["name"].text()
    if kind in _WITHOUT_BOX:
        return None
    if kind == "rect":
        left, top, width, height = (shape[key].number() for key in ("x", "y", "width", "height"))
        return left + width / 2, top + height / 2, width, height
    if kind in ("circle", "ellipse"):
        keys = ("cx", "cy", *(("r", "r") if kind == "circle" else ("rx", "ry")))
        x, y, across, along = (shape[key].number() for key in keys)
        return around_ellipse(x, y, across, along, shape["theta"].number() if "theta" in shape else 0.0)
    if kind == "polygon":
        of_axis = [[each.number() for each in shape[f"all_points_{axis}"].entries()] for axis in "xy"]
        if len(of_axis[0]) != len(of_axis[1]) or len(of_axis[0]) < LEAST_CORNERS:
            raise shape.wrong(f"expected at least {LEAST_CORNERS} points, as many x as y")
        return around_points(list(zip(*of_axis, strict=True)))
    raise shape["name"].wrong("expected rect, polygon, circle, ellipse, point or polyline")
