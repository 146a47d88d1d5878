"""Mistakes in what a camera is said to be: the unit of its focal length, its principal point, its sides."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import ClassVar

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.check.fault import Convention, Fault, Finding, Fix, Stage, View
from valuemap.dataset import Dataset, rows_of
from valuemap.tables import Cameras

_ONE_FOCAL_LENGTH = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_TWO_FOCAL_LENGTHS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE")
FOCAL_LENGTHS = dict.fromkeys(_ONE_FOCAL_LENGTH, 1) | dict.fromkeys(_TWO_FOCAL_LENGTHS, 2)
"""How many of the first parameters of a model are focal lengths; the principal point comes next."""
_SHORT = 0.2
"""No camera has a focal length of less than this share of its picture's longer side: its unit is another one."""
_FILM_MM = 36.0
_SENSORS_MM = (4.8, 5.8, 6.4, 7.2, 8.8, 13.2, 17.3, 23.5)
"""Common widths of sensors: those called 1/3, 1/2.5, 1/2, 1/1.8, 2/3 and 1 inch, Four Thirds and APS-C."""
_SHORTEST_MM, _LONGEST_SHARE = 1.5, 2.0
"""Lenses of common sensors are longer, and those of twice a picture's longer side see 28 degrees of it."""
_OFF_MIDDLE = 0.05
"""Principal points are nearer to the middle than this share of the picture, or were mistaken for something else."""


class FocalUnit(Convention):
    """Focal lengths in another unit than pixels."""

    name: ClassVar[str] = "focal_unit"
    what: ClassVar[str] = "The focal lengths are not in pixels of these pictures."
    do: ClassVar[str] = "Give fx and fy in pixels: for a picture w wide, w / 2 / tan(half the field of view)."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield focal lengths in millimetres of film or of a sensor, in shares of the picture, and as angles."""
        cameras = dataset.cameras
        longer = np.maximum(cameras.width_px, cameras.height_px).astype(np.float64)
        focal = np.array([params[0] if focals(cameras, row) else np.nan for row, params in enumerate(cameras.params)])
        if np.all(np.isnan(focal)):
            return
        if np.nanmax(focal / longer) < _SHORT:
            if all(_is_share(cameras, row) for row in range(len(cameras)) if focals(cameras, row)):
                for name, of_longer in (("the picture", False), ("the longer side of the picture", True)):
                    shares = _Shares(cameras, of_longer=of_longer)
                    if _are_square(shares(dataset).cameras):
                        yield f"all parameters in shares of {name}", shares
            elif np.nanmax(focal) <= _LONGEST_SHARE:
                yield "focal lengths in shares of the longer side of the picture", Focal(longer)
            yield "focal lengths in millimetres of film 36 mm wide", Focal(longer / _FILM_MM)
            if np.nanmin(focal) > _SHORTEST_MM:
                for width in _SENSORS_MM:
                    yield f"focal lengths in millimetres of a sensor {width:g} mm wide", Focal(longer / width)
            half = np.radians(np.clip(focal, 1.0, 179.0)) / 2.0
            yield "fields of view in degrees for focal lengths", Focal(cameras.width_px / 2.0 / np.tan(half) / focal)


def _is_share(cameras: Cameras, row: int) -> bool:
    at = focals(cameras, row)
    return bool(np.all(np.abs(cameras.params[row][: at + 2]) < _GREATEST_SHARE))


def _are_square(cameras: Cameras) -> bool:
    """Return whether pixels are as wide as high, as those of cameras are; rays tell heights of focal lengths poorly."""
    two = [cameras.params[row][:2] for row in range(len(cameras)) if focals(cameras, row) == 2]
    return all(abs(float(np.log(fx / fy))) < _SQUARE for fx, fy in two)


_SQUARE = 0.1
_GREATEST_SHARE = 10.0
"""A lens of ten times its picture's width sees six degrees."""


class _Shares:
    """Focal lengths and principal points in shares of the picture's sides, or both in shares of the longer one."""

    def __init__(self, cameras: Cameras, *, of_longer: bool) -> None:
        size = np.stack([cameras.width_px, cameras.height_px], axis=1).astype(np.float64)
        self._unit = np.repeat(size.max(axis=1, keepdims=True), 2, axis=1) if of_longer else size
        self.gate_factor = float(np.median(size.max(axis=1)))
        """The same angle is so many times as many pixels; the same for both, or the wider gate would win."""

    def __call__(self, dataset: Dataset) -> Dataset:
        """Return a dataset with parameters in pixels; principal points that count from the middle are 0 there."""
        params = []
        for row, values in enumerate(dataset.cameras.params):
            changed, at = values.copy(), focals(dataset.cameras, row)
            if at:
                size = np.array([dataset.cameras.width_px[row], dataset.cameras.height_px[row]], dtype=np.float64)
                changed[:at] *= self._unit[row, :at]
                point = changed[at : at + 2]
                is_from_middle = bool(np.all(np.abs(point) < _OFF_MIDDLE))
                changed[at : at + 2] = size / 2.0 + point * self._unit[row] if is_from_middle else point * size
            params.append(changed)
        return with_params(dataset, params)


