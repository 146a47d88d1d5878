"""Small mistakes that all images share, estimated by least squares with honest standard errors.

Points where rays meet are taken from a vote; the residuals of their votes are linearised in the points and in a few
common parameters (a turn of the cameras in their mounts, the logarithm of the focal length, a shift along the drive),
the points are eliminated, and the parameters solved for, with weights after Cauchy. Images of one place share their
errors, so the standard errors come from the scatter between places (the sandwich of Liang and Zeger, 1986), not from
the number of detections. Where errors of poses last longer than a place, whole blocks of places are what scatters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from valuemap.arrays import Floats, Ints
from valuemap.cameras import Rays, local_pinholes, rotation_matrices
from valuemap.check.agreement import Agreement, agreement_on
from valuemap.check.sample import Sample
from valuemap.dataset import Dataset
from valuemap.tables import Cameras

Change = Callable[[Dataset, float], Dataset]
"""A dataset with one parameter changed by a value."""
ROUNDS = 4
_MOST_ROUNDS = 40
"""Of an error that is there: each vote is at a place that the last round left, so the way to it is many short steps."""
_SETTLED, _SAME = 0.1, 1e-4
"""Of a standard error: steps below the first change nothing, and estimates nearer than the second are one."""
_LEAST_VOTES = 4
_LEAST_PLACES = 6
_CAUCHY = 2.4
"""Residuals of so many median deviations have half the weight."""


@dataclass(frozen=True, eq=False)
class MotionByParameter:
    """How images move with a parameter, by its unit, in the world.

    `turn` (N, 3) is the axis that each camera turns about, times the angle in radians; `move` (N, 3) is the way of its
    centre.
    """

    turn: Floats
    move: Floats


@dataclass(frozen=True)
class Parameter:
    """One thing to estimate, an angle or a length: how it changes a dataset, and how it moves its images.

    A `motion` of None is that of a parameter of cameras: what that does is told by differences of a `step`. One
    `of_drives` changes an image by those before and after it; others change each image or camera by itself.
    """

    name: str
    change: Change
    motion: Callable[[Dataset], MotionByParameter] | None = None
    step: float = 1e-5
    is_length: bool = False
    of_drives: bool = False


@dataclass(frozen=True, eq=False)
class ParameterEstimate:
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
    start: ParameterEstimate | None = None,
    rounds: int = ROUNDS,
    blocks: int | None = None,
    given: Agreement,
) -> ParameterEstimate | None:
    """Estimate parameters on a sample of a dataset; None where there is too little to go by.

    A few `rounds` tell whether there is an error at all. From a `start` that says so it goes on until it stays. Places
    are joined to so many `blocks`, if set, whose scatter standard errors come from. `given` is what the sample came to
    as it is.
    """
    if not len(sample.dataset.detections):
        return start
    value = np.zeros(len(parameters)) if start is None else start.value
    results: list[ParameterEstimate] = []
    rounds = rounds if start is None else _MOST_ROUNDS
    while len(results) < rounds:
        changed = Changed(dataset, sample, parameters, value)
        agreement = agreement_on(sample, changed.images, gate_px) if value.any() else given
        found = _solve(changed, agreement, blocks)
        if found is None:
            return start
        value = value + found.value
        results.append(ParameterEstimate(found.names, value.copy(), found.covariance, found.places, found.points))
        if np.all(np.abs(found.value) < _SETTLED * np.sqrt(np.diag(found.covariance))):
            break
        period = _period(results)
        if period:
            return results[-1 - period + (rounds - len(results)) % period]
    return results[-1]


def _period(results: list[ParameterEstimate]) -> int:
    """Return how many rounds ago the estimate was where it is: it goes round in a circle; 0 where it was never there.

    Votes that come and go with the estimate pull it to and fro, the same votes to the same place.
    """
    last = results[-1]
    near = _SAME * np.sqrt(np.diag(last.covariance))
    for back in range(1, len(results)):
        if np.all(np.abs(results[-1 - back].value - last.value) < near):
            return back
    return 0


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
        pairs = [(p, float(v)) for p, v in zip(parameters, value, strict=True)]
        self._whole = apply(dataset, parameters, {p.name: v for p, v in pairs if p.of_drives})
        alone = {p.name: v for p, v in pairs if not p.of_drives}
        self.images = apply(sample.of(self._whole), parameters, alone)

    def motion(self, parameter: Parameter) -> MotionByParameter | None:
        """Return how the images move with one parameter; None where it is their cameras that change."""
        if parameter.motion is None:
            return None
        if not parameter.of_drives:
            return parameter.motion(self.images)
        of_all = parameter.motion(self._whole)
        return MotionByParameter(of_all.turn[self.sample.image_row], of_all.move[self.sample.image_row])


def _solve(changed: Changed, agreement: Agreement, blocks: int | None) -> ParameterEstimate | None:
    sample, parameters, found = changed.sample, changed.parameters, agreement.found
    votes = np.diff(found.voter_offsets)
    kept = np.flatnonzero(votes >= _LEAST_VOTES)
    if len(kept) < 3 * len(parameters):
        return None
    voters = found.voters.astype(np.int64)
    rows = np.concatenate([np.arange(found.voter_offsets[k], found.voter_offsets[k + 1]) for k in kept])
    point_of = np.repeat(np.arange(len(kept)), votes[kept])
    meet = _VotesOfRays(changed.images, agreement.rays, voters[rows], found.position_in_world_m[kept][point_of])
    residual, of_point = meet.residual, meet.slope_of_points()
    slope = np.stack([_slope(changed, p, meet) for p in parameters], axis=2)
    # A step may take a pixel to where its camera has no ray.
    tells = np.all(
        [np.isfinite(each).reshape(len(rows), -1).all(axis=1) for each in (residual, slope, of_point)], axis=0
    )
    for values in (residual, slope, of_point):
        values[~tells] = 0.0
    size = np.linalg.norm(residual, axis=1)
    scale = _CAUCHY * max(float(np.median(size)), 1e-9)
    weight = tells / (1.0 + (size / scale) ** 2)
    place = sample.place_of_image[meet.image_row].astype(np.int64)
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
    scatter = pull @ inverse
    covariance = scatter.T @ scatter * count / max(count - len(parameters), 1)
    return ParameterEstimate(tuple(p.name for p in parameters), value, covariance, count, len(kept))


class _VotesOfRays:
    """Rays (N) of a dataset that vote for points (N, 3), and how their residuals change."""

    def __init__(self, dataset: Dataset, rays: Rays, voter: Ints, point: Floats) -> None:
        self.voter, self.image_row = voter, rays.image_row[voter]
        self._dataset = dataset
        self._matrix = rays.residual_from_world[voter]
        self._to_point = point - rays.center_in_world_m[voter]
        self._local = _times(self._matrix, self._to_point)
        self.residual = _over_depth(self._local)

    def slope_of_points(self) -> Floats:
        """Return d residual / d point (N, 2, 3)."""
        rows = self._matrix[:, :2] - self.residual[:, :, None] * self._matrix[:, 2:]
        return np.asarray(rows / self._local[:, 2, None, None])

    def slope_of_motion(self, motion: MotionByParameter) -> Floats:
        """Return d residual / d parameter (N, 2) of one by which the images move."""
        turn, move = motion.turn[self.image_row], motion.move[self.image_row]
        change = _times(self._matrix, np.cross(turn, self._to_point) - move)
        return np.asarray((change[:, :2] - self.residual * change[:, 2:]) / self._local[:, 2:])

    def residual_by(self, cameras: Cameras) -> Floats:
        """Return the residuals (N, 2) by other cameras with the same poses."""
        detections = self._dataset.detections.take(self.voter)
        pinholes = local_pinholes(Dataset(**{**vars(self._dataset), "cameras": cameras, "detections": detections}))
        return _over_depth(_times(pinholes.residual_from_cam, self._in_cam))

    @cached_property
    def _in_cam(self) -> Floats:
        """The way from each camera to the point (N, 3), in camera axes."""
        return _times(rotation_matrices(self._dataset.images)[self.image_row], self._to_point)


def _slope(changed: Changed, parameter: Parameter, votes: _VotesOfRays) -> Floats:
    """Return d residual / d parameter (N, 2)."""
    motion = changed.motion(parameter)
    if motion is not None:
        return votes.slope_of_motion(motion)
    ahead, behind = (
        votes.residual_by(parameter.change(changed.images, way * parameter.step).cameras) for way in (1.0, -1.0)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray((ahead - behind) / (2.0 * parameter.step))


def _times(matrix: Floats, vector: Floats) -> Floats:
    """Return the products (N, 3) of matrices (N, 3, 3) and vectors (N, 3)."""
    return np.asarray((matrix @ vector[:, :, None])[:, :, 0])


def _over_depth(local: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(local[:, :2] / local[:, 2:])


def _eliminate(
    residual: Floats, slope: Floats, of_point: Floats, weight: Floats, point_of: Ints, place: Ints
) -> tuple[Floats, Floats]:
    """Return gradients (K, P) and curvatures (K, P, P) of each place, the points eliminated."""
    weighted, of_points = weight[:, None, None], _Sums(point_of)
    a = of_points(_products(weighted * of_point, of_point))
    b = of_points(_products(weighted * of_point, slope))
    c = of_points(_products(weighted * of_point, residual[:, :, None]))[:, :, 0]
    g = of_points(_products(weighted * slope, residual[:, :, None]))[:, :, 0]
    h = of_points(_products(weighted * slope, slope))
    trace = np.trace(a, axis1=1, axis2=2)
    inverse = np.linalg.inv(a + np.maximum(1e-9 * trace, 1e-12)[:, None, None] * np.eye(3))
    g = g - np.einsum("nip,nij,nj->np", b, inverse, c)
    h = h - np.einsum("nip,nij,njq->npq", b, inverse, b)
    _, group = np.unique(place[np.searchsorted(point_of, np.arange(len(a)))], return_inverse=True)
    of_groups = _Sums(group)
    return of_groups(g), of_groups(h)


def _products(first: Floats, second: Floats) -> Floats:
    """Return the products (N, P, Q) of vectors (N, 2, P) and (N, 2, Q), summed over both coordinates of a residual."""
    return np.asarray(sum(first[:, axis, :, None] * second[:, axis, None, :] for axis in (0, 1)))


class _Sums:
    """Adds up rows that belong together: all those (N) of one number, from 0 without gaps."""

    def __init__(self, number: Ints) -> None:
        self._sum = scipy.sparse.csr_matrix((np.ones(len(number)), (number, np.arange(len(number)))))

    def __call__(self, values: Floats) -> Floats:
        """Return the sums (K, ...) of rows (N, ...), added in their order."""
        return np.asarray(self._sum @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])
