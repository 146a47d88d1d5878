"""Detections in a table: one row a box, a key point or a bearing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.readers.boxes import NOTHING, OPTIONAL, SINGLE, BoxWriter
from valuemap.readers.csv_file import CsvFile, csv_portions, line_of
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes
from valuemap.readers.texts import Texts

_EXPECTED = (
    "a CSV file with columns image and x1, y1, x2, y2, or left, top, width, height, or x, y; "
    "--detection-column x1=xmin where x1 is called xmin"
)


_TEXTS = ("image", "class")
_EDGES = ("x1", "y1", "x2", "y2")
_PLACES = (*_EDGES, "left", "top", "x", "y")
_NUMBERS = (*_PLACES, "width", "height", "score", *OPTIONAL)


def read_csv_boxes(file: DetectionFile) -> NamedBoxes:
    """Read boxes from a table with a column `image` (a name) and one of these sets of columns, in pixels or fractions.

    `x1, y1, x2, y2` are edges, `left, top, width, height` the top-left corner and the size, `x, y` the centre, with
    `width, height` or, for key points, without. Optional are `class`, `score`, `range_m`, `range_sigma_m` (metres) and
    `vertical_sigma_px`. Beside edges, whole numbers `width, height` that no box exceeds are the size of the picture. A
    row that has neither place nor class says that nothing is in the picture.

    The file is read in portions, and of a box its numbers are kept, in a temporary file.

    Raises
    ------
    InputError
        The file is no such table.
    """
    writer = BoxWriter()
    has_sizes, pictures = True, _Pictures()
    for table in csv_portions(file.path, _EXPECTED, texts=_TEXTS, numbers=_NUMBERS, columns=file.columns):
        center, size = _boxes(table)
        has_sizes = size is not None
        has_class, has_score = table.has_optional("class"), table.has_optional("score")
        classes = table.texts("class") if has_class else Texts.repeated(file.class_name, len(table))
        images = writer.images.codes_of(table.texts("image"))
        pictures.add(table, images)
        writer.add(
            image=images,
            kind=writer.classes.codes_of(classes),
            center=center,
            size=size,
            score=table.numbers("score") if has_score else np.full(len(table), file.full_score),
            entry=np.where(_are_empty(table, center, classes), NOTHING, SINGLE),
            **{name: table.numbers_or_none(name) for name in OPTIONAL if table.has(name)},
        )
    return NamedBoxes(
        rows=writer.rows,
        image_names=writer.images.texts,
        class_names=writer.classes.texts,
        where=partial(line_of, file.path),
        fractions=file.fractions,
        are_points=not has_sizes,
        pictures={} if file.fractions else pictures.sizes(writer.images.texts),
    )


class _Pictures:
    """The sizes of pictures as far as a table says them: TensorFlow's has them as `width, height` beside edges."""

    def __init__(self) -> None:
        self._size_of: dict[int, tuple[float, float]] = {}
        self._are_sizes = True

    def add(self, table: CsvFile, images: Ints) -> None:
        """Take a portion, whose rows (N) are of these images."""
        if not (self._are_sizes and table.has(*_EDGES, "width", "height")):
            return
        size, last = _pair(table, "width", "height"), _pair(table, "x2", "y2")
        # Of a box they would be less than its far edges.
        self._are_sizes = bool(((size >= last) & (size == np.rint(size)) | np.isnan(last)).all())
        codes, rows = np.unique(images, return_index=True)
        for code, (width, height) in zip(codes.tolist(), size[rows].tolist(), strict=True):
            self._size_of[code] = (width, height)

    def sizes(self, names: Sequence[str]) -> dict[str, tuple[int, int]]:
        """Return width and height by the names of the images."""
        known = {code: size for code, size in self._size_of.items() if np.isfinite(size).all()}
        return {names[code]: (int(size[0]), int(size[1])) for code, size in known.items()} if self._are_sizes else {}


def _boxes(table: CsvFile) -> tuple[Floats, Floats | None]:
    """Return centres (N, 2), and sizes (N, 2) where there are any."""
    if table.has(*_EDGES):
        first, last = _pair(table, "x1", "y1"), _pair(table, "x2", "y2")
        return (first + last) / 2.0, last - first
    if table.has("left", "top", "width", "height"):
        corner, size = _pair(table, "left", "top"), _pair(table, "width", "height")
        return corner + size / 2.0, size
    if table.has("x", "y"):
        return _pair(table, "x", "y"), _pair(table, "width", "height") if table.has("width", "height") else None
    raise table.missing("x1, y1, x2, y2, or left, top, width, height, or x, y (the centre) and maybe width, height")


def _are_empty(table: CsvFile, center: Floats, classes: Texts) -> Bools:
    """Return which rows (N) have nothing in any column of places, and no class where there is such a column."""
    if not np.isnan(center).any():
        return np.zeros(len(table), np.bool_)
    places = [name for name in _PLACES if table.has(name)]
    empty: Bools = np.all([np.isnan(table.numbers_or_none(name)) for name in places], axis=0)
    return empty & (np.array([not text for text in classes]) if table.has("class") else True)


def _pair(table: CsvFile, first: str, second: str) -> Floats:
    return np.stack([table.numbers(first), table.numbers(second)], axis=1)
