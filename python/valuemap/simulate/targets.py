"""Things that the detector finds or takes for what it looks for, and their classes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.simulate.streams import random_stream
from valuemap.tables import Table

CLASSES = ("traffic_light", "traffic_sign", "street_lamp", "tree", "post")
"""What can be in the truth; `class_code` of targets and boxes is an index into it."""


@dataclass(frozen=True, eq=False)
class Targets(Table):
    """Things that are detected.

    `position_in_world_m` (N, 3) are their centres; `facing_rad` (N) where they face to, counter-clockwise from
    east; `size_m` (N, 2) width and height; `recall_share` (N) how often they are detected compared to a light;
    `pass_row` (N) the only pass that meets them, or -1 for all; `class_code` (N) what they are, or look like;
    `is_round` (N) whether they look the same from all sides; `uneven_m` (N, 4) how the middle of their boxes is off
    their centres from different sides: sideways (cosine and sine of twice the angle) and up (of once).
    """

    position_in_world_m: Floats
    facing_rad: Floats
    size_m: Floats
    recall_share: Floats
    pass_row: Ints
    class_code: Ints
    is_round: Bools
    uneven_m: Floats


def classes_in(config: SimulationConfig) -> Ints:
    """Return the codes, ascending, of the classes that stand in the city."""
    stands = [config.has_lights, config.sign_row_spacing_m, config.lamp_spacing_m]
    stands += [config.tree_spacing_m, config.post_spacing_m]
    return np.flatnonzero(np.array(stands) > 0.0)


def class_of_false(count: int, config: SimulationConfig, *, seed: int, kind: str) -> Ints:
    """Return what false things (N) of a kind look like: any class that stands in the city."""
    classes = classes_in(config)
    if len(classes) == 1:
        return np.full(count, classes[0])
    return classes[random_stream(seed, kind, "class").integers(0, len(classes), count)]
