"""Bring a map up to date: solve the cells that new passes touch, keep the ids of labels, and say what changed."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.calibration import read_calibration
from valuemap.cameras import camera_centers
from valuemap.config import MapConfig
from valuemap.control import dataset_after_control, labels_before_control, updated_after_control
from valuemap.dataset import (
    MARKER,
    Dataset,
    ensure_checked,
    read_dataset,
    read_head,
    read_images,
    rows_of,
    write_dataset_in_pieces,
    write_dataset_in_portions,
)
from valuemap.drives import find_drives
from valuemap.errors import InputError
from valuemap.evidence import Evidence, find_dataset
from valuemap.map_folder import BRIDGE, CELLS, CHANGES, DATASET, Map, read_map, read_record
from valuemap.nearby import Nearby
from valuemap.pipeline import Run, build_map_of_folder
from valuemap.portions import fits_into_memory, largest_detection, read_dataset_in_portions, rows_on_disk
from valuemap.progress import Progress, counted, silent, until
from valuemap.rejected import rejected_of_map
from valuemap.remote import Place
from valuemap.tables import Categories, Changes, Detections, IdBridge, Labels, Votes
from valuemap.tables.map import LABEL_STATES
from valuemap.tables.table import join_tables
from valuemap.tables.write import write_table
from valuemap.tiles.source import VIEWPOINT_SHARE
from valuemap.update.changes import Verdicts, existence_now, first_rows, judge, match_labels, match_places, number, tell
from valuemap.update.join import join_datasets, join_in_portions, refuse_other_frame
from valuemap.update.looks import Chances, Lookout, Looks, Sights
from valuemap.update.moved import is_moved_with_map

ADDED = "added"
"""Where in the folder of work the dataset of the added passes is kept."""
_NOTE_ON_CONTROL = (
    "the map had been moved to control points, and its dataset had not: this one is in the frame of the dataset "
    "(valuemap map with --control moves a map of all the data to them)"
)
_NOTE_ON_MOVED = (
    "the map and its dataset had been moved to control points: the passes that were added are moved likewise, as if "
    "their positions were as wrong (control in run.json)"
)
DRIVES_OF_NEW = 2
"""So many drives must have met what only the added passes have: a parked van is met by one."""
_DATASET_FILES = (MARKER, "cameras.parquet", "images.parquet", "detections.parquet")


def update_map(
    old: Path, added: Path, run: Run, *, dataset: Path | None = None, progress: Progress = silent
) -> tuple[Map, list[Place], dict[str, Path]]:
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
    list[Place]
        The files of its cells.
    dict[str, Path]
        Further files by their names in the folder of the map: its dataset, what changed, and the bridge of ids.

    Raises
    ------
    InputError
        One of the folders is not what it should be, the map was not made by this version, the frames differ, or the
        map has images of the dataset already.
    """
    record = read_record(old)
    place = find_dataset(old, record, dataset)
    if place is None:
        raise InputError(f"{old}: its dataset is not where it was", hint="say where it is with --dataset")
    refuse_other_frame(read_head(place)[1], read_head(added)[1], place, added)
    run = replace(run, calibration=read_calibration(old), known=old / CELLS, keeps_rejected=False)
    with ThreadPoolExecutor(1) as beside:
        reading = beside.submit(read_map, old)
        second = read_dataset(added)
        if not len(second.detections):
            raise InputError(f"{added}: there are no detections in it", hint="find some with valuemap detect")
        is_moved = "control" in record and is_moved_with_map(reading.result(), place)
        if is_moved:
            second = dataset_after_control(reading.result(), second)
        both = None if _is_large(place, added) else _joined(place, second)
        before = reading.result()
        written: Future[None] | None = None
        if both is None:
            rebuilt, cells, alone, posed, images_before = _updated_in_portions(place, second, before, run, progress)
        else:
            is_cut = run.cuts_on_disk(len(both[0].images) + len(both[0].detections))
            if is_cut:
                _write(both[0], run)
            rebuilt, cells, alone, posed, images_before = _updated_in_memory(*both, before, run, beside, progress)
            if not is_cut:  # Beside what comes next: both take one core.
                written = beside.submit(_write, both[0], run)
        before, is_put_back = _in_frame_of(rebuilt, before)
        result, changes, bridge = compare(before, rebuilt, alone, posed, images_before, progress=progress)
        if is_put_back:
            result = replace(result, run={**result.run, "notes": [_NOTE_ON_CONTROL, *result.run["notes"]]})
        if is_moved:  # The next update is to know, too.
            notes = [_NOTE_ON_MOVED, *result.run["notes"]]
            result = updated_after_control(replace(result, run={**result.run, "notes": notes}), before.run["control"])
        result = replace(result, rejected=rejected_of_map(result, lambda: _with_detections(posed, run)))
        if written is not None:
            written.result()
    for name, table in ((CHANGES, changes), (BRIDGE, bridge)):
        write_table(table, run.work / name)
    files = {f"{DATASET}/{name}": run.work / DATASET / name for name in _DATASET_FILES}
    return result, cells, {**files, CHANGES: run.work / CHANGES, BRIDGE: run.work / BRIDGE}


