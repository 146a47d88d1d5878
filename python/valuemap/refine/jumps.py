"""Where poses jump: steps that no vehicle makes, or that one hardly makes, told from the trajectory alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset
from valuemap.drives import Drives

_FASTER_TIMES = 1.2
"""A step that much longer than those around it is none of a vehicle."""
_SIGMAS = 8.0
"""A step farther than so many usual deviations from what a vehicle can make is a jump."""
_LEAST_JUMP_M = 0.3
"""A step outside of what a vehicle can make by less than this is no jump, however little poses tremble."""
MOST_STEPS = 4.0
"""Images farther apart in time than so many usual steps say nothing of the velocity between them."""
_JUMP_M = 2.0
"""Deviation of jumps, each axis."""
_LEAST_SIGMA_M = 0.02
RARE = 13.8
"""Minus twice the log odds of a jump before anything is known: one step in a thousand."""
_FARTHEST_JUMP_M = 6.0
"""What is farther than drives are laid is no jump of poses: images are missing."""
_TOLD_M = 0.5
"""Jumps that a trajectory tells worse, as the vehicle stops or turns there, are left to objects."""
_MOST_JUMPS = 0.1
"""A drive with jumps in more than this share of its steps does not go as a vehicle does."""


@dataclass(frozen=True, eq=False)
class Hints:
    """How much a trajectory speaks for a jump: minus twice the log of the odds (H) before this place of a drive (H).

    Sorted by drive and order; where nothing is known, nothing is said.
    """

    drive: Ints
    order: Ints
    evidence: Floats

    def between(self, drive: int, order: Ints) -> Floats:
        """Return the most that speaks (N) for a jump after the image before and not after this one, 0 at the first.

        Where the trajectory says nothing of any step between them, it is 0; where all are usual, less.
        """
        low, high = np.searchsorted(self.drive, [drive, drive + 1])
        at = low + np.searchsorted(self.order[low:high], order, side="right")
        most = np.zeros(len(order))
        for i in np.flatnonzero(np.diff(at)) + 1:
            most[i] = float(self.evidence[at[i - 1] : at[i]].max())
        return most


@dataclass(frozen=True, eq=False)
class Links:
    """What trajectories say of the offsets of segments (K) after each other: second - first is so much (K, 2), m.

    `information` (K, 2, 2) is the inverse of its covariance.
    """

    first: Ints
    second: Ints
    apart_m: Floats
    information: Floats

    @staticmethod
    def none() -> Links:
        """Return none."""
        return Links(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))

    def blocks(self) -> Floats:
        """Return the information on the offsets of both segments, first and second, on the ground (K, 4, 4)."""
        sign = np.array([[1.0, -1.0], [-1.0, 1.0]])
        return np.asarray(np.einsum("ab,nij->naibj", sign, self.information).reshape(-1, 4, 4))

    def columns(self, of_offsets: Ints) -> Ints:
        """Return which columns (K, 4) these are, given those of offsets (L, 3)."""
        return np.asarray(of_offsets[np.stack([self.first, self.second], axis=1), :2].reshape(-1, 4))

    def without(self, segments: Bools) -> Links:
        """Return those of which no segment is among these (L): what is as far off as others has not jumped."""
        kept = ~(segments[self.first] | segments[self.second])
        return Links(self.first[kept], self.second[kept], self.apart_m[kept], self.information[kept])

    def groups(self, count: int) -> Ints:
        """Return one number (count) for all segments that are linked."""
        number = np.arange(count)
        for a, b in sorted(zip(self.first.tolist(), self.second.tolist(), strict=True)):
            number[b] = number[a]
        return number


@dataclass(frozen=True, eq=False)
class Segments:
    """Drives cut where their poses jump: segment `begins` (L) at this place in the order of its `drive` (L)."""

    drive: Ints
    begins: Ints

    def __len__(self) -> int:
        return len(self.drive)

    @classmethod
    def at(cls, cuts: Iterable[tuple[int, int]]) -> Segments:
        """Return those that begin at some places (drive, order), each named once or more, in any order."""
        drive, begins = np.array(sorted(set(cuts)), np.int64).reshape(-1, 2).T
        return cls(drive, begins)

    def cuts(self) -> list[tuple[int, int]]:
        """Return where they begin: drive and order."""
        return list(zip(self.drive.tolist(), self.begins.tolist(), strict=True))

    def of(self, drive: Ints, order: Ints) -> Ints:
        """Return the segment (N) of images, by drive and order."""
        reach = int(max(order.max(initial=0), self.begins.max(initial=0))) + 2
        return np.searchsorted(self.drive * reach + self.begins, drive * reach + order, side="right") - 1


@dataclass(frozen=True, eq=False)
class Jumps:
    """Jumps (J) before a place in the order of a drive: how far (J, 2), m, with their covariances (J, 2, 2).

    `segments` (L) are between them, and `offset_m` (L, 3) takes the jumps back; drives stay where their images are in
    the mean.
    """

    segments: Segments
    offset_m: Floats
    drive: Ints
    begins: Ints
    jump_m: Floats
    covariance_m2: Floats

    def links(self, segments: Segments, refuted: set[tuple[int, int]]) -> Links:
        """Return what the jumps say of segments that begin there, without those that are refuted (drive, begins)."""
        here = [(d, b) not in refuted for d, b in zip(self.drive.tolist(), self.begins.tolist(), strict=True)]
        rows = np.flatnonzero(np.array(here, dtype=np.bool_))
        second = segments.of(self.drive[rows], self.begins[rows])
        kept = (segments.begins[second] == self.begins[rows]) & (self.begins[rows] > 0)
        rows, second = rows[kept], second[kept]
        return Links(second - 1, second, -self.jump_m[rows], np.linalg.inv(self.covariance_m2[rows]))


def find_jumps(dataset: Dataset, drives: Drives) -> Segments:
    """Cut drives where the pose jumps: at steps that are outside what the steps before and after them span.

    A vehicle goes on as before, or as after, or stops, or anything between: the step is in the triangle of no step and
    those two. How far usual steps are outside of it is the trembling of the poses.
    """
    cuts: list[tuple[int, int]] = [(drive, 0) for drive in range(drives.count)]
    for track in _tracks(dataset, drives):
        steps = track.steps()
        ahead = _FASTER_TIMES * steps.seconds[:, None]
        outside = _from_triangle(steps.step_m, steps.before_mps * ahead, steps.after_mps * ahead)
        usual = float(np.median(np.linalg.norm(steps.unexpected_m(steps.before_mps, steps.after_mps), axis=1)))
        far = outside > max(_SIGMAS * usual / 1.5, _LEAST_JUMP_M)
        cuts += [(track.drive, int(order)) for order in track.order[steps.row[far]]]
    return Segments.at(cuts)


def find_hints(dataset: Dataset, drives: Drives) -> Hints:
    """Return how much each step speaks for a jump: by how much it is likelier with one than without."""
    parts = [np.empty((0, 3))]
    for track in _tracks(dataset, drives):
        steps = track.steps()
        evidence = _Test.of(steps, _usual(steps)).evidence
        parts.append(np.column_stack([np.full(len(evidence), track.drive), track.order[steps.row], evidence]))
    table = np.concatenate(parts)
    return Hints(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2])


def mend(dataset: Dataset, drives: Drives) -> Jumps:
    """Return the jumps that trajectories prove: the likeliest is taken back, then the next one, until none is left.

    A jump makes the steps beside it unlike others, too: it is where most is explained once it is taken back. A drive
    with more than one in ten steps does not go as a vehicle does: none of its jumps is proven.
    """
    found: dict[int, list[tuple[int, Floats, Floats]]] = {}
    for track in _tracks(dataset, drives):
        usual = _usual(track.steps())
        jumps: list[tuple[int, Floats, Floats]] = []
        while True:
            steps = track.steps()
            test = _Test.of(steps, usual)
            is_told = np.linalg.eigvalsh(test.covariance_m2)[:, 1] < _TOLD_M**2
            is_told &= np.linalg.norm(test.jump_m, axis=1) < _FARTHEST_JUMP_M
            evidence = np.where(is_told, test.evidence, -np.inf)
            best = int(np.argmax(evidence))
            if evidence[best] <= RARE or len(jumps) > _MOST_JUMPS * len(steps.row):
                break
            here = np.arange(max(best - 1, 0), min(best + 2, len(steps.row)))
            here = here[np.isfinite(evidence[here])]
            tried = [track.without(steps.row[i], test.jump_m[i]) for i in here]
            left = [float(_Test.of(other.steps(), usual).misfit.sum()) for other in tried]
            which = int(np.argmin(left))
            at, track = here[which], tried[which]
            jumps.append((int(track.order[steps.row[at]]), test.jump_m[at], test.covariance_m2[at]))
        if len(jumps) <= _MOST_JUMPS * len(steps.row):
            found[track.drive] = sorted(jumps, key=lambda jump: jump[0])
    cuts, offsets, told = [], [], []
    for drive in range(drives.count):
        jumps = found.get(drive, [])
        offset = -np.cumsum(np.array([np.zeros(2), *(jump for _, jump, _ in jumps)]), axis=0)
        begins = np.array([order for order, _, _ in jumps], dtype=np.int64)
        offset -= offset[np.searchsorted(begins, drives.order[drives.pass_code == drive], side="right")].mean(axis=0)
        cuts += [(drive, 0), *((drive, int(begin)) for begin in begins)]
        offsets.append(np.column_stack([offset, np.zeros(len(offset))]))
        told += [(drive, *jump) for jump in jumps]
    both = np.array(cuts, dtype=np.int64)  # As offsets are: what jumps twice in one place is there twice.
    return Jumps(
        Segments(both[:, 0], both[:, 1]),
        np.concatenate(offsets),
        np.array([drive for drive, *_ in told], dtype=np.int64),
        np.array([order for _, order, *_ in told], dtype=np.int64),
        np.array([jump for _, _, jump, _ in told], dtype=np.float64).reshape(-1, 2),
        np.array([covariance for *_, covariance in told], dtype=np.float64).reshape(-1, 2, 2),
    )


@dataclass(frozen=True, eq=False)
class _StepsOnGround:
    """Steps (N) of one drive that have one before and one after them, on the ground, and the image that they lead to.

    Velocities are those of one step, and of two where there are two: those tremble half as much.
    """

    row: Ints
    step_m: Floats
    seconds: Floats
    before_mps: Floats
    after_mps: Floats
    long_before_mps: Floats
    long_after_mps: Floats

    def unexpected_m(self, before_mps: Floats, after_mps: Floats) -> Floats:
        """Return what the steps (N, 2) are other than the mean of velocities (N, 2) before and after."""
        return np.asarray(self.step_m - 0.5 * (before_mps + after_mps) * self.seconds[:, None])


@dataclass(frozen=True, eq=False)
class _TrackOnGround:
    """Where one drive was (n, 2) on the ground and when (n); seconds are images where there are no times."""

    drive: int
    order: Ints
    center_m: Floats
    when_s: Floats

    def steps(self) -> _StepsOnGround:
        """Return its steps."""
        seconds, step = np.diff(self.when_s), np.diff(self.center_m, axis=0)
        near = seconds <= MOST_STEPS * np.median(seconds)
        velocity = step / seconds[:, None]
        inner = np.flatnonzero(near[1:-1] & near[:-2] & near[2:]) + 1
        two, last = 0.5 * (velocity[1:] + velocity[:-1]), len(step) - 1
        is_long = near[np.maximum(inner - 2, 0)] & (inner >= 2)
        before = np.where(is_long[:, None], two[np.maximum(inner - 2, 0)], velocity[inner - 1])
        is_long = near[np.minimum(inner + 2, last)] & (inner + 2 <= last)
        after = np.where(is_long[:, None], two[np.minimum(inner + 1, last - 1)], velocity[inner + 1])
        return _StepsOnGround(
            inner + 1, step[inner], seconds[inner], velocity[inner - 1], velocity[inner + 1], before, after
        )

    def without(self, row: int, jump_m: Floats) -> _TrackOnGround:
        """Return the track without a jump (2) before this image."""
        back = np.where(np.arange(len(self.order))[:, None] >= row, jump_m, 0.0)
        return replace(self, center_m=self.center_m - back)


def _tracks(dataset: Dataset, drives: Drives) -> Iterator[_TrackOnGround]:
    """Yield where the camera with most images in each drive was, where it took enough steps."""
    center = camera_centers(dataset.images)[:, :2]
    time = dataset.images.timestamp_s
    camera = np.unique(dataset.images.camera_id, return_inverse=True)[1]
    for drive in range(drives.count):
        rows = np.flatnonzero(drives.pass_code == drive)
        rows = rows[camera[rows] == np.argmax(np.bincount(camera[rows]))]
        rows = rows[np.argsort(drives.order[rows], kind="stable")]
        if len(rows) < 5:
            continue
        when = np.arange(len(rows), dtype=np.float64) if time is None else time[rows]
        if not (np.all(np.isfinite(when)) and np.all(np.diff(when) > 0.0)):
            when = np.arange(len(rows), dtype=np.float64)
        track = _TrackOnGround(drive, drives.order[rows], center[rows], when)
        if len(track.steps().row) >= 3:
            yield track


@dataclass(frozen=True, eq=False)
class _Test:
    """What each step (N) says of a jump (N, 2) that is in it, with the covariance (N, 2, 2) of that.

    `evidence` (N) is minus twice the log of how much likelier the step is without one, `misfit` (N) minus twice the log
    of how likely it is without.
    """

    jump_m: Floats
    covariance_m2: Floats
    evidence: Floats
    misfit: Floats

    @classmethod
    def of(cls, steps: _StepsOnGround, usual_m: Floats) -> _Test:
        """Test the steps of a drive where what is unexpected of them is usually so much (2), see `_usual`.

        What a step is other than the mean of the velocities before and after is normal; and wider by jumps where there
        is one. The velocities of two steps are used where those are surer, and of one where the vehicle was still
        standing, or turning, in the other.
        """
        near = _unexpected(steps, steps.before_mps, steps.after_mps, float(usual_m[0]))
        far = _unexpected(steps, steps.long_before_mps, steps.long_after_mps, float(usual_m[1]))
        is_far = np.trace(far[1], axis1=1, axis2=2) < np.trace(near[1], axis1=1, axis2=2)
        jump = np.where(is_far[:, None], far[0], near[0])
        covariance = np.where(is_far[:, None, None], far[1], near[1])
        wide = covariance + _JUMP_M**2 * np.eye(2)
        misfit, with_jump = (
            np.einsum("ni,nij,nj->n", jump, np.linalg.inv(of), jump) + np.log(np.linalg.det(of))
            for of in (covariance, wide)
        )
        return cls(jump, covariance, misfit - with_jump, misfit)


def _usual(steps: _StepsOnGround) -> Floats:
    """Return the deviation (2), each axis, of what steps are other than expected: by velocities of one step, of two."""
    by = ((steps.before_mps, steps.after_mps), (steps.long_before_mps, steps.long_after_mps))
    unexpected = [steps.unexpected_m(before, after) for before, after in by]
    return np.maximum(1.4826 * np.median(np.abs(unexpected), axis=(1, 2)), _LEAST_SIGMA_M)


def _unexpected(steps: _StepsOnGround, before_mps: Floats, after_mps: Floats, usual_m: float) -> tuple[Floats, Floats]:
    """Return what steps (N, 2) are other than the mean of two velocities, and the covariance (N, 2, 2) of that.

    Where the velocities differ, the vehicle brakes, sets off or turns within the step, nobody knows when: the step is
    uniform between both. One that turns evenly is off the chord between them by v (sin(a) / a - cos(a)), with a half of
    the angle.
    """
    before, after = before_mps * steps.seconds[:, None], after_mps * steps.seconds[:, None]
    change = after - before
    covariance = usual_m**2 * np.eye(2) + np.einsum("ni,nj->nij", change, change) / 12.0
    turn = np.arccos(np.clip(np.sum(_unit(before) * _unit(after), axis=1), -1.0, 1.0))
    slower = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1))
    covariance += ((slower * turn**2 / 12.0) ** 2)[:, None, None] * np.eye(2)
    return steps.step_m - 0.5 * (before + after), covariance


def _unit(vector: Floats) -> Floats:
    """Return vectors (N, 2) of length 1; (1, 0) for those of none."""
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0.0, vector / np.maximum(length, 1e-9), np.array([1.0, 0.0])))


def _from_triangle(point: Floats, a: Floats, b: Floats) -> Floats:
    """Return the distance (N) of points (N, 2) from the triangles of the origin, a and b (N, 2)."""
    zero = np.zeros_like(a)
    edges = np.stack([_from_edge(point, zero, a), _from_edge(point, a, b), _from_edge(point, b, zero)])
    sides = np.stack([_side(point, zero, a), _side(point, a, b), _side(point, b, zero)])
    inside = np.all(sides >= 0.0, axis=0) | np.all(sides <= 0.0, axis=0)
    return np.where(inside, 0.0, edges.min(axis=0))


def _from_edge(point: Floats, start: Floats, end: Floats) -> Floats:
    along = end - start
    length2 = np.sum(along**2, axis=1)
    share = np.clip(np.sum((point - start) * along, axis=1) / np.where(length2 > 0.0, length2, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(point - start - share[:, None] * along, axis=1))


def _side(point: Floats, start: Floats, end: Floats) -> Floats:
    along, to = end - start, point - start
    return np.asarray(along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0])
