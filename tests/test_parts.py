"""Each part of the robust method has a scene that fails without it, and no part has none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import valuemap
from block import block
from test_few import some_pictures
from valuemap import robust
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, rows_of
from valuemap.sightings import cast_sightings
from valuemap.simulate import simulate
from valuemap.tables import Floats, covariance_matrices
from valuemap.tiles.source import InMemory

NEAR_M = 2.0
HONEST_CHI2 = 16.0
POSES_AS_THEY_ARE = valuemap.MapConfig().with_settings(["correct_poses=0"])
NO_LIGHTS = {"has_lights": 0, "lookalikes_per_light": 0.0}
BLOCKS: dict[str, dict[str, float]] = {
    "lights": {},
    "drifts": {"position_drift_m": 0.4, "position_white_m": 0.05, "passes_per_street": 3},
    "poor detector": {"recall_mean": 0.35, "clutter_per_image": 0.5, "passes_per_street": 3},
    "temporary": {"temporary_per_1000_images": 10.0},
    "reflections": {
        "reflections_per_1000_images": 8.0,
        "reflection_images": 30.0,
        "frame_spacing_m": 1.0,
        "pixel_noise_px": 0.6,
        "passes_per_street": 1,
    },
    "confused classes": {
        "class_confusion": 0.15,
        "sign_row_spacing_m": 20.0,
        "lookalikes_per_light": 0.0,
        "passes_per_street": 1,
    },
    "rows": {"sign_row_spacing_m": 30.0, "sign_apart_m": 0.9, "passes_per_street": 1, **NO_LIGHTS},
    "close rows": {"sign_row_spacing_m": 30.0, "sign_apart_m": 0.5, **NO_LIGHTS},
    "standing": {"frame_spacing_m": 20.0},
    "narrow": {"max_facing_deg": 20.0},
    "trees": {"tree_spacing_m": 8.0, "max_sight_m": 60.0, "passes_per_street": 1, **NO_LIGHTS},
    "far off": {
        "tail_share": 0.2,
        "max_sight_m": 100.0,
        "frame_spacing_m": 1.2,
        "passes_per_street": 2,
        "lookalikes_per_light": 0.0,
    },
    "wandering boxes": {
        "noise_memory_images": 10.0,
        "pixel_noise_px": 2.0,
        "position_white_m": 0.02,
        "rotation_white_deg": 0.02,
        "frame_spacing_m": 1.0,
        "passes_per_street": 1,
        "lookalikes_per_light": 0.0,
    },
    "missed": {"tail_share": 0.1, "tree_spacing_m": 8.0, "max_sight_m": 60.0, "passes_per_street": 1, **NO_LIGHTS},
    "uneven trees": {
        "tree_spacing_m": 10.0,
        "side_offset_m": 0.2,
        "max_sight_m": 60.0,
        "passes_per_street": 1,
        **NO_LIGHTS,
    },
    "uneven lamps": {"lamp_spacing_m": 25.0, "side_offset_m": 0.15, "passes_per_street": 4, **NO_LIGHTS},
}
"""Changes of the block's settings; scenes of few pictures are those of `test_few.py`."""
FEW_PICTURES = "few pictures"
RANGES = "few pictures with ranges"
RANGE_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Score:
    """How good a map is: `chi2` (N) are the squared normalised errors of right labels, of those within 2 m."""

    objects: int
    labels: int
    chi2: Floats
    existence: Floats
    variance_m2: Floats
    energy: float

    @property
    def right(self) -> int:
        """Labels that are near an object, one each."""
        return len(self.chi2)

    @property
    def honest(self) -> int:
        """Right labels that say how wrong they may be."""
        return int((self.chi2 < HONEST_CHI2).sum())

    @property
    def wrong(self) -> int:
        """Labels that are near no object of their own, and objects without one."""
        return self.labels + self.objects - 2 * self.right


@cache
def scene(name: str, seed: int) -> tuple[Dataset, Floats]:
    """Return a scene, and where its objects are."""
    if name == FEW_PICTURES:
        return some_pictures(seed, one_in=15)
    if name == RANGES:
        return some_pictures(seed, one_in=15, change=lambda whole: with_ranges(whole, seed))
    dataset = simulate(block(**BLOCKS[name]), seed=seed, name="block")
    assert dataset.truth is not None
    return dataset, dataset.truth.position_in_world_m


def with_ranges(dataset: Dataset, seed: int) -> Dataset:
    """Return a dataset whose detections have ranges: a tenth off, those of clutter anywhere."""
    rng, detections, truth, shown = (
        np.random.default_rng(seed),
        dataset.detections,
        dataset.truth,
        dataset.truth_detections,
    )
    assert truth is not None
    assert shown is not None
    range_m = rng.uniform(5.0, 60.0, len(detections))
    row = rows_of(shown.detection_id, detections.detection_id)
    center_m = camera_centers(dataset.images)[rows_of(detections.image_id[row], dataset.images.image_id)]
    away_m = truth.position_in_world_m[rows_of(shown.object_id, truth.object_id)] - center_m
    range_m[row] = np.linalg.norm(away_m, axis=1) * rng.lognormal(0.0, RANGE_SHARE, len(row))
    return replace(dataset, detections=detections.replace(range_m=range_m, range_sigma_m=RANGE_SHARE * range_m))


