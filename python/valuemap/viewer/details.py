"""Answers to clicks: what a label rests on, and why a place is empty."""

from __future__ import annotations

from typing import Any

import numpy as np

from valuemap.errors import InputError
from valuemap.evidence import Evidence, Misses, picture_file
from valuemap.tables import Floats, Ints
from valuemap.viewer.scene import Scene, number

PLACE_RADIUS_M = 5.0
"""How far around a place its labels and rejected hypotheses are listed."""
RAY_RADIUS_M = 1.0
"""A detection whose ray passes a place closer than this points at it."""

_CROP_BOXES = 4.0
"""A crop shows this many times the larger side of a box, at least `_CROP_LEAST_PX`."""
_CROP_LEAST_PX = 48.0
_MOST_RAYS = 24
_MOST_LOOKS = 12

REASONS = {
    "votes": "too few images voted for it (setting min_votes)",
    "ratio": "it had too few votes compared with the other hypotheses (setting min_vote_ratio)",
    "outvoted": "its detections belong to a label that explains them better",
    "existence": "too many images that should have seen it did not (setting min_existence)",
    "merged": "it is one object with another label",
    "class": "a label of another class has the place",
    "parallax": "all its rays come from nearly one direction, which gives no distance (setting min_parallax_deg)",
    "range": "it is nearer or farther than allowed (settings min_range_m, max_range_m)",
}
"""Why a hypothesis became no label, for people."""


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
    """Return what is known about a place (metres on the page): labels and rejected hypotheses near it, rays past it.

    The height of the place is that of the nearest rejected hypothesis or label, else that of the rays.
    """
    labels, rejected, evidence = scene.result.labels, scene.rejected, scene.evidence
    place = np.array([east_m, north_m])
    label_at = scene.local(labels.position_in_world_m)
    near_labels, label_m = _nearest(label_at, place)
    details: dict[str, Any] = {
        "kept": rejected is not None,
        "rejected": [],
        "labels": [
            {
                "id": int(labels.label_id[row]),
                "class": labels.class_name.names[labels.class_name.codes[row]],
                "away_m": number(away, 2),
            }
            for row, away in zip(near_labels, label_m, strict=True)
        ],
    }
    heights = [float(label_at[row, 2]) for row in near_labels[:1]]
    if rejected is not None:
        rejected_at = scene.local(rejected.position_in_world_m)
        rows, away_m = _nearest(rejected_at, place)
        # The one with the most evidence says the most.
        order = np.lexsort((away_m, -rejected.votes[rows]))
        details["rejected"] = [_hypothesis(scene, int(rows[i]), float(away_m[i]), rejected_at) for i in order]
        heights = [float(rejected_at[rows[i], 2]) for i in order[:1]] or heights
    if evidence is not None:
        with scene.lock:
            details |= _seen_at(scene, evidence, place, heights)
    height = heights[0] if heights else details.get("height_m", 0.0)
    world = scene.world(np.array([[east_m, north_m, height]]))[0]
    details |= {
        "local_m": [number(east_m), number(north_m), number(height)],
        "position_m": [number(c) for c in world],
        "lon_lat_height": scene.lon_lat_height(world),
    }
    return details | {"answer": _answer(details)}


def _voters(scene: Scene, evidence: Evidence, label_id: int) -> list[dict[str, Any]]:
    voters = evidence.voters(label_id)
    centers = scene.local(evidence.center_in_world_m[voters.image_row])
    return [
        {
            **_image(scene, evidence, int(voters.image_row[i]), centers[i]),
            "box": _box(voters.box_px[i], voters.size_px[i]),
            "projected": [number(c, 1) for c in voters.projected_px[i]],
            "crop": _crop(voters.box_px[i], _side(voters.size_px[i])),
            "residual_px": number(voters.residual_px[i], 2),
            "residual_sigmas": number(voters.residual_sigmas[i], 2),
            "score": number(voters.score[i], 3),
            "distance_m": number(voters.distance_m[i], 1),
        }
        for i in range(len(voters))
    ]


