"""A place so dense that its smallest square is too much at once: solved by some drives at a time, and made one map.

Each group of drives is an independent survey of the place. Labels of different groups that are of one class and within
their covariances of each other are one object; its position is their mean, weighted by information, as drives share no
pose errors. An object that stands there is found by most groups: what fewer than half of them find is left out, so that
the false labels of many surveys do not add up.
"""

from __future__ import annotations

import math

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.drives import InOrder
from valuemap.nearby import ONE_PLACE_CHI2
from valuemap.tables.candidates import Candidates

_LEAST_SHARE = 0.5


def groups_of_drives(piece: InOrder, most_detections: int) -> list[Ints]:
    """Return the images (rows) of each group: whole drives, no more detections than that in each group.

    A drive that alone has more is cut into parts. Where all fits, there is one group.
    """
    count = np.bincount(piece.dataset.detections.image_id, minlength=len(piece.image_id))
    groups = max(1, math.ceil(count.sum() / most_detections))
    if groups == 1:
        return [np.arange(len(count))]
    # Parts of drives, in driving order: a new one begins where a drive does, or has had enough.
    first = np.searchsorted(piece.drives.pass_code, piece.drives.pass_code)
    before = np.concatenate([[0], np.cumsum(count)])
    share = max(1, most_detections // 2)
    part_in_drive = (before[:-1] - before[first]) // share
    begins = np.concatenate([[True], (np.diff(first) != 0) | (np.diff(part_in_drive) != 0)])
    part = np.cumsum(begins) - 1
    size = np.bincount(part, count).astype(np.int64)
    # Drives of one day are alike: they are dealt out in turn, to whoever has least.
    load: list[int] = []
    of_part = np.empty(len(size), np.int64)
    for number, detections in enumerate(size.tolist()):
        fits = [group for group, has in enumerate(load) if has + detections <= most_detections]
        if len(load) < groups or not fits:
            fits = [len(load)]
            load.append(0)
        of_part[number] = min(fits, key=load.__getitem__)
        load[of_part[number]] += detections
    of_image = of_part[part]
    return [np.flatnonzero(of_image == group) for group in range(len(load))]


def join_groups(found: list[Candidates]) -> tuple[Candidates, int]:
    """Return the labels of groups as one map, by their first detections, and how many were left out.

    The voters of all groups are rows of the same detections; covariances, existences, expected votes and classes must
    be there.
    """
    position = np.concatenate([group.position_in_world_m for group in found])
    names = ("covariance_m2", "existence", "expected", "class_code")
    columns = {name: np.concatenate([getattr(group, name) for group in found]) for name in names}
    covariance, existence, expected, code = columns.values()
    information = np.linalg.inv(covariance) if len(covariance) else covariance
    voters = [
        group.voters[a:b] for group in found for a, b in zip(group.voter_offsets, group.voter_offsets[1:], strict=False)
    ]
    objects: list[list[int]] = []
    first = 0
    for group in found:
        rows = np.arange(first, first + len(group))
        first += len(group)
        pairs = sorted(
            (apart, number, row)
            for number, members in enumerate(objects)
            for apart, row in _near(members, rows, position, information, covariance, code)
        )
        taken: set[int] = set()
        joined: set[int] = set()
        for _, number, row in pairs:
            if row not in taken and number not in joined:
                objects[number].append(row)
                taken.add(row)
                joined.add(number)
        objects += [[row] for row in rows.tolist() if row not in taken]
    least = _LEAST_SHARE * len(found)
    kept = [members for members in objects if len(members) >= least]
    votes = [np.unique(np.concatenate([voters[row] for row in members])) for members in kept]
    order = sorted(range(len(kept)), key=lambda i: int(votes[i][0]))
    kept, votes = [kept[i] for i in order], [votes[i] for i in order]
    mean, spread = zip(*(_mean(position[rows], information[rows]) for rows in kept), strict=True) if kept else ((), ())
    return Candidates(
        position_in_world_m=np.array(mean).reshape(-1, 3),
        voter_offsets=np.cumsum([0, *map(len, votes)]),
        voters=np.concatenate([np.empty(0, np.uint32), *votes]),
        covariance_m2=np.array(spread).reshape(-1, 3, 3),
        existence=np.array([existence[rows].max() for rows in kept]),
        expected=np.array([expected[rows].sum() for rows in kept], np.int64),
        class_code=np.array([code[rows[0]] for rows in kept], np.int64),
    ), len(objects) - len(kept)


def _near(
    members: list[int], rows: Ints, position: Floats, information: Floats, covariance: Floats, code: Ints
) -> list[tuple[float, int]]:
    """Return which labels (rows) may be an object, and how far from it they are in squared sigmas."""
    mean, spread = _mean(position[members], information[members])
    away = position[rows] - mean
    inverse = np.linalg.inv(covariance[rows] + spread) if len(rows) else covariance[rows]
    apart = np.einsum("ni,nij,nj->n", away, inverse, away)
    same = (apart <= ONE_PLACE_CHI2) & (code[rows] == code[members[0]])
    return list(zip(apart[same].tolist(), rows[same].tolist(), strict=True))


def _mean(position: Floats, information: Floats) -> tuple[Floats, Floats]:
    """Return the mean (3) of positions (N, 3), weighted by information (N, 3, 3), and its covariance (3, 3)."""
    spread = np.linalg.inv(information.sum(axis=0))
    return spread @ np.einsum("nij,nj->i", information, position), spread
