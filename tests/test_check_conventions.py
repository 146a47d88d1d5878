"""Data under a wrong convention: which one is told, of all images or of one camera; they are read right again."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from check_faults import FAULTS as INJECTED
from check_faults import RIG_FAULTS, exchanged, good_city, of_camera
from check_faults import good_rig as rig
from checking import FAULT_NAMED, LOOSE, convention_told, degrees_off, named, one_pass, turned_by
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import boxes, contest, examine, frames, mounts
from valuemap.check.agreement import Agreement, compare, gains_of_objects
from valuemap.check.boxes import BoxesOfSquare, EndsOfBoxes, PictureSize, chance_of_gap, picture_sizes
from valuemap.check.contest import (
    Reading,
    compare_on_samples,
    hold_contest,
    joined_with_attitude,
    spoils_a_group,
    suspicion_of,
)
from valuemap.check.fault import (
    LEAST_CHANCE,
    Convention,
    Finding,
    View,
    keep_rows,
    with_centers,
    with_detections,
    with_images,
    with_poses,
)
from valuemap.check.frames import WorldAxes
from valuemap.check.groups import Group
from valuemap.check.headings import driving_azimuths, headings, level_rotations, rotations_of
from valuemap.check.poses import PitchAndRoll
from valuemap.check.registry import CONVENTIONS
from valuemap.check.sample import order_by_pass
from valuemap.dataset import Dataset
from valuemap.simulate import simulate
from valuemap.tables import Categories


def test_a_reading_that_few_places_cannot_prove_is_suspected_not_found(view: View) -> None:
    def reading(convention: Convention | None, gain: np.ndarray) -> Reading:
        points = replace(view.agreement.found, voters=np.arange(len(gain), dtype=np.uint32))
        points = replace(points, position_in_world_m=np.zeros((len(gain), 3)), voter_offsets=np.arange(len(gain) + 1))
        agreement = replace(view.agreement, gain=gain, gain_of_point=gain, found=points)
        return Reading(convention, "x y z w", None, agreement, uprightness=1.0, tests=tests)

    worse = np.array([3.0, 4.0, 2.0, 5.0, 4.0, 6.0, 3.0])
    better = worse + [4.0, 6.0, 3.0, 9.0, 5.0, 8.0, 2.0]
    tests = len(CONVENTIONS)
    quaternions, given = next(each for each in CONVENTIONS if each.name == "quaternion_order"), reading(None, worse)
    chance = compare(better, worse).chance * tests
    assert LEAST_CHANCE < chance < 0.05
    told = suspicion_of(given, reading(quaternions, better))
    assert told is not None
    assert quaternions.what in told
    assert "x y z w" in told
    assert suspicion_of(given, reading(quaternions, worse + 0.1 * (better - worse) * [1, -1, 1, 1, -1, 1, 1])) is None
    assert suspicion_of(given, given) is None


def street(good: Dataset, start: int, length: int) -> Dataset:
    """Return images that follow each other, and nothing else."""
    rows = order_by_pass(good.images)[start : start + length]
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


def test_a_guess_is_compared_by_places_however_few_they_are(good: Dataset) -> None:
    """Level cameras are better or worse for whole stretches, so their objects do not count one by one."""
    view = View(street(good, 270, 40))
    few, none = [view.agreement], [replace(view.agreement, gain=0.0 * view.agreement.gain, gain_of_point=np.zeros(0))]
    none = [replace(none[0], found=view.agreement.found.take(np.array([], dtype=np.int64)))]
    assert compare_on_samples(few, none).of == "objects"
    assert compare_on_samples(few, none).places == len(view.agreement.found)
    assert compare_on_samples(few, none, may_split=False).of == "places"
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
    def reading(uprightness: float, *, is_along_axis: bool = False) -> Reading:
        return Reading(None, "", None, view.agreement, uprightness, is_along_axis)

    upright = reading(0.999)
    assert joined_with_attitude(0.01, upright, reading(-0.3)) == pytest.approx(5e-6 * (1.0 - np.log(5e-6)))
    assert joined_with_attitude(0.01, upright, reading(-0.3, is_along_axis=True)) == 0.01
    assert joined_with_attitude(0.01, upright, reading(0.9)) == 0.01
    assert joined_with_attitude(0.2, upright, reading(-0.3)) == 0.2


_LOOSE_BY = ("position_white_m", "position_drift_m", "rotation_white_deg", "rotation_drift_deg")


def test_pitch_and_roll_of_a_phone_are_not_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    given = View(one_pass(300, **{name: getattr(LOOSE, name) for name in _LOOSE_BY}))
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
    # Boxes of the others would be outside of their pictures.
    assert hold_contest(View(spoiled), conventions("picture_size")).finding is None
    monkeypatch.setattr(contest, "puts_boxes_outside", lambda *_: False)
    wide = hold_contest(View(spoiled), conventions("picture_size")).finding
    monkeypatch.undo()
    assert wide is not None
    assert wide.of is None
    assert wide.fix is not None
    assert spoils_a_group(View(spoiled), wide.fix)
    assert told_of_convention("picture_size", spoiled, monkeypatch) == [("picture_size", "camera 1")]
    everywhere = hold_contest(View(fitted), conventions("picture_size")).finding
    assert everywhere is not None
    assert everywhere.fix is not None
    assert not spoils_a_group(View(fitted), everywhere.fix)


def test_nothing_measured_is_given_up_where_another_reading_stands_the_cameras_up() -> None:
    given = simulate(replace(LOOSE, passes_per_street=1), seed=300)
    spoiled = INJECTED["inverted_poses"].spoil(given)
    assert spoiled is not None
    finding = convention_told(spoiled)
    assert finding.fault == "inverted_poses"


def test_boxes_are_not_said_to_be_of_pictures_that_they_would_not_be_in(good: Dataset) -> None:
    assert not [how for how, _ in PictureSize().readings(good) if "boxes 2 " in how]
    halved = INJECTED["picture_size"].spoil(good)
    assert halved is not None
    assert [how for how, _ in PictureSize().readings(halved) if "boxes 2 " in how]


def test_images_with_the_camera_of_others_are_no_pictures_of_another_size(good: Dataset) -> None:
    wrong = INJECTED["wrong_camera"].spoil(good)
    assert wrong is not None
    view = View(wrong)
    camera = FAULT_NAMED["wrong_camera"].find(view)
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
    assert FAULT_NAMED["headings_constant"].find(View(lying)) is None
    of_radians = with_poses(
        one,
        rotations_of(np.radians(headings(one)[0]), *headings(one)[1:], one.frame),
        camera_centers(one.images),
    )
    assert FAULT_NAMED["headings_constant"].find(View(of_radians)) is None


def test_two_faults_are_both_named_and_undone(one: Dataset) -> None:
    twice = INJECTED["repeated_boxes"].spoil(one)
    assert twice is not None
    spoiled = INJECTED["inverted_poses"].spoil(twice)
    assert spoiled is not None
    outcome = examine(spoiled)
    assert [finding.fault for finding in outcome.findings] == ["repeated_boxes", "inverted_poses"]
    assert len(outcome.fixed.detections) == len(one.detections)
    np.testing.assert_allclose(camera_centers(outcome.fixed.images), camera_centers(one.images), atol=1e-6)


def conventions(*names: str) -> list[Convention]:
    """Return some conventions, in the order of the registry."""
    return [each for each in CONVENTIONS if each.name in names]


def told_of_convention(name: str, dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str | None]]:
    """Return what a check says, and of what alone, if it looks for one convention and nothing else."""
    monkeypatch.setattr(sys.modules["valuemap.check.examine"], "STAGES", ("conventions",))
    monkeypatch.setattr(sys.modules["valuemap.check.examine"], "CONVENTIONS", conventions(name))
    return [(finding.fault, finding.of) for finding in examine(dataset).findings]


def test_parameters_in_shares_of_the_picture_are_named_and_undone(one: Dataset) -> None:
    """As pixels they make a radian a pixel, and other readings of them millions."""
    size = np.stack([one.cameras.width_px, one.cameras.height_px], axis=1)
    params = [each / np.tile(extent, 2) for each, extent in zip(one.cameras.params, size, strict=True)]
    outcome = examine(replace(one, cameras=one.cameras.replace(params=params)))
    assert [finding.fault for finding in outcome.findings] == ["focal_unit"]
    for fixed, right in zip(outcome.fixed.cameras.params, one.cameras.params, strict=True):
        np.testing.assert_allclose(fixed, right)


def test_boxes_far_outside_of_their_pictures_are_not_called_corners() -> None:
    keeping = EndsOfBoxes(np.linspace(0.6, 2.0, 200))
    assert chance_of_gap(EndsOfBoxes(np.linspace(-0.4, 2.0, 200)), keeping) < LEAST_CHANCE
    assert chance_of_gap(EndsOfBoxes(np.linspace(-8.0, 2.0, 200)), keeping) == 1.0


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
            assert len(list(unit.readings(with_poses(given, rotation, camera_centers(given.images))))) == 16
    straight = street(one, 0, 40)
    assert len(list(unit.readings(straight))) == 11  # No turns to follow, and five hardly turn it.


def test_headings_alone_in_the_wrong_unit_are_told_from_all_angles(one: Dataset) -> None:
    azimuth, pitch, roll = headings(one)
    rotation = rotations_of(np.radians(azimuth), pitch, roll, one.frame)
    spoiled = with_poses(one, rotation, camera_centers(one.images))
    finding = convention_told(spoiled)
    assert finding.figures["reading"] == "headings in radians clockwise from north read as degrees"


def test_radians_from_east_that_were_read_as_degrees_from_north_are_told_at_once(one: Dataset) -> None:
    azimuth, pitch, roll = headings(one)
    from_east = (np.pi / 2.0 - azimuth + np.pi) % (2.0 * np.pi) - np.pi
    spoiled = with_poses(one, rotations_of(np.radians(from_east), pitch, roll, one.frame), camera_centers(one.images))
    finding = convention_told(spoiled)
    assert finding.fault == "degrees_for_radians"
    assert (
        finding.figures["reading"]
        == "headings in radians counter-clockwise from east read as degrees clockwise from north"
    )
    assert finding.fix is not None
    assert np.max(degrees_off(finding.fix(spoiled), one)) < 1e-6


@pytest.mark.parametrize("has_tilts", [True, False])
def test_headings_in_gon_are_told_and_read_right(has_tilts: bool, one: Dataset) -> None:
    """A circle has 400: of those from 360 on nothing but the way tells which of two they were."""
    azimuth, pitch, roll = headings(one)
    tilt = 0.9 if has_tilts else 1.0
    rotation = rotations_of((azimuth % (2.0 * np.pi)) / 0.9, pitch / tilt, roll / tilt, one.frame)
    spoiled = with_poses(one, rotation, camera_centers(one.images))
    finding = convention_told(spoiled)
    assert finding.fault == "degrees_for_radians"
    assert "gon clockwise from north" in finding.figures["reading"]
    assert finding.fix is not None
    off = degrees_off(finding.fix(spoiled), one)
    assert np.quantile(off, 0.99) < 0.5


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
    monkeypatch.setattr(contest.AmongOthers, "readings", lambda *_: iter(()))
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
def one_rig() -> Dataset:
    """Each street is driven once: enough for what shows at once."""
    return rig(14, passes_per_street=1)


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


@pytest.mark.parametrize("is_squeezed", [True, False])
def test_the_gate_is_one_angle_whatever_square_boxes_were_measured_in(is_squeezed: bool, good: Dataset) -> None:
    width, height = picture_sizes(good)[0]
    pixel = np.sqrt(width * height) if is_squeezed else max(width, height)
    assert BoxesOfSquare(good, 416, is_squeezed=is_squeezed).gate_factor == pytest.approx(pixel / 416.0)


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
