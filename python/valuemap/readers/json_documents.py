"""Answers of web services as people keep them: files of JSON, or of a JSON document a line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

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
    """Yield what a file holds.

    Raises
    ------
    InputError
        It is no JSON.
    """
    hint = f"expected {expected}"
    if path.suffix not in LINES:
        yield Json(read_json(path, expected), str(path), hint)
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
