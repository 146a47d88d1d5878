"""Where the pieces of cells come from: a dataset in memory here, one on disk in `partition`."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Protocol

import numpy as np

from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.drives import InOrder, in_driving_order
from valuemap.tiles.fingerprint import Fingerprints
from valuemap.tiles.grid import WHOLE, Cell, Census, Grid, Places
from valuemap.tiles.piece import piece_of_rows
from valuemap.tiles.sample import is_sampled

VIEWPOINT_SHARE = 1.0 / 60.0
"""Images of a drive closer than this share of the range are one viewpoint: about a degree of parallax at most."""


class Source(Protocol):
    """A dataset in driving order, as pieces."""

    @property
    def grid(self) -> Grid:
        """The grid of the cells."""
        ...

    @property
    def cells(self) -> list[Cell]:
        """The cells, ascending."""
        ...

    @property
    def sizes(self) -> list[int]:
        """How many detections there are in and around each cell, by which it takes long to solve."""
        ...

    @property
    def drives_record(self) -> dict[str, Any]:
        """What was found about drives."""
        ...

    def piece(self, cell: Cell) -> InOrder:
        """Return what a cell is solved with; it may have no detections, or not even images."""
        ...

    def fingerprint(self, cell: Cell, settings: str) -> str | None:
        """Return what `Fingerprints` tell of a piece, where that is known before the piece is made."""
        ...

    def sample(self) -> InOrder:
        """Return what is calibrated on."""
        ...


class InMemory:
    """The pieces of a dataset that is in memory whole."""

    def __init__(self, dataset: Dataset, config: MapConfig) -> None:
        max_range_m = config.vote.farthest_m
        self.grid: Grid = Grid.of(dataset.frame, max_range_m)
        # Nothing that comes after looks at names, as there are none of pieces on disk.
        step_m = max_range_m * VIEWPOINT_SHARE
        self._ordered = in_driving_order(dataset, viewpoint_step_m=step_m, keeps_names=False)
        self.drives_record: dict[str, Any] = self._ordered.drives.record
        images, detections = self._ordered.dataset.images, self._ordered.dataset.detections
        self._place_m = self.grid.images_on_ground(images)
        self._census = Census.of(self.grid, self._place_m, np.bincount(detections.image_id, minlength=len(images)))
        cells = self._census.cells(self.grid)
        self.cells: list[Cell] = list(cells)
        self.sizes: list[int] = list(cells.values())
        self._places = Places(self.grid, self._place_m)

    def piece(self, cell: Cell) -> InOrder:
        """Return what a cell is solved with."""
        return self._ordered if cell == WHOLE else piece_of_rows(self._ordered, self._places.around(cell))

    def fingerprint(self, cell: Cell, settings: str) -> str:
        """Return what tells the piece of a cell apart."""
        rows = np.arange(len(self._ordered.image_id)) if cell == WHOLE else self._places.around(cell)
        return self._fingerprints.of(rows, cell, settings)

    @cached_property
    def _fingerprints(self) -> Fingerprints:
        return Fingerprints(self._ordered)

    def sample(self) -> InOrder:
        """Return what is calibrated on: all of what is one cell."""
        if self.cells == [WHOLE]:
            return self._ordered
        return piece_of_rows(self._ordered, np.flatnonzero(is_sampled(self.grid, self._census, self._place_m)))
