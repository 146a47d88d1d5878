"""Detections in COCO's format: annotations (an object) or results (a list)."""

from __future__ import annotations

import reprlib
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.coco import ID, MAYBE_TEXT, TEXT, Entries, list_in, read_coco_json
from valuemap.errors import InputError
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.tables import Ints


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
    content = read_coco_json(path)
    is_results = isinstance(content, list)
    boxes = Entries(f"{path}: {'results' if is_results else 'annotations'}", _boxes_in(content, path))
    listed = Entries(f"{path}: images", [] if is_results else list_in(content, "images", path))
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
        other_names=listed.column("file_name", TEXT),
    )


def _boxes_in(content: Any, path: Path) -> list[Any]:
    boxes: list[Any] = content if isinstance(content, list) else list_in(content, "annotations", path)
    if not boxes:
        raise InputError(f"{path}: there are no detections in it", hint="did the detector find anything?")
    return boxes


def _sizes(listed: Entries) -> dict[str, tuple[int, int]]:
    sizes = ((entry["file_name"], entry.get("width"), entry.get("height")) for entry in listed.entries)
    return {name: (width, height) for name, width, height in sizes if width is not None and height is not None}


def _names_of_annotations(boxes: Entries, listed: Entries) -> list[str]:
    """Return the file name of each annotation; of an image that is not listed its id, which is no file name."""
    ids, names = listed.column("id", ID), listed.column("file_name", TEXT)
    name_of = _without_repeats(ids, names, listed.where)
    image_ids = [entry.get("image_id") for entry in boxes.entries]
    return [
        name_of[key] if ID.accepts(key) and key in name_of else f"image_id {reprlib.repr(key)}" for key in image_ids
    ]


def _names_of_results(boxes: Entries) -> list[str]:
    """Return the file name of each result: a bare number might be the id of another image elsewhere."""
    image_ids = boxes.column("image_id", ID, default="")
    names: list[str] = [
        name or (image_id if isinstance(image_id, str) else "")
        for name, image_id in zip(boxes.column("file_name", MAYBE_TEXT, default=""), image_ids, strict=True)
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


def _class_names(boxes: Entries, content: Any, path: Path) -> list[str]:
    """Return the class of each box; of those that have none, or one that is not listed, an empty text."""
    category_ids = [entry.get("category_id") for entry in boxes.entries]
    if isinstance(content, list) or not content.get("categories"):
        return [_class_of_id(key) for key in category_ids]
    categories = Entries(f"{path}: categories", list_in(content, "categories", path))
    name_of = _without_repeats(categories.column("id", ID), categories.column("name", TEXT), categories.where)
    return [name_of.get(key, "") if ID.accepts(key) else "" for key in category_ids]


def _class_of_id(key: Any) -> str:
    if not ID.accepts(key):
        return ""
    return key if isinstance(key, str) else f"class-{key}"


def _own_ids(boxes: Entries) -> Ints | None:
    ids = [entry.get("id") for entry in boxes.entries]
    is_whole = all(type(value) is int and 0 <= value < 2**63 for value in ids)
    return np.array(ids, dtype=np.int64) if is_whole and len(set(ids)) == len(ids) else None
