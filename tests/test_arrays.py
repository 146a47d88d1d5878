"""Rows put together by a number that they share."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import RowsByNumber, runs


def test_rows_are_found_by_their_number() -> None:
    number = np.array([2, 0, 2, 4, 0, 2])
    rows = RowsByNumber.of(number, 6)
    expected = [[1, 4], [], [0, 2, 5], [], [3], []]
    assert [rows[k].tolist() for k in range(6)] == expected
    assert [each.tolist() for each in rows.each()] == expected
    assert rows.count.tolist() == [2, 0, 3, 0, 1, 0]


def test_rows_of_several_numbers_come_one_number_after_the_other() -> None:
    rows = RowsByNumber.of(np.array([2, 0, 2, 4, 0, 2]), 6)
    which, row = rows.of_several(np.array([4, 1, 2, 4]))
    assert which.tolist() == [0, 2, 2, 2, 3]
    assert row.tolist() == [3, 0, 2, 5, 3]


def test_runs_end_where_the_next_code_is_another() -> None:
    rows = np.array([5, 3, 1, 0])
    assert [each.tolist() for each in runs(rows, np.array([7, 7, 2, 7]))] == [[5, 3], [1], [0]]
    assert [each.tolist() for each in runs(rows[:0], rows[:0])] == [[]]
