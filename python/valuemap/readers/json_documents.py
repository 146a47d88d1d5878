"""Answers of web services as people keep them: files of JSON, or of a JSON document a line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from valuemap.errors import InputError
from valuemap.readers.files import check_file, file_in, read_json, read_text
from valuemap.readers.json_values import Json
from valuemap.text_files import first_line

LINES = (".jsonl", ".ndjson", ".geojsonl")
"""Files of a document a line."""


def files_of(export: Path, suffixes: tuple[str, ...], expected: str, besides: str | None = None) -> list[Path]:
    """Return the file, or those of a folder with these suffixes; not the one of the name `besides`.

    Raises
    ------
    InputError
        There is no such file, or none in the folder.
    """
    if not export.is_dir():
        return [check_file(export, expected)]
    names = sorted(path.name for path in export.iterdir() if path.suffix in suffixes and path.name != besides)
    if not names:
        raise InputError(f"{export}: there are no JSON files in it", hint=f"expected {expected}")
    return [file_in(export, name, expected) for name in names]


def documents_of(path: Path, expected: str) -> Iterator[Json]:
    """Yield what a file holds; one of a document a line may be called as one of a single document.

    Raises
    ------
    InputError
        It is no JSON.
    """
    hint = f"expected {expected}"
    if path.suffix not in LINES:
        try:
            content = read_json(path, expected)
        except InputError as error:
            if not _is_of_second_line(error.__cause__):
                raise
        else:
            yield Json(content, str(path), hint)
            return
    for number, line in enumerate(read_text(path, expected).split("\n"), start=1):
        if not line.strip():
            continue
        where = f"{path} line {number}"
        try:
            yield Json(json.loads(line), where, hint)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{where}: cannot be read as JSON: {first_line(error)}", hint="is it whole? Write or download it again"
            ) from error


def _is_of_second_line(error: BaseException | None) -> bool:
    """Return whether the first line is a document, and more begins in the second."""
    return isinstance(error, json.JSONDecodeError) and (error.msg, error.lineno, error.colno) == ("Extra data", 2, 1)


class Pages:
    """Which answers say that a further page follows, and which of these pages are not here.

    A page that says its own address is the one that another one names as its next. Others make chains of one question,
    each of which ends in a page without a next one.
    """

    def __init__(self) -> None:
        self._next: dict[str, str] = {}
        self._of_chain: dict[Any, list[str]] = {}
        self._here: set[str] = set()
        self._ends = 0

    def add(self, where: str, following: str | None, itself: str | None = None) -> None:
        """Take an answer, with the addresses of the page after it and of itself as far as it says them."""
        if itself is not None:
            self._here.add(itself)
            if following is not None:
                self._next.setdefault(following, where)
        elif following is not None:
            url = urlsplit(following)
            asked = sorted(pair for pair in parse_qsl(url.query) if pair[0] not in _OF_PAGE)
            self._of_chain.setdefault((url.netloc, url.path, *asked), []).append(where)
        else:
            self._ends += 1

    def told(self) -> Iterator[str]:
        """Yield what is to be told of pages that are not here."""
        without = [where for address, where in self._next.items() if address not in self._here]
        if len(self._of_chain) > self._ends:
            without += [pages[-1] for pages in self._of_chain.values()]
        if without:
            yield (
                f"{without[0]}: says that a further page follows, which is not here ({len(without)} answers): only "
                "what is here is read; ask for the next page until there is none, and give a folder of all of them"
            )


_OF_PAGE = frozenset(("access_token", "after", "before", "limit"))
"""What an address says of its page and not of the question."""
