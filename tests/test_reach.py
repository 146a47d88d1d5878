"""How far away objects are looked for: told from the data where they are no street."""

from __future__ import annotations

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest

import laws
from valuemap import pipeline, reach
from valuemap.arrays import Floats
from valuemap.cameras import Rays, camera_centers
from valuemap.config import MapConfig, SimulationConfig, VoteConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.errors import SettingError
from valuemap.pipeline import build_map
from valuemap.simulate import simulate


@cache
def city(seed: int = 1) -> Dataset:
    few = SimulationConfig(passes_per_street=2, streets_north_south=2, streets_east_west=2, frame_spacing_m=4.0)
    return simulate(few, seed=seed)


def of_size(scale: float, dataset: Dataset | None = None) -> Dataset:
    changed = laws.scaled(scale)(dataset or city(), MapConfig(), np.random.default_rng(0))
    assert changed is not None
    return changed.dataset


def usual_m(dataset: Dataset) -> float | None:
    return reach.usual_distance_m(dataset, VoteConfig())


def true_distances_m(dataset: Dataset) -> Floats:
    shown, truth = dataset.truth_detections, dataset.truth
    assert shown is not None
    assert truth is not None
    assert truth.object_id is not None
    place = truth.position_in_world_m[rows_of(shown.object_id, truth.object_id)]
    row = rows_of(shown.detection_id, dataset.detections.detection_id)
    center = camera_centers(dataset.images)[rows_of(dataset.detections.image_id[row], dataset.images.image_id)]
    return np.asarray(np.linalg.norm(center - place, axis=1))


@pytest.mark.parametrize("seed", [1, 2])
def test_the_usual_distance_is_that_of_what_is_seen(seed: int) -> None:
    """Ranges are twice as long: half as far again is near enough."""
    assert usual_m(city(seed)) == pytest.approx(np.median(true_distances_m(city(seed))), rel=0.5)


