"""What the documentation says is so: links lead somewhere, commands exist, snippets run, no column is missing."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

import valuemap
from block import block
from small_dataset import map_of, small_dataset, votes_of_two_labels
from still_poses import nothing_found
from tiny_models import red_finder
from valuemap import _core, correction, tables
from valuemap.cli.commands import app
from valuemap.dataset import Dataset, write_dataset
from valuemap.map_folder import read_map, write_map
from valuemap.readers import READERS
from valuemap.readers.detections import DETECTIONS
from valuemap.simulate import PRESETS, simulate
from valuemap.tables.map import REJECTION_REASONS
from valuemap.writers import SUFFIXES

ROOT = Path(__file__).parents[1]
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), *sorted(ROOT.glob("*.md")), ROOT / "benchmarks" / "README.md"]
TUTORIALS = ("colmap", "panoramas", "detector", "large")
NEEDS_A_BROWSER = ("view", "demo")
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_PRINTED = re.compile(r"^print\(.*\)  # (.*)$", re.MULTILINE)
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page: Path, language: str) -> list[str]:
    return [code for name, code in _FENCE.findall(page.read_text(encoding="utf-8")) if name == language]


def slug(heading: str) -> str:
    """Return the anchor of a heading, as Markdown's table of contents and GitHub make it."""
    text = re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
    return re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", text))


def anchors(page: Path) -> set[str]:
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)}


def test_every_format_that_is_read_or_written_has_a_page() -> None:
    folder = ROOT / "docs" / "formats"
    named = {page.stem: page.read_text(encoding="utf-8") for page in folder.glob("*.md")}
    for name in READERS:
        assert f"valuemap import {name} " in named[name], name
    for name in DETECTIONS:
        assert f"](detections_{name}.md)" in named["detections"]
        assert "valuemap import" in named[f"detections_{name}"]
    written = "".join(named[name] for name in ("gis", "osm", "hd_maps", "viewers"))
    for name in SUFFIXES.values():
        assert f"\n## {name}\n" in written, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    for target in _LINK.findall(re.sub(r"`[^`\n]*`", "", text)):
        if "://" in target:
            continue
        place, _, anchor = target.partition("#")
        file = page if not place else (page.parent / place).resolve()
        if not file.exists() or (anchor and anchor not in anchors(file)):
            lost.append(target)
    assert lost == []


def test_a_link_to_nowhere_would_be_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# One thing: `this`\n\n[a](nowhere.md) [b](#one-thing-this) [c](#another)\n")
    assert anchors(page) == {"one-thing-this"}
    with pytest.raises(AssertionError, match="nowhere.md"):
        test_links_lead_somewhere(page)


