"""KITTI-360: poses of the car, and calibrated perspective and fisheye cameras."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.colmap import pycolmap
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import check_folder, file_in, read_text, read_yaml
from valuemap.readers.json_values import Json
from valuemap.readers.names import of_other_cameras
from valuemap.readers.poses import make_images
from valuemap.readers.reader import Reader

_EXPECTED = "KITTI-360's folder with calibration/ and data_poses/SEQUENCE/poses.txt"
_PERSPECTIVE, _FISHEYE = (0, 1), (2, 3)
_SEQUENCE = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync")
_WIDEST_RAD = np.radians(90.0)
_MAX_FIT_PX = 0.5
"""Those of the data set are 0.03 and 0.09 px off."""


@Reader
def read_kitti360(
    root: Path,
    *,
    sequence: str,
    cameras: tuple[int, ...] = (0,),
    detections: DetectionFile | Path | None = None,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read one sequence: the pose of the car, the place of the camera in it, and what rectified it undone.

    The image of frame 123 of camera 0 is `SEQUENCE/image_00/data_rect/0000000123.png`, and of camera 2
    `SEQUENCE/image_02/data_rgb/0000000123.png`. Images of one frame are a rig; a pass is a sequence; times are those of
    `data_2d_raw/SEQUENCE/image_0N/timestamps.txt` where these files are there. The fisheyes' model (MEI) is not
    among COLMAP's: the THIN_PRISM_FISHEYE nearest to it within 90 degrees of the axis is taken, and refused beyond
    0.5 px.

    Parameters
    ----------
    root
        The folder with `calibration` and `data_poses`.
    sequence
        Such as `2013_05_28_drive_0000_sync`.
    cameras
        0 and 1 are the rectified perspective ones, 2 and 3 the fisheyes.
    detections
        As in `read_detections`.
    up, anchor, max_rejected
        As in `assemble`. The frame of the poses has z up.

    Raises
    ------
    InputError
        A file is missing or damaged.
    SettingError
        There is no such camera.
    """
    check_folder(root, _EXPECTED)
    if not cameras or any(camera not in (*_PERSPECTIVE, *_FISHEYE) for camera in cameras):
        raise SettingError(f"cameras {cameras}: expected some of 0, 1, 2, 3", hint="0 and 1 are perspective")
    cameras = tuple(sorted(set(cameras)))
    progress("reading the poses", 0, 2)
    frames, world_from_car = _poses(root, sequence)
    places = _matrices(root, "calibration/calib_cam_to_pose.txt")
    rectified = _matrices(root, "calibration/perspective.txt")
    names, camera_of, rotation, center, rigs, time = [], [], [], [], [], []
    for camera in cameras:
        car_from_cam = _need(places, f"image_{camera:02d}", 12, "calib_cam_to_pose.txt").reshape(3, 4)
        turn = np.eye(3)
        if camera in _PERSPECTIVE:
            turn = _need(rectified, f"R_rect_{camera:02d}", 9, "perspective.txt").reshape(3, 3).T
            intrinsics = _perspective(rectified, camera)
        else:
            intrinsics = _fisheye(root, camera)
        folder = "data_rect" if camera in _PERSPECTIVE else "data_rgb"
        rotation.append(world_from_car[:, :, :3] @ _rotation(car_from_cam[:, :3] @ turn))
        center.append(world_from_car[:, :, :3] @ car_from_cam[:, 3] + world_from_car[:, :, 3])
        names += [f"{sequence}/image_{camera:02d}/{folder}/{frame:010d}.png" for frame in frames]
        camera_of += [intrinsics] * len(frames)
        rigs += [f"{frame:010d}" for frame in frames]
        time.append(_times(root, sequence, camera, frames))
    table, camera_id = make_cameras(camera_of, str(root))
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=np.concatenate(rotation),
        center_in_world_m=np.concatenate(center),
        passes=[sequence] * len(names),
        source=str(root),
        timestamp_s=np.concatenate(time),
        rigs=rigs if len(cameras) > 1 else None,
    )
    progress("reading the detections", 1, 2)
    dataset = assemble(
        name=sequence,
        cameras=table,
        images=images,
        detections=read_detections(detections, images, table),
        up=(0.0, 0.0, 1.0) if up is None and anchor is None else up,
        anchor=anchor,
        source=str(root),
        max_rejected=max_rejected,
        not_chosen=lambda names: of_other_cameras(names, cameras) | _of_other_sequences(names, sequence),
    )
    progress("reading the detections", 2, 2)
    return dataset


