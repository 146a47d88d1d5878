"""Faults of frames: axes of the world, headings, angles in the wrong unit, latitude and longitude, scale."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.fault import Convention, Fault, Finding, Fix, Stage, View, with_centers, with_images, with_poses
from valuemap.check.headings import driving_azimuths, headings, rotations_of, turned
from valuemap.check.passes import median_speed_mps
from valuemap.check.sizes import are_outside, object_heights, plausible_heights
from valuemap.check.turns import rotations_from_degrees
from valuemap.dataset import Dataset, Frame
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.tables import Floats

_WORLD_AXES: dict[str, list[list[float]]] = {
    "north, east, down": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    "north, west, up": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "x south, y east, z up": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "west, south, up": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "y up, z back": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "y down, z forward": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "east, south, down": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}
"""Takes the world of the positions into that in which the rotations are given."""
_MIRRORED: dict[str, list[list[float]]] = {
    "x the other way": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "y the other way": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "z the other way": [[1, 0, 0], [0, 1, 0], [0, 0, -1]],
}
_LEAST_UPRIGHT = 0.5
_SIGMA_LIMIT_RAD = 0.35
"""A pose whose rotation is not known to 20 degrees is none: such a column is in degrees."""
_SPEEDS_MPS = (0.2, 70.0)
"""From pushing a cart to the fastest road."""


class WorldAxes(Convention):
    """Positions in one world, rotations in another: ENU and NED, y up and z up."""

    name: ClassVar[str] = "world_axes"
    what: ClassVar[str] = "Positions and rotations are in different worlds (ENU and NED, y up and z up)."
    do: ClassVar[str] = "Turn positions and rotations into one world: x east, y north, z up."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield rotations given in other axes than the positions."""
        for name, axes in _WORLD_AXES.items():
            yield f"rotations in {name}", _OtherWorld(np.array(axes, dtype=np.float64))


class MirroredPositions(Convention):
    """One axis of the positions goes the other way: a left-handed world."""

    name: ClassVar[str] = "mirrored_positions"
    what: ClassVar[str] = "One axis of the positions goes the other way: the world is left-handed."
    do: ClassVar[str] = "Negate that axis of the positions; the world must be right-handed."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield each axis of the positions negated."""
        for name, axes in _MIRRORED.items():
            yield name, _OtherPositions(np.array(axes, dtype=np.float64))


class LatLonSwapped(Convention):
    """Latitude where longitude is expected, or northing where easting is."""

    name: ClassVar[str] = "lat_lon_swapped"
    what: ClassVar[str] = "Latitude and longitude (or north and east) of the positions are swapped."
    do: ClassVar[str] = "Exchange the two columns and import again; headings stay as they are."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield x and y exchanged; of a geo-referenced dataset on the Earth."""
        if dataset.frame.anchor is not None and abs(dataset.frame.anchor[1]) <= 90.0:
            yield "latitude and longitude exchanged", _swap_on_the_earth
        up = int(np.argmax(np.abs(dataset.frame.up)))
        first, second = (axis for axis in range(3) if axis != up)
        swap = np.eye(3)
        swap[[first, second]] = swap[[second, first]]
        yield f"{'xyz'[first]} and {'xyz'[second]} exchanged", _OtherPositions(swap)


class HeadingConvention(Convention):
    """Compass headings and mathematical angles taken for each other."""

    name: ClassVar[str] = "heading_convention"
    what: ClassVar[str] = "Headings count from another direction, or the other way round, than they were read."
    do: ClassVar[str] = "Say what headings mean: clockwise from north (compass) or counter-clockwise from east."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield headings mirrored."""
        yield "counter-clockwise from east taken for clockwise from north", _Headings(lambda a: np.pi / 2.0 - a)
        yield "counter-clockwise taken for clockwise", _Headings(lambda a: -a)


class DegreesForRadians(Convention):
    """Angles in degrees read as radians, or the other way round."""

    name: ClassVar[str] = "degrees_for_radians"
    what: ClassVar[str] = "The angles of the poses are in the wrong unit: degrees and radians are mixed up."
    do: ClassVar[str] = "Convert the angles (180/pi) and import again."
    is_guess: ClassVar[bool] = True

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield degrees that were read as radians, and radians read as degrees, as compass or mathematical angles."""
        for name, zero in (("clockwise from north", 0.0), ("counter-clockwise from east", np.pi / 2.0)):
            yield f"degrees {name} read as radians", _DegreesReadAsRadians(zero)
            yield f"radians {name} read as degrees", _RadiansReadAsDegrees(zero)


