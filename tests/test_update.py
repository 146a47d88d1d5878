"""Maps brought up to date: only what new passes touch is solved, ids stay, and what changed is told with evidence."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from typer.testing import CliRunner

import valuemap
from literal import Pinhole, Sighting
from scenes import FOCAL, HEIGHT, WIDTH, Scene, as_dataset
from still_poses import nothing_found
from valuemap import correction, map_folder, pipeline, portions
from valuemap.arrays import Floats, Ints
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.cli.commands import app
from valuemap.control import labels_before_control
from valuemap.dataset import Dataset, ensure_checked, rows_of, write_dataset_in_pieces
from valuemap.drives import find_drives
from valuemap.engine.threads import ThreadEngine
from valuemap.errors import InputError, OutputError
from valuemap.evidence import Evidence
from valuemap.map_folder import Map
from valuemap.pipeline import Run
from valuemap.progress import Stopped
from valuemap.refine import Refined
from valuemap.rejected import find_rejected
from valuemap.tables import Categories, Changes, Detections, IdBridge, Labels
from valuemap.tables.read import read_table
from valuemap.tables.table import join_tables, table_to_arrow
from valuemap.tiles.compare import Comparison
from valuemap.update import changes as changes_of_labels
from valuemap.update import compare, join, update
from valuemap.update.changes import Verdicts, _likeliest, existence_now, first_rows, judge, match_labels, match_places
from valuemap.update.join import join_datasets, join_in_portions, refuse_other_frame
from valuemap.update.looks import HIDDEN_OF, Chances, Lookout, Looks, Sights
from valuemap.update.moved import is_moved_with_map

SET = ("detection_sigma_px=1.5", "position_sigma_m=0.05", "rotation_sigma_deg=0.05")
LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

# Objects beside a street along x, at x = 0 and again 1200 m further, where nobody drives in the second year.
STAYS = [[40.0, 6.0, 4.0], [46.0, -7.0, 5.0], [55.0, 5.0, 4.5], [60.0, -6.0, 4.0], [66.0, 8.0, 5.5]]
REMOVED, ADDED = [50.0, 9.0, 5.0], [52.0, -9.0, 4.2]
MOVED_FROM, MOVED_TO = [58.0, 10.0, 5.0], [61.0, 10.0, 5.0]
FAR_M = 1200.0


def drives(objects: list[list[float]], seed: int, *, starts_m: tuple[float, ...], passes: int, year: int) -> Dataset:
    """Drive past objects, seeing nine of ten, with some clutter; times are seconds of a year."""
    random = np.random.default_rng(seed)
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    cameras: list[Pinhole] = []
    sightings: list[Sighting] = []
    names: list[str] = []
    times: list[float] = []
    world = [np.array(each) + [start, 0.0, 0.0] for start in starts_m for each in objects]
    for number in range(passes):
        for start in starts_m:
            side_m = random.normal(0.0, 1.0)
            for step in range(24):
                center = np.array([start + 2.0 * step + 0.3, side_m, 1.6])
                camera = Pinhole(intrinsics, LEVEL, -LEVEL @ center)
                for place in world:
                    pixel, depth = camera.project(place)
                    inside = 4.0 < depth < 55.0 and 0 <= pixel[0] < WIDTH and 0 <= pixel[1] < HEIGHT
                    if inside and random.random() < 0.9:
                        sightings.append(Sighting(len(cameras), "light", pixel + random.normal(0.0, 1.0, 2)))
                if random.random() < 0.2:
                    sightings.append(Sighting(len(cameras), "light", random.uniform([0, 0], [WIDTH, HEIGHT])))
                cameras.append(camera)
                names.append(f"pass-{number}-{start:.0f}")
                times.append(1e7 * year + 1e5 * number + 100.0 * start + 0.2 * step)
    dataset = as_dataset(Scene(cameras, sightings, np.array(world)), passes=names)
    return Dataset(**{**vars(dataset), "images": dataset.images.replace(timestamp_s=np.array(times))})


@pytest.fixture(scope="module", autouse=True)
def poses_stay() -> Iterator[None]:
    """Find nothing wrong with poses, which takes two thirds of an update of so few drives."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(correction, "refine_poses", nothing_found)
        yield


