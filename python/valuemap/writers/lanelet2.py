"""Lanelet2 as Autoware extends it: lights as lines along their lower edges, left to right as drivers see them."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.tables import Floats
from valuemap.writers.attributes import Export, needs_places, records
from valuemap.writers.sign_codes import find_sign, is_traffic_light
from valuemap.writers.xml import child, write_xml

_LEAST_WIDTH_M = 0.05
"""The end points of a line must differ."""


def write_lanelet2(export: Export, path: Path) -> None:
    """Write two nodes and a way per label: lights as `traffic_light`, all others as `traffic_sign`.

    Nodes carry `ele` (ellipsoidal height) and `local_x`, `local_y` (metres in the frame of the map). A way carries
    `height`, and for whoever merges it into a map of lanes `existence`, `sigma_m` and the label's id.

    Raises
    ------
    InputError
        The map is not geo-referenced.
    OutputError
        Another reference system is asked for.
    """
    needs_places(export, "Lanelet2")
    anchor = export.result.frame.anchor
    assert anchor is not None
    ends = lower_edges(export)
    ends_geographic = lon_lat_height_from_enu(ends.reshape(-1, 3), anchor).reshape(-1, 2, 3)
    root = ElementTree.Element("osm", version="0.6", generator="valuemap", upload="never")
    child(root, "MetaInfo", format_version="1", map_version="1")
    rows = records(export)
    for number in range(len(rows)):
        for end in (0, 1):
            lon, lat, height = ends_geographic[number, end].tolist()
            x, y, _ = ends[number, end].tolist()
            node = child(root, "node", id=2 * number + end + 1, version=1, visible="true", lat=lat, lon=lon)
            child(node, "tag", k="ele", v=f"{height:.4f}")
            child(node, "tag", k="local_x", v=f"{x:.4f}")
            child(node, "tag", k="local_y", v=f"{y:.4f}")
    for number, row in enumerate(rows):
        way = child(root, "way", id=2 * len(rows) + number + 1, version=1, visible="true")
        for end in (0, 1):
            child(way, "nd", ref=2 * number + end + 1)
        for key, value in _tags(row).items():
            child(way, "tag", k=key, v=value)
    write_xml(root, path)


def lower_edges(export: Export) -> Floats:
    """Return the ends (N, 2, 3) of the labels' lower edges in the map's frame: left, then right, as drivers see."""
    labels = export.result.labels
    east, north = export.result.frame.east_north()
    up = np.array(export.result.frame.up)
    azimuth = labels.facing_azimuth_rad
    # Who looks at it looks against its facing; to the right of that is facing turned a quarter counter-clockwise.
    right = np.outer(-np.cos(azimuth), east) + np.outer(np.sin(azimuth), north)
    half_m = np.maximum(labels.object_width_m, _LEAST_WIDTH_M)[:, None] / 2.0
    middle = labels.position_in_world_m - np.outer(labels.object_height_m / 2.0, up)
    return np.stack([middle - half_m * right, middle + half_m * right], axis=1)


def _tags(row: dict[str, object]) -> dict[str, str]:
    name = str(row["class"])
    if is_traffic_light(name):
        tags = {"type": "traffic_light", "subtype": "red_yellow_green"}
    else:
        found = find_sign(name)
        code = found[0].vienna or found[0].mapillary if found is not None else name
        tags = {"type": "traffic_sign", "subtype": code}
    if "object_height_m" in row:
        tags["height"] = f"{row['object_height_m']:.3f}"
    tags["sigma_m"] = f"{row['sigma_m']:.3f}"
    if "existence" in row:
        tags["existence"] = f"{row['existence']:.4f}"
    tags["valuemap:class"] = name
    tags["valuemap:label"] = str(row["label_id"])
    return tags
