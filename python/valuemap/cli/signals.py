"""Signals that end a command: one clear line, nothing half-written, and the exit status that shells expect.

Until a handler is there, Ctrl-C prints a traceback. So this imports nothing but what the interpreter has already:
`signal` and `contextlib` take longer than all the rest up to the handler.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # What `signal` makes enumerations of.
import os

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

_ENDING = tuple(int(getattr(_signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(_signal, name))


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, and no plain KeyboardInterrupt.

    Where that has passed an `exec`, as those of dataclasses, `python -m` ends itself with the signal, whatever
    the status that it was to exit with in the end.
    """


class Terminated(BaseException):
    """A signal asks the process to end; like Ctrl-C it is no error, and passes whatever handles errors."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = number


def exit_code(number: int) -> int:
    """Return the status of a process that a signal ended."""
    return 128 + number


def end_at_once() -> None:
    """While nothing has begun, end on a signal right away: an exception could come in the middle of an import."""
    for number in _ENDING:
        if _signal.getsignal(number) != _signal.SIG_IGN:  # As the parent wants it: nohup, or a script's background.
            _signal.signal(number, _end_at_once)


def end_in_order() -> None:
    """From now on, turn signals that would end at once into exceptions, so that what was begun is cleaned up.

    Nothing changes where `end_at_once` was not called: the process is another's.
    """
    for number in _ENDING:
        if _signal.getsignal(number) == _end_at_once:
            _signal.signal(number, _raise)


def _end_at_once(number: int, _: FrameType | None) -> NoReturn:
    what = "interrupted" if number == _signal.SIGINT else "terminated"
    os.write(2, f"{what}: nothing was written\nhint: run the same command again to start over\n".encode())
    os._exit(exit_code(number))


def _raise(number: int, _: FrameType | None) -> NoReturn:
    if number == _signal.SIGINT:
        raise Interrupted
    raise Terminated(number)
