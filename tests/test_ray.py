"""Maps and detections on a Ray cluster of two nodes, where Ray is installed; and what is said where it is not."""

from __future__ import annotations

import importlib.util
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

import valuemap
from test_detect import noisy_pictures
from test_tiles import streets
from tiny_models import red_finder
from valuemap.cli.commands import app
from valuemap.engine.choose import engine_named
from valuemap.engine.ray import RayEngine, import_ray
from valuemap.errors import ClusterError, SettingError

IS_INSTALLED = importlib.util.find_spec("ray") is not None
LIMIT_S = 400.0


@pytest.mark.skipif(not IS_INSTALLED, reason="ray is not installed: pip install 'valuemap[ray]'")
def test_two_nodes_give_the_map_of_threads_whatever_is_killed(tmp_path: Path) -> None:
    # So many images that cells are still being solved when workers are killed.
    valuemap.write_dataset(streets(0.0, 445.0, 3000.0, images=60), tmp_path / "street")
    noisy_pictures(tmp_path / "pictures")
    red_finder(tmp_path / "finder.onnx")
    # As below `uv run` in another project: Ray looks at the command lines of all processes above.
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "other"\nversion = "0"\n', encoding="utf-8")
    python, script = shlex.quote(sys.executable), shlex.quote(str(Path(__file__).with_name("ray_cluster.py")))
    (tmp_path / "run").write_text(f"{python} {script} {shlex.quote(str(tmp_path))}\nexit $?\n", encoding="utf-8")
    done = subprocess.run(
        ["uv", "run"], executable="/bin/sh", cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    told = (tmp_path / "told.txt").read_text(encoding="utf-8").splitlines()
    assert told == ["identical", "detected", "failures told", "GPUs stay", "node killed", "workers killed"]


class RaySays:
    """As much of Ray as gives one answer, for what no cluster of a test does."""

    def __init__(self, error: Exception) -> None:
        self.error, self.exceptions = error, sys.modules["ray"].exceptions

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 1.0}

    def put(self, _value: object) -> object:
        return object()

    def remote(self, *_: object, **__: object) -> Any:
        return lambda _work: SimpleNamespace(remote=lambda *_: object())

    def wait(self, pending: list[object], num_returns: int) -> tuple[list[object], list[object]]:
        return pending[:num_returns], pending[num_returns:]

    def get(self, _reference: object) -> object:
        raise self.error


@pytest.mark.skipif(not IS_INSTALLED, reason="ray is not installed: pip install 'valuemap[ray]'")
def test_what_a_cluster_cannot_do_is_told_from_what_it_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    told = import_ray().exceptions
    lost, memory, never = "task 0 was lost 4 times: ", "task 0 needs more memory", "the cluster cannot run task 0: "
    for error, expected in (
        (told.WorkerCrashedError(), lost),
        (told.NodeDiedError("gone\nand more"), lost + "gone"),
        (told.OutOfMemoryError("none left"), memory),
        (told.RaySystemError("no worker starts\nand more"), never + "System error: no worker starts"),
        (told.RuntimeEnvSetupError("no uv"), never),
    ):
        monkeypatch.setitem(sys.modules, "ray", RaySays(error))
        with pytest.raises(ClusterError) as caught:
            list(RayEngine().run(lambda _task, _progress: None, [0]))
        assert str(caught.value).startswith(expected)
        assert "\n" not in str(caught.value)


@pytest.mark.skipif(not IS_INSTALLED, reason="ray is not installed: pip install 'valuemap[ray]'")
def test_a_gpu_has_its_share_of_the_cores_and_one_must_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    import_ray()
    machines: list[dict[str, float]] = [{"CPU": 64.0}, {"CPU": 9.0, "GPU": 2.0}, {"CPU": 5.0, "GPU": 1.0}]
    cluster = RaySays(RuntimeError())
    cluster.nodes = lambda: [{"Alive": True, "Resources": machine} for machine in machines]  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ray", cluster)
    assert RayEngine().threads_of_task(100, on_gpus=True) == 4
    del machines[1:]
    with pytest.raises(ClusterError, match="no machine of the cluster has a GPU") as caught:
        list(RayEngine().run(lambda _task, _progress: None, [0], on_gpus=True))
    assert "--provider cpu" in caught.value.hint


def test_engines_that_cannot_be_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingError, match="there is no such engine"):
        engine_named("spark")
    with pytest.raises(SettingError, match="has no address"):
        engine_named("threads", ray_address="10.0.0.1:6379")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ClusterError, match="Ray is not installed"):
        engine_named("ray")
    valuemap.write_dataset(streets(0.0), tmp_path / "street")
    result = CliRunner().invoke(app, ["map", str(tmp_path / "street"), "--out", str(tmp_path / "map"), "--engine=ray"])
    assert result.exit_code == 1
    assert "Ray is not installed" in result.output
    result = CliRunner().invoke(app, ["detect", str(tmp_path), "--model=bundled", "--engine=ray"])
    assert result.exit_code == 1
    assert "Ray is not installed" in result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["street"]
