"""What a fault is: one small class that looks at a dataset and says what it found, with a fix where there is one."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, wraps
from typing import Any, ClassVar, Concatenate, Literal, ParamSpec, TypeVar

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.agreement import Agreement, agreement_on, chance_agreement
from valuemap.check.sample import (
    MOST_DETECTIONS,
    Sample,
    median_step_m,
    pixels_per_radian,
    sample_places,
    sample_stretches,
)
from valuemap.dataset import Dataset
from valuemap.tables import Images

Fix = Callable[[Dataset], Dataset]
Stage = Literal["tables", "conventions", "positions", "fine", "results"]
STAGES: tuple[Stage, ...] = ("tables", "conventions", "positions", "fine", "results")
"""In this order: what is found and can be put right is put right before the next stage looks."""

GATE_RAD = 0.012
"""Rays that pass closer than this agree: 0.7 degrees, 6 px at a focal length of 500 px."""
WIDER_GATE = 4.0
"""Detections of heat maps or panoramas with compass headings may be off by degrees."""
SMALL_TURNS_RAD = np.radians(np.arange(2.0, 17.0, 2.0))
"""At most a degree from any turn that a mount may be off by, that magnetic north has from north where most streets are,
or that pictures seem to be turned by which were cropped at one side."""
MANY_DETECTIONS = 8000
LEAST_RISE = 0.02
"""Passes have errors of their own, which few passes do not average out: what costs less than one part in fifty of the
agreement is within them, and changes no map."""
LEAST_CHANCE = 1e-3
"""A finding that good data would give with a probability above this, all that was tried counted, is none."""
FAR_WORSE = 0.5
"""What agrees less than half as well as others do, or as it would if it were read otherwise, has more than errors."""
NEAR_STEPS = 2.0
"""Rays of one drive leave open how far an object is, by some of the steps between images."""
TIE = 1e-3
"""Gains as close as this share are the same: readings that differ in the last digits only."""
WHICH_PASS = "which_pass"
"""Known as a fault is, where two passes are apart and nothing tells which is off: truth may be with either."""
AGAINST = 0.05
"""What is told from something else than how well rays agree, that must bear out beyond this chance: rays agree better
with a correction than without, and than with its opposite."""


@dataclass(frozen=True, eq=False)
class Finding:
    """One thing that is wrong.

    `what` is wrong, in one sentence; `why` one knows it, with the figures; what to `do` about it. `chance` is the
    probability that good data look like this by accident, None where values cannot be right whatever the chance.
    `fix` makes the corrected dataset; it is None where none is known.
    """

    fault: str
    what: str
    why: str
    do: str
    chance: float | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)
    fix: Fix | None = None
    of: str | None = None
    """What alone is wrong (a camera, a pass); None where all that is looked at may be."""
    trial: Fix | None = None
    """What makes rays agree where it is not known which of two is wrong: the look goes on so; it is never written."""

    @property
    def mends(self) -> Fix | None:
        """What lets the look go on beyond it: the fix, or what makes rays agree as well."""
        return self.fix or self.trial

    @property
    def sure(self) -> str:
        """How sure, in words."""
        if self.chance is None:
            return "certain"
        return "almost certain" if self.chance < 1e-6 else "very likely"

    def to_json(self) -> dict[str, Any]:
        """Return the finding by name."""
        return {
            "fault": self.fault,
            "what": self.what,
            "why": self.why,
            "do": self.do,
            "sure": self.sure,
            "chance": None if self.chance is None else float(f"{self.chance:.2g}"),
            "figures": dict(self.figures),
            "has_fix": self.fix is not None,
        }


class InTurn:
    """Several fixes, one after the other."""

    def __init__(self, *fixes: Fix) -> None:
        self._fixes = fixes

    def __call__(self, dataset: Dataset) -> Dataset:
        """Return the dataset with all of them made."""
        for fix in self._fixes:
            dataset = fix(dataset)
        return dataset


class View:
    """A dataset as faults look at it; what several of them need is worked out once."""

    def __init__(
        self,
        dataset: Dataset,
        *,
        gate_share: float = 1.0,
        known: frozenset[str] = frozenset(),
        meets: bool = True,
        rivals: tuple[str, ...] = (),
        drives: Images | None = None,
    ) -> None:
        self.dataset = dataset
        self.drives = dataset.images if drives is None else drives
        """Images of whole passes: all that there are, or some, if any, where the dataset is a part of another."""
        self.meets = meets
        """Whether rays can be told to meet better than by chance: else points where they meet are no objects."""
        self.rivals = rivals
        """Other readings under which the cameras would stand upright, and that rays cannot exclude."""
        self.known = known
        """Names of what was found before and put right."""
        self.gate_share = gate_share
        self.memory: dict[Any, Any] = {}
        """What is worked out `once_a_view`, as several faults of one family share it."""

    def again(self, *, known: frozenset[str], meets: bool, rivals: tuple[str, ...]) -> View:
        """Return a view of the same dataset of which other things are known; what was worked out stays."""
        view = copy.copy(self)
        view.known, view.meets, view.rivals = known, meets, rivals
        view.memory = self.memory if meets == self.meets else {}
        return view

    @cached_property
    def gate_px(self) -> float:
        """How close rays must pass to agree, at the images' own resolution."""
        return GATE_RAD * self.gate_share * pixels_per_radian(self.dataset)

    @cached_property
    def stretches(self) -> Sample:
        """Stretches of single passes."""
        return sample_stretches(self.dataset)

    @cached_property
    def places(self) -> Sample:
        """Places with all their passes."""
        return sample_places(self.dataset)

    @cached_property
    def places_of_passes(self) -> Sample:
        """Places with all their passes, densely enough that each pass can be looked at alone."""
        return sample_places(self.dataset, most_detections=4 * MOST_DETECTIONS, thins=False)

    @cached_property
    def many_places(self) -> Sample:
        """More places, for what is too small to show at few."""
        return sample_places(self.dataset, most_detections=MANY_DETECTIONS)

    @cached_property
    def agreement(self) -> Agreement:
        """How well the rays of the stretches agree."""
        return agreement_on(self.stretches, self.stretches.dataset, self.gate_px)

    @cached_property
    def agreement_at_many_places(self) -> Agreement:
        """How well the rays of the many places agree."""
        return agreement_on(self.many_places, self.many_places.dataset, self.gate_px)

    @cached_property
    def agreement_at_places(self) -> Agreement:
        """How well the rays of several passes agree."""
        return agreement_on(self.places, self.places.dataset, self.gate_px)

    @cached_property
    def chance(self) -> Agreement:
        """How well they agree by chance."""
        return chance_agreement(self.stretches.dataset, self.stretches.place_of_image, self.gate_px)

    @cached_property
    def step_m(self) -> float:
        """The median distance between successive images."""
        return median_step_m(self.dataset.images)

    @cached_property
    def seen_m(self) -> float:
        """How far poses must be off to be seen at all: the gate of rays at the usual distance of what they show."""
        if not len(self.dataset.detections) or not len(self.agreement.found):
            return 0.0
        found, rays = self.agreement.found, self.agreement.rays
        point = np.repeat(found.position_in_world_m, np.diff(found.voter_offsets), axis=0)
        ray_m = point - rays.center_in_world_m[found.voters.astype(np.int64)]
        return GATE_RAD * self.gate_share * float(np.median(np.linalg.norm(ray_m, axis=1)))

    @cached_property
    def center_in_world_m(self) -> Floats:
        """The camera centres (N, 3)."""
        return camera_centers(self.dataset.images)

    @cached_property
    def uprightness(self) -> float:
        """The mean cosine between the cameras' up and the sky."""
        return uprightness(self.dataset)


