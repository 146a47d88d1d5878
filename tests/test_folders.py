"""Writing folders and files: whole or not at all, and never over what is not ours."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from valuemap import folders
from valuemap.errors import OutputError
from valuemap.folders import LEDGER, check_files, check_place, new_file, new_folder, remove_file, settle, take_over
from valuemap.system import folder_lock

MARKER = "run.json"
PARTS = (MARKER, "labels.parquet")


def write_folder(path: Path, text: str) -> None:
    with new_folder(path, parts=PARTS) as folder:
        (folder / MARKER).write_text(text)
        (folder / "inner").mkdir()
        (folder / "inner" / "data").write_text(text)


def content(path: Path) -> dict[str, str]:
    """Return the texts of all files, without what says which of them are ours."""
    files = (p for p in path.rglob("*") if p.is_file() and p.name != LEDGER)
    return {str(p.relative_to(path)): p.read_text() for p in files}


def test_a_folder_and_its_parents_are_made(tmp_path: Path) -> None:
    write_folder(tmp_path / "a" / "b", "new")
    assert content(tmp_path) == {"a/b/run.json": "new", "a/b/inner/data": "new"}


def test_nothing_is_there_before_the_end(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out", parts=PARTS) as folder:
        (folder / MARKER).write_text("new")
        assert not (tmp_path / "out").exists()
    assert content(tmp_path / "out") == {MARKER: "new"}


def test_an_empty_folder_and_an_older_one_of_ours_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with new_folder(tmp_path / "out", parts=PARTS) as folder:
        for name in PARTS:
            (folder / name).write_text("old")
    write_folder(tmp_path / "out", "new")
    # What a new one does not have must not stay beside it.
    assert content(tmp_path) == {"out/run.json": "new", "out/inner/data": "new"}


@pytest.mark.parametrize("exception", [RuntimeError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("has_older", [True, False])
def test_an_interrupted_folder_leaves_everything_as_it_was(
    exception: type[BaseException], has_older: bool, tmp_path: Path
) -> None:
    if has_older:
        write_folder(tmp_path / "out", "old")
    before = content(tmp_path)
    with pytest.raises(exception), new_folder(tmp_path / "out", parts=PARTS) as folder:
        (folder / MARKER).write_text("half")
        raise exception
    assert content(tmp_path) == before
    assert (tmp_path / "out").exists() == has_older
    assert len(list(tmp_path.iterdir())) == int(has_older)


def test_an_interrupt_between_two_renames_ends_with_the_new_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_folder(tmp_path / "out", "old")
    replace = Path.replace
    interrupts = iter([False, True])

    def interrupted(self: Path, target: Path) -> Path:
        if next(interrupts, False):
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path / "out", "new")
    assert content(tmp_path) == {"out/run.json": "new", "out/inner/data": "new"}
    assert [p.name for p in (tmp_path / "out").iterdir() if p.is_dir()] == ["inner"]


def killed_while_writing(out: Path, point: str) -> None:
    """Write a folder in a process that kills itself before the first rename of that kind."""
    code = f"""
import os, pathlib, signal, valuemap.folders
def killed(self, target):
    os.kill(os.getpid(), signal.SIGKILL)
pathlib.Path.{point} = killed
with valuemap.folders.new_folder(pathlib.Path({str(out)!r}), parts={PARTS!r}) as folder:
    (folder / "run.json").write_text("new")
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL


