"""Put each known fault into good data and see whether `valuemap check` names it, and whether its fix undoes it.

    python benchmarks/check_faults.py [--seeds N ...] [--rigs N ...] [--spoiled N ...] [--kitti-signs DIR]
                                      [--kitti-ts DIR] [--only FAULT ...] [--json FILE] [--go-on]

Good data are simulated cities (two cameras, time stamps, a geo-reference, truth; faults go into the first), simulated
cities whose cars have three cameras (what only rigs can have goes into the first), and where their folders are given
KITTI odometry 00, 05, 07, 09 (see kitti_signs.py; faults go into 00) and KITTI-TS
(`images.csv`, `detections.csv`, `signs.csv`). Faults are written here, apart from the package: no fix is used to make
the fault that it undoes.

What is counted

    named     the fault is among the findings, of a rig with the camera that has it
    others    findings of other names beside it, first ones included
    clean     findings in data without a fault: there should be none
    recovered the map of the fixed data has as many of the true objects as that of the unharmed data, less 2 %
    nowhere   faults that a dataset has no place for: a shift of one pass where no two drive the same road
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from kitti_signs import SEQUENCES, import_sequence, read_points
from machine import command_as_typed, describe_machine, keep_record
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.examine import Examination, examine
from valuemap.check.fault import keep_rows
from valuemap.dataset import Dataset, Frame, rows_of
from valuemap.errors import ValuemapError
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.pipeline import build_map
from valuemap.simulate import PRESETS, simulate
from valuemap.tables import Cameras, Categories, Detections, Images, Truth

Floats = NDArray[np.float64]
ANCHOR = (51.5, -0.14, 35.0)
MATCH_M = 1.5


@dataclass(frozen=True)
class Fault:
    """How a fault gets into data; None where the data have nothing to put it into.

    `compared` makes of good data those that the fixed ones are compared to, where a fault writes over what no fix can
    know. `of` is the camera that the finding must name, where one alone is wrong; `finding` is what it is called, where
    that is not the name of the fault.
    """

    spoil: Callable[[Dataset], Dataset | None]
    has_fix: bool = True
    compared: Callable[[Dataset], Dataset] = lambda good: good
    of: str | None = None
    finding: str | None = None


# ---------------------------------------------------------------------------------------------- good data


def good_city(seed: int, **changes: float) -> Dataset:
    """Return a simulated city with two cameras, a geo-reference and sigmas of the poses."""
    config = replace(PRESETS["small"], write_pose_sigmas=1, **changes)  # type: ignore[arg-type]
    dataset = simulate(config, seed=seed, name=f"city-{seed}")
    return with_second_camera(replace(dataset, frame=Frame(anchor=ANCHOR)), scale=0.75)


def with_second_camera(dataset: Dataset, *, scale: float) -> Dataset:
    """Give every second pass a camera with smaller pictures."""
    cameras = dataset.cameras
    first = cameras.params[0]
    both = Cameras(
        camera_id=np.array([0, 1]),
        model=Categories.from_texts([cameras.model.names[0]] * 2),
        width_px=np.array([cameras.width_px[0], int(cameras.width_px[0] * scale)]),
        height_px=np.array([cameras.height_px[0], int(cameras.height_px[0] * scale)]),
        params=[first, first * scale],
    )
    is_second = dataset.images.pass_id.codes % 2 == 1
    of_detection = is_second[rows(dataset)]
    factor = np.where(of_detection, scale, 1.0)[:, None]
    detections = dataset.detections
    return replace(
        dataset,
        cameras=both,
        images=dataset.images.replace(camera_id=is_second.astype(np.int64)),
        detections=detections.replace(center_px=detections.center_px * factor, size_px=detections.size_px * factor),
    )


def good_rig(seed: int, **changes: float) -> Dataset:
    """Return a simulated city that cars with three cameras drive, 60 degrees from each other."""
    config = replace(PRESETS["small"], cameras=3, camera_spread_deg=60.0, write_pose_sigmas=1, **changes)  # type: ignore[arg-type]
    return simulate(config, seed=seed, name=f"rig-{seed}")


def good_kitti(data_dir: Path, sequence: str) -> Dataset:
    """Return a KITTI sequence as a drive of two passes, with time stamps and the reference tracks as truth."""
    dataset = import_sequence(data_dir, sequence)
    tracks = read_points(data_dir / sequence / "reference_tracks.csv")
    count = len(dataset.images)
    half = np.where(np.arange(count) < _HALF.get(sequence, count), "first", "second")
    return replace(
        dataset,
        images=dataset.images.replace(
            timestamp_s=0.1 * np.arange(count),
            pass_id=Categories.from_texts(half.tolist()),
            rotation_sigma_rad=np.full(count, 0.01),
        ),
        truth=Truth(
            object_id=np.arange(len(tracks)),
            class_name=Categories.from_texts(["sign"] * len(tracks)),
            position_in_world_m=tracks,
        ),
    )


_HALF = {"00": 2300}
"""The image at which sequence 00 comes back to streets that it has been in."""


def good_kitti_ts(data_dir: Path) -> Dataset:
    """Return KITTI-TS: level cameras 1.65 m above the road, at latitudes and longitudes."""
    images = _rows_of_csv(data_dir / "images.csv")
    boxes = _rows_of_csv(data_dir / "detections.csv")
    signs = _rows_of_csv(data_dir / "signs.csv")
    lat_lon = np.array([[float(row["lat"]), float(row["lon"])] for row in images])
    anchor = (float(lat_lon[:, 0].mean()), float(lat_lon[:, 1].mean()), 0.0)
    position = _enu(lat_lon, anchor)
    position[:, 2] = 1.65
    yaw = np.array([float(row["yaw_rad_ccw_from_east"]) for row in images])
    forward = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], forward.shape)
    rotation = np.stack([np.cross(down, forward), down, forward], axis=1)
    shapes = sorted({(row["fx"], row["cx"], row["cy"], row["width"], row["height"]) for row in images})
    names = [row["image"] for row in images]
    corners = np.array([[float(row[key]) for key in ("x1", "y1", "x2", "y2")] for row in boxes])
    sign_position = _enu(np.array([[float(row["lat"]), float(row["lon"])] for row in signs]), anchor)
    sign_position[:, 2] = 0.0  # Their heights are not known.
    return Dataset(
        name="kitti_ts",
        frame=Frame(anchor=anchor),
        cameras=Cameras(
            camera_id=np.arange(len(shapes)),
            model=Categories.from_texts(["PINHOLE"] * len(shapes)),
            width_px=np.array([int(shape[3]) for shape in shapes]),
            height_px=np.array([int(shape[4]) for shape in shapes]),
            params=[np.array([float(fx), float(fx), float(cx) + 0.5, float(cy) + 0.5]) for fx, cx, cy, _, _ in shapes],
        ),
        images=Images(
            image_id=np.arange(len(images)),
            name=pa.array(names),
            camera_id=np.array(
                [shapes.index((row["fx"], row["cx"], row["cy"], row["width"], row["height"])) for row in images]
            ),
            cam_from_world_quat=Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True),
            cam_from_world_m=-np.einsum("nij,nj->ni", rotation, position),
            pass_id=Categories.from_texts([row["drive"] for row in images]),
            timestamp_s=np.array([0.1 * int(name.rsplit("_", 1)[1]) for name in names]),
        ),
        detections=Detections(
            detection_id=np.arange(len(boxes)),
            image_id=np.array([names.index(row["image"]) for row in boxes]),
            class_name=Categories.from_texts([f"sign {row['class']}" for row in boxes]),
            center_px=(corners[:, :2] + corners[:, 2:]) / 2.0 + 0.5,
            size_px=corners[:, 2:] - corners[:, :2],
            score=np.ones(len(boxes)),
        ),
        truth=Truth(
            object_id=np.arange(len(signs)),
            class_name=Categories.from_texts([f"sign {row['class']}" for row in signs]),
            position_in_world_m=sign_position,
        ),
    )


def _rows_of_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _enu(lat_lon: Floats, anchor: tuple[float, float, float]) -> Floats:
    return enu_from_lon_lat_height(np.stack([lat_lon[:, 1], lat_lon[:, 0], np.zeros(len(lat_lon))], axis=1), anchor)


# ---------------------------------------------------------------------------------------------- faults


def rows(dataset: Dataset) -> NDArray[np.int64]:
    """Return the image row of each detection."""
    return rows_of(dataset.detections.image_id, dataset.images.image_id)


def posed(dataset: Dataset, rotation: Floats, center: Floats) -> Dataset:
    """Return the dataset with other poses."""
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    return replace(
        dataset,
        images=dataset.images.replace(
            cam_from_world_quat=quaternion, cam_from_world_m=-np.einsum("nij,nj->ni", rotation, center)
        ),
    )


def _poses(dataset: Dataset) -> tuple[Floats, Floats]:
    return rotation_matrices(dataset.images), camera_centers(dataset.images)


def boxed(dataset: Dataset, center: Floats | None = None, size: Floats | None = None) -> Dataset:
    """Return the dataset with other boxes."""
    detections = dataset.detections
    return replace(
        dataset,
        detections=detections.replace(
            center_px=detections.center_px if center is None else center,
            size_px=detections.size_px if size is None else size,
        ),
    )


def inverted_poses(dataset: Dataset) -> Dataset:
    """world_from_cam in the columns."""
    rotation, center = _poses(dataset)
    quaternion = Rotation.from_matrix(rotation.transpose(0, 2, 1)).as_quat(canonical=True, scalar_first=True)
    return replace(dataset, images=dataset.images.replace(cam_from_world_quat=quaternion, cam_from_world_m=center))


def quaternion_order(dataset: Dataset) -> Dataset:
    """Put x y z w into the columns."""
    quaternion = dataset.images.cam_from_world_quat[:, [1, 2, 3, 0]].copy()
    return replace(dataset, images=dataset.images.replace(cam_from_world_quat=quaternion))


def camera_axes(dataset: Dataset) -> Dataset:
    """OpenGL: y up, z back."""
    rotation, center = _poses(dataset)
    return posed(dataset, np.diag([1.0, -1.0, -1.0]) @ rotation, center)


def world_axes(dataset: Dataset) -> Dataset:
    """Rotations from north, east, down (or another pair of axes where up is not z); positions as they are."""
    rotation, center = _poses(dataset)
    ned_from_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return posed(dataset, rotation @ ned_from_enu.T, center)


def center_as_translation(dataset: Dataset) -> Dataset:
    """Put the camera centre into tx ty tz."""
    return replace(dataset, images=dataset.images.replace(cam_from_world_m=camera_centers(dataset.images)))


def mirrored_positions(dataset: Dataset) -> Dataset:
    """Give the positions in a left-handed world."""
    rotation, center = _poses(dataset)
    axis = 0 if abs(dataset.frame.up[1]) > 0.7 else 1
    flip = np.ones(3)
    flip[axis] = -1.0
    return posed(dataset, rotation, center * flip)


def lat_lon_swapped(dataset: Dataset) -> Dataset:
    """Latitude and longitude of the positions exchanged at import, or two axes where there are none."""
    rotation, center = _poses(dataset)
    if dataset.frame.anchor is None:
        return posed(dataset, rotation, center[:, [2, 1, 0]])
    lat, lon, height = dataset.frame.anchor
    geographic = lon_lat_height_from_enu(center, dataset.frame.anchor)
    anchor = (lon, lat, height)
    swapped = enu_from_lon_lat_height(np.ascontiguousarray(geographic[:, [1, 0, 2]]), anchor)
    return replace(posed(dataset, rotation, swapped), frame=Frame(anchor=anchor))


def _angles(dataset: Dataset) -> tuple[Floats, Floats, Floats]:
    """Azimuth clockwise from north, pitch and roll, by SciPy's Euler angles."""
    east, north = dataset.frame.east_north()
    axes = np.stack([east, north, np.array(dataset.frame.up)])
    # World (east, north, up) to a body with x right, y forward, z up.
    body = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) @ rotation_matrices(dataset.images) @ axes.T
    angles = Rotation.from_matrix(body.transpose(0, 2, 1)).as_euler("ZXY")
    return -angles[:, 0], angles[:, 1], angles[:, 2]


