"""The anchor of a geo-referenced world: where on the Earth its origin is."""

from __future__ import annotations

from valuemap.errors import InputError

HIGHEST_M = 1e8


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
