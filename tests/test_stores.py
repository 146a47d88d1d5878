"""Maps whose parts are kept in a store, at a URL, instead of a folder."""

from __future__ import annotations

import importlib.util
import io
import pickle
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from threading import Thread
from typing import Any

import pyarrow.fs as pa_fs
import pytest
from typer.testing import CliRunner

import valuemap
from test_detect import Elsewhere
from test_tiles import SET, files, mapped, streets
from valuemap.cli.commands import app
from valuemap.config import MapConfig
from valuemap.errors import InputError, OutputError
from valuemap.map_folder import write_map
from valuemap.pipeline import Run, build_map_of_folder
from valuemap.remote import UrlPath, folder_of, place_of
from valuemap.tiles import mapping, partition, work
from valuemap.tiles.solve import Solved, solve_cell
from valuemap.tiles.work import MARKER, open_store

TILES = ("--tile-size", "500")


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stores") / "street"
    valuemap.write_dataset(streets(0.0, 445.0, 3000.0), folder)
    return folder


@pytest.fixture(scope="module")
def expected(street: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return mapped(street, tmp_path_factory.mktemp("expected") / "map", *TILES)


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """Yield what a URL of a bucket ends with, of a server that speaks as S3 does."""
    server = shutil.which("moto_server")
    if server is None:
        pytest.skip("there is no moto_server: uv tool install 'moto[s3]' --with flask --with flask-cors")
    port = 5000 + hash(time.monotonic_ns()) % 20_000
    query = f"endpoint_override=127.0.0.1:{port}&scheme=http&region=us-east-1"
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("AWS_ACCESS_KEY_ID", "nobody")
        patched.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        with subprocess.Popen([server, "-H", "127.0.0.1", "-p", str(port)], stderr=subprocess.DEVNULL) as process:
            try:
                until = time.monotonic() + 60.0
                while time.monotonic() < until:
                    try:
                        urllib.request.urlopen(f"http://127.0.0.1:{port}/moto-api/").close()
                        break
                    except OSError:
                        time.sleep(0.2)
                system, _ = pa_fs.FileSystem.from_uri(f"s3://city?{query}&allow_bucket_creation=true")
                system.create_dir("city")
                yield query
            finally:
                process.terminate()


@pytest.fixture(params=["memory", "s3"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "s3":
        return f"s3://city/{tmp_path.name}?{request.getfixturevalue('s3')}"
    if not importlib.util.find_spec("fsspec"):
        pytest.skip("fsspec is not installed")
    return f"memory://city/{tmp_path.name}"


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let runs say often that they live, and not be waited for long."""
    monkeypatch.setattr(work, "_BEAT_S", 0.05)
    monkeypatch.setattr(work, "_WAIT_S", 3.0)


def run(street: Path, out: Path, *options: str) -> tuple[int, str]:
    settings = [f"--set={name}={value}" for name, value in SET.items()]
    result = CliRunner().invoke(app, ["map", str(street), "--out", str(out), *settings, *options])
    return result.exit_code, result.output


def test_a_map_of_parts_in_a_store_is_that_of_a_folder(
    street: Path, expected: dict[str, bytes], tmp_path: Path, url: str
) -> None:
    assert mapped(street, tmp_path / "map", "--work", url, *TILES) == expected
    assert [path.name for path in tmp_path.iterdir()] == ["map"]
    assert UrlPath(url).names() == []


def test_what_is_in_a_store_is_not_made_again(
    street: Path, expected: dict[str, bytes], tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved: list[str] = []
    cut: list[Path] = []
    write = partition._Writer.write

    def some(piece: object, cell: object, *rest: object, **options: object) -> Solved:
        if len(solved) == 2:
            raise InputError("this far", hint="and on")
        solved.append(str(cell))
        return solve_cell(piece, cell, *rest, **options)  # type: ignore[arg-type]

    def counted(writer: partition._Writer) -> None:
        cut.append(writer.aside)
        write(writer)

    monkeypatch.setattr(partition._Writer, "write", counted)
    with monkeypatch.context() as patched:
        patched.setattr(mapping, "solve_cell", some)
        assert "this far" in run(street, tmp_path / "map", "--work", url, "--threads=1", *TILES)[1]
    kept = UrlPath(url).names()
    assert [name.partition(".")[0] for name in kept if "/" not in name] == ["calibration", "valuemap-work"]
    assert sum(name.startswith("cells/") for name in kept) == 2

    def others(piece: object, cell: object, *rest: object, **options: object) -> Solved:
        solved.append(str(cell))
        return solve_cell(piece, cell, *rest, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(mapping, "solve_cell", others)
    assert mapped(street, tmp_path / "map", "--work", url, "--resume", *TILES) == expected
    assert len(set(solved)) == len(solved)
    assert len(cut) == 1
    # Without --resume nothing of it is taken.
    (UrlPath(url) / MARKER).write_bytes(b"{}")
    (UrlPath(url) / "cells" / "left.arrow").write_bytes(b"of another run")
    assert mapped(street, tmp_path / "again", "--work", url, *TILES) == expected
    assert len(cut) == 2
    assert UrlPath(url).names() == []


def test_a_partition_that_was_cut_short_is_not_taken_for_whole(
    street: Path, expected: dict[str, bytes], tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = UrlPath.write_bytes
    written: list[str] = []

    def failing(place: UrlPath, content: bytes) -> None:
        if place.name.startswith("partition-"):
            if len(written) == 7:
                raise OutputError(f"{place}: cannot be written: gone", hint="later")
            written.append(place.name)
        write(place, content)

    with monkeypatch.context() as patched:
        patched.setattr(UrlPath, "write_bytes", failing)
        assert "cannot be written: gone" in run(street, tmp_path / "map", "--work", url, *TILES)[1]
    assert set(written) <= set(UrlPath(url).names())
    assert mapped(street, tmp_path / "map", "--work", url, "--resume", *TILES) == expected


def test_a_second_run_is_refused_while_the_first_lives_and_takes_over_when_it_does_not(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, told = UrlPath(url), list[str]()
    with open_store(place, resume=False, tell=told.append):
        (place / "cells" / "a").write_bytes(b"1")
        assert told == []
        refused = pytest.raises(OutputError, match="another run is at work here")
        with refused, open_store(place, resume=False, tell=told.append):
            pass
        assert told == [f"{place}: another run is, or was, at work here: waiting 3 s for a sign of life"]
        assert (place / "cells" / "a").read_bytes() == b"1"
    # One that was killed says nothing more.
    (place / "living-killed").write_bytes(b"7")
    with open_store(place, resume=True, tell=told.append):
        assert (place / "cells" / "a").is_file()
        assert [name for name in place.names() if name.endswith("killed")] == []
    assert place.names() == ["cells/a", MARKER]
    del told[:]
    with open_store(place, resume=False, tell=told.append):
        assert told == [f"{place}: what an earlier run left unfinished is discarded; --resume goes on from it"]


def test_of_two_runs_that_begin_together_not_both_go_on(url: str) -> None:
    outcomes: list[str] = []

    def begin() -> None:
        try:
            with open_store(UrlPath(url), resume=True, tell=lambda _: None):
                outcomes.append("runs")
                for _ in range(200):  # It lives until the other one has decided.
                    if len(outcomes) < 2:
                        time.sleep(0.1)
        except OutputError:
            outcomes.append("refused")

    (UrlPath(url) / MARKER).write_bytes(b"{}")
    threads = [Thread(target=begin) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(outcomes) == 2
    assert outcomes.count("runs") <= 1


class ChangedMeanwhile:
    """A store whose file is replaced, or removed, once somebody has looked how large it is."""

    def __init__(self, then: bytes | None) -> None:
        self._then, self._looks = then, 0

    def open_input_file(self, path: str) -> io.BytesIO:
        self._looks += 1
        if self._looks == 1:
            raise OSError("failed to flush response stream")
        if self._then is None:
            raise FileNotFoundError(path)
        return io.BytesIO(self._then)


@pytest.mark.parametrize("then", [b"2", None])
def test_a_file_that_changes_meanwhile_is_read_again(then: bytes | None, monkeypatch: pytest.MonkeyPatch) -> None:
    store = ChangedMeanwhile(then)
    monkeypatch.setattr(UrlPath, "_place", lambda _: (store, "path"))
    with nullcontext() if then else pytest.raises(FileNotFoundError):
        assert UrlPath("memory://city/living-1").read_bytes() == then


def test_a_file_can_be_read_while_somebody_else_reads_it(tmp_path: Path) -> None:
    """The store of fsspec in memory opens the same file for all, with one position."""
    memory = pytest.importorskip("fsspec").filesystem("memory")
    place, content = UrlPath(f"memory://city/{tmp_path.name}"), bytes(range(100))
    place.write_bytes(content)
    with memory.open(f"/city/{tmp_path.name}") as other:
        assert other.read(50) == content[:50]
        assert place.read_bytes() == content
        assert other.read() == content[50:]


def test_what_is_not_ours_stays(street: Path, tmp_path: Path, url: str) -> None:
    (UrlPath(url) / "letter.txt").write_bytes(b"dear")
    code, said = run(street, tmp_path / "map", "--work", url)
    assert (code, "is not ours" in said) == (1, True)
    assert UrlPath(url).names() == ["letter.txt"]


def test_a_url_of_a_folder_is_the_folder(street: Path, expected: dict[str, bytes], tmp_path: Path) -> None:
    place = tmp_path / "my work"
    assert folder_of(place_of(place.as_uri())) == place
    assert mapped(street, tmp_path / "map", "--work", place.as_uri(), *TILES) == expected
    assert folder_of(place_of("s3://b/x")) == UrlPath("s3://b/x")


def test_a_url_without_a_store_is_one_line(street: Path, tmp_path: Path) -> None:
    code, said = run(street, tmp_path / "map", "--work", "nowhere://b/c")
    assert (code, "nowhere://b/c: no store can be opened" in said) == (1, True)


class Pickling(Elsewhere):
    """An engine in other processes: what goes to them is pickled."""

    def run(self, work: Any, tasks: Any, *, on_gpus: bool = False) -> Any:
        sent = pickle.dumps((work, list(tasks)))
        assert len(sent) < 20_000
        return super().run(*pickle.loads(sent), on_gpus=on_gpus)


def test_only_the_url_goes_to_other_processes(
    street: Path, expected: dict[str, bytes], tmp_path: Path, url: str
) -> None:
    with open_store(UrlPath(url), resume=False, tell=print) as store:
        (tmp_path / "here").mkdir()
        run = Run(tmp_path / "here", Pickling(), tile_size_m=500.0, store=store)
        result, cells = build_map_of_folder(
            street, MapConfig().with_settings([f"{k}={v}" for k, v in SET.items()]), run
        )
        assert all(isinstance(cell, UrlPath) for cell in cells)
        assert list((tmp_path / "here").iterdir()) == []
        write_map(result, tmp_path / "map", cells=cells)
    assert files(tmp_path / "map") == expected
