"""Of two passes that are apart, one is off: which one, truth or the sigmas of poses tell, or nothing does."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city, pass_offset, pass_time_shift
from valuemap.cameras import camera_centers
from valuemap.check.examine import examine
from valuemap.check.fault import View, with_centers, with_images, with_pass_moved
from valuemap.check.meeting import unexplained_passes
from valuemap.check.pass_offsets import PassOffset
from valuemap.check.pass_turns import PassTurned, turn_about
from valuemap.dataset import Dataset

OFFSETS_M = ([4.0, 3.0, 0.0], [0.0, 0.0, 1.5])


@pytest.fixture(scope="module")
def two() -> Dataset:
    return good_city(21, passes_per_street=2)


def moved(dataset: Dataset, code: int, offset_m: list[float]) -> Dataset:
    mine = dataset.images.pass_id.codes == code
    return with_centers(dataset, camera_centers(dataset.images) + np.where(mine[:, None], offset_m, 0.0))


def without_truth(dataset: Dataset) -> Dataset:
    return Dataset(**{**vars(dataset), "truth": None, "truth_detections": None})


@pytest.mark.parametrize("code", [0, 1])
def test_the_pass_that_the_truth_is_not_with_is_moved_and_the_truth_stays(code: int, two: Dataset) -> None:
    outcome = examine(moved(two, code, OFFSETS_M[0]))
    (finding,) = outcome.findings
    assert (finding.fault, finding.figures["pass"]) == ("pass_offset", two.images.pass_id.names[code])
    left_m = np.linalg.norm(camera_centers(outcome.fixed.images) - camera_centers(two.images), axis=1)
    assert left_m.max() < 0.3
    assert outcome.fixed.truth is two.truth


@pytest.mark.parametrize(("offset_m", "fault"), [(OFFSETS_M[0], "pass_offset"), (OFFSETS_M[1], "camera_height")])
def test_where_nothing_tells_neither_is_moved(offset_m: list[float], fault: str, two: Dataset) -> None:
    given = moved(without_truth(two), 0, offset_m)
    outcome = examine(given)
    (finding,) = outcome.findings
    assert finding.fault == fault
    assert finding.fix is None
    assert "nothing tells which of the two" in finding.what
    assert all(name in finding.do for name in two.images.pass_id.names)
    assert outcome.fixed is given


def test_truth_that_is_with_neither_of_two_is_not_moved(two: Dataset) -> None:
    assert two.truth is not None
    truth = two.truth.replace(position_in_world_m=two.truth.position_in_world_m + [2000.0, -700.0, 0.0])
    outcome = examine(moved(Dataset(**{**vars(two), "truth": truth}), 0, OFFSETS_M[0]))
    assert [each.fault for each in outcome.findings] == ["pass_offset"]
    assert outcome.fixed.truth is truth


@pytest.mark.parametrize("code", [0, 1])
def test_sigmas_tell_where_one_pass_states_such_errors_and_the_other_none(code: int, two: Dataset) -> None:
    mine = two.images.pass_id.codes == code
    given = with_images(moved(without_truth(two), code, OFFSETS_M[0]), position_sigma_m=np.where(mine, 5.0, 0.1))
    finding = PassOffset().find(View(given))
    assert finding is not None
    assert finding.fix is not None
    assert finding.figures["pass"] == two.images.pass_id.names[code]
    loose = with_images(given, position_sigma_m=np.full(len(mine), 5.0))
    finding = PassOffset().find(View(loose))
    assert finding is not None
    assert finding.fix is None


def test_of_three_passes_two_agree() -> None:
    three = without_truth(good_city(1, passes_per_street=3))
    finding = PassOffset().find(View(moved(three, 1, OFFSETS_M[0])))
    assert finding is not None
    assert finding.fix is not None
    assert finding.figures["pass"] == three.images.pass_id.names[1]


@pytest.mark.parametrize("code", [0, 1])
def test_of_two_passes_that_are_turned_against_each_other_truth_tells(code: int, two: Dataset) -> None:
    name = two.images.pass_id.names[code]
    given = with_pass_moved(two, name, turn_about((0.0, 0.0, 1.0), 2.0), np.zeros(3))
    finding = PassTurned().find(View(given))
    assert finding is not None
    assert finding.of == f"pass {name}"
    assert finding.fix is not None
    left_m = np.linalg.norm(camera_centers(finding.fix(given).images) - camera_centers(two.images), axis=1)
    assert left_m.max() < 1.0
    finding = PassTurned().find(View(without_truth(given)))
    assert finding is not None
    assert finding.fix is None
    assert "against each other" in finding.what


def test_what_no_single_fault_explains_is_said_to_be_wrong(two: Dataset) -> None:
    late = pass_time_shift(two)
    spoiled = None if late is None else pass_offset(late)
    assert spoiled is not None
    outcome = examine(spoiled)
    assert outcome.findings == ()
    (note,) = outcome.notes
    assert "something else is wrong" in note
    assert two.images.pass_id.names[0] in note


def test_passes_of_loose_poses_are_not_called_wrong(two: Dataset) -> None:
    assert unexplained_passes(View(two), View(two).step_m) == ()
    loose = {"position_white_m": 0.8, "position_drift_m": 2.0, "rotation_white_deg": 0.6, "rotation_drift_deg": 1.0}
    assert all("something else" not in note for note in examine(good_city(5, **loose)).notes)
