"""The images and detections that the refinement works on, as arrays: one image of each camera and viewpoint."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from valuemap.arrays import Bools, Floats, Ints, runs
from valuemap.camera_models import places_of_params
from valuemap.cameras import Rays, camera_centers, camera_poses, cast_rays, rotation_of
from valuemap.dataset import Dataset, rows_of
from valuemap.drives import Drives, InOrder
from valuemap.refine.adjust import Chain
from valuemap.refine.jumps import MOST_STEPS
from valuemap.refine.landmarks import keyframes
from valuemap.refine.residuals import Observations, Views, rotations
from valuemap.tables import Images, Labels, Votes

NODE_M = 10.0
"""Drift is the same within so much of a drive."""
DRIFT_LENGTH_M = 100.0
"""The way over which drift forgets 63 % of itself."""
_SUDDEN = 3.0
"""A rate that changes from the step before to the step after by so many times what it does beside them changes at once.

It has no unit. Steady acceleration gives 2, a change at once has no limit: 3 is the first whole number that is neither.
From 1.5 to 12, what comes out is the same (`docs/notes/poses.md`).
"""
_TREMBLES = 4.0
"""Velocities before and after an image that differ by more than so many times what is usual are not the same."""


@dataclass(frozen=True, eq=False)
class Sigmas:
    """Standard deviations (detections), px: of all that is not in the model, and of the detection alone."""

    total_px: Floats
    detection_px: Floats


@dataclass(frozen=True, eq=False)
class Footage:
    """A dataset in driving order, its keyframes, and what is computed once from them.

    `row` are the rows of the keyframes in the dataset; all arrays of images are of keyframes, all of detections of
    those in them, `detection_row` their rows in the dataset.
    """

    dataset: Dataset
    drives: Drives
    whole: Dataset
    whole_drives: Drives
    row: Ints
    detection_row: Ints
    rays: Rays
    cam_from_world: Floats
    center_in_world_m: Floats
    camera: Ints
    chain: Chain
    node: Ints
    cam_from_node: Floats
    from_middle_px: Floats
    residual_from_cam: Floats
    late_s: float | None = None

    @cached_property
    def motion(self) -> Motion:
        """How keyframes move; where it is known how `late_s` poses are, in that part of each step alone."""
        motion = self.steps.motion(None if self.late_s is None else np.full(len(self.whole.images), self.late_s))
        return Motion(**{name: value[self.row] for name, value in vars(motion).items()})

    @cached_property
    def steps(self) -> StepsOfImages:
        """The steps from each image of the whole dataset to those beside it."""
        return find_steps(self.whole, self.whole_drives)

    @cached_property
    def length_m(self) -> float:
        """How far all drives came."""
        farthest_m = np.zeros(self.drives.count)
        np.maximum.at(farthest_m, self.drives.pass_code, self.drives.driven_m)
        return float(farthest_m.sum())

    @property
    def cameras(self) -> int:
        """The number of cameras."""
        return len(self.dataset.cameras)

    @cached_property
    def pixels_per_rad(self) -> Floats:
        """How far (detections), px, a detection moves when its image turns; NaN of one that has no ray."""
        square = np.sum(self.residual_from_cam[:, :2] ** 2, axis=(1, 2))
        along = np.einsum("nij,nj->ni", self.residual_from_cam[:, :2], self.residual_from_cam[:, 2])
        return np.asarray(np.sqrt(0.5 * (square - np.sum(along**2, axis=1))))

    @property
    def usual_pixels_per_rad(self) -> float:
        """The median of that of all detections that have a ray; NaN where none has."""
        known = self.pixels_per_rad[np.isfinite(self.pixels_per_rad)]
        return float(np.median(known)) if len(known) else math.nan

    @cached_property
    def box_px(self) -> Floats:
        """How high the boxes (detections) are, px."""
        return np.maximum(self.dataset.detections.size_px[:, 1], 0.0)

    def observe(self, detection: Ints, thing: Ints, segment_of_image: Ints, sigma_px: Sigmas) -> Observations:
        """Return detections (rows) as observations of things, sorted by drive and node."""
        order = np.lexsort((detection, self.node[self.rays.image_row[detection]]))
        return self.observe_as_given(detection[order], thing[order], segment_of_image, sigma_px)

    def observe_as_given(self, detection: Ints, thing: Ints, segment_of_image: Ints, sigma_px: Sigmas) -> Observations:
        """Return detections (rows) as observations of things, in their order."""
        views = Views(
            cam_from_world=self.cam_from_world,
            center_in_world_m=self.center_in_world_m,
            forward_mps=self.motion.forward_mps,
            backward_mps=self.motion.backward_mps,
            forward_radps=self.motion.forward_radps,
            backward_radps=self.motion.backward_radps,
            cam_from_node=self.cam_from_node,
            node=self.node,
            drive=self.drives.pass_code,
            segment=segment_of_image,
            vehicle=self.drives.pass_code,
            camera=self.camera,
        )
        return Observations(
            views,
            residual_from_cam=self.residual_from_cam[detection],
            from_middle_px=self.from_middle_px[detection],
            sigma_px=sigma_px.total_px[detection],
            detection_sigma_px=sigma_px.detection_px[detection],
            box_px=self.box_px[detection],
            thing=thing,
            image=self.rays.image_row[detection],
        )


@dataclass(frozen=True, eq=False)
class AllImages:
    """The dataset `ordered`, and all its images in the working frame, which is in units of `unit_m`."""

    ordered: InOrder
    unit_m: float
    footage: Footage


@dataclass(frozen=True, eq=False)
class Motion:
    """How images (N) move, m/s in the world, and turn, rad/s in camera axes, until the next and since the last one.

    Both are the mean of the two, unless they differ by more than poses tremble: an image moved towards the next one
    would else be moved towards the mean of both, and whatever the delay, half of the trembling would be gone.
    Where there are no times, of an image: a second is then an image.
    """

    forward_mps: Floats
    backward_mps: Floats
    forward_radps: Floats
    backward_radps: Floats
    is_timed: Bools


@dataclass(frozen=True, eq=False)
class Rates:
    """Rates (N, 3) over one step of each image: the mean, and those until `until_s` (N) and from then on."""

    mean: Floats
    first: Floats
    then: Floats
    until_s: Floats

    def within(self, late_s: Floats) -> Floats:
        """Return the mean rates (N, 3) of the first `late_s` (N) of each step."""
        before = np.where(late_s > self.until_s, self.until_s / np.where(late_s > 0.0, late_s, 1.0), 1.0)[:, None]
        return np.asarray(before * self.first + (1.0 - before) * self.then)


@dataclass(frozen=True, eq=False)
class StepsOfImages:
    """What `Motion` is made of: how images (N) move and turn in the step until the next and since the last one."""

    forward_mps: Rates
    backward_mps: Rates
    forward_radps: Rates
    backward_radps: Rates
    is_timed: Bools

    def motion(self, late_s: Floats | None = None) -> Motion:
        """Return how images move.

        Where it is known how `late_s` (N) they are, rates are those of so much of the step alone: where a turn begins
        or ends within it, it turns before or after that only.
        """
        forward, backward, turn_on, turn_back = (
            rates.mean if late_s is None else rates.within(np.abs(late_s))
            for rates in (self.forward_mps, self.backward_mps, self.forward_radps, self.backward_radps)
        )
        return Motion(forward, backward, turn_on, turn_back, self.is_timed)


def with_poses(images: Images, rotation: Floats, center: Floats) -> Images:
    """Return images with other poses as `camera_poses` gives them: rotations into cameras (N, 3, 3), centres (N, 3)."""
    quat = scipy.spatial.transform.Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    return images.replace(
        cam_from_world_quat=quat, cam_from_world_m=-np.einsum("nij,nj->ni", rotation_of(quat), center)
    )


def with_poses_in_order(images: Images, ordered: InOrder, rotation: Floats, center: Floats) -> Images:
    """Return images of the dataset `ordered`, in any order, with other poses, which are given in its order."""
    row = ordered.rows_of_images(images.image_id)
    return with_poses(images, rotation[row], center[row])


def in_working_frame(dataset: Dataset, drives: Drives, unit_m: float) -> tuple[Dataset, Drives]:
    """Return a dataset and its drives in the frame of this package: x east, y north, z up, in units of `unit_m`.

    Every length below is in such units, so that a world of another scale, with a range of that scale, gives the same.
    """
    rotation, center = camera_poses(dataset.images)
    center = points_in_working_frame(dataset, center, unit_m)
    sigma = dataset.images.position_sigma_m
    images = with_poses(dataset.images, rotation @ dataset.frame.east_north_up().T, center).replace(
        position_sigma_m=None if sigma is None else sigma / unit_m
    )
    frame = replace(dataset.frame, up=(0.0, 0.0, 1.0), anchor=None)
    return replace(dataset, images=images, frame=frame), replace(drives, driven_m=drives.driven_m / unit_m)


def points_in_working_frame(dataset: Dataset, point_in_world_m: Floats, unit_m: float) -> Floats:
    """Return points (N, 3) of the world of a dataset in the frame that `in_working_frame` gives it."""
    middle = np.median(camera_centers(dataset.images), axis=0)
    return np.asarray((point_in_world_m - middle) @ dataset.frame.east_north_up().T / unit_m)


def shown_objects(footage: Footage, ordered: InOrder, labels: Labels, votes: Votes) -> tuple[Ints, Ints, Ints, Ints]:
    """Return the detections (N) that labels of a map have, with their objects (N), and of each object its label.

    `footage` is of the dataset `ordered`: rows of that are the ids of its detections. Of each object (K) there are the
    row of its label and the place of its first detection among the N.
    """
    label = np.full(len(ordered.detection_id), -1)
    label[ordered.rows_of_detections(votes.detection_id)] = rows_of(votes.label_id, labels.label_id)
    label = label[footage.dataset.detections.detection_id]
    detection = np.flatnonzero(label >= 0)
    number, first = numbered_along(label[detection])
    return detection, number, label[detection][first], first


def numbered_along(label: Ints) -> tuple[Ints, Ints]:
    """Return the numbers of labels (N), each with what it is first of (K), in the order in which they come.

    Numbered along the drives, the order of labels does not show in the last digits.
    """
    _, first, code = np.unique(label, return_index=True, return_inverse=True)
    along = np.argsort(first)
    return np.argsort(along)[code], first[along]


def gather(dataset: Dataset, drives: Drives, *, every_image: bool = False) -> Footage:
    """Take the keyframes, or every image, of a dataset in driving order and in the working frame."""
    chosen = np.ones(len(dataset.images), np.bool_) if every_image else keyframes(drives, dataset.images.camera_id)
    row = np.flatnonzero(chosen)
    images = dataset.images.take(row)
    image_row = rows_of(dataset.detections.image_id, dataset.images.image_id)
    detection_row = np.flatnonzero(chosen[image_row])
    part = replace(dataset, images=images, detections=dataset.detections.take(detection_row), truth_detections=None)
    part_drives = drives.take(row)
    rays = cast_rays(part)
    rotation, center = camera_poses(images)
    camera = rows_of(images.camera_id, dataset.cameras.camera_id)
    chain, node, lead = _nodes(part_drives)
    cam_from_node = np.einsum("nij,nkj->nik", rotation, rotation[lead])
    # M (N, 3, 3) is in world axes: back into those of the camera.
    in_cam = np.einsum("nij,nkj->nik", rays.residual_from_world, rotation[rays.image_row])
    return Footage(
        dataset=part,
        drives=part_drives,
        whole=dataset,
        whole_drives=drives,
        row=row,
        detection_row=detection_row,
        rays=rays,
        cam_from_world=rotation,
        center_in_world_m=center,
        camera=camera,
        chain=chain,
        node=node,
        cam_from_node=cam_from_node,
        from_middle_px=_from_middle(part, rays),
        residual_from_cam=in_cam,
    )


def _nodes(drives: Drives) -> tuple[Chain, Ints, Ints]:
    """Return the chain of nodes, the node (N) of each image, and the image (N) whose axes the node's drift has."""
    piece = np.floor(drives.driven_m / NODE_M).astype(np.int64)
    code = drives.pass_code * (int(piece.max(initial=0)) + 1) + piece
    kinds, first, node = np.unique(code, return_index=True, return_inverse=True)
    drive = drives.pass_code[first]
    middle_m = np.bincount(node, weights=drives.driven_m) / np.bincount(node)
    # Nothing is kept from one drive to the next; how far into theirs both nodes are says nothing.
    keep = np.zeros(len(kinds))
    goes_on = np.flatnonzero(np.diff(drive) == 0)
    keep[goes_on + 1] = np.exp(-np.diff(middle_m)[goes_on] / DRIFT_LENGTH_M)
    # All cameras of an exposure turn with the first of it.
    exposure = drives.pass_code * (int(drives.order.max(initial=0)) + 1) + drives.order
    _, lead, of = np.unique(exposure, return_index=True, return_inverse=True)
    return Chain(drive, keep), node, lead[of]


