"""What not every operating system has is asked for, not taken for granted."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from small_dataset import small_dataset
from valuemap import system
from valuemap.dataset import read_dataset, write_dataset

WITHOUT_UNIX = """
import os, signal, subprocess, sys, types
for name in ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog"):
    sys.modules[name] = None
windows = types.ModuleType("msvcrt")
windows.LK_NBLCK, windows.locking = 2, lambda descriptor, mode, length: None
sys.modules["msvcrt"] = windows
for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_DIRECTORY"):
    delattr(os, name)
for name in ("pthread_sigmask", "SIGHUP"):
    delattr(signal, name)
"""


def run_without_unix(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", WITHOUT_UNIX + code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_all_names_for_users_are_there_without_what_only_unix_has() -> None:
    out = run_without_unix("import valuemap\nprint(len([getattr(valuemap, name) for name in valuemap.__all__]))")
    import valuemap

    assert int(out) == len(valuemap.__all__)


def test_the_command_line_makes_a_map_without_what_only_unix_has(tmp_path: Path) -> None:
    write_dataset(small_dataset(), tmp_path / "data")
    arguments = ["map", str(tmp_path / "data"), "--out", str(tmp_path / "map")]
    code = f"from valuemap.cli import main\nsys.argv[1:] = {arguments!r}\nmain()"
    run_without_unix(code)
    run_without_unix(code)  # Replaces what the first run is on record for.
    assert (tmp_path / "map" / "labels.parquet").is_file()
    assert '"peak_memory_mb": null' in (tmp_path / "map" / "run.json").read_text(encoding="utf-8")


def test_the_peak_memory_is_that_of_this_process() -> None:
    before = system.peak_memory_mb()
    assert before is not None
    block = bytearray(os.urandom(1)) * (300 * 2**20)
    after = system.peak_memory_mb()
    assert after is not None
    assert after >= min(before + 250, len(block) // 2**20)


def test_the_peak_memory_is_not_that_of_who_started_the_process() -> None:
    block = bytearray(os.urandom(1)) * (300 * 2**20)
    code = "from valuemap import system; print(system.peak_memory_mb())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < len(block) // 2**20


def test_a_folder_is_locked_once(tmp_path: Path) -> None:
    with system.folder_lock(tmp_path), pytest.raises(BlockingIOError), system.folder_lock(tmp_path):
        raise AssertionError
    with system.folder_lock(tmp_path):
        pass


class Msvcrt(types.ModuleType):
    """Locks of files as Windows has them: the second one of a file is refused until the first is closed."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        super().__init__("msvcrt")
        self.held: dict[int, int] = {}

    def locking(self, descriptor: int, _mode: int, _length: int) -> None:
        inode = os.fstat(descriptor).st_ino
        if any(other == inode and _is_open(held) for held, other in self.held.items() if held != descriptor):
            raise PermissionError(13, "locked")
        self.held[descriptor] = inode


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def test_where_folders_cannot_be_locked_a_file_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modules: dict[str, Any] = {"fcntl": None, "msvcrt": Msvcrt()}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    one, other = tmp_path / "one", tmp_path / "other"
    with system.folder_lock(one), system.folder_lock(other), pytest.raises(PermissionError), system.folder_lock(one):
        raise AssertionError
    with system.folder_lock(one):
        pass
    assert not one.exists()


def test_without_locks_new_folders_are_written_and_those_of_others_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("fcntl", "msvcrt"):
        monkeypatch.setitem(sys.modules, name, None)
    data = tmp_path / "data"
    write_dataset(small_dataset(), data)
    living = data / ".valuemap-new-of-another"
    living.mkdir()
    write_dataset(small_dataset(), data)
    assert len(read_dataset(data).images) == len(small_dataset().images)
    assert living.is_dir()
