"""What light there is: day, dusk, night or rain, one for each pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats
from valuemap.simulate.streams import random_stream

Color = tuple[float, float, float]
"""Red, green, blue from 0 to 255; of light, 1 is white."""


@dataclass(frozen=True)
class Weather:
    """How a scene is lit: colours of the sky, of the light and of the haze, and what shines by itself."""

    name: str
    sky_top: Color
    sky_low: Color
    clouds: float
    sunlight: Color
    skylight: Color
    haze_length_m: float
    lit_windows: float
    glow: float
    lamps_are_on: bool
    is_wet: bool
    headlamps: float
    noise: float


WEATHERS = (
    Weather(
        name="day",
        sky_top=(92, 142, 205),
        sky_low=(196, 216, 232),
        clouds=0.55,
        sunlight=(0.46, 0.44, 0.40),
        skylight=(0.56, 0.58, 0.62),
        haze_length_m=420.0,
        lit_windows=0.0,
        glow=0.25,
        lamps_are_on=False,
        is_wet=False,
        headlamps=0.0,
        noise=2.0,
    ),
    Weather(
        name="dusk",
        sky_top=(62, 72, 122),
        sky_low=(238, 170, 118),
        clouds=0.7,
        sunlight=(0.30, 0.17, 0.08),
        skylight=(0.38, 0.36, 0.42),
        haze_length_m=320.0,
        lit_windows=0.18,
        glow=0.6,
        lamps_are_on=True,
        is_wet=False,
        headlamps=0.2,
        noise=3.0,
    ),
    Weather(
        name="night",
        sky_top=(7, 9, 18),
        sky_low=(32, 30, 38),
        clouds=0.3,
        sunlight=(0.0, 0.0, 0.0),
        skylight=(0.20, 0.185, 0.20),
        haze_length_m=240.0,
        lit_windows=0.3,
        glow=1.0,
        lamps_are_on=True,
        is_wet=False,
        headlamps=1.6,
        noise=5.0,
    ),
    Weather(
        name="rain",
        sky_top=(128, 134, 142),
        sky_low=(170, 175, 180),
        clouds=0.25,
        sunlight=(0.0, 0.0, 0.0),
        skylight=(0.50, 0.52, 0.55),
        haze_length_m=130.0,
        lit_windows=0.12,
        glow=0.6,
        lamps_are_on=True,
        is_wet=True,
        headlamps=0.0,
        noise=3.5,
    ),
)


@dataclass(frozen=True)
class Light:
    """The weather of one pass with where its sun stands and how the camera takes it.

    `sun` is the horizontal unit vector to the sun, `gain` the factors of red, green and blue by exposure and
    white balance.
    """

    weather: Weather
    sun: Floats
    gain: Floats

    def on_walls(self, normal: Floats) -> Floats:
        """Return the light (N, 3) on walls that face (N, 2)."""
        toward_sun = np.clip(normal @ self.sun, 0.0, None)
        lit: Floats = np.asarray(self.weather.skylight) + toward_sun[:, None] * np.asarray(self.weather.sunlight)
        return lit

    @property
    def on_ground(self) -> Floats:
        """The light (3) on the street."""
        return np.asarray(self.weather.skylight) + 0.6 * np.asarray(self.weather.sunlight)

    def through_haze(self, color: Floats, distance_m: Floats) -> Floats:
        """Return colours (N, 3) as seen over distances (N)."""
        clear = np.exp(-distance_m / self.weather.haze_length_m)[:, None]
        haze: Floats = color * clear + np.asarray(self.weather.sky_low) * (1.0 - clear)
        return haze


def light_of_pass(pass_row: int, *, seed: int) -> Light:
    """Return the light of a pass: the same for all its images."""
    # Each four successive passes have one of each weather.
    block, turn = divmod(pass_row, len(WEATHERS))
    weather = WEATHERS[random_stream(seed, "weather", block).permutation(len(WEATHERS))[turn]]
    random = random_stream(seed, "light", pass_row)
    azimuth = random.uniform(0.0, 2.0 * np.pi)
    exposure, warmth = random.uniform(0.88, 1.12), random.uniform(-0.05, 0.05)
    return Light(
        weather=weather,
        sun=np.array([np.cos(azimuth), np.sin(azimuth)]),
        gain=exposure * np.array([1.0 + warmth, 1.0, 1.0 - warmth]),
    )
