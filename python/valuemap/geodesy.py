"""Between a dataset's local frame (x east, y north, z up at an anchor), WGS84 and map projections, through PROJ.

The local frame is a plane that touches the ellipsoid at the anchor, so it is exact at any distance; what bends is the
Earth below it. Who knows a heading, or a pose relative to the horizon, at some other place must turn it by
`enu_axes_at`, and in a map projection by `true_axes_of_crs` too.
"""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np

from valuemap.anchor import check_anchor
from valuemap.arrays import Floats
from valuemap.errors import InputError, SettingError


def lon_lat_height_from_enu(position_in_world_m: Floats, anchor: tuple[float, float, float]) -> Floats:
    """Return longitude, latitude (degrees) and ellipsoidal height (m), (N, 3), of ENU positions (N, 3).

    `anchor` is latitude, longitude (degrees) and height (m) of the origin.
    """
    return _transform(position_in_world_m, anchor, inverse=True)


def enu_from_lon_lat_height(lon_lat_height: Floats, anchor: tuple[float, float, float]) -> Floats:
    """Return ENU positions (N, 3) in metres of longitude, latitude (degrees) and height (m), (N, 3)."""
    return _transform(lon_lat_height, anchor, inverse=False)


def enu_axes_at(lon_lat_height: Floats, anchor: tuple[float, float, float]) -> Floats:
    """Return rotations (N, 3, 3) from east, north, up at places (N, 3) into the frame of the anchor.

    Columns are the directions east, north and up there, from longitude and geodetic latitude.
    """
    lat, lon, _ = anchor
    at_anchor = _earth_from_enu(np.array([lon]), np.array([lat]))[0]
    axes: Floats = at_anchor.T @ _earth_from_enu(lon_lat_height[:, 0], lon_lat_height[:, 1])
    return axes


def lon_lat_height_from_crs(position: Floats, crs: str) -> Floats:
    """Return longitude, latitude (degrees) and ellipsoidal height (m), (N, 3), of coordinates in a reference system.

    Parameters
    ----------
    position
        Easting (or longitude), northing (or latitude) and height (N, 3), whatever the order of the system's own axes.
    crs
        What pyproj knows, such as `EPSG:32610`. Heights of a system without a vertical axis are those above the
        ellipsoid of WGS84.

    Raises
    ------
    SettingError
        There is no such system, or PROJ lacks the grid that its heights need.
    InputError
        A place is outside where the system is defined.
    """
    lon, lat, height = _to_wgs84(crs).transform(*position.T)
    found = np.stack([lon, lat, height], axis=1)
    if not np.all(np.isfinite(found)):
        row = int(np.flatnonzero(~np.isfinite(found).all(axis=1))[0])
        raise InputError(
            f"crs {crs}: {position[row].tolist()} is no place in it",
            hint="are x and y easting and northing in its unit?",
        )
    return found


def degrees_outside(lon_lat_height: Floats, crs: str) -> Floats | None:
    """Return how many degrees places (N, 3) are outside of the area that a system is made for, 0 inside.

    These are degrees of longitude or latitude, whichever are more. None where the area is not known.
    """
    system = _system(crs)
    area = (system.sub_crs_list[0] if system.is_compound else system).area_of_use
    if area is None:
        return None
    west, south, east, north = area.bounds
    lon, lat, _ = lon_lat_height.T
    width = (east - west) % 360.0 or 360.0  # West of the date line longitudes go on with the negative ones.
    beyond_east = (lon - west) % 360.0 - width
    beside = np.minimum(beyond_east, 360.0 - width - beyond_east)
    outside: Floats = np.max([beside, south - lat, lat - north, np.zeros(len(lat))], axis=0)
    return outside


def is_geographic(crs: str) -> bool:
    """Say whether coordinates in a system are longitude and latitude."""
    return bool(_system(crs).is_geographic)


def crs_from_lon_lat_height(lon_lat_height: Floats, crs: str) -> Floats:
    """Return coordinates in a reference system: easting (or longitude), northing (or latitude) and height (N, 3).

    Raises
    ------
    SettingError
        There is no such system, or PROJ lacks the grid that it needs.
    InputError
        A place is outside where the system is defined.
    """
    found = np.stack(_to_wgs84(crs).transform(*lon_lat_height.T, direction="INVERSE"), axis=1)
    if not np.all(np.isfinite(found)):
        row = int(np.flatnonzero(~np.isfinite(found).all(axis=1))[0])
        raise InputError(
            f"crs {crs}: longitude, latitude, height {lon_lat_height[row].tolist()} has no place in it",
            hint="choose a system that is made for this part of the Earth",
        )
    return found


