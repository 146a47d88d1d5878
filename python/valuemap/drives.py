"""Driving order, told once: which images are one drive, in which order, and from which places they were taken.

All that follows looks only at times, numbers in names, poses and which images share a pass and a camera; never at
the values of ids, the order of rows or what passes are called. Images are put into an order of their own first (by
time, then place), and all ties are broken by it.

1. *Streams*: the images of one camera in one pass.
2. *Rigs*: streams that expose together, each always in the same place seen from the other, are cameras of one
   vehicle. Their images share exposures.
3. *Order*: the exposures of a vehicle by time, else by the numbers in their names, else along the chain of nearest
   poses. An order that makes the way clearly longer than the chain is not believed.
4. *Drives*: the order is cut where time or place jumps, and where the vehicle comes back to where it was.
5. *Viewpoints*: a new one begins where the camera has moved more than a step since the last one began.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints, bounds, rows_in_runs
from valuemap.arrow import no_texts, take_texts
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.connected import connected
from valuemap.dataset import Dataset, rows_of
from valuemap.tables import Detections, Images

_MOST_CAMERAS = 16
"""More images of one camera and pass with one time than this are no rig: the time is a date, and tells no order."""
_LEAST_EXPOSURES = 3
"""Two cameras must expose together this often before their places relative to each other can be said to be constant."""
_LEAST_SHARE_ON_RIGS = 0.2
"""A part of the names in which fewer images than this share differ alone names no cameras."""
_LEAST_NAMESAKES = 8
"""The same by names: fewer names agree by chance."""
_SAME_LOOK_COSINE = float(np.cos(np.radians(10.0)))
"""Two cameras that look less than this apart look the same way."""
_WINDOW = 16
"""Exposures in a row that are looked at together: in random order their way is 5.7 times as long as they are wide."""
_CLEARLY_LONGER = 2.0
"""An order whose way is longer than the chain of nearest poses by this factor is none."""
_NEIGHBORS = 8
"""Nearest poses that a pose may be chained to in one round."""
_GAP_STEPS = 10.0
"""A step longer than this many usual ones is a jump, if the time it took does not explain it."""
_JUMP_SPEEDS = 3.0
"""Faster than this many usual speeds nobody drives."""
_PAUSE_STEPS = 100.0
"""Who was away for longer than this many usual steps take, and comes back elsewhere, drives anew."""
_STOP_STEPS = 1000.0
"""Who stood for longer than this many usual steps take drives anew: no light is red for that long."""
_REVISIT_STEPS = 5.0
"""Nearer than this many usual steps is the same place: opposite lanes are, parallel streets are not."""
_AWAY_STEPS = 30.0
"""Who drove this many usual steps between two visits of a place had left it."""
_STILL_SHARE = 1.0 / 3.0
"""A step shorter than this share of a usual one is no way made: poses of a standing car tremble."""

_STEADY_SHARE = 0.5
"""A place that varies by less than this share of the way from image to image is constant."""
_ROUNDING = 1e-6
"""What is constant to this share of the way is constant."""

_PARTS_OF_A_METRE = 2.0**26
"""Ways are summed in such parts: sums of a whole fleet, 130,000 km, are exact."""

TIME, NAME, CHAIN = 0, 1, 2
_TOLD_BY = ("time", "name", "chain")
_DIGITS = re.compile("([0-9]+)")


@dataclass(frozen=True, eq=False)
class Drives:
    """The drives, for each image (N) in the order of the images table.

    `pass_code` numbers the drives from 0 by their first time, then first place; `order` is the place of the image's
    exposure within its drive, from 0, the same for all images of one exposure of a rig; `driven_m` is how far the
    drive had come where its viewpoint began; `viewpoint` numbers the viewpoints of all drives, along the drives.
    `record` says in numbers what was found, for `valuemap info` and `run.json`: `passes` given, `drives` made of
    them, `cut_at` (why there are more), `images_ordered_by` (how the order was told), `rigs` and `images_on_rigs`.
    """

    pass_code: Ints
    order: Ints
    driven_m: Floats
    viewpoint: Ints
    record: dict[str, Any]

    @property
    def count(self) -> int:
        """The number of drives."""
        return int(self.pass_code.max(initial=-1)) + 1

    def take(self, rows: Ints | Bools) -> Drives:
        """Return what some images have, by their rows or by a mask; drives and viewpoints keep their numbers."""
        return Drives(self.pass_code[rows], self.order[rows], self.driven_m[rows], self.viewpoint[rows], self.record)


def find_drives(images: Images, *, viewpoint_step_m: float = 1.0) -> Drives:
    """Tell which images are one drive and in which order they were taken.

    It never fails: images without any order become short drives from one to the nearest next. The result depends
    on times, poses, numbers in names, and on which images share a pass or a camera, but not on row order, nor on
    the values of ids, nor on the names of passes.

    Parameters
    ----------
    images
        The images of a dataset.
    viewpoint_step_m
        A new viewpoint begins where the camera has moved more than this since the last one began.
    """
    ways = Ways(images)
    return ways.drives(ways.usual, viewpoint_step_m=viewpoint_step_m)[0]


@dataclass(frozen=True, eq=False)
class Usual:
    """What is usual among some vehicles (V): the upper quartiles of their steps, speeds and times, NaN where unknown.

    `low_m` and `high_m` (3) are between which places they drove.
    """

    step_m: Floats
    speed: Floats
    taken: Floats
    low_m: Floats
    high_m: Floats

    def __add__(self, other: Usual) -> Usual:
        return Usual(
            step_m=np.concatenate([self.step_m, other.step_m]),
            speed=np.concatenate([self.speed, other.speed]),
            taken=np.concatenate([self.taken, other.taken]),
            low_m=np.minimum(self.low_m, other.low_m),
            high_m=np.maximum(self.high_m, other.high_m),
        )

    @property
    def ground_axes(self) -> Ints:
        """The two axes along which places differ most."""
        return np.sort(np.argsort(self.low_m - self.high_m, kind="stable")[:2])


class Ways:
    """The ways of vehicles: their images in driving order, not yet cut into drives.

    Of a dataset larger than memory these are the ways of some vehicles; what is `usual` among all of them then says how
    they are cut.
    """

    def __init__(self, images: Images) -> None:
        self._shots = shots = _Shots.of(images)
        vehicle, exposure, self._rigs = _vehicles(shots)
        self._first = first = np.flatnonzero(exposure == np.arange(len(exposure)))
        self._exposure_of_shot = (np.cumsum(exposure == np.arange(len(exposure))) - 1)[exposure]
        self._track = track = _order_exposures(shots, vehicle[first], first)
        self._place_m = shots.center_m.take(first[track.exposure], axis=0)
        self._steps = _Steps.of(self._place_m, track)
        low_m, high_m = bounds(self._place_m)
        step_m, speed, taken = (
            _quantiles(values, track.group, 0.75)
            for values in (self._steps.step_m, self._steps.speed, self._steps.taken)
        )
        self.usual = Usual(step_m, speed, taken, low_m, high_m)

    def drives(self, usual: Usual, *, viewpoint_step_m: float = 1.0) -> tuple[Drives, Ints]:
        """Cut the ways where something unusual happens; return the drives, and the first image (row) of each."""
        shots, first, track, place_m = self._shots, self._first, self._track, self._place_m
        cut = _cuts(place_m, track, self._steps, self.usual, usual)
        drive = np.cumsum(cut.any_of) - 1

        # Numbered by first time, then place, which is what the order of the shots is.
        starts = np.flatnonzero(cut.any_of)
        rank = np.empty(len(starts), np.int64)
        earliest = np.minimum.reduceat(first[track.exposure], starts) if len(starts) else starts
        rank[np.argsort(earliest, kind="stable")] = np.arange(len(starts))
        along = np.argsort(rank[drive], kind="stable")
        drive, place_m, exposure_along = rank[drive][along], place_m.take(along, axis=0), track.exposure[along]
        begins = _begins(drive)
        order = _since(begins)
        opens = _core.viewpoint_openings(place_m, begins, viewpoint_step_m)
        driven_m = _driven_m(place_m, begins, opens)

        position = np.empty(len(first), np.int64)
        position[exposure_along] = np.arange(len(first))
        of_row = np.empty(len(shots), np.int64)
        of_row[shots.row] = position[self._exposure_of_shot]
        told_by = np.empty(len(first), np.int64)
        told_by[track.exposure] = track.told_by
        told = np.bincount(told_by[self._exposure_of_shot], minlength=3)
        record = {
            "passes": int(np.count_nonzero(np.bincount(shots.images.pass_id.codes))),
            "drives": len(starts),
            "cut_at": cut.counts,
            "images_ordered_by": {name: int(n) for name, n in zip(_TOLD_BY, told, strict=True) if n},
            "rigs": self._rigs,
            "images_on_rigs": int(np.sum(np.bincount(self._exposure_of_shot)[self._exposure_of_shot] > 1)),
        }
        drives = Drives(drive[of_row], order[of_row], driven_m[of_row], (np.cumsum(opens) - 1)[of_row], record)
        return drives, shots.row[np.sort(earliest)]


def are_dates(images: Images) -> Bools:
    """Return the images (N) whose timestamps tell no order: of passes that have many images of a camera at one time."""
    if images.timestamp_s is None:
        return np.zeros(len(images), np.bool_)
    return _is_a_date(images, images.timestamp_s)


# Images in an order of their own.


@dataclass(frozen=True, eq=False)
class _Shots:
    """The images (N) by time, then place: `row` in the images table, and what tells them apart."""

    images: Images
    row: Ints
    center_m: Floats
    time_s: Floats
    given: Ints
    camera: Ints

    def __len__(self) -> int:
        return len(self.row)

    @classmethod
    def of(cls, images: Images) -> _Shots:
        center_m = camera_centers(images)
        time_s = np.full(len(images), np.nan) if images.timestamp_s is None else images.timestamp_s
        time_s = np.where(_is_a_date(images, time_s), np.nan, time_s)
        row = np.argsort(time_s, kind="stable")
        tie = _equal_to_next(time_s[row])
        for key in (*center_m.T, *images.cam_from_world_quat.T):
            if not tie.any():
                break
            row, tie = _break_ties(row, tie, key)
        if tie.any():
            names = np.array(images.name.to_pylist())
            row, tie = _break_ties(row, tie, names)
        # Numbered by first appearance: neither names nor ids matter.
        is_timed = ~np.isnan(time_s[row])
        given = _by_first(images.pass_id.codes[row].astype(np.int64) * 2 + is_timed)
        camera = _by_first(images.camera_id[row])
        return cls(images, row, center_m.take(row, axis=0), time_s[row], given, camera)

    @cached_property
    def _parts_of_untimed(self) -> _NameParts:
        return _NameParts(self.names(np.flatnonzero(np.isnan(self.time_s))))

    def name_parts(self, shots: Ints) -> _NameParts:
        """Return the names of some, cut into texts and numbers; those of all without a time are cut only once."""
        timed = ~np.isnan(self.time_s)
        if timed[shots].any():
            return _NameParts(self.names(shots))
        return self._parts_of_untimed.take(shots - np.cumsum(timed)[shots])

    def names(self, shots: Ints) -> list[str]:
        """Return the names of some."""
        return list(take_texts(self.images.name, self.row[shots]).to_pylist())

    def cam_from_world(self, shots: Ints) -> Floats:
        """Return the rotations (N, 3, 3) of some."""
        return rotation_matrices(self.images.take(self.row[shots]))


def _is_a_date(images: Images, time_s: Floats) -> Bools:
    """Return the images (N) of passes that have many images of one camera at one time."""
    order = np.argsort(time_s, kind="stable")
    ordered = time_s[order]
    same = np.concatenate([ordered[1:] == ordered[:-1], [False]])[: len(order)]  # What has no time shares none.
    if not same.any():
        return np.zeros(len(images), np.bool_)
    tied = order[same | np.concatenate([[False], same[:-1]])]
    pass_code, camera = images.pass_id.codes[tied].astype(np.int64), images.camera_id[tied]
    at_once = np.stack([pass_code, camera, np.unique(time_s[tied], return_inverse=True)[1]])
    groups, count = np.unique(at_once, axis=1, return_counts=True)
    dated = np.zeros(len(images.pass_id.names), np.bool_)
    dated[groups[0, count > _MOST_CAMERAS]] = True
    return dated[images.pass_id.codes]


def _equal_to_next(values: NDArray[Any]) -> Bools:
    """Return which of sorted values (N) equal the next one (N - 1); none follows none."""
    same: Bools = values[1:] == values[:-1]
    if values.dtype.kind == "f":
        same |= np.isnan(values[1:]) & np.isnan(values[:-1])
    return same


def _break_ties(row: Ints, tie: Bools, key: NDArray[Any]) -> tuple[Ints, Bools]:
    """Sort rows that tie with their neighbors by a further key (of all rows), and return what still ties."""
    group = np.concatenate([[0], np.cumsum(~tie)])
    place = np.flatnonzero(np.concatenate([tie, [False]]) | np.concatenate([[False], tie]))
    values = key[row[place]]
    if values.dtype.kind == "U":
        values = np.unique(values, return_inverse=True)[1]
    row = row.copy()
    row[place] = row[place][np.lexsort((values, group[place]))]
    tie = tie.copy()
    tied = np.flatnonzero(tie)
    tie[tied] = key[row[tied]] == key[row[tied + 1]]
    return row, tie


def _by_first(codes: Ints) -> Ints:
    """Return codes (N) numbered by their first appearance."""
    if not len(codes):
        return codes.astype(np.int64)
    low, high = int(codes.min()), int(codes.max())
    if high - low > 4 * len(codes):
        codes = np.unique(codes, return_inverse=True)[1]
        low, high = 0, int(codes.max())
    first = np.full(high - low + 1, len(codes))
    first[codes[::-1] - low] = np.arange(len(codes))[::-1]  # The last assignment stays: that of the first.
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[codes - low]


# Rigs: cameras of one vehicle.


def _vehicles(shots: _Shots) -> tuple[Ints, Ints, int]:
    """Return the vehicle (N) of each shot, the first shot (N) of its exposure, and the number of rigs."""
    stream = _streams(shots)
    clock = shots.time_s.copy()
    timed = ~np.isnan(clock)
    pairs = [_rig_pairs(shots, np.flatnonzero(timed), clock, stream, by_name=False)]
    untimed = np.flatnonzero(~timed)
    if len(untimed):
        clock[untimed], part, found = _rigs_by_name(shots, untimed, stream)
        stream = _by_first(stream * (int(part.max()) + 1) + part)
        pairs.append(found)
    i, j = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    streams = int(stream.max(initial=-1)) + 1
    exposure = np.arange(len(shots))
    rig_id = shots.images.rig_id
    if rig_id is not None:
        rig = _by_first(rig_id[shots.row])
        _, first = np.unique(rig, return_index=True)
        exposure = first[rig]
        i, j = np.concatenate([i, exposure]), np.concatenate([j, np.arange(len(shots))])
    given_of_stream = np.empty(streams, np.int64)
    given_of_stream[stream] = shots.given
    if not len(i):
        return shots.given, exposure, 0
    rig_of_stream = connected(stream[i], stream[j], streams)
    exposure = _expose_together(clock, stream, rig_of_stream, exposure)
    given = connected(shots.given[i], shots.given[j], int(shots.given.max()) + 1)
    on_rig = np.bincount(rig_of_stream, minlength=streams)
    return _by_first(given[shots.given]), exposure, int(np.sum(on_rig > 1))


def _streams(shots: _Shots) -> Ints:
    """Return the stream (N) of each shot: its pass, camera, and which of several at one time it is."""
    cameras = int(shots.camera.max(initial=0)) + 1
    stream = _by_first(shots.given * cameras + shots.camera) if cameras > 1 else shots.given
    if cameras > 1:
        # A camera for each image, as some reconstructions have it, tells no cameras apart.
        images = np.bincount(shots.given)
        _, first = np.unique(stream, return_index=True)
        streams = np.bincount(shots.given[first], minlength=len(images))
        alone = (2 * streams > images)[shots.given]
        stream = _by_first(np.where(alone, shots.given, int(shots.given.max()) + 1 + stream))
    tie = _equal_to_next(shots.time_s) & ~np.isnan(shots.time_s[1:])
    if not tie.any():
        return stream
    # Several at one time of what looks like one camera: told apart by their names.
    group = np.concatenate([[0], np.cumsum(~tie)])
    tied = np.flatnonzero(np.concatenate([tie, [False]]) | np.concatenate([[False], tie]))
    name = np.unique(np.array(shots.names(tied)), return_inverse=True)[1]
    tied = tied[np.lexsort((name, stream[tied], group[tied]))]
    begins = np.concatenate([[True], (np.diff(group[tied]) != 0) | (np.diff(stream[tied]) != 0)])
    rank = np.zeros(len(shots), np.int64)
    rank[tied] = _since(begins)
    return _by_first(stream * (int(rank.max()) + 1) + rank)


def _rig_pairs(
    shots: _Shots, members: Ints, clock: Floats, stream: Ints, *, by_name: bool, by_number: bool = False
) -> tuple[Ints, Ints]:
    """Return pairs of shots that two cameras of one rig took together.

    Two streams are of one rig if, where they expose within half the time between two exposures of each, the place of
    the one seen from the other is constant, measured by how far the vehicle moves from image to image. Two drives by
    one camera that looks the same way are no rig where only numbers in their names or their places agree.
    """
    members = members[np.argsort(clock[members], kind="stable")]
    if not len(members) or stream[members].min() == stream[members].max():
        return members[:0], members[:0]
    time, of = clock[members], stream[members]
    cadence, step_m = _own_cadence(time, of, shots.center_m.take(members, axis=0))
    found = []
    for lag in range(1, min(_MOST_CAMERAS, len(members))):
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
        by_stream = _sort_codes(of)
        codes = np.unique(of, return_inverse=True)[1]
        often &= _is_a_way(shots.center_m[members[by_stream]], of[by_stream])[codes[pair[0]]]
    pair, group = pair[:, often], group[often]
    if not pair.shape[1]:
        return members[:0], members[:0]
    a, b = members[pair[0]], members[pair[1]]
    rotation_a, rotation_b = shots.cam_from_world(a), shots.cam_from_world(b)
    offset_m = np.einsum("nij,nj->ni", rotation_a, shots.center_m[b] - shots.center_m[a])
    cosine = (np.einsum("nij,nij->n", rotation_a, rotation_b) - 1.0) / 2.0
    group = np.unique(group, return_inverse=True)[1]
    middle_m = np.stack([_quantiles(axis_m, group, 0.5) for axis_m in offset_m.T], axis=1)
    spread_m = _quantiles(np.linalg.norm(offset_m - middle_m[group], axis=1), group, 0.5)
    by_group = _sort_codes(group)
    starts = _runs(group[by_group])[:-1]
    place_m = shots.center_m[a[by_group]]
    width_m = _lengths(np.maximum.reduceat(place_m, starts) - np.minimum.reduceat(place_m, starts))
    usual_m = _quantiles(step_m[pair[0]], group, 0.5)
    apart_m = np.linalg.norm(middle_m, axis=1)
    one, other = a[by_group[starts]], b[by_group[starts]]
    one_camera = (
        (shots.camera[one] == shots.camera[other])
        & (by_number | (shots.given[one] != shots.given[other]))
        & (_quantiles(cosine, group, 0.5) > _SAME_LOOK_COSINE)
    )
    is_rig = (spread_m <= _STEADY_SHARE * usual_m + _ROUNDING * width_m) & (apart_m <= width_m)
    is_rig &= ~(one_camera & (by_name | (apart_m <= usual_m)))
    return a[is_rig[group]], b[is_rig[group]]


def _own_cadence(time: Floats, stream: Ints, center_m: Floats) -> tuple[Floats, Floats]:
    """Return for shots (N, by time) the time to the nearer neighbor in their stream, and the distance to the next."""
    order = np.argsort(stream, kind="stable")
    same = np.diff(stream[order]) == 0
    gap = np.where(same, np.diff(time[order]), np.inf)
    away_m = np.where(same, _lengths(np.diff(center_m.take(order, axis=0), axis=0)), np.nan)
    cadence, step_m = np.empty(len(order)), np.empty(len(order))
    cadence[order] = np.minimum(np.concatenate([[np.inf], gap]), np.concatenate([gap, [np.inf]]))
    before_m, after_m = np.concatenate([[np.nan], away_m]), np.concatenate([away_m, [np.nan]])
    step_m[order] = np.where(np.isnan(after_m), before_m, after_m)
    return cadence, np.nan_to_num(step_m)


def _expose_together(clock: Floats, stream: Ints, rig_of_stream: Ints, exposure: Ints) -> Ints:
    """Return the first shot (N) of each shot's exposure: that of the rig's fullest camera nearest in time."""
    rig = rig_of_stream[stream]
    cameras = np.bincount(rig_of_stream)
    shared = np.flatnonzero((cameras[rig] > 1) & (np.bincount(exposure)[exposure] == 1))  # The rest knows already.
    shared = shared[np.lexsort((clock[shared], rig[shared]))]
    if not len(shared):
        return exposure
    exposure = exposure.copy()
    for members in np.split(shared, np.flatnonzero(np.diff(rig[shared])) + 1):
        of, images = np.unique(stream[members], return_counts=True)
        leads = stream[members] == of[np.argmax(images)]
        lead, follow = members[leads], members[~leads]
        at = clock[lead]
        after = np.clip(np.searchsorted(at, clock[follow]), 1, max(len(at) - 1, 1))
        nearest = after - (clock[follow] - at[after - 1] <= np.abs(at[np.minimum(after, len(at) - 1)] - clock[follow]))
        gap = np.diff(at)
        own = np.minimum(np.concatenate([[np.inf], gap]), np.concatenate([gap, [np.inf]]))
        joins = np.abs(clock[follow] - at[nearest]) <= 0.5 * own[nearest]
        exposure[follow[joins]] = exposure[lead[nearest[joins]]]
        # What the fullest camera missed the others may still have taken together.
        rest = follow[~joins]
        _, head, at_once = np.unique(clock[rest], return_index=True, return_inverse=True)
        exposure[rest] = np.minimum(exposure[rest], exposure[rest[head[at_once]]])
    return exposure


# Numbers in names.


def _rigs_by_name(shots: _Shots, members: Ints, stream: Ints) -> tuple[Floats, Ints, tuple[Ints, Ints]]:
    """Return what names tell of shots (M): their rank, the part that names the camera (N), and pairs of rigs."""
    parts = shots.name_parts(members)
    best: tuple[Floats, Ints, tuple[Ints, Ints]] | None = None
    for column in parts.columns_that_may_name_cameras():
        rank = np.zeros(len(shots))
        rank[members] = parts.rank(without=column)
        part = np.zeros(len(shots), np.int64)
        part[members] = parts.codes[column]
        split = _by_first(stream * (int(part.max()) + 1) + part)
        found = _rig_pairs(shots, members, rank, split, by_name=True, by_number=column % 2 == 1)
        if len(found[0]) > (len(best[2][0]) if best else 0):
            best = rank[members], part, found
    none = np.empty(0, np.int64)
    return best or (parts.rank(), np.zeros(len(shots), np.int64), (none, none))


class _NameParts:
    """Names (M) cut into texts and numbers: columns of codes that sort as texts and numbers do."""

    def take(self, rows: Ints) -> _NameParts:
        """Return some of them."""
        part = _NameParts([])
        part._length = self._length[rows]
        part.codes = [codes[rows] for codes in self.codes]
        part.numbers = [numbers[rows] for numbers in self.numbers]
        return part

    def __init__(self, names: Sequence[str]) -> None:
        parts = [_DIGITS.split(name) for name in names]
        self._length = np.array([len(part) for part in parts])
        self.codes: list[Ints] = []
        self.numbers: list[Floats] = []
        for column in range(int(self._length.max(initial=0))):
            cells = [part[column] if column < len(part) else "" for part in parts]
            values = {cell: (0, cell) for cell in set(cells)}
            if column % 2:  # Numbers of any length: without leading zeros, the longer one is more.
                values = {cell: (len(cell.lstrip("0")), cell.lstrip("0")) for cell in values}
            rank = {value: i for i, value in enumerate(sorted(set(values.values())))}
            self.codes.append(np.array([rank[values[cell]] for cell in cells], dtype=np.int64))
            numbers = {cell: float(cell) if column % 2 and cell else np.nan for cell in values}
            self.numbers.append(np.array([numbers[cell] for cell in cells]))

    def rank(self, *, without: int | None = None) -> Floats:
        """Return the rank (M) in natural order; names that differ in one column only may have the same."""
        keys = [codes for column, codes in enumerate(self.codes) if column != without]
        keys.insert(0, self._length)
        order = np.lexsort(keys[::-1])
        differs = np.zeros(len(order), np.bool_)
        for key in keys:
            differs[1:] |= key[order][1:] != key[order][:-1]
        rank = np.empty(len(order))
        rank[order] = np.cumsum(differs)
        return rank

    def columns_that_may_name_cameras(self) -> list[int]:
        """Return the columns without which a good part of the names is the same as some others, but not as many."""
        columns = []
        for column, codes in enumerate(self.codes):
            if codes.any():
                alike = np.bincount(self.rank(without=column).astype(np.int64))
                on_rig = alike[(alike > 1) & (alike <= _MOST_CAMERAS)].sum()
                if on_rig > _LEAST_SHARE_ON_RIGS * len(codes):
                    columns.append(column)
        return columns

    def numbers_passed(self, order: Ints) -> Floats:
        """Return by how much (M) a number grew since the name before in an order, NaN where more than it changed."""
        varying = [column for column, codes in enumerate(self.codes) if len(codes) and np.ptp(codes) > 0]
        passed = np.full(len(order), np.nan)
        if varying and varying[-1] % 2 == 1:
            passed[1:] = np.diff(self.numbers[varying[-1]][order])
            for column in varying[:-1]:
                passed[1:][np.diff(self.codes[column][order]) != 0] = np.nan
        return passed


# The order of the exposures of a vehicle.


@dataclass(frozen=True, eq=False)
class _Track:
    """Exposures (E) one after the other, vehicle after vehicle.

    `exposure` indexes what was put in order; `group` numbers the vehicles, ascending; `taken` is how long it is since
    the exposure before, in seconds or by a running number, NaN where nothing tells; `told_by` is how the order was
    told.
    """

    exposure: Ints
    group: Ints
    taken: Floats
    told_by: Ints


def _order_exposures(shots: _Shots, vehicle: Ints, first: Ints) -> _Track:
    """Return the exposures (first shots, E) of vehicles (E) in driving order."""
    by_vehicle = _sort_codes(vehicle)
    place_m, time_s = shots.center_m.take(first, axis=0), shots.time_s[first]
    runs = _runs(vehicle[by_vehicle])
    ordered, told_by = by_vehicle.copy(), np.zeros(len(first), np.int64)
    taken = np.diff(time_s[by_vehicle], prepend=np.nan)
    believed = _is_a_way(place_m.take(by_vehicle, axis=0), vehicle[by_vehicle])
    believed &= ~np.isnan(time_s[by_vehicle[runs[:-1]]])
    group = vehicle[by_vehicle].astype(np.int64)
    pieces: list[_Track] = []
    for number in np.flatnonzero(~believed):
        place = slice(runs[number], runs[number + 1])
        members = by_vehicle[place]
        found = _order_vehicle(shots, members, first, place_m)
        ordered[place], taken[place], told_by[place] = found.exposure, found.taken, found.told_by
        pieces.append(found)
    # A vehicle whose cameras go each their own way is several.
    extra = np.zeros(len(first), np.int64)
    for number, found in zip(np.flatnonzero(~believed), pieces, strict=True):
        extra[runs[number] : runs[number + 1]] = found.group
    steps = np.concatenate([[0], (np.diff(group) != 0) | (np.diff(extra) != 0)]) if len(group) else group
    return _Track(ordered, np.cumsum(steps), taken, told_by)


def _order_vehicle(shots: _Shots, members: Ints, first: Ints, place_m: Floats) -> _Track:
    """Return some exposures (of all, E) in driving order, told by time, names or the chain, whichever is plausible."""
    time_s = shots.time_s[first[members]]
    none = np.full(len(members), np.nan)
    zero = np.zeros(len(members), np.int64)
    chain: Ints | None = None

    def is_believed(order: Ints) -> bool:
        nonlocal chain
        way = place_m[members[order]]
        if _is_a_way(way, zero).all():
            return True
        chain = _chain(place_m[members]) if chain is None else chain
        return _way_m(way) <= _CLEARLY_LONGER * _way_m(place_m[members[chain]])

    if not np.isnan(time_s).any() and is_believed(np.arange(len(members))):
        return _Track(members, zero, np.diff(time_s, prepend=np.nan), zero + TIME)
    camera = shots.camera[first[members]]
    if len(np.unique(camera)) > 1 and 2 * len(np.unique(camera)) <= len(members):
        parts = [
            _order_vehicle(shots, members[camera == code], first, place_m) for code in dict.fromkeys(camera.tolist())
        ]
        if not any(np.any(part.told_by == CHAIN) for part in parts):
            offset = np.cumsum([0, *(int(part.group.max()) + 1 for part in parts)])
            return _Track(
                np.concatenate([part.exposure for part in parts]),
                np.concatenate([part.group + start for part, start in zip(parts, offset, strict=False)]),
                np.concatenate([part.taken for part in parts]),
                np.concatenate([part.told_by for part in parts]),
            )
    parts_of_names = shots.name_parts(first[members])
    by_name = np.argsort(parts_of_names.rank(), kind="stable")
    if is_believed(by_name):
        return _Track(members[by_name], zero, parts_of_names.numbers_passed(by_name), zero + NAME)
    chain = _chain(place_m[members]) if chain is None else chain
    return _Track(members[chain], zero, none, zero + CHAIN)


def _sort_codes(codes: Ints) -> Ints:
    """Return a stable order of codes from 0."""
    # Numbers of 16 bits are sorted by counting.
    small = codes.astype(np.uint16) if len(codes) and codes.max() < 2**16 else codes
    return np.argsort(small, kind="stable")


def _quantiles(values: Floats, group: Ints, share: float) -> Floats:
    """Return for each group from 0 the value below which this share of its values (N) lies; NaN values do not count.

    Values are rounded to single precision: then one sort of whole numbers, by group and value, does it.
    """
    is_nan = np.isnan(values)
    bits = (values + 0.0).astype(np.float32).view(np.uint32)  # No -0; bits of positive numbers sort as these do.
    bits ^= (bits.view(np.int32) >> 31).view(np.uint32) | np.uint32(2**31)  # Of negative ones all bits, else the sign.
    bits[is_nan] = 2**32 - 1
    keys = np.sort((group.astype(np.uint64) << np.uint64(32)) | bits)
    groups = int(group.max(initial=-1)) + 1
    size = np.bincount(group, minlength=groups)
    number = size - np.bincount(group[is_nan], minlength=groups)
    some = np.flatnonzero(number)
    at = (np.cumsum(size) - size)[some] + (share * (number[some] - 1) + 0.5).astype(np.int64)
    found = keys[at].astype(np.uint32)
    found ^= np.where(found >> 31, 2**31, 2**32 - 1).astype("u4")
    quantile = np.full(groups, np.nan)
    quantile[some] = found.view(np.float32)
    return quantile


def _lengths(vectors: Floats) -> Floats:
    """Return the lengths (N) of vectors (N, 3)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))  # Several times as fast as the norm of NumPy.


