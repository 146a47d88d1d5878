"""Matches once more where poses are known: of pictures that are turned against each other, along epipolar lines.

A house front looks another way from round the corner, and its windows look like each other: asked among all features of
a picture, few are told from the next best. Asked among those where a feature can be, if the poses are roughly right,
they are. At corners that gives half as many again of pictures that follow each other, and twice as many of those with
one between (docs/notes/structure_from_motion.md); nothing else holds a drive together there.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from valuemap.readers.structure.job import DATABASE, Job
from valuemap.readers.structure.pairs import pairs_to_match
from valuemap.readers.structure.two_views import LEAST_MATCHES, rays_of
from valuemap.tables import Floats, Ints

GUIDED = "guided.db"
"""A copy of the database with these matches: the first ones stay as they are, to begin from again."""
_LEAST_TURN_RAD, _MOST_TURN_RAD = 0.1, 1.2
"""Less changes a picture little, and its matches are many; more leaves nothing that both see."""
_BAND_RAD = 0.016
"""How far from its line a feature may be: 8 px at a focal length of 500, as first poses are wrong by half a degree."""
_LARGEST_DISTANCE, _RATIO = 0.7, 0.8
"""Of descriptors of length 1, and of the best to the second best: those of matching without poses."""


@dataclass(frozen=True, eq=False)
class Features:
    """What a picture has: directions in its camera (M, 3) of length 1, and descriptors (M, 128) of length 1."""

    ray: Floats
    descriptor: Floats


def match_turned(
    job: Job,
    workspace: Path,
    ids: Mapping[int, int],
    poses: Mapping[int, tuple[Floats, Floats]],
    cameras: Mapping[int, pycolmap.Camera],
    folder: Path,
) -> Path:
    """Return a database in the folder with new matches of the pairs that are turned against each other.

    `poses` are those of rows, cam_from_world and centre; `cameras` are by their id.
    """
    path = folder / GUIDED
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(workspace / DATABASE, path)
    features: dict[int, Features] = {}
    with pycolmap.Database.open(path) as database:
        for one, two in pairs_to_match(job):
            if one not in poses or two not in poses or not is_turned(poses[one][0], poses[two][0]):
                continue
            for row in (one, two):
                if row not in features:
                    features[row] = _read(database, ids[row], cameras[job.pictures[row].camera + 1])
            found = match_along_lines(features[one], features[two], poses[one], poses[two])
            number = ids[one], ids[two]
            if len(found) >= max(LEAST_MATCHES, _known(database, *number)):
                _write(database, *number, found)
            # Of a drive, what is behind is not asked again.
            features = {row: each for row, each in features.items() if row >= one}
    return path


def is_turned(one: Floats, two: Floats) -> bool:
    """Tell whether two rotations (3, 3) differ by so much that what both see looks different."""
    return bool(_LEAST_TURN_RAD < Rotation.from_matrix(two @ one.T).magnitude() < _MOST_TURN_RAD)


def match_along_lines(
    one: Features, two: Features, first: tuple[Floats, Floats], second: tuple[Floats, Floats]
) -> Ints:
    """Return pairs (K, 2) of features that look most like each other among those that poses allow."""
    way = first[1] - second[1]
    if not (np.linalg.norm(way) > 0.0 and len(one.ray) and len(two.ray)):
        return np.empty((0, 2), dtype=np.int64)
    # The ray of a feature and the way between the cameras make a plane, in which its other ray lies.
    across = np.cross(second[0] @ way, one.ray @ (second[0] @ first[0].T).T)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None]
    off = np.abs(across @ two.ray.T)
    squared = np.where(off < _BAND_RAD, np.maximum(2.0 - 2.0 * one.descriptor @ two.descriptor.T, 0.0), np.inf)
    rows, best = np.arange(len(squared)), squared.argmin(axis=1)
    least = squared[rows, best]
    mutual = squared.argmin(axis=0)[best] == rows
    squared[rows, best] = np.inf
    clear = least < _RATIO**2 * squared.min(axis=1)
    kept = np.flatnonzero(mutual & clear & (least < _LARGEST_DISTANCE**2))
    return np.stack([kept, best[kept]], axis=1)


def _read(database: pycolmap.Database, image_id: int, camera: pycolmap.Camera) -> Features:
    pixel = np.asarray(database.read_keypoints(image_id), dtype=np.float64)[:, :2]
    descriptor = np.asarray(database.read_descriptors(image_id).data, dtype=np.float32)
    length = np.linalg.norm(descriptor, axis=1, keepdims=True)
    return Features(rays_of(camera, pixel), np.asarray(descriptor / np.maximum(length, 1e-9)))


def _known(database: pycolmap.Database, one: int, two: int) -> int:
    known = database.exists_two_view_geometry(one, two)
    return len(database.read_two_view_geometry(one, two).inlier_matches) if known else 0


def _write(database: pycolmap.Database, one: int, two: int, found: Ints) -> None:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
    geometry.inlier_matches = found.astype(np.uint32)
    if database.exists_two_view_geometry(one, two):
        database.delete_two_view_geometry(one, two)
    database.write_two_view_geometry(one, two, geometry)
