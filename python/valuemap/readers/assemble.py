"""What all readers end with: vet what was found, settle the frame, and pass the checks at the door."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.dataset import Dataset, Frame, check_dataset, write_dataset_in_portions
from valuemap.errors import InputError, SettingError
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.readers.boxes import FiledBoxes, FoundBoxes
from valuemap.readers.vet import MAX_REJECTED, Rejections, number_detections, vet_boxes, vet_images
from valuemap.tables import Cameras, Detections, Images, RejectedRows, Truth
from valuemap.tables.table import join_tables

__all__ = ["MAX_REJECTED", "ONE_PASS", "STILL_M", "FoundBoxes", "Imported", "assemble", "number_detections"]

ONE_PASS = "all"
"""The pass of images about whose passes nothing is known."""

_PLAUSIBLE_STEP_M = (1e-3, 1e3)
STILL_M = 1e-6
"""Images this near each other are at one place."""
_MIN_MEAN_UP = 0.1
_MAX_TILT_FROM_ENU_RAD = math.radians(60.0)
_HIGHEST_ABOVE_ANCHOR_M = 7e3
"""No street is higher; 300 km from the anchor, the plane that touches the Earth there is."""

_FAR_FROM_ANCHOR_M = 1.5e5
"""Eastings of UTM are from 166 km on."""
_LEVEL = 0.25
"""Of what the plane is above the Earth: mountains just as high, just as far, are no data of streets."""
_EARTH_RADIUS_M = 6.371e6


@dataclass(frozen=True, eq=False)
class Imported:
    """A checked dataset whose detections, and what was left out, are in temporary files.

    `dataset` has all but these, which come in portions, the detections by their ids.
    """

    dataset: Dataset
    detections: Callable[[], Iterator[Detections]]
    left_out: Rejections

    def rejected(self) -> Iterator[RejectedRows]:
        """Yield what was left out; nothing where that is nothing."""
        return self.left_out.portions()

    def whole(self) -> Dataset:
        """Return all of it in memory."""
        rejected = list(self.rejected())
        return dataclasses.replace(
            self.dataset,
            detections=join_tables(list(self.detections())),
            rejected=join_tables(rejected) if rejected else None,
        )

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write all of it under the name of the folder, as `valuemap.dataset.write_dataset` does, in portions."""
        named = dataclasses.replace(self.dataset, name=path.resolve().name)
        write_dataset_in_portions(named, self.detections(), self.rejected(), path, force=force)


def assemble(
    *,
    name: str,
    cameras: Cameras,
    images: Images,
    detections: FoundBoxes | FiledBoxes,
    up: tuple[float, float, float] | None,
    anchor: tuple[float, float, float] | None,
    is_on_earth: bool = False,
    source: str,
    where_image: Callable[[int], str] | None = None,
    truth: Truth | None = None,
    max_rejected: float = MAX_REJECTED,
    unposed: Mapping[int, str] | None = None,
    unreadable: Mapping[str, str] | None = None,
    not_chosen: Callable[[Collection[str]], Collection[str]] | None = None,
) -> Imported:
    """Return the checked dataset of what a reader found; what cannot be used is left out and listed in it.

    Parameters
    ----------
    images
        All that were found; those whose pose is no pose are left out, and their boxes with them.
    detections
        All that were found.
    up
        The direction up in the frame of the poses, of any length; None for the mean of the cameras' own.
    anchor
        WGS84 latitude, longitude (degrees) and ellipsoidal height (m) of the origin, where the poses are in
        the ENU frame there already (x east, y north, z up, metres).
    is_on_earth
        The poses are in that frame because the data say where on the Earth they are, not because somebody says so.
        Then cameras may be turned: pictures taken upright or upside down.
    source
        What errors name as the place of the data.
    where_image
        Returns the place of an image in the user's files, for its row in `images`.
    truth
        Known objects, where there are.
    max_rejected
        The share of the boxes, and of the images, that may be left out.
    unposed
        Why images have no pose, by row, where poses were to be found: they do not count toward that share.
    unreadable
        Why pictures are not even in `images`, by name; they and their boxes are listed.
    not_chosen
        Returns which of the names of images that boxes have are of images that the user chose not to read: these boxes
        are listed, and do not count toward that share.

    Raises
    ------
    SettingError
        `up`, `anchor` or `max_rejected` is impossible, or `up` and `anchor` are both given.
    InputError
        Too many boxes or images cannot be used; the tables are inconsistent, the poses cannot be metric, have no
        mean up, or contradict `anchor` or are far from it.
    """
    rejections = Rejections(source, max_rejected)
    rejections.add_unreadable(unreadable or {})
    posed, usable = vet_images(images, rejections, where_image, unposed)
    if isinstance(detections, FoundBoxes):
        detections = detections.filed(images.name)
    boxes = vet_boxes(detections, images, usable, cameras, rejections, list(unreadable or ()), not_chosen)
    unframed = Dataset(
        name=name,
        frame=Frame(),
        cameras=cameras,
        images=posed,
        detections=Detections.none(),
        truth=truth,
    )
    dataset = check_dataset(unframed, source=source)
    _check_steps(dataset.images, source)
    dataset = dataclasses.replace(dataset, frame=_frame(dataset.images, up, anchor, is_on_earth, source))
    return Imported(dataset, boxes, rejections)


