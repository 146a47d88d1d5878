"""Boxes that were found earlier, by picture: of a dataset, or of a folder of pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from valuemap.dataset import MARKER, read_images, rows_of
from valuemap.detect.accuracy import FoundBoxes
from valuemap.detect.labels import LabelledPictures
from valuemap.detect.run import RESULTS
from valuemap.errors import InputError
from valuemap.tables import Detections, read_table


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
    row = rows_of(detections.image_id, images.image_id)
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], np.arange(len(images) + 1))
    place = np.concatenate([detections.center_px, detections.size_px], axis=1)
    classes = detections.class_name.texts()
    found = {}
    for i, name in enumerate(images.name.to_pylist()):
        rows = order[first[i] : first[i + 1]]
        found[name] = FoundBoxes(place[rows], detections.score[rows], [classes[j] for j in rows])
    return found


def _of_results(file: Path) -> dict[str, FoundBoxes]:
    try:
        content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        names = {image["id"]: str(image["file_name"]) for image in content["images"]}
        classes = {category["id"]: str(category["name"]) for category in content["categories"]}
        rows: dict[Any, list[tuple[list[float], float, str]]] = {image_id: [] for image_id in names}
        for entry in content["annotations"]:
            x, y, width, height = (float(number) for number in entry["bbox"])
            box = [x + width / 2.0, y + height / 2.0, width, height]
            rows[entry["image_id"]].append((box, float(entry.get("score", 1.0)), classes[entry["category_id"]]))
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise InputError(
            f"{file}: is no COCO file of images, annotations and categories: {error!r}",
            hint="make it with valuemap detect",
        ) from error
    return {
        names[image_id]: FoundBoxes(
            np.array([box for box, _, _ in entries], dtype=np.float64).reshape(-1, 4),
            np.array([score for _, score, _ in entries], dtype=np.float64),
            [name for _, _, name in entries],
        )
        for image_id, entries in rows.items()
    }
