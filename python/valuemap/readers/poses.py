"""Images of poses in the conventions of others: camera to world, headings, places on Earth or in a map projection."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow as pa
import scipy

from valuemap.anchor import HIGHEST_M, heights_not_given
from valuemap.arrays import Bools, Floats, Ints
from valuemap.errors import InputError, SettingError
from valuemap.geodesy import (
    degrees_outside,
    enu_axes_at,
    enu_from_lon_lat_height,
    is_geographic,
    lon_lat_height_from_crs,
    true_axes_of_crs,
    with_heights,
)
from valuemap.readers.files import check_names, refuse_repeated_names
from valuemap.tables import Categories, Images

_ROTATION_TOLERANCE = 1e-3
_LONGEST_GAP_S = 1e9
_NANO = 1_000_000_000
_LEAST_COSINE_TO_ANCHOR = np.cos(np.radians(10.0))
"""Farther from the anchor than a quarter of a continent, up is no longer up."""
_LEAST_COSINE_TO_MIDDLE = np.cos(np.radians(1.0))
"""An image this near the middle of all is where data of streets are: 100 km."""
_SHOWN = 3
_MANY = 20
"""So many latitudes and longitudes that are all as small as radians are taken for such: degrees seldom are."""
_TINY = 1e-300

# Columns are the axes of a level camera that looks north: x east, y down, z north.
LOOKING_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

RotationName = Literal["cam_from_world", "world_from_cam"]
"""What a rotation does."""

Axes = Literal["right-down-forward", "right-up-back", "forward-left-up"]

AXES: dict[str, Floats] = {
    "right-down-forward": np.eye(3),
    "right-up-back": np.diag([1.0, -1.0, -1.0]),
    "forward-left-up": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""What takes camera axes (x right, y down, z forward) into the axes that others give to a camera: OpenCV's, OpenGL's
and those of a vehicle (ROS, Waymo)."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Where images are: positions (N, 3) in the ENU frame of the anchor, and there the local axes of each.

    `world_from_local` (N, 3, 3) takes east, north, up at the image into the frame of the anchor; 20 km away these
    differ by a fifth of a degree. Without an anchor both are one frame of its own.
    """

    position_in_world_m: Floats
    world_from_local: Floats
    anchor: tuple[float, float, float] | None


def height_where_none(camera_height_m: float) -> float:
    """Return the height of cameras that state none, m.

    Raises
    ------
    SettingError
        It is no number.
    """
    if not math.isfinite(camera_height_m):
        raise SettingError(
            f"camera-height: expected a finite number, found {camera_height_m:g}", hint="2.5 is 2.5 m above the zero"
        )
    return camera_height_m


def place_on_earth(
    lon_lat_height: Floats,
    anchor: tuple[float, float, float] | None,
    names: Sequence[str],
    *,
    source: str,
    tell: Callable[[str], None] | None = None,
) -> Placed:
    """Place images (N, 3) at longitude, latitude (degrees) and ellipsoidal height (m); NaN stays NaN.

    Parameters
    ----------
    anchor
        Latitude, longitude and height of the origin; None for the place of the first image by name that is about where
        most are: one without a fix of the satellites may be at 0, 0.
    names
        Of the images (N).
    source
        What errors name as the place of the data.
    tell
        Called with each line that is worth knowing about the places.

    Raises
    ------
    InputError
        A latitude is beyond 90 degrees: often latitude and longitude are swapped. Or a height is none.
    SettingError
        The anchor is another place on the Earth.
    """
    fine: Bools = np.asarray(np.isfinite(lon_lat_height).all(axis=1))
    beyond = (np.abs(lon_lat_height[:, 1]) > 90.0) | (np.abs(lon_lat_height[:, 0]) > 360.0)
    wrong = np.flatnonzero(fine & beyond)
    if len(wrong):
        lon, lat, _ = lon_lat_height[wrong[0]]
        raise InputError(
            f"{source}: expected degrees, found latitude {lat:g} and longitude {lon:g} ({len(wrong)} images)",
            hint="are latitude and longitude swapped, or are these metres of a map projection (--crs)?",
        )
    height = lon_lat_height[:, 2]
    wrong = np.flatnonzero(fine & (np.abs(height) > HIGHEST_M))
    if len(wrong):
        raise InputError(
            f"{source}: expected heights of at most {HIGHEST_M:g} m, found {height[wrong[0]]:g} ({len(wrong)} images)",
            hint="heights, and those of cameras that have none, are in metres",
        )
    if not fine.any():
        raise InputError(f"{source}: no image has a place", hint="are latitude and longitude numbers in degrees?")
    is_near, is_far = _near_and_far(lon_lat_height, fine)
    lon, lat, height = lon_lat_height[min(np.flatnonzero(is_near).tolist(), key=lambda row: names[row])].tolist()
    origin = (lat, lon, height) if anchor is None else anchor
    position, axes = np.full((len(fine), 3), np.nan), np.full((len(fine), 3, 3), np.nan)
    position[fine] = enu_from_lon_lat_height(lon_lat_height[fine], origin)
    axes[fine] = enu_axes_at(lon_lat_height[fine], origin)
    if axes[fine & ~is_far, 2, 2].max() < _LEAST_COSINE_TO_ANCHOR:  # Up there against up at the anchor.
        raise SettingError(
            f"anchor: expected a place near the images, as at {lat:.6g} {lon:.6g}, found {origin[0]:g} {origin[1]:g}",
            hint="the latitude comes first; leave it away for the place of the first image",
        )
    if tell is not None and is_far.any():
        far = sorted((names[row], row) for row in np.flatnonzero(is_far).tolist())
        shown = ", ".join(
            f"{name!r} at lat {lon_lat_height[row, 1]:.2f}, lon {lon_lat_height[row, 0]:.2f}"
            for name, row in far[:_SHOWN]
        )
        tell(
            f"{len(far)} of {int(fine.sum())} images are far from the others, such as {shown}: had the receiver no fix?"
        )
    if tell is not None and (note := heights_not_given(lon_lat_height[fine, 2])) is not None:
        tell(note)
    angles = np.abs(lon_lat_height[fine, :2])
    if tell is not None and len(angles) >= _MANY and (angles <= [math.pi, math.pi / 2.0]).all() and angles.all():
        tell(
            f"all images are near latitude {lat:.4g}, longitude {lon:.4g}, where there is only sea: are these radians? "
            "Latitudes and longitudes are degrees"
        )
    return Placed(position, axes, origin)


