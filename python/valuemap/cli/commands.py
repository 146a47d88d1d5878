"""The application with all its commands: a new one is a file and a line in `load.py`."""

from __future__ import annotations

from valuemap.cli.app import app
from valuemap.cli.load import load_commands

COMMANDS = (
    "import_",
    "simulate",
    "info",
    "check",
    "detect",
    "map",
    "update",
    "evaluate",
    "show_",
    "report",
    "view",
    "export",
    "settings",
    "experiment",
    "train",
    "evaluate_detections",
    "demo",
)
"""Modules of this package; each adds its command to `app` when it is imported."""
load_commands()

__all__ = ["app"]
