"""What the tests of readers share: small files, rays of boxes, and the one line that bad input must end with."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from valuemap.arrays import Floats
from valuemap.cameras import cast_rays
from valuemap.dataset import Dataset
from valuemap.errors import ValuemapError


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def refusal(read: Callable[[], Any]) -> str:
    """The message and hint of the error that reading must end with, each of one line."""
    with pytest.raises(ValuemapError) as caught:
        read()
    assert "\n" not in str(caught.value)
    assert "\n" not in caught.value.hint
    assert caught.value.hint
    return f"{caught.value} | {caught.value.hint}"


def azimuths_deg(dataset: Dataset) -> Floats:
    """Directions of the detections' rays, degrees clockwise from the axis y of the world."""
    east, north, _ = cast_rays(dataset).direction_in_world.T
    azimuth: Floats = np.degrees(np.arctan2(east, north)) % 360.0
    return azimuth


def meeting_point(dataset: Dataset, *, within_m: float = 1e-6) -> Floats:
    """The point nearest to all rays of a dataset, by the normal equations, which all must pass it."""
    rays = cast_rays(dataset)
    across = np.eye(3) - rays.direction_in_world[:, :, None] * rays.direction_in_world[:, None, :]
    point: Floats = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, rays.center_in_world_m))
    away = np.linalg.norm(np.einsum("nij,nj->ni", across, point - rays.center_in_world_m), axis=1)
    assert away.max() < within_m
    return point


def spoiled(path: Path, how: str, *, outside: Path | None = None) -> Path:
    """Put something else in the place of a file: what every reader must refuse in one line."""
    whole = path.read_bytes()
    path.unlink()
    if how == "empty":
        path.write_bytes(b"")
    elif how == "cut":
        path.write_bytes(whole[: len(whole) * 2 // 3].rstrip()[:-1])
    elif how == "binary":
        path.write_bytes(bytes(range(256)) * 8)
    elif how == "utf-16":
        path.write_bytes("lat,lon\n1,2\n".encode("utf-16"))
    elif how == "other":
        path.write_text("<html><body>404 Not Found</body></html>\n")
    elif how == "pipe":
        os.mkfifo(path)
    elif how == "folder":
        path.mkdir()
    elif how == "link":
        target = (outside or path.parent.parent) / f"outside-{path.name}"
        target.write_bytes(whole)
        path.symlink_to(target)
    else:
        assert how == "absent"
    return path


SPOILS = ("empty", "binary", "utf-16", "other", "pipe", "folder", "absent")