class HeadingsUseless(Convention):
    """Headings that say less than the direction of travel."""

    name: ClassVar[str] = "headings_useless"
    what: ClassVar[str] = "The headings say nothing: cameras taken to look where they drive agree better."
    do: ClassVar[str] = "Look where the headings come from; the fix takes the direction of travel."
    is_guess: ClassVar[bool] = True

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield headings from the positions."""
        yield "headings along the drive", _heading_from_motion


class UpDirection(Fault):
    """Cameras that are upside down or on their side in their own world."""

    name: ClassVar[str] = "up_direction"
    stage: ClassVar[Stage] = "positions"

    def find(self, view: View) -> Finding | None:
        """Compare the cameras' own up with the frame's."""
        if view.uprightness > _LEAST_UPRIGHT:
            return None
        mean_up = -rotation_matrices(view.dataset.images)[:, 1].mean(axis=0)
        strength = float(np.linalg.norm(mean_up))
        if strength < _LEAST_UPRIGHT:
            return None
        own = mean_up / strength
        fix: Fix | None
        if view.rivals:  # Were it one of these, a world that is turned would have its north anywhere.
            do, fix = "See which of the readings in the notes is right, or where the sky is; rays cannot tell.", None
        elif view.dataset.frame.anchor is None:
            do, fix = "Give the direction of the sky with --up.", lambda dataset: _with_up(dataset, own)
        else:
            do, fix = "Turn the world into x east, y north, z up.", lambda dataset: _stand_up(dataset, own)
        return Finding(
            fault=self.name,
            what="The direction of the sky is not where the cameras have it.",
            why=f"The cameras' own up is {_vector(own)} on average, the frame's "
            f"{_vector(np.array(view.dataset.frame.up))}: the cosine between them is {view.uprightness:.2f}.",
            do=do,
            figures={"cosine": round(view.uprightness, 3), "own_up": [round(float(part), 3) for part in own]},
            fix=fix,
        )


class RotationSigmaUnit(Fault):
    """rotation_sigma_rad that holds degrees."""

    name: ClassVar[str] = "rotation_sigma_in_degrees"
    stage: ClassVar[Stage] = "tables"

    def find(self, view: View) -> Finding | None:
        """Look for standard deviations that leave nothing of a rotation."""
        sigma = view.dataset.images.rotation_sigma_rad
        if sigma is None or not np.any(np.isfinite(sigma)):
            return None
        median = float(np.nanmedian(sigma))
        if median <= _SIGMA_LIMIT_RAD:
            return None
        return Finding(
            fault=self.name,
            what="rotation_sigma_rad holds degrees.",
            why=f"Its median is {median:.3g}: as radians that is {math.degrees(median):.0f} degrees, which is no pose.",
            do="Convert the column to radians.",
            figures={"median": median},
            fix=lambda dataset: with_images(
                dataset, rotation_sigma_rad=np.radians(np.asarray(dataset.images.rotation_sigma_rad))
            ),
        )


class Scale(Fault):
    """A world that is not in metres."""

    name: ClassVar[str] = "scale"
    stage: ClassVar[Stage] = "results"

    def find(self, view: View) -> Finding | None:
        """Compare the size of objects and the speed of the car with what there is."""
        reasons, figures = [], {}
        factors = []
        heights = object_heights(view)
        for name, height_of_each_m in heights.items():
            height_m, objects = float(np.median(height_of_each_m)), len(height_of_each_m)
            low, high = plausible_heights(name)
            figures[f"height_m of {name}"] = round(height_m, 4)
            if are_outside(height_of_each_m, low, high):
                reasons.append(
                    f"{name} are {height_m:.3g} m high (median of {objects} places; {low:g} to {high:g} m is usual)"
                )
                factors.append(math.sqrt(low * high) / height_m)
        speed = median_speed_mps(view)
        if speed is not None:
            figures["speed_mps"] = round(speed, 4)
            low, high = _SPEEDS_MPS
            if not low <= speed <= high:
                reasons.append(f"the car drives at {speed:.3g} m/s ({low:g} to {high:g} m/s is usual)")
        if not factors:
            return None
        figures["factor"] = round(float(np.median(factors)), 3)
        return Finding(
            fault=self.name,
            what="The world is not in metres, or boxes have the wrong size.",
            why="; ".join(reasons).capitalize() + ".",
            do=f"Scale the poses (about {figures['factor']:g} times): by GPS positions or a known distance.",
            figures=figures,
        )


def _vector(parts: Floats) -> str:
    return " ".join(f"{part:.2f}" for part in parts)


def _with_up(dataset: Dataset, up: Floats) -> Dataset:
    x, y, z = (float(part) for part in up)
    return Dataset(**{**vars(dataset), "frame": Frame(up=(x, y, z))})


_ENU_BY_UP: dict[tuple[int, float], list[list[float]]] = {
    (2, -1.0): [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    (1, 1.0): [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    (1, -1.0): [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    (0, 1.0): [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
    (0, -1.0): [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}
"""Takes the world whose up is along an axis to x east, y north, z up: north, east, down; y up, as in graphics; ..."""


def _stand_up(dataset: Dataset, own_up: Floats) -> Dataset:
    """Turn the whole world of poses so that its up becomes the frame's; truth stays where it was surveyed."""
    axis = int(np.argmax(np.abs(own_up)))
    turn = np.array(_ENU_BY_UP[axis, float(np.sign(own_up[axis]))], dtype=np.float64)
    return with_poses(dataset, rotation_matrices(dataset.images) @ turn.T, camera_centers(dataset.images) @ turn.T)