def commands(page: Path) -> Iterator[list[str]]:
    """Yield the commands in fenced and indented code of a page, each as its words."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for line in re.findall(r"^\s*(?:\$ )?(valuemap .*)$", text, flags=re.MULTILINE):
        if line.startswith("valuemap ") and is_code(text, line):
            yield shlex.split(line.split("  #")[0].split(" # ")[0])


def is_code(text: str, line: str) -> bool:
    return any(line in code for _, code in _FENCE.findall(text)) or f"    {line}" in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_options_exist(page: Path) -> None:
    unknown = [" ".join(words) for words in commands(page) if not exists(words)]
    assert unknown == []


@cache
def whole_command() -> Any:
    return typer.main.get_command(app)


def exists(words: list[str]) -> bool:
    """Return whether there is a command of this name with all options that are named."""
    command = whole_command()
    rest = words[1:]
    while hasattr(command, "commands") and rest and rest[0] in command.commands:
        command, rest = command.commands[rest[0]], rest[1:]
    if hasattr(command, "commands"):
        return not rest or rest[0].startswith("-") or rest[0].isupper()
    known = {name for parameter in command.params for name in parameter.opts} | {"--help"}
    return {word.partition("=")[0] for word in rest if re.match(r"--\w", word)} <= known


def test_an_option_that_is_none_would_be_found() -> None:
    assert exists(["valuemap", "map", "x", "--out", "y"])
    assert not exists(["valuemap", "map", "x", "--output", "y"])
    assert not exists(["valuemap", "import", "nothing", "x"])


def test_files_of_the_code_that_the_method_names_exist() -> None:
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    folders = (ROOT, ROOT / "python" / "valuemap", ROOT / "crates" / "valuemap-core" / "src" / "robust")
    named = set(re.findall(r"`([\w/]+\.(?:rs|py))`", text))
    assert len(named) > 10
    assert [name for name in named if not any((folder / name).is_file() for folder in folders)] == []


def test_every_column_of_every_table_is_explained() -> None:
    text = (ROOT / "docs" / "tables.md").read_text(encoding="utf-8")
    pattern = re.compile(r"^### ([\w.]+parquet(?: of a \w+)?)\n(.*?)(?=^##|\Z)", re.DOTALL | re.MULTILINE)
    sections = dict(pattern.findall(text))
    for name, kind in {
        "cameras.parquet": tables.Cameras,
        "images.parquet": tables.Images,
        "detections.parquet": tables.Detections,
        "truth.parquet": tables.Truth,
        "truth_detections.parquet": tables.TruthDetections,
        "rejected.parquet of a dataset": tables.RejectedRows,
        "labels.parquet": tables.Labels,
        "votes.parquet": tables.Votes,
        "rejected.parquet of a map": tables.Rejected,
        "changes.parquet": tables.Changes,
        "bridge.parquet": tables.IdBridge,
    }.items():
        told = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`[^|]*) \|", sections[name], flags=re.MULTILINE))))
        assert told == {column for field in fields(kind) for column in field.metadata["names"]}, name
    for reason in REJECTION_REASONS:
        assert f"`{reason}`" in sections["rejected.parquet of a map"]


def test_everything_that_is_learned_of_a_class_is_explained() -> None:
    text = (ROOT / "docs" / "tables.md").read_text(encoding="utf-8")
    section = re.search(r"^### What was learned.*?(?=^###)", text, flags=re.DOTALL | re.MULTILINE)
    assert section is not None
    told = re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`[^|]*) \|", section[0], flags=re.MULTILINE)))
    assert set(told) == {name for name, _ in _core.CLASS_FIELDS}


def test_the_table_of_figures_is_that_of_the_results() -> None:
    script = ROOT / "benchmarks" / "readme_table.py"
    done = subprocess.run([sys.executable, str(script), "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_table_of_figures_has_the_peers_on_real_data() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for name, peer in (
        ("London", "Krylov"),
        ("Bend", "auto-labeler"),
        ("KITTI raw", "AutoTS"),
        ("Argoverse", "COLMAP"),
    ):
        (row,) = re.findall(rf"^\| {name}.*$", readme, flags=re.MULTILINE)
        assert peer in row


def test_every_result_of_a_benchmark_is_explained() -> None:
    text = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"`(?:results/)?([\w*]+\.(?:json|md))`", text)
    results = sorted(path.name for path in (ROOT / "benchmarks" / "results").iterdir())
    assert [name for name in results if not any(fnmatch(name, each) for each in named)] == []


def test_every_page_is_in_the_site_once() -> None:
    site = re.findall(r"^ +- [^:]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), flags=re.MULTILINE)
    pages = (str(page.relative_to(ROOT / "docs")) for page in PAGES if (ROOT / "docs") in page.parents)
    assert sorted(site) == sorted(page for page in pages if not page.startswith("notes/"))


def test_the_site_fetches_nothing_from_elsewhere() -> None:
    pages = sorted((ROOT / "build" / "site").rglob("*.html"))
    if not pages:
        pytest.skip("the site is not built: make docs")
    fetched = re.compile(
        r"<(?:script|img|iframe)[^>]* src=\"?(?:https?:)?//|<link[^>]*stylesheet[^>]*href=\"?(?:https?:)?//"
    )
    assert [page.name for page in pages if fetched.search(page.read_text(encoding="utf-8"))] == []


def write_colmap_model(dataset: Dataset, folder: Path) -> None:
    """Write cameras and poses as COLMAP's texts."""
    folder.mkdir()
    cameras, images = dataset.cameras, dataset.images
    models = zip(cameras.camera_id, cameras.model.texts(), cameras.width_px, cameras.height_px, strict=True)
    with (folder / "cameras.txt").open("w") as file:
        for (number, model, width, height), params in zip(models, cameras.params, strict=True):
            print(number, model, width, height, *params.tolist(), file=file)
    poses = np.hstack([images.cam_from_world_quat, images.cam_from_world_m]).tolist()
    with (folder / "images.txt").open("w") as file:
        for number, pose, camera, name in zip(
            images.image_id, poses, images.camera_id, images.name.to_pylist(), strict=True
        ):
            print(number, *pose, camera, name, end="\n\n", file=file)


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the tutorials say that the reader has, which it goes to; poses stay, for speed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(correction, "refine_poses", nothing_found)
    few = block(frame_spacing_m=6.0, standing_interval_s=4.0, passes_per_street=1)
    monkeypatch.setitem(PRESETS, "small", few)
    city = simulate(few, seed=0)
    write_colmap_model(city, tmp_path / "model")
    names = dict(zip(city.images.image_id.tolist(), city.images.name.to_pylist(), strict=True))
    found = city.detections
    corner = found.center_px - found.size_px / 2.0
    boxes = [
        {
            "file_name": names[image],
            "bbox": [*map(float, left_top), *map(float, size)],
            "category_id": "light",
            "score": score,
        }
        for image, left_top, size, score in zip(
            found.image_id.tolist(), corner, found.size_px, found.score.tolist(), strict=True
        )
    ]
    (tmp_path / "coco.json").write_text(json.dumps(boxes))
    red_finder(tmp_path / "detector.onnx")
    for name in small_dataset().images.name.to_pylist():
        camera = (640, 480) if name.startswith("a/") else (800, 600)
        pixels = np.zeros((camera[1], camera[0], 3), np.uint8)
        pixels[200:230, 300:312, 0] = 255
        (tmp_path / "pictures" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(tmp_path / "pictures" / name, quality=95)
    labels = {
        "images": [{"id": 1, "file_name": "a/1.jpg", "width": 640, "height": 480}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [300, 200, 12, 30]}],
        "categories": [{"id": 1, "name": "traffic_light"}],
    }
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    return tmp_path


