"""CSV: the labels as a plain table, numbers with all their digits."""

from __future__ import annotations

from pathlib import Path

from valuemap.map_folder import Map
from valuemap.tables import table_to_arrow


def write_csv(result: Map, path: Path) -> None:
    """Write the columns of labels.parquet; an unknown value is an empty field."""
    table_to_arrow(result.labels).to_pandas().to_csv(path, index=False, lineterminator="\n")