def _from_middle(dataset: Dataset, rays: Rays) -> Floats:
    """Return detections (N, 2) relative to the principal point; 0 in cameras without a focal length."""
    offset = np.zeros((len(rays), 2))
    for row, model in enumerate(dataset.cameras.model.texts()):
        focal, middle = places_of_params(model)
        if focal:
            members = rays.camera_row == row
            offset[members] = dataset.detections.center_px[members] - dataset.cameras.params[row][middle]
    return offset


def find_steps(dataset: Dataset, drives: Drives) -> StepsOfImages:
    """Return the steps from all images to those of the same camera before and after them in the drive."""
    images = dataset.images
    rotation, center = camera_poses(images)
    time = np.full(len(images), np.nan) if images.timestamp_s is None else images.timestamp_s
    is_timed = np.zeros(len(images), np.bool_)
    speeds = _still(len(images)), _still(len(images))
    turns = _still(len(images)), _still(len(images))
    camera = np.unique(images.camera_id, return_inverse=True)[1]
    stream = drives.pass_code * (int(camera.max(initial=0)) + 1) + camera
    order = np.lexsort((drives.order, stream))
    for rows in runs(order, stream[order]):
        when = time[rows]
        timed = bool(np.all(np.isfinite(when)) and np.all(np.diff(when) > 0.0))
        when = when if timed else np.arange(len(rows), dtype=np.float64)
        is_timed[rows] = timed
        step_s = np.diff(when)
        if not len(step_s):
            continue
        usable = step_s <= MOST_STEPS * np.median(step_s)
        seconds = np.where(usable, step_s, np.inf)[:, None]
        _fill(*speeds, rows, np.diff(center[rows], axis=0) / seconds, step_s, usable)
        _fill(*turns, rows, _turns(rotation[rows]) / seconds, step_s, usable)
    return StepsOfImages(*speeds, *turns, is_timed)


