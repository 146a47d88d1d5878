"""Errors that poses state, where images show others."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import valuemap
from literal import Floats
from test_straight_drives import lanes
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset
from valuemap.tables import Labels

NEAR_M = 0.6
"""A label that is so near an object is of that."""


def one_lane(off_m: float = 1.0) -> tuple[Dataset, Floats]:
    """Return a drive that is off by as much as its receiver says, images of which are off by 0.1 m against it."""
    return lanes(5, lane_m=(0.0,), off_m=np.array([[off_m, 0.0, 0.0]]))


def stated(dataset: Dataset, position_m: Any, rotation_deg: float = 0.1) -> Dataset:
    """Return a dataset whose poses state their errors."""
    count = len(dataset.images)
    images = dataset.images.replace(
        position_sigma_m=np.broadcast_to(np.asarray(position_m, np.float64), count).copy(),
        rotation_sigma_rad=np.full(count, np.radians(rotation_deg)),
    )
    return dataclasses.replace(dataset, images=images)


def right(labels: Labels, signs: Floats, off_m: Floats) -> int:
    """Return how many signs have a label, where the drive puts them."""
    apart = np.linalg.norm(labels.position_in_world_m[:, None] - signs - off_m, axis=2)
    return int(np.sum(apart.min(axis=0) < NEAR_M))


@pytest.mark.parametrize("sigma_m", [1.0, 3.0])
def test_a_map_is_no_worse_for_stated_errors_of_a_whole_drive(sigma_m: float) -> None:
    dataset, signs = one_lane()
    maps = {name: valuemap.build_map(one) for name, one in (("no", dataset), ("yes", stated(dataset, sigma_m)))}
    record = maps["yes"].run["poses"]["stated_errors"]
    assert record["misfit_after"] + record["price"] < record["misfit_before"]
    assert any("what their poses state" in note for note in maps["yes"].run["notes"])
    assert not any("what their poses state" in note for note in maps["no"].run["notes"])
    found = {name: right(result.labels, signs, np.array([1.0, 0.0, 0.0])) for name, result in maps.items()}
    assert found["yes"] == found["no"] > 20
    np.testing.assert_array_equal(maps["yes"].labels.position_in_world_m, maps["no"].labels.position_in_world_m)
    # What the drive says of its place is in absolute covariances, and in no others.
    absolute = maps["yes"].labels.absolute_covariance_m2
    assert absolute is not None
    added = absolute[:, :3] - maps["yes"].labels.covariance_m2[:, :3]
    np.testing.assert_allclose(added, [[sigma_m**2, 0.0, 0.0]] * len(added), atol=1e-12)


def test_errors_that_are_stated_rightly_are_believed() -> None:
    dataset, _ = one_lane(0.0)
    assert "stated_errors" not in valuemap.build_map(stated(dataset, 0.1)).run["poses"]


def test_stated_errors_are_taken_as_they_are_where_poses_are() -> None:
    config = valuemap.MapConfig().with_settings(["correct_poses=0"])
    assert "stated_errors" not in valuemap.build_map(stated(one_lane()[0], 1.0), config).run["poses"]


def test_the_mean_of_drives_is_weighted_by_what_they_state_all_the_same() -> None:
    off_m = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [0.0, 0.6, 0.0]])
    dataset, _ = lanes(1, off_m=off_m)
    sigma_m = np.array([0.3, 3.0, 3.0])[dataset.images.pass_id.codes]
    result = valuemap.build_map(stated(dataset, sigma_m))
    assert "stated_errors" in result.run["poses"]
    assert result.corrected is not None
    assert result.corrected.images.position_sigma_m is None
    moved = camera_centers(result.corrected.images) - camera_centers(dataset.images)
    by_drive = [np.median(moved[dataset.images.pass_id.codes == drive], axis=0) for drive in range(3)]
    np.testing.assert_allclose(by_drive, -off_m, atol=0.12)
