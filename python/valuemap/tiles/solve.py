"""The labels of one cell, from its piece alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valuemap.arrays import Bools, Ints
from valuemap.config import MapConfig
from valuemap.dataset import number_passes
from valuemap.describe import describe_labels
from valuemap.drives import InOrder
from valuemap.progress import Progress, counted, silent
from valuemap.robust import Calibration, Scene, find_labels, steps_of_labels
from valuemap.sightings import cast_sightings
from valuemap.tables import Labels, Votes
from valuemap.tables.candidates import Candidates
from valuemap.tiles.dense import groups_of_drives, join_groups
from valuemap.tiles.grid import Cell, Grid
from valuemap.tiles.piece import piece_of_rows


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
    groups = groups_of_drives(piece, grid.most_detections)
    if len(groups) == 1:
        scene = Scene(piece.dataset, piece.drives, rays, config.vote.unit_m)
        found, counts = find_labels(scene, calibration, config, threads=threads, progress=progress)
    else:
        found, counts = _by_groups(piece, groups, calibration, config, threads, progress)
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


def _by_groups(
    piece: InOrder,
    groups: list[Ints],
    calibration: Calibration,
    config: MapConfig,
    threads: int,
    progress: Progress,
) -> tuple[Candidates, dict[str, Any]]:
    """Find the labels of a piece that is too dense to be solved at once, some drives at a time."""
    found, counts = [], []
    steps = steps_of_labels(calibration)
    with counted(progress, "finding labels", steps * len(groups)) as tell:
        for number, rows in enumerate(groups):
            part = piece_of_rows(piece, rows)
            detection_row = np.flatnonzero(np.isin(piece.dataset.detections.image_id, rows))
            scene = Scene(part.dataset, part.drives, cast_sightings(part.dataset)[0], config.vote.unit_m)

            def go_on(_what: str, done: int, _total: int, before: int = steps * number) -> None:
                tell(before + done)

            of_group, of_counts = find_labels(scene, calibration, config, threads=threads, progress=go_on)
            found.append(replace(of_group, voters=detection_row[of_group.voters].astype(np.uint32)))
            counts.append({"images": len(rows), **of_counts})
    joined, left_out = join_groups(found)
    return joined, {**summed(counts), "dense_groups": len(groups), "labels_of_few_groups": left_out}


def summed(counts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return counts of parts as one: sums of whole numbers and of the energy, means of the rest by their images.

    What only some parts counted is 0 in the others.
    """
    images = np.array([part["images"] for part in counts], np.float64)
    totals: dict[str, Any] = {}
    for name in dict.fromkeys(name for part in counts for name in part if name != "images"):
        values = [part.get(name, 0) for part in counts]
        if name == "energy" or all(isinstance(value, int) for value in values):
            totals[name] = sum(values)
        else:
            totals[name] = float(np.average(values, weights=images))
    return totals
