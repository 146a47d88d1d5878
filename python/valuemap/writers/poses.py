"""Corrected poses: a dataset, and beside it a COLMAP model of the same, with the labels as its points."""

from __future__ import annotations

from pathlib import Path

from valuemap.dataset import PARTS, Dataset, write_dataset
from valuemap.folders import check_place, new_folder
from valuemap.map_folder import Map
from valuemap.writers.attributes import Export
from valuemap.writers.colmap import FILES, write_colmap

MODEL = "colmap"
"""The folder of the model in that of the dataset."""


def check_poses_place(path: Path, *, force: bool = False) -> None:
    """Check before long work that `write_poses` may write there; raises as that."""
    check_place(path, parts=PARTS, force=force)
    check_place(path / MODEL, parts=FILES, force=force)


def write_poses(result: Map, dataset: Dataset, path: Path, *, force: bool = False) -> None:
    """Write the dataset that labels were found with as a folder, and as a COLMAP model in its folder `colmap`.

    Raises
    ------
    OutputError
        A file that valuemap did not write is in the way, or the place cannot be written.
    InputError
        An id is larger than COLMAP can hold.
    """
    write_dataset(dataset, path, force=force)
    with new_folder(path / MODEL, parts=FILES, force=force) as folder:
        write_colmap(Export(result, dataset), folder)
