"""What a map looks like from above, in metres: horizontal axes, driven streets, ellipses, the extent of it all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, Frame
from valuemap.drives import find_drives
from valuemap.map_folder import Map
from valuemap.tables import Categories, Images
from valuemap.tables.covariance import covariance_matrices

ELLIPSE_SIGMAS = 2.4477468306808161
"""Half axis of the ellipse that holds 95 % of a 2D normal distribution: sqrt(chi2.ppf(0.95, 2))."""

_LONGEST_JOIN_M = 200.0
"""A pass that goes on after a gap no longer than this, in a direction that fits, drove through the gap."""
_AHEAD_COSINE = math.cos(math.radians(25.0))
_FAR_M = 150.0
"""Labels farther than this from all that was driven do not decide what the picture shows."""


class Outcomes(Protocol):
    """What a picture needs of a comparison with the truth (`valuemap.evaluate.Matches` has it)."""

    @property
    def object_in_world_m(self) -> Floats:
        """Positions (objects, 3) of the true objects."""

    @property
    def object_outcome(self) -> Categories:
        """found, missed or not recoverable (objects)."""

    @property
    def label_outcome(self) -> Categories:
        """true, duplicate, false or gone (labels)."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Everything to draw, in metres along two horizontal axes.

    `drives` are pictured stretches, each (n, 2); `joins` the probable ways between them. `half_axes_m` (labels, 2;
    major first) and `angle_rad` (labels) of the major one are those of the 95 % ellipses; `objects` and `outcomes`
    hold the rows of each outcome by its text, `outcomes` None where nothing was compared. `is_there` says which labels
    no update found to be gone.
    """

    axis_names: tuple[str, str]
    drives: list[Floats]
    joins: list[Floats]
    label_points: Floats
    label_class: Categories
    is_there: Bools
    half_axes_m: Floats
    angle_rad: Floats
    object_points: Floats
    objects: dict[str, Ints]
    outcomes: dict[str, Ints] | None

    def all_points(self) -> Floats:
        """Return the labels and the true objects."""
        return np.concatenate([self.label_points, self.object_points])


def look_down(result: Map, dataset: Dataset | None = None, matches: Outcomes | None = None) -> Ground:
    """Return a map as it looks from above, with what was driven and with the truth where they are known."""
    axes_in_world, axis_names = horizontal_axes(result.frame)
    half_axes_m, angle_rad = ellipses(result.labels.stated_covariance_m2, axes_in_world)
    drives, joins = ([], []) if dataset is None else drives_of(dataset.images, axes_in_world)
    return Ground(
        axis_names=axis_names,
        drives=drives,
        joins=joins,
        label_points=result.labels.position_in_world_m @ axes_in_world.T,
        label_class=result.labels.class_name,
        is_there=result.is_there,
        half_axes_m=half_axes_m,
        angle_rad=angle_rad,
        object_points=np.empty((0, 2)) if matches is None else matches.object_in_world_m @ axes_in_world.T,
        objects={} if matches is None else _rows_by_text(matches.object_outcome),
        outcomes=None if matches is None else _rows_by_text(matches.label_outcome),
    )


def horizontal_axes(frame: Frame) -> tuple[Floats, tuple[str, str]]:
    """Return unit vectors to the right and to the top of a picture (2, 3), and their names."""
    up = np.array(frame.up)
    forward = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    right = forward - (forward @ up) * up
    right /= np.linalg.norm(right)
    basis = np.stack([right, np.cross(up, right)])
    if frame.is_georeferenced:
        return basis, ("east (m)", "north (m)")
    return basis, (f"{_axis_name(basis[0], 'right')} (m)", f"{_axis_name(basis[1], 'ahead')} (m)")


def _axis_name(direction: Floats, otherwise: str) -> str:
    """Return x, y or z with its sign where the direction is that of an axis of the world."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 1.0 - 1e-6:
        return otherwise
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def _rows_by_text(outcome: Categories) -> dict[str, Ints]:
    return {name: np.flatnonzero(outcome.codes == code) for code, name in enumerate(outcome.names)}


def ellipses(covariance_m2: Floats, axes_in_world: Floats) -> tuple[Floats, Floats]:
    """Return half axes (N, 2; major first) in metres and angles (N) of the 95 % ellipses of covariances (N, 6)."""
    flat = axes_in_world @ covariance_matrices(covariance_m2) @ axes_in_world.T
    variance, direction = np.linalg.eigh(flat)  # Ascending.
    half_axes_m = ELLIPSE_SIGMAS * np.sqrt(np.maximum(variance[:, ::-1], 0.0))
    return half_axes_m, np.arctan2(direction[:, 1, 1], direction[:, 0, 1])


# What was driven.


