"""What each stage of a run took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from valuemap.system import peak_memory_mb


class Stages:
    """Seconds and peak memory of each stage, in the order they ran."""

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []

    @contextmanager
    def measured(self, stage: str) -> Iterator[None]:
        """Record what is done meanwhile as a stage."""
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        self.records.append({"stage": stage, "seconds": round(seconds, 3), "peak_memory_mb": peak_memory_mb()})
