"""The folder of a run that is going on: what is done stays there until the map is written, so that a run can go on.

Everything in it is written beside, synced and renamed, under a name that says what it was made from: what is there is
whole, and a task that is done twice comes to the same file.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from valuemap.errors import OutputError
from valuemap.system import folder_lock

MARKER = "valuemap-work.json"
CELLS = "cells"
_TEMPORARY = ".tmp-"
_MANY = 100
"""To wait for more files than this one by one takes minutes for what takes seconds together."""


@contextmanager
def open_work(path: Path, *, resume: bool) -> Iterator[Path]:
    """Yield a folder for the parts of a run, which nobody else has until the block ends; it stays.

    What an earlier run left there is used if it is to be resumed, and removed if not.

    Raises
    ------
    OutputError
        Another run has it, it holds something else, or it cannot be written.
    """
    path = path.absolute()
    try:
        _claim(path)
        with _lock_of(path):
            if not resume:
                _empty(path)
            _remove_temporary(path)
            (path / CELLS).mkdir(exist_ok=True)
            try:
                yield path
            finally:  # A signal may come before `written` has begun to look after what it made, or while it removes it.
                with suppress(OSError):
                    _remove_temporary(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written: {error.strerror or error}",
            hint="make room, or check the folder's permissions; the same command with --resume then goes on from here",
        ) from error


def has_parts(path: Path) -> bool:
    """Return whether a run has left anything to go on from."""
    return any(path.glob(f"{CELLS}/*.parquet")) or any(path.glob("partition-*"))


def remove_work(path: Path) -> None:
    """Remove the folder of a run that is over: the marker last, so that what a kill leaves of it is still ours."""
    with suppress(OSError):
        _empty(path)
        shutil.rmtree(path)


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, of a file or a folder, that is synced and renamed when the block ends well.

    Where another has done the same meanwhile, theirs stays: it is the same.
    """
    temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY, dir=path.parent))
    try:
        yield temporary / path.name
        _sync_all([temporary / path.name, *(temporary / path.name).rglob("*")])
        try:
            (temporary / path.name).replace(path)
        except OSError:
            if not path.is_dir():
                raise
        _sync(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _claim(path: Path) -> None:
    """Make the folder, if it is not there; refuse one that is somebody else's."""
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file, a folder for the parts is needed", hint="choose another --work")
    path.mkdir(parents=True, exist_ok=True)
    if not (path / MARKER).is_file():
        if any(entry.name[: len(_TEMPORARY)] != _TEMPORARY for entry in path.iterdir()):
            raise OutputError(
                f"{path}: is not ours: there are files in it, and no {MARKER}", hint="choose another --work"
            )
        with written(path / MARKER) as file:
            file.write_text(json.dumps({"what": "parts of an unfinished map of valuemap"}) + "\n", encoding="utf-8")


@contextmanager
def _lock_of(path: Path) -> Iterator[None]:
    lock = folder_lock(path)
    try:
        lock.__enter__()
    except OSError as error:
        raise OutputError(
            f"{path}: another run is at work here", hint="wait for it to end, or choose another --out or --work"
        ) from error
    try:
        yield
    finally:
        lock.__exit__(None, None, None)


def _empty(path: Path) -> None:
    for entry in path.iterdir():
        if entry.name != MARKER:
            _remove(entry)


def _remove_temporary(path: Path) -> None:
    for entry in [*path.glob(f"{_TEMPORARY}*"), *path.glob(f"*/{_TEMPORARY}*")]:
        _remove(entry)


def _remove(entry: Path) -> None:
    """Remove a file or folder; a folder is renamed first, so that what is there under its name is always whole."""
    if not entry.is_dir() or entry.is_symlink():
        entry.unlink(missing_ok=True)
    elif entry.name.startswith(_TEMPORARY):
        shutil.rmtree(entry)
    else:
        aside = Path(tempfile.mkdtemp(prefix=_TEMPORARY, dir=entry.parent))
        entry.replace(aside / entry.name)
        shutil.rmtree(aside)


def _sync_all(paths: Sequence[Path]) -> None:
    """Wait until files and folders are on disk; of very many the system writes out all that it has."""
    if len(paths) > _MANY and hasattr(os, "sync"):
        os.sync()
        return
    for path in paths:
        _sync(path)


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk; folders as far as the system can."""
    if path.is_dir() and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
