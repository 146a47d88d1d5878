"""Labels as YOLO text: a file a picture, a line an object."""

from __future__ import annotations

from pathlib import Path

from valuemap.detect.labels.pictures import SPLITS, BoxList, LabelledPicture, LabelledPictures
from valuemap.detect.pictures import list_pictures
from valuemap.errors import InputError
from valuemap.yolo_names import YoloNames, yolo_names

_TRANSPOSED = frozenset({5, 6, 7, 8})
"""EXIF orientations that swap width and height."""


def read_yolo(folder: Path) -> LabelledPictures:
    """Read every picture below `folder` with its text file of the same name.

    The text file lies beside the picture, or below `labels` where the picture lies below `images`. A line is
    `class cx cy w h [confidence]`, or `class x1 y1 x2 y2 x3 y3 ...` for a polygon, which becomes the box around
    it; all as shares of the picture's size. A picture without a text file has no objects. Class names come from
    `names` in a `data.yaml` or `dataset.yaml`, or from the lines of a `classes.txt` or `obj.names`, in the folder or
    one of the two above; class 3 without a name is `class-3`. Key points, of which `kpt_shape` in the YAML file says
    how many there are, count for nothing. The split is what the innermost folder named like one says (train, val,
    valid, test).

    Raises
    ------
    InputError
        The folder is not there, or holds no pictures or no text files for them, or the names cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder", hint="give the folder that holds pictures and YOLO text files")
    names = yolo_names(folder)
    paths = list_pictures(folder)
    if not paths:
        raise InputError(f"{folder}: there are no pictures in it", hint="pictures and text files belong together")
    texts = [_text_of(path, folder) for path in paths]
    if not any(text.is_file() for text in texts):
        raise InputError(
            f"{folder}: {len(paths)} pictures, but none has a text file beside it or below labels",
            hint="expected are images/a.jpg with labels/a.txt, or a.jpg with a.txt",
        )
    skipped: list[str] = []
    pictures = [
        picture
        for path, text in zip(paths, texts, strict=True)
        if (picture := _picture(path, text, names, _split_of(path, folder), skipped)) is not None
    ]
    return LabelledPictures(f"yolo:{folder}", tuple(pictures), tuple(skipped))


def _text_of(path: Path, folder: Path) -> Path:
    parts = list(path.relative_to(folder).parts)
    if "images" in parts[:-1]:
        parts[len(parts) - 1 - parts[::-1].index("images")] = "labels"
        return folder.joinpath(*parts).with_suffix(".txt")
    if folder.name == "images":
        return (folder.parent / "labels").joinpath(*parts).with_suffix(".txt")
    return path.with_suffix(".txt")


def _split_of(path: Path, folder: Path) -> str:
    parts = path.relative_to(folder).parts[:-1]
    return next((SPLITS[part] for part in reversed(parts) if part in SPLITS), "")


def _picture(path: Path, text: Path, names: YoloNames, split: str, skipped: list[str]) -> LabelledPicture | None:
    size_px = _size_px(path)
    if size_px is None:
        skipped.append(f"{path}: cannot be read as a picture")
        return None
    found = BoxList(skipped)
    try:
        lines = text.read_text(encoding="utf-8-sig").splitlines() if text.is_file() else []
    except (OSError, UnicodeDecodeError) as error:
        skipped.append(f"{text}: cannot be read: {error}")
        return None
    for row, line in enumerate(lines, start=1):
        if line.strip():
            _add_line(found, line, f"{text} line {row}", names, size_px)
    return found.picture(path, split)


def _add_line(found: BoxList, line: str, where: str, names: YoloNames, size_px: tuple[int, int]) -> None:
    try:
        number, *values = map(float, line.split())
        class_number = int(number)
    except (ValueError, OverflowError):
        found.skipped.append(f"{where}: expected a class and numbers, found {line.strip()!r}")
        return
    width_px, height_px = size_px
    values = names.without_key_points(values)
    if len(values) in (4, 5):
        x, y, width, height = values[:4]
        left, top, right, bottom = x - width / 2, y - height / 2, x + width / 2, y + height / 2
    elif len(values) >= 6 and len(values) % 2 == 0:
        xs, ys = values[0::2], values[1::2]
        left, top, right, bottom = min(xs), min(ys), max(xs), max(ys)
    else:
        found.skipped.append(f"{where}: expected 4 or 5 numbers after the class, or 3 or more points, found {line!r}")
        return
    kind = names.name(class_number)
    if not kind:
        found.skipped.append(f"{where}: class {class_number} is not among the names of the classes")
        return
    found.add(kind, (left * width_px, top * height_px, right * width_px, bottom * height_px), where)


def _size_px(path: Path) -> tuple[int, int] | None:
    """Return width and height as a viewer shows the picture, from the file's head; None if it has none."""
    from PIL import ExifTags, Image, UnidentifiedImageError  # Only labels in shares of the size need it.

    try:
        with Image.open(path) as picture:
            width, height = picture.size
            turned = picture.getexif().get(ExifTags.Base.Orientation) in _TRANSPOSED
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return (height, width) if turned else (width, height)
