"""Labels in COCO's format: one JSON file for all pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from valuemap.detect.labels.pictures import BoxList, LabelledPictures
from valuemap.errors import InputError

_HINT = "COCO's format is described at https://cocodataset.org/#format-data"
_LISTS = ("images", "annotations", "categories")


def read_coco(path: Path) -> LabelledPictures:
    """Read `images` (id, file_name), `annotations` (image_id, category_id, bbox) and `categories` (id, name).

    A bbox is x, y, width, height of continuous edges. An annotation with `iscrowd` is a place to ignore.
    Pictures are looked for beside the file, and in a folder `images` beside it.

    Raises
    ------
    InputError
        The file is missing, is no JSON, or lacks one of the lists.
    """
    content = _load(path)
    skipped: list[str] = []
    names = _by_id(content["categories"], "name", f"{path}: categories", skipped)
    files = _by_id(content["images"], "file_name", f"{path}: images", skipped)
    boxes = {image: BoxList(skipped) for image in files}
    for row, entry in enumerate(content["annotations"]):
        where = f"{path}: annotations[{row}]"
        try:
            x, y, width, height = map(float, entry["bbox"])
            edges_px = (x, y, x + width, y + height)
            is_crowd = bool(entry.get("iscrowd"))
            boxes[entry["image_id"]].add(names[entry["category_id"]], edges_px, where, ignored=is_crowd)
        except (AttributeError, KeyError, TypeError, ValueError):
            skipped.append(f"{where}: expected bbox, and image_id and category_id that are listed, found {entry!r}")
    pictures = tuple(boxes[image].picture(_find(path.parent, name)) for image, name in files.items())
    return LabelledPictures(f"coco:{path}", pictures, tuple(skipped))


def _load(path: Path) -> dict[str, list[Any]]:
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file", hint="give a JSON file with labels in COCO's format") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}", hint="is it whole? Write it again") from error
    for key in _LISTS:
        if not isinstance(content, dict) or not isinstance(content.get(key), list):
            raise InputError(f"{path}: expected an object with a list named {key}", hint=_HINT)
    return {key: content[key] for key in _LISTS}


def _by_id(entries: list[Any], key: str, where: str, skipped: list[str]) -> dict[Any, str]:
    found: dict[Any, str] = {}
    for row, entry in enumerate(entries):
        name = entry.get(key) if isinstance(entry, dict) else None
        number = entry.get("id") if isinstance(entry, dict) else None
        if not isinstance(name, str) or not isinstance(number, int | str) or number in found:
            skipped.append(f"{where}[{row}]: expected an id of its own and {key}, found {entry!r}")
        else:
            found[number] = name
    return found


def _find(folder: Path, name: str) -> Path:
    inside = folder / "images" / name
    return inside if inside.exists() and not (folder / name).exists() else folder / name
