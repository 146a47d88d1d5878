"""Import commands: every reader has one, and options reach the reader."""

from __future__ import annotations

from pathlib import Path

import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from reading import write
from valuemap.cli.app import app
from valuemap.cli.import_ import READERS as COMMANDS
from valuemap.dataset import read_dataset
from valuemap.readers import READERS


def test_every_reader_has_a_command() -> None:
    assert sorted(COMMANDS) == sorted(READERS)


@pytest.mark.parametrize("name", sorted(READERS))
def test_every_command_says_what_it_takes(name: str) -> None:
    said = CliRunner().invoke(app, ["import", name, "--help"], env={"COLUMNS": "200"})
    assert said.exit_code == 0, said.output
    assert "--out" in said.output
    assert ("--detections-format" in said.output) == (name != "bearings")


def test_options_of_poses_and_detections_reach_the_reader(tmp_path: Path) -> None:
    poses = write(tmp_path / "poses.csv", "name,lat,lon,yaw,drive\na.jpg,52,4,0.5,mon\nb.jpg,52,4.0001,0.5,tue\n")
    boxes = write(tmp_path / "boxes.txt", "file,u,v,confidence\na.jpg,0.25,0.5,50\n")
    options = {
        "--camera": "PINHOLE 640 480 500 500 319.5 239.5",
        "--pixel-center": "0",
        "--column": ("image=name", "yaw_rad=yaw", "pass=drive"),
        "--detections": str(boxes),
        "--detections-format": "csv",
        "--detection-column": ("image=file", "x=u", "y=v", "score=confidence"),
        "--fractions": (),
        "--full-score": "100",
        "--class": "ramp",
        "--camera-height": "2.5",
    }
    arguments = ["import", "csv", str(poses), "--out", str(tmp_path / "out")]
    for name, values in options.items():
        if values == ():
            arguments.append(name)
        for value in (values,) if isinstance(values, str) else values:
            arguments += [name, value]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    dataset = read_dataset(tmp_path / "out")
    assert dataset.name == "out", "called like its folder, not like one of the files that it is made of"
    assert dataset.cameras.params[0].tolist() == [500, 500, 320, 240]
    assert dataset.images.pass_id.texts() == ["mon", "tue"]
    assert_allclose(dataset.detections.center_px, [[160.0, 240.0]])
    assert dataset.detections.score.tolist() == [0.5]
    assert dataset.detections.class_name.texts() == ["ramp"]
    assert dataset.frame.anchor == (52.0, 4.0, 2.5)


def test_bearings_from_the_command_line(tmp_path: Path) -> None:
    table = write(tmp_path / "b.csv", "lat,lon,bearing,depth\n52,4,10,5\n52,4.0001,350,5\n")
    arguments = [
        "import",
        "bearings",
        str(table),
        "--out",
        str(tmp_path / "out"),
        "--class",
        "light",
        "--depth-sigma",
        "0.1",
    ]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    dataset = read_dataset(tmp_path / "out")
    assert dataset.detections.range_sigma_m is not None
    assert_allclose(dataset.detections.range_sigma_m, [0.5, 0.5])


def test_options_of_detections_need_some(tmp_path: Path) -> None:
    poses = write(tmp_path / "p.csv", "image,lat,lon,heading_deg\na.jpg,52,4,0\n")
    arguments = ["import", "csv", str(poses), "--camera", "EQUIRECTANGULAR 64 32", "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    for option in (["--class", "light"], ["--fractions"], ["--full-score", "100"], ["--detection-column", "x=a"]):
        done = CliRunner().invoke(app, [*arguments, *option])
        assert done.exit_code == 1
        assert "options say how to read a file of them, and there is none" in done.stderr
