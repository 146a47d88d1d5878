"""Poses as people give them: azimuth, pitch and roll of a camera, and the direction it is driven in."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.sample import drive_of_camera, order_by_camera
from valuemap.dataset import Dataset, Frame
from valuemap.drives.way import azimuths_along


def headings(dataset: Dataset) -> tuple[Floats, Floats, Floats]:
    """Return azimuth (clockwise from north), pitch (up) and roll (N each) in radians of the cameras."""
    rotation = rotation_matrices(dataset.images)
    east, north = dataset.frame.east_north()
    up = np.array(dataset.frame.up)
    right, forward = rotation[:, 0], rotation[:, 2]
    azimuth = np.arctan2(forward @ east, forward @ north)
    pitch = np.arcsin(np.clip(forward @ up, -1.0, 1.0))
    level = level_rotations(azimuth, dataset.frame)
    sideways = np.einsum("nj,nj->n", right, level[:, 0])
    roll = np.arctan2(right @ up, sideways * np.cos(pitch))
    return azimuth, pitch, roll


def wrapped(angle: Floats, half_turn: float = np.pi) -> Floats:
    """Return angles (any shape) to within half a turn of zero, in the unit that the half turn has."""
    return np.asarray(angle - 2.0 * half_turn * np.round(angle / (2.0 * half_turn)))


def level_rotations(azimuth_rad: Floats, frame: Frame) -> Floats:
    """Return the rotations (N, 3, 3) from the world to level cameras that look along azimuths (N)."""
    east, north = frame.east_north()
    up = np.array(frame.up)
    forward = np.sin(azimuth_rad)[:, None] * east + np.cos(azimuth_rad)[:, None] * north
    down = np.broadcast_to(-up, forward.shape)
    return np.stack([np.cross(down, forward), down, forward], axis=1)


def rotations_of(azimuth_rad: Floats, pitch_rad: Floats, roll_rad: Floats, frame: Frame) -> Floats:
    """Return the rotations (N, 3, 3) of cameras: level along the azimuth, then pitched up, then rolled to the left."""
    level = level_rotations(azimuth_rad, frame)
    sine, cosine = np.sin(pitch_rad)[:, None], np.cos(pitch_rad)[:, None]
    forward = cosine * level[:, 2] - sine * level[:, 1]
    down = cosine * level[:, 1] + sine * level[:, 2]
    sine, cosine = np.sin(roll_rad)[:, None], np.cos(roll_rad)[:, None]
    right = cosine * level[:, 0] - sine * down
    return np.stack([right, cosine * down + sine * level[:, 0], forward], axis=1)


def turned(dataset: Dataset, by_rad: Floats) -> Floats:
    """Return the rotations (N, 3, 3) of the cameras turned clockwise about the sky's direction by angles (N)."""
    east, north = dataset.frame.east_north()
    up = np.array(dataset.frame.up)
    axes = np.stack([east, north, up])
    sine, cosine = np.sin(by_rad), np.cos(by_rad)
    zero, one = np.zeros_like(sine), np.ones_like(sine)
    # Clockwise seen from above: north goes to east. Camera rows turn with it: R' = R T^-1.
    turn = np.array([[cosine, sine, zero], [-sine, cosine, zero], [zero, zero, one]]).transpose(2, 0, 1)
    in_axes = rotation_matrices(dataset.images) @ axes.T
    return np.asarray(in_axes @ turn.transpose(0, 2, 1) @ axes)


def ways_of_car(dataset: Dataset) -> tuple[Floats, Floats]:
    """Return the unit vectors (N, 3) in the world forward and to the right of how each image is driven, level."""
    azimuth_rad, _ = driving_azimuths(dataset)
    level = level_rotations(azimuth_rad, dataset.frame)
    return level[:, 2], level[:, 0]


def driving_azimuths(dataset: Dataset) -> tuple[Floats, Bools]:
    """Return the azimuth (N) in radians in which each image moves, and which images (N) move.

    Of a standing image it is that of the image before it. Each camera moves by itself: from one of a car to the next
    there is no way that was driven.
    """
    order = order_by_camera(dataset.images)
    center, drive = camera_centers(dataset.images)[order], drive_of_camera(dataset.images)[order]
    result, is_moving = np.empty(len(order)), np.empty(len(order), dtype=np.bool_)
    result[order], is_moving[order] = azimuths_along(center, drive, *dataset.frame.east_north())
    return result, is_moving
