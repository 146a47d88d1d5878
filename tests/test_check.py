"""Every known fault is put into a good simulated city and has to be named; good data must raise none."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from check_faults import FAULTS as INJECTED
from check_faults import RIG_FAULTS, exchanged, good_city, lowered, of_camera
from check_faults import good_rig as rig
from small_dataset import small_dataset
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import boxes, cameras, contest, distortion, examine, fit, frames, mounts, passes, sizes
from valuemap.check.agreement import Agreement, compare, gains_of_objects, measure_agreement
from valuemap.check.boxes import PictureSize, _chance_of_gap, _Ends, _OfSquare, picture_sizes, rows_in_images
from valuemap.check.cameras import PARAMETERS, _followed, _is_wider_gate_only, with_focal
from valuemap.check.contest import _compare, _joined, _Reading, _suspicion, hold_contest, spoils_a_group
from valuemap.check.examine import _look
from valuemap.check.fault import (
    LEAST_CHANCE,
    Convention,
    Fault,
    Finding,
    View,
    gains_of_all,
    keep_rows,
    with_centers,
    with_detections,
    with_images,
    with_poses,
)
from valuemap.check.fit import Changed, Estimate, Parameter, apply
from valuemap.check.frames import WorldAxes
from valuemap.check.groups import Group
from valuemap.check.headings import driving_azimuths, headings, level_rotations, rotations_of
from valuemap.check.loose import Correction, Loose
from valuemap.check.offsets import find_shift
from valuemap.check.passes import (
    _at_a_seam,
    _jumping_passes,
    _passes_in_turn,
    _rolling_period,
    _unrolled,
    moved_along,
    seen_m,
)
from valuemap.check.poses import PitchAndRoll
from valuemap.check.quality import TruthElsewhere, strays
from valuemap.check.registry import CONVENTIONS, FAULTS
from valuemap.check.sample import driving_order, number_rows
from valuemap.check.seams import worst_seam
from valuemap.check.sizes import are_outside, object_heights
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, Frame, read_dataset, write_dataset
from valuemap.errors import InputError
from valuemap.progress import silent
from valuemap.simulate import PRESETS, simulate
from valuemap.tables import Categories, Floats

_CONVENTIONS = {convention.name for convention in CONVENTIONS}
_SEEN_AGAIN = {"passes_no_drives"}
"""Images without any order have none afterwards either: what is put right is which of them share a pass."""
_RECOVERED = {"degrees_for_radians": 0.6}
"""Degrees read as radians lose whole turns, which the direction of travel does not always give back."""
_NEEDS_ALL = {"mirrored_pictures", "boxes_top_left", "lens_model"}
"""What half as many passes do not prove."""
_NEEDS_FEW = {
    "pass_offset",
    "pass_frame",
    "pass_time_shift",
    "camera_height",
    "height_zero",
    "interleaved_passes",
    "wrong_camera",
}
"""What one pass and one camera cannot have."""
_FAULT = {fault.name: fault for fault in FAULTS}


_ESTIMATE = Estimate(("along",), np.array([0.5]), np.array([[1e-6]]), 40, 400)


@pytest.fixture(scope="module")
def good() -> Dataset:
    return good_city(1)


@pytest.fixture(scope="module")
def few() -> Dataset:
    """Half as many passes: enough for all that is looked for beside a fault."""
    return good_city(1, passes_per_street=2)


@pytest.fixture(scope="module")
def one() -> Dataset:
    """Each street is driven once: enough for what shows at once."""
    return good_city(1, passes_per_street=1)


def enough_for(name: str) -> str:
    """Return the fixture with the fewest passes that prove a fault."""
    return "good" if name in _NEEDS_ALL else "few" if name in _NEEDS_FEW else "one"


@pytest.fixture(scope="module")
def view(good: Dataset) -> View:
    return View(good)


@pytest.fixture(scope="module")
def view_of_few(few: Dataset) -> View:
    return View(few)


@pytest.fixture(scope="module")
def view_of_one(one: Dataset) -> View:
    return View(one)


def test_key_points_have_no_size_that_could_be_wrong(few: Dataset) -> None:
    points = few.detections.replace(size_px=np.zeros_like(few.detections.size_px))
    assert object_heights(View(Dataset(**{**vars(few), "detections": points}))) == {}


def test_truth_in_metres_is_not_called_misplaced_where_the_world_is_not_in_metres(one: Dataset) -> None:
    spoiled = INJECTED["scale"].spoil(one)
    assert spoiled is not None
    assert [found.fault for found in _look(View(spoiled), "results", silent)] == ["scale"]


def test_a_reading_that_few_places_cannot_prove_is_suspected_not_found(view: View) -> None:
    def reading(convention: Convention | None, gain: np.ndarray) -> _Reading:
        points = replace(view.agreement.found, voters=np.arange(len(gain), dtype=np.uint32))
        points = replace(points, position_in_world_m=np.zeros((len(gain), 3)), voter_offsets=np.arange(len(gain) + 1))
        agreement = replace(view.agreement, gain=gain, gain_of_point=gain, found=points)
        return _Reading(convention, "x y z w", None, agreement, uprightness=1.0, tests=tests)

    worse = np.array([3.0, 4.0, 2.0, 5.0, 4.0, 6.0, 3.0])
    better = worse + [4.0, 6.0, 3.0, 9.0, 5.0, 8.0, 2.0]
    tests = len(CONVENTIONS)
    quaternions, given = next(each for each in CONVENTIONS if each.name == "quaternion_order"), reading(None, worse)
    chance = compare(better, worse).chance * tests
    assert LEAST_CHANCE < chance < 0.05
    told = _suspicion(given, reading(quaternions, better))
    assert told is not None
    assert quaternions.what in told
    assert "x y z w" in told
    assert _suspicion(given, reading(quaternions, worse + 0.1 * (better - worse) * [1, -1, 1, 1, -1, 1, 1])) is None
    assert _suspicion(given, given) is None


def test_rows_are_numbered_in_the_order_of_their_columns() -> None:
    rows = np.array([[2, -1, 0], [0, 5, 9], [2, -1, 0], [0, 5, -9], [0, 4, 2**62], [2, -1, 1]])
    assert number_rows(*rows.T).tolist() == [3, 2, 3, 1, 0, 4]
    assert number_rows(rows[:0, 0], rows[:0, 1]).tolist() == []


def street(good: Dataset, start: int, length: int) -> Dataset:
    """Return images that follow each other, and nothing else."""
    rows = driving_order(good.images)[start : start + length]
    assert len(np.unique(good.images.pass_id.codes[rows])) == 1
    return keep_rows(good, images=np.isin(np.arange(len(good.images)), rows))


@pytest.mark.parametrize("start", [270, 540, 1260, 1620])
def test_quaternions_of_a_short_street_are_named(start: int, good: Dataset) -> None:
    """A hundred images have too few places to compare; single objects and where the cameras' up is say enough."""
    short = street(good, start, 100)
    assert hold_contest(View(short), CONVENTIONS).finding is None
    spoiled = INJECTED["quaternion_order"].spoil(short)
    assert spoiled is not None
    finding = convention_told(spoiled)
    assert finding.fault == "quaternion_order"
    assert finding.chance is not None
    assert finding.chance < LEAST_CHANCE
    assert finding.fix is not None
    fixed = finding.fix(spoiled)
    np.testing.assert_allclose(camera_centers(fixed.images), camera_centers(short.images), atol=1e-6)


def test_where_rays_cannot_tell_the_sky_is_not_moved_but_what_it_may_be_is_told(few: Dataset) -> None:
    short = street(few, 450, 20)
    assert examine(short).findings == ()
    spoiled = INJECTED["quaternion_order"].spoil(short)
    assert spoiled is not None
    outcome = examine(spoiled)
    assert [finding.fault for finding in outcome.findings] == ["up_direction"]
    assert outcome.findings[0].fix is None
    assert any("x y z w" in note and "the rays are too few to tell" in note for note in outcome.notes)


def test_points_where_rays_may_meet_by_chance_are_no_objects(good: Dataset) -> None:
    spoiled = INJECTED["truth_elsewhere"].spoil(good)
    assert spoiled is not None
    assert _FAULT["truth_elsewhere"].find(View(spoiled)) is not None
    assert _FAULT["truth_elsewhere"].find(View(spoiled, meets=False)) is None
    assert object_heights(View(good)) != {}
    assert object_heights(View(good, meets=False)) == {}


def test_a_guess_is_compared_by_places_however_few_they_are(good: Dataset) -> None:
    """Level cameras are better or worse for whole stretches, so their objects do not count one by one."""
    view = View(street(good, 270, 40))
    few, none = [view.agreement], [replace(view.agreement, gain=0.0 * view.agreement.gain, gain_of_point=np.zeros(0))]
    none = [replace(none[0], found=view.agreement.found.take(np.array([], dtype=np.int64)))]
    assert _compare(few, none).of == "objects"
    assert _compare(few, none).places == len(view.agreement.found)
    assert _compare(few, none, may_split=False).of == "places"
    assert {each.name for each in CONVENTIONS if each.is_guess} == {
        "pitch_and_roll", "headings_useless", "held_positions", "degrees_for_radians"
    }  # fmt: skip


