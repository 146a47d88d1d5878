"""ARCHITECTURE.md names files that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SECTIONS = re.split(r"^## ", (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
FOLDERS = {"Python": "python/valuemap", "Core": "crates/valuemap-core/src"}
"""Where the files of a section are, by the first word of its heading."""


def named(section: str) -> set[str]:
    """Paths in backticks: those that end as files of code do, or as folders."""
    return set(re.findall(r"`([\w./]+(?:\.py|\.rs|/))`", section))


@pytest.mark.parametrize("word", list(FOLDERS))
def test_every_file_that_is_named_is_there(word: str) -> None:
    (section,) = (text for text in SECTIONS if text.startswith(word))
    # `detect/` and `robust/` have tables of their own, of files in those folders.
    folders = [ROOT, *(ROOT / FOLDERS[word] / folder for folder in ("", "detect", "robust"))]
    paths = named(section)
    assert len(paths) > 10
    assert [path for path in sorted(paths) if not any((folder / path).exists() for folder in folders)] == []
