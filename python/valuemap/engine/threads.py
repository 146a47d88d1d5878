"""Tasks on the threads of this process: the core lets go of Python while it works."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import chain, islice
from threading import Event
from typing import TypeVar

from valuemap.config import bounded_threads
from valuemap.engine.engine import Work
from valuemap.progress import silent, until

T = TypeVar("T")
R = TypeVar("R")


class ThreadEngine:
    """As many tasks at a time as there are threads (0: one a core); fewer tasks work on several threads each."""

    needs_paths = False

    def __init__(self, threads: int = 0) -> None:
        self.threads = bounded_threads(threads) or os.cpu_count() or 1

    def threads_of_task(self, tasks: int, *, on_gpus: bool = False) -> int:  # noqa: ARG002
        """Return how many threads each of so many tasks may work on."""
        return max(1, self.threads // max(tasks, 1))

    def run(self, work: Work[T, R], tasks: Iterable[T], *, on_gpus: bool = False) -> Iterator[tuple[int, R]]:  # noqa: ARG002
        """Yield the number of a task and what the work makes of it, as they get done; all see all GPUs."""
        tasks = iter(tasks)
        first = list(islice(tasks, 2))
        todo = enumerate(chain(first, tasks))
        if len(first) <= 1 or self.threads == 1:  # Here, where signals are heard.
            yield from ((number, work(task, silent)) for number, task in todo)
            return
        is_over = Event()
        go_on = until(is_over)  # No further once another task failed, or a signal came.
        running: dict[Future[R], int] = {}
        with ThreadPoolExecutor(self.threads) as pool:
            try:
                while True:
                    # One waits, so that no thread does while the next one is found.
                    while len(running) <= self.threads and (task := next(todo, None)) is not None:
                        running[pool.submit(work, task[1], go_on)] = task[0]
                    if not running:
                        return
                    done, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in sorted(done, key=running.__getitem__):
                        yield running.pop(future), future.result()
            finally:
                is_over.set()
                for future in running:
                    future.cancel()
