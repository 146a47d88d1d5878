"""The Cramer-Rao bound of positions: the best that any unbiased method can do with the same views and noise."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from valuemap.cameras import cast_rays
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset, rows_of

Floats = NDArray[np.float64]


def cramer_rao_covariances(dataset: Dataset, noise: SimulationConfig) -> Floats:
    """Return the bound (objects, 3, 3) in m², from the true associations and the simulator's own noise.

    A view's residual is J dX + own error + J b + J [X - C]_x w, where b and w are the drifts of position and rotation
    of its pass, which are taken as constant over the views of one object; the information of each pass about X is
    that left after b and w are marginalised with their priors. Objects without views get infinite variances.
    """
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    rays = cast_rays(dataset)
    object_row = rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)
    ray = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    point = dataset.truth.position_in_world_m[object_row]
    matrix, center = rays.residual_from_world[ray], rays.center_in_world_m[ray]
    projected = np.einsum("nij,nj->ni", matrix, point - center)
    depth = projected[:, 2, None, None]
    jacobian = (matrix[:, :2] - (projected[:, :2] / projected[:, 2:])[:, :, None] * matrix[:, 2:]) / depth
    turned = np.cross((point - center)[:, None], jacobian)
    scale2 = np.mean(np.sum(jacobian**2, axis=2), axis=1) * projected[:, 2] ** 2
    height_px = dataset.detections.size_px[ray, 1]
    variance = (
        noise.pixel_noise_px**2
        + (noise.pixel_noise_share * height_px) ** 2
        + scale2 * (noise.position_white_m / projected[:, 2]) ** 2
        + scale2 * math.radians(noise.rotation_white_deg) ** 2
    )
    shared = np.concatenate(
        [jacobian * noise.position_drift_m, turned * math.radians(noise.rotation_drift_deg)], axis=2
    )
    weighted = jacobian / variance[:, None, None]
    passes = dataset.images.pass_id.codes[rays.image_row[ray]]
    group, inverse = np.unique(np.stack([object_row, passes], axis=1), axis=0, return_inverse=True)

    def summed(products: Floats) -> Floats:
        sums = np.zeros((len(group), *products.shape[1:]))
        np.add.at(sums, inverse.ravel(), products)
        return sums

    of_point = summed(np.einsum("nki,nkj->nij", weighted, jacobian))
    cross = summed(np.einsum("nki,nkj->nij", weighted, shared))
    of_shared = np.eye(6) + summed(np.einsum("nki,nkj->nij", shared / variance[:, None, None], shared))
    information = np.zeros((len(dataset.truth), 3, 3))
    left = of_point - cross @ np.linalg.solve(of_shared, cross.transpose(0, 2, 1))
    np.add.at(information, group[:, 0], left)
    bound = np.full_like(information, np.inf)
    seen = np.linalg.det(information) > 0.0
    bound[seen] = np.linalg.inv(information[seen])
    return bound
