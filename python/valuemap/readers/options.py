"""What readers are asked for, looked at before any file is: hours of reading should not end at a typing error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from valuemap.geodesy import check_crs, with_heights
from valuemap.readers.assemble import check_frame
from valuemap.readers.cameras_of import parse_camera
from valuemap.readers.pixel_center import shift_to_corner_px
from valuemap.readers.poses import height_where_none
from valuemap.readers.vet import Rejections


def check_options(given: Mapping[str, Any]) -> None:
    """Refuse options, by their names, that no data could go with; what they mean stands with the readers.

    Raises
    ------
    SettingError
        One is impossible.
    """
    pixel_center = given.get("pixel_center", 0.5)
    shift_to_corner_px(pixel_center, "pixel-center")
    if isinstance(given.get("camera"), str):
        parse_camera(given["camera"], pixel_center)
    height_where_none(given.get("camera_height_m", 0.0))
    check_frame(given.get("up"), given.get("anchor"))
    if given.get("crs") is not None:
        check_crs(given["crs"])
    with_heights(given.get("crs"), given.get("vertical"))
    if "max_rejected" in given:
        Rejections("", given["max_rejected"])
