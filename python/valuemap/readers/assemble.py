"""What all readers end with: number the detections, settle the frame, and pass the checks at the door."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.dataset import Dataset, Frame, check_dataset
from valuemap.errors import InputError, SettingError
from valuemap.tables import Cameras, Categories, Detections, Floats, Images, Ints

ONE_PASS = "all"
"""The pass of images about whose passes nothing is known."""

_PLAUSIBLE_STEP_M = (1e-3, 1e3)
_STILL_M = 1e-6
_MIN_MEAN_UP = 0.1
_MAX_TILT_FROM_ENU_RAD = math.radians(60.0)


def number_detections(
    image_id: Ints,
    class_names: Sequence[str],
    center_px: Floats,
    size_px: Floats,
    score: Floats,
    detection_id: Ints | None = None,
) -> Detections:
    """Return detections of boxes in any order.

    Parameters
    ----------
    image_id, class_names, score
        One a box (N).
    center_px, size_px
        Centre and size (N, 2) in pixels, centre of the top-left pixel at (0.5, 0.5).
    detection_id
        Distinct ids (N). Without them the boxes are numbered from 0 by image, place, size, class and score,
        so that the numbers do not depend on the order of the boxes.
    """
    classes = Categories.from_texts(class_names)
    if detection_id is None:
        order = np.lexsort((score, classes.codes, *size_px.T, *center_px.T, image_id))
        ids: Ints = np.arange(len(order), dtype=np.int64)
    else:
        order = np.argsort(detection_id)
        ids = detection_id[order]
    return Detections(
        detection_id=ids,
        image_id=image_id[order],
        class_name=classes.take(order),
        center_px=center_px[order],
        size_px=size_px[order],
        score=score[order],
    )


def assemble(
    *,
    name: str,
    cameras: Cameras,
    images: Images,
    detections: Detections,
    up: tuple[float, float, float] | None,
    anchor: tuple[float, float, float] | None,
    source: str,
) -> Dataset:
    """Return the checked dataset of what a reader found.

    Parameters
    ----------
    up
        The direction up in the frame of the poses, of any length; None for the mean of the cameras' own.
    anchor
        WGS84 latitude, longitude (degrees) and ellipsoidal height (m) of the origin, where the poses are in
        the ENU frame there already (x east, y north, z up, metres).
    source
        What errors name as the place of the data.

    Raises
    ------
    SettingError
        `up` or `anchor` is impossible, or both are given.
    InputError
        The tables are inconsistent, the poses cannot be metric, have no mean up, or contradict `anchor`.
    """
    unframed = Dataset(name=name, frame=Frame(), cameras=cameras, images=images, detections=detections)
    dataset = check_dataset(unframed, source=source)
    _check_steps(dataset.images, source)
    return dataclasses.replace(dataset, frame=_frame(dataset.images, up, anchor, source))


def _frame(
    images: Images,
    up: tuple[float, float, float] | None,
    anchor: tuple[float, float, float] | None,
    source: str,
) -> Frame:
    if up is not None and anchor is not None:
        raise SettingError("up and anchor: expected at most one", hint="with an anchor, up is +z: leave up away")
    if up is not None:
        length = math.hypot(*up)
        if not (math.isfinite(length) and length > 0.0):
            raise SettingError(f"up: expected a direction, found {up}", hint="for example 0 -1 0 where y points down")
        return Frame(up=(up[0] / length, up[1] / length, up[2] / length))
    mean_up: Floats = -rotation_matrices(images)[:, 1].mean(axis=0)  # Camera axes: y down.
    length = float(np.linalg.norm(mean_up))
    if anchor is not None:
        _check_anchor(anchor, mean_up, length, source)
        return Frame(anchor=anchor)
    if length < _MIN_MEAN_UP:
        raise InputError(
            f"{source}: the cameras' own up directions cancel out (their mean has length {length:.2g})",
            hint="give up, the direction up in the frame of the poses, e.g. 0 0 1",
        )
    x, y, z = (mean_up / length).tolist()
    return Frame(up=(x, y, z))


def _check_anchor(anchor: tuple[float, float, float], mean_up: Floats, length: float, source: str) -> None:
    lat, lon, height = anchor
    if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and math.isfinite(height)):
        raise SettingError(
            f"anchor: expected latitude, longitude (degrees) and height (m), found {lat} {lon} {height}",
            hint="for example 52.3702 4.8952 43.0: latitude first",
        )
    if length >= _MIN_MEAN_UP and mean_up[2] / length < math.cos(_MAX_TILT_FROM_ENU_RAD):
        x, y, z = mean_up / length
        raise InputError(
            f"{source}: with an anchor z is up, but the cameras' own up is ({x:.2f}, {y:.2f}, {z:.2f})",
            hint="bring the poses into the ENU frame of the anchor first (COLMAP: model_aligner "
            "--alignment_type enu), or leave the anchor away",
        )


def _check_steps(images: Images, source: str) -> None:
    """Refuse poses that cannot be in metres: all ranges and radii of the method are."""
    order = np.lexsort((np.array(images.name.to_pylist()), images.pass_id.codes))
    same_pass = np.diff(images.pass_id.codes[order]) == 0
    step_m = np.linalg.norm(np.diff(camera_centers(images)[order], axis=0), axis=1)[same_pass]
    if not len(step_m):
        return
    moving = step_m[step_m > _STILL_M]  # A car that waits says nothing about scale.
    median = float(np.median(moving)) if len(moving) else 0.0
    low, high = _PLAUSIBLE_STEP_M
    if not low <= median <= high:
        raise InputError(
            f"{source}: poses: expected metres, with a median step between successive images of a pass from "
            f"{low:g} to {high:g}, found {median:.3g}",
            hint="scale the model to metres first, e.g. with COLMAP's model_aligner",
        )
