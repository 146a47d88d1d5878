"""What became of each label of a map when passes were added: by what each epoch alone has where, and by its looks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from valuemap.arrays import Bools, Floats, Ints, runs
from valuemap.connected import connected
from valuemap.dataset import rows_of
from valuemap.nearby import ONE_PLACE_CHI2, Nearby
from valuemap.tables import Categories, Changes, IdBridge, Labels, Votes
from valuemap.tables.covariance import covariance_matrices
from valuemap.update.looks import SURE, Looks

SAME_SHARE = 0.5
"""Labels that share this part of the votes of one of them are one object."""
MOVED_WITHIN_M = 5.0
"""What is gone here and new there, no farther away, is one object that was moved."""
SAME_PLACE_CHI2 = 30.0
"""Squared sigmas up to which labels of two epochs may be one object. Of objects that stand still one in a thousand is
beyond `ONE_PLACE_CHI2` if covariances are right, and beyond this if deviations are 1.35 times what they say."""

FEW_WAYS = 1000
"""Of so few ways to pair labels all are looked at: that takes less time than importing SciPy does, 0.5 s."""


@dataclass(frozen=True)
class Verdicts:
    """What became of the labels (N) of the new map, and then of those of the old one that it does not have.

    `before` (N) is the row of the old label that each is, -1 where there is none; `state` (N) is one of `LABEL_STATES`;
    `moved_from` (N) the row of the new map that a moved one was before, -1 for all others.
    """

    before: Ints
    state: list[str]
    moved_from: Ints


def match_labels(old: Labels, old_votes: Votes, new: Labels, new_votes: Votes) -> tuple[Ints, Ints]:
    """Return the row of the old label (N) that each new one is, -1 for none, and how many votes they share (N).

    Pairs with more common votes go first, then lower ids; each label is of one pair.
    """
    before, common = np.full(len(new), -1), np.zeros(len(new), np.int64)
    at = first_rows(new_votes.detection_id, old_votes.detection_id)
    has = np.flatnonzero(at >= 0)
    voted = old_votes.label_id[at[has]], new_votes.label_id[has]
    rows = rows_of(voted[0], old.label_id), rows_of(voted[1], new.label_id)
    pair, count = np.unique(rows[0] * len(new) + rows[1], return_counts=True)
    i, j = pair // max(len(new), 1), pair % max(len(new), 1)
    able = np.flatnonzero(count >= SAME_SHARE * np.minimum(old.votes[i], new.votes[j]))
    able = able[np.lexsort((j[able], i[able], -count[able]))]
    taken: set[int] = set()
    for first, second, shared in zip(i[able].tolist(), j[able].tolist(), count[able].tolist(), strict=True):
        if first not in taken and before[second] < 0:
            before[second], common[second] = first, shared
            taken.add(first)
    return before, common


def first_rows(ids: Ints, keys: Ints) -> Ints:
    """Return the first row among `keys` (M), in any order, of each of `ids` (N), -1 where there is none."""
    if not len(ids) or not len(keys):
        return np.full(len(ids), -1)
    low, high = int(keys.min()), int(keys.max())
    if high - low > 4 * (len(ids) + len(keys)):
        order = np.argsort(keys, kind="stable")
        at = np.minimum(np.searchsorted(keys, ids, sorter=order), len(keys) - 1)
        return np.asarray(np.where(keys[order[at]] == ids, order[at], -1))
    # Ids without many gaps, as most are: a table of all of them takes a tenth of the time of sorting.
    row_of = np.full(high - low + 2, -1)
    row_of[keys[::-1] - low] = np.arange(len(keys))[::-1]  # The last assignment stays: that of the first.
    is_within = (ids >= low) & (ids <= high)
    return row_of[np.where(is_within, ids - low, -1)]


def match_places(old: Labels, new: Labels) -> Ints:
    """Return the row of the old label (N) that stands where each new one does, -1 for none.

    Both are of one class, and no farther apart than their covariances explain. Of all ways to pair them this is the
    likeliest: it has the least sum of squared sigmas, where a label alone counts as much as a pair that is just
    possible. So of two heads side by side neither takes the other's place.
    """
    before = np.full(len(new), -1)
    if not len(old) or not len(new):
        return before
    codes = {name: code for code, name in enumerate(old.class_name.names)}
    code = np.array([codes.get(name, -1) for name in new.class_name.names])[new.class_name.codes]
    j, i = Nearby(old.position_in_world_m).pairs(new.position_in_world_m, MOVED_WITHIN_M)
    same = old.class_name.codes[i] == code[j]
    i, j = i[same], j[same]
    gain = SAME_PLACE_CHI2 - _apart(old, i, new, j)
    i, j, gain = i[gain >= 0.0], j[gain >= 0.0], gain[gain >= 0.0]
    if not len(i):
        return before
    # What has nothing to do with each other is paired by itself.
    group = connected(i, len(old) + j, len(old) + len(new))[i]
    order = np.lexsort((j, i, group))
    for pairs in runs(order, group[order]):
        rows, row = np.unique(i[pairs], return_inverse=True)
        columns, column = np.unique(j[pairs], return_inverse=True)
        table = np.full((len(rows), len(columns)), -np.inf)
        table[row, column] = gain[pairs]
        for first, second in zip(*_likeliest(np.maximum(table, -1.0)), strict=True):
            if table[first, second] >= 0.0:
                before[columns[second]] = rows[first]
    return before


def _likeliest(gain: Floats) -> tuple[Ints, Ints]:
    """Return the rows and columns of the pairs whose gains (N, M) have the largest sum; each is of one pair."""
    rows, columns = gain.shape
    if rows > columns:
        column, row = _likeliest(gain.T)
        return row, column
    if math.perm(columns, rows) > FEW_WAYS:
        row, column = scipy.optimize.linear_sum_assignment(gain, maximize=True)
        return row, column
    ways = np.array(list(itertools.permutations(range(columns), rows)))
    return np.arange(rows), ways[np.argmax(gain[np.arange(rows), ways].sum(axis=1))]


def judge(
    new: Labels,
    before: Ints,
    state_before: list[str],
    stands: Bools,
    looks: Mapping[int, tuple[Looks, Looks]],
) -> Verdicts:
    """Return what became of each label; `looks` are those of both epochs at the labels (rows) that are asked for.

    Those that both epochs alone have in one place, `stands` (N), are confirmed. A label without a look of the added
    passes stays what it was.
    """
    state = []
    for row in range(len(new)):
        was = state_before[before[row]] if before[row] >= 0 else "new"
        first, second = looks.get(row, (None, None))
        if stands[row]:
            state.append("confirmed")
        elif second is None or first is None or second.looks == 0:
            state.append(was)
        elif before[row] >= 0:
            state.append("confirmed" if second.say_there else "gone" if second.say_gone else _undecided(was, second))
        else:
            state.append("confirmed" if first.say_there else "new")
    moved_from = np.full(len(new), -1)
    position, code = new.position_in_world_m, new.class_name.codes.tolist()
    # Where something new stands beside it, what was rather missed need not be sure to be gone: one event explains both.
    missing = ("gone", "uncertain")
    gone = [row for row in looks if before[row] >= 0 and state[row] in missing and state_before[before[row]] != "gone"]
    fresh = [row for row in looks if before[row] < 0 and state[row] == "new" and looks[row][1].say_there]
    for row, source in _pairs(position, code, fresh, gone):
        if looks[row][0].log_odds <= 0.0:  # Nobody saw it there before.
            moved_from[row], state[row] = source, "moved"
    return Verdicts(before, state, moved_from)


def existence_now(labels: Labels, state: list[str], looks: Mapping[int, tuple[Looks, Looks]]) -> Floats | None:
    """Return the probabilities (N) that labels exist, those that are gone by what the looks of the added passes say.

    Their old votes tell that they were there. The odds against one that is gone are those of the verdict: 20 to 1, or
    more where looks say more. None where no label has a probability.
    """
    if labels.existence is None:
        return None
    existence = labels.existence.copy()
    for row in (row for row, each in enumerate(state) if each == "gone"):
        against = max(SURE, -looks[row][1].log_odds if row in looks else SURE)
        existence[row] = min(existence[row], math.exp(-against) / (1.0 + math.exp(-against)))
    return existence


def _undecided(was: str, looks: Looks) -> str:
    """Return the state of a label whose looks say neither: what it was, unless they missed more than they saw."""
    return was if looks.log_odds >= 0.0 else "uncertain"


def _pairs(position_m: Floats, code: list[int], fresh: list[int], gone: list[int]) -> list[tuple[int, int]]:
    """Return pairs of new and gone labels of one class that are near each other, the nearest first."""
    if not fresh or not gone:
        return []
    near = Nearby(position_m[gone]).pairs(position_m[fresh], MOVED_WITHIN_M)
    found = [
        (float(np.linalg.norm(position_m[fresh[j]] - position_m[gone[i]])), fresh[j], gone[i])
        for j, i in zip(*(rows.tolist() for rows in near), strict=True)
        if code[fresh[j]] == code[gone[i]]
    ]
    pairs: list[tuple[int, int]] = []
    for _, row, source in sorted(found):
        if all(row != r and source != s for r, s in pairs):
            pairs.append((row, source))
    return pairs


def number(old: Labels, verdicts: Verdicts) -> Ints:
    """Return the ids (N) of the labels of the new map: those they had, else beyond all that were."""
    ids = np.zeros(len(verdicts.before), np.int64)
    known = verdicts.before >= 0
    ids[known] = old.label_id[verdicts.before[known]]
    moved = np.flatnonzero(verdicts.moved_from >= 0)
    ids[moved] = ids[verdicts.moved_from[moved]]
    fresh = np.flatnonzero(ids == 0)
    ids[fresh] = np.arange(len(fresh)) + int(old.label_id.max(initial=0)) + 1
    return ids


def tell(
    old: Labels,
    new: Labels,
    verdicts: Verdicts,
    ids: Ints,
    looks: Mapping[int, tuple[Looks, Looks]],
    common: Ints,
    is_lost: Bools,
) -> tuple[Changes, IdBridge]:
    """Return what changed, a row a label of either map, by id, and which labels of both maps are the same.

    `common` (N) are the votes that a label shares with what it was; the new map does not have those that are lost (N).
    """
    covered = set(verdicts.moved_from.tolist())
    rows = np.array([row for row in range(len(new)) if row not in covered], np.int64)
    sources = np.where(verdicts.moved_from[rows] >= 0, verdicts.moved_from[rows], rows)
    before = verdicts.before[sources]
    differs = np.zeros(len(new), np.bool_)
    known = rows[verdicts.before[rows] >= 0]
    differs[known] = _differ(old, verdicts.before[known], new, known)
    kinds = []
    for row, source, was in zip(rows.tolist(), sources.tolist(), before.tolist(), strict=True):
        if source != row:
            kinds.append("moved")
        elif was < 0:
            kinds.append("added")
        elif verdicts.state[row] == "gone" or is_lost[row]:
            kinds.append("removed")
        else:
            kinds.append("changed" if differs[row] else "unchanged")
    found = [looks.get(source, (_NONE, _NONE))[1] for source in sources.tolist()]
    changes = Changes(
        label_id=ids[rows],
        change=Categories.from_texts(kinds),
        state=Categories.from_texts([verdicts.state[row] for row in rows.tolist()]),
        class_name=new.class_name.take(rows),
        position_in_world_m=new.position_in_world_m[rows],
        from_m=np.where(before[:, None] >= 0, old.position_in_world_m[before], np.nan),
        looks=np.array([each.looks for each in found], np.int64),
        hits=np.array([each.hits for each in found], np.int64),
        misses=np.array([each.misses for each in found], np.int64),
        log_odds=np.array([each.log_odds for each in found], np.float64),
        first_look_s=np.array([each.first_s for each in found], np.float64),
        last_look_s=np.array([each.last_s for each in found], np.float64),
    )
    known = rows[(before >= 0) & (~is_lost[rows] | (sources != rows))]
    of = np.where(verdicts.moved_from[known] >= 0, verdicts.moved_from[known], known)
    bridge = IdBridge(old.label_id[verdicts.before[of]], ids[known], common[known])
    return (
        changes.take(np.argsort(changes.label_id, kind="stable")),
        bridge.take(np.argsort(bridge.old_label_id, kind="stable")),
    )


_NONE = Looks(0, 0, 0.0, float("nan"), float("nan"))


def _differ(old: Labels, before: Ints, new: Labels, rows: Ints) -> Bools:
    """Return which labels (N) are of another class, or elsewhere than their covariances explain."""
    code_of = {name: code for code, name in enumerate(new.class_name.names)}
    code = np.array([code_of.get(name, -1) for name in old.class_name.names], np.int64)
    is_other = code[old.class_name.codes[before]] != new.class_name.codes[rows]
    return np.asarray(is_other | (_apart(old, before, new, rows) > ONE_PLACE_CHI2))


def _apart(old: Labels, i: Ints, new: Labels, j: Ints) -> Floats:
    """Return the distances (N) of pairs of labels in squared sigmas."""
    away = new.position_in_world_m[j] - old.position_in_world_m[i]
    spread = covariance_matrices(old.covariance_m2[i] + new.covariance_m2[j])
    return np.asarray(np.einsum("ni,nij,nj->n", away, np.linalg.pinv(spread), away))
