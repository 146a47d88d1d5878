"""How a picture was made to fit the network, so that boxes find the way back exactly.

Pixels are continuous (the centre of the top-left pixel is at (0.5, 0.5)), so resizing is a multiplication and
padding an addition, without any half pixel:

    network = picture * scale + offset,    scale = resized size / picture size, each axis
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats
from valuemap.detect.boxes import Boxes

Pixels = NDArray[np.uint8]
Size = tuple[int, int]
"""Width, height in pixels."""

Fitting = Literal["corner", "center", "stretch"]
"""Where the picture goes: letterboxed at the top left or in the middle, or stretched to the whole size."""

PADDING = 114
"""Grey of the padding, as YOLOX and Ultralytics train with."""
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Fit:
    """The place of a picture on the canvas that the network sees; sizes are width, height in pixels."""

    picture: Size
    resized: Size
    canvas: Size
    offset: Size

    @property
    def scale(self) -> Floats:
        """Canvas pixels per picture pixel, x and y."""
        return np.array(self.resized, np.float64) / np.array(self.picture, np.float64)

    def to_canvas(self, boxes: Boxes) -> Boxes:
        """Return boxes of the picture as the network should find them."""
        return boxes.moved(boxes.center_px * self.scale + np.array(self.offset, np.float64), boxes.size_px * self.scale)

    def to_picture(self, boxes: Boxes) -> Boxes:
        """Return boxes that the network found as boxes of the picture: the inverse of `to_canvas`."""
        return boxes.moved(
            (boxes.center_px - np.array(self.offset, np.float64)) / self.scale, boxes.size_px / self.scale
        )

    def draw(self, pixels: Pixels) -> Pixels:
        """Return the canvas (height, width, 3) with the picture on it."""
        if self.resized != self.picture:
            # Pixel centres map as above. Without antialiasing, as the detectors are trained.
            resized: Any = cv2.resize(pixels, self.resized, interpolation=cv2.INTER_LINEAR)
        else:
            resized = pixels
        if self.resized == self.canvas:
            return np.ascontiguousarray(resized)
        canvas = np.full((self.canvas[1], self.canvas[0], 3), PADDING, np.uint8)
        (left, top), (width, height) = self.offset, self.resized
        canvas[top : top + height, left : left + width] = resized
        return canvas


def fit_into(picture: Size, canvas: Size, how: Fitting) -> Fit:
    """Fit a picture into a canvas of a given size."""
    if how == "stretch":
        return Fit(picture, canvas, canvas, (0, 0))
    ratio = min(canvas[0] / picture[0], canvas[1] / picture[1])
    # Rounded down, as YOLOX does: a row of pixels more or less changes what a small network finds.
    resized = _size(max(math.floor(picture[i] * ratio + _ROUNDING), 1) for i in (0, 1))
    offset = _size((canvas[i] - resized[i]) // 2 for i in (0, 1)) if how == "center" else (0, 0)
    return Fit(picture, resized, canvas, offset)


def fit_around(picture: Size, stride: int) -> Fit:
    """Leave the picture as it is, on the smallest canvas whose sides are multiples of the stride."""
    return Fit(picture, picture, _size(-(-side // stride) * stride for side in picture), (0, 0))


def _size(sides: Any) -> Size:
    width, height = sides
    return int(width), int(height)
