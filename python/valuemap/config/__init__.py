"""Every default, once, with its unit and its effect: a file a command, and one for what a setting is.

One frozen dataclass a stage. The field names are the names that `--set`, `run.json` and the docs use.
"""

from __future__ import annotations

from valuemap.config.detection import MAX_CANVAS_PX, DetectConfig, ModelKind, Provider
from valuemap.config.mapping import (
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
from valuemap.config.simulation import SimulationConfig
from valuemap.config.threads import MAX_THREADS, bounded_threads
from valuemap.config.training import TrainConfig

__all__ = [
    "MAX_CANVAS_PX",
    "MAX_THREADS",
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
