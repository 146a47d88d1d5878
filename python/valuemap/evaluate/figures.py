"""Figures that may say nothing: NaN in Python, None in JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real


def is_number(value: object) -> bool:
    """Return whether a value of a user is a number, and finite."""
    return isinstance(value, Real) and math.isfinite(value)


def share(part: float, whole: int) -> float:
    """Return a part of a whole; NaN of nothing."""
    return part / whole if whole else math.nan


def to_json(figures: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return figures by name, None where they are NaN."""
    return {name: None if value is None or math.isnan(value) else value for name, value in figures.items()}
