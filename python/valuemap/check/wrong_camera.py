"""Images that have another image's camera."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from valuemap.arrays import Floats
from valuemap.check.agreement import agreement_on, compare
from valuemap.check.fault import (
    LEAST_CHANCE,
    LEAST_RISE,
    Fault,
    Finding,
    Stage,
    View,
    with_images,
)
from valuemap.check.sample import pixels_per_radian
from valuemap.dataset import Dataset

_SUSPICIOUS = 0.05
"""One pass in twenty is so by luck: what is judged together is not judged by this alone."""

_MOST_CAMERAS = 6


class WrongCamera(Fault):
    """Images that have another image's camera."""

    name: ClassVar[str] = "wrong_camera"
    stage: ClassVar[Stage] = "fine"

    def find(self, view: View) -> Finding | None:
        """Give the images of each pass and camera each other camera and see whether their rays agree better."""
        chosen, chance = _best_cameras(view)
        if not chosen:
            return None
        worst = max(chosen, key=lambda each: each["difference"])
        rows = sum(each["images"] for each in chosen)
        cameras = {(each["pass"], each["camera"]): each["better"] for each in chosen}
        return Finding(
            fault=self.name,
            what="Images have the wrong camera.",
            why=f"Of {rows} images in {len(chosen)} groups of a pass the rays agree better with another camera of the "
            f"table: those of pass {worst['pass']} have camera {worst['camera']}, and with camera {worst['better']} "
            f"their agreement is {worst['with_better']:.0f} instead of {worst['as_given']:.0f}.",
            do="Give each image the camera that took it.",
            chance=chance,
            figures={"images": rows, "groups": chosen[:10]},
            fix=lambda dataset: _with_cameras(dataset, cameras),
        )


def _best_cameras(view: View) -> tuple[list[dict[str, Any]], float]:
    cameras = view.dataset.cameras
    if not 1 < len(cameras) <= _MOST_CAMERAS:
        return [], 1.0
    sample = view.stretches
    images = sample.dataset.images
    place_pass = np.zeros(sample.places, dtype=np.int64)
    place_camera = np.zeros(sample.places, dtype=np.int64)
    place_pass[sample.place_of_image] = images.pass_id.codes
    place_camera[sample.place_of_image] = images.camera_id
    gains: dict[int, Floats] = {}
    for row, camera in enumerate(cameras.camera_id.tolist()):
        version = with_images(sample.dataset, camera_id=np.full(len(images), camera))
        gate_px = view.gate_px * pixels_per_radian_of(view.dataset, row) / pixels_per_radian(view.dataset)
        gains[camera] = agreement_on(sample, version, gate_px).gain
    best: list[dict[str, Any]] = []
    better: list[Floats] = []
    worse: list[Floats] = []
    groups = np.unique(np.stack([place_pass, place_camera], axis=1), axis=0)
    for code, camera in groups.tolist():
        of_group = (place_pass == code) & (place_camera == camera)
        given = gains[camera][of_group]
        comparisons = {other: compare(gain[of_group], given) for other, gain in gains.items() if other != camera}
        other = min(comparisons, key=lambda each: (comparisons[each].chance, -comparisons[each].difference))
        least_rise = LEAST_RISE * float(given.sum())
        if comparisons[other].chance > _SUSPICIOUS or comparisons[other].difference < least_rise:
            continue
        better.append(gains[other][of_group])
        worse.append(given)
        best.append(
            {
                "pass": images.pass_id.names[code],
                "camera": camera,
                "better": other,
                "images": int(((images.pass_id.codes == code) & (images.camera_id == camera)).sum()),
                "as_given": round(float(given.sum()), 1),
                "with_better": round(float(better[-1].sum()), 1),
                "difference": round(comparisons[other].difference, 1),
            }
        )
    if not best:
        return [], 1.0
    # One pass may have too few stretches to be sure of; all that are suspicious together have not.
    chance = compare(np.concatenate(better), np.concatenate(worse)).chance * len(groups) * (len(gains) - 1)
    return (best, chance) if chance < LEAST_CHANCE else ([], 1.0)


def pixels_per_radian_of(dataset: Dataset, row: int) -> float:
    """Return how many pixels a radian has in the middle of the picture of one camera."""
    return pixels_per_radian(Dataset(**{**vars(dataset), "cameras": dataset.cameras.take(np.array([row]))}))


def _with_cameras(dataset: Dataset, cameras: dict[tuple[str, int], int]) -> Dataset:
    """Give images the cameras found for their pass; passes outside the sample follow those with the same camera."""
    images = dataset.images
    camera = images.camera_id.copy()
    for (name, old), new in cameras.items():
        rows = (images.camera_id == old) & (images.pass_id.codes == images.pass_id.code_of(name))
        camera[rows] = new
    return with_images(dataset, camera_id=camera)
