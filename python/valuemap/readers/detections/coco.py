"""Detections in COCO's format: annotations (an object) or results (a list)."""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.errors import InputError
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.files import read_json
from valuemap.tables import Floats, Ints

_FORMAT_HINT = "COCO's format is described at https://cocodataset.org/#format-data"
_HUGE = 1e300
_NO_BOX = [float("nan")] * 4


@dataclass(frozen=True)
class _Kind:
    """What a value must be, as a test and in words."""

    accepts: Callable[[Any], bool]
    expected: str


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < _HUGE  # False for NaN too.


_ID = _Kind(lambda value: type(value) in (int, str), "a whole number or a text")
_TEXT = _Kind(lambda value: isinstance(value, str) and value != "", "a text")
_MAYBE_TEXT = _Kind(lambda value: isinstance(value, str), "a text")


@dataclass(frozen=True)
class _Entries:
    """A list of JSON objects and where it stands, for errors."""

    where: str
    entries: list[dict[str, Any]]

    def __post_init__(self) -> None:
        wrong = next((row for row, entry in enumerate(self.entries) if not isinstance(entry, dict)), None)
        if wrong is not None:
            raise InputError(
                f"{self.where}[{wrong}]: expected an object, found {reprlib.repr(self.entries[wrong])}",
                hint=_FORMAT_HINT,
            )

    def column(self, key: str, kind: _Kind, default: Any = None) -> list[Any]:
        """Return one value an entry; `default` stands for a missing key."""
        values = [entry.get(key, default) for entry in self.entries]
        wrong = next((row for row, value in enumerate(values) if not kind.accepts(value)), None)
        if wrong is not None:
            found = reprlib.repr(values[wrong])
            raise InputError(
                f"{self.where}[{wrong}]: {key}: expected {kind.expected}, found {found}",
                hint=_FORMAT_HINT,
            )
        return values

    def numbers(self, key: str, default: float) -> Floats:
        """Return one number an entry (N), NaN where there is something else."""
        values = (entry.get(key, default) for entry in self.entries)
        return np.array([value if _is_number(value) else np.nan for value in values], dtype=np.float64)

    def boxes(self) -> Floats:
        """Return x, y, width, height (N, 4), NaN where these are no four numbers."""
        found = [entry.get("bbox") for entry in self.entries]
        return np.array(
            [
                box if isinstance(box, list) and len(box) == 4 and all(map(_is_number, box)) else _NO_BOX
                for box in found
            ],
            dtype=np.float64,
        )


def read_coco(file: DetectionFile) -> NamedBoxes:
    """Read boxes; images are known by file name.

    An object has `images` (id, file_name), `annotations` (image_id, category_id, bbox, maybe score and id)
    and maybe `categories` (id, name). A list has results (category_id, bbox, score) that name their image in
    `file_name`, or in an `image_id` that is a text. A bbox is x, y, width, height of continuous edges, so its
    centre needs no further half pixel. Without `categories` the class of id 9 is `class-9`; without `score`
    the score is 1. Where every annotation has a whole number of its own as `id`, that is its detection_id.

    Raises
    ------
    InputError
        The file is no COCO file or has no boxes, or one does not say its image or class.
    """
    path = file.path
    content = read_json(path, "a JSON file with detections in COCO's format")
    is_results = isinstance(content, list)
    boxes = _Entries(f"{path}: {'results' if is_results else 'annotations'}", _boxes_in(content, path))
    listed = _Entries(f"{path}: images", [] if is_results else _list_in(content, "images", path))
    bbox_px = boxes.boxes()
    return NamedBoxes(
        image_names=_names_of_results(boxes) if is_results else _names_of_annotations(boxes, listed),
        class_names=_class_names(boxes, content, path),
        center=bbox_px[:, :2] + bbox_px[:, 2:] / 2.0,
        size=bbox_px[:, 2:],
        score=boxes.numbers("score", 1.0),
        where=lambda row: f"{boxes.where}[{row}]",
        detection_id=None if is_results else _own_ids(boxes),
        pictures=_sizes(listed),
        other_names=listed.column("file_name", _TEXT),
    )


