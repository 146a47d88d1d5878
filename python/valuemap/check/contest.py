"""The contest of conventions: all ways to read the data are tried on one sample, and the best is named.

Data as given win unless another reading makes the rays agree better by more than the scatter between places explains.
Several readings may be as good as the best on single stretches of road (on a straight drive a mirrored world agrees as
well); places that several passes meet decide between them, then whether cameras stand upright, then the order of the
registry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valuemap.check.agreement import Agreement, compare, measure_agreement
from valuemap.check.fault import LEAST_CHANCE, WIDER_GATE, Convention, Finding, Fix, View, uprightness
from valuemap.check.sample import Sample
from valuemap.dataset import Dataset
from valuemap.progress import Progress, silent
from valuemap.tables import Floats

_LEAST_UPRIGHT = 0.5
_SUSPICIOUS = 0.05
"""What good data would give with a probability above this, all that was tried counted, is not even told."""
_TIE = 1e-3
"""Gains as close as this are the same: readings that differ in the last digits only."""


@dataclass(frozen=True, eq=False)
class _Reading:
    """One way to read the data (none: as given) and what came of it on the stretches."""

    convention: Convention | None
    how: str
    fix: Fix | None
    agreement: Agreement
    is_upright: bool

    @property
    def total(self) -> float:
        """The gain of all places."""
        return float(self.agreement.gain.sum())


def hold_contest(
    view: View, conventions: Sequence[Convention], progress: Progress = silent
) -> tuple[Finding | None, float | None, str | None]:
    """Return what is wrong with the conventions, if anything, the share of the gate that tells, and what is suspected.

    The gate is widened where rays, read in any way, meet no better than by chance; None where a wide one tells
    nothing either. A reading that is better than the given one, but by less than so few places can prove, is told.
    """
    for gate_share in (view.gate_share, view.gate_share * WIDER_GATE):
        at_gate = view if gate_share == view.gate_share else View(view.dataset, gate_share=gate_share)
        readings = _try_all(at_gate, conventions, progress)
        top = max(readings, key=lambda reading: reading.total)
        tests = len(readings)
        if compare(top.agreement.gain, at_gate.chance.gain).chance * tests > LEAST_CHANCE:
            continue
        finding = _judge(at_gate, readings, top)
        return finding, gate_share, _suspicion(readings[0], top, tests) if finding is None else None
    return None, None, None


def _try_all(view: View, conventions: Sequence[Convention], progress: Progress) -> list[_Reading]:
    sample = view.stretches
    tried = [(convention, how, fix) for convention in conventions for how, fix in convention.readings(sample.dataset)]
    readings = [_Reading(None, "as given", None, view.agreement, view.uprightness > _LEAST_UPRIGHT)]
    for number, (convention, how, fix) in enumerate(tried):
        progress("trying other conventions", number, len(tried))
        other = fix(sample.dataset)
        agreement = _measure(other, sample, view.gate_px, fix)
        readings.append(_Reading(convention, how, fix, agreement, uprightness(other) > _LEAST_UPRIGHT))
    progress("trying other conventions", len(tried), len(tried))
    return readings


def _measure(dataset: Dataset, sample: Sample, gate_px: float, fix: Fix | None) -> Agreement:
    # Where pixels become larger, so do their errors.
    return measure_agreement(dataset, sample.place_of_image, gate_px * getattr(fix, "gate_factor", 1.0))


def _judge(view: View, readings: Sequence[_Reading], top: _Reading) -> Finding | None:
    tests, given = len(readings), readings[0]
    alike = [r for r in readings if compare(top.agreement.gain, r.agreement.gain).chance * tests > LEAST_CHANCE]
    if len(alike) > 1:
        alike = _judge_by_places(view, alike, tests)
    if given in alike:
        return None
    alike = [reading for reading in alike if reading.is_upright] or alike
    best = max(float(_gains(view, reading).sum()) for reading in alike)
    chosen = next(reading for reading in alike if float(_gains(view, reading).sum()) > (1.0 - _TIE) * best)
    assert chosen.convention is not None
    gain, gain_given = _gains(view, chosen), _gains(view, given)
    comparison = compare(gain, gain_given)
    return Finding(
        fault=chosen.convention.name,
        what=chosen.convention.what,
        why=f"Read as {chosen.how}, {chosen.agreement.share:.0%} of {chosen.agreement.detections} detections meet "
        f"others, with an agreement of {chosen.total:.0f}; as given {given.agreement.share:.0%} and {given.total:.0f}, "
        f"by chance {view.chance.share:.0%} and {view.chance.gain.sum():.0f} ({comparison.places} places).",
        do=chosen.convention.do,
        chance=min(comparison.chance * tests, 1.0),
        figures={
            "reading": chosen.how,
            "agreement_as_given": round(given.total, 1),
            "agreement_if_read_so": round(chosen.total, 1),
            "agreement_by_chance": round(float(view.chance.gain.sum()), 1),
            **comparison.to_json(),
        },
        fix=chosen.fix,
    )


def _suspicion(given: _Reading, top: _Reading, tests: int) -> str | None:
    comparison = compare(top.agreement.gain, given.agreement.gain)
    if top.convention is None or comparison.chance * tests > _SUSPICIOUS:
        return None
    return (
        f"Read as {top.how}, {top.agreement.share:.0%} of {top.agreement.detections} detections meet others, as given "
        f"{given.agreement.share:.0%}. The data are too few to be sure ({comparison.places} places), but it may "
        f"be so: {top.convention.what}"
    )


def _judge_by_places(view: View, alike: Sequence[_Reading], tests: int) -> list[_Reading]:
    """Return those of readings that no other one beats where several passes meet."""
    gains = [_gains(view, reading) for reading in alike]
    best = gains[int(np.argmax([gain.sum() for gain in gains]))]
    return [r for r, gain in zip(alike, gains, strict=True) if compare(best, gain).chance * tests > LEAST_CHANCE]


def _gains(view: View, reading: _Reading) -> Floats:
    """Return the gains on the stretches and at the places."""
    # Places have parts of passes: what depends on the image before or after needs the whole.
    dataset = view.places.dataset if reading.fix is None else view.places.of(reading.fix(view.dataset))
    at_places = _measure(dataset, view.places, view.gate_px, reading.fix)
    return np.concatenate([reading.agreement.gain, at_places.gain])
