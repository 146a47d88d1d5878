"""Readers: one file a format, each a function from somebody else's files to a checked `Dataset`."""

from __future__ import annotations

from collections.abc import Mapping

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
from valuemap.readers.reader import Reader
from valuemap.readers.ros import read_ros
from valuemap.readers.tum import read_tum

READERS: Mapping[str, Reader[...]] = {
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
"""What `valuemap import NAME` calls; paths may be given as texts."""
