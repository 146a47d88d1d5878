"""kapture: a folder of text tables of sensors, rigs, trajectories and records."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras, parse_camera
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import check_folder, file_in, read_text
from valuemap.readers.poses import make_images, seconds_of_unit
from valuemap.readers.reader import Reader

_EXPECTED = "a kapture folder with sensors/sensors.txt, sensors/records_camera.txt and sensors/trajectories.txt"
_DEEPEST_RIG = 10
_SHOWN = 5


@dataclass(frozen=True)
class _Pose:
    """point_in_device = R point_in_reference + t."""

    rotation: Floats
    translation_m: Floats

    def after(self, other: _Pose) -> _Pose:
        return _Pose(self.rotation @ other.rotation, self.rotation @ other.translation_m + self.translation_m)


@Reader
def read_kapture(
    folder: Path,
    *,
    detections: DetectionFile | Path | None = None,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read a kapture folder, version 1.

    Poses take the world into the device (quaternion w, x, y, z, then translation), and rigs the rig into the sensor;
    camera models are COLMAP's. Images without a pose are left out and listed. A pass is the folder of an image's name
    without its last part where that is one camera's, images of one rig at one time are a rig, and timestamps are taken
    for nanoseconds, micro- or milliseconds since 1970 where they are as large as today's.

    Parameters
    ----------
    folder
        The folder that holds `sensors`.
    detections
        As in `read_detections`.
    up, anchor, max_rejected
        As in `assemble`.

    Raises
    ------
    InputError
        A table is missing or damaged, or a camera has a model that is not known.
    SettingError
        `up` or `anchor` is impossible.
    """
    check_folder(folder, _EXPECTED)
    progress("reading the kapture tables", 0, 2)
    sensors = _sensors(folder)
    rigs = _rigs(folder)
    poses = _trajectories(folder)
    cameras_of: dict[str, Camera] = {}  # Of those with a pose alone: kapture need not know the others.
    names, camera_of, found, rig, time, device_of = [], [], [], [], [], []
    unposed: dict[str, str] = {}
    without: set[str] = set()
    for row in _table(folder, "records_camera.txt", 3):
        stamp, device, name = row.stamp(), row.fields[1], ",".join(row.fields[2:])
        if device not in sensors:
            raise row.wrong("a camera of sensors.txt", device)
        posed = _pose(stamp, device, poses, rigs)
        if posed is None:
            unposed[name] = f"trajectories.txt has no pose then of {device}, nor of a rig that rigs.txt puts it on"
            without.add(device)
            continue
        pose, owner = posed
        names.append(name)
        if device not in cameras_of:
            cameras_of[device] = _camera(sensors[device])
        camera_of.append(cameras_of[device])
        found.append(pose)
        rig.append(f"{stamp}/{owner}")
        time.append(_seconds(stamp, row))
        device_of.append(device)
    if not names:
        with_pose = ", ".join(sorted({device for _, device in poses})[:_SHOWN]) or "nothing"
        raise InputError(
            f"{folder}: no record of a camera has a pose: records are of {', '.join(sorted(without)[:_SHOWN])}, "
            f"trajectories.txt has poses of {with_pose}",
            hint="are both of the same data and times? sensors/rigs.txt says which cameras are on which device",
        )
    cameras, camera_id = make_cameras(camera_of, str(folder))
    rotation = np.array([pose.rotation for pose in found])
    translation = np.array([pose.translation_m for pose in found])
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=rotation.transpose(0, 2, 1),
        center_in_world_m=-np.einsum("nji,nj->ni", rotation, translation),
        passes=_passes(names, device_of),
        source=str(folder),
        timestamp_s=np.array(time),
        rigs=rig,
    )
    progress("reading the detections", 1, 2)
    dataset = assemble(
        name=folder.resolve().name,
        cameras=cameras,
        images=images,
        detections=read_detections(detections, images, cameras),
        up=up,
        anchor=anchor,
        source=str(folder),
        max_rejected=max_rejected,
        unreadable=unposed,
    )
    progress("reading the detections", 2, 2)
    return dataset