@pytest.mark.parametrize("tutorial", TUTORIALS)
def test_tutorials_run_as_they_stand(tutorial: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All blocks in their order; what opens a browser is only looked up, and what Python prints is as the page says."""
    page = ROOT / "docs" / "tutorials" / f"{tutorial}.md"
    if tutorial in ("detector", "large"):  # These begin with a dataset.
        write_dataset(small_dataset(), desk / "my-data")
    for language, code in _FENCE.findall(page.read_text(encoding="utf-8")):
        if language == "python":
            capsys.readouterr()
            exec(compile(code, page.name, "exec"), {})
            printed = capsys.readouterr().out
            assert [said for said in _PRINTED.findall(code) if said not in printed] == [], printed
        elif language == "sh":
            for line in code.splitlines():
                run(shlex.split(line.split(" # ")[0]))


def run(words: list[str]) -> None:
    if words[0] != "valuemap" or words[1] in NEEDS_A_BROWSER:
        assert words[0] != "valuemap" or exists(words)
        return
    done = CliRunner().invoke(app, words[1:])
    # The exit code of a check that found something is 3.
    assert done.exit_code in ((0, 3) if words[1] == "check" else (0,)), f"{words}: {done.output}"


def test_a_part_of_a_map_is_exported_as_the_page_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    dataset = small_dataset()
    whole = map_of([[4.0, 25.0, 5.0], [12.0, 20.0, 2.0]], existence=[0.99, 0.6])
    write_dataset(dataset, "DATASET")
    write_map(replace(whole, votes=votes_of_two_labels()), "MAP")
    (code,) = blocks(ROOT / "docs" / "formats" / "export.md", "python")
    exec(compile(code, "export.md", "exec"), {})
    assert read_map("sure-map").labels.label_id.tolist() == [0]
    for layer, rows in (("labels", 1), ("votes", 2)):
        assert pyogrio.read_dataframe("sure.gpkg", layer=layer).label_id.tolist() == [0] * rows


def test_the_readme_runs_as_it_stands(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its tables are those that the tutorial of panoramas makes."""
    (makes_tables, *_) = blocks(ROOT / "docs" / "tutorials" / "panoramas.md", "python")
    exec(compile(makes_tables, "panoramas.md", "exec"), {})
    readme = ROOT / "README.md"
    lines = [line for code in blocks(readme, "sh") for line in code.splitlines()]
    assert {line.split()[1] for line in lines} >= {"demo", "import", "map", "view", "export"}
    for line in lines:
        run(shlex.split(line))
    (example,) = blocks(readme, "python")
    exec(compile(example, "README.md", "exec"), {})
    assert "labels," in capsys.readouterr().out
    assert valuemap.read_map("street-map").labels.votes.min() >= 3
