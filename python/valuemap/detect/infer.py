"""Pictures in, boxes out: decoded ahead by several threads, put through the network group by group."""

from __future__ import annotations

import math
import os
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from valuemap.config import MAX_CANVAS_PX, DetectConfig
from valuemap.detect.boxes import Boxes
from valuemap.detect.classes import WantedClasses, choose_classes
from valuemap.detect.journal import Outcome
from valuemap.detect.letterbox import Fit, Pixels, Size
from valuemap.detect.model import Model, load_model
from valuemap.detect.outputs import find_boxes
from valuemap.detect.panorama import PanoramaViews, plan_views
from valuemap.detect.pictures import Picture, UnusablePicture, read_picture
from valuemap.detect.structure import coarse_share
from valuemap.detect.tiles import Window, are_cut, inner_borders, merge_views, plan_tiles
from valuemap.remote import UrlPath

_ALL_INNER = (True, True, True, True)


@dataclass(frozen=True)
class Task:
    """One picture to look at; `camera` is the width and height that its camera says, if it has one."""

    path: Path | UrlPath
    camera: Size | None = None
    is_panorama: bool = False


@dataclass(frozen=True, eq=False)
class _Tile:
    """A part of a scene on the network's canvas."""

    window: Window
    fit: Fit
    canvas: Pixels


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A decoded picture: one scene of tiles, or, of a panorama, a scene a view."""

    picture: Picture
    in_stored_pixels: bool
    views: PanoramaViews | None
    scenes: list[list[_Tile]]


class Detector:
    """A model with what to do before and after it.

    Results depend on the model, the settings and the pictures of a group of `batch`, never on threads (0: one a core).

    Raises
    ------
    InputError, SettingError
        As `load_model` and `choose_classes`.
    """

    def __init__(self, model: Path, config: DetectConfig, *, threads: int = 0) -> None:
        self.config = config
        self.model: Model = load_model(model, config, threads=threads)
        self.wanted: WantedClasses = choose_classes(config.classes, self.model.class_names)
        if self.model.class_count is not None:
            self.wanted.columns(self.model.class_count)  # Complains now, not after the first picture.
        self.min_score = self.model.min_score if config.min_score is None else config.min_score
        self._decoders = config.decoders or threads or os.cpu_count() or 1
        self._views: dict[Size, PanoramaViews] = {}

    def run(self, tasks: Sequence[Task]) -> Iterator[list[Outcome]]:
        """Yield what became of the pictures, group by group, in their order.

        Memory does not grow with the number of pictures.
        """
        sizes = {task.camera for task in tasks if task.is_panorama and task.camera is not None}
        self._views |= {size: plan_views(size, self.config) for size in sorted(sizes - self._views.keys())}
        decoders = self._decoders
        ahead: deque[Future[_Prepared | Outcome]] = deque()
        waiting = iter(tasks)
        with ThreadPoolExecutor(decoders, thread_name_prefix="decode") as pool:
            try:
                while True:
                    while len(ahead) < decoders + self.config.batch and (task := next(waiting, None)) is not None:
                        ahead.append(pool.submit(self._prepare, task))
                    if not ahead:
                        return
                    count = min(self.config.batch, len(ahead))
                    yield self._detect([ahead.popleft().result() for _ in range(count)])
            finally:
                pool.shutdown(cancel_futures=True)

    def _prepare(self, task: Task) -> _Prepared | Outcome:
        """Decode one picture and cut it into what the network sees; runs in the decoding threads."""
        try:
            picture = read_picture(task.path, upright=not task.is_panorama)
            in_stored_pixels = _is_of_stored_pixels(picture, task)
            if not self._has_structure(picture):
                return Outcome(Boxes.none(), picture.stored, was_turned=picture.orientation != 1, has_structure=False)
            around = self._views[picture.stored] if task.is_panorama else None
            scenes = (
                [picture.pixels] if around is None else [around.draw(picture.pixels, i) for i in range(around.count)]
            )
            return _Prepared(picture, in_stored_pixels, around, [self._cut(pixels) for pixels in scenes])
        except UnusablePicture as problem:
            return Outcome(Boxes.none(), problem=str(problem))

    def _has_structure(self, picture: Picture) -> bool:
        least = self.model.min_coarse_share
        return least <= 0.0 or coarse_share(picture.pixels) >= least

    def _cut(self, pixels: Pixels) -> list[_Tile]:
        size = (pixels.shape[1], pixels.shape[0])
        tiles = []
        for window in plan_tiles(size, self.config.tile_px, self.config.tile_overlap_px):
            left, top, right, bottom = window
            fit = self.model.fit((right - left, bottom - top), self.config.size_px)
            if fit.canvas[0] * fit.canvas[1] > MAX_CANVAS_PX:
                raise UnusablePicture(
                    f"is {fit.canvas[0]} x {fit.canvas[1]} px, too much for a network at once: use --tile or --size"
                )
            tiles.append(_Tile(window, fit, fit.draw(pixels[top:bottom, left:right])))
        return tiles

    def _detect(self, group: Sequence[_Prepared | Outcome]) -> list[Outcome]:
        prepared = [entry for entry in group if isinstance(entry, _Prepared)]
        found = iter(self._boxes_of([tile for entry in prepared for scene in entry.scenes for tile in scene]))
        return [entry if isinstance(entry, Outcome) else self._assemble(entry, found) for entry in group]

    def _boxes_of(self, tiles: Sequence[_Tile]) -> list[Boxes]:
        """Return the boxes of each tile, in pixels of the tile."""
        rows_of_size: dict[Size, list[int]] = defaultdict(list)
        for row, tile in enumerate(tiles):
            rows_of_size[tile.fit.canvas].append(row)
        at_once = self.model.fixed_batch or self.config.batch
        boxes = [Boxes.none()] * len(tiles)
        for rows in rows_of_size.values():
            for first in range(0, len(rows), at_once):
                batch = rows[first : first + at_once]
                outputs = self.model.run([tiles[row].canvas for row in batch])
                for entry, row in enumerate(batch):
                    boxes[row] = find_boxes(
                        self.model,
                        outputs,
                        entry,
                        tiles[row].fit,
                        self.wanted,
                        min_score=self.min_score,
                        max_iou=self.config.max_iou,
                    )
        return boxes

    def _assemble(self, prepared: _Prepared, found: Iterator[Boxes]) -> Outcome:
        """Put the boxes of all tiles and views of a picture together, in its stored pixels."""
        scenes = [self._join_tiles(scene, [next(found) for _ in scene]) for scene in prepared.scenes]
        picture, views = prepared.picture, prepared.views
        if views is None:
            boxes = scenes[0]
            if prepared.in_stored_pixels:
                boxes = picture.to_stored(boxes)
        else:
            whole = (0, 0, views.side_px, views.side_px)
            boxes = merge_views(
                [views.to_panorama(scene, i) for i, scene in enumerate(scenes)],
                [are_cut(scene, whole, _ALL_INNER) for scene in scenes],
                self.config.max_iou,
                period_px=float(views.panorama[0]),
            )
        order = np.lexsort((boxes.center_px[:, 1], boxes.center_px[:, 0], boxes.class_code, -boxes.score))
        return Outcome(boxes.take(order), picture.stored, was_turned=picture.orientation != 1)

    def _join_tiles(self, tiles: Sequence[_Tile], found: Sequence[Boxes]) -> Boxes:
        if len(tiles) == 1:
            return found[0]
        size = (max(tile.window[2] for tile in tiles), max(tile.window[3] for tile in tiles))
        placed = [
            boxes.moved(boxes.center_px + np.array(tile.window[:2], np.float64), boxes.size_px)
            for tile, boxes in zip(tiles, found, strict=True)
        ]
        cuts = [
            are_cut(boxes, tile.window, inner_borders(tile.window, size))
            for tile, boxes in zip(tiles, placed, strict=True)
        ]
        return merge_views(placed, cuts, self.config.max_iou, period_px=math.inf)


def _is_of_stored_pixels(picture: Picture, task: Task) -> bool:
    """Return whether the camera of a picture is that of the stored pixels, or else of the upright ones.

    Raises
    ------
    UnusablePicture
        The camera is of another size.
    """
    if task.camera is None or task.camera == picture.stored:
        return True
    if task.camera == picture.upright:
        return False
    width, height = picture.stored
    raise UnusablePicture(f"is {width} x {height} px, but its camera {task.camera[0]} x {task.camera[1]}")
