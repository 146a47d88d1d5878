"""One map against the truth: all figures of it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Bools, Floats
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, Frame, read_dataset
from valuemap.errors import SettingError, check_kind
from valuemap.evaluate.accuracy import PositionalAccuracy, measure_accuracy
from valuemap.evaluate.chance import ChanceFloor, measure_chance
from valuemap.evaluate.class_names import note_classes
from valuemap.evaluate.completeness import Completeness, measure_completeness
from valuemap.evaluate.figures import is_number, share, to_json
from valuemap.evaluate.matching import LABEL_OUTCOMES, Matches, match_labels
from valuemap.evaluate.recoverable import near_images
from valuemap.evaluate.reliability import ExistenceRange, measure_reliability
from valuemap.evaluate.truth import TrueObjects, positions_in_frame, true_objects
from valuemap.map_folder import Map, read_map
from valuemap.tables import Truth

_MEASURES = (
    "true_positives",
    "duplicates",
    "false_positives",
    "false_negatives",
    "recall",
    "precision",
    "position_rmse_m",
    "position_median_m",
    "horizontal_rmse_m",
    "vertical_rmse_m",
    "mean_reprojection_error_px",
)
"""The names that `valuemap evaluate --json` prints first, in this order."""


@dataclass(frozen=True)
class Evaluation:
    """Counts and errors of one map against the truth; NaN where there is nothing to measure.

    precision = true_positives / labels, so that duplicates cost; recall = recoverable objects found /
    recoverable_objects; false_negatives are the recoverable objects not found. Position errors are over the
    true positives, horizontal and vertical with respect to the up of the map's frame (root mean squares of
    lengths, so position² = horizontal² + vertical²). The reprojection error is the mean over all votes.
    """

    true_positives: int
    duplicates: int
    false_positives: int
    false_negatives: int
    recall: float
    precision: float
    position_rmse_m: float
    position_median_m: float
    horizontal_rmse_m: float
    vertical_rmse_m: float
    mean_reprojection_error_px: float
    labels: int
    objects: int
    recoverable_objects: int
    radius_m: float
    notes: tuple[str, ...]
    """What a reader of the numbers must know, e.g. that every object counts as recoverable."""
    accuracy: PositionalAccuracy
    completeness: Completeness
    chance: ChanceFloor
    reliability: tuple[ExistenceRange, ...] | None
    """None where the map has no probability of existence."""
    matches: Matches = field(repr=False, compare=False)

    def measures(self) -> dict[str, int | float | None]:
        """Return the measures of this class by name, None where there is nothing to measure."""
        return to_json({name: getattr(self, name) for name in _MEASURES})

    def to_json(self) -> dict[str, Any]:
        """Return all figures by name, None where there is nothing to measure."""
        return {
            **self.measures(),
            "accuracy": {"statement": self.accuracy.statement, **self.accuracy.to_json()},
            "completeness": self.completeness.to_json(),
            "chance": self.chance.to_json(),
            "reliability": None if self.reliability is None else [each.to_json() for each in self.reliability],
        }


def evaluate_map(
    result: Map | str | Path,
    truth: Dataset | Truth | str | Path,
    *,
    radius_m: float = 2.0,
    min_parallax_rad: float | None = None,
    truth_sigma_m: float | None = None,
    images: Dataset | str | Path | None = None,
    seen_within_m: float | None = None,
) -> Evaluation:
    """Compare a map with known objects.

    Parameters
    ----------
    result
        A map, or the folder of one.
    truth
        A dataset with truth or its folder, a table of objects in the frame of the map, or a file of objects
        (see `read_truth`).
    radius_m
        A label and an object farther apart than this are never matched.
    min_parallax_rad
        An object is recoverable if two images that detected it see it from directions that differ by at
        least this angle. Default: the `min_parallax_deg` that the map was made with.
    truth_sigma_m
        Standard deviation of the true positions on each axis, where it is known; the accuracy statement adds it.
    images
        The dataset that the map was made from, or its folder. Default: the truth, where that is a dataset.
    seen_within_m
        Objects farther than this from every image, horizontally, could not be seen and do not count in the recall.
        Default: distance does not matter.

    Raises
    ------
    InputError
        There is no truth, it cannot be read, or it or the images are in another frame than the map.
    SettingError
        The radius, the angle, the standard deviation or the distance is impossible, or there are no images for it.
    """
    check_kind(
        "map",
        result,
        (Map, str, Path),
        "a Map or its folder",
        hint="evaluate_map takes the map first, then the truth",
    )
    check_kind(
        "truth",
        truth,
        (Dataset, Truth, str, Path),
        "a Dataset with truth, a Truth, or the folder or file of one",
        hint="positions alone are a Truth of ids, classes and positions",
    )
    check_kind(
        "images",
        images,
        (Dataset, str, Path, type(None)),
        "a Dataset or its folder",
        hint="the dataset that the map was made from",
    )
    if isinstance(result, str | Path):
        result = read_map(result)
    is_there = result.is_there
    result = result if is_there.all() else result.take(is_there)
    objects = true_objects(truth, result, min_parallax_rad)
    notes = (*_note_gone(is_there), *_notes(objects), *note_classes(result.labels, objects))
    if seen_within_m is None and images is not None:
        raise SettingError(
            "images: mean nothing without seen-within, the distance at which objects can be seen",
            hint="give it too, as --seen-within 25",
        )
    if seen_within_m is not None:
        objects, note = _only_seen(objects, _images_of(truth, images), result.frame, seen_within_m)
        notes = (*notes, note)
    matches = match_labels(result.labels, objects, result.frame, radius_m=radius_m)
    evaluation = _measure(result, matches, radius_m, truth_sigma_m, notes)
    return dataclasses.replace(evaluation, matches=matches.among_all(is_there))


def _note_gone(is_there: Bools) -> tuple[str, ...]:
    gone = int(np.sum(~is_there))
    if not gone:
        return ()
    return (f"{gone} of {len(is_there)} labels are gone (valuemap update found nothing there) and do not count",)


def _images_of(truth: Dataset | Truth | str | Path, images: Dataset | str | Path | None) -> Dataset:
    """Return the dataset that says where the images are: the one given for that, else the truth."""
    source = truth if images is None else images
    if isinstance(source, str | Path) and (images is not None or Path(source).is_dir()):
        source = read_dataset(source)
    if not isinstance(source, Dataset):
        raise SettingError(
            "seen-within: the truth does not say where the images are",
            hint="name the dataset that the map was made from as images (--images)",
        )
    return source


def check_seen_within(seen_within_m: float) -> None:
    """Refuse a distance, in metres, at which objects can be seen, that is none (`SettingError`)."""
    if not (is_number(seen_within_m) and seen_within_m > 0.0):
        raise SettingError(f"seen-within: expected above 0 m, found {seen_within_m!r}", hint="for example 25")


def _only_seen(objects: TrueObjects, source: Dataset, frame: Frame, seen_within_m: float) -> tuple[TrueObjects, str]:
    """Take objects far from all images for ones that nobody can place; return them and what to say of it."""
    check_seen_within(seen_within_m)
    center = positions_in_frame(camera_centers(source.images), source, frame, what="the images are")
    is_near = near_images(objects.position_in_world_m, center, np.array(frame.up), seen_within_m)
    far = int(np.sum(~is_near))
    note = f"{far} of {len(objects)} objects lie farther than {seen_within_m:g} m from every image and do not count"
    return dataclasses.replace(objects, is_recoverable=objects.counts_in_recall & is_near), note


def _measure(
    result: Map, matches: Matches, radius_m: float, truth_sigma_m: float | None, notes: tuple[str, ...]
) -> Evaluation:
    objects = matches.objects
    found = matches.object_of_label >= 0
    offset = result.labels.position_in_world_m[found] - objects.position_in_world_m[matches.object_of_label[found]]
    vertical = offset @ np.array(result.frame.up)
    horizontal = np.linalg.norm(offset - vertical[:, None] * result.frame.up, axis=1)
    if not objects.has_height:
        vertical = np.full(len(vertical), np.nan)
    distance = np.hypot(horizontal, vertical)

    labels, true_positives = len(found), int(found.sum())
    recoverable = int(objects.counts_in_recall.sum())
    missed = int(np.sum(objects.counts_in_recall & (matches.label_of_object < 0)))
    accuracy = measure_accuracy(result.labels, matches, result.frame, truth_sigma_m=truth_sigma_m)
    outcomes = np.bincount(matches.label_outcome.codes, minlength=len(LABEL_OUTCOMES))
    return Evaluation(
        true_positives=true_positives,
        duplicates=int(outcomes[LABEL_OUTCOMES.index("duplicate")]),
        false_positives=int(outcomes[LABEL_OUTCOMES.index("false")]),
        false_negatives=missed,
        recall=share(recoverable - missed, recoverable),
        precision=share(true_positives, labels),
        position_rmse_m=_root_mean_square(distance),
        position_median_m=float(np.median(distance)) if true_positives else math.nan,
        horizontal_rmse_m=_root_mean_square(horizontal),
        vertical_rmse_m=_root_mean_square(vertical),
        mean_reprojection_error_px=float(result.votes.residual_px.mean()) if len(result.votes) else math.nan,
        labels=labels,
        objects=len(objects),
        recoverable_objects=recoverable,
        radius_m=radius_m,
        notes=(*notes, *_note_elsewhere(result, matches, radius_m), *accuracy.notes),
        accuracy=accuracy,
        completeness=measure_completeness(matches),
        chance=measure_chance(result.labels, objects, result.frame, radius_m=radius_m),
        reliability=measure_reliability(result.labels, matches),
        matches=matches,
    )


def _notes(objects: TrueObjects) -> tuple[str, ...]:
    notes = {
        "every true object counts as recoverable: the truth does not say which detections show it": (
            objects.is_recoverable is None
        ),
        "a label may match an object of any class: the truth has no classes": objects.class_name is None,
        "labels are matched horizontally, without vertical and 3D errors: the truth has no heights": (
            not objects.knows_height.any()
        ),
        "labels are matched horizontally, without vertical and 3D errors: not all of the truth has heights": (
            not objects.has_height and objects.knows_height.any()
        ),
    }
    return (*objects.notes, *_note_same(objects), *(note for note, applies in notes.items() if applies))


def _note_same(objects: TrueObjects) -> tuple[str, ...]:
    """Return what is told where rows of the truth are equal: one label can match one of them only."""
    code = np.zeros(len(objects)) if objects.class_name is None else objects.class_name.codes
    same = len(objects) - len(np.unique(np.column_stack([objects.position_in_world_m, code]), axis=0))
    if not same:
        return ()
    of_class = "" if objects.class_name is None else " of its class"
    return (f"{same} of {len(objects)} objects stand exactly where another{of_class} stands, and count like any other",)


def _note_elsewhere(result: Map, matches: Matches, radius_m: float) -> tuple[str, ...]:
    """Return what is told where no object is matched and all are far away, or all far above or below."""
    labels, objects = result.labels.position_in_world_m, matches.objects.position_in_world_m
    if not len(labels) or not len(objects) or np.any(matches.object_of_label >= 0):
        return ()
    from scipy.spatial import KDTree  # Slow to import, and only evaluation needs it.

    up = np.array(result.frame.up)
    on_ground = [place - np.outer(place @ up, up) for place in (labels, objects)]
    distance_m, nearest = (np.asarray(part) for part in KDTree(on_ground[1]).query(on_ground[0]))
    if distance_m.min() > _ELSEWHERE_M:
        return (
            f"the nearest true object is {distance_m.min() / 1000.0:.4g} km from a label: is the truth of this place, "
            "are x, y, z not those of a map projection, and are latitude and longitude not exchanged?",
        )
    beside = np.flatnonzero(distance_m <= radius_m)
    above_m = float(np.median((objects[nearest] - labels)[beside] @ up)) if len(beside) else 0.0
    if not matches.objects.has_height or abs(above_m) <= radius_m:
        return ()
    return (
        f"true objects are {abs(above_m):.1f} m {'above' if above_m > 0.0 else 'below'} the labels beside them: do the "
        "heights of both count from the ellipsoid?",
    )


_ELSEWHERE_M = 1000.0
"""Truth whose nearest object is farther from all labels is of another place: objects are seen from 100 m or so."""


def _root_mean_square(values: Floats) -> float:
    return math.sqrt(np.mean(values**2)) if len(values) else math.nan
