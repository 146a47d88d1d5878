"""The labels of all cells as one map: what lies across borders becomes one, and each detection votes once.

A label belongs to the cell that it lies in. Cells also return the labels just beyond their borders, their guests, since
two cells may disagree about an object there: each solved another part of its surroundings.

- Labels of different cells are one object if they share at least half of the votes of one of them.
- Of one object that several cells have in themselves, the label with most votes is kept.
- An object that each cell places in the other is a guest of both, and at home nowhere: again the one with most votes is
  kept. A guest that the cell where it lies does not know is not: that cell sees the place better.
- A detection that votes for two objects votes for the one with more votes.

Ties go to the lower cell, then to the order of labels in it, so that all this depends on data only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from valuemap.arrays import Bools, Ints
from valuemap.config import MapConfig
from valuemap.describe import residual_sigma_px
from valuemap.tables import Labels, Votes
from valuemap.tables.table import join_tables
from valuemap.tiles.grid import Grid, numbered
from valuemap.tiles.solve import Solved, summed

_SAME_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class _Rows:
    """The labels (N) of all cells one after the other, and their votes (V); `home` (N) is the cell they lie in."""

    cell: Ints
    home: Ints
    votes: Ints
    label_of_vote: Ints
    detection_id: Ints

    @property
    def is_own(self) -> Bools:
        """Which labels (N) lie in the cell that found them."""
        return np.asarray(self.home == self.cell)

    @cached_property
    def of_several(self) -> Ints:
        """The votes (rows) by detections that vote more than once: few, and nothing is to be decided of the others."""
        number = numbered(self.detection_id - self.detection_id.min(initial=0))[1]
        return np.flatnonzero(np.bincount(number)[number] > 1)


def join_cells(solved: Sequence[Solved], grid: Grid, config: MapConfig) -> tuple[Labels, Votes, dict[str, Any]]:
    """Return the map of cells, ascending, its votes, and counts; labels are numbered from 1, cell by cell."""
    sizes = np.array([len(cell.labels) for cell in solved])
    before = np.cumsum(sizes) - sizes
    labels = join_tables([cell.labels for cell in solved])
    votes = join_tables([cell.votes for cell in solved])
    cells = np.repeat(np.arange(len(solved)), sizes)
    home = np.where(np.concatenate([cell.is_own for cell in solved]), cells, -1)
    guests = np.flatnonzero(home < 0)
    home[guests] = grid.find(grid.on_ground(labels.position_in_world_m[guests]), [cell.cell for cell in solved])
    rows = _Rows(
        cell=cells,
        home=home,
        votes=labels.votes,
        label_of_vote=votes.label_id - 1 + np.repeat(before, [len(cell.votes) for cell in solved]),
        detection_id=votes.detection_id,
    )
    is_kept, has_vote, counts = _decide(rows, config.vote.min_votes)
    vote_pass = np.concatenate([cell.vote_pass for cell in solved])
    has_vote &= is_kept[rows.label_of_vote]
    lost = np.bincount(rows.label_of_vote[~has_vote], minlength=len(labels)) > 0
    new_id = np.cumsum(is_kept)
    if (lost & is_kept).any():
        labels = _recounted(labels, np.flatnonzero(lost & is_kept), rows.label_of_vote, vote_pass, votes, has_vote)
    labels = labels.take(np.flatnonzero(is_kept)).replace(label_id=np.arange(1, int(is_kept.sum()) + 1))
    votes = votes.take(np.flatnonzero(has_vote))
    votes = votes.replace(label_id=new_id[rows.label_of_vote[has_vote]])
    sigma_px = config.noise.detection_sigma_px or residual_sigma_px(votes.residual_px, len(labels))
    votes = votes.replace(residual_sigmas=votes.residual_px / sigma_px)
    return labels, votes, {**_totals(solved), **(counts if len(solved) > 1 else {})}


def _decide(rows: _Rows, min_votes: int) -> tuple[Bools, Bools, dict[str, int]]:
    """Return which labels (N) are kept and which votes (V) count, and what was decided how often."""
    is_own = rows.is_own
    is_kept = is_own.copy()
    has_vote = np.ones(len(rows.detection_id), np.bool_)
    shared = _shared(rows)
    order = np.lexsort((np.arange(len(rows.votes)), -rows.votes, ~is_own))
    disputed = np.flatnonzero(np.bincount(shared[:, 0], minlength=len(rows.votes)))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    is_one = 1.0 * shared[:, 2] >= _SAME_SHARE * np.minimum(rows.votes[shared[:, 0]], rows.votes[shared[:, 1]])
    same: dict[int, list[int]] = {}
    for label, other in shared[is_one, :2].tolist():
        same.setdefault(label, []).append(other)
    counts = {"labels_of_two_cells": 0, "labels_at_home_nowhere": 0}
    for label in disputed[np.argsort(rank[disputed])].tolist():
        others = same.get(label, [])
        taken = any(is_kept[other] and rank[other] < rank[label] for other in others)
        if is_own[label]:
            is_kept[label] = not taken
            counts["labels_of_two_cells"] += taken
        elif not taken and any(rows.cell[other] == rows.home[label] for other in others):
            is_kept[label] = True
            counts["labels_at_home_nowhere"] += 1
    # Each detection votes for the first of those that are kept.
    vote = rows.of_several[is_kept[rows.label_of_vote[rows.of_several]]]
    vote = vote[np.lexsort((rank[rows.label_of_vote[vote]], rows.detection_id[vote]))]
    again = np.flatnonzero(np.diff(rows.detection_id[vote]) == 0) + 1
    has_vote[vote[again]] = False
    counts["votes_of_two_labels"] = len(again)
    left = np.bincount(rows.label_of_vote[has_vote], minlength=len(is_kept))
    outvoted = is_kept & (left < np.minimum(rows.votes, min_votes))
    counts["labels_outvoted_at_seams"] = int(outvoted.sum())
    return is_kept & ~outvoted, has_vote, counts


def _shared(rows: _Rows) -> Ints:
    """Return (label, other label, detections that vote for both) of all pairs, in both orders (P, 3)."""
    vote = rows.of_several
    vote = vote[np.lexsort((rows.label_of_vote[vote], rows.detection_id[vote]))]
    label, detection = rows.label_of_vote[vote], rows.detection_id[vote]
    pairs = [np.empty(0, np.int64)]
    for step in range(1, len(vote)):
        near = np.flatnonzero(detection[step:] == detection[:-step])
        if not len(near):
            break
        pairs.append(label[near] * len(rows.votes) + label[near + step])
    keys, count = np.unique(np.concatenate(pairs), return_counts=True)
    pair = np.stack(np.divmod(keys, max(len(rows.votes), 1)), axis=1)
    both = np.concatenate([pair, pair[:, ::-1]])
    return np.column_stack([both, np.concatenate([count, count])])


def _recounted(
    labels: Labels, changed: Ints, label_of_vote: Ints, vote_pass: Ints, votes: Votes, has_vote: Bools
) -> Labels:
    """Return the labels with what is counted over votes counted anew where votes went to another label."""
    count, passes, rms = labels.votes.copy(), labels.passes.copy(), labels.reprojection_rms_px.copy()
    order = np.argsort(label_of_vote, kind="stable")
    first, end = (np.searchsorted(label_of_vote[order], changed, side=side) for side in ("left", "right"))
    for label, begin, stop in zip(changed.tolist(), first.tolist(), end.tolist(), strict=True):
        members = order[begin:stop]
        members = members[has_vote[members]]
        count[label] = len(members)
        passes[label] = len(np.unique(vote_pass[members]))
        rms[label] = np.sqrt(np.mean(votes.residual_px[members] ** 2)) if len(members) else 0.0
    return labels.replace(votes=count, passes=passes, reprojection_rms_px=rms)


def _totals(solved: Sequence[Solved]) -> dict[str, Any]:
    """Return counts of all cells: sums of whole numbers and of the energy, means of the rest by number of images."""
    if len(solved) == 1:
        return {name: value for name, value in solved[0].counts.items() if name != "images"}
    images = sum(cell.counts["images"] for cell in solved)
    return {"cells": len(solved), "images_in_cells": images, **summed([cell.counts for cell in solved])}
