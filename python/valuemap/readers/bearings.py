"""Bearings: where the camera was, in which direction an object, and maybe how far; nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, FoundBoxes, Imported, assemble
from valuemap.readers.boxes import NO_ANGLE, SINGLE
from valuemap.readers.cameras_of import make_cameras, parse_camera
from valuemap.readers.csv_file import CsvFile
from valuemap.readers.poses import height_where_none, local_from_cam, make_images, place_on_earth
from valuemap.readers.radians import tell_radians
from valuemap.readers.reader import Reader

_EXPECTED = "a CSV file with columns lat, lon, bearing (degrees clockwise from north) and maybe depth (metres)"
_TEXTS = ("image", "class", "pass")
_NUMBERS = ("lat", "lon", "height", "bearing", "depth", "score")
_TURN_DEG = 360.0
_WIDTH_PX, _HEIGHT_PX = 7200, 3600
"""Of the panorama that a place is taken for: 20 px a degree."""
VERTICAL_SIGMA_PX = _HEIGHT_PX / math.sqrt(2.0 * math.pi)
"""A normal density of this deviation is at its peak as high as the even one over the picture: no evidence."""


@Reader
def read_bearings(
    bearings: Path,
    *,
    columns: Mapping[str, str] | None = None,
    class_name: str = "object",
    depth_sigma: float = 0.3,
    camera_height_m: float = 0.0,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read a table with one row a detection: `lat, lon` of the camera, `bearing` and maybe `depth` of the object.

    Every distinct place is an image, a panorama that looks north, or every distinct text in the column `image` where
    there is one. Detections are on the horizon with a `vertical_sigma_px` that says that their elevation was not
    measured, and have no size. Optional columns are `class`, `score`, `pass` and `height` of the camera.

    Parameters
    ----------
    bearings
        The table.
    columns
        Under which name a column stands in it, where it is another one.
    class_name
        The class of detections that have none.
    depth_sigma
        Standard deviation of a depth as a fraction of it.
    camera_height_m
        Height of the cameras where the table has none.
    anchor
        Latitude, longitude and height of the origin; by default the place of the first image by name that is
        about where most are.
    tell
        Called with each line that is worth knowing about the positions.

    Raises
    ------
    InputError
        The file is no such table, or an image is at two places.
    SettingError
        An option is impossible.
    """
    if not 0.0 < depth_sigma < math.inf:
        raise SettingError(f"depth-sigma: expected above 0, found {depth_sigma:g}", hint="0.3 is 30 % of the depth")
    level_m = height_where_none(camera_height_m)
    progress("reading the bearings", 0, 1)
    table = CsvFile(bearings, _EXPECTED, texts=_TEXTS, numbers=_NUMBERS, columns=columns)
    lat, lon = (table.finite_numbers(name) for name in ("lat", "lon"))
    bearing_deg = table.numbers("bearing")
    height = table.finite_numbers("height") if table.has("height") else np.full(len(table), level_m)
    place = np.stack([lon, lat, height], axis=1)
    passes = table.filled_texts("pass", may_be_left_away=True) if table.has("pass") else [ONE_PASS] * len(table)
    names, first, image_of = _images(table, place, passes)
    placed = place_on_earth(place[first], anchor, names, source=str(bearings), tell=tell)
    level = np.zeros(len(first))
    cameras, camera_id = make_cameras([parse_camera(f"EQUIRECTANGULAR {_WIDTH_PX} {_HEIGHT_PX}")] * len(first), "")
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=placed.world_from_local @ local_from_cam(level, level, level),
        center_in_world_m=placed.position_in_world_m,
        passes=[passes[row] for row in first],
        source=str(bearings),
    )
    depth_m = table.numbers_or_none("depth") if table.has("depth") else None
    if tell is not None:
        tell_radians("bearing", bearing_deg, tell)
    x_px = ((bearing_deg / 360.0 + 0.5) % 1.0) * _WIDTH_PX
    dataset = assemble(
        name=bearings.stem,
        cameras=cameras,
        images=images,
        detections=FoundBoxes(
            image_row=image_of,
            class_names=table.texts("class") if table.has_optional("class") else [class_name] * len(table),
            center_px=np.stack([x_px, np.full(len(table), _HEIGHT_PX / 2.0)], axis=1),
            size_px=np.zeros((len(table), 2)),
            are_points=True,
            score=table.numbers("score") if table.has_optional("score") else np.ones(len(table)),
            where=table.line,
            range_m=depth_m,
            range_sigma_m=None if depth_m is None else depth_sigma * depth_m,
            vertical_sigma_px=np.full(len(table), VERTICAL_SIGMA_PX),
            entry=np.where(np.abs(bearing_deg) > _TURN_DEG, NO_ANGLE, SINGLE),
        ),
        up=None,
        anchor=placed.anchor,
        source=str(bearings),
        max_rejected=max_rejected,
    )
    progress("reading the bearings", 1, 1)
    return dataset


def _images(table: CsvFile, place: Floats, passes: list[str]) -> tuple[list[str], Ints, Ints]:
    """Return the names of the images in their order, the first row of each (M), and the image of each row (N)."""
    keys = (
        table.filled_texts("image", may_be_left_away=True)
        if table.has("image")
        else [f"{lat:.8f}_{lon:.8f}_{height:g}_{name}" for (lon, lat, height), name in zip(place, passes, strict=True)]
    )
    names, first, image_of = np.unique(np.array(keys), return_index=True, return_inverse=True)
    moved = np.flatnonzero((place != place[first[image_of]]).any(axis=1))
    if len(moved) and table.has("image"):  # Else they differ by less than a name tells.
        row = int(moved[0])
        raise InputError(
            f"{table.line(row)}: image {keys[row]!r} is at two places ({len(moved)} rows)",
            hint="give every place an image of its own, or remove the column image",
        )
    return [str(name) for name in names], first, image_of