def _steps_m(place_m: Floats) -> Floats:
    """Return how far each of some places (N, 3) in a row is from the one before, the first 0."""
    step_m = np.zeros(len(place_m))
    step_m[1:] = _lengths(place_m[1:] - place_m[:-1])
    return step_m


def _summed_m(step_m: Floats) -> Floats:
    """Return the way up to each of some steps (N), to 15 nm: then no sum depends on other drives."""
    return np.asarray(np.cumsum(np.rint(step_m * _PARTS_OF_A_METRE).astype(np.int64)) / _PARTS_OF_A_METRE)


def _begins(values: Ints) -> Bools:
    """Return where (N) runs of equal values begin."""
    begins = np.ones(len(values), np.bool_)
    np.not_equal(values[1:], values[:-1], out=begins[1:])
    return begins


def _since(begins: Bools) -> Ints:
    """Return how many rows (N) it is since the last one where something begins, as it does in the first."""
    return rows_in_runs(0, np.diff(np.append(np.flatnonzero(begins), len(begins))))


def _runs(values: Ints) -> Ints:
    """Return where runs of equal values begin, and the end."""
    return np.append(np.flatnonzero(_begins(values)), len(values))


def _is_a_way(place_m: Floats, group: Ints) -> Bools:
    """Return for each group of places (N, 3) in a row whether they surely are in driving order.

    No order is shorter than its places are wide. So one that, cut into short windows, is little longer than these
    windows are wide, goes ahead nearly everywhere.
    """
    runs = _runs(group)
    starts = np.flatnonzero(rows_in_runs(0, np.diff(runs)) % _WINDOW == 0)
    if not len(starts):
        return np.empty(0, np.bool_)
    step_m = _steps_m(place_m)
    step_m[starts] = 0.0
    way_m = np.add.reduceat(step_m, starts)
    width_m = _lengths(np.maximum.reduceat(place_m, starts) - np.minimum.reduceat(place_m, starts))
    of = np.searchsorted(runs, starts, side="right") - 1
    groups = len(runs) - 1
    ways_m, widths_m = np.bincount(of, way_m, groups), np.bincount(of, width_m, groups)
    return np.asarray(ways_m <= _CLEARLY_LONGER * widths_m)


