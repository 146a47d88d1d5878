"""Lanelet2 as Autoware extends it: lights as lines along their lower edges, left to right as drivers see them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from valuemap.arrays import Floats
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.writers.attributes import Export, needs_places, records
from valuemap.writers.sign_codes import find_sign, is_for_pedestrians, is_traffic_light
from valuemap.writers.xml import child, write_xml

_LEAST_WIDTH_M = 0.05
"""The end points of a line must differ."""


_FIRST_ID = 1_000_000_000
"""Maps of lanes count from 1: a merged map must not have an id twice. Messages of Autoware hold ids of 31 bits."""


def write_lanelet2(export: Export, path: Path) -> None:
    """Write two nodes and a way per label: lights as `traffic_light`, all others as `traffic_sign`.

    Nodes have latitude, longitude and `ele` (ellipsoidal height). Where the map is not geo-referenced they have
    `local_x`, `local_y` and `ele` in metres in its frame, z up, and latitude and longitude are 0, as Autoware has it:
    it takes these tags for the truth wherever there are any. A way carries `height`, and for whoever merges it into a
    map of lanes `existence`, `sigma_m` and the label's id. The ids go with those of the labels.

    Raises
    ------
    InputError
        A reference system is asked for, and the map is not geo-referenced.
    OutputError
        Another reference system is asked for.
    """
    ends = lower_edges(export)
    root = ElementTree.Element("osm", version="0.6", generator="valuemap", upload="never")
    child(root, "MetaInfo", format_version="1", map_version="1")
    rows = records(export)
    first_id = [_FIRST_ID + 3 * int(row["label_id"]) for row in rows]
    for number, (place, tags) in enumerate(_nodes(export, ends.reshape(-1, 3))):
        identity = first_id[number // 2] + number % 2
        node = child(root, "node", id=identity, version=1, visible="true", **place)
        for key, value in tags.items():
            child(node, "tag", k=key, v=f"{value:.4f}")
    for identity, row in zip(first_id, rows, strict=True):
        way = child(root, "way", id=identity + 2, version=1, visible="true")
        for end in (0, 1):
            child(way, "nd", ref=identity + end)
        for key, text in _tags(row).items():
            child(way, "tag", k=key, v=text)
    write_xml(root, path)


def _nodes(export: Export, position_in_world_m: Floats) -> Iterator[tuple[dict[str, float], dict[str, float]]]:
    """Yield latitude and longitude, and the tags, of positions (N, 3)."""
    anchor = export.result.frame.anchor
    if anchor is None:
        for x, y, z in export.on_the_ground(position_in_world_m).tolist():
            yield {"lat": 0.0, "lon": 0.0}, {"ele": z, "local_x": x, "local_y": y}
        return
    needs_places(export, "Lanelet2")
    for lon, lat, height in lon_lat_height_from_enu(position_in_world_m, anchor).tolist():
        yield {"lat": lat, "lon": lon}, {"ele": height}


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
        tags = {"type": "traffic_light", "subtype": "red_green" if is_for_pedestrians(name) else "red_yellow_green"}
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
