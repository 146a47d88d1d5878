"""Pictures in shards, each a task of an engine whose processes see model and pictures under the same paths."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2

from valuemap.config import DetectConfig
from valuemap.detect import BUNDLED_MODEL
from valuemap.detect.infer import Detector, Task
from valuemap.detect.journal import Outcome
from valuemap.detect.pictures import NO_SUCH_FILE
from valuemap.engine.engine import Engine
from valuemap.errors import InputError
from valuemap.progress import Progress

SHARD_PICTURES = 64
"""Pictures of a task: seconds of work, next to which handing it out is nothing, and soon done again if it is lost."""
_HINT = "all machines need the same files under the same paths: docs/cluster.md"


@dataclass(frozen=True)
class ShardWork:
    """What is done with a shard; `model` is None for the bundled one, which each machine has where valuemap is."""

    model: Path | None
    sha256: str
    config: DetectConfig
    threads: int

    def __call__(self, shard: Sequence[Task], progress: Progress) -> list[Outcome]:
        """Return what became of each picture."""
        found: list[Outcome] = []
        for group in _detector(self).run(shard):
            found += group
            progress("pictures", len(found), len(shard))
        return found


@lru_cache(maxsize=1)
def _detector(work: ShardWork) -> Detector:
    """Return the detector, loaded once in a process."""
    path = work.model or BUNDLED_MODEL
    if not path.is_file():
        raise InputError(f"{path}: no such file on {platform.node()}", hint=_HINT)
    cv2.setNumThreads(work.threads)
    detector = Detector(path, work.config, threads=work.threads)
    if detector.model.sha256 != work.sha256:
        raise InputError(f"{path}: is another file on {platform.node()}", hint=_HINT)
    return detector


def detect_in_shards(
    detector: Detector, config: DetectConfig, tasks: Sequence[Task], engine: Engine
) -> Iterator[tuple[int, list[Outcome]]]:
    """Yield the number of a shard and what became of its pictures, as shards get done; shard follows upon shard.

    The detector says which model; a shard is of whole groups, so that outcomes are those of one process.

    Raises
    ------
    InputError
        Not all machines have the model or the pictures.
    ClusterError
        As the engine.
    """
    size = max(SHARD_PICTURES // config.batch, 1) * config.batch
    tasks = [replace(task, path=task.path.absolute()) for task in tasks]
    shards = [tasks[first : first + size] for first in range(0, len(tasks), size)]
    model, on_gpus = detector.model, config.provider == "cuda"
    work = ShardWork(
        model=None if model.path == BUNDLED_MODEL else model.path.absolute(),
        sha256=model.sha256,
        config=config,
        threads=engine.threads_of_task(max(len(shards), 2), on_gpus=on_gpus),  # One alone is done elsewhere too.
    )
    for number, found in engine.run(work, shards, on_gpus=on_gpus):
        for task, outcome in zip(shards[number], found, strict=True):
            if outcome.problem == NO_SUCH_FILE and task.path.is_file():
                raise InputError(f"{task.path}: is not there on all machines of the cluster", hint=_HINT)
        yield number, found
