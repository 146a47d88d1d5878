"""The anchor of a geo-referenced world: where on the Earth its origin is."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats
from valuemap.errors import InputError

HIGHEST_M = 1e8
_MANY_HEIGHTS, _SAME_HEIGHT_M = 10, 1e-6
"""A plain in the frame of the anchor is no such thing: it leaves the ellipsoid by more than this within 4 m."""
_HEIGHT_OF_NOTHING_M = 10.0
"""Zero, or the height of a camera above the street: what stands where no height is known."""


def is_place(lat: float, lon: float, height_m: float) -> bool:
    """Return whether there is such a latitude and longitude (degrees) and height (m)."""
    return abs(lat) <= 90.0 and abs(lon) <= 360.0 and abs(height_m) <= HIGHEST_M


def check_anchor(anchor: tuple[float, float, float]) -> None:
    """Refuse an anchor (latitude, longitude, height) that is no place on the Earth.

    Raises
    ------
    InputError
        A number is out of its range, or none.
    """
    lat, lon, height = (float(part) for part in anchor)
    if not is_place(lat, lon, height):
        raise InputError(
            f"anchor {lat:g} {lon:g} {height:g}: expected a latitude from -90 to 90 and a longitude, in degrees, and a "
            "height in metres",
            hint="the latitude comes first: for example 51.5 -0.14 35",
        )


def heights_not_given(height_m: Floats) -> str | None:
    """Say that all cameras are at one ellipsoidal height (N) near 0, as where the data has none: that of no street.

    One height far from 0, as of streets that were taken for level, is one that somebody knew.
    """
    if len(height_m) < _MANY_HEIGHTS or not np.ptp(height_m) < _SAME_HEIGHT_M:
        return None
    if abs(height_m[0]) > _HEIGHT_OF_NOTHING_M:
        return None
    level_m = round(float(height_m[0]), 2) + 0.0  # Rounding leaves a minus before a zero, and adding one takes it away.
    return (
        f"all cameras are at height {level_m:.2f} m, as where data states none (--camera-height): heights "
        "then count from the same level as theirs, not from the ellipsoid, and exports that name it have them wrong"
    )
