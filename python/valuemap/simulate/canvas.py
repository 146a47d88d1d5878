"""Where things of the world are in a picture, and painting them there.

Pictures are painted twice as large as they become, because shrinking them smooths all edges. Pixels are as everywhere:
the centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.simulate.drives import Frames

Picture = NDArray[np.uint8]
"""Height, width, and red, green, blue."""

NEAR_M = 0.8
ENLARGED = 2
_SHIFT = 4
_STEPS = 1 << _SHIFT
_LARGEST = 2e6
_SHARPEST = 0.2
"""Of corners, as 1 + cos of the turn there (143 degrees): the tip of a needle would move without bound, and so moves by
0.8 px at most."""


@dataclass(frozen=True, eq=False)
class View:
    """One true exposure: rotation (3, 3) and centre (3) of the camera, focal length and size of the picture."""

    cam_from_world: Floats
    center_in_world_m: Floats
    focal_px: float
    width_px: int
    height_px: int

    @staticmethod
    def of_frame(frames: Frames, row: int, config: SimulationConfig) -> View:
        """Return the view of one of the frames."""
        return View(
            cam_from_world=frames.take(np.array([row])).cam_from_world()[0],
            center_in_world_m=frames.center_in_world_m[row],
            focal_px=config.focal_px,
            width_px=config.image_width_px,
            height_px=config.image_height_px,
        )

    @property
    def heading_rad(self) -> float:
        """Where the camera looks, counter-clockwise from east."""
        return float(np.arctan2(self.cam_from_world[2, 1], self.cam_from_world[2, 0]))

    @property
    def pitch_rad(self) -> float:
        """How far up the camera looks."""
        return float(np.arcsin(self.cam_from_world[2, 2]))

    def in_cam_m(self, in_world_m: Floats) -> Floats:
        """Return points (..., 3) in camera axes."""
        in_cam: Floats = (in_world_m - self.center_in_world_m) @ self.cam_from_world.T
        return in_cam

    def project_px(self, in_cam_m: Floats) -> Floats:
        """Return where points (..., 3) before the camera are in the picture (..., 2)."""
        middle = np.array([self.width_px / 2.0, self.height_px / 2.0])
        picture: Floats = self.focal_px * in_cam_m[..., :2] / in_cam_m[..., 2:] + middle
        return picture

    def outlines_px(self, corner_in_world_m: Floats) -> list[Floats | None]:
        """Return the outline in the picture of each polygon (N, K, 3), cut where it comes too near; None if unseen."""
        in_cam = self.in_cam_m(corner_in_world_m)
        before = in_cam[..., 2] > NEAR_M
        whole = before.all(axis=1)
        outlines: list[Floats | None] = [None] * len(in_cam)
        rows = np.flatnonzero(whole)
        px = self.project_px(in_cam[rows])
        for row in np.flatnonzero(self._is_inside(px)):
            outlines[rows[row]] = px[row]
        for row in np.flatnonzero(before.any(axis=1) & ~whole):
            cut = self.project_px(_cut_off_near(in_cam[row]))
            if self._is_inside(cut[None])[0]:
                outlines[row] = cut
        return outlines

    def _is_inside(self, px: Floats) -> Bools:
        """Return which outlines (N, K, 2) can touch the picture."""
        low, high = px.min(axis=1), px.max(axis=1)
        size = np.array([self.width_px, self.height_px])
        inside: Bools = np.all((high > 0.0) & (low < size), axis=1)
        return inside


def fill(canvas: Picture, outline_px: Floats, color: list[float]) -> None:
    """Fill a convex outline (K, 2), in pixels of the picture to be."""
    cv2.fillConvexPoly(canvas, on_canvas(inset(outline_px[None])[0]), color, cv2.LINE_8, _SHIFT)


def fill_all(canvas: Picture, inner_px: Floats, color: list[float]) -> None:
    """Fill outlines (N, K, 2), as `inset` returns them, that do not overlap, in one colour."""
    if len(inner_px):
        cv2.fillPoly(canvas, list(on_canvas(inner_px)), color, cv2.LINE_8, _SHIFT)


def inset(outlines_px: Floats) -> Floats:
    """Return convex outlines (N, K, 2) without the half pixel of the canvas that OpenCV paints around each.

    It paints what is inside and what the outline itself touches. What is thinner than a pixel of the canvas it paints
    as wide as one, with the middle where it should be.
    """
    count = outlines_px.shape[1]
    corner = np.ascontiguousarray(outlines_px, dtype=np.float64).view(np.complex128)[..., 0]
    after = corner[:, np.arange(1, count + 1) % count]
    side = after - corner
    length = np.maximum(np.abs(side), 1e-9)
    twice_area = (corner.conj() * after).imag.sum(axis=1)
    # As far as the middle of what is thin, and no farther.
    by = np.minimum(0.5 / ENLARGED, 0.5 * np.abs(twice_area) / length.sum(axis=1))
    inward = 1j * side / length
    before = inward[:, np.arange(-1, count - 1)]
    facing = 1.0 + (inward * before.conj()).real
    moved = corner + (np.copysign(by, twice_area)[:, None] / np.maximum(facing, _SHARPEST)) * (inward + before)
    inner: Floats = moved[..., None].view(np.float64)
    return inner


def on_canvas(px: Floats, scale: float = ENLARGED) -> NDArray[np.int32]:
    """Return pixels as OpenCV wants them: fixed-point, 0 at the centre of the first pixel of the enlarged picture."""
    return np.rint((px * scale - 0.5) * _STEPS).clip(-_LARGEST, _LARGEST).astype(np.int32)


def bar_outlines_px(start_px: Floats, end_px: Floats, width_px: Floats) -> Floats:
    """Return outlines (N, 4, 2) of bars from start to end (N, 2) that are so wide (N, 2) at both ends."""
    along = end_px - start_px
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1) / 2.0
    at_start, at_end = aside * width_px[:, :1], aside * width_px[:, 1:]
    return np.stack([start_px - at_start, end_px - at_end, end_px + at_end, start_px + at_start], axis=1)


def far_to_near(depth_m: Floats) -> Ints:
    """Return the order in which to paint."""
    return np.argsort(-depth_m, kind="stable")


def _cut_off_near(corner_in_cam_m: Floats) -> Floats:
    """Return a polygon (K, 3) without what is nearer than NEAR_M (Sutherland and Hodgman)."""
    kept: list[Floats] = []
    for here, there in zip(corner_in_cam_m, np.roll(corner_in_cam_m, -1, axis=0), strict=True):
        if here[2] > NEAR_M:
            kept.append(here)
        if (here[2] > NEAR_M) != (there[2] > NEAR_M):
            kept.append(here + (NEAR_M * 1.0001 - here[2]) / (there[2] - here[2]) * (there - here))
    return np.array(kept)
