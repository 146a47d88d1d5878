"""Tables of the user's own: poses, headings, map projections and bearings, against geometry done by hand."""

from __future__ import annotations

import math
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import Transformer
from typer.testing import CliRunner

from reading import SPOILS, azimuths_deg, meeting_point, refusal, spoiled, write
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, cast_rays, rotation_matrices
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, read_dataset, write_dataset
from valuemap.errors import InputError, SettingError
from valuemap.evaluate import evaluate_map
from valuemap.geodesy import accuracy_note
from valuemap.pipeline import build_map
from valuemap.readers.bearings import VERTICAL_SIGMA_PX, read_bearings
from valuemap.readers.csv_poses import read_csv_poses
from valuemap.readers.detections import DetectionFile
from valuemap.readers.panoramax import read_panoramax

DATA = Path(__file__).parents[2] / "shared" / "data"
CAMERA = "PINHOLE 640 480 500 500 320 240"
# At these places two positions 1e-5 degrees apart are 1.1132 m (east, at the equator) and 1.1057 m (north) apart.
DEGREE_EAST_M, DEGREE_NORTH_M = 111319.4908, 110574.2758


def poses_of(folder: Path, header: str, *rows: str) -> Path:
    return write(folder / "poses.csv", "\n".join([header, *rows]) + "\n")


def boxes_of(folder: Path, *boxes: tuple[str, float, float]) -> Path:
    lines = [f"{image},{x - 5},{y - 10},{x + 5},{y + 10},light" for image, x, y in boxes]
    return write(folder / "boxes.csv", "\n".join(["image,x1,y1,x2,y2,class", *lines]) + "\n")


def test_a_heading_counts_clockwise_from_north_and_right_of_it_is_more(tmp_path: Path) -> None:
    """A box one focal length right of the middle is 45 degrees clockwise of the heading."""
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", "a.jpg,0,0,90", "b.jpg,0.0001,0,350")
    boxes = boxes_of(tmp_path, ("a.jpg", 320, 240), ("a.jpg", 620, 240), ("b.jpg", 620, 240))
    dataset = read_csv_poses(poses, camera=CAMERA, detections=boxes)
    right = np.degrees(np.arctan2(300.0, 500.0))
    assert_allclose(azimuths_deg(dataset), [90.0, 90.0 + right, 350.0 + right - 360.0], atol=1e-9)
    assert_allclose(cast_rays(dataset).direction_in_world[:, 2], 0.0, atol=1e-5)
    assert dataset.frame.anchor == (0.0, 0.0, 0.0)
    assert_allclose(camera_centers(dataset.images)[1], [0.0, 1e-4 * DEGREE_NORTH_M, 0.0], atol=1e-4)


@pytest.mark.parametrize(
    ("omega_phi_kappa", "heading_pitch_roll"),
    [
        ("90,0,0", "0,0,0"),
        ("90,-30,0", "30,0,0"),
        ("100,0,0", "0,10,0"),
        ("90,0,-5", "0,0,5"),
        ("0,0,0", "0,-90,0"),
        ("0,0,-20", "20,-90,0"),
    ],
)
def test_omega_phi_kappa_are_the_angles_of_photogrammetry(
    omega_phi_kappa: str, heading_pitch_roll: str, tmp_path: Path
) -> None:
    """About x, the new y and the new z of a camera with x right, y up in the picture, z back: derived on paper."""
    photo = poses_of(tmp_path / "1", "image,lat,lon,omega_deg,phi_deg,kappa_deg", f"a.jpg,0,0,{omega_phi_kappa}")
    level = poses_of(tmp_path / "2", "image,lat,lon,heading_deg,pitch_deg,roll_deg", f"a.jpg,0,0,{heading_pitch_roll}")
    found, expected = (rotation_matrices(read_csv_poses(poses, camera=CAMERA).images) for poses in (photo, level))
    assert_allclose(found, expected, atol=1e-12)


def test_an_orientation_is_said_in_one_way(tmp_path: Path) -> None:
    poses = poses_of(tmp_path, "image,x,y,omega_deg,phi_deg,kappa_deg,yaw_deg", "a.jpg,0,0,90,0,0,0")
    assert "has both omega, phi, kappa and yaw_deg" in refusal(lambda: read_csv_poses(poses, camera=CAMERA))


def test_images_placed_by_latitude_and_longitude_may_be_far_from_each_other(tmp_path: Path) -> None:
    """The frame of most images holds those on another continent, too, and they are told."""
    told: list[str] = []
    rows = ("a.jpg,52,4,1", "b.jpg,40,-74,1", "c.jpg,40,-74.0001,1")
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", *rows)
    images = read_csv_poses(poses, camera=CAMERA, tell=told.append).images
    assert np.linalg.norm(camera_centers(images)[0]) > 5e6
    assert len(told) == 1
    assert "1 of 3 images are far from the others, such as 'a.jpg' at lat 52.00, lon 4.00" in told[0]


@pytest.mark.parametrize("lat", [52.5, 5.6])
def test_images_without_a_fix_are_not_the_origin(lat: float, tmp_path: Path) -> None:
    """At 5.6 degrees north, up is hardly another than at 0, 0."""
    header, rows = "image,lat,lon,heading_deg", [f"{name}.jpg,{lat},{0.2 + i / 1e4},0" for i, name in enumerate("edcb")]
    for order in (rows, rows[::-1]):
        told: list[str] = []
        poses = poses_of(tmp_path, header, "a.jpg,0,0,0", *order)
        dataset = read_csv_poses(poses, camera=CAMERA, tell=told.append)
        assert dataset.frame.anchor == (lat, 0.2003, 0.0)
        assert ["'a.jpg' at lat 0.00, lon 0.00" in line for line in told] == [True]
    if lat > 10.0:  # Where only one is that has no fix.
        said = refusal(lambda: read_csv_poses(poses, camera=CAMERA, anchor=(0.0, 0.0, 0.0)))
        assert "anchor: expected a place near the images" in said


def test_bearings_without_a_fix_are_not_the_origin(tmp_path: Path) -> None:
    told: list[str] = []
    rows = ("0,0,10", "52.5,13.4,20", "52.5001,13.4,20", "52.5002,13.4,30")
    bearings = write(tmp_path / "bearings.csv", "\n".join(["lat,lon,bearing", *rows]) + "\n")
    assert read_bearings(bearings, tell=told.append).frame.anchor == (52.5, 13.4, 0.0)
    assert len(told) == 1


def test_cameras_that_look_up_are_told(tmp_path: Path) -> None:
    """The pitch of Metashape counts from straight down: that of a camera on a car is about 90."""
    told: list[str] = []
    header = "image,lat,lon,heading_deg,pitch_deg"
    read_csv_poses(poses_of(tmp_path, header, "a.jpg,0,0,0,10"), camera=CAMERA, tell=told.append)
    assert told == []
    rows = ("a.jpg,0,0,0,88", "b.jpg,0,0.0001,0,92", "c.jpg,0,0.0002,0,90")
    read_csv_poses(poses_of(tmp_path, header, *rows), camera=CAMERA, tell=told.append)
    assert len(told) == 1
    assert "cameras look 90 degrees above the horizon" in told[0]


