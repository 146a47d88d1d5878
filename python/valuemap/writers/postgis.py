"""PostGIS: labels, votes and cameras as tables of a database, replaced together in one transaction."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, urlencode

import numpy as np

from valuemap.cameras import camera_centers
from valuemap.errors import InputError, OutputError, SettingError
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.writers.attributes import Export, iso_times, needs_places, plain

if TYPE_CHECKING:
    import psycopg

SCHEMES = ("postgresql", "postgres")
"""What a URL of a database begins with."""

_SCHEMA = "valuemap"
_TYPES = {"int": "bigint", "float": "double precision", "str": "text", "time": "timestamptz"}


def is_database(target: str) -> bool:
    """Return whether a target is the URL of a database rather than a file."""
    return target.partition("://")[0] in SCHEMES and "://" in target


def write_postgis(export: Export, url: str) -> None:
    """Write the tables `labels`, `votes` and, where the dataset is known, `cameras`.

    Every row has the name of its map in the column `map`; rows of other maps stay. All is done in one transaction: on
    any error, and for whoever reads meanwhile, the database is as before. Done twice, it is the same.

    Parameters
    ----------
    url
        `postgresql://user@host:port/database`, as libpq reads it; `?schema=NAME` (default valuemap) and `?map=NAME`
        (default the name of the dataset) are taken out first. Passwords are better in PGPASSWORD or ~/.pgpass.

    Raises
    ------
    SettingError
        The extra postgis is not installed, or the URL is none.
    InputError
        The map is not geo-referenced.
    OutputError
        The database cannot be reached, has no PostGIS, or refuses.
    """
    needs_places(export, "PostGIS")
    try:
        import psycopg
        from psycopg import sql
    except ImportError as error:
        raise SettingError(
            "export to PostGIS needs the extra named postgis", hint="pip install 'valuemap[postgis]'"
        ) from error
    address, schema, name = _parts(url, str(export.result.run.get("dataset", "map")))
    try:
        with psycopg.connect(address, connect_timeout=10) as connection, connection.cursor() as cursor:
            cursor.execute("SELECT 1 FROM pg_extension WHERE extname = 'postgis'")
            if cursor.fetchone() is None:
                cursor.execute("CREATE EXTENSION postgis")
            cursor.execute(sql.SQL("CREATE SCHEMA IF NOT EXISTS {}").format(sql.Identifier(schema)))
            for table, columns, rows in _tables(export):
                _replace(cursor, sql.Identifier(schema, table), table, columns, rows, name)
            if export.dataset is None:  # Cameras of an older export would not be those of this map.
                cursor.execute("SELECT to_regclass(%s)", (sql.Identifier(schema, "cameras").as_string(cursor),))
                found = cursor.fetchone()
                if found is not None and found[0] is not None:
                    cursor.execute(
                        sql.SQL("DELETE FROM {} WHERE map = %s").format(sql.Identifier(schema, "cameras")), (name,)
                    )
    except psycopg.Error as error:
        reason = " ".join(str(error).split()).partition(" DETAIL:")[0]
        raise OutputError(
            f"{without_password(address)}: cannot be written: {reason}",
            hint="is the server running, may this user create tables, is PostGIS installed there?",
        ) from error
    except UnicodeEncodeError as error:
        raise InputError(f"a text cannot be kept in a database: {error}", hint="repair the name") from error


def _replace(
    cursor: psycopg.Cursor[Any],
    identifier: Any,
    table: str,
    columns: dict[str, str],
    rows: Iterable[Sequence[Any]],
    name: str,
) -> None:
    """Replace the rows of one map in one table, which is made, or gets the columns that it lacks, first."""
    from psycopg import sql

    kinds = {"map": "text", **columns}
    definitions = sql.SQL(", ").join(
        sql.SQL("{} {}").format(sql.Identifier(column), sql.SQL(kind)) for column, kind in kinds.items()
    )
    cursor.execute(sql.SQL("CREATE TABLE IF NOT EXISTS {} ({})").format(identifier, definitions))
    for column, kind in kinds.items():
        cursor.execute(
            sql.SQL("ALTER TABLE {} ADD COLUMN IF NOT EXISTS {} {}").format(
                identifier, sql.Identifier(column), sql.SQL(kind)
            )
        )
    for number, index in enumerate(_INDEXES[table]):
        cursor.execute(
            sql.SQL("CREATE INDEX IF NOT EXISTS {} ON {} {}").format(
                sql.Identifier(f"{table}_{number}"), identifier, sql.SQL(index)
            )
        )
    cursor.execute(sql.SQL("DELETE FROM {} WHERE map = %s").format(identifier), (name,))
    names = sql.SQL(", ").join(map(sql.Identifier, kinds))
    with cursor.copy(sql.SQL("COPY {} ({}) FROM STDIN").format(identifier, names)) as copy:
        for row in rows:
            copy.write_row([_without_null(cell) for cell in (name, *row)])


_INDEXES = {
    "labels": ("(map, label_id)", "USING gist (geom)"),
    "votes": ("(map, label_id)", "(map, image_id)"),
    "cameras": ("(map, image_id)", "USING gist (geom)"),
}


def _tables(export: Export) -> list[tuple[str, dict[str, str], Iterable[Sequence[Any]]]]:
    """Return name, columns with their types, and rows of each table."""
    attributes = export.attributes
    kinds = {name: _kind(name, attributes[name].dtype) for name in attributes.columns}
    cells = [[plain(value) for value in attributes[name].tolist()] for name in attributes.columns]
    places = needs_places(export, "PostGIS").tolist()
    labels = {**kinds, "geom": "geometry(PointZ, 4326)"}
    tables: list[tuple[str, dict[str, str], Iterable[Sequence[Any]]]] = [
        ("labels", labels, ([*row, _point(place)] for *row, place in zip(*cells, places, strict=True)))
    ]
    votes = export.result.votes
    ids = (votes.label_id, votes.detection_id, votes.image_id)
    numbers = [column.tolist() for column in (*ids, votes.residual_px, votes.residual_sigmas)]
    columns = dict.fromkeys(("label_id", "detection_id", "image_id"), "bigint")
    columns |= dict.fromkeys(("residual_px", "residual_sigmas"), "double precision")
    tables.append(("votes", columns, zip(*numbers, strict=True)))
    if export.dataset is not None:
        tables.append(_cameras(export))
    return tables


def _cameras(export: Export) -> tuple[str, dict[str, str], Iterable[Sequence[Any]]]:
    assert export.dataset is not None
    assert export.result.frame.anchor is not None
    images = export.dataset.images
    places = lon_lat_height_from_enu(camera_centers(images), export.result.frame.anchor).tolist()
    times = [None] * len(images) if images.timestamp_s is None else iso_times(images.timestamp_s)
    columns = {
        "image_id": "bigint",
        "picture": "text",
        "pass": "text",
        "time": "timestamptz",
        "geom": "geometry(PointZ, 4326)",
    }
    rows = zip(images.image_id.tolist(), images.name.to_pylist(), images.pass_id.texts(), times, places, strict=True)
    return "cameras", columns, ([*row, _point(place)] for *row, place in rows)


def _kind(name: str, dtype: Any) -> str:
    if name.endswith("_time"):
        return _TYPES["time"]
    if np.issubdtype(getattr(dtype, "numpy_dtype", dtype) if not str(dtype).startswith("str") else object, np.integer):
        return _TYPES["int"]
    return _TYPES["float"] if str(dtype).startswith("float") else _TYPES["str"]


def _point(place: Sequence[float]) -> str:
    lon, lat, height = place
    return f"SRID=4326;POINT Z ({lon!r} {lat!r} {height!r})"


def _without_null(cell: Any) -> Any:
    """Return a cell without the one character that PostgreSQL's texts cannot hold."""
    return cell.replace("\0", "") if isinstance(cell, str) else cell


def _parts(url: str, default_name: str) -> tuple[str, str, str]:
    """Return the address for libpq, the schema and the name of the map."""
    address, _, query = url.partition("?")
    pairs = parse_qsl(query, keep_blank_values=True)
    ours = {key: value for key, value in pairs if key in ("schema", "map")}
    rest = urlencode([(key, value) for key, value in pairs if key not in ours], quote_via=quote)
    schema, name = ours.get("schema", _SCHEMA), ours.get("map", default_name)
    if not schema or not name or "\0" in schema + name:
        raise SettingError(f"{without_password(url)}: schema and map must have names", hint="for example ?schema=maps")
    return f"{address}?{rest}" if rest else address, schema, name


def without_password(url: str) -> str:
    """Return the URL of a database as it may be shown; a path stays as it is."""
    if not is_database(url):
        return url
    address = url.partition("?")[0]
    scheme, _, place = address.partition("://")
    user, at, host = place.rpartition("@")
    return f"{scheme}://{user.partition(':')[0]}{at}{host}"
