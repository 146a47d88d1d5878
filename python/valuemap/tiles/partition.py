"""A dataset that is larger than memory, as pieces on disk: written once, tile by tile, with what is around each.

    partition-<hash>/
        partition.json                                  cells, drives, classes: what a task needs to know
        cameras.parquet
        images/tile_x=0/tile_y=-1/part-0.parquet        with their drives, a part for each batch (`fleet`)
        detections/tile_x=0/tile_y=-1/part-0.parquet    a part for each portion that was read

`place` is the number of an image in the driving order of the whole dataset.
"""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from valuemap.arrays import Floats, Ints
from valuemap.arrow import no_texts, numbers_from_arrow, numbers_to_arrow
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, Frame, rows_of
from valuemap.drives import Drives, InOrder, from_left_to_right
from valuemap.portions import DatasetReader, rows_on_disk
from valuemap.progress import Progress, silent
from valuemap.remote import Place, UrlPath, read_all
from valuemap.tables import Cameras, Categories, Detections, Images, Table
from valuemap.tables.read import table_from_arrow
from valuemap.tables.table import table_to_arrow
from valuemap.tiles.fleet import Fleet
from valuemap.tiles.grid import LEVELS, WHOLE, Cell, Census, Grid, cells_across_tile, smallest_squares
from valuemap.tiles.piece import piece_of_rows
from valuemap.tiles.places import PlaceIndex
from valuemap.tiles.sample import sampled_squares
from valuemap.tiles.source import VIEWPOINT_SHARE
from valuemap.tiles.work import TEMPORARY, written_folder

_META, _CAMERAS = "partition.json", "cameras.parquet"
_DRIVES = ("pass_code", "order", "driven_m", "viewpoint")

T = TypeVar("T", bound=Table)