def _way_m(place_m: Floats) -> float:
    """Return the length of a way along places (N, 3)."""
    return float(_steps_m(place_m).sum())


def _chain(place_m: Floats) -> Ints:
    """Return places (N, 3) in the order of a short way through all of them: nearest ends are joined first.

    It begins at the end that is farther from the middle of all places.
    """
    from scipy.spatial import cKDTree  # Only where neither times nor names tell.

    count = len(place_m)
    if count < 3:
        return np.arange(count)
    links: list[list[int]] = [[] for _ in range(count)]
    parent = list(range(count))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    ends = np.arange(count)
    chains = count
    while chains > 1:
        tree = cKDTree(place_m[ends])
        neighbors = min(_NEIGHBORS + 1, len(ends))
        distance_m, near = map(np.asarray, tree.query(place_m[ends], k=neighbors))
        a = np.repeat(ends, neighbors)
        b = ends[near.reshape(-1)]
        low, high = np.minimum(a, b), np.maximum(a, b)
        order = np.lexsort((high, low, distance_m.reshape(-1)))
        joined = 0
        for i, j in zip(low[order].tolist(), high[order].tolist(), strict=True):
            if i != j and len(links[i]) < 2 and len(links[j]) < 2 and root(i) != root(j):
                links[i].append(j)
                links[j].append(i)
                parent[root(i)] = root(j)
                joined += 1
        chains -= joined
        ends = np.array([i for i in range(count) if len(links[i]) < 2])
        if not joined:  # All near ends are of one chain: look farther.
            ends = _one_end_each(ends, [root(i) for i in ends.tolist()])
    tips = [i for i in range(count) if len(links[i]) == 1]
    middle_m = place_m.mean(axis=0)
    last, here = -1, max(tips, key=lambda i: (float(np.linalg.norm(place_m[i] - middle_m)), -i))
    way = [here]
    while len(way) < count:
        last, here = here, next(i for i in links[here] if i != last)
        way.append(here)
    return np.array(way)


