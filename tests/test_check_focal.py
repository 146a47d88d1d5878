"""Focal lengths that are far off: least squares see only the few votes that are right, so others are tried."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from camera_models import cameras_like, seen_through
from check_faults import good_city
from valuemap.check import corrections
from valuemap.check.corrections import find_correction, find_focal
from valuemap.check.examine import examine
from valuemap.check.fault import View
from valuemap.dataset import Dataset
from valuemap.simulate import PRESETS, simulate


def city(seed: int) -> Dataset:
    return simulate(replace(PRESETS["small"], passes_per_street=2), seed=seed, name=f"city-{seed}")


def with_focal_times(dataset: Dataset, factor: float, camera: int | None = None) -> Dataset:
    params = [
        np.append(each[:2] * factor, each[2:]) if camera in (None, row) else each
        for row, each in enumerate(dataset.cameras.params)
    ]
    return replace(dataset, cameras=dataset.cameras.replace(params=params))


# As given they were called a lens, a tilt, and nothing.
@pytest.mark.parametrize(("seed", "factor"), [(31, 0.8), (32, 0.8), (31, 1.2)])
def test_focal_lengths_far_off_are_named_alone_and_put_right(seed: int, factor: float) -> None:
    good = city(seed)
    outcome = examine(with_focal_times(good, factor))
    assert [each.fault for each in outcome.findings] == ["focal_length"]
    assert outcome.fixed.cameras.params[0][0] == pytest.approx(good.cameras.params[0][0], rel=0.03)


def test_those_of_a_fisheye_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    good = city(42)
    fisheye = seen_through(good, *cameras_like(good)["fisheye"])
    view = View(with_focal_times(fisheye, 0.8))
    assert find_correction(view) is None
    found = find_focal(view)
    assert found is not None
    assert np.exp(found.value) == pytest.approx(1.25, rel=0.03)
    assert find_focal(View(fisheye)) is None
    for name, value in (("LEAST_CHANCE", 0.0), ("LEAST_RISE", 0.9), ("_LEAST_LOG_FOCAL", 0.5)):
        monkeypatch.setattr(corrections, name, value)
        assert find_focal(view) is None
        monkeypatch.undo()


def test_of_two_cameras_the_right_one_keeps_its_focal_length() -> None:
    good = good_city(21, passes_per_street=2)
    assert find_focal(View(good)) is None
    found = find_focal(View(with_focal_times(good, 0.8, camera=1)))
    assert found is not None
    assert found.group is not None
    assert found.group.camera_id == 1
    assert np.exp(found.value) == pytest.approx(1.25, rel=0.04)
    found = find_focal(View(with_focal_times(good, 0.8)))
    assert found is not None
    assert found.group is None
