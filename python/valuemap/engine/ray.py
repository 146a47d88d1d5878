"""Tasks on a Ray cluster. Nothing else imports Ray."""

from __future__ import annotations

import importlib
import os
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

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
_GO_ON = "what was done is kept: run the same again (map and update with --resume)"
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
        self._lost = (
            told.WorkerCrashedError,
            told.ActorDiedError,
            told.ActorUnavailableError,
            told.NodeDiedError,
            told.LocalRayletDiedError,
            told.ObjectLostError,
        )
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

    def threads_of_task(self, tasks: int, *, on_gpus: bool = False) -> int:
        """Return how many threads each of so many tasks may work on."""
        if on_gpus:
            return max(TASK_CPUS, self._gpus()[1])
        return TASK_CPUS if tasks > 1 else 0  # What is done alone is done here.

    def run(self, work: Work[T, R], tasks: Iterable[T], *, on_gpus: bool = False) -> Iterator[tuple[int, R]]:
        """Yield the number of a task and what the work makes of it, as they get done."""
        return self._run_on_gpus(work, list(tasks)) if on_gpus else self._run_on_cores(work, tasks)

    def _run_on_cores(self, work: Work[T, R], tasks: Iterable[T]) -> Iterator[tuple[int, R]]:
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

    def _run_on_gpus(self, work: Work[T, R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Run tasks on actors with a GPU each: Ray ends the process of a plain task with a GPU, and what it has loaded.

        Where an actor is lost, others do its task. A new one is begun, and has no task before it has a GPU.
        """
        ray = self._ray
        gpus, cores = self._gpus()
        kind = ray.remote(num_gpus=1, num_cpus=cores, runtime_env={"env_vars": _ONE_THREAD})(_Actor)
        work_in_store = ray.put(work)
        todo, left, lost = deque(range(len(tasks))), len(tasks), Counter[int]()
        idle: list[Any] = []
        pending: dict[Any, tuple[Any, int | None]] = {}

        def start() -> None:
            actor = kind.remote(work_in_store)
            pending[actor.is_ready.remote()] = (actor, None)

        try:
            for _ in range(min(gpus, left)):
                start()
            while left:
                while idle and todo:
                    actor, number = idle.pop(), todo.popleft()
                    pending[actor.done.remote(tasks[number])] = (actor, number)
                done, _ = ray.wait(list(pending), num_returns=1)
                actor, of_task = pending.pop(done[0])
                number = -1 if of_task is None else of_task
                try:
                    result = ray.get(done[0])
                except ray.exceptions.RayTaskError:
                    raise  # A bug, as below.
                except ray.exceptions.RayError as error:
                    lost[number] += 1
                    if lost[number] > self._retries(error):
                        raise self._told(error, max(number, 0)) from error
                    if of_task is not None:
                        todo.appendleft(of_task)
                    start()
                    continue
                idle.append(actor)
                if of_task is None:
                    lost[number] = 0  # Of all that begin, those that fail one after the other are counted.
                else:
                    left -= 1
                    yield of_task, _unwrapped(result)
        finally:
            for actor in (*idle, *(actor for actor, _ in pending.values())):
                ray.kill(actor)

    def _gpus(self) -> tuple[int, int]:
        """Return how many GPUs the cluster has, and how many cores there are for each where these are fewest."""
        resources = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        with_gpus = [(int(each["GPU"]), int(each.get("CPU", 0))) for each in resources if each.get("GPU", 0) >= 1]
        if not with_gpus:
            raise ClusterError(
                "no machine of the cluster has a GPU",
                hint="use --provider cpu; or say what Ray does not find: ray start --num-gpus",
            )
        return sum(gpus for gpus, _ in with_gpus), min(cores // gpus for gpus, cores in with_gpus)

    def _result(self, reference: Any, number: int) -> Any:
        try:
            return _unwrapped(self._ray.get(reference))
        except self._ray.exceptions.RayTaskError:
            raise  # A bug, with its traceback on the machine where it happened.
        except self._ray.exceptions.RayError as error:
            raise self._told(error, number) from error

    def _retries(self, error: Exception) -> int:
        """Return how often a task is done again after an error of Ray."""
        if isinstance(error, self._ray.exceptions.OutOfMemoryError):
            return MEMORY_RETRIES
        return RETRIES if isinstance(error, self._lost) else 0

    def _told(self, error: Exception, number: int) -> ClusterError:
        """Return what a user is told of an error of Ray."""
        reason = str(error).splitlines()[0]
        if isinstance(error, self._ray.exceptions.OutOfMemoryError):
            return ClusterError(
                f"task {number} needs more memory than a machine of the cluster has left, {MEMORY_RETRIES + 1} times",
                hint="give machines more memory, or start them with fewer cores: ray start --num-cpus",
            )
        if isinstance(error, self._lost):
            return ClusterError(
                f"task {number} was lost {RETRIES + 1} times: {reason}", hint=f"{_GO_ON} when the cluster is well"
            )
        return ClusterError(
            f"the cluster cannot run task {number}: {reason}",
            hint=f"have all machines the same Python, valuemap and Ray? {_GO_ON}",
        )


class _Actor(Generic[T, R]):
    """A process with a GPU."""

    def __init__(self, work: Work[T, R]) -> None:
        self._work = work

    def is_ready(self) -> bool:
        return True

    def done(self, task: T) -> R | _Failed:
        return _done(self._work, task)


@dataclass(frozen=True)
class _Failed:
    """An error of a user, which Ray would wrap beyond recognition."""

    kind: type[ValuemapError]
    message: str
    hint: str


def _unwrapped(result: R | _Failed) -> R:
    if isinstance(result, _Failed):
        raise result.kind(result.message, hint=result.hint)
    return result


def _done(work: Work[T, R], task: T) -> R | _Failed:
    try:
        return work(task, silent)
    except ValuemapError as error:
        return _Failed(type(error), str(error), error.hint)
