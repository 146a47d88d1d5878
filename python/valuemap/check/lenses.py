"""Mistakes in what a camera is said to be: the unit of its focal length, its principal point, its lens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import ClassVar

import numpy as np

from valuemap.check.agreement import Comparison, compare
from valuemap.check.fault import LEAST_CHANCE, LEAST_RISE, Convention, Fault, Finding, Fix, Stage, View, gains_of_all
from valuemap.dataset import Dataset
from valuemap.tables import Cameras, Categories, Floats

_ONE_FOCAL_LENGTH = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_TWO_FOCAL_LENGTHS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE")
FOCAL_LENGTHS = dict.fromkeys(_ONE_FOCAL_LENGTH, 1) | dict.fromkeys(_TWO_FOCAL_LENGTHS, 2)
"""How many of the first parameters of a model are focal lengths; the principal point comes next."""
_WITHOUT_DISTORTION = ("SIMPLE_PINHOLE", "PINHOLE")
_SHORT = 0.2
"""No camera has a focal length of less than this share of its picture's longer side: its unit is another one."""
_FILM_MM = 36.0
_OFF_MIDDLE = 0.05
"""Principal points are nearer to the middle than this share of the picture, or were mistaken for something else."""
_AT_BORDERS = 0.2
"""The share of the agreement that a lens has a say in: of simulated `nyc` so many boxes are in the outer half of the
picture, by width or height."""


class FocalUnit(Convention):
    """Focal lengths in another unit than pixels."""

    name: ClassVar[str] = "focal_unit"
    what: ClassVar[str] = "The focal lengths are not in pixels of these pictures."
    do: ClassVar[str] = "Give fx and fy in pixels: for a picture w wide, w / 2 / tan(half the field of view)."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield focal lengths in millimetres of film, in shares of the picture, and as angles."""
        cameras = dataset.cameras
        longer = np.maximum(cameras.width_px, cameras.height_px).astype(np.float64)
        focal = np.array([params[0] if focals(cameras, row) else np.nan for row, params in enumerate(cameras.params)])
        if np.all(np.isnan(focal)):
            return
        if np.nanmax(focal / longer) < _SHORT:
            yield "focal lengths in shares of the longer side of the picture", Focal(longer)
            yield "focal lengths in millimetres of film 36 mm wide", Focal(longer / _FILM_MM)
            half = np.radians(np.clip(focal, 1.0, 179.0)) / 2.0
            yield "fields of view in degrees for focal lengths", Focal(cameras.width_px / 2.0 / np.tan(half) / focal)


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


class LensModel(Fault):
    """Boxes of undistorted pictures with the parameters of the lens, and distortion the other way."""

    name: ClassVar[str] = "lens_model"
    stage: ClassVar[Stage] = "fine"

    def find(self, view: View) -> Finding | None:
        """Try pinholes for cameras with a lens, distortion of the other sign, and fisheyes for pinholes.

        What a lens does is small but for the borders of pictures: all that a check looks at is needed to see it.
        """
        readings = list(_lenses(view.dataset))
        if not readings:
            return None
        given = gains_of_all(view, view.dataset)
        best: tuple[str, Fix, Floats, Comparison] | None = None
        for how, fix in readings:
            gain = gains_of_all(view, fix(view.dataset))
            comparison = compare(gain, given)
            rises = comparison.difference >= _AT_BORDERS * LEAST_RISE * float(given.sum())
            if comparison.chance * len(readings) > LEAST_CHANCE or not rises:
                continue
            if best is None or compare(gain, best[2]).chance < LEAST_CHANCE:
                best = how, fix, gain, comparison
        if best is None or any(self._agreement(view, factor) >= best[2].sum() for factor in _FOCAL_FACTORS):
            return None
        how, fix, _, comparison = best
        return Finding(
            fault=self.name,
            what="The cameras have another lens than the pictures were taken with.",
            why=f"Read as {how}, the agreement of rays rises by {comparison.difference:.0f} "
            f"({comparison.places} places).",
            do="Of undistorted pictures give PINHOLE with their own fx fy cx cy; else the model of the lens.",
            chance=comparison.chance * len(readings),
            figures={"reading": how, **comparison.to_json()},
            fix=fix,
        )

    def _agreement(self, view: View, focal_factor: float) -> float:
        """Return how well rays agree with other focal lengths, which are more often wrong than the kind of lens."""
        count = len(view.dataset.cameras)
        return float(gains_of_all(view, Focal(np.full(count, focal_factor))(view.dataset)).sum())


_FOCAL_FACTORS = (0.7, 0.8, 0.9, 1.1, 1.25, 1.4)
"""Steps of about a tenth and more, to beyond the nearest sizes that pictures are scaled to, 3/4 and 4/3."""


def _lenses(dataset: Dataset) -> Iterator[tuple[str, Fix]]:
    cameras = dataset.cameras
    models = {cameras.model.names[code] for code in cameras.model.codes} & set(FOCAL_LENGTHS)
    if models - set(_WITHOUT_DISTORTION):
        yield "boxes of undistorted pictures", lambda whole: _with_model(whole, "PINHOLE")
        yield "distortion of the other sign", _with_opposite_distortion
    if models & set(_WITHOUT_DISTORTION):
        yield "fisheyes (equidistant)", lambda whole: _with_model(whole, "OPENCV_FISHEYE")


def focals(cameras: Cameras, row: int) -> int:
    """Return how many focal lengths a camera has: its first parameters; 0 where its model has none."""
    return FOCAL_LENGTHS.get(cameras.model.names[cameras.model.codes[row]], 0)


def _is_off_middle(cameras: Cameras, row: int) -> bool:
    if not focals(cameras, row):
        return False
    at = focals(cameras, row)
    size = np.array([cameras.width_px[row], cameras.height_px[row]], dtype=np.float64)
    return bool(np.any(np.abs(cameras.params[row][at : at + 2] / size - 0.5) > _OFF_MIDDLE))


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


def _with_model(dataset: Dataset, model: str) -> Dataset:
    """Give cameras with focal lengths another model, without distortion; the other model's own cameras stay."""
    cameras = dataset.cameras
    names, params = [], []
    for row, values in enumerate(cameras.params):
        name = cameras.model.names[cameras.model.codes[row]]
        is_plain = name in _WITHOUT_DISTORTION
        if name not in FOCAL_LENGTHS or is_plain == (model in _WITHOUT_DISTORTION):
            names.append(name)
            params.append(values)
            continue
        at = FOCAL_LENGTHS[name]
        point = values[at : at + 2]
        names.append(model)
        params.append(np.concatenate([[values[0], values[at - 1]], point, np.zeros(0 if model == "PINHOLE" else 4)]))
    changed = cameras.replace(params=params, model=Categories.from_texts(names))
    return Dataset(**{**vars(dataset), "cameras": changed})


def _with_opposite_distortion(dataset: Dataset) -> Dataset:
    params = []
    for row, values in enumerate(dataset.cameras.params):
        changed = values.copy()
        if focals(dataset.cameras, row):
            at = focals(dataset.cameras, row)
            changed[at + 2 :] *= -1.0
        params.append(changed)
    return with_params(dataset, params)
