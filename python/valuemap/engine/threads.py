"""Tasks on the threads of this process: the core lets go of Python while it works."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from threading import Event
from typing import TypeVar

from valuemap.config import bounded_threads
from valuemap.engine.engine import Work
from valuemap.progress import silent

T = TypeVar("T")
R = TypeVar("R")


class _Stopped(Exception):
    """Another task failed, or a signal came."""


class ThreadEngine:
    """As many tasks at a time as there are threads (0: one a core); fewer tasks work on several threads each."""

    needs_paths = False

    def __init__(self, threads: int = 0) -> None:
        self.threads = bounded_threads(threads) or os.cpu_count() or 1

    def threads_of_task(self, tasks: int, *, on_gpus: bool = False) -> int:  # noqa: ARG002
        """Return how many threads each of so many tasks may work on."""
        return max(1, self.threads // max(tasks, 1))

    def run(self, work: Work[T, R], tasks: Sequence[T], *, on_gpus: bool = False) -> Iterator[tuple[int, R]]:  # noqa: ARG002
        """Yield the number of a task and what the work makes of it, as they get done; all see all GPUs."""
        if len(tasks) <= 1 or self.threads == 1:  # Here, where signals are heard.
            yield from ((number, work(task, silent)) for number, task in enumerate(tasks))
            return
        is_over = Event()

        def go_on(_what: str, _done: int, _total: int) -> None:
            if is_over.is_set():
                raise _Stopped

        todo = iter(enumerate(tasks))
        running: dict[Future[R], int] = {}
        with ThreadPoolExecutor(self.threads) as pool:
            try:
                while True:
                    while len(running) < self.threads and (task := next(todo, None)) is not None:
                        running[pool.submit(work, task[1], go_on)] = task[0]
                    if not running:
                        return
                    done, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in sorted(done, key=running.__getitem__):
                        yield running.pop(future), future.result()
            finally:
                is_over.set()
