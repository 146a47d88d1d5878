"""Text and JSON files of others: regular ones only, whole, in UTF-8; whatever is wrong with one is one `InputError`."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

from valuemap.errors import InputError


def check_file(path: Path, expected: str) -> Path:
    """Return the path of a regular file; `expected` says in words what should be there.

    Raises
    ------
    InputError
        There is nothing, or a folder, a pipe or a device, which would never end.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no such file", hint=f"expected {expected}") from error
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "no regular file"
        raise InputError(f"{path}: is {kind}", hint=f"expected {expected}")
    return path


def read_text(path: Path, expected: str) -> str:
    """Return a file as text; `expected` says in words what should be there."""
    check_file(path, expected)
    refuse_packed(path, expected)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise not_utf8(path, error.start, expected) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", hint=f"expected {expected}") from error
    if not text.strip():
        raise InputError(f"{path}: is empty", hint=f"expected {expected}")
    return text


def not_utf8(path: Path, byte: int, expected: str) -> InputError:
    """Return what is wrong with a file that is no text; bytes are counted behind a mark of their order."""
    return InputError(
        f"{path}: cannot be read as text: byte {byte} is not UTF-8", hint=f"expected {expected}, in UTF-8"
    )


def refuse_packed(path: Path, expected: str) -> None:
    """Raise `InputError` where a file that should be text is packed."""
    try:
        with path.open("rb") as file:
            start = file.read(4)
    except OSError:
        return  # Whoever reads it says why.
    for mark, what in ((b"\x1f\x8b", "gzip"), (b"PK\3\4", "a zip archive or a spreadsheet")):
        if start.startswith(mark):
            raise InputError(f"{path}: is {what}", hint=f"unpack it first; expected {expected}")


def read_json(path: Path, expected: str) -> Any:
    """Return what a JSON file holds; `expected` says in words what should be there."""
    text = read_text(path, expected)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise not_json(path, error) from error


def not_json(path: Path, error: Exception) -> InputError:
    """Return the error of a file that is no JSON."""
    return InputError(
        f"{path}: cannot be read as JSON: {first_line(error)}", hint="is it whole? Write or download it again"
    )


def first_line(error: BaseException) -> str:
    """Return what an exception says, on one line."""
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