def drives_of(images: Images, axes_in_world: Floats) -> tuple[list[Floats], list[Floats]]:
    """Return the pictured stretches, each (n, 2), and the probable ways between those of one pass, each (n, 2).

    Images of a pass in order make stretches, cut where the pass jumps. Where it goes on after a gap, straight on or
    around one corner, it probably drove through the gap and took no pictures.
    """
    found = find_drives(images)
    order = np.lexsort((found.order, found.pass_code, images.pass_id.codes))
    exposure = np.stack([found.pass_code, found.order])[:, order]
    order = order[np.append(True, np.any(np.diff(exposure, axis=1) != 0, axis=0))]  # One image of each rig.
    points = (camera_centers(images) @ axes_in_world.T)[order]
    pass_code, drive_code = images.pass_id.codes[order], found.pass_code[order]
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    moving = step[step > 0.0]
    longest_step = max(25.0, 5.0 * float(np.median(moving))) if len(moving) else 0.0
    cuts = np.flatnonzero((np.diff(drive_code) != 0) | (np.diff(pass_code) != 0) | (step > longest_step)) + 1
    drives = [np.asarray(drive) for drive in np.split(points, cuts)]
    joins = [
        way
        for before, after, cut in zip(drives, drives[1:], cuts, strict=False)
        if pass_code[cut - 1] == pass_code[cut] and (way := _way_between(before, after)) is not None
    ]
    return drives, joins


def _way_between(before: Floats, after: Floats) -> Floats | None:
    """Return the probable way (n, 2) from the end of one stretch to the start of another; None where there is none."""
    start, end = before[-1], after[0]
    gap = end - start
    length = float(np.linalg.norm(gap))
    ahead, behind = _heading(before[::-1]), _heading(after)
    if ahead is None or behind is None or not 0.0 < length <= _LONGEST_JOIN_M:
        return None
    ahead = -ahead  # The stretch was reversed, to begin at its end.
    if min(float(ahead @ gap), float(behind @ gap)) >= _AHEAD_COSINE * length:
        return np.stack([start, end])
    # One corner: ahead from the start, and from there in the direction that the other stretch begins with.
    turn = float(ahead[0] * behind[1] - ahead[1] * behind[0])
    if abs(turn) < 0.5:
        return None
    to_corner = float(gap[0] * behind[1] - gap[1] * behind[0]) / turn
    from_corner = float(ahead[0] * gap[1] - ahead[1] * gap[0]) / turn
    if min(to_corner, from_corner) < -5.0 or max(to_corner, from_corner) > _LONGEST_JOIN_M:
        return None
    return np.stack([start, start + to_corner * ahead, end])


def _heading(stretch: Floats) -> Floats | None:
    """Return the direction (2) in which a stretch begins, over its first 10 m; None where it does not move."""
    away = stretch - stretch[0]
    distance = np.linalg.norm(away, axis=1)
    far = np.flatnonzero(distance >= min(10.0, float(distance.max(initial=0.0))))
    if len(far) == 0 or distance[far[0]] < 1.0:
        return None
    return np.asarray(away[far[0]] / distance[far[0]])


def thinned(line: Floats, step_m: float) -> Floats:
    """Return a line (N, 2) without points that are in the same cell of the ground as the one before; its ends stay."""
    cell = np.floor(line / step_m)
    keep = np.ones(len(line), np.bool_)
    keep[1:-1] = np.any(cell[1:-1] != cell[:-2], axis=1)
    return line[keep]


# Where to look.


def extent_of(ground: Ground) -> tuple[Floats, Floats, int]:
    """Return lower left corner (2) and size (2) in metres of what a picture should show, and how much it leaves out.

    It shows everything that was driven and all labels and objects but those far away from it.
    """
    points = ground.all_points()
    left_out = 0
    if ground.drives:
        driven = np.concatenate(ground.drives)
        low, high = driven.min(axis=0), driven.max(axis=0)
        reach = max(_FAR_M, 0.1 * float(max(high - low)))
        near = np.all((points >= low - reach) & (points <= high + reach), axis=1)
        left_out = int(np.sum(~near))
        points = np.concatenate([driven, points[near]])
    if len(points) == 0:
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * max(*(high - low), 20.0)
    size: Floats = high - low + 2.0 * margin
    return low - margin, size, left_out


def busiest_place(points: Floats, size_m: float) -> Floats:
    """Return the middle (2) of the square of that size that holds most of the points (N, 2) of those around each."""
    from scipy.spatial import KDTree  # Slow to import, and only pictures need it.

    distinct = np.unique(points, axis=0)  # Sorted, so that ties do not depend on the order of rows.
    tree = KDTree(distinct)
    near = tree.query_ball_point(distinct, 0.4 * size_m, p=np.inf, return_length=True)
    chosen = tree.query_ball_point(distinct[np.argmax(near)], 0.4 * size_m, p=np.inf, return_sorted=True)
    around = distinct[chosen]
    return np.asarray((around.min(axis=0) + around.max(axis=0)) / 2.0)


def closest_pair(points: Floats) -> tuple[Floats, float]:
    """Return the middle (2) of the two closest of some points (N, 2) and their distance; of one, itself and 0."""
    from scipy.spatial import KDTree  # Slow to import, and only pictures need it.

    ordered = points[np.lexsort(points.T[::-1])]
    if len(ordered) < 2:
        return ordered[0], 0.0
    distance, neighbor = (np.asarray(each) for each in KDTree(ordered).query(ordered, k=2))
    first = int(np.argmin(distance[:, 1]))
    return np.asarray((ordered[first] + ordered[neighbor[first, 1]]) / 2.0), float(distance[first, 1])
