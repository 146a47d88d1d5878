"""Where the cameras are on their car: lever arms left out, with other axes or signs, or not turned with the car."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import camera_centers
from valuemap.check.agreement import compare_objects
from valuemap.check.fault import (
    AGAINST,
    LEAST_CHANCE,
    Fault,
    Finding,
    Stage,
    View,
    agreement_after,
    agreements_of_all,
    with_centers,
)
from valuemap.check.fit import MotionByParameter, Parameter, ParameterEstimate, apply
from valuemap.check.groups import Group, groups_of
from valuemap.check.headings import ways_of_car
from valuemap.check.loose import HALF_WAY, LEAST_TIMES, loose_of
from valuemap.check.mounts import pairs_of_a_car
from valuemap.check.parameters import at_wider_gate, chance_of, estimate_of
from valuemap.dataset import Dataset

Ways = Callable[[Dataset], tuple[Floats, Floats]]
"""How each image (N, 3) moves, in the world, by a metre forward and by a metre to the right on its car."""


class LeverArms(Fault):
    """Cameras of a car that are elsewhere on it than their poses say: two or all of them, or one to a side."""

    name: ClassVar[str] = "lever_arms"
    stage: ClassVar[Stage] = "fine"

    def find(self, view: View) -> Finding | None:
        """Estimate the places of all cameras on the car together, for each way in which they may be mistaken.

        Each camera agrees with itself wherever on its car it is; only where rays of several meet, and in bends, it
        shows. So how all rays agree is to bear out what the estimate says.
        """
        groups = cameras_of_cars(view)
        found = [told for how in _MISTAKES if (told := find_mistake(view, groups, how)) is not None] if groups else []
        if not found:
            return None
        best = max(found, key=lambda each: agreement_after(view, each.fix))
        # What one object shows of the places of cameras does not hang on the next.
        fixed, given = (agreements_of_all(view, each) for each in (best.fix(view.dataset), view.dataset))
        comparison = compare_objects(fixed, given)
        if comparison.chance * len(_MISTAKES) > AGAINST:
            return None
        offsets = {group.text: best.offset_m(group) for group in groups}
        return Finding(
            fault=self.name,
            what=_MISTAKES[best.how].what,
            why=f"{_MISTAKES[best.how].says} "
            + ", ".join(f"{text} {_in_words(*offset_m)}" for text, offset_m in offsets.items())
            + f" (± {best.sigma_m:.2f} m, {best.estimate.places} places and {best.estimate.points} objects); "
            f"corrected, the agreement of rays rises by {comparison.difference:.0f} "
            f"({comparison.places} {comparison.of}).",
            do=_MISTAKES[best.how].do,
            chance=best.chance,
            figures={
                "mistake": best.how,
                "forward_right_m": {text: [round(each, 2) for each in offset_m] for text, offset_m in offsets.items()},
                **comparison.to_json(),
            },
            fix=best.fix,
        )


@dataclass(frozen=True)
class _Mistake:
    """How places on the car may be mistaken: what the fix is of, and in words."""

    ways: Ways
    what: str
    says: str
    do: str


def _not_turned(dataset: Dataset, *, is_forward_east: bool) -> tuple[Floats, Floats]:
    """Return the ways of a place that was added in the axes of the world, and belongs into those of the car."""
    forward, right = ways_of_car(dataset)
    east, north = dataset.frame.east_north()
    return (forward - east, right + north) if is_forward_east else (forward - north, right - east)


_TURN = "Turn the lever arm of each camera by the heading of the car before it is added to the position."
_NOT_TURNED = (
    "The places of the cameras on the car do not turn with it: they were added in the axes of the world, forward as "
)
_MISTAKES = {
    "on the car": _Mistake(
        ways_of_car,
        "The cameras are not where on their car the poses say.",
        "By where their rays meet they are, against their poses,",
        "Correct the lever arm of each camera: was it left out, or were axes (forward, left) or signs taken otherwise?",
    ),
    "forward as east": _Mistake(
        partial(_not_turned, is_forward_east=True),
        f"{_NOT_TURNED}east.",
        "By where their rays meet they are, against the point that the poses of the car are of,",
        _TURN,
    ),
    "forward as north": _Mistake(
        partial(_not_turned, is_forward_east=False),
        f"{_NOT_TURNED}north.",
        "By where their rays meet they are, against the point that the poses of the car are of,",
        _TURN,
    ),
}


@dataclass(frozen=True, eq=False)
class LeverArmMistake:
    """What one mistake comes to: the estimate of where the cameras are, and how likely it is so far from nothing."""

    how: str
    parameters: tuple[Parameter, ...]
    estimate: ParameterEstimate
    chance: float

    def fix(self, dataset: Dataset) -> Dataset:
        """Return the dataset with all cameras moved."""
        return apply(dataset, self.parameters, self.estimate.value)

    def offset_m(self, group: Group) -> tuple[float, float]:
        """Return how far forward and to the right a camera is."""
        forward, right = (self.estimate.of(_name(group, axis))[0] for axis in _AXES)
        return forward, right

    @property
    def sigma_m(self) -> float:
        """The largest standard error."""
        return float(np.sqrt(np.diag(self.estimate.covariance)).max())


_AXES = ("forward", "right")


def _name(group: Group, axis: str) -> str:
    return f"{group.text} {axis}"


def cameras_of_cars(view: View) -> tuple[Group, ...]:
    """Return the cameras, with detections enough, that expose together with others."""
    of_cars = {camera for pair in pairs_of_a_car(view.dataset.images) for camera in pair}
    cameras = [group for group in groups_of(view.dataset) if group.camera_id in of_cars]
    return tuple(sorted(cameras, key=lambda group: group.text))


def find_mistake(view: View, groups: tuple[Group, ...], how: str) -> LeverArmMistake | None:
    """Return the estimate for one mistake, if one camera is farther off than what is seen, and noise of poses makes."""
    own = tuple(each for group in groups for each in _places(group, how))
    # Of cameras that are a metre off few votes are right at the gate at which good rays meet.
    wide, least_m = at_wider_gate(view), view.seen_m
    first = estimate_of(wide, own)
    if first is None or np.abs(first.value).max() < HALF_WAY * least_m:
        return None
    found = estimate_of(view, own, start=estimate_of(wide, own, start=first))
    assert found is not None
    misses = loose_of(view).misses(apply(view.dataset, own, found.value))
    farthest = max(found.names, key=lambda name: abs(found.of(name)[0]))
    chance = chance_of(found, farthest, len(_MISTAKES))
    if misses is None or abs(found.of(farthest)[0]) < max(least_m, LEAST_TIMES * misses.distance_m):
        return None
    return None if chance > LEAST_CHANCE else LeverArmMistake(how, own, found, chance)


def _places(group: Group, how: str) -> tuple[Parameter, ...]:
    """Return where one camera is on its car, forward and to the right in metres, as what is estimated."""

    def way(dataset: Dataset, axis: int) -> Floats:
        return np.asarray(_MISTAKES[how].ways(dataset)[axis] * group.images_of(dataset)[:, None])

    def moved(dataset: Dataset, by_m: float, *, axis: int) -> Dataset:
        return with_centers(dataset, camera_centers(dataset.images) + by_m * way(dataset, axis))

    def motion(dataset: Dataset, *, axis: int) -> MotionByParameter:
        return MotionByParameter(np.zeros((len(dataset.images), 3)), way(dataset, axis))

    return tuple(
        Parameter(
            _name(group, name), partial(moved, axis=axis), partial(motion, axis=axis), is_length=True, of_drives=True
        )
        for axis, name in enumerate(_AXES)
    )


def _in_words(forward_m: float, right_m: float) -> str:
    along, aside = "ahead" if forward_m >= 0.0 else "behind", "right" if right_m >= 0.0 else "left"
    return f"{abs(forward_m):.2f} m {along} and {abs(right_m):.2f} m to the {aside}"
