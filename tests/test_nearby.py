"""Points near each other: those that looking at all pairs finds."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from valuemap import nearby
from valuemap.nearby import Nearby


@pytest.mark.parametrize("at_once", [1, 50, 2**20])
@pytest.mark.parametrize(("points", "places"), [(0, 5), (5, 0), (1, 1), (200, 150)])
def test_pairs_are_those_of_looking_at_all(
    points: int, places: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nearby, "_AT_ONCE", at_once)
    random = np.random.default_rng(points)
    known, asked = (random.uniform([0, 0, 0], [40, 90, 3], (count, 3)) for count in (points, places))
    near = np.linalg.norm(asked[:, None] - known, axis=2) <= 6.0
    place, point = Nearby(known).pairs(asked, 6.0)
    assert np.all(np.diff(place) >= 0)
    assert set(zip(place.tolist(), point.tolist(), strict=True)) == set(zip(*np.nonzero(near), strict=True))
    assert len(place) == near.sum()
    np.testing.assert_array_equal(Nearby(known).have_any(asked, 6.0), near.any(axis=1))


def test_points_as_far_apart_as_asked_are_near() -> None:
    assert Nearby(np.array([[0.0, 0.0], [3.0, 4.0]])).have_any(np.array([[0.0, 0.0]]), 0.0).all()
    assert len(Nearby(np.array([[3.0, 4.0]])).pairs(np.array([[0.0, 0.0]]), 5.0)[0]) == 1


def test_update_is_there_before_scipys_parts_are_imported() -> None:
    parts = "sorted({'scipy.spatial', 'scipy.optimize', 'scipy.sparse', 'scipy.linalg'} & set(sys.modules))"
    program = f"import sys, valuemap.cli.update; sys.exit(' '.join({parts}) or None)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
