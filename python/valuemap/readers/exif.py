"""What a picture says about itself: where, when, which way and how wide, in EXIF and in the XMP of panoramas."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError
from PIL.ExifTags import GPS, IFD, Base

from valuemap.errors import InputError
from valuemap.readers.cameras_of import is_whole_panorama

_FILM_MM = (36.0, 24.0)
"""Cameras say by CIPA's DCG-001 which lens has the same angle from corner to corner there."""
_LARGEST_PX = 200_000_000
ROLL_DEG = {3: 180.0, 6: 90.0, 8: -90.0}
"""Roll of a camera whose picture must be turned by this orientation to stand upright: 6 is a quarter turn clockwise,
so up is at the left of the picture as stored, and the camera's right side was down."""


@dataclass(frozen=True)
class Exif:
    """What is known of one picture; None where it does not say.

    `lat_lon` in degrees, `height_m`, `sigma_m` (horizontal), `heading_deg` clockwise from north, `pitch_deg` up and
    `roll_deg` right side down, `focal_px`, `gps_time_s` and `camera_time_s` since 1970. Pictures of one `camera` have
    the same intrinsics. A panorama that `is_cut` does not show the whole sphere. A picture that `may_be_panorama` has
    the shape of one, and neither a tag nor a focal length says what it is. Heights count from the sea, unless
    `is_ellipsoidal` says that they count from the ellipsoid. The `pose_heading_deg` is that of GPano or of a gimbal,
    which is not used where the GPS tags or the description have one: cameras without a compass write 0.
    """

    width: int
    height: int
    is_panorama: bool
    is_cut: bool
    camera: tuple[Any, ...]
    may_be_panorama: bool = False
    lat_lon: tuple[float, float] | None = None
    height_m: float | None = None
    is_ellipsoidal: bool = False
    sigma_m: float | None = None
    heading_deg: float | None = None
    pose_heading_deg: float | None = None
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    focal_px: float | None = None
    gps_time_s: float | None = None
    camera_time_s: float | None = None


def read_exif(path: Path) -> Exif:
    """Read a picture's size and what it says about itself; values that make no sense are taken for missing.

    What the GPS tags do not say may stand in the description that Mapillary's programs write.

    Raises
    ------
    InputError
        The file is no picture, or one of more than 200 million pixels.
    """
    try:
        with Image.open(path) as picture:
            width, height = picture.size
            tags = picture.getexif()
            gps, exif = dict(tags.get_ifd(IFD.GPSInfo)), dict(tags.get_ifd(IFD.Exif))
            xmp = picture.info.get("xmp", b"")
            main = dict(tags)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, KeyError, Image.DecompressionBombError) as error:
        reason = " ".join(str(error).replace(f" {str(path)!r}", "").split())[:150]
        raise InputError(f"{path}: cannot be read as a picture: {reason}", hint="remove or replace it") from error
    if width * height > _LARGEST_PX:
        raise InputError(f"{path}: has {width} x {height} pixels", hint="make it smaller")
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)
    pano = _panorama(text)
    is_panorama = "equirectangular" in pano
    gimbal = {} if is_panorama else _gimbal(text)  # Of a panorama it is that of the last of its pictures.
    focal_px = _focal_px(exif, width, height)
    orientation = main.get(Base.Orientation)
    described = _described(main.get(Base.ImageDescription))
    lat_lon, height_m = _lat_lon(gps), _height(gps)
    if lat_lon is None:
        lat_lon, height_m = _place(_number(described.get("MAPLatitude")), _number(described.get("MAPLongitude"))), None
    if height_m is None and lat_lon is not None:
        height_m = _number(described.get("MAPAltitude"))
    pose_heading = pano.get("PoseHeadingDegrees", gimbal.get("Yaw"))
    directions = (_number(gps.get(GPS.GPSImgDirection)), _described_heading(described), pose_heading)
    heading = next((each for each in directions if each is not None), None)
    upright_roll = ROLL_DEG.get(orientation, 0.0) if isinstance(orientation, int) else 0.0
    return Exif(
        width=width,
        height=height,
        is_panorama=is_panorama,
        is_cut=_is_cut(pano, width, height) if is_panorama else _is_swept(pano, exif),
        camera=(str(main.get(Base.Make)), str(main.get(Base.Model)), width, height, focal_px),
        may_be_panorama=not is_panorama and width == 2 * height and focal_px is None,
        lat_lon=lat_lon,
        height_m=height_m,
        is_ellipsoidal=_is_ellipsoidal(exif, gps),
        sigma_m=_positive(gps.get(GPS.GPSHPositioningError)),
        heading_deg=None if heading is None else heading % 360.0,
        pose_heading_deg=None if pose_heading is None else pose_heading % 360.0,
        pitch_deg=pano.get("PosePitchDegrees", gimbal.get("Pitch", 0.0)),
        roll_deg=pano.get("PoseRollDegrees", gimbal.get("Roll", upright_roll)),
        focal_px=focal_px,
        gps_time_s=_gps_time(gps),
        camera_time_s=_camera_time(exif) or _described_time(described.get("MAPCaptureTime")),
    )


