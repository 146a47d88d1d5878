"""Tasks on a Ray cluster. Nothing else imports Ray."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from valuemap.engine.engine import Work
from valuemap.errors import ClusterError, ValuemapError
from valuemap.progress import silent

T = TypeVar("T")
R = TypeVar("R")

TASK_CPUS = 1
"""Cores of a task; the core and BLAS use no more."""
RETRIES = 3
"""How often a task is done again whose worker or machine was lost."""
MEMORY_RETRIES = 1
"""How often a task is done again that Ray ended for want of memory: without a bound Ray would do so for ever."""
PENDING_PER_CORE = 2
"""Tasks that wait or run, for each core of the cluster: no more, however many there are."""
_ONE_THREAD = {"RAYON_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def import_ray() -> Any:
    """Return Ray, which reads these variables when it is imported; who has set them keeps what was set.

    Under `uv run` Ray would send the working folder to all machines and make an environment from it on each, which
    may hold pictures, and to which no path on the command line is relative. Here machines have their own.

    Raises
    ------
    ClusterError
        It is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    os.environ.setdefault("RAY_task_oom_retries", str(MEMORY_RETRIES))
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise ClusterError("Ray is not installed", hint="install it with: pip install 'valuemap[ray]'") from error


class RayEngine:
    """Tasks on the cluster at an address, or on one that is started here and ends with the process.

    Raises
    ------
    ClusterError
        Ray is not installed, or there is no cluster at the address.
    """

    needs_paths = True

    def __init__(self, address: str | None = None) -> None:
        self._ray = import_ray()
        told = self._ray.exceptions
        self._lost = (told.WorkerCrashedError, told.NodeDiedError, told.LocalRayletDiedError, told.ObjectLostError)
        if self._ray.is_initialized():
            return
        own = {"include_dashboard": False} if address is None else {}
        try:
            self._ray.init(address=address or "local", log_to_driver=False, logging_level="ERROR", **own)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ClusterError(
                f"no Ray cluster at {address or 'this machine'}: {str(error).splitlines()[0]}",
                hint="start one with: ray start --head; docs/cluster.md says how",
            ) from error

    def threads_of_task(self, tasks: int) -> int:
        """Return how many threads each of so many tasks may work on."""
        return TASK_CPUS if tasks > 1 else 0  # What is done alone is done here.

    def run(self, work: Work[T, R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield the number of a task and what the work makes of it, as they get done."""
        ray = self._ray
        remote = ray.remote(num_cpus=TASK_CPUS, max_retries=RETRIES, runtime_env={"env_vars": _ONE_THREAD})(_done)
        work_in_store = ray.put(work)
        most = max(1, int(PENDING_PER_CORE * ray.cluster_resources().get("CPU", 1)))
        todo = iter(enumerate(tasks))
        pending: dict[Any, int] = {}
        try:
            while True:
                while len(pending) < most and (task := next(todo, None)) is not None:
                    pending[remote.remote(work_in_store, task[1])] = task[0]
                if not pending:
                    return
                done, _ = ray.wait(list(pending), num_returns=1)
                number = pending.pop(done[0])
                yield number, self._result(done[0], number)
        finally:
            for reference in pending:
                ray.cancel(reference)

    def _result(self, reference: Any, number: int) -> Any:
        ray = self._ray
        try:
            result = ray.get(reference)
        except ray.exceptions.RayTaskError:
            raise  # A bug, with its traceback on the machine where it happened.
        except ray.exceptions.OutOfMemoryError as error:
            raise ClusterError(
                f"task {number} needs more memory than a machine of the cluster has left, {MEMORY_RETRIES + 1} times",
                hint="give machines more memory, or start them with fewer cores: ray start --num-cpus",
            ) from error
        except self._lost as error:
            raise ClusterError(
                f"task {number} was lost {RETRIES + 1} times: {str(error).splitlines()[0]}",
                hint="what was done is kept: go on with --resume when the cluster is well",
            ) from error
        except ray.exceptions.RayError as error:
            raise ClusterError(
                f"the cluster cannot run task {number}: {str(error).splitlines()[0]}",
                hint="have all machines the same Python, valuemap and Ray? What was done is kept: go on with --resume",
            ) from error
        if isinstance(result, _Failed):
            raise result.kind(result.message, hint=result.hint)
        return result


@dataclass(frozen=True)
class _Failed:
    """An error of a user, which Ray would wrap beyond recognition."""

    kind: type[ValuemapError]
    message: str
    hint: str


def _done(work: Work[T, R], task: T) -> R | _Failed:
    try:
        return work(task, silent)
    except ValuemapError as error:
        return _Failed(type(error), str(error), error.hint)
