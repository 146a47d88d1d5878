"""Faults of cameras: how they hang, their focal lengths, where they are on the car, their clock."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from valuemap.check.clocks import find_clock
from valuemap.check.corrections import best_correction
from valuemap.check.fault import (
    Fault,
    Finding,
    Stage,
    View,
)
from valuemap.check.groups import Group
from valuemap.check.pass_offsets import OF_ITS_CAMERA, find_height_of_pass


class _CommonError(Fault):
    """Something small that all images share."""

    stage: ClassVar[Stage] = "fine"
    parameters: ClassVar[tuple[str, ...]]
    do: ClassVar[str]

    def find(self, view: View) -> Finding | None:
        """Take the correction that lets rays agree best, if it is one of these parameters."""
        best = best_correction(view)
        if best is None or best.parameter.name not in self.parameters:
            return None
        name, value, found = best.parameter.name, best.value, best.estimate
        return Finding(
            fault=self.name,
            what=self.says(view, name, value)
            if best.group is None
            else _only(best.group, self.says(view, name, value)),
            why=f"{self.shows(value, best.sigma)} over {found.places} places and {found.points} objects; "
            f"corrected, the agreement of rays rises by {best.comparison.difference:.0f} "
            f"({best.comparison.places} places).",
            do=self.do,
            chance=best.chance,
            figures={
                "estimates": found.to_json(),
                "parameter": name,
                **({} if best.group is None else {"of": best.group.text}),
                **best.comparison.to_json(),
            },
            fix=best,
            of=None if best.group is None else best.group.text,
        )

    @abstractmethod
    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""

    def shows(self, value: float, sigma: float) -> str:
        """Return the estimate in the unit that people use."""
        return f"The estimate is {np.degrees(value):.2f} ± {np.degrees(sigma):.2f} degrees"


class CameraTilt(_CommonError):
    """Cameras that look higher or lower, or hang more to a side, than their poses say."""

    name: ClassVar[str] = "camera_tilt"
    parameters: ClassVar[tuple[str, ...]] = ("pitch", "roll")
    # The noise of pitch and roll hides how cameras are mounted.
    completes: ClassVar[frozenset[str]] = frozenset(
        {"camera_tilt", "camera_mount", "pitch_and_roll", "inverted_mounts"}
    )
    do: ClassVar[str] = "Correct the rotation between car and camera, or the principal point's y."

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        if name == "pitch":
            way = "lower" if value > 0 else "higher"
            return f"The cameras look {abs(np.degrees(value)):.2f} degrees {way} than their poses say."
        return f"The cameras are rolled by {abs(np.degrees(value)):.2f} degrees against their poses."


class CameraYaw(_CommonError):
    """Cameras that look more to a side than their poses say."""

    name: ClassVar[str] = "camera_yaw"
    parameters: ClassVar[tuple[str, ...]] = ("yaw",)
    completes: ClassVar[frozenset[str]] = frozenset({"camera_yaw", "camera_mount", "inverted_mounts"})
    do: ClassVar[str] = "Correct the rotation between car and camera, or the principal point's x."

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        side = "right" if value < 0 else "left"
        return f"The cameras look {abs(np.degrees(value)):.2f} degrees more to the {side} than their poses say."


class FocalLength(_CommonError):
    """A focal length that is wrong."""

    name: ClassVar[str] = "focal_length"
    parameters: ClassVar[tuple[str, ...]] = ("log_focal",)
    completes: ClassVar[frozenset[str]] = frozenset({"focal_length"})
    do: ClassVar[str] = "Calibrate the cameras, or scale their focal lengths: of which picture size are they?"

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        return f"The focal lengths are too {'short' if value > 0 else 'long'}: {np.exp(value):.3f} times them is right."

    def shows(self, value: float, sigma: float) -> str:
        """Return the factor."""
        return f"The factor is {np.exp(value):.3f} ± {sigma:.3f}"


class CameraHeight(_CommonError):
    """Cameras of a pass, or one of several on a car, that are at another height than their poses say."""

    name: ClassVar[str] = "camera_height"
    rivals: ClassVar[frozenset[str]] = OF_ITS_CAMERA
    may_be_reading: ClassVar[bool] = True
    parameters: ClassVar[tuple[str, ...]] = ("up",)
    completes: ClassVar[frozenset[str]] = frozenset({"camera_height"})
    do: ClassVar[str] = "Correct the position of the camera on the car."

    def find(self, view: View) -> Finding | None:
        """Take the offset of the pass that is farthest from good, if it is up or down; else that of a camera."""
        return find_height_of_pass(view, self.name) or super().find(view)

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        return f"The cameras are {abs(value):.2f} m too {'low' if value > 0 else 'high'}."

    def shows(self, value: float, sigma: float) -> str:
        """Return metres."""
        return f"The estimate is {value:.2f} ± {sigma:.2f} m"


class CameraAside(_CommonError):
    """Cameras that are farther to a side of the car than their poses say."""

    name: ClassVar[str] = "camera_aside"
    parameters: ClassVar[tuple[str, ...]] = ("aside",)
    completes: ClassVar[frozenset[str]] = frozenset({"camera_aside"})
    do: ClassVar[str] = (
        "Correct the way from the point that the poses are of (antenna, axle) to the camera: is its sign, right or "
        "left, the one that is meant?"
    )

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        side = "right" if value > 0 else "left"
        return f"The cameras are {abs(value):.2f} m farther to the {side} of their way than their poses say."

    def shows(self, value: float, sigma: float) -> str:
        """Return metres."""
        return f"The estimate is {value:.2f} ± {sigma:.2f} m"


class TimeShift(_CommonError):
    """Poses that are some time off all pictures."""

    name: ClassVar[str] = "time_shift"
    parameters: ClassVar[tuple[str, ...]] = ("along",)
    completes: ClassVar[frozenset[str]] = frozenset({"time_shift"})
    do: ClassVar[str] = (
        "Correct the clock between cameras and poses (trigger, exposure or network delay). If it is a whole number of "
        "images: are detections listed with the images before or after theirs?"
    )

    def find(self, view: View) -> Finding | None:
        """Take a small shift, else one of seconds."""
        found = super().find(view)
        return found if found is not None or best_correction(view) is not None else find_clock(view)

    def says(self, view: View, name: str, value: float) -> str:
        """Return what is wrong."""
        side = "behind" if value > 0 else "ahead of"
        images = abs(value) / view.step_m
        return f"The poses are {abs(value):.2f} m along the road ({images:.1f} images) {side} their pictures."

    def shows(self, value: float, sigma: float) -> str:
        """Return metres."""
        return f"The shift is {value:.2f} ± {sigma:.2f} m"


def _only(group: Group, what: str) -> str:
    return f"Only {group.text}: {what[0].lower()}{what[1:]}"
