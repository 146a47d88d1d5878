"""Which drives go on where the one before them ended: what few objects tell of a short one, the other tells.

A pass that comes back to where it was is cut into drives. Neither the error of its poses nor its camera changes there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from valuemap.arrays import Ints
from valuemap.drives import are_dates
from valuemap.refine.footage import Footage
from valuemap.refine.jumps import Segments
from valuemap.refine.residuals import DELAY, MOUNT, OFFSET, Observations

_FEW_OBJECTS = 8
"""A segment or drive that sees fewer shared objects than this is told by its neighbour."""
_PAUSE_S = 30.0


@dataclass(frozen=True, eq=False)
class Ties:
    """The segment (L) whose offset each segment has, and the drive (D) whose mounting and delay each drive has."""

    segment: Ints
    vehicle: Ints

    def spread(self, constants: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return arrays by kind with the rows of those that are tied as those they are tied to."""
        of = {OFFSET: self.segment, MOUNT: self.vehicle, DELAY: self.vehicle}
        return tuple(values[of[kind]] if kind in of else values for kind, values in enumerate(constants))


def tie(footage: Footage, segments: Segments, seen: Observations) -> Ties:
    """Tie drives that see little to the one of their pass that ends right before they begin, or begins right after."""
    segment, vehicle = np.arange(len(segments)), np.arange(footage.drives.count)
    images = footage.whole.images
    if images.timestamp_s is None:
        return Ties(segment, vehicle)
    # A date is that of many drives: it tells none of them that another one ended right before.
    timed = np.flatnonzero(np.isfinite(images.timestamp_s) & ~are_dates(images))
    drive, time_s = footage.whole_drives.pass_code, images.timestamp_s[timed]
    count = footage.drives.count
    begins, ends = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(begins, drive[timed], time_s)
    np.maximum.at(ends, drive[timed], time_s)
    pass_of = np.zeros(count, np.int64)
    pass_of[drive] = images.pass_id.codes
    objects = np.bincount(np.unique(np.stack([seen.drive, seen.thing]), axis=1)[0], minlength=count)
    of_drive = [np.flatnonzero(segments.drive == number) for number in range(count)]
    for number in np.argsort(begins, kind="stable").tolist():
        if objects[number] >= _FEW_OBJECTS:
            continue
        others = np.flatnonzero((pass_of == pass_of[number]) & (objects >= _FEW_OBJECTS))
        before = others[(begins[number] - ends[others] >= 0.0) & (begins[number] - ends[others] < _PAUSE_S)]
        after = others[(begins[others] - ends[number] >= 0.0) & (begins[others] - ends[number] < _PAUSE_S)]
        if len(before):
            other = int(before[np.argmax(ends[before])])
            segment[of_drive[number]] = of_drive[other][-1]
        elif len(after):
            other = int(after[np.argmin(begins[after])])
            segment[of_drive[number]] = of_drive[other][0]
        else:
            continue
        vehicle[number] = other
    return Ties(segment, vehicle)
