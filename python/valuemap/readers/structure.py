"""Poses of pictures by pycolmap's structure from motion, with positions of the GPS as priors, on the Earth.

What has been found is kept in a workspace, so that an interrupted run goes on: features of pictures and matches of
pairs that are in its database are not made again. A model is moved onto the GPS by a similarity that also turns the
cameras' mean up onto the vertical: along one straight street positions alone leave the roll about it open.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from valuemap.errors import InputError
from valuemap.progress import Progress, silent
from valuemap.tables import Floats, Ints

_DATABASE, _RECORD, _LINKS, _MODELS = "database.db", "pictures.json", "pictures", "models"
_CHUNK_PICTURES, _CHUNK_PAIRS = 16, 64
_FOLLOWING, _AROUND, _AROUND_M = 8, 20, 30.0
_MAX_FEATURES = 4096
_TILT_SIGMA_RAD = 0.05
_ROUNDS = 10
_LEAST_IMAGES = 3
_INITIAL_ANGLE_DEG = 6.0


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture for structure from motion.

    `camera` numbers its camera among `cameras`; `gps_in_world_m` is NaN where it has no GPS; pictures that follow each
    other in a `drive` are matched.
    """

    name: str
    path: Path
    camera: int
    gps_in_world_m: Floats
    sigma_m: float
    drive: str


@dataclass(frozen=True, eq=False)
class Posed:
    """Poses that were found: rows (N) of the pictures, in the world; their sigmas; and the cameras, refined."""

    row: Ints
    world_from_cam: Floats
    center_in_world_m: Floats
    position_sigma_m: Floats
    rotation_sigma_rad: Floats
    part: Ints
    """Which model each is of: models share no errors."""
    cameras: dict[int, pycolmap.Camera]


def find_poses(
    pictures: Sequence[Picture],
    cameras: Sequence[pycolmap.Camera],
    workspace: Path,
    *,
    threads: int = -1,
    progress: Progress = silent,
) -> Posed:
    """Find the poses of pictures in driving order; those that no model takes in are left out.

    Parameters
    ----------
    pictures
        In driving order within each drive.
    cameras
        First guesses of the intrinsics, which are refined.
    workspace
        Folder that is made for what is found on the way; one that was made for other pictures is begun anew.

    Raises
    ------
    InputError
        The folder is somebody else's, or no model can be made or placed.
    """
    _prepare(workspace, pictures)
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # It tells every step.
    image_ids = _extract(pictures, cameras, workspace, threads, progress)
    _match(pictures, workspace, threads, progress)
    models = _map(pictures, workspace, threads, progress)
    return _placed(models, pictures, image_ids, workspace)


def _alias(row: int, picture: Picture) -> str:
    """Return the name of a picture in the database: pairs of names in a file must not have spaces."""
    return f"{row:08d}{picture.path.suffix.lower()}"


def _prepare(workspace: Path, pictures: Sequence[Picture]) -> None:
    """Make the workspace, or keep what it has where it is of the same pictures."""
    facts = [[p.name, p.path.stat().st_size, p.camera, p.gps_in_world_m.tolist(), p.sigma_m] for p in pictures]
    record = {"pictures": len(pictures), "hash": hashlib.sha256(json.dumps(facts).encode()).hexdigest()}
    if workspace.exists() and any(workspace.iterdir()):
        path = workspace / _RECORD
        if not path.is_file():
            raise InputError(f"{workspace}: is not empty and not ours", hint="choose another --workspace")
        if path.read_text(encoding="utf-8") == json.dumps(record):
            return
        for name in (_DATABASE, f"{_DATABASE}-shm", f"{_DATABASE}-wal"):
            (workspace / name).unlink(missing_ok=True)
        for name in (_LINKS, _MODELS):
            shutil.rmtree(workspace / name, ignore_errors=True)
    (workspace / _LINKS).mkdir(parents=True, exist_ok=True)
    for row, picture in enumerate(pictures):
        (workspace / _LINKS / _alias(row, picture)).symlink_to(picture.path.resolve())
    (workspace / _RECORD).write_text(json.dumps(record), encoding="utf-8")


