"""Heights that are not those of the images: in another unit than positions in metres, or left out of one pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers
from valuemap.check.agreement import compare
from valuemap.check.fault import (
    AGAINST,
    LEAST_CHANCE,
    LEAST_RISE,
    NEAR_STEPS,
    Fault,
    Finding,
    Stage,
    View,
    gains_of_all,
    with_centers,
)
from valuemap.check.groups import Group, groups_of
from valuemap.check.sample import FASTER, drive_of_camera, median_step_m, order_by_camera, order_by_pass, standing_m
from valuemap.dataset import Dataset

_FOOT_M = 0.3048
_LARGER = 1.5
"""Half as much again: if heights waver, rays agree about as well with that, or better with none."""
_STEEPEST = 0.35
"""No street rises by more of its length (Baldwin Street, Dunedin)."""
_LEAST_STEEP = 0.1
"""The share of the ways that are steeper: of one place the heights may just be wrong."""
_SMOOTHED = 9
"""Errors of heights grow less with a smaller share, too: means of so many images have few of these."""
_STRETCH, _ALIKE = 16, 0.8
"""Over so many images heights of two passes rise alike, by their correlation, if they are no errors."""
_LEVEL_M = 1e-3
_LEAST_NEAR = 10


class HeightUnit(Fault):
    """Heights in feet where positions are in metres, in all passes or in one."""

    name: ClassVar[str] = "height_unit"
    stage: ClassVar[Stage] = "positions"
    units_m: ClassVar[dict[str, float]] = {"feet": _FOOT_M}

    def may_be(self, dataset: Dataset) -> bool:
        """Return whether heights are worth a look, before rays are asked."""
        return True

    def find(self, view: View) -> Finding | None:
        """See whether rays agree better with heights in another unit, those of all images or of a pass alone."""
        groups = [None, *(group for group in groups_of(view.dataset) if group.pass_name is not None)]
        groups = [each for each in groups if self.may_be(view.dataset if each is None else each.part(view.dataset))]
        proven: dict[tuple[Group | None, str], float] = {}
        for group in groups:
            for unit, unit_m in self.units_m.items():
                chance = _chance_of_unit(view, group, unit_m) * len(groups) * len(self.units_m)
                if chance < 1.0:
                    proven[group, unit] = chance
        if proven:
            steady = _steady_passes(view.dataset)
            proven = {each: chance for each, chance in proven.items() if steady & _passes_of(view, each[0])}
        if not proven or min(proven.values()) > LEAST_CHANCE:
            return None
        of_names = {(None if group is None else group.pass_name, unit) for group, unit in proven}
        of_names |= {(None, unit) for _, unit in of_names}
        gains, without = {}, {}
        for name, unit in sorted(of_names, key=lambda each: (each[0] is not None, each)):
            scaled = _ScaledHeights(name, self.units_m[unit])
            smoothed = _smoothed(scaled(view.dataset))
            gains[name, unit] = gains_of_all(view, smoothed)
            without[name, unit] = gains_of_all(view, scaled.undone(smoothed))
        name, unit = max(gains, key=lambda each: float(gains[each].sum()))
        rise = compare(gains[name, unit], without[name, unit])
        if rise.difference < LEAST_RISE * float(gains[name, unit].sum()):
            return None
        whose, unit_m = "all images" if name is None else f"pass {name}", self.units_m[unit]
        return Finding(
            fault=self.name,
            what=f"The heights of {whose} are in {unit}, the positions in metres.",
            why=f"With {unit_m:g} times the heights the agreement of rays rises by {rise.difference:.0f} "
            f"({rise.places} places); with no heights, or with half as much again, they agree less.",
            do="Give heights in metres. The fix scales them from the zero of the dataset's frame.",
            chance=min(proven.values()),
            figures={**({} if name is None else {"pass": name}), "unit": unit, **rise.to_json()},
            fix=_ScaledHeights(name, unit_m),
            of=None if name is None else f"pass {name}",
        )


class SmallHeightUnit(HeightUnit):
    """Heights in centimetres or millimetres, with which hardly any rays meet and no convention can be told."""

    stage: ClassVar[Stage] = "tables"
    units_m: ClassVar[dict[str, float]] = {"centimetres": 0.01, "millimetres": 0.001}

    def may_be(self, dataset: Dataset) -> bool:
        """Return whether ways are steeper than streets are."""
        order, up = order_by_camera(dataset.images), _up(dataset)
        if len(order) <= _STRETCH:
            return False
        drive, center = drive_of_camera(dataset.images)[order], camera_centers(dataset.images)[order]
        step = np.diff(center, axis=0)
        along_m = np.append(0.0, np.cumsum(np.linalg.norm(step - np.outer(step @ up, up), axis=1)))
        rise_m, way_m = (np.abs(each[_STRETCH:] - each[:-_STRETCH]) for each in (center @ up, along_m))
        moves = (drive[_STRETCH:] == drive[:-_STRETCH]) & (way_m > standing_m(way_m))
        return bool(moves.any()) and float(np.mean((rise_m > _STEEPEST * way_m)[moves])) > _LEAST_STEEP


class HeightsLeftOut(Fault):
    """A pass that is driven at one height where the others go up and down."""

    name: ClassVar[str] = "heights_left_out"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Look for level passes; rays must agree better with the heights that other passes have there."""
        level = _level_passes(view.dataset)
        if not level:
            return None
        fix = _HeightsOfOthers(level)
        apart_m = np.abs((camera_centers(fix(view.dataset).images) - view.center_in_world_m) @ _up(view.dataset))
        rise = compare(gains_of_all(view, fix(view.dataset)), gains_of_all(view, view.dataset))
        if rise.chance > AGAINST or float(np.ptp(apart_m)) < _LEVEL_M:
            return None
        return Finding(
            fault=self.name,
            what=f"All images of {'passes' if len(level) > 1 else 'pass'} {', '.join(level)} are at one height, and "
            "those of other passes at the same places are not.",
            why=f"Those are up to {apart_m.max():.1f} m above or below; with the heights of the others the agreement "
            f"of all rays rises by {rise.difference:.0f} ({rise.places} places).",
            do="Import the heights, too. The fix takes those of the nearest images of other passes.",
            figures={"passes": list(level), "most_m": round(float(apart_m.max()), 2), **rise.to_json()},
            fix=fix,
            of=f"pass {level[0]}" if len(level) == 1 else None,
        )