def _is_large(*datasets: Path) -> bool:
    """Return whether datasets are together too large to be in memory whole."""
    return not fits_into_memory(sum(sum(rows_on_disk(folder)) for folder in datasets))


def _with_detections(posed: Dataset, run: Run) -> Dataset:
    return posed if len(posed.detections) else read_dataset(run.work / DATASET)


_Updated = tuple[Map, list[Place], Map, Dataset, Ints]
"""The map of all the data, the files of its cells, that of the added passes alone, the dataset with the poses that both
were found with, and the ids of the images that the map before had."""


def _joined(place: Path, second: Dataset) -> tuple[Dataset, Ints]:
    """Return two datasets as one, and the ids of the images of the first."""
    first = read_dataset(place)
    return ensure_checked(join_datasets(first, second)), first.images.image_id


def _write(joined: Dataset, run: Run) -> None:
    write_dataset_in_pieces([joined], run.work / DATASET)


def _updated_in_memory(
    joined: Dataset, images_before: Ints, before: Map, run: Run, beside: ThreadPoolExecutor, progress: Progress
) -> _Updated:
    """Return what is compared, of datasets that fit into memory; what is cut on disk is written already.

    The added passes are mapped while most of the others' cells are found to be known.
    """
    alone: Future[Map] | None = None
    is_over = Event()

    def map_alone(posed: Dataset) -> None:
        nonlocal alone
        alone = beside.submit(_map_of_added, posed, images_before, before, run, until(is_over))

    try:
        rebuilt, cells = build_map_of_folder(
            run.work / DATASET, _settings(before), run, held=joined, on_posed=map_alone, progress=progress
        )
        # The poses that the labels were found with, where those of whole drives were corrected.
        posed = rebuilt.corrected or joined
        of_added = alone.result() if alone else _map_of_added(posed, images_before, before, run, progress)
    finally:
        is_over.set()
    return rebuilt, cells, of_added, posed, images_before


def _map_of_added(posed: Dataset, images_before: Ints, before: Map, run: Run, progress: Progress) -> Map:
    """Return the map of the images of a dataset that the map before did not have."""
    is_new = ~np.isin(posed.images.image_id, images_before)
    of_new = is_new[rows_of(posed.detections.image_id, posed.images.image_id)]
    added = replace(posed, images=posed.images.take(is_new), detections=posed.detections.take(of_new))
    return _map_alone(added, before, run, progress)


def _updated_in_portions(place: Path, second: Dataset, before: Map, run: Run, progress: Progress) -> _Updated:
    """Return what is compared, of datasets of which only images are in memory, and not while cells are solved.

    The dataset that is returned has no detections. Poses are taken as they are in datasets as large as these.
    """
    first, portions = read_dataset_in_portions(place)
    joined, added, portions = join_in_portions(first, portions, largest_detection(place), second)
    images_before = first.images.image_id
    del first, second
    write_dataset_in_portions(joined, portions, (), run.work / DATASET)
    name = joined.name
    del joined, portions
    rebuilt, cells = build_map_of_folder(run.work / DATASET, _settings(before), run, progress=progress)
    alone = _map_alone(added, before, run, progress)
    cameras, images = read_images(run.work / DATASET)
    return rebuilt, cells, alone, Dataset(name, before.frame, cameras, images, Detections.none()), images_before


