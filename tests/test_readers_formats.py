"""Formats of poses: one scene written in the conventions of each, by this file alone, must be the same scene when read.

Three images along a street see one object. Every fixture is written from rotations and centres in the plainest words
of its format; the boxes are where the object projects by similar triangles. When all rays meet at the object, then
direction and order of rotations, axes, offsets of sensors and pixel centres are right.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest
from numpy.testing import assert_allclose
from pyproj import Proj, Transformer
from scipy.spatial.transform import Rotation

from reading import SPOILS, azimuths_deg, meeting_point, refusal, spoiled, write
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, cast_rays, colmap_camera
from valuemap.dataset import Dataset
from valuemap.geodesy import enu_from_lon_lat_height
from valuemap.readers.argoverse2 import read_argoverse2
from valuemap.readers.kapture import read_kapture
from valuemap.readers.kitti import read_kitti
from valuemap.readers.kitti360 import read_kitti360
from valuemap.readers.mapillary import read_mapillary
from valuemap.readers.nuscenes import read_nuscenes
from valuemap.readers.opendronemap import read_opendronemap
from valuemap.readers.opensfm import read_opensfm
from valuemap.readers.panoramax import read_panoramax
from valuemap.readers.poses import interpolate_poses
from valuemap.readers.tum import read_tum

WIDTH, HEIGHT, FX, FY, CX, CY = 640, 480, 500.0, 510.0, 330.0, 230.0
OBJECT = np.array([4.0, 30.0, 3.0])
CENTERS = np.array([[0.0, 0.0, 1.5], [0.5, 4.0, 1.6], [0.2, 8.0, 1.4]])
# Columns: right, down, forward of cameras that look north, a little to the right, and a little down.
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
WORLD_FROM_CAM = np.array([Rotation.from_euler("zx", [-0.05 * i, -0.02 * i]).as_matrix() @ _LEVEL for i in range(3)])
STAMPS_NS = np.array([1_600_000_000_000_000_000, 1_600_000_000_500_000_000, 1_600_000_001_000_000_000])
LAT, LON = 52.0, 4.0


def pinhole(point_in_cam: Floats) -> Floats:
    """The pixel by similar triangles; the centre of the top-left pixel is (0.5, 0.5)."""
    x, y, z = point_in_cam
    return np.array([FX * x / z + CX, FY * y / z + CY])


def boxes(folder: Path, names: list[str], project: Callable[[Floats], Floats] = pinhole, **poses: Any) -> Path:
    """A box around the object in each image, as CSV."""
    rotations, centers = poses.get("rotations", WORLD_FROM_CAM), poses.get("centers", CENTERS)
    lines = []
    for name, rotation, center in zip(names, rotations, centers, strict=True):
        x, y = project(rotation.T @ (OBJECT - center))
        lines.append(f"{name},{x - 5!r},{y - 10!r},{x + 5!r},{y + 10!r}".replace("np.float64(", "").replace(")", ""))
    return write(folder / "boxes.csv", "\n".join(["image,x1,y1,x2,y2", *lines]) + "\n")


def numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def check_scene(dataset: Dataset, *, seconds: bool = True, within_m: float = 1e-6) -> None:
    """Three images where they are, and three rays that meet at the object."""
    assert len(dataset.images) == len(dataset.detections) == 3
    assert_allclose(camera_centers(dataset.images), CENTERS, atol=within_m)
    assert_allclose(meeting_point(dataset, within_m=within_m), OBJECT, atol=1e-5 + 10 * within_m)
    if seconds:
        assert dataset.images.timestamp_s is not None
        assert_allclose(dataset.images.timestamp_s, STAMPS_NS / 1e9, atol=1e-6)


def notes_of(read: Callable[..., Any], path: Path) -> list[str]:
    said: list[str] = []
    read(path, tell=said.append)
    return said


# TUM.


def tum_in(folder: Path) -> tuple[Path, Path]:
    rows = [
        f"{stamp / 1e9:.9f} {numbers(center)} {numbers(Rotation.from_matrix(rotation).as_quat())}"
        for stamp, center, rotation in zip(STAMPS_NS, CENTERS, WORLD_FROM_CAM, strict=True)
    ]
    return write(folder / "trajectory.txt", "\n".join(["# t tx ty tz qx qy qz qw", *rows]) + "\n"), boxes(
        folder, [f"{stamp / 1e9:.9f}.png" for stamp in STAMPS_NS]
    )


CAMERA = f"PINHOLE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY}"


@pytest.mark.parametrize("stamp", ["1e99999999", "inf", "nan", "1e-9999999"])
def test_timestamps_beyond_all_times_are_refused(stamp: str, tmp_path: Path) -> None:
    trajectory, _ = tum_in(tmp_path)
    listed = write(tmp_path / "list.txt", f"{stamp} a.png\n")
    said = refusal(lambda: read_tum(trajectory, camera=CAMERA, image_list=listed))
    expected = "no image is between two poses" if "-" in stamp else "expected a timestamp in seconds"
    assert f"list.txt: {expected}" in said


def test_tum(tmp_path: Path) -> None:
    trajectory, csv = tum_in(tmp_path)
    check_scene(read_tum(trajectory, camera=CAMERA, detections=csv))


def test_what_is_twice_in_tum_is_named_with_its_place(tmp_path: Path) -> None:
    trajectory, _ = tum_in(tmp_path)
    head, *rows = trajectory.read_text().splitlines()
    listed = write(tmp_path / "rgb.txt", f"{rows[0].split()[0]} a.png\n{rows[1].split()[0]} a.png\n")
    said = refusal(lambda: read_tum(trajectory, camera=CAMERA, image_list=listed))
    assert "rgb.txt: 1 image names occur more than once, the first is 'a.png'" in said
    write(trajectory, "\n".join([head, *rows, rows[1]]))
    said = refusal(lambda: read_tum(trajectory, camera=CAMERA))
    assert "trajectory.txt line 5: the pose has the same timestamp as that of line 3" in said


def test_tum_has_pixels_of_another_convention_where_it_says_so(tmp_path: Path) -> None:
    trajectory, _ = tum_in(tmp_path)
    dataset = read_tum(trajectory, camera="PINHOLE 640 480 500 500 319.5 239.5", pixel_center=0.0)
    assert dataset.cameras.params[0].tolist() == [500, 500, 320, 240]
    said = refusal(lambda: read_tum(trajectory, camera=CAMERA, pixel_center=7.0))
    assert "pixel-center: expected 0 or 0.5, found 7" in said


def test_an_image_between_two_poses_of_tum_is_between_them(tmp_path: Path) -> None:
    """A quarter turn in one second, one metre on: 0.25 s in it is 22.5 degrees and 0.25 m."""
    half = np.sqrt(0.5)
    write(tmp_path / "t.txt", f"10 0 0 0 0 0 0 1\n11 1 0 0 0 0 {half} {half}\n")
    write(tmp_path / "rgb.txt", "# stamps\n10.25 rgb/a.png\n10.0 rgb/b.png\n12.5 rgb/late.png\n9 rgb/early.png\n")
    options: dict[str, Any] = {
        "camera": CAMERA,
        "image_list": tmp_path / "rgb.txt",
        "longest_gap_s": 2.0,
        "up": (0.0, 0.0, 1.0),
    }
    dataset = read_tum(tmp_path / "t.txt", **options)
    assert dataset.images.name.to_pylist() == ["rgb/a.png", "rgb/b.png"]
    assert_allclose(camera_centers(dataset.images), [[0.25, 0.0, 0.0], [0.0, 0.0, 0.0]], atol=1e-12)
    turned = Rotation.from_quat(dataset.images.cam_from_world_quat[0], scalar_first=True).inv().as_rotvec(degrees=True)
    assert_allclose(turned, [0, 0, 22.5], atol=1e-9)
    assert dataset.rejected is not None
    assert dataset.rejected.image_name.to_pylist() == ["rgb/early.png", "rgb/late.png"]
    assert set(dataset.rejected.reason.texts()) == {
        "it is before or after all poses, or in a gap of them that is longer than 2 s"
    }
    only_exact = read_tum(tmp_path / "t.txt", **{**options, "longest_gap_s": 0.5})
    assert only_exact.images.name.to_pylist() == ["rgb/b.png"]
    write(tmp_path / "rgb.txt", "10.5 a.png\n")
    said = refusal(lambda: read_tum(tmp_path / "t.txt", **{**options, "longest_gap_s": 0.5}))
    assert "no image is between two poses of the trajectory, 10 to 11, that are at most 0.5 s apart" in said
    for gap in (np.nan, np.inf, -1.0):
        said = refusal(lambda gap=gap: read_tum(tmp_path / "t.txt", **{**options, "longest_gap_s": gap}))  # type: ignore[misc]
        assert f"longest-gap: expected seconds from 0 to 1e+09, found {gap:g}" in said


def test_nanoseconds_of_orb_slam3_are_times_of_pictures(tmp_path: Path) -> None:
    """It writes them with a fraction of 0; pictures of EuRoC are named by whole ones, and listed with commas."""
    trajectory, _ = tum_in(tmp_path)
    texts = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in STAMPS_NS.tolist()]
    rows = trajectory.read_text()
    for text, stamp in zip(texts, STAMPS_NS.tolist(), strict=True):
        rows = rows.replace(text, f"{stamp}.000000")
    write(trajectory, rows)
    names = [f"{stamp}.png" for stamp in STAMPS_NS.tolist()]
    detections = boxes(tmp_path, names)
    listed = [f"{stamp},cam0/data/{name}" for stamp, name in zip(STAMPS_NS.tolist(), names, strict=True)]
    lines = write(tmp_path / "data.csv", "\n".join(["#timestamp [ns],filename", *listed]) + "\n")
    check_scene(read_tum(trajectory, camera=CAMERA, detections=detections))
    check_scene(read_tum(trajectory, camera=CAMERA, detections=detections, image_list=lines))


def test_trajectories_whose_quaternions_begin_with_w_are_not_tum(tmp_path: Path) -> None:
    """As of EuRoC and Basalt, with a comment that says so, and of VINS, without; both with commas and nanoseconds."""
    row = "1403636760113555456,1,2,3,1,0,0,0"
    basalt = f"#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n{row}\n"
    vins, own = f"{row},\n", "# t x y z qw qx qy qz\n1 1 2 3 1 0 0 0\n"
    for text, line in ((basalt, "line 1: says"), (vins, "line 1: has commas"), (own, "line 1: says")):
        said = refusal(lambda text=text: read_tum(write(tmp_path / "t.csv", text), camera=CAMERA))  # type: ignore[misc]
        assert line in said
        assert "quaternions begin with w" in said
        assert "w last" in said


# kapture.


def kapture_in(folder: Path) -> Path:
    """The poses are of a rig; the camera is 0.3 m right of it and turned by 10 degrees."""
    rig_from_cam, camera_in_rig = Rotation.from_euler("y", 10, degrees=True).as_matrix(), np.array([0.3, 0.0, 0.1])
    poses, records = [], []
    for stamp, rotation, center in zip(STAMPS_NS, WORLD_FROM_CAM, CENTERS, strict=True):
        world_from_rig = rotation @ rig_from_cam.T
        rig_center = center - world_from_rig @ camera_in_rig
        quaternion = Rotation.from_matrix(world_from_rig.T).as_quat(scalar_first=True)
        pose = numbers([*quaternion, *(-world_from_rig.T @ rig_center)]).replace(" ", ", ")
        poses.append(f"{stamp}, rig0, {pose}")
        records.append(f"{stamp}, cam0, day1/{stamp}.jpg")
    sensor = Rotation.from_matrix(rig_from_cam.T).as_quat(scalar_first=True)
    place = numbers([*sensor, *(-rig_from_cam.T @ camera_in_rig)]).replace(" ", ", ")
    head = "# kapture format: 1.1\n"
    parameters = f"{WIDTH}, {HEIGHT}, {FX}, {FY}, {CX}, {CY}"
    write(folder / "sensors" / "sensors.txt", f"{head}cam0, front, camera, PINHOLE, {parameters}\nimu, , imu\n")
    write(folder / "sensors" / "rigs.txt", f"{head}rig0, cam0, {place}\n")
    write(
        folder / "sensors" / "trajectories.txt",
        head + "\n".join(poses) + f"\n{STAMPS_NS[0] + 7}, rig0, , , , , 1, 2, 3\n",
    )
    unposed = f"{STAMPS_NS[0] + 7}, cam0, day1/unposed.jpg"
    write(folder / "sensors" / "records_camera.txt", head + "\n".join([*records, unposed]) + "\n")
    return folder


def test_kapture(tmp_path: Path) -> None:
    folder = kapture_in(tmp_path / "k")
    dataset = read_kapture(folder, detections=boxes(tmp_path, [f"day1/{stamp}.jpg" for stamp in STAMPS_NS]))
    check_scene(dataset)
    assert dataset.images.pass_id.texts() == ["day1"] * 3
    assert dataset.images.rig_id is not None
    assert len(set(dataset.images.rig_id.tolist())) == 3


def test_records_of_kapture_without_a_pose_are_listed(tmp_path: Path) -> None:
    rejected = read_kapture(kapture_in(tmp_path)).rejected
    assert rejected is not None
    assert rejected.image_name.to_pylist() == ["day1/unposed.jpg"]
    assert rejected.reason.texts() == [
        "trajectories.txt has no pose then of cam0, nor of a rig that rigs.txt puts it on"
    ]


def test_devices_of_kapture_without_their_rig_are_named(tmp_path: Path) -> None:
    (kapture_in(tmp_path) / "sensors" / "rigs.txt").unlink()
    said = refusal(lambda: read_kapture(tmp_path))
    assert "records are of cam0, trajectories.txt has poses of rig0" in said
    assert "sensors/rigs.txt says which cameras are on which device" in said


def test_timestamps_of_kapture_are_whole_numbers_however_they_are_written(tmp_path: Path) -> None:
    folder = kapture_in(tmp_path)
    trajectories = folder / "sensors" / "trajectories.txt"
    write(trajectories, re.sub(r"(?m)^(?=\d)", "000", trajectories.read_text()))
    assert len(read_kapture(folder).images) == 3


def test_a_camera_of_kapture_that_has_no_pose_may_be_unknown(tmp_path: Path) -> None:
    """Queries come with UNKNOWN_CAMERA, width and height; nothing is asked of what is skipped."""
    sensors = kapture_in(tmp_path) / "sensors" / "sensors.txt"
    known = sensors.read_text()
    write(sensors, known + f"phone, gs9, camera, UNKNOWN_CAMERA, {WIDTH}, {HEIGHT}\n")
    records = tmp_path / "sensors" / "records_camera.txt"
    write(records, records.read_text() + f"{STAMPS_NS[0] + 7}, phone, query/1.jpg\n")
    assert len(read_kapture(tmp_path).images) == 3
    write(sensors, known.replace("PINHOLE", "UNKNOWN_CAMERA"))
    assert "sensors.txt line 2: camera 'UNKNOWN_CAMERA" in refusal(lambda: read_kapture(tmp_path))


# OpenSfM.


def opensfm_in(folder: Path, camera: dict[str, Any] | None = None) -> Path:
    shots = {}
    for i, (rotation, center) in enumerate(zip(WORLD_FROM_CAM, CENTERS, strict=True)):
        shots[f"{i}.jpg"] = {
            "camera": "c",
            "rotation": Rotation.from_matrix(rotation.T).as_rotvec().tolist(),
            "translation": (-rotation.T @ center).tolist(),
            "capture_time": float(STAMPS_NS[i]) / 1e9,
        }
    # Integer pixel centres: the middle of 640 pixels is 319.5, which is 320 here, so cx - 320 is the offset.
    brown = {
        "projection_type": "brown",
        "width": WIDTH,
        "height": HEIGHT,
        "focal_x": FX / WIDTH,
        "focal_y": FY / WIDTH,
        "c_x": (CX - 320.0) / WIDTH,
        "c_y": (CY - 240.0) / WIDTH,
        **dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0.0),
    }
    reference = {"latitude": LAT, "longitude": LON, "altitude": 40.0}
    part = {"cameras": {"c": camera or brown}, "shots": shots, "reference_lla": reference}
    return write(folder / "reconstruction.json", json.dumps([part]))


def test_opensfm(tmp_path: Path) -> None:
    path = opensfm_in(tmp_path / "o")
    dataset = read_opensfm(path, detections=boxes(tmp_path, ["0.jpg", "1.jpg", "2.jpg"]))
    check_scene(dataset)
    assert dataset.frame.anchor == (LAT, LON, 40.0)
    assert "says where it is" in refusal(lambda: read_opensfm(path, anchor=(1.0, 2.0, 3.0)))


def test_another_origin_beside_that_of_opensfms_reconstruction_is_told(tmp_path: Path) -> None:
    path = opensfm_in(tmp_path)
    same = {"latitude": LAT, "longitude": LON, "altitude": 40.0}
    write(tmp_path / "reference_lla.json", json.dumps(same))
    assert notes_of(read_opensfm, path) == []
    write(tmp_path / "reference_lla.json", json.dumps({**same, "latitude": LAT + 1.0}))
    (note,) = notes_of(read_opensfm, path)
    assert f"is {LAT:g} {LON:g} 40, which is used; reference_lla.json beside it says {LAT + 1.0:g} {LON:g} 40" in note


def test_cameras_of_opensfm_may_be_turned_where_it_says_where_it_is(tmp_path: Path) -> None:
    """OpenSfM does not turn pictures: those taken upright have their own up to the side."""
    path = opensfm_in(tmp_path)
    parts = json.loads(path.read_text())
    for shot in parts[0]["shots"].values():
        quarter = Rotation.from_euler("z", 90, degrees=True)
        shot["rotation"] = (quarter * Rotation.from_rotvec(shot["rotation"])).as_rotvec().tolist()
        shot["translation"] = quarter.apply(shot["translation"]).tolist()
    write(path, json.dumps(parts))
    dataset = read_opensfm(path)
    assert dataset.frame.anchor == (LAT, LON, 40.0)
    assert_allclose(camera_centers(dataset.images), CENTERS, atol=1e-9)
    del parts[0]["reference_lla"]
    write(path, json.dumps(parts))
    assert "with an anchor z is up" in refusal(lambda: read_opensfm(path, anchor=(LAT, LON, 40.0)))


def test_a_capture_time_of_zero_is_none_in_opensfm(tmp_path: Path) -> None:
    """So it says of pictures without a date, which are not 50 years older than the others."""
    path = opensfm_in(tmp_path)
    parts = json.loads(path.read_text())
    parts[0]["shots"]["1.jpg"]["capture_time"] = 0.0
    times = read_opensfm(write(path, json.dumps(parts))).images.timestamp_s
    assert times is not None
    assert np.isnan(times[1])
    assert_allclose(times[[0, 2]], STAMPS_NS[[0, 2]] / 1e9)


def test_a_camera_of_opensfm_without_a_type_is_perspective(tmp_path: Path) -> None:
    """As old versions wrote it."""
    plain: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "focal": 0.8, "k1": -0.1, "k2": 0.02}
    typed = {**plain, "projection_type": "perspective"}
    found, expected = (read_opensfm(opensfm_in(tmp_path / str(i), camera)) for i, camera in enumerate((plain, typed)))
    assert_allclose(found.cameras.params[0], expected.cameras.params[0])
    assert found.cameras.model.texts() == expected.cameras.model.texts()


def brown_radial(r: float) -> float:
    return 1 - 0.1 * r**2 + 0.02 * r**4 + 0.003 * r**6


@pytest.mark.parametrize(
    ("camera", "project"),
    [
        (
            {"projection_type": "perspective", "focal": 0.8, "k1": -0.1, "k2": 0.02},
            lambda x, y, r: 640 * 0.8 * np.array([x, y]) * (1 - 0.1 * r**2 + 0.02 * r**4) + [320, 240],
        ),
        (
            {"projection_type": "fisheye", "focal": 0.5, "k1": -0.05, "k2": 0.01},
            lambda x, y, r: 640 * 0.5 * np.array([x, y]) / r * (t := np.arctan(r)) * (1 - 0.05 * t**2 + 0.01 * t**4)
            + [320, 240],
        ),
        (
            {"projection_type": "spherical"},
            lambda x, y, _: [
                320 + 640 * np.arctan2(x, 1.0) / (2 * np.pi),
                240 + 640 * np.arctan2(y, np.hypot(x, 1.0)) / (2 * np.pi),
            ],
        ),
        (
            {
                "projection_type": "brown", "focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01, "c_y": -0.02,
                "k1": -0.1, "k2": 0.02, "k3": 0.003, "p1": 0.001, "p2": -0.002,
            },
            lambda x, y, r: np.array(
                [
                    326.4 + 512 * (x * brown_radial(r) + 0.002 * x * y - 0.002 * (r**2 + 2 * x**2)),
                    227.2 + 576 * (y * brown_radial(r) + 0.001 * (r**2 + 2 * y**2) - 0.004 * x * y),
                ]
            ),
        ),
    ],
    ids=["perspective", "fisheye", "spherical", "brown"],
)  # fmt: skip
def test_cameras_of_opensfm(tmp_path: Path, camera: dict[str, Any], project: Callable[..., Any]) -> None:
    """Each by the formula of its documentation; a panorama must be twice as wide as high."""
    height = 320 if camera["projection_type"] == "spherical" else HEIGHT
    path = opensfm_in(tmp_path / "o", {**camera, "width": WIDTH, "height": height})

    def pixel(point: Floats) -> Floats:
        x, y = point[:2] / point[2]
        found = np.array(project(x, y, np.hypot(x, y)), dtype=np.float64)
        return found - [0.0, 80.0] if height == 320 else found

    csv = boxes(tmp_path, ["0.jpg", "1.jpg", "2.jpg"], pixel)
    check_scene(read_opensfm(path, detections=csv), within_m=1e-4)


def test_two_reconstructions_of_opensfm_share_no_pass(tmp_path: Path) -> None:
    path = opensfm_in(tmp_path)
    part = json.loads(path.read_text())[0]
    other = {**part, "shots": {f"b{name}": shot for name, shot in part["shots"].items()}}
    write(path, json.dumps([part, other]))
    assert sorted(set(read_opensfm(path).images.pass_id.texts())) == ["0/all", "1/all"]
    other["reference_lla"] = {"latitude": 1.0, "longitude": 2.0, "altitude": 3.0}
    write(path, json.dumps([part, other]))
    assert "have different origins" in refusal(lambda: read_opensfm(path))


def test_a_camera_of_opensfm_without_shots_may_be_of_any_type(tmp_path: Path) -> None:
    """It lists those of pictures that it could not place, too."""
    path = opensfm_in(tmp_path)
    parts = json.loads(path.read_text())
    parts[0]["cameras"]["other"] = {"projection_type": "dual", "width": 0, "height": 0, "focal": 0.8}
    write(path, json.dumps(parts))
    assert len(read_opensfm(path).cameras) == 1
    parts[0]["shots"]["1.jpg"]["camera"] = "other"
    write(path, json.dumps(parts))
    assert "cameras['other']: " in refusal(lambda: read_opensfm(path))


def test_of_opendronemap_what_is_east_north_up_is_read(tmp_path: Path) -> None:
    """Its reconstruction.json is in a map projection, and still says where the origin of the other one is."""
    true = opensfm_in(tmp_path / "opensfm").rename(tmp_path / "opensfm" / "reconstruction.topocentric.json")
    parts = json.loads(true.read_text())
    convergence = Rotation.from_euler("z", 1.0, degrees=True)
    for shot in parts[0]["shots"].values():
        shot["rotation"] = (Rotation.from_rotvec(shot["rotation"]) * convergence).as_rotvec().tolist()
    projected = write(tmp_path / "opensfm" / "reconstruction.json", json.dumps(parts))
    undistorted = write(tmp_path / "opensfm" / "undistorted" / "reconstruction.json", json.dumps(parts))
    detections = boxes(tmp_path, ["0.jpg", "1.jpg", "2.jpg"])
    for given in (true, true.parent):
        check_scene(read_opensfm(given, detections=detections))
    for given in (projected, undistorted, undistorted.parent):
        said = refusal(lambda given=given: read_opensfm(given))  # type: ignore[misc]
        assert "reconstruction.json: is in OpenDroneMap's map projection" in said
        assert f"give {true}" in said


@pytest.mark.parametrize(("turn_deg", "is_told"), [(0.788, True), (0.0, False), (-0.788, False), (3.0, False)])
def test_a_map_projection_is_told_by_the_gps_of_its_cameras(tmp_path: Path, turn_deg: float, is_told: bool) -> None:
    """In zone 31 at 52 degrees of latitude, 1 degree east of its middle, grid north is sin(52) degrees east of north.

    Forty cameras on a street of 800 m have GPS that is wrong by a metre. In the grid the street is turned the other way
    as seen from above: counter-clockwise by 0.788 degrees.
    """
    random = np.random.default_rng(3)
    centers = np.column_stack([np.linspace(0.0, 600.0, 40), np.linspace(0.0, 500.0, 40), np.full(40, 2.0)])
    gps = centers + random.normal(0.0, 1.0, centers.shape)
    path = opensfm_in(tmp_path)
    parts = json.loads(path.read_text())
    turn = Rotation.from_euler("z", turn_deg, degrees=True)
    looks = Rotation.from_matrix(_LEVEL)
    parts[0]["shots"] = {
        f"{i}.jpg": {
            "camera": "c",
            "rotation": (turn * looks).inv().as_rotvec().tolist(),
            "translation": (-(turn * looks).inv().apply(turn.apply(center))).tolist(),
            "gps_position": where.tolist(),
        }
        for i, (center, where) in enumerate(zip(centers, gps, strict=True))
    }
    parts[0]["shots"]["3.jpg"]["gps_position"] = "unknown"  # No pose needs it.
    notes = notes_of(read_opensfm, write(path, json.dumps(parts)))
    assert len(notes) == is_told
    assert all("turned by 0.79 degrees against their GPS" in note for note in notes)


@pytest.mark.parametrize(
    ("easting_m", "northing_m"),
    [(568_600.0, 5_761_500.0), (371_000.0, 143_800.0)],  # The latter is in Singapore, near the equator.
)
def test_coordinates_of_a_map_projection_are_not_those_of_an_anchor(
    tmp_path: Path, easting_m: float, northing_m: float
) -> None:
    """As of `export_geocoords`, which leaves the origin as it was: UTM counts north from the equator."""
    path = opensfm_in(tmp_path)
    parts = json.loads(path.read_text())
    for shot in parts[0]["shots"].values():
        cam_from_world = Rotation.from_rotvec(shot["rotation"])
        center = -cam_from_world.inv().apply(shot["translation"]) + [easting_m, northing_m, 0.0]
        shot["translation"] = (-cam_from_world.apply(center)).tolist()
    write(path, json.dumps(parts))
    said = refusal(lambda: read_opensfm(path))
    assert f"expected positions in metres east, north, up of the anchor, found ({easting_m // 1000:.0f}" in said


# OpenDroneMap.


def lon_lat_height_of(center: Floats) -> tuple[float, float, float]:
    """The place of a point in the frame of the scene, whose origin is at height 0."""
    to_wgs = Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={LON} +lat_0={LAT} +h_0=0"
    )
    lon, lat, height = to_wgs.transform(center[0], center[1], center[2], direction="INVERSE")
    return lon, lat, height


def opendronemap_in(folder: Path) -> Path:
    """A project in zone 31 of UTM, whose grid is turned by 0.79 degrees here, with a lens that is off the middle."""
    turn = np.radians(Proj("EPSG:32631").get_factors(LON, LAT).meridian_convergence)
    enu_from_grid = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    features = []
    for i, (rotation, center) in enumerate(zip(WORLD_FROM_CAM, CENTERS, strict=True)):
        lon, lat, height = lon_lat_height_of(center)
        east, north = Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True).transform(lon, lat)
        properties = {
            "filename": f"{i}.jpg",
            "camera": "v2 maker model 640 480 brown 0.85",
            "focal": FX / WIDTH,
            "width": WIDTH,
            "height": HEIGHT,
            "capture_time": float(STAMPS_NS[i]) / 1e9,
            "translation": [east, north, height],
            "rotation": Rotation.from_matrix(rotation.T @ enu_from_grid).as_rotvec().tolist(),
        }
        place = {"type": "Point", "coordinates": [lon, lat, height]}
        features.append({"type": "Feature", "properties": properties, "geometry": place})
    write(folder / "odm_report" / "shots.geojson", json.dumps({"type": "FeatureCollection", "features": features}))
    opensfm = opensfm_in(folder / "opensfm")
    camera = json.loads(opensfm.read_text())[0]["cameras"]["c"]
    opensfm.unlink()
    write(folder / "cameras.json", json.dumps({"maker model 640 480 brown 0.85": camera}))
    return folder


@pytest.mark.parametrize("given", [".", "odm_report", "odm_report/shots.geojson"])
def test_opendronemap(tmp_path: Path, given: str) -> None:
    project = opendronemap_in(tmp_path / "p")
    said: list[str] = []
    dataset = read_opendronemap(
        project / given,
        detections=boxes(tmp_path, ["0.jpg", "1.jpg", "2.jpg"]),
        anchor=(LAT, LON, 0.0),
        tell=said.append,
    )
    check_scene(dataset, within_m=1e-4)
    assert said == []


def test_lenses_of_opendronemap_that_are_not_there_are_told(tmp_path: Path) -> None:
    """Older versions do not name the camera of a shot: the one of the same size and focal length is it."""
    project = opendronemap_in(tmp_path)
    path, lenses = project / "odm_report" / "shots.geojson", project / "cameras.json"
    content = json.loads(path.read_text())
    for feature in content["features"]:
        del feature["properties"]["camera"], feature["properties"]["capture_time"]
    write(path, json.dumps(content))
    assert notes_of(read_opendronemap, project) == []
    assert read_opendronemap(project).cameras.model.texts() == ["FULL_OPENCV"]
    write(lenses, lenses.read_text().replace(f'"width": {WIDTH}', '"width": 999'))
    (note,) = notes_of(read_opendronemap, project)
    assert "3 shots have a focal length alone, as" in note
    assert "cameras.json has no such camera" in note
    write(lenses, "[]")
    assert "cameras.json: expected an object" in refusal(lambda: read_opendronemap(project))
    lenses.unlink()
    (note,) = notes_of(read_opendronemap, project)
    assert "no cameras.json is beside" in note
    dataset = read_opendronemap(project)
    assert dataset.cameras.model.texts() == ["SIMPLE_PINHOLE"]
    assert_allclose(dataset.cameras.params[0], [FX, 320.0, 240.0])


def test_shots_of_opendronemap_that_are_there_twice_count_once(tmp_path: Path) -> None:
    path = opendronemap_in(tmp_path) / "odm_report" / "shots.geojson"
    content = json.loads(path.read_text())
    content["features"].append(content["features"][0])
    write(path, json.dumps(content))
    (note,) = notes_of(read_opendronemap, path)
    assert "1 shots are there again" in note
    assert len(read_opendronemap(path).images) == 3


def test_shots_of_opendronemap_in_another_system_are_refused(tmp_path: Path) -> None:
    """As of projects without GPS, whose coordinates are made up."""
    path = opendronemap_in(tmp_path) / "odm_report" / "shots.geojson"
    content = json.loads(path.read_text())
    for feature, center in zip(content["features"], CENTERS, strict=True):
        feature["properties"]["translation"] = center.tolist()
    write(path, json.dumps(content))
    said = refusal(lambda: read_opendronemap(path))
    assert "expected translations that are the coordinates in UTM, found [0.0, 0.0, 1.5] for [4.0, 52.0" in said


# Poses that hold no numbers.


def spoil_pose_of_tum(folder: Path) -> Dataset:
    path, _ = tum_in(folder)
    first, second, *rest = path.read_text().splitlines()
    write(path, "\n".join([first, f"{second.split()[0]} nan nan nan nan nan nan nan", *rest]))
    return read_tum(path, camera=CAMERA, max_rejected=0.5)


def spoil_pose_of_kapture(folder: Path) -> Dataset:
    path = kapture_in(folder) / "sensors" / "trajectories.txt"
    first, second, *rest = path.read_text().splitlines()
    write(path, "\n".join([first, ", ".join([*second.split(", ")[:2], *["nan"] * 7]), *rest]))
    (folder / "sensors" / "records_camera.txt").write_text(
        "\n".join((folder / "sensors" / "records_camera.txt").read_text().splitlines()[:-1])
    )
    return read_kapture(folder, max_rejected=0.5)


def spoil_pose_of_kitti(folder: Path) -> Dataset:
    files = kitti_in(folder)
    rows = files["poses"].read_text().splitlines()
    write(files["poses"], "\n".join(["nan " * 12, *rows[1:]]))
    return read_kitti(**files, max_rejected=0.5)


def spoil_pose_of_kitti360(folder: Path) -> Dataset:
    path = kitti360_in(folder) / "data_poses" / "drive" / "poses.txt"
    rows = path.read_text().splitlines()
    write(path, "\n".join([rows[0].split()[0] + " nan" * 12, *rows[1:]]))
    return read_kitti360(folder, sequence="drive", max_rejected=0.5)


def spoil_pose_of_nuscenes(folder: Path) -> Dataset:
    poses = json.loads((nuscenes_in(folder) / "ego_pose.json").read_text())
    poses[0]["translation"][1] = math.nan
    write(folder / "ego_pose.json", json.dumps(poses))
    return read_nuscenes(folder, max_rejected=0.5)


def spoil_pose_of_opensfm(folder: Path) -> Dataset:
    path = opensfm_in(folder)
    content = json.loads(path.read_text())
    content[0]["shots"]["0.jpg"]["rotation"] = [math.nan] * 3
    write(path, json.dumps(content))
    return read_opensfm(path, max_rejected=0.5)


def spoil_pose_of_mapillary(folder: Path) -> Dataset:
    path = mapillary_in(folder)
    content = json.loads(path.read_text())
    content["data"][0]["computed_rotation"] = [None, None, None]
    write(path, json.dumps(content))
    return read_mapillary(path, max_rejected=0.5)


@pytest.mark.parametrize(
    "spoilt",
    [
        spoil_pose_of_tum,
        spoil_pose_of_kapture,
        spoil_pose_of_kitti,
        spoil_pose_of_kitti360,
        spoil_pose_of_nuscenes,
        spoil_pose_of_opensfm,
        spoil_pose_of_mapillary,
    ],
)
def test_an_image_whose_pose_is_no_number_is_left_out(tmp_path: Path, spoilt: Callable[[Path], Dataset]) -> None:
    dataset = spoilt(tmp_path / "data")
    assert len(dataset.images) == 2
    assert dataset.rejected is not None
    (reason,) = {
        reason
        for table, reason in zip(dataset.rejected.table.texts(), dataset.rejected.reason.texts(), strict=True)
        if table == "images"
    }
    assert reason == "a number of its pose is missing or not finite"


# nuScenes.


def nuscenes_in(folder: Path) -> Path:
    """Each image has an ego pose of its own; the camera is 1.7 m in front of the ego's origin and 1.5 m above it."""
    ego_from_cam, camera_in_ego = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.7, 0.1, 1.5])
    tables: dict[str, list[dict[str, Any]]] = {
        "log": [{"token": "l", "location": "boston-seaport"}],
        "scene": [{"token": "s", "name": "scene-0001", "log_token": "l"}],
        "sample": [{"token": f"f{i}", "scene_token": "s"} for i in range(3)],
        "sensor": [
            {"token": "cam", "channel": "CAM_FRONT", "modality": "camera"},
            {"token": "top", "channel": "LIDAR_TOP", "modality": "lidar"},
        ],
        "calibrated_sensor": [
            {
                "token": "k",
                "sensor_token": "cam",
                "rotation": Rotation.from_matrix(ego_from_cam).as_quat(scalar_first=True).tolist(),
                "translation": camera_in_ego.tolist(),
                # Pixels count from the centre of the top-left one.
                "camera_intrinsic": [[FX, 0, CX - 0.5], [0, FY, CY - 0.5], [0, 0, 1]],
            },
            {"token": "m", "sensor_token": "top", "rotation": [1, 0, 0, 0], "translation": [0, 0, 2]},
        ],
        "ego_pose": [],
        "sample_data": [],
    }
    for i, (rotation, center) in enumerate(zip(WORLD_FROM_CAM, CENTERS, strict=True)):
        world_from_ego = rotation @ ego_from_cam.T
        quaternion = Rotation.from_matrix(world_from_ego).as_quat(scalar_first=True).tolist()
        place = (center - world_from_ego @ camera_in_ego).tolist()
        tables["ego_pose"].append({"token": f"e{i}", "rotation": quaternion, "translation": place})
        row = {"sample_token": f"f{i}", "ego_pose_token": f"e{i}", "timestamp": int(STAMPS_NS[i] // 1000)}
        image = {"filename": f"samples/CAM_FRONT/{i}.jpg", "width": WIDTH, "height": HEIGHT, "is_key_frame": True}
        tables["sample_data"].append({"token": f"d{i}", "calibrated_sensor_token": "k", **row, **image})
        scan = {"filename": f"samples/LIDAR_TOP/{i}.bin", "width": 0, "height": 0, "is_key_frame": True}
        tables["sample_data"].append({"token": f"p{i}", "calibrated_sensor_token": "m", **row, **scan})
    for name, rows in tables.items():
        write(folder / f"{name}.json", json.dumps(rows))
    return folder


def test_nuscenes(tmp_path: Path) -> None:
    folder = nuscenes_in(tmp_path / "v1.0-mini")
    dataset = read_nuscenes(folder, detections=boxes(tmp_path, [f"samples/CAM_FRONT/{i}.jpg" for i in range(3)]))
    check_scene(dataset)
    assert dataset.images.pass_id.texts() == ["scene-0001"] * 3
    assert dataset.frame.anchor == (42.336849169438615, -71.05785369873047, 0.0)
    assert "location mars: " in refusal(lambda: read_nuscenes(folder, location="mars"))


def test_cameras_of_one_sample_of_nuscenes_are_a_rig_and_sweeps_are_not_read_unless_asked_for(tmp_path: Path) -> None:
    folder = nuscenes_in(tmp_path / "v1.0-mini")
    rows = json.loads((folder / "sample_data.json").read_text())
    back = {**rows[0], "token": "back", "filename": "samples/CAM_BACK/0.jpg"}
    sweep = {**rows[0], "token": "sweep", "filename": "sweeps/CAM_FRONT/0.jpg", "is_key_frame": False}
    write(folder / "sample_data.json", json.dumps([*rows, back, sweep]))
    images = read_nuscenes(folder).images
    assert images.rig_id is not None
    rig = dict(zip(images.name.to_pylist(), images.rig_id.tolist(), strict=True))
    assert len(rig) == 4
    assert rig["samples/CAM_BACK/0.jpg"] == rig["samples/CAM_FRONT/0.jpg"] != rig["samples/CAM_FRONT/1.jpg"]
    assert len(read_nuscenes(folder, sweeps=True).images) == 5


def test_nuscenes_maps_are_not_mixed(tmp_path: Path) -> None:
    folder = nuscenes_in(tmp_path)
    other = {"token": "t", "name": "scene-0002", "log_token": "m"}
    write(folder / "scene.json", json.dumps([*json.loads((folder / "scene.json").read_text()), other]))
    logs = [*json.loads((folder / "log.json").read_text()), {"token": "m", "location": "singapore-onenorth"}]
    write(folder / "log.json", json.dumps(logs))
    assert "each map has a frame of its own; " in refusal(lambda: read_nuscenes(folder))
    said = refusal(lambda: read_nuscenes(folder, location="boston"))
    assert f"location boston: there is none such in {folder} | it has boston-seaport, singapore-onenorth" in said
    assert len(read_nuscenes(folder, location="boston-seaport").images) == 3


NOT_CHOSEN = "its image is one that the options of the import leave out"


def not_chosen(dataset: Dataset) -> list[str]:
    """The images of boxes that were left out, which all are of images that nobody chose."""
    assert dataset.rejected is not None
    assert set(dataset.rejected.reason.texts()) == {NOT_CHOSEN}
    return sorted(dataset.rejected.image_name.to_pylist())


def test_boxes_of_images_of_nuscenes_that_were_not_chosen_stop_no_import(tmp_path: Path) -> None:
    """Those of other maps, and those between the key frames."""
    folder = nuscenes_in(tmp_path / "v1.0")
    other = {"token": "t", "name": "scene-0002", "log_token": "m"}
    for name, row in (
        ("scene", other),
        ("log", {"token": "m", "location": "singapore-onenorth"}),
        ("sample", {"token": "g", "scene_token": "t"}),
    ):
        write(folder / f"{name}.json", json.dumps([*json.loads((folder / f"{name}.json").read_text()), row]))
    rows = json.loads((folder / "sample_data.json").read_text())
    there = {**rows[0], "token": "there", "sample_token": "g", "filename": "samples/CAM_FRONT/there.jpg"}
    sweep = {**rows[0], "token": "sweep", "filename": "sweeps/CAM_FRONT/between.jpg", "is_key_frame": False}
    write(folder / "sample_data.json", json.dumps([*rows, there, sweep]))
    names = [*(f"samples/CAM_FRONT/{i}.jpg" for i in range(3)), "there.jpg", sweep["filename"]]
    lines = [f"{name},100,100,110,120" for name in names]
    csv = write(tmp_path / "boxes.csv", "\n".join(["image,x1,y1,x2,y2", *lines]) + "\n")
    dataset = read_nuscenes(folder, location="boston-seaport", detections=csv)
    assert len(dataset.detections) == 3
    assert not_chosen(dataset) == ["sweeps/CAM_FRONT/between.jpg", "there.jpg"]
    write(csv, "\n".join(["image,x1,y1,x2,y2", *lines[3:]]) + "\n")
    assert f"2 of 2 boxes cannot be used, none is left: {NOT_CHOSEN}" in refusal(
        lambda: read_nuscenes(folder, location="boston-seaport", detections=csv)
    )


# Argoverse 2.


def feather(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.feather.write_feather(pa.table(columns), path, compression="lz4")


def argoverse_in(folder: Path, *, city: str | None = None, offset: Floats | None = None) -> Path:
    """The ego pose at each instant of an image; the camera sits in front of it."""
    ego_from_cam, camera_in_ego = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.6, -0.1, 1.4])
    world_from_ego = WORLD_FROM_CAM @ ego_from_cam.T
    place = CENTERS - world_from_ego @ camera_in_ego + (0.0 if offset is None else offset)

    def pose(rotation: Floats, translation: Floats) -> dict[str, Any]:
        quaternion = np.atleast_2d(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
        translation = np.atleast_2d(translation)
        return {
            **{name: quaternion[:, i] for i, name in enumerate(("qw", "qx", "qy", "qz"))},
            **{name: translation[:, i] for i, name in enumerate(("tx_m", "ty_m", "tz_m"))},
        }

    feather(folder / "city_SE3_egovehicle.feather", {"timestamp_ns": STAMPS_NS, **pose(world_from_ego, place)})
    calibration = folder / "calibration"
    sensor = {"sensor_name": ["ring_front_center"], **pose(ego_from_cam, camera_in_ego)}
    feather(calibration / "egovehicle_SE3_sensor.feather", sensor)
    intrinsics = {"fx_px": FX, "fy_px": FY, "cx_px": CX - 0.5, "cy_px": CY - 0.5, "k1": -0.3, "k2": 0.1, "k3": 0.0}
    columns = {name: [value] for name, value in intrinsics.items()}
    size = {"height_px": [HEIGHT], "width_px": [WIDTH]}
    feather(calibration / "intrinsics.feather", {"sensor_name": ["ring_front_center"], **columns, **size})
    for stamp in STAMPS_NS:
        write(folder / "sensors" / "cameras" / "ring_front_center" / f"{stamp}.jpg", "picture")
    if city is not None:
        write(folder / "map" / f"log_map_archive_x____{city}_city_1234.json", "{}")
    return folder


def test_argoverse2(tmp_path: Path) -> None:
    folder = argoverse_in(tmp_path / "log1")
    csv = boxes(tmp_path, [f"sensors/cameras/ring_front_center/{stamp}.jpg" for stamp in STAMPS_NS])
    dataset = read_argoverse2(folder, detections=csv, up=(0.0, 0.0, 1.0))
    check_scene(dataset)
    assert dataset.images.pass_id.texts() == ["log1"] * 3


def test_argoverse2_on_the_earth(tmp_path: Path) -> None:
    """Pittsburgh's frame is UTM 17N less its origin: a place 2 km north of that, by pyproj."""
    offset = np.array([100.0, 2000.0, 300.0])
    argoverse_in(tmp_path / "logs" / "a", city="PIT", offset=offset)
    dataset = read_argoverse2(tmp_path / "logs")
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32617", always_xy=True)
    origin = np.array(to_utm.transform(-80.01294377242584, 40.44177902989321))
    first = origin + offset[:2] + CENTERS[0, :2]
    lon, lat = to_utm.transform(first[0], first[1], direction="INVERSE")
    assert dataset.frame.anchor is not None
    assert_allclose(dataset.frame.anchor, (lat, lon, offset[2] + CENTERS[0, 2]), atol=1e-9)
    # Grid north is (lon - 81 W) sin(lat) clockwise of north, here 0.64 degrees; the scale is 0.9996 (1 + x²/2R²).
    grid_north_rad = np.radians((lon + 81.0) * np.sin(np.radians(lat)))
    assert abs(grid_north_rad) > 0.01
    east, north = (CENTERS - CENTERS[0])[:, :2].T / (0.9996 * (1 + ((first[0] - 5e5) / 6.378e6) ** 2 / 2))
    turned = np.stack([np.cos(grid_north_rad) * east + np.sin(grid_north_rad) * north,
                       np.cos(grid_north_rad) * north - np.sin(grid_north_rad) * east], axis=1)  # fmt: skip
    assert_allclose(camera_centers(dataset.images)[:, :2], turned, atol=2e-3)


def test_logs_of_argoverse_of_who_knows_which_city_are_not_mixed(tmp_path: Path) -> None:
    """Whoever downloads poses and pictures alone has no maps, and each city has a frame of its own."""
    argoverse_in(tmp_path / "a", city="PIT")
    argoverse_in(tmp_path / "b")
    assert "1 of 2 logs do not say which city they are of, the first is b" in refusal(lambda: read_argoverse2(tmp_path))
    assert len(read_argoverse2(tmp_path, city="PIT").images) == 6
    (tmp_path / "a" / "map" / "log_map_archive_x____PIT_city_1234.json").unlink()
    assert "2 of 2 logs do not say" in refusal(lambda: read_argoverse2(tmp_path))
    assert len(read_argoverse2(tmp_path / "a").images) == 3


def test_boxes_of_other_cities_of_argoverse_stop_no_import(tmp_path: Path) -> None:
    argoverse_in(tmp_path / "logs" / "a", city="PIT")
    argoverse_in(tmp_path / "logs" / "b", city="MIA")
    names = [f"{log}/sensors/cameras/ring_front_center/{stamp}.jpg" for log in "ab" for stamp in STAMPS_NS]
    rows = [f"{name},100,100,110,120" for name in names]
    csv = write(tmp_path / "boxes.csv", "\n".join(["image,x1,y1,x2,y2", *rows]) + "\n")
    dataset = read_argoverse2(tmp_path / "logs", city="PIT", detections=csv)
    assert len(dataset.detections) == 3
    assert not_chosen(dataset) == names[3:]


def test_cameras_of_argoverse_that_fire_together_are_a_rig(tmp_path: Path) -> None:
    folder = argoverse_in(tmp_path / "log1")
    for path in ("calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"):
        table = pyarrow.feather.read_table(folder / path)
        left = table.set_column(0, "sensor_name", pa.array(["ring_side_left"]))
        pyarrow.feather.write_feather(pa.concat_tables([table, left]), folder / path)
    for stamp in STAMPS_NS[:2] + 20_000_000:
        write(folder / "sensors" / "cameras" / "ring_side_left" / f"{stamp}.jpg", "picture")
    dataset = read_argoverse2(folder, up=(0.0, 0.0, 1.0))
    images = dataset.images
    assert images.rig_id is not None
    # Between poses half a second apart there is none, but the exact ones stay.
    assert len(images) == 3
    assert dataset.rejected is not None
    assert len(dataset.rejected) == 2
    table = pyarrow.feather.read_table(folder / "city_SE3_egovehicle.feather").to_pydict()
    denser = {name: np.repeat(np.array(values), 4)[:-3] for name, values in table.items()}
    denser["timestamp_ns"] = np.linspace(STAMPS_NS[0], STAMPS_NS[2], 9).astype(np.int64)
    feather(folder / "city_SE3_egovehicle.feather", denser)
    images = read_argoverse2(folder, up=(0.0, 0.0, 1.0)).images
    assert images.rig_id is not None
    rig = images.rig_id.tolist()
    assert len(images) == 5
    assert [rig.count(value) for value in sorted(set(rig))] == [2, 2, 1]


# KITTI with several cameras, and on the Earth.


def kitti_in(folder: Path) -> dict[str, Any]:
    """Camera 0 half a metre left of camera 2, in the axes of the first of it: the world's y is down."""
    world_from_first = WORLD_FROM_CAM[0]
    rows = []
    for rotation, center in zip(WORLD_FROM_CAM, CENTERS, strict=True):
        center0 = center - rotation @ np.array([0.5, 0.0, 0.0])
        in_first = world_from_first.T @ np.column_stack([rotation, center0 - CENTERS[0]])
        rows.append(numbers(in_first))
    calibration = [
        f"P0: {numbers([[FX, 0, CX - 0.5, 0], [0, FY, CY - 0.5, 0], [0, 0, 1, 0]])}",
        f"P2: {numbers([[FX, 0, CX - 0.5, -0.5 * FX], [0, FY, CY - 0.5, 0], [0, 0, 1, 0]])}",
        "Tr: 1 2 3",
    ]
    return {
        "poses": write(folder / "poses.txt", "\n".join(rows) + "\n"),
        "calibration": write(folder / "calib.txt", "\n".join(calibration) + "\n"),
        "times": write(folder / "times.txt", "\n".join(f"{stamp / 1e9:.6e}" for stamp in STAMPS_NS - STAMPS_NS[0])),
        "image_size": (WIDTH, HEIGHT),
    }


def test_kitti_with_several_cameras(tmp_path: Path) -> None:
    files = kitti_in(tmp_path / "00")
    lines = ["frame,camera,x1,y1,x2,y2"]
    for frame, (rotation, center) in enumerate(zip(WORLD_FROM_CAM, CENTERS, strict=True)):
        for camera, offset in ((2, 0.0), (0, -0.5)):
            x, y = pinhole(rotation.T @ (OBJECT - center) - [offset, 0, 0]) - 0.5
            lines.append(f"{frame},{camera},{float(x - 5)},{float(y - 9)},{float(x + 5)},{float(y + 9)}")
    csv = write(tmp_path / "boxes.csv", "\n".join(lines) + "\n")
    dataset = read_kitti(**files, cameras=(2, 0), detections=csv)
    assert dataset.images.name.to_pylist()[::3] == ["image_0/000000.png", "image_2/000000.png"]
    assert_allclose(meeting_point(dataset), WORLD_FROM_CAM[0].T @ (OBJECT - CENTERS[0]), atol=1e-6)
    assert dataset.images.rig_id is not None
    assert dataset.images.rig_id.tolist() == [0, 1, 2, 0, 1, 2]
    assert dataset.images.timestamp_s is not None
    assert_allclose(dataset.images.timestamp_s, [0, 0.5, 1, 0, 0.5, 1])


def test_intrinsics_of_kitti_are_of_no_numbered_camera(tmp_path: Path) -> None:
    files = {**kitti_in(tmp_path / "00"), "calibration": None, "intrinsics": (FX, FX, CX, CY)}
    assert len(read_kitti(**files).cameras) == 1
    said = refusal(lambda: read_kitti(**files, cameras=(2,)))
    assert "camera 2: is one of calib.txt, intrinsics are of the only camera there is" in said


def test_boxes_of_other_cameras_of_kitti_stop_no_import(tmp_path: Path) -> None:
    """In tables of frames and in those of names."""
    files = kitti_in(tmp_path / "00")
    size = "10,10,20,30"
    frames = write(tmp_path / "f.csv", f"frame,camera,x1,y1,x2,y2\n0,2,{size}\n0,3,{size}\n")
    images = write(tmp_path / "i.csv", f"image,x1,y1,x2,y2\nimage_2/000000.png,{size}\nimage_3/000000.png,{size}\n")
    for csv, name in ((frames, "image_3/frame 0"), (images, "image_3/000000.png")):
        dataset = read_kitti(**files, cameras=(2,), detections=csv)
        assert len(dataset.detections) == 1
        assert not_chosen(dataset) == [name]
    write(frames, f"frame,camera,x1,y1,x2,y2\n0,2,{size}\n0,7,{size}\n")
    assert "'image_7/frame 0'" in refusal(lambda: read_kitti(**files, cameras=(2,), detections=frames))


def test_frames_and_cameras_of_kitti_are_numbers(tmp_path: Path) -> None:
    files = kitti_in(tmp_path / "00")
    csv = write(tmp_path / "boxes.csv", "frame,x1,y1,x2,y2\n000001.png,10,10,20,30\n")
    said = refusal(lambda: read_kitti(**files, detections=csv))
    assert "line 2: frame: expected a number, found '000001.png'" in said
    assert "--detection-column image=frame" in said
    write(csv, "frame,camera,x1,y1,x2,y2\n1,image_2,10,10,20,30\n")
    assert "line 2: camera: expected a number, found 'image_2'" in refusal(lambda: read_kitti(**files, detections=csv))


def test_times_of_kitti_rise(tmp_path: Path) -> None:
    files = kitti_in(tmp_path / "00")
    write(files["times"], "\n".join(reversed(files["times"].read_text().split())))
    said = refusal(lambda: read_kitti(**files))
    assert "times.txt line 2: expected times that rise, found 0.5 after 1" in said


def test_kitti_on_the_earth(tmp_path: Path) -> None:
    """The first camera looks north, level: with that heading the world is east, north, up about it."""
    files = kitti_in(tmp_path / "00")
    dataset = read_kitti(**files, cameras=(2,), anchor=(49.0, 8.4, 115.0), heading_deg=0.0)
    assert_allclose(camera_centers(dataset.images), CENTERS - CENTERS[0], atol=1e-9)
    assert dataset.frame.anchor == (49.0, 8.4, 115.0)
    east = read_kitti(**files, cameras=(2,), anchor=(49.0, 8.4, 115.0), heading_deg=90.0)
    north_m, east_m = (CENTERS - CENTERS[0])[:, 1], (CENTERS - CENTERS[0])[:, 0]
    assert_allclose(camera_centers(east.images)[:, :2], np.stack([north_m, -east_m], axis=1), atol=1e-9)
    assert "goes with an anchor" in refusal(lambda: read_kitti(**files, heading_deg=0.0))
    assert "expected one of them" in refusal(lambda: read_kitti(**{**files, "calibration": None}))
    assert "expected rows P1" in refusal(lambda: read_kitti(**files, cameras=(1, 2)))


# KITTI-360.


def kitti360_in(folder: Path) -> Path:
    car_from_cam, camera_in_car = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.5, 0.3, 1.2])
    rectified = Rotation.from_euler("xyz", [0.02, -0.01, 0.03]).as_matrix()  # Rectified from raw camera axes.
    raw_in_car = car_from_cam @ rectified
    rows, raw_rows = [], []
    for i, (rotation, center) in enumerate(zip(WORLD_FROM_CAM, CENTERS, strict=True)):
        world_from_car = rotation @ car_from_cam.T
        rows.append(f"{i + 5} {numbers(np.column_stack([world_from_car, center - world_from_car @ camera_in_car]))}")
    raw_rows.append(f"image_00: {numbers(np.column_stack([raw_in_car, camera_in_car]))}")
    raw_rows.append(f"image_02: {numbers(np.column_stack([car_from_cam, camera_in_car]))}")
    write(folder / "data_poses" / "drive" / "poses.txt", "\n".join(rows) + "\n")
    write(folder / "calibration" / "calib_cam_to_pose.txt", "\n".join(raw_rows) + "\n")
    projection = numbers([[FX, 0, CX - 0.5, 0], [0, FY, CY - 0.5, 0], [0, 0, 1, 0]])
    write(
        folder / "calibration" / "perspective.txt",
        f"calib_time: 09-Jan-2012\nS_rect_00: {WIDTH} {HEIGHT}\n"
        f"R_rect_00: {numbers(rectified)}\nP_rect_00: {projection}\n",
    )
    write(
        folder / "calibration" / "image_02.yaml",
        "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: image_02\nimage_width: 1400\nimage_height: 1400\n"
        "mirror_parameters:\n   xi: 2.2134047507854890e+00\ndistortion_parameters:\n   k1: 1.6798235660113681e-02\n"
        "   k2: 1.6548773243373522e+00\n   p1: 4.2223943394772046e-04\n   p2: 4.2462134260997584e-04\n"
        "projection_parameters:\n   gamma1: 1.3363220825849971e+03\n   gamma2: 1.3357883350012958e+03\n"
        "   u0: 7.1694323510126321e+02\n   v0: 7.0576498308221585e+02\n",
    )
    stamps = [f"2020-09-13 12:26:4{i}.000000000" for i in range(8)]
    write(folder / "data_2d_raw" / "drive" / "image_00" / "timestamps.txt", "\n".join(stamps) + "\n")
    return folder