def _of_other_sequences(names: Collection[str], sequence: str) -> set[str]:
    return {name for name in names if any(found != sequence for found in _SEQUENCE.findall(name))}


def _poses(root: Path, sequence: str) -> tuple[list[int], Floats]:
    """Return frames (N) and car-to-world matrices (N, 3, 4)."""
    path = file_in(root, f"data_poses/{sequence}/poses.txt", _EXPECTED)
    frames, rows = [], []
    for number, line in enumerate(read_text(path, _EXPECTED).splitlines(), start=1):
        fields = line.split()
        if not fields:
            continue
        try:
            frame, values = int(fields[0]), [float(field) for field in fields[1:]]
        except ValueError:
            frame, values = -1, []
        if frame < 0 or len(values) not in (12, 16):
            raise InputError(
                f"{path} line {number}: expected a frame and 12 numbers, found {line[:60]!r}",
                hint=f"expected {_EXPECTED}",
            )
        frames.append(frame)
        rows.append(values[:12])
    if len(set(frames)) < len(frames):
        raise InputError(f"{path}: a frame is there twice", hint="keep one of them")
    return frames, np.array(rows).reshape(-1, 3, 4)


def _matrices(root: Path, name: str) -> dict[str, Floats]:
    """Return the numbers of the rows `NAME: numbers` of a file."""
    path = file_in(root, name, _EXPECTED)
    found = {}
    for line in read_text(path, _EXPECTED).splitlines():
        key, _, rest = line.partition(":")
        try:
            found[key.strip()] = np.array([float(value) for value in rest.split()])
        except ValueError:
            continue  # Dates and other texts.
    return found


def _need(found: dict[str, Floats], key: str, count: int, name: str) -> Floats:
    values = found.get(key, np.empty(0))
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(
            f"{name}: {key}: expected {count} finite numbers, found {len(values)}", hint=f"expected {_EXPECTED}"
        )
    return values


def _rotation(matrix: Floats) -> Floats:
    """Return the rotation next to a product of rounded ones."""
    nearest: Floats = Rotation.from_matrix(matrix).as_matrix() if np.abs(np.linalg.det(matrix) - 1.0) < 1e-3 else matrix
    return nearest


def _perspective(found: dict[str, Floats], camera: int) -> Camera:
    projection = _need(found, f"P_rect_{camera:02d}", 12, "perspective.txt").reshape(3, 4)
    size = _need(found, f"S_rect_{camera:02d}", 2, "perspective.txt")
    params = (projection[0, 0], projection[1, 1], projection[0, 2] + 0.5, projection[1, 2] + 0.5)
    return Camera("PINHOLE", int(size[0]), int(size[1]), tuple(float(value) for value in params))


