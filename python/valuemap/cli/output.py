"""Standard output that nobody reads any more, or that has no room left.

What cannot be written must not stop what a command does: it goes on to its end, where the map is written.
"""

from __future__ import annotations

import io
import os
import sys
from typing import Any, TextIO


class _Output(io.FileIO):
    """What a process writes to; from the first error on, to nowhere. A reader that has seen enough is no error."""

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Return how many bytes are done with."""
        try:
            return super().write(data)
        except OSError as error:
            self.error = None if isinstance(error, BrokenPipeError) else error
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return memoryview(data).nbytes


def watch_output() -> None:
    """Let errors of standard output wait until the command has ended, and write names of files that are not UTF-8."""
    sys.stdout, sys.stderr = _watched(sys.stdout), _watched(sys.stderr)


def end_output() -> OSError | None:
    """Write what is left and return why not all of standard output could be written, if so."""
    if sys.stdout is None:  # Closed, as by a service.
        return None
    sys.stdout.flush()
    return getattr(getattr(sys.stdout.buffer, "raw", None), "error", None)


def _watched(stream: TextIO) -> TextIO:
    if stream is None:
        return stream
    stream.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(_Output(stream.fileno(), "wb", closefd=False)),
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=getattr(stream, "line_buffering", False),
        write_through=getattr(stream, "write_through", False),
    )
