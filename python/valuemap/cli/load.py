"""Which commands there are, and importing only the one that is asked for: all of them take twice as long."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

COMMANDS = (
    "demo",
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
)
"""Modules of this package, in the order of use; each adds its command to `app` when it is imported."""


def name_of(module: str) -> str:
    """Return the word that asks for the command of a module."""
    return module.strip("_").replace("_", "-")


def load_commands(words: Sequence[str] = ()) -> None:
    """Import the command that the first word names, none for the version, or all of them where it names none."""
    if words[:1] == ["--version"]:
        return
    asked = [module for module in COMMANDS if name_of(module) in words[:1]]
    for module in asked or COMMANDS:
        import_module(f"valuemap.cli.{module}")
