"""All cells of a source through an engine."""

from __future__ import annotations

from valuemap.config import MapConfig
from valuemap.engine.engine import Engine
from valuemap.progress import Progress
from valuemap.robust import Calibration
from valuemap.tiles.grid import Cell
from valuemap.tiles.solve import Solved, solve_cell
from valuemap.tiles.source import Source


def solve_cells(
    source: Source, calibration: Calibration, config: MapConfig, engine: Engine, progress: Progress
) -> list[Solved]:
    """Return the labels of all cells, ascending, that have images in or around them."""
    cells = source.cells
    solved: list[Solved | None] = [None] * len(cells)
    threads = engine.threads_of_task(len(cells))
    one = len(cells) == 1

    def solve(cell: Cell, go_on: Progress) -> Solved | None:
        piece = source.piece(cell)
        if not len(piece.image_id):
            return None
        report = progress if one else go_on
        return solve_cell(piece, cell, source.grid, calibration, config, threads=threads, progress=report)

    for done, (number, result) in enumerate(engine.run(solve, cells), start=1):
        solved[number] = result
        if not one:
            progress("cells", done, len(cells))
    return [result for result in solved if result is not None]
