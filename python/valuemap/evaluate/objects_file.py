"""Files of known objects, as surveyors and cities give them: which rows have a place, and in what columns."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from valuemap.arrays import Bools, Floats
from valuemap.config.setting import LARGEST_SIGMA_M
from valuemap.csv_table import read_csv_arrow
from valuemap.dataset import Frame
from valuemap.errors import InputError
from valuemap.geodesy import accuracy_note, lon_lat_height_from_crs
from valuemap.tables import GeographicTruth, TruthPoints
from valuemap.tables.read import read_arrow, table_from_arrow

LABELS = "labels"
"""The layer of objects in what `valuemap export` writes, which has others too."""
_OSM_NODES = "points"
_OTHER_NAMES = {
    "lat": ("latitude", "lat_dd", "latitude_dd"),
    "lon": ("longitude", "long", "lng", "lon_dd", "long_dd", "longitude_dd"),
    "height": ("elevation", "altitude"),
}
"""What tables call degrees, and heights beside them, that can be nothing else."""
_OF_PLACES = ("lon", "lat", "height", "sigma")
_NUMBERS = ("x", "y", "z", *_OF_PLACES)
_TEXTS = ("class", "object_id")
_DEGREES_AROUND = 1.0
"""All x, y that are nearer than this to the longitude and latitude of the anchor are degrees."""
_CUT_SHORT = re.compile(rb'"exceededTransferLimit"\s*:\s*true')
_POINT, _MULTIPOINT, _NOTHING = 0, 4, -1
"""Types of geometries by shapely's numbers."""


@dataclass(frozen=True)
class ObjectsFile:
    """What a file of objects holds, in its order; `notes` say what was left out, and what else a reader must know."""

    objects: GeographicTruth | TruthPoints
    notes: tuple[str, ...]


def check_objects_file(path: Path, what: str, or_else: str = "") -> None:
    """Find out before long work whether `read_objects_file` knows what a file is by its name.

    `what` the file is for, and what may be given `or_else`, go into what is said.

    Raises
    ------
    InputError
        The file is missing or of an unknown kind.
    """
    hint = f"give {or_else}a table of objects as one of {', '.join(_READERS)}"
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a table of objects", hint=hint)
    if not path.is_file():
        told = "is no file" if path.exists() else f"no such file{' or folder' if or_else else ''}"
        raise InputError(f"{path}: {told}", hint=hint)
    suffix = _suffix(path)
    if suffix not in _READERS or (_READERS[suffix] is not _read_csv and path.suffix.lower() == ".gz"):
        raise InputError(f"{path}: {what} of an unknown kind: {path.suffix or 'no suffix'}", hint=hint)


def read_objects_file(path: Path, frame: Frame) -> ObjectsFile:
    """Read a file of objects for a map in a frame, that `check_objects_file` lets pass.

    Rows without a place, and those at longitude 0, latitude 0, which mean the same, are left out.

    Raises
    ------
    InputError
        The file is damaged, or has nothing that can be brought to the frame.
    """
    notes: list[str] = []
    table = _with_heights(_with_our_names(_READERS[_suffix(path)](path, notes.append)))
    columns = {*table.column_names}
    has_position, has_place = {"x", "y", "z"} <= columns, {"lon", "lat"} <= columns
    if has_place and frame.is_georeferenced and ("height" in columns or not has_position):
        table, is_there, left_out = _with_places_everywhere(table)
        places = table_from_arrow(GeographicTruth, table, source=str(path))
        _check_degrees(places.lon_lat, path)
        _check_sigmas(places.sigma_m, path)
        places = places.take(is_there)
        notes += left_out
        if places.height_m is not None:
            places, about_heights = _with_known_heights(places, places.height_m)
            notes += about_heights
        if _is_cut_short(path):
            notes.append(
                "the server that gave the objects did not give all (exceededTransferLimit): what is missing counts "
                "as if it did not exist"
            )
        return ObjectsFile(places, tuple(notes))
    if has_place and not has_position:
        raise InputError(
            f"{path}: has longitude and latitude, but the map is not geo-referenced",
            hint="give x, y, z in the frame of the map",
        )
    if not has_position:
        raise InputError(
            f"{path}: expected columns lon, lat or x, y, z, found {', '.join(table.column_names)[:300]}",
            hint="lon and lat are WGS84 degrees, x, y, z metres in the frame of the map: call the columns so; points "
            "in a map projection, or as texts in one column, give as GeoJSON or GeoPackage",
        )
    points = table_from_arrow(TruthPoints, table, source=str(path))
    _check_sigmas(points.sigma_m, path)
    if frame.anchor is not None:
        lat, lon, _ = frame.anchor
        if np.all(np.abs(points.position_in_world_m[:, :2] - [lon, lat]) < _DEGREES_AROUND):
            raise InputError(
                f"{path}: x and y are longitude and latitude of the place, expected metres in the frame of the map",
                hint="call the columns lon, lat and height",
            )
    return ObjectsFile(points, ())


