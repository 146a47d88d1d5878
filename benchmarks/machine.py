"""On what a benchmark ran: written beside every figure."""

from __future__ import annotations

import json
import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from valuemap.folders import new_file


def write_record(path: Path | None, results: Any, **more: Any) -> None:
    """Write the figures of a benchmark on simulated data with its command, machine and versions, if a file is named."""
    if path is not None:
        record = {"command": command_as_typed(), "data": "simulated", **describe_machine(), **more, "results": results}
        keep_record(path, record)


def command_as_typed() -> str:
    """Return the command that runs, with `PATH` for places of this machine."""
    arguments = ("PATH" if Path(argument).is_absolute() else argument for argument in sys.argv[1:])
    return " ".join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *arguments])


def keep_record(path: Path | None, record: dict[str, Any]) -> None:
    """Write a record whole or not at all, if a file is named."""
    if path is not None:
        with new_file(path, force=True, keep_record=False) as temporary:
            temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, system and versions."""
    return {
        "machine": {"platform": platform.platform(), "cpu": _cpu_model(), "cores": os.cpu_count()},
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("valuemap", "numpy", "scipy", "pyarrow", "pycolmap")},
            "onnxruntime": _version_of_onnxruntime(),
        },
    }


def _version_of_onnxruntime() -> str:
    """Return its version; that for GPUs has another name."""
    try:
        return version("onnxruntime")
    except PackageNotFoundError:
        return version("onnxruntime-gpu")


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()
