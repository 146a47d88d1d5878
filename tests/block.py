"""One block of a simulated city: four crossings with twelve lights, for tests that need a whole map and soon."""

from __future__ import annotations

import dataclasses
from typing import Any

from valuemap.config import SimulationConfig
from valuemap.simulate import PRESETS

SHORT_STREETS: dict[str, Any] = {"block_east_m": 60.0, "block_north_m": 60.0}
"""As short as streets may be: all of a city with fewer images."""


def block(**changes: float) -> SimulationConfig:
    """Return the settings of the block: all its streets are driven twice in each direction."""
    settings: dict[str, float] = {
        "streets_north_south": 2,
        "streets_east_west": 2,
        "signalised_share": 1.0,
        "lights": 12,
        "passes_per_street": 2,
    }
    return dataclasses.replace(PRESETS["small"], **{**settings, **changes})  # type: ignore[arg-type]
