"""What the README tells people to type works."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

import valuemap
from block import block
from test_cli import works
from valuemap.simulate import PRESETS, simulate

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_the_python_example_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(PRESETS, "small", block())
    (example,) = blocks("python")
    exec(compile(example, "README.md", "exec"), {})
    assert "labels," in capsys.readouterr().out


def test_the_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the import, which needs data of the reader's own: a simulated city stands in for it."""
    monkeypatch.chdir(tmp_path)
    valuemap.write_dataset(simulate(block(), seed=0), Path("my-data"))
    (tmp_path / "survey.csv").write_text("x,y,z\n0,0,0\n")
    lines = [line.split("#")[0] for block in blocks("sh") for line in block.splitlines()]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("valuemap ")]
    assert {command[0] for command in commands} >= {"import", "info", "map", "export", "evaluate"}
    for command in commands:
        works(*(command if command[0] != "import" else ["import", "colmap", "--help"]))


def test_every_page_it_points_to_exists() -> None:
    root = Path(__file__).parents[1]
    targets = [target for target in re.findall(r"\]\(([^)]+)\)", README) if "://" not in target]
    assert len(targets) > 5
    assert [target for target in targets if not (root / target).exists()] == []
