"""Pieces of pictures with the box that voted and the point where the label projects."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.evidence import Evidence, Misses, Voters, cut_out, picture_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEAST_SIDE_PX, BOXES_PER_SIDE = 48.0, 4.0
"""A crop shows this many box sizes, but no fewer pixels than that."""

_BOX, _POINT, _DARK = (255, 255, 255), (255, 176, 0), (0, 0, 0)
_QUALITY = 82


@dataclass(frozen=True, eq=False)
class Crop:
    """A square piece of a picture (side, side, 3), RGB; `corner_px` is its upper left corner in the picture."""

    pixels: NDArray[np.uint8]
    corner_px: Floats
    px_per_px: float
    """Pixels of the crop per pixel of the picture."""

    def inside(self, pixel: Floats) -> Floats:
        """Return where pixels (..., 2) of the picture are in the crop."""
        return np.asarray((pixel - self.corner_px) * self.px_per_px)


def crop_at(
    evidence: Evidence, pictures: Path | None, image_row: int, center_px: Floats, side_px: float, out_px: int
) -> Crop:
    """Return the square of an image's picture around a pixel; empty where there is no picture."""
    file = picture_file(pictures, evidence.image_name(image_row))
    pixels = cut_out(file, center_px, side_px, out_px)
    return Crop(pixels, np.asarray(center_px, np.float64) - side_px / 2.0, out_px / side_px)


def voter_crop(evidence: Evidence, pictures: Path | None, voters: Voters, i: int, out_px: int) -> Crop:
    """Return the crop around one vote: its box and where the label projects are both in it."""
    apart = np.abs(voters.projected_px[i] - voters.box_px[i])
    reach = float(np.nan_to_num(apart, nan=0.0, posinf=0.0).max())
    side = max(LEAST_SIDE_PX, BOXES_PER_SIDE * float(voters.size_px[i].max()), 2.6 * min(reach, 2000.0))
    return crop_at(evidence, pictures, int(voters.image_row[i]), voters.box_px[i], side, out_px)


def miss_crop(evidence: Evidence, pictures: Path | None, misses: Misses, i: int, side_px: float, out_px: int) -> Crop:
    """Return the crop around where a label should have been seen."""
    return crop_at(evidence, pictures, int(misses.image_row[i]), misses.projected_px[i], side_px, out_px)


def chosen_voters(voters: Voters, most: int) -> Ints:
    """Return the places of at most so many votes: in turn from each pass, its largest boxes first."""
    area = voters.size_px.prod(axis=1)
    order = np.lexsort((voters.image_row, -area, voters.pass_number))
    passes = voters.pass_number[order]
    first = np.searchsorted(passes, passes)
    turn = np.arange(len(order)) - first
    return np.sort(order[np.lexsort((passes, turn))][:most])


def thumbnail(crop: Crop, box_px: Floats, size_px: Floats, point_px: Floats) -> str:
    """Return a crop with its box and its reprojected point drawn in, as a JPEG in base64."""
    from PIL import Image, ImageDraw  # Slow to import, and only crops need it.

    image = Image.fromarray(crop.pixels)
    pen: Any = ImageDraw.Draw(image)
    corners = crop.inside(np.stack([box_px - size_px / 2.0, box_px + size_px / 2.0])).ravel()
    pen.rectangle([corners[0] - 1, corners[1] - 1, corners[2] + 1, corners[3] + 1], outline=_DARK, width=1)
    pen.rectangle(list(corners), outline=_BOX, width=1)
    if np.all(np.isfinite(point_px)):
        x, y = crop.inside(point_px)
        for color, width in ((_DARK, 4), (_POINT, 2)):
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):  # Open in the middle, to hide nothing.
                pen.line([x + 4 * dx, y + 4 * dy, x + 10 * dx, y + 10 * dy], fill=color, width=width)
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=_QUALITY, optimize=True)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
