"""Faults of passes and time: what is one drive, in which order, when, and where against the other drives."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import Rays, camera_centers, rotation_matrices
from valuemap.check.agreement import chance_of_majority, compare, measure_agreement
from valuemap.check.boxes import rows_in_images
from valuemap.check.fault import (
    AGAINST,
    FAR_WORSE,
    GATE_RAD,
    LEAST_CHANCE,
    LEAST_RISE,
    Convention,
    Fault,
    Finding,
    Fix,
    Stage,
    View,
    once_a_view,
    with_centers,
    with_detections,
    with_images,
)
from valuemap.check.headings import driving_azimuths
from valuemap.check.offsets import densest, pairs_within
from valuemap.check.quality import flattened
from valuemap.check.sample import (
    FASTER,
    drive_of_camera,
    driving_order,
    order_by_camera,
    standing_m,
    steps_along_drives,
)
from valuemap.check.seams import Seam, worst_seam
from valuemap.dataset import Dataset
from valuemap.tables import Categories, Images

_JUMP_TIMES = 8.0
"""A step this many times the distance to the nearest image of the pass is none that a car drove."""
_MOST_JUMPS = 0.25
_TURNS = 6
_LAGS = range(1, _TURNS + 1)
"""At most so many drives take turns under one pass id."""
_LEAST_IMAGES = 10
_SAME_WAY = 0.7
"""Cosine between the axes of cameras that may be of one drive: up to 45 degrees."""
_TIME_UNITS = (("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))
_SPEEDS_MPS = (0.2, 70.0)
SEARCH_STEPS = 8.0
"""How far a pass may be off, in median steps between images."""
_MOST_PASSES = 60
_MOST_CANDIDATES = 6
_LEAST_PAIRS = 4


class ShiftedDetections(Convention):
    """Detections that belong to the image before or after."""

    name: ClassVar[str] = "detections_shifted"
    what: ClassVar[str] = (
        "The detections belong to other images than those they are listed with: the next or the last one."
    )
    do: ClassVar[str] = "Match detections and images by name, not by their place in a list (one counts from 1?)."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield detections moved by one image along each pass and camera; by more, that is a shift in time."""
        yield "detections of the next image", _ByImages(1)
        yield "detections of the image before", _ByImages(-1)


class TimeUnit(Fault):
    """Time stamps that are not seconds."""

    name: ClassVar[str] = "time_unit"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """See whether another unit of time gives a speed that a car has."""
        speed = median_speed_mps(view)
        if speed is None or _SPEEDS_MPS[0] <= speed <= _SPEEDS_MPS[1]:
            return None
        for unit, seconds in _TIME_UNITS:
            if _SPEEDS_MPS[0] <= speed / seconds <= _SPEEDS_MPS[1]:
                return Finding(
                    fault=self.name,
                    what=f"The time stamps are {unit}, not seconds.",
                    why=f"Images would move at {speed:.2g} m/s (median); in {unit} it is {speed / seconds:.3g} m/s.",
                    do="Write seconds.",
                    figures={"speed_mps": speed, "unit": unit},
                    fix=partial(_with_times_scaled, factor=seconds),
                )
        return None


def _with_times_scaled(dataset: Dataset, *, factor: float) -> Dataset:
    return with_images(dataset, timestamp_s=np.asarray(dataset.images.timestamp_s) * factor)


class RollingTimes(Fault):
    """Time stamps that start over within a drive."""

    name: ClassVar[str] = "rolling_times"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Follow each pass by the names of its images and look for time that falls back by one and the same amount."""
        period = _rolling_period(view.dataset)
        if period is None:
            return None
        length, falls = period
        return Finding(
            fault=self.name,
            what="The time stamps start over within drives.",
            why=f"Along the images of single passes, in the order of their names, time falls back {falls} times, "
            f"and all time stamps are within {length:.4g} s.",
            do=f"Add {length:.4g} s at every fall (a counter of seconds within the minute, hour or week?).",
            figures={"period_s": round(length, 4), "falls": falls},
            fix=_unrolled,
        )


class InterleavedPasses(Fault):
    """Several vehicles or cameras under one pass id."""

    name: ClassVar[str] = "interleaved_passes"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Look for passes that jump to and fro between few drives."""
        return _find_jumping(view, self.name, is_interleaved=True)


