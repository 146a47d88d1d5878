"""Boxes of images that are known by name, as the formats of detections have them, and finding these images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from valuemap.dataset import rows_of
from valuemap.errors import InputError, SettingError
from valuemap.readers.assemble import FoundBoxes
from valuemap.readers.names import match_images
from valuemap.readers.texts import Texts
from valuemap.tables import Cameras, Floats, Images, Ints


@dataclass(frozen=True)
class DetectionFile:
    """A file or folder of detections and how to read it.

    Parameters
    ----------
    path
        File, or folder of files.
    format
        A name in `DETECTIONS`, or "auto" for what the path says.
    class_name
        The class of boxes that have none.
    pixel_center
        Coordinates of the centre of the top-left pixel: 0.5 where they count from the picture's corner (COLMAP, COCO),
        0 where from that pixel (OpenCV, KITTI).
    full_score
        The score that means certain: scores are divided by it.
    columns
        Under which name a column stands in a CSV file, where it is another one.
    fractions
        Whether the coordinates of a CSV file are fractions of the picture's width and height.
    """

    path: Path
    format: str = "auto"
    class_name: str = "object"
    pixel_center: float = 0.5
    full_score: float = 1.0
    columns: Mapping[str, str] = field(default_factory=dict)
    fractions: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.full_score < float("inf"):
            raise SettingError(f"full-score: expected above 0, found {self.full_score:g}", hint="for example 100")
        if self.pixel_center not in (0.0, 0.5):
            raise SettingError(f"pixel-center: expected 0 or 0.5, found {self.pixel_center:g}", hint="COLMAP has 0.5")


@dataclass(frozen=True, eq=False)
class NamedBoxes:
    """Boxes (N) of images that are known by name.

    Centres and sizes (N, 2) are in pixels from the picture's corner, or fractions of its width and height; NaN where
    the file holds no number. Without sizes nothing is known of them. `where(row)` says where a box stands in the file,
    `pictures` the width and height of pictures as far as the file says.
    """

    image_names: Sequence[str]
    class_names: Sequence[str]
    center: Floats
    size: Floats | None
    score: Floats
    where: Callable[[int], str]
    fractions: bool = False
    detection_id: Ints | None = None
    pictures: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    other_names: Sequence[str] = ()
    """Names of images without boxes: what is told apart by them must be told apart."""
    range_m: Floats | None = None
    range_sigma_m: Floats | None = None
    vertical_sigma_px: Floats | None = None


def find_images(boxes: NamedBoxes, images: Images, cameras: Cameras, file: DetectionFile) -> FoundBoxes:
    """Return the boxes with the rows of their images, -1 where there is none of the name.

    Raises
    ------
    InputError
        There are no boxes, or they were made on pictures of another size.
    """
    if not len(boxes.image_names):
        raise InputError(f"{file.path}: there are no detections in it", hint="did the detector find anything?")
    names = Texts.of(boxes.image_names)
    row_of = match_images({*names.distinct, *boxes.other_names}, images.name.to_pylist())
    row_of_name = np.array([row_of.get(name, -1) for name in names.distinct], dtype=np.int64)
    image_row = row_of_name[names.codes]
    camera_row = rows_of(images.camera_id, cameras.camera_id)
    _refuse_other_sizes(boxes, names.distinct, row_of, camera_row, cameras, file.path)
    center, size = boxes.center, boxes.size
    if boxes.fractions:
        picture_px = np.stack([cameras.width_px, cameras.height_px], axis=1)[camera_row[image_row]].astype(np.float64)
        center, size = center * picture_px, None if size is None else size * picture_px
    return FoundBoxes(
        image_row=image_row,
        class_names=boxes.class_names,
        center_px=center + (0.5 - file.pixel_center),
        size_px=np.zeros((len(image_row), 2)) if size is None else size,
        are_points=boxes.size is None,
        score=boxes.score / file.full_score,
        where=boxes.where,
        image_names=names,
        detection_id=boxes.detection_id,
        range_m=boxes.range_m,
        range_sigma_m=boxes.range_sigma_m,
        vertical_sigma_px=boxes.vertical_sigma_px,
    )


def _refuse_other_sizes(
    boxes: NamedBoxes, names: Sequence[str], row_of: Mapping[str, int], camera_row: Ints, cameras: Cameras, path: Path
) -> None:
    """Refuse boxes that were made on pictures of another size than the cameras', resized or undistorted."""
    used = set(names)
    for name, size in boxes.pictures.items():
        if name not in used or name not in row_of:
            continue
        camera = camera_row[row_of[name]]
        expected = (int(cameras.width_px[camera]), int(cameras.height_px[camera]))
        if size != expected:
            raise InputError(
                f"{path}: {name!r}: expected {expected[0]} x {expected[1]} px as in the "
                f"model, found {size[0]} x {size[1]}",
                hint="run the detector on the pictures that the model was made of, or scale boxes and sizes",
            )
