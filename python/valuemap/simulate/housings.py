"""Lights in a picture: where exactly, how they are turned, and their housings painted to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.simulate.canvas import ENLARGED, Picture, View, fill, on_canvas
from valuemap.simulate.sightings import NARROWEST, cos_facing
from valuemap.simulate.targets import Targets
from valuemap.simulate.weather import Color, Light
from valuemap.tables import Table

LIT: tuple[Color, ...] = ((255, 62, 40), (255, 186, 48), (70, 255, 160))
"""Colours of lit lamps: red, amber, green."""
_DARK: tuple[Color, ...] = ((72, 18, 16), (70, 52, 14), (12, 56, 40))
_LAMP_AT = (0.19, 0.5, 0.81)
_LAMP_RADIUS = 0.31
_BODIES: tuple[Color, ...] = ((44, 46, 46), (34, 60, 48), (198, 158, 36))
_PATCH_PX = 160.0


@dataclass(frozen=True, eq=False)
class Housings(Table):
    """Lights before the camera: row of the light, depth, centre and size (N, 2) in pixels, cosine of the turn."""

    light_row: Ints
    depth_m: Floats
    center_px: Floats
    size_px: Floats
    cos_facing: Floats

    def corners_px(self) -> Floats:
        """Return the boxes (N, 4): left, top, right, bottom."""
        return np.concatenate([self.center_px - self.size_px / 2.0, self.center_px + self.size_px / 2.0], axis=1)


def place_housings(lights: Targets, rows: Ints, view: View) -> Housings:
    """Return where those of the lights are that can be in the picture, the whole or a part."""
    to_light = lights.position_in_world_m[rows] - view.center_in_world_m
    in_cam = to_light @ view.cam_from_world.T
    before = in_cam[:, 2] > 1.0
    rows, to_light, in_cam = rows[before], to_light[before], in_cam[before]
    turn = cos_facing(to_light, lights.facing_rad[rows])
    size_px = view.focal_px * lights.size_m[rows] / in_cam[:, 2:]
    size_px[:, 0] *= np.maximum(np.abs(turn), NARROWEST)
    housings = Housings(rows, in_cam[:, 2], view.project_px(in_cam), size_px, turn)
    box = housings.corners_px()
    inside = np.all((box[:, 2:] > 0.0) & (box[:, :2] < [view.width_px, view.height_px]), axis=1)
    return housings.take(inside)


def paint_housing(
    canvas: Picture, box_px: Floats, turn: float, lamp: int, body: int, light: Light, haze: float
) -> None:
    """Paint one housing that fills exactly the box (left, top, right, bottom).

    It is painted enlarged on a patch of its own, which is then shrunk onto the canvas, so that lamps lie where
    they belong to a small fraction of a pixel; its edges are exact. `turn` is the cosine between its front and
    the camera, `lamp` the lit one, `haze` the share of its colour that is left.
    """
    box = box_px * ENLARGED
    low = np.maximum(np.floor(box[:2]).astype(int) - 1, 0)
    high = np.minimum(np.ceil(box[2:]).astype(int) + 1, [canvas.shape[1], canvas.shape[0]])
    if np.any(high <= low):
        return
    finer = int(np.clip(round(_PATCH_PX / (box[3] - box[1])), 1, 16))
    width, height = (high - low) * finer
    color = np.zeros((height, width, 3), np.uint8)
    left, top, right, bottom = ((box - np.tile(low, 2)) * finer).tolist()
    ambient = np.asarray(light.weather.skylight) + 0.3 * np.asarray(light.weather.sunlight)
    body_color = ambient * _BODIES[body % len(_BODIES)] * (0.8 if turn > 0.0 else 0.65)
    color[:] = body_color.astype(np.uint8)
    if turn > 0.0:
        _paint_lamps(color, (left, top, right, bottom), turn, lamp, body_color, ambient)
    else:
        _paint_back(color, (left, top, right, bottom), body_color)
    hazed = color * haze + np.asarray(light.weather.sky_low) * (1.0 - haze)
    if turn > 0.0:
        _paint_lit(hazed, (left, top, right, bottom), turn, lamp)
    patch_px = (int(high[0] - low[0]), int(high[1] - low[1]))
    share = np.outer(_covered(box[1], box[3], low[1], high[1]), _covered(box[0], box[2], low[0], high[0]))[:, :, None]
    smooth = cv2.resize(hazed, patch_px, interpolation=cv2.INTER_AREA)
    place = canvas[low[1] : high[1], low[0] : high[0]]
    place[:] = np.rint(np.clip(place * (1.0 - share) + smooth * share, 0.0, 255.0)).astype(np.uint8)


def paint_lookalike(canvas: Picture, box_px: Floats, light: Light, haze: float) -> None:
    """Paint what may be taken for a light: a narrow dark shop sign with a coloured emblem."""
    ambient = np.asarray(light.weather.skylight) + 0.3 * np.asarray(light.weather.sunlight)
    sky = np.asarray(light.weather.sky_low) * (1.0 - haze)
    left, top, right, bottom = box_px
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    fill(canvas, corners, (np.array([36.0, 34.0, 52.0]) * ambient * haze + sky).tolist())
    middle, radius_px = lamp_px(box_px, 0)
    angle = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    emblem = middle + radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    fill(canvas, emblem, (np.array([224.0, 96.0, 60.0]) * haze + sky).tolist())


def lamp_px(box_px: Floats, lamp: int) -> tuple[Floats, float]:
    """Return centre (2) and radius of a lamp of the housing in a box, in pixels."""
    left, top, right, bottom = box_px
    center = np.array([(left + right) / 2.0, top + _LAMP_AT[lamp] * (bottom - top)])
    return center, _LAMP_RADIUS * 0.35 * float(bottom - top)


def _covered(start: float, stop: float, first: int, last: int) -> Floats:
    """Return which shares of the pixels first to last (N) are between start and stop."""
    pixel = np.arange(first, last)
    covered: Floats = np.clip(np.minimum(pixel + 1, stop) - np.maximum(pixel, start), 0.0, 1.0)
    return covered


def _ellipse(
    middle: tuple[float, float], radius: tuple[float, float]
) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    angle = np.linspace(0.0, 2.0 * np.pi, 28, endpoint=False)
    points = np.stack([middle[0] + radius[0] * np.cos(angle), middle[1] + radius[1] * np.sin(angle)], axis=1)
    return on_canvas(points, 1.0)


def _paint_lamps(
    color: Picture, box: tuple[float, float, float, float], turn: float, lamp: int, body: Floats, ambient: Floats
) -> None:
    """Paint visors and dark lamps, and an edge along the housing."""
    left, top, right, bottom = box
    width, height, middle = right - left, bottom - top, (left + right) / 2.0
    edge = round(0.06 * width)
    if edge:
        rim = (np.clip(body * 1.5, 0, 255)).tolist()
        cv2.rectangle(color, (round(left), round(top)), (round(right) - 1, round(bottom) - 1), rim, edge)
    radius_x, radius_y = _LAMP_RADIUS * width, _LAMP_RADIUS * 0.35 * height
    radius_x *= turn / max(turn, NARROWEST)
    for number, at in enumerate(_LAMP_AT):
        center = top + at * height
        visor = _ellipse((middle, center - 0.25 * radius_y), (1.25 * radius_x, 1.25 * radius_y))
        cv2.fillConvexPoly(color, visor, (body * 0.45).tolist(), cv2.LINE_8, 4)
        if number != lamp:
            dark = (np.asarray(_DARK[number]) * ambient * 1.2).tolist()
            cv2.fillConvexPoly(color, _ellipse((middle, center), (radius_x, radius_y)), dark, cv2.LINE_8, 4)


def _paint_lit(color: Floats, box: tuple[float, float, float, float], turn: float, lamp: int) -> None:
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    radius = _LAMP_RADIUS * width * turn / max(turn, NARROWEST), _LAMP_RADIUS * 0.35 * height
    middle = (left + right) / 2.0, top + _LAMP_AT[lamp] * height
    bright = np.asarray(LIT[lamp])
    for share, white in ((1.0, 0.0), (0.75, 0.25), (0.45, 0.55)):
        shade = (bright + white * (255.0 - bright)).tolist()
        cv2.fillConvexPoly(color, _ellipse(middle, (share * radius[0], share * radius[1])), shade, cv2.LINE_8, 4)


def _paint_back(color: Picture, box: tuple[float, float, float, float], body: Floats) -> None:
    """Paint a back: two seams between its three parts and a hinge."""
    left, top, right, bottom = box
    height = bottom - top
    thick = max(1, round(0.02 * height))
    for at in (1.0 / 3.0, 2.0 / 3.0):
        y = round(top + at * height)
        color[max(0, y) : y + thick, max(0, round(left)) : max(0, round(right))] = (body * 0.6).astype(np.uint8)
