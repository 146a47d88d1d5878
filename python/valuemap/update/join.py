"""Two datasets as one: the rows of the first stay as they are, those of the second get ids and passes of their own."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from valuemap.dataset import Dataset, checked_as
from valuemap.errors import InputError
from valuemap.tables import Categories, Floats, Ints, Table, join_tables

T = TypeVar("T", bound=Table)


def join_datasets(first: Dataset, second: Dataset) -> Dataset:
    """Return both datasets as one, without truth.

    Ids of the second that the first has too are shifted beyond those of the first. Where both name passes alike, those
    of the second are named after their dataset. A column that only one of them has has no values for the other.

    Raises
    ------
    InputError
        They are not in one frame.
    """
    if first.frame != second.frame:
        raise InputError(
            f"{second.name}: expected the frame of {first.name}, {first.frame.to_json()}, found "
            f"{second.frame.to_json()}",
            hint="import it again with the same origin",
        )
    given = first
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
    detections = second.detections.replace(
        detection_id=_beyond(second.detections.detection_id, first.detections.detection_id),
        image_id=_renumbered(second.detections.image_id, second.images.image_id, images.image_id),
    )
    joined = replace(
        first,
        cameras=_joined(first.cameras, cameras),
        images=_joined(first.images, images),
        detections=_joined(first.detections, detections),
        truth=None,
        truth_detections=None,
        rejected=None,
    )
    return checked_as(joined, given, second)


def _joined(first: T, second: T) -> T:
    """Return two tables as one, ascending; values that one of them does not have are missing."""
    for f in fields(first):
        if f.metadata["nullable"]:
            one, other = getattr(first, f.name), getattr(second, f.name)
            if one is None and other is not None:
                first = first.replace(**{f.name: _missing(len(first))})
            elif other is None and one is not None:
                second = second.replace(**{f.name: _missing(len(second))})
    table = join_tables([first, second])
    key: Ints = getattr(table, str(table.KEY))
    return table if np.all(np.diff(key) > 0) else table.take(np.argsort(key, kind="stable"))


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
