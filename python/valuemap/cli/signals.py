"""Signals that end a command: one clear line, nothing half-written, and the exit status that shells expect."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Terminated(BaseException):
    """A signal asks the process to end; like Ctrl-C it is no error, and passes whatever handles errors."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = number


def exit_code(number: int) -> int:
    """Return the status of a process that a signal ended."""
    return 128 + number


@contextmanager
def end_at_once() -> Iterator[None]:
    """While nothing has begun, end on a signal right away: an exception could come in the middle of an import.

    SIGTERM waits until the block ends, as glog, which pycolmap brings along, takes it over and prints a stack trace.
    """
    _handle(_end_at_once)
    if not hasattr(signal, "pthread_sigmask"):  # Windows, where none of these signals comes from outside.
        yield
        return
    blocked = {number for number in _ENDING if number != signal.SIGINT}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, blocked)
    try:
        yield
    finally:
        _handle(_end_at_once)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_in_order() -> None:
    """From now on, turn signals into exceptions, so that what was begun is cleaned up."""
    _handle(_raise)


def _handle(handler: signal._HANDLER) -> None:
    for number in _ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:  # As the parent wants it: nohup, or a script's background.
            signal.signal(number, handler)


def _end_at_once(number: int, _: FrameType | None) -> NoReturn:
    what = "interrupted" if number == signal.SIGINT else "terminated"
    os.write(2, f"{what}: nothing was written\nhint: run the same command again to start over\n".encode())
    os._exit(exit_code(number))


def _raise(number: int, _: FrameType | None) -> NoReturn:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise Terminated(number)
