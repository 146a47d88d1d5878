"""Straight drives side by side: what their residuals tell of noise, and which errors they prove."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

import valuemap
from literal import Floats, Pinhole, Sighting
from scenes import FOCAL, HEIGHT, WIDTH, Scene, as_dataset
from test_refine import city, few_observations
from test_robust import ALONG_X, INTRINSICS
from valuemap.cameras import camera_centers, camera_poses
from valuemap.dataset import Dataset
from valuemap.refine import noise, poses, refine_poses, select
from valuemap.refine.adjust import Adjustment, Scales, adjust
from valuemap.refine.estimate import WIDE, Estimate
from valuemap.refine.footage import with_poses
from valuemap.refine.noise import NoiseLeft
from valuemap.refine.poses import Refined
from valuemap.refine.residuals import CAMERA_MOUNT, OFFSET, State
from valuemap.refine.select import Selected


def lanes(
    seed: int,
    *,
    lane_m: tuple[float, ...] = (-2.0, 2.0, 5.0),
    off_m: Floats | None = None,
    left_deg: tuple[float, ...] | None = None,
    is_back: tuple[bool, ...] | None = None,
    image_m: float = 0.1,
    drift_m: float = 0.0,
    signs_count: int = 28,
) -> tuple[Dataset, Floats]:
    """Return straight drives side by side past signs, and where the signs are.

    Each drive wanders aside by 0.15 m and is off by 0.3 m, or by `off_m` (drives, 3), and turned to the left by
    `left_deg` (drives); each image is off by `image_m` and 0.1 deg, and others around alike by `drift_m`. Where it
    `is_back` (drives), it goes the other way.
    """
    left_rad = np.radians(np.zeros(len(lane_m)) if left_deg is None else left_deg)
    turned = Rotation.from_rotvec(np.outer(left_rad, [0.0, 0.0, 1.0])).as_matrix()
    ways = np.where(np.zeros(len(lane_m), np.bool_) if is_back is None else is_back, -1.0, 1.0)
    rng = np.random.default_rng(seed)
    signs = np.column_stack([np.arange(40.0, 600.0, 20.0), rng.uniform(-9.0, 9.0, 28), rng.uniform(2.5, 7.0, 28)])
    signs[:, 1] += 4.0 * np.sign(signs[:, 1])
    signs = signs[:signs_count]
    end_m = signs[-1, 0] + 20.0
    off_m = rng.normal(0.0, 0.3, (len(lane_m), 3)) if off_m is None else off_m
    cameras: list[Pinhole] = []
    sightings: list[Sighting] = []
    passes: list[str] = []
    heights_px: list[float] = []
    for drive, lane in enumerate(lane_m):
        for x in np.arange(rng.uniform(0.0, 6.0), end_m, 6.0):
            center = np.array([x, lane + 0.15 * np.sin(x / 40.0 + drive), 1.6])
            along = ALONG_X @ np.diag([ways[drive], ways[drive], 1.0])
            true = Pinhole(INTRINSICS, along, -along @ center)
            ahead_m = ways[drive] * (signs[:, 0] - x)
            for sign in signs[(ahead_m > 6.0) & (ahead_m < 60.0)]:
                pixel, depth = true.project(sign)
                if 0 <= pixel[0] < WIDTH and 0 <= pixel[1] < HEIGHT and rng.random() < 0.9:
                    sightings.append(Sighting(len(cameras), "sign", pixel + rng.normal(0.0, 0.5, 2)))
                    heights_px.append(0.9 * FOCAL / depth)
            own = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=3)).as_matrix() @ along @ turned[drive].T
            drift = drift_m * np.sin(x / np.array([31.0, 23.0, 37.0]) + 2.0 * drive)
            center = center + off_m[drive] + image_m * rng.normal(size=3) + drift
            cameras.append(Pinhole(INTRINSICS, own, -own @ center))
            passes.append(f"drive {drive}")
    dataset = as_dataset(Scene(cameras, sightings, signs), passes=passes)
    size_px = np.outer(heights_px, [1.0, 1.0])
    return dataclasses.replace(dataset, detections=dataset.detections.replace(size_px=size_px)), signs


@pytest.mark.parametrize("seed", [3, 4, 6])
def test_straight_drives_that_tremble_prove_no_error_of_their_camera(seed: int) -> None:
    """How far they wander aside is known no better than their images, so that it tells no focal length and no roll."""
    refined = refine_poses(lanes(seed)[0], valuemap.MapConfig())
    assert refined.is_corrected
    assert refined.record["cameras"] == []


@pytest.mark.parametrize(("seed", "lane_m", "to_deg"), [(3, -2.0, 250.0), (4, -2.0, 250.0), (2, 2.0, 70.0)])
def test_two_drives_in_opposite_directions_that_are_apart_prove_no_focal_length(
    seed: int, lane_m: float, to_deg: float
) -> None:
    """What a place tells of both is told less well as long as focal lengths may be anything."""
    off_m = np.outer([0.25, -0.25], [np.cos(np.radians(to_deg)), np.sin(np.radians(to_deg)), 0.0])
    dataset, _ = lanes(seed, lane_m=(lane_m, -lane_m), off_m=off_m, is_back=(False, True), image_m=0.02)
    refined = refine_poses(dataset, valuemap.MapConfig())
    assert refined.record["cameras"] == []
    np.testing.assert_allclose(moved_m(dataset, refined), -off_m, atol=0.1)


@pytest.mark.parametrize("seed", [1, 2])
def test_what_drives_are_off_by_is_not_hidden_by_how_they_are_turned(seed: int) -> None:
    off_m = np.outer([1.0, -1.0], [np.cos(np.radians(250.0)), np.sin(np.radians(250.0)), 0.0])
    dataset, _ = lanes(seed, lane_m=(0.0, 0.0), off_m=off_m, left_deg=(1.5, -1.5), image_m=0.02)
    refined = refine_poses(dataset, valuemap.MapConfig())
    np.testing.assert_allclose(moved_m(dataset, refined), -off_m, atol=0.1)
    turned_deg = [drive["turned_deg"][1] for drive in refined.record["drives"]]
    np.testing.assert_allclose(sorted(turned_deg), [-1.5, 1.5], atol=0.1)


def test_a_straight_drive_is_moved_along_itself_and_not_taken_to_be_late() -> None:
    dataset, _ = lanes(1, off_m=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.5], [1.0, 0.0, 0.0]]))
    moved = moved_m(dataset, refine_poses(dataset, valuemap.MapConfig()))
    np.testing.assert_allclose(moved, np.array([[1.0, 0.0, 1.5], [1.0, 0.0, -3.0], [-2.0, 0.0, 1.5]]) / 3.0, atol=0.1)


@pytest.mark.parametrize("up_m", [3.0, -6.0, 45.0])
def test_drives_that_are_metres_higher_or_lower_are_laid_onto_each_other(up_m: float) -> None:
    dataset, _ = lanes(1, off_m=np.array([[0.0, 0.0, 0.0], [0.4, 0.0, up_m], [0.0, 0.6, 0.0]]))
    moved = moved_m(dataset, refine_poses(dataset, valuemap.MapConfig()))
    np.testing.assert_allclose(moved[:, 2], np.array([1.0, -2.0, 1.0]) * up_m / 3.0, atol=0.15)


@pytest.mark.parametrize("apart_m", [0.75, 1.5, 3.0])
def test_two_drives_that_are_apart_are_brought_together(apart_m: float) -> None:
    off_m = apart_m * np.array([[0.5, 0.1, 0.0], [-0.5, -0.1, 0.0]])
    dataset, _ = lanes(2, lane_m=(-2.0, 2.0), off_m=off_m)
    moved = moved_m(dataset, refine_poses(dataset, valuemap.MapConfig()))
    np.testing.assert_allclose((moved[1] - moved[0])[:2], (off_m[0] - off_m[1])[:2], atol=0.15)


@pytest.mark.parametrize("signs", [5, 6])
def test_few_signs_bring_two_drives_together(signs: int) -> None:
    off_m = 1.5 * np.array([[0.5, 0.1, 0.0], [-0.5, -0.1, 0.0]])
    dataset, _ = lanes(3, lane_m=(-2.0, 2.0), off_m=off_m, image_m=0.05, signs_count=signs)
    moved = moved_m(dataset, refine_poses(dataset, valuemap.MapConfig()))
    np.testing.assert_allclose((moved[1] - moved[0])[:2], (off_m[0] - off_m[1])[:2], atol=0.15)


ALONE: dict[str, Any] = {"lane_m": (0.0,), "off_m": np.zeros((1, 3)), "image_m": 0.03}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_drive_alone_stays_as_it_is_where_nothing_is_wrong(seed: int) -> None:
    dataset, _ = lanes(seed, **ALONE)
    refined = refine_poses(dataset, valuemap.MapConfig())
    assert refined.dataset is dataset
    assert refined.record["landmarks"] > 20


def test_a_drive_alone_tells_that_its_camera_is_askew() -> None:
    """It sees each sign from far and near."""
    refined = refine_poses(lanes(1, **ALONE, left_deg=(1.5,))[0], valuemap.MapConfig())
    assert refined.record["cameras"][0]["turned_deg"][1] == pytest.approx(-1.5, abs=0.15)
    assert refined.record["drives"] == []


def test_a_jump_of_a_drive_alone_is_taken_back() -> None:
    jump_m = np.array([0.5, 1.5, 0.0])
    dataset, _ = lanes(2, **ALONE)
    rotation, center = camera_poses(dataset.images)
    jumped = np.where(center[:, :1] > 300.0, center + jump_m, center)
    refined = refine_poses(
        dataclasses.replace(dataset, images=with_poses(dataset.images, rotation, jumped)), valuemap.MapConfig()
    )
    before, after = (part["moved_m"] for part in refined.record["drives"][0]["segments"])
    np.testing.assert_allclose(np.subtract(before, after), jump_m, atol=0.1)


@pytest.mark.parametrize("seed", [1, 2])
def test_what_drives_drift_by_makes_no_fault_look_like_luck(seed: int) -> None:
    """Objects gain unlike each other where drives drift; but what drift is there is told by the objects around."""
    dataset, _ = lanes(
        seed,
        lane_m=(-2.0, 2.0),
        off_m=np.zeros((2, 3)),
        left_deg=(1.0, -1.0),
        is_back=(False, True),
        image_m=0.05,
        drift_m=0.3,
    )
    assert selected(dataset).chance < 1e-8


def test_what_cameras_gain_does_not_pay_for_offsets() -> None:
    """A camera is turned. Drives that are off by no more than they drift stay where they are."""
    dataset, _ = lanes(
        4,
        off_m=np.random.default_rng(4).normal(0.0, 0.15, (3, 3)),
        left_deg=(1.5, 1.5, 1.5),
        is_back=(False, False, True),
        image_m=0.05,
        drift_m=0.3,
        signs_count=14,
    )
    found = selected(dataset)
    assert found.is_proven
    assert not found.active[OFFSET].any()
    assert found.state.constants[CAMERA_MOUNT][0, 1] == pytest.approx(np.radians(-1.5), abs=np.radians(0.3))


def selected(dataset: Dataset) -> Selected:
    """Return what is found to be wrong with the poses of a dataset."""
    found = refine_poses(dataset, valuemap.MapConfig()).found
    assert found is not None
    assert found.selected is not None
    return found.selected


@pytest.mark.parametrize("off", [[3.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
def test_drives_of_two_receivers_are_brought_together(off: list[float]) -> None:
    """What half of the drives are off by alike is not where most are. One drive is too short to be judged."""
    sign = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0])
    whole, _ = lanes(3, lane_m=(-2.0, -1.3, -0.7, 0.0, 0.7, 1.3, 2.0), off_m=np.outer(sign, off))
    stays = (whole.images.pass_id.codes < 6) | (camera_centers(whole.images)[:, 0] < 40.0)
    dataset = dataclasses.replace(
        whole,
        images=whole.images.take(np.flatnonzero(stays)),
        detections=whole.detections.take(np.isin(whole.detections.image_id, whole.images.image_id[stays])),
    )
    apart = (moved_m(dataset, refine_poses(dataset, valuemap.MapConfig())) + np.outer(sign, off))[:6]
    np.testing.assert_allclose(apart - apart.mean(axis=0), 0.0, atol=0.25)


def test_what_is_left_without_a_group_is_fitted_from_where_the_normal_equations_have_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where offsets were dropped that a delay explains as well, a fit from no delay would lose what drives share."""
    off_m = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    dataset, _ = lanes(3, lane_m=(-2.0, 2.0), off_m=off_m, is_back=(False, True), image_m=0.02)
    from_start, from_last = [], []
    fits: list[tuple[Adjustment, State]] = []

    def fitted(problem: Adjustment, state: State, **options: Any) -> State:
        after = adjust(problem, state, **options)
        if options.get("with_variance"):
            if fits and is_part(problem, fits[-1][0]):
                from_start.append(sigmas_apart(problem, state, after))
                from_last.append(sigmas_apart(problem, fits[-1][1], after))
            fits.append((problem, after))
        return after

    monkeypatch.setattr(select, "adjust", fitted)
    refine_poses(dataset, valuemap.MapConfig())
    assert len(from_start) > 1
    assert max(from_start) < 0.1 * max(from_last)


