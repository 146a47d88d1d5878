"""Large pictures in overlapping tiles, and the boxes of all tiles as boxes of one picture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from valuemap.arrays import Bools, Ints
from valuemap.detect.boxes import Boxes, intersections, suppress
from valuemap.detect.letterbox import Size

Window = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels of the picture."""

_CUT_PX = 3.0
"""A box that ends closer than this to an inner border of its view may go on beyond it."""
_MAX_INSIDE = 0.5
"""Boxes of different views are of one thing if this share of the smaller lies in the other."""
_MIN_SHARED_SIDE = 0.5
"""Two parts of one thing have at least this share of a side in common where their views overlap."""


def plan_tiles(picture: Size, tile_px: int, overlap_px: int) -> list[Window]:
    """Return windows of at most `tile_px` that cover the picture evenly and overlap by at least `overlap_px`.

    A picture that is no larger than a tile, or `tile_px` 0, is one window.
    """
    starts = []
    for side in picture:
        if tile_px == 0 or side <= tile_px:
            starts.append([(0, side)])
            continue
        count = math.ceil((side - overlap_px) / (tile_px - overlap_px))
        first = np.round(np.linspace(0, side - tile_px, count)).astype(int)
        starts.append([(int(low), int(low) + tile_px) for low in first])
    return [(left, top, right, bottom) for top, bottom in starts[1] for left, right in starts[0]]


def inner_borders(window: Window, picture: Size) -> tuple[bool, bool, bool, bool]:
    """Return whether the left, top, right, bottom of a window have picture beyond them."""
    left, top, right, bottom = window
    return left > 0, top > 0, right < picture[0], bottom < picture[1]


def are_cut(boxes: Boxes, window: Window, is_inner: tuple[bool, bool, bool, bool]) -> Bools:
    """Return which boxes (N) touch a border of their window with picture beyond it."""
    outward = np.array([-1.0, -1.0, 1.0, 1.0])
    to_border = (np.array(window, np.float64) - boxes.edges_px) * outward
    cut: Bools = ((to_border < _CUT_PX) & np.array(is_inner)).any(axis=1)
    return cut


def merge_views(parts: Sequence[Boxes], cuts: Sequence[Bools], max_iou: float, period_px: float = math.inf) -> Boxes:
    """Return the boxes of several overlapping views of one picture, in its pixels, each thing once.

    Parts of things that no view saw whole are joined; then a box that was seen whole stands for all boxes
    of its class that show the same. `period_px` is the width of a panorama.
    """
    boxes = Boxes.together(parts)
    view = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    is_cut = np.concatenate(cuts) if cuts else np.empty(0, np.bool_)
    if math.isinf(period_px):
        boxes, view, is_cut = _join_parts(boxes, view, is_cut)
    kept = suppress(boxes, max_iou, view=view, is_cut=is_cut, max_inside=_MAX_INSIDE, period_px=period_px)
    return boxes.take(kept)


def _join_parts(boxes: Boxes, view: Ints, is_cut: Bools) -> tuple[Boxes, Ints, Bools]:
    """Replace cut boxes of different views that continue each other by the box around them."""
    rows = np.flatnonzero(is_cut)
    cut = boxes.take(rows)
    common = intersections(cut, cut)
    longer = np.maximum(cut.size_px[:, None], cut.size_px[None])
    continues = (common > 0.0).all(axis=2) & (common >= _MIN_SHARED_SIDE * longer).any(axis=2)
    is_pair = continues & (view[rows][:, None] != view[rows][None]) & (cut.class_code[:, None] == cut.class_code[None])
    count, thing = connected_components(coo_array(is_pair), directed=False)
    is_joined = np.bincount(thing, minlength=count)[thing] > 1
    if not is_joined.any():
        return boxes, view, is_cut
    edges = np.full((count, 4), np.inf)
    signs = np.array([1.0, 1.0, -1.0, -1.0])  # The least of left and top, the greatest of right and bottom.
    np.minimum.at(edges, thing, cut.edges_px * signs)
    score = np.zeros(count)
    np.maximum.at(score, thing, cut.score)
    number = np.zeros(count, np.int64)
    number[thing] = cut.class_code
    things = np.unique(thing[is_joined])
    joined = Boxes.from_edges((edges * signs)[things], score[things], number[things])
    stays = np.ones(len(boxes), np.bool_)
    stays[rows[is_joined]] = False
    return (
        Boxes.together([boxes.take(stays), joined]),
        np.concatenate([view[stays], -1 - np.arange(len(joined))]),
        np.concatenate([is_cut[stays], np.zeros(len(joined), np.bool_)]),
    )