@dataclass(frozen=True)
class OnDisk:
    """The pieces of a partition: only a place, which travels to other processes."""

    folder: Place

    def piece(self, cell: Cell) -> InOrder:
        """Return what a cell is solved with."""
        if cell == WHOLE:
            return self.sample()
        ordered = self._read([self.grid.tile_of(cell, self._meta["cells_across"])])
        place_m = self.grid.images_on_ground(ordered.dataset.images)
        return piece_of_rows(ordered, np.flatnonzero(self.grid.is_within(cell, place_m, self.grid.halo_m)))

    def fingerprint(self, cell: Cell, settings: str) -> str | None:  # noqa: ARG002
        """Return nothing: the piece must be read for it."""
        return None

    def sample(self) -> InOrder:
        """Return what is calibrated on: all of what is one cell."""
        squares = np.array(self._meta["sample"], np.int64).reshape(-1, 2)
        across = self._meta["cells_across"]
        tiles = sorted({self.grid.tile_of(Cell((x >> LEVELS, y >> LEVELS)), across) for x, y in squares.tolist()})
        ordered = self._read(tiles, squares)
        return ordered if self.cells == [WHOLE] else piece_of_rows(ordered, np.arange(len(ordered.image_id)))

    @cached_property
    def cells(self) -> list[Cell]:
        """The cells, ascending."""
        return [Cell((x, y), level, (i, j)) for (x, y), level, (i, j), _ in self._meta["cells"]]

    @property
    def sizes(self) -> list[int]:
        """How many detections there are in and around each cell."""
        return [size for *_, size in self._meta["cells"]]

    @cached_property
    def grid(self) -> Grid:
        """The grid of the cells."""
        return Grid.of(self.frame, self._meta["max_range_m"])

    @cached_property
    def frame(self) -> Frame:
        """The frame of the dataset."""
        return Frame.from_json(self._meta["frame"], source=str(self.folder / _META))

    @property
    def name(self) -> str:
        """The name of the dataset."""
        return str(self._meta["name"])

    @property
    def drives_record(self) -> dict[str, Any]:
        """What was found about drives."""
        return dict(self._meta["drives"])

    @property
    def counts(self) -> dict[str, int]:
        """Images and detections of the dataset."""
        return dict(self._meta["counts"])

    @cached_property
    def _meta(self) -> dict[str, Any]:
        meta: dict[str, Any] = json.loads((self.folder / _META).read_bytes())
        return meta

    def _read(self, tiles: list[tuple[int, int]], squares: Ints | None = None) -> InOrder:
        """Return what is in and around tiles, or of it only what is in some of the smallest squares, in driving order.

        Of several tiles squares must be given: what is around one is in another.
        """
        images, found = self._tables(tiles, squares)
        place = numbers_from_arrow(images.column("place"))
        along = np.argsort(place)
        images, place = images.take(numbers_to_arrow(along)), place[along]
        row = rows_of(numbers_from_arrow(found.column("place")), place)
        detections = _from_columns(Detections, found, self._meta["classes"])
        order = from_left_to_right(detections, row)
        detections = detections.take(order)
        table = _from_columns(Images, images, [""])
        dataset = Dataset(
            name=self.name,
            frame=self.frame,
            cameras=table_from_arrow(Cameras, _parsed((self.folder / _CAMERAS).read_bytes()), source=str(self.folder)),
            images=table.replace(image_id=np.arange(len(place))),
            detections=detections.replace(detection_id=np.arange(len(order)), image_id=row[order]),
        )
        drives = Drives(**{name: numbers_from_arrow(images.column(name)) for name in _DRIVES}, record={})
        return InOrder(dataset, drives, table.image_id, detections.detection_id)

    def _tables(self, tiles: list[tuple[int, int]], squares: Ints | None) -> tuple[pa.Table, pa.Table]:
        """Return the images and detections of `_read`, in any order."""
        columns = self._meta["columns"]
        parts: dict[str, list[pa.Table]] = {"images": [], "detections": []}
        chosen = None if squares is None else {(x, y) for x, y in squares.tolist()}
        for tile in tiles:
            images, found = (_read_parts(self.folder / kind / _hive(tile), columns[kind]) for kind in parts)
            if chosen is not None:
                square = smallest_squares(self.grid, self.grid.images_on_ground(_from_columns(Images, images, [""])))
                across = self._meta["cells_across"] << LEVELS
                own = np.all(square // across == tile, axis=1)
                own &= np.array([(x, y) in chosen for x, y in square.tolist()], np.bool_)
                place = numbers_from_arrow(images.column("place"))[own]
                of_own = np.isin(numbers_from_arrow(found.column("place")), place)
                images, found = (
                    table.take(numbers_to_arrow(np.flatnonzero(rows)))
                    for table, rows in ((images, own), (found, of_own))
                )
            parts["images"].append(images)
            parts["detections"].append(found)
        both = (pa.concat_tables(part).combine_chunks() for part in parts.values())
        images, found = both
        return images, found


def partition_dataset(
    dataset: Path,
    work: Path,
    config: MapConfig,
    *,
    store: Place | None = None,
    tile_size_m: float | None = None,
    progress: Progress = silent,
) -> OnDisk:
    """Write the pieces of a dataset into a folder of work, or a store; those that are there already are taken.

    Raises
    ------
    InputError
        As `read_dataset`.
    """
    place = (store or work) / f"partition-{_key(dataset, config, tile_size_m)}"
    if not (place / _META).is_file():
        with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=work) as aside, written_folder(place) as folder:
            _Writer(dataset, folder, Path(aside), config, tile_size_m, progress).write()
    return OnDisk(place)


