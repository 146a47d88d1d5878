"""All cells of a source through an engine, those that are done already left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
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
) -> tuple[list[Solved], list[Place]]:
    """Return the labels of all cells, ascending, that have images in or around them, and the files they are in.

    Parameters
    ----------
    store
        Where the labels of each cell are kept; what is there is not made again. There are no files without it.
    known
        Where those of an older map are, which are not made again either.
    """
    cells = source.cells
    settings = hash_settings(source.grid, calibration, config)
    task = CellTask(source, calibration, config, settings, engine.threads_of_task(len(cells)), store, known)
    if len(cells) == 1:  # It tells how far it is.
        return _loaded({cells[0]: task(cells[0], progress)}, {})
    results: dict[Cell, Solved | Place | None] = {}
    read: dict[Cell, Solved] = {}
    with counted(progress, "cells", len(cells)) as tell:
        unsolved = _unsolved(source, task, results)
        first = list(islice(unsolved, max(2, engine.threads_of_task(1))))  # No more of them share out the threads.
        todo = list(first)

        def others() -> Iterator[Cell]:
            """Look for the others, and read what is done, while the first are solved."""
            todo.extend(unsolved)
            done = {cell: file for cell in set(cells).difference(todo) if isinstance(file := results[cell], Place)}
            read.update(zip(done, load_cells(list(done.values())), strict=True))
            yield from todo[len(first) :]

        task = replace(task, threads=engine.threads_of_task(len(first)))
        for number, result in engine.run(task, chain(first, others())):
            results[todo[number]] = result
            tell(len(results))
    return _loaded({cell: results[cell] for cell in cells}, read)


def _unsolved(source: Source, task: CellTask, results: dict[Cell, Solved | Place | None]) -> Iterator[Cell]:
    """Yield the cells that are not done, the largest first, so that all cores end together; enter where others are."""
    for row in np.argsort(-np.array(source.sizes), kind="stable").tolist():
        cell = source.cells[row]
        place = task.done(cell)
        if place is None:
            yield cell
        else:
            results[cell] = place


def _loaded(results: dict[Cell, Solved | Place | None], read: dict[Cell, Solved]) -> tuple[list[Solved], list[Place]]:
    """Return the labels of cells, read where they are in files and not read yet, and the files."""
    places = {cell: file for cell, file in results.items() if file is not None and not isinstance(file, Solved)}
    unread = [cell for cell in places if cell not in read]
    read = {**read, **dict(zip(unread, load_cells([places[cell] for cell in unread]), strict=True))}
    solved = (read.get(cell, result) for cell, result in results.items() if result is not None)
    return [each for each in solved if isinstance(each, Solved)], list(places.values())
