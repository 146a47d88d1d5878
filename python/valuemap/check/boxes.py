"""Faults of boxes: what x, y, width and height mean, and in which picture they were measured."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from scipy import stats

from valuemap.arrays import Bools, Floats, Ints
from valuemap.check.agreement import measure_agreement
from valuemap.check.fault import (
    GATE_RAD,
    LEAST_CHANCE,
    LEAST_RISE,
    Convention,
    Fault,
    Finding,
    Fix,
    Stage,
    View,
    keep_rows,
    with_detections,
)
from valuemap.check.groups import Group, OfGroup, groups_of
from valuemap.check.lenses import camera_rows, focals
from valuemap.dataset import ABOVE_ZERO, LARGEST_PX, Dataset, outside_by_a_box, rows_of

_NORMALISED_LIMIT = 2.0
_MOST_OUT = 1.02
"""A box cut at its centre ends half its size outside, and with its corner for its centre a whole one."""
_FEET_IN_A_METRE = 3.28
_STRAYS = 0.02
"""A gap with more boxes in it than this share of those beside it is none."""
_NEARLY_ALL = 0.99
"""Of the boxes have their middle in the picture."""


def _reach(dataset: Dataset) -> float:
    """Return how far from the first pixel nearly all boxes have their middle, in shares of their pictures."""
    return float(np.quantile((dataset.detections.center_px / picture_sizes(dataset)).max(axis=1), _NEARLY_ALL))


def picture_sizes(dataset: Dataset) -> Floats:
    """Return width and height (N, 2) in pixels of the picture of each detection."""
    camera = camera_rows(dataset)
    return np.stack([dataset.cameras.width_px[camera], dataset.cameras.height_px[camera]], axis=1).astype(np.float64)


class NormalisedBoxes(Fault):
    """Boxes from 0 to 1."""

    name: ClassVar[str] = "boxes_normalised"
    stage: ClassVar[Stage] = "tables"
    is_of_rows: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """Look for boxes that all lie in the first pixel."""
        detections = view.dataset.detections
        most = float(max(np.abs(detections.center_px).max(), np.abs(detections.size_px).max()))
        if most > _NORMALISED_LIMIT:
            return None
        return Finding(
            fault=self.name,
            what="The boxes are from 0 to 1, not in pixels.",
            why=f"No centre or size of {len(detections)} boxes is above {most:.3g}.",
            do="Multiply x and width by the picture's width, y and height by its height.",
            figures={"largest": round(most, 4)},
            fix=_to_pixels,
        )


class CornersAsCenter(Fault):
    """x1 y1 x2 y2 where centre and size are expected."""

    name: ClassVar[str] = "boxes_as_corners"
    stage: ClassVar[Stage] = "tables"
    is_of_rows: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """See whether width and height are always beyond x and y, and still in the picture."""
        detections = view.dataset.detections
        center, size = detections.center_px, detections.size_px
        if len(detections) < 3 or np.median(size) < 2.0:
            return None
        beyond = (size >= center).all(axis=1)
        inside = (size <= picture_sizes(view.dataset) * 1.02 + 1.0).all(axis=1)
        # Boxes of objects are as often left as right of where width equals x; in good data most are far smaller.
        share = float((beyond & inside).mean())
        if share < 0.98:
            return None
        return Finding(
            fault=self.name,
            what="x, y, width and height hold the corners x1, y1, x2, y2.",
            why=f"In {share:.1%} of {len(detections)} boxes width exceeds x and height exceeds y; the median width is "
            f"{np.median(size[:, 0]):.0f} px.",
            do="Write centres and sizes: x = (x1 + x2) / 2, width = x2 - x1.",
            figures={"share": round(share, 4)},
            fix=_from_corners,
        )


class TopLeftAsCenter(Fault):
    """The top left corner where the centre is expected."""

    name: ClassVar[str] = "boxes_top_left"
    stage: ClassVar[Stage] = "tables"
    is_of_rows: ClassVar[bool] = True

    def find(self, view: View) -> Finding | None:
        """Compare how boxes end at the left and top of pictures with how they end at the right and bottom."""
        near, far = _border_ends(view.dataset)
        for name, shift, first, second in (
            ("the top left corner", 0.5, near, far),
            ("the bottom right corner", -0.5, far, near),
        ):
            chance = chance_of_gap(first, second)
            if chance < LEAST_CHANCE:
                return Finding(
                    fault=self.name,
                    what=f"x and y are {name} of the boxes, not their centres.",
                    why=f"On one side of the pictures {first.beyond} boxes reach out of the picture by up to "
                    f"{-first.least:.2g} of their size, on the other none comes closer than {second.least:.2g} of its, "
                    f"although {second.within} are within one and a half.",
                    do="Write centres: x + width / 2, y + height / 2.",
                    chance=chance,
                    figures={"beyond": first.beyond, "gap": round(second.least, 3), "near": second.within},
                    fix=partial(_with_centers_moved, sizes=shift),
                )
        return None


class HalfSizes(Fault):
    """Half the width and height where the whole is expected."""

    name: ClassVar[str] = "boxes_half_size"
    stage: ClassVar[Stage] = "results"

    def find(self, view: View) -> Finding | None:
        """See whether boxes keep half a size from all borders, or objects are half as high as their kind is."""
        from valuemap.check.sizes import half_sized_group, object_heights, plausible_heights

        of_group = half_sized_group(view)
        if of_group is not None:
            return _half_of_group(*of_group)
        near, far = _border_ends(view.dataset)
        chance = max(_chance_of_margin(near), _chance_of_margin(far)) if near.within and far.within else 1.0
        chance = min(chance, _chance_of_margin(near + far))
        heights = object_heights(view)
        figures: dict[str, float] = {"gap": round(min(near.least, far.least), 3)}
        reasons = []
        if chance < LEAST_CHANCE:
            reasons.append(
                f"no box comes closer to the border of its picture than {figures['gap']:g} of its own size, although "
                f"{near.within + far.within} are within one and a half sizes"
            )
        for name, height_of_each_m in heights.items():
            height_m, objects = float(np.median(height_of_each_m)), len(height_of_each_m)
            low, high = plausible_heights(name)
            figures[f"height_m of {name}"] = round(height_m, 3)
            # Of a unit that is not the metre, feet are the nearest to a half.
            is_half = height_m > math.sqrt(low * high) / math.sqrt(2.0 * _FEET_IN_A_METRE)
            if low > 0.1 and objects >= 3 and is_half and height_m < low * 1.35 <= 2.0 * height_m <= high:
                reasons.append(f"{name} are {height_m:.2g} m high; twice that is usual")
        if not reasons:
            return None
        return Finding(
            fault=self.name,
            what="Width and height of the boxes are half of what they should be.",
            why="; ".join(reasons).capitalize() + ".",
            do="Write whole widths and heights, not distances from the centre to the sides.",
            chance=chance if chance < LEAST_CHANCE else LEAST_CHANCE / 10.0,
            figures=figures,
            fix=_doubled,
        )


class ImpossibleBoxes(Fault):
    """Rows of detections that no map takes."""

    name: ClassVar[str] = "impossible_boxes"
    stage: ClassVar[Stage] = "results"  # Boxes that were read wrongly are in their pictures once they are put right.

    def find(self, view: View) -> Finding | None:
        """Count what is outside of its picture by more than a box, or has a size or a range that nothing has."""
        reasons = _impossible(view.dataset)
        is_out = np.any(list(reasons.values()), axis=0)
        count, total = int(is_out.sum()), len(is_out)
        if count == 0:
            return None
        told = {why: int(rows.sum()) for why, rows in reasons.items() if rows.any()}
        ids = ", ".join(str(each) for each in view.dataset.detections.detection_id[is_out][:_MOST_TOLD].tolist())
        return Finding(
            fault=self.name,
            what=f"{count} {'detection is one' if count == 1 else 'detections are ones'} that no map takes.",
            why="; ".join(f"{number} of {total} {why}" for why, number in told.items())
            + f" (detection_id {ids}{' and more' if count > _MOST_TOLD else ''}).",
            do="Look where these rows come from (another picture, corners, a sign?); the fix leaves them out.",
            figures={"left_out": count, "detections": total, **told},
            fix=None if count == total else _without_impossible,
        )


_MOST_TOLD = 5
_ARE_OUTSIDE = "are outside of their pictures by more than a box"


def _impossible(dataset: Dataset) -> dict[str, Bools]:
    """Return which detections (N) no dataset may have, by reason, as `read_dataset` refuses them."""
    detections, extent = dataset.detections, picture_sizes(dataset)
    center, size = detections.center_px, detections.size_px
    is_negative: Bools = np.asarray((size < 0.0).any(axis=1))
    is_outside = outside_by_a_box(center, size, extent).any(axis=1)
    reasons: dict[str, Bools] = {
        _ARE_OUTSIDE: is_outside & ~is_negative,
        "have a negative width or height": is_negative,
        "are larger than any picture": np.asarray((size > LARGEST_PX).any(axis=1)),
    }
    for name in ABOVE_ZERO:
        values = getattr(detections, name)
        if values is not None:
            reasons[f"have a {name} of 0 or less"] = np.asarray(values <= 0.0)
    return reasons


def _without_impossible(dataset: Dataset) -> Dataset:
    return keep_rows(dataset, detections=~np.any(list(_impossible(dataset).values()), axis=0))


def puts_boxes_outside(dataset: Dataset, fix: Fix) -> bool:
    """Return whether a reading leaves boxes outside of their pictures that are possible as given."""
    return bool(np.any(_impossible(fix(dataset))[_ARE_OUTSIDE] & ~_impossible(dataset)[_ARE_OUTSIDE]))


def _half_of_group(group: Group, name: str, height_m: float, others_m: float, chance: float) -> Finding:
    return Finding(
        fault=HalfSizes.name,
        what=f"Only {group.text}: width and height of the boxes are half of what they should be.",
        why=f"By its boxes {name} are {height_m:.2g} m high (median), by those of the others {others_m:.2g} m.",
        do="Write whole widths and heights, not distances from the centre to the sides.",
        chance=chance,
        figures={"of": group.text, f"height_m of {name}": round(height_m, 3), "height_m of others": round(others_m, 3)},
        fix=OfGroup(group, _doubled),
        of=group.text,
    )


def _doubled(dataset: Dataset) -> Dataset:
    return with_detections(dataset, size_px=2.0 * dataset.detections.size_px)


class PictureSize(Convention):
    """Boxes measured in pictures of another size than the cameras'."""

    name: ClassVar[str] = "picture_size"
    what: ClassVar[str] = "The boxes were measured in pictures of another size than cameras.parquet says."
    do: ClassVar[str] = "Give width, height and parameters of the cameras for the pictures that were looked at."
    is_of_boxes: ClassVar[bool] = True

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield boxes of pictures enlarged or shrunk, but not so much that they would be outside of theirs.

        What is possible in one camera and not in all is tried in that camera.
        """
        # In panoramas things are seen all round: there is no border that boxes keep from.
        is_all_round = not any(focals(dataset.cameras, row) for row in range(len(dataset.cameras)))
        reach, of_cameras = _reach(dataset), [each for each in groups_of(dataset) if each.pass_name is None]
        reach_of = {camera: _reach(camera.part(dataset)) for camera in of_cameras}
        for name, factor in (
            ("4", 4.0), ("3", 3.0), ("2", 2.0), ("1.5", 1.5), ("4/3", 4 / 3), ("5/4", 1.25), ("6/5", 1.2),
            ("10/9", 10 / 9), ("20/19", 20 / 19), ("19/20", 0.95), ("9/10", 0.9),
            ("5/6", 5 / 6), ("4/5", 0.8), ("3/4", 0.75), ("2/3", 2 / 3), ("1/2", 0.5), ("1/3", 1 / 3), ("1/4", 0.25),
        ):  # fmt: skip
            is_possible = factor * reach <= 1.0 if factor > 1.0 else reach > 1.0 or not is_all_round
            if is_possible:
                yield f"boxes {name} times as large", _ScaledBoxes(factor)
            for camera, its_reach in reach_of.items():
                is_possible_in_one = (
                    factor * its_reach <= 1.0 < factor * reach if factor > 1.0 else reach <= 1.0 < its_reach
                )
                if is_possible_in_one:
                    yield f"boxes {name} times as large", OfGroup(camera, _ScaledBoxes(factor))
        extent, exchanged = picture_sizes(dataset), _of_other_sides(dataset).detections.center_px
        is_inside = float(np.quantile((exchanged / extent).max(axis=1), _NEARLY_ALL)) <= 1.0
        if is_inside and (extent[:, 0] != extent[:, 1]).any():
            yield (
                "shares of the width that were multiplied by the height, and of the height by the width",
                _of_other_sides,
            )
        farthest = float(np.quantile(dataset.detections.center_px.max(axis=1), _NEARLY_ALL))
        for side in _SQUARES_PX:
            if farthest > side:
                continue
            for how, is_squeezed in (
                ("squeezed into {0} x {0} px", True),
                ("fitted into {0} x {0} px with bars", False),
            ):
                yield f"boxes of pictures {how.format(side)}", BoxesOfSquare(dataset, side, is_squeezed=is_squeezed)

    def refined(self, view: View, how: str, fix: Fix) -> tuple[str, Fix]:
        """Look for the size between those that are tried: pictures are scaled by any number."""
        scaled = fix.own if isinstance(fix, OfGroup) else fix
        if not isinstance(scaled, _ScaledBoxes):
            return how, fix
        sample = view.stretches

        def of_camera(scaled: _ScaledBoxes) -> Fix:
            return OfGroup(fix.group, scaled) if isinstance(fix, OfGroup) else scaled

        def gain(scaled: _ScaledBoxes) -> float:
            changed = of_camera(scaled)
            gate_px = view.gate_px * getattr(changed, "gate_factor", 1.0)
            return float(measure_agreement(changed(sample.dataset), sample.place_of_image, gate_px).gain.sum())

        beside = scaled.gate_factor * np.exp(np.arange(-_HALF_A_STEP, _HALF_A_STEP, GATE_RAD))
        sizes = (_ScaledBoxes(float(factor)) for factor in beside)
        possible = [each for each in sizes if not puts_boxes_outside(view.dataset, of_camera(each))]
        best = max(possible, key=gain, default=scaled)
        if gain(best) < (1.0 + LEAST_RISE) * gain(scaled):
            return how, fix
        return f"boxes {best.gate_factor:.3g} times as large", of_camera(best)


_HALF_A_STEP = math.log(3.0 / 2.0) / 2.0
"""Half the widest step between the sizes tried; beside one of them in steps of the gate, at 45 degrees."""


class MirroredPictures(Convention):
    """Boxes measured in pictures that were mirrored or turned."""

    name: ClassVar[str] = "mirrored_pictures"
    what: ClassVar[str] = "The boxes were measured in pictures that were mirrored or turned."
    do: ClassVar[str] = (
        "Detect in the pictures as the cameras took them (mind the EXIF orientation). If these are not mirrored, the "
        "world is (north and east exchanged in positions and headings): rays cannot tell one from the other."
    )
    is_of_boxes: ClassVar[bool] = True
    left_and_right: ClassVar[str] = "left and right exchanged"

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield boxes mirrored, turned upside down, and with x and y exchanged."""
        yield self.left_and_right, _Flipped(x=True, y=False)
        yield "top and bottom exchanged", _Flipped(x=False, y=True)
        yield "turned upside down", _Flipped(x=True, y=True)
        yield "x and y exchanged (row, column)", _swap_axes
        yield "turned a quarter to the right", partial(_turned_by_a_quarter, to_right=True)
        yield "turned a quarter to the left", partial(_turned_by_a_quarter, to_right=False)


