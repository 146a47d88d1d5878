"""Cameras as formats give them, made into the cameras table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.camera_models import names_of_params
from valuemap.errors import InputError, SettingError
from valuemap.readers.pixel_center import shift_to_corner_px
from valuemap.tables import Cameras, Categories

_LARGEST_PX = 1_000_000
CUT_PANORAMA = "is a panorama that is cut: it does not show the whole sphere"
_ROUNDING_PX = 2
"""Each side may be a pixel off where pictures were made smaller: two of the width for one of the height."""


@dataclass(frozen=True)
class Camera:
    """One camera: COLMAP's name of the model, size in pixels, parameters in COLMAP's order and pixel convention.

    `readout_s` is how much later its last row is exposed than its first one, where it is known.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    readout_s: float | None = None


def is_whole_panorama(width: int, height: int) -> bool:
    """Return whether an equirectangular picture shows the whole sphere, as its pixels are as wide as high."""
    return abs(width - 2 * height) <= _ROUNDING_PX


def panorama(width: int, height: int, where: str) -> Camera:
    """Return the camera of an equirectangular picture whose pixels are as wide as high, `where` it stands.

    COLMAP's model spreads half a turn over the height, so that one of which the top or bottom was cut has none.

    Raises
    ------
    InputError
        It is not twice as wide as high.
    """
    if not is_whole_panorama(width, height):
        raise InputError(
            f"{where}: expected a panorama twice as wide as high, found {width} x {height} pixels",
            hint="those that are cut are not read: leave their images out",
        )
    return Camera("EQUIRECTANGULAR", width, height, (float(width), float(height)))


def make_cameras(cameras: Sequence[Camera], source: str) -> tuple[Cameras, Ints]:
    """Return the distinct cameras, with ids from 1 in an order of their values, and the id of each given one (N).

    Raises
    ------
    InputError
        A camera has no size, or a focal length that is not above 0.
    """
    for camera in cameras:
        if not (0 < camera.width < _LARGEST_PX and 0 < camera.height < _LARGEST_PX):
            raise InputError(
                f"{source}: camera: expected a width and height in pixels, found {camera.width} x {camera.height}",
                hint="give the size of the pictures that the detections were made on",
            )
        if not np.isfinite(camera.params).all() or (camera.model != "EQUIRECTANGULAR" and not camera.params[0] > 0.0):
            raise InputError(
                f"{source}: camera: expected a focal length above 0 and finite parameters, found {list(camera.params)}",
                hint="focal lengths are in pixels",
            )
    distinct = sorted(set(cameras), key=_by_value)
    id_of = {camera: number for number, camera in enumerate(distinct, start=1)}
    table = Cameras(
        camera_id=np.arange(1, len(distinct) + 1, dtype=np.int64),
        model=Categories.from_texts([camera.model for camera in distinct]),
        width_px=np.array([camera.width for camera in distinct], dtype=np.int64),
        height_px=np.array([camera.height for camera in distinct], dtype=np.int64),
        params=[np.array(camera.params, dtype=np.float64) for camera in distinct],
        readout_s=_readout_s(distinct),
    )
    return table, np.array([id_of[camera] for camera in cameras], dtype=np.int64)


def _by_value(camera: Camera) -> tuple[str, int, int, tuple[float, ...], float]:
    readout_s = -np.inf if camera.readout_s is None else camera.readout_s
    return camera.model, camera.width, camera.height, camera.params, readout_s


def _readout_s(cameras: Sequence[Camera]) -> Floats | None:
    """Return the readout times (N) of cameras; nothing if none states one."""
    if all(camera.readout_s is None for camera in cameras):
        return None
    return np.array([np.nan if camera.readout_s is None else camera.readout_s for camera in cameras])


def parse_camera(text: str, pixel_center: float = 0.5) -> Camera:
    """Return the camera of a text such as `PINHOLE 1242 375 721.5 721.5 609.6 172.9`: model, size, parameters.

    `pixel_center` is the coordinate of the centre of the top-left pixel in the parameters. A panorama
    (`EQUIRECTANGULAR 8192 4096`) has no further parameters.

    Raises
    ------
    SettingError
        There is no such model, it has another number of parameters, one of them is not finite, or pixels count from
        elsewhere than 0 or 0.5.
    """
    hint = 'for example "PINHOLE 1242 375 721.5 721.5 609.6 172.9" or "EQUIRECTANGULAR 8192 4096"'
    name, *rest = text.split() or [""]
    expected = names_of_params(name)
    if expected is None and names_of_params(name.upper()) is not None:
        raise SettingError(f"camera {text!r}: expected a model in capitals first", hint=f"write {name.upper()}")
    if expected is None:
        raise SettingError(f"camera {text!r}: expected one of COLMAP's camera models first", hint=hint)
    try:
        width, height = int(rest[0]), int(rest[1])
        params = [float(value) for value in rest[2:]]
    except (ValueError, IndexError) as error:
        raise SettingError(f"camera {text!r}: expected model, width, height and numbers", hint=hint) from error
    if not (0 < width < _LARGEST_PX and 0 < height < _LARGEST_PX):
        raise SettingError(f"camera {text!r}: expected a width and height in pixels", hint=hint)
    if name == "EQUIRECTANGULAR":
        params = params or [float(width), float(height)]
    names = [part.strip() for part in expected.split(",")]
    if len(params) != len(names):
        raise SettingError(
            f"camera {text!r}: {name} has the parameters {', '.join(names)}, found {len(params)} numbers", hint=hint
        )
    odd = [key for key, value in zip(names, params, strict=True) if not np.isfinite(value)]
    if odd:
        raise SettingError(f"camera {text!r}: {odd[0]}: expected a finite number", hint=hint)
    shift_px = shift_to_corner_px(pixel_center, "pixel-center")
    shifted = [value + shift_px if key in ("cx", "cy") else value for key, value in zip(names, params, strict=True)]
    return Camera(name, width, height, tuple(shifted))
