"""Cut-outs of labelled pictures, varied at random as other streets, cameras and days would be; never upside down."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats
from valuemap.config import TrainConfig
from valuemap.detect.letterbox import PADDING, Pixels


@dataclass(frozen=True)
class Window:
    """Which part of a picture a cut-out shows: cut-out = (picture - corner) * scale, then maybe mirrored.

    `corner_px` is x, y in pixels of the picture, `side_px` the side of the square cut-out in its own pixels.
    """

    corner_px: tuple[float, float]
    scale: float
    is_mirrored: bool
    side_px: int

    def edges(self, boxes_px: Floats) -> Floats:
        """Return boxes (N, 4) of centre and size in the picture as left, top, right, bottom in the cut-out."""
        center = (boxes_px[:, :2] - self.corner_px) * self.scale
        if self.is_mirrored:
            center = np.stack([self.side_px - center[:, 0], center[:, 1]], axis=1)
        half = boxes_px[:, 2:] * self.scale / 2.0
        return np.hstack([center - half, center + half])

    def draw(self, pixels: Pixels) -> Pixels:
        """Return the cut-out (side, side, 3) of a picture; outside the picture it is grey."""
        sign, start = (-1.0, float(self.side_px)) if self.is_mirrored else (1.0, 0.0)
        x, y = self.corner_px
        # OpenCV counts from the pixel centres: half a pixel before and after.
        matrix = np.array(
            [
                [sign * self.scale, 0.0, start + sign * self.scale * (0.5 - x) - 0.5],
                [0.0, self.scale, self.scale * (0.5 - y) - 0.5],
            ]
        )
        drawn: Any = cv2.warpAffine(
            pixels,
            matrix,
            (self.side_px, self.side_px),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(PADDING, PADDING, PADDING),
        )
        return np.asarray(drawn, np.uint8)


def choose_window(size_px: tuple[int, int], boxes_px: Floats, config: TrainConfig, rng: np.random.Generator) -> Window:
    """Choose a cut-out of a picture (width, height), mostly one with an object where there are any."""
    spread = math.log(config.max_enlargement)
    scale = math.exp(rng.uniform(-spread, spread))
    seen_px = config.crop_px / scale
    wants_object = rng.random() < config.object_share
    if wants_object and len(boxes_px):
        focus = boxes_px[rng.integers(len(boxes_px)), :2] - rng.uniform(0.1, 0.9, 2) * seen_px
    else:
        focus = rng.uniform(0.0, 1.0, 2) * (np.array(size_px) - seen_px)
    room_px = np.array(size_px) - seen_px
    corner = np.clip(focus, np.minimum(room_px, 0.0), np.maximum(room_px, 0.0))
    is_mirrored = bool(rng.random() < config.flip_share)
    return Window((float(corner[0]), float(corner[1])), scale, is_mirrored, config.crop_px)


def vary_colours(pixels: Pixels, config: TrainConfig, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the cut-out as RGB 0..1 with another brightness, contrast, gamma and balance, maybe blurred."""
    picture = pixels.astype(np.float32) / np.float32(255.0)
    share = config.brightness
    if rng.random() < 1.0 / 3.0 and config.blur_sigma_px > 0.0:
        sigma_px = max(0.1, rng.uniform(0.0, config.blur_sigma_px))
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px), np.float32)
    gain = rng.uniform(1.0 - share, 1.0 + share) * rng.uniform(1.0 - share / 3.0, 1.0 + share / 3.0, 3)
    contrast = rng.uniform(1.0 - share, 1.0 + share)
    gamma = math.exp(rng.uniform(-share, share))
    middle = float(picture.mean())
    picture = (picture - middle) * np.float32(contrast) + np.float32(middle)
    picture = np.clip(picture * gain.astype(np.float32), 0.0, 1.0)
    return np.asarray(picture ** np.float32(gamma), np.float32)
