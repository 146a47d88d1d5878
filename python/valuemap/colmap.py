"""pycolmap, imported so that who hears Ctrl-C and SIGTERM stays as it was: all others import it from here.

glog, which it brings along, takes SIGTERM over when it is imported, and prints a stack trace. Its import turns what a
signal raises in the middle of it into an error of its own.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _same_hearers() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait, and then come to who heard them before; only the main thread can say so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard: list[int] = []
    hearers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    has_mask = hasattr(signal, "pthread_sigmask")
    waiting = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM]) if has_mask else set()
    for number, hearer in hearers.items():
        if callable(hearer):
            signal.signal(number, lambda heard_now, _: heard.append(heard_now))
    try:
        yield
    finally:
        for number, hearer in hearers.items():
            if hearer is not None:
                signal.signal(number, hearer)
        if has_mask:
            signal.pthread_sigmask(signal.SIG_SETMASK, waiting)
    for signalled in heard:
        signal.raise_signal(signalled)


with _same_hearers():
    import pycolmap

__all__ = ["pycolmap"]