def test_up_is_z_where_angles_say_how_cameras_are_turned(tmp_path: Path) -> None:
    """Pictures on their side, as of a telephone, and cameras that look down have their own up elsewhere."""
    for angles in ("0,90", "-90,0", "20,0"):
        poses = poses_of(tmp_path, "image,x,y,heading_deg,pitch_deg,roll_deg", f"a.jpg,0,0,0,{angles}")
        assert read_csv_poses(poses, camera=CAMERA).frame.up == (0.0, 0.0, 1.0)
        assert read_csv_poses(poses, camera=CAMERA, up=(0.0, 2.0, 0.0)).frame.up == (0.0, 1.0, 0.0)
        assert read_csv_poses(poses, camera=CAMERA, anchor=(52.0, 4.0, 0.0)).frame.anchor == (52.0, 4.0, 0.0)


def test_a_map_projection_that_counts_to_the_west_is_refused(tmp_path: Path) -> None:
    """That of Cape Town counts to the west and south: its y is no north that a heading could count from."""
    poses = poses_of(tmp_path, "image,x,y,heading_deg", "a.jpg,55496,3752730,0")
    said = refusal(lambda: read_csv_poses(poses, camera=CAMERA, crs="EPSG:2048"))
    assert "crs EPSG:2048: expected a system of eastings and northings, found axes to the west and south" in said


def test_an_anchor_elsewhere_on_the_earth_is_refused(tmp_path: Path) -> None:
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", "a.jpg,52,4,0")
    said = refusal(lambda: read_csv_poses(poses, camera=CAMERA, anchor=(4.0, 52.0, 0.0)))
    assert "anchor: expected a place near the images, as at 52 4, found 4 52" in said
    assert read_csv_poses(poses, camera=CAMERA, anchor=(52.5, 5.0, 0.0)).frame.anchor == (52.5, 5.0, 0.0)


@pytest.mark.parametrize(
    ("header", "row", "said", "hint"),
    [
        ("lat,lon,heading_deg", "52°30'N,4,0", 'lat: expected a number, found "52°30\'N"', "decimal degrees"),
        ("lat,lon,heading_deg", "52,4,north", "heading_deg: expected a number, found 'north'", "plain numbers"),
        ("lat,lon,height,heading_deg", "52,4,,0", "height: expected a number, found none", "--camera-height"),
        ("x,y,heading_deg", "12 m,4,0", "x: expected a number, found '12 m'", "metres"),
        ("lat,lon,heading_deg,fx,cx,cy,width_px,height_px", '52,4,0,"1,500",1,1,9,9', "found '1,500' (2 rows)", ""),
    ],
)
def test_a_column_without_any_number_is_named_with_what_it_has(
    tmp_path: Path, header: str, row: str, said: str, hint: str
) -> None:
    poses = poses_of(tmp_path, f"image,{header}", f"a.jpg,{row}", f"b.jpg,{row}")
    with pytest.raises(InputError) as caught:
        read_csv_poses(poses, camera=None if "fx" in header else CAMERA)
    assert f"poses.csv line 2: {said.partition(':')[0] if hint else 'fx'}" in str(caught.value)
    assert said in str(caught.value)
    assert hint in caught.value.hint


def test_a_depth_that_is_no_number_is_not_lost_in_silence(tmp_path: Path) -> None:
    rows = ["lat,lon,bearing,depth", *["52,4,10,12"] * 1, "52,4,20,-", "52,4,30,", "52,4,40,12 m"]
    path = write(tmp_path / "bearings.csv", "\n".join(rows) + "\n")
    dataset = read_bearings(path, max_rejected=0.5)
    assert len(dataset.detections) == 3
    assert dataset.detections.range_m is not None
    assert_allclose(dataset.detections.range_m, [12.0, np.nan, np.nan])
    with pytest.raises(InputError, match="1 of 4 boxes cannot be used"):
        read_bearings(path)


@pytest.mark.parametrize(
    ("column", "value"),
    [("heading_deg", 210.0), ("heading_rad", np.radians(210)), ("yaw_deg", -120.0), ("yaw_rad", -np.radians(120))],
)
def test_a_heading_may_be_given_in_four_ways(tmp_path: Path, column: str, value: float) -> None:
    poses = poses_of(tmp_path, f"image,lat,lon,{column}", f"a.jpg,0,0,{float(value)!r}")
    dataset = read_csv_poses(poses, camera=CAMERA, detections=boxes_of(tmp_path, ("a.jpg", 320, 240)))
    assert_allclose(azimuths_deg(dataset), 210.0, atol=1e-9)


def test_pitch_is_up_and_roll_turns_the_right_side_down(tmp_path: Path) -> None:
    """The middle of a picture pitched up by 30 degrees; the right of one that is rolled by a quarter turn is below."""
    poses = poses_of(
        tmp_path, "image,lat,lon,heading_deg,pitch_deg,roll_deg", "a.jpg,0,0,0,30,0", "b.jpg,0.0001,0,0,0,90"
    )
    boxes = boxes_of(tmp_path, ("a.jpg", 320, 240), ("b.jpg", 620, 240))
    pitched, rolled = cast_rays(read_csv_poses(poses, camera=CAMERA, detections=boxes)).direction_in_world
    assert_allclose(pitched, [0.0, np.cos(np.pi / 6), np.sin(np.pi / 6)], atol=1e-9)
    assert_allclose(rolled, np.array([0.0, 500.0, -300.0]) / np.hypot(500.0, 300.0), atol=1e-5)


@pytest.mark.parametrize(("roll", "y"), [(90, -1.0), (180, 0.0)])
def test_all_cameras_may_be_turned_where_angles_say_so(tmp_path: Path, roll: int, y: float) -> None:
    """Pictures taken upright, or upside down: their own up says nothing about the frame."""
    rows = [f"{name}.jpg,52.000{name},4,0,{roll}" for name in "12"]
    dataset = read_csv_poses(poses_of(tmp_path, "image,lat,lon,heading_deg,roll_deg", *rows), camera=CAMERA)
    assert_allclose(rotation_matrices(dataset.images)[0, 0, 2], y, atol=1e-9)  # The picture's right, in the world.


def test_quaternions_of_both_directions_and_of_other_axes(tmp_path: Path) -> None:
    """A camera that looks along x with z up: x right of it is -y, down is -z. By hand: w x y z = (1, -1, 1, -1) / 2."""
    boxes = boxes_of(tmp_path, ("a.jpg", 620, 140))
    expected = np.array([500.0, -300.0, 100.0]) / np.linalg.norm([500.0, 300.0, 100.0])
    for rotation, quaternion, axes in (
        ("world_from_cam", (0.5, -0.5, 0.5, -0.5), "right-down-forward"),
        ("cam_from_world", (0.5, 0.5, -0.5, 0.5), "right-down-forward"),
        ("world_from_cam", (1, 0, 0, 0), "forward-left-up"),
        ("world_from_cam", (0.5, 0.5, -0.5, -0.5), "right-up-back"),
    ):
        poses = poses_of(tmp_path, "image,x,y,z,qw,qx,qy,qz", f"a.jpg,3,4,5,{','.join(map(str, quaternion))}")
        dataset = read_csv_poses(poses, camera=CAMERA, detections=boxes, rotation=rotation, axes=axes, up=(0, 0, 1))
        assert_allclose(cast_rays(dataset).direction_in_world[0], expected, atol=1e-12, err_msg=f"{rotation} {axes}")
        assert_allclose(camera_centers(dataset.images)[0], [3, 4, 5], atol=1e-12)


