"""The picture of a map from above: streets, true objects, labels with their uncertainty, what is wrong."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, Frame
from valuemap.folders import new_file
from valuemap.map_folder import Map
from valuemap.tables import Categories, Floats, Images, Ints

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 100
_WIDTH_PX = 1600
_MAIN_LEFT_PX, _MAIN_BOTTOM_PX, _MAIN_WIDTH_PX = 92, 66, 1012
_MAIN_HEIGHT_PX = (840, 1012)
"""The main view is as high as its content needs, within these bounds; head and foot come on top."""
_HEAD_PX = 102
_DETAIL_LEFT_PX, _DETAIL_SIDE_PX = 1168, 414
_ELLIPSE_SIGMAS = 2.4477468306808161
"""Half axis of the ellipse that holds 95 % of a 2D normal distribution: sqrt(chi2.ppf(0.95, 2))."""
_ELLIPSE_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ELLIPSE_PX = (12.0, 60.0)
"""Ellipses are drawn larger than they are until the median half axis has the first length, but not so large
that a tenth of them exceed the second; where markers are smaller, so are both lengths."""
_DETAIL_MARKER_SCALE = 1.3
_STREET_WIDTH_M = 9.0
_DETAIL_SHARE = 1 / 8
_DETAIL_M = (24.0, 60.0)
"""The detail shows this share of the map's extent, within these bounds."""

_NO_ROWS = np.empty(0, np.int64)
_STREET = "#e4e4e4"
_TRACK = "#b8b8b8"
_INK = "#333333"
# Okabe and Ito's colours, which people with any kind of colour vision can tell apart.
_BLUE, _ORANGE, _VERMILION, _GREEN = "#0072B2", "#E69F00", "#D55E00", "#009E73"


class Outcomes(Protocol):
    """What the picture needs of a comparison with the truth (`valuemap.evaluate.Matches` has it)."""

    @property
    def object_in_world_m(self) -> Floats:
        """Positions (objects, 3) of the true objects."""

    @property
    def object_outcome(self) -> Categories:
        """found, missed or not recoverable (objects)."""

    @property
    def label_outcome(self) -> Categories:
        """true, duplicate or false (labels)."""


@dataclass(frozen=True)
class _Style:
    """How the points of one outcome look, and what the legend calls them."""

    text: str
    marker: str
    size_pt: float
    edge: str
    face: str = "none"
    edge_width_pt: float = 1.2
    min_scale: float = 0.0
    """Markers shrink where there are many, but what is wrong must stay visible."""


_OBJECT_STYLES = {
    "found": _Style("true object, found", "o", 11, _GREEN, edge_width_pt=1.4),
    "missed": _Style("true object, missed", "s", 12, _VERMILION, edge_width_pt=2.2, min_scale=0.6),
    "not recoverable": _Style("true object, not recoverable", "s", 8, "#8a8a8a"),
}
_LABEL_STYLES = {
    "true": _Style("label, true", "o", 4.5, "white", _BLUE, edge_width_pt=0.4),
    "duplicate": _Style("label, duplicate", "^", 9, "black", _ORANGE, edge_width_pt=0.7, min_scale=0.8),
    "false": _Style("label, false", "X", 10, "white", _VERMILION, edge_width_pt=0.6, min_scale=0.8),
    "not compared": _Style("label", "o", 5, "white", _BLUE, edge_width_pt=0.4),
}


@dataclass(frozen=True, eq=False)
class _Scene:
    """Everything to draw, in metres along the two horizontal axes.

    `half_axes_m` (labels, 2; major first) and `angle_rad` (labels) of the major one are those of the 95 %
    ellipses; `objects` and `labels` hold the rows of each outcome by its text.
    """

    tracks: list[Floats]
    object_points: Floats
    label_points: Floats
    half_axes_m: Floats
    angle_rad: Floats
    objects: dict[str, Ints]
    labels: dict[str, Ints]

    def all_points(self) -> Floats:
        return np.concatenate([self.label_points, self.object_points])


@dataclass(frozen=True)
class _Window:
    """A part of the ground and how many metres of it one pixel shows."""

    left: float
    right: float
    bottom: float
    top: float
    meters_per_px: float


