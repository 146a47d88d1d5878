"""Mapillary: images as its API v4 gives them, as JSON in files, with their detections."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from valuemap.arrays import Floats
from valuemap.errors import InputError
from valuemap.progress import Progress, silent
from valuemap.readers.api_images import FoundImages
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported
from valuemap.readers.cameras_of import CUT_PANORAMA, Camera, is_whole_panorama, panorama
from valuemap.readers.detections import DetectionFile
from valuemap.readers.exif import ROLL_DEG
from valuemap.readers.files import file_in, read_json
from valuemap.readers.json_documents import documents_of, files_of
from valuemap.readers.json_values import Json
from valuemap.readers.poses import local_from_cam
from valuemap.readers.reader import Reader
from valuemap.readers.vector_tile import outline_of_tile

_EXPECTED = "JSON of Mapillary's API v4: an image, or data: a list of images, each with id, geometry and camera_type"
_IN_FOLDERS = (".json", ".jsonl", ".ndjson")
_MILLI = 1e-3
_HEIGHT_WITHOUT_ANY_M = 2.0
_MOST_AT_ONCE = 2000
"""Images that the API answers with at most, and unless fewer are asked for; it has no further pages of an area."""
_END_OF_DOWNLOAD = "__complete__"
"""What mapillary_downloader writes behind the images."""
_OTHER_CAMERA = "its camera_type is none of perspective, fisheye, spherical and equirectangular"
_NO_CAMERA = "it has no camera_type, or no camera_parameters: it was not processed, or they were not asked for"

_STORED: dict[int, Callable[[float, float, float, float], list[float]]] = {
    3: lambda left, top, right, bottom: [1.0 - right, 1.0 - bottom, 1.0 - left, 1.0 - top],
    6: lambda left, top, right, bottom: [top, 1.0 - right, bottom, 1.0 - left],
    8: lambda left, top, right, bottom: [1.0 - bottom, left, 1.0 - top, right],
}
"""Edges of a box in the picture as stored, of those in the picture turned upright by this EXIF orientation."""


@dataclass
class _Found(FoundImages):
    """Images and boxes read so far, with what Mapillary says of them; edges are parts of pictures turned upright."""

    full: list[str] = field(default_factory=list)
    cut: list[str] = field(default_factory=list)
    uncomputed: set[str] = field(default_factory=set)
    orientation: list[int] = field(default_factory=list)
    lon_lat: list[list[float]] = field(default_factory=list)
    computed_height_m: list[float] = field(default_factory=list)
    stated_height_m: list[float] = field(default_factory=list)
    rotation: list[Floats] = field(default_factory=list)


@Reader
def read_mapillary(
    export: Path,
    *,
    detections: DetectionFile | Path | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read JSON that the API answered with: the fields asked for, for one image or for many; nothing is fetched.

    Positions are `computed_geometry` and `computed_altitude` where structure from motion has them, else `geometry`.
    Computed altitudes count from near the ground and stated ones from the sea: as soon as one image has a computed one,
    the others have the median of their sequence, else of all.

    The rotation is `computed_rotation`, axis-angle from east, north, up at the image into the camera, else level with
    `computed_compass_angle` or `compass_angle`. `camera_parameters` are focal length over the larger side, k1, k2.
    Passes are sequences, images are named `ID.jpg`, and `captured_at` is in milliseconds. Cameras, rotations and sizes
    are those of pictures as stored, compass angles and outlines those of pictures turned by `exif_orientation`.
    An image without a camera, or of a panorama that is cut, is left out.

    Answers are an image, a list of images, in `data` too, an object of images by their ids, or GeoJSON with what is
    known of an image as its properties; or one of these a line.

    Detections are lists of `value` and `geometry` (a vector tile as base64), in `detections` of an image, or in a file
    `detections.json` beside the export: an object of image ids with such lists, or a list of `data` with `image`.

    Parameters
    ----------
    export
        A file of JSON, or of a JSON document a line (`.jsonl`, `.ndjson`), or a folder of them.
    detections
        As in `read_detections`, instead of Mapillary's own; images are named by their ids.
    anchor
        Latitude, longitude and height of the origin; by default the place of the first image by name that is
        about where most are.
    tell
        Called with each line that is worth knowing: that there are images or detections that are not here.

    Raises
    ------
    InputError
        A file is missing, damaged or of another format, an image has no size, or too many have no camera.
    """
    paths = files_of(export, _IN_FOLDERS, _EXPECTED, besides="detections.json")
    found = _Found()
    for number, path in enumerate(paths):
        progress("reading Mapillary's answers", number, len(paths))
        for answer in documents_of(path, _EXPECTED):
            images_here = _images(answer)
            if isinstance(answer.value, dict) and "data" in answer:
                found.pages.add(answer.where, _next_page(answer))
                if len(images_here) == _MOST_AT_ONCE:
                    found.full.append(answer.where)
            for image in images_here:
                _add_image(image, found)
    hint = "panoramas that are cut, and other types of cameras, are not read"
    if _NO_CAMERA in found.unreadable.values():
        hint = "ask for the fields camera_type and camera_parameters"
    found.refuse_unusable(export, max_rejected, hint, _EXPECTED)
    folder = export if export.is_dir() else export.parent
    if (folder / "detections.json").exists():
        _add_detections(file_in(folder, "detections.json", "Mapillary's detections"), found)
    if tell is not None:
        for line in _told(found):
            tell(line)
    dataset = found.assembled(
        export,
        lon_lat_height=np.column_stack([np.array(found.lon_lat), _heights(found)]),
        local_from_cam=np.array(found.rotation),
        edges_px=lambda: _edges_px(found),
        score=np.ones(len(found.edges)),
        detections=detections,
        anchor=anchor,
        max_rejected=max_rejected,
        tell=tell,
    )
    progress("reading Mapillary's answers", len(paths), len(paths))
    return dataset


