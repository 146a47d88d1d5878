"""Boxes from a map of probabilities: connected pixels above a threshold are one object."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from valuemap.detect.boxes import Boxes


def boxes_of_components(probability: NDArray[Any], threshold: float, minimum_component_px: int) -> Boxes:
    """Return the boxes around connected pixels (8 neighbours) of at least the threshold, as class 0.

    Parameters
    ----------
    probability
        (H, W) of one class. A box is in its pixels, the centre of the first at (0.5, 0.5), and its score is the
        mean probability of its component.
    minimum_component_px
        Components of fewer pixels are left out.
    """
    mask = (probability >= threshold).astype(np.uint8)
    count, component, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    total = np.bincount(component.ravel(), weights=probability.ravel().astype(np.float64), minlength=count)
    area = np.asarray(stats[1:, cv2.CC_STAT_AREA], np.int64)
    corner = np.asarray(stats[1:, : cv2.CC_STAT_HEIGHT + 1], np.float64)  # Left, top, width, height.
    edges = np.concatenate([corner[:, :2], corner[:, :2] + corner[:, 2:]], axis=1)
    score = total[1:] / np.maximum(area, 1)
    return Boxes.from_edges(edges, score, np.zeros(count - 1)).take(area >= minimum_component_px)
