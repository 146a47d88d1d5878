"""Which known object a detection shows, for datasets with truth: by where the object is in the picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from valuemap.arrays import Bools, Floats, Ints, RowsByNumber
from valuemap.cameras import camera_poses, lens_of
from valuemap.dataset import rows_of
from valuemap.tables import Cameras, Detections, Images, Truth, TruthDetections

_MAX_RANGE_M = 200.0
_SLACK_PX = 4.0
"""For boxes that are smaller than the errors of the poses."""
_IMAGES_AT_ONCE = 2000
"""Bounds memory, changes no result."""


def find_truth_detections(cameras: Cameras, images: Images, detections: Detections, truth: Truth) -> TruthDetections:
    """Return the object that each detection shows: of its class, projected within a box of its centre, the closest.

    Closeness is in widths and heights of the box. An object is nearer than 200 m and shown at most once an image.
    """
    by_image = RowsByNumber.of(rows_of(detections.image_id, images.image_id), len(images))
    with_detections = np.flatnonzero(by_image.count)
    tree = cKDTree(truth.position_in_world_m)
    rotation, centers = camera_poses(images)
    same_class = _same_class(detections, truth)
    rows, objects = [], []
    for begin in range(0, len(with_detections), _IMAGES_AT_ONCE):
        chunk = with_detections[begin : begin + _IMAGES_AT_ONCE]
        near: Any = tree.query_ball_point(centers[chunk], _MAX_RANGE_M, return_sorted=True)
        image = np.repeat(chunk, [len(found) for found in near])
        known = np.concatenate([np.array(found, np.int64) for found in near])
        in_cam = np.einsum("nij,nj->ni", rotation[image], truth.position_in_world_m[known] - centers[image])
        place_px = _project(cameras, rows_of(images.camera_id, cameras.camera_id)[image], in_cam)
        # Every detection of an image with every object near it.
        pair, row = by_image.of_several(image)
        away = np.abs(place_px[pair] - detections.center_px[row]) / (detections.size_px[row] + _SLACK_PX)
        is_shown = (away <= 1.0).all(axis=1) & same_class[detections.class_name.codes[row], known[pair]]
        distance = np.linalg.norm(away[is_shown], axis=1)
        row, seen, image_of_pair = row[is_shown], known[pair][is_shown], image[pair][is_shown]
        best = _first_of_each(np.lexsort((seen, distance, row)), row)
        row, seen, image_of_pair, distance = row[best], seen[best], image_of_pair[best], distance[best]
        key = image_of_pair * len(truth) + seen
        best = _first_of_each(np.lexsort((row, distance, key)), key)
        rows.append(row[best])
        objects.append(seen[best])
    row = np.concatenate([np.empty(0, np.int64), *rows])
    known = np.concatenate([np.empty(0, np.int64), *objects])
    by_id = np.argsort(detections.detection_id[row], kind="stable")
    return TruthDetections(detections.detection_id[row][by_id], truth.object_id[known][by_id])


def _same_class(detections: Detections, truth: Truth) -> Bools:
    """Return (classes of detections, objects) which objects have the class."""
    names = np.array(detections.class_name.names, dtype=object)
    known = np.array(truth.class_name.texts(), dtype=object)
    same: Bools = (names[:, None] == known[None]).astype(np.bool_)
    return same


def _project(cameras: Cameras, camera_row: Ints, in_cam_m: Floats) -> Floats:
    """Return pixels (N, 2) of points in front of their cameras, NaN for the others."""
    place = np.full((len(in_cam_m), 2), np.nan)
    for row in np.unique(camera_row):
        camera = lens_of(cameras, int(row))
        members = np.flatnonzero((camera_row == row) & ((in_cam_m[:, 2] > 0.0) | camera.is_spherical()))
        place[members] = camera.img_from_cam(in_cam_m[members])
    return place


def _first_of_each(order: Ints, key: Ints) -> Ints:
    """Return the first row, in the given order, of each distinct key; the order groups equal keys."""
    grouped = key[order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = grouped[1:] != grouped[:-1]
    return order[is_first]
