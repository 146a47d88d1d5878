"""Faults of cameras: focal length, half a pixel, a turn in the mount, the wrong camera of images."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.agreement import agreement_on, compare
from valuemap.check.clocks import find_clock
from valuemap.check.fault import (
    AGAINST,
    GATE_RAD,
    LEAST_CHANCE,
    LEAST_RISE,
    WIDER_GATE,
    Fault,
    Finding,
    Stage,
    View,
    agreement_after,
    fair_gains,
    gains_of_all,
    once_a_view,
    with_centers,
    with_detections,
    with_images,
)
from valuemap.check.fit import ROUNDS, Estimate, Motion, Parameter, estimate
from valuemap.check.groups import Group, OfGroup, groups_of
from valuemap.check.headings import ways_of_car
from valuemap.check.lenses import Focal, focals, with_params
from valuemap.check.loose import HALF_WAY, LEAST_TIMES, Correction, loose_of
from valuemap.check.passes import OF_ITS_CAMERA, find_height_of_pass, moved_along, seen_m
from valuemap.check.sample import pixels_per_radian
from valuemap.dataset import Dataset

_MOST_DOUBLINGS, _MOST_STEPS = 6, 12
"""Of a search that ends by itself as soon as the agreement falls: of turns it need not."""


class _Turn:
    """Cameras turned about one of their own axes."""

    def __init__(self, axis: int) -> None:
        self._axis = axis

    def change(self, dataset: Dataset, angle_rad: float) -> Dataset:
        """Return a dataset whose cameras are turned by an angle, in their places."""
        turn = Rotation.from_rotvec(angle_rad * np.eye(3)[self._axis])
        turned = turn * Rotation.from_quat(dataset.images.cam_from_world_quat, scalar_first=True)
        return with_images(
            dataset,
            cam_from_world_quat=turned.as_quat(scalar_first=True),
            cam_from_world_m=dataset.images.cam_from_world_m @ turn.as_matrix().T,
        )

    def motion(self, dataset: Dataset) -> Motion:
        """Return the axis in the world, about which no centre moves."""
        axis = rotation_matrices(dataset.images)[:, self._axis]
        return Motion(axis, np.zeros_like(axis))


def with_focal(dataset: Dataset, log_factor: float) -> Dataset:
    """Return a dataset with all focal lengths multiplied by exp(log_factor)."""
    return Focal(np.full(len(dataset.cameras), np.exp(log_factor)))(dataset)


def _shift_along(dataset: Dataset, forward_m: float) -> Dataset:
    return with_centers(dataset, moved_along(dataset, forward_m))


_STEP_ALONG_M = 1e-3


def _motion_along(dataset: Dataset) -> Motion:
    ahead, behind = (moved_along(dataset, way * _STEP_ALONG_M) for way in (1.0, -1.0))
    return Motion(np.zeros_like(ahead), (ahead - behind) / (2.0 * _STEP_ALONG_M))


PARAMETERS = (
    *(Parameter(name, _Turn(axis).change, _Turn(axis).motion) for axis, name in enumerate(("pitch", "yaw", "roll"))),
    Parameter("log_focal", with_focal),
    Parameter("along", _shift_along, _motion_along, is_length=True, of_drives=True),
)


def _shift_aside(dataset: Dataset, right_m: float) -> Dataset:
    return with_centers(dataset, camera_centers(dataset.images) + right_m * ways_of_car(dataset)[1])


def _motion_aside(dataset: Dataset) -> Motion:
    right = ways_of_car(dataset)[1]
    return Motion(np.zeros_like(right), right)


_ASIDE = Parameter("aside", _shift_aside, _motion_aside, is_length=True, of_drives=True)
"""Where the camera is on the car, to a side: told only where objects are passed in both directions, or in bends. So it
is not among what is estimated always: where it cannot be told, the other estimates would be worse beside it."""


def _raised(dataset: Dataset, up_m: float) -> Dataset:
    return with_centers(dataset, camera_centers(dataset.images) + up_m * np.array(dataset.frame.up))


def _motion_up(dataset: Dataset) -> Motion:
    up = np.tile(dataset.frame.up, (len(dataset.images), 1))
    return Motion(np.zeros_like(up), up)


_ALONG = next(each for each in PARAMETERS if each.name == "along")
_OF_ONE_CAMERA = (*PARAMETERS[:3], Parameter("up", _raised, _motion_up, is_length=True), _ALONG)
"""How one camera of several hangs, and when it exposes: its own rays do not know how high, nor on a straight road how
late, but those of the others do."""


def estimate_of(
    view: View, parameters: tuple[Parameter, ...], *, start: Estimate | None = None, rounds: int = ROUNDS
) -> Estimate | None:
    """Return the estimate of parameters at the many places of a view."""
    given = view.agreement_at_many_places
    return estimate(view.dataset, view.many_places, view.gate_px, parameters, start=start, rounds=rounds, given=given)


@once_a_view
def common_errors(view: View, parameters: tuple[Parameter, ...]) -> Estimate | None:
    """Return the estimate of what all images may share."""
    return estimate_of(view, parameters)


@once_a_view
def settled_errors(view: View, parameters: tuple[Parameter, ...]) -> Estimate:
    """Return the same followed to its end: of an error that is there, its full size."""
    start = common_errors(view, parameters)
    assert start is not None
    settled = estimate_of(view, parameters, start=start)
    assert settled is not None
    return settled


def parameters_of(view: View) -> tuple[Parameter, ...]:
    """Return what all images may share: without focal lengths where a camera has none."""
    cameras = view.dataset.cameras
    has_focal = all(focals(cameras, row) for row in range(len(cameras)))
    return PARAMETERS if has_focal else tuple(p for p in PARAMETERS if p.name != "log_focal")


@once_a_view
def _best_correction(view: View) -> Correction | None:
    """Return the one change that lets rays agree best, None where none is told from nothing.

    The estimate must be told from its standard error, and the agreement with the correction from that without. One at a
    time, the best first: of a shift along the drive a little looks like a wrong focal length.
    """
    every = _better_explained(view, _find_correction(view), _find_focal(view))
    every = every or _find_beyond_noise(view) or _find_aside(view)
    return _better_explained(view, every, _find_of_one_group(view))


_OF_A_CAMERA, _OF_A_PASS = frozenset({"pitch", "yaw", "roll", "log_focal"}), frozenset({"pitch", "yaw", "roll"})
"""What one camera may have of its own, and what changes when it is mounted anew for a drive."""


def _find_of_one_group(view: View) -> Correction | None:
    """Return the change of one camera, or of the cameras of one pass, by which rays gain most.

    Its size is estimated from the group's own rays, or of a camera from how they meet those of the others. That it is
    no accident must show in how all rays meet; where how they do has told the size, it need not show as surely again.
    """
    groups, compared = groups_of(view.dataset), 0
    best: Correction | None = None
    for group in groups:
        alone = group.alone(view)
        told = _estimates_of(alone, _OF_A_CAMERA if group.pass_name is None else _OF_A_PASS, len(groups))
        by_others = _estimates_by_others(view, group, alone, len(groups)) if group.pass_name is None else ()
        for own, is_by_others in (*((each, False) for each in told), *((each, True) for each in by_others)):
            compared += 1
            correction = replace(own, group=group)
            comparison = compare(gains_of_all(view, correction(view.dataset)), gains_of_all(view, view.dataset))
            is_borne_out = is_by_others and comparison.chance * len(groups) < AGAINST
            chance = own.chance if is_borne_out else max(own.chance, comparison.chance)
            correction = replace(correction, comparison=comparison, chance=chance)
            if best is None or comparison.difference > best.comparison.difference:
                best = correction
    if best is None or best.chance * compared > LEAST_CHANCE:
        return None
    return replace(best, chance=best.chance * compared)


def _estimates_of(alone: View, told: frozenset[str], groups: int) -> Iterator[Correction]:
    """Yield the changes of a group that its own rays tell from nothing, if a map would show them."""
    parameters = parameters_of(alone)
    found = common_errors(alone, parameters)
    if found is None:
        return
    for name in found.names:
        value, sigma = found.of(name)
        chance = chance_of(found, name, groups)
        if name not in told or chance > LEAST_CHANCE:
            continue
        parameter = next(p for p in parameters if p.name == name)
        given = gains_of_all(alone, alone.dataset)
        gains = gains_of_all(alone, parameter.change(alone.dataset, value))
        value, sigma, gains = _better(alone, parameters, parameter, value, sigma, gains)
        rise = compare(gains, given)
        if rise.difference < LEAST_RISE * float(given.sum()):
            continue
        own = _followed(alone, Correction(parameter, value, sigma, chance, rise, found), given)
        least = _LEAST_LOG_FOCAL if name == "log_focal" else _LEAST_GATES * GATE_RAD * alone.gate_share
        if abs(own.value) < least:
            continue
        if name == "log_focal" and _is_wider_gate_only(alone, parameter.change(alone.dataset, own.value)):
            continue
        yield replace(own, chance=chance)


def _estimates_by_others(view: View, group: Group, alone: View, groups: int) -> Iterator[Correction]:
    """Yield the changes of a camera's mount that its rays need to meet those of the others, if a map would show them.

    What one camera sees little of alone, others see as well; and only they tell how high it is.
    """
    own = tuple(_of_group(parameter, group) for parameter in _OF_ONE_CAMERA)
    turn_rad = _LEAST_GATES * GATE_RAD * view.gate_share
    least = {each.name: seen_m(view) if each.is_length else turn_rad for each in own}
    first: Estimate | None = None
    for rounds, share in _FIRST_ROUNDS:
        # Of a camera that is off by gates few votes are right at the gate at which good rays meet.
        first = estimate_of(at_wider_gate(view), own, rounds=rounds)
        if first is None or all(abs(first.of(name)[0]) < share * smallest for name, smallest in least.items()):
            return
    found = estimate_of(view, own, start=first)
    assert found is not None
    given, least_rise = gains_of_all(view, view.dataset), LEAST_RISE * float(gains_of_all(alone, alone.dataset).sum())
    for parameter, changes in zip(_OF_ONE_CAMERA, own, strict=True):
        value, sigma = found.of(parameter.name)
        chance = chance_of(found, parameter.name, groups)
        if chance > LEAST_CHANCE or abs(value) < least[parameter.name]:
            continue
        rise = compare(gains_of_all(view, changes.change(view.dataset, value)), given)
        if rise.difference >= least_rise:
            followed = _followed(view, Correction(changes, value, sigma, chance, rise, found), given)
            yield replace(followed, parameter=parameter, chance=chance)


@once_a_view
def at_wider_gate(view: View) -> View:
    """Return a view of the same dataset at which rays of cameras that are a few gates off vote, too."""
    return View(view.dataset, gate_share=view.gate_share * WIDER_GATE, known=view.known)


def _of_group(parameter: Parameter, group: Group) -> Parameter:
    def change(dataset: Dataset, value: float) -> Dataset:
        return OfGroup(group, lambda part: parameter.change(part, value))(dataset)

    def motion(dataset: Dataset) -> Motion:
        assert parameter.motion is not None
        of_all, mine = parameter.motion(dataset), group.images_of(dataset)[:, None]
        return Motion(of_all.turn * mine, of_all.move * mine)

    return replace(parameter, change=change, motion=motion)


def chance_of(found: Estimate, name: str, groups: int) -> float:
    """Return how likely one of all parameters of all groups is as far from nothing."""
    value, sigma = found.of(name)
    freedom = max(found.places - len(found.names), 1)
    return 2.0 * float(stats.t.sf(abs(value) / sigma, freedom)) * len(found.names) * groups


_FIRST_ROUNDS = (1, 0.2), (ROUNDS, HALF_WAY)
"""At a wide gate so many rounds of an estimate go at least so far. In simulated rigs with a camera that is turned by
1.6 to 4 degrees, a metre too low or 0.3 s late, the first round goes a quarter to all of the way."""
_LEAST_GATES = 2.0
"""How many gates (1.4 degrees) one group must be turned by: mounts are known to a degree, and levels assumed to one."""
_LEAST_LOG_FOCAL = 0.05
"""So much of a focal length moves what is 30 degrees from the axis as far."""


def _better_explained(view: View, every: Correction | None, one: Correction | None) -> Correction | None:
    """Return which of two corrections, of all images and of one group, lets all rays agree better."""
    if every is None or one is None:
        return every or one
    return one if agreement_after(view, one) > agreement_after(view, every) else every


def _find_correction(view: View) -> Correction | None:
    parameters = parameters_of(view)
    found = common_errors(view, parameters)
    if found is None:
        return None
    tests = len(found.names)
    given = gains_of_all(view, view.dataset)
    best: Correction | None = None
    for name in found.names:
        parameter = next(p for p in parameters if p.name == name)
        correction = _told_of_all(view, parameters, parameter, found)
        if correction is None:
            continue
        comparison = correction.comparison
        chance = max(correction.chance, comparison.chance * tests * 2)  # Of each parameter two values are tried.
        if chance > LEAST_CHANCE or comparison.difference < LEAST_RISE * float(given.sum()):
            continue
        if name == "log_focal" and _is_wider_gate_only(view, correction(view.dataset)):
            continue
        if best is None or comparison.difference > best.comparison.difference:
            best = replace(correction, chance=chance)
    if best is None:
        return None
    followed = _followed(view, best, given)
    # Agreement may rise on and on with the gate, where the first value was small enough not to show it.
    is_focal = followed.parameter.name == "log_focal"
    return None if is_focal and _is_wider_gate_only(view, followed(view.dataset)) else followed


def _told_of_all(
    view: View, parameters: tuple[Parameter, ...], parameter: Parameter, found: Estimate
) -> Correction | None:
    """Return the change of a parameter, estimated beside all others, if its standard error tells it from nothing."""
    value, sigma = found.of(parameter.name)
    chance = chance_of(found, parameter.name, 1)
    if chance > LEAST_CHANCE:
        return None
    given = gains_of_all(view, view.dataset)
    gains = gains_of_all(view, parameter.change(view.dataset, value))
    value, sigma, gains = _better(view, parameters, parameter, value, sigma, gains)
    # What the opposite gives as well is none of it: poses moved along their drives are smoother than measured ones.
    opposite = gains_of_all(view, parameter.change(view.dataset, -value))
    comparison = compare(gains, opposite if opposite.sum() > given.sum() else given)
    return Correction(parameter, value, sigma, chance, comparison, found)


_LOG_FOCALS = 0.09 * np.array([-4, -3, -2, -1, 1, 2, 3, 4])
"""Steps of less than a tenth, to beyond the nearest sizes that pictures are scaled to, 3/4 and 4/3."""
_LOG_FOCAL_STEP = 0.01
"""To which a focal length is told between two of these."""


def _find_focal(view: View) -> Correction | None:
    """Return other focal lengths of all cameras, or of one, that rays agree with: of those far off few votes are right.

    So least squares stay where they are, or go astray. What suits all must not spoil what one camera sees.
    """
    cameras = [group for group in groups_of(view.dataset) if group.pass_name is None]
    of_all = _focal_by_trial(view, 1 + len(cameras))
    if of_all is not None:
        for camera in cameras:
            alone = camera.alone(view)
            given = float(gains_of_all(alone, alone.dataset).sum())
            if agreement_after(alone, of_all) < (1.0 - LEAST_RISE) * given:
                of_all = None
                break
    best = of_all
    for camera in cameras:
        own = _focal_by_trial(camera.alone(view), 1 + len(cameras))
        if own is None:
            continue
        one = replace(own, group=camera)
        comparison = compare(fair_gains(view, one(view.dataset)), gains_of_all(view, view.dataset))
        if comparison.chance < AGAINST:
            best = _better_explained(view, best, replace(one, comparison=comparison))
    return best


def _focal_by_trial(view: View, groups: int) -> Correction | None:
    parameters = parameters_of(view)
    parameter = next((each for each in parameters if each.name == "log_focal"), None)
    found = None if parameter is None else common_errors(view, parameters)
    if parameter is None or found is None:
        return None
    given = gains_of_all(view, view.dataset)
    gains = {float(value): fair_gains(view, with_focal(view.dataset, float(value))) for value in _LOG_FOCALS}

    def loss(value: float) -> float:
        gains[value] = fair_gains(view, with_focal(view.dataset, value))
        return -float(gains[value].sum())

    def total(value: float) -> float:
        return float(gains[value].sum())

    first = max(gains, key=total)
    if total(first) <= float(given.sum()):
        return None
    step = float(_LOG_FOCALS[-1] - _LOG_FOCALS[-2])
    bounds = (first - step, first + step)
    minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": _LOG_FOCAL_STEP, "maxiter": _MOST_STEPS})
    value = max(gains, key=total)
    comparison = compare(gains[value], given)
    chance = comparison.chance * len(gains) * groups
    rises = comparison.difference >= LEAST_RISE * float(given.sum())
    if chance > LEAST_CHANCE or not rises or abs(value) < _LEAST_LOG_FOCAL:
        return None
    sigma = max(found.of(parameter.name)[1], _LOG_FOCAL_STEP)
    correction = Correction(parameter, value, sigma, chance, comparison, found)
    if _is_wider_gate_only(view, correction(view.dataset)):
        return None
    # Gates tell roughly how long they are; by the votes that there are now, least squares tell the rest.
    near = View(correction(view.dataset), gate_share=view.gate_share, known=view.known)
    rest = common_errors(near, parameters)
    if rest is None or abs(rest.of(parameter.name)[0]) > step:
        return correction
    left, sigma = rest.of(parameter.name)
    return replace(correction, value=value + left, sigma=max(sigma, _LOG_FOCAL_STEP))


def _find_aside(view: View) -> Correction | None:
    """Return how much farther to a side all cameras are, if that is told from nothing and from the noise of poses.

    Most objects are passed in one direction only, and are as much aside as the cameras, to the liking of all rays. So
    the agreement rises by little, however far the map is off: it is to bear out what the estimate says.
    """
    parameters = (*parameters_of(view), _ASIDE)
    found, misses = common_errors(view, parameters), loose_of(view).misses(view.dataset)
    if found is None or misses is None:
        return None
    least_m = max(seen_m(view), LEAST_TIMES * misses.distance_m)
    if abs(found.of(_ASIDE.name)[0]) < HALF_WAY * least_m:
        return None
    correction = _told_of_all(view, parameters, _ASIDE, found)
    if correction is None or abs(correction.value) < least_m:
        return None
    if correction.comparison.chance * 2 > AGAINST:  # Two values are tried.
        return None
    followed = _followed(view, correction, gains_of_all(view, view.dataset))
    return replace(followed, chance=correction.chance)


def _find_beyond_noise(view: View) -> Correction | None:
    """Return a change of one parameter that is larger than what single rays miss by, where the gate is too narrow.

    How cameras hang to a side is estimated, and not named: it turns rays by little.
    """
    focal = next((each for each in parameters_of(view) if each.name == "log_focal"), None)
    others = tuple(each for each in PARAMETERS if each.name != "log_focal")
    return loose_of(view).correction(others, frozenset({"pitch", "yaw", "along"}), focal)


def _is_wider_gate_only(view: View, dataset: Dataset) -> bool:
    """Return whether rays agree with other focal lengths only because the gate, in pixels, is a wider angle then.

    Errors of poses are angles: pictures said to be six times as wide make them a sixth of the pixels. So the gate is
    one angle, and so wide that all rays of an object vote either way: how close they pass counts, not how many do.
    """
    wide = at_wider_gate(view)
    at_one_angle = float(gains_of_all(wide, dataset, is_gate_an_angle=True).sum())
    return at_one_angle < float(gains_of_all(wide, view.dataset).sum())


class _CommonError(Fault):
    """Something small that all images share."""

    stage: ClassVar[Stage] = "fine"
    parameters: ClassVar[tuple[str, ...]]
    do: ClassVar[str]

    def find(self, view: View) -> Finding | None:
        """Take the correction that lets rays agree best, if it is one of these parameters."""
        best = _best_correction(view)
        if best is None or best.parameter.name not in self.parameters:
            return None
        name, value, found = best.parameter.name, best.value, best.estimate
        return Finding(
            fault=self.name,
            what=self.says(view, name, value)
            if best.group is None
            else _only(best.group, self.says(view, name, value)),
            why=f"{self.shows(view, name, value, best.sigma)} over {found.places} places and {found.points} objects; "
            f"corrected, the agreement of rays rises by {best.comparison.difference:.0f} "
            f"({best.comparison.places} places).",
            do=self.do,
            chance=best.chance,
            figures={
                "estimates": found.to_json(),
                "parameter": name,
                **({} if best.group is None else {"of": best.group.text}),
                **best.comparison.to_json(),
            },
            fix=best,
            of=None if best.group is None else best.group.text,
        )

    @abstractmethod
    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""

    def shows(self, view: View, name: str, value: float, sigma: float) -> str:
        """Return the estimate in the unit that people use."""
        return f"The estimate is {np.degrees(value):.2f} ± {np.degrees(sigma):.2f} degrees"


class CameraTilt(_CommonError):
    """Cameras that look higher or lower, or hang more to a side, than their poses say."""

    name: ClassVar[str] = "camera_tilt"
    parameters: ClassVar[tuple[str, ...]] = ("pitch", "roll")
    # The noise of pitch and roll hides how cameras are mounted.
    completes: ClassVar[frozenset[str]] = frozenset(
        {"camera_tilt", "camera_mount", "pitch_and_roll", "inverted_mounts"}
    )
    do: ClassVar[str] = "Correct the rotation between car and camera, or the principal point's y."

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        if name == "pitch":
            way = "lower" if value > 0 else "higher"
            return f"The cameras look {abs(np.degrees(value)):.2f} degrees {way} than their poses say."
        return f"The cameras are rolled by {abs(np.degrees(value)):.2f} degrees against their poses."


class CameraYaw(_CommonError):
    """Cameras that look more to a side than their poses say."""

    name: ClassVar[str] = "camera_yaw"
    parameters: ClassVar[tuple[str, ...]] = ("yaw",)
    completes: ClassVar[frozenset[str]] = frozenset({"camera_yaw", "camera_mount", "inverted_mounts"})
    do: ClassVar[str] = "Correct the rotation between car and camera, or the principal point's x."

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        side = "right" if value < 0 else "left"
        return f"The cameras look {abs(np.degrees(value)):.2f} degrees more to the {side} than their poses say."


class FocalLength(_CommonError):
    """A focal length that is wrong."""

    name: ClassVar[str] = "focal_length"
    parameters: ClassVar[tuple[str, ...]] = ("log_focal",)
    completes: ClassVar[frozenset[str]] = frozenset({"focal_length"})
    do: ClassVar[str] = "Calibrate the cameras, or scale their focal lengths: of which picture size are they?"

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        return f"The focal lengths are too {'short' if value > 0 else 'long'}: {np.exp(value):.3f} times them is right."

    def shows(self, view: View, name: str, value: float, sigma: float) -> str:
        """Return the factor."""
        return f"The factor is {np.exp(value):.3f} ± {sigma:.3f}"


class CameraHeight(_CommonError):
    """Cameras of a pass, or one of several on a car, that are at another height than their poses say."""

    name: ClassVar[str] = "camera_height"
    rivals: ClassVar[frozenset[str]] = OF_ITS_CAMERA
    may_be_reading: ClassVar[bool] = True
    parameters: ClassVar[tuple[str, ...]] = ("up",)
    completes: ClassVar[frozenset[str]] = frozenset({"camera_height"})
    do: ClassVar[str] = "Correct the position of the camera on the car."

    def find(self, view: View) -> Finding | None:
        """Take the offset of the pass that is farthest from good, if it is up or down; else that of a camera."""
        return find_height_of_pass(view, self.name) or super().find(view)

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        return f"The cameras are {abs(value):.2f} m too {'low' if value > 0 else 'high'}."

    def shows(self, view: View, name: str, value: float, sigma: float) -> str:
        """Return metres."""
        return f"The estimate is {value:.2f} ± {sigma:.2f} m"


class CameraAside(_CommonError):
    """Cameras that are farther to a side of the car than their poses say."""

    name: ClassVar[str] = "camera_aside"
    parameters: ClassVar[tuple[str, ...]] = ("aside",)
    completes: ClassVar[frozenset[str]] = frozenset({"camera_aside"})
    do: ClassVar[str] = (
        "Correct the way from the point that the poses are of (antenna, axle) to the camera: is its sign, right or "
        "left, the one that is meant?"
    )

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        side = "right" if value > 0 else "left"
        return f"The cameras are {abs(value):.2f} m farther to the {side} of their way than their poses say."

    def shows(self, view: View, name: str, value: float, sigma: float) -> str:
        """Return metres."""
        return f"The estimate is {value:.2f} ± {sigma:.2f} m"


class TimeShift(_CommonError):
    """Poses that are some time off all pictures."""

    name: ClassVar[str] = "time_shift"
    parameters: ClassVar[tuple[str, ...]] = ("along",)
    completes: ClassVar[frozenset[str]] = frozenset({"time_shift"})
    do: ClassVar[str] = (
        "Correct the clock between cameras and poses (trigger, exposure or network delay). If it is a whole number of "
        "images: are detections listed with the images before or after theirs?"
    )

    def find(self, view: View) -> Finding | None:
        """Take a small shift, else one of seconds."""
        found = super().find(view)
        return found if found is not None or _best_correction(view) is not None else find_clock(view)

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        side = "behind" if value > 0 else "ahead of"
        images = abs(value) / view.step_m
        return f"The poses are {abs(value):.2f} m along the road ({images:.1f} images) {side} their pictures."

    def shows(self, view: View, name: str, value: float, sigma: float) -> str:
        """Return metres."""
        return f"The shift is {value:.2f} ± {sigma:.2f} m"


def _better(
    view: View, parameters: tuple[Parameter, ...], parameter: Parameter, value: float, sigma: float, gains: Floats
) -> tuple[float, float, Floats]:
    """Return value, standard error and gains of the first estimate or the settled one, whichever rays agree with."""
    settled, settled_sigma = settled_errors(view, parameters).of(parameter.name)
    settled_gains = gains_of_all(view, parameter.change(view.dataset, settled))
    return (settled, settled_sigma, settled_gains) if settled_gains.sum() > gains.sum() else (value, sigma, gains)


def _followed(view: View, best: Correction, given: Floats) -> Correction:
    """Return a correction as far as the agreement of rays rises with it.

    Least squares know only the votes that there are. Of an error as large as the way between objects most are wrong,
    and the estimate stays where these pull; the agreement, which votes anew, rises up to the error.
    """
    gains: dict[float, Floats] = {}

    def loss(value: float) -> float:
        gains[value] = gains_of_all(view, best.parameter.change(view.dataset, value))
        return -float(gains[value].sum())

    value, least = best.value, loss(best.value)
    for _ in range(_MOST_DOUBLINGS):
        farther = loss(2.0 * value)
        if farther >= least:
            break
        value, least = 2.0 * value, farther
    if value == best.value:
        return best
    minimize_scalar(
        loss,
        bounds=(min(value / 2.0, 2.0 * value), max(value / 2.0, 2.0 * value)),
        method="bounded",
        options={"xatol": best.sigma, "maxiter": _MOST_STEPS},
    )
    value = max(gains, key=lambda each: float(gains[each].sum()))
    comparison = compare(gains[value], given)
    # The values tried count as tests, as those before did.
    chance = max(best.chance, comparison.chance * len(gains))
    return replace(best, value=value, chance=chance, comparison=comparison)


def _only(group: Group, what: str) -> str:
    return f"Only {group.text}: {what[0].lower()}{what[1:]}"


class HalfPixel(Fault):
    """Pixels counted from the middle of the first one on one side, and from its corner on the other."""

    name: ClassVar[str] = "half_pixel"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look at where principal points are, and where boxes cut by the border of the picture end."""
        return _principal_points_at_integers(view) or _boxes_cut_aside(view)


