"""Reading the files of others: regular ones only, whole, as text, JSON, YAML or XML, and only inside their folder.

Whatever is wrong with a file is one `InputError`. Names that a file gives to other files must not lead out of the
folder, YAML must have no aliases and XML no document type: an alias or an entity that names itself ten times, ten times
over, is a few bytes on disk and fills the memory.
"""

from __future__ import annotations

import reprlib
import xml.parsers.expat
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from valuemap.errors import InputError
from valuemap.text_files import check_file, first_line, read_json, read_text
from valuemap.yaml_text import load_yaml

__all__ = [
    "check_file",
    "check_folder",
    "check_names",
    "file_in",
    "files_below",
    "read_json",
    "read_text",
    "read_xml",
    "read_yaml",
    "refuse_repeated_names",
]

_MAX_NAME = 1000


def check_folder(path: Path, expected: str) -> Path:
    """Return the path of a folder; `expected` says in words what should be there."""
    if not path.is_dir():
        found = "is a file" if path.exists() else "no such folder"
        raise InputError(f"{path}: {found}", hint=f"expected {expected}")
    return path


def file_in(folder: Path, name: str, expected: str) -> Path:
    """Return the path of a regular file in a folder; neither its name nor a link may lead out of the folder.

    Raises
    ------
    InputError
        The name is absolute or goes up, the file is elsewhere, is missing, or is no regular file.
    """
    if not _stays_inside(name):
        raise InputError(
            f"{folder}: {_short(name)}: leads out of the folder",
            hint="file names must be relative, without .. in them",
        )
    path = check_file(folder / name, expected)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(
            f"{path}: is a link that leads out of {folder}",
            hint="put the file itself into the folder",
        )
    return path


def check_names(names: list[str], source: str) -> None:
    """Refuse names of images that could mean a file outside the folder of the pictures, or none at all."""
    for name in names:
        if len(name) > _MAX_NAME:
            raise InputError(
                f"{source}: image name {_short(name)}: expected at most {_MAX_NAME} letters, found {len(name)}",
                hint="give the pictures shorter names",
            )
        if not name.isprintable():
            odd = next(letter for letter in name if not letter.isprintable())
            raise InputError(
                f"{source}: image name {_short(name)}: expected letters that can be printed, found {odd!r}",
                hint="is a quotation mark missing in the file, or is it in another encoding?",
            )
        if not _stays_inside(name):
            raise InputError(
                f"{source}: image name {_short(name)}: expected a relative name that stays in the folder",
                hint="names must be texts without .. and not absolute, e.g. monday/cam0/000123.jpg",
            )


def refuse_repeated_names(names: Sequence[str], source: str) -> None:
    """Refuse names of images that are there twice."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise InputError(
            f"{source}: {len(repeated)} image names occur more than once, the first is {min(repeated)!r}",
            hint="detections are matched by file name: give every image a name of its own",
        )


def _stays_inside(name: str) -> bool:
    path = PurePosixPath(name)
    is_drive = bool(PureWindowsPath(name).drive)
    printable = name.isprintable() and 0 < len(name) <= _MAX_NAME
    return printable and not path.is_absolute() and not is_drive and ".." not in path.parts and str(path) != "."


def read_yaml(path: Path, expected: str) -> Any:
    """Return what a YAML file holds, which must not have aliases."""
    try:
        return load_yaml(read_text(path, expected).encode())
    except ValueError as error:
        raise InputError(
            f"{path}: cannot be read as YAML: {error}", hint="is it whole? Write or download it again"
        ) from error


def read_xml(
    path: Path,
    expected: str,
    on_element: Callable[[str, dict[str, str], int], None],
    on_text: Callable[[str, str, int], None] | None = None,
) -> None:
    """Call `on_element(name, attributes, line)` for every opening tag of an XML file, in their order.

    Parameters
    ----------
    path, expected
        The file, and in words what should be there.
    on_element
        Called as `on_element(name, attributes, line)` for an opening tag, and with `/name` for a closing one.
    on_text
        Called as `on_text(name, text, line)` before the closing tag of an element that has no others in it, with the
        text between its tags, without spaces around it.
    """
    text = read_text(path, expected)
    parser = xml.parsers.expat.ParserCreate("utf-8")  # Whatever the file says: it is text by now.
    innermost: list[str] | None = None
    """The text since the last opening tag, where no other tag came after it."""

    def refuse(*_: Any) -> None:
        raise InputError(
            f"{path} line {parser.CurrentLineNumber}: has a document type", hint="remove <!DOCTYPE ...> from the file"
        )

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal innermost
        innermost = []
        on_element(name, attributes, parser.CurrentLineNumber)

    def end(name: str) -> None:
        nonlocal innermost
        if innermost is not None and on_text is not None:
            on_text(name, "".join(innermost).strip(), parser.CurrentLineNumber)
        innermost = None
        on_element(f"/{name}", {}, parser.CurrentLineNumber)

    def characters(part: str) -> None:
        if innermost is not None:
            innermost.append(part)

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, characters
    try:
        parser.Parse(text.encode(), True)
    except xml.parsers.expat.ExpatError as error:
        raise InputError(
            f"{path}: cannot be read as XML: {first_line(error)}", hint="is it whole? Write or download it again"
        ) from error


def files_below(path: Path, suffix: str, expected: str) -> list[tuple[str, Path]]:
    """Return the file, or those of a folder and the ones in it with this suffix, each with its name in the folder.

    Raises
    ------
    InputError
        There is no such file, none in the folder, or one is a link that leads out of it.
    """
    if not path.is_dir():
        return [(path.name, check_file(path, expected))]
    names = sorted(each.relative_to(path).as_posix() for each in path.rglob("*") if each.suffix.lower() == suffix)
    if not names:
        raise InputError(f"{path}: there are no {suffix} files in it", hint=f"expected {expected}")
    return [(name, file_in(path, name, expected)) for name in names]


def _short(text: str) -> str:
    return reprlib.repr(text)