@pytest.fixture(scope="module")
def years(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the first year, the passes of the second, and the map with both."""
    folder = tmp_path_factory.mktemp("years")
    first = drives([*STAYS, REMOVED, MOVED_FROM], 1, starts_m=(0.0, FAR_M), passes=3, year=1)
    second = drives([*STAYS, ADDED, MOVED_TO], 2, starts_m=(0.0,), passes=2, year=2)
    valuemap.write_dataset(first, folder / "first")
    valuemap.write_dataset(second, folder / "second")
    run("map", folder / "first", "--out", folder / "map", *(f"--set={each}" for each in SET))
    run("update", folder / "map", "--add", folder / "second", "--out", folder / "map2")
    return folder


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def state_at(result: Map, place: list[float], *, start_m: float = 0.0) -> tuple[str, int] | None:
    """State and id of the label within half a metre of a place."""
    labels = result.labels
    distance: Floats = np.linalg.norm(labels.position_in_world_m - place - [start_m, 0.0, 0.0], axis=1)
    row = int(np.argmin(distance))
    assert labels.state is not None
    return (labels.state.texts()[row], int(labels.label_id[row])) if distance[row] < 0.5 else None


def id_at(result: Map, place: list[float], *, start_m: float = 0.0) -> int:
    distance = np.linalg.norm(result.labels.position_in_world_m - place - [start_m, 0.0, 0.0], axis=1)
    assert distance.min() < 0.5
    return int(result.labels.label_id[np.argmin(distance)])


def test_states_say_what_became_of_each_object(years: Path) -> None:
    old, new = valuemap.read_map(years / "map"), valuemap.read_map(years / "map2")
    for place in STAYS:
        assert state_at(new, place) == ("confirmed", id_at(old, place))
        assert state_at(new, place, start_m=FAR_M) == ("confirmed", id_at(old, place, start_m=FAR_M))
    gone = state_at(new, REMOVED)
    assert gone is None or gone == ("gone", id_at(old, REMOVED))
    fresh = state_at(new, ADDED)
    assert fresh is not None
    assert fresh[0] == "new"
    assert fresh[1] > old.labels.label_id.max()
    assert state_at(new, MOVED_TO) == ("moved", id_at(old, MOVED_FROM))
    assert state_at(new, MOVED_FROM) is None
    # Nobody looked: nothing is known to have changed there.
    for place in (REMOVED, MOVED_FROM):
        assert state_at(new, place, start_m=FAR_M) == ("confirmed", id_at(old, place, start_m=FAR_M))


@dataclass(frozen=True)
class Compared:
    """What `compare` takes of the years: the map before, that of all the data, that of the new passes, and the data."""

    before: Map
    told: Map
    alone: Map
    both: Dataset
    images_before: Ints

    def with_rebuilt(self, rebuilt: Map) -> tuple[Map, Changes, IdBridge]:
        """Compare with another map of all the data."""
        return compare(self.before, rebuilt, self.alone, self.both, self.images_before)

    def blind(self) -> tuple[Map, int, int]:
        """Return the map of all the data of who takes things for standing still, and the labels that it has as one.

        It has the old label, with the votes of both places.
        """
        moved, gone = id_at(self.told, MOVED_TO), id_at(self.before, MOVED_FROM)
        of_gone = self.before.votes.take(self.before.votes.label_id == gone)
        labels = [
            self.told.labels.take(self.told.labels.label_id != moved).replace(state=None),
            self.before.labels.take(self.before.labels.label_id == gone).replace(label_id=np.array([9000])),
        ]
        of_told = np.where(self.told.votes.label_id == moved, 9000, self.told.votes.label_id)
        votes = join_tables(
            [
                self.told.votes.replace(label_id=of_told),
                of_gone.replace(label_id=np.full(len(of_gone), 9000)),
            ]
        )
        in_order = votes.take(np.argsort(votes.label_id, kind="stable"))
        return replace(self.told, labels=join_tables(labels), votes=in_order), moved, gone


@pytest.fixture(scope="module")
def compared(years: Path) -> Compared:
    old, both = valuemap.read_map(years / "map"), valuemap.read_dataset(years / "map2" / "dataset")
    is_new = ~np.isin(both.images.image_id, valuemap.read_dataset(years / "first").images.image_id)
    of_new = np.isin(both.detections.image_id, both.images.image_id[is_new])
    added = replace(both, images=both.images.take(is_new), detections=both.detections.take(of_new))
    alone = valuemap.build_map(added, valuemap.MapConfig().with_settings(SET))
    return Compared(old, valuemap.read_map(years / "map2"), alone, both, both.images.image_id[~is_new])


def test_what_moved_is_told_where_all_the_data_have_one_label_for_both_places(compared: Compared) -> None:
    old = compared.before
    blind, _, gone = compared.blind()
    result, changes, _ = compared.with_rebuilt(blind)
    assert state_at(result, MOVED_TO) == ("moved", gone)
    assert state_at(result, MOVED_FROM) is None
    for place in STAYS:
        assert state_at(result, place) == ("confirmed", id_at(old, place))
    kinds = changes.change.texts()
    assert (kinds.count("moved"), kinds.count("removed"), kinds.count("added")) == (1, 1, 1)
    assert np.all(np.bincount(np.unique(result.votes.detection_id, return_inverse=True)[1]) == 1)
    assert np.bincount(result.votes.label_id)[result.labels.label_id].tolist() == result.labels.votes.tolist()


@pytest.mark.parametrize("spread", [1, 1000])
def test_first_rows_are_those_of_a_search_row_by_row(spread: int) -> None:
    """With gaps few and many: two ways to look ids up."""
    random = np.random.default_rng(5)
    keys, ids = (spread * random.integers(0, 60, count) + 7 for count in (40, 100))
    expected = [next((row for row, key in enumerate(keys.tolist()) if key == each), -1) for each in ids.tolist()]
    assert first_rows(ids, keys).tolist() == expected
    assert -1 in expected
    assert first_rows(ids[:0], keys).tolist() == []
    assert first_rows(ids, keys[:0]).tolist() == [-1] * len(ids)


def test_labels_are_those_of_all_the_data_where_nothing_is_told_to_have_changed(
    compared: Compared, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stands_still(new: Labels, before: Ints, *_: object) -> Verdicts:
        return Verdicts(before, ["confirmed" if row >= 0 else "new" for row in before], np.full(len(new), -1))

    monkeypatch.setattr(update, "judge", stands_still)
    blind, _, gone = compared.blind()
    result, _, _ = compared.with_rebuilt(blind)
    assert state_at(result, MOVED_FROM) == ("confirmed", gone)
    votes = {tuple(votes_of(each, label)) for each, label in ((result, gone), (blind, 9000))}
    assert len(votes) == 1
    assert state_at(result, MOVED_TO) is None


def test_what_is_judged_again_is_not_looked_for_again(compared: Compared, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[bytes, bytes]] = []
    rounds: list[int] = []
    look = Lookout.at

    def looks(lookout: Lookout, label_id: int) -> tuple[Sights, Sights]:
        found = lookout._evidence.result
        row = lookout._evidence.label_row(label_id)
        votes = lookout._votes.detection_id[lookout._votes.label_id == label_id]
        asked.append((found.labels.position_in_world_m[row].tobytes(), votes.tobytes()))
        return look(lookout, label_id)

    def stands_still(new: Labels, before: Ints, *rest: Any) -> Verdicts:
        rounds.append(len(new))
        return replace(judge(new, before, *rest), state=["confirmed"] * len(new), moved_from=np.full(len(new), -1))

    monkeypatch.setattr(Lookout, "at", looks)
    monkeypatch.setattr(update, "judge", stands_still)
    compared.with_rebuilt(compared.blind()[0])
    assert len(rounds) == 2
    assert len(asked) == len(set(asked)) > 0


def test_what_was_put_up_is_told_though_all_the_data_have_no_label_for_it(compared: Compared) -> None:
    told, fresh = compared.told, id_at(compared.told, ADDED)
    without = replace(
        told,
        labels=told.labels.take(told.labels.label_id != fresh).replace(state=None),
        votes=told.votes.take(told.votes.label_id != fresh),
    )
    result, changes, _ = compared.with_rebuilt(without)
    there = state_at(result, ADDED)
    assert there is not None
    assert there[0] == "new"
    row = changes.label_id.tolist().index(there[1])
    assert changes.change.texts()[row] == "added"
    assert changes.hits[row] >= 6


def test_what_one_drive_met_has_not_been_put_up() -> None:
    missed, seen = Looks(9, 0, -9.0, 0, 0), Looks(9, 9, 20.0, 0, 0, seen_by=2)
    assert update.has_appeared(missed, seen)
    assert not update.has_appeared(missed, replace(seen, seen_by=1))
    assert not update.has_appeared(replace(missed, log_odds=-1.0), seen)
    assert not update.has_appeared(missed, replace(seen, log_odds=1.0))


def test_labels_of_two_epochs_are_one_where_their_covariances_say_so(years: Path) -> None:
    labels = valuemap.read_map(years / "map").labels
    assert np.array_equal(match_places(labels, labels), np.arange(len(labels)))
    sigma_m = np.sqrt(labels.covariance_m2[:, 0])
    for sigmas, expected in ((4.0, np.arange(len(labels))), (9.0, np.full(len(labels), -1))):
        away = np.zeros((len(labels), 3))
        away[:, 0] = sigmas * sigma_m
        only_x = labels.covariance_m2 * [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]
        still = labels.replace(covariance_m2=only_x)
        elsewhere = still.replace(position_in_world_m=labels.position_in_world_m + away)
        assert np.array_equal(match_places(still, elsewhere), expected)
    signs = labels.replace(class_name=Categories(labels.class_name.codes, ("sign",)))
    assert (match_places(labels, signs) == -1).all()
    # Of two at one place each is one of the old ones.
    twice = join_tables([labels, labels.replace(label_id=labels.label_id + 1000)])
    assert sorted(match_places(labels, twice).tolist()) == sorted([*range(len(labels)), *[-1] * len(labels)])


def test_of_two_heads_side_by_side_neither_takes_the_place_of_the_other(
    years: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(changes_of_labels, "scipy", None)  # Slow to import: it is not asked about so few.
    labels = valuemap.read_map(years / "map").labels[:2]
    sigma_m = np.tile([0.01, 0.0, 0.0, 0.01, 0.0, 0.01], (2, 1))
    heads = labels.replace(position_in_world_m=np.array([[0.0, 0, 0], [0.6, 0, 0]]), covariance_m2=sigma_m)
    # The second of the old ones is the nearest to the first of the new ones.
    again = heads.replace(position_in_world_m=heads.position_in_world_m + [0.35, 0.0, 0.0])
    assert match_places(heads, again).tolist() == [0, 1]
    assert match_places(heads, again[1:]).tolist() == [1]


def test_labels_are_paired_in_the_likeliest_way_however_many_ways_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(4)
    for shape in [(1, 1), (1, 5), (4, 1), (2, 2), (2, 3), (3, 2), (3, 5), (4, 4)] * 5:
        gain = random.normal(size=shape)
        few = list(zip(*_likeliest(gain), strict=True))
        with monkeypatch.context() as patched:
            patched.setattr(changes_of_labels, "FEW_WAYS", 0)
            assert sorted(few) == sorted(zip(*_likeliest(gain), strict=True))
    assert len(_likeliest(random.normal(size=(40, 30)))[0]) == 30  # More ways than can be looked at.


def test_what_was_rather_missed_has_moved_where_something_new_stands_beside_it(years: Path) -> None:
    labels = valuemap.read_map(years / "map").labels[:2]
    labels = labels.replace(position_in_world_m=np.array([[0.0, 0, 0], [3.0, 0, 0]]))

    def judged(odds: float, *, before: float = -1.0) -> list[str]:
        looks = {0: (Looks(9, 9, 20.0, 0, 0), Looks(9, 0, odds, 0, 0)), 1: (Looks(9, 0, before, 0, 0), Looks(9, 9, 20.0, 0, 0))}  # fmt: skip # noqa: E501
        return judge(labels, np.array([0, -1]), ["confirmed"], np.zeros(2, np.bool_), looks).state

    assert judged(-9.0) == ["gone", "moved"]
    assert judged(-2.0) == ["uncertain", "moved"]
    assert judged(0.5) == ["confirmed", "new"]
    assert judged(-2.0, before=1.0) == ["uncertain", "new"]


def test_one_drive_that_missed_says_gone_only_where_drives_seldom_miss_what_is_there(years: Path) -> None:
    result, dataset = valuemap.read_map(years / "map"), valuemap.read_dataset(years / "first")
    is_new = np.zeros(len(dataset.images), np.bool_)
    lookout = Lookout(Evidence(result, dataset), find_drives(dataset.images), is_new, result.votes)
    chances = Chances(0.9)

    def sights(*hits: int) -> Sights:
        return Sights(np.full(len(hits), 10), np.array(hits), 0.0, 1.0)

    assert chances.hidden_share([]) == 1.0 / HIDDEN_OF
    seldom = chances.hidden_share([sights(9, 8, 9)] * 50)
    often = chances.hidden_share([sights(9, 8, 0)] * 50)
    assert seldom == 1.0 / (150 + HIDDEN_OF)
    assert often == 51.0 / (150 + HIDDEN_OF)
    assert chances.looks(sights(0), seldom).say_gone
    assert not chances.looks(sights(0), often).say_gone
    assert chances.looks(sights(0, 0, 0), often).say_gone
    assert chances.looks(sights(9), often).say_there
    # Of what is asked in a map: three drives saw each object.
    first, second = lookout.at(id_at(result, STAYS[0]))
    assert len(first.looks) == 3
    assert len(second.looks) == 0


def test_what_is_gone_does_not_read_as_there(years: Path) -> None:
    """Whoever keeps what surely exists, by the column, keeps none of it; the probability is that of the looks."""
    old, new = valuemap.read_map(years / "map"), valuemap.read_map(years / "map2")
    assert new.labels.existence is not None
    assert new.labels.state is not None
    is_gone = np.array(new.labels.state.texts()) == "gone"
    assert is_gone[new.labels.label_id == id_at(old, REMOVED)].all()
    assert (new.labels.existence[is_gone] <= 1.0 / 21.0 + 1e-12).all()
    assert np.median(new.labels.existence[~is_gone]) > 0.9
    sure, none = Looks(9, 9, 20.0, 0, 0), Looks(0, 0, 0.0, 0, 0)
    labels = new.labels[:4].replace(existence=np.array([0.99, 0.99, 0.99, 0.001]))
    looks = {0: (sure, Looks(9, 0, -9.0, 0, 0)), 1: (sure, none), 3: (sure, Looks(9, 0, -4.0, 0, 0))}
    told = existence_now(labels, ["gone", "gone", "uncertain", "gone"], looks)
    assert told is not None
    assert told.tolist() == pytest.approx([1.0 / (1.0 + math.exp(9.0)), 1.0 / 21.0, 0.99, 0.001])
    assert existence_now(labels.replace(existence=None), ["gone"] * 4, looks) is None


def test_changes_come_with_opportunities_and_dates(years: Path) -> None:
    old = valuemap.read_map(years / "map")
    changes = read_table(Changes, years / "map2" / "changes.parquet")
    row = {label: i for i, label in enumerate(changes.label_id.tolist())}
    kinds = changes.change.texts()
    removed = row[id_at(old, REMOVED)]
    assert kinds[removed] == "removed"
    assert changes.state.texts()[removed] == "gone"
    assert changes.misses[removed] >= 6
    assert changes.looks[removed] == changes.hits[removed] + changes.misses[removed]
    assert 2e7 <= changes.first_look_s[removed] <= changes.last_look_s[removed] < 3e7
    moved = row[id_at(old, MOVED_FROM)]
    assert kinds[moved] == "moved"
    np.testing.assert_allclose(changes.from_m[moved], MOVED_FROM, atol=0.3)
    np.testing.assert_allclose(changes.position_in_world_m[moved], MOVED_TO, atol=0.3)
    assert kinds[row[id_at(old, STAYS[0])]] == "unchanged"
    far = row[id_at(old, STAYS[0], start_m=FAR_M)]
    assert (kinds[far], changes.looks[far]) == ("unchanged", 0)
    assert kinds.count("added") == 1
    bridge = read_table(IdBridge, years / "map2" / "bridge.parquet")
    assert np.array_equal(bridge.old_label_id, bridge.label_id)
    assert len(bridge) >= len(old.labels) - 1


def test_an_update_is_a_map_of_all_the_data_but_for_the_ids(years: Path, tmp_path: Path) -> None:
    run("map", years / "map2" / "dataset", "--out", tmp_path / "all", "--calibration", years / "map",
        *(f"--set={each}" for each in SET))  # fmt: skip
    rebuilt, updated = valuemap.read_map(tmp_path / "all"), valuemap.read_map(years / "map2")

    def contents(result: Map) -> set[tuple[object, ...]]:
        without = ("label_id", "state")
        return {
            (*(value for name, value in row.items() if name not in without), *votes_of(result, row["label_id"]))
            for row in table_to_arrow(result.labels).to_pylist()
        }

    assert updated.labels.state is not None
    is_gone = np.array(updated.labels.state.texts()) == "gone"
    assert contents(replace(updated, labels=updated.labels.take(~is_gone))) <= contents(rebuilt)
    rebuilt, updated = (replace(each, labels=each.labels.replace(existence=None)) for each in (rebuilt, updated))
    missing = contents(rebuilt) - contents(updated)
    assert contents(updated) <= contents(rebuilt)
    assert len(missing) <= 1  # Where the moved one was.
    before = valuemap.read_map(years / "map")
    assert updated.run["settings_not_given"] == before.run["settings_not_given"] != []
    cells = [{path.name for path in (folder / "cells").glob("*.arrow")} for folder in (tmp_path / "all", years / "map2")]  # fmt: skip # noqa: E501
    assert cells[0] == cells[1]


def votes_of(result: Map, label_id: int) -> list[int]:
    return list(result.votes.detection_id[result.votes.label_id == label_id].tolist())


def test_an_update_in_portions_is_that_in_memory(years: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(portions, "LARGEST_IN_MEMORY", 0)
    monkeypatch.setattr(portions, "ROWS", 50)
    monkeypatch.setattr(update, "join_datasets", None)
    run("update", years / "map", "--add", years / "second", "--out", tmp_path / "map2")
    for name in ("labels.parquet", "votes.parquet", "changes.parquet", "bridge.parquet", "rejected.parquet"):
        assert (tmp_path / "map2" / name).read_bytes() == (years / "map2" / name).read_bytes(), name
    one, other = (valuemap.read_dataset(each / "map2" / "dataset") for each in (tmp_path, years))
    for name in ("cameras", "images", "detections"):
        assert table_to_arrow(getattr(one, name)).equals(table_to_arrow(getattr(other, name)))


def test_datasets_are_joined_in_portions_as_they_are_in_memory(years: Path) -> None:
    first, second = (valuemap.read_dataset(years / name) for name in ("first", "second"))
    ranged = second.detections.replace(range_m=np.full(len(second.detections), 20.0))
    second = ensure_checked(replace(second, detections=ranged))
    both = join_datasets(first, second)
    head, part = replace(first, detections=Detections.none()), len(first.detections) // 2
    parts = iter([first.detections[:part], first.detections[part:]])
    joined, added, all_portions = join_in_portions(head, parts, int(first.detections.detection_id[-1]), second)
    detections = join_tables(list(all_portions))
    for table, expected in ((detections, both.detections), (joined.images, both.images)):
        assert table_to_arrow(table).equals(table_to_arrow(expected))
    is_new = ~np.isin(both.images.image_id, first.images.image_id)
    assert np.array_equal(added.images.image_id, both.images.image_id[is_new])
    assert np.array_equal(added.detections.detection_id, both.detections.detection_id[-len(second.detections) :])
    # What another dataset has in between goes behind, too: ids ascend.
    odd = replace(first, detections=first.detections.replace(detection_id=2 * first.detections.detection_id))
    between = replace(second, detections=second.detections.replace(detection_id=2 * second.detections.detection_id + 1))
    ids = [each.detection_id for each in join_in_portions(head, iter([odd.detections]), int(odd.detections.detection_id[-1]), between)[2]]  # fmt: skip # noqa: E501
    assert np.all(np.diff(np.concatenate(ids)) > 0)


@pytest.mark.parametrize("most_runs", [0, 10_000])
@pytest.mark.parametrize("every", [1, 3, 1000])
def test_rows_of_both_datasets_ascend_whatever_ids_they_have(
    most_runs: int, every: int, years: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = valuemap.read_dataset(years / "first")
    monkeypatch.setattr(join, "_MOST_RUNS", most_runs)
    is_second = np.arange(len(whole.images)) // every % 2 == 1
    of_second = is_second[rows_of(whole.detections.image_id, whole.images.image_id)]
    if not is_second.any():  # None is in between: all are before.
        is_second[-1], of_second = True, whole.detections.image_id == whole.images.image_id[-1]
    first, second = (
        replace(whole, images=whole.images[chosen], detections=whole.detections[rows], truth=None)
        for chosen, rows in ((~is_second, ~of_second), (is_second, of_second))
    )
    # Of one camera with the same id: that of the second is called otherwise.
    both = join_datasets(first, second)
    images = both.images.replace(camera_id=whole.images.camera_id, pass_id=whole.images.pass_id)
    assert table_to_arrow(images).equals(table_to_arrow(whole.images))
    assert table_to_arrow(both.detections).equals(table_to_arrow(whole.detections))


def test_a_dataset_that_cannot_be_written_is_told_and_no_map_is_left(
    years: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(pieces: Sequence[Dataset], path: Path) -> None:
        if path.name == map_folder.DATASET:
            raise OutputError(f"{path}: cannot be written: No space left on device", hint="check free space")
        write_dataset_in_pieces(pieces, path)

    monkeypatch.setattr(update, "write_dataset_in_pieces", write)
    options = [years / "map", "--add", years / "second", "--out", tmp_path / "map2"]
    result = CliRunner().invoke(app, ["update", *map(str, options)])
    assert result.exit_code == 1
    assert "No space left" in result.stderr
    assert not (tmp_path / "map2").exists()


FILES = ("labels.parquet", "votes.parquet", "changes.parquet", "dataset/detections.parquet")


def test_a_dataset_is_on_disk_before_it_is_cut(years: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []
    build = pipeline.build_map_of_folder

    def built(folder: Path, *given: Any, **named: Any) -> Any:
        if folder.name == map_folder.DATASET:
            seen.append(folder.exists())
        return build(folder, *given, **named)

    monkeypatch.setattr(update, "build_map_of_folder", built)
    run("update", years / "map", "--add", years / "second", "--out", tmp_path / "map2", "--tile-size", "500")
    assert seen == [True]
    for name in FILES:
        assert (tmp_path / "map2" / name).read_bytes() == (years / "map2" / name).read_bytes(), name


def test_what_takes_one_core_is_done_beside_other_work(
    years: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_mapped_alone, is_written, is_compared = (threading.Event() for _ in range(3))
    build = pipeline.build_map_of_folder

    def built(folder: Path, config: valuemap.MapConfig, run: pipeline.Run, **named: Any) -> Any:
        result = build(folder, config, run, **named)
        if folder.name == map_folder.DATASET:
            assert is_mapped_alone.wait(60.0)
        else:
            is_mapped_alone.set()
        return result

    def write(pieces: Sequence[Dataset], path: Path) -> None:
        if path.name == map_folder.DATASET:
            is_written.set()
            assert is_compared.wait(60.0)
        write_dataset_in_pieces(pieces, path)

    def compared(*given: Any, **named: Any) -> Any:
        is_compared.set()
        assert is_written.wait(60.0)
        return compare(*given, **named)

    monkeypatch.setattr(update, "build_map_of_folder", built)
    monkeypatch.setattr(update, "write_dataset_in_pieces", write)
    monkeypatch.setattr(update, "compare", compared)
    run("update", years / "map", "--add", years / "second", "--out", tmp_path / "map2")
    for name in FILES:
        assert (tmp_path / "map2" / name).read_bytes() == (years / "map2" / name).read_bytes(), name


def test_an_update_that_ends_ends_what_is_done_beside_it(
    years: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build = pipeline.build_map_of_folder
    is_begun, ended = threading.Event(), list[str]()

    def built(folder: Path, config: valuemap.MapConfig, run: pipeline.Run, *, progress: Any, **named: Any) -> Any:
        if folder.name == map_folder.DATASET:

            def fail(what: str, _done: int, _total: int) -> None:
                if what == "cells":
                    assert is_begun.wait(60.0)
                    raise InputError("ended", hint="begin again")

            return build(folder, config, run, progress=fail, **named)
        is_begun.set()
        try:
            for _ in range(6000):
                progress("beside", 0, 1)
                time.sleep(0.01)
        except Stopped as stopped:
            ended.append(type(stopped).__name__)
            raise

    monkeypatch.setattr(update, "build_map_of_folder", built)
    given = [years / "map", "--add", years / "second", "--out", tmp_path / "map2"]
    result = CliRunner().invoke(app, ["update", *map(str, given)])
    assert result.exit_code == 1
    assert "ended" in result.stderr
    assert ended == ["Stopped"]


def test_cells_that_nobody_drove_through_are_not_solved_again(years: Path) -> None:
    before, after = ({p.name for p in (years / name / "cells").glob("*.arrow")} for name in ("map", "map2"))
    assert before & after
    assert after - before
    assert all(name.startswith("1_") for name in before & after)


def test_cells_of_a_dataset_that_was_changed_are_solved_again(years: Path, tmp_path: Path) -> None:
    first = valuemap.read_dataset(years / "first")
    center_px = first.detections.center_px.copy()
    place_m = camera_centers(first.images)[rows_of(first.detections.image_id, first.images.image_id)]
    center_px[np.argmax(place_m[:, 0])] += 0.25  # Where no new pass drove.
    valuemap.write_dataset(replace(first, detections=first.detections.replace(center_px=center_px)), tmp_path / "first")
    run("update", years / "map", "--add", years / "second", "--dataset", tmp_path / "first", "--out", tmp_path / "map2")
    before, after = ({p.name for p in (each / "cells").glob("*.arrow")} for each in (years / "map", tmp_path / "map2"))
    assert not before & after


def test_what_was_rejected_is_looked_for_once_and_pandas_not_at_all(years: Path, tmp_path: Path) -> None:
    code = """
import sys
import valuemap.cli
from valuemap import rejected
found, find = [], rejected.find_rejected
rejected.find_rejected = lambda *given: found.append(given) or find(*given)
try:
    valuemap.cli.main()
finally:
    print(len(found), "pandas" in sys.modules)
"""
    options = ["update", years / "map", "--add", years / "second", "--out", tmp_path / "map"]
    done = subprocess.run([sys.executable, "-c", code, *map(str, options)], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-2:] == ["1", "False"], done.stdout


def test_a_damaged_cell_of_the_old_map_is_named(years: Path, tmp_path: Path) -> None:
    shutil.copytree(years / "map", tmp_path / "map")
    for cell in (tmp_path / "map" / "cells").iterdir():
        cell.write_bytes(cell.read_bytes()[:-100])
    options = ["--add", years / "second", "--dataset", years / "first", "--out", tmp_path / "map2"]
    result = CliRunner().invoke(app, ["update", str(tmp_path / "map"), *map(str, options)])
    assert result.exit_code != 0
    assert ".arrow: cannot be read" in "".join(result.output.split("\n"))


def test_updated_maps_keep_what_was_rejected_of_all_the_data(years: Path) -> None:
    result = valuemap.read_map(years / "map2")
    assert result.rejected is not None
    assert len(result.rejected) > 0
    found = find_rejected(Evidence(result, valuemap.read_dataset(years / "map2" / "dataset")))
    assert table_to_arrow(found).equals(table_to_arrow(result.rejected))
    has_label = result.rejected.rival is not None and np.isin(result.rejected.rival, [-1, *result.labels.label_id])
    assert np.all(has_label)


def test_an_update_of_an_update_goes_on(years: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(pipeline, "read_dataset")  # What is in memory is not read again.
    third = drives([*STAYS, ADDED, MOVED_TO], 3, starts_m=(0.0,), passes=1, year=3)
    valuemap.write_dataset(third, tmp_path / "third")
    run("update", years / "map2", "--add", tmp_path / "third", "--out", tmp_path / "map3")
    second, new = valuemap.read_map(years / "map2"), valuemap.read_map(tmp_path / "map3")
    assert state_at(new, ADDED) == ("confirmed", id_at(second, ADDED))
    assert state_at(new, MOVED_TO) == ("confirmed", id_at(second, MOVED_TO))
    assert state_at(new, STAYS[1]) == ("confirmed", id_at(second, STAYS[1]))


def test_datasets_become_one(years: Path) -> None:
    first, second = valuemap.read_dataset(years / "first"), valuemap.read_dataset(years / "second")
    both = join_datasets(first, second)
    assert len(both.images) == len(first.images) + len(second.images)
    assert np.array_equal(both.detections.detection_id[: len(first.detections)], first.detections.detection_id)
    assert len(set(both.images.pass_id.texts())) == 8  # Six of the first year, and two that are named alike.
    untimed = Dataset(**{**vars(second), "images": second.images.replace(timestamp_s=None)})
    times = join_datasets(first, untimed).images.timestamp_s
    assert times is not None
    assert np.isnan(times).sum() == len(second.images)
    with pytest.raises(InputError, match="expected the frame of .*, found one of its own, with 0 -1 0 up"):
        join_datasets(first, Dataset(**{**vars(second), "frame": valuemap.Frame(up=(0.0, -1.0, 0.0))}))


def test_labels_are_matched_by_votes_one_to_one(years: Path) -> None:
    old = valuemap.read_map(years / "map")
    matched, common = match_labels(old.labels, old.votes, old.labels, old.votes)
    assert np.array_equal(matched, np.arange(len(old.labels)))
    assert np.array_equal(common, old.labels.votes)
    half = old.votes.take(np.flatnonzero(old.votes.detection_id % 20 == 0))
    none = old.votes.replace(detection_id=old.votes.detection_id + 10_000_000)
    assert (match_labels(old.labels, none, old.labels, old.votes)[0] == -1).all()
    assert (match_labels(old.labels, half, old.labels, old.votes)[1] <= common).all()


def test_what_cannot_be_updated_says_so(years: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["update", str(years / "first"), "--add", str(years / "second"), "--out", str(tmp_path / "x")])  # fmt: skip # noqa: E501
    assert result.exit_code == 1
    assert "is a dataset, not a map" in result.output
    assert not (tmp_path / "x").exists()


def test_another_frame_is_told_with_the_option_that_makes_it_the_same(years: Path, tmp_path: Path) -> None:
    first, anchor = valuemap.read_dataset(years / "first"), (-33.92345678901234, 18.4, 5.123456789)
    places = [tmp_path / name for name in ("first", "second")]
    for place, lon in zip(places, (18.4, 18.4 + 1e-12), strict=True):
        frame = valuemap.Frame(anchor=(anchor[0], lon, anchor[2]))
        valuemap.write_dataset(replace(first, frame=frame), place)
    with pytest.raises(InputError, match="expected the frame of") as error:
        update.update_map(years / "map", places[1], Run(tmp_path, ThreadEngine(1)), dataset=places[0])
    assert str(error.value).startswith(f"{places[1]}: expected the frame of {places[0]}, at latitude")
    assert error.value.hint == f"import {places[1]} again with --anchor -33.92345678901234 18.4 5.123456789"
    with pytest.raises(InputError) as error:
        refuse_other_frame(valuemap.Frame(up=(0.0, -1.0, 0.0)), valuemap.Frame(), "a", "b")
    assert error.value.hint == "import b again with --up 0.0 -1.0 0.0"
    refuse_other_frame(valuemap.Frame(up=(0.6, 0.0, 0.8)), valuemap.Frame(up=(0.6, 1e-16, 0.8)), "a", "b")


@pytest.mark.parametrize(("before", "again"), [("map", "first"), ("map2", "first"), ("map2", "second")])
@pytest.mark.parametrize("in_portions", [False, True])
def test_what_a_map_has_is_not_added_again(
    before: str, again: str, in_portions: bool, years: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if in_portions:
        monkeypatch.setattr(portions, "LARGEST_IN_MEMORY", 0)
    options = ["--add", years / again, "--out", tmp_path / "x"]
    result = CliRunner().invoke(app, ["update", str(years / before), *map(str, options)])
    assert result.exit_code == 1
    count = len(valuemap.read_dataset(years / again).images)
    told = f"expected images that the map does not have, found {count} of {count} that it has, such as '000.jpg'"
    assert told in " ".join(result.output.split())
    assert list(tmp_path.iterdir()) == []


def test_images_are_the_same_by_name_pose_and_time(years: Path) -> None:
    first = valuemap.read_dataset(years / "first").images
    some = np.arange(10, 20)
    same = first.take(some)
    renamed = same.replace(pass_id=Categories.from_texts(["another"] * 10), image_id=same.image_id + 1000)
    assert np.array_equal(join._same_images(first, renamed), np.arange(10))
    assert np.array_equal(join._same_images(first, renamed.replace(timestamp_s=None)), np.arange(10))
    assert np.array_equal(join._same_images(first.replace(timestamp_s=None), renamed), np.arange(10))
    assert same.timestamp_s is not None
    later = same.replace(timestamp_s=same.timestamp_s + np.where(some < 15, 0.0, 60.0))
    assert np.array_equal(join._same_images(first, later), np.arange(5))
    aside = same.replace(cam_from_world_m=same.cam_from_world_m + [0.0, 1e-9, 0.0])
    assert len(join._same_images(first, aside)) == 0
    assert len(join._same_images(first, same.replace(name=pa.array([f"{i}.png" for i in range(10)])))) == 0


def test_an_update_is_one_run_where_poses_are_corrected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = drives(STAYS, 1, starts_m=(0.0,), passes=3, year=1)
    second = drives(STAYS, 2, starts_m=(0.0,), passes=2, year=2)
    shift_m = np.random.default_rng(3).normal(0.0, 2.0, (5, 2))

    def moved(dataset: Dataset, way: float, *, keep_mean: bool = False) -> Dataset:
        """Return the dataset with each pass shifted, one way or back, about the mean of the passes that there are."""
        images = dataset.images
        time = images.timestamp_s
        assert time is not None
        number = np.array([int(name.split("-")[1]) for name in images.pass_id.texts()]) + np.where(time > 1.5e7, 3, 0)
        shift = shift_m - (shift_m[np.unique(number)].mean(axis=0) if keep_mean else 0.0)
        offset = np.column_stack([way * shift[number], np.zeros(len(number))])
        rotated = np.einsum("nij,nj->ni", rotation_matrices(images), offset)
        return replace(dataset, images=images.replace(cam_from_world_m=images.cam_from_world_m - rotated))

    def corrected(dataset: Dataset, config: valuemap.MapConfig, **_: object) -> Refined:
        if not config.poses.correct_poses:
            return nothing_found(dataset)
        record = {"found": "faults", "drives": [{"drive": 0}]}
        return Refined(moved(dataset, -1.0, keep_mean=True), record, True, place_m2=0.25 * np.eye(3))

    monkeypatch.setattr(correction, "refine_poses", corrected)
    monkeypatch.setattr(correction, "compare_poses", lambda *_, **__: Comparison(2.0, 1.0, 0.0, 10))
    valuemap.write_dataset(moved(first, 1.0), tmp_path / "first")
    valuemap.write_dataset(moved(second, 1.0), tmp_path / "second")
    run("map", tmp_path / "first", "--out", tmp_path / "map", *(f"--set={each}" for each in SET))
    run("update", tmp_path / "map", "--add", tmp_path / "second", "--out", tmp_path / "map2")
    settings = [f"--set={each}" for each in SET]
    run("map", tmp_path / "map2" / "dataset", "--out", tmp_path / "once", "--calibration", tmp_path / "map", *settings)
    updated, once = valuemap.read_map(tmp_path / "map2"), valuemap.read_map(tmp_path / "once")
    assert updated.run["poses"] == once.run["poses"]
    ours, theirs = (m.labels.position_in_world_m[np.lexsort(m.labels.position_in_world_m.T)] for m in (updated, once))
    assert np.array_equal(ours, theirs)
    for each in (updated, once):
        added_m2 = each.labels.stated_covariance_m2 - each.labels.covariance_m2
        assert np.allclose(added_m2, [0.25, 0.0, 0.0, 0.25, 0.0, 0.25], atol=1e-12)
    assert updated.labels.state is not None
    assert updated.labels.state.texts() == ["confirmed"] * len(STAYS)
    # What it is compared with is where the corrected poses put it.
    changes = read_table(Changes, tmp_path / "map2" / "changes.parquet")
    assert changes.change.texts() == ["unchanged"] * len(STAYS)


def test_a_map_that_control_points_moved_is_compared_where_its_dataset_is(years: Path, tmp_path: Path) -> None:
    truth = np.array([np.add(each, [start, 0.0, 0.0]) for start in (0.0, FAR_M) for each in STAYS])
    turn, middle = np.radians(0.05), truth.mean(axis=0)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    points = (truth - middle) @ rotation.T + middle + [1.0, 0.6, 0.2]
    lines = [",".join(f"{value:.4f}" for value in point) for point in points]
    (tmp_path / "points.csv").write_text("\n".join(["x,y,z", *lines]) + "\n")
    control = ("--control", tmp_path / "points.csv", *(f"--set={each}" for each in SET))
    run("map", years / "first", "--out", tmp_path / "map", *control)
    moved, plain = valuemap.read_map(tmp_path / "map"), valuemap.read_map(years / "map")
    assert moved.run["control"]["turn_deg"] != 0.0
    back = labels_before_control(moved)
    for name in ("position_in_world_m", "facing_azimuth_rad"):
        assert getattr(back, name) == pytest.approx(getattr(plain.labels, name), abs=1e-3)
    run("update", tmp_path / "map", "--add", years / "second", "--out", tmp_path / "map2")
    assert "control points" in valuemap.read_map(tmp_path / "map2").run["notes"][0]
    ours, theirs = (read_table(Changes, folder / "map2" / "changes.parquet") for folder in (tmp_path, years))
    assert ours.change.texts() == theirs.change.texts()
    assert ours.position_in_world_m == pytest.approx(theirs.position_in_world_m, abs=1e-3)
    assert ours.from_m == pytest.approx(theirs.from_m, abs=1e-3, nan_ok=True)
    assert "control" not in valuemap.read_map(tmp_path / "map2").run
    # Where the dataset was moved too, the map is where it is.
    as_it_is, is_put_back = update._in_frame_of(moved, moved)
    assert as_it_is.labels is moved.labels
    assert not is_put_back


def test_passes_are_moved_to_the_control_points_that_a_map_and_its_dataset_were_moved_to(
    years: Path, tmp_path: Path
) -> None:
    """With positions as wrong as those of the map, and a turn that makes a metre at the far street."""
    truth = np.array([np.add(each, [start, 0.0, 0.0]) for start in (0.0, FAR_M) for each in STAYS])
    turn, middle = np.radians(0.05), truth.mean(axis=0)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    shift = np.array([2.0, 1.5, 0.2])
    lines = (",".join(f"{value:.4f}" for value in point) for point in (truth - middle) @ rotation.T + middle + shift)
    (tmp_path / "points.csv").write_text("\n".join(["x,y,z", *lines]) + "\n")
    control = ("--control", tmp_path / "points.csv", "--write-poses", tmp_path / "posed")
    run("map", years / "first", "--out", tmp_path / "map", *control, *(f"--set={each}" for each in SET))
    run("update", tmp_path / "map", "--add", years / "second", "--out", tmp_path / "map2")
    ours, theirs = valuemap.read_map(tmp_path / "map2"), valuemap.read_map(years / "map2")
    assert ours.labels.state is not None
    assert theirs.labels.state is not None
    assert ours.labels.state.texts() == theirs.labels.state.texts()
    moved = (theirs.labels.position_in_world_m - middle) @ rotation.T + middle + shift
    assert ours.labels.position_in_world_m == pytest.approx(moved, abs=0.1)
    assert "are moved likewise" in ours.run["notes"][0]
    before = valuemap.read_map(tmp_path / "map")
    assert ours.run["control"] == before.run["control"]
    assert ours.labels.absolute_covariance_m2 is not None
    assert before.labels.absolute_covariance_m2 is not None
    added_m2 = (ours.labels.absolute_covariance_m2 - ours.labels.covariance_m2)[:, [0, 3, 5]]
    of_map_m2 = (before.labels.absolute_covariance_m2 - before.labels.covariance_m2)[:, [0, 3, 5]]
    assert added_m2.min(axis=0) == pytest.approx(of_map_m2.min(axis=0), rel=0.05)
    assert is_moved_with_map(ours, tmp_path / "map2" / "dataset")  # So that the next passes are moved, too.
    assert not is_moved_with_map(ours, years / "map2" / "dataset")
    assert not is_moved_with_map(theirs, years / "map2" / "dataset")


def test_joined_dataset_need_not_be_checked_again(years: Path) -> None:
    first, second = (valuemap.read_dataset(years / name) for name in ("first", "second"))
    joined = join_datasets(first, second)
    assert ensure_checked(joined) is joined
    # What is not looked at again would have been found right, and not changed.
    again = ensure_checked(replace(joined))
    assert again is not joined
    for name in ("cameras", "images", "detections"):
        assert table_to_arrow(getattr(again, name)).equals(table_to_arrow(getattr(joined, name)))
    # What was made by hand was never checked: nor is what it became a part of.
    assert ensure_checked(by_hand := join_datasets(replace(first), second)) is not by_hand