def is_part(some: Adjustment, more: Adjustment) -> bool:
    """Return whether some of the constants of an adjustment are free in another, but no others."""
    flags = list(zip(some.active, more.active, strict=True))
    return all(np.all(b[a]) for a, b in flags) and any(np.any(a != b) for a, b in flags)


def sigmas_apart(problem: Adjustment, one: State, other: State) -> float:
    """Return how far apart the constants of two states are that are free, in deviations of what they may be."""
    kinds = zip(one.constants, other.constants, problem.active, WIDE.constant, strict=True)
    return float(sum(np.abs((a - b)[free]).sum() / np.max(sigma) for a, b, free, sigma in kinds))


def moved_m(dataset: Dataset, refined: Refined) -> Floats:
    """Return how far the images of each drive (D, 3) were moved."""
    step = camera_centers(refined.dataset.images) - camera_centers(dataset.images)
    return np.array(
        [
            np.median(step[dataset.images.pass_id.codes == drive], axis=0)
            for drive in np.unique(dataset.images.pass_id.codes)
        ]
    )


def test_the_cost_of_variances_is_the_likelihood_with_all_that_is_random_integrated_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(noise, "_SQUARE_WITHIN", 1.0)
    seen, state, footage = few_observations()
    chain = footage.chain
    told = noise.residuals_of_images(seen, state)
    assert told is not None
    rows = np.repeat(np.arange(len(told.node)), np.diff(told.of_image.members.indptr))
    order = told.of_image.members.indices
    by_own = told.rows[order, :, :6].reshape(-1, 6)
    residual, box_px = told.rows[order, :, 6].ravel(), np.repeat(told.box_px[order], 2)
    image = np.repeat(rows, 2)
    by_drift = np.einsum("ni,nij->nj", by_own, told.turned[image])
    node = told.node[image]
    alike = np.array(
        [
            [
                np.prod(chain.keep[min(i, j) + 1 : max(i, j) + 1]) * (chain.drive[i] == chain.drive[j])
                for j in range(len(chain.keep))
            ]
            for i in range(len(chain.keep))
        ]
    )
    same_image = image[:, None] == image
    same_drive = chain.drive[node][:, None] == chain.drive[node]

    def literal(scales: Scales, px: float, share: float) -> float:
        def of(by: Floats, metres: float, rad: float) -> Floats:
            return np.asarray(by * np.repeat([metres**2, rad**2], 3) @ by.T)

        covariance = np.diag(px**2 + (share * box_px) ** 2)
        covariance += of(by_own, scales.own_m, scales.own_rad) * same_image
        covariance += of(by_drift, scales.drift_m, scales.drift_rad) * alike[np.ix_(node, node)]
        covariance += of(by_drift, constant[0], constant[1]) * same_drive
        return -2.0 * float(multivariate_normal(cov=covariance, allow_singular=True).logpdf(residual))

    constant = (3.0, 0.03, 0.2, 0.05, 0.03, 0.2)
    of_settings = [
        (Scales(0.2, 0.004, 0.1, 0.002, constant), 1.0, 0.02),
        (Scales(0.1, 0.004, 0.05, 0.002, constant), 1.5, 0.02),
        (Scales(0.3, 0.001, 0.1, 0.004, constant), 1.0, 0.05),
    ]
    ours, theirs = (
        np.array([cost(*settings) for settings in of_settings])
        for cost in (lambda scales, px, share: told.cost(chain, scales, px, share), literal)
    )
    np.testing.assert_allclose(ours - ours[0], theirs - theirs[0], rtol=1e-5)


NOISES: dict[str, dict[str, float]] = {
    "px": {"pixel_noise_px": 3.0},
    "image_m": {"position_white_m": 0.25},
    "turn_px": {"rotation_white_deg": 0.3},
    "drift_m": {"position_drift_m": 0.35},
}
"""What each part of the noise is found to be is largest where the simulated city has more of it."""


def test_each_part_of_the_noise_is_told_from_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    found: dict[str, NoiseLeft] = {}

    def told(name: str) -> None:
        def noted(_: object, estimate: Estimate) -> None:
            found[name] = estimate.noise

        monkeypatch.setattr(poses, "select", noted)
        refine_poses(city(**NOISES.get(name, {})), valuemap.MapConfig())

    for name in ("plain", *NOISES):
        told(name)
    for part in NOISES:
        size = {name: getattr(of, part) for name, of in found.items()}
        assert max(size, key=lambda name: size[name]) == part, (part, size)
        assert size[part] > 1.5 * size["plain"]
