"""Boxes that were found earlier, by picture: of a dataset, or of a folder of pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from valuemap.arrays import RowsByNumber
from valuemap.coco import read_labelled
from valuemap.dataset import MARKER, read_images, rows_of
from valuemap.detect.accuracy import FoundBoxes
from valuemap.detect.labels import LabelledPictures
from valuemap.detect.run import RESULTS
from valuemap.errors import InputError
from valuemap.tables import Detections
from valuemap.tables.read import read_table


def read_found(place: Path) -> dict[str, FoundBoxes]:
    """Read the boxes of a dataset, or of the `detections.json` in a folder of pictures, by name of the picture.

    Raises
    ------
    InputError
        There is neither, or it cannot be read.
    """
    if (place / MARKER).is_file():
        return _of_dataset(place)
    file = place / RESULTS if place.is_dir() else place
    if not file.is_file():
        raise InputError(f"{place}: has neither {MARKER} nor {RESULTS}", hint="make them with valuemap detect")
    return _of_results(file)


def match_pictures(found: Mapping[str, FoundBoxes], labels: LabelledPictures) -> dict[Path, FoundBoxes]:
    """Return the boxes by the path of the labelled picture: that ends as the name does, or alone has its file name.

    Boxes of pictures without labels keep their name.

    Raises
    ------
    InputError
        None of the pictures is labelled.
    """
    by_file: dict[str, list[Path]] = {}
    for picture in labels.pictures:
        by_file.setdefault(picture.path.name, []).append(picture.path)
    names_of_file: dict[str, int] = {}
    for name in found:
        file = PurePosixPath(name).name
        names_of_file[file] = names_of_file.get(file, 0) + 1
    matched = {}
    for name, boxes in found.items():
        parts = PurePosixPath(name).parts
        same_file = by_file.get(parts[-1], [])
        exact = [path for path in same_file if path.parts[-len(parts) :] == parts]
        if len(exact) == 1:
            matched[exact[0]] = boxes
        elif len(same_file) == 1 and names_of_file[parts[-1]] == 1:
            matched[same_file[0]] = boxes
        else:
            matched[Path(name)] = boxes
    if not matched.keys() & {picture.path for picture in labels.pictures}:
        raise InputError(
            f"{labels.source}: none of the {len(found)} pictures with detections is labelled there",
            hint=f"pictures are matched by file name, as in {next(iter(found), '?')!r}",
        )
    return matched


def _of_dataset(folder: Path) -> dict[str, FoundBoxes]:
    _, images = read_images(folder)
    detections = read_table(Detections, folder / "detections.parquet")
    by_image = RowsByNumber.of(rows_of(detections.image_id, images.image_id), len(images))
    place = np.concatenate([detections.center_px, detections.size_px], axis=1)
    classes = detections.class_name.texts()
    found = {}
    for i, name in enumerate(images.name.to_pylist()):
        rows = by_image[i]
        found[name] = FoundBoxes(place[rows], detections.score[rows], [classes[j] for j in rows])
    return found


def _of_results(file: Path) -> dict[str, FoundBoxes]:
    content = read_labelled(file)
    if content.skipped:
        raise InputError(
            f"{content.skipped[0]} ({len(content.skipped)} entries)", hint="make the file with valuemap detect"
        )
    boxes = np.concatenate([content.box_px[:, :2] + content.box_px[:, 2:] / 2.0, content.box_px[:, 2:]], axis=1)
    rows: dict[Any, list[int]] = {image: [] for image in content.files}
    for row, image in enumerate(content.image):
        rows[image].append(row)
    return {
        content.files[image]: FoundBoxes(boxes[own], content.score[own], [content.class_name[row] for row in own])
        for image, own in rows.items()
    }
