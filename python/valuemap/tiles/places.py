"""Where the image of each detection is, for datasets larger than memory: looked up in shares of all images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.dataset import check_detections, rows_of
from valuemap.portions import DatasetReader, read_portions
from valuemap.tables import Detections, Images
from valuemap.tables.write import TableWriter

SHARE = 2_000_000
"""So many images are looked up in at a time: 0.1 GB. Detections of more are first sorted into as many shares."""


_COLUMNS = ("image_id", "camera_id", "place", "place_m")


class PlaceIndex:
    """Where images are, by their ids, in a folder; first all are added, then detections are placed."""

    def __init__(self, folder: Path, images: int) -> None:
        folder.mkdir()
        self._folder, self._shares = folder, max(1, math.ceil(images / SHARE))
        self._parts = 0

    def add(self, images: Images, place: Ints, place_m: Floats) -> None:
        """Add images with their numbers (N) in the driving order and their places (N, 2) on the ground."""
        for share, rows in self._rows(images.image_id):
            np.savez(
                self._folder / f"{share}-{self._parts}.npz",
                image_id=images.image_id[rows],
                camera_id=images.camera_id[rows],
                place=place[rows],
                place_m=place_m[rows],
            )
        self._parts += 1

    def placed(self, reader: DatasetReader) -> Iterator[tuple[Detections, Ints, Floats]]:
        """Yield all detections, checked, with the number of their images in the driving order (N) and place (N, 2)."""
        files = self._sorted(reader)
        for share in range(self._shares):
            image_id, camera_id, place, place_m = self._read(share)
            if self._shares > 1 and not files[share].is_file():
                continue
            portions = (
                reader.detections() if self._shares == 1 else read_portions(Detections, files[share], reader.rows)
            )
            for portion in portions:
                check_detections(portion, image_id, camera_id, reader.cameras, str(reader.folder))
                row = rows_of(portion.image_id, image_id)
                yield portion, place[row], place_m[row]

    def _read(self, share: int) -> tuple[Ints, Ints, Ints, Floats]:
        """Return ids, cameras, numbers and places of the images of a share, by id."""
        columns: dict[str, list[np.ndarray[Any, Any]]] = {name: [] for name in _COLUMNS}
        for path in sorted(self._folder.glob(f"{share}-*.npz")):
            with np.load(path) as part:
                for name, parts in columns.items():
                    parts.append(part[name])
        none = np.empty(0, np.int64)
        image_id, camera_id, place = (np.concatenate([none, *columns[name]]) for name in _COLUMNS[:3])
        place_m = np.concatenate([np.empty((0, 2)), *columns["place_m"]])
        order = np.argsort(image_id)
        return image_id[order], camera_id[order], place[order], place_m[order]

    def _sorted(self, reader: DatasetReader) -> list[Path]:
        """Write the detections of each share of the images into a file; nothing is needed for one share."""
        files = [self._folder / f"of-{share}.parquet" for share in range(self._shares)]
        if self._shares == 1:
            return files
        with ExitStack() as opened:
            writers: dict[int, TableWriter] = {}
            for portion in reader.detections():
                for share, rows in self._rows(portion.image_id):
                    if share not in writers:
                        writers[share] = opened.enter_context(TableWriter(files[share]))
                    writers[share].write(portion.take(rows))
        return files

    def _rows(self, image_id: Ints) -> Iterator[tuple[int, Ints]]:
        """Yield each share of the images, and which of some ids are of it, where there are any."""
        if self._shares == 1:
            yield 0, np.arange(len(image_id))
            return
        of = image_id % self._shares
        for share in range(self._shares):
            rows = np.flatnonzero(of == share)
            if len(rows):
                yield share, rows