def test_a_heading_in_a_map_projection_is_that_of_its_grid(tmp_path: Path) -> None:
    """At 60 N, 3 degrees east of the middle of zone 32, grid north is 3 sin(60) = 2.60 degrees clockwise of north."""
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    east, north = to_utm.transform(12.0, 60.0)
    poses = poses_of(
        tmp_path, "image,x,y,heading_deg", f"a.jpg,{east!r},{north!r},0", f"b.jpg,{east!r},{north + 100!r},90"
    )
    dataset = read_csv_poses(
        poses, camera=CAMERA, detections=boxes_of(tmp_path, ("a.jpg", 320, 240), ("b.jpg", 320, 240)), crs="EPSG:32632"
    )
    assert dataset.frame.anchor is not None
    assert_allclose(dataset.frame.anchor[:2], (60.0, 12.0), atol=1e-9)
    convergence = 3.0 * np.sin(np.radians(60.0))
    assert_allclose(azimuths_deg(dataset), [convergence, 90.0 + convergence], atol=0.01)
    step = np.diff(camera_centers(dataset.images), axis=0)[0]
    assert_allclose(np.degrees(np.arctan2(step[0], step[1])), convergence, atol=0.01)
    # On the map 3 degrees off the middle is stretched: 0.9996 (1 + (east - 500 km)² / 2 R²) = 0.99994.
    assert_allclose(np.linalg.norm(step), 100.0 / 0.99994, atol=1e-3)


@pytest.mark.parametrize(
    ("crs", "x", "y", "step", "said", "hint"),
    [
        ("EPSG:32632", 691000.0, 5335000.0, 10.0, "lat 4.79, lon 48.94", "x is the easting, y the northing"),
        ("EPSG:4258", 11.5, 48.1, 1e-4, "lat 11.5, lon 48.1", "x is the longitude, y the latitude"),
    ],
)
def test_exchanged_eastings_and_northings_are_far_from_where_the_system_is_for(
    tmp_path: Path, crs: str, x: float, y: float, step: float, said: str, hint: str
) -> None:
    """An image without a fix, at 0, 0, says nothing about the others."""
    header, lost = "image,x,y,heading_deg", "c.jpg,0,0,0"
    rows = [f"a.jpg,{y},{x},0", f"b.jpg,{y},{x + step},0", lost]
    with pytest.raises(InputError, match=f"crs {crs}: positions are at {said}, .* degrees outside the area") as error:
        read_csv_poses(poses_of(tmp_path, header, *rows), camera=CAMERA, crs=crs)
    assert error.value.hint == f"{hint}: are they exchanged?"
    right = [f"a.jpg,{x},{y},0", f"b.jpg,{x},{y + step},0", lost]
    told: list[str] = []
    assert len(read_csv_poses(poses_of(tmp_path, header, *right), camera=CAMERA, crs=crs, tell=told.append).images) == 3
    assert len(told) == 1
    assert re.search(r"'c.jpg' at lat -?0.00, lon [04].[05][01]: had the receiver no fix", told[0])


def test_a_system_of_all_of_a_country_may_be_used_outside_of_its_zone(tmp_path: Path) -> None:
    """The east of Norway is in zone 33 by law."""
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:25833", always_xy=True).transform(30.6, 69.9)
    poses = poses_of(tmp_path, "image,x,y,heading_deg", f"a.jpg,{x!r},{y!r},0", f"b.jpg,{x!r},{y + 10.0!r},0")
    told: list[str] = []
    assert len(read_csv_poses(poses, camera=CAMERA, crs="EPSG:25833", tell=told.append).images) == 2
    (line,) = told
    said = "crs EPSG:25833: positions are at lat 69.9, lon 30.6, 13 degrees outside the area it is made for"
    assert line == said
    arguments = ["import", "csv", str(poses), "--crs", "EPSG:25833", "--camera", CAMERA]
    assert f"note: {said}\n" in CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "d")]).stderr
    britain = poses_of(tmp_path, "image,x,y,heading_deg", "a.jpg,530000,180000,0", "b.jpg,530000,180010,0")
    arguments = ["import", "csv", str(britain), "--crs", "EPSG:27700", "--camera", CAMERA]
    done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "e")])
    assert f"note: {accuracy_note('EPSG:27700')}\n" in done.stderr


def earth_centred(lon_lat_height: Floats) -> Floats:
    to_earth = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    return np.stack(to_earth.transform(*lon_lat_height.T), axis=1)


def test_far_from_the_anchor_positions_are_exact_and_cameras_stay_level(tmp_path: Path) -> None:
    """Over 60 km the local frame keeps every distance to a millimetre, and level cameras follow the Earth's bend."""
    lat_lon = np.array([[52.0 + 0.05 * i, 4.0 + 0.08 * i] for i in range(10)])
    rows = [f"{i}.jpg,{lat!r},{lon!r},43.0,{36.0 * i},{i}" for i, (lat, lon) in enumerate(lat_lon.tolist())]
    dataset = read_csv_poses(poses_of(tmp_path, "image,lat,lon,height,heading_deg,pass", *rows), camera=CAMERA)
    on_earth = earth_centred(np.column_stack([lat_lon[:, 1], lat_lon[:, 0], np.full(10, 43.0)]))
    centers = camera_centers(dataset.images)
    extent = np.linalg.norm(on_earth[-1] - on_earth[0])
    assert extent > 60_000
    between = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    assert_allclose(between, np.linalg.norm(on_earth[:, None] - on_earth[None], axis=2), rtol=0, atol=1e-3)
    up = -rotation_matrices(dataset.images)[:, 1]
    tilt = np.degrees(np.arccos(np.clip(up @ up[0], -1, 1)))
    assert_allclose(tilt[-1], np.degrees(extent / 6.375e6), rtol=5e-3)
    # One metre up from each camera is one metre up on the Earth.
    lifted = earth_centred(np.column_stack([lat_lon[:, 1], lat_lon[:, 0], np.full(10, 44.0)]))
    assert_allclose(
        np.linalg.norm((centers + up)[:, None] - centers[None], axis=2),
        np.linalg.norm(lifted[:, None] - on_earth[None], axis=2),
        rtol=0,
        atol=1e-3,
    )


