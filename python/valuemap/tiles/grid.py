"""The cells of a dataset: squares of a fixed grid on the ground, which depend on where there is data.

The squares are anchored at the origin of the world, which is the middle of one of them. One in which, with what is
around it, there are more detections than can be held at a time is four squares, and so on. A dataset that is no wider
than a square, and has no more, is one cell whole. Tiles group cells into units of work: their size changes no label.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints, bounds
from valuemap.cameras import camera_centers
from valuemap.dataset import Frame
from valuemap.errors import SettingError
from valuemap.tables import Images

SIDE_RANGES = 16.0
"""The side of a cell, in units of `max_range_m`: 960 m by default. What lies around cells is solved with each of them,
so larger ones cost less; smaller ones take less memory, and less of a map has to be made again where streets are driven
again."""
HALO_RANGES = 1.25
"""Images this far around a cell are solved with it, in units of `max_range_m`: all that see objects in it, and so much
farther that objects just beyond its border, which compete for the same detections, are seen by all of theirs too."""
MARGIN_RANGES = 1.0 / 6.0
"""Labels this far around a cell are compared with those of its neighbors."""
LEVELS = 3
"""How often a cell may be split: into squares of two ranges at least, as there is always the same around them."""
MOST_DETECTIONS = 300_000
"""Cells with more detections in and around them are split: about 0.5 GB."""


@dataclass(frozen=True, order=True)
class Cell:
    """A square: `base` is its number in the grid, or that of the one that it is a part of.

    A part is the square `place` of the 2^level x 2^level that the square of the grid is split into.
    """

    base: tuple[int, int]
    level: int = 0
    place: tuple[int, int] = (0, 0)

    @property
    def name(self) -> str:
        """A name for people and files."""
        part = "" if self.level == 0 else f"-{self.level}-{self.place[0]}-{self.place[1]}"
        return f"{self.base[0]}_{self.base[1]}{part}"


WHOLE = Cell((0, 0), -1)
"""The one cell of a dataset that is no wider than one."""


@dataclass(frozen=True)
class Grid:
    """Squares of the ground, in the directions `east_north` (2, 3) of the frame."""

    side_m: float
    halo_m: float
    margin_m: float
    east_north: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    most_detections: int = MOST_DETECTIONS

    @classmethod
    def of(cls, frame: Frame, max_range_m: float) -> Grid:
        """Return the grid that maps are made on."""
        east_north = tuple(map(tuple, frame.east_north().tolist()))
        return cls(SIDE_RANGES * max_range_m, HALO_RANGES * max_range_m, MARGIN_RANGES * max_range_m, east_north)

    @property
    def halo_squares(self) -> int:
        """How many of the smallest squares the halo is wide."""
        squares: float = self.halo_m * 2.0**LEVELS / self.side_m
        return math.ceil(squares)

    def on_ground(self, point_in_world_m: Floats) -> Floats:
        """Return the places (N, 2) of points (N, 3) on the ground."""
        across = np.array(self.east_north)
        if np.count_nonzero(across) == 2 and np.all(across.max(axis=1) == 1.0):  # Two axes of the frame, as usual.
            return np.ascontiguousarray(point_in_world_m[:, across.argmax(axis=1)])
        return np.asarray(point_in_world_m @ across.T)

    def images_on_ground(self, images: Images) -> Floats:
        """Return the places (N, 2) of images on the ground."""
        return self.on_ground(camera_centers(images))

    def is_within(self, cell: Cell, place_m: Floats, around_m: float = 0.0) -> Bools:
        """Return which places (N, 2) are in a cell, or less than `around_m` outside it."""
        if cell == WHOLE:
            return np.ones(len(place_m), np.bool_)
        index = np.array(cell.base) * 2**cell.level + np.array(cell.place)
        # The upper corner is computed as the lower one of the next square: no place is in two, or in none.
        low, high = (step * (self.side_m / 2**cell.level) - 0.5 * self.side_m for step in (index, index + 1))
        is_above, is_below = place_m >= low - around_m, place_m < high + around_m
        inside: Bools = is_above[:, 0] & is_above[:, 1] & is_below[:, 0] & is_below[:, 1]
        return inside

    def find(self, place_m: Floats, cells: Sequence[Cell]) -> Ints:
        """Return the number among some cells of that in which each place (N, 2) is, -1 where none is there."""
        number = {(cell.level, cell.base, cell.place): i for i, cell in enumerate(cells)}
        found = np.full(len(place_m), -1)
        for level in sorted({cell.level for cell in cells} - {WHOLE.level}):
            index = np.floor((place_m + 0.5 * self.side_m) / (self.side_m / 2**level)).astype(np.int64)
            for row, (x, y) in enumerate(index.tolist()):
                base, place = (x >> level, y >> level), (x % 2**level, y % 2**level)
                found[row] = number.get((level, base, place), found[row])
        return found

    def tile_of(self, cell: Cell, cells_across: int) -> tuple[int, int]:
        """Return the tile that a cell is of."""
        return cell.base[0] // cells_across, cell.base[1] // cells_across


def smallest_squares(grid: Grid, place_m: Floats) -> Ints:
    """Return the smallest square (N, 2) of a grid that each place (N, 2) is in."""
    return np.asarray(np.floor((place_m + 0.5 * grid.side_m) / (grid.side_m / 2**LEVELS)).astype(np.int64))


def numbered(keys: NDArray[Any]) -> tuple[Ints, Ints]:
    """Return which whole numbers from 0 there are, ascending, and which of them each key (N) is."""
    if keys.max(initial=0) > 4 * len(keys):
        found, number = np.unique(keys, return_inverse=True)
        return found, number
    is_there = np.bincount(keys) > 0  # In a tenth of the time of sorting them.
    return np.flatnonzero(is_there), (np.cumsum(is_there) - 1)[keys]


@dataclass(frozen=True, eq=False)
class Census:
    """How many images and detections there are in each of the smallest squares.

    `square` (N, 2) are those with images, ascending; all squares of a grid's cell have 2^LEVELS of them across.
    """

    square: Ints
    images: Ints
    detections: Ints
    extent_m: tuple[float, float, float, float] = (math.inf, math.inf, -math.inf, -math.inf)

    @classmethod
    def of(cls, grid: Grid, place_m: Floats, detections: Ints) -> Census:
        """Count images at places (N, 2) with as many `detections` (N) each."""
        if not len(place_m):
            return cls(np.empty((0, 2), np.int64), np.empty(0, np.int64), np.empty(0, np.int64))
        square = smallest_squares(grid, place_m)
        low, high = bounds(square)
        across = int(high[1] - low[1]) + 1
        keys, inverse = numbered((square[:, 0] - low[0]) * across + square[:, 1] - low[1])
        found = np.column_stack([keys // across, keys % across]) + low
        least_m, largest_m = (bound.tolist() for bound in bounds(place_m))
        return cls(
            found,
            np.bincount(inverse, minlength=len(found)),
            np.bincount(inverse, detections, len(found)).astype(np.int64),
            (*least_m, *largest_m),
        )

    @classmethod
    def of_detections(cls, grid: Grid, place_m: Floats) -> Census:
        """Count detections of images at places (N, 2), which are counted already."""
        found = cls.of(grid, place_m, np.ones(len(place_m), np.int64))
        return replace(found, images=np.zeros_like(found.images))

    def __add__(self, other: Census) -> Census:
        square, inverse = np.unique(np.concatenate([self.square, other.square]), axis=0, return_inverse=True)
        inverse = inverse.reshape(-1)
        images = np.bincount(inverse, np.concatenate([self.images, other.images]), len(square))
        detections = np.bincount(inverse, np.concatenate([self.detections, other.detections]), len(square))
        low = np.minimum(self.extent_m[:2], other.extent_m[:2]).tolist()
        high = np.maximum(self.extent_m[2:], other.extent_m[2:]).tolist()
        return Census(square, images.astype(np.int64), detections.astype(np.int64), (*low, *high))

    def cells(self, grid: Grid) -> dict[Cell, int]:
        """Return the cells, ascending, that may have images in or around them, with how many detections there are."""
        is_narrow = not len(self.square) or max(np.subtract(self.extent_m[2:], self.extent_m[:2])) <= grid.side_m
        if is_narrow and self.detections.sum() <= grid.most_detections:
            return {WHOLE: int(self.detections.sum())}
        reach = grid.halo_squares
        around = np.concatenate([self.square + step for step in np.ndindex(2 * reach + 1, 2 * reach + 1)]) - reach
        bases = np.unique(around >> LEVELS, axis=0).tolist()
        return dict(sorted(found for x, y in bases for found in self._split(grid, Cell((x, y)))))

    def _split(self, grid: Grid, cell: Cell) -> list[tuple[Cell, int]]:
        images, detections = self._around(grid, cell)
        if images == 0:
            return []
        if detections <= grid.most_detections or cell.level == LEVELS:
            return [(cell, detections)]
        x, y = cell.place
        parts = [Cell(cell.base, cell.level + 1, (2 * x + i, 2 * y + j)) for i, j in np.ndindex(2, 2)]
        return [final for part in parts for final in self._split(grid, part)]

    def _around(self, grid: Grid, cell: Cell) -> tuple[int, int]:
        """Return how many images and detections there are in a cell and the squares around it."""
        across = 2 ** (LEVELS - cell.level)
        low = [base * 2**LEVELS + place * across for base, place in zip(cell.base, cell.place, strict=True)]
        index, reach = self._index, grid.halo_squares
        near = [
            row
            for x in range(low[0] - reach, low[0] + across + reach)
            for y in range(low[1] - reach, low[1] + across + reach)
            if (row := index.get((x, y))) is not None
        ]
        return int(self.images[near].sum()), int(self.detections[near].sum())

    @cached_property
    def _index(self) -> dict[tuple[int, int], int]:
        return {(x, y): row for row, (x, y) in enumerate(self.square.tolist())}


class Places:
    """Places (N, 2) on the ground by the smallest square that they are in: a cell looks only at those near it."""

    def __init__(self, grid: Grid, place_m: Floats) -> None:
        self._grid, self._place_m = grid, place_m
        square = smallest_squares(grid, place_m)
        low, high = bounds(square) if len(square) else (square.sum(axis=0),) * 2
        self._low, self._across = low, int(high[1] - low[1]) + 1
        key = self._key(square)
        # Numbers of 16 bits are sorted by counting.
        self._order = np.argsort(key.astype(np.uint16) if key.max(initial=0) < 2**16 else key, kind="stable")
        self._keys = key[self._order]

    def around(self, cell: Cell) -> Ints:
        """Return the places (rows, ascending) in a cell and its halo."""
        across = 2 ** (LEVELS - cell.level)
        low = np.array(cell.base) * 2**LEVELS + np.array(cell.place) * across - self._grid.halo_squares
        high = low + across + 2 * self._grid.halo_squares
        x = np.arange(low[0], high[0])
        bounds = np.clip([low[1], high[1]], self._low[1], self._low[1] + self._across)
        first, end = (np.searchsorted(self._keys, self._key(np.column_stack([x, np.full_like(x, y)]))) for y in bounds)
        rows = np.concatenate([self._order[a:b] for a, b in zip(first.tolist(), end.tolist(), strict=True)])
        rows = np.sort(rows)
        return np.asarray(rows[self._grid.is_within(cell, self._place_m[rows], self._grid.halo_m)])

    def _key(self, square: Ints) -> Ints:
        """Return numbers (N) that ascend with the first, then the second coordinate of squares (N, 2)."""
        return np.asarray((square[:, 0] - self._low[0]) * self._across + square[:, 1] - self._low[1])


def check_tile_size(tile_size_m: float | None) -> None:
    """Refuse a size of tiles, in metres, that is none (`SettingError`)."""
    if tile_size_m is not None and not tile_size_m > 0.0:
        raise SettingError(f"--tile-size {tile_size_m}: expected metres above 0", hint="leave it away for the default")


def cells_across_tile(grid: Grid, tile_size_m: float | None) -> int:
    """Return how many cells a tile of about this size (above 0) has across: at least one."""
    if tile_size_m is None:
        return 1
    return max(1, math.ceil(min(tile_size_m / grid.side_m, 2.0**31)))