@pytest.mark.parametrize(("point", "after"), [("rename", "old"), ("replace", "new")])
def test_a_crash_leaves_the_old_or_the_new_folder(point: str, after: str, tmp_path: Path) -> None:
    """Before the decision (one rename of a folder) it is the old one, from then on the new one."""
    with new_folder(tmp_path / "out", parts=PARTS) as folder:
        for name in PARTS:
            (folder / name).write_text("old")
    killed_while_writing(tmp_path / "out", point)
    settle(tmp_path / "out")
    assert content(tmp_path / "out") == dict.fromkeys(PARTS, "old") if after == "old" else {MARKER: "new"}
    write_folder(tmp_path / "out", "newer")
    assert content(tmp_path / "out") == {MARKER: "newer", "inner/data": "newer"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == {MARKER, "inner", LEDGER}


def test_what_a_crash_left_beside_is_cleaned_up(tmp_path: Path) -> None:
    killed_while_writing(tmp_path / "out", "replace")
    assert not (tmp_path / "out").exists()
    assert len(list(tmp_path.iterdir())) == 1
    write_folder(tmp_path / "out", "new")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_what_another_process_is_writing_is_left_alone(tmp_path: Path) -> None:
    write_folder(tmp_path / "out", "old")
    with new_folder(tmp_path / "out", parts=PARTS) as folder:
        (folder / MARKER).write_text("new")
        settle(tmp_path / "out")
        assert (folder / MARKER).read_text() == "new"
    assert content(tmp_path / "out")[MARKER] == "new"


def test_files_of_somebody_else_stay(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("beach")
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "notes").write_text("mine")
    for text in ("old", "new"):
        write_folder(tmp_path, text)
        expected = {"holiday.jpg": "beach", "inner/notes": "mine", MARKER: text, "inner/data": text}
        assert content(tmp_path) == expected


@pytest.mark.parametrize("name", [*PARTS, "inner/data"])
@pytest.mark.parametrize("was_ours", [True, False])
def test_a_file_of_somebody_else_is_replaced_by_force_only(tmp_path: Path, name: str, was_ours: bool) -> None:
    """One of ours that somebody changed is somebody's. Nor may a foreign part stay beside those of a new set."""
    if was_ours:
        write_folder(tmp_path, "old")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    before = content(tmp_path)
    with pytest.raises(OutputError, match=f"{name}: is not ours to replace") as refusal:
        write_folder(tmp_path, "new")
    assert "--force" in refusal.value.hint
    assert content(tmp_path) == before
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".valuemap-new")]
    if name in PARTS:
        with pytest.raises(OutputError, match="is not ours to replace"):
            check_place(tmp_path, parts=PARTS)
    with new_folder(tmp_path, parts=PARTS, force=True) as folder:
        (folder / MARKER).write_text("forced")
        (folder / "inner").mkdir()
        (folder / "inner" / "data").write_text("forced")
    assert content(tmp_path) == {MARKER: "forced", "inner/data": "forced"}


def test_of_folders_of_parts_only_what_is_ours_goes(tmp_path: Path) -> None:
    write_folder(tmp_path, "old")
    with new_file(tmp_path / "images" / "ours.jpg") as path:
        path.write_text("ours")
    with new_file(tmp_path / "images" / "changed.jpg") as path:
        path.write_text("ours")
    (tmp_path / "images" / "changed.jpg").write_text("retouched")
    (tmp_path / "images" / "mine.jpg").write_text("mine")
    with new_folder(tmp_path, parts=PARTS, part_folders=("images",)) as folder:
        (folder / MARKER).write_text("new")
    assert content(tmp_path / "images") == {"changed.jpg": "retouched", "mine.jpg": "mine"}


