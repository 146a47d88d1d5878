"""A short way through places, for exposures of which neither times nor names tell the order."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats, Ints

_NEIGHBORS = 8
"""Nearest poses that a pose may be chained to in one round."""


def chain_nearest(place_m: Floats) -> Ints:
    """Return places (N, 3) in the order of a short way through all of them: nearest ends are joined first.

    It begins at the end that is farther from the middle of all places.
    """
    from scipy.spatial import cKDTree  # Only where neither times nor names tell.

    count = len(place_m)
    if count < 3:
        return np.arange(count)
    links: list[list[int]] = [[] for _ in range(count)]
    parent = list(range(count))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    ends = np.arange(count)
    chains = count
    while chains > 1:
        tree = cKDTree(place_m[ends])
        neighbors = min(_NEIGHBORS + 1, len(ends))
        distance_m, near = map(np.asarray, tree.query(place_m[ends], k=neighbors))
        a = np.repeat(ends, neighbors)
        b = ends[near.reshape(-1)]
        low, high = np.minimum(a, b), np.maximum(a, b)
        order = np.lexsort((high, low, distance_m.reshape(-1)))
        joined = 0
        for i, j in zip(low[order].tolist(), high[order].tolist(), strict=True):
            if i != j and len(links[i]) < 2 and len(links[j]) < 2 and root(i) != root(j):
                links[i].append(j)
                links[j].append(i)
                parent[root(i)] = root(j)
                joined += 1
        chains -= joined
        ends = np.array([i for i in range(count) if len(links[i]) < 2])
        if not joined:  # All near ends are of one chain: look farther.
            ends = _one_end_each(ends, [root(i) for i in ends.tolist()])
    tips = [i for i in range(count) if len(links[i]) == 1]
    middle_m = place_m.mean(axis=0)
    last, here = -1, max(tips, key=lambda i: (float(np.linalg.norm(place_m[i] - middle_m)), -i))
    way = [here]
    while len(way) < count:
        last, here = here, next(i for i in links[here] if i != last)
        way.append(here)
    return np.array(way)


def _one_end_each(ends: Ints, chain: list[int]) -> Ints:
    """Return one end of each chain, the first by number."""
    first: dict[int, int] = {}
    for end, of in zip(ends.tolist(), chain, strict=True):
        first.setdefault(of, end)
    return np.array(list(first.values()))
