"""The contest of conventions: all ways to read the data are tried on one sample, and the best is named.

Data as given win unless another reading makes the rays agree better by more than the scatter between places explains.
Several readings may be as good as the best on single stretches of road (on a straight drive a mirrored world agrees as
well); places that several passes meet decide between them, then whether cameras stand upright, then the order of the
registry.

Places are what readings are compared by, as errors of poses last for a while. A short street has too few of them. There
single objects are compared, for readings that take the same numbers to mean something else: what they make of one
object says nothing of what they make of the next. A reading that gives measured values up for guessed ones (level
cameras, say) is better or worse for whole stretches, and always compared by places.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import rotation_matrices
from valuemap.check.agreement import Agreement, Comparison, agreement_on, compare, compare_objects
from valuemap.check.boxes import puts_boxes_outside
from valuemap.check.fault import (
    AGAINST,
    FAR_WORSE,
    LEAST_CHANCE,
    LEAST_RISE,
    SMALL_TURNS_RAD,
    TIE,
    WIDER_GATE,
    Convention,
    Finding,
    Fix,
    View,
    agreement_after,
    gains_of_all,
    uprightness,
)
from valuemap.check.fit import Parameter
from valuemap.check.groups import Group, OfGroup, groups_of, is_of_one_group, only
from valuemap.check.parameters import PARAMETERS
from valuemap.check.sample import HEAT, LEAST_IN_HEAT, Sample
from valuemap.check.wrong_camera import WrongCamera
from valuemap.dataset import Dataset
from valuemap.progress import Progress, silent

_LEAST_UPRIGHT = 0.5
_ALONG_AXIS = 0.985
"""The cosine of 10 degrees, which cars and their cameras lean at most."""
_ENOUGH_PLACES = 12
"""What a sample is cut into where there are detections enough."""
_FROM_RAYS = 0.05
"""Rays must agree better beyond this chance, however upright cameras stand, and before a few stretches refute any."""
_SUSPICIOUS = 0.05
"""What good data would give with a probability above this, all that was tried counted, is not even told."""
_MAY_BE = 0.05
"""Of so many good cameras one is looked at alone for each reading that rays do not object to."""
_LEAST_PRODUCT = 1e-300


@dataclass(frozen=True, eq=False)
class Reading:
    """One way to read the data (none: as given) and what came of it on the stretches."""

    convention: Convention | None
    how: str
    fix: Fix | None
    agreement: Agreement
    uprightness: float
    is_along_axis: bool = False
    tests: int = 1
    """How often the chance of an accident counts: conventions have the same share, and their readings share that."""

    @property
    def is_upright(self) -> bool:
        """Whether the cameras stand."""
        return self.uprightness > _LEAST_UPRIGHT

    @property
    def total(self) -> float:
        """The gain of all places."""
        return float(self.agreement.gain.sum())

    @property
    def is_guess(self) -> bool:
        """Whether it gives up what was measured."""
        return self.convention is not None and self.convention.is_guess

    def is_worth(self, given: Reading) -> bool:
        """Return whether rays agree so much better than as given that it is no mere noise that is taken off."""
        times = None if self.convention is None else self.convention.least_times
        return times is None or self.total >= times * given.total


@dataclass(frozen=True, eq=False)
class Verdict:
    """What is wrong with the conventions, if anything, and what may be.

    `gate_share` is the share of the gate at which rays meet better than by chance; None where they cannot be told to,
    however they are read. `suspicion` is a reading that is better than the given one, but by less than so few places
    can prove. `rivals` are readings, in words, under which cameras stand that as given lie, where rays cannot tell.
    `suspects` are cameras that something else may be wrong with than with all. `runner_up` is the reading of all data
    that rays agree with best, where that is better than as given by no more than chance may be.
    """

    finding: Finding | None
    gate_share: float | None
    suspicion: str | None = None
    rivals: tuple[str, ...] = ()
    suspects: tuple[Group, ...] = ()
    runner_up: Finding | None = None


def hold_contest(
    view: View, conventions: Sequence[Convention], progress: Progress = silent, group: Group | None = None
) -> Verdict:
    """Compare all readings. The gate is widened where rays, read in any way, meet no better than by chance.

    Of a `group`, readings are those of its images alone, and compared by how its rays meet those of all others, too.
    """
    rivals: tuple[str, ...] = ()
    if not len(view.stretches.dataset.detections):
        return Verdict(None, None)
    for gate_share in (view.gate_share, view.gate_share * WIDER_GATE):
        at_gate = view if gate_share == view.gate_share else View(view.dataset, gate_share=gate_share, known=view.known)
        tried = try_readings(at_gate, conventions, progress, group)
        readings = [each for each in tried if each.is_worth(tried[0]) and not _is_outside(at_gate.dataset, each)]
        top = max(readings, key=lambda reading: reading.total)
        rivals = _rivals(readings)
        by_rays = compare_on_samples([top.agreement], [at_gate.chance]).chance
        if joined_with_attitude(by_rays, top, readings[0]) * top.tests > LEAST_CHANCE:
            continue
        suspects = _suspects(at_gate, tried) if group is None else ()
        finding = finding_of_contest(at_gate, readings, top)
        suspicion = None if finding is not None else suspicion_of(readings[0], top)
        if (finding or suspicion) and _is_small_turn(at_gate, top.total, group):
            return Verdict(None, gate_share, suspects=suspects)
        runner_up = None if finding is not None or group is not None else _runner_up(at_gate, readings)
        return Verdict(finding, gate_share, suspicion, () if finding is not None else rivals, suspects, runner_up)
    return Verdict(None, None, rivals=rivals)


def _is_outside(dataset: Dataset, reading: Reading) -> bool:
    """Return whether a reading of boxes leaves some outside of their pictures that are possible as given."""
    if reading.convention is None or reading.fix is None or not reading.convention.is_of_boxes:
        return False
    return puts_boxes_outside(dataset, reading.fix)


def _suspects(view: View, readings: Sequence[Reading]) -> tuple[Group, ...]:
    """Return the cameras of several whose rays another reading of all cameras may suit better than the given one.

    This only says where to look, so it need not be sure.
    """
    sample, given = view.stretches, readings[0].agreement
    found = []
    for group in groups_of(view.dataset):
        mine = group.images_of(sample.dataset)
        if group.pass_name is not None or not mine.any():
            continue
        gain = given.gain_of_images(sample.place_of_image, mine)
        others = (each.agreement.gain_of_images(sample.place_of_image, mine) for each in readings[1:])
        if any(other.sum() > gain.sum() and compare(other, gain).chance < _MAY_BE for other in others):
            found.append(group)
    return tuple(found)


def find_odd_group(
    view: View, conventions: Sequence[Convention], progress: Progress = silent, suspects: Sequence[Group] = ()
) -> Finding | None:
    """Look for a camera or a pass whose rays alone agree far worse than those of others, and hold its own contest.

    What is good in all others is no mistake of the frame, and what changes more than the group is not tried. A reading
    is believed if rays agree with it about as well as those of others do: else it fits by chance what is otherwise
    wrong. Of `suspects` all rays decide where their own are too few to.
    """
    groups = groups_of(view.dataset)
    alone = {group: group.alone(view) for group in groups}
    worth = {group: _worth_of(each) for group, each in alone.items()}
    # Cameras first: one is in many passes.
    for group in sorted(groups, key=lambda each: (each.pass_name is not None, worth[each])):
        others = [
            worth[each] for each in groups if each != group and (each.pass_name is None) == (group.pass_name is None)
        ]
        least = FAR_WORSE * float(np.median(others)) if others else 0.0
        if worth[group] >= least and group not in suspects:
            continue
        may_be = [each for each in conventions if group.pass_name is not None or not each.is_of_world]
        own = [_OfOneGroup(convention, group) for convention in may_be]
        finding = hold_contest(alone[group], own, progress).finding
        if finding is not None and finding.fix is not None:
            finding = only(group, finding)
        elif group in suspects:
            finding = hold_contest(view, [AmongOthers(each, group) for each in own], progress, group).finding
        if finding is None or finding.fix is None or finding.chance is None:
            continue
        chance = finding.chance * len(groups)
        mended = View(group.part(finding.fix(view.dataset)), gate_share=view.gate_share)
        # Cameras see more or less: it is enough to agree as well as the least of those that agree.
        enough = FAR_WORSE * min((each for each in others if each >= least), default=0.0)
        if chance > LEAST_CHANCE or _worth_of(mended) < enough:
            continue
        # Pictures of another size are those of a camera of the table, where there is one of that size.
        return better_explained(view, WrongCamera().find(view), replace(finding, chance=chance))
    return None


def better_explained(view: View, wide: Finding | None, odd: Finding | None) -> Finding | None:
    """Return which of two findings lets all rays agree better: one of any images, or that of an odd group."""
    if wide is None or odd is None:
        return wide or odd
    of_wide, of_odd = (agreement_after(view, each.fix) for each in (wide, odd) if each.fix is not None)
    return wide if of_wide > (1.0 - TIE) * of_odd else odd


def spoils_a_group(view: View, fix: Fix) -> bool:
    """Return whether a fix makes the rays of a camera or a pass agree worse: what it puts right may not be wrong there.

    What is wrong with one camera only makes all rays together agree better where it is put right in every camera, too.
    Of a camera that sees little this is never sure.
    """

    def loss(each: View) -> float:
        after = measure_reading(fix(each.stretches.dataset), each.stretches, each.gate_px, fix)
        return 1.0 - float(after.gain.sum()) / max(float(each.agreement.gain.sum()), _LEAST_PRODUCT)

    return any(loss(group.alone(view)) > LEAST_RISE for group in groups_of(view.dataset))


def _worth_of(view: View) -> float:
    """Return how much better a detection agrees with others than by chance."""
    return float(view.agreement.gain.sum() - view.chance.gain.sum()) / max(view.agreement.detections, 1)


class _LikeAnother(Convention):
    """A convention that has other readings, for a group, than the one that it is called like."""

    def __init__(self, convention: Convention, group: Group) -> None:
        self._convention, self._group = convention, group
        self.name, self.what, self.do = convention.name, convention.what, convention.do  # type: ignore[misc]
        self.is_guess, self.least_times = convention.is_guess, convention.least_times  # type: ignore[misc]
        self.explained_by = convention.explained_by  # type: ignore[misc]
        self.is_of_boxes, self.kind = convention.is_of_boxes, convention.kind  # type: ignore[misc]


class _OfOneGroup(_LikeAnother):
    """A convention with those of its readings that change nothing but one group."""

    def __init__(self, convention: Convention, group: Group) -> None:
        super().__init__(convention, group)
        self.refined = convention.refined  # type: ignore[method-assign]

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield those."""
        for how, fix in self._convention.readings(dataset):
            if is_of_one_group(fix(dataset), dataset, self._group):
                yield how, fix


