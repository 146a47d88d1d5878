"""The report: it needs nothing from elsewhere, shows what it claims, and takes no name for anything but a name."""

from __future__ import annotations

import base64
import csv
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from report_city import city, write_city
from small_dataset import map_of, small_dataset
from told import Told
from valuemap import MapConfig, build_map
from valuemap.dataset import Dataset
from valuemap.errors import InputError
from valuemap.evaluate import Evaluation, evaluate_map
from valuemap.evidence import Evidence
from valuemap.experiment import CURVES, PassesResult, Quartiles
from valuemap.map_folder import Map
from valuemap.report.errors import spread_m
from valuemap.report.figures import existence, normalized_errors, passes, residuals_by_depth
from valuemap.report.ground import look_down
from valuemap.report.page import inline_data, shown
from valuemap.report.paper import ReportTable, paper_tables
from valuemap.report.run_tables import accuracy_tables, doubtful_rows, run_tables, worst_rows
from valuemap.report.style import probability
from valuemap.report.write import files_folder, write_csv_table, write_report
from valuemap.tables import Categories, Truth

HOSTILE = ["<script>alert(1)</script>", "[/] [bold]", "=cmd|' /C calc'!A0", "\"quoted\" & 'single'", "</title><b>"]


def passes_result() -> PassesResult:
    curve = [Quartiles(1, 5, 0.5, 0.6, 0.7), Quartiles(2, 4, 0.7, 0.8, 0.9)]
    return PassesResult("d", "robust", "the truth", 5, 3, 2, dict.fromkeys(CURVES, curve))


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the page of a city with truth, curves and some pictures."""
    folder = tmp_path_factory.mktemp("report")
    data, _ = write_city(folder, pictures=6)
    write_again(folder / "report.html", data)
    return folder / "report.html"


def write_again(page: Path, data: Path) -> None:
    evidence = city()
    evaluation = evaluate_map(evidence.result, evidence.dataset)
    write_report(
        evidence.result,
        page,
        dataset=evidence.dataset,
        dataset_folder=data,
        evaluation=evaluation,
        passes=passes_result(),
        progress=(told := Told()),
    )
    told.check("drawing the report")


class Page(HTMLParser):
    """What is in a page: its tags with attributes, its text outside scripts, its inline data."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.scripts: list[str] = []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._inside = tag if tag in ("script", "style") else self._inside
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag == self._inside:
            self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts[-1] += data
        elif self._inside != "style":
            self.text += data

    @property
    def data(self) -> dict[str, Any]:
        """What the map needs and what a click needs, as one."""
        first, later = (json.loads(script) for script in self.scripts[:2])
        return {**first, **later, "arrays": {**first["arrays"], **later["arrays"]}}


def arrays_of(data: dict[str, Any]) -> dict[str, Any]:
    return {
        name: np.frombuffer(base64.b64decode(packed["data"]), np.dtype(f"<{packed['type']}"))
        for name, packed in data["arrays"].items()
    }


def test_nothing_comes_from_elsewhere(report: Path) -> None:
    page = Page(report.read_text(encoding="utf-8"))
    for _, attributes in page.tags:
        for name in ("src", "href", "xlink:href", "action", "data", "poster"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), value
    assert not re.search(r"@import|url\((?!#)", report.read_text(encoding="utf-8"))
    for word in ("fetch(", "XMLHttpRequest", "Worker(", "import(", "WebSocket", 'type="module"'):
        assert word not in report.read_text(encoding="utf-8")
    policy = next(a["content"] for t, a in page.tags if t == "meta" and a.get("http-equiv"))
    assert policy is not None
    assert policy.startswith("default-src 'none'")
    assert "'unsafe-inline'" not in policy.split("script-src")[1]


