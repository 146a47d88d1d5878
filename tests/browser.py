"""Scripts of viewer/e2e in Debian's Chromium, for tests; they skip, and say so, where there is no browser."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

VIEWER = Path(__file__).parent.parent / "viewer"
CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")


def in_browser(script: str, *arguments: object) -> dict[str, Any]:
    """Return what a script saw."""
    require_browser()
    done = subprocess.run(
        ["node", f"e2e/{script}", *map(str, arguments)],
        cwd=VIEWER,
        capture_output=True,
        text=True,
        timeout=560,
        check=False,
        env={**os.environ, "CHROMIUM": CHROMIUM},
    )
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout)
    return seen


def require_browser() -> None:
    """Skip the test where it cannot run, or fail it where BROWSER_TESTS says that it must."""
    missing = [
        what
        for what, is_there in (
            ("node", shutil.which("node") is not None),
            (CHROMIUM, Path(CHROMIUM).is_file()),
            ("viewer/node_modules (npm ci in viewer/)", (VIEWER / "node_modules" / "playwright-core").is_dir()),
        )
        if not is_there
    ]
    if not missing:
        return
    why = f"this is not tested in a browser: there is no {', no '.join(missing)}"
    if os.environ.get("BROWSER_TESTS") == "required":
        pytest.fail(why)
    pytest.skip(why)
