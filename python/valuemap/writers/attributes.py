"""What all formats say about labels: the columns of labels.parquet, and others that people ask for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from valuemap.arrays import Floats, Ints, rows_in_runs
from valuemap.dataset import Dataset, rows_of_votes
from valuemap.errors import InputError, OutputError
from valuemap.geodesy import crs_from_lon_lat_height
from valuemap.map_folder import Map
from valuemap.tables.covariance import covariance_matrices
from valuemap.tables.table import table_to_arrow

if TYPE_CHECKING:
    import geopandas
    import pandas as pd

PICTURES = 3
"""How many pictures are named."""

_FIRST_DATE_S = 631_152_000.0
"""1990: smaller timestamps count from a beginning of their own."""


WGS84 = "EPSG:4979"
"""Longitude, latitude and ellipsoidal height."""

_CODES_OF_WGS84 = ("4326", "4979", "OGC:CRS84")
"""What people call it: coordinates are east before north whatever the order of its own axes."""


_UP_IS_Z = 0.9
"""Cosine of 26 degrees: further from z no axis z is meant to be up."""


def azimuth_in_degrees(azimuth_rad: Floats) -> Floats:
    """Return azimuths (N) from 0 to less than 360 degrees, NaN where there is none."""
    turned = np.degrees(azimuth_rad) % 360.0
    return np.where(turned == 360.0, 0.0, turned)  # What remains of a little less than 0 is rounded to 360.


@dataclass(frozen=True, eq=False)
class Places:
    """Coordinates (N, 3) of labels, east before north, and the reference system that they are in, None for none."""

    coordinates: Floats
    crs: str | None


@dataclass(frozen=True, eq=False)
class Export:
    """A map that is to be written: with the dataset it was made from, if that is known, for pictures and cameras.

    `crs` is the coordinate reference system to write in, as PROJ knows it ("EPSG:25832"); None for WGS84. Heights are
    written above a zero that is `zero_height_m` above its own.
    """

    result: Map
    dataset: Dataset | None = None
    crs: str | None = None
    zero_height_m: float = 0.0

    @cached_property
    def attributes(self) -> pd.DataFrame:
        """A row for each label: the columns of labels.parquet, then those of docs/formats/export.md for people."""
        labels = self.result.labels
        table = table_to_arrow(labels).to_pandas()
        table["class"] = table["class"].astype("string")  # No labels have no classes: categories of none have no type.
        for name in ("object_width_m", "object_height_m"):
            table[name] = table[name].where(table[name] > 0.0)  # Key points have no size.
        ellipse = self.ellipses
        table["sigma_m"] = np.hypot(ellipse.major_m, ellipse.minor_m)
        table["sigma_height_m"] = ellipse.height_m
        table["ellipse_major_m"] = ellipse.major_m
        table["ellipse_minor_m"] = ellipse.minor_m
        table["ellipse_azimuth_deg"] = ellipse.azimuth_deg
        table["facing_deg"] = azimuth_in_degrees(labels.facing_azimuth_rad)
        table["first_seen_time"] = iso_times(labels.first_seen_s)
        table["last_seen_time"] = iso_times(labels.last_seen_s)
        if self.dataset is not None:
            names = self._best_pictures(self.dataset)
            for rank in range(PICTURES):
                table[f"picture_{rank + 1}"] = names[rank]
        if self.crs is not None:
            places = self.places
            for axis, column in zip("xyz", places.coordinates.T, strict=True):
                table[f"crs_{axis}"] = column
        texts = [name for name in table.columns if name.endswith("_time") or name.startswith("picture_")]
        typed: pd.DataFrame = table.astype(dict.fromkeys(texts, "string"))
        return typed

    @cached_property
    def places(self) -> Places:
        """Where the labels are: in WGS84 (longitude, latitude, height), in `crs`, or in a frame of the map's own."""
        labels = self.result.labels
        if labels.lon_lat_height is None:
            if self.crs is not None:
                raise InputError(
                    f"the map is not geo-referenced, so that it has no place in {self.crs}",
                    hint="leave --crs away, or import the data with a geo-reference",
                )
            return Places(self.on_the_ground(labels.position_in_world_m), None)
        if self.crs is None:
            return Places(labels.lon_lat_height, WGS84)
        return Places(self.placed(labels.lon_lat_height), self.crs)

    def placed(self, lon_lat_height: Floats) -> Floats:
        """Return places (N, 3) of WGS84 in `crs`."""
        if self.crs is None:
            return lon_lat_height
        return crs_from_lon_lat_height(lon_lat_height, self.crs) - [0.0, 0.0, self.zero_height_m]

    def on_the_ground(self, position_in_world_m: Floats) -> Floats:
        """Return positions (N, 3) in the frame of the map as east, north, up: a GIS shows the first two.

        Where z is up, but for a few degrees by which the cameras were tilted, they are x, y, z as the user has them.
        """
        if self.result.frame.up[2] > _UP_IS_Z:
            return position_in_world_m
        turned: Floats = position_in_world_m @ self.result.frame.east_north_up().T
        return turned

    @cached_property
    def ellipses(self) -> Ellipses:
        """How wrong the positions may be, on the ground and in height, the place of the whole map included."""
        return self._ellipses_of(self.result.labels.stated_covariance_m2)

    @cached_property
    def ellipses_among_labels(self) -> Ellipses:
        """How wrong the positions may be against the labels around."""
        return self._ellipses_of(self.result.labels.covariance_m2)

    def _ellipses_of(self, columns_m2: Floats) -> Ellipses:
        up = np.array(self.result.frame.up)
        east, north = self.result.frame.east_north()
        covariance_m2 = covariance_matrices(columns_m2)
        ground = np.stack([east, north])
        values, vectors = np.linalg.eigh(ground @ covariance_m2 @ ground.T)
        minor_m, major_m = np.sqrt(np.maximum(values, 0.0)).T
        longest = vectors[:, :, 1]
        return Ellipses(
            major_m=major_m,
            minor_m=minor_m,
            azimuth_deg=np.degrees(np.arctan2(longest[:, 0], longest[:, 1])) % 180.0,
            height_m=np.sqrt(np.maximum(np.einsum("i,nij,j->n", up, covariance_m2, up), 0.0)),
        )

    def frame(self) -> geopandas.GeoDataFrame:
        """Return the attributes with the labels as points."""
        import geopandas  # Slow to import.

        points = geopandas.points_from_xy(*self.places.coordinates.T)
        return geopandas.GeoDataFrame(self.attributes, geometry=points, crs=self.places.crs)

    @cached_property
    def image_row_of_vote(self) -> Ints:
        """The row in the images of the dataset (votes) of each vote."""
        assert self.dataset is not None
        return rows_of_votes(self.result.votes, self.dataset)[1]

    def _best_pictures(self, dataset: Dataset) -> list[list[str | None]]:
        """Return the names (PICTURES, labels) of pictures that show each label largest, of different passes first."""
        votes, images, labels = self.result.votes, dataset.images, self.result.labels
        detection, image = rows_of_votes(votes, dataset)
        size_px = dataset.detections.size_px[detection]
        area_px = size_px[:, 0] * size_px[:, 1]
        label = np.searchsorted(labels.label_id, votes.label_id)
        pass_code = images.pass_id.codes[image]
        order = np.lexsort((votes.image_id, -area_px, pass_code, label))
        rank_in_pass = _rank_in_runs(label[order] * (int(pass_code.max(initial=0)) + 1) + pass_code[order])
        order = order[np.lexsort((votes.image_id[order], -area_px[order], rank_in_pass, label[order]))]
        rank = _rank_in_runs(label[order])
        names: list[list[str | None]] = []
        for wanted in range(PICTURES):
            column: list[str | None] = [None] * len(labels)
            chosen = order[rank == wanted]
            for row, name in zip(label[chosen].tolist(), images.name.take(image[chosen]).to_pylist(), strict=True):
                column[row] = name
            names.append(column)
        return names


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Standard deviations (N) in metres along both axes on the ground and of the height.

    `azimuth_deg` is where the longer axis points, clockwise from north, 0 to 180.
    """

    major_m: Floats
    minor_m: Floats
    azimuth_deg: Floats
    height_m: Floats


def iso_times(timestamp_s: Floats) -> list[str | None]:
    """Return times (N) as ISO 8601 in UTC, to the millisecond; None where there is none, or no date."""
    known = np.nan_to_num(timestamp_s, nan=0.0)
    dates = (known * 1e3).round().clip(0.0, 253_402_300_799_999.0).astype("datetime64[ms]")  # Until the year 9999.
    texts = np.datetime_as_string(dates, unit="ms")
    return [f"{text}Z" if is_date else None for text, is_date in zip(texts, known >= _FIRST_DATE_S, strict=True)]


def refuse_crs(export: Export, holds: str) -> None:
    """Refuse another reference system where one is asked for, of a format that has its own; `holds` says which.

    Raises
    ------
    OutputError
        Another reference system is asked for.
    """
    if export.crs is None:
        return
    from pyproj import CRS

    named = CRS.from_user_input(export.crs).name if "[" in export.crs else export.crs  # WKT is long.
    raise OutputError(
        f"{holds} only, not {'heights above another zero' if export.zero_height_m else named}",
        hint="leave --crs and --vertical away, or export to .gpkg, .parquet, .fgb or .csv",
    )


def needs_places(export: Export, what: str) -> Floats:
    """Return longitude, latitude and height (N, 3) for a format that holds nothing else.

    Raises
    ------
    InputError
        The map is not geo-referenced.
    OutputError
        Another reference system is asked for.
    """
    if export.zero_height_m or (export.crs or "EPSG:4326").upper().removeprefix("EPSG:") not in _CODES_OF_WGS84:
        refuse_crs(export, f"{what} holds WGS84 longitude and latitude")
    if export.result.labels.lon_lat_height is None:
        raise InputError(
            f"the map is not geo-referenced, and {what} holds longitude and latitude only",
            hint="export to .csv, .parquet or .gpkg, or import the data with a geo-reference",
        )
    return export.result.labels.lon_lat_height


def plain(value: Any) -> Any:
    """Return a cell of the attributes as a plain Python value; None where it is unknown."""
    if value is None or value is np.ma.masked:
        return None
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool) else None


def records(export: Export) -> list[dict[str, Any]]:
    """Return the attributes of every label by name, unknown ones left away."""
    table = export.attributes
    columns = {name: [plain(value) for value in table[name].tolist()] for name in table.columns}
    return [
        {name: column[row] for name, column in columns.items() if column[row] is not None} for row in range(len(table))
    ]


def _rank_in_runs(values: Ints) -> Ints:
    """Return how many of a run of equal values (N) come before each."""
    begins = np.flatnonzero(np.diff(values, prepend=values[:1] - 1))
    return rows_in_runs(0, np.diff(np.append(begins, len(values))))
