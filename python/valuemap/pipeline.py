"""The method on one screen: a dataset in, a map out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.anchor import heights_not_given
from valuemap.calibration import calibrate, with_sides
from valuemap.cameras import Rays, camera_centers, cast_rays, directions_down
from valuemap.config import MapConfig
from valuemap.correction import TOO_LARGE, correct_poses, with_errors_of_poses
from valuemap.dataset import Dataset, Frame, ensure_checked, read_dataset, write_dataset
from valuemap.describe import describe_labels
from valuemap.engine.engine import Engine
from valuemap.engine.threads import ThreadEngine
from valuemap.errors import InputError, SettingError, check_kind
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import Map
from valuemap.notes import Findings, cameras_not_upright, find_notes, heights_not_measured
from valuemap.paper.merge import merge_clusters
from valuemap.paper.partition import partition_images
from valuemap.paper.vote import vote_in_clusters
from valuemap.portions import fits_into_memory, rows_on_disk
from valuemap.progress import Progress, silent
from valuemap.reach import MOST_LOOKED_AT, with_range, with_usual_range
from valuemap.refine import Refined
from valuemap.rejected import rejected_of_map
from valuemap.remote import Place, UrlPath
from valuemap.robust import Calibration, calibration_to_json
from valuemap.stages import Stages
from valuemap.tables import Cameras, Labels, Votes
from valuemap.tables.read import read_table
from valuemap.tiles.grid import check_tile_size
from valuemap.tiles.mapping import solve_cells
from valuemap.tiles.partition import partition_dataset
from valuemap.tiles.seams import join_cells
from valuemap.tiles.source import InMemory, Source
from valuemap.tiles.work import CELLS

_NOTE_ON_SIZE = (
    "the dataset is larger than what poses are looked at of: they were taken as they are (map a part of it to learn "
    "what whole drives are off by; correct_poses=0 says that this is known)"
)
_NOTE_ON_ROWS = (
    "cameras state a readout time, but poses were taken to be those of all rows, as the dataset is large and cut into "
    "pieces (map a part of it to learn what that moves)"
)
CORRECTED = "corrected"
"""Where in the folder of work a dataset is kept whose poses were corrected."""


def build_map(
    dataset: Dataset | str | Path,
    config: MapConfig | None = None,
    *,
    threads: int = 0,
    progress: Progress = silent,
) -> Map:
    """Find the objects that the detections of a dataset show.

    Parameters
    ----------
    dataset
        Posed images and detections, or their folder.
    config
        Settings; the defaults where not given.
    threads
        Threads to work on, 0 for one a core. The result does not depend on it.
    progress
        Called as progress(what, done, total).

    Raises
    ------
    InputError
        The dataset has no detections, or it is not what `read_dataset` accepts.
    SettingError
        `config` is no `MapConfig`, or `threads` no number of threads.

    Returns
    -------
    Map
        Labels ordered by their first detection, votes, rejected hypotheses, and the record of the run.
    """
    check_kind(
        "dataset",
        dataset,
        (Dataset, str, Path),
        "a Dataset or its folder",
        hint="valuemap import and valuemap simulate write such folders",
    )
    check_kind(
        "config",
        config,
        (MapConfig, type(None)),
        "a MapConfig",
        hint="for example MapConfig(min_votes=3)",
        error=SettingError,
    )
    engine = ThreadEngine(threads)
    if isinstance(dataset, str | Path):
        dataset = read_dataset(dataset)
    _check_detections(dataset.name, len(dataset.detections))
    return _held(ensure_checked(dataset), config or MapConfig(), engine, None, None, progress)[0]


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

    def __post_init__(self) -> None:
        check_tile_size(self.tile_size_m)

    @property
    def parts(self) -> Place:
        """Where what tasks read and write is."""
        return self.store or self.work

    def cuts_on_disk(self, rows: int) -> bool:
        """Return whether a dataset of so many images and detections is cut into tiles on disk, from its folder."""
        return self.tile_size_m is not None or self.engine.needs_paths or not fits_into_memory(rows)


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
    if config.method != "paper" and run.cuts_on_disk(images + detections):
        is_looked_at = 0 < detections <= MOST_LOOKED_AT - images
        looked_at = ensure_checked(held or read_dataset(folder)) if is_looked_at else None
        return _cut(folder, looked_at, config, run, lambda: looked_at or held or read_dataset(folder), progress)
    dataset = ensure_checked(held or read_dataset(folder))
    _check_detections(dataset.name, detections)
    return _held(dataset, config, run.engine, run, on_posed, progress)


def _held(
    dataset: Dataset,
    config: MapConfig,
    engine: Engine,
    run: Run | None,
    on_posed: Callable[[Dataset], None] | None,
    progress: Progress,
) -> tuple[Map, list[Place]]:
    """Map a checked dataset that is in memory whole."""
    given = config
    config, odd_range = with_range(dataset, config)
    stages, threads = Stages(), engine.threads_of_task(1)
    refined: Refined | None = None
    cells: list[Place] = []
    if config.method == "paper":
        labels, votes, counts = _paper(dataset, config, stages, threads, progress)
    else:
        refined = correct_poses(dataset, config, stages, threads, progress)
        if on_posed is not None:
            on_posed(refined.dataset)
        with stages.measured("order"):
            source = InMemory(refined.dataset, config)
        labels, votes, counts, cells = _robust(source, config, stages, engine, progress, refined, run)
    size = {"images": len(dataset.images), "detections": len(dataset.detections)}
    passes = len(np.unique(dataset.images.pass_id.codes))
    poses = None if refined is None else refined.record
    result = _as_map(
        dataset.name, dataset.frame, size, passes, given, config, labels, votes, counts, stages, refined, poses
    )
    if run is None or run.keeps_rejected:
        result = _with_rejected(result, lambda: dataset, stages)
    return _with_notes(result, [*_notes_on_input(dataset, odd_range), *_notes_on_poses(refined)]), cells


def _cut(
    folder: Path,
    dataset: Dataset | None,
    config: MapConfig,
    run: Run,
    read: Callable[[], Dataset],
    progress: Progress,
) -> tuple[Map, list[Place]]:
    """Map a dataset folder that is cut into tiles on disk.

    `dataset` is what is in it where that is small enough for its poses to be looked at, `read` gives it in any case.
    """
    stages, given = Stages(), config
    refined: Refined | None = None
    notes: list[str] = []
    posed = folder
    if dataset is not None:
        config, odd_range = with_range(dataset, config)
        notes = _notes_on_input(dataset, odd_range)
        refined = correct_poses(dataset, config, stages, run.engine.threads_of_task(1), progress)
        if refined.is_corrected:
            posed = run.work / CORRECTED
            write_dataset(refined.dataset, posed)
    config = with_usual_range(config)
    with stages.measured("partition"):
        source = partition_dataset(
            posed, run.work, config, store=run.store, tile_size_m=run.tile_size_m, progress=progress
        )
    size = source.counts
    _check_detections(source.name, size["detections"])
    if refined is None and _has_rolling_shutter(folder):
        notes = [_NOTE_ON_ROWS]
    labels, votes, counts, cells = _robust(source, config, stages, run.engine, progress, refined, run)
    passes = source.drives_record["passes"]
    untouched = TOO_LARGE if config.poses.correct_poses else "correct_poses is 0"
    poses = {"found": "nothing", "because": untouched} if refined is None else refined.record
    result = _as_map(
        source.name, source.frame, size, passes, given, config, labels, votes, counts, stages, refined, poses
    )
    if run.keeps_rejected:
        result = _with_rejected(result, read, stages)
    return _with_notes(result, [*notes, *_notes_on_poses(refined)]), cells


def _with_rejected(result: Map, read: Callable[[], Dataset], stages: Stages) -> Map:
    """Add the best hypotheses that became no labels; `read` gives the dataset as it was, where none is corrected."""
    with stages.measured("rejected"):
        return replace(result, rejected=rejected_of_map(result, lambda: result.corrected or read()))


def _has_rolling_shutter(folder: Path) -> bool:
    """Return whether a camera of a dataset states how long it reads its rows."""
    readout_s = read_table(Cameras, folder / "cameras.parquet").readout_s
    return readout_s is not None and bool(np.nan_to_num(readout_s).any())


def _notes_on_input(dataset: Dataset, odd_range: str | None) -> list[str]:
    cosine_to_sky = -directions_down(dataset.images) @ np.array(dataset.frame.up)
    upright = cameras_not_upright(cosine_to_sky)
    notes = (odd_range, upright, heights_not_measured(dataset.detections.vertical_sigma_px), _note_on_heights(dataset))
    return [note for note in notes if note is not None]


def _notes_on_poses(refined: Refined | None) -> list[str]:
    if refined is None or "stated_errors" not in refined.record:
        return []
    return [
        "images are not off by what their poses state of their errors (position_sigma_m, rotation_sigma_rad): that was "
        "estimated as if they stated nothing; absolute covariances have it (correct_poses=0 takes them as they are)"
    ]


def _note_on_heights(dataset: Dataset) -> str | None:
    anchor = dataset.frame.anchor
    if anchor is None:
        return None
    return heights_not_given(lon_lat_height_from_enu(camera_centers(dataset.images), anchor)[:, 2])


def _with_notes(result: Map, notes: list[str]) -> Map:
    is_too_large = result.run.get("poses", {}).get("because") == TOO_LARGE
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
    given: MapConfig,
    config: MapConfig,
    labels: Labels,
    votes: Votes,
    counts: dict[str, Any],
    stages: Stages,
    refined: Refined | None,
    poses: dict[str, Any] | None,
) -> Map:
    without = size["detections"] - len(votes)
    counts = {**size, "detections_without_label": without, **counts, "labels": len(labels)}
    notes = find_notes(Findings(passes, config, labels, votes, counts))
    record = {**_record(name, given, config, counts, stages), "notes": notes}
    corrected = refined.dataset if refined is not None and refined.is_corrected else None
    return Map(frame, labels, votes, record if poses is None else {**record, "poses": poses}, corrected)


def _paper(
    dataset: Dataset, config: MapConfig, stages: Stages, threads: int, progress: Progress
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
    stages: Stages,
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
    if refined is not None and refined.side_m is not None:
        config = with_sides(refined.side_m, config)
    if refined is not None and refined.as_given is not None and given is None and store is None:
        calibration, labels, votes, counts = refined.as_given
    else:
        with stages.measured("calibrate"):
            sought = None if refined is None else refined.sought
            parts = None if run is None else run.parts
            calibration = calibrate(source, config, given, parts, engine, progress, sought)
        with stages.measured("find"):
            known = None if run is None else run.known
            solved, files = solve_cells(source, calibration, config, engine, progress, store=store, known=known)
        with stages.measured("join"):
            labels, votes, counts = join_cells(solved, source.grid, config)
    if refined is not None:
        labels = with_errors_of_poses(refined, labels, votes)
    estimated = calibration_to_json(calibration)
    counts = {**counts, "drives": source.drives_record, "noise": estimated["noise"], "calibration": estimated}
    return labels, votes, counts, files


def _without_ray(rays: Rays) -> dict[str, int]:
    return {"detections_without_ray": int(np.isnan(rays.direction_in_world[:, 0]).sum())}


def _record(name: str, given: MapConfig, config: MapConfig, counts: dict[str, Any], stages: Stages) -> dict[str, Any]:
    """Return the record of a run with the settings that it had; those that were not `given` are named beside them."""
    drives, calibration = counts.pop("drives", None), counts.pop("calibration", None)
    return {
        "valuemap": version("valuemap"),
        "dataset": name,
        "settings": config.as_dict(),
        "settings_not_given": sorted(name for name, value in given.as_dict().items() if value is None),
        **({} if drives is None else {"drives": drives}),
        **({} if calibration is None else {"calibration": calibration}),
        "counts": counts,
        "stages": stages.records,
    }
