"""Poses of all pictures from their pairs, sharpened by the points that they see.

`pose_graph` says about where all cameras are. There points are made from the matches, at first with much tolerance, and
cameras and points are moved to where they agree best (`adjust`), again and again with less. Pictures that no pair holds
well are sought in the whole in the end. What shares no points stays in parts that the GPS alone holds together.

Cameras stay as they are until then: a car drives forward, and a few such pictures fit any focal length.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from valuemap.arrays import Bools, Floats, Ints
from valuemap.colmap import pycolmap
from valuemap.errors import InputError
from valuemap.progress import Progress
from valuemap.readers.cameras_of import Camera
from valuemap.readers.structure.adjust import Adjusted, Sights, adjust
from valuemap.readers.structure.features import image_ids
from valuemap.readers.structure.job import DATABASE, LINKS, MODELS, Job, Posed
from valuemap.readers.structure.pose_graph import LEAST_IMAGES, start_of
from valuemap.readers.structure.two_views import LEAST_MATCHES, read_pairs

_LEAST_INLIERS = 20
_GPS_SIGMAS = 7.0
_LEAST_POINTS, _SHARED_POINTS, _FEW_POINTS = 10, 8, 50
_TOLERANCES_PX = (12.0, 4.0, 4.0)
"""Of points, round by round: at first poses are as wrong as pairs say."""
_SHARP_PX, _ANGLE_DEG = 4.0, 2.0
_LEAST_ANGLE_DEG = 0.3
"""Between two sights of a point: features are right to 0.4 px, 0.05 degrees at a focal length of 500 px, and a depth
then to a sixth. What is farther tells how a camera turns, and at corners little else does."""

NO_FILE = "its features cannot be found: the file is damaged"
NO_MATCH = "too little of it is seen in other pictures"
NO_GPS = "it hangs together with fewer than three pictures that have a GPS position"
NOT_THERE = "structure from motion puts it where its GPS position cannot be"


@dataclass(eq=False)
class _Whole:
    """What all models together know: poses by row (cam_from_world, centre), and cameras by id."""

    poses: dict[int, tuple[Floats, Floats]] = field(default_factory=dict)
    cameras: dict[int, pycolmap.Camera] = field(default_factory=dict)


def find_models(job: Job, workspace: Path, *, threads: int, progress: Progress) -> Posed:
    """Return the poses of all pictures that can be posed, and the reasons for the others.

    Raises
    ------
    InputError
        No two pictures have anything in common, or no three with GPS hang together.
    """
    ids = image_ids(job, workspace)
    why_not = {row: NO_FILE for row in range(len(job.pictures)) if row not in ids}
    whole = _Whole(cameras=_cameras(job, workspace))
    if len(ids) >= LEAST_IMAGES:
        progress("finding poses", 0, len(ids))
        pairs = read_pairs(workspace, ids, whole.cameras)
        if not pairs:
            raise InputError(
                f"{workspace}: structure from motion finds no two of {len(ids)} pictures that have anything in common",
                hint="do neighbouring pictures overlap, and are they sharp, with more in them than sky and road? "
                "--poses exif takes headings as they are",
            )
        whole.poses = start_of(pairs, job.drives(), job.gps_in_world_m(), job.sigma_m())
        progress("finding poses", len(ids), len(ids))
    if not whole.poses:
        raise InputError(
            f"{workspace}: structure from motion finds no {LEAST_IMAGES} pictures with GPS that hang together",
            hint="do neighbouring pictures overlap, and do they have GPS? --poses exif takes headings as they are",
        )
    found, row, part = _unite(job, workspace, ids, whole, why_not, threads, progress)
    for each in ids:
        if each not in set(row.tolist()):
            why_not.setdefault(each, NO_MATCH)
    # Several parts are apart by what each is wrong on the Earth; of one, nobody sees that but who compares with others.
    sigma = found.sigma if part.max() else found.sigma_in_part
    return Posed(
        row=row,
        world_from_cam=np.swapaxes(found.cam_from_world, 1, 2),
        center_in_world_m=found.center_in_world_m,
        position_sigma_m=sigma[:, 0],
        rotation_sigma_rad=sigma[:, 1],
        part=part,
        on_earth_m=np.sqrt((found.sigma[:, 0] ** 2).mean()),
        cameras={camera_id - 1: _camera(camera) for camera_id, camera in found.cameras.items()},
        why_not=why_not,
    )


def _options(job: Job, threads: int) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    options.use_prior_position = bool(np.isfinite(job.gps_in_world_m()).all(axis=1).sum() >= LEAST_IMAGES)
    # Outliers of the GPS are few beside features; what loses weight lets a wrong start stay wrong.
    options.use_robust_loss_on_prior_position = False
    options.extract_colors = False
    options.min_model_size = LEAST_IMAGES
    options.min_num_matches = LEAST_MATCHES
    options.constant_cameras = {number + 1 for number in range(len(job.cameras))}
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.abs_pose_min_num_inliers = _LEAST_INLIERS
    return options


def _run(
    workspace: Path, folder: Path, options: Any, total: int, progress: Progress, start: Path
) -> dict[int, pycolmap.Reconstruction]:
    posed = 0

    def count() -> None:
        nonlocal posed
        posed = min(posed + 1, total)
        progress("finding poses", posed, total)

    progress("finding poses", 0, total)
    found: dict[int, pycolmap.Reconstruction] = pycolmap.incremental_mapping(
        workspace / DATABASE,
        workspace / LINKS,
        folder,
        options=options,
        input_path=start,
        next_image_callback=count,
    )
    for number, model in found.items():
        (folder / str(number)).mkdir(exist_ok=True)
        model.write_binary(folder / str(number))
    progress("finding poses", total, total)
    return found


def _cameras(job: Job, workspace: Path) -> dict[int, pycolmap.Camera]:
    """Return the cameras by id; focal lengths that nobody knows are estimated from all pairs of pictures together."""
    calibrated = workspace / MODELS / "calibrated"
    if not all(job.has_focal) and not calibrated.is_file():
        calibrated.parent.mkdir(exist_ok=True)
        options = pycolmap.ViewGraphCalibrationOptions()
        options.random_seed = 0
        pycolmap.calibrate_view_graph(workspace / DATABASE, options)
        calibrated.touch()
    with pycolmap.Database.open(workspace / DATABASE) as database:
        return {int(camera.camera_id): camera for camera in database.read_all_cameras()}


def contradicts_gps(center_m: Floats, gps_m: Floats, sigma_m: Floats) -> Bools:
    """Return which positions (N, 3) are too far from those of the GPS, whose sigmas may be too small for them all."""
    away = np.linalg.norm(center_m - gps_m, axis=1) / sigma_m
    known = np.isfinite(away)
    # Three axes, the third twice as wrong: a median of about 1.9.
    usual = max(1.0, float(np.median(away[known])) / 1.9) if known.any() else 1.0
    far: Bools = known & (np.nan_to_num(away) > _GPS_SIGMAS * usual)
    return far


def _unite(
    job: Job,
    workspace: Path,
    ids: dict[int, int],
    whole: _Whole,
    why_not: dict[int, str],
    threads: int,
    progress: Progress,
) -> tuple[Adjusted, Ints, Ints]:
    """Return the final poses of rows (N), and which part each is of: parts are held together by the GPS alone."""
    last = len(_TOLERANCES_PX) - 1
    for step, tolerance_px in enumerate(_TOLERANCES_PX):
        progress("adjusting poses", step, last + 1)
        model = _triangulated(job, workspace, ids, whole, tolerance_px, threads)
        if step == last:
            model = _with_the_rest(job, workspace, model, ids, threads, progress)
        found, row, part = _settle(job, model, ids, whole, why_not, is_last=step == last)
    progress("adjusting poses", last + 1, last + 1)
    return found, row, part


def _triangulated(
    job: Job, workspace: Path, ids: dict[int, int], whole: _Whole, tolerance_px: float, threads: int
) -> pycolmap.Reconstruction:
    """Return one model of all poses, with points made from the matches that agree to so many pixels."""
    with pycolmap.Database.open(workspace / DATABASE) as database:
        which = pycolmap.DatabaseCacheOptions()
        which.min_num_matches = LEAST_MATCHES
        cache = pycolmap.DatabaseCache.create(database, which)
    model = pycolmap.Reconstruction()
    model.load(cache)
    for camera_id, camera in whole.cameras.items():
        model.cameras[camera_id].params = list(camera.params)
    for row, (rotation, center) in sorted(whole.poses.items()):
        if not model.exists_image(ids[row]):  # It has no match at all.
            continue
        image = model.image(ids[row])
        frame = model.frame(image.frame_id)
        frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center))
        model.register_frame(image.frame_id)
    folder = workspace / MODELS / "united"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    options = _options(job, threads)
    points, looser = options.triangulation, tolerance_px / _SHARP_PX
    points.merge_max_reproj_error = points.complete_max_reproj_error = tolerance_px
    options.mapper.filter_max_reproj_error = tolerance_px
    points.create_max_angle_error = points.continue_max_angle_error = looser * _ANGLE_DEG
    points.min_angle = options.mapper.filter_min_tri_angle = _LEAST_ANGLE_DEG
    points.ignore_two_view_tracks = False  # At corners two pictures share what no third sees: see `confirmed`.
    options.use_prior_position = False  # It would turn the whole anew, about a straight street by any angle.
    made: pycolmap.Reconstruction = pycolmap.triangulate_points(
        model, workspace / DATABASE, workspace / LINKS, folder, clear_points=True, options=options
    )
    return made


def _with_the_rest(
    job: Job, workspace: Path, model: pycolmap.Reconstruction, ids: dict[int, int], threads: int, progress: Progress
) -> pycolmap.Reconstruction:
    """Return the model with pictures that no model had and that fit into the whole."""
    missing = len(ids) - model.num_reg_images()
    if not missing:
        return model
    folder = workspace / MODELS / "united"
    model.write_binary(folder)
    options = _options(job, threads)
    options.use_prior_position = options.multiple_models = False
    options.fix_existing_frames = options.mapper.fix_existing_frames = True
    found = _run(workspace, folder, options, missing, progress, start=folder)
    return max([model, *found.values()], key=lambda each: each.num_reg_images())


def _settle(
    job: Job,
    model: pycolmap.Reconstruction,
    ids: dict[int, int],
    whole: _Whole,
    why_not: dict[int, str],
    *,
    is_last: bool,
) -> tuple[Adjusted, Ints, Ints]:
    """Adjust the model, without the pictures that do not belong to it, until all that are left do."""
    row_of = {image_id: row for row, image_id in ids.items()}
    out: set[int] = set()
    while True:
        sights = _sights(job, model, row_of, out)
        part = _parts(sights)
        bad = {}
        known = np.isfinite(sights.gps_in_world_m).all(axis=1)
        seen = np.bincount(sights.image, minlength=len(sights.row))
        with_gps = np.bincount(part[known], minlength=part.max(initial=-1) + 1)
        for i, row in enumerate(sights.row.tolist()):
            if seen[i] < _LEAST_POINTS:
                bad[row] = NO_MATCH
            elif with_gps[part[i]] < LEAST_IMAGES:
                bad[row] = NO_GPS
        found = None
        if not bad:
            found = adjust(sights, part, is_last=is_last)
            wrong = contradicts_gps(found.center_in_world_m, sights.gps_in_world_m, sights.sigma_m)
            bad = dict.fromkeys(sights.row[wrong].tolist(), NOT_THERE)
        if found is not None and not bad:
            break
        why_not.update(bad)
        out |= set(bad)
        if len(out) == model.num_reg_images():
            raise InputError(
                f"{job.pictures[0].path.parent}: structure from motion finds no pictures that agree with their GPS",
                hint="is --gps-sigma right? --poses exif takes headings as they are",
            )
    whole.poses = {
        row: (found.cam_from_world[i], found.center_in_world_m[i]) for i, row in enumerate(sights.row.tolist())
    }
    whole.cameras = found.cameras
    for row in sights.row.tolist():
        why_not.pop(row, None)
    return found, sights.row, part


def _sights(job: Job, model: pycolmap.Reconstruction, row_of: dict[int, int], out: set[int]) -> Sights:
    """Return what the pictures of a model see, without those that are out."""
    images = sorted((row_of[each], each) for each in model.reg_image_ids() if row_of[each] not in out)
    number_of: dict[int, int] = {}
    image, point, pixel = [], [], []
    for i, (_, image_id) in enumerate(images):
        for feature in model.image(image_id).points2D:
            if feature.has_point3D():
                image.append(i)
                point.append(number_of.setdefault(feature.point3D_id, len(number_of)))
                pixel.append(feature.xy)
    of_image, of_point = np.array(image, dtype=np.int64), np.array(point, dtype=np.int64)
    fine = confirmed(of_image, of_point)
    rows = np.array([row for row, _ in images], dtype=np.int64)
    poses = [model.image(image_id) for _, image_id in images]
    rotation = np.array([each.cam_from_world().rotation.matrix() for each in poses]).reshape(-1, 3, 3)
    kept, of_point = np.unique(of_point[fine], return_inverse=True)
    xyz = np.array([model.point3D(point_id).xyz for point_id in number_of]).reshape(-1, 3)
    return Sights(
        row=rows,
        cam_from_world=rotation,
        center_in_world_m=np.array([each.projection_center() for each in poses]).reshape(-1, 3),
        camera_id=np.array([each.camera_id for each in poses], dtype=np.int64),
        cameras=dict(sorted(model.cameras.items())),
        has_focal={number + 1: known for number, known in enumerate(job.has_focal)},
        gps_in_world_m=job.gps_in_world_m()[rows],
        sigma_m=job.sigma_m()[rows],
        drive=job.drives()[rows],
        image=of_image[fine],
        point=of_point,
        pixel=np.array(pixel, dtype=np.float64).reshape(-1, 2)[fine],
        point_in_world_m=xyz[kept],
    )


def confirmed(image: Ints, point: Ints) -> Bools:
    """Return which sights (M) of points in images to keep.

    A point that one picture alone sees, when others are out, says nothing. One that two see may be two windows alike,
    and no third tells. It counts only where its two pictures share few others.
    """
    count = np.bincount(point)
    fine: Bools = np.asarray(count[point] > 2)
    shape = (image.max(initial=-1) + 1, len(count))
    seen = csr_matrix((np.ones(int(fine.sum())), (image[fine], point[fine])), shape=shape)
    shared = (seen @ seen.T).tocsr()
    two = np.flatnonzero(count[point] == 2)
    both = two[np.argsort(point[two], kind="stable")].reshape(-1, 2)
    if len(both):
        poor = np.asarray(shared[image[both[:, 0]], image[both[:, 1]]]).reshape(-1) < _FEW_POINTS
        fine[both[poor]] = True
    return fine


def _parts(sights: Sights) -> Ints:
    """Return which pictures (N) hang together by points that pairs of them share."""
    shape = (len(sights.row), len(sights.point_in_world_m))
    seen = csr_matrix((np.ones(len(sights.image)), (sights.image, sights.point)), shape=shape)
    shared = seen @ seen.T
    shared.data[shared.data < _SHARED_POINTS] = 0.0
    shared.eliminate_zeros()
    part: Ints = connected_components(shared, directed=False)[1].astype(np.int64)
    return part


def _camera(camera: pycolmap.Camera) -> Camera:
    params = tuple(float(value) for value in camera.params)
    return Camera(camera.model.name, int(camera.width), int(camera.height), params)
