"""The method on one screen: a dataset in, a map out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.cameras import Rays, camera_centers, cast_rays, directions_down
from valuemap.config import MapConfig, bounded_threads
from valuemap.dataset import Dataset, Frame, ensure_checked, read_dataset, write_dataset
from valuemap.describe import describe_labels
from valuemap.engine.engine import Engine
from valuemap.engine.threads import ThreadEngine
from valuemap.errors import InputError
from valuemap.map_folder import Map
from valuemap.merge import merge_clusters
from valuemap.notes import Findings, cameras_not_upright, find_notes, heights_not_measured
from valuemap.partition import partition_images
from valuemap.portions import rows_on_disk
from valuemap.progress import Progress, silent
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
from valuemap.rejected import rejected_of_map
from valuemap.remote import Place, UrlPath
from valuemap.robust import Calibration, Noise, calibration_to_json
from valuemap.system import peak_memory_mb
from valuemap.tables import Labels, Votes, covariance_columns
from valuemap.tiles.calibration import calibrate
from valuemap.tiles.compare import compare_poses
from valuemap.tiles.mapping import solve_cells
from valuemap.tiles.partition import partition_dataset
from valuemap.tiles.seams import join_cells
from valuemap.tiles.source import InMemory, Source
from valuemap.tiles.work import CELLS
from valuemap.vote import vote_in_clusters

LARGEST_IN_MEMORY = 2_000_000
"""Datasets with more images and detections are cut into pieces on disk: about 2 GB."""
MOST_CORRECTED = 300_000
"""Poses are looked at in datasets of no more images and detections: a minute or two."""
_TOO_LARGE = "large dataset: poses were taken as they are"
_NOTE_ON_SIZE = (
    "the dataset is larger than what poses are looked at of: they were taken as they are (map a part of it to learn "
    "what whole drives are off by; correct_poses=0 says that this is known)"
)
_MAPS_OF_IMAGES = 5
"""Maps that tell errors of images, at most, before the one that stays."""
_SETTLED = 0.1
"""Images that move by less than this share of what they are off by have settled: they add a hundredth to its square."""
CORRECTED = "corrected"
"""Where in the folder of work a dataset is kept whose poses were corrected."""


def build_map(
    dataset: Dataset, config: MapConfig | None = None, *, threads: int = 0, progress: Progress = silent
) -> Map:
    """Find the objects that the detections of a dataset show.

    Parameters
    ----------
    dataset
        Posed images and detections.
    config
        Settings; the defaults where not given.
    threads
        Threads to work on, 0 for one a core. The result does not depend on it.
    progress
        Called as progress(what, done, total).

    Raises
    ------
    InputError
        The dataset has no detections, or was made by hand and is not what `read_dataset` would accept.
    SettingError
        `threads` is no number of threads.

    Returns
    -------
    Map
        Labels ordered by their first detection, votes, rejected hypotheses, and the record of the run.
    """
    config, threads = config or MapConfig(), bounded_threads(threads)
    _check_detections(dataset.name, len(dataset.detections))
    dataset = ensure_checked(dataset)
    stages = _Stages()
    refined = None
    if config.method == "paper":
        labels, votes, counts = _paper(dataset, config, stages, threads, progress)
    else:
        refined = _refined(dataset, config, stages, threads, progress)
        with stages.measured("order"):
            source = InMemory(refined.dataset, config)
        labels, votes, counts, _ = _robust(source, config, stages, ThreadEngine(threads), progress, refined)
        labels = _with_errors_of_images(refined, labels, votes)
    size = {"images": len(dataset.images), "detections": len(dataset.detections)}
    passes = len(np.unique(dataset.images.pass_id.codes))
    poses = None if refined is None else refined.record
    result = _as_map(dataset.name, dataset.frame, size, passes, config, labels, votes, counts, stages, poses)
    if refined is not None and refined.is_corrected:
        result = replace(result, corrected=refined.dataset)
    result = _with_rejected(result, lambda: result.corrected or dataset, stages)
    return _with_notes(result, _notes_on_input(dataset))


@dataclass(frozen=True)
class Run:
    """How a map of a dataset folder is made: where its parts are kept until it is written, and where they are made.

    `tile_size_m` is how large the units are that the dataset is cut into on disk: None for what is usual, where it is
    larger than memory; it changes no label. `calibration` is that of another map to use, None to estimate it. `known`
    is where the cells of an older map are, which are not solved again where nothing changed. `store` is where the parts
    are that tasks share, None for the folder `work`. Without `keeps_rejected` hypotheses that became no labels are not
    looked for: the map is only a step to another one.
    """

    work: Path
    engine: Engine
    tile_size_m: float | None = None
    calibration: Calibration | None = None
    known: Path | None = None
    store: UrlPath | None = None
    keeps_rejected: bool = True

    @property
    def parts(self) -> Place:
        """Where what tasks read and write is."""
        return self.store or self.work

    def cuts_on_disk(self, rows: int) -> bool:
        """Return whether a dataset of so many images and detections is cut into tiles on disk, from its folder."""
        return self.tile_size_m is not None or self.engine.needs_paths or rows > LARGEST_IN_MEMORY


def build_map_of_folder(
    folder: Path,
    config: MapConfig,
    run: Run,
    *,
    held: Dataset | None = None,
    on_posed: Callable[[Dataset], None] | None = None,
    progress: Progress = silent,
) -> tuple[Map, list[Place]]:
    """Find the objects that a dataset folder shows, which may be larger than memory.

    Parameters
    ----------
    folder
        A dataset.
    config
        Settings.
    run
        Where and how it is made.
    held
        What is in the folder, where it is in memory already: it is not read again, and the folder needs to be there
        only where `run.cuts_on_disk`.
    on_posed
        Called with the dataset that labels are found in, which has the poses that they are found with, before they are;
        not where it is cut on disk.
    progress
        Called as progress(what, done, total).

    Raises
    ------
    InputError, OutputError, SettingError
        As `read_dataset`; the folder of work cannot be written; `tile_size_m` is no size.

    Returns
    -------
    Map
        The map that `build_map` makes of the dataset.
    list[Place]
        The files of its cells; none of a dataset that is no wider than one.
    """
    images, detections = rows_on_disk(folder) if held is None else (len(held.images), len(held.detections))
    stages = _Stages()
    refined: Refined | None = None
    notes: list[str] = []
    threads = run.engine.threads_of_task(1)
    if config.method == "paper" or not run.cuts_on_disk(images + detections):
        dataset = ensure_checked(held or read_dataset(folder))
        if config.method == "paper":
            return build_map(dataset, config, threads=threads, progress=progress), []
        _check_detections(dataset.name, len(dataset.detections))
        refined = _refined(dataset, config, stages, threads, progress)
        if on_posed is not None:
            on_posed(refined.dataset)
        with stages.measured("order"):
            source: Source = InMemory(refined.dataset, config)
        size = {"images": len(dataset.images), "detections": len(dataset.detections)}
        name, frame, notes = dataset.name, dataset.frame, _notes_on_input(dataset)
    else:
        if images + detections <= MOST_CORRECTED and detections:
            refined = _refined(ensure_checked(held or read_dataset(folder)), config, stages, threads, progress)
            if refined.is_corrected:
                folder = run.work / CORRECTED
                write_dataset(refined.dataset, folder)
        with stages.measured("partition"):
            on_disk = partition_dataset(
                folder, run.work, config, store=run.store, tile_size_m=run.tile_size_m, progress=progress
            )
        source, name, frame, size = on_disk, on_disk.name, on_disk.frame, on_disk.counts
        _check_detections(name, size["detections"])
    labels, votes, counts, cells = _robust(source, config, stages, run.engine, progress, refined, run)
    if refined is not None:
        labels = _with_errors_of_images(refined, labels, votes)
    passes = source.drives_record["passes"]
    untouched = _TOO_LARGE if config.poses.correct_poses else "correct_poses is 0"
    poses = {"found": "nothing", "because": untouched} if refined is None else refined.record
    result = _as_map(name, frame, size, passes, config, labels, votes, counts, stages, poses)
    if refined is not None and refined.is_corrected:
        result = replace(result, corrected=refined.dataset)
    if run.keeps_rejected:
        result = _with_rejected(result, lambda: result.corrected or held or read_dataset(folder), stages)
    return _with_notes(result, notes), cells


def _refined(dataset: Dataset, config: MapConfig, stages: _Stages, threads: int, progress: Progress) -> Refined:
    """Give images the poses of the rows of their detections, then correct what poses of drives are proven wrong by."""
    exposed, rows = expose_rows(dataset)
    refined = _proven(exposed, config, stages, threads, progress)
    return replace(refined, record={**refined.record, **rows}, is_corrected=True) if rows else refined


def _proven(dataset: Dataset, config: MapConfig, stages: _Stages, threads: int, progress: Progress) -> Refined:
    """Correct what whole drives' poses are proven wrong by, if that makes the same detections likelier."""
    if len(dataset.images) + len(dataset.detections) > MOST_CORRECTED and config.poses.correct_poses:
        return Refined(dataset, {"found": "nothing", "because": _TOO_LARGE})

    with stages.measured("poses"):
        refined = refine_poses(dataset, config, threads=threads, progress=progress)
        if not refined.is_noisy:
            return _of_drives(dataset, refined, config, threads, progress)
        # Where single images are far off, what whole drives seem to be off by is mostly theirs.
        of_images = _by_images(dataset, config, threads, progress)
        if of_images.is_corrected:
            return of_images
        refined = _of_drives(dataset, refined, config, threads, progress)
        return refined if refined.is_corrected else replace(refined, as_given=of_images.as_given)


