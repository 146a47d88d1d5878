"""The report in a browser: from disk, without a network, with scripts and without."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from browser import in_browser, require_browser
from report_city import city, write_city
from test_report_page import HOSTILE, hostile_city, passes_result
from valuemap.evaluate import evaluate_map
from valuemap.report.write import write_report


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the page of a city whose names want to be more than names."""
    require_browser()
    folder = tmp_path_factory.mktemp("report")
    data, _ = write_city(folder, pictures=6)
    result, dataset = hostile_city()
    write_report(
        result,
        folder / "report.html",
        dataset=dataset,
        dataset_folder=data,
        evaluation=evaluate_map(result, dataset),
        passes=passes_result(),
    )
    return folder / "report.html"


def test_from_disk_without_a_network_a_click_shows_what_a_label_rests_on(page: Path, tmp_path: Path) -> None:
    labels = city().result.labels
    row = int(labels.votes.argmax())
    seen = in_browser("report.mjs", page, "on", labels.label_id[row], tmp_path / "a.png", tmp_path / "b.png")
    assert seen["requests"] == [page.as_uri()]
    assert seen["complaints"] == []
    assert seen["labels"] == len(labels)
    assert seen["colors"] > 20, "the map is drawn"
    assert seen["chosen"].startswith(f"Label {labels.label_id[row]}: ")
    hostile, dataset = hostile_city()
    matches = evaluate_map(hostile, dataset).matches
    labelled, objects = matches.label_outcome, matches.object_outcome
    there = {labelled.names[code] for code in labelled.codes} - {"true"}
    there |= {objects.names[code] for code in objects.codes}
    there |= {hostile.labels.class_name.names[code] for code in hostile.labels.class_name.codes}
    assert len(set(seen["marks"])) == len(seen["marks"]), "marks are told apart in print, without their colours"
    assert len(seen["marks"]) == len(there), "what the map shows, and nothing that it does not"
    assert seen["rows"] == min(300, labels.votes[row])
    assert seen["cleared"]
    assert seen["again"] == seen["chosen"]
    assert seen["next"] != seen["chosen"]
    assert HOSTILE[0] + "0" in seen["panel"] + seen["text"]
    assert seen["map"] == 0, "the map on the canvas takes the place of the picture"
    with Image.open(tmp_path / "b.png") as screenshot:
        assert screenshot.size == (1280, 900)


def test_with_scripts_off_tables_figures_and_lists_show(page: Path, tmp_path: Path) -> None:
    seen = in_browser("report.mjs", page, "off", "", tmp_path / "off.png")
    assert seen["requests"] == [page.as_uri()]
    assert (seen["map"], seen["controls"]) == (1, 0), "a picture of the map, and nothing that needs scripts"
    assert seen["figures"] == 4  # No label is of the class of an object, so nothing says how honest covariances are.
    assert seen["tables"] >= 9
    assert seen["phone"]["beyond"] <= 0
    assert seen["phone"]["lines"] < 1.0, "words are not broken into letters"
    assert seen["print"]["proportion"] == pytest.approx(0.5, abs=0.01)
    assert 300 < seen["print"]["height"] < 1000, "on one sheet of paper"
    assert seen["cards"] > 5
    assert "Table 3. Results" in seen["text"]
    for name in HOSTILE:
        assert name in seen["text"]
