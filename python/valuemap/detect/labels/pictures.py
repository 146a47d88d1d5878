"""Labelled pictures: what every loader gives, whatever the format."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from valuemap.arrays import Floats

SPLITS = {"train": "train", "training": "train", "val": "val", "valid": "val", "validation": "val", "test": "test"}
"""Names that folders and lists of pictures go by, and the split that they mean."""


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """One picture and its boxes.

    Attributes
    ----------
    path
        The file; the loaders do not look whether it is there.
    boxes_px
        (N, 4) centre x, centre y, width, height; the centre of the top-left pixel is (0.5, 0.5).
    classes
        The N class names.
    ignored_px
        (K, 4) like `boxes_px`: places that count neither as object nor as background.
    split
        `train`, `val` or `test`; empty where the labels do not say.
    """

    path: Path
    boxes_px: Floats
    classes: tuple[str, ...]
    ignored_px: Floats = field(default_factory=lambda: np.empty((0, 4)))
    split: str = ""


@dataclass(frozen=True)
class LabelledPictures:
    """All usable pictures of one source, and a line for each label or picture that is not."""

    source: str
    pictures: tuple[LabelledPicture, ...]
    skipped: tuple[str, ...]

    @property
    def class_names(self) -> tuple[str, ...]:
        """All class names that occur, sorted."""
        return tuple(sorted({name for picture in self.pictures for name in picture.classes}))

    @property
    def boxes(self) -> int:
        """Number of boxes of all pictures."""
        return sum(len(picture.classes) for picture in self.pictures)


@dataclass
class BoxList:
    """Gathers the boxes of one picture, and what was wrong with the others."""

    skipped: list[str]
    edges_px: list[Sequence[float]] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    ignored_edges_px: list[Sequence[float]] = field(default_factory=list)

    def add(self, name: str, edges_px: Sequence[float], where: str, *, ignored: bool = False) -> None:
        """Add a box of left, top, right, bottom, or note at `where` that it is none."""
        if not all(math.isfinite(value) for value in edges_px):
            self.skipped.append(f"{where}: expected finite numbers, found {list(edges_px)}")
        elif edges_px[2] <= edges_px[0] or edges_px[3] <= edges_px[1]:
            self.skipped.append(f"{where}: expected a box wider and higher than 0, found {list(edges_px)}")
        elif ignored:
            self.ignored_edges_px.append(edges_px)
        else:
            self.edges_px.append(edges_px)
            self.classes.append(name)

    def picture(self, path: Path, split: str = "") -> LabelledPicture:
        """Return the picture with the boxes gathered so far."""
        boxes_px, ignored_px = _boxes_of_edges(self.edges_px), _boxes_of_edges(self.ignored_edges_px)
        return LabelledPicture(path, boxes_px, tuple(self.classes), ignored_px, split)


def _boxes_of_edges(edges_px: list[Sequence[float]]) -> Floats:
    edges = np.array(edges_px, dtype=np.float64).reshape(-1, 4)
    low, high = edges[:, :2], edges[:, 2:]
    return np.hstack([(low + high) / 2.0, high - low])