def _from_angles(dataset: Dataset, azimuth: Floats, pitch: Floats, roll: Floats) -> Dataset:
    east, north = dataset.frame.east_north()
    axes = np.stack([east, north, np.array(dataset.frame.up)])
    body = Rotation.from_euler("ZXY", np.stack([-azimuth, pitch, roll], axis=1)).as_matrix().transpose(0, 2, 1)
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) @ body @ axes
    return posed(dataset, rotation, camera_centers(dataset.images))


def heading_convention(dataset: Dataset) -> Dataset:
    """Counter-clockwise from east read as clockwise from north."""
    azimuth, pitch, roll = _angles(dataset)
    return _from_angles(dataset, np.pi / 2.0 - azimuth, pitch, roll)


def degrees_for_radians(dataset: Dataset) -> Dataset:
    """Angles in degrees read as radians."""
    azimuth, pitch, roll = _angles(dataset)
    return _from_angles(dataset, np.degrees(azimuth), np.degrees(pitch), np.degrees(roll))


def tilt_convention(dataset: Dataset) -> Dataset | None:
    """Let pitch count downwards, where there is any to speak of."""
    azimuth, pitch, roll = _angles(dataset)
    return None if np.abs(pitch).mean() < LEAST_PITCH_RAD else _from_angles(dataset, azimuth, -pitch, roll)


LEAST_PITCH_RAD = np.radians(2.0)


def rounded_headings(dataset: Dataset) -> Dataset:
    """Headings in steps of five degrees."""
    azimuth, pitch, roll = _angles(dataset)
    return _from_angles(dataset, np.radians(5.0 * np.round(np.degrees(azimuth) / 5.0)), pitch, roll)


def sides_exchanged(dataset: Dataset) -> Dataset:
    """Give the pictures' heights for their widths."""
    cameras = dataset.cameras
    return replace(dataset, cameras=cameras.replace(width_px=cameras.height_px, height_px=cameras.width_px))


def two_names(dataset: Dataset) -> Dataset:
    """Call what is in every second image by another name, as a second source does."""
    other = rows(dataset) % 2 == 1
    names = [
        f"{name} of another source" if is_other else name
        for name, is_other in zip(dataset.detections.class_name.texts(), other, strict=True)
    ]
    return replace(dataset, detections=dataset.detections.replace(class_name=Categories.from_texts(names)))


def pitch_and_roll(dataset: Dataset) -> Dataset:
    """Pitch and roll of a poor sensor."""
    azimuth, _, _ = _angles(dataset)
    noise = np.radians(5.0) * np.random.default_rng(1).standard_normal((2, len(azimuth)))
    return _from_angles(dataset, azimuth, noise[0], noise[1])