class NoDrives(Fault):
    """Passes that are not drives."""

    name: ClassVar[str] = "passes_no_drives"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Look for passes whose images are in no order that a car drove, or that take turns along one drive."""
        return _find_in_turn(view, self.name) or _find_jumping(view, self.name, is_interleaved=False)


@dataclass(frozen=True, eq=False)
class PassShift:
    """How far what one pass sees is from what the others see.

    `offset_m` (3) takes the pass's own objects to those of the others, in the world; of a shift along the drive it is
    (forward, left, up). `gain` is how well its rays meet the others' points then; `chance` that good data do so. Where
    it is told from the way the poses jump where the pass goes on from another, that is the `seam`.
    """

    pass_name: str
    offset_m: Floats
    is_along: bool
    gain: float
    gain_without: float
    chance: float
    passes: int
    seam: Seam | None = None
    points: int = 0
    """How many points of the pass are where others have one, where it is told from these."""
    other: PassShift | None = None
    """The shift of another pass that explains as much, where nothing tells which of the two is off."""


OF_ITS_CAMERA = frozenset({"focal_length", "camera_tilt", "camera_yaw"})
"""Errors of a camera that no other pass has put what its pass sees elsewhere, as far away as most of it is."""


class PassOffset(Fault):
    """A pass that is off by some metres."""

    name: ClassVar[str] = "pass_offset"
    stage: ClassVar[Stage] = "fine"
    rivals: ClassVar[frozenset[str]] = OF_ITS_CAMERA
    may_be_reading: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """Take the offset of the pass that is farthest from good."""
        shift = worst_pass(view)
        if shift is None or shift.is_along or _is_vertical(view, shift.offset_m):
            return None
        return _shift_finding(
            self.name, shift, f"Pass {shift.pass_name} is off by {np.linalg.norm(shift.offset_m):.2f} m.",
            "Align it with the others (another datum, another antenna, no correction data?).",
        )  # fmt: skip


class PassTimeShift(Fault):
    """A pass whose poses are some time off its pictures."""

    name: ClassVar[str] = "pass_time_shift"
    stage: ClassVar[Stage] = "fine"
    rivals: ClassVar[frozenset[str]] = OF_ITS_CAMERA
    may_be_reading: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """Take the shift along the drive of the pass that is farthest from good."""
        shift = worst_pass(view)
        if shift is None or not shift.is_along:
            return None
        images = shift.offset_m[0] / view.step_m
        return _shift_finding(self.name, shift,
            f"The poses of pass {shift.pass_name} are {abs(shift.offset_m[0]):.2f} m along the road "
            f"({abs(images):.1f} images) {'behind' if images > 0 else 'ahead of'} its pictures.",
            "Correct the clock of this pass (leap seconds, exposure or trigger delay).",
        )  # fmt: skip


def find_height_of_pass(view: View, fault: str) -> Finding | None:
    """Take the offset of the pass that is farthest from good, if it is up or down."""
    shift = worst_pass(view)
    if shift is None or shift.is_along or not _is_vertical(view, shift.offset_m):
        return None
    up_m = float(shift.offset_m @ np.array(view.dataset.frame.up))
    return _shift_finding(fault, shift,
        f"The camera of pass {shift.pass_name} is {abs(up_m):.2f} m too {'low' if up_m > 0 else 'high'}.",
        "Correct the height of its camera above the ground, or use one datum of heights for all passes.",
    )  # fmt: skip


def median_speed_mps(view: View) -> float | None:
    """Return the median speed of images that move, None without time stamps."""
    images = view.dataset.images
    if images.timestamp_s is None or not np.all(np.isfinite(images.timestamp_s)):
        return None
    order = driving_order(images)
    step = np.linalg.norm(np.diff(view.center_in_world_m[order], axis=0), axis=1)
    seconds = np.diff(images.timestamp_s[order])
    moves = (np.diff(images.pass_id.codes[order]) == 0) & (seconds > 0.0) & (step > 0.3 * view.step_m)
    return float(np.median(step[moves] / seconds[moves])) if np.any(moves) else None


def _rolling_period(dataset: Dataset) -> tuple[float, int] | None:
    """Return after how many seconds time starts over and how often it does, None where it does not.

    Counters that start over stay within their period, and go forward but for few falls.
    """
    images = dataset.images
    if images.timestamp_s is None or not np.all(np.isfinite(images.timestamp_s)):
        return None
    order, starts = _by_name(images)
    time = images.timestamp_s[order]
    step = np.diff(time)[~starts[1:]]
    falls, forward = -step[step < 0.0], step[step > 0.0]
    if len(falls) < 1 or len(forward) < 10 or len(falls) > 0.1 * len(step):
        return None
    usual = float(np.median(forward))
    period = _rounded(float(falls.max()) + usual)
    within = np.ptp(time) <= 1.02 * period and time.min() >= -0.02 * period
    return (period, len(falls)) if within and falls.max() > 10.0 * usual else None


def _by_name(images: Images) -> tuple[Ints, Bools]:
    """Return the rows of images in the order of their names, and where (N) the next pass or camera of one begins.

    Names of a car with several cameras often are those of one camera after the other, and cameras of one kind may share
    a row of the table. So where the folder changes and the car is elsewhere at once, the next one begins, too.
    """
    order = order_by_camera(images, by_time=False)
    step_m, ends, usual_m = steps_along_drives(camera_centers(images)[order], drive_of_camera(images)[order])
    folders = [name.rpartition("/")[0] for name in images.name.take(order).to_pylist()]
    changes = np.array([first != second for first, second in itertools.pairwise(folders)], dtype=np.bool_)
    return order, np.append(True, ends | (changes & (step_m > FASTER * usual_m)))


def _unrolled(dataset: Dataset) -> Dataset:
    found = _rolling_period(dataset)
    assert found is not None
    images = dataset.images
    order, start = _by_name(images)
    time = np.asarray(images.timestamp_s)[order]
    falls = np.diff(time, prepend=time[0]) < 0.0
    falls[start] = False
    laps = np.cumsum(falls)
    laps = laps - np.repeat(laps[start], np.diff(np.append(np.flatnonzero(start), len(order))))
    unrolled = np.empty(len(order))
    unrolled[order] = time + laps * found[0]
    return with_images(dataset, timestamp_s=unrolled)


def _rounded(period: float) -> float:
    """Return the period of a counter: a round number far more often than what a fall and a step add up to."""
    for unit in (604_800.0, 86_400.0, 3_600.0, 60.0, 10.0, 1.0):
        whole = round(period / unit) * unit
        if whole > 0.0 and abs(whole - period) < 0.06 * period:
            return whole
    return period


def _find_jumping(view: View, name: str, *, is_interleaved: bool) -> Finding | None:
    if view.known & {"interleaved_passes", "passes_no_drives"}:
        return None
    passes = _jumping_passes(view.drives)
    passes = [each for each in passes if each["interleaved"] == is_interleaved]
    if not passes:
        return None
    first = passes[0]
    images = sum(each["images"] for each in passes)
    what = (
        f"{len(passes)} passes are several drives in one: their images jump between them."
        if is_interleaved
        else f"{len(passes)} passes are no drives: their images follow no road."
    )
    return Finding(
        fault=name,
        what=what.replace("1 passes are", "One pass is").replace("their", "its" if len(passes) == 1 else "their"),
        why=f"In pass {first['name']} the median step from image to image is {first['step_m']:.3g} m, although the "
        f"nearest image is {first['nearest_m']:.3g} m away; {first['jumps']:.0%} of the steps are jumps ({images} "
        "images in all such passes).",
        do="Give each drive of each camera a pass id of its own, and time stamps; the fix chains images by place.",
        figures={"passes": len(passes), "images": images, **{k: v for k, v in first.items() if k != "interleaved"}},
        fix=_rechained,
    )


def _find_in_turn(view: View, name: str) -> Finding | None:
    found = _passes_in_turn(view.drives)
    if found is None:
        return None
    names, share, chance = found
    several = len(set(names.values()))
    return Finding(
        fault=name,
        what=f"{len(names)} passes are {'one drive' if several == 1 else f'{several} drives'}: their images take turns "
        "along one road.",
        why=f"In the order of their times, {share:.0%} of the images of all but the longest of them are next to one of "
        "another pass and the same camera, no farther than a car gets in that time.",
        do="Give all images of a drive one pass id (is it a batch, a split or a folder?).",
        chance=chance,
        figures={"passes": len(names), "drives": several, "in_turn": round(share, 3)},
        fix=_joined_passes,
    )


def _passes_in_turn(images: Images) -> tuple[dict[str, str], float, float] | None:
    """Return under which one name passes (N) that take turns belong, which share of their images do, and the chance.

    Two images that follow each other in time, of one camera, are of one drive where the second is no farther from the
    first than a car gets in that time. Passes that go on in each other to and fro take turns if most of their images
    are next to one of another pass. Those of the longest pass do not count, as few images may be dealt out of many.
    Drives that follow each other do not come back. Where drives meet or overlap, few of their images are.
    """
    time = images.timestamp_s
    if time is None or not np.all(np.isfinite(time)) or len(images) < _LEAST_IMAGES:
        return None
    center, codes = camera_centers(images), images.pass_id.codes.astype(np.int64)
    order = np.lexsort((np.arange(len(time)), time, images.camera_id))
    before, after = order[:-1], order[1:]
    follows = (images.camera_id[before] == images.camera_id[after]) & (time[after] > time[before])
    step_m = np.linalg.norm(center[after] - center[before], axis=1)
    seconds = time[after] - time[before]
    moves = follows & (step_m > 0.0)
    if moves.sum() < _LEAST_IMAGES:
        return None
    speed_mps = float(np.median(step_m[moves] / seconds[moves]))
    goes_on = follows & (codes[before] != codes[after]) & (step_m <= FASTER * speed_mps * seconds)
    first, second, count = before[goes_on], after[goes_on], len(images.pass_id.names)
    pairs = coo_matrix((np.ones(len(first)), (codes[first], codes[second])), (count, count))
    _, drive = connected_components(pairs, directed=True, connection="strong")
    is_next = np.zeros(len(images), dtype=np.bool_)
    together = drive[codes[first]] == drive[codes[second]]
    is_next[first[together]] = is_next[second[together]] = True
    length, turns = np.bincount(codes, minlength=count), np.bincount(codes[is_next], minlength=count)
    drives = [members for each in np.unique(drive) if len(members := np.flatnonzero(drive == each)) > 1]
    names: dict[str, str] = {}
    told = []
    for members in drives:
        shorter = np.delete(members, np.argmax(length[members]))
        in_turn, most = int(turns[shorter].sum()), int(length[shorter].sum())
        chance = chance_of_majority(in_turn, most) * len(drives)
        if chance < LEAST_CHANCE:
            told.append((chance, in_turn, most))
            names |= {images.pass_id.names[code]: images.pass_id.names[members[0]] for code in members.tolist()}
    chances, seen, of = zip(*told, strict=True) if told else ((), (), ())
    return (names, sum(seen) / sum(of), max(chances)) if names else None


def _joined_passes(dataset: Dataset) -> Dataset:
    found = _passes_in_turn(dataset.images)
    if found is None:
        return dataset
    names = [found[0].get(name, name) for name in dataset.images.pass_id.texts()]
    return with_images(dataset, pass_id=Categories.from_texts(names))


def _jumping_passes(images: Images) -> list[dict[str, Any]]:
    if not len(images):
        return []
    center = camera_centers(images)
    found = []
    for code, rows in _passes_in_order(images):
        if len(rows) < _LEAST_IMAGES:
            continue
        step = np.linalg.norm(np.diff(center[rows], axis=0), axis=1)
        moving = rows[np.append(True, step > standing_m(step))]
        if len(moving) < _LEAST_IMAGES:
            continue
        way = np.diff(center[moving], axis=0)
        step = np.linalg.norm(way, axis=1)
        # Cameras of a car are nearer to each other than its images are, and one may have the poses of another time.
        camera, count = np.unique(images.camera_id[moving], return_counts=True)
        nearest = _typical_gap(center[moving[images.camera_id[moving] == camera[count.argmax()]]])
        if nearest <= 0.0:
            continue
        jumps = float(((step > _JUMP_TIMES * nearest) & ~_leads_on(way)).mean())
        if jumps <= _MOST_JUMPS:
            continue
        # Of few drives in turn, one of the last images is near; of none, hardly ever.
        recent = np.min(
            [np.linalg.norm(center[moving[_TURNS:]] - center[moving[_TURNS - lag : -lag]], axis=1) for lag in _LAGS],
            axis=0,
        )
        found.append(
            {
                "name": images.pass_id.names[code],
                "images": len(rows),
                "step_m": round(float(np.median(step)), 3),
                "nearest_m": round(nearest, 3),
                "jumps": round(jumps, 3),
                "interleaved": bool((recent <= _JUMP_TIMES * nearest).mean() > 0.7),
            }
        )
    return found


def _leads_on(way: Floats) -> Bools:
    """Return which steps (N, 3) go on from the one before and lead to the one after, as those of a drive do.

    Where a pass drives a road again and again, its nearest image is of another lap, much nearer than any step.
    """
    turn = np.linalg.norm(np.diff(way, axis=0), axis=1)
    turns = np.stack([np.append(0.0, turn), np.append(turn, 0.0)])
    return np.asarray((turns <= np.linalg.norm(way, axis=1)).all(axis=0))


def _passes_in_order(images: Images) -> Iterator[tuple[int, Ints]]:
    order = driving_order(images)
    codes = images.pass_id.codes[order]
    for rows in np.split(order, np.flatnonzero(np.diff(codes)) + 1):
        yield int(images.pass_id.codes[rows[0]]), rows


def _typical_gap(center: Floats) -> float:
    """Return the median distance to the nearest image that is elsewhere at all."""
    distance = np.asarray(cKDTree(center).query(center, k=min(8, len(center)))[0])[:, 1:]
    extent = float(np.linalg.norm(np.ptp(center, axis=0)))
    elsewhere = np.where(distance > 1e-4 * extent, distance, np.inf).min(axis=1)
    elsewhere = elsewhere[np.isfinite(elsewhere)]
    return float(np.median(elsewhere)) if len(elsewhere) else 0.0


def _chains(center: Floats, gap_m: float) -> Ints:
    """Return the chain (N) of images in order: each goes on with the chain whose end is nearest, or starts one."""
    ends: list[Floats] = []
    chain = np.empty(len(center), dtype=np.int64)
    for i, here in enumerate(center):
        if ends:
            distance = np.linalg.norm(np.array(ends) - here, axis=1)
            nearest = int(np.argmin(distance))
            if distance[nearest] <= _JUMP_TIMES * gap_m:
                ends[nearest], chain[i] = here, nearest
                continue
        if len(ends) >= 500:
            chain[i] = len(ends) - 1
            continue
        chain[i] = len(ends)
        ends.append(here)
    return chain


def _rechained(dataset: Dataset) -> Dataset:
    """Give jumping passes new ids: chains in their own order, or where that follows no road, strands of near poses."""
    images = dataset.images
    center = camera_centers(images)
    names = np.array(images.pass_id.texts(), dtype=object)
    scattered: list[Ints] = []
    bad = {each["name"]: each["interleaved"] for each in _jumping_passes(dataset.images)}
    for code, rows in _passes_in_order(images):
        name = images.pass_id.names[code]
        if name not in bad:
            continue
        if bad[name]:
            for row, chain in zip(rows, _chains(center[rows], _typical_gap(center[rows])), strict=True):
                names[row] = f"{name} part {chain + 1}"
        else:
            scattered.append(rows)
    if scattered:
        rows = np.sort(np.concatenate(scattered))
        for row, number in zip(rows, _strands(dataset, rows), strict=True):
            names[row] = f"strand {number + 1}"
    return with_images(dataset, pass_id=Categories.from_texts(names.tolist()))


def _strands(dataset: Dataset, rows: Ints) -> Ints:
    """Return which strand each of some images (N) is of: near images that look the same way are linked."""
    center = camera_centers(dataset.images)[rows]
    forward = rotation_matrices(dataset.images)[rows, 2]
    count = min(_TURNS + 1, len(rows))
    distance, near = map(np.asarray, cKDTree(center).query(center, k=count))
    first = np.repeat(np.arange(len(rows)), count)
    second = near.ravel()
    linked = (distance.ravel() <= _JUMP_TIMES * _typical_gap(center)) & (
        np.einsum("nj,nj->n", forward[first], forward[second]) > _SAME_WAY
    )
    graph = coo_matrix((np.ones(int(linked.sum())), (first[linked], second[linked])), shape=(len(rows), len(rows)))
    _, strand = connected_components(graph, directed=False)
    return np.asarray(strand, dtype=np.int64)


class _ByImages:
    """Detections moved along the images of their pass and camera by a number of them; those of the ends stay."""

    def __init__(self, images: int) -> None:
        self._images = images

    def __call__(self, dataset: Dataset) -> Dataset:
        images = dataset.images
        order = order_by_camera(images)
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        to = np.clip(np.arange(len(order)) - self._images, 0, len(order) - 1)
        same = (images.pass_id.codes[order[to]] == images.pass_id.codes[order]) & (
            images.camera_id[order[to]] == images.camera_id[order]
        )
        to = np.where(same, to, np.arange(len(order)))
        moved = order[to][rank]
        return with_detections(dataset, image_id=images.image_id[moved[rows_in_images(dataset)]])


@dataclass(frozen=True, eq=False)
class _PassPoints:
    """What each pass of a sample finds alone: rays to meet them with, and the drive's mean azimuth at each point."""

    meeting: Meeting
    heading: Floats


