"""All cells of a source through an engine, those that are done already left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from valuemap.config import MapConfig
from valuemap.engine.engine import Engine
from valuemap.progress import Progress, counted
from valuemap.remote import Place
from valuemap.robust import Calibration
from valuemap.tiles.fingerprint import Fingerprints
from valuemap.tiles.grid import Cell
from valuemap.tiles.solve import Solved, solve_cell
from valuemap.tiles.source import Source
from valuemap.tiles.store import cell_file, hash_settings, load_cells, save_cell


@dataclass(frozen=True)
class CellTask:
    """What is done with a cell: all that is needed travels with it, the data as a source that reads it.

    `settings` is the hash of what all cells depend on.
    """

    source: Source
    calibration: Calibration
    config: MapConfig
    settings: str
    threads: int
    store: Place | None = None
    known: Path | None = None

    def __call__(self, cell: Cell, progress: Progress) -> Solved | Place | None:
        """Return the labels of a cell, or where they are; nothing where there are no images."""
        piece = self.source.piece(cell)
        if not len(piece.image_id):
            return None
        grid, file = self.source.grid, None
        if self.store is not None:
            key = self.source.fingerprint(cell, self.settings)
            if key is None:
                key = Fingerprints(piece).of(np.arange(len(piece.image_id)), cell, self.settings)
                if (done := self._done(cell, key)) is not None:
                    return done
            file = cell_file(self.store, cell, key)
        solved = solve_cell(piece, cell, grid, self.calibration, self.config, threads=self.threads, progress=progress)
        if file is None:
            return solved
        save_cell(solved, file)
        return file

    def done(self, cell: Cell) -> Place | None:
        """Return where the labels of a cell are, if they are there and that is known before its piece is made."""
        key = None if self.store is None else self.source.fingerprint(cell, self.settings)
        return None if key is None else self._done(cell, key)

    def _done(self, cell: Cell, key: str) -> Place | None:
        """Return where the labels of a cell are, made from what has this hash, if they are there."""
        places = (place for place in (self.store, self.known) if place is not None)
        return next((file for place in places if (file := cell_file(place, cell, key)).is_file()), None)


def solve_cells(
    source: Source,
    calibration: Calibration,
    config: MapConfig,
    engine: Engine,
    progress: Progress,
    *,
    store: Place | None = None,
    known: Path | None = None,
) -> list[Solved | Place]:
    """Return the labels of all cells, ascending, that have images in or around them, or where they are.

    Parameters
    ----------
    store
        Where the labels of each cell are kept; what is there is not made again.
    known
        Where those of an older map are, which are not made again either.
    """
    cells = source.cells
    settings = hash_settings(source.grid, calibration, config)
    task = CellTask(source, calibration, config, settings, engine.threads_of_task(len(cells)), store, known)
    if len(cells) == 1:  # It tells how far it is.
        result = task(cells[0], progress)
        return [] if result is None else [result]
    with counted(progress, "cells", len(cells)) as tell:
        solved: list[Solved | Place | None] = [task.done(cell) for cell in cells]
        largest_first = np.argsort(-np.array(source.sizes), kind="stable").tolist()  # So that all cores end together.
        todo = [row for row in largest_first if solved[row] is None]
        task = replace(task, threads=engine.threads_of_task(len(todo)))
        tell(len(cells) - len(todo))
        for left, (place, result) in enumerate(engine.run(task, [cells[row] for row in todo]), start=1):
            solved[todo[place]] = result
            tell(len(cells) - len(todo) + left)
    return [result for result in solved if result is not None]


def loaded(solved: list[Solved | Place]) -> list[Solved]:
    """Return the labels of cells, read where they are in files."""
    read = iter(load_cells([result for result in solved if not isinstance(result, Solved)]))
    return [result if isinstance(result, Solved) else next(read) for result in solved]
