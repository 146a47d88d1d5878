"""Labelled pictures: what every loader gives, whatever the format."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from valuemap.tables import Floats

SPLITS = {"train": "train", "training": "train", "val": "val", "valid": "val", "validation": "val", "test": "test"}
"""Names that folders and lists of pictures go by, and the split that they mean."""


@dataclass(frozen=True)
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
    split
        `train`, `val` or `test`; empty where the labels do not say.
    """

    path: Path
    boxes_px: Floats
    classes: tuple[str, ...]
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

    def add(self, name: str, edges_px: Sequence[float], where: str) -> None:
        """Add a box of left, top, right, bottom, or note at `where` that it is none."""
        if not all(math.isfinite(value) for value in edges_px):
            self.skipped.append(f"{where}: expected finite numbers, found {list(edges_px)}")
        elif edges_px[2] <= edges_px[0] or edges_px[3] <= edges_px[1]:
            self.skipped.append(f"{where}: expected a box wider and higher than 0, found {list(edges_px)}")
        else:
            self.edges_px.append(edges_px)
            self.classes.append(name)

    def picture(self, path: Path, split: str = "") -> LabelledPicture:
        """Return the picture with the boxes gathered so far."""
        edges_px = np.array(self.edges_px, dtype=np.float64).reshape(-1, 4)
        low, high = edges_px[:, :2], edges_px[:, 2:]
        return LabelledPicture(path, np.hstack([(low + high) / 2.0, high - low]), tuple(self.classes), split)
