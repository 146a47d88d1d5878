"""Poses of all pictures from their pairs: two rotations of a plane, lengths, wrong pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from valuemap.arrays import Bools, Floats
from valuemap.readers.structure.pose_graph import _north_sigma_rad, _of_one_place, start_of
from valuemap.readers.structure.two_views import Pair, _turns_by_plane, find_way

COUNT, STEP_M, FOCAL_PX = 30, 2.0, 500.0
LOOKING_NORTH = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def drive() -> tuple[Floats, Floats]:
    """Rotations, cam from world, and centres of a drive round a corner, by 24 degrees from picture to picture."""
    heading = np.radians(np.clip((np.arange(COUNT) - 13) * 24.0, 0.0, 96.0))
    center = np.cumsum(STEP_M * np.column_stack([np.sin(heading), np.cos(heading), np.zeros(COUNT)]), axis=0)
    turn = Rotation.from_rotvec(np.outer(-heading, [0.0, 0.0, 1.0])).as_matrix()
    return LOOKING_NORTH @ np.swapaxes(turn, 1, 2), center


def seen(points: Floats, rotation: Floats, center: Floats, random: np.random.Generator) -> tuple[Bools, Floats]:
    """Which points (P) a camera sees up to 30 m away, and in what directions (P, 3), half a pixel wrong."""
    in_cam = (points - center) @ rotation.T
    pixel = in_cam[:, :2] / in_cam[:, 2:] * FOCAL_PX + random.normal(0.0, 0.5, (len(points), 2))
    inside = (in_cam[:, 2] > 2.0) & (in_cam[:, 2] < 30.0) & (np.abs(pixel) < [320.0, 240.0]).all(axis=1)
    ray = np.column_stack([pixel / FOCAL_PX, np.ones(len(points))])
    return inside, ray / np.linalg.norm(ray, axis=1)[:, None]


def pairs_of(rotation: Floats, center: Floats, seed: int, steps: int = 4) -> list[Pair]:
    """Return pairs along a drive with what they see of points all around, and their true rotations."""
    random = np.random.default_rng(seed)
    points = np.array([-25.0, -10.0, -1.0]) + random.random((6000, 3)) * [85.0, 80.0, 12.0]
    sights = [seen(points, r, c, random) for r, c in zip(rotation, center, strict=True)]
    found = []
    for one in range(len(center)):
        for two in range(one + 1, min(one + 1 + steps, len(center))):
            both = np.flatnonzero(sights[one][0] & sights[two][0])
            both = both[random.random(len(both)) < 0.7]
            ray = np.stack([sights[one][1][both], sights[two][1][both]])
            noise = Rotation.from_rotvec(random.normal(0.0, 0.003, 3)).as_matrix()
            turn = noise @ rotation[two] @ rotation[one].T
            if len(both) >= 30:
                found.append(Pair(one, two, turn[None], np.column_stack([both, both]), ray))
    return found


def errors(pairs: list[Pair], rotation: Floats, center: Floats, gps_sigma_m: float = 0.3) -> tuple[Floats, Floats]:
    """Return how wrong the poses are: positions, m, where all are there, and rotations, degrees, beside each other."""
    random = np.random.default_rng(5)
    gps = center + random.normal(0.0, gps_sigma_m, center.shape)
    poses = start_of(pairs, np.zeros(len(center), np.int64), gps, np.full(len(center), gps_sigma_m))
    assert sorted(poses) == list(range(len(center)))
    off = np.array([poses[row][0].T @ rotation[row] for row in range(len(center))])
    turned = np.degrees(Rotation.from_matrix(off[0].T @ off).magnitude())
    away = np.linalg.norm([poses[row][1] - center[row] for row in range(len(center))], axis=1)
    return away, turned


def test_poses_come_from_pairs() -> None:
    rotation, center = drive()
    away, turned = errors(pairs_of(rotation, center, 0), rotation, center)
    assert away.max() < 0.5
    assert turned.max() < 1.0


def test_a_plane_allows_two_rotations_and_the_true_one_is_one_of_them() -> None:
    random = np.random.default_rng(0)
    wall = np.column_stack([random.uniform(-8.0, 8.0, 300), np.full(300, 15.0), random.uniform(-4.0, 4.0, 300)])
    turn = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.0, -0.3]]).as_matrix()
    rotation, center = LOOKING_NORTH @ np.swapaxes(turn, 1, 2), np.array([[0.0, 0.0, 0.0], [0.8, 2.0, 0.0]])
    (first, one), (second, two) = (seen(wall, r, c, random) for r, c in zip(rotation, center, strict=True))
    both = first & second
    found = _turns_by_plane(one[both], two[both])
    off = np.degrees(Rotation.from_matrix(found @ (rotation[1] @ rotation[0].T).T).magnitude())
    assert len(found) == 2
    assert off.min() < 1.0
    assert off.max() > 3.0
    # Points all around lie in no plane.
    points = np.array([-8.0, 4.0, -4.0]) + random.random((300, 3)) * [16.0, 20.0, 8.0]
    (first, one), (second, two) = (seen(points, r, c, random) for r, c in zip(rotation, center, strict=True))
    assert len(_turns_by_plane(one[first & second], two[first & second])) == 0


@pytest.mark.parametrize("steps", [4, 1])
def test_of_two_rotations_that_is_taken_with_which_the_others_agree(steps: int) -> None:
    """At the corner each pair gives a wrong one first. Where only neighbours are paired, depths alone can tell."""
    rotation, center = drive()
    pairs = pairs_of(rotation, center, 1, steps)
    both, wrong = [], []
    for pair in pairs:
        twisted = pair.second_from_first
        if pair.second >= 13 and pair.first <= 17:
            twisted = Rotation.from_rotvec([0.0, 0.12, 0.0]).as_matrix() @ twisted
        both.append(replace(pair, second_from_first=np.concatenate([twisted, pair.second_from_first])))
        wrong.append(replace(pair, second_from_first=twisted))
    away, turned = errors(both, rotation, center)
    assert away.max() < 0.6
    assert turned.max() < 1.5
    assert errors(wrong, rotation, center)[1].max() > 5.0


def test_pairs_of_different_places_are_not_believed() -> None:
    rotation, center = drive()
    random, pairs = np.random.default_rng(2), pairs_of(rotation, center, 2)
    for one, two in ((2, 20), (3, 25), (9, 28)):
        ray = random.normal(0.0, 0.2, (2, 40, 3)) + [0.0, 0.0, 1.0]
        ray /= np.linalg.norm(ray, axis=2)[:, :, None]
        pairs.append(Pair(one, two, Rotation.random(1, rng=one).as_matrix(), random.integers(0, 6000, (40, 2)), ray))
    away, turned = errors(pairs, rotation, center)
    assert away.max() < 0.5
    assert turned.max() < 1.0


def test_houses_alike_in_another_street_do_not_close_a_round() -> None:
    """The first picture and the last show houses alike, in more features than the pictures at the corner share."""
    rotation, center = drive()
    poor = [
        replace(pair, feature=pair.feature[:35], ray=pair.ray[:, :35])
        if pair.first <= 15 < pair.second and pair.second == pair.first + 1
        else pair
        for pair in pairs_of(rotation, center, 2)
        if not pair.first <= 15 < pair.second or pair.second == pair.first + 1
    ]
    true = next(pair for pair in pairs_of(rotation, center, 4) if pair.first == 0 and pair.second == 1)
    alike = [replace(true, first=0, second=COUNT - back, feature=true.feature + 6000 * back) for back in (1, 2, 3)]
    away, turned = errors([*poor, *alike], rotation, center)
    assert away.max() < 1.0
    assert turned.max() < 3.0
    # Where the way around says the same, they are believed.
    closing = replace(true, first=0, second=COUNT - 1, second_from_first=(rotation[-1] @ rotation[0].T)[None])
    kept = _of_one_place([*poor, closing, *alike], np.zeros(COUNT, np.int64))
    assert len(kept) == len(poor) + 1
    assert kept[-1] is closing


def broken_at_the_corner() -> tuple[list[Pair], Floats, Floats]:
    """Pairs of a drive whose two streets one pair alone holds together, turned by 40 degrees too much."""
    rotation, center = drive()
    pairs = [pair for pair in pairs_of(rotation, center, 6) if not pair.first <= 15 < pair.second]
    twist = Rotation.from_rotvec([0.0, 0.7, 0.0]).as_matrix()
    true = next(pair for pair in pairs_of(rotation, center, 6) if pair.first == 15 and pair.second == 16)
    pairs.append(replace(true, second_from_first=twist @ true.second_from_first, feature=true.feature + 10_000))
    return pairs, rotation, center


def test_a_wrong_rotation_between_two_streets_leaves_two_pieces_on_their_gps() -> None:
    pairs, rotation, center = broken_at_the_corner()
    random, sigma_m = np.random.default_rng(7), np.full(COUNT, 0.3)
    poses = start_of(pairs, np.zeros(COUNT, np.int64), center + random.normal(0.0, 0.3, center.shape), sigma_m)
    assert sorted(poses) == list(range(COUNT))
    for street in (range(16), range(16, COUNT)):
        turned = [np.degrees(Rotation.from_matrix(poses[row][0].T @ rotation[row]).magnitude()) for row in street]
        assert max(turned) < 5.0
        assert max(np.linalg.norm(poses[row][1] - center[row]) for row in street) < 0.6


def test_a_piece_whose_gps_tells_no_north_is_left_out_where_rotations_are_wrong() -> None:
    pairs, _, center = broken_at_the_corner()
    random, sigma_m = np.random.default_rng(7), np.full(COUNT, 9.0)
    poses = start_of(pairs, np.zeros(COUNT, np.int64), center + random.normal(0.0, 0.3, center.shape), sigma_m)
    assert sorted(poses) == list(range(16))


def test_noise_of_a_car_that_stands_tells_no_north() -> None:
    noise, sigma_m = np.random.default_rng(3).normal(0.0, 2.0, (60, 3)), np.full(60, 2.0)
    street = noise + np.outer(np.arange(60.0), [2.0, 0.0, 0.0])
    assert _north_sigma_rad(noise, sigma_m) > 0.12
    # 2 m over the root of the sum of squares of ways from the middle.
    assert _north_sigma_rad(street, sigma_m) == pytest.approx(2.0 / np.sqrt(4.0 * 60.0**3 / 12.0), rel=0.1)


def test_pictures_of_a_car_that_stands_are_at_one_place() -> None:
    """Their GPS is not: without parallax a pair says how near its pictures are, as others know the depths."""
    rotation, center = drive()
    where = np.concatenate([np.arange(8), np.full(8, 8), np.arange(9, COUNT)])
    rotation, center = rotation[where], center[where]
    random = np.random.default_rng(3)
    gps = center + random.normal(0.0, 2.0, center.shape)
    poses = start_of(pairs_of(rotation, center, 3, 6), np.zeros(len(center), np.int64), gps, np.full(len(center), 2.0))
    standing = np.array([poses[row][1] for row in np.flatnonzero(where == 8).tolist()])
    assert np.linalg.norm(standing - standing.mean(axis=0), axis=1).max() < 0.2
    assert np.linalg.norm(gps[where == 8] - center[where == 8], axis=1).max() > 2.0


def test_the_scale_is_the_same_along_a_drive() -> None:
    """By the GPS of the first pictures alone, without noise, the last are where they are."""
    rotation, center = drive()
    gps = np.where(np.arange(COUNT)[:, None] < 18, center, np.nan)
    poses = start_of(pairs_of(rotation, center, 4), np.zeros(COUNT, np.int64), gps, np.full(COUNT, 0.05))
    assert np.linalg.norm(poses[COUNT - 1][1] - center[-1]) < 1.0
    nowhere = np.full((COUNT, 3), np.nan)
    assert start_of(pairs_of(rotation, center, 4), np.zeros(COUNT, np.int64), nowhere, np.ones(COUNT)) == {}


def test_the_way_between_two_cameras_is_where_most_matches_say() -> None:
    """A third of the matches are wrong."""
    random = np.random.default_rng(0)
    points = np.array([-10.0, 5.0, -3.0]) + random.random((300, 3)) * [20.0, 20.0, 8.0]
    way = np.array([0.6, 2.0, 0.1])
    first, second = points.copy(), points - way
    second[:100] += random.normal(0.0, 3.0, (100, 3))
    rays = [ray / np.linalg.norm(ray, axis=1)[:, None] for ray in (first, second)]
    found = find_way(*rays)
    length = np.linalg.norm(way)
    assert found.direction @ way / length > np.cos(np.radians(0.2))
    assert found.fine[100:].mean() > 0.95
    assert found.fine[:100].mean() < 0.3
    expected = np.linalg.norm(points, axis=1) / length
    assert np.median(np.abs(found.depth[0] / expected - 1.0)[100:]) < 0.01