def with_heights(crs: str | None, vertical: str | None) -> tuple[str | None, float]:
    """Return a reference system with the heights of a vertical one, and how far their zero is above its own.

    Parameters
    ----------
    crs
        The horizontal system; None for longitude and latitude in WGS84.
    vertical
        A vertical system that pyproj knows, such as `EPSG:5773` (EGM96), or in metres how far the zero of the heights
        (the sea level) lies above the ellipsoid; None for the heights of `crs`.

    Raises
    ------
    SettingError
        There is no such vertical system, PROJ lacks the grid that it needs, or `crs` has heights of its own.
    """
    if vertical is None:
        return crs, 0.0
    from pyproj.crs import CompoundCRS
    from pyproj.exceptions import ProjError

    try:
        zero_m = float(vertical)
    except ValueError:
        zero_m = 0.0
    else:
        # EPSG codes are no heights of the sea above the ellipsoid, which are between -110 and 90 m.
        if not abs(zero_m) <= _GREATEST_UNDULATION_M:
            raise SettingError(
                f"vertical {vertical}: expected at most {_GREATEST_UNDULATION_M:g} m, or a system such as EPSG:5773",
                hint="metres say how far the zero of the heights lies above the ellipsoid of WGS84",
            )
        _refuse_own_heights(crs, vertical)
        return crs or "EPSG:4326", zero_m
    _refuse_own_heights(crs, vertical)
    try:
        below, above = _system(crs or "EPSG:4326"), _system(vertical)
        if not _is_of_heights(above):
            raise SettingError(
                f"vertical {vertical}: {above.name} is no vertical system", hint="for example EPSG:5773, which is EGM96"
            )
        system = CompoundCRS(f"{below.name} + {above.name}", [below, above]).to_string()
    except ProjError as error:
        reason = _reason(error)
        raise SettingError(
            f"vertical {vertical}: there is no such system: {reason}", hint="for example EPSG:5773, or metres: 47.2"
        ) from error
    try:
        _transformer(system)
    except ProjError as error:
        raise SettingError(
            f"vertical {vertical}: its heights cannot be brought to the ellipsoid: {_reason(error)}",
            hint="projsync or PROJ_NETWORK=ON gets a grid that PROJ lacks; or give --vertical in metres, how far the "
            "sea level lies above the ellipsoid of WGS84",
        ) from error
    return system, 0.0


_GREATEST_UNDULATION_M = 150.0
_LONGEST_CODE = 40


def _refuse_own_heights(crs: str | None, vertical: str) -> None:
    system = None if crs is None else _known_system(crs)
    if system is not None and len(system.axis_info) == 3:
        raise SettingError(
            f"vertical {vertical}: {crs} has heights of its own",
            hint=f"leave --vertical away, or give --crs {_horizontal(system)} with it",
        )


def _known_system(crs: str) -> Any:
    """Return a system of places on the Earth, refused where there is none or it is one of heights only."""
    from pyproj.exceptions import ProjError

    try:
        system = _system(crs)
    except ProjError as error:
        reason = _reason(error)
        raise SettingError(f"crs {crs!r}: there is no such system: {reason}", hint="for example EPSG:32610") from error
    if _is_of_heights(system):
        raise SettingError(
            f"crs {crs}: {system.name} is a vertical system",
            hint="give it as --vertical, and a horizontal system as --crs",
        )
    return system


def _is_of_heights(system: Any) -> bool:
    """Say whether a system is of heights only; those that have them beside places are vertical to pyproj too."""
    return bool(system.is_vertical) and not system.is_compound


def _horizontal(system: Any) -> str:
    """Return the code, or else the name, of a system without its heights."""
    flat = system.to_2d()
    if len(flat.axis_info) == 3:
        return "EPSG:4326"  # Coordinates from the centre of the Earth have no heights to take away.
    authority = flat.to_authority()
    return flat.name if authority is None else ":".join(authority)


def check_crs(crs: str) -> None:
    """Refuse a reference system that there is not, or that PROJ cannot bring to WGS84.

    Raises
    ------
    SettingError
        It is so.
    """
    _to_wgs84(crs)


