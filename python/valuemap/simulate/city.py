"""What stands in the city: lights at some intersections, rows along the streets, and things that look like lights."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.errors import SettingError
from valuemap.simulate.roadside import place_roadside
from valuemap.simulate.rows import join_rows
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import DIRECTIONS, Streets, lay_streets
from valuemap.simulate.targets import CLASSES, Targets, class_of_false

_MOUNTS_M: Floats = np.array(
    # Ahead of the intersection's centre, to the left of the street's axis, above the street, as drivers see it.
    [
        [10.5, -2.5, 5.5],  # mast arm beyond the intersection
        [10.5, -8.0, 3.6],  # the pole that carries it
        [10.5, 10.0, 3.6],  # pole beyond the intersection, on the left
        [-11.0, -8.0, 3.4],  # pole before the intersection
    ]
)
"""Where lights hang: no two mounts of the four approaches of an intersection are nearer than 2 m."""
_BEFORE_INTERSECTION = 3
_MOUNT_JITTER_M = 0.3
_STOREY_M = 1.5
_PAIR_APART_M = (0.5, 0.9)
_AIM_JITTER_RAD = np.radians(8.0)
_LOOKALIKE_AHEAD_M = (-60.0, -15.0)
_LOOKALIKE_ASIDE_M = (7.5, 11.0)
_LOOKALIKE_ABOVE_M = (2.5, 6.0)


@dataclass(frozen=True, eq=False)
class City:
    """Streets and what stands there for good.

    `roadside` are the signs, lamps, trees and posts along the streets.
    `is_signalised[i, j, k]` says whether lights face the traffic that reaches intersection (i, j) in direction k.
    """

    streets: Streets
    is_signalised: Bools
    lights: Targets
    roadside: Targets
    lookalikes: Targets

    @cached_property
    def objects(self) -> Targets:
        """All that is in the truth, in its order: the lights, then what stands along the streets."""
        return join_rows([self.lights, self.roadside])


def build_city(config: SimulationConfig, *, seed: int) -> City:
    """Build the city of a seed; drives, detector and poses do not change it.

    Raises
    ------
    SettingError
        The exact number of lights does not fit the number of intersections that have lights.
    """
    streets = lay_streets(config, seed=seed)
    lights_facing = _lights_per_approach(config, streets, random_stream(seed, "signals"))
    lights = _hang_lights(config, lights_facing, streets, random_stream(seed, "lights"))
    count = round(config.lookalikes_per_light * len(lights))
    return City(
        streets=streets,
        is_signalised=lights_facing > 0,
        lights=_in_many_shapes(lights, config, seed, "lights"),
        roadside=_in_many_shapes(place_roadside(config, streets, seed=seed), config, seed, "roadside"),
        lookalikes=_place_lookalikes(config, count, np.argwhere(lights_facing > 0), streets, seed),
    )


def _in_many_shapes(targets: Targets, config: SimulationConfig, seed: int, kind: str) -> Targets:
    """Return the targets larger or smaller than they were, and uneven, each in its own way."""
    if config.size_spread:
        log_factor = config.size_spread * random_stream(seed, kind, "size").standard_normal((len(targets), 1))
        targets = targets.replace(size_m=targets.size_m * np.exp(log_factor))
    if config.side_offset_m:
        uneven = random_stream(seed, kind, "uneven").standard_normal((len(targets), 4))
        targets = targets.replace(uneven_m=config.side_offset_m * uneven)
    return targets


def _lights_per_approach(config: SimulationConfig, streets: Streets, random: np.random.Generator) -> Ints:
    """Return (i, j, k): how many lights face the traffic that reaches intersection (i, j) in direction k."""
    if not config.has_lights:
        return np.zeros((*streets.shape, 4), dtype=np.int64)
    can_arrive = np.roll(streets.can_leave(), 2, axis=2)  # Who may leave to the west may arrive going east.
    every = np.argwhere(np.ones(streets.shape))
    count = max(1, round(config.signalised_share * len(every)))
    signalised = every[np.sort(random.choice(len(every), count, replace=False))]
    popularity = streets.popularity[signalised[:, 0], signalised[:, 1]]
    # Popular intersections tend to have more lights.
    rank = np.argsort(np.argsort(np.log(popularity).max(axis=1) + 0.5 * random.standard_normal(count)))
    totals = np.sort(_lights_per_intersection(config, count, random))[rank]
    lights_facing = np.zeros(can_arrive.shape, dtype=np.int64)
    for (i, j), total in zip(signalised, totals, strict=True):
        arriving = np.flatnonzero(can_arrive[i, j])
        approaches = np.clip(round(total / config.lights_per_approach), 1, min(len(arriving), total))
        chosen = random.choice(arriving, approaches, replace=False)
        weights = streets.popularity[i, j, chosen] / streets.popularity[i, j, chosen].sum()
        lights_facing[i, j, chosen] = 1
        np.add.at(lights_facing[i, j], random.choice(chosen, total - approaches, p=weights), 1)
    return lights_facing


def _lights_per_intersection(config: SimulationConfig, count: int, random: np.random.Generator) -> Ints:
    """Return numbers of lights (count) within the limits; their sum is `lights` where that is given."""
    fewest, most = config.min_lights, config.max_lights
    totals = random.integers(fewest, most + 1, count)
    if config.lights == 0:
        return totals
    if not fewest * count <= config.lights <= most * count:
        raise SettingError(
            f"lights ({config.lights}): {count} intersections with {fewest} to {most} lights each have "
            f"{fewest * count} to {most * count}",
            hint="change signalised_share, or streets_north_south and streets_east_west",
        )
    while (missing := config.lights - int(totals.sum())) != 0:
        free = np.flatnonzero(totals < most if missing > 0 else totals > fewest)
        changed = random.choice(free, min(abs(missing), len(free)), replace=False)
        totals[changed] += np.sign(missing)
    return totals


def _hang_lights(
    config: SimulationConfig, lights_facing: Ints, streets: Streets, random: np.random.Generator
) -> Targets:
    approaches = np.argwhere(lights_facing > 0)
    places = [np.empty((0, 3)), *(_choose_mounts(config, lights_facing[i, j, k], random) for i, j, k in approaches)]
    of_light = np.repeat(approaches, [len(p) for p in places[1:]], axis=0)
    class_code = np.full(len(of_light), CLASSES.index("traffic_light"))
    return _targets_at(of_light, np.concatenate(places), class_code, streets, config, 1.0, random)


def _choose_mounts(config: SimulationConfig, count: int, random: np.random.Generator) -> Floats:
    """Return places (count, 3) for the lights of one approach: ahead, to the left, above the street."""
    order = random.permutation(len(_MOUNTS_M))
    # The first light hangs beyond the intersection, so that it is seen up to the stop line.
    order = np.roll(order, -1) if order[0] == _BEFORE_INTERSECTION else order
    mounts = _MOUNTS_M[order] + random.uniform(-_MOUNT_JITTER_M, _MOUNT_JITTER_M, (len(order), 3))
    aside_m = random.choice([-1.0, 1.0], len(order)) * random.uniform(*_PAIR_APART_M, len(order))
    twins = mounts + aside_m[:, None] * [0.0, 1.0, 0.0]
    # Chosen twins come right after their mount, the others only when all mounts are taken.
    is_paired = random.random(len(order)) < config.pair_share
    turn = np.concatenate([np.arange(4.0), np.where(is_paired, np.arange(4.0) + 0.5, np.arange(4.0) + 4.0)])
    places = np.concatenate([mounts, twins])[np.argsort(turn)]
    # An approach with more lights than that has the same again, a storey higher.
    storey = np.arange(count) // len(places)
    above_m = _STOREY_M * storey[:, None] * [0.0, 0.0, 1.0]
    return places[np.arange(count) % len(places)] + above_m


def _place_lookalikes(config: SimulationConfig, count: int, approaches: Ints, streets: Streets, seed: int) -> Targets:
    """Put lookalikes beside the streets that lead to lights, where cars look."""
    random = random_stream(seed, "lookalikes")
    side = random.choice([-1.0, 1.0], count)
    places = np.column_stack(
        [
            random.uniform(*_LOOKALIKE_AHEAD_M, count),
            side * random.uniform(*_LOOKALIKE_ASIDE_M, count),
            random.uniform(*_LOOKALIKE_ABOVE_M, count),
        ]
    )
    chosen = approaches[random.integers(0, max(len(approaches), 1), count)]
    class_code = class_of_false(count, config, seed=seed, kind="lookalikes")
    return _targets_at(chosen, places, class_code, streets, config, config.lookalike_recall, random)


def _targets_at(
    approach: Ints,
    place_m: Floats,
    class_code: Ints,
    streets: Streets,
    config: SimulationConfig,
    recall_share: float,
    random: np.random.Generator,
) -> Targets:
    """Return targets at places (N, 3) (ahead, left, above) of approaches (N, 3) (i, j, k), facing their traffic."""
    count = len(approach)
    ahead = DIRECTIONS[approach[:, 2]]
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    ground = streets.center_m(approach[:, :2]) + place_m[:, :1] * ahead + place_m[:, 1:2] * left
    aim_rad = random.uniform(-_AIM_JITTER_RAD, _AIM_JITTER_RAD, count)
    return Targets(
        position_in_world_m=np.column_stack([ground, streets.hills.height_m(ground) + place_m[:, 2]]),
        facing_rad=np.arctan2(-ahead[:, 1], -ahead[:, 0]) + aim_rad,
        size_m=np.broadcast_to([config.light_width_m, config.light_height_m], (count, 2)),
        recall_share=np.full(count, recall_share),
        pass_row=np.full(count, -1, dtype=np.int64),
        class_code=class_code,
        is_round=np.zeros(count, dtype=np.bool_),
        uneven_m=np.zeros((count, 4)),
    )