class _Writer:
    """Writes the pieces of a dataset, of which only portions are in memory."""

    def __init__(
        self,
        dataset: Path,
        folder: Place,
        aside: Path,
        config: MapConfig,
        tile_size_m: float | None,
        progress: Progress,
    ) -> None:
        self.folder, self.aside, self.progress = folder, aside, progress
        self.max_range_m = config.vote.farthest_m
        self.reader = DatasetReader(dataset)
        self.grid = Grid.of(self.reader.frame, self.max_range_m)
        self.cells_across = cells_across_tile(self.grid, tile_size_m)
        self.columns: dict[str, dict[str, str]] = {"images": {}, "detections": {}}

    def write(self) -> None:
        step_m = self.max_range_m * VIEWPOINT_SHARE
        fleet = Fleet(self.reader, self.aside / "fleet", viewpoint_step_m=step_m, progress=self.progress)
        index = PlaceIndex(self.aside / "places", fleet.count)
        census = Census.of(self.grid, np.empty((0, 2)), np.empty(0, np.int64))
        for number, batch in enumerate(fleet.batches()):
            place_m = self.grid.images_on_ground(batch.images)
            census += Census.of(self.grid, place_m, np.zeros(len(place_m), np.int64))
            extra = {name: getattr(batch.drives, name) for name in _DRIVES}
            self._spread("images", number, _to_columns(batch.images, {"place": batch.place, **extra}), place_m)
            index.add(batch.images, batch.place, place_m)
        classes: dict[str, int] = {}
        done, total = 0, rows_on_disk(self.reader.folder)[1]
        self.progress("cutting into tiles", done, total)
        for number, (portion, place, place_m) in enumerate(index.placed(self.reader)):
            census += Census.of_detections(self.grid, place_m)
            names = portion.class_name.names
            codes = np.array([classes.setdefault(name, len(classes)) for name in names], np.int32)
            portion = portion.replace(class_name=Categories(codes[portion.class_name.codes], tuple(classes)))
            self._spread("detections", number, _to_columns(portion, {"place": place}), place_m)
            done += len(portion)
            self.progress("cutting into tiles", done, total)
        cells = census.cells(self.grid)
        squares = census.square if WHOLE in cells else sampled_squares(census)
        self._write(_CAMERAS, lambda file: pq.write_table(table_to_arrow(self.reader.cameras), file))
        record = {
            "name": self.reader.name,
            "frame": self.reader.frame.to_json(),
            "max_range_m": self.max_range_m,
            "cells_across": self.cells_across,
            "cells": [[cell.base, cell.level, cell.place, size] for cell, size in cells.items()],
            "sample": squares.tolist(),
            "classes": list(classes),
            "columns": self.columns,
            "drives": fleet.record,
            "counts": {"images": fleet.count, "detections": total},
        }
        self._write(_META, lambda file: file.write(json.dumps(record).encode() + b"\n"))

    def _spread(self, kind: str, number: int, table: pa.Table, place_m: Floats) -> None:
        """Write rows, in this order, to all tiles that they are in or around."""
        if table.num_rows:
            self.columns[kind] = {column.name: str(column.type) for column in table.schema}
        else:
            self.columns[kind] = self.columns[kind] or {column.name: str(column.type) for column in table.schema}
        for tile, rows in self._tiles_of(place_m):
            of_tile = table.take(numbers_to_arrow(rows))
            self._write(
                f"{kind}/{_hive(tile)}/part-{number}.parquet",
                partial(pq.write_table, of_tile, compression="lz4", use_dictionary=False),
            )

    def _write(self, name: str, write_to: Callable[[BinaryIO], Any]) -> None:
        place = self.folder / name
        if isinstance(place, UrlPath):
            content = io.BytesIO()
            write_to(content)
            place.write_bytes(content.getvalue())
            return
        place.parent.mkdir(parents=True, exist_ok=True)
        with place.open("wb") as file:
            write_to(file)

    def _tiles_of(self, place_m: Floats) -> Iterator[tuple[tuple[int, int], Ints]]:
        """Yield the tiles that places (N, 2) are in or around, and which are there, ascending."""
        side_m, halo_m = self.grid.side_m * self.cells_across, self.grid.halo_m
        low_m = place_m + 0.5 * self.grid.side_m  # From the corner of the tile that the origin is in.
        first, last = (np.floor((low_m + away) / side_m).astype(np.int64) for away in (-halo_m, halo_m))
        rows, tiles = [], []
        for step in np.ndindex(*(int(n) + 1 for n in (last - first).max(axis=0, initial=0))):
            tile = first + step
            here = np.flatnonzero(np.all(tile <= last, axis=1))
            rows.append(here)
            tiles.append(tile[here])
        row, tile = np.concatenate(rows), np.concatenate(tiles)
        order = np.lexsort((row, tile[:, 1], tile[:, 0]))
        row, tile = row[order], tile[order]
        if not len(row):
            return
        starts = np.flatnonzero(np.any(np.diff(tile, axis=0, prepend=tile[:1] - 1) != 0, axis=1)).tolist()
        for start, end in zip(starts, [*starts[1:], len(row)], strict=True):
            yield (int(tile[start, 0]), int(tile[start, 1])), row[start:end]


