"""Bring a map up to date: solve the cells that new passes touch, keep the ids of labels, and say what changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from valuemap.config import MapConfig
from valuemap.dataset import MARKER, Dataset, read_dataset, write_dataset
from valuemap.drives import find_drives
from valuemap.errors import InputError
from valuemap.evidence import Evidence, find_dataset
from valuemap.map_folder import BRIDGE, CELLS, CHANGES, DATASET, Map, read_map
from valuemap.pipeline import Run, build_map_of_folder
from valuemap.progress import Progress, silent
from valuemap.tables import Bools, Categories, Changes, IdBridge, Ints, Labels, Votes, join_tables, write_table
from valuemap.tiles.calibration import read_calibration
from valuemap.tiles.source import VIEWPOINT_SHARE
from valuemap.update.changes import STATES, judge, match_labels, number, tell
from valuemap.update.join import join_datasets
from valuemap.update.looks import Lookout, Looks

_DATASET_FILES = (MARKER, "cameras.parquet", "images.parquet", "detections.parquet")


def update_map(
    old: Path, added: Path, run: Run, *, dataset: Path | None = None, progress: Progress = silent
) -> tuple[Map, list[Path], dict[str, Path]]:
    """Add the passes of a dataset to a map.

    The settings are those of the map, and so is what was estimated of its dataset: the labels are those of a map of
    all the data that is made with them (`valuemap map --calibration`). Cells that the new passes do not touch are not
    solved again.

    Parameters
    ----------
    old
        The folder of the map.
    added
        A dataset with the new passes, in the same frame.
    run
        Where and how the map is made; its calibration and known cells are replaced.
    dataset
        The dataset of the map, where its record does not say it.
    progress
        Called as progress(what, done, total).

    Returns
    -------
    Map
        The new map; its labels have states.
    list[Path]
        The files of its cells.
    dict[str, Path]
        Further files by their names in the folder of the map: its dataset, what changed, and the bridge of ids.

    Raises
    ------
    InputError
        One of the folders is not what it should be, the map was not made by this version, or the frames differ.
    """
    before = read_map(old)
    calibration = read_calibration(old)
    place = find_dataset(old, before.run, dataset)
    if place is None:
        raise InputError(f"{old}: its dataset is not where it was", hint="say where it is with --dataset")
    first, second = read_dataset(place), read_dataset(added)
    if not len(second.detections):
        raise InputError(f"{added}: there are no detections in it", hint="find some with valuemap detect")
    joined = join_datasets(first, second)
    write_dataset(joined, run.work / DATASET)
    run = replace(run, calibration=calibration, known=old / CELLS)
    rebuilt, cells = build_map_of_folder(run.work / DATASET, _settings(before), run, progress=progress)
    result, changes, bridge = compare(before, rebuilt, joined, first.images.image_id, progress=progress)
    for name, table in ((CHANGES, changes), (BRIDGE, bridge)):
        write_table(table, run.work / name)
    files = {f"{DATASET}/{name}": run.work / DATASET / name for name in _DATASET_FILES}
    return result, cells, {**files, CHANGES: run.work / CHANGES, BRIDGE: run.work / BRIDGE}


def compare(
    before: Map, rebuilt: Map, joined: Dataset, images_before: Ints, *, progress: Progress = silent
) -> tuple[Map, Changes, IdBridge]:
    """Return a rebuilt map with the ids of the map before it and with states, what changed, and the bridge of ids.

    The images of the joined dataset with the ids `images_before` are those of the map before.
    """
    labels, votes = rebuilt.labels.replace(state=None), rebuilt.votes
    matched, common = match_labels(before.labels, before.votes, labels, votes)
    lost = np.setdiff1d(np.arange(len(before.labels)), matched)
    # Those that the new map does not have are looked for at where they were, with the votes that they had.
    all_labels, all_votes = _with_lost(labels, votes, before, lost)
    matched = np.concatenate([matched, lost])
    common = np.concatenate([common, np.zeros(len(lost), np.int64)])
    evidence = Evidence(replace(rebuilt, labels=all_labels, votes=all_votes), joined)
    drives = find_drives(joined.images, viewpoint_step_m=evidence.max_range_m * VIEWPOINT_SHARE)
    is_new = ~np.isin(joined.images.image_id, images_before)
    detection_rate = rebuilt.run["counts"].get("detection_rate", 0.5)
    near = cKDTree(evidence.center_in_world_m[is_new]).query(all_labels.position_in_world_m)[0]
    lookout = Lookout(evidence, drives, is_new, detection_rate)
    done = 0

    def looks_at(label_id: int) -> tuple[Looks, Looks]:
        nonlocal done
        done += 1
        progress("looking for changes", done, len(all_labels))
        return lookout.at(label_id)

    states = before.labels.state.texts() if before.labels.state is not None else ["confirmed"] * len(before.labels)
    verdicts, looks = judge(all_labels, matched, states, np.asarray(near <= evidence.max_range_m), looks_at)
    ids = number(before.labels, verdicts)
    changes, bridge = tell(before.labels, all_labels, verdicts, ids, looks, common)
    is_kept = np.arange(len(all_labels)) < len(labels)
    is_kept[verdicts.moved_from[verdicts.moved_from >= 0]] = False
    states_now = Categories.from_texts([verdicts.state[row] for row in np.flatnonzero(is_kept)])
    order = np.argsort(ids[is_kept], kind="stable")
    kept = labels.take(np.flatnonzero(is_kept[: len(labels)])).replace(label_id=ids[is_kept], state=states_now)
    id_of = np.where(is_kept, ids, -1)[votes.label_id - 1]
    votes = votes.replace(label_id=id_of).take(np.flatnonzero(id_of >= 0))
    votes = votes.take(np.argsort(votes.label_id, kind="stable"))
    run = {**rebuilt.run, "update": _counts(verdicts.state, is_kept, changes)}
    return Map(rebuilt.frame, kept.take(order), votes, run), changes, bridge


def _settings(before: Map) -> MapConfig:
    settings = dict(before.run.get("settings", {}))
    method = settings.pop("method", "robust")
    return MapConfig(method=method, **settings)


def _with_lost(labels: Labels, votes: Votes, before: Map, lost: Ints) -> tuple[Labels, Votes]:
    rows = before.labels.take(lost).replace(state=None)
    beyond = np.arange(len(lost)) + len(labels) + 1
    is_of_lost = np.isin(before.votes.label_id, rows.label_id)
    old_votes = before.votes.take(np.flatnonzero(is_of_lost))
    old_votes = old_votes.replace(label_id=beyond[np.searchsorted(rows.label_id, old_votes.label_id)])
    return join_tables([labels, rows.replace(label_id=beyond)]), join_tables([votes, old_votes])


def _counts(states: list[str], is_kept: Bools, changes: Changes) -> dict[str, dict[str, int]]:
    kept = [state for state, kept in zip(states, is_kept.tolist(), strict=True) if kept]
    kinds = changes.change.texts()
    return {
        "labels": {state: kept.count(state) for state in STATES},
        "changes": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
    }
