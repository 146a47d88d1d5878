"""TUM: a trajectory with one line a pose, as SLAM systems and evo write it."""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported, assemble
from valuemap.readers.cameras_of import make_cameras, parse_camera
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import read_text
from valuemap.readers.poses import (
    AXES,
    images_without_poses,
    interpolate_poses,
    make_images,
    nanoseconds_of_gap,
    rotations_of_quaternions,
    seconds_of_unit,
)
from valuemap.readers.reader import Reader

_EXPECTED = "a text file with rows: timestamp tx ty tz qx qy qz qw, camera to world"
_EXPECTED_LIST = "a text file with rows: timestamp filename"
_NANO = 1_000_000_000
_COMPONENT = re.compile(r"\bq\w*([wxyz])\b", re.IGNORECASE)
"""How comments name the parts of a quaternion: qw, quat_x, q_RS_w."""


@Reader
def read_tum(
    trajectory: Path,
    *,
    camera: str,
    image_list: Path | None = None,
    detections: DetectionFile | Path | None = None,
    axes: str = "right-down-forward",
    pixel_center: float = 0.5,
    longest_gap_s: float = 0.2,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read a trajectory of `timestamp tx ty tz qx qy qz qw` (x first!), camera to world, in metres.

    Timestamps are seconds; those as large as today's in nano-, micro- or milliseconds are taken for these.

    Parameters
    ----------
    trajectory
        Text file; lines that begin with `#` do not count.
    camera
        As in `parse_camera`.
    image_list
        Text file of `timestamp filename` (`rgb.txt`). The pose of an image is that between the two poses next in
        time; images outside the trajectory, or in a gap longer than `longest_gap_s`, are left out and listed. Without
        it there is an image `TIMESTAMP.png` for every pose, as written in the file, but for a fraction of 0 of
        nanoseconds.
    detections
        As in `read_detections`.
    axes
        The axes of what the trajectory is of, one of `AXES`.
    pixel_center
        Coordinates of the centre of the top-left pixel in the parameters of the camera.
    up, anchor, max_rejected
        As in `assemble`.

    Raises
    ------
    InputError
        A file is missing or no such table, or one whose quaternions begin with w; two poses have one time, or no image
        has a pose.
    SettingError
        An option is impossible.
    """
    if axes not in AXES:
        raise SettingError(f"axes {axes}: there are none such", hint=f"one of {', '.join(AXES)}")
    longest = nanoseconds_of_gap(longest_gap_s)
    progress("reading the trajectory", 0, 2)
    texts, rows, lines = _rows(trajectory)
    time = _nanoseconds(texts, trajectory)
    line_of: dict[int, int] = {}
    for each, line in zip(time.tolist(), lines, strict=True):
        if line_of.setdefault(each, line) != line:
            raise InputError(
                f"{trajectory} line {line}: the pose has the same timestamp as that of line {line_of[each]}",
                hint="keep one of them",
            )
    rotation = rotations_of_quaternions(rows[:, [6, 3, 4, 5]]) @ AXES[axes]
    center = rows[:, :3]
    names = [f"{_picture(text)}.png" for text in texts]
    if image_list is not None:
        image_time, names = _read_list(image_list)
        rotation, center, usable = interpolate_poses(image_time, time, rotation, center, longest)
        if not usable.any():
            raise InputError(
                f"{image_list}: no image is between two poses of the trajectory, {texts[0]} to {texts[-1]}, that are "
                f"at most {longest_gap_s:g} s apart",
                hint="are both in seconds, of one clock? --longest-gap allows longer gaps between poses",
            )
        time = image_time
    cameras, camera_id = make_cameras([parse_camera(camera, pixel_center)] * len(names), str(trajectory))
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=rotation,
        center_in_world_m=center,
        passes=[ONE_PASS] * len(names),
        source=str(image_list or trajectory),
        timestamp_s=time / _NANO,
    )
    progress("reading the detections", 1, 2)
    dataset = assemble(
        name=trajectory.stem,
        cameras=cameras,
        images=images,
        detections=read_detections(detections, images, cameras),
        up=up,
        anchor=anchor,
        source=str(trajectory),
        max_rejected=max_rejected,
        unposed=None if image_list is None else images_without_poses(images, longest_gap_s),
    )
    progress("reading the detections", 2, 2)
    return dataset


def _rows(path: Path) -> tuple[list[str], Floats, list[int]]:
    """Return timestamps, numbers (N, 7) and lines of the poses."""
    texts, rows, lines = [], [], []
    for number, line in enumerate(read_text(path, _EXPECTED).splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            if "".join(_COMPONENT.findall(line)).lower().startswith("w"):
                raise _w_first(f"{path} line {number}: says that quaternions begin with w")
            continue
        try:
            values = [float(field) for field in fields]
        except ValueError:
            values = []
        if len(values) != 8:
            raise InputError(
                f"{path} line {number}: expected 8 numbers, found {line[:80]!r}", hint=f"expected {_EXPECTED}"
            )
        if "," in line and seconds_of_unit(values[0]) != 1.0:
            raise _w_first(f"{path} line {number}: has commas and nanoseconds, as where quaternions begin with w")
        texts.append(fields[0])
        rows.append(values[1:])
        lines.append(number)
    if not rows:
        raise InputError(f"{path}: there are no poses in it", hint=f"expected {_EXPECTED}")
    return texts, np.array(rows), lines


def _read_list(path: Path) -> tuple[Ints, list[str]]:
    texts, names = [], []
    for number, line in enumerate(read_text(path, _EXPECTED_LIST).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = re.split(r"[\s,]+", line.strip(), maxsplit=1)
        if len(fields) != 2:
            raise InputError(f"{path} line {number}: found {line[:80]!r}", hint=f"expected {_EXPECTED_LIST}")
        texts.append(fields[0])
        names.append(fields[1].strip())
    if not names:
        raise InputError(f"{path}: there are no images in it", hint=f"expected {_EXPECTED_LIST}")
    return _nanoseconds(texts, path), names


def _w_first(what: str) -> InputError:
    return InputError(
        what,
        hint="EuRoC, VINS and Basalt write these: write rows timestamp tx ty tz qx qy qz qw, with spaces, and w last",
    )


def _nanoseconds(texts: list[str], path: Path) -> Ints:
    """Return times in texts as whole nanoseconds (N): in float64 two images at 10 kHz would be one today."""
    found = []
    for text in texts:
        try:
            value, exact = float(text), Decimal(text)
        except (InvalidOperation, ValueError) as error:
            raise InputError(
                f"{path}: expected a timestamp in seconds, found {text[:40]!r}", hint="is it TUM?"
            ) from error
        unit_ns = round(_NANO * seconds_of_unit(value))
        if not abs(value) * unit_ns < 2**62:
            raise InputError(
                f"{path}: expected a timestamp in seconds, found {text[:40]!r}",
                hint="today's may be in seconds, or in milli-, micro- or nanoseconds",
            )
        found.append(round(exact * unit_ns))
    return np.array(found, dtype=np.int64)


def _picture(text: str) -> str:
    """Return how pictures are named by a time: not with the `.000000` that ORB-SLAM3 writes behind nanoseconds."""
    whole, _, part = text.partition(".")
    return text if part.strip("0") or seconds_of_unit(float(text)) == 1.0 else whole
