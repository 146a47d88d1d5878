"""How long work reports that it goes on: one callback type for every stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event

Progress = Callable[[str, int, int], None]
"""Called as `progress(what, done, total)`, from the calling thread, whenever something got done.

Each kind of work begins with 0 of a total, which stays, and ends with all of it (`counted`).
"""


def silent(what: str, done: int, total: int) -> None:
    """Report nothing; the default of every stage."""


class Stopped(Exception):
    """Work beside other work was told to end."""


def until(is_over: Event) -> Progress:
    """Return what reports nothing, for work in another thread, and raises `Stopped` once that is over."""

    def go_on(_what: str, _done: int, _total: int) -> None:
        if is_over.is_set():
            raise Stopped

    return go_on


@contextmanager
def counted(progress: Progress, what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Report work of a known amount: none of it as it begins, never less than before, all of it when it has ended.

    Yields what is told how much is done by now; the progress hears of it each time, for that is how work is stopped.
    """
    most = 0
    progress(what, 0, total)

    def tell(done: int) -> None:
        nonlocal most
        most = max(most, min(done, total))
        progress(what, most, total)

    yield tell
    progress(what, total, total)
