"""What a map is compared with: objects of a dataset, a table or a file, in the frame of the map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from valuemap.config import VoteConfig
from valuemap.config.setting import LARGEST_SIGMA_M
from valuemap.csv_table import read_csv_arrow
from valuemap.dataset import Dataset, Frame, read_dataset
from valuemap.errors import InputError, SettingError
from valuemap.evaluate.recoverable import recoverable_objects
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_crs, lon_lat_height_from_enu
from valuemap.map_folder import Map
from valuemap.tables import (
    Bools,
    Categories,
    Floats,
    GeographicTruth,
    Ints,
    Labels,
    Truth,
    TruthPoints,
    read_arrow,
    table_from_arrow,
)

LABELS = "labels"
"""The layer of objects in what `valuemap export` writes, which has others too."""


@dataclass(frozen=True, eq=False)
class TrueObjects:
    """What a map is compared with, in the frame of the map.

    `position_in_world_m` is (N, 3). `class_name` is None where the truth has no classes: then any class
    matches. `is_recoverable` (N) is None where nobody recorded which images detected the objects: then all
    count. Without `has_height` the vertical part of the positions means nothing and matching is horizontal.
    `sigma_m` (N) is the standard deviation of the positions on each axis, NaN where it is not known.
    """

    object_id: Ints
    position_in_world_m: Floats
    class_name: Categories | None = None
    is_recoverable: Bools | None = None
    has_height: bool = True
    sigma_m: Floats | None = None

    def __len__(self) -> int:
        return len(self.object_id)

    @property
    def counts_in_recall(self) -> Bools:
        """Which objects (N) a map should hold."""
        return np.ones(len(self), np.bool_) if self.is_recoverable is None else self.is_recoverable


def true_objects(truth: Dataset | Truth | str | Path, result: Map, min_parallax_rad: float | None) -> TrueObjects:
    """Return the objects of a dataset, a table, a folder or a file in the frame of a map; raises as `evaluate_map`."""
    source = read_truth(Path(truth), result) if isinstance(truth, str | Path) else truth
    if isinstance(source, Dataset):
        angle = _min_parallax_of(result) if min_parallax_rad is None else min_parallax_rad
        return _objects_of_dataset(source, result.frame, angle)
    if isinstance(source, Truth):
        return TrueObjects(source.object_id, source.position_in_world_m, source.class_name)
    return source


def read_truth(path: Path, result: Map) -> Dataset | TrueObjects:
    """Read the truth for a map: a dataset folder, or a file of objects.

    A file has one object a row. It is .csv or .parquet with columns x, y, z in the frame of the map or, for
    geo-referenced maps, lon, lat (WGS84 degrees) and perhaps height (ellipsoidal, m); or .geojson, .gpkg or
    .fgb with points. Columns `class` and `object_id` are optional. Where a file has both kinds of positions,
    the geographic ones count if they are complete, because x, y, z may belong to another anchor. Without
    heights the objects are matched horizontally.

    Raises
    ------
    InputError
        The file is missing, of an unknown kind, damaged, or cannot be brought to the frame of the map.
    """
    if path.is_dir():
        return read_dataset(path)
    check_objects_file(path, "truth", "a dataset folder or ")
    return read_objects(path, result)


def check_objects_file(path: Path, what: str, or_else: str = "") -> None:
    """Find out before long work whether `read_objects` knows what a file is by its name.

    `what` the file is for, and what may be given `or_else`, go into what is said.

    Raises
    ------
    InputError
        The file is missing or of an unknown kind.
    """
    hint = f"give {or_else}a table of objects as one of {', '.join(_TRUTH_READERS)}"
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a table of objects", hint=hint)
    if not path.is_file():
        told = "is no file" if path.exists() else f"no such file{' or folder' if or_else else ''}"
        raise InputError(f"{path}: {told}", hint=hint)
    suffix = _suffix(path)
    if suffix not in _TRUTH_READERS or (suffix != ".csv" and path.suffix.lower() == ".gz"):
        raise InputError(f"{path}: {what} of an unknown kind: {path.suffix or 'no suffix'}", hint=hint)


def _suffix(path: Path) -> str:
    """Return what says the kind of a file."""
    return (Path(path.stem) if path.suffix.lower() == ".gz" else path).suffix.lower()


def read_objects(path: Path, result: Map) -> TrueObjects:
    """Read a file of objects, as `read_truth` describes them, that `check_objects_file` lets pass.

    Raises
    ------
    InputError
        The file is damaged, or cannot be brought to the frame of the map.
    """
    table = _with_numbered_objects(_TRUTH_READERS[_suffix(path)](path))
    columns = {*table.column_names}
    has_position, has_place = {"x", "y", "z"} <= columns, {"lon", "lat"} <= columns
    anchor = result.frame.anchor
    if has_place and anchor is not None and ("height" in columns or not has_position):
        places = table_from_arrow(GeographicTruth, table, source=str(path))
        _check_sigmas(places.sigma_m, path)
        return _objects_on_earth(places, anchor, result.labels)
    if has_place and not has_position:
        raise InputError(
            f"{path}: has longitude and latitude, but the map is not geo-referenced",
            hint="give x, y, z in the frame of the map",
        )
    if not has_position:
        raise InputError(
            f"{path}: expected columns lon, lat or x, y, z, found {', '.join(table.column_names)[:300]}",
            hint="columns have these names; lon and lat are WGS84 degrees, x, y, z metres in the frame of the map",
        )
    points = table_from_arrow(TruthPoints, table, source=str(path))
    _check_sigmas(points.sigma_m, path)
    return _sorted_objects(points, points.position_in_world_m)


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


def _with_numbered_objects(table: pa.Table) -> pa.Table:
    """Return the table with whole numbers as ids: surveys have texts, such as TL-17a, whose rows are then the ids."""
    if table.column_names.count("object_id") != 1:
        return table
    ids = table["object_id"]
    if pa.types.is_dictionary(ids.type):
        ids = ids.cast(ids.type.value_type)
    if pa.types.is_string(ids.type) or pa.types.is_large_string(ids.type):
        try:
            ids = ids.cast(pa.int64())
        except pa.ArrowInvalid:
            ids = pa.chunked_array([pa.array(range(table.num_rows), pa.int64())])
        table = table.set_column(table.column_names.index("object_id"), "object_id", ids)
    return table


def _min_parallax_of(result: Map) -> float:
    settings = result.run.get("settings")
    degrees = settings.get("min_parallax_deg") if isinstance(settings, dict) else None
    return math.radians(degrees if isinstance(degrees, int | float) else VoteConfig().min_parallax_deg)


def _objects_of_dataset(dataset: Dataset, frame: Frame, min_parallax_rad: float) -> TrueObjects:
    truth = dataset.truth
    if truth is None:
        raise InputError(
            f"{dataset.name}: the dataset has no truth",
            hint="add truth.parquet, or give a file of true objects",
        )
    if not 0.0 <= min_parallax_rad <= math.pi:
        raise SettingError(
            f"min_parallax: expected 0 to 180 degrees, found {math.degrees(min_parallax_rad):g}",
            hint="the default is that of the map",
        )
    position = positions_in_frame(truth.position_in_world_m, dataset, frame, what="the truth is")
    return TrueObjects(
        truth.object_id,
        position,
        truth.class_name,
        is_recoverable=recoverable_objects(dataset, min_parallax_rad),
    )


def positions_in_frame(position_in_world_m: Floats, dataset: Dataset, frame: Frame, *, what: str) -> Floats:
    """Return positions (N, 3) of a dataset in the frame of a map; `what` begins the message where that cannot be.

    Raises
    ------
    InputError
        The frames have nothing to do with each other.
    """
    if frame.anchor is not None and dataset.frame.anchor is not None:
        if frame.anchor == dataset.frame.anchor:
            return position_in_world_m
        return enu_from_lon_lat_height(lon_lat_height_from_enu(position_in_world_m, dataset.frame.anchor), frame.anchor)
    if frame.is_georeferenced or dataset.frame.is_georeferenced or not np.allclose(frame.up, dataset.frame.up):
        raise InputError(
            f"{dataset.name}: {what} in a frame {dataset.frame}, the map in one {frame}",
            hint="evaluate with the dataset that the map was made from, or with one in the same frame",
        )
    return position_in_world_m


def _objects_on_earth(truth: GeographicTruth, anchor: tuple[float, float, float], labels: Labels) -> TrueObjects:
    """Bring WGS84 places to the ENU frame of a map, at the height of its labels where they have none.

    A wrong height shifts a place horizontally by that error times its distance from the anchor over the
    radius of the Earth: with the height of the labels, centimetres in a city.
    """
    height_m = truth.height_m
    if height_m is None:
        places = labels.lon_lat_height
        height_m = np.full(len(truth), anchor[2] if places is None or len(places) == 0 else np.median(places[:, 2]))
    position = enu_from_lon_lat_height(np.column_stack([truth.lon_lat, height_m]), anchor)
    return _sorted_objects(truth, position, has_height=truth.height_m is not None)


def _sorted_objects(
    truth: TruthPoints | GeographicTruth, position_in_world_m: Floats, *, has_height: bool = True
) -> TrueObjects:
    """Put objects in an order of their own, because that of the rows must not change any figure."""
    class_code = np.zeros(len(truth), np.int32) if truth.class_name is None else truth.class_name.codes
    object_id = np.arange(len(truth)) if truth.object_id is None else truth.object_id
    order = np.lexsort((class_code, *position_in_world_m.T))
    return TrueObjects(
        object_id=object_id[order],
        position_in_world_m=position_in_world_m[order],
        class_name=None if truth.class_name is None else truth.class_name.take(order),
        has_height=has_height,
        sigma_m=None if truth.sigma_m is None else truth.sigma_m[order],
    )


def _read_csv(path: Path) -> pa.Table:
    numbers = dict.fromkeys(("x", "y", "z", "lon", "lat", "height", "sigma"), pa.float64())
    types = {**numbers, "class": pa.string(), "object_id": pa.string()}
    hint = "separate columns by commas, their names in the first line"
    return read_csv_arrow(path, types, has_missing=True, hint=hint)


def _read_points(path: Path) -> pa.Table:
    import geopandas  # Slow to import, and only files of points need it.
    import pyogrio

    try:
        layers = pyogrio.list_layers(path)[:, 0].tolist()
        if len(layers) > 1 and LABELS not in layers:
            raise InputError(
                f"{path}: has the layers {', '.join(layers)[:300]}", hint="save the one with the objects alone"
            )
        points = geopandas.read_file(path, layer=LABELS if LABELS in layers else layers[0])
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: cannot be read: {reason}", hint="is it a file of points that QGIS opens?") from error
    if not isinstance(points, geopandas.GeoDataFrame) or points.crs is None:
        raise InputError(f"{path}: has no geometries in a coordinate system", hint="save it as points, e.g. in WGS 84")
    kinds = points.geom_type.to_numpy()
    wrong = np.flatnonzero(kinds != "Point")
    if len(wrong):
        raise InputError(
            f"{path} row {wrong[0]}: expected a point, found {kinds[wrong[0]]} ({len(wrong)} rows)",
            hint="give every object as one point",
        )
    coordinates = points.get_coordinates(include_z=True).to_numpy()
    has_height = ~np.isnan(coordinates[:, 2])
    lon, lat, height = lon_lat_height_from_crs(np.nan_to_num(coordinates), points.crs.to_string()).T
    columns = {"lon": lon, "lat": lat}
    if has_height.any():
        columns["height"] = np.where(has_height, height, np.nan)
    columns |= {name: points[name] for name in ("class", "object_id") if name in points}
    return pa.table({name: pa.array(column, from_pandas=True) for name, column in columns.items()})


_TRUTH_READERS: dict[str, Callable[[Path], pa.Table]] = {
    ".csv": _read_csv,
    ".parquet": read_arrow,
    ".geojson": _read_points,
    ".gpkg": _read_points,
    ".fgb": _read_points,
}
