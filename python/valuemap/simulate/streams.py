"""Independent random streams by name, so that changing one noise does not reshuffle the others."""

from __future__ import annotations

import zlib

import numpy as np

from valuemap.arrays import Floats, Ints


def random_stream(seed: int, *names: str | int) -> np.random.Generator:
    """Return the generator of one purpose: the same seed and names give the same numbers, always."""
    key = tuple(zlib.crc32(str(name).encode()) for name in names)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def hash01(numbers: Floats | Ints, *key: int) -> Floats:
    """Return a random number from 0 to 1 for each whole number (N) and key, quickly: for looks, not for statistics."""
    state = numbers.astype(np.int64).astype(np.uint64)
    for part in key:
        state = (state ^ np.uint64(part + 0x9E37)) * np.uint64(0x9E3779B97F4A7C15)
        state ^= state >> np.uint64(29)
    unit: Floats = (state >> np.uint64(11)).astype(np.float64) / float(1 << 53)
    return unit
