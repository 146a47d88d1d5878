"""What a label rests on: who voted for it, who should have seen it and did not, and what is near an empty place.

The report, the pictures of `valuemap show` and the interactive page all ask the same questions; this is where they are
answered. Nothing is decided anew here: votes are those of the map, everything else is geometry.
"""

from __future__ import annotations

import math
import os
import stat
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints, RowsByNumber
from valuemap.cameras import Rays, camera_centers, cast_rays, lens_of, rotation_of
from valuemap.config import USUAL_RANGE_M
from valuemap.dataset import MARKER, Dataset, number_passes, rows_of, rows_of_votes
from valuemap.drives import find_drives
from valuemap.errors import InputError
from valuemap.map_folder import Map
from valuemap.nearby import Nearby

PICTURES = "images"
"""The folder of a dataset that holds its pictures, where it has some."""

SECTOR_COSINE = math.cos(math.radians(15.0))
"""Directions of looking that differ by less than 15 degrees are one sector."""

_ROUNDING = 1.0 + 1e-9
_NO_ROW = -1


@dataclass(frozen=True, eq=False)
class Voters:
    """The votes for one label, by pass, then in the order of the drive; all arrays have a row per vote (N).

    Rows are those of the dataset's tables. `box_px` is the centre and `size_px` the size (N, 2) of the box,
    `projected_px` (N, 2) where the label projects with the camera's full model. The residuals are those that the map
    holds. `distance_m` is from the camera to the label.
    """

    image_row: Ints
    detection_row: Ints
    pass_number: Ints
    box_px: Floats
    size_px: Floats
    score: Floats
    projected_px: Floats
    residual_px: Floats
    residual_sigmas: Floats
    distance_m: Floats

    def __len__(self) -> int:
        return len(self.image_row)


@dataclass(frozen=True, eq=False)
class Misses:
    """Images that should have seen a label and did not vote, by pass, then in the order of the drive (N).

    `nearest_px` is how far the closest detection of the label's class is from where the label projects (inf without
    one), `nearest_row` the row of that detection (-1 without one), and `nearest_label` the id of the label that this
    detection votes for (-1 where nobody has it).
    """

    image_row: Ints
    pass_number: Ints
    projected_px: Floats
    distance_m: Floats
    nearest_row: Ints
    nearest_px: Floats
    nearest_label: Ints

    def __len__(self) -> int:
        return len(self.image_row)


@dataclass(frozen=True, eq=False)
class PassingRays:
    """Detections whose rays pass a vertical line closely, by distance to it (N).

    `miss_m` is the horizontal distance between ray and line, `point_in_world_m` (N, 3) the point of the ray that is
    nearest to it, `distance_m` how far that is from the camera, and `label_id` the label that the detection votes for
    (-1 where nobody has it).
    """

    detection_row: Ints
    image_row: Ints
    pass_number: Ints
    miss_m: Floats
    point_in_world_m: Floats
    distance_m: Floats
    label_id: Ints

    def __len__(self) -> int:
        return len(self.detection_row)