def _principal_points_at_integers(view: View) -> Finding | None:
    cameras = view.dataset.cameras
    rows: list[int] = []
    middles = 0
    for row, params in enumerate(cameras.params):
        count = focals(cameras, row)
        if not count:
            continue
        off = 2.0 * params[count : count + 2] - [cameras.width_px[row], cameras.height_px[row]]
        if np.all(np.abs(off + 1.0) < 1e-6):
            rows.append(row)
        middles += int(np.all(np.abs(off) < 1e-6))
    if not rows or middles:
        return None
    first = cameras.params[rows[0]]
    count = focals(cameras, rows[0])
    return Finding(
        fault=HalfPixel.name,
        what="The principal points are half a pixel off: they count from the middle of the first pixel.",
        why=f"{len(rows)} of {len(cameras)} cameras have it at exactly (width - 1) / 2, (height - 1) / 2 "
        f"({first[count]:g}, {first[count + 1]:g} of {cameras.width_px[rows[0]]} x {cameras.height_px[rows[0]]}): "
        "the middle of a picture where pixel centres are whole numbers, as in OpenCV; here they are at halves.",
        do="Add 0.5 to cx and cy (and to box centres that were measured so).",
        figures={"cameras": len(rows)},
        fix=lambda dataset: _with_principal_points(dataset, rows, 0.5),
    )


