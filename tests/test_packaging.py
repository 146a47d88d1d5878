"""What the package says about itself, and what it needs, is what is so."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml

from small_dataset import ANCHOR, map_of
from valuemap.dataset import Frame
from valuemap.errors import SettingError
from valuemap.readers import READERS
from valuemap.writers import export_map

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
DISTRIBUTION_OF = {
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "yaml": "pyyaml",
    "psycopg": "psycopg[binary]",
    "rerun": "rerun-sdk",
}
BROUGHT_ALONG = {"pandas": "geopandas", "shapely": "geopandas", "pydantic_core": "pydantic"}
"""Packages that are there because another one, whose data they are, needs them."""


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=;~ ]", requirement)[0] for requirement in requirements}


def imported_packages() -> set[str]:
    found: set[str] = set()
    for path in (ROOT / "python" / "valuemap").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - {"valuemap"}


def test_what_is_imported_is_required_and_what_is_required_is_imported() -> None:
    extras = PROJECT["optional-dependencies"]
    declared = names(PROJECT["dependencies"]).union(*(names(extra) for name, extra in extras.items() if name != "all"))
    imported = {DISTRIBUTION_OF.get(name, name) for name in imported_packages() - BROUGHT_ALONG.keys()}
    assert imported <= declared
    # PyTorch imports the first to write ONNX files; the second is imported by name.
    assert declared - imported == {"onnxscript", "ray"}
    assert set(BROUGHT_ALONG.values()) <= declared


def test_pycolmap_is_imported_from_one_place() -> None:
    """Who imports it hands SIGTERM to glog."""
    folder = ROOT / "python" / "valuemap"
    importing = [
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*.py")
        if re.search(r"^ *import pycolmap", path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert importing == ["colmap.py"]


def test_the_extra_all_is_all_extras() -> None:
    extras = dict(PROJECT["optional-dependencies"])
    (everything,) = extras.pop("all")
    assert everything == f"valuemap[{','.join(sorted(extras))}]"


def test_one_version_is_told_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    cargo = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))
    assert citation["version"] == PROJECT["version"] == cargo["workspace"]["package"]["version"]
    assert citation["references"][0]["url"] == PROJECT["urls"]["Paper"]


def test_the_workflow_of_releases_tries_every_wheel() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8"))["jobs"]
    systems = {row["name"] for row in jobs["wheel"]["strategy"]["matrix"]["include"]}
    assert systems >= {"linux-x86_64", "linux-aarch64", "macos-arm64", "windows-x86_64"}
    commands = [step.get("run", "") for step in jobs["wheel"]["steps"]]
    assert any("try_wheel.py" in command for command in commands)
    assert set(jobs["publish"]["needs"]) == set(jobs) - {"publish"}
    for job in jobs.values():
        for command in (step.get("run", "") for step in job["steps"]):
            for target in re.findall(r"\bmake (\w+)", command):
                assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
            for script in re.findall(r"\.ci/\w+(?:\.py)?", command):
                assert (ROOT / script).is_file()


def test_a_wheel_of_one_python_or_one_machine_is_refused(tmp_path: Path) -> None:
    for name in ("valuemap-0.1.0-cp311-cp311-manylinux_2_28_x86_64.whl", "valuemap-0.1.0-cp311-abi3-linux_x86_64.whl"):
        done = subprocess.run(
            [sys.executable, str(ROOT / ".ci" / "try_wheel.py"), str(tmp_path / name)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 1
        assert "error: expected a wheel named like" in done.stderr


def test_a_missing_extra_is_named_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("psycopg", "rosbags", "rosbags.highlevel", "rosbags.typesys"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SettingError) as error:
        export_map(
            map_of([[1.0, 2.0, 3.0]], frame=Frame(anchor=ANCHOR), lon_lat_height=np.array([[-0.14, 51.5, 36.0]])),
            "postgresql://localhost/nothing",
        )
    assert "valuemap[postgis]" in error.value.hint
    with pytest.raises(SettingError) as error:
        READERS["ros"]([tmp_path / "drive.bag"])
    assert "valuemap[ros]" in error.value.hint
