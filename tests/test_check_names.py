"""One kind of object under two names, and two kinds of object at one place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from check_faults import good_city
from valuemap.check import names
from valuemap.check.fault import View, with_detections
from valuemap.check.names import TwoNames
from valuemap.dataset import Dataset
from valuemap.tables import Categories


@pytest.fixture(scope="module")
def city() -> Dataset:
    return good_city(1, passes_per_street=2)


def called(dataset: Dataset, is_other: NDArray[np.bool_]) -> Dataset:
    """Return the dataset with some detections (N, by mask) of another class."""
    return with_detections(dataset, class_name=Categories.from_texts(np.where(is_other, "red", "green").tolist()))


def by_chance(dataset: Dataset, share: float) -> NDArray[np.bool_]:
    return np.random.default_rng(5).random(len(dataset.detections)) < share


def second_pass(dataset: Dataset) -> NDArray[np.bool_]:
    row = np.searchsorted(dataset.images.image_id, dataset.detections.image_id)
    return np.asarray(dataset.images.pass_id.codes[row] == 1)


def test_objects_that_have_one_name_in_some_pictures_and_another_in_others_are_one_kind(
    city: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    for is_other in (by_chance(city, 0.4), second_pass(city)):
        spoiled = called(city, is_other)
        found = TwoNames().find(View(spoiled))
        assert found is not None
        assert found.fix is not None
        assert city.truth is not None
        every = np.arange(len(city.truth)) % 2 == 0
        truth = city.truth.replace(class_name=Categories.from_texts(np.where(every, "red", "green").tolist()))
        fixed = found.fix(replace(spoiled, truth=truth))
        assert fixed.truth is not None
        name = "red"  # Of two names that are about as common the shorter one.
        assert fixed.truth.class_name.names == fixed.detections.class_name.names == (name,)
    for limit in ("LEAST_CHANCE", "AGAINST"):
        monkeypatch.setattr(names, limit, 0.0)
        assert TwoNames().find(View(spoiled)) is None
        monkeypatch.undo()


@pytest.mark.parametrize(
    ("number", "others", "kept"),
    [(60, 40, "sign"), (40, 60, "sign"), (80, 20, "traffic sign (back)"), (20, 80, "sign")],
)
def test_the_commoner_name_is_kept_and_of_two_as_common_the_plainer(number: int, others: int, kept: str) -> None:
    column = Categories.from_texts(["traffic sign (back)"] * number + ["sign"] * others)
    assert names.name_of_both(column, *column.names) == kept


def test_two_kinds_of_object_that_are_taken_for_each_other_now_and_then_stay(
    city: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objects of one half of the city are of one kind, and one detection in ten is called by the name of the other."""
    assert city.truth_detections is not None
    of = dict(zip(city.truth_detections.detection_id.tolist(), city.truth_detections.object_id.tolist(), strict=True))
    kind = np.array([of.get(each, -1) % 2 == 1 for each in city.detections.detection_id.tolist()])
    confused = View(called(city, kind ^ by_chance(city, 0.1)))
    assert TwoNames().find(confused) is None
    monkeypatch.setattr(names, "_are_near", lambda *_: True)
    assert TwoNames().find(confused) is None
    monkeypatch.setattr(names, "_OFTEN", 0.01)
    assert TwoNames().find(confused) is not None


def test_two_objects_on_one_pole_are_two_kinds(city: Dataset) -> None:
    """Below each light hangs a plate, which most pictures of the light show."""
    boxes = city.detections
    below = boxes.take(by_chance(city, 0.8))
    below = below.replace(
        detection_id=below.detection_id + 1_000_000,
        center_px=below.center_px + [0.0, 1.0] * below.size_px,
        class_name=Categories.from_texts(["plate"] * len(below)),
    )
    both = boxes.replace(
        detection_id=np.concatenate([boxes.detection_id, below.detection_id]),
        image_id=np.concatenate([boxes.image_id, below.image_id]),
        class_name=Categories.from_texts([*boxes.class_name.texts(), *below.class_name.texts()]),
        center_px=np.concatenate([boxes.center_px, below.center_px]),
        size_px=np.concatenate([boxes.size_px, below.size_px]),
        score=np.concatenate([boxes.score, below.score]),
    )
    given = View(Dataset(**{**vars(city), "detections": both, "truth_detections": None}))
    assert len(names.points_of_classes(given)) == 2
    joined = names.joined_as_one(given, "traffic_light", "plate")
    assert joined.gain.difference < 0.0
    assert TwoNames().find(given) is None