def test_without_scripts_tables_figures_and_lists_are_there(report: Path) -> None:
    page = Page(report.read_text(encoding="utf-8"))
    tags = [tag for tag, _ in page.tags]
    assert tags.count("svg") == 5
    assert tags.count("table") == 11
    for text in (
        "Table 1. Detections and clusters",
        "Table 2. Passes per cluster",
        "Table 3. Results",
        "San Francisco (paper, other data)",
        "New York City (paper, other data)",
        "360,207",
        "What more passes bring",
        "Honesty of the covariance",
        "Reliability of existence",
        "Residuals by depth",
        "Where time and memory went",
        "The worst",
        "The most doubtful",
    ):
        assert text in page.text
    hidden = {a["id"] for _, a in page.tags if "hidden" in a and "id" in a}
    assert hidden == {"explore"}  # Only what needs scripts.
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))


def test_files_lie_beside_the_page(report: Path) -> None:
    folder = files_folder(report)
    names = {path.name for path in folder.iterdir()}
    for figure in ("map", "passes", "existence", "covariance", "residuals_by_depth", "stages"):
        assert (folder / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
        assert (folder / f"{figure}.svg").read_text().startswith("<?xml")
    assert {"table_1_data.csv", "table_2_passes.csv", "table_3_results.csv", "doubtful.csv", "worst.csv"} <= names
    with (folder / "table_1_data.csv").open(newline="") as file:
        rows = {row[0]: row[1:] for row in csv.reader(file)}
    assert rows["images"] == [str(len(city().dataset.images)), "12048", "360207"]
    assert rows["views per cluster, mean"][1:] == ["70.05", "91.4"]


def test_the_data_of_the_page_are_those_of_the_map(report: Path) -> None:
    evidence = city()
    labels, votes = evidence.result.labels, evidence.result.votes
    data = Page(report.read_text(encoding="utf-8")).data
    arrays = arrays_of(data)
    assert_array_equal(arrays["label_id"], labels.label_id)
    position = arrays["label_at"].reshape(-1, 3) + data["origin"]
    assert_allclose(position, labels.position_in_world_m, atol=1e-4)
    assert_array_equal(np.diff(arrays["vote_start"]), labels.votes)
    # Every ray passes its label as closely as the residual says: about that many pixels at its distance.
    label = np.repeat(np.arange(len(labels)), labels.votes)
    camera = arrays["camera_at"].reshape(-1, 3)[arrays["vote_image"]]
    away = arrays["label_at"].reshape(-1, 3)[label] - camera
    direction = arrays["vote_direction"].reshape(-1, 3) / 32767.0
    miss_m = np.linalg.norm(np.cross(away, direction), axis=1)
    focal_px = evidence.dataset.cameras.params[0][0]
    sight_px = miss_m / np.linalg.norm(away, axis=1) * focal_px
    assert_allclose(np.sort(sight_px), np.sort(arrays["vote_px"]), rtol=0.3, atol=1.0)
    assert_allclose(np.sort(arrays["vote_px"]), np.sort(votes.residual_px.astype(np.float32)))
    assert np.isfinite(arrays["label_at"]).all()


def test_pictures_that_are_there_give_crops(report: Path) -> None:
    page = Page(report.read_text(encoding="utf-8"))
    crops = [a for t, a in page.tags if t == "img" and (a["src"] or "").startswith("data:image/jpeg")]
    assert len(crops) > 20
    assert all("sigmas" in (a["alt"] or "") for a in crops)
    in_data = sum(map(len, page.data["crops"].values()))
    listed = {int(a["data-label"] or -1) for _, a in page.tags if "data-label" in a}
    assert listed | {int(row) for row in page.data["crops"]} == set(range(len(city().result.labels)))
    assert in_data + len(crops) >= len(city().result.labels)


def hostile_city() -> tuple[Map, Dataset]:
    """Return the city with names that want to be more: of the data set, classes, images and passes."""
    evidence = city()
    dataset, result = evidence.dataset, evidence.result
    images = dataset.images
    names = pa.array([HOSTILE[i % len(HOSTILE)] + str(i) for i in range(len(images))])
    passes = Categories.from_texts([HOSTILE[code % len(HOSTILE)] + str(code) for code in images.pass_id.codes])
    classes = Categories.from_texts([HOSTILE[i % len(HOSTILE)] for i in range(len(result.labels))])
    run = {**result.run, "notes": [HOSTILE[0]], "dataset": HOSTILE[0]}
    return (
        replace(result, labels=result.labels.replace(class_name=classes), run=run),
        replace(dataset, name=HOSTILE[0], images=images.replace(name=names, pass_id=passes)),
    )


def test_names_are_shown_as_text_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result, dataset = hostile_city()
    monkeypatch.setattr("valuemap.report.write._figures", lambda *_: [])  # Drawn in other tests.
    write_report(result, tmp_path / "r.html", dataset=dataset, dataset_folder=tmp_path)
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.scripts) == 3
    assert "<script>alert" not in text
    assert "</title><b>" not in text
    for name in HOSTILE:
        assert name in page.text
        assert name in page.data["classes"]
    assert HOSTILE[0] + "0" in page.data["passes"]
    assert any(name.startswith(HOSTILE[2]) for name in page.data["image_names"])
    with (tmp_path / "r_files" / "classes.csv").open(newline="") as file:
        cells = [cell for row in csv.reader(file) for cell in row]
    assert "'" + HOSTILE[2] in cells
    assert not any(cell.startswith(("=", "+", "@")) for cell in cells)


