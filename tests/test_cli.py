"""The command line as users meet it: the verbs end to end, and one clear line for every mistake."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pycolmap
import pytest
from typer.testing import CliRunner

import valuemap
from scenes import as_dataset, random_scene
from small_dataset import map_of
from valuemap.cli.commands import app
from valuemap.config import describe_settings

COMMAND = [sys.executable, "-c", "from valuemap.cli import main; main()"]


def start(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, check=False)


def works(*arguments: str | Path) -> str:
    """Run a command in this process, as starting one takes longer than the work; return what it prints."""
    done = CliRunner().invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, done.output
    return done.stdout


def complains(*arguments: str | Path) -> str:
    """Run a command that must fail with one line and a hint; return the line."""
    done = CliRunner().invoke(app, [*map(str, arguments)])
    assert isinstance(done.exception, SystemExit), done.exception  # Nothing else gets out: no traceback.
    return one_line_and_a_hint(done.exit_code, done.stdout, done.stderr)


def one_line_and_a_hint(code: int, stdout: str, stderr: str) -> str:
    assert code == 1
    assert stdout == ""
    lines = stderr.strip().splitlines()
    assert len(lines) == 2, stderr
    assert lines[0].startswith("error: ")
    assert lines[1].startswith("hint: ")
    return stderr


def test_no_package_is_asked_for_plugins() -> None:
    asked = """
import sys
import importlib.metadata as metadata
def entry_points(**group): raise AssertionError(group)
metadata.entry_points = entry_points
from valuemap.cli import main
sys.argv = ["valuemap", "map", "--help"]
main()
"""
    environment = {name: value for name, value in os.environ.items() if name != "PYDANTIC_DISABLE_PLUGINS"}
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr


def test_threads_of_blas_do_not_wait_in_a_loop() -> None:
    asked = """
import sys
from valuemap.cli import main
sys.argv = ["valuemap", "info", "--help"]
try:
    main()
except SystemExit:
    import numpy, threadpoolctl
    pools = threadpoolctl.threadpool_info()
    print("threads:", [pool["num_threads"] for pool in pools if pool["internal_api"] == "openblas"])
"""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.splitlines()[-1] == "threads: [1]"


@pytest.fixture
def street(tmp_path: Path) -> Path:
    folder = tmp_path / "street"
    valuemap.write_dataset(as_dataset(random_scene(7, images=60, objects=8, clutter=60)), folder)
    return folder


def spoil(folder: Path, table: str, column: str, value: object) -> None:
    """Overwrite the first value of a column."""
    path = folder / f"{table}.parquet"
    content = pq.read_table(path)
    values = content.column(column).to_pylist()
    values[0] = value
    index = content.column_names.index(column)
    pq.write_table(content.set_column(index, column, pa.array(values)), path)


def test_from_simulation_to_export(tmp_path: Path) -> None:
    data, result = tmp_path / "data", tmp_path / "map"
    works("simulate", "--preset", "small", "--seed", "3", "--out", data)
    assert "traffic_light" in works("info", data)
    works("map", data, "--out", result, "--method", "paper", "--threads", "2", "--set", "min_votes=4")
    run_record = json.loads((result / "run.json").read_text())
    assert run_record["settings"]["min_votes"] == 4
    assert run_record["counts"]["labels"] == len(valuemap.read_map(result).labels)
    assert {stage["stage"] for stage in run_record["stages"]} >= {"partition", "vote", "merge"}
    figures = json.loads(works("evaluate", result, "--truth", data, "--json"))
    assert figures["recall"] > 0.9
    assert set(figures) == {
        "true_positives",
        "duplicates",
        "false_positives",
        "false_negatives",
        "recall",
        "precision",
        "position_rmse_m",
        "position_median_m",
        "horizontal_rmse_m",
        "vertical_rmse_m",
        "mean_reprojection_error_px",
        "accuracy",
        "completeness",
        "chance",
        "reliability",
    }
    told = works("evaluate", result, "--truth", data, "--radius", "1.0", "--truth-sigma", "0.02")
    assert "recoverable objects" in told
    assert "RMSE_H = " in told
    assert "own sigma 0.02 m an axis" in told
    works("export", result, tmp_path / "labels.csv")
    header = (tmp_path / "labels.csv").read_text().splitlines()[0].split(",")
    assert {"label_id", "class", "x", "y", "z", "votes", "passes"} <= set(header)
    assert json.loads(works("info", result, "--json"))["labels"] == run_record["counts"]["labels"]


@pytest.mark.parametrize("way", [COMMAND, *([sys.executable, "-m", name] for name in ("valuemap", "valuemap.cli"))])
def test_every_way_to_start_tells_the_version(way: list[str]) -> None:
    done = subprocess.run([*way, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"valuemap {version('valuemap')}\n"
    assert done.stderr == ""


def test_a_process_says_and_ends_as_its_command_does(street: Path, tmp_path: Path) -> None:
    done = start("map", street, "--out", tmp_path / "map", "--method", "paper", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["counts"]["images"] == 60
    failed = start("map", tmp_path / "nowhere", "--out", tmp_path / "map")
    assert "is not a dataset" in one_line_and_a_hint(failed.returncode, failed.stdout, failed.stderr)


def test_commands_are_shown_in_the_order_of_use() -> None:
    told = works("--help")
    places = [told.index(f"│ {name} ") for name in ("demo", "import", "detect", "map", "evaluate", "export")]
    assert places == sorted(places)


def test_only_the_command_that_is_asked_for_is_imported() -> None:
    code = """
