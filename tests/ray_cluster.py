"""Two Ray nodes on the loopback of this machine, with token authentication: what is made on them is that of threads.

Run by `test_ray.py` in a process of its own, as Ray leaves threads and warnings behind: python ray_cluster.py FOLDER.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from still_poses import nothing_found
from valuemap import correction
from valuemap.cameras import rotation_matrices
from valuemap.config import DetectConfig, MapConfig
from valuemap.dataset import Dataset
from valuemap.detect import BUNDLED_MODEL, shards
from valuemap.detect.run import RECORD, detect_dataset
from valuemap.engine import ray as ray_engine
from valuemap.engine.engine import Engine, Work
from valuemap.engine.ray import RayEngine, import_ray
from valuemap.engine.threads import ThreadEngine
from valuemap.errors import ClusterError, InputError, SettingError, ValuemapError
from valuemap.map_folder import write_map
from valuemap.pipeline import Run, build_map_of_folder
from valuemap.progress import Progress
from valuemap.refine import Refined
from valuemap.tiles.compare import Comparison
from valuemap.tiles.work import open_work

# Nodes of a busy machine take longer to begin than Ray waits. One that is gone is asked for its health five times.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "a" * 64}
os.environ |= {"RAY_raylet_start_wait_time_s": "120", "RAY_health_check_period_ms": "500"}
# Workers that are begun before there is a task for them have not its environment, and are never used.
os.environ |= {"RAY_prestart_worker_first_driver": "0", "RAY_enable_worker_prestart": "0"}
ray = import_ray()

HEAD = {"num_cpus": 1, "node_ip_address": "127.0.0.2", "include_dashboard": False}
T = TypeVar("T")
R = TypeVar("R")
KNOWN = MapConfig(detection_sigma_px=1.5, position_sigma_m=0.05, rotation_sigma_deg=0.05, correct_poses=0)


def mapped(folder: Path, engine: Engine, name: str, progress: Progress) -> dict[str, bytes]:
    with open_work(folder / f"{name}.work", resume=False) as work:
        result, cells = build_map_of_folder(folder / "street", KNOWN, Run(work, engine), progress=progress)
        write_map(result, folder / name, cells=cells)
    names = ["labels.parquet", "votes.parquet", "calibration.json"]
    names += sorted(f"cells/{path.name}" for path in cells)
    return {each: (folder / name / each).read_bytes() for each in names}


def moved_by_a_metre(dataset: Dataset, *_: object, **__: object) -> Refined:
    by_m = -rotation_matrices(dataset.images) @ np.array([0.0, 1.0, 0.0])
    images = dataset.images.replace(cam_from_world_m=dataset.images.cam_from_world_m + by_m)
    return Refined(replace(dataset, images=images), {"found": "faults"}, is_corrected=True)


def dies_then_fails(task: tuple[str, int], progress: Progress) -> int:
    """Return the number of the process, which the third task ends the first time; the fifth cannot be."""
    path, number = task
    if number == 2:
        dies(path, progress)
    if number == 4:
        raise InputError("the fifth cannot be", hint="leave it away")
    return os.getpid()


def fails(number: int, _progress: Progress) -> int:
    if number == 3:
        raise InputError("the fourth cannot be", hint="leave it away")
    return number


def dies(path: str, _progress: Progress) -> int:
    """End the worker with SIGKILL the first time."""
    mark = Path(path)
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 1


def always_dies(path: str, _progress: Progress) -> int:
    """Leave a mark, then end the worker with SIGKILL."""
    with Path(path).open("a", encoding="utf-8") as file:
        file.write("+")
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def error_of(run: Callable[[], object]) -> ValuemapError:
    try:
        run()
    except ValuemapError as error:
        return error
    raise AssertionError("nothing went wrong")


def is_lost(marks: Path, engine: Engine, *, on_gpus: bool) -> None:
    """Run a task that ends its worker whenever it is tried, with one retry: each needs a worker of its own."""
    retries = ray_engine.RETRIES
    setattr(ray_engine, "RETRIES", 1)  # noqa: B010
    error = error_of(lambda: list(engine.run(always_dies, [str(marks)], on_gpus=on_gpus)))
    setattr(ray_engine, "RETRIES", retries)  # noqa: B010
    assert isinstance(error, ClusterError), error
    assert str(error).startswith("task 0 was lost 2 times"), error
    assert marks.read_text(encoding="utf-8") == "++"


class InOrder(RayEngine):
    """Tasks are told of in their order: whichever gets done first, an interrupted run has the first, not all."""

    def run(self, work: Work[T, R], tasks: Iterable[T], *, on_gpus: bool = False) -> Iterator[tuple[int, R]]:
        ahead, number = dict[int, R](), 0
        for done, result in super().run(work, tasks, on_gpus=on_gpus):
            ahead[done] = result
            while number in ahead:
                yield number, ahead.pop(number)
                number += 1


def detect_as_threads(folder: Path, engine: Engine) -> None:
    """Look at the pictures of `pictures` on the cluster, interrupted once: the bytes are those of one process."""
    os.chdir(folder)  # Paths go to other folders as they are meant here.
    model, config = Path("finder.onnx"), DetectConfig(batch=3)
    whole = shutil.copytree("pictures", "detected")
    detect_dataset(whole, model, config)

    def stop(_what: str, done: int, _total: int) -> None:
        if done > 0:
            raise KeyboardInterrupt

    setattr(shards, "SHARD_PICTURES", 4)  # noqa: B010
    with suppress(KeyboardInterrupt):
        detect_dataset("pictures", model, config, engine=InOrder(), progress=stop)
    told = list[int]()
    detect_dataset("pictures", model, config, engine=engine, progress=lambda _what, done, _total: told.append(done))
    assert told[0] == 3, told  # Three pictures a shard: whole groups.
    assert len(told) == 1 + -(-(20 - told[0]) // 3), told
    assert (told, told[-1]) == (sorted(told), 20), told
    assert Path("pictures/detections.parquet").read_bytes() == Path("detected/detections.parquet").read_bytes()
    record, expected = (json.loads(Path(name, RECORD).read_text(encoding="utf-8")) for name in ("pictures", "detected"))
    assert record["pictures_of_an_interrupted_run"] == told[0]
    assert [record[key] for key in ("counts", "unusable", "settings")] == [
        expected[key] for key in ("counts", "unusable", "settings")
    ]
    detect_dataset("pictures", BUNDLED_MODEL, engine=engine)
    # The GPU of the second node is none: what is told is what happens there, not here.
    error = error_of(lambda: detect_dataset("pictures", model, DetectConfig(provider="cuda"), engine=engine))
    assert isinstance(error, SettingError), error
    assert "--provider cuda" in str(error), error


def gpus_stay(folder: Path, engine: Engine) -> None:
    """Run tasks on the one GPU of the cluster: in one process, in others where that is lost, and not for ever."""
    process = dict[int, int]()
    tasks = [(str(folder / "gpu"), number) for number in range(5)]
    error = error_of(lambda: process.update(engine.run(dies_then_fails, tasks, on_gpus=True)))
    assert str(error) == "the fifth cannot be"
    assert process[0] == process[1] != process[2] == process[3]
    is_lost(folder / "lost-gpu", engine, on_gpus=True)


def tell(folder: Path, what: str) -> None:
    """Add a line to `told.txt`: Ray writes to the standard output whenever it likes, within our lines too."""
    with (folder / "told.txt").open("a", encoding="utf-8") as file:
        file.write(what + "\n")


def main(folder: Path) -> None:
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args=HEAD)
    second = cluster.add_node(num_cpus=1, num_gpus=1, node_ip_address="127.0.0.3")
    cluster.wait_for_nodes()
    engine = RayEngine(cluster.address)
    assert sum(node["Alive"] for node in ray.nodes()) == 2

    expected = mapped(folder, ThreadEngine(2), "threads", lambda *_: None)
    assert mapped(folder, engine, "ray", lambda *_: None) == expected
    # Poses that were corrected go to the tasks by the dataset that is written with them.
    setattr(correction, "refine_poses", moved_by_a_metre)  # noqa: B010
    setattr(correction, "compare_poses", lambda *_, **__: Comparison(2.0, 1.0, 0.0, 10))  # noqa: B010
    corrected = mapped(folder, ThreadEngine(2), "threads-moved", lambda *_: None)
    assert corrected["labels.parquet"] != expected["labels.parquet"]
    assert mapped(folder, engine, "ray-moved", lambda *_: None) == corrected
    setattr(correction, "refine_poses", nothing_found)  # noqa: B010
    tell(folder, "identical")

    # What ends workers comes last: others take seconds to begin.
    detect_as_threads(folder, engine)
    tell(folder, "detected")
    assert str(error_of(lambda: list(engine.run(fails, range(6))))) == "the fourth cannot be"
    tell(folder, "failures told")
    gpus_stay(folder, engine)
    tell(folder, "GPUs stay")

    killed: list[Any] = []

    def kill_a_node(what: str, done: int, _total: int) -> None:
        if what == "cells" and done == 1 and not killed:
            killed.append(second)
            cluster.remove_node(second, allow_graceful=False)

    assert mapped(folder, engine, "node-killed", kill_a_node) == expected
    assert killed
    tell(folder, "node killed")
    assert list(engine.run(dies, [str(folder / "dead")])) == [(0, 1)]
    is_lost(folder / "lost", engine, on_gpus=False)
    tell(folder, "workers killed")
    ray.shutdown()
    cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
