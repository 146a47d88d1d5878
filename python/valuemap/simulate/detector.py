"""What the detector makes of things in view: misses, noisy boxes and scores."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.simulate.drives import Frames
from valuemap.simulate.rows import join_rows
from valuemap.simulate.sightings import Sightings, cut_boxes
from valuemap.simulate.streams import random_stream
from valuemap.simulate.targets import Targets, classes_in
from valuemap.tables import Table

KINDS = ("lights", "lookalikes", "temporary", "reflections", "clutter", "roadside")
"""What a box may show; also the names of their random numbers."""
TRUE_KINDS = ("lights", "roadside")
"""The kinds that a box shows rightly, in the order of the truth."""


_SCORE_OF_DOUBLE = 0.8
_HIDDEN_PARTS = (0.15, 0.6)
"""Least and largest share of a box that is hidden in part."""


@dataclass(frozen=True, eq=False)
class Boxes(Table):
    """Detected boxes: centres and sizes (N, 2) in pixels, scores (N).

    `kind` (N) is what a box shows, as index of KINDS; `thing_row` (N) numbers the things of a kind from 0, so that
    boxes of one thing have one number; `class_code` (N) is what the detector calls it; `is_cut` (N) says which
    boxes are of a part only, since the picture's edge or something before it hides the rest.
    """

    frame_row: Ints
    kind: Ints
    thing_row: Ints
    class_code: Ints
    center_px: Floats
    size_px: Floats
    score: Floats
    is_cut: Bools


def recall_of_passes(count: int, config: SimulationConfig, *, seed: int) -> Floats:
    """Return the recall (N) of each pass: beta distributed with the mean and deviation asked for."""
    mean = config.recall_mean
    if config.recall_sd == 0.0:
        return np.full(count, mean)
    strength = mean * (1.0 - mean) / config.recall_sd**2 - 1.0
    return random_stream(seed, "recall").beta(mean * strength, (1.0 - mean) * strength, count)


def detect(
    sightings: Sightings,
    targets: Targets,
    frames: Frames,
    pass_recall: Floats,
    config: SimulationConfig,
    *,
    seed: int,
    kind: str,
) -> Boxes:
    """Return what is detected of the targets in view, all of one of KINDS.

    The numbers are drawn for every view, detected or not, so that no setting reshuffles those of another.
    """
    count = len(sightings)
    true_center_px, true_size_px, is_cut = sightings.center_px, sightings.size_px, sightings.is_cut
    if config.partly_hidden_share:
        part = _hidden_part(sightings, frames, config, seed=seed, kind=kind)
        true_center_px, true_size_px = _without_part(true_center_px, true_size_px, part)
        is_cut = is_cut | np.any(part > 0.0, axis=1)
    height_px = true_size_px[:, 1]
    with np.errstate(divide="ignore"):  # Of a height of 0 px on, every box is large.
        quality = 1.0 - np.exp2(-((height_px / config.half_recall_height_px) ** 2))
    recall = pass_recall[frames.pass_row[sightings.frame_row]] * quality
    recall *= targets.recall_share[sightings.target_row]
    is_found = random_stream(seed, kind, "detect").random(count) < recall
    is_found &= ~hidden_by_traffic(sightings, frames, config, seed=seed, kind=kind)

    sigma_px = np.hypot(config.pixel_noise_px, config.pixel_noise_share * height_px)
    if config.tail_share:
        is_far_off = random_stream(seed, kind, "tails").random(count) < config.tail_share
        sigma_px = np.where(is_far_off, config.tail_factor, 1.0) * sigma_px
    error = random_stream(seed, kind, "center").standard_normal((count, 2))
    if config.noise_memory_images:
        error = _remembered(error, sightings, frames, config.noise_memory_images)
    shift_px = error * sigma_px[:, None]
    stretch = np.exp(config.size_noise * random_stream(seed, kind, "size").standard_normal((count, 2)))
    best = config.score_true if kind in TRUE_KINDS else (config.score_true + config.score_false) / 2.0
    score = config.score_false + (best - config.score_false) * quality
    boxes = Boxes(
        frame_row=sightings.frame_row,
        kind=np.full(count, KINDS.index(kind)),
        thing_row=sightings.target_row,
        class_code=_confuse(targets.class_code[sightings.target_row], config, seed=seed, kind=kind),
        center_px=inside_picture(true_center_px + shift_px, config),
        size_px=true_size_px * stretch,
        score=noisy_score(score, config, random_stream(seed, kind, "score")),
        is_cut=is_cut,
    )
    return report(boxes, is_found, config, random_stream(seed, kind, "double"))


def report(boxes: Boxes, is_found: Bools, config: SimulationConfig, random: np.random.Generator) -> Boxes:
    """Return the boxes that are found, some of them twice; none reaches out of the picture where that cuts boxes."""
    reported = boxes.take(is_found)
    if config.double_share:
        is_double, angle_rad = random.random((2, len(boxes)))
        angle_rad = 2.0 * np.pi * angle_rad
        apart_px = config.double_apart_px * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
        again = boxes.replace(
            center_px=inside_picture(boxes.center_px + apart_px, config), score=_SCORE_OF_DOUBLE * boxes.score
        )
        reported = join_rows([reported, again.take(is_found & (is_double < config.double_share))])
    if config.min_visible_share < 1.0:
        half_px = np.array([config.image_width_px, config.image_height_px]) / 2.0
        from_middle_px = reported.center_px - half_px
        low, high = cut_boxes(from_middle_px - reported.size_px / 2.0, from_middle_px + reported.size_px / 2.0, half_px)
        reported = reported.replace(center_px=half_px + (low + high) / 2.0, size_px=high - low)
    return reported


def _confuse(class_code: Ints, config: SimulationConfig, *, seed: int, kind: str) -> Ints:
    """Return what the detector calls objects (N): now and then another class that stands in the city."""
    if not config.class_confusion or kind not in TRUE_KINDS:
        return class_code
    classes = classes_in(config)
    is_wrong, other = random_stream(seed, kind, "confusion").random((2, len(class_code)))
    steps = 1 + np.floor(other * (len(classes) - 1)).astype(np.int64)
    wrong = classes[(np.searchsorted(classes, class_code) + steps) % len(classes)]
    return np.where(is_wrong < config.class_confusion, wrong, class_code)


def inside_picture(center_px: Floats, config: SimulationConfig) -> Floats:
    """Return centres (N, 2) moved to the nearest place in the picture."""
    return np.clip(center_px, 0.0, [config.image_width_px, config.image_height_px])


def noisy_score(mean: Floats, config: SimulationConfig, random: np.random.Generator) -> Floats:
    """Return scores (N) around means (N), cut to 0 and 1."""
    noisy: Floats = np.clip(mean + config.score_noise * random.standard_normal(len(mean)), 0.0, 1.0)
    return noisy


def hidden_by_traffic(sightings: Sightings, frames: Frames, config: SimulationConfig, *, seed: int, kind: str) -> Bools:
    """Return which views (N) of one kind of target traffic hides.

    From one view of a target to its next in the same pass, dt later, the state is drawn anew with probability
    1 - exp(-dt / occlusion_s), and else stays as it is.
    """
    return _states(sightings, frames, config, random_stream(seed, kind, "traffic")) < config.occluded_share


def _hidden_part(sightings: Sightings, frames: Frames, config: SimulationConfig, *, seed: int, kind: str) -> Floats:
    """Return which shares (N, 3) of the boxes of views are hidden from the left, from the right and from below.

    At most one of the three is more than 0. As with traffic, it stays for a while.
    """
    state = _states(sightings, frames, config, random_stream(seed, kind, "part")) / config.partly_hidden_share
    side, share = np.divmod(3.0 * state, 1.0)
    low, high = _HIDDEN_PARTS
    part: Floats = (low + (high - low) * share)[:, None] * (side[:, None] == np.arange(3))
    return part


def _without_part(center_px: Floats, size_px: Floats, part: Floats) -> tuple[Floats, Floats]:
    """Return centres and sizes (N, 2) of what is left of boxes without parts (N, 3) on the left, right and below."""
    left, right, below = part.T
    shift = np.stack([left - right, -below], axis=1) / 2.0
    return center_px + shift * size_px, size_px * np.stack([1.0 - left - right, 1.0 - below], axis=1)


def _remembered(error: Floats, sightings: Sightings, frames: Frames, images: float) -> Floats:
    """Return errors (N, 2) of views that forget 63 % of themselves over so many views of a target in a pass: AR(1)."""
    keep = math.exp(-1.0 / images)
    order, is_next = _views_of_passes(sightings, frames)
    remembered = error.copy()
    before = order[0] if len(order) else 0
    for row, goes_on in zip(order[1:].tolist(), is_next.tolist(), strict=True):
        if goes_on:
            remembered[row] = keep * remembered[before] + math.sqrt(1.0 - keep * keep) * error[row]
        before = row
    return remembered


def _views_of_passes(sightings: Sightings, frames: Frames) -> tuple[Ints, Bools]:
    """Return the rows (N) of views by pass, target and time, and whether each but the first goes on from the last."""
    pass_row = frames.pass_row[sightings.frame_row]
    order = np.lexsort((sightings.frame_row, sightings.target_row, pass_row))
    return order, (np.diff(pass_row[order]) == 0) & (np.diff(sightings.target_row[order]) == 0)


def _states(sightings: Sightings, frames: Frames, config: SimulationConfig, random: np.random.Generator) -> Floats:
    """Return a uniform random number (N) for each view, which stays for a while from a target's view to the next."""
    order, is_next = _views_of_passes(sightings, frames)
    time_s = frames.time_s[sightings.frame_row]
    redraw, state = random.random((len(order), 2)).T
    with np.errstate(divide="ignore", invalid="ignore"):  # A time of 0 s draws anew for every view.
        stays = np.exp(-np.abs(np.diff(time_s[order])) / config.occlusion_s)
    is_anew = np.ones(len(order), dtype=np.bool_)
    is_anew[1:] = ~is_next | (redraw[1:] >= stays)
    drawn_at = np.maximum.accumulate(np.where(is_anew, np.arange(len(order)), 0))
    of_view = np.empty(len(order))
    of_view[order] = state[drawn_at]
    return of_view
