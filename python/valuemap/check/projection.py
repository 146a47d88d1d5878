"""Positions in a frame of their own that are those of a map projection: of one kind a metre is none."""

from __future__ import annotations

import math

import numpy as np

from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset

_LEAST_FROM_ORIGIN_M = 100_000.0
"""Drives begin near the origin of a frame of their own; projections count from a meridian and the equator, or from far
outside of their country."""
_MERCATOR_RADIUS_M = 6_378_137.0
"""Of the sphere that EPSG:3857 takes the Earth for."""


def note_projection(dataset: Dataset) -> str | None:
    """Return what to say of positions far from the origin of a frame of their own, None where there is nothing to say.

    Rays agree however large the unit is, and numbers alone do not tell one projection from another.
    """
    if dataset.frame.anchor is not None or not len(dataset.images):
        return None
    east, north = dataset.frame.east_north()
    center = camera_centers(dataset.images)
    x_m, y_m = float(np.median(center @ east)), float(np.median(center @ north))
    away_m = math.hypot(x_m, y_m)
    if away_m < _LEAST_FROM_ORIGIN_M:
        return None
    latitude_deg = math.degrees(math.atan(math.sinh(y_m / _MERCATOR_RADIUS_M)))
    return (
        f"The positions are {away_m / 1000.0:.0f} km from the origin of a frame of their own, as those of a map "
        "projection are. Import them with its code (--crs), and the map has its place on the Earth. Of Web Mercator "
        f"(EPSG:3857), which these may be, they are no metres: at latitude {latitude_deg:.1f} all distances and sizes "
        f"are {math.cosh(y_m / _MERCATOR_RADIUS_M):.2f} times as large as they are."
    )
