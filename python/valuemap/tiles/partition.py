"""A dataset that is larger than memory, as pieces on disk: written once, tile by tile, with what is around each.

    partition-<hash>/
        partition.json                                  cells, drives, classes: what a task needs to know
        cameras.parquet
        images/tile_x=0/tile_y=-1/part-0.parquet        in driving order, with their drives
        detections/tile_x=0/tile_y=-1/part-0.parquet    a part for each portion that was read
        images/sample/..., detections/sample/...        what is calibrated on

`place` is the number of an image in the driving order of the whole dataset.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from valuemap.arrow import numbers_from_arrow, numbers_to_arrow
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, Frame, rows_of
from valuemap.drives import Drives, InOrder, driving_order, find_drives
from valuemap.portions import DatasetReader
from valuemap.progress import Progress, silent
from valuemap.tables import Cameras, Categories, Detections, Floats, Images, Ints, Table, read_table, write_table
from valuemap.tiles.grid import WHOLE, Cell, Census, Grid, cells_across_tile
from valuemap.tiles.piece import piece_of_rows
from valuemap.tiles.sample import is_sampled
from valuemap.tiles.source import VIEWPOINT_SHARE
from valuemap.tiles.work import written

_META, _CAMERAS, _SAMPLE = "partition.json", "cameras.parquet", "sample"
_DRIVES = ("pass_code", "order", "driven_m", "viewpoint")
_HASHED_BYTES = 1 << 20

T = TypeVar("T", bound=Table)


@dataclass(frozen=True)
class OnDisk:
    """The pieces of a partition: only a path, which travels to other processes."""

    folder: Path

    def piece(self, cell: Cell) -> InOrder:
        """Return what a cell is solved with."""
        if cell == WHOLE:
            return self.sample()
        ordered = self._read(_hive(self.grid.tile_of(cell, self._meta["cells_across"])))
        place_m = self.grid.images_on_ground(ordered.dataset.images)
        return piece_of_rows(ordered, np.flatnonzero(self.grid.is_within(cell, place_m, self.grid.halo_m)))

    def sample(self) -> InOrder:
        """Return what is calibrated on: all of what is one cell."""
        return self._read(_SAMPLE)

    @cached_property
    def cells(self) -> list[Cell]:
        """The cells, ascending."""
        return [Cell((x, y), level, (i, j)) for (x, y), level, (i, j) in self._meta["cells"]]

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
        meta: dict[str, Any] = json.loads((self.folder / _META).read_text(encoding="utf-8"))
        return meta

    def _read(self, part: str) -> InOrder:
        """Return what is in and around a tile, or the sample, in driving order."""
        images = _read_parts(self.folder / "images" / part, self._meta["columns"]["images"])
        place = numbers_from_arrow(images.column("place"))
        found = _read_parts(self.folder / "detections" / part, self._meta["columns"]["detections"])
        row, center = rows_of(numbers_from_arrow(found.column("place")), place), ("x", "y", "width", "height")
        x, y, width, height = (numbers_from_arrow(found.column(name)) for name in center)
        detection_id = numbers_from_arrow(found.column("detection_id"))
        order = np.lexsort((detection_id, height, width, y, x, row))
        detections = _from_columns(Detections, found, self._meta["classes"]).take(order)
        table = _from_columns(Images, images, [""])
        dataset = Dataset(
            name=self.name,
            frame=self.frame,
            cameras=read_table(Cameras, self.folder / _CAMERAS),
            images=table.replace(image_id=np.arange(len(place))),
            detections=detections.replace(detection_id=np.arange(len(order)), image_id=row[order]),
        )
        drives = Drives(**{name: numbers_from_arrow(images.column(name)) for name in _DRIVES}, record={})
        return InOrder(dataset, drives, table.image_id, detection_id[order])


def partition_dataset(
    dataset: Path, work: Path, config: MapConfig, *, tile_size_m: float | None = None, progress: Progress = silent
) -> OnDisk:
    """Write the pieces of a dataset into a folder of work; those that are there already are taken.

    Raises
    ------
    InputError
        As `read_dataset`.
    """
    folder = work / f"partition-{_key(dataset, config, tile_size_m)}"
    if not folder.is_dir():
        with written(folder) as temporary:
            temporary.mkdir()
            _Writer(dataset, temporary, config, tile_size_m, progress).write()
    return OnDisk(folder)


class _Writer:
    """Writes the pieces of a dataset."""

    def __init__(
        self, dataset: Path, folder: Path, config: MapConfig, tile_size_m: float | None, progress: Progress
    ) -> None:
        self.folder, self.progress = folder, progress
        self.max_range_m = config.vote.max_range_m
        self.reader = DatasetReader(dataset)
        self.grid = Grid.of(self.reader.frame, self.max_range_m)
        self.cells_across = cells_across_tile(self.grid, tile_size_m)

    def write(self) -> None:
        reader, grid = self.reader, self.grid
        images = reader.images
        place_m = grid.images_on_ground(images)
        count = np.zeros(len(images), np.int64)
        classes: set[str] = set()
        for portion in reader.detections():
            count += np.bincount(rows_of(portion.image_id, images.image_id), minlength=len(images))
            classes.update(portion.class_name.names)
        census = Census.of(grid, place_m, count)
        cells = census.cells(grid)
        drives = find_drives(images, viewpoint_step_m=self.max_range_m * VIEWPOINT_SHARE)
        rows = driving_order(images, drives)
        place = np.empty(len(rows), np.int64)
        place[rows] = np.arange(len(rows))
        is_in_sample = np.ones(len(images), np.bool_) if cells == [WHOLE] else is_sampled(grid, census, place_m)
        columns: dict[str, dict[str, str]] = {"images": {}, "detections": {}}
        extra = {name: getattr(drives, name) for name in _DRIVES}
        self._spread("images", 0, _to_columns(images, {"place": place, **extra}), rows, place_m, is_in_sample, columns)
        done, total = 0, int(count.sum())
        names = tuple(sorted(classes))
        for number, portion in enumerate(reader.detections()):
            row = rows_of(portion.image_id, images.image_id)
            codes = np.array([names.index(name) for name in portion.class_name.names], np.int32)
            portion = portion.replace(class_name=Categories(codes[portion.class_name.codes], names))
            table = _to_columns(portion, {"place": place[row]})
            every = np.arange(len(portion))
            self._spread("detections", number, table, every, place_m[row], is_in_sample[row], columns)
            done += len(portion)
            self.progress("partition", done, total)
        write_table(reader.cameras, self.folder / _CAMERAS)
        record = {
            "name": reader.name,
            "frame": reader.frame.to_json(),
            "max_range_m": self.max_range_m,
            "cells_across": self.cells_across,
            "cells": [[cell.base, cell.level, cell.place] for cell in cells],
            "classes": names,
            "columns": columns,
            "drives": drives.record,
            "counts": {"images": len(images), "detections": total},
        }
        (self.folder / _META).write_text(json.dumps(record) + "\n", encoding="utf-8")

    def _spread(
        self,
        kind: str,
        number: int,
        table: pa.Table,
        rows: Ints,
        place_m: Floats,
        is_in_sample: np.ndarray[Any, np.dtype[np.bool_]],
        columns: dict[str, dict[str, str]],
    ) -> None:
        """Write rows, in this order, to all tiles that they are in or around."""
        columns[kind] = {column.name: str(column.type) for column in table.schema}
        for part, members in self._tiles_of(place_m[rows]):
            self._write(kind, _hive(part), number, table, rows[members])
        self._write(kind, _SAMPLE, number, table, rows[is_in_sample[rows]])

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

    def _write(self, kind: str, part: str, number: int, table: pa.Table, rows: Ints) -> None:
        if not len(rows):
            return
        folder = self.folder / kind / part
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / f"part-{number}.parquet").open("wb") as file:
            pq.write_table(table.take(numbers_to_arrow(rows)), file, compression="lz4", use_dictionary=False)


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
    settings = [version("valuemap"), config.vote.max_range_m, tile_size_m]
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
            values[field.name] = pa.repeat("", table.num_rows)
        elif names[0] not in table.column_names:
            values[field.name] = None
        elif of == "category":
            codes = numbers_from_arrow(table.column(names[0]))
            if kind is Images:  # What passes are called does not matter.
                codes = np.unique(codes, return_inverse=True)[1].astype(np.int32)
                categories = [str(code) for code in range(int(codes.max(initial=-1)) + 1)]
            values[field.name] = Categories(codes, tuple(categories))
        else:
            parts = [numbers_from_arrow(table.column(name)) for name in names]
            values[field.name] = parts[0] if len(parts) == 1 else np.stack(parts, axis=1)
    return kind(**values)


def _read_parts(folder: Path, columns: dict[str, str]) -> pa.Table:
    """Return all parts in a folder, in their order; none have the columns all the same."""
    parts = []
    for path in sorted(folder.glob("part-*.parquet"), key=lambda path: int(path.stem.partition("-")[2])):
        with path.open("rb") as file:
            parts.append(pq.ParquetFile(file).read())
    if parts:
        return pa.concat_tables(parts).combine_chunks()
    types = {"int64": pa.int64(), "int32": pa.int32(), "double": pa.float64()}
    return pa.schema([pa.field(name, types[kind]) for name, kind in columns.items()]).empty_table()
