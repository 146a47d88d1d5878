"""Faults of frames: axes of the world, headings, angles in the wrong unit, latitude and longitude, scale."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check.agreement import chance_of_majority
from valuemap.check.fault import (
    GATE_RAD,
    LEAST_CHANCE,
    Convention,
    Fault,
    Finding,
    Fix,
    InTurn,
    Stage,
    View,
    with_centers,
    with_images,
    with_poses,
)
from valuemap.check.headings import driving_azimuths, headings, rotations_of, turned, wrapped
from valuemap.check.lenses import focals
from valuemap.check.offsets import find_shift
from valuemap.check.quality import certain_points, flattened, matches
from valuemap.check.sizes import are_outside, do_groups_agree, object_heights, plausible_heights
from valuemap.check.time_stamps import SPEEDS_MPS, median_speed_mps
from valuemap.check.turns import rotations_from_degrees
from valuemap.dataset import Dataset, Frame, rows_of
from valuemap.geodesy import enu_from_lon_lat_height, lon_lat_height_from_enu
from valuemap.tables import Images

_WORLD_AXES: dict[str, list[list[float]]] = {
    "north, east, down": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    "north, west, up (headings from another direction)": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "x south, y east, z up (headings from another direction)": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "west, south, up (headings from the opposite direction)": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "y up, z back": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "y down, z forward": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "east, south, down": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}
"""Takes the world of the positions into that in which the rotations are given."""
_POSITIONS_IN = ("y up, z back", "y down, z forward", "north, east, down", "east, south, down")
"""Those in which up is elsewhere: of the others it is one whether positions or rotations are turned."""
_MIRRORED: dict[str, list[list[float]]] = {
    "x the other way": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "y the other way": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "z the other way": [[1, 0, 0], [0, 1, 0], [0, 0, -1]],
}
_LEAST_UPRIGHT = 0.5
_SIGMA_LIMIT_RAD = 0.35
"""A pose whose rotation is not known to 20 degrees is none: such a column is in degrees."""
_TIMES_THE_GATE = 6.0
"""Rays that meet at the gate are not of rotations known to no more than so many times as much."""
"""From pushing a cart to the fastest road."""


class WorldAxes(Convention):
    """Positions in one world, rotations in another: ENU and NED, y up and z up."""

    name: ClassVar[str] = "world_axes"
    is_of_world: ClassVar[bool] = True
    what: ClassVar[str] = (
        "Positions and rotations are in different worlds (ENU and NED, y up and z up, headings from north or east)."
    )
    do: ClassVar[str] = "Turn positions and rotations into one world: x east, y north, z up, headings from north."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield rotations given in other axes than the positions."""
        for name, axes in _WORLD_AXES.items():
            yield f"rotations in {name}", _OtherWorld(np.array(axes, dtype=np.float64))
        for name in _POSITIONS_IN:  # Cameras stand then as they are given.
            yield f"positions in {name}", _OtherPositions(np.array(_WORLD_AXES[name], dtype=np.float64).T)


class MirroredPositions(Convention):
    """One axis of the positions goes the other way: a left-handed world."""

    name: ClassVar[str] = "mirrored_positions"
    is_of_world: ClassVar[bool] = True
    what: ClassVar[str] = "One axis of the positions goes the other way: the world is left-handed."
    do: ClassVar[str] = "Negate that axis of the positions; the world must be right-handed."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield each axis of the positions negated."""
        for name, axes in _MIRRORED.items():
            yield name, _OtherPositions(np.array(axes, dtype=np.float64))


class MirroredWorld(Convention):
    """A left-handed world: positions and headings agree with each other, and pictures are the other way round."""

    name: ClassVar[str] = "mirrored_world"
    kind: ClassVar[str | None] = "mirrored_pictures"
    is_of_world: ClassVar[bool] = True
    what: ClassVar[str] = "The world is left-handed: north and east are exchanged, in positions and in headings."
    do: ClassVar[str] = (
        "Exchange both columns of the positions and count headings from the other axis, the other way round. If the "
        "world is right, the pictures are mirrored: rays cannot tell one from the other."
    )

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield positions and headings mirrored together."""
        east, north = dataset.frame.east_north()
        for name, across, mirrored in (
            ("north and east exchanged", east - north, lambda a: np.pi / 2.0 - a),
            ("east the other way", east, lambda a: -a),
            ("north the other way", north, lambda a: np.pi - a),
        ):
            axes = np.eye(3) - 2.0 * np.outer(across, across) / float(across @ across)
            yield f"{name}, in positions and headings", InTurn(_OtherPositions(axes), _Headings(mirrored))


