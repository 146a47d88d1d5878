"""Rendered pictures: lights are where the truth says, hidden ones are hidden, and the same seed paints the same."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from told import Told
from valuemap.arrays import Floats
from valuemap.cameras import colmap_camera, rotation_matrices
from valuemap.config import SimulationConfig
from valuemap.dataset import write_dataset
from valuemap.detect.labels import read_labels
from valuemap.folders import LEDGER
from valuemap.simulate import PRESETS, Recording, record_city
from valuemap.simulate.canvas import ENLARGED, Picture, View, bar_outlines_px, fill, fill_all, inset
from valuemap.simulate.housings import lamp_px, paint_housing
from valuemap.simulate.paint import Painter
from valuemap.simulate.render import render_images, render_pictures
from valuemap.simulate.scene import Scene, World, build_world, look, true_boxes
from valuemap.simulate.signals import GREEN, RED
from valuemap.simulate.traffic import CAR
from valuemap.simulate.weather import WEATHERS, Light, light_of_pass

SMALL = PRESETS["small"]
NO_SUN = Light(WEATHERS[0], np.array([1.0, 0.0]), np.ones(3))


def changed(**settings: Any) -> SimulationConfig:
    return SMALL.with_settings(f"{name}={value}" for name, value in settings.items())


@cache
def recording() -> Recording:
    """A city recorded with exact poses."""
    errors = ("position_white_m", "position_drift_m", "rotation_white_deg", "rotation_drift_deg")
    return record_city(changed(occluded_share=0.15, **dict.fromkeys(errors, 0.0)), seed=3)


@cache
def world() -> World:
    return build_world(recording())


@cache
def painter() -> Painter:
    return Painter(world())


def without(scene: Scene, housing: int) -> Scene:
    rest = np.arange(len(scene.housings)) != housing
    return replace(scene, housings=scene.housings.take(rest), seen_share=scene.seen_share[rest])


def difference(scene: Scene, housing: int) -> Floats:
    """Return how much (height, width) the picture changes if one housing is taken away."""
    with_it, without_it = (painter().paint(s).astype(np.float64) for s in (scene, without(scene, housing)))
    change: Floats = np.abs(with_it - without_it).max(axis=2)
    return change


def inside(box_px: Floats) -> tuple[slice, slice]:
    left, top, right, bottom = np.round(box_px).astype(int)
    return slice(top, max(bottom, top + 1)), slice(left, max(right, left + 1))


# Where lights are painted.


def edges_px(box_px: Floats, turn: float) -> Floats:
    """Return left, top, right and bottom of what is painted: the share of each pixel whose white is not black."""
    black, white = (np.full((48 * ENLARGED, 64 * ENLARGED, 3), level, np.uint8) for level in (0, 255))
    for canvas in (black, white):
        paint_housing(canvas, box_px, turn, RED, 0, NO_SUN, 1.0)
    cover = 1.0 - (white.astype(np.float64) - black).mean(axis=2) / 255.0
    middle = np.round((box_px[:2] + box_px[2:]) / 2.0 * ENLARGED).astype(int)
    low = [at - cover.max(axis=axis)[:at].sum() for axis, at in enumerate(middle)]
    high = [at + cover.max(axis=axis)[at:].sum() for axis, at in enumerate(middle)]
    return np.array(low + high) / ENLARGED


@given(
    x=st.floats(20.0, 44.0),
    y=st.floats(18.0, 30.0),
    width=st.floats(1.5, 12.0),
    stretch=st.floats(1.5, 3.0),
    turn=st.floats(-1.0, 1.0),
)
def test_a_housing_covers_its_box_and_nothing_else(
    x: float, y: float, width: float, stretch: float, turn: float
) -> None:
    height = width * stretch
    box = np.array([x - width / 2.0, y - height / 2.0, x + width / 2.0, y + height / 2.0])
    assert edges_px(box, turn) == pytest.approx(box, abs=0.01)


@pytest.mark.parametrize("all_at_once", [False, True])
@pytest.mark.parametrize("clockwise", [False, True])
def test_what_is_painted_is_as_large_as_its_outline(all_at_once: bool, clockwise: bool) -> None:
    # OpenCV paints what an outline touches, too: everything would be a quarter of a pixel larger on all sides.
    random, larger_px, away_px = np.random.default_rng(0), [], []
    for _ in range(200):
        middle, half, turn = random.uniform(20.0, 28.0, 2), random.uniform(1.0, 12.0, 2), random.uniform(0.0, np.pi)
        aside = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])[:: 1 if clockwise else -1] * half
        outline = middle + aside @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        canvas = np.zeros((48 * ENLARGED, 48 * ENLARGED, 3), np.uint8)
        if all_at_once:
            fill_all(canvas, inset(outline[None]), [255.0] * 3)
        else:
            fill(canvas, outline, [255.0] * 3)
        y, x = (np.argwhere(canvas[:, :, 0]).T + 0.5) / ENLARGED
        larger_px.append((len(x) / ENLARGED**2 - 4.0 * half.prod()) / (4.0 * half.sum()))
        away_px.append([x.mean() - middle[0], y.mean() - middle[1]])
    assert abs(np.mean(larger_px)) < 0.05
    assert np.abs(np.mean(away_px, axis=0)).max() < 0.03


def test_what_is_thin_is_painted_as_thin_as_a_pixel_of_the_canvas() -> None:
    for turn in np.linspace(0.1, 3.0, 9):
        along = np.array([np.cos(turn), np.sin(turn)])
        start, end = 24.0 - 12.0 * along, 24.0 + 12.0 * along
        canvas = np.zeros((48 * ENLARGED, 48 * ENLARGED, 3), np.uint8)
        fill(canvas, bar_outlines_px(start[None], end[None], np.full((1, 2), 0.05))[0], [255.0] * 3)
        assert np.count_nonzero(canvas[:, :, 0]) / ENLARGED**2 / 24.0 < 0.6


def test_the_tip_of_a_needle_stays_near() -> None:
    needle = np.array([[[4.0, 20.0], [40.0, 24.0], [40.0, 28.0]], [[4.0, 20.0], [40.0, 20.0], [40.0, 20.0]]])
    assert np.abs(inset(needle) - needle).max() < 0.8


@pytest.mark.parametrize(("lamp", "channel"), [(RED, 0), (GREEN, 1)])
def test_the_lit_lamp_shines_where_it_hangs(lamp: int, channel: int) -> None:
    box = np.array([28.3, 9.7, 37.1, 34.9])
    canvas = np.zeros((48 * ENLARGED, 64 * ENLARGED, 3), np.uint8)
    paint_housing(canvas, box, 1.0, lamp, 0, NO_SUN, 1.0)
    bright = np.clip(
        cv2.resize(canvas, (64, 48), interpolation=cv2.INTER_AREA)[:, :, channel].astype(float) - 150.0, 0, None
    )
    center = [(bright.sum(axis=0) @ (np.arange(64) + 0.5)), (bright.sum(axis=1) @ (np.arange(48) + 0.5))] / bright.sum()
    assert center == pytest.approx(lamp_px(box, lamp)[0], abs=0.15)


def test_lights_seen_from_behind_show_no_lamp() -> None:
    canvas = np.zeros((96, 128, 3), np.uint8)
    paint_housing(canvas, np.array([20.0, 8.0, 32.0, 40.0]), -0.9, RED, 0, NO_SUN, 1.0)
    assert canvas.any()
    assert canvas.max() < 60


def test_boxes_are_where_the_dataset_projects_the_lights() -> None:
    images, lights = recording().dataset.images, recording().city.lights.position_in_world_m
    camera = colmap_camera(recording().dataset.cameras, 0)
    rotation = rotation_matrices(images)
    checked = 0
    for row in range(0, len(images), 101):
        housings = look(world(), row).housings
        of_lights = housings.light_row < len(lights)
        in_cam = lights[housings.light_row[of_lights]] @ rotation[row].T + images.cam_from_world_m[row]
        np.testing.assert_allclose(camera.img_from_cam(in_cam), housings.center_px[of_lights], atol=1e-6)
        checked += int(of_lights.sum())
    assert checked > 50


def test_lights_are_painted_where_the_boxes_are() -> None:
    """The part of the picture that changes with a light is its box, to a pixel and less on average."""
    errors = []
    for row in range(40, len(recording().frames), 60):
        scene = look(world(), row)
        if light_of_pass(int(recording().frames.pass_row[row]), seed=3).weather.name != "day":
            continue  # Elsewhere the glow around lamps is larger.
        for i in np.flatnonzero((scene.seen_share == 1.0) & (scene.housings.size_px[:, 1] > 9.0)):
            box = scene.housings.corners_px()[i]
            if np.any(box < 2.0) or np.any(box[2:] > [638.0, 478.0]):
                continue
            change = difference(scene, int(i))
            rows, columns = (np.flatnonzero((change > 25.0).any(axis=axis)) for axis in (1, 0))
            if len(rows):
                found = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
                errors.append((found[:2] + found[2:] - box[:2] - box[2:]) / 2.0)
    assert len(errors) > 8
    assert np.abs(np.mean(errors, axis=0)).max() < 0.4
    assert np.median(np.abs(errors)) < 0.5


# What hides what.


def test_lights_that_traffic_hides_are_not_in_the_picture() -> None:
    checked = 0
    for row in np.unique(recording().sightings.frame_row[recording().is_hidden])[::50]:
        scene = look(world(), int(row))
        shown, hidden = world().sightings_in(int(row))
        is_hidden = np.isin(scene.housings.light_row, shown.target_row[hidden])
        assert (scene.seen_share[is_hidden] < 0.05).all()
        i = int(np.flatnonzero(is_hidden)[0])
        change = difference(scene, i)[inside(scene.housings.corners_px()[i])]
        assert change.mean() < 4.0
        checked += 1
    assert checked > 5


def test_true_boxes_are_those_in_view_and_not_hidden() -> None:
    boxes = in_view = 0
    for row in range(0, len(recording().frames), 23):
        should, _ = true_boxes(world(), look(world(), row))
        shown, hidden = world().sightings_in(row)
        free = shown.take(~hidden)
        # Each is exactly one of the sightings that traffic leaves free; cars may hide a few more.
        place = np.concatenate([free.center_px, free.size_px], axis=1)
        assert all(np.isclose(place, box, atol=1e-6).all(axis=1).any() for box in should)
        boxes, in_view = boxes + len(should), in_view + len(free)
    assert boxes > 100
    assert boxes > 0.9 * in_view


def test_only_trucks_and_coaches_are_taller_than_the_camera() -> None:
    for row in range(0, len(recording().frames), 211):
        vehicles = look(world(), row).vehicles
        _, hidden = world().sightings_in(row)
        assert np.count_nonzero(vehicles.kind != CAR) == np.count_nonzero(hidden)


def test_cars_wait_at_red() -> None:
    frames = recording().frames
    still = np.flatnonzero((np.diff(frames.distance_m) < 1e-9) & (np.diff(frames.pass_row) == 0))
    lamps = []
    for row in still[::20]:
        scene = look(world(), int(row))
        ahead = frames.signal_ahead_m[row]
        near = (scene.housings.depth_m < ahead + 13.0) & (scene.housings.cos_facing > 0.9)
        lamps += world().signals.lamps(frames, int(row), world().approach[scene.housings.light_row[near]]).tolist()
    assert len(lamps) > 3
    assert set(lamps) == {RED}


# Pictures as a whole.


def test_pictures_depend_on_the_seed_alone() -> None:
    rows = [700, 5, 1900]
    first = list(render_pictures(recording(), rows=rows, threads=1))
    again = list(render_pictures(recording(), rows=rows, threads=3))
    assert [picture.row for picture in again] == rows
    for one, other in zip(first, again, strict=True):
        assert one.image.shape == (480, 640, 3)
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.boxes_px, other.boxes_px)
    alone = next(render_pictures(recording(), rows=[5]))
    np.testing.assert_array_equal(alone.image, first[1].image)


def test_all_weathers_come_and_nights_are_dark() -> None:
    weather = [light_of_pass(number, seed=8).weather.name for number in range(40)]
    assert {weather.count(kind.name) for kind in WEATHERS} == {10}
    brightness: dict[str, float] = {}
    frames = recording().frames
    for pass_row in np.unique(frames.pass_row)[:4]:
        row = int(np.flatnonzero(frames.pass_row == pass_row)[20])
        picture: Picture = next(render_pictures(recording(), rows=[row])).image
        brightness[light_of_pass(int(pass_row), seed=3).weather.name] = float(picture.mean())
    assert min(brightness, key=lambda name: brightness[name]) == "night"
    assert brightness["day"] > 2.0 * brightness["night"]


def test_cameras_of_any_size_and_lens_have_pictures() -> None:
    config = changed(
        image_width_px=203, image_height_px=101, focal_px=60.0, camera_pitch_deg=20.0, relief_m=8.0, light_width_m=0.9
    )
    odd = record_city(config, seed=1)
    for picture in render_pictures(odd, rows=range(0, len(odd.frames), 400)):
        assert picture.image.shape == (101, 203, 3)
        assert picture.image.std() > 5.0


def test_views_cut_off_what_is_behind_the_camera() -> None:
    view = View(np.eye(3), np.zeros(3), 100.0, 200, 100)
    ground = np.array([[[-1.0, 1.0, -5.0], [1.0, 1.0, -5.0], [1.0, 1.0, 10.0], [-1.0, 1.0, 10.0]]])
    (outline,) = view.outlines_px(ground)
    assert outline is not None
    assert outline[:, 1].min() == pytest.approx(60.0)  # 50 + 100 * 1 / 10
    assert outline[:, 1].max() > 100.0
    assert view.outlines_px(ground - [0.0, 0.0, 20.0]) == [None]


# On disk.


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, Path]:
    few = record_city(changed(passes_per_street=0, images=24, image_width_px=160, image_height_px=120), seed=2)
    folder = tmp_path_factory.mktemp("rendered") / "dataset"
    write_dataset(few.dataset, folder)
    told = Told()
    assert render_images(few, folder, progress=told) == 24
    told.check("rendering")
    return few, folder


def test_pictures_have_the_names_of_the_images(written: tuple[Recording, Path]) -> None:
    few, folder = written
    names = few.dataset.images.name.to_pylist()
    assert {path.relative_to(folder / "images").as_posix() for path in folder.rglob("*.jpg")} == set(names)
    picture = cv2.imread(str(folder / "images" / names[3]))
    assert picture is not None
    exact = next(render_pictures(few, rows=[3])).image[:, :, ::-1].astype(float)
    assert np.abs(picture - exact).mean() < 6.0


def test_an_interrupted_rendering_goes_on(written: tuple[Recording, Path]) -> None:
    few, folder = written

    def content() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != LEDGER}

    before = content()
    lost = sorted(folder.rglob("*.jpg"))[4:9]
    for path in lost:
        path.unlink()
    assert render_images(few, folder) == len(lost)
    assert content() == before


def test_true_boxes_are_written_as_labels(written: tuple[Recording, Path]) -> None:
    few, folder = written
    labels = read_labels(f"coco:{folder / 'boxes.json'}")
    assert labels.skipped == ()
    by_path = {picture.path: picture for picture in labels.pictures}
    for rendered in render_pictures(few):
        picture = by_path[folder / "images" / rendered.name]
        np.testing.assert_allclose(picture.boxes_px, rendered.boxes_px.reshape(-1, 4), atol=2e-3)
        assert len(picture.ignored_px) == len(rendered.ignored_px)
    names = {entry["name"] for entry in json.loads((folder / "boxes.json").read_text())["categories"]}
    assert names == set(few.dataset.detections.class_name.texts())
