"""What the air and the camera make of a scene: sky, haze of lamps, wet streets, rain, exposure, noise."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats
from valuemap.config import SimulationConfig
from valuemap.simulate.canvas import ENLARGED, Picture, View
from valuemap.simulate.streams import random_stream
from valuemap.simulate.weather import WEATHERS, Light, Weather

COARSE = 4
"""Skies and glows are painted this much smaller than the picture: they are soft."""

_NOISE_MARGIN_PX = 64

Noise = NDArray[np.int16]


class Air:
    """Skies, light and noise of every weather, made once for all pictures of one size."""

    def __init__(self, config: SimulationConfig, seed: int) -> None:
        self.config = config
        self.seed = seed
        shade, beam = self._shade_of_corners(), self._light_of_headlamps()
        self._skies: dict[str, Picture] = {}
        self._noises: dict[str, Noise] = {}
        self._gains: dict[str, NDArray[np.float32]] = {}
        for weather in WEATHERS:
            self._skies[weather.name] = self._paint_sky(weather)
            self._noises[weather.name] = self._make_noise(weather.noise)
            gain = shade * (1.0 + weather.headlamps * beam)
            self._gains[weather.name] = np.repeat(gain[:, :, None], 3, axis=2).astype(np.float32)

    def sky_behind(self, view: View, light: Light) -> Picture:
        """Return an enlarged picture of nothing but the sky and the far ground."""
        sky = self._skies[light.weather.name]
        width, height = -(-view.width_px // COARSE), -(-view.height_px // COARSE)
        turn_px = -view.heading_rad * view.focal_px / COARSE
        rise_px = np.tan(view.pitch_rad) * view.focal_px / COARSE
        left = int(turn_px) % (sky.shape[1] - width)
        top = int(np.clip((sky.shape[0] - height) / 2.0 - rise_px, 0, sky.shape[0] - height))
        crop = sky[top : top + height, left : left + width]
        size = (view.width_px * ENLARGED, view.height_px * ENLARGED)
        return np.ascontiguousarray(cv2.resize(crop, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)

    def _make_noise(self, sigma: float) -> Noise:
        config = self.config
        shape = (config.image_height_px + _NOISE_MARGIN_PX, config.image_width_px + _NOISE_MARGIN_PX)
        random = random_stream(self.seed, "noise")
        grain = 0.8 * random.standard_normal((*shape, 1)) + 0.6 * random.standard_normal((*shape, 3))
        return np.round(sigma * grain).astype(np.int16)

    def _shade_of_corners(self) -> Floats:
        """Return the share of light (height, width) that the lens lets through."""
        config = self.config
        y = (np.arange(config.image_height_px) + 0.5) / config.image_height_px - 0.5
        x = (np.arange(config.image_width_px) + 0.5) / config.image_width_px - 0.5
        shade: Floats = 1.0 - 0.35 * (x[None] ** 2 + y[:, None] ** 2)
        return shade

    def _light_of_headlamps(self) -> Floats:
        """Return the light (height, width) that our own headlamps add on the street before us."""
        config = self.config
        y = (np.arange(config.image_height_px)[:, None] + 0.5) / config.image_height_px - 0.5
        x = (np.arange(config.image_width_px)[None] + 0.5) / config.image_width_px - 0.5
        beam: Floats = np.exp(-((x / 0.32) ** 2)) * np.exp(-(((y - 0.28) / 0.2) ** 2))
        return beam

    def expose(self, picture: Picture, glow: Picture, view: View, light: Light, random: np.random.Generator) -> Picture:
        """Add what the air and the camera add: glows, wet streets, rain, headlamps, white balance and noise."""
        weather = light.weather
        horizon = int(np.clip(view.height_px / 2.0 + np.tan(view.pitch_rad) * view.focal_px, 1, view.height_px - 1))
        soft = cv2.GaussianBlur(glow, (0, 0), 1.1)
        wide = cv2.GaussianBlur(glow, (0, 0), 4.5)
        halo = cv2.addWeighted(soft, 0.5 * weather.glow, wide, 0.9 * weather.glow, 0.0)
        if weather.is_wet:
            picture = _mirror_on_street(picture, horizon)
            picture = _let_it_rain(picture, random)
        halo = cv2.resize(halo, (view.width_px, view.height_px), interpolation=cv2.INTER_LINEAR)
        gain = self._gains[weather.name] * light.gain.astype(np.float32)
        bright = cv2.multiply(cv2.add(picture, halo), gain, dtype=cv2.CV_8U)
        top, left = random.integers(0, _NOISE_MARGIN_PX, 2)
        noise = self._noises[weather.name][top : top + view.height_px, left : left + view.width_px]
        return np.asarray(cv2.add(bright, noise, dtype=cv2.CV_8U), np.uint8)

    def _paint_sky(self, weather: Weather) -> Picture:
        """Paint the sky all around, with houses far away, and the ground below, at 1 / COARSE of the size."""
        config = self.config
        focal_px = config.focal_px / COARSE
        width = int(2.0 * np.pi * focal_px) + config.image_width_px // COARSE + 1
        height = 2 * (config.image_height_px // COARSE) + 2
        horizon = height // 2
        random = random_stream(self.seed, "sky", weather.name)
        up = np.clip((horizon - np.arange(height)) / focal_px, 0.0, None)[:, None, None]
        share = 1.0 - np.exp(-2.2 * up)
        sky = np.asarray(weather.sky_low) * (1.0 - share) + np.asarray(weather.sky_top) * share
        cloud = sum(
            cv2.resize(random.random((3 + 4 * n, 8 * n)), (width, height), interpolation=cv2.INTER_CUBIC) / n
            for n in (1, 2, 4, 8)
        )
        cover = weather.clouds * np.clip(2.2 * (np.asarray(cloud) / 2.0833 - 0.5), 0.0, 1.0)[:, :, None]
        bright = 0.6 * np.asarray(weather.sky_low) + 0.4 * np.asarray(weather.sky_low).max()
        picture = sky * (1.0 - cover) + bright * cover
        ground = np.asarray(weather.skylight) * 120.0
        down = np.clip((np.arange(height) - horizon) / focal_px, 0.0, None)[:, None, None]
        far = np.exp(-12.0 * down)
        picture[horizon:] = (np.asarray(weather.sky_low) * far + ground * (1.0 - far))[horizon:]
        for left in np.arange(0, width, max(2, int(0.03 * focal_px))):
            roof = horizon - int(focal_px * random.uniform(0.015, 0.07))
            picture[roof:horizon, left : left + int(0.05 * focal_px)] = 0.72 * np.asarray(
                weather.sky_low
            ) + random.uniform(-8.0, 8.0)
        sky_picture: Picture = np.clip(picture, 0.0, 255.0).astype(np.uint8)
        return sky_picture


def _mirror_on_street(picture: Picture, horizon: int) -> Picture:
    """Return the picture with what is above the horizon faintly mirrored below it."""
    below = picture.shape[0] - horizon
    mirrored = cv2.resize(cv2.flip(picture[:horizon], 0), (picture.shape[1], below), interpolation=cv2.INTER_AREA)
    mirrored = cv2.blur(mirrored, (3, max(3, below // 6)))
    wet = picture.copy()
    wet[horizon:] = cv2.addWeighted(picture[horizon:], 0.78, mirrored, 0.24, 0.0)
    return wet


def _let_it_rain(picture: Picture, random: np.random.Generator) -> Picture:
    """Return the picture with streaks of rain."""
    height, width = picture.shape[:2]
    streaks = np.zeros((height, width), np.uint8)
    start = random.random((90, 2)) * [width, height]
    length = random.uniform(0.01, 0.035, (90, 1)) * height
    end = start + length * [0.12, 1.0]
    lines = np.round(np.stack([start, end], axis=1)).astype(np.int32)
    cv2.polylines(streaks, list(lines), False, 34, 1, cv2.LINE_AA)
    return np.asarray(cv2.add(picture, cv2.cvtColor(streaks, cv2.COLOR_GRAY2RGB)), np.uint8)
