"""Why there is no label: what is left over proposes points, and each says the test that it fails."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from report_city import city, write_city
from valuemap import rejected
from valuemap.arrays import Floats
from valuemap.cli.commands import app
from valuemap.config import MapConfig
from valuemap.dataset import rows_of
from valuemap.evidence import Evidence
from valuemap.map_folder import read_map, write_map
from valuemap.rejected import figures_in_words, find_rejected, rejected_of_map
from valuemap.tables import Categories, Rejected
from valuemap.tables.map import REJECTION_REASONS


def without_its_best_label(**settings: Any) -> tuple[Evidence, Floats, int]:
    """Return the city without the label that has most votes, where that was, and how many votes it had."""
    evidence = city()
    labels, votes = evidence.result.labels, evidence.result.votes
    best = int(np.argmax(labels.votes))
    others = votes.take(votes.label_id != labels.label_id[best])
    run = {**evidence.result.run, "settings": {**MapConfig().as_dict(), **settings}}
    without = labels.take(np.arange(len(labels)) != best)
    result = replace(evidence.result, labels=without, votes=others, run=run, rejected=None)
    return Evidence(result, evidence.dataset), labels.position_in_world_m[best], int(labels.votes[best])


def at(found: Rejected, point: Floats) -> int:
    """Return the row of the hypothesis nearest to a point."""
    away = np.linalg.norm(found.position_in_world_m - point, axis=1)
    assert away.min() < 1.0
    return int(np.argmin(away))


@pytest.mark.parametrize(
    ("settings", "reason", "threshold"),
    [
        ({}, "existence", None),
        ({"method": "paper"}, "ratio", math.nan),
        ({"min_votes": 1000}, "votes", 1000.0),
        ({"min_parallax_deg": 89.0}, "parallax", 89.0),
        ({"max_range_m": 8.0}, "range", 8.0),
        ({"min_range_m": 39.0, "max_range_m": 40.0}, "range", 39.0),
    ],
)
def test_a_label_that_is_taken_out_is_found_again_with_the_test_it_fails(
    settings: Any, reason: str, threshold: float | None
) -> None:
    evidence, point, votes = without_its_best_label(**settings)
    found = find_rejected(evidence)
    row = at(found, point)
    assert found.reason.texts()[row] == reason
    assert 0.3 * votes <= found.votes[row] <= 1.2 * votes
    assert found.rival is not None
    assert found.rival[row] == -1
    assert (found.expected[row] >= found.votes[row]) == (reason in ("existence", "ratio"))
    assert found.value is not None
    assert found.threshold is not None
    if threshold is None:
        labels = evidence.result.labels
        assert labels.expected is not None
        threshold = float(np.median(labels.votes / np.maximum(labels.expected, labels.votes)))
        assert found.value[row] == found.votes[row] / found.expected[row]
    assert found.threshold[row] == pytest.approx(threshold, nan_ok=True)
    assert math.isnan(found.value[row]) == math.isnan(threshold)
    if reason in ("votes", "parallax"):
        assert found.value[row] < threshold
    if reason == "range":
        assert (found.value[row] > threshold) == (threshold == 8.0)
    said = figures_in_words(found, row)
    assert f"{threshold:.0%}" in said if reason == "existence" else (f"{threshold:g}" in said) != math.isnan(threshold)


@pytest.mark.parametrize(("class_name", "reason"), [(None, "merged"), ("another", "class")])
def test_a_point_where_a_label_is_names_that_label(class_name: str | None, reason: str) -> None:
    evidence, point, _ = without_its_best_label()
    labels = evidence.result.labels
    names = labels.class_name.texts()
    names[0] = class_name or names[0]
    position = labels.position_in_world_m.copy()
    position[0] = point + [0.05, 0.0, 0.0]
    moved = labels.replace(position_in_world_m=position, class_name=Categories.from_texts(names))
    found = find_rejected(Evidence(replace(evidence.result, labels=moved), evidence.dataset))
    row = at(found, point)
    assert found.reason.texts()[row] == reason
    assert found.rival is not None
    assert found.value is not None
    assert found.threshold is not None
    assert found.rival[row] == labels.label_id[0]
    assert found.value[row] <= found.threshold[row]
    assert "sigmas" in figures_in_words(found, row)


def test_a_place_is_answered_as_the_whole_map_is() -> None:
    evidence, point, _ = without_its_best_label()
    whole, here = find_rejected(evidence), find_rejected(evidence, point)
    assert len(here) <= len(whole)
    assert here.reason.texts()[at(here, point)] == whole.reason.texts()[at(whole, point)] == "existence"
    assert len(find_rejected(evidence, point + [9e3, 0.0, 0.0])) == 0


def test_numbers_of_images_and_detections_say_nothing_of_what_was_rejected() -> None:
    evidence, *_ = without_its_best_label()
    dataset, result = evidence.dataset, evidence.result
    images, detections, votes = dataset.images, dataset.detections, result.votes
    random = np.random.default_rng(1)
    image_id, detection_id = random.permutation(len(images)), random.permutation(len(detections))
    image_of = image_id[rows_of(detections.image_id, images.image_id)]
    renumbered = replace(
        dataset,
        images=images.replace(image_id=image_id).by_key(),
        detections=detections.replace(detection_id=detection_id, image_id=image_of).by_key(),
        truth_detections=None,
    )
    votes = votes.replace(
        detection_id=detection_id[rows_of(votes.detection_id, detections.detection_id)],
        image_id=image_id[rows_of(votes.image_id, images.image_id)],
    )
    before, after = find_rejected(evidence), find_rejected(Evidence(replace(result, votes=votes), renumbered))
    assert len(before) > 5
    assert np.array_equal(before.position_in_world_m, after.position_in_world_m)
    assert np.array_equal(before.votes, after.votes)
    assert before.reason.texts() == after.reason.texts()


def test_what_is_kept_is_bounded_and_has_most_votes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence, *_ = without_its_best_label()
    found = find_rejected(evidence)
    assert np.all(np.diff(found.votes) <= 0)
    assert set(found.reason.names) <= set(REJECTION_REASONS)
    monkeypatch.setattr(rejected, "MOST_KEPT", 2)
    fewest = find_rejected(evidence)
    assert fewest.position_in_world_m.tolist() == found.position_in_world_m[:2].tolist()
    monkeypatch.setattr(rejected, "LARGEST", 10)
    counts = {"images": 6, "detections": 5}
    assert rejected_of_map(replace(evidence.result, run={"counts": counts}), lambda: pytest.fail("read")) is None


def test_a_map_without_detections_left_over_keeps_an_empty_table(tmp_path: Path) -> None:
    evidence, *_ = without_its_best_label()
    dataset = evidence.dataset
    taken = dataset.detections.take(evidence.label_of_detection >= 0)
    whole = Evidence(evidence.result, replace(dataset, detections=taken, truth_detections=None))
    found = find_rejected(whole)
    assert len(found) == 0
    write_map(replace(evidence.result, rejected=found), tmp_path / "map")
    kept = read_map(tmp_path / "map").rejected
    assert kept is not None
    assert len(kept) == 0


def test_show_says_why_without_a_kept_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_city(tmp_path)
    evidence, point, _ = without_its_best_label()
    write_map(evidence.result, tmp_path / "less")
    place = [f"{c:.2f}" for c in point[:2]]
    app(
        ["show", str(tmp_path / "less"), "--at", *place, "--dataset", str(tmp_path / "dataset"), "--out",
         str(tmp_path / "place.png")],
        standalone_mode=False,
    )  # fmt: skip
    assert "A hypothesis (traffic_light)" in (said := capsys.readouterr().out)
    assert REJECTION_REASONS["existence"] in " ".join(said.split())
