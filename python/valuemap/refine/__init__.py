"""Errors of the poses of whole drives, found from the objects that drives share, once for all that comes after."""

from valuemap.refine.poses import Refined, refine_poses

__all__ = ["Refined", "refine_poses"]
