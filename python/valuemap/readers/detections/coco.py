"""Detections in COCO's format: annotations (an object) or results (a list)."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Ints
from valuemap.coco import EXPECTED, ID, MAYBE_TEXT, TEXT, Entries, by_texts_too
from valuemap.errors import InputError, SettingError
from valuemap.json_lists import read_json_lists
from valuemap.readers.boxes import CROWD, SINGLE, BoxWriter
from valuemap.readers.detections.named_boxes import OF_OTHERS, DetectionFile, NamedBoxes


def read_coco(file: DetectionFile) -> NamedBoxes:
    """Read boxes; images are known by file name.

    An object has `images` (id, file_name), `annotations` (image_id, category_id, bbox, maybe score and id)
    and maybe `categories` (id, name). A list has results (category_id, bbox, score) that name their image in
    `file_name`, or in an `image_id` that is a text, or whose `image_id` and `category_id` are of the lists in
    `file.image_list`. A bbox is x, y, width, height of continuous edges, so its
    centre needs no further half pixel. Where `iscrowd` is 1 it is of many objects, and left out. Without
    `categories` the class of id 9 is `class-9`; without `score` the score is 1. Where every annotation has a
    whole number of its own as `id`, that is its detection_id.

    The file is read in portions, and of a box its numbers are kept, in a temporary file.

    Raises
    ------
    InputError
        The file is no COCO file or has no boxes, or one does not say its image or class.
    SettingError
        Images are listed in the file and apart.
    """
    path = file.path
    lists = _read_lists(path, _LISTS)
    boxes = lists[None] if isinstance(lists.get(None), _Results) else _list_in(lists, "annotations", path)
    if not len(boxes.writer.rows):
        raise InputError(f"{path}: there are no detections in it", hint="did the detector find anything?")
    if isinstance(boxes, _Annotations):
        if file.image_list is not None:
            raise SettingError(
                f"detection-images: {path} lists its images itself", hint="leave this option away, or name results"
            )
        images = _list_in(lists, "images", path)
    elif file.image_list is not None:
        path = file.image_list
        lists = _read_lists(path, _NAMES)
        images = _list_in(lists, "images", path)
    else:
        boxes.refuse_unnamed()
        images = _Named("")
    categories = by_texts_too(_list_in(lists, "categories", path).name_of) if lists.get("categories") else None
    return NamedBoxes(
        rows=boxes.writer.rows,
        image_names=boxes.image_names(by_texts_too(images.name_of)),
        class_names=[_name_of_class(key, categories) for key in boxes.classes.keys],
        where=partial(_place_of, boxes.where),
        has_ids=boxes.has_ids,
        pictures=images.sizes,
        other_names=list(images.name_of.values()),
    )


def _read_lists(path: Path, kinds: Mapping[str | None, Callable[[str], _Boxes | _Named]]) -> dict[str | None, Any]:
    """Return what is made of the lists in a file."""
    lists: dict[str | None, Any] = {}
    for portion in read_json_lists(path, EXPECTED):
        key, where = portion.key, f"{path}: {portion.key or 'results'}"
        if portion.entries is None:  # The last of a name counts.
            lists[key] = portion.value
        elif key in kinds:
            if portion.first == 0:
                lists[key] = kinds[key](where)
            lists[key].add(Entries(where, portion.entries, portion.first))
    return lists


class _Numbered:
    """A value an entry, as the number of the one that is like it; what is no id is a tuple of how it is written."""

    def __init__(self) -> None:
        self._number: dict[Any, int] = {}

    @property
    def keys(self) -> list[Any]:
        """The distinct values by their numbers."""
        return list(self._number)

    def codes_of(self, values: list[Any]) -> Ints:
        """Return the number of each value (N)."""
        number = self._number
        keys = (_whole(value) if ID.accepts(_whole(value)) else (reprlib.repr(value),) for value in values)
        return np.fromiter((number.setdefault(key, len(number)) for key in keys), np.int64, len(values))


def _whole(value: Any) -> Any:
    """Return a whole number as such that is written as 3.0, as programs do where a column has gaps."""
    return int(value) if type(value) is float and value.is_integer() else value


class _Boxes:
    """What boxes are, without what more their entries hold."""

    has_ids = False

    def __init__(self, where: str) -> None:
        self.where, self.writer = where, BoxWriter()
        self.images, self.classes = _Numbered(), _Numbered()

    def write(self, entries: Entries, images: list[Any], ids: Ints | None = None) -> None:
        """Keep the boxes of these images."""
        panoptic = next((row for row, entry in enumerate(entries.entries) if "segments_info" in entry), None)
        if panoptic is not None:
            raise InputError(
                f"{self.where}[{entries.first + panoptic}]: is a panoptic segmentation, not a box",
                hint="export its things as instances with boxes",
            )
        bbox_px = entries.boxes().reshape(-1, 4)
        self.writer.add(
            image=self.images.codes_of(images),
            kind=self.classes.codes_of([entry.get("category_id") for entry in entries.entries]),
            center=bbox_px[:, :2] + bbox_px[:, 2:] / 2.0,
            size=bbox_px[:, 2:],
            score=entries.numbers("score", 1.0),
            detection_id=ids,
            entry=np.array([CROWD if entry.get("iscrowd") == 1 else SINGLE for entry in entries.entries]),
        )


class _Annotations(_Boxes):
    """Boxes with an `image_id` of a listed image, and maybe whole numbers as ids."""

    has_ids = True

    def add(self, entries: Entries) -> None:
        ids = [entry.get("id") for entry in entries.entries]
        self.has_ids &= all(type(value) is int and 0 <= value < 2**63 for value in ids)
        images = [entry.get("image_id") for entry in entries.entries]
        self.write(entries, images, np.array(ids, np.int64) if self.has_ids else np.zeros(len(ids), np.int64))

    def image_names(self, name_of: Mapping[Any, str]) -> list[str]:
        """Return the file names of the images; of one that is not listed its id, which is no file name."""
        return [name_of.get(key) or f"image_id {_written(key)}" for key in self.images.keys]


class _Results(_Boxes):
    """Boxes that name their file; or a number, which might be the id of another image elsewhere."""

    def __init__(self, where: str) -> None:
        super().__init__(where)
        self._unnamed, self._first_unnamed = 0, (0, "")

    def add(self, entries: Entries) -> None:
        image_ids = entries.column("image_id", ID, default="")
        names = entries.column("file_name", MAYBE_TEXT, default="")
        unnamed = [
            (row, reprlib.repr(image_id))
            for row, (name, image_id) in enumerate(zip(names, image_ids, strict=True), start=entries.first)
            if not (name or (image_id and isinstance(image_id, str)))
        ]
        self._first_unnamed = self._first_unnamed if self._unnamed or not unnamed else unnamed[0]
        self._unnamed += len(unnamed)
        self.write(entries, [name or image_id for name, image_id in zip(names, image_ids, strict=True)])

    def refuse_unnamed(self) -> None:
        """Raise where there are boxes of which nothing says the file."""
        if self._unnamed:
            row, image_id = self._first_unnamed
            if image_id == repr(""):
                raise InputError(
                    f"{self.where}[{row}]: has neither image_id nor file_name ({self._unnamed} entries)",
                    hint=f"is it a COCO file? {OF_OTHERS}",
                )
            raise InputError(
                f"{self.where}[{row}]: image_id {image_id} does not say which file it is ({self._unnamed} entries)",
                hint="name the COCO file that the detector ran on with --detection-images, or add file_name to every "
                "result",
            )

    def image_names(self, name_of: Mapping[Any, str]) -> list[str]:
        """Return the file names of the images; of a number that is not listed that, which is no file name."""
        return [
            name_of.get(key) or (key if isinstance(key, str) and key else f"image_id {_written(key)}")
            for key in self.images.keys
        ]


class _Named:
    """The names of images or categories by id, and the sizes of pictures by name."""

    def __init__(self, where: str, text: str = "file_name") -> None:
        self._where, self._text = where, text
        self.name_of: dict[Any, str] = {}
        self.sizes: dict[str, tuple[int, int]] = {}

    def __len__(self) -> int:
        return len(self.name_of)

    def add(self, entries: Entries) -> None:
        ids, names = entries.column("id", ID), entries.column(self._text, TEXT)
        for row, (key, name, entry) in enumerate(zip(ids, names, entries.entries, strict=True), start=entries.first):
            if key in self.name_of:
                raise InputError(
                    f"{self._where}[{row}]: id {key!r} is there twice", hint="give every entry an id of its own"
                )
            self.name_of[key] = name
            if entry.get("width") is not None and entry.get("height") is not None:
                width, height = (_as_number(entry[side]) for side in ("width", "height"))
                self.sizes[name] = (width, height)


def _as_number(value: Any) -> Any:
    """Return a number that is written as a text; what is none as it is, for the refusal that will name it."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


