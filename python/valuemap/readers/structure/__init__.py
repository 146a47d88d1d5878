"""Poses of pictures by pycolmap's structure from motion, with positions of the GPS as priors, on the Earth.

The work is done by a process of its own (`child`), in a folder where all that was found is kept:

1. `features` finds features in every picture.
2. `pairs` matches pictures that follow each other in a drive, and those that are near each other by GPS.
3. `pose_graph` finds all poses at once from what pairs of pictures say (`two_views`), on the Earth (`onto_earth`).
   `mapping` makes points there and finds pictures that pairs do not hold.
4. `adjust` moves cameras and points to where features, GPS and the vertical agree best, and says how sure that is.
"""

from __future__ import annotations

from valuemap.readers.structure.job import Picture, Posed
from valuemap.readers.structure.onto_earth import similarity_onto
from valuemap.readers.structure.process import find_poses

__all__ = ["Picture", "Posed", "find_poses", "similarity_onto"]
