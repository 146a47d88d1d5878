"""GeoJSON (RFC 7946): the labels as points of WGS84 longitude, latitude and ellipsoidal height."""

from __future__ import annotations

import io
from pathlib import Path

from valuemap.writers.attributes import Export, needs_places

_DECIMALS = 9
"""Of a degree: a tenth of a millimetre; and of the height in metres."""


def write_geojson(export: Export, path: Path) -> None:
    """Write one point per label, all attributes as properties.

    Raises
    ------
    InputError
        The map is not geo-referenced, so that its labels have no longitude and latitude.
    OutputError
        Another reference system is asked for.
    """
    needs_places(export, "GeoJSON")
    # Through memory, because GDAL does not tell when a disk is full.
    buffer = io.BytesIO()
    export.frame().to_file(
        buffer,
        driver="GeoJSON",
        engine="pyogrio",
        layer="labels",
        RFC7946="YES",
        COORDINATE_PRECISION=_DECIMALS,
    )
    path.write_bytes(buffer.getvalue())