def test_an_object_is_all_that_points_of_either_reading_join(view: View) -> None:
    def reading(points: list[list[int]], gain: list[float]) -> Agreement:
        found = replace(
            view.agreement.found,
            position_in_world_m=np.zeros((len(points), 3)),
            voter_offsets=np.cumsum([0, *map(len, points)]),
            voters=np.concatenate(points).astype(np.uint32),
        )
        return replace(view.agreement, detection_id=np.arange(10) + 50, found=found, gain_of_point=np.array(gain))

    one = reading([[0, 1, 2, 3], [6, 7]], [2.5, 0.5])
    two = reading([[0, 1], [2, 3], [8, 9]], [0.25, 0.5, 1.0])
    better, worse = gains_of_objects([one], [two])
    assert sorted(zip(better.tolist(), worse.tolist(), strict=True)) == [(0.0, 1.0), (0.5, 0.0), (2.5, 0.75)]
    # The same objects on another sample are no others.
    assert [len(side) for side in gains_of_objects([one, one], [two, two])] == [3, 3]


def test_attitudes_speak_where_cameras_lie_askew_only(view: View) -> None:
    def reading(uprightness: float, *, is_along_axis: bool = False) -> _Reading:
        return _Reading(None, "", None, view.agreement, uprightness, is_along_axis)

    upright = reading(0.999)
    assert _joined(0.01, upright, reading(-0.3)) == pytest.approx(5e-6 * (1.0 - np.log(5e-6)))
    assert _joined(0.01, upright, reading(-0.3, is_along_axis=True)) == 0.01
    assert _joined(0.01, upright, reading(0.9)) == 0.01
    assert _joined(0.2, upright, reading(-0.3)) == 0.2


