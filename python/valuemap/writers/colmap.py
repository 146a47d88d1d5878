"""COLMAP: the labels as 3D points, with the images that vote for them as tracks, to open in COLMAP's viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from valuemap.arrays import RowsByNumber
from valuemap.cameras import colmap_camera
from valuemap.dataset import Dataset, rows_of
from valuemap.errors import InputError
from valuemap.writers.attributes import Export, refuse_crs

if TYPE_CHECKING:
    from valuemap.colmap import pycolmap

_COLORS = ((230, 75, 53), (77, 187, 213), (0, 160, 135), (60, 84, 136), (243, 155, 127), (132, 145, 180))


FILES = tuple(
    f"{name}{suffix}" for suffix in (".bin", ".txt") for name in ("cameras", "frames", "images", "points3D", "rigs")
)
"""What a model may be made of."""


def write_colmap(export: Export, folder: Path) -> None:
    """Write a whole model into a folder: cameras, images with their detections as 2D points, and the labels.

    It is text, but where names of images have white space, which ends a name in text: then it is binary.
    `ERROR` of a point is its reprojection error in pixels, its track the votes.

    Raises
    ------
    InputError
        The dataset of the map is not known.
    OutputError
        Another reference system is asked for.
    """
    from valuemap.colmap import pycolmap  # Slow to import, and only this format needs it.

    refuse_crs(export, "a COLMAP model holds metres in the frame of the map")
    dataset = export.dataset
    if dataset is None:
        raise InputError(
            "a COLMAP model holds the images, and the dataset of the map is not known",
            hint="give it with --dataset",
        )
    model = pycolmap.Reconstruction()
    for row in range(len(dataset.cameras)):
        camera = colmap_camera(dataset.cameras, row)
        camera.camera_id = _number(dataset.cameras.camera_id[row])
        model.add_camera_with_trivial_rig(camera)
    first_point = _add_images(model, dataset)
    _add_labels(model, export, dataset, first_point)
    if any(name.split() != [name] for name in dataset.images.name.to_pylist()):
        model.write_binary(str(folder))
    else:
        model.write_text(str(folder))


def _add_images(model: pycolmap.Reconstruction, dataset: Dataset) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Add all images with their detections; return the number (detections) of each detection within its image."""
    from valuemap.colmap import pycolmap

    images, detections = dataset.images, dataset.detections
    image_row = rows_of(detections.image_id, images.image_id)
    by_image = RowsByNumber.of(image_row, len(images))
    within = np.empty(len(image_row), np.int64)
    within[by_image.order] = np.arange(len(image_row)) - by_image.first[image_row[by_image.order]]
    for row, name in enumerate(images.name.to_pylist()):
        w, x, y, z = images.cam_from_world_quat[row].tolist()
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), images.cam_from_world_m[row])
        members = by_image[row]
        image = pycolmap.Image(
            name=name,
            points2D=[pycolmap.Point2D(center) for center in detections.center_px[members]],
            camera_id=_number(images.camera_id[row]),
            image_id=_number(images.image_id[row]),
        )
        model.add_image_with_trivial_frame(image, pose)
    return within


def _add_labels(
    model: pycolmap.Reconstruction,
    export: Export,
    dataset: Dataset,
    first_point: np.ndarray[tuple[int], np.dtype[np.int64]],
) -> None:
    from valuemap.colmap import pycolmap

    result = export.result
    export.image_row_of_vote  # noqa: B018  Raises where votes are not by this dataset.
    number = first_point[rows_of(result.votes.detection_id, dataset.detections.detection_id)]
    by_label = RowsByNumber.of(np.searchsorted(result.labels.label_id, result.votes.label_id), len(result.labels))
    for row in range(len(result.labels)):
        track = pycolmap.Track()
        for vote in by_label[row].tolist():
            track.add_element(_number(result.votes.image_id[vote]), int(number[vote]))
        color = _COLORS[result.labels.class_name.codes[row] % len(_COLORS)]
        point = pycolmap.Point3D(
            xyz=result.labels.position_in_world_m[row],
            color=np.array(color, np.uint8),
            error=float(result.labels.reprojection_rms_px[row]),
            track=track,
        )
        model.add_point3D_with_id(int(result.labels.label_id[row]), point)


def _number(value: np.int64) -> int:
    """Return an id that COLMAP can hold."""
    if not 0 <= value < 2**32 - 1:
        raise InputError(f"id {value}: COLMAP holds ids from 0 to 2^32 - 2 only", hint="number images and cameras anew")
    return int(value)
