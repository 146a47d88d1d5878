"""Poses that were written with too few digits: positions and headings on a grid."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from valuemap.arrays import Floats
from valuemap.check.fault import Fault, Finding, Stage, View
from valuemap.check.headings import headings
from valuemap.geodesy import lon_lat_height_from_enu

_LEAST_PLACES = 10
_ON_GRID = 0.02
_ROUNDED_STEPS = 0.1
"""Rounding to more than this share of the way from image to image is coarse."""
_DIGITS = (1, 2, 3, 4, 5, 6)
_UNITS_M = (1000.0, 100.0, 10.0, 1.0, 0.5, 0.1)
_STEPS_DEG = (45.0, 22.5, 10.0, 5.0, 2.0, 1.0)
"""Points of the compass, and round numbers; half a degree is within what rays agree by."""
_LEAST_IMAGES = 30
"""Of a camera: by chance one of 25 is on a grid."""


class RoundedPositions(Fault):
    """Latitudes and longitudes, or metres, with too few digits."""

    name: ClassVar[str] = "rounded_positions"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look for a number of digits that all positions keep to."""
        grid = _grid(view)
        if grid is None:
            return None
        said, step_m = grid
        if step_m <= _ROUNDED_STEPS * view.step_m:
            return None
        return Finding(
            fault=self.name,
            what="The positions of the images are rounded.",
            why=f"All of them are {said}: that is {step_m:.3g} m, and the images are {view.step_m:.3g} m apart.",
            do="Write all digits: seven decimals of a degree are a centimetre. "
            f"If there are none, give --set position_sigma_m={max(step_m / 3.46, 0.01):.2g}.",
            figures={"step_m": round(step_m, 4), "grid": said},
        )


class RoundedHeadings(Fault):
    """Headings in whole degrees, or coarser."""

    name: ClassVar[str] = "rounded_headings"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look for a step that the headings of each camera keep to, from one another: a mount may turn all of them."""
        images = view.dataset.images
        azimuth_deg = np.degrees(headings(view.dataset)[0])
        of_cameras = [azimuth_deg[images.camera_id == camera] for camera in np.unique(images.camera_id)]
        step_deg = next((step for step in _STEPS_DEG if all(_keep_to(each, step) for each in of_cameras)), None)
        if step_deg is None:
            return None
        return Finding(
            fault=self.name,
            what="The headings of the images are rounded.",
            why=f"All of them are multiples of {step_deg:g} degrees (from one another): they are off by up to "
            f"{step_deg / 2.0:g} degrees.",
            do="Write all digits: a tenth of a degree is 7 cm at 40 m. If there are none, give --set "
            f"rotation_sigma_deg={step_deg / math.sqrt(12.0):.2g}.",
            figures={"step_deg": step_deg},
        )


def _keep_to(azimuth_deg: Floats, step_deg: float) -> bool:
    """Return whether azimuths (N) are multiples of a step from one another, and of enough of them."""
    steps = (azimuth_deg - azimuth_deg[0]) / step_deg
    whole = np.round(steps)
    least = min(_LEAST_PLACES, 360.0 / step_deg)
    is_many = len(azimuth_deg) >= _LEAST_IMAGES and len(np.unique(whole % (360.0 / step_deg))) >= least
    return is_many and bool(np.all(np.abs(steps - whole) < _ON_GRID))


def _grid(view: View) -> tuple[str, float] | None:
    """Return in words on which grid all positions are, and its step in metres; None where on none."""
    center = view.center_in_world_m
    if len(np.unique(np.round(center, 3), axis=0)) < _LEAST_PLACES:
        return None
    if view.dataset.frame.anchor is not None:
        degrees = lon_lat_height_from_enu(center, view.dataset.frame.anchor)[:, :2]
        for digits in _DIGITS:
            if _are_multiples(degrees, 10.0**-digits):
                return f"multiples of {10.0**-digits:g} degrees", 111_000.0 * 10.0**-digits
    up = int(np.argmax(np.abs(view.dataset.frame.up)))
    level = np.delete(center, up, axis=1)
    for unit_m in _UNITS_M:
        if _are_multiples(level, unit_m):
            return f"multiples of {unit_m:g} m", unit_m
    return None


def _are_multiples(values: Floats, unit: float) -> bool:
    share = values / unit
    return bool(np.all(np.abs(share - np.round(share)) < _ON_GRID)) and bool(np.all(np.ptp(share, axis=0) >= 1.0))