def _suffix(path: Path) -> str:
    """Return what says the kind of a file."""
    return (Path(path.stem) if path.suffix.lower() == ".gz" else path).suffix.lower()


def _with_our_names(table: pa.Table) -> pa.Table:
    """Return the table with columns by our names, classes as texts and whole numbers as ids.

    Surveys have texts as ids, such as TL-17a, whose rows are then the ids. An empty column is none.
    """
    for ours in (*_NUMBERS, *_TEXTS):
        for other in (ours, *_OTHER_NAMES.get(ours, ())):
            same = [name for name in table.column_names if name.strip().lower() == other]
            if ours not in table.column_names and len(same) == 1:
                table = table.rename_columns([ours if name == same[0] else name for name in table.column_names])
    for name in ("height", "sigma", *_TEXTS):
        if table.column_names.count(name) == 1 and 0 < table.num_rows == table[name].null_count:
            table = table.drop_columns(name)
    for name in _TEXTS:
        if table.column_names.count(name) == 1:
            column = _as_texts(table[name])
            table = table.set_column(table.column_names.index(name), name, column)
    if table.column_names.count("object_id") == 1:
        ids = _as_ids(table["object_id"])
        table = table.set_column(table.column_names.index("object_id"), "object_id", ids)
    return table


def _with_heights(table: pa.Table) -> pa.Table:
    """Return the table with z as heights where it stands beside degrees, and not beside x and y."""
    columns = {*table.column_names}
    if not {"lon", "lat", "z"} <= columns or columns & {"x", "y", "height"} or table.column_names.count("z") > 1:
        return table
    return table.rename_columns(["height" if name == "z" else name for name in table.column_names])


def _with_known_heights(places: GeographicTruth, height_m: Floats) -> tuple[GeographicTruth, list[str]]:
    """Return places without heights where none is known, and what to say of these."""
    unknown = int(np.isnan(height_m).sum())
    if unknown == len(height_m):
        return places.replace(height_m=None), []
    if not np.any(np.nan_to_num(height_m)):
        return places.replace(height_m=None), ["the heights of the objects are all 0, and taken for none"]
    return places, [f"{unknown} of {len(height_m)} objects have no height"] if unknown else []


def _as_texts(column: Any) -> Any:
    """Return a column of texts, or of numbers, which may be codes, as texts: 205 and 205.0 are 205."""
    import pyarrow.compute as pc  # Slow to import, and only files of objects need it.

    kind = column.type
    if pa.types.is_dictionary(kind):
        column, kind = column.cast(kind.value_type), kind.value_type
    if pa.types.is_floating(kind) and pc.all(pc.equal(pc.floor(column), column)).as_py() is not False:
        with contextlib.suppress(pa.ArrowInvalid):  # A number that is too large stays as it is written.
            column, kind = column.cast(pa.int64()), pa.int64()
    is_other = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_string_view(kind)
    return column.cast(pa.string()) if is_other else column


def _as_ids(column: Any) -> Any:
    if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        return column
    try:
        ids = column.cast(pa.int64())
    except pa.ArrowInvalid:
        ids = None
    if ids is None or ids.null_count:
        ids = pa.chunked_array([pa.array(range(len(column)), pa.int64())])
    return ids