def test_kitti360(tmp_path: Path) -> None:
    folder = kitti360_in(tmp_path / "K")
    names = [f"drive/image_00/data_rect/{i + 5:010d}.png" for i in range(3)]
    dataset = read_kitti360(folder, sequence="drive", detections=boxes(tmp_path, names))
    check_scene(dataset, seconds=False)
    assert dataset.images.timestamp_s is not None
    assert_allclose(dataset.images.timestamp_s - 1_600_000_000, [5, 6, 7])
    assert "expected some of 0, 1, 2, 3" in refusal(lambda: read_kitti360(folder, sequence="drive", cameras=(4,)))


def test_boxes_of_other_sequences_and_cameras_of_kitti360_stop_no_import(tmp_path: Path) -> None:
    folder, sequence = kitti360_in(tmp_path / "K"), "2013_05_28_drive_0000_sync"
    for place in ("data_poses", "data_2d_raw"):
        (folder / place / "drive").rename(folder / place / sequence)
    last = "data_rect/0000000005.png"
    others = [f"2013_05_28_drive_0002_sync/image_00/{last}", f"{sequence}/image_01/{last}"]
    rows = [f"{name},100,100,110,120" for name in (f"{sequence}/image_00/{last}", *others)]
    csv = write(tmp_path / "boxes.csv", "\n".join(["image,x1,y1,x2,y2", *rows]) + "\n")
    dataset = read_kitti360(folder, sequence=sequence, detections=csv)
    assert len(dataset.detections) == 1
    assert not_chosen(dataset) == sorted(others)