def up_direction(dataset: Dataset) -> Dataset | None:
    """Turn the sky: positions and rotations in north, east, down where z should be up."""
    x, y, z = dataset.frame.up
    if dataset.frame.anchor is None:
        return replace(dataset, frame=Frame(up=(z, x, y)))
    rotation, center = _poses(dataset)
    ned_from_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return posed(dataset, rotation @ ned_from_enu.T, center @ ned_from_enu.T)


def rotation_sigma_in_degrees(dataset: Dataset) -> Dataset:
    """Give the column in degrees: half a degree and more, or a degree where the data do not say."""
    own = dataset.images.rotation_sigma_rad
    sigma = np.full(len(dataset.images), 1.0) if own is None else np.degrees(np.maximum(own, 0.01))
    return replace(dataset, images=dataset.images.replace(rotation_sigma_rad=sigma))


def rotation_sigma_stated(dataset: Dataset) -> Dataset:
    """State in radians what `rotation_sigma_in_degrees` states in degrees."""
    degrees = rotation_sigma_in_degrees(dataset).images.rotation_sigma_rad
    return replace(dataset, images=dataset.images.replace(rotation_sigma_rad=np.radians(np.asarray(degrees))))


def headings_constant(dataset: Dataset) -> Dataset:
    """Take all cameras to look north: the column was not there."""
    azimuth, pitch, roll = _angles(dataset)
    return _from_angles(dataset, np.zeros_like(azimuth), pitch, roll)


def _with_params(dataset: Dataset, change: Callable[[Floats], Floats]) -> Dataset:
    return replace(
        dataset, cameras=dataset.cameras.replace(params=[change(each.copy()) for each in dataset.cameras.params])
    )


def focal_length(dataset: Dataset) -> Dataset:
    """Lengthen the focal length by a quarter."""
    return _with_params(dataset, lambda params: params * [1.25, 1.25, 1.0, 1.0])


def picture_size(dataset: Dataset) -> Dataset:
    """Let the detector see pictures of half the size."""
    return boxed(dataset, dataset.detections.center_px / 2.0, dataset.detections.size_px / 2.0)


def half_pixel(dataset: Dataset) -> Dataset | None:
    """OpenCV's pixels in cameras whose principal point is in the middle, else in boxes that the picture cuts."""
    middle = 2.0 * dataset.cameras.params[0][2] == dataset.cameras.width_px[0]
    if middle:
        return _with_params(dataset, lambda params: params - [0.0, 0.0, 0.5, 0.5])
    first = dataset.detections.center_px - dataset.detections.size_px / 2.0
    if (first.min(axis=1) < 1.0).sum() < 3:
        return None
    return boxed(dataset, dataset.detections.center_px - 0.5)


def camera_tilt(dataset: Dataset) -> Dataset:
    """Cameras mounted 2 degrees lower than is known."""
    rotation, center = _poses(dataset)
    return posed(dataset, Rotation.from_euler("x", 2.0, degrees=True).as_matrix() @ rotation, center)


def camera_yaw(dataset: Dataset) -> Dataset:
    """Cameras mounted 3 degrees to a side."""
    rotation, center = _poses(dataset)
    return posed(dataset, Rotation.from_euler("y", 3.0, degrees=True).as_matrix() @ rotation, center)


def camera_aside(dataset: Dataset) -> Dataset:
    """Cameras that are 2 m farther to the right of where they are driven than is known: a lever arm the other way."""
    rotation, center = _poses(dataset)
    to_left = np.cross(dataset.frame.up, _ways(dataset))
    return posed(dataset, rotation, center + 2.0 * to_left)


def _ways(dataset: Dataset) -> Floats:
    """Return the level unit vectors (N, 3) along which the images of each pass and camera move, by their times."""
    up, center = np.array(dataset.frame.up), camera_centers(dataset.images)
    time_s = np.asarray(dataset.images.timestamp_s)
    way, drive = np.zeros_like(center), np.stack([dataset.images.pass_id.codes, dataset.images.camera_id])
    for code, camera in np.unique(drive, axis=1).T:
        members = np.flatnonzero((drive[0] == code) & (drive[1] == camera))
        members = members[np.argsort(time_s[members], kind="stable")]
        step = np.gradient(center[members], axis=0) if len(members) > 1 else np.zeros((1, 3))
        step -= np.outer(step @ up, up)
        length = np.linalg.norm(step, axis=1)
        # A car that stands looks where it drove to.
        moves = np.maximum.accumulate(np.where(length > 0.2 * np.median(length), np.arange(len(step)), 0))
        way[members] = step[moves] / np.maximum(length[moves], 1e-12)[:, None]
    return way


def wrong_camera(dataset: Dataset) -> Dataset | None:
    """All images have the first camera."""
    if len(dataset.cameras) < 2:
        dataset = with_second_camera(dataset, scale=0.75)
    elif np.ptp(dataset.cameras.width_px) < 0.1 * dataset.cameras.width_px[0]:
        return None
    return replace(
        dataset, images=dataset.images.replace(camera_id=np.full(len(dataset.images), dataset.cameras.camera_id[0]))
    )


def boxes_as_corners(dataset: Dataset) -> Dataset:
    """x1 y1 x2 y2."""
    center, size = dataset.detections.center_px, dataset.detections.size_px
    return boxed(dataset, center - size / 2.0, center + size / 2.0)


def boxes_top_left(dataset: Dataset) -> Dataset:
    """Give the top left corner as the centre."""
    return boxed(dataset, dataset.detections.center_px - dataset.detections.size_px / 2.0)


def boxes_normalised(dataset: Dataset) -> Dataset:
    """From 0 to 1."""
    row = rows_of(dataset.images.camera_id, dataset.cameras.camera_id)[rows(dataset)]
    extent = np.stack([dataset.cameras.width_px[row], dataset.cameras.height_px[row]], axis=1)
    return boxed(dataset, dataset.detections.center_px / extent, dataset.detections.size_px / extent)


def boxes_half_size(dataset: Dataset) -> Dataset:
    """Half widths and heights."""
    return boxed(dataset, size=dataset.detections.size_px / 2.0)


def mirrored_pictures(dataset: Dataset) -> Dataset:
    """Left and right of the pictures exchanged."""
    row = rows_of(dataset.images.camera_id, dataset.cameras.camera_id)[rows(dataset)]
    center = dataset.detections.center_px.copy()
    center[:, 0] = dataset.cameras.width_px[row] - center[:, 0]
    return boxed(dataset, center)


def scale(dataset: Dataset) -> Dataset:
    """Give the model in a unit of its own."""
    rotation, center = _poses(dataset)
    return posed(dataset, rotation, 0.07 * center)


def _met_pass(dataset: Dataset) -> int | None:
    """Return the pass with most detections but one, of those that drive where others do; None where there is none."""
    codes, center = dataset.images.pass_id.codes, camera_centers(dataset.images)
    count = np.bincount(codes[rows(dataset)], minlength=len(dataset.images.pass_id.names))
    for code in np.argsort(-count, kind="stable")[1:]:
        near, _ = cKDTree(center[codes != code]).query(center[codes == code], distance_upper_bound=MEETS_M)
        if np.isfinite(near).sum() >= LEAST_MEETINGS:
            return int(code)
    return None


MEETS_M = 10.0
LEAST_MEETINGS = 30


def _moved_pass(dataset: Dataset, offset: Floats) -> Dataset | None:
    code = _met_pass(dataset)
    if code is None:
        return None
    rotation, center = _poses(dataset)
    is_moved = dataset.images.pass_id.codes == code
    return posed(dataset, rotation, center + np.where(is_moved[:, None], offset, 0.0))