def _with_principal_points(dataset: Dataset, rows: list[int], shift_px: float) -> Dataset:
    params = [values.copy() for values in dataset.cameras.params]
    for row in rows:
        count = focals(dataset.cameras, row)
        params[row][count : count + 2] += shift_px
    return with_params(dataset, params)


def _boxes_cut_aside(view: View) -> Finding | None:
    from valuemap.check.boxes import picture_sizes

    detections = view.dataset.detections
    low = detections.center_px - detections.size_px / 2.0
    high = picture_sizes(view.dataset) - detections.center_px - detections.size_px / 2.0
    for axis in (0, 1):
        first, last = float(low[:, axis].min()), float(high[:, axis].min())
        shift = (last - first) / 2.0
        at_first, at_last = (
            int((np.abs(side[:, axis] - end) < 1e-3).sum()) for side, end in ((low, first), (high, last))
        )
        # A border that boxes are cut at is cut at in both directions of the picture at the same number.
        at_other = (
            int((np.abs(low[:, 1 - axis] - first) < 1e-3).sum()) if abs(low[:, 1 - axis].min() - first) < 1e-3 else 0
        )
        if abs(abs(shift) - 0.5) < 1e-3 and min(at_first, at_last) >= 2 and at_first + at_other >= 3:
            return Finding(
                fault=HalfPixel.name,
                what="The boxes are half a pixel off: they count from the middle of the first pixel.",
                why=f"Boxes cut by the picture end at {first:g} px on one side ({at_first + at_other} boxes) and "
                f"{last:g} px before the other ({at_last} boxes): the picture they were cut by is {shift:+g} px off.",
                do=f"Add {shift:g} to x and y of the boxes.",
                figures={"shift_px": shift, "boxes": at_first + at_other + at_last},
                fix=partial(_with_boxes_moved, shift_px=shift),
            )
    return None


