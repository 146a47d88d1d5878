"""The lens: distortion that is not there, or not known, and fisheyes taken for pinholes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import ClassVar

import numpy as np
from scipy import stats

from valuemap.arrays import Floats
from valuemap.check.agreement import Comparison, compare
from valuemap.check.fault import LEAST_CHANCE, LEAST_RISE, Fault, Finding, Fix, Stage, View, gains_of_all
from valuemap.check.fit import Parameter
from valuemap.check.lenses import FOCAL_LENGTHS, Focal, focals, with_params
from valuemap.check.parameters import PARAMETERS, estimate_of, parameters_of
from valuemap.dataset import Dataset
from valuemap.tables import Categories

_WITHOUT_DISTORTION = ("SIMPLE_PINHOLE", "PINHOLE")
_AT_BORDERS = 0.2
"""The share of the agreement that a lens has a say in: of simulated `nyc` so many boxes are in the outer half of the
picture, by width or height."""


class LensModel(Fault):
    """Boxes of undistorted pictures with the parameters of the lens, and distortion the other way."""

    name: ClassVar[str] = "lens_model"
    stage: ClassVar[Stage] = "fine"
    rivals: ClassVar[frozenset[str]] = frozenset({"focal_length"})
    # Headings along the drive are off in bends, to one side.
    explained_by: ClassVar[frozenset[str]] = frozenset({"headings_constant", "headings_useless"})

    def find(self, view: View) -> Finding | None:
        """Try pinholes for cameras with a lens, distortion of the other sign, and fisheyes for pinholes.

        What a lens does is small but for the borders of pictures: all that a check looks at is needed to see it.
        """
        readings = list(_lenses(view.dataset))
        if not readings:
            return None
        measured = self._measured(view)
        readings += [] if measured is None else [measured]
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

    def _measured(self, view: View) -> tuple[str, Fix] | None:
        """Return the distortion that the votes tell beside all else that images share, if it is more than none."""
        if len(parameters_of(view)) < len(PARAMETERS):  # Panoramas have no lens.
            return None
        found = estimate_of(view, (*parameters_of(view), _DISTORTION))
        if found is None:
            return None
        value, sigma = found.of("distortion")
        if 2.0 * float(stats.t.sf(abs(value) / sigma, max(found.places - len(found.names), 1))) > LEAST_CHANCE:
            return None
        return f"pictures with {value:+.2g} more of radial distortion (k1)", partial(with_distortion, k1=value)

    def _agreement(self, view: View, focal_factor: float) -> float:
        """Return how well rays agree with other focal lengths, which are more often wrong than the kind of lens."""
        count = len(view.dataset.cameras)
        return float(gains_of_all(view, Focal(np.full(count, focal_factor))(view.dataset)).sum())


def with_distortion(dataset: Dataset, k1: float) -> Dataset:
    """Return a dataset whose cameras have so much more radial distortion, of the first order."""
    names, params = [], []
    for row, values in enumerate(dataset.cameras.params):
        name = dataset.cameras.model.names[dataset.cameras.model.codes[row]]
        at = focals(dataset.cameras, row)
        changed = values.copy()
        if name in _WITHOUT_DISTORTION:
            name, changed = (
                ("SIMPLE_RADIAL", np.append(values, k1))
                if at == 1
                else ("OPENCV", np.append(values, [k1, 0.0, 0.0, 0.0]))
            )
        elif at and name != "FOV":
            changed[at + 2] += k1
        names.append(name)
        params.append(changed)
    changed_cameras = dataset.cameras.replace(params=params, model=Categories.from_texts(names))
    return Dataset(**{**vars(dataset), "cameras": changed_cameras})


_DISTORTION = Parameter("distortion", with_distortion, step=1e-4)
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
