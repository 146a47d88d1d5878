"""What is estimated once of a dataset, before any cell is solved; kept in the folder of work."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from valuemap.config import MapConfig
from valuemap.describe import describe_labels
from valuemap.drives import InOrder
from valuemap.engine.engine import Engine
from valuemap.errors import InputError
from valuemap.map_folder import CALIBRATION, read_json
from valuemap.progress import Progress
from valuemap.refine import images_in_order, middles
from valuemap.remote import Place
from valuemap.robust import Calibration, Noise, Scene, calibration_from_json, calibration_to_json
from valuemap.robust import calibrate as calibrate_scene
from valuemap.sightings import cast_sightings
from valuemap.tables.candidates import Candidates
from valuemap.tiles.fingerprint import Fingerprints
from valuemap.tiles.grid import WHOLE
from valuemap.tiles.sample import SAMPLE_DETECTIONS
from valuemap.tiles.source import Source
from valuemap.tiles.store import hash_settings
from valuemap.tiles.work import put


def calibrate(
    source: Source,
    config: MapConfig,
    given: Calibration | None,
    work: Place | None,
    engine: Engine,
    progress: Progress,
    sought: Noise | None = None,
) -> Calibration:
    """Return the calibration that is given, or kept in the folder of work, or else estimated on the sample.

    `sought` is the noise that was found when these poses were compared with others.
    """
    if given is not None:
        return given
    sample = source.sample()
    is_part = source.cells != [WHOLE] and len(sample.detection_id) >= SAMPLE_DETECTIONS
    if work is None:
        return _estimated(sample, is_part, sought, config, engine, progress)
    rows, settings = np.arange(len(sample.image_id)), hash_settings(source.grid, None, config)
    file = work / f"calibration.{Fingerprints(sample).of(rows, WHOLE, settings)}.json"
    if not file.is_file():
        calibration = _estimated(sample, is_part, sought, config, engine, progress)
        put(file, json.dumps(calibration_to_json(calibration)).encode())
    return calibration_from_json(json.loads(file.read_bytes()), source=str(file))


def read_calibration(path: Path) -> Calibration:
    """Read what was estimated of the dataset of a map; raises `InputError` where there is nothing."""
    file = path / CALIBRATION
    if not file.is_file():
        raise InputError(
            f"{path}: there is no {CALIBRATION} in it",
            hint="give a map that this version of valuemap made by the method robust",
        )
    return calibration_from_json(read_json(file), source=str(file))


def with_sides(side_m: float, config: MapConfig) -> MapConfig:
    """Return settings with what the middles that sides show are off by, m, each axis."""
    return replace(config, noise=replace(config.noise, side_sigma_m=side_m))


def _estimated(
    sample: InOrder,
    is_part: bool,
    sought: Noise | None,
    config: MapConfig,
    engine: Engine,
    progress: Progress,
) -> Calibration:
    """Estimate all but middles that sides show, which all objects tell together, and all again with these if any."""
    scene = Scene(sample.dataset, sample.drives, cast_sightings(sample.dataset)[0], config.vote.unit_m)

    def estimated(config: MapConfig, sought: Noise | None) -> tuple[Calibration, Candidates]:
        threads = engine.threads_of_task(1)
        return calibrate_scene(scene, config, is_part=is_part, sought=sought, threads=threads, progress=progress)

    if config.noise.side_sigma_m is not None:
        return estimated(config, sought)[0]
    calibration, found = estimated(with_sides(0.0, config), sought)
    labels, votes = describe_labels(sample.dataset, scene.rays, found, config.noise)
    votes = replace(votes, detection_id=sample.detection_id[votes.detection_id])
    told = middles(images_in_order(sample, config), labels, votes, calibration.noise)
    if told is None:
        return calibration
    if told.is_certain:
        return estimated(with_sides(told.off_m, config), calibration.noise)[0]
    # Who votes for what stays; how well it is known had better not rest on a doubt.
    return replace(calibration, noise_of_covariances=replace(calibration.noise_of_covariances, side_m=told.off_m))
