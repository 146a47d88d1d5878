"""Positions between seldom fixes on straight lines: the path is bent at the fixes alone, and cameras turn between them.

No car goes straight ahead and all at once some other way. Its cameras tell how it went: along a curve of which the
positions are the chords. Where streets are straight the positions are right, and nothing is said of these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from valuemap.arrays import Bools, Floats, Ints, runs
from valuemap.cameras import camera_centers
from valuemap.check.agreement import compare
from valuemap.check.fault import AGAINST, Fault, Finding, Stage, View, gains_of_all, keep_rows, with_centers
from valuemap.check.headings import headings, wrapped
from valuemap.check.sample import FASTER, drive_of_camera, order_by_camera
from valuemap.dataset import Dataset

_STRAIGHT, _EXACT = 0.01, 1e-6
"""Shares of the median step. Who is off the line through its neighbours by less than the first, may be on it."""
_ROUNDED = 5.0
"""Most images between fixes are off their line by what positions were rounded to; a fix is by so many times as much."""
_LEAST_BETWEEN = 3
"""Images on a line at each side of a fix: of fewer the error is small."""
_KINK_RAD = np.radians(10.0)
_TURNS_WITH_IT = 0.5
"""The share of a kink that a camera at least turns by, from the image before it to that after it, if it is driven."""
_LEAST_KINKS = 8
_MOSTLY = 0.8
_CANNOT_GO_RAD = np.radians(60.0)
"""What is farther from where cameras look was not driven: the car went some other way between the fixes."""


class InterpolatedPositions(Fault):
    """Positions on straight lines between fixes that are several images apart, around corners too."""

    name: ClassVar[str] = "interpolated_positions"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """See whether paths are bent between straight lines only, where cameras do not turn; rays must bear it out."""
        paths = _paths(view.dataset)
        kinks, followed = np.sum([(0, 0), *(path.kinks() for path in paths)], axis=0).tolist()
        if kinks < _LEAST_KINKS or kinks - followed < _MOSTLY * kinks:
            return None
        moved, can_go = _on_curves(view.dataset)
        rise = compare(gains_of_all(view, moved), gains_of_all(view, view.dataset))
        if rise.difference <= 0.0:
            return None
        has_fix = rise.chance <= AGAINST
        between = float(np.median(np.concatenate([np.diff(path.fixes) for path in paths])))
        left_out = int(np.sum(~can_go))
        return Finding(
            fault=self.name,
            what=f"The positions lie on straight lines between fixes that are some {between:.0f} images apart.",
            why=f"The path turns by more than {np.degrees(_KINK_RAD):.0f} degrees at one image between straight lines "
            f"at {kinks} places, and the cameras turn by less than half as much at {kinks - followed} of these. "
            f"On curves along which the cameras look, the agreement of all rays rises by {rise.difference:.0f}.",
            do="Take more of the fixes, or the positions of an inertial sensor."
            + (" The fix puts images on curves through the fixes that go where the cameras look" if has_fix else "")
            + (f", and leaves out {left_out} where no car can have gone so." if has_fix and left_out else ""),
            figures={"kinks": kinks, "images_between": between, "left_out": left_out, **rise.to_json()},
            fix=_along_curves if has_fix else None,
        )


@dataclass(frozen=True, eq=False)
class _WayOfCamera:
    """The way of a camera in one pass: rows of images that moved, where they are on the ground, and where they look."""

    row: Ints
    ground_m: Floats
    """East and north (N, 2)."""
    azimuth: Floats
    """Of the car, as the camera tells it (N), clockwise from north."""
    fixes: Ints
    """Which images (of N) are fixes: the ends, and where the path is bent."""

    @property
    def length_m(self) -> Floats:
        """Of the lines between the fixes."""
        return np.asarray(np.linalg.norm(np.diff(self.ground_m[self.fixes], axis=0), axis=1))

    def kinks(self) -> tuple[int, int]:
        """Return at how many fixes between straight lines the path is bent, and at how many of these cameras turn."""
        inner = self.fixes[1:-1]
        is_between_lines = np.minimum(inner - self.fixes[:-2], self.fixes[2:] - inner) > _LEAST_BETWEEN
        at = inner[is_between_lines]
        chord = _azimuths(np.diff(self.ground_m[self.fixes], axis=0))
        kink = wrapped(np.diff(chord))[is_between_lines]
        turn = wrapped(self.azimuth[at + 1] - self.azimuth[at - 1])
        is_kink = np.abs(kink) > _KINK_RAD
        return int(is_kink.sum()), int(np.sum(is_kink & (turn * np.sign(kink) > _TURNS_WITH_IT * np.abs(kink))))

    def on_curves(self) -> tuple[Floats, Bools]:
        """Return where images (N, 2) are on curves through the fixes along which cameras look, and if a car can go so.

        A cubic with tangents as long as those that fit an arc.
        """
        line = np.clip(np.searchsorted(self.fixes, np.arange(len(self.row)), side="right") - 1, 0, len(self.fixes) - 2)
        first, last = self.fixes[line], self.fixes[line + 1]
        begin, end = self.ground_m[first], self.ground_m[last]
        chord = end - begin
        length_m = np.maximum(np.linalg.norm(chord, axis=1), 1e-9)
        share = np.sum((self.ground_m - begin) * chord, axis=1) / length_m**2
        off = np.stack([np.abs(wrapped(self.azimuth[each] - _azimuths(chord))) for each in (first, last)])
        turn = wrapped(self.azimuth[last] - self.azimuth[first])
        tangent_m = (length_m / np.cos(turn / 4.0) ** 2)[:, None]
        ahead = np.stack([np.sin(self.azimuth), np.cos(self.azimuth)], axis=1)
        s = share[:, None]
        curve = (
            (2.0 * s**3 - 3.0 * s**2 + 1.0) * begin
            + (s**3 - 2.0 * s**2 + s) * tangent_m * ahead[first]
            + (3.0 * s**2 - 2.0 * s**3) * end
            + (s**3 - s**2) * tangent_m * ahead[last]
        )
        is_fix = np.isin(np.arange(len(self.row)), self.fixes)
        most_m = FASTER * float(np.median(self.length_m / np.diff(self.fixes)))
        is_driven = (off.max(axis=0) < _CANNOT_GO_RAD) & (length_m / (last - first) < most_m)
        return np.where(is_fix[:, None], self.ground_m, curve), is_fix | is_driven


def _paths(dataset: Dataset) -> list[_WayOfCamera]:
    """Return the ways of cameras in passes that are mostly on lines, without images at the place of the one before."""
    images = dataset.images
    east, north = dataset.frame.east_north()
    center, azimuth = camera_centers(images), headings(dataset)[0]
    order = order_by_camera(images)
    paths = []
    for rows in runs(order, drive_of_camera(images)[order]):
        ground = np.stack([center[rows] @ east, center[rows] @ north], axis=1)
        moved = np.append(True, np.linalg.norm(np.diff(ground, axis=0), axis=1) > _EXACT)
        row, ground = rows[moved], ground[moved]
        if len(row) < 2 * _LEAST_BETWEEN:
            continue
        way = np.diff(ground, axis=0)
        across = np.abs(way[:-1, 0] * way[1:, 1] - way[:-1, 1] * way[1:, 0])
        aside_m = across / np.maximum(np.linalg.norm(ground[2:] - ground[:-2], axis=1), _EXACT)
        step_m = float(np.median(np.linalg.norm(way, axis=1)))
        is_bent = aside_m > np.clip(_ROUNDED * np.median(aside_m), _EXACT * step_m, _STRAIGHT * step_m)
        fixes = np.concatenate([[0], 1 + np.flatnonzero(is_bent), [len(row) - 1]])
        if len(fixes) * (_LEAST_BETWEEN + 1) > len(row):
            continue
        # A camera is turned in its mount: what most images look off the way that they are driven is that.
        off = wrapped(azimuth[row[1:]] - _azimuths(way))
        mean = np.arctan2(np.sin(off).mean(), np.cos(off).mean())
        mount = mean + np.median(wrapped(off - mean))
        paths.append(_WayOfCamera(row, ground, azimuth[row] - mount, fixes))
    return paths


def _along_curves(dataset: Dataset) -> Dataset:
    """Return the dataset with images on curves between the fixes, without those where no car can have gone."""
    moved, can_go = _on_curves(dataset)
    return keep_rows(moved, images=can_go)


def _on_curves(dataset: Dataset) -> tuple[Dataset, Bools]:
    """Return the dataset with images on curves between the fixes, and for which images (N) a car can go so."""
    axes = np.stack(list(dataset.frame.east_north()))
    center, can_go = camera_centers(dataset.images), np.ones(len(dataset.images), dtype=np.bool_)
    for path in _paths(dataset):
        curve, can_go[path.row] = path.on_curves()
        center[path.row] += (curve - path.ground_m) @ axes
    return with_centers(dataset, center), can_go


def _azimuths(way: Floats) -> Floats:
    return np.asarray(np.arctan2(way[:, 0], way[:, 1]))
