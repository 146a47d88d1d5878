"""Odometry-style data as of KITTI: one text file of poses, one pinhole camera, boxes in a CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from valuemap.dataset import Dataset
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, FoundBoxes, assemble
from valuemap.readers.csv_file import read_csv
from valuemap.tables import Cameras, Categories, Floats, Images

_CORNERS = ("x1", "y1", "x2", "y2")
_ROTATION_TOLERANCE = 1e-3
_PIXEL_CENTER = 0.5
"""Sources of this kind count pixels from the centre of the top-left one, valuemap from its corner."""


def read_kitti(
    poses: Path,
    *,
    intrinsics: tuple[float, float, float, float],
    image_size: tuple[int, int],
    detections: Path,
    class_name: str = "object",
    up: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Dataset:
    """Read the poses of one drive with one rectified camera, and the detections in its frames.

    Everything in pixels follows the source's convention, that the centre of the top-left pixel is (0, 0), and
    gets half a pixel added here: cx and cy, and the corners of the boxes. Frame number i is the image with
    id i and a name like `000123.png`; all frames are one pass.

    Parameters
    ----------
    poses
        Text file; the row of a frame holds 12 numbers, the 3x4 matrix [R | t] row by row, that takes a point
        from camera axes (x right, y down, z forward, metres) into the world.
    intrinsics, image_size
        fx, fy, cx, cy in pixels, and width, height in pixels.
    detections
        CSV file with columns frame (the first is 0), x1, y1, x2, y2 and maybe class and score.
    class_name
        The class of boxes that have none.
    up, max_rejected
        As in `assemble`.

    Raises
    ------
    InputError
        A file is missing or no table of such numbers, a pose is no rigid motion, or too many boxes are impossible.
    SettingError
        `intrinsics`, `image_size`, `up` or `max_rejected` is impossible.
    """
    fx, fy, cx, cy = intrinsics
    if not (np.isfinite(intrinsics).all() and min(fx, fy) > 0.0 and min(image_size) > 0):
        raise SettingError(
            "intrinsics and image size: expected fx fy cx cy with fx and fy above 0, and a size above 0, "
            f"found {fx:g} {fy:g} {cx:g} {cy:g} and {image_size[0]} x {image_size[1]}",
            hint="give them in pixels, e.g. 718.856 718.856 607.193 185.216 and 1241 x 376",
        )
    cameras = Cameras(
        camera_id=np.array([1], dtype=np.int64),
        model=Categories.from_texts(["PINHOLE"]),
        width_px=np.array([image_size[0]], dtype=np.int64),
        height_px=np.array([image_size[1]], dtype=np.int64),
        params=[np.array([fx, fy, cx + _PIXEL_CENTER, cy + _PIXEL_CENTER])],
    )
    progress("reading the poses", 0, 2)
    images = _images(_read_poses(poses))
    progress("reading the detections", 1, 2)
    found = _read_detections(detections, len(images), class_name)
    progress("reading the detections", 2, 2)
    return assemble(
        name=poses.stem,
        cameras=cameras,
        images=images,
        detections=found,
        up=up,
        anchor=None,
        source=str(poses),
        max_rejected=max_rejected,
    )


def _read_poses(path: Path) -> Floats:
    """Return world-from-camera matrices (N, 3, 4)."""
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give a text file with one pose of 12 numbers a row")
    try:
        rows = [line.split() for line in path.read_text(encoding="utf-8").rstrip().splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {error}", hint="give a text file of poses") from error
    if not rows:
        raise InputError(f"{path}: there are no poses in it", hint="give a text file with one pose of 12 numbers a row")
    world_from_cam = np.array([_pose_numbers(path, row, fields) for row, fields in enumerate(rows)]).reshape(-1, 3, 4)
    rotation = world_from_cam[:, :, :3]
    error_of_rotation = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((error_of_rotation > _ROTATION_TOLERANCE) | (np.linalg.det(rotation) < 0.0))
    if len(wrong):
        raise InputError(
            f"{path} line {wrong[0] + 1} (frame {wrong[0]}): expected a rotation in the first three columns "
            f"of the 3x4 matrix, found {rotation[wrong[0]].tolist()} ({len(wrong)} rows)",
            hint="the numbers are r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz, camera to world, no scale",
        )
    return world_from_cam


def _pose_numbers(path: Path, row: int, fields: list[str]) -> list[float]:
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        numbers = []
    if len(numbers) != 12 or not np.isfinite(numbers).all():
        text = " ".join(fields)
        raise InputError(
            f"{path} line {row + 1} (frame {row}): expected 12 finite numbers, found {len(fields)} fields: "
            f"{text if len(text) < 60 else text[:60] + '...'}",
            hint="every frame needs a pose, and its row says which it is: repair the row, do not remove it",
        )
    return numbers


def _images(world_from_cam: Floats) -> Images:
    count = len(world_from_cam)
    cam_from_world = Rotation.from_matrix(world_from_cam[:, :, :3]).inv()
    return Images(
        image_id=np.arange(count, dtype=np.int64),
        name=pa.array([f"{frame:06d}.png" for frame in range(count)], pa.string()),
        camera_id=np.ones(count, dtype=np.int64),
        cam_from_world_quat=cam_from_world.as_quat(canonical=True, scalar_first=True),
        cam_from_world_m=-cam_from_world.apply(world_from_cam[:, :, 3]),
        pass_id=Categories.from_texts([ONE_PASS] * count),
    )


def _read_detections(path: Path, frames: int, class_name: str) -> FoundBoxes:
    table = read_csv(
        path,
        dict.fromkeys(("frame", *_CORNERS), pa.float64()),
        {"class": pa.string(), "score": pa.float64()},
    )
    frame = table["frame"].to_numpy()
    is_frame = (frame >= 0) & (frame < frames) & (frame % 1.0 == 0.0)
    corners_px = np.stack([table[name].to_numpy() for name in _CORNERS], axis=1)
    return FoundBoxes(
        image_row=np.where(is_frame, frame, -1).astype(np.int64),
        image_names=[f"frame {number:.17g}" for number in frame],
        class_names=table["class"].to_pylist() if "class" in table.column_names else [class_name] * len(frame),
        center_px=(corners_px[:, :2] + corners_px[:, 2:]) / 2.0 + _PIXEL_CENTER,
        size_px=corners_px[:, 2:] - corners_px[:, :2],
        score=table["score"].to_numpy() if "score" in table.column_names else np.ones(len(frame)),
        where=lambda row: f"{path} line {row + 2}",
    )
