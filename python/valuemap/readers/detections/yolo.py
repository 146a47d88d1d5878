"""Detections in YOLO's format: a folder with a text file a picture, of the same name."""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.errors import InputError
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.files import check_folder, file_in, read_text, read_yaml

_EXPECTED = "a folder of text files with rows: class cx cy width height [confidence], as fractions of the picture"
_NAMES_FILES = ("data.yaml", "data.yml", "dataset.yaml", "dataset.yml", "classes.txt", "obj.names")
_LARGEST_CLASS = 100_000


def read_yolo(file: DetectionFile) -> NamedBoxes:
    """Read a folder of files `NAME.txt` for the pictures `NAME.jpg`, with rows of fractions of the picture.

    A row is class, centre x and y, width, height and maybe the confidence, and after it the number of a track. An odd
    number of values from 7 up is a class and a polygon, of which the box counts, an even one from 10 up has the
    confidence too. `data.yaml`, `dataset.yaml` (names), `classes.txt` or `obj.names` in the
    folder or the one above name the classes; else class 9 is `class-9`.

    Raises
    ------
    InputError
        There are no such files, a file is not text, or a row is of another form.
    """
    folder = check_folder(file.path, _EXPECTED)
    paths = sorted(
        path for path in folder.rglob("*") if path.suffix.lower() == ".txt" and path.name not in _NAMES_FILES
    )
    if not paths:
        raise InputError(f"{folder}: there are no .txt files in it", hint=f"expected {_EXPECTED}")
    names = _class_names(folder)
    images, classes, places, scores, where = [], [], [], [], []
    for path in paths:
        name = path.relative_to(folder).as_posix()
        if _is_blank(file_in(folder, name, _EXPECTED)):
            continue  # Nothing is in the picture.
        for line, row in enumerate(read_text(path, _EXPECTED).splitlines(), start=1):
            if not row.strip():
                continue
            code, place, score = _row(row, f"{path} line {line}")
            images.append(name)
            classes.append(names.get(code, f"class-{code}") if names is not None else f"class-{code}")
            places.append(place)
            scores.append(score * file.full_score)
            where.append(f"{path} line {line}")
    boxes = np.array(places, dtype=np.float64).reshape(-1, 4)
    return NamedBoxes.of_columns(
        image_names=images,
        class_names=classes,
        center=boxes[:, :2],
        size=boxes[:, 2:],
        score=np.array(scores, dtype=np.float64),
        where=where.__getitem__,
        fractions=True,
    )


def _is_blank(path: Path) -> bool:
    return path.stat().st_size <= _MOST_BLANK and not path.read_bytes().removeprefix(codecs.BOM_UTF8).strip()


_MOST_BLANK = 16
"""Bytes of a file that may hold a mark and the ends of lines, and no row."""


def _row(row: str, where: str) -> tuple[int, list[float], float]:
    """Return class, place and confidence; what Ultralytics writes after these of a track is only a whole number."""
    fields = row.split()
    try:
        code, values = int(fields[0]), [float(field) for field in fields[1:]]
    except ValueError:
        code, values = -1, []
    is_numbered = fields[-1].isdecimal() and values[-1:] >= [1.0]
    if len(values) == 6 and is_numbered:
        values.pop()
    elif len(values) > 6 and is_numbered and values[-1] > 1.0:
        code = -1  # Of an outline: its number would be a corner.
    is_outline = len(values) >= 6 and len(values) % 2 == 0
    is_scored_outline = len(values) >= 9 and len(values) % 2 == 1
    if not 0 <= code < _LARGEST_CLASS or not (len(values) in (4, 5) or is_outline or is_scored_outline):
        raise InputError(
            f"{where}: expected class cx cy width height [confidence], found {row.strip()[:60]!r}",
            hint="the class is a whole number, the others are fractions of the picture's width and height",
        )
    score = values.pop() if len(values) % 2 == 1 else 1.0
    if len(values) == 4:
        return code, values, score
    x, y = np.array(values[::2]), np.array(values[1::2])
    low, high = (x.min(), y.min()), (x.max(), y.max())
    return code, [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[0] - low[0], high[1] - low[1]], score


def _class_names(folder: Path) -> dict[int, str] | None:
    for place in (folder, folder.parent):
        for name in _NAMES_FILES:
            path = place / name
            if path.is_file():
                found = (
                    _names_in(read_yaml(path, "a YAML file with names"), path)
                    if path.suffix in (".yaml", ".yml")
                    else read_text(path, "one name of a class a line").splitlines()
                )
                pairs = found.items() if isinstance(found, dict) else enumerate(found)
                return {int(code): str(text).strip() or f"class-{code}" for code, text in pairs}
    return None


def _names_in(content: Any, path: Path) -> Any:
    names = content.get("names") if isinstance(content, dict) else None
    is_list = isinstance(names, list) and all(isinstance(name, str) for name in names)
    is_dict = isinstance(names, dict) and all(
        type(code) is int and isinstance(name, str) for code, name in names.items()
    )
    if not (is_list or is_dict):
        raise InputError(f"{path}: expected names, a list of classes, or numbers and classes", hint="repair the file")
    return names
