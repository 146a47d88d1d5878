"""What more data brings: recall, reprojection error and position error against the number of passes.

This is the experiment behind Fig. 4 of Dabisias et al., "VALUE", ICRA 2018. The images are cut into the paper's
clusters. For a number of passes n and a seed, passes are put in a random order, and each cluster keeps the images of
the first n passes that drove through it. A map of these images is compared with the truth, cluster by cluster; without
truth, with the map of all images. The last pass in the order of a cluster is the one left out: it is never kept, and
the labels are projected into its images.

Every map is written down when it is done, so that an interrupted experiment goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from valuemap.arrays import Floats, Ints
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, number_passes, rows_of
from valuemap.errors import InputError, OutputError, SettingError
from valuemap.evaluate import TrueObjects, match_labels, recoverable_objects
from valuemap.evidence import Evidence
from valuemap.folders import check_place, new_file
from valuemap.map_folder import Map
from valuemap.paper.partition import partition_images
from valuemap.pipeline import build_map
from valuemap.progress import Progress, silent
from valuemap.tables import Categories

MARKER = "experiment.json"
RESULT = "passes.json"
CURVES = {
    "recall": ("Recall", "1"),
    "reprojection_px": ("Reprojection error", "px"),
    "position_m": ("Position error", "m"),
}
"""What is measured: title and unit by name."""

_FORMAT = 1


@dataclass(frozen=True)
class Quartiles:
    """How clusters differ with a number of passes: the quartiles of one measure over `clusters` clusters."""

    passes: int
    clusters: int
    lower: float
    median: float
    upper: float


@dataclass(frozen=True)
class PassesResult:
    """The curves of one experiment, by the names of `CURVES`, and what they were made from."""

    dataset: str
    method: str
    reference: str
    """What labels are compared with: the truth, or the map of all images."""
    clusters: int
    min_passes: int
    seeds: int
    curves: dict[str, list[Quartiles]]

    def to_json(self) -> dict[str, Any]:
        """Return everything by name."""
        return {"format_version": _FORMAT, **asdict(self)}


@dataclass(frozen=True, eq=False)
class _Reference:
    """What labels are compared with.

    `cluster` (objects) is where most of an object's sightings are; the sightings are detections that show an object:
    `detection_row` and `object_row` (sightings).
    """

    name: str
    objects: TrueObjects
    cluster: Ints
    detection_row: Ints
    object_row: Ints


def experiment_passes(
    dataset: Dataset,
    out: Path,
    config: MapConfig | None = None,
    *,
    seeds: int = 5,
    min_passes: int = 5,
    radius_m: float = 2.0,
    threads: int = 0,
    progress: Progress = silent,
) -> PassesResult:
    """Measure what more passes bring, in all clusters that at least `min_passes` drove through.

    Parameters
    ----------
    dataset
        Images and detections; its truth is used where it has one.
    out
        A folder for the result and for every map's figures; an experiment that began there goes on.
    config
        Settings of the maps.
    seeds
        How many random orders of the passes are tried.
    min_passes
        Clusters with fewer passes do not count; at least 2.
    radius_m
        A label farther than this from an object is not that object.
    threads
        As in `build_map`.
    progress
        Called after each map.

    Raises
    ------
    InputError
        No cluster has so many passes and an object.
    SettingError
        A number is out of range, or the folder holds another experiment.
    OutputError
        The folder is somebody else's, or cannot be written.
    """
    config = config or MapConfig()
    for name, value, least in (("seeds", seeds, 1), ("min_passes", min_passes, 2)):
        if value < least:
            raise SettingError(f"{name}: expected at least {least}, found {value}", hint="the default is 5")
    cluster = partition_images(dataset.images, config.partition).astype(np.int64)
    pass_number = number_passes(dataset.images)
    passes_of_cluster = _passes_of(cluster, pass_number)
    identity = _identity(dataset, config, radius_m)
    _check_folder(out, identity)

    everything = build_map(dataset, config, threads=threads, progress=progress)
    reference = _reference(dataset, everything, cluster)
    counted = _counted(reference, passes_of_cluster, min_passes, dataset.name)
    most = int(passes_of_cluster[counted].max())
    jobs = [(seed, passes) for passes in range(1, most) for seed in range(seeds)]
    runs = []
    for done, (seed, passes) in enumerate(jobs):
        progress("maps of some passes", done, len(jobs))
        path = out / "runs" / f"passes{passes:03d}_seed{seed:03d}.json"
        run = _read_run(path)
        if run is None:
            run = _measure(dataset, config, reference, cluster, pass_number, seed, passes, radius_m, threads)
            if not (out / MARKER).is_file():  # Not before there is anything to go on from.
                _write_json(identity, out / MARKER)
            _write_json(run, path, force=True)  # One that is damaged is there, and is no use to anybody.
        runs.append(run)
    progress("maps of some passes", len(jobs), len(jobs))
    result = PassesResult(
        dataset=dataset.name,
        method=config.method,
        reference=reference.name,
        clusters=len(counted),
        min_passes=min_passes,
        seeds=seeds,
        curves={name: _curve(name, jobs, runs, counted, passes_of_cluster) for name in CURVES},
    )
    _write_json(result.to_json(), out / RESULT)
    return result


def read_passes(path: Path) -> PassesResult:
    """Read the result of an experiment: its folder or its passes.json.

    Raises
    ------
    InputError
        There is none, or it is damaged.
    """
    file = path / RESULT if path.is_dir() else path
    hint = "make it with valuemap experiment passes"
    if not file.is_file():
        raise InputError(f"{file}: no such file", hint=hint)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        curves = {name: [Quartiles(**each) for each in content["curves"][name]] for name in CURVES}
        known = {f.name: content[f.name] for f in fields(PassesResult) if f.name != "curves"}
        return PassesResult(**known, curves=curves)
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise InputError(f"{file}: is not the result of an experiment: {error!r}", hint=hint) from error


# The clusters and what is in them.


def _passes_of(cluster: Ints, pass_number: Ints) -> Ints:
    """Return how many passes drove through each cluster."""
    pairs = np.unique(np.stack([cluster, pass_number]), axis=1)
    return np.bincount(pairs[0])


def _reference(dataset: Dataset, everything: Map, cluster: Ints) -> _Reference:
    min_parallax_rad = math.radians(float(everything.run["settings"]["min_parallax_deg"]))
    if dataset.truth is not None and dataset.truth_detections is not None:
        truth, pairs = dataset.truth, dataset.truth_detections
        recoverable = recoverable_objects(dataset, min_parallax_rad)
        objects = TrueObjects(truth.object_id, truth.position_in_world_m, truth.class_name, recoverable)
        detection_row = rows_of(pairs.detection_id, dataset.detections.detection_id)
        object_row = rows_of(pairs.object_id, truth.object_id)
        name = "the truth"
    else:
        labels, votes = everything.labels, everything.votes
        objects = TrueObjects(labels.label_id, labels.position_in_world_m, labels.class_name)
        detection_row = rows_of(votes.detection_id, dataset.detections.detection_id)
        object_row = rows_of(votes.label_id, labels.label_id)
        name = "the map of all passes"
    image_row = rows_of(dataset.detections.image_id, dataset.images.image_id)[detection_row]
    return _Reference(
        name, objects, _most_frequent(object_row, cluster[image_row], len(objects)), detection_row, object_row
    )


def _most_frequent(group: Ints, value: Ints, groups: int) -> Ints:
    """Return the most frequent value of each group, the least of several; -1 for groups without one."""
    result = np.full(groups, -1)
    if len(group):
        pairs, count = np.unique(np.stack([group, value]), axis=1, return_counts=True)
        best = np.lexsort((-pairs[1], count, pairs[0]))  # The last of each group is its most frequent.
        result[pairs[0][best]] = pairs[1][best]
    return result


def _counted(reference: _Reference, passes_of_cluster: Ints, min_passes: int, name: str) -> Ints:
    """Return the clusters with enough passes and an object to find, ascending."""
    countable = reference.cluster[reference.objects.counts_in_recall & (reference.cluster >= 0)]
    counted = np.intersect1d(np.flatnonzero(passes_of_cluster >= min_passes), countable)
    if len(counted) == 0:
        most = int(passes_of_cluster[np.unique(countable)].max(initial=0))
        raise InputError(
            f"{name}: no cluster with an object has {min_passes} passes; the most are {most}",
            hint=f"try --min-passes {most}" if most >= 2 else "the same places have to be driven several times",
        )
    return counted


# One map of some passes.


def _measure(
    dataset: Dataset,
    config: MapConfig,
    reference: _Reference,
    cluster: Ints,
    pass_number: Ints,
    seed: int,
    passes: int,
    radius_m: float,
    threads: int,
) -> dict[str, Any]:
    """Return sums over the objects of each cluster, by the cluster's number: found, position and reprojection."""
    rank, last = _ranks(cluster, pass_number, seed)
    part = _images_of(dataset, np.flatnonzero((rank < passes) & (rank < last[cluster])))
    clusters = len(last)
    countable = reference.objects.counts_in_recall & (reference.cluster >= 0)
    where = reference.cluster[countable]
    sums: dict[str, Any] = {"objects": np.bincount(where, minlength=clusters)}
    names = ("found", "position_m", "seen", "reprojection_px")
    if part is None:
        return {name: sums.get(name, np.zeros(clusters)).tolist() for name in ("objects", *names)}
    result = build_map(part, config, threads=threads)
    label = match_labels(result.labels, reference.objects, result.frame, radius_m=radius_m).label_of_object
    is_found = label >= 0
    apart = (
        result.labels.position_in_world_m[label] - reference.objects.position_in_world_m if len(result.labels) else 0
    )
    distance = np.where(is_found, np.linalg.norm(apart * np.ones((len(label), 3)), axis=1), 0.0)
    sums["found"] = np.bincount(where, is_found[countable], minlength=clusters)
    sums["position_m"] = np.bincount(where, distance[countable], minlength=clusters)

    # Into the images of the pass left out, where nobody of that pass voted.
    image_row = rows_of(dataset.detections.image_id, dataset.images.image_id)[reference.detection_row]
    is_left_out = rank[image_row] == last[cluster[image_row]]
    of_object = reference.object_row
    chosen = np.flatnonzero(is_left_out & is_found[of_object] & countable[of_object])
    chosen = chosen[cluster[image_row[chosen]] == reference.cluster[of_object[chosen]]]
    chosen = chosen[~_have_voted(result, dataset, label[of_object[chosen]], pass_number, image_row[chosen])]
    point = result.labels.position_in_world_m[label[of_object[chosen]]]
    pixel = Evidence(replace(result, votes=result.votes[:0]), dataset).project(image_row[chosen], point)
    error = np.linalg.norm(pixel - dataset.detections.center_px[reference.detection_row[chosen]], axis=1)
    seen = np.flatnonzero(np.isfinite(error))
    of_cluster = cluster[image_row[chosen[seen]]]
    sums["seen"] = np.bincount(of_cluster, minlength=clusters)
    sums["reprojection_px"] = np.bincount(of_cluster, error[seen], minlength=clusters)
    return {name: sums[name].tolist() for name in ("objects", *names)}