class PrincipalPoint(Convention):
    """Principal points that are those of other pictures, or none."""

    name: ClassVar[str] = "principal_point"
    what: ClassVar[str] = "The principal points are wrong."
    do: ClassVar[str] = "Give cx and cy in pixels from the upper left corner; near the middle of the picture."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield cx and cy exchanged, and both in the middle, where they are far from it."""
        cameras = dataset.cameras
        if not any(_is_off_middle(cameras, row) for row in range(len(cameras))):
            return
        yield "cx and cy exchanged", lambda whole: _with_principal_points(whole, lambda point, _: point[::-1])
        yield "in the middle of the picture", lambda whole: _with_principal_points(whole, lambda _, size: size / 2.0)


class SidesExchanged(Fault):
    """The width of a picture where its height is expected, and the height for the width."""

    name: ClassVar[str] = "sides_exchanged"
    stage: ClassVar[Stage] = "tables"  # Rays are the same, but what is in the picture is not.

    def find(self, view: View) -> Finding | None:
        """Look for principal points in the middle of the lying picture, and boxes that only this one has room for."""
        cameras, detections, camera_row = view.dataset.cameras, view.dataset.detections, camera_rows(view.dataset)
        found, outside = [], 0
        for row in range(len(cameras)):
            size = np.array([cameras.width_px[row], cameras.height_px[row]], dtype=np.float64)
            center_px = detections.center_px[camera_row == row]
            is_out, is_out_if_exchanged = ((center_px > each).any(axis=1) for each in (size, size[::-1]))
            is_room = is_out.sum() >= _LEAST_OUT and is_out.mean() > _NEARLY_NONE >= is_out_if_exchanged.mean()
            if is_room and _is_in_middle(cameras, row, size[::-1]) and _is_off_middle(cameras, row):
                found.append(row)
                outside += int(is_out.sum())
        if not found:
            return None
        first = found[0]
        return Finding(
            fault=self.name,
            what="The widths and heights of pictures are exchanged.",
            why=f"{len(found)} of {len(cameras)} cameras have their principal points in the middle of pictures whose "
            f"width is their height ({cameras.height_px[first]} x {cameras.width_px[first]}), and {outside} boxes are "
            "in these pictures that are outside of those given.",
            do="Exchange width and height of these cameras.",
            figures={"cameras": len(found), "boxes_outside": outside},
            fix=lambda dataset: _with_sides_exchanged(dataset, found),
        )


_LEAST_OUT, _NEARLY_NONE = 3, 0.01
"""Boxes outside of their picture are a detector's slips, or of another picture."""


def _with_sides_exchanged(dataset: Dataset, rows: list[int]) -> Dataset:
    cameras = dataset.cameras
    width_px, height_px = cameras.width_px.copy(), cameras.height_px.copy()
    width_px[rows], height_px[rows] = cameras.height_px[rows], cameras.width_px[rows]
    return Dataset(**{**vars(dataset), "cameras": cameras.replace(width_px=width_px, height_px=height_px)})


def camera_rows(dataset: Dataset) -> Ints:
    """Return the row of the camera (N) that each detection is of."""
    camera_row = rows_of(dataset.images.camera_id, dataset.cameras.camera_id)
    return camera_row[rows_of(dataset.detections.image_id, dataset.images.image_id)]


def focals(cameras: Cameras, row: int) -> int:
    """Return how many focal lengths a camera has: its first parameters; 0 where its model has none."""
    return FOCAL_LENGTHS.get(cameras.model.names[cameras.model.codes[row]], 0)


def _is_off_middle(cameras: Cameras, row: int) -> bool:
    size = np.array([cameras.width_px[row], cameras.height_px[row]], dtype=np.float64)
    return bool(focals(cameras, row)) and not _is_in_middle(cameras, row, size)


def _is_in_middle(cameras: Cameras, row: int, size: Floats) -> bool:
    """Return whether the principal point of a camera is in the middle of a picture of a size (2)."""
    at = focals(cameras, row)
    return bool(np.all(np.abs(cameras.params[row][at : at + 2] / size - 0.5) <= _OFF_MIDDLE))


def with_params(dataset: Dataset, params: list[Floats]) -> Dataset:
    """Return a dataset with other parameters of its cameras."""
    return Dataset(**{**vars(dataset), "cameras": dataset.cameras.replace(params=params)})


class Focal:
    """Focal lengths times a factor of each camera."""

    def __init__(self, factor: Floats) -> None:
        self._factor = factor
        self.gate_factor = float(np.nanmedian(factor))
        """The same angle is so many times as many pixels."""

    def __call__(self, dataset: Dataset) -> Dataset:
        """Return a dataset with these focal lengths."""
        params = []
        for row, values in enumerate(dataset.cameras.params):
            changed = values.copy()
            if focals(dataset.cameras, row):
                changed[: focals(dataset.cameras, row)] *= self._factor[row]
            params.append(changed)
        return with_params(dataset, params)


def _with_principal_points(dataset: Dataset, change: Callable[[Floats, Floats], Floats]) -> Dataset:
    cameras = dataset.cameras
    params = [values.copy() for values in cameras.params]
    for row, values in enumerate(params):
        if _is_off_middle(cameras, row):
            at = focals(cameras, row)
            size = np.array([cameras.width_px[row], cameras.height_px[row]], dtype=np.float64)
            values[at : at + 2] = change(values[at : at + 2].copy(), size)
    return with_params(dataset, params)