def _next_page(answer: Json) -> str | None:
    """Return the address of the page after an answer."""
    paging = answer.get("paging") if isinstance(answer.value, dict) else None
    following = None if paging is None else paging.get("next")
    return None if following is None else following.text()


def _told(found: _Found) -> Iterator[str]:
    """Yield what is to be told of images and detections that are not here."""
    yield from found.pages.told()
    if found.full:
        yield (
            f"{found.full[0]}: has {_MOST_AT_ONCE} images, the most that Mapillary answers with ({len(found.full)} "
            "answers): there may be more; ask for smaller areas, and give a folder of all answers"
        )
    if uncomputed := found.uncomputed & set(found.names):
        yield (
            f"{len(uncomputed)} of {len(found.names)} images have no computed_geometry or no "
            "computed_rotation: they stand or look as their GPS or compass says; ask for these fields"
        )
    if found.cut:
        yield (
            f"{found.cut[0]}: says that there are more detections, which are not here ({len(found.cut)} answers): ask "
            "for ID/detections until there is no next page"
        )


def _images(answer: Json) -> list[Json]:
    """Return the images of an answer: as `_entries`, or by their ids, or as features."""
    if not isinstance(answer.value, dict):
        return list(answer.entries())
    if "error" in answer and "data" not in answer:
        said = answer["error"].value
        message = str(said.get("message", said) if isinstance(said, dict) else said)
        raise InputError(
            f"{answer.where}: the API answered with an error: {' '.join(message.split())[:200]}",
            hint="ask again, with a valid access token and fields that there are",
        )
    if "features" in answer:
        return [_of_feature(feature) for feature in answer["features"].entries()]
    if answer.value.get("type") == "Feature":
        return [_of_feature(answer)]
    if answer.value and all(key.isdecimal() and isinstance(value, dict) for key, value in answer.value.items()):
        return [image for _, image in answer.items()]
    return [] if list(answer.value) == [_END_OF_DOWNLOAD] else _entries(answer)


def _of_feature(feature: Json) -> Json:
    """Return the image of a feature of GeoJSON."""
    properties = feature["properties"]
    return replace(properties, value={"geometry": feature.object().get("geometry"), **properties.object()})


def _entries(content: Json) -> list[Json]:
    """Return the images or detections of an answer: one, a list, or a list in `data`."""
    if isinstance(content.value, dict):
        if "data" in content:
            return list(content["data"].entries())
        return [content]
    return list(content.entries())


def _add_image(image: Json, found: _Found) -> None:
    key = image["id"].key()
    width, height = image["width"].whole(), image["height"].whole()
    orientation = image["exif_orientation"].whole() if "exif_orientation" in image else 1
    point = next((image[name] for name in ("computed_geometry", "geometry") if name in image), None)
    lon, lat = (np.nan, np.nan) if point is None else point["coordinates"].known_numbers(2)
    heights_m = [image[name].number() if name in image else np.nan for name in ("computed_altitude", "altitude")]
    if "computed_geometry" not in image or "computed_rotation" not in image:
        found.uncomputed.add(f"{key}.jpg")
    if "computed_rotation" in image:
        rotation = Rotation.from_rotvec(image["computed_rotation"].known_numbers(3)).inv().as_matrix()
    else:
        angles = ("computed_compass_angle", "compass_angle")
        heading = np.radians([next((image[name].number() for name in angles if name in image), np.nan)])
        rotation = local_from_cam(heading, np.zeros(1), np.radians([ROLL_DEG.get(orientation, 0.0)]))[0]
    camera, place = _camera(image, width, height), [float(lon), float(lat), *heights_m]
    sequence = image.get("sequence")
    name = ONE_PASS if sequence is None else _sequence(sequence)
    time = image["captured_at"].number() * _MILLI if "captured_at" in image else np.nan
    boxes = _entries(image["detections"]) if "detections" in image else []
    if boxes and _next_page(image["detections"]) is not None:
        found.cut.append(image["detections"].where)
    if found.told.again(key, camera, orientation, place, rotation.tolist(), name, time, [box.value for box in boxes]):
        return
    for detection in boxes:
        _add_box(detection, key, found)
    if isinstance(camera, str):
        found.unreadable[f"{key}.jpg"] = camera
        return
    found.add_image(f"{key}.jpg", camera, name, time)
    found.orientation.append(orientation)
    found.lon_lat.append(place[:2])
    found.computed_height_m.append(heights_m[0])
    found.stated_height_m.append(heights_m[1])
    found.rotation.append(rotation)