def _ranks(cluster: Ints, pass_number: Ints, seed: int) -> tuple[Ints, Ints]:
    """Return the place (images) of each image's pass among those of its cluster, and the last place (clusters)."""
    order = np.random.default_rng(seed).permutation(int(pass_number.max()) + 1)
    pairs, of_image = np.unique(np.stack([cluster, order[pass_number]]), axis=1, return_inverse=True)
    first = np.searchsorted(pairs[0], np.arange(int(cluster.max()) + 1))
    rank = np.arange(pairs.shape[1]) - first[pairs[0]]
    last = np.bincount(pairs[0]) - 1
    return rank[of_image.reshape(-1)], last


def _images_of(dataset: Dataset, image_row: Ints) -> Dataset | None:
    """Return some images of a dataset with their detections; None where they have none."""
    images = dataset.images.take(image_row)
    detections = dataset.detections.take(np.isin(dataset.detections.image_id, images.image_id))
    if len(detections) == 0:
        return None
    return Dataset(dataset.name, dataset.frame, dataset.cameras, images, detections)


def _have_voted(result: Map, dataset: Dataset, label_row: Ints, pass_number: Ints, image_row: Ints) -> Any:
    """Return for which pairs of a label and an image the image's pass has a vote for the label."""
    votes = result.votes
    voter_pass = pass_number[rows_of(votes.image_id, dataset.images.image_id)]
    passes = int(pass_number.max()) + 1
    voted = np.unique(rows_of(votes.label_id, result.labels.label_id) * passes + voter_pass)
    return np.isin(label_row * passes + pass_number[image_row], voted)


