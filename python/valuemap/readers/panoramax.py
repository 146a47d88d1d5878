"""Panoramax: items of its STAC API as JSON in files, with their annotations."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from valuemap.errors import SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.api_images import FoundImages
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported
from valuemap.readers.cameras_of import CUT_PANORAMA, Camera, is_whole_panorama, panorama
from valuemap.readers.detections import DetectionFile
from valuemap.readers.json_documents import LINES, Pages, documents_of, files_of
from valuemap.readers.json_values import Json
from valuemap.readers.poses import height_where_none, local_from_cam
from valuemap.readers.reader import Reader

_EXPECTED = "JSON of Panoramax: a STAC item, or a collection of features with geometry, properties and id"
_IN_FOLDERS = (".json", ".geojson", *LINES)
_WHOLE_TURN_DEG = 360.0
_SHOWN_KEYS = 20
_WIDEST_DEG = 170.0
_NO_SIZE = "it has no size: neither sensor_array_dimensions nor, of a panorama, tiles"
_NO_VIEW = "it has no field_of_view"
_NO_AZIMUTH = "it has no view:azimuth, the heading of its middle"
_NO_GEOMETRY = "it has no geometry, its place"
_TOO_WIDE = f"its field_of_view is not that of a pinhole: not between 0 and {_WIDEST_DEG:g} degrees"
_QUALIFIER = re.compile(r"([^\[]+)\[(.+)\]")
"""A tag about another tag, such as `detection_confidence[osm|traffic_sign=stop]`."""


@dataclass
class _Found(FoundImages):
    """Images and boxes read so far, with what Panoramax says of them."""

    place: list[list[float]] = field(default_factory=list)
    angles_deg: list[list[float]] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    keys: set[str] = field(default_factory=set)


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
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read items as the API gives them; nothing is fetched.

    The heading of the middle of a picture is `view:azimuth`; `pers:pitch` and `pers:roll` are used where they are
    there. `pers:interior_orientation` has the size (`sensor_array_dimensions`) and the horizontal `field_of_view`: 360
    degrees is a panorama, less a pinhole camera. What has tiles is a panorama too, as large as they are where nothing
    else says it. `quality:horizontal_accuracy` is the deviation of the position. Passes are collections, and images are
    named `ID.jpg`. Positions have no height but `camera_height_m`, unless they do. Items without a size, a field of
    view, a place or a heading, and panoramas that are cut, are left out.

    Annotations are `shape`s in pixels from the top left, polygons or four numbers, whose class is the value of the
    semantic tag `class_key`, or else `KEY=VALUE` of the first tag; what a value says counts before `yes`. Tags about
    others, as `detection_confidence[KEY=VALUE]`, are no classes. The score is what is told of the tag: its
    `detection_confidence`, else that of its key, else its `classification_confidence`, else 1.

    Parameters
    ----------
    export
        A file of JSON, or of a JSON document a line (`.jsonl`, `.ndjson`), or a folder of them.
    detections
        As in `read_detections`, instead of the annotations; images are named by their ids.
    anchor
        Latitude, longitude and height of the origin; by default the place of the first image by name that is
        about where most are.
    tell
        Called with each line that is worth knowing: that there are further pages, which are not here.

    Raises
    ------
    InputError
        A file is missing, damaged or of another format, or too many items have no camera.
    SettingError
        `camera_height_m` is no number, or no annotation has the `class_key`.
    """
    level_m = height_where_none(camera_height_m)
    paths = files_of(export, _IN_FOLDERS, _EXPECTED)
    found = _Found()
    for number, path in enumerate(paths):
        progress("reading the items", number, len(paths))
        for answer in documents_of(path, _EXPECTED):
            _add_page(answer, found.pages)
            for item in _items(answer):
                _add_item(item, found, class_key, level_m)
    if tell is not None:
        for line in found.pages.told():
            tell(line)
    hint = "import pictures reads what the tags of the pictures themselves say"
    found.refuse_unusable(export, max_rejected, hint, _EXPECTED)
    if class_key is not None and detections is None and found.classes and not any(found.classes):
        raise SettingError(
            f"class-key {class_key}: none of {len(found.classes)} annotations in {export} has a tag of this key",
            hint=f"they have {', '.join(sorted(found.keys)[:_SHOWN_KEYS]) or 'no tags'}",
        )
    heading, pitch, roll = np.radians(found.angles_deg).T
    dataset = found.assembled(
        export,
        lon_lat_height=np.array(found.place),
        local_from_cam=local_from_cam(heading, pitch, roll),
        edges_px=lambda: np.array(found.edges),
        score=np.array(found.scores),
        detections=detections,
        anchor=anchor,
        max_rejected=max_rejected,
        tell=tell,
        position_sigma_m=np.array(found.sigma_m),
    )
    progress("reading the items", len(paths), len(paths))
    return dataset


def _items(answer: Json) -> list[Json]:
    """Return the items of an answer: one, a list, or a collection of features."""
    if isinstance(answer.value, list):
        return list(answer.entries())
    return [answer] if answer.object().get("type") == "Feature" else list(answer["features"].entries())


def _add_page(answer: Json, pages: Pages) -> None:
    """Note what an answer says of the page after it."""
    if isinstance(answer.value, dict) and "features" in answer and "links" in answer:
        address_of = {link["rel"].text(): link["href"].text() for link in answer["links"].entries()}
        pages.add(answer.where, address_of.get("next"), address_of.get("self"))