@pytest.mark.parametrize(
    ("header", "rows", "crs"),
    [
        ("image,lat,lon,height,heading_deg", ("a.jpg,52,4,10,0", "b.jpg,52.0001,4,11,0"), None),
        ("image,x,y,z,heading_deg", ("a.jpg,600000,5760000,10,0", "b.jpg,600000,5760010,11,0"), "EPSG:32631"),
    ],
)
def test_heights_above_the_sea_are_brought_to_the_ellipsoid(
    tmp_path: Path, header: str, rows: tuple[str, ...], crs: str | None
) -> None:
    poses = poses_of(tmp_path, header, *rows)
    above_sea = read_csv_poses(poses, camera=CAMERA, crs=crs, vertical="43.5")
    plain = read_csv_poses(poses, camera=CAMERA, crs=crs)
    assert above_sea.frame.anchor is not None
    assert plain.frame.anchor is not None
    assert above_sea.frame.anchor[2] == pytest.approx(plain.frame.anchor[2] + 43.5, abs=1e-6)
    assert_allclose(camera_centers(above_sea.images), camera_centers(plain.images), atol=1e-4)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_times_and_parameters_have_decimal_commas_too(separator: str, tmp_path: Path) -> None:
    table = """image,lat,lon,heading_deg,timestamp,width_px,height_px,model,params
a.jpg,52.5,4.25,0.5,1700000000.25,1280,720,PINHOLE,800.5 801 640 360.25
b.jpg,52.5001,4.25,0.5,2023-11-14T22:13:21.5Z,1280,720,PINHOLE,800.5 801 640 360.25
"""
    table = table.replace(",", separator).replace(".", ",").replace(",jpg", ".jpg")
    dataset = read_csv_poses(write(tmp_path / "poses.csv", table))
    assert dataset.images.timestamp_s is not None
    assert_allclose(dataset.images.timestamp_s, [1700000000.25, 1700000001.5])
    assert [params.tolist() for params in dataset.cameras.params] == [[800.5, 801.0, 640.0, 360.25]]
    assert dataset.frame.anchor == (52.5, 4.25, 0.0)
    quoted = 'image,lat,lon,heading_deg,timestamp\na.jpg,52,4,0,"1700000000,25"\n'
    said = refusal(lambda: read_csv_poses(write(tmp_path / "quoted.csv", quoted), camera=CAMERA))
    assert "timestamp: expected seconds or an ISO 8601 time, found '1700000000,25'" in said


@pytest.mark.parametrize(
    "text",
    [
        *("1700000000.25", "1700000000250", "1700000000250000", "1700000000250000000"),
        *("2023:11:14 22:13:20.25", "2023:11:14 23:13:20.25+01:00"),
    ],
)
def test_times_as_others_write_them(text: str, tmp_path: Path) -> None:
    """Telephones and Mapillary count milliseconds, ROS nanoseconds; ExifTool writes EXIF's dates."""
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg,timestamp", f"a.jpg,0,0,0,{text}")
    times = read_csv_poses(poses, camera=CAMERA).images.timestamp_s
    assert times is not None
    assert_allclose(times, [1700000000.25], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("header", "columns", "height_m"),
    [
        ("lat,lon,z,heading_deg", {}, 7.0),
        ("lat,lon,H,heading_deg", {"z": "H"}, 7.0),
        ("lat,lon,height,z,heading_deg", {}, 7.0),
        ("lat,lon,z,x,y,heading_deg", {}, 2.0),
    ],
)
def test_heights_beside_latitudes_may_be_called_z(
    tmp_path: Path, header: str, columns: dict[str, str], height_m: float
) -> None:
    row = ",".join(
        {"lat": "52", "lon": "4", "x": "1", "y": "1", "heading_deg": "0"}.get(name, "7") for name in header.split(",")
    )
    poses = poses_of(tmp_path, f"image,{header}", f"a.jpg,{row}")
    dataset = read_csv_poses(poses, camera=CAMERA, columns=columns, camera_height_m=2.0)
    assert dataset.frame.anchor == (52.0, 4.0, height_m)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (
            ("2023-11-14T22:13:20+01:00", "", "1700000000", "2023-11-14 22:13:22"),
            "line 5: timestamp: expected a zone as in the rows before, found none: '2023-11-14 22:13:22'",
        ),
        (("2023:11:14 22:13:20", "2023-11-14T22:13:21Z"), "line 3: timestamp: expected no zone as in the rows before"),
    ],
)
def test_times_are_all_with_a_zone_or_all_without(times: tuple[str, ...], said: str, tmp_path: Path) -> None:
    rows = (f"{number}.jpg,52,4,0,{time}" for number, time in enumerate(times))
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg,timestamp", *rows)
    assert said in refusal(lambda: read_csv_poses(poses, camera=CAMERA))


def test_heights_in_a_frame_of_its_own_have_no_zero(tmp_path: Path) -> None:
    poses = poses_of(tmp_path, "image,x,y,z,heading_deg", "a.jpg,0,0,0,0", "b.jpg,0,1,0,0")
    said = refusal(lambda: read_csv_poses(poses, camera=CAMERA, vertical="43.5"))
    assert "does not go with x, y in a frame of their own" in said


def test_cameras_passes_times_rigs_and_sigmas_come_from_columns(tmp_path: Path) -> None:
    header = (
        "image,lat,lon,heading_deg,width_px,height_px,fx,cx,cy,pass,timestamp,rig,position_sigma_m,rotation_sigma_deg"
    )
    poses = poses_of(
        tmp_path,
        header,
        "b.jpg,0,0.0001,0,1242,375,721.5,609.5,172.5,mon,2023-11-14T22:13:20.5Z,1,0.1,2",
        "a.jpg,0,0,0,1242,375,721.5,609.5,172.5,mon,1700000000.25,1,,",
        "c.jpg,0,0.0002,0,640,480,500,320,240,tue,,2,0.3,1",
    )
    assert "pixel-center: expected 0 or 0.5" in refusal(lambda: read_csv_poses(poses, pixel_center=1.0))
    dataset = read_csv_poses(poses, pixel_center=0.0)
    assert dataset.images.name.to_pylist() == ["a.jpg", "b.jpg", "c.jpg"]
    assert dataset.images.pass_id.texts() == ["mon", "mon", "tue"]
    assert dataset.images.timestamp_s is not None
    assert_allclose(dataset.images.timestamp_s, [1700000000.25, 1700000000.5, np.nan])
    assert dataset.images.rig_id is not None
    assert dataset.images.rig_id.tolist() == [0, 0, 1]
    assert dataset.images.position_sigma_m is not None
    assert_allclose(dataset.images.position_sigma_m, [np.nan, 0.1, 0.3])
    assert dataset.images.rotation_sigma_rad is not None
    assert_allclose(dataset.images.rotation_sigma_rad[1:], np.radians([2.0, 1.0]))
    assert len(dataset.cameras) == 2
    assert [params.tolist() for params in dataset.cameras.params] == [
        [500, 500, 320.5, 240.5],
        [721.5, 721.5, 610, 173],
    ]
    write_dataset(dataset, tmp_path / "dataset")
    assert read_dataset(tmp_path / "dataset").images.rig_id is not None