def _boxes_in(content: Any, path: Path) -> list[Any]:
    boxes: list[Any] = content if isinstance(content, list) else _list_in(content, "annotations", path)
    if not boxes:
        raise InputError(f"{path}: there are no detections in it", hint="did the detector find anything?")
    return boxes


def _list_in(content: Any, key: str, path: Path) -> list[Any]:
    found = content.get(key) if isinstance(content, dict) else None
    if not isinstance(found, list):
        raise InputError(
            f"{path}: expected a list of results, or an object with lists named images and annotations; "
            f"there is no list named {key}",
            hint="is it a COCO file?",
        )
    return found


def _sizes(listed: _Entries) -> dict[str, tuple[int, int]]:
    sizes = ((entry["file_name"], entry.get("width"), entry.get("height")) for entry in listed.entries)
    return {name: (width, height) for name, width, height in sizes if width is not None and height is not None}


def _names_of_annotations(boxes: _Entries, listed: _Entries) -> list[str]:
    """Return the file name of each annotation; of an image that is not listed its id, which is no file name."""
    ids, names = listed.column("id", _ID), listed.column("file_name", _TEXT)
    name_of = _without_repeats(ids, names, listed.where)
    image_ids = [entry.get("image_id") for entry in boxes.entries]
    return [
        name_of[key] if _ID.accepts(key) and key in name_of else f"image_id {reprlib.repr(key)}" for key in image_ids
    ]


def _names_of_results(boxes: _Entries) -> list[str]:
    """Return the file name of each result: a bare number might be the id of another image elsewhere."""
    image_ids = boxes.column("image_id", _ID, default="")
    names: list[str] = [
        name or (image_id if isinstance(image_id, str) else "")
        for name, image_id in zip(boxes.column("file_name", _MAYBE_TEXT, default=""), image_ids, strict=True)
    ]
    unnamed = [row for row, name in enumerate(names) if not name]
    if unnamed:
        raise InputError(
            f"{boxes.where}[{unnamed[0]}]: image_id {image_ids[unnamed[0]]!r} does not say which file it is "
            f"({len(unnamed)} entries)",
            hint="add file_name to every result, or put the results as annotations into an object, beside "
            "the list named images that the detector ran on",
        )
    return names


def _without_repeats(ids: list[Any], texts: list[str], where: str) -> dict[Any, str]:
    found = dict(zip(ids, texts, strict=True))
    if len(found) < len(ids):
        seen = set()
        row = next(row for row, key in enumerate(ids) if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise InputError(f"{where}[{row}]: id {ids[row]!r} is there twice", hint="give every entry an id of its own")
    return found


def _class_names(boxes: _Entries, content: Any, path: Path) -> list[str]:
    """Return the class of each box; of those that have none, or one that is not listed, an empty text."""
    category_ids = [entry.get("category_id") for entry in boxes.entries]
    if isinstance(content, list) or not content.get("categories"):
        return [_class_of_id(key) for key in category_ids]
    categories = _Entries(f"{path}: categories", _list_in(content, "categories", path))
    name_of = _without_repeats(categories.column("id", _ID), categories.column("name", _TEXT), categories.where)
    return [name_of.get(key, "") if _ID.accepts(key) else "" for key in category_ids]


def _class_of_id(key: Any) -> str:
    if not _ID.accepts(key):
        return ""
    return key if isinstance(key, str) else f"class-{key}"


def _own_ids(boxes: _Entries) -> Ints | None:
    ids = [entry.get("id") for entry in boxes.entries]
    is_whole = all(type(value) is int and 0 <= value < 2**63 for value in ids)
    return np.array(ids, dtype=np.int64) if is_whole and len(set(ids)) == len(ids) else None
