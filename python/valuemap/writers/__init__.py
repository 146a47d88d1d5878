"""Files and databases that other software reads, made from a map: one module a format, one line here."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np

from valuemap import dataset as dataset_folder
from valuemap import map_folder
from valuemap.dataset import Dataset, expect_dataset
from valuemap.errors import OutputError
from valuemap.folders import new_file, new_folder
from valuemap.geodesy import accuracy_note, degrees_outside, with_heights
from valuemap.map_folder import Map, expect_map
from valuemap.tables import Labels
from valuemap.writers.attributes import Export
from valuemap.writers.colmap import FILES as COLMAP_FILES
from valuemap.writers.colmap import write_colmap
from valuemap.writers.csv import write_csv
from valuemap.writers.flatgeobuf import write_flatgeobuf
from valuemap.writers.geojson import write_geojson
from valuemap.writers.geopackage import write_geopackage
from valuemap.writers.kml import write_kml
from valuemap.writers.lanelet2 import write_lanelet2
from valuemap.writers.maproulette import write_maproulette
from valuemap.writers.opendrive import write_opendrive
from valuemap.writers.osm import write_osm
from valuemap.writers.parquet import write_parquet
from valuemap.writers.postgis import SCHEMES, is_database, without_password, write_postgis
from valuemap.writers.rerun import write_rerun

__all__ = ["FOLDER_WRITERS", "SUFFIXES", "WRITERS", "export_map", "without_password"]

WRITERS: dict[str, Callable[[Export, Path], None]] = {
    "csv": write_csv,
    "geojson": write_geojson,
    "parquet": write_parquet,
    "gpkg": write_geopackage,
    "fgb": write_flatgeobuf,
    "kml": write_kml,
    "osm": write_osm,
    "maproulette": write_maproulette,
    "lanelet2": write_lanelet2,
    "xodr": write_opendrive,
    "rerun": write_rerun,
}

FOLDER_WRITERS: dict[str, tuple[Callable[[Export, Path], None], Collection[str]]] = {
    "colmap": (write_colmap, COLMAP_FILES),
}
"""Each with the names of all files that it writes."""

SUFFIXES: dict[str, str] = {
    ".csv": "csv",
    ".geojson": "geojson",
    ".parquet": "parquet",
    ".gpkg": "gpkg",
    ".fgb": "fgb",
    ".kml": "kml",
    ".osm": "osm",
    ".geojsonl": "maproulette",
    ".lanelet2.osm": "lanelet2",
    ".xodr": "xodr",
    ".rrd": "rerun",
}
"""How a file must end to be of a format without being told; of several that fit, the longest."""

_WITHOUT_STATE = ("osm", "maproulette", "lanelet2", "xodr", "colmap")
"""Formats that cannot say that a label is gone, or that ask people to add what they hold."""

_OWN_FILES = (
    ("dataset", dataset_folder.MARKER, dataset_folder.PARTS, dataset_folder.PART_FOLDERS),
    ("map", map_folder.MARKER, (*map_folder.PARTS, map_folder.REVIEW), (map_folder.CELLS,)),
)
"""Folders of valuemap's that no export writes over: their marker, their files, and their folders."""


