"""Faults of poses, cameras, detectors and drives that are off by default: each does what it says, and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from test_simulate import (
    EXACT_BOXES,
    EXACT_POSES,
    NOTHING_FALSE,
    NOTHING_MISSED,
    PERFECT,
    SMALL,
    changed,
    line_of_frames,
    projected,
    shown,
    sightings_of,
    small,
    tables_of,
    truth_in_cam,
)
from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.dataset import Dataset, check_dataset, rows_of
from valuemap.errors import SettingError
from valuemap.simulate import Recording, record_city
from valuemap.simulate.pose_errors import pose_errors
from valuemap.tables import Images

EXACT_VIEWS = EXACT_POSES | NOTHING_FALSE | NOTHING_MISSED


def recorded(**settings: Any) -> Recording:
    return record_city(changed(SMALL, **settings), seed=0)


def turns_between(images: Images, others: Images) -> Floats:
    """Return rotation vectors (N, 3), in degrees and camera axes, from the poses of the others to those of images."""
    ours, theirs = (Rotation.from_matrix(rotation_matrices(i)) for i in (images, others))
    return np.degrees((ours * theirs.inv()).as_rotvec())


def of_one_light_and_image(recording: Recording) -> dict[tuple[int, int], Floats]:
    """Return the box (x, y, width, height) by image and light, the last of several."""
    boxes = recording.boxes.take(recording.boxes.kind == 0)
    place = np.column_stack([boxes.center_px, boxes.size_px])
    return dict(zip(zip(boxes.frame_row.tolist(), boxes.thing_row.tolist(), strict=True), place, strict=True))


# --- poses


def test_errors_of_a_middle_length_are_as_large_and_as_long_as_asked() -> None:
    step_m, count = 1.0, 40_000
    frames = line_of_frames(step_m * np.arange(count, dtype=np.float64), np.zeros(count, dtype=np.int64))
    only = EXACT_POSES | {"position_middle_m": 0.1, "rotation_middle_deg": 0.2, "middle_length_m": 15.0}
    shift_m, turn_rad = pose_errors(frames, changed(SMALL, **only), seed=0)
    for errors, sigma in ((shift_m, 0.1), (turn_rad, np.radians(0.2))):
        unit = errors / sigma
        np.testing.assert_allclose(unit.std(axis=0), 1.0, atol=0.06)
        for lag in (5, 15, 60):
            correlation = np.mean(unit[lag:] * unit[:-lag])
            assert abs(correlation - np.exp(-lag * step_m / 15.0)) < 0.08
    # They come on top of those that are there anyhow.
    plain = pose_errors(frames, changed(SMALL), seed=0)
    both = pose_errors(frames, changed(SMALL, position_middle_m=0.1, rotation_middle_deg=0.2), seed=0)
    np.testing.assert_allclose(both[0] - plain[0], shift_m, atol=1e-12)
    np.testing.assert_allclose(both[1] - plain[1], turn_rad, atol=1e-12)


def test_each_pass_is_shifted_as_a_whole_on_the_ground() -> None:
    short = {"pass_length_m": 500.0}
    images = small(**EXACT_POSES, **short, pass_shift_m=1.5).images
    shift_m = camera_centers(images) - camera_centers(small(**EXACT_POSES, **short).images)
    np.testing.assert_allclose(shift_m[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.hypot(*shift_m[:, :2].T), 1.5)
    of_pass = [shift_m[images.pass_id.codes == code] for code in range(len(images.pass_id.names))]
    assert all(np.allclose(shift, shift[0], atol=1e-9) for shift in of_pass)
    assert len(of_pass) > 5
    assert len(np.unique(np.round([shift[0] for shift in of_pass], 6), axis=0)) == len(of_pass)


def test_each_pass_is_higher_or_lower_as_a_whole() -> None:
    short = {"pass_length_m": 500.0}
    images = small(**EXACT_POSES, **short, pass_height_m=2.0).images
    shift_m = camera_centers(images) - camera_centers(small(**EXACT_POSES, **short).images)
    np.testing.assert_allclose(shift_m[:, :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(shift_m[:, 2]), 2.0)
    of_pass = [shift_m[images.pass_id.codes == code, 2] for code in range(len(images.pass_id.names))]
    assert all(np.allclose(shift, shift[0], atol=1e-9) for shift in of_pass)
    assert {float(np.sign(shift[0])) for shift in of_pass} == {-1.0, 1.0}


def test_each_pass_looks_askew_to_one_side() -> None:
    short = {"pass_length_m": 500.0}
    images = small(**EXACT_POSES, **short, pass_yaw_deg=1.0).images
    turn_deg = turns_between(images, small(**EXACT_POSES, **short).images)
    np.testing.assert_allclose(turn_deg[:, [0, 2]], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.abs(turn_deg[:, 1]), 1.0, atol=1e-6)
    signs = [np.unique(np.sign(turn_deg[images.pass_id.codes == c, 1])) for c in range(len(images.pass_id.names))]
    assert all(len(sign) == 1 for sign in signs)
    assert {float(sign[0]) for sign in signs} == {-1.0, 1.0}


def test_poses_jump_and_jump_back() -> None:
    jumps: dict[str, Any] = {"jump_m": 3.0, "jumps_per_km": 10.0, "frame_spacing_m": 1.0}
    exact = {**EXACT_POSES, "frame_spacing_m": 1.0}
    recording = recorded(**EXACT_POSES, **jumps)
    shift_m = camera_centers(recording.dataset.images) - camera_centers(small(**exact).images)
    off = np.hypot(*shift_m[:, :2].T)
    assert np.unique(np.round(off, 6)).tolist() == [0.0, 3.0]
    frames = recording.frames
    starts = np.diff(frames.pass_row, prepend=-1) != 0
    assert not off[starts].any()
    changes = np.linalg.norm(np.diff(shift_m, axis=0), axis=1)[~starts[1:]] > 1e-6
    driven_km = (np.diff(frames.distance_m)[~starts[1:]]).sum() / 1000.0
    assert abs(np.count_nonzero(changes) / driven_km / 10.0 - 1.0) < 0.35
    assert len(np.unique(np.round(shift_m[off > 1.0], 6), axis=0)) > 5


def test_late_poses_are_where_the_car_was() -> None:
    delay: dict[str, Any] = {"pose_delay_s": 0.5, "frame_spacing_m": 4.0, "keep_before_signal_m": 500.0}
    recording, exact = recorded(**EXACT_POSES, **delay), recorded(**EXACT_POSES, **(delay | {"pose_delay_s": 0.0}))
    frames = recording.frames
    np.testing.assert_array_equal(frames.center_in_world_m, exact.frames.center_in_world_m)
    late_m = camera_centers(exact.dataset.images) - camera_centers(recording.dataset.images)
    turn_deg = turns_between(exact.dataset.images, recording.dataset.images)
    same_pass = np.diff(frames.pass_row) == 0
    # A step of 4 m takes 0.5 s: the recorded pose is that of the image before.
    step_s = np.diff(frames.time_s, prepend=0.0)
    before = np.flatnonzero(np.isclose(step_s, 0.5) & np.append(False, same_pass))
    moving = before[np.diff(frames.distance_m, prepend=0.0)[before] > 3.9]
    assert len(moving) > 200
    np.testing.assert_allclose(
        late_m[moving], frames.center_in_world_m[moving] - frames.center_in_world_m[moving - 1], atol=1e-6
    )
    assert np.abs(turn_deg[moving, 1]).max() > 10.0  # In bends.
    turned = np.degrees(np.angle(np.exp(1j * (frames.heading_rad[moving] - frames.heading_rad[moving - 1]))))
    up_in_cam = np.einsum("nij,j->ni", frames.cam_from_world()[moving], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(turn_deg[moving], -turned[:, None] * up_in_cam, atol=1e-6)
    standing = np.flatnonzero((np.diff(frames.distance_m) == 0.0) & same_pass & (np.diff(frames.time_s) > 0.6)) + 1
    np.testing.assert_allclose(late_m[standing], 0.0, atol=1e-6)
    assert recording.dataset.detections.center_px.tolist() == exact.dataset.detections.center_px.tolist()


def test_each_row_is_seen_from_where_the_camera_is_at_its_time() -> None:
    rolling: dict[str, Any] = {"readout_s": 0.05, "keep_before_signal_m": 500.0}
    exact = EXACT_VIEWS | EXACT_BOXES
    recording = recorded(**exact, **rolling)
    dataset, frames = recording.dataset, recording.frames
    assert dataset.cameras.readout_s is not None
    assert dataset.cameras.readout_s.tolist() == [0.05]
    plain = recorded(**exact, **(rolling | {"readout_s": 0.0}))
    assert plain.dataset.cameras.readout_s is None
    np.testing.assert_array_equal(camera_centers(dataset.images), camera_centers(plain.dataset.images))
    # Straight on, the camera makes 0.4 m in 0.05 s; in bends it turns left or right.
    way_m = np.linalg.norm(frames.readout_m, axis=1)
    assert np.quantile(way_m, 0.99) == pytest.approx(0.4, rel=1e-3)
    assert np.degrees(np.abs(frames.readout_rad)).max() > 1.0
    assert way_m.min() == 0.0
    detection, thing = shown(dataset)
    image = dataset.detections.image_id[detection]
    found_px = dataset.detections.center_px[detection]
    assert dataset.truth is not None
    point = dataset.truth.position_in_world_m[thing]
    share = (found_px[:, 1] / 480.0 - 0.5)[:, None]
    center = frames.center_in_world_m[image] + share * frames.readout_m[image]
    at_row = frames.replace(heading_rad=frames.heading_rad).take(image)
    at_row = at_row.replace(heading_rad=at_row.heading_rad + share[:, 0] * frames.readout_rad[image])
    in_cam = np.einsum("nij,nj->ni", at_row.cam_from_world(), point - center)
    seen_px = np.array([320.0, 240.0]) + 500.0 * in_cam[:, :2] / in_cam[:, 2:]
    np.testing.assert_allclose(seen_px, found_px, atol=0.02)
    assert np.abs(projected(dataset, image, point) - found_px).max() > 5.0


def test_a_wrong_focal_length_is_only_recorded() -> None:
    wrong, right = small(focal_error_share=0.02), small()
    assert wrong.cameras.params[0].tolist() == [510.0, 510.0, 320.0, 240.0]
    assert all(a.equals(b) for a, b in zip(tables_of(wrong)[1:], tables_of(right)[1:], strict=True))


# --- what is seen of objects


def test_the_edge_of_the_picture_cuts_boxes() -> None:
    """Against the projections of whole lights: what is left of them is the box, if it is enough."""
    whole, cut = recorded(**EXACT_VIEWS, **EXACT_BOXES), recorded(**EXACT_VIEWS, **EXACT_BOXES, min_visible_share=0.3)
    before, after = of_one_light_and_image(whole), of_one_light_and_image(cut)
    assert before.keys() < after.keys()
    assert all(np.allclose(after[key], box, atol=1e-9) for key, box in before.items())
    new = [key for key in after if key not in before]
    assert len(new) > 30
    lights = cut.city.lights
    for frame, light in new:
        x, y, width, height = after[frame, light]
        low, high = np.array([x - width / 2.0, y - height / 2.0]), np.array([x + width / 2.0, y + height / 2.0])
        assert np.all(low > -1e-9)
        assert np.all(high < np.array([640.0, 480.0]) + 1e-9)
        assert np.isclose([*low, *(high - [640.0, 480.0])], 0.0).any()
        point = lights.position_in_world_m[[light]]
        middle = projected(cut.dataset, np.array([frame]), point)[0]
        depth_m = cut.frames.cam_from_world()[frame, 2] @ (point[0] - cut.frames.center_in_world_m[frame])
        assert height <= 500.0 / depth_m + 1e-9
        full_low, full_high = middle[1] - 250.0 / depth_m, middle[1] + 250.0 / depth_m
        np.testing.assert_allclose([low[1], high[1]], np.clip([full_low, full_high], 0.0, 480.0), atol=1e-6)
    is_cut = cut.boxes.is_cut
    assert np.count_nonzero(is_cut) == len(new)


def test_noisy_boxes_do_not_reach_out_of_a_picture_that_cuts_them() -> None:
    boxes = recorded(min_visible_share=0.3, clutter_per_image=1.0, double_share=0.5).boxes
    assert np.all(boxes.center_px - boxes.size_px / 2.0 >= -1e-9)
    assert np.all(boxes.center_px + boxes.size_px / 2.0 <= np.array([640.0, 480.0]) + 1e-9)


def test_what_hides_a_part_leaves_a_smaller_box_around_another_middle() -> None:
    whole, part = (
        recorded(**EXACT_VIEWS, **EXACT_BOXES, partly_hidden_share=share, frame_spacing_m=1.0) for share in (0.0, 0.3)
    )
    before, after = of_one_light_and_image(whole), of_one_light_and_image(part)
    assert before.keys() == after.keys() | before.keys()
    keys = list(after)
    old, new = np.array([before[key] for key in keys]), np.array([after[key] for key in keys])
    old_low, old_high = old[:, :2] - old[:, 2:] / 2.0, old[:, :2] + old[:, 2:] / 2.0
    new_low, new_high = new[:, :2] - new[:, 2:] / 2.0, new[:, :2] + new[:, 2:] / 2.0
    moved = np.abs(np.column_stack([new_low - old_low, new_high - old_high])) > 1e-6
    is_hidden: Bools = np.any(moved, axis=1)
    assert abs(is_hidden.mean() - 0.3) < 0.05
    assert np.all(moved[is_hidden].sum(axis=1) == 1)  # One of left, right and below; never from above.
    assert not moved[:, 1].any()
    assert all(moved[:, side].sum() > 100 for side in (0, 2, 3))
    share = 1.0 - np.prod(new[is_hidden, 2:], axis=1) / np.prod(old[is_hidden, 2:], axis=1)
    assert 0.15 <= share.min() < 0.2 < 0.55 < share.max() <= 0.6
    hidden = {keys[row] for row in np.flatnonzero(is_hidden)}
    assert np.mean([(i + 1, j) in hidden for i, j in hidden if (i + 1, j) in after]) > 0.7
    assert part.boxes.is_cut.sum() == len(hidden)


def test_objects_of_one_class_have_many_sizes() -> None:
    lights = recorded(size_spread=0.2, signalised_share=1.0, lights=0).city.lights
    log_size = np.log(lights.size_m / [0.35, 1.0])
    np.testing.assert_allclose(log_size[:, 0], log_size[:, 1])
    assert abs(log_size[:, 0].std() - 0.2) < 0.05
    recording = recorded(**PERFECT, size_spread=0.2)
    depth_m = truth_in_cam(recording.dataset)[0][:, 2]
    height_px = recording.dataset.detections.size_px[:, 1]
    truth = recording.dataset.truth_detections
    assert truth is not None
    np.testing.assert_allclose(height_px * depth_m / 500.0, recording.city.lights.size_m[truth.object_id, 1])


def test_the_middle_of_a_box_is_another_from_each_side() -> None:
    posts = {"has_lights": 0, "lights": 0, "post_spacing_m": 30.0, "frame_spacing_m": 1.0}
    dataset = small(**PERFECT, **posts, side_offset_m=0.3)
    in_cam, exact_px = truth_in_cam(dataset)
    assert dataset.truth_detections is not None
    assert dataset.truth is not None
    detection, thing = dataset.truth_detections.detection_id, dataset.truth_detections.object_id
    off_m = (dataset.detections.center_px[detection] - exact_px) * in_cam[:, 2:] / 500.0
    image = dataset.detections.image_id[detection]
    to_object = dataset.truth.position_in_world_m[thing] - camera_centers(dataset.images)[image]
    angle = np.arctan2(to_object[:, 1], to_object[:, 0])
    ahead = np.abs(in_cam[:, 0] / in_cam[:, 2]) < 0.3
    assert 0.15 < off_m[ahead, 0].std() < 0.45
    assert 0.15 < off_m[ahead, 1].std() < 0.45
    for number in np.unique(thing)[:20]:
        rows = np.flatnonzero((thing == number) & ahead)
        # The same from the same side, and a smooth function of it: one wave of twice the angle, one of once.
        for offset, waves in ((off_m[rows, 0], 2.0), (off_m[rows, 1], 1.0)):
            basis = np.column_stack([np.cos(waves * angle[rows]), np.sin(waves * angle[rows])])
            fitted = basis @ np.linalg.lstsq(basis, offset, rcond=None)[0]
            assert np.abs(offset - fitted).max() < 0.05


# --- the detector


def test_some_boxes_are_far_off() -> None:
    settings = EXACT_VIEWS | {"pixel_noise_px": 1.0, "pixel_noise_share": 0.0}
    dataset = small(**settings, tail_share=0.1, tail_factor=10.0)
    _, exact_px = truth_in_cam(dataset)
    assert dataset.truth_detections is not None
    far = np.abs(dataset.detections.center_px[dataset.truth_detections.detection_id] - exact_px) > 4.0
    # 69 % of normal numbers of deviation 10 are above 4 on one axis; of deviation 1, none.
    assert abs(far.mean() / (0.1 * 0.69) - 1.0) < 0.2
    assert sightings_of(dataset) == sightings_of(small(**settings))


def test_errors_of_boxes_last() -> None:
    settings = EXACT_VIEWS | {"pixel_noise_px": 1.0, "pixel_noise_share": 0.0}

    def errors(dataset: Dataset) -> tuple[Floats, Ints]:
        _, exact_px = truth_in_cam(dataset)
        pairs, images = dataset.truth_detections, dataset.images
        assert pairs is not None
        image = rows_of(dataset.detections.image_id[pairs.detection_id], images.image_id)
        order = np.lexsort((image, pairs.object_id, images.pass_id.codes[image]))
        error = (dataset.detections.center_px[pairs.detection_id] - exact_px)[order]
        return error, np.stack([images.pass_id.codes[image], pairs.object_id, image], axis=1)[order]

    for images, expected in ((0.0, 0.0), (4.0, np.exp(-0.25))):
        dataset = small(**settings, noise_memory_images=images)
        assert sightings_of(dataset) == sightings_of(small(**settings))
        error, of = errors(dataset)
        # Seen in one image and the next of the same pass.
        follows = np.all(np.diff(of, axis=0) == [0, 0, 1], axis=1)
        assert np.count_nonzero(follows) > 1000
        shared = (error[1:][follows] * error[:-1][follows]).mean()
        assert abs(error.std() - 1.0) < 0.1
        assert abs(shared - expected) < 0.1


@pytest.mark.parametrize("share", [0.08, 1.0])
def test_some_boxes_are_reported_twice(share: float) -> None:
    once, twice = recorded(clutter_per_image=0.3), recorded(clutter_per_image=0.3, double_share=share)
    assert abs(len(twice.boxes) / len(once.boxes) - 1.0 - share) < 0.03
    places = {tuple(place) for place in once.boxes.center_px.tolist()}
    is_first = np.array([tuple(place) in places for place in twice.boxes.center_px.tolist()])
    assert np.count_nonzero(is_first) == len(once.boxes)
    by_key: dict[Any, dict[bool, Floats]] = {}
    for first, frame, kind, thing, center in zip(
        is_first, twice.boxes.frame_row, twice.boxes.kind, twice.boxes.thing_row, twice.boxes.center_px, strict=True
    ):
        by_key.setdefault((frame, kind, thing), {})[bool(first)] = center
    apart = [np.linalg.norm(pair[True] - pair[False]) for pair in by_key.values() if len(pair) == 2]
    assert len(apart) == np.count_nonzero(~is_first)
    np.testing.assert_allclose(np.median(apart), 1.5)  # Less only where the picture ends.
    truth = twice.dataset.truth_detections
    assert truth is not None
    assert len(truth) == np.count_nonzero(twice.boxes.kind == 0)
    check_dataset(twice.dataset, source="twice")


def test_classes_are_confused_as_often_as_asked() -> None:
    settings: dict[str, Any] = {"sign_row_spacing_m": 40.0, "lamp_spacing_m": 25.0, "passes_per_street": 1}
    right, wrong = recorded(**settings), recorded(**settings, class_confusion=0.2)
    assert np.array_equal(right.boxes.center_px, wrong.boxes.center_px)
    is_object = np.isin(right.boxes.kind, (0, 5))
    is_other = right.boxes.class_code != wrong.boxes.class_code
    assert not is_other[~is_object].any()
    assert abs(is_other[is_object].mean() - 0.2) < 0.02
    pairs = np.unique(np.stack([right.boxes.class_code[is_other], wrong.boxes.class_code[is_other]]), axis=1)
    assert pairs.shape[1] == 6
    assert tables_of(right.dataset)[3].equals(tables_of(wrong.dataset)[3])


def test_nothing_can_be_confused_with_the_only_class() -> None:
    with pytest.raises(SettingError, match="only one class stands in the city"):
        changed(SMALL, class_confusion=0.1)


# --- cars and drives


def test_cameras_of_one_car_look_different_ways_and_share_its_errors() -> None:
    recording = recorded(cameras=3, camera_spread_deg=50.0, **NOTHING_FALSE, **NOTHING_MISSED, **EXACT_BOXES)
    frames, images = recording.frames, recording.dataset.images
    assert recording.dataset.cameras.camera_id.tolist() == [0, 1, 2]
    assert np.array_equal(images.camera_id, frames.camera_row)
    check_dataset(recording.dataset, source="three cameras")
    by_exposure = frames.heading_rad.reshape(-1, 3)
    np.testing.assert_allclose(np.diff(by_exposure, axis=1), np.radians(-50.0))
    exact = frames.center_in_world_m.reshape(-1, 3, 3)
    error_m = (camera_centers(images) - frames.center_in_world_m).reshape(-1, 3, 3)
    assert error_m[:, 0].std() > 0.05
    np.testing.assert_allclose(error_m - error_m[:, :1], 0.0, atol=1e-9)
    # Cameras that are turned together: their relative rotation is without error.
    recorded_rotation = rotation_matrices(images).reshape(-1, 3, 3, 3)
    true_rotation = frames.cam_from_world().reshape(-1, 3, 3, 3)
    for rotation in (recorded_rotation, true_rotation):
        relative = rotation[:, 0] @ rotation[:, 2].transpose(0, 2, 1)
        np.testing.assert_allclose(relative, true_rotation[:, 0] @ true_rotation[:, 2].transpose(0, 2, 1), atol=1e-9)
    error = Rotation.from_matrix(recorded_rotation[:, 1] @ true_rotation[:, 1].transpose(0, 2, 1))
    assert np.degrees(error.magnitude()).max() > 0.2
    np.testing.assert_allclose(np.linalg.norm(exact[:, 0] - exact[:, 2], axis=1), 0.4 * np.sin(np.radians(50.0)))
    assert np.all(np.bincount(images.camera_id[recording.dataset.detections.image_id]) > 100)


def test_without_noise_the_truth_projects_onto_the_boxes_of_all_cameras() -> None:
    dataset = small(**PERFECT, cameras=2)
    _, pixel = truth_in_cam(dataset)
    np.testing.assert_allclose(pixel, dataset.detections.center_px, atol=1e-7)


@pytest.mark.parametrize(
    ("settings", "name", "passes"),
    [
        ({"camera_folders": 0}, "pass-0000/cam-1/000000.jpg", ("pass-0000",)),
        ({"camera_folders": 1}, "cam-1/pass-0000/000000.jpg", ("pass-0000",)),
        ({"camera_folders": 2}, "pass-0000-cam-1/000000.jpg", ("pass-0000",)),
        ({"pass_per_camera": 1}, "pass-0000/cam-1/000000.jpg", ("pass-0000-cam-0", "pass-0000-cam-1")),
    ],
)
def test_cameras_have_folders_and_perhaps_passes_of_their_own(
    settings: dict[str, Any], name: str, passes: tuple[str, ...]
) -> None:
    images = small(cameras=2, **settings).images
    names = images.name.to_pylist()
    assert names[1] == name
    assert len(set(names)) == len(names)
    assert images.pass_id.names[: len(passes)] == passes
    assert (images.pass_id.texts()[1] == passes[-1]) == (images.camera_id[1] == 1)


def test_rigs_are_what_a_car_took_at_one_time() -> None:
    assert small(cameras=2).images.rig_id is None
    images = small(cameras=2, write_rigs=1).images
    assert images.rig_id is not None
    assert images.timestamp_s is not None
    assert np.array_equal(np.bincount(images.rig_id), np.full(len(images) // 2, 2))
    assert np.array_equal(images.rig_id[::2], images.rig_id[1::2])
    assert np.array_equal(images.timestamp_s[::2], images.timestamp_s[1::2])


def test_reflections_stay_in_one_camera() -> None:
    recording = recorded(cameras=2, reflections_per_1000_images=5.0)
    reflections = recording.boxes.take(recording.boxes.kind == 3)
    camera = recording.frames.camera_row[reflections.frame_row]
    pairs = np.unique(np.stack([reflections.thing_row, camera]), axis=1)
    assert set(camera.tolist()) == {0, 1}
    assert len(np.unique(pairs[0])) == pairs.shape[1] > 4


def test_laps_drive_the_same_streets_again_within_one_pass() -> None:
    once, thrice = (recorded(passes_per_street=1, laps=laps, keep_before_signal_m=500.0) for laps in (1, 3))
    assert len(thrice.dataset.images) > 2.5 * len(once.dataset.images)
    frames = thrice.frames.take(thrice.frames.pass_row == 0)
    assert np.all(np.diff(frames.time_s) > 0.0)

    def visits(place: Floats) -> int:
        """Return how often the first pass comes within 5 m of a place going the same way as in its first image."""
        near = np.linalg.norm(frames.center_in_world_m - place, axis=1) < 5.0
        same_way = np.cos(frames.heading_rad - frames.heading_rad[0]) > 0.9
        at_m = frames.distance_m[near & same_way]
        return 1 + int(np.count_nonzero(np.diff(at_m) > 50.0))

    assert visits(frames.center_in_world_m[0]) >= 3


# --- what is recorded


def test_times_can_be_left_out() -> None:
    assert small(write_timestamps=0).images.timestamp_s is None


def of_shuffled(shuffled: Recording, plain: Recording) -> tuple[Ints, Bools]:
    """Return the row of each image of a shuffled recording in the plain one, and which are where they were."""
    plain_row = {key: row for row, key in enumerate(zip(plain.frames.pass_row, plain.frames.time_s, strict=True))}
    row = np.array([plain_row[key] for key in zip(shuffled.frames.pass_row, shuffled.frames.time_s, strict=True)])
    return row, row == np.arange(len(row))


def test_shuffled_ids_are_all_that_is_shuffled() -> None:
    plain, shuffled = recorded(), recorded(shuffle_ids=1)
    row, is_where_it_was = of_shuffled(shuffled, plain)
    assert is_where_it_was.mean() < 0.01
    images, others = shuffled.dataset.images, plain.dataset.images.take(row)
    assert np.array_equal(images.image_id, np.arange(len(images)))
    assert np.array_equal(images.cam_from_world_m, others.cam_from_world_m)
    assert images.name.to_pylist() == others.name.to_pylist()
    assert images.pass_id.texts() == others.pass_id.texts()
    check_dataset(shuffled.dataset, source="shuffled")

    def boxes_of(recording: Recording, image: Ints) -> Floats:
        detections = recording.dataset.detections
        rows = np.column_stack([image[detections.image_id], detections.center_px, detections.size_px])
        return np.asarray(rows[np.lexsort(rows.T)])

    assert np.array_equal(boxes_of(shuffled, row), boxes_of(plain, np.arange(len(row))))
    assert np.array_equal(shuffled.boxes.center_px, shuffled.dataset.detections.center_px)
    assert {(int(row[i]), j) for i, j in sightings_of(shuffled.dataset)} == sightings_of(plain.dataset)
    assert not np.all(np.diff(shuffled.dataset.detections.image_id) >= 0)


def test_shuffled_names_tell_no_order() -> None:
    plain, shuffled = small().images, small(shuffle_names=1).images
    names = shuffled.name.to_pylist()
    assert len(set(names)) == len(names)
    assert [name.split("/")[0] for name in names] == plain.pass_id.texts()
    numbers = np.array([int(name[-10:-4]) for name in names])
    assert abs(np.corrcoef(numbers, np.arange(len(numbers)))[0, 1]) < 0.1


@pytest.mark.parametrize(
    "setting", ["side_offset_m=0.1", "partly_hidden_share=0.1", "cameras=2"], ids=lambda s: s.partition("=")[0]
)
def test_pictures_that_would_not_show_it_are_refused(setting: str) -> None:
    SMALL.check_drawable()
    with pytest.raises(SettingError, match=setting.partition("=")[0]):
        SMALL.with_settings([setting]).check_drawable()
