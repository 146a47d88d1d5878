"""FlatGeobuf: the labels as points with a spatial index, for maps on the web that read a part of a file."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

from valuemap.writers.attributes import Export


def write_flatgeobuf(export: Export, path: Path) -> None:
    """Write one point per label with all attributes."""
    # Through memory, because GDAL does not tell when a disk is full.
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "'crs' was not provided")  # A frame of its own has none.
        export.frame().to_file(buffer, driver="FlatGeobuf", engine="pyogrio", layer="labels")
    path.write_bytes(buffer.getvalue())
