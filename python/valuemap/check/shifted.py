"""Detections that are listed with the image before or after theirs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from valuemap.check.boxes import rows_in_images
from valuemap.check.fault import (
    Convention,
    Fix,
    with_detections,
)
from valuemap.check.sample import (
    order_by_camera,
)
from valuemap.dataset import Dataset


class ShiftedDetections(Convention):
    """Detections that belong to the image before or after."""

    name: ClassVar[str] = "detections_shifted"
    what: ClassVar[str] = (
        "The detections belong to other images than those they are listed with: the next or the last one."
    )
    do: ClassVar[str] = "Match detections and images by name, not by their place in a list (one counts from 1?)."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield detections moved by one image along each pass and camera; by more, that is a shift in time."""
        yield "detections of the next image", _ByImages(1)
        yield "detections of the image before", _ByImages(-1)


class _ByImages:
    """Detections moved along the images of their pass and camera by a number of them; those of the ends stay."""

    def __init__(self, images: int) -> None:
        self._images = images

    def __call__(self, dataset: Dataset) -> Dataset:
        images = dataset.images
        order = order_by_camera(images)
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        to = np.clip(np.arange(len(order)) - self._images, 0, len(order) - 1)
        same = (images.pass_id.codes[order[to]] == images.pass_id.codes[order]) & (
            images.camera_id[order[to]] == images.camera_id[order]
        )
        to = np.where(same, to, np.arange(len(order)))
        moved = order[to][rank]
        return with_detections(dataset, image_id=images.image_id[moved[rows_in_images(dataset)]])