def _of_drives(dataset: Dataset, refined: Refined, config: MapConfig, threads: int, progress: Progress) -> Refined:
    """Keep what whole drives were found to be off by if it makes detections likelier, and estimate it with a map."""
    is_proven = refined.is_corrected
    if not is_proven:
        refined = _told_by_a_map(dataset, refined, config, threads, progress)
    if not refined.is_corrected:
        return replace(refined, found=None)
    parameters = refined.record.get("parameters", 0)
    found = compare_poses(dataset, refined.dataset, parameters, config, threads=threads, progress=progress)
    record = {**refined.record, **found.figures()}
    if not found.is_better:
        return Refined(dataset, {**record, "found": "nothing", "because": FITS_NO_BETTER})
    if is_proven:
        refined = _told_by_a_map(dataset, refined, config, threads, progress)
    return replace(refined, record={**record, **refined.record}, found=None)


def _by_images(before: Dataset, config: MapConfig, threads: int, progress: Progress) -> Refined:
    """Correct what single images are probably off by, given a map, where that is proven.

    It is proven with the map of the poses as they were: each half of its objects places the images for the other half.
    """
    engine, moved, images = ThreadEngine(threads), before, gather_images(before, config)
    as_given: Mapped | None = None
    figures: dict[str, float] = {}
    for number in range(_MAPS_OF_IMAGES):
        _, labels, votes, _ = mapped = _map_alone(moved, config, engine, progress)
        as_given = as_given or mapped
        if not len(labels):
            return Refined(before, {}, as_given=as_given)
        noise = as_given[0].noise
        config = _with_sides_of(noise, config)
        told = bundle(images, labels, votes, noise)
        if number == 0:
            is_proven, figures = told.is_proven()
            if not is_proven:
                return Refined(before, {}, as_given=as_given)
        last, moved = moved, replace(before, images=told.images(before.images))
        step_m = camera_centers(moved.images) - camera_centers(last.images)
        if np.sqrt(np.mean(step_m**2)) < _SETTLED * noise.position_m:
            break
    record = {"found": "errors of images", "images": len(before.images), **figures}
    return Refined(moved, record, is_corrected=True, before_images=(images, noise))