class AmongOthers(_LikeAnother):
    """The readings of one group, in a dataset that has all other groups, too."""

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield them with what they make of the whole dataset."""
        for how, fix in self._convention.readings(self._group.part(dataset)):
            yield how, OfGroup(self._group, fix)

    def refined(self, view: View, how: str, fix: Fix) -> tuple[str, Fix]:
        """Return the reading that rays of the group agree with best."""
        assert isinstance(fix, OfGroup)
        how, own = self._convention.refined(self._group.alone(view), how, fix.own)
        return how, OfGroup(self._group, own)


def _rivals(readings: Sequence[Reading]) -> tuple[str, ...]:
    """Return readings that stand the cameras up by more than a chance of all that was tried, if rays do not object."""
    given = readings[0]
    if given.is_upright:
        return ()
    return tuple(
        reading.how
        for reading in readings[1:]
        if not reading.is_guess
        and _by_attitude(reading) * reading.tests < _SUSPICIOUS
        and _compare_readings(given, reading).chance * reading.tests > LEAST_CHANCE
    )


def try_readings(
    view: View, conventions: Sequence[Convention], progress: Progress, group: Group | None = None
) -> list[Reading]:
    """Return the data as given and read in every way."""
    sample = view.stretches

    def part(dataset: Dataset) -> Dataset:
        return dataset if group is None else group.part(dataset)

    possible = [convention for convention in conventions if not convention.explained_by & view.known]
    of_each = [(convention, list(convention.readings(sample.dataset))) for convention in possible]
    of_kind: dict[str, int] = {}
    for convention, found in of_each:
        kind = convention.kind or convention.name
        of_kind[kind] = max(of_kind.get(kind, 0), len(found))  # To rays they are the same readings.
    shares = sum(bool(number) for number in of_kind.values())
    tried = [
        (convention, how, fix, shares * of_kind[convention.kind or convention.name])
        for convention, found in of_each
        for how, fix in found
    ]
    stands = uprightness(part(view.dataset))
    # An axis of a frame that others stand in is not its up.
    is_along_axis = _is_along_axis(view.dataset) if group is None else view.uprightness <= _LEAST_UPRIGHT
    given = Reading(None, "as given", None, view.agreement, stands, is_along_axis)
    readings = [given]
    # One camera's part in how all rays meet is too small to tell by a few stretches.
    stays = [True] * len(tried) if group else which_lead(view, given, [fix for _, _, fix, _ in tried], progress)
    for convention, how, fix, tests in itertools.compress(tried, stays):
        other = fix(sample.dataset)
        agreement = measure_reading(other, sample, view.gate_px, fix)
        readings.append(Reading(convention, how, fix, agreement, uprightness(part(other)), tests=tests))
    progress("trying other conventions", len(tried), len(tried))
    return readings


def which_lead(view: View, given: Reading, fixes: Sequence[Fix], progress: Progress) -> list[bool]:
    """Return which of the ways to read the data are worth a look at all stretches: a few refute most of them.

    Out is what agrees less than half as well as the best, chance taken off both; if the data may be right as given,
    what suits one camera about as well stays, too. All stay where a few stretches do not say that rays meet at all, and
    where the cameras lie though their rays may be right: then it counts which readings rays cannot refute.
    """
    heat = view.stretches.every(HEAT)
    if heat.places < LEAST_IN_HEAT:
        return [True] * len(fixes)
    cameras = [each for each in groups_of(view.dataset) if each.pass_name is None]
    as_given, by_chance = (
        _gains_by_camera(each, view.stretches, cameras)[:, ::HEAT] for each in (view.agreement, view.chance)
    )
    gains = [as_given]
    for number, fix in enumerate(fixes):
        progress("trying other conventions", number, len(fixes))
        gains.append(_gains_by_camera(measure_reading(fix(heat.dataset), heat, view.gate_px, fix), heat, cameras))
    best = max(gains, key=lambda each: float(each[0].sum()))
    beyond_chance = np.stack([(each - by_chance).sum(axis=1) for each in gains])
    leads = beyond_chance[:, 0] >= FAR_WORSE * beyond_chance[:, 0].max()
    if compare(best[0], by_chance[0]).chance > _FROM_RAYS or (leads[0] and not given.is_upright):
        return [True] * len(fixes)
    if leads[0]:
        leads |= (beyond_chance[:, 1:] >= FAR_WORSE * beyond_chance[0, 1:]).any(axis=1)
    return [bool(each) for each in leads[1:]]


def _gains_by_camera(agreement: Agreement, sample: Sample, cameras: Sequence[Group]) -> Floats:
    """Return the gains (1 + cameras, places) of all images of a sample, and of those of each camera."""
    masks = [np.ones(len(sample.image_row), np.bool_), *(each.images_of(sample.dataset) for each in cameras)]
    return np.stack([agreement.gain_of_images(sample.place_of_image, mine) for mine in masks])


def measure_reading(dataset: Dataset, sample: Sample, gate_px: float, fix: Fix | None) -> Agreement:
    """Return how well the rays of a sample agree, read so."""
    # Where pixels become larger, so do their errors.
    return agreement_on(sample, dataset, gate_px * getattr(fix, "gate_factor", 1.0))


def finding_of_contest(view: View, readings: Sequence[Reading], top: Reading) -> Finding | None:
    """Return the finding of the reading at the top, None where it is no better than the data as given."""
    given = readings[0]
    alike = [r for r in readings if _chance(top, r, given) * top.tests > LEAST_CHANCE]
    everywhere = {id(reading): _everywhere(view, reading) for reading in alike}
    total = {id(reading): sum(float(each.gain.sum()) for each in everywhere[id(reading)]) for reading in alike}
    if len(alike) > 1:
        best = max(alike, key=lambda reading: total[id(reading)])
        alike = [r for r in alike if _chance(best, r, given, everywhere) * best.tests > LEAST_CHANCE]
    if given in alike:
        return None
    alike = [reading for reading in alike if reading.is_upright] or alike
    if not given.is_upright:  # What was measured may well stand: nothing need be given up for a guess.
        alike = [reading for reading in alike if not reading.is_guess] or alike
    most = max(total[id(reading)] for reading in alike)
    chosen = next(reading for reading in alike if total[id(reading)] > (1.0 - TIE) * most)
    assert chosen.convention is not None
    everywhere[id(given)] = _everywhere(view, given)
    assert chosen.fix is not None
    how, fix = chosen.convention.refined(view, chosen.how, chosen.fix)
    comparison = _compare_readings(chosen, given, everywhere)
    # What the stretches alone have decided, places that few passes meet do not take back.
    chance = min(_chance(chosen, given, given), _chance(chosen, given, given, everywhere)) * chosen.tests
    if chance > LEAST_CHANCE:
        return None
    return _told(view, chosen, given, how, fix, comparison, chance)


def _runner_up(view: View, readings: Sequence[Reading]) -> Finding | None:
    """Return the reading that rays agree with best, if better than as given and no guess."""
    given = readings[0]
    best = max((each for each in readings if not each.is_guess), key=lambda each: each.total)
    if best.fix is None:
        return None
    comparison = _compare_readings(best, given)
    return _told(view, best, given, best.how, best.fix, comparison, min(1.0, comparison.chance * best.tests))


def better_read(view: View, finding: Finding, reading: Finding) -> Finding:
    """Return a finding about one pass, or the reading of all data with which all rays agree better still.

    The finding says beyond chance that data as given are wrong; both readings of them were there to be found.
    """
    assert finding.mends is not None
    assert reading.fix is not None
    read, corrected = (gains_of_all(view, fix(view.dataset)) for fix in (reading.fix, finding.mends))
    if compare(read, corrected).chance > AGAINST:
        return finding
    return replace(reading, chance=finding.chance)


def _told(
    view: View, chosen: Reading, given: Reading, how: str, fix: Fix, comparison: Comparison, chance: float
) -> Finding:
    assert chosen.convention is not None
    group = fix.group if isinstance(fix, OfGroup) else None
    return Finding(
        fault=chosen.convention.name,
        what=chosen.convention.what if group is None else f"Only {group.text}: {chosen.convention.what}",
        why=f"Read as {how}, {chosen.agreement.share:.0%} of {chosen.agreement.detections} detections meet "
        f"others, with an agreement of {chosen.total:.0f}; as given {given.agreement.share:.0%} and {given.total:.0f}, "
        f"by chance {view.chance.share:.0%} and {view.chance.gain.sum():.0f} ({comparison.places} {comparison.of}).",
        do=chosen.convention.do,
        chance=chance,
        figures={
            **({} if group is None else {"of": group.text}),
            "reading": how,
            "agreement_as_given": round(given.total, 1),
            "agreement_if_read_so": round(chosen.total, 1),
            "agreement_by_chance": round(float(view.chance.gain.sum()), 1),
            **comparison.to_json(),
        },
        fix=fix,
        of=None if group is None else group.text,
    )


def _is_small_turn(view: View, total: float, group: Group | None) -> bool:
    """Return whether rays agree as well if cameras are turned a little, which is a smaller mistake than any other.

    Cameras that look too low, read upside down, look too high: up to half as much.
    """
    sample, turns = view.stretches, (turn for turn in PARAMETERS if turn.name in ("pitch", "yaw"))
    tried = (_turned(turn, way * angle) for turn in turns for angle in SMALL_TURNS_RAD for way in (-1, 1))
    fixes: Iterator[Fix] = tried if group is None else (OfGroup(group, each) for each in tried)
    return any(agreement_on(sample, fix(sample.dataset), view.gate_px).gain.sum() >= total for fix in fixes)


def _turned(turn: Parameter, angle_rad: float) -> Fix:
    return lambda dataset: turn.change(dataset, angle_rad)


def suspicion_of(given: Reading, top: Reading) -> str | None:
    """Return in words that the data may have to be read otherwise, None where nothing points to it."""
    comparison = _compare_readings(top, given)
    if top.convention is None or joined_with_attitude(comparison.chance, top, given) * top.tests > _SUSPICIOUS:
        return None
    return (
        f"Read as {top.how}, {top.agreement.share:.0%} of {top.agreement.detections} detections meet others, as given "
        f"{given.agreement.share:.0%}. The data are too few to be sure ({comparison.places} {comparison.of}), but it "
        f"may be so: {top.convention.what}"
    )


def _chance(
    better: Reading, worse: Reading, given: Reading, everywhere: Mapping[int, Sequence[Agreement]] | None = None
) -> float:
    """Return how likely one reading would be so much better than another, or than the given one, by chance."""
    by_rays = _compare_readings(better, worse, everywhere).chance
    return joined_with_attitude(by_rays, better, given) if worse is given else by_rays


def joined_with_attitude(by_rays: float, reading: Reading, given: Reading) -> float:
    """Join the chance by rays with that of cameras that stand upright, by Fisher's method."""
    if given.is_upright or given.is_along_axis or not reading.is_upright or by_rays > _FROM_RAYS:
        return by_rays
    product = by_rays * _by_attitude(reading)
    return min(by_rays, product * (1.0 - math.log(max(product, _LEAST_PRODUCT))))


