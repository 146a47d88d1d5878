"""KML 2.2: the labels for Google Earth and the like."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from valuemap.writers.attributes import Export, needs_places, records
from valuemap.writers.xml import child, write_xml


def write_kml(export: Export, path: Path) -> None:
    """Write one placemark per label with all attributes, in a folder per class.

    Heights are ellipsoidal, but KML counts from the sea: placemarks stand on the ground, `height` is an attribute.

    Raises
    ------
    InputError
        The map is not geo-referenced.
    OutputError
        Another reference system is asked for.
    """
    places = needs_places(export, "KML")
    root = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = child(root, "Document")
    child(document, "name", export.result.run.get("dataset", "labels"))
    folders: dict[str, ElementTree.Element] = {}
    rows = records(export)
    for name in sorted({row["class"] for row in rows}):
        folders[name] = child(document, "Folder")
        child(folders[name], "name", name)
    for row, (lon, lat, _) in zip(rows, places.tolist(), strict=True):
        mark = child(folders[row["class"]], "Placemark", id=f"label-{row['label_id']}")
        child(mark, "name", f"{row['class']} {row['label_id']}")
        if "first_seen_time" in row:
            span = child(mark, "TimeSpan")
            child(span, "begin", row["first_seen_time"])
            child(span, "end", row["last_seen_time"])
        data = child(mark, "ExtendedData")
        for key, value in row.items():
            child(child(data, "Data", name=key), "value", value)
        child(child(mark, "Point"), "coordinates", f"{lon:.9f},{lat:.9f}")
    write_xml(root, path)