def test_cameras_with_other_readout_times_are_others(tmp_path: Path) -> None:
    rows = ("b.jpg,0,0.0001,0,0.03", "a.jpg,0,0,0,", "c.jpg,0,0.0002,0,-0.02", "d.jpg,0,0.0003,0,0.03")
    dataset = read_csv_poses(poses_of(tmp_path, "image,lat,lon,heading_deg,readout_s", *rows), camera=CAMERA)
    write_dataset(dataset, tmp_path / "dataset")
    again = read_dataset(tmp_path / "dataset")
    assert again.cameras.readout_s is not None
    assert_allclose(again.cameras.readout_s, [np.nan, -0.02, 0.03])
    assert again.images.camera_id.tolist() == [1, 3, 2, 3]
    plain = read_csv_poses(
        poses_of(tmp_path, "image,lat,lon,heading_deg", "a.jpg,0,0,0", "b.jpg,0,0.0001,0"), camera=CAMERA
    )
    assert plain.cameras.readout_s is None


def test_a_camera_model_may_stand_in_a_row(tmp_path: Path) -> None:
    poses = poses_of(
        tmp_path,
        "image,lat,lon,heading_deg,width_px,height_px,model,params",
        "a.jpg,0,0,0,800,600,OPENCV_FISHEYE,300 300 400 300 0 0 0 0",
        "b.jpg,0,0.0001,0,800,400,EQUIRECTANGULAR,",
    )
    assert read_csv_poses(poses).cameras.model.texts() == ["EQUIRECTANGULAR", "OPENCV_FISHEYE"]
    bad = poses_of(tmp_path, "image,lat,lon,heading_deg,width_px,height_px,model,params", "a.jpg,0,0,0,8,6,PINHOLE,1 2")
    assert "line 2: camera 'PINHOLE 8 6 1 2': PINHOLE has the parameters fx, fy, cx, cy" in refusal(
        lambda: read_csv_poses(bad)
    )


def test_key_points_as_fractions_of_a_panorama(tmp_path: Path) -> None:
    """A quarter of the width is 90 degrees; a cell of a 512 x 256 heat map has its middle at 0.5 / 512."""
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", "p,0,0,100", "q,0,0.001,0")
    points = write(tmp_path / "points.csv", "id,u,v,confidence\np,0.25,0.5,1.02\np,0.75,0.25,0.51\n")
    file = DetectionFile(
        points,
        columns={"image": "id", "x": "u", "y": "v", "score": "confidence"},
        fractions=True,
        full_score=1.02,
        class_name="ramp",
    )
    dataset = read_csv_poses(poses, camera="EQUIRECTANGULAR 512 256", detections=file)
    assert_allclose(azimuths_deg(dataset), [190.0, 10.0], atol=1e-9)
    assert_allclose(cast_rays(dataset).direction_in_world[:, 2], [np.sqrt(0.5), 0.0], atol=1e-9)
    assert_allclose(dataset.detections.score, [0.5, 1.0])
    assert not dataset.detections.size_px.any()
    assert dataset.detections.class_name.texts() == ["ramp", "ramp"]


@pytest.mark.parametrize(
    ("header", "row", "options", "said"),
    [
        (
            "image,lat,lon,heading_deg",
            "a.jpg,123.4,52.0,0",
            {},
            "expected degrees, found latitude 123.4 and longitude 52",
        ),
        ("image,lat,lon,yaw_rad", "a.jpg,52,4,123", {}, "yaw_rad: expected radians, found 123"),
        ("image,lat,lon", "a.jpg,52,4", {}, "expected one of heading_deg"),
        ("image,heading_deg", "a.jpg,4", {}, "expected lat, lon or x, y"),
        ("name,lat,lon,heading_deg", "a.jpg,52,4,1", {}, "expected a column 'image'"),
        ("image,lat,lon,heading_deg", "../a.jpg,52,4,1", {}, "stays in the folder"),
        ("image,lat,lon,heading_deg", "/etc/passwd,52,4,1", {}, "stays in the folder"),
        ("image,lat,lon,heading_deg", "a.jpg,52,4,1", {"columns": {"lat": "latitude"}}, "has no column 'latitude'"),
        ("image,lat,lon,heading_deg", "a.jpg,52,4,1", {"columns": {"latt": "lat"}}, "there is no column 'latt'"),
        ("image,lat,lon,heading_deg", "a.jpg,52,4,1", {"crs": "EPSG:32632"}, "do not go with columns lat, lon"),
        (
            "image,lat,lon,heading_deg",
            "a.jpg,52,4,1",
            {"camera": "PINHOL 1 2"},
            "expected one of COLMAP's camera models",
        ),
        ("image,lat,lon,heading_deg", "a.jpg,52,4,1", {"camera": None}, "where no camera is given"),
        (
            "image,lat,lon,heading_deg",
            "a.jpg,52,4,1",
            {"camera": "PINHOLE 640 480 500 nan 320 240"},
            "camera 'PINHOLE 640 480 500 nan 320 240': fy: expected a finite number",
        ),
        (
            "image,lat,lon,heading_deg",
            "a.jpg,52,4,1",
            {"camera": "PINHOLE 640 480 500"},
            "PINHOLE has the parameters fx, fy, cx, cy, found 1 numbers",
        ),
        ("image,lat,lon,heading_deg,position_sigma_m", "a.jpg,52,4,1,-1", {}, "poses.csv line 2: position_sigma_m: "),
        ("image,lat,lon,heading_deg,position_sigma_m", "a.jpg,52,4,1,x", {}, "above 0, or no value, found 'x'"),
        ("image,lat,lon,heading_deg,rotation_sigma_deg", "a.jpg,52,4,1,0", {}, "line 2: rotation_sigma_deg: expected"),
        ("image,lat,lon,heading_deg,readout_s", "a.jpg,52,4,1,30", {}, "poses.csv line 2: readout_s: expected at most"),
        (
            "image,lat,lon,heading_deg",
            "a.jpg,52,4,1",
            {"camera_height_m": 1e12},
            "poses.csv: expected heights of at most 1e+08 m, found 1e+12 (1 images)",
        ),
        ("image,lat,lon,height,heading_deg", "a.jpg,52,4,1e12,1", {}, "heights of at most 1e+08 m, found 1e+12"),
        ("image,lat,lon,heading_deg", f"{'a' * 2000}.jpg,52,4,1", {}, "expected at most 1000 letters, found 2004"),
        ("image,lat,lon,heading_deg", '"a\nb.jpg",52,4,1', {}, "expected letters that can be printed, found '\\n'"),
        (
            "image,x,y,heading_deg",
            "a.jpg,52,4,1",
            {"crs": "EPSG:123456"},
            "crs 'EPSG:123456': there is no such system",
        ),
        ("image,x,y,heading_deg", "a.jpg,1e9,4,1", {"crs": "EPSG:32632"}, "is no place in it"),
        ("image,lat,lon,heading_deg,timestamp", "a.jpg,52,4,1,noon", {}, "line 2: timestamp: expected seconds"),
        (
            "image,lat,lon,heading_deg,timestamp",
            "a.jpg,52,4,1,20231114221320",
            {},
            "line 2: timestamp: expected seconds",
        ),
        ("image,lat,lon,qw,qx,qy,qz", "a.jpg,52,4,1,2,3,4", {}, "its quaternion is not of length 1"),
        ("image,x,y,qw,qx,qy,qz", "a.jpg,52,4,0,0,0,0", {}, "its quaternion is not of length 1"),
        ("image,x,y,qw,qx,qy,qz", "a.jpg,52,4,1e200,0,0,0", {}, "its quaternion is not of length 1"),
        ("image,x,y,qw,qx,qy,qz", "a.jpg,1e15,4,1,0,0,0", {}, "it is more than 1e+08 m from the origin"),
        ("image,x,y,qw,qx,qy,qz", "a.jpg,52,4,1,0,0,0\nb.jpg,52,4,1,0,0,", {}, "a number of its pose is missing"),
        ("image,lat,lon,heading_deg", "a.jpg,52,4,x", {}, "heading_deg: expected a number, found 'x'"),
        ("image,lat,lon,heading_deg", "a.jpg,52,x,0", {}, "lon: expected a number, found 'x'"),
        ("image,lat,lon,heading_deg", "a.jpg,52,4,0\na.jpg,52,4,0", {}, "occur more than once, the first is 'a.jpg'"),
    ],
)
def test_bad_tables(tmp_path: Path, header: str, row: str, options: dict[str, Any], said: str) -> None:
    poses = poses_of(tmp_path, header, row)
    assert said in refusal(lambda: read_csv_poses(poses, **{"camera": CAMERA, **options}))


