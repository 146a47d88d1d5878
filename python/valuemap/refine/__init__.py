"""Errors of the poses of whole drives, found from the objects that drives share, once for all that comes after."""

from valuemap.refine.images import Bundle, bundle
from valuemap.refine.poses import FITS_NO_BETTER, Refined, keyframes_of, noise_left, refine_again, refine_poses
from valuemap.refine.shutter import expose_rows

__all__ = [
    "FITS_NO_BETTER",
    "Bundle",
    "Refined",
    "bundle",
    "expose_rows",
    "keyframes_of",
    "noise_left",
    "refine_again",
    "refine_poses",
]