@once_a_view
def _pass_points(view: View) -> _PassPoints | None:
    """Return what each pass finds alone at each place; None where there is nothing to compare."""
    sample = view.places_of_passes
    dataset, pass_code = sample.dataset, sample.dataset.images.pass_id.codes.astype(np.int64)
    if len(np.unique(pass_code)) < 2:
        return None
    group = sample.place_of_image.astype(np.int64) * (int(pass_code.max()) + 1) + pass_code
    _, group_of_image = np.unique(group, return_inverse=True)
    agreement = measure_agreement(dataset, group_of_image.astype(np.uint32), view.gate_px)
    found = agreement.found
    if len(found) < _LEAST_PAIRS:
        return None
    voters = found.voters.astype(np.int64)
    first = voters[found.voter_offsets[:-1]]
    first_image = agreement.rays.image_row[first]
    azimuth, _ = driving_azimuths(view.dataset)
    heading = _mean_heading(azimuth[sample.image_row][agreement.rays.image_row[voters]], found.voter_offsets)
    meeting = Meeting(
        rays=agreement.rays,
        place_of_image=sample.place_of_image,
        pass_of_image=pass_code,
        point=found.position_in_world_m,
        middle_in_world_m=agreement.middle_in_world_m,
        pass_of_point=pass_code[first_image],
        class_of_point=agreement.rays.class_code[first],
        place_of_point=sample.place_of_image[first_image].astype(np.int64),
        gate_px=view.gate_px,
    )
    return _PassPoints(meeting, heading)