def check_whole(path: Path) -> None:
    """Decode a picture, in an eighth of its size where its format lets that, to see that nothing of it is missing.

    Raises
    ------
    InputError
        It is cut off or damaged.
    """
    try:
        with Image.open(path) as picture:
            picture.draft("L", (picture.width // 8, picture.height // 8))
            picture.load()
    except (OSError, ValueError, SyntaxError, IndexError, KeyError) as error:
        reason = " ".join(str(error).split())[:150]
        raise InputError(f"{path}: is cut off or damaged: {reason}", hint="remove or replace it") from error


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0.0 else None


def _degrees(value: Any, reference: Any, negative: str) -> float | None:
    """Return degrees of degrees, minutes and seconds."""
    try:
        parts = [_number(part) for part in value]
    except TypeError:
        return None
    if len(parts) != 3 or any(part is None for part in parts):
        return None
    degrees = sum(float(part or 0.0) / 60.0**place for place, part in enumerate(parts))
    return -degrees if str(reference).strip("\0 ").upper() == negative else degrees


def _lat_lon(gps: dict[int, Any]) -> tuple[float, float] | None:
    lat = _degrees(gps.get(GPS.GPSLatitude), gps.get(GPS.GPSLatitudeRef), "S")
    lon = _degrees(gps.get(GPS.GPSLongitude), gps.get(GPS.GPSLongitudeRef), "W")
    return _place(lat, lon)


def _place(lat: float | None, lon: float | None) -> tuple[float, float] | None:
    if lat is None or lon is None or abs(lat) > 90.0 or abs(lon) > 180.0 or (lat, lon) == (0.0, 0.0):
        return None
    return lat, lon


def _height(gps: dict[int, Any]) -> float | None:
    height = _number(gps.get(GPS.GPSAltitude))
    return None if height is None else (-height if _altitude_reference(gps) in (1, 3) else height)


def _altitude_reference(gps: dict[int, Any]) -> int:
    """Return 0 for above and 1 for below the sea; since EXIF 3.0 these are of the ellipsoid, and 2 and 3 of the sea."""
    value = gps.get(GPS.GPSAltitudeRef)
    return value[0] if isinstance(value, bytes) and value else value if isinstance(value, int) else 0


def _is_ellipsoidal(exif: dict[int, Any], gps: dict[int, Any]) -> bool:
    version = exif.get(Base.ExifVersion)
    return isinstance(version, bytes) and version >= b"0300" and _altitude_reference(gps) in (0, 1)


def _focal_px(exif: dict[int, Any], width: int, height: int) -> float | None:
    film_mm = _positive(exif.get(Base.FocalLengthIn35mmFilm))
    if film_mm is not None:
        return film_mm / math.hypot(*_FILM_MM) * math.hypot(width, height)
    focal_mm = _positive(exif.get(Base.FocalLength))
    per_unit = _positive(exif.get(Base.FocalPlaneXResolution))
    unit_mm = {2: 25.4, 3: 10.0}.get(exif.get(Base.FocalPlaneResolutionUnit, 2))
    stored = _positive(exif.get(Base.ExifImageWidth)) or width
    if focal_mm is None or per_unit is None or unit_mm is None:
        return None
    return focal_mm * per_unit / unit_mm * width / stored


def _gps_time(gps: dict[int, Any]) -> float | None:
    day, clock = str(gps.get(GPS.GPSDateStamp, "")), gps.get(GPS.GPSTimeStamp)
    try:
        hours, minutes, seconds = (float(part) for part in clock or ())
        start = datetime.strptime(day.strip("\0 "), "%Y:%m:%d").replace(tzinfo=UTC)
        return start.timestamp() + hours * 3600.0 + minutes * 60.0 + seconds
    except (TypeError, ValueError, ZeroDivisionError):
        return None


def _camera_time(exif: dict[int, Any]) -> float | None:
    """Return the camera's time, in UTC where it does not say its zone."""
    text = str(exif.get(Base.DateTimeOriginal, "")).strip("\0 ")
    zone = str(exif.get(Base.OffsetTimeOriginal, "")).strip("\0 ") or "+00:00"
    part = str(exif.get(Base.SubsecTimeOriginal, "")).strip("\0 ")
    try:
        time = datetime.strptime(f"{text} {zone}", "%Y:%m:%d %H:%M:%S %z").timestamp()
    except ValueError:
        return None
    return time + (float(f"0.{part}") if part.isdecimal() else 0.0)


def _described(text: Any) -> dict[str, Any]:
    """Return the values that Mapillary's programs wrote as JSON into the description; none of another text."""
    try:
        values = json.loads(str(text).strip("\0 "))
    except (ValueError, RecursionError):
        return {}
    return values if isinstance(values, dict) else {}


def _described_heading(described: dict[str, Any]) -> float | None:
    """Return the heading from true north; telephones write -1 where they do not know it."""
    compass = described.get("MAPCompassHeading")
    heading = _number(compass.get("TrueHeading")) if isinstance(compass, dict) else None
    return heading if heading is not None and heading >= 0.0 else None


def _described_time(text: Any) -> float | None:
    """Return the time in UTC, which has milliseconds at its end."""
    try:
        clock, milliseconds = str(text).rsplit("_", 1)
        time = datetime.strptime(clock, "%Y_%m_%d_%H_%M_%S").replace(tzinfo=UTC)
        return time.timestamp() + int(milliseconds) * 1e-3
    except (ValueError, OverflowError):
        return None


def _tags_of(namespace: str, xmp: str) -> list[tuple[str, str]]:
    """Return the tags of a namespace, be they attributes or elements."""
    found = re.findall(namespace + r":(\w+)\s*(?:=\s*[\"']([^\"']*)[\"']|>([^<]*)<)", xmp)
    return [(name, (first or second).strip()) for name, first, second in found]


def _gimbal(xmp: str) -> dict[str, float]:
    """Return Yaw, Pitch and Roll of a camera on DJI's drones, in degrees; all are 0 where the drone does not know."""
    told = dict(_tags_of("drone-dji", xmp))
    angles = {name: _number(told.get(f"Gimbal{name}Degree")) for name in ("Yaw", "Pitch", "Roll")}
    known = {name: angle for name, angle in angles.items() if angle is not None}
    return known if any(known.values()) else {}


def _panorama(xmp: str) -> dict[str, float]:
    """Return the numbers of the GPano namespace, and a key `equirectangular` or such where that is the projection."""
    found = {}
    for name, text in _tags_of("GPano", xmp):
        if name == "ProjectionType":
            found[text.lower()] = 1.0
        elif (number := _number(text)) is not None:
            found[name] = number
    return found


def _is_swept(pano: dict[str, float], exif: dict[int, Any]) -> bool:
    """Return whether a phone was swept round for the picture: it is no sphere, and no flat picture either."""
    return "cylindrical" in pano or exif.get(Base.CustomRendered) == _PANORAMA


_PANORAMA = 6
"""What Apple writes into CustomRendered of a panorama."""


def _is_cut(pano: dict[str, float], width: int, height: int) -> bool:
    """Return whether an equirectangular picture is not of the whole sphere, by its tags or by its shape."""
    sides = ((f"CroppedAreaImage{side}Pixels", f"FullPano{side}Pixels") for side in ("Width", "Height"))
    by_tags = any(part in pano and whole in pano and pano[part] != pano[whole] for part, whole in sides)
    return by_tags or not is_whole_panorama(width, height)