class PanoramaMiddle(Convention):
    """Panoramas whose middle column has another heading than the pose: north, the back, a side."""

    name: ClassVar[str] = "panorama_middle"
    what: ClassVar[str] = "The middle column of the panoramas has another heading than their poses."
    do: ClassVar[str] = (
        "Give the heading of the middle column, or turn the panoramas so that their poses look along it (is the "
        "heading that of the left edge?)."
    )

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield boxes of panoramas moved by a quarter and by a half of their width."""
        if not _are_panoramas(dataset).any():
            return
        yield "the heading is that of the left edge (half a turn)", partial(_moved_round, turns=0.5)
        yield "the middle column looks to the right of it (a quarter)", partial(_moved_round, turns=0.25)
        yield "the middle column looks to the left of it (a quarter)", partial(_moved_round, turns=-0.25)


def _are_panoramas(dataset: Dataset) -> Bools:
    """Return which detections (N) are of pictures that show all round."""
    models = np.array(dataset.cameras.model.texts())
    return np.asarray((models == "EQUIRECTANGULAR")[camera_rows(dataset)])


def _moved_round(dataset: Dataset, *, turns: float) -> Dataset:
    width, center = picture_sizes(dataset)[:, 0], dataset.detections.center_px.copy()
    center[:, 0] = np.where(_are_panoramas(dataset), (center[:, 0] + turns * width) % width, center[:, 0])
    return with_detections(dataset, center_px=center)


_SQUARES_PX = (100, 224, 300, 416, 512, 608, 640, 768, 800, 1000, 1024, 1280, 1536)
"""What detectors take their pictures in (and 100 and 1000, for percent and thousandths of them)."""


@dataclass(frozen=True)
class EndsOfBoxes:
    """How boxes end at some sides of their pictures, in shares of their own size (negative: outside)."""

    ends: Floats

    @property
    def least(self) -> float:
        """The least end, infinity of none."""
        return float(self.ends.min(initial=math.inf))

    @property
    def beyond(self) -> int:
        """How many are outside."""
        return int((self.ends < -0.02).sum())

    @property
    def within(self) -> int:
        """How many are within one and a half, or outside."""
        return int((self.ends < 1.5).sum())

    def __add__(self, other: EndsOfBoxes) -> EndsOfBoxes:
        return EndsOfBoxes(np.concatenate([self.ends, other.ends]))


def _border_ends(dataset: Dataset) -> tuple[EndsOfBoxes, EndsOfBoxes]:
    """Return how boxes end at left and top, and at right and bottom; sides that nothing comes near are left out."""
    detections = dataset.detections
    size = detections.size_px
    low = (detections.center_px - size / 2.0) / np.maximum(size, 1e-9)
    high = (picture_sizes(dataset) - detections.center_px - size / 2.0) / np.maximum(size, 1e-9)
    solid: Bools = size > 1.0
    keep = [EndsOfBoxes(np.concatenate([side[:, axis][solid[:, axis]] for axis in (0, 1)])) for side in (low, high)]
    return keep[0], keep[1]


def chance_of_gap(reaching: EndsOfBoxes, keeping: EndsOfBoxes) -> float:
    """Return how likely one side has boxes half out and the other none that near, if both end alike.

    Pictures cut boxes where the boxes end or where their centres do. If corners stand for centres, boxes on one side
    reach half a size farther than that, and on the other keep half a size away. Boxes are spread evenly close to a
    border: those in the unit behind the gap say how many should be in the unit before it.
    """
    reach = -0.5 if np.sum(reaching.ends < -0.52) >= 3 else 0.0
    out = int((reaching.ends < reach - 0.02).sum())
    if out < 3 or int((reaching.ends < -_MOST_OUT).sum()) > _STRAYS * out:
        return 1.0  # Boxes that lie outside of their pictures are of other pictures.
    return _chance_of_empty(keeping.ends, reach + 0.5, 1.0)


def _chance_of_margin(ends: EndsOfBoxes) -> float:
    """Return how likely no box comes within half its size of a border, if they are spread evenly close to it."""
    return _chance_of_empty(ends.ends, 0.5, 0.5)


def _chance_of_empty(ends: Floats, border: float, width: float) -> float:
    """Return how likely the range of a width before a border is empty by accident, as many as there are behind it."""
    missing = int((ends < border - 0.02).sum())
    beside = int(((ends >= border - 0.02) & (ends < border + width)).sum())
    if missing > _STRAYS * beside:
        return 1.0
    return float(stats.binom.cdf(missing, missing + beside, 0.5))


def _with_centers_moved(dataset: Dataset, *, sizes: float) -> Dataset:
    return with_detections(dataset, center_px=dataset.detections.center_px + sizes * dataset.detections.size_px)


def _to_pixels(dataset: Dataset) -> Dataset:
    extent = picture_sizes(dataset)
    detections = dataset.detections
    return with_detections(dataset, center_px=detections.center_px * extent, size_px=detections.size_px * extent)


def _from_corners(dataset: Dataset) -> Dataset:
    first, second = dataset.detections.center_px, dataset.detections.size_px
    return with_detections(dataset, center_px=(first + second) / 2.0, size_px=np.maximum(second - first, 0.0))


class _ScaledBoxes:
    """Boxes of pictures so many times as large."""

    def __init__(self, factor: float) -> None:
        self.gate_factor = factor

    def __call__(self, dataset: Dataset) -> Dataset:
        detections = dataset.detections
        return with_detections(
            dataset, center_px=detections.center_px * self.gate_factor, size_px=detections.size_px * self.gate_factor
        )


def _of_other_sides(dataset: Dataset) -> Dataset:
    """Put right boxes whose place in the picture, as a share of it, was multiplied by the other side of the picture."""
    extent, detections = picture_sizes(dataset), dataset.detections
    factor = extent / extent[:, ::-1]
    return with_detections(dataset, center_px=detections.center_px * factor, size_px=detections.size_px * factor)


class BoxesOfSquare:
    """Boxes of the pictures that a detector saw in a square, squeezed in both directions or with bars at two sides."""

    def __init__(self, dataset: Dataset, side_px: float, *, is_squeezed: bool) -> None:
        self._side_px, self._is_squeezed = side_px, is_squeezed
        # A pixel of the square is so many of the picture, on average of both directions.
        self.gate_factor = float(np.exp(np.median(np.log(self._shown(dataset) / side_px).mean(axis=1))))

    def _shown(self, dataset: Dataset) -> Floats:
        """Return what of each detection's picture (N, 2), in its pixels, is as large as the square."""
        extent = picture_sizes(dataset)
        return extent if self._is_squeezed else np.broadcast_to(extent.max(axis=1, keepdims=True), extent.shape)

    def __call__(self, dataset: Dataset) -> Dataset:
        """Return the dataset with boxes in pixels of the pictures."""
        detections, shown = dataset.detections, self._shown(dataset)
        factor = shown / self._side_px
        center = detections.center_px * factor - (shown - picture_sizes(dataset)) / 2.0
        return with_detections(dataset, center_px=center, size_px=detections.size_px * factor)


class _Flipped:
    """Boxes mirrored."""

    def __init__(self, *, x: bool, y: bool) -> None:
        self._flips = np.array([x, y])

    def __call__(self, dataset: Dataset) -> Dataset:
        center = dataset.detections.center_px
        return with_detections(dataset, center_px=np.where(self._flips, picture_sizes(dataset) - center, center))


def _swap_axes(dataset: Dataset) -> Dataset:
    detections = dataset.detections
    return with_detections(
        dataset, center_px=detections.center_px[:, ::-1].copy(), size_px=detections.size_px[:, ::-1].copy()
    )


def _turned_by_a_quarter(dataset: Dataset, *, to_right: bool) -> Dataset:
    """Turn boxes back that were measured in a picture turned to the right, or to the left, by a quarter."""
    swapped, extent = _swap_axes(dataset), picture_sizes(dataset)
    center = swapped.detections.center_px
    axis = 1 if to_right else 0
    center[:, axis] = extent[:, axis] - center[:, axis]
    return swapped


def rows_in_images(dataset: Dataset) -> Ints:
    """Return the row (N) of each detection's image."""
    return rows_of(dataset.detections.image_id, dataset.images.image_id)
