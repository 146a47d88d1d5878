"""What the detector takes for lights and is none: clutter, reflections in the car, lamps of other vehicles.

Lookalikes, which stay, belong to the city.
"""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats, rows_in_runs
from valuemap.config import SimulationConfig
from valuemap.simulate.detector import KINDS, Boxes, inside_picture, noisy_score, report
from valuemap.simulate.drives import Frames
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import Streets
from valuemap.simulate.targets import Targets, class_of_false

_BOX_HEIGHT_PX = (6.0, 40.0)
_BOX_ASPECT = 0.4
_REFLECTION_RECALL = 0.8
_REFLECTION_JITTER_PX = 1.0
_TEMPORARY_AHEAD_M = (12.0, 45.0)
_TEMPORARY_RIGHT_M = (-7.0, 4.0)
_TEMPORARY_ABOVE_M = (0.8, 3.0)


def clutter(frames: Frames, config: SimulationConfig, *, seed: int) -> Boxes:
    """Return false boxes that have nothing to do with each other."""
    counts = random_stream(seed, "clutter").poisson(config.clutter_per_image, len(frames))
    frame_row = np.repeat(np.arange(len(frames)), counts)
    center_px, size_px = _false_boxes(random_stream(seed, "clutter", "place").random((len(frame_row), 3)), config)
    score = np.full(len(frame_row), config.score_false)
    boxes = Boxes(
        frame_row=frame_row,
        kind=np.full(len(frame_row), KINDS.index("clutter")),
        thing_row=np.arange(len(frame_row)),
        class_code=class_of_false(len(frame_row), config, seed=seed, kind="clutter"),
        center_px=center_px,
        size_px=size_px,
        score=noisy_score(score, config, random_stream(seed, "clutter", "score")),
        is_cut=np.zeros(len(frame_row), dtype=np.bool_),
    )
    return report(boxes, np.ones(len(boxes), dtype=np.bool_), config, random_stream(seed, "clutter", "double"))


def reflect(frames: Frames, config: SimulationConfig, *, seed: int) -> Boxes:
    """Return false boxes fixed to the car: at one place of the picture of one camera for a stretch of one pass."""
    parts: list[Boxes] = []
    for camera in range(config.cameras):
        rows = np.flatnonzero(frames.camera_row == camera)
        boxes = _reflect_in_camera(frames.take(rows), config, seed, *([camera] if camera else []))
        parts.append(boxes.replace(frame_row=rows[boxes.frame_row], thing_row=boxes.thing_row + _things(parts)))
    return join_rows(parts)


def _things(parts: list[Boxes]) -> int:
    return max((int(part.thing_row.max(initial=-1)) + 1 for part in parts), default=0)


def _reflect_in_camera(frames: Frames, config: SimulationConfig, seed: int, *camera: int) -> Boxes:
    chance = random_stream(seed, "reflections", *camera).random(len(frames))
    first = np.flatnonzero(chance < config.reflections_per_1000_images / 1000.0)
    draw = random_stream(seed, "reflections", *camera, "place").random((len(first), 4))
    length = 1 + np.floor(draw[:, 0] * (2.0 * config.reflection_images - 1.0)).astype(np.int64)
    end_of_pass = np.searchsorted(frames.pass_row, frames.pass_row[first], side="right")
    length = np.minimum(length, end_of_pass - first)
    center_px, size_px = _false_boxes(draw[:, 1:], config)

    of_box = np.repeat(np.arange(len(first)), length)
    count = len(of_box)
    frame_row = rows_in_runs(first, length)
    normal = random_stream(seed, "reflections", *camera, "center").standard_normal((count, 2))
    score = np.full(count, config.score_false)
    boxes = Boxes(
        frame_row=frame_row,
        kind=np.full(count, KINDS.index("reflections")),
        thing_row=of_box,
        class_code=class_of_false(len(first), config, seed=seed, kind="reflections")[of_box],
        center_px=inside_picture(center_px[of_box] + _REFLECTION_JITTER_PX * normal, config),
        size_px=size_px[of_box],
        score=noisy_score(score, config, random_stream(seed, "reflections", *camera, "score")),
        is_cut=np.zeros(count, dtype=np.bool_),
    )
    is_found = random_stream(seed, "reflections", *camera, "detect").random(count) < _REFLECTION_RECALL
    return report(boxes, is_found, config, random_stream(seed, "reflections", *camera, "double"))


def place_temporary(frames: Frames, streets: Streets, config: SimulationConfig, *, seed: int) -> Targets:
    """Return lamps of other vehicles: in front of images drawn at random, met by their pass only."""
    chance = random_stream(seed, "temporary").random(len(frames))
    near = np.flatnonzero(chance < config.temporary_per_1000_images / 1000.0)
    count = len(near)
    heading_rad = frames.heading_rad[near]
    ahead = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=1)
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    draw = random_stream(seed, "temporary", "place").random((count, 3))
    low, high = np.transpose([_TEMPORARY_AHEAD_M, _TEMPORARY_RIGHT_M, _TEMPORARY_ABOVE_M])
    place_m = low + (high - low) * draw
    ground = frames.center_in_world_m[near, :2] + place_m[:, :1] * ahead + place_m[:, 1:2] * right
    return Targets(
        position_in_world_m=np.column_stack([ground, streets.hills.height_m(ground) + place_m[:, 2]]),
        facing_rad=heading_rad + np.pi,
        size_m=np.broadcast_to([config.light_width_m, config.light_height_m], (count, 2)),
        recall_share=np.full(count, config.temporary_recall),
        pass_row=frames.pass_row[near],
        class_code=class_of_false(count, config, seed=seed, kind="temporary"),
        is_round=np.zeros(count, dtype=np.bool_),
        uneven_m=np.zeros((count, 4)),
    )


def _false_boxes(draw: Floats, config: SimulationConfig) -> tuple[Floats, Floats]:
    """Return centres and sizes (N, 2) in pixels from uniform numbers (N, 3): anywhere, more small than large."""
    low, high = np.log(_BOX_HEIGHT_PX)
    height_px = np.exp(low + (high - low) * draw[:, 2])
    center_px = draw[:, :2] * [config.image_width_px, config.image_height_px]
    return center_px, np.stack([_BOX_ASPECT * height_px, height_px], axis=1)
