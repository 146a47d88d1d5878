"""From landmarks of single drives to objects, segments and everything that the poses of drives may be wrong by."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import MapConfig
from valuemap.refine.adjust import Adjustment, Groups, Scales, adjust, triangulate
from valuemap.refine.footage import DRIFT_LENGTH_M, Footage, Sigmas
from valuemap.refine.jumps import RARE, Hints, Jumps, Links, Segments
from valuemap.refine.landmarks import RANGES, Landmarks
from valuemap.refine.noise import NoiseLeft, fit_noise
from valuemap.refine.register import Registration, register
from valuemap.refine.residuals import CAMERA_DELAY, MOUNT, OFFSET, WIDTH, Observations, State, linearised, weights
from valuemap.refine.tracks import associate, merge_objects

WIDE = Scales(
    NoiseLeft().drift_m,
    NoiseLeft().drift_rad,
    0.1,
    math.radians(0.1),
    (3.0, math.radians(2.0), 0.2, 0.05, math.radians(2.0), 0.2),
)
"""What errors are thought to be before anything is known: drift; offset, mounting, delay, focal length."""
_LANDMARK_PX, _LANDMARK_M = 3.0, 0.2
_NEW_SEGMENT_M = 1.0
"""Registered shifts that differ by more than this are of two segments."""
_SEGMENT_PRICE = 8.0
"""What a new segment has to explain, in squares of sigmas, where the trajectory shows the jump: by Bayes' information
criterion, the price of two offsets that 55 coordinates tell."""
LEAST_VOTES = 4
"""An object that fewer detections show is dropped."""
_SURE_SIGMAS = 4.0
"""Turns of drives are none of chance if their squares exceed their variances by so many deviations."""
_TOLD_RAD = math.radians(0.5)
"""Drives whose turns are less sure than this say nothing of how much drives are turned."""
_ALONE = (4.0, 3.0, 2.0, 2.0)
_PIECES = 200_000
"""So many pieces of a signal are looked at together: 2 MB for each of their numbers."""
_TIMES_CUT_ANEW = 2
"""Times that drives are cut anew where it is known which detection shows which object, as offsets move cuts."""
_MORE_ROUNDS = 2
"""Times that drives are cut and detections associated anew, after the first time."""
_COARSE, _FINE = (6.0, 4.0, 3.0, 2.0), (2.0, 1.5, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Objects with their classes and sizes, which detections show them, segments, state, and the noise that is left."""

    detection: Ints
    thing: Ints
    class_code: Ints
    size_m: Floats
    segments: Segments
    links: Links
    state: State
    noise: NoiseLeft
    sigma_px: Sigmas
    scales: Scales
    landmarks: int


@dataclass(frozen=True, eq=False)
class Marks:
    """Landmarks with their covariances (N, 3, 3), m², and how those of all drives lie to each other."""

    landmarks: Landmarks
    covariance: Floats
    registration: Registration


def lay(landmarks: Landmarks, footage: Footage, hints: Hints) -> Marks | None:
    """Lay the landmarks of a footage onto each other, None where too few of them say where they are."""
    usable = _usable(landmarks, footage)
    if usable is None:
        return None
    landmarks, covariance = usable
    order = footage.drives.order[footage.rays.image_row[landmarks.voters]].astype(np.float64)
    order = _core.medians(order, landmarks.offsets).astype(np.int64)
    evidence = np.zeros(len(landmarks))
    for drive in range(footage.drives.count):
        rows = np.flatnonzero(landmarks.drive == drive)
        rows = rows[np.argsort(landmarks.driven_m[rows], kind="stable")]
        evidence[rows] = hints.between(drive, np.maximum.accumulate(order[rows]))
    return Marks(landmarks, covariance, register(landmarks, covariance, evidence))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """What trajectories alone tell of where poses jump: where they do, where they may, and what is proven of it."""

    seen_cuts: Segments
    hints: Hints
    jumps: Jumps


