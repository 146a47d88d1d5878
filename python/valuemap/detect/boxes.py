"""Boxes of one picture, and which of several boxes show the same thing."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of one picture: centre and size (N, 2) in pixels, score (N), and class (N) as index into the names."""

    center_px: Floats
    size_px: Floats
    score: Floats
    class_code: Ints

    @classmethod
    def from_edges(cls, edges_px: NDArray[Any], score: NDArray[Any], class_code: NDArray[Any]) -> Self:
        """Return boxes from left, top, right, bottom (N, 4); numbers that are not finite are dropped."""
        is_whole = np.isfinite(edges_px).all(axis=1) & np.isfinite(score)
        edges = edges_px[is_whole].astype(np.float64).reshape(-1, 4)
        low, high = edges[:, :2], edges[:, 2:]
        return cls(
            (low + high) / 2.0,
            np.maximum(high - low, 0.0),
            score[is_whole].astype(np.float64),
            class_code[is_whole].astype(np.int64),
        )

    @classmethod
    def none(cls) -> Self:
        """Return no boxes."""
        return cls.from_edges(np.empty((0, 4)), np.empty(0), np.empty(0))

    @classmethod
    def together(cls, parts: Sequence[Boxes]) -> Self:
        """Return the boxes of all parts, one after the other."""
        if not parts:
            return cls.none()
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __len__(self) -> int:
        return len(self.score)

    @property
    def edges_px(self) -> Floats:
        """Left, top, right, bottom (N, 4)."""
        half = self.size_px / 2.0
        return np.concatenate([self.center_px - half, self.center_px + half], axis=1)

    def take(self, rows: NDArray[Any]) -> Self:
        """Return the boxes given by indices or by a mask."""
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))

    def moved(self, center_px: Floats, size_px: Floats) -> Self:
        """Return the same things with other places."""
        return dataclasses.replace(self, center_px=center_px, size_px=size_px)

    def clipped(self, width_px: float, height_px: float) -> Boxes:
        """Return the parts of the boxes inside a picture; boxes without any are left out."""
        edges = np.clip(self.edges_px, 0.0, [width_px, height_px, width_px, height_px])
        inside = Boxes.from_edges(edges, self.score, self.class_code)
        return inside.take(np.flatnonzero((inside.size_px > 0.0).all(axis=1)))


def intersections(first: Boxes, second: Boxes, period_px: float = math.inf) -> Floats:
    """Return the width and height (N, M, 2) of the common part of each of N boxes and each of M, 0 where there is none.

    `period_px` is the width of a panorama, whose left edge is its right edge.
    """
    apart = np.abs(first.center_px[:, None] - second.center_px[None])
    if math.isfinite(period_px):
        apart[..., 0] = np.minimum(apart[..., 0], period_px - apart[..., 0])
    reach = (first.size_px[:, None] + second.size_px[None]) / 2.0 - apart
    common: Floats = np.clip(reach, 0.0, np.minimum(first.size_px[:, None], second.size_px[None]))
    return common


def overlaps(first: Boxes, second: Boxes, period_px: float = math.inf) -> tuple[Floats, Floats]:
    """Return intersection over union, and over the smaller of the two (N, M)."""
    common = intersections(first, second, period_px).prod(axis=2)
    area, other = first.size_px.prod(axis=1)[:, None], second.size_px.prod(axis=1)[None]
    with np.errstate(invalid="ignore"):  # Boxes without area overlap nothing.
        union, smaller = common / (area + other - common), common / np.minimum(area, other)
    return np.nan_to_num(union), np.nan_to_num(smaller)


def suppress(
    boxes: Boxes,
    max_iou: float,
    *,
    view: Ints | None = None,
    is_cut: Bools | None = None,
    max_inside: float = math.inf,
    period_px: float = math.inf,
) -> Ints:
    """Return the rows of the boxes that stay, best first, when each removes those of its class that it covers.

    Greedy non-maximum suppression. Where the boxes come from several views of the picture, whole ones go before
    those that a view's border cut, and a box is also covered if more than `max_inside` of the smaller of the
    two is common with a box of another view.
    """
    cut = np.zeros(len(boxes), np.bool_) if is_cut is None else is_cut
    of_view = np.zeros(len(boxes), np.int64) if view is None else view
    order = np.lexsort((boxes.center_px[:, 1], boxes.center_px[:, 0], boxes.class_code, -boxes.score, cut))
    kept = []
    while len(order):
        best, rest = order[0], order[1:]
        kept.append(best)
        union, smaller = overlaps(boxes.take(order[:1]), boxes.take(rest), period_px)
        is_same = (union[0] > max_iou) | ((smaller[0] > max_inside) & (of_view[rest] != of_view[best]))
        order = rest[~(is_same & (boxes.class_code[rest] == boxes.class_code[best]))]
    return np.array(kept, dtype=np.int64)
