"""The laws of real data: each change is one, is undone when maps are compared, and is found where it tells."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import laws
from block import SHORT_STREETS
from scenes import as_dataset, random_scene
from valuemap.config import MapConfig, SimulationConfig
from valuemap.dataset import Dataset
from valuemap.map_folder import Map
from valuemap.pipeline import build_map
from valuemap.simulate import simulate
from valuemap.tables import Categories

ONE_CLUSTER = MapConfig(method="paper").with_settings(["cluster_radius_m=500"])


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Two cameras in each of two passes past five objects of two classes."""
    scene = as_dataset(random_scene(3, images=24, objects=5, clutter=4, noise_px=0.5, classes=("light", "sign")))
    images, cameras = scene.images, scene.cameras
    both = dataclasses.replace(
        cameras,
        camera_id=np.array([7, 8]),
        model=Categories.from_texts(["PINHOLE"] * 2),
        width_px=cameras.width_px.repeat(2),
        height_px=cameras.height_px.repeat(2),
        params=cameras.params * 2,
    )
    number = np.arange(len(images))
    passes = Categories.from_texts([f"drive {i // 12}" for i in number])
    return dataclasses.replace(
        scene,
        cameras=both,
        images=images.replace(camera_id=7 + number % 2, pass_id=passes, position_sigma_m=np.full(len(images), 0.1)),
        detections=scene.detections.replace(range_m=np.full(len(scene.detections), 20.0)),
    )


@pytest.fixture(scope="module")
def before(dataset: Dataset) -> Map:
    return build_map(dataset, ONE_CLUSTER)


def test_a_method_without_memory_of_names_keeps_all_laws(dataset: Dataset, before: Map) -> None:
    """In one cluster nothing in the paper's method depends on what the laws change."""
    assert len(before.labels) >= 4
    verdicts = laws.check_laws(dataset, ONE_CLUSTER)
    assert list(verdicts) == list(laws.LAWS)
    assert {name: str(verdict) for name, verdict in verdicts.items()} == dict.fromkeys(laws.LAWS, "holds")


@pytest.mark.parametrize("name", list(laws.LAWS))
def test_every_law_changes_something(dataset: Dataset, name: str) -> None:
    changed = laws.LAWS[name](dataset, ONE_CLUSTER, np.random.default_rng(0))
    assert changed is not None
    after, images, detections = changed.dataset, changed.dataset.images, changed.dataset.detections
    assert {
        "detection ids": not np.array_equal(changed.old_detection_id, detections.detection_id),
        "image ids": images.name != dataset.images.name and np.all(np.diff(images.image_id) > 0),
        "pass names": images.pass_id.names != dataset.images.pass_id.names and len(images.pass_id.names) == 2,
        "split rigs": len(images.pass_id.names) == 4,
        "threads": changed.threads == 1,
        "moved": not np.allclose(images.cam_from_world_quat, dataset.images.cam_from_world_quat),
        "x 10": detections.range_m is not None and detections.range_m[0] == 200.0,
        "x 0.1": images.position_sigma_m is not None and np.isclose(images.position_sigma_m[0], 0.01),
    }[name]
    assert len(after.detections) == len(dataset.detections)


def test_a_larger_world_has_larger_settings(dataset: Dataset, before: Map) -> None:
    changed = laws.LAWS["x 10"](dataset, ONE_CLUSTER, np.random.default_rng(0))
    assert changed is not None
    assert changed.config.vote.max_range_m == 10 * ONE_CLUSTER.vote.farthest_m
    assert changed.config.vote.max_reprojection_error_px == ONE_CLUSTER.vote.max_reprojection_error_px
    assert changed.config.noise.position_sigma_m is None
    without = build_map(changed.dataset, ONE_CLUSTER)
    assert not laws.compare_maps(before, without, changed).holds


def test_rigs_are_split_where_there_are_any(dataset: Dataset) -> None:
    one = dataclasses.replace(dataset, images=dataset.images.replace(camera_id=np.full(len(dataset.images), 7)))
    assert laws.check_laws(one, ONE_CLUSTER, ["split rigs"]) == {"split rigs": None}


def test_what_differs_is_told(dataset: Dataset, before: Map) -> None:
    same = laws.Changed(dataset, ONE_CLUSTER, dataset.detections.detection_id)
    labels, votes = before.labels, before.votes
    count = len(labels)
    assert laws.compare_maps(before, before, same) == laws.Verdict(count, count, count, 0.0)
    moved = labels.replace(position_in_world_m=labels.position_in_world_m + [0.0, 0.3, 0.4])
    verdict = laws.compare_maps(before, dataclasses.replace(before, labels=moved), same)
    assert (verdict.holds, verdict.same, round(verdict.farthest_m, 9)) == (False, count, 0.5)
    fewer_votes = dataclasses.replace(before, votes=votes.take(np.arange(1, len(votes))))
    assert laws.compare_maps(before, fewer_votes, same) == laws.Verdict(count, count, count - 1, 0.0)
    other = Categories.from_texts(["other"] * count)
    assert (
        laws.compare_maps(before, dataclasses.replace(before, labels=labels.replace(class_name=other)), same).same == 0
    )


@pytest.mark.parametrize("seed", [0, 3])
def test_a_world_of_another_size_with_its_settings_is_the_same_map(seed: int) -> None:
    """Every length of the method is in proportion to `max_range_m`, in the core and where poses are compared."""
    few = SimulationConfig(passes_per_street=2, streets_north_south=2, streets_east_west=2, frame_spacing_m=4.0)
    few = dataclasses.replace(few, **SHORT_STREETS)
    verdicts = laws.check_laws(simulate(few, seed=seed), MapConfig(), ["x 10", "x 0.1"])
    assert {name: str(verdict) for name, verdict in verdicts.items()} == {"x 10": "holds", "x 0.1": "holds"}