def test_the_fisheye_of_kitti360_is_that_of_mei(tmp_path: Path) -> None:
    """By the formula of Mei and Rives: onto the unit sphere, to z + xi, distorted, scaled."""
    dataset = read_kitti360(kitti360_in(tmp_path), sequence="drive", cameras=(2, 0))
    assert dataset.cameras.model.texts() == ["PINHOLE", "THIN_PRISM_FISHEYE"]
    camera = colmap_camera(dataset.cameras, 1)
    xi, k1, k2, p1, p2 = (
        2.213404750785489,
        0.016798235660113681,
        1.6548773243373522,
        4.2223943394772046e-4,
        4.2462134260997584e-4,
    )
    for direction in ([0.3, -0.2, 1.0], [-2.0, 1.0, 0.5], [5.0, 3.0, 0.4], [0.0, 0.0, 1.0]):
        ray = np.array(direction) / np.linalg.norm(direction)
        x, y = ray[:2] / (ray[2] + xi)
        r2 = x * x + y * y
        radial = 1.0 + k1 * r2 + k2 * r2**2
        u = 1336.3220825849971 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 716.94323510126321 + 0.5
        v = 1335.7883350012958 * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + 705.76498308221585 + 0.5
        assert_allclose(np.asarray(camera.img_from_cam(ray[None]))[0], [u, v], atol=0.05)
    assert dataset.images.rig_id is not None
    assert dataset.images.rig_id.tolist() == [0, 1, 2, 0, 1, 2]


