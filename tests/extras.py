"""Tests that need an extra: skipped where it is not installed, but not where somebody says that it has to be."""

from __future__ import annotations

import importlib.util
import os

import pytest


def require_extra(name: str, *modules: str) -> None:
    """Skip the tests of the calling module, or fail if the variable EXTRAS names the extra."""
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if not missing:
        return
    why = f"{', '.join(missing)} is not installed: make test EXTRAS={name}"
    if name in os.environ.get("EXTRAS", "").split():
        pytest.fail(why)
    pytest.skip(why, allow_module_level=True)