def score(name: str, seed: int, without: str | None = None) -> Score:
    """Map a scene, perhaps without a part of the method."""
    dataset, objects = scene(name, seed)
    robust.LEFT_OUT = {without} if without else set()
    try:
        result = valuemap.build_map(dataset, POSES_AS_THEY_ARE)
    finally:
        robust.LEFT_OUT = set()
    labels = result.labels
    assert labels.covariance_m2 is not None
    assert labels.existence is not None
    covariance = covariance_matrices(labels.covariance_m2)
    apart_m = np.linalg.norm(labels.position_in_world_m[:, None] - objects, axis=2)
    label, of = linear_sum_assignment(np.where(apart_m < NEAR_M, apart_m - 1e6, 0.0))
    is_near = apart_m[label, of] < NEAR_M
    error_m = labels.position_in_world_m[label[is_near]] - objects[of[is_near]]
    chi2 = np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(covariance[label[is_near]]), error_m)
    counts = result.run["counts"]
    trace_m2 = np.trace(covariance, axis1=1, axis2=2)
    existence = labels.existence[label[is_near]]
    return Score(len(objects), len(labels), chi2, existence, trace_m2, counts["energy"])


whole = cache(score)


def j_is_higher(best: Score, without: Score) -> bool:
    """A move of the search: J of the map is higher without it."""
    return without.energy > best.energy + 1.0


def more_is_wrong(best: Score, without: Score) -> bool:
    return without.wrong > best.wrong


def fewer_are_honest(best: Score, without: Score) -> bool:
    return without.honest < best.honest


def errors_are_larger_than_said(best: Score, without: Score) -> bool:
    return bool(without.chi2.mean() > 1.2 * best.chi2.mean())


def covariances_are_less_honest(best: Score, without: Score) -> bool:
    """Squared normalised errors of three axes are 3 on average."""
    off, of_without = (abs(math.log(one.chi2.mean() / 3.0)) for one in (best, without))
    return of_without > off + math.log(1.2)


def less_is_said_of_what_is_contested(best: Score, without: Score) -> bool:
    return bool(without.variance_m2.sum() < 0.999 * best.variance_m2.sum() and without.chi2.mean() > best.chi2.mean())


def what_is_there_is_believed_less(best: Score, without: Score) -> bool:
    return bool(without.existence.mean() < best.existence.mean() - 1e-3)


Fails = Callable[[Score, Score], bool]
CASES: dict[str, tuple[str, int, Fails]] = {
    "polishing": ("uneven trees", 8, more_is_wrong),
    "assignment": ("trees", 9, j_is_higher),
    "merging": ("uneven trees", 8, j_is_higher),
    "exchanges": ("temporary", 5, j_is_higher),
    "contested_exchanges": ("rows", 3, j_is_higher),
    "near_exchanges": ("close rows", 17, j_is_higher),
    "repair": ("rows", 5, j_is_higher),
    "halves": (FEW_PICTURES, 5, more_is_wrong),
    "two_for_one": (FEW_PICTURES, 6, more_is_wrong),
    "births": ("trees", 2, more_is_wrong),
    "taken_votes": (FEW_PICTURES, 5, j_is_higher),
    "untangling": ("close rows", 17, more_is_wrong),
    "exclusion": ("trees", 9, more_is_wrong),
    "sizes": (FEW_PICTURES, 5, more_is_wrong),
    "ranges": (RANGES, 5, more_is_wrong),
    "heights": (FEW_PICTURES, 5, fewer_are_honest),
    "scores": ("poor detector", 5, more_is_wrong),
    "elevations": (FEW_PICTURES, 9, more_is_wrong),
    "tails": ("missed", 6, more_is_wrong),
    "reach": ("drifts", 5, what_is_there_is_believed_less),
    "aspect": ("narrow", 7, what_is_there_is_believed_less),
    "company": (FEW_PICTURES, 5, more_is_wrong),
    "ghosts": ("far off", 6, more_is_wrong),
    "carried": ("reflections", 5, more_is_wrong),
    "looks": ("lights", 5, more_is_wrong),
    "turns": ("standing", 2, more_is_wrong),
    "confusions": ("confused classes", 6, more_is_wrong),
    "shared_noise": ("drifts", 5, errors_are_larger_than_said),
    "noise_split": ("close rows", 17, more_is_wrong),
    "memory": ("wandering boxes", 5, covariances_are_less_honest),
    "sides": ("uneven lamps", 5, more_is_wrong),
    "contest": ("close rows", 17, less_is_said_of_what_is_contested),
    "scaling": ("drifts", 7, errors_are_larger_than_said),
}
"""By part: a scene, its seed, and what is worse there without the part."""
ELSEWHERE = {
    "identity_switches": "the unit tests of switches.rs: simulated poses do not bend while a car turns",
    "existence": "the unit tests of existence.rs: small scenes have too few false things to tell what they are like",
}
"""Parts that no simulated scene fails without, and what pins them."""


@pytest.mark.parametrize("part", CASES)
def test_a_scene_fails_without(part: str) -> None:
    name, seed, fails = CASES[part]
    best = whole(name, seed)
    assert fails(best, score(name, seed, without=part))
    assert not fails(best, best)


def test_what_is_left_over_is_born_where_not_all_moves_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    ordered = InMemory(scene("trees", 2)[0], POSES_AS_THEY_ARE).sample()
    seen = robust.Scene(ordered.dataset, ordered.drives, cast_sightings(ordered.dataset)[0], 1.0)
    known = replace(robust.calibrate(seen, POSES_AS_THEY_ARE)[0], is_deep=False)
    _, counts = robust.find_labels(seen, known, POSES_AS_THEY_ARE)
    monkeypatch.setattr(robust, "LEFT_OUT", {"births"})
    _, without = robust.find_labels(seen, known, POSES_AS_THEY_ARE)
    assert counts["births"] > without["births"]
    assert counts["energy"] < without["energy"] - 1.0


def test_every_part_has_a_scene() -> None:
    assert {*CASES, *ELSEWHERE} == set(robust.PARTS)
    assert not CASES.keys() & ELSEWHERE.keys()
