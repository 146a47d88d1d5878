"""Errors that all images share, told from the noise of loose poses: metres and degrees, as of a phone.

At the gate at which good rays meet, the votes of loose poses are those that happen to agree with the poses as given:
an estimate from them stays near zero. At a wider gate all rays of an object vote, and the estimate goes to where the
error is. It rests on stretches of single passes, in which poses drift together; the scatter between blocks of stretches
says how sure it is.

What noise does to such an estimate no scatter tells, as it is of one sign. In simulated cities without a fault, with
errors of positions of 0.2 to 2.5 m and of rotations of 0.1 to 1.3 degrees, it was below three times what single rays
miss by. So less than that is not named, and the output says what would be. Focal lengths, which take most of it up, are
not estimated here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

import valuemap._core as _core
from valuemap.arrays import Floats
from valuemap.check.agreement import Agreement, Comparison, agreement_on, compare
from valuemap.check.fault import AGAINST, GATE_RAD, LEAST_CHANCE, MANY_DETECTIONS, WIDER_GATE, View, once_a_view
from valuemap.check.fit import Parameter, ParameterEstimate, apply, estimate
from valuemap.check.groups import Group, OfGroup
from valuemap.check.sample import Sample, pixels_per_radian, sample_stretches
from valuemap.dataset import Dataset

LEAST_TIMES = 3.0
"""An error of all images is seen from so many times what single rays miss by."""
HALF_WAY = 0.5
"""The first rounds go at least so far."""
_BLOCKS = 8
"""Of hundreds of metres each, longer than poses drift together."""


@dataclass(frozen=True)
class UsualMiss:
    """What the middle one of all votes misses its point by: an angle, and a distance there."""

    angle_rad: float
    distance_m: float

    def of(self, parameter: Parameter) -> float:
        """Return it in the unit of a parameter."""
        return self.distance_m if parameter.is_length else self.angle_rad


@dataclass(frozen=True, eq=False)
class Correction:
    """One parameter changed by a value, how sure that is, and how well the rays agree then."""

    parameter: Parameter
    value: float
    sigma: float
    chance: float
    comparison: Comparison
    estimate: ParameterEstimate
    group: Group | None = None
    """What alone is corrected; None where all is."""

    def __call__(self, dataset: Dataset) -> Dataset:
        """Return a dataset with the parameter changed by the value."""
        if self.group is None:
            return self.parameter.change(dataset, self.value)
        return OfGroup(self.group, lambda part: self.parameter.change(part, self.value))(dataset)


@once_a_view
def loose_of(view: View) -> Loose:
    """Return the dataset of a view at that gate."""
    return Loose(view)


class Loose:
    """A dataset at a gate wide enough for all rays of an object, however loose its poses are."""

    def __init__(self, view: View) -> None:
        self._dataset = view.dataset
        self._sample: Sample = sample_stretches(view.dataset, most_detections=MANY_DETECTIONS)
        self._gate_px = GATE_RAD * max(view.gate_share, WIDER_GATE) * pixels_per_radian(view.dataset)

    def misses(self, dataset: Dataset) -> UsualMiss | None:
        """Return what votes miss by with the poses of a version of the dataset; None where nothing votes."""
        agreement = self._agreement(dataset)
        found, rays = agreement.found, agreement.rays
        if not len(found):
            return None
        residual_px, _, _ = _core.see(rays.core, found.position_in_world_m, found.voter_offsets, found.voters)
        angle_rad = float(np.median(residual_px)) / pixels_per_radian(dataset)
        point = np.repeat(found.position_in_world_m, np.diff(found.voter_offsets), axis=0)
        ray_m = np.linalg.norm(point - rays.center_in_world_m[found.voters.astype(np.int64)], axis=1)
        return UsualMiss(angle_rad, angle_rad * float(np.median(ray_m)))

    def correction(
        self, parameters: tuple[Parameter, ...], told: frozenset[str], rival: Parameter | None
    ) -> Correction | None:
        """Return the change of one parameter, of those `told`, with which rays agree best; None where none is sure.

        The `rival` is one that noise takes for something else, so it is no part of the estimate.
        """
        found = self._settled(parameters)
        misses = None if found is None else self.misses(apply(self._dataset, parameters, found.value))
        if found is None or misses is None:
            return None
        given = self._gain(self._dataset)
        best: Correction | None = None
        for parameter in parameters:
            value, sigma = found.of(parameter.name)
            chance = 2.0 * float(stats.t.sf(abs(value) / sigma, found.places - 1)) * len(parameters)
            is_seen = parameter.name in told and abs(value) >= LEAST_TIMES * misses.of(parameter)
            if not is_seen or chance > LEAST_CHANCE:
                continue
            gain, opposite = (self._gain(parameter.change(self._dataset, way * value)) for way in (1.0, -1.0))
            is_smoothed = opposite.sum() > given.sum()
            comparison = compare(gain, opposite if is_smoothed else given)
            # Where the opposite agrees better as well, the estimate rests on noise: rays have to tell it alone.
            most = LEAST_CHANCE if is_smoothed else AGAINST
            if comparison.chance * len(parameters) > most:
                continue
            # What another focal length explains as well is none of it.
            beside = self._beside(parameters, rival, parameter.name)
            if np.sign(beside) != np.sign(value) or abs(beside) < LEAST_TIMES * misses.of(parameter):
                continue
            if best is None or comparison.difference > best.comparison.difference:
                best = Correction(parameter, value, sigma, chance, comparison, found)
        return best

    def _settled(self, parameters: tuple[Parameter, ...]) -> ParameterEstimate | None:
        """Return the estimate followed to its end, if after the first rounds it may be one of an error."""
        first = self._estimate(parameters)
        misses = None if first is None else self.misses(apply(self._dataset, parameters, first.value))
        if first is None or misses is None:
            return None
        least = LEAST_TIMES * HALF_WAY
        if all(abs(first.of(each.name)[0]) < least * misses.of(each) for each in parameters):
            return None
        return self._estimate(parameters, start=first)

    def _beside(self, parameters: tuple[Parameter, ...], rival: Parameter | None, name: str) -> float:
        """Return the estimate of a parameter beside a rival one."""
        every = parameters if rival is None else (*parameters, rival)
        found = self._estimate(every)
        if found is not None:
            found = self._estimate(every, start=found)
        return 0.0 if found is None else found.of(name)[0]

    def _gain(self, dataset: Dataset) -> Floats:
        return self._agreement(dataset).gain

    def _estimate(
        self, parameters: tuple[Parameter, ...], *, start: ParameterEstimate | None = None
    ) -> ParameterEstimate | None:
        return estimate(
            self._dataset, self._sample, self._gate_px, parameters, start=start, blocks=_BLOCKS, given=self._given
        )

    def _agreement(self, dataset: Dataset) -> Agreement:
        if dataset is self._dataset:
            return self._given
        return agreement_on(self._sample, self._sample.of(dataset), self._gate_px)

    @cached_property
    def _given(self) -> Agreement:
        return agreement_on(self._sample, self._sample.dataset, self._gate_px)
