"""Faults of one pass that is off by some metres: to a side, up or down, or along its drive."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers
from valuemap.check.along_drives import moved_along
from valuemap.check.fault import (
    Fault,
    Finding,
    Stage,
    View,
    with_centers,
)
from valuemap.check.pass_shifts import PassShift, worst_pass
from valuemap.check.which_pass import which_of_two
from valuemap.dataset import Dataset

OF_ITS_CAMERA = frozenset({"focal_length", "camera_tilt", "camera_yaw"})
"""Errors of a camera that no other pass has put what its pass sees elsewhere, as far away as most of it is."""


class PassOffset(Fault):
    """A pass that is off by some metres."""

    name: ClassVar[str] = "pass_offset"
    stage: ClassVar[Stage] = "fine"
    rivals: ClassVar[frozenset[str]] = OF_ITS_CAMERA
    may_be_reading: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """Take the offset of the pass that is farthest from good."""
        shift = worst_pass(view)
        if shift is None or shift.is_along or _is_vertical(view, shift.offset_m):
            return None
        return _shift_finding(
            self.name, shift, f"Pass {shift.pass_name} is off by {np.linalg.norm(shift.offset_m):.2f} m.",
            "Align it with the others (another datum, another antenna, no correction data?).",
        )  # fmt: skip


class PassTimeShift(Fault):
    """A pass whose poses are some time off its pictures."""

    name: ClassVar[str] = "pass_time_shift"
    stage: ClassVar[Stage] = "fine"
    rivals: ClassVar[frozenset[str]] = OF_ITS_CAMERA
    may_be_reading: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """Take the shift along the drive of the pass that is farthest from good."""
        shift = worst_pass(view)
        if shift is None or not shift.is_along:
            return None
        images = shift.offset_m[0] / view.step_m
        return _shift_finding(self.name, shift,
            f"The poses of pass {shift.pass_name} are {abs(shift.offset_m[0]):.2f} m along the road "
            f"({abs(images):.1f} images) {'behind' if images > 0 else 'ahead of'} its pictures.",
            "Correct the clock of this pass (leap seconds, exposure or trigger delay).",
        )  # fmt: skip


def find_height_of_pass(view: View, fault: str) -> Finding | None:
    """Take the offset of the pass that is farthest from good, if it is up or down."""
    shift = worst_pass(view)
    if shift is None or shift.is_along or not _is_vertical(view, shift.offset_m):
        return None
    up_m = float(shift.offset_m @ np.array(view.dataset.frame.up))
    return _shift_finding(fault, shift,
        f"The camera of pass {shift.pass_name} is {abs(up_m):.2f} m too {'low' if up_m > 0 else 'high'}.",
        "Correct the height of its camera above the ground, or use one datum of heights for all passes.",
    )  # fmt: skip


def _is_vertical(view: View, offset_m: Floats) -> bool:
    return abs(float(offset_m @ np.array(view.dataset.frame.up))) > 0.9 * float(np.linalg.norm(offset_m))


def _shift_finding(fault: str, shift: PassShift, what: str, do: str) -> Finding:
    frame = "forward, left, up" if shift.is_along else "x, y, z"
    numbers = ", ".join(f"{part:.2f}" for part in shift.offset_m)
    if shift.points:
        why = (
            f"Moved by {numbers} m ({frame}), {shift.points} things that it sees are where others see such; by no "
            "other shift nearly as many are."
        )
        figures: dict[str, Any] = {"points_if_moved": shift.points}
    elif shift.seam is None:
        why = (
            f"Moved by {numbers} m ({frame}), what it sees is where other passes see it: the agreement of its rays "
            f"with the others' points rises from {shift.gain_without:.0f} to {shift.gain:.0f}."
        )
        figures = {
            "agreement_as_given": round(shift.gain_without, 1),
            "agreement_if_moved": round(shift.gain, 1),
        }
    else:
        jump_m = float(np.linalg.norm(shift.seam.jump_m))
        why = (
            f"By its times pass {shift.seam.after} goes on where {shift.seam.before} ends, but the poses jump by "
            f"{jump_m:.2f} m there; from image to image within passes it is less than {shift.seam.usual_m:.2f} m. "
            f"Moved by {numbers} m ({frame}) they do not."
        )
        figures = {"jump_m": round(jump_m, 3), "usual_jump_m": round(shift.seam.usual_m, 3)}
    other = shift.other
    if other is not None:
        apart_m = float(np.linalg.norm(shift.offset_m))
        by = f"{numbers} m" if not other.is_along else f"{shift.offset_m[0]:.2f} m along its drive"
        or_by = (
            f"{other.offset_m[0]:.2f} m along its drive"
            if other.is_along
            else ", ".join(f"{part:.2f}" for part in other.offset_m) + " m"
        )
        what = which_of_two(shift.pass_name, other.pass_name, f"{apart_m:.2f} m apart")
        do = (
            f"Find out which is right (by a third pass, by known points as truth), then move {shift.pass_name} by "
            f"{by}, or {other.pass_name} by {or_by}. {do}"
        )
        why += f" So it is if {other.pass_name} is moved by {or_by}."
    fix = _Realigned(shift)
    return Finding(
        fault=fault,
        what=what,
        why=why,
        do=do,
        chance=shift.chance,
        figures={
            **({} if other is None else {"or_pass": other.pass_name}),
            "pass": shift.pass_name,
            "shift_m": [round(float(part), 3) for part in shift.offset_m],
            "frame": frame,
            **figures,
            "passes_looked_at": shift.passes,
        },
        fix=fix if other is None else None,
        trial=None if other is None else fix,
    )


class _Realigned:
    """One pass moved, in the world or along its own drive."""

    def __init__(self, shift: PassShift) -> None:
        self._shift = shift

    def __call__(self, dataset: Dataset) -> Dataset:
        center = camera_centers(dataset.images)
        is_moved: Bools = dataset.images.pass_id.codes == dataset.images.pass_id.code_of(self._shift.pass_name)
        offset_m = self._shift.offset_m
        moved = moved_along(dataset, offset_m[0]) if self._shift.is_along else center + offset_m
        return with_centers(dataset, np.where(is_moved[:, None], moved, center))
