"""Two datasets as one: the rows of the first stay as they are, those of the second get ids and passes of their own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.dataset import Dataset, Frame, checked_as
from valuemap.errors import InputError
from valuemap.tables import Categories, Detections, Images, Table
from valuemap.tables.table import join_tables

T = TypeVar("T", bound=Table)
_SAME_UP = 1e-12
_MOST_RUNS = 1000
"""Tables are joined run by run, which takes half the time and memory, unless there are more."""


def join_datasets(first: Dataset, second: Dataset) -> Dataset:
    """Return both datasets as one, without truth.

    Ids of the second that the first has too are shifted beyond those of the first. Where both name passes alike, those
    of the second are named after their dataset. A column that only one of them has has no values for the other.

    Raises
    ------
    InputError
        They are not in one frame, or share images.
    """
    joined, added = _join_images(first, second)
    ids = _beyond(added.detection_id, first.detections.detection_id)
    detections = _joined(first.detections, added.replace(detection_id=ids))
    return checked_as(replace(joined, detections=detections), first, second)


def refuse_other_frame(expected: Frame, found: Frame, first: str | Path, second: str | Path) -> None:
    """Raise `InputError` where the second of two datasets is not in the frame of the first."""
    if found == expected:
        return
    if found.anchor is None and expected.anchor is None and math.dist(found.up, expected.up) < _SAME_UP:
        return  # Brought to unit length once more.
    option, numbers = ("--up", expected.up) if expected.anchor is None else ("--anchor", expected.anchor)
    digits = " ".join(map(repr, numbers))  # All of them: an origin beside this one is another.
    raise InputError(
        f"{second}: expected the frame of {first}, {expected}, found one {found}",
        hint=f"import {second} again with {option} {digits}",
    )


def join_in_portions(
    first: Dataset, portions: Iterator[Detections], largest_id: int, second: Dataset
) -> tuple[Dataset, Dataset, Iterator[Detections]]:
    """Return both datasets as one without detections, the second as a part of it, and the detections in portions.

    The first has no detections: these are the `portions`, with ids up to `largest_id`. Ids of the second are shifted
    beyond it, so that they ascend. All else is as `join_datasets` has it.
    """
    joined, added = _join_images(first, second)
    added = added.replace(detection_id=added.detection_id + max(0, largest_id + 1 - int(added.detection_id[0])))
    is_added = ~np.isin(joined.images.image_id, first.images.image_id)
    of_second = replace(joined, images=joined.images.take(is_added), detections=added)

    def all_portions() -> Iterator[Detections]:
        last = added
        for portion in portions:
            like, last = _alike(portion, added)
            yield like
        yield last

    return joined, of_second, all_portions()


def _join_images(first: Dataset, second: Dataset) -> tuple[Dataset, Detections]:
    """Return both datasets as one without detections, and those of the second, of images with their ids in it."""
    refuse_other_frame(first.frame, second.frame, first.name, second.name)
    _refuse_same(first, second)
    cameras = second.cameras.replace(camera_id=_beyond(second.cameras.camera_id, first.cameras.camera_id))
    images = second.images.replace(
        image_id=_beyond(second.images.image_id, first.images.image_id),
        camera_id=_renumbered(second.images.camera_id, second.cameras.camera_id, cameras.camera_id),
        pass_id=_own_passes(second.images.pass_id, first.images.pass_id, second.name),
    )
    if images.rig_id is not None or first.images.rig_id is not None:
        rigs = _own_rigs(first.images.rig_id, len(first.images))
        images = images.replace(rig_id=_beyond(_own_rigs(images.rig_id, len(images)), rigs))
        first = replace(first, images=first.images.replace(rig_id=rigs))
    joined = replace(
        first,
        cameras=_joined(first.cameras, cameras),
        images=_joined(first.images, images),
        detections=Detections.none(),
        truth=None,
        truth_detections=None,
        rejected=None,
    )
    image_id = _renumbered(second.detections.image_id, second.images.image_id, images.image_id)
    return joined, second.detections.replace(image_id=image_id)


def _refuse_same(first: Dataset, second: Dataset) -> None:
    """Refuse images of the second that the first has: what they see would count twice, as if two drives had seen it."""
    same = _same_images(first.images, second.images)
    if len(same):
        raise InputError(
            f"{second.name}: expected images that the map does not have, found {len(same)} of "
            f"{len(second.images)} that it has, such as {second.images.name[same[0]].as_py()!r}",
            hint="add new passes only; new images of a camera that stands still need times or names of their own",
        )


def _same_images(first: Images, second: Images) -> Ints:
    """Return the rows of the second that are images of the first, whatever their passes are called.

    They have the same name, the same pose and, where both say it, the same time. No two drives are in the same place to
    the last bit; names alone say nothing, as many cameras count from 1.
    """
    x, x_of_second = first.cam_from_world_m[:, 0], second.cam_from_world_m[:, 0]
    rows = np.flatnonzero(np.isin(x_of_second, x))
    times: dict[_NameAndPose, set[float | None]] = {}
    for image, time in _identities(first.take(np.flatnonzero(np.isin(x, x_of_second[rows])))):
        times.setdefault(image, set()).add(time)
    is_same = [
        image in times and (time is None or None in times[image] or time in times[image])
        for image, time in _identities(second.take(rows))
    ]
    return rows[np.array(is_same, np.bool_)]


_NameAndPose = tuple[str, tuple[float, ...]]


def _identities(images: Images) -> Iterator[tuple[_NameAndPose, float | None]]:
    """Yield name with pose, and time, of each image; a time that is not known is None."""
    poses = np.column_stack([images.cam_from_world_quat, images.cam_from_world_m]).tolist()
    times = _missing(len(images)) if images.timestamp_s is None else images.timestamp_s
    for name, pose, time in zip(images.name.to_pylist(), poses, times.tolist(), strict=True):
        yield (name, tuple(pose)), None if np.isnan(time) else time


def _joined(first: T, second: T) -> T:
    """Return two tables as one, ascending; values that one of them does not have are missing."""
    first, second = _alike(first, second)
    ids, ids_of_second = (getattr(table, str(first.KEY)) for table in (first, second))
    before = np.searchsorted(ids, ids_of_second)
    # Runs of the second between two rows of the first: mostly the ids of a pass follow each other.
    starts = np.flatnonzero(np.diff(before, prepend=-1))
    if len(starts) > _MOST_RUNS:
        return join_tables([first, second]).by_key()
    pieces, row, ends = [], 0, [*starts[1:].tolist(), len(second)]
    for start, end, until in zip(starts.tolist(), ends, before[starts].tolist(), strict=True):
        pieces += [first[row:until], second[start:end]]
        row = until
    return join_tables([*pieces, first[row:]])


def _alike(first: T, second: T) -> tuple[T, T]:
    """Return two tables with the same columns; values that one of them does not have are missing."""
    for f in fields(first):
        if f.metadata["nullable"]:
            one, other = getattr(first, f.name), getattr(second, f.name)
            if one is None and other is not None:
                first = first.replace(**{f.name: _missing(len(first))})
            elif other is None and one is not None:
                second = second.replace(**{f.name: _missing(len(second))})
    return first, second


def _missing(count: int) -> Floats:
    return np.full(count, np.nan)


def _beyond(ids: Ints, taken: Ints) -> Ints:
    """Return ids (N), shifted beyond those that are taken if one of them is."""
    if not np.isin(ids, taken).any():
        return ids
    return np.asarray(ids - ids.min() + taken.max() + 1)


def _renumbered(ids: Ints, before: Ints, after: Ints) -> Ints:
    """Return ids (N) as they are called after `before` (sorted) became `after`."""
    return np.asarray(after[np.searchsorted(before, ids)])


def _own_rigs(rig_id: Ints | None, count: int) -> Ints:
    """Return the rigs (N), where nothing is known one an image."""
    return np.arange(count) if rig_id is None else rig_id


def _own_passes(passes: Categories, taken: Categories, name: str) -> Categories:
    used = {taken.names[code] for code in np.unique(taken.codes)}
    if not used & {passes.names[code] for code in np.unique(passes.codes)}:
        return passes
    prefix = name
    while any(other.startswith(f"{prefix}/") for other in used):
        prefix += "'"
    return Categories(passes.codes, tuple(f"{prefix}/{each}" for each in passes.names))
