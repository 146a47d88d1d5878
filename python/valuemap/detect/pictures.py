"""Pictures on disk: decoded strictly, upright for the network, with the way back to the pixels as stored.

COLMAP, OpenSfM and most others ignore the EXIF orientation, so their cameras know the stored pixels. Networks are
trained on upright pictures. So the network sees the upright picture, and its boxes are turned back.
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from valuemap.arrays import Floats
from valuemap.detect.boxes import Boxes
from valuemap.detect.letterbox import Pixels, Size
from valuemap.remote import UrlPath

Image.MAX_IMAGE_PIXELS = None  # Pillow's own limit takes large panoramas for attacks; MAX_PIXELS is ours.

MAX_PIXELS = 2**28
"""Of a picture: several are in memory together, and a header can promise anything."""

SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm"))
_EXIF_ORIENTATION = 0x0112
_SWAPS_SIDES = frozenset((5, 6, 7, 8))


NO_SUCH_FILE = "no such file"


class UnusablePicture(Exception):
    """A picture that cannot be used; the text says why."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels (height, width, 3), RGB, upright; EXIF orientation (1 to 8) and size of the picture as stored."""

    pixels: Pixels
    orientation: int
    stored: Size

    @property
    def upright(self) -> Size:
        """Width and height of the pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def to_stored(self, boxes: Boxes) -> Boxes:
        """Return boxes of the upright picture as boxes of the stored one."""
        center = _stored_from_upright(boxes.center_px, self.orientation, self.stored)
        swaps = self.orientation in _SWAPS_SIDES
        return boxes.moved(center, boxes.size_px[:, ::-1].copy() if swaps else boxes.size_px)


def read_picture(path: Path | UrlPath, *, upright: bool = True) -> Picture:
    """Decode a picture, all of it.

    Raises
    ------
    UnusablePicture
        There is no such file, it is no picture, or it is damaged or cut short.
    InputError
        The store that it is in cannot be read.
    """
    source = _source(path)
    try:
        with Image.open(source) as image:
            stored = image.size
            _refuse_too_large(stored)
            orientation = image.getexif().get(_EXIF_ORIENTATION, 1) if upright else 1
            if orientation not in range(2, 9):
                orientation = 1
            pixels = _as_rgb(ImageOps.exif_transpose(image) if orientation > 1 else image)
    except UnusablePicture:
        raise
    except UnidentifiedImageError:
        raise UnusablePicture("is no picture") from None
    except Exception as error:  # On damaged files Pillow's decoders raise nearly anything.
        reason = str(error).splitlines()[0] if str(error) else repr(error)
        raise UnusablePicture(f"cannot be decoded: {reason}") from error
    return Picture(pixels, orientation, stored)


def _source(path: Path | UrlPath) -> Path | BytesIO:
    if isinstance(path, UrlPath):
        try:
            return BytesIO(path.read_bytes())
        except FileNotFoundError:
            raise UnusablePicture(NO_SUCH_FILE) from None
    if not path.is_file():  # A pipe would be waited for.
        raise UnusablePicture("is no file" if path.exists() else NO_SUCH_FILE)
    return path


def _refuse_too_large(stored: Size) -> None:
    if stored[0] * stored[1] > MAX_PIXELS:
        raise UnusablePicture(
            f"is {stored[0]} x {stored[1]} px, more than the {MAX_PIXELS // 10**6} million that are read"
        )


def list_pictures(folder: Path) -> list[Path]:
    """Return the pictures in a folder and in the folders in it, by name."""
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())


def _as_rgb(image: Image.Image) -> Pixels:
    if image.mode.startswith("I;16"):  # Pillow would cut 16 bits off at 255 instead of scaling them.
        grey = (np.asarray(image) >> 8).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


def _stored_from_upright(point_px: Floats, orientation: int, stored: Size) -> Floats:
    """Return where points (N, 2) of the upright picture are in the stored one; orientations as EXIF counts them."""
    u, v = point_px.T
    width, height = stored
    x, y = {
        1: (u, v),
        2: (width - u, v),
        3: (width - u, height - v),
        4: (u, height - v),
        5: (v, u),
        6: (v, height - u),
        7: (width - v, height - u),
        8: (width - v, u),
    }[orientation]
    return np.stack([x, y], axis=1)
