"""One label as a picture: who voted for it, by pass, who should have seen it and did not, and how their rays meet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.dataset import evenly
from valuemap.evidence import Evidence, Misses, Voters
from valuemap.report.above import plain_line
from valuemap.report.crops import LEAST_SIDE_PX, Crop, miss_crop, voter_crop
from valuemap.report.ground import ellipses, horizontal_axes
from valuemap.report.style import BLUE, DPI, FAINT_INK, GROUND, INK, ORANGE, RULE, drawing, number_of, probability

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH_PX, _MARGIN_PX, _GAP_PX = 1600.0, 44.0, 14.0
_CROPS_PER_ROW = 9
_CROP_PX = (_WIDTH_PX - 2 * _MARGIN_PX - (_CROPS_PER_ROW - 1) * _GAP_PX) / _CROPS_PER_ROW
_CAPTION_PX, _ROW_TITLE_PX, _HEAD_PX, _VIEW_PX, _FOOT_PX = 40.0, 30.0, 132.0, 400.0, 22.0
_MOST_PASSES = 6
_MOST_RAYS = 400
_PASS_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#8c564b", "#7a5195", "#C9B400", "#4d4d4d")


@dataclass(frozen=True)
class _Row:
    """A row of crops: its title, the places of its votes or misses, and its colour."""

    title: str
    places: Ints
    color: str
    misses: bool = False


def pass_color(number: int) -> str:
    """Return the colour of a pass."""
    return _PASS_COLORS[number % len(_PASS_COLORS)]


def plot_label(evidence: Evidence, label_id: int, pictures: Path | None = None) -> Figure:
    """Return the picture of one label.

    Parameters
    ----------
    evidence
        The map and its dataset.
    label_id
        The label.
    pictures
        The folder of the dataset's pictures; without it crops are empty frames with boxes.

    Raises
    ------
    InputError
        There is no such label.
    """
    from matplotlib.figure import Figure  # Slow to import, and only pictures need it.

    row = evidence.label_row(label_id)
    voters, misses = evidence.voters(label_id), evidence.misses(label_id)
    rows = _rows(evidence, voters, misses)
    row_px = _ROW_TITLE_PX + _CROP_PX + _CAPTION_PX
    height_px = _HEAD_PX + _VIEW_PX + 58.0 + len(rows) * row_px + _FOOT_PX
    with drawing():
        figure = Figure(figsize=(_WIDTH_PX / DPI, height_px / DPI), dpi=DPI, facecolor="white")
        _draw_head(figure, evidence, row, voters, misses, height_px)
        _draw_views(figure, evidence, row, voters, misses, height_px)
        top = height_px - _HEAD_PX - _VIEW_PX - 58.0
        for each in rows:
            figure.text(
                _MARGIN_PX / _WIDTH_PX, (top - 18.0) / height_px, each.title, fontsize=12.5, weight="bold",
                color=each.color,
            )  # fmt: skip
            for i, place in enumerate(each.places):
                left = _MARGIN_PX + i * (_CROP_PX + _GAP_PX)
                bottom = top - _ROW_TITLE_PX - _CROP_PX
                box = (left / _WIDTH_PX, bottom / height_px, _CROP_PX / _WIDTH_PX, _CROP_PX / height_px)
                if each.misses:
                    _draw_miss(figure.add_axes(box), evidence, pictures, misses, int(place), _typical_side(voters))
                else:
                    _draw_vote(figure.add_axes(box), evidence, pictures, voters, int(place))
            top -= row_px
    return figure


def _rows(evidence: Evidence, voters: Voters, misses: Misses) -> list[_Row]:
    """Return the rows of crops: the passes with most votes, then the images that did not see the label."""
    numbers, count = np.unique(voters.pass_number, return_counts=True)
    shown = np.sort(numbers[np.lexsort((numbers, -count))][:_MOST_PASSES])
    rows = []
    for number in shown:
        places = np.flatnonzero(voters.pass_number == number)
        name = plain_line(evidence.pass_name(int(voters.image_row[places[0]])), 60)
        spread = evenly(places, _CROPS_PER_ROW)
        some = f", {len(spread)} of them" if len(spread) < len(places) else ""
        rows.append(
            _Row(
                f"Pass {name}: {number_of(len(places), 'vote')}{some}",
                spread,
                pass_color(int(number)),
            )
        )
    if len(shown) < len(numbers):
        others = int(count.sum() - count[np.isin(numbers, shown)].sum())
        last = rows[-1]
        rows[-1] = _Row(
            f"{last.title}   (and {len(numbers) - len(shown)} more passes with {others:,} votes)",
            last.places,
            last.color,
        )
    if len(misses):
        spread = evenly(np.arange(len(misses)), _CROPS_PER_ROW)
        some = f", {len(spread)} of them" if len(spread) < len(misses) else ""
        title = f"{number_of(len(misses), 'image')} that should have seen it and did not vote{some}"
        rows.append(_Row(title, spread, INK, misses=True))
    return rows


def _typical_side(voters: Voters) -> float:
    return max(LEAST_SIDE_PX, 4.0 * float(np.median(voters.size_px.max(axis=1)))) if len(voters) else 100.0


def _draw_head(figure: Figure, evidence: Evidence, row: int, voters: Voters, misses: Misses, height_px: float) -> None:
    labels = evidence.result.labels
    name = plain_line(labels.class_name.names[labels.class_name.codes[row]], 50)
    gone = "" if evidence.result.is_there[row] else ", gone"
    figure.text(
        _MARGIN_PX / _WIDTH_PX, 1.0 - 50.0 / height_px, f"Label {labels.label_id[row]}: {name}{gone}", fontsize=22,
        weight="bold",
    )  # fmt: skip
    passes = len(np.unique(voters.pass_number))
    seen = len(voters) + len(misses)
    facts = [f"{len(voters):,} of {seen:,} images that should have seen it, {number_of(passes, 'pass', 'passes')}"]
    if labels.existence is not None:
        facts.append(f"exists with probability {probability(labels.existence[row])}")
    if labels.state is not None:
        facts.append(f"state: {labels.state.names[labels.state.codes[row]]}")
    facts.append(f"reprojection rms {labels.reprojection_rms_px[row]:.2f} px")
    figure.text(_MARGIN_PX / _WIDTH_PX, 1.0 - 80.0 / height_px, ",  ".join(facts), fontsize=13)
    x, y, z = labels.position_in_world_m[row]
    where = f"x {x:.2f}  y {y:.2f}  z {z:.2f} m"
    if labels.lon_lat_height is not None:
        lon, lat, height = labels.lon_lat_height[row]
        where += f"     lat {lat:.7f}  lon {lon:.7f}  height {height:.2f} m"
    where += f"     about {labels.object_width_m[row]:.2f} x {labels.object_height_m[row]:.2f} m in size"
    figure.text(_MARGIN_PX / _WIDTH_PX, 1.0 - 104.0 / height_px, where, fontsize=12, color=FAINT_INK)


# How rays meet.


def _draw_views(figure: Figure, evidence: Evidence, row: int, voters: Voters, misses: Misses, height_px: float) -> None:
    """Draw where the label was seen from, and how the rays pass it, from above and from the side."""
    labels, frame = evidence.result.labels, evidence.result.frame
    axes_in_world, names = horizontal_axes(frame)
    up = np.array(frame.up)
    point = labels.position_in_world_m[row]
    bottom = (height_px - _HEAD_PX - _VIEW_PX) / height_px
    wide = _WIDTH_PX - 2 * _MARGIN_PX - 2 * (_VIEW_PX + 66.0)
    boxes = [
        (_MARGIN_PX + 34.0, wide - 34.0),
        (_MARGIN_PX + wide + 66.0, _VIEW_PX),
        (_MARGIN_PX + wide + 2 * 66.0 + _VIEW_PX, _VIEW_PX),
    ]
    views = [
        figure.add_axes((left / _WIDTH_PX, bottom, width / _WIDTH_PX, (_VIEW_PX - 30.0) / height_px))
        for left, width in boxes
    ]
    center = evidence.center_in_world_m[voters.image_row] - point
    direction = evidence.rays.direction_in_world[voters.detection_row]
    places = evenly(np.arange(len(voters)), _MOST_RAYS)
    from_above, down = center @ axes_in_world.T, direction @ axes_in_world.T
    mean = down.sum(axis=0)
    mean = mean / (np.linalg.norm(mean) or 1.0)
    from_side = np.stack([from_above @ mean, center @ up], axis=1)
    sideways = np.stack([down @ mean, direction @ up], axis=1)

    _draw_seen_from(views[0], evidence, row, voters, misses, axes_in_world)
    covariance_m2, along_up = labels.stated_covariance_m2[[row]], np.stack([mean @ axes_in_world, up])
    half_axes, angle = (each[0] for each in ellipses(covariance_m2, axes_in_world))
    side_axes, side_angle = (each[0] for each in ellipses(covariance_m2, along_up))
    reach = 4.0 * float(np.nanmax([*half_axes, *side_axes]))
    reach = min(max(reach, 0.25), 60.0) if math.isfinite(reach) else 5.0
    colors = [pass_color(int(number)) for number in voters.pass_number]
    for axes, origin, heading, (half, turn), what in (
        (views[1], from_above, down, (half_axes, angle), "Rays from above"),
        (views[2], from_side, sideways, (side_axes, side_angle), "Rays from the side"),
    ):
        _draw_rays(axes, origin[places], heading[places], [colors[i] for i in places], reach)
        _draw_ellipse(axes, half, turn)
        axes.set_title(what, pad=7)
    views[1].set_xlabel(f"{names[0].removesuffix(' (m)')} from the label (m)")
    views[1].set_ylabel(f"{names[1].removesuffix(' (m)')} from the label (m)")
    views[2].set_xlabel("along the mean direction of looking (m)")
    views[2].set_ylabel("up from the label (m)")


def _frame(axes: Axes) -> None:
    axes.set_facecolor(GROUND)
    axes.grid(visible=False)
    axes.tick_params(labelsize=9.5, length=3)
    axes.locator_params(nbins=5)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(RULE)


def _draw_seen_from(
    axes: Axes, evidence: Evidence, row: int, voters: Voters, misses: Misses, axes_in_world: Floats
) -> None:
    """Draw the cameras that voted, those that did not, and the labels around."""
    _frame(axes)
    labels = evidence.result.labels
    point = labels.position_in_world_m[row] @ axes_in_world.T
    cameras = evidence.center_in_world_m[voters.image_row] @ axes_in_world.T - point
    missed = evidence.center_in_world_m[misses.image_row] @ axes_in_world.T - point
    everything = np.concatenate([cameras, missed, np.zeros((1, 2))])
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, half = (low + high) / 2.0, max(4.0, 0.56 * float(np.max(high - low)))
    box = axes.get_window_extent()
    aspect = box.width / box.height
    spread = high - low
    half = max(0.56 * float(spread[1]), 0.56 * float(spread[0]) / aspect, 4.0)
    axes.set_xlim(middle[0] - half * aspect, middle[0] + half * aspect)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    for number in np.unique(voters.pass_number):
        of_pass = cameras[voters.pass_number == number]
        for x, y in of_pass[evenly(np.arange(len(of_pass)), 60)]:
            axes.plot([0.0, x], [0.0, y], color=pass_color(int(number)), linewidth=0.7, alpha=0.4, zorder=2)
        axes.plot(of_pass[:, 0], of_pass[:, 1], ".", color=pass_color(int(number)), markersize=5, zorder=3)
    axes.plot(missed[:, 0], missed[:, 1], "x", color=INK, markersize=4.5, alpha=0.8, zorder=3, label="did not vote")
    others = labels.position_in_world_m[evidence.result.is_there] @ axes_in_world.T - point
    axes.plot(others[:, 0], others[:, 1], "o", color="white", markeredgecolor=INK, markersize=5, zorder=4)
    axes.plot(0.0, 0.0, "o", color=BLUE, markeredgecolor="white", markersize=9, zorder=5)
    axes.set_title("Seen from: dots voted, crosses did not", pad=7)
    axes.set_xlabel("from the label (m)")


def _draw_rays(axes: Axes, origin: Floats, heading: Floats, colors: list[str], reach: float) -> None:
    from matplotlib.collections import LineCollection

    _frame(axes)
    length = np.linalg.norm(heading, axis=1, keepdims=True)
    heading = heading / np.where(length > 0.0, length, 1.0)
    far = np.linalg.norm(origin, axis=1, keepdims=True) + 4.0 * reach
    lines = np.stack([origin, origin + far * heading], axis=1)
    axes.add_collection(LineCollection(list(lines), colors=colors, linewidths=0.8, alpha=0.55, zorder=2), autolim=False)
    axes.set_xlim(-reach, reach)
    axes.set_aspect("equal", adjustable="box")
    axes.set_ylim(-reach, reach)


def _draw_ellipse(axes: Axes, half_axes_m: Floats, angle_rad: float) -> None:
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Ellipse

    if np.all(np.isfinite(half_axes_m)):
        axes.add_patch(
            Ellipse(
                (0.0, 0.0), *(2.0 * half_axes_m), angle=math.degrees(angle_rad), facecolor=to_rgba(BLUE, 0.22),
                edgecolor=BLUE, linewidth=1.6, zorder=3,
            )
        )  # fmt: skip
    axes.plot(0.0, 0.0, "o", color=BLUE, markeredgecolor="white", markersize=7, zorder=4)


# Crops.


def _draw_vote(axes: Axes, evidence: Evidence, pictures: Path | None, voters: Voters, i: int) -> None:
    crop = voter_crop(evidence, pictures, voters, i, round(_CROP_PX))
    image_row = int(voters.image_row[i])
    draw_crop(axes, evidence, crop, image_row, voters.projected_px[i], int(voters.detection_row[i]))
    name = _short_name(evidence, image_row)
    _caption(
        axes,
        name,
        f"{voters.residual_px[i]:.1f} px, {voters.residual_sigmas[i]:.1f} sigmas, {voters.distance_m[i]:.0f} m",
    )


def _draw_miss(axes: Axes, evidence: Evidence, pictures: Path | None, misses: Misses, i: int, side_px: float) -> None:
    crop = miss_crop(evidence, pictures, misses, i, side_px, round(_CROP_PX))
    image_row = int(misses.image_row[i])
    draw_crop(axes, evidence, crop, image_row, misses.projected_px[i], None)
    if not math.isfinite(misses.nearest_px[i]):
        why = "no detection of its class"
    elif misses.nearest_label[i] >= 0:
        why = f"{misses.nearest_px[i]:.0f} px to one of label {misses.nearest_label[i]}"
    else:
        why = f"{misses.nearest_px[i]:.0f} px to the next box"
    _caption(axes, _short_name(evidence, image_row), why)


def draw_crop(
    axes: Axes, evidence: Evidence, crop: Crop, image_row: int, point_px: Floats, detection_row: int | None
) -> None:
    """Draw a crop with all detections of its image in it, the one that counts in white, and the reprojected point."""
    from matplotlib.patches import Rectangle

    side = crop.pixels.shape[0]
    axes.imshow(crop.pixels, extent=(0, side, side, 0), interpolation="lanczos")
    axes.set_xlim(0, side)
    axes.set_ylim(side, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    detections = evidence.dataset.detections
    for row in evidence.detections_of_image(image_row):
        size = detections.size_px[row] * crop.px_per_px
        corner = crop.inside(detections.center_px[row]) - size / 2.0
        is_this = detection_row is not None and row == detection_row
        styles: list[dict[str, Any]] = [{"edgecolor": "black", "linewidth": 2.6, "alpha": 0.7}] if is_this else []
        styles.append({"edgecolor": "white", "linewidth": 1.3 if is_this else 0.8, "alpha": 1.0 if is_this else 0.55})
        for style in styles:
            axes.add_patch(Rectangle((corner[0], corner[1]), size[0], size[1], fill=False, **style))
    if np.all(np.isfinite(point_px)):
        x, y = crop.inside(point_px)
        for color, width in (("black", 3.2), (ORANGE, 1.8)):
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):  # Open in the middle, to hide nothing.
                axes.plot([x + 5 * dx, x + 13 * dx], [y + 5 * dy, y + 13 * dy], color=color, linewidth=width)


def _short_name(evidence: Evidence, image_row: int) -> str:
    name = "".join(c if c.isprintable() else " " for c in evidence.image_name(image_row))
    return name if len(name) <= 26 else f"…{name[-25:]}"


def _caption(axes: Axes, first: str, second: str) -> None:
    axes.text(0.0, -0.035, first, transform=axes.transAxes, fontsize=8.5, va="top", color=FAINT_INK)
    axes.text(0.0, -0.135, second, transform=axes.transAxes, fontsize=8.8, va="top")
