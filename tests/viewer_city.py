"""A street with pictures, and maps of it from fewer or more images, for the tests of the page."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import valuemap
from scenes import HEIGHT, WIDTH, as_dataset, random_scene
from valuemap.dataset import Dataset
from valuemap.map_folder import Map
from valuemap.tables import Categories

HOSTILE = "<img src=x onerror=\"document.title='pwned'\">"
"""A class name that would be a program, were it taken for HTML."""


def street() -> Dataset:
    """Return 120 images along a street with eight objects; every third is of the pass `two`."""
    passes = ["two" if i % 3 == 2 else "one" for i in range(120)]
    dataset = as_dataset(random_scene(7, images=120, objects=8, clutter=40), passes=passes)
    classes = Categories.from_texts([HOSTILE] * len(dataset.detections))
    return dataclasses.replace(dataset, name="<b>street</b>", detections=dataset.detections.replace(class_name=classes))


def part(dataset: Dataset, *passes: str) -> Dataset:
    """Return the images of some passes, with their detections."""
    wanted = [name in passes for name in dataset.images.pass_id.texts()]
    images = dataset.images.take(np.array(wanted))
    detections = dataset.detections
    return dataclasses.replace(
        dataset, images=images, detections=detections.take(np.isin(detections.image_id, images.image_id))
    )


def write_pictures(dataset: Dataset, folder: Path) -> None:
    """Draw a lamp for every detection on a grey picture."""
    for image_id, name in zip(dataset.images.image_id, dataset.images.name.to_pylist(), strict=True):
        picture = Image.new("RGB", (WIDTH, HEIGHT), (110, 120, 130))
        pen = ImageDraw.Draw(picture)
        for row in np.flatnonzero(dataset.detections.image_id == image_id):
            (x, y), (w, h) = dataset.detections.center_px[row], dataset.detections.size_px[row]
            pen.rectangle([x - w / 2, y - h / 2, x + w / 2, y + h / 2], fill=(200, 30, 20))
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.save(path, quality=80)


@cache
def mapped(*passes: str) -> tuple[Dataset, Map]:
    """Return the images of some passes, and their map; their poses are those of the simulation."""
    dataset = part(street(), *passes)
    return dataset, valuemap.build_map(dataset, valuemap.MapConfig(correct_poses=0), threads=1)


def write_city(folder: Path, *passes: str) -> Map:
    """Write a dataset, its pictures and its map below a folder."""
    dataset, result = mapped(*passes)
    valuemap.write_dataset(dataset, folder / "dataset")
    write_pictures(dataset, folder / "dataset" / "images")
    valuemap.write_map(result, folder / "map")
    return result
