"""`valuemap import NAME`, in the order in which they are shown: a new one is a file and a line here."""

from __future__ import annotations

from importlib import import_module

READERS = (
    "argoverse2",
    "bearings",
    "colmap",
    "csv",
    "kapture",
    "kitti",
    "kitti360",
    "mapillary",
    "nuscenes",
    "opendronemap",
    "opensfm",
    "panoramax",
    "pictures",
    "ros",
    "tum",
)
"""Modules of this package; each adds its command to `import_app` when it is imported."""

for _module in READERS:
    import_module(f"valuemap.cli.import_.{_module}")