def _one_end_each(ends: Ints, chain: list[int]) -> Ints:
    """Return one end of each chain, the first by number."""
    first: dict[int, int] = {}
    for end, of in zip(ends.tolist(), chain, strict=True):
        first.setdefault(of, end)
    return np.array(list(first.values()))


# Where one drive ends and the next begins.


@dataclass(frozen=True, eq=False)
class _Cuts:
    """Where (E) a drive begins, and why: counts by reason."""

    any_of: Bools
    counts: dict[str, int]


@dataclass(frozen=True, eq=False)
class _Steps:
    """How far (E) each exposure is from the one before in metres, in time, and both, NaN where a way begins."""

    begins: Bools
    step_m: Floats
    taken: Floats
    speed: Floats

    @classmethod
    def of(cls, place_m: Floats, track: _Track) -> _Steps:
        begins = _begins(track.group)
        step_m = _steps_m(place_m)
        step_m[begins] = np.nan
        taken = np.where(begins, np.nan, track.taken)
        with np.errstate(divide="ignore", invalid="ignore"):
            speed = step_m / np.where(taken > 0.0, taken, np.nan)
        return cls(begins, step_m, taken, speed)


def _cuts(place_m: Floats, track: _Track, steps: _Steps, own: Usual, usual: Usual) -> _Cuts:
    """Return where along the exposures (E) of vehicles drives begin.

    `own` is what is usual for each of these vehicles, `usual` for all.
    """
    begins, step_m, taken = steps.begins, steps.step_m, steps.taken
    if len(begins) < 2:
        return _Cuts(begins, {})
    usual_m, usual_speed, usual_taken = (
        _usual(getattr(own, name), getattr(usual, name))[track.group] for name in ("step_m", "speed", "taken")
    )
    timed = track.told_by == TIME
    with np.errstate(divide="ignore", invalid="ignore"):
        far = step_m > _GAP_STEPS * usual_m
        too_fast = ~(step_m <= _JUMP_SPEEDS * usual_speed * taken)  # Also where there is no clock.
        waited = taken - step_m / np.where(usual_speed > 0.0, usual_speed, np.inf)
        pause = timed & (waited > _PAUSE_STEPS * usual_taken) & (far | (waited > _STOP_STEPS * usual_taken))
    jump = far & too_fast & ~pause
    drive = np.cumsum(begins | jump | pause)
    revisit = _revisits(place_m, drive, steps, usual_m, track.told_by != CHAIN, usual.ground_axes)
    reasons = {"pauses": pause, "jumps": jump, "revisits": revisit}
    counts = {name: int(mask.sum()) for name, mask in reasons.items() if mask.any()}
    return _Cuts(begins | jump | pause | revisit, counts)


