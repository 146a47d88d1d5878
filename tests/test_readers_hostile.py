"""Every reader against every kind of bad file: one clear line, and nothing outside its folder."""

from __future__ import annotations

import gzip
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import test_readers_detections as boxes_of
from reading import SPOILS, refusal, spoiled, write
from test_hostile import ALIAS_BOMB
from test_readers import model_of, write_model
from test_readers_formats import FORMATS
from test_readers_pictures import picture, tags
from valuemap.readers import READERS
from valuemap.readers.bearings import read_bearings
from valuemap.readers.colmap import read_colmap
from valuemap.readers.csv_poses import read_csv_poses
from valuemap.readers.detections import DETECTIONS
from valuemap.readers.pictures import read_pictures
from valuemap.readers.ros import read_ros

ENTITY_BOMB = (
    '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY a{i} "{"&a{};".format(i - 1 if i > 1 else "") * 10}">' for i in range(1, 10))
    + "]><annotations><image name='&a9;'/></annotations>"
)
DEEP = "[" * 100_000


@dataclass(frozen=True)
class Case:
    """How a reader's files are made, which of them is spoiled, and how they are read."""

    make: Callable[[Path], Any]
    file: str
    read: Callable[[Path], Any]


def colmap_in(folder: Path) -> None:
    write_model(model_of("PINHOLE", names=("a/0.jpg", "a/1.jpg")), folder / "model")


def bag_in(folder: Path) -> None:
    pytest.importorskip("rosbags", reason="the package rosbags is not installed: pip install 'valuemap[ros]'")
    from test_readers_ros import write_bag

    folder.mkdir(parents=True)
    write_bag(folder / "bag")


def pictures_in(folder: Path) -> None:
    picture(folder / "1.jpg", tags(52.0, 4.0, GPSImgDirection=90.0, FocalLengthIn35mmFilm=36))


def boxes_case(kind: str) -> Case:
    file = {"yolo": "labels/a/1.txt", "coco": "boxes.json", "cvat": "annotations.xml", "bosch": "train.yaml"}
    file |= {"voc": "1.xml", "labelme": "1.json", "via": "via.json"}
    place = {"yolo": "labels"}
    name = file.get(kind, "boxes.csv")
    return Case(
        lambda folder: boxes_of.detections_in(folder, kind),
        name,
        lambda folder: boxes_of.read(folder, folder / place.get(kind, name)),
    )


def csv_in(folder: Path) -> Path:
    return write(folder / "poses.csv", "image,lat,lon,heading_deg\na.jpg,52,4,1\nb.jpg,52.0001,4,1\n")


CASES: dict[str, Case] = {
    **{name: Case(make, files[0], read) for name, (make, read, files) in FORMATS.items()},
    "colmap": Case(colmap_in, "model/images.bin", lambda folder: read_colmap(folder / "model")),
    "csv": Case(
        csv_in,
        "poses.csv",
        lambda folder: read_csv_poses(folder / "poses.csv", camera="PINHOLE 640 480 500 500 320 240"),
    ),
    "bearings": Case(
        lambda folder: write(folder / "bearings.csv", "lat,lon,bearing\n52,4,3\n52.0001,4,9\n"),
        "bearings.csv",
        lambda folder: read_bearings(folder / "bearings.csv"),
    ),
    "ros": Case(bag_in, "bag/metadata.yaml", lambda folder: read_ros([folder / "bag"], longest_gap_s=1.0)),
    "pictures": Case(pictures_in, "1.jpg", partial(read_pictures, poses="exif")),
    **{f"boxes {kind}": boxes_case(kind) for kind in DETECTIONS},
}


def made(name: str, tmp_path: Path) -> tuple[Path, Case]:
    folder = tmp_path / "data"
    CASES[name].make(folder)
    return folder, CASES[name]


def test_every_reader_is_in_the_table() -> None:
    assert set(CASES) == set(READERS) | {f"boxes {kind}" for kind in DETECTIONS}


@pytest.mark.parametrize("name", CASES)
def test_whole_files_are_read(name: str, tmp_path: Path) -> None:
    folder, case = made(name, tmp_path)
    assert len(case.read(folder).images) > 0