def pass_offset(dataset: Dataset) -> Dataset | None:
    """One pass 5 m off."""
    east, north = dataset.frame.east_north()
    return _moved_pass(dataset, 4.0 * east + 3.0 * north)


def pass_turned(dataset: Dataset) -> Dataset | None:
    """One pass in a world whose north is 1.5 degrees off, as grid north is."""
    code = _met_pass(dataset)
    if code is None:
        return None
    rotation, center = _poses(dataset)
    turn = Rotation.from_rotvec(np.radians(1.5) * np.array(dataset.frame.up)).as_matrix()
    middle, is_turned = center.mean(axis=0), dataset.images.pass_id.codes == code
    return posed(
        dataset,
        np.where(is_turned[:, None, None], rotation @ turn.T, rotation),
        np.where(is_turned[:, None], (center - middle) @ turn.T + middle, center),
    )


def pass_frame(dataset: Dataset) -> Dataset | None:
    """Positions of one pass in feet, where z is up."""
    code = _met_pass(dataset)
    if code is None or dataset.frame.up != (0.0, 0.0, 1.0):
        return None
    rotation, center = _poses(dataset)
    in_feet = (dataset.images.pass_id.codes == code)[:, None]
    return posed(dataset, rotation, np.where(in_feet, center / 0.3048, center))


def camera_height(dataset: Dataset) -> Dataset | None:
    """Put the camera of one pass 1.8 m too low."""
    return _moved_pass(dataset, -1.8 * np.array(dataset.frame.up))


def _later(dataset: Dataset, seconds: float, is_moved: NDArray[np.bool_]) -> Dataset:
    """Poses as they are so many seconds later."""
    rotation, center = _poses(dataset)
    time_s = dataset.images.timestamp_s
    assert time_s is not None
    moved, drive = center.copy(), np.stack([dataset.images.pass_id.codes, dataset.images.camera_id])
    for code, camera in np.unique(drive, axis=1).T:
        members = np.flatnonzero((drive[0] == code) & (drive[1] == camera))
        members = members[np.argsort(time_s[members], kind="stable")]
        for axis in range(3):
            moved[members, axis] = np.interp(time_s[members] + seconds, time_s[members], center[members, axis])
    return posed(dataset, rotation, np.where(is_moved[:, None], moved, center))


def pass_time_shift(dataset: Dataset) -> Dataset | None:
    """Set the clock of one pass 0.5 s off."""
    code = _met_pass(dataset)
    return None if code is None else _later(dataset, 0.5, dataset.images.pass_id.codes == code)


SHIFT_S, LONGEST_GAP_S = 0.6, 1.0


def time_shift(dataset: Dataset) -> Dataset:
    """Set the clock of all poses 0.6 s off."""
    return _later(dataset, SHIFT_S, np.ones(len(dataset.images), dtype=np.bool_))


def going_on(dataset: Dataset) -> Dataset:
    """Leave out the last images of passes and those before gaps: `time_shift` has no poses for them, and makes some up.

    KITTI-TS has bursts of some ten images, so that of every drive two fifths are such.
    """
    return keep_rows(dataset, images=_goes_on(dataset))


def _goes_on(dataset: Dataset) -> NDArray[np.bool_]:
    """Return which images (N) are followed by poses around the time of the shift, a second apart at most."""
    time_s, codes = dataset.images.timestamp_s, dataset.images.pass_id.codes
    assert time_s is not None
    goes_on = np.zeros(len(codes), dtype=np.bool_)
    for code in np.unique(codes):
        members = np.flatnonzero(codes == code)
        known = np.sort(time_s[members])
        after = np.searchsorted(known, time_s[members] + SHIFT_S)
        is_inside = after < len(known)
        goes_on[members[is_inside]] = np.diff(known)[after[is_inside] - 1] <= LONGEST_GAP_S
    return goes_on


LEAP_S = 18.0


def leap_seconds(dataset: Dataset) -> Dataset | None:
    """Look poses up at times of GPS that are UTC's: images that have none then are left out."""
    time_s = dataset.images.timestamp_s
    return None if time_s is None else _looked_up(dataset, -LEAP_S)


def _looked_up(dataset: Dataset, seconds: float) -> Dataset:
    """Return the images that are between two others so much later, no farther apart than 10 m, with the poses there."""
    (rotation, center), time_s = _poses(dataset), np.asarray(dataset.images.timestamp_s)
    turned, moved, stays = rotation.copy(), center.copy(), np.zeros(len(center), dtype=np.bool_)
    drive = np.stack([dataset.images.pass_id.codes, dataset.images.camera_id])
    for code, camera in np.unique(drive, axis=1).T:
        members = np.flatnonzero((drive[0] == code) & (drive[1] == camera))
        members = members[np.unique(time_s[members], return_index=True)[1]]
        when, at = time_s[members], time_s[members] + seconds
        after = np.clip(np.searchsorted(when, at), 1, len(when) - 1)
        gap_m = np.linalg.norm(np.diff(center[members], axis=0), axis=1)[after - 1]
        inside = (at >= when[0]) & (at <= when[-1]) & (gap_m < 10.0)
        stays[members] = inside
        turned[members[inside]] = Slerp(when, Rotation.from_matrix(rotation[members]))(at[inside]).as_matrix()
        for axis in range(3):
            moved[members, axis] = np.interp(at, when, center[members, axis])
    return keep_rows(posed(dataset, turned, moved), images=stays)


def with_leaps(dataset: Dataset) -> Dataset:
    """Keep the images for which, after `leap_seconds`, a pose can be known again."""
    known = _looked_up(_looked_up(dataset, -LEAP_S), LEAP_S).images.image_id
    return keep_rows(dataset, images=np.isin(dataset.images.image_id, known))


def _dealt(count: int) -> NDArray[np.int64]:
    return np.random.default_rng(2).permutation(count)


def passes_no_drives(dataset: Dataset) -> Dataset:
    """Pass ids dealt at random, without times, names or numbers that tell."""
    order = _dealt(len(dataset.images))
    names = [f"{number:06d}.jpg" for number in order]
    passes = [f"batch-{number % 5}" for number in order]
    images = dataset.images.replace(name=pa.array(names), pass_id=Categories.from_texts(passes), timestamp_s=None)
    return replace(dataset, images=images)


def as_driven(dataset: Dataset) -> Dataset:
    """Name as one pass what was driven as one, and nothing else that tells its order: no times, names as dealt.

    Where this file cut a drive in two no poses tell, nor which way it went on where it crosses itself.
    """
    images = dataset.images
    order = np.lexsort((np.arange(len(images)), np.asarray(images.timestamp_s), images.pass_id.codes))
    codes, center = images.pass_id.codes[order], camera_centers(images)[order]
    step = np.linalg.norm(np.diff(center, axis=0), axis=1)
    goes_on = (np.diff(codes) == 0) | (step < 3.0 * np.median(step))
    passes = np.empty(len(order), dtype=np.int64)
    passes[order] = np.append(0, np.cumsum(~goes_on))
    drives = Categories.from_texts([f"drive-{number}" for number in passes])
    names = pa.array([f"{number:06d}.jpg" for number in _dealt(len(images))])
    return replace(dataset, images=images.replace(name=names, pass_id=drives, timestamp_s=None))


