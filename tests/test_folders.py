"""Writing folders and files: whole or not at all, and never over what is not ours."""

from __future__ import annotations

from pathlib import Path

import pytest

from valuemap.errors import OutputError
from valuemap.folders import new_file, new_folder

MARKER = "run.json"


def write_folder(path: Path, text: str) -> None:
    with new_folder(path, marker=MARKER) as folder:
        (folder / MARKER).write_text(text)
        (folder / "inner").mkdir()
        (folder / "inner" / "data").write_text(text)


def content(path: Path) -> dict[str, str]:
    return {str(p.relative_to(path)): p.read_text() for p in path.rglob("*") if p.is_file()}


def test_a_folder_and_its_parents_are_made(tmp_path: Path) -> None:
    write_folder(tmp_path / "a" / "b", "new")
    assert content(tmp_path) == {"a/b/run.json": "new", "a/b/inner/data": "new"}


def test_nothing_is_there_before_the_end(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out", marker=MARKER) as folder:
        (folder / MARKER).write_text("new")
        assert not (tmp_path / "out").exists()
    assert content(tmp_path / "out") == {MARKER: "new"}


def test_an_empty_folder_and_an_older_one_of_ours_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_folder(tmp_path / "out", "old")
    (tmp_path / "out" / "report.html").write_text("old")
    write_folder(tmp_path / "out", "new")
    assert content(tmp_path) == {"out/run.json": "new", "out/inner/data": "new"}


@pytest.mark.parametrize("exception", [RuntimeError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("has_older", [True, False])
def test_an_interrupted_folder_leaves_everything_as_it_was(
    exception: type[BaseException], has_older: bool, tmp_path: Path
) -> None:
    if has_older:
        write_folder(tmp_path / "out", "old")
    before = content(tmp_path)
    with pytest.raises(exception), new_folder(tmp_path / "out", marker=MARKER) as folder:
        (folder / MARKER).write_text("half")
        raise exception
    assert content(tmp_path) == before
    assert (tmp_path / "out").exists() == has_older
    assert len(list(tmp_path.iterdir())) == int(has_older)


def test_an_interrupt_while_the_folders_change_places_leaves_the_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_folder(tmp_path / "out", "old")
    replace = Path.replace

    def interrupted(self: Path, target: Path) -> Path:
        if self.name == "fresh":
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path / "out", "new")
    assert content(tmp_path) == {"out/run.json": "old", "out/inner/data": "old"}


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("beach")
    with pytest.raises(OutputError, match=r"is a folder without run\.json") as refusal:
        write_folder(tmp_path, "new")
    assert "choose another --out" in refusal.value.hint
    assert content(tmp_path) == {"holiday.jpg": "beach"}


def test_a_file_in_the_place_of_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match="out: is a file, a folder is to be written there"):
        write_folder(tmp_path / "out", "new")
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
    (tmp_path / "labels.csv").write_text("old")
    with pytest.raises(exception), new_file(tmp_path / "labels.csv") as path:
        path.write_text("half")
        raise exception
    assert content(tmp_path) == {"labels.csv": "old"}


def test_a_folder_in_the_place_of_a_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder, a file is to be written there"), new_file(tmp_path):
        pass
