"""Faults of whole drives: each mechanism alone, and cities with one fault of their poses each."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

import laws
import valuemap
from block import SHORT_STREETS
from test_drives import posed
from test_simulate import EXACT_BOXES, EXACT_POSES
from valuemap import camera_models, correction, pipeline
from valuemap.arrays import Bools, Floats, Ints
from valuemap.calibration import with_sides
from valuemap.cameras import camera_poses, cast_rays
from valuemap.config import USUAL_RANGE_M, MapConfig, SimulationConfig
from valuemap.dataset import Dataset, Frame, ensure_checked, rows_of, write_dataset
from valuemap.drives import Drives, InOrder, find_drives, in_driving_order
from valuemap.engine.threads import ThreadEngine
from valuemap.progress import silent
from valuemap.reach import with_usual_range
from valuemap.refine import Mapped, Refined, adjust, expose_rows, poses, refine_again, refine_poses, tracks
from valuemap.refine import estimate as refine_estimate
from valuemap.refine import footage as refine_footage
from valuemap.refine import images as refine_images
from valuemap.refine import select as refine_select
from valuemap.refine.adjust import Adjustment, SameObjects, Scales
from valuemap.refine.alias import without_aliases
from valuemap.refine.delay import delay_alone, gate_of_delay_px, is_gain
from valuemap.refine.estimate import WIDE, Estimate, cut_into_segments, mounts_alone, own_scales, prices
from valuemap.refine.footage import (
    Footage,
    Rates,
    Sigmas,
    StepsOfImages,
    find_steps,
    gather,
    in_working_frame,
    rates_at_ends,
)
from valuemap.refine.jumps import Links, Segments, find_hints, find_jumps, mend
from valuemap.refine.landmarks import Landmarks, find_landmarks, keyframes
from valuemap.refine.noise import NoiseLeft
from valuemap.refine.poses import sigma_of_mean_m
from valuemap.refine.register import order_of_laying, register
from valuemap.refine.residuals import (
    CAMERA_MOUNT,
    FOCAL,
    MOUNT,
    OFFSET,
    Observations,
    State,
    corrected,
    rotations,
    weights,
)
from valuemap.refine.select import EquationsOfConstants, FittedConstants, Selected, Trial, chance_of_gain, price_of
from valuemap.refine.ties import tie
from valuemap.refine.tracks import merge_objects
from valuemap.remote import Place
from valuemap.robust import Calibration, calibration_from_json
from valuemap.simulate import simulate
from valuemap.summary import summarize_map
from valuemap.tables import Detections, Images
from valuemap.tables.covariance import covariance_matrices
from valuemap.tiles.compare import Comparison
from valuemap.tiles.mapping import solve_cells
from valuemap.tiles.solve import Solved
from valuemap.tiles.source import InMemory
from valuemap.tiles.work import open_work

CITY = SimulationConfig(
    streets_north_south=2,
    streets_east_west=2,
    signalised_share=1.0,
    passes_per_street=3,
    lookalikes_per_light=0.0,
)


DASHCAM = {
    "position_white_m": 0.48,
    "position_drift_m": 0.64,
    "rotation_white_deg": 0.3,
    "rotation_drift_deg": 0.4,
}
"""Poses of a dash camera: each image is 0.8 m and 0.5 degrees off on each axis."""


USUAL = with_usual_range(MapConfig())
"""The settings that cities are mapped with where none are given."""


FEWER_IMAGES: dict[str, Any] = {"frame_spacing_m": 4.0, "standing_interval_s": 2.0}
"""A third of the images, for tests that make whole maps."""
FEWEST_IMAGES = FEWER_IMAGES | {"passes_per_street": 2}


@functools.cache
def city(**faults: float) -> Dataset:
    """Return a city of four crossings, three tours in each direction, with the same errors but for the faults."""
    return ensure_checked(simulate(dataclasses.replace(CITY, **faults), seed=3))  # type: ignore[arg-type]


@functools.cache
def refined_once(dataset: Dataset, config: MapConfig) -> Refined:
    """Return what whole drives are found to be off by."""
    return refine_poses(dataset, config)


map_alone = correction._map_alone


@functools.cache
def mapped_once(dataset: Dataset, config: MapConfig) -> Mapped:
    """Return the map of poses as they are."""
    return map_alone(dataset, config, ThreadEngine(1), silent)


def residuals(seen: Observations, state: State) -> tuple[Floats, Floats]:
    """Return the residuals (N, 2) in px and the depths (N) in m, without derivatives."""
    poses = corrected(seen.views, state)
    apart = state.point_in_world_m[seen.thing] - poses.center_in_world_m[seen.image]
    p = np.einsum("nij,nj->ni", poses.cam_from_world[seen.image], apart)
    abc = np.einsum("nij,nj->ni", seen.residual_from_cam, p)
    stretch = state.constants[FOCAL][seen.camera]
    return (1.0 + stretch) * abc[:, :2] / abc[:, 2:] + stretch * seen.from_middle_px, abc[:, 2]


def share_refined(patch: pytest.MonkeyPatch) -> None:
    """Let whole drives be looked at once, for all tests that correct poses of the same dataset."""
    patch.setattr(
        correction, "refine_poses", lambda dataset, config, **_: refined_once(dataset, with_usual_range(config))
    )


def share_maps(patch: pytest.MonkeyPatch) -> None:
    """Let the map of the same poses be made once, for all tests that correct them by it."""
    patch.setattr(correction, "_map_alone", lambda dataset, config, *_: mapped_once(dataset, with_usual_range(config)))


@functools.cache
def map_of_shifted_city() -> tuple[Dataset, valuemap.Map]:
    """Return a city with every pass shifted by 3 m, and its map."""
    faulty = city(pass_shift_m=3.0, **FEWER_IMAGES)
    with pytest.MonkeyPatch.context() as patch:
        share_refined(patch)
        return faulty, valuemap.build_map(faulty)


def clean_city() -> Dataset:
    """Return the city of `map_of_shifted_city` as it is without the shift."""
    return city(**FEWER_IMAGES)


def few_of_dashcam() -> Dataset:
    """Return a city of few lights with the poses of a dash camera."""
    return city(lights=12, **FEWEST_IMAGES, **SHORT_STREETS, **DASHCAM)


def poor_detector() -> Dataset:
    """Return a city of few lights with exact poses and a poor detector."""
    return city(pixel_noise_px=5.0, lights=12, **FEWEST_IMAGES, **SHORT_STREETS, **EXACT_POSES)


@functools.cache
def maps_of_dashcam_city() -> tuple[Dataset, valuemap.Map, valuemap.Map]:
    """Return a city with the poses of a dash camera, its map, and the first one that was made, of the poses as given.

    Images are put in order once, for all maps of the poses that whole drives have.
    """
    faulty, begun, ordered, made = city(**DASHCAM, **FEWEST_IMAGES), [], [], []
    by_images = correction._by_images

    def counted(*given: Any) -> Any:
        begun.append(given)
        return by_images(*given)

    def noted(*given: Any) -> Any:
        made.append(map_alone(*given))
        return made[-1]

    def in_order(dataset: Dataset, **options: Any) -> InOrder:
        ordered.append(dataset)
        return in_driving_order(dataset, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refine_images, "in_driving_order", in_order)
        patch.setattr(correction, "_map_alone", noted)
        patch.setattr(correction, "_by_images", counted)
        result = valuemap.build_map(faulty)
    assert len(ordered) == len(begun)
    _, labels, votes, _ = made[0]
    return faulty, result, dataclasses.replace(result, labels=labels, votes=votes)


@dataclasses.dataclass(frozen=True, eq=False)
class Watched:
    """What correcting poses made of a city, and what was done: `fitted` are the equations, by the kinds judged."""

    city: Dataset
    refined: Refined
    done: list[str]
    steps: int
    fitted: list[list[tuple[object, ...]]]
    freed: list[Estimate]
    selected: list[Estimate]


@functools.cache
def watched(shift_m: float) -> Watched:
    """Correct the poses of a city with every pass shifted by so much, once for all tests of what is done then."""
    dataset = city(pass_shift_m=shift_m, **SHORT_STREETS)
    done: list[str] = []
    steps: list[int] = []
    fitted: list[list[tuple[object, ...]]] = []
    last: list[tuple[object, ...]] = []
    freed: list[Estimate] = []
    selected: list[Estimate] = []
    step, prune = Adjustment.step, Trial.prune

    def noted(name: str, make: Callable[..., Any]) -> Callable[..., Any]:
        def told(*given: Any, **more: Any) -> Any:
            done.append(name)
            return make(*given, **more)

        return told

    def counted(*given: Any, **more: Any) -> tuple[State, float]:
        steps.append(1)
        return step(*given, **more)

    def adjusted(problem: Adjustment, state: State, **more: Any) -> State:
        of = (*(flags.tobytes() for flags in problem.active), *map(repr, problem.scales.constant))
        last.append(of)
        return adjust.adjust(problem, state, **more)

    def pruned(*given: Any) -> Any:
        last.clear()
        after = prune(*given)
        fitted.append(last.copy())
        return after

    def freed_of_aliases(*given: Any) -> Estimate:
        freed.append(dataclasses.replace(without_aliases(*given)))
        return freed[-1]

    def chosen(footage: Footage, found: Estimate) -> Selected | None:
        selected.append(found)
        return refine_select.select(footage, found)

    def asked(*_: Any) -> None:
        raise AssertionError("pycolmap is asked for the rays of pinholes")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_models, "colmap_camera", asked)
        patch.setattr(poses, "begin", noted("begin", refine_estimate.begin))
        patch.setattr(poses, "go_on", noted("go_on", refine_estimate.go_on))
        patch.setattr(poses, "without_aliases", freed_of_aliases)
        patch.setattr(poses, "select", chosen)
        patch.setattr(Adjustment, "step", counted)
        patch.setattr(refine_select, "adjust", adjusted)
        patch.setattr(Trial, "prune", pruned)
        refined = refine_poses(dataset, valuemap.MapConfig())
    return Watched(dataset, refined, done, len(steps), fitted, freed, selected)


def shifted_city() -> tuple[Dataset, Refined]:
    """Return a city with every pass shifted by 3 m, and what is made of its poses when it is mapped."""
    faulty, result = map_of_shifted_city()
    assert result.corrected is not None
    return faulty, Refined(result.corrected, result.run["poses"], is_corrected=True)


def errors(dataset: Dataset, clean: Dataset) -> tuple[float, float]:
    """Return how far images are off on the ground, against their mean, m, and turned about up, deg (RMS)."""
    rotation, center = camera_poses(dataset.images)
    clean_rotation, clean_center = camera_poses(clean.images)
    apart = (center - clean_center)[:, :2]
    turn = Rotation.from_matrix(np.einsum("nij,nkj->nik", rotation, clean_rotation)).as_rotvec(degrees=True)
    off_m = np.linalg.norm(apart - apart.mean(axis=0), axis=1)
    return float(np.sqrt(np.mean(off_m**2))), float(np.sqrt(np.mean(turn[:, 1] ** 2)))


def test_segments_begin_where_drives_are_cut() -> None:
    segments = Segments.at([(1, 0), (0, 4), (0, 0), (0, 4)])
    assert segments.cuts() == [(0, 0), (0, 4), (1, 0)]
    assert segments.of(np.array([0, 0, 0, 1]), np.array([0, 3, 4, 9])).tolist() == [0, 0, 1, 2]


def test_a_city_without_faults_stays_bit_for_bit() -> None:
    refined = watched(0.0).refined
    assert refined.dataset is watched(0.0).city
    assert refined.record["found"] == "nothing"
    assert refined.record["shared_objects"] > 10


def test_shifts_of_passes_of_three_metres_are_found_to_three_decimetres() -> None:
    clean, (faulty, refined) = clean_city(), shifted_city()
    assert errors(faulty, clean)[0] > 2.0
    assert errors(refined.dataset, clean)[0] < 0.3
    assert len(refined.record["drives"]) >= 5
    # The place of all stays: as many images are moved as far to one side as to the other, drive by drive.
    drive = find_drives(faulty.images).pass_code
    moved = camera_poses(refined.dataset.images)[1] - camera_poses(faulty.images)[1]
    mean = np.stack([np.bincount(drive, weights=axis) / np.bincount(drive) for axis in moved.T], axis=1)
    assert np.abs(mean.mean(axis=0)).max() < 0.3


def test_poses_of_pinholes_are_corrected_without_pycolmap() -> None:
    """Asking it fails where poses are corrected under watch."""
    assert watched(3.0).refined.is_corrected


def test_all_that_multiplies_matrices_has_one_thread_from_the_beginning() -> None:
    # In a process of its own, as SciPy is loaded in this one.
    program = """
