"""Which of two kinds of things belong together, one to one, by what each pair costs."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats, Ints

_NEVER = 1e6
"""Cost of a pair that cannot be: above that of any that can, in squared sigmas."""


def one_to_one(first: Ints, second: Ints, cost: Floats, alone: float) -> tuple[Ints, Ints]:
    """Return the pairs with the least total cost (M), ascending by their first.

    Each of the first and of the second is of one pair (N) at most; one of the first that is of none costs `alone`.
    """
    from scipy.optimize import linear_sum_assignment  # Slow to import, and few commands need it.

    ours, i = np.unique(first, return_inverse=True)
    theirs, j = np.unique(second, return_inverse=True)
    table = np.full((len(ours), len(theirs) + len(ours)), _NEVER)
    table[i, j] = cost
    table[np.arange(len(ours)), len(theirs) + np.arange(len(ours))] = alone
    row, column = linear_sum_assignment(table)
    is_pair = column < len(theirs)
    return ours[row[is_pair]], theirs[column[is_pair]]
