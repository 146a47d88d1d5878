"""The picture of a map from above: streets, labels with their true uncertainty, true objects, what is wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.dataset import Dataset
from valuemap.map_folder import Map, expect_map
from valuemap.report.ground import Ground, Outcomes, busiest_place, closest_pair, extent_of, look_down, thinned
from valuemap.report.style import (
    BLACK,
    BLUE,
    DPI,
    FAINT_INK,
    GREEN,
    GREY,
    GROUND,
    INK,
    ORANGE,
    PURPLE,
    RULE,
    SKY,
    STREET,
    STREET_EDGE,
    TRACK,
    VERMILION,
    YELLOW,
    check_format,
    drawing,
    number_of,
    plain,
    save_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH_PX = 1600.0
_HEAD_PX, _FOOT_PX, _LEFT_PX, _RIGHT_PX, _GAP_PX = 122, 64, 84, 28, 66
_LENS_PX = (300.0, 420.0)
"""Side of a lens: two of them are as high as the main view beside them, and that as high as its content needs."""
_WIDE_PX = (230, 560)
"""Height of a main view above the lenses, for what is more than twice as wide as high."""
_LEAST_WIDTH_PX = 380
_WIDE_ASPECT = 2.2

_STREET_WIDTH_M = 9.0
_LENS_SHARE, _LENS_M = 1 / 8, (24.0, 60.0)
"""The first lens shows this share of the map's extent, within these bounds."""
_CLOSE_M = (1.5, 12.0)
"""The second lens is as wide as ellipses in true scale are seen well in it, within these bounds."""
_ELLIPSE_SHARE = 0.16
"""Half axis that the median ellipse has in the second lens, as a share of its side."""
_TRACKS_BELOW_M_PER_PX = 1.0
_LENS_MARKER_SCALE = 1.3
_SHOWN_CLASSES = 8
_SEGMENTEND_ROWS, _SEGMENTEND_ROW_PX = 3, 30.0

_NO_ROWS = np.empty(0, np.int64)


@dataclass(frozen=True)
class _Style:
    """How points look, and what the legend calls them."""

    text: str
    marker: str
    size_pt: float
    edge: str
    face: str = "none"
    edge_width_pt: float = 1.2
    min_scale: float = 0.0
    """Markers shrink where there are many labels, but a few that are wrong must stay visible."""


_OBJECT_STYLES = {
    "found": _Style("true object, found", "o", 11, GREEN, edge_width_pt=1.4),
    "missed": _Style("true object, missed", "s", 12, VERMILION, edge_width_pt=2.2, min_scale=0.6),
    "not recoverable": _Style("true object, not recoverable", "s", 8, GREY),
}
_MISTAKE_STYLES = {
    "duplicate": _Style("duplicate label", "^", 12, ORANGE, edge_width_pt=2.2, min_scale=0.8),
    "false": _Style("false label", "X", 10, "white", VERMILION, edge_width_pt=0.6, min_scale=0.8),
}
_GONE_STYLE = _Style("label, gone", "x", 6, GREY, edge_width_pt=1.4)
# By number of labels: the most frequent class is the first.
_CLASS_MARKS = (
    ("o", BLUE, 5.0),
    ("D", PURPLE, 5.0),
    ("^", SKY, 6.5),
    ("s", YELLOW, 5.0),
    ("v", BLACK, 6.5),
    ("P", "#7a5195", 6.5),
    ("*", "#8c564b", 8.5),
    ("o", GREY, 5.0),
)


@dataclass(frozen=True)
class _Window:
    """A part of the ground and how many metres of it one pixel shows."""

    left: float
    right: float
    bottom: float
    top: float
    meters_per_px: float


@dataclass(frozen=True)
class _Layout:
    """Where the views are, px from the lower left corner: (left, bottom, width, height)."""

    width_px: float
    height_px: float
    main: tuple[float, float, float, float]
    lenses: tuple[tuple[float, float, float, float], ...]
    legend: tuple[float, float]
    """Upper left corner."""


def draw_map(
    result: Map, dataset: Dataset | None, matches: Outcomes | None, path: str | Path, *, force: bool = False
) -> None:
    """Draw a map from above as PNG or SVG, as the suffix says; same input, same bytes.

    Parameters
    ----------
    result
        The map: labels by class, in the lenses with the 95 % ellipses of their horizontal covariance, in true scale.
    dataset
        The images it was made from: where they were taken shows the streets.
    matches
        What became of labels and true objects; without it labels are drawn alone.
    path
        The file to write.

    Raises
    ------
    OutputError
        The suffix is neither .png nor .svg, or the place cannot be written.
    """
    check_format(Path(path))
    save_figure(plot_map(result, dataset, matches), Path(path), force=force)