@dataclass(frozen=True)
class _Row:
    fields: list[str]
    where: str

    def wrong(self, expected: str, found: str) -> InputError:
        return InputError(f"{self.where}: expected {expected}, found {found[:60]!r}", hint=f"expected {_EXPECTED}")

    def stamp(self) -> str:
        """Return the timestamp, a whole number, in one way of writing it."""
        text = self.fields[0]
        return text.lstrip("0") or "0" if text.isascii() and text.isdigit() else text

    def pose(self, first: int) -> _Pose | None:
        """Return the pose in the fields from `first` on; None where it is not whole, NaN where a number is none."""
        try:
            values = np.array([float(text) if text else np.nan for text in self.fields[first : first + 7]])
        except ValueError as error:
            raise self.wrong("qw, qx, qy, qz, tx, ty, tz", ", ".join(self.fields[first:])) from error
        if len(values) != 7 or "" in self.fields[first : first + 7]:
            return None
        if not np.isfinite(values).all():
            return _Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
        length = np.linalg.norm(values[:4])
        if not abs(length - 1.0) < 1e-3:
            raise self.wrong("a quaternion of length 1", ", ".join(self.fields[first : first + 4]))
        return _Pose(Rotation.from_quat(values[:4], scalar_first=True).as_matrix(), values[4:])


def _table(folder: Path, name: str, least: int, *, optional: bool = False) -> list[_Row]:
    if optional and not (folder / "sensors" / name).exists():
        return []
    path = file_in(folder, f"sensors/{name}", _EXPECTED)
    rows = []
    for number, line in enumerate(read_text(path, _EXPECTED).splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            row = _Row([field.strip() for field in line.split(",")], f"{path} line {number}")
            if len(row.fields) < least:
                raise row.wrong(f"at least {least} fields", line)
            rows.append(row)
    return rows


def _sensors(folder: Path) -> dict[str, _Row]:
    """Return the rows of cameras by name: sensor_id, name, type, model, width, height, parameters."""
    return {row.fields[0]: row for row in _table(folder, "sensors.txt", 3) if row.fields[2] == "camera"}


def _camera(row: _Row) -> Camera:
    try:
        return parse_camera(" ".join(row.fields[3:]))
    except SettingError as error:
        raise InputError(f"{row.where}: {error}", hint="kapture's camera models have COLMAP's names") from error


def _rigs(folder: Path) -> dict[str, dict[str, _Pose]]:
    """Return the rigs that a device is in, and where: device, rig, sensor from rig."""
    found: dict[str, dict[str, _Pose]] = {}
    for row in _table(folder, "rigs.txt", 9, optional=True):
        pose = row.pose(2)
        if pose is None or not np.isfinite(pose.translation_m).all():
            raise row.wrong("seven finite numbers", ", ".join(row.fields[2:]))
        found.setdefault(row.fields[1], {})[row.fields[0]] = pose
    return found


def _trajectories(folder: Path) -> dict[tuple[str, str], _Pose]:
    found = {}
    for row in _table(folder, "trajectories.txt", 9):
        pose = row.pose(2)
        if pose is not None:
            found[row.stamp(), row.fields[1]] = pose
    return found


def _pose(
    stamp: str,
    device: str,
    poses: dict[tuple[str, str], _Pose],
    rigs: dict[str, dict[str, _Pose]],
    depth: int = 0,
) -> tuple[_Pose, str] | None:
    """Return the pose of a device at a time, its own or through the rigs that it is in, and who has it."""
    own = poses.get((stamp, device))
    if own is not None or depth == _DEEPEST_RIG:
        return None if own is None else (own, device)
    for rig, sensor_from_rig in rigs.get(device, {}).items():
        above = _pose(stamp, rig, poses, rigs, depth + 1)
        if above is not None:
            return sensor_from_rig.after(above[0]), above[1]
    return None


def _seconds(stamp: str, row: _Row) -> float:
    try:
        value = float(stamp)
    except ValueError as error:
        raise row.wrong("a timestamp", stamp) from error
    if not abs(value) < 1e30:
        raise row.wrong("a timestamp", stamp)
    return value * seconds_of_unit(value)


def _passes(names: list[str], device_of: list[str]) -> list[str]:
    """Return the folders of names, without a last part that only one camera has and another one beside it has not."""
    folders = [PurePosixPath(name).parent for name in names]
    devices: dict[PurePosixPath, set[str]] = {}
    for folder, device in zip(folders, device_of, strict=True):
        devices.setdefault(folder, set()).add(device)
    beside: dict[PurePosixPath, set[str]] = {}
    for folder, found in devices.items():
        beside.setdefault(folder.parent, set()).update(found)
    found_passes = []
    for folder in folders:
        of_a_camera = len(devices[folder]) == 1 and len(beside[folder.parent]) > 1
        place = folder.parent if of_a_camera else folder
        found_passes.append(str(place) if str(place) != "." else ONE_PASS)
    return found_passes