def _up(dataset: Dataset) -> Floats:
    return np.asarray(dataset.frame.up, dtype=np.float64)


def _chance_of_unit(view: View, group: Group | None, unit_m: float) -> float:
    """Return how likely rays of a group (None: all) agree so much better with heights in a unit by chance.

    It is 1 where they do not agree less with no heights, or with larger ones. A pass is looked at alone: against others
    a shift is as good.
    """
    alone = view if group is None else group.alone(view)
    smoothed = _smoothed(_ScaledHeights(None, unit_m)(alone.dataset))
    none, in_unit, larger, given = (
        gains_of_all(alone, _ScaledHeights(None, share)(smoothed)) for share in (0.0, 1.0, _LARGER, 1.0 / unit_m)
    )
    if max(compare(in_unit, none).chance, compare(in_unit, larger).chance) > AGAINST:
        return 1.0
    return compare(in_unit, given).chance


def _passes_of(view: View, group: Group | None) -> frozenset[str]:
    names = view.dataset.images.pass_id.names if group is None else [group.pass_name]
    return frozenset(name for name in names if name is not None)


def _steady_passes(dataset: Dataset) -> frozenset[str]:
    """Return the passes whose heights rise and fall with those of others at the same places, or that meet none."""
    smoothed, order, names = _smoothed(dataset), order_by_camera(dataset.images), dataset.images.pass_id.names
    height, drive = camera_centers(smoothed.images) @ _up(dataset), drive_of_camera(dataset.images)
    first, last = order[:-_STRETCH], order[_STRETCH:]
    is_one_drive, steady = drive[first] == drive[last], set(names)
    for code in np.unique(dataset.images.pass_id.codes).tolist() if len(names) > 1 else []:
        near, there = _near_others(smoothed, (names[code],), names[code])
        both = is_one_drive & near[first] & near[last]
        rises = np.stack([each[last[both]] - each[first[both]] for each in (height, there)])
        if rises.shape[1] < _LEAST_NEAR:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):  # Of heights that are all the same.
            alike = float(np.corrcoef(rises)[0, 1])
        if not alike > _ALIKE:
            steady.remove(names[code])
    return frozenset(steady)


