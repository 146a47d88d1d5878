"""Every known fault is put into a good simulated city and has to be named; good data must raise none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from check_faults import FAULTS as INJECTED
from check_faults import RIG_FAULTS, good_city
from check_faults import good_rig as rig
from checking import FAULT_NAMED, convention_told
from small_dataset import small_dataset
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import examine, frames
from valuemap.check.agreement import compare, measure_agreement
from valuemap.check.along_drives import moved_along
from valuemap.check.drive_ids import jumping_passes, passes_in_turn
from valuemap.check.examine import find_in_stage
from valuemap.check.fault import (
    View,
    keep_rows,
    with_centers,
    with_detections,
    with_images,
)
from valuemap.check.headings import headings, level_rotations, rotations_of
from valuemap.check.offsets import find_shift
from valuemap.check.pass_shifts import shift_at_a_seam
from valuemap.check.quality import strays
from valuemap.check.registry import CONVENTIONS, FAULTS
from valuemap.check.sample import number_rows, order_by_pass
from valuemap.check.seams import worst_seam
from valuemap.check.sizes import are_outside, object_heights
from valuemap.check.time_stamps import rolling_period, unroll
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, Frame, read_dataset, write_dataset
from valuemap.errors import InputError
from valuemap.progress import silent
from valuemap.tables import Categories

_CONVENTIONS = {convention.name for convention in CONVENTIONS}


_SEEN_AGAIN = {"passes_no_drives"}
"""Images without any order have none afterwards either: what is put right is which of them share a pass."""


_RECOVERED = {"degrees_for_radians": 0.6}
"""Degrees read as radians lose whole turns, which the direction of travel does not always give back."""


_NEEDS_ALL = {"mirrored_pictures", "boxes_top_left", "lens_model", "camera_aside"}
"""What half as many passes do not prove."""


_NEEDS_FEW = {
    "pass_offset",
    "pass_frame",
    "pass_turned",
    "pass_time_shift",
    "camera_height",
    "height_zero",
    "heights_left_out",
    "interleaved_passes",
    "wrong_camera",
}
"""What one pass and one camera cannot have."""


def enough_for(name: str) -> str:
    """Return the fixture with the fewest passes that prove a fault."""
    return "good" if name in _NEEDS_ALL else "few" if name in _NEEDS_FEW else "one"


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
    assert [found.fault for found in find_in_stage(View(spoiled), "results", silent)] == ["scale"]


def test_rows_are_numbered_in_the_order_of_their_columns() -> None:
    rows = np.array([[2, -1, 0], [0, 5, 9], [2, -1, 0], [0, 5, -9], [0, 4, 2**62], [2, -1, 1]])
    assert number_rows(*rows.T).tolist() == [3, 2, 3, 1, 0, 4]
    assert number_rows(rows[:0, 0], rows[:0, 1]).tolist() == []


def test_points_where_rays_may_meet_by_chance_are_no_objects(good: Dataset) -> None:
    spoiled = INJECTED["truth_elsewhere"].spoil(good)
    assert spoiled is not None
    assert FAULT_NAMED["truth_elsewhere"].find(View(spoiled)) is not None
    assert FAULT_NAMED["truth_elsewhere"].find(View(spoiled, meets=False)) is None
    assert object_heights(View(good)) != {}
    assert object_heights(View(good, meets=False)) == {}


def test_a_seam_that_rays_cannot_see_is_no_fault(good: Dataset, view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = view.seen_m
    assert 0.1 < seen < 1.0  # Objects are 10 to 80 m away, the gate is 0.012 rad.
    drive = one_drive_in_two(good)
    is_late = drive.images.pass_id.codes == drive.images.pass_id.code_of("late")
    up = np.where(is_late[:, None], [0.0, 0.0, 0.5 * seen], 0.0)
    jumps = View(with_centers(drive, camera_centers(drive.images) + up))
    assert shift_at_a_seam(jumps) is not None
    monkeypatch.setattr(jumps, "seen_m", seen)
    assert shift_at_a_seam(jumps) is None


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
    assert jumping_passes(images) == []
    dealt = np.random.default_rng(0).permutation(400).astype(np.float64)
    assert len(jumping_passes(images.replace(timestamp_s=dealt))) == 1


def test_of_a_car_one_of_whose_cameras_has_the_poses_of_another_time_no_images_are_of_several_drives() -> None:
    given = rig(1, passes_per_street=1)
    center, images = camera_centers(given.images), given.images
    late = (images.camera_id == 1)[:, None] * [6.0, 0.0, 0.0]
    assert jumping_passes(with_centers(given, center + late).images) == []


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
    assert rolling_period(given) is None
    rolling = replace(given, images=images.replace(timestamp_s=np.asarray(images.timestamp_s) % 10.0))
    assert rolling_period(rolling) == (10.0, 2)
    unrolled = np.asarray(unroll(rolling).images.timestamp_s)
    np.testing.assert_allclose(unrolled, np.asarray(images.timestamp_s))


def test_three_lights_taken_for_large_are_no_other_unit() -> None:
    assert not are_outside(np.array([1.1, 2.2, 2.4]), 0.45, 2.0)
    assert are_outside(np.array([0.06, 0.07, 0.08]), 0.45, 2.0)
    assert are_outside(np.array([0.06, 0.07, 0.22]), 0.45, 2.0)
    assert are_outside(np.array([2.1, 2.2, 2.2, 2.3]), 0.45, 2.0)
    assert not are_outside(np.array([0.06, 0.07, 0.08]), 0.05, 2.0)


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
    known = _CONVENTIONS | set(FAULT_NAMED)
    injected = {fault.finding or name for name, fault in (*INJECTED.items(), *RIG_FAULTS.items())}
    assert injected <= known
    assert known - injected == {"headings_useless", "impossible_boxes", "mirrored_world", "panorama_middle"}
    names = [each.name for each in CONVENTIONS] + [each.name for each in FAULTS]
    # Small units, and feet; by rays, and by truth.
    assert {name for name in known if names.count(name) > 1} == {"height_unit", "mirrored_world"}


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


@pytest.mark.parametrize("name", sorted(name for name in set(INJECTED) - _CONVENTIONS if not INJECTED[name].finding))
def test_a_fault_is_named(name: str, request: pytest.FixtureRequest) -> None:
    good = request.getfixturevalue(enough_for(name))
    spoiled = INJECTED[name].spoil(good)
    assert spoiled is not None
    finding = FAULT_NAMED[name].find(View(spoiled))
    assert finding is not None
    assert finding.fault == name
    assert (finding.fix is not None) == INJECTED[name].has_fix
    if finding.fix is not None and name not in _SEEN_AGAIN:
        assert FAULT_NAMED[name].find(View(finding.fix(spoiled))) is None


def test_good_data_raise_nothing(good: Dataset) -> None:
    outcome = examine(good)
    assert outcome.findings == ()
    assert outcome.notes == ()
    assert outcome.prospects["detections_that_meet_others"] > 0.8
    assert outcome.prospects["passes_per_place"]["median"] >= 2


def test_rays_agree_far_better_than_by_chance(view: View) -> None:
    assert compare(view.agreement.gain, view.chance.gain).chance < 1e-6
    assert compare(view.chance.gain, view.agreement.gain).chance == 1.0


def test_agreement_does_not_depend_on_where_the_world_begins(good: Dataset, view: View) -> None:
    rotation = rotation_matrices(good.images)
    far = good.images.replace(cam_from_world_m=good.images.cam_from_world_m - rotation @ np.array([4e6, -5e6, 1e3]))
    sample = view.stretches
    moved = measure_agreement(sample.of(Dataset(**{**vars(good), "images": far})), sample.place_of_image, view.gate_px)
    np.testing.assert_allclose(moved.gain, view.agreement.gain, atol=1e-3)


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
    finding = FAULT_NAMED[fault].find(View(spoiled))
    assert finding is not None
    assert "By its times pass late goes on where early ends" in finding.why
    assert all(
        FAULT_NAMED[other].find(View(spoiled)) is None
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
    from valuemap.tables.write import write_table

    outside = corners.detections.replace(center_px=3.0 * corners.detections.center_px)
    write_table(outside, tmp_path / "given" / "detections.parquet")
    with pytest.raises(InputError):
        read_dataset(tmp_path / "given")
    assert len(read_dataset(tmp_path / "given", are_boxes_checked=False).detections) == len(good.detections)
    run = CliRunner().invoke(app, ["check", str(tmp_path / "given"), "--fix", str(tmp_path / "given")])
    assert run.exit_code != 0
    assert (tmp_path / "given" / "detections.parquet").is_file()


def test_a_pass_a_third_of_a_second_off_is_named() -> None:
    given = good_city(11)
    is_late = given.images.pass_id.codes == given.images.pass_id.code_of("pass-0003")
    late = np.where(is_late[:, None], moved_along(given, 2.4), camera_centers(given.images))
    assert FAULT_NAMED["pass_time_shift"].find(View(with_centers(given, late))) is not None


def test_an_image_a_jump_away_from_its_drive_is_named(one: Dataset) -> None:
    center = camera_centers(one.images)
    row = order_by_pass(one.images)[400]
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


def test_a_few_images_dealt_out_of_many_take_turns_and_pieces_that_overlap_do_not(good: Dataset) -> None:
    drive = keep_rows(good, images=good.images.pass_id.codes == 0)
    count = np.arange(len(drive.images))
    few = passes_in_turn(pass_of_each(drive, (np.random.default_rng(1).random(len(count)) < 0.05).astype(int)).images)
    assert few is not None
    assert set(few[0].values()) == {"pass 0"}
    overlap = (count % 100 < 6) & (count % 2 == 0) & (count > 100)
    assert passes_in_turn(pass_of_each(drive, count // 100 - overlap).images) is None


def test_drives_that_follow_each_other_are_not_joined_with_their_batches(good: Dataset) -> None:
    drives = keep_rows(good, images=good.images.pass_id.codes < 2)
    batch = np.random.default_rng(1).integers(0, 2, len(drives.images))
    dealt = [f"{drive} {number}" for drive, number in zip(drives.images.pass_id.codes, batch, strict=True)]
    found = passes_in_turn(drives.images.replace(pass_id=Categories.from_texts(dealt)))
    assert found is not None
    assert len(found[0]) == 4
    assert len(set(found[0].values())) == 2


def test_passes_that_take_turns_along_one_drive_are_joined(good: Dataset) -> None:
    drive = keep_rows(good, images=good.images.pass_id.codes == 0)
    assert passes_in_turn(drive.images) is None
    assert passes_in_turn(good.images) is None
    dealt = [f"batch {number}" for number in np.random.default_rng(1).integers(0, 3, len(drive.images))]
    outcome = examine(with_images(drive, pass_id=Categories.from_texts(dealt)))
    assert [finding.fault for finding in outcome.findings] == ["passes_no_drives"]
    assert len(set(outcome.fixed.images.pass_id.texts())) == 1


def test_rotation_sigmas_that_rays_give_the_lie_to_are_degrees(good: Dataset) -> None:
    sigma = np.full(len(good.images), 0.2)
    spoiled = with_images(good, rotation_sigma_rad=sigma)
    assert FAULT_NAMED["rotation_sigma_in_degrees"].find(View(spoiled)) is not None
    assert FAULT_NAMED["rotation_sigma_in_degrees"].find(View(spoiled, gate_share=4.0)) is None


def test_a_plural_is_another_spelling(one: Dataset) -> None:
    names = [f"{name}s" if row % 4 == 0 else name for row, name in enumerate(one.detections.class_name.texts())]
    spoiled = with_detections(one, class_name=Categories.from_texts(names))
    (finding,) = find_in_stage(View(spoiled), "tables", silent)
    assert finding.fault == "class_spelling"
    assert finding.fix is not None
    assert finding.fix(spoiled).detections.class_name.texts() == one.detections.class_name.texts()


@pytest.mark.parametrize("factor", [0.3048, 1.0 / 0.3048])
def test_truth_tells_feet_from_metres(factor: float, few: Dataset) -> None:
    spoiled = with_centers(few, factor * camera_centers(few.images))
    finding = FAULT_NAMED["scale"].find(View(spoiled))
    assert finding is not None
    assert finding.fix is not None
    fixed = finding.fix(spoiled)
    np.testing.assert_allclose(camera_centers(fixed.images), camera_centers(few.images), atol=1e-6)


def test_truth_tells_metres_of_web_mercator(few: Dataset) -> None:
    """At the latitude of London they are 62 cm; and near the equator they are metres."""
    assert few.frame.anchor is not None
    spoiled = with_centers(few, camera_centers(few.images) / np.cos(np.radians(few.frame.anchor[0])))
    finding = FAULT_NAMED["scale"].find(View(spoiled))
    assert finding is not None
    assert "Web Mercator" in finding.why
    assert finding.fix is not None
    np.testing.assert_allclose(camera_centers(finding.fix(spoiled).images), camera_centers(few.images), atol=1e-6)
    assert FAULT_NAMED["scale"].find(View(few)) is None
    assert frames.units_of_frame_m(Frame(anchor=(5.0, 0.0, 0.0))) == frames.units_of_frame_m(Frame(up=(0.0, 0.0, 1.0)))


def test_feet_are_not_taken_for_half_sizes(one: Dataset) -> None:
    spoiled = with_centers(replace(one, truth=None, truth_detections=None), 0.3048 * camera_centers(one.images))
    assert [found.fault for found in find_in_stage(View(spoiled), "results", silent)] == ["scale"]


@pytest.mark.parametrize(("fault", "offset_m"), [("pass_offset", [0.8, 0.6, 0.0]), ("camera_height", [0.0, 0.0, 1.0])])
def test_a_metre_between_passes_is_named(fault: str, offset_m: list[float], few: Dataset) -> None:
    """Less than the way from image to image."""
    moved = few.images.pass_id.codes == 1
    spoiled = with_centers(few, camera_centers(few.images) + np.where(moved[:, None], offset_m, 0.0))
    assert [found.fault for found in find_in_stage(View(spoiled), "fine", silent)] == [fault]
