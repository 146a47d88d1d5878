"""How coarsely detections are written down: bearings in whole degrees, boxes of whole pixels, cells of a heat map.

A map of few detections may fit better by chance than they can be right. No noise is below that of rounding: where there
is nothing between steps of q, the standard deviation of the uniform distribution between them, q / sqrt(12).
"""

from __future__ import annotations

import math

import numpy as np

from valuemap.arrays import Floats
from valuemap.dataset import Dataset, rows_of

_CHANCE = 1e-6
"""Numbers that are not rounded are nowhere closer to each other than what is taken for a step, in one of a million
datasets."""
_DIGITS = 6
"""Pixels are told apart to a millionth: less is the rounding of arithmetic."""


def rounding_px(dataset: Dataset) -> float:
    """Return the standard deviation that rounding alone gives the centres of detections, on each axis, px.

    It is the mean over the detections and both axes; 0 where nothing shows that they are rounded.
    """
    detections, images = dataset.detections, dataset.images
    if not len(detections):
        return 0.0
    camera = images.camera_id[rows_of(detections.image_id, images.image_id)]
    variance = 0.0
    for camera_id in np.unique(camera).tolist():
        of_camera = detections.center_px[camera == camera_id]
        variance += len(of_camera) * sum(_step(along) ** 2 / 12.0 for along in of_camera.T)
    return math.sqrt(variance / (2.0 * len(detections)))


def _step(values: Floats) -> float:
    """Return the step that numbers (N) are rounded to, 0 if they may as well not be."""
    different = np.unique(np.round(values, _DIGITS))
    count, extent = len(different), float(different[-1] - different[0])
    if extent == 0.0:
        return 0.0
    step = float(np.diff(different).min())
    # Of so many numbers in that extent no two are closer: about count^2 pairs, each closer by chance step / extent.
    return step if math.exp(-count * (count - 1) * step / extent) < _CHANCE else 0.0
