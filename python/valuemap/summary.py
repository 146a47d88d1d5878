"""What a dataset or a map holds, in a few facts for people and scripts."""

from __future__ import annotations

from typing import Any

import numpy as np

from valuemap.cameras import camera_centers
from valuemap.dataset import Dataset, Frame, rows_of
from valuemap.drives import find_drives, summarize_drives
from valuemap.map_folder import Map
from valuemap.tables import Categories, Floats, Ints


def summarize_dataset(dataset: Dataset) -> dict[str, Any]:
    """Return the facts of a dataset by name, ready for JSON."""
    images, detections = dataset.images, dataset.detections
    detections_of_image = np.bincount(rows_of(detections.image_id, images.image_id), minlength=len(images))
    facts: dict[str, Any] = {
        "dataset": dataset.name,
        "frame": _frame(dataset.frame),
        "cameras": len(dataset.cameras),
        "camera models": ", ".join(sorted(set(dataset.cameras.model.texts()))),
        "images": len(images),
        "passes": len(np.unique(images.pass_id.codes)),
        **summarize_drives(find_drives(images)),
        "extent in m": _extent(camera_centers(images)),
        "detections": len(detections),
        "classes": _classes(detections.class_name),
        "detections an image": len(detections) / len(images),
        "images with 0, 1, 2, ... detections": _histogram(detections_of_image),
    }
    if dataset.truth is not None:
        facts["true objects"] = len(dataset.truth)
    return facts


def summarize_map(result: Map) -> dict[str, Any]:
    """Return the facts of a map by name, ready for JSON."""
    labels, counts = result.labels, result.run.get("counts", {})
    facts: dict[str, Any] = {
        "map of": result.run.get("dataset", "?"),
        "method": result.run.get("settings", {}).get("method", "?"),
        "frame": _frame(result.frame),
        "labels": len(labels),
        "classes": _classes(labels.class_name),
        **{name.replace("_", " "): _short(counts[name]) for name in counts if name != "labels"},
        "seconds": float(sum(stage["seconds"] for stage in result.run.get("stages", []))),
    }
    if len(labels):
        facts |= {
            "extent in m": _extent(labels.position_in_world_m),
            "median votes": float(np.median(labels.votes)),
            "median passes": float(np.median(labels.passes)),
            "median reprojection rms in px": float(np.median(labels.reprojection_rms_px)),
        }
    return facts


def _short(count: Any) -> Any:
    """Return what a record holds by name as one line."""
    return ", ".join(f"{name} {value:.2g}" for name, value in count.items()) if isinstance(count, dict) else count


def _frame(frame: Frame) -> str:
    if frame.anchor is None:
        return f"local, up {' '.join(f'{c:.3g}' for c in frame.up)}"
    lat, lon, height = frame.anchor
    return f"east, north, up at lat {lat:.7f} lon {lon:.7f} height {height:.2f} m"


def _extent(points: Floats) -> str:
    return " x ".join(f"{side:.0f}" for side in np.ptp(points, axis=0))


def _classes(column: Categories) -> str:
    count = np.bincount(column.codes, minlength=len(column.names))
    return ", ".join(f"{name} {n}" for name, n in zip(column.names, count, strict=True) if n)


def _histogram(detections_of_image: Ints) -> str:
    count = np.bincount(np.minimum(detections_of_image, 10), minlength=11)
    return " ".join(map(str, count[: np.flatnonzero(count)[-1] + 1]))
