"""Parquet: the labels with their types; GeoParquet 1.1 where the map is geo-referenced."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from valuemap.writers.attributes import Export

_ROWS_IN_A_GROUP = 20_000
"""Readers that look for a place skip groups of rows by their bounds: smaller ones are larger files."""


def write_parquet(export: Export, path: Path) -> None:
    """Write all attributes, and where the map is geo-referenced points, along a Hilbert curve, with their bounds.

    What is near on the ground is near in the file; a reader that looks for a place reads only the groups of rows whose
    bounds it touches.
    """
    if export.places.crs is None:
        table = pa.Table.from_pandas(export.attributes, preserve_index=False).replace_schema_metadata()
        pq.write_table(table, path, compression="zstd")
        return
    frame = export.frame()
    if len(frame):
        frame = frame.iloc[frame.geometry.hilbert_distance().argsort(kind="stable")]
    frame.to_parquet(
        path,
        index=False,
        compression="zstd",
        schema_version="1.1.0",
        write_covering_bbox=True,
        row_group_size=_ROWS_IN_A_GROUP,
    )
