"""Laws of the whole method: moved worlds, permuted rows, renamed passes, other thread counts give the same map."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import valuemap
import valuemap._core as _core
from literal import Pinhole, Sighting
from scenes import Scene, as_dataset, random_scene
from told import Told
from valuemap import pipeline
from valuemap.calibration import calibrate
from valuemap.cameras import cast_rays
from valuemap.config import NoiseConfig
from valuemap.dataset import Dataset, Frame
from valuemap.describe import describe_labels
from valuemap.engine.threads import ThreadEngine
from valuemap.map_folder import Map
from valuemap.progress import silent
from valuemap.tables import Labels, Votes
from valuemap.tables.candidates import Candidates
from valuemap.tables.table import table_to_arrow
from valuemap.tables.write import write_table
from valuemap.tiles.compare import compare_poses
from valuemap.tiles.mapping import solve_cells
from valuemap.tiles.seams import join_cells
from valuemap.tiles.source import InMemory
from valuemap.tiles.work import open_work

# Nothing is estimated, and poses stay.
KNOWN = valuemap.MapConfig(detection_sigma_px=1.5, position_sigma_m=0.05, rotation_sigma_deg=0.05, correct_poses=0)


def street(seed: int = 7) -> Dataset:
    """A drive of several clusters, with clutter and two passes."""
    scene = random_scene(seed, images=30, objects=8, clutter=30)
    return as_dataset(scene, passes=[f"pass-{i % 2}" for i in range(30)])


def paper() -> valuemap.MapConfig:
    """Algorithm 1 in clusters that are small, so that there are several."""
    return valuemap.MapConfig(method="paper").with_settings(["cluster_radius_m=12"])


@cache
def map_of_street(config: valuemap.MapConfig) -> Map:
    """The map of the street as it is, which nothing changes."""
    return valuemap.build_map(street(), config)


both_methods = pytest.mark.parametrize("config", [valuemap.MapConfig(), paper()], ids=["robust", "paper"])


def same_tables(a: Map, b: Map) -> bool:
    pairs = ((a.labels, b.labels), (a.votes, b.votes))
    return all(bool(table_to_arrow(x).equals(table_to_arrow(y))) for x, y in pairs)


def test_a_folder_is_mapped_as_what_it_holds(tmp_path: Path) -> None:
    valuemap.write_dataset(street(), tmp_path / "street")
    assert same_tables(valuemap.build_map(str(tmp_path / "street")), map_of_street(valuemap.MapConfig()))


def moved(dataset: Dataset, turn: Rotation, shift: np.ndarray) -> Dataset:
    """The same dataset in a world where X' = turn X + shift."""
    rotation = Rotation.from_quat(dataset.images.cam_from_world_quat, scalar_first=True) * turn.inv()
    return Dataset(
        **{
            **vars(dataset),
            "frame": Frame(up=tuple(turn.apply([0.0, 0.0, 1.0]))),
            "images": dataset.images.replace(
                cam_from_world_quat=rotation.as_quat(scalar_first=True),
                cam_from_world_m=dataset.images.cam_from_world_m - rotation.apply(shift),
            ),
        }
    )


@both_methods
@settings(max_examples=2, deadline=None)
@given(
    angles=st.tuples(*[st.floats(-180.0, 180.0)] * 3),
    shift=st.tuples(*[st.floats(-1e5, 1e5)] * 3),
)
def test_a_moved_world_gives_the_moved_map(
    config: valuemap.MapConfig, angles: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    turn = Rotation.from_euler("zyx", angles, degrees=True)
    still = map_of_street(config)
    other = valuemap.build_map(moved(street(), turn, np.array(shift)), config)
    assert len(still.labels) > 3
    # Drives without times are numbered by place: labels may come in another order.
    row_of = {votes: row for row, votes in enumerate(votes_of_labels(other))}
    same = [row_of[votes] for votes in votes_of_labels(still)]
    assert sorted(same) == list(range(len(still.labels)))
    expected = turn.apply(still.labels.position_in_world_m) + np.array(shift)
    np.testing.assert_allclose(other.labels.position_in_world_m[same], expected, atol=2e-6)
    np.testing.assert_allclose(other.labels.reprojection_rms_px[same], still.labels.reprojection_rms_px, atol=2e-5)
    np.testing.assert_allclose(other.labels.facing_concentration[same], still.labels.facing_concentration, atol=1e-6)
    np.testing.assert_allclose(facing(other)[same], turn.apply(facing(still)), atol=1e-6)


def votes_of_labels(result: valuemap.Map) -> list[frozenset[int]]:
    """The detections of each label, in the order of the labels."""
    return [
        frozenset(result.votes.detection_id[result.votes.label_id == label].tolist())
        for label in result.labels.label_id
    ]


def facing(result: valuemap.Map) -> np.ndarray:
    """Where labels face, as unit vectors in the world."""
    azimuth = result.labels.facing_azimuth_rad
    return np.asarray(np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1) @ result.frame.east_north())


