"""What lies beside labels in YOLO's format: the names of classes, and how many numbers key points have."""

from __future__ import annotations

import math
import os.path
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from valuemap.errors import InputError
from valuemap.text_files import read_text
from valuemap.yaml_text import load_yaml

NAMES_FILES = ("data.yaml", "data.yml", "dataset.yaml", "dataset.yml", "classes.txt", "obj.names")
_ABOVE = 2
"""Folders above labels that may hold the names: parts of a dataset lie in `train/labels` or `labels/train`."""
BOX = 4
"""Numbers of a box: centre x and y, width and height."""


@dataclass(frozen=True)
class YoloNames:
    """The names of classes by number, and how many values of key points follow a box."""

    name_of: dict[int, str]
    key_values: int = 0

    def name(self, code: int) -> str:
        """Return the name of a class, none where others have names; where none has, class 9 is `class-9`."""
        return self.name_of.get(code, "") if self.name_of else f"class-{code}"

    def without_key_points(self, values: Sequence[float]) -> list[float]:
        """Return the numbers of a row behind its class without those of key points, which follow the box."""
        has_key_points = len(values) >= BOX + self.key_values
        return [*values[:BOX], *values[BOX + self.key_values :]] if has_key_points else list(values)


def yolo_names(folder: Path) -> YoloNames:
    """Read `data.yaml`, `dataset.yaml` (names, kpt_shape), `classes.txt` or `obj.names` (a name a line).

    The first that is in the folder or in one of the two above counts; where there is none, nothing is known.

    Raises
    ------
    InputError
        The file is no text, or its names are none.
    """
    above = Path(os.path.abspath(folder)).parents  # noqa: PTH100 (a link to a folder is where it is)
    places = (place / name for place in (folder, *above[:_ABOVE]) for name in NAMES_FILES)
    path = next((path for path in places if path.is_file()), None)
    if path is None:
        return YoloNames({})
    if path.suffix not in (".yaml", ".yml"):
        lines = read_text(path, "one name of a class a line").splitlines()
        return YoloNames({code: name.strip() for code, name in enumerate(lines)})
    try:
        content = load_yaml(read_text(path, "a YAML file with names").encode())
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as YAML: {error}", hint="is it whole? Write it again") from error
    return YoloNames(_names_in(content, path), _key_values_in(content))


def _names_in(content: Any, path: Path) -> dict[int, str]:
    """Return the names of a list or by number; speeds and the like may be written as numbers."""
    names = content.get("names") if isinstance(content, dict) else None
    pairs = list(names.items() if isinstance(names, dict) else enumerate(names) if isinstance(names, list) else [])
    if not pairs:
        raise InputError(
            f"{path}: expected names of the classes, a list or by number",
            hint="write names: [traffic light] into it",
        )
    for code, name in pairs:
        if not str(code).isdecimal() or isinstance(name, bool) or not isinstance(name, str | int | float):
            raise InputError(
                f"{path}: names: expected a class by its number, found {code!r}: {name!r}",
                hint="put names such as yes, no, on and off in quotes",
            )
    return {int(code): str(name).strip() for code, name in pairs}


def _key_values_in(content: dict[str, Any]) -> int:
    shape: Any = content.get("kpt_shape")
    is_shape = isinstance(shape, list) and len(shape) == 2 and all(type(each) is int and each > 0 for each in shape)
    return math.prod(shape) if is_shape else 0
