"""Small mistakes that all images share, estimated by least squares with honest standard errors.

Points where rays meet are taken from a vote; the residuals of their votes are linearised in the points and in a few
common parameters (a turn of the cameras in their mounts, the logarithm of the focal length, a shift along the drive),
the points are eliminated, and the parameters solved for, with weights after Cauchy. Images of one place share their
errors, so the standard errors come from the scatter between places (the sandwich of Liang and Zeger, 1986), not from
the number of detections. Where errors of poses last longer than a place, whole blocks of places are what scatters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from valuemap.cameras import Rays, cast_rays
from valuemap.check.agreement import measure_agreement
from valuemap.check.sample import Sample
from valuemap.dataset import Dataset
from valuemap.tables import Floats, Ints

Change = Callable[[Dataset, float], Dataset]
"""A dataset with one parameter changed by a value."""
_ROUNDS = 4
_MOST_ROUNDS = 40
"""Of an error that is there: each vote is at a place that the last round left, so the way to it is many short steps."""
_SETTLED = 0.1
"""Of a standard error: steps below it change nothing."""
_LEAST_VOTES = 4
_LEAST_PLACES = 6
_CAUCHY = 2.4
"""Residuals of so many median deviations have half the weight."""


@dataclass(frozen=True)
class Parameter:
    """One thing to estimate, an angle or a length: how it changes a dataset, and the step of the derivative.

    One `of_drives` changes an image by those before and after it; others change each image or camera by itself.
    """

    name: str
    change: Change
    step: float
    is_length: bool = False
    of_drives: bool = False


@dataclass(frozen=True, eq=False)
class Estimate:
    """Values (P) of parameters, their covariance (P, P), and the number of places and points they rest on."""

    names: tuple[str, ...]
    value: Floats
    covariance: Floats
    places: int
    points: int

    def of(self, name: str) -> tuple[float, float]:
        """Return the value of a parameter and its standard error."""
        at = self.names.index(name)
        return float(self.value[at]), float(np.sqrt(self.covariance[at, at]))

    def to_json(self) -> dict[str, list[float]]:
        """Return value and standard error by name."""
        return {name: [float(f"{part:.4g}") for part in self.of(name)] for name in self.names}


def estimate(
    dataset: Dataset,
    sample: Sample,
    gate_px: float,
    parameters: tuple[Parameter, ...],
    *,
    start: Estimate | None = None,
    blocks: int | None = None,
) -> Estimate | None:
    """Estimate parameters on a sample of a dataset; None where there is too little to go by.

    A few rounds tell whether there is an error at all. From a `start` that says so it goes on until it stays. Places
    are joined to so many `blocks`, if given, whose scatter standard errors come from.
    """
    if not len(sample.dataset.detections):
        return start
    value = np.zeros(len(parameters)) if start is None else start.value
    result = start
    for _ in range(_ROUNDS if start is None else _MOST_ROUNDS):
        found = _solve(Changed(dataset, sample, parameters, value), gate_px, blocks)
        if found is None:
            return start
        value = value + found.value
        result = Estimate(found.names, value.copy(), found.covariance, found.places, found.points)
        if np.all(np.abs(found.value) < _SETTLED * np.sqrt(np.diag(found.covariance))):
            break
    return result


def apply(dataset: Dataset, parameters: tuple[Parameter, ...], value: Floats | Mapping[str, float]) -> Dataset:
    """Return the dataset with parameters changed by values."""
    for number, parameter in enumerate(parameters):
        change = value.get(parameter.name, 0.0) if isinstance(value, Mapping) else float(value[number])
        if change != 0.0:
            dataset = parameter.change(dataset, change)
    return dataset


class Changed:
    """The images of a sample with parameters changed by values: a thousandth of a large dataset."""

    def __init__(self, dataset: Dataset, sample: Sample, parameters: tuple[Parameter, ...], value: Floats) -> None:
        self.sample, self.parameters = sample, parameters
        self._whole = apply(dataset, parameters, {p.name: v for p, v in _pairs(parameters, value) if p.of_drives})
        self._alone = {p.name: v for p, v in _pairs(parameters, value) if not p.of_drives}
        self.images = self._of(self._whole)

    def by(self, parameter: Parameter, change: float) -> Dataset:
        """Return the images with one parameter changed further."""
        if parameter.of_drives:
            return self._of(parameter.change(self._whole, change))
        return parameter.change(self.images, change)

    def _of(self, whole: Dataset) -> Dataset:
        return apply(self.sample.of(whole), self.parameters, self._alone)


def _pairs(parameters: tuple[Parameter, ...], value: Floats) -> Iterator[tuple[Parameter, float]]:
    return zip(parameters, value.tolist(), strict=True)


def _solve(changed: Changed, gate_px: float, blocks: int | None) -> Estimate | None:
    sample, parameters = changed.sample, changed.parameters
    agreement = measure_agreement(changed.images, sample.place_of_image, gate_px)
    found, rays = agreement.found, cast_rays(changed.images)
    votes = np.diff(found.voter_offsets)
    kept = np.flatnonzero(votes >= _LEAST_VOTES)
    if len(kept) < 3 * len(parameters):
        return None
    voters = found.voters.astype(np.int64)
    rows = np.concatenate([np.arange(found.voter_offsets[k], found.voter_offsets[k + 1]) for k in kept])
    voter, point_of = voters[rows], np.repeat(np.arange(len(kept)), votes[kept])
    point = agreement.points_in_world_m[kept]
    residual = _residuals(rays, voter, point[point_of])
    slope = np.stack([_slope(changed, p, voter, point[point_of]) for p in parameters], axis=2)
    of_point = _slopes_of_points(rays, voter, point[point_of])
    # A step may take a pixel to where its camera has no ray.
    tells = np.all(
        [np.isfinite(each).reshape(len(rows), -1).all(axis=1) for each in (residual, slope, of_point)], axis=0
    )
    for values in (residual, slope, of_point):
        values[~tells] = 0.0
    size = np.linalg.norm(residual, axis=1)
    scale = _CAUCHY * max(float(np.median(size)), 1e-9)
    weight = tells / (1.0 + (size / scale) ** 2)
    place = sample.place_of_image[rays.image_row[voter]].astype(np.int64)
    if blocks is not None:  # Places are numbered along the drives.
        place = place * blocks // max(sample.places, blocks)
    gradient, curvature = _eliminate(residual, slope, of_point, weight, point_of, place)
    total = curvature.sum(axis=0)
    if len(curvature) < _LEAST_PLACES or np.linalg.matrix_rank(total) < len(parameters):
        return None
    inverse = np.linalg.inv(total)
    value = -inverse @ gradient.sum(axis=0)
    # At the solution: what each place pulls.
    pull = gradient + np.einsum("kij,j->ki", curvature, value)
    count = len(pull)
    meat = pull.T @ pull * count / max(count - len(parameters), 1)
    return Estimate(tuple(p.name for p in parameters), value, inverse @ meat @ inverse, count, len(kept))


def _slope(changed: Changed, parameter: Parameter, voter: Ints, point: Floats) -> Floats:
    """Return d residual / d parameter (N, 2)."""
    ahead, behind = (
        _residuals(cast_rays(changed.by(parameter, way * parameter.step)), voter, point) for way in (1.0, -1.0)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray((ahead - behind) / (2.0 * parameter.step))


def _residuals(rays: Rays, voter: Ints, point: Floats) -> Floats:
    local = np.einsum("nij,nj->ni", rays.residual_from_world[voter], point - rays.center_in_world_m[voter])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(local[:, :2] / local[:, 2:])


def _slopes_of_points(rays: Rays, voter: Ints, point: Floats) -> Floats:
    """Return d residual / d point (N, 2, 3)."""
    matrix = rays.residual_from_world[voter]
    local = np.einsum("nij,nj->ni", matrix, point - rays.center_in_world_m[voter])
    ratio = local[:, :2] / local[:, 2:]
    return np.asarray((matrix[:, :2] - ratio[:, :, None] * matrix[:, 2:]) / local[:, 2][:, None, None])


def _eliminate(
    residual: Floats, slope: Floats, of_point: Floats, weight: Floats, point_of: Ints, place: Ints
) -> tuple[Floats, Floats]:
    """Return gradients (K, P) and curvatures (K, P, P) of each place, the points eliminated."""
    count = int(point_of.max()) + 1
    parts = slope.shape[2]
    a = np.zeros((count, 3, 3))
    b = np.zeros((count, 3, parts))
    c = np.zeros((count, 3))
    g = np.zeros((count, parts))
    h = np.zeros((count, parts, parts))
    np.add.at(a, point_of, np.einsum("n,nki,nkj->nij", weight, of_point, of_point))
    np.add.at(b, point_of, np.einsum("n,nki,nkp->nip", weight, of_point, slope))
    np.add.at(c, point_of, np.einsum("n,nki,nk->ni", weight, of_point, residual))
    np.add.at(g, point_of, np.einsum("n,nkp,nk->np", weight, slope, residual))
    np.add.at(h, point_of, np.einsum("n,nkp,nkq->npq", weight, slope, slope))
    trace = np.trace(a, axis1=1, axis2=2)
    inverse = np.linalg.inv(a + np.maximum(1e-9 * trace, 1e-12)[:, None, None] * np.eye(3))
    g = g - np.einsum("nip,nij,nj->np", b, inverse, c)
    h = h - np.einsum("nip,nij,njq->npq", b, inverse, b)
    first = np.searchsorted(point_of, np.arange(count))
    _, group = np.unique(place[first], return_inverse=True)
    groups = int(group.max()) + 1
    gradient, curvature = np.zeros((groups, parts)), np.zeros((groups, parts, parts))
    np.add.at(gradient, group, g)
    np.add.at(curvature, group, h)
    return gradient, curvature
