"""Putting tables of one kind under each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import TypeVar

import numpy as np

from valuemap.tables import Table

T = TypeVar("T", bound=Table)


def join_rows(parts: Sequence[T]) -> T:
    """Return one table of all rows, in the order given; all fields must be arrays, and there must be a part."""
    names = [f.name for f in fields(parts[0])]
    return type(parts[0])(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
