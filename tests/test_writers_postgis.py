"""Export to PostGIS, to a server that these tests start; skipped where PostgreSQL with PostGIS is not installed."""

from __future__ import annotations

import dataclasses
import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

from small_dataset import ANCHOR, map_of, small_dataset
from valuemap.dataset import Frame
from valuemap.errors import InputError, OutputError
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import Map
from valuemap.tables import Votes
from valuemap.writers import export_map, without_password

psycopg = pytest.importorskip("psycopg", reason="the extra postgis is not installed")

POSITIONS = np.array([[4.0, 25.0, 5.0], [12.0, 20.0, 2.0]])


def _programs() -> Path | None:
    """Return the folder of the newest PostgreSQL that has PostGIS."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name), reverse=True)
    for folder in folders:
        has_postgis = Path(f"/usr/share/postgresql/{folder.parent.name}/extension/postgis.control").is_file()
        if has_postgis and (folder / "initdb").is_file():
            return folder
    return None


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Start a server that only listens in a folder of its own; yield the URL of a database."""
    programs = _programs()
    if programs is None:
        why = "PostgreSQL with PostGIS is not installed: apt-get install postgresql postgis"
        if "postgis" in os.environ.get("EXTRAS", "").split():
            pytest.fail(why)
        pytest.skip(why)
    # It does not run as root.
    user = "postgres" if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name
    folder = Path(tempfile.mkdtemp(prefix="pg"))  # Short: the name of a socket must be.
    try:
        if os.geteuid() == 0:
            shutil.chown(folder, user)
        run: dict[str, Any] = {
            "user": user if os.geteuid() == 0 else None,
            "cwd": folder,
            "check": True,
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
        }
        subprocess.run(
            [
                str(programs / "initdb"),
                "-D",
                str(folder / "data"),
                "-U",
                "tester",
                "-A",
                "trust",
                "-E",
                "UTF8",
                "--no-sync",
            ],
            **run,
        )
        options = f"-c listen_addresses='' -c unix_socket_directories='{folder}' -c fsync=off"
        control = [str(programs / "pg_ctl"), "-D", str(folder / "data"), "-w"]
        subprocess.run([*control, "-o", options, "-l", str(folder / "log"), "start"], **run)
        try:
            yield f"postgresql://tester@/postgres?host={quote(str(folder), safe='')}"
        finally:
            subprocess.run([*control, "-m", "immediate", "stop"], **run)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def url(server: str) -> Iterator[str]:
    """Yield the URL of the server, whose database is emptied afterwards."""
    yield server
    with psycopg.connect(server) as connection:
        connection.execute("DROP SCHEMA IF EXISTS valuemap, other CASCADE")


def a_map(name: str = "small") -> Map:
    result = map_of(
        POSITIONS,
        ["light", 'it\'s; DROP TABLE \0\\N\t"sign"'],
        frame=Frame(anchor=ANCHOR),
        lon_lat_height=lon_lat_height_from_enu(POSITIONS, ANCHOR),
        run={"dataset": name},
    )
    votes = Votes(
        label_id=np.array([0, 0, 1]),
        detection_id=np.array([100, 101, 102]),
        image_id=small_dataset().detections.image_id[:3],
        residual_px=np.array([1.0, 2.0, 3.0]),
        residual_sigmas=np.array([0.5, 1.0, 1.5]),
    )
    return dataclasses.replace(result, votes=votes, labels=result.labels.replace(last_seen_s=np.full(2, 1.7e9)))


def rows(url: str, query: str) -> list[tuple[Any, ...]]:
    with psycopg.connect(url) as connection:
        return list(connection.execute(query).fetchall())


def test_postgis_has_labels_votes_and_cameras(url: str) -> None:
    export_map(a_map(), url, dataset=small_dataset(Frame(anchor=ANCHOR)))
    found = rows(url, "SELECT label_id, class, sigma_m, last_seen_time, picture_1 FROM valuemap.labels ORDER BY 1")
    assert [row[:2] for row in found] == [(0, "light"), (1, 'it\'s; DROP TABLE \\N\t"sign"')]
    assert found[0][2] == pytest.approx(np.hypot(0.2, 0.1))
    assert found[0][3].isoformat() == "2023-11-14T22:13:20+00:00" or found[0][3].timestamp() == 1.7e9
    assert found[0][4] == "a/1.jpg"
    places = rows(
        url, "SELECT ST_X(geom), ST_Y(geom), ST_Z(geom), ST_SRID(geom) FROM valuemap.labels ORDER BY label_id"
    )
    assert [row[:3] for row in places] == [tuple(row) for row in lon_lat_height_from_enu(POSITIONS, ANCHOR).tolist()]
    assert {row[3] for row in places} == {4326}
    assert rows(url, "SELECT label_id, detection_id FROM valuemap.votes ORDER BY 2") == [(0, 100), (0, 101), (1, 102)]
    assert rows(url, "SELECT picture FROM valuemap.cameras ORDER BY image_id")[0] == ("a/1.jpg",)
    assert rows(url, "SELECT first_seen FROM valuemap.labels") == [(None,), (None,)]


