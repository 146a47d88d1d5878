"""ASAM OpenDRIVE 1.8: the labels as signals with their places in space, sizes, facing and data quality."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from valuemap.arrays import Floats
from valuemap.geodesy import crs_from_lon_lat_height
from valuemap.writers.attributes import Export, records, refuse_crs
from valuemap.writers.sign_codes import find_sign, is_traffic_light
from valuemap.writers.xml import child, write_xml

_LEAST_ROAD_M = 1.0
_SIGNAL_TRAFFIC_LIGHT = "1000001"
"""What the signal catalogue of OpenDRIVE calls a traffic light of three colours."""


def write_opendrive(export: Export, path: Path) -> None:
    """Write one signal per label, at its inertial position, with a road that only carries them.

    A map holds no roads, and OpenDRIVE wants signals on one: a straight line from the westernmost to the easternmost
    label, longer where others lie beyond its ends, and named so. Who merges the signals into a road network uses
    `positionInertial` and works out s and t anew.
    Coordinates are metres: of a transverse Mercator projection at the anchor, which `geoReference` names, or where the
    map is not geo-referenced in its own frame, z up. `dataQuality` is filled from the covariances, in the world and
    against the labels around: one standard deviation on the ground (root of the sum of squares) and of the height.

    Raises
    ------
    OutputError
        Another reference system is asked for.
    """
    refuse_crs(export, "OpenDRIVE holds metres of a projection at the anchor")
    points, projection = _coordinates(export)
    root = ElementTree.Element("OpenDRIVE")
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    header = child(
        root,
        "header",
        revMajor="1",
        revMinor="8",
        name=export.result.run.get("dataset", "labels"),
        version="1",
        vendor="valuemap",
        west=f"{low[0]:.4f}",
        east=f"{high[0]:.4f}",
        south=f"{low[1]:.4f}",
        north=f"{high[1]:.4f}",
    )
    if projection is not None:
        child(header, "geoReference", projection)
    start, heading, length_m, s_t = _road(points)
    road = child(
        root, "road", name="carries signals, is no road", id="0", junction="-1", length=f"{length_m:.4f}", rule="RHT"
    )
    line = child(
        child(road, "planView"),
        "geometry",
        s="0",
        x=f"{start[0]:.4f}",
        y=f"{start[1]:.4f}",
        hdg=f"{heading:.10f}",
        length=f"{length_m:.4f}",
    )
    child(line, "line")
    section = child(child(road, "lanes"), "laneSection", s="0")
    child(child(section, "center"), "lane", id="0", type="none", level="false")
    _border(section)
    signals = child(road, "signals")
    relative = export.ellipses_among_labels
    relative_m = np.column_stack([np.hypot(relative.major_m, relative.minor_m), relative.height_m])
    for row, point, sigmas_m, place in zip(records(export), points, relative_m, s_t, strict=True):
        _signal(signals, row, point, sigmas_m, place, heading)
    write_xml(root, path)


def _border(section: ElementTree.Element) -> None:
    """Add a lane without width: every section must have one."""
    lane = child(child(section, "right"), "lane", id="-1", type="none", level="false")
    child(lane, "width", sOffset="0", a="0", b="0", c="0", d="0")


def _coordinates(export: Export) -> tuple[Floats, str | None]:
    """Return x, y, z (N, 3) in metres and the PROJ text of their projection, if there is one."""
    frame, labels = export.result.frame, export.result.labels
    if labels.lon_lat_height is None or frame.anchor is None:
        return export.on_the_ground(labels.position_in_world_m), None
    lat, lon, _ = frame.anchor
    projection = f"+proj=tmerc +lat_0={lat!r} +lon_0={lon!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    return crs_from_lon_lat_height(labels.lon_lat_height, f"{projection} +type=crs"), f"{projection} +vunits=m"


def _road(points: Floats) -> tuple[Floats, float, float, Floats]:
    """Return start (2), heading (rad from x) and length (m) of a line past all labels, and their s and t (N, 2), m."""
    if not len(points):
        return np.zeros(2), 0.0, _LEAST_ROAD_M, np.empty((0, 2))
    order = np.lexsort((points[:, 1], points[:, 0]))
    start, end = points[order[0], :2], points[order[-1], :2]
    east_m, north_m = end - start
    heading = math.atan2(north_m, east_m) if math.hypot(east_m, north_m) >= _LEAST_ROAD_M else 0.0
    along = np.array([math.cos(heading), math.sin(heading)])
    s_t = (points[:, :2] - start) @ np.column_stack([along, [-along[1], along[0]]])
    first_m = float(s_t[:, 0].min())
    s_t[:, 0] -= first_m
    return start + first_m * along, heading, max(float(s_t[:, 0].max()), _LEAST_ROAD_M), s_t


def _signal(
    signals: ElementTree.Element,
    row: dict[str, object],
    point: Floats,
    relative_m: Floats,
    s_t: Floats,
    road_heading: float,
) -> None:
    name, height_m = str(row["class"]), float(str(row.get("object_height_m", 0.0)))
    is_light = is_traffic_light(name)
    found = find_sign(name)
    code = None if found is None else found[0].vienna or found[0].mapillary
    number = None if found is None else found[1]
    x, y, z = point.tolist()
    # From x, counter-clockwise: where those drive whom it faces. A sign that is not turned (`hOffset` 0) is for traffic
    # along its road, and so looks back.
    heading = -math.pi / 2.0 - math.radians(float(str(row["facing_deg"])))
    signal = child(
        signals,
        "signal",
        id=row["label_id"],
        name=name,
        s=f"{s_t[0]:.4f}",
        t=f"{s_t[1]:.4f}",
        zOffset=f"{z - height_m / 2.0:.4f}",
        dynamic="yes" if is_light else "no",
        orientation="none",
        country="OpenDRIVE" if is_light else None,
        type=_SIGNAL_TRAFFIC_LIGHT if is_light else code or "-1",
        subtype="-1",
        height=f"{height_m:.3f}" if "object_height_m" in row else None,
        width=f"{row['object_width_m']:.3f}" if "object_width_m" in row else None,
        hOffset=f"{_turn(heading - road_heading):.6f}",
    )
    if number is not None:
        signal.set("text", number)  # A value must have a unit, and a class does not say whether km/h or mph.
    child(
        signal,
        "positionInertial",
        x=f"{x:.4f}",
        y=f"{y:.4f}",
        z=f"{z - height_m / 2.0:.4f}",
        hdg=f"{_turn(heading):.6f}",
        pitch="0",
        roll="0",
    )
    _say_how_good(signal, row, relative_m)


def _say_how_good(signal: ElementTree.Element, row: dict[str, object], relative_m: Floats) -> None:
    """Add how wrong its place may be, in the world and against the labels around (2), m, and what it rests on."""
    quality = child(signal, "dataQuality")
    child(
        quality,
        "error",
        xyAbsolute=f"{row['sigma_m']:.4f}",
        zAbsolute=f"{row['sigma_height_m']:.4f}",
        xyRelative=f"{relative_m[0]:.4f}",
        zRelative=f"{relative_m[1]:.4f}",
    )
    child(
        quality,
        "rawData",
        date=row.get("last_seen_time", "unknown"),
        source="sensor",
        postProcessing="fused",
        postProcessingComment=f"valuemap, {row['votes']} images of {row['passes']} passes",
    )
    for key in ("existence", "max_parallax_rad", "reprojection_rms_px"):
        if key in row:
            child(signal, "userData", code=key, value=row[key])


def _turn(angle: float) -> float:
    """Return an angle between -pi and pi."""
    return math.remainder(angle, 2.0 * math.pi)
