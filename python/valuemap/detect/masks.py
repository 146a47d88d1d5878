"""Boxes become masks: what the network is to say of each pixel, and how much each pixel counts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints

Mask = NDArray[np.uint8]
Weights = NDArray[np.float32]


def masks_of_boxes(
    edges_px: Floats,
    class_code: Ints,
    ignored_edges_px: Floats,
    *,
    classes: int,
    size_px: tuple[int, int],
    small_object_px: float,
) -> tuple[Mask, Weights]:
    """Return targets (classes, height, width) of 0 and 1, and the weight of each of these pixels in the loss.

    A pixel is of an object if its centre is in the box, at least the pixel of the box's centre is. Pixels of
    an object smaller than `small_object_px` count more, so that far objects are not lost beside near ones;
    those to ignore count nothing, unless an object is there.

    Parameters
    ----------
    edges_px, ignored_edges_px
        (N, 4) left, top, right, bottom; what is outside the picture is cut away.
    class_code
        (N) index of the class.
    size_px
        Width, height.
    """
    width, height = size_px
    target = np.zeros((classes, height, width), np.uint8)
    weight = np.ones((classes, height, width), np.float32)
    for left, top, right, bottom in _pixels(ignored_edges_px, size_px):
        weight[:, top:bottom, left:right] = 0.0
    area_px = (edges_px[:, 2] - edges_px[:, 0]) * (edges_px[:, 3] - edges_px[:, 1])
    importance = np.maximum(1.0, small_object_px / np.maximum(area_px, 1.0))
    rows = np.argsort(importance, kind="stable")  # Where boxes overlap, the smaller object decides.
    pixels = _pixels(edges_px, size_px)
    for row in rows:
        left, top, right, bottom = pixels[row]
        target[class_code[row], top:bottom, left:right] = 1
        weight[class_code[row], top:bottom, left:right] = importance[row]
    return target, weight


def _pixels(edges_px: Floats, size_px: tuple[int, int]) -> NDArray[Any]:
    """Return first column, first row, last column + 1, last row + 1 of the pixels whose centres are in the boxes."""
    first = np.ceil(edges_px[:, :2] - 0.5).astype(np.int64)
    end = np.ceil(edges_px[:, 2:] - 0.5).astype(np.int64)
    middle = np.floor((edges_px[:, :2] + edges_px[:, 2:]) / 2.0).astype(np.int64)
    is_thin = end <= first
    first, end = np.where(is_thin, middle, first), np.where(is_thin, middle + 1, end)
    return np.hstack([np.clip(first, 0, size_px), np.clip(end, 0, size_px)])
