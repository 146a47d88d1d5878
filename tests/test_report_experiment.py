"""What more passes bring: subsets, what is left out, quartiles, and going on after an interruption."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from report_city import city
from small_dataset import small_dataset
from told import Told
from valuemap import build_map, experiment
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, number_passes
from valuemap.errors import InputError, OutputError, SettingError
from valuemap.experiment import MARKER, RESULT, PassesResult, _curve, _ranks, experiment_passes, read_passes
from valuemap.paper.partition import partition_images

QUICK = MapConfig(method="paper")
"""An experiment makes many maps: those of this method are made a hundred times as fast."""


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PassesResult]:
    out = tmp_path_factory.mktemp("experiment") / "out"
    result = experiment_passes(city().dataset, out, QUICK, seeds=2, min_passes=3, progress=(told := Told()))
    told.check("voting", "maps of some passes")
    return out, result


def test_more_passes_place_objects_better(measured: tuple[Path, PassesResult]) -> None:
    result = measured[1]
    assert result.clusters >= 3
    assert result.reference == "the truth"
    recall, position = result.curves["recall"], result.curves["position_m"]
    assert [each.passes for each in recall] == list(range(1, len(recall) + 1))
    assert len(recall) >= 2
    assert position[-1].median < position[0].median
    assert recall[-1].median >= recall[0].median
    assert all(each.lower <= each.median <= each.upper for curve in result.curves.values() for each in curve)
    assert 0.5 < result.curves["reprojection_px"][-1].median < 20.0


def test_a_finished_experiment_is_read_and_an_interrupted_one_goes_on(
    measured: tuple[Path, PassesResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, result = measured
    assert read_passes(out) == read_passes(out / RESULT) == result
    shutil.copytree(out, tmp_path / "again")
    runs = sorted((tmp_path / "again" / "runs").glob("*.json"))
    runs[0].unlink()
    runs[1].write_text("{")  # Cut short by a full disk.
    made = []
    build = build_map

    def counting(*arguments: Any, **settings: Any) -> Any:
        made.append(1)
        return build(*arguments, **settings)

    monkeypatch.setattr(experiment, "build_map", counting)
    assert experiment_passes(city().dataset, tmp_path / "again", QUICK, seeds=2, min_passes=3) == result
    assert len(made) == 1 + 2  # The map of all images, and the two that were missing.
    for path in runs:
        assert path.read_bytes() == (out / "runs" / path.name).read_bytes()


def test_without_truth_the_map_of_all_passes_is_the_measure(tmp_path: Path) -> None:
    dataset = city().dataset
    bare = Dataset(dataset.name, dataset.frame, dataset.cameras, dataset.images, dataset.detections)
    result = experiment_passes(bare, tmp_path, QUICK, seeds=1, min_passes=3)
    assert result.reference == "the map of all passes"
    assert result.curves["recall"][-1].median > 0.8


def test_another_experiment_is_not_mixed_in(measured: tuple[Path, PassesResult], tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="on other data or with other settings"):
        experiment_passes(city().dataset, measured[0], MapConfig(), min_passes=3)
    with pytest.raises(SettingError, match="on other data"):
        experiment_passes(small_dataset(), measured[0], min_passes=2)
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=f"is a folder without {MARKER}"):
        experiment_passes(city().dataset, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_too_few_passes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no cluster with an object has 40 passes; the most are \d") as caught:
        experiment_passes(city().dataset, tmp_path / "a", QUICK, min_passes=40)
    assert "try --min-passes" in caught.value.hint
    with pytest.raises(SettingError, match="seeds: expected at least 1, found 0"):
        experiment_passes(city().dataset, tmp_path / "b", seeds=0)
    assert list(tmp_path.iterdir()) == []


def test_an_experiment_that_fails_before_its_first_map_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any, **__: Any) -> None:
        raise MemoryError

    with monkeypatch.context() as patched, pytest.raises(MemoryError):
        patched.setattr(experiment, "_measure", failing)
        experiment_passes(city().dataset, tmp_path / "out", QUICK, seeds=1, min_passes=3)
    assert list(tmp_path.iterdir()) == []


def test_a_place_for_an_experiment_is_tried_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("mine")
    monkeypatch.delattr(experiment, "build_map")
    with pytest.raises(OutputError, match="cannot be written"):
        experiment_passes(city().dataset, tmp_path / "file" / "out", QUICK, min_passes=3)


@pytest.mark.parametrize("content", [None, "", "[]", '{"curves": {}}', '{"curves": {"recall": [{"x": 1}]}}'])
def test_what_is_no_result_is_refused(content: str | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / RESULT).write_text(content)
    with pytest.raises(InputError, match=RESULT):
        read_passes(tmp_path)


def test_each_cluster_ranks_its_own_passes_in_one_order() -> None:
    cluster = np.array([0, 0, 0, 1, 1, 1, 1, 2])
    passes = np.array([0, 1, 1, 0, 2, 1, 3, 2])
    for seed in range(20):
        rank, last = _ranks(cluster, passes, seed)
        order = np.random.default_rng(seed).permutation(4)
        assert_array_equal(last, [1, 3, 0])
        for c in range(3):
            rows = np.flatnonzero(cluster == c)
            assert sorted(set(rank[rows])) == list(range(last[c] + 1))
            assert_array_equal(np.argsort(rank[rows], kind="stable"), np.argsort(order[passes[rows]], kind="stable"))


def test_the_curve_is_of_clusters_that_have_the_passes() -> None:
    """Cluster 0 has 2 passes, cluster 1 has 3, cluster 2 is not counted; nothing was found in cluster 1 once."""
    jobs = [(0, 1), (1, 1), (0, 2), (1, 2)]
    runs: list[dict[str, Any]] = [
        {"found": [1, 0, 9], "objects": [2, 4, 9]},
        {"found": [2, 0, 9], "objects": [2, 4, 9]},
        {"found": [2, 1, 9], "objects": [2, 4, 9]},
        {"found": [2, 3, 9], "objects": [2, 4, 9]},
    ]
    curve = _curve("recall", jobs, runs, np.array([0, 1]), np.array([2, 3, 9]))
    assert [(each.passes, each.clusters, each.median) for each in curve] == [(1, 2, 0.375), (2, 1, 0.5)]
    for run in runs:
        run |= {"position_m": [1.0, 2.0, 0.0]}
    curve = _curve("position_m", jobs, runs, np.array([0, 1]), np.array([2, 3, 9]))
    assert [(each.passes, each.clusters, each.median) for each in curve] == [
        (1, 1, 0.75),
        (2, 1, pytest.approx((2.0 + 2.0 / 3.0) / 2.0)),
    ]


def test_the_pass_left_out_is_never_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Detections of the last pass in the order of a cluster are moved by 50 px: the error says so, the maps do not."""
    dataset = city().dataset
    cluster = partition_images(dataset.images, MapConfig().partition).astype(np.int64)
    passes = number_passes(dataset.images)
    rank, last = _ranks(cluster, passes, 0)
    left_out = dataset.images.image_id[rank == last[cluster]]
    moved = np.isin(dataset.detections.image_id, left_out)
    center = dataset.detections.center_px + np.where(moved, 50.0, 0.0)[:, None] * [0.0, 1.0]
    spoiled = replace(dataset, detections=dataset.detections.replace(center_px=center))
    parts: list[Dataset] = []
    build = build_map

    def keeping(part: Dataset, *arguments: Any, **settings: Any) -> Any:
        parts.append(part)
        return build(part, *arguments, **settings)

    monkeypatch.setattr(experiment, "build_map", keeping)
    result = experiment_passes(spoiled, tmp_path, QUICK, seeds=1, min_passes=3)
    for part in parts[1:]:
        assert not np.isin(part.images.image_id, left_out).any()
    assert result.curves["reprojection_px"][0].median > 45.0


def test_the_result_is_plain_json(measured: tuple[Path, PassesResult]) -> None:
    content = json.loads((measured[0] / RESULT).read_text())
    assert set(content["curves"]) == {"recall", "reprojection_px", "position_m"}
    assert content["seeds"] == 2
