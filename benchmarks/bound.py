"""The Cramer-Rao bound of positions: the best that any unbiased method can do with the same views and noise."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from valuemap.arrays import Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.dataset import rows_of
from valuemap.simulate import Recording
from valuemap.tables import Table


@dataclass(frozen=True, eq=False)
class Views(Table):
    """Which detection shows which object, and how a residual in pixels moves: sorted by object, pass and distance.

    `of_point` (N, 2, 3) is its derivative by the object's position in m, which is also that by the camera's but for
    the sign; `of_turn` (N, 2, 3) that by a rotation vector in rad in camera axes; `pixel_sigma` (N) the deviation of
    the box's centre, each axis; `distance_m` (N) driven since the start of the pass; `exposure_row` (N) is one number
    for all that the cameras of a car took at one time. The cameras of a car turn together: `of_turn` is by the turn of
    a camera that looks ahead.
    """

    object_row: Ints
    pass_row: Ints
    distance_m: Floats
    of_point: Floats
    of_turn: Floats
    pixel_sigma: Floats
    exposure_row: Ints


def cramer_rao_covariances(views: Views, config: SimulationConfig, objects: int) -> Floats:
    """Return the bound (objects, 3, 3) in m² of an unbiased estimate from these views under the simulator's noise.

    With the covariance S of the residuals of all views of an object in a pass and their derivatives J by its position,
    the pass tells J^T S^-1 J of that, and passes add up. Objects without views get infinite variances.
    """
    information = np.zeros((objects, 3, 3))
    is_new = (np.diff(views.object_row) != 0) | (np.diff(views.pass_row) != 0)
    for start, end in itertools.pairwise([0, *(np.flatnonzero(is_new) + 1).tolist(), len(views)]):
        of_one = views.take(np.arange(start, end))
        of_point = of_one.of_point.reshape(-1, 3)
        factor = cho_factor(residual_covariance(of_one, config))
        information[of_one.object_row[0]] += of_point.T @ cho_solve(factor, of_point)
    bound = np.full_like(information, np.inf)
    seen = np.linalg.det(information) > 0.0
    bound[seen] = np.linalg.inv(information[seen])
    return bound


def joint_cramer_rao_covariance(views: Views, config: SimulationConfig, objects: int) -> Floats:
    """Return the bound (objects, 3, objects, 3) in m² of all objects together, from all views of each pass together.

    An error of a pose is one for all that its image shows, so that objects tell it, and are better known against each
    other than each alone. It is the bound where it is known which detection shows which object. Objects that fewer than
    two views show have infinite variances.
    """
    information = np.zeros((objects, 3, objects, 3))
    for number in np.unique(views.pass_row):
        of_pass = views.take(np.flatnonzero(views.pass_row == number))
        whitened = cho_solve(cho_factor(residual_covariance(of_pass, config)), of_objects(of_pass, objects))
        information += (of_objects(of_pass, objects).T @ whitened).reshape(information.shape)
    rows = np.flatnonzero(np.bincount(views.object_row, minlength=objects) >= 2)
    bound = np.zeros_like(information)
    bound[np.arange(objects), :, np.arange(objects), :] = np.diag([np.inf] * 3) if objects else 0.0
    seen = information[rows][:, :, rows].reshape(3 * len(rows), 3 * len(rows))
    bound[rows[:, None], :, rows[None, :], :] = (
        np.linalg.inv(seen).reshape(len(rows), 3, len(rows), 3).transpose(0, 2, 1, 3)
    )
    return bound


def of_objects(views: Views, objects: int) -> Floats:
    """Return the derivatives (2N, 3 objects) of the residuals of views (N) by the positions of all objects."""
    derivatives = np.zeros((len(views), 2, objects, 3))
    derivatives[np.arange(len(views)), :, views.object_row] = views.of_point
    return derivatives.reshape(2 * len(views), 3 * objects)


def true_views(recording: Recording) -> Views:
    """Return detections that show whole objects, one of each in an image, with true poses, boxes and derivatives."""
    dataset, config, objects = recording.dataset, recording.config, recording.city.objects
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    object_row = rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)
    detection = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    frame_row = rows_of(dataset.detections.image_id[detection], dataset.images.image_id)
    # A box of a part is around another middle, and a second box of a sighting tells nothing.
    whole = np.flatnonzero(~recording.boxes.is_cut[detection])
    once = whole[np.unique(np.stack([object_row[whole], frame_row[whole]]), axis=1, return_index=True)[1]]
    object_row, frames = object_row[once], recording.frames.take(frame_row[once])
    cam_from_world = frames.cam_from_world()
    in_cam = np.einsum("nij,nj->ni", cam_from_world, objects.position_in_world_m[object_row] - frames.center_in_world_m)
    x, y, depth = in_cam.T
    of_cam = np.zeros((len(depth), 2, 3))
    of_cam[:, 0, 0] = of_cam[:, 1, 1] = config.focal_px / depth
    of_cam[:, 0, 2], of_cam[:, 1, 2] = -config.focal_px * x / depth**2, -config.focal_px * y / depth**2
    height_px = config.focal_px * objects.size_m[object_row, 1] / depth
    of_turn = np.cross(in_cam[:, None], of_cam)
    if config.cameras > 1:
        aside_rad = np.radians(config.camera_spread_deg) * ((config.cameras - 1) / 2.0 - frames.camera_row)
        ahead = frames.replace(heading_rad=frames.heading_rad - aside_rad).cam_from_world()
        of_turn = of_turn @ cam_from_world @ ahead.transpose(0, 2, 1)
    views = Views(
        object_row=object_row,
        pass_row=frames.pass_row,
        distance_m=frames.distance_m,
        of_point=of_cam @ cam_from_world,
        of_turn=of_turn,
        pixel_sigma=np.hypot(config.pixel_noise_px, config.pixel_noise_share * height_px),
        exposure_row=frames.exposure_row,
    )
    return views.take(np.lexsort((views.distance_m, views.pass_row, views.object_row)))


def residual_covariance(views: Views, config: SimulationConfig) -> Floats:
    """Return the covariance (2N, 2N) in px² of the residuals, x and y in turn, of views (N) of one pass.

    A pose error has a part of each image of its own and an Ornstein-Uhlenbeck process over the distance driven, whose
    values d apart correlate with exp(-d / drift_length_m), and another with middle_length_m; see
    simulate/pose_errors.py. All cameras of an exposure share them.
    """
    apart_m = np.abs(views.distance_m[:, None] - views.distance_m)
    own = np.asarray(views.exposure_row[:, None] == views.exposure_row, dtype=np.float64)
    drift, middle = np.exp(-apart_m / config.drift_length_m), np.exp(-apart_m / config.middle_length_m)
    white_rad, drift_rad, middle_rad = np.radians(
        [config.rotation_white_deg, config.rotation_drift_deg, config.rotation_middle_deg]
    )
    position = config.position_white_m**2 * own + config.position_drift_m**2 * drift
    position += config.position_middle_m**2 * middle
    rotation = white_rad**2 * own + drift_rad**2 * drift + middle_rad**2 * middle
    covariance = np.diag(np.repeat(views.pixel_sigma**2, 2))
    for derivative, between_images in ((views.of_point, position), (views.of_turn, rotation)):
        rows = derivative.reshape(-1, 3)
        covariance += rows @ rows.T * between_images.repeat(2, axis=0).repeat(2, axis=1)
    return np.asarray(covariance)
