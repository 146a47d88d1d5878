"""The local frame and WGS84: against PROJ's own steps, against known geometry, and there and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import CRS, Transformer
from pyproj.datadir import get_user_data_dir  # type: ignore[attr-defined]

from valuemap.arrays import Floats
from valuemap.dataset import Frame
from valuemap.errors import InputError, SettingError
from valuemap.geodesy import (
    accuracy_note,
    crs_from_lon_lat_height,
    degrees_outside,
    enu_from_lon_lat_height,
    lon_lat_height_from_crs,
    lon_lat_height_from_enu,
    with_heights,
)

ANCHORS = [
    (51.5, -0.14, 35.0),
    (37.7749, -122.4194, 16.0),
    (-33.87, 151.21, 0.0),
    (0.0, 0.0, 0.0),
    (64.1, -21.9, 1500.0),
    (-16.5, 179.9999, 10.0),
    (89.9, 45.0, 0.0),
]
EQUATOR_RADIUS_M = 6378137.0


def random_positions(count: int = 200, extent_m: float = 20_000.0) -> Floats:
    random = np.random.default_rng(5)
    return random.uniform(-1.0, 1.0, (count, 3)) * [extent_m, extent_m, 300.0]


def enu_by_hand(lon_lat_height: Floats, anchor: tuple[float, float, float]) -> Floats:
    """Earth-centred coordinates by pyproj, turned and shifted by the textbook's matrix."""
    to_earth_centred = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    points = np.stack(to_earth_centred.transform(*lon_lat_height.T), axis=1)
    lat, lon, height = anchor
    origin = np.array(to_earth_centred.transform(lon, lat, height))
    phi, lam = np.radians(lat), np.radians(lon)
    enu_from_earth = np.array(
        [
            [-np.sin(lam), np.cos(lam), 0.0],
            [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)],
            [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)],
        ]
    )
    return np.asarray((points - origin) @ enu_from_earth.T)


@pytest.mark.parametrize("anchor", ANCHORS)
def test_positions_survive_the_way_there_and_back(anchor: tuple[float, float, float]) -> None:
    positions = random_positions()
    back = enu_from_lon_lat_height(lon_lat_height_from_enu(positions, anchor), anchor)
    assert_allclose(back, positions, rtol=0, atol=1e-6)


@pytest.mark.parametrize("anchor", ANCHORS)
def test_the_local_frame_is_that_of_the_textbook(anchor: tuple[float, float, float]) -> None:
    places = lon_lat_height_from_enu(random_positions(), anchor)
    assert_allclose(enu_from_lon_lat_height(places, anchor), enu_by_hand(places, anchor), rtol=0, atol=1e-6)


@pytest.mark.parametrize("anchor", ANCHORS)
def test_the_anchor_is_the_origin(anchor: tuple[float, float, float]) -> None:
    lat, lon, height = anchor
    assert_allclose(lon_lat_height_from_enu(np.zeros((1, 3)), anchor), [[lon, lat, height]], rtol=0, atol=1e-7)
    assert_allclose(enu_from_lon_lat_height(np.array([[lon, lat, height]]), anchor), 0.0, atol=1e-8)


def test_x_is_east_y_is_north_z_is_up() -> None:
    """At the equator one metre east is 1/a radians of longitude; north and up have their own signs."""
    east, north, up = lon_lat_height_from_enu(np.eye(3), (0.0, 0.0, 0.0))
    assert_allclose(east, [np.degrees(1.0 / EQUATOR_RADIUS_M), 0.0, 0.0], rtol=1e-6, atol=1e-6)
    assert east[0] > 8.9e-6
    assert north[1] > 8.9e-6
    assert abs(north[0]) < 1e-12
    assert_allclose(up, [0.0, 0.0, 1.0], rtol=0, atol=1e-8)


def test_a_map_may_cross_the_date_line() -> None:
    place = lon_lat_height_from_enu(np.array([[100.0, 0.0, 0.0]]), (-16.5, 179.9999, 10.0))
    assert -180.0 <= place[0, 0] < -179.9


def test_no_positions_are_no_places() -> None:
    assert lon_lat_height_from_enu(np.empty((0, 3)), ANCHORS[0]).shape == (0, 3)


def test_an_anchor_may_be_of_numpy_numbers() -> None:
    anchor = tuple(np.array(ANCHORS[0]))
    assert_allclose(lon_lat_height_from_enu(np.zeros((1, 3)), anchor), [[-0.14, 51.5, 35.0]], rtol=0, atol=1e-8)


def test_a_place_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="has no place on the ellipsoid") as refusal:
        enu_from_lon_lat_height(np.array([[0.0, 95.0, 0.0]]), ANCHORS[0])
    assert "x east, y north, z up" in refusal.value.hint


@pytest.mark.parametrize(
    "anchor", [(91.0, 0.0, 0.0), (0.0, 361.0, 0.0), (0.0, 0.0, float("inf")), (float("nan"), 0.0, 0.0)]
)
def test_an_anchor_that_is_no_place_is_refused(anchor: tuple[float, float, float]) -> None:
    for use in (lambda: enu_from_lon_lat_height(np.zeros((1, 3)), anchor), lambda: Frame(anchor=anchor)):
        with pytest.raises(InputError, match="expected a latitude from -90 to 90") as refusal:
            use()
        assert "latitude comes first" in refusal.value.hint


