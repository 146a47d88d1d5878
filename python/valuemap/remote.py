"""Files at URLs, in object stores or wherever else PyArrow or fsspec can read, as much like paths as reading needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from valuemap.errors import InputError
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
        system, path = self._place()
        try:
            with system.open_input_file(path) as file:
                content: bytes = file.read()
        except FileNotFoundError:
            raise
        except Exception as error:  # Of fsspec's systems each has its own.
            raise self._unreadable(error) from error
        return content

    def _type(self) -> str:
        system, path = self._place()
        try:
            return str(system.get_file_info(path).type.name)
        except Exception as error:
            raise self._unreadable(error) from error

    def _place(self) -> tuple[Any, str]:
        system, path = _system_of(self.root)
        return system, f"{path.rstrip('/')}/{self.name}" if self.name else path

    def _unreadable(self, error: Exception) -> InputError:
        return InputError(
            f"{self}: cannot be read: {first_line(error)}",
            hint="can this machine reach it, and may it read it? What was done is kept: run the same again",
        )


def place_of(text: str | Path) -> Path | UrlPath:
    """Return what a user calls a place: a URL or a path."""
    return UrlPath(text) if isinstance(text, str) and "://" in text else Path(text)


@lru_cache
def _system_of(root: str) -> tuple[Any, str]:
    """Return PyArrow's file system for a URL, or fsspec's through it, and the path in it."""
    import pyarrow as pa
    import pyarrow.fs as pa_fs  # Takes half a second, and only URLs need it.

    try:
        try:
            found: tuple[Any, str] = pa_fs.FileSystem.from_uri(root)
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
