"""The order of the exposures of each vehicle: by time, else by names, else along the chain of nearest poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Bools, Floats, Ints, rows_in_runs
from valuemap.connected import connected
from valuemap.drives.chain import chain_nearest
from valuemap.drives.name_exposures import name_exposures
from valuemap.drives.runs import edges_of_runs, equal_to_next, numbered_by_first, quantiles, rows_since, sort_codes
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


def order_exposures(shots: Shots, vehicle: Ints, first: Ints, exposure: Ints) -> Track:
    """Return the exposures (first shots, E) of vehicles (E) in driving order; `exposure` (N) is that of each shot."""
    by_vehicle = sort_codes(vehicle)
    place_m, time_s = shots.center_m.take(first, axis=0), shots.time_s[first]
    tie = (np.diff(time_s[by_vehicle]) == 0.0) & equal_to_next(vehicle[by_vehicle])
    tie &= equal_to_next(shots.camera[first[by_vehicle]])
    if tie.any():  # Several images of one camera at one time: its clock tells whole seconds.
        by_vehicle = _order_ties(tie, by_vehicle, vehicle, place_m)
        time_s = _spread_ties(tie, by_vehicle, vehicle, time_s)
    runs = edges_of_runs(vehicle[by_vehicle])
    ordered, told_by = by_vehicle.copy(), np.zeros(len(first), np.int64)
    taken = np.diff(time_s[by_vehicle], prepend=np.nan)
    believed = are_ways(place_m.take(by_vehicle, axis=0), vehicle[by_vehicle])
    believed &= ~np.isnan(time_s[by_vehicle[runs[:-1]]])
    group = vehicle[by_vehicle].astype(np.int64)
    pieces: list[Track] = []
    by_exposure = np.empty(0, np.int64) if believed.all() else sort_codes(exposure)
    edges = edges_of_runs(exposure[by_exposure])
    for number in np.flatnonzero(~believed):
        place = slice(runs[number], runs[number + 1])
        members = by_vehicle[place]
        rows = by_exposure[rows_in_runs(edges[members], edges[members + 1] - edges[members])]
        found = _order_vehicle(shots, members, np.sort(rows), exposure, place_m, time_s)
        ordered[place], taken[place], told_by[place] = found.exposure, found.taken, found.told_by
        pieces.append(found)
    # A vehicle whose cameras go each their own way is several.
    extra = np.zeros(len(first), np.int64)
    for number, found in zip(np.flatnonzero(~believed), pieces, strict=True):
        extra[runs[number] : runs[number + 1]] = found.group
    steps = np.concatenate([[0], (np.diff(group) != 0) | (np.diff(extra) != 0)]) if len(group) else group
    return Track(ordered, np.cumsum(steps), taken, told_by)


def _order_ties(tie: Bools, order: Ints, vehicle: Ints, place_m: Floats) -> Ints:
    """Return exposures (E) of vehicles, those that tie with the next (E - 1) along the way from before to after."""
    at = np.append(0, np.cumsum(~tie))
    place_m = place_m.take(order, axis=0)
    middle_m = np.stack([np.bincount(at, axis_m) for axis_m in place_m.T], axis=1) / np.bincount(at)[:, None]
    of = vehicle[order][np.append(True, ~tie)]
    step_m = np.where(equal_to_next(of)[:, None], np.diff(middle_m, axis=0), 0.0)
    way_m = np.concatenate([np.zeros((1, 3)), step_m]) + np.concatenate([step_m, np.zeros((1, 3))])
    return order[np.lexsort((np.einsum("ni,ni->n", place_m, way_m[at]), at))]


def _spread_ties(tie: Bools, order: Ints, vehicle: Ints, time_s: Floats) -> Floats:
    """Return the times (E) of exposures: those that tie with the next (E - 1) evenly until the clock usually moves."""
    run = np.append(0, np.cumsum(~tie))
    begins = np.append(True, ~tie)
    start, count = np.flatnonzero(begins), np.bincount(run)
    begin_s, of = time_s[order[start]], vehicle[order[start]]
    gap_s = np.append(np.where(np.diff(of) == 0, np.diff(begin_s), np.nan), np.nan)
    usual_s = quantiles(np.where(count > 1, gap_s, np.nan), of, 0.5)[of]
    span_s = np.where(count > 1, np.nan_to_num(np.fmin(gap_s, usual_s)), 0.0)
    spread = time_s.copy()
    spread[order] += rows_since(begins) * (span_s / count)[run]
    return spread


def _order_vehicle(shots: Shots, members: Ints, rows: Ints, exposure: Ints, place_m: Floats, time_s: Floats) -> Track:
    """Return some exposures (M of E) in driving order, told by time, names or the chain, whichever is plausible.

    `rows` are their shots, ascending; `exposure` (N) is that of each shot; places and times are those of all (E).
    """
    ascending = np.argsort(members)
    of = ascending[np.searchsorted(members[ascending], exposure[rows])]
    begins = np.unique(of, return_index=True)[1]
    first = rows[begins]
    own_s = time_s[members]
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

    if not np.isnan(own_s).any() and is_believed(np.arange(len(members))):
        return Track(members, zero, np.diff(own_s, prepend=np.nan), zero + TIME)
    camera = _cameras_apart(shots.camera[rows], of, begins)
    if len(np.unique(camera)) > 1 and 2 * len(np.unique(camera)) <= len(members):
        parts = [
            _order_vehicle(shots, members[camera == code], rows[camera[of] == code], exposure, place_m, time_s)
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
    names = shots.name_parts(first) if len(rows) == len(members) else name_exposures(shots, rows, of)
    by_name = np.argsort(names.rank(), kind="stable")
    if is_believed(by_name):
        return Track(members[by_name], zero, names.numbers_passed(by_name), zero + NAME)
    chain = chain_nearest(place_m[members]) if chain is None else chain
    return Track(members[chain], zero, none, zero + CHAIN)


def _cameras_apart(camera: Ints, exposure: Ints, first: Ints) -> Ints:
    """Return of which camera of shots (N) each exposure (first shots, M) is; cameras that share exposures are one."""
    if len(first) == len(camera):
        return camera
    camera = numbered_by_first(camera)
    return connected(camera, camera[first][exposure], int(camera.max()) + 1)[camera[first]]