def test_the_same_map_gives_the_same_page(report: Path, tmp_path: Path) -> None:
    write_again(tmp_path / "report.html", report.parent / "dataset")
    assert (tmp_path / "report.html").read_bytes() == report.read_bytes()
    for path in files_folder(report).iterdir():
        assert (files_folder(tmp_path / "report.html") / path.name).read_bytes() == path.read_bytes(), path.name


@pytest.mark.parametrize("labels", [0, 1, 3])
def test_a_map_alone_gives_a_report(labels: int, tmp_path: Path) -> None:
    write_report(map_of(np.zeros((labels, 3)), run={}), tmp_path / "r.html")
    page = Page((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "The dataset of the map was not given" in page.text
    assert "Nothing was compared with a truth" in page.text
    assert len(arrays_of(page.data)["label_id"]) == labels
    assert ("The map has no labels" in page.text) == (labels == 0)
    assert ("Labels whose positions are the least certain" in page.text) == (labels > 0)


def test_another_dataset_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not in the dataset"):
        write_report(map_of([[0.0, 0.0, 0.0]], residual_px=[1.0]), tmp_path / "r.html", dataset=small_dataset())
    assert list(tmp_path.iterdir()) == []


# Tables and lists.


def evaluation_of() -> Evaluation:
    return evaluate_map(city().result, city().dataset)


def cells(table: ReportTable) -> dict[Any, tuple[Any, ...]]:
    return {row[0]: row[1:] for row in table.rows}


def test_settings_that_nobody_set_are_not_called_changed() -> None:
    dataset = city().dataset
    result = build_map(dataset, MapConfig(correct_poses=0, max_range_m=70))
    said = cells(next(table for table in run_tables(result) if table.name == "settings"))
    assert said["max_range_m"] == (70.0, "changed")
    assert said["correct_poses"] == (0, "changed")
    assert said["min_range_m"] == (pytest.approx(70 / 30), "estimated")
    assert said["detection_sigma_px"] == ("estimated", "")
    assert said["min_votes"] == (3, "")
    paper = build_map(dataset, MapConfig(method="paper"))
    said = cells(next(table for table in run_tables(paper) if table.name == "settings"))
    assert said["max_range_m"] == (60.0, "usual")


def test_table_1_counts_what_the_paper_counts() -> None:
    dataset = city().dataset
    table = cells(paper_tables(city().result, dataset, evaluation_of())[0])
    in_image = np.unique(dataset.detections.image_id, return_counts=True)[1]
    assert table["images with 1 detections"] == (int(np.sum(in_image == 1)), 6231, 145608)
    assert table["images with 0 detections"][0] == len(dataset.images) - len(in_image)
    assert sum(table[f"images with {i} detections"][0] for i in range(10)) + table["images with 10+ detections"][
        0
    ] == len(dataset.images)
    for column, images in ((1, 12048), (2, 360207)):
        shown_images = sum(table[f"images with {i}{'+' if i == 10 else ''} detections"][column] for i in range(11))
        assert abs(shown_images - images) <= 40  # As printed: 12,048 and 360,167.
    assert table["views per cluster, mean"][0] == pytest.approx(len(dataset.images) / table["clusters"][0])


def test_table_2_counts_every_cluster_once() -> None:
    tables = paper_tables(city().result, city().dataset, None)
    assert [table.name for table in tables] == ["table_1_data", "table_2_passes"]
    count = cells(tables[1])
    assert sum(row[0] for row in count.values()) == cells(tables[0])["clusters"][0]
    assert sum(row[1] for row in count.values()) == 123
    assert sum(row[2] for row in count.values()) == 1206


def test_table_3_is_the_evaluation() -> None:
    evaluation = evaluation_of()
    table = cells(paper_tables(city().result, city().dataset, evaluation)[2])
    assert table["true positives"] == (evaluation.true_positives, 156, 1560)
    assert table["duplicates"] == (evaluation.duplicates, 14, 56)
    assert table["recall"][1:] == pytest.approx((0.934, 0.901), abs=1e-3)


def test_without_heights_table_3_has_horizontal_errors() -> None:
    evaluation = evaluation_of()
    flat_objects = replace(evaluation.matches.objects, has_height=False)
    flat = replace(evaluation, matches=replace(evaluation.matches, objects=flat_objects))
    spatial, horizontal = (cells(paper_tables(city().result, city().dataset, each)[2]) for each in (evaluation, flat))
    assert spatial["position error, median (m)"][0] == pytest.approx(evaluation.position_median_m)
    assert horizontal["horizontal position error, rms (m)"][0] == pytest.approx(evaluation.horizontal_rmse_m)


def test_the_worst_come_first() -> None:
    result, evaluation = city().result, evaluation_of()
    rows = worst_rows(result, evaluation)
    outcome = evaluation.matches.label_outcome.texts()
    rank = [("false", "duplicate", "true").index(outcome[row]) for row in rows]
    assert rank == sorted(rank)
    existence = result.labels.existence
    assert existence is not None
    assert_array_equal(existence[doubtful_rows(result)], np.sort(existence)[: len(doubtful_rows(result))])


def test_of_false_labels_the_surest_is_the_worst() -> None:
    result, evaluation = city().result, evaluation_of()
    existence, count = result.labels.existence, len(result.labels)
    assert existence is not None
    none_found = replace(
        evaluation.matches,
        object_of_label=np.full(count, -1),
        label_outcome=Categories.from_texts(["false"] * count),
    )
    rows = worst_rows(result, replace(evaluation, matches=none_found))
    assert_array_equal(existence[rows], np.sort(existence)[::-1][: len(rows)])


def test_honest_covariances_are_called_honest() -> None:
    """Labels off by errors that are drawn from their own covariance have squared errors of 3 on average."""
    random = np.random.default_rng(0)
    truth = np.stack([np.arange(400) * 10.0, np.zeros(400), np.zeros(400)], axis=1)
    result = map_of(truth + random.normal(0.0, [0.2, 0.1, 0.3], (400, 3)))
    evaluation = evaluate_map(result, Truth(np.arange(400), Categories.from_texts(["light"] * 400), truth))
    squared, dimensions = normalized_errors(result, evaluation)
    assert dimensions == 3
    assert squared.mean() == pytest.approx(3.0, abs=0.35)


def test_errors_against_a_truth_are_in_units_of_the_covariance_in_the_world() -> None:
    truth = np.stack([np.arange(4) * 10.0, np.zeros(4), np.zeros(4)], axis=1)
    result = map_of(truth + np.array([2.0, 0.0, 0.0]))  # The whole map is off, and says so.
    in_world = result.labels.covariance_m2 + np.array([4.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    placed = replace(result, labels=result.labels.replace(absolute_covariance_m2=in_world))
    objects = Truth(np.arange(4), Categories.from_texts(["light"] * 4), truth)
    for each, expected in ((result, 4.0 / result.labels.covariance_m2[:, 0]), (placed, 4.0 / in_world[:, 0])):
        squared, _ = normalized_errors(each, evaluate_map(each, objects, radius_m=3.0))
        assert_allclose(squared, expected)
    assert_allclose(spread_m(placed) ** 2 - spread_m(result) ** 2, 4.0)
    wider = np.max(look_down(placed, None, None).half_axes_m) - np.max(look_down(result, None, None).half_axes_m)
    assert wider > 2.0


@pytest.mark.parametrize(
    ("cell", "text"),
    [(None, "\u2013"), (1234567, "1,234,567"), (0.93412, "0.934"), (12.3456, "12.35"), (1e-7, "1e-07"), (3.0, "3")],
)
def test_cells_are_readable(cell: Any, text: str) -> None:
    assert shown(cell) == text


@pytest.mark.parametrize(
    ("value", "text"), [(1.0, "> 0.999"), (0.9994, "0.999"), (0.5, "0.500"), (1e-5, "< 0.001"), (0.0, "0.000")]
)
def test_what_is_nearly_certain_is_not_called_certain(value: float, text: str) -> None:
    assert probability(value) == text


def test_what_marks_mean_is_not_said_over_the_marks() -> None:
    evidence = city()
    evaluation = evaluate_map(evidence.result, evidence.dataset)
    drawn = residuals_by_depth(evidence), existence(evidence.result, evaluation), passes(passes_result())
    for figure in (each.figure for each in drawn if each is not None):
        figure.draw_without_rendering()
        (legend,) = figure.legends
        words = legend.get_window_extent()
        assert legend.get_texts()
        assert 0.0 <= words.x0 < words.x1 <= figure.bbox.width
        assert not any(words.overlaps(axes.get_window_extent()) for axes in figure.axes)
        assert not any(axes.get_legend() for axes in figure.axes)


def test_names_of_figures_are_readable_and_say_their_units() -> None:
    tables = {table.name: cells(table) for table in [*accuracy_tables(evaluation_of()), *run_tables(city().result)]}
    assert tables["accuracy"]["RMSE, horizontal (m)"][0] == evaluation_of().accuracy.rmse_h_m
    assert "noise position (m)" in tables["counts"]
    names = [name for name in (*tables["accuracy"], *tables["counts"]) if "_" in name or name.endswith(" m")]
    assert names == []


def test_formulas_are_marked_as_text(tmp_path: Path) -> None:
    write_csv_table(ReportTable("t", "t", ("=a", "b"), (("-x", -1.5), ("plain", None))), tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text() == "'=a,b\n'-x,-1.5\nplain,\n"


def test_inline_data_of_a_map_alone_has_no_rays() -> None:
    data, details = inline_data(map_of([[1.0, 2.0, 3.0]]), None, None, {})
    assert set(data["detail_arrays"]) == set(details["arrays"])
    arrays = arrays_of(details)
    assert len(arrays["vote_image"]) == 0
    assert_array_equal(arrays["vote_start"], [0, 0])
    assert isinstance(city(), Evidence)


# In a browser.

BROWSER = next((found for name in ("chromium", "chromium-browser") if (found := shutil.which(name))), None)


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium on this machine")
def test_a_browser_without_network_draws_all_labels(report: Path, tmp_path: Path) -> None:
    assert BROWSER is not None
    done = subprocess.run(
        [
            BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={tmp_path}", "--virtual-time-budget=4000", "--dump-dom", report.as_uri(),
        ],
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert f'data-ready="{len(city().result.labels)}"' in done.stdout, done.stderr[-2000:]
