"""What tells pieces apart: hashes of all that the labels of a cell depend on.

Each image is told by a number of 64 bits, of it and of its detections; the hash of a piece is made of those of its
images. So cells in which nothing changed are known without making their pieces.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Ints
from valuemap.dataset import rows_of
from valuemap.drives import InOrder
from valuemap.tables import Cameras, Categories, Table
from valuemap.tiles.grid import Cell, numbered
from valuemap.tiles.piece import renumbered

_Hashes = NDArray[np.uint64]
_ODD = np.uint64(0x9E3779B97F4A7C15)
"""2^64 divided by the golden ratio, odd: multiplied by it, each bit reaches those above it."""
_HALF = np.uint64(32)
_BLOCK = 2**13


class Fingerprints:
    """The images of a dataset in driving order with their detections, by which pieces are told apart."""

    def __init__(self, ordered: InOrder) -> None:
        images, detections, drives = ordered.dataset.images, ordered.dataset.detections, ordered.drives
        # Rows are numbered anew in a piece, and so are passes, drives and viewpoints; names do not matter.
        of_image = _columns(images, without=("image_id", "name", "pass_id"))
        of_detection = _columns(detections, without=("detection_id", "image_id"))
        first = ordered.first_detection
        # Differences of sums that overflow are right nevertheless.
        up_to = np.cumsum(np.append(np.uint64(0), _hashes([*of_detection.values(), ordered.detection_id])))
        cameras = ordered.dataset.cameras
        of_camera = _hashes_of_cameras(cameras)[rows_of(images.camera_id, cameras.camera_id)]
        sums = (np.diff(first), np.diff(up_to[first]))
        columns = (*of_image.values(), of_camera, drives.order, drives.driven_m, ordered.image_id, *sums)
        self._image = _hashes(columns)
        self._pass, self._drive, self._viewpoint = images.pass_id.codes, drives.pass_code, drives.viewpoint
        self._head = {
            "frame": ordered.dataset.frame.to_json(),
            "classes": detections.class_name.names,
            "columns": [[*of_image], [*of_detection]],
        }

    def of(self, rows: Ints, cell: Cell, settings: str) -> str:
        """Return the hash of all that the labels of a cell depend on, of the piece with some images (rows, ascending).

        `settings` is what `hash_settings` returned.
        """
        head = {**self._head, "settings": settings, "cell": [cell.base, cell.level, cell.place], "images": len(rows)}
        digest = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
        for column in (
            self._image[rows],
            numbered(self._pass[rows])[1],
            renumbered(self._drive[rows]),
            renumbered(self._viewpoint[rows]),
        ):
            digest.update(column.data)
        return digest.hexdigest()[:32]


def _columns(table: Table, without: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the columns of a table that has values in them, of texts their codes."""
    values = {f.name: getattr(table, f.name) for f in fields(table) if f.name not in without}
    return {
        name: value.codes if isinstance(value, Categories) else value
        for name, value in values.items()
        if value is not None
    }


def _hashes(columns: Sequence[NDArray[Any]]) -> _Hashes:
    """Return a number for each row (N) of some columns (N) or (N, K), in which each bit of the row has its part."""
    values = [each for column in columns for each in (column.T if column.ndim == 2 else [column])]
    hashes = np.zeros(len(columns[0]), np.uint64)
    for first in range(0, len(hashes), _BLOCK):  # What fits into the caches takes half the time.
        rows = slice(first, first + _BLOCK)
        mixed = hashes[rows]
        for each in values:
            wide = each[rows] if each.dtype.itemsize == 8 else each[rows].astype(np.int64)
            mixed ^= np.ascontiguousarray(wide).view(np.uint64)
            mixed *= _ODD
            mixed ^= mixed >> _HALF
    return hashes


def _hashes_of_cameras(cameras: Cameras) -> _Hashes:
    """Return a number for each camera (N)."""
    readout_s = cameras.readout_s
    told = [
        json.dumps(
            [
                cameras.model.names[cameras.model.codes[row]],
                *(int(cameras.width_px[row]), int(cameras.height_px[row])),
                cameras.params[row].tolist(),
                None if readout_s is None else repr(float(readout_s[row])),
            ]
        )
        for row in range(len(cameras))
    ]
    digests = b"".join(hashlib.sha256(each.encode()).digest()[:8] for each in told)
    return np.frombuffer(digests, np.uint64)
