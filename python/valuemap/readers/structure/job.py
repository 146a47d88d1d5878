"""What structure from motion is asked and what it answers, in memory and in the folder that it works in."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.errors import InputError, OutputError
from valuemap.readers.cameras_of import Camera

DATABASE, LINKS, MODELS, LOG = "database.db", "pictures", "models", "log.txt"
_RECORD, _JOB, _ANSWER = "pictures.json", "job.json", "poses.npz"
_VERSION = 2
"""Of all that is kept here: what another version of valuemap left is not understood."""
_WORK = (DATABASE, f"{DATABASE}-shm", f"{DATABASE}-wal", _ANSWER)


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture for structure from motion.

    `camera` numbers its camera among those of the job; `gps_in_world_m` (3) is NaN where it has no GPS, `sigma_m` its
    standard deviation on each axis of the ground; pictures that follow each other in a `drive` are matched.
    """

    name: str
    path: Path
    camera: int
    gps_in_world_m: Floats
    sigma_m: float
    drive: str


@dataclass(frozen=True, eq=False)
class Job:
    """Pictures in driving order within each drive, and first guesses of their cameras, which are refined.

    `has_focal` says which cameras (K) have a focal length that is known, not guessed.
    """

    pictures: Sequence[Picture]
    cameras: Sequence[Camera]
    has_focal: Sequence[bool]

    def alias(self, row: int) -> str:
        """Return the name of a picture in the database: pairs of names in a file must not have spaces."""
        return f"{row:08d}{self.pictures[row].path.suffix.lower()}"

    def gps_in_world_m(self) -> Floats:
        """Return the positions (N, 3), NaN where there are none."""
        return np.array([picture.gps_in_world_m for picture in self.pictures], dtype=np.float64).reshape(-1, 3)

    def sigma_m(self) -> Floats:
        """Return their standard deviations (N)."""
        return np.array([picture.sigma_m for picture in self.pictures], dtype=np.float64)

    def drives(self) -> Ints:
        """Return the number (N) of the drive of each picture."""
        names = [picture.drive for picture in self.pictures]
        return np.unique(names, return_inverse=True)[1].reshape(-1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Posed:
    """Poses that were found: rows (N) of the pictures, in the world; their sigmas; and the cameras, refined.

    `part` (N) says which model each is of: models are held together by the GPS alone. Where there is one, the sigmas
    are those within it; `on_earth_m` is how well all together stand on the Earth, each axis. `why_not` has the reason
    for every other row.
    """

    row: Ints
    world_from_cam: Floats
    center_in_world_m: Floats
    position_sigma_m: Floats
    rotation_sigma_rad: Floats
    part: Ints
    on_earth_m: float
    cameras: dict[int, Camera]
    why_not: dict[int, str]


def prepare(workspace: Path, job: Job) -> None:
    """Make the folder, or keep what it has where it is of the same pictures; one of others is begun anew.

    Raises
    ------
    InputError
        The folder is somebody else's.
    OutputError
        It cannot be written to.
    """
    try:
        _prepare(workspace, job)
    except OSError as error:
        raise OutputError(
            f"{workspace}: cannot be written: {error.strerror}", hint="choose another folder with --workspace"
        ) from error


def _prepare(workspace: Path, job: Job) -> None:
    facts = [
        [p.name, (s := p.path.stat()).st_size, s.st_mtime_ns, p.camera, p.gps_in_world_m.tolist(), p.sigma_m, p.drive]
        for p in job.pictures
    ]
    cameras = [[c.model, c.width, c.height, *c.params] for c in job.cameras]
    text = json.dumps([facts, cameras, list(job.has_focal)])
    record = json.dumps(
        {"version": _VERSION, "pictures": len(facts), "hash": hashlib.sha256(text.encode()).hexdigest()}
    )
    path = workspace / _RECORD
    if workspace.is_dir() and any(workspace.iterdir()):
        if not path.is_file():
            raise InputError(f"{workspace}: is not empty and not ours", hint="choose another --workspace")
        if path.read_text(encoding="utf-8") == record:
            return
        path.unlink()  # Until all is there, it is of no pictures.
        path.touch()
        for name in _WORK:
            (workspace / name).unlink(missing_ok=True)
        for name in (LINKS, MODELS):
            shutil.rmtree(workspace / name, ignore_errors=True)
    elif workspace.exists() and not workspace.is_dir():
        raise InputError(f"{workspace}: is a file", hint="choose another --workspace")
    (workspace / LINKS).mkdir(parents=True, exist_ok=True)
    for row, picture in enumerate(job.pictures):
        (workspace / LINKS / job.alias(row)).symlink_to(picture.path.resolve())
    listed = [[p.name, str(p.path), p.camera, p.gps_in_world_m.tolist(), p.sigma_m, p.drive] for p in job.pictures]
    (workspace / _JOB).write_text(json.dumps([listed, cameras, list(job.has_focal)]), encoding="utf-8")
    path.write_text(record, encoding="utf-8")


def read_job(workspace: Path) -> Job:
    """Return what `prepare` wrote."""
    listed, cameras, has_focal = json.loads((workspace / _JOB).read_text(encoding="utf-8"))
    pictures = [
        Picture(name, Path(path), camera, np.array(gps, dtype=np.float64), sigma_m, drive)
        for name, path, camera, gps, sigma_m, drive in listed
    ]
    return Job(pictures, [_camera(values) for values in cameras], has_focal)


def write_answer(workspace: Path, posed: Posed) -> None:
    """Keep what was found; it is there whole or not at all."""
    cameras = {number: [c.model, c.width, c.height, *c.params] for number, c in posed.cameras.items()}
    fresh = workspace / f"fresh-{_ANSWER}"
    np.savez(
        fresh,
        row=posed.row,
        world_from_cam=posed.world_from_cam,
        center_in_world_m=posed.center_in_world_m,
        position_sigma_m=posed.position_sigma_m,
        rotation_sigma_rad=posed.rotation_sigma_rad,
        part=posed.part,
        on_earth_m=posed.on_earth_m,
        texts=np.array([json.dumps(cameras), json.dumps(posed.why_not)]),
    )
    fresh.replace(workspace / _ANSWER)


def read_answer(workspace: Path) -> Posed | None:
    """Return what was found, or None where the work has not come to its end."""
    path = workspace / _ANSWER
    if not path.is_file():
        return None
    with np.load(path) as file:
        cameras, why_not = (json.loads(text) for text in file["texts"].tolist())
        return Posed(
            row=file["row"],
            world_from_cam=file["world_from_cam"],
            center_in_world_m=file["center_in_world_m"],
            position_sigma_m=file["position_sigma_m"],
            rotation_sigma_rad=file["rotation_sigma_rad"],
            part=file["part"],
            on_earth_m=float(file["on_earth_m"]),
            cameras={int(number): _camera(values) for number, values in cameras.items()},
            why_not={int(row): reason for row, reason in why_not.items()},
        )


def _camera(values: list[Any]) -> Camera:
    model, width, height, *params = values
    return Camera(model, width, height, tuple(params))
