"""Boxes of what the car carries: a bonnet, an emblem, dirt on the windscreen, a caption in the picture.

They stay at one place of the picture wherever the car drives. No object does, and other objects that come to the same
place do so in few pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial import KDTree

from valuemap.arrays import Bools, Floats, RowsByNumber
from valuemap.cameras import camera_centers
from valuemap.check.boxes import picture_sizes
from valuemap.check.fault import Fault, Finding, Stage, View, keep_rows
from valuemap.check.sample import drive_of_camera
from valuemap.dataset import Dataset, rows_of

_SIDE_SHARE = 0.01
"""Of a place in the picture, as a share of its width: some times what detectors are off by, and far less than what the
boxes of objects differ by that a car drives past."""
_MORE_THAN = 0.5
"""Of the pictures that a camera takes while the car drives."""
_AROUND = 3.0
"""Sides of a place from its middle, within which other boxes are beside it: far ahead on a straight street all objects
are, near where it vanishes, and there they are as often beside a place as at it."""
_LEAST_STOPS = 30
"""Of fewer places of the world, objects in a row may come to one place in half of the pictures, where the car drives as
far from picture to picture as from object to object."""
_MOST = 0.9
"""Of the positions of a drive are no farther from the nearest other one than a car that drives moves from picture to
picture: where it stands they only tremble."""


class CarriedBoxes(Fault):
    """Boxes that stay at one place of the picture wherever the car drives."""

    name: ClassVar[str] = "carried_boxes"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look for places of the picture where most pictures of one camera in one pass have a box."""
        is_carried, places = find_carried(view.dataset)
        if not places:
            return None
        most, count = places[0], int(is_carried.sum())
        others = f" ({len(places)} such places)" if len(places) > 1 else ""
        return Finding(
            fault=self.name,
            what="Boxes stay at one place of the picture while the car drives: they show what it carries.",
            why=f"{most.text[0].upper()}{most.text[1:]}{others}; {count} of {len(is_carried)} boxes are such.",
            do="Leave them out: mask the part of the picture where the detector sees the bonnet, dirt or a caption.",
            figures={
                "boxes": count,
                "of": len(is_carried),
                "share_of_pictures": round(most.share, 3),
                "places": len(places),
            },
            fix=_without,
        )


def _without(dataset: Dataset) -> Dataset:
    return keep_rows(dataset, detections=~find_carried(dataset)[0])


@dataclass(frozen=True)
class Carried:
    """A place of the pictures of one camera in one pass where most of them have a box: `x_px`, `y_px`."""

    share: float
    """Of the pictures; those from one place of the world together count as one."""
    x_px: float
    y_px: float
    camera_id: int
    pass_name: str

    @property
    def text(self) -> str:
        """What reports call it."""
        return (
            f"in {self.share:.0%} of the pictures that camera {self.camera_id} took while it drove in pass "
            f"{self.pass_name}, a box is within {_SIDE_SHARE:.0%} of the picture's width of "
            f"({self.x_px:.0f}, {self.y_px:.0f}) px"
        )


def find_carried(dataset: Dataset) -> tuple[Bools, list[Carried]]:
    """Return which detections (N) stay at a place of the picture, and these places, those in most pictures first."""
    images, detections = dataset.images, dataset.detections
    image, drive = rows_of(detections.image_id, images.image_id), drive_of_camera(images)
    width_px = picture_sizes(dataset)[:, 0]
    place = detections.center_px / width_px[:, None]
    weight = np.zeros(len(images))
    is_carried, places = np.zeros(len(detections), np.bool_), []
    drives = int(drive.max(initial=0)) + 1
    rows_of_drives = (RowsByNumber.of(each, drives).each() for each in (drive, drive[image]))
    for of_drive, left in zip(*rows_of_drives, strict=True):
        weight[of_drive] = _weights(camera_centers(images.take(of_drive)))
        stops = float(weight[of_drive].sum())
        while len(left) and stops > _LEAST_STOPS - 0.5:
            middle = _densest(place[left], weight[image[left]])
            away = np.abs(place[left] - middle).max(axis=1)
            here = away < _SIDE_SHARE
            share, beside = (
                float(weight[np.unique(image[left[rows]])].sum()) / stops
                for rows in (here, ~here & (away < _AROUND * _SIDE_SHARE))
            )
            if share - beside <= _MORE_THAN:
                break
            is_carried[left[here]] = True
            x_px, y_px = (middle * width_px[left[0]]).tolist()
            first = of_drive[0]
            pass_name = images.pass_id.names[images.pass_id.codes[first]]
            places.append(Carried(share, x_px, y_px, int(images.camera_id[first]), pass_name))
            left = left[~here]
    return is_carried, sorted(places, key=lambda one: -one.share)


def _weights(center_in_world_m: Floats) -> Floats:
    """Return weights of images (N): one over the number of them that a camera took where it stood."""
    different = np.unique(center_in_world_m, axis=0)
    if len(different) < _LEAST_STOPS:
        return np.zeros(len(center_in_world_m))
    nearest_m, _ = KDTree(different).query(different, k=[2])
    step_m = np.quantile(nearest_m, _MOST)
    row, count = np.unique(np.floor(center_in_world_m / step_m), axis=0, return_inverse=True, return_counts=True)[1:]
    weight: Floats = 1.0 / count[row.ravel()]
    return weight


def _densest(place: Floats, weight: Floats) -> Floats:
    """Return the middle (2) of the boxes (N, 2) at the place where their weights (N) are most."""
    most = 0.0
    middle: Floats = place[0]
    # What lies on an edge of one grid lies within another.
    for shift in ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5)):
        cell = np.floor(place / _SIDE_SHARE + shift).astype(np.int64)
        cell -= cell.min(axis=0)
        number = cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1]
        total = np.bincount(number, weight)
        if total.max() > most:
            most = float(total.max())
            middle = np.median(place[number == total.argmax()], axis=0)
    return middle
