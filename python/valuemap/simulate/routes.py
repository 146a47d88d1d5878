"""Which way the cars go: routes over the grid, as intersections and directions of travel."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from valuemap.arrays import Bools, Ints
from valuemap.config import SimulationConfig
from valuemap.simulate.streams import random_stream
from valuemap.simulate.streets import DIRECTIONS, Streets

_STEP: Ints = DIRECTIONS.astype(np.int64)
_LAST_RESORT = 1e-9
"""Weight of a way that is only taken where all others are closed."""


@dataclass(frozen=True, eq=False)
class Route:
    """A way over the grid: `intersection` (N + 1, 2), street numbers, and `direction` (N) between them."""

    intersection: Ints
    direction: Ints


def route_at_random(streets: Streets, config: SimulationConfig, *, seed: int, pass_row: int) -> Route:
    """Return a drive of `pass_length_m` that turns at random and never turns round."""
    random = random_stream(seed, "route", pass_row)
    can_leave = streets.can_leave()
    straight_or_turn = np.array([1.0 - config.turn_share, config.turn_share / 2.0, config.turn_share / 2.0])
    here = random.integers(0, streets.shape)
    direction = int(random.choice(np.flatnonzero(can_leave[here[0], here[1]])))
    intersections, directions, length_m = [here], [], 0.0
    while length_m < config.pass_length_m:
        here = here + _STEP[direction]
        intersections.append(here)
        directions.append(direction)
        length_m += float(np.abs(np.diff(streets.center_m(np.array(intersections[-2:])), axis=0)).sum())
        ways = np.array([direction, (direction + 1) % 4, (direction + 3) % 4])
        weights = straight_or_turn * streets.popularity[here[0], here[1], ways] + _LAST_RESORT
        weights *= can_leave[here[0], here[1], ways]
        direction = int(random.choice(ways, p=weights / weights.sum()))
    return Route(np.array(intersections), np.array(directions))


def routes_over_every_street(
    streets: Streets, config: SimulationConfig, *, seed: int, round_number: int
) -> list[Route]:
    """Return routes that together drive every street once in each direction, without turning round.

    Each arrival at an intersection is given a departure of its own at random, which makes closed loops; loops
    that meet are joined by swapping departures; the loops are cut into passes of about `pass_length_m`, or are driven
    `laps` times each.
    """
    random = random_stream(seed, "round", round_number)
    departure = _random_departures(streets.can_leave(), random)
    _join_loops(departure, random)
    routes = []
    for loop in _loops(departure):
        turned = np.roll(loop, random.integers(0, len(loop)), axis=0)
        intersection, direction = np.concatenate([turned[:, :2], turned[:1, :2]]), turned[:, 2]
        length_m = float(np.abs(np.diff(streets.center_m(intersection), axis=0)).sum())
        if config.laps > 1:
            intersection = np.concatenate([np.tile(intersection[:-1], (config.laps, 1)), intersection[-1:]])
            routes.append(Route(intersection, np.tile(direction, config.laps)))
            continue
        parts = np.clip(round(length_m / config.pass_length_m), 1, len(direction))
        cuts = np.linspace(0, len(direction), parts + 1).astype(int)
        routes += [Route(intersection[a : b + 1], direction[a:b]) for a, b in pairwise(cuts)]
    return routes


def _random_departures(can_leave: Bools, random: np.random.Generator) -> Ints:
    """Return (i, j, k): where a car goes on to that reaches intersection (i, j) in direction k, or -1."""
    departure = np.full(can_leave.shape, -1, dtype=np.int64)
    for i, j in np.ndindex(can_leave.shape[:2]):
        leaving = np.flatnonzero(can_leave[i, j])
        arriving = (leaving + 2) % 4
        shuffled = random.permutation(leaving)
        while np.any(shuffled == leaving):  # That would be turning round.
            shuffled = random.permutation(leaving)
        departure[i, j, arriving] = shuffled
    return departure


def _loops(departure: Ints) -> list[Ints]:
    """Return the closed loops as rows (intersection i, j, direction of travel from there)."""
    loops = []
    todo = departure >= 0
    for start in np.argwhere(todo):
        i, j, arriving = (int(c) for c in start)
        loop = []
        while todo[i, j, arriving]:
            todo[i, j, arriving] = False
            leaving = int(departure[i, j, arriving])
            loop.append((i, j, leaving))
            i, j, arriving = i + int(_STEP[leaving, 0]), j + int(_STEP[leaving, 1]), leaving
        if loop:
            loops.append(np.array(loop))
    return loops


def _join_loops(departure: Ints, random: np.random.Generator) -> None:
    """Swap departures of arrivals that are in different loops, which makes one loop of the two."""
    loop_of = np.full(departure.shape, -1, dtype=np.int64)
    for number, loop in enumerate(_loops(departure)):
        reached = loop[:, :2] + _STEP[loop[:, 2]]
        loop_of[reached[:, 0], reached[:, 1], loop[:, 2]] = number
    for i, j in random.permutation(np.argwhere(np.ones(departure.shape[:2]))):
        for a, b in combinations(np.flatnonzero(departure[i, j] >= 0), 2):
            turns_round = departure[i, j, a] == (b + 2) % 4 or departure[i, j, b] == (a + 2) % 4
            if loop_of[i, j, a] != loop_of[i, j, b] and not turns_round:
                departure[i, j, [a, b]] = departure[i, j, [b, a]]
                loop_of[loop_of == loop_of[i, j, b]] = loop_of[i, j, a]
