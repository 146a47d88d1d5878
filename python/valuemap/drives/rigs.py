"""Rigs: which cameras are of one vehicle, and which of their images are of one exposure."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Bools, Floats, Ints, runs
from valuemap.connected import connected
from valuemap.drives.names import NameParts
from valuemap.drives.runs import edges_of_runs, equal_to_next, numbered_by_first, quantiles, rows_since, sort_codes
from valuemap.drives.shots import MOST_CAMERAS, Shots
from valuemap.drives.way import are_ways, lengths

_LEAST_EXPOSURES = 3
"""Two cameras must expose together this often before their places relative to each other can be said to be constant."""
_LEAST_NAMESAKES = 8
"""The same by names: fewer names agree by chance."""
_LEAST_SHARE_ON_RIGS = 0.2
"""A part of the names in which fewer images than this share differ alone names no cameras."""
_SAME_LOOK_COSINE = float(np.cos(np.radians(10.0)))
"""Two cameras that look less than this apart look the same way."""
_ALONG_COSINE = float(np.cos(np.radians(45.0)))
"""What lies in a direction nearer than this to that of the way is ahead or behind, not beside."""
_STEADY_SHARE = 0.5
"""A place that varies by less than this share of the way from image to image is constant."""
_ROUNDING = 1e-6
"""What is constant to this share of the way is constant."""


def find_vehicles(shots: Shots) -> tuple[Ints, Ints, int]:
    """Return the vehicle (N) of each shot, the first shot (N) of its exposure, and the number of rigs."""
    stream = _streams(shots)
    clock = shots.time_s.copy()
    timed = ~np.isnan(clock)
    pairs = [_rig_pairs(shots, np.flatnonzero(timed), clock, stream, by_name=False)]
    untimed = np.flatnonzero(~timed)
    if len(untimed):
        clock[untimed], part, found = _rigs_by_name(shots, untimed, stream)
        stream = numbered_by_first(stream * (int(part.max()) + 1) + part)
        pairs.append(found)
    i, j = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    streams = int(stream.max(initial=-1)) + 1
    exposure = np.arange(len(shots))
    rig_id = shots.images.rig_id
    if rig_id is not None:
        rig = numbered_by_first(rig_id[shots.row])
        _, first = np.unique(rig, return_index=True)
        exposure = first[rig]
        i, j = np.concatenate([i, exposure]), np.concatenate([j, np.arange(len(shots))])
    given_of_stream = np.empty(streams, np.int64)
    given_of_stream[stream] = shots.given
    if not len(i):
        return shots.given, exposure, 0
    rig_of_stream = connected(stream[i], stream[j], streams)
    exposure = _expose_together(clock, timed, stream, rig_of_stream, exposure)
    given = connected(shots.given[i], shots.given[j], int(shots.given.max()) + 1)
    on_rig = np.bincount(rig_of_stream, minlength=streams)
    return numbered_by_first(given[shots.given]), exposure, int(np.sum(on_rig > 1))


def _streams(shots: Shots) -> Ints:
    """Return the stream (N) of each shot: its pass, camera, and which of several at one time it is."""
    cameras = int(shots.camera.max(initial=0)) + 1
    stream = numbered_by_first(shots.given * cameras + shots.camera) if cameras > 1 else shots.given
    if cameras > 1:
        # A camera for each image, as some reconstructions have it, tells no cameras apart.
        images = np.bincount(shots.given)
        _, first = np.unique(stream, return_index=True)
        streams = np.bincount(shots.given[first], minlength=len(images))
        alone = (2 * streams > images)[shots.given]
        stream = numbered_by_first(np.where(alone, shots.given, int(shots.given.max()) + 1 + stream))
    tie = equal_to_next(shots.time_s) & ~np.isnan(shots.time_s[1:])
    if not tie.any():
        return stream
    # Several at one time of what looks like one camera: told apart by their names.
    group = np.concatenate([[0], np.cumsum(~tie)])
    tied = np.flatnonzero(np.concatenate([tie, [False]]) | np.concatenate([[False], tie]))
    name = np.unique(np.array(shots.names(tied)), return_inverse=True)[1]
    tied = tied[np.lexsort((name, stream[tied], group[tied]))]
    begins = np.concatenate([[True], (np.diff(group[tied]) != 0) | (np.diff(stream[tied]) != 0)])
    rank = np.zeros(len(shots), np.int64)
    rank[tied] = rows_since(begins)
    return numbered_by_first(stream * (int(rank.max()) + 1) + rank)


def _rigs_by_name(shots: Shots, members: Ints, stream: Ints) -> tuple[Floats, Ints, tuple[Ints, Ints]]:
    """Return what names tell of shots (M): their rank, the part that names the camera (N), and pairs of rigs."""
    parts = shots.name_parts(members)
    best: tuple[Floats, Ints, tuple[Ints, Ints]] | None = None
    for column in _columns_that_may_name_cameras(parts):
        rank = np.zeros(len(shots))
        rank[members] = parts.rank(without=column)
        part = np.zeros(len(shots), np.int64)
        part[members] = parts.codes[column]
        split = numbered_by_first(stream * (int(part.max()) + 1) + part)
        found = _rig_pairs(shots, members, rank, split, by_name=True, by_number=column % 2 == 1)
        if len(found[0]) > (len(best[2][0]) if best else 0):
            best = rank[members], part, found
    none = np.empty(0, np.int64)
    return best or (parts.rank(), np.zeros(len(shots), np.int64), (none, none))


def _columns_that_may_name_cameras(names: NameParts) -> list[int]:
    """Return the columns without which a good part of the names is the same as some others, but not as many."""
    columns = []
    for column, codes in enumerate(names.codes):
        if codes.any():
            alike = np.bincount(names.rank(without=column).astype(np.int64))
            on_rig = alike[(alike > 1) & (alike <= MOST_CAMERAS)].sum()
            if on_rig > _LEAST_SHARE_ON_RIGS * len(codes):
                columns.append(column)
    return columns


def _rig_pairs(
    shots: Shots, members: Ints, clock: Floats, stream: Ints, *, by_name: bool, by_number: bool = False
) -> tuple[Ints, Ints]:
    """Return pairs of shots that two cameras of one rig took together.

    Two streams are of one rig if, where they expose within half the time between two exposures of each, the place of
    the one seen from the other is constant, measured by how far the vehicle moves from image to image. Two drives by
    one camera that looks the same way are no rig where only numbers in their names or their places agree. Nor are the
    images that one camera took within one second of its clock: each is a step farther on.
    """
    members = members[np.argsort(clock[members], kind="stable")]
    if not len(members) or stream[members].min() == stream[members].max():
        return members[:0], members[:0]
    time, of = clock[members], stream[members]
    cadence, step_m = _own_cadence(time, of, shots.center_m.take(members, axis=0))
    found = []
    for lag in range(1, min(MOST_CAMERAS, len(members))):
        near = time[lag:] - time[:-lag] <= 0.5 * np.minimum(cadence[lag:], cadence[:-lag])
        if by_name:
            near &= time[lag:] == time[:-lag]
        if not near.any():
            break
        before = np.flatnonzero(near & (of[lag:] != of[:-lag]))
        found.append(np.stack([before, before + lag]))
    pair = np.concatenate([*found, np.empty((2, 0), np.int64)], axis=1)
    swapped = of[pair[0]] > of[pair[1]]
    pair = np.where(swapped, pair[::-1], pair)
    count = int(of.max()) + 1
    _, group, number = np.unique(of[pair[0]] * count + of[pair[1]], return_inverse=True, return_counts=True)
    often = number[group] >= (_LEAST_NAMESAKES if by_name else _LEAST_EXPOSURES)
    if by_name:  # Names that tell no order tell no exposures.
        by_stream = sort_codes(of)
        codes = np.unique(of, return_inverse=True)[1]
        often &= are_ways(shots.center_m[members[by_stream]], of[by_stream])[codes[pair[0]]]
    pair, group = pair[:, often], group[often]
    if not pair.shape[1]:
        return members[:0], members[:0]
    a, b = members[pair[0]], members[pair[1]]
    rotation_a, rotation_b = shots.cam_from_world(a), shots.cam_from_world(b)
    offset_m = np.einsum("nij,nj->ni", rotation_a, shots.center_m[b] - shots.center_m[a])
    cosine = (np.einsum("nij,nij->n", rotation_a, rotation_b) - 1.0) / 2.0
    group = np.unique(group, return_inverse=True)[1]
    middle_m = np.stack([quantiles(axis_m, group, 0.5) for axis_m in offset_m.T], axis=1)
    spread_m = quantiles(np.linalg.norm(offset_m - middle_m[group], axis=1), group, 0.5)
    by_group = sort_codes(group)
    starts = edges_of_runs(group[by_group])[:-1]
    place_m = shots.center_m[a[by_group]]
    width_m = lengths(np.maximum.reduceat(place_m, starts) - np.minimum.reduceat(place_m, starts))
    usual_m = quantiles(step_m[pair[0]], group, 0.5)
    apart_m = np.linalg.norm(middle_m, axis=1)
    one, other = a[by_group[starts]], b[by_group[starts]]
    one_camera = (shots.camera[one] == shots.camera[other]) & (quantiles(cosine, group, 0.5) > _SAME_LOOK_COSINE)
    if not by_number:
        one_pass = shots.given[one] == shots.given[other]
        asked = np.zeros_like(one_pass) if by_name else one_camera & one_pass
        one_camera &= ~one_pass | _are_steps(shots, a, b, group, middle_m, asked)
    is_rig = (spread_m <= _STEADY_SHARE * usual_m + _ROUNDING * width_m) & (apart_m <= width_m)
    is_rig &= ~(one_camera & (by_name | (apart_m <= usual_m)))
    return a[is_rig[group]], b[is_rig[group]]


def _are_steps(shots: Shots, a: Ints, b: Ints, group: Ints, offset_m: Floats, asked: Bools) -> Bools:
    """Return for groups (G) of pairs of shots, if asked, whether they are as if one camera had gone ahead.

    The second is ahead of the first or behind it (`offset_m`, G times 3, as the first sees it) rather than beside it,
    and no part of their names names two cameras.
    """
    found = np.zeros(len(asked), np.bool_)
    by_group = np.lexsort((a, group)) if asked.any() else np.empty(0, np.int64)
    edges = edges_of_runs(group[by_group])
    for number in np.flatnonzero(asked):
        pair = by_group[edges[number] : edges[number + 1]]
        one, other = a[pair], b[pair]
        way_m = np.einsum("nij,nj->ni", shots.cam_from_world(one[:-1]), np.diff(shots.center_m[one], axis=0))
        way_m, away_m = np.median(way_m, axis=0), offset_m[number]
        if abs(way_m @ away_m) > _ALONG_COSINE * np.linalg.norm(way_m) * np.linalg.norm(away_m):
            found[number] = not _are_named_apart(shots, one, other)
    return found


def _are_named_apart(shots: Shots, one: Ints, other: Ints) -> bool:
    """Return whether a part of the names is mostly one text for some shots (M), another for those (M) they go with."""
    parts = NameParts(shots.names(np.concatenate([one, other])))
    for codes in parts.codes:
        both, count = np.unique(codes.reshape(2, -1), axis=1, return_counts=True)
        usual = np.argmax(count)
        if 2 * count[usual] > len(one) and both[0, usual] != both[1, usual]:
            return True
    return False


def _own_cadence(time: Floats, stream: Ints, center_m: Floats) -> tuple[Floats, Floats]:
    """Return for shots (N, by time) the time to the nearer neighbor in their stream, and the distance to the next."""
    order = np.argsort(stream, kind="stable")
    same = np.diff(stream[order]) == 0
    gap = np.where(same, np.diff(time[order]), np.inf)
    away_m = np.where(same, lengths(np.diff(center_m.take(order, axis=0), axis=0)), np.nan)
    cadence, step_m = np.empty(len(order)), np.empty(len(order))
    cadence[order] = np.minimum(np.concatenate([[np.inf], gap]), np.concatenate([gap, [np.inf]]))
    before_m, after_m = np.concatenate([[np.nan], away_m]), np.concatenate([away_m, [np.nan]])
    step_m[order] = np.where(np.isnan(after_m), before_m, after_m)
    return cadence, np.nan_to_num(step_m)


def _expose_together(clock: Floats, timed: Bools, stream: Ints, rig_of_stream: Ints, exposure: Ints) -> Ints:
    """Return the first shot (N) of each shot's exposure: that of the rig's fullest camera nearest in time.

    Where a shot is not `timed` (N), its clock is the rank of its name, and only the same rank is one exposure.
    """
    rig = rig_of_stream[stream]
    cameras = np.bincount(rig_of_stream)
    shared = np.flatnonzero((cameras[rig] > 1) & (np.bincount(exposure)[exposure] == 1))  # The rest knows already.
    shared = shared[np.lexsort((clock[shared], rig[shared]))]
    if not len(shared):
        return exposure
    exposure = exposure.copy()
    for members in runs(shared, rig[shared]):
        of, images = np.unique(stream[members], return_counts=True)
        leads = stream[members] == of[np.argmax(images)]
        lead, follow = members[leads], members[~leads]
        at = clock[lead]
        after = np.clip(np.searchsorted(at, clock[follow]), 1, max(len(at) - 1, 1))
        nearest = after - (clock[follow] - at[after - 1] <= np.abs(at[np.minimum(after, len(at) - 1)] - clock[follow]))
        gap = np.diff(at)
        own = np.minimum(np.concatenate([[np.inf], gap]), np.concatenate([gap, [np.inf]]))
        off = np.abs(clock[follow] - at[nearest])
        joins = (off == 0.0) | (timed[follow] & (off <= 0.5 * own[nearest]))
        exposure[follow[joins]] = exposure[lead[nearest[joins]]]
        # What the fullest camera missed the others may still have taken together.
        rest = follow[~joins]
        _, head, at_once = np.unique(clock[rest], return_index=True, return_inverse=True)
        exposure[rest] = np.minimum(exposure[rest], exposure[rest[head[at_once]]])
    return exposure
