"""Labels in COCO's format: one JSON file for all pictures."""

from __future__ import annotations

from pathlib import Path

from valuemap.coco import read_labelled
from valuemap.detect.labels.pictures import BoxList, LabelledPictures


def read_coco(path: Path) -> LabelledPictures:
    """Read `images` (id, file_name), `annotations` (image_id, category_id, bbox) and `categories` (id, name).

    A bbox is x, y, width, height of continuous edges. An annotation with `iscrowd` is a place to ignore.
    Pictures are looked for beside the file, and in a folder `images` beside it.

    Raises
    ------
    InputError
        The file is missing, is no JSON, or lacks one of the lists.
    """
    content = read_labelled(path)
    boxes = {image: BoxList(content.skipped) for image in content.files}
    for number, (x, y, width, height) in enumerate(content.box_px.tolist()):
        boxes[content.image[number]].add(
            content.class_name[number],
            (x, y, x + width, y + height),
            f"{content.where}[{content.rows[number]}]",
            ignored=content.is_crowd[number],
        )
    pictures = tuple(boxes[image].picture(_find(path.parent, name)) for image, name in content.files.items())
    return LabelledPictures(f"coco:{path}", pictures, tuple(content.skipped))


def _find(folder: Path, name: str) -> Path:
    inside = folder / "images" / name
    return inside if inside.exists() and not (folder / name).exists() else folder / name
