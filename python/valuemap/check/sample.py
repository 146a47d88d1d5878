"""The sample that a check looks at: stretches of single passes, and places that several passes meet.

A stretch is what one pass saw on some way, whatever the poses are; a place is what all passes saw within some metres,
if the positions can be believed. Mistakes in conventions spoil stretches; mistakes between passes spoil places only.
The choice is a function of the data alone: evenly spread, never at random.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import Pinholes, camera_centers, local_pinholes
from valuemap.dataset import Dataset, rows_of
from valuemap.tables import Images

MOST_DETECTIONS = 3000
"""Of a sample: enough to tell conventions apart many times over, and a tenth of a second for each."""
_LEAST_PLACES = 12
_DETECTIONS_OF_A_PLACE = (24, 120)
_MOST_IN_A_PLACE = 200
_IMAGES_OF_A_STRETCH = 200
_STANDING = 0.2
_PLACE_STEPS = 16.0
"""Radius of a place in median steps between images: tens of metres in street images, and no metre in it."""
HEAT, LEAST_IN_HEAT = 4, 5
"""Every so many stretches of a sample readings and times are tried on first, if there are so many of these."""
FASTER = 3.0
"""No car goes faster than so many times its usual speed, or its images farther from each other than so many steps."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Part of a dataset, all of whose images are in a place: `place_of_image` (images) counts from 0.

    `image_row` are the rows in the `whole` dataset.
    """

    dataset: Dataset
    place_of_image: NDArray[np.uint32]
    image_row: Ints
    whole: Dataset

    def of(self, whole: Dataset) -> Dataset:
        """Return the same images of another version of the whole dataset, with what it detects in them."""
        images = whole.images.take(self.image_row)
        if whole.detections is self.whole.detections:
            detections = self.dataset.detections
        else:
            detections = whole.detections.take(np.isin(whole.detections.image_id, images.image_id))
        return Dataset(**{**vars(whole), "images": images, "detections": detections, "truth_detections": None})

    def pinholes_of(self, version: Dataset) -> Pinholes:
        """Return what the detections of another version of these images see by their cameras alone."""
        return self._pinholes if see_the_same(version, self.dataset) else local_pinholes(version)

    @cached_property
    def _pinholes(self) -> Pinholes:
        return local_pinholes(self.dataset)

    def every(self, nth: int) -> Sample:
        """Return every so many of the places, with the same images in each."""
        row = np.flatnonzero(self.place_of_image % nth == 0)
        images, detections = self.dataset.images.take(row), self.dataset.detections
        part = {"images": images, "detections": detections.take(np.isin(detections.image_id, images.image_id))}
        return Sample(
            Dataset(**{**vars(self.dataset), **part}),
            self.place_of_image[row] // np.uint32(nth),
            self.image_row[row],
            self.whole,
        )

    @property
    def places(self) -> int:
        """How many there are."""
        return int(self.place_of_image.max(initial=0)) + 1 if len(self.place_of_image) else 0


def see_the_same(version: Dataset, dataset: Dataset) -> bool:
    """Return whether detections are the same by their cameras alone, in two versions of a dataset, whatever the poses.

    Tables are the same where nothing was put into their place: to compare their rows takes as long as to cast rays.
    """
    return (
        version.detections is dataset.detections
        and version.cameras is dataset.cameras
        and np.array_equal(version.images.camera_id, dataset.images.camera_id)
    )


def order_by_pass(images: Images, *, by_time: bool = True) -> Ints:
    """Return the rows of images pass by pass, in a pass by time, else by the numbers in their names."""
    if by_time and images.timestamp_s is not None and np.all(np.isfinite(images.timestamp_s)):
        return np.lexsort((np.arange(len(images)), images.timestamp_s, images.pass_id.codes)).astype(np.int64)
    return np.lexsort((_rank_of_names(images), images.pass_id.codes)).astype(np.int64)


def order_by_camera(images: Images, *, by_time: bool = True) -> Ints:
    """Return the rows of images pass by pass and there camera by camera, those of one camera in driving order."""
    order = order_by_pass(images, by_time=by_time)
    return order[np.lexsort((images.camera_id[order], images.pass_id.codes[order]))]


def drive_of_camera(images: Images) -> Ints:
    """Return a number (N) that images of one pass and camera share, and no others."""
    return number_rows(images.pass_id.codes, images.camera_id)


def number_rows(*columns: NDArray[np.integer]) -> Ints:
    """Return a number (N) for each row of columns (N), from 0 without gaps and in their order; equal rows share one.

    Several times as fast as `numpy.unique` of whole rows, which compares them field by field.
    """
    number = np.zeros(len(columns[0]), dtype=np.int64)
    for column in columns:
        _, code = np.unique(column, return_inverse=True)
        _, number = np.unique(number * (int(code.max(initial=0)) + 1) + code, return_inverse=True)
    return number.astype(np.int64)


def _rank_of_names(images: Images) -> Ints:
    """Return the place (N) of each name among all, where numbers count as numbers."""
    keys = [
        tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name))
        for name in images.name.to_pylist()
    ]
    rank = np.empty(len(keys), dtype=np.int64)
    rank[sorted(range(len(keys)), key=keys.__getitem__)] = np.arange(len(keys))
    return rank


def median_step_m(images: Images) -> float:
    """Return the median distance between successive images of a pass, those of a standing car left out."""
    order = order_by_pass(images)
    center = camera_centers(images)[order]
    step = np.linalg.norm(np.diff(center, axis=0), axis=1)[np.diff(images.pass_id.codes[order]) == 0]
    step = step[step > standing_m(step)]
    return float(np.median(step)) if len(step) else 1.0


def steps_along_drives(center: Floats, drive: Ints) -> tuple[Floats, Bools, float]:
    """Return the lengths of the steps between images (N) of drives in their order (N - 1), and which of these lead to
    another drive; and how long one is as a rule, infinite where nothing moves.
    """
    step_m, leaves = np.linalg.norm(np.diff(center, axis=0), axis=1), np.diff(drive) != 0
    moving = step_m[~leaves & (step_m > 0.0)]
    return step_m, leaves, float(np.median(moving)) if len(moving) else np.inf


def standing_m(step: Floats) -> float:
    """Return which steps (N) are none but errors of a standing car: far below those of nine in ten."""
    return _STANDING * float(np.quantile(step, 0.9)) if len(step) else 0.0


def sample_stretches(dataset: Dataset, *, most_detections: int = MOST_DETECTIONS) -> Sample:
    """Cut every pass into stretches and take as many, evenly spread, as give so many detections."""
    images = dataset.images
    order = order_by_pass(images)
    count = _detections_of_images(dataset)[order]
    target = _detections_of_a_place(len(dataset.detections), most_detections)
    stretch = np.empty(len(order), dtype=np.int64)
    number, seen, length = -1, 0, 0
    last_pass = -1
    for row, code in enumerate(images.pass_id.codes[order].tolist()):
        if code != last_pass or seen >= target or length >= _IMAGES_OF_A_STRETCH:
            number, seen, length, last_pass = number + 1, 0, 0, code
        stretch[row] = number
        seen += int(count[row])
        length += 1
    of_image = np.empty(len(order), dtype=np.int64)
    of_image[order] = stretch
    return _take_places(dataset, of_image, most_detections)


def sample_places(dataset: Dataset, *, most_detections: int = MOST_DETECTIONS, thins: bool = True) -> Sample:
    """Cut the ground into places by the positions of the images and take some, evenly spread.

    Of places with very many detections only part of the images is taken, unless `thins` is false.
    """
    radius = _PLACE_STEPS * median_step_m(dataset.images)
    place = _core.partition(np.ascontiguousarray(camera_centers(dataset.images)), radius).astype(np.int64)
    if thins:
        place = _thin_places(dataset, place, _MOST_IN_A_PLACE)
    return _take_places(dataset, place, most_detections)


def _detections_of_images(dataset: Dataset) -> Ints:
    rows = rows_of(dataset.detections.image_id, dataset.images.image_id)
    return np.bincount(rows, minlength=len(dataset.images))


def _detections_of_a_place(detections: int, most: int) -> int:
    low, high = _DETECTIONS_OF_A_PLACE
    return int(np.clip(min(detections, most) // (2 * _LEAST_PLACES), low, high))


def _thin_places(dataset: Dataset, place: Ints, most: int) -> Ints:
    """Take images out of places with more detections than that, evenly; -1 for those."""
    count = _detections_of_images(dataset)
    total = np.bincount(place, weights=count)
    order = np.lexsort((np.arange(len(place)), dataset.images.pass_id.codes, place))
    # In each place the running number of detections is cut into `most` equal parts; the first image of a part stays.
    before = np.cumsum(count[order]) - count[order]
    starts = np.flatnonzero(np.diff(place[order], prepend=-1))
    before = before - np.repeat(before[starts], np.diff(np.append(starts, len(order))))
    every = np.maximum(np.ceil(total / most), 1.0)[place[order]]
    part = np.floor(before / (every * np.maximum(count[order].mean(), 1.0)))
    stays = np.ones(len(order), dtype=np.bool_)
    stays[1:] = (np.diff(part) != 0) | (np.diff(place[order]) != 0)
    stays |= every <= 1.0
    thinned = place.copy()
    thinned[order[~stays]] = -1
    return thinned


def _take_places(dataset: Dataset, of_image: Ints, most_detections: int) -> Sample:
    """Take places (-1: none) with detections in two images or more, evenly spread, until there are enough."""
    count = _detections_of_images(dataset)
    inside = of_image >= 0
    places = int(of_image.max(initial=-1)) + 1
    with_some = np.bincount(of_image[inside & (count > 0)], minlength=places)
    total = np.bincount(of_image[inside], weights=count[inside], minlength=places)
    usable = np.flatnonzero(with_some >= 2)
    every = max(1.0, float(total[usable].sum()) / most_detections) if len(usable) else 1.0
    chosen = usable[np.unique(np.floor(np.arange(0.0, len(usable), every)).astype(np.int64))] if len(usable) else usable
    number = np.full(places + 1, -1, dtype=np.int64)
    number[chosen] = np.arange(len(chosen))
    place = number[of_image]
    image_row = np.flatnonzero(place >= 0)
    detection_image = rows_of(dataset.detections.image_id, dataset.images.image_id)
    detection_row = np.flatnonzero(place[detection_image] >= 0)
    part = Dataset(
        **{
            **vars(dataset),
            "images": dataset.images.take(image_row),
            "detections": dataset.detections.take(detection_row),
            "truth_detections": None,
        }
    )
    return Sample(part, place[image_row].astype(np.uint32), image_row, dataset)


def pixels_per_radian(dataset: Dataset) -> float:
    """Return the median over cameras of how many pixels a radian has in the middle of the picture."""
    from valuemap.cameras import lens_of

    scales = []
    for row in range(len(dataset.cameras)):
        camera = lens_of(dataset.cameras, row)
        middle = np.array([[camera.width / 2.0, camera.height / 2.0], [camera.width / 2.0 + 1.0, camera.height / 2.0]])
        ray = np.asarray(camera.cam_ray_from_img(middle))
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        angle = float(np.linalg.norm(ray[1] - ray[0]))
        if np.isfinite(angle) and angle > 0.0:
            scales.append(1.0 / angle)
    return float(np.median(scales)) if scales else 500.0
