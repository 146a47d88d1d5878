"""What vehicles look like: faces, windows, wheels and lamps, as polygons around their middle on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.simulate.traffic import CAR, COACH, SIZES_M, TRUCK
from valuemap.tables import Table

PAINT, GLASS, TYRE, TRIM, TAIL_LAMP, HEAD_LAMP = range(6)
_CORNERS = 8


@dataclass(frozen=True, eq=False)
class Polygons(Table):
    """Polygons (N, 8, 3) in m: x ahead, y left, z up; where they face (N, 3), what they are of, in which part."""

    corner_m: Floats
    normal: Floats
    material: Ints
    part: Ints


class _Shape:
    """Collects the polygons of one kind of vehicle."""

    def __init__(self) -> None:
        self.rows: list[tuple[Floats, tuple[float, float, float], int, int]] = []

    def add(self, corners: Floats, normal: tuple[float, float, float], material: int, part: int) -> None:
        padded = corners[np.minimum(np.arange(_CORNERS), len(corners) - 1)]
        self.rows.append((padded, normal, material, part))

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float], part: int, inset: float) -> None:
        """Add the faces of a box whose top is smaller by `inset` on every side."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        a, b = 2.0 * inset, 0.6 * inset  # Windscreens slope more than sides.
        below = [(x0, y1, z0), (x0, y0, z0), (x1, y0, z0), (x1, y1, z0)]
        above = [(x0 + b, y1 - b, z1), (x0 + b, y0 + b, z1), (x1 - a, y0 + b, z1), (x1 - a, y1 - b, z1)]
        p = np.array(below + above)
        normals = [(-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
        for side, normal in enumerate(normals):
            after = (side + 1) % 4
            self.add(p[[side, after, after + 4, side + 4]], normal, PAINT, part)
            if inset:  # A cabin has windows all around.
                q = p[[side, after, after + 4, side + 4]]
                q = q.mean(axis=0) + (q - q.mean(axis=0)) * 0.84
                self.add(q, normal, GLASS, part)
        self.add(p[4:], (0.0, 0.0, 1.0), PAINT, part)

    def wheels(self, at_m: tuple[float, ...], radius_m: float, half_width_m: float, part: int) -> None:
        angle = np.arange(8) * (np.pi / 4.0) + 0.39
        for x in at_m:
            for side in (-1.0, 1.0):
                y = np.full(8, side * half_width_m)
                circle = np.stack([x + radius_m * np.cos(angle), y, radius_m * (1.0 + np.sin(angle))], axis=1)
                self.add(circle, (0.0, side, 0.0), TYRE, part)

    def plate(self, x: float, y: tuple[float, float], z: tuple[float, float], material: int, part: int) -> None:
        """Add a rectangle on the front or on the rear."""
        corners = np.array([(x, y[0], z[0]), (x, y[1], z[0]), (x, y[1], z[1]), (x, y[0], z[1])])
        self.add(corners, (float(np.sign(x)), 0.0, 0.0), material, part)

    def done(self) -> Polygons:
        corners, normals, materials, parts = zip(*self.rows, strict=True)
        return Polygons(np.array(corners), np.array(normals), np.array(materials), np.array(parts))


def _car() -> Polygons:
    shape = _Shape()
    length, width, height = SIZES_M[CAR].tolist()
    half = width / 2.0
    shape.box((-length / 2.0, -half, 0.28), (length / 2.0, half, 0.88), 0, 0.0)
    shape.wheels((-0.3 * length, 0.31 * length), 0.33, half, 0)
    for side in (-1.0, 1.0):
        inner, outer = sorted((side * 0.48, side * (half - 0.04)))
        shape.plate(-length / 2.0, (inner, outer), (0.62, 0.8), TAIL_LAMP, 0)
        shape.plate(length / 2.0, (inner, outer), (0.58, 0.74), HEAD_LAMP, 0)
    shape.plate(-length / 2.0, (-half, half), (0.28, 0.42), TRIM, 0)
    shape.plate(length / 2.0, (-0.45, 0.45), (0.38, 0.6), TRIM, 0)
    shape.box((-0.46 * length, -half + 0.04, 0.88), (0.24 * length, half - 0.04, height), 1, 0.3)
    return shape.done()


def _truck() -> Polygons:
    shape = _Shape()
    length, width, height = SIZES_M[TRUCK].tolist()
    half = width / 2.0
    shape.box((-length / 2.0, -half, 0.55), (0.26 * length, half, height), 0, 0.0)
    shape.wheels((-0.34 * length, -0.2 * length), 0.48, half, 0)
    shape.plate(-length / 2.0, (-half + 0.1, half - 0.1), (0.4, 0.62), TRIM, 0)
    shape.plate(-length / 2.0, (-0.02, 0.02), (0.7, height - 0.15), TRIM, 0)
    for side in (-1.0, 1.0):
        inner, outer = sorted((side * 0.75, side * (half - 0.1)))
        shape.plate(-length / 2.0, (inner, outer), (0.64, 0.82), TAIL_LAMP, 0)
        shape.plate(length / 2.0, (inner, outer), (0.75, 0.95), HEAD_LAMP, 1)
    shape.box((0.29 * length, -half + 0.1, 0.45), (length / 2.0, half - 0.1, 2.75), 1, 0.0)
    shape.plate(length / 2.0, (-half + 0.25, half - 0.25), (1.5, 2.5), GLASS, 1)
    shape.wheels((0.38 * length,), 0.48, half - 0.1, 1)
    return shape.done()


def _coach() -> Polygons:
    shape = _Shape()
    length, width, height = SIZES_M[COACH].tolist()
    half = width / 2.0
    shape.box((-length / 2.0, -half, 0.35), (length / 2.0, half, height), 0, 0.0)
    shape.wheels((-0.28 * length, 0.3 * length), 0.5, half, 0)
    for side in (-1.0, 1.0):
        for column in range(7):
            x0 = (-0.46 + 0.13 * column) * length
            x1 = x0 + 0.11 * length
            window = np.array([(x0, side * half, z) for z in (1.9, 1.9, 3.0, 3.0)])
            window[1:3, 0] = x1
            shape.add(window, (0.0, side, 0.0), GLASS, 0)
        inner, outer = sorted((side * 0.7, side * (half - 0.12)))
        shape.plate(length / 2.0, (inner, outer), (0.7, 0.92), HEAD_LAMP, 0)
        shape.plate(-length / 2.0, (inner, outer), (0.8, 1.1), TAIL_LAMP, 0)
    shape.plate(length / 2.0, (-half + 0.12, half - 0.12), (1.5, 3.1), GLASS, 0)
    shape.plate(length / 2.0, (-half, half), (0.35, 0.55), TRIM, 0)
    shape.plate(-length / 2.0, (-half + 0.25, half - 0.25), (2.1, 3.1), GLASS, 0)
    return shape.done()


SHAPES: dict[int, Polygons] = {CAR: _car(), TRUCK: _truck(), COACH: _coach()}
"""The polygons of each kind, those of one part in the order of painting."""
