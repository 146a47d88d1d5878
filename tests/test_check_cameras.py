"""Small errors of cameras, of all or of one of several: found, told from others of their like, and put right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from check_faults import FAULTS as INJECTED
from check_faults import exchanged, good_city, lowered, of_camera
from check_faults import good_rig as rig
from checking import FAULT_NAMED, LOOSE, degrees_off, one_pass, turned_by
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import (
    cameras,
    corrections,
    distortion,
    examine,
    fit,
    mounts,
    parameters,
    pass_offsets,
    pass_shifts,
    sizes,
)
from valuemap.check.agreement import compare, measure_agreement
from valuemap.check.along_drives import moved_along
from valuemap.check.boxes import rows_in_images
from valuemap.check.corrections import follow, is_wider_gate_only
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import (
    Fault,
    Finding,
    View,
    gains_of_all,
    with_centers,
    with_detections,
    with_images,
    with_poses,
)
from valuemap.check.fit import Changed, Parameter, ParameterEstimate, apply
from valuemap.check.groups import Group
from valuemap.check.headings import driving_azimuths, headings
from valuemap.check.loose import Correction, Loose
from valuemap.check.parameters import PARAMETERS, with_focal
from valuemap.check.quality import TruthElsewhere
from valuemap.check.sizes import object_heights
from valuemap.check.wrong_camera import WrongCamera
from valuemap.dataset import Dataset
from valuemap.progress import silent
from valuemap.simulate import simulate

_ESTIMATE = ParameterEstimate(("along",), np.array([0.5]), np.array([[1e-6]]), 40, 400)


def test_the_gate_is_one_angle_whatever_the_focal_length(good: Dataset, view: View) -> None:
    """Pictures said to be wider make errors of poses fewer pixels, which is no agreement."""
    noisy = camera_centers(good.images) + np.random.default_rng(3).normal(0.0, 1.0, (len(good.images), 3))
    coarse = View(with_centers(good, noisy))
    wide = with_focal(coarse.dataset, -2.0)
    sample = coarse.many_places
    in_pixels = measure_agreement(sample.of(wide), sample.place_of_image, coarse.gate_px).gain.sum()
    assert gains_of_all(coarse, wide, is_gate_an_angle=True).sum() < 0.5 * in_pixels
    assert is_wider_gate_only(coarse, wide)
    assert not is_wider_gate_only(coarse, with_focal(coarse.dataset, 0.0))


def test_a_focal_length_that_is_followed_to_a_wider_gate_only_is_not_named(
    one: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = with_focal(one, 0.1)
    named = corrections.find_correction(View(wrong))
    assert named is not None
    assert named.parameter.name == "log_focal"
    monkeypatch.setattr("valuemap.check.corrections.follow", lambda _view, best: replace(best, value=-2.0))
    assert corrections.find_correction(View(wrong)) is None


def test_a_shift_in_time_is_followed_where_least_squares_stay_behind(good: Dataset, view: View) -> None:
    shifted = View(with_centers(good, moved_along(good, 5.0)))
    parameter = next(each for each in PARAMETERS if each.name == "along")
    given = gains_of_all(shifted, shifted.dataset)
    start = Correction(parameter, -1.0, 0.05, 1e-9, compare(given, given), _ESTIMATE)
    found = follow(shifted, start)
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
        return np.full(40, np.log(abs(tried[-1])) * np.sign(tried[-1])) + np.linspace(0.0, 0.1, 40)

    monkeypatch.setattr("valuemap.check.corrections.gains_of_all", gains)
    monkeypatch.setattr("valuemap.check.fault.gains_of_all", gains)
    given = np.zeros(40)
    start = Correction(Parameter("along", change), 1.0, 1e-12, 1e-9, compare(given, given), _ESTIMATE)
    found = follow(View(good), start)
    assert 64.0 <= found.value <= 128.0
    assert len(tried) <= 1 + 6 + 12 + 1  # And the opposite.


def test_what_the_opposite_gives_as_well_is_no_correction(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses that are moved along a drive either way are smoother than measured ones, so rays agree the better."""
    random = np.random.default_rng(0)

    def gains(_view: View, version: Dataset, **_: bool) -> Floats:
        return np.full(40, 100.0 if version is view.dataset else 110.0) + random.normal(0.0, 1.0, 40)

    monkeypatch.setattr("valuemap.check.corrections.gains_of_all", gains)
    monkeypatch.setattr("valuemap.check.fault.gains_of_all", gains)
    monkeypatch.setattr(corrections, "_better", lambda *given: given[3:])
    monkeypatch.setattr(corrections, "common_errors", lambda *_: _ESTIMATE)
    assert corrections.find_correction(view) is None


