"""Parts of a dataset that may be wrong alone: the images of one camera of several, or of one pass.

Where one camera of a car is turned, or one drive was imported otherwise, most rays are right, and what all images share
says little of it. So each group is looked at as a dataset of its own, and what is put right in it is put back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools
from valuemap.check.fault import LEAST_CHANCE, Fault, Finding, Fix, View, keep_rows
from valuemap.dataset import Dataset, rows_of
from valuemap.tables import Cameras, Categories

_LEAST_DETECTIONS = 60
"""A dozen objects, seen five times each."""
_MOST_GROUPS = 12
"""The largest ones; each is looked at as a dataset is."""


@dataclass(frozen=True)
class Group:
    """The images of a camera (by its id) or of a pass (by its name)."""

    camera_id: int | None = None
    pass_name: str | None = None

    @property
    def text(self) -> str:
        """What reports call it."""
        return f"camera {self.camera_id}" if self.pass_name is None else f"pass {self.pass_name}"

    def images_of(self, dataset: Dataset) -> Bools:
        """Return which images (N) are of the group."""
        images = dataset.images
        if self.pass_name is None:
            return np.asarray(images.camera_id == self.camera_id)
        return np.asarray(images.pass_id.codes == images.pass_id.code_of(self.pass_name))

    def part(self, dataset: Dataset) -> Dataset:
        """Return the group as a dataset of its own."""
        part = keep_rows(dataset, images=self.images_of(dataset))
        used = np.isin(part.cameras.camera_id, part.images.camera_id)
        return Dataset(**{**vars(part), "cameras": part.cameras.take(used)})

    def alone(self, view: View) -> View:
        """Return a view of the group alone, made once a view: a camera of one pass has the images of that pass."""
        views: dict[Any, View] = view.memory.setdefault("alone", {})
        key = self.images_of(view.dataset).tobytes(), view.known
        if key not in views:
            views[key] = View(self.part(view.dataset), gate_share=view.gate_share, known=view.known)
        return views[key]


def groups_of(dataset: Dataset) -> tuple[Group, ...]:
    """Return cameras, then passes, with detections enough, where there are several; those with most first."""
    images = dataset.images
    row = rows_of(dataset.detections.image_id, images.image_id)
    found: list[Group] = []
    camera_id, count = np.unique(images.camera_id[row], return_counts=True)
    if len(camera_id) > 1:
        found += [Group(camera_id=int(camera_id[at])) for at in _largest(count)]
    code, count = np.unique(images.pass_id.codes[row], return_counts=True)
    if len(code) > 1:
        found += [Group(pass_name=images.pass_id.names[code[at]]) for at in _largest(count)]
    return tuple(found)


def _largest(count: NDArray[np.int64]) -> Iterator[int]:
    for at in np.argsort(-count, kind="stable")[:_MOST_GROUPS].tolist():
        if count[at] >= _LEAST_DETECTIONS:
            yield at


class OfGroup:
    """Puts one group of a dataset right and leaves the rest as it is."""

    def __init__(self, group: Group, fix: Fix) -> None:
        self.group, self.own = group, fix

    def __call__(self, dataset: Dataset) -> Dataset:
        """Return the dataset with poses, boxes and the group's own camera as the fix makes them."""
        changed = self.own(self.group.part(dataset))
        mine = self.group.images_of(dataset)
        boxes = mine[rows_of(dataset.detections.image_id, dataset.images.image_id)]
        images, detections = dataset.images, dataset.detections
        result = Dataset(
            **{
                **vars(dataset),
                "images": images.replace(
                    cam_from_world_quat=_put(
                        images.cam_from_world_quat, mine, np.asarray(changed.images.cam_from_world_quat)
                    ),
                    cam_from_world_m=_put(images.cam_from_world_m, mine, np.asarray(changed.images.cam_from_world_m)),
                ),
                "detections": detections.replace(
                    image_id=_put(detections.image_id, boxes, changed.detections.image_id),
                    center_px=_put(detections.center_px, boxes, changed.detections.center_px),
                    size_px=_put(detections.size_px, boxes, changed.detections.size_px),
                ),
            }
        )
        return result if self.group.pass_name is not None else _with_camera(result, changed.cameras)


def only(group: Group, finding: Finding) -> Finding:
    """Return what is found in a group on its own as a finding of the whole."""
    assert finding.fix is not None
    return replace(
        finding,
        what=f"Only {group.text}: {finding.what}",
        figures={"of": group.text, **finding.figures},
        fix=OfGroup(group, finding.fix),
        of=group.text,
    )


def find_in_groups(view: View, fault: Fault) -> Finding | None:
    """Return what is wrong with the rows of one camera or pass alone, by as small a chance as that of the whole."""
    groups = groups_of(view.dataset)
    for group in groups:
        finding = fault.find(group.alone(view))
        if finding is None or finding.fix is None:
            continue
        chance = None if finding.chance is None else finding.chance * len(groups)
        if chance is None or chance < LEAST_CHANCE:
            return only(group, replace(finding, chance=chance))
    return None


def is_of_one_group(changed: Dataset, part: Dataset, group: Group) -> bool:
    """Return whether nothing is changed that a group shares with others: the frame, and of a pass its cameras."""
    return changed.frame == part.frame and (group.pass_name is None or changed.cameras is part.cameras)


def _put(values: NDArray[Any], rows: Bools, part: NDArray[Any]) -> NDArray[Any]:
    result = values.copy()
    result[rows] = part
    return result


def _with_camera(dataset: Dataset, own: Cameras) -> Dataset:
    """Return the dataset with models and parameters of some cameras as in another table."""
    cameras = dataset.cameras
    row_of = {int(camera): row for row, camera in enumerate(own.camera_id)}
    rows = [row_of.get(int(camera)) for camera in cameras.camera_id]
    models, own_models = cameras.model.texts(), own.model.texts()
    changed = cameras.replace(
        params=[old if row is None else own.params[row] for old, row in zip(cameras.params, rows, strict=True)],
        model=Categories.from_texts(
            [old if row is None else own_models[row] for old, row in zip(models, rows, strict=True)]
        ),
    )
    return Dataset(**{**vars(dataset), "cameras": changed})