def _extract(
    pictures: Sequence[Picture],
    cameras: Sequence[pycolmap.Camera],
    workspace: Path,
    threads: int,
    progress: Progress,
) -> dict[str, int]:
    """Find features, and write the GPS as priors; return the ids of the images by their names in the database."""
    database_path = workspace / _DATABASE
    with pycolmap.Database.open(database_path) as database:
        if database.num_cameras() == 0:
            for camera in cameras:
                database.write_camera(camera)
        known = {image.name for image in database.read_all_images()}
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = threads, False
    options.sift.max_num_features = _MAX_FEATURES
    done = 0
    for number in range(len(cameras)):
        rows = [row for row, picture in enumerate(pictures) if picture.camera == number]
        missing = [name for row in rows if (name := _alias(row, pictures[row])) not in known]
        done += len(rows) - len(missing)
        reader = pycolmap.ImageReaderOptions()
        reader.existing_camera_id = number + 1
        for start in range(0, len(missing), _CHUNK_PICTURES):
            progress("finding features", done, len(pictures))
            chunk = missing[start : start + _CHUNK_PICTURES]
            pycolmap.extract_features(
                database_path,
                workspace / _LINKS,
                image_names=chunk,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(chunk)
    progress("finding features", len(pictures), len(pictures))
    with pycolmap.Database.open(database_path) as database:
        images = {image.name: image for image in database.read_all_images()}
        database.clear_pose_priors()
        for row, picture in enumerate(pictures):
            image = images.get(_alias(row, picture))
            if image is not None and np.isfinite(picture.gps_in_world_m).all():
                prior = pycolmap.PosePrior()
                prior.corr_data_id = image.data_id
                prior.position = picture.gps_in_world_m
                prior.position_covariance = picture.sigma_m**2 * np.diag([1.0, 1.0, 4.0])
                prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
                database.write_pose_prior(prior)
    return {name: image.image_id for name, image in images.items()}


def _pairs(pictures: Sequence[Picture]) -> list[tuple[int, int]]:
    """Return pairs of rows to match: those that follow each other in a drive, and those near each other by GPS."""
    found: set[tuple[int, int]] = set()
    drives: dict[str, list[int]] = {}
    for row, picture in enumerate(pictures):
        drives.setdefault(picture.drive, []).append(row)
    for rows in drives.values():
        found |= {(a, b) for i, a in enumerate(rows) for b in rows[i + 1 : i + 1 + _FOLLOWING]}
    gps = np.array([picture.gps_in_world_m for picture in pictures])
    located = np.flatnonzero(np.isfinite(gps).all(axis=1))
    if len(located) > 1:
        count = min(_AROUND + 1, len(located))
        _, near = cKDTree(gps[located]).query(gps[located], k=[*range(1, count + 1)], distance_upper_bound=_AROUND_M)
        for i, others in enumerate(np.asarray(near).tolist()):
            for j in others:
                if j < len(located) and i != j:
                    first, second = sorted((int(located[i]), int(located[j])))
                    found.add((first, second))
    return sorted(found)


def _match(pictures: Sequence[Picture], workspace: Path, threads: int, progress: Progress) -> None:
    """Match pairs in chunks; those that were matched before are passed over by pycolmap."""
    pairs = _pairs(pictures)
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = threads, False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = workspace / "pairs.txt"
    for start in range(0, len(pairs), _CHUNK_PAIRS):
        progress("matching pictures", start, len(pairs))
        lines = [f"{_alias(a, pictures[a])} {_alias(b, pictures[b])}" for a, b in pairs[start : start + _CHUNK_PAIRS]]
        (workspace / "pairs.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        pycolmap.match_image_pairs(
            workspace / _DATABASE, matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu
        )
    progress("matching pictures", len(pairs), len(pairs))


def _map(
    pictures: Sequence[Picture], workspace: Path, threads: int, progress: Progress
) -> list[pycolmap.Reconstruction]:
    """Return the models, the largest first; those of an earlier run that came to its end are read."""
    folder = workspace / _MODELS
    finished = folder / "finished"
    if not finished.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = threads, 0
        options.use_prior_position = bool(sum(np.isfinite(p.gps_in_world_m).all() for p in pictures) >= _LEAST_IMAGES)
        options.use_robust_loss_on_prior_position = True
        options.extract_colors = False
        options.min_model_size = _LEAST_IMAGES
        # A car drives forward: pairs without a wide angle between them, and along the optical axis, are what there is.
        options.mapper.init_max_forward_motion, options.mapper.init_min_tri_angle = 1.0, _INITIAL_ANGLE_DEG
        posed = 0

        def count() -> None:
            nonlocal posed
            posed = min(posed + 1, len(pictures))
            progress("finding poses", posed, len(pictures))

        progress("finding poses", 0, len(pictures))
        found = pycolmap.incremental_mapping(
            workspace / _DATABASE, workspace / _LINKS, folder, options=options, next_image_callback=count
        )
        for number, model in found.items():
            place = folder / f"{number:04d}"
            place.mkdir(exist_ok=True)
            model.write_binary(place)
        finished.write_text(f"{len(found)}\n", encoding="utf-8")
    progress("finding poses", len(pictures), len(pictures))
    models = [pycolmap.Reconstruction(path) for path in sorted(folder.glob("[0-9][0-9][0-9][0-9]"))]
    return sorted(models, key=lambda model: -model.num_reg_images())


def _placed(
    models: list[pycolmap.Reconstruction], pictures: Sequence[Picture], image_ids: dict[str, int], workspace: Path
) -> Posed:
    """Return the poses of all models on the Earth; a picture in several counts in the largest."""
    row_of = {image_ids[alias]: row for row, p in enumerate(pictures) if (alias := _alias(row, p)) in image_ids}
    taken: set[int] = set()
    rows, rotations, centers, position_sigma, rotation_sigma, part = [], [], [], [], [], []
    cameras: dict[int, pycolmap.Camera] = {}
    for number, model in enumerate(models):
        images = [
            image for _, image in sorted(model.images.items()) if image.has_pose and row_of[image.image_id] not in taken
        ]
        if len(images) < _LEAST_IMAGES:
            continue
        row = np.array([row_of[image.image_id] for image in images])
        rotation = np.array([image.cam_from_world().rotation.matrix().T for image in images])
        center = np.array([image.projection_center() for image in images])
        gps = np.array([pictures[each].gps_in_world_m for each in row])
        moved = similarity_onto(center, -rotation[:, :, 1], gps, np.array([pictures[each].sigma_m for each in row]))
        if moved is None:
            continue
        scale, turn, shift = moved
        taken |= set(row.tolist())
        rows.append(row)
        rotations.append(turn @ rotation)
        centers.append(scale * center @ turn.T + shift)
        sigmas = np.array([_resection_sigmas(image, model) for image in images])
        position_sigma.append(scale * sigmas[:, 0])
        rotation_sigma.append(sigmas[:, 1])
        part.append(np.full(len(row), number))
        for camera_id, camera in model.cameras.items():
            cameras.setdefault(camera_id - 1, camera)
    if not rows:
        raise InputError(
            f"{workspace}: structure from motion found no model with {_LEAST_IMAGES} pictures that have a GPS position",
            hint="do neighbouring pictures overlap, and do they have GPS? --poses exif takes headings as they are",
        )
    return Posed(
        row=np.concatenate(rows),
        world_from_cam=np.concatenate(rotations),
        center_in_world_m=np.concatenate(centers),
        position_sigma_m=np.concatenate(position_sigma),
        rotation_sigma_rad=np.concatenate(rotation_sigma),
        part=np.concatenate(part),
        cameras=cameras,
    )


def similarity_onto(center: Floats, up: Floats, gps_m: Floats, sigma_m: Floats) -> tuple[float, Floats, Floats] | None:
    """Return scale, rotation and shift that take a model's camera centres onto their GPS positions and up onto z.

    Weighted least squares by the singular value decomposition of Umeyama (1991), with the cameras' up directions as
    further correspondences of a standard deviation of 0.05 rad, reweighted ten times so that outliers of the GPS lose
    their weight (Cauchy's loss). None where fewer than three positions are known, or all are one.

    Parameters
    ----------
    center, up
        Camera centres and up directions (N, 3) in the model.
    gps_m, sigma_m
        GPS positions (N, 3), NaN where there are none, and their standard deviations (N).
    """
    known = np.isfinite(gps_m).all(axis=1)
    if known.sum() < _LEAST_IMAGES:
        return None
    source, target, sigma = center[known], gps_m[known], sigma_m[known]
    robust, scale = np.ones(len(source)), 1.0
    turn, shift = np.eye(3), np.zeros(3)
    mean_up = up.mean(axis=0)
    for _ in range(_ROUNDS):
        weight = robust / sigma**2
        share = weight / weight.sum()
        source_mean, target_mean = share @ source, share @ target
        a, b = source - source_mean, target - target_mean
        if not (share @ (a**2).sum(axis=1) > 0.0 and share @ (b**2).sum(axis=1) > 0.0):
            return None
        # Positions weigh by the square of their sigma, directions by that of the tilt, both without a unit.
        across = scale * (weight[:, None] * b).T @ a + len(up) / _TILT_SIGMA_RAD**2 * np.outer([0.0, 0.0, 1.0], mean_up)
        u, _, vt = np.linalg.svd(across)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turned = a @ turn.T
        scale = float(np.sum(share * (b * turned).sum(axis=1)) / np.sum(share * (turned**2).sum(axis=1)))
        if not scale > 0.0:
            scale = float(np.sqrt(np.sum(share * (b**2).sum(axis=1)) / np.sum(share * (a**2).sum(axis=1))))
        shift = target_mean - scale * turn @ source_mean
        away = np.linalg.norm(target - (scale * source @ turn.T + shift), axis=1) / sigma
        robust = 1.0 / (1.0 + (away / 3.0) ** 2)
    return scale, turn, shift


def _resection_sigmas(image: pycolmap.Image, model: pycolmap.Reconstruction) -> tuple[float, float]:
    """Return standard deviations of position (in the model's unit) and rotation (rad) of a picture among its points.

    Those of a resection from N points with the model's mean reprojection error e: e / (f sqrt(N / 2)), times the
    median depth for the position.
    """
    points = [model.points3D[p.point3D_id] for p in image.points2D if p.has_point3D()]
    if not points:
        return float("nan"), float("nan")
    depth = np.median([abs((image.cam_from_world() * point.xyz)[2]) for point in points])
    error_px = float(np.mean([point.error for point in points]))
    focal = model.cameras[image.camera_id].mean_focal_length()
    angle = max(error_px, 0.1) / focal / np.sqrt(len(points) / 2.0)
    return float(angle * depth), float(angle)
