"""Readers: one file a format, each a function from somebody else's files to a checked `Dataset`."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any

from valuemap.dataset import Dataset
from valuemap.readers.argoverse2 import read_argoverse2
from valuemap.readers.bearings import read_bearings
from valuemap.readers.colmap import read_colmap
from valuemap.readers.csv_poses import read_csv_poses
from valuemap.readers.kapture import read_kapture
from valuemap.readers.kitti import read_kitti
from valuemap.readers.kitti360 import read_kitti360
from valuemap.readers.mapillary import read_mapillary
from valuemap.readers.nuscenes import read_nuscenes
from valuemap.readers.opensfm import read_opensfm
from valuemap.readers.panoramax import read_panoramax
from valuemap.readers.pictures import read_pictures
from valuemap.readers.ros import read_ros
from valuemap.readers.tum import read_tum


def _taking_texts(reader: Callable[..., Dataset]) -> Callable[..., Dataset]:
    """Return a reader that takes texts where it expects paths, as people write them."""
    parameters = signature(reader)
    paths = {name for name, parameter in parameters.parameters.items() if "Path" in str(parameter.annotation)}

    @wraps(reader)
    def read(*arguments: Any, **options: Any) -> Dataset:
        given = parameters.bind(*arguments, **options)
        for name in paths & given.arguments.keys():
            if isinstance(given.arguments[name], str):
                given.arguments[name] = Path(given.arguments[name])
        return reader(*given.args, **given.kwargs)

    return read


_READERS: dict[str, Callable[..., Dataset]] = {
    "argoverse2": read_argoverse2,
    "bearings": read_bearings,
    "colmap": read_colmap,
    "csv": read_csv_poses,
    "kapture": read_kapture,
    "kitti": read_kitti,
    "kitti360": read_kitti360,
    "mapillary": read_mapillary,
    "nuscenes": read_nuscenes,
    "opensfm": read_opensfm,
    "panoramax": read_panoramax,
    "pictures": read_pictures,
    "ros": read_ros,
    "tum": read_tum,
}
READERS = {name: _taking_texts(reader) for name, reader in _READERS.items()}
"""What `valuemap import NAME` calls; paths may be given as texts."""