def _swap_on_the_earth(dataset: Dataset) -> Dataset:
    assert dataset.frame.anchor is not None
    lat, lon, height = dataset.frame.anchor
    swapped_anchor = (lon, lat, height)

    def swap(points: Floats) -> Floats:
        geographic = lon_lat_height_from_enu(points, (lat, lon, height))
        return enu_from_lon_lat_height(np.ascontiguousarray(geographic[:, [1, 0, 2]]), swapped_anchor)

    moved = with_centers(dataset, swap(camera_centers(dataset.images)))
    return Dataset(**{**vars(moved), "frame": Frame(anchor=swapped_anchor)})


def _heading_from_motion(dataset: Dataset) -> Dataset:
    azimuth, _, _ = headings(dataset)
    along, _ = driving_azimuths(dataset)
    return with_poses(dataset, turned(dataset, along - azimuth), camera_centers(dataset.images))


class _OtherWorld:
    """Rotations that take another world into the camera."""

    def __init__(self, axes: Floats) -> None:
        self._axes = axes

    def __call__(self, dataset: Dataset) -> Dataset:
        return with_poses(dataset, rotation_matrices(dataset.images) @ self._axes, camera_centers(dataset.images))


class _OtherPositions:
    """Positions in other axes than the rotations."""

    def __init__(self, axes: Floats) -> None:
        self._axes = axes

    def __call__(self, dataset: Dataset) -> Dataset:
        return with_centers(dataset, camera_centers(dataset.images) @ self._axes.T)


class _Headings:
    """Azimuths read another way; pitch and roll stay."""

    def __init__(self, change: object) -> None:
        self._change = change

    def __call__(self, dataset: Dataset) -> Dataset:
        azimuth, _, _ = headings(dataset)
        by = self._change(azimuth) - azimuth  # type: ignore[operator]
        return with_poses(dataset, turned(dataset, by), camera_centers(dataset.images))


class _RadiansReadAsDegrees:
    """All angles 57 times too small."""

    def __init__(self, zero_rad: float) -> None:
        self._zero_rad = zero_rad

    def __call__(self, dataset: Dataset) -> Dataset:
        azimuth, pitch, roll = headings(dataset)
        way = -1.0 if self._zero_rad else 1.0
        angle = way * (azimuth - self._zero_rad)
        angle = np.arctan2(np.sin(angle), np.cos(angle))
        whole = self._zero_rad + way * np.degrees(angle)
        rotation = rotations_of(whole, np.degrees(pitch), np.degrees(roll), dataset.frame)
        return with_poses(dataset, rotation, camera_centers(dataset.images))


class _DegreesReadAsRadians:
    """Angles 57 times too large, of which whole turns are lost: the drive says how many."""

    def __init__(self, zero_rad: float) -> None:
        self._zero_rad = zero_rad

    def __call__(self, dataset: Dataset) -> Dataset:
        rotation = rotations_from_degrees(dataset, zero_rad=self._zero_rad, clockwise=not self._zero_rad)
        return with_poses(dataset, rotation, camera_centers(dataset.images))
