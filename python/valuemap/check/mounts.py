"""How cameras hang on their car: two may be exchanged, vehicle_from_cam may be taken for cam_from_vehicle, and one may
look any other way: by an angle in degrees that was read as radians, a sign, or the order of angles.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats, Ints
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.agreement import Comparison, compare
from valuemap.check.fault import (
    AGAINST,
    GATE_RAD,
    LEAST_CHANCE,
    LEAST_RISE,
    SMALL_TURNS_RAD,
    Convention,
    Fault,
    Finding,
    Fix,
    InTurn,
    Stage,
    View,
    gains_of_all,
    with_images,
    with_poses,
)
from valuemap.check.groups import Group, OfGroup, groups_of, only
from valuemap.check.headings import driving_azimuths, headings, level_rotations
from valuemap.check.others import points_of_others
from valuemap.check.sample import number_rows
from valuemap.dataset import Dataset, rows_of
from valuemap.tables import Images


class CamerasExchanged(Convention):
    """Two cameras of a car taken for each other: each has the poses of the other, its parameters, or both."""

    name: ClassVar[str] = "cameras_exchanged"
    what: ClassVar[str] = (
        "Two cameras of the car are taken for each other: each has the poses of the other, its parameters, or both."
    )
    do: ClassVar[str] = (
        "Give each camera its own place on the car and its own calibration (left for right, front for rear?)."
    )

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield the poses of each two cameras exchanged, where they expose together, and where their parameters differ
        also these, and both.
        """
        for first, second in pairs_of_a_car(dataset.images):
            poses = _Exchanged(first, second)
            yield f"poses of cameras {first} and {second} exchanged", poses
            parameters = _ExchangedParameters(first, second)
            if parameters.changes(dataset):
                yield f"parameters of cameras {first} and {second} exchanged", parameters
                both = InTurn(poses, parameters)
                yield f"poses and parameters of cameras {first} and {second} exchanged", both