def test_done_twice_it_is_the_same_and_other_maps_stay(url: str) -> None:
    dataset = small_dataset(Frame(anchor=ANCHOR))
    export_map(a_map("one"), url, dataset=dataset)
    export_map(a_map("two"), url)
    for _ in range(2):
        export_map(a_map("one"), url, dataset=dataset)
    counts = "SELECT map, count(*) FROM valuemap.{} GROUP BY map ORDER BY map"
    assert rows(url, counts.format("labels")) == [("one", 2), ("two", 2)]
    assert rows(url, counts.format("votes")) == [("one", 3), ("two", 3)]
    assert rows(url, counts.format("cameras")) == [("one", 4)]
    export_map(a_map("one"), url)
    assert rows(url, counts.format("cameras")) == []


def test_schema_and_name_may_be_given(url: str) -> None:
    export_map(a_map(), f"{url}&schema=other&map=my+map")
    assert rows(url, "SELECT DISTINCT map FROM other.labels") == [("my map",)]
    assert rows(url, "SELECT to_regclass('valuemap.labels')") == [(None,)]


def test_what_goes_wrong_leaves_the_database_as_it_was(url: str) -> None:
    export_map(a_map(), url)
    rows_before = rows(url, "SELECT label_id FROM valuemap.labels")
    with psycopg.connect(url) as connection:
        connection.execute("ALTER TABLE valuemap.votes ADD CHECK (residual_px < 10)")
    votes = a_map().votes
    worse = dataclasses.replace(a_map(), votes=votes.replace(residual_px=votes.residual_px + 10.0))
    worse = dataclasses.replace(worse, labels=worse.labels.take(np.array([0])))
    with pytest.raises(OutputError, match="cannot be written"):
        export_map(worse, url)
    assert rows(url, "SELECT label_id FROM valuemap.labels") == rows_before


def test_a_table_of_an_older_export_gets_the_columns_it_lacks(url: str) -> None:
    export_map(a_map(), url)  # Without pictures.
    export_map(a_map("new"), url, dataset=small_dataset(Frame(anchor=ANCHOR)))
    assert rows(url, "SELECT map, picture_1 FROM valuemap.labels WHERE label_id = 0 ORDER BY map") == [
        ("new", "a/1.jpg"),
        ("small", None),
    ]


def test_places_are_found_by_an_index(url: str) -> None:
    export_map(a_map(), url)
    indexes = rows(url, "SELECT indexdef FROM pg_indexes WHERE schemaname = 'valuemap' AND tablename = 'labels'")
    assert any("gist (geom)" in text for (text,) in indexes)
    lon, lat, _ = lon_lat_height_from_enu(POSITIONS, ANCHOR)[0]
    near = f"ST_DWithin(geom::geography, ST_SetSRID(ST_MakePoint({lon}, {lat}), 4326)::geography, 1)"
    assert rows(url, f"SELECT label_id FROM valuemap.labels WHERE {near}") == [(0,)]


def test_a_server_that_is_not_there_is_one_line_without_the_password() -> None:
    with pytest.raises(OutputError, match="cannot be written") as refusal:
        export_map(a_map(), "postgresql://me:secret@127.0.0.1:1/none")
    assert "secret" not in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_postgis_needs_a_geo_reference() -> None:
    with pytest.raises(InputError, match="the map is not geo-referenced, and PostGIS"):
        export_map(map_of(POSITIONS), "postgresql://localhost/none")


def test_a_url_is_shown_without_its_password() -> None:
    assert without_password("postgresql://me:secret@host:5432/maps?password=x") == "postgresql://me@host:5432/maps"
    assert without_password("maps/a?b.csv") == "maps/a?b.csv"