@pytest.mark.parametrize(
    ("header", "columns", "said", "hint"),
    [
        ("image,rig", {}, "line 3: rig: expected a text, found none (2 rows)", "fill in 'rig' in all rows, or remove"),
        ("image,drive", {"pass": "drive"}, "line 3: pass: expected", "fill in 'drive' in all rows, or remove"),
        ("name,image", {"image": "image"}, "line 3: image: expected", "fill in 'image' in all rows"),
    ],
)
def test_a_text_that_is_missing_is_told_with_its_column(
    header: str, columns: dict[str, str], said: str, hint: str, tmp_path: Path
) -> None:
    rows = ("1.jpg,x,52,4,0", "2.jpg,,52,4.1,0", "3.jpg,,52,4.2,0")
    with pytest.raises(InputError, match=re.escape(said)) as error:
        read_csv_poses(poses_of(tmp_path, f"{header},lat,lon,heading_deg", *rows), camera=CAMERA, columns=columns)
    assert error.value.hint.startswith(hint)
    assert ("remove the column" in error.value.hint) == ("remove" in hint)


def test_boxes_that_cannot_be_used_are_said_to_be_in_their_file(tmp_path: Path) -> None:
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", "a.jpg,52,4,1")
    boxes = boxes_of(tmp_path, ("a.jpg", 3, 1e6))
    said = refusal(lambda: read_csv_poses(poses, camera=CAMERA, detections=boxes))
    assert said.startswith(f"{boxes}: 1 of 1 boxes cannot be used")


@pytest.mark.parametrize("how", SPOILS)
def test_files_that_are_no_tables(tmp_path: Path, how: str) -> None:
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", "a.jpg,52,4,1")
    boxes = boxes_of(tmp_path, ("a.jpg", 3, 4))
    assert "boxes.csv" in refusal(lambda: read_csv_poses(poses, camera=CAMERA, detections=spoiled(boxes, how)))
    assert "poses.csv" in refusal(lambda: read_csv_poses(spoiled(poses, how), camera=CAMERA))
    bearings = write(tmp_path / "b" / "bearings.csv", "lat,lon,bearing\n1,2,3\n")
    assert "bearings.csv" in refusal(lambda: read_bearings(spoiled(bearings, how)))


def test_a_line_that_says_the_separator_counts_as_a_line(tmp_path: Path) -> None:
    poses = poses_of(tmp_path, "sep=;", "image;lat;lon;heading_deg;rig", "a.jpg;52,5;4;0;")
    assert "poses.csv line 3: rig: expected a text" in refusal(lambda: read_csv_poses(poses, camera=CAMERA))


def test_a_header_that_is_no_utf8_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_bytes(b"image,lat,lon,heading_deg,\x80x\na.jpg,52,4,1,2\n")
    assert "cannot be read as CSV" in refusal(lambda: read_csv_poses(tmp_path / "poses.csv", camera=CAMERA))


# Bearings.


@pytest.mark.parametrize(
    ("header", "name", "theirs"),
    [("Label,score", "class", "Label"), ("category_id,score", "class", "category_id"), ("class,conf", "score", "conf")],
)
def test_a_class_or_score_under_another_name_is_not_lost_in_silence(
    tmp_path: Path, header: str, name: str, theirs: str
) -> None:
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", "a.jpg,0,0,90")
    boxes = write(tmp_path / "boxes.csv", f"image,x,y,track,{header}\na.jpg,320,240,7,light,0.5\n")
    bearings = write(tmp_path / "bearings.csv", f"lat,lon,bearing,track,{header}\n0,0,90,7,light,0.5\n")
    said = f"has no column '{name}', and its column '{theirs}' is none of "
    columns = {name: theirs}

    def read_boxes(columns: dict[str, str]) -> Dataset:
        return read_csv_poses(poses, camera=CAMERA, detections=DetectionFile(boxes, columns=columns))

    for path, read in ((boxes, read_boxes), (bearings, lambda columns: read_bearings(bearings, columns=columns))):
        with pytest.raises(InputError, match=re.escape(f"{path}: {said}")) as error:
            read({})
        assert f"{name}={theirs}" in error.value.hint
        detections = read(columns).detections  # Of the track, which nobody asks for, nothing is said.
        assert (detections.class_name.texts(), detections.score.tolist()) == (["light"], [0.5])


def two_bearings(tmp_path: Path) -> Path:
    """From (0, 0) an object 30 m north and 40 m east; from 60 m east of there the same."""
    east = 60.0 / DEGREE_EAST_M
    first, second = np.degrees(np.arctan2(40.0, 30.0)), np.degrees(np.arctan2(-20.0, 30.0))
    return write(
        tmp_path / "bearings.csv", f"lat,lon,bearing,depth\n0,0,{float(first)!r},50\n0,{east!r},{float(second)!r},\n"
    )


def test_bearings_meet_where_the_object_is(tmp_path: Path) -> None:
    dataset = read_bearings(two_bearings(tmp_path), class_name="light")
    assert_allclose(meeting_point(dataset, within_m=1e-3)[:2], [40.0, 30.0], atol=1e-3)
    assert dataset.detections.range_m is not None
    assert_allclose(dataset.detections.range_m, [50.0, np.nan])
    assert dataset.detections.range_sigma_m is not None
    assert_allclose(dataset.detections.range_sigma_m, [15.0, np.nan])
    assert dataset.detections.class_name.texts() == ["light", "light"]