def meeting_of_passes(view: View) -> Meeting | None:
    """Return the points that each pass finds alone and the rays to meet them with; None where there are none."""
    points = _pass_points(view)
    return None if points is None else points.meeting


def unexplained_passes(view: View, near_m: float) -> tuple[str, ...]:
    """Return the passes whose points are near those of others no more often than if they were elsewhere.

    Each has a dozen points or more that others have some of the kind around. Elsewhere is four times as far as near is,
    in each of sixteen directions on the ground, the middle one of which counts.
    """
    points = _pass_points(view)
    if points is None:
        return ()
    meeting = points.meeting
    east, north = view.dataset.frame.east_north()
    ways = [np.cos(angle) * east + np.sin(angle) * north for angle in np.linspace(0.0, 2.0 * np.pi, _WAYS, False)]
    found = []
    for code in meeting.passes_of_most_points():
        if meeting.met(code, meeting.point, SEARCH_STEPS * view.step_m) < _A_DOZEN:
            continue
        own = (meeting.pass_of_point == code)[:, None]
        away = [
            meeting.met(code, np.where(own, meeting.point + _NEXT_TIMES * near_m * way, meeting.point), near_m)
            for way in ways
        ]
        met, by_chance = meeting.met(code, meeting.point, near_m), int(np.median(away))
        if chance_of_majority(met, met + by_chance) > AGAINST:
            found.append(view.dataset.images.pass_id.names[code])
    return tuple(found)