_NAMES: Mapping[str | None, Callable[[str], _Boxes | _Named]] = {
    "images": _Named,
    "categories": partial(_Named, text="name"),
}
_LISTS: Mapping[str | None, Callable[[str], _Boxes | _Named]] = {
    None: _Results,
    "annotations": _Annotations,
    **_NAMES,
}
"""What is made of each list; None is the whole file."""


def _list_in(lists: Mapping[str | None, Any], key: str, path: Path) -> Any:
    found = lists.get(key)
    if not isinstance(found, _Boxes | _Named):
        raise InputError(
            f"{path}: expected a list of results, or an object with lists named images and annotations; "
            f"there is no list named {key}",
            hint=f"is it a COCO file? {OF_OTHERS}",
        )
    return found


def _name_of_class(key: Any, name_of: Mapping[Any, str] | None) -> str:
    """Return the class of a category; of one that is no id, or not listed where some are, an empty text."""
    if name_of is not None:
        return name_of.get(key, "")
    if isinstance(key, str):
        return key
    return f"class-{key}" if isinstance(key, int) else ""


def _written(key: Any) -> str:
    return str(key[0]) if isinstance(key, tuple) else reprlib.repr(key)


def _place_of(where: str, row: int) -> str:
    return f"{where}[{row}]"
