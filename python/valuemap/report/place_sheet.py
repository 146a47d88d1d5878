"""Why there is nothing at a place: what was looking there, what it saw, and the test that every hypothesis failed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.dataset import evenly
from valuemap.evidence import Evidence, Misses, PassingRays
from valuemap.rejected import figures_in_words
from valuemap.report.above import plain_line
from valuemap.report.crops import crop_at
from valuemap.report.ground import horizontal_axes
from valuemap.report.label_sheet import draw_crop, pass_color
from valuemap.report.style import BLUE, DPI, FAINT_INK, GREY, GROUND, INK, ORANGE, RULE, VERMILION, drawing, number_of
from valuemap.tables import Rejected
from valuemap.tables.map import REJECTION_REASONS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RADIUS_M = 2.0
"""Around a place: what is evaluated within as much is one object."""

_WIDTH_PX, _MARGIN_PX, _GAP_PX = 1600.0, 44.0, 14.0
_CROPS = 9
_CROP_PX = (_WIDTH_PX - 2 * _MARGIN_PX - (_CROPS - 1) * _GAP_PX) / _CROPS
_HEAD_PX, _VIEW_PX, _FOOT_PX = 96.0, 560.0, 66.0
_CROP_SIDE_PX = 140.0
_SHOWN_HYPOTHESES = 6
_SHOWN_RIVALS = 3
_TEXT_COLUMNS = 82


@dataclass(frozen=True, eq=False)
class PlaceAnswer:
    """What is known about a place.

    `point_in_world_m` is the place at the height where an object would most probably be; `reasons` says in sentences,
    the most important first, why there is no label, or which one there is.
    """

    point_in_world_m: Floats
    radius_m: float
    reasons: tuple[str, ...]
    looks: Misses
    passing: PassingRays
    hypotheses: Ints
    """Rows of the rejected hypotheses within the radius, those with most votes first."""
    labels: Ints
    """Rows of the labels within the radius, the nearest first."""
    figures: tuple[dict[str, Any], ...]
    """Of each of these hypotheses what a script may want to know."""

    def to_json(self) -> dict[str, Any]:
        """Return what a script may want to know."""
        free = self.passing.label_id < 0
        return {
            "point_in_world_m": [float(c) for c in self.point_in_world_m],
            "radius_m": self.radius_m,
            "images_that_picture_it": len(self.looks),
            "passes_that_picture_it": len(np.unique(self.looks.pass_number)),
            "detections_that_point_here": len(self.passing),
            "of_them_without_a_label": int(free.sum()),
            "rejected_hypotheses": list(self.figures),
            "labels_here": len(self.labels),
            "reasons": list(self.reasons),
        }


def place_in_world(evidence: Evidence, right_m: float, top_m: float) -> Floats:
    """Return the point (3) of a place on the picture from above, at the height of the cameras around."""
    basis, _ = horizontal_axes(evidence.result.frame)
    up = np.array(evidence.result.frame.up)
    ground = right_m * basis[0] + top_m * basis[1]
    near = evidence.images_around(ground, evidence.max_range_m, horizontally=True)
    centers = evidence.center_in_world_m[near] if len(near) else evidence.center_in_world_m
    return np.asarray(ground + float(np.median(centers @ up)) * up)


def explain_place(
    evidence: Evidence, point_in_world_m: Floats, rejected: Rejected | None, *, radius_m: float = RADIUS_M
) -> PlaceAnswer:
    """Say why there is no label within a horizontal distance of a place, whatever its height.

    Parameters
    ----------
    evidence
        The map and its dataset.
    point_in_world_m
        The place (3); its height counts only where nothing points to the place.
    rejected
        The rejected hypotheses of the map; None where it keeps none.
    radius_m
        How far from the place an object may be.
    """
    up = np.array(evidence.result.frame.up)
    passing = evidence.rays_past(point_in_world_m, radius_m=radius_m)
    hypotheses = _hypotheses_at(rejected, evidence, point_in_world_m, radius_m)
    labels = evidence.labels_around(point_in_world_m, radius_m)
    height = _height(evidence, point_in_world_m, passing, rejected, hypotheses, labels)
    point = np.asarray(point_in_world_m + (height - float(point_in_world_m @ up)) * up)
    looks = evidence.looks_at(point)
    reasons = [
        *_about_labels(evidence, point, labels),
        *_about_hypotheses(rejected, evidence, point, hypotheses),
        *_about_rays(evidence, point, passing, looks, radius_m),
    ]
    if rejected is None:
        reasons.append("The map keeps no rejected hypotheses; this is what its detections say.")
    figures = () if rejected is None else tuple(_figures(rejected, int(row)) for row in hypotheses)
    return PlaceAnswer(point, radius_m, tuple(reasons), looks, passing, hypotheses, labels, figures)


def _figures(rejected: Rejected, row: int) -> dict[str, Any]:
    def finite(column: Floats | None) -> float | None:
        return None if column is None or not math.isfinite(column[row]) else float(column[row])

    return {
        "hypothesis_id": int(rejected.hypothesis_id[row]),
        "class": rejected.class_name.names[rejected.class_name.codes[row]],
        "position_in_world_m": [float(c) for c in rejected.position_in_world_m[row]],
        "votes": int(rejected.votes[row]),
        "passes": int(rejected.passes[row]),
        "reason": rejected.reason.names[rejected.reason.codes[row]],
        "value": finite(rejected.value),
        "threshold": finite(rejected.threshold),
    }


def _hypotheses_at(rejected: Rejected | None, evidence: Evidence, point: Floats, radius_m: float) -> Ints:
    if rejected is None or len(rejected) == 0:
        return np.empty(0, np.int64)
    across = (rejected.position_in_world_m - point) @ evidence.result.frame.east_north().T
    distance = np.linalg.norm(across, axis=1)
    rows = np.flatnonzero(distance <= radius_m)
    return rows[np.lexsort((distance[rows], -rejected.votes[rows]))]


def _height(
    evidence: Evidence,
    point: Floats,
    passing: PassingRays,
    rejected: Rejected | None,
    hypotheses: Ints,
    labels: Ints,
) -> float:
    """Return the height along up at which an object would most probably be."""
    up = np.array(evidence.result.frame.up)
    if rejected is not None and len(hypotheses):
        return float(rejected.position_in_world_m[hypotheses[0]] @ up)
    if len(labels):
        return float(evidence.result.labels.position_in_world_m[labels[0]] @ up)
    free = passing.label_id < 0
    for rays in (passing.point_in_world_m[free], passing.point_in_world_m):
        if len(rays):
            return float(np.median(rays @ up))
    return float(point @ up)


# The reasons.


def _about_labels(evidence: Evidence, point: Floats, rows: Ints) -> list[str]:
    labels = evidence.result.labels
    reasons = []
    for row in rows[:_SHOWN_RIVALS]:
        across = (labels.position_in_world_m[row] - point) @ evidence.result.frame.east_north().T
        name = labels.class_name.names[labels.class_name.codes[row]]
        reasons.append(
            f"There is a label: {labels.label_id[row]} ({name}), {np.linalg.norm(across):.2f} m away, with "
            f"{labels.votes[row]} votes. valuemap show MAP {labels.label_id[row]} shows it."
        )
    return reasons


def _about_hypotheses(rejected: Rejected | None, evidence: Evidence, point: Floats, rows: Ints) -> list[str]:
    if rejected is None:
        return []
    if len(rows) == 0:
        return ["No rejected hypothesis of this map is near."]
    reasons = []
    for row in rows[:_SHOWN_HYPOTHESES]:
        across = (rejected.position_in_world_m[row] - point) @ evidence.result.frame.east_north().T
        code = rejected.reason.names[rejected.reason.codes[row]]
        name = rejected.class_name.names[rejected.class_name.codes[row]]
        votes = f"{rejected.votes[row]} {'vote' if rejected.votes[row] == 1 else 'votes'}"
        passes = f"{rejected.passes[row]} {'pass' if rejected.passes[row] == 1 else 'passes'}"
        expected = f", where {rejected.expected[row]} images should have seen it" if rejected.expected[row] > 0 else ""
        existence, figures = rejected.existence[row], figures_in_words(rejected, int(row))
        probability = f" Its probability of existence is {existence:.2f}." if math.isfinite(existence) else ""
        rival = (
            f" That is label {rejected.rival[row]}." if rejected.rival is not None and rejected.rival[row] >= 0 else ""
        )
        reasons.append(
            f"A hypothesis ({name}) {np.linalg.norm(across):.2f} m away had {votes} of {passes}{expected}. It was "
            f"rejected: {REJECTION_REASONS.get(code, code)}{f' ({figures})' if figures else ''}.{rival}{probability}"
        )
    if len(rows) > _SHOWN_HYPOTHESES:
        reasons.append(f"{len(rows) - _SHOWN_HYPOTHESES} more hypotheses with fewer votes were rejected here.")
    return reasons


def _about_rays(evidence: Evidence, point: Floats, passing: PassingRays, looks: Misses, radius_m: float) -> list[str]:
    """Say what pictures the place and what its detections vote for."""
    far = f"within {evidence.max_range_m:g} m"
    if len(looks) == 0 and len(passing) == 0:
        return [f"No image pictures this place {far}: nothing could be seen here."]
    passes = len(np.unique(looks.pass_number))
    verb = "pictures" if len(looks) == 1 else "picture"
    pictured = f"{number_of(len(looks), 'image')} of {number_of(passes, 'pass', 'passes')} {verb} it"
    if len(passing) == 0:
        return [
            f"{pictured} {far}. No detection points to within {radius_m:g} m of it: the detector found nothing here."
        ]
    point_there = f"{number_of(len(passing), 'detection')} {'points' if len(passing) == 1 else 'point'}"
    reasons = [f"{pictured} {far}. {point_there} to within {radius_m:g} m of it, at some height."]
    taken = passing.label_id[passing.label_id >= 0]
    ids, count = np.unique(taken, return_counts=True)
    for place in np.lexsort((ids, -count))[:_SHOWN_RIVALS]:
        position = evidence.result.labels.position_in_world_m[evidence.label_row(int(ids[place]))]
        number = int(count[place])
        away = np.linalg.norm((position - point) @ evidence.result.frame.east_north().T)
        reasons.append(f"{number_of(number, 'detection')} {_verb(number)} for label {ids[place]}, {away:.1f} m away.")
    free = np.flatnonzero(passing.label_id < 0)
    if len(free) == 0:
        reasons.append("None of them is left over: all vote for other labels.")
        return reasons
    images = len(np.unique(passing.image_row[free]))
    reasons.append(
        f"{number_of(len(free), 'detection')} in {number_of(images, 'image')} of "
        f"{number_of(len(np.unique(passing.pass_number[free])), 'pass', 'passes')} {_verb(len(free))} for nothing."
    )
    reasons += _missing(evidence, passing, free, images)
    return reasons


def _missing(evidence: Evidence, passing: PassingRays, free: Ints, images: int) -> list[str]:
    """Say which plain test the detections that are left over fail."""
    settings = evidence.result.run.get("settings", {})
    reasons = []
    least = settings.get("min_votes")
    if isinstance(least, int | float) and images < least:
        few = settings.get("least_votes")
        but = ", or of fewer where others of its class tell height and size (least_votes)"
        makes_up = but if isinstance(few, int) and few < least else ""
        reasons.append(f"A label needs votes of {least} images (min_votes){makes_up}.")
    parallax = settings.get("min_parallax_deg")
    direction = evidence.rays.direction_in_world[passing.detection_row[free]]
    direction = direction[np.isfinite(direction[:, 0])]
    if isinstance(parallax, int | float) and len(direction) > 1:
        middle = direction.mean(axis=0)
        extreme = direction[np.argsort(direction @ middle)[:64]]
        widest = math.degrees(math.acos(float(np.clip((extreme @ extreme.T).min(), -1.0, 1.0))))
        if widest < parallax:
            reasons.append(
                f"Their rays differ by at most {widest:.1f} degrees, a position needs {parallax:g} (min_parallax_deg)."
            )
    height = passing.point_in_world_m[free] @ np.array(evidence.result.frame.up)
    if len(height) > 2 and float(np.quantile(height, 0.75) - np.quantile(height, 0.25)) > 1.5:
        reasons.append(
            f"They pass the place at heights from {height.min():.1f} to {height.max():.1f} m, not in one point."
        )
    return reasons


def _verb(count: int) -> str:
    return "votes" if count == 1 else "vote"


# The picture.


def plot_place(
    evidence: Evidence, answer: PlaceAnswer, rejected: Rejected | None, pictures: Path | None = None
) -> Figure:
    """Return the picture of a place: what points there from above, the reasons, crops of images that picture it."""
    from matplotlib.figure import Figure  # Slow to import, and only pictures need it.

    basis, names = horizontal_axes(evidence.result.frame)
    point = answer.point_in_world_m
    shown = _shown_looks(answer)
    crops_px = _CROP_PX + 40.0 if len(shown) else 0.0
    height_px = _HEAD_PX + _VIEW_PX + crops_px + _FOOT_PX
    right, top = point @ basis.T
    with drawing():
        figure = Figure(figsize=(_WIDTH_PX / DPI, height_px / DPI), dpi=DPI, facecolor="white")
        figure.text(
            _MARGIN_PX / _WIDTH_PX, 1.0 - 50.0 / height_px,
            f"What is at {names[0].removesuffix(' (m)')} {right:.1f}, {names[1].removesuffix(' (m)')} {top:.1f} m?",
            fontsize=22, weight="bold",
        )  # fmt: skip
        bottom = (height_px - _HEAD_PX - _VIEW_PX) / height_px
        left = (_MARGIN_PX + 34.0) / _WIDTH_PX
        axes = figure.add_axes((left, bottom + 30.0 / height_px, _VIEW_PX / _WIDTH_PX, (_VIEW_PX - 30.0) / height_px))
        _draw_place(axes, evidence, answer, rejected, basis, names)
        y = height_px - _HEAD_PX - 14.0
        for reason in answer.reasons:
            for i, line in enumerate(_wrapped(reason, _TEXT_COLUMNS)):
                figure.text(
                    (_MARGIN_PX + _VIEW_PX + 84.0 + (0.0 if i == 0 else 14.0)) / _WIDTH_PX, y / height_px,
                    f"•  {line}" if i == 0 else line, fontsize=12.5,
                )  # fmt: skip
                y -= 24.0
            y -= 8.0
        for i, look in enumerate(shown):
            box_left = _MARGIN_PX + i * (_CROP_PX + _GAP_PX)
            crop_axes = figure.add_axes(
                (box_left / _WIDTH_PX, _FOOT_PX / height_px, _CROP_PX / _WIDTH_PX, _CROP_PX / height_px)
            )
            _draw_look(crop_axes, evidence, answer, pictures, int(look))
    return figure


def _shown_looks(answer: PlaceAnswer) -> Ints:
    """Return the images (places in `looks`) to show: those with a detection that is left over first."""
    pointing = np.flatnonzero(np.isin(answer.looks.image_row, answer.passing.image_row[answer.passing.label_id < 0]))
    others = np.setdiff1d(np.arange(len(answer.looks)), pointing)
    first = evenly(pointing, _CROPS)
    return np.concatenate([first, evenly(others, _CROPS - len(first))])


def _draw_look(axes: Axes, evidence: Evidence, answer: PlaceAnswer, pictures: Path | None, look: int) -> None:
    looks = answer.looks
    image_row, pixel = int(looks.image_row[look]), looks.projected_px[look]
    here = answer.passing.detection_row[answer.passing.image_row == image_row]
    side = _CROP_SIDE_PX
    if len(here):
        apart = np.abs(evidence.dataset.detections.center_px[here[0]] - pixel)
        side = max(side, 2.4 * min(float(np.nan_to_num(apart.max())), 1000.0))
    crop = crop_at(evidence, pictures, image_row, pixel, side, round(_CROP_PX))
    draw_crop(axes, evidence, crop, image_row, pixel, int(here[0]) if len(here) else None)
    name = plain_line(evidence.image_name(image_row), 400)
    axes.text(
        0.0, -0.035, name if len(name) <= 26 else f"…{name[-25:]}", transform=axes.transAxes, fontsize=8.5, va="top",
        color=FAINT_INK,
    )  # fmt: skip
    what = "points here" if len(here) else "no box here"
    axes.text(0.0, -0.135, f"{what}, {looks.distance_m[look]:.0f} m", transform=axes.transAxes, fontsize=8.8, va="top")


def _draw_place(
    axes: Axes,
    evidence: Evidence,
    answer: PlaceAnswer,
    rejected: Rejected | None,
    basis: Floats,
    names: tuple[str, str],
) -> None:
    from matplotlib.patches import Circle

    point = answer.point_in_world_m @ basis.T
    reach = max(12.0, 5.0 * answer.radius_m)
    if len(answer.passing) == 0 and len(answer.looks):  # Nothing points here: what looks here is what there is to see.
        reach = max(reach, 1.1 * float(np.median(answer.looks.distance_m)))
    axes.set_facecolor(GROUND)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(RULE)
    passing = answer.passing
    direction = evidence.rays.direction_in_world[passing.detection_row] @ basis.T
    center = evidence.center_in_world_m[passing.image_row] @ basis.T
    for i in range(min(len(passing), 300)):
        end = center[i] + direction[i] * (passing.distance_m[i] + 4.0 * reach)
        is_free = passing.label_id[i] < 0
        color = pass_color(int(passing.pass_number[i])) if is_free else GREY
        axes.plot(
            [center[i, 0], end[0]], [center[i, 1], end[1]], color=color, linewidth=1.1 if is_free else 0.6,
            alpha=0.8 if is_free else 0.35, zorder=2,
        )  # fmt: skip
    free = passing.label_id < 0
    if np.any(free):
        color = pass_color(int(passing.pass_number[free][0]))
        axes.plot([], [], color=color, linewidth=1.4, label="rays that vote for nothing")
    if not np.all(free):
        axes.plot([], [], color=GREY, linewidth=1.4, label="rays that vote for labels")

    def draw(points: Floats, marker: str, text: str, **style: Any) -> None:
        inside = points[np.all(np.abs(points - point) <= reach, axis=1)]
        if len(inside):  # The legend explains what is there.
            axes.plot(inside[:, 0], inside[:, 1], marker, label=text, zorder=4, **style)

    cameras = evidence.center_in_world_m[answer.looks.image_row] @ basis.T
    draw(cameras, ".", "cameras that picture it", color=FAINT_INK, markersize=4.5)
    labels, is_there = evidence.result.labels.position_in_world_m @ basis.T, evidence.result.is_there
    draw(labels[is_there], "o", "labels", color=BLUE, markeredgecolor="white", markersize=8)
    draw(labels[~is_there], "x", "labels that are gone", color=GREY, markeredgewidth=1.4, markersize=7)
    if rejected is not None:
        position = rejected.position_in_world_m @ basis.T
        draw(position, "X", "rejected hypotheses", color=VERMILION, markeredgecolor="white", markersize=8)
    axes.add_patch(Circle((point[0], point[1]), answer.radius_m, fill=False, edgecolor=INK, linestyle="--", zorder=5))
    axes.plot(*point, "+", color=ORANGE, markersize=16, markeredgewidth=2.4, zorder=6, label="the place")
    axes.set_xlim(point[0] - reach, point[0] + reach)
    axes.set_ylim(point[1] - reach, point[1] + reach)
    axes.set_aspect("equal")
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    axes.tick_params(labelsize=9.5)
    axes.set_title("From above", pad=7)
    axes.legend(loc="lower left", fontsize=9.5, frameon=True, facecolor="white", framealpha=0.85, edgecolor="none")


def _wrapped(text: str, columns: int) -> list[str]:
    lines = [""]
    for word in plain_line(text, 2000).split(" "):
        if lines[-1] and len(lines[-1]) + 1 + len(word) > columns:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return lines