def test_a_link_to_a_folder_is_followed_and_stays(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    for text in ("old", "new"):
        write_folder(tmp_path / "out", text)
    assert (tmp_path / "out").is_symlink()
    assert content(tmp_path / "disk") == {MARKER: "new", "inner/data": "new"}


def test_no_link_leads_out(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputError, match="out: is a link to nothing"):
        write_folder(tmp_path / "out", "new")
    (tmp_path / "out").unlink()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / MARKER).symlink_to(tmp_path / "precious")
    with pytest.raises(OutputError, match="is not ours to replace"):
        write_folder(tmp_path / "out", "new")
    (tmp_path / "out" / MARKER).unlink()
    (tmp_path / "out" / "inner").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="inner/data: leads out of"):
        write_folder(tmp_path / "out", "new")
    (tmp_path / "out" / LEDGER).symlink_to(tmp_path / "precious")
    with pytest.raises(OutputError, match="cannot be written"), new_file(tmp_path / "out" / "a.csv") as path:
        path.write_text("new")
    assert (tmp_path / "precious").read_text() == "mine"
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_ledger_that_names_files_elsewhere_removes_none(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    out = tmp_path / "out"
    (out / "images").mkdir(parents=True)
    digest = hashlib.sha256(b"mine").hexdigest()
    for folder in (out, out / "images"):
        (folder / LEDGER).write_text(f"{digest}  ../precious\n{digest}  ../../precious\n{digest}  ..\nrubbish\n")
    workspace = out / ".valuemap-new-evil"
    (workspace / "decided").mkdir(parents=True)
    (workspace / "stale").write_bytes(b"../precious\0" + str(tmp_path / "precious").encode())
    with new_folder(out, parts=PARTS, part_folders=("images",)) as fresh:
        (fresh / MARKER).write_text("new")
    assert (tmp_path / "precious").read_text() == "mine"


def test_the_ledger_is_one_that_sha256sum_checks(tmp_path: Path) -> None:
    write_folder(tmp_path, "new")
    assert (tmp_path / LEDGER).read_text() == f"{hashlib.sha256(b'new').hexdigest()}  {MARKER}\n"


@pytest.mark.parametrize("has_older", [True, False])
def test_files_that_are_taken_over_are_not_hashed_again(
    has_older: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_folder(tmp_path / "first", "same")
    if has_older:
        write_folder(tmp_path / "second", "older")
    hashed: list[str] = []
    hash_of = folders._sha256
    monkeypatch.setattr(folders, "_sha256", lambda path: hashed.append(path.name) or hash_of(path))  # type: ignore[func-returns-value]
    (tmp_path / "foreign").write_text("of nobody")
    with new_folder(tmp_path / "second", parts=PARTS, part_folders=["inner"]) as folder:
        (folder / "new").write_text("new")
        hashed.clear()
        take_over(
            {
                tmp_path / "first" / MARKER: folder / MARKER,
                tmp_path / "first" / "inner" / "data": folder / "inner" / "data",
                tmp_path / "foreign": folder / "foreign",
            }
        )
    monkeypatch.undo()
    # What is in the place of an older one is hashed to see whether that is ours.
    assert [name for name in hashed if name in ("new", "foreign")] == ["foreign", "new"]
    assert has_older or len(hashed) == 2
    for place in (tmp_path / "second", tmp_path / "second" / "inner"):
        subprocess.run(["sha256sum", "--check", "--strict", LEDGER], cwd=place, check=True)


def test_what_was_changed_before_it_was_taken_over_is_not_ours(tmp_path: Path) -> None:
    write_folder(tmp_path / "first", "same")
    (tmp_path / "first" / MARKER).write_text("changed")
    with new_folder(tmp_path / "second", parts=PARTS) as folder:
        take_over({tmp_path / "first" / MARKER: folder / MARKER})
    with pytest.raises(OutputError, match="not ours to replace"):
        check_files(tmp_path / "second", PARTS)


def test_a_ledger_does_not_grow_with_each_set_of_files(tmp_path: Path) -> None:
    def lines(*places: str) -> list[int]:
        return [len((tmp_path / place / LEDGER).read_text(encoding="utf-8").splitlines()) for place in places]

    for number in range(4):
        with new_folder(tmp_path / "out", parts=("a", "b"), part_folders=("of",)) as folder:
            (folder / "of").mkdir()
            for name in ("a", "of/c", f"of/{number}"):
                (folder / name).write_text(f"{name} {number}", encoding="utf-8")
    assert lines("out", "out/of") == [1, 2]
    subprocess.run(["sha256sum", "--check", "--strict", LEDGER], cwd=tmp_path / "out/of", check=True)
    # What somebody else has noted, and is about to put in place, stays noted.
    (tmp_path / "out" / ".valuemap-new-other").mkdir()
    with (
        folder_lock(tmp_path / "out" / ".valuemap-new-other"),
        new_folder(tmp_path / "out", parts=("a", "b"), part_folders=("of",)) as folder,
    ):
        (folder / "a").write_text("new", encoding="utf-8")
    assert lines("out") == [2]


def test_a_file_in_the_place_of_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match="out: is a file, a folder is to be written there") as refusal:
        write_folder(tmp_path / "out", "new")
    assert refusal.value.hint == "choose another folder"  # The option is not called --out everywhere.
    assert content(tmp_path) == {"out": "mine"}


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot be written: ") as refusal:
        write_folder(tmp_path / "file" / "out", "new")
    assert "permissions" in refusal.value.hint
    with (
        pytest.raises(OutputError, match="cannot be written: "),
        new_file(tmp_path / "file" / "out.csv") as path,
    ):
        path.write_text("new")
    with pytest.raises(OutputError, match="cannot be written: "), new_file(tmp_path / ("x" * 300)) as path:
        path.write_text("new")
    assert content(tmp_path) == {"file": "mine"}


def test_a_full_disk_while_writing_is_an_output_error(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match="cannot be written: No space left"),
        new_file(tmp_path / "a.csv") as path,
    ):
        path.write_text("half")
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_written_whole(tmp_path: Path) -> None:
    for text in ("old", "new"):
        with new_file(tmp_path / "a" / "labels.csv") as path:
            assert path.suffix == ".csv"
            path.write_text(text)
        assert content(tmp_path) == {"a/labels.csv": text}