def _usual(own: Floats, of_all: Floats) -> Floats:
    """Return what is usual for each of some vehicles: the upper quartile, which neither stops nor gaps move.

    It is at least half of what is usual among all, so that one that mostly stands has the speed of the others.
    """
    known = of_all[~np.isnan(of_all)]
    floor = 0.5 * np.median(known) if len(known) else np.nan
    return np.asarray(np.maximum(own, floor))


def _revisits(place_m: Floats, drive: Ints, steps: _Steps, usual_m: Floats, may: Bools, ground: Ints) -> Bools:
    """Return where (E) a drive comes back to where it has been, having left: what follows is a drive of its own.

    A place is as wide as some usual steps, on the ground (the axes `ground`).
    """
    near_m = np.where((usual_m > 0.0) & may, _REVISIT_STEPS * usual_m, np.nan)
    way_m = _summed_m(np.where(steps.step_m > _STILL_SHARE * usual_m, steps.step_m, 0.0))
    return _core.revisits(place_m, drive, way_m, near_m, _AWAY_STEPS * usual_m, ground.tolist())


# Viewpoints.


def _driven_m(place_m: Floats, begins: Bools, opens: Bools) -> Floats:
    """Return how far (E) drives had come where the viewpoint of each exposure began."""
    start = np.flatnonzero(opens)
    way_m = _steps_m(place_m.take(start, axis=0))
    way_m[begins[start]] = 0.0
    total_m = _summed_m(way_m)
    at_begin_m = np.maximum.accumulate(np.where(begins[start], total_m, 0.0))
    return np.asarray((total_m - at_begin_m)[np.cumsum(opens) - 1])


