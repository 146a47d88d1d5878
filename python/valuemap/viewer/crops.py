"""Pictures for the page: decoded, cut and encoded anew, so that nothing but pixels leaves a file."""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path

import numpy as np

from valuemap.evidence import cut_out

CROP_PX = 256
PICTURE_PX = 1600
_QUALITY = 88


@lru_cache(maxsize=2000)
def crop_jpeg(picture: Path, modified_ns: int, x_px: float, y_px: float, side_px: float) -> bytes:
    """Return a square of a picture around a pixel as JPEG of CROP_PX; `modified_ns` is its time of change."""
    del modified_ns  # A picture that changes is another one for the cache.
    return _encode(cut_out(picture, np.array([x_px, y_px]), side_px, CROP_PX))


@lru_cache(maxsize=16)
def whole_jpeg(picture: Path, modified_ns: int) -> bytes | None:
    """Return a whole picture as JPEG of at most PICTURE_PX; None where it cannot be decoded."""
    del modified_ns
    from PIL import Image

    try:
        with Image.open(picture) as stored:
            stored.draft("RGB", (PICTURE_PX, PICTURE_PX))
            image = stored.convert("RGB")
            image.thumbnail((PICTURE_PX, PICTURE_PX))
    except Exception:  # On damaged files Pillow's decoders raise nearly anything.
        return None
    return _encode(np.asarray(image))


def _encode(pixels: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> bytes:
    from PIL import Image

    body = io.BytesIO()
    Image.fromarray(pixels).save(body, "JPEG", quality=_QUALITY)
    return body.getvalue()
