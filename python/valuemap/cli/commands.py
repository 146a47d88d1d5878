"""All commands, in the order in which they are used and shown: a new one is a file and a line here."""

from __future__ import annotations

from importlib import import_module

from valuemap.cli.app import app

COMMANDS = (
    "import_",
    "simulate",
    "info",
    "check",
    "detect",
    "map",
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

for _module in COMMANDS:
    import_module(f"valuemap.cli.{_module}")

__all__ = ["COMMANDS", "app"]