def _misses(scene: Scene, evidence: Evidence, misses: Misses, *, typical_px: float) -> list[dict[str, Any]]:
    centers = scene.local(evidence.center_in_world_m[misses.image_row])
    detections = evidence.dataset.detections
    found = []
    for i in range(len(misses)):
        nearest = int(misses.nearest_row[i])
        is_near = nearest >= 0 and misses.nearest_px[i] <= _CROP_LEAST_PX + typical_px
        found.append(
            {
                **_image(scene, evidence, int(misses.image_row[i]), centers[i]),
                "projected": [number(c, 1) for c in misses.projected_px[i]],
                "crop": _crop(misses.projected_px[i], typical_px),
                "distance_m": number(misses.distance_m[i], 1),
                "box": _box(detections.center_px[nearest], detections.size_px[nearest]) if is_near else None,
                "nearest_px": number(misses.nearest_px[i], 1),
                "nearest_label": int(misses.nearest_label[i]) if misses.nearest_label[i] >= 0 else None,
            }
        )
    return found


def _image(scene: Scene, evidence: Evidence, row: int, center: Floats) -> dict[str, Any]:
    images = evidence.dataset.images
    name = evidence.image_name(row)
    width, height = evidence.picture_size_px(np.array([row]))[0]
    return {
        "image": int(images.image_id[row]),
        "name": name,
        "pass": int(evidence.pass_number[row]),
        "picture": picture_file(scene.pictures, name) is not None,
        "size": [int(width), int(height)],
        "camera_m": [number(c, 3) for c in center],
        "time_s": None if images.timestamp_s is None else number(images.timestamp_s[row], 2),
    }


def _side(size_px: Floats) -> float:
    """Return the side of the crop around a box; boxes may have no size."""
    longest = float(np.nanmax([*size_px, 0.0]))
    return max(_CROP_LEAST_PX, _CROP_BOXES * longest)


def _typical_side(evidence: Evidence, label_id: int) -> float:
    sizes = evidence.voters(label_id).size_px
    return float(np.median([_side(size) for size in sizes])) if len(sizes) else _CROP_LEAST_PX


def _crop(center_px: Floats, side_px: float) -> list[float | None]:
    return [number(center_px[0], 1), number(center_px[1], 1), number(side_px, 1)]


def _box(center_px: Floats, size_px: Floats) -> list[float | None]:
    return [number(c, 1) for c in (*center_px, *size_px)]


def _nearest(local_m: Floats, place: Floats) -> tuple[Ints, Floats]:
    away = np.linalg.norm(local_m[:, :2] - place, axis=1)
    rows = np.flatnonzero(away <= PLACE_RADIUS_M)
    rows = rows[np.argsort(away[rows], kind="stable")]
    return rows, away[rows]


def _hypothesis(scene: Scene, row: int, away_m: float, local_m: Floats) -> dict[str, Any]:
    rejected = scene.rejected
    assert rejected is not None
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
        "why": REASONS.get(reason, reason),
        "rival": rival if rival >= 0 else None,
    }


