"""Features of every picture, in the database, with the GPS as priors of positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from valuemap.colmap import pycolmap
from valuemap.progress import Progress
from valuemap.readers.structure.job import DATABASE, LINKS, Job

_CHUNK_PICTURES = 8
_MAX_FEATURES = 4096
_LARGEST_PX = 2000
_HEIGHT_SHARE = 2.0
"""A GPS is about twice as wrong in height as on each axis of the ground."""


def find_features(job: Job, workspace: Path, *, threads: int, progress: Progress) -> None:
    """Find what is not in the database yet, a few pictures at a time."""
    path = workspace / DATABASE
    with pycolmap.Database.open(path) as database:
        if database.num_cameras() == 0:
            _write_cameras_and_images(job, database)
    known = {job.alias(row) for row in image_ids(job, workspace)}
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu, options.max_image_size = threads, False, _LARGEST_PX
    options.sift.max_num_features = _MAX_FEATURES
    done = 0
    for number in range(len(job.cameras)):
        rows = [row for row, picture in enumerate(job.pictures) if picture.camera == number]
        missing = [name for row in rows if (name := job.alias(row)) not in known]
        done += len(rows) - len(missing)
        reader = pycolmap.ImageReaderOptions()
        reader.existing_camera_id = number + 1
        for start in range(0, len(missing), _CHUNK_PICTURES):
            progress("finding features", done, len(job.pictures))
            chunk = missing[start : start + _CHUNK_PICTURES]
            pycolmap.extract_features(
                path,
                workspace / LINKS,
                image_names=chunk,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(chunk)
    progress("finding features", len(job.pictures), len(job.pictures))
    with pycolmap.Database.open(path) as database:
        database.clear_pose_priors()
        for image in database.read_all_images():
            picture = job.pictures[image.image_id - 1]
            if database.exists_keypoints(image.image_id) and np.isfinite(picture.gps_in_world_m).all():
                prior = pycolmap.PosePrior()
                prior.corr_data_id = image.data_id
                prior.position = picture.gps_in_world_m
                prior.position_covariance = picture.sigma_m**2 * np.diag([1.0, 1.0, _HEIGHT_SHARE**2])
                prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
                database.write_pose_prior(prior)


def _write_cameras_and_images(job: Job, database: pycolmap.Database) -> None:
    """Give every picture its id before pycolmap does.

    It would number them in the order in which threads are done with them, and models grow in the order of the ids.
    """
    for number, (camera, has_focal) in enumerate(zip(job.cameras, job.has_focal, strict=True), start=1):
        made = pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=list(camera.params))
        made.camera_id, made.has_prior_focal_length = number, has_focal
        database.write_camera(made, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(made.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for row, picture in enumerate(job.pictures):
        image = pycolmap.Image(name=job.alias(row), camera_id=picture.camera + 1, image_id=row + 1)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(frame_id=row + 1, rig_id=picture.camera + 1)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)


def image_ids(job: Job, workspace: Path) -> dict[int, int]:
    """Return the ids of the images with features in the database, by row; pictures that cannot be read have none."""
    with pycolmap.Database.open(workspace / DATABASE) as database:
        return {row: row + 1 for row in range(len(job.pictures)) if database.exists_keypoints(row + 1)}
