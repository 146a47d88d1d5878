"""Rolling shutters: rows have times of their own, so images get the poses of the rows that their detections are on.

A camera states how much later its last row is exposed than its first one (`readout_s`), and an image's pose is that of
the middle row. How fast it moves and turns is told by the images before and after it in its drive. What is detected
on other rows than the mean of all in its image is left where it is: lights and signs are about as high in a picture.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import camera_poses
from valuemap.dataset import Dataset, rows_of
from valuemap.drives import find_drives
from valuemap.refine.footage import find_steps, moved_on, with_poses


def expose_rows(dataset: Dataset) -> tuple[Dataset, dict[str, Any]]:
    """Return a dataset with the poses that cameras had when the rows of their detections were exposed, and a record.

    Where no camera states a readout time, it is the dataset that was given, and nothing is recorded. Images whose drive
    has no times stay: how fast they move is not known. The cameras that come out state no readout time: none is left.
    """
    readout_s = dataset.cameras.readout_s
    if readout_s is None or not np.nan_to_num(readout_s).any():
        return dataset, {}
    images = dataset.images
    motion = find_steps(dataset, find_drives(images)).motion()
    late_s = np.where(motion.is_timed, _lateness(dataset, np.nan_to_num(readout_s)), 0.0)
    rotation, center = camera_poses(images)
    moved_rotation, moved_center = moved_on(motion, rotation, center, late_s)
    moved_m = np.linalg.norm(moved_center - center, axis=1)
    moved = with_poses(images, moved_rotation, moved_center)
    has_moved = late_s != 0.0
    record = {
        "images": int(has_moved.sum()),
        "images_without_times": int((~motion.is_timed).sum()),
        "mean_s": round(float(late_s[has_moved].mean()), 6) if has_moved.any() else 0.0,
        "mean_moved_m": round(float(moved_m[has_moved].mean()), 4) if has_moved.any() else 0.0,
    }
    return replace(dataset, images=moved, cameras=dataset.cameras.replace(readout_s=None)), {"rows": record}


def _lateness(dataset: Dataset, readout_s: Floats) -> Floats:
    """Return how much later (N) than the middle row of each image its detections are exposed, in the mean, s."""
    images, cameras, detections = dataset.images, dataset.cameras, dataset.detections
    camera = rows_of(images.camera_id, cameras.camera_id)
    image = rows_of(detections.image_id, images.image_id)
    share = detections.center_px[:, 1] / cameras.height_px[camera[image]] - 0.5
    count = np.bincount(image, minlength=len(images))
    mean = np.bincount(image, weights=share, minlength=len(images)) / np.maximum(count, 1)
    return np.asarray(readout_s[camera] * mean)
