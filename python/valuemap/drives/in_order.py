"""A dataset in driving order: its rows follow the drives, whatever ids, names and rows were before."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from valuemap.arrays import Ints
from valuemap.arrow import no_texts
from valuemap.dataset import Dataset, rows_of
from valuemap.drives.find import Drives, find_drives
from valuemap.tables import Detections, Images


@dataclass(frozen=True, eq=False)
class InOrder:
    """A dataset in driving order: images and detections are numbered by their rows; the ids (N) are those they had."""

    dataset: Dataset
    drives: Drives
    image_id: Ints
    detection_id: Ints

    @cached_property
    def first_detection(self) -> Ints:
        """The first detection (row) of each image (N), and behind the last one how many there are (N + 1)."""
        count = np.bincount(self.dataset.detections.image_id, minlength=len(self.dataset.images))
        return np.concatenate([[0], np.cumsum(count)])

    def rows_of_images(self, image_id: Ints) -> Ints:
        """Return the rows (M) of images by the ids (M) they had, all of which must be there."""
        return _rows_by_id(image_id, self.image_id)

    def rows_of_detections(self, detection_id: Ints) -> Ints:
        """Return the rows (M) of detections by the ids (M) they had, all of which must be there."""
        return _rows_by_id(detection_id, self.detection_id)


def _rows_by_id(ids: Ints, keys: Ints) -> Ints:
    """Return the row in unique `keys` (N), in any order, of each of `ids` (M)."""
    by_id = np.argsort(keys)
    return by_id[rows_of(ids, keys[by_id])]


def driving_order(images: Images, drives: Drives) -> Ints:
    """Return the rows of images (N) along their drives, those of one exposure by place and direction."""
    order = drives.pass_code * (int(drives.order.max(initial=0)) + 1) + drives.order
    if not np.any(np.diff(order) <= 0):
        return np.arange(len(order))
    return np.lexsort((*images.cam_from_world_m.T, *images.cam_from_world_quat.T, order))


def from_left_to_right(detections: Detections, image_row: Ints) -> Ints:
    """Return the rows of detections by image (N), then from left to right; of one box by class, then score.

    Only what is the same in all of that is told apart by ids.
    """
    box = (*detections.size_px.T[::-1], *detections.center_px.T[::-1], image_row)
    rows = np.lexsort(box)
    same = np.arange(len(rows) - 1)
    for key in box[::-1]:
        same = same[key[rows[same]] == key[rows[same + 1]]]
    if not len(same):  # As nearly always.
        return rows
    return np.lexsort((detections.detection_id, detections.score, detections.class_name.codes, *box))


def in_driving_order(dataset: Dataset, *, viewpoint_step_m: float = 1.0, keeps_names: bool = True) -> InOrder:
    """Return a dataset with its rows in an order that ids, names and the order of rows do not change.

    Images follow the drives, those of one exposure by place and direction; the detections of an image go from left
    to right, those of one box by class and score. Without `keeps_names` those of images are empty.
    """
    images, detections = dataset.images, dataset.detections
    drives = find_drives(images, viewpoint_step_m=viewpoint_step_m)
    if not keeps_names:
        images = images.replace(name=no_texts(len(images)))
    image_row = rows_of(detections.image_id, images.image_id)
    rows = driving_order(images, drives)
    if np.any(np.diff(rows) <= 0):
        images = images.take(rows)
        drives = drives.take(rows)
        rank = np.empty(len(rows), dtype=np.int64)
        rank[rows] = np.arange(len(rows))
        image_row = rank[image_row]
    x, step = detections.center_px[:, 0], np.diff(image_row)
    if np.any((step < 0) | ((step == 0) & (np.diff(x) <= 0))):
        rows = from_left_to_right(detections, image_row)
        detections, image_row = detections.take(rows), image_row[rows]
    image_id, detection_id = images.image_id, detections.detection_id
    images = images.replace(image_id=np.arange(len(images)))
    detections = detections.replace(detection_id=np.arange(len(detections)), image_id=image_row)
    return InOrder(replace(dataset, images=images, detections=detections), drives, image_id, detection_id)