def test_a_vote_whose_camera_has_no_ray_a_step_away_is_left_out(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    over_depth = fit._over_depth

    def without_one(local: Floats) -> Floats:
        found = over_depth(local)
        found[0] = np.inf
        return found

    monkeypatch.setattr(fit, "_over_depth", without_one)
    found = parameters.estimate_of(view, PARAMETERS[:1])
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


@pytest.fixture(scope="module")
def loose() -> View:
    return View(simulate(replace(LOOSE, passes_per_street=1), seed=302))


def test_what_looks_like_noise_to_a_narrow_gate_is_seen_by_a_wide_one() -> None:
    """Errors of 1 m and 0.6 degrees, and a camera that is 3 degrees askew."""
    phone = {"position_white_m": 0.4, "position_drift_m": 1.0, "rotation_white_deg": 0.3, "rotation_drift_deg": 0.5}
    given = one_pass(308, **phone)
    assert corrections.find_beyond_noise(View(given)) is None
    askew = INJECTED["camera_yaw"].spoil(given)
    assert askew is not None
    assert corrections.find_correction(View(askew)) is None
    found = corrections.find_beyond_noise(View(askew))
    assert found is not None
    assert found.parameter.name == "yaw"
    assert np.degrees(found.value) == pytest.approx(-3.0, abs=0.7)


def test_a_shift_in_time_of_a_short_drive_is_named() -> None:
    late = INJECTED["time_shift"].spoil(one_pass(301))
    assert late is not None
    assert corrections.find_correction(View(late)) is None
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
    assert corrections.find_beyond_noise(spoiled) is None
    monkeypatch.setattr(Loose, "_beside", lambda self, parameters, _rival, name: self._settled(parameters).of(name)[0])
    wrong = corrections.find_beyond_noise(spoiled)
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


def test_rays_that_hardly_part_do_not_say_how_large_things_are(loose: View) -> None:
    height_m = object_heights(loose)["traffic_light"]
    assert np.median(height_m) == pytest.approx(1.0, rel=0.3)
    assert len(height_m) >= 3


def test_truth_is_not_called_misplaced_where_poses_are_metres_off(loose: View) -> None:
    assert TruthElsewhere().find(loose) is None
    assert loose.dataset.truth is not None
    moved = loose.dataset.truth.replace(position_in_world_m=loose.dataset.truth.position_in_world_m + [2e4, 0.0, 0.0])
    assert TruthElsewhere().find(View(replace(loose.dataset, truth=moved))) is not None


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
    assert WrongCamera().find(View(spoiled)) is not None


def test_common_errors_are_estimated_in_size_and_direction(good: Dataset, view: View) -> None:
    pitch, focal = PARAMETERS[0], PARAMETERS[3]
    spoiled = focal.change(pitch.change(good, np.radians(1.5)), 0.08)
    before, after = (parameters.estimate_of(each, PARAMETERS) for each in (view, View(spoiled)))
    assert before is not None
    assert after is not None
    assert after.of("pitch")[0] - before.of("pitch")[0] == pytest.approx(-np.radians(1.5), rel=0.15)
    assert after.of("log_focal")[0] - before.of("log_focal")[0] == pytest.approx(-0.08, rel=0.2)


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


def told_of_camera(dataset: Dataset, camera_id: int) -> Finding:
    """Return the small error that is found in a dataset, which must be one of a camera alone."""
    (finding,) = find_in_stage(View(dataset), "fine", silent)
    assert finding.of == f"camera {camera_id}"
    return finding


@pytest.fixture(scope="module")
def good_rig() -> Dataset:
    return rig(11)


@pytest.fixture(scope="module")
def one_rig() -> Dataset:
    """Each street is driven once: enough for what shows at once."""
    return rig(14, passes_per_street=1)


def test_a_good_rig_raises_nothing(one_rig: Dataset) -> None:
    assert examine(one_rig).findings == ()


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
    first, second = mounts.exposed_together(late.images, 0, 1)
    assert len(first) == (camera == 0).sum()
    np.testing.assert_allclose(time[first], time[second])
    no_rig = with_images(good_rig, timestamp_s=time + 1e4 * camera)
    assert len(mounts.exposed_together(no_rig.images, 0, 1)[0]) == 0
    assert list(mounts.CamerasExchanged().readings(with_images(good_rig, timestamp_s=None))) == []


def test_what_one_camera_sees_in_its_right_size_is_no_other_unit(
    good_rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of three cameras are exchanged: their rays meet where things are three times as large."""
    spoiled = View(replace(exchanged(good_rig, 0, 1), truth=None, truth_detections=None))
    assert FAULT_NAMED["scale"].find(spoiled) is None
    small = View(replace(with_centers(good_rig, 0.07 * camera_centers(good_rig.images)), truth=None))
    assert FAULT_NAMED["scale"].find(small) is not None
    monkeypatch.setattr("valuemap.check.frames.do_groups_agree", lambda *_: True)
    assert FAULT_NAMED["scale"].find(spoiled) is not None


def test_a_camera_that_sees_little_is_turned_by_what_the_others_see(
    one_rig: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoiled = of_camera(one_rig, turned_by(one_rig, "y", 4.0), 2)
    finding = told_of_camera(spoiled, 2)
    assert finding.fault == "camera_yaw"
    assert finding.fix is not None
    assert degrees_off(finding.fix(spoiled), one_rig).max() < 0.5
    monkeypatch.setattr(corrections, "_estimates_by_others", lambda *_: [])
    assert corrections.find_of_one_group(View(spoiled)) is None


def test_a_turn_by_gates_is_told_where_hardly_a_ray_is_right(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the gate at which good rays meet, the estimate stays where chance votes pull."""
    given = rig(1, passes_per_street=1)
    spoiled = of_camera(given, turned_by(given, "y", 3.0), 2)
    found = corrections.find_of_one_group(View(spoiled))
    assert found is not None
    assert found.group == Group(camera_id=2)
    assert found.parameter.name == "yaw"
    assert degrees_off(found(spoiled), given).max() < 0.3
    monkeypatch.setattr(corrections, "at_wider_gate", lambda view: view)
    assert corrections.find_of_one_group(View(spoiled)) is None


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
    assert [(found.fault, found.of) for found in find_in_stage(tilted, "fine", silent)] == [("camera_tilt", "camera 1")]
    assert [(found.fault, found.of) for found in find_in_stage(low, "fine", silent)] == [("camera_height", None)]
    monkeypatch.setattr(cameras.CameraHeight, "rivals", frozenset())
    assert [found.fault for found in find_in_stage(tilted, "fine", silent)] == ["camera_height"]


@pytest.mark.parametrize(("fault", "is_along"), [(pass_offsets.PassOffset, False), (pass_offsets.PassTimeShift, True)])
def test_a_camera_that_no_other_pass_has_is_told_from_any_shift_of_its_pass(
    fault: type[Fault], is_along: bool, tilted: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    shift = pass_shifts.worst_pass(tilted)
    assert shift is not None
    aside = replace(shift, offset_m=np.array([1.0, 0.0, 0.0]), is_along=is_along)
    monkeypatch.setattr(pass_offsets, "worst_pass", lambda _: aside)
    assert [found.fault for found in find_in_stage(tilted, "fine", silent)] == ["camera_tilt"]
    monkeypatch.setattr(fault, "rivals", frozenset())
    assert [found.fault for found in find_in_stage(tilted, "fine", silent)] == [fault.name]


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
    finding = FAULT_NAMED["boxes_half_size"].find(View(spoiled))
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