def export_map(
    result: Map,
    target: str | Path,
    *,
    format_name: str | None = None,
    dataset: Dataset | None = None,
    crs: str | None = None,
    vertical: str | None = None,
    force: bool = False,
    tell: Callable[[str], None] | None = None,
) -> int:
    """Write the labels of a map as one file, a folder or into a database; never half. Return how many.

    A file that is there is replaced if valuemap wrote it and nobody changed it since, or with `force`. Labels whose
    state is `gone` are left out of formats that cannot say so.

    Parameters
    ----------
    target
        A file, whose suffix says the format, or the URL of a database with PostGIS (`postgresql://...`).
    format_name
        The format, one of `WRITERS`, whatever the suffix; or one of `FOLDER_WRITERS`, for which the target is a folder.
    dataset
        What the map was made from: then the best pictures of each label are named, and formats that hold cameras do.
    crs
        Coordinates in this reference system ("EPSG:25832") instead of WGS84, in formats that hold any.
    vertical
        The zero of the heights, as in `with_heights`.
    force
        Replace a file that valuemap did not write, or that was changed since, too.
    tell
        Called with each note: how many labels are gone and left out, how many lie outside the area that `crs` is made
        for, and how exact positions are in it where PROJ lacks a grid.

    Raises
    ------
    OutputError
        There is no such format, it cannot hold what is asked for, nothing writes to such a URL, a file of somebody else
        is there, the file is one of a dataset or a map, or the place cannot be written.
    InputError
        The format needs a geo-referenced map and this one is not, or the dataset is not that of the map.
    SettingError
        There is no such reference system, or an extra is missing.
    """
    expect_map(result)
    if dataset is not None:
        expect_dataset(dataset)
    system, zero_m = with_heights(crs, vertical)
    notes = []
    if format_name is None and is_database(str(target)):
        write_postgis(Export(result, dataset, system, zero_m), str(target))
    else:
        _refuse_no_file(str(target))
        path = Path(target)
        name = format_name if format_name in FOLDER_WRITERS else _format(path, format_name)
        if name in _WITHOUT_STATE:
            is_there = result.is_there
            if left_out := int(np.sum(~is_there)):
                result = result.take(is_there)
                notes.append(f"labels that are gone (column state): {left_out} left out of {name}")
        _write(Export(result, dataset, system, zero_m), path, name, force=force)
    if tell is not None:
        for note in [*notes, *_notes_on_crs(result.labels, crs)]:
            tell(note)
    return len(result.labels)


def _write(export: Export, path: Path, name: str, *, force: bool) -> None:
    if name in FOLDER_WRITERS:
        writer, parts = FOLDER_WRITERS[name]
        with new_folder(path, parts=parts, force=force) as folder:
            writer(export, folder)
        return
    _refuse_own(path)
    with new_file(path, force=force) as temporary:
        WRITERS[name](export, temporary)


def _notes_on_crs(labels: Labels, crs: str | None) -> list[str]:
    """Return what to tell about labels in a reference system."""
    if crs is None or labels.lon_lat_height is None:
        return []
    notes = []
    outside = degrees_outside(labels.lon_lat_height, crs)
    if outside is not None and np.any(outside > 0.0):
        notes.append(
            f"crs {crs}: {int(np.sum(outside > 0.0))} of {len(labels)} labels lie outside the area that it is made "
            f"for, by up to {outside.max():.3g} degrees: is it the right system for this part of the Earth?"
        )
    note = accuracy_note(crs)
    return notes if note is None else [*notes, note]


def _refuse_no_file(target: str) -> None:
    """Refuse what would become a file named - or a folder with the name of a scheme."""
    if target == "-":
        raise OutputError(
            "-: expected a file, and export does not write to standard output",
            hint="give the name of a file, whose suffix says the format",
        )
    scheme, separator, _ = target.partition("://")
    if not separator or "/" in scheme:
        return
    databases = " or ".join(f"{each}://" for each in SCHEMES)
    if scheme in SCHEMES:
        raise OutputError(f"{scheme}://: a database takes no --format", hint="leave --format away")
    raise OutputError(
        f"{scheme}://: expected a file, or the URL of a database, which begins with {databases}",
        hint="export to a file on this machine and copy it there",
    )


def _refuse_own(path: Path) -> None:
    """Keep an export from taking the place of a file of a dataset or a map, which is ours to replace elsewhere."""
    folder = path.absolute().parent
    for kind, marker, parts, part_folders in _OWN_FILES:
        is_part = path.name in parts and (folder / marker).is_file()
        is_in_part = folder.name in part_folders and (folder.parent / marker).is_file() and path.exists()
        if is_part or is_in_part:
            raise OutputError(f"{path}: is a file of a {kind}, which would be lost", hint="name another file")


def _format(path: Path, name: str | None) -> str:
    if name is not None:
        if name not in WRITERS:
            raise OutputError(
                f"--format {name}: there is no such format",
                hint=f"choose one of {', '.join([*WRITERS, *FOLDER_WRITERS])}",
            )
        return name
    fitting = [suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix.lower())]
    if not fitting:
        found = f"that ends in {path.suffix}" if path.suffix else "without a suffix"
        raise OutputError(
            f"{path}: cannot export to a file {found}",
            hint=f"name a file that ends in {', '.join(SUFFIXES)}, or give --format",
        )
    return SUFFIXES[max(fitting, key=len)]