def _still(images: int) -> Rates:
    mean, first, then = np.zeros((3, images, 3))
    return Rates(mean, first, then, np.full(images, np.inf))


def _fill(forward: Rates, backward: Rates, rows: Ints, rate: Floats, step_s: Floats, usable: Bools) -> None:
    """Write the rates of one camera in one drive, whose images are `rows` (N), from the means over steps (N - 1, 3)."""
    # At an end, as on the other side.
    starts, ends = np.append(True, ~usable), np.append(~usable, True)
    forward.mean[rows[:-1]], backward.mean[rows[1:]] = rate, rate
    backward.mean[rows[starts]] = forward.mean[rows[starts]]
    forward.mean[rows[ends]] = backward.mean[rows[ends]]
    same = _trembles(forward.mean[rows], backward.mean[rows])
    both = 0.5 * (forward.mean[rows] + backward.mean[rows])
    # At an end, both are those of the one step that there is.
    inside = ~(starts | ends)
    on, back = slice(None, -1), slice(None, 0, -1)
    for rates, images, steps in ((forward, on, slice(None)), (backward, back, slice(None, None, -1))):
        has_step = inside[images]
        of = rows[images][has_step]
        rates.first[rows], rates.then[rows] = rates.mean[rows], rates.mean[rows]
        rates.first[of], rates.then[of], rates.until_s[of] = (
            values[has_step] for values in rates_at_ends(rate[steps], step_s[steps], usable[steps])
        )
        for values in (rates.mean, rates.first, rates.then):
            values[rows[same]] = both[same]
        rates.until_s[rows[same]] = np.inf