def compare(
    before: Map, rebuilt: Map, alone: Map, joined: Dataset, images_before: Ints, *, progress: Progress = silent
) -> tuple[Map, Changes, IdBridge]:
    """Return a rebuilt map with the ids of the map before it and with states, what changed, and the bridge of ids.

    What changed is told by two maps that know nothing of each other: that `before`, and that of the added passes
    `alone`. The images of the joined dataset with the ids `images_before` are those of the map before. Where something
    moved, the rebuilt map, which takes it for standing still, may have one label for both places; then those of the
    epochs stand for it.
    """
    is_new = ~np.isin(joined.images.image_id, images_before)
    center_m = camera_centers(joined.images)
    seen: dict[bytes, tuple[Sights, Sights]] = {}

    def judged(rows: _Rows) -> tuple[Verdicts, dict[int, tuple[Looks, Looks]], float]:
        return _judged(rows, before, rebuilt, alone, joined, center_m, is_new, seen, progress)

    matches = _Matches.of(before, rebuilt, alone)
    rows = _Rows.of(before, rebuilt, alone, matches)
    verdicts, looks, hidden = judged(rows)
    # Where nothing has changed, the map of all the data is right: it knows more than each epoch alone.
    while len(unchanged := rows.unchanged(verdicts)):
        rows = _Rows.of(before, rebuilt, alone, matches, whole=np.concatenate([rows.whole, unchanged]))
        verdicts, looks, hidden = judged(rows)
    # What only the added passes have, and all the data do not, is there only if it explains what is gone, or was put up
    # since: then the looks from before that speak against it are those of drives that could not see it yet.
    unfounded = rows.is_of_alone & (verdicts.moved_from < 0) & (rows.part_of < 0)
    unfounded &= ~np.array([row in looks and has_appeared(*looks[row]) for row in range(len(unfounded))], np.bool_)
    if unfounded.any():
        rows, verdicts, looks = _left_out(rows, verdicts, looks, unfounded)
    ids = number(before.labels, verdicts)
    changes, bridge = tell(before.labels, rows.labels, verdicts, ids, looks, rows.common, rows.is_lost)
    is_kept = ~rows.is_lost
    is_kept[verdicts.moved_from[verdicts.moved_from >= 0]] = False
    states_now = Categories.from_texts([verdicts.state[row] for row in np.flatnonzero(is_kept)])
    order = np.argsort(ids[is_kept], kind="stable")
    id_of = np.where(is_kept, ids, -1)[rows.votes.label_id - 1]
    votes = rows.votes.replace(label_id=id_of).take(np.flatnonzero(id_of >= 0))
    votes, count = _once(votes, ids[is_kept], rows.is_of_alone[is_kept])
    labels = rows.labels.replace(existence=existence_now(rows.labels, verdicts.state, looks))
    kept = labels.take(np.flatnonzero(is_kept)).replace(label_id=ids[is_kept], state=states_now, votes=count)
    told = {"hidden_share": round(hidden, 4), **_counts(verdicts.state, is_kept, changes)}
    not_given = before.run.get("settings_not_given", [])  # Those of the map before were taken over.
    run = {**rebuilt.run, "settings_not_given": not_given, "update": told}
    return Map(rebuilt.frame, kept.take(order), votes, run), changes, bridge


