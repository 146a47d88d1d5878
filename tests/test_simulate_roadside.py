"""Rows of signs, street lamps, trees and posts: where they stand, who sees them, and that they change nothing else."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from test_simulate import EXACT_POSES, NOTHING_FALSE, PERFECT, SMALL, changed, points_in_cam, projected, tables_of
from valuemap.arrays import Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset, check_dataset
from valuemap.errors import SettingError
from valuemap.simulate import PRESETS, Recording, build_city, record_city, simulate
from valuemap.simulate.render import render_pictures
from valuemap.simulate.streets import DIRECTIONS

SPACINGS = ("sign_row_spacing_m", "lamp_spacing_m", "tree_spacing_m", "post_spacing_m")
STREETS: dict[str, Any] = {"has_lights": 0, "passes_per_street": 1, "streets_north_south": 2, "streets_east_west": 2}


@cache
def recorded(**settings: Any) -> Recording:
    return record_city(changed(SMALL, **{"lights": 0, **STREETS, **settings}), seed=0)


def places_along(config: SimulationConfig) -> tuple[Floats, Ints]:
    """Return of all roadside objects the place from the axis and along the nearest street, and which class they are."""
    city = build_city(config, seed=0)
    ground = city.roadside.position_in_world_m[:, :2]
    off_x = np.abs(ground[:, :1] - city.streets.x_m).min(axis=1)
    off_y = np.abs(ground[:, 1:] - city.streets.y_m).min(axis=1)
    return np.minimum(off_x, off_y), city.roadside.class_code


@pytest.mark.parametrize(
    ("settings", "class_name", "apart_m"),
    [
        ({"lamp_spacing_m": 25.0}, "street_lamp", (22.0, 28.0)),
        ({"tree_spacing_m": 6.0}, "tree", (4.7, 7.3)),
        ({"post_spacing_m": 3.0}, "post", (2.8, 3.2)),
    ],
)
def test_rows_stand_on_both_sides_of_every_street_as_far_apart_as_asked(
    settings: dict[str, float], class_name: str, apart_m: tuple[float, float]
) -> None:
    recording = recorded(**settings)
    dataset, streets = recording.dataset, recording.city.streets
    assert dataset.truth is not None
    assert dataset.truth.class_name.names == (class_name,)
    assert dataset.detections.class_name.names == (class_name,)
    ground = dataset.truth.position_in_world_m[:, :2]
    # The street from intersection (0, 0) to (1, 0), of which the rest of the city is a copy.
    between = (ground[:, 0] > streets.x_m[0] + 13.0) & (ground[:, 0] < streets.x_m[1] - 13.0)
    for side in (-1.0, 1.0):
        along = np.sort(ground[between & (side * (ground[:, 1] - streets.y_m[0]) > 0.0) & (ground[:, 1] < 13.0), 0])
        assert len(along) >= 2
        assert np.all((np.diff(along) > apart_m[0]) & (np.diff(along) < apart_m[1]))
        assert along[0] - streets.x_m[0] < 16.0 + apart_m[1]
    from_axis_m, _ = places_along(recording.config)
    assert np.all((from_axis_m > 6.5) & (from_axis_m < streets.half_width_m))


@pytest.mark.parametrize("apart_m", [0.5, 0.9])
def test_signs_stand_side_by_side_on_the_right_and_face_the_traffic(apart_m: float) -> None:
    recording = recorded(sign_row_spacing_m=20.0, sign_apart_m=apart_m)
    signs, streets = recording.city.roadside, recording.city.streets
    facing = np.stack([np.cos(signs.facing_rad), np.sin(signs.facing_rad)], axis=1)
    ahead = DIRECTIONS[np.argmax(-facing @ DIRECTIONS.T, axis=1)]
    assert np.all(-(facing * ahead).sum(axis=1) > np.cos(np.radians(5.1)))
    ground = signs.position_in_world_m[:, :2]
    along = np.abs(ahead[:, 1]).astype(int)
    axis = np.where(
        along == 0, np.abs(ground[:, 1:] - streets.y_m).argmin(1), np.abs(ground[:, :1] - streets.x_m).argmin(1)
    )
    from_axis = np.where(along == 0, ground[:, 1] - streets.y_m[axis], ground[:, 0] - streets.x_m[axis])
    right = np.where(along == 0, -ahead[:, 0], ahead[:, 1])
    assert np.all((right * from_axis > 6.9) & (right * from_axis < streets.half_width_m))
    distance = np.linalg.norm(ground[:, None] - ground, axis=2)
    same_row = distance < 6.5
    counts = same_row.sum(axis=1)
    assert set(counts.tolist()) == {2, 3, 4, 5, 6}
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_allclose(distance.min(axis=1), apart_m, atol=0.06)


def test_each_class_is_in_the_truth_and_is_detected_where_it_stands() -> None:
    settings = PERFECT | dict.fromkeys(SPACINGS, 20.0) | {"has_lights": 1}
    recording = recorded(**settings)
    dataset = recording.dataset
    check_dataset(dataset, source="streets")
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    names = ("traffic_light", "traffic_sign", "street_lamp", "tree", "post")
    assert dataset.truth.class_name.names == names
    assert np.all(np.bincount(dataset.truth.class_name.codes) > 4)
    assert len(recording.city.objects) == len(dataset.truth) > len(recording.city.lights)
    detection, thing = dataset.truth_detections.detection_id, dataset.truth_detections.object_id
    assert len(detection) == len(dataset.detections)
    assert np.array_equal(dataset.detections.class_name.codes[detection], dataset.truth.class_name.codes[thing])
    assert np.all(np.bincount(dataset.detections.class_name.codes) > 50)
    image, point = dataset.detections.image_id[detection], dataset.truth.position_in_world_m[thing]
    np.testing.assert_allclose(projected(dataset, image, point), dataset.detections.center_px[detection], atol=1e-7)
    depth_m = points_in_cam(dataset, image, point)[:, 2]
    height_m = recording.city.objects.size_m[thing, 1]
    np.testing.assert_allclose(dataset.detections.size_px[detection, 1], 500.0 * height_m / depth_m, rtol=1e-9)


def test_posts_are_seen_from_all_sides_and_signs_from_one() -> None:
    def views_from(recording: Recording) -> Floats:
        """Return the spread (objects) of the headings that see each object: 0 for one heading, 1 for two opposite."""
        shown = recording.dataset.truth_detections
        assert shown is not None
        heading = recording.frames.heading_rad[recording.dataset.detections.image_id[shown.detection_id]]
        seen = np.bincount(shown.object_id)
        mean = [np.bincount(shown.object_id, part(heading)) / np.maximum(seen, 1) for part in (np.cos, np.sin)]
        return np.asarray((1.0 - np.hypot(*mean))[seen > 8])

    settings = PERFECT | {"passes_per_street": 2}
    assert np.mean(views_from(recorded(post_spacing_m=10.0, **settings)) > 0.35) > 0.5
    assert views_from(recorded(sign_row_spacing_m=20.0, **settings)).max() < 0.3


def test_without_lights_no_car_waits_and_all_images_are_kept() -> None:
    recording = recorded(post_spacing_m=20.0, keep_before_signal_m=20.0)
    frames = recording.frames
    assert len(recording.city.lights) == len(recording.city.lookalikes) == 0
    step_m = np.diff(frames.distance_m)[np.diff(frames.pass_row) == 0]
    np.testing.assert_allclose(step_m, SMALL.frame_spacing_m)


def test_rows_leave_lights_and_drives_as_they_were() -> None:
    plain, with_rows = (
        record_city(changed(SMALL, **NOTHING_FALSE, **EXACT_POSES, **more), seed=0)
        for more in ({}, {"post_spacing_m": 10.0, "sign_row_spacing_m": 30.0})
    )
    of_lights = with_rows.boxes.take(with_rows.boxes.kind == 0)
    assert len(with_rows.boxes) > len(of_lights) == len(plain.boxes)
    assert np.array_equal(of_lights.center_px, plain.boxes.center_px)
    assert np.array_equal(of_lights.thing_row, plain.boxes.thing_row)
    assert tables_of(plain.dataset)[1].equals(tables_of(with_rows.dataset)[1])


def test_false_things_look_like_any_class_of_the_city() -> None:
    rates = {"clutter_per_image": 1.0, "reflections_per_1000_images": 30.0, "temporary_per_1000_images": 30.0}
    recording = recorded(**dict.fromkeys(SPACINGS, 30.0), **rates)
    for kind in (2, 3, 4):  # temporary, reflections, clutter
        boxes = recording.boxes.take(recording.boxes.kind == kind)
        assert set(boxes.class_code.tolist()) == {1, 2, 3, 4}
        pairs = np.unique(np.stack([boxes.thing_row, boxes.class_code]), axis=1)
        assert len(np.unique(boxes.thing_row)) == pairs.shape[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"has_lights": 0}, "nothing stands in the city"),
        ({"min_row_signs": 4, "max_row_signs": 3}, "min_row_signs (4)"),
        ({"post_spacing_m": -1.0}, "post_spacing_m"),
    ],
)
def test_impossible_rows_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError) as error:
        changed(SMALL, **settings)
    assert message in str(error.value)


def test_pictures_of_rows_are_refused() -> None:
    with pytest.raises(SettingError, match="pictures are drawn by one camera of whole, flat lights only"):
        next(render_pictures(recorded(post_spacing_m=20.0, keep_before_signal_m=20.0), rows=[0]))


# What was simulated before there were rows, from the same seeds: (images, detections, a few numbers of each table).
_BEFORE: dict[str, tuple[int, int, list[float]]] = {
    "small": (
        2656,
        5014,
        [-76.50026128014633, 501.8114001212215, -7.237803837980954, -2471.4689775769966, -500.54455296519967],
    ),
    "sf": (
        12048,
        17174,
        [-9835.458411157768, -159.6280943506894, 12.156667676277761, -22727.83787268342, -1881.428680175332],
    ),
}


def fingerprint(dataset: Dataset) -> tuple[int, int, list[float]]:
    """Return counts, and sums that any change of the random numbers moves by far more than rounding does."""
    detections, images, truth = dataset.detections, dataset.images, dataset.truth
    assert truth is not None
    boxes = (detections.center_px, detections.size_px, detections.score[:, None])
    parts = (*boxes, images.cam_from_world_m, truth.position_in_world_m)
    sums = [float(np.sum(np.cos(np.arange(len(part))) @ part)) for part in parts]
    return len(images), len(detections), sums


@pytest.mark.parametrize("name", ["small", "sf"])
def test_presets_give_what_they_always_gave(name: str) -> None:
    images, detections, sums = fingerprint(simulate(PRESETS[name], seed=0))
    assert (images, detections) == _BEFORE[name][:2]
    np.testing.assert_allclose(sums, _BEFORE[name][2], rtol=1e-7)
