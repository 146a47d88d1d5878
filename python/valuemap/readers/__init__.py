"""Readers: one file a format, each a function from somebody else's files to a checked `Dataset`."""

from __future__ import annotations

from collections.abc import Callable

from valuemap.dataset import Dataset
from valuemap.readers.colmap import read_colmap
from valuemap.readers.kitti import read_kitti

READERS: dict[str, Callable[..., Dataset]] = {
    "colmap": read_colmap,
    "kitti": read_kitti,
}
"""What `valuemap import NAME` calls."""