def _seen_at(scene: Scene, evidence: Evidence, place: Floats, heights: list[float]) -> dict[str, Any]:
    """Return the rays that pass a place and the images that picture it."""
    at = scene.world(np.array([[*place, heights[0] if heights else 0.0]]))[0]
    rays = evidence.rays_past(at, radius_m=RAY_RADIUS_M)
    points = scene.local(rays.point_in_world_m)
    if not heights:
        heights = [float(np.median(points[:, 2]))] if len(points) else [_camera_height(scene, evidence, place)]
        at = scene.world(np.array([[*place, heights[0]]]))[0]
    looks = evidence.looks_at(at)
    free = rays.label_id < 0
    detections, classes = evidence.dataset.detections, evidence.dataset.detections.class_name
    centers = scene.local(evidence.center_in_world_m[rays.image_row])
    shown = np.concatenate([np.flatnonzero(free), np.flatnonzero(~free)])[:_MOST_RAYS]
    takers, counts = np.unique(rays.label_id[~free], return_counts=True)
    return {
        "height_m": heights[0],
        "looks": len(looks),
        "look_passes": len(np.unique(looks.pass_number)),
        "rays": len(rays),
        "free_rays": int(free.sum()),
        "free_ray_passes": len(np.unique(rays.pass_number[free])),
        "takers": [
            {"id": int(taker), "rays": int(count)}
            for count, taker in sorted(zip(counts.tolist(), takers.tolist(), strict=True), key=lambda each: -each[0])
        ],
        "passing": [
            {
                **_image(scene, evidence, int(rays.image_row[i]), centers[i]),
                "box": _box(detections.center_px[rays.detection_row[i]], detections.size_px[rays.detection_row[i]]),
                "crop": _crop(
                    detections.center_px[rays.detection_row[i]], _side(detections.size_px[rays.detection_row[i]])
                ),
                "projected": None,
                "class": classes.names[classes.codes[rays.detection_row[i]]],
                "score": number(detections.score[rays.detection_row[i]], 3),
                "miss_m": number(rays.miss_m[i], 2),
                "distance_m": number(rays.distance_m[i], 1),
                "label": int(rays.label_id[i]) if rays.label_id[i] >= 0 else None,
            }
            for i in shown
        ],
        "pictured": _misses(scene, evidence, _some(looks), typical_px=2.0 * _CROP_LEAST_PX),
    }


def _some(looks: Misses) -> Misses:
    """Return the nearest looks of all: enough to see what is there."""
    rows = np.sort(np.argsort(looks.distance_m, kind="stable")[:_MOST_LOOKS])
    return Misses(**{name: values[rows] for name, values in vars(looks).items()})


def _camera_height(scene: Scene, evidence: Evidence, place: Floats) -> float:
    """Return the height of the nearest camera: where there is nothing else, streets are at least near it."""
    centers = scene.local(evidence.center_in_world_m)
    return float(centers[np.argmin(np.linalg.norm(centers[:, :2] - place, axis=1)), 2])


def _answer(details: dict[str, Any]) -> str:
    """Return in a few sentences why there is no label at a place."""
    sentences = []
    if details["rejected"]:
        best = details["rejected"][0]
        sentences.append(
            f"A {best['class']} with {_count(best['votes'], 'vote')} from {_count(best['passes'], 'pass', 'passes')} "
            f"was considered {best['away_m']:.1f} m from here and rejected: {best['why']}."
        )
        if best["rival"] is not None:
            sentences.append(f"Label {best['rival']} has its detections or its place.")
    elif details["kept"]:
        sentences.append(f"No hypothesis that was worth keeping is within {PLACE_RADIUS_M:g} m of here.")
    else:
        sentences.append("This map keeps no rejected hypotheses, so only what is around here can be told.")
    if "looks" in details:
        if details["looks"] == 0:
            sentences.append("No image pictures this place.")
        elif details["rays"] == 0:
            sentences.append(
                f"{_count(details['looks'], 'image pictures', 'images picture')} this place, and no detection in any "
                f"of them points at it."
            )
        else:
            taken = details["rays"] - details["free_rays"]
            sentences.append(
                f"{_count(details['looks'], 'image pictures', 'images picture')} this place; "
                f"{_count(details['rays'], 'detection points', 'detections point')} at it, of which "
                f"{taken} vote for other labels and {details['free_rays']} for none."
            )
            if details["free_rays"] == 1:
                sentences.append("One free ray gives a direction and no place.")
            elif details["free_rays"] > 1 and details["free_ray_passes"] == 1:
                sentences.append("All free ones are of one pass.")
    if details["labels"]:
        nearest = details["labels"][0]
        sentences.append(f"The nearest label is {nearest['id']} ({nearest['class']}), {nearest['away_m']:.1f} m away.")
    return " ".join(sentences)


def _count(count: int, one: str, many: str | None = None) -> str:
    return f"{count:,} {one if count == 1 else many or one + 's'}"