def _hive(tile: tuple[int, int]) -> str:
    return f"tile_x={tile[0]}/tile_y={tile[1]}"


def _key(dataset: Path, config: MapConfig, tile_size_m: float | None) -> str:
    """Return a hash of all that a partition depends on."""
    digest = hashlib.sha256()
    for name in ("dataset.json", "cameras.parquet", "images.parquet", "detections.parquet"):
        path = dataset / name
        digest.update(name.encode())
        if path.is_file():
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    settings = [version("valuemap"), config.vote.farthest_m, tile_size_m]
    digest.update(json.dumps(settings).encode())
    return digest.hexdigest()[:32]


def _to_columns(table: Table, extra: dict[str, Any]) -> pa.Table:
    """Return the numbers of a table as columns named as on disk, categories as codes, texts left out."""
    columns: dict[str, pa.Array] = {}
    for field in fields(table):
        value, names = getattr(table, field.name), field.metadata["names"]
        if value is None or field.metadata["kind"] == "text":
            continue
        if isinstance(value, Categories):
            value = value.codes
        for i, name in enumerate(names):
            columns[name] = numbers_to_arrow(value if value.ndim == 1 else value[:, i])
    return pa.table({**columns, **{name: numbers_to_arrow(value) for name, value in extra.items()}})


def _from_columns(kind: type[T], table: pa.Table, categories: list[str]) -> T:
    """Return a typed table of what `_to_columns` made."""
    values: dict[str, Any] = {}
    for field in fields(kind):
        names, of = field.metadata["names"], field.metadata["kind"]
        if of == "text":
            values[field.name] = no_texts(table.num_rows)
        elif names[0] not in table.column_names:
            values[field.name] = None
        elif of == "category":
            codes = numbers_from_arrow(table.column(names[0]))
            if kind is Images:  # What passes are called does not matter.
                codes = np.unique(codes, return_inverse=True)[1].astype(np.int32)
                values[field.name] = Categories(codes, tuple(map(str, range(int(codes.max(initial=-1)) + 1))))
                continue
            rank = np.argsort(np.argsort(categories)).astype(np.int32)
            values[field.name] = Categories(rank[codes] if len(codes) else codes, tuple(sorted(categories)))
        else:
            parts = [numbers_from_arrow(table.column(name)) for name in names]
            values[field.name] = parts[0] if len(parts) == 1 else np.stack(parts, axis=1)
    return kind(**values)


def _read_parts(folder: Place, columns: dict[str, str]) -> pa.Table:
    """Return all parts in a folder, in their order; none have the columns all the same."""
    names = folder.names() if isinstance(folder, UrlPath) else [path.name for path in folder.glob("part-*.parquet")]
    names.sort(key=lambda name: int(name.removeprefix("part-").removesuffix(".parquet")))
    places = [folder / name for name in names]
    parts = [_parsed(content) for content in read_all(places)]
    if parts:
        return pa.concat_tables(parts).combine_chunks()
    types = {"int64": pa.int64(), "int32": pa.int32(), "double": pa.float64()}
    return pa.schema([pa.field(name, types[kind]) for name, kind in columns.items()]).empty_table()


def _parsed(content: bytes) -> pa.Table:
    return pq.ParquetFile(pa.BufferReader(content)).read()
