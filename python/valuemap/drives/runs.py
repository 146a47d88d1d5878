"""Runs of equal values, codes by their first appearance, and quantiles of groups."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints, rows_in_runs


def begins_of_runs(values: Ints) -> Bools:
    """Return where (N) runs of equal values begin."""
    begins = np.ones(len(values), np.bool_)
    np.not_equal(values[1:], values[:-1], out=begins[1:])
    return begins


def edges_of_runs(values: Ints) -> Ints:
    """Return where runs of equal values begin, and the end."""
    return np.append(np.flatnonzero(begins_of_runs(values)), len(values))


def rows_since(begins: Bools) -> Ints:
    """Return how many rows (N) it is since the last one where something begins, as it does in the first."""
    return rows_in_runs(0, np.diff(np.append(np.flatnonzero(begins), len(begins))))


def equal_to_next(values: NDArray[Any]) -> Bools:
    """Return which of sorted values (N) equal the next one (N - 1); none follows none."""
    same: Bools = values[1:] == values[:-1]
    if values.dtype.kind == "f":
        same |= np.isnan(values[1:]) & np.isnan(values[:-1])
    return same


def numbered_by_first(codes: Ints) -> Ints:
    """Return codes (N) numbered by their first appearance."""
    if not len(codes):
        return codes.astype(np.int64)
    low, high = int(codes.min()), int(codes.max())
    if high - low > 4 * len(codes):
        codes = np.unique(codes, return_inverse=True)[1]
        low, high = 0, int(codes.max())
    first = np.full(high - low + 1, len(codes))
    first[codes[::-1] - low] = np.arange(len(codes))[::-1]  # The last assignment stays: that of the first.
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[codes - low]


def sort_codes(codes: Ints) -> Ints:
    """Return a stable order of codes from 0."""
    # Numbers of 16 bits are sorted by counting.
    small = codes.astype(np.uint16) if len(codes) and codes.max() < 2**16 else codes
    return np.argsort(small, kind="stable")


def quantiles(values: Floats, group: Ints, share: float) -> Floats:
    """Return for each group from 0 the value below which this share of its values (N) lies; NaN values do not count.

    Values are rounded to single precision: then one sort of whole numbers, by group and value, does it.
    """
    is_nan = np.isnan(values)
    bits = (values + 0.0).astype(np.float32).view(np.uint32)  # No -0; bits of positive numbers sort as these do.
    bits ^= (bits.view(np.int32) >> 31).view(np.uint32) | np.uint32(2**31)  # Of negative ones all bits, else the sign.
    bits[is_nan] = 2**32 - 1
    keys = np.sort((group.astype(np.uint64) << np.uint64(32)) | bits)
    groups = int(group.max(initial=-1)) + 1
    size = np.bincount(group, minlength=groups)
    number = size - np.bincount(group[is_nan], minlength=groups)
    some = np.flatnonzero(number)
    at = (np.cumsum(size) - size)[some] + (share * (number[some] - 1) + 0.5).astype(np.int64)
    found = keys[at].astype(np.uint32)
    found ^= np.where(found >> 31, 2**31, 2**32 - 1).astype("u4")
    quantile = np.full(groups, np.nan)
    quantile[some] = found.view(np.float32)
    return quantile