def plot_map(result: Map, dataset: Dataset | None = None, matches: Outcomes | None = None) -> Figure:
    """Return the picture that `draw_map` writes, as a figure of matplotlib."""
    from matplotlib.figure import Figure  # Slow to import, and only pictures need it.

    expect_map(result)
    ground = look_down(result, dataset, matches)
    low, size, left_out = extent_of(ground)
    lenses = 0 if len(ground.all_points()) == 0 else 2 if len(ground.label_points) else 1
    with drawing():
        entries = _legend_entries(ground, left_out)
        layout = _layout(size, lenses, 24.0 + _SEGMENTEND_ROW_PX * min(len(entries), _SEGMENTEND_ROWS))
        figure = Figure(figsize=(layout.width_px / DPI, layout.height_px / DPI), dpi=DPI, facecolor="white")
        _draw_head(figure, layout, result, dataset)
        main = _axes_at(figure, layout, layout.main)
        whole = _fitted(main, low + size / 2.0, size)
        _draw_ground(main, ground, whole, _marker_scale(len(result.labels)))
        main.set_xlabel(ground.axis_names[0])
        main.set_ylabel(ground.axis_names[1])
        if result.frame.is_georeferenced:
            _draw_north(main)
        _draw_lenses(figure, layout, main, ground, whole)
        _draw_legend(figure, layout, entries)
    return figure


# Where things are.


def _layout(size_m: Floats, lenses: int, legend_px: float) -> _Layout:
    """Put the main view beside the lenses, or above them where it is much wider than high."""
    aspect = float(size_m[0] / size_m[1])
    if aspect > _WIDE_ASPECT:
        width = _WIDTH_PX - _LEFT_PX - _RIGHT_PX
        height, lens = float(np.clip(width / aspect, *_WIDE_PX)), _LENS_PX[1]
        bottom = _FOOT_PX + lens + 1.6 * _GAP_PX
        squares = tuple((_LEFT_PX + i * (lens + _GAP_PX), float(_FOOT_PX), lens, lens) for i in range(lenses))
        legend = (_LEFT_PX + lenses * (lens + _GAP_PX), _FOOT_PX + lens + 8.0)
        return _Layout(_WIDTH_PX, bottom + height + _HEAD_PX, (_LEFT_PX, bottom, width, height), squares, legend)
    lens, height = _LENS_PX[1], 0.0
    for _ in range(2):  # The lenses are as high as the main view, which is as high as the width that they leave.
        width_left = _WIDTH_PX - _LEFT_PX - _RIGHT_PX - lens - _GAP_PX
        height = float(np.clip(width_left / aspect, 2 * _LENS_PX[0] + _GAP_PX, 2 * _LENS_PX[1] + _GAP_PX))
        lens = (height - _GAP_PX) / 2.0
    width = float(np.clip(height * aspect, _LEAST_WIDTH_PX, width_left))
    lens_left, bottom = _LEFT_PX + width + _GAP_PX, _FOOT_PX + legend_px
    squares = tuple((lens_left, bottom + height - (i + 1) * lens - i * _GAP_PX, lens, lens) for i in range(lenses))
    return _Layout(
        lens_left + lens + _RIGHT_PX,
        bottom + height + _HEAD_PX,
        (_LEFT_PX, bottom, width, height),
        squares,
        (_LEFT_PX - 10.0, legend_px + 8.0),
    )


def _axes_at(figure: Figure, layout: _Layout, box_px: tuple[float, float, float, float]) -> Axes:
    left, bottom, width, height = box_px
    return figure.add_axes(
        (left / layout.width_px, bottom / layout.height_px, width / layout.width_px, height / layout.height_px)
    )


def _fitted(axes: Axes, center: Floats, size: Floats, *, inside: _Window | None = None) -> _Window:
    """Return the least window of the axes' proportions around a rectangle (size (2), m), moved `inside`."""
    box = axes.get_window_extent()
    meters_per_px = float(max(size[0] / box.width, size[1] / box.height))
    half = 0.5 * meters_per_px * np.array([box.width, box.height])
    if inside is not None:
        low, high = np.array([inside.left, inside.bottom]), np.array([inside.right, inside.top])
        center = np.clip(center, np.minimum(low + half, high), np.maximum(high - half, low))
    (left, bottom), (right, top) = center - half, center + half
    return _Window(float(left), float(right), float(bottom), float(top), meters_per_px)


