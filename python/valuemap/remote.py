"""Files at URLs, in object stores or wherever else PyArrow or fsspec can go, as much like paths as is needed.

Files are written at once: in object stores one is there whole, or not at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from valuemap.errors import InputError, OutputError
from valuemap.text_files import first_line


@dataclass(frozen=True)
class UrlPath:
    """A file or folder by its name below a URL; names are as they are, URLs as URLs are written.

    It is only text: who may read is found out by each machine for itself, from its environment.
    """

    root: str
    name: str = ""

    def __truediv__(self, name: str) -> UrlPath:
        return UrlPath(self.root, f"{self.name}/{name}" if self.name else name)

    def __str__(self) -> str:
        """Return the URL without a password."""
        parts = urlsplit(self.root)
        who, at, where = parts.netloc.rpartition("@")
        place = where if ":" in who else who + at + where
        return f"{parts.scheme}://{place}{parts.path.rstrip('/')}" + (f"/{self.name}" if self.name else "")

    def absolute(self) -> UrlPath:
        """Return the same: it means the same wherever it is read."""
        return self

    def is_dir(self) -> bool:
        """Return whether there is such a folder, or anything whose name goes on like this."""
        return self._type() == "Directory"

    def is_file(self) -> bool:
        """Return whether there is such a file."""
        return self._type() == "File"

    def read_bytes(self) -> bytes:
        """Return what the file holds.

        Raises
        ------
        FileNotFoundError
            There is none.
        InputError
            Whether there is one cannot be known: the network is down, say, or it may not be read.
        """
        try:
            return self._content()
        except FileNotFoundError:
            raise
        except Exception:  # Of fsspec's systems each has its own.
            # What another run removes or writes anew between a look at its size and at its content fails like this.
            try:
                return self._content()
            except FileNotFoundError:
                raise
            except Exception as error:
                raise self._unreadable(error) from error

    def _content(self) -> bytes:
        system, path = self._place()
        # A file of fsspec may be one for all who open it, with one position: that in memory is.
        if (store := _fsspec_of(system)) is not None:
            content: bytes = store.cat_file(path)
        else:
            with system.open_input_file(path) as file:
                content = file.read()
        return content

    def write_bytes(self, content: bytes) -> None:
        """Write the file, in place of one that is there.

        Raises
        ------
        OutputError
            It cannot be written.
        """
        system, path = self._place()
        try:
            if (store := _fsspec_of(system)) is not None:
                store.pipe_file(path, content)
            else:
                with system.open_output_stream(path) as file:
                    file.write(content)
        except Exception as error:
            raise self._unwritable(error) from error

    def names(self) -> list[str]:
        """Return the names of all files below this one, ascending; none where there is no such folder."""
        import pyarrow.fs as pa_fs

        system, path = self._place()
        try:
            _forget_listings(system)
            found = system.get_file_info(pa_fs.FileSelector(path, recursive=True, allow_not_found=True))
        except Exception as error:
            raise self._unreadable(error) from error
        above = len(path.strip("/")) + 1
        return sorted(info.path.strip("/")[above:] for info in found if info.type == pa_fs.FileType.File)

    def unlink(self) -> None:
        """Remove the file, if it is there."""
        system, path = self._place()
        try:
            system.delete_file(path)
        except FileNotFoundError:
            pass
        except Exception as error:
            if self.is_file():
                raise self._unwritable(error) from error

    def remove_folder(self) -> None:
        """Remove the folder with all that is in it, if it is there."""
        system, path = self._place()
        try:
            _forget_listings(system)
            system.delete_dir(path)
        except FileNotFoundError:
            pass
        except Exception as error:
            if self.is_dir():
                raise self._unwritable(error) from error

    def _type(self) -> str:
        system, path = self._place()
        try:
            _forget_listings(system)
            return str(system.get_file_info(path).type.name)
        except Exception as error:
            raise self._unreadable(error) from error

    def _place(self) -> tuple[Any, str]:
        system, path = _system_of(self.root)
        return system, f"{path.rstrip('/')}/{self.name}" if self.name else path

    def _unwritable(self, error: Exception) -> OutputError:
        return OutputError(
            f"{self}: cannot be written: {first_line(error)}",
            hint="can this machine reach it, and may it write there? The same command with --resume then goes on",
        )

    def _unreadable(self, error: Exception) -> InputError:
        return InputError(
            f"{self}: cannot be read: {first_line(error)}",
            hint="can this machine reach it, and may it read it? What was done is kept: run the same again",
        )


Place = Path | UrlPath
"""Where a file or folder is."""
_AT_ONCE = 16
"""Files that are read from a store together: to wait for each would take longer than to work on it."""


def name_of(place: Place) -> str:
    """Return the last part of the name of a file."""
    return place.name.rpartition("/")[2]


def read_all(places: Sequence[Place]) -> Iterator[bytes]:
    """Yield what files hold, in their order."""
    if not any(isinstance(place, UrlPath) for place in places):
        yield from (place.read_bytes() for place in places)
        return
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for first in range(0, len(places), _AT_ONCE):
            yield from pool.map(lambda place: place.read_bytes(), places[first : first + _AT_ONCE])


def _fsspec_of(system: Any) -> Any | None:
    """Return the file system of fsspec that one of PyArrow goes through, if it does."""
    return getattr(getattr(system, "handler", None), "fs", None)


def _forget_listings(system: Any) -> None:
    """Let a file system look again for what others have written; some of fsspec's remember what they saw."""
    if (store := _fsspec_of(system)) is not None:
        store.invalidate_cache()


def place_of(text: str | Path) -> Path | UrlPath:
    """Return what a user calls a place: a URL or a path."""
    return UrlPath(text) if isinstance(text, str) and "://" in text else Path(text)


def folder_of(place: Place) -> Place:
    """Return the folder that a URL of this machine's own files names; other places as they are."""
    parts = urlsplit(str(place)) if isinstance(place, UrlPath) else None
    return Path(unquote(parts.path)) if parts is not None and parts.scheme == "file" else place


def _with_one_request(root: str) -> str:
    """Return a URL by which a file is written to S3 in one request, where it would be three."""
    if not root.startswith("s3://") or "allow_delayed_open" in root:
        return root
    return f"{root}{'&' if '?' in root else '?'}allow_delayed_open=true"


@lru_cache
def _system_of(root: str) -> tuple[Any, str]:
    """Return PyArrow's file system for a URL, or fsspec's through it, and the path in it."""
    import pyarrow as pa
    import pyarrow.fs as pa_fs  # Takes half a second, and only URLs need it.

    try:
        try:
            found: tuple[Any, str] = pa_fs.FileSystem.from_uri(_with_one_request(root))
        except pa.ArrowInvalid:
            if root.startswith("fsspec+"):
                raise
            found = pa_fs.FileSystem.from_uri(f"fsspec+{root}")
    except Exception as error:
        raise InputError(
            f"{UrlPath(root)}: no store can be opened by this URL: {first_line(error)}",
            hint="s3, gs, abfs and file are known; others where fsspec and its package for them are installed",
        ) from error
    return found