def _near_and_far(lon_lat_height: Floats, fine: Bools) -> tuple[Bools, Bools]:
    """Return which images (N) are about the middle of those that have a place, or all these where none is; and which
    are so far from it that they are elsewhere: on another continent, or at latitude and longitude 0.
    """
    lon, lat = np.radians(np.where(fine, lon_lat_height[:, :2].T, np.nan))  # No cosine of what is infinite.
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    middle: Floats = np.median(up[fine], axis=0)  # Of each coordinate: less than half of the images cannot move it far.
    cosine = up @ middle / max(float(np.linalg.norm(middle)), _TINY)
    is_near: Bools = fine & (cosine >= _LEAST_COSINE_TO_MIDDLE)
    if not is_near.any():
        return fine, np.zeros(len(fine), np.bool_)
    is_at_zero = (lon_lat_height[:, :2] == 0.0).all(axis=1) & ~is_near
    is_far: Bools = fine & ((cosine < _LEAST_COSINE_TO_ANCHOR) | is_at_zero)
    return is_near, is_far


def place_in_crs(
    position: Floats,
    crs: str,
    anchor: tuple[float, float, float] | None,
    names: Sequence[str],
    *,
    vertical: str | None = None,
    source: str,
    tell: Callable[[str], None] | None = None,
) -> Placed:
    """Place images at coordinates (N, 3) of a reference system such as `EPSG:32610`, easting first, height last.

    The local axes are those of the grid: its north is not north, and poses in it are turned by the convergence.
    Heights are those of the vertical system, as in `with_heights`. Places that are a little outside of what the system
    is made for are told, and those of images far from the others.

    Raises
    ------
    InputError
        A place is none, or most are far outside of what the system is made for: often easting and northing are
        exchanged.
    SettingError
        There is no such system, or the anchor is another place on the Earth.
    """
    system, zero_m = with_heights(crs, vertical)
    assert system is not None
    position = position + [0.0, 0.0, zero_m]
    fine: Bools = np.asarray(np.isfinite(position).all(axis=1))
    lon_lat_height, true_from_grid = np.full((len(fine), 3), np.nan), np.full((len(fine), 3, 3), np.nan)
    lon_lat_height[fine] = lon_lat_height_from_crs(position[fine], system)
    true_from_grid[fine] = true_axes_of_crs(position[fine], crs)
    _check_area(lon_lat_height[fine], crs, tell)
    placed = place_on_earth(lon_lat_height, anchor, names, source=source, tell=tell)
    return Placed(placed.position_in_world_m, placed.world_from_local @ true_from_grid, placed.anchor)