def interleaved_passes(dataset: Dataset) -> Dataset | None:
    """Two passes under one id, their images in turn."""
    codes = dataset.images.pass_id.codes
    if len(np.unique(codes)) < 2:
        return None
    first, second = (int(code) for code in np.argsort(-np.bincount(codes), kind="stable")[:2])
    names, when = list(dataset.images.name.to_pylist()), np.arange(len(codes), dtype=np.float64)
    for code, late in ((first, 0.0), (second, 0.03)):
        members = np.flatnonzero(codes == code)
        when[members] = 0.1 * np.arange(len(members)) + late
        for number, row in enumerate(members):
            names[row] = f"both/{2 * number + (code == second):06d}.jpg"
    passes = np.array(dataset.images.pass_id.texts(), dtype=object)
    passes[(codes == first) | (codes == second)] = "both"
    images = dataset.images.replace(
        name=pa.array(names), pass_id=Categories.from_texts(passes.tolist()), timestamp_s=when
    )
    return replace(dataset, images=images)


def rolling_times(dataset: Dataset) -> Dataset | None:
    """Seconds within the minute."""
    time_s = dataset.images.timestamp_s
    return None if time_s is None else replace(dataset, images=dataset.images.replace(timestamp_s=time_s % 60.0))


def time_unit(dataset: Dataset) -> Dataset | None:
    """Milliseconds."""
    time_s = dataset.images.timestamp_s
    return None if time_s is None else replace(dataset, images=dataset.images.replace(timestamp_s=1000.0 * time_s))


def detections_shifted(dataset: Dataset) -> Dataset:
    """List detections with the image before their own."""
    codes = dataset.images.pass_id.codes
    before = np.maximum(np.arange(len(codes)) - 1, 0)
    before = np.where(codes[before] == codes, before, np.arange(len(codes)))
    ids = dataset.images.image_id[before[rows(dataset)]]
    return replace(dataset, detections=dataset.detections.replace(image_id=ids))


def repeated_boxes(dataset: Dataset) -> Dataset:
    """Every box twice."""
    detections = dataset.detections
    twice = np.repeat(np.arange(len(detections)), 2)
    copies = detections.take(twice).replace(detection_id=np.arange(len(twice)))
    copies.center_px[1::2] += 0.2
    return replace(dataset, detections=copies, truth_detections=None)


def carried_boxes(dataset: Dataset) -> Dataset:
    """Dirt on the windscreen in two of three pictures of the pass with most detections, at one place up to a pixel."""
    images, detections = dataset.images, dataset.detections
    codes = images.pass_id.codes
    of_pass = np.flatnonzero(codes == np.argmax(np.bincount(codes[rows(dataset)])))
    random = np.random.default_rng(0)
    dirty = of_pass[random.random(len(of_pass)) < 2.0 / 3.0]
    camera = int(images.camera_id[dirty[0]])
    dirty = dirty[images.camera_id[dirty] == camera]
    row = rows_of(np.array([camera]), dataset.cameras.camera_id)[0]
    place = np.array([0.3 * dataset.cameras.width_px[row], 0.4 * dataset.cameras.height_px[row]])
    count = len(detections)
    boxes = detections.take(np.concatenate([np.arange(count), np.zeros(len(dirty), np.int64)]))
    center_px, size_px = boxes.center_px.copy(), boxes.size_px.copy()
    center_px[count:] = place + random.normal(0.0, 1.0, (len(dirty), 2))
    size_px[count:] = np.median(detections.size_px, axis=0)
    boxes = boxes.replace(
        detection_id=np.concatenate(
            [detections.detection_id, detections.detection_id.max() + 1 + np.arange(len(dirty))]
        ),
        image_id=np.concatenate([detections.image_id, images.image_id[dirty]]),
        center_px=center_px,
        size_px=size_px,
    )
    return replace(dataset, detections=boxes)


def repeated_images(dataset: Dataset) -> Dataset:
    """Give a tenth of the images twice, under other names."""
    images, detections = dataset.images, dataset.detections
    again = np.arange(0, len(images), 10)
    image_rows = np.concatenate([np.arange(len(images)), again])
    offset = int(images.image_id.max()) + 1
    ids = np.concatenate([images.image_id, offset + np.arange(len(again))])
    names = images.name.to_pylist() + [f"copy/{name}" for name in images.name.take(again).to_pylist()]
    copied = np.isin(rows(dataset), again)
    new_id = offset + np.searchsorted(again, rows(dataset)[copied])
    detection_rows = np.concatenate([np.arange(len(detections)), np.flatnonzero(copied)])
    return replace(
        dataset,
        images=images.take(image_rows).replace(image_id=ids, name=pa.array(names)),
        detections=detections.take(detection_rows).replace(
            detection_id=np.arange(len(detection_rows)), image_id=np.concatenate([detections.image_id, new_id])
        ),
        truth_detections=None,
    )


def repeated_detections(dataset: Dataset) -> Dataset | None:
    """List all boxes with the next image of their camera, too."""
    images, detections = dataset.images, dataset.detections
    if images.timestamp_s is None:
        return None
    order = np.lexsort((images.timestamp_s, images.camera_id, images.pass_id.codes))
    first, second = order[:-1], order[1:]
    goes_on = (images.camera_id[first] == images.camera_id[second]) & (
        images.pass_id.codes[first] == images.pass_id.codes[second]
    )
    following = np.full(len(order), -1)
    following[first[goes_on]] = second[goes_on]
    to = following[rows(dataset)]
    detection_rows = np.concatenate([np.arange(len(detections)), np.flatnonzero(to >= 0)])
    image_id = np.concatenate([detections.image_id, images.image_id[to[to >= 0]]])
    again = detections.take(detection_rows).replace(detection_id=np.arange(len(detection_rows)), image_id=image_id)
    return replace(dataset, detections=again, truth_detections=None)


def far_images(dataset: Dataset) -> Dataset:
    """One image in a hundred at the other end of the Earth."""
    rotation, center = _poses(dataset)
    center = center.copy()
    center[50::100] += [3.2e6, -1.1e6, 4.0e5]
    return posed(dataset, rotation, center)


def focal_unit(dataset: Dataset) -> Dataset:
    """Focal lengths in millimetres of film 36 mm wide."""
    factors = [
        36.0 / float(max(w, h)) for w, h in zip(dataset.cameras.width_px, dataset.cameras.height_px, strict=True)
    ]
    params = [each * [factor, factor, 1.0, 1.0] for each, factor in zip(dataset.cameras.params, factors, strict=True)]
    return replace(dataset, cameras=dataset.cameras.replace(params=params))


def principal_point(dataset: Dataset) -> Dataset:
    """Exchange cx and cy."""
    return _with_params(dataset, lambda params: params[[0, 1, 3, 2]])


def lens_model(dataset: Dataset) -> Dataset:
    """Give the parameters of the lens for pictures that were undistorted."""
    cameras = dataset.cameras
    return replace(
        dataset,
        cameras=cameras.replace(
            model=Categories.from_texts(["OPENCV"] * len(cameras)),
            params=[np.concatenate([each, [-0.4, 0.1, 0.0, 0.0]]) for each in cameras.params],
        ),
    )


