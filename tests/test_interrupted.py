"""Runs that end before they are done: by a signal, as processes of their own, and by a full disk."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

import valuemap
from test_tiles import SET, files, streets
from valuemap.cli.commands import app
from valuemap.tiles.work import open_work

LIMIT_S = 300.0


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of several cells, and the map of it."""
    folder = tmp_path_factory.mktemp("interrupted")
    # So many images that a cell takes longer than it takes to see that one is there, and to end the run.
    valuemap.write_dataset(streets(0.0, 445.0, 3000.0, images=60), folder / "street")
    assert run(mapping(folder, folder / "whole"))[0] == 0
    return folder


def mapping(folder: Path, out: Path, *options: str) -> list[str]:
    settings = [f"--set={name}={value}" for name, value in SET.items()]
    command = ["map", str(folder / "street"), "--out", str(out), "--threads=1"]
    return [*command, *settings, "--tile-size=500", *options]


def updating(folder: Path, out: Path, *options: str) -> list[str]:
    command = ["update", str(folder / "whole"), "--out", str(out), "--threads=1"]
    return [*command, "--add", str(folder / "added"), "--tile-size=500", *options]


def run(command: list[str]) -> tuple[int, str]:
    """Run a command to its end, in this process; return how it ended, and what it said on stderr."""
    done = CliRunner().invoke(app, command)
    return done.exit_code, done.stderr


def start(command: list[str]) -> subprocess.Popen[str]:
    """Start a command that is ended before it is done, in a process of its own."""
    command = [sys.executable, "-m", "valuemap.cli", *command]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Return how a process ended, and what it said on stderr."""
    _, told = process.communicate(timeout=LIMIT_S)
    return process.returncode, told


def parts(work: Path) -> list[Path]:
    return list(work.glob("cells/*.arrow"))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM that a process can hear")
def test_a_terminated_run_says_so_in_one_line_and_goes_on(street: Path, tmp_path: Path) -> None:
    work = tmp_path / "map.work"
    process = start(mapping(street, tmp_path / "map"))
    until = time.monotonic() + LIMIT_S
    while not parts(work) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.002)
    process.send_signal(signal.SIGTERM)
    code, told = finish(process)
    assert code == 128 + signal.SIGTERM
    lines = [line for line in told.splitlines() if not line.startswith("hint: ")]
    assert len(lines) == 1, told
    assert str(work) in lines[0]
    assert 0 < len(parts(work)) < len(files(street / "whole")) - 3
    # Nothing temporary is left, there or beside it.
    assert [path.name for path in tmp_path.iterdir()] == ["map.work"]
    assert [path for path in work.rglob("*") if path.name.startswith(".tmp-")] == []
    assert run(mapping(street, tmp_path / "map", "--resume"))[0] == 0
    assert files(tmp_path / "map") == files(street / "whole")
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


def test_earlier_work_that_is_not_gone_on_with_is_told(tmp_path: Path) -> None:
    told: list[str] = []
    for resume in (False, True):  # A first run has nothing to tell, one that is to go on has.
        with open_work(tmp_path / "work", resume=resume, tell=told.append):
            pass
    assert told == [f"{tmp_path / 'work'}: there is nothing to resume: the work begins anew"]
    (tmp_path / "work" / "cells" / "a.arrow").touch()
    for resume in (True, False):
        with open_work(tmp_path / "work", resume=resume, tell=told.append):
            assert len(parts(tmp_path / "work")) == int(resume)
    assert told[1:] == [
        f"{tmp_path / 'work'}: what an earlier run left unfinished is discarded; --resume goes on from it"
    ]


# What an update has made when it is killed: the data as one, a cell, and what is new alone.
MOMENTS = ("dataset/detections.parquet", "cells/*.arrow", "added/detections.parquet")


@pytest.fixture(scope="module")
def updated(street: Path) -> dict[str, bytes]:
    """What an update of the map is that nobody ends."""
    valuemap.write_dataset(streets(0.0, 445.0, seed=11, images=60), street / "added")
    assert run(updating(street, street / "updated"))[0] == 0
    return everything(street / "updated")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("moment", MOMENTS)
def test_an_update_that_is_killed_goes_on_to_the_same_map(
    street: Path, updated: dict[str, bytes], tmp_path: Path, moment: str
) -> None:
    out = tmp_path / "map"
    process = start(updating(street, out))
    until = time.monotonic() + LIMIT_S
    while not any(out.with_name("map.work").glob(moment)) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.001)
    process.kill()
    assert finish(process)[0] == -signal.SIGKILL
    assert not out.exists()
    assert run(updating(street, out, "--resume"))[0] == 0
    assert everything(out) == updated
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


def everything(folder: Path) -> dict[str, bytes]:
    """All files of a map, but for the record of how long it took."""
    found = (path for path in folder.rglob("*") if path.is_file() and path.name not in ("run.json", ".valuemap-files"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount(place, "-t", "tmpfs", "-o", "size=64k", "tmpfs")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def mount(place: Path, *options: str) -> None:
    try:
        done = subprocess.run(["mount", *options, str(place)], capture_output=True, text=True)
    except OSError as error:
        pytest.skip(f"file systems cannot be mounted here: {error}")
    if done.returncode:
        pytest.skip(f"file systems cannot be mounted here: {done.stderr.strip()}")


def test_on_a_full_disk_a_run_says_so_and_goes_on_when_there_is_room(
    street: Path, small_disk: Path, tmp_path: Path
) -> None:
    code, told = run(mapping(street, tmp_path / "map", f"--work={small_disk / 'work'}"))
    assert code == 1, told
    assert told.startswith(f"error: {small_disk / 'work'}: cannot be written: No space left on device"), told
    assert "--resume" in told
    assert len(told.splitlines()) == 2, told
    assert not (tmp_path / "map").exists()
    assert [path for path in small_disk.rglob("*") if path.name.startswith(".tmp-")] == []
    mount(small_disk, "-o", "remount,size=100m")
    assert run(mapping(street, tmp_path / "map", f"--work={small_disk / 'work'}", "--resume"))[0] == 0
    assert files(tmp_path / "map") == files(street / "whole")


def test_a_map_that_does_not_fit_leaves_nothing_behind(street: Path, small_disk: Path, tmp_path: Path) -> None:
    # The parts fit elsewhere, the map does not.
    (small_disk / "map").mkdir()
    (small_disk / "letter").write_bytes(b"x" * 50_000)
    code, told = run(mapping(street, small_disk / "map", f"--work={tmp_path / 'work'}"))
    assert code == 1, told
    assert "No space left on device" in told
    assert sorted(path.name for path in small_disk.rglob("*")) == ["letter", "map"]
    (small_disk / "letter").unlink()
    mount(small_disk, "-o", "remount,size=100m")
    assert run(mapping(street, small_disk / "map", f"--work={tmp_path / 'work'}", "--resume"))[0] == 0
    assert files(small_disk / "map") == files(street / "whole")
