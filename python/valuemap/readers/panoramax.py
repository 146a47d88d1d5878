"""Panoramax: items of its STAC API as JSON in files, with their annotations."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from valuemap.errors import InputError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, FoundBoxes, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras, panorama
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import check_file, file_in, read_json
from valuemap.readers.json_values import Json, Told
from valuemap.readers.poses import height_where_none, local_from_cam, make_images, place_on_earth
from valuemap.readers.reader import Reader
from valuemap.tables import Images

_EXPECTED = "JSON of Panoramax: a STAC item, or a collection of features with geometry, properties and id"
_WHOLE_TURN_DEG = 360.0


@dataclass
class _Found:
    """Images and boxes read so far, and what was told of them."""

    told: Told = field(default_factory=Told)
    ids: list[str] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    place: list[list[float]] = field(default_factory=list)
    angles_deg: list[list[float]] = field(default_factory=list)
    passes: list[str] = field(default_factory=list)
    time: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    image_of_box: list[int] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    edges: list[list[float]] = field(default_factory=list)
    where: list[str] = field(default_factory=list)


@Reader
def read_panoramax(
    export: Path,
    *,
    detections: DetectionFile | Path | None = None,
    class_key: str | None = None,
    camera_height_m: float = 0.0,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read items as the API gives them; nothing is fetched.

    The heading of the middle of a picture is `view:azimuth`; `pers:pitch` and `pers:roll` are used where they are
    there. `pers:interior_orientation` has the size (`sensor_array_dimensions`) and the horizontal `field_of_view`: 360
    degrees is a panorama, less a pinhole camera. `quality:horizontal_accuracy` is the deviation of the position. Passes
    are collections, and images are named `ID.jpg`. Positions have no height but `camera_height_m`, unless they do.

    Annotations are `shape`s in pixels from the top left, polygons or four numbers, whose class is the value of the
    semantic tag `class_key`, or else `KEY=VALUE` of the first tag.

    Parameters
    ----------
    export
        A JSON file, or a folder of them.
    detections
        As in `read_detections`, instead of the annotations; images are named by their ids.
    anchor
        Latitude, longitude and height of the origin; by default the place of the first image by name.

    Raises
    ------
    InputError
        A file is missing, damaged or of another format, or an item lacks its size or field of view.
    SettingError
        `camera_height_m` is no number.
    """
    level_m = height_where_none(camera_height_m)
    paths = (
        [file_in(export, path.name, _EXPECTED) for path in sorted(export.glob("*.*json"))]
        if export.is_dir()
        else [check_file(export, _EXPECTED)]
    )
    if not paths:
        raise InputError(f"{export}: there are no JSON files in it", hint=f"expected {_EXPECTED}")
    found = _Found()
    for number, path in enumerate(paths):
        progress("reading the items", number, len(paths))
        content = Json(read_json(path, _EXPECTED), str(path), f"expected {_EXPECTED}")
        items = [content] if content.object().get("type") == "Feature" else list(content["features"].entries())
        for item in items:
            _add_item(item, found, class_key, level_m)
    if not found.ids:
        raise InputError(f"{export}: there are no items in it", hint=f"expected {_EXPECTED}")
    names = [f"{key}.jpg" for key in found.ids]
    placed = place_on_earth(np.array(found.place), anchor, names.index(min(names)), source=str(export))
    heading, pitch, roll = np.radians(found.angles_deg).T
    cameras, camera_id = make_cameras(found.cameras, str(export))
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=placed.world_from_local @ local_from_cam(heading, pitch, roll),
        center_in_world_m=placed.position_in_world_m,
        passes=found.passes,
        source=str(export),
        timestamp_s=np.array(found.time),
        position_sigma_m=np.array(found.sigma_m),
    )
    dataset = assemble(
        name=export.stem,
        cameras=cameras,
        images=images,
        detections=_boxes(found, names, images) if detections is None else read_detections(detections, images, cameras),
        up=None,
        anchor=placed.anchor,
        is_on_earth=True,
        source=str(export),
        max_rejected=max_rejected,
    )
    progress("reading the items", len(paths), len(paths))
    return dataset