@pytest.mark.parametrize("how", SPOILS)
@pytest.mark.parametrize("name", CASES)
def test_bad_files_are_refused_in_one_line(name: str, how: str, tmp_path: Path) -> None:
    folder, case = made(name, tmp_path)
    spoiled(folder / case.file, how)
    if name == "boxes yolo" and how in ("empty", "absent", "pipe", "folder"):
        return  # A picture without boxes has such a file, or none.
    refusal(lambda: case.read(folder))


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if not case.file.endswith((".csv", "1.txt"))])
def test_files_cut_in_the_middle_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    folder, case = made(name, tmp_path)
    spoiled(folder / case.file, "cut")
    refusal(lambda: case.read(folder))


def bomb_for(suffix: str) -> bytes | None:
    """What is small on disk and large once it is read, for a kind of file."""
    texts = {".json": DEEP, ".yaml": ALIAS_BOMB, ".xml": ENTITY_BOMB}
    if suffix == ".csv":
        return gzip.compress(b"image,lat,lon,heading_deg\n" + bytes(300_000_000), 1)
    return texts[suffix].encode() if suffix in texts else None


@pytest.mark.parametrize(
    "name", [name for name, case in CASES.items() if case.file.endswith((".json", ".yaml", ".xml"))]
)
def test_bombs_do_not_go_off(name: str, tmp_path: Path) -> None:
    folder, case = made(name, tmp_path)
    bomb = bomb_for(Path(case.file).suffix)
    assert bomb is not None
    (folder / case.file).write_bytes(bomb)
    refusal(lambda: case.read(folder))


def test_a_packed_file_that_unpacks_to_far_more_is_refused(tmp_path: Path) -> None:
    folder, case = made("csv", tmp_path)
    bomb = bomb_for(".csv")
    assert bomb is not None
    (folder / case.file).write_bytes(bomb)
    assert "unpacks to more than" in refusal(lambda: case.read(folder))
    rows = "\n".join(f"{i}.jpg,52,{4 + i * 1e-5},1" for i in range(2000))
    (folder / case.file).write_bytes(gzip.compress(f"image,lat,lon,heading_deg\n{rows}\n".encode()))
    assert len(case.read(folder).images) == 2000


@pytest.mark.parametrize("bad", ["../../etc/passwd", "/etc/passwd", "a/../../b.jpg", "C:\\a.jpg"])
@pytest.mark.parametrize("name", ["csv", "colmap", "bearings", "boxes csv"])
def test_names_lead_nowhere(name: str, bad: str, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    if name == "csv":
        csv_in(folder).write_text(f"image,lat,lon,heading_deg\n{bad},52,4,1\n")
    elif name == "colmap":
        write_model(model_of("PINHOLE", names=(bad, "b.jpg")), folder / "model")
    elif name == "bearings":
        write(folder / "bearings.csv", f"image,lat,lon,bearing\n{bad},52,4,3\n")
    else:
        boxes_of.detections_in(folder, "csv").write_text(f"image,x1,y1,x2,y2\n{bad},1,1,5,5\n")
    said = refusal(lambda: CASES[name].read(folder))
    assert "stays in the folder" in said or "path in the folder" in said or "cannot be used" in said


@pytest.mark.parametrize("name", ["pictures", "boxes yolo"])
def test_links_and_pipes_in_folders_are_not_followed(name: str, tmp_path: Path) -> None:
    folder, case = made(name, tmp_path)
    path = folder / case.file
    spoiled(path, "link", outside=tmp_path)
    said = refusal(lambda: case.read(folder))
    assert "link" in said or "no detections" in said
    path.unlink()
    os.mkfifo(path)
    refusal(lambda: case.read(folder))


def test_a_hostile_text_comes_out_on_one_line(tmp_path: Path) -> None:
    folder, case = made("boxes coco", tmp_path)
    content = json.loads((folder / case.file).read_text())
    content["images"][0]["file_name"] = "a\n\x1b[31mb.jpg"
    (folder / case.file).write_text(json.dumps(content))
    assert "\x1b" not in refusal(lambda: case.read(folder))
