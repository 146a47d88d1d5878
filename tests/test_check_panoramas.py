"""Panoramas whose middle column has another heading than their poses: one mistake, and one finding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from camera_models import cameras_like, seen_through
from valuemap.check.boxes import PanoramaMiddle
from valuemap.check.examine import examine
from valuemap.check.fault import with_detections
from valuemap.dataset import Dataset
from valuemap.simulate import PRESETS, simulate


@pytest.fixture(scope="module")
def city() -> Dataset:
    return simulate(replace(PRESETS["small"], passes_per_street=2), seed=41, name="city-41")


@pytest.mark.parametrize(("share", "reading"), [(0.5, "half a turn"), (0.25, "to the left"), (-0.25, "to the right")])
def test_another_middle_column_is_named_alone_and_put_right(share: float, reading: str, city: Dataset) -> None:
    panoramas = seen_through(city, *cameras_like(city)["equirectangular"])
    assert not list(PanoramaMiddle().readings(city))
    center, width = panoramas.detections.center_px.copy(), panoramas.cameras.width_px[0]
    center[:, 0] = (center[:, 0] + share * width) % width
    outcome = examine(with_detections(panoramas, center_px=center))
    (finding,) = outcome.findings
    assert finding.fault == "panorama_middle"
    assert reading in finding.figures["reading"]
    np.testing.assert_allclose(outcome.fixed.detections.center_px, panoramas.detections.center_px, atol=1e-6)