class LatLonSwapped(Convention):
    """Latitude where longitude is expected, or northing where easting is."""

    name: ClassVar[str] = "lat_lon_swapped"
    is_of_world: ClassVar[bool] = True
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
    is_of_world: ClassVar[bool] = True
    what: ClassVar[str] = "Headings count from another direction, or the other way round, than they were read."
    do: ClassVar[str] = "Say what headings mean: clockwise from north (compass) or counter-clockwise from east."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield headings mirrored, from each of the four directions; only turned they are `WorldAxes`."""
        yield "counter-clockwise from east taken for clockwise from north", _Headings(lambda a: np.pi / 2.0 - a)
        yield "counter-clockwise taken for clockwise", _Headings(lambda a: -a)
        yield "counter-clockwise from west taken for clockwise from north", _Headings(lambda a: -a - np.pi / 2.0)
        yield "counter-clockwise from south taken for clockwise from north", _Headings(lambda a: np.pi - a)


class TiltConvention(Convention):
    """Pitch that counts downwards, roll that counts the other way, or one taken for the other."""

    name: ClassVar[str] = "tilt_convention"
    is_of_world: ClassVar[bool] = True
    what: ClassVar[str] = "Pitch or roll count the other way than they were read, or are taken for each other."
    do: ClassVar[str] = "Say what the angles mean: pitch counts upwards, roll with the right side down."

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield pitch, roll and both negated, and the one for the other."""
        yield "pitch the other way", _Tilts([[-1, 0], [0, 1]])
        yield "roll the other way", _Tilts([[1, 0], [0, -1]])
        yield "pitch and roll the other way", _Tilts([[-1, 0], [0, -1]])
        yield "pitch and roll exchanged", _Tilts([[0, 1], [1, 0]])
        yield "pitch and roll exchanged, one the other way", _Tilts([[0, -1], [1, 0]])
        yield "pitch and roll exchanged, the other the other way", _Tilts([[0, 1], [-1, 0]])
        yield "pitch and roll exchanged, both the other way", _Tilts([[0, -1], [-1, 0]])


