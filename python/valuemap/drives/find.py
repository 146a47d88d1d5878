"""The drives of images: their ways in driving order, cut into drives, and the viewpoints along these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints, bounds
from valuemap.drives.cuts import Steps, Usual, find_cuts, usual_steps
from valuemap.drives.order import TOLD_BY, order_exposures
from valuemap.drives.rigs import find_vehicles
from valuemap.drives.runs import begins_of_runs, rows_since
from valuemap.drives.shots import Shots
from valuemap.drives.way import way_from_place_to_place
from valuemap.tables import Images


@dataclass(frozen=True, eq=False)
class Drives:
    """The drives, for each image (N) in the order of the images table.

    `pass_code` numbers the drives from 0 by their first time, then first place; `order` is the place of the image's
    exposure within its drive, from 0, the same for all images of one exposure of a rig; `driven_m` is how far the
    drive had come where its viewpoint began; `viewpoint` numbers the viewpoints of all drives, along the drives.
    `record` says in numbers what was found, for `valuemap info` and `run.json`: `passes` given, `drives` made of
    them, `cut_at` (why there are more), `images_ordered_by` (how the order was told), `rigs` and `images_on_rigs`.
    """

    pass_code: Ints
    order: Ints
    driven_m: Floats
    viewpoint: Ints
    record: dict[str, Any]

    @property
    def count(self) -> int:
        """The number of drives."""
        return int(self.pass_code.max(initial=-1)) + 1

    def take(self, rows: Ints | Bools) -> Drives:
        """Return what some images have, by their rows or by a mask; drives and viewpoints keep their numbers."""
        return Drives(self.pass_code[rows], self.order[rows], self.driven_m[rows], self.viewpoint[rows], self.record)


def find_drives(images: Images, *, viewpoint_step_m: float = 1.0) -> Drives:
    """Tell which images are one drive and in which order they were taken.

    It never fails: images without any order become short drives from one to the nearest next. The result depends
    on times, poses, numbers in names, and on which images share a pass or a camera, but not on row order, nor on
    the values of ids, nor on the names of passes.

    Parameters
    ----------
    images
        The images of a dataset.
    viewpoint_step_m
        A new viewpoint begins where the camera has moved more than this since the last one began.
    """
    ways = Ways(images)
    return ways.drives(ways.usual, viewpoint_step_m=viewpoint_step_m)[0]


class Ways:
    """The ways of vehicles: their images in driving order, not yet cut into drives.

    Of a dataset larger than memory these are the ways of some vehicles; what is `usual` among all of them then says how
    they are cut.
    """

    def __init__(self, images: Images) -> None:
        self._shots = shots = Shots.of(images)
        vehicle, exposure, self._rigs = find_vehicles(shots)
        self._first = first = np.flatnonzero(exposure == np.arange(len(exposure)))
        self._exposure_of_shot = (np.cumsum(exposure == np.arange(len(exposure))) - 1)[exposure]
        self._track = track = order_exposures(shots, vehicle[first], first, self._exposure_of_shot)
        self._place_m = shots.center_m.take(first[track.exposure], axis=0)
        self._steps = Steps.of(self._place_m, track.group, track.taken)
        low_m, high_m = bounds(self._place_m)
        step_m, speed, taken = usual_steps(self._steps, self._place_m, track, shots.camera[first[track.exposure]])
        self.usual = Usual(step_m, speed, taken, low_m, high_m)

    def drives(self, usual: Usual, *, viewpoint_step_m: float = 1.0) -> tuple[Drives, Ints]:
        """Cut the ways where something unusual happens; return the drives, and the first image (row) of each."""
        shots, first, track, place_m = self._shots, self._first, self._track, self._place_m
        cut = find_cuts(place_m, track, self._steps, self.usual, usual)
        drive = np.cumsum(cut.any_of) - 1

        # Numbered by first time, then place, which is what the order of the shots is.
        starts = np.flatnonzero(cut.any_of)
        rank = np.empty(len(starts), np.int64)
        earliest = np.minimum.reduceat(first[track.exposure], starts) if len(starts) else starts
        rank[np.argsort(earliest, kind="stable")] = np.arange(len(starts))
        along = np.argsort(rank[drive], kind="stable")
        drive, place_m, exposure_along = rank[drive][along], place_m.take(along, axis=0), track.exposure[along]
        begins = begins_of_runs(drive)
        order = rows_since(begins)
        opens = _core.viewpoint_openings(place_m, begins, viewpoint_step_m)
        driven_m = way_from_place_to_place(place_m, begins, opens)

        position = np.empty(len(first), np.int64)
        position[exposure_along] = np.arange(len(first))
        of_row = np.empty(len(shots), np.int64)
        of_row[shots.row] = position[self._exposure_of_shot]
        told_by = np.empty(len(first), np.int64)
        told_by[track.exposure] = track.told_by
        told = np.bincount(told_by[self._exposure_of_shot], minlength=3)
        record = {
            "passes": int(np.count_nonzero(np.bincount(shots.images.pass_id.codes))),
            "drives": len(starts),
            "cut_at": cut.counts,
            "images_ordered_by": {name: int(n) for name, n in zip(TOLD_BY, told, strict=True) if n},
            "rigs": self._rigs,
            "images_on_rigs": int(np.sum(np.bincount(self._exposure_of_shot)[self._exposure_of_shot] > 1)),
        }
        drives = Drives(drive[of_row], order[of_row], driven_m[of_row], (np.cumsum(opens) - 1)[of_row], record)
        return drives, shots.row[np.sort(earliest)]
