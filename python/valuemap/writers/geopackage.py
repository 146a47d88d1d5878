"""GeoPackage: labels, their ellipses, votes and camera positions as layers, drawn by QGIS without any setting up."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.cameras import camera_poses
from valuemap.errors import OutputError
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.writers import qgis_style
from valuemap.writers.attributes import Export, azimuth_in_degrees, iso_times

if TYPE_CHECKING:
    import geopandas

ELLIPSE_SIGMAS = 2.4477
"""Axes of an ellipse that holds 95 % of the errors on the ground: the root of the quantile of chi-square with 2."""

_CORNERS = 48
_SAME_DATE = "2000-01-01T00:00:00.000Z"
"""What the file says about when it was written, so that the same map gives the same bytes."""


def write_geopackage(export: Export, path: Path) -> None:
    """Write the layers `labels`, `ellipses` and `votes`, and `cameras` where the dataset is known.

    Votes are lines from the camera to the label where the dataset is known, else rows without a geometry.

    Raises
    ------
    OutputError
        The disk is full, or the folder has a name that SQLite cannot open.
    """
    import pyogrio
    from pyogrio.errors import DataLayerError, DataSourceError

    layers: dict[str, Callable[[Export], geopandas.GeoDataFrame]] = {
        "labels": Export.frame,
        "ellipses": _ellipses,
        "votes": _votes,
    }
    if export.dataset is not None:
        layers["cameras"] = _cameras
    rows: dict[str, int] = {}
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _SAME_DATE})
    try:
        for name, layer in layers.items():
            frame = layer(export)
            rows[name] = len(frame)
            options = {"geometry_type": _GEOMETRIES[name]} if hasattr(frame, "geometry") else {}
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "'crs' was not provided")  # A frame of its own has none.
                pyogrio.write_dataframe(frame, path, layer=name, driver="GPKG", append=name != "labels", **options)
    except (DataLayerError, DataSourceError) as error:
        is_odd = not str(path.parent).isprintable()
        raise OutputError(
            f"{path.parent}: no GeoPackage can be written there: {error}",
            hint="choose a folder without line breaks in its name" if is_odd else "is the disk full?",
        ) from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
    _finish(path, rows, export)


_GEOMETRIES = {"labels": "Point Z", "ellipses": "Polygon Z", "votes": "LineString Z", "cameras": "Point Z"}


def ellipse_rings_in_world_m(export: Export) -> Floats:
    """Return rings (N, corners, 3) around labels on the ground that hold 95 % of the errors, in the map's frame."""
    labels, ellipse = export.result.labels, export.ellipses
    east, north = export.result.frame.east_north()
    azimuth = np.radians(ellipse.azimuth_deg)
    long_axis = np.outer(np.sin(azimuth), east) + np.outer(np.cos(azimuth), north)
    short_axis = np.outer(np.cos(azimuth), east) - np.outer(np.sin(azimuth), north)
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    ring = (
        np.cos(angle)[None, :, None] * (ellipse.major_m[:, None] * long_axis)[:, None]
        + np.sin(angle)[None, :, None] * (ellipse.minor_m[:, None] * short_axis)[:, None]
    )
    return np.asarray(labels.position_in_world_m[:, None] + ELLIPSE_SIGMAS * ring)


def _ellipses(export: Export) -> geopandas.GeoDataFrame:
    import geopandas
    import shapely

    rings = ellipse_rings_in_world_m(export)
    placed = _together(export, rings, np.arange(len(rings)))
    table = export.attributes[["label_id", "class", "ellipse_major_m", "ellipse_minor_m", "ellipse_azimuth_deg"]]
    return geopandas.GeoDataFrame(table, geometry=shapely.polygons(placed), crs=export.places.crs)


def _votes(export: Export) -> geopandas.GeoDataFrame:
    import geopandas
    import pandas as pd
    import shapely

    votes = export.result.votes
    table = pd.DataFrame(
        {
            "label_id": votes.label_id,
            "detection_id": votes.detection_id,
            "image_id": votes.image_id,
            "residual_px": votes.residual_px,
            "residual_sigmas": votes.residual_sigmas,
        }
    )
    if export.dataset is None:
        return table
    image = export.image_row_of_vote
    images = export.dataset.images
    table["picture"] = images.name.take(image).to_pandas()
    table["pass"] = [images.pass_id.names[code] for code in images.pass_id.codes[image]]
    label = np.searchsorted(export.result.labels.label_id, votes.label_id)
    ends = export.result.labels.position_in_world_m[label]
    lines = _together(export, np.stack([camera_poses(images)[1][image], ends], axis=1), label)
    lines[:, 1] = export.places.coordinates[label]
    return geopandas.GeoDataFrame(table, geometry=shapely.linestrings(lines), crs=export.places.crs)