def _judged(
    rows: _Rows,
    before: Map,
    rebuilt: Map,
    alone: Map,
    joined: Dataset,
    center_m: Floats,
    is_new: Bools,
    seen: dict[bytes, tuple[Sights, Sights]],
    progress: Progress,
) -> tuple[Verdicts, dict[int, tuple[Looks, Looks]], float]:
    """Return what became of labels, how both epochs looked at those that were asked for, and the share of drives that
    are blind to an object; `seen` keeps how labels with the same votes in the same place were seen.
    """
    max_range_m = _settings(before).vote.farthest_m
    is_near = Nearby(center_m[is_new]).have_any(rows.labels.position_in_world_m, max_range_m)
    is_asked = is_near | (rows.before < 0)
    # What an epoch alone has elsewhere is no sight of this object.
    looked = _without_claimed(rows, is_asked, before, alone, joined, is_new)
    sights = _sights(rows, looked, is_asked, seen, rebuilt, joined, center_m, is_new, max_range_m, progress)
    states = before.labels.state.texts() if before.labels.state is not None else ["confirmed"] * len(before.labels)
    were_there = {row: at for row, at in sights.items() if rows.before[row] >= 0 and states[rows.before[row]] != "gone"}
    chances = Chances.of(rebuilt)
    hidden = chances.hidden_share([first for first, _ in were_there.values()])
    looks = {
        row: (chances.looks(first, hidden), chances.looks(second, hidden)) for row, (first, second) in sights.items()
    }
    return judge(rows.labels, rows.before, states, rows.stands, looks), looks, hidden


def _sights(
    rows: _Rows,
    looked: Votes,
    is_asked: Bools,
    seen: dict[bytes, tuple[Sights, Sights]],
    rebuilt: Map,
    joined: Dataset,
    center_m: Floats,
    is_new: Bools,
    max_range_m: float,
    progress: Progress,
) -> dict[int, tuple[Sights, Sights]]:
    """Return how both epochs saw the labels (rows) that are asked for; `seen` says what is known, and is told more."""
    asked = np.flatnonzero(is_asked)
    ids, place_m = rows.labels.label_id[asked], rows.labels.position_in_world_m[asked]
    first, end = (np.searchsorted(looked.label_id, ids, side=side) for side in ("left", "right"))
    votes = (looked.detection_id[a:b] for a, b in zip(first, end, strict=True))
    keys = [place.tobytes() + of.tobytes() for place, of in zip(place_m, votes, strict=True)]
    todo = [number for number, key in enumerate(keys) if key not in seen]
    if todo:
        is_unseen = np.zeros(len(rows.labels), np.bool_)
        is_unseen[asked[todo]] = True
        votes_of_unseen = looked.take(np.flatnonzero(is_unseen[looked.label_id - 1]))
        unseen = replace(rebuilt, labels=rows.labels, votes=votes_of_unseen)
        lookout = _lookout(unseen, is_unseen, joined, center_m, is_new, max_range_m)
        with counted(progress, "looking for changes", len(todo)) as looked_at:
            for done, number in enumerate(todo, start=1):
                seen[keys[number]] = lookout.at(int(ids[number]))
                looked_at(done)
    return {row: seen[key] for row, key in zip(asked.tolist(), keys, strict=True)}


def has_appeared(first: Looks, second: Looks) -> bool:
    """Return whether something was not there before, and stands there since: what one drive met may have passed by."""
    return first.say_gone and second.say_there and second.seen_by >= DRIVES_OF_NEW


def _in_frame_of(rebuilt: Map, before: Map) -> tuple[Map, bool]:
    """Return the map before where the rebuilt one is, and whether it was put back from its control points.

    Control points move a map, and its dataset only where that is written. Corrected poses are about the mean of all
    drives, and that of more drives is elsewhere.
    """
    was_corrected = before.run.get("poses", {}).get("drives") and before.run["poses"]["found"] != "nothing"
    is_corrected, was_moved = rebuilt.corrected is not None or was_corrected, "control" in before.run
    if not (is_corrected or was_moved):
        return before, False
    row, _ = match_labels(before.labels, before.votes, rebuilt.labels, rebuilt.votes)
    place_m, labels = rebuilt.labels.position_in_world_m[row >= 0], before.labels
    if not len(place_m):
        return before, False

    def away_m(labels: Labels) -> Floats:
        return place_m - labels.position_in_world_m[row[row >= 0]]

    is_put_back = False
    if was_moved:
        back = labels_before_control(before)
        far_m, near_m = (float(np.median(np.linalg.norm(away_m(each), axis=1))) for each in (labels, back))
        if is_put_back := near_m < far_m:
            labels = back
    if is_corrected:
        position = labels.position_in_world_m + np.median(away_m(labels), axis=0)
        labels = labels.replace(position_in_world_m=position)
    return replace(before, labels=labels), is_put_back