def test_a_seam_that_rays_cannot_see_is_no_fault(good: Dataset, view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = seen_m(view)
    assert 0.1 < seen < 1.0  # Objects are 10 to 80 m away, the gate is 0.012 rad.
    drive = one_drive_in_two(good)
    is_late = drive.images.pass_id.codes == drive.images.pass_id.code_of("late")
    up = np.where(is_late[:, None], [0.0, 0.0, 0.5 * seen], 0.0)
    jumps = View(with_centers(drive, camera_centers(drive.images) + up))
    assert _at_a_seam(jumps) is not None
    monkeypatch.setattr("valuemap.check.passes.seen_m", lambda _: seen)
    assert _at_a_seam(jumps) is None


def test_the_gate_is_one_angle_whatever_the_focal_length(good: Dataset, view: View) -> None:
    """Pictures said to be wider make errors of poses fewer pixels, which is no agreement."""
    noisy = camera_centers(good.images) + np.random.default_rng(3).normal(0.0, 1.0, (len(good.images), 3))
    coarse = View(with_centers(good, noisy))
    wide = with_focal(coarse.dataset, -2.0)
    sample = coarse.many_places
    in_pixels = measure_agreement(sample.of(wide), sample.place_of_image, coarse.gate_px).gain.sum()
    assert gains_of_all(coarse, wide, is_gate_an_angle=True).sum() < 0.5 * in_pixels
    assert _is_wider_gate_only(coarse, wide)
    assert not _is_wider_gate_only(coarse, with_focal(coarse.dataset, 0.0))


def test_a_focal_length_that_is_followed_to_a_wider_gate_only_is_not_named(
    one: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = with_focal(one, 0.1)
    named = cameras._find_correction(View(wrong))
    assert named is not None
    assert named.parameter.name == "log_focal"
    monkeypatch.setattr("valuemap.check.cameras._followed", lambda _view, best, _given: replace(best, value=-2.0))
    assert cameras._find_correction(View(wrong)) is None


def test_a_shift_in_time_is_followed_where_least_squares_stay_behind(good: Dataset, view: View) -> None:
    shifted = View(with_centers(good, moved_along(good, 5.0)))
    parameter = next(each for each in PARAMETERS if each.name == "along")
    given = gains_of_all(shifted, shifted.dataset)
    start = Correction(parameter, -1.0, 0.05, 1e-9, compare(given, given), _ESTIMATE)
    found = _followed(shifted, start, given)
    assert found.value == pytest.approx(-5.0, abs=0.3)
    assert found.comparison.difference > 0.0


def test_what_agrees_the_more_the_farther_is_followed_so_far_and_no_farther(
    good: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rays that agree ever better with a larger value, as no rays do: six doublings, and twelve values beyond."""
    tried: list[float] = []

    def change(dataset: Dataset, value: float) -> Dataset:
        tried.append(value)
        return dataset

    def gains(_view: View, _dataset: Dataset) -> Floats:
        # Every value has a gain of its own, and its neighbours differ: the search never settles.
        return np.full(40, np.log(tried[-1])) + np.linspace(0.0, 0.1, 40)

    monkeypatch.setattr("valuemap.check.cameras.gains_of_all", gains)
    given = np.zeros(40)
    start = Correction(Parameter("along", change), 1.0, 1e-12, 1e-9, compare(given, given), _ESTIMATE)
    found = _followed(View(good), start, given)
    assert 64.0 <= found.value <= 128.0
    assert len(tried) <= 1 + 6 + 12


def test_what_the_opposite_gives_as_well_is_no_correction(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses that are moved along a drive either way are smoother than measured ones, so rays agree the better."""
    random = np.random.default_rng(0)

    def gains(_view: View, version: Dataset, **_: bool) -> Floats:
        return np.full(40, 100.0 if version is view.dataset else 110.0) + random.normal(0.0, 1.0, 40)

    monkeypatch.setattr(cameras, "gains_of_all", gains)
    monkeypatch.setattr(cameras, "_better", lambda *given: given[2:])
    monkeypatch.setattr(cameras, "common_errors", lambda _: _ESTIMATE)
    assert cameras._find_correction(view) is None


def test_a_vote_whose_camera_has_no_ray_a_step_away_is_left_out(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    over_depth = fit._over_depth

    def without_one(local: Floats) -> Floats:
        found = over_depth(local)
        found[0] = np.inf
        return found

    monkeypatch.setattr(fit, "_over_depth", without_one)
    found = cameras.estimate_of(view, PARAMETERS[:1])
    assert found is not None
    assert abs(found.value[0]) < 3.0 * found.of("pitch")[1]


def test_the_images_of_a_sample_change_as_they_do_in_the_whole(good: Dataset, view: View) -> None:
    """What they are moved along are the drives of the whole dataset."""
    sample = view.stretches
    value = np.array([0.02, -0.03, 0.01, 0.04, 1.5])
    changed, whole = Changed(good, sample, PARAMETERS, value), apply(good, PARAMETERS, value)
    part, expected = changed.images, sample.of(whole)
    np.testing.assert_allclose(rotation_matrices(part.images), rotation_matrices(expected.images), atol=1e-12)
    np.testing.assert_allclose(camera_centers(part.images), camera_centers(expected.images), atol=1e-9)
    np.testing.assert_allclose(part.cameras.params[0], expected.cameras.params[0])
    assert not np.allclose(camera_centers(changed.images.images), camera_centers(sample.of(good).images))


def test_images_move_with_a_parameter_as_its_changes_do(good: Dataset, view: View) -> None:
    sample, step = view.stretches, 1e-4
    value = np.array([0.02, -0.03, 0.01, 0.04, 1.5])
    changed, whole = Changed(good, sample, PARAMETERS, value), apply(good, PARAMETERS, value)
    for parameter in PARAMETERS:
        motion = changed.motion(parameter)
        if motion is None:
            assert parameter.name == "log_focal"
            continue
        ahead, behind = (sample.of(parameter.change(whole, way * step)).images for way in (1.0, -1.0))
        move = (camera_centers(ahead) - camera_centers(behind)) / (2.0 * step)
        np.testing.assert_allclose(motion.move, move, atol=1e-3)
        between = Rotation.from_matrix(rotation_matrices(behind).transpose(0, 2, 1) @ rotation_matrices(ahead))
        np.testing.assert_allclose(motion.turn, between.as_rotvec() / (2.0 * step), atol=1e-5)


def test_a_pass_that_drives_its_streets_again_and_again_is_a_drive() -> None:
    """Its laps lie closer to each other than its steps are long."""
    lap, step = np.divmod(np.arange(400), 40)
    angle = 2.0 * np.pi * (step + 0.09 * lap) / 40
    center = np.stack([50.0 * np.cos(angle), 50.0 * np.sin(angle), 0.0 * angle], axis=1)
    images = small_dataset().images.take(np.zeros(400, dtype=np.int64))
    images = images.replace(
        image_id=np.arange(400),
        cam_from_world_quat=np.tile([1.0, 0.0, 0.0, 0.0], (400, 1)),
        cam_from_world_m=-center,
        timestamp_s=np.arange(400.0),
    )
    assert _jumping_passes(images) == []
    dealt = np.random.default_rng(0).permutation(400).astype(np.float64)
    assert len(_jumping_passes(images.replace(timestamp_s=dealt))) == 1


_LOOSE = replace(
    PRESETS["small"], position_white_m=0.4, position_drift_m=1.5, rotation_white_deg=0.3, rotation_drift_deg=0.8
)
"""Poses as of a phone: metres and most of a degree off."""
_LOOSE_BY = ("position_white_m", "position_drift_m", "rotation_white_deg", "rotation_drift_deg")


@pytest.fixture(scope="module")
def loose() -> View:
    return View(simulate(replace(_LOOSE, passes_per_street=1), seed=302))


def one_pass(seed: int, **changes: float) -> Dataset:
    """Return a small city that each street of is driven once."""
    return good_city(seed, passes_per_street=1, **changes)


def test_what_looks_like_noise_to_a_narrow_gate_is_seen_by_a_wide_one() -> None:
    """Errors of 1 m and 0.6 degrees, and a camera that is 3 degrees askew."""
    phone = {"position_white_m": 0.4, "position_drift_m": 1.0, "rotation_white_deg": 0.3, "rotation_drift_deg": 0.5}
    given = one_pass(308, **phone)
    assert cameras._find_beyond_noise(View(given)) is None
    askew = INJECTED["camera_yaw"].spoil(given)
    assert askew is not None
    assert cameras._find_correction(View(askew)) is None
    found = cameras._find_beyond_noise(View(askew))
    assert found is not None
    assert found.parameter.name == "yaw"
    assert np.degrees(found.value) == pytest.approx(-3.0, abs=0.7)


def test_a_shift_in_time_of_a_short_drive_is_named() -> None:
    late = INJECTED["time_shift"].spoil(one_pass(301))
    assert late is not None
    assert cameras._find_correction(View(late)) is None
    found = cameras.TimeShift().find(View(late))
    assert found is not None
    assert "ahead" in found.what


def test_a_focal_length_is_told_where_all_rays_of_an_object_vote() -> None:
    spoiled = INJECTED["focal_length"].spoil(one_pass(302))
    assert spoiled is not None
    assert cameras.FocalLength().find(View(spoiled)) is not None
    narrow, shorter = View(spoiled), with_focal(spoiled, -0.29)
    at_one_angle = gains_of_all(narrow, shorter, is_gate_an_angle=True).sum()
    assert at_one_angle < 0.98 * gains_of_all(narrow, spoiled).sum()  # As of poses that are off by metres.


def test_a_focal_length_is_no_tilt(monkeypatch: pytest.MonkeyPatch) -> None:
    spoiled = View(with_focal(one_pass(303), 0.45))
    assert cameras._find_beyond_noise(spoiled) is None
    monkeypatch.setattr(Loose, "_beside", lambda self, parameters, _rival, name: self._settled(parameters).of(name)[0])
    wrong = cameras._find_beyond_noise(spoiled)
    assert wrong is not None
    assert wrong.parameter.name == "pitch"


def test_an_error_that_is_put_right_in_two_steps_is_named_once() -> None:
    given = one_pass(310)
    rotation = Rotation.from_euler("y", 6.0, degrees=True).as_matrix() @ rotation_matrices(given.images)
    askew = with_poses(given, rotation, camera_centers(given.images))
    outcome = examine(askew)
    assert [finding.fault for finding in outcome.findings] == ["camera_yaw"]
    first = outcome.findings[0].fix
    assert first is not None
    rest = [
        Rotation.from_matrix(rotation_matrices(each.images) @ rotation_matrices(given.images).transpose(0, 2, 1))
        for each in (first(askew), outcome.fixed)
    ]
    assert np.degrees(rest[0].magnitude().mean()) > 1.0
    assert np.degrees(rest[1].magnitude().mean()) < 0.3


def test_how_cameras_are_mounted_is_part_of_pitch_and_roll() -> None:
    """The cameras look up 3 degrees, which the noise hides: it is put right, and no second fault."""
    given = one_pass(300)
    spoiled = INJECTED["pitch_and_roll"].spoil(given)
    assert spoiled is not None
    outcome = examine(spoiled)
    assert [finding.fault for finding in outcome.findings] == ["pitch_and_roll"]
    assert np.median(headings(outcome.fixed)[1]) == pytest.approx(np.median(headings(given)[1]), abs=np.radians(0.3))


def test_pitch_and_roll_of_a_phone_are_not_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    given = View(one_pass(300, **{name: getattr(_LOOSE, name) for name in _LOOSE_BY}))
    assert hold_contest(given, [PitchAndRoll()]).finding is None
    monkeypatch.setattr(PitchAndRoll, "least_times", None)
    assert hold_contest(given, [PitchAndRoll()]).finding is not None


def test_a_camera_that_looks_too_low_is_not_upside_down(monkeypatch: pytest.MonkeyPatch) -> None:
    low = turned_by(one_pass(300), "x", 4.0)
    verdict = hold_contest(View(low), conventions("mirrored_pictures", "tilt_convention"))
    assert verdict.finding is None
    assert verdict.suspicion is None
    monkeypatch.setattr(contest, "_is_small_turn", lambda *_: False)
    assert hold_contest(View(low), conventions("mirrored_pictures", "tilt_convention")).finding is not None


def test_a_turn_of_as_much_as_magnetic_north_is_off_is_no_other_convention(
    monkeypatch: pytest.MonkeyPatch, one: Dataset
) -> None:
    aside = turned_by(one, "y", 9.0)
    verdict = hold_contest(View(aside), CONVENTIONS)
    assert verdict.finding is None
    assert verdict.suspicion is None
    monkeypatch.setattr(contest, "SMALL_TURNS_RAD", np.radians([2.0, 4.0, 6.0]))
    monkeypatch.setattr(frames, "_follow_the_drive", lambda _: False)  # Headings taken from the drive are not aside.
    assert hold_contest(View(aside), CONVENTIONS).finding is not None


def _to_world(dataset: Dataset, axes: list[list[int]], order: list[int]) -> Dataset:
    """Return poses that take cameras with other axes into the world, and quaternions in another order."""
    rotation = rotation_matrices(dataset.images).transpose(0, 2, 1) @ np.array(axes)
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)[:, order]
    return with_images(
        dataset, cam_from_world_quat=np.ascontiguousarray(quaternion), cam_from_world_m=camera_centers(dataset.images)
    )


@pytest.mark.parametrize(
    ("fault", "axes", "order"),
    [
        ("inverted_poses", [[1, 0, 0], [0, -1, 0], [0, 0, -1]], [0, 1, 2, 3]),  # As radiance fields have them.
        ("quaternion_order", [[0, -1, 0], [0, 0, -1], [1, 0, 0]], [1, 2, 3, 0]),  # As ROS has them.
    ],
)
def test_poses_of_cameras_with_other_axes_that_go_the_wrong_way_are_undone_at_once(
    one: Dataset, fault: str, axes: list[list[int]], order: list[int]
) -> None:
    finding = hold_contest(View(_to_world(one, axes, order)), CONVENTIONS).finding
    assert finding is not None
    assert finding.fault == fault
    assert finding.fix is not None
    fixed = finding.fix(_to_world(one, axes, order))
    assert np.allclose(rotation_matrices(fixed.images), rotation_matrices(one.images), atol=1e-9)
    assert np.allclose(camera_centers(fixed.images), camera_centers(one.images), atol=1e-6)


def test_shares_of_one_side_of_the_picture_that_were_multiplied_by_the_other_are_named(one: Dataset) -> None:
    extent = picture_sizes(one)
    factor = extent[:, ::-1] / extent
    boxes = one.detections
    spoiled = with_detections(one, center_px=boxes.center_px * factor, size_px=boxes.size_px * factor)
    finding = hold_contest(View(spoiled), CONVENTIONS).finding
    assert finding is not None
    assert finding.fault == "picture_size"
    assert finding.fix is not None
    assert np.allclose(finding.fix(spoiled).detections.center_px, boxes.center_px)


def test_what_is_wrong_with_the_main_camera_is_not_put_right_in_all(
    one_rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    extent = picture_sizes(one_rig)
    factor = 640.0 / extent.max(axis=1, keepdims=True)
    center = one_rig.detections.center_px * factor + (640.0 - extent * factor) / 2.0
    fitted = with_detections(one_rig, center_px=center, size_px=one_rig.detections.size_px * factor)
    spoiled = of_camera(one_rig, fitted, 1)
    wide = hold_contest(View(spoiled), conventions("picture_size")).finding
    assert wide is not None
    assert wide.of is None
    assert wide.fix is not None
    assert spoils_a_group(View(spoiled), wide.fix)
    assert told_of_convention("picture_size", spoiled, monkeypatch) == [("picture_size", "camera 1")]
    everywhere = hold_contest(View(fitted), conventions("picture_size")).finding
    assert everywhere is not None
    assert everywhere.fix is not None
    assert not spoils_a_group(View(fitted), everywhere.fix)


def test_of_a_car_one_of_whose_cameras_has_the_poses_of_another_time_no_images_are_of_several_drives() -> None:
    given = rig(1, passes_per_street=1)
    center, images = camera_centers(given.images), given.images
    late = (images.camera_id == 1)[:, None] * [6.0, 0.0, 0.0]
    assert _jumping_passes(with_centers(given, center + late).images) == []


def test_passes_of_one_image_each_tell_nothing_and_say_so(one: Dataset) -> None:
    names = [f"pass-{row}" for row in range(len(one.images))]
    outcome = examine(with_images(one, pass_id=Categories.from_texts(names)))
    assert any("cannot be told" in note for note in outcome.notes)


def test_names_of_one_camera_after_the_other_are_no_clock_that_starts_over() -> None:
    images = small_dataset().images.take(np.zeros(60, dtype=np.int64))
    camera, frame = np.divmod(np.arange(60), 30)
    images = images.replace(
        image_id=np.arange(60),
        name=pa.array([f"{'left' if c == 0 else 'right'}/{f:03d}.jpg" for c, f in zip(camera, frame, strict=True)]),
        camera_id=camera,
        timestamp_s=0.5 * frame,
    )
    given = replace(small_dataset(), images=images)
    assert _rolling_period(given) is None
    rolling = replace(given, images=images.replace(timestamp_s=np.asarray(images.timestamp_s) % 10.0))
    assert _rolling_period(rolling) == (10.0, 2)
    unrolled = np.asarray(_unrolled(rolling).images.timestamp_s)
    np.testing.assert_allclose(unrolled, np.asarray(images.timestamp_s))


def test_rays_that_hardly_part_do_not_say_how_large_things_are(loose: View) -> None:
    height_m = object_heights(loose)["traffic_light"]
    assert np.median(height_m) == pytest.approx(1.0, rel=0.3)
    assert len(height_m) >= 3


def test_three_lights_taken_for_large_are_no_other_unit() -> None:
    assert not are_outside(np.array([1.1, 2.2, 2.4]), 0.45, 2.0)
    assert are_outside(np.array([0.06, 0.07, 0.08]), 0.45, 2.0)
    assert are_outside(np.array([0.06, 0.07, 0.22]), 0.45, 2.0)
    assert are_outside(np.array([2.1, 2.2, 2.2, 2.3]), 0.45, 2.0)
    assert not are_outside(np.array([0.06, 0.07, 0.08]), 0.05, 2.0)


def test_truth_is_not_called_misplaced_where_poses_are_metres_off(loose: View) -> None:
    assert TruthElsewhere().find(loose) is None
    assert loose.dataset.truth is not None
    moved = loose.dataset.truth.replace(position_in_world_m=loose.dataset.truth.position_in_world_m + [2e4, 0.0, 0.0])
    assert TruthElsewhere().find(View(replace(loose.dataset, truth=moved))) is not None


def test_nothing_measured_is_given_up_where_another_reading_stands_the_cameras_up() -> None:
    given = simulate(replace(_LOOSE, passes_per_street=1), seed=300)
    spoiled = INJECTED["inverted_poses"].spoil(given)
    assert spoiled is not None
    finding = convention_told(spoiled)
    assert finding.fault == "inverted_poses"


def test_boxes_are_not_said_to_be_of_pictures_that_they_would_not_be_in(good: Dataset) -> None:
    assert not [how for how, _ in PictureSize().readings(good) if "boxes 2 " in how]
    halved = INJECTED["picture_size"].spoil(good)
    assert halved is not None
    assert [how for how, _ in PictureSize().readings(halved) if "boxes 2 " in how]


def test_a_focal_length_is_no_lens(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fisheye for a pinhole makes up for part of a focal length that is too long."""
    random = np.random.default_rng(0)

    def gains(_: View, version: Dataset) -> Floats:
        is_lens = version.cameras.model.names == ("OPENCV_FISHEYE",)
        is_shorter = version.cameras.params[0][0] < 0.95 * view.dataset.cameras.params[0][0]
        return np.full(200, 100.0 + 10.0 * is_lens + 20.0 * is_shorter) + random.normal(0.0, 0.3, 200)

    monkeypatch.setattr(distortion, "gains_of_all", gains)
    assert distortion.LensModel().find(view) is None


def test_a_wrong_camera_of_passes_with_few_stretches_is_named() -> None:
    spoiled = INJECTED["wrong_camera"].spoil(good_city(300))
    assert spoiled is not None
    assert cameras.WrongCamera().find(View(spoiled)) is not None


def test_images_with_the_camera_of_others_are_no_pictures_of_another_size(good: Dataset) -> None:
    wrong = INJECTED["wrong_camera"].spoil(good)
    assert wrong is not None
    view = View(wrong)
    camera = _FAULT["wrong_camera"].find(view)
    assert camera is not None
    assert camera.fix is not None
    scaled = replace(camera, fault="picture_size", fix=lambda dataset: dataset)
    assert contest.better_explained(view, camera, scaled) is camera
    assert contest.better_explained(view, replace(camera, fix=scaled.fix), replace(scaled, fix=camera.fix)) != camera
    assert contest.better_explained(view, None, scaled) is scaled


def test_an_axis_the_other_way_is_no_other_world_on_flat_ground(few: Dataset) -> None:
    center = camera_centers(few.images) * [1.0, 1.0, 0.0]
    flat = with_poses(few, level_rotations(headings(few)[0], few.frame), center)
    mirrored = INJECTED["mirrored_positions"].spoil(flat)
    assert mirrored is not None
    finding = hold_contest(View(mirrored), conventions("world_axes", "mirrored_positions")).finding
    assert finding is not None
    assert finding.fault == "mirrored_positions"


def test_headings_that_were_never_filled_are_in_no_unit(one: Dataset) -> None:
    constant = INJECTED["headings_constant"].spoil(one)
    assert constant is not None
    assert named(constant) == ["headings_constant"]
    lying = with_poses(constant, rotation_matrices(constant.images)[:, [1, 2, 0]], camera_centers(constant.images))
    assert _FAULT["headings_constant"].find(View(lying)) is None
    of_radians = with_poses(
        one,
        rotations_of(np.radians(headings(one)[0]), *headings(one)[1:], one.frame),
        camera_centers(one.images),
    )
    assert _FAULT["headings_constant"].find(View(of_radians)) is None


def test_images_of_one_time_have_no_speed(good: Dataset) -> None:
    images = good.images.replace(timestamp_s=np.floor(np.asarray(good.images.timestamp_s)))
    worst_seam(replace(good, images=images), camera_centers(images))
    drive = one_drive_in_two(good)
    time_s = np.asarray(drive.images.timestamp_s).copy()
    time_s[101] = time_s[100]
    center = camera_centers(drive.images)
    center[1700:] += [3.0, 2.0, 0.0]
    assert worst_seam(replace(drive, images=drive.images.replace(timestamp_s=time_s)), center) is not None


def test_every_fault_of_the_registry_is_injected() -> None:
    known = _CONVENTIONS | set(_FAULT)
    injected = set(INJECTED) | set(RIG_FAULTS)
    assert injected <= known
    assert known - injected == {"headings_useless"}
    assert len(known) == len(CONVENTIONS) + len(FAULTS)


@pytest.mark.parametrize("name", sorted(set(INJECTED) & _CONVENTIONS))
def test_a_wrong_convention_is_named_and_undone(name: str, request: pytest.FixtureRequest) -> None:
    good = request.getfixturevalue(enough_for(name))
    view = request.getfixturevalue({"good": "view", "few": "view_of_few", "one": "view_of_one"}[enough_for(name)])
    spoiled = INJECTED[name].spoil(good)
    assert spoiled is not None
    finding = convention_told(spoiled)
    assert finding.fault == name
    assert finding.chance is not None
    assert finding.chance < 1e-3
    assert finding.fix is not None
    if INJECTED[name].has_fix:
        sample = view.stretches
        fixed = measure_agreement(sample.of(finding.fix(spoiled)), sample.place_of_image, view.gate_px)
        assert fixed.gain.sum() > _RECOVERED.get(name, 0.95) * view.agreement.gain.sum()


@pytest.mark.parametrize("name", sorted(set(INJECTED) - _CONVENTIONS))
def test_a_fault_is_named(name: str, request: pytest.FixtureRequest) -> None:
    good = request.getfixturevalue(enough_for(name))
    spoiled = INJECTED[name].spoil(good)
    assert spoiled is not None
    finding = _FAULT[name].find(View(spoiled))
    assert finding is not None
    assert finding.fault == name
    assert (finding.fix is not None) == INJECTED[name].has_fix
    if finding.fix is not None and name not in _SEEN_AGAIN:
        assert _FAULT[name].find(View(finding.fix(spoiled))) is None


def test_good_data_raise_nothing(good: Dataset) -> None:
    outcome = examine(good)
    assert outcome.findings == ()
    assert outcome.notes == ()
    assert outcome.prospects["detections_that_meet_others"] > 0.8
    assert outcome.prospects["passes_per_place"]["median"] >= 2


def test_two_faults_are_both_named_and_undone(one: Dataset) -> None:
    twice = INJECTED["repeated_boxes"].spoil(one)
    assert twice is not None
    spoiled = INJECTED["inverted_poses"].spoil(twice)
    assert spoiled is not None
    outcome = examine(spoiled)
    assert [finding.fault for finding in outcome.findings] == ["repeated_boxes", "inverted_poses"]
    assert len(outcome.fixed.detections) == len(one.detections)
    np.testing.assert_allclose(camera_centers(outcome.fixed.images), camera_centers(one.images), atol=1e-6)


def test_rays_agree_far_better_than_by_chance(view: View) -> None:
    assert compare(view.agreement.gain, view.chance.gain).chance < 1e-6
    assert compare(view.chance.gain, view.agreement.gain).chance == 1.0


def test_agreement_does_not_depend_on_where_the_world_begins(good: Dataset, view: View) -> None:
    rotation = rotation_matrices(good.images)
    far = good.images.replace(cam_from_world_m=good.images.cam_from_world_m - rotation @ np.array([4e6, -5e6, 1e3]))
    sample = view.stretches
    moved = measure_agreement(sample.of(Dataset(**{**vars(good), "images": far})), sample.place_of_image, view.gate_px)
    np.testing.assert_allclose(moved.gain, view.agreement.gain, atol=1e-3)


def test_common_errors_are_estimated_in_size_and_direction(good: Dataset, view: View) -> None:
    pitch, focal = PARAMETERS[0], PARAMETERS[3]
    spoiled = focal.change(pitch.change(good, np.radians(1.5)), 0.08)
    before, after = (cameras.estimate_of(each, PARAMETERS) for each in (view, View(spoiled)))
    assert before is not None
    assert after is not None
    assert after.of("pitch")[0] - before.of("pitch")[0] == pytest.approx(-np.radians(1.5), rel=0.15)
    assert after.of("log_focal")[0] - before.of("log_focal")[0] == pytest.approx(-0.08, rel=0.2)


def test_angles_make_the_rotation_they_come_from(good: Dataset) -> None:
    rotation = rotations_of(*headings(good), good.frame)
    np.testing.assert_allclose(rotation, rotation_matrices(good.images), atol=1e-9)


def test_the_shift_between_point_sets_is_found_among_strangers() -> None:
    random = np.random.default_rng(0)
    points = random.uniform(0.0, 100.0, (40, 3))
    others = np.concatenate([points[:20] + [3.0, -2.0, 1.0], random.uniform(0.0, 100.0, (30, 3))])
    shift = find_shift(points, others, 0.5, within_m=None)
    assert shift is not None
    np.testing.assert_allclose(shift.offset_m, [3.0, -2.0, 1.0], atol=1e-6)
    assert shift.pairs >= 20


def one_drive_in_two(good: Dataset) -> Dataset:
    """Return drives of the city as one long one that is two passes: so long that a jump at the seam is no chance."""
    count = 3000
    way = np.linspace(0.0, 1.9 * np.pi, count)
    center = np.stack([475.0 * np.sin(way), 475.0 - 475.0 * np.cos(way), np.full(count, 1.5)], axis=1)
    rotation = level_rotations(np.pi / 2.0 - way, good.frame)
    number = np.arange(count)
    images = good.images.take(number % len(good.images)).replace(
        image_id=number,
        name=pa.array([f"{i:05d}.jpg" for i in number]),
        camera_id=np.zeros(count, dtype=np.int64),
        cam_from_world_quat=Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True),
        cam_from_world_m=-np.einsum("nij,nj->ni", rotation, center),
        pass_id=Categories.from_texts(["early" if i < 1700 else "late" for i in number]),
        timestamp_s=0.1 * number,
    )
    return Dataset(**{**vars(good), "images": images, "detections": good.detections.take(np.arange(0))})


@pytest.mark.parametrize(
    ("fault", "move"),
    [("pass_offset", [3.0, 2.0, 0.0]), ("camera_height", [0.0, 0.0, -1.8]), ("pass_time_shift", None)],
)
def test_a_pass_that_jumps_where_it_goes_on_from_another_is_named_and_put_back(
    fault: str, move: list[float] | None, good: Dataset
) -> None:
    drive = one_drive_in_two(good)
    assert worst_seam(drive, camera_centers(drive.images)) is None
    center, is_late = camera_centers(drive.images), drive.images.pass_id.codes == drive.images.pass_id.code_of("late")
    there = moved_along(drive, 4.0) if move is None else center + move
    spoiled = with_centers(drive, np.where(is_late[:, None], there, center))
    finding = _FAULT[fault].find(View(spoiled))
    assert finding is not None
    assert "By its times pass late goes on where early ends" in finding.why
    assert all(
        _FAULT[other].find(View(spoiled)) is None
        for other in ("pass_offset", "camera_height", "pass_time_shift")
        if other != fault
    )
    assert finding.fix is not None
    fixed = camera_centers(finding.fix(spoiled).images)
    assert np.linalg.norm(fixed - center, axis=1)[:-10].max() < 0.1


def test_drives_far_apart_that_follow_each_other_by_chance_have_no_seam(good: Dataset) -> None:
    drive = one_drive_in_two(good)
    is_late = drive.images.pass_id.codes == drive.images.pass_id.code_of("late")
    there = camera_centers(drive.images) + np.where(is_late[:, None], [60.0, 0.0, 0.0], 0.0)
    elsewhere = with_centers(drive, there)
    assert worst_seam(elsewhere, camera_centers(elsewhere.images)) is None


def test_a_dataset_without_detections_is_refused(good: Dataset) -> None:
    nothing = Dataset(**{**vars(good), "detections": good.detections.take(np.arange(0)), "truth_detections": None})
    with pytest.raises(InputError, match="no detections"):
        examine(nothing)


def test_the_command_says_what_is_wrong_and_writes_the_fixed_dataset(one: Dataset, tmp_path: Path) -> None:
    spoiled = INJECTED["boxes_normalised"].spoil(one)
    assert spoiled is not None
    write_dataset(spoiled, tmp_path / "given")
    run = CliRunner().invoke(app, ["check", str(tmp_path / "given"), "--fix", str(tmp_path / "fixed")])
    assert run.exit_code == 3
    assert "from 0 to 1" in run.stdout
    assert "What the data can give" in run.stdout
    fixed = read_dataset(tmp_path / "fixed")
    np.testing.assert_allclose(fixed.detections.center_px, one.detections.center_px, atol=1e-9)
    again = CliRunner().invoke(app, ["check", str(tmp_path / "fixed"), "--json"])
    assert again.exit_code == 0
    assert json.loads(again.stdout)["findings"] == []


def test_the_command_reads_boxes_that_others_refuse_and_spares_what_is_given(good: Dataset, tmp_path: Path) -> None:
    write_dataset(good, tmp_path / "given")
    corners = INJECTED["boxes_as_corners"].spoil(good)
    assert corners is not None
    from valuemap.tables import write_table

    outside = corners.detections.replace(center_px=3.0 * corners.detections.center_px)
    write_table(outside, tmp_path / "given" / "detections.parquet")
    with pytest.raises(InputError):
        read_dataset(tmp_path / "given")
    assert len(read_dataset(tmp_path / "given", are_boxes_checked=False).detections) == len(good.detections)
    run = CliRunner().invoke(app, ["check", str(tmp_path / "given"), "--fix", str(tmp_path / "given")])
    assert run.exit_code != 0
    assert (tmp_path / "given" / "detections.parquet").is_file()


@pytest.mark.parametrize(("rise", "is_named"), [(0.2, False), (1.0, True)])
def test_a_lens_is_named_only_where_it_changes_a_map(
    view: View, rise: float, is_named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many places a rise is sure however small: errors of poses are fewer pixels where pictures are narrower."""
    random = np.random.default_rng(0)

    def gains(_: View, version: Dataset) -> Floats:
        is_lens = version.cameras.model.names != view.dataset.cameras.model.names
        return 100.0 + (rise if is_lens else 0.0) + random.normal(0.0, 0.3, 200)

    monkeypatch.setattr(distortion, "gains_of_all", gains)
    found = distortion.LensModel().find(view)
    assert (found is not None) == is_named


# ------------------------------------------------------------------------------- mistakes of other sizes and parts


def conventions(*names: str) -> list[Convention]:
    """Return some conventions, in the order of the registry."""
    return [each for each in CONVENTIONS if each.name in names]


def convention_told(dataset: Dataset) -> Finding:
    """Return what is said of the conventions of a dataset, of which something must be."""
    finding = hold_contest(View(dataset), CONVENTIONS).finding
    assert finding is not None
    return finding


def named(dataset: Dataset) -> list[str]:
    return [finding.fault for finding in examine(dataset).findings]


def told_of_convention(name: str, dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str | None]]:
    """Return what a check says, and of what alone, if it looks for one convention and nothing else."""
    monkeypatch.setattr(sys.modules["valuemap.check.examine"], "STAGES", ("conventions",))
    monkeypatch.setattr(sys.modules["valuemap.check.examine"], "CONVENTIONS", conventions(name))
    return [(finding.fault, finding.of) for finding in examine(dataset).findings]


def told_of_camera(dataset: Dataset, camera_id: int) -> Finding:
    """Return the small error that is found in a dataset, which must be one of a camera alone."""
    (finding,) = _look(View(dataset), "fine", silent)
    assert finding.of == f"camera {camera_id}"
    return finding


def degrees_off(dataset: Dataset, right: Dataset) -> Floats:
    """Return by how many degrees each image (N) is turned against another version of the dataset."""
    off = rotation_matrices(dataset.images) @ rotation_matrices(right.images).transpose(0, 2, 1)
    return np.asarray(np.degrees(Rotation.from_matrix(off).magnitude()))


def turned_by(dataset: Dataset, axis: str, degrees: float) -> Dataset:
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return with_poses(dataset, turn @ rotation_matrices(dataset.images), camera_centers(dataset.images))


def test_parameters_in_shares_of_the_picture_are_named_and_undone(one: Dataset) -> None:
    """As pixels they make a radian a pixel, and other readings of them millions."""
    size = np.stack([one.cameras.width_px, one.cameras.height_px], axis=1)
    params = [each / np.tile(extent, 2) for each, extent in zip(one.cameras.params, size, strict=True)]
    outcome = examine(replace(one, cameras=one.cameras.replace(params=params)))
    assert [finding.fault for finding in outcome.findings] == ["focal_unit"]
    for fixed, right in zip(outcome.fixed.cameras.params, one.cameras.params, strict=True):
        np.testing.assert_allclose(fixed, right)


def test_boxes_far_outside_of_their_pictures_are_not_called_corners() -> None:
    keeping = _Ends(np.linspace(0.6, 2.0, 200))
    assert _chance_of_gap(_Ends(np.linspace(-0.4, 2.0, 200)), keeping) < LEAST_CHANCE
    assert _chance_of_gap(_Ends(np.linspace(-8.0, 2.0, 200)), keeping) == 1.0


@pytest.mark.parametrize("is_squeezed", [True, False])
def test_boxes_of_the_square_that_a_detector_saw_are_named_and_undone(is_squeezed: bool, one: Dataset) -> None:
    extent = picture_sizes(one)
    shown = extent if is_squeezed else np.repeat(extent.max(axis=1, keepdims=True), 2, axis=1)
    center = (one.detections.center_px + (shown - extent) / 2.0) * 416.0 / shown
    spoiled = with_detections(one, center_px=center, size_px=one.detections.size_px * 416.0 / shown)
    finding = convention_told(spoiled)
    assert finding.fault == "picture_size"
    assert finding.fix is not None
    np.testing.assert_allclose(finding.fix(spoiled).detections.center_px, one.detections.center_px)


def test_headings_that_follow_the_drive_are_in_no_other_unit(one: Dataset, one_rig: Dataset) -> None:
    unit = frames.DegreesForRadians()
    for given in (one, one_rig):
        assert list(unit.readings(given)) == []
        azimuth, pitch, roll = headings(given)
        for factor in (np.radians(1.0), np.degrees(1.0)):
            rotation = rotations_of(factor * azimuth, pitch, roll, given.frame)
            assert len(list(unit.readings(with_poses(given, rotation, camera_centers(given.images))))) == 8
    straight = street(one, 0, 40)
    assert len(list(unit.readings(straight))) == 8  # It has no turns to follow.


def test_headings_alone_in_the_wrong_unit_are_told_from_all_angles(one: Dataset) -> None:
    azimuth, pitch, roll = headings(one)
    rotation = rotations_of(np.radians(azimuth), pitch, roll, one.frame)
    spoiled = with_poses(one, rotation, camera_centers(one.images))
    finding = convention_told(spoiled)
    assert finding.figures["reading"] == "headings in radians clockwise from north read as degrees"


def test_cameras_on_their_side_and_pictures_turned_by_a_quarter_are_undone(one: Dataset) -> None:
    finding = convention_told(turned_by(one, "z", 90.0))
    assert finding.fault == "camera_axes"
    extent, center = picture_sizes(one), one.detections.center_px
    turned = np.stack([extent[:, 1] - center[:, 1], center[:, 0]], axis=1)
    spoiled = with_detections(one, center_px=turned, size_px=one.detections.size_px[:, ::-1].copy())
    finding = convention_told(spoiled)
    assert finding.figures["reading"] == "turned a quarter to the right"
    assert finding.fix is not None
    np.testing.assert_allclose(finding.fix(spoiled).detections.center_px, center)


def test_positions_with_y_up_are_turned_and_the_sky_stays(one: Dataset) -> None:
    y_up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    spoiled = with_centers(one, camera_centers(one.images) @ y_up.T)
    finding = convention_told(spoiled)
    assert finding.fault == "world_axes"
    assert finding.fix is not None
    fixed = finding.fix(spoiled)
    assert fixed.frame == one.frame
    np.testing.assert_allclose(camera_centers(fixed.images), camera_centers(one.images), atol=1e-6)


@pytest.fixture(scope="module")
def upside_down(few: Dataset) -> View:
    """One camera of two is upside down."""
    return View(of_camera(few, turned_by(few, "z", 180.0), 1))


@pytest.fixture(scope="module")
def odd(upside_down: View) -> Finding:
    """What is said of it."""
    finding = contest.find_odd_group(upside_down, CONVENTIONS)
    assert finding is not None
    return finding


def test_one_camera_upside_down_is_named_and_undone(
    few: Dataset, upside_down: View, odd: Finding, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (odd.fault, odd.of) == ("camera_axes", "camera 1")
    assert odd.what.startswith("Only camera 1: ")
    assert odd.fix is not None
    fixed = odd.fix(upside_down.dataset).images
    np.testing.assert_allclose(rotation_matrices(fixed), rotation_matrices(few.images), atol=1e-9)
    assert told_of_convention("camera_axes", upside_down.dataset, monkeypatch) == [("camera_axes", "camera 1")]
    monkeypatch.setattr(contest, "FAR_WORSE", 0.0)
    assert contest.find_odd_group(upside_down, CONVENTIONS) is None


def test_rays_of_a_camera_that_agree_by_chance_alone_do_not_hide_what_is_wrong_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """More than half of how well they agree is chance here: they agree more than half as well as those of the other."""
    city = good_city(4, passes_per_street=4)
    other_order = INJECTED["quaternion_order"].spoil(city)
    assert other_order is not None
    spoiled = View(of_camera(city, other_order, 1))
    found = contest.find_odd_group(spoiled, conventions("quaternion_order"))
    assert found is not None
    assert (found.fault, found.of) == ("quaternion_order", "camera 1")

    def with_chance(view: View) -> float:
        return float(view.agreement.gain.sum()) / view.agreement.detections

    monkeypatch.setattr(contest, "_worth_of", with_chance)
    assert contest.find_odd_group(spoiled, conventions("quaternion_order")) is None


def test_what_leaves_rays_of_a_group_in_disagreement_is_not_what_is_wrong_with_it(
    upside_down: View, odd: Finding, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = contest.Verdict(replace(odd, chance=1e-9, fix=lambda dataset: dataset), 1.0)
    monkeypatch.setattr(contest, "hold_contest", lambda *_: nothing)
    assert contest.find_odd_group(upside_down, CONVENTIONS) is None


def test_one_camera_has_no_world_of_its_own(few: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    about_up = Rotation.from_rotvec(np.pi / 2.0 * np.asarray(few.frame.up)).as_matrix()
    turned = with_poses(few, rotation_matrices(few.images) @ about_up, camera_centers(few.images))
    spoiled, world_axes = View(of_camera(few, turned, 1)), conventions("world_axes")
    finding = contest.find_odd_group(spoiled, world_axes)
    assert finding is not None
    assert finding.of == "pass pass-0001"  # The only one that has that camera.
    monkeypatch.setattr(WorldAxes, "is_of_world", False)
    finding = contest.find_odd_group(spoiled, world_axes)
    assert finding is not None
    assert finding.of == "camera 1"


def one_camera_in_another_order(dataset: Dataset, camera_id: int) -> View:
    """Return a dataset one camera of which has quaternions x, y, z, w."""
    quaternion, mine = dataset.images.cam_from_world_quat, dataset.images.camera_id == camera_id
    reordered = np.where(mine[:, None], quaternion[:, [1, 2, 3, 0]], quaternion)
    return View(with_images(dataset, cam_from_world_quat=reordered))


def test_a_main_camera_that_still_agrees_as_well_as_those_at_the_sides_is_looked_at(one_rig: Dataset) -> None:
    """Those see little of what lights the way: half of what their rays agree by is little."""
    spoiled = one_camera_in_another_order(one_rig, 1)
    order = conventions("quaternion_order")
    verdict = hold_contest(spoiled, order)
    assert verdict.suspects == (Group(camera_id=1),)
    assert hold_contest(View(one_rig), order).suspects == ()
    assert contest.find_odd_group(spoiled, order) is None
    found = contest.find_odd_group(spoiled, order, suspects=verdict.suspects)
    assert found is not None
    assert (found.fault, found.of) == ("quaternion_order", "camera 1")


def test_of_a_camera_that_sees_little_the_rays_of_the_others_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    given = rig(0, passes_per_street=1)
    spoiled, order = one_camera_in_another_order(given, 2), conventions("quaternion_order")
    suspects = hold_contest(spoiled, order).suspects
    found = contest.find_odd_group(spoiled, order, suspects=suspects)
    assert found is not None
    assert (found.fault, found.of) == ("quaternion_order", "camera 2")
    assert found.fix is not None
    fixed = found.fix(spoiled.dataset).images
    np.testing.assert_allclose(rotation_matrices(fixed), rotation_matrices(given.images), atol=1e-9)
    monkeypatch.setattr(contest._AmongOthers, "readings", lambda *_: iter(()))
    assert contest.find_odd_group(spoiled, order, suspects=suspects) is None


def test_boxes_that_keep_to_a_part_of_the_picture_of_one_camera_are_of_smaller_pictures_there(
    one_rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    detections = one_rig.detections
    smaller = with_detections(one_rig, center_px=detections.center_px / 2.0, size_px=detections.size_px / 2.0)
    spoiled = of_camera(one_rig, smaller, 1)
    finding = hold_contest(View(spoiled), conventions("picture_size")).finding
    assert finding is not None
    assert (finding.of, finding.what[:14]) == ("camera 1", "Only camera 1:")
    assert finding.fix is not None
    np.testing.assert_allclose(finding.fix(spoiled).detections.center_px, detections.center_px, rtol=0.02)
    monkeypatch.setattr(boxes, "groups_of", lambda _: ())
    assert hold_contest(View(spoiled), conventions("picture_size")).finding is None


@pytest.fixture(scope="module")
def good_rig() -> Dataset:
    return rig(11)


@pytest.fixture(scope="module")
def one_rig() -> Dataset:
    """Each street is driven once: enough for what shows at once."""
    return rig(14, passes_per_street=1)


def test_a_good_rig_raises_nothing(one_rig: Dataset) -> None:
    assert examine(one_rig).findings == ()


@pytest.mark.parametrize("pair", [(0, 1), (0, 2)])
def test_exchanged_cameras_are_named_and_put_back(pair: tuple[int, int], one_rig: Dataset) -> None:
    spoiled = exchanged(one_rig, *pair)
    finding = convention_told(spoiled)
    assert finding.fault == "cameras_exchanged"
    assert finding.figures["reading"] == f"poses of cameras {pair[0]} and {pair[1]} exchanged"
    assert finding.fix is not None
    fixed = finding.fix(spoiled).images
    np.testing.assert_allclose(rotation_matrices(fixed), rotation_matrices(one_rig.images), atol=1e-9)


def test_inverted_mounts_are_named_and_the_cameras_turned(one_rig: Dataset) -> None:
    spoiled = RIG_FAULTS["inverted_mounts"].spoil(one_rig)
    assert spoiled is not None
    finding = hold_contest(View(spoiled), conventions("inverted_poses", "camera_axes", "inverted_mounts")).finding
    assert finding is not None
    assert finding.fault == "inverted_mounts"
    assert finding.fix is not None
    assert degrees_off(finding.fix(spoiled), one_rig).max() < 3.0


def test_mounts_that_are_what_they_are_inverted_are_not_tried(one: Dataset, one_rig: Dataset) -> None:
    """Cameras that look ahead, on a vehicle with their axes, are not turned by the way back, and one alone has axes."""
    assert list(mounts.InvertedMounts().readings(one)) == []
    tried = [how for how, _ in mounts.InvertedMounts().readings(one_rig)]
    assert len(tried) == 3
    azimuth, _ = driving_azimuths(one_rig)
    level = with_poses(one_rig, level_rotations(azimuth, one_rig.frame), camera_centers(one_rig.images))
    ahead = [how for how, _ in mounts.InvertedMounts().readings(level)]
    assert ahead == [how for how in tried if "looks ahead" not in how]


def test_each_camera_of_a_car_goes_its_own_way(good_rig: Dataset) -> None:
    """One hangs two metres to the left of the others, from which no way was driven."""
    center = camera_centers(good_rig.images)
    aside = np.where((good_rig.images.camera_id == 0)[:, None], [2.0, 0.0, 0.0], 0.0)
    moved = with_centers(good_rig, center + aside)
    np.testing.assert_allclose(moved_along(moved, 0.0), center + aside, atol=1e-9)
    np.testing.assert_allclose(moved_along(moved, 1.5), moved_along(good_rig, 1.5) + aside, atol=1e-9)
    azimuth, moves = driving_azimuths(moved)
    right, _ = driving_azimuths(good_rig)
    np.testing.assert_allclose(azimuth[moves], right[moves], atol=1e-9)


def test_cameras_that_expose_a_little_later_are_one_rig(good_rig: Dataset) -> None:
    """And those of another rhythm than half a step are none."""
    time, camera = np.asarray(good_rig.images.timestamp_s), good_rig.images.camera_id
    late = with_images(good_rig, timestamp_s=time + 0.01 * camera)
    first, second = mounts._together(late.images, 0, 1)
    assert len(first) == (camera == 0).sum()
    np.testing.assert_allclose(time[first], time[second])
    no_rig = with_images(good_rig, timestamp_s=time + 1e4 * camera)
    assert len(mounts._together(no_rig.images, 0, 1)[0]) == 0
    assert list(mounts.CamerasExchanged().readings(with_images(good_rig, timestamp_s=None))) == []


def test_what_one_camera_sees_in_its_right_size_is_no_other_unit(
    good_rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of three cameras are exchanged: their rays meet where things are three times as large."""
    spoiled = View(replace(exchanged(good_rig, 0, 1), truth=None, truth_detections=None))
    assert _FAULT["scale"].find(spoiled) is None
    small = View(replace(with_centers(good_rig, 0.07 * camera_centers(good_rig.images)), truth=None))
    assert _FAULT["scale"].find(small) is not None
    monkeypatch.setattr("valuemap.check.frames.do_groups_agree", lambda *_: True)
    assert _FAULT["scale"].find(spoiled) is not None


def test_a_camera_that_sees_little_is_turned_by_what_the_others_see(
    one_rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoiled = of_camera(one_rig, turned_by(one_rig, "y", 4.0), 2)
    finding = told_of_camera(spoiled, 2)
    assert finding.fault == "camera_yaw"
    assert finding.fix is not None
    assert degrees_off(finding.fix(spoiled), one_rig).max() < 0.5
    monkeypatch.setattr(cameras, "_estimates_by_others", lambda *_: [])
    assert cameras._find_of_one_group(View(spoiled)) is None


def test_a_turn_by_gates_is_told_where_hardly_a_ray_is_right(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the gate at which good rays meet, the estimate stays where chance votes pull."""
    given = rig(1, passes_per_street=1)
    spoiled = of_camera(given, turned_by(given, "y", 3.0), 2)
    found = cameras._find_of_one_group(View(spoiled))
    assert found is not None
    assert found.group == Group(camera_id=2)
    assert found.parameter.name == "yaw"
    assert degrees_off(found(spoiled), given).max() < 0.3
    monkeypatch.setattr(cameras, "_at_wider_gate", lambda view: view)
    assert cameras._find_of_one_group(View(spoiled)) is None


@pytest.fixture(scope="module")
def city() -> Dataset:
    """One pass of three has a camera of its own."""
    return good_city(2, passes_per_street=3)


@pytest.fixture(scope="module")
def tilted(city: Dataset) -> View:
    """That camera looks 3 degrees too low."""
    return View(of_camera(city, turned_by(city, "x", 3.0), 1))


def test_a_camera_that_looks_too_low_is_named_and_the_others_stay(city: Dataset, tilted: View) -> None:
    finding = cameras.CameraTilt().find(tilted)
    assert finding is not None
    assert finding.of == "camera 1"
    assert finding.fix is not None
    off, other = degrees_off(finding.fix(tilted.dataset), city), city.images.camera_id == 0
    assert off[other].max() < 1e-6
    assert off[~other].max() < 0.5


def test_a_camera_that_no_other_pass_has_is_told_from_the_height_of_its_pass(
    city: Dataset, tilted: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it sees is as much lower where it looks higher than its poses say, as far away as most of it is."""
    low = View(of_camera(city, lowered(city), 1))
    assert [(found.fault, found.of) for found in _look(tilted, "fine", silent)] == [("camera_tilt", "camera 1")]
    assert [(found.fault, found.of) for found in _look(low, "fine", silent)] == [("camera_height", None)]
    monkeypatch.setattr(cameras.CameraHeight, "rivals", frozenset())
    assert [found.fault for found in _look(tilted, "fine", silent)] == ["camera_height"]


@pytest.mark.parametrize(("fault", "is_along"), [(passes.PassOffset, False), (passes.PassTimeShift, True)])
def test_a_camera_that_no_other_pass_has_is_told_from_any_shift_of_its_pass(
    fault: type[Fault], is_along: bool, tilted: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    shift = passes.worst_pass(tilted)
    assert shift is not None
    aside = replace(shift, offset_m=np.array([1.0, 0.0, 0.0]), is_along=is_along)
    monkeypatch.setattr(passes, "worst_pass", lambda _: aside)
    assert [found.fault for found in _look(tilted, "fine", silent)] == ["camera_tilt"]
    monkeypatch.setattr(fault, "rivals", frozenset())
    assert [found.fault for found in _look(tilted, "fine", silent)] == [fault.name]


def test_a_camera_that_is_too_low_is_named_and_the_others_stay(one_rig: Dataset) -> None:
    spoiled = of_camera(one_rig, lowered(one_rig), 1)
    finding = told_of_camera(spoiled, 1)
    assert finding.fault == "camera_height"
    assert finding.fix is not None
    center, right = camera_centers(finding.fix(spoiled).images), camera_centers(one_rig.images)
    np.testing.assert_allclose(center, right, atol=0.15)
    others = one_rig.images.camera_id != 1
    np.testing.assert_allclose(center[others], right[others], atol=1e-9)


@pytest.mark.parametrize("camera_id", [0, 1, 2])
def test_half_sizes_of_one_camera_are_named_and_the_others_stay(camera_id: int, good_rig: Dataset) -> None:
    half = with_detections(good_rig, size_px=good_rig.detections.size_px / 2.0)
    spoiled = of_camera(good_rig, half, camera_id)
    finding = _FAULT["boxes_half_size"].find(View(spoiled))
    assert finding is not None
    assert finding.of == f"camera {camera_id}"
    assert finding.fix is not None
    fixed = finding.fix(spoiled)
    np.testing.assert_allclose(fixed.detections.size_px, good_rig.detections.size_px)


def test_half_sizes_of_a_camera_that_sees_little_are_told_by_what_others_see_as_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Four objects, far more than twice as high as each other: each is compared with itself."""
    given = rig(2, passes_per_street=1)
    half = with_detections(given, size_px=given.detections.size_px / 2.0)
    found = sizes.half_sized_group(View(of_camera(given, half, 2)))
    assert found is not None
    assert found[0].camera_id == 2
    assert sizes.half_sized_group(View(given)) is None
    monkeypatch.setattr(sizes._Heights, "pairs", lambda *_: {})
    assert sizes.half_sized_group(View(of_camera(given, half, 2))) is None


@pytest.mark.parametrize("factor", [0.9, 0.6])
def test_pictures_of_any_size_are_named_and_undone(factor: float, one: Dataset) -> None:
    detections = one.detections
    spoiled = with_detections(one, center_px=factor * detections.center_px, size_px=factor * detections.size_px)
    finding = convention_told(spoiled)
    assert finding.fault == "picture_size"
    assert finding.fix is not None
    np.testing.assert_allclose(finding.fix(spoiled).detections.center_px, detections.center_px, rtol=0.02)


def test_panoramas_in_which_things_are_all_round_are_not_of_larger_pictures(good: Dataset) -> None:
    """Bend: narrower panoramas make rays more alike, and so agree better; but nothing would be seen to one side."""
    cameras_ = good.cameras
    params = [
        np.array([width, height], dtype=np.float64)
        for width, height in zip(cameras_.width_px, cameras_.height_px, strict=True)
    ]
    all_round = cameras_.replace(model=Categories.from_texts(["EQUIRECTANGULAR"] * len(cameras_)), params=params)
    assert [how for how, _ in PictureSize().readings(good) if "9/10" in how]
    assert not [how for how, _ in PictureSize().readings(replace(good, cameras=all_round)) if "9/10" in how]


def test_a_pass_a_third_of_a_second_off_is_named() -> None:
    given = good_city(11)
    is_late = given.images.pass_id.codes == given.images.pass_id.code_of("pass-0003")
    late = np.where(is_late[:, None], moved_along(given, 2.4), camera_centers(given.images))
    assert _FAULT["pass_time_shift"].find(View(with_centers(given, late))) is not None


@pytest.mark.parametrize("is_squeezed", [True, False])
def test_the_gate_is_one_angle_whatever_square_boxes_were_measured_in(is_squeezed: bool, good: Dataset) -> None:
    width, height = picture_sizes(good)[0]
    pixel = np.sqrt(width * height) if is_squeezed else max(width, height)
    assert _OfSquare(good, 416, is_squeezed=is_squeezed).gate_factor == pytest.approx(pixel / 416.0)


def test_a_mistake_of_all_is_not_told_of_one(few: Dataset) -> None:
    finding = cameras.CameraTilt().find(View(turned_by(few, "x", 3.0)))
    assert finding is not None
    assert finding.of is None


def test_distortion_that_no_camera_knows_is_named(good: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    params = np.stack(good.cameras.params)[good.images.camera_id[rows_in_images(good)]]
    ray = (good.detections.center_px - params[:, 2:]) / params[:, :2]
    bent = ray * (1.0 - 0.2 * (ray**2).sum(axis=1, keepdims=True))
    spoiled = View(with_detections(good, center_px=bent * params[:, :2] + params[:, 2:]))
    found = distortion.LensModel().find(spoiled)
    assert found is not None
    assert found.fix is not None
    k1 = [float(each[4]) for each in found.fix(spoiled.dataset).cameras.params]
    assert k1 == pytest.approx([-0.2, -0.2], abs=0.05)
    monkeypatch.setattr(distortion.LensModel, "_measured", lambda *_: None)
    assert distortion.LensModel().find(spoiled) is None


def test_an_image_a_jump_away_from_its_drive_is_named(one: Dataset) -> None:
    center = camera_centers(one.images)
    row = driving_order(one.images)[400]
    center[row] += [0.0, 2000.0, 0.0]
    outcome = examine(with_centers(one, center))
    assert [finding.fault for finding in outcome.findings] == ["far_images"]
    assert set(one.images.image_id) - set(outcome.fixed.images.image_id) == {one.images.image_id[row]}
    assert not strays(one.images).any()


def test_what_a_camera_does_not_see_says_nothing_of_it() -> None:
    """Twelve places of fifty agree better; the others differ by rounding."""
    better = np.full(50, 60.0)
    worse = better + 1e-9 * np.where(np.arange(50) % 2, -1.0, 1.0)
    worse[:12] -= np.linspace(0.2, 9.0, 12)
    assert compare(better, worse) == compare(better[:12], worse[:12])


def pass_of_each(drive: Dataset, number: NDArray[np.integer]) -> Dataset:
    """Return a drive whose images, in the order of their times, have passes of these numbers."""
    names = np.empty(len(number), dtype=object)
    names[np.argsort(np.asarray(drive.images.timestamp_s))] = [f"pass {each}" for each in number]
    return with_images(drive, pass_id=Categories.from_texts(names.tolist()))


def test_images_that_only_a_wrong_reading_puts_far_away_stay(one: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in KITTI-TS, where bursts of images jump if their poses are inverted."""
    center = camera_centers(one.images)
    monkeypatch.setattr(
        "valuemap.check.quality.strays",
        lambda images: np.arange(len(images)) < 5 * (not np.allclose(camera_centers(images), center)),
    )
    spoiled = INJECTED["inverted_poses"].spoil(one)
    assert spoiled is not None
    assert named(spoiled) == ["inverted_poses"]


def test_a_few_images_dealt_out_of_many_take_turns_and_pieces_that_overlap_do_not(good: Dataset) -> None:
    drive = keep_rows(good, images=good.images.pass_id.codes == 0)
    count = np.arange(len(drive.images))
    few = _passes_in_turn(pass_of_each(drive, (np.random.default_rng(1).random(len(count)) < 0.05).astype(int)).images)
    assert few is not None
    assert set(few[0].values()) == {"pass 0"}
    overlap = (count % 100 < 6) & (count % 2 == 0) & (count > 100)
    assert _passes_in_turn(pass_of_each(drive, count // 100 - overlap).images) is None


def test_drives_that_follow_each_other_are_not_joined_with_their_batches(good: Dataset) -> None:
    drives = keep_rows(good, images=good.images.pass_id.codes < 2)
    batch = np.random.default_rng(1).integers(0, 2, len(drives.images))
    dealt = [f"{drive} {number}" for drive, number in zip(drives.images.pass_id.codes, batch, strict=True)]
    found = _passes_in_turn(drives.images.replace(pass_id=Categories.from_texts(dealt)))
    assert found is not None
    assert len(found[0]) == 4
    assert len(set(found[0].values())) == 2


def test_passes_that_take_turns_along_one_drive_are_joined(good: Dataset) -> None:
    drive = keep_rows(good, images=good.images.pass_id.codes == 0)
    assert _passes_in_turn(drive.images) is None
    assert _passes_in_turn(good.images) is None
    dealt = [f"batch {number}" for number in np.random.default_rng(1).integers(0, 3, len(drive.images))]
    outcome = examine(with_images(drive, pass_id=Categories.from_texts(dealt)))
    assert [finding.fault for finding in outcome.findings] == ["passes_no_drives"]
    assert len(set(outcome.fixed.images.pass_id.texts())) == 1


def test_rotation_sigmas_that_rays_give_the_lie_to_are_degrees(good: Dataset) -> None:
    sigma = np.full(len(good.images), 0.2)
    spoiled = with_images(good, rotation_sigma_rad=sigma)
    assert _FAULT["rotation_sigma_in_degrees"].find(View(spoiled)) is not None
    assert _FAULT["rotation_sigma_in_degrees"].find(View(spoiled, gate_share=4.0)) is None


def test_a_plural_is_another_spelling(one: Dataset) -> None:
    names = [f"{name}s" if row % 4 == 0 else name for row, name in enumerate(one.detections.class_name.texts())]
    spoiled = with_detections(one, class_name=Categories.from_texts(names))
    (finding,) = _look(View(spoiled), "tables", silent)
    assert finding.fault == "class_spelling"
    assert finding.fix is not None
    assert finding.fix(spoiled).detections.class_name.texts() == one.detections.class_name.texts()


@pytest.mark.parametrize("factor", [0.3048, 1.0 / 0.3048])
def test_truth_tells_feet_from_metres(factor: float, few: Dataset) -> None:
    spoiled = with_centers(few, factor * camera_centers(few.images))
    finding = _FAULT["scale"].find(View(spoiled))
    assert finding is not None
    assert finding.fix is not None
    fixed = finding.fix(spoiled)
    np.testing.assert_allclose(camera_centers(fixed.images), camera_centers(few.images), atol=1e-6)


def test_truth_tells_metres_of_web_mercator(few: Dataset) -> None:
    """At the latitude of London they are 62 cm; and near the equator they are metres."""
    assert few.frame.anchor is not None
    spoiled = with_centers(few, camera_centers(few.images) / np.cos(np.radians(few.frame.anchor[0])))
    finding = _FAULT["scale"].find(View(spoiled))
    assert finding is not None
    assert "Web Mercator" in finding.why
    assert finding.fix is not None
    np.testing.assert_allclose(camera_centers(finding.fix(spoiled).images), camera_centers(few.images), atol=1e-6)
    assert _FAULT["scale"].find(View(few)) is None
    assert frames._units_m(Frame(anchor=(5.0, 0.0, 0.0))) == frames._units_m(Frame(up=(0.0, 0.0, 1.0)))


def test_feet_are_not_taken_for_half_sizes(one: Dataset) -> None:
    spoiled = with_centers(replace(one, truth=None, truth_detections=None), 0.3048 * camera_centers(one.images))
    assert [found.fault for found in _look(View(spoiled), "results", silent)] == ["scale"]


@pytest.mark.parametrize(("fault", "offset_m"), [("pass_offset", [0.8, 0.6, 0.0]), ("camera_height", [0.0, 0.0, 1.0])])
def test_a_metre_between_passes_is_named(fault: str, offset_m: list[float], few: Dataset) -> None:
    """Less than the way from image to image."""
    moved = few.images.pass_id.codes == 1
    spoiled = with_centers(few, camera_centers(few.images) + np.where(moved[:, None], offset_m, 0.0))
    assert [found.fault for found in _look(View(spoiled), "fine", silent)] == [fault]
