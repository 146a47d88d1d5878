"""The core against Algorithm 1 as it is written."""

from __future__ import annotations

import math

import numpy as np
import pytest

from literal import Settings, algorithm_1
from scenes import Scene, as_dataset, random_scene
from valuemap.cameras import cast_rays
from valuemap.config import VoteConfig
from valuemap.paper.vote import vote_in_clusters
from valuemap.tables.candidates import Candidates


def vote(scene: Scene, config: VoteConfig, *, threads: int = 1) -> Candidates:
    rays = cast_rays(as_dataset(scene))
    one_cluster = np.zeros(len(scene.cameras), np.uint32)
    return vote_in_clusters(rays, one_cluster, config, threads=threads)[0]


def literal_settings(config: VoteConfig) -> Settings:
    return Settings(
        d_max_px=config.max_reprojection_error_px,
        theta_min_rad=math.radians(config.min_parallax_deg),
        r_min_m=config.nearest_m,
        r_max_m=config.farthest_m,
        alpha=config.min_vote_ratio,
        min_votes=config.min_votes,
    )


def assert_same_as_literal(scene: Scene, config: VoteConfig) -> int:
    found = vote(scene, config)
    classes = sorted({s.class_name for s in scene.sightings})
    expected = []
    for class_name in classes:
        rows = [k for k, s in enumerate(scene.sightings) if s.class_name == class_name]
        labels = algorithm_1(scene.cameras, [scene.sightings[k] for k in rows], literal_settings(config))
        expected += [(tuple(rows[k] for k in label.voters), label.point) for label in labels]
    expected.sort(key=lambda label: label[0][0])
    voters = [
        tuple(int(v) for v in found.voters[found.voter_offsets[i] : found.voter_offsets[i + 1]])
        for i in range(len(found))
    ]
    assert voters == [label[0] for label in expected]
    if expected:
        np.testing.assert_allclose(
            found.position_in_world_m, np.array([label[1] for label in expected]), rtol=0, atol=1e-6
        )
    return len(expected)


@pytest.mark.parametrize("seed", range(6))
def test_core_equals_the_literal_algorithm(seed: int) -> None:
    assert assert_same_as_literal(random_scene(seed), VoteConfig()) > 0


@pytest.mark.parametrize(("alpha", "labels"), [(0.5, 4), (1.25, 3), (2.0, 0)])
def test_core_equals_the_literal_algorithm_at_other_ratios(alpha: float, labels: int) -> None:
    scene = random_scene(105, images=9, objects=4, clutter=8)
    config = VoteConfig(min_vote_ratio=alpha, min_votes=2, min_parallax_deg=1.0, max_reprojection_error_px=9.0)
    assert assert_same_as_literal(scene, config) == labels


def test_core_equals_the_literal_algorithm_with_several_classes() -> None:
    scene = random_scene(200, images=12, objects=5, clutter=8, classes=("light", "sign"))
    assert assert_same_as_literal(scene, VoteConfig()) >= 2


def test_core_equals_the_literal_algorithm_under_clutter_alone() -> None:
    assert assert_same_as_literal(random_scene(300, objects=0, clutter=35), VoteConfig(min_votes=2)) > 0


def test_one_object_seen_by_all_gives_one_label_at_its_place() -> None:
    scene = random_scene(1, objects=1, clutter=0, noise_px=0.0, recall=1.0)
    found = vote(scene, VoteConfig())
    assert len(found) == 1
    assert len(found.voters) == len(scene.sightings)
    np.testing.assert_allclose(found.position_in_world_m, scene.objects, atol=1e-6)


def test_parallel_rays_propose_nothing() -> None:
    scene = random_scene(2, images=2, objects=1, clutter=0, noise_px=0.0, recall=1.0)
    assert len(scene.sightings) == 2
    assert len(vote(scene, VoteConfig(min_votes=2, min_parallax_deg=0.5))) == 1
    assert len(vote(scene, VoteConfig(min_votes=2, min_parallax_deg=80.0))) == 0


def test_every_pair_is_counted_once() -> None:
    scene = random_scene(3, images=12, clutter=30)
    rays = cast_rays(as_dataset(scene))
    _, counts = vote_in_clusters(rays, np.zeros(12, np.uint32), VoteConfig())
    images = np.array([s.image for s in scene.sightings])
    assert counts["pairs"] == sum(int((images[k + 1 :] != images[k]).sum()) for k in range(len(images)))
    assert counts["pairs"] == sum(n for name, n in counts.items() if name != "pairs")
    assert all(n > 0 for name, n in counts.items() if name != "pairs_rejected_behind")


def test_clusters_do_not_see_each_other() -> None:
    scene = random_scene(4, images=12, objects=1, clutter=0, recall=1.0)
    rays = cast_rays(as_dataset(scene))
    halves = (np.arange(12) % 2).astype(np.uint32)
    found, _ = vote_in_clusters(rays, halves, VoteConfig())
    assert found.cluster is not None
    assert sorted(found.cluster) == [0, 1]
    for row in range(2):
        members = found.voters[found.voter_offsets[row] : found.voter_offsets[row + 1]]
        assert set(halves[rays.image_row[members]]) == {found.cluster[row]}


def test_a_report_that_raises_stops_the_work() -> None:
    scene = random_scene(5, images=150, objects=12, clutter=2000)

    def stop(what: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    rays = cast_rays(as_dataset(scene))
    each = np.arange(150).astype(np.uint32) // 75
    with pytest.raises(KeyboardInterrupt):
        vote_in_clusters(rays, each, VoteConfig(min_parallax_deg=0.1, max_reprojection_error_px=50.0), progress=stop)
