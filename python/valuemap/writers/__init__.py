"""Files that other software reads, made from a map: one module a format, one line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from valuemap.errors import OutputError
from valuemap.folders import new_file
from valuemap.map_folder import Map
from valuemap.writers.csv import write_csv
from valuemap.writers.geojson import write_geojson
from valuemap.writers.parquet import write_parquet

WRITERS: dict[str, Callable[[Map, Path], None]] = {
    ".csv": write_csv,
    ".geojson": write_geojson,
    ".parquet": write_parquet,
}


def export_map(result: Map, path: str | Path) -> None:
    """Write the labels of a map as one file, in the format that its suffix names; never half.

    Raises
    ------
    OutputError
        There is no format with this suffix, or the place cannot be written.
    InputError
        The format needs a geo-referenced map and this one is not.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise OutputError(
            f"{path}: cannot export to a file {f'that ends in {suffix}' if suffix else 'without a suffix'}",
            hint=f"name a file that ends in {', '.join(WRITERS)}",
        )
    with new_file(path) as temporary:
        WRITERS[suffix](result, temporary)
