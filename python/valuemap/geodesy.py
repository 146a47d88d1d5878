"""Between a dataset's local frame (x east, y north, z up at an anchor) and WGS84, through PROJ."""

from __future__ import annotations

import numpy as np

from valuemap.errors import InputError
from valuemap.tables import Floats


def lon_lat_height_from_enu(position_in_world_m: Floats, anchor: tuple[float, float, float]) -> Floats:
    """Return longitude, latitude (degrees) and ellipsoidal height (m), (N, 3), of ENU positions (N, 3).

    `anchor` is latitude, longitude (degrees) and height (m) of the origin.
    """
    return _transform(position_in_world_m, anchor, inverse=True)


def enu_from_lon_lat_height(lon_lat_height: Floats, anchor: tuple[float, float, float]) -> Floats:
    """Return ENU positions (N, 3) in metres of longitude, latitude (degrees) and height (m), (N, 3)."""
    return _transform(lon_lat_height, anchor, inverse=False)


def _transform(points: Floats, anchor: tuple[float, float, float], *, inverse: bool) -> Floats:
    from pyproj import Transformer  # Slow to import, and only geo-referenced data needs it.

    lat, lon, height = (float(part) for part in anchor)
    enu_from_geographic = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={height!r}"
    )
    direction = "INVERSE" if inverse else "FORWARD"
    first, second, third = points.T
    transformed = np.stack(enu_from_geographic.transform(first, second, third, direction=direction), axis=1)
    if not np.all(np.isfinite(transformed)):
        raise InputError(
            f"anchor {lat} {lon} {height}: a position has no place on the ellipsoid relative to it",
            hint="is the frame metric, x east, y north, z up, with the anchor as its origin?",
        )
    return transformed
