"""Input that is damaged or made to harm: one clear line, no traceback, no hang, nothing outside the folder."""

from __future__ import annotations

import gzip
import json
import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pyarrow as pa
import pytest
from onnx import TensorProto, helper, numpy_helper
from typer.testing import CliRunner

import valuemap
from small_dataset import map_of, rewrite, small_dataset, with_column, with_value
from test_cli import complains, start
from valuemap.cli.commands import app
from valuemap.config import MAX_THREADS, DetectConfig, MapConfig, bounded_threads, describe_settings
from valuemap.dataset import read_dataset, read_images, write_dataset
from valuemap.detect.labels import read_labels
from valuemap.detect.model import load_model
from valuemap.detect.pictures import UnusablePicture, read_picture
from valuemap.errors import InputError, SettingError
from valuemap.evaluate import evaluate_map
from valuemap.evaluate.truth import TrueObjects, read_truth
from valuemap.map_folder import read_map, write_map
from valuemap.pipeline import build_map
from valuemap.summary import summarize_map
from valuemap.tables import Categories
from valuemap.yaml_text import load_yaml


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_dataset(small_dataset(), tmp_path / "city")
    return tmp_path / "city"


# Names.


def runs(*arguments: str | Path) -> str:
    """Run a command in this process, which must go well; return what it printed."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("name", ["[/]", "[bold]x[/bold]", ":smile:"])
def test_names_are_not_taken_for_markup(name: str, tmp_path: Path) -> None:
    dataset = small_dataset()
    detections = dataset.detections.replace(class_name=Categories.from_texts([name] * 5))
    write_dataset(replace(dataset, name=name, detections=detections), tmp_path / "[/]" / "city")
    told = runs("info", tmp_path / "[/]" / "city")
    assert f"dataset {name}" in " ".join(told.split())
    runs("map", tmp_path / "[/]" / "city", "--out", tmp_path / "[/]" / "map")
    runs("info", tmp_path / "[/]" / "map")


def test_a_folder_whose_name_is_not_utf8_can_be_used(tmp_path: Path) -> None:
    place = tmp_path / os.fsdecode(b"caf\xe9")
    dataset = small_dataset()
    write_dataset(replace(dataset, name=place.name), place)
    assert read_dataset(place).name == place.name
    done = start("info", place)  # What is printed then has to be printed by a process of its own.
    assert done.returncode == 0, done.stderr
    assert "caf" in done.stdout


def test_a_text_that_is_no_unicode_is_refused() -> None:
    with pytest.raises(InputError, match=r"'\\udcff.jpg': cannot be written as UTF-8"):
        Categories.from_texts(["\udcff.jpg"])


@pytest.mark.parametrize(
    "name",
    [
        "../secret.jpg",
        "/etc/passwd",
        "a/../../secret.jpg",
        "..",
        "a/..",
        "a\0b",
        "C:a.jpg",
        r"\\host\a.jpg",
        r"a\..\b.jpg",
    ],
)
def test_names_of_images_that_lead_out_are_refused(name: str, folder: Path) -> None:
    rewrite(folder / "images.parquet", with_value("name", 1, name))
    for read in (read_dataset, read_images):
        with pytest.raises(InputError, match=r"row with image_id 20: name: expected a path in the folder") as caught:
            read(folder)
        assert "without .." in caught.value.hint
    rewrite(folder / "images.parquet", with_value("name", 1, "..a/b..jpg"))
    assert len(read_dataset(folder).images) == 4


# JSON and YAML.


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"counts": []}, "counts: expected an object, found []"),
        ({"settings": "robust"}, "settings: expected an object, found 'robust'"),
        ({"stages": {"a": 1}}, "stages: expected a list"),
        ({"stages": [1]}, "stages: expected objects with seconds, found 1"),
        ({"stages": [{"seconds": "long"}]}, "stages: expected objects with seconds"),
        ({"dataset": 5}, "dataset: expected a text, found 5"),
        ({"notes": None}, "notes: expected a list, found None"),
        ({"frame": None}, "frame: expected"),
    ],
)
def test_a_damaged_record_of_a_map_is_named(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    write_map(map_of([[0.0, 0.0, 0.0]]), tmp_path / "map")
    path = tmp_path / "map" / "run.json"
    record = {**json.loads(path.read_text()), **change}
    path.write_text(json.dumps(record))
    with pytest.raises(InputError) as caught:
        summarize_map(read_map(tmp_path / "map"))
    assert f"run.json: {said}" in str(caught.value)


@pytest.mark.parametrize("content", [b"[" * 100_000, b"{", b"null", b'"text"', b"[]", b"\xff"])
def test_a_record_that_is_none_is_named(content: bytes, tmp_path: Path) -> None:
    write_map(map_of([[0.0, 0.0, 0.0]]), tmp_path / "map")
    (tmp_path / "map" / "run.json").write_bytes(content)
    with pytest.raises(InputError, match=r"run\.json: (cannot be read as JSON|expected a JSON object)"):
        read_map(tmp_path / "map")


ALIAS_BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 40)]
)


def test_yaml_with_aliases_is_refused_and_stars_in_texts_are_not(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"has an alias, \*a0"):
        load_yaml(ALIAS_BOMB.encode())
    with pytest.raises(ValueError, match="nested more than 200 deep"):
        load_yaml(b"[" * 100_000)
    assert load_yaml(b"- path: '*a.png'\n- 2 *b\n") == [{"path": "*a.png"}, "2 *b"]
    (tmp_path / "labels.yaml").write_text(ALIAS_BOMB)
    with pytest.raises(InputError, match=r"labels\.yaml: cannot be read as YAML: it has an alias"):
        read_labels(f"bosch:{tmp_path / 'labels.yaml'}")
    (tmp_path / "data.yaml").write_text(f"names: [light]\n{ALIAS_BOMB}")
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    with pytest.raises(InputError, match=r"data\.yaml: cannot be read as YAML: it has an alias"):
        read_labels(f"yolo:{tmp_path}")


# Settings that cannot be met.


@pytest.mark.parametrize("threads", [-1, MAX_THREADS + 1, 3000, 2**70])
def test_impossible_numbers_of_threads_are_refused(threads: int) -> None:
    with pytest.raises(SettingError, match=f"threads: expected 0 to {MAX_THREADS}, found"):
        build_map(small_dataset(), threads=threads)


def test_more_threads_than_cores_can_use_are_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert [bounded_threads(count) for count in (0, 1, 3, 8, 9, 1000)] == [0, 1, 3, 8, 8, 8]


def test_a_huge_number_of_threads_is_one_line_on_the_command_line(folder: Path, tmp_path: Path) -> None:
    assert "threads: expected 0 to" in complains("map", folder, "--out", tmp_path / "map", "--threads", str(2**70))


@pytest.mark.parametrize(
    ("method", "assignment", "owner"),
    [
        ("robust", "min_vote_ratio=2", "paper"),
        ("robust", "max_reprojection_error_px=6", "paper"),
        ("robust", "cluster_radius_m=50", "paper"),
        ("robust", "merge_radius_m=1", "paper"),
        ("paper", "gate_sigmas=4", "robust"),
        ("paper", "position_sigma_m=0.1", "robust"),
        ("paper", "rotation_sigma_deg=0.1", "robust"),
        ("paper", "min_existence=0.5", "robust"),
    ],
)
def test_settings_that_the_method_ignores_are_refused(method: Any, assignment: str, owner: Any) -> None:
    with pytest.raises(SettingError, match=f"the method {method} has no such setting, only {owner} has it") as caught:
        MapConfig(method=method).with_settings([assignment])
    assert f"--method {owner}" in caught.value.hint
    MapConfig(method=owner).with_settings([assignment])
    shown = {name: effect for name, _, _, effect in describe_settings()}
    assert shown[assignment.partition("=")[0]].endswith(f"({owner})")


@pytest.mark.parametrize("method", ["robust", "paper"])
def test_settings_of_the_method_change_its_maps_record(method: Any) -> None:
    config = MapConfig(method=method).with_settings(["min_votes=2", "detection_sigma_px=1.5"])
    assert (config.vote.min_votes, config.noise.detection_sigma_px) == (2, 1.5)


@pytest.mark.parametrize(("size", "batch"), [("30000", 1), ("8192", 2), ("32767x4096", 1)])
def test_a_size_that_does_not_fit_into_memory_is_refused(size: str, batch: int) -> None:
    with pytest.raises(SettingError, match="do not fit into memory"):
        DetectConfig(size=size, batch=batch)
    assert DetectConfig(size="8192").size_px == (8192, 8192)


# Pictures and models.


def png_header(width: int, height: int) -> bytes:
    """Return a PNG that promises a size and has no pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def jpeg_header(width: int, height: int) -> bytes:
    """Return a JPEG that promises a size and has no pixels."""
    frame = struct.pack(">BHHB", 8, height, width, 3) + b"\x01\x11\x00\x02\x11\x00\x03\x11\x00"
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