@pytest.mark.parametrize("off_m", [0.3, 1.0])
def test_rays_that_cross_at_wide_angles_tell_it_where_poses_are_off(
    off_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, random = city(2).images, np.random.default_rng(0)
    moved_m = images.cam_from_world_m + random.normal(0.0, off_m, images.cam_from_world_m.shape)
    trembling = dataclasses.replace(city(2), images=images.replace(cam_from_world_m=moved_m))
    assert usual_m(trembling) == pytest.approx(usual_m(city(2)), rel=0.3)
    if off_m == 1.0:
        monkeypatch.setattr(reach, "_PARALLAX_DEG", 2.0)
        monkeypatch.setattr(reach, "_BEYOND_CHANCE", 1.0)
        assert (usual_m(trembling) or 0.0) > 1.5 * (usual_m(city(2)) or 0.0)


def test_coarse_boxes_are_seen_through_a_wider_gate(monkeypatch: pytest.MonkeyPatch) -> None:
    detections, random = city(2).detections, np.random.default_rng(0)
    moved_px = detections.center_px + random.normal(0.0, 10.0, detections.center_px.shape)
    coarse = dataclasses.replace(city(2), detections=detections.replace(center_px=moved_px))
    assert usual_m(coarse) == pytest.approx(usual_m(city(2)), rel=0.4)
    monkeypatch.setattr(reach, "GATES", (1.0,))
    assert usual_m(coarse) is None


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rays_that_meet_by_chance_tell_nothing(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    dealt = reach._dealt(city(seed), reach._stretches(city(seed)).astype(np.uint32))
    assert usual_m(dealt) is None
    monkeypatch.setattr(reach, "_BEYOND_CHANCE", 0.0)
    assert usual_m(dealt) is not None


@pytest.mark.parametrize(("by_chance", "is_told"), [(0.1, True), (0.42, True), (0.65, False)])
def test_where_most_rays_meet_they_tell_if_far_fewer_are_left_than_by_chance(
    by_chance: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rays of a straight drive lie side by side and meet by chance as well: three of four cannot be twice as many."""
    share = itertools.cycle([0.75, by_chance])

    def met(rays: Rays, *_: object) -> Floats:
        return np.full(round(next(share) * len(rays)), 30.0)

    monkeypatch.setattr(reach, "_distances_m", met)
    assert usual_m(city(1)) == (30.0 if is_told else None)


@pytest.mark.parametrize("law", ["detection ids", "image ids", "pass names", "moved"])
def test_ids_names_and_the_place_in_the_world_do_not_matter(law: str) -> None:
    changed = laws.LAWS[law](city(), MapConfig(), np.random.default_rng(0))
    assert changed is not None
    assert usual_m(changed.dataset) == pytest.approx(usual_m(city()), rel=1e-6)


def test_in_streets_it_is_what_it_is_and_elsewhere_in_proportion() -> None:
    config, note = reach.with_range(city(), MapConfig())
    assert (config.vote.max_range_m, config.vote.min_range_m, note) == (60.0, 2.0, None)
    told = {}
    for scale in (0.01, 1000.0):
        config, note = reach.with_range(of_size(scale), MapConfig())
        assert note is not None
        assert f"{config.vote.max_range_m:g} m" in note
        assert config.vote.farthest_m == pytest.approx(2.0 * scale * (usual_m(city()) or 0.0), rel=0.06)
        assert config.vote.nearest_m == pytest.approx(config.vote.farthest_m / 30.0)
        told[scale] = config.vote.farthest_m
    assert told[1000.0] == pytest.approx(1e5 * told[0.01])


def test_what_is_given_stays() -> None:
    tiny = of_size(0.01)
    given, note = reach.with_range(tiny, MapConfig(max_range_m=3.0, min_range_m=0.02))
    assert (given.vote.max_range_m, given.vote.min_range_m, note) == (3.0, 0.02, None)
    assert reach.with_range(tiny, MapConfig(max_range_m=3.0))[0].vote.min_range_m == pytest.approx(0.1)
    paper, note = reach.with_range(tiny, MapConfig("paper"))
    assert (paper.vote.max_range_m, paper.vote.min_range_m, note) == (60.0, 2.0, None)
    with pytest.raises(SettingError, match=r"min_range_m \(2.0\) must be less than max_range_m"):
        reach.with_range(tiny, MapConfig(min_range_m=2.0))


def test_what_does_not_tell_is_a_street(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few detections, rays that do not meet, and data so large that nobody looks."""
    tiny = of_size(0.01)
    few = dataclasses.replace(tiny, detections=tiny.detections.take(np.arange(49)))
    quat = np.random.default_rng(0).normal(size=tiny.images.cam_from_world_quat.shape)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    anyhow = dataclasses.replace(tiny, images=tiny.images.replace(cam_from_world_quat=quat))
    assert usual_m(tiny) is not None
    assert usual_m(few) is None
    assert usual_m(anyhow) is None
    assert reach.with_range(anyhow, MapConfig())[0].vote.farthest_m == 60.0
    monkeypatch.setattr(reach, "MOST_LOOKED_AT", len(tiny.images) + len(tiny.detections) - 1)
    assert usual_m(tiny) is None


def test_a_sample_of_stretches_tells_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    of_all = usual_m(city())
    monkeypatch.setattr(reach, "_MOST_DETECTIONS", len(city().detections) // 2)
    stretch = reach._stretches(city())
    assert 0 < np.count_nonzero(stretch >= 0) < len(stretch)
    assert usual_m(city()) == pytest.approx(of_all, rel=0.5)
    # Of images full of detections a stretch has eight all the same.
    full = dataclasses.replace(
        city(), detections=city().detections.take(np.repeat(np.arange(len(city().detections)), 30))
    )
    monkeypatch.setattr(reach, "_MOST_DETECTIONS", len(full.detections))
    assert np.bincount(reach._stretches(full)).max() >= 8


def test_a_world_of_a_hundredth_is_mapped_without_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model of a town on a table, or a reconstruction whose unit is a hundred metres."""
    before, tiny = build_map(city()), build_map(of_size(0.01))
    assert len(tiny.labels) == len(before.labels) >= 6
    apart_m = 100.0 * tiny.labels.position_in_world_m - before.labels.position_in_world_m
    assert np.linalg.norm(apart_m, axis=1).max() < 0.5
    assert "max_range_m was taken to be" in tiny.run["notes"][0]
    assert before.run["settings"]["max_range_m"] == 60.0
    assert not any("max_range_m" in note for note in before.run["notes"])
    # With the ranges of streets it is no map.
    monkeypatch.setattr(pipeline, "with_range", lambda _, config: (reach.with_usual_range(config), None))
    lost = build_map(of_size(0.01))
    distance_m = np.linalg.norm(
        100.0 * lost.labels.position_in_world_m[:, None] - before.labels.position_in_world_m[None], axis=2
    )
    assert np.count_nonzero(distance_m.min(axis=0, initial=np.inf) < 0.5) < len(before.labels) / 2


def test_a_range_too_short_for_the_world_is_one_line() -> None:
    images = city().images
    dataset = dataclasses.replace(city(), images=images.replace(cam_from_world_m=images.cam_from_world_m + 1e9))
    with pytest.raises(SettingError, match="too far for so short a range"):
        build_map(dataset, MapConfig(max_range_m=1e-6, correct_poses=0))