def _with_places_everywhere(table: pa.Table) -> tuple[pa.Table, Bools, list[str]]:
    """Return the table with a copy of another row where there is no place, which rows have one, and what to say.

    So every row can be checked under its number, and the others left out after it. What the check of columns refuses,
    comes back as it is.
    """
    import pyarrow.compute as pc  # As slow.

    ours = [name for name in table.column_names if name in (*_OF_PLACES, *_TEXTS)]
    is_checked_later = table.num_rows == 0 or len({*ours}) < len(ours)
    kinds = [] if is_checked_later else [table.schema.field(name).type for name in ("lon", "lat")]
    if is_checked_later or not all(pa.types.is_floating(kind) or pa.types.is_integer(kind) for kind in kinds):
        return table, np.ones(table.num_rows, np.bool_), []
    table = table.select(ours)  # Of others there may be types that rows cannot be taken of.
    lon, lat = (table[name].cast(pa.float64()) for name in ("lon", "lat"))
    is_none = pc.and_(pc.is_null(lon, nan_is_null=True), pc.is_null(lat, nan_is_null=True)).to_numpy()
    is_zero = pc.fill_null(pc.and_(pc.equal(lon, 0), pc.equal(lat, 0)), False).to_numpy()
    is_there: Bools = ~(is_none | is_zero)
    if not is_there.any():
        return table, np.ones(table.num_rows, np.bool_), []
    rows = np.arange(table.num_rows)
    notes = [
        f"{int(which.sum())} of {table.num_rows} objects {what} and are left out"
        for which, what in ((is_none, "have no place"), (is_zero, "lie at longitude 0, latitude 0"))
        if which.any()
    ]
    return table.take(pa.array(np.where(is_there, rows, np.argmax(is_there)))), is_there, notes


def _check_degrees(lon_lat: Floats, path: Path) -> None:
    wrong = np.flatnonzero((np.abs(lon_lat[:, 0]) > 360.0) | (np.abs(lon_lat[:, 1]) > 90.0))
    if len(wrong):
        lon, lat = lon_lat[wrong[0]]
        raise InputError(
            f"{path} row {wrong[0]}: expected degrees, found longitude {lon:.9g} and latitude {lat:.9g} "
            f"({len(wrong)} rows)",
            hint="are latitude and longitude swapped, or are these metres of a map projection? Then give a file that "
            "names it, such as a GeoPackage",
        )


def _check_sigmas(sigma_m: Floats | None, path: Path) -> None:
    """Refuse standard deviations that are none; those that are not known are NaN."""
    if sigma_m is None:
        return
    wrong = np.flatnonzero((sigma_m <= 0.0) | (sigma_m > LARGEST_SIGMA_M))
    if len(wrong):
        raise InputError(
            f"{path} row {wrong[0]}: sigma: expected above 0 and at most {LARGEST_SIGMA_M:g} (m), or no value, found "
            f"{sigma_m[wrong[0]]:g} ({len(wrong)} rows)",
            hint="it is the standard deviation of the position on each axis; leave it empty where it is not known",
        )


def _is_cut_short(path: Path) -> bool:
    """Say whether a server of features says in its answer that there are more."""
    return _suffix(path) in (".json", ".geojson") and _CUT_SHORT.search(path.read_bytes()) is not None


def _read_csv(path: Path, _: Callable[[str], None]) -> pa.Table:
    names = (*_NUMBERS, *(other for others in _OTHER_NAMES.values() for other in others))
    types = {**dict.fromkeys(names, pa.float64()), **dict.fromkeys(_TEXTS, pa.string())}
    hint = "separate columns by commas, their names in the first line; lon and lat are decimal degrees"
    return read_csv_arrow(path, types, has_missing=True, hint=hint)


def _read_parquet(path: Path, tell: Callable[[str], None]) -> pa.Table:
    table = read_arrow(path)
    names = {name.strip().lower() for name in table.column_names}
    has_places = all(names & {ours, *_OTHER_NAMES[ours]} for ours in ("lon", "lat"))
    if b"geo" not in (table.schema.metadata or {}) or has_places:
        return table
    import geopandas  # Slow to import, and only files of points need it.
    import shapely

    try:
        points = geopandas.read_parquet(path)
    except (ValueError, KeyError, TypeError, AttributeError, pa.ArrowException, shapely.errors.ShapelyError) as error:
        raise InputError(
            f"{path}: cannot be read as GeoParquet: {str(error).splitlines()[0]}", hint="is its column of points whole?"
        ) from error
    return table if points.crs is None else _table_of_points(path, points, tell)