def _inside(points: Floats, window: _Window) -> Ints:
    """Return the rows of the points (N, 2) in a window."""
    low, high = (window.left, window.bottom), (window.right, window.top)
    return np.flatnonzero(np.all((points >= low) & (points <= high), axis=1))


def _marker_scale(labels: int) -> float:
    """Return how large markers are: smaller where there are many labels."""
    return float(np.clip(np.sqrt(200.0 / max(labels, 1)), 0.35, 1.0))


def _close_side_m(half_axes_m: Floats, apart_m: float) -> float:
    """Return how wide the second lens is: so that two labels that far apart are in it and their ellipses are seen."""
    major = half_axes_m[:, 0]
    major = major[np.isfinite(major) & (major > 0.0)]
    typical = float(np.median(major)) if len(major) else 0.0
    return float(np.clip(max(typical / _ELLIPSE_SHARE, 2.2 * apart_m), *_CLOSE_M))


# Drawing.


def _draw_head(figure: Figure, layout: _Layout, result: Map, dataset: Dataset | None) -> None:
    left, height = _LEFT_PX / layout.width_px, layout.height_px
    name = dataset.name if dataset is not None else str(result.run.get("dataset", "map"))
    figure.text(left, 1.0 - 52 / height, plain_line(name, 70), fontsize=22, weight="bold", parse_math=False)
    figure.text(left, 1.0 - 84 / height, _summary(result, dataset), fontsize=13, color=FAINT_INK)


