"""The application with all its commands: a new one is a file and a line in `load.py`."""

from __future__ import annotations

from valuemap.cli.app import app
from valuemap.cli.load import load_commands

load_commands()

__all__ = ["app"]
