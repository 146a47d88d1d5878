"""How the contest of conventions stops: what is too likely an accident, what costs a group too much, who stands."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from check_faults import FAULTS as INJECTED
from check_faults import good_city, of_camera, upside_down
from checking import FAULT_NAMED
from valuemap.cameras import camera_centers
from valuemap.check import contest
from valuemap.check.agreement import Agreement, agreement_on
from valuemap.check.contest import (
    AmongOthers,
    Reading,
    finding_of_contest,
    hold_contest,
    measure_reading,
    spoils_a_group,
    try_readings,
    which_lead,
)
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import LEAST_RISE, Fix, View, keep_rows, with_centers
from valuemap.check.groups import Group
from valuemap.check.poses import CameraAxes
from valuemap.check.registry import CONVENTIONS
from valuemap.check.sample import Sample
from valuemap.dataset import Dataset
from valuemap.progress import silent


@pytest.fixture(scope="module")
def view() -> View:
    """A small city in which every second pass has a camera of its own."""
    return View(good_city(1, passes_per_street=2))


def test_a_reading_that_is_no_better_than_given_is_not_told_for_being_as_good_as_the_best(
    view: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best is far better than given, but does not stand; the one that stands may be better by luck."""

    def reading(gain: np.ndarray, number: int | None, uprightness: float) -> Reading:
        convention = None if number is None else CONVENTIONS[number]
        fix = None if number is None else lambda dataset: dataset
        return Reading(convention, str(number), fix, replace(view.agreement, gain=gain), uprightness)

    scatter = 12.0 * np.array([1.0, -1.0] * 6) + np.arange(12.0)
    given, best = reading(np.zeros(12), None, 1.0), reading(10.0 + np.arange(12.0) / 12.0, 0, 0.0)
    lucky, sure = reading(8.0 + scatter, 1, 1.0), reading(9.9 + np.arange(12.0) / 10.0, 2, 1.0)
    monkeypatch.setattr(contest, "_everywhere", lambda _, each: [each.agreement])
    found = finding_of_contest(view, [given, best, sure], best)
    assert found is not None
    assert found.fault == CONVENTIONS[2].name
    assert finding_of_contest(view, [given, best, lucky], best) is None


@pytest.mark.parametrize(("share", "is_spoilt"), [(0.5, False), (1.5, True)])
def test_a_group_is_spoilt_by_more_than_what_good_passes_differ_by(
    share: float, is_spoilt: bool, view: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = Group(camera_id=1)
    of_camera_1 = len(mine.part(view.dataset).detections)

    def measured(dataset: Dataset, sample: Sample, gate_px: float, _: Fix | None) -> Agreement:
        agreement = agreement_on(sample, dataset, gate_px)
        is_mine = len(sample.whole.detections) == of_camera_1
        return replace(agreement, gain=(1.0 - is_mine * share * LEAST_RISE) * agreement.gain)

    monkeypatch.setattr(contest, "measure_reading", measured)
    assert spoils_a_group(view, lambda dataset: dataset) is is_spoilt


@pytest.mark.parametrize(("images", "is_up_unknown"), [(100, False), (10_000, True)])
def test_of_one_camera_it_counts_whether_that_one_stands(images: int, is_up_unknown: bool, view: View) -> None:
    """Whether all stand says only how sure the frame's up is, which cameras that lie along an axis may have wrong."""
    whole, group = view.dataset, Group(camera_id=1)
    mine = whole.images.camera_id == 1
    some = keep_rows(whole, images=~mine | (np.cumsum(mine) <= images))
    spoiled = View(of_camera(some, upside_down(some), 1))
    tried = try_readings(spoiled, [AmongOthers(CameraAxes(), group)], silent, group)
    given, turned = tried[0], next(each for each in tried if each.how == "x left, y up, z forward")
    assert (given.is_upright, turned.is_upright) == (False, True)
    assert given.uprightness == pytest.approx(-turned.uprightness, abs=1e-9)
    assert given.is_along_axis is is_up_unknown


def test_a_few_stretches_refute_most_readings_and_no_good_one(monkeypatch: pytest.MonkeyPatch) -> None:
    spoiled = INJECTED["heading_convention"].spoil(good_city(1, passes_per_street=1))
    assert spoiled is not None
    raced = View(spoiled)
    measured: list[Dataset] = []

    def measure(dataset: Dataset, *given: Any) -> Agreement:
        measured.append(dataset)
        return measure_reading(dataset, *given)

    monkeypatch.setattr(contest, "measure_reading", measure)
    told = hold_contest(raced, CONVENTIONS)
    assert told.finding is not None
    assert told.finding.fault == "heading_convention"
    few = [each for each in measured if len(each.images) < len(raced.stretches.image_row)]
    assert 0 < len(measured) - len(few) < len(few) / 2
    monkeypatch.setattr(contest, "which_lead", lambda _view, _given, fixes, _progress: [True] * len(fixes))
    by_all = hold_contest(View(spoiled), CONVENTIONS)
    assert by_all.finding is not None
    assert by_all.finding.to_json() == told.finding.to_json()


def test_all_readings_stay_where_few_stretches_cannot_tell_or_cameras_lie(view: View) -> None:
    given = Reading(None, "as given", None, view.agreement, 1.0)
    nothing: list[Fix] = [
        lambda dataset: dataset,
        lambda dataset: with_centers(dataset, -camera_centers(dataset.images)),
    ]
    assert which_lead(view, given, nothing, silent) == [True, False]
    assert which_lead(view, replace(given, uprightness=0.0), nothing, silent) == [True, True]
    noise = View(with_centers(view.dataset, 1e3 * np.random.default_rng(0).normal(size=(len(view.dataset.images), 3))))
    assert which_lead(noise, given, nothing, silent) == [True, True]
    few = View(keep_rows(view.dataset, images=np.arange(len(view.dataset.images)) < 60))
    assert few.stretches.every(4).places < 5
    assert which_lead(few, given, nothing, silent) == [True, True]


def test_a_pass_is_off_only_if_all_rays_agree_better_so_than_with_another_reading_of_all_data(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Mirrored pictures of straight roads agree with themselves, and two passes of them see things apart."""
    offset = FAULT_NAMED["pass_offset"]
    monkeypatch.setattr(sys.modules["valuemap.check.examine"], "FAULTS", (offset,))
    city = good_city(0)
    mirrored = INJECTED["mirrored_pictures"].spoil(keep_rows(city, images=city.images.pass_id.codes < 2))
    off = INJECTED["pass_offset"].spoil(city)
    assert mirrored is not None
    assert off is not None
    view = View(mirrored)
    reading = hold_contest(view, CONVENTIONS).finding
    assert reading is not None
    assert reading.fault == "mirrored_pictures"
    for given, told in ((view, "mirrored_pictures"), (View(off), "pass_offset")):
        (alone,) = find_in_stage(given, "fine", silent)
        assert alone.fault == "pass_offset"
        (found,) = find_in_stage(given, "fine", silent, reading)
        assert found.fault == told
        assert found.chance == alone.chance


def test_the_reading_that_comes_next_is_kept_where_none_is_found(view: View) -> None:
    verdict = hold_contest(view, CONVENTIONS)
    assert verdict.finding is None
    best = max(try_readings(view, CONVENTIONS, silent), key=lambda each: each.total)
    assert (verdict.runner_up is None) == (best.fix is None or best.is_guess)
    if verdict.runner_up is not None:
        assert verdict.runner_up.figures["reading"] == best.how
