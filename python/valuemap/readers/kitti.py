"""Odometry-style data as of KITTI: text files of poses and calibration, rectified cameras, boxes in a CSV file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from valuemap.arrays import Floats
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, FoundBoxes, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.csv_file import CsvFile
from valuemap.readers.detections import DetectionFile, format_of, read_detections
from valuemap.readers.detections.named_boxes import CORNER
from valuemap.readers.files import read_text
from valuemap.readers.names import of_other_cameras
from valuemap.readers.poses import local_from_cam, make_images
from valuemap.readers.reader import Reader
from valuemap.tables import Images

_CORNERS = ("x1", "y1", "x2", "y2")
_ROTATION_TOLERANCE = 1e-3
_PIXEL_CENTER = 0.5
"""Sources of this kind count pixels from the centre of the top-left one, valuemap from its corner."""
_EXPECTED = "a text file with one pose of 12 numbers a row"
_EXPECTED_CALIBRATION = "KITTI's calib.txt, with rows such as P2: and 12 numbers"
_EXPECTED_TIMES = "KITTI's times.txt, with the seconds of a frame a row"
_EXPECTED_BOXES = "a CSV file with columns frame, x1, y1, x2, y2 and maybe camera, class, score"


@Reader
def read_kitti(
    poses: Path,
    *,
    intrinsics: tuple[float, float, float, float] | None = None,
    calibration: Path | None = None,
    cameras: tuple[int, ...] | None = None,
    image_size: tuple[int, int],
    detections: DetectionFile | Path | None = None,
    times: Path | None = None,
    class_name: str = "object",
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    heading_deg: float | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read the poses of one drive with one or several rectified cameras, and the detections in its frames.

    Everything in pixels follows the source's convention, that the centre of the top-left pixel is (0, 0), and
    gets half a pixel added here: cx and cy, and the corners of the boxes, unless `detections` says that these count
    from the picture's corner or are fractions. All frames are one pass.

    Parameters
    ----------
    poses
        Text file; the row of a frame holds 12 numbers, the 3x4 matrix [R | t] row by row, that takes a point
        from camera axes (x right, y down, z forward, metres) into the world.
    intrinsics
        fx, fy, cx, cy in pixels: the poses are those of this camera. Frame number i is the image with id i and a name
        like `000123.png`.
    calibration
        Instead, KITTI's `calib.txt`: the poses are those of camera 0, and the matrices P0 to P3 say where the
        `cameras` are (camera 2, where not given). The image of frame 123 of camera 2 is `image_2/000123.png`; those of
        a frame are a rig.
    image_size
        Width and height in pixels.
    detections
        CSV file with columns frame (the first is 0), x1, y1, x2, y2 and maybe camera, class and score; or any of
        `read_detections`, which find images by name.
    times
        KITTI's `times.txt`: seconds of each frame.
    class_name
        The class of boxes that have none, where `detections` is a path.
    up, anchor, max_rejected
        As in `assemble`.
    heading_deg
        Where camera 0 of the first frame looked, clockwise from north, with y down and level: brings poses in its axes
        into east, north, up at the anchor.

    Raises
    ------
    InputError
        A file is missing or no table of such numbers, a pose is no rigid motion, or a box is impossible.
    SettingError
        `intrinsics`, `image_size`, `up`, `anchor` or `heading_deg` is impossible.
    """
    if (intrinsics is None) == (calibration is None):
        raise SettingError("intrinsics and calibration: expected one of them", hint="give FX FY CX CY, or calib.txt")
    if intrinsics is not None and cameras is not None:
        raise SettingError(
            f"camera {', '.join(map(str, cameras))}: is one of calib.txt, intrinsics are of the only camera there is",
            hint="leave it away, or give calib.txt instead of intrinsics (--calib)",
        )
    if min(image_size) <= 0:
        raise SettingError(
            f"image size: expected a size above 0, found {image_size[0]} x {image_size[1]}",
            hint="give it in pixels, e.g. 1241 x 376",
        )
    projections = _projections(intrinsics, calibration, (2,) if cameras is None else cameras)
    progress("reading the poses", 0, 2)
    world_from_cam0 = _read_poses(poses)
    if heading_deg is not None:
        world_from_cam0 = _turned(world_from_cam0, heading_deg, anchor)
    frames = len(world_from_cam0)
    seconds = None if times is None else _read_times(times, frames)
    rows = [(camera, frame) for camera in projections for frame in range(frames)]
    camera_of = [_camera(projections[camera], image_size) for camera, _ in rows]
    table, camera_id = make_cameras(camera_of, str(poses))
    frame = np.array([frame for _, frame in rows])
    images = make_images(
        names=[_name(camera, frame, single=calibration is None) for camera, frame in rows],
        camera_id=camera_id,
        world_from_cam=world_from_cam0[frame, :, :3],
        center_in_world_m=np.concatenate([_centers(world_from_cam0, each) for each in projections.values()]),
        passes=[ONE_PASS] * len(rows),
        source=str(poses),
        image_id=np.arange(len(rows)),
        timestamp_s=None if seconds is None else seconds[frame],
        rigs=[f"{number:09d}" for number in frame] if len(projections) > 1 else None,
    )
    progress("reading the detections", 1, 2)
    of_frames = _detections(detections, images, image_size, projections, class_name)
    dataset = assemble(
        name=poses.stem,
        cameras=table,
        images=images,
        detections=read_detections(detections, images, table) if of_frames is None else of_frames,
        up=up,
        anchor=anchor,
        source=str(poses),
        max_rejected=max_rejected,
        not_chosen=None if calibration is None else partial(of_other_cameras, cameras=list(projections)),
    )
    progress("reading the detections", 2, 2)
    return dataset


