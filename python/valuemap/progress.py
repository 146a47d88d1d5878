"""How long work reports that it goes on: one callback type for every stage."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called as `progress(what, done, total)`, from the calling thread, whenever something got done."""


def silent(what: str, done: int, total: int) -> None:
    """Report nothing; the default of every stage."""
