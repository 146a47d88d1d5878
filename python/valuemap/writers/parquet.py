"""Parquet: the labels with their types; GeoParquet where the map is geo-referenced."""

from __future__ import annotations

from pathlib import Path

from valuemap.map_folder import Map, write_labels


def write_parquet(result: Map, path: Path) -> None:
    """Write the labels as the map folder holds them."""
    write_labels(result, path)
