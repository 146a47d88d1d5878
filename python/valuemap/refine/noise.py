"""What detections and single images are off by, as the residuals of an estimate tell: variance components.

With objects and constants as they are, the residuals r of an image at a node of its drive are

    r = J (o + T (d + m)) + e,   e ~ N(0, S),   o ~ N(0, D),   d a process of Ornstein and Uhlenbeck

with J the derivatives by the image's position and rotation, o its own error, d the drift of its node, m what its whole
drive is off by, and T what takes these to axes of the camera. S is px^2 and a share of the box, D has the squares of
image_m and of turn_px on its diagonal. The likeliest of these and of the size of drift are sought with o, d and m
integrated out (restricted likelihood; Harville 1977). What the most probable o and d tell of them is too little: what
is taken for drift is not left for images, and what is left gets less in each round. Then how far a drive wanders aside
is thought to be known better than it is, and the focal length is found with which that matters less (errors in
variables; Carroll et al. 2006, chapter 3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from valuemap.arrays import Floats, Ints
from valuemap.refine.adjust import Chain, Groups, Scales, banded, process
from valuemap.refine.residuals import MOUNT, OFFSET, Observations, State, linearised

_FIRST_PX, _FIRST_SHARE, _FIRST_M = 2.0, 0.05, 0.1
_FIRST_DRIFT_M, _FIRST_DRIFT_RAD = 0.2, math.radians(0.2)
_LEAST = 20
"""So few residuals tell nothing."""
_USUAL = 3.0
"""What is more than so many deviations off is something else."""
_SQUARE_WITHIN = 1.0 - 0.5 * _USUAL**2 * math.exp(-0.5 * _USUAL**2) / -math.expm1(-0.5 * _USUAL**2)
"""The mean square of what is within them, over that of all: of a normal distribution in the plane."""
_BOUNDS = np.log([(0.1, 30.0), (1e-3, 0.3), (1e-3, 0.5), (0.1, 30.0), (1e-3, 10.0), (1e-5, 1.0)])
"""Least and most of each, as in `NoiseLeft`: a range that no data reach, so that the search ends."""
_STEPS = 6
"""Steps of the search: it goes on from there when poses are adjusted the next time."""


@dataclass(frozen=True, eq=False)
class NoiseLeft:
    """What else moves a detection: px and a share of its box; errors of single images, m, and px that they turn; drift.

    Drift is what it is found to be, each axis, m and rad: that which poses are thought to have is in `Scales`.
    """

    px: float = math.sqrt(0.5) * _FIRST_PX
    share: float = _FIRST_SHARE
    image_m: float = _FIRST_M
    turn_px: float = math.sqrt(0.5) * _FIRST_PX
    drift_m: float = _FIRST_DRIFT_M
    drift_rad: float = _FIRST_DRIFT_RAD

    def total_px(self, box_px: Floats) -> Floats:
        """Return what detections with boxes of so many px (N) are off by, all in all; a box is as of a metre."""
        return np.hypot(math.hypot(self.px, self.turn_px), math.hypot(self.share, self.image_m) * box_px)

    def is_larger_than_thought(self, box_px: Floats) -> bool:
        """Whether most such detections are off by more than was thought possible before anything was known."""
        return bool(np.median(self.total_px(box_px) - NoiseLeft().total_px(box_px)) > 0.0)


def fit_noise(
    seen: Observations,
    state: State,
    chain: Chain,
    scales: Scales,
    noise: NoiseLeft,
    pixels_per_rad: float,
) -> NoiseLeft:
    """Return the likeliest noise, sought from one."""
    told = residuals_of_images(seen, state)
    if told is None:
        return noise

    def cost(log: Floats) -> float:
        px, share, image_m, turn_px, drift_m, drift_rad = np.exp(log)
        of_poses = replace(
            scales, own_m=image_m, own_rad=turn_px / pixels_per_rad, drift_m=drift_m, drift_rad=drift_rad
        )
        return told.cost(chain, of_poses, px, share)

    limits = scipy.optimize.Bounds(*_BOUNDS.T)
    start = np.clip(np.log([*vars(noise).values()]), *_BOUNDS.T)
    found = scipy.optimize.minimize(cost, start, method="L-BFGS-B", bounds=limits, options={"maxiter": _STEPS})
    return NoiseLeft(*(float(value) for value in np.exp(found.x)))


@dataclass(frozen=True, eq=False)
class ResidualsOfImages:
    """What residuals (N) tell of the images (I) that have them.

    `rows` (N, 2, 7) are the derivatives by an image's position and rotation, and the residuals, px, of boxes of
    `box_px` (N), `of_image` groups them, `turned` (I, 6, 6) takes drift to errors of images, `node` (I) is whose drift.
    """

    rows: Floats
    box_px: Floats
    of_image: Groups
    turned: Floats
    node: Ints

    def cost(self, chain: Chain, scales: Scales, px: float, share: float) -> float:
        """Return minus twice the log likelihood of variances, up to a constant."""
        of_detections, information, pull = self._without_own(scales, px, share)
        # Everything that nodes (n, 6, 7) are told: information, and the right side.
        told = np.zeros((len(chain.drive), 6, 7))
        np.add.at(told[:, :, :6], self.node, self.turned.transpose(0, 2, 1) @ information @ self.turned)
        np.add.at(told[:, :, 6], self.node, np.einsum("nji,nj->ni", self.turned, pull))
        of_nodes, left = _without_drift(chain, scales, told)
        of_drive = np.zeros((int(chain.drive[-1]) + 1, 6, 7))
        np.add.at(of_drive, chain.drive, left)
        # What whole drives are off by is no drift, and integrated out as well.
        off = np.repeat([float(scales.constant[OFFSET]), float(scales.constant[MOUNT])], 3)
        return of_detections + of_nodes + _integrated(of_drive, off)[0]

    def _without_own(self, scales: Scales, px: float, share: float) -> tuple[float, Floats, Floats]:
        """Return the cost of detections with images' own errors, and what they tell of drift (I, 6, 6), (I, 6)."""
        sigma_px = np.hypot(px, share * self.box_px)
        products = self.of_image.products(self.rows / sigma_px[:, None, None])
        cost, left = _integrated(products[:, :6], np.repeat([scales.own_m, scales.own_rad], 3))
        cost += 4.0 * float(np.sum(np.log(sigma_px))) + float(products[:, 6, 6].sum()) / _SQUARE_WITHIN
        return cost, left[:, :, :6], left[:, :, 6]


