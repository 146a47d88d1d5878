"""The simulation from end to end: a city, drives through it, what the detector reports, what is recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset, Frame
from valuemap.errors import SettingError
from valuemap.progress import Progress, silent
from valuemap.simulate.city import City, build_city
from valuemap.simulate.detector import KINDS, TRUE_KINDS, Boxes, detect, hidden_by_traffic, recall_of_passes
from valuemap.simulate.drives import KEEP_RANGE, Frames, drive, mount_cameras
from valuemap.simulate.false_objects import clutter, place_temporary, reflect
from valuemap.simulate.pose_errors import pose_errors
from valuemap.simulate.rows import join_rows
from valuemap.simulate.sightings import Look, Sightings, see
from valuemap.simulate.streams import random_stream
from valuemap.simulate.targets import CLASSES, classes_in
from valuemap.tables import Cameras, Categories, Detections, Images, Truth, TruthDetections

_KEEP_STEP_M = 0.5


@dataclass(frozen=True, eq=False)
class Recording:
    """What was recorded, and what it was recorded of.

    Row i of `frames`, the true exposures, is row i of `dataset.images`, which holds their poses with errors.
    `sightings` are the true views of lights, of which traffic hides those in `is_hidden` (N). Row i of `boxes` says
    what row i of `dataset.detections` shows.
    """

    config: SimulationConfig
    seed: int
    city: City
    frames: Frames
    sightings: Sightings
    is_hidden: Bools
    boxes: Boxes
    dataset: Dataset


def simulate(config: SimulationConfig, *, seed: int, name: str = "simulated", progress: Progress = silent) -> Dataset:
    """Return the dataset of `record_city`, which has the parameters and the errors."""
    return record_city(config, seed=seed, name=name, progress=progress).dataset


def record_city(
    config: SimulationConfig, *, seed: int, name: str = "simulated", progress: Progress = silent
) -> Recording:
    """Simulate a city and a fleet's recordings of it, with truth.

    Parameters
    ----------
    config
        The city, the drives, the camera, the detector and all errors.
    seed
        At least 0. The same seed and settings give the same dataset, bit for bit. Each noise has random numbers
        of its own, so that changing one leaves the others as they were.
    name
        The dataset's name.
    progress
        Called as work goes on.

    Returns
    -------
    Recording
        Its dataset is in a local frame, x east, y north, z up, in metres. Poses are as recorded, with their
        errors; truth is without. Detections that show no light are not in `truth_detections`.

    Raises
    ------
    SettingError
        A negative seed, a number of lights or detections that the other settings cannot give, or no detection.
    """
    if seed < 0:
        raise SettingError(f"seed: expected at least 0, found {seed}", hint="for example --seed 1")
    if config.districts > 1:
        raise SettingError(
            f"districts ({config.districts}): only one can be held at a time",
            hint="valuemap simulate, and simulate_districts in Python, make them one after the other",
        )
    city = build_city(config, seed=seed)
    exposures = drive(city, config, seed=seed, progress=progress)
    return record_drives(city, exposures, config, seed=seed, name=name, progress=progress)


def record_drives(
    city: City,
    exposures: Frames,
    config: SimulationConfig,
    *,
    seed: int,
    name: str = "simulated",
    progress: Progress = silent,
    look: Look = see,
) -> Recording:
    """Record drives through a city, both of which may come from elsewhere, such as from a real map.

    Parameters
    ----------
    city
        What stands there. Of its streets only the hills and the houses that hide things are used.
    exposures
        The true exposures of cameras that look ahead.
    config, seed, name, progress
        As of `record_city`; what they say of the city and of its drives is not used.
    look
        What a camera sees. The dataset's cameras are pinholes: with another `look` they have to be exchanged.

    Raises
    ------
    SettingError
        A number of detections that the other settings cannot give, or no detection.
    """
    errors = pose_errors(exposures, config, seed=seed)
    frames = mount_cameras(exposures, config)
    sightings = look(city.lights, frames, city.streets, config, progress=progress, what="seeing lights")
    boxes = _detect_everything(city, sightings, frames, config, look, seed=seed, progress=progress)
    is_hidden = hidden_by_traffic(sightings, frames, config, seed=seed, kind="lights")
    kept = _kept_frames(frames, boxes, config)
    if config.shuffle_ids:
        kept = random_stream(seed, "shuffle", "images").permutation(kept)
        boxes = boxes.take(random_stream(seed, "shuffle", "detections").permutation(len(boxes)))
    new_row = np.full(len(frames), -1)
    new_row[kept] = np.arange(len(kept))
    frames = frames.take(kept)
    boxes = boxes.replace(frame_row=new_row[boxes.frame_row])
    boxes = boxes.take(boxes.frame_row >= 0)
    if len(boxes) == 0:
        raise SettingError("nothing at all is detected in this city", hint="raise recall_mean, or drive more")
    sightings = sightings.replace(frame_row=new_row[sightings.frame_row])
    in_order = np.lexsort((sightings.target_row, sightings.frame_row))
    in_order = in_order[sightings.frame_row[in_order] >= 0]
    dataset = _dataset(name, city, frames, boxes, _recorded_poses(frames, *errors, config), config, seed=seed)
    return Recording(
        config=config,
        seed=seed,
        city=city,
        frames=frames,
        sightings=sightings.take(in_order),
        is_hidden=is_hidden[in_order],
        boxes=boxes,
        dataset=dataset,
    )


def _dataset(
    name: str,
    city: City,
    frames: Frames,
    boxes: Boxes,
    poses: tuple[Rotation, Floats],
    config: SimulationConfig,
    *,
    seed: int,
) -> Dataset:
    shows_object = np.isin(boxes.kind, [KINDS.index(kind) for kind in TRUE_KINDS])
    is_of_roadside = boxes.kind == KINDS.index("roadside")
    object_row = boxes.thing_row + np.where(is_of_roadside, len(city.lights), 0)
    return Dataset(
        name=name,
        frame=Frame(),
        cameras=_cameras(config),
        images=_images(frames, poses, config, seed=seed),
        detections=Detections(
            detection_id=np.arange(len(boxes)),
            image_id=boxes.frame_row,
            class_name=_classes(boxes.class_code, config),
            center_px=boxes.center_px,
            size_px=boxes.size_px,
            score=boxes.score,
        ),
        truth=Truth(
            object_id=np.arange(len(city.objects)),
            class_name=_classes(city.objects.class_code, config),
            position_in_world_m=city.objects.position_in_world_m,
        ),
        truth_detections=TruthDetections(detection_id=np.flatnonzero(shows_object), object_id=object_row[shows_object]),
    )


def _detect_everything(
    city: City,
    of_lights: Sightings,
    frames: Frames,
    config: SimulationConfig,
    look: Look,
    *,
    seed: int,
    progress: Progress,
) -> Boxes:
    """Return all boxes, by frame and in it from left to right, so that their order tells nothing."""
    recall = recall_of_passes(int(frames.pass_row[-1]) + 1, config, seed=seed)
    kinds = {
        "roadside": city.roadside,
        "lookalikes": city.lookalikes,
        "temporary": place_temporary(frames, city.streets, config, seed=seed),
    }
    parts = [
        reflect(frames, config, seed=seed),
        clutter(frames, config, seed=seed),
        detect(of_lights, city.lights, frames, recall, config, seed=seed, kind="lights"),
    ]
    for kind, targets in kinds.items():
        if len(targets) == 0:
            continue
        seen = look(targets, frames, city.streets, config, progress=progress, what=f"seeing {kind}")
        parts.append(detect(seen, targets, frames, recall, config, seed=seed, kind=kind))
    boxes = join_rows(parts)
    return boxes.take(np.lexsort((boxes.center_px[:, 1], boxes.center_px[:, 0], boxes.frame_row)))


def _kept_frames(frames: Frames, boxes: Boxes, config: SimulationConfig) -> Ints:
    """Return the rows of the images that stay: those near enough to lights ahead, up to the number asked for.

    Where a number of detections is aimed at, how near is near is chosen to come closest to it: farther images
    show fewer lights.
    """
    limit = config.images or len(frames)
    if config.detections == 0:
        return np.flatnonzero(frames.signal_ahead_m <= config.keep_before_signal_m)[:limit]
    in_frame = np.bincount(boxes.frame_row, minlength=len(frames))
    low, high = (config.keep_before_signal_m * bend for bend in KEEP_RANGE)
    choices = [np.flatnonzero(frames.signal_ahead_m <= keep_m)[:limit] for keep_m in np.arange(low, high, _KEEP_STEP_M)]
    totals = np.array([int(in_frame[rows].sum()) for rows in choices])
    best = int(np.argmin(np.abs(totals - config.detections)))
    if abs(totals[best] - config.detections) > 0.02 * config.detections:
        raise SettingError(
            f"detections ({config.detections}): the other settings give {totals.min()} to {totals.max()}",
            hint="change keep_before_signal_m, lights_per_approach or recall_mean, or set detections=0",
        )
    return choices[best]


def _cameras(config: SimulationConfig) -> Cameras:
    center_px = config.image_width_px / 2.0, config.image_height_px / 2.0
    focal_px = config.focal_px * (1.0 + config.focal_error_share)
    return Cameras(
        camera_id=np.arange(config.cameras),
        model=Categories.from_texts(["PINHOLE"] * config.cameras),
        width_px=np.full(config.cameras, config.image_width_px),
        height_px=np.full(config.cameras, config.image_height_px),
        params=[np.array([focal_px, focal_px, *center_px])] * config.cameras,
        readout_s=np.full(config.cameras, config.readout_s) if config.readout_s else None,
    )


def _recorded_poses(
    frames: Frames, position_error_m: Floats, rotation_error_rad: Floats, config: SimulationConfig
) -> tuple[Rotation, Floats]:
    """Return the rotations from the world (N) and the centres (N, 3) that are recorded, from the errors of exposures.

    The rotation error is that of a camera that looks ahead; others of the same car are turned with it.
    """
    center_m = frames.center_in_world_m + position_error_m[frames.exposure_row]
    true_rotation = Rotation.from_matrix(frames.cam_from_world())
    turn_rad = rotation_error_rad[frames.exposure_row]
    if config.cameras > 1:
        aside_rad = np.radians(config.camera_spread_deg) * ((config.cameras - 1) / 2.0 - frames.camera_row)
        ahead = frames.replace(heading_rad=frames.heading_rad - aside_rad).cam_from_world()
        turn_rad = true_rotation.apply(np.einsum("nji,nj->ni", ahead, turn_rad))
    if config.pose_delay_s:
        center_m = center_m - frames.late_m
        true_rotation = true_rotation * Rotation.from_rotvec(frames.late_rad[:, None] * [0.0, 0.0, 1.0])
    return Rotation.from_rotvec(turn_rad) * true_rotation, center_m


def _images(frames: Frames, poses: tuple[Rotation, Floats], config: SimulationConfig, *, seed: int) -> Images:
    rotation, center_m = poses
    names, passes = _names_and_passes(frames, config, seed=seed)
    optional: dict[str, Any] = {**_pose_sigmas(len(frames), config)}
    if config.write_timestamps:
        optional["timestamp_s"] = frames.time_s
    if config.write_rigs:
        optional["rig_id"] = np.unique(frames.exposure_row, return_inverse=True)[1]
    return Images(
        image_id=np.arange(len(frames)),
        name=pa.array(names, pa.string()),
        camera_id=frames.camera_row,
        cam_from_world_quat=rotation.as_quat(canonical=True, scalar_first=True),
        cam_from_world_m=-rotation.apply(center_m),
        pass_id=passes,
        **optional,
    )


def _names_and_passes(frames: Frames, config: SimulationConfig, *, seed: int) -> tuple[list[str], Categories]:
    """Return the names of the files (N) and the passes (N)."""
    present, pass_code = np.unique(frames.pass_row, return_inverse=True)
    digits = max(4, len(str(present[-1])))
    pass_names = [f"pass-{row:0{digits}d}" for row in present]
    # Images are numbered in each pass, those that cameras took at one time alike.
    exposure = np.unique(frames.exposure_row, return_inverse=True)[1]
    first = np.full(len(present), len(frames))
    np.minimum.at(first, pass_code, exposure)
    number = exposure - first[pass_code]
    if config.shuffle_names:
        number = random_stream(seed, "shuffle", "names").permutation(int(exposure.max()) + 1)[exposure]
    camera_names = [f"cam-{camera}" for camera in range(config.cameras)]
    folder = "{0}" if config.cameras == 1 else ("{0}/{1}", "{1}/{0}", "{0}-{1}")[config.camera_folders]
    folders = [[folder.format(p, c) for c in camera_names] for p in pass_names]
    names = [
        f"{folders[code][camera]}/{i:06d}.jpg"
        for code, camera, i in zip(pass_code, frames.camera_row, number, strict=True)
    ]
    if config.pass_per_camera:
        pass_names = [f"{p}-{c}" for p in pass_names for c in camera_names]
        pass_code = config.cameras * pass_code + frames.camera_row
    return names, Categories(pass_code.astype(np.int32), tuple(pass_names))


def _pose_sigmas(count: int, config: SimulationConfig) -> dict[str, Any]:
    """Return the optional columns; a sigma of 0 cannot be written, a pose without errors has none."""
    if not config.write_pose_sigmas:
        return {}
    sigmas = {
        "position_sigma_m": np.hypot(
            np.hypot(config.position_white_m, config.position_drift_m), config.position_middle_m
        ),
        "rotation_sigma_rad": np.radians(
            np.hypot(np.hypot(config.rotation_white_deg, config.rotation_drift_deg), config.rotation_middle_deg)
        ),
    }
    return {name: np.full(count, sigma) for name, sigma in sigmas.items() if sigma > 0.0}


def _classes(class_code: Ints, config: SimulationConfig) -> Categories:
    classes = classes_in(config)
    return Categories(np.searchsorted(classes, class_code).astype(np.int32), tuple(CLASSES[code] for code in classes))
