"""Errors of the poses of whole drives, found from the objects that drives see, once for all that comes after."""

from valuemap.refine.images import bundle, gather_images, images_in_order
from valuemap.refine.middles import middles
from valuemap.refine.poses import FITS_NO_BETTER, Mapped, Refined, keyframes_of, noise_left, refine_again, refine_poses
from valuemap.refine.shutter import expose_rows

__all__ = [
    "FITS_NO_BETTER",
    "Mapped",
    "Refined",
    "bundle",
    "expose_rows",
    "gather_images",
    "images_in_order",
    "keyframes_of",
    "middles",
    "noise_left",
    "refine_again",
    "refine_poses",
]