def _heights(found: _Found) -> Floats:
    """Return the heights (N) of images, of one kind: what computed ones count from, stated ones do not."""
    for given in (found.computed_height_m, found.stated_height_m):
        heights_m = np.array(given)
        known = np.isfinite(heights_m)
        if known.any():
            break
    else:
        return np.full(len(found.names), _HEIGHT_WITHOUT_ANY_M)
    of_pass: dict[str, list[float]] = {}
    for row in np.flatnonzero(known).tolist():
        of_pass.setdefault(found.passes[row], []).append(heights_m[row])
    median_m = {name: float(np.median(each)) for name, each in of_pass.items()}
    of_all_m = float(np.median(heights_m[known]))
    for row in np.flatnonzero(~known).tolist():
        heights_m[row] = median_m.get(found.passes[row], of_all_m)
    return heights_m


def _sequence(value: Json) -> str:
    return value["id"].key() if isinstance(value.value, dict) else value.key()


def _camera(image: Json, width: int, height: int) -> Camera | str:
    """Return the camera, or why there is none."""
    if "camera_type" not in image:
        return _NO_CAMERA
    kind = image["camera_type"].text()
    if kind in ("spherical", "equirectangular"):
        return panorama(width, height, image.where) if is_whole_panorama(width, height) else CUT_PANORAMA
    if kind not in ("perspective", "fisheye"):
        return _OTHER_CAMERA
    values = [entry.number() for entry in image["camera_parameters"].entries()] if "camera_parameters" in image else []
    if not values:
        return _NO_CAMERA
    if len(values) not in (1, 2, 3):
        raise image["camera_parameters"].wrong("expected focal length, k1 and k2")
    focal, k1, k2 = (*values, 0.0, 0.0)[:3]
    model = "RADIAL" if kind == "perspective" else "RADIAL_FISHEYE"
    return Camera(model, width, height, (focal * max(width, height), width / 2.0, height / 2.0, k1, k2))


def _add_detections(path: Path, found: _Found) -> None:
    content = Json(read_json(path, "Mapillary's detections"), str(path), "expected image ids with lists of detections")
    if _next_page(content) is not None:
        found.cut.append(content.where)
    if isinstance(content.value, dict) and "data" not in content:
        for key, listed in content.items():
            if _next_page(listed) is not None:
                found.cut.append(listed.where)
            for detection in _entries(listed):
                _add_box(detection, key, found)
        return
    for detection in _entries(content):
        image = detection["image"]
        _add_box(detection, image["id"].key() if isinstance(image.value, dict) else image.key(), found)


def _add_box(detection: Json, image: str, found: _Found) -> None:
    geometry = detection["geometry"]
    try:
        points = outline_of_tile(geometry.text())
    except ValueError as error:
        raise geometry.wrong(f"expected a vector tile as base64, which {error}") from error
    value = detection.get("value")
    edges = [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]
    found.add_box(f"{image}.jpg", "" if value is None else value.text(), edges, detection.where)


def _edges_px(found: _Found) -> Floats:
    """Return the edges (N, 4) of the boxes in the pictures as stored; those of images that are not here are in any."""
    camera_of = dict(zip(found.names, found.cameras, strict=True))
    orientation_of = dict(zip(found.names, found.orientation, strict=True))
    nowhere = next(iter(found.cameras))
    size = np.array([[(c := camera_of.get(name, nowhere)).width, c.height] for name in found.image_of_box], np.float64)
    edges = np.array(
        [
            _STORED[turned](*shown) if (turned := orientation_of.get(name, 1)) in _STORED else shown
            for name, shown in zip(found.image_of_box, found.edges, strict=True)
        ]
    )
    return np.asarray(edges * np.hstack([size, size]))