class DegreesForRadians(Convention):
    """Angles in degrees read as radians, or the other way round."""

    name: ClassVar[str] = "degrees_for_radians"
    what: ClassVar[str] = "The angles of the poses are in the wrong unit: degrees, radians or gon are mixed up."
    do: ClassVar[str] = "Convert the angles to degrees (180/pi of radians, 0.9 of gon) and import again."
    is_guess: ClassVar[bool] = True
    explained_by: ClassVar[frozenset[str]] = frozenset({"headings_constant", "headings_useless"})

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield degrees read as radians, and radians or gon read as degrees, as compass or mathematical angles.

        Headings that follow the drive are in their unit, and the tilts beside them, too. What hardly turns most cameras
        says nothing of a unit: it takes the noise off headings near zero.
        """
        if _follow_the_drive(dataset):
            return
        for how, fix in self._in_other_units():
            if _usual_turn_rad(dataset, fix(dataset)) >= _LEAST_TURN_RAD:
                yield how, fix

    def _in_other_units(self) -> Iterator[tuple[str, Fix]]:
        for name, zero in (("clockwise from north", 0.0), ("counter-clockwise from east", np.pi / 2.0)):
            yield f"degrees {name} read as radians", _DegreesReadAsRadians(zero)
            yield f"radians {name} read as degrees", _RadiansReadAsDegrees(zero)
            yield f"headings in degrees {name} read as radians", _DegreesReadAsRadians(zero, tilts=False)
            yield f"headings in radians {name} read as degrees", _RadiansReadAsDegrees(zero, tilts=False)
            yield f"gon {name} read as degrees", _GonReadAsDegrees(zero)
            yield f"headings in gon {name} read as degrees", _GonReadAsDegrees(zero, tilts=False)
            other = "clockwise from north" if zero else "counter-clockwise from east"
            both, meant = f"radians {name} read as degrees {other}", zero
            yield both, _RadiansReadAsDegrees(np.pi / 2.0 - zero, meant_rad=meant)
            yield f"headings in {both}", _RadiansReadAsDegrees(np.pi / 2.0 - zero, meant_rad=meant, tilts=False)


def _usual_turn_rad(dataset: Dataset, other: Dataset) -> float:
    """Return the median angle between the cameras of two versions of a dataset."""
    between = rotation_matrices(other.images) @ rotation_matrices(dataset.images).transpose(0, 2, 1)
    cosine = (np.trace(between, axis1=1, axis2=2) - 1.0) / 2.0
    return float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _follow_the_drive(dataset: Dataset) -> bool:
    """Return whether most images of each camera keep to where it is driven, as the drive turns.

    In degrees that were read as radians they would look any way, and in radians read as degrees always the same one.
    """
    azimuth_rad, _, _ = headings(dataset)
    way_rad, is_moving = driving_azimuths(dataset)
    for camera in np.unique(dataset.images.camera_id):
        moving = is_moving & (dataset.images.camera_id == camera)
        if moving.sum() < _LEAST_MOVING:
            return False
        turns_rad = _usual_off_rad(way_rad[moving])
        if turns_rad < _WAYS_RAD or _usual_off_rad((azimuth_rad - way_rad)[moving]) > _FOLLOWS * turns_rad:
            return False
    return True


def _usual_off_rad(azimuth_rad: Floats) -> float:
    """Return how far the middle one of azimuths (N) is off their mean."""
    each = np.exp(1j * azimuth_rad)
    return float(np.median(np.abs(np.angle(each * np.conj(each.mean())))))


_LEAST_TURN_RAD = np.radians(5.0)
"""Headings of consumer phones are off by as much: what turns less may be their noise."""

_FOLLOWS = 0.05
"""Headings that jitter by a twentieth of a degree are off by as much in the wrong unit, on a way of many turns."""


class HeadingsUseless(Convention):
    """Headings that say less than the direction of travel."""

    name: ClassVar[str] = "headings_useless"
    what: ClassVar[str] = "The headings say nothing: cameras taken to look where they drive agree better."
    do: ClassVar[str] = "Look where the headings come from; the fix takes the direction of travel."
    is_guess: ClassVar[bool] = True

    def readings(self, dataset: Dataset) -> Iterator[tuple[str, Fix]]:
        """Yield headings from the positions."""
        yield "headings along the drive", _heading_from_motion


class ConstantHeadings(Fault):
    """Cameras that look one way wherever they are driven: a column of headings that was never filled."""

    name: ClassVar[str] = "headings_constant"
    stage: ClassVar[Stage] = "tables"  # What says nothing is in no convention and in no unit.

    def find(self, view: View) -> Finding | None:
        """Compare how much the cameras turn with how much their ways do; panoramas may all be turned to north."""
        if view.uprightness < _LEAST_UPRIGHT:  # Of cameras that lie, headings are no headings.
            return None
        dataset = view.dataset
        camera_row = rows_of(dataset.images.camera_id, dataset.cameras.camera_id)
        azimuth_rad, _, _ = headings(dataset)
        way_rad, is_moving = driving_azimuths(dataset)
        told = []
        for row in np.unique(camera_row).tolist():
            mine = camera_row == row
            moving = mine & is_moving
            if not focals(dataset.cameras, row) or moving.sum() < _LEAST_MOVING:
                continue
            told.append((_spread_rad(azimuth_rad[mine]), _spread_rad(way_rad[moving])))
        if any(turns > _STEADY_RAD for turns, _ in told) or all(way < _WAYS_RAD for _, way in told):
            return None
        images = dataset.images
        return Finding(
            fault=self.name,
            what="The headings say nothing: all images of a camera look the same way, wherever it is driven.",
            why=f"The headings of a camera scatter by {math.degrees(max(turns for turns, _ in told)):.2g} degrees, "
            f"the directions in which its images move by {math.degrees(max(way for _, way in told)):.0f} degrees.",
            do=HeadingsUseless.do,
            figures={"cameras": len(told), "images": len(images)},
            fix=None if _expose_together(images) else _heading_from_motion,  # Which way looks each of a car's cameras?
        )


_LEAST_MOVING = 20
_WAYS_RAD = math.radians(20.0)
_STEADY_RAD = math.radians(1.0) * _WAYS_RAD / 2.0
"""No camera of a car keeps its heading while the car's turns by twenty degrees. Headings in radians that were read as
degrees would turn by twice as much."""


def _expose_together(images: Images) -> bool:
    """Return whether cars have several cameras, or may have: of images with several cameras no times are known."""
    if len(np.unique(images.camera_id)) == 1:
        return False
    if images.timestamp_s is None:
        return True
    together = np.stack([images.pass_id.codes.astype(np.float64), images.timestamp_s])
    return len(np.unique(together, axis=1).T) < len(images)


def _spread_rad(azimuth_rad: Floats) -> float:
    """Return the circular standard deviation of azimuths (N)."""
    length = float(np.hypot(np.mean(np.cos(azimuth_rad)), np.mean(np.sin(azimuth_rad))))
    return math.sqrt(max(0.0, -2.0 * math.log(max(length, 1e-12))))


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
    stage: ClassVar[Stage] = "positions"  # When it is known at which gate rays meet.

    def find(self, view: View) -> Finding | None:
        """Look for standard deviations that leave nothing of a rotation, or that rays give the lie to."""
        sigma = view.dataset.images.rotation_sigma_rad
        if sigma is None or not np.any(np.isfinite(sigma)):
            return None
        median = float(np.nanmedian(sigma))
        seen = _TIMES_THE_GATE * GATE_RAD * view.gate_share if view.meets else math.inf
        if median <= min(_SIGMA_LIMIT_RAD, seen):
            return None
        why = "which is no pose" if median > _SIGMA_LIMIT_RAD else "but rays meet at a tenth of that"
        return Finding(
            fault=self.name,
            what="rotation_sigma_rad holds degrees.",
            why=f"Its median is {median:.3g}: as radians that is {math.degrees(median):.0f} degrees, {why}.",
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
        """Compare where objects are with the truth, and their size and the speed of the car with what there is."""
        by_truth = _scale_by_truth(view)
        if by_truth is not None:
            return by_truth
        reasons, figures = [], {}
        factors = []
        heights = object_heights(view)
        for name, height_of_each_m in heights.items():
            height_m, objects = float(np.median(height_of_each_m)), len(height_of_each_m)
            low, high = plausible_heights(name)
            figures[f"height_m of {name}"] = round(height_m, 4)
            if are_outside(height_of_each_m, low, high) and do_groups_agree(view, name, low, high):
                reasons.append(
                    f"{name} are {height_m:.3g} m high (median of {objects} places; {low:g} to {high:g} m is usual)"
                )
                factors.append(math.sqrt(low * high) / height_m)
        speed = median_speed_mps(view)
        if speed is not None:
            figures["speed_mps"] = round(speed, 4)
            low, high = SPEEDS_MPS
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


def _scale_by_truth(view: View) -> Finding | None:
    """Return the unit in which most points where rays meet get a true object; None where it is the metre or unknown."""
    truth, points = view.dataset.truth, certain_points(view)
    if truth is None or min(len(truth), len(points)) < _LEAST_TRUTH or not view.meets:
        return None
    tolerance_m = max(view.step_m / 2.0, 1e-9)
    points, objects = flattened(points, truth, view), flattened(truth.position_in_world_m, truth, view)
    units_m = units_of_frame_m(view.dataset.frame)
    matched = {unit: _matched_in(unit_m, points, objects, tolerance_m) for unit, unit_m in units_m.items()}
    unit = max(matched, key=lambda each: matched[each])
    if unit == "metres" or matched[unit] < 2 * matched["metres"]:
        return None
    tests = len(points) * len(objects) * len(units_m)
    chance = chance_of_majority(matched[unit], matched[unit] + matched["metres"]) * tests
    if chance > LEAST_CHANCE:
        return None
    factor = units_m[unit]
    return Finding(
        fault=Scale.name,
        what="The world is not in metres.",
        why=f"Read in {unit} (times {factor:g}), {matched[unit]} of {len(points)} points where many rays meet have a "
        f"true object within {tolerance_m * factor:.2g} m, in metres {matched['metres']}.",
        do=f"Scale the positions of the images {factor:g} times.",
        chance=chance,
        figures={"factor": factor, "matched": matched["metres"], "matched_if_scaled": matched[unit]},
        fix=lambda dataset: with_centers(dataset, factor * camera_centers(dataset.images)),
    )


_LEAST_TRUTH = 5
_UNITS_M = {
    "metres": 1.0, "kilometres": 1000.0, "decimetres": 0.1, "centimetres": 0.01, "millimetres": 0.001,
    "feet": 0.3048, "inches": 0.0254, "miles": 1609.344, "metres taken for feet": 1 / 0.3048,
    "metres taken for centimetres": 100.0, "metres taken for decimetres": 10.0,
}  # fmt: skip


def units_of_frame_m(frame: Frame) -> dict[str, float]:
    """Return how long units are that positions may be in; those of a map in Web Mercator are shorter than a metre."""
    if frame.anchor is None:
        return _UNITS_M
    mercator_m = math.cos(math.radians(frame.anchor[0]))
    return _UNITS_M if mercator_m > _NEAR_THE_EQUATOR else {**_UNITS_M, "metres of Web Mercator": mercator_m}


_NEAR_THE_EQUATOR = 0.95
"""Within 18 degrees of it they are a metre, but for a twentieth."""


def _matched_in(unit_m: float, points: Floats, objects: Floats, tolerance: float) -> int:
    """Return how many points have an object as near as the tolerance (in their own unit), after the best shift."""
    there = objects / unit_m
    shift = find_shift(there, points, tolerance, within_m=None)
    return 0 if shift is None else matches(points, there + shift.offset_m, tolerance)


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


class _Tilts:
    """Pitch and roll made of each other; headings stay."""

    def __init__(self, of_pitch_and_roll: list[list[int]]) -> None:
        self._matrix = np.array(of_pitch_and_roll, dtype=np.float64)

    def __call__(self, dataset: Dataset) -> Dataset:
        azimuth, pitch, roll = headings(dataset)
        pitch, roll = self._matrix @ [pitch, roll]
        return with_poses(dataset, rotations_of(azimuth, pitch, roll, dataset.frame), camera_centers(dataset.images))


class _RadiansReadAsDegrees:
    """All angles, or those of the compass only, 57 times too small.

    They were read as counting from one direction, and may be meant from another.
    """

    def __init__(self, zero_rad: float, *, meant_rad: float | None = None, tilts: bool = True) -> None:
        self._zero_rad = zero_rad
        self._meant_rad = zero_rad if meant_rad is None else meant_rad
        self._tilts = np.degrees(1.0) if tilts else 1.0

    def __call__(self, dataset: Dataset) -> Dataset:
        azimuth, pitch, roll = headings(dataset)
        way = -1.0 if self._zero_rad else 1.0
        angle = way * (azimuth - self._zero_rad)
        angle = np.arctan2(np.sin(angle), np.cos(angle))
        whole = self._meant_rad + (-1.0 if self._meant_rad else 1.0) * np.degrees(angle)
        rotation = rotations_of(whole, self._tilts * pitch, self._tilts * roll, dataset.frame)
        return with_poses(dataset, rotation, camera_centers(dataset.images))


class _DegreesReadAsRadians:
    """Angles 57 times too large, of which whole turns are lost: the drive says how many."""

    def __init__(self, zero_rad: float, *, tilts: bool = True) -> None:
        self._zero_rad, self._tilts = zero_rad, tilts

    def __call__(self, dataset: Dataset) -> Dataset:
        rotation = rotations_from_degrees(
            dataset, zero_rad=self._zero_rad, clockwise=not self._zero_rad, tilts=self._tilts
        )
        return with_poses(dataset, rotation, camera_centers(dataset.images))


class _GonReadAsDegrees:
    """Angles of 400 a circle, of which those above 360 have lost a turn: the drive says which."""

    def __init__(self, zero_rad: float, *, tilts: bool = True) -> None:
        self._zero_rad = zero_rad
        self._tilts = _DEGREES_OF_A_GON if tilts else 1.0

    def __call__(self, dataset: Dataset) -> Dataset:
        azimuth, pitch, roll = headings(dataset)
        way = -1.0 if self._zero_rad else 1.0
        angle = (way * (azimuth - self._zero_rad)) % (2.0 * np.pi)
        one, other = (self._zero_rad + way * _DEGREES_OF_A_GON * (angle + turn) for turn in (0.0, 2.0 * np.pi))
        may_be_other = angle < 2.0 * np.pi * (1.0 / _DEGREES_OF_A_GON - 1.0)
        along, _ = driving_azimuths(dataset)
        whole = one.copy()
        for camera in np.unique(dataset.images.camera_id):
            mine = dataset.images.camera_id == camera
            known = mine & ~may_be_other
            looks = along + float(np.angle(np.exp(1j * (one - along)[known]).sum()))
            nearer = np.abs(wrapped(other - looks)) < np.abs(wrapped(one - looks))
            whole = np.where(mine & may_be_other & nearer, other, whole)
        rotation = rotations_of(whole, self._tilts * pitch, self._tilts * roll, dataset.frame)
        return with_poses(dataset, rotation, camera_centers(dataset.images))


_DEGREES_OF_A_GON = 0.9