def moved_on(motion: Motion, rotation: Floats, center: Floats, late_s: Floats) -> tuple[Floats, Floats]:
    """Return rotations (N, 3, 3) into cameras and centres (N, 3) so much later (N) than those given, or earlier."""
    late, ahead = late_s[:, None], late_s[:, None] >= 0.0
    moved = center + late * np.where(ahead, motion.forward_mps, motion.backward_mps)
    turned = rotations(late * np.where(ahead, motion.forward_radps, motion.backward_radps)) @ rotation
    return turned, moved


def _trembles(on: Floats, back: Floats) -> Bools:
    """Return at which images (N) only poses' trembling tells velocities (N, 3) after and before them apart.

    The mean of both has no part of the error of the image itself.
    """
    apart = np.linalg.norm(on - back, axis=1)
    return np.asarray(apart <= _TREMBLES * np.median(apart))


def rates_at_ends(rate: Floats, step_s: Floats, usable: Bools) -> tuple[Floats, Floats, Floats]:
    """Return the rates (N, 3) at the beginning and at the end of each step, and when (N), s, the first one ends.

    Steps that are not `usable` (N) tell nothing of those beside them. Rates, of places or of rotations, are means over
    steps. Where one is between those beside it, and they differ by far more than each of them from the one beyond it,
    the rate changes at once within the step, where it explains the mean (the subcell resolution of
    Harten 1989). Elsewhere it is the mean, which never ends.
    """
    first, then, until_s = rate.copy(), rate.copy(), np.full(len(rate), np.inf)
    if len(rate) < 5:
        return first, then, until_s
    change = np.where(usable[1:] & usable[:-1], np.linalg.norm(np.diff(rate, axis=0), axis=1), 0.0)
    across = rate[1:-3] - rate[3:-1]
    square = np.sum(across**2, axis=1)
    is_sudden = np.sqrt(square) > _SUDDEN * np.maximum(change[:-3], change[3:])
    share = np.sum((rate[2:-2] - rate[3:-1]) * across, axis=1) / np.where(square > 0.0, square, 1.0)
    is_sudden &= (share > 0.0) & (share < 1.0) & usable[1:-3] & usable[2:-2] & usable[3:-1]
    at = 2 + np.flatnonzero(is_sudden)
    first[at], then[at], until_s[at] = rate[at - 1], rate[at + 1], share[at - 2] * step_s[at]
    return first, then, until_s


def _turns(rotation: Floats) -> Floats:
    """Return the rotation vectors (N - 1, 3) in camera axes from each image to the next: R_next = exp(v) R."""
    between = np.einsum("nij,nkj->nik", rotation[1:], rotation[:-1])
    axis = np.stack(
        [between[:, 2, 1] - between[:, 1, 2], between[:, 0, 2] - between[:, 2, 0], between[:, 1, 0] - between[:, 0, 1]],
        axis=1,
    )
    sine = 0.5 * np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(between, axis1=1, axis2=2) - 1.0))
    return np.asarray(0.5 * axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None])