def _with_sides_of(noise: Noise, config: MapConfig) -> MapConfig:
    """Return settings with the middles that sides show, which were told before images were moved.

    Where images show one thing each, errors of images explain all that its sides disagree about.
    """
    return replace(config, noise=replace(config.noise, side_sigma_m=noise.side_m))


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


def _with_rejected(result: Map, read: Callable[[], Dataset], stages: _Stages) -> Map:
    """Add the best hypotheses that became no labels; `read` gives the dataset that the labels were found in."""
    with stages.measured("rejected"):
        rejected = rejected_of_map(result, read)
    return replace(result, rejected=rejected, run={**result.run, "stages": stages.records})


def _notes_on_input(dataset: Dataset) -> list[str]:
    cosine_to_sky = -directions_down(dataset.images) @ np.array(dataset.frame.up)
    notes = (cameras_not_upright(cosine_to_sky), heights_not_measured(dataset.detections.vertical_sigma_px))
    return [note for note in notes if note is not None]


def _with_notes(result: Map, notes: list[str]) -> Map:
    is_too_large = result.run.get("poses", {}).get("because") == _TOO_LARGE
    notes = [*notes, *([_NOTE_ON_SIZE] if is_too_large else [])]
    return replace(result, run={**result.run, "notes": [*notes, *result.run["notes"]]}) if notes else result


