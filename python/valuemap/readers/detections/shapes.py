"""Shapes that people draw into pictures, and the upright boxes around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import numpy as np

from valuemap.errors import InputError
from valuemap.readers.boxes import NO_BOX, SINGLE
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes

Box = tuple[float, float, float, float]
"""Centre x and y, width and height in pixels."""

LEAST_CORNERS = 3
"""Of a polygon."""


@dataclass
class Drawn:
    """The shapes (N) that were found so far, and the pictures."""

    where: list[str] = field(default_factory=list)
    images: list[str] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    boxes_px: list[Box] = field(default_factory=list)
    entries: list[int] = field(default_factory=list)
    scores: list[float | None] = field(default_factory=list)
    pictures: dict[str, tuple[int, int]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)

    def add(self, where: str, image: str, class_name: str, box: Box | None, score: float | None = None) -> None:
        """Take a shape; one without a box, such as points or a line, is left out and counted later."""
        self.where.append(where)
        self.images.append(image)
        self.classes.append(class_name)
        self.boxes_px.append((math.nan,) * 4 if box is None else box)
        self.entries.append(NO_BOX if box is None else SINGLE)
        self.scores.append(score)

    def named_boxes(self, file: DetectionFile, expected: str) -> NamedBoxes:
        """Return the boxes; those without a score are certain.

        Raises
        ------
        InputError
            There is not one picture.
        """
        if not self.names:
            raise InputError(f"{file.path}: there are no images in it", hint=f"expected {expected}")
        boxes_px = np.array(self.boxes_px, dtype=np.float64).reshape(-1, 4)
        scores = [file.full_score if score is None else score for score in self.scores]
        return NamedBoxes.of_columns(
            image_names=self.images,
            class_names=self.classes,
            center=boxes_px[:, :2],
            size=boxes_px[:, 2:],
            score=np.array(scores, dtype=np.float64),
            entry=np.array(self.entries, np.int64),
            where=self.where.__getitem__,
            pictures=self.pictures,
            other_names=self.names,
        )


def around_points(points: Sequence[Sequence[float]]) -> Box:
    """Return the box around points (x, y), of which there is at least one."""
    (left, top), (right, bottom) = np.min(points, axis=0).tolist(), np.max(points, axis=0).tolist()
    return (left + right) / 2, (top + bottom) / 2, right - left, bottom - top


def around_turned_box(x: float, y: float, width: float, height: float, turn_rad: float) -> Box:
    """Return the box around one that is turned about its centre."""
    cosine, sine = abs(math.cos(turn_rad)), abs(math.sin(turn_rad))
    return x, y, cosine * width + sine * height, cosine * height + sine * width


def around_ellipse(x: float, y: float, across: float, along: float, turn_rad: float = 0.0) -> Box:
    """Return the box around an ellipse of these half axes, turned about its centre."""
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    return x, y, 2 * math.hypot(cosine * across, sine * along), 2 * math.hypot(cosine * along, sine * across)


def picture_beside(file: str, stated: str) -> str:
    """Return the name of the picture that a file of shapes is of, by the name of the file and of the picture in it.

    Where the latter has no folders, they are those of the file; where there is none, it is called like the file.
    """
    if not stated:
        return PurePosixPath(file).with_suffix("").as_posix()
    is_bare = "/" not in stated and "\\" not in stated
    return (PurePosixPath(file).parent / stated).as_posix() if is_bare else stated