def _with_boxes_moved(dataset: Dataset, *, shift_px: float) -> Dataset:
    return with_detections(dataset, center_px=dataset.detections.center_px + shift_px)


class WrongCamera(Fault):
    """Images that have another image's camera."""

    name: ClassVar[str] = "wrong_camera"
    stage: ClassVar[Stage] = "fine"

    def find(self, view: View) -> Finding | None:
        """Give the images of each pass and camera each other camera and see whether their rays agree better."""
        chosen, chance = _best_cameras(view)
        if not chosen:
            return None
        worst = max(chosen, key=lambda each: each["difference"])
        rows = sum(each["images"] for each in chosen)
        cameras = {(each["pass"], each["camera"]): each["better"] for each in chosen}
        return Finding(
            fault=self.name,
            what="Images have the wrong camera.",
            why=f"Of {rows} images in {len(chosen)} groups of a pass the rays agree better with another camera of the "
            f"table: those of pass {worst['pass']} have camera {worst['camera']}, and with camera {worst['better']} "
            f"their agreement is {worst['with_better']:.0f} instead of {worst['as_given']:.0f}.",
            do="Give each image the camera that took it.",
            chance=chance,
            figures={"images": rows, "groups": chosen[:10]},
            fix=lambda dataset: _with_cameras(dataset, cameras),
        )