@pytest.mark.parametrize("exception", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_file_leaves_the_older_one(exception: type[BaseException], tmp_path: Path) -> None:
    with new_file(tmp_path / "labels.csv") as path:
        path.write_text("old")
    with pytest.raises(exception), new_file(tmp_path / "labels.csv") as path:
        path.write_text("half")
        raise exception
    assert content(tmp_path) == {"labels.csv": "old"}


def test_a_file_of_somebody_else_is_refused_but_by_force(tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    path.write_text("mine")
    with pytest.raises(OutputError, match=r"labels\.csv: is not ours to replace"), new_file(path) as fresh:
        fresh.write_text("new")
    with pytest.raises(OutputError, match="is not ours to replace"):
        check_files(tmp_path, ["labels.csv"])
    with pytest.raises(OutputError, match="is not ours to replace"):
        remove_file(path)
    assert content(tmp_path) == {"labels.csv": "mine"}
    with new_file(path, force=True) as fresh:
        fresh.write_text("forced")
    with new_file(path) as fresh:
        fresh.write_text("ours by now")
    assert content(tmp_path) == {"labels.csv": "ours by now"}
    remove_file(path)
    remove_file(path)
    assert content(tmp_path) == {}


def test_a_link_or_a_pipe_in_the_place_of_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "target.csv").write_text("mine")
    (tmp_path / "link.csv").symlink_to(tmp_path / "target.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    for force in (True, False):
        with pytest.raises(OutputError, match="is a link"), new_file(tmp_path / "link.csv", force=force) as path:
            path.write_text("new")
        refused = pytest.raises(OutputError, match=r"pipe\.csv: is a pipe, a socket or a device, not a file")
        with refused, new_file(tmp_path / "pipe.csv", force=force) as path:
            path.write_text("new")
        with refused:
            remove_file(tmp_path / "pipe.csv", force=force)
        with refused, new_folder(tmp_path, parts=("pipe.csv",), force=force):
            pass
    assert (tmp_path / "pipe.csv").is_fifo()
    assert (tmp_path / "target.csv").read_text() == "mine"


def test_a_name_with_a_line_break_is_refused_as_it_is_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as refusal, new_file(tmp_path / "two\nlines.csv") as path:
        path.write_text("new")
    assert str(refusal.value) == f"{tmp_path}/two\\nlines.csv: a line break in a name cannot be kept on record"
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_the_place_of_a_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder, a file is to be written there"), new_file(tmp_path):
        pass


@pytest.mark.parametrize("force", [False, True])
def test_a_map_is_not_written_over_a_dataset_nor_the_other_way_round(tmp_path: Path, force: bool) -> None:
    """Both have a table of what was left out, under one name."""
    datasets = ("dataset.json", "rejected.parquet")
    with new_folder(tmp_path / "data", parts=datasets) as folder:
        (folder / "dataset.json").write_text("given")
    write_folder(tmp_path / "map", "given")
    before = content(tmp_path)
    for path, parts in ((tmp_path / "data", PARTS), (tmp_path / "map", datasets)):
        with pytest.raises(OutputError, match=r"holds a (dataset|map), which would be lost") as refusal:
            check_place(path, parts=parts, force=force)
        assert refusal.value.hint == "choose another folder"
    assert content(tmp_path) == before
