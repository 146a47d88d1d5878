"""Answers to clicks: what a label rests on, and why a place is empty."""

from __future__ import annotations

from typing import Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.errors import InputError
from valuemap.evidence import Evidence, Misses, PassingRays, pictures_there
from valuemap.rejected import figures_in_words, find_rejected
from valuemap.report.place_sheet import explain_place
from valuemap.report.style import number_of
from valuemap.tables import Rejected
from valuemap.tables.map import REJECTION_REASONS
from valuemap.viewer.scene import Scene, number, numbers

PLACE_RADIUS_M = 2.0
"""What is at most this far from a place, seen from above, answers why there is nothing."""
NEAR_LABELS_M = 10.0
"""How far around a place its labels are listed."""

_CROP_BOXES = 4.0
"""A crop shows this many times the larger side of a box, at least `_CROP_LEAST_PX`."""
_CROP_LEAST_PX = 48.0
_MOST_RAYS = 24
_MOST_LOOKS = 12


def label_details(scene: Scene, label_id: int) -> dict[str, Any]:
    """Return the numbers of a label, the images that voted for it and those that should have.

    Raises
    ------
    InputError
        There is no such label.
    """
    labels, evidence = scene.result.labels, scene.evidence
    row = int(np.searchsorted(labels.label_id, label_id))
    if row == len(labels) or labels.label_id[row] != label_id:
        raise InputError(f"there is no label {label_id} in the map", hint="its ids are in labels.parquet")
    position = labels.position_in_world_m[row]
    details: dict[str, Any] = {
        "id": label_id,
        "class": labels.class_name.names[labels.class_name.codes[row]],
        "state": None if labels.state is None else labels.state.names[labels.state.codes[row]],
        "position_m": [number(c) for c in position],
        "local_m": [number(c) for c in scene.local(position[None])[0]],
        "lon_lat_height": scene.lon_lat_height(position),
        "votes": int(labels.votes[row]),
        "passes": int(labels.passes[row]),
        "expected": None if labels.expected is None else int(labels.expected[row]),
        "existence": None if labels.existence is None else number(labels.existence[row], 6),
        "rms_px": number(labels.reprojection_rms_px[row], 2),
        "max_parallax_deg": number(np.degrees(labels.max_parallax_rad[row]), 1),
        "size_m": [number(labels.object_width_m[row], 2), number(labels.object_height_m[row], 2)],
        "facing_deg": number(np.degrees(labels.facing_azimuth_rad[row]), 0),
        "facing_concentration": number(labels.facing_concentration[row], 2),
        "first_seen_s": number(labels.first_seen_s[row], 1),
        "last_seen_s": number(labels.last_seen_s[row], 1),
        "voters": [],
        "misses": [],
    }
    if evidence is not None:
        with scene.lock:
            details["voters"] = _voters(scene, evidence, label_id)
            details["misses"] = _misses(
                scene, evidence, evidence.misses(label_id), typical_px=_typical_side(evidence, label_id)
            )
    return details


def place_details(scene: Scene, east_m: float, north_m: float) -> dict[str, Any]:
    """Return what is known about a place (metres on the page): why there is nothing, and the evidence for that."""
    labels, rejected, evidence = scene.result.labels, scene.rejected, scene.evidence
    place = np.array([east_m, north_m])
    if rejected is None and evidence is not None:  # Maps of large datasets keep none.
        with scene.lock:
            rejected = find_rejected(evidence, scene.world(np.array([[east_m, north_m, 0.0]]))[0])
    label_at = scene.local(labels.position_in_world_m)
    near_labels, label_m = _nearest(label_at, place, NEAR_LABELS_M)
    details: dict[str, Any] = {
        "kept": rejected is not None,
        "rejected": [],
        "labels": [
            {
                "id": int(labels.label_id[row]),
                "class": labels.class_name.names[labels.class_name.codes[row]],
                "state": None if labels.state is None else labels.state.names[labels.state.codes[row]],
                "away_m": number(away, 2),
            }
            for row, away in zip(near_labels, label_m, strict=True)
        ],
    }
    height = float(label_at[near_labels[0], 2]) if len(near_labels) else 0.0
    if rejected is not None:
        rejected_at = scene.local(rejected.position_in_world_m)
        rows, away_m = _nearest(rejected_at, place, PLACE_RADIUS_M)
        order = np.lexsort((away_m, -rejected.votes[rows]))  # The one with the most evidence says the most.
        details["rejected"] = [_hypothesis(rejected, int(rows[i]), float(away_m[i]), rejected_at) for i in order]
        height = float(rejected_at[rows[order[0]], 2]) if len(order) else height
    if evidence is not None:
        with scene.lock:
            seen, height = _seen_at(scene, evidence, rejected, place)
        details |= seen
    else:
        details["answer"] = _answer_without_dataset(details)
    world = scene.world(np.array([[east_m, north_m, height]]))[0]
    return details | {
        "local_m": [number(east_m), number(north_m), number(height)],
        "position_m": [number(c) for c in world],
        "lon_lat_height": scene.lon_lat_height(world),
    }