@pytest.mark.parametrize("header", [png_header, jpeg_header])
def test_a_header_that_promises_a_huge_picture_is_not_believed(header: Any, tmp_path: Path) -> None:
    (tmp_path / "a.img").write_bytes(header(32000, 32000))
    with pytest.raises(UnusablePicture, match="is 32000 x 32000 px, more than the 268 million that are read"):
        read_picture(tmp_path / "a.img")
    (tmp_path / "a.img").write_bytes(header(16384, 16385))
    with pytest.raises(UnusablePicture, match="more than the 268 million"):
        read_picture(tmp_path / "a.img")


def test_a_pipe_or_a_folder_is_no_picture(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.jpg")
    for path in (tmp_path / "pipe.jpg", tmp_path):
        with pytest.raises(UnusablePicture, match="is no file"):
            read_picture(path)
    with pytest.raises(UnusablePicture, match="no such file"):
        read_picture(tmp_path / "absent.jpg")


def test_a_model_that_keeps_its_weights_elsewhere_is_named(tmp_path: Path) -> None:
    weights = numpy_helper.from_array(np.ones((3, 3, 1, 1), np.float32), "weights")
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "weights"], ["probability"])],
        "tiny",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 64, 64])],
        [helper.make_tensor_value_info("probability", TensorProto.FLOAT, [1, 3, 64, 64])],
        initializer=[weights],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(model, tmp_path / "model.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    with pytest.raises(InputError, match=r"model\.onnx: keeps its weights in another file, 'weights\.bin'") as caught:
        load_model(tmp_path / "model.onnx", DetectConfig())
    assert "put them into one" in caught.value.hint


# Truth of surveys.


@pytest.mark.parametrize(
    "text",
    [
        "object_id,x,y,z\nTL-17a,0,0,0\nTL-17b,9,0,0\n",
        "object_id;x;y;z\nTL-17a;0,0;0;0\nTL-17b;9;0;0\n",
        "\ufeffX,Y,Z\n0,0,0\n9,0,0\n",
        "object_id,x,y,z\n7,0,0,0\n8,9,0,0\n",
    ],
)
def test_truth_of_surveys_is_read(text: str, tmp_path: Path) -> None:
    (tmp_path / "survey.csv").write_text(text, encoding="utf-8")
    evaluation = evaluate_map(map_of([[0.1, 0.0, 0.0], [9.0, 0.1, 0.0]]), tmp_path / "survey.csv")
    assert (evaluation.objects, evaluation.true_positives) == (2, 2)


def test_ids_of_surveys_are_kept_where_they_are_numbers(tmp_path: Path) -> None:
    (tmp_path / "survey.csv").write_text("object_id,x,y,z\n70,0,0,0\n8,9,0,0\n")
    matches = evaluate_map(map_of([[0.1, 0.0, 0.0]]), tmp_path / "survey.csv").matches
    assert sorted(matches.objects.object_id.tolist()) == [8, 70]


def test_a_column_of_texts_from_parquet_is_read_too(tmp_path: Path) -> None:
    valuemap.write_dataset(small_dataset(), tmp_path / "city")
    path = tmp_path / "city" / "truth.parquet"
    rewrite(path, with_column("object_id", pa.array(["a", "b"])))
    assert evaluate_map(map_of([[4.0, 25.0, 5.0]]), path).true_positives == 1


def test_truth_may_be_packed(tmp_path: Path) -> None:
    write_map(map_of([[1.0, 2.0, 3.0]]), tmp_path / "map")
    (tmp_path / "truth.csv.gz").write_bytes(gzip.compress(b"object_id,class,x,y,z\n1,light,1,2,3\n"))
    found = read_truth(tmp_path / "truth.csv.gz", read_map(tmp_path / "map"))
    assert isinstance(found, TrueObjects)
    assert len(found) == 1
    (tmp_path / "truth.gpkg.gz").write_bytes(gzip.compress(b"x"))
    with pytest.raises(InputError, match="truth of an unknown kind: .gz"):
        read_truth(tmp_path / "truth.gpkg.gz", read_map(tmp_path / "map"))