def _add_item(item: Json, found: _Found, class_key: str | None, camera_height_m: float) -> None:
    properties = item["properties"]
    key, camera = item["id"].key(), _camera(properties)
    name = f"{key}.jpg"
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
    for annotation in annotations:
        said = _tags(annotation)
        kind, score = _class(said, class_key)
        found.keys.update(tag for tag, _ in said if not _QUALIFIER.fullmatch(tag))
        found.scores.append(score)
        found.add_box(name, kind, _edges(annotation["shape"]), annotation.where)
    why_not = camera if isinstance(camera, str) else _why_no_pose(place, angles_deg)
    if isinstance(camera, str) or why_not:
        found.unreadable[name] = why_not
        return
    found.add_image(name, camera, collection, time)
    found.place.append(place)
    found.angles_deg.append(angles_deg)
    found.sigma_m.append(sigma if sigma > 0.0 else math.nan)


def _why_no_pose(place: list[float], angles_deg: list[float]) -> str:
    if math.isnan(place[0]):
        return _NO_GEOMETRY
    return _NO_AZIMUTH if math.isnan(angles_deg[0]) else ""


def _place(coordinates: Json, camera_height_m: float) -> list[float]:
    """Return longitude, latitude and height."""
    is_3d = isinstance(coordinates.value, list) and len(coordinates.value) == 3
    return [*coordinates.numbers(3 if is_3d else 2).tolist(), camera_height_m][:3]


def _number(properties: Json, name: str, default: float) -> float:
    return properties[name].number() if name in properties else default


def _camera(properties: Json) -> Camera | str:
    """Return the camera, or why there is none."""
    orientation = properties.get("pers:interior_orientation")
    tiled_px = _tiled_px(properties)
    view = None if orientation is None else orientation.get("field_of_view")
    view_deg = math.nan if view is None else view.number()
    if orientation is not None and "sensor_array_dimensions" in orientation:
        width, height = (int(value) for value in orientation["sensor_array_dimensions"].numbers(2))
    elif tiled_px is not None:
        width, height = tiled_px
    else:
        return _NO_SIZE
    is_cut = orientation is not None and "visible_area" in orientation and orientation["visible_area"].numbers(4).any()
    if view_deg == _WHOLE_TURN_DEG or tiled_px is not None or is_cut:
        is_whole = is_whole_panorama(width, height) and not is_cut
        return panorama(width, height, properties.where) if is_whole else CUT_PANORAMA
    if not 0.0 < view_deg < _WIDEST_DEG:
        return _NO_VIEW if view is None else _TOO_WIDE
    focal = width / 2.0 / math.tan(math.radians(view_deg) / 2.0)
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2.0, height / 2.0))


def _tiled_px(properties: Json) -> tuple[int, int] | None:
    """Return width and height of what is there in tiles, as panoramas alone are."""
    sets = properties.get("tiles:tile_matrix_sets")
    for _, tiled in () if sets is None else sets.items():
        largest = max(
            ((_side_px(level, "Width"), _side_px(level, "Height")) for level in tiled["tileMatrix"].entries()),
            default=None,
        )
        if largest is not None:
            return largest
    return None


def _side_px(level: Json, side: str) -> int:
    pixels = level[f"tile{side}"].number() * level[f"matrix{side}"].number()
    if not math.isfinite(pixels):
        raise level.wrong("expected sizes of tiles in pixels")
    return round(pixels)


def _seconds(value: Json) -> float:
    try:
        time = datetime.fromisoformat(value.text())
    except ValueError as error:
        raise value.wrong("expected an ISO 8601 time") from error
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _tags(annotation: Json) -> list[tuple[str, str]]:
    semantics = annotation.get("semantics")
    return [(tag["key"].text(), tag["value"].key()) for tag in (() if semantics is None else semantics.entries())]


def _class(said: list[tuple[str, str]], class_key: str | None) -> tuple[str, float]:
    """Return class and score by all tags; the class is empty where none says it."""
    tags = [(key, value) for key, value in said if not _QUALIFIER.fullmatch(key)]
    if class_key is not None:
        tags = [(key, value) for key, value in tags if key == class_key]
    if not tags:
        return "", 1.0
    key = tags[0][0]
    value = next((value for other, value in tags if other == key and value != "yes"), tags[0][1])
    return value if class_key is not None else f"{key}={value}", _score(key, value, said)


def _score(key: str, value: str, said: list[tuple[str, str]]) -> float:
    """Return what the qualifiers among the tags say of a tag, NaN where that is no number."""
    confidence = {
        (match[1], match[2]): text for name, text in said if (match := _QUALIFIER.fullmatch(name)) is not None
    }
    of_tag = (f"{key}={value}", f"{key}=*", key)
    of_key = [about for _, about in confidence if about.startswith(f"{key}=")]
    asked = [("detection_confidence", about) for about in (*of_tag, *of_key)]
    asked += [("classification_confidence", about) for about in of_tag]
    text = next((confidence[each] for each in asked if each in confidence), "1")
    try:
        return float(text)
    except ValueError:
        return math.nan


def _edges(shape: Json) -> list[float]:
    """Return left, top, right, bottom in pixels."""
    if isinstance(shape.value, list):
        return shape.numbers(4).tolist()  # type: ignore[no-any-return]
    rings = list(shape["coordinates"].entries())
    points = np.array([point.numbers(2) for ring in rings for point in ring.entries()]).reshape(-1, 2)
    if not len(points):
        raise shape.wrong("expected a polygon, or four numbers")
    return [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]