import sys
from valuemap.cli.load import COMMANDS, load_commands
load_commands(sys.argv[1:])
print(*(name for name in (*COMMANDS, "import_.colmap") if f"valuemap.cli.{name}" in sys.modules))
assert not {"valuemap.readers.colmap", "pycolmap", "scipy.spatial"} & set(sys.modules)
"""
    asked = ((["info", "map"], "info"), (["import"], "import_ import_.colmap"), (["--version"], ""))
    for words, imported in asked:
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
        assert done.stdout == f"{imported}\n"


def test_json_of_a_map_is_its_record(street: Path, tmp_path: Path) -> None:
    printed = json.loads(works("map", street, "--out", tmp_path / "map", "--json"))
    assert printed["counts"]["images"] == 60


def test_what_completes_names_the_command_however_it_was_started() -> None:
    told = subprocess.run(
        [sys.executable, "-m", "valuemap", "--show-completion", "bash"],
        env={**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert "_VALUEMAP_COMPLETE=complete_bash" in told
    assert told.rstrip().endswith("_valuemap_completion valuemap")
    wrong = subprocess.run([sys.executable, "-m", "valuemap", "info"], capture_output=True, text=True, check=False)
    assert "hint: valuemap info --help says what it takes" in wrong.stderr


def test_settings_are_listed_with_their_effects() -> None:
    told = works("settings")
    assert all(name in told for name, *_ in describe_settings())


def test_what_cannot_be_is_said_before_the_work_begins(street: Path, tmp_path: Path) -> None:
    said = complains("map", street, "--out", tmp_path / "m", "--write-poses", tmp_path / "." / "m")
    assert "is the folder of the map too" in said
    assert list(tmp_path.iterdir()) == [street]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_in_the_middle_of_an_import_comes_after_it(name: str, tmp_path: Path) -> None:
    """Imports of compiled modules turn what is raised in them into an error of their own."""
    (tmp_path / "pycolmap.py").write_text(f"""
import os, signal
try:
    os.kill(os.getpid(), signal.{name})
    for _ in range(100_000):
        pass
except BaseException as error:
    raise ImportError("cannot import the backend") from error
signal.signal(signal.SIGTERM, signal.SIG_DFL)
""")
    program = f"""
import signal, sys
sys.path.insert(0, {str(tmp_path)!r})
def heard(number, frame):
    raise KeyboardInterrupt(number)
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, heard)
try:
    import valuemap.colmap
except KeyboardInterrupt:
    print("heard", "pycolmap" in sys.modules, signal.getsignal(signal.SIGTERM) is heard)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "heard True True\n", done.stderr