def _add_item(item: Json, found: _Found, class_key: str | None, camera_height_m: float) -> None:
    properties = item["properties"]
    key, camera = item["id"].key(), _camera(properties)
    place = _place(item["geometry"]["coordinates"], camera_height_m) if "geometry" in item else [math.nan] * 3
    angles_deg = [
        _number(properties, name, default)
        for name, default in (("view:azimuth", math.nan), ("pers:pitch", 0.0), ("pers:roll", 0.0))
    ]
    collection = item["collection"].text() if "collection" in item else ONE_PASS
    time = _seconds(properties["datetime"]) if "datetime" in properties else math.nan
    sigma = _number(properties, "quality:horizontal_accuracy", math.nan)
    holder = next((part for part in (properties, item) if "annotations" in part), None)
    annotations = [] if holder is None else list(holder["annotations"].entries())
    if found.told.again(key, camera, place, angles_deg, collection, time, sigma, [each.value for each in annotations]):
        return
    found.ids.append(key)
    found.cameras.append(camera)
    found.place.append(place)
    found.angles_deg.append(angles_deg)
    found.passes.append(collection)
    found.time.append(time)
    found.sigma_m.append(sigma if sigma > 0.0 else math.nan)
    for annotation in annotations:
        found.image_of_box.append(len(found.ids) - 1)
        found.classes.append(_class(annotation, class_key))
        found.edges.append(_edges(annotation["shape"]))
        found.where.append(annotation.where)


def _place(coordinates: Json, camera_height_m: float) -> list[float]:
    """Return longitude, latitude and height."""
    is_3d = isinstance(coordinates.value, list) and len(coordinates.value) == 3
    return [*coordinates.numbers(3 if is_3d else 2).tolist(), camera_height_m][:3]


def _number(properties: Json, name: str, default: float) -> float:
    return properties[name].number() if name in properties else default


def _camera(properties: Json) -> Camera:
    orientation = properties["pers:interior_orientation"]
    width, height = (int(value) for value in orientation["sensor_array_dimensions"].numbers(2))
    view_deg = orientation["field_of_view"].number()
    if view_deg == _WHOLE_TURN_DEG:
        return panorama(width, height, orientation.where)
    if not 0.0 < view_deg < 170.0:
        raise orientation["field_of_view"].wrong("expected degrees, 360 for a panorama, else below 170")
    focal = width / 2.0 / math.tan(math.radians(view_deg) / 2.0)
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2.0, height / 2.0))


def _seconds(value: Json) -> float:
    try:
        time = datetime.fromisoformat(value.text())
    except ValueError as error:
        raise value.wrong("expected an ISO 8601 time") from error
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _class(annotation: Json, class_key: str | None) -> str:
    semantics = annotation.get("semantics")
    tags = [(tag["key"].text(), tag["value"].key()) for tag in (() if semantics is None else semantics.entries())]
    if class_key is not None:
        return next((value for key, value in tags if key == class_key), "")
    return "=".join(tags[0]) if tags else ""


def _edges(shape: Json) -> list[float]:
    """Return left, top, right, bottom in pixels."""
    if isinstance(shape.value, list):
        return shape.numbers(4).tolist()  # type: ignore[no-any-return]
    rings = list(shape["coordinates"].entries())
    points = np.array([point.numbers(2) for ring in rings for point in ring.entries()]).reshape(-1, 2)
    if not len(points):
        raise shape.wrong("expected a polygon, or four numbers")
    return [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]


def _boxes(found: _Found, names: list[str], images: Images) -> FoundBoxes:
    if not found.edges:
        return FoundBoxes.none()
    row_of = {name: row for row, name in enumerate(images.name.to_pylist())}
    edges = np.array(found.edges)
    return FoundBoxes(
        image_row=np.array([row_of[names[image]] for image in found.image_of_box], dtype=np.int64),
        class_names=found.classes,
        center_px=(edges[:, :2] + edges[:, 2:]) / 2.0,
        size_px=edges[:, 2:] - edges[:, :2],
        score=np.ones(len(edges)),
        where=found.where.__getitem__,
    )