def _read_points(path: Path, tell: Callable[[str], None]) -> pa.Table:
    import geopandas  # Slow to import, and only files of points need it.
    import pyogrio

    try:
        layers = pyogrio.list_layers(path)[:, 0].tolist()
        wanted = _OSM_NODES if _suffix(path) == ".osm" else LABELS
        if len(layers) > 1 and wanted not in layers:
            raise InputError(
                f"{path}: has the layers {', '.join(layers)[:300]}", hint="save the one with the objects alone"
            )
        points = geopandas.read_file(path, layer=wanted if wanted in layers else layers[0])
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, OSError, IndexError) as error:
        reason = str(error).splitlines()[0].partition(";")[0]
        hint = "is it a file of points that QGIS opens?"
        if _suffix(path) == ".json":
            hint = "GeoJSON and Esri JSON are read; of Overpass take XML (.osm), or GeoJSON"
        raise InputError(f"{path}: cannot be read: {reason}", hint=hint) from error
    if wanted == _OSM_NODES and not len(points):
        raise InputError(
            f"{path}: has no nodes with tags",
            hint="of .osm only such nodes are read, no ways: export a map as .csv to compare another with it",
        )
    return _table_of_points(path, points, tell)


def _table_of_points(path: Path, points: Any, tell: Callable[[str], None]) -> pa.Table:
    """Return the points as longitude, latitude and height; those without a geometry have none.

    Tell how exactly PROJ brings them there, where it lacks a grid for it.
    """
    import geopandas
    import shapely

    if not isinstance(points, geopandas.GeoDataFrame) or points.crs is None:
        if {"x", "y", "z"} <= {*points.columns}:  # As of an exported map that has no place on the Earth.
            return _as_table(_columns_of(points, ("x", "y", "z", "sigma", *_TEXTS)))
        raise InputError(
            f"{path}: has no geometries in a coordinate system",
            hint="save it as points, e.g. in WGS 84, or in the frame of the map as a .csv with columns x, y, z",
        )
    geometries = points.geometry.to_numpy()
    kinds = np.where(shapely.is_empty(geometries), _NOTHING, shapely.get_type_id(geometries))
    is_one = (kinds == _MULTIPOINT) & (shapely.get_num_geometries(geometries) == 1)
    geometries = np.where(is_one, shapely.get_geometry(geometries, 0), geometries)
    wrong = np.flatnonzero(~is_one & (kinds != _POINT) & (kinds != _NOTHING))
    if len(wrong):
        found = shapely.get_num_geometries(geometries[wrong[0]])
        name = f"{geometries[wrong[0]].geom_type}{f' of {found}' if found > 1 else ''}"
        raise InputError(
            f"{path} row {wrong[0]}: expected a point, found {name} ({len(wrong)} rows)",
            hint="give every object as one point",
        )
    is_there = kinds != _NOTHING
    coordinates = shapely.get_coordinates(geometries[is_there], include_z=True)
    has_height = ~np.isnan(coordinates[:, 2])
    place = np.full((len(points), 3), np.nan)
    if len(coordinates):
        crs = points.crs.to_string()
        place[is_there] = lon_lat_height_from_crs(np.nan_to_num(coordinates), crs)
        if (note := accuracy_note(crs)) is not None:
            tell(note)
    place[np.flatnonzero(is_there)[~has_height], 2] = np.nan
    columns: dict[str, Any] = {"lon": place[:, 0], "lat": place[:, 1]}
    if has_height.any():
        columns["height"] = place[:, 2]
    return _as_table(columns | _columns_of(points, ("sigma", *_TEXTS)))


def _columns_of(points: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return the columns of a data frame that are called so, but for capitals."""
    return {name: points[name] for name in points if str(name).strip().lower() in names}


def _as_table(columns: Mapping[str, Any]) -> pa.Table:
    return pa.table({name: pa.array(column, from_pandas=True) for name, column in columns.items()})


_READERS: dict[str, Callable[[Path, Callable[[str], None]], pa.Table]] = {
    ".csv": _read_csv,
    ".tsv": _read_csv,
    ".parquet": _read_parquet,
    **dict.fromkeys((".geojson", ".json", ".gpkg", ".fgb", ".shp", ".zip", ".kml", ".gml", ".osm"), _read_points),
}
