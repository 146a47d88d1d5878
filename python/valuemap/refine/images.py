"""What single images are off by, told by all that each of them shows: a bundle adjustment with the objects of a map.

A map takes errors of poses as noise of each object apart. Where images are off by more than objects are apart, that
does not say which detection shows which. But an error of an image, and the drift of its drive, is one for all that it
shows: together, objects tell it. So images are moved by what they are probably off by given a map, and mapped again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

import valuemap._core as _core
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_poses
from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.drives import InOrder, in_driving_order
from valuemap.refine.adjust import Adjustment, SameObjects, Scales, adjust, triangulate
from valuemap.refine.estimate import WIDE, everything
from valuemap.refine.footage import (
    AllImages,
    Footage,
    Sigmas,
    gather,
    in_working_frame,
    numbered_along,
    points_in_working_frame,
    shown_objects,
    with_poses_in_order,
)
from valuemap.refine.jumps import Links, Segments
from valuemap.refine.poses import one_blas_thread
from valuemap.refine.residuals import Observations, State, corrected, cost
from valuemap.refine.select import LEAST_CHANCE, chance_of_gain, halves
from valuemap.robust import Noise
from valuemap.tables import Images, Labels, Votes

_TOLERANCES = (4.0, 3.0, 3.0, 3.0, 3.0)
"""Votes of a map are the wrong object's now and then: Cauchy's weights stay wide of what errors of images leave."""
_MOST_ASKED = 1000
"""Objects that say whether images are off, at most about: a part of them tells that as surely, in less time."""
_RUN = 100
"""Objects side by side along drives that are asked together: what an image shows lies side by side."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """The images of a dataset with what they see of the things (K) of a map, which are of its labels `label` (K).

    A thing is an object, or what a side shows of it where sides show other middles: `ties` are to the objects then,
    which are things behind these. `scales` are what errors of images and drift are thought to be a priori, in the
    working frame.
    """

    of: AllImages
    seen: Observations
    scales: Scales
    state: State
    label: Ints
    ties: SameObjects

    def adjusted(self, seen: Observations) -> State:
        """Return objects, drift and errors of images as some of the observations tell them."""
        with one_blas_thread():
            return adjust(self._problem(seen), self.state, tolerances=_TOLERANCES)

    def _problem(self, seen: Observations) -> Adjustment:
        footage = self.of.footage
        none = tuple(np.zeros_like(flags) for flags in everything(footage, _whole_drives(footage)))
        return Adjustment(
            seen, footage.chain, self.scales, none, len(self.state.point_in_world_m), Links.none(), self.ties
        )

    def gain(self) -> tuple[float, float]:
        """Return by how much rays of objects meet better that had no part in it, and the chance that it is luck.

        The gain is in units of chi-squared, of poses as each half of the objects has them for the other half.
        """
        things = len(self.label)
        half = halves(self.state.point_in_world_m[:things])
        asked = self.seen.take(asked_in_runs(things)[self.seen.thing])
        if len(np.unique(half[asked.thing])) < 2:  # There is no other half.
            return 0.0, 1.0
        gains = []
        for side in (0, 1):
            judged = asked.take(half[asked.thing] != side)
            poses = corrected(judged.views, self.adjusted(asked.take(half[asked.thing] == side)))
            views = replace(
                judged.views, cam_from_world=poses.cam_from_world, center_in_world_m=poses.center_in_world_m
            )
            given, moved = (
                np.bincount(rays.thing, weights=cost(rays, triangulate(rays, self.state)), minlength=things)
                for rays in (judged, replace(judged, views=views))
            )
            gains.append((given - moved)[np.unique(judged.thing)])
        return float(np.concatenate(gains).sum()), chance_of_gain(np.concatenate(gains))

    def is_proven(self) -> tuple[bool, dict[str, float]]:
        """Return whether the gain is hardly luck, and what `run.json` says of it."""
        gain, chance = self.gain()
        return chance < LEAST_CHANCE, {"gain_on_held_out": round(gain, 1), "chance_of_that": float(f"{chance:.2g}")}

    def images(self, like: Images) -> Images:
        """Return images `like` those of the dataset with the poses that they probably have.

        They state no errors: what the poses stated is what they were off by before.
        """
        poses = corrected(self.seen.views, self.adjusted(self.seen))
        ordered, step = self.of.ordered, poses.center_in_world_m - self.of.footage.center_in_world_m
        axes = ordered.dataset.frame.east_north_up()
        center = camera_poses(ordered.dataset.images)[1] + self.of.unit_m * step @ axes
        moved = with_poses_in_order(like, ordered, poses.cam_from_world @ axes, center)
        return moved.replace(position_sigma_m=None, rotation_sigma_rad=None)

    def placed(self, groups: Ints) -> tuple[Floats, Floats]:
        """Return where things (K, 3) probably are, m, and how well that is known of groups (G, M) of them together, m².

        The covariances are (G, 3 M, 3 M), with errors of all images and drift marginalised. All is in the working
        frame.
        """
        with one_blas_thread():
            problem = self._problem(self.seen)
            state = adjust(problem, self.state, tolerances=_TOLERANCES)
            covariance = problem.step(state, _TOLERANCES[-1], of_groups=groups)[0].covariance
        assert covariance is not None
        return self.of.unit_m * state.point_in_world_m, self.of.unit_m**2 * covariance

    def covariances(self) -> tuple[Ints, Floats]:
        """Return labels (L) with their covariances (L, 3, 3) in m², errors of all images and drift marginalised."""
        axes = self.of.ordered.dataset.frame.east_north_up()
        label, thing = np.unique(self.label, return_index=True)
        covariance_m2 = self.placed(self.object_of(thing)[:, None])[1]
        return label, np.asarray(axes.T @ covariance_m2 @ axes, np.float64)

    def object_of(self, thing: Ints) -> Ints:
        """Return the objects (N) that things (N) are, or are sides of."""
        object_of_thing = np.arange(len(self.label))
        object_of_thing[self.ties.first] = self.ties.second
        return np.asarray(object_of_thing[thing])


def gather_images(dataset: Dataset, config: MapConfig) -> AllImages:
    """Return all images of a dataset as maps are bundled with them."""
    return images_in_order(in_driving_order(dataset, viewpoint_step_m=config.vote.unit_m), config)


def images_in_order(ordered: InOrder, config: MapConfig) -> AllImages:
    """Return the same of a dataset that is in driving order."""
    unit_m = config.vote.unit_m
    return AllImages(
        ordered, unit_m, gather(*in_working_frame(ordered.dataset, ordered.drives, unit_m), every_image=True)
    )


def bundle(images: AllImages, labels: Labels, votes: Votes, noise: Noise) -> Bundle:
    """Return images with what they see of a map; `noise` is that of maps of their poses.

    The map may have been made with other poses of the same images. Sides are things of their own where they show other
    middles.
    """
    ordered, unit_m, footage = images.ordered, images.unit_m, images.footage
    detection, thing, label, _ = shown_objects(footage, ordered, labels, votes)
    if noise.side_m:
        thing, label = _by_side(footage, detection, thing, label)
    box = np.maximum(footage.dataset.detections.size_px[:, 1], 0.0)
    alone = np.hypot(noise.detection_px, noise.box_share * box)
    # As everywhere in this package, a metre of the camera is as many pixels as the box of a thing of a metre.
    of_image = np.hypot(noise.position_m / unit_m * box, noise.rotation_rad * footage.pixels_per_rad)
    segments = _whole_drives(footage)
    seen = footage.observe(detection, thing, footage.drives.pass_code, Sigmas(np.hypot(alone, of_image), alone))
    scales = Scales(
        drift_m=max(math.hypot(noise.position_drift_m, noise.position_segment_m) / unit_m, 1e-3),
        drift_rad=max(math.hypot(noise.rotation_drift_rad, noise.rotation_segment_rad), 1e-5),
        own_m=max(noise.position_m / unit_m, 1e-3),
        own_rad=max(noise.rotation_rad, 1e-5),
        constant=WIDE.constant,
    )
    points = points_in_working_frame(ordered.dataset, labels.position_in_world_m[label], unit_m)
    ties, objects = SameObjects.none(), points[:0]
    if noise.side_m:
        # Sides are where their objects are, but for their middles; objects are numbered behind them.
        of_side, first = numbered_along(label)
        side, apart = noise.side_m / unit_m, math.hypot(noise.side_m / unit_m, math.sqrt(2.0) * scales.drift_m)
        ties, objects = SameObjects(np.arange(len(label)), len(label) + of_side, side, apart), points[first]
    counts = tuple(map(len, everything(footage, segments)))
    state = State.zero(np.concatenate([points, objects]), len(footage.chain.drive), len(footage.row), counts)
    return Bundle(images, seen, scales, triangulate(seen, state), label, ties)


def _by_side(footage: Footage, detection: Ints, thing: Ints, label: Ints) -> tuple[Ints, Ints]:
    """Return what sides show of objects as things: that of each detection (N), and the label of each (K)."""
    image = footage.rays.image_row[detection]
    visit, of_visit = np.unique(np.stack([thing, footage.drives.pass_code[image]]), axis=1, return_inverse=True)
    direction = np.zeros((visit.shape[1], 3))
    np.add.at(direction, of_visit.ravel(), footage.rays.direction_in_world[detection])
    side = np.asarray(_core.sides(visit[0].astype(np.uint32), direction), np.int64)
    things, thing = np.unique(np.stack([visit[0], side])[:, of_visit.ravel()], axis=1, return_inverse=True)
    return thing.ravel(), label[things[0]]


def asked_in_runs(things: int) -> Bools:
    """Return which of the objects (K), numbered along the drives, are asked: runs of them, evenly spread."""
    step = -(-things // _MOST_ASKED)
    is_asked: Bools = np.arange(things) // _RUN % step == 0
    return is_asked


def _whole_drives(footage: Footage) -> Segments:
    count = footage.drives.count
    return Segments(np.arange(count), np.zeros(count, np.int64))
