"""One camera or pass whose rays meet nothing that others see, unless it is read another way."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from check_faults import FAULTS as INJECTED
from check_faults import good_city, good_rig, of_camera
from valuemap.check import examine, others
from valuemap.check.boxes import MirroredPictures
from valuemap.check.fault import Convention, Fix, View
from valuemap.check.frames import HeadingsUseless, WorldAxes
from valuemap.check.groups import Group
from valuemap.check.others import find_by_others, points_of_others
from valuemap.check.registry import CONVENTIONS
from valuemap.dataset import Dataset


@pytest.fixture(scope="module")
def rig() -> Dataset:
    return good_rig(14, passes_per_street=1)


@pytest.fixture(scope="module")
def city() -> Dataset:
    """The second of three passes has a camera of its own."""
    return good_city(1, passes_per_street=3)


@pytest.fixture(scope="module")
def mirrored(city: Dataset) -> View:
    """Pictures of that camera are mirrored: along a straight road its rays still meet each other."""
    spoiled = INJECTED["mirrored_pictures"].spoil(city)
    assert spoiled is not None
    return View(of_camera(city, spoiled, 1))


def test_mirrored_pictures_of_one_pass_are_named_and_undone(
    city: Dataset, mirrored: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules["valuemap.check.examine"]
    monkeypatch.setattr(module, "CONVENTIONS", (MirroredPictures(),))
    monkeypatch.setattr(module, "FAULTS", ())
    monkeypatch.setattr(module, "find_odd_group", lambda *_: None)
    outcome = examine(mirrored.dataset)
    assert [(each.fault, each.of) for each in outcome.findings] == [("mirrored_pictures", "camera 1")]
    np.testing.assert_allclose(outcome.fixed.detections.center_px, city.detections.center_px, atol=1e-9)
    monkeypatch.setattr(module, "find_by_others", lambda *_: None)
    assert examine(mirrored.dataset).findings == ()


def test_smaller_pictures_of_a_side_camera_that_sees_little_are_named_and_undone(rig: Dataset) -> None:
    smaller = INJECTED["picture_size"].spoil(rig)
    assert smaller is not None
    found = find_by_others(View(of_camera(rig, smaller, 0)), CONVENTIONS)
    assert found is not None
    assert (found.fault, found.of) == ("picture_size", "camera 0")
    assert found.fix is not None
    fixed = found.fix(of_camera(rig, smaller, 0)).detections
    np.testing.assert_allclose(fixed.center_px, rig.detections.center_px, rtol=0.03)


def test_good_rays_meet_what_others_see_best_as_they_are(
    city: Dataset, rig: Dataset, mirrored: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    for given in (city, rig):
        assert find_by_others(View(given), CONVENTIONS) is None
    monkeypatch.setattr(others, "FAR_WORSE", 0.01)  # Mirrored rays meet a few, in the middle of the pictures.
    assert find_by_others(mirrored, [MirroredPictures()]) is None


def test_points_to_meet_are_those_of_others(mirrored: View) -> None:
    """Else what a camera sees itself, wherever it looks, is what it should see."""
    group, agreement = Group(camera_id=1), mirrored.agreement_at_many_places
    points = points_of_others(mirrored, group)
    assert points is not None
    image = agreement.rays.image_row[agreement.found.voters.astype(np.int64)]
    is_other = ~group.images_of(mirrored.many_places.dataset)[image]
    votes = np.add.reduceat(is_other.astype(np.int64), agreement.found.voter_offsets[:-1])
    assert votes.min() < 3
    assert len(points.place) == (votes >= 3).sum()


def test_a_ray_is_worth_one_point_and_only_one_of_its_place_and_class(mirrored: View) -> None:
    points = points_of_others(mirrored, Group(camera_id=1))
    assert points is not None
    part, rays = points.part, points.rays(points.part)
    ray, point = points.pairs(rays)
    assert (points.place_of_image[rays.image_row[ray]] == points.place[point]).all()
    assert (rays.class_code[ray] == points.class_code[point]).all()
    once = points.worth(part, mirrored.gate_px)
    double = replace(
        points,
        position_m=np.concatenate([points.position_m] * 2),
        place=np.concatenate([points.place] * 2),
        class_code=np.concatenate([points.class_code] * 2),
    )
    assert double.worth(part, mirrored.gate_px).sum() == pytest.approx(once.sum())


def test_all_readings_of_all_groups_count_and_all_rays_must_bear_it_out(
    mirrored: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = [MirroredPictures()]
    found, again = find_by_others(mirrored, one), find_by_others(mirrored, [*one, *one])
    assert found is not None
    assert again is not None
    assert found.chance is not None
    assert again.chance == pytest.approx(2.0 * found.chance)
    monkeypatch.setattr(others, "LEAST_CHANCE", 0.99 * found.chance)
    assert find_by_others(mirrored, one) is None
    monkeypatch.undo()
    monkeypatch.setattr(others, "AGAINST", 0.0)
    assert find_by_others(mirrored, one) is None


def test_of_readings_that_are_the_same_the_first_is_told(mirrored: View) -> None:
    class Same(MirroredPictures):
        name = "first"

    found = find_by_others(mirrored, [Same(), MirroredPictures()])
    assert found is not None
    assert found.fault == "first"


@pytest.mark.parametrize("convention", [WorldAxes(), HeadingsUseless()])
def test_a_camera_has_no_world_of_its_own_and_nothing_is_guessed(convention: Convention, mirrored: View) -> None:
    group = Group(camera_id=1)
    points = points_of_others(mirrored, group)
    assert points is not None
    fixes: list[Fix] = [fix for _, fix in convention.readings(points.part)]
    assert fixes
    assert list(others.readings_of_group(mirrored, [convention], group, points)) == []
