"""OSM XML: the labels as nodes for JOSM, offered as suggestions and marked never to be uploaded as they are."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from valuemap.writers.attributes import Export, needs_places, records
from valuemap.writers.sign_codes import osm_tags
from valuemap.writers.xml import child, write_xml

_TOLD_FACING = 0.5
"""A label that is seen from all sides faces nowhere: less concentrated than this it gets no direction."""


def write_osm(export: Export, path: Path) -> None:
    """Write one new node per label with the tags of its class, its direction and how sure and exact it is.

    Classes that the table of signs does not have get a tag of their own. `direction` is the azimuth that a label faces.

    Raises
    ------
    InputError
        The map is not geo-referenced.
    OutputError
        Another reference system is asked for.
    """
    places = needs_places(export, "OSM XML")
    root = ElementTree.Element("osm", version="0.6", generator="valuemap", upload="never")
    if len(places):
        (west, east), (south, north) = ((float(axis.min()), float(axis.max())) for axis in places.T[:2])
        child(root, "bounds", minlat=f"{south:.7f}", minlon=f"{west:.7f}", maxlat=f"{north:.7f}", maxlon=f"{east:.7f}")
    for number, (row, (lon, lat, _)) in enumerate(zip(records(export), places.tolist(), strict=True), start=1):
        node = child(root, "node", id=-number, lat=f"{lat:.9f}", lon=f"{lon:.9f}", visible="true")
        for key, value in suggested_tags(row).items():
            child(node, "tag", k=key, v=value)
    write_xml(root, path)


def suggested_tags(row: dict[str, object]) -> dict[str, str]:
    """Return the tags of OpenStreetMap for a label, and the evidence for whoever looks at the suggestion."""
    known = osm_tags(str(row["class"]))
    tags = dict(known) if known is not None else {"valuemap:class": str(row["class"])[:255]}
    if float(str(row["facing_concentration"])) >= _TOLD_FACING:
        tags["direction"] = f"{round(float(str(row['facing_deg']))) % 360}"
    tags["source"] = "valuemap"
    tags["valuemap:label"] = str(row["label_id"])
    tags["valuemap:sigma_m"] = f"{row['sigma_m']:.2f}"
    tags["valuemap:images"] = str(row["votes"])
    if "existence" in row:
        tags["valuemap:existence"] = f"{row['existence']:.4f}"
    if "last_seen_time" in row:
        tags["survey:date"] = str(row["last_seen_time"])[:10]
    return tags
