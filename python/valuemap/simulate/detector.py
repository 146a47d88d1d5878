"""What the detector makes of things in view: misses, noisy boxes and scores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.config import SimulationConfig
from valuemap.simulate.drives import Frames
from valuemap.simulate.sightings import Sightings
from valuemap.simulate.streams import random_stream
from valuemap.simulate.targets import Targets
from valuemap.tables import Bools, Floats, Ints, Table

KINDS = ("lights", "lookalikes", "temporary", "reflections", "clutter", "roadside")
"""What a box may show; also the names of their random numbers."""
TRUE_KINDS = ("lights", "roadside")
"""The kinds that a box shows rightly, in the order of the truth."""


@dataclass(frozen=True, eq=False)
class Boxes(Table):
    """Detected boxes: centres and sizes (N, 2) in pixels, scores (N).

    `kind` (N) is what a box shows, as index of KINDS; `thing_row` (N) numbers the things of a kind from 0, so that
    boxes of one thing have one number; `class_code` (N) is what the detector calls it.
    """

    frame_row: Ints
    kind: Ints
    thing_row: Ints
    class_code: Ints
    center_px: Floats
    size_px: Floats
    score: Floats


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
    height_px = sightings.size_px[:, 1]
    with np.errstate(divide="ignore"):  # Of a height of 0 px on, every box is large.
        quality = 1.0 - np.exp2(-((height_px / config.half_recall_height_px) ** 2))
    recall = pass_recall[frames.pass_row[sightings.frame_row]] * quality
    recall *= targets.recall_share[sightings.target_row]
    is_found = random_stream(seed, kind, "detect").random(count) < recall
    is_found &= ~hidden_by_traffic(sightings, frames, config, seed=seed, kind=kind)

    sigma_px = np.hypot(config.pixel_noise_px, config.pixel_noise_share * height_px)
    shift_px = random_stream(seed, kind, "center").standard_normal((count, 2)) * sigma_px[:, None]
    stretch = np.exp(config.size_noise * random_stream(seed, kind, "size").standard_normal((count, 2)))
    best = config.score_true if kind in TRUE_KINDS else (config.score_true + config.score_false) / 2.0
    score = config.score_false + (best - config.score_false) * quality
    boxes = Boxes(
        frame_row=sightings.frame_row,
        kind=np.full(count, KINDS.index(kind)),
        thing_row=sightings.target_row,
        class_code=targets.class_code[sightings.target_row],
        center_px=inside_picture(sightings.center_px + shift_px, config),
        size_px=sightings.size_px * stretch,
        score=noisy_score(score, config, random_stream(seed, kind, "score")),
    )
    return boxes.take(is_found)


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
    pass_row, time_s = frames.pass_row[sightings.frame_row], frames.time_s[sightings.frame_row]
    order = np.lexsort((sightings.frame_row, sightings.target_row, pass_row))
    redraw, state = random_stream(seed, kind, "traffic").random((len(order), 2)).T
    is_next = (np.diff(pass_row[order]) == 0) & (np.diff(sightings.target_row[order]) == 0)
    with np.errstate(divide="ignore", invalid="ignore"):  # A time of 0 s draws anew for every view.
        stays = np.exp(-np.abs(np.diff(time_s[order])) / config.occlusion_s)
    is_anew = np.ones(len(order), dtype=np.bool_)
    is_anew[1:] = ~is_next | (redraw[1:] >= stays)
    drawn_at = np.maximum.accumulate(np.where(is_anew, np.arange(len(order)), 0))
    is_hidden = np.empty(len(order), dtype=np.bool_)
    is_hidden[order] = (state < config.occluded_share)[drawn_at]
    return is_hidden