def check_frame(up: tuple[float, float, float] | None, anchor: tuple[float, float, float] | None) -> None:
    """Refuse a direction of the sky, or an anchor, that is impossible whatever the poses are.

    Raises
    ------
    SettingError
        One is impossible, or both are given.
    """
    if up is not None and anchor is not None:
        raise SettingError("up and anchor: expected at most one", hint="with an anchor, up is +z: leave up away")
    if up is not None and not (math.isfinite(length := math.hypot(*up)) and length > 0.0):
        raise SettingError(f"up: expected a direction, found {up}", hint="for example 0 -1 0 where y points down")
    if anchor is not None:
        lat, lon, height = anchor
        if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and math.isfinite(height)):
            raise SettingError(
                f"anchor: expected latitude, longitude (degrees) and height (m), found {lat} {lon} {height}",
                hint="for example 52.3702 4.8952 43.0: latitude first",
            )


def _frame(
    images: Images,
    up: tuple[float, float, float] | None,
    anchor: tuple[float, float, float] | None,
    is_on_earth: bool,
    source: str,
) -> Frame:
    check_frame(up, anchor)
    if up is not None:
        length = math.hypot(*up)
        return Frame(up=(up[0] / length, up[1] / length, up[2] / length))
    mean_up: Floats = -rotation_matrices(images)[:, 1].mean(axis=0)  # Camera axes: y down.
    length = float(np.linalg.norm(mean_up))
    if anchor is not None:
        _check_heights(images, anchor, source)
        if not is_on_earth:
            refuse_plane(camera_centers(images), source)
        if not is_on_earth and length >= _MIN_MEAN_UP:
            _check_is_enu(mean_up / length, source)
        return Frame(anchor=anchor)
    if length < _MIN_MEAN_UP:
        raise InputError(
            f"{source}: the cameras' own up directions cancel out (their mean has length {length:.2g})",
            hint="give up, the direction up in the frame of the poses, e.g. 0 0 1",
        )
    x, y, z = (mean_up / length).tolist()
    return Frame(up=(x, y, z))


def _check_heights(images: Images, anchor: tuple[float, float, float], source: str) -> None:
    """Refuse positions that are not about an anchor: those of a map projection, or from the middle of the Earth.

    These are far from it, and so high above the Earth, which curves away.
    """
    center_m = camera_centers(images)
    above_m = np.abs(lon_lat_height_from_enu(center_m, anchor)[:, 2] - anchor[2])
    if np.median(above_m) > _HIGHEST_ABOVE_ANCHOR_M:
        raise _no_place_about_anchor(center_m[np.argmax(above_m)], source)


def refuse_plane(center_m: Floats, source: str) -> None:
    """Refuse positions (N, 3) that somebody says are about an anchor, but that are far from it and do not curve away.

    In a map projection heights count from the Earth, in the frame of an anchor from the plane that touches it there,
    which is 1.8 km above the Earth in a distance of 150 km.
    """
    middle_m: Floats = np.nanmedian(center_m, axis=0)
    x, y, z = middle_m.tolist()
    far_m = math.hypot(x, y)
    if far_m > _FAR_FROM_ANCHOR_M and abs(z) < _LEVEL * far_m * far_m / (2.0 * _EARTH_RADIUS_M):
        raise _no_place_about_anchor(middle_m, source)


def _no_place_about_anchor(center_m: Floats, source: str) -> InputError:
    x, y, z = center_m.tolist()
    return InputError(
        f"{source}: expected positions in metres east, north, up of the anchor, found ({x:.0f}, {y:.0f}, {z:.0f})",
        hint="are these coordinates of a map projection, or from the middle of the Earth? Bring them into the "
        "frame of the anchor first",
    )


def _check_is_enu(mean_up: Floats, source: str) -> None:
    """Refuse poses that somebody says are east, north, up, but whose cameras' own mean up (3, unit length) is not z."""
    if mean_up[2] < math.cos(_MAX_TILT_FROM_ENU_RAD):
        x, y, z = mean_up
        raise InputError(
            f"{source}: with an anchor z is up, but the cameras' own up is ({x:.2f}, {y:.2f}, {z:.2f})",
            hint="bring the poses into the ENU frame of the anchor first (COLMAP: model_aligner "
            "--alignment_type enu), or leave the anchor away",
        )


def _check_steps(images: Images, source: str) -> None:
    """Refuse poses that cannot be in metres: all ranges and radii of the method are.

    A step is the way from an image to the nearest of its pass that is elsewhere, so that no order of them is assumed.
    """
    center_m = camera_centers(images)
    steps = []
    for code in range(len(images.pass_id.names)):
        # A car that waits says nothing about scale: its images are one place.
        places = np.unique((center_m[images.pass_id.codes == code] / STILL_M).round(), axis=0) * STILL_M
        if len(places) > 1:
            distance_m, _ = scipy.spatial.cKDTree(places).query(places, k=[2])
            steps.append(np.ravel(distance_m))
    if np.bincount(images.pass_id.codes).max() < 2:
        return
    median = float(np.median(np.concatenate(steps))) if steps else 0.0
    low, high = _PLAUSIBLE_STEP_M
    if not low <= median <= high:
        raise InputError(
            f"{source}: poses: expected metres, with a median step between neighbouring images of a pass from "
            f"{low:g} to {high:g}, found {median:.3g}",
            hint="scale the model to metres first, e.g. with COLMAP's model_aligner",
        )