def test_a_fisheye_of_kitti360_may_have_tangential_distortion(tmp_path: Path) -> None:
    """Like its camera 3, of which no fisheye with radial distortion alone is within half a pixel."""
    folder = kitti360_in(tmp_path)
    path = folder / "calibration" / "image_02.yaml"
    text = re.sub(r"(?m)^   (\w+):.*$", "   \\1: NUMBER", path.read_text())
    for number in (2.55, 0.05, 4.5, 0.00135, -0.0007, 1485.0, 1485.0, 699.5, 699.5):
        text = text.replace("NUMBER", str(number), 1)
    write(path, text)
    camera = colmap_camera(read_kitti360(folder, sequence="drive", cameras=(2,)).cameras, 0)
    # To the left, up and 45 degrees off the axis.
    x = -0.5 / (0.5**0.5 + 2.55)
    r2 = 2.0 * x * x
    radial = x * (1.0 + 0.05 * r2 + 4.5 * r2 * r2)
    u = 1485.0 * (radial + 2 * 0.00135 * x * x - 0.0007 * (r2 + 2 * x * x)) + 700.0
    v = 1485.0 * (radial - 2 * 0.0007 * x * x + 0.00135 * (r2 + 2 * x * x)) + 700.0
    ray = np.array([[-0.5, -0.5, 0.5**0.5]])
    assert_allclose(np.asarray(camera.img_from_cam(ray))[0], [u, v], atol=0.1)