def draw_map(result: Map, dataset: Dataset, matches: Outcomes | None, path: str | Path) -> None:
    """Draw a map from above as a PNG, 1600 pixels wide and 1000 to 1200 high; same input, same bytes.

    Parameters
    ----------
    result
        The map: labels with 95 % ellipses of their horizontal covariance, drawn larger where they would be
        invisible (the legend says by how much).
    dataset
        The images it was made from: where they were taken shows the streets.
    matches
        What became of labels and true objects; without it labels are drawn alone.
    path
        The PNG to write.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    from matplotlib.figure import Figure  # Slow to import, and only pictures need it.

    axes_in_world, axis_names = _horizontal_axes(result.frame)
    scene = _scene(result, dataset, matches, axes_in_world)
    low, size = _extent(scene)
    main_height_px = float(np.clip(_MAIN_WIDTH_PX * size[1] / size[0], *_MAIN_HEIGHT_PX))
    main_top_px = _MAIN_BOTTOM_PX + main_height_px
    height_px = main_top_px + _HEAD_PX
    figure = Figure(figsize=(_WIDTH_PX / _DPI, height_px / _DPI), dpi=_DPI, facecolor="white")

    def axes_at(left_px: float, bottom_px: float, width_px: float, side_px: float) -> Axes:
        return figure.add_axes((left_px / _WIDTH_PX, bottom_px / height_px, width_px / _WIDTH_PX, side_px / height_px))

    left = _MAIN_LEFT_PX / _WIDTH_PX
    figure.text(left, 1.0 - 54 / height_px, f"valuemap: {dataset.name}", fontsize=21, color=_INK, weight="bold")
    figure.text(left, 1.0 - 88 / height_px, _summary(result, dataset), fontsize=13, color=_INK)

    main = axes_at(_MAIN_LEFT_PX, _MAIN_BOTTOM_PX, _MAIN_WIDTH_PX, main_height_px)
    whole = _fitted(main, low + size / 2.0, size)
    marker_scale = _marker_scale(len(result.labels))
    scale = _ellipse_scale(scene, whole, marker_scale)
    _draw_scene(main, scene, whole, scale, marker_scale)
    main.set_xlabel(axis_names[0], fontsize=12, color=_INK)
    main.set_ylabel(axis_names[1], fontsize=12, color=_INK)

    scales = [f"{scale}x larger" if scale > 1 else "to scale"]
    detail_bottom_px = main_top_px - 28 - _DETAIL_SIDE_PX
    if len(scene.all_points()):
        detail = axes_at(_DETAIL_LEFT_PX, detail_bottom_px, _DETAIL_SIDE_PX, _DETAIL_SIDE_PX)
        close = _busiest_window(scene, whole, detail)
        detail_scale = _ellipse_scale(scene, close, _DETAIL_MARKER_SCALE)
        _draw_scene(detail, scene, close, detail_scale, _DETAIL_MARKER_SCALE)
        detail.set_title("detail: the busiest place", fontsize=13, color=_INK, loc="left")
        _mark_window(main, close)
        scales.append(f"in the detail {detail_scale}x" if detail_scale > 1 else "in the detail to scale")
    _draw_legend(figure, scene, ", ".join(scales), top=(detail_bottom_px - 42) / height_px)
    with new_file(Path(path)) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None}, pil_kwargs={"optimize": True})


def _summary(result: Map, dataset: Dataset) -> str:
    passes = len(np.unique(dataset.images.pass_id.codes))
    return (
        f"{len(result.labels):,} labels from {len(dataset.detections):,} detections in "
        f"{len(dataset.images):,} images of {passes:,} {'pass' if passes == 1 else 'passes'}"
    )


# What to draw.


def _horizontal_axes(frame: Frame) -> tuple[Floats, tuple[str, str]]:
    """Return unit vectors to the right and to the top of the picture (2, 3), and their names."""
    up = np.array(frame.up)
    forward = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    right = forward - (forward @ up) * up
    right /= np.linalg.norm(right)
    basis = np.stack([right, np.cross(up, right)])
    if frame.is_georeferenced:
        return basis, ("east (m)", "north (m)")
    return basis, (f"{_axis_name(basis[0], 'right')} (m)", f"{_axis_name(basis[1], 'ahead')} (m)")


def _axis_name(direction: Floats, otherwise: str) -> str:
    """Return x, y or z with its sign where the direction is that of an axis of the world."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 1.0 - 1e-6:
        return otherwise
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def _scene(result: Map, dataset: Dataset, matches: Outcomes | None, axes_in_world: Floats) -> _Scene:
    label_points = result.labels.position_in_world_m @ axes_in_world.T
    object_points, objects = np.empty((0, 2)), {}
    labels = {"not compared": np.arange(len(label_points))}
    if matches is not None:
        object_points = matches.object_in_world_m @ axes_in_world.T
        objects, labels = _rows_by_text(matches.object_outcome), _rows_by_text(matches.label_outcome)
    half_axes_m, angle_rad = _ellipses(result.labels.covariance_m2, axes_in_world)
    tracks = _tracks(dataset.images, axes_in_world)
    return _Scene(tracks, object_points, label_points, half_axes_m, angle_rad, objects, labels)