def test_the_elevation_and_size_of_a_bearing_were_not_measured(tmp_path: Path) -> None:
    """At this deviation a normal density is at most as high as the even one over the picture, so it says nothing."""
    dataset = read_bearings(two_bearings(tmp_path))
    height = float(dataset.cameras.height_px[0])
    assert_allclose(dataset.detections.center_px[:, 1], height / 2.0)
    assert dataset.detections.vertical_sigma_px is not None
    assert_allclose(dataset.detections.vertical_sigma_px, VERTICAL_SIGMA_PX)
    assert_allclose(1.0 / (np.sqrt(2.0 * np.pi) * VERTICAL_SIGMA_PX), 1.0 / height, rtol=1e-12)
    assert not dataset.detections.size_px.any()
    write_dataset(dataset, tmp_path / "dataset")
    again = read_dataset(tmp_path / "dataset").detections.vertical_sigma_px
    assert again is not None
    assert_allclose(again, VERTICAL_SIGMA_PX)


def test_bearings_of_one_place_are_of_one_image_unless_they_say_otherwise(tmp_path: Path) -> None:
    rows = "1,2,10\n1,2,20\n1,2.0001,30\n"
    assert len(read_bearings(write(tmp_path / "a.csv", f"lat,lon,bearing\n{rows}")).images) == 2
    named = "a,1,2,10\nb,1,2,20\nc,1,2.0001,30\n"
    assert len(read_bearings(write(tmp_path / "b.csv", f"image,lat,lon,bearing\n{named}")).images) == 3
    close = "1,2,50.00001,10\n1,2,50.00002,20\n1.0000000001,2,50,30\n1,2,51,10\n"
    assert len(read_bearings(write(tmp_path / "d.csv", f"lat,lon,height,bearing\n{close}")).images) == 2
    moved = write(tmp_path / "c.csv", "image,lat,lon,bearing\na,1,2,10\na,1,2.1,20\n")
    assert "line 3: image 'a' is at two places" in refusal(lambda: read_bearings(moved))


def test_a_bearing_of_more_than_a_turn_is_left_out(tmp_path: Path) -> None:
    rows = "".join(f"1,2,{bearing}\n" for bearing in (-360, 360, 361, -4000, *range(20, 320)))
    path = write(tmp_path / "a.csv", f"lat,lon,bearing\n{rows}")
    dataset = read_bearings(path)
    assert len(dataset.detections) == 301  # 360 is -360.
    assert dataset.rejected is not None
    assert dataset.rejected.reason.texts().count("its bearing is more than a turn") == 2
    assert "its bearing is more than a turn (2, the first is" in refusal(lambda: read_bearings(path, max_rejected=0.0))


@pytest.mark.parametrize(("factor", "told"), [(1.0, []), (math.pi / 180.0, ["only sea: are these", "bearing: all 20"])])
def test_radians_of_bearings_are_told(factor: float, told: list[str], tmp_path: Path) -> None:
    rows = ((52.5 + i / 1e4, 13.4, 18.0 * i) for i in range(20))
    lines = (",".join(str(factor * value) for value in row) for row in rows)
    said: list[str] = []
    read_bearings(write(tmp_path / "a.csv", "\n".join(["lat,lon,bearing", *lines]) + "\n"), tell=said.append)
    said = [line for line in said if "all cameras are at height" not in line]
    assert len(said) == len(told)
    assert all(part in line for part, line in zip(told, said, strict=True))


@pytest.mark.parametrize(("factor", "times"), [(0.0, 0), (1.0, 0), (math.pi / 180.0, 1), (0.1 * math.pi / 180.0, 0)])
@pytest.mark.parametrize("columns", ["heading_deg", "yaw_deg", "omega_deg,phi_deg,kappa_deg"])
def test_radians_of_headings_are_told(columns: str, factor: float, times: int, tmp_path: Path) -> None:
    *level, turned = columns.split(",")
    rows = [f"{i}.jpg,{i // 7 / 1e4},0,{'90,0,' if level else ''}{factor * 18.0 * i!r}" for i in range(20)]
    said: list[str] = []
    boxes = boxes_of(tmp_path, ("0.jpg", 320, 240))
    poses = poses_of(tmp_path, f"image,lat,lon,{columns}", *rows)
    read_csv_poses(poses, camera=CAMERA, detections=boxes, tell=said.append)
    said = [line for line in said if "all cameras are at height" not in line]
    assert [line.startswith(f"{turned}: all 20 are from 0 to 5.97") for line in said] == times * [True]


def headings_on_a_way(folder: Path, way_deg: Floats, column: str, angle: Floats) -> list[str]:
    """What is told of angles (N) of cameras that are driven along azimuths (N)."""
    azimuth = np.radians(way_deg)
    east_m, north_m = np.cumsum(2.0 * np.stack([np.sin(azimuth), np.cos(azimuth)]), axis=1)
    rows = [f"{i:02d}.jpg,{x},{y},{a}" for i, (x, y, a) in enumerate(zip(east_m, north_m, angle, strict=True))]
    said: list[str] = []
    poses = poses_of(folder, f"image,x,y,{column}", *rows)
    read_csv_poses(poses, camera=CAMERA, detections=boxes_of(folder, ("00.jpg", 320, 240)), tell=said.append)
    return [line for line in said if "radians" in line]


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("column", ["heading_deg", "yaw_deg"])
@pytest.mark.parametrize(
    ("begin", "turn", "mount"), [(70, 90, 0), (10, -90, 45), (130, 0, 0), (190, 0, 0), (60, 0, 180)]
)
def test_radians_that_follow_the_way_are_told(
    begin: int, turn: int, mount: int, column: str, unit: str, tmp_path: Path
) -> None:
    """Round one corner whichever way the camera looks, straight ahead only where it looks ahead or back."""
    way_deg = begin + np.where(np.arange(24) < 15, 0.0, turn)
    heading = np.mod(way_deg + mount + np.tile([-1.0, 1.0, 0.5], 8), 360.0)
    angle = heading if column == "heading_deg" else np.mod(90.0 - heading, 360.0)
    said = headings_on_a_way(tmp_path, way_deg, column, np.radians(angle) if unit == "rad" else angle)
    assert [line.startswith(f"{column}: all 24 are from") for line in said] == [True] * (unit == "rad")
    assert all("only as radians do they follow the way" in line for line in said)


def test_degrees_that_follow_a_way_to_the_north_are_no_radians(tmp_path: Path) -> None:
    """They are as small as radians, and farther apart than half a turn of radians."""
    angle = np.tile([-2.5, 2.5, 1.0], 8)
    assert headings_on_a_way(tmp_path, np.zeros(24), "heading_deg", angle) == []


@pytest.mark.parametrize(
    ("columns", "angles"),
    [("heading_deg", "36001"), ("yaw_deg", "-1e9"), ("omega_deg,phi_deg,kappa_deg", "90,0,1e308")],
)
def test_no_angle_has_more_than_a_hundred_turns(columns: str, angles: str, tmp_path: Path) -> None:
    poses = poses_of(tmp_path, f"image,x,y,{columns}", f"a.jpg,0,0,{angles}")
    said = refusal(lambda: read_csv_poses(poses, camera=CAMERA))
    assert re.search(r"line 2: (heading|yaw|kappa)_deg: expected degrees, at most 36000, found '?[-0-9e.+]+'? ", said)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", ["inf,0.1", "51,-inf", "nan,inf"])
