"""Every default, once, with its unit and its effect: a file a command, and one for what a setting is.

One frozen dataclass a stage. The field names are the names that `--set`, `run.json` and the docs use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from valuemap.config.mapping import (
    USUAL_RANGE_M,
    ExistenceConfig,
    MapConfig,
    MergeConfig,
    NoiseConfig,
    PartitionConfig,
    PosesConfig,
    VoteConfig,
    describe_settings,
    list_settings,
)
from valuemap.config.setting import Method
from valuemap.config.threads import MAX_THREADS, bounded_threads

if TYPE_CHECKING:
    from valuemap.config.detection import MAX_CANVAS_PX, DetectConfig, ModelKind, Provider
    from valuemap.config.simulation import SimulationConfig
    from valuemap.config.training import TrainConfig

_MODULE_OF = {
    "MAX_CANVAS_PX": "detection",
    "DetectConfig": "detection",
    "ModelKind": "detection",
    "Provider": "detection",
    "SimulationConfig": "simulation",
    "TrainConfig": "training",
}
"""What maps do not need: making a class of settings takes 10 ms."""

__all__ = [
    "MAX_CANVAS_PX",
    "MAX_THREADS",
    "USUAL_RANGE_M",
    "DetectConfig",
    "ExistenceConfig",
    "MapConfig",
    "MergeConfig",
    "Method",
    "ModelKind",
    "NoiseConfig",
    "PartitionConfig",
    "PosesConfig",
    "Provider",
    "SimulationConfig",
    "TrainConfig",
    "VoteConfig",
    "bounded_threads",
    "describe_settings",
    "list_settings",
]


def __getattr__(name: str) -> Any:
    """Import what maps do not need when it is first used."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