from threadpoolctl import threadpool_info
from valuemap.refine.poses import one_blas_thread
with one_blas_thread():
    blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
    import scipy.linalg
    assert len(blas) == sum(library["user_api"] == "blas" for library in threadpool_info())
    assert set(blas) == {1}, blas
"""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)


@pytest.mark.parametrize("is_proven", [False, True])
def test_all_is_estimated_only_where_a_sample_proves_a_fault(is_proven: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    faulty = city(pass_shift_m=3.0, **FEWER_IMAGES)
    monkeypatch.setattr(poses, "_SAMPLE", len(faulty.detections) // 3)
    looked_at: list[int] = []

    def counted(footage: Footage, found: Estimate) -> Selected | None:
        looked_at.append(len(footage.whole.detections))
        return refine_select.select(footage, found) if is_proven else None

    monkeypatch.setattr(poses, "select", counted)
    assert refine_poses(faulty, valuemap.MapConfig()).is_corrected == is_proven
    assert looked_at[0] < len(faulty.detections)
    assert looked_at[1:] == ([len(faulty.detections)] if is_proven else [])


def test_a_sample_has_no_drives_that_only_touch_its_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a few images show of a drive fits in many places, and would be taken for a fault of its poses."""
    dataset = city(streets_north_south=3, **FEWER_IMAGES)
    monkeypatch.setattr(poses, "_SAMPLE", len(dataset.detections) // 3)
    monkeypatch.setattr(poses, "estimate_errors", lambda *_, **__: None)

    def shortest_of_cut_m() -> float:
        cut: list[float] = []

        def noted(dataset: Dataset, drives: Drives, chosen: Bools) -> tuple[Dataset, Drives]:
            for drive in np.unique(drives.pass_code[chosen]):
                mine = drives.pass_code == drive
                if not chosen[mine].all():
                    cut.append(float(np.ptp(drives.driven_m[mine & chosen])))
            return dataset, drives

        with monkeypatch.context() as watched:
            watched.setattr(poses, "_part", noted)
            refine_poses(dataset, valuemap.MapConfig())
        return min(cut)

    assert shortest_of_cut_m() >= USUAL_RANGE_M
    monkeypatch.setattr(poses, "_only_touched", lambda _, drives: np.zeros(drives.count, np.bool_))
    assert shortest_of_cut_m() < USUAL_RANGE_M


def test_a_sample_tells_how_late_all_poses_are(monkeypatch: pytest.MonkeyPatch) -> None:
    late, looked_at = city(pose_delay_s=0.1), []
    monkeypatch.setattr(poses, "_SAMPLE", len(late.detections) // 3)

    def counted(laid: Callable[[float], Footage], *given: Any, **more: Any) -> float:
        looked_at.append(len(laid(0.0).whole.detections))
        return delay_alone(laid, *given, **more)

    monkeypatch.setattr(poses, "delay_alone", counted)
    refined = refine_poses(late, valuemap.MapConfig())
    assert len(looked_at) == 1
    assert looked_at[0] < len(late.detections)
    assert refined.record["cameras"][0]["delay_s"] == pytest.approx(0.1, abs=0.005)


@pytest.mark.parametrize("shift_m", [0.0, 3.0])
def test_drives_that_are_far_off_are_laid_anew_after_a_first_estimate(shift_m: float) -> None:
    assert watched(shift_m).done == (["begin", "begin", "go_on"] if shift_m else ["begin", "go_on"])


def test_the_same_equations_are_not_fitted_again_where_other_kinds_are_judged() -> None:
    fitted = watched(3.0).fitted
    assert any(len(of_kinds) > 1 for of_kinds in fitted)
    assert all(len(of_kinds) == len(set(of_kinds)) for of_kinds in fitted)


def test_the_map_that_tells_votes_is_of_the_images_that_poses_are_estimated_with() -> None:
    faulty, refined, config = watched(3.0).city, watched(3.0).refined, valuemap.MapConfig()
    assert refined.found is not None
    shown = poses.keyframes_of(faulty, refined, config)
    assert len(shown.images) == len(refined.found.footage.row) < len(faulty.images)
    assert len(shown.detections) == len(refined.found.footage.detection_row)
    row = rows_of(shown.images.image_id, refined.dataset.images.image_id)
    assert np.array_equal(shown.images.cam_from_world_m, refined.dataset.images.cam_from_world_m[row])
    noise = poses.noise_left(refined, config)
    found = refined.found.result
    assert noise.detection_sigma_px == found.noise.px
    assert noise.position_sigma_m == pytest.approx(np.hypot(found.noise.image_m, found.scales.drift_m))
    # A world of another scale has errors of that scale, and what is set stays.
    larger = dataclasses.replace(config, vote=dataclasses.replace(config.vote, max_range_m=120.0))
    twice = poses.noise_left(refined, larger).position_sigma_m
    assert twice == pytest.approx(2.0 * np.hypot(found.noise.image_m, found.scales.drift_m))
    stated = dataclasses.replace(config, noise=dataclasses.replace(config.noise, position_sigma_m=0.5))
    assert poses.noise_left(refined, stated).position_sigma_m == 0.5


@functools.cache
def told_by_a_map() -> tuple[Dataset, Refined, Refined]:
    """Return a city with every pass shifted by 1.5 m, what is made of its poses, and then with a map."""
    faulty = simulate(dataclasses.replace(CITY, **FEWEST_IMAGES, **SHORT_STREETS, pass_shift_m=1.5), seed=2)
    at_first = refined_once(faulty, USUAL)
    return faulty, at_first, correction._told_by_a_map(faulty, at_first, valuemap.MapConfig(), 1, silent)


def test_a_map_tells_better_than_what_single_drives_see_how_drives_lie_to_each_other() -> None:
    # Of two lights beside each other a drive alone does not know which another one saw.
    clean = simulate(dataclasses.replace(CITY, **FEWEST_IMAGES, **SHORT_STREETS), seed=2)
    _, at_first, at_last = told_by_a_map()
    assert errors(at_last.dataset, clean)[0] < min(0.25, 0.75 * errors(at_first.dataset, clean)[0])


def test_a_map_proves_what_single_drives_leave_in_doubt() -> None:
    config = valuemap.MapConfig()
    faulty = city(focal_error_share=0.015, lights=18, **FEWER_IMAGES, **SHORT_STREETS)
    doubtful = refine_poses(faulty, config)
    assert doubtful.found is not None
    assert doubtful.dataset is faulty
    assert not doubtful.is_corrected
    refined = correction._told_by_a_map(faulty, doubtful, config, 1, silent)
    assert refined.is_corrected
    assert refined.record["cameras"][0]["focal_length_factor"] == pytest.approx(0.985, abs=0.005)


@pytest.mark.parametrize(("is_proven", "is_told"), [(True, True), (False, True), (False, False)])
def test_what_is_proven_is_compared_before_a_map_tells_more_and_what_is_in_doubt_after(
    is_proven: bool, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, done = city(), []
    at_first = Refined(dataset, {"found": "nothing"})
    at_last = Refined(dataset, {"found": "faults"}, is_corrected=True)

    def told(_: Dataset, refined: Refined, *__: Any) -> Refined:
        done.append("map")
        return at_last if is_told else refined

    def compared(*_: Any, **__: Any) -> Comparison:
        done.append("compare")
        return Comparison(2.0, 1.0, 0.0, 10)

    monkeypatch.setattr(correction, "refine_poses", lambda *_, **__: at_last if is_proven else at_first)
    monkeypatch.setattr(correction, "_told_by_a_map", told)
    monkeypatch.setattr(correction, "compare_poses", compared)
    refined = correction._proven(dataset, dataset, valuemap.MapConfig(), 1, silent)
    assert refined.is_corrected == is_told
    assert done == (["compare", "map"] if is_proven else ["map", "compare"] if is_told else ["map"])


@pytest.mark.parametrize(
    ("drives", "cameras", "images", "after", "is_better", "kept"),
    [
        (False, [], False, False, False, "nothing"),
        (True, [], False, False, False, "drives"),
        (False, [], True, False, False, "images"),
        (True, [], True, False, False, "drives"),
        (True, [], True, True, False, "images"),
        (True, [], True, True, True, "both"),
        (True, [{"turned_deg": [0.0, 1.5, 0.0]}], True, True, True, "both"),
        (True, [{"focal_length_factor": 0.98}], True, True, True, "images"),
    ],
)
def test_single_images_are_corrected_after_whole_drives_if_that_is_likelier(
    drives: bool,
    cameras: list[Any],
    images: bool,
    after: bool,
    is_better: bool,
    kept: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dataset, moved = city(), dataclasses.replace(city())
    as_given = mapped_once(city(**FEWEST_IMAGES, **SHORT_STREETS), USUAL)

    def of(found: str, is_corrected: bool, of_what: Dataset) -> Refined:
        refined = Refined(of_what, {"found": found, "cameras": cameras}, is_corrected=is_corrected, is_noisy=True)
        return refined if is_corrected else dataclasses.replace(refined, as_given=as_given)

    def by_images(given: Dataset, *_: Any) -> Refined:
        is_first = given is dataset
        return of("images", images if is_first else after, dataclasses.replace(city()))

    def compared(before: Dataset, after: Dataset, price: float, *_: Any, **__: Any) -> Comparison:
        assert dataset is not before is not after is not moved
        return Comparison(1.0, 0.0 if is_better else 2.0, price, 10)

    of_drives = of("drives" if drives else "nothing", drives, moved if drives else dataset)
    monkeypatch.setattr(correction, "refine_poses", lambda *_, **__: of_drives)
    monkeypatch.setattr(correction, "_of_drives", lambda *_: of_drives)
    monkeypatch.setattr(correction, "_by_images", by_images)
    monkeypatch.setattr(correction, "compare_poses", compared)
    refined = correction._proven(dataset, dataset, valuemap.MapConfig(), 1, silent)
    assert refined.record["found"] == ("drives" if kept == "both" else kept)
    assert ("errors_of_images" in refined.record) == (kept == "both")
    assert refined.is_corrected == (kept != "nothing")
    # A map of poses that stay need not be made again.
    assert (refined.as_given is as_given) == (kept == "nothing")


def test_poses_are_estimated_with_a_map_only_where_some_were_corrected() -> None:
    faulty, result = map_of_shifted_city()
    at_first = refined_once(faulty, USUAL)
    assert at_first.is_corrected
    as_given = Refined(faulty, {"found": "nothing"})
    assert refine_again(faulty, as_given, result.labels, result.votes, valuemap.MapConfig()) is as_given
    none = result.labels.take(np.zeros(len(result.labels), np.bool_))
    assert refine_again(faulty, at_first, none, result.votes, valuemap.MapConfig()) is at_first
    unseen = result.votes.take(np.zeros(len(result.votes), np.bool_))
    assert refine_again(faulty, at_first, result.labels, unseen, valuemap.MapConfig()) is at_first


def test_what_drives_are_off_by_is_found_before_their_objects_are() -> None:
    faulty, result = map_of_shifted_city()
    assert valuemap.evaluate_map(result, faulty, radius_m=4.0).precision > 0.97
    assert off_from_each_other(result, faulty) < 0.57  # 1.14 where poses stay as they are.


def test_the_mean_of_few_passes_is_as_far_off_as_is_stated_however_often_they_were_cut() -> None:
    rng = np.random.default_rng(5)
    for passes, parts in ((3, 5), (4, 4), (12, 1)):
        within = []
        for _ in range(400):
            off_m = rng.normal(0.0, 1.5, (passes, 3))
            moved_m = np.repeat(off_m.mean(axis=0) - off_m, parts, axis=0) + rng.normal(0.0, 0.03, (passes * parts, 3))
            within.append(np.abs(off_m.mean(axis=0)) <= 1.96 * sigma_of_mean_m(moved_m, 0.05))
        share = np.mean(within, axis=0)
        assert ((share > 0.92) & (share < 0.99)).all(), (passes, parts, share)
    # What nobody was moved by may still be off as far as drives drift.
    assert sigma_of_mean_m(np.zeros((5, 3)), 0.1) == pytest.approx([0.1, 0.1, 0.1])


def test_absolute_covariances_know_that_drives_are_off_together() -> None:
    faulty, result = map_of_shifted_city()
    assert faulty.truth is not None
    assert result.labels.absolute_covariance_m2 is not None
    added_m2 = covariance_matrices(result.labels.absolute_covariance_m2 - result.labels.covariance_m2)
    assert np.allclose(added_m2, added_m2[0])
    level_m = np.sqrt(np.diag(added_m2[0])[:2])
    # Six passes are off by 3 m in any direction: their mean is by 3 / sqrt(2 * 6) on each axis.
    assert (np.abs(level_m - 0.87) < 0.4).all()
    stated_m = result.run["poses"]["mean_of_drives_sigma_east_north_up_m"]
    assert stated_m == pytest.approx(np.sqrt(np.diag(added_m2[0])), abs=1e-4)
    assert summarize_map(result)["corrected_poses"]["mean_of_drives_sigma_east_north_up_m"] == stated_m
    object_row = valuemap.evaluate_map(result, faulty, radius_m=4.0).matches.object_of_label
    off_m = (result.labels.position_in_world_m - faulty.truth.position_in_world_m[object_row])[object_row >= 0]
    assert 10.0 * np.sqrt(np.median(result.labels.covariance_m2[:, 0])) < np.linalg.norm(off_m.mean(axis=0)[:2])
    assert (np.abs(off_m.mean(axis=0)[:2]) < 3.0 * level_m).all()
    assert valuemap.build_map(clean_city(), valuemap.MapConfig(correct_poses=0)).labels.absolute_covariance_m2 is None


def test_poses_stay_where_they_are_not_to_be_corrected() -> None:
    faulty = watched(3.0).city
    as_it_is = refine_poses(faulty, valuemap.MapConfig(correct_poses=0))
    assert as_it_is.dataset is faulty
    assert as_it_is.record == {"found": "nothing", "because": "correct_poses is 0"}


def off_from_each_other(result: valuemap.Map, dataset: Dataset) -> float:
    """Return the root mean square of what labels are off by, m, but for what they share."""
    assert dataset.truth is not None
    object_row = valuemap.evaluate_map(result, dataset, radius_m=4.0).matches.object_of_label
    is_right = object_row >= 0
    assert is_right.sum() >= 0.8 * len(dataset.truth)
    truth = dataset.truth.position_in_world_m[object_row[is_right]]
    off_m = result.labels.position_in_world_m[is_right] - truth
    return float(np.sqrt(((off_m - off_m.mean(axis=0)) ** 2).sum(axis=1).mean()))


def between_neighbors(result: valuemap.Map, dataset: Dataset) -> tuple[float, float]:
    """Return the error of vectors between objects within 50 m, m (RMS), and the mean normalised error of labels."""
    assert dataset.truth is not None
    label = valuemap.evaluate_map(result, dataset, radius_m=4.0).matches.label_of_object
    place = dataset.truth.position_in_world_m[label >= 0]
    error = result.labels.position_in_world_m[label[label >= 0]] - place
    a, b = scipy.spatial.cKDTree(place).query_pairs(50.0, output_type="ndarray").T
    covariance = covariance_matrices(result.labels.covariance_m2)[label[label >= 0]]
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    return float(np.sqrt(np.mean(np.sum((error[a] - error[b]) ** 2, axis=1)))), float(square.mean())


def test_all_that_images_show_tells_what_they_are_off_by_themselves() -> None:
    clean, (faulty, result, alone) = city(**FEWEST_IMAGES), maps_of_dashcam_city()
    assert result.run["poses"]["found"] == "errors of images"
    assert result.corrected is not None
    assert errors(result.corrected, clean)[0] < 0.7 * errors(faulty, clean)[0]
    (between_m, square), (between_alone_m, _) = (between_neighbors(one, faulty) for one in (result, alone))
    assert between_m < 0.7 * between_alone_m
    # What residuals leave once images are moved is a few centimetres: errors of images count in the covariance.
    assert square < 6.0


def test_numbers_of_images_and_detections_do_not_matter_where_poses_are_corrected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shifted, at_first, at_last = told_by_a_map()
    assert at_last is not at_first
    monkeypatch.setattr(correction, "_MAPS_OF_IMAGES", 1)
    share_maps(monkeypatch)
    config = USUAL

    def by_images(dataset: Dataset) -> Refined:
        return correction._by_images(dataset, config, 1, silent)

    def by_drives(dataset: Dataset) -> Refined:
        return correction._told_by_a_map(dataset, refine_poses(dataset, config), config, 1, silent)

    dashcam = few_of_dashcam()
    for faulty, before, correct in ((shifted, at_last, by_drives), (dashcam, by_images(dashcam), by_images)):
        random = np.random.default_rng(0)
        shuffled = laws.shuffle_images(faulty, config, random)
        shuffled = laws.shuffle_detections(shuffled.dataset, config, random)
        after = correct(shuffled.dataset)
        assert before.is_corrected
        assert after.record == before.record
        assert np.array_equal(places_by_name(before.dataset), places_by_name(after.dataset))


def places_by_name(dataset: Dataset) -> Floats:
    """Return where images are (N, 3) in the order of their names."""
    images = dataset.images
    return images.cam_from_world_m[np.argsort(images.name.to_numpy(zero_copy_only=False))]


@functools.cache
def lamps_of_four_sides() -> Dataset:
    """Return lamps that show other middles to other sides, of images that are off and show few of them."""
    config = dataclasses.replace(CITY, has_lights=0, lamp_spacing_m=15.0, side_offset_m=0.25, **FEWER_IMAGES)
    config = dataclasses.replace(config, position_white_m=0.15, rotation_white_deg=0.2, **SHORT_STREETS)
    return ensure_checked(simulate(config, seed=4))


def test_middles_that_differ_by_side_are_no_errors_of_images(monkeypatch: pytest.MonkeyPatch) -> None:
    lamps = lamps_of_four_sides()
    assert lamps.truth is not None
    share_refined(monkeypatch)
    share_maps(monkeypatch)
    result = valuemap.build_map(lamps)
    assert result.run["poses"]["found"] == "errors of images"
    assert len(result.labels) <= len(lamps.truth) + 1
    # What they are off by is told once, of images as they were.
    assert result.run["counts"]["noise"]["side_m"] == mapped_once(lamps, USUAL)[0].noise.side_m > 0.0
    assert between_neighbors(result, lamps)[1] < 6.0
    for module in (correction, pipeline):
        monkeypatch.setattr(module, "with_sides", lambda _, config: with_sides(0.0, config))
    monkeypatch.setattr(correction, "_MAPS_OF_IMAGES", 1)
    assert len(valuemap.build_map(lamps).labels) > 1.5 * len(lamps.truth)


def test_images_are_moved_by_what_sides_show_of_one_object() -> None:
    lamps, config = lamps_of_four_sides(), USUAL
    calibration, labels, votes, _ = mapped_once(lamps, config)
    assert calibration.noise.side_m > 0.1
    images = refine_images.gather_images(lamps, config)
    told, as_one = (
        refine_images.bundle(images, labels, votes, dataclasses.replace(calibration.noise, side_m=side_m))
        for side_m in (calibration.noise.side_m, 0.0)
    )
    assert len(as_one.label) == len(labels)
    assert len(told.label) > 1.5 * len(labels)
    (row, covariance_m2), (row_as_one, _) = told.covariances(), as_one.covariances()
    assert np.array_equal(row, row_as_one)
    sides = np.bincount(told.label)[row]
    assert (np.trace(covariance_m2, axis1=1, axis2=2) > 3.0 * calibration.noise.side_m**2 / sides).all()
    # Sides disagree by as much as they are thought to show other middles, and not by what poses are off by.
    state = told.adjusted(told.seen)
    apart = (state.point_in_world_m[told.ties.first] - state.point_in_world_m[told.ties.second])[sides[told.label] > 1]

    assert np.sqrt(np.mean(apart**2)) == pytest.approx(calibration.noise.side_m, rel=0.5)


def test_middles_in_doubt_widen_covariances_where_images_were_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    dashcam, config = few_of_dashcam(), USUAL
    monkeypatch.setattr(correction, "_MAPS_OF_IMAGES", 1)
    calibration, labels, votes, counts = mapped_once(dashcam, config)
    assert calibration.noise.side_m == 0.0
    doubtful = dataclasses.replace(calibration.noise_of_covariances, side_m=0.5)
    doubted = dataclasses.replace(calibration, noise_of_covariances=doubtful)

    def refined(told: Calibration) -> Refined:
        monkeypatch.setattr(correction, "_map_alone", lambda *_: (told, labels, votes, counts))
        return correction._by_images(dashcam, config, 1, silent)

    sure, unsure = refined(calibration), refined(doubted)
    assert sure.is_corrected
    assert np.array_equal(sure.dataset.images.cam_from_world_m, unsure.dataset.images.cam_from_world_m)
    variance_m2, wider_m2 = (
        covariance_matrices(correction.with_errors_of_poses(one, labels, votes).covariance_m2).trace(axis1=1, axis2=2)
        for one in (sure, unsure)
    )
    assert (wider_m2 > variance_m2).all()
    assert np.median(wider_m2 - variance_m2) > 3 * 0.5**2 / 4  # Lights are seen from four sides at most.


def test_images_that_were_moved_state_no_errors() -> None:
    """What poses state they were off by before: a map of moved ones would take them for as wrong as they were."""
    sigmas = {"position_sigma_m": 0.8, "rotation_sigma_rad": 0.01}
    few = few_of_dashcam()
    calibration, labels, votes, _ = mapped_once(few, USUAL)
    stating = few.images.replace(**{name: np.full(len(few.images), sigma) for name, sigma in sigmas.items()})
    few = dataclasses.replace(few, images=stating)
    moved = refine_images.bundle(refine_images.gather_images(few, USUAL), labels, votes, calibration.noise).images(
        few.images
    )
    assert not np.array_equal(moved.cam_from_world_m, few.images.cam_from_world_m)
    assert all(getattr(moved, name) is None for name in sigmas)


def test_errors_of_images_are_no_noise_of_detections(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images whose poses are exact stay, however poor the detector: what one object says another does not confirm."""
    share_maps(monkeypatch)
    assert refined_once(poor_detector(), USUAL).is_noisy
    assert not correction._by_images(poor_detector(), USUAL, 1, silent).is_corrected


def test_poses_that_stay_are_mapped_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    poor, solved = poor_detector(), []
    share_refined(monkeypatch)
    run = pipeline.Run(tmp_path, ThreadEngine(1))

    def solve(source: InMemory, *arguments: Any, **options: Any) -> tuple[list[Solved], list[Place]]:
        solved.append(len(source.sample().image_id) == len(poor.images))
        return solve_cells(source, *arguments, **options)

    def build(made: pipeline.Run) -> valuemap.Map:
        return pipeline.build_map_of_folder(tmp_path, MapConfig(), made, held=poor)[0]

    for module in (correction, pipeline):
        monkeypatch.setattr(module, "solve_cells", solve)
    once, in_folder = valuemap.build_map(poor), build(run)
    assert sum(solved) == 2
    calibration = calibration_from_json(once.run["calibration"], source="")
    other = build(dataclasses.replace(run, calibration=dataclasses.replace(calibration, is_deep=False)))
    assert sum(solved) == 4  # Of another calibration, it is another map.
    assert other.run["calibration"] != once.run["calibration"]
    monkeypatch.setattr(correction, "_by_images", lambda dataset, *_: Refined(dataset, {}))
    twice = valuemap.build_map(poor)
    for same in (once, in_folder):
        assert np.array_equal(same.labels.position_in_world_m, twice.labels.position_in_world_m)
        assert np.array_equal(same.votes.detection_id, twice.votes.detection_id)
        assert [same.run[name] for name in ("poses", "counts")] == [twice.run[name] for name in ("poses", "counts")]


def test_a_map_without_objects_says_nothing_of_images() -> None:
    dashcam = few_of_dashcam()
    assert refined_once(dashcam, USUAL).is_noisy
    result = valuemap.build_map(dashcam, MapConfig().with_settings(["min_votes=5000"]))
    assert (len(result.labels), result.run["poses"]["found"]) == (0, "nothing")


def test_one_object_has_no_other_half(monkeypatch: pytest.MonkeyPatch) -> None:
    share_maps(monkeypatch)
    monkeypatch.setattr(refine_images, "halves", lambda points: np.zeros(len(points), np.int64))
    assert not correction._by_images(few_of_dashcam(), USUAL, 1, silent).is_corrected


def test_a_part_of_many_objects_says_whether_images_are_off() -> None:
    assert refine_images.asked_in_runs(999).all()
    asked = refine_images.asked_in_runs(5000)
    assert asked.sum() == 1000
    # In runs of what lies side by side, evenly spread.
    assert np.flatnonzero(np.diff(asked.astype(int)) == 1).tolist() == list(range(499, 4999, 500))
    assert np.flatnonzero(np.diff(asked.astype(int)) == -1).tolist() == list(range(99, 4999, 500))


def test_single_images_are_looked_at_only_where_they_are_off_by_more_than_was_thought(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clean, asked = watched(0.0).city, []

    def by_images(dataset: Dataset, *_: Any) -> Refined:
        asked.append(dataset)
        return Refined(dataset, {})

    monkeypatch.setattr(correction, "_by_images", by_images)
    for is_noisy in (False, True):
        monkeypatch.setattr(
            correction,
            "refine_poses",
            lambda dataset, *_, is_noisy=is_noisy, **__: Refined(dataset, {}, is_noisy=is_noisy),
        )
        correction._proven(clean, clean, valuemap.MapConfig(), 1, silent)
    assert len(asked) == 1
    assert not watched(0.0).refined.is_noisy


def rows_of_signs(moved_m: Floats | None = None) -> tuple[Footage, Estimate]:
    """Return a city of rows of signs and what is to be found there, one drive `moved_m` from its poses."""
    dataset = city(has_lights=0, sign_row_spacing_m=30.0, min_row_signs=4)
    assert dataset.truth_detections is not None
    ordered = in_driving_order(dataset, viewpoint_step_m=1.0)
    rotation, center = camera_poses(ordered.dataset.images)
    drives = ordered.drives
    drive = a_drive(drives)
    if moved_m is not None:
        center[drives.pass_code == drive] -= moved_m
    moving = dataclasses.replace(
        ordered.dataset, images=refine_footage.with_poses(ordered.dataset.images, rotation, center)
    )
    footage = gather(*in_working_frame(moving, drives, 1.0))
    shown = ordered.rows_of_detections(dataset.truth_detections.detection_id)
    place = np.full(len(ordered.dataset.detections), -1)
    place[footage.detection_row] = np.arange(len(footage.detection_row))
    kept = place[shown] >= 0
    detection = place[shown][kept]
    kinds, thing = np.unique(dataset.truth_detections.object_id[kept], return_inverse=True)
    few = np.bincount(thing) < 8
    detection, thing = detection[~few[thing]], np.unique(thing[~few[thing]], return_inverse=True)[1]
    things = int(thing.max()) + 1
    counts = (drives.count,) * 3 + (1,) * 3
    truth = dataset.truth
    assert truth is not None
    points = refine_footage.points_in_working_frame(
        moving, truth.position_in_world_m[rows_of(kinds[~few], truth.object_id)], 1.0
    )
    state = State.zero(points, len(footage.chain.drive), len(footage.row), counts)
    if moved_m is not None:
        state.constants[OFFSET][drive] = moved_m
    every = np.arange(drives.count)
    noise = NoiseLeft()
    estimate = Estimate(
        detection,
        thing,
        footage.rays.class_code[detection[np.unique(thing, return_index=True)[1]]].astype(np.int64),
        np.full(things, np.nan),
        Segments(every, np.zeros_like(every)),
        Links.none(),
        state,
        noise,
        refine_estimate._sigmas(footage, noise),
        refine_estimate.WIDE,
        things,
    )
    return footage, estimate


def a_drive(drives: Drives) -> int:
    """Return the shortest drive that is no turn at a corner."""
    images = np.bincount(drives.pass_code)
    return int(np.argmin(np.where(images < 50, np.inf, images)))


def along_the_row(footage: Footage, drive: int, signs: int) -> Floats:
    """Return a shift by so many signs of a row, which stand 0.9 m apart, along the street of a drive."""
    center = footage.center_in_world_m[footage.drives.pass_code == drive]
    way = center[-1] - center[0]
    way[2] = 0.0
    return np.asarray(0.9 * signs * way / np.linalg.norm(way))


@pytest.mark.parametrize("signs", [1, -1, 2])
def test_a_drive_that_was_laid_one_sign_further_on_is_put_back(signs: int) -> None:
    footage, right = rows_of_signs()
    drive = a_drive(footage.drives)
    alias = along_the_row(footage, drive, signs)
    state = dataclasses.replace(
        right.state, constants=(right.state.constants[OFFSET].copy(), *right.state.constants[1:])
    )
    state.constants[OFFSET][drive] = alias
    images = np.flatnonzero(footage.drives.pass_code == drive)
    detection, thing, _ = tracks.associate(
        footage, state, right.class_code, right.size_m, footage.drives.pass_code, right.sigma_px, 60.0, images
    )
    others = footage.drives.pass_code[footage.rays.image_row[right.detection]] != drive
    laid = dataclasses.replace(
        right,
        detection=np.append(right.detection[others], detection),
        thing=np.append(right.thing[others], thing),
        state=state,
    )
    wrong = dict(zip(laid.detection.tolist(), laid.thing.tolist(), strict=True))
    truth = dict(zip(right.detection.tolist(), right.thing.tolist(), strict=True))
    assert len(detection) > 10
    assert sum(wrong[row] == truth.get(row) for row in detection.tolist()) < 0.3 * len(detection)
    back = without_aliases(footage, laid, 60.0)
    assert np.linalg.norm(back.state.constants[OFFSET][drive]) < 0.4
    np.testing.assert_array_equal(
        np.delete(back.state.constants[OFFSET], drive, axis=0), np.delete(right.state.constants[OFFSET], drive, axis=0)
    )
    of_drive = footage.drives.pass_code[footage.rays.image_row[back.detection]] == drive
    assert of_drive.sum() > 1.05 * len(detection)


def test_what_is_selected_is_free_of_aliases() -> None:
    seen = watched(0.0)
    assert len(seen.selected) == len(seen.freed) == 1
    assert seen.selected[0] is seen.freed[0]


def test_a_drive_that_is_elsewhere_stays_there() -> None:
    footage, _ = rows_of_signs()
    drive = a_drive(footage.drives)
    moved = along_the_row(footage, drive, 3)
    footage, right = rows_of_signs(moved)
    assert without_aliases(footage, right, 60.0) is right


def test_short_drives_have_the_offset_of_the_one_they_go_on_from() -> None:
    clean, (faulty, refined) = clean_city(), shifted_city()
    drives = find_drives(faulty.images)
    short = np.bincount(drives.pass_code) < 20
    assert short.any()
    off = (camera_poses(refined.dataset.images)[1] - camera_poses(clean.images)[1])[:, :2]
    off = off - off.mean(axis=0)
    assert np.linalg.norm(off[short[drives.pass_code]], axis=1).max() < 0.6


@pytest.mark.parametrize("is_dated", [False, True])
def test_drives_go_on_from_each_other_by_times_but_not_by_dates(is_dated: bool) -> None:
    images = posed(np.zeros((40, 2)), time_s=np.full(40, 7e4) if is_dated else 0.2 * np.arange(40.0))
    drive = np.repeat([0, 1], 20)
    drives = Drives(drive, np.arange(40), np.zeros(40), np.arange(40), {})
    whole = SimpleNamespace(images=images)
    footage: Any = SimpleNamespace(whole=whole, drives=drives, whole_drives=drives)
    # The first sees ten objects, the second one of them.
    seen: Any = SimpleNamespace(drive=np.repeat([0, 1], [10, 1]), thing=np.append(np.arange(10), 0))
    ties = tie(footage, Segments(np.array([0, 1]), np.zeros(2, np.int64)), seen)
    assert ties.vehicle.tolist() == ties.segment.tolist() == ([0, 1] if is_dated else [0, 0])


def test_cells_on_disk_get_the_poses_that_were_corrected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    faulty, result = map_of_shifted_city()
    write_dataset(faulty, tmp_path / "data")
    monkeypatch.setattr(correction, "_proven", lambda *_: shifted_city()[1])
    (tmp_path / "work").mkdir()
    run = pipeline.Run(tmp_path / "work", ThreadEngine(1), tile_size_m=150.0)
    with open_work(tmp_path / "work", resume=False) as work:
        tiled, _ = pipeline.build_map_of_folder(
            tmp_path / "data", valuemap.MapConfig(), dataclasses.replace(run, work=work)
        )
    assert tiled.run["poses"] == result.run["poses"]
    assert np.array_equal(tiled.labels.position_in_world_m, result.labels.position_in_world_m)


def test_what_is_too_large_to_be_looked_at_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(
        simulate(dataclasses.replace(CITY, lights=12, passes_per_street=1, **FEWER_IMAGES), seed=1), tmp_path / "data"
    )
    for module in (correction, pipeline):
        monkeypatch.setattr(module, "MOST_LOOKED_AT", 100)
    results = [valuemap.build_map(valuemap.read_dataset(tmp_path / "data"), valuemap.MapConfig())]
    for tile_size_m in (None, 500.0):
        with open_work(tmp_path / f"work{tile_size_m}", resume=False) as work:
            run = pipeline.Run(work, ThreadEngine(1), tile_size_m=tile_size_m)
            results.append(pipeline.build_map_of_folder(tmp_path / "data", valuemap.MapConfig(), run)[0])
    for result in results:
        assert "large dataset" in result.run["poses"]["because"]
        assert "poses" in result.run["notes"][0]


def test_drives_alone_tell_how_their_cameras_are_turned() -> None:
    for settings in ({}, {"pass_yaw_deg": 1.0}):
        clean, faulty = city(), city(**settings)
        drives = find_drives(faulty.images, viewpoint_step_m=1.0)
        ordered = in_driving_order(faulty, viewpoint_step_m=1.0)
        footage = gather(*in_working_frame(ordered.dataset, ordered.drives, 1.0))
        marks = find_landmarks(
            footage.dataset, footage.rays, footage.drives, footage.drives.pass_code, valuemap.MapConfig()
        )
        turned = np.degrees(mounts_alone(footage, marks))
        if not settings:
            assert np.all(turned == 0.0)
            continue
        rotations = [camera_poses(d.images)[0] for d in (faulty, clean)]
        turn = Rotation.from_matrix(np.einsum("nij,nkj->nik", *rotations)).as_rotvec(degrees=True)[:, 1]
        true = np.array([turn[drives.pass_code == drive].mean() for drive in range(drives.count)])
        long = np.bincount(drives.pass_code) > 100
        assert np.abs(turned[long, 1] + true[long]).max() < 0.6


def test_the_drift_of_a_drive_of_any_length_says_nothing_of_that_of_the_next() -> None:
    driven_m = np.array([0.0, 100_000.0, 0.0, 50.0])
    drives = Drives(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), driven_m, np.arange(4), {})
    chain, node, _ = refine_footage._nodes(drives)
    assert node.tolist() == [0, 1, 2, 3]
    assert chain.drive.tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(chain.keep, [0.0, 0.0, 0.0, np.exp(-50.0 / refine_footage.DRIFT_LENGTH_M)])


def test_cameras_mounted_askew_are_turned_back() -> None:
    clean, faulty = city(**SHORT_STREETS), city(pass_yaw_deg=1.5, **SHORT_STREETS)
    refined = refine_poses(faulty, valuemap.MapConfig())
    assert errors(faulty, clean)[1] == pytest.approx(1.5, abs=0.01)
    assert errors(refined.dataset, clean)[1] < 0.4


def test_a_delay_of_all_poses_is_one_number_of_the_camera() -> None:
    refined = refine_poses(city(pose_delay_s=0.15, **SHORT_STREETS), valuemap.MapConfig())
    assert refined.record["cameras"][0]["delay_s"] == pytest.approx(0.15, abs=0.01)


def test_errors_are_estimated_with_the_rates_of_the_delay_that_poses_start_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late, seen = city(pose_delay_s=0.1), []
    monkeypatch.setattr(poses, "begin", lambda footage, *_, late_s, **__: seen.append((footage, late_s)))
    ordered = in_driving_order(late, viewpoint_step_m=1.0)
    assert poses.estimate_errors(ordered.dataset, ordered.drives, valuemap.MapConfig(), 1) is None
    footage, late_s = seen[0]
    assert late_s == pytest.approx(0.1, abs=0.03)
    turned = {}
    for name, motion in (("mean", find_steps(ordered.dataset, ordered.drives).motion()), ("found", footage.motion)):
        rate = motion.forward_radps[footage.row] if name == "mean" else motion.forward_radps
        turned[name] = rotations(0.1 * rate) @ footage.cam_from_world
    clean = camera_poses(in_driving_order(city(), viewpoint_step_m=1.0).dataset.images)[0][footage.row]
    off = {
        name: np.degrees(Rotation.from_matrix(np.einsum("nij,nkj->nik", rotation, clean)).magnitude())
        for name, rotation in turned.items()
    }
    assert (off["mean"] > 1.0).sum() > 5
    assert (off["found"] > 1.0).sum() < 0.3 * (off["mean"] > 1.0).sum()


def delay_of(dataset: Dataset) -> float:
    """Return how late its poses are as its drives alone tell it, s."""
    ordered = in_driving_order(dataset, viewpoint_step_m=1.0)
    footage = gather(*in_working_frame(ordered.dataset, ordered.drives, 1.0))
    askew = np.zeros((ordered.drives.count, 3))
    config, drive = valuemap.MapConfig(), footage.drives.pass_code
    return delay_alone(lambda late_s: poses.moved_footage(footage, askew, late_s), drive, config)


@pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.15])
def test_drives_alone_tell_how_late_their_poses_are(delay_s: float) -> None:
    assert delay_of(city(pose_delay_s=delay_s)) == pytest.approx(delay_s, abs=0.011)


def test_a_camera_that_sees_more_sharply_tells_a_delay_between_two_that_are_tried() -> None:
    # Through the gate of the votes alone, 0.01 s are too much where it turns.
    sharp = {"focal_px": 1500.0, "image_width_px": 1920, "image_height_px": 1440}
    assert delay_of(city(pose_delay_s=0.11, **sharp)) == pytest.approx(0.11, abs=0.011)


def test_a_delay_gains_votes_on_more_stretches_than_by_chance() -> None:
    assert is_gain(np.array([5, 4, 0, 6, 3, 5]))
    assert not is_gain(np.array([40, 0, 0, 0, 0, 0]))
    # Where two ways round a corner gain, and all else is straight.
    assert is_gain(np.array([0, 18, 0, 0, -1, 13, 0, 0]))
    assert not is_gain(np.array([5, -4, 0, 6, -3, -2]))
    assert not is_gain(np.zeros(6, np.int64))


def test_poses_that_are_moved_on_tremble_as_before() -> None:
    # Moved towards the next image by two fifths of the way, an image would lose a quarter of its own error.
    dataset = city(position_drift_m=0.0, position_white_m=0.3)
    drives = find_drives(dataset.images)
    motion, center = find_steps(dataset, drives).motion(), camera_poses(dataset.images)[1]
    for late_s, velocity in ((0.1, motion.forward_mps), (-0.1, motion.backward_mps)):
        assert trembling(center + late_s * velocity, drives) > 0.95 * trembling(center, drives)


ROLLING = EXACT_POSES | {"readout_s": 0.06}


def test_images_get_the_poses_of_the_rows_of_their_detections() -> None:
    rolling = city(**ROLLING, **EXACT_BOXES)
    exposed, record = expose_rows(rolling)
    before, after = (missed_px(dataset) for dataset in (rolling, exposed))
    # Some lights are not on the mean row of all in their image.
    assert np.mean(after) < 0.6 * np.mean(before)
    alone = np.bincount(rolling.detections.image_id, minlength=len(rolling.images))[image_of_missed(rolling)] == 1
    assert np.mean(after[alone]) < 0.3 * np.mean(before[alone])
    assert exposed.cameras.readout_s is None
    assert record["rows"]["images_without_times"] == 0
    assert record["rows"]["mean_s"] < -0.001  # Lights are in the upper half of the picture.
    assert exposed.images.timestamp_s is rolling.images.timestamp_s


def missed_px(dataset: Dataset) -> Floats:
    """Return how far (N), px, true lights are from where they were detected, where they are detected exactly."""
    assert dataset.truth is not None
    assert dataset.truth_detections is not None
    detection = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    thing = rows_of(dataset.truth_detections.object_id, dataset.truth.object_id)
    rays = cast_rays(dataset)
    away = dataset.truth.position_in_world_m[thing] - rays.center_in_world_m[detection]
    a, b, c = np.einsum("nij,nj->in", rays.residual_from_world[detection], away)
    return np.asarray(np.hypot(a / c, b / c))


def image_of_missed(dataset: Dataset) -> Ints:
    """Return the images (rows, N) of the same detections."""
    assert dataset.truth_detections is not None
    detection = rows_of(dataset.truth_detections.detection_id, dataset.detections.detection_id)
    return rows_of(dataset.detections.image_id[detection], dataset.images.image_id)


def test_poses_stay_where_rows_are_not_told_apart_or_nobody_knows_how_fast_images_move() -> None:
    still = city()
    assert expose_rows(still) == (still, {})
    untold = replace_cameras(still, np.array([np.nan]))
    assert expose_rows(untold) == (untold, {})
    without = dataclasses.replace(city(**ROLLING), images=city(**ROLLING).images.replace(timestamp_s=None))
    exposed, record = expose_rows(without)
    assert record["rows"]["images"] == 0
    assert record["rows"]["images_without_times"] == len(without.images)
    np.testing.assert_allclose(camera_poses(exposed.images)[1], camera_poses(without.images)[1], atol=1e-9)


def replace_cameras(dataset: Dataset, readout_s: Floats) -> Dataset:
    return dataclasses.replace(dataset, cameras=dataset.cameras.replace(readout_s=readout_s))


def test_a_rolling_shutter_costs_a_map_nothing_where_it_is_stated() -> None:
    rolling = city(**ROLLING, **EXACT_BOXES, lights=12, **FEWEST_IMAGES, **SHORT_STREETS)
    result = valuemap.build_map(rolling, MapConfig().with_settings(["correct_poses=0"]))
    assert result.corrected is not None
    assert result.corrected.cameras.readout_s is None
    assert result.run["poses"]["rows"]["images"] > 0
    unstated = dataclasses.replace(rolling, cameras=rolling.cameras.replace(readout_s=None))
    off_m = [
        valuemap.evaluate_map(each, rolling, radius_m=2.0).position_rmse_m
        for each in (result, valuemap.build_map(unstated, MapConfig().with_settings(["correct_poses=0"])))
    ]
    assert off_m[0] < 0.8 * off_m[1]


def trembling(center: Floats, drives: Drives) -> float:
    """Return the median of what steps differ by from those before them, m."""
    order = np.lexsort((drives.order, drives.pass_code))
    unlike = np.linalg.norm(np.diff(center[order], n=2, axis=0), axis=1)
    return float(np.median(unlike[drives.pass_code[order][2:] == drives.pass_code[order][:-2]]))


def test_constellations_tell_how_drives_lie_to_each_other() -> None:
    random = np.random.default_rng(1)
    objects = np.column_stack([random.uniform(0.0, 300.0, (20, 2)), random.uniform(3.0, 6.0, 20)])
    angle = random.uniform(0.0, 2.0 * np.pi, 6)
    shift = 3.0 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6)])
    points = (objects[None] + shift[:, None]).reshape(-1, 3) + random.normal(0.0, 0.1, (120, 3))
    marks = landmarks(points, drive=np.repeat(np.arange(6), 20), driven_m=np.tile(objects[:, 0], 6))
    found = register(marks, np.tile(0.1**2 * np.eye(3), (120, 1, 1)))
    total = found.shift_m.reshape(6, 20, 3) + shift[:, None]
    assert np.abs(total - total.mean(axis=(0, 1))).max() < 1.0
    assert len(np.unique(found.object_of_landmark)) == 20


def test_constellations_tell_heights_to_a_decimetre() -> None:
    random = np.random.default_rng(3)
    objects = np.column_stack([random.uniform(0.0, 300.0, (20, 2)), random.uniform(3.0, 6.0, 20)])
    points = np.concatenate([objects, objects + [1.0, 0.0, 3.45]])
    marks = landmarks(points, drive=np.repeat([0, 1], 20), driven_m=np.tile(objects[:, 0], 2))
    shift_m = register(marks, np.tile(0.05**2 * np.eye(3), (40, 1, 1))).shift_m
    np.testing.assert_allclose(shift_m[:20, 2] - shift_m[20:, 2], 3.45, atol=0.11)


@pytest.mark.parametrize("seed", range(5))
def test_drives_are_laid_after_those_that_they_meet_most_of(seed: int) -> None:
    random = np.random.default_rng(seed)
    point, drive = random.uniform(0.0, 40.0, (60, 3)), np.sort(random.integers(0, 8, 60))
    rows = [np.flatnonzero(drive == number) for number in np.unique(drive)]
    near = np.linalg.norm(point[:, None] - point, axis=2) <= 6.0
    known: list[int] = []
    while len(known) < len(rows):
        met = [len(of) * sum(bool(near[np.ix_(of, rows[k])].any()) for k in known) for of in rows]
        left = [number for number in range(len(rows)) if number not in known]
        known.append(max(left, key=lambda i: (met[i], len(rows[i]), -i)))
    assert order_of_laying(point, rows) == known


def test_two_vague_landmarks_that_another_shift_fits_make_no_jump() -> None:
    random = np.random.default_rng(4)
    objects = np.column_stack([np.arange(14) * 20.0, random.uniform(-8.0, 8.0, 14), np.full(14, 5.0)])
    drive = np.repeat([0, 1], 14)
    away = np.array([4.0, 4.0, 0.0])
    for count, sigma_m in ((2, 1.0), (6, 0.3)):
        points = np.concatenate([objects, objects])
        points[28 - count :] += away
        covariance = np.tile(0.3**2 * np.eye(3), (28, 1, 1))
        covariance[28 - count :] = sigma_m**2 * np.eye(3)
        shift = register(landmarks(points, drive=drive, driven_m=points[:, 0]), covariance).shift_m
        expected = np.zeros(3) if count == 2 else -away
        assert np.abs(shift[28 - count :] - shift[14] - expected).max() <= 0.5


def test_a_trajectory_speaks_for_a_jump_where_a_step_is_unlike_the_others() -> None:
    plain, jumping = city(), city(jump_m=1.0, jumps_per_km=10.0)
    drives = find_drives(plain.images)
    hints = find_hints(jumping, find_drives(jumping.images))
    off = camera_poses(jumping.images)[1] - camera_poses(plain.images)[1]
    true, false = [], []
    for drive in range(drives.count):
        rows = np.flatnonzero(drives.pass_code == drive)
        rows = rows[np.argsort(drives.order[rows])]
        jumps = np.append(False, np.linalg.norm(np.diff(off[rows], axis=0), axis=1) > 0.5)
        speaks = hints.between(drive, drives.order[rows])
        true += speaks[jumps].tolist()
        false += speaks[~jumps].tolist()
    assert np.mean(np.array(true) > 8.0) > 0.6
    assert np.mean(np.array(false) > 8.0) < 0.05


def test_constellations_that_agree_are_not_moved_and_classes_are_kept_apart() -> None:
    random = np.random.default_rng(2)
    objects = random.uniform(0.0, 200.0, (10, 3)) * [1.0, 1.0, 0.02]
    marks = landmarks(np.tile(objects, (2, 1)), drive=np.repeat([0, 1], 10), driven_m=np.tile(objects[:, 0], 2))
    covariance = np.tile(0.1**2 * np.eye(3), (20, 1, 1))
    assert np.all(register(marks, covariance).shift_m == 0.0)
    other = dataclasses.replace(marks, class_code=np.repeat([0, 1], 10))
    assert len(np.unique(register(other, covariance).object_of_landmark)) == 20


def landmarks(points: Floats, *, drive: Ints, driven_m: Floats) -> Landmarks:
    count = len(points)
    return Landmarks(
        point_in_world_m=points,
        class_code=np.zeros(count, np.int64),
        size_m=np.ones(count),
        drive=drive,
        segment=drive,
        driven_m=driven_m,
        offsets=np.arange(count + 1),
        voters=np.arange(count),
    )


def test_a_signal_is_cut_where_any_cuts_are_cheapest(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(3)
    for _ in range(5):
        value = np.repeat([[0.0, 0.0], [1.5, -1.0], [0.0, 0.0]], [3, 4, 3], axis=0) + random.normal(0.0, 0.4, (10, 2))
        precision = np.tile(np.diag([4.0, 9.0]), (10, 1, 1))
        price = 8.0

        def cost(starts: tuple[int, ...], value: Floats = value, price: float = price) -> float:
            parts = np.split(value, starts)
            return sum(float(np.sum((p - p.mean(axis=0)) ** 2 * [4.0, 9.0])) for p in parts) + price * len(starts)

        every = [c for k in range(4) for c in itertools.combinations(range(1, 10), k)]
        best = min(every, key=cost)
        assert cut_into_segments(value, precision, np.full(10, price)) == [0, *best]
        # However many of its pieces are looked at together.
        with monkeypatch.context() as patched:
            patched.setattr(refine_estimate, "_PIECES", 30)
            assert cut_into_segments(value, precision, np.full(10, price)) == [0, *best]


@pytest.mark.parametrize(
    ("evidence", "is_shown", "gain", "is_cut"),
    [
        # One step in a thousand jumps: minus twice the log odds are 13.8.
        (0.0, False, 20.0, False),
        (0.0, False, 24.0, True),
        (-6.0, False, 24.0, False),
        (6.0, False, 20.0, True),
        (99.0, False, 7.0, False),
        (99.0, False, 9.0, True),
        (-6.0, True, 9.0, True),
    ],
)
def test_jumps_are_as_rare_as_one_step_in_a_thousand_but_where_a_trajectory_speaks_for_them(
    evidence: float, is_shown: bool, gain: float, is_cut: bool
) -> None:
    # Each of the twenty is half a step from the mean of all.
    value = np.repeat([[0.0, 0.0], [np.sqrt(gain / 5.0), 0.0]], 10, axis=0)
    precision = np.tile(np.eye(2), (20, 1, 1))
    price = prices(np.full(20, evidence), np.full(20, is_shown))
    assert (len(cut_into_segments(value, precision, price)) > 1) == is_cut


def test_segments_are_found_by_drive_and_order() -> None:
    segments = Segments(np.array([0, 0, 1]), np.array([0, 5, 0]))
    assert segments.of(np.array([0, 0, 0, 1, 1]), np.array([0, 4, 5, 0, 9])).tolist() == [0, 0, 1, 2, 2]


def test_what_drives_that_drift_see_beside_itself_is_one_object_but_for_two_that_an_image_shows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tracks, "_covariances", lambda *_: np.tile(1e-6 * np.eye(3), (2, 1, 1)))
    seen, state, _ = few_observations()
    # Every observation is of one of two places; the second one is 0.4 m beside the first.
    thing = np.asarray(seen.drive == seen.drive[0], np.int64)
    point = state.point_in_world_m[:1] + np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    beside = dataclasses.replace(seen, thing=thing)
    state = dataclasses.replace(state, point_in_world_m=point)
    classes = np.zeros(2, np.int64)
    assert merge_objects(beside, state, seen.image, classes, 0.2).tolist() == [0, 0]
    assert merge_objects(beside, state, seen.image, classes, 0.01).tolist() == [0, 1]
    assert merge_objects(beside, state, np.zeros(len(seen), np.int64), classes, 0.2).tolist() == [0, 1]


def test_the_closest_pairs_are_taken_first_one_to_one_in_each_image() -> None:
    random = np.random.default_rng(5)
    for _ in range(20):
        pairs = np.unique(random.integers(0, 6, (14, 2)), axis=0)
        image, square = pairs[:, 0] // 2, random.uniform(size=len(pairs))
        literal: list[int] = []
        for k in np.argsort(square).tolist():
            rivals = [
                o
                for o in literal
                if pairs[o, 0] == pairs[k, 0] or (image[o] == image[k] and pairs[o, 1] == pairs[k, 1])
            ]
            literal += [] if rivals else [k]
        assert tracks._one_to_one(image, pairs[:, 0], pairs[:, 1], square).tolist() == sorted(literal)


def test_products_of_groups_are_the_sums_of_those_of_their_members() -> None:
    random = np.random.default_rng(6)
    code, rows = random.integers(0, 9, 40), random.normal(size=(40, 2, 5))
    groups = adjust.Groups(code)
    expected = [np.sum([row.T @ row for row in rows[code == kind]], axis=0) for kind in np.unique(code)]
    np.testing.assert_allclose(groups.products(rows), expected, atol=1e-12)


def test_a_waiting_car_gives_the_middle_one_of_its_images() -> None:
    dataset = city()
    drives = find_drives(dataset.images)
    chosen = keyframes(drives, dataset.images.camera_id)
    assert np.array_equal(np.unique(drives.viewpoint[chosen]), np.unique(drives.viewpoint))
    assert chosen.sum() == len(np.unique(drives.viewpoint))
    longest = np.argmax(np.bincount(drives.viewpoint))
    members = np.sort(drives.order[drives.viewpoint == longest])
    assert drives.order[chosen & (drives.viewpoint == longest)][0] == members[len(members) // 2]


def test_velocities_are_found_once_and_only_where_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[Dataset] = []

    def find(dataset: Dataset, drives: Drives) -> StepsOfImages:
        found.append(dataset)
        return find_steps(dataset, drives)

    monkeypatch.setattr(refine_footage, "find_steps", find)
    ordered = in_driving_order(city())
    footage = gather(ordered.dataset, ordered.drives)
    assert not found
    assert footage.motion is footage.motion
    assert len(found) == 1
    # Once more for what is laid without a delay, and not for each of those that are tried.
    segment, turned = footage.drives.pass_code, np.zeros((footage.drives.count, 3))
    delay_alone(lambda late_s: poses.moved_footage(footage, turned, late_s), segment, valuemap.MapConfig(), threads=1)
    assert len(found) == 2


def test_velocities_are_those_of_the_trajectory() -> None:
    dataset = city(position_white_m=0.0, position_drift_m=0.0)
    drives = find_drives(dataset.images)
    motion = find_steps(dataset, drives).motion()
    speed = np.linalg.norm(motion.forward_mps, axis=1)
    assert motion.is_timed.all()
    assert np.median(speed[speed > 1.0]) == pytest.approx(CITY.speed_mps, rel=0.02)
    assert speed.max() < 1.3 * CITY.speed_mps


def test_jumps_of_poses_are_seen_in_the_trajectory_and_stops_and_turns_are_none() -> None:
    settings = {"jump_m": 3.0, "jumps_per_km": 10.0}
    plain, jumping = city(), city(**settings)
    drives = find_drives(plain.images)
    assert len(find_jumps(plain, drives)) == drives.count
    center, other = (camera_poses(d.images)[1] for d in (plain, jumping))
    found = find_jumps(jumping, find_drives(jumping.images))
    segment = found.of(drives.pass_code, drives.order)
    off = other - center
    true = right = 0
    for drive in range(drives.count):
        rows = np.flatnonzero(drives.pass_code == drive)
        rows = rows[np.argsort(drives.order[rows])]
        jumps = np.linalg.norm(np.diff(off[rows], axis=0), axis=1) > 1.0
        true += int(jumps.sum())
        right += int((jumps & (np.diff(segment[rows]) != 0)).sum())
    assert true >= 8
    assert right >= 0.5 * true


def jumps_of(plain: Dataset, jumping: Dataset, drives: Drives) -> dict[tuple[int, int], Floats]:
    """Return how far (2) poses jump, by drive and the place in its order that they jump before."""
    off = (camera_poses(jumping.images)[1] - camera_poses(plain.images)[1])[:, :2]
    jumps: dict[tuple[int, int], Floats] = {}
    for drive in range(drives.count):
        rows = np.flatnonzero(drives.pass_code == drive)
        rows = rows[np.argsort(drives.order[rows])]
        for at in np.flatnonzero(np.linalg.norm(np.diff(off[rows], axis=0), axis=1) > 0.5) + 1:
            jumps[drive, int(drives.order[rows[at]])] = off[rows[at]] - off[rows[at - 1]]
    return jumps


def test_a_trajectory_proves_jumps_of_a_metre_and_says_how_far_they_are() -> None:
    plain, jumping = city(), city(jump_m=1.0, jumps_per_km=10.0)
    drives = find_drives(jumping.images)
    true = jumps_of(plain, jumping, drives)
    found = mend(jumping, drives)
    told = {(d, b): j for d, b, j in zip(found.drive.tolist(), found.begins.tolist(), found.jump_m, strict=True)}
    right = [place for place in told if place in true]
    assert len(true) >= 8
    assert len(right) >= 0.8 * len(true)
    assert len(right) >= 0.9 * len(told)
    apart = np.array([told[place] - true[place] for place in right])
    assert np.sqrt(np.mean(apart**2)) < 0.3
    # Stops and turns are none.
    assert len(mend(plain, find_drives(plain.images)).drive) == 0


def test_jumps_are_taken_back_one_after_the_other_and_links_say_the_same() -> None:
    jumping = city(jump_m=1.0, jumps_per_km=10.0)
    drives = find_drives(jumping.images)
    jumps = mend(jumping, drives)
    links = jumps.links(jumps.segments, set())
    np.testing.assert_allclose(
        jumps.offset_m[links.second, :2] - jumps.offset_m[links.first, :2], links.apart_m, atol=1e-12
    )
    back = jumps.offset_m[jumps.segments.of(drives.pass_code, drives.order)]
    for drive in range(drives.count):
        np.testing.assert_allclose(back[drives.pass_code == drive].mean(axis=0), 0.0, atol=1e-12)
    refuted = {(int(jumps.drive[0]), int(jumps.begins[0]))}
    assert len(jumps.links(jumps.segments, refuted).second) == len(links.second) - 1


@pytest.mark.parametrize("jumps", [(9,), (5, 12), (5, 10, 15)])
def test_of_a_drive_that_jumps_in_more_than_one_of_ten_steps_no_jump_is_proven(jumps: tuple[int, ...]) -> None:
    place = np.column_stack([2.0 * np.arange(20), np.zeros(20)])
    place += np.random.default_rng(0).normal(0.0, 0.01, place.shape)
    for row in jumps:
        place[row:, 1] += 2.0
    images = posed(place, time_s=0.2 * np.arange(20.0))
    drives = Drives(np.zeros(20, np.int64), np.arange(20), 2.0 * np.arange(20.0), np.arange(20), {})
    cameras = city().cameras
    found = mend(Dataset("drive", Frame(), cameras, images, Detections.none()), drives)
    assert found.begins.tolist() == (list(jumps) if len(jumps) <= 0.1 * 17 else [])


def few_observations() -> tuple[Observations, State, Footage]:
    """Return what some drives see of a few objects, with all kinds of errors somewhat wrong, and the footage."""
    ordered = in_driving_order(city(pass_shift_m=0.3, focal_error_share=0.01), viewpoint_step_m=1.0)
    footage = gather(*in_working_frame(ordered.dataset, ordered.drives, 1.0))
    drive = footage.drives.pass_code
    marks = find_landmarks(footage.dataset, footage.rays, footage.drives, drive, valuemap.MapConfig())
    few = np.flatnonzero(np.isin(marks.drive, [0, 2, 3]))[::3]
    chosen = np.isin(marks.landmark_of_voter(), few)
    thing = np.searchsorted(few, marks.landmark_of_voter()[chosen]) % 5
    noise = np.full(len(footage.rays), 2.0)
    seen = footage.observe(marks.voters[chosen], thing, drive, Sigmas(noise, 0.7 * noise))
    random = np.random.default_rng(6)
    counts = (footage.drives.count,) * 3 + (1,) * 3
    state = State.zero(marks.point_in_world_m[few][:5], len(footage.chain.drive), len(footage.row), counts)
    # Turns of a turned camera are derived to first order: none here. All are late, as early is another velocity.
    constants = tuple(
        np.full(c.shape, value) for value, c in zip((0.3, 0, 0, 0.01, 0, 0.05), state.constants, strict=True)
    )
    constants[OFFSET][:] = random.normal(0.0, 0.3, constants[OFFSET].shape)
    drift = random.normal(0.0, 0.01, state.drift.shape) * [1, 1, 1, 0, 0, 0]
    return seen, dataclasses.replace(state, constants=constants, drift=drift), footage


def test_a_detection_without_a_ray_says_nothing_of_how_far_others_move() -> None:
    *_, footage = few_observations()
    from_cam = footage.residual_from_cam.copy()
    from_cam[7] = np.nan
    without = dataclasses.replace(footage, residual_from_cam=from_cam)
    assert own_scales(without, NoiseLeft(), WIDE).own_rad == pytest.approx(
        own_scales(footage, NoiseLeft(), WIDE).own_rad, 1e-3
    )
    narrow = MapConfig(max_reprojection_error_px=0.01)
    assert gate_of_delay_px(without, narrow) == pytest.approx(gate_of_delay_px(footage, narrow), 1e-3) != 0.01
    from_cam[:] = np.nan
    assert gate_of_delay_px(dataclasses.replace(footage, residual_from_cam=from_cam), narrow) == 0.01


@pytest.mark.parametrize(("gain", "is_luck"), [(0.0, True), (-1.0, True), (1.0, False)])
def test_what_all_objects_gain_alike_is_luck_unless_it_is_more_than_nothing(gain: float, is_luck: bool) -> None:
    assert chance_of_gain(np.full(20, gain)) == pytest.approx(1.0 if is_luck else 0.0, abs=1e-4)


def test_how_much_few_objects_gain_does_not_tell_whether_it_is_luck() -> None:
    """They are as many coins: of seven all show the same side once in 128 times."""
    assert chance_of_gain(np.array([9.9, 10.0, 10.1])) == pytest.approx(1.0 / 8.0)
    assert chance_of_gain(np.linspace(9.9, 10.1, 7)) == pytest.approx(1.0 / 128.0)
    assert chance_of_gain(np.linspace(9.9, 10.1, 8)) < 1e-6


def test_what_many_objects_gain_nothing_of_is_looked_at_where_others_gain_much() -> None:
    """A jump moves few of the objects that all drives see: what is right, and not luck, is what gains differ by."""
    gain = np.array([-31.0, -8.0, 0.0, 0.0, 0.0, 1.0, 7.0, 24.0, 27.0, 36.0, 70.0, 212.0, 236.0])
    nothing = State.zero(np.zeros((1, 3)), 1, 1, (1,) * 6)
    of_offsets = tuple(np.full(c.shape, kind == OFFSET) for kind, c in enumerate(nothing.constants))
    of_jump = Selected(nothing, of_offsets, (), float(gain.sum()), 40.0, chance_of_gain(gain), len(gain))
    assert of_jump.is_proven
    # How a camera is turned, or all that a drive shows, touches all objects.
    for turned in (FOCAL, MOUNT, CAMERA_MOUNT):
        of_turn = tuple(np.full(c.shape, kind == turned) for kind, c in enumerate(nothing.constants))
        assert not dataclasses.replace(of_jump, active=of_turn).is_proven
        assert dataclasses.replace(of_jump, active=of_turn, chance=0.009).is_proven
    assert not dataclasses.replace(of_jump, gain=45.0).is_proven
    assert not dataclasses.replace(of_jump, chance=0.6).is_proven


@pytest.mark.parametrize(("told", "is_worth"), [(0.006, True), (0.008, False)])
def test_a_focal_length_that_objects_tell_less_well_than_a_calibration_does_is_worth_nothing(
    told: float, is_worth: bool
) -> None:
    seen, state, footage = few_observations()
    active = tuple(np.full(c.shape, kind == FOCAL) for kind, c in enumerate(state.constants))
    constants = tuple(np.where(flags, -0.05, 0.0) for flags in active)
    column_of = tuple(np.where(flags, 0, -1) for flags in active)
    narrow = tuple(np.zeros_like(flags) for flags in active)
    linked, things = np.arange(footage.drives.count), len(state.point_in_world_m)
    # However well it is known as a rule, it may be wrong by as much as any.
    known = tuple(0.01 if kind == FOCAL else sigma for kind, sigma in enumerate(WIDE.constant))
    scales = dataclasses.replace(WIDE, constant=known)
    trial = Trial(seen, footage.chain, scales, things, Links.none(), linked, narrow)
    worth = trial._worth(FittedConstants(constants, np.array([[told**2]]), column_of), active, narrow)
    assert (worth[FOCAL][0, 0] > 0.0) == is_worth


def test_the_price_of_errors_is_how_much_better_they_are_known_than_thought() -> None:
    seen, state, footage = few_observations()
    scales = Scales(0.2, 0.004, 0.1, 0.002, (3.0, 0.03, 0.2, 0.05, 0.03, 0.2))
    things = len(state.point_in_world_m)

    def price(free: dict[int, list[int]], links: Links) -> float:
        active = tuple(np.zeros(c.shape, np.bool_) for c in state.constants)
        for kind, rows in free.items():
            active[kind][rows] = True
        problem = Adjustment(seen, footage.chain, scales, active, things, links)
        return price_of(problem, adjust.adjust(problem, state, tolerances=(1.0,), with_variance=True))

    active = tuple(np.full(c.shape, kind == FOCAL) for kind, c in enumerate(state.constants))
    problem = Adjustment(seen, footage.chain, scales, active, things, Links.none())
    known = adjust.adjust(problem, state, tolerances=(1.0,), with_variance=True)
    assert known.covariance is not None
    thought = scales.constant[FOCAL] ** 2
    of_focal = np.log(thought / known.covariance[0, 0]) + known.constants[FOCAL][0, 0] ** 2 / thought
    assert price({FOCAL: [0]}, Links.none()) == pytest.approx(of_focal)
    # A drive that sees nothing could be anywhere, and is as free as it was.
    blind = int(np.setdiff1d(np.arange(footage.drives.count), seen.views.segment[seen.image])[0])
    one, two = (int(drive) for drive in np.unique(seen.views.segment[seen.image])[:2])
    alone = price({OFFSET: [one]}, Links.none())
    assert price({OFFSET: [one, blind]}, Links.none()) == pytest.approx(alone)
    # What a jump ties to each other is one offset.
    both = price({OFFSET: [one, two]}, Links.none())
    tied = Links(np.array([one]), np.array([two]), np.zeros((1, 2)), np.array([1e8 * np.eye(2)]))
    assert price({OFFSET: [one, two]}, tied) < 0.75 * both


def test_a_step_is_that_of_all_unknowns_in_one_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, state, footage = few_observations()
    active = tuple(np.ones(c.shape, np.bool_) for c in state.constants)
    active[MOUNT][1:, 2] = active[OFFSET][2] = False
    state = dataclasses.replace(
        state, constants=tuple(np.where(a, c, 0.0) for a, c in zip(active, state.constants, strict=True))
    )
    scales = Scales(0.2, 0.004, 0.1, 0.002, (3.0, 0.03, 0.2, 0.05, 0.03, 0.2))
    # One of them is to a segment that is not free.
    information = np.array([[[30.0, 5.0], [5.0, 20.0]], [[9.0, 0.0], [0.0, 9.0]]])
    links = Links(np.array([0, 2]), np.array([1, 3]), np.array([[0.7, -0.2], [0.1, 0.4]]), information)
    ties = SameObjects(np.array([0, 3]), np.array([4, 1]), 20.0, 50.0)
    problem = Adjustment(seen, footage.chain, scales, active, len(state.point_in_world_m), links, ties)

    def moved(by: Floats) -> State:
        parts = np.split(by, np.cumsum([state.point_in_world_m.size, state.drift.size]))
        values = iter(parts[2])
        constants = tuple(c.copy() for c in state.constants)
        for kind, flags in enumerate(active):
            for at in np.argwhere(flags):
                constants[kind][tuple(at)] += next(values)
        point = state.point_in_world_m + parts[0].reshape(-1, 3)
        return dataclasses.replace(
            state, point_in_world_m=point, drift=state.drift + parts[1].reshape(-1, 6), constants=constants
        )

    free = sum(int(flags.sum()) for flags in active)
    count = state.point_in_world_m.size + state.drift.size + free
    residual, depth = residuals(seen, state)
    weight = np.repeat(weights(seen, residual, depth, 2.0) * (seen.sigma_px / seen.detection_sigma_px) ** 2, 2)
    step = 1e-6
    images = np.unique(seen.image)
    assert len(images) < len(seen)  # Some show several objects.

    def off_by_themselves(by: Floats) -> State:
        return dataclasses.replace(state, own=state.own + by)

    # What an image is off by changes what it shows itself: all are moved at once.
    of_own = [
        (residuals(seen, off_by_themselves(step * unit))[0] - residuals(seen, off_by_themselves(-step * unit))[0])
        for unit in np.eye(6)
    ]
    by_own = np.zeros((residual.size, 6 * len(images)))
    own = 6 * np.repeat(np.searchsorted(images, seen.image), 2)[:, None] + np.arange(6)
    np.put_along_axis(by_own, own, np.stack(of_own, axis=-1).reshape(-1, 6) / (2.0 * step), axis=1)
    known = np.diag(np.tile(np.repeat([scales.own_m**-2, scales.own_rad**-2], 3), len(images)))
    weighted = weight[:, None] * by_own
    precision_of_rows = np.diag(weight) - weighted @ np.linalg.solve(known + by_own.T @ weighted, weighted.T)
    keep, drive = footage.chain.keep, footage.chain.drive
    # Drives that see nothing are no part of the problem.
    idle = np.repeat(~np.isin(drive, seen.drive), 6)
    first = state.point_in_world_m.size
    last = first + state.drift.size
    jacobian = np.zeros((residual.size, count))
    for column in np.delete(np.arange(count), first + np.flatnonzero(idle)):
        unit = step * np.eye(1, count, int(column))[0]
        either = residuals(seen, moved(unit))[0] - residuals(seen, moved(-unit))[0]
        jacobian[:, column] = either.ravel() / (2.0 * step)
    prior, mean = np.zeros((count, count)), np.zeros(count)
    prior[np.arange(first), np.arange(first)] = 1e-6
    nodes = len(keep)
    alike = np.array(
        [
            [np.prod(keep[min(i, j) + 1 : max(i, j) + 1]) * (drive[i] == drive[j]) for j in range(nodes)]
            for i in range(nodes)
        ]
    )
    precision = np.kron(np.linalg.inv(alike + 1e-9 * np.eye(nodes)), np.diag([0.2**-2.0] * 3 + [0.004**-2.0] * 3))
    precision[idle] = precision[:, idle] = 0.0
    precision[idle, idle] = 1.0
    prior[first:last, first:last] = precision
    mean[first:last] = np.where(idle, 0.0, state.drift.ravel())
    sigma = [np.full(int(flags.sum()), scales.constant[kind]) for kind, flags in enumerate(active)]
    prior[np.arange(last, count), np.arange(last, count)] = np.concatenate(sigma) ** -2.0
    mean[last:] = np.concatenate([c[flags] for c, flags in zip(state.constants, active, strict=True)])
    hessian = jacobian.T @ precision_of_rows @ jacobian + prior
    right = -jacobian.T @ precision_of_rows @ residual.ravel() - prior @ mean
    place = np.full(active[OFFSET].shape, -1)
    place[active[OFFSET]] = last + np.arange(int(active[OFFSET].sum()))
    for one, other in zip(ties.first, ties.second, strict=True):
        by = np.zeros((3, count))
        by[:, 3 * one : 3 * one + 3], by[:, 3 * other : 3 * other + 3] = np.eye(3), -np.eye(3)
        apart_m = state.point_in_world_m[one] - state.point_in_world_m[other]
        of_tie = 20.0**-2.0 / (1.0 + np.sum(apart_m**2) / (50.0 * 2.0 * 2.0) ** 2)
        hessian += of_tie * by.T @ by
        right -= of_tie * by.T @ apart_m
    for first_one, second, apart, of in zip(links.first, links.second, links.apart_m, information, strict=True):
        by = np.zeros((2, count))
        for axis in range(2):
            by[axis, place[second, axis]] += 1.0
            if place[first_one, axis] >= 0:
                by[axis, place[first_one, axis]] -= 1.0
        left = state.constants[OFFSET][second, :2] - state.constants[OFFSET][first_one, :2] - apart
        hessian += by.T @ of @ by
        right -= by.T @ of @ left
    expected = np.asarray(np.linalg.solve(hessian, right))
    literal = moved(expected)
    things = np.arange(first // 3)
    literal_of_things = np.linalg.inv(hessian)[:first, :first].reshape(len(things), 3, len(things), 3)
    groups = np.array([[2, 0], [1, 2]])
    for dense_limit in (0, 3000):
        monkeypatch.setattr(adjust, "_DENSE_LIMIT", dense_limit)
        after, gain = problem.step(state, 2.0, with_variance=True)
        assert after.covariance is not None
        np.testing.assert_allclose(after.point_in_world_m, literal.point_in_world_m, atol=1e-4)
        np.testing.assert_allclose(after.drift, literal.drift, atol=1e-4)
        for ours, theirs in zip(after.constants, literal.constants, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-4)
        assert gain == pytest.approx(right @ expected, rel=1e-3)
        np.testing.assert_allclose(after.covariance, np.linalg.inv(hessian)[last:, last:], rtol=1e-2, atol=1e-7)
        of_each = problem.step(state, 2.0, of_groups=things[:, None])[0].covariance
        assert of_each is not None
        np.testing.assert_allclose(of_each, literal_of_things[things, :, things, :], rtol=1e-2, atol=1e-5)
        of_groups = problem.step(state, 2.0, of_groups=groups)[0].covariance
        assert of_groups is not None
        for group, covariance in zip(groups, of_groups, strict=True):
            literal_of_group = literal_of_things[np.ix_(group, range(3), group, range(3))].reshape(6, 6)
            np.testing.assert_allclose(covariance, literal_of_group, rtol=1e-2, atol=1e-5)


def test_equations_tell_what_others_are_without_a_group_as_a_fit_without_it_does() -> None:
    seen, state, footage = few_observations()
    state = State.zero(state.point_in_world_m, len(state.drift), len(state.own), tuple(map(len, state.constants)))
    scales = Scales(0.2, 0.004, 0.1, 0.002, (3.0, 0.03, 0.2, 0.05, 0.03, 0.2))
    active = tuple(np.ones(c.shape, np.bool_) for c in state.constants)
    fewer = (active[OFFSET], np.zeros_like(active[MOUNT]), *active[2:])
    # Equal weights: what a fit without the group has others of is no part of the comparison.
    fits = {}
    for name, flags in (("all", active), ("fewer", fewer)):
        problem = Adjustment(seen, footage.chain, scales, flags, len(state.point_in_world_m), Links.none())
        fits[name] = problem, problem.step(state, 1e6, with_variance=True)[0]
    told = EquationsOfConstants.at(*fits["all"]).solved(fewer, scales)
    covariance = fits["fewer"][1].covariance
    assert covariance is not None
    for ours, theirs in zip(told.constants, fits["fewer"][1].constants, strict=True):
        # What observations hardly tell is known to fewer digits.
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * np.abs(theirs).max() + 1e-9)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(told.covariance / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-4)


def test_poses_that_are_right_cost_few_steps() -> None:
    assert 10 < watched(0.0).steps < 60


def test_velocities_change_at_once_where_a_car_stops_beside_images_that_are_missing() -> None:
    # Four images a second at 8 m/s until 3.1 s, and standing from then on; nothing is seen from 4 to 8 s.
    time_s: Floats = np.concatenate([0.25 * np.arange(17), 8.0 + 0.25 * np.arange(8)])
    at_m = 8.0 * np.minimum(time_s, 3.1)
    step_s = np.diff(time_s)
    speed = np.column_stack([np.diff(at_m) / step_s, np.zeros((len(step_s), 2))])
    usable: Bools = np.asarray(step_s < 1.0)
    true = (8.0 * np.minimum(time_s[:-1] + 0.2, 3.1) - at_m[:-1]) / 0.2
    found = Rates(speed, *rates_at_ends(speed, step_s, usable)).within(np.full(len(step_s), 0.2))
    np.testing.assert_allclose(found[:, 0], true, atol=1e-9)
    # A turn that goes on where nothing is seen: the mean rate until images are there again tells nothing of it.
    rate = np.where(time_s[:-1] < 3.5, 0.0, 60.0)
    rate[14], rate[16] = 24.0, 5.0
    for is_usable, first in ((usable, 0.0), (np.ones_like(usable), 24.0)):
        rates = np.column_stack([rate] * 3)
        found = Rates(rates, *rates_at_ends(rates, step_s, is_usable)).within(np.full(len(step_s), 0.1))
        np.testing.assert_allclose(found[14], first, atol=1e-9)


@pytest.mark.parametrize("late_s", [0.03, 0.1, -0.03, -0.1])
def test_a_turn_that_begins_or_ends_between_two_images_is_none_before_or_after(late_s: float) -> None:
    # One camera, four images a second; it turns at once by 60 degrees a second from 2.07 s to 4.12 s.
    time_s: Floats = np.asarray(0.25 * np.arange(24))

    def azimuth_rad(at_s: Floats) -> Floats:
        return np.asarray(np.radians(60.0) * np.clip(at_s - 2.07, 0.0, 4.12 - 2.07))

    def images(at_s: Floats) -> Images:
        rotation = Rotation.from_euler("y", azimuth_rad(at_s)[:, None])
        quat = rotation.as_quat(canonical=True, scalar_first=True)
        center = np.column_stack([5.0 * at_s, np.zeros((len(at_s), 2))])
        return dataset.images.take(np.arange(len(at_s))).replace(
            cam_from_world_quat=quat,
            cam_from_world_m=-np.einsum("nij,nj->ni", rotation.as_matrix(), center),
            timestamp_s=time_s,
        )

    dataset = city()
    recorded, true = (dataclasses.replace(dataset, images=images(at)) for at in (time_s, np.asarray(time_s + late_s)))
    count = len(time_s)
    drives = dataclasses.replace(
        find_drives(dataset.images),
        pass_code=np.zeros(count, np.int64),
        order=np.arange(count),
        driven_m=np.asarray(5.0 * time_s),
        viewpoint=np.arange(count),
    )
    for known, worst_deg in ((np.full(count, late_s), 1e-3), (None, 0.5)):
        motion = find_steps(recorded, drives).motion(known)
        rate = motion.forward_radps if late_s > 0.0 else motion.backward_radps
        turned = rotations(late_s * rate) @ camera_poses(recorded.images)[0]
        off = Rotation.from_matrix(turned @ camera_poses(true.images)[0].transpose(0, 2, 1)).magnitude()
        assert (np.degrees(off).max() < worst_deg) == (known is not None)
