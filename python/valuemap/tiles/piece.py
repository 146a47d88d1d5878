"""What a cell is solved with: its images and those around it, in driving order, as a dataset of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valuemap.drives import Drives, InOrder
from valuemap.tables import Ints


def piece_of_rows(ordered: InOrder, rows: Ints) -> InOrder:
    """Return some images (rows, ascending) with their detections.

    Drives and viewpoints are numbered anew, in their order: what else is in the data must not matter.
    """
    images, detections = ordered.dataset.images, ordered.dataset.detections
    # The detections are in the order of their images, whose ids are their rows.
    first, end = (np.searchsorted(detections.image_id, rows, side=side) for side in ("left", "right"))
    count = end - first
    detection_rows = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(int(count.sum()))
    drives, cameras = ordered.drives, ordered.dataset.cameras
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
        Drives(
            pass_code=np.unique(drives.pass_code[rows], return_inverse=True)[1],
            order=drives.order[rows],
            driven_m=drives.driven_m[rows],
            viewpoint=np.unique(drives.viewpoint[rows], return_inverse=True)[1],
            record={},
        ),
        ordered.image_id[rows],
        ordered.detection_id[detection_rows],
    )