@pytest.mark.parametrize("out", [["--out", ""], ["--out="]])
def test_an_empty_path_is_not_the_folder_that_one_is_in(
    out: list[str], street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    done = CliRunner().invoke(app, ["map", str(street), *out])
    assert done.exit_code == 2
    assert done.stderr.startswith("error: an argument is empty\nhint: ")
    assert not list((tmp_path / "here").iterdir())


def test_a_map_takes_no_place_of_the_dataset_that_it_is_made_of(street: Path, tmp_path: Path) -> None:
    before = (street / "images.parquet").read_bytes()
    (tmp_path / "link").symlink_to(street)
    for place, how in (
        (street, "is"),
        (street / ".." / "street", "is"),
        (tmp_path / "link", "is"),
        (tmp_path, "holds"),
    ):
        said = complains("map", street, "--out", tmp_path / "m", "--write-poses", place)
        assert f"{how} the dataset that is read" in said
    inside = tmp_path / "old" / "dataset"  # Where an updated map has its own, which a new one replaces.
    shutil.copytree(street, inside)
    for read in (inside, tmp_path / "old" / "cells" / "street"):
        assert "the dataset that is read" in complains("map", read, "--out", tmp_path / "old")
    assert (street / "images.parquet").read_bytes() == (inside / "images.parquet").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"street", "link", "old"}


def test_an_update_takes_no_place_of_a_dataset_that_it_reads(street: Path, tmp_path: Path) -> None:
    works("map", street, "--out", tmp_path / "map", "--method", "paper")
    shutil.copytree(street, tmp_path / "out" / "dataset")
    update = ("update", tmp_path / "map", "--out", tmp_path / "out")
    inside = tmp_path / "out" / "dataset"
    assert "is the dataset that is read" in complains(*update, "--add", inside)
    assert "is the dataset that is read" in complains(*update, "--add", street, "--dataset", inside)


def test_pictures_of_another_dataset_are_not_exported(street: Path, tmp_path: Path) -> None:
    works("map", street, "--out", tmp_path / "map", "--method", "paper")
    dataset = valuemap.read_dataset(street)
    moved = dataset.detections.replace(image_id=np.roll(dataset.detections.image_id, 1))
    valuemap.write_dataset(dataclasses.replace(dataset, detections=moved), tmp_path / "other")
    export = ("export", tmp_path / "map", tmp_path / "labels.csv")
    assert "is of another image in the dataset" in complains(*export, "--dataset", tmp_path / "other")
    shutil.rmtree(street)
    (tmp_path / "other").rename(street)
    done = CliRunner().invoke(app, [*map(str, export)])
    assert done.exit_code == 0
    assert "cannot be used for pictures and cameras" in done.stderr
    assert "picture_1" not in (tmp_path / "labels.csv").read_text()


def test_notes_on_a_map_are_told_where_it_is_exported(tmp_path: Path) -> None:
    run = {"notes": ["heights mean nothing", "all images are of one pass", "heights mean nothing"]}
    valuemap.write_map(map_of([[0.0, 0.0, 5.0]], run=run), tmp_path / "map")
    done = CliRunner().invoke(app, ["export", str(tmp_path / "map"), str(tmp_path / "labels.csv")])
    assert done.exit_code == 0
    notes = [line for line in done.stderr.splitlines() if line.startswith("note:")]
    assert notes == ["note: heights mean nothing", "note: all images are of one pass"]


def test_a_map_replaces_an_older_one_and_nothing_else(street: Path, tmp_path: Path) -> None:
    works("map", street, "--out", tmp_path / "map", "--method", "paper")
    works("map", street, "--out", tmp_path / "map", "--method", "paper", "--set", "min_votes=5")
    assert valuemap.read_map(tmp_path / "map").run["settings"]["min_votes"] == 5
    (tmp_path / "map" / "thesis.txt").write_text("years of work")
    (tmp_path / "map" / "votes.parquet").write_text("by hand")
    assert "votes.parquet: is not ours to replace" in complains("map", street, "--out", tmp_path / "map")
    assert (tmp_path / "map" / "votes.parquet").read_text() == "by hand"
    works("map", street, "--out", tmp_path / "map", "--method", "paper", "--force")
    assert (tmp_path / "map" / "thesis.txt").read_text() == "years of work"
    works("export", tmp_path / "map", tmp_path / "labels.csv")
    works("export", tmp_path / "map", tmp_path / "labels.csv")
    (tmp_path / "labels.csv").write_text("corrected by hand")
    assert "labels.csv: is not ours to replace" in complains("export", tmp_path / "map", tmp_path / "labels.csv")
    assert (tmp_path / "labels.csv").read_text() == "corrected by hand"
    works("export", tmp_path / "map", tmp_path / "labels.csv", "--force")


