"""What a cell is solved with: its images and those around it, in driving order, as a dataset of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valuemap.arrays import Ints, rows_in_runs
from valuemap.drives import InOrder


def piece_of_rows(ordered: InOrder, rows: Ints) -> InOrder:
    """Return some images (rows, ascending) with their detections.

    Drives and viewpoints are numbered anew, in their order: what else is in the data must not matter.
    """
    images, detections = ordered.dataset.images, ordered.dataset.detections
    first = ordered.first_detection[rows]
    count = ordered.first_detection[rows + 1] - first
    detection_rows = rows_in_runs(first, count)
    drives, cameras = ordered.drives.take(rows), ordered.dataset.cameras
    return InOrder(
        replace(
            ordered.dataset,
            cameras=cameras.take(np.isin(cameras.camera_id, images.camera_id[rows])),
            images=images.take(rows).replace(image_id=np.arange(len(rows))),
            detections=detections.take(detection_rows).replace(
                detection_id=np.arange(len(detection_rows)), image_id=np.repeat(np.arange(len(rows)), count)
            ),
            truth=None,
            truth_detections=None,
            rejected=None,
        ),
        replace(drives, pass_code=renumbered(drives.pass_code), viewpoint=renumbered(drives.viewpoint), record={}),
        ordered.image_id[rows],
        ordered.detection_id[detection_rows],
    )


def renumbered(ascending: Ints) -> Ints:
    """Return numbers (N) that ascend, without gaps and from 0."""
    return np.concatenate([[0], np.cumsum(np.diff(ascending) != 0)])[: len(ascending)]