@dataclass(frozen=True, eq=False)
class InOrder:
    """A dataset in driving order: images and detections are numbered by their rows; the ids (N) are those they had."""

    dataset: Dataset
    drives: Drives
    image_id: Ints
    detection_id: Ints

    @cached_property
    def first_detection(self) -> Ints:
        """The first detection (row) of each image (N), and behind the last one how many there are (N + 1)."""
        count = np.bincount(self.dataset.detections.image_id, minlength=len(self.dataset.images))
        return np.concatenate([[0], np.cumsum(count)])

    def rows_of_images(self, image_id: Ints) -> Ints:
        """Return the rows (M) of images by the ids (M) they had, all of which must be there."""
        return _rows_by_id(image_id, self.image_id)

    def rows_of_detections(self, detection_id: Ints) -> Ints:
        """Return the rows (M) of detections by the ids (M) they had, all of which must be there."""
        return _rows_by_id(detection_id, self.detection_id)


def _rows_by_id(ids: Ints, keys: Ints) -> Ints:
    """Return the row in unique `keys` (N), in any order, of each of `ids` (M)."""
    by_id = np.argsort(keys)
    return by_id[rows_of(ids, keys[by_id])]


def driving_order(images: Images, drives: Drives) -> Ints:
    """Return the rows of images (N) along their drives, those of one exposure by place and direction."""
    order = drives.pass_code * (int(drives.order.max(initial=0)) + 1) + drives.order
    if not np.any(np.diff(order) <= 0):
        return np.arange(len(order))
    return np.lexsort((*images.cam_from_world_m.T, *images.cam_from_world_quat.T, order))


