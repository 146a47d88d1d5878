"""MapRoulette: a challenge of one task per label, for people to look at one after the other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from valuemap.writers.attributes import Export, needs_places, records
from valuemap.writers.osm import suggested_tags

_RECORD_SEPARATOR = "\x1e"
"""Begins each line (RFC 7464), so that a cut file is noticed."""


def write_maproulette(export: Export, path: Path) -> None:
    """Write one line per label: a collection of one point with all attributes and the suggested tags.

    The property `id` stays the same when a map is made anew from the same labels, so that rebuilding a challenge does
    not bring back tasks that are done.

    Raises
    ------
    InputError
        The map is not geo-referenced.
    OutputError
        Another reference system is asked for.
    """
    places = needs_places(export, "MapRoulette")
    lines = []
    for row, place in zip(records(export), places.tolist(), strict=True):
        properties: dict[str, Any] = {"id": f"valuemap-{row['label_id']}", **row}
        properties["suggested_tags"] = "\n".join(f"{key}={value}" for key, value in suggested_tags(row).items())
        point = {"type": "Point", "coordinates": [round(part, 9) for part in place[:2]]}
        feature = {"type": "Feature", "id": properties["id"], "geometry": point, "properties": properties}
        task = {"type": "FeatureCollection", "features": [feature]}
        lines.append(_RECORD_SEPARATOR + json.dumps(task, ensure_ascii=False, allow_nan=False) + "\n")
    path.write_text("".join(lines), encoding="utf-8", newline="\n")