# Mapillary.


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def tile(corners: list[tuple[int, int]], extent: int = 4096) -> str:
    """A vector tile with one polygon, by the specification: tags, lengths, commands, zigzag deltas."""
    commands, last = [9], (0, 0)  # Move to, once.
    for i, corner in enumerate(corners):
        if i == 1:
            commands.append((len(corners) - 1) << 3 | 2)  # Line to.
        commands += [(d << 1) ^ (d >> 31) for d in (corner[0] - last[0], corner[1] - last[1])]
        last = corner
    geometry = b"".join(map(varint, [*commands, 15]))
    feature = b"\x18\x03" + b"\x22" + varint(len(geometry)) + geometry
    layer = b"\x0a\x06mpy-or" + b"\x12" + varint(len(feature)) + feature + b"\x28" + varint(extent) + b"\x78\x02"
    return base64.b64encode(b"\x1a" + varint(len(layer)) + layer).decode()


# Where a point of the picture as stored is in the picture as shown, fractions from the top left, by EXIF orientation.
SHOWN: dict[int, Callable[[float, float], tuple[float, float]]] = {
    1: lambda x, y: (x, y),
    3: lambda x, y: (1.0 - x, 1.0 - y),
    6: lambda x, y: (1.0 - y, x),
    8: lambda x, y: (y, 1.0 - x),
}


