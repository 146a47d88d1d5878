"""The images in an order of their own, by time, then place, by which all ties are broken."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints
from valuemap.arrow import take_texts
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.drives.names import NameParts
from valuemap.drives.runs import equal_to_next, numbered_by_first
from valuemap.tables import Images

MOST_CAMERAS = 16
"""More images of one camera and pass with one time than this are no rig: the time is a date, and tells no order."""


@dataclass(frozen=True, eq=False)
class Shots:
    """The images (N) by time, then place: `row` in the images table, and what tells them apart."""

    images: Images
    row: Ints
    center_m: Floats
    time_s: Floats
    given: Ints
    camera: Ints

    def __len__(self) -> int:
        return len(self.row)

    @classmethod
    def of(cls, images: Images) -> Shots:
        """Return images in an order that neither rows nor ids change."""
        center_m = camera_centers(images)
        time_s = np.full(len(images), np.nan) if images.timestamp_s is None else images.timestamp_s
        time_s = np.where(_is_a_date(images, time_s), np.nan, time_s)
        row = np.argsort(time_s, kind="stable")
        tie = equal_to_next(time_s[row])
        for key in (*center_m.T, *images.cam_from_world_quat.T):
            if not tie.any():
                break
            row, tie = _break_ties(row, tie, key)
        if tie.any():
            names = np.array(images.name.to_pylist())
            row, tie = _break_ties(row, tie, names)
        # Numbered by first appearance: neither names nor ids matter.
        is_timed = ~np.isnan(time_s[row])
        given = numbered_by_first(images.pass_id.codes[row].astype(np.int64) * 2 + is_timed)
        camera = numbered_by_first(images.camera_id[row])
        return cls(images, row, center_m.take(row, axis=0), time_s[row], given, camera)

    @cached_property
    def _parts_of_untimed(self) -> NameParts:
        return NameParts(self.names(np.flatnonzero(np.isnan(self.time_s))))

    def name_parts(self, shots: Ints) -> NameParts:
        """Return the names of some, cut into texts and numbers; those of all without a time are cut only once."""
        timed = ~np.isnan(self.time_s)
        if timed[shots].any():
            return NameParts(self.names(shots))
        return self._parts_of_untimed.take(shots - np.cumsum(timed)[shots])

    def names(self, shots: Ints) -> list[str]:
        """Return the names of some."""
        return list(take_texts(self.images.name, self.row[shots]).to_pylist())

    def cam_from_world(self, shots: Ints) -> Floats:
        """Return the rotations (N, 3, 3) of some."""
        return rotation_matrices(self.images.take(self.row[shots]))


def are_dates(images: Images) -> Bools:
    """Return the images (N) whose timestamps tell no order: of passes that have many images of a camera at one time."""
    if images.timestamp_s is None:
        return np.zeros(len(images), np.bool_)
    return _is_a_date(images, images.timestamp_s)


def _is_a_date(images: Images, time_s: Floats) -> Bools:
    """Return the images (N) of passes that have many images of one camera at one time."""
    order = np.argsort(time_s, kind="stable")
    ordered = time_s[order]
    same = np.concatenate([ordered[1:] == ordered[:-1], [False]])[: len(order)]  # What has no time shares none.
    if not same.any():
        return np.zeros(len(images), np.bool_)
    tied = order[same | np.concatenate([[False], same[:-1]])]
    pass_code, camera = images.pass_id.codes[tied].astype(np.int64), images.camera_id[tied]
    at_once = np.stack([pass_code, camera, np.unique(time_s[tied], return_inverse=True)[1]])
    groups, count = np.unique(at_once, axis=1, return_counts=True)
    dated = np.zeros(len(images.pass_id.names), np.bool_)
    dated[groups[0, count > MOST_CAMERAS]] = True
    return dated[images.pass_id.codes]


def _break_ties(row: Ints, tie: Bools, key: NDArray[Any]) -> tuple[Ints, Bools]:
    """Sort rows that tie with their neighbors by a further key (of all rows), and return what still ties."""
    group = np.concatenate([[0], np.cumsum(~tie)])
    place = np.flatnonzero(np.concatenate([tie, [False]]) | np.concatenate([[False], tie]))
    values = key[row[place]]
    if values.dtype.kind == "U":
        values = np.unique(values, return_inverse=True)[1]
    row = row.copy()
    row[place] = row[place][np.lexsort((values, group[place]))]
    tie = tie.copy()
    tied = np.flatnonzero(tie)
    tie[tied] = key[row[tied]] == key[row[tied + 1]]
    return row, tie
