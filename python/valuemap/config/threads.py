"""How many threads work: no more than can do anything."""

from __future__ import annotations

import os
from numbers import Integral

from valuemap.errors import SettingError

MAX_THREADS = 1024
"""More are a slip of the keyboard, and take minutes to start."""


def bounded_threads(threads: int) -> int:
    """Return a number of threads to work on (0: one a core), no more than can do anything; results do not depend on it.

    Raises
    ------
    SettingError
        It is no number of threads.
    """
    is_whole = isinstance(threads, Integral) and not isinstance(threads, bool)
    if not is_whole or not 0 <= threads <= MAX_THREADS:
        raise SettingError(
            f"threads: expected 0 to {MAX_THREADS}, found {threads!r}", hint="leave it away for one thread a core"
        )
    return min(threads, 4 * (os.cpu_count() or 1))