def _cameras(export: Export) -> geopandas.GeoDataFrame:
    import geopandas
    import pandas as pd

    assert export.dataset is not None
    images = export.dataset.images
    rotation, center_in_world_m = camera_poses(images)
    ahead = rotation[:, 2] @ export.result.frame.east_north().T
    table = pd.DataFrame(
        {
            "image_id": images.image_id,
            "picture": images.name.to_pandas(),
            "camera_id": images.camera_id,
            "pass": images.pass_id.texts(),
            "heading_deg": azimuth_in_degrees(np.arctan2(ahead[:, 0], ahead[:, 1])),
        }
    )
    if images.timestamp_s is not None:
        table["time"] = pd.array(iso_times(images.timestamp_s), dtype="string")
    points = geopandas.points_from_xy(*_placed(export, center_in_world_m).T)
    return geopandas.GeoDataFrame(table, geometry=points, crs=export.places.crs)


def _placed(export: Export, position_in_world_m: Floats) -> Floats:
    """Return positions (N, 3) in the map's frame where the labels are written to."""
    anchor = export.result.frame.anchor
    if export.places.crs is None or anchor is None:
        return export.on_the_ground(position_in_world_m)
    geographic = lon_lat_height_from_enu(position_in_world_m, anchor)
    return export.placed(geographic)


def _together(export: Export, position_in_world_m: Floats, label: Ints) -> Floats:
    """Return where lines or rings (N, corners, 3) are written to that do not go around the Earth, of labels (rows, N).

    Longitudes jump from 180 to -180, and what is projected there from one end of the map to the other; here they go on
    beyond, on the side where the label is.
    """
    from pyproj import CRS

    shape = position_in_world_m.shape
    coordinates = _placed(export, position_in_world_m.reshape(-1, 3)).reshape(shape)
    if export.places.crs is None:
        return coordinates
    at = np.broadcast_to(export.places.coordinates[label, None], shape)
    if CRS.from_user_input(export.places.crs).is_geographic:
        turns = np.round((coordinates[..., 0] - at[..., 0]) / 360.0)
        return coordinates - 360.0 * np.stack([turns, 0.0 * turns, 0.0 * turns], axis=-1)
    near = np.broadcast_to(export.result.labels.position_in_world_m[label, None], shape)
    most = _MOST_STRETCHED * np.linalg.norm(position_in_world_m - near, axis=-1) + 1.0
    jumps = np.abs(coordinates - at)[..., :2].max(axis=-1) > most
    if jumps.any():
        coordinates[jumps] -= _jump(export, near[jumps], position_in_world_m[jumps], at[jumps], most[jumps])
    return coordinates


def _jump(export: Export, near: Floats, far: Floats, at: Floats, most: Floats) -> Floats:
    """Return how far coordinates jump (N, 3) between places (N, 3) that are at `at` and others, more than `most` away.

    The place of the jump is between those that were last found on either side of it.
    """
    before, beyond = at, _placed(export, far)
    for _ in range(_HALVES):
        middle = (near + far) / 2.0
        placed = _placed(export, middle)
        is_beyond = np.abs(placed - at)[:, :2].max(axis=1, keepdims=True) > most[:, None]
        near, before = np.where(is_beyond, near, middle), np.where(is_beyond, before, placed)
        far, beyond = np.where(is_beyond, middle, far), np.where(is_beyond, placed, beyond)
    return np.asarray((beyond - before) * [1.0, 1.0, 0.0])


_MOST_STRETCHED = 1000.0
"""No map projection is used where it makes more of a metre."""
_HALVES = 50
"""Of 1 km that is less than numbers hold."""


def _finish(path: Path, rows: dict[str, int], export: Export) -> None:
    """Add the styles, and make sure that all is there: GDAL does not tell when a disk is full."""
    classes = sorted(set(export.result.labels.class_name.texts()))
    styles = {
        "labels": qgis_style.labels_style(classes),
        "ellipses": qgis_style.ellipses_style(),
        "votes": qgis_style.votes_style(),
        "cameras": qgis_style.cameras_style(),
    }
    try:
        with closing(sqlite3.connect(path)) as database:
            database.execute(
                "CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, f_table_catalog TEXT, f_table_schema TEXT, "
                "f_table_name TEXT, f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT, "
                "useAsDefault BOOLEAN, description TEXT, owner TEXT, ui TEXT, update_time DATETIME)"
            )
            database.execute(
                "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change) "
                "VALUES ('layer_styles', 'attributes', 'layer_styles', 'Styles for QGIS', ?)",
                (_SAME_DATE,),
            )
            spatial = {name for (name,) in database.execute("SELECT table_name FROM gpkg_geometry_columns")}
            for name in rows:
                if name in spatial:
                    database.execute(
                        "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, "
                        "styleName, styleQML, styleSLD, useAsDefault, description, owner, update_time) "
                        "VALUES ('', '', ?, 'geom', ?, ?, '', 1, 'by valuemap', '', ?)",
                        (name, name, styles[name], _SAME_DATE),
                    )
            database.commit()
            for name, count in rows.items():
                found = database.execute(f'SELECT count(*) FROM "{name}"').fetchone()[0]
                if found != count:
                    raise OutputError(
                        f"{path}: cannot be written: {found} of {count} {name} are in it", hint="is the disk full?"
                    )
    except sqlite3.Error as error:
        raise OutputError(f"{path}: cannot be written: {error}", hint="is the disk full?") from error
