"""Stage 1: split the images into clusters that are worked on alone (section III-C of the paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import valuemap._core as _core
from valuemap.cameras import camera_centers
from valuemap.config import PartitionConfig
from valuemap.tables import Images


def partition_images(images: Images, config: PartitionConfig) -> NDArray[np.uint32]:
    """Return the cluster of each image (N), numbered from 0.

    In ascending order of image_id, each image that is still free becomes a seed and takes all free images whose
    camera centres are closer than `cluster_radius_m`. Every image is in exactly one cluster.
    """
    return _core.partition(np.ascontiguousarray(camera_centers(images)), config.cluster_radius_m)