# From all maps to curves.


def _curve(
    name: str, jobs: list[tuple[int, int]], runs: list[dict[str, Any]], counted: Ints, passes_of_cluster: Ints
) -> list[Quartiles]:
    """Return the quartiles over clusters, each cluster with the mean over its seeds, by number of passes."""
    part, whole = {"recall": ("found", "objects"), "position_m": ("position_m", "found")}.get(
        name, ("reprojection_px", "seen")
    )
    curve = []
    for passes in range(1, max(passes for _, passes in jobs) + 1):
        chosen = [run for (_, n), run in zip(jobs, runs, strict=True) if n == passes]
        clusters = counted[passes_of_cluster[counted] > passes]
        parts = np.array([run[part] for run in chosen])[:, clusters]
        wholes = np.array([run[whole] for run in chosen], dtype=np.float64)[:, clusters]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = parts / wholes
        known = np.isfinite(ratio).any(axis=0)
        value: Floats = np.nanmean(ratio[:, known], axis=0)
        if len(value):
            lower, median, upper = (float(q) for q in np.quantile(value, [0.25, 0.5, 0.75]))
            curve.append(Quartiles(passes, len(value), lower, median, upper))
    return curve


# On disk.


def _identity(dataset: Dataset, config: MapConfig, radius_m: float) -> dict[str, Any]:
    """Return what must be the same for maps to be of the same experiment."""
    digest = hashlib.sha256()
    for table in (dataset.cameras, dataset.images, dataset.detections, dataset.truth, dataset.truth_detections):
        for f in fields(table) if table is not None else ():
            for piece in _bytes_of(getattr(table, f.name)):
                digest.update(piece)
    return {"dataset": dataset.name, "sha256": digest.hexdigest(), "radius_m": radius_m, "settings": config.as_dict()}


