"""Writing whole folders and files: beside first, then renamed, so that nothing is ever half-written."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from valuemap.errors import OutputError


@contextmanager
def new_folder(path: Path, *, marker: str, keep: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary folder beside `path` that takes its place when the block ends well.

    An existing folder is replaced only if it is empty or holds `marker` (the file that proves it is one
    of ours); the files named in `keep` stay in it. On any exception, Ctrl-C included, the temporary folder is removed
    and `path` is as before.

    Raises
    ------
    OutputError
        `path` is a file or somebody else's folder, or cannot be written.
    """
    path = path.absolute()
    workspace = None
    try:
        _check_replaceable(path, marker)
        path.parent.mkdir(parents=True, exist_ok=True)
        workspace = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        fresh, old = workspace / "fresh", workspace / "old"
        fresh.mkdir()
        yield fresh
        for name in keep:
            if (path / name).is_file():
                shutil.copy2(path / name, fresh / name)
        try:
            if path.exists():
                path.replace(old)
            fresh.replace(path)
        finally:
            if old.exists() and not path.exists():
                old.replace(path)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        if workspace is not None:
            shutil.rmtree(workspace, ignore_errors=True)


def check_place(path: Path, *, marker: str) -> None:
    """Find out before long work whether `new_folder` will be able to write; raises as it does."""
    with suppress(_Tried), new_folder(path, marker=marker):
        raise _Tried


class _Tried(Exception):
    """Leaves `new_folder` before it replaces anything."""


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file path beside `path` that takes its place when the block ends well.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    path = path.absolute()
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder, a file is to be written there", hint="name a file in it")
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        with suppress(OSError):  # There is none, if it was renamed or never begun.
            temporary.unlink()


def _check_replaceable(path: Path, marker: str) -> None:
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file, a folder is to be written there", hint="choose another --out")
    if path.is_dir() and any(path.iterdir()) and not (path / marker).is_file():
        raise OutputError(
            f"{path}: is a folder without {marker}, so it is not ours to replace",
            hint="choose another --out, or remove the folder first",
        )


def _cannot_write(path: Path, error: OSError) -> OutputError:
    reason = error.strerror or str(error)
    return OutputError(f"{path}: cannot be written: {reason}", hint="check the folder's permissions and free space")
