"""The interface of all engines."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

from valuemap.progress import Progress

T = TypeVar("T")
R = TypeVar("R")

Work = Callable[[T, Progress], R]
"""What is done with a task. It calls the progress now and then, which raises where the task is to end."""


class Engine(Protocol):
    """Runs tasks that do not depend on each other, a bounded number at a time."""

    needs_paths: bool
    """Whether tasks may be done in other processes, to which paths go, not arrays."""

    def threads_of_task(self, tasks: int, *, on_gpus: bool = False) -> int:
        """Return how many threads each of so many tasks may work on."""
        ...

    def run(self, work: Work[T, R], tasks: Iterable[T], *, on_gpus: bool = False) -> Iterator[tuple[int, R]]:
        """Yield the number of a task and what the work makes of it, as they get done, in any order.

        What tasks there are may be found out while the first of them are done.

        With `on_gpus` a task in another process has a GPU to itself, and the process stays for the next one.
        An exception of a task ends the others, and is raised. A task may be done again where a machine is lost, so it
        must come to the same then.
        """
        ...
