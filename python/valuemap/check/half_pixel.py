"""Pixels counted from the middle of the first one on one side, and from its corner on the other."""

from __future__ import annotations

from functools import partial
from typing import ClassVar

import numpy as np

from valuemap.check.fault import (
    Fault,
    Finding,
    Stage,
    View,
    with_detections,
)
from valuemap.check.lenses import focals, with_params
from valuemap.dataset import Dataset


class HalfPixel(Fault):
    """Pixels counted from the middle of the first one on one side, and from its corner on the other."""

    name: ClassVar[str] = "half_pixel"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look at where principal points are, and where boxes cut by the border of the picture end."""
        return _principal_points_at_integers(view) or _boxes_cut_aside(view)


def _principal_points_at_integers(view: View) -> Finding | None:
    cameras = view.dataset.cameras
    rows: list[int] = []
    middles = 0
    for row, params in enumerate(cameras.params):
        count = focals(cameras, row)
        if not count:
            continue
        off = 2.0 * params[count : count + 2] - [cameras.width_px[row], cameras.height_px[row]]
        if np.all(np.abs(off + 1.0) < 1e-6):
            rows.append(row)
        middles += int(np.all(np.abs(off) < 1e-6))
    if not rows or middles:
        return None
    first = cameras.params[rows[0]]
    count = focals(cameras, rows[0])
    return Finding(
        fault=HalfPixel.name,
        what="The principal points are half a pixel off: they count from the middle of the first pixel.",
        why=f"{len(rows)} of {len(cameras)} cameras have it at exactly (width - 1) / 2, (height - 1) / 2 "
        f"({first[count]:g}, {first[count + 1]:g} of {cameras.width_px[rows[0]]} x {cameras.height_px[rows[0]]}): "
        "the middle of a picture where pixel centres are whole numbers, as in OpenCV; here they are at halves.",
        do="Add 0.5 to cx and cy (and to box centres that were measured so).",
        figures={"cameras": len(rows)},
        fix=lambda dataset: _with_principal_points(dataset, rows, 0.5),
    )


def _with_principal_points(dataset: Dataset, rows: list[int], shift_px: float) -> Dataset:
    params = [values.copy() for values in dataset.cameras.params]
    for row in rows:
        count = focals(dataset.cameras, row)
        params[row][count : count + 2] += shift_px
    return with_params(dataset, params)


def _boxes_cut_aside(view: View) -> Finding | None:
    from valuemap.check.boxes import picture_sizes

    detections = view.dataset.detections
    low = detections.center_px - detections.size_px / 2.0
    high = picture_sizes(view.dataset) - detections.center_px - detections.size_px / 2.0
    for axis in (0, 1):
        first, last = float(low[:, axis].min()), float(high[:, axis].min())
        shift = (last - first) / 2.0
        at_first, at_last = (
            int((np.abs(side[:, axis] - end) < 1e-3).sum()) for side, end in ((low, first), (high, last))
        )
        # A border that boxes are cut at is cut at in both directions of the picture at the same number.
        at_other = (
            int((np.abs(low[:, 1 - axis] - first) < 1e-3).sum()) if abs(low[:, 1 - axis].min() - first) < 1e-3 else 0
        )
        if abs(abs(shift) - 0.5) < 1e-3 and min(at_first, at_last) >= 2 and at_first + at_other >= 3:
            return Finding(
                fault=HalfPixel.name,
                what="The boxes are half a pixel off: they count from the middle of the first pixel.",
                why=f"Boxes cut by the picture end at {first:g} px on one side ({at_first + at_other} boxes) and "
                f"{last:g} px before the other ({at_last} boxes): the picture they were cut by is {shift:+g} px off.",
                do=f"Add {shift:g} to x and y of the boxes.",
                figures={"shift_px": shift, "boxes": at_first + at_other + at_last},
                fix=partial(_with_boxes_moved, shift_px=shift),
            )
    return None


def _with_boxes_moved(dataset: Dataset, *, shift_px: float) -> Dataset:
    return with_detections(dataset, center_px=dataset.detections.center_px + shift_px)
