"""valuemap: many posed street images in, a trustworthy 3D map of static objects out.

The verbs are `read_dataset`, `build_map` and `evaluate_map`; `write_dataset`, `write_map`, `read_map` and `export_map`
are for what lies on disk.
"""

from valuemap.config import MapConfig
from valuemap.dataset import Dataset, Frame, read_dataset, write_dataset
from valuemap.errors import ValuemapError
from valuemap.evaluate import Evaluation, evaluate_map
from valuemap.map_folder import Map, read_map, write_map
from valuemap.pipeline import build_map
from valuemap.writers import export_map

__all__ = [
    "Dataset",
    "Evaluation",
    "Frame",
    "Map",
    "MapConfig",
    "ValuemapError",
    "build_map",
    "evaluate_map",
    "export_map",
    "read_dataset",
    "read_map",
    "write_dataset",
    "write_map",
]
