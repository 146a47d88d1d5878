"""Faults of pass ids: several drives under one id, and one drive under several."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats, Ints, runs
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.agreement import chance_of_majority
from valuemap.check.fault import (
    LEAST_CHANCE,
    Fault,
    Finding,
    Stage,
    View,
    with_images,
)
from valuemap.check.sample import (
    FASTER,
    order_by_pass,
    standing_m,
)
from valuemap.dataset import Dataset
from valuemap.tables import Categories, Images

_JUMP_TIMES = 8.0
"""A step this many times the distance to the nearest image of the pass is none that a car drove."""

_MOST_JUMPS = 0.25

_TURNS = 6

_LAGS = range(1, _TURNS + 1)
"""At most so many drives take turns under one pass id."""

_LEAST_IMAGES = 10

_SAME_WAY_COSINE = 0.7
"""Cosine between the axes of cameras that may be of one drive: up to 45 degrees."""


class InterleavedPasses(Fault):
    """Several vehicles or cameras under one pass id."""

    name: ClassVar[str] = "interleaved_passes"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Look for passes that jump to and fro between few drives."""
        return _find_jumping(view, self.name, is_interleaved=True)


class NoDrives(Fault):
    """Passes that are not drives."""

    name: ClassVar[str] = "passes_no_drives"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Look for passes whose images are in no order that a car drove, or that take turns along one drive."""
        return _find_in_turn(view, self.name) or _find_jumping(view, self.name, is_interleaved=False)


def _find_jumping(view: View, name: str, *, is_interleaved: bool) -> Finding | None:
    if view.known & {"interleaved_passes", "passes_no_drives"}:
        return None
    passes = jumping_passes(view.drives)
    passes = [each for each in passes if each["interleaved"] == is_interleaved]
    if not passes:
        return None
    first = passes[0]
    images = sum(each["images"] for each in passes)
    what = (
        f"{len(passes)} passes are several drives in one: their images jump between them."
        if is_interleaved
        else f"{len(passes)} passes are no drives: their images follow no road."
    )
    return Finding(
        fault=name,
        what=what.replace("1 passes are", "One pass is").replace("their", "its" if len(passes) == 1 else "their"),
        why=f"In pass {first['name']} the median step from image to image is {first['step_m']:.3g} m, although the "
        f"nearest image is {first['nearest_m']:.3g} m away; {first['jumps']:.0%} of the steps are jumps ({images} "
        "images in all such passes).",
        do="Give each drive of each camera a pass id of its own, and time stamps; the fix chains images by place.",
        figures={"passes": len(passes), "images": images, **{k: v for k, v in first.items() if k != "interleaved"}},
        fix=_rechained,
    )


def _find_in_turn(view: View, name: str) -> Finding | None:
    found = passes_in_turn(view.drives)
    if found is None:
        return None
    names, share, chance = found
    several = len(set(names.values()))
    return Finding(
        fault=name,
        what=f"{len(names)} passes are {'one drive' if several == 1 else f'{several} drives'}: their images take turns "
        "along one road.",
        why=f"In the order of their times, {share:.0%} of the images of all but the longest of them are next to one of "
        "another pass and the same camera, no farther than a car gets in that time.",
        do="Give all images of a drive one pass id (is it a batch, a split or a folder?).",
        chance=chance,
        figures={"passes": len(names), "drives": several, "in_turn": round(share, 3)},
        fix=_joined_passes,
    )


def passes_in_turn(images: Images) -> tuple[dict[str, str], float, float] | None:
    """Return under which one name passes (N) that take turns belong, which share of their images do, and the chance.

    Two images that follow each other in time, of one camera, are of one drive where the second is no farther from the
    first than a car gets in that time. Passes that go on in each other to and fro take turns if most of their images
    are next to one of another pass. Those of the longest pass do not count, as few images may be dealt out of many.
    Drives that follow each other do not come back. Where drives meet or overlap, few of their images are.
    """
    time = images.timestamp_s
    if time is None or not np.all(np.isfinite(time)) or len(images) < _LEAST_IMAGES:
        return None
    center, codes = camera_centers(images), images.pass_id.codes.astype(np.int64)
    order = np.lexsort((np.arange(len(time)), time, images.camera_id))
    before, after = order[:-1], order[1:]
    follows = (images.camera_id[before] == images.camera_id[after]) & (time[after] > time[before])
    step_m = np.linalg.norm(center[after] - center[before], axis=1)
    seconds = time[after] - time[before]
    moves = follows & (step_m > 0.0)
    if moves.sum() < _LEAST_IMAGES:
        return None
    speed_mps = float(np.median(step_m[moves] / seconds[moves]))
    goes_on = follows & (codes[before] != codes[after]) & (step_m <= FASTER * speed_mps * seconds)
    first, second, count = before[goes_on], after[goes_on], len(images.pass_id.names)
    pairs = coo_matrix((np.ones(len(first)), (codes[first], codes[second])), (count, count))
    _, drive = connected_components(pairs, directed=True, connection="strong")
    is_next = np.zeros(len(images), dtype=np.bool_)
    together = drive[codes[first]] == drive[codes[second]]
    is_next[first[together]] = is_next[second[together]] = True
    length, turns = np.bincount(codes, minlength=count), np.bincount(codes[is_next], minlength=count)
    drives = [members for each in np.unique(drive) if len(members := np.flatnonzero(drive == each)) > 1]
    names: dict[str, str] = {}
    told = []
    for members in drives:
        shorter = np.delete(members, np.argmax(length[members]))
        in_turn, most = int(turns[shorter].sum()), int(length[shorter].sum())
        chance = chance_of_majority(in_turn, most) * len(drives)
        if chance < LEAST_CHANCE:
            told.append((chance, in_turn, most))
            names |= {images.pass_id.names[code]: images.pass_id.names[members[0]] for code in members.tolist()}
    chances, seen, of = zip(*told, strict=True) if told else ((), (), ())
    return (names, sum(seen) / sum(of), max(chances)) if names else None


def _joined_passes(dataset: Dataset) -> Dataset:
    found = passes_in_turn(dataset.images)
    if found is None:
        return dataset
    names = [found[0].get(name, name) for name in dataset.images.pass_id.texts()]
    return with_images(dataset, pass_id=Categories.from_texts(names))


def jumping_passes(images: Images) -> list[dict[str, Any]]:
    """Return, for each pass whose images jump, its name, how it does, and whether few drives take turns in it."""
    if not len(images):
        return []
    center = camera_centers(images)
    found = []
    for code, rows in _passes_in_order(images):
        if len(rows) < _LEAST_IMAGES:
            continue
        step = np.linalg.norm(np.diff(center[rows], axis=0), axis=1)
        moving = rows[np.append(True, step > standing_m(step))]
        if len(moving) < _LEAST_IMAGES:
            continue
        way = np.diff(center[moving], axis=0)
        step = np.linalg.norm(way, axis=1)
        # Cameras of a car are nearer to each other than its images are, and one may have the poses of another time.
        camera, count = np.unique(images.camera_id[moving], return_counts=True)
        nearest = _typical_gap(center[moving[images.camera_id[moving] == camera[count.argmax()]]])
        if nearest <= 0.0:
            continue
        jumps = float(((step > _JUMP_TIMES * nearest) & ~_leads_on(way)).mean())
        if jumps <= _MOST_JUMPS:
            continue
        # Of few drives in turn, one of the last images is near; of none, hardly ever.
        recent = np.min(
            [np.linalg.norm(center[moving[_TURNS:]] - center[moving[_TURNS - lag : -lag]], axis=1) for lag in _LAGS],
            axis=0,
        )
        found.append(
            {
                "name": images.pass_id.names[code],
                "images": len(rows),
                "step_m": round(float(np.median(step)), 3),
                "nearest_m": round(nearest, 3),
                "jumps": round(jumps, 3),
                "interleaved": bool((recent <= _JUMP_TIMES * nearest).mean() > 0.7),
            }
        )
    return found


def _leads_on(way: Floats) -> Bools:
    """Return which steps (N, 3) go on from the one before and lead to the one after, as those of a drive do.

    Where a pass drives a road again and again, its nearest image is of another lap, much nearer than any step.
    """
    turn = np.linalg.norm(np.diff(way, axis=0), axis=1)
    turns = np.stack([np.append(0.0, turn), np.append(turn, 0.0)])
    return np.asarray((turns <= np.linalg.norm(way, axis=1)).all(axis=0))


def _passes_in_order(images: Images) -> Iterator[tuple[int, Ints]]:
    order = order_by_pass(images)
    codes = images.pass_id.codes[order]
    for rows in runs(order, codes):
        yield int(images.pass_id.codes[rows[0]]), rows


def _typical_gap(center: Floats) -> float:
    """Return the median distance to the nearest image that is elsewhere at all."""
    distance = np.asarray(cKDTree(center).query(center, k=min(8, len(center)))[0])[:, 1:]
    extent = float(np.linalg.norm(np.ptp(center, axis=0)))
    elsewhere = np.where(distance > 1e-4 * extent, distance, np.inf).min(axis=1)
    elsewhere = elsewhere[np.isfinite(elsewhere)]
    return float(np.median(elsewhere)) if len(elsewhere) else 0.0


def _chains(center: Floats, gap_m: float) -> Ints:
    """Return the chain (N) of images in order: each goes on with the chain whose end is nearest, or starts one."""
    ends: list[Floats] = []
    chain = np.empty(len(center), dtype=np.int64)
    for i, here in enumerate(center):
        if ends:
            distance = np.linalg.norm(np.array(ends) - here, axis=1)
            nearest = int(np.argmin(distance))
            if distance[nearest] <= _JUMP_TIMES * gap_m:
                ends[nearest], chain[i] = here, nearest
                continue
        if len(ends) >= 500:
            chain[i] = len(ends) - 1
            continue
        chain[i] = len(ends)
        ends.append(here)
    return chain


def _rechained(dataset: Dataset) -> Dataset:
    """Give jumping passes new ids: chains in their own order, or where that follows no road, strands of near poses."""
    images = dataset.images
    center = camera_centers(images)
    names = np.array(images.pass_id.texts(), dtype=object)
    scattered: list[Ints] = []
    bad = {each["name"]: each["interleaved"] for each in jumping_passes(dataset.images)}
    for code, rows in _passes_in_order(images):
        name = images.pass_id.names[code]
        if name not in bad:
            continue
        if bad[name]:
            for row, chain in zip(rows, _chains(center[rows], _typical_gap(center[rows])), strict=True):
                names[row] = f"{name} part {chain + 1}"
        else:
            scattered.append(rows)
    if scattered:
        rows = np.sort(np.concatenate(scattered))
        for row, number in zip(rows, _strands(dataset, rows), strict=True):
            names[row] = f"strand {number + 1}"
    return with_images(dataset, pass_id=Categories.from_texts(names.tolist()))


def _strands(dataset: Dataset, rows: Ints) -> Ints:
    """Return which strand each of some images (N) is of: near images that look the same way are linked."""
    center = camera_centers(dataset.images)[rows]
    forward = rotation_matrices(dataset.images)[rows, 2]
    count = min(_TURNS + 1, len(rows))
    distance, near = map(np.asarray, cKDTree(center).query(center, k=count))
    first = np.repeat(np.arange(len(rows)), count)
    second = near.ravel()
    linked = (distance.ravel() <= _JUMP_TIMES * _typical_gap(center)) & (
        np.einsum("nj,nj->n", forward[first], forward[second]) > _SAME_WAY_COSINE
    )
    graph = coo_matrix((np.ones(int(linked.sum())), (first[linked], second[linked])), shape=(len(rows), len(rows)))
    _, strand = connected_components(graph, directed=False)
    return np.asarray(strand, dtype=np.int64)
