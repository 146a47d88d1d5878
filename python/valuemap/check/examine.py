"""The check from end to end: what is wrong, stage by stage, each on data with all found before put right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from valuemap.check.clocks import better_by_clock
from valuemap.check.contest import better_explained, better_read, find_odd_group, hold_contest, spoils_a_group
from valuemap.check.fault import STAGES, WHICH_PASS, Fault, Finding, Fix, View, agreement_after
from valuemap.check.groups import find_in_groups
from valuemap.check.handedness import told_by_truth
from valuemap.check.loose import LEAST_TIMES, loose_of
from valuemap.check.meeting import unexplained_passes
from valuemap.check.others import find_by_others
from valuemap.check.projection import note_projection
from valuemap.check.prospects import describe_prospects
from valuemap.check.registry import CONVENTIONS, FAULTS
from valuemap.dataset import Dataset, expect_dataset
from valuemap.errors import InputError
from valuemap.progress import Progress, silent
from valuemap.tables import Images

_MOST_ROUNDS = 4
"""Of one stage: one fault may hide behind another, but not for ever."""
_MOST_TOLD = 4
_COMPLETES = {fault.name: fault.completes for fault in FAULTS}


@dataclass(frozen=True, eq=False)
class Examination:
    """What a check found, what the data can give, and the dataset with all that can be put right put right."""

    findings: tuple[Finding, ...]
    prospects: dict[str, Any]
    fixed: Dataset
    notes: tuple[str, ...] = field(default=())

    def to_json(self) -> dict[str, Any]:
        """Return everything but the dataset by name."""
        return {
            "findings": [finding.to_json() for finding in self.findings],
            "prospects": self.prospects,
            "notes": list(self.notes),
        }


def examine(dataset: Dataset, *, drives: Images | None = None, progress: Progress = silent) -> Examination:
    """Look for all known faults in a dataset.

    Parameters
    ----------
    dataset
        Posed images with detections. Nothing is asked of it but that its tables fit together.
    drives
        Images of whole passes, where the dataset is a part of another and has pieces of passes.
    progress
        Called as progress(what, done, total).

    Returns
    -------
    Examination
        Findings in the order in which they have to be put right. Same dataset, same findings.

    Raises
    ------
    InputError
        The dataset has no detections.
    """
    expect_dataset(dataset)
    if not len(dataset.detections):
        raise InputError(
            f"{dataset.name}: there are no detections in it",
            hint="find some with valuemap detect, or import them with the images",
        )
    findings: list[Finding] = []
    notes: list[str] = []
    fixed = dataset
    view, read = View(dataset, drives=drives), _Readings()
    for stage in STAGES:
        for _ in range(_MOST_ROUNDS):
            known = frozenset(name for finding in findings for name in _known_by(finding))
            view, gate_share = view.again(known=known, meets=read.meets, rivals=read.rivals), view.gate_share
            if stage == "conventions":
                read = _read_otherwise(view, progress)
                notes += read.notes
                gate_share = read.gate_share or gate_share
                found = [] if read.finding is None else [read.finding]
            else:
                found = find_in_stage(view, stage, progress, read.runner_up)
            findings += [each for each in found if not _is_rest(each, findings)]
            fixes: list[Fix] = [each.mends for each in found if each.mends is not None]
            for fix in fixes:
                dataset = fix(dataset)
            for each in found:
                fixed = fixed if each.fix is None else each.fix(fixed)
            if fixes and drives is not None:  # They put pieces of passes right, not these.
                drives = dataset.images[:0]
            if fixes or gate_share != view.gate_share:
                view = View(dataset, gate_share=gate_share, drives=drives)
            if not fixes:
                break
    left = (_note_passes_apart(view) if read.meets else None, note_projection(dataset))
    notes += [note for note in left if note is not None]
    if any(finding.trial is not None for finding in findings):
        view = View(fixed, gate_share=view.gate_share, drives=drives)
    return Examination(tuple(findings), describe_prospects(view), fixed, tuple(notes))


@dataclass(frozen=True, eq=False)
class _Readings:
    """What came of reading the data otherwise: what was found, what may be there instead, and what to say of it.

    `gate_share` is None where rays do not meet better than by chance (`meets`), or nothing was read yet.
    """

    meets: bool = True
    rivals: tuple[str, ...] = ()
    runner_up: Finding | None = None
    gate_share: float | None = None
    finding: Finding | None = None
    notes: tuple[str, ...] = ()


def _read_otherwise(view: View, progress: Progress) -> _Readings:
    """Read all data, then those of one camera or pass, in every other way, and see which way rays agree best with."""
    verdict = hold_contest(view, CONVENTIONS, progress)
    meets, finding = verdict.gate_share is not None, verdict.finding
    if meets and (finding is None or (finding.fix is not None and spoils_a_group(view, finding.fix))):
        odd = find_odd_group(view, CONVENTIONS, progress, verdict.suspects)
        finding = better_explained(view, finding, odd)
        finding = better_explained(view, finding, find_by_others(view, CONVENTIONS))
    finding = told_by_truth(view, better_by_clock(view, finding))
    notes = [] if verdict.suspicion is None else [verdict.suspicion]
    if not meets and finding is None:
        notes.append(
            "However the data are read, it cannot be told that rays meet better than by chance: too few "
            "detections show one object from several places, or the poses are no poses of these pictures."
        )
    rivals = verdict.rivals
    if rivals:
        told = [
            *rivals[:_MOST_TOLD],
            *(["otherwise"] if len(rivals) > _MOST_TOLD else []),
            "with the sky elsewhere",
        ]
        notes.append(
            f"As given the cameras do not stand upright (cosine {view.uprightness:.2f}). They would if the "
            f"data were read as {', or '.join(told)}, and the rays are too few to tell which."
        )
    return _Readings(meets, rivals, verdict.runner_up, verdict.gate_share, finding, tuple(notes))


def _note_passes_apart(view: View) -> str | None:
    """Say which passes see nothing where others do, although all that was found is put right; None if none."""
    misses = loose_of(view).misses(view.dataset)
    # Where poses are loose, what passes see is as far apart.
    near_m = max(view.step_m, 0.0 if misses is None else LEAST_TIMES * misses.distance_m)
    apart = unexplained_passes(view, near_m)
    if not apart:
        return None
    return (
        f"What {'pass' if len(apart) == 1 else 'passes'} {', '.join(apart[:_MOST_TOLD])}"
        f"{' and more' if len(apart) > _MOST_TOLD else ''} {'sees' if len(apart) == 1 else 'see'} is where others "
        "see such things no more often than by chance, and nothing that is looked for explains it: something else "
        "is wrong, or several things at once."
    )


def _known_by(finding: Finding) -> tuple[str, ...]:
    return (finding.fault,) if finding.trial is None else (finding.fault, WHICH_PASS)


def _is_rest(finding: Finding, before: Sequence[Finding]) -> bool:
    """Return whether a finding is what the fixes of earlier ones left of the same mistake."""
    completes = _COMPLETES.get(finding.fault, frozenset())
    return any(each.fault in completes and each.of in (None, finding.of) for each in before)


def find_in_stage(view: View, stage: str, progress: Progress, runner_up: Finding | None = None) -> list[Finding]:
    """Return the first fault of a stage that can be put right, and all before it that cannot.

    The `runner_up` is a reading of all data that may be there instead.
    """
    faults = [fault for fault in FAULTS if fault.stage == stage]
    found: list[Finding] = []
    for number, fault in enumerate(faults):
        progress(_WORK[stage], number, len(faults))
        if fault.name in view.known and stage != "fine" and not fault.is_of_rows:
            continue
        if fault.explained_by & (view.known | {finding.fault for finding in found}):
            continue
        finding = fault.find(view)
        if finding is None and fault.is_of_rows:
            finding = find_in_groups(view, fault)
        if finding is not None and finding.mends is not None and fault.rivals:
            finding = _best_of(view, finding, [each for each in faults if each.name in fault.rivals])
        if finding is not None and finding.mends is not None and fault.may_be_reading and runner_up is not None:
            finding = better_read(view, finding, runner_up)
        if finding is not None and not (finding.mends is None and finding.fault in view.known):
            found.append(finding)
            if finding.mends is not None:
                break
    progress(_WORK[stage], len(faults), len(faults))
    return found


def _best_of(view: View, finding: Finding, rivals: Sequence[Fault]) -> Finding:
    """Return the finding, or that of a rival whose fix lets all rays agree better."""
    others = [other for rival in rivals if (other := rival.find(view)) is not None and other.mends is not None]

    def agreement(of: Finding) -> float:
        assert of.mends is not None
        return agreement_after(view, of.mends)

    return max([finding, *others], key=agreement) if others else finding


_WORK = {
    "tables": "looking at the rows",
    "positions": "looking at the positions",
    "fine": "looking for small errors",
    "results": "looking at what comes out",
}
