"""What the benchmarks compute besides the method: bounds and counts, on small cases of known answers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bound import Views, cramer_rao_covariances, residual_covariance, true_views
from valuemap.config import SimulationConfig
from valuemap.simulate import PRESETS, Recording, record_city
from valuemap.simulate.pose_errors import pose_errors
from valuemap.tables import Floats


@pytest.fixture(scope="module")
def small_city() -> Recording:
    return record_city(PRESETS["small"], seed=0)


# The Cramer-Rao bound.


def information(views: Views, config: SimulationConfig, *, is_shared: bool) -> Floats:
    """What views of one object tell of it, with drift as six unknowns of each pass, or as more noise of each image."""
    white = config.position_white_m, np.radians(config.rotation_white_deg)
    drift = config.position_drift_m, np.radians(config.rotation_drift_deg)
    passes, number = np.unique(views.pass_row, return_inverse=True)
    normal = np.diag([0.0] * 3 + [1.0] * (6 * len(passes)))
    for i in range(len(views)):
        derivatives = views.of_point[i], views.of_turn[i]
        covariance = views.pixel_sigma[i] ** 2 * np.eye(2)
        for derivative, own, along in zip(derivatives, white, drift, strict=True):
            covariance += (own**2 + (0.0 if is_shared else along**2)) * derivative @ derivative.T
        row = np.zeros((2, len(normal)))
        row[:, :3] = views.of_point[i]
        if is_shared:
            row[:, 3 + 6 * number[i] :][:, :6] = np.hstack([derivatives[0] * drift[0], derivatives[1] * drift[1]])
        normal += row.T @ np.linalg.inv(covariance) @ row
    return np.asarray(np.linalg.inv(np.linalg.inv(normal)[:3, :3]))


@pytest.mark.parametrize(("length_m", "is_shared"), [(1e12, True), (1e-12, False)])
def test_the_bound_has_the_right_limits(small_city: Recording, length_m: float, is_shared: bool) -> None:
    """Drift that never changes in a pass is six more unknowns of it; drift that is forgotten at once is white."""
    config = dataclasses.replace(small_city.config, drift_length_m=length_m)
    views = true_views(small_city)
    views = views.take(np.diff(views.distance_m, append=np.inf) != 0.0)  # Where the car stands, drift stands as well.
    bound = cramer_rao_covariances(views, config, len(small_city.city.lights))
    for light in np.unique(views.object_row)[:5]:
        of_light = views.take(views.object_row == light)
        assert len(np.unique(of_light.pass_row)) > 1
        expected = information(of_light, config, is_shared=is_shared)
        np.testing.assert_allclose(bound[light], np.linalg.inv(expected), rtol=1e-6)


def test_residuals_scatter_as_the_bound_takes_them_to(small_city: Recording) -> None:
    """Over 1000 draws of the simulator's own errors the residuals of one light in one pass have that covariance."""
    config, frames, lights = small_city.config, small_city.frames, small_city.city.lights
    views = true_views(small_city)
    views = views.take((views.object_row == views.object_row[0]) & (views.pass_row == views.pass_row[0]))
    views = views.take(np.arange(0, len(views), 3))
    rows = [
        int(np.flatnonzero((frames.pass_row == p) & (frames.distance_m == d))[0])
        for p, d in zip(views.pass_row, views.distance_m, strict=True)
    ]
    to_light = lights.position_in_world_m[views.object_row] - frames.center_in_world_m[rows]
    cam_from_world = frames.cam_from_world()[rows]
    random = np.random.default_rng(0)
    residuals = []
    for seed in range(1000):
        shift, turn = pose_errors(frames, config, seed=seed)
        in_cam = np.einsum("nij,nj->ni", cam_from_world, to_light - shift[rows])
        turned = Rotation.from_rotvec(turn[rows]).apply(in_cam)
        exact = np.einsum("nij,nj->ni", cam_from_world, to_light)
        moved = config.focal_px * (turned[:, :2] / turned[:, 2:] - exact[:, :2] / exact[:, 2:])
        residuals.append((moved + random.normal(size=moved.shape) * views.pixel_sigma[:, None]).ravel())
    lower = np.linalg.cholesky(residual_covariance(views, config))
    scatter = np.cov(np.linalg.solve(lower, np.transpose(residuals)))
    assert len(scatter) >= 16
    np.testing.assert_allclose(scatter, np.eye(len(scatter)), atol=0.2)


def test_without_views_nothing_is_known(small_city: Recording) -> None:
    views = true_views(small_city)
    bound = cramer_rao_covariances(views.take(views.object_row != 0), small_city.config, len(small_city.city.lights))
    assert np.all(np.isinf(bound[0]))
    assert np.all(np.isfinite(bound[views.object_row[-1]]))
