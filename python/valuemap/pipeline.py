"""The method on one screen: a dataset in, a map out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

import numpy as np

from valuemap.cameras import Rays, cast_rays
from valuemap.config import MapConfig, bounded_threads
from valuemap.dataset import Dataset, ensure_checked
from valuemap.describe import describe_labels
from valuemap.engine.threads import ThreadEngine
from valuemap.errors import InputError
from valuemap.map_folder import Map
from valuemap.merge import merge_clusters
from valuemap.notes import Findings, find_notes
from valuemap.partition import partition_images
from valuemap.progress import Progress, silent
from valuemap.robust import Scene, calibrate_noise, calibration_to_json
from valuemap.system import peak_memory_mb
from valuemap.tables import Labels, Votes
from valuemap.tiles.mapping import solve_cells
from valuemap.tiles.seams import join_cells
from valuemap.tiles.source import InMemory
from valuemap.vote import vote_in_clusters


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
        Labels ordered by their first detection, votes, and the record of the run.
    """
    config, threads = config or MapConfig(), bounded_threads(threads)
    if not len(dataset.detections):
        raise InputError(
            f"{dataset.name}: there are no detections in it",
            hint="find some with valuemap detect, or import them with the images",
        )
    dataset = ensure_checked(dataset)
    stages = _Stages()
    method = _paper if config.method == "paper" else _robust
    labels, votes, counts = method(dataset, config, stages, threads, progress)
    counts = {
        "images": len(dataset.images),
        "detections": len(dataset.detections),
        "detections_without_label": len(dataset.detections) - len(votes),
        **counts,
        "labels": len(labels),
    }
    notes = find_notes(Findings(dataset, config, labels, votes, counts))
    return Map(dataset.frame, labels, votes, {**_record(dataset, config, counts, stages), "notes": notes})


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
    dataset: Dataset, config: MapConfig, stages: _Stages, threads: int, progress: Progress
) -> tuple[Labels, Votes, dict[str, Any]]:
    """Drives, noise estimated from a sample, and in each cell the map with the least J found; docs/method.md."""
    with stages.measured("order"):
        source = InMemory(dataset, config)
    with stages.measured("calibrate"):
        sample = source.sample()
        scene = Scene(sample.dataset, sample.drives, cast_rays(sample.dataset))
        calibration = calibrate_noise(scene, config, threads=threads, progress=progress)
        del sample, scene
    with stages.measured("find"):
        solved = solve_cells(source, calibration, config, ThreadEngine(threads), progress)
    with stages.measured("join"):
        labels, votes, counts = join_cells(solved, source.grid, config)
    return labels, votes, {**counts, "drives": source.drives_record, "noise": calibration_to_json(calibration)}


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


def _record(dataset: Dataset, config: MapConfig, counts: dict[str, int], stages: _Stages) -> dict[str, Any]:
    drives = counts.pop("drives", None)
    return {
        "valuemap": version("valuemap"),
        "dataset": dataset.name,
        "settings": config.as_dict(),
        **({} if drives is None else {"drives": drives}),
        "counts": counts,
        "stages": stages.records,
    }
