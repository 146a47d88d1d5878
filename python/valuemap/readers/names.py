"""Finding images by the names that other files give them."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import PurePosixPath
from urllib.parse import unquote


def match_images(names: Collection[str], known: Sequence[str]) -> dict[str, int]:
    """Return the index in `known` of each of `names` that can be told for sure; the others are left out.

    The exact name counts first, then the name with Windows' separators turned, accents as one character (macOS writes
    two), and `%20` and the like as what they stand for. After that capitals do not count: the name without its suffix,
    its last three, two and one parts, as of a path in another folder, these without their suffix, and the last part as
    it was before a tool for labels got it, which may have put `_` or `-` for a space. Each counts only if no other name
    and no other known image has the same. `cam1/7.jpg` must not become `cam0/7.jpg` only because `cam1` is not among
    the known, nor `7.png` become `7.jpg` beside another `7.jpg`: where both have a folder, the last part alone does not
    count, but for folders that are called as what is in them; nor do more parts below folders that differ in digits
    only.
    """
    distinct = set(names)
    found: dict[str, int] = {}
    for key, keys_of_known in _KEYS:
        missing = distinct - found.keys()
        if not missing:
            break
        pairs = [(part, row) for row, name in enumerate(known) for part in keys_of_known(name)]
        count, known_count, row_of = Counter(map(key, distinct)), Counter(part for part, _ in pairs), dict(pairs)
        for name in missing:
            part = key(name)
            if count[part] == known_count[part] == 1 and not _is_elsewhere(name, known[row_of[part]]):
                found[name] = row_of[part]
    return found


def of_other_cameras(names: Collection[str], cameras: Collection[int]) -> set[str]:
    """Return those of names of which a folder is that of another of KITTI's four cameras: `image_3`, `image_03`."""
    return {name for name in names if any(int(one) not in cameras for one in _KITTI_CAMERA.findall(_slashed(name)))}


_KITTI_CAMERA = re.compile(r"(?:^|/)image_0?([0-3])(?=/)")


def same_but_for_zeros(names: Collection[str], known: Sequence[str]) -> tuple[str, str] | None:
    """Return the first of names that would be a known image if numbers had not lost their leading zeros, or got a `.0`,
    and that image: `7` or `7.0` of `0007.jpg`.
    """
    image_of = {_without_zeros(name): name for name in reversed(known)} if names else {}
    pairs = ((name, image_of.get(_without_zeros(name))) for name in sorted(names))
    return next(((name, image) for name, image in pairs if image and _is_zeros_apart(name, image)), None)


def ambiguous(names: Collection[str], known: Sequence[str]) -> tuple[str, list[str]] | None:
    """Return the first of names that may be several known images by its last part, and these images."""
    images_of: dict[str, list[str]] = {}
    for image in known if names else ():
        for part in _after_upload(image):
            images_of.setdefault(part, []).append(image)
    for name in sorted(names):
        images = [image for image in images_of.get(_before_upload(name), ()) if not _is_elsewhere(name, image)]
        if len(images) > 1:
            return name, images
    return None


def _is_zeros_apart(name: str, image: str) -> bool:
    return _end_without_suffix(name, 1) != _end_without_suffix(image, 1) and not _is_elsewhere(name, image)


def _without_zeros(name: str) -> str:
    last = _end_without_suffix(name, 1)
    return _LEADING_ZEROS.sub("", last.removesuffix(".0"))


_LEADING_ZEROS = re.compile(r"(?<!\d)0+(?=\d)")


def _slashed(name: str) -> str:
    return unicodedata.normalize("NFC", unquote(name.replace("\\", "/")))


def _without_suffix(name: str) -> str:
    path = PurePosixPath(_slashed(name).casefold())
    return str(path.with_suffix("")) if path.suffix in _PICTURES else str(path)


def _end(name: str, parts: int) -> str:
    return "/".join(_slashed(name).casefold().split("/")[-parts:])


def _end_without_suffix(name: str, parts: int) -> str:
    return "/".join(_without_suffix(name).split("/")[-parts:])


def _is_elsewhere(name: str, known: str) -> bool:
    """Return whether two names that end alike are of different folders."""
    folders = list(zip(reversed(_folders(name)), reversed(_folders(known)), strict=False))
    same = next((count for count, (one, other) in enumerate(folders) if one != other), len(folders))
    if same == len(folders):
        return False
    if same == 0:
        return _before_upload(name) == _end_without_suffix(name, 1)  # Tools for labels have a folder of their own.
    one, other = (_DIGITS.sub("", folder) for folder in folders[same])
    return one == other


def _folders(name: str) -> list[str]:
    """Return the folders of a name, without those that say nothing of what is in them, and without a root."""
    folders = _slashed(name).casefold().split("/")[:-1]
    return [folder for folder in folders if folder.strip(".") and folder not in _CONTAINERS]


def _before_upload(name: str) -> str:
    """Return the last part without the eight digits that Label Studio puts before it and what Roboflow adds to it."""
    last = _end_without_suffix(name, 1)
    return _ROBOFLOW.sub("", _LABEL_STUDIO.sub("", last))


def _after_upload(name: str) -> set[str]:
    """Return the last part without its suffix, and what Label Studio and Roboflow make of letters that they avoid."""
    last = _end_without_suffix(name, 1)
    return {last, re.sub(r"[^-\w.]", "", last.strip().replace(" ", "_")), re.sub(r"[^-\w]", "-", last)}


_LABEL_STUDIO = re.compile(r"^(?!(?:19|20)\d\d[01]\d[0-3]\d-)[0-9a-f]{8}-(?=.)")
"""Not a date: `20231115-7.jpg` is another picture than `20231114/7.jpg`."""
_ROBOFLOW = re.compile(r"_[a-z]{3,4}\.rf\.[0-9a-z]+$")
_DIGITS = re.compile(r"\d+")
_CONTAINERS = frozenset(
    ("image", "images", "img", "imgs", "picture", "pictures", "photo", "photos", "frame", "frames", "jpegimages")
    + ("label", "labels", "annotation", "annotations", "train", "val", "valid", "test", "data", "dataset", "upload")
)
"""Folders that are not one pass or camera: all pictures of a data set, or of its parts, are in them."""
_PICTURES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".ppm", ".txt"))
_KEYS_OF_BOTH: tuple[Callable[[str], str], ...] = (
    str,
    _slashed,
    _without_suffix,
    *(partial(end, parts=parts) for parts in (3, 2, 1) for end in (_end, _end_without_suffix)),
)
# No tool for labels has had the known: `00000012-left.jpg` and `00000013-left.jpg` stay two pictures.
_KEYS: tuple[tuple[Callable[[str], str], Callable[[str], Collection[str]]], ...] = (
    *((key, lambda name, key=key: (key(name),)) for key in _KEYS_OF_BOTH),
    (_before_upload, _after_upload),
)