def mapillary_in(folder: Path, orientation: int = 1) -> Path:
    """Radial cameras with positions from ENU, rotations about local axes, and outlines in 4096ths of the picture."""
    data = []
    for i, (rotation, center) in enumerate(zip(WORLD_FROM_CAM, CENTERS, strict=True)):
        x, y = (p := rotation.T @ (OBJECT - center))[:2] / p[2]
        distorted = np.array([x, y]) * (1 - 0.05 * (x * x + y * y))
        u, v = 640 * 0.8 * distorted + [320, 240]
        half = 40
        cx, cy = (4096 * part for part in SHOWN[orientation](u / 640, v / 480))
        box = [(cx - half, cy - half), (cx + half, cy - half), (cx + half, cy + half), (cx - half, cy + half)]
        corners = [(round(a), round(b)) for a, b in box]
        lon, lat, height = lon_lat_height_of(center)
        data.append(
            {
                "id": str(1000 + i),
                "sequence": "seq",
                "captured_at": int(STAMPS_NS[i] // 1_000_000),
                "geometry": {"type": "Point", "coordinates": [9.0, 9.0]},
                "computed_geometry": {"type": "Point", "coordinates": [lon, lat]},
                "computed_altitude": height,
                "computed_rotation": Rotation.from_matrix(rotation.T).as_rotvec().tolist(),
                "camera_type": "perspective",
                "camera_parameters": [0.8, -0.05, 0.0],
                "width": WIDTH,
                "height": HEIGHT,
                "exif_orientation": orientation,
                "detections": {"data": [{"id": f"d{i}", "value": "object--traffic-light", "geometry": tile(corners)}]},
            }
        )
    return write(folder / "images.json", json.dumps({"data": data}))


def test_mapillary(tmp_path: Path) -> None:
    """Outlines are rounded to 4096ths, 0.08 px, which is 5 mm at 30 m."""
    path = mapillary_in(tmp_path / "m")
    dataset = read_mapillary(path, anchor=(LAT, LON, 0.0))
    check_scene(dataset, within_m=0.01)
    assert dataset.detections.class_name.texts() == ["object--traffic-light"] * 3
    assert_allclose(dataset.detections.size_px, [[80 / 4096 * 640, 80 / 4096 * 480]] * 3)
    assert dataset.images.pass_id.texts() == ["seq"] * 3


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_outlines_of_mapillary_are_in_pictures_as_shown(tmp_path: Path, orientation: int) -> None:
    """Its cameras and rotations are of pictures as stored, its outlines of pictures turned upright."""
    check_scene(read_mapillary(mapillary_in(tmp_path, orientation), anchor=(LAT, LON, 0.0)), within_m=0.01)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_mapillary_without_structure_from_motion_is_level_as_shown(tmp_path: Path, orientation: int) -> None:
    """A quarter right of the middle of the picture, as people see it upright, and on the horizon."""
    image = {
        "id": 7,
        "width": 1000,
        "height": 500,
        "camera_type": "perspective",
        "camera_parameters": [1.0, 0.0, 0.0],
        "compass_angle": 30.0,
        "geometry": {"type": "Point", "coordinates": [LON, LAT]},
        "exif_orientation": orientation,
        "detections": [{"value": "a", "geometry": tile([(3062, 2038), (3082, 2038), (3082, 2058), (3062, 2058)])}],
    }
    dataset = read_mapillary(write(tmp_path / "images.json", json.dumps(image)))
    right_px = (500 if orientation in (6, 8) else 1000) / 4
    assert_allclose(azimuths_deg(dataset), 30.0 + np.degrees(np.arctan(right_px / 1000.0)), atol=1e-9)
    assert_allclose(cast_rays(dataset).direction_in_world[:, 2], 0.0, atol=1e-12)


def test_mapillary_without_structure_from_motion_is_level_with_its_compass(tmp_path: Path) -> None:
    image = {
        "id": 7,
        "width": 1000,
        "height": 500,
        "camera_type": "spherical",
        "compass_angle": 30.0,
        "geometry": {"type": "Point", "coordinates": [LON, LAT]},
        "captured_at": 5000,
    }
    outline = tile([(1024, 2048), (1024, 2048), (1024, 2048)])
    eleventh = {"7": [{"value": "a", "geometry": tile([(3062, 2038), (3082, 2038), (3082, 2058), (3062, 2058)])}]}
    write(tmp_path / "images.json", json.dumps(image))
    write(tmp_path / "detections.json", json.dumps(eleventh))
    dataset = read_mapillary(tmp_path)
    assert_allclose(azimuths_deg(dataset), 30.0 + 90.0, atol=1e-9)
    assert_allclose(cast_rays(dataset).direction_in_world[:, 2], 0.0, atol=1e-12)
    write(tmp_path / "detections.json", json.dumps({"7": [{"value": "a", "geometry": outline}]}))
    assert "its width or height is not above 0" in refusal(lambda: read_mapillary(tmp_path))


@pytest.mark.parametrize("kept", ["by id", "features", "lines"])
def test_answers_of_mapillary_as_people_keep_them(tmp_path: Path, kept: str) -> None:
    """Asked for many ids it answers with an object of them; programs write GeoJSON, or an image a line."""
    images = json.loads(mapillary_in(tmp_path / "asked").read_text())["data"]
    if kept == "by id":
        path = write(tmp_path / "images.json", json.dumps({image["id"]: image for image in images}))
    elif kept == "features":
        features = [
            {"type": "Feature", "geometry": image.pop("computed_geometry"), "properties": image} for image in images
        ]
        for image in images:
            del image["geometry"]
        path = write(tmp_path / "a.geojson", json.dumps({"type": "FeatureCollection", "features": features}))
    else:
        lines = [*map(json.dumps, images), "", json.dumps({"__complete__": True})]
        path = write(tmp_path / "metadata.jsonl", "\n".join(lines))
    check_scene(read_mapillary(path, anchor=(LAT, LON, 0.0)), within_m=0.01)
    if kept == "lines":
        write(path, "\n".join(lines).replace('"1001"', "?"))
        assert "metadata.jsonl line 2: cannot be read as JSON" in refusal(lambda: read_mapillary(tmp_path))


def test_altitudes_of_mapillary_are_of_one_kind(tmp_path: Path) -> None:
    """Computed ones count from near the ground, stated ones from the sea."""
    path = mapillary_in(tmp_path)
    content = json.loads(path.read_text())
    first, second, third = content["data"]

    def heights() -> list[float]:
        write(path, json.dumps(content))
        found: list[float] = camera_centers(read_mapillary(path, anchor=(LAT, LON, 0.0)).images)[:, 2].round(2).tolist()
        return found

    first |= {"computed_altitude": 3.0, "altitude": 80.0, "sequence": "a"}
    second |= {"computed_altitude": None, "altitude": 81.0, "sequence": "a"}
    third |= {"computed_altitude": 7.0, "altitude": 82.0, "sequence": "b"}
    assert heights() == [3.0, 3.0, 7.0]
    second["sequence"] = "c"
    assert heights() == [3.0, 5.0, 7.0]
    first["computed_altitude"] = third["computed_altitude"] = second["altitude"] = None
    assert heights() == [80.0, 81.0, 82.0]
    first["altitude"] = third["altitude"] = None
    assert heights() == [2.0, 2.0, 2.0]


def test_detections_of_mapillary_are_in_one_file(tmp_path: Path) -> None:
    """Those in a file of another form are refused, and not left out without a word."""
    mapillary_in(tmp_path)
    write(tmp_path / "detections.jsonl", '{"image": {"id": "11"}, "value": "a", "geometry": "AAAA"}\n')
    assert "detections.jsonl line 1: expected 'id'" in refusal(lambda: read_mapillary(tmp_path))


@pytest.mark.parametrize("geometry", ["", "?", "AAAA", "GgA=", base64.b64encode(b"\x1a\xff\xff\xff").decode(), 5, None])
def test_outlines_that_are_no_tiles(tmp_path: Path, geometry: Any) -> None:
    path = mapillary_in(tmp_path)
    content = json.loads(path.read_text())
    content["data"][0]["detections"]["data"][0]["geometry"] = geometry
    write(path, json.dumps(content))
    assert "data[0]: detections: data[0]: geometry: expected" in refusal(lambda: read_mapillary(path))


# Panoramax.


def panoramax_in(folder: Path) -> Path:
    """A panorama heading east sees something a quarter turn right; a pinhole of 90 degrees its right edge."""
    ring = [[1499, 499], [1501, 499], [1501, 501], [1499, 501], [1499, 499]]
    pano = {
        "datetime": "2023-11-14T22:13:20+00:00",
        "view:azimuth": 90,
        "quality:horizontal_accuracy": 1.5,
        "pers:interior_orientation": {"field_of_view": 360, "sensor_array_dimensions": [2000, 1000]},
        "annotations": [
            {
                "id": "x",
                "shape": {"type": "Polygon", "coordinates": [ring]},
                "semantics": [{"key": "osm|traffic_sign", "value": "stop"}],
            }
        ],
    }
    flat = {
        **pano,
        "view:azimuth": 10,
        "pers:interior_orientation": {"field_of_view": 90, "sensor_array_dimensions": [800, 600]},
        "annotations": [{"shape": [790, 295, 800, 305], "semantics": [{"key": "osm|traffic_sign", "value": "stop"}]}],
    }
    items = [
        {
            "type": "Feature",
            "id": key,
            "collection": "c",
            "geometry": {"type": "Point", "coordinates": [LON + i * 1e-4, LAT]},
            "properties": properties,
        }
        for i, (key, properties) in enumerate((("a", pano), ("b", flat)))
    ]
    return write(folder / "items.json", json.dumps({"type": "FeatureCollection", "features": items}))


def test_panoramax(tmp_path: Path) -> None:
    dataset = read_panoramax(panoramax_in(tmp_path), camera_height_m=2.0)
    assert_allclose(azimuths_deg(dataset), [180.0, 10.0 + np.degrees(np.arctan(395.0 / 400.0))], atol=1e-3)
    assert dataset.detections.class_name.texts() == ["osm|traffic_sign=stop"] * 2
    assert dataset.images.name.to_pylist() == ["a.jpg", "b.jpg"]
    assert dataset.images.timestamp_s is not None
    assert dataset.images.timestamp_s[0] == 1_700_000_000.0
    assert dataset.images.position_sigma_m is not None
    assert_allclose(dataset.images.position_sigma_m, 1.5)
    by_key = read_panoramax(tmp_path, class_key="osm|traffic_sign")
    assert by_key.detections.class_name.texts() == ["stop"] * 2
    assert by_key.frame.anchor == (LAT, LON, 0.0)
    away = enu_from_lon_lat_height(np.array([[LON + 1e-4, LAT, 0.0]]), (LAT, LON, 0.0))
    assert_allclose(camera_centers(by_key.images)[1], away[0], atol=1e-9)


def test_items_of_panoramax_without_a_heading_or_a_place_are_named(tmp_path: Path) -> None:
    path = panoramax_in(tmp_path)
    content = json.loads(path.read_text())
    first = content["features"][0]
    content["features"] += [
        {**first, "id": "c", "properties": {**first["properties"], "view:azimuth": None}},
        {**first, "id": "d", "geometry": None},
    ]
    write(path, json.dumps(content))
    assert "c.jpg: it has no view:azimuth" in refusal(lambda: read_panoramax(path))
    rejected = read_panoramax(path, max_rejected=0.5).rejected
    assert rejected is not None
    reasons = dict(zip(rejected.image_name.to_pylist()[:2], rejected.reason.texts()[:2], strict=True))
    assert reasons == {
        "c.jpg": "it has no view:azimuth, the heading of its middle",
        "d.jpg": "it has no geometry, its place",
    }


def test_a_key_that_no_annotation_of_panoramax_has_is_refused(tmp_path: Path) -> None:
    said = refusal(lambda: read_panoramax(panoramax_in(tmp_path), class_key="osm|highway"))
    assert "class-key osm|highway: none of 2 annotations in" in said
    assert "they have osm|traffic_sign" in said


def test_classes_and_scores_of_panoramax_as_it_gives_them(tmp_path: Path) -> None:
    """Tags come in the order of their keys: what a detector says of its tags stands before them."""
    sign = "osm|traffic_sign"
    told = {
        "a=1": ([f"detection_confidence[{sign}=yes]=0.3", f"detection_model[{sign}=yes]=m/1", f"{sign}=yes"], 0.3),
        "b=2": ([f"classification_confidence[{sign}=A[1]]=0.5", f"{sign}=A[1]"], 0.5),
        "c=3": (
            [
                f"classification_confidence[{sign}=A]=0.5",
                f"detection_confidence[{sign}=yes]=0.4",
                f"{sign}=yes",
                f"{sign}=A",
            ],
            0.4,
        ),
        "d=4": ([f"detection_confidence[{sign}=*]=0.6", f"{sign}=A"], 0.6),
        "e=5": (["detection_confidence[osm|amenity=bench]=0.2", f"{sign}=A"], 1.0),
        "f=6": ([f"classification_confidence[{sign}=*]=0.7", f"{sign}=A"], 0.7),
        "g=7": ([f"detection_confidence[{sign}]=0.8", f"{sign}=A"], 0.8),
    }
    path = panoramax_in(tmp_path)
    content = json.loads(path.read_text())
    del content["features"][1]
    content["features"][0]["properties"]["annotations"] = [
        {
            "shape": [100 * i, 100, 100 * i + 20, 120],
            "semantics": [dict(zip(("key", "value"), tag.rsplit("=", 1), strict=True)) for tag in tags],
        }
        for i, (tags, _) in enumerate(told.values())
    ]
    boxes = read_panoramax(write(path, json.dumps(content))).detections
    values = ["yes", "A[1]", *["A"] * 5]
    assert boxes.class_name.texts() == [f"{sign}={value}" for value in values]
    assert boxes.score.tolist() == [score for _, score in told.values()]
    assert read_panoramax(path, class_key=sign).detections.class_name.texts() == values
    content["features"][0]["properties"]["annotations"][0]["semantics"][0]["value"] = "high"
    write(path, json.dumps(content))
    assert "a number is missing or not finite" in refusal(lambda: read_panoramax(path))


@pytest.mark.parametrize("kept", ["list", "lines"])
def test_older_panoramas_of_panoramax_are_as_large_as_their_tiles(tmp_path: Path, kept: str) -> None:
    """They do not say how large they are, nor how much they show; a list of items, or one a line, will do."""
    whole = read_panoramax(panoramax_in(tmp_path / "whole"))
    items = json.loads((tmp_path / "whole" / "items.json").read_text())["features"]
    del items[0]["properties"]["pers:interior_orientation"]["sensor_array_dimensions"]
    del items[0]["properties"]["pers:interior_orientation"]["field_of_view"]
    level = {"tileWidth": 62.5, "tileHeight": 125, "matrixWidth": 32, "matrixHeight": 8}
    items[0]["properties"]["tiles:tile_matrix_sets"] = {"geovisio": {"tileMatrix": [level]}}
    if kept == "list":
        path = write(tmp_path / "items.json", json.dumps(items))
    else:
        path = write(tmp_path / "items.ndjson", "\n".join(map(json.dumps, items)))
    assert_allclose(azimuths_deg(read_panoramax(path)), azimuths_deg(whole))
    level |= {"tileWidth": 1e200, "matrixWidth": 1e200}
    write(path, json.dumps(items) if kept == "list" else "\n".join(map(json.dumps, items)))
    assert "tileMatrix[0]: expected sizes of tiles" in refusal(lambda: read_panoramax(path))


def test_what_mapillarys_api_answers_besides_images_is_told(tmp_path: Path) -> None:
    """An error; a document a line in a file that is not called so; and images that were not computed."""
    answer = {"error": {"message": "Invalid OAuth access token", "type": "OAuthException", "code": 190}}
    path = write(tmp_path / "e.json", json.dumps(answer))
    assert "the API answered with an error: Invalid OAuth access token" in refusal(lambda: read_mapillary(path))
    images = json.loads(mapillary_in(tmp_path).read_text())["data"]
    lines = write(tmp_path / "lines.json", "\n".join(map(json.dumps, images)))
    assert len(read_mapillary(lines).images) == 3
    write(lines, json.dumps(images[0]) + "\n{")
    assert "lines.json line 2: cannot be read as JSON" in refusal(lambda: read_mapillary(lines))
    del images[0]["computed_rotation"]
    images[0]["compass_angle"] = 90.0
    (note,) = notes_of(read_mapillary, write(tmp_path / "i.json", json.dumps(images)))
    assert "1 of 3 images have no computed_geometry or no computed_rotation" in note


def test_pages_of_mapillary_that_are_not_here_are_told(tmp_path: Path) -> None:
    """Each names the next one with the cursor after it; the last one names none."""
    images = json.loads(mapillary_in(tmp_path / "all").read_text())["data"]
    asked = "https://graph.mapillary.com/images?creator_username=c&limit=1&after="
    for i, image in enumerate(images):
        paging = {"cursors": {"before": f"b{i}", "after": f"a{i}"}, **({"next": f"{asked}a{i}"} if i < 2 else {})}
        write(tmp_path / "pages" / f"{i}.json", json.dumps({"data": [image], "paging": paging}))
    assert notes_of(read_mapillary, tmp_path / "pages") == []
    assert len(read_mapillary(tmp_path / "pages").images) == 3
    (note,) = notes_of(read_mapillary, tmp_path / "pages" / "0.json")
    assert "0.json: says that a further page follows, which is not here (1 answers)" in note
    assert "give a folder of all of them" in note
    write(tmp_path / "pages" / "2.json", "[]")
    (note,) = notes_of(read_mapillary, tmp_path / "pages")
    assert "1.json: says that a further page follows" in note


def test_detections_of_mapillary_that_are_not_here_are_told(tmp_path: Path) -> None:
    path = mapillary_in(tmp_path)
    content = json.loads(path.read_text())
    content["data"][1]["detections"]["paging"] = {"next": "https://graph.mapillary.com/1001/detections?after=x"}
    write(path, json.dumps(content))
    (note,) = notes_of(read_mapillary, path)
    assert "data[1]: detections: says that there are more detections, which are not here (1 answers)" in note


def test_as_many_images_as_mapillary_answers_with_at_most_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("valuemap.readers.mapillary._MOST_AT_ONCE", 3)
    (note,) = notes_of(read_mapillary, mapillary_in(tmp_path))
    assert "has 3 images, the most that Mapillary answers with" in note


def test_pages_of_panoramax_that_are_not_here_are_told(tmp_path: Path) -> None:
    """Each says its own address and that of the next one; another collection is whole."""
    items = json.loads(panoramax_in(tmp_path / "all").read_text())["features"]
    place = "https://api.example/api/collections/{}/items?limit=1"
    first, second, other = place.format("c"), place.format("c") + "&startAfterRank=1", place.format("d")
    for name, item, itself, following in (
        ("1.json", items[0], first, second),
        ("2.json", items[1], second, None),
        ("d.json", {**items[0], "id": "z", "collection": "d"}, other, None),
    ):
        links = [{"rel": "self", "href": itself}, *([{"rel": "next", "href": following}] if following else [])]
        page = {"type": "FeatureCollection", "features": [item], "links": links}
        write(tmp_path / "pages" / name, json.dumps(page))
    assert notes_of(read_panoramax, tmp_path / "pages") == []
    (tmp_path / "pages" / "2.json").unlink()
    (note,) = notes_of(read_panoramax, tmp_path / "pages")
    assert "1.json: says that a further page follows, which is not here (1 answers)" in note


@pytest.mark.parametrize("missing", ["place", "heading"])
@pytest.mark.parametrize("name", ["mapillary", "panoramax"])
def test_an_image_without_a_pose_is_left_out_and_listed(tmp_path: Path, name: str, missing: str) -> None:
    """One of many must not stop the others; what stands in its place is null, or nothing."""
    if name == "mapillary":
        path = mapillary_in(tmp_path)
        content = json.loads(path.read_text())
        image = content["data"][1]
        if missing == "place":
            del image["computed_geometry"]
            image["geometry"] = None
        else:
            del image["computed_rotation"]
            image["compass_angle"] = None
    else:
        path = panoramax_in(tmp_path)
        content = json.loads(path.read_text())
        item = content["features"][1]
        if missing == "place":
            item["geometry"] = None
        else:
            item["properties"]["view:azimuth"] = None
    write(path, json.dumps(content))
    read: Callable[..., Any] = read_mapillary if name == "mapillary" else read_panoramax
    assert " cannot be used" in refusal(lambda: read(path))
    dataset = read(path, max_rejected=0.5)
    left_out = "1001.jpg" if name == "mapillary" else "b.jpg"
    assert left_out not in dataset.images.name.to_pylist()
    assert dataset.rejected is not None
    assert set(dataset.rejected.image_name.to_pylist()) == {left_out}


@pytest.mark.parametrize("name", ["mapillary", "panoramax"])
def test_an_image_that_two_answers_tell_the_same_of_is_one(tmp_path: Path, name: str) -> None:
    """Questions for places next to each other have images in common."""
    path = (mapillary_in if name == "mapillary" else panoramax_in)(tmp_path / "once")
    read: Callable[..., Any] = read_mapillary if name == "mapillary" else read_panoramax
    once = read(path)
    first, second = json.loads(path.read_text()), json.loads(path.read_text())
    images = second["data" if name == "mapillary" else "features"]
    images[0]["thumb_url"] = "of another hour"
    del images[1:]
    for number, content in enumerate((second, first)):
        write(tmp_path / "twice" / f"{number}.json", json.dumps(content))
    twice = read(tmp_path / "twice")
    assert_allclose(camera_centers(twice.images), camera_centers(once.images))
    assert_allclose(twice.detections.center_px, once.detections.center_px)
    assert twice.rejected is None
    if name == "mapillary":
        images[0]["computed_altitude"] += 1.0
    else:
        images[0]["properties"]["view:azimuth"] += 1.0
    write(tmp_path / "twice" / "0.json", json.dumps(second))
    assert "occur more than once" in refusal(lambda: read(tmp_path / "twice"))


@pytest.mark.parametrize("name", ["mapillary", "panoramax"])
def test_a_box_without_a_class_is_left_out_and_listed(tmp_path: Path, name: str) -> None:
    if name == "mapillary":
        path = mapillary_in(tmp_path)
        content = json.loads(path.read_text())
        del content["data"][1]["detections"]["data"][0]["value"]
    else:
        path = panoramax_in(tmp_path)
        content = json.loads(path.read_text())
        content["features"][1]["properties"]["annotations"][0]["semantics"] = None
    write(path, json.dumps(content))
    read: Callable[..., Any] = read_mapillary if name == "mapillary" else read_panoramax
    assert "its class is missing" in refusal(lambda: read(path))
    assert len(read(path, max_rejected=0.5).detections) == (2 if name == "mapillary" else 1)


def test_panoramas_that_are_cut_are_refused(tmp_path: Path) -> None:
    """Their heights are angles too: taken for half a turn, all that is off the horizon is somewhere else."""
    path = opensfm_in(tmp_path, {"projection_type": "spherical", "width": 4096, "height": 1024})
    assert "expected a panorama twice as wide as high, found 4096 x 1024" in refusal(lambda: read_opensfm(path))


LEFT_OUT: dict[str, tuple[str, dict[str, Any], str]] = {
    "mapillary, not processed": (
        "mapillary",
        {"camera_parameters": None, "camera_type": None},
        "it has no camera_type, or no camera_parameters: it was not processed, or they were not asked for",
    ),
    "mapillary, without parameters": ("mapillary", {"camera_parameters": []}, "it has no camera_type, or no camera_pa"),
    "mapillary, of another camera": ("mapillary", {"camera_type": "brown"}, "its camera_type is none of perspective"),
    "mapillary, cut": (
        "mapillary",
        {"camera_type": "spherical", "camera_parameters": [], "width": 4096, "height": 1024},
        "is a panorama that is cut",
    ),
    "panoramax, without a size": (
        "panoramax",
        {"pers:interior_orientation": {"field_of_view": 90}},
        "it has no size",
    ),
    "panoramax, without a field of view": (
        "panoramax",
        {"pers:interior_orientation": {"sensor_array_dimensions": [800, 600]}},
        "it has no field_of_view",
    ),
    "panoramax, without a camera": ("panoramax", {"pers:interior_orientation": {}}, "it has no size"),
    "panoramax, too wide": (
        "panoramax",
        {"pers:interior_orientation": {"field_of_view": 215, "sensor_array_dimensions": [800, 600]}},
        "its field_of_view is not that of a pinhole",
    ),
    "panoramax, not twice as wide as high": (
        "panoramax",
        {"pers:interior_orientation": {"field_of_view": 360, "sensor_array_dimensions": [4096, 1024]}},
        "is a panorama that is cut",
    ),
    "panoramax, a part of the whole that is no flat picture": (
        "panoramax",
        {
            "pers:interior_orientation": {
                "field_of_view": 100,
                "sensor_array_dimensions": [640, 480],
                "visible_area": [0, 512, 0, 512],
            }
        },
        "is a panorama that is cut",
    ),
    "panoramax, a part of the whole": (
        "panoramax",
        {
            "pers:interior_orientation": {
                "field_of_view": 360,
                "sensor_array_dimensions": [4096, 2048],
                "visible_area": [0, 512, 0, 512],
            }
        },
        "is a panorama that is cut",
    ),
}


@pytest.mark.parametrize("case", LEFT_OUT)
def test_images_without_a_usable_camera_are_left_out_with_their_boxes(tmp_path: Path, case: str) -> None:
    """One of an area that somebody asked for must not stop the others."""
    name, change, reason = LEFT_OUT[case]
    path = (mapillary_in if name == "mapillary" else panoramax_in)(tmp_path)
    content = json.loads(path.read_text())
    gone, total = ("1001.jpg", 3) if name == "mapillary" else ("b.jpg", 2)
    (content["data"][1] if name == "mapillary" else content["features"][1]["properties"]).update(change)
    read: Callable[..., Any] = read_mapillary if name == "mapillary" else read_panoramax
    write(path, json.dumps(content))
    said = refusal(lambda: read(path))
    assert f"1 of {total} pictures cannot be used: {gone}: {reason}" in said
    assert f"--max-rejected {0.34 if total == 3 else 0.5}" in said
    dataset = read(path, max_rejected=0.5)
    assert gone not in dataset.images.name.to_pylist()
    assert len(dataset.detections) == len(dataset.images) == total - 1
    assert dataset.rejected is not None
    assert dataset.rejected.image_name.to_pylist() == [gone, gone]
    assert dataset.rejected.reason.texts()[0].startswith(reason)
    assert dataset.rejected.reason.texts()[1] == "its image was left out"
    # Boxes of a file of their own, too.
    names = ["1000", "1001", "1002"] if name == "mapillary" else ["a", "b"]
    table = "\n".join(["image,x1,y1,x2,y2", *(f"{each}.jpg,10,10,20,20" for each in names)])
    of_file = read(path, detections=write(tmp_path / "boxes.csv", table), max_rejected=0.5)
    assert len(of_file.detections) == total - 1
    assert len(of_file.rejected) == 2


def test_poses_without_numbers_are_not_interpolated() -> None:
    rotation = np.array([np.eye(3), np.full((3, 3), np.nan), np.eye(3)])
    times, center = np.array([0, 10, 20]), np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    _, between, usable = interpolate_poses(np.array([5, 15]), times, rotation, center, 100)
    assert usable.all()
    assert_allclose(between[:, 0], [0.5, 1.5])
    _, nowhere, usable = interpolate_poses(np.array([5]), times[1:2], rotation[1:2], center[1:2], 100)
    assert not usable.any()
    assert np.isnan(nowhere).all()


# What all must refuse, each in one line.


FORMATS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any], tuple[str, ...]]] = {
    "tum": (tum_in, lambda p: read_tum(p / "trajectory.txt", camera=CAMERA), ("trajectory.txt",)),
    "kapture": (
        kapture_in,
        read_kapture,
        tuple(f"sensors/{name}.txt" for name in ("sensors", "trajectories", "records_camera")),
    ),
    "opendronemap": (opendronemap_in, read_opendronemap, ("odm_report/shots.geojson",)),
    "opensfm": (opensfm_in, read_opensfm, ("reconstruction.json",)),
    "nuscenes": (
        nuscenes_in,
        read_nuscenes,
        ("scene.json", "sample_data.json", "ego_pose.json", "calibrated_sensor.json"),
    ),
    "argoverse2": (
        argoverse_in,
        read_argoverse2,
        ("city_SE3_egovehicle.feather", "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"),
    ),
    "kitti360": (
        kitti360_in,
        lambda p: read_kitti360(p, sequence="drive", cameras=(0, 2)),
        (
            "data_poses/drive/poses.txt",
            "calibration/calib_cam_to_pose.txt",
            "calibration/perspective.txt",
            "calibration/image_02.yaml",
        ),
    ),
    "kitti": (
        kitti_in,
        lambda p: read_kitti(
            p / "poses.txt", calibration=p / "calib.txt", times=p / "times.txt", image_size=(WIDTH, HEIGHT)
        ),
        ("poses.txt", "calib.txt", "times.txt"),
    ),
    "mapillary": (mapillary_in, lambda p: read_mapillary(p / "images.json"), ("images.json",)),
    "panoramax": (panoramax_in, lambda p: read_panoramax(p / "items.json"), ("items.json",)),
}


