"""GeoJSON (RFC 7946): the labels as points of WGS84 longitude, latitude and ellipsoidal height."""

from __future__ import annotations

import io
from pathlib import Path

from valuemap.errors import InputError
from valuemap.map_folder import Map, geographic_labels

_DECIMALS = 9
"""Of a degree: a tenth of a millimetre; and of the height in metres."""


def write_geojson(result: Map, path: Path) -> None:
    """Write one point a label, all columns of labels.parquet as properties.

    Raises
    ------
    InputError
        The map is not geo-referenced, so that its labels have no longitude and latitude.
    """
    if result.labels.lon_lat_height is None:
        raise InputError(
            "the map is not geo-referenced, and GeoJSON holds longitude and latitude only",
            hint="export to .csv or .parquet, or import the data with a geo-reference",
        )
    # Through memory, because GDAL does not tell when a disk is full.
    buffer = io.BytesIO()
    geographic_labels(result.labels).to_file(
        buffer,
        driver="GeoJSON",
        engine="pyogrio",
        layer="labels",
        RFC7946="YES",
        COORDINATE_PRECISION=_DECIMALS,
    )
    path.write_bytes(buffer.getvalue())