def test_heights_stay_where_a_system_has_none_of_its_own() -> None:
    """The ellipsoid of Airy, below EPSG:27700, lies some 46 m from that of WGS84 in London."""
    place = np.array([[-0.14, 51.5, 39.0]])
    found = crs_from_lon_lat_height(place, "EPSG:27700")
    assert found[0] == pytest.approx([529_203.0, 179_535.6, 39.0], abs=5.0)
    assert found[0, 2] == 39.0
    assert_allclose(lon_lat_height_from_crs(found, "EPSG:27700"), place, atol=1e-7)


def test_a_missing_grid_is_told() -> None:
    note = accuracy_note("EPSG:27700")
    assert note is None or "EPSG:27700: positions are good to 2 m" in note  # None where somebody installed the grid.
    assert accuracy_note("EPSG:32630") is None
    of_many_lines = accuracy_note(CRS("EPSG:27700").to_wkt(pretty=True))
    assert of_many_lines == (note and note.replace("EPSG:27700", "OSGB36 / British National Grid"))


# Heights above the sea.

PROJ_DATA = Path(get_user_data_dir())


def test_heights_count_from_a_zero_given_in_metres() -> None:
    assert with_heights("EPSG:25832", None) == ("EPSG:25832", 0.0)
    assert with_heights(None, "47.25") == ("EPSG:4326", 47.25)


@pytest.mark.parametrize(
    ("crs", "vertical", "said"),
    [
        (None, "5773", "expected at most 150 m, or a system such as EPSG:5773"),
        (None, "nan", "expected at most 150 m"),
        (None, "EPSG:25832", "is no vertical system"),
        (None, "EPSG:7405", "is no vertical system"),
        (None, "EPSG:1", "there is no such system"),
        ("EPSG:4979", "40", "EPSG:4979 has heights of its own"),
        ("EPSG:7405", "40", "EPSG:7405 has heights of its own"),
        ("EPSG:5701", "40", "ODN height is a vertical system"),
        ("EPSG:nothing", "40", "there is no such system"),
    ],
)
def test_what_heights_cannot_count_from(crs: str | None, vertical: str, said: str) -> None:
    with pytest.raises(SettingError, match=said) as refusal:
        with_heights(crs, vertical)
    assert refusal.value.hint


@pytest.mark.parametrize(
    ("crs", "vertical", "hint"),
    [
        ("EPSG:7405", "47", "leave --vertical away, or give --crs EPSG:27700 with it"),
        ("EPSG:4979", "47", "leave --vertical away, or give --crs EPSG:4326 with it"),
        ("EPSG:4978", "47", "leave --vertical away, or give --crs EPSG:4326 with it"),
        ("EPSG:5701", None, "give it as --vertical, and a horizontal system as --crs"),
        ("EPSG:5773", None, "give it as --vertical, and a horizontal system as --crs"),
        ("EPSG:99999", None, "for example EPSG:32610"),
    ],
)
def test_what_to_do_about_a_system_is_said_of_that_system(crs: str, vertical: str | None, hint: str) -> None:
    with pytest.raises(SettingError) as refusal:
        crs_from_lon_lat_height(np.array([[-0.14, 51.5, 100.0]]), with_heights(crs, vertical)[0] or "")
    assert refusal.value.hint == hint


def test_a_system_whose_heights_need_a_grid_names_its_horizontal_part() -> None:
    if PROJ_DATA.is_absolute() and any(PROJ_DATA.rglob("uk_os_OSGM15_GB.tif")):
        pytest.skip("PROJ has the grid")
    with pytest.raises(SettingError, match="cannot be brought to WGS84: Grid") as refusal:
        crs_from_lon_lat_height(np.array([[-0.14, 51.5, 100.0]]), "EPSG:7405")
    assert "give --crs EPSG:27700 and --vertical with the metres" in refusal.value.hint


def test_heights_of_a_vertical_system_need_its_grid() -> None:
    """In London the geoid EGM96 lies 46 m above the ellipsoid; where PROJ lacks the grid, that is one line."""
    if PROJ_DATA.is_absolute() and any(PROJ_DATA.rglob("us_nga_egm96_15.tif")):
        system, zero_m = with_heights("EPSG:32630", "EPSG:5773")
        assert system is not None
        assert zero_m == 0.0
        place = np.array([[-0.14, 51.5, 100.0]])
        assert crs_from_lon_lat_height(place, system)[0, 2] == pytest.approx(100.0 - 46.0, abs=1.5)
        return
    for crs in (None, "EPSG:32630"):  # With the first PROJ has a system of its own, EPSG:9707.
        with pytest.raises(SettingError) as refusal:
            with_heights(crs, "EPSG:5773")
        assert str(refusal.value) == (
            "vertical EPSG:5773: its heights cannot be brought to the ellipsoid: "
            "Grid us_nga_egm96_15.tif is not available"
        )
        assert "--vertical in metres" in refusal.value.hint


@pytest.mark.parametrize(
    ("crs", "outside"),
    [
        ("EPSG:32632", [0.0, 0.5, 1.0, 4.0, 172.0]),  # 6 to 12 E, 0 to 84 N.
        ("EPSG:32632+5773", [0.0, 0.5, 1.0, 4.0, 172.0]),
        ("EPSG:3832", [80.0, 80.5, 75.0, 80.0, 0.0]),  # 98.69 E to 68 W, across the date line.
        ("EPSG:4326", [0.0] * 5),
        ("+proj=utm +zone=32", None),
    ],
)
def test_how_far_places_are_from_where_a_system_is_for(crs: str, outside: list[float] | None) -> None:
    lon_lat = [[12.0, 50.0], [12.5, 50.0], [7.0, -1.0], [12.0, -4.0], [-176.0, 50.0]]
    found = degrees_outside(np.array([[*each, 0.0] for each in lon_lat]), crs)
    assert (None if found is None else found.round(9).tolist()) == outside
