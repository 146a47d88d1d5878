"""The labels of one cell, from its piece alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valuemap.config import MapConfig
from valuemap.dataset import number_passes
from valuemap.describe import describe_labels
from valuemap.drives import InOrder
from valuemap.progress import Progress, silent
from valuemap.robust import Calibration, Scene, find_labels
from valuemap.sightings import cast_sightings
from valuemap.tables import Bools, Ints, Labels, Votes
from valuemap.tiles.grid import Cell, Grid


@dataclass(frozen=True, eq=False)
class Solved:
    """The labels (N) of a cell and those around it, which `is_own` (N) tells apart, with their votes (V).

    Labels are numbered from 1; votes have the ids that detections and images have in the dataset, and `vote_pass` (V)
    numbers the passes of the piece.
    """

    cell: Cell
    labels: Labels
    is_own: Bools
    votes: Votes
    vote_pass: Ints
    counts: dict[str, Any]


def solve_cell(
    piece: InOrder,
    cell: Cell,
    grid: Grid,
    calibration: Calibration,
    config: MapConfig,
    *,
    threads: int = 0,
    progress: Progress = silent,
) -> Solved:
    """Find the labels of a cell in its piece; the piece has at least one image."""
    rays, is_double = cast_sightings(piece.dataset)
    scene = Scene(piece.dataset, piece.drives, rays)
    found, counts = find_labels(scene, calibration, config, threads=threads, progress=progress)
    ground_m = grid.on_ground(found.position_in_world_m)
    found = found.take(np.flatnonzero(grid.is_within(cell, ground_m, grid.margin_m)))
    labels, votes = describe_labels(piece.dataset, rays, found, config.noise)
    counts = {
        "images": len(piece.image_id),
        "detections_double": int(is_double.sum()),
        "detections_without_ray": int((np.isnan(rays.direction_in_world[:, 0]) & ~is_double).sum()),
        **counts,
    }
    return Solved(
        cell=cell,
        labels=labels,
        is_own=grid.is_within(cell, grid.on_ground(labels.position_in_world_m)),
        votes=replace(
            votes,
            detection_id=piece.detection_id[votes.detection_id],
            image_id=piece.image_id[votes.image_id],
        ),
        vote_pass=number_passes(piece.dataset.images)[votes.image_id],
        counts=counts,
    )
