"""Readers: one file a format, each a function from somebody else's files to a checked `Dataset`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from valuemap.readers.reader import Reader

_MODULE_OF = {
    "argoverse2": "argoverse2",
    "bearings": "bearings",
    "colmap": "colmap",
    "csv": "csv_poses",
    "kapture": "kapture",
    "kitti": "kitti",
    "kitti360": "kitti360",
    "mapillary": "mapillary",
    "nuscenes": "nuscenes",
    "opendronemap": "opendronemap",
    "opensfm": "opensfm",
    "panoramax": "panoramax",
    "pictures": "pictures",
    "ros": "ros",
    "tum": "tum",
}
"""The function of a module has its name, with `read_` before it."""


class _Readers(Mapping[str, "Reader[...]"]):
    """A reader is imported when it is asked for: all of them, with what they need, take half a second."""

    def __getitem__(self, name: str) -> Reader[...]:
        module = _MODULE_OF[name]
        reader: Reader[...] = getattr(import_module(f"{__name__}.{module}"), f"read_{module}")
        return reader

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULE_OF)

    def __len__(self) -> int:
        return len(_MODULE_OF)


READERS: Mapping[str, Reader[...]] = _Readers()
"""What `valuemap import NAME` calls; paths may be given as texts."""