def begin(
    footage: Footage,
    marks: Marks,
    config: MapConfig,
    told: Trajectories,
    *,
    known: tuple[Segments, Floats],
    turned_rad: Floats,
    late_s: float,
) -> Estimate | None:
    """Return a first estimate of all that drives may be wrong by, None where there is too little that drives share.

    The landmarks are those of the footage laid by segments that are `known` and their offsets (L, 3), by how the
    cameras of drives are turned (D, 3), and by how late poses are.
    """
    landmarks, registration = marks.landmarks, marks.registration
    segments, offset = _first_segments(footage, landmarks, registration, told.seen_cuts)
    segments, offset = _added(segments, offset, *known)
    thing_of_mark, class_code, size_m, points = _objects(landmarks, registration)
    detection, thing = landmarks.voters, thing_of_mark[landmarks.landmark_of_voter()]
    counts = (len(segments), footage.drives.count, footage.drives.count) + (footage.cameras,) * 3
    state = State.zero(points, len(footage.chain.drive), len(footage.row), counts)
    state.constants[OFFSET][:] = offset
    state.constants[MOUNT][:] = turned_rad
    state.constants[CAMERA_DELAY][:] = late_s
    noise, links = NoiseLeft(), told.jumps.links(segments, set())
    errors = (noise, _sigmas(footage, noise), WIDE)
    now = Estimate(detection, thing, class_code, size_m, segments, links, state, *errors, len(landmarks))
    return _round(footage, now, _COARSE, config, told)


def go_on(footage: Footage, begun: Estimate, config: MapConfig, told: Trajectories) -> Estimate | None:
    """Return an estimate that has settled, from a first one."""
    now: Estimate | None = begun
    for _ in range(_MORE_ROUNDS):
        now = None if now is None else _round(footage, now, _FINE, config, told)
    return None if now is None else associated(footage, _adjusted(footage, now, _FINE), range_of(config))


def _round(
    footage: Footage, now: Estimate, tolerances: tuple[float, ...], config: MapConfig, told: Trajectories
) -> Estimate | None:
    """Adjust all unknowns, cut drives and associate anew; None where nothing is left."""
    now = associated(footage, _cut(footage, _adjusted(footage, now, tolerances), told), range_of(config))
    return now if len(now.thing) else None


def range_of(config: MapConfig) -> float:
    """Return how far from an image its objects are looked for, m."""
    return RANGES * config.vote.farthest_m


def estimate_again(footage: Footage, found: Estimate, told: Trajectories) -> Estimate:
    """Estimate everything anew with the objects and the detections that an estimate has, about where it has them."""
    now = replace(found, state=triangulate(seen_by(footage, found), found.state))
    for _ in range(_TIMES_CUT_ANEW):
        now = _cut(footage, _adjusted(footage, now, _FINE), told)
    return _adjusted(footage, now, _FINE)


def seen_by(footage: Footage, now: Estimate) -> Observations:
    """Return the detections that an estimate takes for objects."""
    return footage.observe(now.detection, now.thing, segments_of(footage, now.segments), now.sigma_px)


def segments_of(footage: Footage, segments: Segments) -> Ints:
    """Return the segment of each keyframe."""
    return segments.of(footage.drives.pass_code, footage.drives.order)


def _adjusted(footage: Footage, now: Estimate, tolerances: tuple[float, ...]) -> Estimate:
    """Return an estimate with all unknowns adjusted, then its noise and drift."""
    seen = seen_by(footage, now)
    free = everything(footage, now.segments)
    problem = Adjustment(seen, footage.chain, now.scales, free, len(now.class_code), now.links)
    state = adjust(problem, now.state, tolerances=tolerances)
    noise = fit_noise(seen, state, footage.chain, now.scales, now.noise, footage.usual_pixels_per_rad)
    scales = own_scales(footage, noise, now.scales)
    return replace(now, state=state, noise=noise, sigma_px=_sigmas(footage, noise), scales=scales)


