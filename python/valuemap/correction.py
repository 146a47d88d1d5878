"""Poses of a dataset, corrected where maps prove them wrong."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from valuemap.arrays import Floats
from valuemap.calibration import calibrate, with_sides
from valuemap.cameras import camera_centers
from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.engine.engine import Engine
from valuemap.engine.threads import ThreadEngine
from valuemap.progress import Progress
from valuemap.reach import MOST_LOOKED_AT
from valuemap.refine import (
    FITS_NO_BETTER,
    Mapped,
    Refined,
    bundle,
    expose_rows,
    gather_images,
    keyframes_of,
    noise_left,
    refine_again,
    refine_poses,
)
from valuemap.stages import Stages
from valuemap.tables import Labels, Votes
from valuemap.tables.covariance import covariance_columns
from valuemap.tiles.compare import compare_poses
from valuemap.tiles.mapping import solve_cells
from valuemap.tiles.seams import join_cells
from valuemap.tiles.source import InMemory

TOO_LARGE = "large dataset: poses were taken as they are"
_FREE_WHERE_UNSTATED = 2
"""What is estimated where poses state no errors: how far off their positions and rotations are all in all. Each costs
what the Bayesian information criterion says (Schwarz 1978), where each detection has two coordinates."""
_MAPS_OF_IMAGES = 5
"""Maps that tell errors of images, at most, before the one that stays."""
_SETTLED = 0.1
"""Images that move by less than this share of what they are off by have settled: they add a hundredth to its square."""


def correct_poses(dataset: Dataset, config: MapConfig, stages: Stages, threads: int, progress: Progress) -> Refined:
    """Give images the poses of the rows of their detections, then correct what poses of drives are proven wrong by.

    Errors that poses state are dropped first where the images show others.
    """
    exposed, rows = expose_rows(dataset)
    if len(exposed.images) + len(exposed.detections) > MOST_LOOKED_AT and config.poses.correct_poses:
        refined = Refined(exposed, {"found": "nothing", "because": TOO_LARGE})
    else:
        with stages.measured("poses"):
            believed, of_stated = _believed(exposed, config, threads, progress)
            refined = _proven(exposed, believed, config, threads, progress)
        if of_stated:
            places_m2 = [place_m2 for place_m2 in (refined.place_m2, _stated_place_m2(exposed)) if place_m2 is not None]
            place_m2 = max(places_m2, key=lambda one: float(np.trace(one)), default=None)
            rows, refined = {**of_stated, **rows}, replace(refined, place_m2=place_m2)
    return replace(refined, record={**refined.record, **rows}, is_corrected=True) if rows else refined


def _believed(dataset: Dataset, config: MapConfig, threads: int, progress: Progress) -> tuple[Dataset, dict[str, Any]]:
    """Return a dataset without the errors that its poses state, where that makes detections likelier.

    A receiver states what a whole drive is off by, and images are as much nearer to each other; or software states less
    than is true. What `run.json` says of it is returned beside, nothing where the errors are believed.
    """
    if not config.poses.correct_poses or _unstated(dataset) is dataset:
        return dataset, {}
    unstated = _unstated(dataset)
    price = _FREE_WHERE_UNSTATED * math.log(2 * len(dataset.detections))
    found = compare_poses(dataset, unstated, price, config, threads=threads, progress=progress)
    if not found.is_better:
        return dataset, {}
    return unstated, {"stated_errors": {"found": "not what images are off by", **found.figures()}}


def _unstated(dataset: Dataset) -> Dataset:
    """Return a dataset whose poses state no errors."""
    images = dataset.images
    if images.position_sigma_m is None and images.rotation_sigma_rad is None:
        return dataset
    return replace(dataset, images=images.replace(position_sigma_m=None, rotation_sigma_rad=None))


def _stated_place_m2(dataset: Dataset) -> Floats | None:
    """Return the covariance (3, 3) of where all passes are together, m², by what their poses state; None without."""
    stated_m, of_pass = dataset.images.position_sigma_m, dataset.images.pass_id.codes
    if stated_m is None:
        return None
    of_passes = [stated_m[(of_pass == one) & np.isfinite(stated_m)] for one in np.unique(of_pass)]
    square_m2 = [float(np.median(of_one)) ** 2 for of_one in of_passes if len(of_one)]
    return np.asarray(np.mean(square_m2) / len(square_m2) * np.eye(3)) if square_m2 else None


def _proven(dataset: Dataset, believed: Dataset, config: MapConfig, threads: int, progress: Progress) -> Refined:
    """Correct what whole drives' poses are proven wrong by, if that makes the same detections likelier.

    How much a drive's place counts is as its poses state it; all else is as `believed`.
    """
    refined = refine_poses(dataset, config, threads=threads, progress=progress)
    if believed is not dataset:
        refined = replace(refined, dataset=_unstated(refined.dataset) if refined.is_corrected else believed)
    if not refined.is_noisy:
        return _of_drives(believed, refined, config, threads, progress)
    of_images = _by_images(believed, config, threads, progress)
    of_drives = _of_drives(believed, refined, config, threads, progress)
    if of_images.is_corrected and of_drives.is_corrected:
        return _of_drives_and_images(of_drives, of_images, config, threads, progress)
    if of_images.is_corrected or of_drives.is_corrected:
        return of_images if of_images.is_corrected else of_drives
    return replace(of_drives, as_given=of_images.as_given)


def _of_drives_and_images(
    of_drives: Refined, of_images: Refined, config: MapConfig, threads: int, progress: Progress
) -> Refined:
    """Correct single images after whole drives, if that makes detections likelier than single images alone do.

    Where single images are far off, what whole drives seem to be off by is mostly theirs, and what focal lengths seem
    to be off by is: images that are beside where they should be make all things seem nearer (errors in variables).
    """
    if any("focal_length_factor" in camera for camera in of_drives.record.get("cameras", [])):
        return of_images
    both = _by_images(of_drives.dataset, config, threads, progress)
    if not both.is_corrected:
        return of_drives
    found = compare_poses(of_images.dataset, both.dataset, of_drives.price, config, threads=threads, progress=progress)
    if not found.is_better:
        return of_images
    record = {**of_drives.record, "errors_of_images": {**both.record, **found.figures()}}
    return replace(both, record=record, place_m2=of_drives.place_m2)


def _of_drives(dataset: Dataset, refined: Refined, config: MapConfig, threads: int, progress: Progress) -> Refined:
    """Keep what whole drives were found to be off by if it makes detections likelier, and estimate it with a map."""
    is_proven = refined.is_corrected
    if not is_proven:
        refined = _told_by_a_map(dataset, refined, config, threads, progress)
    if not refined.is_corrected:
        return replace(refined, found=None)
    found = compare_poses(dataset, refined.dataset, refined.price, config, threads=threads, progress=progress)
    record = {**refined.record, **found.figures()}
    if not found.is_better:
        return Refined(dataset, {**record, "found": "nothing", "because": FITS_NO_BETTER}, sought=found.sought)
    if is_proven:
        refined = _told_by_a_map(dataset, refined, config, threads, progress)
    return replace(refined, record={**record, **refined.record}, found=None)


def _by_images(before: Dataset, config: MapConfig, threads: int, progress: Progress) -> Refined:
    """Correct what single images are probably off by, given a map, where that is proven.

    It is proven with the map of the poses as they were: each half of its objects places the images for the other half.
    """
    engine, images = ThreadEngine(threads), gather_images(before, config)
    as_given = _map_alone(before, config, engine, progress)
    calibration, labels, votes, _ = as_given
    uncorrected = Refined(before, {}, as_given=as_given)
    if not len(labels):
        return uncorrected
    noise, moved = calibration.noise, before
    # Where images show one thing each, errors of images explain all that its sides disagree about.
    config = with_sides(noise.side_m, config)
    told = bundle(images, labels, votes, noise)
    is_proven, figures = told.is_proven()
    if not is_proven:
        return uncorrected
    for maps in range(1, _MAPS_OF_IMAGES + 1):
        last, moved = moved, replace(before, images=told.images(before.images))
        step_m = camera_centers(moved.images) - camera_centers(last.images)
        if np.sqrt(np.mean(step_m**2)) < _SETTLED * noise.position_m or maps == _MAPS_OF_IMAGES:
            break
        _, labels, votes, _ = _map_alone(moved, config, engine, progress)
        if not len(labels):
            return uncorrected
        told = bundle(images, labels, votes, noise)
    record = {"found": "errors of images", "images": len(before.images), **figures}
    # Middles in doubt move no image; covariances reckon with them, as those of a map of images that stay do.
    of_covariances = replace(noise, side_m=calibration.noise_of_covariances.side_m)
    return Refined(moved, record, is_corrected=True, before_images=(images, of_covariances), side_m=noise.side_m)


def with_errors_of_poses(refined: Refined, labels: Labels, votes: Votes) -> Labels:
    """Return labels with covariances that know of what poses are still off by, where they were corrected."""
    return _with_place_of_drives(refined, _with_errors_of_images(refined, labels, votes))


def _with_errors_of_images(refined: Refined, labels: Labels, votes: Votes) -> Labels:
    """Return labels with covariances that know of errors of images, where these were corrected.

    What is left of residuals once images are moved does not say how well they were.
    """
    if refined.before_images is None or not len(labels):
        return labels
    images, noise = refined.before_images
    told = bundle(images, labels, votes, noise)
    columns = labels.covariance_m2.copy()
    row, covariance_m2 = told.covariances()
    columns[row] = covariance_columns(covariance_m2)
    return labels.replace(covariance_m2=columns)


def _with_place_of_drives(refined: Refined, labels: Labels) -> Labels:
    """Return labels whose absolute covariances know of the place of all drives together, where these were moved.

    Drives that were brought together agree, and are off together.
    """
    if refined.place_m2 is None:
        return labels
    return labels.replace(absolute_covariance_m2=labels.covariance_m2 + covariance_columns(refined.place_m2[None]))


def _told_by_a_map(dataset: Dataset, refined: Refined, config: MapConfig, threads: int, progress: Progress) -> Refined:
    """Estimate once more what poses are wrong by, where anything was found: a map knows better what is one object."""
    if refined.found is None:
        return refined
    labels, votes = _map_of_keyframes(dataset, refined, config, ThreadEngine(threads), progress)
    return refine_again(dataset, refined, labels, votes, config, progress=progress)


def _map_of_keyframes(
    dataset: Dataset, refined: Refined, config: MapConfig, engine: Engine, progress: Progress
) -> tuple[Labels, Votes]:
    """Return a map that says which detection shows which object, and no more.

    It is of the images that poses are estimated with. Its noise is what was left there, and not sought.
    """
    config = replace(config, noise=noise_left(refined, config))
    _, labels, votes, _ = _map_alone(keyframes_of(dataset, refined, config), config, engine, progress)
    return labels, votes


def _map_alone(dataset: Dataset, config: MapConfig, engine: Engine, progress: Progress) -> Mapped:
    """Return the map of a dataset in memory, and keep nothing."""
    source = InMemory(dataset, config)
    calibration = calibrate(source, config, None, None, engine, progress)
    cells, _ = solve_cells(source, calibration, config, engine, progress)
    return calibration, *join_cells(cells, source.grid, config)