def _check_area(lon_lat_height: Floats, crs: str, tell: Callable[[str], None] | None) -> None:
    """Refuse places (N, 3) most of which are far outside of what a system is made for; tell where they are outside."""
    outside = degrees_outside(lon_lat_height, crs)
    if outside is None or not len(outside):
        return
    row = int(np.argsort(outside, kind="stable")[(len(outside) - 1) // 2])  # Some may be at 0, 0, without a fix.
    if not outside[row] > 0.0:
        return
    lon, lat, _ = lon_lat_height[row]
    said = (
        f"crs {crs}: positions are at lat {lat:.4g}, lon {lon:.4g}, {outside[row]:.2g} degrees outside the area it is "
        "made for"
    )
    if outside[row] > _FAR_OUTSIDE_DEG:
        x, y = ("longitude", "latitude") if is_geographic(crs) else ("easting", "northing")
        raise InputError(said, hint=f"x is the {x}, y the {y}: are they exchanged?")
    if tell is not None:
        tell(said)


_FAR_OUTSIDE_DEG = 15.0
"""Norway uses one zone for all of the country, which lies up to 13 degrees outside of it."""


def local_from_cam(heading_rad: Floats, pitch_rad: Floats, roll_rad: Floats) -> Floats:
    """Return rotations (N, 3, 3) from camera axes into east, north, up.

    The heading counts clockwise from north as seen from above, the pitch up, and the roll clockwise as seen from
    behind the camera, so that its right side is down. The heading is applied last.
    """
    turn = scipy.spatial.transform.Rotation.from_euler("ZXY", np.stack([-heading_rad, pitch_rad, roll_rad], axis=1))
    matrix: Floats = turn.as_matrix() @ LOOKING_NORTH
    return matrix


def rotations_of_quaternions(quaternion_wxyz: Floats) -> Floats:
    """Return rotations (N, 3, 3) of quaternions (N, 4) in the order w, x, y, z.

    They are zeros where a quaternion is not of unit length, and NaN where it has none.
    """
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternion_wxyz, axis=1)
    fine: Bools = np.abs(length - 1.0) < _ROTATION_TOLERANCE
    matrix = np.where(np.isfinite(quaternion_wxyz).all(axis=1), 0.0, np.nan)[:, None, None] * np.ones((1, 3, 3))
    if fine.any():
        matrix[fine] = scipy.spatial.transform.Rotation.from_quat(quaternion_wxyz[fine], scalar_first=True).as_matrix()
    return matrix


def make_images(
    *,
    names: Sequence[str],
    camera_id: Ints,
    world_from_cam: Floats,
    center_in_world_m: Floats,
    passes: Sequence[str],
    source: str,
    image_id: Ints | None = None,
    timestamp_s: Floats | None = None,
    rigs: Sequence[str] | None = None,
    position_sigma_m: Floats | None = None,
    rotation_sigma_rad: Floats | None = None,
) -> Images:
    """Return images of poses in any order, with what is wrong with a pose kept, to be left out with its reason.

    A pose of which a number is missing becomes NaN, and a rotation that is none a quaternion of zeros.

    Parameters
    ----------
    names, camera_id, passes
        One an image (N); names are distinct and stay in the folder of the pictures.
    world_from_cam, center_in_world_m
        Rotations (N, 3, 3) from camera axes (x right, y down, z forward) into the world, and camera centres (N, 3).
    source
        What errors name as the place of the data.
    image_id
        Distinct ids (N). Without them images are numbered from 0 in the order of their names.
    timestamp_s
        Seconds (N), NaN where not known.
    rigs
        Which images were taken at one time by one rig (N): equal texts.
    position_sigma_m, rotation_sigma_rad
        Standard deviations of each axis (N), NaN where not known.

    Raises
    ------
    InputError
        There are no images, or a name is there twice or leads out of its folder.
    """
    if not len(names):
        raise InputError(f"{source}: there is no image with a pose", hint="is this the whole of it?")
    check_names(list(names), source)
    refuse_repeated_names(names, source)
    is_given, is_motion = given_and_motions(world_from_cam, center_in_world_m)
    if image_id is None:
        order = np.array(sorted(range(len(names)), key=lambda row: names[row]), dtype=np.int64)
        ids: Ints = np.arange(len(names), dtype=np.int64)
    else:
        order = np.argsort(image_id, kind="stable")
        ids = image_id[order]
    quaternion, translation = np.full((len(names), 4), np.nan), np.full((len(names), 3), np.nan)
    quaternion[is_given[order]] = translation[is_given[order]] = 0.0
    fine = is_motion[order]
    if fine.any():
        cam_from_world = scipy.spatial.transform.Rotation.from_matrix(world_from_cam[order][fine]).inv()
        quaternion[fine] = cam_from_world.as_quat(canonical=True, scalar_first=True)
        translation[fine] = -cam_from_world.apply(center_in_world_m[order][fine])
    optional = {
        name: None if values is None or np.isnan(values).all() else values[order]
        for name, values in (
            ("timestamp_s", timestamp_s),
            ("position_sigma_m", position_sigma_m),
            ("rotation_sigma_rad", rotation_sigma_rad),
        )
    }
    return Images(
        image_id=ids,
        name=pa.array([names[row] for row in order], pa.string()),
        camera_id=np.asarray(camera_id, dtype=np.int64)[order],
        cam_from_world_quat=quaternion,
        cam_from_world_m=translation,
        pass_id=Categories.from_texts([passes[row] for row in order]),
        rig_id=None if rigs is None else Categories.from_texts([rigs[row] for row in order]).codes.astype(np.int64),
        **optional,
    )


def rigs_by_time(
    cameras: Sequence[str], timestamp_s: Floats, drives: Sequence[str], longest_s: float = 0.06
) -> list[str]:
    """Return which images (N) were taken together: equal texts for images of different cameras of one drive.

    In driving order an image joins the ones before it unless its camera is among them, or the first of them is more
    than `longest_s` older. Cameras of a car are not fired at the same instant: Argoverse's are within 50 ms.
    """
    rigs = [""] * len(cameras)
    together: set[str] = set()
    drive, begin_s, number = None, -np.inf, -1
    for row in sorted(range(len(cameras)), key=lambda row: (drives[row], timestamp_s[row], cameras[row])):
        if drives[row] != drive or cameras[row] in together or timestamp_s[row] - begin_s > longest_s:
            drive, begin_s, together, number = drives[row], float(timestamp_s[row]), set(), number + 1
        together.add(cameras[row])
        rigs[row] = f"{number:012d}"
    return rigs


def seconds_of_unit(stamp: float) -> float:
    """Return the unit of a timestamp, s: 1, or milli-, micro- or nanoseconds, in which it is as large as today's."""
    return next((unit for least, unit in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)) if stamp >= least), 1.0)


