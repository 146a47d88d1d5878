"""valuemap: many posed street images in, a trustworthy 3D map of static objects out.

The verbs are `read_dataset`, `build_map` and `evaluate_map`; `write_dataset`, `write_map`, `read_map` and `export_map`
are for what lies on disk; `plot_map`, `draw_map` and `write_report` are for looking at it.
"""

from __future__ import annotations

TYPE_CHECKING = False  # That of `typing`, which takes longer than all that comes before `valuemap.cli` hears Ctrl-C.
if TYPE_CHECKING:
    from typing import Any

    from valuemap.config import MapConfig
    from valuemap.dataset import Dataset, Frame, read_dataset, write_dataset
    from valuemap.errors import ValuemapError
    from valuemap.evaluate import Evaluation, evaluate_map
    from valuemap.map_folder import Map, read_map, write_map
    from valuemap.pipeline import build_map
    from valuemap.report.above import draw_map, plot_map
    from valuemap.report.write import write_report
    from valuemap.writers import export_map

__version__: str

_MODULE_OF = {
    "Dataset": "dataset",
    "Evaluation": "evaluate",
    "Frame": "dataset",
    "Map": "map_folder",
    "MapConfig": "config",
    "ValuemapError": "errors",
    "build_map": "pipeline",
    "draw_map": "report.above",
    "evaluate_map": "evaluate",
    "export_map": "writers",
    "plot_map": "report.above",
    "read_dataset": "dataset",
    "read_map": "map_folder",
    "write_dataset": "dataset",
    "write_map": "map_folder",
    "write_report": "report.write",
}

__all__ = [
    "Dataset",
    "Evaluation",
    "Frame",
    "Map",
    "MapConfig",
    "ValuemapError",
    "__version__",
    "build_map",
    "draw_map",
    "evaluate_map",
    "export_map",
    "plot_map",
    "read_dataset",
    "read_map",
    "write_dataset",
    "write_map",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Import a name when it is first used: `valuemap.cli` must be there before the half second that all take."""
    if name == "__version__":
        from importlib.metadata import version

        return version("valuemap")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'valuemap' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(f"valuemap.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