def _map_alone(added: Dataset, before: Map, run: Run, progress: Progress) -> Map:
    """Return the map of the added passes alone, with their poses as they are in the joined dataset."""
    added = ensure_checked(added)
    write_dataset_in_pieces([added], run.work / ADDED)
    config = _settings(before).with_settings(["correct_poses=0"])
    run = replace(run, known=None)
    return build_map_of_folder(run.work / ADDED, config, run, held=added, progress=progress)[0]


@dataclass(frozen=True, eq=False)
class _Matches:
    """The label (row) before that each of the rebuilt map is by its votes, `old`, with how many are `common` (N).

    `fresh` (N) is the one of the added passes alone, `same` (M) that before which stands where each of these does; -1
    where there is none.
    """

    old: Ints
    common: Ints
    fresh: Ints
    same: Ints

    @classmethod
    def of(cls, before: Map, rebuilt: Map, alone: Map) -> _Matches:
        old, common = match_labels(before.labels, before.votes, rebuilt.labels, rebuilt.votes)
        fresh, _ = match_labels(alone.labels, alone.votes, rebuilt.labels, rebuilt.votes)
        return cls(old, common, fresh, match_places(before.labels, alone.labels))


@dataclass(frozen=True, eq=False)
class _Rows:
    """All labels (N) that are judged: of the rebuilt map, then of the added passes alone, then of the map before.

    Labels are numbered from 1. `before` (N) is the old label that each is, `common` (N) how many votes they share;
    `stands` (N) tells what both epochs alone have in one place, or what is to be taken for it, `part_of` (N) the label
    (row) of the rebuilt map that has the votes of both places of an object that may have moved, -1 of all others;
    `whole` are those labels of it that are not taken apart.
    """

    labels: Labels
    votes: Votes
    before: Ints
    common: Ints
    stands: Bools
    is_of_alone: Bools
    part_of: Ints
    is_lost: Bools
    whole: Ints

    @classmethod
    def of(cls, before: Map, rebuilt: Map, alone: Map, matches: _Matches, whole: Ints | None = None) -> _Rows:
        whole = np.empty(0, np.int64) if whole is None else whole
        labels, votes = rebuilt.labels.replace(state=None), rebuilt.votes
        old, common, fresh, same = matches.old, matches.common, matches.fresh, matches.same
        partner = np.where(fresh >= 0, same[fresh], -1)
        # One label of what stood here before and of what stands there now.
        mixed = (old >= 0) & (fresh >= 0) & (partner < 0) & ~np.isin(old, same)
        mixed[whole] = False
        by_place = (old < 0) & (partner >= 0) & ~np.isin(partner, old)
        old = np.where(by_place, partner, old)
        stands = np.isin(old, same[same >= 0]) & (old >= 0)
        stands[whole] = True
        extra = np.flatnonzero(
            (same < 0) & (~np.isin(np.arange(len(same)), fresh) | np.isin(np.arange(len(same)), fresh[mixed]))
        )
        taken_apart = np.flatnonzero(mixed)
        part_of_extra = np.full(len(alone.labels), -1)
        part_of_extra[fresh[mixed]] = taken_apart
        lost = np.setdiff1d(np.arange(len(before.labels)), old)
        parts = [
            (
                labels.take(np.flatnonzero(~mixed)),
                votes.take(np.flatnonzero(~np.isin(votes.label_id, labels.label_id[mixed]))),
            ),
            _taken(alone, extra),
            _taken(before, np.concatenate([old[mixed], lost])),
        ]
        table, all_votes = _numbered(parts)
        table = _placed_as(rebuilt.labels, table)
        kept = int((~mixed).sum())
        none = np.full(len(extra), -1)
        size = (kept, len(extra), int(mixed.sum()), len(lost))
        zeros = [np.zeros(count, np.bool_) for count in size]
        return cls(
            labels=table,
            votes=all_votes,
            before=np.concatenate([old[~mixed], none, old[mixed], lost]),
            common=np.concatenate(
                [common[~mixed], np.zeros(len(extra), np.int64), common[mixed], np.zeros(len(lost), np.int64)]
            ),
            stands=np.concatenate([stands[~mixed], zeros[1], stands[mixed], np.isin(lost, same)]),
            is_of_alone=np.concatenate([zeros[0], ~zeros[1], zeros[2], zeros[3]]),
            part_of=np.concatenate(
                [np.full(kept, -1), part_of_extra[extra], taken_apart, np.full(len(lost), -1)],
            ),
            is_lost=np.concatenate([zeros[0], zeros[1], zeros[2], ~zeros[3]]),
            whole=whole,
        )

    def unchanged(self, verdicts: Verdicts) -> Ints:
        """Return the labels (rows) of the rebuilt map that were taken apart though nothing is gone from there."""
        parts = np.flatnonzero((self.part_of >= 0) & ~self.is_of_alone)
        moved = np.isin(parts, verdicts.moved_from)
        gone = np.array([verdicts.state[row] == "gone" for row in parts.tolist()], np.bool_)
        return self.part_of[parts[~(moved | gone)]]