def _name(camera: int, frame: int, *, single: bool) -> str:
    return f"{frame:06d}.png" if single else f"image_{camera}/{frame:06d}.png"


def _projections(
    intrinsics: tuple[float, float, float, float] | None, calibration: Path | None, cameras: tuple[int, ...]
) -> dict[int, Floats]:
    """Return the projection (3, 4) of each camera, from the axes of the camera that the poses are of."""
    if calibration is None:
        fx, fy, cx, cy = intrinsics or (0.0,) * 4
        if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0.0):
            raise SettingError(
                f"intrinsics: expected fx fy cx cy with fx and fy above 0, found {fx:g} {fy:g} {cx:g} {cy:g}",
                hint="give them in pixels, e.g. 718.856 718.856 607.193 185.216",
            )
        return {0: np.array([[fx, 0.0, cx, 0.0], [0.0, fy, cy, 0.0], [0.0, 0.0, 1.0, 0.0]])}
    found = {}
    for number, line in enumerate(read_text(calibration, _EXPECTED_CALIBRATION).splitlines(), start=1):
        name, _, rest = line.partition(":")
        key = name.strip().removeprefix("P_rect_").removeprefix("P").lstrip("0") or "0"
        if name.strip().startswith("P") and key.isdecimal():
            found[int(key)] = _numbers(rest.split(), f"{calibration} line {number}").reshape(3, 4)
    missing = [camera for camera in cameras if camera not in found]
    if missing or not cameras:
        raise InputError(
            f"{calibration}: expected rows P{', P'.join(map(str, missing or (0,)))}, found cameras {sorted(found)}",
            hint=f"expected {_EXPECTED_CALIBRATION}",
        )
    for camera in cameras:
        if not (
            np.isfinite(found[camera]).all()
            and found[camera][0, 0] > 0.0
            and found[camera][1, 1] > 0.0
            and abs(found[camera][2, 2] - 1.0) < 1e-6
        ):
            raise InputError(
                f"{calibration}: P{camera} is no rectified camera", hint=f"expected {_EXPECTED_CALIBRATION}"
            )
    return {camera: found[camera] for camera in sorted(set(cameras))}


def _camera(projection: Floats, size: tuple[int, int]) -> Camera:
    (fx, _, cx), (_, fy, cy) = projection[0, :3].tolist(), projection[1, :3].tolist()
    return Camera("PINHOLE", size[0], size[1], (fx, fy, cx + _PIXEL_CENTER, cy + _PIXEL_CENTER))


def _centers(world_from_cam0: Floats, projection: Floats) -> Floats:
    """Return the centres (N, 3) of a camera that is turned as camera 0, and stands beside it: P = K [I | t]."""
    offset = -np.linalg.solve(projection[:, :3], projection[:, 3])
    centers: Floats = world_from_cam0[:, :, :3] @ offset + world_from_cam0[:, :, 3]
    return centers


def _turned(world_from_cam: Floats, heading_deg: float, anchor: tuple[float, float, float] | None) -> Floats:
    if not abs(heading_deg) <= 360.0:
        raise SettingError(
            f"heading: expected degrees from -360 to 360, found {heading_deg:g}",
            hint="it counts clockwise from north: 90 is east",
        )
    if anchor is None:
        raise SettingError(f"heading {heading_deg:g}: goes with an anchor", hint="give --anchor LAT LON HEIGHT too")
    turn = local_from_cam(np.radians([heading_deg]), np.zeros(1), np.zeros(1))[0]
    turned: Floats = turn @ world_from_cam
    return turned


