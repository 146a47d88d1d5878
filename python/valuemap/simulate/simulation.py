"""The simulation from end to end: a city, drives through it, what the detector reports, what is recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset, Frame
from valuemap.errors import SettingError
from valuemap.progress import Progress, silent
from valuemap.simulate.city import City, build_city
from valuemap.simulate.detector import KINDS, TRUE_KINDS, Boxes, detect, hidden_by_traffic, recall_of_passes
from valuemap.simulate.drives import KEEP_RANGE, Frames, drive
from valuemap.simulate.false_objects import clutter, place_temporary, reflect
from valuemap.simulate.pose_errors import pose_errors
from valuemap.simulate.rows import join_rows
from valuemap.simulate.sightings import Sightings, see
from valuemap.simulate.targets import CLASSES, classes_in
from valuemap.tables import Bools, Cameras, Categories, Detections, Floats, Images, Ints, Truth, TruthDetections

_CAMERA_ID = 0
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
    city = build_city(config, seed=seed)
    frames = drive(city, config, seed=seed, progress=progress)
    sightings = see(city.lights, frames, city.streets, config, progress=progress, what="seeing lights")
    boxes = _detect_everything(city, sightings, frames, config, seed=seed, progress=progress)
    position_error_m, rotation_error_rad = pose_errors(frames, config, seed=seed)
    kept = _kept_frames(frames, boxes, config)
    boxes = boxes.replace(frame_row=_row_among(kept, boxes.frame_row))
    boxes = boxes.take(boxes.frame_row >= 0)
    if len(boxes) == 0:
        raise SettingError("nothing at all is detected in this city", hint="raise recall_mean, or drive more")
    is_hidden = hidden_by_traffic(sightings, frames, config, seed=seed, kind="lights")
    sighted_in = _row_among(kept, sightings.frame_row)
    frames = frames.take(kept)
    dataset = _dataset(name, city, frames, boxes, position_error_m[kept], rotation_error_rad[kept], config)
    return Recording(
        config=config,
        seed=seed,
        city=city,
        frames=frames,
        sightings=sightings.replace(frame_row=sighted_in).take(sighted_in >= 0),
        is_hidden=is_hidden[sighted_in >= 0],
        boxes=boxes,
        dataset=dataset,
    )


def _dataset(
    name: str,
    city: City,
    frames: Frames,
    boxes: Boxes,
    position_error_m: Floats,
    rotation_error_rad: Floats,
    config: SimulationConfig,
) -> Dataset:
    shows_object = np.isin(boxes.kind, [KINDS.index(kind) for kind in TRUE_KINDS])
    is_of_roadside = boxes.kind == KINDS.index("roadside")
    object_row = boxes.thing_row + np.where(is_of_roadside, len(city.lights), 0)
    return Dataset(
        name=name,
        frame=Frame(),
        cameras=_cameras(config),
        images=_images(frames, position_error_m, rotation_error_rad, config),
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
    city: City, of_lights: Sightings, frames: Frames, config: SimulationConfig, *, seed: int, progress: Progress
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
        seen = see(targets, frames, city.streets, config, progress=progress, what=f"seeing {kind}")
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


def _row_among(kept: Ints, frame_row: Ints) -> Ints:
    """Return rows (N) numbered among the kept ones, -1 for those that are not kept."""
    row = np.minimum(np.searchsorted(kept, frame_row), len(kept) - 1)
    return np.where(kept[row] == frame_row, row, -1)


def _cameras(config: SimulationConfig) -> Cameras:
    center_px = config.image_width_px / 2.0, config.image_height_px / 2.0
    return Cameras(
        camera_id=np.array([_CAMERA_ID]),
        model=Categories.from_texts(["PINHOLE"]),
        width_px=np.array([config.image_width_px]),
        height_px=np.array([config.image_height_px]),
        params=[np.array([config.focal_px, config.focal_px, *center_px])],
    )


def _images(frames: Frames, position_error_m: Floats, rotation_error_rad: Floats, config: SimulationConfig) -> Images:
    rotation = Rotation.from_rotvec(rotation_error_rad) * Rotation.from_matrix(frames.cam_from_world())
    present, pass_code = np.unique(frames.pass_row, return_inverse=True)
    digits = max(4, len(str(present[-1])))
    pass_names = tuple(f"pass-{row:0{digits}d}" for row in present)
    number = np.arange(len(frames)) - np.searchsorted(pass_code, pass_code)
    names = [f"{pass_names[code]}/{i:06d}.jpg" for code, i in zip(pass_code, number, strict=True)]
    return Images(
        image_id=np.arange(len(frames)),
        name=pa.array(names, pa.string()),
        camera_id=np.full(len(frames), _CAMERA_ID),
        cam_from_world_quat=rotation.as_quat(canonical=True, scalar_first=True),
        cam_from_world_m=-rotation.apply(frames.center_in_world_m + position_error_m),
        pass_id=Categories(pass_code.astype(np.int32), pass_names),
        timestamp_s=frames.time_s,
        **_pose_sigmas(len(frames), config),
    )


def _pose_sigmas(count: int, config: SimulationConfig) -> dict[str, Any]:
    """Return the optional columns; a sigma of 0 cannot be written, a pose without errors has none."""
    if not config.write_pose_sigmas:
        return {}
    sigmas = {
        "position_sigma_m": np.hypot(config.position_white_m, config.position_drift_m),
        "rotation_sigma_rad": np.radians(np.hypot(config.rotation_white_deg, config.rotation_drift_deg)),
    }
    return {name: np.full(count, sigma) for name, sigma in sigmas.items() if sigma > 0.0}


def _classes(class_code: Ints, config: SimulationConfig) -> Categories:
    classes = classes_in(config)
    return Categories(np.searchsorted(classes, class_code).astype(np.int32), tuple(CLASSES[code] for code in classes))