def _taken(source: Map, rows: Ints) -> tuple[Labels, Votes]:
    """Return some labels of a map with their votes."""
    labels = source.labels.take(rows).replace(state=None)
    return labels, source.votes.take(np.flatnonzero(np.isin(source.votes.label_id, labels.label_id)))


def _placed_as(placed: Labels, labels: Labels) -> Labels:
    """Return labels with absolute covariances where a map has them, of which all labels have one place."""
    if placed.absolute_covariance_m2 is None or not len(placed):
        return labels
    place_m2 = placed.absolute_covariance_m2[0] - placed.covariance_m2[0]
    return labels.replace(absolute_covariance_m2=labels.covariance_m2 + place_m2)


def _numbered(parts: list[tuple[Labels, Votes]]) -> tuple[Labels, Votes]:
    """Return labels of several maps, and their votes, numbered from 1 in their order."""
    labels, votes, first = [], [], 1
    for table, of in parts:
        ids = np.arange(first, first + len(table))
        first += len(table)
        row = first_rows(of.label_id, table.label_id)
        of = of.replace(label_id=ids[row])
        labels.append(table.replace(label_id=ids))
        votes.append(of.take(np.argsort(row, kind="stable")) if np.any(np.diff(row) < 0) else of)
    return join_tables(labels), join_tables(votes)


def _lookout(
    asked: Map, is_asked: Bools, joined: Dataset, center_m: Floats, is_new: Bools, max_range_m: float
) -> Lookout:
    """Return what counts looks at some labels of a map; its votes are theirs, and its labels numbered from 1.

    Only images that may have seen one of them are asked: those no farther from it than the farthest of all votes.
    """
    images, votes = joined.images, asked.votes
    place_m = asked.labels.position_in_world_m
    away_m = center_m[rows_of(votes.image_id, images.image_id)] - place_m[votes.label_id - 1]
    farthest_m = 1.001 * float(np.linalg.norm(away_m, axis=1).max(initial=0.0))
    low_m, high_m = place_m[is_asked].min(axis=0, initial=np.inf), place_m[is_asked].max(axis=0, initial=-np.inf)
    axes = zip(center_m.T, low_m - farthest_m, high_m + farthest_m, strict=True)
    near = np.flatnonzero(np.all([(low <= along_m) & (along_m <= high) for along_m, low, high in axes], axis=0))
    if len(near):
        near = near[Nearby(place_m[is_asked]).have_any(center_m[near], farthest_m)]
    # Whole passes, since an order is told by all of it.
    of_passes = np.flatnonzero(np.isin(images.pass_id.codes, images.pass_id.codes[near]))
    drives = find_drives(images.take(of_passes), viewpoint_step_m=max_range_m * VIEWPOINT_SHARE)
    drives = drives.take(np.searchsorted(of_passes, near))
    part = replace(joined, images=images.take(near), detections=Detections.none())
    labels = replace(asked, votes=votes[:0])
    return Lookout(Evidence(labels, part), drives, is_new[near], votes)


