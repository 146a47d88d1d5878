"""What the names of a rig's images tell of the order of its exposures: all but the parts that name the cameras."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats, Ints, RowsByNumber
from valuemap.drives.names import NameParts, cut_name
from valuemap.drives.runs import numbered_by_first
from valuemap.drives.shots import Shots

_FEW_SHARE = 0.1
"""Where fewer exposures than this share have several images of one camera, these were put together by mistake."""


def name_exposures(shots: Shots, rows: Ints, exposure: Ints) -> NameParts:
    """Return what names tell of the exposures (M) of one vehicle, of which each of its shots (rows, N) is.

    A part that is the same in all names of each camera tells no order and is left out. Of the rest each exposure has
    what its fullest camera says. Cameras may count each on its own: their last numbers are shifted by what these
    usually differ by in shared exposures.
    """
    names = shots.names(rows)
    camera = _tell_cameras(shots.camera[rows], exposure, NameParts(names))
    parts = NameParts(_without_cameras(names, camera))
    last = parts.varying()[-1:]
    counted = last[0] if last and last[0] % 2 == 1 else None
    number = np.zeros(len(rows)) if counted is None else np.nan_to_num(parts.numbers[counted], nan=-1.0)
    leader, number = _count_together(number, camera, exposure)
    told = parts.take(leader)
    if counted is not None:
        told.numbers[counted] = number
        told.codes[counted] = np.unique(number, return_inverse=True)[1]
    return told


def _tell_cameras(camera: Ints, exposure: Ints, parts: NameParts) -> Ints:
    """Return the camera (N) of shots; several of one exposure are told apart by the parts with the fewest values."""
    camera = numbered_by_first(camera)
    if 2 * (int(camera.max()) + 1) > len(camera):  # A camera for each image tells no cameras apart.
        camera = np.zeros(len(camera), np.int64)
    for codes in sorted(parts.codes, key=lambda codes: len(np.unique(codes))):
        at_once = numbered_by_first(exposure * (int(camera.max()) + 1) + camera)
        _, first, count = np.unique(at_once, return_index=True, return_counts=True)
        if np.sum(count > 1) <= _FEW_SHARE * len(np.unique(exposure)):
            break
        if np.any(codes != codes[first][at_once]):
            camera = numbered_by_first(camera * (int(codes.max()) + 1) + codes)
    return camera


def _without_cameras(names: list[str], camera: Ints) -> list[str]:
    """Return names (N) without the parts that are the same in all of each camera, among those of as many parts."""
    cells = [cut_name(name) for name in names]
    length = np.array([len(cell) for cell in cells])
    left = [""] * len(names)
    for number in np.unique(length):
        rows = np.flatnonzero(length == number)
        codes = NameParts([names[row] for row in rows]).codes
        group = numbered_by_first(camera[rows])
        first = np.unique(group, return_index=True)[1][group]
        kept = [column for column in range(number) if np.any(codes[column] != codes[column][first])]
        for row in rows:
            left[row] = " ".join(cells[row][column] for column in kept)
    return left


def _count_together(number: Floats, camera: Ints, exposure: Ints) -> tuple[Ints, Floats]:
    """Return the shot of the fullest camera of each exposure (M), and its number as the fullest of all would count."""
    exposures = int(exposure.max()) + 1
    leader, known = np.full(exposures, -1), np.zeros(exposures)
    shots_of = RowsByNumber.of(camera, int(camera.max()) + 1).each()
    for shots in sorted(shots_of, key=len, reverse=True):
        at = exposure[shots]
        shared = leader[at] >= 0
        own = number[shots]
        if shared.any():
            own = own - np.median((own - known[at])[shared])
        new = np.flatnonzero(~shared)[::-1]  # The last assignment stays: that of the first.
        leader[at[new]], known[at[new]] = shots[new], own[new]
    return leader, known