def _best_cameras(view: View) -> tuple[list[dict[str, Any]], float]:
    cameras = view.dataset.cameras
    if not 1 < len(cameras) <= _MOST_CAMERAS:
        return [], 1.0
    sample = view.stretches
    images = sample.dataset.images
    place_pass = np.zeros(sample.places, dtype=np.int64)
    place_camera = np.zeros(sample.places, dtype=np.int64)
    place_pass[sample.place_of_image] = images.pass_id.codes
    place_camera[sample.place_of_image] = images.camera_id
    gains: dict[int, Floats] = {}
    for row, camera in enumerate(cameras.camera_id.tolist()):
        version = with_images(sample.dataset, camera_id=np.full(len(images), camera))
        gate_px = view.gate_px * pixels_per_radian_of(view.dataset, row) / pixels_per_radian(view.dataset)
        gains[camera] = agreement_on(sample, version, gate_px).gain
    best: list[dict[str, Any]] = []
    better: list[Floats] = []
    worse: list[Floats] = []
    groups = np.unique(np.stack([place_pass, place_camera], axis=1), axis=0)
    for code, camera in groups.tolist():
        of_group = (place_pass == code) & (place_camera == camera)
        given = gains[camera][of_group]
        comparisons = {other: compare(gain[of_group], given) for other, gain in gains.items() if other != camera}
        other = min(comparisons, key=lambda each: (comparisons[each].chance, -comparisons[each].difference))
        least_rise = LEAST_RISE * float(given.sum())
        if comparisons[other].chance > _SUSPICIOUS or comparisons[other].difference < least_rise:
            continue
        better.append(gains[other][of_group])
        worse.append(given)
        best.append(
            {
                "pass": images.pass_id.names[code],
                "camera": camera,
                "better": other,
                "images": int(((images.pass_id.codes == code) & (images.camera_id == camera)).sum()),
                "as_given": round(float(given.sum()), 1),
                "with_better": round(float(better[-1].sum()), 1),
                "difference": round(comparisons[other].difference, 1),
            }
        )
    if not best:
        return [], 1.0
    # One pass may have too few stretches to be sure of; all that are suspicious together have not.
    chance = compare(np.concatenate(better), np.concatenate(worse)).chance * len(groups) * (len(gains) - 1)
    return (best, chance) if chance < LEAST_CHANCE else ([], 1.0)


_SUSPICIOUS = 0.05
"""One pass in twenty is so by luck: what is judged together is not judged by this alone."""
_MOST_CAMERAS = 6


def pixels_per_radian_of(dataset: Dataset, row: int) -> float:
    """Return how many pixels a radian has in the middle of the picture of one camera."""
    return pixels_per_radian(Dataset(**{**vars(dataset), "cameras": dataset.cameras.take(np.array([row]))}))


def _with_cameras(dataset: Dataset, cameras: dict[tuple[str, int], int]) -> Dataset:
    """Give images the cameras found for their pass; passes outside the sample follow those with the same camera."""
    images = dataset.images
    camera = images.camera_id.copy()
    for (name, old), new in cameras.items():
        rows = (images.camera_id == old) & (images.pass_id.codes == images.pass_id.code_of(name))
        camera[rows] = new
    return with_images(dataset, camera_id=camera)
