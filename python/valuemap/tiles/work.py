"""The folder of a run that is going on: what is done stays there until the map is written, so that a run can go on.

Everything in it is written beside, synced and renamed, under a name that says what it was made from: what is there is
whole, and a task that is done twice comes to the same file.

A store has neither locks nor renames. There a file is whole as soon as it is there, and a run says all the time that it
lives, in a file of its own: a second one waits to see whether that changes.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from uuid import uuid4

from valuemap.errors import OutputError, ValuemapError
from valuemap.remote import Place, UrlPath
from valuemap.system import folder_lock

MARKER = "valuemap-work.json"
CELLS = "cells"
TEMPORARY = ".tmp-"
_LIVING = "living-"
"""How files begin by which runs say in a store that they live."""
_BEAT_S, _WAIT_S = 5.0, 30.0
"""How often they do so, and how long is waited for it: six times that, as a request may fail or take long."""
_WHAT = {"what": "parts of an unfinished map of valuemap"}
_MANY = 100
"""To wait for more files than this one by one takes minutes for what takes seconds together."""


@contextmanager
def open_work(path: Path, *, resume: bool, tell: Callable[[str], None] = lambda _: None) -> Iterator[Path]:
    """Yield a folder for the parts of a run, which nobody else has until the block ends; it stays.

    What an earlier run left there is used if it is to be resumed, and removed if not; `tell` says so.

    Raises
    ------
    OutputError
        Another run has it, it holds something else, or it cannot be written.
    """
    path = path.absolute()
    try:
        _claim(path)
        with _lock_of(path):
            _tell_of_earlier(path, resume, tell)
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


@contextmanager
def open_store(url: UrlPath, *, resume: bool, tell: Callable[[str], None]) -> Iterator[UrlPath]:
    """Yield a place in a store for the parts of a run, as `open_work` yields a folder; `tell` says why it waits, too.

    Raises
    ------
    OutputError
        Another run has it, it holds something else, or it cannot be written.
    """
    names = url.names()
    if MARKER not in names:
        if names:
            raise OutputError(
                f"{url}: is not ours: there are files in it, and no {MARKER}", hint="choose another --work"
            )
        (url / MARKER).write_bytes(json.dumps(_WHAT).encode())
    with _living(url, tell):
        _tell_of_earlier(url, resume, tell)
        if not resume:
            _clear(url)
        yield url


def _tell_of_earlier(place: Place, resume: bool, tell: Callable[[str], None]) -> None:
    """Say where an earlier run is not gone on with: it left something, or there is nothing to resume."""
    is_left = has_parts(place)
    if is_left and not resume:
        tell(f"{place}: what an earlier run left unfinished is discarded; --resume goes on from it")
    if resume and not is_left:
        tell(f"{place}: there is nothing to resume: the work begins anew")


@contextmanager
def _living(url: UrlPath, tell: Callable[[str], None]) -> Iterator[None]:
    """Say until the block ends that a run lives; refuse where another one does.

    Of two that begin together each sees the other, as both say so before they look.
    """
    own = url / f"{_LIVING}{uuid4().hex}"
    is_over = Event()

    def beat() -> None:
        number = 1
        while not is_over.wait(_BEAT_S):
            with suppress(ValuemapError):  # The next one may come through.
                own.write_bytes(str(number).encode())
            number += 1

    own.write_bytes(b"0")
    thread = Thread(target=beat, daemon=True)
    thread.start()
    try:
        others = [url / name for name in url.names() if name.startswith(_LIVING) and url / name != own]
        if others:
            tell(f"{url}: another run is, or was, at work here: waiting {_WAIT_S:g} s for a sign of life")
        before = [_content(other) for other in others]
        time.sleep(_WAIT_S if others else 0.0)
        for other, found in zip(others, before, strict=True):
            if (now := _content(other)) is not None and now != found:
                raise OutputError(
                    f"{url}: another run is at work here", hint="wait for it to end, or choose another --work"
                )
        for other in others:
            other.unlink()
        yield
    finally:
        is_over.set()
        thread.join()
        own.unlink()


def _content(place: UrlPath) -> bytes | None:
    try:
        return place.read_bytes()
    except FileNotFoundError:
        return None


def _clear(url: UrlPath) -> None:
    """Remove the parts in a store; what says that a partition is whole goes before its files do."""
    names = [name for name in url.names() if name != MARKER and not name.startswith(_LIVING)]
    for name in names:
        if name.count("/") == 0 or (name.startswith("partition-") and name.count("/") == 1):
            (url / name).unlink()
    for folder in {name.partition("/")[0] for name in names if "/" in name}:
        (url / folder).remove_folder()


def has_parts(place: Place) -> bool:
    """Return whether a run has left anything to go on from."""
    if isinstance(place, UrlPath):
        return any(name.startswith((f"{CELLS}/", "partition-")) for name in place.names())
    return any(place.glob(f"{CELLS}/*.arrow")) or any(place.glob("partition-*"))


def remove_work(place: Place) -> None:
    """Remove the parts of a run that is over: the marker last, so that what a kill leaves of it is still ours."""
    if isinstance(place, UrlPath):
        _clear(place)
        (place / MARKER).unlink()
        return
    with suppress(OSError):
        _empty(place)
        shutil.rmtree(place)


def put(place: Place, content: bytes) -> None:
    """Write a file that is there whole, or not at all."""
    if isinstance(place, UrlPath):
        place.write_bytes(content)
        return
    with written(place) as temporary:
        temporary.write_bytes(content)


@contextmanager
def written_folder(place: Place) -> Iterator[Place]:
    """Yield where the files of a folder are to be written, the last of which says that it is whole."""
    if isinstance(place, UrlPath):
        yield place
        return
    with written(place) as temporary:
        temporary.mkdir()
        yield temporary


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, of a file or a folder, that is synced and renamed when the block ends well.

    Where another has done the same meanwhile, theirs stays: it is the same.
    """
    temporary = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=path.parent))
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
        if any(entry.name[: len(TEMPORARY)] != TEMPORARY for entry in path.iterdir()):
            raise OutputError(
                f"{path}: is not ours: there are files in it, and no {MARKER}", hint="choose another --work"
            )
        with written(path / MARKER) as file:
            file.write_text(json.dumps(_WHAT) + "\n", encoding="utf-8")


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
    for entry in [*path.glob(f"{TEMPORARY}*"), *path.glob(f"*/{TEMPORARY}*")]:
        _remove(entry)


def _remove(entry: Path) -> None:
    """Remove a file or folder; a folder is renamed first, so that what is there under its name is always whole."""
    if not entry.is_dir() or entry.is_symlink():
        entry.unlink(missing_ok=True)
    elif entry.name.startswith(TEMPORARY):
        shutil.rmtree(entry)
    else:
        aside = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=entry.parent))
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
