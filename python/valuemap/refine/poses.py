"""The stage: what is wrong with the poses of whole drives is found once, for all that comes after."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from threadpoolctl import threadpool_limits

from valuemap.arrays import Bools, Floats
from valuemap.camera_models import places_of_params
from valuemap.cameras import camera_poses
from valuemap.config import USUAL_RANGE_M, MapConfig, NoiseConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.drives import Drives, InOrder, in_driving_order
from valuemap.errors import SettingError
from valuemap.progress import Progress, silent
from valuemap.refine.alias import without_aliases
from valuemap.refine.delay import delay_alone
from valuemap.refine.estimate import (
    Estimate,
    Marks,
    Trajectories,
    begin,
    estimate_again,
    go_on,
    lay,
    mounts_alone,
    range_of,
)
from valuemap.refine.footage import (
    AllImages,
    Footage,
    find_steps,
    gather,
    in_working_frame,
    moved_on,
    points_in_working_frame,
    shown_objects,
    with_poses,
    with_poses_in_order,
)
from valuemap.refine.jumps import Hints, Segments, find_hints, find_jumps, mend
from valuemap.refine.landmarks import find_landmarks
from valuemap.refine.residuals import CAMERA_DELAY, CAMERA_MOUNT, DELAY, FOCAL, MOUNT, OFFSET, rotations
from valuemap.refine.select import Selected, select
from valuemap.robust import Calibration, Noise
from valuemap.tables import Labels, Votes

_SAMPLE = 4_000
"""So many detections, where most drives meet, tell whether anything is wrong."""
_PLACE = 3.0
"""Places of the sample are so many ranges wide."""
_LEAST_DETECTIONS = 50
_MOST_TURNS_OF_MOUNTS = 2
_LOST_M, _FEW_LOST = 0.5, 0.05
"""Where offsets are larger than this, each drive is looked at anew as it lies then."""
_SHARE_BELOW = 0.975
"""The share of errors below a bound that 95 % are within on either side."""


FITS_NO_BETTER = "the poses as given fit better"
"""Why nothing is corrected where faults are found that do not make the detections likelier by more than they cost."""


@dataclass(frozen=True, eq=False)
class Found:
    """What was estimated, from poses moved on by `late_s`, and what of it is proven."""

    late_s: float
    footage: Footage
    told: Trajectories
    result: Estimate
    selected: Selected | None


Mapped = tuple[Calibration, Labels, Votes, dict[str, Any]]
"""A map of a dataset: what was estimated before, labels, votes, and what was counted."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A dataset with better poses and cameras, or as it was; `record` says in `run.json` what was found.

    `price` is what the correction must make detections likelier by. `found` is what a map may tell more of: it was
    corrected, or is in doubt. Where `is_noisy`, single images are off by more than was thought possible.
    `before_images` is what errors of single images were taken from, where they were.
    `as_given` is the map of the dataset as it was, where one was made and nothing is corrected. `sought` is its noise,
    where it was compared with what could have been corrected. `side_m` is what the middles that sides show are off by,
    where that was told. `place_m2` is the covariance (3, 3) in the world of where all drives are together, where they
    were moved.
    """

    dataset: Dataset
    record: dict[str, Any]
    is_corrected: bool = False
    price: float = 0.0
    found: Found | None = None
    is_noisy: bool = False
    before_images: tuple[AllImages, Noise] | None = None
    as_given: Mapped | None = None
    sought: Noise | None = None
    side_m: float | None = None
    place_m2: Floats | None = None


def refine_poses(
    dataset: Dataset,
    config: MapConfig,
    *,
    threads: int = 0,
    progress: Progress = silent,
) -> Refined:
    """Estimate what whole drives' poses are wrong by, from the objects that drives see; correct what is proven.

    Parameters
    ----------
    dataset
        Posed images and detections.
    config
        Ranges and parallax as in mapping.
    threads
        Threads to work on, 0 for one a core. The result does not depend on it.
    progress
        Called as progress(what, done, total).

    Returns
    -------
    Refined
        Where nothing is proven, the dataset is the one that was given.
    """
    if not config.poses.correct_poses:
        return Refined(dataset, {"found": "nothing", "because": "correct_poses is 0"})
    if len(dataset.detections) < _LEAST_DETECTIONS:
        return Refined(dataset, {"found": "nothing", "because": "few detections"})
    with one_blas_thread():
        return _refined(dataset, config, threads, progress)


def one_blas_thread() -> threadpool_limits:
    """Return what limits all that multiplies matrices to one thread while it is entered.

    Matrices are small: more threads are slower, and how many there are would show in the last digits.
    """
    # SciPy has a BLAS of its own. It is loaded when it is first asked for, and only what is loaded can be limited.
    assert scipy.linalg.lapack
    return threadpool_limits(limits=1, user_api="blas")


def _refined(dataset: Dataset, config: MapConfig, threads: int, progress: Progress) -> Refined:
    unit_m = config.vote.unit_m
    ordered = in_driving_order(dataset, viewpoint_step_m=unit_m)
    ranges = replace(config.vote, max_range_m=USUAL_RANGE_M, min_range_m=config.vote.nearest_m / unit_m)
    config = replace(config, vote=ranges)
    moved, drives = in_working_frame(ordered.dataset, ordered.drives, unit_m)
    progress("comparing drives", 0, 2)
    sample = _sample(moved, drives)
    found = None
    if sample is not None:
        found = estimate_errors(*_part(moved, drives, sample), config, threads)
        progress("comparing drives", 1, 2)
    if sample is None:
        found = estimate_errors(moved, drives, config, threads)
    elif found is not None and found.selected is not None:
        found = estimate_errors(moved, drives, config, threads, late_s=found.late_s)
    progress("comparing drives", 2, 2)
    return _corrected(dataset, ordered, found, unit_m)


def refine_again(
    dataset: Dataset, refined: Refined, labels: Labels, votes: Votes, config: MapConfig, *, progress: Progress = silent
) -> Refined:
    """Estimate anew what poses of drives are wrong by, with the objects of a map of the dataset that was corrected.

    Landmarks of single drives are taken for each other where several lights stand beside each other, and then drives
    are laid onto each other wrongly, by less than lights are apart. A map knows better which detection shows which.

    Parameters
    ----------
    dataset
        What `refine_poses` was given.
    refined
        What it made of it.
    labels, votes
        A map of that.
    config
        Ranges as in mapping.
    progress
        Called as progress(what, done, total).

    Returns
    -------
    Refined
        Where nothing was corrected, or nothing is proven with these objects, it is what was given.
    """
    before = refined.found
    if before is None or before.selected is None or not len(labels):
        return refined
    progress("comparing drives", 0, 1)
    with one_blas_thread():
        unit_m = config.vote.unit_m
        ordered = in_driving_order(dataset, viewpoint_step_m=unit_m)
        footage = before.footage
        detection, thing, kinds, first = shown_objects(footage, ordered, labels, votes)
        if not len(detection):
            return refined
        points = points_in_working_frame(ordered.dataset, labels.position_in_world_m[kinds], unit_m)
        start = replace(
            before.result,
            detection=detection,
            thing=thing,
            class_code=footage.rays.class_code[detection[first]].astype(np.int64),
            size_m=np.full(len(kinds), np.nan),
            state=replace(before.selected.state, point_in_world_m=points),
        )
        result = estimate_again(footage, start, before.told)
        after = replace(before, result=result, selected=select(footage, result))
        progress("comparing drives", 1, 1)
        again = _corrected(dataset, ordered, after, unit_m)
        return again if again.is_corrected else refined


def keyframes_of(dataset: Dataset, refined: Refined, config: MapConfig) -> Dataset:
    """Return the images, with their detections, that poses were estimated with, as they were corrected.

    `dataset` is what `refine_poses` was given. It needs that something was corrected.
    """
    found = refined.found
    assert found is not None
    assert found.selected is not None
    unit_m = config.vote.unit_m
    ordered = in_driving_order(dataset, viewpoint_step_m=unit_m)
    shown = refined.dataset if refined.is_corrected else _moved(dataset, ordered, found, found.selected, unit_m)
    image_id = ordered.image_id[found.footage.row]
    return replace(
        shown,
        images=shown.images.take(np.flatnonzero(np.isin(shown.images.image_id, image_id))),
        detections=shown.detections.take(np.isin(shown.detections.image_id, image_id)),
        truth_detections=None,
    )


def noise_left(refined: Refined, config: MapConfig) -> NoiseConfig:
    """Return what detections of corrected poses are off by, as `refine_poses` found it; what is set stays as it is.

    Drift is as large as it is thought to be, and not as it was found: drives that were laid onto each other wrongly
    are what a map is to tell.
    """
    assert refined.found is not None
    noise, scales = refined.found.result.noise, refined.found.result.scales
    unit_m = config.vote.unit_m
    given = config.noise
    turned_rad = math.hypot(scales.own_rad, scales.drift_rad)
    left = (noise.px, unit_m * math.hypot(noise.image_m, scales.drift_m), math.degrees(turned_rad))
    names = ("detection_sigma_px", "position_sigma_m", "rotation_sigma_deg")
    return replace(given, **{n: value for n, value in zip(names, left, strict=True) if getattr(given, n) is None})


def _corrected(dataset: Dataset, ordered: InOrder, found: Found | None, unit_m: float) -> Refined:
    """Return a dataset corrected by what was proven of it `ordered`; as it is where nothing was."""
    is_noisy = found is not None and found.result.noise.is_larger_than_thought(found.footage.box_px)
    if found is None or found.selected is None:
        return Refined(dataset, {"found": "nothing", **_looked_at(found)}, is_noisy=is_noisy)
    if not found.selected.is_proven:
        return Refined(dataset, {"found": "nothing", **_looked_at(found)}, found=found, is_noisy=is_noisy)
    record = {**_describe(ordered.dataset, found, found.selected, unit_m), **_looked_at(found)}
    moved = _moved(dataset, ordered, found, found.selected, unit_m)
    sigma_m, price = _mean_of_drives_sigma_m(found, found.selected, unit_m), found.selected.price
    if sigma_m is None:
        return Refined(moved, record, is_corrected=True, price=price, found=found, is_noisy=is_noisy)
    record["mean_of_drives_sigma_east_north_up_m"] = [round(float(sigma), 4) for sigma in sigma_m]
    axes = dataset.frame.east_north_up()
    place_m2 = np.asarray(axes.T @ np.diag(sigma_m**2) @ axes)
    return Refined(moved, record, is_corrected=True, price=price, found=found, is_noisy=is_noisy, place_m2=place_m2)


def _mean_of_drives_sigma_m(found: Found, selected: Selected, unit_m: float) -> Floats | None:
    """Return how far all drives are off together, east, north and up, m (3); None where no drive was moved.

    They are where their mean is, which is as far off as one of them over the square root of their number. How far off
    one is is told by how far they were moved, and by what drives drift by besides. Few drives hardly tell it: the
    variance is that of the Gaussian that has as much beyond 95 % as Student's t.
    """
    is_moved = selected.active[OFFSET].any(axis=1)
    if not is_moved.any():
        return None
    drift_m = found.result.scales.drift_m * unit_m
    return sigma_of_mean_m(selected.state.constants[OFFSET][is_moved] * unit_m, drift_m)


def sigma_of_mean_m(offset_m: Floats, drift_m: float) -> Floats:
    """Return the standard deviations of the mean of drives, m (3), by the offsets (N, 3) of their parts, m."""
    offset_m, parts = _moved_alike(offset_m, drift_m)
    share = parts / parts.sum()
    free = max(len(parts) - 1, 1)
    east_m2, north_m2, up_m2 = share @ offset_m**2 * len(parts) / free
    level_m2 = (east_m2 + north_m2) / 2  # A few drives do not tell in which direction they are off more.
    widened = scipy.special.stdtrit([2 * free, 2 * free, free], _SHARE_BELOW) / scipy.special.ndtri(_SHARE_BELOW)
    variance_m2 = np.array([level_m2, level_m2, up_m2]) * widened**2 + drift_m**2
    return np.asarray(np.sqrt(variance_m2 * (share @ share)))


def _moved_alike(offset_m: Floats, drift_m: float) -> tuple[Floats, Floats]:
    """Return the mean offsets (R, 3) of runs of parts of drives (N, 3) that were moved alike, and how many each has.

    A pass is cut wherever it comes back to a street. Its parts follow each other and are off by the same: they are no
    farther from each other than two that drift are on each axis in 95 % of the cases.
    """
    apart_m = scipy.special.ndtri(_SHARE_BELOW) * math.sqrt(2.0) * drift_m
    is_new = np.any(np.abs(np.diff(offset_m, axis=0)) > apart_m, axis=1)
    run = np.concatenate([[0], np.cumsum(is_new)])
    count = np.bincount(run)
    sums = np.column_stack([np.bincount(run, weights=axis) for axis in offset_m.T])
    return sums / count[:, None], count.astype(np.float64)


def _moved(dataset: Dataset, ordered: InOrder, found: Found, selected: Selected, unit_m: float) -> Dataset:
    """Return a dataset, with its poses and cameras corrected by what was selected of it `ordered`."""
    images, drives = ordered.dataset.images, ordered.drives
    offset, mount, delay, focal, camera_mount, camera_delay = selected.state.constants
    drive, camera = drives.pass_code, rows_of(images.camera_id, dataset.cameras.camera_id)
    segment = found.result.segments.of(drive, drives.order)
    rotation, center = camera_poses(images)
    late_s = delay[drive, 0] + camera_delay[camera, 0]
    rotation, center = moved_on(find_steps(ordered.dataset, drives).motion(late_s), rotation, center, late_s)
    center = center + unit_m * offset[segment] @ dataset.frame.east_north_up()
    rotation = rotations(mount[drive] + camera_mount[camera]) @ rotation
    params = []
    for row, model in enumerate(dataset.cameras.model.texts()):
        values = dataset.cameras.params[row].copy()
        values[places_of_params(model)[0]] *= 1.0 + focal[row, 0]
        params.append(values)
    return replace(
        dataset,
        images=with_poses_in_order(dataset.images, ordered, rotation, center),
        cameras=dataset.cameras.replace(params=params),
    )


def estimate_errors(
    dataset: Dataset, drives: Drives, config: MapConfig, threads: int, *, late_s: float | None = None
) -> Found | None:
    """Estimate on a dataset in the working frame; where drives are far off, with landmarks of drives laid right.

    Poses that are late are moved on first, as one thing seen from two sides is two else. Then cameras askew are turned,
    drive by drive, as what drives see is turned about them else and fits nowhere. `late_s` is None where it is not
    known.
    """
    footage = gather(dataset, drives)
    proven = mend(dataset, drives)
    known = (proven.segments, proven.offset_m)
    try:
        seen = _straightened(footage, known, late_s, config, threads)
    except SettingError:  # So many detections in one place that their votes fill the memory.
        return None
    if seen.marks is None:
        return None
    told = Trajectories(seen.jumps, seen.hints, proven)
    if seen.late_s:
        # Mean rates of steps in which turns begin are none of a delay: focal lengths took what they left.
        footage = replace(footage, late_s=seen.late_s)

    def begun(marks: Marks, known: tuple[Segments, Floats]) -> Estimate | None:
        return begin(footage, marks, config, told, known=known, turned_rad=seen.turned_rad, late_s=seen.late_s)

    first = begun(seen.marks, known)
    if first is None:
        return None
    if _is_lost(footage, first):
        known = (first.segments, first.state.constants[OFFSET])
        laid = moved_footage(footage, seen.turned_rad, seen.late_s, known)
        segment = laid.drives.pass_code  # Its jumps are mended.
        try:
            landmarks = find_landmarks(laid.dataset, laid.rays, laid.drives, segment, config, threads=threads)
        except SettingError:
            return None
        marks = lay(landmarks, laid, seen.hints)
        again = None if marks is None else begun(marks, known)
        if again is not None and len(again.thing) >= len(first.thing):
            first = again
    result = go_on(footage, first, config, told)
    if result is None:
        return None
    result = without_aliases(footage, result, range_of(config))
    return Found(seen.late_s, footage, told, result, select(footage, result))


@dataclass(frozen=True, eq=False)
class _Straightened:
    """What drives are off by at first sight, and the landmarks, if they do, that they see once that is taken back.

    Cameras of drives are askew by `turned_rad` (D, 3), and poses `late_s`. `jumps` and `hints` are those of
    trajectories whose proven jumps are mended.
    """

    turned_rad: Floats
    late_s: float
    jumps: Segments
    hints: Hints
    marks: Marks | None


def _straightened(
    footage: Footage, known: tuple[Segments, Floats], late_s: float | None, config: MapConfig, threads: int
) -> _Straightened:
    """Move poses that are late on, then turn cameras that are askew; segments are `known` to be off by offsets, m.

    Raises
    ------
    SettingError
        So many detections are in one place that their votes fill the memory.
    """
    drives = footage.whole_drives
    turned = np.zeros((drives.count, 3))
    laid = moved_footage(footage, turned, 0.0, known) if len(known[0]) > drives.count else footage
    # What is left once the jumps that trajectories prove are taken back.
    jumps, hints = find_jumps(laid.whole, laid.whole_drives), find_hints(laid.whole, laid.whole_drives)
    segment = jumps.of(laid.drives.pass_code, laid.drives.order)
    if late_s is None:
        late_s = delay_alone(lambda s: moved_footage(footage, turned, s, known), segment, config, threads=threads)
    if late_s:
        laid = moved_footage(footage, turned, late_s, known)
    landmarks = find_landmarks(laid.dataset, laid.rays, laid.drives, segment, config, threads=threads)
    for _ in range(_MOST_TURNS_OF_MOUNTS):
        more = mounts_alone(laid, landmarks)
        if not more.any():
            break
        turned = turned + more
        laid = moved_footage(footage, turned, late_s, known)
        landmarks = find_landmarks(laid.dataset, laid.rays, laid.drives, segment, config, threads=threads)
    return _Straightened(turned, late_s, jumps, hints, lay(landmarks, laid, hints))


def _is_lost(footage: Footage, result: Estimate) -> bool:
    """Return whether more than few of the observations are of segments that are far from where most are."""
    image = footage.rays.image_row[result.detection]
    segment = result.segments.of(footage.drives.pass_code[image], footage.drives.order[image])
    offset = result.state.constants[OFFSET][segment]
    far = np.linalg.norm(offset - np.median(offset, axis=0), axis=1) > _LOST_M
    return bool(np.mean(far) > _FEW_LOST)


def moved_footage(
    footage: Footage, turned_rad: Floats, late_s: float = 0.0, known: tuple[Segments, Floats] | None = None
) -> Footage:
    """Return the footage with cameras of drives (D, 3) turned, all poses moved on, and segments moved, as they seem."""
    images, drives = footage.whole.images, footage.whole_drives
    rotation, center = camera_poses(images)
    if late_s:
        late = np.full(len(center), late_s)
        rotation, center = moved_on(footage.steps.motion(late), rotation, center, late)
    rotation = rotations(turned_rad[drives.pass_code]) @ rotation
    if known is not None:
        center = center + known[1][known[0].of(drives.pass_code, drives.order)]
    return gather(replace(footage.whole, images=with_poses(images, rotation, center)), drives)


def _sample(dataset: Dataset, drives: Drives) -> Bools | None:
    """Return the images (N) of the places where most drives meet, None where all are few enough.

    Of drives that only touch these places there are none: what a few images show of one fits in many places.
    """
    images = dataset.images
    image_row = rows_of(dataset.detections.image_id, images.image_id)
    if len(image_row) <= 2 * _SAMPLE:
        return None
    _, center = camera_poses(images)
    cell = np.floor(center[:, :2] / (_PLACE * USUAL_RANGE_M)).astype(np.int64)
    _, place = np.unique(cell, axis=0, return_inverse=True)
    place = place.ravel()
    pairs = np.unique(np.stack([place, drives.pass_code]), axis=1)
    met = np.bincount(pairs[0], minlength=int(place.max()) + 1)
    detections = np.bincount(place[image_row], minlength=len(met))
    order = np.lexsort((np.arange(len(met)), -detections, -met))
    enough = int(np.searchsorted(np.cumsum(detections[order]), _SAMPLE)) + 1
    chosen = np.isin(place, order[:enough])
    told = chosen & ~_only_touched(chosen, drives)[drives.pass_code]
    return told if told.any() else chosen


def _only_touched(chosen: Bools, drives: Drives) -> Bools:
    """Return of which drives (D) the chosen images (N) show less than an object is seen from, and not all."""
    first, last = np.full(drives.count, np.inf), np.full(drives.count, -np.inf)
    np.minimum.at(first, drives.pass_code[chosen], drives.driven_m[chosen])
    np.maximum.at(last, drives.pass_code[chosen], drives.driven_m[chosen])
    left_out = np.bincount(drives.pass_code[~chosen], minlength=drives.count)
    return np.asarray((last - first < USUAL_RANGE_M) & (left_out > 0))


def _part(dataset: Dataset, drives: Drives, chosen: Bools) -> tuple[Dataset, Drives]:
    """Return some images with their detections, and their drives, numbered anew."""
    row = np.flatnonzero(chosen)
    image_row = rows_of(dataset.detections.image_id, dataset.images.image_id)
    part = drives.take(row)
    part = replace(part, pass_code=np.unique(part.pass_code, return_inverse=True)[1])
    detections = dataset.detections.take(chosen[image_row])
    return replace(dataset, images=dataset.images.take(row), detections=detections, truth_detections=None), part


def _looked_at(found: Found | None) -> dict[str, Any]:
    if found is None:
        return {"landmarks": 0, "shared_objects": 0}
    return {"landmarks": found.result.landmarks, "shared_objects": len(found.result.class_code)}


def _describe(dataset: Dataset, found: Found, selected: Selected, unit_m: float) -> dict[str, Any]:
    """Return what was found, by camera and by drive: corrections with their standard deviations."""
    names, footage, result = dataset.images.pass_id.names, found.footage, found.result
    drives = footage.whole_drives
    first = np.unique(drives.pass_code, return_index=True)[1]
    cameras = [
        {
            "camera_id": int(dataset.cameras.camera_id[row]),
            **_figures(selected, FOCAL, row, "focal_length_factor", 1.0, plus=1.0),
            **_figures(selected, CAMERA_MOUNT, row, "turned_deg", np.degrees(1.0)),
            **_figures(selected, CAMERA_DELAY, row, "delay_s", 1.0),
        }
        for row in range(len(dataset.cameras))
    ]
    of_drives = []
    for drive, image in enumerate(first.tolist()):
        segments = np.flatnonzero(result.segments.drive == drive)
        of_drive = {
            **_figures(selected, MOUNT, drive, "turned_deg", np.degrees(1.0)),
            **_figures(selected, DELAY, drive, "delay_s", 1.0),
        }
        moved = [
            {"from_image": _image_at(footage, drive, int(result.segments.begins[segment])), **figures}
            for segment in segments.tolist()
            if (figures := _figures(selected, OFFSET, segment, "moved_m", unit_m))
        ]
        if of_drive or moved:
            name = names[dataset.images.pass_id.codes[image]]
            of_drives.append({"drive": drive, "pass": name, **of_drive, **({"segments": moved} if moved else {})})
    return {
        "found": "faults",
        "cameras": [camera for camera in cameras if len(camera) > 1],
        "drives": of_drives,
        "parameters": selected.parameters,
        "held_out_objects": selected.held_out,
        "gain_on_held_out": round(selected.gain, 1),
        "chance_of_that": float(f"{selected.chance:.2g}"),
    }


def _image_at(footage: Footage, drive: int, order: int) -> str:
    drives = footage.whole_drives
    row = int(np.flatnonzero((drives.pass_code == drive) & (drives.order >= order))[0])
    return str(footage.whole.images.name[row].as_py())


def _figures(selected: Selected, kind: int, row: int, name: str, factor: float, plus: float = 0.0) -> dict[str, Any]:
    """Return one correction and its deviation, nothing where it is zero."""
    if not selected.active[kind][row].any():
        return {}
    values = selected.state.constants[kind][row] * factor + plus
    deviation = selected.deviation[kind][row] * factor
    shown = [round(float(v), 5) for v in values], [round(float(v), 5) for v in deviation]
    if len(values) == 1:
        return {name: shown[0][0], f"{name}_sigma": shown[1][0]}
    return {name: shown[0], f"{name}_sigma": shown[1]}
