"""The one change of all images, or of one camera or pass, that lets rays agree best."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from valuemap.arrays import Floats
from valuemap.check.agreement import compare
from valuemap.check.fault import (
    AGAINST,
    GATE_RAD,
    LEAST_CHANCE,
    LEAST_RISE,
    View,
    agreement_after,
    fair_gains,
    gains_of_all,
    gains_without,
    once_a_view,
)
from valuemap.check.fit import ROUNDS, MotionByParameter, Parameter, ParameterEstimate
from valuemap.check.groups import Group, OfGroup, groups_of
from valuemap.check.loose import HALF_WAY, LEAST_TIMES, Correction, loose_of
from valuemap.check.parameters import (
    ASIDE,
    OF_ONE_CAMERA,
    PARAMETERS,
    at_wider_gate,
    chance_of,
    common_errors,
    estimate_of,
    parameters_of,
    settled_errors,
    with_focal,
)
from valuemap.dataset import Dataset

_MOST_DOUBLINGS, _MOST_STEPS = 6, 12
"""Of a search that ends by itself as soon as the agreement falls: of turns it need not."""

_OF_A_CAMERA, _OF_A_PASS = frozenset({"pitch", "yaw", "roll", "log_focal"}), frozenset({"pitch", "yaw", "roll"})
"""What one camera may have of its own, and what changes when it is mounted anew for a drive."""

_FIRST_ROUNDS = (1, 0.2), (ROUNDS, HALF_WAY)
"""At a wide gate so many rounds of an estimate go at least so far. In simulated rigs with a camera that is turned by
1.6 to 4 degrees, a metre too low or 0.3 s late, the first round goes a quarter to all of the way."""

_LEAST_GATES = 2.0
"""How many gates (1.4 degrees) one group must be turned by: mounts are known to a degree, and levels assumed to one."""

_LEAST_LOG_FOCAL = 0.05
"""So much of a focal length moves what is 30 degrees from the axis as far."""

_LOG_FOCALS = 0.09 * np.array([-4, -3, -2, -1, 1, 2, 3, 4])
"""Steps of less than a tenth, to beyond the nearest sizes that pictures are scaled to, 3/4 and 4/3."""

_LOG_FOCAL_STEP = 0.01
"""To which a focal length is told between two of these."""


@once_a_view
def best_correction(view: View) -> Correction | None:
    """Return the one change that lets rays agree best, None where none is told from nothing.

    The estimate must be told from its standard error, and the agreement with the correction from that without. One at a
    time, the best first: of a shift along the drive a little looks like a wrong focal length.
    """
    every = _better_explained(view, find_correction(view), find_focal(view))
    every = every or find_beyond_noise(view) or find_aside(view)
    return _better_explained(view, every, find_of_one_group(view))


def _better_explained(view: View, every: Correction | None, one: Correction | None) -> Correction | None:
    """Return which of two corrections, of all images and of one group, lets all rays agree better."""
    if every is None or one is None:
        return every or one
    return one if agreement_after(view, one) > agreement_after(view, every) else every


def find_correction(view: View) -> Correction | None:
    """Return the change of all images, by least squares, by which rays gain most."""
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
        if name == "log_focal" and is_wider_gate_only(view, correction(view.dataset)):
            continue
        if best is None or comparison.difference > best.comparison.difference:
            best = replace(correction, chance=chance)
    if best is None:
        return None
    followed = follow(view, best)
    # Agreement may rise on and on with the gate, where the first value was small enough not to show it.
    is_focal = followed.parameter.name == "log_focal"
    return None if is_focal and is_wider_gate_only(view, followed(view.dataset)) else followed


def _told_of_all(
    view: View, parameters: tuple[Parameter, ...], parameter: Parameter, found: ParameterEstimate
) -> Correction | None:
    """Return the change of a parameter, estimated beside all others, if its standard error tells it from nothing."""
    value, sigma = found.of(parameter.name)
    chance = chance_of(found, parameter.name, 1)
    if chance > LEAST_CHANCE:
        return None
    gains = gains_of_all(view, parameter.change(view.dataset, value))
    value, sigma, gains = _better(view, parameters, parameter, value, sigma, gains)
    comparison = compare(gains, gains_without(view, parameter.change(view.dataset, -value)))
    return Correction(parameter, value, sigma, chance, comparison, found)


def _better(
    view: View, parameters: tuple[Parameter, ...], parameter: Parameter, value: float, sigma: float, gains: Floats
) -> tuple[float, float, Floats]:
    """Return value, standard error and gains of the first estimate or the settled one, whichever rays agree with."""
    settled, settled_sigma = settled_errors(view, parameters).of(parameter.name)
    settled_gains = gains_of_all(view, parameter.change(view.dataset, settled))
    return (settled, settled_sigma, settled_gains) if settled_gains.sum() > gains.sum() else (value, sigma, gains)


def follow(view: View, best: Correction) -> Correction:
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
    comparison = compare(gains[value], gains_without(view, best.parameter.change(view.dataset, -value)))
    # The values tried count as tests, as those before did.
    chance = max(best.chance, comparison.chance * len(gains))
    return replace(best, value=value, chance=chance, comparison=comparison)


def find_focal(view: View) -> Correction | None:
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
    if is_wider_gate_only(view, correction(view.dataset)):
        return None
    # Gates tell roughly how long they are; by the votes that there are now, least squares tell the rest.
    near = View(correction(view.dataset), gate_share=view.gate_share, known=view.known)
    rest = common_errors(near, parameters)
    if rest is None or abs(rest.of(parameter.name)[0]) > step:
        return correction
    left, sigma = rest.of(parameter.name)
    return replace(correction, value=value + left, sigma=max(sigma, _LOG_FOCAL_STEP))


def is_wider_gate_only(view: View, dataset: Dataset) -> bool:
    """Return whether rays agree with other focal lengths only because the gate, in pixels, is a wider angle then.

    Errors of poses are angles: pictures said to be six times as wide make them a sixth of the pixels. So the gate is
    one angle, and so wide that all rays of an object vote either way: how close they pass counts, not how many do.
    """
    wide = at_wider_gate(view)
    at_one_angle = float(gains_of_all(wide, dataset, is_gate_an_angle=True).sum())
    return at_one_angle < float(gains_of_all(wide, view.dataset).sum())


def find_beyond_noise(view: View) -> Correction | None:
    """Return a change of one parameter that is larger than what single rays miss by, where the gate is too narrow.

    How cameras hang to a side is estimated, and not named: it turns rays by little.
    """
    focal = next((each for each in parameters_of(view) if each.name == "log_focal"), None)
    others = tuple(each for each in PARAMETERS if each.name != "log_focal")
    return loose_of(view).correction(others, frozenset({"pitch", "yaw", "along"}), focal)


def find_aside(view: View) -> Correction | None:
    """Return how much farther to a side all cameras are, if that is told from nothing and from the noise of poses.

    Most objects are passed in one direction only, and are as much aside as the cameras, to the liking of all rays. So
    the agreement rises by little, however far the map is off: it is to bear out what the estimate says.
    """
    parameters = (*parameters_of(view), ASIDE)
    found, misses = common_errors(view, parameters), loose_of(view).misses(view.dataset)
    if found is None or misses is None:
        return None
    least_m = max(view.seen_m, LEAST_TIMES * misses.distance_m)
    if abs(found.of(ASIDE.name)[0]) < HALF_WAY * least_m:
        return None
    correction = _told_of_all(view, parameters, ASIDE, found)
    if correction is None or abs(correction.value) < least_m:
        return None
    if correction.comparison.chance * 2 > AGAINST:  # Two values are tried.
        return None
    followed = follow(view, correction)
    return replace(followed, chance=correction.chance)


def find_of_one_group(view: View) -> Correction | None:
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
        own = follow(alone, Correction(parameter, value, sigma, chance, rise, found))
        least = _LEAST_LOG_FOCAL if name == "log_focal" else _LEAST_GATES * GATE_RAD * alone.gate_share
        if abs(own.value) < least:
            continue
        if name == "log_focal" and is_wider_gate_only(alone, parameter.change(alone.dataset, own.value)):
            continue
        yield replace(own, chance=chance)


def _estimates_by_others(view: View, group: Group, alone: View, groups: int) -> Iterator[Correction]:
    """Yield the changes of a camera's mount that its rays need to meet those of the others, if a map would show them.

    What one camera sees little of alone, others see as well; and only they tell how high it is.
    """
    own = tuple(_of_group(parameter, group) for parameter in OF_ONE_CAMERA)
    turn_rad = _LEAST_GATES * GATE_RAD * view.gate_share
    least = {each.name: view.seen_m if each.is_length else turn_rad for each in own}
    first: ParameterEstimate | None = None
    for rounds, share in _FIRST_ROUNDS:
        # Of a camera that is off by gates few votes are right at the gate at which good rays meet.
        first = estimate_of(at_wider_gate(view), own, rounds=rounds)
        if first is None or all(abs(first.of(name)[0]) < share * smallest for name, smallest in least.items()):
            return
    found = estimate_of(view, own, start=first)
    assert found is not None
    given, least_rise = gains_of_all(view, view.dataset), LEAST_RISE * float(gains_of_all(alone, alone.dataset).sum())
    for parameter, changes in zip(OF_ONE_CAMERA, own, strict=True):
        value, sigma = found.of(parameter.name)
        chance = chance_of(found, parameter.name, groups)
        if chance > LEAST_CHANCE or abs(value) < least[parameter.name]:
            continue
        rise = compare(gains_of_all(view, changes.change(view.dataset, value)), given)
        if rise.difference >= least_rise:
            followed = follow(view, Correction(changes, value, sigma, chance, rise, found))
            yield replace(followed, parameter=parameter, chance=chance)


def _of_group(parameter: Parameter, group: Group) -> Parameter:
    def change(dataset: Dataset, value: float) -> Dataset:
        return OfGroup(group, lambda part: parameter.change(part, value))(dataset)

    def motion(dataset: Dataset) -> MotionByParameter:
        assert parameter.motion is not None
        of_all, mine = parameter.motion(dataset), group.images_of(dataset)[:, None]
        return MotionByParameter(of_all.turn * mine, of_all.move * mine)

    return replace(parameter, change=change, motion=motion)
