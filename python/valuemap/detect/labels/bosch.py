"""Labels of the Bosch Small Traffic Lights dataset: one YAML file for all pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from valuemap.detect.labels.pictures import BoxList, LabelledPicture, LabelledPictures
from valuemap.errors import InputError
from valuemap.yaml_text import load_yaml

_EDGES = ("x_min", "y_min", "x_max", "y_max")


def read_bosch(path: Path) -> LabelledPictures:
    """Read a list of `{path, boxes: [{label, x_min, x_max, y_min, y_max, occluded}]}`; edges are in px.

    Pictures are looked for relative to the file; where a path is absolute (as in the published test labels) and
    not there, its longest tail that exists beside the file is taken.

    Raises
    ------
    InputError
        The file is missing, is no YAML, or holds no list.
    """
    entries = _load(path)
    skipped: list[str] = []
    pictures = [
        picture
        for row, entry in enumerate(entries)
        if (picture := _picture(entry, f"{path} entry {row}", path.parent, skipped)) is not None
    ]
    return LabelledPictures(f"bosch:{path}", tuple(pictures), tuple(skipped))


def _load(path: Path) -> list[Any]:
    try:
        content = load_yaml(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file", hint="give the YAML file of the labels") from None
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read as YAML: {reason}", hint="is it whole? Fetch it again") from error
    if not isinstance(content, list):
        raise InputError(
            f"{path}: expected a list of pictures, found {type(content).__name__}",
            hint="expected are entries like {path: a.png, boxes: [{label: Red, x_min: 1, ...}]}",
        )
    return content


def _picture(entry: Any, where: str, folder: Path, skipped: list[str]) -> LabelledPicture | None:
    name = entry.get("path") if isinstance(entry, dict) else None
    boxes = entry.get("boxes") if isinstance(entry, dict) else None
    if not isinstance(name, str) or not isinstance(boxes, list):
        skipped.append(f"{where}: expected a path and a list of boxes")
        return None
    found = BoxList(skipped)
    for number, box in enumerate(boxes):
        here = f"{where} box {number}"
        try:
            found.add(str(box["label"]), [float(box[edge]) for edge in _EDGES], here)
        except (KeyError, TypeError, ValueError):
            skipped.append(f"{here}: expected label, {', '.join(_EDGES)}, found {box!r}")
    return found.picture(_find(folder, name))


def _find(folder: Path, name: str) -> Path:
    path = folder / name
    if not Path(name).is_absolute() or path.exists():
        return path
    parts = path.parts[1:]
    tails = (folder.joinpath(*parts[start:]) for start in range(len(parts)))
    return next((tail for tail in tails if tail.exists()), path)
