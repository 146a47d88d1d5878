"""The ground of the city: a grid of streets between houses, on hills.

East is x, north is y, up is z, all in metres. The four directions of travel are numbered 0 east, 1 north,
2 west, 3 south, so that k + 1 is a turn to the left and k - 1 one to the right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.simulate.streams import random_stream

DIRECTIONS: Floats = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Unit vectors of the directions of travel."""

_HILL_LENGTHS_M = (350.0, 900.0)
_HILLS = 6


@dataclass(frozen=True, eq=False)
class Hills:
    """The height of the ground as a sum of plane waves: h(p) = amplitude * sum of sin(wave_vector . p + phase)."""

    amplitude_m: float
    wave_vector: Floats
    phase_rad: Floats

    def height_m(self, ground_m: Floats) -> Floats:
        """Return the height (N) at points (N, 2) of the ground."""
        height: Floats = self.amplitude_m * np.sin(self._angle(ground_m)).sum(axis=1)
        return height

    def slope(self, ground_m: Floats) -> Floats:
        """Return the gradient (N, 2) of the height."""
        cosine = self.amplitude_m * np.cos(self._angle(ground_m))
        return np.stack([(cosine * self.wave_vector[:, axis]).sum(axis=1) for axis in (0, 1)], axis=1)

    def _angle(self, ground_m: Floats) -> Floats:
        x, y = ground_m[:, :1], ground_m[:, 1:]
        angle: Floats = x * self.wave_vector[:, 0] + y * self.wave_vector[:, 1] + self.phase_rad
        return angle


@dataclass(frozen=True, eq=False)
class Streets:
    """A grid of streets.

    `x_m` are the axes of the streets that run north to south, `y_m` of those that run east to west; an
    intersection is a pair (i, j) of their numbers. Houses fill everything farther than `half_width_m` from
    all axes. `popularity[i, j, k]` says how much drivers like the street through (i, j) in direction k.
    """

    x_m: Floats
    y_m: Floats
    half_width_m: float
    popularity: Floats
    hills: Hills

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of streets that run north to south, and east to west."""
        return len(self.x_m), len(self.y_m)

    def center_m(self, intersection: Ints) -> Floats:
        """Return the centres (N, 2) on the ground of intersections (N, 2)."""
        return np.stack([self.x_m[intersection[:, 0]], self.y_m[intersection[:, 1]]], axis=1)

    def can_leave(self) -> Bools:
        """Return (i, j, k): whether a street leads on from intersection (i, j) in direction k."""
        can_leave = np.ones((*self.shape, 4), dtype=np.bool_)
        can_leave[-1, :, 0] = can_leave[:, -1, 1] = can_leave[0, :, 2] = can_leave[:, 0, 3] = False
        return can_leave

    def is_hidden_by_houses(self, from_m: Floats, to_m: Floats) -> Bools:
        """Return whether a house stands between points (N, 2) and (N, 2) of the ground.

        A block of houses is the product of a gap between streets in x and one in y. A line of sight enters it
        where its stretch inside the one gap overlaps its stretch inside the other.
        """
        hidden = np.zeros(len(from_m), dtype=np.bool_)
        for x_from, x_to in self._stretches_between(self.x_m, from_m[:, 0], to_m[:, 0]):
            for y_from, y_to in self._stretches_between(self.y_m, from_m[:, 1], to_m[:, 1]):
                hidden |= np.maximum(x_from, y_from) < np.minimum(x_to, y_to)
        return hidden

    def _stretches_between(self, axes_m: Floats, start: Floats, end: Floats) -> list[tuple[Floats, Floats]]:
        """Return, for each gap between streets that lines start..end (N) may meet, the part of each inside it.

        A part is from (N) and to (N), as shares of the line; it is empty where from >= to.
        """
        low = np.concatenate([[-np.inf], axes_m + self.half_width_m])
        high = np.concatenate([axes_m - self.half_width_m, [np.inf]])
        first = np.searchsorted(high, np.minimum(start, end), side="right")
        last = np.searchsorted(low, np.maximum(start, end), side="left") - 1
        stretches = []
        for offset in range(int(np.max(last - first, initial=-1)) + 1):
            gap = np.minimum(first + offset, len(low) - 1)
            with np.errstate(divide="ignore", invalid="ignore"):  # A line along a street gives +-inf, rightly.
                enter, leave = (low[gap] - start) / (end - start), (high[gap] - start) / (end - start)
            stretches.append((np.maximum(np.minimum(enter, leave), 0.0), np.minimum(np.maximum(enter, leave), 1.0)))
        return stretches


def lay_streets(config: SimulationConfig, *, seed: int) -> Streets:
    """Lay the streets of a city."""
    return Streets(
        x_m=_street_axes(config.streets_north_south, config.block_east_m, config, seed, "x"),
        y_m=_street_axes(config.streets_east_west, config.block_north_m, config, seed, "y"),
        half_width_m=config.street_width_m / 2.0,
        popularity=_popularity(config, random_stream(seed, "popularity")),
        hills=_raise_hills(config, random_stream(seed, "hills")),
    )


def _street_axes(count: int, block_m: float, config: SimulationConfig, seed: int, axis: str) -> Floats:
    random = random_stream(seed, "streets", axis)
    blocks = block_m * (1.0 + config.block_jitter * random.uniform(-1.0, 1.0, count - 1))
    axes: Floats = np.concatenate([[0.0], np.cumsum(blocks)])
    return axes


def _popularity(config: SimulationConfig, random: np.random.Generator) -> Floats:
    shape = (config.streets_north_south, config.streets_east_west)
    # Normal quantiles in random order: every city has its share of main streets.
    of_north_south, of_east_west = (
        np.exp(config.main_street_pull * random.permutation(ndtri((np.arange(count) + 0.5) / count))) for count in shape
    )
    along_x = np.broadcast_to(of_east_west[None, :], shape)
    along_y = np.broadcast_to(of_north_south[:, None], shape)
    return np.stack([along_x, along_y, along_x, along_y], axis=2)


def _raise_hills(config: SimulationConfig, random: np.random.Generator) -> Hills:
    wave_number = 2.0 * np.pi / random.uniform(*_HILL_LENGTHS_M, _HILLS)
    angle = random.uniform(0.0, 2.0 * np.pi, _HILLS)
    return Hills(
        amplitude_m=config.relief_m * float(np.sqrt(2.0 / _HILLS)),
        wave_vector=np.stack([np.cos(angle), np.sin(angle)], axis=1) * wave_number[:, None],
        phase_rad=random.uniform(0.0, 2.0 * np.pi, _HILLS),
    )
