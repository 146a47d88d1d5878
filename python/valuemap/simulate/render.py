"""Pictures of a recorded simulation: what the cameras saw, with the true boxes of the lights."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from valuemap.arrays import Floats
from valuemap.folders import new_file
from valuemap.progress import Progress, counted, silent
from valuemap.simulate.canvas import Picture
from valuemap.simulate.paint import Painter
from valuemap.simulate.scene import build_world, look, true_boxes
from valuemap.simulate.simulation import Recording

IMAGES = "images"
BOXES = "boxes.json"
_QUALITY = 90
_AHEAD = 4
"""Pictures under way for each thread: enough to keep them busy, few enough to keep memory flat."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class RenderedPicture:
    """One picture: `image` (height, width, 3) is red, green, blue.

    `boxes_px` (N, 4) and `ignored_px` (K, 4) are centre x, y, width and height of the lights that a detector
    should find, and of those that it may find: half hidden, cut off, tiny or seen from the side.
    """

    row: int
    name: str
    image: Picture
    boxes_px: Floats
    ignored_px: Floats


def render_pictures(
    recording: Recording, *, rows: Iterable[int] | None = None, threads: int = 0, progress: Progress = silent
) -> Iterator[RenderedPicture]:
    """Yield pictures of a recording, in the order of `rows` (of `recording.dataset.images`; None for all).

    The same recording gives the same pictures, whichever rows are asked for and by however many threads (0: one
    a core). Weather goes by pass.
    """
    wanted = list(range(len(recording.frames)) if rows is None else rows)
    names = recording.dataset.images.name.to_pylist()
    world = build_world(recording)
    painter = Painter(world)

    def render(row: int) -> RenderedPicture:
        scene = look(world, row)
        boxes_px, ignored_px = true_boxes(world, scene)
        return RenderedPicture(row, names[row], painter.paint(scene), boxes_px, ignored_px)

    with counted(progress, "rendering", len(wanted)) as tell:
        for done, picture in enumerate(_in_threads(render, wanted, threads)):
            yield picture
            tell(done + 1)


def render_images(recording: Recording, folder: Path, *, threads: int = 0, progress: Progress = silent) -> int:
    """Write the pictures of a recording and their true boxes into the folder of its dataset.

    Pictures become `images/NAME`, with the names in images.parquet. One that is there already stays as it is,
    so that a call after an interrupted one goes on from there. The true boxes become `boxes.json` in COCO's
    format; `iscrowd` marks lights that a detector may find or not.

    Returns
    -------
    int
        How many pictures were painted.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    world = build_world(recording)
    painter = Painter(world)
    names = recording.dataset.images.name.to_pylist()
    painted = 0

    def render(row: int) -> tuple[Floats, Floats, bool]:
        scene = look(world, row)
        path = folder / IMAGES / names[row]
        is_missing = not path.is_file()
        if is_missing:
            bgr = cv2.cvtColor(painter.paint(scene), cv2.COLOR_RGB2BGR)
            _, coded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            with new_file(path) as fresh:
                fresh.write_bytes(coded.tobytes())
        return *true_boxes(world, scene), is_missing

    rows = range(len(recording.frames))
    boxes: list[tuple[Floats, Floats]] = []
    with counted(progress, "rendering", len(rows)) as tell:
        for should, may, is_new in _in_threads(render, rows, threads):
            boxes.append((should, may))
            painted += is_new
            tell(len(boxes))
    with new_file(folder / BOXES) as fresh:
        fresh.write_text(json.dumps(_coco(recording, names, boxes)), encoding="utf-8")
    return painted


def _in_threads(work: Callable[[int], T], rows: Iterable[int], threads: int) -> Iterator[T]:
    """Yield the results of rows in their order, from a pool that works a little ahead."""
    count = threads or os.cpu_count() or 1
    waiting = iter(rows)
    with ThreadPoolExecutor(count) as pool:
        under_way: list[Future[T]] = [pool.submit(work, row) for row in islice(waiting, _AHEAD * count)]
        try:
            while under_way:
                yield under_way.pop(0).result()
                under_way += [pool.submit(work, row) for row in islice(waiting, 1)]
        finally:
            for future in under_way:
                future.cancel()


def _coco(recording: Recording, names: list[str], boxes: list[tuple[Floats, Floats]]) -> dict[str, Any]:
    """Return the true boxes as COCO has them: left, top, width, height."""
    config = recording.config
    size = {"width": config.image_width_px, "height": config.image_height_px}
    ids = recording.dataset.images.image_id.tolist()
    annotations: list[dict[str, Any]] = []
    for image_id, of_image in zip(ids, boxes, strict=True):
        for is_crowd, box in enumerate(of_image):
            corner = np.concatenate([box[:, :2] - box[:, 2:] / 2.0, box[:, 2:]], axis=1)
            for left_top_size in np.round(corner, 3).tolist():
                annotations.append(
                    {
                        "id": len(annotations) + 1,
                        "image_id": image_id,
                        "category_id": 1,
                        "bbox": left_top_size,
                        "area": round(left_top_size[2] * left_top_size[3], 3),
                        "iscrowd": is_crowd,
                    }
                )
    return {
        "images": [{"id": i, "file_name": name, **size} for i, name in zip(ids, names, strict=True)],
        "categories": [{"id": 1, "name": "traffic_light"}],
        "annotations": annotations,
    }
