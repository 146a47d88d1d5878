"""Algorithm 1 of the paper as it is written, in plain NumPy: all pairs, all projections, everything counted anew.

It shares no code with the package: real pinhole projections instead of local ones, a linear start instead of the
midpoint, a loop instead of bits. The core must agree with it on every label, voter and vote count.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Pinhole:
    """One image: intrinsics K, world to camera R, t."""

    intrinsics: Floats
    rotation: Floats
    translation: Floats

    @property
    def center(self) -> Floats:
        return np.asarray(-self.rotation.T @ self.translation)

    def project(self, point: Floats) -> tuple[Floats, float]:
        """Pixel and depth."""
        x, y, depth = self.rotation @ point + self.translation
        fx, fy, cx, cy = self.intrinsics[0, 0], self.intrinsics[1, 1], self.intrinsics[0, 2], self.intrinsics[1, 2]
        return np.array([fx * x / depth + cx, fy * y / depth + cy]), float(depth)

    def direction(self, pixel: Floats) -> Floats:
        ray = self.rotation.T @ np.linalg.inv(self.intrinsics) @ np.array([*pixel, 1.0])
        return np.asarray(ray / np.linalg.norm(ray))


@dataclass(frozen=True)
class Sighting:
    """One detection: its image (index), class and centre."""

    image: int
    class_name: str
    pixel: Floats


@dataclass(frozen=True)
class Settings:
    d_max_px: float
    theta_min_rad: float
    r_min_m: float
    r_max_m: float
    alpha: float
    min_votes: int


def error_px(camera: Pinhole, sighting: Sighting, point: Floats) -> float:
    pixel, depth = camera.project(point)
    return float(np.linalg.norm(pixel - sighting.pixel)) if depth > 0 else math.inf


def triangulate(cameras: list[Pinhole], sightings: list[Sighting], start: Floats | None = None) -> Floats | None:
    """Minimise Eq. (1) by Gauss-Newton with halved steps, from the linear solution."""
    if start is None:
        rows = []
        for camera, sighting in zip(cameras, sightings, strict=True):
            matrix = camera.intrinsics @ np.column_stack([camera.rotation, camera.translation])
            rows += [sighting.pixel[0] * matrix[2] - matrix[0], sighting.pixel[1] * matrix[2] - matrix[1]]
        solution = np.linalg.svd(np.array([row / np.linalg.norm(row) for row in rows]))[2][-1]
        start = solution[:3] / solution[3]
    point = start

    def residuals(at: Floats) -> tuple[Floats, Floats] | None:
        values, jacobian = [], []
        for camera, sighting in zip(cameras, sightings, strict=True):
            pixel, depth = camera.project(at)
            if depth <= 0:
                return None
            in_camera = camera.rotation @ at + camera.translation
            fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
            by_camera = np.array(
                [[fx / depth, 0, -fx * in_camera[0] / depth**2], [0, fy / depth, -fy * in_camera[1] / depth**2]]
            )
            values.append(pixel - sighting.pixel)
            jacobian.append(by_camera @ camera.rotation)
        return np.concatenate(values), np.concatenate(jacobian)

    current = residuals(point)
    if current is None:
        return None
    for _ in range(200):
        values, jacobian = current
        step = np.linalg.lstsq(jacobian, -values, rcond=None)[0]
        scale = 1.0
        while scale > 1e-6:
            candidate = residuals(point + scale * step)
            if candidate is not None and candidate[0] @ candidate[0] <= values @ values:
                break
            scale /= 2
        else:
            break
        point = point + scale * step
        current = candidate
        if np.linalg.norm(scale * step) < 1e-12:
            break
    return point


@dataclass(frozen=True)
class Label:
    point: Floats
    voters: tuple[int, ...]


def algorithm_1(cameras: list[Pinhole], sightings: list[Sighting], settings: Settings) -> list[Label]:
    """Labels of one cluster and one class, in the order of acceptance; voters are indices of sightings."""

    def viable(a: int, b: int) -> Floats | None:
        pair = [sightings[a], sightings[b]]
        views = [cameras[s.image] for s in pair]
        directions = [camera.direction(s.pixel) for camera, s in zip(views, pair, strict=True)]
        angle = math.atan2(
            float(np.linalg.norm(np.cross(directions[0], directions[1]))), float(directions[0] @ directions[1])
        )
        if angle <= settings.theta_min_rad:
            return None
        point = triangulate(views, pair)
        if point is None:
            return None
        ranges = [float(np.linalg.norm(point - camera.center)) for camera in views]
        if min(ranges) < settings.r_min_m or max(ranges) > settings.r_max_m:
            return None
        errors = [error_px(camera, s, point) for camera, s in zip(views, pair, strict=True)]
        return point if max(errors) < settings.d_max_px else None

    pairs = [(a, b) for a, b in itertools.combinations(range(len(sightings)), 2)]
    proposed = {
        (a, b): point
        for a, b in pairs
        if sightings[a].image != sightings[b].image and (point := viable(a, b)) is not None
    }
    labels: list[Label] = []
    left = set(range(len(sightings)))
    while True:
        support: dict[tuple[int, int], tuple[list[int], float]] = {}
        for (a, b), point in proposed.items():
            if a not in left or b not in left:
                continue
            voters, cost = [], 0.0
            for image in range(len(cameras)):
                errors = [
                    (error_px(cameras[image], sightings[k], point), k)
                    for k in sorted(left)
                    if sightings[k].image == image
                ]
                if errors and min(errors)[0] < settings.d_max_px:
                    voters.append(min(errors)[1])
                    cost += min(errors)[0] ** 2
            support[a, b] = (voters, cost)
        if not support:
            return labels
        best = min(support, key=lambda pair: (-len(support[pair][0]), support[pair][1], pair))
        votes = len(support[best][0])
        mean = sum(len(voters) for voters, _ in support.values()) / len(support)
        if votes < settings.min_votes or votes < settings.alpha * mean:
            return labels
        voters = support[best][0]
        point = triangulate(
            [cameras[sightings[k].image] for k in voters], [sightings[k] for k in voters], proposed[best]
        )
        assert point is not None
        labels.append(Label(point, tuple(sorted(voters))))
        left -= set(voters)
