"""Maps on a Ray cluster of two nodes, where Ray is installed; and what is said where it is not."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import valuemap
from test_tiles import streets
from valuemap.cli.commands import app
from valuemap.engine.choose import engine_named
from valuemap.errors import ClusterError, SettingError

IS_INSTALLED = importlib.util.find_spec("ray") is not None
LIMIT_S = 400.0


@pytest.mark.skipif(not IS_INSTALLED, reason="ray is not installed: pip install 'valuemap[ray]'")
def test_two_nodes_give_the_map_of_threads_whatever_is_killed(tmp_path: Path) -> None:
    valuemap.write_dataset(streets(0.0, 445.0, 3000.0), tmp_path / "street")
    script = Path(__file__).with_name("ray_cluster.py")
    done = subprocess.run([sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 0, done.stdout + done.stderr
    for told in ("identical", "workers killed", "failures told", "node killed"):
        assert told in done.stdout.splitlines()


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
    assert sorted(path.name for path in tmp_path.iterdir()) == ["street"]
