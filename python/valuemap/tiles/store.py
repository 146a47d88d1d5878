"""The labels of cells as files: one a cell, named after the hash of all that they were made from.

They are in the format of Arrow itself: tables as small as these are read and written in a third of the time that
Parquet takes.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
import pyarrow as pa

from valuemap.arrays import Ints
from valuemap.arrow import in_one, numbers_from_arrow, numbers_to_arrow
from valuemap.config import MapConfig
from valuemap.errors import InputError
from valuemap.remote import Place, read_all
from valuemap.robust import Calibration, calibration_to_json
from valuemap.tables import Categories, Labels, Votes
from valuemap.tables.read import table_from_arrow
from valuemap.tables.table import table_to_arrow
from valuemap.tiles.grid import Cell, Grid
from valuemap.tiles.solve import Solved
from valuemap.tiles.work import put

_AGAIN = "remove it, and make the map again"
_VOTE_COLUMNS = ("detection_id", "image_id", "residual_px", "residual_sigmas")


def cell_file(folder: Place, cell: Cell, key: str) -> Place:
    """Return where the labels of a cell are, made from what has this hash."""
    return folder / f"{cell.name}.{key}.arrow"


def hash_settings(grid: Grid, calibration: Calibration | None, config: MapConfig) -> str:
    """Return the hash of all that the labels of every cell depend on."""
    head = {
        "valuemap": version("valuemap"),
        "grid": vars(grid),
        "settings": config.as_dict(),
        "calibration": None if calibration is None else calibration_to_json(calibration),
    }
    return hashlib.sha256(json.dumps(head, sort_keys=True).encode()).hexdigest()


def save_cell(solved: Solved, place: Place) -> None:
    """Write the labels of a cell with their votes: a row a label."""
    table = table_to_arrow(solved.labels)
    votes = table_to_arrow(solved.votes)
    offsets = numbers_to_arrow(
        np.searchsorted(solved.votes.label_id, np.arange(1, len(solved.labels) + 2)).astype("i4")
    )
    for name in _VOTE_COLUMNS:
        table = table.append_column(f"vote.{name}", _listed(votes.column(name), offsets))
    table = table.append_column("vote.pass", _listed(numbers_to_arrow(solved.vote_pass), offsets))
    table = table.append_column("is_own", numbers_to_arrow(solved.is_own.astype(np.int32)))
    cell = {"base": solved.cell.base, "level": solved.cell.level, "place": solved.cell.place}
    head = {"cell": cell, "counts": solved.counts, "classes": solved.labels.class_name.names}
    table = table.replace_schema_metadata({"valuemap": json.dumps(head)})
    file = io.BytesIO()
    options = pa.ipc.IpcWriteOptions(compression="lz4", use_threads=False)
    with pa.ipc.new_file(file, table.schema, options=options) as writer:
        writer.write_table(table)
    put(place, file.getvalue())


def load_cells(places: Sequence[Place]) -> list[Solved]:
    """Read what `save_cell` wrote of some cells; raises `InputError` where a file is damaged."""
    if not places:
        return []
    heads, tables = zip(*map(_parsed, places, _contents(places)), strict=True)
    # All are checked as one table: of a small one that takes longer than reading it.
    table = pa.concat_tables(tables)
    first = np.cumsum([0, *map(len, tables)])
    number = numbers_to_arrow(np.arange(table.num_rows))
    label_id = numbers_from_arrow(table.column(Labels.KEY))
    table = table.set_column(table.column_names.index(Labels.KEY), Labels.KEY, number)
    labels = table_from_arrow(Labels, table, source=str(places[0])).replace(label_id=label_id)
    votes = {name: _flat(table.column(f"vote.{name}")) for name in (*_VOTE_COLUMNS, "pass")}
    of_label = np.repeat(label_id, labels.votes)
    first_vote = np.concatenate([[0], np.cumsum(labels.votes)])[first]
    is_own = numbers_from_arrow(table.column("is_own")) > 0
    cells = []
    for k, head in enumerate(heads):
        rows, cast = slice(first[k], first[k + 1]), slice(first_vote[k], first_vote[k + 1])
        of_cell = labels[rows]
        classes = tuple(head["classes"])
        code = np.array([classes.index(name) if name in classes else -1 for name in labels.class_name.names], np.int32)
        codes = code[of_cell.class_name.codes] if len(of_cell) else of_cell.class_name.codes
        cells.append(
            Solved(
                cell=head["cell"],
                labels=of_cell.replace(class_name=Categories(codes, classes)),
                is_own=is_own[rows],
                votes=Votes(of_label[cast], **{name: votes[name][cast] for name in _VOTE_COLUMNS}),
                vote_pass=votes["pass"][cast],
                counts=head["counts"],
            )
        )
    return cells


def _contents(places: Sequence[Place]) -> Iterator[bytes]:
    try:
        yield from read_all(places)
    except OSError as error:
        raise InputError(f"{places[0]} and others: cannot be read: {error}", hint=_AGAIN) from error


def _parsed(place: Place, content: bytes) -> tuple[dict[str, Any], pa.Table]:
    """Return what a file of a cell says of it, and its rows."""
    try:
        options = pa.ipc.IpcReadOptions(use_threads=False)
        table = pa.ipc.open_file(pa.BufferReader(content), options=options).read_all()
        table.validate(full=True)  # Nothing else finds offsets that lead out of a column.
        head = json.loads(table.schema.metadata[b"valuemap"])
        cell = head["cell"]
        head = {**head, "cell": Cell(tuple(cell["base"]), cell["level"], tuple(cell["place"]))}
    except (pa.ArrowException, OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{place}: cannot be read: {error}", hint=_AGAIN) from error
    return head, table.replace_schema_metadata(None)


def _listed(column: pa.Array | pa.ChunkedArray, offsets: pa.Array) -> pa.Array:
    return pa.ListArray.from_arrays(offsets, in_one(column))


def _flat(column: pa.ChunkedArray) -> Any:
    """Return the numbers of all lists, one after the other, none of which is missing."""
    chunks = [chunk for chunk in column.chunks if len(chunk)]
    parts = [chunk.values[chunk.offsets[0].as_py() : chunk.offsets[-1].as_py()] for chunk in chunks]
    values: Ints = numbers_from_arrow(pa.chunked_array(parts, column.type.value_type))
    return values