def test_azimuths_are_clockwise_from_north() -> None:
    """A light seen from the west by a car that waits and from the south by one that does not faces south-west."""
    light = np.array([3.0, 4.0, 5.0])
    intrinsics = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    looking_east = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    looking_north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    places = [(looking_east, light - [20.0, 0.0, 3.0])] * 9 + [(looking_north, light - [0.0, 30.0, 3.0])]
    cameras = [Pinhole(intrinsics, rotation, -rotation @ center) for rotation, center in places]
    sightings = [Sighting(i, "light", camera.project(light)[0]) for i, camera in enumerate(cameras)]
    dataset = as_dataset(Scene(cameras, sightings, light[None]), passes=["waits"] * 9 + ["passes by"])
    found = Candidates(light[None], np.array([0, 10]), np.arange(10, dtype=np.uint32))
    labels, _ = describe_labels(dataset, cast_rays(dataset), found, NoiseConfig())
    np.testing.assert_allclose(labels.facing_azimuth_rad, [np.radians(225.0)])
    np.testing.assert_allclose(labels.facing_concentration, [np.sqrt(0.5)])


def test_a_frame_of_its_own_has_a_north() -> None:
    np.testing.assert_allclose(Frame().east_north(), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(Frame(up=(0.0, -1.0, 0.0)).east_north(), [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-15)
    np.testing.assert_allclose(Frame().east_north_up(), np.eye(3), atol=1e-15)
    tilted = Frame(up=(0.0, 0.6, 0.8)).east_north()
    np.testing.assert_allclose(tilted, [[1.0, 0.0, 0.0], [0.0, 0.8, -0.6]], atol=1e-15)


@both_methods
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_rows_does_not_matter(
    tmp_path_factory: pytest.TempPathFactory, config: valuemap.MapConfig, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("dataset") / "street"
    dataset = street()
    random = np.random.default_rng(seed)
    shuffled = Dataset(
        **{
            **vars(dataset),
            "images": dataset.images.take(random.permutation(len(dataset.images))),
            "detections": dataset.detections.take(random.permutation(len(dataset.detections))),
        }
    )
    # Only the door sorts rows, so the shuffled tables go through files.
    valuemap.write_dataset(dataset, folder)
    write_table(shuffled.images, folder / "images.parquet")
    write_table(shuffled.detections, folder / "detections.parquet")
    again = valuemap.build_map(valuemap.read_dataset(folder), config)
    assert same_tables(again, map_of_street(config))


@both_methods
def test_the_names_of_passes_do_not_matter(config: valuemap.MapConfig) -> None:
    dataset = street()
    names = {"pass-0": "z", "pass-1": "a"}
    renamed = dataset.images.pass_id.from_texts([names[name] for name in dataset.images.pass_id.texts()])
    other = Dataset(**{**vars(dataset), "images": dataset.images.replace(pass_id=renamed)})
    assert same_tables(map_of_street(config), valuemap.build_map(other, config))


@both_methods
def test_the_number_of_threads_does_not_matter(config: valuemap.MapConfig, tmp_path: Path) -> None:
    every_core = map_of_street(config)
    assert len(every_core.labels) > 3
    made = {str(threads): valuemap.build_map(street(), config, threads=threads) for threads in (1, 2, 3)}
    made["0"] = every_core
    for threads, result in made.items():
        valuemap.write_map(result, tmp_path / threads)
    for name in ("labels.parquet", "votes.parquet", "rejected.parquet"):
        assert len({(tmp_path / threads / name).read_bytes() for threads in made}) == 1


@both_methods
def test_a_map_tells_how_far_it_is(config: valuemap.MapConfig) -> None:
    valuemap.build_map(street(), config, progress=(told := Told()))
    kinds = ["voting"] if config.method == "paper" else ["comparing drives", "estimating the noise", "finding labels"]
    told.check(*kinds)


def test_what_the_core_counts_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """It counts maps and moves, no more than the total; how often it is asked is a matter of time."""

    def counting(work: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*given: Any) -> Any:
            given[-1](7, 0)
            return work(*given)

        return counted

    for name in ("misfits", "calibrate", "find_labels"):
        monkeypatch.setattr(_core, name, counting(getattr(_core, name)))
    dataset = street()
    as_they_are = valuemap.MapConfig(correct_poses=0)
    valuemap.build_map(dataset, as_they_are, progress=(told := Told()))
    told.check("estimating the noise", "finding labels")
    compare_poses(dataset, dataset, 0, valuemap.MapConfig(), threads=1, progress=told)
    told.check("comparing poses")
    for call in (("estimating the noise", 7, 50), ("finding labels", 7, 25), ("comparing poses", 7, 32)):
        assert call in told.calls


@both_methods
def test_votes_and_labels_tell_one_story(config: valuemap.MapConfig) -> None:
    dataset, result = street(), map_of_street(config)
    labels, votes = result.labels, result.votes
    rows = votes.label_id - 1
    assert np.array_equal(np.bincount(rows), labels.votes)
    assert len(np.unique(votes.detection_id)) == len(votes)
    assert len(np.unique(np.stack([votes.label_id, votes.image_id]), axis=1).T) == len(votes)
    rms = np.sqrt(np.bincount(rows, votes.residual_px**2) / labels.votes)
    np.testing.assert_allclose(labels.reprojection_rms_px, rms)
    assert set(labels.passes) <= {1, 2}
    counts = result.run["counts"]
    assert counts["labels"] == len(labels)
    assert counts["detections_without_label"] == len(dataset.detections) - len(votes)


def test_a_map_survives_its_folder(tmp_path: Path) -> None:
    result = map_of_street(valuemap.MapConfig())
    valuemap.write_map(result, tmp_path / "map")
    again = valuemap.read_map(tmp_path / "map")
    assert result.rejected is not None
    assert again.rejected is not None
    assert table_to_arrow(again.rejected).equals(table_to_arrow(result.rejected))
    assert same_tables(result, again)
    assert again.frame == result.frame
    assert again.run["settings"] == {**valuemap.MapConfig().as_dict(), "max_range_m": 60.0, "min_range_m": 2.0}


@both_methods
def test_no_support_gives_an_empty_map_with_all_columns(config: valuemap.MapConfig, tmp_path: Path) -> None:
    scene = random_scene(3, images=5, objects=0, clutter=5)
    result = valuemap.build_map(as_dataset(scene), config)
    assert len(result.labels) == 0
    assert len(result.votes) == 0
    valuemap.write_map(result, tmp_path / "map")
    assert isinstance(valuemap.read_map(tmp_path / "map").labels, Labels)
    assert isinstance(valuemap.read_map(tmp_path / "map").votes, Votes)


def paper_labels(config: valuemap.MapConfig) -> Callable[[Dataset], Labels]:
    """Return what finds the labels of a dataset by Algorithm 1."""
    return lambda dataset: valuemap.build_map(dataset, config).labels


def robust_labels(sample: Dataset, config: valuemap.MapConfig) -> Callable[[Dataset], Labels]:
    """Return what finds the labels of a dataset by the robust method, with what is estimated once of a sample."""
    engine = ThreadEngine(1)
    calibration = calibrate(InMemory(sample, config), config, None, None, engine, silent)

    def found(dataset: Dataset) -> Labels:
        source = InMemory(dataset, config)
        cells, _ = solve_cells(source, calibration, config, engine, silent)
        return join_cells(cells, source.grid, config)[0]

    return found


@pytest.mark.parametrize("method", ["robust", "paper"])
def test_covariance_is_that_of_the_scatter(method: Literal["robust", "paper"]) -> None:
    """Over many noise draws positions scatter as the mean covariance says (6 numbers, 200 draws)."""
    sigma = 1.5
    known = ["position_sigma_m=0", "rotation_sigma_deg=0", "gate_sigmas=6", "correct_poses=0"]
    own = known if method == "robust" else ["max_reprojection_error_px=20"]
    config = valuemap.MapConfig(method=method).with_settings([f"detection_sigma_px={sigma}", *own])
    base = as_dataset(random_scene(1, images=20, objects=1, clutter=0, noise_px=0.0, recall=1.0))
    labels_of = robust_labels(base, config) if method == "robust" else paper_labels(config)
    random = np.random.default_rng(0)
    points, covariances = [], []
    for _ in range(200):
        noisy = base.detections.center_px + random.normal(0.0, sigma, base.detections.center_px.shape)
        labels = labels_of(Dataset(**{**vars(base), "detections": base.detections.replace(center_px=noisy)}))
        assert len(labels) == 1
        if labels.votes[0] < len(base.detections):
            continue  # The robust method left a voter out: another estimator, with another scatter.
        points.append(labels.position_in_world_m[0])
        covariances.append(labels.covariance_m2[0])
    assert len(points) > 190
    xx, xy, xz, yy, yz, zz = np.mean(covariances, axis=0)
    expected = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    whitened = np.linalg.inv(np.linalg.cholesky(expected)) @ np.cov(np.array(points).T)
    whitened = whitened @ np.linalg.inv(np.linalg.cholesky(expected)).T
    np.testing.assert_allclose(np.linalg.eigvalsh(whitened), 1.0, atol=0.35)


def test_what_is_cut_on_disk_is_read_once_and_has_the_notes_of_what_is_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = street()
    uncertain = dataset.detections.replace(vertical_sigma_px=np.full(len(dataset.detections), 5.0))
    valuemap.write_dataset(dataclasses.replace(dataset, detections=uncertain), tmp_path / "data")
    reads: list[Path] = []

    def read(folder: Path) -> Dataset:
        reads.append(folder)
        return valuemap.read_dataset(folder)

    monkeypatch.setattr(pipeline, "read_dataset", read)
    results = []
    for tile_size_m in (None, 500.0):
        with open_work(tmp_path / f"work{tile_size_m}", resume=False) as work:
            run = pipeline.Run(work, ThreadEngine(1), tile_size_m=tile_size_m)
            results.append(pipeline.build_map_of_folder(tmp_path / "data", KNOWN, run)[0])
    assert len(reads) == 2
    assert "vertical_sigma_px" in results[0].run["notes"][0]
    assert results[0].run["notes"] == results[1].run["notes"]
    assert results[1].rejected is not None


def test_it_is_said_where_a_rolling_shutter_is_not_corrected_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = street()
    monkeypatch.setattr(pipeline, "MOST_LOOKED_AT", 10)
    told = []
    for readout_s in (0.03, 0.0):
        cameras = dataset.cameras.replace(readout_s=np.full(len(dataset.cameras), readout_s))
        valuemap.write_dataset(dataclasses.replace(dataset, cameras=cameras), tmp_path / f"{readout_s}")
        for tile_size_m in (None, 500.0):
            with open_work(tmp_path / "work", resume=False) as work:
                run = pipeline.Run(work, ThreadEngine(1), tile_size_m=tile_size_m)
                result, _ = pipeline.build_map_of_folder(tmp_path / f"{readout_s}", KNOWN, run)
            told.append([note for note in result.run["notes"] if "readout" in note])
    assert list(map(len, told)) == [0, 1, 0, 0]