def _smoothed(dataset: Dataset) -> Dataset:
    """Return the dataset with means of heights along the ways of cameras, as far as these are driven."""
    images, up = dataset.images, _up(dataset)
    center, order = camera_centers(images), order_by_camera(images)
    height = center @ up
    mean = height.copy()
    is_far = np.linalg.norm(np.diff(center[order], axis=0), axis=1) > FASTER * median_step_m(images)
    for rows in np.split(order, 1 + np.flatnonzero(is_far | (np.diff(drive_of_camera(images)[order]) != 0))):
        mean[rows] = uniform_filter1d(height[rows], _SMOOTHED, mode="nearest")
    return with_centers(dataset, center + (mean - height)[:, None] * up)


@dataclass(frozen=True)
class _ScaledHeights:
    """Heights of a pass (None: all) that are so many times as large."""

    name: str | None
    factor: float

    def undone(self, dataset: Dataset) -> Dataset:
        """Return a dataset that was scaled so, as it was."""
        return _ScaledHeights(self.name, 1.0 / self.factor)(dataset)

    def __call__(self, dataset: Dataset) -> Dataset:
        center, up = camera_centers(dataset.images), _up(dataset)
        passes = dataset.images.pass_id
        mine = np.ones(len(center), np.bool_) if self.name is None else passes.codes == passes.code_of(self.name)
        lift = np.where(mine, (self.factor - 1.0) * (center @ up), 0.0)
        return with_centers(dataset, center + lift[:, None] * up)


def _level_passes(dataset: Dataset) -> tuple[str, ...]:
    """Return the names of passes at one height, if others are not, and are near enough at enough of their images."""
    passes, height = dataset.images.pass_id, camera_centers(dataset.images) @ _up(dataset)
    is_level = {
        code: float(np.ptp(height[passes.codes == code])) < _LEVEL_M for code in np.unique(passes.codes).tolist()
    }
    if all(is_level.values()):
        return ()
    level = tuple(passes.names[code] for code, is_it in is_level.items() if is_it)
    return tuple(name for name in level if _near_others(dataset, level, name)[0].sum() >= _LEAST_NEAR)


def _near_others(dataset: Dataset, level: tuple[str, ...], name: str) -> tuple[Bools, Floats]:
    """Return which images (N) of a pass are near those of passes that are not level, and how high these are (N)."""
    passes, center = dataset.images.pass_id, camera_centers(dataset.images)
    ground = center @ np.stack(list(dataset.frame.east_north()), axis=1)
    mine = np.flatnonzero(passes.codes == passes.code_of(name))
    others = np.flatnonzero(~np.isin(passes.codes, [passes.code_of(each) for each in level]))
    away_m, nearest = (np.asarray(each) for each in cKDTree(ground[others]).query(ground[mine]))
    is_near = away_m < NEAR_STEPS * median_step_m(dataset.images)
    near, height = np.zeros(len(center), np.bool_), np.zeros(len(center))
    near[mine] = is_near
    height[mine] = center[others[nearest]] @ _up(dataset)
    return near, height


@dataclass(frozen=True)
class _HeightsOfOthers:
    """Level passes at the heights of the nearest images of others; on the way between, at heights between."""

    level: tuple[str, ...]

    def __call__(self, dataset: Dataset) -> Dataset:
        images, up = dataset.images, _up(dataset)
        center, order = camera_centers(images), order_by_pass(images)
        height = center @ up
        lifted = height.copy()
        for name in self.level:
            near, there = _near_others(dataset, self.level, name)
            mine = order[images.pass_id.codes[order] == images.pass_id.code_of(name)]
            known = np.flatnonzero(near[mine])
            lifted[mine] = np.interp(np.arange(len(mine)), known, there[mine[known]])
        return with_centers(dataset, center + (lifted - height)[:, None] * up)
