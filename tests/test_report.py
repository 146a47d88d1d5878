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
from valuemap import report
from valuemap.dataset import Dataset, Frame
from valuemap.errors import OutputError
from valuemap.evaluate import evaluate_map
from valuemap.map_folder import Map
from valuemap.report import draw_map
from valuemap.tables import Categories, Floats, Images

VERMILION, ORANGE, BLUE, GREEN = ((213, 94, 0), (230, 159, 0), (0, 114, 178), (0, 158, 115))
MAIN_VIEW = (slice(102, -66), slice(93, 1103))
"""Rows and columns of the pixels of the main view, without the legend, which has all colours."""


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
    return int(np.sum(np.abs(pixels[MAIN_VIEW] - color).max(axis=2) <= 2))


def drawn(result: Map, dataset: Dataset, path: Path, *, compared: bool = True) -> Any:
    draw_map(result, dataset, evaluate_map(result, dataset).matches if compared else None, path)
    return picture(path)


GOOD = [[20.1, 10.0, 5.0], [60.1, 10.0, 5.0]]


def test_a_good_map_has_nothing_marked(tmp_path: Path) -> None:
    pixels = drawn(map_of(GOOD), street(), tmp_path / "map.png")
    assert pixels.shape[1] == 1600
    assert 1000 <= pixels.shape[0] <= 1200
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


def test_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        drawn(map_of(GOOD), street(), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert b"matplotlib" not in (tmp_path / "a.png").read_bytes()


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
    for compared in (True, False):
        assert drawn(result, dataset, tmp_path / "map.png", compared=compared).shape[1] == 1600


def test_a_picture_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot be written"):
        draw_map(map_of(GOOD), street(), None, tmp_path / "file" / "map.png")


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
    axes, found_names = report._horizontal_axes(frame)
    assert_allclose(axes, [right, top], atol=1e-15)
    assert found_names == names


def test_any_up_gives_a_right_handed_view() -> None:
    for up in np.random.default_rng(0).normal(0.0, 1.0, (50, 3)):
        up /= np.linalg.norm(up)
        axes, names = report._horizontal_axes(Frame(up=tuple(up)))
        assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
        assert_allclose(np.cross(*axes), up, atol=1e-12)
        assert names == ("right (m)", "ahead (m)")


def test_an_ellipse_holds_95_percent() -> None:
    random = np.random.default_rng(2)
    root = random.normal(0.0, 1.0, (3, 3))
    covariance = root @ root.T
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    half_axes, angle = report._ellipses(covariance[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]][None], axes)
    samples = random.multivariate_normal(np.zeros(3), covariance, 40_000) @ axes.T
    cosine, sine = np.cos(angle[0]), np.sin(angle[0])
    along = samples @ np.array([[cosine, -sine], [sine, cosine]]) / half_axes[0]
    assert np.mean((along**2).sum(axis=1) <= 1.0) == pytest.approx(0.95, abs=0.005)
    assert half_axes[0, 0] >= half_axes[0, 1]
    assert np.sqrt(chi2.ppf(0.95, 2)) == pytest.approx(report._ELLIPSE_SIGMAS, rel=1e-12)


def scene_of(half_axes_m: Floats) -> Any:
    points = np.zeros((len(half_axes_m), 2))
    return report._Scene([], points, points, half_axes_m, np.zeros(len(points)), {}, {})


@pytest.mark.parametrize(
    ("half_axes_m", "expected"),
    [
        ([2.0] * 10, 1),  # 20 px at 0.1 m a pixel: large enough.
        ([0.2] * 10, 10),  # 2 px: needs 6 times, and the next step is 10.
        ([0.2] * 8 + [3.0] * 2, 2),  # 30 px already: twice that is the most.
        ([0.2] * 8 + [30.0] * 2, 1),
        ([1e-9] * 3, 1000),
        ([0.0, np.nan], 1),
        ([], 1),
    ],
)
def test_ellipses_are_enlarged_until_they_are_seen(half_axes_m: list[float], expected: int) -> None:
    window = report._Window(0.0, 100.0, 0.0, 100.0, meters_per_px=0.1)
    axes = np.array(half_axes_m, dtype=np.float64)
    assert report._ellipse_scale(scene_of(np.stack([axes, axes], axis=1)), window, 1.0) == expected


def test_tracks_follow_time_and_are_cut_at_passes_and_jumps() -> None:
    """Ids run against time; pass b starts where a ends; a jumps by 100 m after its third image."""
    x = np.array([0.0, 2.0, 4.0, 104.0, 106.0, 106.0, 108.0])
    count = len(x)
    images = Images(
        np.arange(count),
        pa.array([str(i) for i in range(count)]),
        np.zeros(count, np.int64),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        -np.stack([x, np.zeros(count), np.zeros(count)], axis=1)[::-1],
        Categories.from_texts(["b", "b", "a", "a", "a", "a", "a"]),
        timestamp_s=np.arange(count)[::-1].astype(np.float64),
    )
    tracks = report._tracks(images, np.eye(3)[:2])
    assert [track[:, 0].tolist() for track in tracks] == [[0.0, 2.0, 4.0], [104.0, 106.0], [106.0, 108.0]]


def test_a_window_has_the_proportions_of_its_axes_and_shows_everything() -> None:
    axes = Figure(figsize=(10, 10), dpi=100).add_axes((0.1, 0.1, 0.8, 0.4))
    window = report._fitted(axes, np.array([5.0, 7.0]), np.array([10.0, 30.0]))
    assert (window.top - window.bottom, window.right - window.left) == pytest.approx((30.0, 60.0))
    assert window.meters_per_px == pytest.approx(0.075)
    moved = report._fitted(axes, np.array([34.0, 7.0]), np.array([1.0, 5.0]), inside=window)
    assert moved.right == pytest.approx(window.right)
    assert_array_equal([moved.bottom, moved.top], [4.5, 9.5])
