"""Settings of `valuemap map`, a stage a class, and all of them together."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, Self, get_args

from pydantic.dataclasses import dataclass

from valuemap.config.setting import (
    CHECKED,
    LARGEST_SIGMA_M,
    LONGEST_M,
    SHORTEST_M,
    WIDEST_PX,
    Method,
    Setting,
    Settings,
    assign,
    declare,
    declared,
    owner_of,
)
from valuemap.errors import SettingError

USUAL_RANGE_M = 60.0
"""How far away objects of a street are at most, from where they tell their place."""
NEAREST = 1.0 / 30.0
"""How near, as a share of it: 2 m."""


@dataclass(frozen=True, config=CHECKED)
class PartitionConfig(Settings):
    """How images are split into independent clusters."""

    cluster_radius_m: float = declare(
        50.0,
        unit="m",
        open_low=True,
        high=LONGEST_M,
        effect="a seed takes all free images closer than this (N_max of the paper); "
        "larger sees objects from more images and costs more",
        method="paper",
    )


@dataclass(frozen=True, config=CHECKED)
class VoteConfig(Settings):
    """Which hypotheses are viable, who votes, and when the greedy selection stops."""

    max_reprojection_error_px: float = declare(
        6.0,
        unit="px",
        open_low=True,
        high=WIDEST_PX,
        effect="a detection votes for a point that projects closer than this (d_max of the paper)",
        method="paper",
    )
    min_parallax_deg: float = declare(
        2.0,
        unit="deg",
        high=90.0,
        effect="two rays closer than this in angle propose no point (theta_min of the paper)",
    )
    min_range_m: float | None = declare(
        None,
        example=NEAREST * USUAL_RANGE_M,
        unit="m",
        high=LONGEST_M,
        effect="a proposed point nearer than this to either of its cameras is dropped; a thirtieth of max_range_m",
    )
    max_range_m: float | None = declare(
        None,
        example=USUAL_RANGE_M,
        unit="m",
        low=SHORTEST_M,
        high=LONGEST_M,
        effect="a proposed point farther than this from either of its cameras is dropped (r_max of the paper); "
        "`robust` takes points and detections up to 2.5 times as far, and without it tells it from the data",
    )
    min_vote_ratio: float = declare(
        1.0,
        unit="1",
        high=1e3,
        effect="a point is accepted while its votes reach this multiple of the mean votes of the hypotheses "
        "still alive (alpha of the paper); larger is stricter",
        method="paper",
    )
    min_votes: int = declare(
        3, unit="images", low=2, high=10**6, effect="a point is accepted only with votes from at least this many images"
    )

    @property
    def farthest_m(self) -> float:
        """`max_range_m`, or what is usual in streets."""
        return USUAL_RANGE_M if self.max_range_m is None else self.max_range_m

    @property
    def nearest_m(self) -> float:
        """`min_range_m`, or what is usual where points are so far away at most."""
        return NEAREST * self.farthest_m if self.min_range_m is None else self.min_range_m

    @property
    def unit_m(self) -> float:
        """The unit, in metres, of what has none of its own: a metre where points are as far away as in streets."""
        return self.farthest_m / USUAL_RANGE_M


@dataclass(frozen=True, config=CHECKED)
class NoiseConfig(Settings):
    """How far a detection may be from where its object projects; what is not set is estimated from the data."""

    gate_sigmas: float = declare(
        4.0,
        unit="sigmas",
        open_low=True,
        high=100.0,
        effect="a detection votes for a point that projects closer than this many standard deviations",
        method="robust",
    )
    detection_sigma_px: float | None = declare(
        None,
        example=1.5,
        unit="px",
        open_low=True,
        high=1e3,
        effect="standard deviation of a detection's centre, each axis",
    )
    position_sigma_m: float | None = declare(
        None,
        example=0.1,
        unit="m",
        high=LARGEST_SIGMA_M,
        effect="standard deviation of a camera position, each axis",
        method="robust",
    )
    rotation_sigma_deg: float | None = declare(
        None,
        example=0.1,
        unit="deg",
        high=45.0,
        effect="standard deviation of a camera rotation, each axis",
        method="robust",
    )
    side_sigma_m: float | None = declare(
        None,
        example=0.1,
        unit="m",
        high=LARGEST_SIGMA_M,
        effect="standard deviation of the middle of an object's box, as one side of the object shows it, each axis",
        method="robust",
    )


@dataclass(frozen=True, config=CHECKED)
class PosesConfig(Settings):
    """Whether poses are corrected before objects are looked for."""

    correct_poses: int = declare(
        1,
        unit="0 or 1",
        high=1,
        effect="0 takes poses and cameras as they are; 1 corrects what whole drives are proven to be off by",
        method="robust",
    )


@dataclass(frozen=True, config=CHECKED)
class ExistenceConfig(Settings):
    """Which labels are kept."""

    min_existence: float = declare(
        0.55,
        unit="1",
        high=1.0,
        effect="labels that exist with a smaller probability are dropped",
        method="robust",
    )
    least_votes: int = declare(
        1,
        unit="images",
        low=1,
        high=10**6,
        effect="where the heights and sizes of a class are known from others of the map, a label needs votes from "
        "no more than this many images",
        method="robust",
    )


@dataclass(frozen=True, config=CHECKED)
class MergeConfig(Settings):
    """When labels of different clusters are one object."""

    merge_radius_m: float = declare(
        1.0,
        unit="m",
        high=LONGEST_M,
        effect="labels of different clusters closer than this become one",
        method="paper",
    )


@dataclasses.dataclass(frozen=True, init=False)
class MapConfig:
    """All settings of one `map` run, by stage; single ones by name as well: `MapConfig(max_range_m=80)`."""

    method: Method = "robust"
    partition: PartitionConfig = PartitionConfig()
    vote: VoteConfig = VoteConfig()
    noise: NoiseConfig = NoiseConfig()
    existence: ExistenceConfig = ExistenceConfig()
    merge: MergeConfig = MergeConfig()
    poses: PosesConfig = PosesConfig()

    def __init__(
        self,
        method: Method = "robust",
        partition: PartitionConfig = partition,
        vote: VoteConfig = vote,
        noise: NoiseConfig = noise,
        existence: ExistenceConfig = existence,
        merge: MergeConfig = merge,
        poses: PosesConfig = poses,
        **settings: float | None,
    ) -> None:
        stages: dict[str, Any] = {
            "partition": partition, "vote": vote, "noise": noise, "existence": existence, "merge": merge,
            "poses": poses,
        }  # fmt: skip
        for name, value in settings.items():
            stage = owner_of(name, stages, name)
            stages[stage] = dataclasses.replace(stages[stage], **{name: value})
        for name, value in {"method": method, **stages}.items():
            object.__setattr__(self, name, value)  # As a frozen dataclass does.
        self._check()

    def _check(self) -> None:
        if self.method not in get_args(Method):
            raise SettingError(
                f"method: expected one of {', '.join(get_args(Method))}, found {self.method!r}",
                hint="leave --method away for the default",
            )
        for name, stage in self._stages().items():
            if not isinstance(stage, type(getattr(MapConfig, name))):
                raise SettingError(
                    f"{name}: expected {type(getattr(MapConfig, name)).__name__}, found {stage!r}",
                    hint="single settings go by their names: MapConfig(max_range_m=80)",
                )
        if self.vote.nearest_m >= self.vote.farthest_m:
            raise SettingError(
                f"min_range_m ({self.vote.nearest_m}) must be less than max_range_m ({self.vote.farthest_m})",
                hint="set both, e.g. --set min_range_m=2 --set max_range_m=60",
            )

    def with_settings(self, assignments: Iterable[str]) -> Self:
        """Return a copy with `name=value` assignments applied, as given to `--set`.

        Raises
        ------
        SettingError
            A name that no stage has, or that the method ignores; a value that is not a number, or out of range.
        """
        assignments = list(assignments)
        owner = self.ignored_settings()
        for name in (assignment.partition("=")[0].strip() for assignment in assignments):
            if name in owner:  # A user would look for an effect that cannot be.
                raise SettingError(
                    f"--set {name}: the method {self.method} has no such setting, only {owner[name]} has it",
                    hint=f"leave it away, or use --method {owner[name]}",
                )
        return dataclasses.replace(self, **assign(self._stages(), assignments))

    def ignored_settings(self) -> dict[str, Method]:
        """Return the settings that the method does not have, each with the only method that has it."""
        return {s.name: s.method for s in _all_settings() if s.method is not None and s.method != self.method}

    def as_dict(self) -> dict[str, float | str | None]:
        """Return all settings, flat, as `run.json` holds them."""
        flat: dict[str, float | str | None] = {"method": self.method}
        for stage in self._stages().values():
            flat.update(dataclasses.asdict(stage))
        return flat

    def _stages(self) -> Mapping[str, Any]:
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "method"}


def _all_settings() -> list[Setting]:
    return [setting for stage in MapConfig()._stages().values() for setting in declared(stage)]


def describe_settings() -> list[tuple[str, str, str, str]]:
    """Return (name, default, unit, effect) of every setting, in the order of the stages."""
    return [(s.name, s.shown_default, s.unit, s.shown_effect) for s in _all_settings()]


def list_settings() -> list[dict[str, Any]]:
    """Return every setting as an object of JSON: name, default (null: estimated), unit, effect, method (null: all)."""
    return [{key: getattr(s, key) for key in ("name", "default", "unit", "effect", "method")} for s in _all_settings()]
