"""What all images, or those of one camera, may share of an error, and its estimate from rays."""

from __future__ import annotations

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.along_drives import moved_along
from valuemap.check.fault import (
    WIDER_GATE,
    View,
    once_a_view,
    with_centers,
    with_images,
)
from valuemap.check.fit import ROUNDS, MotionByParameter, Parameter, ParameterEstimate, estimate
from valuemap.check.headings import ways_of_car
from valuemap.check.lenses import Focal, focals
from valuemap.dataset import Dataset


class _TurnAboutAxis:
    """Cameras turned about one of their own axes."""

    def __init__(self, axis: int) -> None:
        self._axis = axis

    def change(self, dataset: Dataset, angle_rad: float) -> Dataset:
        """Return a dataset whose cameras are turned by an angle, in their places."""
        turn = Rotation.from_rotvec(angle_rad * np.eye(3)[self._axis])
        turned = turn * Rotation.from_quat(dataset.images.cam_from_world_quat, scalar_first=True)
        return with_images(
            dataset,
            cam_from_world_quat=turned.as_quat(scalar_first=True),
            cam_from_world_m=dataset.images.cam_from_world_m @ turn.as_matrix().T,
        )

    def motion(self, dataset: Dataset) -> MotionByParameter:
        """Return the axis in the world, about which no centre moves."""
        axis = rotation_matrices(dataset.images)[:, self._axis]
        return MotionByParameter(axis, np.zeros_like(axis))


def with_focal(dataset: Dataset, log_factor: float) -> Dataset:
    """Return a dataset with all focal lengths multiplied by exp(log_factor)."""
    return Focal(np.full(len(dataset.cameras), np.exp(log_factor)))(dataset)


def _shift_along(dataset: Dataset, forward_m: float) -> Dataset:
    return with_centers(dataset, moved_along(dataset, forward_m))


_STEP_ALONG_M = 1e-3


def _motion_along(dataset: Dataset) -> MotionByParameter:
    ahead, behind = (moved_along(dataset, way * _STEP_ALONG_M) for way in (1.0, -1.0))
    return MotionByParameter(np.zeros_like(ahead), (ahead - behind) / (2.0 * _STEP_ALONG_M))


PARAMETERS = (
    *(
        Parameter(name, _TurnAboutAxis(axis).change, _TurnAboutAxis(axis).motion)
        for axis, name in enumerate(("pitch", "yaw", "roll"))
    ),
    Parameter("log_focal", with_focal),
    Parameter("along", _shift_along, _motion_along, is_length=True, of_drives=True),
)


def _shift_aside(dataset: Dataset, right_m: float) -> Dataset:
    return with_centers(dataset, camera_centers(dataset.images) + right_m * ways_of_car(dataset)[1])


def _motion_aside(dataset: Dataset) -> MotionByParameter:
    right = ways_of_car(dataset)[1]
    return MotionByParameter(np.zeros_like(right), right)


ASIDE = Parameter("aside", _shift_aside, _motion_aside, is_length=True, of_drives=True)
"""Where the camera is on the car, to a side: told only where objects are passed in both directions, or in bends. So it
is not among what is estimated always: where it cannot be told, the other estimates would be worse beside it."""


def _raised(dataset: Dataset, up_m: float) -> Dataset:
    return with_centers(dataset, camera_centers(dataset.images) + up_m * np.array(dataset.frame.up))


def _motion_up(dataset: Dataset) -> MotionByParameter:
    up = np.tile(dataset.frame.up, (len(dataset.images), 1))
    return MotionByParameter(np.zeros_like(up), up)


_ALONG = next(each for each in PARAMETERS if each.name == "along")

OF_ONE_CAMERA = (*PARAMETERS[:3], Parameter("up", _raised, _motion_up, is_length=True), _ALONG)
"""How one camera of several hangs, and when it exposes: its own rays do not know how high, nor on a straight road how
late, but those of the others do."""


def estimate_of(
    view: View, parameters: tuple[Parameter, ...], *, start: ParameterEstimate | None = None, rounds: int = ROUNDS
) -> ParameterEstimate | None:
    """Return the estimate of parameters at the many places of a view."""
    given = view.agreement_at_many_places
    return estimate(view.dataset, view.many_places, view.gate_px, parameters, start=start, rounds=rounds, given=given)


@once_a_view
def common_errors(view: View, parameters: tuple[Parameter, ...]) -> ParameterEstimate | None:
    """Return the estimate of what all images may share."""
    return estimate_of(view, parameters)


@once_a_view
def settled_errors(view: View, parameters: tuple[Parameter, ...]) -> ParameterEstimate:
    """Return the same followed to its end: of an error that is there, its full size."""
    start = common_errors(view, parameters)
    assert start is not None
    settled = estimate_of(view, parameters, start=start)
    assert settled is not None
    return settled


def parameters_of(view: View) -> tuple[Parameter, ...]:
    """Return what all images may share: without focal lengths where a camera has none."""
    cameras = view.dataset.cameras
    has_focal = all(focals(cameras, row) for row in range(len(cameras)))
    return PARAMETERS if has_focal else tuple(p for p in PARAMETERS if p.name != "log_focal")


@once_a_view
def at_wider_gate(view: View) -> View:
    """Return a view of the same dataset at which rays of cameras that are a few gates off vote, too."""
    return View(view.dataset, gate_share=view.gate_share * WIDER_GATE, known=view.known)


def chance_of(found: ParameterEstimate, name: str, groups: int) -> float:
    """Return how likely one of all parameters of all groups is as far from nothing."""
    value, sigma = found.of(name)
    freedom = max(found.places - len(found.names), 1)
    return 2.0 * float(stats.t.sf(abs(value) / sigma, freedom)) * len(found.names) * groups
