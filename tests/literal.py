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

    rotation = np.array([camera.rotation for camera in cameras])
    translation = np.array([camera.translation for camera in cameras])
    focal = np.array([camera.intrinsics[[0, 1], [0, 1]] for camera in cameras])
    principal = np.array([camera.intrinsics[[0, 1], [2, 2]] for camera in cameras])
    pixel = np.array([sighting.pixel for sighting in sightings])

    def residuals(at: Floats) -> tuple[Floats, Floats] | None:
        in_camera = rotation @ at + translation
        depth = in_camera[:, 2:]
        if (depth <= 0).any():
            return None
        values = focal * in_camera[:, :2] / depth + principal - pixel
        by_camera = np.zeros((len(values), 2, 3))
        by_camera[:, [0, 1], [0, 1]] = focal / depth
        by_camera[:, :, 2] = -focal * in_camera[:, :2] / depth**2
        return values.ravel(), (by_camera @ rotation).reshape(-1, 3)

    current = residuals(point)
    if current is None:
        return None
    for _ in range(50):
        values, jacobian = current
        step = np.linalg.lstsq(jacobian, -values, rcond=None)[0]
        scale = 1.0
        while scale > 1e-6:
            candidate = residuals(point + scale * step)
            if candidate is not None and candidate[0] @ candidate[0] < (1.0 - 1e-14) * (values @ values):
                break
            scale /= 2
        else:
            break
        point = point + scale * step
        current = candidate
        if np.linalg.norm(scale * step) < 1e-9:
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
    errors_px = {pair: [error_px(cameras[s.image], s, point) for s in sightings] for pair, point in proposed.items()}
    labels: list[Label] = []
    left = set(range(len(sightings)))
    while True:
        support: dict[tuple[int, int], tuple[list[int], float]] = {}
        shown = [[k for k in sorted(left) if sightings[k].image == image] for image in range(len(cameras))]
        for (a, b), of_sighting in errors_px.items():
            if a not in left or b not in left:
                continue
            voters, cost = [], 0.0
            for in_image in shown:
                errors = [(of_sighting[k], k) for k in in_image]
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
