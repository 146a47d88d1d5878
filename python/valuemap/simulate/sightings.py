"""What the cameras can see: which targets stand in which pictures, and where exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.progress import Progress, counted
from valuemap.simulate.drives import Frames
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streets import Streets
from valuemap.simulate.targets import Targets
from valuemap.tables import Table

_CHUNK_FRAMES = 50_000
_NEAREST_M = 1.0
_ROUNDS_OF_ROWS = 4
"""The row tells the time, the time the row: what is off falls each round to the share of the picture that passes."""
NARROWEST = 0.3
"""A light seen from the side still looks this wide, as share of its width: it has visors."""


@dataclass(frozen=True, eq=False)
class Sightings(Table):
    """Targets in view, sorted by frame, then target: rows (N) of both, true centre and size (N, 2) in pixels.

    Where the picture's edge cuts off a part, `is_cut` (N), they are those of the rest.
    """

    frame_row: Ints
    target_row: Ints
    center_px: Floats
    size_px: Floats
    is_cut: Bools


class Look(Protocol):
    """How a kind of camera sees targets: `see` with a pinhole."""

    def __call__(
        self,
        targets: Targets,
        frames: Frames,
        streets: Streets,
        config: SimulationConfig,
        *,
        progress: Progress,
        what: str,
    ) -> Sightings:
        """Return all views of targets."""


def see(
    targets: Targets,
    frames: Frames,
    streets: Streets,
    config: SimulationConfig,
    *,
    progress: Progress,
    what: str,
) -> Sightings:
    """Return all views of targets: near enough, inside the picture, facing the camera, no house between."""
    chunks = []
    with counted(progress, what, len(frames)) as tell:
        for start in range(0, len(frames), _CHUNK_FRAMES):
            rows = np.arange(start, min(start + _CHUNK_FRAMES, len(frames)))
            seen = _see_in_chunk(targets, frames.take(rows), streets, config)
            chunks.append(seen.replace(frame_row=seen.frame_row + start))
            tell(int(rows[-1]) + 1)
    return join_rows(chunks)


def _see_in_chunk(targets: Targets, frames: Frames, streets: Streets, config: SimulationConfig) -> Sightings:
    frame_row, target_row = _pairs_within(frames, targets, config.max_sight_m)
    center, position = frames.center_in_world_m[frame_row], targets.position_in_world_m[target_row]
    to_target = position - center
    turn = np.where(targets.is_round[target_row], 1.0, cos_facing(to_target, targets.facing_rad[target_row]))
    if config.side_offset_m:
        to_target = to_target + _offset_of_side(to_target, targets.uneven_m[target_row])
    picture_px = np.array([config.image_width_px, config.image_height_px])
    in_cam = np.einsum("nij,nj->ni", frames.cam_from_world()[frame_row], to_target)
    for _ in range(_ROUNDS_OF_ROWS if config.readout_s else 0):
        in_cam = _at_its_row(in_cam, to_target, frames, frame_row, config)
    depth_m = np.maximum(in_cam[:, 2:], _NEAREST_M)
    from_middle_px = config.focal_px * in_cam[:, :2] / depth_m
    size_px = config.focal_px * targets.size_m[target_row] / depth_m
    size_px[:, 0] *= np.maximum(turn, NARROWEST)
    only_pass = targets.pass_row[target_row]
    seen = (
        ((only_pass < 0) | (only_pass == frames.pass_row[frame_row]))
        & (in_cam[:, 2] > _NEAREST_M)
        & (turn >= np.cos(np.radians(config.max_facing_deg)))
        & (size_px[:, 1] >= config.min_box_height_px)
    )
    is_whole = np.all(np.abs(from_middle_px) <= (picture_px - size_px) / 2.0, axis=1)
    if config.min_visible_share < 1.0:
        low, high = cut_boxes(from_middle_px - size_px / 2.0, from_middle_px + size_px / 2.0, picture_px / 2.0)
        is_left = np.prod(high - low, axis=1) >= config.min_visible_share * np.prod(size_px, axis=1)
        seen &= is_whole | (is_left & ((high - low)[:, 1] >= config.min_box_height_px))
        from_middle_px = np.where(is_whole[:, None], from_middle_px, (low + high) / 2.0)
        size_px = np.where(is_whole[:, None], size_px, high - low)
    else:
        seen &= is_whole
    rows = np.flatnonzero(seen)
    rows = rows[~streets.is_hidden_by_houses(center[rows, :2], position[rows, :2])]
    rows = rows[np.lexsort((target_row[rows], frame_row[rows]))]
    center_px = picture_px / 2.0 + from_middle_px[rows]
    return Sightings(frame_row[rows], target_row[rows], center_px, size_px[rows], ~is_whole[rows])


def _at_its_row(in_cam: Floats, to_target: Floats, frames: Frames, frame_row: Ints, config: SimulationConfig) -> Floats:
    """Return targets (N, 3) in camera axes when the row is exposed on which they are seen as they were (N, 3)."""
    height_px = config.focal_px * in_cam[:, 1] / np.maximum(in_cam[:, 2], _NEAREST_M)
    share = np.clip(height_px / config.image_height_px, -0.5, 0.5)
    away = to_target - share[:, None] * frames.readout_m[frame_row]
    # The camera has turned left: what it sees has turned right.
    turned_rad = -share * frames.readout_rad[frame_row]
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    away = np.stack([cos * away[:, 0] - sin * away[:, 1], sin * away[:, 0] + cos * away[:, 1], away[:, 2]], axis=1)
    return np.asarray(np.einsum("nij,nj->ni", frames.cam_from_world()[frame_row], away))


def _offset_of_side(to_target: Floats, uneven_m: Floats) -> Floats:
    """Return how far (N, 3) the middle of what a camera sees is off the target's centre: sideways and up.

    An offset that goes once round with the direction from which one looks would only be another centre; sideways it
    goes twice round.
    """
    angle_rad = np.arctan2(to_target[:, 1], to_target[:, 0])
    to_the_right = np.stack([np.sin(angle_rad), -np.cos(angle_rad), np.zeros(len(angle_rad))], axis=1)
    aside_m = uneven_m[:, 0] * np.cos(2.0 * angle_rad) + uneven_m[:, 1] * np.sin(2.0 * angle_rad)
    above_m = uneven_m[:, 2] * np.cos(angle_rad) + uneven_m[:, 3] * np.sin(angle_rad)
    offset: Floats = aside_m[:, None] * to_the_right
    offset[:, 2] = above_m
    return offset


def cut_boxes(low_px: Floats, high_px: Floats, half_picture_px: Floats) -> tuple[Floats, Floats]:
    """Return what of boxes from low to high (N, 2), in px from the middle of the picture, is in it."""
    return np.clip(low_px, -half_picture_px, half_picture_px), np.clip(high_px, -half_picture_px, half_picture_px)


def cos_facing(to_target: Floats, facing_rad: Floats) -> Floats:
    """Return the cosine (N), on the ground, between where targets face and where the camera is from them."""
    along = to_target[:, 0] * np.cos(facing_rad) + to_target[:, 1] * np.sin(facing_rad)
    cosine: Floats = -along / np.maximum(np.hypot(to_target[:, 0], to_target[:, 1]), 1e-9)
    return cosine


def _pairs_within(frames: Frames, targets: Targets, radius_m: float) -> tuple[Ints, Ints]:
    """Return the rows (frame, target) of all pairs closer than a radius on the ground."""
    if len(targets) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    trees = [cKDTree(points[:, :2]) for points in (frames.center_in_world_m, targets.position_in_world_m)]
    pairs = trees[0].sparse_distance_matrix(trees[1], radius_m, output_type="ndarray")
    return pairs["i"].astype(np.int64), pairs["j"].astype(np.int64)
