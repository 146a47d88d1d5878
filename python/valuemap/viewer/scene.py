"""What the page shows: a map, the dataset it was made from, truth and rejected hypotheses, as far as they are there.

Everything is sent in local coordinates: metres to the east, to the north and up from an origin near the labels, so that
the browser's 32-bit numbers are exact to a millimetre whatever frame the data is in.
"""

from __future__ import annotations

import math
import threading
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Floats
from valuemap.cameras import rotation_matrices
from valuemap.dataset import read_dataset
from valuemap.errors import InputError
from valuemap.evaluate import Evaluation, evaluate_map
from valuemap.evaluate.objects_file import check_objects_file
from valuemap.evidence import PICTURES, Evidence, find_dataset
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import read_map
from valuemap.tables.covariance import covariance_matrices
from valuemap.viewer.columns import pack_columns

OUTCOMES = ("", "true", "duplicate", "false", "gone", "found", "missed", "not recoverable")
"""What became of labels and true objects, as numbers for the page."""

_GAP_STEPS = 6.0
"""Successive images of a pass farther apart than so many median steps are not joined by a line."""


class Scene:
    """A map with all that is known about it; read once, never changed.

    Parameters
    ----------
    map_folder
        Folder that `valuemap map` wrote.
    dataset_folder
        The dataset it was made from; found by itself where not given (`find_dataset`).
    pictures
        Folder of the pictures; images in the dataset where not given.
    truth
        A dataset with truth or a file of objects; the truth of the dataset where not given.

    Raises
    ------
    InputError
        Map or dataset cannot be used, or do not belong together.
    """

    def __init__(
        self,
        map_folder: Path,
        *,
        dataset_folder: Path | None = None,
        pictures: Path | None = None,
        truth: Path | None = None,
    ) -> None:
        self.folder = map_folder
        self.result = read_map(map_folder)
        self.notes: list[str] = []
        self.evidence = self._find_evidence(dataset_folder)
        self.pictures = self._find_pictures(pictures)
        if truth is not None and not truth.is_dir():
            check_objects_file(truth, "truth", "a dataset folder or ")
        self._truth = truth
        self.rejected = self.result.rejected
        self.lock = threading.Lock()
        """Held while something about the evidence is computed, so that nothing is computed twice at once."""
        frame = self.result.frame
        self.local_from_world = frame.east_north_up()
        """East, north and up as unit vectors (3, 3) in the world."""
        self.origin_in_world_m = self._origin()
        """The point (3) in the world that is 0, 0, 0 on the page."""

    def _find_evidence(self, given: Path | None) -> Evidence | None:
        folder = find_dataset(self.folder, self.result.run, given)
        if folder is None:
            self.notes.append("The dataset of this map was not found, so there are no cameras, votes or pictures.")
            return None
        self.dataset_folder = folder
        try:
            return Evidence(self.result, read_dataset(folder))
        except InputError as error:
            if given is not None:
                raise
            self.notes.append(f"The dataset {folder.name} beside this map cannot be used: {error}.")
            return None

    def _find_pictures(self, given: Path | None) -> Path | None:
        if given is not None:
            if not given.is_dir():
                raise InputError(f"{given}: is not a folder", hint="give the folder that holds the pictures")
            return given
        if self.evidence is None:
            return None
        folder = self.dataset_folder / PICTURES
        if folder.is_dir():
            return folder
        self.notes.append("There are no pictures in the dataset: boxes are shown on empty frames.")
        return None

    def _origin(self) -> Floats:
        if self.result.frame.is_georeferenced:
            return np.zeros(3)
        points = self.result.labels.position_in_world_m
        if not len(points) and self.evidence is not None:
            points = self.evidence.center_in_world_m
        return np.round(np.median(points, axis=0)) if len(points) else np.zeros(3)

    # Between the world and the page

    def local(self, point_in_world_m: Floats) -> Floats:
        """Return points (N, 3) of the world as metres east, north and up on the page."""
        return np.asarray((point_in_world_m - self.origin_in_world_m) @ self.local_from_world.T)

    def world(self, local_m: Floats) -> Floats:
        """Return points (N, 3) of the page in the world."""
        return np.asarray(local_m @ self.local_from_world + self.origin_in_world_m)

    def lon_lat_height(self, point_in_world_m: Floats) -> list[float] | None:
        """Return where a point (3) is on WGS84, None where nobody knows."""
        anchor = self.result.frame.anchor
        if anchor is None:
            return None
        return [float(part) for part in lon_lat_height_from_enu(point_in_world_m[None], anchor)[0]]

    # What the page asks for when it opens

    def head(self) -> dict[str, Any]:
        """Return names, counts and what there is to show."""
        result, evidence = self.result, self.evidence
        anchor = result.frame.anchor
        return {
            "name": str(result.run.get("dataset", self.folder.name)),
            "folder": self.folder.absolute().name,
            "anchor": anchor and {"lat": anchor[0], "lon": anchor[1], "height": anchor[2]},
            "origin": [float(c) for c in self.local_from_world @ self.origin_in_world_m],
            "classes": list(result.labels.class_name.names),
            "passes": self._passes(),
            "counts": {
                "labels": int(np.sum(result.is_there)),
                "gone": int(np.sum(~result.is_there)),
                "images": 0 if evidence is None else len(evidence.dataset.images),
                "detections": 0 if evidence is None else len(evidence.dataset.detections),
            },
            "has": {
                "dataset": evidence is not None,
                "pictures": self.pictures is not None,
                "truth": self._truth is not None or (evidence is not None and evidence.dataset.truth is not None),
                "rejected": self.rejected is not None,
                "existence": result.labels.existence is not None,
            },
            "rejected": None
            if self.rejected is None
            else {"classes": list(self.rejected.class_name.names), "reasons": list(self.rejected.reason.names)},
            "outcomes": list(OUTCOMES),
            "states": [] if result.labels.state is None else list(result.labels.state.names),
            "method": str(result.run.get("settings", {}).get("method", "")),
            "version": str(result.run.get("valuemap", "")),
            "notes": self.notes,
        }

    def _passes(self) -> list[dict[str, Any]]:
        if self.evidence is None:
            return []
        number = self.evidence.pass_number
        _, first, count = np.unique(number, return_index=True, return_counts=True)
        return [
            {"name": self.evidence.pass_name(int(row)), "images": int(images)}
            for row, images in zip(first, count, strict=True)
        ]

    @cached_property
    def labels_body(self) -> bytes:
        """The labels as columns."""
        labels = self.result.labels
        covariance = covariance_matrices(labels.stated_covariance_m2)
        covariance = self.local_from_world @ covariance @ self.local_from_world.T
        return pack_columns(
            {
                "id": labels.label_id.astype(np.float64),
                "position": self.local(labels.position_in_world_m).astype(np.float32),
                "ellipse": _ellipses(covariance[:, :2, :2]).astype(np.float32),
                "sigma_up": np.sqrt(np.maximum(covariance[:, 2, 2], 0.0)).astype(np.float32),
                "class": labels.class_name.codes.astype(np.int32),
                "state": np.full(len(labels), -1, np.int32)
                if labels.state is None
                else labels.state.codes.astype(np.int32),
                "votes": labels.votes.astype(np.int32),
                "passes": labels.passes.astype(np.int32),
                "expected": (np.full(len(labels), -1) if labels.expected is None else labels.expected).astype(np.int32),
                "existence": (
                    np.full(len(labels), np.nan, np.float32)
                    if labels.existence is None
                    else labels.existence.astype(np.float32)
                ),
                "rms_px": labels.reprojection_rms_px.astype(np.float32),
                "facing": np.stack([labels.facing_azimuth_rad, labels.facing_concentration], axis=1).astype(np.float32),
            }
        )

    @cached_property
    def cameras_body(self) -> bytes:
        """The images in the order of the drives, as columns; `joined` says that a line leads on to the next."""
        evidence = self.evidence
        if evidence is None:
            return pack_columns({"position": np.empty((0, 3), np.float32)})
        order = np.argsort(evidence.drive_order)
        images = evidence.dataset.images
        position = self.local(evidence.center_in_world_m[order])
        number = evidence.pass_number[order]
        forward = rotation_matrices(images)[order][:, 2] @ self.local_from_world.T
        joined = np.zeros(len(order), np.uint8)
        step = np.linalg.norm(np.diff(position, axis=0), axis=1)
        same = np.diff(number) == 0
        moving = step[same & (step > 0.0)]
        joined[:-1] = same & (step <= _GAP_STEPS * float(np.median(moving) if len(moving) else 0.0))
        return pack_columns(
            {
                "position": position.astype(np.float32),
                "heading": np.arctan2(forward[:, 1], forward[:, 0]).astype(np.float32),
                "pass": number.astype(np.int32),
                "joined": joined,
            }
        )

    @cached_property
    def rejected_body(self) -> bytes:
        """The rejected hypotheses as columns."""
        rejected = self.rejected
        if rejected is None:
            return pack_columns({"position": np.empty((0, 3), np.float32)})
        return pack_columns(
            {
                "position": self.local(rejected.position_in_world_m).astype(np.float32),
                "class": rejected.class_name.codes.astype(np.int32),
                "reason": rejected.reason.codes.astype(np.int32),
                "votes": rejected.votes.astype(np.int32),
            }
        )

    @cached_property
    def truth_body(self) -> bytes:
        """The true objects, and what became of them and of the labels (numbers of OUTCOMES), as columns."""
        evaluation = self._evaluation()
        if evaluation is None:
            return pack_columns({"position": np.empty((0, 3), np.float32)})
        matches = evaluation.matches
        position = np.nan_to_num(self.local(matches.object_in_world_m))
        return pack_columns(
            {
                "position": position.astype(np.float32),
                "id": matches.objects.object_id.astype(np.float64),
                "outcome": _outcomes(matches.object_outcome.texts()),
                "label_outcome": _outcomes(matches.label_outcome.texts()),
            }
        )

    def _evaluation(self) -> Evaluation | None:
        if self._truth is not None:
            return evaluate_map(self.result, self._truth)
        if self.evidence is None or self.evidence.dataset.truth is None:
            return None
        return evaluate_map(self.result, self.evidence.dataset)


def _ellipses(covariance: Floats) -> Floats:
    """Return major and minor standard deviation and the angle (N, 3), in radians from the first axis, of (N, 2, 2)."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    middle, spread = (a + c) / 2.0, np.hypot((a - c) / 2.0, b)
    major, minor = np.sqrt(np.maximum(middle + spread, 0.0)), np.sqrt(np.maximum(middle - spread, 0.0))
    return np.stack([major, minor, 0.5 * np.arctan2(2.0 * b, a - c)], axis=1)


def _outcomes(texts: list[str]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.array([OUTCOMES.index(text) for text in texts], dtype=np.uint8)


def number(value: Any, digits: int = 4) -> float | None:
    """Return a number for JSON, which has no NaN; rounded, because people read it."""
    value = float(value)
    return round(value, digits) if math.isfinite(value) else None


def numbers(values: Floats, digits: int = 4) -> list[Any]:
    """Return what `number` does of every value of an array, in lists of lists as deep as its axes."""
    rounded: Any = np.round(values, digits)
    finite = np.isfinite(rounded)
    if not finite.all():
        rounded = rounded.astype(object)
        rounded[~finite] = None
    found: list[Any] = rounded.tolist()
    return found