_A_DOZEN, _WAYS = 12, 16


@once_a_view
def worst_pass(view: View) -> PassShift | None:
    """Return the shift of the pass that is farthest from good, None where all agree."""
    shift = _apart_from_others(view) or _far_from_others(view)
    return _at_a_seam(view) if shift is None else _settled(view, shift)


def _settled(view: View, shift: PassShift) -> PassShift:
    """Return the shift, or that of the other pass of two if it is that one which is off; with the other if none tells.

    Of three passes that see the same, two agree. Of two, rays say no more than how far they are apart.
    """
    points = _pass_points(view)
    assert points is not None
    mine = _Hypothesis.of(view, points, shift)
    rivals = [
        rival
        for code in points.meeting.met_by(mine.code, mine.point, view.step_m / 2.0)
        for rival in [_best_opposite(view, points, mine, code)]
        if rival.share >= FAR_WORSE * mine.share
    ]
    if not rivals:
        return shift
    theirs = max(rivals, key=lambda each: each.share)
    is_mine = which_is_off(view, points.meeting, (mine.code, mine.point), (theirs.code, theirs.point))
    if is_mine is None:
        return replace(shift, other=theirs.shift)
    return shift if is_mine else theirs.shift


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A shift of a pass, all points (P, 3) with those of the pass moved, and what share of what is met is due to it."""

    shift: PassShift
    code: int
    point: Floats
    share: float

    @classmethod
    def of(cls, view: View, points: _PassPoints, shift: PassShift) -> _Hypothesis:
        """Work out what a shift comes to."""
        meeting, offset_m = points.meeting, shift.offset_m
        code = view.dataset.images.pass_id.code_of(shift.pass_name)
        if shift.is_along:
            east, north = view.dataset.frame.east_north()
            heading = points.heading[:, None]
            moves = offset_m[0] * (np.sin(heading) * east + np.cos(heading) * north)
        else:
            moves = np.broadcast_to(offset_m, meeting.point.shape)
        point = np.where((meeting.pass_of_point == code)[:, None], meeting.point + moves, meeting.point)
        if shift.points:  # Rays of one place do not reach so far.
            met, met_before = (meeting.met(code, each, view.step_m / 2.0) for each in (point, meeting.point))
            return cls(shift, code, point, (met - met_before) / max(met, 1))
        images = view.places_of_passes.image_row
        still = np.zeros((len(images), 3))
        moved = (moved_along(view.dataset, offset_m[0]) - view.center_in_world_m)[images] if shift.is_along else still
        moved = moved if shift.is_along else still + offset_m
        gain, gain_without = (float(meeting.gain(code, each).sum()) for each in (moved, still))
        told = replace(shift, gain=gain, gain_without=gain_without)
        return cls(told, code, point, (gain - gain_without) / max(gain, 1e-9))


def _best_opposite(view: View, points: _PassPoints, mine: _Hypothesis, code: int) -> _Hypothesis:
    """Return the shift of another pass, by as much the other way, by which most of what it sees is met."""
    shift, moved = mine.shift, mine.point - points.meeting.point
    in_world = replace(
        shift,
        pass_name=view.dataset.images.pass_id.names[code],
        is_along=False,
        offset_m=-np.mean(moved[points.meeting.pass_of_point == mine.code], axis=0),
    )
    # One that drives the other way is as far ahead as this one is.
    along = [replace(in_world, is_along=True, offset_m=way * shift.offset_m) for way in (-1.0, 1.0) if shift.is_along]
    tried = [_Hypothesis.of(view, points, each) for each in (*along, in_world)]
    return max(tried, key=lambda each: each.share)


def which_is_off(view: View, meeting: Meeting, mine: tuple[int, Floats], theirs: tuple[int, Floats]) -> bool | None:
    """Return whether the first of two passes is the one that is off, None where neither truth nor poses' sigmas say so.

    Each is given as its code and all points (P, 3) with its own as they would be were it the one that is off.
    """
    by_truth = _by_truth(view, meeting, mine, theirs)
    return _by_sigmas(view, meeting, mine, theirs) if by_truth is None else by_truth


def _by_truth(view: View, meeting: Meeting, mine: tuple[int, Floats], theirs: tuple[int, Floats]) -> bool | None:
    """Count the true objects that either pass sees where they are, as given or moved (a sign test)."""
    truth = view.dataset.truth
    if truth is None or not len(truth):
        return None
    middle = meeting.middle_in_world_m
    objects = flattened(truth.position_in_world_m, truth, view)
    says_mine = votes = 0
    for is_mine, (code, moved) in ((True, mine), (False, theirs)):
        own = meeting.pass_of_point == code
        given, there = (flattened(each[own] + middle, truth, view) for each in (meeting.point, moved))
        near_m = float(np.median(np.linalg.norm(there - given, axis=1))) / 2.0
        given_m, there_m = (np.asarray(cKDTree(each).query(objects)[0]) for each in (given, there))
        is_near = (np.minimum(given_m, there_m) < near_m) & (given_m != there_m)
        votes += int(is_near.sum())
        says_mine += int((((there_m < given_m) == is_mine) & is_near).sum())
    for says, is_mine in ((says_mine, True), (votes - says_mine, False)):
        if 2.0 * chance_of_majority(says, votes) < LEAST_CHANCE:
            return is_mine
    return None


def _by_sigmas(view: View, meeting: Meeting, mine: tuple[int, Floats], theirs: tuple[int, Floats]) -> bool | None:
    """See whether one pass states errors as large as that, and the other states that it has none."""
    sigma_m = view.dataset.images.position_sigma_m
    if sigma_m is None:
        return None
    likely = []
    for code, moved in (mine, theirs):
        own = meeting.pass_of_point == code
        off_m = float(np.median(np.linalg.norm((moved - meeting.point)[own], axis=1)))
        stated_m = sigma_m[view.dataset.images.pass_id.codes == code]
        if not np.any(np.isfinite(stated_m)):
            return None
        stated = float(np.nanmedian(stated_m))
        likely.append(0.0 if stated <= 0.0 else float(stats.chi2.sf((off_m / stated) ** 2, 3)))
    for (one, another), is_mine in ((likely, True), (likely[::-1], False)):
        if one > AGAINST and another < LEAST_CHANCE:
            return is_mine
    return None


def seen_m(view: View) -> float:
    """Return how far poses must be off to be seen at all: the gate of rays at the usual distance of what they show."""
    if not len(view.dataset.detections) or not len(view.agreement.found):
        return 0.0
    found, rays = view.agreement.found, view.agreement.rays
    point = np.repeat(found.position_in_world_m, np.diff(found.voter_offsets), axis=0)
    ray_m = point - rays.center_in_world_m[found.voters.astype(np.int64)]
    return GATE_RAD * view.gate_share * float(np.median(np.linalg.norm(ray_m, axis=1)))


def _at_a_seam(view: View) -> PassShift | None:
    """Return the shift that closes the largest jump between passes that are one drive: of the shorter of the two."""
    seam = worst_seam(view.dataset, view.center_in_world_m)
    if seam is None or seam.chance > LEAST_CHANCE or float(np.linalg.norm(seam.jump_m)) < seen_m(view):
        return None
    images = view.dataset.images
    count = {name: int((images.pass_id.codes == images.pass_id.code_of(name)).sum()) for name in images.pass_id.names}
    name = seam.after if count[seam.after] <= count[seam.before] else seam.before
    offset_m = -seam.jump_m if name == seam.after else seam.jump_m
    forward_m = float(offset_m @ seam.forward)
    speed_mps = median_speed_mps(view)
    is_along = speed_mps is not None and abs(forward_m) > _ALONG * float(np.linalg.norm(offset_m))
    if is_along and speed_mps is not None:
        # What a shift in time is at the median speed.
        offset_m = np.array([forward_m / seam.speed_mps * speed_mps, 0.0, 0.0])
    return PassShift(name, offset_m, is_along, 0.0, 0.0, seam.chance, len(count), seam)


_ALONG = 0.97
"""A jump within 14 degrees of the way the car drives is one in time."""


def _apart_from_others(view: View) -> PassShift | None:
    """See for each pass whether its rays meet the points of the others, moved or not."""
    points = _pass_points(view)
    if points is None:
        return None
    meeting, heading = points.meeting, points.heading
    # Offsets as small as rays can see, if that is less than images are apart.
    tolerance_m = min(view.step_m / 2.0, seen_m(view) or view.step_m / 2.0)
    tried = meeting.passes_of_most_points()
    candidates: list[tuple[int, int, bool, Floats]] = []
    for code in tried:
        own, difference = meeting.differences(code, within_m=SEARCH_STEPS * view.step_m)
        for is_along, turned in ((False, difference), (True, _along(difference, heading[own], view))):
            shift = densest(turned, tolerance_m)
            if shift is None or shift.pairs < _LEAST_PAIRS or np.linalg.norm(shift.offset_m) <= tolerance_m:
                continue
            if is_along and abs(shift.offset_m[0]) < 2.0 * float(np.linalg.norm(shift.offset_m[1:])):
                continue
            candidates.append((shift.pairs - shift.pairs_at_zero, code, is_along, shift.offset_m))
    candidates.sort(key=lambda each: (-each[0], each[1], each[2]))
    return _best_shift(view, meeting, candidates[:_MOST_CANDIDATES], len(tried), tolerance_m)


def _far_from_others(view: View) -> PassShift | None:
    """Return the shift by which what a pass sees is what the others see, where it is farther off than rays tell.

    Then its points are in other places than theirs. The right shift stands out of all others: by the next best one
    fewer of its points have another, beyond what chance makes of two that are alike.
    """
    points = _pass_points(view)
    if points is None:
        return None
    meeting, tolerance_m = points.meeting, view.step_m / 2.0
    tried = meeting.passes_of_most_points()
    found: list[tuple[int, PassShift]] = []
    for code in tried:
        match = meeting.best_match(code, tolerance_m)
        if match is None or np.linalg.norm(match.offset_m) <= SEARCH_STEPS * view.step_m:
            continue
        chance = match.chance_against(match.met_by_next) * len(tried)
        if chance < LEAST_CHANCE:
            name = view.dataset.images.pass_id.names[code]
            told = PassShift(name, match.offset_m, False, 0.0, 0.0, chance, len(tried), points=match.met)
            found.append((match.met - match.met_by_next, told))
    return max(found, key=lambda each: each[0])[1] if found else None


_NEXT_TIMES = 4.0
"""So many tolerances away from the best shift, no pair of points agrees with it and with another."""


@dataclass(frozen=True, eq=False)
class Match:
    """The shift (3) by which so many points of a pass are `met` by those of others, and how many by the next."""

    offset_m: Floats
    met: int
    met_by_next: int

    def chance_against(self, others: int) -> float:
        """Return how likely so many are met, and so many others otherwise, by two ways that are alike."""
        return chance_of_majority(self.met, self.met + others)


@dataclass(frozen=True, eq=False)
class Meeting:
    """Rays of a sample, and the points (P, 3) that each pass finds alone, relative to `middle_in_world_m` (3)."""

    rays: Rays
    place_of_image: NDArray[np.uint32]
    pass_of_image: Ints
    point: Floats
    middle_in_world_m: Floats
    pass_of_point: Ints
    class_of_point: NDArray[np.int32]
    place_of_point: Ints
    gate_px: float

    def passes_of_most_points(self) -> list[int]:
        """Return the codes of the passes that find most points, as many as are looked at."""
        codes, number = np.unique(self.pass_of_point, return_counts=True)
        return [int(code) for code in codes[np.argsort(-number, kind="stable")][:_MOST_PASSES]]

    def differences(self, code: int, *, within_m: float | None) -> tuple[Ints, Floats]:
        """Return from which points of a pass (M) how far it is (M, 3) to points of their class that others find."""
        i, j = self.near(code, self.point, within_m=within_m)
        return i, self.point[j] - self.point[i]

    def near(self, code: int, point: Floats, *, within_m: float | None) -> tuple[Ints, Ints]:
        """Return the rows of points of a pass, and of points of their class that others find near them, of all pairs.

        The points (P, 3) are these, or some of them elsewhere.
        """
        own, others = np.flatnonzero(self.pass_of_point == code), np.flatnonzero(self.pass_of_point != code)
        i, j = pairs_within(point[own], point[others], within_m=within_m)
        same = self.class_of_point[own[i]] == self.class_of_point[others[j]]
        return own[i[same]], others[j[same]]

    def met(self, code: int, point: Floats, within_m: float) -> int:
        """Return how many points of a pass, where all points (P, 3) are elsewhere, are near one of others."""
        return len(np.unique(self.elsewhere(point).near(code, point, within_m=within_m)[0]))

    def met_by(self, code: int, point: Floats, within_m: float) -> list[int]:
        """Return the codes of the passes that points of a pass are near those of, where all points are elsewhere."""
        _, others = self.elsewhere(point).near(code, point, within_m=within_m)
        return [int(each) for each in np.unique(self.pass_of_point[others])]

    def elsewhere(self, point: Floats) -> Meeting:
        """Return the same with other points (P, 3)."""
        return replace(self, point=point)

    def best_match(self, code: int, tolerance_m: float) -> Match | None:
        """Return the shift, however far, by which most points of a pass fall on those of others; None where none do."""
        own, difference = self.differences(code, within_m=None)
        shift = densest(difference, tolerance_m)
        if shift is None:
            return None
        away_m = np.linalg.norm(difference - shift.offset_m, axis=1)
        next_best = densest(difference[away_m > _NEXT_TIMES * tolerance_m], tolerance_m)
        met_by_next = 0
        if next_best is not None:
            is_next = np.linalg.norm(difference - next_best.offset_m, axis=1) <= tolerance_m
            met_by_next = len(np.unique(own[is_next]))
        return Match(shift.offset_m, len(np.unique(own[away_m <= tolerance_m])), met_by_next)

    def gain(self, code: int, offset_m: Floats) -> Floats:
        """Return how well the rays of a pass, whose images (N, 3) are moved, meet the points of the others (places)."""
        image = self.rays.image_row
        own = np.flatnonzero((self.pass_of_image[image] == code) & np.isfinite(self.rays.direction_in_world[:, 0]))
        others = np.flatnonzero(self.pass_of_point != code)
        place_of_ray = self.place_of_image[image[own]].astype(np.int64)
        gain = np.zeros(int(self.place_of_image.max()) + 1)
        for place in np.unique(place_of_ray).tolist():
            ray, target = own[place_of_ray == place], others[self.place_of_point[others] == place]
            if not len(target):
                continue
            center = self.rays.center_in_world_m[ray] + offset_m[image[ray]]
            towards = self.point[target][None] - center[:, None]
            local = np.einsum("nij,nmj->nmi", self.rays.residual_from_world[ray], towards)
            with np.errstate(divide="ignore", invalid="ignore"):
                error2 = (local[..., 0] ** 2 + local[..., 1] ** 2) / local[..., 2] ** 2
            meets = (local[..., 2] > 0.0) & (self.rays.class_code[ray][:, None] == self.class_of_point[target])
            worth = np.where(meets, 1.0 - error2 / self.gate_px**2, 0.0).max(axis=1)
            gain[place] = np.maximum(worth, 0.0).sum()
        return gain


def _best_shift(
    view: View,
    meeting: Meeting,
    candidates: Sequence[tuple[int, int, bool, Floats]],
    passes: int,
    tolerance_m: float,
) -> PassShift | None:
    """Move each candidate pass and return the shift that makes its rays meet the points of the others best."""
    images = view.places_of_passes.image_row
    still = np.zeros((len(images), 3))
    best: tuple[float, PassShift] | None = None
    for _, code, is_along, offset_m in candidates:
        name = view.dataset.images.pass_id.names[code]
        given = meeting.gain(code, still)

        def gain_of(offset: Floats, code: int = code, is_along: bool = is_along) -> Floats:
            moved = (
                (moved_along(view.dataset, offset[0]) - view.center_in_world_m)[images] if is_along else still + offset
            )
            return meeting.gain(code, moved)

        offset = offset_m * [1.0, 0.0, 0.0] if is_along else offset_m.copy()
        gain = gain_of(offset)
        first = compare(gain, given)
        for reach in (1.0, 0.5, 0.25):
            for axis in (0,) if is_along else (0, 1, 2):
                for way in (-reach, reach):
                    other = offset.copy()
                    other[axis] += way * tolerance_m
                    gain_there = gain_of(other)
                    if gain_there.sum() > gain.sum():
                        offset, gain = other, gain_there
        # The pairs of points chose where to look; how well rays meet there has not been looked at before.
        chance = min(1.0, first.chance * len(candidates))
        total, without = float(gain.sum()), float(given.sum())
        if total - without < LEAST_RISE * without:
            continue
        # Of two ways to say the same, a shift in the world is the simpler one.
        rise = (total - without) * (1.0 if not is_along else 0.95)
        if chance < LEAST_CHANCE and np.linalg.norm(offset) > tolerance_m and (best is None or rise > best[0]):
            best = rise, PassShift(name, offset, is_along, total, without, chance, passes)
    return None if best is None else best[1]


def _mean_heading(azimuth: Floats, offsets: Ints) -> Floats:
    starts = offsets[:-1]
    return np.arctan2(np.add.reduceat(np.sin(azimuth), starts), np.add.reduceat(np.cos(azimuth), starts))


def _along(difference: Floats, heading: Floats, view: View) -> Floats:
    """Return differences (N, 3) as forward, left and up of drives along azimuths (N)."""
    east, north = view.dataset.frame.east_north()
    up = np.array(view.dataset.frame.up)
    forward = np.sin(heading)[:, None] * east + np.cos(heading)[:, None] * north
    left = np.sin(heading - np.pi / 2.0)[:, None] * east + np.cos(heading - np.pi / 2.0)[:, None] * north
    return np.stack(
        [np.einsum("nj,nj->n", difference, forward), np.einsum("nj,nj->n", difference, left), difference @ up], axis=1
    )


def _is_vertical(view: View, offset_m: Floats) -> bool:
    return abs(float(offset_m @ np.array(view.dataset.frame.up))) > 0.9 * float(np.linalg.norm(offset_m))


def _shift_finding(fault: str, shift: PassShift, what: str, do: str) -> Finding:
    frame = "forward, left, up" if shift.is_along else "x, y, z"
    numbers = ", ".join(f"{part:.2f}" for part in shift.offset_m)
    if shift.points:
        why = (
            f"Moved by {numbers} m ({frame}), {shift.points} things that it sees are where others see such; by no "
            "other shift nearly as many are."
        )
        figures: dict[str, Any] = {"points_if_moved": shift.points}
    elif shift.seam is None:
        why = (
            f"Moved by {numbers} m ({frame}), what it sees is where other passes see it: the agreement of its rays "
            f"with the others' points rises from {shift.gain_without:.0f} to {shift.gain:.0f}."
        )
        figures = {
            "agreement_as_given": round(shift.gain_without, 1),
            "agreement_if_moved": round(shift.gain, 1),
        }
    else:
        jump_m = float(np.linalg.norm(shift.seam.jump_m))
        why = (
            f"By its times pass {shift.seam.after} goes on where {shift.seam.before} ends, but the poses jump by "
            f"{jump_m:.2f} m there; from image to image within passes it is less than {shift.seam.usual_m:.2f} m. "
            f"Moved by {numbers} m ({frame}) they do not."
        )
        figures = {"jump_m": round(jump_m, 3), "usual_jump_m": round(shift.seam.usual_m, 3)}
    other = shift.other
    if other is not None:
        apart_m = float(np.linalg.norm(shift.offset_m))
        by = f"{numbers} m" if not other.is_along else f"{shift.offset_m[0]:.2f} m along its drive"
        or_by = (
            f"{other.offset_m[0]:.2f} m along its drive"
            if other.is_along
            else ", ".join(f"{part:.2f}" for part in other.offset_m) + " m"
        )
        what = which_of_two(shift.pass_name, other.pass_name, f"{apart_m:.2f} m apart")
        do = (
            f"Find out which is right (by a third pass, by known points as truth), then move {shift.pass_name} by "
            f"{by}, or {other.pass_name} by {or_by}. {do}"
        )
        why += f" So it is if {other.pass_name} is moved by {or_by}."
    fix = _Realigned(shift)
    return Finding(
        fault=fault,
        what=what,
        why=why,
        do=do,
        chance=shift.chance,
        figures={
            **({} if other is None else {"or_pass": other.pass_name}),
            "pass": shift.pass_name,
            "shift_m": [round(float(part), 3) for part in shift.offset_m],
            "frame": frame,
            **figures,
            "passes_looked_at": shift.passes,
        },
        fix=fix if other is None else None,
        trial=None if other is None else fix,
    )


def which_of_two(one: str, other: str, apart: str) -> str:
    """Return in one sentence that two passes are apart, and that it is not known which of them is off."""
    return f"Passes {one} and {other} are {apart}, and nothing tells which of the two is off."


class _Realigned:
    """One pass moved, in the world or along its own drive."""

    def __init__(self, shift: PassShift) -> None:
        self._shift = shift

    def __call__(self, dataset: Dataset) -> Dataset:
        center = camera_centers(dataset.images)
        is_moved: Bools = dataset.images.pass_id.codes == dataset.images.pass_id.code_of(self._shift.pass_name)
        offset_m = self._shift.offset_m
        moved = moved_along(dataset, offset_m[0]) if self._shift.is_along else center + offset_m
        return with_centers(dataset, np.where(is_moved[:, None], moved, center))


def moved_along(dataset: Dataset, forward_m: float) -> Floats:
    """Return camera centres (N, 3) moved forward along their passes, each camera's own, as a shift in time does.

    The shift is that of an image that moves by the median step; slower ones move less, standing ones not at all.
    """
    order = order_by_camera(dataset.images)
    center = camera_centers(dataset.images)[order]
    codes = drive_of_camera(dataset.images)[order]
    time = dataset.images.timestamp_s
    seconds = np.arange(len(order), dtype=np.float64) if time is None or not np.all(np.isfinite(time)) else time[order]
    step = np.linalg.norm(np.diff(center, axis=0), axis=1)
    duration = np.diff(seconds)
    usable = (np.diff(codes) == 0) & (duration > 0.0) & (step > 0.0)
    usable &= step > 0.3 * np.median(step[usable]) if np.any(usable) else usable
    if not np.any(usable):
        return camera_centers(dataset.images)
    shift_s = forward_m / float(np.median(step[usable] / duration[usable]))
    moved = np.empty_like(center)
    for rows in np.split(np.arange(len(order)), np.flatnonzero(np.diff(codes)) + 1):
        when = seconds[rows]
        _, keep = np.unique(when, return_index=True)
        if len(keep) < 2:
            moved[rows] = center[rows]
            continue
        for axis in range(3):
            moved[rows, axis] = _interpolate(when + shift_s, when[keep], center[rows[keep], axis])
    result = np.empty_like(moved)
    result[order] = moved
    return result


def _interpolate(at: Floats, when: Floats, value: Floats) -> Floats:
    """Interpolate linearly, and beyond the ends go on as at the ends."""
    inside = np.interp(at, when, value)
    first = value[0] + (at - when[0]) * (value[1] - value[0]) / (when[1] - when[0])
    last = value[-1] + (at - when[-1]) * (value[-1] - value[-2]) / (when[-1] - when[-2])
    return np.asarray(np.where(at < when[0], first, np.where(at > when[-1], last, inside)))
