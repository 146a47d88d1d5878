"""Pairs of things, one to one."""

from __future__ import annotations

import numpy as np

from valuemap.assignment import one_to_one


def pairs(*costs: tuple[int, int, float], alone: float = 10.0) -> list[tuple[int, int]]:
    first, second, cost = (np.array([each[column] for each in costs]) for column in range(3))
    mine, theirs = one_to_one(first.astype(np.int64), second.astype(np.int64), cost.astype(np.float64), alone)
    return list(zip(mine.tolist(), theirs.tolist(), strict=True))


def test_the_total_counts_not_the_nearest_pair() -> None:
    assert pairs((3, 7, 1.0), (3, 9, 2.0), (5, 7, 2.0)) == [(3, 9), (5, 7)]
    both = ((5, 7, 1.0), (3, 7, 0.5))
    assert pairs(*both, (3, 9, 9.4)) == [(3, 9), (5, 7)]  # 10.4, and 10.5 with 5 alone.
    assert pairs(*both, (3, 9, 9.6)) == [(3, 7)]


def test_what_costs_more_than_being_alone_stays_alone() -> None:
    assert pairs((0, 0, 3.0), (1, 0, 2.0), (1, 1, 11.0)) == [(1, 0)]


def test_of_no_pairs_there_are_none() -> None:
    none = np.empty(0, np.int64)
    assert [len(each) for each in one_to_one(none, none, np.empty(0), 1.0)] == [0, 0]
