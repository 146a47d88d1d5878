"""A dataset that is larger than memory, read in portions and checked at the door as `read_dataset` does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from valuemap.dataset import (
    MARKER,
    Dataset,
    Frame,
    check_cameras,
    check_detections,
    check_images,
    read_head,
)
from valuemap.errors import InputError
from valuemap.tables import (
    Cameras,
    Detections,
    Images,
    Ints,
    Table,
    join_tables,
    read_table,
    table_from_arrow,
)

ROWS = 500_000
"""Rows that are read at a time."""

T = TypeVar("T", bound=Table)


class DatasetReader:
    """The head, cameras and images of a dataset folder, and its detections in portions.

    Of the images all columns are held, but the names only where an image has no timestamp: then they tell the order.
    """

    def __init__(self, folder: Path, *, rows: int = ROWS) -> None:
        self.folder, self._rows = folder, rows
        head = read_head(folder)
        self.name = str(head.get("name", folder.name))
        self.frame = Frame.from_json(head.get("frame"), source=str(folder / MARKER))
        self.cameras = read_table(Cameras, folder / "cameras.parquet")
        check_cameras(self.cameras, str(folder))
        self.images = self._read_images()

    def detections(self) -> Iterator[Detections]:
        """Yield the detections in the order of the file, each portion sorted by id."""
        none = Detections(*(None,) * 9)  # type: ignore[arg-type]
        dataset = Dataset(self.name, self.frame, self.cameras, self.images, none)
        for portion in _portions(Detections, self.folder / "detections.parquet", self._rows):
            check_detections(replace(dataset, detections=portion), str(self.folder))
            yield portion

    def _read_images(self) -> Images:
        path = self.folder / "images.parquet"
        parts = []
        for portion in _portions(Images, path, self._rows):
            images = check_images(portion, self.cameras, str(self.folder))
            if images.timestamp_s is not None and not np.isnan(images.timestamp_s).any():
                images = images.replace(name=pa.repeat("", len(images)))
            parts.append(images)
        return _sorted(join_tables(parts), str(path))


def rows_on_disk(folder: Path) -> tuple[int, int]:
    """Return how many images and detections a dataset folder has, from the ends of its files."""
    return _count(folder / "images.parquet"), _count(folder / "detections.parquet")


def _count(path: Path) -> int:
    try:
        rows: int = pq.ParquetFile(path).metadata.num_rows
    except (pa.ArrowException, OSError):
        return 0  # Whoever reads it says what is wrong.
    return rows


def _portions(kind: type[T], path: Path, rows: int) -> Iterator[T]:
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder that an import or simulate command wrote")
    try:
        with path.open("rb") as file:
            source = pq.ParquetFile(file)
            if source.metadata.num_rows == 0:
                yield table_from_arrow(kind, source.schema_arrow.empty_table(), source=str(path))
            for batch in source.iter_batches(rows):
                table = pa.Table.from_batches([batch])
                table.validate(full=True)
                yield table_from_arrow(kind, table, source=str(path))
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{path}: cannot be read as Parquet: {reason}", hint="the file is damaged or cut short: write it again"
        ) from error


def _sorted(images: Images, source: str) -> Images:
    """Return images by id; raises `InputError` where two have the same."""
    steps: Ints = np.diff(images.image_id)
    if np.all(steps > 0):
        return images
    images = images.take(np.argsort(images.image_id, kind="stable"))
    repeated = np.flatnonzero(np.diff(images.image_id) == 0)
    if len(repeated):
        raise InputError(
            f"{source}: image_id: expected unique ids, found {images.image_id[repeated[0]]} again "
            f"({len(repeated)} repeated)",
            hint="give every row an id of its own",
        )
    return images