def test_an_infinite_place_is_left_out_in_silence_of_numpy(place: str, tmp_path: Path) -> None:
    rows = [f"{i}.jpg,{51 + i / 1e4},0.1,90" for i in range(20)]
    poses = poses_of(tmp_path, "image,lat,lon,heading_deg", f"x.jpg,{place},90", *rows)
    boxes = boxes_of(tmp_path, ("0.jpg", 320, 240))
    assert len(read_csv_poses(poses, camera=CAMERA, detections=boxes, max_rejected=0.1).images) == 20


def test_a_bearing_that_is_no_number_is_left_out(tmp_path: Path) -> None:
    rows = "".join(f"1,2,{bearing}\n" for bearing in (10, "x", *range(20, 320)))
    dataset = read_bearings(write(tmp_path / "a.csv", f"lat,lon,bearing\n{rows}"))
    assert len(dataset.detections) == 301
    assert dataset.rejected is not None
    assert dataset.rejected.place.to_pylist()[0].endswith("a.csv line 3")


# Real data, where it is there.


def real(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA / name} is not here")
    return DATA / name


def commands_in_the_docs() -> dict[str, list[str]]:
    """The commands that docs/formats/published_data.md gives for published data, by the folder that they read."""
    text = (Path(__file__).parents[1] / "docs" / "formats" / "published_data.md").read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^    .+\n)+", text, re.MULTILINE)
    commands = [shlex.split(line) for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return {command[3].partition("/")[0]: command for command in commands}


@pytest.mark.parametrize(
    ("name", "images", "detections"),
    [("london_tl", 50, 173), ("bend_ramps", 9857, 24185), ("kitti_ts", 1756, 2363)],
)
def test_the_commands_of_the_docs_import_published_data(
    name: str, images: int, detections: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = commands_in_the_docs()[name]
    assert command[0] == "valuemap"
    real(name)
    monkeypatch.chdir(DATA)
    command[command.index("--out") + 1] = str(tmp_path / "out")
    done = CliRunner().invoke(app, command[1:])
    assert done.exit_code == 0, done.output
    dataset = read_dataset(tmp_path / "out")
    assert (len(dataset.images), len(dataset.detections), dataset.rejected) == (images, detections, None)


def test_london_imports_without_a_script() -> None:
    dataset = read_bearings(real("london_tl") / "detection_input.csv", class_name="traffic light")
    assert (len(dataset.images), len(dataset.detections), dataset.rejected) == (50, 173, None)


def test_london_with_depths_is_mapped_as_the_docs_say() -> None:
    text = (Path(__file__).parents[1] / "docs" / "formats" / "published_data.md").read_text(encoding="utf-8")
    told = re.search(r"find (\d+), with (\d+) labels:\s+an F1 of (0\.\d+)", text)
    assert told is not None
    dataset = read_bearings(real("london_tl") / "detection_input.csv", class_name="traffic light")
    found = evaluate_map(build_map(dataset), DATA / "london_tl" / "ground_truth.csv", radius_m=6.0)
    f1 = 2 * found.recall * found.precision / (found.recall + found.precision)
    assert (str(found.true_positives), str(found.labels), f"{f1:.3f}") == told.groups()


def test_bend_imports_without_a_script() -> None:
    folder = real("bend_ramps")
    dataset = read_csv_poses(
        folder / "panoramas.csv",
        columns={"image": "panorama_id", "pass": "captured"},
        camera="EQUIRECTANGULAR 512 256",
        camera_height_m=2.5,
        detections=DetectionFile(
            folder / "detections.csv",
            columns={"image": "panorama_id", "x": "x_normalized", "y": "y_normalized", "score": "confidence"},
            fractions=True,
            full_score=1.05,
            class_name="ramp",
        ),
    )
    assert (len(dataset.images), len(dataset.detections), dataset.rejected) == (9857, 24185, None)


def kitti_ts() -> Dataset:
    folder = real("kitti_ts")
    return read_csv_poses(
        folder / "images.csv",
        columns={
            "yaw_rad": "yaw_rad_ccw_from_east",
            "pass": "drive",
            "width_px": "width",
            "height_px": "height",
        },
        pixel_center=0.0,
        camera_height_m=1.65,
        detections=DetectionFile(folder / "detections.csv", pixel_center=0.0),
    )


def test_kitti_ts_imports_without_a_script() -> None:
    dataset = kitti_ts()
    assert (len(dataset.images), len(dataset.detections), dataset.rejected) == (1756, 2363, None)
    assert len(set(dataset.images.pass_id.texts())) == 37


@pytest.mark.parametrize("height_m", [math.nan, math.inf])
def test_a_height_of_cameras_that_is_no_number_is_named(tmp_path: Path, height_m: float) -> None:
    bearings = write(tmp_path / "bearings.csv", "lat,lon,bearing\n44,-121.3,90\n44.0001,-121.3,100\n")
    poses = write(tmp_path / "poses.csv", "image,lat,lon,heading\na.jpg,44,-121.3,0\n")
    export = write(tmp_path / "items.json", '{"type": "FeatureCollection", "features": []}')
    detections = DetectionFile(write(tmp_path / "boxes.csv", "image,class,x,y,w,h\n"))
    with pytest.raises(SettingError, match=r"camera-height: expected a finite number, found (nan|inf)"):
        read_bearings(bearings, camera_height_m=height_m)
    with pytest.raises(SettingError, match=r"camera-height: expected a finite number"):
        read_csv_poses(poses, detections=detections, camera="EQUIRECTANGULAR 4000 2000", camera_height_m=height_m)
    with pytest.raises(SettingError, match=r"camera-height: expected a finite number"):
        read_panoramax(export, camera_height_m=height_m)


@pytest.mark.parametrize("turn", ["heading_deg", "qw,qx,qy,qz"])
@pytest.mark.parametrize(
    ("x_m", "y_m", "z_m", "is_plane"),
    [
        (200_000.0, 20_000.0, 12.0, True),  # UTM near the equator, at the western edge of a zone.
        (95_000.0, 10_000.0, 12.0, False),  # The British grid in Scilly: too near to be told.
        (200_000.0, 20_000.0, -3_150.0, False),  # 200 km away the Earth is 40400 / (2 * 6371) = 3.17 km lower.
    ],
)
def test_coordinates_of_a_map_projection_near_its_origin_are_told_by_their_heights(
    tmp_path: Path, x_m: float, y_m: float, z_m: float, is_plane: bool, turn: str
) -> None:
    side = math.sqrt(0.5)  # Level, to the north.
    value = "0" if turn == "heading_deg" else f"{side},{side},0,0"
    rows = [f"{i}.jpg,{x_m},{y_m + 2 * i},{z_m},{value}" for i in range(3)]
    path = write(tmp_path / "poses.csv", "\n".join([f"image,x,y,z,{turn}", *rows]) + "\n")
    if is_plane:
        said = refusal(lambda: read_csv_poses(path, camera=CAMERA, anchor=(0.2, 0.3, 10.0)))
        assert "expected positions in metres east, north, up of the anchor, found (200000, 20002, 12)" in said
    else:
        assert len(read_csv_poses(path, camera=CAMERA, anchor=(0.2, 0.3, 10.0)).images) == 3
