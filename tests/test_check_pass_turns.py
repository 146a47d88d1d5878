"""One pass whose world is turned a little against that of the others."""

from __future__ import annotations

import numpy as np
import pytest

from check_faults import good_city, pass_offset, pass_turned
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import pass_turns
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import View
from valuemap.check.pass_turns import PassTurned
from valuemap.dataset import Dataset
from valuemap.progress import silent


@pytest.fixture(scope="module")
def city() -> Dataset:
    return good_city(3, passes_per_street=2)


@pytest.fixture(scope="module")
def turned(city: Dataset) -> View:
    """A pass is turned by 1.5 degrees counter-clockwise about the middle of the city."""
    spoiled = pass_turned(city)
    assert spoiled is not None
    return View(spoiled)


def test_a_turned_pass_is_named_and_put_back(city: Dataset, turned: View) -> None:
    off_m = np.linalg.norm(camera_centers(turned.dataset.images) - camera_centers(city.images), axis=1)
    assert off_m.max() > 3.0
    (finding,) = find_in_stage(turned, "fine", silent)
    assert (finding.fault, finding.figures["pass"]) == ("pass_turned", finding.of and finding.of.removeprefix("pass "))
    # Of two passes nobody knows which is right: the other one may be turned instead.
    is_spoiled = off_m[city.images.pass_id.codes == city.images.pass_id.code_of(finding.figures["pass"])].max() > 0.0
    assert finding.figures["turn_deg"] == pytest.approx(-1.5 if is_spoiled else 1.5, abs=0.1)
    assert finding.fix is not None
    fixed = finding.fix(turned.dataset).images
    # All is as it was, but for what is common to both passes.
    left_deg = 0.0 if is_spoiled else 1.5
    back = pass_turns.turn_about(turned.dataset.frame.up, -left_deg)
    moved = camera_centers(fixed) @ back.T - camera_centers(city.images)
    assert np.linalg.norm(moved - np.median(moved, axis=0), axis=1).max() < 1.0
    np.testing.assert_allclose(rotation_matrices(fixed) @ back.T, rotation_matrices(city.images), atol=0.005)
    assert PassTurned().find(View(finding.fix(turned.dataset))) is None


def test_a_pass_that_is_off_is_not_turned_and_good_ones_are_neither(city: Dataset) -> None:
    off = pass_offset(city)
    assert off is not None
    assert PassTurned().find(View(off)) is None
    assert PassTurned().find(View(city)) is None


def test_all_passes_count_and_a_shift_is_the_simpler_explanation(turned: View, monkeypatch: pytest.MonkeyPatch) -> None:
    found = PassTurned().find(turned)
    assert found is not None
    assert found.chance is not None
    monkeypatch.setattr(pass_turns, "LEAST_CHANCE", 0.99 * found.chance)
    other = PassTurned().find(turned)
    assert other is None or other.of != found.of
    monkeypatch.undo()
    best_turn = pass_turns.best_turn_of_pass
    # If a shift did as well, the turn is not named.
    monkeypatch.setattr(
        pass_turns,
        "best_turn_of_pass",
        lambda view, meeting, code, _: best_turn(view, meeting, code, pass_turns.ANGLES_DEG),
    )
    assert PassTurned().find(turned) is None