def _rows_by_text(outcome: Categories) -> dict[str, Ints]:
    return {name: np.flatnonzero(outcome.codes == code) for code, name in enumerate(outcome.names)}


def _tracks(images: Images, axes_in_world: Floats) -> list[Floats]:
    """Return the driven lines, each (n, 2): the images of a pass in order, cut where the pass jumps."""
    order = np.lexsort((images.image_id, _times(images), images.pass_id.codes))
    points = (camera_centers(images) @ axes_in_world.T)[order]
    pass_code = images.pass_id.codes[order]
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    moving = step[step > 0.0]
    longest_step = max(25.0, 5.0 * float(np.median(moving))) if len(moving) else 0.0
    cuts = np.flatnonzero((np.diff(pass_code) != 0) | (step > longest_step)) + 1
    return [np.asarray(track) for track in np.split(points, cuts)]


def _times(images: Images) -> Floats | Ints:
    return images.image_id if images.timestamp_s is None else images.timestamp_s


def _ellipses(covariance_m2: Floats, axes_in_world: Floats) -> tuple[Floats, Floats]:
    full = covariance_m2[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    variance, direction = np.linalg.eigh(axes_in_world @ full @ axes_in_world.T)  # Ascending.
    half_axes_m = _ELLIPSE_SIGMAS * np.sqrt(np.maximum(variance[:, ::-1], 0.0))
    return half_axes_m, np.arctan2(direction[:, 1, 1], direction[:, 0, 1])


# Where to look.


def _extent(scene: _Scene) -> tuple[Floats, Floats]:
    """Return the lower left corner (2) and the size (2) in metres of all there is, with a margin."""
    points = np.concatenate([*scene.tracks, scene.all_points()])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * max(*(high - low), 20.0)
    size: Floats = high - low + 2.0 * margin
    return low - margin, size


def _busiest_window(scene: _Scene, whole: _Window, axes: Axes) -> _Window:
    """Return the window with most labels and objects of those around each of them."""
    from scipy.spatial import KDTree  # Slow to import, and only pictures need it.

    extent = max(whole.right - whole.left, whole.top - whole.bottom)
    size = float(np.clip(_DETAIL_SHARE * extent, *_DETAIL_M))
    points = np.unique(scene.all_points(), axis=0)  # Sorted, so that ties do not depend on the order of rows.
    tree = KDTree(points)
    near = tree.query_ball_point(points, 0.4 * size, p=np.inf, return_length=True)
    chosen = tree.query_ball_point(points[np.argmax(near)], 0.4 * size, p=np.inf, return_sorted=True)
    around = points[chosen]
    center = (around.min(axis=0) + around.max(axis=0)) / 2.0
    return _fitted(axes, center, np.array([size, size]), inside=whole)


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


def _ellipse_scale(scene: _Scene, window: _Window, marker_scale: float) -> int:
    """Return how many times larger than they are ellipses are drawn, so that one sees them."""
    half_axis_px = scene.half_axes_m[:, 0] / window.meters_per_px
    half_axis_px = half_axis_px[np.isfinite(half_axis_px) & (half_axis_px > 0.0)]
    if len(half_axis_px) == 0:
        return 1
    typical_px, large_px = np.quantile(half_axis_px, [0.5, 0.9])
    seen_px, most_px = (limit_px * marker_scale for limit_px in _ELLIPSE_PX)
    fitting = [scale for scale in _ELLIPSE_SCALES if scale == 1 or scale * large_px <= most_px]
    return next((scale for scale in fitting if scale * typical_px >= seen_px), fitting[-1])


def _marker_scale(labels: int) -> float:
    """Return how large markers are: smaller where there are many labels."""
    return float(np.clip(np.sqrt(200.0 / max(labels, 1)), 0.35, 1.0))


# Drawing.


def _draw_scene(axes: Axes, scene: _Scene, window: _Window, ellipse_scale: int, marker_scale: float) -> None:
    axes.set_xlim(window.left, window.right)
    axes.set_ylim(window.bottom, window.top)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=10, color=_TRACK, labelcolor=_INK)
    for spine in axes.spines.values():
        spine.set_color(_TRACK)
    _draw_tracks(axes, scene.tracks, window)
    for outcome, style in _OBJECT_STYLES.items():
        _draw_points(axes, scene.object_points[scene.objects.get(outcome, _NO_ROWS)], style, marker_scale)
    for outcome, style in _LABEL_STYLES.items():
        rows = scene.labels.get(outcome, _NO_ROWS)
        _draw_ellipses(axes, scene, rows, style, ellipse_scale, 0.8 * marker_scale)
        _draw_points(axes, scene.label_points[rows], style, marker_scale)


