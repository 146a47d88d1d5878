"""Angles that are read as degrees, and are radians: how it is told."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.drives import find_drives
from valuemap.drives.way import azimuths_along
from valuemap.tables import Images

_MANY = 20
"""So many angles that are all as small as radians, and half a turn apart, are taken for such: degrees seldom are."""
_MOVING = 10
"""So many images of a camera that moves are compared with its way."""
_FOLLOWS_RAD = math.radians(20.0)
"""Headings that follow the way spread less about it than this, and half as much as those that do not."""
_AHEAD_RAD = math.radians(5.0)
"""A camera that looks ahead, or back, does so this well on average of a drive."""
_EAST_NORTH = np.eye(3)[:2]
_TINY = 1e-12


def as_small_as_radians(angle_deg: Floats) -> bool:
    """Return whether no angle (any shape, NaN where there is none) is beyond a turn of radians."""
    return bool(np.nanmax(np.abs(angle_deg), initial=0.0) <= 2.0 * math.pi)


def tell_radians(
    name: str,
    angle_deg: Floats,
    tell: Callable[[str], None],
    *,
    images: tuple[Images, Images] | None = None,
) -> None:
    """Say that angles (N, NaN where there is none) look like radians.

    They are as small as radians are, and half a turn apart. Where images are given, the way that these are driven,
    level about z, says more: first the images as read, then as they are if the angles are radians.
    """
    known = angle_deg[np.isfinite(angle_deg)]
    if not len(known) or not as_small_as_radians(known):
        return
    follow = None if images is None else _second_follows_way(*images)
    if follow or (follow is None and len(known) >= _MANY and np.ptp(known) >= math.pi):
        fit = ", and only as radians do they follow the way that is driven" if follow else ""
        tell(
            f"{name}: all {len(known)} are from {known.min():.3g} to {known.max():.3g}, taken for degrees{fit}: are "
            "they radians?"
        )


def _second_follows_way(first: Images, second: Images) -> bool | None:
    """Return whether cameras look along their way as they are turned in `second`, not in `first`; None: nobody knows.

    Cameras look any way from their car, so that in a curve only the spread about the way counts. On a straight way
    both spread as little: there a camera that looks just ahead, or back, is believed.
    """
    fine = np.flatnonzero(np.isfinite(np.hstack([first.cam_from_world_m, second.cam_from_world_m])).all(axis=1))
    if len(fine) < _MOVING:
        return None
    images = (first.take(fine), second.take(fine))
    drives = find_drives(images[0])
    camera = images[0].camera_id
    order = np.lexsort((drives.order, camera, drives.pass_code))
    changes = np.logical_or(np.diff(camera[order]), np.diff(drives.pass_code[order]))
    way = np.concatenate([[0], np.cumsum(changes)])
    azimuth, moves = azimuths_along(camera_centers(images[0])[order], way, *_EAST_NORTH)
    said = set()
    for of_camera in np.unique(camera):
        rows = moves & (camera[order] == of_camera)
        if np.sum(rows) >= _MOVING:
            offs = [_off_way(rotation_matrices(each)[order[rows], 2], azimuth[rows]) for each in images]
            said.add(_second_is_better(*offs))
    return True if True in said else False if False in said else None


def _second_is_better(first: tuple[float, float], second: tuple[float, float]) -> bool | None:
    """Return which of two readings of a camera's headings follows its way, of `_off_way`; None for neither or both."""
    (first_off, first_spread), (second_off, second_spread) = first, second
    for spread, other, is_second in ((first_spread, second_spread, False), (second_spread, first_spread, True)):
        if spread < _FOLLOWS_RAD and other > max(_FOLLOWS_RAD, 2.0 * spread):
            return is_second
    ahead, back = abs(second_off), math.pi - abs(second_off)
    off = min(abs(first_off), math.pi - abs(first_off)) if back < ahead else abs(first_off)
    return True if second_spread < _FOLLOWS_RAD and min(ahead, back) < _AHEAD_RAD and off > _FOLLOWS_RAD else None


def _off_way(forward: Floats, azimuth_rad: Floats) -> tuple[float, float]:
    """Return how far directions (N, 3) are to the right of a way (N) on average, and their spread about that, in rad.

    The spread is a circular standard deviation.
    """
    turned = np.exp(1j * (np.arctan2(forward[:, 0], forward[:, 1]) - azimuth_rad)).mean()
    return float(np.angle(turned)), math.sqrt(-2.0 * math.log(min(max(abs(turned), _TINY), 1.0)))