def _check_detections(name: str, detections: int) -> None:
    if not detections:
        raise InputError(
            f"{name}: there are no detections in it",
            hint="find some with valuemap detect, or import them with the images",
        )


def _as_map(
    name: str,
    frame: Frame,
    size: dict[str, int],
    passes: int,
    config: MapConfig,
    labels: Labels,
    votes: Votes,
    counts: dict[str, Any],
    stages: _Stages,
    poses: dict[str, Any] | None,
) -> Map:
    without = size["detections"] - len(votes)
    counts = {**size, "detections_without_label": without, **counts, "labels": len(labels)}
    notes = find_notes(Findings(passes, config, labels, votes, counts))
    record = {**_record(name, config, counts, stages), "notes": notes}
    return Map(frame, labels, votes, record if poses is None else {**record, "poses": poses})


def _paper(
    dataset: Dataset, config: MapConfig, stages: _Stages, threads: int, progress: Progress
) -> tuple[Labels, Votes, dict[str, Any]]:
    """Algorithm 1 of Dabisias et al., "VALUE", ICRA 2018, in clusters, with merging."""
    with stages.measured("rays"):
        rays = cast_rays(dataset)
    with stages.measured("partition"):
        cluster_of_image = partition_images(dataset.images, config.partition)
    with stages.measured("vote"):
        found, counts = vote_in_clusters(rays, cluster_of_image, config.vote, threads=threads, progress=progress)
    with stages.measured("merge"):
        merged = merge_clusters(rays, found, config.merge)
    with stages.measured("describe"):
        labels, votes = describe_labels(dataset, rays, merged, config.noise)
    clusters = int(cluster_of_image.max()) + 1
    counts = {**_without_ray(rays), "clusters": clusters, **counts, "labels_before_merge": len(found)}
    return labels, votes, counts


def _robust(
    source: Source,
    config: MapConfig,
    stages: _Stages,
    engine: Engine,
    progress: Progress,
    refined: Refined | None,
    run: Run | None = None,
) -> tuple[Labels, Votes, dict[str, Any], list[Place]]:
    """Noise estimated from a sample, and in each cell the map with the least J that is found; docs/method.md.

    A map of the same poses that was made before stays, unless cells are to be kept, or another calibration is given.
    """
    given = None if run is None else run.calibration
    store = run.parts / CELLS if run is not None and len(source.cells) > 1 else None
    files: list[Place] = []
    if refined is not None and refined.before_images is not None:
        config = _with_sides_of(refined.before_images[1], config)
    if refined is not None and refined.as_given is not None and given is None and store is None:
        calibration, labels, votes, counts = refined.as_given
    else:
        with stages.measured("calibrate"):
            calibration = calibrate(source, config, given, None if run is None else run.parts, engine, progress)
        with stages.measured("find"):
            known = None if run is None else run.known
            solved, files = solve_cells(source, calibration, config, engine, progress, store=store, known=known)
        with stages.measured("join"):
            labels, votes, counts = join_cells(solved, source.grid, config)
    estimated = calibration_to_json(calibration)
    counts = {**counts, "drives": source.drives_record, "noise": estimated["noise"], "calibration": estimated}
    return labels, votes, counts, files


def _without_ray(rays: Rays) -> dict[str, int]:
    return {"detections_without_ray": int(np.isnan(rays.direction_in_world[:, 0]).sum())}


class _Stages:
    """Seconds and peak memory of each stage, in the order they ran."""

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []

    @contextmanager
    def measured(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        self.records.append({"stage": stage, "seconds": round(seconds, 3), "peak_memory_mb": peak_memory_mb()})


def _record(name: str, config: MapConfig, counts: dict[str, Any], stages: _Stages) -> dict[str, Any]:
    drives, calibration = counts.pop("drives", None), counts.pop("calibration", None)
    return {
        "valuemap": version("valuemap"),
        "dataset": name,
        "settings": config.as_dict(),
        **({} if drives is None else {"drives": drives}),
        **({} if calibration is None else {"calibration": calibration}),
        "counts": counts,
        "stages": stages.records,
    }
