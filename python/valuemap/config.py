"""Every default of the method, once, with its unit and its effect.

One frozen dataclass a stage. The field names are the names that `--set`, `run.json` and the docs use.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Self, get_args

from valuemap.errors import SettingError

Method = Literal["robust", "paper"]

_LONGEST_M = 1e5
"""Nothing in the world of one map is farther apart; beyond it squares of metres swallow the metres."""
_WIDEST_PX = 1e5
"""Wider than any picture."""
_TOO_LARGE = 2**63
"""Whole numbers from here on fit no integer of the core."""


def _setting(
    default: float | None,
    *,
    unit: str,
    effect: str,
    low: float = 0.0,
    high: float = math.inf,
    open_low: bool = False,
    method: Method | None = None,
) -> Any:
    """Declare one setting: default (None: estimated from the data), unit, effect and the range that makes sense.

    `method` is the only one that has it; None for a setting of all methods.
    """
    return field(
        default=default,
        metadata={"unit": unit, "effect": effect, "low": low, "high": high, "open_low": open_low, "method": method},
    )


MAX_THREADS = 1024
"""More are a slip of the keyboard, and take minutes to start."""


def bounded_threads(threads: int) -> int:
    """Return a number of threads to work on (0: one a core), no more than can do anything; results do not depend on it.

    Raises
    ------
    SettingError
        It is no number of threads.
    """
    if not 0 <= threads <= MAX_THREADS:
        raise SettingError(
            f"threads: expected 0 to {MAX_THREADS}, found {threads}", hint="leave it away for one thread a core"
        )
    return min(threads, 4 * (os.cpu_count() or 1))


@dataclass(frozen=True)
class PartitionConfig:
    """How images are split into independent clusters."""

    cluster_radius_m: float = _setting(
        50.0,
        unit="m",
        open_low=True,
        high=_LONGEST_M,
        effect="a seed takes all free images closer than this (N_max of the paper); "
        "larger sees objects from more images and costs more",
        method="paper",
    )


@dataclass(frozen=True)
class VoteConfig:
    """Which hypotheses are viable, who votes, and when the greedy selection stops."""

    max_reprojection_error_px: float = _setting(
        6.0,
        unit="px",
        open_low=True,
        high=_WIDEST_PX,
        effect="a detection votes for a point that projects closer than this (d_max of the paper)",
        method="paper",
    )
    min_parallax_deg: float = _setting(
        2.0,
        unit="deg",
        high=90.0,
        effect="two rays closer than this in angle propose no point (theta_min of the paper)",
    )
    min_range_m: float = _setting(
        2.0, unit="m", high=_LONGEST_M, effect="a proposed point nearer than this to either of its cameras is dropped"
    )
    max_range_m: float = _setting(
        60.0,
        unit="m",
        open_low=True,
        high=_LONGEST_M,
        effect="a proposed point farther than this from either of its cameras is dropped (r_max of the paper)",
    )
    min_vote_ratio: float = _setting(
        1.0,
        unit="1",
        high=1e3,
        effect="a point is accepted while its votes reach this multiple of the mean votes of the hypotheses "
        "still alive (alpha of the paper); larger is stricter",
        method="paper",
    )
    min_votes: int = _setting(
        3, unit="images", low=2, high=10**6, effect="a point is accepted only with votes from at least this many images"
    )


@dataclass(frozen=True)
class NoiseConfig:
    """How far a detection may be from where its object projects; what is not set is estimated from the data."""

    gate_sigmas: float = _setting(
        4.0,
        unit="sigmas",
        open_low=True,
        high=100.0,
        effect="a detection votes for a point that projects closer than this many standard deviations",
        method="robust",
    )
    detection_sigma_px: float | None = _setting(
        None,
        unit="px",
        open_low=True,
        high=1e3,
        effect="standard deviation of a detection's centre, each axis",
    )
    position_sigma_m: float | None = _setting(
        None,
        unit="m",
        high=100.0,
        effect="standard deviation of a camera position, each axis",
        method="robust",
    )
    rotation_sigma_deg: float | None = _setting(
        None,
        unit="deg",
        high=45.0,
        effect="standard deviation of a camera rotation, each axis",
        method="robust",
    )


@dataclass(frozen=True)
class ExistenceConfig:
    """Which labels are kept."""

    min_existence: float = _setting(
        0.55,
        unit="1",
        high=1.0,
        effect="labels that exist with a smaller probability are dropped",
        method="robust",
    )


@dataclass(frozen=True)
class MergeConfig:
    """When labels of different clusters are one object."""

    merge_radius_m: float = _setting(
        1.0,
        unit="m",
        high=_LONGEST_M,
        effect="labels of different clusters closer than this become one",
        method="paper",
    )


@dataclass(frozen=True, init=False)
class MapConfig:
    """All settings of one `map` run, by stage; single ones by name as well: `MapConfig(max_range_m=80)`."""

    method: Method = "robust"
    partition: PartitionConfig = PartitionConfig()
    vote: VoteConfig = VoteConfig()
    noise: NoiseConfig = NoiseConfig()
    existence: ExistenceConfig = ExistenceConfig()
    merge: MergeConfig = MergeConfig()

    def __init__(
        self,
        method: Method = "robust",
        partition: PartitionConfig = partition,
        vote: VoteConfig = vote,
        noise: NoiseConfig = noise,
        existence: ExistenceConfig = existence,
        merge: MergeConfig = merge,
        **settings: float | None,
    ) -> None:
        stages: dict[str, Any] = {
            "partition": partition, "vote": vote, "noise": noise, "existence": existence, "merge": merge,
        }  # fmt: skip
        for name, value in settings.items():
            stage, _ = _owner_of(name, stages, name)
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
        for stage in self._stages().values():
            for setting in fields(stage):
                _check_range(setting, getattr(stage, setting.name))
        if self.vote.min_range_m >= self.vote.max_range_m:
            raise SettingError(
                f"min_range_m ({self.vote.min_range_m}) must be less than max_range_m ({self.vote.max_range_m})",
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
        changed = dataclasses.replace(self, **_assign(self._stages(), assignments))
        owner = self.ignored_settings()
        for name in (assignment.partition("=")[0].strip() for assignment in assignments):
            if name in owner:  # A user would look for an effect that cannot be.
                raise SettingError(
                    f"--set {name}: the method {self.method} has no such setting, only {owner[name]} has it",
                    hint=f"leave it away, or use --method {owner[name]}",
                )
        return changed

    def ignored_settings(self) -> dict[str, Method]:
        """Return the settings that the method does not have, each with the only method that has it."""
        settings = [setting for stage in self._stages().values() for setting in fields(stage)]
        owner = {setting.name: setting.metadata["method"] for setting in settings}
        return {name: method for name, method in owner.items() if method not in (None, self.method)}

    def as_dict(self) -> dict[str, float | str | None]:
        """Return all settings, flat, as `run.json` holds them."""
        flat: dict[str, float | str | None] = {"method": self.method}
        for stage in self._stages().values():
            flat.update(dataclasses.asdict(stage))
        return flat

    def _stages(self) -> Mapping[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "method"}


def describe_settings() -> list[tuple[str, str, str, str]]:
    """Return (name, default, unit, effect) of every setting, in the order of the stages."""
    return [
        (s.name, _shown(s.default), s.metadata["unit"], _effect_of(s))
        for stage in MapConfig()._stages().values()
        for s in fields(stage)
    ]


def list_settings() -> list[dict[str, Any]]:
    """Return every setting as an object of JSON: name, default (null: estimated), unit, effect, method (null: all)."""
    return [
        {"name": s.name, "default": s.default, **{key: s.metadata[key] for key in ("unit", "effect", "method")}}
        for stage in MapConfig()._stages().values()
        for s in fields(stage)
    ]


def _assign(stages: Mapping[str, Any], assignments: Iterable[str]) -> dict[str, Any]:
    """Return the stages by name, with `name=value` assignments applied to the stage that has the name."""
    changes: dict[str, dict[str, float]] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        name = name.strip()
        if not equals:
            example, (_, setting) = next(iter(_owners(stages).items()))
            raise SettingError(
                f"--set {assignment}: expected name=value", hint=f"for example --set {example}={setting.default}"
            )
        stage, setting = _owner_of(name, stages, f"--set {assignment}")
        changes.setdefault(stage, {})[name] = _parse(setting, text.strip())
    return {stage: dataclasses.replace(config, **changes.get(stage, {})) for stage, config in stages.items()}


def _owners(stages: Mapping[str, Any]) -> dict[str, tuple[str, dataclasses.Field[Any]]]:
    """Return the stage and the declaration of every setting by name."""
    return {s.name: (stage, s) for stage, config in stages.items() for s in fields(config) if s.metadata}


def _owner_of(name: str, stages: Mapping[str, Any], where: str) -> tuple[str, dataclasses.Field[Any]]:
    """Return the stage and the declaration of one setting; `where` is what errors begin with."""
    owner = _owners(stages)
    if name not in owner:
        near = difflib.get_close_matches(name, owner, n=1)
        raise SettingError(
            f"{where}: there is no setting named {name!r}",
            hint=f"did you mean {near[0]}?" if near else f"settings are: {', '.join(sorted(owner))}",
        )
    return owner[name]


def _parse(setting: dataclasses.Field[Any], text: str) -> float:
    number = int if isinstance(setting.default, int) else float
    try:
        return number(text)
    except ValueError:
        kind = "a whole number" if number is int else "a number"
        raise SettingError(
            f"{setting.name}: expected {kind} ({setting.metadata['unit']}), found {text!r}",
            hint=f"the default is {setting.name}={_shown(setting.default)}",
        ) from None


def _effect_of(setting: dataclasses.Field[Any]) -> str:
    """Return the effect of a setting with the only method that has it, if there is one."""
    method = setting.metadata["method"]
    return f"{setting.metadata['effect']}{f' ({method})' if method else ''}"


def _shown(value: Any) -> str:
    return "estimated" if value is None else str(value)


def _check_range(setting: dataclasses.Field[Any], value: float | None) -> None:
    if value is None and setting.default is None:
        return
    kind = numbers.Integral if isinstance(setting.default, int) else numbers.Real
    if not isinstance(value, kind) or isinstance(value, bool):
        expected = "a whole number" if kind is numbers.Integral else "a number"
        raise SettingError(
            f"{setting.name}: expected {expected} ({setting.metadata['unit']}), found {value!r}",
            hint=f"the default is {setting.name}={_shown(setting.default)}",
        )
    low, high = setting.metadata["low"], setting.metadata["high"]
    too_low = value <= low if setting.metadata["open_low"] else value < low
    if too_low or value > high or not abs(value) < _TOO_LARGE:  # Nor infinite, nor NaN.
        above = "above" if setting.metadata["open_low"] else "at least"
        upper = f" and at most {high:g}" if math.isfinite(high) else ""
        raise SettingError(
            f"{setting.name}: expected {above} {low:g}{upper} ({setting.metadata['unit']}), found {value}",
            hint=f"the default is {setting.name}={_shown(setting.default)}",
        )


@dataclass(frozen=True)
class TrainConfig:
    """How a segmentation network is built and trained."""

    # The network. Its size on disk and its speed depend on these alone.
    first_stride: int = _setting(
        2, unit="px", low=1, high=2, effect="2 works on the picture at half size: four times as fast, coarser boxes"
    )
    first_channels: int = _setting(16, unit="channels", low=1, effect="channels of the first convolution")
    growth_channels: int = _setting(10, unit="channels", low=1, effect="new channels a layer of a dense block")
    first_layers: int = _setting(
        2, unit="layers", low=1, effect="layers of the first and last dense block, at the full size; the dearest"
    )
    layers: int = _setting(4, unit="layers", low=1, effect="layers of each other dense block")
    levels: int = _setting(
        4, unit="halvings", low=1, high=4, effect="how often a picture is halved and enlarged again; more sees wider"
    )
    compression: float = _setting(
        0.6, unit="1", open_low=True, high=1.0, effect="share of the channels that a transition down keeps"
    )
    dropout: float = _setting(0.05, unit="1", high=0.9, effect="share of channels left out at random in training")

    # The optimisation.
    epochs: int = _setting(40, unit="epochs", low=1, effect="how often the network sees every picture")
    cutouts: int = _setting(
        1, unit="cut-outs", low=1, effect="cut-outs of each picture an epoch; more validates and saves less often"
    )
    batch: int = _setting(8, unit="pictures", low=1, effect="cut-outs a step; more needs more memory")
    learning_rate: float = _setting(
        0.003, unit="1", open_low=True, high=1.0, effect="largest step; rises over the first 5 % and falls to nothing"
    )
    weight_decay: float = _setting(0.0005, unit="1", effect="pull of the weights towards 0")
    focal_power: float = _setting(
        2.0, unit="1", high=5.0, effect="how little pixels count that are right already; 0 counts all alike"
    )
    small_object_px: float = _setting(
        64.0, unit="px", effect="pixels of an object smaller than this count more, so that it counts like one as large"
    )
    validation_share: float = _setting(
        0.2,
        unit="1",
        open_low=True,
        high=0.9,
        effect="share of the pictures kept for validation where the labels do not say which",
    )
    minimum_component_px: int = _setting(
        4, unit="px", low=1, effect="connected pixels fewer than this are no detection"
    )

    # The augmentation.
    crop_px: int = _setting(
        256, unit="px", low=32, high=4096, effect="side of the square cut-outs, a multiple of 32; larger costs more"
    )
    object_share: float = _setting(
        0.7, unit="1", high=1.0, effect="share of cut-outs that hold an object, where the picture has one"
    )
    flip_share: float = _setting(0.5, unit="1", high=1.0, effect="share of cut-outs with left and right exchanged")
    max_enlargement: float = _setting(
        1.6, unit="1", low=1.0, high=8.0, effect="pictures are enlarged or shrunk by at most this, at random"
    )
    brightness: float = _setting(
        0.3, unit="1", high=0.9, effect="brightness, contrast and the balance of colours vary by about this share"
    )
    blur_sigma_px: float = _setting(1.0, unit="px", effect="a third of the cut-outs are blurred by up to this")

    def __post_init__(self) -> None:
        for setting in fields(self):
            _check_range(setting, getattr(self, setting.name))
        if self.crop_px % 32:
            raise SettingError(
                f"crop_px: expected a multiple of 32, found {self.crop_px}", hint="take 256, 320 or 384, say"
            )

    def with_settings(self, assignments: Iterable[str]) -> Self:
        """Return a copy with `name=value` assignments applied; raises as `MapConfig.with_settings`."""
        changed: Self = _assign({"train": self}, assignments)["train"]
        return changed


@dataclass(frozen=True)
class SimulationConfig:
    """A simulated city, its drives, its camera, its detector and all their errors."""

    # The city.
    streets_north_south: int = _setting(
        6,
        unit="streets",
        low=2,
        effect="streets that run north to south; with the next, the size of the city",
    )
    streets_east_west: int = _setting(6, unit="streets", low=2, effect="streets that run east to west")
    block_east_m: float = _setting(
        110.0, unit="m", low=60.0, effect="mean distance between two streets that run north to south"
    )
    block_north_m: float = _setting(
        90.0, unit="m", low=60.0, effect="mean distance between two streets that run east to west"
    )
    block_jitter: float = _setting(
        0.15, unit="1", high=0.3, effect="blocks are longer or shorter by up to this share of the mean"
    )
    street_width_m: float = _setting(
        26.0,
        unit="m",
        low=24.0,
        high=40.0,
        effect="from house front to house front; wider streets see round corners",
    )
    relief_m: float = _setting(2.0, unit="m", effect="standard deviation of the height of the ground; 0 is a flat city")
    signalised_share: float = _setting(
        0.3, unit="1", high=1.0, effect="share of the intersections that have lights (at least one has)"
    )
    lights: int = _setting(
        0, unit="lights", effect="exact number of lights; 0 takes as many as the intersections happen to have"
    )
    min_lights: int = _setting(3, unit="lights", low=1, effect="fewest lights of an intersection")
    max_lights: int = _setting(8, unit="lights", low=1, high=24, effect="most lights of an intersection")
    lights_per_approach: float = _setting(
        1.8, unit="lights", low=1.0, high=8.0, effect="mean number of lights that face the same approach"
    )
    pair_share: float = _setting(
        0.25,
        unit="1",
        high=1.0,
        effect="share of poles and mast arms that carry two lights, 0.5 to 0.9 m apart",
    )
    light_width_m: float = _setting(0.35, unit="m", open_low=True, effect="width of a light")
    light_height_m: float = _setting(1.0, unit="m", open_low=True, effect="height of a light")
    has_lights: int = _setting(
        1, unit="0 or 1", high=1, effect="0 builds a city without lights, in which no car waits and all images are kept"
    )

    # What stands in rows along the streets.
    sign_row_spacing_m: float = _setting(
        0.0, unit="m", effect="distance along the right side of a street between two rows of signs; 0 for none"
    )
    sign_apart_m: float = _setting(
        0.9, unit="m", open_low=True, effect="distance between the middles of two signs side by side"
    )
    min_row_signs: int = _setting(2, unit="signs", low=1, effect="fewest signs of a row")
    max_row_signs: int = _setting(6, unit="signs", low=1, high=12, effect="most signs of a row")
    lamp_spacing_m: float = _setting(
        0.0, unit="m", effect="distance between two street lamps on each side of a street; 0 for none"
    )
    tree_spacing_m: float = _setting(
        0.0, unit="m", effect="distance between two trees on each side of a street; 0 for none"
    )
    post_spacing_m: float = _setting(
        0.0, unit="m", effect="distance between two posts on each side of a street; 0 for none"
    )
    size_spread: float = _setting(
        0.0, unit="1", high=1.0, effect="standard deviation of the logarithm of the size of objects of one class"
    )
    side_offset_m: float = _setting(
        0.0,
        unit="m",
        high=2.0,
        effect="deviation of the middle of an object's box from its centre, another way from each side",
    )

    # The drives.
    passes_per_street: int = _setting(
        2,
        unit="passes",
        effect="every street is driven this often in each direction, before any drives at random",
    )
    images: int = _setting(
        0,
        unit="images",
        effect="exact number of images: drives at random follow until it is reached; 0 for no such drives",
    )
    pass_length_m: float = _setting(
        3000.0,
        unit="m",
        low=200.0,
        effect="length of a pass; errors of the pose and of the car are of one pass",
    )
    laps: int = _setting(
        1,
        unit="laps",
        low=1,
        effect="a pass drives its tour of the streets this often in turn; more than 1 cuts no tours into passes",
    )
    turn_share: float = _setting(
        0.35,
        unit="1",
        high=1.0,
        effect="share of intersections at which a drive at random turns (half left, half right)",
    )
    main_street_pull: float = _setting(
        0.0,
        unit="1",
        high=3.0,
        effect="how much some streets are preferred: by drives at random, and by the lights of an intersection",
    )
    red_light_share: float = _setting(
        0.35, unit="1", high=1.0, effect="share of approaches at which the car has to wait"
    )
    red_light_s: float = _setting(20.0, unit="s", effect="mean time it waits; waits are 0.5 to 1.5 times that")
    speed_mps: float = _setting(
        8.0, unit="m/s", open_low=True, effect="speed while moving; only timestamps depend on it"
    )
    frame_spacing_m: float = _setting(
        2.0,
        unit="m",
        low=0.1,
        high=20.0,
        effect="distance between two images of a moving car; smaller takes more images",
    )
    standing_interval_s: float = _setting(
        0.5,
        unit="s",
        low=0.02,
        effect="time between two images of a standing car; smaller takes more alike images",
    )
    keep_before_signal_m: float = _setting(
        100.0,
        unit="m",
        low=20.0,
        effect="images farther than this along the street from the next lights ahead are dropped; "
        "larger keeps more images without a detection",
    )
    detections: int = _setting(
        0,
        unit="detections",
        effect="aimed number of detections, met by taking keep_before_signal_m between 0.7 and 1.5 times "
        "its value; 0 takes it as it is",
    )

    # The camera.
    image_width_px: int = _setting(640, unit="px", low=16, effect="width of the pictures")
    image_height_px: int = _setting(480, unit="px", low=16, effect="height of the pictures")
    focal_px: float = _setting(
        500.0, unit="px", open_low=True, effect="focal length; larger sees farther and less wide"
    )
    camera_height_m: float = _setting(1.6, unit="m", effect="height of the camera above the street")
    camera_pitch_deg: float = _setting(
        3.0, unit="deg", low=-30.0, high=30.0, effect="how far the camera looks up from the street"
    )

    cameras: int = _setting(
        1, unit="cameras", low=1, high=8, effect="cameras of each car, each with a camera_id of its own"
    )
    camera_spread_deg: float = _setting(
        60.0, unit="deg", high=180.0, effect="angle between the directions in which two neighbouring cameras look"
    )

    # What can be seen.
    max_sight_m: float = _setting(
        120.0, unit="m", open_low=True, effect="a light farther than this (on the ground) is not seen"
    )
    min_box_height_px: float = _setting(5.0, unit="px", effect="a light lower than this in the picture is not seen")
    max_facing_deg: float = _setting(
        65.0,
        unit="deg",
        high=90.0,
        effect="a light that faces away from the camera by more than this is not seen",
    )
    occluded_share: float = _setting(
        0.05,
        unit="1",
        high=0.9,
        effect="share of views of a light that traffic hides, in runs of successive images",
    )
    occlusion_s: float = _setting(4.0, unit="s", effect="mean time after which traffic hides a light or not anew")
    min_visible_share: float = _setting(
        1.0,
        unit="1",
        open_low=True,
        high=1.0,
        effect="what the picture's edge cuts is seen if this share of its box is left, and has a box of the rest",
    )
    partly_hidden_share: float = _setting(
        0.0,
        unit="1",
        high=0.9,
        effect="share of views of an object that is hidden in part, in runs: its box is that of the rest",
    )

    # The detector.
    recall_mean: float = _setting(
        0.85,
        unit="1",
        open_low=True,
        high=1.0,
        effect="detection rate: share of the lights in view that are detected, mean of the passes",
    )
    recall_sd: float = _setting(
        0.06,
        unit="1",
        high=0.45,
        effect="standard deviation of that share between passes (weather, time of day)",
    )
    half_recall_height_px: float = _setting(
        3.0,
        unit="px",
        effect="box height at which the detection rate is half; at twice the height 94 % of it; 0 switches off",
    )
    pixel_noise_px: float = _setting(1.2, unit="px", effect="standard deviation of a small box's centre, each axis")
    pixel_noise_share: float = _setting(
        0.06,
        unit="1",
        high=0.5,
        effect="part of that standard deviation that grows with the box, as share of its height",
    )
    tail_share: float = _setting(
        0.0, unit="1", high=1.0, effect="share of boxes whose centre is far more wrong than that"
    )
    tail_factor: float = _setting(
        5.0, unit="1", low=1.0, effect="how many times the standard deviation of such boxes is that of others"
    )
    size_noise: float = _setting(
        0.15, unit="1", high=1.0, effect="standard deviation of the logarithm of a box's width and height"
    )
    score_true: float = _setting(0.75, unit="1", high=1.0, effect="mean score of a light in a large box")
    score_false: float = _setting(0.5, unit="1", high=1.0, effect="mean score of false boxes and of tiny ones")
    score_noise: float = _setting(0.12, unit="1", high=1.0, effect="standard deviation of scores (cut to 0 and 1)")
    double_share: float = _setting(0.0, unit="1", high=1.0, effect="share of boxes that the detector reports twice")
    double_apart_px: float = _setting(1.5, unit="px", effect="distance between the centres of two such boxes")
    class_confusion: float = _setting(
        0.0,
        unit="1",
        high=0.9,
        effect="share of boxes of objects that get another class of those that stand in the city",
    )

    # Detections of other things.
    clutter_per_image: float = _setting(
        0.05, unit="boxes", effect="mean number of random false boxes an image, each in one image only"
    )
    reflections_per_1000_images: float = _setting(
        0.6,
        unit="1",
        effect="false objects fixed to the car, at one place of the picture for a stretch of a pass",
    )
    reflection_images: float = _setting(
        25.0, unit="images", low=1.0, effect="mean number of images in which such a reflection stays"
    )
    temporary_per_1000_images: float = _setting(
        0.1, unit="1", effect="false objects in the world that only one pass meets, such as a van's lamp"
    )
    temporary_recall: float = _setting(
        0.6,
        unit="1",
        high=1.0,
        effect="how often a temporary object is detected, as share of the detection rate of lights",
    )
    lookalikes_per_light: float = _setting(
        0.02,
        unit="1",
        effect="false objects that stay, look like lights and are met by every pass; 0 for none",
    )
    lookalike_recall: float = _setting(
        0.4, unit="1", high=1.0, effect="how often a lookalike is detected, as share of the detection rate of lights"
    )

    # The errors of the poses.
    position_white_m: float = _setting(
        0.072,
        unit="m",
        effect="standard deviation of a camera position, each axis: part of each image of its own",
    )
    position_drift_m: float = _setting(
        0.096,
        unit="m",
        effect="standard deviation of a camera position, each axis: part that drifts along a pass",
    )
    rotation_white_deg: float = _setting(
        0.09, unit="deg", effect="standard deviation of a rotation, each axis: part of each image of its own"
    )
    rotation_drift_deg: float = _setting(
        0.12, unit="deg", effect="standard deviation of a rotation, each axis: part that drifts along a pass"
    )
    drift_length_m: float = _setting(
        100.0, unit="m", open_low=True, effect="distance over which drifting errors forget 63 % of themselves"
    )
    position_middle_m: float = _setting(
        0.0,
        unit="m",
        effect="standard deviation of a camera position, each axis: part that drifts over middle_length_m",
    )
    rotation_middle_deg: float = _setting(
        0.0, unit="deg", effect="standard deviation of a rotation, each axis: part that drifts over middle_length_m"
    )
    middle_length_m: float = _setting(
        15.0, unit="m", open_low=True, effect="distance over which those errors forget 63 % of themselves"
    )
    pass_shift_m: float = _setting(
        0.0, unit="m", effect="each pass is shifted by this much on the ground, in a direction of its own"
    )
    pass_yaw_deg: float = _setting(
        0.0, unit="deg", effect="each pass is turned by this much, left or right, as by a camera mounted askew"
    )
    jump_m: float = _setting(
        0.0, unit="m", effect="poses jump by this much on the ground, and back again later, jumps_per_km times"
    )
    jumps_per_km: float = _setting(5.0, unit="1", effect="how often they jump or jump back, in each km of a pass")
    pose_delay_s: float = _setting(
        0.0, unit="s", high=10.0, effect="the recorded pose is that of so much time before the image was taken"
    )
    focal_error_share: float = _setting(
        0.0, unit="1", low=-0.5, high=0.5, effect="the recorded focal length is too long by this share of itself"
    )

    # What is recorded.
    write_pose_sigmas: int = _setting(
        0, unit="0 or 1", high=1, effect="1 writes the standard deviations of the poses into images.parquet"
    )
    write_timestamps: int = _setting(1, unit="0 or 1", high=1, effect="0 leaves the time out of images.parquet")
    write_rigs: int = _setting(
        0, unit="0 or 1", high=1, effect="1 writes into images.parquet which images a car took at one time (rig_id)"
    )
    camera_folders: int = _setting(
        0,
        unit="0, 1 or 2",
        high=2,
        effect="names with several cameras: 0 is PASS/CAMERA/NUMBER.jpg, 1 CAMERA/PASS/NUMBER.jpg, 2 PASS-CAMERA/...",
    )
    pass_per_camera: int = _setting(
        0, unit="0 or 1", high=1, effect="1 gives the images of each camera a pass_id of their own"
    )
    shuffle_ids: int = _setting(
        0, unit="0 or 1", high=1, effect="1 numbers images and detections at random, not in the order of time"
    )
    shuffle_names: int = _setting(
        0, unit="0 or 1", high=1, effect="1 numbers the files of images at random, not in the order of time"
    )

    def __post_init__(self) -> None:
        for setting in fields(self):
            _check_range(setting, getattr(self, setting.name))
        if self.images == 0 and self.passes_per_street == 0:
            raise SettingError(
                "images and passes_per_street are both 0, so nobody drives",
                hint="--set passes_per_street=2 drives every street; --set images=1000 drives at random",
            )
        if self.min_lights > self.max_lights:
            raise SettingError(
                f"min_lights ({self.min_lights}) must be at most max_lights ({self.max_lights})",
                hint="set both, e.g. --set min_lights=3 --set max_lights=8",
            )
        if self.min_row_signs > self.max_row_signs:
            raise SettingError(
                f"min_row_signs ({self.min_row_signs}) must be at most max_row_signs ({self.max_row_signs})",
                hint="set both, e.g. --set min_row_signs=2 --set max_row_signs=6",
            )
        rows = (self.sign_row_spacing_m, self.lamp_spacing_m, self.tree_spacing_m, self.post_spacing_m)
        if self.class_confusion and sum(spacing > 0.0 for spacing in (self.has_lights, *rows)) < 2:
            raise SettingError(
                f"class_confusion ({self.class_confusion}): only one class stands in the city",
                hint="--set sign_row_spacing_m=50 puts signs along the streets as well",
            )
        if not self.has_lights and not any(rows):
            raise SettingError(
                "has_lights and all spacings of signs, lamps, trees and posts are 0, so nothing stands in the city",
                hint="--set post_spacing_m=10 puts posts along the streets",
            )
        if self.recall_sd > 0.0 and self.recall_sd**2 >= self.recall_mean * (1.0 - self.recall_mean):
            raise SettingError(
                f"recall_sd ({self.recall_sd}) is too large for recall_mean ({self.recall_mean})",
                hint="a share between 0 and 1 cannot vary so much: take a smaller recall_sd, or 0",
            )

    def check_drawable(self) -> None:
        """Raise `SettingError` where pictures could not show what is simulated."""
        rows = ("sign_row_spacing_m", "lamp_spacing_m", "tree_spacing_m", "post_spacing_m")
        for name in (*rows, "side_offset_m", "partly_hidden_share", "cameras"):
            default = getattr(SimulationConfig, name)
            if getattr(self, name) != default:
                raise SettingError(
                    f"{name} ({getattr(self, name)}): pictures are drawn by one camera of whole, flat lights only",
                    hint=f"leave --images away, or --set {name}={default}",
                )

    def with_settings(self, assignments: Iterable[str]) -> Self:
        """Return a copy with `name=value` assignments applied; raises as `MapConfig.with_settings`."""
        changed: Self = _assign({"simulation": self}, assignments)["simulation"]
        return changed


MAX_CANVAS_PX = 2**26
"""What goes through a network at once: its layers take hundreds of bytes a pixel."""

ModelKind = Literal["segmentation", "yolox", "ultralytics", "detr", "boxes"]
Provider = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class DetectConfig:
    """How pictures are put through a detector, and which of its boxes count."""

    kind: ModelKind | None = None
    """What the outputs of the model mean; None finds out."""
    classes: str = ""
    """Names or numbers of the wanted classes, each perhaps =NEW_NAME, with commas between; none is all."""
    size: str = "model"
    """What the network sees: "model" is its own size, else the picture's; "picture"; N or WIDTHxHEIGHT in px."""
    provider: Provider = "cpu"
    min_score: float | None = None
    """A box with a lower score is dropped; None takes the model's own, or `default_min_score`."""
    default_min_score: float = _setting(
        0.3, unit="1", high=1.0, effect="a box with a lower score is dropped, if --min-score does not say otherwise"
    )
    max_iou: float = _setting(
        0.5, unit="1", high=1.0, effect="of two boxes of one class that overlap more than this, the lesser is dropped"
    )
    tile_px: int = _setting(
        0,
        unit="px",
        effect="larger pictures are cut into overlapping tiles of this size, to find smaller things; 0 cuts nothing",
    )
    tile_overlap_px: int = _setting(
        96,
        unit="px",
        effect="least overlap of two tiles: things larger than this may be seen only in parts, then joined",
    )
    batch: int = _setting(
        1, unit="pictures", low=1, high=1024, effect="pictures of one size that go through the network together"
    )
    decoders: int = _setting(
        0, unit="threads", high=256, effect="threads that decode pictures ahead of the network; 0 for one a core"
    )
    panorama_view_deg: float = _setting(
        90.0,
        unit="deg",
        low=30.0,
        high=120.0,
        effect="field of view of the perspective views, all the way round, that a panorama is cut into",
    )
    panorama_overlap_deg: float = _setting(
        20.0, unit="deg", high=25.0, effect="least overlap of two neighbouring views of a panorama"
    )
    panorama_pitch_deg: float = _setting(
        10.0, unit="deg", low=-60.0, high=60.0, effect="how far the views of a panorama look up"
    )

    def __post_init__(self) -> None:
        for name, allowed in (("kind", (None, *get_args(ModelKind))), ("provider", get_args(Provider))):
            if getattr(self, name) not in allowed:
                raise SettingError(
                    f"--{name}: expected one of {', '.join(filter(None, allowed))}, found {getattr(self, name)!r}",
                    hint="leave it away for the default",
                )
        for setting in fields(self):
            if setting.metadata:
                _check_range(setting, getattr(self, setting.name))
        if self.min_score is not None and not 0.0 <= self.min_score <= 1.0:
            raise SettingError(f"--min-score: expected 0 to 1, found {self.min_score}", hint="for example 0.3")
        if self.tile_px and self.tile_overlap_px >= self.tile_px / 2:
            raise SettingError(
                f"--tile {self.tile_px}: expected more than twice tile_overlap_px ({self.tile_overlap_px})",
                hint="take larger tiles, or --set tile_overlap_px=32",
            )
        _ = self.size_px

    @property
    def size_px(self) -> tuple[int, int] | None:
        """The width and height that the user asked for; None for the model's or the picture's own."""
        if self.size in ("model", "picture"):
            return None
        sides = self.size.lower().split("x")
        if len(sides) > 2 or not all(side.isdecimal() and 0 < int(side) < 2**15 for side in sides):
            raise SettingError(
                f"--size: expected N or WIDTHxHEIGHT in px, or picture, found {self.size!r}",
                hint="for example --size 1024x448",
            )
        width, height = int(sides[0]), int(sides[-1])
        if width * height * self.batch > MAX_CANVAS_PX:
            raise SettingError(
                f"--size {self.size}: {width} x {height} px in batches of {self.batch} do not fit into memory",
                hint=f"take at most {MAX_CANVAS_PX // 10**6} million pixels at once, and --tile for small things",
            )
        return width, height

    def with_settings(self, assignments: Iterable[str]) -> Self:
        """Return a copy with `name=value` assignments applied; raises as `MapConfig.with_settings`."""
        changed: Self = _assign({"detect": self}, assignments)["detect"]
        return changed
