"""Cells of a fixed grid: what is where, what each is solved with, and one map of all."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import valuemap
from block import block
from scenes import as_dataset, random_scene
from told import Told
from valuemap import portions
from valuemap.arrays import Floats
from valuemap.cli.commands import app
from valuemap.config import MapConfig, SimulationConfig
from valuemap.dataset import Dataset, Frame
from valuemap.drives import InOrder, driving_order, find_drives, in_driving_order
from valuemap.engine.threads import ThreadEngine
from valuemap.errors import OutputError
from valuemap.map_folder import Map
from valuemap.portions import DatasetReader
from valuemap.progress import silent
from valuemap.robust import Calibration, Noise, Scene, calibrate, find_labels
from valuemap.sightings import cast_sightings
from valuemap.simulate import simulate
from valuemap.tables import Categories, Labels, Votes
from valuemap.tables.candidates import Candidates
from valuemap.tables.table import join_tables, table_to_arrow
from valuemap.tiles import fleet, places
from valuemap.tiles import grid as grid_module
from valuemap.tiles.dense import groups_of_drives, join_groups
from valuemap.tiles.fingerprint import Fingerprints
from valuemap.tiles.fleet import Fleet
from valuemap.tiles.grid import LEVELS, WHOLE, Cell, Census, Grid, Places, smallest_squares
from valuemap.tiles.mapping import solve_cells
from valuemap.tiles.partition import partition_dataset
from valuemap.tiles.sample import is_sampled, sampled_squares
from valuemap.tiles.seams import _Rows, join_cells
from valuemap.tiles.solve import Solved, solve_cell
from valuemap.tiles.source import InMemory
from valuemap.tiles.store import hash_settings, load_cells
from valuemap.tiles.work import MARKER, open_work, remove_work, written

GRID = Grid.of(Frame(), 60.0)
# With all noise known, only the classes are learned.
KNOWN = MapConfig(detection_sigma_px=1.5, position_sigma_m=0.05, rotation_sigma_deg=0.05, correct_poses=0)


# The grid.


def census(place_m: Floats, grid: Grid = GRID) -> Census:
    return Census.of(grid, place_m, np.ones(len(place_m), np.int64))


def test_places_are_counted_alike_near_and_far_from_each_other() -> None:
    random = np.random.default_rng(5)
    near_m = random.uniform(-2000.0, 2000.0, (500, 2))
    counted = census(near_m)
    with_one_far = census(
        np.concatenate([near_m, [[1e9, 1e9]]])
    )  # Between them are more squares than there are places.
    assert np.array_equal(counted.square, with_one_far.square[:-1])
    assert np.array_equal(counted.images, with_one_far.images[:-1])
    assert np.array_equal(counted.square, np.unique(counted.square, axis=0))
    assert np.array_equal(with_one_far.detections, [*counted.detections, 1])


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), most=st.sampled_from([20, 100, 10**6]))
def test_every_place_is_in_one_cell(seed: int, most: int) -> None:
    random = np.random.default_rng(seed)
    place_m = np.concatenate([random.uniform(-2000.0, 2000.0, (200, 2)), random.normal(0.0, 50.0, (200, 2))])
    grid = replace(GRID, most_detections=most)
    cells = census(place_m, grid).cells(grid)
    inside = np.stack([grid.is_within(cell, place_m) for cell in cells])
    assert np.all(inside.sum(axis=0) == 1)
    assert np.array_equal(grid.find(place_m, list(cells)), np.argmax(inside, axis=0))
    assert (max(cell.level for cell in cells) > 0) == (most < 10**6)


def test_borders_belong_to_one_side() -> None:
    steps = np.arange(-4, 5) * GRID.side_m / 2**LEVELS - 0.5 * GRID.side_m
    place_m = np.array([[x, y] for x in steps for y in steps])
    cells = [Cell((x, y)) for x in range(-3, 3) for y in range(-3, 3)]
    parts = [Cell(c.base, LEVELS, (i, j)) for c in cells for i in range(2**LEVELS) for j in range(2**LEVELS)]
    for some in (cells, parts):
        assert np.all(np.sum([GRID.is_within(cell, place_m) for cell in some], axis=0) == 1)


def test_what_is_no_wider_than_a_cell_is_one_wherever_it_is() -> None:
    place_m = np.array([[470.0, 470.0], [1400.0, 1420.0]])
    assert census(place_m).cells(GRID) == {WHOLE: 2}
    assert len(census(place_m).cells(replace(GRID, most_detections=1))) > 1  # But not if it is too dense.
    assert len(census(place_m + [[0.0, 0.0], [100.0, 0.0]]).cells(GRID)) > 1


def test_objects_in_a_cell_without_images_have_a_cell_too() -> None:
    place_m = np.array([[470.0, 0.0], [-2000.0, 0.0]])
    cells = census(place_m).cells(GRID)
    assert Cell((1, 0)) in cells  # 10 m away from the image.
    assert Cell((-3, 0)) not in cells


def test_dense_places_are_split_until_it_helps_no_more() -> None:
    grid = replace(GRID, most_detections=1000)
    random = np.random.default_rng(0)
    spread = np.concatenate([random.uniform(-480.0, 480.0, (3000, 2)), [[3000.0, 0.0]]])
    levels = {cell.level for cell in census(spread, grid).cells(grid) if cell.base == (0, 0)}
    assert max(levels) in (1, 2)
    crossing = np.concatenate([np.zeros((4000, 2)), [[3000.0, 0.0]]])
    parts = [cell for cell in census(crossing, grid).cells(grid) if cell.base == (0, 0)]
    assert {cell.level for cell in parts if grid.is_within(cell, np.zeros((1, 2)), grid.halo_m).any()} == {LEVELS}


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), spread_m=st.sampled_from([10.0, 500.0, 4000.0]))
def test_the_places_around_a_cell_are_those_in_it_and_its_halo(seed: int, spread_m: float) -> None:
    random = np.random.default_rng(seed)
    place_m = random.normal(random.uniform(-5000.0, 5000.0, 2), spread_m, (int(random.integers(0, 300)), 2))
    places_of = Places(GRID, place_m)
    bases = [(x, y) for x in range(-9, 9, 2) for y in range(-9, 9)]
    for cell in [*map(Cell, bases), *(Cell(base, 2, (1, 3)) for base in bases)]:
        around = np.flatnonzero(GRID.is_within(cell, place_m, GRID.halo_m))
        assert np.array_equal(places_of.around(cell), around)


def test_counts_in_parts_add_up() -> None:
    random = np.random.default_rng(1)
    place_m = random.uniform(-3000.0, 3000.0, (500, 2))
    whole, parts = census(place_m), census(place_m[:200]) + census(place_m[200:])
    for name in ("square", "images", "detections", "extent_m"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))


def test_the_sample_does_not_depend_on_what_is_elsewhere() -> None:
    random = np.random.default_rng(2)
    place_m = random.uniform(-3000.0, 3000.0, (5000, 2))
    few = sampled_squares(census(place_m), detections=500)
    chosen = {tuple(square) for square in few.tolist()}
    assert 0 < len(chosen) < len(census(place_m).square)
    assert np.array_equal(few, sampled_squares(census(random.permutation(place_m)), detections=500))
    # Data far away adds places to choose from, and takes no others in.
    with_more = np.concatenate([place_m, random.uniform(9000.0, 9500.0, (100, 2))])
    again = {tuple(square) for square in sampled_squares(census(with_more), detections=500).tolist()}
    assert {square for square in again if square[0] < 60} <= chosen
    assert is_sampled(GRID, census(place_m), place_m).all()  # Few enough to take all.
    expected = [tuple(square) in chosen for square in smallest_squares(GRID, place_m).tolist()]
    assert is_sampled(GRID, census(place_m), place_m, 500).tolist() == expected
    assert 0 < sum(expected) < len(expected)


# Seams, by hand: cell 0 is left of x = 480 m, cell 1 right of it.

LEFT, RIGHT = Cell((0, 0)), Cell((1, 0))


def solved(cell: Cell, *labels: tuple[float, list[int]]) -> Solved:
    """Labels of a cell: x and detections of each."""
    count = len(labels)
    position = np.array([[x, 0.0, 5.0] for x, _ in labels]).reshape(count, 3)
    votes = np.array([len(detections) for _, detections in labels], np.int64)
    detection = np.array([d for _, detections in labels for d in detections], np.int64)
    ones = np.ones(count)
    table = Labels(
        label_id=np.arange(1, count + 1),
        class_name=Categories(np.zeros(count, np.int32), ("light",)),
        position_in_world_m=position,
        covariance_m2=np.zeros((count, 6)),
        votes=votes,
        passes=np.ones(count, np.int64),
        object_width_m=ones,
        object_height_m=ones,
        reprojection_rms_px=ones,
        max_parallax_rad=ones,
        first_seen_s=ones,
        last_seen_s=ones,
        facing_azimuth_rad=ones,
        facing_concentration=ones,
        expected=votes,
        existence=ones,
    )
    label = np.repeat(np.arange(1, count + 1), votes)
    residual: Floats = detection.astype(np.float64) + 1.0
    return Solved(
        cell=cell,
        labels=table,
        is_own=GRID.is_within(cell, GRID.on_ground(position)),
        votes=Votes(label, detection, detection, residual, residual),
        vote_pass=detection % 3,
        counts={"images": 1},
    )


def joined(*cells: Solved) -> list[tuple[float, list[int]]]:
    labels, votes, _ = join_cells(cells, GRID, MapConfig())
    assert labels.label_id.tolist() == list(range(1, len(labels) + 1))
    assert np.bincount(votes.label_id, minlength=len(labels) + 1)[1:].tolist() == labels.votes.tolist()
    return [
        (x, votes.detection_id[votes.label_id == label].tolist())
        for x, label in zip(labels.position_in_world_m[:, 0].tolist(), labels.label_id.tolist(), strict=True)
    ]


def test_a_label_belongs_to_the_cell_it_lies_in() -> None:
    at_home, guest = (479.0, [1, 2, 3, 4]), (479.2, [1, 2, 3, 4, 5])
    assert joined(solved(LEFT, at_home), solved(RIGHT, guest)) == [at_home]


def test_of_an_object_in_two_cells_the_one_with_more_votes_is_kept() -> None:
    left, right = (479.9, [1, 2, 3, 4]), (480.1, [2, 3, 4, 5, 6])
    assert joined(solved(LEFT, left), solved(RIGHT, right)) == [right]
    assert joined(solved(LEFT, (479.9, [1, 2, 3])), solved(RIGHT, (480.1, [2, 3, 4]))) == [(479.9, [1, 2, 3])]


def test_an_object_that_each_cell_places_in_the_other_is_not_lost() -> None:
    from_left, from_right = (480.1, [1, 2, 3, 4]), (479.9, [1, 2, 3, 4, 5])
    assert joined(solved(LEFT, from_left), solved(RIGHT, from_right)) == [from_right]


def test_a_guest_that_its_home_does_not_know_is_not_kept() -> None:
    assert joined(solved(LEFT, (481.0, [1, 2, 3, 4])), solved(RIGHT, (500.0, [7, 8, 9]))) == [(500.0, [7, 8, 9])]
    # Nor if two others say so.
    corner = solved(Cell((0, 1)), (481.0, [1, 2, 3]))
    assert joined(solved(LEFT, (481.0, [1, 2, 3, 4])), corner, solved(RIGHT, (500.0, [7, 8, 9]))) == [
        (500.0, [7, 8, 9])
    ]


def test_each_detection_votes_once_and_what_is_counted_follows() -> None:
    left, right = solved(LEFT, (470.0, [0, 1, 2, 3, 4, 5])), solved(RIGHT, (490.0, [5, 6, 9, 12]))
    assert joined(left, right) == [(470.0, [0, 1, 2, 3, 4, 5]), (490.0, [6, 9, 12])]
    labels, _, counts = join_cells([left, right], GRID, MapConfig())
    assert labels.passes.tolist() == [1, 1]  # Detections 6, 9 and 12 are of one pass.
    assert labels.reprojection_rms_px[1] == pytest.approx(np.sqrt(np.mean(np.array([7.0, 10.0, 13.0]) ** 2)))
    assert counts["votes_of_two_labels"] == 1
    # Too few are left.
    assert joined(left, solved(RIGHT, (490.0, [4, 6, 9]), (495.0, [20, 21, 22]))) == [
        (470.0, [0, 1, 2, 3, 4, 5]),
        (495.0, [20, 21, 22]),
    ]


@pytest.mark.parametrize("spread", [1, 10**12])
def test_votes_of_several_are_those_of_detections_counted_one_by_one(spread: int) -> None:
    random = np.random.default_rng(8)
    detection = spread * random.integers(3, 90, 60)
    none = np.zeros(60, np.int64)
    expected = [row for row, each in enumerate(detection.tolist()) if np.sum(detection == each) > 1]
    assert 0 < len(expected) < 60
    assert _Rows(none, none, none, none, detection).of_several.tolist() == expected
    assert _Rows(*[none[:0]] * 5).of_several.tolist() == []


# Whole maps.


def streets(*places_m: float, seed: int = 7, images: int = 30) -> Dataset:
    """Drives of 40 m past the same objects, at several places along x."""
    scene = random_scene(seed, images=images, objects=8, clutter=images // 2)
    parts = [
        shifted(as_dataset(scene, passes=[f"pass-{k}-{i % 2}" for i in range(images)]), x, 10_000 * k)
        for k, x in enumerate(places_m)
    ]
    return joined_datasets(parts)


def shifted(dataset: Dataset, x_m: float, ids: int) -> Dataset:
    from valuemap.cameras import rotation_matrices

    images, detections = dataset.images, dataset.detections
    moved = images.cam_from_world_m - rotation_matrices(images) @ np.array([x_m, 0.0, 0.0])
    return replace(
        dataset,
        images=images.replace(image_id=images.image_id + ids, cam_from_world_m=moved),
        detections=detections.replace(detection_id=detections.detection_id + ids, image_id=detections.image_id + ids),
    )


def joined_datasets(parts: list[Dataset]) -> Dataset:
    import pyarrow as pa

    from valuemap.tables import Detections, Images
    from valuemap.tables.read import table_from_arrow

    images = pa.concat_tables([table_to_arrow(part.images).cast(plain(part.images)) for part in parts])
    detections = pa.concat_tables([table_to_arrow(part.detections).cast(plain(part.detections)) for part in parts])
    return replace(
        parts[0],
        images=table_from_arrow(Images, images, source="images"),
        detections=table_from_arrow(Detections, detections, source="detections"),
    )


def plain(table: object) -> object:
    import pyarrow as pa

    schema = table_to_arrow(table).schema  # type: ignore[arg-type]
    return pa.schema([pa.field(f.name, pa.string() if pa.types.is_dictionary(f.type) else f.type) for f in schema])


def rows(
    result: Map, *, low: float = -np.inf, high: float = np.inf, shift: float = 0.0, ids: int = 0
) -> list[tuple[float, ...]]:
    """What a map says about some part of the world, as if it were elsewhere."""
    labels, votes = result.labels, result.votes
    found = []
    for row in np.flatnonzero((labels.position_in_world_m[:, 0] >= low) & (labels.position_in_world_m[:, 0] < high)):
        members = votes.label_id == labels.label_id[row]
        position = labels.position_in_world_m[row] - [shift, 0.0, 0.0]
        found.append((*np.round(position, 4).tolist(), *(votes.detection_id[members] - ids).tolist()))
    return sorted(found)


def test_what_is_in_other_cells_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    # What is estimated once of all data depends on all data.
    known = learned(InMemory(streets(0.0), KNOWN).sample())
    monkeypatch.setattr("valuemap.pipeline.calibrate", lambda *_: known)
    alone = valuemap.build_map(streets(0.0), KNOWN)
    assert len(alone.labels) >= 6
    together = valuemap.build_map(streets(0.0, 1000.0, 2100.0), KNOWN)
    assert together.run["counts"]["cells"] == 3
    for k, x in enumerate((0.0, 1000.0, 2100.0)):
        assert rows(together, low=x - 200.0, high=x + 200.0, shift=x, ids=10_000 * k) == rows(alone)
    unmoved = [row for row in table_to_arrow(together.labels).to_pylist() if abs(row["x"]) < 200.0]
    assert [{**row, "label_id": 0} for row in unmoved] == [
        {**row, "label_id": 0} for row in table_to_arrow(alone.labels).to_pylist()
    ]


def test_objects_at_a_border_are_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # The border at x = 480 m goes through the objects of the street.
    dataset = streets(445.0, 3000.0)
    result = valuemap.build_map(dataset, KNOWN)
    assert result.run["counts"]["cells"] > 2
    sides = result.labels.position_in_world_m[:, 0]
    assert min(np.sum((sides > 300.0) & (sides < 480.0)), np.sum((sides >= 480.0) & (sides < 700.0))) >= 2
    alone = valuemap.build_map(streets(0.0), KNOWN)
    assert len(rows(result, high=1000.0)) == len(alone.labels)
    assert len(np.unique(result.votes.detection_id)) == len(result.votes)
    # Without what is around them, cells see their objects worse.
    monkeypatch.setattr(grid_module, "HALO_RANGES", 0.0)
    assert len(valuemap.build_map(dataset, KNOWN).votes) < len(result.votes)


def test_pieces_have_all_that_sees_their_objects() -> None:
    dataset = streets(445.0, 3000.0)
    source = InMemory(dataset, KNOWN)
    place_m = source.grid.images_on_ground(dataset.images)
    for cell in source.cells:
        piece = source.piece(cell)
        near = source.grid.is_within(cell, place_m, source.grid.halo_m)
        assert sorted(piece.image_id.tolist()) == dataset.images.image_id[near].tolist()
        own = dataset.images.image_id[near]
        of_own = np.isin(dataset.detections.image_id, own)
        assert sorted(piece.detection_id.tolist()) == dataset.detections.detection_id[of_own].tolist()


# Dense places.


def crossing(passes: int) -> InOrder:
    """Many drives past the same objects."""
    scene = random_scene(3, images=30 * passes, objects=6, clutter=10 * passes)
    dataset = as_dataset(scene, passes=[f"pass-{i % passes}" for i in range(30 * passes)])
    time_s = np.arange(30.0 * passes)
    dataset = replace(dataset, images=dataset.images.replace(timestamp_s=1e5 * (time_s % passes) + time_s // passes))
    return in_driving_order(dataset)


def learned(piece: InOrder) -> Calibration:
    return calibrate(Scene(piece.dataset, piece.drives, cast_sightings(piece.dataset)[0], 1.0), KNOWN)[0]


def test_a_dense_place_is_solved_some_drives_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    piece = crossing(12)
    most = len(piece.detection_id) // 4 + 1
    sizes = []

    def counted(scene: Any, *args: Any, **kwargs: Any) -> Any:
        sizes.append(len(scene._dataset.detections))
        return find_labels(scene, *args, **kwargs)

    known = learned(piece)
    whole = solve_cell(piece, WHOLE, GRID, known, KNOWN)
    monkeypatch.setattr("valuemap.tiles.solve.find_labels", counted)
    split = solve_cell(piece, WHOLE, replace(GRID, most_detections=most), known, KNOWN)
    assert len(sizes) >= 4
    assert max(sizes) <= most
    assert sum(sizes) == len(piece.detection_id)
    assert split.counts["dense_groups"] == len(sizes)
    assert len(split.labels) == len(whole.labels) >= 5
    for place, votes in zip(whole.labels.position_in_world_m, whole.labels.votes.tolist(), strict=True):
        away = np.linalg.norm(split.labels.position_in_world_m - place, axis=1)
        assert away.min() < 0.1
        assert split.labels.votes[np.argmin(away)] > 0.9 * votes
    assert (split.labels.passes == 12).all()
    assert len(np.unique(split.votes.detection_id)) == len(split.votes)
    # All the drives together know the place as well as they do at once.
    trace = [np.sqrt(labels.covariance_m2[:, [0, 3, 5]].sum(axis=1)).mean() for labels in (split.labels, whole.labels)]
    assert trace[0] == pytest.approx(trace[1], rel=0.5)


def test_no_group_of_drives_is_too_large() -> None:
    piece = crossing(7)
    for most in (200, 37, 10**6):
        groups = groups_of_drives(piece, most)
        assert np.array_equal(np.sort(np.concatenate(groups)), np.arange(len(piece.image_id)))
        sizes = [int(np.isin(piece.dataset.detections.image_id, rows).sum()) for rows in groups]
        assert max(sizes) <= most
        assert len(groups) <= 2 * np.ceil(sum(sizes) / most)  # And none is solved for a few detections.


def test_what_few_groups_find_is_left_out() -> None:
    def found(*labels: tuple[float, list[int]]) -> Candidates:
        """Of the second class where the first voter is 20 or more."""
        count = len(labels)
        return Candidates(
            np.array([[x, 0.0, 5.0] for x, _ in labels]).reshape(-1, 3),
            np.cumsum([0, *(len(voters) for _, voters in labels)]),
            np.array([row for _, voters in labels for row in voters], np.uint32),
            covariance_m2=np.tile(0.01 * np.eye(3), (count, 1, 1)),
            existence=np.full(count, 0.9),
            expected=np.full(count, 4),
            class_code=np.array([int(voters[0] >= 20) for _, voters in labels], np.int64),
        )

    groups = [
        found((0.0, [8, 9]), (5.0, [2, 3])),
        found((0.1, [4, 5]), (0.15, [24, 25])),  # The second is of another class.
        found((-0.1, [6, 7]), (0.1, [26, 27]), (0.6, [10, 11])),  # The third is another one.
        found((0.2, [0])),
    ]
    joined, left_out = join_groups(groups)
    assert joined.position_in_world_m[:, 0] == pytest.approx([0.05, 0.125])
    assert joined.voters.tolist() == [0, 4, 5, 6, 7, 8, 9, 24, 25, 26, 27]
    assert joined.voter_offsets.tolist() == [0, 7, 11]
    assert joined.expected is not None
    assert joined.expected.tolist() == [16, 8]
    assert joined.class_code is not None
    assert joined.class_code.tolist() == [0, 1]
    assert joined.covariance_m2 is not None
    assert joined.covariance_m2[0] == pytest.approx(0.0025 * np.eye(3))
    assert left_out == 2
    assert len(join_groups([found(), found()])[0]) == 0


# On disk, interrupted, twice.


def files(folder: Path) -> dict[str, bytes]:
    """What a map says, with the parts that an update starts from; not how long it took."""
    names = ("labels.parquet", "votes.parquet", "calibration.json")
    found = {name: (folder / name).read_bytes() for name in names}
    return found | {path.name: path.read_bytes() for path in sorted((folder / "cells").glob("*.arrow"))}


def mapped(dataset: Path, out: Path, *options: str) -> dict[str, bytes]:
    settings = [f"--set={name}={value}" for name, value in SET.items()]
    result = CliRunner().invoke(app, ["map", str(dataset), "--out", str(out), *settings, *options])
    assert result.exit_code == 0, result.output
    return files(out)


SET = {"detection_sigma_px": 1.5, "position_sigma_m": 0.05, "rotation_sigma_deg": 0.05, "correct_poses": 0}


@pytest.fixture(scope="module")
def long_street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("long") / "street"
    valuemap.write_dataset(streets(0.0, 445.0, 3000.0), folder)
    return folder


def test_tiles_of_any_size_on_disk_or_in_memory_give_the_same_map(
    long_street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_memory = mapped(long_street, tmp_path / "memory")
    assert len(in_memory) > 5  # Several cells.
    monkeypatch.setattr(portions, "ROWS", 50)
    for size in (200.0, 2000.0, 1e6):
        assert mapped(long_street, tmp_path / f"tiles-{size:.0f}", "--tile-size", str(size)) == in_memory
    assert mapped(long_street, tmp_path / "one-thread", "--tile-size", "500", "--threads", "1") == in_memory
    assert sorted(path.name for path in tmp_path.iterdir() if "work" in path.name) == []


def fingerprint(piece: InOrder, cell: Cell, settings: str = "") -> str:
    return Fingerprints(piece).of(np.arange(len(piece.image_id)), cell, settings)


def test_fingerprints_tell_all_that_labels_depend_on() -> None:
    piece = InMemory(streets(0.0), KNOWN).piece(WHOLE)
    dataset, drives = piece.dataset, piece.drives
    images, detections = dataset.images, dataset.detections
    images = images.replace(timestamp_s=np.arange(1.0 * len(images)), rig_id=np.arange(len(images)))
    other_cameras = dataset.cameras.replace(camera_id=dataset.cameras.camera_id + 1)
    cameras = join_tables([dataset.cameras, other_cameras])
    piece = replace(piece, dataset=(dataset := replace(dataset, cameras=cameras, images=images)))
    known = fingerprint(piece, WHOLE)
    renamed = images.replace(
        name=images.name.take(list(range(len(images)))[::-1]),
        pass_id=Categories(images.pass_id.codes, tuple(f"{name}-again" for name in images.pass_id.names)),
    )
    assert fingerprint(replace(piece, dataset=replace(dataset, images=renamed)), WHOLE) == known

    def other(values: Any) -> Any:
        """Return values of which the last one is the least bit more."""
        if isinstance(values, Categories):
            return Categories(other(values.codes), (*values.names, "other"))
        changed = values.copy()
        changed[-1] = np.nextafter(changed[-1], np.inf) if changed.dtype.kind == "f" else changed[-1] + 1
        return changed

    one_less = np.arange(len(detections) - 1)
    in_another = np.sort(np.append(detections.image_id[:-1], 0))
    each = np.arange(len(images))
    tables: list[dict[str, Any]] = [
        *(
            {table: rows.replace(**{name: other(getattr(rows, name))})}
            for table, rows, names in (
                ("images", images, "camera_id cam_from_world_quat cam_from_world_m pass_id rig_id timestamp_s"),
                ("detections", detections, "class_name center_px size_px score"),
            )
            for name in names.split()
        ),
        {"images": images.replace(timestamp_s=None)},
        {"detections": detections.replace(image_id=in_another)},
        {"cameras": cameras.replace(width_px=cameras.width_px + 1)},
        {"cameras": cameras.replace(params=[params + 0.5 for params in cameras.params])},
        {"cameras": cameras.replace(readout_s=np.full(len(cameras), 0.02))},
    ]
    drives_of_others: list[dict[str, Any]] = [
        *({name: other(getattr(drives, name))} for name in ("order", "driven_m")),
        {"pass_code": each},
        {"viewpoint": np.zeros_like(each)},
    ]
    others = [
        *(replace(piece, dataset=replace(dataset, **changed)) for changed in tables),
        *(replace(piece, drives=replace(drives, **changed)) for changed in drives_of_others),
        *(replace(piece, **{name: other(getattr(piece, name))}) for name in ("image_id", "detection_id")),
        replace(
            piece,
            dataset=replace(dataset, detections=detections.take(one_less)),
            detection_id=piece.detection_id[one_less],
        ),
    ]
    told = {fingerprint(each, WHOLE) for each in others}
    told |= {known, fingerprint(piece, Cell((1, 0))), fingerprint(piece, WHOLE, "other settings")}
    assert len(told) == len(others) + 3


def test_pieces_on_disk_are_those_in_memory(long_street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name in ((portions, "ROWS"), (fleet, "BATCH"), (places, "SHARE")):
        monkeypatch.setattr(module, name, 50)
    with open_work(tmp_path / "work", resume=False) as work:
        on_disk = partition_dataset(long_street, work, KNOWN, tile_size_m=1500.0, progress=(told := Told()))
        told.check("reading images", "ordering drives", "cutting into tiles")
    in_memory = InMemory(valuemap.read_dataset(long_street), KNOWN)
    assert on_disk.cells == in_memory.cells
    assert on_disk.drives_record == in_memory.drives_record
    for cell in [*on_disk.cells, WHOLE]:
        settings = hash_settings(GRID, None, KNOWN)
        hashes = {fingerprint(source.piece(cell), cell, settings) for source in (on_disk, in_memory)}
        assert len(hashes) == 1 or cell == WHOLE  # Which they are not: it stands for the sample here.
        assert in_memory.fingerprint(cell, settings) == fingerprint(in_memory.piece(cell), cell, settings)
        assert on_disk.fingerprint(cell, settings) is None
    assert np.array_equal(on_disk.sample().detection_id, in_memory.sample().detection_id)


@pytest.mark.parametrize("lights_first", [True, False])
def test_boxes_of_two_classes_are_in_one_order_on_disk_and_in_memory(lights_first: bool, tmp_path: Path) -> None:
    dataset = streets(0.0)
    detections, count = dataset.detections, len(dataset.detections)
    names = ["light"] * count + ["sign"] * count
    ids = np.concatenate([2 * np.arange(count) + 1 - lights_first, 2 * np.arange(count) + lights_first])
    twice = detections.take(np.tile(np.arange(count), 2))
    twice = twice.replace(class_name=Categories.from_texts(names), detection_id=ids).by_key()
    valuemap.write_dataset(replace(dataset, detections=twice), tmp_path / "data")
    with open_work(tmp_path / "work", resume=False) as work:
        on_disk = partition_dataset(tmp_path / "data", work, KNOWN).piece(WHOLE)
    in_memory = InMemory(valuemap.read_dataset(tmp_path / "data"), KNOWN).piece(WHOLE)
    assert in_memory.dataset.detections.class_name.texts() == ["light", "sign"] * count
    assert on_disk.dataset.detections.class_name.texts() == ["light", "sign"] * count
    assert np.array_equal(on_disk.detection_id, in_memory.detection_id)


PLAIN: dict[str, float] = {"block_east_m": 300.0, "shuffle_ids": 1}


@pytest.mark.parametrize(
    ("changes", "batches"),
    [
        ({}, 3),
        ({"cameras": 2, "pass_per_camera": 1}, 3),
        ({"cameras": 2, "write_rigs": 1}, 3),
        ({"cameras": 2, "write_rigs": 1, "some untimed": 1}, 1),
        ({"write_timestamps": 0}, 1),
        ({"some untimed": 1}, 3),
        ({"some of a pass untimed": 1}, 3),
        ({"some dated": 1}, 3),
    ],
)
def test_drives_are_the_same_batch_by_batch(
    changes: dict[str, float], batches: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**PLAIN, **{name: value for name, value in changes.items() if " " not in name}}
    known = {field.name for field in fields(SimulationConfig)}
    dataset = simulate(block(**{name: value for name, value in settings.items() if name in known}), seed=3)
    images, time_s = dataset.images, dataset.images.timestamp_s
    chosen = images.pass_id.codes % 3 == 0
    if "some untimed" in changes:
        assert time_s is not None
        dataset = replace(dataset, images=images.replace(timestamp_s=np.where(chosen, np.nan, time_s)))
    if "some of a pass untimed" in changes:
        assert time_s is not None
        time_s = time_s.copy()
        time_s[np.flatnonzero(images.pass_id.codes == 0)[10:40]] = np.nan
        dataset = replace(dataset, images=images.replace(timestamp_s=time_s))
    if "some dated" in changes:
        assert time_s is not None
        dataset = replace(dataset, images=images.replace(timestamp_s=np.where(chosen, 7e4, time_s)))
    valuemap.write_dataset(dataset, tmp_path / "city")
    monkeypatch.setattr(fleet, "BATCH", 300)
    found = Fleet(DatasetReader(tmp_path / "city", rows=500), tmp_path / "f", viewpoint_step_m=1.0, progress=silent)
    expected = find_drives(dataset.images, viewpoint_step_m=1.0)
    assert found.record == expected.record
    rows, count = driving_order(dataset.images, expected), 0
    for batch in found.batches():
        of = rows[batch.place]
        assert np.array_equal(batch.images.image_id, dataset.images.image_id[of])
        assert batch.images.pass_id.texts() == dataset.images.pass_id.take(of).texts()
        for name in ("pass_code", "order", "driven_m", "viewpoint"):
            assert np.array_equal(getattr(batch.drives, name), getattr(expected, name)[of]), name
        count += 1
    assert count >= batches


def test_a_run_that_was_killed_goes_on_and_ends_with_the_same_map(
    long_street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = mapped(long_street, tmp_path / "whole")
    solved: list[Cell] = []
    most = 2

    def dies(piece: InOrder, cell: Cell, *args: Any, **kwargs: Any) -> Solved:
        if len(solved) == most:
            raise MemoryError
        solved.append(cell)
        return solve_cell(piece, cell, *args, **kwargs)

    monkeypatch.setattr("valuemap.tiles.mapping.solve_cell", dies)
    with pytest.raises(MemoryError):
        mapped_or_raises(long_street, tmp_path / "killed", "--threads", "1")
    assert not (tmp_path / "killed").exists()
    most = 100
    assert mapped(long_street, tmp_path / "killed", "--resume") == whole
    assert len(solved) == len(set(solved)) == len(whole) - 3  # None was solved twice.
    assert not (tmp_path / "killed.work").exists()


def mapped_or_raises(dataset: Path, out: Path, *options: str) -> None:
    settings = [f"--set={name}={value}" for name, value in SET.items()]
    CliRunner().invoke(app, ["map", str(dataset), "--out", str(out), *settings, *options], catch_exceptions=False)


def test_what_was_made_with_other_settings_is_not_taken(long_street: Path, tmp_path: Path) -> None:
    with open_work(tmp_path / "work", resume=False) as work:
        source = InMemory(valuemap.read_dataset(long_street), KNOWN)
        known = learned(source.sample())
        noisy = replace(known, noise=Noise(detection_px=3.0))
        _, first = solve_cells(source, known, KNOWN, ThreadEngine(1), silent, store=work / "cells")
        _, again = solve_cells(source, known, KNOWN, ThreadEngine(2), (told := Told()), store=work / "cells")
        told.check("cells")
        _, other = solve_cells(source, noisy, KNOWN, ThreadEngine(2), silent, store=work / "cells")
    assert first == again
    assert not set(map(str, first)) & set(map(str, other))


class Listed(ThreadEngine):
    """Threads that remember what they were given."""

    def run(self, work: Any, tasks: Any, *, on_gpus: bool = False) -> Any:
        self.work, self.tasks = work, list(tasks)
        return super().run(work, self.tasks, on_gpus=on_gpus)


def test_cells_with_most_detections_are_solved_first(long_street: Path, tmp_path: Path) -> None:
    dataset = valuemap.read_dataset(long_street)
    last = int(dataset.images.image_id[-1])
    sparse = dataset.detections.take(dataset.detections.image_id > last // 2)  # The cells of the first half have less.
    dataset = replace(dataset, detections=sparse, truth_detections=None)
    valuemap.write_dataset(dataset, tmp_path / "dataset")
    for source in (InMemory(dataset, KNOWN), partition_dataset(tmp_path / "dataset", tmp_path, KNOWN)):
        engine = Listed(2)
        solve_cells(source, learned(source.sample()), KNOWN, engine, silent)
        sizes = dict(zip(source.cells, source.sizes, strict=True))
        assert [sizes[cell] for cell in engine.tasks] == sorted(source.sizes, reverse=True)
        assert engine.tasks != source.cells


def test_cells_that_are_known_leave_all_threads_to_the_others(long_street: Path, tmp_path: Path) -> None:
    with open_work(tmp_path / "work", resume=False) as work:
        source = InMemory(valuemap.read_dataset(long_street), KNOWN)
        known, engine = learned(source.sample()), Listed(2)
        labels, first = solve_cells(source, known, KNOWN, engine, silent, store=work / "cells")
        assert len(engine.tasks) > 2
        assert engine.work.threads == 1
        assert isinstance(first[1], Path)
        first[1].unlink()
        again, files = solve_cells(source, known, KNOWN, engine, silent, store=work / "cells")
        assert files == first
        assert [of.cell for of in again] == [of.cell for of in labels] == source.cells
    assert engine.tasks == source.cells[1:2]
    assert engine.work.threads == 2


def test_what_is_known_is_read_while_the_others_are_solved(
    long_street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_read = threading.Event()

    def solve(*given: Any, **named: Any) -> Solved:
        assert is_read.wait(60.0)
        return solve_cell(*given, **named)

    def load(files: Any) -> list[Solved]:
        is_read.set()
        return load_cells(files)

    with open_work(tmp_path / "work", resume=False) as work:
        source = InMemory(valuemap.read_dataset(long_street), KNOWN)
        known, engine = learned(source.sample()), ThreadEngine(2)
        labels, files = solve_cells(source, known, KNOWN, engine, silent, store=work / "cells")
        for file in files[1:3]:
            assert isinstance(file, Path)
            file.unlink()
        monkeypatch.setattr("valuemap.tiles.mapping.solve_cell", solve)
        monkeypatch.setattr("valuemap.tiles.mapping.load_cells", load)
        again, same = solve_cells(source, known, KNOWN, engine, silent, store=work / "cells")
    assert same == files
    assert [each.votes.detection_id.tolist() for each in again] == [each.votes.detection_id.tolist() for each in labels]


def test_threads_do_not_wait_until_all_tasks_are_known() -> None:
    is_found = threading.Event()

    def tasks() -> Iterator[int]:
        yield from (0, 1)
        is_found.set()
        yield 2

    def work(task: int, _progress: object) -> int:
        assert is_found.wait(60.0)
        return 10 * task

    assert dict(ThreadEngine(2).run(work, tasks())) == {0: 0, 1: 10, 2: 20}


@pytest.mark.parametrize("where", [".", "cells"])
def test_whenever_a_run_is_ended_nothing_temporary_is_left(tmp_path: Path, where: str) -> None:
    with pytest.raises(KeyboardInterrupt), open_work(tmp_path / "work", resume=False) as work:
        (work / where / ".tmp-1").mkdir()
        (work / where / ".tmp-1" / "part.parquet").write_bytes(b"half")
        raise KeyboardInterrupt
    assert sorted(path.name for path in (tmp_path / "work").rglob("*")) == ["cells", "valuemap-work.json"]


def test_what_is_removed_is_never_there_by_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_work(tmp_path / "work", resume=False) as work:
        (work / "partition-1").mkdir()
        for name in ("a", "b"):
            (work / "partition-1" / name).write_bytes(b"1")

    def killed(path: Path) -> None:
        next(file for file in sorted(Path(path).rglob("*")) if file.is_file() and file.name in "ab").unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(shutil, "rmtree", killed)
        remove_work(work)
    # What goes on from here takes no partition for whole that lacks a part, and the folder for its own.
    with open_work(work, resume=True):
        assert not (work / "partition-1").exists()
        assert {path.name for path in work.iterdir()} <= {"cells", MARKER}


def test_a_second_run_into_the_same_folder_is_refused(long_street: Path, tmp_path: Path) -> None:
    with open_work(tmp_path / "map.work", resume=False):
        result = CliRunner().invoke(app, ["map", str(long_street), "--out", str(tmp_path / "map"), "--resume"])
    assert result.exit_code == 1
    assert "another run is at work here" in result.output


def test_foreign_folders_are_no_place_for_parts(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="is not ours"), open_work(tmp_path / "mine", resume=False):
        pass
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"


def test_parts_are_whole_or_not_there(tmp_path: Path) -> None:
    with open_work(tmp_path / "work", resume=False) as work:
        with pytest.raises(OSError, match="full"), written(work / "cells" / "a") as path:
            path.write_text("half")
            raise OSError(28, "full")
        assert list((work / "cells").iterdir()) == []
        (work / "cells" / ".tmp-left").mkdir()
    with open_work(tmp_path / "work", resume=True) as work:
        assert list((work / "cells").iterdir()) == []
    full = pytest.raises(OutputError, match=r"cannot be written: full")
    with full, open_work(tmp_path / "work", resume=True):
        raise OSError(28, "full")
