"""One pass in a world of its own."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import pass_frames
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import View, with_centers, with_poses
from valuemap.check.pass_frames import PassFrame
from valuemap.dataset import Dataset
from valuemap.progress import silent


@pytest.fixture(scope="module")
def city() -> Dataset:
    return good_city(2, passes_per_street=3)


def second_in(dataset: Dataset, world: str) -> Dataset:
    """Return the dataset with its second pass in another world, 30 m off."""
    back = np.linalg.inv(pass_frames._WORLDS[world])
    turn = back / np.cbrt(np.abs(np.linalg.det(back)))
    mine = dataset.images.pass_id.codes == 1
    center, rotation = camera_centers(dataset.images), rotation_matrices(dataset.images)
    return with_poses(
        dataset,
        np.where(mine[:, None, None], rotation @ turn.T, rotation),
        np.where(mine[:, None], (center + [30.0, 0.0, 0.0]) @ back.T, center),
    )


def furthest_m(dataset: Dataset, right: Dataset) -> float:
    return float(np.linalg.norm(camera_centers(dataset.images) - camera_centers(right.images), axis=1).max())


@pytest.mark.parametrize("world", sorted(pass_frames._WORLDS))
def test_a_pass_in_another_world_is_named_and_taken_to_that_of_the_others(world: str, city: Dataset) -> None:
    spoiled = second_in(city, world)
    (finding,) = find_in_stage(View(spoiled), "fine", silent)
    assert (finding.fault, finding.of) == ("pass_frame", f"pass {city.images.pass_id.names[1]}")
    assert finding.figures["world"] == world
    assert finding.fix is not None
    fixed = finding.fix(spoiled)
    assert furthest_m(fixed, city) < 1.0
    np.testing.assert_allclose(rotation_matrices(fixed.images), rotation_matrices(city.images), atol=1e-9)


def test_a_pass_that_is_moved_or_good_is_in_the_world_of_the_others(city: Dataset) -> None:
    assert PassFrame().find(View(city)) is None
    center, mine = camera_centers(city.images), (city.images.pass_id.codes == 1)[:, None]
    far = with_centers(city, center + np.where(mine, [50.0, -35.0, 0.0], 0.0))
    assert PassFrame().find(View(far)) is None


def test_a_world_that_fits_no_better_than_another_shift_is_not_told(
    city: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoiled = View(second_in(city, "feet"))
    monkeypatch.setattr(pass_frames, "_WORLDS", {"yards": 0.9144 * np.eye(3)})
    assert PassFrame().find(spoiled) is None
    monkeypatch.setattr(pass_frames, "_WORLDS", {"the same": np.eye(3)})
    assert PassFrame().find(spoiled) is None
