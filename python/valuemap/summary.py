"""What a dataset or a map holds, in a few facts: numbers as numbers, for scripts; the command line words them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, rows_of
from valuemap.drives import find_drives
from valuemap.map_folder import Map
from valuemap.tables import Categories, Detections
from valuemap.tables.map import LABEL_STATES

_MANY = 10
"""So many detections in an image, and more, are counted together."""


def summarize_dataset(dataset: Dataset) -> dict[str, Any]:
    """Return the facts of a dataset by name, ready for JSON."""
    return summarize_portions(dataset, [dataset.detections])


def summarize_portions(dataset: Dataset, portions: Iterable[Detections]) -> dict[str, Any]:
    """Return the facts of a dataset whose detections come in portions; those in `dataset` do not count."""
    images = dataset.images
    detections_of_image = np.zeros(len(images), np.int64)
    of_class: Counter[str] = Counter()
    for portion in portions:
        detections_of_image += np.bincount(rows_of(portion.image_id, images.image_id), minlength=len(images))
        of_class.update(_classes(portion.class_name))
    count = int(detections_of_image.sum())
    drives = find_drives(images).record
    facts: dict[str, Any] = {
        "dataset": dataset.name,
        "frame": dataset.frame.to_json(),
        "cameras": len(dataset.cameras),
        "camera_models": sorted(set(dataset.cameras.model.texts())),
        "images": len(images),
        "passes": len(np.unique(images.pass_id.codes)),
        "drives": drives["drives"],
        "drives_cut_at": drives["cut_at"],
        "images_ordered_by": drives["images_ordered_by"],
        "images_on_rigs": drives["images_on_rigs"],
        "extent_m": _extent(camera_centers(images)),
        "detections": count,
        "classes": dict(sorted(of_class.items())),
        "detections_per_image": count / len(images),
        "images_by_detections": _histogram(detections_of_image),
    }
    if dataset.truth is not None:
        facts["true_objects"] = len(dataset.truth)
    return facts


def summarize_map(result: Map) -> dict[str, Any]:
    """Return the facts of a map by name, ready for JSON."""
    labels, counts = result.labels, result.run.get("counts", {})
    facts: dict[str, Any] = {
        "map_of": result.run.get("dataset", "?"),
        "method": result.method,
        "frame": result.frame.to_json(),
        "labels": len(labels),
        **_states(labels.state),
        "classes": _classes(labels.class_name),
        **{name: counts[name] for name in counts if name != "labels"},
        **_poses(result.run.get("poses")),
        **_control(result.run.get("control")),
        "seconds": float(sum(stage["seconds"] for stage in result.run.get("stages", []))),
    }
    if len(labels):
        facts |= {
            "extent_m": _extent(labels.position_in_world_m),
            "median_votes": float(np.median(labels.votes)),
            "median_passes": float(np.median(labels.passes)),
            "median_reprojection_rms_px": float(np.median(labels.reprojection_rms_px)),
        }
    return facts


def _states(state: Categories | None) -> dict[str, int]:
    """Return how many labels an update confirmed, found to be gone, and so on; nothing where there was none."""
    if state is None:
        return {}
    count = _classes(state)
    return {f"labels_{name}": count.get(name, 0) for name in LABEL_STATES}


def _poses(record: Any) -> dict[str, Any]:
    """Return how many cameras and drives were corrected, and how well the place of all drives together is known.

    Nothing where nothing was looked for.
    """
    if not isinstance(record, dict):
        return {}
    sigma = "mean_of_drives_sigma_east_north_up_m"
    corrected = {name: len(record.get(name, ())) for name in ("cameras", "drives")}
    return {"corrected_poses": {**corrected, **({sigma: record[sigma]} if sigma in record else {})}}


def _control(record: Any) -> dict[str, Any]:
    """Return by how much control points moved the map, and what points left out say; nothing where there were none."""
    if not isinstance(record, dict):
        return {}
    names = ("matched", "shift_east_north_up_m", "shift_sigma_m", "turn_deg")
    left_out = record.get("left_out", {})
    proof = {
        name: left_out[key]
        for name, key in (
            ("left_out_rmse_as_mapped_m", "rmse_horizontal_as_mapped_m"),
            ("left_out_rmse_moved_m", "rmse_horizontal_m"),
        )
        if key in left_out
    }
    return {"control": {**{name: record[name] for name in names if name in record}, **proof}}


def _extent(points: Floats) -> list[float]:
    return [float(side) for side in np.ptp(points, axis=0)]


def _classes(column: Categories) -> dict[str, int]:
    count = np.bincount(column.codes, minlength=len(column.names))
    return {name: int(n) for name, n in zip(column.names, count, strict=True) if n}


def _histogram(detections_of_image: Ints) -> list[int]:
    """Return how many images have 0, 1, 2, ... detections; the last count is of 10 and more."""
    count = np.bincount(np.minimum(detections_of_image, _MANY), minlength=_MANY + 1)
    return [int(images) for images in count[: np.flatnonzero(count)[-1] + 1]]
