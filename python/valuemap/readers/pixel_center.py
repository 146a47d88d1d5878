"""Where pixels count from: the picture's corner, as in COLMAP, or the middle of its first pixel, as in OpenCV."""

from __future__ import annotations

from valuemap.errors import SettingError


def shift_to_corner_px(pixel_center: float, option: str) -> float:
    """Return what has to be added to pixels to count them from the picture's corner.

    `pixel_center` is the coordinate of the centre of the top-left pixel: 0.5 where they count from the corner (COLMAP,
    COCO), 0 where from that pixel (OpenCV, KITTI).

    Raises
    ------
    SettingError
        It is neither; the message names the `option` that says so.
    """
    if pixel_center not in (0.0, 0.5):
        raise SettingError(f"{option}: expected 0 or 0.5, found {pixel_center:g}", hint="COLMAP has 0.5, OpenCV 0")
    return 0.5 - pixel_center
