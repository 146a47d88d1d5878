"""What commands say: choices, one stream for summaries, numbers as numbers, bars that begin and end with the work."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, get_args

import pytest
from rich.console import Console
from rich.progress import Progress
from typer.testing import CliRunner

from small_dataset import map_of, small_dataset
from valuemap.cli import show as shown
from valuemap.cli.commands import app
from valuemap.cli.export import Format
from valuemap.cli.import_.options import DetectionFormat
from valuemap.cli.options import EngineName
from valuemap.cli.simulate import Preset
from valuemap.config import list_settings
from valuemap.dataset import write_dataset
from valuemap.engine.choose import ENGINES
from valuemap.map_folder import write_map
from valuemap.pipeline import build_map
from valuemap.readers.detections import DETECTIONS
from valuemap.readers.poses import AXES, Axes
from valuemap.simulate import PRESETS
from valuemap.writers import FOLDER_WRITERS, WRITERS


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_choices_are_what_there_is() -> None:
    assert set(get_args(Format)) == {*WRITERS, *FOLDER_WRITERS}
    assert set(get_args(DetectionFormat)) == {"auto", *DETECTIONS}
    assert set(get_args(Preset)) == set(PRESETS)
    assert set(get_args(Axes)) == set(AXES)
    assert set(get_args(get_args(EngineName)[0])) == set(ENGINES)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["map", "x", "--out", "y", "--method", "magic"], "'magic' is not one of 'robust', 'paper'"),
        (["detect", "x", "--model", "m", "--provider", "tpu"], "'tpu' is not one of 'cpu', 'cuda'"),
        (["simulate", "--out", "y", "--preset", "big"], "'big' is not one of 'small'"),
        (["import", "csv", "x", "--out", "y", "--axes", "up"], "'up' is not one of"),
        (["export", "x", "y", "--format", "doc"], "'doc' is not one of"),
        (["export", "x"], "Missing argument"),
        (["nothing"], "No such command 'nothing'"),
        (["--nothing"], "No such option"),
    ],
)
def test_wrong_use_is_told_in_one_line(arguments: list[str], said: str) -> None:
    done = run(*arguments)
    assert done.exit_code == 2
    line, hint = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert said in line
    assert hint.startswith("hint: ")
    assert "--help" in hint
    assert done.stdout == ""


def test_without_arguments_the_help_is_shown() -> None:
    assert "Usage" in run("import").output


def test_summaries_go_to_stdout_and_what_was_done_to_stderr(tmp_path: Path) -> None:
    done = run("simulate", "--out", tmp_path / "data", "--set", "passes_per_street=1")
    assert done.exit_code == 0, done.stderr
    assert "extent in m" in done.stdout
    assert "local, up 0 0 1" in done.stdout
    assert done.stderr == f"Wrote {tmp_path / 'data'}\n"
    facts = json.loads(run("info", tmp_path / "data", "--json").stdout)
    again = json.loads(run("simulate", "--out", tmp_path / "data", "--set", "passes_per_street=1", "--json").stdout)
    assert again == {**facts, "left_out": {}}


def test_json_has_numbers_as_numbers(tmp_path: Path) -> None:
    write_dataset(small_dataset(), tmp_path / "data")
    facts = json.loads(run("info", tmp_path / "data", "--json").stdout)
    assert facts["classes"] == {"light": 3, "sign": 2}
    assert len(facts["extent_m"]) == 3
    assert sum(facts["images_by_detections"]) == facts["images"]
    assert isinstance(facts["detections_per_image"], float)
    assert facts["frame"] == small_dataset().frame.to_json()
    told = run("info", tmp_path / "data").stdout
    assert "light 3, sign 2" in told
    write_map(map_of([[0.0, 0.0, 0.0], [3.0, 4.0, 5.0]], run={"notes": ["all is odd"]}), tmp_path / "map")
    told = run("info", tmp_path / "map")
    assert told.stderr.splitlines() == ["note: all is odd"]
    assert "odd" not in told.stdout
    assert json.loads(run("info", tmp_path / "map", "--json").stdout)["notes"] == ["all is odd"]
    assert json.loads(run("info", tmp_path / "map", "--json").stdout)["extent_m"] == [3.0, 4.0, 5.0]
    assert "3 x 4 x 5" in run("info", tmp_path / "map").stdout
    settings = json.loads(run("settings", "--json").stdout)
    assert settings == list_settings()
    assert {"name": "min_votes", "default": 3}.items() <= next(s for s in settings if s["name"] == "min_votes").items()


def test_recall_is_what_a_map_has_and_a_detector_has_a_rate() -> None:
    counts = build_map(small_dataset()).run["counts"]
    assert 0.0 < counts["detection_rate"] < 1.0
    assert [name for name in counts if "recall" in name] == []


class Terminal:
    """A terminal that nobody looks at, and the bars drawn on it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.bars: list[Any] = []
        monkeypatch.setattr(shown, "log", Console(file=io.StringIO(), force_terminal=True))
        terminal = self

        class Bars(Progress):
            def __init__(self, *columns: Any, **options: Any) -> None:
                super().__init__(*columns, **options)
                terminal.bars.append(self)

            def add_task(self, description: str, *arguments: Any, **options: Any) -> Any:
                assert options["total"] is not None, f"{description} begins without a total"
                return super().add_task(description, *arguments, **options)

        monkeypatch.setattr(shown, "ProgressBars", Bars)


def test_bars_begin_with_a_total_and_end_with_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal(monkeypatch)
    with shown.progress_bars() as progress:
        progress("reading", 0, 2)
        progress("finding", 1, 7)
        (bars,) = terminal.bars
        reading, finding = bars.tasks
        assert (reading.completed, reading.total) == (2, 2)  # What comes next has begun.
        assert (finding.completed, finding.total) == (1, 7)
        progress("finding", 7, 7)
        assert bars.finished
        progress("finding", 0, 3)  # The same once more, on something else.
        assert (bars.tasks[1].completed, bars.tasks[1].total) == (0, 3)
        progress("finding", 3, 3)
        assert bars.finished