def from_left_to_right(detections: Detections, image_row: Ints) -> Ints:
    """Return the rows of detections by image (N), then from left to right; of one box by class, then score.

    Only what is the same in all of that is told apart by ids.
    """
    box = (*detections.size_px.T[::-1], *detections.center_px.T[::-1], image_row)
    rows = np.lexsort(box)
    same = np.arange(len(rows) - 1)
    for key in box[::-1]:
        same = same[key[rows[same]] == key[rows[same + 1]]]
    if not len(same):  # As nearly always.
        return rows
    return np.lexsort((detections.detection_id, detections.score, detections.class_name.codes, *box))


def in_driving_order(dataset: Dataset, *, viewpoint_step_m: float = 1.0, keeps_names: bool = True) -> InOrder:
    """Return a dataset with its rows in an order that ids, names and the order of rows do not change.

    Images follow the drives, those of one exposure by place and direction; the detections of an image go from left
    to right, those of one box by class and score. Without `keeps_names` those of images are empty.
    """
    images, detections = dataset.images, dataset.detections
    drives = find_drives(images, viewpoint_step_m=viewpoint_step_m)
    if not keeps_names:
        images = images.replace(name=no_texts(len(images)))
    image_row = rows_of(detections.image_id, images.image_id)
    rows = driving_order(images, drives)
    if np.any(np.diff(rows) <= 0):
        images = images.take(rows)
        drives = drives.take(rows)
        rank = np.empty(len(rows), dtype=np.int64)
        rank[rows] = np.arange(len(rows))
        image_row = rank[image_row]
    x, step = detections.center_px[:, 0], np.diff(image_row)
    if np.any((step < 0) | ((step == 0) & (np.diff(x) <= 0))):
        rows = from_left_to_right(detections, image_row)
        detections, image_row = detections.take(rows), image_row[rows]
    image_id, detection_id = images.image_id, detections.detection_id
    images = images.replace(image_id=np.arange(len(images)))
    detections = detections.replace(detection_id=np.arange(len(detections)), image_id=image_row)
    return InOrder(replace(dataset, images=images, detections=detections), drives, image_id, detection_id)
