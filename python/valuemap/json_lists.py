"""JSON files of others that may be larger than memory: what their lists hold, a portion at a time.

Values and errors are those of the json module, whose decoder gets one entry of a list after the other.
"""

from __future__ import annotations

import codecs
import io
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from valuemap.errors import InputError
from valuemap.text_files import check_file, not_json, not_utf8, refuse_packed

PORTION = 20_000
"""Entries that are held together: objects of Python take a kilobyte each."""
_BLOCK = 2**20
"""Characters that are read at a time."""
_SPACE = re.compile(r"[ \t\n\r]*")
_CUT = 16
"""An error this close to the end of what is held may be none when more is read: words and escapes are shorter."""


@dataclass(frozen=True)
class Portion:
    """Some entries of a list, the first of which is the list's entry `first`: 0 is where a list begins.

    `key` is what the list is called in the object that the file is; None for the file itself. What is no list has no
    `entries` but a `value`.
    """

    key: str | None
    first: int
    entries: list[Any] | None
    value: Any = None


def read_json_lists(path: Path, expected: str) -> Iterator[Portion]:
    """Yield what is in a file that is a list, or an object of lists and other values, in its order.

    Of an empty list there is a portion, too. `expected` says in words what should be there.

    Raises
    ------
    InputError
        There is no such file, or it is no JSON; the latter may turn out after the first portions.
    """
    check_file(path, expected)
    refuse_packed(path, expected)
    try:
        with path.open("rb") as file:
            start = len(codecs.BOM_UTF8) if file.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8 else 0
            file.seek(start)
            try:
                text = _Text(io.TextIOWrapper(file, encoding="utf-8"))
                if not text.next():
                    raise InputError(f"{path}: is empty", hint=f"expected {expected}")
                yield from _content(text)
            except UnicodeDecodeError as error:
                byte = file.tell() - start - len(error.object) + error.start
                raise not_utf8(path, byte, expected) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", hint=f"expected {expected}") from error
    except (ValueError, RecursionError) as error:
        raise not_json(path, error) from error


def _content(text: _Text) -> Iterator[Portion]:
    if text.next() == "[":
        yield from _list(text, None)
    elif text.next() == "{":
        yield from _object(text)
    else:
        yield Portion(None, 0, None, text.value())
    if text.next():
        raise text.error("Extra data")


def _object(text: _Text) -> Iterator[Portion]:
    text.at += 1
    if text.next() == "}":
        text.at += 1
        return
    while True:
        if text.next() != '"':
            raise text.error("Expecting property name enclosed in double quotes")
        key = text.value()
        if text.next() != ":":
            raise text.error("Expecting ':' delimiter")
        text.at += 1
        if text.next() == "[":
            yield from _list(text, key)
        else:
            yield Portion(key, 0, None, text.value())
        if text.is_over("}"):
            return


def _list(text: _Text, key: str | None) -> Iterator[Portion]:
    text.at += 1
    entries: list[Any] = []
    first = 0
    if text.next() == "]":
        text.at += 1
    else:
        while True:
            entries.append(text.value())
            if text.is_over("]"):
                break
            if len(entries) == PORTION:
                yield Portion(key, first, entries)
                first += PORTION
                entries = []
            text.next()
    yield Portion(key, first, entries)


class _Text:
    """The text of a file from `at` on, as far as it was read."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._held, self.at = "", 0
        self._characters = self._lines = self._of_line = 0  # Before what is held; the last of its last line.
        self._decode = json.JSONDecoder().raw_decode

    def next(self) -> str:
        """Return the next character that is no space, and go there; an empty text at the end."""
        while True:
            space = _SPACE.match(self._held, self.at)
            assert space is not None
            self.at = space.end()
            if self.at < len(self._held):
                return self._held[self.at]
            if not self._read():
                return ""

    def is_over(self, end: str) -> bool:
        """Go behind the comma, or the bracket, that follows an entry; return whether it was the bracket."""
        found = self.next()
        if found not in (",", end):
            raise self.error("Expecting ',' delimiter")
        self.at += 1
        return found == end

    def value(self) -> Any:
        """Return the value that begins here, and go behind it."""
        while True:
            try:
                found, end = self._decode(self._held, self.at)
            except json.JSONDecodeError as error:
                is_cut = error.msg.startswith("Unterminated") or error.pos > len(self._held) - _CUT
                if is_cut and self._read():
                    continue
                raise self.error(error.msg, error.pos) from error
            if end > len(self._held) - _CUT and self._read():  # A number may go on.
                continue
            self.at = end
            return found

    def error(self, what: str, at: int | None = None) -> ValueError:
        """Return what the json module would raise of the whole file."""
        at = self.at if at is None else at
        before = self._held[:at]
        lines, newline = before.count("\n"), before.rfind("\n")
        column = at - newline if lines else self._of_line + at + 1
        return ValueError(f"{what}: line {self._lines + lines + 1} column {column} (char {self._characters + at})")

    def _read(self) -> bool:
        """Read on and forget what was decoded; return whether there was more, else all is as before."""
        block = self._file.read(max(_BLOCK, len(self._held) - self.at))  # Twice as much of what is larger than a block.
        if not block:
            return False
        gone = self._held[: self.at]
        self._characters += len(gone)
        self._lines += gone.count("\n")
        self._of_line = len(gone) - gone.rfind("\n") - 1 if "\n" in gone else self._of_line + len(gone)
        self._held, self.at = self._held[self.at :] + block, 0
        return True