def mounts_alone(footage: Footage, landmarks: Landmarks) -> Floats:
    """Return how the camera of each drive (D, 3), rad, is turned about its axes, as the drive alone tells it.

    What a drive passes spreads out from where it drives to: one that looks elsewhere than it says is told without any
    other drive. How much of it is drift and noise is told by all drives together: where they are turned by no more than
    that, all is zero; else each is drawn to zero by its share of it. Turns about the axis of view are not told.
    """
    drives = footage.drives.count
    counts = (drives, drives, drives) + (footage.cameras,) * 3
    turned = np.zeros((drives, 3))
    marks = _usable(landmarks, footage)
    if marks is None:
        return turned
    landmarks = marks[0]
    state = State.zero(landmarks.point_in_world_m, len(footage.chain.drive), len(footage.row), counts)
    segment_of_image = footage.drives.pass_code
    seen = footage.observe(
        landmarks.voters, landmarks.landmark_of_voter(), segment_of_image, _sigmas(footage, NoiseLeft())
    )
    free = tuple(np.full((n, w), kind == MOUNT) for kind, (n, w) in enumerate(zip(counts, WIDTH, strict=True)))
    problem = Adjustment(seen, footage.chain, WIDE, free, len(landmarks), Links.none())
    state = adjust(problem, state, tolerances=_ALONE, with_variance=True)
    assert state.covariance is not None
    at = problem.column_of[MOUNT] - 3 * len(landmarks)
    variance = np.diag(state.covariance)[at]
    for axis in (0, 1):
        value, of = state.constants[MOUNT][:, axis], variance[:, axis]
        told = of < _TOLD_RAD**2
        excess = float(np.sum(value[told] ** 2 / of[told])) - int(told.sum())
        if excess > _SURE_SIGMAS * math.sqrt(2.0 * max(int(told.sum()), 1)):
            wide = max(float(np.average(value[told] ** 2 - of[told], weights=1.0 / of[told])), 0.0)
            turned[:, axis] = value * wide / (wide + of)
    return turned


def everything(footage: Footage, segments: Segments) -> tuple[Bools, ...]:
    """Return that all constants are free; focal lengths and delays where there are any."""
    cameras, drives = footage.cameras, footage.drives.count
    has_focal: Bools = np.zeros(cameras, np.bool_)
    has_focal[np.unique(footage.rays.camera_row[np.any(footage.from_middle_px != 0.0, axis=1)])] = True
    of_camera = np.ones(cameras, np.bool_)
    of_segments, of_drives = np.ones(len(segments), np.bool_), np.ones(drives, np.bool_)
    kinds = (of_segments, of_drives, of_drives, has_focal, of_camera, of_camera)
    return tuple(np.repeat(flags[:, None], width, axis=1) for flags, width in zip(kinds, WIDTH, strict=True))


def _usable(landmarks: Landmarks, footage: Footage) -> tuple[Landmarks, Floats] | None:
    """Return the landmarks whose covariances (N, 3, 3) are known, None where they are too few."""
    if len(landmarks) < 4:
        return None
    unit = _core.unit_covariance(
        footage.rays.core, landmarks.point_in_world_m, landmarks.offsets, landmarks.voters.astype(np.uint32)
    ).reshape(-1, 3, 3)
    covariance = _LANDMARK_PX**2 * unit + _LANDMARK_M**2 * np.eye(3)
    good: Bools = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    good[good] &= np.linalg.cond(covariance[good]) < 1e8
    good[good] &= np.trace(covariance[good], axis1=1, axis2=2) < 100.0**2
    if good.sum() < 4:
        return None
    counts = np.diff(landmarks.offsets)
    return (
        Landmarks(
            point_in_world_m=landmarks.point_in_world_m[good],
            class_code=landmarks.class_code[good],
            size_m=landmarks.size_m[good],
            drive=landmarks.drive[good],
            segment=landmarks.segment[good],
            driven_m=landmarks.driven_m[good],
            offsets=np.concatenate([[0], np.cumsum(counts[good])]),
            voters=landmarks.voters[np.repeat(good, counts)],
        ),
        covariance[good],
    )