def _is_along_axis(dataset: Dataset) -> bool:
    up = -rotation_matrices(dataset.images)[:, 1].mean(axis=0)
    return bool(np.abs(up).max() > _ALONG_AXIS)


def _by_attitude(reading: Reading) -> float:
    """Return the share of cameras, mounted anyhow, that stand as upright."""
    return (1.0 - min(reading.uprightness, 1.0)) / 2.0


def _compare_readings(
    better: Reading, worse: Reading, everywhere: Mapping[int, Sequence[Agreement]] | None = None
) -> Comparison:
    both = [[each.agreement] if everywhere is None else everywhere[id(each)] for each in (better, worse)]
    return compare_on_samples(*both, may_split=not (better.is_guess or worse.is_guess))


def compare_on_samples(
    better: Sequence[Agreement], worse: Sequence[Agreement], *, may_split: bool = True
) -> Comparison:
    """Compare what two readings come to on the same samples: by places, or where these are few by objects."""
    by_places = compare(*(np.concatenate([each.gain for each in side]) for side in (better, worse)))
    if not may_split or by_places.places >= _ENOUGH_PLACES:
        return by_places
    return compare_objects(better, worse)


def _everywhere(view: View, reading: Reading) -> list[Agreement]:
    """Return how well rays agree on the stretches and at the places."""
    if reading.fix is None:
        return [reading.agreement, view.agreement_at_places]
    # Places have parts of passes: what depends on the image before or after needs the whole.
    read = view.places.of(reading.fix(view.dataset))
    return [reading.agreement, measure_reading(read, view.places, view.gate_px, reading.fix)]
