"""Boxes as readers find them, checked by nobody yet: in arrays, or in a temporary file where they may be many."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from valuemap.arrays import Floats, Ints
from valuemap.readers.row_file import KeyBounds, PartFile, RowFile, Rows
from valuemap.readers.texts import Texts

OPTIONAL = ("range_m", "range_sigma_m", "vertical_sigma_px")
SINGLE, CROWD, NO_BOX, NOTHING, NO_ANGLE = range(5)
"""What an entry of a file is: a box of one object, a region of many, a shape without a box, no more than a name, or a
direction that is none.
"""
_COLUMNS: Mapping[str, Any] = {
    "row": np.int64,
    "image": np.int32,
    "class": np.int32,
    "center": (np.float64, 2),
    "size": (np.float64, 2),
    "score": np.float64,
    "detection_id": np.int64,
    "entry": np.int8,
    **dict.fromkeys(OPTIONAL, np.float64),
}


@dataclass(frozen=True, eq=False)
class FoundBoxes:
    """Boxes as a reader found them, in any order, checked by nobody yet.

    Parameters
    ----------
    image_row
        Row (N) of each box's image in the reader's table of images; -1 where it is not among them.
    class_names, score
        One a box (N); an empty text for a class, and NaN for a score, that the file does not have.
    center_px, size_px
        Centre and size (N, 2) in pixels, centre of the top-left pixel at (0.5, 0.5); NaN for what is no number.
    where
        Returns the place of a box in the user's files, for its index here.
    image_names
        The names (N) that the file has for the images; needed where some `image_row` is -1.
    detection_id
        Distinct ids (N). Without them the boxes are numbered from 0 by image, place, size, class and score,
        so that the numbers do not depend on the order of the boxes.
    range_m, range_sigma_m
        Measured distances (N) in metres, NaN where there is none.
    vertical_sigma_px
        Standard deviations (N) of the centre's y, NaN where it is that of its x.
    are_points
        The boxes are directions without a size, so that a size of 0 is right.
    source
        What errors name as the place of the boxes, where it is not that of the images.
    entry
        What each is (N), as in `FiledBoxes`; without, all are `SINGLE`.
    """

    image_row: Ints
    class_names: Sequence[str]
    center_px: Floats
    size_px: Floats
    score: Floats
    where: Callable[[int], str]
    image_names: Sequence[str] | None = None
    detection_id: Ints | None = None
    range_m: Floats | None = None
    range_sigma_m: Floats | None = None
    vertical_sigma_px: Floats | None = None
    are_points: bool = False
    source: str | None = None
    entry: Ints | None = None

    @staticmethod
    def none() -> FoundBoxes:
        """Return no boxes: they are still to be found in the pictures."""
        nothing = np.empty(0)
        pairs = np.empty((0, 2))
        return FoundBoxes(nothing.astype(np.int64), [], pairs, pairs, nothing, str)

    def __len__(self) -> int:
        return len(self.image_row)

    def filed(self, names_of_images: pa.Array) -> FiledBoxes:
        """Return the same boxes in a file."""
        rows = np.asarray(self.image_row, np.int64)
        if self.image_names is None:
            distinct_row, code = np.unique(rows, return_inverse=True)
            names = [names_of_images[row].as_py() if row >= 0 else "" for row in distinct_row.tolist()]
        else:  # A name and a row: that images have a row and no name of their own is up to the reader.
            texts = Texts.of(self.image_names)
            pairs, code = np.unique(np.stack([rows, texts.codes]), axis=1, return_inverse=True)
            distinct_row, names = pairs[0], [texts.distinct[text] for text in pairs[1].tolist()]
        writer = BoxWriter()
        classes = Texts.of(self.class_names)
        writer.add(
            image=code.reshape(-1),
            kind=writer.classes.codes_of(classes),
            center=self.center_px,
            size=self.size_px,
            score=self.score,
            detection_id=self.detection_id,
            entry=self.entry,
            **{name: getattr(self, name) for name in OPTIONAL},
        )
        return FiledBoxes(
            rows=writer.rows,
            image_row=distinct_row,
            image_names=names,
            class_names=writer.classes.texts,
            where=self.where,
            has_ids=self.detection_id is not None,
            are_points=self.are_points,
            source=self.source,
        )


@dataclass(frozen=True, eq=False)
class FiledBoxes:
    """Boxes (N) as a reader found them, in a temporary file; the columns are those of `FoundBoxes`.

    Parameters
    ----------
    rows
        Their numbers, with a number for each distinct text. A column `entry`, where there is one, says which
        are `CROWD`, `NO_BOX`, `NOTHING` or `NO_ANGLE` instead of `SINGLE`.
    image_row, image_names
        Row of an image (M) in the reader's table of images, -1 where it is not among them, and its name in the file, by
        its number in `rows`.
    class_names
        The classes by their numbers in `rows`.
    where
        Returns the place of a box in the user's files, for its index here.
    has_ids
        Whether all have ids of their own.
    are_points
        The boxes are directions without a size.
    source
        As of `FoundBoxes`.
    picture_px
        Width and height (M, 2) of the pictures of which centres and sizes are fractions.
    shift_px, full_score
        What is to be added to centres, and what scores are to be divided by.
    """

    rows: RowFile
    image_row: Ints
    image_names: Sequence[str]
    class_names: Sequence[str]
    where: Callable[[int], str]
    has_ids: bool = False
    are_points: bool = False
    source: str | None = None
    picture_px: Floats | None = None
    shift_px: float = 0.0
    full_score: float = 1.0

    def __len__(self) -> int:
        return len(self.rows)

    def portions(self) -> Iterator[tuple[int, Rows]]:
        """Yield the boxes in their order in portions, each with the number of its first one."""
        for first, rows in self.rows.portions():
            yield first, self._scaled(rows)

    def read(self, first: int, count: int) -> Rows:
        """Return some boxes."""
        return self._scaled(self.rows.read(first, count))

    def optional(self) -> tuple[str, ...]:
        """Return which optional columns they have."""
        return tuple(name for name in OPTIONAL if name in (self.rows.dtype.names or ()))

    def _scaled(self, rows: Rows) -> Rows:
        if self.picture_px is not None:
            rows["center"] *= self.picture_px[rows["image"]]
            rows["size"] *= self.picture_px[rows["image"]]
        rows["center"] += self.shift_px
        rows["score"] /= self.full_score
        return rows


class Codes:
    """Numbers for distinct texts, in the order in which they come."""

    def __init__(self) -> None:
        self._code: dict[str, int] = {}

    @property
    def texts(self) -> list[str]:
        """The texts by their numbers."""
        return list(self._code)

    def codes_of(self, texts: Sequence[str]) -> Ints:
        """Return the number of each text (N)."""
        column = Texts.of(texts)
        code = np.full(len(column.distinct), -1, np.int64)
        for used in np.flatnonzero(np.bincount(column.codes, minlength=len(code))).tolist():
            code[used] = self._code.setdefault(column.distinct[used], len(self._code))
        return code[column.codes] if len(code) else np.empty(0, np.int64)


class BoxWriter:
    """Puts boxes into a temporary file, a portion at a time."""

    def __init__(self) -> None:
        self.images, self.classes = Codes(), Codes()
        self._rows: RowFile | None = None

    @property
    def rows(self) -> RowFile:
        """What was added."""
        return RowFile(structure(())) if self._rows is None else self._rows

    def add(
        self,
        *,
        image: Ints,
        kind: Ints,
        center: Floats,
        size: Floats | None,
        score: Floats,
        **optional: Ints | Floats | None,
    ) -> None:
        """Add boxes (N); each time the same of the optional columns."""
        given = {name: values for name, values in optional.items() if values is not None}
        if self._rows is None:
            self._rows = RowFile(structure(tuple(given)))
        rows = np.empty(len(image), self._rows.dtype)
        columns = {"image": image, "class": kind, "center": center, "size": 0.0 if size is None else size}
        for name, values in {**columns, "score": score, **given}.items():
            rows[name] = values
        self._rows.append(rows)


def structure(more: Sequence[str]) -> Any:
    """Return the structure of rows with what every box has, and some columns more."""
    always = ("image", "class", "center", "size", "score")
    names = [name for name in _COLUMNS if name in always or name in more]
    return np.dtype([(name, *kind) if isinstance(kind := _COLUMNS[name], tuple) else (name, kind) for name in names])


def are_distinct(rows: RowFile) -> tuple[bool, Ints]:
    """Return whether all boxes have ids of their own, and bounds of the ids that make parts of about a portion."""
    ascend, last, samples = True, -1, KeyBounds()
    for _, portion in rows.portions():
        ids = portion["detection_id"]
        ascend &= bool(ids[0] > last and np.all(ids[1:] > ids[:-1]))
        last = int(ids[-1])
        samples.add(ids)
    bounds = samples.bounds()
    if ascend:
        return True, bounds
    parts = PartFile(np.dtype([("detection_id", np.int64)]), bounds)
    for _, portion in rows.portions():
        parts.append(portion[["detection_id"]], portion["detection_id"])
    ordered = (np.sort(part["detection_id"]) for part in parts.parts())
    return not any(bool(np.any(ids[1:] == ids[:-1])) for ids in ordered), bounds
