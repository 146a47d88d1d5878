"""Which camera of a car hangs where: those of two may be exchanged."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from valuemap.check.fault import Convention, Fix, with_images
from valuemap.dataset import Dataset
from valuemap.tables import Images, Ints


class CamerasExchanged(Convention):
    """Two cameras of a car taken for each other: each has the poses of the other."""

    name: ClassVar[str] = "cameras_exchanged"
    what: ClassVar[str] = "Two cameras of the car are taken for each other: each has the poses of the other."
    do: ClassVar[str] = "Give each camera its own place on the car (left for right, front for rear?)."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield the poses of each two cameras exchanged, where they expose together."""
        for first, second in itertools.combinations(np.unique(dataset.images.camera_id).tolist(), 2):
            if len(_together(dataset.images, first, second)[0]):
                yield f"poses of cameras {first} and {second} exchanged", _Exchanged(first, second)


class _Exchanged:
    """Gives the images of two cameras that expose together the pose of the other."""

    def __init__(self, first: int, second: int) -> None:
        self._first, self._second = first, second

    def __call__(self, dataset: Dataset) -> Dataset:
        images = dataset.images
        first, second = _together(images, self._first, self._second)
        row = np.arange(len(images))
        row[first], row[second] = second, first
        return with_images(
            dataset,
            cam_from_world_quat=images.cam_from_world_quat[row],
            cam_from_world_m=images.cam_from_world_m[row],
        )


def _together(images: Images, first: int, second: int) -> tuple[Ints, Ints]:
    """Return the rows (N) of images of one camera, and of another one that exposed with it (in the same pass).

    Two expose together if each is the nearest in time of the other's, and much nearer than the next of its own.
    """
    none = np.empty(0, dtype=np.int64)
    time = images.timestamp_s
    if time is None or not np.all(np.isfinite(time)):
        return none, none
    pairs = [(none, none)]
    for code in np.unique(images.pass_id.codes):
        rows = [np.flatnonzero((images.pass_id.codes == code) & (images.camera_id == each)) for each in (first, second)]
        if min(len(each) for each in rows) < 2:
            continue
        one, other = (each[np.argsort(time[each], kind="stable")] for each in rows)
        to, back = _nearest(time[one], time[other]), _nearest(time[other], time[one])
        mutual = back[to] == np.arange(len(one))
        step_s = min(float(np.median(np.diff(time[each]))) for each in (one, other))
        near = np.abs(time[other[to]] - time[one]) < step_s / 2.0
        pairs.append((one[mutual & near], other[to][mutual & near]))
    one, other = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return one, other


def _nearest(when: np.ndarray, others: np.ndarray) -> Ints:
    """Return the place in sorted times of the one nearest to each time."""
    after = np.clip(np.searchsorted(others, when), 1, len(others) - 1)
    return np.where(when - others[after - 1] <= others[after] - when, after - 1, after)