def _integrated(told: Floats, sigma: Floats) -> tuple[float, Floats]:
    """Integrate errors (6) with deviations (6) out of what is told of each (N, 6, 7): information A, right side b.

    Return the cost, log |I + A D| - b^T D (I + A D)^-1 b, and what is told beside them, (I + A D)^-1 (A, b).
    """
    with_errors = np.eye(6) + told[:, :, :6] * sigma**2
    left = np.asarray(np.linalg.solve(with_errors, told), np.float64)
    explained = np.sum(told[:, :, 6] * sigma**2 * left[:, :, 6])
    return float(np.sum(np.linalg.slogdet(with_errors)[1]) - explained), left


def _without_drift(chain: Chain, scales: Scales, told: Floats) -> tuple[float, Floats]:
    """Integrate the process of nodes out of what they are told (n, 6, 7); return its cost, and what is told beside it.

    That has to be summed over a drive.
    """
    diagonal, beside = process(chain.keep, scales)
    blocks = told[:, :, :6] + diagonal[:, :, None] * np.eye(6)
    factor, failed = scipy.linalg.lapack.dpbtrf(banded(blocks, beside), lower=1, overwrite_ab=1)
    if failed:
        return math.inf, told
    solved = scipy.linalg.lapack.dtbtrs(factor, told.reshape(-1, 7), uplo=b"L")[0].reshape(-1, 6, 7)
    explained = solved.transpose(0, 2, 1) @ solved
    # The determinant of the process itself, but for what is always the same.
    cost = 2.0 * np.sum(np.log(factor[0])) + 6.0 * len(told) * math.log(scales.drift_m * scales.drift_rad)
    return float(cost - explained[:, 6, 6].sum()), told - explained[:, :6]


def residuals_of_images(seen: Observations, state: State) -> ResidualsOfImages | None:
    """Return what residuals tell of images; None where they are too few."""
    at = linearised(seen, state)
    with np.errstate(invalid="ignore"):
        square = np.sum(at.residual_px**2, axis=1) / seen.sigma_px**2
    is_seen = (at.depth_m > 0.0) & np.isfinite(square)
    if int(is_seen.sum()) < _LEAST:
        return None
    usual = float(np.median(square[is_seen])) / (2.0 * math.log(2.0))
    rows = is_seen & (square < _USUAL**2 * usual)
    votes = np.bincount(seen.thing[rows], minlength=len(state.point_in_world_m))
    rows &= votes[seen.thing] >= 2
    # An object's place is fitted to its residuals: they are smaller by three of twice its votes.
    larger = 1.0 / np.sqrt(1.0 - 1.5 / votes[seen.thing[rows]])
    by_own = np.concatenate([-at.by_point, at.by_turn], axis=2)[rows]
    groups = Groups(seen.image[rows])
    image = seen.image[rows][groups.row]
    turned = np.zeros((len(image), 6, 6))
    turned[:, :3, :3], turned[:, 3:, 3:] = np.eye(3), seen.views.cam_from_node[image]
    # Residuals with what drift is thought to be in them.
    drift = np.einsum("nij,nj->ni", turned, state.drift[seen.views.node[image]])
    of_row = np.searchsorted(image, seen.image[rows])
    residual = at.residual_px[rows] - np.einsum("nij,nj->ni", by_own, drift[of_row])
    residual *= larger[:, None]
    values = np.concatenate([by_own, residual[:, :, None]], axis=2)
    return ResidualsOfImages(values, seen.box_px[rows], groups, turned, seen.views.node[image])
