"""Other methods, as the benchmarks rewrite them, on rays that meet exactly."""

from __future__ import annotations

import numpy as np
import pytest

from peers import krylov_field, least_squares

CAMERAS = np.array([[0.0, 0.0], [6.0, 0.0], [12.0, 0.0], [18.0, 0.0]])
OBJECTS = np.array([[5.0, 9.0], [14.0, 8.0]])


def test_the_random_field_finds_where_rays_cross() -> None:
    origin = np.repeat(CAMERAS, 2, axis=0)
    to = np.tile(OBJECTS, (4, 1)) - origin
    depth_m = np.linalg.norm(to, axis=1)
    found, _ = krylov_field(origin, to / depth_m[:, None], np.repeat(np.arange(4), 2), depth_m)
    near = np.linalg.norm(found[:, None] - OBJECTS, axis=2)
    assert np.all(near.min(axis=0) < 1e-6)
    assert len(found) == 2


def test_rays_that_do_not_cross_make_nothing() -> None:
    found, _ = krylov_field(CAMERAS, np.tile([0.0, 1.0], (4, 1)), np.arange(4), None)
    assert len(found) == 0


def test_least_squares_of_angles_is_the_point_that_all_rays_meet() -> None:
    point = np.array([4.0, 9.0, 3.0])
    origin = np.column_stack([CAMERAS, np.zeros(4)])
    direction = (point - origin) / np.linalg.norm(point - origin, axis=1)[:, None]
    assert least_squares(origin, direction) == pytest.approx(point)
    assert least_squares(origin, np.tile([0.0, 0.0, 1.0], (4, 1))) is None