def plain_line(text: str, most: int) -> str:
    """Return a user's text as one line of at most so many characters."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return line if len(line) <= most else line[: most - 1] + "…"


def _summary(result: Map, dataset: Dataset | None) -> str:
    gone = int(np.sum(~result.is_there))
    labels = number_of(len(result.labels) - gone, "label") + (f", {gone:,} more that are gone," if gone else "")
    if dataset is None:
        return f"{labels} with {len(result.votes):,} votes"
    passes = len(np.unique(dataset.images.pass_id.codes))
    return (
        f"{labels} from {len(dataset.detections):,} detections in "
        f"{len(dataset.images):,} images of {number_of(passes, 'pass', 'passes')}"
    )


def _draw_ground(axes: Axes, ground: Ground, window: _Window, marker_scale: float) -> None:
    axes.set_facecolor(GROUND)
    axes.grid(visible=False)
    axes.set_xlim(window.left, window.right)
    axes.set_ylim(window.bottom, window.top)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=9.5, length=3)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(RULE)
    _draw_streets(axes, ground, window)
    axes.locator_params(nbins=6 if window.meters_per_px > _CLOSE_M[1] / _LENS_PX[0] else 4)
    _draw_labels(axes, ground, window, marker_scale)
    _draw_scale_bar(axes, window)


def _draw_streets(axes: Axes, ground: Ground, window: _Window) -> None:
    from matplotlib.collections import LineCollection

    drives = [_thinned(drive, window) for drive in ground.drives]
    street_pt = float(np.clip(_STREET_WIDTH_M / window.meters_per_px * 72 / DPI, 2.5, 400.0))
    layers = [(STREET_EDGE, street_pt + 2.0, [*drives, *ground.joins]), (STREET, street_pt, [*drives, *ground.joins])]
    if window.meters_per_px < _TRACKS_BELOW_M_PER_PX:
        layers.append((TRACK, 0.6, drives))
    for color, width_pt, lines in layers:
        axes.add_collection(
            LineCollection(lines, colors=color, linewidths=width_pt, capstyle="round", joinstyle="round", zorder=1),
            autolim=False,
        )


def _thinned(line: Floats, window: _Window) -> Floats:
    """Return a line without points that are within a pixel of the last one; a single point stays visible."""
    thin = thinned(line, window.meters_per_px)
    return np.repeat(thin, 2, axis=0) if len(thin) == 1 else thin


def _draw_labels(axes: Axes, ground: Ground, window: _Window, marker_scale: float) -> None:
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import to_rgba

    for outcome, style in _OBJECT_STYLES.items():
        points = ground.object_points[ground.objects.get(outcome, _NO_ROWS)]
        _draw_points(axes, points, style, marker_scale, zorder=3)
        axes.plot(points[:, 0], points[:, 1], ".", color=style.edge, markersize=2.0 * marker_scale, zorder=3)
    for style, rows in _class_groups(ground):
        visible = rows[ground.half_axes_m[rows, 0] > window.meters_per_px]  # Smaller ones are under the marker.
        width, height = 2.0 * ground.half_axes_m[visible].T
        axes.add_collection(
            EllipseCollection(
                width,
                height,
                np.degrees(ground.angle_rad[visible]),
                units="xy",
                offsets=ground.label_points[visible],
                transOffset=axes.transData,
                linewidths=0.9,
                zorder=2,
                facecolor=to_rgba(style.face, 0.18),
                edgecolor=to_rgba(style.face, 0.75),
            ),
            autolim=False,
        )
        _draw_points(axes, ground.label_points[rows], style, marker_scale, zorder=4)
    _draw_points(axes, ground.label_points[~ground.is_there], _GONE_STYLE, marker_scale, zorder=4)
    for outcome, style in _MISTAKE_STYLES.items():
        rows = (ground.outcomes or {}).get(outcome, _NO_ROWS)
        _draw_points(axes, ground.label_points[rows], style, marker_scale, zorder=5)


def _class_groups(ground: Ground) -> list[tuple[_Style, Ints]]:
    """Return the labels that are there of each class, the most frequent first; the rarest classes share one style."""
    names = ground.label_class.names
    codes = np.where(ground.is_there, ground.label_class.codes, -1)
    count = np.bincount(codes[ground.is_there], minlength=len(names))
    ranked = [code for code in sorted(range(len(names)), key=lambda code: (-count[code], names[code])) if count[code]]
    own = ranked if len(ranked) <= _SHOWN_CLASSES else ranked[: _SHOWN_CLASSES - 1]
    groups = []
    for (marker, color, size_pt), code in zip(_CLASS_MARKS, own, strict=False):
        style = _Style(plain_line(names[code], 34), marker, size_pt, "white", color, edge_width_pt=0.5)
        groups.append((style, np.flatnonzero(codes == code)))
    if len(own) < len(ranked):
        marker, color, size_pt = _CLASS_MARKS[-1]
        style = _Style(f"{len(ranked) - len(own)} other classes", marker, size_pt, "white", color, edge_width_pt=0.5)
        groups.append((style, np.flatnonzero(np.isin(codes, ranked[len(own) :]))))
    return groups


def _draw_points(axes: Axes, points: Floats, style: _Style, marker_scale: float, *, zorder: float) -> None:
    axes.plot(points[:, 0], points[:, 1], zorder=zorder, **_marker(style, marker_scale, len(points)))


def _marker(style: _Style, scale: float, count: int = 1) -> dict[str, Any]:
    scale = max(scale, min(style.min_scale, _marker_scale(count)))
    return {
        "linestyle": "none",
        "marker": style.marker,
        "markersize": style.size_pt * scale,
        "markerfacecolor": style.face,
        "markeredgecolor": style.edge,
        "markeredgewidth": style.edge_width_pt * max(scale, 0.6),
    }


def _draw_scale_bar(axes: Axes, window: _Window) -> None:
    """Draw a bar of a round length, at most a quarter of the width, into the lower right corner."""
    most = 0.25 * (window.right - window.left)
    power = 10.0 ** math.floor(math.log10(most))
    length = next(factor * power for factor in (5.0, 2.0, 1.0) if factor * power <= most)
    height_px = (window.top - window.bottom) / window.meters_per_px
    right, bottom = 0.97, 14.0 / height_px
    share = length / (window.right - window.left)
    for color, width_pt in (("white", 5.0), (INK, 2.0)):
        axes.plot(
            [right - share, right],
            [bottom, bottom],
            transform=axes.transAxes,
            color=color,
            linewidth=width_pt,
            solid_capstyle="butt",
            zorder=6,
        )
    text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    box = {"facecolor": GROUND, "edgecolor": "none", "pad": 1.0, "alpha": 0.8}
    axes.text(
        right - share / 2,
        bottom + 7.0 / height_px,
        text,
        transform=axes.transAxes,
        ha="center",
        va="bottom",
        fontsize=9.5,
        zorder=6,
        bbox=box,
    )


def _draw_north(axes: Axes) -> None:
    height = axes.get_window_extent().height
    axes.annotate(
        "",
        xy=(0.025, 1.0 - 14.0 / height),
        xytext=(0.025, 1.0 - 48.0 / height),
        xycoords="axes fraction",
        arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.4},
    )
    axes.text(
        0.025, 1.0 - 62.0 / height, "N", transform=axes.transAxes, ha="center", va="center", fontsize=10, weight="bold"
    )


def _draw_lenses(figure: Figure, layout: _Layout, main: Axes, ground: Ground, whole: _Window) -> None:
    """Draw the busiest place, and in it the closest labels, where one sees ellipses as they are."""
    if not layout.lenses:
        return
    extent = max(whole.right - whole.left, whole.top - whole.bottom)
    side = float(np.clip(_LENS_SHARE * extent, *_LENS_M))
    points = ground.all_points()
    first = _axes_at(figure, layout, layout.lenses[0])
    busy = _fitted(first, busiest_place(points, side), np.array([side, side]), inside=whole)
    _draw_ground(first, ground, busy, _LENS_MARKER_SCALE)
    first.set_title("The busiest place", pad=7)
    _connect(figure, main, first, busy)
    rows = _inside(ground.label_points, busy)
    if len(layout.lenses) < 2:
        return
    if len(rows) == 0:  # The busiest place has true objects only.
        rows = np.arange(len(ground.label_points))
    middle, apart = closest_pair(ground.label_points[rows])
    second = _axes_at(figure, layout, layout.lenses[1])
    side = _close_side_m(ground.half_axes_m[rows], apart)
    close = _fitted(second, middle, np.array([side, side]))
    _draw_ground(second, ground, close, _LENS_MARKER_SCALE)
    second.set_title("Closer, ellipses of 95 %", pad=7)
    _connect(figure, first, second, close)


def _connect(figure: Figure, outer: Axes, lens: Axes, window: _Window) -> None:
    """Mark a window in the view that it is a part of, and join it with the lens that shows it."""
    from matplotlib.patches import ConnectionPatch, Rectangle

    corner, width, height = (window.left, window.bottom), window.right - window.left, window.top - window.bottom
    outer.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=INK, linewidth=1.0, zorder=7))
    a, b = outer.get_window_extent(), lens.get_window_extent()
    if b.x0 > a.x1:  # The lens is to the right.
        ends = [((window.right, window.bottom), (0.0, 0.0)), ((window.right, window.top), (0.0, 1.0))]
    else:
        ends = [((window.left, window.bottom), (0.0, 1.0)), ((window.right, window.bottom), (1.0, 1.0))]
    for here, there in ends:
        patch = ConnectionPatch(
            here, there, "data", "axes fraction", axesA=outer, axesB=lens, color=INK, linewidth=0.6, alpha=0.45
        )
        patch.set_in_layout(False)
        figure.add_artist(patch)


def _legend_entries(ground: Ground, left_out: int) -> list[Any]:
    """Return what the legend explains: only what is there."""
    from matplotlib.lines import Line2D

    entries: list[Any] = []
    if ground.drives:
        entries.append(Line2D([], [], color=STREET_EDGE, linewidth=7, label="driven streets"))

    def add(style: _Style, rows: Ints, what: str = "") -> None:
        if len(rows):
            marker = _marker(style, _LENS_MARKER_SCALE)
            entries.append(Line2D([], [], label=f"{what}{style.text} ({len(rows):,})", **marker))

    for style, rows in _class_groups(ground):
        add(style, rows, "label: ")
    add(_GONE_STYLE, np.flatnonzero(~ground.is_there))
    for outcome, style in _MISTAKE_STYLES.items():
        add(style, (ground.outcomes or {}).get(outcome, _NO_ROWS))
    for outcome, style in _OBJECT_STYLES.items():
        add(style, ground.objects.get(outcome, _NO_ROWS))
    if left_out:
        entries.append(Line2D([], [], linestyle="none", label=f"{left_out:,} far away, not shown"))
    return entries


def _draw_legend(figure: Figure, layout: _Layout, entries: list[Any]) -> None:
    if not entries:
        return
    is_below = layout.legend[0] < layout.main[0]
    legend = figure.legend(
        handles=entries,
        loc="upper left",
        bbox_to_anchor=(layout.legend[0] / layout.width_px, layout.legend[1] / layout.height_px),
        fontsize=12.5,
        ncols=max(1, math.ceil(len(entries) / _SEGMENTEND_ROWS)) if is_below else 1,
        borderaxespad=0.0,
        labelspacing=0.75,
        columnspacing=2.2,
    )
    for text in legend.get_texts():
        plain(text)
