"""pycolmap, imported so that who hears SIGTERM stays as it was: all others import it from here.

glog, which it brings along, takes that signal over when it is imported, and prints a stack trace.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _same_hearer() -> Iterator[None]:
    """Let SIGTERM wait, and then come to who heard it before; only the main thread can say so."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    hearer, waiting = signal.getsignal(signal.SIGTERM), signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        yield
    finally:
        if hearer is not None:
            signal.signal(signal.SIGTERM, hearer)
        signal.pthread_sigmask(signal.SIG_SETMASK, waiting)


with _same_hearer():
    import pycolmap

__all__ = ["pycolmap"]
