"""Covariances of positions, as matrices and as the six columns that tables hold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats


def covariance_matrices(covariance_m2: NDArray[Any] | Sequence[float]) -> Floats:
    """Return symmetric matrices (..., 3, 3) of their columns xx, xy, xz, yy, yz, zz (..., 6)."""
    columns = np.asarray(covariance_m2, dtype=np.float64)
    return columns[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*columns.shape[:-1], 3, 3)


def covariance_columns(matrices_m2: Floats) -> Floats:
    """Return the columns xx, xy, xz, yy, yz, zz (N, 6) of symmetric matrices (N, 3, 3)."""
    return matrices_m2.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