def _first_segments(
    footage: Footage, landmarks: Landmarks, registration: Registration, seen_cuts: Segments
) -> tuple[Segments, Floats]:
    """Return the segments and offsets (L, 3) that jumps and registered shifts of landmarks along the drives suggest."""
    drives = footage.drives
    cuts = seen_cuts.cuts()
    for drive in range(drives.count):
        rows = np.flatnonzero(landmarks.drive == drive)
        rows = rows[np.argsort(landmarks.driven_m[rows], kind="stable")]
        same_segment = np.diff(landmarks.segment[rows]) == 0
        moves = np.linalg.norm(np.diff(registration.shift_m[rows], axis=0), axis=1) > _NEW_SEGMENT_M
        images = np.flatnonzero(drives.pass_code == drive)
        for cut in (np.flatnonzero(moves & same_segment) + 1).tolist():
            at_m = 0.5 * (landmarks.driven_m[rows[cut - 1]] + landmarks.driven_m[rows[cut]])
            after = images[drives.driven_m[images] >= at_m]
            if len(after):
                cuts.append((drive, int(drives.order[after].min())))
    segments = Segments.at(cuts)
    # A landmark is in the segment of most of its voters.
    image = footage.rays.image_row[landmarks.voters]
    segment = segments.of(drives.pass_code[image], drives.order[image])
    of_mark = (
        np.array([np.median(part) for part in np.split(segment, landmarks.offsets[1:-1])]).round().astype(np.int64)
    )
    offset = np.zeros((len(segments), 3))
    for number in range(len(segments)):
        marks = registration.shift_m[of_mark == number]
        if len(marks):
            offset[number] = np.median(marks, axis=0)
    return segments, offset


def _added(segments: Segments, offset: Floats, known: Segments, known_offset: Floats) -> tuple[Segments, Floats]:
    """Return the segments that both have cut, with both offsets (L, 3) added."""
    both = Segments.at(cut for of in (segments, known) for cut in of.cuts())
    return both, offset[segments.of(both.drive, both.begins)] + known_offset[known.of(both.drive, both.begins)]


def _objects(landmarks: Landmarks, registration: Registration) -> tuple[Ints, Ints, Floats, Floats]:
    """Return the object of each landmark, and class, size and position of each object."""
    kinds, first, thing = np.unique(registration.object_of_landmark, return_index=True, return_inverse=True)
    count = np.bincount(thing)
    place = landmarks.point_in_world_m + registration.shift_m
    points = np.stack([np.bincount(thing, weights=axis) / count for axis in place.T], axis=1)
    size = np.array([np.median(landmarks.size_m[thing == k]) for k in range(len(kinds))])
    return thing, landmarks.class_code[first], size, points


def _sigmas(footage: Footage, noise: NoiseLeft) -> Sigmas:
    """Return what detections are off by; a metre of the camera is as many pixels as the box of a thing of a metre."""
    return Sigmas(noise.total_px(footage.box_px), np.hypot(noise.px, noise.share * footage.box_px))


def own_scales(footage: Footage, noise: NoiseLeft, scales: Scales) -> Scales:
    """Return scales with more drift where more is found than was thought possible, and with errors of images.

    These are as large as they may be, were those of detections theirs. Which is which, residuals hardly tell where
    images show little; and with too small ones, what is noise of a drive's place would tell focal lengths. A share of a
    box is as many metres of an object of a metre.
    """
    own_rad = math.hypot(noise.px, noise.turn_px) / footage.usual_pixels_per_rad
    own_m = math.hypot(noise.image_m, noise.share)
    drift_m, drift_rad = max(scales.drift_m, noise.drift_m), max(scales.drift_rad, noise.drift_rad)
    return replace(scales, own_m=own_m, own_rad=own_rad, drift_m=drift_m, drift_rad=drift_rad)


