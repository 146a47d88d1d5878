"""The picture of a map: what it shows, how large ellipses are, and that it is the same every time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2

from small_dataset import map_of, small_dataset
from valuemap.arrays import Floats
from valuemap.dataset import Dataset, Frame
from valuemap.errors import OutputError
from valuemap.evaluate import evaluate_map
from valuemap.map_folder import Map
from valuemap.report.above import (
    _MISTAKE_STYLES,
    _class_groups,
    _close_side_m,
    _fitted,
    _legend_entries,
    _marker,
    _marker_scale,
    draw_map,
    plot_map,
)
from valuemap.report.ground import (
    ELLIPSE_SIGMAS,
    Ground,
    closest_pair,
    drives_of,
    ellipses,
    extent_of,
    horizontal_axes,
    look_down,
)
from valuemap.report.style import figure_bytes
from valuemap.tables import Categories, Images

VERMILION, ORANGE, BLUE, GREEN = ((213, 94, 0), (230, 159, 0), (0, 114, 178), (0, 158, 115))
SEGMENTEND_PX = 180
"""What is lowest in the picture has all colours."""


def street(count: int = 40) -> Dataset:
    """Return a dataset of one pass along x, with two true objects 10 m beside it."""
    base = small_dataset()
    center = np.stack([2.0 * np.arange(count), np.zeros(count), np.full(count, 1.5)], axis=1)
    ids = np.arange(count)
    images = Images(
        ids,
        pa.array([f"{i}.jpg" for i in ids]),
        np.ones_like(ids),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        -center,
        Categories.from_texts(["p"] * count),
    )
    detections = base.detections.replace(image_id=np.array([0, 10, 20, 30, 39]))
    assert base.truth is not None
    truth = base.truth.replace(
        class_name=Categories.from_texts(["light", "light"]),
        position_in_world_m=np.array([[20.0, 10.0, 5.0], [60.0, 10.0, 5.0]]),
    )
    return Dataset("street", Frame(), base.cameras, images, detections, truth)


def picture(path: Path) -> Any:
    """Return the pixels (rows, columns, 3) as bytes."""
    return np.round(imread(path)[:, :, :3] * 255).astype(int)


def pixels_of(pixels: Any, color: tuple[int, int, int]) -> int:
    return int(np.sum(np.abs(pixels[:-SEGMENTEND_PX] - color).max(axis=2) <= 2))


def drawn(result: Map, dataset: Dataset, path: Path, *, compared: bool = True) -> Any:
    draw_map(result, dataset, evaluate_map(result, dataset).matches if compared else None, path)
    return picture(path)


GOOD = [[20.1, 10.0, 5.0], [60.1, 10.0, 5.0]]


def test_a_good_map_has_nothing_marked(tmp_path: Path) -> None:
    pixels = drawn(map_of(GOOD), street(), tmp_path / "map.png")
    assert 900 <= pixels.shape[1] <= 1610
    assert 700 <= pixels.shape[0] <= 1200
    assert pixels_of(pixels, BLUE) > 10
    assert pixels_of(pixels, GREEN) > 50
    assert pixels_of(pixels, VERMILION) == pixels_of(pixels, ORANGE) == 0
    assert (tmp_path / "map.png").stat().st_size < 300_000


@pytest.mark.parametrize(
    ("positions", "color"),
    [
        ([*GOOD, [40.0, -5.0, 5.0]], VERMILION),
        ([*GOOD, [60.5, 10.5, 5.0]], ORANGE),
        (GOOD[:1], VERMILION),
    ],
    ids=["false label", "duplicate", "missed object"],
)
def test_what_is_wrong_is_marked(positions: Any, color: tuple[int, int, int], tmp_path: Path) -> None:
    assert pixels_of(drawn(map_of(positions), street(), tmp_path / "map.png"), color) > 30


def test_without_truth_labels_are_drawn_alone(tmp_path: Path) -> None:
    pixels = drawn(map_of(GOOD), street(), tmp_path / "map.png", compared=False)
    assert pixels_of(pixels, BLUE) > 10
    assert pixels_of(pixels, GREEN) == 0


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_same_map_gives_the_same_bytes(suffix: str, tmp_path: Path) -> None:
    for name in ("a", "b"):
        draw_map(map_of(GOOD), street(), None, tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    assert b"Matplotlib v" not in (tmp_path / f"a{suffix}").read_bytes()
    assert b"<dc:date>" not in (tmp_path / f"a{suffix}").read_bytes()


def unknown_covariance() -> Map:
    result = map_of(GOOD)
    covariance = result.labels.covariance_m2.copy()
    covariance[0] = 0.0
    return Map(result.frame, result.labels.replace(covariance_m2=covariance), result.votes, result.run)


def one_image() -> Dataset:
    dataset = street()
    first = np.array([0])
    parts = {"images": dataset.images.take(first), "detections": dataset.detections.take(first)}
    return Dataset(**{**vars(dataset), **parts})


@pytest.mark.parametrize(
    ("result", "dataset"),
    [
        (map_of([]), street()),
        (map_of([[1e5, 2e5, 0.0]]), street()),
        (map_of(GOOD), one_image()),
        (unknown_covariance(), street()),
        (map_of([[5.0, 5.0, 5.0]]), small_dataset()),
    ],
    ids=["no labels", "far away", "one image", "zero covariance", "truth elsewhere"],
)
def test_unusual_maps_are_drawn(result: Map, dataset: Dataset, tmp_path: Path) -> None:
    assert drawn(result, dataset, tmp_path / "map.png").shape[1] >= 700


def test_a_picture_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot be written"):
        draw_map(map_of(GOOD), street(), None, tmp_path / "file" / "map.png")
    with pytest.raises(OutputError, match="cannot draw a file that ends in .gif"):
        draw_map(map_of(GOOD), street(), None, tmp_path / "map.gif")


# What the picture is made of.


@pytest.mark.parametrize(
    ("frame", "right", "top", "names"),
    [
        (Frame(), [1, 0, 0], [0, 1, 0], ("x (m)", "y (m)")),
        (Frame(anchor=(51.5, 0.0, 0.0)), [1, 0, 0], [0, 1, 0], ("east (m)", "north (m)")),
        (Frame(up=(0.0, -1.0, 0.0)), [1, 0, 0], [0, 0, 1], ("x (m)", "z (m)")),
        (Frame(up=(0.0, 1.0, 0.0)), [1, 0, 0], [0, 0, -1], ("x (m)", "-z (m)")),
        (Frame(up=(1.0, 0.0, 0.0)), [0, 1, 0], [0, 0, 1], ("y (m)", "z (m)")),
    ],
)
def test_the_picture_is_seen_from_above(frame: Frame, right: Any, top: Any, names: tuple[str, str]) -> None:
    axes, found_names = horizontal_axes(frame)
    assert_allclose(axes, [right, top], atol=1e-15)
    assert found_names == names


def test_any_up_gives_a_right_handed_view() -> None:
    for up in np.random.default_rng(0).normal(0.0, 1.0, (50, 3)):
        up /= np.linalg.norm(up)
        axes, names = horizontal_axes(Frame(up=tuple(up)))
        assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
        assert_allclose(np.cross(*axes), up, atol=1e-12)
        assert names == ("right (m)", "ahead (m)")


def test_an_ellipse_holds_95_percent() -> None:
    random = np.random.default_rng(2)
    root = random.normal(0.0, 1.0, (3, 3))
    covariance = root @ root.T
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    half_axes, angle = ellipses(covariance[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]][None], axes)
    samples = random.multivariate_normal(np.zeros(3), covariance, 40_000) @ axes.T
    cosine, sine = np.cos(angle[0]), np.sin(angle[0])
    along = samples @ np.array([[cosine, -sine], [sine, cosine]]) / half_axes[0]
    assert np.mean((along**2).sum(axis=1) <= 1.0) == pytest.approx(0.95, abs=0.005)
    assert half_axes[0, 0] >= half_axes[0, 1]
    assert np.sqrt(chi2.ppf(0.95, 2)) == pytest.approx(ELLIPSE_SIGMAS, rel=1e-12)


def test_ellipses_are_drawn_as_large_as_they_are() -> None:
    """The second lens shows 1.5 m on about 420 px: a half axis of 0.49 m is there, and nowhere scaled."""
    from matplotlib.collections import EllipseCollection

    figure = plot_map(map_of([[20.0, 10.0, 5.0], [20.5, 10.0, 5.0]]), street())
    drawn_m: list[float] = []
    for axes in figure.axes:
        for collection in axes.collections:
            if isinstance(collection, EllipseCollection):
                drawn_m += np.ravel(np.asarray(collection.get_widths(), np.float64)).tolist()
    assert drawn_m
    assert_allclose(drawn_m, 2.0 * ELLIPSE_SIGMAS * 0.2, rtol=1e-12)


@pytest.mark.parametrize(
    ("half_axis_m", "apart_m", "side_m"),
    [(0.5, 0.0, 3.125), (0.01, 0.5, 1.5), (0.1, 2.0, 4.4), (50.0, 0.0, 12.0), (np.nan, 0.0, 1.5)],
)
def test_the_close_lens_shows_ellipses_and_the_closest_pair(half_axis_m: float, apart_m: float, side_m: float) -> None:
    assert _close_side_m(np.full((3, 2), half_axis_m), apart_m) == pytest.approx(side_m)


def images_at(points: Any, passes: list[str] | None = None, times: Any = None) -> Images:
    points = np.asarray(points, np.float64)
    count = len(points)
    return Images(
        np.arange(count),
        pa.array([str(i) for i in range(count)]),
        np.zeros(count, np.int64),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        -np.column_stack([points, np.zeros(count)]),
        Categories.from_texts(passes or ["p"] * count),
        timestamp_s=None if times is None else np.asarray(times, np.float64),
    )


def test_drives_follow_time_and_are_cut_at_passes_and_jumps() -> None:
    """Ids run against time; pass b starts where a ends; a jumps by 100 m after its third image."""
    x = np.array([0.0, 2.0, 4.0, 104.0, 106.0, 106.0, 108.0])
    points = np.stack([x, np.zeros(len(x))], axis=1)[::-1]
    images = images_at(points, ["b", "b", "a", "a", "a", "a", "a"], np.arange(len(x))[::-1])
    drives, joins = drives_of(images, np.eye(3)[:2])
    assert [drive[:, 0].tolist() for drive in drives] == [[0.0, 2.0, 4.0], [104.0, 106.0], [106.0, 108.0]]
    assert [join[:, 0].tolist() for join in joins] == [[4.0, 104.0]]


def line(start: Any, end: Any, count: int = 8) -> Floats:
    return np.linspace(start, end, count)


@pytest.mark.parametrize(
    ("after", "way"),
    [
        (line([80, 0], [100, 0]), [[20, 0], [80, 0]]),  # Straight on.
        (line([60, 30], [60, 60]), [[20, 0], [60, 0], [60, 30]]),  # Around one corner.
        (line([60, -30], [60, -60]), [[20, 0], [60, 0], [60, -30]]),
        (line([80, 40], [60, 40]), None),  # Back again on another street: nobody knows how.
        (line([-80, 0], [-60, 0]), None),  # Behind.
        (line([500, 0], [520, 0]), None),  # Too far.
        (np.zeros((3, 2)) + [80, 0], None),  # Stands.
    ],
)
def test_a_gap_is_driven_through_where_the_direction_fits(after: Any, way: Any) -> None:
    points = np.concatenate([line([0, 0], [20, 0]), after])
    images = images_at(points, times=np.arange(len(points)))
    joins = drives_of(images, np.eye(3)[:2])[1]
    assert len(joins) == (way is not None)
    if way is not None:
        assert_allclose(joins[0], way, atol=1e-9)


def test_a_straight_drive_fills_its_picture() -> None:
    """500 m of street with labels 10 m beside it: the main view is wide and low, not a strip in a square."""
    dataset = street(250)
    figure = plot_map(map_of(GOOD), dataset)
    box = figure.axes[0].get_window_extent()
    assert box.width / box.height > 4.0
    left, right = figure.axes[0].get_xlim()
    assert right - left < 1.15 * 500.0


def test_far_labels_do_not_decide_what_is_shown() -> None:
    ground = look_down(map_of([*GOOD, [1e5, 2e5, 0.0]]), street())
    _, size, left_out = extent_of(ground)
    assert left_out == 1
    assert np.all(size < 200.0)
    assert any("1 far away" in str(entry.get_label()) for entry in _legend_entries(ground, left_out))


def test_a_few_mistakes_stay_visible_among_many_labels_and_many_do_not_hide_the_map() -> None:
    of_many_labels = _marker_scale(5000)
    few, many = (_marker(_MISTAKE_STYLES["false"], of_many_labels, count)["markersize"] for count in (5, 2000))
    assert few > 1.8 * many


def test_the_legend_has_no_empty_rows() -> None:
    result, dataset = map_of(GOOD), street()
    ground = look_down(result, dataset, evaluate_map(result, dataset).matches)
    texts = [str(entry.get_label()) for entry in _legend_entries(ground, 0)]
    assert texts == ["driven streets", "label: light (2)", "true object, found (2)"]


def test_classes_are_told_apart_and_the_rarest_share_a_mark() -> None:
    names = [f"c{i}" for i in range(12) for _ in range(i + 1)]
    ground = look_down(map_of(np.zeros((len(names), 3)), names))
    groups = _class_groups(ground)
    assert [style.text for style, _ in groups] == ["c11", "c10", "c9", "c8", "c7", "c6", "c5", "5 other classes"]
    assert [len(rows) for _, rows in groups] == [12, 11, 10, 9, 8, 7, 6, 1 + 2 + 3 + 4 + 5]
    assert len({(style.marker, style.face) for style, _ in groups}) == 8


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_letters_that_no_font_has_raise_no_warning(suffix: str, recwarn: pytest.WarningsRecorder) -> None:
    figure = Figure()
    figure.text(0.5, 0.5, "\u4fe1\u53f7")
    figure_bytes(figure, suffix)
    assert [str(each.message) for each in recwarn] == []


def test_names_are_no_formulas(tmp_path: Path) -> None:
    dataset = street()
    hostile = Dataset(**{**vars(dataset), "name": "$\\frac{1}$ <script>\n\0 $x"})
    draw_map(map_of(GOOD, ["$\\bad{$", "a$b$c"]), hostile, None, tmp_path / "a.png")


def test_the_closest_pair_is_found() -> None:
    middle, apart = closest_pair(np.array([[0.0, 0.0], [10.0, 0.0], [10.5, 0.0], [3.0, 0.0]]))
    assert_array_equal(middle, [10.25, 0.0])
    assert apart == 0.5
    assert closest_pair(np.array([[1.0, 2.0]]))[1] == 0.0


def test_a_window_has_the_proportions_of_its_axes_and_shows_everything() -> None:
    axes = Figure(figsize=(10, 10), dpi=100).add_axes((0.1, 0.1, 0.8, 0.4))
    window = _fitted(axes, np.array([5.0, 7.0]), np.array([10.0, 30.0]))
    assert (window.top - window.bottom, window.right - window.left) == pytest.approx((30.0, 60.0))
    assert window.meters_per_px == pytest.approx(0.075)
    moved = _fitted(axes, np.array([34.0, 7.0]), np.array([1.0, 5.0]), inside=window)
    assert moved.right == pytest.approx(window.right)
    assert_array_equal([moved.bottom, moved.top], [4.5, 9.5])


def test_a_map_alone_is_drawn() -> None:
    assert isinstance(plot_map(map_of(GOOD)), Figure)
    assert isinstance(look_down(map_of([])), Ground)
    assert isinstance(plot_map(map_of([])), Figure)