def nanoseconds_of_gap(longest_gap_s: float) -> int:
    """Return how long a gap between poses may be, of seconds that somebody set, in nanoseconds.

    Raises
    ------
    SettingError
        It is below 0, or no number of seconds.
    """
    if not 0.0 <= longest_gap_s <= _LONGEST_GAP_S:
        raise SettingError(
            f"longest-gap: expected seconds from 0 to {_LONGEST_GAP_S:g}, found {longest_gap_s:g}",
            hint="for example 0.2; 0 takes only images at the time of a pose",
        )
    return int(longest_gap_s * _NANO)


def interpolate_poses(
    time: Ints, known_time: Ints, rotation: Floats, center_m: Floats, longest: int
) -> tuple[Floats, Floats, Bools]:
    """Return rotations (N, 3, 3) and centres (N, 3) at times (N) between known poses, and which there are (N).

    Poses turn about one axis and move straight between neighbours. There is none (NaN) outside the known times, nor in
    gaps longer than `longest`, in which it may have been anywhere. Known times (M) are in any order, and distinct;
    poses that hold no numbers, or no rotation, are not known.
    """
    _, fine = given_and_motions(rotation, center_m)
    if not fine.any():
        count = len(time)
        return np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan), np.zeros(count, dtype=np.bool_)
    known_time, rotation, center_m = known_time[fine], rotation[fine], center_m[fine]
    order = np.argsort(known_time, kind="stable")
    rotations = scipy.spatial.transform.Rotation.from_matrix(rotation[order])
    known, centers = known_time[order], center_m[order]
    after = np.clip(np.searchsorted(known, time), 1 if len(known) > 1 else 0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    gap = known[after] - known[before]
    share = np.divide(time - known[before], gap, out=np.zeros(len(time)), where=gap > 0)
    inside = (time >= known[0]) & (time <= known[-1])
    usable: Bools = inside & ((gap <= longest) | (share == 0.0) | (share == 1.0))
    share = np.clip(share, 0.0, 1.0)
    step = rotations[before].inv() * rotations[after]
    turned = rotations[before] * scipy.spatial.transform.Rotation.from_rotvec(step.as_rotvec() * share[:, None])
    moved: Floats = centers[before] + (centers[after] - centers[before]) * share[:, None]
    matrix = turned.as_matrix()
    matrix[~usable], moved[~usable] = np.nan, np.nan
    return matrix, moved, usable


def images_without_poses(images: Images, longest_gap_s: float) -> dict[int, str]:
    """Return why images have no pose, by row, where all poses that there are were interpolated between others."""
    reason = f"it is before or after all poses, or in a gap of them that is longer than {longest_gap_s:g} s"
    return dict.fromkeys(np.flatnonzero(np.isnan(images.cam_from_world_m).any(axis=1)).tolist(), reason)


def given_and_motions(rotation: Floats, center_m: Floats) -> tuple[Bools, Bools]:
    """Return which poses (N) have all their numbers, and which are rigid motions."""
    is_given: Bools = np.asarray(np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(center_m).all(axis=1))
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    is_rotation = error <= _ROTATION_TOLERANCE
    right = np.linalg.det(np.where((is_given & is_rotation)[:, None, None], rotation, 0.0)) > 0.0
    return is_given, is_given & is_rotation & right