def accuracy_note(crs: str) -> str | None:
    """Return what to tell about positions in a reference system that PROJ could reach more exactly with a grid.

    None where there is nothing to tell; raises as `crs_from_lon_lat_height` where there is no such system.
    """
    from pyproj.transformer import TransformerGroup

    _to_wgs84(crs)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Best transformation is not available")
        ways = TransformerGroup(_system(crs), "EPSG:4326", always_xy=True, allow_ballpark=False)
    if ways.best_available or not ways.transformers:
        return None
    name = crs if len(crs) < _LONGEST_CODE else _system(crs).name  # Files may have a system in many lines.
    return (
        f"{name}: positions are good to {ways.transformers[0].accuracy:g} m, as PROJ lacks a grid for it; "
        "projsync or PROJ_NETWORK=ON gets it"
    )


def true_axes_of_crs(position: Floats, crs: str) -> Floats:
    """Return rotations (N, 3, 3) from the axes of a map's grid into east, north, up at coordinates (N, 3) in it.

    Grid north differs from north by the convergence, 3 degrees at the edge of a UTM zone at 60 degrees of latitude.

    Raises
    ------
    SettingError
        The system counts to the west, as those of southern Africa do: what north and a heading are in it nobody knows.
    """
    transformer = _to_wgs84(crs)
    directions = [axis.direction for axis in _system(crs).axis_info]
    if "west" in directions:
        raise SettingError(
            f"crs {crs}: expected a system of eastings and northings, found axes to the {' and '.join(directions[:2])}",
            hint="bring the positions into another one first, such as UTM",
        )
    step = 1e-5 if transformer.source_crs is not None and transformer.source_crs.is_geographic else 1.0
    north = np.zeros_like(position)
    north[:, 1] = step
    ends = [np.stack(transformer.transform(*(position + sign * north).T), axis=1) for sign in (-1.0, 1.0)]
    lon_rad, lat_rad = (np.radians(ends[1][:, axis] - ends[0][:, axis]) for axis in (0, 1))
    middle_rad = np.radians((ends[0][:, 1] + ends[1][:, 1]) / 2.0)
    # A degree of longitude is shorter than one of latitude by the cosine, and by the shape of the ellipsoid.
    flatness = 6.69437999014e-3
    east = np.cos(middle_rad) * lon_rad
    along = lat_rad * (1.0 - flatness) / (1.0 - flatness * np.sin(middle_rad) ** 2)
    azimuth_rad = np.arctan2(east, along)
    sine, cosine, zero, one = np.sin(azimuth_rad), np.cos(azimuth_rad), np.zeros(len(east)), np.ones(len(east))
    rows = [[cosine, sine, zero], [-sine, cosine, zero], [zero, zero, one]]
    return np.array(rows).transpose(2, 0, 1)


def _reason(error: Exception) -> str:
    """Return what PROJ says in one line, of a grid that it lacks only its name."""
    text = " ".join(str(error).split())
    lacking = re.search(r"Grid \S+ is not available", text)
    return lacking.group() if lacking else text[:200]


def _transformer(crs: str) -> Any:
    from pyproj import Transformer

    system = _system(crs)
    # Without a vertical axis heights stay those of WGS84: those of other ellipsoids differ by up to 100 m and more.
    target = "EPSG:4979" if len(system.axis_info) == 3 else "EPSG:4326"
    return Transformer.from_crs(system, target, always_xy=True, only_best=True, allow_ballpark=False)


def _to_wgs84(crs: str) -> Any:
    from pyproj.exceptions import ProjError

    system = _known_system(crs)
    try:
        return _transformer(crs)
    except ProjError as error:
        hint = "give a code such as EPSG:32610, or 4979"
        if len(system.axis_info) == 3:
            hint = (
                "heights above the sea need a grid that PROJ must have (projsync gets it); or give --crs "
                f"{_horizontal(system)} and --vertical with the metres of the sea level above the ellipsoid"
            )
        raise SettingError(f"crs {crs!r}: cannot be brought to WGS84: {_reason(error)}", hint=hint) from error


def _system(crs: str) -> Any:
    from pyproj import CRS

    return CRS.from_user_input(int(crs) if crs.isdecimal() else crs)


def _earth_from_enu(lon_deg: Floats, lat_deg: Floats) -> Floats:
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    zero = np.zeros(len(lon))
    east = np.stack([-np.sin(lon), np.cos(lon), zero], axis=1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=1)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    return np.stack([east, north, up], axis=2)


def _transform(points: Floats, anchor: tuple[float, float, float], *, inverse: bool) -> Floats:
    from pyproj import Transformer  # Slow to import, and only geo-referenced data needs it.

    check_anchor(anchor)
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