def held_positions(dataset: Dataset) -> Dataset:
    """Four images in a row have the position of the first."""
    rotation, center = _poses(dataset)
    held = center.copy()
    for code in np.unique(dataset.images.pass_id.codes):
        members = np.flatnonzero(dataset.images.pass_id.codes == code)
        held[members] = center[members[np.arange(len(members)) // 4 * 4]]
    return posed(dataset, rotation, held)


FIX_IMAGES = 16


def interpolated_positions(dataset: Dataset) -> Dataset:
    """Positions in proportion of time between those of each sixteenth image of a camera in a pass."""
    (rotation, center), when = _poses(dataset), dataset.images.timestamp_s
    time_s, between = np.arange(len(center)) if when is None else np.asarray(when), center.copy()
    drive = np.stack([dataset.images.pass_id.codes, dataset.images.camera_id])
    for code, camera in np.unique(drive, axis=1).T:
        members = np.flatnonzero((drive[0] == code) & (drive[1] == camera))
        members = members[np.argsort(time_s[members], kind="stable")]
        fixes = np.append(members[:-1:FIX_IMAGES], members[-1])
        for axis in range(3):
            between[members, axis] = np.interp(time_s[members], time_s[fixes], center[fixes, axis])
    return posed(dataset, rotation, between)


def rounded_positions(dataset: Dataset) -> Dataset:
    """Five decimals of a degree, or whole metres."""
    rotation, center = _poses(dataset)
    if dataset.frame.anchor is None:
        return posed(dataset, rotation, np.round(center))
    geographic = lon_lat_height_from_enu(center, dataset.frame.anchor)
    geographic[:, :2] = np.round(geographic[:, :2], 5)
    return posed(dataset, rotation, enu_from_lon_lat_height(geographic, dataset.frame.anchor))


def height_zero(dataset: Dataset) -> Dataset | None:
    """One pass above the ellipsoid, the others above the sea."""
    return _moved_pass(dataset, 47.0 * np.array(dataset.frame.up))


FOOT_M = 0.3048


def height_unit(dataset: Dataset) -> Dataset | None:
    """Heights in feet above positions in metres, where there are hills."""
    (rotation, center), up = _poses(dataset), np.array(dataset.frame.up)
    height = center @ up
    is_hilly = np.ptp(height) > LEAST_HILLS_M
    return posed(dataset, rotation, center + np.outer(height / FOOT_M - height, up)) if is_hilly else None


def heights_in_centimetres(dataset: Dataset) -> Dataset | None:
    """Heights in centimetres above positions in metres, where there are hills."""
    (rotation, center), up = _poses(dataset), np.array(dataset.frame.up)
    height = center @ up
    return posed(dataset, rotation, center + np.outer(99.0 * height, up)) if np.ptp(height) > LEAST_HILLS_M else None


LEAST_HILLS_M = 1.0


def heights_left_out(dataset: Dataset) -> Dataset | None:
    """One pass at the height of zero, where there are hills."""
    code, (rotation, center), up = _met_pass(dataset), _poses(dataset), np.array(dataset.frame.up)
    height = center @ up
    if code is None or np.ptp(height) < LEAST_HILLS_M:
        return None
    left_out = np.where(dataset.images.pass_id.codes == code, height, 0.0)
    return posed(dataset, rotation, center - np.outer(left_out, up))


def quantised_boxes(dataset: Dataset) -> Dataset:
    """Centres on the cells of a heat map."""
    return boxed(dataset, (np.floor(dataset.detections.center_px / 4.0) + 0.5) * 4.0)


def class_spelling(dataset: Dataset) -> Dataset:
    """Every third detection of a class in other letters."""
    texts = dataset.detections.class_name.texts()
    spelled = [text.replace("_", " ").title() if i % 3 == 0 else text for i, text in enumerate(texts)]
    return replace(dataset, detections=dataset.detections.replace(class_name=Categories.from_texts(spelled)))


def equal_scores(dataset: Dataset) -> Dataset:
    """All 0.5."""
    return replace(dataset, detections=dataset.detections.replace(score=np.full(len(dataset.detections), 0.5)))


def truth_elsewhere(dataset: Dataset) -> Dataset | None:
    """Truth in another frame: moved by some hundred metres."""
    if dataset.truth is None:
        return None
    moved = dataset.truth.position_in_world_m + [250.0, -130.0, 0.0]
    return replace(dataset, truth=dataset.truth.replace(position_in_world_m=moved))


FAULTS: dict[str, Fault] = {
    "inverted_poses": Fault(inverted_poses),
    "quaternion_order": Fault(quaternion_order),
    "camera_axes": Fault(camera_axes),
    "world_axes": Fault(world_axes),
    "center_as_translation": Fault(center_as_translation),
    "mirrored_positions": Fault(mirrored_positions),
    "lat_lon_swapped": Fault(lat_lon_swapped),
    "heading_convention": Fault(heading_convention),
    "degrees_for_radians": Fault(degrees_for_radians),
    "tilt_convention": Fault(tilt_convention),
    "pitch_and_roll": Fault(pitch_and_roll, has_fix=False),  # What the sensor did not measure does not come back.
    "headings_constant": Fault(headings_constant),
    "up_direction": Fault(up_direction),
    "rotation_sigma_in_degrees": Fault(rotation_sigma_in_degrees, compared=rotation_sigma_stated),
    "focal_length": Fault(focal_length),
    "picture_size": Fault(picture_size),
    "half_pixel": Fault(half_pixel),
    "camera_tilt": Fault(camera_tilt),
    "camera_yaw": Fault(camera_yaw),
    "camera_aside": Fault(camera_aside),
    "wrong_camera": Fault(wrong_camera),
    "boxes_as_corners": Fault(boxes_as_corners),
    "boxes_top_left": Fault(boxes_top_left),
    "boxes_normalised": Fault(boxes_normalised),
    "boxes_half_size": Fault(boxes_half_size),
    "mirrored_pictures": Fault(mirrored_pictures),
    "scale": Fault(scale, has_fix=False),
    "pass_offset": Fault(pass_offset),
    "pass_frame": Fault(pass_frame),
    "pass_turned": Fault(pass_turned),
    "pass_time_shift": Fault(pass_time_shift),
    "time_shift": Fault(time_shift, compared=going_on),
    "leap_seconds": Fault(leap_seconds, compared=with_leaps, finding="time_shift"),
    "camera_height": Fault(camera_height),
    "passes_no_drives": Fault(passes_no_drives, compared=as_driven),
    "interleaved_passes": Fault(interleaved_passes),
    "rolling_times": Fault(rolling_times),
    "time_unit": Fault(time_unit),
    "detections_shifted": Fault(detections_shifted),
    "repeated_boxes": Fault(repeated_boxes),
    "repeated_images": Fault(repeated_images),
    "repeated_detections": Fault(repeated_detections),
    "carried_boxes": Fault(carried_boxes),
    "far_images": Fault(far_images),
    "focal_unit": Fault(focal_unit),
    "principal_point": Fault(principal_point),
    "lens_model": Fault(lens_model),
    "held_positions": Fault(held_positions, has_fix=False),  # Between the fixes the way is guessed.
    "interpolated_positions": Fault(interpolated_positions),
    "rounded_positions": Fault(rounded_positions, has_fix=False),
    "rounded_headings": Fault(rounded_headings, has_fix=False),
    "sides_exchanged": Fault(sides_exchanged),
    "two_names": Fault(two_names),
    "height_zero": Fault(height_zero),
    "height_unit": Fault(height_unit),
    "heights_in_centimetres": Fault(heights_in_centimetres, finding="height_unit"),
    "heights_left_out": Fault(heights_left_out),
    "quantised_boxes": Fault(quantised_boxes, has_fix=False),
    "class_spelling": Fault(class_spelling),
    "equal_scores": Fault(equal_scores, has_fix=False),
    "truth_elsewhere": Fault(truth_elsewhere),
}


# ---------------------------------------------------------------------------------------------- faults of rigs


def exchanged(dataset: Dataset, first: int, second: int) -> Dataset:
    """Exchange the poses of two cameras, image by image as they are listed."""
    camera_id, time_s = dataset.images.camera_id, np.asarray(dataset.images.timestamp_s)
    one, other = (np.flatnonzero(camera_id == camera) for camera in (first, second))
    assert np.array_equal(time_s[one], time_s[other])
    row = np.arange(len(camera_id))
    row[one], row[other] = other, one
    rotation, center = _poses(dataset)
    return posed(dataset, rotation[row], center[row])


def of_camera(dataset: Dataset, spoiled: Dataset, camera_id: int) -> Dataset:
    """Return a dataset whose images and boxes of one camera are as in another."""
    mine = dataset.images.camera_id == camera_id
    (rotation, center), (other_rotation, other_center) = _poses(dataset), _poses(spoiled)
    result = posed(
        dataset,
        np.where(mine[:, None, None], other_rotation, rotation),
        np.where(mine[:, None], other_center, center),
    )
    box, detections = mine[rows(dataset), None], dataset.detections
    return boxed(
        result,
        np.where(box, spoiled.detections.center_px, detections.center_px),
        np.where(box, spoiled.detections.size_px, detections.size_px),
    )


def lowered(dataset: Dataset) -> Dataset:
    """All cameras a metre lower."""
    rotation, center = _poses(dataset)
    return posed(dataset, rotation, center - np.array(dataset.frame.up))


def inverted_mounts(dataset: Dataset) -> Dataset:
    """Take vehicle_from_cam for cam_from_vehicle: a level vehicle, x forward, y left, z up, amid its cameras."""
    rotation, center = _poses(dataset)
    vehicle, middle = _vehicles(dataset), _mean_of(_frames(dataset), center)
    mount = rotation @ vehicle.transpose(0, 2, 1)
    aside = np.einsum("nij,nj->ni", mount @ vehicle, middle - center)
    return posed(dataset, mount.transpose(0, 2, 1) @ vehicle, middle + np.einsum("nji,nj->ni", vehicle, aside))


def _vehicles(dataset: Dataset) -> Floats:
    """Return the rotations (N, 3, 3) from the world to the level vehicle of each image, x forward, y left, z up."""
    up = np.array(dataset.frame.up)
    forward = _mean_of(_frames(dataset), rotation_matrices(dataset.images)[:, 2])
    forward -= np.outer(forward @ up, up)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return np.stack([forward, np.cross(up, forward), np.broadcast_to(up, forward.shape)], axis=1)


def _frames(dataset: Dataset) -> NDArray[np.int64]:
    """Return the number of the exposure (N) of each image."""
    exposure = np.stack([dataset.images.pass_id.codes, np.asarray(dataset.images.timestamp_s)])
    return np.unique(exposure, axis=1, return_inverse=True)[1].ravel()


def _mean_of(group: NDArray[np.int64], values: Floats) -> Floats:
    """Return for each row the mean of the values (N, 3) of its group."""
    total = np.stack([np.bincount(group, weights=column) for column in values.T], axis=1)
    return (total / np.bincount(group)[:, None])[group]


def upside_down(dataset: Dataset) -> Dataset:
    """Cameras mounted upside down, whose poses say so no more."""
    rotation, center = _poses(dataset)
    return posed(dataset, np.diag([-1.0, -1.0, 1.0]) @ rotation, center)


def mount_in_degrees(dataset: Dataset, camera_id: int) -> Dataset:
    """Read the rotation vector of a mount, which is in degrees, as radians: of a vehicle x forward, y left, z up."""
    rotation, center = _poses(dataset)
    mine = dataset.images.camera_id == camera_id
    mount = Rotation.from_matrix((rotation @ _vehicles(dataset).transpose(0, 2, 1))[mine]).mean()
    wrong = Rotation.from_rotvec(np.degrees(mount.as_rotvec())) * mount.inv()
    return posed(dataset, np.where(mine[:, None, None], wrong.as_matrix() @ rotation, rotation), center)


def camera_late(dataset: Dataset, camera_id: int) -> Dataset:
    """Set the clock of one camera 0.3 s off."""
    return of_camera(dataset, _later(dataset, 0.3, np.ones(len(dataset.images), dtype=np.bool_)), camera_id)


ARMS_M = np.array([[-0.5, 1.0, 0.0], [2.0, 0.0, 0.0], [-0.5, -1.0, 0.0]])
"""Forward, left, up of the left, the front and the right camera from the point of the car that is positioned."""


def _with_arms(dataset: Dataset, arm_in_world: Callable[[Floats], Floats]) -> Dataset:
    """Return cameras whose lever arms (N, 3) on the car were not turned into the world, but made something else of."""
    rotation, center = _poses(dataset)
    arm_m = ARMS_M[dataset.images.camera_id]
    turned = np.einsum("nji,nj->ni", _vehicles(dataset), arm_m)
    return posed(dataset, rotation, center - turned + arm_in_world(arm_m))


def arms_left_out(dataset: Dataset) -> Dataset:
    """All cameras in the point of the car that is positioned."""
    return _with_arms(dataset, np.zeros_like)


def arms_exchanged(dataset: Dataset) -> Dataset:
    """Forward for left, and left for forward."""
    vehicle = _vehicles(dataset)
    return _with_arms(dataset, lambda arm_m: np.einsum("nji,nj->ni", vehicle, arm_m[:, [1, 0, 2]]))


def arms_not_turned(dataset: Dataset) -> Dataset:
    """Forward as east and left as north, wherever the car drives."""
    return _with_arms(dataset, lambda arm_m: arm_m)


RIG_FAULTS: dict[str, Fault] = {
    "inverted_mounts": Fault(inverted_mounts),
    "quaternion_order": Fault(lambda good: of_camera(good, quaternion_order(good), 0), of="camera 0"),
    "camera_axes": Fault(lambda good: of_camera(good, upside_down(good), 1), of="camera 1"),
    "picture_size": Fault(lambda good: of_camera(good, picture_size(good), 1), of="camera 1"),
    "cameras_exchanged": Fault(lambda good: exchanged(good, 0, 1)),
    "camera_aside": Fault(camera_aside),
    "boxes_half_size": Fault(lambda good: of_camera(good, boxes_half_size(good), 1), of="camera 1"),
    "camera_yaw": Fault(lambda good: of_camera(good, camera_yaw(good), 2), of="camera 2"),
    "camera_height": Fault(lambda good: of_camera(good, lowered(good), 0), of="camera 0"),
    "camera_mount": Fault(lambda good: mount_in_degrees(good, 2), of="camera 2"),
    "time_shift": Fault(lambda good: camera_late(good, 1), of="camera 1"),
    "arms_left_out": Fault(arms_left_out, finding="lever_arms"),
    "arms_exchanged": Fault(arms_exchanged, finding="lever_arms"),
    "arms_not_turned": Fault(arms_not_turned, finding="lever_arms"),
}
"""What only cars with several cameras have."""


# ---------------------------------------------------------------------------------------------- measuring


def found_objects(dataset: Dataset, good: Dataset) -> int:
    """Return how many true objects of good data a map of the dataset has a label for, on the ground."""
    assert good.truth is not None
    labels = build_map(dataset).labels
    if not len(labels):
        return 0
    plane = np.stack(list(good.frame.east_north()), axis=1)
    distance, _ = cKDTree(labels.position_in_world_m @ plane).query(good.truth.position_in_world_m @ plane)
    return int((np.asarray(distance) <= MATCH_M).sum())


def is_same(fixed: Dataset, good: Dataset) -> bool:
    """Return whether a fix gave back all poses, times, passes, cameras and boxes, to rounding."""
    if len(fixed.images) != len(good.images) or len(fixed.detections) != len(good.detections):
        return False
    pairs = [
        (rotation_matrices(fixed.images), rotation_matrices(good.images), 1e-7),
        (camera_centers(fixed.images), camera_centers(good.images), 1e-4),
        (fixed.images.image_id, good.images.image_id, 0.0),
        (fixed.images.camera_id, good.images.camera_id, 0.0),
        (_or_zero(fixed.images.timestamp_s), _or_zero(good.images.timestamp_s), 1e-6),
        (_or_zero(fixed.images.rotation_sigma_rad), _or_zero(good.images.rotation_sigma_rad), 1e-9),
        (fixed.detections.detection_id, good.detections.detection_id, 0.0),
        (fixed.detections.image_id, good.detections.image_id, 0.0),
        (fixed.detections.center_px, good.detections.center_px, 1e-6),
        (fixed.detections.size_px, good.detections.size_px, 1e-6),
        (np.concatenate(fixed.cameras.params), np.concatenate(good.cameras.params), 1e-6),
    ]
    return (
        fixed.frame == good.frame
        and fixed.images.pass_id.texts() == good.images.pass_id.texts()
        and fixed.detections.class_name.texts() == good.detections.class_name.texts()
        and fixed.cameras.model.texts() == good.cameras.model.texts()
        and all(a.shape == b.shape and bool(np.all(np.abs(a - b) <= most)) for a, b, most in pairs)
    )


def _or_zero(values: Floats | None) -> Floats:
    return np.zeros(1) if values is None else np.nan_to_num(values)


def measure(good: Dataset, name: str, fault: Fault, unharmed: int | None) -> dict[str, Any] | None:
    """Put one fault in, check, and map what the fix made of it."""
    spoiled = fault.spoil(good)
    if spoiled is None:
        return None
    start = time.perf_counter()
    outcome: Examination = examine(spoiled)
    seconds = time.perf_counter() - start
    findings, called = [finding.fault for finding in outcome.findings], fault.finding or name
    result: dict[str, Any] = {
        "named": any(finding.fault == called and fault.of in (None, finding.of) for finding in outcome.findings),
        "others": [finding for finding in findings if finding != called],
        "seconds": round(seconds, 2),
    }
    if fault.has_fix and unharmed is not None and good.truth is not None and name != "truth_elsewhere":
        compared = fault.compared(good)
        if compared is not good:
            unharmed = found_objects(compared, good)
        # What is the same data makes the same map.
        result["is_undone"] = is_same(outcome.fixed, compared)
        result["objects"] = unharmed if result["is_undone"] else found_objects(outcome.fixed, good)
        result["unharmed"] = unharmed
        result["recovered"] = result["objects"] >= 0.98 * unharmed - 1.0
    return result


def run(good: Dataset, faults: dict[str, Fault], record: dict[str, Any], *, maps: bool = True) -> Iterator[None]:
    """Check one good dataset as it is and with each fault; yield when more of it stands in the record."""
    if not record:
        start = time.perf_counter()
        clean = examine(good)
        record |= {
            "clean": [finding.to_json() for finding in clean.findings],
            "seconds": round(time.perf_counter() - start, 2),
            "nowhere": [],
            "faults": {},
        }
        yield
    left = {name: fault for name, fault in faults.items() if name not in (*record["faults"], *record["nowhere"])}
    unharmed = found_objects(good, good) if maps and left and good.truth is not None else None
    for name, fault in left.items():
        result = measure(good, name, fault, unharmed)
        if result is None:
            record["nowhere"].append(name)
        else:
            record["faults"][name] = result
            print(f"  {name:28} {_line(result)}", flush=True)
        yield


def _line(result: dict[str, Any]) -> str:
    named = "named" if result["named"] else "MISSED"
    fixed = "" if "recovered" not in result else f" {result['objects']} of {result['unharmed']} objects"
    fixed += "" if result.get("recovered", True) else " NOT RECOVERED"
    return f"{named:7}{fixed} {result['seconds']:.1f} s {' '.join(result['others'])}"


def summarise(records: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the counts over all data."""
    results = [result for record in records.values() for result in record["faults"].values()]
    fixes = [result for result in results if "recovered" in result]
    return {
        "datasets": len(records),
        "clean_with_findings": [name for name, record in records.items() if record["clean"]],
        "nowhere": {name: record["nowhere"] for name, record in records.items() if record["nowhere"]},
        "kinds": len({name for record in records.values() for name in record["faults"]}),
        "faults": len(results),
        "named": sum(result["named"] for result in results),
        "alone": sum(result["named"] and not result["others"] for result in results),
        "fixes": len(fixes),
        "recovered": sum(result["recovered"] for result in fixes),
        "missed": [
            f"{data}: {name}"
            for data, record in records.items()
            for name, r in record["faults"].items()
            if not r["named"]
        ],
        "not_recovered": [
            f"{data}: {name}"
            for data, record in records.items()
            for name, r in record["faults"].items()
            if not r.get("recovered", True)
        ],
    }


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(10)))
    parser.add_argument("--rigs", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--kitti-signs", type=Path, metavar="DIR")
    parser.add_argument("--kitti-ts", type=Path, metavar="DIR")
    parser.add_argument("--only", nargs="*", default=[], choices=sorted({**FAULTS, **RIG_FAULTS}))
    parser.add_argument(
        "--spoiled", type=int, nargs="*", default=[0], help="seeds of cities and rigs that faults go into"
    )
    parser.add_argument("--clean", action="store_true", help="look at good data only")
    parser.add_argument("--no-maps", action="store_true", help="do not map what the fixes make")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--go-on", action="store_true", help="keep what the JSON file of an interrupted run has")
    options = parser.parse_args()
    records = json.loads(options.json.read_text(encoding="utf-8"))["results"] if options.go_on else {}
    try:
        for name, good, possible in _datasets(options):
            print(name, flush=True)
            record = records.setdefault(name, {})
            faults = {} if options.clean else {k: v for k, v in possible.items() if k in (options.only or possible)}
            for _ in run(good, faults, record, maps=not options.no_maps):
                keep_record(options.json, record_of(records))  # It takes long.
            for finding in record["clean"]:
                print(f"  CLEAN DATA: {finding['fault']}: {finding['why']}")
        for key, value in summarise(records).items():
            print(f"{key:22} {value}")
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    return 0


def record_of(records: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return what is kept: where and how it was measured, totals and all."""
    return {
        "benchmark": "check_faults",
        "command": command_as_typed(),
        **describe_machine(),
        "totals": summarise(records),
        "results": records,
    }


def _datasets(options: argparse.Namespace) -> Iterator[tuple[str, Dataset, dict[str, Fault]]]:
    """Yield each good dataset with its name and the faults that go into it."""
    for seed in options.seeds:
        yield f"city {seed}", good_city(seed), FAULTS if seed in options.spoiled else {}
    for seed in options.rigs:
        yield f"rig {seed}", good_rig(seed), RIG_FAULTS if seed in options.spoiled else {}
    if options.kitti_signs is not None:
        for sequence in SEQUENCES:
            yield f"KITTI {sequence}", good_kitti(options.kitti_signs, sequence), FAULTS if sequence == "00" else {}
    if options.kitti_ts is not None:
        yield "KITTI-TS", good_kitti_ts(options.kitti_ts), FAULTS


if __name__ == "__main__":
    sys.exit(main())