def _read_poses(path: Path) -> Floats:
    """Return world-from-camera matrices (N, 3, 4)."""
    rows = [line.split() for line in read_text(path, _EXPECTED).rstrip().splitlines()]
    world_from_cam = np.array(
        [_numbers(fields, f"{path} line {row + 1} (frame {row})") for row, fields in enumerate(rows)]
    ).reshape(-1, 3, 4)
    rotation = world_from_cam[:, :, :3]
    with np.errstate(invalid="ignore", over="ignore"):  # Those without numbers are left out later.
        error_of_rotation = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero((error_of_rotation > _ROTATION_TOLERANCE) | (np.linalg.det(rotation) < 0.0))
    if len(wrong):
        raise InputError(
            f"{path} line {wrong[0] + 1} (frame {wrong[0]}): expected a rotation in the first three columns "
            f"of the 3x4 matrix, found {rotation[wrong[0]].tolist()} ({len(wrong)} rows)",
            hint="the numbers are r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz, camera to world, no scale",
        )
    return world_from_cam


def _numbers(fields: list[str], where: str) -> Floats:
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        numbers = []
    if len(numbers) != 12:
        text = " ".join(fields)
        raise InputError(
            f"{where}: expected 12 numbers, found {len(fields)} {'field' if len(fields) == 1 else 'fields'}: "
            f"{text if len(text) < 60 else text[:60] + '...'}",
            hint="every frame needs a pose, and its row says which it is: repair the row, do not remove it",
        )
    return np.array(numbers)


def _read_times(path: Path, frames: int) -> Floats:
    fields = read_text(path, _EXPECTED_TIMES).split()
    try:
        seconds = np.array([float(field) for field in fields])
    except ValueError as error:
        raise InputError(f"{path}: expected a number a row", hint=f"expected {_EXPECTED_TIMES}") from error
    if len(seconds) != frames or not np.isfinite(seconds).all():
        raise InputError(
            f"{path}: expected {frames} finite numbers, one a pose, found {len(seconds)}",
            hint=f"expected {_EXPECTED_TIMES}",
        )
    back = np.flatnonzero(np.diff(seconds) < 0.0)
    if len(back):
        raise InputError(
            f"{path} line {back[0] + 2}: expected times that rise, found {seconds[back[0] + 1]:g} after "
            f"{seconds[back[0]]:g}",
            hint="the row of a time is that of its frame: is the file of this drive?",
        )
    return seconds


def _detections(
    detections: DetectionFile | Path | None,
    images: Images,
    image_size: tuple[int, int],
    projections: Mapping[int, Floats],
    class_name: str,
) -> FoundBoxes | None:
    """Return the boxes of a CSV file that names frames by their numbers; None where it is something else."""
    file = DetectionFile(detections, class_name=class_name) if isinstance(detections, Path) else detections
    if file is None or format_of(file) != "csv":
        return None
    table = CsvFile(
        file.path,
        _EXPECTED_BOXES,
        texts=("image", "class"),
        numbers=(*_CORNERS, "frame", "camera", "score"),
        columns=file.columns,
    )
    if table.has("image"):
        return None
    frame = table.some_numbers(
        "frame", "frames are numbers from 0; a column of image names is called image: --detection-column image=frame"
    )
    corners_px = np.stack([table.numbers(name) for name in _CORNERS], axis=1)
    numbers = list(projections)
    frames = len(images) // len(numbers)
    names = [f"frame {number:.17g}" for number in frame.tolist()]
    if table.has("camera"):
        row_of = {float(camera): row for row, camera in enumerate(numbers)}
        number = table.some_numbers("camera", "cameras are numbers: 2 is that of image_2").tolist()
        camera = np.array([row_of.get(each, -1) for each in number])
        names = [f"image_{each:.17g}/{name}" for each, name in zip(number, names, strict=True)]
    elif len(numbers) == 1:
        camera = np.zeros(len(frame), dtype=np.int64)
    else:
        raise table.missing("a column 'camera' for several cameras")
    picture_px = np.array(image_size, dtype=np.float64) if file.fractions else np.ones(2)
    shift_px = file.shift_to_corner_px(CORNER if file.fractions else 0.0)
    known = (camera >= 0) & (frame >= 0) & (frame < frames) & (frame % 1.0 == 0.0)
    return FoundBoxes(
        image_row=np.where(known, camera * frames + np.where(known, frame, 0.0), -1.0).astype(np.int64),
        class_names=table.texts("class") if table.has_optional("class") else [file.class_name] * len(frame),
        center_px=(corners_px[:, :2] + corners_px[:, 2:]) / 2.0 * picture_px + shift_px,
        size_px=(corners_px[:, 2:] - corners_px[:, :2]) * picture_px,
        score=(table.numbers("score") if table.has_optional("score") else np.full(len(frame), file.full_score))
        / file.full_score,
        where=table.line,
        source=str(file.path),
        image_names=names,
    )