def test_bad_input_is_one_line_and_no_map(street: Path, tmp_path: Path) -> None:
    """Truncated Parquet, empty detections, a pose with NaN, a missing dataset."""

    def told(spoiled: Path) -> str:
        line = complains("map", spoiled, "--out", tmp_path / "map")
        assert not (tmp_path / "map").exists()
        assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
        return line

    def copy(name: str) -> Path:
        return Path(shutil.copytree(street, tmp_path / name))

    truncated = copy("truncated")
    content = (truncated / "images.parquet").read_bytes()
    (truncated / "images.parquet").write_bytes(content[: len(content) // 2])
    assert "images.parquet" in told(truncated)

    empty = copy("empty")
    pq.write_table(pq.read_table(empty / "detections.parquet").slice(0, 0), empty / "detections.parquet")
    assert "there are no detections in it" in told(empty)

    nan = copy("nan")
    spoil(nan, "images", "tx", float("nan"))
    assert "images.parquet row 0: tx: expected a finite number, found nan" in told(nan)

    unknown = copy("unknown")
    spoil(unknown, "detections", "image_id", 987654)
    assert "found 987654" in told(unknown)

    assert "is not a dataset: there is no such folder" in told(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    assert "is not a dataset: it is a file" in told(tmp_path / "file")
    assert "neither a dataset nor a map: there is no such folder" in complains("info", tmp_path / "nowhere")


def test_misspelt_settings_are_refused_with_a_suggestion(street: Path, tmp_path: Path) -> None:
    line = complains("map", street, "--out", tmp_path / "map", "--set", "min_vote=4")
    assert "did you mean min_votes?" in line
    assert "expected a whole number" in complains("map", street, "--out", tmp_path / "map", "--set", "min_votes=many")
    assert "expected at least 1e-06" in complains("map", street, "--out", tmp_path / "map", "--set", "max_range_m=-1")


def test_an_option_that_the_method_ignores_is_refused(street: Path, tmp_path: Path) -> None:
    options = ("--out", tmp_path / "map", "--method", "paper", "--calibration", tmp_path / "other")
    line = complains("map", street, *options)
    assert "other: the method paper has no such option, only robust has it" in line
    assert "--method robust" in line
    assert not (tmp_path / "map").exists()


def test_an_unwritable_output_is_found_before_the_work(street: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    assert "cannot be written" in complains("map", street, "--out", tmp_path / "file" / "map")
    assert "is a file" in complains("map", street, "--out", tmp_path / "file")


def test_a_colmap_folder_without_cameras_is_refused(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    (tmp_path / "coco.json").write_text("[]")
    line = complains(
        "import", "colmap", tmp_path / "model", "--detections", tmp_path / "coco.json", "--out", tmp_path / "out"
    )
    assert "cameras" in line


def colmap_model(folder: Path) -> None:
    """Write a model of three images on a line."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
    )
    for i in range(3):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-float(i), 0.0, 0.0]))
        image = pycolmap.Image(name=f"a/{i}.jpg", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pose)
    folder.mkdir()
    model.write_text(folder)


def test_a_coco_file_naming_an_unknown_image_is_refused(tmp_path: Path) -> None:
    colmap_model(tmp_path / "model")
    coco: dict[str, list[dict[str, object]]] = {
        "images": [{"id": 5, "file_name": "a/0.jpg"}, {"id": 6, "file_name": "b/99.jpg"}],
        "categories": [{"id": 1, "name": "light"}],
        "annotations": [
            {"id": 1, "image_id": 5, "category_id": 1, "bbox": [310, 230, 20, 20]},
            {"id": 2, "image_id": 6, "category_id": 1, "bbox": [310, 230, 20, 20]},
        ],
    }
    (tmp_path / "coco.json").write_text(json.dumps(coco))
    command: list[str | Path] = ["import", "colmap", tmp_path / "model", "--detections", tmp_path / "coco.json"]
    command += ["--out", tmp_path / "out"]
    assert "b/99.jpg" in complains(*command)
    assert not (tmp_path / "out").exists()
    coco["annotations"].pop()
    (tmp_path / "coco.json").write_text(json.dumps(coco))
    works(*command)
    dataset = valuemap.read_dataset(tmp_path / "out")
    assert dataset.images.pass_id.names == ("a",)
    np.testing.assert_allclose(dataset.detections.center_px, [[320.0, 240.0]])


def heard_by_default() -> None:
    """Undo what a parent does that ignores signals for its children, as nohup and scripts do."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def cpu_seconds(process: int) -> float:
    """Return how long a process has worked, however busy the machine is."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.fixture
def dense(tmp_path: Path) -> list[str]:
    """A command that works for minutes: one cluster of thousands of detections."""
    scene = random_scene(5, images=200, objects=12, clutter=12000)
    valuemap.write_dataset(as_dataset(scene), tmp_path / "dense")
    command = [*COMMAND, "map", str(tmp_path / "dense"), "--out", str(tmp_path / "map"), "--threads", "1"]
    wide = ["--set", "max_reprojection_error_px=60", "--set", "min_parallax_deg=0.01", "--set", "cluster_radius_m=1000"]
    return [*command, "--method", "paper", *wide]


@pytest.mark.parametrize(
    ("number", "told_first", "code"),
    [
        (signal.SIGINT, "interrupted: nothing was written", 130),
        (signal.SIGTERM, "terminated: nothing was written", 143),
    ],
)
def test_a_signal_to_end_leaves_nothing_behind(
    number: signal.Signals, told_first: str, code: int, dense: list[str], tmp_path: Path
) -> None:
    with subprocess.Popen(
        dense, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heard_by_default
    ) as process:
        while process.poll() is None and cpu_seconds(process.pid) < 1.7:  # Starting takes a second.
            time.sleep(0.05)
        assert process.poll() is None, "the work was too short to be interrupted"
        process.send_signal(number)
        _, told = process.communicate(timeout=60)
    assert process.returncode == code
    assert told.splitlines()[0] == told_first
    assert len(told.splitlines()) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["dense"]


def test_nothing_is_imported_before_a_signal_is_heard() -> None:
    """Up to its first handler the command takes what the interpreter has, as Ctrl-C until then is a traceback."""
    code = """
import os, sys, _signal
before = set(sys.modules)
def heard(number, handler):
    print(*sorted(set(sys.modules) - before), number, flush=True)
    os._exit(0)
_signal.signal = heard
from valuemap.cli import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, preexec_fn=heard_by_default
    )
    assert done.stdout.split() == ["__future__", "valuemap", "valuemap.cli", "valuemap.cli.signals", "2"]


def test_pycolmap_leaves_sigterm_to_who_hears_it() -> None:
    code = """
import os, signal, sys
signal.signal(signal.SIGTERM, lambda *_: os._exit(7))
import valuemap.colmap
assert "pycolmap" in sys.modules
os.kill(os.getpid(), signal.SIGTERM)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (7, "")


def test_a_map_of_pinholes_needs_nothing_that_is_slow_to_import(tmp_path: Path) -> None:
    valuemap.write_dataset(as_dataset(random_scene(5, images=40, objects=6)), tmp_path / "local")
    code = """
import sys
from valuemap.cli import main
try:
    main()
finally:
    assert not {"pyarrow.compute", "pycolmap"} & set(sys.modules)
"""
    command = [
        sys.executable,
        "-c",
        code,
        "map",
        str(tmp_path / "local"),
        "--out",
        str(tmp_path / "map"),
        "--set",
        "correct_poses=0",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("module", ["gc", "valuemap.cli.app", "pyarrow"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_libraries_are_imported_is_one_line(number: signal.Signals, module: str) -> None:
    """The import of the commands is slowed down until the signal is there; `gc` is the first of all."""
    code = """
import builtins, os, signal, sys, valuemap.cli
plain = builtins.__import__
def slow(name, *rest):
    if name.startswith(sys.argv[2]):
        os.kill(os.getpid(), int(sys.argv[1]))
    return plain(name, *rest)
builtins.__import__ = slow
valuemap.cli.main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(int(number)), module],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=heard_by_default,
    )
    what = "interrupted" if number == signal.SIGINT else "terminated"
    assert done.returncode == 128 + number
    assert done.stderr.splitlines() == [
        f"{what}: nothing was written",
        "hint: run the same command again to start over",
    ]
    assert done.stdout == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_commands_are_built_is_one_line(number: signal.Signals) -> None:
    """Of `python -m valuemap`, once all is imported, and Typer makes of it what parses."""
    code = """
import os, runpy, sys, typer.main
plain = typer.main.get_command
def slow(*rest):
    os.kill(os.getpid(), int(sys.argv.pop(1)))
    return plain(*rest)
typer.main.get_command = slow
runpy.run_module("valuemap", run_name="__main__")
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(int(number))],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=heard_by_default,
    )
    what = "interrupted" if number == signal.SIGINT else "terminated"
    assert done.returncode == 128 + number
    assert done.stderr.splitlines()[0] == f"{what}: nothing was written"
    assert len(done.stderr.splitlines()) == 2


def test_the_exit_status_of_ctrl_c_is_ours_where_it_came_in_the_middle_of_an_exec(tmp_path: Path) -> None:
    """Dataclasses are made by one while modules are imported; `python -m` would then end itself with the signal."""
    code = """
import os, signal
from valuemap.cli.signals import end_at_once, end_in_order
end_at_once()
end_in_order()
from valuemap.cli.app import on_interrupt
with on_interrupt("nothing was written", "again"):
    exec("os.kill(os.getpid(), signal.SIGINT)")
"""
    (tmp_path / "stopped.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "-m", "stopped"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=heard_by_default,
    )
    assert (done.returncode, done.stderr) == (130, "interrupted: nothing was written\nhint: again\n")


def test_signals_that_the_parent_ignores_stay_ignored(street: Path, tmp_path: Path) -> None:
    code = """
import os, signal, sys
for number in (signal.SIGINT, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
import valuemap.cli.signals
valuemap.cli.signals.end_at_once()
valuemap.cli.signals.end_in_order()
for number in (signal.SIGINT, signal.SIGHUP):
    os.kill(os.getpid(), number)
valuemap.cli.main()
"""
    done = subprocess.run([sys.executable, "-c", code, "info", str(street)], capture_output=True, check=False)
    assert done.returncode == 0


def test_the_package_offers_what_it_says() -> None:
    for name in valuemap.__all__:
        assert getattr(getattr(valuemap, name), "__name__", name) == name
    assert set(valuemap.__all__) <= set(dir(valuemap))
    with pytest.raises(AttributeError, match="has no attribute 'build_maps'"):
        _ = valuemap.build_maps


def test_a_command_whose_output_is_closed_ends_well() -> None:
    closed = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *COMMAND, "--version"], capture_output=True, check=False)
    assert b"Traceback" not in closed.stderr


_FULL = Path("/dev/full")


@pytest.mark.skipif(not _FULL.exists(), reason="there is no disk that is always full")
def test_output_that_cannot_be_written_is_one_line_once_the_work_is_done(street: Path, tmp_path: Path) -> None:
    with _FULL.open("wb") as full:
        for words in (["import", "--help"], ["map", str(street), "--out", str(tmp_path / "map"), "--method=paper"]):
            done = subprocess.run([*COMMAND, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
            lines = done.stderr.splitlines(keepends=True)
            told = "".join(line for line in lines if not line.startswith(("Wrote ", "note: ")))
            assert "No space left" in one_line_and_a_hint(done.returncode, "", told)
        assert (tmp_path / "map" / "labels.parquet").is_file()
        assert subprocess.run([*COMMAND, "--version"], stderr=full, check=False).returncode == 0


def test_a_reader_that_has_seen_enough_is_no_error(street: Path) -> None:
    for words in (["import", "colmap", "--help"], ["info", str(street)]):
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run([*COMMAND, *words], stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
        os.close(writer)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "words",
    [
        "report MAP --out r.html --radius -1",
        "report MAP --out r.html --radius nan",
        "evaluate MAP --truth t.csv --radius 0",
        "evaluate MAP --truth t.csv --truth-sigma -0.1",
        "report MAP --out r.html --seen-within 0",
        "experiment passes DATA --out e --radius 1e9",
        "map DATA --out m --tile-size 0",
        "update MAP DATA --out m --tile-size -5",
        "import colmap MODEL --out d --max-rejected 1.5",
        "import tum T.txt --camera X --out d --longest-gap -1",
        "import kitti K --out d --anchor 1 2 3 --heading 400",
        "detect DATA --min-score 2",
        "evaluate-detections DATA --labels coco:x --min-height -1",
    ],
)
def test_a_number_that_cannot_be_is_a_wrong_use_of_its_option(words: str) -> None:
    """Nothing is read: no file that is named is there."""
    option = [word for word in words.split() if word.startswith("--")][-1]
    done = CliRunner().invoke(app, words.split())
    assert (done.exit_code, done.stdout) == (2, "")
    error, hint = done.stderr.splitlines()
    assert error.startswith(f"error: Invalid value for '{option}'")
    assert hint.startswith("hint: ")
