"""The robust method: noise estimated from the data, then labels with covariances and probabilities of existence."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

import valuemap._core as _core
from valuemap.arrays import Floats, Ints
from valuemap.cameras import Rays, camera_poses, picture_bounds
from valuemap.config import MapConfig, NoiseConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.drives import Drives
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, counted, silent
from valuemap.rounding import rounding_px
from valuemap.tables.candidates import Candidates

PARTS: tuple[str, ...] = tuple(_core.parts())
"""Parts of the method: moves of the search, terms of J, and what is done before and after; the core's `parts`."""
LEFT_OUT: set[str] = set()
"""Those to leave out. For tests and the ablation benchmark; not a setting."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what moves a detection off its object; see the core's `noise`.

    Each axis; position and rotation have a part that each image has for itself, and a part that drifts and is shared
    by the images of a pass that see one object. The middle of an object as one side of it shows it is off by `side_m`.
    What successive looks at an object are off by themselves has a `look_correlation`.
    """

    detection_px: float = 2.0
    box_share: float = 0.04
    position_m: float = 0.1
    rotation_rad: float = math.radians(0.1)
    position_segment_m: float = 0.03
    rotation_segment_rad: float = math.radians(0.03)
    position_drift_m: float = 0.1
    rotation_drift_rad: float = math.radians(0.1)
    side_m: float = 0.0
    look_correlation: float = 0.0

    def as_tuple(self) -> tuple[float, ...]:
        """Return the ten numbers in the order of the fields."""
        return astuple(self)

    def in_units(self, unit_m: float) -> Noise:
        """Return it with lengths in units of so many metres."""
        return replace(
            self,
            position_m=self.position_m / unit_m,
            position_segment_m=self.position_segment_m / unit_m,
            position_drift_m=self.position_drift_m / unit_m,
            side_m=self.side_m / unit_m,
        )


@dataclass(frozen=True)
class Calibration:
    """All that is estimated once of a dataset, before any part of it is mapped.

    What is learned of classes has lengths in the unit of the settings that it was learned with, `VoteConfig.unit_m`.
    """

    noise: Noise
    noise_of_covariances: Noise
    """The same where successive looks, or middles that sides show, may be off: what covariances are estimated with."""
    is_deep: bool
    """Whether all moves of the search pay."""
    classes: dict[str, tuple[float, ...]]
    """What is learned of each class of the sample, by its name: the numbers of the core's `ClassModel::to_row`."""
    pooled: tuple[float, ...]
    """What is learned of all classes together: what others are like."""
    confusions: dict[str, dict[str, float]]
    """By class of the object and said class: the share of its detections. Only where classes are taken for others."""

    def as_tuple(self, class_names: Sequence[str], unit_m: float) -> tuple[Any, ...]:
        """Return it as the core takes it, for classes in this order."""
        classes = [self.classes.get(name) for name in class_names]
        code = {name: number for number, name in enumerate(class_names)}
        shares = [
            [(code[said], share) for said, share in self.confusions.get(name, {}).items() if said in code]
            for name in class_names
        ]
        noise = (each.in_units(unit_m).as_tuple() for each in (self.noise, self.noise_of_covariances))
        return *noise, self.is_deep, classes, self.pooled, shares


def calibration_to_json(calibration: Calibration) -> dict[str, Any]:
    """Return a calibration as an object of JSON; numbers that are not finite are null.

    What is learned of a class has the names of the core's `ClassModel::FIELDS`, which `docs/tables.md` explains.
    """
    classes = {name: _named(row) for name, row in calibration.classes.items()}
    return {**asdict(calibration), "classes": classes, "pooled": _named(calibration.pooled)}


