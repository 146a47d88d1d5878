"""What not every operating system has: flags of opened files, locks of folders, peak memory of the process."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

OWN_FILE = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
"""Flags for `os.open` with which a link is not followed, a pipe not waited for, and no line break changed."""


def peak_memory_mb() -> int | None:
    """Return the peak memory of the process so far in MB; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    with suppress(OSError, StopIteration):  # Linux counts that of who started a process as its own elsewhere.
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) // 2**10
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // (2**20 if sys.platform == "darwin" else 2**10)


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which ends with the process at the latest.

    Unix locks the folder itself. Windows locks no folders: a file in the folder for temporary files, named after it,
    stands for it.

    Raises
    ------
    OSError
        A living process has it, or the system or the file system knows no locks.
    """
    try:
        import fcntl
    except ImportError:
        with _file_lock(Path(tempfile.gettempdir()) / f"valuemap-{_name_of(folder)}.lock"):
            yield
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _file_lock(path: Path) -> Iterator[None]:
    try:
        import msvcrt
    except ImportError as error:
        raise OSError("this system knows no locks") from error
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]  # Typed on Windows only.
        yield
    finally:
        os.close(descriptor)


def _name_of(folder: Path) -> str:
    return hashlib.sha256(os.fsencode(folder.absolute())).hexdigest()[:32]


def sync_file(path: Path) -> None:
    """Wait until a file is on disk; raises `OSError` where it cannot be opened."""
    # Windows writes out only what is open for writing.
    descriptor = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