class Evidence:
    """A map together with the dataset that it was made from.

    Raises
    ------
    InputError
        A vote of the map is by a detection or an image that the dataset does not have, or has elsewhere.
    """

    def __init__(self, result: Map, dataset: Dataset) -> None:
        self.result = result
        self.dataset = dataset
        self.detection_row, self.image_row = rows_of_votes(result.votes, dataset)
        """The rows in the tables of detections and images (votes) of each vote."""

    @cached_property
    def center_in_world_m(self) -> Floats:
        """The camera centre (images, 3) of every image."""
        return camera_centers(self.dataset.images)

    @cached_property
    def pass_number(self) -> Ints:
        """The number (images) of every image's pass, in the order of their first images."""
        return number_passes(self.dataset.images)

    @cached_property
    def drive_order(self) -> Ints:
        """The place (images) of every image in the order of passes, and in it of the drive."""
        images = self.dataset.images
        drives = find_drives(images)
        place = np.empty(len(images), np.int64)
        order = np.lexsort((images.image_id, drives.order, drives.pass_code, self.pass_number))
        place[order] = np.arange(len(images))
        return place

    @cached_property
    def rays(self) -> Rays:
        """The viewing ray of every detection."""
        return cast_rays(self.dataset)

    @cached_property
    def label_of_detection(self) -> Ints:
        """The id of the label that each detection (detections) votes for, -1 where nobody has it."""
        label = np.full(len(self.dataset.detections), _NO_ROW)
        label[self.detection_row] = self.result.votes.label_id
        return label

    @cached_property
    def max_range_m(self) -> float:
        """How far away the map looked for objects."""
        return self.result.setting("max_range_m", USUAL_RANGE_M)

    def label_row(self, label_id: int) -> int:
        """Return the row of a label in the labels table.

        Raises
        ------
        InputError
            There is no such label.
        """
        ids = self.result.labels.label_id
        row = int(np.searchsorted(ids, label_id))
        if row == len(ids) or ids[row] != label_id:
            found = f"{ids[0]} to {ids[-1]}" if len(ids) else "none at all"
            raise InputError(f"there is no label {label_id} in the map", hint=f"its labels are {found}")
        return row

    def vote_rows(self, label_id: int) -> Ints:
        """Return the rows of the votes table that are for a label."""
        ids = self.result.votes.label_id
        first, end = np.searchsorted(ids, [label_id, label_id + 1])
        return np.arange(first, end)

    def voters(self, label_id: int) -> Voters:
        """Return the votes for a label, by pass, then in the order of the drive."""
        votes, detections = self.result.votes, self.dataset.detections
        point = self.result.labels.position_in_world_m[self.label_row(label_id)]
        rows = self.vote_rows(label_id)
        rows = rows[np.argsort(self.drive_order[self.image_row[rows]], kind="stable")]
        image_row, detection_row = self.image_row[rows], self.detection_row[rows]
        return Voters(
            image_row=image_row,
            detection_row=detection_row,
            pass_number=self.pass_number[image_row],
            box_px=detections.center_px[detection_row],
            size_px=detections.size_px[detection_row],
            score=detections.score[detection_row],
            projected_px=self.project(image_row, point),
            residual_px=votes.residual_px[rows],
            residual_sigmas=votes.residual_sigmas[rows],
            distance_m=np.linalg.norm(self.center_in_world_m[image_row] - point, axis=1),
        )

    def misses(self, label_id: int) -> Misses:
        """Return the images that should have seen a label and did not vote for it.

        An image should have seen it if it pictures the label from a direction within 15 degrees of those of its
        votes, no nearer and no farther than the votes from there: the rule by which the method counts `expected`.
        """
        row = self.label_row(label_id)
        point = self.result.labels.position_in_world_m[row]
        missed = self.should_have_seen(point, self.image_row[self.vote_rows(label_id)])
        labels = self.result.labels
        return self._misses_at(missed, point, class_name=labels.class_name.names[labels.class_name.codes[row]])

    def should_have_seen(self, point_in_world_m: Floats, voter_image_row: Ints) -> Ints:
        """Return the rows of the images that should have seen a point (3) as its voters did, and did not."""
        if len(voter_image_row) == 0:
            return np.empty(0, np.int64)
        toward = self.center_in_world_m[voter_image_row] - point_in_world_m
        # The middles of sectors are taken in the order of the votes, as the method does.
        distance = np.linalg.norm(toward, axis=1)
        direction = toward / distance[:, None]
        middles = _sector_middles(direction)
        sector = np.argmax(direction @ middles.T >= SECTOR_COSINE, axis=1)
        nearest, farthest = np.full(len(middles), np.inf), np.zeros(len(middles))
        np.minimum.at(nearest, sector, distance)
        np.maximum.at(farthest, sector, distance)

        around = self.images_around(point_in_world_m, float(farthest.max()) * _ROUNDING)
        near = np.setdiff1d(around, voter_image_row)
        away = self.center_in_world_m[near] - point_in_world_m
        distance = np.linalg.norm(away, axis=1)[:, None]
        is_held = (
            (away @ middles.T >= SECTOR_COSINE * distance)
            & (distance >= nearest / _ROUNDING)
            & (distance <= farthest * _ROUNDING)
        )
        near = near[is_held.any(axis=1)]
        return np.asarray(near[self.is_pictured(near, self.project(near, point_in_world_m))])

    def looks_at(self, point_in_world_m: Floats) -> Misses:
        """Return all images that picture a place within `max_range_m`; `nearest_*` is over detections of any class."""
        near = self.images_around(point_in_world_m, self.max_range_m)
        near = near[self.is_pictured(near, self.project(near, point_in_world_m))]
        return self._misses_at(near, point_in_world_m, class_name=None)

    def rays_past(self, point_in_world_m: Floats, *, radius_m: float) -> PassingRays:
        """Return the detections whose rays pass the vertical line through a point closer than `radius_m`."""
        up = np.array(self.dataset.frame.up)
        around = self.images_around(point_in_world_m, self.max_range_m, horizontally=True)
        of_image = [self.detections_of_image(int(row)) for row in around]
        rows = np.sort(np.concatenate(of_image)) if of_image else np.empty(0, np.int64)
        image_row = self.rays.image_row[rows]
        center = self.center_in_world_m[image_row]
        direction = self.rays.direction_in_world[rows]
        away = point_in_world_m - center
        away = away - np.outer(away @ up, up)
        flat = direction - np.outer(direction @ up, up)
        length = np.linalg.norm(flat, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            along = np.einsum("ni,ni->n", away, flat) / length**2  # In lengths of the ray, to the closest point.
            miss = np.linalg.norm(away - along[:, None] * flat, axis=1)
        passing = np.flatnonzero((along > 0.0) & (along <= self.max_range_m) & (miss <= radius_m))
        passing = passing[np.lexsort((rows[passing], miss[passing]))]
        rows = rows[passing]
        return PassingRays(
            detection_row=rows,
            image_row=image_row[passing],
            pass_number=self.pass_number[image_row[passing]],
            miss_m=miss[passing],
            point_in_world_m=center[passing] + along[passing, None] * direction[passing],
            distance_m=along[passing],
            label_id=self.label_of_detection[rows],
        )

    def labels_around(self, point_in_world_m: Floats, radius_m: float) -> Ints:
        """Return the rows of the labels within a horizontal distance of a point, the nearest first."""
        distance = self._horizontal_m(self.result.labels.position_in_world_m - point_in_world_m)
        rows = np.flatnonzero(distance <= radius_m)
        return rows[np.argsort(distance[rows], kind="stable")]

    def images_around(self, point_in_world_m: Floats, radius_m: float, *, horizontally: bool = False) -> Ints:
        """Return the rows of the images taken within a distance of a point, ascending."""
        place = self.dataset.frame.east_north() @ point_in_world_m
        # What is near is near from above: looking there first costs nothing in a map of a whole city.
        rows = np.sort(self._plan.pairs(place[None], radius_m * _ROUNDING)[1])
        away = self.center_in_world_m[rows] - point_in_world_m
        distance = self._horizontal_m(away) if horizontally else np.linalg.norm(away, axis=1)
        return rows[distance <= radius_m]

    def nearest_image(self, point_in_world_m: Floats) -> int:
        """Return the row of the image that was taken nearest to a point, seen from above."""
        return int(np.argmin(self._horizontal_m(self.center_in_world_m - point_in_world_m)))

    @cached_property
    def _plan(self) -> Nearby:
        """An index of the images by where they were taken, seen from above."""
        return Nearby(self.center_in_world_m @ self.dataset.frame.east_north().T)

    def project(self, image_row: Ints, point_in_world_m: Floats) -> Floats:
        """Return where points, one (3) or one per image (N, 3), are in images, px (N, 2); NaN behind the camera."""
        images, cameras = self.dataset.images, self.dataset.cameras
        point = np.broadcast_to(np.asarray(point_in_world_m, np.float64), (len(image_row), 3))
        rotation = rotation_of(images.cam_from_world_quat[image_row])
        in_cam = np.einsum("nij,nj->ni", rotation, point) + images.cam_from_world_m[image_row]
        camera_row = rows_of(images.camera_id[image_row], cameras.camera_id)
        pixel = np.full((len(image_row), 2), np.nan)
        for row in np.unique(camera_row):
            members = np.flatnonzero(camera_row == row)
            pixel[members] = lens_of(cameras, int(row)).img_from_cam(in_cam[members])
        return pixel

    def is_pictured(self, image_row: Ints, pixel: Floats) -> Bools:
        """Return which pixels (N, 2) are inside their images."""
        size = self.picture_size_px(image_row)
        with np.errstate(invalid="ignore"):
            inside: Bools = np.all((pixel >= 0.0) & (pixel <= size), axis=1)
        return inside

    def picture_size_px(self, image_row: Ints) -> Ints:
        """Return width and height (N, 2) of images."""
        images, cameras = self.dataset.images, self.dataset.cameras
        row = rows_of(images.camera_id[image_row], cameras.camera_id)
        return np.stack([cameras.width_px[row], cameras.height_px[row]], axis=1)

    def image_name(self, image_row: int) -> str:
        """Return the name of an image, as the dataset has it."""
        return str(self.dataset.images.name[image_row].as_py())

    def pass_name(self, image_row: int) -> str:
        """Return the name of the pass that an image is of, as the dataset has it."""
        passes = self.dataset.images.pass_id
        name: str = passes.names[passes.codes[image_row]]
        return name

    @cached_property
    def _detections_by_image(self) -> RowsByNumber:
        images = self.dataset.images
        return RowsByNumber.of(rows_of(self.dataset.detections.image_id, images.image_id), len(images))

    def detections_of_image(self, image_row: int) -> Ints:
        """Return the rows of the detections in an image."""
        return self._detections_by_image[image_row]

    def _misses_at(self, image_row: Ints, point: Floats, *, class_name: str | None) -> Misses:
        detections = self.dataset.detections
        image_row = image_row[np.argsort(self.drive_order[image_row], kind="stable")]
        pixel = self.project(image_row, point)
        nearest, distance_px = np.full(len(image_row), _NO_ROW), np.full(len(image_row), np.inf)
        of_image, found = self._detections_by_image.of_several(image_row)
        if class_name is not None:
            alike = detections.class_name.codes[found] == detections.class_name.code_of(class_name)
            of_image, found = of_image[alike], found[alike]
        apart = np.linalg.norm(detections.center_px[found] - pixel[of_image], axis=1)
        by_distance = np.lexsort((apart, of_image))
        having, first = np.unique(of_image[by_distance], return_index=True)
        best = by_distance[first]
        nearest[having], distance_px[having] = found[best], apart[best]
        taken = np.where(nearest >= 0, self.label_of_detection[nearest], _NO_ROW) if len(nearest) else nearest
        return Misses(
            image_row=image_row,
            pass_number=self.pass_number[image_row],
            projected_px=pixel,
            distance_m=np.linalg.norm(self.center_in_world_m[image_row] - point, axis=1),
            nearest_row=nearest,
            nearest_px=distance_px,
            nearest_label=taken,
        )

    def _horizontal_m(self, away: Floats) -> Floats:
        return np.asarray(np.linalg.norm(away @ self.dataset.frame.east_north().T, axis=1))


def _sector_middles(direction: Floats) -> Floats:
    """Return those of the unit vectors (N, 3) that are more than 15 degrees from all middles before them (K, 3)."""
    middles: list[Floats] = []
    while len(direction):
        middles.append(direction[0])
        direction = direction[direction @ direction[0] < SECTOR_COSINE]
    return np.array(middles).reshape(-1, 3)


# The dataset of a map, and its pictures.


def find_dataset(map_folder: Path, run: dict[str, Any], given: Path | None = None) -> Path | None:
    """Return the folder of the dataset that a map was made from, None where nobody can tell.

    It is the `given` one, else what run.json names as `dataset_folder` (from the map's folder), else a folder named
    `dataset` beside the map, which is where the demo has it.
    """
    if given is not None:
        return given
    named = run.get("dataset_folder")
    candidates = [Path(os.path.normpath(map_folder.absolute() / named))] if isinstance(named, str) else []
    candidates.append(map_folder.absolute().parent / "dataset")
    return next((folder for folder in candidates if (folder / MARKER).is_file()), None)


def dataset_reference(dataset_folder: Path, map_folder: Path) -> str:
    """Return what run.json holds as `dataset_folder`: the way from the map's folder, so that both can be moved."""
    try:
        return Path(os.path.relpath(dataset_folder.resolve(), map_folder.resolve())).as_posix()
    except ValueError:  # Another drive.
        return dataset_folder.resolve().as_posix()


def picture_file(pictures: Path | None, name: str) -> Path | None:
    """Return the file of an image's picture; None where there is none, or where its name leads out of the folder."""
    if pictures is None:
        return None
    folder = pictures.resolve()
    try:
        path = (folder / name).resolve()
        inside = os.path.commonpath([folder, path]) == str(folder)
        return path if inside and path.is_file() else None
    except (OSError, ValueError):  # Names that no file can have: too long, or with a zero byte.
        return None


def pictures_there(pictures: Path | None, names: list[str]) -> list[bool]:
    """Return for each image whether `picture_file` finds its picture; each folder is looked up once."""
    if pictures is None:
        return [False] * len(names)
    folder = os.path.realpath(pictures)
    known: dict[str, str | None] = {}

    def is_there(name: str) -> bool:
        path, base = os.path.split(name)
        if path not in known:
            real = os.path.realpath(Path(folder) / path)
            known[path] = real if os.path.commonpath([folder, real]) == folder else None
        real_path = known[path]
        if real_path is None or base in ("", ".", ".."):
            return False
        mode = os.lstat(f"{real_path}{os.sep}{base}").st_mode
        return stat.S_ISREG(mode) or (stat.S_ISLNK(mode) and picture_file(pictures, name) is not None)

    found = []
    for name in names:
        try:
            found.append(is_there(name))
        except (OSError, ValueError):
            found.append(False)
    return found


def cut_out(
    picture: Path | None, center_px: Floats, side_px: float, out_px: int, *, empty: tuple[int, int, int] = (48, 52, 58)
) -> NDArray[np.uint8]:
    """Return a square of a picture (out_px, out_px, 3), RGB, around a pixel; beyond the picture it is `empty`.

    Coordinates are those of the stored picture, whose orientation in EXIF does not count, as in COLMAP. Without a
    picture, or where it cannot be decoded, all is empty.
    """
    from PIL import Image  # Slow to import, and only crops need it.

    left, top = (float(c) - side_px / 2.0 for c in center_px)
    blank = np.full((out_px, out_px, 3), empty, np.uint8)
    if picture is None or not all(map(math.isfinite, (left, top, side_px))) or side_px <= 0.0:
        return blank
    try:
        with Image.open(picture) as stored:
            width = stored.width
            # JPEG can be decoded smaller, which is several times faster.
            sides = [max(1, math.ceil(side * 2.0 * out_px / side_px)) for side in stored.size]
            stored.draft("RGB", (sides[0], sides[1]))
            scale = stored.width / width
            image = stored.convert("RGB")
    except Exception:  # On damaged files Pillow's decoders raise nearly anything.
        return blank
    window = tuple(scale * c for c in (left, top, left + side_px, top + side_px))
    cut = image.transform((out_px, out_px), Image.Transform.EXTENT, window, Image.Resampling.BICUBIC, fillcolor=empty)
    return np.asarray(cut)