def _bytes_of(value: Any) -> Iterable[bytes]:
    if isinstance(value, Categories):
        yield from (np.ascontiguousarray(value.codes).tobytes(), "\0".join(value.names).encode())
    elif isinstance(value, np.ndarray):
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, list):
        yield from (np.ascontiguousarray(each).tobytes() for each in value)
    elif isinstance(value, pa.Array):
        yield "\0".join(value.to_pylist()).encode()


def _check_folder(out: Path, identity: dict[str, Any]) -> None:
    """Find out whether the folder can be written to, and holds the same experiment if it holds any; nothing is made."""
    head = out / MARKER
    if out.is_dir() and any(out.iterdir()) and not head.is_file():
        raise OutputError(
            f"{out}: is a folder without {MARKER}, so it is not ours to write to", hint="choose another --out"
        )
    if head.is_file() and _read_run(head) != json.loads(json.dumps(identity)):
        raise SettingError(
            f"{out}: holds an experiment on other data or with other settings",
            hint="choose another --out, or remove the folder",
        )
    check_place(out, parts=(RESULT,))


def _read_run(path: Path) -> dict[str, Any] | None:
    """Return what a finished map wrote down; None where there is nothing, or it is damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _write_json(content: Any, path: Path, *, force: bool = False) -> None:
    with new_file(path, force=force) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