def _draw_tracks(axes: Axes, tracks: list[Floats], window: _Window) -> None:
    from matplotlib.collections import LineCollection

    street_pt = float(np.clip(_STREET_WIDTH_M / window.meters_per_px * 72 / _DPI, 2.0, 80.0))
    for color, width_pt in ((_STREET, street_pt), (_TRACK, 0.5)):
        axes.add_collection(
            LineCollection(tracks, colors=color, linewidths=width_pt, capstyle="round", joinstyle="round", zorder=1),
            autolim=False,
        )


def _draw_ellipses(axes: Axes, scene: _Scene, rows: Ints, style: _Style, scale: int, edge_width_pt: float) -> None:
    from matplotlib.collections import EllipseCollection

    width, height = 2.0 * scale * scene.half_axes_m[rows].T
    axes.add_collection(
        EllipseCollection(
            width,
            height,
            np.degrees(scene.angle_rad[rows]),
            units="xy",
            offsets=scene.label_points[rows],
            transOffset=axes.transData,
            linewidths=edge_width_pt,
            zorder=2,
            **_ellipse_colors(style),
        ),
        autolim=False,
    )


def _ellipse_colors(style: _Style) -> dict[str, Any]:
    from matplotlib.colors import to_rgba

    return {"facecolor": to_rgba(style.face, 0.16), "edgecolor": to_rgba(style.face, 0.7)}


def _draw_points(axes: Axes, points: Floats, style: _Style, marker_scale: float) -> None:
    axes.plot(points[:, 0], points[:, 1], zorder=3, **_marker(style, marker_scale))


def _marker(style: _Style, scale: float) -> dict[str, Any]:
    scale = max(scale, style.min_scale)
    return {
        "linestyle": "none",
        "marker": style.marker,
        "markersize": style.size_pt * scale,
        "markerfacecolor": style.face,
        "markeredgecolor": style.edge,
        "markeredgewidth": style.edge_width_pt * max(scale, 0.6),
    }


def _mark_window(axes: Axes, window: _Window) -> None:
    from matplotlib.patches import Rectangle

    corner, width, height = (
        (window.left, window.bottom),
        window.right - window.left,
        window.top - window.bottom,
    )
    axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=_INK, linewidth=1.2))


def _draw_legend(figure: Figure, scene: _Scene, ellipse_scales: str, *, top: float) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[Any] = [Line2D([], [], color=_STREET, linewidth=9, label="driven streets")]
    for styles, groups in ((_OBJECT_STYLES, scene.objects), (_LABEL_STYLES, scene.labels)):
        for outcome, rows in ((name, groups[name]) for name in styles if name in groups):
            text = f"{styles[outcome].text} ({len(rows):,})"
            entries.append(Line2D([], [], label=text, **_marker(styles[outcome], _DETAIL_MARKER_SCALE)))
    ellipse = f"95 % ellipse of a label,\n{ellipse_scales}"
    entries.append(Patch(label=ellipse, **_ellipse_colors(_LABEL_STYLES["true"])))
    figure.legend(
        handles=entries,
        loc="upper left",
        bbox_to_anchor=(0.708, top),
        fontsize=14.5,
        labelcolor=_INK,
        frameon=False,
        labelspacing=1.1,
    )
