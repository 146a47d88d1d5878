"""Labels that an update found to be gone: whatever shows a map marks them, and counts them apart."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex

from browser import in_browser, require_browser
from report_city import city, write_city
from small_dataset import map_of
from test_report_page import Page, arrays_of, cells
from test_viewer import serve, unpack
from valuemap.cli.commands import app
from valuemap.evaluate import evaluate_map
from valuemap.evidence import Evidence
from valuemap.map_folder import Map, write_map
from valuemap.report.above import plot_map
from valuemap.report.label_sheet import plot_label
from valuemap.report.place_sheet import explain_place, plot_place
from valuemap.report.run_tables import doubtful_rows, label_table, run_tables, worst_rows
from valuemap.report.style import GREY
from valuemap.report.write import write_report
from valuemap.summary import summarize_map
from valuemap.tables import Categories, Truth
from valuemap.viewer.scene import OUTCOMES, Scene

GONE = 3
"""The id of the one label of the small map that is gone."""


def updated(result: Map, *gone: int) -> Map:
    """Return a map with states, as `valuemap update` gives them."""
    states = ["gone" if label in gone else "confirmed" for label in result.labels.label_id.tolist()]
    return replace(result, labels=result.labels.replace(state=Categories.from_texts(states)))


def small() -> Map:
    """Return four labels, of which the last, the least probable with the largest covariance, is gone."""
    result = map_of([[0, 0, 5], [20, 0, 5], [40, 0, 5], [60, 0, 5]], existence=[0.9, 0.8, 0.7, 0.1])
    covariance = result.labels.covariance_m2 * np.array([[1.0], [1.0], [1.0], [9.0]])
    return updated(replace(result, labels=result.labels.replace(covariance_m2=covariance)), GONE)


def test_the_report_counts_and_lists_labels_that_are_there() -> None:
    result = small()
    assert doubtful_rows(result).tolist() == [2, 1, 0]
    assert worst_rows(result, None).tolist() == [0, 1, 2]
    truth = Truth(np.arange(2), Categories.from_texts(["light"] * 2), np.array([[0.0, 0.0, 5.0], [90.0, 0.0, 5.0]]))
    evaluation = evaluate_map(result, truth)
    assert worst_rows(result, evaluation).tolist() == [1, 2, 0]
    classes = run_tables(result)[0]
    assert classes.rows[0][:2] == ("light", 3)
    assert "1 label that an update found to be gone is left out." in classes.notes
    assert cells(label_table("doubtful", "", result, doubtful_rows(result), None))[2][-1] == "confirmed"


def test_the_page_of_the_report_marks_what_is_gone(tmp_path: Path) -> None:
    write_report(small(), tmp_path / "r.html")
    page = Page((tmp_path / "r.html").read_text())
    assert "3labels1labels that are gone, not counted" in page.text
    assert "state: confirmed" in page.text
    assert "Label 3" not in page.text
    data = page.data
    arrays = arrays_of(data)
    assert arrays["is_gone"].tolist() == [0, 0, 0, 1]
    assert [data["states"][code] for code in arrays["label_state"]] == ["confirmed"] * 3 + ["gone"]


def test_the_picture_from_above_has_another_mark_for_what_is_gone() -> None:
    figure = plot_map(small())
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["label: light (3)", "label, gone (1)"]
    marks = [line for line in figure.axes[0].lines if line.get_marker() == "x" and np.size(line.get_xdata())]
    assert [to_hex(line.get_markeredgecolor()) for line in marks] == [GREY]
    assert "3 labels, 1 more that are gone" in figure.texts[1].get_text()


def test_show_and_info_say_what_is_gone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, _ = write_city(tmp_path)
    label = int(city().result.labels.label_id[0])
    result = updated(city().result, label)
    write_map(result, tmp_path / "updated")

    def told(*arguments: object) -> dict[str, object]:
        with pytest.raises(SystemExit) as stopped:
            app(list(map(str, arguments)))
        assert stopped.value.code == 0
        said: dict[str, object] = json.loads(capsys.readouterr().out)
        return said

    of_label = ("--dataset", data, "--out", tmp_path / "l.png", "--json")
    assert told("show", tmp_path / "updated", label, *of_label)["state"] == "gone"
    of_map = told("info", tmp_path / "updated", "--json")
    assert (of_map["labels_gone"], of_map["labels_confirmed"]) == (1, len(result.labels) - 1)
    assert "labels_gone" not in summarize_map(city().result)
    sheet = plot_label(Evidence(result, city().dataset), label)
    assert sheet.texts[0].get_text().endswith(", gone")
    assert "state: gone" in sheet.texts[1].get_text()
    evidence = Evidence(result, city().dataset)
    point = result.labels.position_in_world_m[0]
    place = plot_place(evidence, explain_place(evidence, point, None), None)
    legend = place.axes[0].get_legend()
    assert legend is not None
    assert "labels that are gone" in [text.get_text() for text in legend.get_texts()]


def test_the_server_of_the_page_says_what_is_gone(tmp_path: Path) -> None:
    write_map(small(), tmp_path / "map")
    (tmp_path / "truth.csv").write_text("x,y,z,class\n0.1,0,5,light\n")
    scene = Scene(tmp_path / "map", truth=tmp_path / "truth.csv")
    assert [OUTCOMES[each] for each in unpack(scene.truth_body)["label_outcome"]] == ["true", "false", "false", "gone"]
    for asked in serve(lambda: scene, tmp_path / "review.json"):
        head = asked.get("/api/map").json()
        assert (head["counts"]["labels"], head["counts"]["gone"]) == (3, 1)
        state = unpack(asked.get("/api/labels").body)["state"]
        assert [head["states"][code] for code in state] == ["confirmed"] * 3 + ["gone"]
        details = asked.get(f"/api/label?id={GONE}").json()
        assert details["state"] == "gone"
        east, north, _ = details["local_m"]
        assert asked.get(f"/api/place?east={east}&north={north + 1}").json()["labels"][0]["state"] == "gone"
    write_map(map_of([[0, 0, 5]]), tmp_path / "plain")
    plain = Scene(tmp_path / "plain")
    assert plain.head()["states"] == []
    assert unpack(plain.labels_body)["state"].tolist() == [-1]


def test_the_page_shows_what_is_gone_last_and_calls_it_so(tmp_path: Path) -> None:
    require_browser()
    write_map(small(), tmp_path / "map")
    for client in serve(lambda: Scene(tmp_path / "map"), tmp_path / "review.json"):
        seen = in_browser("gone.mjs", client.server.address, GONE, tmp_path / "shot.png")
    assert seen["noted"]["complaints"] == []
    assert "3 labels and 1 gone" in seen["name"]
    assert seen["title"] == "Labels 4 of 4, 1 gone, doubtful first"
    assert [text[:1] for text in seen["list"]] == ["2", "1", "0", str(GONE)]
    assert seen["list"][-1].endswith("gone")
    assert "gone" in seen["legend"]
    assert seen["sub"].endswith("gone")
    assert seen["said"] == ["An update found that this label is no longer there. Its votes are from before."]
    assert [text[:1] for text in seen["filtered"]] == ["2", "1", "0"]
    assert "noupdate=gone" in seen["address"]
