"""A dataset that is larger than memory, read in portions and checked at the door as `read_dataset` does."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from valuemap.arrays import Ints
from valuemap.arrow import numbers_from_arrow
from valuemap.dataset import (
    Dataset,
    check_cameras,
    check_detections,
    check_images,
    read_head,
    read_images,
)
from valuemap.errors import InputError
from valuemap.tables import Cameras, Detections, Images, Table, Truth
from valuemap.tables.read import not_parquet, read_table, table_from_arrow

ROWS = 500_000
"""Rows that are read at a time."""

LARGEST_IN_MEMORY = 2_000_000
"""Datasets with more images and detections are not held whole: that many take about 2 GB."""

T = TypeVar("T", bound=Table)


def fits_into_memory(rows: int) -> bool:
    """Return whether so many images and detections together are held whole."""
    return rows <= LARGEST_IN_MEMORY


class DatasetReader:
    """The head and cameras of a dataset folder, and its images and detections in portions.

    Ids are unique in the whole tables, and images have known cameras. Which images detections are of is left to who
    has them (`valuemap.dataset.check_detections`).
    """

    def __init__(self, folder: Path, *, rows: int | None = None) -> None:
        self.folder, self.rows = folder, rows or ROWS
        self.name, self.frame = read_head(folder)
        self.cameras = read_table(Cameras, folder / "cameras.parquet")
        check_cameras(self.cameras, str(folder))
        _check_unique(Images, folder / "images.parquet", self.rows)
        _check_unique(Detections, folder / "detections.parquet", self.rows)

    def images(self) -> Iterator[Images]:
        """Yield the images in the order of the file, each portion sorted by id."""
        for portion in read_portions(Images, self.folder / "images.parquet", self.rows):
            yield check_images(portion, self.cameras, str(self.folder))

    def detections(self) -> Iterator[Detections]:
        """Yield the detections in the order of the file, each portion sorted by id."""
        return read_portions(Detections, self.folder / "detections.parquet", self.rows)


def read_dataset_in_portions(folder: Path) -> tuple[Dataset, Iterator[Detections]]:
    """Read and check a dataset as `read_dataset`, its detections in portions, which are read as they are asked for.

    The dataset itself has none; which detections show which true object is not read.
    """
    reader = DatasetReader(folder)
    cameras, images = read_images(folder)
    truth = folder / "truth.parquet"
    dataset = Dataset(
        name=reader.name,
        frame=reader.frame,
        cameras=cameras,
        images=images,
        detections=Detections.none(),
        truth=read_table(Truth, truth) if truth.is_file() else None,
    )

    def portions() -> Iterator[Detections]:
        for portion in reader.detections():
            check_detections(portion, images.image_id, images.camera_id, cameras, str(folder))
            yield portion

    return dataset, portions()


def rows_on_disk(folder: Path) -> tuple[int, int]:
    """Return how many images and detections a dataset folder has, from the ends of its files."""
    return _count(folder / "images.parquet"), _count(folder / "detections.parquet")


def largest_detection(folder: Path) -> int:
    """Return the largest id of the detections of a dataset folder, -1 where there are none."""
    ids = _ids(Detections, folder / "detections.parquet", ROWS)
    return max((int(of_batch.max(initial=-1)) for of_batch in ids), default=-1)


def read_portions(kind: type[T], path: Path, rows: int) -> Iterator[T]:
    """Yield a table in portions of so many rows at most, at least one portion; each is checked and sorted by itself.

    Raises
    ------
    InputError
        As `read_table`.
    """
    for batch in _batches(path, rows, None):
        yield table_from_arrow(kind, batch, source=str(path))


def _count(path: Path) -> int:
    try:
        with path.open("rb") as file:  # Arrow takes no path that is not UTF-8.
            rows: int = pq.ParquetFile(file).metadata.num_rows
    except (pa.ArrowException, OSError):
        return 0  # Whoever reads it says what is wrong.
    return rows


def _batches(path: Path, rows: int, columns: list[str] | None) -> Iterator[pa.Table]:
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder that an import or simulate command wrote")
    try:
        with path.open("rb") as file:
            source = pq.ParquetFile(file, pre_buffer=False)  # Else all of it is in memory in the end.
            if source.metadata.num_rows == 0:
                yield source.read(columns)
            for batch in source.iter_batches(rows, columns=columns):
                table = pa.Table.from_batches([batch])
                table.validate(full=True)  # Finds texts that are not UTF-8.
                yield table
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise not_parquet(path, error) from error


def _check_unique(kind: type[Table], path: Path, rows: int) -> None:
    """Refuse a table in which two rows have one id; a share of all ids is held at a time."""
    assert kind.KEY is not None
    total, last, ascend = 0, -(2**63), True
    for ids in _ids(kind, path, rows):
        if len(ids):
            ascend &= bool(np.all(np.diff(ids) > 0)) and (total == 0 or int(ids[0]) > last)
            last = int(ids[-1])
        total += len(ids)
    shares = 0 if ascend else math.ceil(total / rows)
    for share in range(shares):
        of_share = np.sort(np.concatenate([ids[ids % shares == share] for ids in _ids(kind, path, rows)]))
        repeated = np.flatnonzero(np.diff(of_share) == 0)
        if len(repeated):
            raise InputError(
                f"{path}: {kind.KEY}: expected unique ids, found {of_share[repeated[0]]} again "
                f"({len(repeated)} repeated)",
                hint="give every row an id of its own",
            )


def _ids(kind: type[Table], path: Path, rows: int) -> Iterator[Ints]:
    assert kind.KEY is not None
    if path.is_file() and _count(path):
        with path.open("rb") as file:
            if kind.KEY not in pq.ParquetFile(file).schema_arrow.names:
                return  # Whoever reads the table says what is wrong.
    for batch in _batches(path, rows, [kind.KEY]):
        column = batch.column(kind.KEY)
        if not pa.types.is_integer(column.type) or column.null_count:
            return
        yield numbers_from_arrow(column.cast(pa.int64()))