def _cut(footage: Footage, now: Estimate, told: Trajectories) -> Estimate:
    """Cut drives anew where their poses jump, given the objects: exact segmentation of each drive's images.

    Jumps that trajectories prove are taken back first. They stay cuts; where one more cut pays there, the jump is
    another one than the trajectory says.
    """
    state, jumps = now.state, told.jumps
    shift, information, image_of = apparent_shift(footage, seen_by(footage, now), state)
    drives, offset_now = footage.drives, state.constants[OFFSET]
    begins: list[tuple[int, int]] = []
    offsets: list[Floats] = []
    refuted: set[tuple[int, int]] = set()
    segment_now = segments_of(footage, now.segments)
    for drive in range(drives.count):
        rows = np.flatnonzero(drives.pass_code[image_of] == drive)
        rows = rows[np.argsort(drives.order[image_of[rows]], kind="stable")]
        if not len(rows):
            old = np.flatnonzero(now.segments.drive == drive)[:1]
            begins.append((drive, 0))
            offsets.append(offset_now[old[0]] if len(old) else np.zeros(3))
            continue
        order, known = drives.order[image_of[rows]], jumps.segments.begins[jumps.segments.drive == drive]
        height_m = offset_now[segment_now[image_of[rows]], 2]
        pieces, wrong = _pieces(drive, order, shift[rows, :2], information[rows], height_m, known, told)
        refuted |= {(drive, begin) for begin in wrong}
        # Pieces hold what is left of the offsets once jumps are taken back.
        first = np.array(sorted(pieces))
        for begin in sorted({*pieces, *known.tolist()}):
            left = pieces[int(first[np.searchsorted(first, begin, side="right") - 1])]
            back = jumps.offset_m[jumps.segments.of(np.array([drive]), np.array([begin]))[0]]
            begins.append((drive, begin))
            offsets.append(left + back)
    new = Segments.at(begins)
    drift = state.drift.copy()
    drift[:, :3] = 0.0
    state = replace(state.with_offset(np.array(offsets)), drift=drift)
    return replace(now, segments=new, links=jumps.links(new, refuted), state=state)


def _pieces(
    drive: int, order: Ints, shift_m: Floats, information: Floats, height_m: Floats, known: Ints, told: Trajectories
) -> tuple[dict[int, Floats], list[int]]:
    """Return what is left of the offset (3) of each piece of a drive, by where it begins, and jumps that are refuted.

    Its images (N), in their `order`, put it so far off on the ground (N, 2), with information (N, 3, 3), and in height
    (N). Jumps begin where they are `known`: a piece that begins where one does refutes it.
    """
    of_drive = np.full(len(order), drive)
    value = shift_m - told.jumps.offset_m[told.jumps.segments.of(of_drive, order), :2]
    precision = np.linalg.inv(np.linalg.inv(information)[:, :2, :2])
    cut_at = told.seen_cuts.of(of_drive, order)
    is_shown = np.diff(cut_at, prepend=cut_at[0]) != 0
    starts = cut_into_segments(value, precision, prices(told.hints.between(drive, order), is_shown))
    pieces: dict[int, Floats] = {}
    refuted: list[int] = []
    for start, end in zip(starts, [*starts[1:], len(order)], strict=True):
        total = precision[start:end].sum(axis=0) + np.eye(2) / WIDE.constant[OFFSET] ** 2
        middle = np.linalg.solve(total, np.einsum("nij,nj->i", precision[start:end], value[start:end]))
        begin = 0
        if start > 0:
            between = known[(known > order[start - 1]) & (known <= order[start])].tolist()
            refuted += between
            begin = between[-1] if between else int(order[start])
        pieces[begin] = np.append(middle, np.median(height_m[start:end]))
    return pieces, refuted


def apparent_shift(footage: Footage, seen: Observations, state: State) -> tuple[Floats, Floats, Ints]:
    """Return where each image (M) that sees objects puts its drive: offset and drift (M, 3) and its information."""
    at = linearised(seen, state)
    weight = weights(seen, at.residual_px, at.depth_m, 2.0)
    groups = Groups(seen.image)
    kinds = seen.image[groups.row]
    now = state.constants[OFFSET][seen.segment] + state.drift[seen.node, :3]
    # The residual falls by `by_point` times the shift: r(o + e) = r - J e.
    whole = at.residual_px + np.einsum("nki,ni->nk", at.by_point, now)
    basis = np.concatenate([at.by_point, whole[:, :, None]], axis=2)
    basis[weight == 0.0] = 0.0
    basis *= np.sqrt(weight)[:, None, None]
    products = groups.products(basis)
    information, right = products[:, :3, :3], products[:, :3, 3]
    shift = np.linalg.solve(information + 0.1 * np.eye(3), right[:, :, None])[:, :, 0]
    # What drifts along the way is no jump: so many images share one value of the process.
    per_length = max(1.0, DRIFT_LENGTH_M * len(kinds) / max(1.0, footage.length_m))
    spread = np.linalg.inv(information + 0.1 * np.eye(3)) + per_length * (0.5 * WIDE.drift_m) ** 2 * np.eye(3)
    return np.asarray(shift), np.asarray(np.linalg.inv(spread)), kinds


