"""Readers of detections: one file a format, whatever the poses of their images come from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa

from valuemap.errors import InputError, SettingError
from valuemap.readers.boxes import FiledBoxes, FoundBoxes
from valuemap.readers.detections.bosch import read_bosch
from valuemap.readers.detections.coco import read_coco
from valuemap.readers.detections.csv import read_csv_boxes
from valuemap.readers.detections.cvat import read_cvat
from valuemap.readers.detections.named_boxes import DetectionFile, NamedBoxes, find_images
from valuemap.readers.detections.yolo import read_yolo
from valuemap.readers.files import check_file
from valuemap.tables import Cameras, Images

__all__ = ["DETECTIONS", "DetectionFile", "format_of", "read_detections"]

DETECTIONS: dict[str, Callable[[DetectionFile], NamedBoxes]] = {
    "coco": read_coco,
    "yolo": read_yolo,
    "cvat": read_cvat,
    "bosch": read_bosch,
    "csv": read_csv_boxes,
}
"""What `--detections-format` names."""

_OF_SUFFIX = {".json": "coco", ".xml": "cvat", ".yaml": "bosch", ".yml": "bosch", ".csv": "csv", ".txt": "csv"}


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
    if file.image_list is not None and name != "coco":
        raise SettingError(
            f"detection-images: goes with results in COCO's format, not with {name}", hint="leave this option away"
        )
    boxes = DETECTIONS[name](file)
    pa.default_memory_pool().release_unused()  # Of the file as it was read, which Arrow would keep for what comes next.
    return find_images(boxes, images, cameras, file)


def format_of(file: DetectionFile) -> str:
    """Return the format of detections, a name in `DETECTIONS`: the one that is given, else what the path says.

    Raises
    ------
    InputError
        The path does not say.
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
        return "yolo"
    found = _OF_SUFFIX.get(Path(file.path.name.lower().removesuffix(".gz")).suffix)
    if found is None:
        check_file(file.path, "a file with detections, or a folder of YOLO's")
        raise InputError(
            f"{file.path}: its name does not say the format of the detections",
            hint=f"give --detections-format, one of {', '.join(DETECTIONS)}",
        )
    return found
