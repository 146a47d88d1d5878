"""A model of structure from motion is moved onto the GPS, with the cameras' mean up on the vertical.

Along one straight street positions alone leave the roll about it open.
"""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats

TILT_SIGMA_RAD = 0.05
"""How far the mean up of cameras is from the vertical: cameras look up or down a little, all in the same way."""

_ROUNDS = 10
_LEAST_IMAGES = 3


def similarity_onto(center: Floats, up: Floats, gps_m: Floats, sigma_m: Floats) -> tuple[float, Floats, Floats] | None:
    """Return scale, rotation and shift that take a model's camera centres onto their GPS positions and up onto z.

    Weighted least squares by the singular value decomposition of Umeyama (1991), with the cameras' up directions as
    further correspondences of a standard deviation of 0.05 rad, reweighted ten times so that outliers of the GPS lose
    their weight (Cauchy's loss). None where fewer than three positions are known, or all are one.

    Parameters
    ----------
    center, up
        Camera centres and up directions (N, 3) in the model.
    gps_m, sigma_m
        GPS positions (N, 3), NaN where there are none, and their standard deviations (N).
    """
    known = np.isfinite(gps_m).all(axis=1)
    if known.sum() < _LEAST_IMAGES:
        return None
    source, target, sigma = center[known], gps_m[known], sigma_m[known]
    robust, scale = np.ones(len(source)), 1.0
    turn, shift = np.eye(3), np.zeros(3)
    mean_up = up.mean(axis=0)
    for _ in range(_ROUNDS):
        weight = robust / sigma**2
        share = weight / weight.sum()
        source_mean, target_mean = share @ source, share @ target
        a, b = source - source_mean, target - target_mean
        if not (share @ (a**2).sum(axis=1) > 0.0 and share @ (b**2).sum(axis=1) > 0.0):
            return None
        # Positions weigh by the square of their sigma, directions by that of the tilt, both without a unit.
        across = scale * (weight[:, None] * b).T @ a + len(up) / TILT_SIGMA_RAD**2 * np.outer([0.0, 0.0, 1.0], mean_up)
        u, _, vt = np.linalg.svd(across)
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        turned = a @ turn.T
        scale = float(np.sum(share * (b * turned).sum(axis=1)) / np.sum(share * (turned**2).sum(axis=1)))
        if not scale > 0.0:
            scale = float(np.sqrt(np.sum(share * (b**2).sum(axis=1)) / np.sum(share * (a**2).sum(axis=1))))
        shift = target_mean - scale * turn @ source_mean
        away = np.linalg.norm(target - (scale * source @ turn.T + shift), axis=1) / sigma
        robust = 1.0 / (1.0 + (away / 3.0) ** 2)
    return scale, turn, shift
