"""Equirectangular panoramas as perspective views, which detectors are trained on, and the boxes back.

The views look all the way round, each turned against the one before by the same angle. One table of pixels serves them
all, because turning about the vertical only moves a panorama sideways.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats
from valuemap.colmap import pycolmap
from valuemap.config import DetectConfig
from valuemap.detect.boxes import Boxes
from valuemap.detect.letterbox import Pixels, Size

MODEL = "EQUIRECTANGULAR"

_SIDES = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
"""The middles of the sides of a box. Its corners are no good: off the middle of a view upright things lean, so that the
corners lie outside of them, and farther outside in the panorama."""


@dataclass(frozen=True, eq=False)
class PanoramaViews:
    """The views of panoramas of one size: squares of `side_px` with a focal length of `focal_px`.

    `lookup_px` (2, side, side) says where in the panorama each pixel of the first view is, x and y; view i lies
    `i * step_px` further to the right.
    """

    panorama: Size
    side_px: int
    focal_px: float
    pitch_rad: float
    count: int
    lookup_px: tuple[NDArray[np.float32], NDArray[np.float32]]

    @property
    def step_px(self) -> float:
        """Panorama pixels from one view to the next."""
        return self.panorama[0] / self.count

    def draw(self, pixels: Pixels, view: int) -> Pixels:
        """Return view `view` (side, side, 3) of a panorama."""
        x, y = self.lookup_px
        # OpenCV's pixel centres are whole numbers; the left edge of a panorama is its right edge.
        drawn: Any = cv2.remap(
            pixels,
            x + np.float32(view * self.step_px - 0.5),
            y - np.float32(0.5),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        return np.asarray(drawn, np.uint8)

    def to_panorama(self, boxes: Boxes, view: int) -> Boxes:
        """Return boxes of a view as boxes of the panorama: centres on the same rays, sizes between the sides."""
        points = boxes.center_px[:, None] + _SIDES[None] * boxes.size_px[:, None]
        center = self._panorama_from_view(boxes.center_px)
        around = self._panorama_from_view(points.reshape(-1, 2)).reshape(points.shape) - center[:, None]
        width = self.panorama[0]
        around[..., 0] -= width * np.round(around[..., 0] / width)
        size = np.ptp(around, axis=1) if len(boxes) else np.empty((0, 2))
        center[:, 0] = (center[:, 0] + view * self.step_px) % width
        return boxes.moved(center, size)

    def _panorama_from_view(self, point_px: Floats) -> Floats:
        return _panorama_from_view(point_px, self.panorama, self.side_px, self.focal_px, self.pitch_rad)


def plan_views(panorama: Size, config: DetectConfig) -> PanoramaViews:
    """Return the views of a panorama, as sharp in their middle as the panorama is on the horizon."""
    field = math.radians(config.panorama_view_deg)
    focal_px = panorama[0] / math.tau
    side_px = max(round(2.0 * focal_px * math.tan(field / 2.0)), 1)
    count = math.ceil(360.0 / (config.panorama_view_deg - config.panorama_overlap_deg))
    pitch_rad = math.radians(config.panorama_pitch_deg)
    middle = np.arange(side_px) + 0.5
    x, y = np.empty((2, side_px, side_px), np.float32)
    for row in range(side_px):  # Row by row, or the points would need more memory than the pictures.
        points = np.stack([middle, np.full(side_px, middle[row])], axis=1)
        x[row], y[row] = _panorama_from_view(points, panorama, side_px, focal_px, pitch_rad).T
    return PanoramaViews(panorama, side_px, focal_px, pitch_rad, count, (x, y))


def _panorama_from_view(point_px: Floats, panorama: Size, side_px: int, focal_px: float, pitch_rad: float) -> Floats:
    """Return where points (N, 2) of the first view are in the panorama."""
    camera = pycolmap.Camera(model=MODEL, width=panorama[0], height=panorama[1], params=panorama)
    ray = np.concatenate([(point_px - side_px / 2.0) / focal_px, np.ones((len(point_px), 1))], axis=1)
    sine, cosine = math.sin(pitch_rad), math.cos(pitch_rad)
    cam_from_view = np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])  # Up is -y.
    found: Floats = np.asarray(camera.img_from_cam(ray @ cam_from_view.T))
    return found