def _voters(scene: Scene, evidence: Evidence, label_id: int) -> list[dict[str, Any]]:
    voters = evidence.voters(label_id)
    return _rows(
        {
            **_images(scene, evidence, voters.image_row),
            "box": _boxes(voters.box_px, voters.size_px),
            "projected": numbers(voters.projected_px, 1),
            "crop": _crops(voters.box_px, _side(voters.size_px)),
            "residual_px": numbers(voters.residual_px, 2),
            "residual_sigmas": numbers(voters.residual_sigmas, 2),
            "score": numbers(voters.score, 3),
            "distance_m": numbers(voters.distance_m, 1),
        }
    )


def _misses(scene: Scene, evidence: Evidence, misses: Misses, *, typical_px: float) -> list[dict[str, Any]]:
    detections = evidence.dataset.detections
    nearest = misses.nearest_row
    is_near = (nearest >= 0) & (misses.nearest_px <= _CROP_LEAST_PX + typical_px)
    box: list[list[float | None] | None] = [None] * len(nearest)
    for i, found in zip(
        np.flatnonzero(is_near).tolist(),
        _boxes(detections.center_px[nearest[is_near]], detections.size_px[nearest[is_near]]),
        strict=True,
    ):
        box[i] = found
    return _rows(
        {
            **_images(scene, evidence, misses.image_row),
            "projected": numbers(misses.projected_px, 1),
            "crop": _crops(misses.projected_px, np.full(len(nearest), typical_px)),
            "distance_m": numbers(misses.distance_m, 1),
            "box": box,
            "nearest_px": numbers(misses.nearest_px, 1),
            "nearest_label": _ids(misses.nearest_label),
        }
    )


def _images(scene: Scene, evidence: Evidence, rows: Ints) -> dict[str, list[Any]]:
    """Return what the page says about images, whatever they show, column by column."""
    images = evidence.dataset.images
    names = images.name.take(rows).to_pylist()
    return {
        "image": images.image_id[rows].tolist(),
        "name": names,
        "pass": evidence.pass_number[rows].tolist(),
        "picture": pictures_there(scene.pictures, names),
        "size": evidence.picture_size_px(rows).tolist(),
        "camera_m": numbers(scene.local(evidence.center_in_world_m[rows]), 3),
        "time_s": [None] * len(rows) if images.timestamp_s is None else numbers(images.timestamp_s[rows], 2),
    }