def _fisheye(root: Path, camera: int) -> Camera:
    """Return the THIN_PRISM_FISHEYE camera next to the one of `image_0N.yaml`, fitted on a grid of directions."""
    path = file_in(root, f"calibration/image_{camera:02d}.yaml", _EXPECTED)
    text = read_text(path, _EXPECTED)
    content = Json(_opencv_yaml(path) if text.startswith("%YAML") else read_yaml(path, _EXPECTED), str(path))
    distortion, projection = content["distortion_parameters"], content["projection_parameters"]
    k1, k2, p1, p2 = (distortion[name].number() for name in ("k1", "k2", "p1", "p2"))
    gamma1, gamma2, u0, v0 = (projection[name].number() for name in ("gamma1", "gamma2", "u0", "v0"))
    xi = content["mirror_parameters"]["xi"].number()
    width, height = content["image_width"].whole(), content["image_height"].whole()
    off_axis, around = np.meshgrid(np.linspace(0.0, _WIDEST_RAD, 60), np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False))
    ray = np.stack(
        [np.sin(off_axis) * np.cos(around), np.sin(off_axis) * np.sin(around), np.cos(off_axis)], axis=-1
    ).reshape(-1, 3)
    pixel = _mei(ray, xi, (k1, k2, p1, p2), (gamma1, gamma2, u0 + 0.5, v0 + 0.5))

    def miss_px(params: Floats) -> Floats:
        model = pycolmap.Camera(model="THIN_PRISM_FISHEYE", width=width, height=height, params=params)
        return np.ravel(np.asarray(model.img_from_cam(ray)) - pixel)

    # At the axis MEI's focal length is gamma / (1 + xi). It has tangential distortion, and OPENCV_FISHEYE has none.
    start = np.array([gamma1 / (1.0 + xi), gamma2 / (1.0 + xi), u0 + 0.5, v0 + 0.5, *[0.0] * 8])
    # The very edge of the half space has no pixel in a pinhole's sense.
    ray, pixel = ray[ray[:, 2] > 1e-3], pixel[ray[:, 2] > 1e-3]
    fit = least_squares(miss_px, start, x_scale=[100.0] * 4 + [0.1] * 8)
    worst = float(np.abs(fit.fun).max())
    if not worst < _MAX_FIT_PX:
        raise InputError(
            f"{path}: no THIN_PRISM_FISHEYE is within {_MAX_FIT_PX} px of it (the nearest is {worst:.2f} px off)",
            hint="are the parameters those of KITTI-360's calibration?",
        )
    return Camera("THIN_PRISM_FISHEYE", width, height, tuple(fit.x.tolist()))


def _opencv_yaml(path: Path) -> object:
    """Return what OpenCV's YAML holds, whose first line and `key:value` without a space no YAML reader takes."""
    content: dict[str, object] = {}
    section: dict[str, object] = content
    for line in read_text(path, _EXPECTED).splitlines():
        key, separator, value = line.partition(":")
        if not separator or line.startswith(("%", "---")):
            continue
        if not value.strip():
            section = {}
            content[key.strip()] = section
            continue
        target = section if line[:1].isspace() else content
        try:
            target[key.strip()] = float(value)
        except ValueError:
            target[key.strip()] = value.strip()
    return content


def _mei(ray: Floats, xi: float, distortion: tuple[float, ...], projection: tuple[float, ...]) -> Floats:
    """Return pixels (N, 2) of unit rays (N, 3): Mei and Rives, 2007, with the mirror's xi and OpenCV's distortion."""
    k1, k2, p1, p2 = distortion
    gamma1, gamma2, u0, v0 = projection
    x, y = (ray[:, :2] / (ray[:, 2:] + xi)).T
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([gamma1 * xd + u0, gamma2 * yd + v0], axis=1)


def _times(root: Path, sequence: str, camera: int, frames: list[int]) -> Floats:
    """Return seconds (N) of the frames, NaN where there is no file of times."""
    name = f"data_2d_raw/{sequence}/image_{camera:02d}/timestamps.txt"
    if not (root / name).exists():
        return np.full(len(frames), np.nan)
    path = file_in(root, name, "times, one a row")
    lines = read_text(path, "times, one a row").splitlines()
    try:
        seconds = np.array(lines, dtype="datetime64[ns]").astype(np.int64) / 1e9
    except ValueError as error:
        raise InputError(
            f"{path}: expected a time a row: {error}", hint="e.g. 2013-05-28 08:46:02.904498078"
        ) from error
    if frames and max(frames) >= len(seconds):
        raise InputError(f"{path}: has {len(seconds)} times, poses.txt has frame {max(frames)}", hint="is it whole?")
    return seconds[frames]