def _without_claimed(rows: _Rows, is_asked: Bools, before: Map, alone: Map, joined: Dataset, is_new: Bools) -> Votes:
    """Return the votes for some labels without those by which one epoch alone has an object in another place."""
    votes = rows.votes.take(np.flatnonzero(is_asked[rows.votes.label_id - 1]))
    label = votes.label_id - 1
    of_new = is_new[rows_of(votes.image_id, joined.images.image_id)]
    in_doubt = ~rows.stands[label] & ~rows.is_of_alone[label]
    is_old = rows.before[label] >= 0
    claimed = (of_new & is_old & np.isin(votes.detection_id, alone.votes.detection_id)) | (
        ~of_new & ~is_old & np.isin(votes.detection_id, before.votes.detection_id)
    )
    return votes.take(np.flatnonzero(~(in_doubt & claimed)))


def _left_out(
    rows: _Rows, verdicts: Verdicts, looks: Mapping[int, tuple[Looks, Looks]], is_out: Bools
) -> tuple[_Rows, Verdicts, dict[int, tuple[Looks, Looks]]]:
    """Return what was judged without some labels."""
    kept = np.flatnonzero(~is_out)
    new_row = np.full(len(is_out), -1)
    new_row[kept] = np.arange(len(kept))
    is_vote_kept = ~is_out[rows.votes.label_id - 1]
    votes = rows.votes.take(np.flatnonzero(is_vote_kept))
    columns = ("before", "common", "stands", "is_of_alone", "part_of", "is_lost")
    moved_from = verdicts.moved_from[kept]
    return (
        _Rows(
            labels=rows.labels.take(kept).replace(label_id=np.arange(1, len(kept) + 1)),
            votes=votes.replace(label_id=new_row[votes.label_id - 1] + 1),
            **{name: getattr(rows, name)[kept] for name in columns},
            whole=rows.whole,
        ),
        Verdicts(
            verdicts.before[kept],
            [verdicts.state[row] for row in kept.tolist()],
            np.where(moved_from >= 0, new_row[moved_from], -1),
        ),
        {int(new_row[row]): each for row, each in looks.items() if new_row[row] >= 0},
    )


def _once(votes: Votes, ids: Ints, is_of_alone: Bools) -> tuple[Votes, Ints]:
    """Return votes, by label, of which each detection has one, and how many each label (N) of these ids has.

    Labels of the added passes alone keep theirs: they are there because others had taken their votes wrongly.
    """
    is_first = first_rows(votes.detection_id, votes.detection_id) == np.arange(len(votes))
    of_several = np.flatnonzero(np.isin(votes.detection_id, votes.detection_id[~is_first]))
    yields = ~np.isin(votes.label_id[of_several], ids[is_of_alone])
    order = of_several[np.lexsort((votes.label_id[of_several], yields, votes.detection_id[of_several]))]
    again = order[1:][np.diff(votes.detection_id[order]) == 0]
    votes = votes.take(np.delete(np.arange(len(votes)), again)) if len(again) else votes
    if np.any(np.diff(votes.label_id) < 0):
        votes = votes.take(np.argsort(votes.label_id, kind="stable"))
    first, end = (np.searchsorted(votes.label_id, ids, side=side) for side in ("left", "right"))
    return votes, end - first


def _settings(before: Map) -> MapConfig:
    settings = dict(before.run.get("settings", {}))
    method = settings.pop("method", "robust")
    return MapConfig(method=method, **settings)


def _counts(states: list[str], is_kept: Bools, changes: Changes) -> dict[str, dict[str, int]]:
    kept = [state for state, kept in zip(states, is_kept.tolist(), strict=True) if kept]
    kinds = changes.change.texts()
    return {
        "labels": {state: kept.count(state) for state in LABEL_STATES},
        "changes": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
    }