def _rows(columns: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Return columns of the same length row by row."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _ids(label_id: Ints) -> list[int | None]:
    return [each if each >= 0 else None for each in label_id.tolist()]


def _side(size_px: Floats) -> Floats:
    """Return the sides (N) of the crops around boxes (N, 2); boxes may have no size."""
    return np.maximum(_CROP_LEAST_PX, _CROP_BOXES * np.fmax(np.fmax(size_px[:, 0], size_px[:, 1]), 0.0))


def _typical_side(evidence: Evidence, label_id: int) -> float:
    size_px = evidence.dataset.detections.size_px[evidence.detection_row[evidence.vote_rows(label_id)]]
    return float(np.median(_side(size_px))) if len(size_px) else _CROP_LEAST_PX


def _crops(center_px: Floats, side_px: Floats) -> list[list[float | None]]:
    return numbers(np.column_stack([center_px, side_px]), 1)


def _boxes(center_px: Floats, size_px: Floats) -> list[list[float | None]]:
    return numbers(np.column_stack([center_px, size_px]), 1)


def _nearest(local_m: Floats, place: Floats, radius_m: float) -> tuple[Ints, Floats]:
    away = np.linalg.norm(local_m[:, :2] - place, axis=1)
    rows = np.flatnonzero(away <= radius_m)
    rows = rows[np.argsort(away[rows], kind="stable")]
    return rows, away[rows]


def _hypothesis(rejected: Rejected, row: int, away_m: float, local_m: Floats) -> dict[str, Any]:
    reason = rejected.reason.names[rejected.reason.codes[row]]
    rival = -1 if rejected.rival is None else int(rejected.rival[row])
    return {
        "id": int(rejected.hypothesis_id[row]),
        "class": rejected.class_name.names[rejected.class_name.codes[row]],
        "local_m": [number(c) for c in local_m[row]],
        "away_m": number(away_m, 2),
        "votes": int(rejected.votes[row]),
        "passes": int(rejected.passes[row]),
        "expected": int(rejected.expected[row]) or None,
        "existence": number(rejected.existence[row]),
        "reason": reason,
        "why": REJECTION_REASONS.get(reason, reason),
        "figures": figures_in_words(rejected, row) or None,
        "value": None if rejected.value is None else number(rejected.value[row], 3),
        "threshold": None if rejected.threshold is None else number(rejected.threshold[row], 3),
        "rival": rival if rival >= 0 else None,
    }


def _seen_at(
    scene: Scene, evidence: Evidence, rejected: Rejected | None, place: Floats
) -> tuple[dict[str, Any], float]:
    """Return why there is nothing at a place, the rays that pass it, the images that picture it, and its height."""
    ground = scene.world(np.array([[*place, 0.0]]))[0]
    camera = scene.local(evidence.center_in_world_m[[evidence.nearest_image(ground)]])[0]
    at = scene.world(np.array([[*place, camera[2]]]))[0]
    answer = explain_place(evidence, at, rejected, radius_m=PLACE_RADIUS_M)
    reasons = " ".join(answer.reasons)
    for row in answer.labels:  # The page has links instead.
        reasons = reasons.replace(f" valuemap show MAP {evidence.result.labels.label_id[row]} shows it.", "")
    rays, looks = answer.passing, answer.looks
    free = rays.label_id < 0
    shown = np.concatenate([np.flatnonzero(free), np.flatnonzero(~free)])[:_MOST_RAYS]
    takers, counts = np.unique(rays.label_id[~free], return_counts=True)
    details = {
        "answer": reasons,
        "looks": len(looks),
        "look_passes": len(np.unique(looks.pass_number)),
        "rays": len(rays),
        "free_rays": int(free.sum()),
        "takers": [
            {"id": int(taker), "rays": int(count)}
            for count, taker in sorted(zip(counts.tolist(), takers.tolist(), strict=True), key=lambda each: -each[0])
        ],
        "passing": _passing(scene, evidence, rays, shown),
        "pictured": _misses(scene, evidence, _some(looks), typical_px=2.0 * _CROP_LEAST_PX),
    }
    return details, float(scene.local(answer.point_in_world_m[None])[0, 2])


def _passing(scene: Scene, evidence: Evidence, rays: PassingRays, shown: Ints) -> list[dict[str, Any]]:
    detections = evidence.dataset.detections
    rows = rays.detection_row[shown]
    classes = detections.class_name
    return _rows(
        {
            **_images(scene, evidence, rays.image_row[shown]),
            "box": _boxes(detections.center_px[rows], detections.size_px[rows]),
            "crop": _crops(detections.center_px[rows], _side(detections.size_px[rows])),
            "projected": [None] * len(rows),
            "class": [classes.names[code] for code in classes.codes[rows]],
            "score": numbers(detections.score[rows], 3),
            "miss_m": numbers(rays.miss_m[shown], 2),
            "distance_m": numbers(rays.distance_m[shown], 1),
            "label": _ids(rays.label_id[shown]),
        }
    )


def _some(looks: Misses) -> Misses:
    """Return the nearest looks of all: enough to see what is there."""
    rows = np.sort(np.argsort(looks.distance_m, kind="stable")[:_MOST_LOOKS])
    return Misses(**{name: values[rows] for name, values in vars(looks).items()})


def _answer_without_dataset(details: dict[str, Any]) -> str:
    """Return what a map alone can say about a place."""
    sentences = []
    if details["rejected"]:
        best = details["rejected"][0]
        sentences.append(
            f"A hypothesis ({best['class']}) {best['away_m']:.2f} m away had {number_of(best['votes'], 'vote')} of "
            f"{number_of(best['passes'], 'pass', 'passes')}. It was rejected: {best['why']}."
        )
    elif details["kept"]:
        sentences.append(f"No rejected hypothesis of this map is within {PLACE_RADIUS_M:g} m.")
    else:
        sentences.append("The map keeps no rejected hypotheses.")
    sentences.append("Without the dataset nobody can tell which images pictured this place.")
    return " ".join(sentences)
