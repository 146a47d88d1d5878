"""Poses are corrected only where that makes the same detections likelier."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import valuemap
from block import block
from valuemap import correction
from valuemap.arrays import Ints
from valuemap.dataset import Dataset
from valuemap.progress import silent
from valuemap.refine import Refined
from valuemap.robust import Calibration, calibrate, misfits
from valuemap.simulate import simulate
from valuemap.tables.candidates import Candidates
from valuemap.tiles import compare
from valuemap.tiles.compare import Comparison, compare_poses


@functools.cache
def shifted(dataset: Dataset, shift_m: float) -> Dataset:
    """Return the dataset with the images of every other pass a step to the right of where they are."""
    images = dataset.images
    step = np.where(images.pass_id.codes % 2 == 0, shift_m, 0.0)[:, None] * np.array([-1.0, 0.0, 0.0])
    return replace(dataset, images=images.replace(cam_from_world_m=images.cam_from_world_m + step))


@pytest.fixture(scope="module")
def city() -> Dataset:
    return simulate(block(frame_spacing_m=4.0, standing_interval_s=2.0), seed=3, name="city")


@functools.cache
def compared(before: Dataset, after: Dataset, price: float = 10.0) -> Comparison:
    """Compare with the default settings."""
    return compare_poses(before, after, price, valuemap.MapConfig(), threads=0, progress=silent)


@pytest.mark.parametrize("shift_m", [1.5, 3.0])
def test_true_poses_make_detections_likelier(city: Dataset, shift_m: float) -> None:
    wrong = shifted(city, shift_m)
    worse = compared(city, wrong)
    assert worse.before < worse.after - 100.0
    assert not worse.is_better
    # The sample is that of the first: the same detections are compared whichever comes first.
    again = compared(wrong, city)
    assert (again.after, again.before) == pytest.approx((worse.before, worse.after), rel=0.05)
    assert again.detections == worse.detections > 100
    assert again.is_better


def test_ids_at_random_compare_the_same_detections(city: Dataset) -> None:
    """Ids that ascend along the drive are the exception: the fit of poses is that of the same rays all the same."""
    ids = np.random.default_rng(0).permutation(len(city.detections)) + 1
    detections = city.detections.replace(detection_id=ids).take(np.argsort(ids))
    shuffled = replace(city, detections=detections, truth_detections=None)
    expected = compared(city, shifted(city, 1.5))
    found = compared(shuffled, shifted(shuffled, 1.5))
    assert found.detections == expected.detections
    assert (found.before, found.after) == pytest.approx((expected.before, expected.after), rel=0.01)


def test_a_correction_that_is_not_worth_its_parameters_is_not_taken(
    city: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = Refined(city, {"found": "faults"}, is_corrected=True, price=30.0)
    monkeypatch.setattr(correction, "refine_poses", lambda *_, **__: right)
    found: list[Any] = []

    def once(*given: Any, **more: Any) -> Any:
        found.extend([] if found else [misfits(*given, **more)])
        return found[0]

    monkeypatch.setattr(compare, "misfits", once)
    poses = shifted(city, 3.0)
    given = poses, poses, valuemap.MapConfig(), 1, silent
    assert correction._proven(*given).is_corrected
    assert len(found) == 1
    right = replace(right, price=1e7)
    assert not correction._proven(*given).is_corrected


def test_a_sample_pays_its_share_of_the_price(city: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fleet has hundreds of parameters, estimated from ten times the detections that are compared."""

    def of_a_tenth(
        scenes: object, second_of_first: Ints, *_: object, **__: object
    ) -> tuple[tuple[float, float], int, None]:
        return (100.0, 90.0), len(second_of_first) // 10, None

    monkeypatch.setattr(compare, "misfits", of_a_tenth)
    found, all_of_it = compared(city, city, price=100.0), len(city.detections)
    assert found.detections <= 0.1 * all_of_it
    assert found.price == pytest.approx(100.0 * found.detections / all_of_it)


def test_a_correction_that_fits_worse_is_not_taken(city: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = valuemap.build_map(city, valuemap.MapConfig(correct_poses=0))
    wrong = Refined(shifted(city, 1.0), {"found": "faults"}, is_corrected=True)
    monkeypatch.setattr(correction, "refine_poses", lambda *_, **__: wrong)
    sought: list[object] = []

    def spied(*given: object, **named: object) -> tuple[Calibration, Candidates]:
        sought.append(named["sought"])
        return calibrate(*given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr("valuemap.calibration.calibrate_scene", spied)
    result = valuemap.build_map(city)
    # The noise of the poses as they are is known from the comparison.
    assert [given is None for given in sought] == [False]
    assert result.run["poses"]["because"] == "the poses as given fit better"
    assert result.run["poses"]["misfit_after"] > result.run["poses"]["misfit_before"]
    assert result.corrected is None
    assert np.array_equal(result.labels.position_in_world_m, alone.labels.position_in_world_m)
