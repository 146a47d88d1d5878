"""Files in COCO's format: the one way to read them, whether they hold detections, labels or results."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from valuemap.arrays import Floats
from valuemap.errors import InputError
from valuemap.text_files import read_json

EXPECTED = "a JSON file in COCO's format"
_FORMAT_HINT = "COCO's format is described at https://cocodataset.org/#format-data"
_HUGE = 1e300
T = TypeVar("T")
_NO_BOX = [float("nan")] * 4


@dataclass(frozen=True)
class Kind:
    """What a value must be, as a test and in words."""

    accepts: Callable[[Any], bool]
    expected: str


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < _HUGE  # False for NaN too.


ID = Kind(lambda value: type(value) in (int, str), "a whole number or a text")
TEXT = Kind(lambda value: isinstance(value, str) and value != "", "a text")
MAYBE_TEXT = Kind(lambda value: isinstance(value, str), "a text")


@dataclass(frozen=True)
class Entries:
    """A list of JSON objects and where it stands, for errors; or a part of it, from the entry `first` on."""

    where: str
    entries: list[dict[str, Any]]
    first: int = 0

    def __post_init__(self) -> None:
        wrong = next((row for row, entry in enumerate(self.entries) if not isinstance(entry, dict)), None)
        if wrong is not None:
            raise InputError(
                f"{self.where}[{self.first + wrong}]: expected an object, found {reprlib.repr(self.entries[wrong])}",
                hint=_FORMAT_HINT,
            )

    def column(self, key: str, kind: Kind, default: Any = None) -> list[Any]:
        """Return one value an entry; `default` stands for a missing key."""
        values = [entry.get(key, default) for entry in self.entries]
        wrong = next((row for row, value in enumerate(values) if not kind.accepts(value)), None)
        if wrong is not None:
            found = reprlib.repr(values[wrong])
            raise InputError(
                f"{self.where}[{self.first + wrong}]: {key}: expected {kind.expected}, found {found}",
                hint=_FORMAT_HINT,
            )
        return values

    def numbers(self, key: str, default: float) -> Floats:
        """Return one number an entry (N), NaN where there is something else; null is as good as none."""
        found = (entry.get(key) for entry in self.entries)
        values = (default if value is None else value for value in found)
        return np.array([value if _is_number(value) else np.nan for value in values], dtype=np.float64)

    def boxes(self) -> Floats:
        """Return x, y, width, height (N, 4), NaN where these are no four numbers.

        An entry without a box has that around its polygons.
        """
        found = [entry["bbox"] if entry.get("bbox") else _around(entry.get("segmentation")) for entry in self.entries]
        return np.array(
            [
                box if isinstance(box, list) and len(box) == 4 and all(map(_is_number, box)) else _NO_BOX
                for box in found
            ],
            dtype=np.float64,
        )

    def named(self, key: str, skipped: list[str]) -> dict[Any, str]:
        """Return the text under a key by id; entries without one, or with an id that is there already, are noted."""
        found: dict[Any, str] = {}
        for row, entry in enumerate(self.entries):
            if not ID.accepts(entry.get("id")) or not TEXT.accepts(entry.get(key)) or entry["id"] in found:
                skipped.append(f"{self.where}[{row}]: expected an id of its own and {key}, found {reprlib.repr(entry)}")
            else:
                found[entry["id"]] = entry[key]
        return found


def by_texts_too(value_of: Mapping[Any, T]) -> dict[Any, T]:
    """Return values by ids, and by whole numbers of texts and texts of numbers, as far as these are no ids themselves.

    Tools write "10" in one list and 10 in another.
    """
    written = {
        int(key) if isinstance(key, str) else str(key): value
        for key, value in value_of.items()
        if not isinstance(key, str) or _WHOLE.fullmatch(key)
    }
    return {**written, **value_of}


_WHOLE = re.compile(r"0|-?[1-9][0-9]{0,17}")


def _around(polygons: Any) -> list[float] | None:
    """Return the box around polygons of x, y, x, y and so on; None where they are something else."""
    if not isinstance(polygons, list) or not all(isinstance(each, list) for each in polygons):
        return None
    numbers = [value for each in polygons for value in each]
    if len(numbers) < _LEAST_NUMBERS or any(len(each) % 2 for each in polygons) or not all(map(_is_number, numbers)):
        return None
    x, y = numbers[::2], numbers[1::2]
    return [min(x), min(y), max(x) - min(x), max(y) - min(y)]


_LEAST_NUMBERS = 6
"""Of a polygon: three corners."""


@dataclass(frozen=True, eq=False)
class Labelled:
    """Annotations with their images and categories: what labels and the results of `valuemap detect` hold.

    `files` and `classes` are texts by id. `rows` (K) are the annotations that are usable: their place in the file,
    `box_px` (K, 4) left, top, width and height, `score` (K), `image` and `class_name` (K) and whether they are crowds.
    `skipped` names the others.
    """

    where: str
    files: dict[Any, str]
    rows: list[int]
    box_px: Floats
    score: Floats
    image: list[Any]
    class_name: list[str]
    is_crowd: list[bool]
    skipped: list[str]


def read_labelled(path: Path) -> Labelled:
    """Read `images` (id, file_name), `annotations` (image_id, category_id, bbox, maybe score) and `categories`.

    Raises
    ------
    InputError
        The file is missing, is no JSON, or lacks one of the lists.
    """
    content = read_json(path, EXPECTED)
    lists: dict[str, list[Any]] = {}
    for key in ("images", "annotations", "categories"):
        if not isinstance(content, dict) or not isinstance(content.get(key), list):
            raise InputError(f"{path}: expected an object with a list named {key}", hint=_FORMAT_HINT)
        lists[key] = content[key]
    skipped: list[str] = []
    # Of labels made by hand what is broken is left out and named.
    objects = {key: [each if isinstance(each, dict) else {} for each in entries] for key, entries in lists.items()}
    classes = by_texts_too(Entries(f"{path}: categories", objects["categories"]).named("name", skipped))
    files = Entries(f"{path}: images", objects["images"]).named("file_name", skipped)
    listed = by_texts_too({key: key for key in files})
    entries = Entries(f"{path}: annotations", objects["annotations"])
    box_px, score = entries.boxes(), entries.numbers("score", 1.0)
    rows = []
    for row, entry in enumerate(entries.entries):
        image, category = entry.get("image_id"), entry.get("category_id")
        is_listed = ID.accepts(image) and ID.accepts(category) and image in listed and category in classes
        if is_listed and np.isfinite(box_px[row]).all():
            rows.append(row)
        else:
            skipped.append(
                f"{entries.where}[{row}]: expected bbox, and image_id and category_id that are listed, "
                f"found {reprlib.repr(lists['annotations'][row])}"
            )
    chosen = [entries.entries[row] for row in rows]
    return Labelled(
        where=entries.where,
        files=files,
        rows=rows,
        box_px=box_px[rows].reshape(-1, 4),
        score=score[rows],
        image=[listed[entry["image_id"]] for entry in chosen],
        class_name=[classes[entry["category_id"]] for entry in chosen],
        is_crowd=[bool(entry.get("iscrowd")) for entry in chosen],
        skipped=skipped,
    )
