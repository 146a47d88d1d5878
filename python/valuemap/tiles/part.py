"""A part of a dataset that is larger than memory: whole places, chosen as those are that noise is estimated from.

What is not in it is counted. All rows are read, some at a time; 40 bytes are held of each image that is not in it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import USUAL_RANGE_M
from valuemap.dataset import Dataset, check_detections, checked_as, rows_of
from valuemap.map_folder import Map
from valuemap.nearby import Nearby
from valuemap.portions import DatasetReader, fits_into_memory, rows_on_disk
from valuemap.tables import Detections, Images, Truth
from valuemap.tables.read import read_table
from valuemap.tables.table import join_tables
from valuemap.tiles.grid import MOST_DETECTIONS, Census, Grid
from valuemap.tiles.sample import is_sampled

LARGEST_PART = MOST_DETECTIONS
"""A part has about so many detections, and images without any; so many images of whole passes are looked at."""


@dataclass(frozen=True, eq=False)
class Part:
    """Some places of a dataset with all that is in them, some whole passes without detections, and counts of all."""

    dataset: Dataset
    drives: Images
    images: int
    detections: int
    images_without_detections: int
    passes: int
    scores_vary: bool

    def to_json(self) -> dict[str, int]:
        """Return how much of the whole is in the part."""
        found = {"images": len(self.dataset.images), "of_images": self.images}
        return {**found, "detections": len(self.dataset.detections), "of_detections": self.detections}

    @property
    def counts(self) -> dict[str, Any]:
        """Figures of the whole by the names that `describe_prospects` has for them."""
        return {
            "images": self.images,
            "detections": self.detections,
            "images_without_detections": round(self.images_without_detections / max(self.images, 1), 3),
            "scores": "vary" if self.scores_vary else "none",
            "passes": self.passes,
        }

    @property
    def note(self) -> str:
        """How much of the whole is in the part, in words."""
        images, detections = len(self.dataset.images), len(self.dataset.detections)
        return (
            f"the dataset is large: {detections:,} of {self.detections:,} detections in {images:,} of {self.images:,} "
            "images were looked at, in whole places spread over all of it"
        )


def is_large(folder: Path) -> bool:
    """Return whether a dataset is looked at in part."""
    return not fits_into_memory(sum(rows_on_disk(folder)))


def read_part(folder: Path, *, also: Callable[[Floats], Bools], are_boxes_checked: bool = True) -> Part:
    """Read some whole places of a dataset; the rows of all others are checked as well.

    Parameters
    ----------
    folder
        A dataset.
    also
        Tells which of all images, by their places (N, 2) on the ground, must be in the part wherever they are.
    are_boxes_checked
        As for `read_dataset`.

    Raises
    ------
    InputError
        As `read_dataset`.
    """
    rows = _Rows(folder, are_boxes_checked=are_boxes_checked)
    count = np.zeros(len(rows.image_id), np.int64)
    low, high = np.inf, -np.inf
    for portion, of_image in rows.detections():
        np.add.at(count, of_image, 1)
        low, high = min(low, portion.score.min(initial=np.inf)), max(high, portion.score.max(initial=-np.inf))
    # Images without detections take room, too.
    census = Census.of(rows.grid, rows.place_m, np.maximum(count, 1))
    is_part = is_sampled(rows.grid, census, rows.place_m, LARGEST_PART) | also(rows.place_m)
    return Part(
        dataset=rows.part(is_part),
        drives=rows.whole_passes(),
        images=len(count),
        detections=int(count.sum()),
        images_without_detections=int(np.count_nonzero(count == 0)),
        passes=len(rows.images_of_pass),
        scores_vary=bool(low < high),
    )


def part_of_map(result: Map, folder: Path) -> tuple[Map, Dataset]:
    """Return the labels of some whole places of a map, with a note that says so, and what may have seen them.

    Raises
    ------
    InputError
        As `read_dataset`.
    """
    rows = _Rows(folder)
    labels = result.labels
    place_m = rows.grid.on_ground(labels.position_in_world_m)
    census = Census.of(rows.grid, place_m, labels.votes)
    chosen = np.flatnonzero(is_sampled(rows.grid, census, place_m, LARGEST_PART))
    votes = result.votes.take(np.isin(result.votes.label_id, labels.label_id[chosen]))
    reach_m = result.setting("max_range_m", USUAL_RANGE_M)
    is_part = Nearby(place_m[chosen]).have_any(rows.place_m, reach_m)
    dataset = rows.part(is_part | np.isin(rows.image_id, votes.image_id))
    note = (
        f"the dataset is large: {len(chosen):,} of {len(labels):,} labels are shown, those of whole places spread over "
        f"all of it, with {len(dataset.images):,} of {len(rows.image_id):,} images (valuemap evaluate compares all "
        "labels with a truth)"
    )
    run = {**result.run, "notes": [note, *result.run.get("notes", [])]}
    return replace(result, labels=labels.take(chosen), votes=votes, run=run), dataset


class _Rows:
    """The rows of a dataset, read some at a time; of all images (N), by id, it holds where they are."""

    def __init__(self, folder: Path, *, are_boxes_checked: bool = True) -> None:
        self._folder, self._are_boxes_checked = folder, are_boxes_checked
        self._reader = DatasetReader(folder)
        self.grid = Grid.of(self._reader.frame, USUAL_RANGE_M)
        self.images_of_pass: dict[str, int] = {}
        parts = []
        for images in self._reader.images():
            parts.append((images.image_id, images.camera_id, self.grid.images_on_ground(images)))
            found, number = np.unique(images.pass_id.codes, return_counts=True)
            for code, of_pass in zip(found.tolist(), number.tolist(), strict=True):
                name = images.pass_id.names[code]
                self.images_of_pass[name] = self.images_of_pass.get(name, 0) + of_pass
        image_id, camera_id, place_m = (np.concatenate(column) for column in zip(*parts, strict=True))
        del parts
        order = np.argsort(image_id, kind="stable")
        self.image_id: Ints = image_id[order]
        self.place_m: Floats = place_m[order]
        self._camera_id: Ints = camera_id[order]

    def detections(self) -> Iterator[tuple[Detections, Ints]]:
        """Yield all detections, checked, with the row among all images of each."""
        for portion in self._reader.detections():
            check_detections(
                portion,
                self.image_id,
                self._camera_id,
                self._reader.cameras,
                str(self._folder),
                are_boxes_checked=self._are_boxes_checked,
            )
            yield portion, rows_of(portion.image_id, self.image_id)

    def part(self, is_part: Bools) -> Dataset:
        """Return some images (N) with their detections, and all the truth."""
        images = [each.take(is_part[rows_of(each.image_id, self.image_id)]) for each in self._reader.images()]
        detections = [each.take(is_part[of_image]) for each, of_image in self.detections()]
        truth = self._folder / "truth.parquet"
        return checked_as(
            Dataset(
                name=self._reader.name,
                frame=self._reader.frame,
                cameras=self._reader.cameras,
                images=join_tables(images).by_key(),
                detections=join_tables(detections).by_key(),
                truth=read_table(Truth, truth) if truth.is_file() else None,
            )
        )

    def whole_passes(self) -> Images:
        """Return the images of some passes, chosen by a hash of their names."""
        chosen: set[str] = set()
        room = LARGEST_PART
        for name in sorted(self.images_of_pass, key=lambda name: hashlib.sha256(name.encode()).digest()):
            room -= self.images_of_pass[name]
            if room < 0 and chosen:
                break
            chosen.add(name)
        taken = []
        for images in self._reader.images():
            is_chosen = np.array([name in chosen for name in images.pass_id.names], np.bool_)
            taken.append(images.take(is_chosen[images.pass_id.codes]))
        return join_tables(taken).by_key()
