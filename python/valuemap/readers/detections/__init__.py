"""Readers of detections: one file a format, whatever the poses of their images come from."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa

from valuemap.errors import InputError, SettingError
from valuemap.json_lists import read_json_lists
from valuemap.readers.boxes import FiledBoxes, FoundBoxes
from valuemap.readers.detections.bosch import read_bosch
from valuemap.readers.detections.coco import read_coco
from valuemap.readers.detections.csv import read_csv_boxes
from valuemap.readers.detections.cvat import read_cvat
from valuemap.readers.detections.labelme import read_labelme
from valuemap.readers.detections.named_boxes import OF_OTHERS, DetectionFile, NamedBoxes, find_images
from valuemap.readers.detections.via import REGIONS, is_via, read_via
from valuemap.readers.detections.voc import read_voc
from valuemap.readers.detections.yolo import read_yolo
from valuemap.readers.files import check_file
from valuemap.tables import Cameras, Images
from valuemap.text_files import refuse_packed
from valuemap.yolo_names import NAMES_FILES

__all__ = ["DETECTIONS", "DetectionFile", "format_of", "read_detections"]

DETECTIONS: dict[str, Callable[[DetectionFile], NamedBoxes]] = {
    "coco": read_coco,
    "yolo": read_yolo,
    "cvat": read_cvat,
    "voc": read_voc,
    "labelme": read_labelme,
    "via": read_via,
    "bosch": read_bosch,
    "csv": read_csv_boxes,
}
"""What `--detections-format` names."""

_OF_SUFFIX = {".json": "coco", ".xml": "cvat", ".yaml": "bosch", ".yml": "bosch", ".csv": "csv", ".txt": "csv"}
_IN_FOLDER = {".txt": "yolo", ".xml": "voc", ".json": "labelme"}
_GOES_WITH = {"detection-images": ("coco",), "detection-column": ("csv", "via"), "fractions": ("csv",)}
"""Options that not every format has."""
_EXPECTED = "a file with detections, or a folder of them"
_START = 4096
_YOLO = re.compile(rb"(?:\xef\xbb\xbf)?\s*\d+(?:[ \t]+[-+.\de]+){4,}\s*")
"""A class and numbers, separated by spaces, where a table names its columns."""
_ROOT = re.compile(rb"<(?![?!])(\w+)")


def read_detections(file: DetectionFile | Path | None, images: Images, cameras: Cameras) -> FoundBoxes | FiledBoxes:
    """Read boxes and find their images by name; None where they are still to be found in the pictures.

    Raises
    ------
    InputError
        The file is missing, damaged or of another format, has no boxes, or was made on pictures of another size.
    SettingError
        The format is unknown, or an option does not go with it.
    """
    if file is None:
        return FoundBoxes.none()
    if isinstance(file, Path):
        file = DetectionFile(file)
    name = format_of(file)
    given = {
        "detection-images": file.image_list is not None,
        "detection-column": bool(file.columns),
        "fractions": file.fractions,
    }
    for option, formats in _GOES_WITH.items():
        if given[option] and name not in formats:  # A user would look for an effect that cannot be.
            raise SettingError(
                f"{option}: goes with detections in the format {' or '.join(formats)}, not with {name}",
                hint="leave this option away",
            )
    boxes = DETECTIONS[name](file)
    pa.default_memory_pool().release_unused()  # Of the file as it was read, which Arrow would keep for what comes next.
    return find_images(boxes, images, cameras, file)


def format_of(file: DetectionFile) -> str:
    """Return the format of detections, a name in `DETECTIONS`: the one that is given, else that of the files.

    The suffix says it, and where formats share one, how a file begins.

    Raises
    ------
    InputError
        The path does not say, is an archive or one file of YOLO's, or files of several formats are in the folder.
    SettingError
        There is no such format.
    """
    if file.format != "auto":
        if file.format not in DETECTIONS:
            raise SettingError(
                f"detections-format {file.format}: there is no such format",
                hint=f"one of auto, {', '.join(DETECTIONS)}",
            )
        return file.format
    if file.path.is_dir():
        return _of_folder(file.path)
    found = _OF_SUFFIX.get(Path(file.path.name.lower().removesuffix(".gz")).suffix)
    if found is None:
        check_file(file.path, _EXPECTED)
        refuse_packed(file.path, _EXPECTED)
        raise InputError(
            f"{file.path}: its name does not say the format of the detections",
            hint=f"give --detections-format, one of {', '.join(DETECTIONS)}",
        )
    return _by_content(file.path, found) if file.path.is_file() else found


def _of_folder(folder: Path) -> str:
    suffixes = {path.suffix.lower() for path in folder.rglob("*") if path.name not in NAMES_FILES}
    found = [suffix for suffix in _IN_FOLDER if suffix in suffixes]
    if len(found) > 1:
        raise InputError(
            f"{folder}: has files of several formats of detections: {', '.join(found)}",
            hint="name the folder of one of them, or give --detections-format, "
            + ", ".join(f"{_IN_FOLDER[suffix]} for {suffix}" for suffix in found),
        )
    name = _IN_FOLDER[found[0]] if found else "yolo"
    if name == "labelme":
        first = min(path for path in folder.rglob("*") if path.suffix.lower() == ".json")
        of_first = _of_json(first) if first.is_file() else name
        if of_first != name:
            raise InputError(
                f"{folder}: expected files of LabelMe, one a picture; {first.name} is no such file",
                hint=OF_OTHERS if of_first is None else f"it is {of_first}: name the file itself, --detections {first}",
            )
    return name


def _by_content(path: Path, by_name: str) -> str:
    """Return the format of a file by how it begins, where several have its suffix."""
    with path.open("rb") as file:
        start = file.read(_START)
    if by_name == "cvat":
        root = _ROOT.search(start)
        return "voc" if root is not None and root[1] == b"annotation" else by_name
    if by_name == "csv":
        if _YOLO.fullmatch(start.partition(b"\n")[0]):
            raise InputError(
                f"{path}: begins with a row of YOLO's format, a file of which is of one picture",
                hint=f"name the folder with the files of all pictures: --detections {path.parent}",
            )
        return "via" if REGIONS.encode() in start.partition(b"\n")[0] else by_name
    return (_of_json(path) or by_name) if by_name == "coco" else by_name


def _of_json(path: Path) -> str | None:
    """Return the format of a JSON file by the first members of it that tell; None where none does."""
    try:
        for portion in read_json_lists(path, "a JSON file of detections"):
            if portion.key in (None, "images", "annotations", "categories"):
                return "coco"
            if portion.key in ("shapes", "imagePath"):
                return "labelme"
            if is_via(portion.key, portion.value):
                return "via"
    except InputError:
        pass  # Who reads all of it says what is wrong.
    return None
