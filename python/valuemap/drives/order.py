"""The order of the exposures of each vehicle: by time, else by names, else along the chain of nearest poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.drives.chain import chain_nearest
from valuemap.drives.runs import edges_of_runs, sort_codes
from valuemap.drives.shots import Shots
from valuemap.drives.way import CLEARLY_LONGER, are_ways, way_length_m

TIME, NAME, CHAIN = 0, 1, 2
TOLD_BY = ("time", "name", "chain")
"""What tells an order, in words."""


@dataclass(frozen=True, eq=False)
class Track:
    """Exposures (E) one after the other, vehicle after vehicle.

    `exposure` indexes what was put in order; `group` numbers the vehicles, ascending; `taken` is how long it is since
    the exposure before, in seconds or by a running number, NaN where nothing tells; `told_by` is how the order was
    told.
    """

    exposure: Ints
    group: Ints
    taken: Floats
    told_by: Ints


def order_exposures(shots: Shots, vehicle: Ints, first: Ints, of_camera: int | None) -> Track:
    """Return the exposures (first shots, E) of vehicles (E) in driving order.

    `of_camera` is the part of names that tells the cameras of rigs apart: which camera took the first shot of an
    exposure tells no order.
    """
    place_m, time_s = shots.center_m.take(first, axis=0), shots.time_s[first]
    by_vehicle = _along_ways(sort_codes(vehicle), vehicle, time_s, place_m)
    runs = edges_of_runs(vehicle[by_vehicle])
    ordered, told_by = by_vehicle.copy(), np.zeros(len(first), np.int64)
    taken = np.diff(time_s[by_vehicle], prepend=np.nan)
    believed = are_ways(place_m.take(by_vehicle, axis=0), vehicle[by_vehicle])
    believed &= ~np.isnan(time_s[by_vehicle[runs[:-1]]])
    group = vehicle[by_vehicle].astype(np.int64)
    pieces: list[Track] = []
    for number in np.flatnonzero(~believed):
        place = slice(runs[number], runs[number + 1])
        members = by_vehicle[place]
        found = _order_vehicle(shots, members, first, place_m, of_camera)
        ordered[place], taken[place], told_by[place] = found.exposure, found.taken, found.told_by
        pieces.append(found)
    # A vehicle whose cameras go each their own way is several.
    extra = np.zeros(len(first), np.int64)
    for number, found in zip(np.flatnonzero(~believed), pieces, strict=True):
        extra[runs[number] : runs[number + 1]] = found.group
    steps = np.concatenate([[0], (np.diff(group) != 0) | (np.diff(extra) != 0)]) if len(group) else group
    return Track(ordered, np.cumsum(steps), taken, told_by)


def _along_ways(by_vehicle: Ints, vehicle: Ints, time_s: Floats, place_m: Floats) -> Ints:
    """Return exposures (E), by vehicle and time, with those of one time along the way from what is before to after."""
    vehicle, time_s, place_m = vehicle[by_vehicle], time_s[by_vehicle], place_m.take(by_vehicle, axis=0)
    is_next = np.diff(vehicle) == 0
    if not np.any(is_next & (np.diff(time_s) == 0.0)):
        return by_vehicle
    at = np.concatenate([[0], np.cumsum(~(is_next & (np.diff(time_s) == 0.0)))])
    middle_m = np.stack([np.bincount(at, axis_m) for axis_m in place_m.T], axis=1) / np.bincount(at)[:, None]
    of_time = vehicle[np.unique(at, return_index=True)[1]]
    step_m = np.where((np.diff(of_time) == 0)[:, None], np.diff(middle_m, axis=0), 0.0)
    way_m = np.concatenate([np.zeros((1, 3)), step_m]) + np.concatenate([step_m, np.zeros((1, 3))])
    along_m = np.einsum("ni,ni->n", place_m, way_m[at])
    return by_vehicle[np.lexsort((along_m, at))]


def _order_vehicle(shots: Shots, members: Ints, first: Ints, place_m: Floats, of_camera: int | None) -> Track:
    """Return some exposures (of all, E) in driving order, told by time, names or the chain, whichever is plausible."""
    time_s = shots.time_s[first[members]]
    none = np.full(len(members), np.nan)
    zero = np.zeros(len(members), np.int64)
    chain: Ints | None = None

    def is_believed(order: Ints) -> bool:
        nonlocal chain
        way = place_m[members[order]]
        if are_ways(way, zero).all():
            return True
        chain = chain_nearest(place_m[members]) if chain is None else chain
        return way_length_m(way) <= CLEARLY_LONGER * way_length_m(place_m[members[chain]])

    if not np.isnan(time_s).any() and is_believed(np.arange(len(members))):
        return Track(members, zero, np.diff(time_s, prepend=np.nan), zero + TIME)
    parts_of_names = shots.name_parts(first[members])

    def by_names(without: int | None) -> Track | None:
        order = np.argsort(parts_of_names.rank(without=without), kind="stable")
        if not is_believed(order):
            return None
        return Track(members[order], zero, parts_of_names.numbers_passed(order, without=without), zero + NAME)

    if of_camera is not None and (whole := by_names(of_camera)) is not None:
        return whole
    camera = shots.camera[first[members]]
    if len(np.unique(camera)) > 1 and 2 * len(np.unique(camera)) <= len(members):
        parts = [
            _order_vehicle(shots, members[camera == code], first, place_m, of_camera)
            for code in dict.fromkeys(camera.tolist())
        ]
        if not any(np.any(part.told_by == CHAIN) for part in parts):
            offset = np.cumsum([0, *(int(part.group.max()) + 1 for part in parts)])
            return Track(
                np.concatenate([part.exposure for part in parts]),
                np.concatenate([part.group + start for part, start in zip(parts, offset, strict=False)]),
                np.concatenate([part.taken for part in parts]),
                np.concatenate([part.told_by for part in parts]),
            )
    if (named := by_names(None)) is not None:
        return named
    chain = chain_nearest(place_m[members]) if chain is None else chain
    return Track(members[chain], zero, none, zero + CHAIN)