def calibration_from_json(value: Any, *, source: str) -> Calibration:
    """Read what `calibration_to_json` returned; raises `InputError` naming the `source` where it is something else."""
    try:
        return Calibration(
            noise=_noise(value["noise"]),
            noise_of_covariances=_noise(value["noise_of_covariances"]),
            is_deep=bool(value["is_deep"]),
            classes={name: _numbers(fields) for name, fields in value["classes"].items()},
            pooled=_numbers(value["pooled"]),
            confusions={
                name: {said: float(share) for said, share in shares.items()}
                for name, shares in value["confusions"].items()
            },
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{source}: is no calibration: {error}", hint="make the map again") from error


def _noise(value: dict[str, Any]) -> Noise:
    return Noise(**{name: float(number) for name, number in value.items()})


def _named(row: Sequence[float]) -> dict[str, Any]:
    """Return the numbers of a class by the names of the core's fields, single ones as such."""
    named: dict[str, Any] = {}
    left = iter(number if math.isfinite(number) else None for number in row)
    for name, count in _core.CLASS_FIELDS:
        numbers = list(islice(left, count))
        named[name] = numbers[0] if count == 1 else numbers
    return named


def _numbers(fields: dict[str, Any]) -> tuple[float, ...]:
    """Return what `_named` was given; raises `ValueError` naming the field where it is of another version."""
    row: list[float] = []
    for name, count in _core.CLASS_FIELDS:
        value = fields.get(name)
        numbers = [value] if count == 1 and name in fields else value
        if not isinstance(numbers, list) or len(numbers) != count:
            raise ValueError(f"expected {count} numbers as {name} of each class, as this version of valuemap has")
        row.extend(math.nan if number is None else float(number) for number in numbers)
    return tuple(row)


class Scene:
    """A dataset as the core's robust method holds it: in units of `unit_m`, which its lengths in metres are of."""

    def __init__(self, dataset: Dataset, drives: Drives, rays: Rays, unit_m: float) -> None:
        self._dataset = dataset
        self._drives = drives
        self.rays = rays
        self.unit_m = unit_m

    @property
    def class_names(self) -> Sequence[str]:
        """The names of the classes, by code."""
        return self._dataset.detections.class_name.names

    @cached_property
    def rounding_px(self) -> float:
        """The standard deviation that rounding alone gives the centres of detections, px."""
        return rounding_px(self._dataset)

    @cached_property
    def core(self) -> _core.Scene:
        """Everything that was seen, copied once."""
        images, detections = self._dataset.images, self._dataset.detections
        normals, solid_angle_sr = picture_bounds(self._dataset.cameras)
        cam_from_world, center_in_world_m = camera_poses(images)
        self._check_unit(center_in_world_m)
        return _core.Scene(
            self.rays.core if self.unit_m == 1.0 else self.rays.core.in_units(self.unit_m),
            box_px=np.ascontiguousarray(detections.size_px[:, 1]),
            score=_or_nan(detections.score, len(detections)),
            range_m=_or_nan(detections.range_m, len(detections)) / self.unit_m,
            range_sigma_m=_or_nan(detections.range_sigma_m, len(detections)) / self.unit_m,
            center_in_world_m=center_in_world_m / self.unit_m,
            cam_from_world=cam_from_world,
            camera=rows_of(images.camera_id, self._dataset.cameras.camera_id).astype(np.uint32),
            pass_code=self._drives.pass_code.astype(np.uint32),
            viewpoint=self._drives.viewpoint.astype(np.uint32),
            driven_m=self._drives.driven_m / self.unit_m,
            position_sigma_m=_or_nan(images.position_sigma_m, len(images)) / self.unit_m,
            rotation_sigma_rad=_or_nan(images.rotation_sigma_rad, len(images)),
            frustum_normals=normals,
            solid_angle_sr=solid_angle_sr,
        )

    def _check_unit(self, center_in_world_m: Floats) -> None:
        farthest_m = float(np.abs(center_in_world_m).max(initial=0.0))
        if farthest_m > _core.FARTHEST_M * self.unit_m:
            raise SettingError(
                f"max_range_m: images are up to {farthest_m:.3g} m from the origin, too far for so short a range",
                hint="leave max_range_m away to have it told from the data",
            )


MISFIT_STEPS: int = _core.MISFIT_STEPS
"""Maps that the core makes to find the likeliest noise, at most."""


def calibrate(
    scene: Scene,
    config: MapConfig,
    *,
    is_part: bool = False,
    sought: Noise | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> tuple[Calibration, Candidates]:
    """Estimate the noise from the residuals of labels in a sample of places, and learn what its classes are like.

    Also the objects that classes are learned from, which are the map of a sample of places.

    What the config sets of the noise stays as it is. The scene may be a part of what is mapped. `sought` is what
    `misfits` found of the same scene with the same config, or what was estimated without the middles that sides show:
    to seek it from all starts is the most work, and done once.
    """
    guess, known = _guess(config.noise, scene)
    steps = _core.CALIBRATION_STEPS + (2 * _core.SEARCH_STEPS if is_part else 0)
    with counted(progress, "estimating the noise", steps) as tell:
        (noise, of_covariances, is_deep, classes, pooled, shares), position, (offsets, voters) = _core.calibrate(
            scene.core,
            guess,
            known,
            _settings(config, scene.unit_m),
            is_part,
            None if sought is None else sought.in_units(scene.unit_m).as_tuple(),
            threads,
            lambda done, _total: tell(done),
        )
    metre = 1.0 / scene.unit_m
    calibration = Calibration(
        noise=Noise(*noise).in_units(metre),
        noise_of_covariances=Noise(*of_covariances).in_units(metre),
        is_deep=is_deep,
        classes={name: tuple(row) for name, row in zip(scene.class_names, classes, strict=False) if row is not None},
        pooled=tuple(pooled),
        confusions=_by_name(shares, scene.class_names),
    )
    return calibration, Candidates(position * scene.unit_m, offsets, voters)


def _by_name(shares: Sequence[Sequence[tuple[int, float]]], class_names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the shares of other classes by names, of those classes that have any."""
    rows = zip(class_names, shares, strict=False)
    return {name: {class_names[said]: share for said, share in row} for name, row in rows if row}


def misfits(
    scenes: tuple[Scene, Scene],
    second_of_first: Ints,
    config: MapConfig,
    *,
    threads: int,
    tell: Callable[[int], None],
) -> tuple[tuple[float, float], int, Noise | None]:
    """Return how badly the same detections, those of a sample of places, fit in two scenes, and how many they are.

    Also the noise that `calibrate` would seek in the first scene from all starts again, None where it has others.

    Minus twice the logarithm of their likelihood, up to a constant of theirs. What is true makes them likelier.
    `second_of_first` (N) is the row in the second scene of each detection of the first. `tell` hears again and again
    how many of `MISFIT_STEPS` are done, and stops the work by an exception.
    """
    guess, known = _guess(config.noise, scenes[0])
    (first, second), count, sought = _core.misfits(
        (scenes[0].core, scenes[1].core),
        second_of_first.astype(np.uint32),
        guess,
        known,
        _settings(config, scenes[0].unit_m),
        threads,
        lambda done, _total: tell(done),
    )
    return (first, second), count, None if sought is None else Noise(*sought).in_units(1.0 / scenes[0].unit_m)


def steps_of_labels(calibration: Calibration) -> int:
    """Return in how many steps labels are found, at most: where they begin, and the moves of the search."""
    return 1 + (_core.SEARCH_STEPS if calibration.is_deep else _core.STEPS_OF_ONCE)


_COUNTED_AS = {"recall": "detection_rate", "recall_concentration": "detection_rate_concentration"}
"""The share of the looks in which a detector sees what is there is no recall: that is a map's, against truth."""


def find_labels(
    scene: Scene, calibration: Calibration, config: MapConfig, *, threads: int = 0, progress: Progress = silent
) -> tuple[Candidates, dict[str, Any]]:
    """Return the labels, ordered by first detection, and counts of what was found and rejected."""
    with counted(progress, "finding labels", steps_of_labels(calibration)) as tell:
        position, class_code, (offsets, voters), covariance, existence, expected, counts = _core.find_labels(
            scene.core,
            calibration.as_tuple(scene.class_names, scene.unit_m),
            _settings(config, scene.unit_m),
            threads,
            lambda done, _total: tell(done),
        )
    covariance = covariance.reshape(-1, 3, 3) * scene.unit_m**2
    said = scene.rays.class_code[voters.astype(np.int64)]
    is_confused = said != np.repeat(class_code, np.diff(offsets))
    counts = {"votes_of_another_class": int(is_confused.sum()), **counts}
    counts = {_COUNTED_AS.get(name, name): value for name, value in counts.items()}
    return Candidates(
        position * scene.unit_m, offsets, voters, None, covariance, existence, expected, class_code.astype(np.int64)
    ), counts


def _guess(given: NoiseConfig, scene: Scene) -> tuple[tuple[float, ...], tuple[list[bool], float]]:
    """Return where the estimation starts, in units, and what is known: what the user sets, and that boxes are rounded.

    The former are detection, position and rotation; detections are off by at least as much as they are rounded, px.
    """
    noise, unit_m = Noise(), scene.unit_m
    if given.detection_sigma_px is not None:
        noise = replace(noise, detection_px=given.detection_sigma_px, box_share=0.0)
    # A known total says nothing about its parts: a third of the variance each.
    if given.position_sigma_m is not None:
        part = given.position_sigma_m / unit_m / math.sqrt(3.0)
        noise = replace(noise, position_m=part, position_segment_m=part, position_drift_m=part)
    if given.rotation_sigma_deg is not None:
        part = math.radians(given.rotation_sigma_deg) / math.sqrt(3.0)
        noise = replace(noise, rotation_rad=part, rotation_segment_rad=part, rotation_drift_rad=part)
    if given.side_sigma_m is not None:
        noise = replace(noise, side_m=given.side_sigma_m / unit_m)
    known = [given.detection_sigma_px, given.position_sigma_m, given.rotation_sigma_deg]
    return noise.as_tuple(), ([value is not None for value in known], scene.rounding_px)


def _settings(config: MapConfig, unit_m: float) -> tuple[float, float, float, float, int, int, float, list[str]]:
    vote = config.vote
    return (
        math.radians(vote.min_parallax_deg),
        vote.nearest_m / unit_m,
        vote.farthest_m / unit_m,
        config.noise.gate_sigmas,
        vote.min_votes,
        config.existence.least_votes,
        config.existence.min_existence,
        sorted(LEFT_OUT),
    )


def _or_nan(values: Floats | None, count: int) -> Floats:
    return np.full(count, np.nan) if values is None else np.ascontiguousarray(values)
