"""Boxes of images that are known by name, as the formats of detections have them, and finding these images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.dataset import rows_of
from valuemap.errors import InputError, SettingError
from valuemap.readers.boxes import BoxWriter, FiledBoxes
from valuemap.readers.names import match_images
from valuemap.readers.pixel_center import shift_to_corner_px
from valuemap.readers.row_file import RowFile
from valuemap.tables import Cameras, Images

CORNER = 0.5
"""The centre of the top-left pixel where pixels count from the picture's corner."""
OF_OTHERS = (
    "Label Studio, Supervisely, Labelbox and the like export COCO, YOLO or Pascal VOC; what is of another kind, as "
    "BDD100K, nuImages and Cityscapes, can be a CSV table: image,x1,y1,x2,y2,class"
)
"""What to do with boxes in formats that are not read."""
_PIXEL_CENTER = "detection-pixel-center"


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
        0 where from that pixel (OpenCV, KITTI). None for what is usual: 0.5, and 0 in KITTI's tables of frames.
    full_score
        The score that means certain: scores are divided by it.
    columns
        Under which name a column stands in a CSV file, where it is another one.
    fractions
        Whether the coordinates of a CSV file are fractions of the picture's width and height.
    image_list
        A COCO file whose `images` and `categories` say what the ids of results are, which name neither.
    """

    path: Path
    format: str = "auto"
    class_name: str = "object"
    pixel_center: float | None = None
    full_score: float = 1.0
    columns: Mapping[str, str] = field(default_factory=dict)
    fractions: bool = False
    image_list: Path | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.full_score < float("inf"):
            raise SettingError(f"full-score: expected above 0, found {self.full_score:g}", hint="for example 100")
        self.shift_to_corner_px()

    def shift_to_corner_px(self, usual: float = CORNER) -> float:
        """Return what has to be added to pixels, where `usual` is where they count from unless something is given."""
        return shift_to_corner_px(usual if self.pixel_center is None else self.pixel_center, _PIXEL_CENTER)


@dataclass(frozen=True, eq=False)
class NamedBoxes:
    """Boxes (N) of images that are known by name, in a temporary file.

    Parameters
    ----------
    rows
        Their numbers, with a number for each distinct name of an image and class. Centres and sizes are in pixels from
        the picture's corner, or fractions of its width and height; NaN where the file holds no number.
    image_names, class_names
        The names by their numbers.
    where
        Returns where a box stands in the file, for its row.
    fractions
        Whether they are fractions.
    are_points
        Whether nothing is known of sizes.
    has_ids
        Whether all have whole numbers of their own.
    pictures
        Width and height of pictures as far as the file says.
    other_names
        Names of images without boxes: what is told apart by them must be told apart.
    """

    rows: RowFile
    image_names: Sequence[str]
    class_names: Sequence[str]
    where: Callable[[int], str]
    fractions: bool = False
    are_points: bool = False
    has_ids: bool = False
    pictures: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    other_names: Sequence[str] = ()

    @classmethod
    def of_columns(
        cls,
        image_names: Sequence[str],
        class_names: Sequence[str],
        center: Floats,
        size: Floats,
        score: Floats,
        entry: Ints | None = None,
        **rest: Any,
    ) -> NamedBoxes:
        """Return boxes (N) that are in memory; `entry` is as in `FiledBoxes`, `rest` as above."""
        writer = BoxWriter()
        names = writer.images.codes_of(image_names), writer.classes.codes_of(class_names)
        writer.add(image=names[0], kind=names[1], center=center, size=size, score=score, entry=entry)
        return cls(writer.rows, writer.images.texts, writer.classes.texts, **rest)


def find_images(boxes: NamedBoxes, images: Images, cameras: Cameras, file: DetectionFile) -> FiledBoxes:
    """Return the boxes with the rows of their images, -1 where there is none of the name.

    Raises
    ------
    InputError
        There are no boxes, or they were made on pictures of another size.
    """
    if not len(boxes.rows):
        raise InputError(f"{file.path}: there are no detections in it", hint="did the detector find anything?")
    row_of = match_images({*boxes.image_names, *boxes.other_names}, images.name.to_pylist())
    image_row = np.array([row_of.get(name, -1) for name in boxes.image_names], dtype=np.int64)
    camera_row = rows_of(images.camera_id, cameras.camera_id)
    _refuse_other_sizes(boxes, row_of, camera_row, cameras, file.path)
    picture_px = np.stack([cameras.width_px, cameras.height_px], axis=1)[camera_row[image_row]].astype(np.float64)
    return FiledBoxes(
        rows=boxes.rows,
        image_row=image_row,
        image_names=boxes.image_names,
        class_names=boxes.class_names,
        where=boxes.where,
        has_ids=boxes.has_ids,
        are_points=boxes.are_points,
        source=str(file.path),
        picture_px=picture_px if boxes.fractions else None,
        shift_px=file.shift_to_corner_px(),
        full_score=file.full_score,
    )


def _refuse_other_sizes(
    boxes: NamedBoxes, row_of: Mapping[str, int], camera_row: Ints, cameras: Cameras, path: Path
) -> None:
    """Refuse boxes that were made on pictures of another size than the cameras', resized or undistorted."""
    used = set(boxes.image_names)
    for name, size in boxes.pictures.items():
        if name not in used or name not in row_of:
            continue
        # Datumaro writes 0 for what it does not know.
        if any(type(side) in (int, float) and side <= 0 for side in size):
            continue
        camera = camera_row[row_of[name]]
        expected = (int(cameras.width_px[camera]), int(cameras.height_px[camera]))
        if size != expected:
            raise InputError(
                f"{path}: {name!r}: expected {expected[0]} x {expected[1]} px as in the "
                f"model, found {size[0]} x {size[1]}",
                hint="run the detector on the pictures that the model was made of, or scale boxes and sizes",
            )