@pytest.mark.parametrize("how", [*SPOILS, "cut"])
@pytest.mark.parametrize(("name", "file"), [(name, file) for name, (*_, files) in FORMATS.items() for file in files])
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, name: str, file: str, how: str) -> None:
    folder = tmp_path / "data"
    make, read, _ = FORMATS[name]
    make(folder)
    spoiled(folder / file, how)
    said = refusal(lambda: read(folder))
    assert Path(file).name in said or "city_SE3_egovehicle.feather" in said


@pytest.mark.parametrize("name", ["kapture", "nuscenes", "argoverse2", "kitti360"])
def test_links_that_lead_out_of_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "data"
    make, read, files = FORMATS[name]
    make(folder)
    spoiled(folder / files[0], "link", outside=tmp_path)
    assert "is a link that leads out of" in refusal(lambda: read(folder))


@pytest.mark.parametrize("bad", ["../../etc/passwd", "/etc/passwd", "a/../../b.jpg", "C:\\\\a.jpg", ""])
@pytest.mark.parametrize(
    ("name", "file", "old"),
    [
        ("kapture", "sensors/records_camera.txt", "day1/unposed.jpg"),
        ("opensfm", "reconstruction.json", "0.jpg"),
        ("nuscenes", "sample_data.json", "samples/CAM_FRONT/0.jpg"),
    ],
)
def test_names_that_lead_out_of_the_folder_are_refused(
    tmp_path: Path, name: str, file: str, old: str, bad: str
) -> None:
    folder = tmp_path / "data"
    make, read, _ = FORMATS[name]
    make(folder)
    path = folder / file
    if name == "kapture":
        old = f"day1/{STAMPS_NS[0]}.jpg"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, bad))
    said = refusal(lambda: read(folder))
    assert "stays in the folder" in said or "expected a text" in said