class InvertedMounts(Convention):
    """vehicle_from_cam where cam_from_vehicle was expected, in poses that were made from those of the vehicle."""

    name: ClassVar[str] = "inverted_mounts"
    what: ClassVar[str] = "The mounts of the cameras go the wrong way: vehicle_from_cam was taken for cam_from_vehicle."
    do: ClassVar[str] = (
        "Invert the rotation and the position of each camera on the vehicle, and make the poses of the cameras anew; "
        "the fix turns the cameras in their places."
    )

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield mounts inverted, on vehicles with the axes that are in use: of one camera alone these are its axes."""
        if next(pairs_of_a_car(dataset.images), None) is None:
            return
        for name, vehicle_from_level in _VEHICLE_AXES.items():
            fix = _WithMountsInverted(vehicle_from_level)
            if fix.turns(dataset):
                yield f"mounts inverted on a vehicle with {name}", fix


_VEHICLE_AXES: dict[str, list[list[float]]] = {
    "x forward, y left, z up": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
    "x forward, y right, z down": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "the axes of a camera that looks ahead": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
}
"""Takes a point in the axes of a level camera that looks where the vehicle drives to those of the vehicle."""


class _WithMountsInverted:
    """Turns each camera as if its mount, by the way its vehicle drives, had been inverted.

    A camera that hangs by M on a vehicle at V has the pose M V, and with its mount inverted M^T V. That is N V with
    N = M^T, the mean of all its images against the way they are driven, so N^T N^T turns it right.
    """

    def __init__(self, vehicle_from_level: list[list[float]]) -> None:
        self._vehicle_from_level = np.array(vehicle_from_level, dtype=np.float64)

    def turns(self, dataset: Dataset) -> bool:
        """Return whether it turns any camera at all."""
        return any(np.trace(turn) < _NO_TURN for turn in self._turn_of_cameras(dataset).values())

    def __call__(self, dataset: Dataset) -> Dataset:
        rotation = rotation_matrices(dataset.images)
        for camera, turn in self._turn_of_cameras(dataset).items():
            mine = dataset.images.camera_id == camera
            rotation[mine] = turn @ rotation[mine]
        return with_poses(dataset, rotation, camera_centers(dataset.images))

    def _turn_of_cameras(self, dataset: Dataset) -> dict[int, Floats]:
        azimuth_rad, moves = driving_azimuths(dataset)
        vehicle = self._vehicle_from_level @ level_rotations(azimuth_rad, dataset.frame)
        mount = rotation_matrices(dataset.images) @ vehicle.transpose(0, 2, 1)
        turns = {}
        for camera in np.unique(dataset.images.camera_id[moves]).tolist():
            mean = Rotation.from_matrix(mount[moves & (dataset.images.camera_id == camera)]).mean().as_matrix()
            turns[camera] = mean.T @ mean.T
        return turns


_NO_TURN = 1.0 + 2.0 * np.cos(SMALL_TURNS_RAD.max())
"""The trace of a turn by so much: by less, a contest takes it for a turn in the mount."""


class CameraMount(Fault):
    """One camera of several, or those of one pass, that look another way than their poses say, whichever it is."""

    name: ClassVar[str] = "camera_mount"
    stage: ClassVar[Stage] = "fine"

    def find(self, view: View) -> Finding | None:
        """Turn each group so that its rays meet most points that others see; take the turn by which all rays gain most.

        How many points it must be, chance says; that all rays agree better is to bear it out. Turns as small as those
        that mounts are off by are measured, not sought.
        """
        groups = groups_of(view.dataset)
        found = [told for group in groups if (told := turned_by_others(view, group)) is not None]
        if not found:
            return None
        best = max(found, key=lambda each: each.comparison.difference)
        chance = best.turn.chance * len(groups)
        if chance > LEAST_CHANCE or best.comparison.chance * len(groups) > AGAINST:
            return None
        turn_deg = np.degrees(best.turn.angle_rad)
        yaw_deg, pitch_deg = np.degrees(_looks(best.turn(best.group.part(view.dataset))))
        side = "right" if yaw_deg > 0.0 else "left"
        finding = Finding(
            fault=self.name,
            what=f"it looks another way than its poses say: {abs(yaw_deg):.0f} degrees to the {side} of where it is "
            f"driven, and {pitch_deg:.0f} degrees up.",
            why=f"Turned by {turn_deg:.0f} degrees in its mount, its rays meet {best.turn.points} of {best.turn.of} "
            f"points that others see around it; the agreement of all rays rises by {best.comparison.difference:.0f} "
            f"({best.comparison.places} places).",
            do="Correct the rotation between car and camera: degrees for radians, a sign, the order of its angles?",
            chance=chance,
            figures={
                "turn_deg": round(float(turn_deg), 2),
                "yaw_deg": round(float(yaw_deg), 2),
                "pitch_deg": round(float(pitch_deg), 2),
                **best.comparison.to_json(),
            },
            fix=best.turn,
        )
        return only(best.group, finding)


def _looks(dataset: Dataset) -> tuple[float, float]:
    """Return how far most images look to the right of where they are driven, and how far up, in radians."""
    azimuth_rad, pitch_rad, _ = headings(dataset)
    way_rad, moves = driving_azimuths(dataset)
    aside = np.exp(1j * (azimuth_rad - way_rad)[moves])
    middle = np.mean(aside)
    return float(np.angle(middle) + np.median(np.angle(aside / middle))), float(np.median(pitch_rad[moves]))


@dataclass(frozen=True, eq=False)
class _Turn:
    """Cameras turned in their mount, so that their rays meet so many `points` `of` those that others see.

    `chance` is how likely any turn would make them meet as many by accident.
    """

    rotation: Rotation
    points: int
    of: int
    chance: float = 1.0

    @property
    def angle_rad(self) -> float:
        """By how much they are turned."""
        return float(self.rotation.magnitude())

    def __call__(self, dataset: Dataset) -> Dataset:
        turned = self.rotation.as_matrix() @ rotation_matrices(dataset.images)
        return with_poses(dataset, turned, camera_centers(dataset.images))


@dataclass(frozen=True, eq=False)
class _TurnOfGroup:
    """The turn of a group, and how much better all rays agree with it."""

    group: Group
    turn: _Turn
    comparison: Comparison


def turned_by_others(view: View, group: Group) -> _TurnOfGroup | None:
    """Return the turn of a group by which its rays meet what others see, None where it is small or not told."""
    bearings = _bearings(view, group)
    turn = None if bearings is None else best_turn(bearings, GATE_RAD * view.gate_share)
    if turn is None or turn.angle_rad < SMALL_TURNS_RAD[-1]:
        return None
    given = gains_of_all(view, view.dataset)
    comparison = compare(gains_of_all(view, OfGroup(group, turn)(view.dataset)), given)
    alone = group.alone(view)
    if comparison.difference < LEAST_RISE * float(gains_of_all(alone, alone.dataset).sum()):
        return None
    return _TurnOfGroup(group, turn, comparison)


@dataclass(frozen=True, eq=False)
class Bearings:
    """All pairs (N) of a ray of a group and a point of its place and class that others see, some of which meet.

    Unit vectors to the `point` in a level camera that looks where the image is driven, to the point in the camera as
    its pose has it, and along the ray in the camera. Only the second depends on how it is said to be mounted.
    """

    to_point_level: Floats
    to_point_in_cam: Floats
    ray_in_cam: Floats
    point: Ints


def _bearings(view: View, group: Group) -> Bearings | None:
    """Return the pairs of a group; None where there are none, or its rays meet what others see as they are."""
    points = points_of_others(view, group)
    if points is None or points.are_met(view.gate_px):
        return None
    rays = points.rays(points.part)
    ray, point = points.pairs(rays)
    if not len(ray):
        return None
    image = rays.image_row[ray]
    to_point = points.position_m[point] - rays.center_in_world_m[ray]
    to_point /= np.linalg.norm(to_point, axis=1, keepdims=True)
    azimuth_rad, _ = driving_azimuths(view.dataset)
    azimuth_rad = azimuth_rad[view.many_places.image_row][group.images_of(view.many_places.dataset)]
    level, given = level_rotations(azimuth_rad, view.dataset.frame)[image], rotation_matrices(points.part.images)[image]
    return Bearings(
        to_point_level=np.einsum("nij,nj->ni", level, to_point),
        to_point_in_cam=np.einsum("nij,nj->ni", given, to_point),
        ray_in_cam=np.einsum("nij,nj->ni", given, rays.direction_in_world[ray]),
        point=point,
    )


_MOST_PITCH_RAD = np.radians(25.0)
"""Cameras for the street look no higher or lower; and so far yaw and pitch of a ray and of its camera add up."""
_CELL_GATES = 8.0
"""Width of a cell of yaw and pitch: errors of poses, of headings along a drive, and of sums for turns in it."""
_MET_GATES = 2.0
"""A ray meets a point within this: good rays are off by a gate at most, and so is the point."""
_PEAKS, _ROUNDS = 3, 4
"""Cells that are followed of each grid, and for so long: both cost time, and are counted in the chance."""
_LEAST_POINTS = 3
"""Two points fit two rays by many turns."""
_SHIFTS = ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5))
"""Grids of cells, in shares of a cell: what lies at the border of two is in the middle of one of another grid."""


def best_turn(bearings: Bearings, gate_rad: float) -> _Turn | None:
    """Return the turn by which rays meet most points, each counted once however often a standing car sees it.

    Every pair says how the camera would look, were they one: the right ones say the same. The fullest cells of yaw and
    pitch are followed to the rotation that their pairs have in common (Wahba's problem).
    """
    level, ray = _yaw_and_pitch(bearings.to_point_level), _yaw_and_pitch(bearings.ray_in_cam)
    looks = np.stack([np.angle(np.exp(1j * (level[0] - ray[0]))), level[1] - ray[1]])
    may_be = np.flatnonzero(np.abs(looks[1]) < _MOST_PITCH_RAD)
    found = []
    for shift in _SHIFTS:
        grid = _GridOfTurns(looks[:, may_be], bearings.point[may_be], _CELL_GATES * gate_rad, shift)
        found += [may_be[grid.cell == peak] for peak in np.argsort(-grid.points, kind="stable")[:_PEAKS]]
    followed = [_followed(bearings, near, _MET_GATES * gate_rad) for near in found]
    best = max((each for each in followed if each is not None), key=lambda each: each.points, default=None)
    if best is None:
        return None
    grid = _GridOfTurns(looks[:, may_be], bearings.point[may_be], 2.0 * _MET_GATES * gate_rad, _SHIFTS[0])
    tried = grid.columns * grid.rows * len(_SHIFTS) * _ROUNDS
    return replace(best, chance=tried * float(stats.poisson.sf(best.points - 1, grid.usual_points)))


class _GridOfTurns:
    """Which `cell` of yaw and pitch each pair (N) is in, and how many different `points` (K) the pairs of each have."""

    def __init__(self, looks: Floats, point: Ints, width_rad: float, shift: tuple[float, float]) -> None:
        self.columns = max(int(2.0 * np.pi / width_rad), 1)
        self.rows = max(int(2.0 * _MOST_PITCH_RAD / width_rad), 1)
        column = np.floor(looks[0] / (2.0 * np.pi) * self.columns + shift[0]).astype(np.int64) % self.columns
        row = np.floor(looks[1] / width_rad + shift[1]).astype(np.int64)
        self.cell = number_rows(column, row)
        _, first = np.unique(self.cell, return_index=True)
        self._row_of_cell = row[first]
        _, first = np.unique(number_rows(self.cell, point), return_index=True)
        self.points = np.bincount(self.cell[first], minlength=len(self._row_of_cell))

    @property
    def usual_points(self) -> float:
        """How many a cell has on average, at the pitch at which it is most."""
        if not len(self.points):
            return 0.0
        row = self._row_of_cell - self._row_of_cell.min()
        return float(np.bincount(row, weights=self.points).max()) / self.columns


def _followed(bearings: Bearings, near: Ints, met_rad: float) -> _Turn | None:
    for _ in range(_ROUNDS):
        if len(np.unique(bearings.point[near])) < _LEAST_POINTS:
            return None
        weight = 1.0 / np.bincount(bearings.point[near])[bearings.point[near]]
        turn = _turn_between(bearings.to_point_in_cam[near], bearings.ray_in_cam[near], weight)
        missed_by = np.linalg.norm(turn.apply(bearings.to_point_in_cam) - bearings.ray_in_cam, axis=1)
        near = np.flatnonzero(missed_by < met_rad)
    return _Turn(turn, *(len(np.unique(each)) for each in (bearings.point[near], bearings.point)))


def _turn_between(first: Floats, second: Floats, weight: Floats) -> Rotation:
    """Return the rotation that takes unit vectors (N, 3) nearest to others, by weighted squares (Markley, 1988)."""
    left, _, right = np.linalg.svd((weight[:, None] * second).T @ first)
    return Rotation.from_matrix(left @ np.diag([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)]) @ right)


def _yaw_and_pitch(direction: Floats) -> tuple[Floats, Floats]:
    """Return how far directions (N, 3) in a level camera are to its right, and up, in radians."""
    return np.arctan2(direction[:, 0], direction[:, 2]), np.arcsin(np.clip(-direction[:, 1], -1.0, 1.0))


class _Exchanged:
    """Gives the images of two cameras that expose together the pose of the other."""

    def __init__(self, first: int, second: int) -> None:
        self._first, self._second = first, second

    def __call__(self, dataset: Dataset) -> Dataset:
        images = dataset.images
        first, second = exposed_together(images, self._first, self._second)
        row = np.arange(len(images))
        row[first], row[second] = second, first
        return with_images(
            dataset,
            cam_from_world_quat=images.cam_from_world_quat[row],
            cam_from_world_m=images.cam_from_world_m[row],
        )


class _ExchangedParameters:
    """Gives two cameras what the other one is in the table of cameras."""

    def __init__(self, first: int, second: int) -> None:
        self._first, self._second = first, second

    def changes(self, dataset: Dataset) -> bool:
        """Return whether the two have different parameters."""
        cameras = dataset.cameras
        first, second = rows_of(np.array([self._first, self._second]), cameras.camera_id)
        return not np.array_equal(cameras.params[first], cameras.params[second])

    def __call__(self, dataset: Dataset) -> Dataset:
        cameras = dataset.cameras
        first, second = rows_of(np.array([self._first, self._second]), cameras.camera_id)
        row = np.arange(len(cameras))
        row[first], row[second] = second, first
        changed = cameras.take(row).replace(camera_id=cameras.camera_id)
        return Dataset(**{**vars(dataset), "cameras": changed})


def pairs_of_a_car(images: Images) -> Iterator[tuple[int, int]]:
    """Yield each two cameras that expose together."""
    for first, second in itertools.combinations(np.unique(images.camera_id).tolist(), 2):
        if len(exposed_together(images, first, second)[0]):
            yield first, second


def exposed_together(images: Images, first: int, second: int) -> tuple[Ints, Ints]:
    """Return the rows (N) of images of one camera, and of another one that exposed with it (in the same pass).

    Two expose together if each is the nearest in time of the other's, and much nearer than the next of its own.
    """
    none = np.empty(0, dtype=np.int64)
    time = images.timestamp_s
    if time is None or not np.all(np.isfinite(time)):
        return none, none
    pairs = [(none, none)]
    for code in np.unique(images.pass_id.codes):
        rows = [np.flatnonzero((images.pass_id.codes == code) & (images.camera_id == each)) for each in (first, second)]
        if min(len(each) for each in rows) < 2:
            continue
        one, other = (each[np.argsort(time[each], kind="stable")] for each in rows)
        to, back = _nearest(time[one], time[other]), _nearest(time[other], time[one])
        mutual = back[to] == np.arange(len(one))
        step_s = min(float(np.median(np.diff(time[each]))) for each in (one, other))
        near = np.abs(time[other[to]] - time[one]) < step_s / 2.0
        pairs.append((one[mutual & near], other[to][mutual & near]))
    one, other = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return one, other


def _nearest(when: np.ndarray, others: np.ndarray) -> Ints:
    """Return the place in sorted times of the one nearest to each time."""
    after = np.clip(np.searchsorted(others, when), 1, len(others) - 1)
    return np.where(when - others[after - 1] <= others[after] - when, after - 1, after)