def prices(evidence: Floats, is_shown: Bools) -> Floats:
    """Return what new segments (N) have to explain: their own price, and the odds of a jump before anything is known.

    What the trajectory speaks for a jump, `evidence`, speaks against these odds; where it shows one they do not count.
    """
    return _SEGMENT_PRICE + np.where(is_shown, 0.0, np.maximum(RARE - evidence, 0.0))


def cut_into_segments(value: Floats, precision: Floats, price: Floats) -> list[int]:
    """Return where the pieces of a piecewise constant signal (N, 2) with information (N, 2, 2) begin.

    The segmentation with the least sum of weighted squares and prices, by dynamic programming over the last cut
    (Jackson et al. 2005). `price` (N) is that of a piece that begins there.
    """
    count = len(value)
    moment = np.einsum("nij,nj->ni", precision, value)
    square = np.einsum("ni,ni->n", value, moment)
    a = np.concatenate([np.zeros((1, 3)), np.cumsum(precision[:, [0, 0, 1], [0, 1, 1]], axis=0)])
    b = np.concatenate([np.zeros((1, 2)), np.cumsum(moment, axis=0)])
    c = np.concatenate([[0.0], np.cumsum(square)])
    best = np.full(count + 1, np.inf)
    best[0] = -price[0]
    last = np.zeros(count + 1, np.int64)
    block = max(1, _PIECES // max(count, 1))
    for first in range(1, count + 1, block):
        until = min(first + block, count + 1)
        # What pieces cost, by where they end and begin.
        p, q = (sums[first:until, None] - sums[None, : until - 1] for sums in (a, b))
        determinant = p[:, :, 0] * p[:, :, 2] - p[:, :, 1] ** 2
        fit = p[:, :, 2] * q[:, :, 0] ** 2 - 2.0 * p[:, :, 1] * q[:, :, 0] * q[:, :, 1] + p[:, :, 0] * q[:, :, 1] ** 2
        piece = c[first:until, None] - c[: until - 1] - fit / np.maximum(determinant, 1e-12) + price[: until - 1]
        for end in range(first, until):
            total = best[:end] + piece[end - first, :end]
            last[end] = int(np.argmin(total))
            best[end] = total[last[end]]
    starts = []
    end = count
    while end > 0:
        starts.append(int(last[end]))
        end = int(last[end])
    return starts[::-1]


def associated(footage: Footage, now: Estimate, range_m: float) -> Estimate:
    """Merge objects that are one, give all detections their objects anew, and drop what too few see."""
    count, class_code, size_m = len(now.state.point_in_world_m), now.class_code, now.size_m
    seen = seen_by(footage, now)
    state = triangulate(seen, now.state, rounds=3)
    number = merge_objects(seen, state, seen.image, class_code, WIDE.drift_m)
    seen = replace(seen, thing=number[seen.thing])
    state = triangulate(seen, state, rounds=4)
    alive = np.bincount(seen.thing, minlength=count) >= LEAST_VOTES
    state, class_code, size_m = _kept(state, alive), class_code[alive], size_m[alive]
    segment = segments_of(footage, now.segments)
    detection, thing, _ = associate(footage, state, class_code, size_m, segment, now.sigma_px, range_m)
    alive = np.bincount(thing, minlength=len(class_code)) >= LEAST_VOTES
    new = np.cumsum(alive) - 1
    stays = alive[thing]
    return replace(
        now,
        detection=detection[stays],
        thing=new[thing[stays]],
        class_code=class_code[alive],
        size_m=size_m[alive],
        state=_kept(state, alive),
    )


def _kept(state: State, alive: Bools) -> State:
    return replace(state, point_in_world_m=state.point_in_world_m[alive])
