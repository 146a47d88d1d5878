"""COLMAP's camera models: pinholes are computed here, all others by pycolmap, which is imported when one is asked for.

Its import takes a sixth of the start of a command.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from valuemap.arrays import Floats

if TYPE_CHECKING:
    from valuemap.colmap import pycolmap

_PINHOLES = {"SIMPLE_PINHOLE": "f, cx, cy", "PINHOLE": "fx, fy, cx, cy"}


class Lens(Protocol):
    """How a camera pictures points: what pycolmap's cameras can do that the map needs."""

    @property
    def width(self) -> int:
        """The width of the picture, px."""
        ...

    @property
    def height(self) -> int:
        """The height of the picture, px."""
        ...

    def cam_ray_from_img(self, pixel: Floats) -> Floats:
        """Return the unit rays (N, 3) in camera axes of pixels (N, 2), NaN where there is none."""
        ...

    def img_from_cam(self, point_in_cam: Floats) -> Floats:
        """Return the pixels (N, 2) of points (N, 3) in camera axes, NaN behind the camera."""
        ...

    def is_perspective_pinhole(self) -> bool:
        """Return whether all that is in front of the camera has a place in its image plane."""
        ...

    def is_spherical(self) -> bool:
        """Return whether the picture shows all around, so that its left edge is its right one."""
        ...


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion, to the bits of pycolmap's: the focal lengths and the principal point (2), in px."""

    width: int
    height: int
    focal_px: Floats
    middle_px: Floats

    def cam_ray_from_img(self, pixel: Floats) -> Floats:
        """Return the unit rays (N, 3) in camera axes of pixels (N, 2)."""
        u, v = ((pixel - self.middle_px) / self.focal_px).T
        length = np.sqrt(u * u + v * v + 1.0)
        return np.stack([u / length, v / length, 1.0 / length], axis=1)

    def img_from_cam(self, point_in_cam: Floats) -> Floats:
        """Return the pixels (N, 2) of points (N, 3) in camera axes, NaN behind the camera."""
        depth = point_in_cam[:, 2:]
        depth = np.where(depth >= np.finfo(np.float64).eps, depth, np.nan)
        pixel: Floats = self.focal_px * point_in_cam[:, :2] / depth + self.middle_px
        return pixel

    def is_perspective_pinhole(self) -> bool:
        """Return that all that is in front of the camera has a place in its image plane."""
        return True

    def is_spherical(self) -> bool:
        """Return that the picture does not show all around."""
        return False


def lens_of(model: str, width: int, height: int, params: Floats) -> Lens:
    """Return how a camera pictures points; `params` are in COLMAP's order."""
    if model in _PINHOLES:
        return Pinhole(width, height, np.array([params[0], params[-3]]), params[-2:])
    lens: Lens = colmap_camera(model, width, height, params)
    return lens


def colmap_camera(model: str, width: int, height: int, params: Sequence[float] | Floats) -> pycolmap.Camera:
    """Return a camera as pycolmap's."""
    from valuemap.colmap import pycolmap

    return pycolmap.Camera(model=model, width=width, height=height, params=params)


def names_of_params(model: str) -> str | None:
    """Return what the parameters of a model are called, as COLMAP writes it; None where it has no such model."""
    if model in _PINHOLES:
        return _PINHOLES[model]
    if model not in camera_models():
        return None
    from valuemap.colmap import pycolmap

    names: str = pycolmap.Camera(model=model, width=1, height=1).params_info
    return names


def places_of_params(model: str) -> tuple[list[int], list[int]]:
    """Return which parameters of a model are its focal lengths, and which its principal point; panoramas have none."""
    names = [name.strip() for name in (names_of_params(model) or "").split(",")]
    focal, middle = (
        [place for place, name in enumerate(names) if name in of] for of in (("f", "fx", "fy"), ("cx", "cy"))
    )
    return focal, middle


def camera_models() -> list[str]:
    """Return the names of COLMAP's camera models."""
    from valuemap.colmap import pycolmap

    return [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
