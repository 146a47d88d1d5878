"""Detections in YOLO's format: a folder with a text file a picture, of the same name."""

from __future__ import annotations

import codecs
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from valuemap.errors import InputError
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.files import check_folder, file_in, read_text
from valuemap.yolo_names import BOX, NAMES_FILES, YoloNames, yolo_names

_EXPECTED = "a folder of text files with rows: class cx cy width height [confidence], as fractions of the picture"
_LARGEST_CLASS = 100_000
_KITTI_FIELDS = (15, 16)
"""Of a label, and of a result, which has a score."""


@dataclass(frozen=True)
class _Row:
    """The numbers of a row after its class, and where and how it is written."""

    where: str
    text: str
    code: int
    values: list[float]

    def wrong(self) -> InputError:
        """Return the error that says what was expected."""
        fields = self.text.split()
        is_kitti = len(fields) in _KITTI_FIELDS and not fields[0][0].isdigit()
        return InputError(
            f"{self.where}: expected class cx cy width height [confidence], found {self.text.strip()[:60]!r}",
            hint="is it a label of KITTI? Make a CSV table image,x1,y1,x2,y2,class of its columns 5 to 8 and 1, "
            "and give --detection-pixel-center 0"
            if is_kitti
            else "the class is a whole number, the others are fractions of the picture's width and height; other text "
            "files must not be in the folder",
        )


def read_yolo(file: DetectionFile) -> NamedBoxes:
    """Read a folder of files `NAME.txt` for the pictures `NAME.jpg`, with rows of fractions of the picture.

    A row is class, centre x and y, width, height and maybe the confidence. An odd number of values from 7 up is a
    class and a polygon, of which the box counts, an even one from 10 up has the confidence too. Numbers of tracks at
    the end of rows, and key points where `data.yaml` says how many there are, count for nothing. `data.yaml`,
    `dataset.yaml` (names), `classes.txt` or `obj.names` in the folder or one of the two above name the classes; else
    class 9 is `class-9`.

    Raises
    ------
    InputError
        There are no such files, a file is not text, or a row is of another form.
    """
    folder = check_folder(file.path, _EXPECTED)
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() == ".txt" and path.name not in NAMES_FILES)
    if not paths:
        raise InputError(f"{folder}: there are no .txt files in it", hint=f"expected {_EXPECTED}")
    names = yolo_names(folder)
    rows_of: dict[str, list[_Row]] = {}
    for path in paths:
        name = path.relative_to(folder).as_posix()
        if _is_blank(file_in(folder, name, _EXPECTED)):
            continue  # Nothing is in the picture.
        lines = enumerate(read_text(path, _EXPECTED).splitlines(), start=1)
        rows_of[name] = [_row(text, f"{path} line {line}", names) for line, text in lines if text.strip()]
    _remove_tracks(list(rows_of.values()))
    rows = [row for of_picture in rows_of.values() for row in of_picture]
    found = [_place(row) for row in rows]
    boxes = np.array([place for place, _ in found], dtype=np.float64).reshape(-1, 4)
    return NamedBoxes.of_columns(
        image_names=[name for name, of_picture in rows_of.items() for _ in of_picture],
        class_names=[names.name(row.code) for row in rows],
        center=boxes[:, :2],
        size=boxes[:, 2:],
        score=np.array([score * file.full_score for _, score in found], dtype=np.float64),
        where=[row.where for row in rows].__getitem__,
        fractions=True,
    )


def _is_blank(path: Path) -> bool:
    return path.stat().st_size <= _MOST_BLANK and not path.read_bytes().removeprefix(codecs.BOM_UTF8).strip()


_MOST_BLANK = 16
"""Bytes of a file that may hold a mark and the ends of lines, and no row."""


def _row(text: str, where: str, names: YoloNames) -> _Row:
    """Return a row without the values of its key points."""
    try:
        code, *values = (float(field) for field in text.split())
    except ValueError:
        code, values = math.nan, []
    is_class = 0.0 <= code < _LARGEST_CLASS and code == int(code)
    row = _Row(where, text, int(code) if is_class else -1, names.without_key_points(values))
    if not is_class or len(values) < BOX:
        raise row.wrong()
    return row


def _remove_tracks(pictures: Sequence[Sequence[_Row]]) -> None:
    """Take the numbers of tracks away, which Ultralytics writes at the end of rows.

    They count from 1, and no other last value, a fraction or a confidence, is larger than that. Where they are no
    tracks in one picture, as percentages that are there twice, they are none in any.
    """

    def may_be_tracks(rows: Sequence[_Row]) -> bool:
        last = [row.values[-1] for row in rows]
        return all(map(_is_numbered, rows)) and len(set(last)) == len(last)

    beyond_1 = [rows for rows in pictures if any(_is_numbered(row) and row.values[-1] > 1.0 for row in rows)]
    if beyond_1 and all(map(may_be_tracks, beyond_1)):
        for row in (row for rows in pictures if may_be_tracks(rows) for row in rows):
            row.values.pop()
    for row in (row for rows in pictures for row in rows):
        if len(row.values) == BOX + 2 and _is_numbered(row):
            row.values.pop()  # A triangle that touches the lower edge is rarer than a box of a first track.


def _is_numbered(row: _Row) -> bool:
    """Return whether a whole number from 1 up is behind the box."""
    return len(row.values) > BOX and row.values[-1] >= 1.0 and row.values[-1].is_integer()


def _place(row: _Row) -> tuple[list[float], float]:
    """Return centre, width and height, and the confidence."""
    values = list(row.values)
    is_outline = len(values) >= 6 and len(values) % 2 == 0
    is_scored_outline = len(values) >= 9 and len(values) % 2 == 1
    if not (len(values) in (BOX, BOX + 1) or is_outline or is_scored_outline):
        raise row.wrong()
    if len(values) > BOX + 1 and values[-1] > 1.0 and values[-1].is_integer():
        raise row.wrong()  # The number of a track, where others have none: it would be a corner.
    score = values.pop() if len(values) % 2 == 1 else 1.0
    if len(values) == BOX:
        return values, score
    x, y = np.array(values[::2]), np.array(values[1::2])
    low, high = (x.min(), y.min()), (x.max(), y.max())
    return [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[0] - low[0], high[1] - low[1]], score
