"""Cameras as OpenSfM writes them, and what is built on it."""

from __future__ import annotations

from valuemap.readers.cameras_of import Camera, panorama
from valuemap.readers.json_values import Json


def opensfm_camera(value: Json) -> Camera:
    """Return one camera; COLMAP's models are the same functions of other names.

    Lengths are fractions of the larger side of the picture about its middle, and become pixels with the centre of the
    top-left one at 0.5.

    Raises
    ------
    InputError
        It is of a type that COLMAP's models do not have, or a number is missing.
    """
    kind = value["projection_type"].text() if "projection_type" in value else "perspective"
    width, height = value["width"].whole(), value["height"].whole()
    if kind in ("spherical", "equirectangular"):
        return panorama(width, height, value.where)
    size = max(width, height)

    def of(name: str, default: float | None = None) -> float:
        return value[name].number() if default is None or name in value else default

    if "focal_x" in value:
        fx, fy = size * of("focal_x"), size * of("focal_y")
    else:
        fx = fy = size * of("focal")
    cx, cy = width / 2.0 + size * of("c_x", 0.0), height / 2.0 + size * of("c_y", 0.0)
    k1, k2, k3, k4, p1, p2 = (of(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    params = {
        "perspective": ("OPENCV", (fx, fy, cx, cy, k1, k2, 0.0, 0.0)),
        "simple_radial": ("OPENCV", (fx, fy, cx, cy, k1, 0.0, 0.0, 0.0)),
        "radial": ("OPENCV", (fx, fy, cx, cy, k1, k2, 0.0, 0.0)),
        "brown": ("FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)),
        "fisheye": ("OPENCV_FISHEYE", (fx, fy, cx, cy, k1, k2, 0.0, 0.0)),
        "fisheye_opencv": ("OPENCV_FISHEYE", (fx, fy, cx, cy, k1, k2, k3, k4)),
    }
    if kind not in params:
        raise value["projection_type"].wrong(f"expected one of {', '.join(params)}, spherical, equirectangular")
    return Camera(params[kind][0], width, height, params[kind][1])