_T = TypeVar("_T")
_P = ParamSpec("_P")


def once_a_view(work_out: Callable[Concatenate[View, _P], _T]) -> Callable[Concatenate[View, _P], _T]:
    """Let a function of a view, and of what can be told apart by its hash, work out each answer once a view."""

    @wraps(work_out)
    def remembered(view: View, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        key = (work_out, args, tuple(kwargs.items()))
        if key not in view.memory:
            view.memory[key] = work_out(view, *args, **kwargs)
        answer: _T = view.memory[key]
        return answer

    return remembered


def uprightness(dataset: Dataset) -> float:
    """Return the mean cosine between the cameras' up (-y) and the frame's."""
    return float(np.mean(-rotation_matrices(dataset.images)[:, 1] @ np.array(dataset.frame.up)))


def gains_of_all(view: View, dataset: Dataset, *, is_gate_an_angle: bool = False) -> Floats:
    """Return the gains of a version of the whole dataset on what `agreements_of_all` looks at."""
    agreements = agreements_of_all(view, dataset, is_gate_an_angle=is_gate_an_angle)
    return np.concatenate([each.gain for each in agreements])


def agreements_of_all(view: View, dataset: Dataset, *, is_gate_an_angle: bool = False) -> list[Agreement]:
    """Return the agreement of a version of the whole dataset on all that a check looks at: stretches and places.

    The gate is so many pixels, as errors of boxes are; or the same angle in every version, as errors of poses are.
    """
    if dataset is view.dataset:
        return [view.agreement, view.agreement_at_many_places]
    samples = (view.stretches, view.many_places)
    scale = pixels_per_radian(dataset) / pixels_per_radian(view.dataset) if is_gate_an_angle else 1.0
    gate_px = view.gate_px * scale
    return [agreement_on(s, s.of(dataset), gate_px) for s in samples]


def fair_gains(view: View, dataset: Dataset) -> Floats:
    """Return the gains of a version that may have other focal lengths, at both gates: half of each.

    The longer focal lengths are, the more pixels an angle has: a gate in pixels favours short ones, as errors of poses
    are fewer pixels then; a gate of one angle favours long ones, whose boxes may be as many more pixels off.
    """
    gains = gains_of_all(view, dataset)
    if pixels_per_radian(dataset) == pixels_per_radian(view.dataset):
        return gains
    return np.asarray((gains + gains_of_all(view, dataset, is_gate_an_angle=True)) / 2.0)


def gains_without(view: View, opposite: Dataset) -> Floats:
    """Return the gains of all rays without a correction: as given, or with the opposite where they agree better so.

    What the opposite gives as well is none of it: poses moved along their drives are smoother than measured ones.
    """
    given, other = gains_of_all(view, view.dataset), gains_of_all(view, opposite)
    return other if other.sum() > given.sum() else given


def agreement_after(view: View, fix: Fix) -> float:
    """Return how well all rays agree once the dataset is put right so."""
    return float(fair_gains(view, fix(view.dataset)).sum())


class Fault(ABC):
    """A mistake that data may have; `name` is how reports and tests call it."""

    name: ClassVar[str]
    stage: ClassVar[Stage]
    explained_by: ClassVar[frozenset[str]] = frozenset()
    """Faults that look like this one too: where one of them was found, this one is not looked for."""
    completes: ClassVar[frozenset[str]] = frozenset()
    """Faults whose fix leaves a rest that this one measures: after them it is put right, and no finding of its own."""
    rivals: ClassVar[frozenset[str]] = frozenset()
    """Faults that move what is seen about as this one does: the one whose fix lets all rays agree best is there."""

    may_be_reading: ClassVar[bool] = False
    """Whether what all passes see may be apart because all data are read wrongly: a reading that makes all rays agree
    better than the fix is there."""
    is_of_rows: ClassVar[bool] = False
    """Whether single rows show it, so that one camera or pass may have it alone."""

    @abstractmethod
    def find(self, view: View) -> Finding | None:
        """Return what is wrong, or None."""


class Convention(ABC):
    """A mistake that has an inverse: the data are read another way, and the way that makes rays agree best is right."""

    name: ClassVar[str]
    what: ClassVar[str]
    do: ClassVar[str]
    is_guess: ClassVar[bool] = False
    """Whether readings give measured values up for guessed ones."""
    least_times: ClassVar[float | None] = None
    """How many times as well as given rays must agree, where without the noise of good data they agree better."""
    explained_by: ClassVar[frozenset[str]] = frozenset()
    """Faults whose fix leaves nothing that this one could be: where one of them was found, it is not tried."""
    kind: ClassVar[str | None] = None
    """Another convention that it has its share of the chance of an error with, as rays hardly tell them apart."""
    is_of_boxes: ClassVar[bool] = False
    """Whether it is about where boxes are in their pictures: a reading that puts any outside is none."""
    is_of_world: ClassVar[bool] = False
    """Whether it is about the world, which all cameras of a vehicle share: one camera alone has none of its own."""

    @abstractmethod
    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield (how the data would be read, the dataset read so) for everything to try."""

    def refined(self, view: View, how: str, fix: Fix) -> tuple[str, Fix]:
        """Return a reading that rays agree with, or one beside it that they agree with better still."""
        return how, fix


def with_images(dataset: Dataset, **changes: Any) -> Dataset:
    """Return a dataset with some columns of its images replaced."""
    return Dataset(**{**vars(dataset), "images": dataset.images.replace(**changes)})


def with_detections(dataset: Dataset, **changes: Any) -> Dataset:
    """Return a dataset with some columns of its detections replaced."""
    return Dataset(**{**vars(dataset), "detections": dataset.detections.replace(**changes)})


def with_poses(dataset: Dataset, rotation: Floats, center_in_world_m: Floats) -> Dataset:
    """Return a dataset with other rotations from the world to the camera (N, 3, 3) and camera centres (N, 3)."""
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    translation = -np.einsum("nij,nj->ni", rotation, center_in_world_m)
    return with_images(dataset, cam_from_world_quat=quaternion, cam_from_world_m=translation)


def with_pass_moved(dataset: Dataset, name: str, axes: Floats, offset_m: Floats) -> Dataset:
    """Return a dataset with the images of one pass moved: what is at x is at `axes` (3, 3) x + `offset_m` (3), m.

    `axes` turn, or mirror, and scale alike in all directions. Cameras are turned with them.
    """
    images = dataset.images
    mine = images.pass_id.codes == images.pass_id.code_of(name)
    center, rotation = camera_centers(images), rotation_matrices(images)
    turn = axes / np.cbrt(np.abs(np.linalg.det(axes)))
    return with_poses(
        dataset,
        np.where(mine[:, None, None], rotation @ turn.T, rotation),
        np.where(mine[:, None], center @ axes.T + offset_m, center),
    )


def with_centers(dataset: Dataset, center_in_world_m: Floats) -> Dataset:
    """Return a dataset with other camera centres (N, 3) that look as they did."""
    translation = -np.einsum("nij,nj->ni", rotation_matrices(dataset.images), center_in_world_m)
    return with_images(dataset, cam_from_world_m=translation)


def keep_rows(dataset: Dataset, *, images: Any = None, detections: Any = None) -> Dataset:
    """Return a dataset with some images (mask) and some detections (mask) only, and nothing that refers to others."""
    kept_images = dataset.images if images is None else dataset.images.take(images)
    stays = np.isin(dataset.detections.image_id, kept_images.image_id)
    if detections is not None:
        stays &= detections
    kept = dataset.detections.take(stays)
    pairs = dataset.truth_detections
    if pairs is not None:
        pairs = pairs.take(np.isin(pairs.detection_id, kept.detection_id))
    return Dataset(**{**vars(dataset), "images": kept_images, "detections": kept, "truth_detections": pairs})
